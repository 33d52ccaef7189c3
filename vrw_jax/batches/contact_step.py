"""Steps of batches with unilateral contact.

Machine code takes the steps. On uneven ground, `walk` under `jax.vmap` takes them if restitution is
given or the engine is diffrax.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
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
from vrw_jax.numerics import StepOptions, batch_sizes, map_in_numpy_batches
from vrw_jax.simulation import walk
from vrw_jax.wheel import PARAMETER_NAMES, wheel_from_parameters

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
    if is_uneven and (engine == "diffrax" or model.restitution is not None):
        return _walk_with_diffrax(
            model, parameters, states, n_steps, options, engine, n_legs, derivative_names
        )
    if engine not in ("auto", "lanes") or load_explicit_tableau(options.solver) is None:
        raise ValueError(
            f"engine is {engine!r} and solver {options.solver}, but batches with contact need "
            "'lanes' and an explicit Runge-Kutta solver: map vrw.return_map over the wheels."
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


def _walk_with_diffrax(
    model: Any,
    parameters: list[np.ndarray],
    states: np.ndarray,
    n_steps: int,
    options: StepOptions,
    engine: str,
    n_legs: int,
    derivative_names: Sequence[str],
) -> StepBatchResult:
    """Return the result of `step_batch` on uneven ground by `walk` under `jax.vmap`, without
    derivatives.
    """
    if engine not in ("auto", "diffrax") or len(derivative_names):
        raise ValueError(
            "uneven ground with restitution, or by engine 'diffrax', is available without "
            "derivatives: leave engine and derivatives out, or map vrw.walk over the elements."
        )
    n_states = len(states)
    parameter_columns = (*parameters, np.asarray(model.friction, states.dtype))
    full_columns = [np.broadcast_to(x, (n_states, *x.shape[1:])) for x in parameter_columns]
    walk_elements = lambda x, *full_columns: _vmapped_walk(
        model, options, n_legs, n_steps, x, full_columns
    )
    x, durations, outcome, n_stepped, n_solver_steps = map_in_numpy_batches(
        walk_elements, batch_sizes.UNEVEN_GROUND_BATCH_SIZES, states, *full_columns
    )
    int_zeros = np.zeros(n_states, np.int32)
    result_arrays = x, durations, outcome, n_stepped, n_solver_steps, int_zeros > 0, int_zeros
    return StepBatchResult(*result_arrays, engine="diffrax", solver_names=(options.solver,))


@eqx.filter_jit
def _vmapped_walk(
    model: Any, options: StepOptions, n_legs: int, n_steps: int, states: Any, input_columns: Any
) -> tuple:
    """Return the last step of a walk from each state, with outcome and counts."""

    def walk_one(x: Any, input_columns: Any) -> tuple:
        *parameter_values, friction = input_columns
        model_with_friction = eqx.tree_at(lambda model: model.friction, model, friction)
        params = wheel_from_parameters(tuple(parameter_values), n_legs)
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
    return jax.tree.map(narrow_integers, jax.vmap(walk_one)(states, input_columns))
