"""Gait steps of many wheels at once, by the engine that suits."""

from vrw_jax.batches.batch import Steps, steps
from vrw_jax.batches.ground import as_full_states, walk_lanes
