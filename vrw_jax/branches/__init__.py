"""Gaits along a parameter, with special points."""

from vrw_jax.branches.branch import Branch, SpecialPoint
