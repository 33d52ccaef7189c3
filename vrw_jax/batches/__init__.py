"""Gait steps of many wheels, computed in one call by one of several engines."""

from vrw_jax.batches import batch_steps
from vrw_jax.batches.batch_steps import step_batch
from vrw_jax.batches.stiffness import SolverIndex, select_cheapest_solver
from vrw_jax.batches.walk_batch import StepBatchResult
