"""Branches of gaits along one parameter, with every border on the way."""

from vrw_jax.branches.bordering import BorderCurve, border_curve, border_curves
from vrw_jax.branches.branch import Border, Branch
from vrw_jax.branches.continuation import continue_branch, continue_branches, continue_map
