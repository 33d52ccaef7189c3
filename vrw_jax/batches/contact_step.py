"""Steps of batches with unilateral contact, by machine code."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from vrw_jax.batches.walk_batch import (
    START_NAME,
    StepBatchResult,
    StepwiseParameter,
    WalkBatch,
    complete_batch_slopes,
)
from vrw_jax.contact import embed_section_states, step_batch_with_jacobian, walk_batch
from vrw_jax.integrator import load_explicit_tableau
from vrw_jax.numerics import StepOptions
from vrw_jax.wheel import PARAMETER_NAMES

CONTACT_PARAMETERS = (*PARAMETER_NAMES, "friction")
UNEVEN_GROUND_PARAMETERS = ("previous_friction", "tilt")
"""Parameters that uneven ground adds: friction of the feet that landed earlier, and the angle by
which the next line is steeper, rad."""
SLOPE_INDEX = CONTACT_PARAMETERS.index("slope")
FRICTION_INDEX = CONTACT_PARAMETERS.index("friction")
CONTACT_STEP_INPUTS = (START_NAME, *CONTACT_PARAMETERS)
"""Inputs of a step with respect to which derivatives are available."""


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
    """Return the result of `step_batch` with unilateral contact.

    Without derivatives, all steps of an element on flat ground are one walk of the kernel.
    """
    friction = np.asarray(model.friction, states.dtype)
    is_uneven = any(np.ndim(x) == 2 for x in (*parameters, friction))
    if engine not in ("auto", "lanes") or load_explicit_tableau(options.solver) is None:
        raise ValueError(
            f"engine is {engine!r} and solver {options.solver}, but batches with contact need "
            "'lanes' and an explicit Runge-Kutta solver: map vrw.walk over the wheels."
        )
    if np.ndim(model.restitution):
        raise ValueError(
            f"restitution has shape {np.shape(model.restitution)}, but a batch needs one number "
            "for all elements: call vrw.step_batch for each restitution."
        )
    ground = _GroundBySteps.from_arrays(parameters[SLOPE_INDEX], friction, len(states), n_steps)
    parameters = [ground.slopes[0] if i == SLOPE_INDEX else x for i, x in enumerate(parameters)]
    input_columns = np.stack(
        [np.broadcast_to(x, len(states)) for x in (*parameters, ground.friction[0])]
    )
    states = embed_section_states(input_columns, states, n_legs)
    int_zeros = np.zeros(len(states), np.int32)
    if not derivative_names and not is_uneven:
        walk_result = walk_batch(input_columns, states, n_steps, model, options, n_legs)
        x, durations, outcome, n_stepped, n_solver_steps, _ = map(np.asarray, walk_result)
        result_arrays = x, durations, outcome, n_stepped, n_solver_steps, int_zeros > 0, int_zeros
        return StepBatchResult(*result_arrays, engine="lanes", solver_names=(options.solver,))
    parameter_names: tuple[str, ...] = CONTACT_PARAMETERS
    stepwise_parameters: dict[str, StepwiseParameter] = {}
    if is_uneven:
        parameter_names = (*CONTACT_PARAMETERS, *UNEVEN_GROUND_PARAMETERS)
        stepwise_parameters = ground.stepwise_parameters()
    walks = WalkBatch(states.T.copy(), derivative_names, parameter_names, stepwise_parameters)
    for k in range(n_steps):
        active_lanes = walks.active_lanes()
        if not len(active_lanes):
            break
        input_columns = ground.parameters_of_step(k, input_columns) if is_uneven else input_columns
        step_arguments = (
            input_columns[:, active_lanes],
            walks.section_state[:, active_lanes].T,
            model,
            options,
            n_legs,
        )
        if not derivative_names:
            walk_result = walk_batch(step_arguments[0], step_arguments[1], 1, *step_arguments[2:])
            x, durations, outcome, _, n_solver_steps, _ = map(np.asarray, walk_result)
            walks.record_step(
                active_lanes,
                (x.T, durations.T, outcome, n_solver_steps),
                int_zeros[active_lanes] > 0,
            )
            continue
        step_result, step_jacobian = step_batch_with_jacobian(*step_arguments, walks.input_indices)
        full_jacobian = np.concatenate([step_jacobian.section_state, step_jacobian.durations], 1)
        input_jacobian = full_jacobian[:, :, list(walks.input_indices)]
        step_values = (
            step_result.section_state,
            step_result.durations,
            step_result.outcome,
            step_result.solver_steps,
        )
        walks.record_step(
            active_lanes,
            tuple(np.asarray(x).T for x in (*step_values, input_jacobian)),
            int_zeros[active_lanes] > 0,
        )
    return walks.to_result(np.arange(len(states)), int_zeros, "lanes", (options.solver,))


class _GroundBySteps(NamedTuple):
    """Slope and friction of the ground of each step."""

    slopes: np.ndarray  # (n_steps + 1, elements), rad
    friction: np.ndarray  # (n_steps, elements)
    n_slopes: int | None  # number of given slopes of an element; None without steps
    n_frictions: int | None

    @classmethod
    def from_arrays(
        cls, slope: np.ndarray, friction: np.ndarray, n_elements: int, n_steps: int
    ) -> "_GroundBySteps":
        """Return the ground, with scalars and arrays over the batch repeated for each step."""
        n_given_by_quantity = (x.shape[1] if x.ndim == 2 else None for x in (slope, friction))

        def expand_over_steps(x: np.ndarray, n_rows: int) -> np.ndarray:
            return x if x.ndim == 2 else np.tile(np.broadcast_to(x, n_elements), (n_rows, 1)).T

        slopes = complete_batch_slopes(expand_over_steps(slope, n_steps + 1), n_steps)
        return cls(slopes, expand_over_steps(friction, n_steps).T[:n_steps], *n_given_by_quantity)

    def parameters_of_step(self, k: int, input_columns: np.ndarray) -> np.ndarray:
        """Return the parameters of step k, with those of `UNEVEN_GROUND_PARAMETERS`, (parameters,
        elements).
        """
        input_columns = np.concatenate(
            [input_columns[: len(CONTACT_PARAMETERS)], np.empty((2, input_columns.shape[1]))]
        )
        input_columns[SLOPE_INDEX], input_columns[FRICTION_INDEX] = self.slopes[k], self.friction[k]
        input_columns[-2:] = self.friction[max(k - 1, 0)], self.slopes[k + 1] - self.slopes[k]
        return input_columns

    def stepwise_parameters(self) -> dict[str, StepwiseParameter]:
        """Return the roles of slopes and friction in the steps, by name."""
        previous_friction_index = len(CONTACT_PARAMETERS)
        tilt_index = previous_friction_index + 1
        n_slopes, n_frictions = self.n_slopes, self.n_frictions

        def slope_terms(k: int) -> tuple[tuple[int, int, float], ...]:
            return (0, k, 1.0), (1, k, -1.0), (1, min(k + 1, (n_slopes or 1) - 1), 1.0)

        def friction_terms(k: int) -> tuple[tuple[int, int, float], ...]:
            if n_frictions is None:
                return (0, 0, 1.0), (1, 0, 1.0)
            return (0, k, 1.0), (1, max(k - 1, 0), 1.0)

        friction = StepwiseParameter(
            (FRICTION_INDEX, previous_friction_index), n_frictions, friction_terms
        )
        if n_slopes is None:
            return {"friction": friction}
        slope = StepwiseParameter((SLOPE_INDEX, tilt_index), n_slopes, slope_terms)
        return {"slope": slope, "friction": friction}
