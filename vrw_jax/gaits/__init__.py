"""Gaits that walks reach: the search with finer meshes and walks as fallbacks."""

from vrw_jax.gaits.reaching import (
    GAIT_BATCH_SIZES,
    GaitChoice,
    limit_cycle,
    limit_cycles,
    parse_gait_choice,
    retry_from_walks,
)
