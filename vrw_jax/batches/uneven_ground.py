"""Walks of batches over uneven ground, which changes from step to step: `walk` under `jax.vmap`."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from vrw_jax.batches.walk_batch import StepBatchResult
from vrw_jax.numerics import StepOptions, map_in_numpy_batches
from vrw_jax.simulation import walk
from vrw_jax.wheel import wheel_from_parameters

UNEVEN_GROUND_BATCH_SIZES = 16, 256
"""Numbers of batch elements that are compiled for."""


def walk_uneven_ground(
    model: Any,
    parameters: list[np.ndarray],
    states: np.ndarray,
    n_steps: int,
    options: StepOptions,
    engine: str,
    n_legs: int,
    derivative_names: Sequence[str],
) -> StepBatchResult:
    """Return `step_batch` for slopes or friction that differ from step to step."""
    if model.batch_kernel != "legs" or engine not in ("auto", "diffrax") or len(derivative_names):
        raise ValueError(
            "uneven ground needs vrw.UnilateralWheel and 'diffrax', "
            "without derivatives: leave engine and derivatives out, or map vrw.walk over lanes."
        )
    n_states, parameter_columns = (
        len(states),
        (*parameters, np.asarray(model.friction, states.dtype)),
    )
    full_columns = [np.broadcast_to(x, (n_states, *x.shape[1:])) for x in parameter_columns]
    walk_rows = lambda x, *full_columns: _vmapped_walk(
        model, options, n_legs, n_steps, x, full_columns
    )
    x, durations, outcome, n_stepped, n_solver_steps = map_in_numpy_batches(
        walk_rows, UNEVEN_GROUND_BATCH_SIZES, states, *full_columns
    )
    zeros = np.zeros(n_states, np.int32)
    results = x, durations, outcome, n_stepped, n_solver_steps, zeros > 0, zeros
    return StepBatchResult(*results, engine="diffrax", solver_names=(options.solver,))


@eqx.filter_jit
def _vmapped_walk(
    model: Any, options: StepOptions, n_legs: int, n_steps: int, states: Any, columns: Any
) -> tuple:
    def walk_one(x: Any, columns: Any) -> tuple:
        *values, friction = columns
        model_with_friction = eqx.tree_at(lambda model: model.friction, model, friction)
        params = wheel_from_parameters(tuple(values), n_legs)
        walk_result = walk(
            params, x, n_steps, model=model_with_friction, options=options, engine="diffrax"
        )
        last_step = jax.tree.map(
            lambda x: x[jnp.minimum(walk_result.n_stepped, n_steps - 1)], walk_result.steps
        )
        n_solver_steps = jnp.sum(walk_result.steps.solver_steps)
        return (
            last_step.section_state,
            last_step.durations,
            walk_result.outcome,
            walk_result.n_stepped,
            n_solver_steps,
        )

    narrow_integers = lambda x: x.astype(jnp.int32) if jnp.issubdtype(x.dtype, jnp.integer) else x
    return jax.tree.map(narrow_integers, jax.vmap(walk_one)(states, columns))
