"""Walks of batches over uneven ground, which changes from step to step: `walk` under `jax.vmap`."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from vrw_jax.batches.walked import Steps
from vrw_jax.numerics import Options, in_batches_of_numpy
from vrw_jax.walks import walk
from vrw_jax.wheel import wheel_of

SIZES = 16, 256
"""Numbers of batch elements that are compiled for."""


def over_floors(
    model: Any,
    wheels: list[np.ndarray],
    states: np.ndarray,
    n_steps: int,
    options: Options,
    engine: str,
    n_legs: int,
    asked: Sequence[str],
) -> Steps:
    """Return `step_batch` for slopes or friction that differ from step to step."""
    if model.lanes != "legs" or engine not in ("auto", "diffrax") or len(asked):
        raise ValueError(
            "uneven ground needs vrw.UnilateralWheel and 'diffrax', "
            "without derivatives: leave engine and derivatives out, or map vrw.walk over lanes."
        )
    n, given = len(states), (*wheels, np.asarray(model.friction, states.dtype))
    columns = [np.broadcast_to(x, (n, *x.shape[1:])) for x in given]
    walked = lambda x, *columns: _mapped(model, options, n_legs, n_steps, x, columns)
    x, durations, outcome, n_stepped, tried = in_batches_of_numpy(walked, SIZES, states, *columns)
    none = np.zeros(n, np.int32)
    told = x, durations, outcome, n_stepped, tried, none > 0, none
    return Steps(*told, engine="diffrax", solvers=(options.solver,))


@eqx.filter_jit
def _mapped(
    model: Any, options: Options, n_legs: int, n_steps: int, states: Any, columns: Any
) -> tuple:
    def one(x: Any, columns: Any) -> tuple:
        *numbers, friction = columns
        ground = eqx.tree_at(lambda model: model.friction, model, friction)
        params = wheel_of(tuple(numbers), n_legs)
        told = walk(params, x, n_steps, model=ground, options=options, engine="diffrax")
        last = jax.tree.map(lambda x: x[jnp.minimum(told.n_stepped, n_steps - 1)], told.steps)
        tried = jnp.sum(told.steps.solver_steps)
        return last.section_state, last.durations, told.outcome, told.n_stepped, tried

    codes = lambda x: x.astype(jnp.int32) if jnp.issubdtype(x.dtype, jnp.integer) else x
    return jax.tree.map(codes, jax.vmap(one)(states, columns))
