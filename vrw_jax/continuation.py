"""Fixed points and continuation of any map."""

from vrw_jax.branches.arclength import ArclengthOptions
from vrw_jax.gaits.fixed_points import FixedPointResult, solve_fixed_point
from vrw_jax.gaits.floquet import floquet_multipliers

__all__ = (
    "ArclengthOptions",
    "FixedPointResult",
    "floquet_multipliers",
    "solve_fixed_point",
)  # The list of `help`.
