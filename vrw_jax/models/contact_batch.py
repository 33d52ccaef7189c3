"""Gait steps of batches with unilateral contact, by machine code."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from vrw_jax.base.options import StepOptions
from vrw_jax.flow.tableaus import load_explicit_tableau
from vrw_jax.models.contact_walks import embed_section_states, step_batch_with_jacobian, walk_batch
from vrw_jax.models.walk_batch import (
    StepBatchResult,
    StepwiseParameter,
    WalkBatch,
    complete_slopes_over_steps,
    compute_rises_over_steps,
    make_height_terms,
)
from vrw_jax.wheel.params import PARAMETER_NAMES

SLOPES_PARAMETER_NAMES = ("previous_friction", "tilt")
HEIGHTS_PARAMETER_NAMES = ("previous_friction", "rise", "next_rise")
"""Names of the additional parameters of a gait step on uneven ground.

The parameters are the friction of the feet that landed earlier, and the increase of the slope from
this line of the ground to the next one, rad, or two rises (see `models.select_stance_line`), m.
"""
SLOPE_INDEX = PARAMETER_NAMES.index("slope")


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

    Without derivatives on flat ground, one call of the kernel computes all gait steps.
    """
    element_friction = np.asarray(model.friction, section_states.dtype)
    is_ground_uneven = element_heights is not None or any(
        np.ndim(x) == 2 for x in (*values_by_parameter, element_friction)
    )
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
    stepwise_ground = _StepwiseGround.repeat_over_steps(
        values_by_parameter[SLOPE_INDEX],
        element_friction,
        len(section_states),
        n_steps,
        element_heights,
    )
    first_step_values = [*values_by_parameter, stepwise_ground.friction_by_step[0]]
    first_step_values[SLOPE_INDEX] = stepwise_ground.slopes_by_step[0]
    parameter_matrix = np.stack(
        [np.broadcast_to(x, len(section_states)) for x in first_step_values]
    )
    section_states = embed_section_states(parameter_matrix, section_states, n_legs)
    solver_indices = np.zeros(len(section_states), np.int32)
    has_equal_steps = not is_ground_uneven and model.leg_period == 1
    if not derivative_names and has_equal_steps:
        x, phase_durations, step_outcomes, n_stepped, n_solver_steps, _ = map(
            np.asarray,
            walk_batch(parameter_matrix, section_states, n_steps, model, options, n_legs),
        )
        return StepBatchResult(
            x,
            phase_durations,
            step_outcomes,
            n_stepped,
            n_solver_steps,
            solver_indices,
            "lanes",
            (options.solver,),
        )
    parameter_names = model.parameter_names
    stepwise_parameters: dict[str, StepwiseParameter] = {}
    if is_ground_uneven:
        ground_names = (
            SLOPES_PARAMETER_NAMES if element_heights is None else HEIGHTS_PARAMETER_NAMES
        )
        parameter_names = (*model.parameter_names, *ground_names)
        stepwise_parameters = stepwise_ground.make_stepwise_parameters(len(model.parameter_names))
    active_walks = WalkBatch(
        section_states.T.copy(), derivative_names, parameter_names, stepwise_parameters
    )
    input_indices = list(active_walks.input_indices)
    for k in range(n_steps):
        active_lanes = active_walks.find_walking_lanes()
        if not len(active_lanes):
            break
        if k > 0:
            model.exchange_legs(parameter_matrix)
        if is_ground_uneven:
            parameter_matrix = stepwise_ground.make_parameters_of_step(
                k, parameter_matrix[: len(model.parameter_names)]
            )
        parameters_of_lanes = parameter_matrix[:, active_lanes]
        start_states = active_walks.section_state[:, active_lanes].T
        step_outputs: tuple[Any, ...]
        if derivative_names:
            step_result, step_jacobian = step_batch_with_jacobian(
                parameters_of_lanes, start_states, model, options, n_legs, input_indices
            )
            output_jacobian = np.concatenate(
                [step_jacobian.section_state, step_jacobian.durations], 1
            )
            step_outputs = (
                step_result.section_state,
                step_result.durations,
                step_result.outcome,
                step_result.solver_steps,
                output_jacobian[:, :, input_indices],
            )
        else:
            x, phase_durations, step_outcomes, _, n_solver_steps, _ = walk_batch(
                parameters_of_lanes, start_states, 1, model, options, n_legs
            )
            step_outputs = x, phase_durations, step_outcomes, n_solver_steps
        active_walks.store_lane_steps(active_lanes, tuple(np.asarray(x).T for x in step_outputs))
    return active_walks.make_batch_result(
        np.arange(len(section_states)), solver_indices, "lanes", (options.solver,)
    )


class _StepwiseGround(NamedTuple):
    """Slope or rises, and friction of the ground in each gait step of each element."""

    slopes_by_step: np.ndarray  # (n_steps + 1, elements), rad
    friction_by_step: np.ndarray  # (n_steps, elements)
    n_stepwise_slopes: int | None  # per element; None if slopes do not vary over steps
    n_stepwise_frictions: int | None
    element_heights: np.ndarray | None  # see `step_batch`, m

    @classmethod
    def repeat_over_steps(
        cls,
        element_slopes: np.ndarray,
        element_friction: np.ndarray,
        n_elements: int,
        n_steps: int,
        element_heights: np.ndarray | None,
    ) -> "_StepwiseGround":
        """Return slope and friction for all gait steps, repeated over steps and over the batch
        where the argument has no such axis.
        """
        n_stepwise_slopes, n_stepwise_frictions = (
            x.shape[1] if x.ndim == 2 else None for x in (element_slopes, element_friction)
        )
        repeat_parameter_over_steps = lambda x, n_repetitions: (
            x if x.ndim == 2 else np.broadcast_to(x, (n_repetitions, n_elements)).T
        )
        slopes_by_step = complete_slopes_over_steps(
            repeat_parameter_over_steps(element_slopes, n_steps + 1), n_steps
        )
        return cls(
            slopes_by_step,
            repeat_parameter_over_steps(element_friction, n_steps).T[:n_steps],
            n_stepwise_slopes,
            n_stepwise_frictions,
            element_heights,
        )

    def make_parameters_of_step(self, k: int, parameter_matrix: np.ndarray) -> np.ndarray:
        """Return the parameters of gait step `k`, shape (parameters, elements).

        - `parameter_matrix`: parameters of wheels and laws, and friction.

        The last parameters are `SLOPES_PARAMETER_NAMES` or `HEIGHTS_PARAMETER_NAMES`.
        """
        parameter_matrix = parameter_matrix.copy()
        parameter_matrix[SLOPE_INDEX] = self.slopes_by_step[k]
        parameter_matrix[-1] = self.friction_by_step[k]
        previous_friction = self.friction_by_step[max(k - 1, 0)]
        if self.element_heights is not None:
            rises = compute_rises_over_steps(self.element_heights, len(self.friction_by_step))
            return np.vstack([parameter_matrix, previous_friction, *rises[k : k + 2]])
        tilt = self.slopes_by_step[k + 1] - self.slopes_by_step[k]
        return np.vstack([parameter_matrix, previous_friction, tilt])

    def make_stepwise_parameters(self, n_parameters: int) -> dict[str, StepwiseParameter]:
        """Return a mapping from parameter names to the terms by which the parameters enter the
        chain rule.

        The mapping contains "friction" and, if they vary over gait steps, "slope" or "heights".
        """
        previous_friction_input_index = n_parameters
        last_slope_index = (self.n_stepwise_slopes or 1) - 1
        last_friction_index = (self.n_stepwise_frictions or 1) - 1
        stepwise_friction = StepwiseParameter(
            (n_parameters - 1, previous_friction_input_index),
            self.n_stepwise_frictions,
            lambda k: (
                (0, min(k, last_friction_index), 1.0),
                (1, max(min(k, last_friction_index) - 1, 0), 1.0),
            ),
        )
        if self.element_heights is not None:
            stepwise_heights = make_height_terms(
                (previous_friction_input_index + 1, previous_friction_input_index + 2),
                self.element_heights.shape[1],
                len(self.friction_by_step),
            )
            return {"heights": stepwise_heights, "friction": stepwise_friction}
        if self.n_stepwise_slopes is None:
            return {"friction": stepwise_friction}
        stepwise_slope = StepwiseParameter(
            (SLOPE_INDEX, previous_friction_input_index + 1),
            self.n_stepwise_slopes,
            lambda k: ((0, k, 1.0), (1, k, -1.0), (1, min(k + 1, last_slope_index), 1.0)),
        )
        return {"slope": stepwise_slope, "friction": stepwise_friction}
