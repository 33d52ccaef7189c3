"""Fixed points and continuation of any map."""

from vrw_jax.base.small_matrices import floquet_multipliers
from vrw_jax.branches.arclength import ArclengthOptions
from vrw_jax.gaits.fixed_points import FixedPointResult, solve_fixed_point

__all__ = (
    "ArclengthOptions",
    "FixedPointResult",
    "floquet_multipliers",
    "solve_fixed_point",
)  # The list of `help`.
