"""Gait steps of batches with unilateral contact, by machine code."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from vrw_jax.base.options import StepOptions
from vrw_jax.flow.tableaus import load_explicit_tableau
from vrw_jax.models.contact_walks import embed_section_states, step_batch_with_jacobian, walk_batch
from vrw_jax.models.walk_batch import (
    StepBatchResult,
    StepInput,
    WalkBatch,
    list_rises,
    make_step_input,
)
from vrw_jax.wheel.params import FRICTION_NAME, PARAMETER_NAMES


def step_batch_with_contact(
    model: Any,
    values_by_parameter: list[np.ndarray],
    section_states: np.ndarray,
    n_steps: int,
    options: StepOptions,
    requested_engine: str,
    n_legs: int,
    derivative_names: Sequence[str],
    element_heights: np.ndarray | None,
) -> StepBatchResult:
    """Return the result of `step_batch` for a model with unilateral contact.

    Without derivatives on flat ground, one call of the kernel computes all gait steps. On uneven
    ground, further inputs are the friction of the feet that landed earlier, and the increase of the
    slope to the next line of the ground, rad, or two rises (see `models.select_stance_line`), m.
    """
    friction = np.asarray(model.friction, section_states.dtype)
    if requested_engine not in ("auto", "lanes") or load_explicit_tableau(options.solver) is None:
        raise ValueError(
            f"engine is {requested_engine!r} and solver {options.solver}, but batches with contact "
            "need 'lanes' and an explicit Runge-Kutta solver: map vrw.walk over the wheels."
        )
    if np.ndim(model.restitution):
        raise ValueError(
            f"restitution has shape {np.shape(model.restitution)}, but a batch needs one number "
            "for all elements: call vrw.step_batch for each restitution."
        )
    slopes = values_by_parameter[PARAMETER_NAMES.index("slope")]
    make_input = lambda name, values, *offset: make_step_input(
        name, values, n_steps, len(section_states), *offset
    )
    inputs = [*map(make_input, model.parameter_names, [*values_by_parameter, friction])]
    first_values = np.stack([x.select_values(0) for x in inputs])
    section_states = embed_section_states(first_values, section_states, n_legs)
    is_ground_uneven = element_heights is not None or slopes.ndim == 2 or friction.ndim == 2
    if not (derivative_names or is_ground_uneven or model.leg_period > 1):
        x, durations, outcome, n_stepped, solver_steps, _ = map(
            np.asarray, walk_batch(first_values, section_states, n_steps, model, options, n_legs)
        )
        solver_index = np.zeros_like(n_stepped)
        return StepBatchResult(
            x, durations, outcome, n_stepped, solver_steps, solver_index, "lanes", (options.solver,)
        )
    if is_ground_uneven:
        inputs.append(make_input(FRICTION_NAME, friction, -1))
        if element_heights is not None:
            inputs += list_rises(element_heights, n_steps)
        else:
            inputs.append(_make_tilt(inputs[PARAMETER_NAMES.index("slope")], slopes, n_steps))
    batch = WalkBatch(section_states.T.copy(), inputs, derivative_names)
    input_indices = list(batch.input_indices)

    def step_lanes(_: Any, inputs: np.ndarray, x: np.ndarray, k: int) -> tuple[np.ndarray, ...]:
        if not derivative_names:
            x, durations, outcome, _, solver_steps, _ = walk_batch(
                inputs, x.T, 1, model, options, n_legs
            )
            outputs: tuple[Any, ...] = x, durations, outcome, solver_steps
        else:
            step, jacobian = step_batch_with_jacobian(
                inputs, x.T, model, options, n_legs, input_indices
            )
            columns = np.concatenate([jacobian.section_state, jacobian.durations], 1)
            outputs = step.section_state, step.durations, step.outcome, step.solver_steps
            outputs += (columns[:, :, input_indices],)
        return tuple(np.asarray(x).T for x in outputs)

    batch.take_steps(n_steps, step_lanes, model)
    return batch.make_batch_result("lanes", (options.solver,))


def _make_tilt(slope: StepInput, slopes: np.ndarray, n_steps: int) -> StepInput:
    """Return the increase of the slope from the line of each step to the next one, rad."""
    if slopes.ndim < 2:
        return StepInput("", np.zeros_like(slope.values))
    next_slope = make_step_input("slope", slopes, n_steps, slopes.shape[0], 1)
    return next_slope._replace(
        values=next_slope.values - slope.values,
        list_terms=lambda k: [(k, -1.0), *next_slope.list_terms(k)],
    )
