"""Gaits that walks reach: the search with finer meshes and walks as fallbacks."""

from vrw_jax.gaits.reaching import SHAPES, Which, limit_cycle, limit_cycles, place_in_list, reached
