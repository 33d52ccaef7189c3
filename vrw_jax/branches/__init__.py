"""Branches of gaits along one parameter, with their special points."""

from vrw_jax.branches.bordering import border_curve
from vrw_jax.branches.branch import Border, BorderCurve, Branch
from vrw_jax.branches.continuation import continue_branch, continue_branches, continue_map
from vrw_jax.branches.mapping import SCANNED, Change, border_map
