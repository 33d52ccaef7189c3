"""Gaits that walks reach: the search, and where it fails finer meshes and walks."""

from vrw_jax.gaits.reaching import SHAPES, Which, limit_cycle, limit_cycles, place_in_list, reached
