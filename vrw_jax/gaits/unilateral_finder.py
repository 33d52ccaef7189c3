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

from vrw_jax.base.checks import has_traced_leaf
from vrw_jax.base.options import StepOptions
from vrw_jax.base.results import Outcome
from vrw_jax.gaits.finder import (
    Gait,
    ParameterValues,
    compute_value_and_tangents,
    move_derivative_axis_first,
)
from vrw_jax.gaits.fixed_points import FixedPointResult
from vrw_jax.gaits.gait_walks import find_slow_gaits, stack_section_units
from vrw_jax.gaits.wheel_finders import (
    ReturnMapCycle,
    ReturnMapFinder,
    compute_newton_tolerance,
    make_return_map_cycle,
)
from vrw_jax.lanes.batching import (
    map_in_batches,
    replace_rows,
    select_rows_on_device,
)
from vrw_jax.models.contact_walks import embed_section_states, step_batch_with_jacobian
from vrw_jax.models.measures import FORCE_PEAK_MEASURES, UNILATERAL_DIFFERENTIABLE_NAMES
from vrw_jax.models.step_results import AbstractStep
from vrw_jax.models.stepping import convert_step_arguments
from vrw_jax.models.unilateral_wheel import UnilateralWheel
from vrw_jax.wheel.params import WheelParams

CONTACT_GAIT_BATCH_SIZES = (1, 8, 64, 512)
"""Numbers of limit cycles with unilateral contact that are computed together. Their search needs
few iterations, but their steps are expensive.
"""


class UnilateralFinder(ReturnMapFinder):
    """Finder of gaits with unilateral contact and their first derivatives.

    The derivatives are with respect to all parameters, including friction.
    """

    model: UnilateralWheel
    gait_batch_sizes: tuple[int, ...] = eqx.field(static=True, default=CONTACT_GAIT_BATCH_SIZES)

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
    differentiates_jacobian: ClassVar[bool] = False

    def find_cycle(self, params: WheelParams, cycle_guess: Any = None) -> ReturnMapCycle:
        """Find the cycle of one wheel.

        If all inputs are concrete, the batched engine computes the gait steps. If an input is
        traced, the cycle has derivatives by the implicit function theorem, computed from a single
        gait step.
        """
        params, section_state, model, _ = self.prepare_search(params, cycle_guess)
        if has_traced_leaf(params, section_state, model):
            return super().find_cycle(params, cycle_guess)
        return jax.tree.map(
            lambda section_state: section_state[0],
            self.find_cycles_near(
                model.collect_parameter_values(params)[None], section_state[None]
            ),
        )

    def find_cycles(self, params: WheelParams, cycle_guess: Any = None) -> Any:
        if has_traced_leaf(params, cycle_guess):
            return eqx.filter_vmap(self.find_cycle)(params, cycle_guess)
        parameter_values = self.model.collect_batch_parameter_values(params)
        section_states = getattr(cycle_guess, "section_state", cycle_guess)
        if section_states is None:
            section_states = jax.vmap(self.model.compute_default_start)(params)
        return self.find_cycles_near(
            parameter_values,
            self.complete_section_states(parameter_values, np.asarray(section_states)),
        )

    def find_cycles_near(self, parameter_values: Any, section_states: Any) -> ReturnMapCycle:
        """Find one gait for each wheel near the given section states, without derivatives."""
        return self._solve_and_evaluate(
            _make_contact_cycles,
            parameter_values,
            section_states,
            needs_parameter_derivatives=False,
        )

    def complete_section_states(
        self, parameter_values: np.ndarray, section_states: np.ndarray
    ) -> np.ndarray:
        return np.array(embed_section_states(parameter_values.T, section_states, self.n_legs))

    def precompile_newton_programs(self, parameter_values: np.ndarray) -> None:
        """Compile the programs of Newton's method while another thread computes walks toward its
        start.
        """
        n_section_entries = self.model.count_section_entries(WheelParams(n_legs=self.n_legs))
        period_map = PeriodMap(self.model, self.n_legs, self.period_n, parameter_values)
        section_states = np.zeros((len(parameter_values), n_section_entries))
        period_map.evaluate_period(self.step_options, section_states, False)

    def make_initial_guess(self, parameter_values: ParameterValues) -> Array:
        guesses = self.make_initial_guesses(select_rows_on_device(parameter_values, None))
        return select_rows_on_device(guesses, 0)

    def make_initial_guesses(self, parameter_values: Array) -> Array:
        """Return the section state of a slow attracting gait for each wheel, or NaN if
        there is none.
        """
        slow_gaits = find_slow_gaits(self, parameter_values)
        is_gait_found = np.asarray(slow_gaits.outcome) == Outcome.STEPPED
        return jax.device_put(np.where(is_gait_found[:, None], slow_gaits.section_state, np.nan))

    def find_gait(self, parameter_values: ParameterValues, cycle_guess: Array) -> Gait:
        batch = select_rows_on_device((parameter_values, cycle_guess), None)
        return select_rows_on_device(self.find_gaits(*batch), 0)

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
            functools.partial(evaluate_fixed_points, self),
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
        return select_rows_on_device(steps, 0)

    def refine_cycle_guess(self, parameter_values: ParameterValues, cycle_guess: Any) -> Array:
        model, params = self.model.from_parameter_values(
            tuple(jax.device_put(list(np.asarray(parameter_values)))), self.n_legs
        )
        section_state = getattr(cycle_guess, "section_state", cycle_guess)
        return convert_step_arguments(params, section_state, model, self.step_options)[1]


class PeriodMap(NamedTuple):
    """Map that advances the section states of many wheels by one period.

    The map uses the batched engine outside `jax.jit`.
    """

    model: Any
    n_legs: int
    period_n: int
    parameter_values: np.ndarray  # (wheels, n_parameter_values)

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
        n_wheels, n_values = self.parameter_values.shape
        n_entries = section_states.shape[1]
        steps = []
        jacobian = np.eye(n_entries, n_values + n_entries, n_values)[None]
        is_complete = np.ones(n_wheels, bool)
        is_differentiated = np.repeat([is_start_differentiated], n_values + n_entries)
        is_differentiated[:n_values] = is_value_differentiated
        input_indices = np.flatnonzero(is_differentiated).tolist()
        columns, states = self.parameter_values.T.copy(), section_states
        for k in range(self.period_n):
            if k > 0:
                self.model.exchange_legs(columns)
            step, step_jacobians = step_batch_with_jacobian(
                columns, states, self.model, step_options, self.n_legs, input_indices
            )
            steps.append((step, step_jacobians))
            is_complete &= np.asarray(step.outcome) == Outcome.STEPPED
            states = np.asarray(step.section_state)
            step_jacobian = np.asarray(step_jacobians.section_state)
            jacobian = step_jacobian[:, :, n_values:] @ jacobian
            jacobian[:, :, :n_values] += step_jacobian[:, :, :n_values]
        gait_steps, step_jacobians = jax.tree.map(lambda *x: np.stack(x, 1), *steps)
        return PeriodEvaluation(
            gait_steps,
            step_jacobians,
            states - section_states,
            jacobian[:, :, :n_values],
            jacobian[:, :, n_values:],
            is_complete,
        )


class PeriodEvaluation(NamedTuple):
    """Gait steps of one period, and whether each period is complete."""

    gait_steps: Any
    step_jacobians: Any
    defects: np.ndarray  # changes of the section states
    parameter_jacobian: np.ndarray
    return_map_jacobian: np.ndarray
    is_complete: np.ndarray

    def compute_newton_correction(self, return_map_jacobian: np.ndarray) -> np.ndarray:
        """Return Newton's correction of the section states, which is zero if a period
        is not complete.
        """
        correction, is_complete = np.zeros_like(self.defects), self.is_complete
        correction[is_complete] = solve_linear_systems(
            np.eye(correction.shape[1]) - return_map_jacobian[is_complete],
            self.defects[is_complete, :, None],
        )[..., 0]
        return correction


def solve_linear_systems(matrices: np.ndarray, right_hand_sides: np.ndarray) -> np.ndarray:
    """Solve many linear systems.

    The solution of a singular system is NaN. The first axis of matrices and right sides is that of
    the systems.
    """
    try:
        return np.linalg.solve(matrices, right_hand_sides)
    except np.linalg.LinAlgError:
        is_regular = (np.abs(np.linalg.det(matrices)) > 0.0)[:, None, None]
        regular_matrices = np.where(is_regular, matrices, np.eye(matrices.shape[-1]))
        return np.where(is_regular, np.linalg.solve(regular_matrices, right_hand_sides), np.nan)


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
    loosen = lambda tolerance: jnp.maximum(tolerance, STEP_TOLERANCE_FAR_FROM_GAIT)
    loose, loose_evaluation = _run_contact_newton(
        period_map,
        replace(step_options, rtol=loosen(step_options.rtol), atol=loosen(step_options.atol)),
        start_states,
        False,
        MAX_CORRECTION_NEAR_GAIT,
        np.ones(len(start_states), bool),
    )
    is_near_gait = np.asarray(loose.converged)
    section_states = np.where(is_near_gait[:, None], loose.x, start_states)
    units = stack_section_units(period_map.model, period_map.parameter_values, period_map.n_legs)
    is_small = lambda change: np.abs(change / units).max(-1) < MAX_CORRECTION_NEAR_GAIT
    exact_evaluation = period_map.evaluate_period(step_options, section_states, False, False)
    correction = exact_evaluation.compute_newton_correction(loose_evaluation.return_map_jacobian)
    correction[~(is_near_gait & is_small(correction))] = 0.0
    is_repeating = exact_evaluation.is_complete & is_small(exact_evaluation.defects - correction)
    exact, period_evaluation = _run_contact_newton(
        period_map,
        step_options,
        section_states + correction,
        needs_parameter_derivatives,
        float(compute_newton_tolerance(step_options)),
        is_near_gait | is_repeating,
        stops_at_small_correction=False,
    )
    n_iterations = loose.n_iterations + 1 + exact.n_iterations
    return exact._replace(n_iterations=n_iterations), period_evaluation


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
    is_requested: np.ndarray,
    stops_at_small_correction: bool = True,
) -> tuple[FixedPointResult, PeriodEvaluation]:
    """Run Newton's method on the requested wheels until corrections are small.

    If no period completes after a correction, the correction is halved. If
    `stops_at_small_correction` is true, a single small correction ends the iteration. Otherwise the
    gait is evaluated again at the corrected state. Two small corrections in succession are then
    needed, because the map may jump between two states if a foot grazes the ground.
    """
    n_wheels, values = len(start_states), period_map.parameter_values
    x, last_x = start_states.copy(), start_states.copy()
    units = stack_section_units(period_map.model, values, period_map.n_legs)
    residuals = np.full(n_wheels, np.inf)
    n_iterations, n_halvings = np.zeros(n_wheels, np.int32), np.zeros(n_wheels, int)
    was_small, is_found = np.zeros((2, n_wheels), bool)
    evaluation, active = None, np.arange(n_wheels)
    while len(active):
        new = period_map._replace(parameter_values=values[active]).evaluate_period(
            step_options, x[active], needs_parameter_derivatives
        )
        # The first evaluation is that of all wheels.
        evaluation = new if evaluation is None else replace_rows(evaluation, active, new)
        correction = new.compute_newton_correction(new.return_map_jacobian)
        size = np.abs(correction / units[active]).max(-1)
        is_valid = new.is_complete & np.isfinite(correction).all(-1)
        residuals[active] = np.abs(new.defects / units[active]).max(-1)
        n_iterations[active] += 1
        is_small = is_valid & (size <= newton_tolerance)
        is_clear = was_small[active] | (size <= CLEAR_CONVERGENCE_FRACTION * newton_tolerance)
        has_converged = is_small & (stops_at_small_correction | is_clear)
        was_small[active] = is_small
        is_moved = is_valid & (stops_at_small_correction | ~has_converged)
        moved, failed = active[is_moved], active[~is_valid]
        last_x[moved] = x[moved]
        x[moved] += correction[is_moved]
        n_halvings[moved] = 0
        x[failed] = 0.5 * (x[failed] + last_x[failed])
        # Discrete codes are not halved.
        x[failed, -period_map.n_legs :] = last_x[failed, -period_map.n_legs :]
        n_halvings[failed] += 1
        is_found[active] = is_requested[active] & has_converged
        is_running = is_requested & ~is_found & (n_halvings <= MAX_CORRECTION_HALVINGS)
        active = active[(is_running & (n_iterations <= MAX_CONTACT_NEWTON_ITERATIONS))[active]]
    assert evaluation is not None
    results: Any = (x, evaluation.return_map_jacobian, residuals, is_found, n_iterations)
    return FixedPointResult(*results), evaluation


def _make_contact_cycle(
    gait_finder: UnilateralFinder,
    parameter_values: Array,
    fixed_point: FixedPointResult,
    evaluation: PeriodEvaluation,
) -> ReturnMapCycle:
    wheel_model, params = gait_finder.model.from_parameter_values(
        parameter_values, gait_finder.n_legs
    )
    return make_return_map_cycle(params, wheel_model, fixed_point, evaluation.gait_steps)


def _make_contact_gait(
    gait_finder: UnilateralFinder,
    parameter_values: Array,
    fixed_point: FixedPointResult,
    evaluation: PeriodEvaluation,
) -> Gait:
    """Build the gait that belongs to a fixed point, with derivatives by the implicit
    function theorem.
    """
    jacobian = jnp.where(fixed_point.converged, evaluation.return_map_jacobian, 0.0)
    eye = functools.partial(jnp.eye, dtype=jacobian.dtype)
    start_derivatives = jnp.linalg.solve(
        eye(len(jacobian)) - jacobian, evaluation.parameter_jacobian
    )
    state_derivatives, derivatives_by_step = start_derivatives, []
    for k in range(len(evaluation.step_jacobians.section_state)):
        input_tangents = jnp.concatenate([eye(len(parameter_values)), state_derivatives])
        step_tangents = jax.tree.map(
            lambda step_jacobian, k=k, tangents=input_tangents: step_jacobian[k] @ tangents,
            evaluation.step_jacobians,
        )
        derivatives_by_step.append(move_derivative_axis_first(step_tangents))
        state_derivatives = step_tangents.section_state
    step_derivatives = jax.tree.map(lambda *x: jnp.stack(x, 1), *derivatives_by_step)

    # The derivative of the Jacobian is unknown, so measures of the Jacobian are not in
    # `differentiable_measures`.
    def make_cycle(parameter_values: Array, x: Array, gait_steps: Any) -> Any:
        cycle = _make_contact_cycle(
            gait_finder,
            parameter_values,
            fixed_point._replace(x=x),
            evaluation._replace(gait_steps=gait_steps),
        )
        return eqx.filter(cycle, eqx.is_inexact_array)

    _, cycle_derivatives = compute_value_and_tangents(
        make_cycle,
        (parameter_values, fixed_point.x, evaluation.gait_steps),
        (eye(len(parameter_values)), start_derivatives.T, step_derivatives),
    )
    cycle = _make_contact_cycle(gait_finder, parameter_values, fixed_point, evaluation)
    return gait_finder.make_gait(cycle, cycle_derivatives)


_make_contact_cycles, _make_contact_gaits = (
    eqx.filter_jit(eqx.filter_vmap(make_result_of_wheel, in_axes=(None, 0, 0, 0)))
    for make_result_of_wheel in (_make_contact_cycle, _make_contact_gait)
)
