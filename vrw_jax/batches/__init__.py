"""Gait steps of many wheels at once, by the engine that suits."""

from vrw_jax.batches.batch import steps
from vrw_jax.batches.walked import Steps
