"""Gaits that walks reach: the search, and where it fails finer meshes and walks."""

from vrw_jax.gaits.attracting import starts_of
from vrw_jax.gaits.reaching import SHAPES, limit_cycle, limit_cycles
