"""Continue branches of gaits in one parameter, and curves of special points in two parameters."""

from vrw_jax.branches.branch import Branch, SpecialPoint, SpecialPointCurve
from vrw_jax.branches.continuation import continue_branch, continue_branches, continue_map
from vrw_jax.branches.special_point_curves import continue_special_point
from vrw_jax.branches.special_point_map import (
    SPECIAL_POINT_MEASURES,
    ScanSignChange,
    trace_special_points,
)
