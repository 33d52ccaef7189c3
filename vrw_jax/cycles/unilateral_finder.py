"""Find gaits with unilateral contact by Newton's method on batches of gait steps.

The machine code for a gait step also computes its tangents. Many wheels are therefore searched
together, and no large program is compiled for the derivatives.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from vrw_jax.contact import UnilateralWheel, step_batch_with_jacobian
from vrw_jax.continuation import FixedPointResult
from vrw_jax.cycles.attracting_gaits import find_slow_gaits
from vrw_jax.cycles.cycle import AbstractCycle
from vrw_jax.cycles.finder import (
    Gait,
    GaitMeasures,
    ParameterValues,
    compute_gait_measures,
    move_derivative_axis_first,
)
from vrw_jax.cycles.gait_walks import stack_section_units
from vrw_jax.cycles.return_map_finder import (
    AbstractReturnMapFinder,
    ReturnMapCycle,
    compute_newton_tolerance,
    find_return_map_cycle,
    make_return_map_cycle,
    make_return_map_gait,
    prepare_search,
    summarize_cycle_steps,
)
from vrw_jax.measures import FORCE_PEAK_MEASURES, UNILATERAL_DIFFERENTIABLE_NAMES
from vrw_jax.models import AbstractStep, AbstractWheel
from vrw_jax.numerics import StepOptions, batch_sizes, map_in_batches, select_tree_rows
from vrw_jax.simulation import convert_step_arguments
from vrw_jax.validation import has_traced_leaf
from vrw_jax.wheel import Outcome, WheelParams


@dataclass(frozen=True)
class ContactNewtonOptions:
    """Numerical options of Newton's method on the return map with unilateral contact."""

    max_iterations: int = 15
    """Largest number of Newton iterations."""
    max_correction_halvings: int = 6
    """Largest number of times that a correction is halved if no gait step completes after it."""
    step_tolerance_far_from_gait: float = 1e-6
    """Tolerance of gait steps that start far from a gait."""
    max_correction_near_gait: float = 1e-4
    """Correction below which a state is treated as near a gait, rad, rad/s, m/s."""
    clear_convergence_fraction: float = 0.01
    """Fraction of the tolerance below which one correction suffices for convergence."""


CONTACT_NEWTON_OPTIONS = ContactNewtonOptions()


class UnilateralFinder(AbstractReturnMapFinder):
    """Finder of gaits with unilateral contact and their first derivatives.

    The derivatives are with respect to all parameters, including friction.
    """

    model: UnilateralWheel
    gait_batch_sizes: tuple[int, ...] = eqx.field(
        static=True, default=batch_sizes.CONTACT_GAIT_BATCH_SIZES
    )

    cycle_measures: ClassVar[tuple[str, ...]] = (
        "spectral_radius",
        "spectral_margin",
        *FORCE_PEAK_MEASURES,
    )
    differentiable_measures: ClassVar[tuple[str, ...]] = (
        *UNILATERAL_DIFFERENTIABLE_NAMES,
        *FORCE_PEAK_MEASURES,
    )
    default_measures: ClassVar[tuple[str, ...]] = UNILATERAL_DIFFERENTIABLE_NAMES
    readable_measures: ClassVar[tuple[str, ...]] = differentiable_measures
    is_multistable: ClassVar[bool] = True

    def find_cycle(self, params: WheelParams, cycle_guess: Any = None) -> ReturnMapCycle:
        """Find the cycle of one wheel.

        If all inputs are concrete, the batched engine computes the gait steps. If an input is
        traced, the cycle has derivatives by the implicit function theorem, computed from a single
        gait step.
        """
        params, section_state, model, options = prepare_search(self, params, cycle_guess)
        if has_traced_leaf(params, section_state, model):
            return find_return_map_cycle(
                params, section_state, model, options, self.period_n, uses_implicit_jvp=True
            )
        return jax.tree.map(
            lambda section_state: section_state[0],
            self.find_cycles_near(
                model.collect_parameter_values(params)[None], section_state[None]
            ),
        )

    def find_cycles(self, params: WheelParams, cycle_guess: Any = None) -> Any:
        if has_traced_leaf(params, cycle_guess):
            return eqx.filter_vmap(self.find_cycle)(params, cycle_guess)
        parameter_values = jax.vmap(self.model.collect_parameter_values)(params)
        section_states = getattr(cycle_guess, "section_state", cycle_guess)
        if section_states is None:
            section_states = jax.vmap(self.model.compute_default_start)(params)
        else:
            section_states = jax.vmap(self.model.complete_section_state)(
                params, jnp.asarray(section_states)
            )
        return self.find_cycles_near(parameter_values, section_states)

    def find_cycles_near(self, parameter_values: Any, section_states: Any) -> ReturnMapCycle:
        """Find one gait for each wheel near the given section states, without derivatives."""
        return self._solve_and_evaluate(
            _make_contact_cycle, parameter_values, section_states, needs_parameter_derivatives=False
        )

    def precompile_newton_programs(self, parameter_values: np.ndarray) -> None:
        """Compile the programs of Newton's method while another thread computes walks toward its
        start.
        """
        n_section_entries = self.model.count_section_entries(WheelParams(n_legs=self.n_legs))
        period_map = PeriodMap(self.model, self.n_legs, self.period_n, parameter_values)
        section_states = np.zeros((len(parameter_values), n_section_entries))
        period_map.evaluate_period(self.step_options, section_states, False)

    def make_initial_guess(self, parameter_values: ParameterValues) -> Array:
        return _remove_batch_axis(self.make_initial_guesses(_add_batch_axis(parameter_values)))

    def make_initial_guesses(self, parameter_values: Array) -> Array:
        """Return the section state of a slow attracting gait for each wheel, or NaN if
        there is none.
        """
        slow_gaits = find_slow_gaits(self, parameter_values)
        is_gait_found = np.asarray(slow_gaits.outcome) == Outcome.STEPPED
        return jax.device_put(np.where(is_gait_found[:, None], slow_gaits.section_state, np.nan))

    def find_gait(self, parameter_values: ParameterValues, cycle_guess: Array) -> Gait:
        return _remove_batch_axis(
            self.find_gaits(_add_batch_axis(parameter_values), _add_batch_axis(cycle_guess))
        )

    def find_gaits(self, parameter_values: Array, cycle_guess: Any) -> Gait:
        return self._solve_and_evaluate(
            _make_contact_gait,
            parameter_values,
            getattr(cycle_guess, "section_state", cycle_guess),
            needs_parameter_derivatives=True,
        )

    def _solve_and_evaluate(
        self,
        evaluate_fixed_point: Callable,
        parameter_values: Any,
        section_states: Any,
        needs_parameter_derivatives: bool,
    ) -> Any:
        """Find the fixed point of the return map for each wheel, and evaluate a function of it.

        - `evaluate_fixed_point`: function of a wheel's parameters and fixed point;
        - `section_states`: starts of Newton's method;
        - `needs_parameter_derivatives`: whether the steps are differentiated with respect to
          parameters.
        """
        newton_search_inputs = (
            np.asarray(parameter_values),
            np.asarray(section_states),
            needs_parameter_derivatives,
        )
        fixed_points = find_contact_fixed_points(
            self.model, self.n_legs, self.step_options, self.period_n, *newton_search_inputs
        )
        evaluate_wheel_batch = functools.partial(
            _evaluate_over_wheels, evaluate_fixed_point, self.model, self.n_legs
        )
        return map_in_batches(
            evaluate_wheel_batch, self.gait_batch_sizes, newton_search_inputs[0], fixed_points
        )

    def take_gait_step(self, params: WheelParams, section_state: Array) -> AbstractStep:
        parameter_value_columns, model = (
            np.asarray(self.model.collect_parameter_values(params))[:, None],
            self.model,
        )
        step_arguments = (
            parameter_value_columns,
            np.asarray(section_state)[None],
            model,
            self.step_options,
            self.n_legs,
        )
        return _remove_batch_axis(step_batch_with_jacobian(*step_arguments, ())[0])

    def measure_gait(
        self, parameter_values: ParameterValues, cycle_guess: Any, measure_names: tuple[str, ...]
    ) -> GaitMeasures:
        """Return measures of a gait and their derivatives, computed from one Jacobian of the gait
        step.
        """
        model, params = self.model.from_parameter_values(
            tuple(jax.device_put(list(np.asarray(parameter_values)))), self.n_legs
        )
        start_state = (
            cycle_guess.section_state if isinstance(cycle_guess, AbstractCycle) else cycle_guess
        )
        start_state = (
            self.make_initial_guess(parameter_values) if start_state is None else start_state
        )
        _, section_state, _, _ = convert_step_arguments(
            params, start_state, model, self.step_options
        )
        return compute_gait_measures(
            self.find_gait(parameter_values, section_state), type(self).read_measure, measure_names
        )


def _add_batch_axis(x: Array) -> Array:
    """Return the array with a batch axis of length one.

    NumPy adds the axis, because JAX would compile a program for each shape.
    """
    return jax.device_put(np.asarray(x)[None])


def _remove_batch_axis(batched_tree: Any) -> Any:
    """Return the first element of every array, which inverts `_add_batch_axis`."""
    return jax.device_put(select_tree_rows(batched_tree, 0))


class _ContactFixedPoints(NamedTuple):
    """Fixed points of the return maps of many wheels. The fields have a leading axis over the
    wheels.
    """

    fixed_section_states: Any
    gait_steps_of_period: Any  # gait steps from the fixed point, (period_n, ...)
    step_jacobians: Any  # with respect to parameter values and section state
    newton_residuals: Any
    is_gait_found: Any
    n_newton_iterations: Any


class PeriodMap(NamedTuple):
    """Map that advances the section states of many wheels by one period.

    The map uses the batched engine outside `jax.jit`.
    """

    model: Any
    n_legs: int
    period_n: int
    parameter_values: np.ndarray  # (wheels, n_parameter_values)

    @property
    def section_units_by_wheel(self) -> np.ndarray:
        """Return the units of the section state of each wheel, shape (wheels, section)."""
        return stack_section_units(self.model, self.parameter_values, self.n_legs)

    def select_wheels(self, wheel_indices: np.ndarray) -> "PeriodMap":
        """Return the map for the wheels with the indices `wheel_indices`."""
        return self._replace(parameter_values=self.parameter_values[wheel_indices])

    def evaluate_period(
        self,
        step_options: StepOptions,
        section_states: np.ndarray,
        is_value_differentiated: Any = True,
        is_start_differentiated: bool = True,
    ) -> "PeriodEvaluation":
        """Compute the gait steps of one period from the given section states, and their
        derivatives.

        The derivatives are with respect to the selected parameter values and to the section states.
        """
        steps_and_jacobians, (n_parameter_values, n_section_entries) = (
            [],
            (self.parameter_values.shape[1], section_states.shape[1]),
        )
        period_jacobian = np.concatenate(
            [np.zeros((n_section_entries, n_parameter_values)), np.eye(n_section_entries)], 1
        )[None]
        is_period_complete = np.ones(len(section_states), bool)
        is_input_differentiated = np.concatenate(
            [
                np.broadcast_to(is_value_differentiated, n_parameter_values),
                np.broadcast_to(is_start_differentiated, n_section_entries),
            ]
        )
        input_indices = np.flatnonzero(is_input_differentiated).tolist()
        for _ in range(self.period_n):
            step_arguments = (
                self.parameter_values.T,
                section_states,
                self.model,
                step_options,
                self.n_legs,
                input_indices,
            )
            steps_and_jacobians.append(step_batch_with_jacobian(*step_arguments))
            step_result, step_result_jacobians = steps_and_jacobians[-1]
            is_period_complete &= np.asarray(step_result.outcome) == Outcome.STEPPED
            section_states = np.asarray(step_result.section_state)
            step_jacobian = np.asarray(step_result_jacobians.section_state)
            period_jacobian = step_jacobian[:, :, n_parameter_values:] @ period_jacobian
            period_jacobian[:, :, :n_parameter_values] += step_jacobian[:, :, :n_parameter_values]
        gait_steps_of_period, stacked_jacobians = (
            jax.tree.map(
                lambda *stacked_arrays: np.stack(stacked_arrays, 1), *step_and_jacobian_arrays
            )
            for step_and_jacobian_arrays in zip(*steps_and_jacobians, strict=True)
        )
        return PeriodEvaluation(
            gait_steps_of_period,
            stacked_jacobians,
            section_states,
            period_jacobian[:, :, :n_parameter_values],
            period_jacobian[:, :, n_parameter_values:],
            is_period_complete,
        )


class PeriodEvaluation(NamedTuple):
    """Gait steps of one period with their Jacobians and end states, and whether each period is
    complete.
    """

    gait_steps_of_period: Any
    step_jacobians: Any
    end_states: np.ndarray
    parameter_jacobian: np.ndarray
    return_map_jacobian: np.ndarray
    is_period_complete: np.ndarray

    def compute_newton_correction(
        self, section_states: np.ndarray, return_map_jacobian: np.ndarray
    ) -> np.ndarray:
        """Return Newton's correction of the section states, which is zero if a period
        is not complete.
        """
        newton_correction, is_period_complete = (
            np.zeros_like(section_states),
            self.is_period_complete,
        )
        newton_matrix = np.eye(section_states.shape[1]) - return_map_jacobian[is_period_complete]
        newton_correction[is_period_complete] = solve_linear_systems(
            newton_matrix, (self.end_states - section_states)[is_period_complete][..., None]
        )[..., 0]
        return newton_correction


def solve_linear_systems(
    linear_system_matrices: np.ndarray, right_hand_sides: np.ndarray
) -> np.ndarray:
    """Solve many linear systems.

    The solution of a singular system is NaN. The first axis of matrices and right sides is that of
    the systems.
    """
    try:
        return np.linalg.solve(linear_system_matrices, right_hand_sides)
    except np.linalg.LinAlgError:
        is_matrix_regular = np.abs(np.linalg.det(linear_system_matrices)) > 0.0
        regular_matrices = np.where(
            is_matrix_regular[:, None, None],
            linear_system_matrices,
            np.eye(linear_system_matrices.shape[-1]),
        )
        return np.where(
            is_matrix_regular[:, None, None],
            np.linalg.solve(regular_matrices, right_hand_sides),
            np.nan,
        )


def find_contact_fixed_points(
    model: Any,
    n_legs: int,
    step_options: StepOptions,
    period_n: int,
    parameter_values: np.ndarray,
    start_states: np.ndarray,
    needs_parameter_derivatives: bool,
    newton_options: ContactNewtonOptions = CONTACT_NEWTON_OPTIONS,
) -> _ContactFixedPoints:
    """Find the fixed points of the return maps near `start_states`.

    The last components of a section state are discrete codes, which are copied from its image.
    Newton's method first uses gait steps with a loose tolerance, until corrections are small. It
    then uses one step at the tolerance of `step_options`, with the same Jacobian. One more step
    evaluates the gait with all derivatives. If loose steps move away from a state that an exact
    step hardly changes, all steps are exact.
    """
    period_map = PeriodMap(model, n_legs, period_n, parameter_values)
    loose_step_tolerances = [
        np.maximum(newton_tolerance, newton_options.step_tolerance_far_from_gait)
        for newton_tolerance in (step_options.rtol, step_options.atol)
    ]
    loose_step_options = eqx.tree_at(
        lambda step_options: (step_options.rtol, step_options.atol),
        step_options,
        jax.device_put(loose_step_tolerances),
    )
    newton_tolerance, is_wheel_requested = (
        float(compute_newton_tolerance(step_options)),
        np.ones(len(parameter_values), bool),
    )
    loose_fixed_points, return_map_jacobian = _run_contact_newton(
        period_map,
        loose_step_options,
        start_states,
        False,
        newton_options.max_correction_near_gait,
        is_wheel_requested,
        newton_options,
    )
    is_near_gait = loose_fixed_points.is_gait_found
    section_states = np.where(
        is_near_gait[:, None], loose_fixed_points.fixed_section_states, start_states
    )
    section_units = period_map.section_units_by_wheel
    exact_period_evaluation = period_map.evaluate_period(step_options, section_states, False, False)
    newton_correction = exact_period_evaluation.compute_newton_correction(
        section_states, return_map_jacobian
    )
    section_states[is_near_gait] += newton_correction[is_near_gait] * (
        np.abs(newton_correction / section_units)[is_near_gait].max(-1, keepdims=True)
        < newton_options.max_correction_near_gait
    )
    is_near_gait = is_near_gait | (
        exact_period_evaluation.is_period_complete
        & (
            np.abs((exact_period_evaluation.end_states - section_states) / section_units).max(-1)
            < newton_options.max_correction_near_gait
        )
    )
    exact_fixed_points, _ = _run_contact_newton(
        period_map,
        step_options,
        section_states,
        needs_parameter_derivatives,
        newton_tolerance,
        is_near_gait,
        newton_options,
        stops_at_small_correction=False,
    )
    return exact_fixed_points._replace(
        n_newton_iterations=loose_fixed_points.n_newton_iterations
        + 1
        + exact_fixed_points.n_newton_iterations
    )


def _run_contact_newton(
    period_map: PeriodMap,
    step_options: StepOptions,
    start_states: np.ndarray,
    needs_parameter_derivatives: bool,
    newton_tolerance: float,
    is_wheel_requested: np.ndarray,
    newton_options: ContactNewtonOptions,
    stops_at_small_correction: bool = True,
) -> tuple[_ContactFixedPoints, np.ndarray]:
    """Run Newton's method on the requested wheels until corrections are small.

    Return the fixed points and the Jacobians of the return map. If no period completes after a
    correction, the correction is halved. If `stops_at_small_correction` is true, a single small
    correction ends the iteration. Otherwise the gait is evaluated again at the corrected state. Two
    small corrections in succession are then needed, because the map may jump between two states if
    a foot grazes the ground.
    """
    n_wheels, n_legs = len(start_states), period_map.n_legs
    section_states, last_section_states, section_units = (
        start_states.copy(),
        start_states.copy(),
        period_map.section_units_by_wheel,
    )
    newton_residuals, n_iterations = np.full(n_wheels, np.inf), np.zeros(n_wheels, np.int32)
    had_small_correction_before, is_gait_found, n_correction_halvings = (
        np.zeros(n_wheels, float_dtype) for float_dtype in (bool, bool, int)
    )
    return_map_jacobian = np.zeros((n_wheels, start_states.shape[1], start_states.shape[1]))
    active_wheel_indices, stored_steps_and_jacobians = np.arange(n_wheels), None
    for _ in range(newton_options.max_iterations + newton_options.max_correction_halvings):
        period_evaluation = period_map.select_wheels(active_wheel_indices).evaluate_period(
            step_options, section_states[active_wheel_indices], needs_parameter_derivatives
        )
        if stored_steps_and_jacobians is None:
            stored_steps_and_jacobians = jax.tree.map(
                np.array, (period_evaluation.gait_steps_of_period, period_evaluation.step_jacobians)
            )
        for stored_array, new_array in zip(
            jax.tree.leaves(stored_steps_and_jacobians),
            jax.tree.leaves(period_evaluation[:2]),
            strict=True,
        ):
            stored_array[active_wheel_indices] = new_array
        newton_correction = period_evaluation.compute_newton_correction(
            section_states[active_wheel_indices], period_evaluation.return_map_jacobian
        )
        correction_size = np.abs(newton_correction / section_units[active_wheel_indices]).max(-1)
        is_correction_valid = period_evaluation.is_period_complete & np.isfinite(
            newton_correction
        ).all(-1)
        newton_residuals[active_wheel_indices] = np.abs(
            (period_evaluation.end_states - section_states[active_wheel_indices])
            / section_units[active_wheel_indices]
        ).max(-1)
        return_map_jacobian[active_wheel_indices] = period_evaluation.return_map_jacobian
        n_iterations[active_wheel_indices] += 1
        has_small_correction_now = is_correction_valid & (correction_size <= newton_tolerance)
        is_wheel_done = (
            has_small_correction_now
            & (
                had_small_correction_before[active_wheel_indices]
                | (correction_size <= newton_options.clear_convergence_fraction * newton_tolerance)
            )
            & (not stops_at_small_correction)
        )
        had_small_correction_before[active_wheel_indices] = has_small_correction_now
        moving_wheel_indices = active_wheel_indices[is_correction_valid & ~is_wheel_done]
        last_section_states[moving_wheel_indices], n_correction_halvings[moving_wheel_indices] = (
            section_states[moving_wheel_indices],
            0,
        )
        section_states[moving_wheel_indices] += newton_correction[
            is_correction_valid & ~is_wheel_done
        ]
        failed_wheel_indices = active_wheel_indices[~is_correction_valid]
        section_states[failed_wheel_indices] = 0.5 * (
            section_states[failed_wheel_indices] + last_section_states[failed_wheel_indices]
        )
        n_correction_halvings[failed_wheel_indices] += 1
        section_states[failed_wheel_indices, -n_legs:] = last_section_states[
            failed_wheel_indices, -n_legs:
        ]
        is_gait_found[active_wheel_indices] = is_wheel_requested[active_wheel_indices] & (
            had_small_correction_before[active_wheel_indices]
            if stops_at_small_correction
            else is_wheel_done
        )
        has_wheel_failed = (
            (n_correction_halvings > newton_options.max_correction_halvings)
            | (n_iterations > newton_options.max_iterations)
            | ~is_wheel_requested
        )
        active_wheel_indices = active_wheel_indices[
            ~is_gait_found[active_wheel_indices] & ~has_wheel_failed[active_wheel_indices]
        ]
        if not len(active_wheel_indices):
            break
    assert stored_steps_and_jacobians is not None
    return _ContactFixedPoints(
        section_states,
        stored_steps_and_jacobians[0],
        stored_steps_and_jacobians[1],
        newton_residuals,
        is_gait_found,
        n_iterations,
    ), return_map_jacobian


@eqx.filter_jit
def _evaluate_over_wheels(
    evaluate_fixed_point: Callable,
    model: AbstractWheel,
    n_legs: int,
    parameter_values: Array,
    fixed_points: _ContactFixedPoints,
) -> Any:
    """Evaluate `evaluate_fixed_point` at the fixed point of each wheel, by one program for the
    batch.
    """
    return eqx.filter_vmap(
        lambda parameter_values, fixed_points: evaluate_fixed_point(
            model, n_legs, parameter_values, fixed_points
        )
    )(parameter_values, fixed_points)


def _compute_return_map_jacobian_of_steps(
    fixed_points: _ContactFixedPoints, n_parameter_values: int
) -> Array:
    """Return the Jacobian of the return map over one period, as a product of the Jacobians of its
    steps.

    - `n_parameter_values`: number of parameter values. Their columns precede those of the
      section state.
    """
    return_map_jacobian = jnp.eye(
        fixed_points.fixed_section_states.shape[0], dtype=fixed_points.fixed_section_states.dtype
    )
    for step_jacobian in fixed_points.step_jacobians.section_state:
        return_map_jacobian = step_jacobian[:, n_parameter_values:] @ return_map_jacobian
    return return_map_jacobian


def _make_contact_cycle(
    model: AbstractWheel, n_legs: int, parameter_values: Array, fixed_points: _ContactFixedPoints
) -> ReturnMapCycle:
    """Build the cycle that belongs to a fixed point."""
    newton_diagnostics = (
        fixed_points.newton_residuals,
        fixed_points.is_gait_found,
        fixed_points.n_newton_iterations,
    )
    wheel_model, params = model.from_parameter_values(parameter_values, n_legs)
    fixed_point = FixedPointResult(
        fixed_points.fixed_section_states,
        _compute_return_map_jacobian_of_steps(fixed_points, len(parameter_values)),
        *newton_diagnostics,
    )
    return make_return_map_cycle(
        params, wheel_model, fixed_point, fixed_points.gait_steps_of_period
    )


def _make_contact_gait(
    model: AbstractWheel, n_legs: int, parameter_values: Array, fixed_points: _ContactFixedPoints
) -> Gait:
    """Build the gait that belongs to a fixed point, with derivatives by the implicit
    function theorem.
    """
    n_parameter_values = parameter_values.shape[0]
    identity_matrix = jnp.eye(
        fixed_points.fixed_section_states.shape[0], dtype=fixed_points.fixed_section_states.dtype
    )
    parameter_jacobian = jnp.zeros(
        (len(identity_matrix), n_parameter_values), identity_matrix.dtype
    )
    return_map_jacobian = _compute_return_map_jacobian_of_steps(fixed_points, n_parameter_values)
    for step_jacobian in fixed_points.step_jacobians.section_state:
        parameter_jacobian = (
            step_jacobian[:, :n_parameter_values]
            + step_jacobian[:, n_parameter_values:] @ parameter_jacobian
        )
    newton_matrix = jnp.where(
        fixed_points.is_gait_found, identity_matrix - return_map_jacobian, identity_matrix
    )
    section_state_derivatives = jnp.linalg.solve(newton_matrix, parameter_jacobian)

    state_derivatives, derivatives_by_step = section_state_derivatives, []
    for step_index in range(len(fixed_points.step_jacobians.section_state)):
        input_tangents = jnp.concatenate(
            [jnp.eye(n_parameter_values, dtype=identity_matrix.dtype), state_derivatives]
        )
        step_tangents = jax.tree.map(
            lambda array_over_steps, step_index=step_index, input_tangents=input_tangents: (
                array_over_steps[step_index] @ input_tangents
            ),
            fixed_points.step_jacobians,
        )
        derivatives_by_step.append(move_derivative_axis_first(step_tangents))
        state_derivatives = step_tangents.section_state
    step_derivatives = jax.tree.map(
        lambda *stacked_arrays: jnp.stack(stacked_arrays, 1), *derivatives_by_step
    )

    cycle = _make_contact_cycle(model, n_legs, parameter_values, fixed_points)
    # The derivative of the Jacobian is unknown, so measures of the Jacobian are not in
    # `differentiable_measures`.
    float_cycle_fields = eqx.filter(cycle, eqx.is_inexact_array)
    zero_derivatives = jax.tree.map(
        lambda x: jnp.zeros((n_parameter_values, *x.shape), x.dtype), float_cycle_fields
    )
    make_cycle_inputs = lambda parameter_values: eqx.filter(
        model.from_parameter_values(parameter_values, n_legs), eqx.is_inexact_array
    )
    model_derivatives, params_derivatives = move_derivative_axis_first(
        jax.jacfwd(make_cycle_inputs)(parameter_values)
    )
    cycle_derivatives = eqx.tree_at(
        lambda c: (
            c.section_state, c.steps, c.model, c.params, c.post_impact, c.durations, c.step_length
        ),
        zero_derivatives,
        (
            section_state_derivatives.T,
            step_derivatives,
            model_derivatives,
            params_derivatives,
            *jax.vmap(summarize_cycle_steps)(step_derivatives),
        ),
    )  # fmt: skip
    first_gait_step = jax.tree.map(
        lambda array_over_steps: array_over_steps[0], fixed_points.gait_steps_of_period
    )
    first_gait_step_derivatives = jax.tree.map(
        lambda array_over_steps: array_over_steps[:, 0], step_derivatives
    )
    return make_return_map_gait(
        model, n_legs, cycle, first_gait_step, cycle_derivatives, first_gait_step_derivatives
    )
