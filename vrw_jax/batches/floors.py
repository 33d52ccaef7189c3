"""Walks of batches over ground that differs from step to step: `walk` under `jax.vmap`."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from vrw_jax.batches.walked import Steps
from vrw_jax.numerics import Options, in_batches_of_numpy
from vrw_jax.walks import walk
from vrw_jax.wheel import FRICTION, PARAMETER_NAMES, WheelParams, wheel_of

SIZES = 16, 256
"""Lanes at a time."""


def floors_of(params: WheelParams, model: Any) -> dict[str, Any]:
    """Slope and friction, if either differs from step to step."""
    ground = {"slope": params.slope, FRICTION: getattr(model, FRICTION, 0.0)}
    return ground if any(np.ndim(x) == 2 for x in ground.values()) else {}


def over_floors(
    params: WheelParams,
    states: np.ndarray,
    n_steps: int,
    model: Any,
    options: Options,
    engine: str,
    asked: Sequence[str],
) -> Steps:
    """See `steps`."""
    n = len(states)
    if model.lanes != "legs" or engine not in ("auto", "diffrax") or len(asked):
        raise ValueError(
            "ground that differs from step to step is walked by vrw.UnilateralWheel and 'diffrax', "
            "without derivatives: leave engine and derivatives out, or map vrw.walk over lanes."
        )
    given = *(getattr(params, name) for name in PARAMETER_NAMES), model.friction
    for name, x in zip((*PARAMETER_NAMES, FRICTION), given, strict=True):
        over = ((n, n_steps),) if name in ("slope", FRICTION) else ()
        if np.shape(x) not in ((), (n,), *over):
            raise ValueError(
                f"{name} has shape {np.shape(x)}, but there are {n} states and {n_steps} steps: "
                f"give one value, one for each lane{', or its row over the steps' * len(over)}."
            )
    columns = [np.broadcast_to(x, (n, *np.shape(x)[1:])) for x in given]
    walked = lambda x, *columns: _mapped(model, options, params.n_legs, n_steps, x, columns)
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
