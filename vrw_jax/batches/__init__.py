"""Gait steps of many wheels at once, with a choice of engines."""

from vrw_jax.batches.batch import step_batch
from vrw_jax.batches.walked import StepBatchResult
