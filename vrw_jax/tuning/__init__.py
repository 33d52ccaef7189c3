"""Optimization of gaits under margins as constraints."""

from vrw_jax.tuning.climbing import ACTIVE_BOUND_TOLERANCE, TrialKind
from vrw_jax.tuning.problem import tune
from vrw_jax.tuning.result import TuneResult
