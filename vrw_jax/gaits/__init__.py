"""Gaits that walks reach: the search, and where it fails finer meshes and walks."""

from vrw_jax.gaits.reaching import limit_cycle, limit_cycles
