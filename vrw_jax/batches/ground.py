"""Steps of batches with unilateral contact."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from vrw_jax.batches.walked import START, Steps, Walked
from vrw_jax.models import as_full_states, step_lanes, walk_lanes
from vrw_jax.numerics import Options, explicit_tableau
from vrw_jax.wheel import PARAMETER_NAMES

VALUES = (*PARAMETER_NAMES, "friction")
ON_GROUND = (START, *VALUES)
"""Inputs with respect to which a step can be differentiated."""


def on_ground(
    model: Any,
    wheels: list[np.ndarray],
    states: np.ndarray,
    n_steps: int,
    options: Options,
    engine: str,
    n_legs: int,
    asked: Sequence[str],
) -> Steps:
    """Return `step_batch` with unilateral contact. Without derivatives, all steps of an element are
    one walk."""
    if engine not in ("auto", "lanes") or explicit_tableau(options.solver) is None:
        raise ValueError(
            f"engine is {engine!r} and solver {options.solver}, but batches with contact need "
            "'lanes' and an explicit Runge-Kutta solver: map vrw.return_map over the wheels."
        )
    friction = np.asarray(model.friction, states.dtype)
    columns = np.stack([np.broadcast_to(x, len(states)) for x in (*wheels, friction)])
    states = as_full_states(columns, states, n_legs)
    none = np.zeros(len(states), np.int32)
    if not asked:
        walk = walk_lanes(columns, states, n_steps, model, options, n_legs)
        x, durations, outcome, n_stepped, tried, _ = map(np.asarray, walk)
        told = x, durations, outcome, n_stepped, tried, none > 0, none
        return Steps(*told, engine="lanes", solvers=(options.solver,))
    walked = Walked(states.T.copy(), asked, VALUES)
    for _ in range(n_steps):
        lanes = walked.on()
        if not len(lanes):
            break
        given = columns[:, lanes], walked.section_state[:, lanes].T, model, options, n_legs
        step, moves = step_lanes(*given, walked.moved)
        by = np.concatenate([moves.section_state, moves.durations], 1)[:, :, list(walked.moved)]
        values = step.section_state, step.durations, step.outcome, step.solver_steps
        walked.take(lanes, tuple(np.asarray(x).T for x in (*values, by)), none[lanes] > 0)
    return walked.told(np.arange(len(states)), none, "lanes", (options.solver,))
