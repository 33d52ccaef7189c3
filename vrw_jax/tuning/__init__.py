"""The best gait that keeps its premises."""

from vrw_jax.tuning.climbing import ACTIVE, Kind
from vrw_jax.tuning.problem import tune
from vrw_jax.tuning.result import Tuned
