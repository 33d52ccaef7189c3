"""Steps of batches with unilateral contact."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from vrw_jax.batches.walk_batch import START_NAME, StepBatchResult, WalkBatch
from vrw_jax.contact import embed_section_states, step_batch_with_jacobian, walk_batch
from vrw_jax.integrator import load_explicit_tableau
from vrw_jax.numerics import StepOptions
from vrw_jax.wheel import PARAMETER_NAMES

CONTACT_PARAMETERS = (*PARAMETER_NAMES, "friction")
CONTACT_STEP_INPUTS = (START_NAME, *CONTACT_PARAMETERS)
"""Inputs with respect to which a step can be differentiated."""


def step_batch_with_contact(
    model: Any,
    parameters: list[np.ndarray],
    states: np.ndarray,
    n_steps: int,
    options: StepOptions,
    engine: str,
    n_legs: int,
    derivative_names: Sequence[str],
) -> StepBatchResult:
    """Return `step_batch` with unilateral contact. Without derivatives, all steps of an element are
    one walk."""
    if engine not in ("auto", "lanes") or load_explicit_tableau(options.solver) is None:
        raise ValueError(
            f"engine is {engine!r} and solver {options.solver}, but batches with contact need "
            "'lanes' and an explicit Runge-Kutta solver: map vrw.return_map over the wheels."
        )
    friction = np.asarray(model.friction, states.dtype)
    columns = np.stack([np.broadcast_to(x, len(states)) for x in (*parameters, friction)])
    states = embed_section_states(columns, states, n_legs)
    zeros = np.zeros(len(states), np.int32)
    if not derivative_names:
        walk_result = walk_batch(columns, states, n_steps, model, options, n_legs)
        x, durations, outcome, n_stepped, n_solver_steps, _ = map(np.asarray, walk_result)
        results = x, durations, outcome, n_stepped, n_solver_steps, zeros > 0, zeros
        return StepBatchResult(*results, engine="lanes", solver_names=(options.solver,))
    walks = WalkBatch(states.T.copy(), derivative_names, CONTACT_PARAMETERS)
    for _ in range(n_steps):
        active = walks.active_lanes()
        if not len(active):
            break
        arguments = columns[:, active], walks.section_state[:, active].T, model, options, n_legs
        step_result, step_jacobian = step_batch_with_jacobian(*arguments, walks.input_indices)
        input_jacobian = np.concatenate([step_jacobian.section_state, step_jacobian.durations], 1)[
            :, :, list(walks.input_indices)
        ]
        step_values = (
            step_result.section_state,
            step_result.durations,
            step_result.outcome,
            step_result.solver_steps,
        )
        walks.record_step(
            active,
            tuple(np.asarray(x).T for x in (*step_values, input_jacobian)),
            zeros[active] > 0,
        )
    return walks.to_result(np.arange(len(states)), zeros, "lanes", (options.solver,))
