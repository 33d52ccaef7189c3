"""Gaits with unilateral contact, found by Newton's method on batches of steps and their
derivatives.

All tangents of a step are computed together with its motion in the same machine code. Many wheels
are therefore searched together, and no large program is compiled for the derivatives.
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
    Values,
    measure_from_gait,
    move_derivative_axis_first,
)
from vrw_jax.cycles.gait_walks import stack_section_units
from vrw_jax.cycles.options import CycleOptions
from vrw_jax.cycles.return_map_finder import (
    AbstractReturnMapFinder,
    ReturnMapCycle,
    ReturnMapFinder,
    find_return_map_cycle,
    make_cycle,
    make_gait,
    newton_tolerance,
    prepare_search,
    summarize_steps,
)
from vrw_jax.measures import UNILATERAL_DIFFERENTIABLE_NAMES
from vrw_jax.models import AbstractStep, AbstractWheel
from vrw_jax.numerics import StepOptions, batch_sizes, map_in_batches, take_rows
from vrw_jax.simulation import validate_arguments
from vrw_jax.validation import is_traced
from vrw_jax.wheel import Outcome, WheelParams


@dataclass(frozen=True)
class ContactNewtonOptions:
    """Options of Newton's method on the return map with unilateral contact."""

    max_iterations: int = 15
    """Largest number of Newton iterations."""
    max_halvings: int = 6
    """Largest number of halvings of a correction if no step completes after it."""
    far_step_tolerance: float = 1e-6
    """Tolerance of the steps far from a gait."""
    near_correction: float = 1e-4
    """Size of a correction below which a state is near a gait, rad, rad/s, m/s."""
    clear_convergence_factor: float = 0.01
    """Fraction of the tolerance below which a correction is accepted without a second one."""


CONTACT_NEWTON_OPTIONS = ContactNewtonOptions()


class UnilateralFinder(AbstractReturnMapFinder):
    """Finder of gaits with unilateral contact and their first derivatives, also with respect to
    friction.
    """

    model: UnilateralWheel
    batch_sizes: tuple[int, ...] = eqx.field(
        static=True, default=batch_sizes.CONTACT_GAIT_BATCH_SIZES
    )

    cycle_measures: ClassVar[tuple[str, ...]] = ("spectral_radius", "spectral_margin")
    differentiable_measures: ClassVar[tuple[str, ...]] = UNILATERAL_DIFFERENTIABLE_NAMES
    default_measures: ClassVar[tuple[str, ...]] = UNILATERAL_DIFFERENTIABLE_NAMES
    readable_measures: ClassVar[tuple[str, ...]] = UNILATERAL_DIFFERENTIABLE_NAMES
    is_multistable: ClassVar[bool] = True

    @classmethod
    def from_options(
        cls,
        model: Any,
        n_legs: int,
        step_options: StepOptions,
        period_n: int,
        cycle_options: CycleOptions,
    ) -> AbstractReturnMapFinder:
        if model.restitution is not None:  # The batched engine has no restitution.
            return ReturnMapFinder(model, n_legs, step_options, period_n)
        return cls(model, n_legs, step_options, period_n)

    def find_cycle(self, params: WheelParams, guess: Any = None) -> ReturnMapCycle:
        """Return the cycle by the batched engine if all inputs are concrete, else by the step's
        own derivatives.
        """
        params, x, model, options = prepare_search(self, params, guess)
        if is_traced(params, x, model):
            return find_return_map_cycle(
                params, x, model, options, self.period_n, uses_jvp_rule=True
            )
        return jax.tree.map(
            lambda x: x[0], self.find_cycles_near(model.parameter_values(params)[None], x[None])
        )

    def find_cycles(self, params: WheelParams, guess: Any = None) -> Any:
        if is_traced(params, guess):
            return eqx.filter_vmap(self.find_cycle)(params, guess)
        values = jax.vmap(self.model.parameter_values)(params)
        states = getattr(guess, "section_state", guess)
        if states is None:
            states = jax.vmap(self.model.default_start)(params)
        else:
            states = jax.vmap(self.model.embed_section)(params, jnp.asarray(states))
        return self.find_cycles_near(values, states)

    def find_cycles_near(self, values: Any, states: Any) -> ReturnMapCycle:
        """Return the gaits near section states, one for each wheel, without derivatives."""
        return self._solve_and_evaluate(
            _make_cycle, values, states, with_parameter_derivatives=False
        )

    def precompile_newton(self, values: np.ndarray) -> None:
        """Compile the programs of Newton's method while another thread walks toward its start."""
        n_section = self.model.section_size(WheelParams(n_legs=self.n_legs))
        period_map = PeriodMap(self.model, self.n_legs, self.period_n, values)
        period_map.evaluate_period(self.step_options, np.zeros((len(values), n_section)), False)

    def initial_guess(self, values: Values) -> Array:
        return _remove_batch_axis(self.initial_guesses(_add_batch_axis(values)))

    def initial_guesses(self, values: Array) -> Array:
        """Return the section state of a slow attracting gait for each wheel, NaN if there is
        none.
        """
        gaits = find_slow_gaits(self, values)
        is_found = np.asarray(gaits.outcome) == Outcome.STEPPED
        return jax.device_put(np.where(is_found[:, None], gaits.section_state, np.nan))

    def find_gait(self, values: Values, guess: Array) -> Gait:
        return _remove_batch_axis(self.find_gaits(_add_batch_axis(values), _add_batch_axis(guess)))

    def find_gaits(self, values: Array, guess: Any) -> Gait:
        return self._solve_and_evaluate(
            _make_gait,
            values,
            getattr(guess, "section_state", guess),
            with_parameter_derivatives=True,
        )

    def _solve_and_evaluate(
        self, evaluate_wheel: Callable, values: Any, states: Any, with_parameter_derivatives: bool
    ) -> Any:
        """Return `evaluate_wheel` of the fixed point of each wheel."""
        arguments = np.asarray(values), np.asarray(states), with_parameter_derivatives
        fixed_points = _find_fixed_points(
            self.model, self.n_legs, self.step_options, self.period_n, *arguments
        )
        evaluate_batch = functools.partial(
            _map_over_wheels, evaluate_wheel, self.model, self.n_legs
        )
        return map_in_batches(evaluate_batch, self.batch_sizes, arguments[0], fixed_points)

    def take_step(self, params: WheelParams, section_state: Array) -> AbstractStep:
        value_columns, model = np.asarray(self.model.parameter_values(params))[:, None], self.model
        arguments = (
            value_columns,
            np.asarray(section_state)[None],
            model,
            self.step_options,
            self.n_legs,
        )
        return _remove_batch_axis(step_batch_with_jacobian(*arguments, ())[0])

    def measure_gait(self, values: Values, guess: Any, names: tuple[str, ...]) -> GaitMeasures:
        """Return measures and derivatives, as in the base class, from one Jacobian of the step."""
        model, params = self.model.from_values(
            tuple(jax.device_put(list(np.asarray(values)))), self.n_legs
        )
        start = guess.section_state if isinstance(guess, AbstractCycle) else guess
        start = self.initial_guess(values) if start is None else start
        _, x, _, _ = validate_arguments(params, start, model, self.step_options)
        return measure_from_gait(self.find_gait(values, x), type(self).read_measure, names)


def _add_batch_axis(x: Array) -> Array:
    """Return the array with a batch axis of length one, added by NumPy because JAX compiles a
    program for each shape.
    """
    return jax.device_put(np.asarray(x)[None])


def _remove_batch_axis(tree: Any) -> Any:
    """Return the first entry of every leaf, the inverse of `_add_batch_axis`."""
    return jax.device_put(take_rows(tree, 0))


class _FixedPoints(NamedTuple):
    """Result of Newton's method; for many wheels with a leading axis."""

    x: Any  # section state
    steps: Any  # steps from that state, (period_n, ...)
    step_jacobians: Any  # derivatives of the steps with respect to values and section state
    residual: Any
    converged: Any
    n_iterations: Any


class PeriodMap(NamedTuple):
    """Map over one period of each wheel, evaluated by the batched engine outside of `jax.jit`."""

    model: Any
    n_legs: int
    period_n: int
    values: np.ndarray  # (wheels, n_values)

    @property
    def section_units(self) -> np.ndarray:
        """Return each wheel's own units of its section state, (wheels, section)."""
        return stack_section_units(self.model, self.values, self.n_legs)

    def select(self, indices: np.ndarray) -> "PeriodMap":
        """Return the map of some of the wheels."""
        return self._replace(values=self.values[indices])

    def evaluate_period(
        self,
        options: StepOptions,
        section_states: np.ndarray,
        value_mask: Any = True,
        start_mask: bool = True,
    ) -> "PeriodEvaluation":
        """Return the period from these section states, with derivatives with respect to masked
        values and the states.
        """
        results, (n_values, n_section) = [], (self.values.shape[1], section_states.shape[1])
        jacobian = np.concatenate([np.zeros((n_section, n_values)), np.eye(n_section)], 1)[None]
        is_valid = np.ones(len(section_states), bool)
        input_mask = np.concatenate(
            [np.broadcast_to(value_mask, n_values), np.broadcast_to(start_mask, n_section)]
        )
        input_indices = np.flatnonzero(input_mask).tolist()
        for _ in range(self.period_n):
            arguments = (
                self.values.T,
                section_states,
                self.model,
                options,
                self.n_legs,
                input_indices,
            )
            results.append(step_batch_with_jacobian(*arguments))
            step, step_jacobians = results[-1]
            is_valid &= np.asarray(step.outcome) == Outcome.STEPPED
            section_states = np.asarray(step.section_state)
            step_jacobian = np.asarray(step_jacobians.section_state)
            jacobian = step_jacobian[:, :, n_values:] @ jacobian
            jacobian[:, :, :n_values] += step_jacobian[:, :, :n_values]
        steps, stacked_jacobians = (
            jax.tree.map(lambda *leaves: np.stack(leaves, 1), *pair)
            for pair in zip(*results, strict=True)
        )
        return PeriodEvaluation(
            steps,
            stacked_jacobians,
            section_states,
            jacobian[:, :, :n_values],
            jacobian[:, :, n_values:],
            is_valid,
        )


class PeriodEvaluation(NamedTuple):
    """Steps of one period, their Jacobians, the end state, its Jacobians, and which periods are
    complete.
    """

    steps: Any
    step_jacobians: Any
    end_state: np.ndarray
    value_jacobian: np.ndarray
    return_jacobian: np.ndarray
    is_valid: np.ndarray

    def newton_correction(
        self, section_states: np.ndarray, return_jacobian: np.ndarray
    ) -> np.ndarray:
        """Return Newton's correction of the section states; zeros if a period is not complete."""
        correction, is_valid = np.zeros_like(section_states), self.is_valid
        matrix = np.eye(section_states.shape[1]) - return_jacobian[is_valid]
        correction[is_valid] = solve_linear_systems(
            matrix, (self.end_state - section_states)[is_valid][..., None]
        )[..., 0]
        return correction


def solve_linear_systems(matrix: np.ndarray, right_sides: np.ndarray) -> np.ndarray:
    """Return the solutions of many linear systems; a singular system gives NaN instead of an
    error for all.
    """
    try:
        return np.linalg.solve(matrix, right_sides)
    except np.linalg.LinAlgError:
        is_regular = np.abs(np.linalg.det(matrix)) > 0.0
        regular_matrix = np.where(is_regular[:, None, None], matrix, np.eye(matrix.shape[-1]))
        return np.where(
            is_regular[:, None, None], np.linalg.solve(regular_matrix, right_sides), np.nan
        )


def _find_fixed_points(
    model: Any,
    n_legs: int,
    options: StepOptions,
    period_n: int,
    values: np.ndarray,
    start: np.ndarray,
    with_parameter_derivatives: bool,
    newton_options: ContactNewtonOptions = CONTACT_NEWTON_OPTIONS,
) -> _FixedPoints:
    """Return the fixed points near `start`; codes at the end of a section state are those of its
    image.

    The iteration uses loose steps until corrections are small. Then a step at the tolerance of
    `options` is taken with the same Jacobian. One more step, with all derivatives, yields the gait.
    If loose steps move away from a state that an exact step hardly changes, all steps are exact.
    """
    period_map = PeriodMap(model, n_legs, period_n, values)
    loose_tolerances = [
        np.maximum(tolerance, newton_options.far_step_tolerance)
        for tolerance in (options.rtol, options.atol)
    ]
    loose_options = eqx.tree_at(
        lambda o: (o.rtol, o.atol), options, jax.device_put(loose_tolerances)
    )
    tolerance, all_wheels = float(newton_tolerance(options)), np.ones(len(values), bool)
    loose_solution, return_jacobian = _run_newton(
        period_map,
        loose_options,
        start,
        False,
        newton_options.near_correction,
        all_wheels,
        newton_options,
    )
    is_near = loose_solution.converged
    section_states = np.where(is_near[:, None], loose_solution.x, start)
    units = period_map.section_units
    exact_period = period_map.evaluate_period(options, section_states, False, False)
    correction = exact_period.newton_correction(section_states, return_jacobian)
    section_states[is_near] += correction[is_near] * (
        np.abs(correction / units)[is_near].max(-1, keepdims=True) < newton_options.near_correction
    )
    is_near = is_near | (
        exact_period.is_valid
        & (
            np.abs((exact_period.end_state - section_states) / units).max(-1)
            < newton_options.near_correction
        )
    )
    solution, _ = _run_newton(
        period_map,
        options,
        section_states,
        with_parameter_derivatives,
        tolerance,
        is_near,
        newton_options,
        stops_at_small_correction=False,
    )
    return solution._replace(n_iterations=loose_solution.n_iterations + 1 + solution.n_iterations)


def _run_newton(
    period_map: PeriodMap,
    options: StepOptions,
    start: np.ndarray,
    with_parameter_derivatives: bool,
    tolerance: float,
    is_requested: np.ndarray,
    newton_options: ContactNewtonOptions,
    stops_at_small_correction: bool = True,
) -> tuple[_FixedPoints, np.ndarray]:
    """Run Newton's method on the requested wheels until corrections are small; return the solution
    and Jacobians.

    A correction after which no period completes is halved. A small correction ends the iteration if
    `stops_at_small_correction` is set. Otherwise another evaluation follows, which gives the gait
    at the corrected state. Then a small correction must occur twice in succession, because the map
    may jump between two states if a foot grazes the ground.
    """
    n_wheels, n_legs = len(start), period_map.n_legs
    section_states, last_section_states, units = (
        start.copy(),
        start.copy(),
        period_map.section_units,
    )
    residual, n_iterations = np.full(n_wheels, np.inf), np.zeros(n_wheels, np.int32)
    has_small_correction, is_found, n_halvings = (
        np.zeros(n_wheels, dtype) for dtype in (bool, bool, int)
    )
    return_jacobian = np.zeros((n_wheels, start.shape[1], start.shape[1]))
    active_indices, stored_results = np.arange(n_wheels), None
    for _ in range(newton_options.max_iterations + newton_options.max_halvings):
        period = period_map.select(active_indices).evaluate_period(
            options, section_states[active_indices], with_parameter_derivatives
        )
        if stored_results is None:
            stored_results = jax.tree.map(np.array, (period.steps, period.step_jacobians))
        for stored_leaf, new_leaf in zip(
            jax.tree.leaves(stored_results), jax.tree.leaves(period[:2]), strict=True
        ):
            stored_leaf[active_indices] = new_leaf
        correction = period.newton_correction(
            section_states[active_indices], period.return_jacobian
        )
        correction_size = np.abs(correction / units[active_indices]).max(-1)
        is_valid = period.is_valid & np.isfinite(correction).all(-1)
        residual[active_indices] = np.abs(
            (period.end_state - section_states[active_indices]) / units[active_indices]
        ).max(-1)
        return_jacobian[active_indices] = period.return_jacobian
        n_iterations[active_indices] += 1
        has_small_correction_now = is_valid & (correction_size <= tolerance)
        is_done = (
            has_small_correction_now
            & (
                has_small_correction[active_indices]
                | (correction_size <= newton_options.clear_convergence_factor * tolerance)
            )
            & (not stops_at_small_correction)
        )
        has_small_correction[active_indices] = has_small_correction_now
        moving_indices = active_indices[is_valid & ~is_done]
        last_section_states[moving_indices], n_halvings[moving_indices] = (
            section_states[moving_indices],
            0,
        )
        section_states[moving_indices] += correction[is_valid & ~is_done]
        failed_indices = active_indices[~is_valid]
        section_states[failed_indices] = 0.5 * (
            section_states[failed_indices] + last_section_states[failed_indices]
        )
        n_halvings[failed_indices] += 1
        section_states[failed_indices, -n_legs:] = last_section_states[failed_indices, -n_legs:]
        is_found[active_indices] = is_requested[active_indices] & (
            has_small_correction[active_indices] if stops_at_small_correction else is_done
        )
        has_failed = (
            (n_halvings > newton_options.max_halvings)
            | (n_iterations > newton_options.max_iterations)
            | ~is_requested
        )
        active_indices = active_indices[~is_found[active_indices] & ~has_failed[active_indices]]
        if not len(active_indices):
            break
    assert stored_results is not None
    return _FixedPoints(
        section_states, stored_results[0], stored_results[1], residual, is_found, n_iterations
    ), return_jacobian


@eqx.filter_jit
def _map_over_wheels(
    evaluate_wheel: Callable,
    model: AbstractWheel,
    n_legs: int,
    values: Array,
    fixed_points: _FixedPoints,
) -> Any:
    """Return `evaluate_wheel` of each wheel, compiled for the batch."""
    return eqx.filter_vmap(
        lambda values, fixed_points: evaluate_wheel(model, n_legs, values, fixed_points)
    )(values, fixed_points)


def _return_jacobian(fixed_points: _FixedPoints, n_values: int) -> Array:
    """Return the Jacobian of the return map over one period."""
    return_jacobian = jnp.eye(fixed_points.x.shape[0], dtype=fixed_points.x.dtype)
    for jacobian in fixed_points.step_jacobians.section_state:
        return_jacobian = jacobian[:, n_values:] @ return_jacobian
    return return_jacobian


def _make_cycle(
    model: AbstractWheel, n_legs: int, values: Array, fixed_points: _FixedPoints
) -> ReturnMapCycle:
    """Return the cycle of a fixed point."""
    diagnostics = fixed_points.residual, fixed_points.converged, fixed_points.n_iterations
    params = model.from_values(values, n_legs)[1]
    fixed_point = FixedPointResult(
        fixed_points.x, _return_jacobian(fixed_points, len(values)), *diagnostics
    )
    return make_cycle(params, fixed_point, fixed_points.steps)


def _make_gait(
    model: AbstractWheel, n_legs: int, values: Array, fixed_points: _FixedPoints
) -> Gait:
    """Return the gait of a fixed point, with derivatives by the implicit function theorem."""
    n_values = values.shape[0]
    identity = jnp.eye(fixed_points.x.shape[0], dtype=fixed_points.x.dtype)
    value_jacobian = jnp.zeros((len(identity), n_values), identity.dtype)
    return_jacobian = _return_jacobian(fixed_points, n_values)
    for jacobian in fixed_points.step_jacobians.section_state:
        value_jacobian = jacobian[:, :n_values] + jacobian[:, n_values:] @ value_jacobian
    newton_matrix = jnp.where(fixed_points.converged, identity - return_jacobian, identity)
    d_section_state = jnp.linalg.solve(newton_matrix, value_jacobian)

    d_state, d_steps = d_section_state, []
    for step_index in range(len(fixed_points.step_jacobians.section_state)):
        input_tangents = jnp.concatenate([jnp.eye(n_values, dtype=identity.dtype), d_state])
        step_tangents = jax.tree.map(
            lambda leaf, step_index=step_index, input_tangents=input_tangents: (
                leaf[step_index] @ input_tangents
            ),
            fixed_points.step_jacobians,
        )
        d_steps.append(move_derivative_axis_first(step_tangents))
        d_state = step_tangents.section_state
    d_step = jax.tree.map(lambda *leaves: jnp.stack(leaves, 1), *d_steps)

    cycle = _make_cycle(model, n_legs, values, fixed_points)
    # The derivative of the Jacobian is unknown, so measures of the Jacobian are not in
    # `differentiable_measures`.
    float_fields = eqx.filter(cycle, eqx.is_inexact_array)
    zero_tangents = jax.tree.map(lambda x: jnp.zeros((n_values, *x.shape), x.dtype), float_fields)
    d_cycle = eqx.tree_at(
        lambda c: (c.section_state, c.steps, c.post_impact, c.durations, c.step_length),
        zero_tangents,
        (d_section_state.T, d_step, *jax.vmap(summarize_steps)(d_step)),
    )
    first_step = jax.tree.map(lambda leaf: leaf[0], fixed_points.steps)
    d_first_step = jax.tree.map(lambda leaf: leaf[:, 0], d_step)
    return make_gait(model, n_legs, cycle, first_step, d_cycle, d_first_step)
