"""Find gaits with unilateral contact by Newton's method on batches of gait steps.

The machine code for a gait step also computes its tangents. Many wheels are therefore searched
together, and no large program is compiled for the derivatives.
"""

import functools
from collections.abc import Callable
from dataclasses import replace
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from vrw_jax.base import batch_sizes
from vrw_jax.base.checks import has_traced_leaf
from vrw_jax.base.options import StepOptions
from vrw_jax.base.outcomes import Outcome
from vrw_jax.gaits.attracting_gaits import find_slow_gaits
from vrw_jax.gaits.finder import (
    Gait,
    GaitMeasures,
    ParameterValues,
    compute_gait_measures,
    compute_value_and_tangents,
    move_derivative_axis_first,
)
from vrw_jax.gaits.fixed_points import FixedPointResult
from vrw_jax.gaits.gait_walks import stack_section_units
from vrw_jax.gaits.return_map_finder import (
    AbstractReturnMapFinder,
    ReturnMapCycle,
    compute_newton_tolerance,
    find_return_map_cycle,
    make_return_map_cycle,
    make_return_map_gait,
)
from vrw_jax.lanes.batching import map_in_batches, select_tree_rows
from vrw_jax.models.contact_walks import step_batch_with_jacobian
from vrw_jax.models.interface import AbstractWheel
from vrw_jax.models.measures import FORCE_PEAK_MEASURES, UNILATERAL_DIFFERENTIABLE_NAMES
from vrw_jax.models.step_results import AbstractStep
from vrw_jax.models.stepping import convert_step_arguments
from vrw_jax.models.unilateral_wheel import UnilateralWheel
from vrw_jax.wheel.params import WheelParams


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
        params, section_state, model, options = self.prepare_search(params, cycle_guess)
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
            _make_contact_cycles,
            parameter_values,
            section_states,
            needs_parameter_derivatives=False,
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
            _make_contact_gaits,
            parameter_values,
            getattr(cycle_guess, "section_state", cycle_guess),
            needs_parameter_derivatives=True,
        )

    def _solve_and_evaluate(
        self,
        evaluate_fixed_points: Callable,
        parameter_values: Any,
        section_states: Any,
        needs_parameter_derivatives: bool,
    ) -> Any:
        """Find the fixed point of the return map for each wheel, and evaluate a function of it.

        - `evaluate_fixed_points`: function of the wheels' parameters, fixed points and periods;
        - `section_states`: starts of Newton's method;
        - `needs_parameter_derivatives`: whether the steps are differentiated with respect to
          parameters.
        """
        parameter_values = np.asarray(parameter_values)
        fixed_points_and_periods = find_contact_fixed_points(
            PeriodMap(self.model, self.n_legs, self.period_n, parameter_values),
            self.step_options,
            np.asarray(section_states),
            needs_parameter_derivatives,
        )
        return map_in_batches(
            functools.partial(evaluate_fixed_points, self.model, self.n_legs),
            self.gait_batch_sizes,
            parameter_values,
            *fixed_points_and_periods,
        )

    def take_gait_step(self, params: WheelParams, section_state: Array) -> AbstractStep:
        steps, _ = step_batch_with_jacobian(
            np.asarray(self.model.collect_parameter_values(params))[:, None],
            np.asarray(section_state)[None],
            self.model,
            self.step_options,
            self.n_legs,
            (),
        )
        return _remove_batch_axis(steps)

    def measure_gait(
        self, parameter_values: ParameterValues, cycle_guess: Any, measure_names: tuple[str, ...]
    ) -> GaitMeasures:
        """Return measures of a gait and their derivatives, computed from one Jacobian of the gait
        step.
        """
        section_state = getattr(cycle_guess, "section_state", cycle_guess)
        if section_state is None:
            section_state = self.make_initial_guess(parameter_values)
        model, params = self.model.from_parameter_values(
            tuple(jax.device_put(list(np.asarray(parameter_values)))), self.n_legs
        )
        section_state = convert_step_arguments(params, section_state, model, self.step_options)[1]
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

    def evaluate_period(
        self,
        step_options: StepOptions,
        section_states: np.ndarray,
        is_value_differentiated: Any,
        is_start_differentiated: bool = True,
    ) -> "PeriodEvaluation":
        """Compute the gait steps of one period from the given section states, and their
        derivatives.

        The derivatives are with respect to the selected parameter values and to the section states.
        """
        steps_and_jacobians = []
        n_parameter_values = self.parameter_values.shape[1]
        n_section_entries = section_states.shape[1]
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
        input_columns = self.parameter_values.T.copy()
        for k in range(self.period_n):
            if k > 0:
                self.model.exchange_legs(input_columns)
            step_result, step_result_jacobians = step_batch_with_jacobian(
                input_columns,
                section_states,
                self.model,
                step_options,
                self.n_legs,
                input_indices,
            )
            steps_and_jacobians.append((step_result, step_result_jacobians))
            is_period_complete &= np.asarray(step_result.outcome) == Outcome.STEPPED
            section_states = np.asarray(step_result.section_state)
            step_jacobian = np.asarray(step_result_jacobians.section_state)
            period_jacobian = step_jacobian[:, :, n_parameter_values:] @ period_jacobian
            period_jacobian[:, :, :n_parameter_values] += step_jacobian[:, :, :n_parameter_values]
        gait_steps_of_period, step_jacobians = jax.tree.map(
            lambda *stacked_arrays: np.stack(stacked_arrays, 1), *steps_and_jacobians
        )
        return PeriodEvaluation(
            gait_steps_of_period,
            step_jacobians,
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
        newton_correction = np.zeros_like(section_states)
        newton_matrix = (
            np.eye(section_states.shape[1]) - return_map_jacobian[self.is_period_complete]
        )
        period_defects = (self.end_states - section_states)[self.is_period_complete]
        newton_correction[self.is_period_complete] = solve_linear_systems(
            newton_matrix, period_defects[..., None]
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


# Tolerance of gait steps that start far from a gait.
STEP_TOLERANCE_FAR_FROM_GAIT = 1e-6
# Correction below which a state is treated as near a gait, rad, rad/s, m/s.
MAX_CORRECTION_NEAR_GAIT = 1e-4


def find_contact_fixed_points(
    period_map: PeriodMap,
    step_options: StepOptions,
    start_states: np.ndarray,
    needs_parameter_derivatives: bool,
) -> tuple[FixedPointResult, PeriodEvaluation]:
    """Find the fixed points of the return maps near `start_states`.

    Return the fixed points, and the periods that start from them. The last components of a section
    state are discrete codes, which are copied from its image. Newton's method first uses gait steps
    with a loose tolerance, until corrections are small. It then uses one step at the tolerance of
    `step_options`, with the same Jacobian. One more step evaluates the gait with all derivatives.
    If loose steps move away from a state that an exact step hardly changes, all steps are exact.
    """
    loose_step_options = replace(
        step_options,
        rtol=jnp.maximum(step_options.rtol, STEP_TOLERANCE_FAR_FROM_GAIT),
        atol=jnp.maximum(step_options.atol, STEP_TOLERANCE_FAR_FROM_GAIT),
    )
    loose_fixed_points, loose_evaluation = _run_contact_newton(
        period_map,
        loose_step_options,
        start_states,
        False,
        MAX_CORRECTION_NEAR_GAIT,
        np.ones(len(start_states), bool),
    )
    is_near_gait = np.asarray(loose_fixed_points.converged)
    section_states = np.where(is_near_gait[:, None], loose_fixed_points.x, start_states)
    section_units = period_map.section_units_by_wheel
    exact_evaluation = period_map.evaluate_period(step_options, section_states, False, False)
    newton_correction = exact_evaluation.compute_newton_correction(
        section_states, loose_evaluation.return_map_jacobian
    )
    section_states[is_near_gait] += newton_correction[is_near_gait] * (
        np.abs(newton_correction / section_units)[is_near_gait].max(-1, keepdims=True)
        < MAX_CORRECTION_NEAR_GAIT
    )
    period_defects = np.abs((exact_evaluation.end_states - section_states) / section_units).max(-1)
    exact_fixed_points, period_evaluation = _run_contact_newton(
        period_map,
        step_options,
        section_states,
        needs_parameter_derivatives,
        float(compute_newton_tolerance(step_options)),
        is_near_gait
        | (exact_evaluation.is_period_complete & (period_defects < MAX_CORRECTION_NEAR_GAIT)),
        stops_at_small_correction=False,
    )
    n_iterations = loose_fixed_points.n_iterations + 1 + exact_fixed_points.n_iterations
    return exact_fixed_points._replace(n_iterations=n_iterations), period_evaluation


# Largest number of Newton iterations.
MAX_CONTACT_NEWTON_ITERATIONS = 15
# Largest number of times that a correction is halved if no gait step completes after it.
MAX_CORRECTION_HALVINGS = 6
# Fraction of the tolerance below which one correction suffices for convergence.
CLEAR_CONVERGENCE_FRACTION = 0.01


def _run_contact_newton(
    period_map: PeriodMap,
    step_options: StepOptions,
    start_states: np.ndarray,
    needs_parameter_derivatives: bool,
    newton_tolerance: float,
    is_wheel_requested: np.ndarray,
    stops_at_small_correction: bool = True,
) -> tuple[FixedPointResult, PeriodEvaluation]:
    """Run Newton's method on the requested wheels until corrections are small.

    If no period completes after a correction, the correction is halved. If
    `stops_at_small_correction` is true, a single small correction ends the iteration. Otherwise the
    gait is evaluated again at the corrected state. Two small corrections in succession are then
    needed, because the map may jump between two states if a foot grazes the ground.
    """
    n_wheels = len(start_states)
    section_states = start_states.copy()
    last_section_states = start_states.copy()
    section_units = period_map.section_units_by_wheel
    newton_residuals = np.full(n_wheels, np.inf)
    n_iterations = np.zeros(n_wheels, np.int32)
    n_correction_halvings = np.zeros(n_wheels, int)
    had_small_correction = np.zeros(n_wheels, bool)
    is_gait_found = np.zeros(n_wheels, bool)
    period_evaluation = None
    active_wheels = np.arange(n_wheels)
    for _ in range(MAX_CONTACT_NEWTON_ITERATIONS + MAX_CORRECTION_HALVINGS):
        active_states = section_states[active_wheels]
        active_map = period_map._replace(
            parameter_values=period_map.parameter_values[active_wheels]
        )
        active_evaluation = active_map.evaluate_period(
            step_options, active_states, needs_parameter_derivatives
        )
        if period_evaluation is None:
            period_evaluation = jax.tree.map(np.array, active_evaluation)
        for stored_array, new_array in zip(
            jax.tree.leaves(period_evaluation), jax.tree.leaves(active_evaluation), strict=True
        ):
            stored_array[active_wheels] = new_array
        newton_correction = active_evaluation.compute_newton_correction(
            active_states, active_evaluation.return_map_jacobian
        )
        correction_size = np.abs(newton_correction / section_units[active_wheels]).max(-1)
        is_correction_valid = active_evaluation.is_period_complete & np.isfinite(
            newton_correction
        ).all(-1)
        newton_residuals[active_wheels] = np.abs(
            (active_evaluation.end_states - active_states) / section_units[active_wheels]
        ).max(-1)
        n_iterations[active_wheels] += 1
        has_small_correction = is_correction_valid & (correction_size <= newton_tolerance)
        has_converged = has_small_correction & (
            had_small_correction[active_wheels]
            | (correction_size <= CLEAR_CONVERGENCE_FRACTION * newton_tolerance)
        )
        had_small_correction[active_wheels] = has_small_correction
        is_state_moved = is_correction_valid & (stops_at_small_correction | ~has_converged)
        moved_wheels = active_wheels[is_state_moved]
        last_section_states[moved_wheels] = section_states[moved_wheels]
        section_states[moved_wheels] += newton_correction[is_state_moved]
        n_correction_halvings[moved_wheels] = 0
        failed_wheels = active_wheels[~is_correction_valid]
        section_states[failed_wheels] = 0.5 * (
            section_states[failed_wheels] + last_section_states[failed_wheels]
        )
        # Discrete codes are not halved.
        section_states[failed_wheels, -period_map.n_legs :] = last_section_states[
            failed_wheels, -period_map.n_legs :
        ]
        n_correction_halvings[failed_wheels] += 1
        is_gait_found[active_wheels] = is_wheel_requested[active_wheels] & (
            has_small_correction if stops_at_small_correction else has_converged
        )
        has_wheel_failed = (
            (n_correction_halvings > MAX_CORRECTION_HALVINGS)
            | (n_iterations > MAX_CONTACT_NEWTON_ITERATIONS)
            | ~is_wheel_requested
        )
        active_wheels = active_wheels[~(is_gait_found | has_wheel_failed)[active_wheels]]
        if not len(active_wheels):
            break
    assert period_evaluation is not None
    fixed_points: Any = (
        section_states,
        period_evaluation.return_map_jacobian,
        newton_residuals,
        is_gait_found,
        n_iterations,
    )
    return FixedPointResult(*fixed_points), period_evaluation


def _make_contact_cycle(
    model: AbstractWheel,
    n_legs: int,
    parameter_values: Array,
    fixed_point: FixedPointResult,
    period_evaluation: PeriodEvaluation,
) -> ReturnMapCycle:
    wheel_model, params = model.from_parameter_values(parameter_values, n_legs)
    return make_return_map_cycle(
        params, wheel_model, fixed_point, period_evaluation.gait_steps_of_period
    )


def _make_contact_gait(
    model: AbstractWheel,
    n_legs: int,
    parameter_values: Array,
    fixed_point: FixedPointResult,
    period_evaluation: Any,
) -> Gait:
    """Build the gait that belongs to a fixed point, with derivatives by the implicit
    function theorem.
    """
    n_parameter_values = len(parameter_values)
    section_state = fixed_point.x
    identity_matrix = jnp.eye(len(section_state), dtype=section_state.dtype)
    newton_matrix = jnp.where(
        fixed_point.converged,
        identity_matrix - period_evaluation.return_map_jacobian,
        identity_matrix,
    )
    section_state_derivatives = jnp.linalg.solve(
        newton_matrix, period_evaluation.parameter_jacobian
    )
    state_derivatives = section_state_derivatives
    derivatives_by_step = []
    for step_index in range(len(period_evaluation.step_jacobians.section_state)):
        input_tangents = jnp.concatenate(
            [jnp.eye(n_parameter_values, dtype=identity_matrix.dtype), state_derivatives]
        )
        step_tangents = jax.tree.map(
            lambda step_jacobian, step_index=step_index, input_tangents=input_tangents: (
                step_jacobian[step_index] @ input_tangents
            ),
            period_evaluation.step_jacobians,
        )
        derivatives_by_step.append(move_derivative_axis_first(step_tangents))
        state_derivatives = step_tangents.section_state
    step_derivatives = jax.tree.map(
        lambda *stacked_arrays: jnp.stack(stacked_arrays, 1), *derivatives_by_step
    )

    # The derivative of the Jacobian is unknown, so measures of the Jacobian are not in
    # `differentiable_measures`.
    def make_cycle(parameter_values: Array, section_state: Array, gait_steps: Any) -> Any:
        return _make_contact_cycle(
            model,
            n_legs,
            parameter_values,
            fixed_point._replace(x=section_state),
            period_evaluation._replace(gait_steps_of_period=gait_steps),
        )

    _, cycle_derivatives = compute_value_and_tangents(
        lambda *inputs: eqx.filter(make_cycle(*inputs), eqx.is_inexact_array),
        (parameter_values, section_state, period_evaluation.gait_steps_of_period),
        (
            jnp.eye(n_parameter_values, dtype=parameter_values.dtype),
            section_state_derivatives.T,
            step_derivatives,
        ),
    )
    cycle = _make_contact_cycle(model, n_legs, parameter_values, fixed_point, period_evaluation)
    return make_return_map_gait(model, n_legs, cycle, cycle_derivatives)


_make_contact_cycles, _make_contact_gaits = (
    eqx.filter_jit(eqx.filter_vmap(make_result_of_wheel, in_axes=(None, None, 0, 0, 0)))
    for make_result_of_wheel in (_make_contact_cycle, _make_contact_gait)
)
