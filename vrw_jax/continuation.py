"""Fixed points and continuation of any map."""

from vrw_jax.branches.arclength import (
    AbstractContinuationProblem,
    ArclengthOptions,
    FixedPointProblem,
    NewtonStep,
    continue_from,
)
from vrw_jax.gaits.fixed_points import FixedPointResult, solve_fixed_point
from vrw_jax.gaits.floquet import floquet_multipliers

__all__ = (
    "ArclengthOptions",
    "FixedPointProblem",
    "FixedPointResult",
    "continue_from",
    "floquet_multipliers",
    "solve_fixed_point",
)  # The list of `help`.
