"""Optimization of gaits with margins as constraints."""

from vrw_jax.tuning.maximization import MAXIMIZATION_OPTIONS, TrialKind
from vrw_jax.tuning.objective import WheelObjective
from vrw_jax.tuning.tune_problem import tune
from vrw_jax.tuning.tune_result import TuneResult
