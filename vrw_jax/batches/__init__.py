"""Gait steps of many wheels at once, with a choice of engines."""

from vrw_jax.batches.batch import steps
from vrw_jax.batches.walked import Steps
