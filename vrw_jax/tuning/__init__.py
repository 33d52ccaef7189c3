"""Optimization of gaits under margins as constraints."""

from vrw_jax.tuning.climbing import ACTIVE, Kind
from vrw_jax.tuning.problem import tune
from vrw_jax.tuning.result import Tuned
