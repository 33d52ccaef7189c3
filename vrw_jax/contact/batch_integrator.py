"""Batched integration between events: each lane has its own step size and contact state.

Arrays have lanes on the last axis. One Runge-Kutta step serves integration and event search: a lane
whose step crosses a guard repeats the step with smaller sizes until the step ends at the earliest
event. No computation in this module combines values of different lanes.

The *initiating guard* of a contact state is the guard whose zero is the event that started this
state. The guard of a foot that has just lifted off is an example.
"""

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from vrw_jax.contact.contact_state import (
    ContactQuantities,
    ContactState,
    ModeDynamics,
    accumulator_rates,
    collect_contact_quantities,
    compute_forces,
    compute_guard_scales,
    compute_state_units,
    evaluate_guards,
)
from vrw_jax.contact.mechanics import WheelMotion, leg_directions, opaque_one, prevent_fusion
from vrw_jax.hybrid import GUARD_ROUNDOFF_IN_EPS
from vrw_jax.integrator import (
    ButcherTableau,
    compute_step_size_factor,
    find_guard_minimum,
    fit_guard_parabola,
)
from vrw_jax.numerics import StepOptions, select_tree_leaves
from vrw_jax.wheel import Outcome, Symbols, compute_wheel_units

N_CONTACT_ROWS = 9
"""Number of dynamics rows that hold the contact quantities of the guards. They follow the
accelerations. Stopper forces of legs in the air follow if stoppers are one-sided, then
`N_ACCUMULATOR_ROWS` rows if these are requested."""
N_ACCUMULATOR_ROWS = 3
"""Number of rows of accumulators: energy lost in dampers, energy lost by sliding, slip."""


class LaneStatus(IntEnum):
    """Status of a lane between two events; a non-negative status is an `Outcome`."""

    RUNNING = -1
    EVENT = -2


@dataclass(frozen=True)
class IntervalOptions:
    """Options of the search for events with unilateral contact, and of the loop over lanes."""

    max_wait_attempts: int = 8
    """Number of attempted solver steps after which a lane at an event ends the loop for all lanes.
    """
    painleve_atol: float = 1e-8
    """Absolute value below which the determinant counts as zero at Painlevé's singularity.

    There, forces are a ratio of two vanishing numbers, which neither round-off nor integration
    resolves."""
    painleve_rtol_factor: float = 1e2
    """Factor of the relative tolerance that is added to `painleve_atol`.

    The value is chosen because one singularity was missed with a factor of 18."""
    n_parabola_iterations: int = 3
    """Number of event iterations with parabolas. The later ones use secants, which converge better
    if a guard is below zero for a short time."""
    min_iterations_of_initiating_guard: int = 15
    """Number of event iterations after which an initiating guard can be the event."""
    max_roundoff_fall_time: float = 1e-3
    """Time in which a guard that counts as falling falls by its own round-off. The value is in the
    wheel's unit of time: seconds for a wheel of Table 1's size."""
    event_time_tolerance_factor: float = 30.0
    """Largest last correction to the time of an event, in tolerances of the step.

    The value is chosen because the error of a parabola's root is about a hundredth of the
    correction."""


INTERVAL_OPTIONS = IntervalOptions()


class IntervalPoint(NamedTuple):
    """Coordinates (hub x, z, theta, lengths), rates and dynamics rows of all lanes at one time."""

    q: Array  # (3 + n, lanes)
    v: Array
    dynamics_rows: Array  # accelerations, contact rows: (3 + n + 9 [+ n] [+ 3], lanes)


class EventBracket(NamedTuple):
    """Bracket of the earliest event inside a step, and the last attempt of the search."""

    is_active: Array
    is_crossing: Array  # whether a guard crosses zero in the bracket, (guards, lanes)
    low_h: Array  # bracket of the event, s from the start of the step
    high_h: Array
    time_tolerance: Array  # s
    n_iterations: Array
    previous_h: Array  # size of the previous attempt, s
    guard_values: Array  # at the end of the previous attempt, (guards, lanes)


class IntervalState(NamedTuple):
    """State of all lanes between two of their events."""

    point: IntervalPoint
    contact_state: ContactState
    guard_values: Array  # at the point, (guards, lanes)
    guard_offset: Array  # initial value of an initiating guard, minus round-off; else 0
    # integrals since the last event, (N_ACCUMULATOR_ROWS, lanes)
    interval_accumulators: Array | None
    h: Array  # of the next attempt, s
    time: Array  # since the last event, s
    event_bracket: EventBracket
    status: Array  # `LaneStatus` or `Outcome`
    triggered_guard: Array  # index of the guard that has triggered
    n_solver_steps: Array  # number of attempts since the last event


def motion_from_point(point: IntervalPoint) -> WheelMotion:
    """Return the motion at a point of an interval."""
    x, z, theta, L = point.q[0], point.q[1], point.q[2], point.q[3:]
    return WheelMotion(x, z, theta, point.v[0], point.v[1], point.v[2], L, point.v[3:])


def make_point(dynamics: ModeDynamics, motion: WheelMotion) -> IntervalPoint:
    """Return the point of a motion, with its dynamics rows: the inverse of `motion_from_point`."""
    q, v = pack_coordinates(motion)
    return IntervalPoint(q, v, evaluate_dynamics(dynamics, q, v))


def pack_coordinates(motion: WheelMotion) -> tuple[Array, Array]:
    """Return the coordinates of a motion and their rates, as two arrays (3 + n, ...)."""
    q = jnp.concatenate([jnp.stack([motion.x, motion.z, motion.theta]), motion.L])
    return q, jnp.concatenate([jnp.stack([motion.vx, motion.vz, motion.dtheta]), motion.dL])


def evaluate_dynamics(dynamics: ModeDynamics, q: Array, v: Array) -> Array:
    """Return the dynamics rows: accelerations, contact quantities, and accumulator rates if
    requested.

    The axes are (rows, lanes). Leg directions are not among the contact quantities.
    """
    motion = motion_from_point(IntervalPoint(q, v, q))
    forces = compute_forces(dynamics, motion)
    quantities = collect_contact_quantities(dynamics, forces)
    contact_rows = [
        *quantities.normal,
        *quantities.tangential,
        *quantities.stopper,
        *quantities.slip_speed,
        quantities.painleve_determinant,
    ]
    optional_rows = [] if quantities.airborne_stopper is None else [quantities.airborne_stopper]
    if dynamics.has_accumulators:
        accumulators = accumulator_rates(dynamics, motion, forces)
        accumulator_rows = (
            accumulators.damping_loss,
            accumulators.friction_loss,
            accumulators.slip_length,
        )
        optional_rows.append(jnp.stack(prevent_fusion(accumulator_rows, opaque_one(motion))))
    return jnp.concatenate(
        [
            jnp.stack(forces.solution.hub_vector),
            forces.solution.length_motion,
            jnp.stack(contact_rows),
            *optional_rows,
        ]
    )


def evaluate_guards_at_point(dynamics: ModeDynamics, point: IntervalPoint) -> Array:
    """Return all guards in the order of `GuardLayout`, (guards, lanes).

    The point is after the start of the contact state, so that all guards are evaluated.
    """
    motion = motion_from_point(point)
    contact_rows = point.dynamics_rows[len(point.q) :]
    n1, n2, t1, t2, s1, s2, x1, x2, painleve_determinant = contact_rows[:N_CONTACT_ROWS]
    airborne_stopper = (
        contact_rows[N_CONTACT_ROWS : N_CONTACT_ROWS + dynamics.s.n]
        if dynamics.is_one_sided
        else None
    )
    directions, slot_pairs = (
        leg_directions(dynamics.s, motion.theta),
        ((n1, n2), (t1, t2), (s1, s2), (x1, x2)),
    )
    quantities = ContactQuantities(directions, *slot_pairs, painleve_determinant, airborne_stopper)
    is_after_start = jnp.ones(point.q.shape[-1:], bool)
    return jnp.concatenate(evaluate_guards(dynamics, motion, quantities, is_after_start))


def compute_guard_rates(dynamics: ModeDynamics, point: IntervalPoint) -> Array:
    """Return the time derivatives of the guards along the motion, (guards, lanes)."""

    def evaluate_guards_at(q: Array, v: Array) -> Array:
        return evaluate_guards_at_point(
            dynamics, IntervalPoint(q, v, evaluate_dynamics(dynamics, q, v))
        )

    return jax.jvp(
        evaluate_guards_at, (point.q, point.v), (point.v, point.dynamics_rows[: len(point.q)])
    )[1]


def find_initiating_guards(dynamics: ModeDynamics) -> Array:
    """Return whether each guard is the initiating guard of the contact state, (guards, lanes)."""
    contact_state = dynamics.contact_state
    has_just_slid = dynamics.contact_slots.gather_flags(contact_state.has_just_slid)
    no_slot_flags = jnp.zeros((2, contact_state.contact_modes.shape[-1]), bool)
    airborne_release_flags = [contact_state.locked & False] if dynamics.is_one_sided else []
    return jnp.concatenate(
        [
            contact_state.has_just_lifted,
            contact_state.has_just_unlocked,
            no_slot_flags,
            no_slot_flags,
            no_slot_flags,
            has_just_slid,
            no_slot_flags,
            no_slot_flags,
            *airborne_release_flags,
        ]
    )


@eqx.filter_jit  # This function is traced once for all call sites.
def init_interval(
    dynamics: ModeDynamics,
    motion: WheelMotion,
    h: Array,
    interval_options: IntervalOptions = INTERVAL_OPTIONS,
) -> IntervalState:
    """Return the lanes at the start of a contact state.

    A lane is at an event again if one of its guards falls immediately.

    - `h`: size of the first attempt in the wheel's unit of time.
    """
    start_point, is_initiating = make_point(dynamics, motion), find_initiating_guards(dynamics)
    guard_values, guard_rates = (
        evaluate_guards_at_point(dynamics, start_point),
        compute_guard_rates(dynamics, start_point),
    )
    # The guard of a contact released from rest is within round-off for 1e-8 s and longer. A guard
    # that rises from below zero has no event before it falls. Several events at one time leave
    # several such guards.
    roundoff = compute_guard_scales(dynamics) * (
        GUARD_ROUNDOFF_IN_EPS * jnp.finfo(guard_values.dtype).eps
    )
    time_unit = compute_wheel_units(dynamics.s).time_unit
    min_guard_rate = -roundoff / (interval_options.max_roundoff_fall_time * time_unit)
    is_initiating = is_initiating | ((guard_values <= roundoff) & (guard_rates > min_guard_rate))
    is_triggered = ~is_initiating & (
        (guard_values < 0.0) | ((guard_values == 0.0) & (guard_rates <= 0.0))
    )
    triggered_guard = jnp.zeros(is_triggered.shape[1:], jnp.int32)
    for guard_index in reversed(range(len(is_triggered))):
        triggered_guard = jnp.where(is_triggered[guard_index], guard_index, triggered_guard)
    guard_offset = jnp.where(is_initiating, guard_values - 2.0 * roundoff, 0.0)
    float_zeros, int_zeros = jnp.zeros_like(motion.x), jnp.zeros(motion.x.shape, jnp.int32)
    return IntervalState(
        point=start_point,
        contact_state=dynamics.contact_state,
        guard_values=guard_values - guard_offset,
        guard_offset=guard_offset,
        interval_accumulators=jnp.zeros((N_ACCUMULATOR_ROWS, *float_zeros.shape), float_zeros.dtype)
        if dynamics.has_accumulators
        else None,
        h=float_zeros + h * time_unit,
        time=float_zeros,
        event_bracket=EventBracket(
            int_zeros > 0,
            jnp.zeros_like(is_initiating),
            float_zeros,
            float_zeros,
            float_zeros,
            int_zeros,
            float_zeros,
            guard_values,
        ),
        status=jnp.where(
            jnp.any(is_triggered, axis=0), LaneStatus.EVENT, LaneStatus.RUNNING
        ).astype(jnp.int32),
        triggered_guard=triggered_guard,
        n_solver_steps=int_zeros,
    )


DynamicsFn = Callable[[Array], ModeDynamics]
"""Function from the input columns of the lanes to the dynamics of their contact states."""


def integrate_interval(
    dynamics_fn: DynamicsFn,
    input_columns: Array,
    initial_state: IntervalState,
    has_unfinished_walk: Array,
    options: StepOptions,
    tableau: ButcherTableau,
) -> IntervalState:
    """Return the lanes integrated until none is running.

    After `max_wait_attempts` attempts, the loop ends as soon as a lane with an unfinished walk is
    at an event.

    - `input_columns`: parameters, friction and uneven ground, (columns, lanes).
    """
    dynamics = dynamics_fn(input_columns)
    guard_scales, options = (
        compute_guard_scales(dynamics),
        compute_wheel_units(dynamics.s).scale_times_to_seconds(options),
    )

    def try_step(state: IntervalState) -> IntervalState:
        return integrator_step(
            state,
            attempt_solver_step(dynamics, tableau, options, state),
            guard_scales,
            tableau,
            options,
        )

    return iterate_until_stopped(
        lambda state: state.status == LaneStatus.RUNNING,
        has_unfinished_walk,
        try_step,
        initial_state,
    )


def iterate_until_stopped(
    is_running: Callable[[Any], Array],
    has_unfinished_walk: Array,
    advance_state: Callable,
    initial_state: Any,
    max_wait_attempts: int = INTERVAL_OPTIONS.max_wait_attempts,
) -> Any:
    """Return the state after `advance_state` has been applied until no lane is running.

    After `max_wait_attempts` attempts, the loop ends as soon as a lane with an unfinished walk has
    stopped.
    """

    def should_continue(loop_state: tuple) -> Array:
        lane_state, n_attempts = loop_state
        is_active = is_running(lane_state)
        has_stopped = jnp.any(has_unfinished_walk & ~is_active)
        return jnp.any(is_active) & ((n_attempts < max_wait_attempts) | ~has_stopped)

    n_initial = jnp.zeros((), jnp.int32)
    advance_loop = lambda loop_state: (advance_state(loop_state[0]), loop_state[1] + 1)
    return lax.while_loop(should_continue, advance_loop, (initial_state, n_initial))[0]


class AttemptedSolverStep(NamedTuple):
    """Result of one attempted solver step of every lane."""

    end_point: IntervalPoint
    squared_error: Array  # mean square of the error over the tolerance
    guard_values: Array  # at the end of the step, (guards, lanes)
    parabola_curvature: Array  # of the parabola through each guard, (guards, lanes)
    parabola_linear_term: Array
    minimum_fraction: Array  # fraction of the step to a negative guard minimum, else 1
    accumulator_increments: Array | None  # increment of `IntervalState.interval_accumulators`


def compute_stage_state(
    tableau: ButcherTableau, i: Array | int, q: Array, v: Array, stage_rows: Array, h: Array
) -> tuple[Array, Array]:
    """Return coordinates and rates at stage i, from the accelerations of the earlier stages.

    - `h`: step size, s.
    """
    a, b, node = (
        jnp.asarray(x)[i] for x in (tableau.matrix, tableau.matrix_squared, tableau.nodes)
    )
    n, n_previous = len(q), len(tableau.nodes) - 1
    rate_increment = sum(a[j] * stage_rows[j, :n] for j in range(n_previous))
    coordinate_increment = sum(b[j] * stage_rows[j, :n] for j in range(n_previous))
    return q + h * (node * v + h * coordinate_increment), v + h * rate_increment


def attempt_solver_step(
    dynamics: ModeDynamics, tableau: ButcherTableau, options: StepOptions, state: IntervalState
) -> AttemptedSolverStep:
    """Return one attempted step of every lane."""
    h, start_point, last_stage = state.h, state.point, len(tableau.nodes) - 1

    def evaluate_stage_dynamics(i: Array, stage_rows: Array) -> Array:
        stage_row = evaluate_dynamics(
            dynamics, *compute_stage_state(tableau, i, start_point.q, start_point.v, stage_rows, h)
        )
        return lax.dynamic_update_index_in_dim(stage_rows, stage_row, i, 0)

    later_stage_rows = jnp.zeros((last_stage, *start_point.dynamics_rows.shape), h.dtype)
    stage_rows = jnp.concatenate([start_point.dynamics_rows[None], later_stage_rows])
    stage_rows = lax.fori_loop(1, last_stage + 1, evaluate_stage_dynamics, stage_rows)
    return complete_solver_step(dynamics, tableau, options, state, stage_rows)


def complete_solver_step(
    dynamics: ModeDynamics,
    tableau: ButcherTableau,
    options: StepOptions,
    state: IntervalState,
    stage_rows: Array,
) -> AttemptedSolverStep:
    """Return the attempted step whose dynamics rows at all stages are `stage_rows`."""
    h, start_point, last_stage = state.h, state.point, len(tableau.nodes) - 1
    n = len(start_point.q)
    end_point = IntervalPoint(
        *compute_stage_state(tableau, last_stage, start_point.q, start_point.v, stage_rows, h),
        stage_rows[last_stage],
    )
    accumulator_increments = None
    if dynamics.has_accumulators:
        accumulator_increments = h * sum(
            tableau.matrix[last_stage][j] * stage_rows[j, -N_ACCUMULATOR_ROWS:]
            for j in range(last_stage)
        )
    inner_stage_points = {
        i: IntervalPoint(
            *compute_stage_state(tableau, i, start_point.q, start_point.v, stage_rows, h),
            stage_rows[i],
        )
        for i in tableau.guard_stages
    }
    guard_points = *inner_stage_points.values(), end_point
    *inner_guard_values, end_guard_values = (
        evaluate_guards_at_point(dynamics, guard_point) - state.guard_offset
        for guard_point in guard_points
    )
    sum_stages = lambda weights: sum(
        float(w) * stage_rows[j, :n] for j, w in enumerate(weights) if w != 0.0
    )
    error_estimates = h * h * sum_stages(tableau.b_error_position), h * sum_stages(tableau.b_error)
    squared_error = _compute_squared_error(
        dynamics.s, options, error_estimates, start_point, guard_points[-1], end_guard_values
    )
    middle_guard_values = (
        inner_guard_values[tableau.guard_stages.index(tableau.middle_stage)]
        if inner_guard_values
        else state.guard_values
    )
    parabola_terms = fit_guard_parabola(
        tableau, state.guard_values, middle_guard_values, end_guard_values
    )
    minimum_fraction = _find_earliest_minimum(
        tableau, [state.guard_values, *inner_guard_values, end_guard_values], _is_initiating(state)
    )
    return AttemptedSolverStep(
        end_point,
        squared_error,
        end_guard_values,
        *parabola_terms,
        minimum_fraction,
        accumulator_increments,
    )


def is_at_singularity(
    value_before: Array,
    value_after: Array,
    options: StepOptions,
    interval_options: IntervalOptions = INTERVAL_OPTIONS,
) -> Array:
    """Return whether a determinant vanishes between two times, which is Painlevé's singularity.

    - `value_before`, `value_after`: the determinant at the two times.
    """
    atol, rtol_factor = interval_options.painleve_atol, interval_options.painleve_rtol_factor
    is_zero = jnp.abs(value_after) <= atol + rtol_factor * options.rtol
    return (value_before * value_after <= 0.0) | is_zero


def integrator_step(
    state: IntervalState,
    attempt: AttemptedSolverStep,
    guard_scales: Array,
    tableau: ButcherTableau,
    options: StepOptions,
    interval_options: IntervalOptions = INTERVAL_OPTIONS,
) -> IntervalState:
    """Return the lanes after one attempted solver step.

    A lane accepts the step, repeats the step with another size, or stops at an event.
    """
    start_point, h, event_bracket, end_point = (
        state.point,
        state.h,
        state.event_bracket,
        attempt.end_point,
    )
    is_running = state.status == LaneStatus.RUNNING
    is_accurate = is_running & ~event_bracket.is_active & (attempt.squared_error <= 1.0)
    needs_retry = (
        is_accurate
        & (attempt.minimum_fraction < 1.0)
        & (state.time + h * attempt.minimum_fraction > state.time)
    )
    has_crossed = is_accurate & ~needs_retry & jnp.any(attempt.guard_values <= 0.0, axis=0)
    is_accepted = is_accurate & ~needs_retry & ~has_crossed
    next_bracket, event = _search_event(
        state, attempt, has_crossed, guard_scales, options, interval_options
    )
    has_reached_event = event.has_reached_event
    step_size_ratio = jnp.where(
        needs_retry,
        attempt.minimum_fraction,
        compute_step_size_factor(tableau, attempt.squared_error, h.dtype),
    )
    # The last step ends exactly at the time limit.
    time_limit = options.max_phase_time
    end_time = jnp.where(is_accepted & (h == time_limit - state.time), time_limit, state.time + h)
    reached_time = jnp.where(is_accepted, end_time, state.time)
    next_integration_h = jnp.minimum(h * step_size_ratio, time_limit - reached_time)
    next_h = jnp.where(event_bracket.is_active | has_crossed, event.next_h, next_integration_h)

    time_shift = jnp.where(has_reached_event, event.time_shift, 0.0)
    end_point = IntervalPoint(
        end_point.q + time_shift * end_point.v,
        end_point.v + time_shift * end_point.dynamics_rows[: len(end_point.q)],
        end_point.dynamics_rows,
    )
    is_state_updated = is_accepted | has_reached_event
    interval_accumulators = state.interval_accumulators
    if interval_accumulators is not None and attempt.accumulator_increments is not None:
        interval_accumulators = interval_accumulators + jnp.where(
            is_state_updated, attempt.accumulator_increments, 0.0
        )
    time = jnp.where(is_state_updated, end_time + time_shift, state.time)
    is_past_time_limit = is_accepted & (time >= time_limit)
    is_past_time_limit = is_past_time_limit | (has_reached_event & (time > time_limit))
    has_failed = (next_bracket.n_iterations >= options.max_event_iterations) | (
        state.n_solver_steps + 1 >= options.max_solver_steps
    )
    has_failed = has_failed | (~event_bracket.is_active & (state.time + next_h == state.time))
    determinant_row = len(start_point.q) + N_CONTACT_ROWS - 1
    determinant_before = start_point.dynamics_rows[determinant_row]
    determinant_after = end_point.dynamics_rows[determinant_row]
    status = jnp.where(has_failed, Outcome.SOLVER_FAILED, LaneStatus.RUNNING)
    status = jnp.where(has_reached_event, LaneStatus.EVENT, status)
    status = jnp.where(is_past_time_limit, Outcome.NO_TOUCHDOWN_IN_TIME, status)
    is_singular = is_state_updated & is_at_singularity(
        determinant_before, determinant_after, options, interval_options
    )
    status = jnp.where(is_singular, Outcome.PAINLEVE_PARADOX, status)
    return state._replace(
        point=select_tree_leaves(is_state_updated, end_point, start_point),
        guard_values=jnp.where(is_accepted, attempt.guard_values, state.guard_values),
        interval_accumulators=interval_accumulators,
        h=jnp.where(is_running, next_h, h),
        time=time,
        event_bracket=select_tree_leaves(is_running, next_bracket, event_bracket),
        status=jnp.where(is_running, status, state.status).astype(jnp.int32),
        triggered_guard=jnp.where(has_reached_event, event.guard, state.triggered_guard),
        n_solver_steps=state.n_solver_steps + is_running,
    )


class _LocatedEvent(NamedTuple):
    """Result of one iteration of the search for the earliest event inside a step."""

    next_h: Array  # step size of the next attempt, s
    time_shift: Array  # correction from this step size to that of the event, s
    has_reached_event: Array  # whether the event is within tolerance
    guard: Array


def _search_event(
    state: IntervalState,
    attempt: AttemptedSolverStep,
    has_crossed: Array,
    guard_scales: Array,
    options: StepOptions,
    interval_options: IntervalOptions,
) -> tuple[EventBracket, _LocatedEvent]:
    """Return the bracket after one more iteration, and the event if the iteration has located one.

    The proposed step size is a zero of the guards' parabolas or secants.
    """
    h, bracket = state.h, state.event_bracket
    is_below_zero = attempt.guard_values <= 0.0
    is_crossing = jnp.where(bracket.is_active, bracket.is_crossing | is_below_zero, is_below_zero)
    parabolas = state.guard_values, attempt.parabola_linear_term, attempt.parabola_curvature
    root_fraction, guard = _find_earliest_root(*parabolas, is_crossing, _is_initiating(state))
    secant_h, secant_guard = _find_earliest_secant_root(
        bracket, attempt.guard_values, h, is_crossing
    )
    uses_secant = bracket.is_active & (
        bracket.n_iterations >= interval_options.n_parabola_iterations
    )
    proposed_h = jnp.where(uses_secant, secant_h, h * root_fraction)
    guard = jnp.where(uses_secant, secant_guard, guard)
    is_past_crossing = jnp.any(is_crossing & is_below_zero, axis=0)
    low_h = jnp.where(bracket.is_active & ~is_past_crossing, h, bracket.low_h)
    high_h = jnp.where(bracket.is_active & is_past_crossing, h, bracket.high_h)
    low_h, high_h = jnp.where(has_crossed, 0.0, low_h), jnp.where(has_crossed, h, high_h)
    time_resolution = 1e3 * jnp.finfo(h.dtype).eps * (state.time + h)
    time_tolerance = jnp.maximum(
        interval_options.event_time_tolerance_factor * options.rtol * h, time_resolution
    )
    time_tolerance = jnp.where(bracket.is_active, bracket.time_tolerance, time_tolerance)
    is_in_bracket = (proposed_h >= low_h - time_tolerance) & (proposed_h <= high_h + time_tolerance)
    # If a guard is below zero for microseconds only, round-off moves proposals out of the bracket.
    # The bracket is then bisected.
    needs_bisection = ~is_in_bracket | (uses_secant & ((bracket.n_iterations & 3) == 3))
    # An initiating guard falls again soon, or not at all.
    bisection_h = jnp.where(
        (low_h == 0.0) & jnp.isinf(proposed_h), 0.125 * high_h, 0.5 * (low_h + high_h)
    )
    next_h = jnp.where(needs_bisection, bisection_h, proposed_h)
    time_shift = next_h - h
    # If a guard is within its round-off, no other step size is better than this one.
    lowest_guard, lowest_value = _find_lowest_guard(
        attempt.guard_values / guard_scales, is_crossing
    )
    # An initiating guard is within twice its round-off. Without another event, the guard is the
    # event.
    guard_roundoff = (
        GUARD_ROUNDOFF_IN_EPS
        * jnp.where(
            bracket.n_iterations < interval_options.min_iterations_of_initiating_guard, 1.0, 3.0
        )
        * jnp.finfo(h.dtype).eps
    )
    is_guard_within_roundoff = bracket.is_active & (jnp.abs(lowest_value) <= guard_roundoff)
    time_shift = jnp.where(is_guard_within_roundoff, 0.0, time_shift)
    guard = jnp.where(is_guard_within_roundoff, lowest_guard, guard)
    is_within_tolerance = bracket.is_active & (jnp.abs(time_shift) <= time_tolerance)
    n_iterations = jnp.where(bracket.is_active, bracket.n_iterations + 1, 0)
    is_active = (bracket.is_active | has_crossed) & ~is_within_tolerance
    next_bracket = EventBracket(
        is_active, is_crossing, low_h, high_h, time_tolerance, n_iterations, h, attempt.guard_values
    )
    return next_bracket, _LocatedEvent(
        next_h, time_shift, is_within_tolerance & (state.status == LaneStatus.RUNNING), guard
    )


def _compute_squared_error(
    s: Symbols,
    options: StepOptions,
    error_estimates: tuple[Array, Array],
    start_point: IntervalPoint,
    end_point: IntervalPoint,
    guard_values: Array,
) -> Array:
    """Return the mean square of the error over its tolerance; infinite for a step that is not
    finite.
    """
    total_error = 0.0 * jnp.sum(guard_values, axis=0)
    units = compute_state_units(s)
    for error, a, b, coordinate_unit in zip(
        error_estimates, start_point[:2], end_point[:2], units, strict=True
    ):
        tolerance = options.atol * coordinate_unit + options.rtol * jnp.maximum(
            jnp.abs(a), jnp.abs(b)
        )
        total_error = total_error + jnp.sum(jnp.square(error / tolerance), axis=0)
    return jnp.where(jnp.isfinite(total_error), total_error / (2 * start_point.q.shape[0]), jnp.inf)


def _is_initiating(state: IntervalState) -> Array:
    """Return whether each guard is an initiating guard and the lane is at the start of its
    interval.
    """
    return (state.time == 0.0) & (state.guard_offset != 0.0)


def _find_earliest_minimum(
    tableau: ButcherTableau, guard_values: list[Array], is_initiating: Array
) -> Array:
    """Return the fraction of the step to the earliest negative minimum of a guard; 1 without such a
    minimum.

    A guard that is positive at both ends of a step may be negative between them: see
    `integrator.find_guard_minimum`. Initiating guards are not considered.
    """
    has_minimum, minimum_fraction = find_guard_minimum(tableau, guard_values)
    return jnp.min(
        jnp.where(has_minimum & (guard_values[0] > 0.0) & ~is_initiating, minimum_fraction, 1.0),
        axis=0,
    )


def _find_lowest_guard(guard_values: Array, is_crossing: Array) -> tuple[Array, Array]:
    """Return the index of the lowest guard that crosses zero, and its value; infinite if none
    crosses.
    """
    lowest_value, guard = (
        jnp.full_like(guard_values[0], jnp.inf),
        jnp.zeros(guard_values.shape[1:], jnp.int32),
    )
    for guard_index in range(len(guard_values)):
        is_lower = is_crossing[guard_index] & (guard_values[guard_index] < lowest_value)
        lowest_value = jnp.where(is_lower, guard_values[guard_index], lowest_value)
        guard = jnp.where(is_lower, guard_index, guard)
    return guard, lowest_value


def _find_earliest_secant_root(
    bracket: EventBracket, guard_values: Array, h: Array, is_crossing: Array
) -> tuple[Array, Array]:
    """Return the step size (s) at the earliest zero of the crossing guards' secants, and the
    guard's index.

    The secants go through the last two attempts, because their ends are as accurate as the
    integration and inner stages are not. The step size is infinite if no guard falls. It is minus
    infinity if a guard is below zero and does not fall, because the guard fell earlier.
    """
    secant_slope = (guard_values - bracket.guard_values) / jnp.where(
        h == bracket.previous_h, jnp.inf, h - bracket.previous_h
    )
    earliest_h, guard = jnp.full_like(h, jnp.inf), jnp.zeros(h.shape, jnp.int32)
    for guard_index in range(len(guard_values)):
        is_falling = is_crossing[guard_index] & (secant_slope[guard_index] < 0.0)
        root_h = h - guard_values[guard_index] / jnp.where(
            is_falling, secant_slope[guard_index], 1.0
        )
        is_already_below = (
            is_crossing[guard_index] & ~is_falling & (guard_values[guard_index] < 0.0)
        )
        root_h = jnp.where(is_already_below, -jnp.inf, root_h)
        is_earlier = (is_falling | is_already_below) & (root_h < earliest_h)
        earliest_h = jnp.where(is_earlier, root_h, earliest_h)
        guard = jnp.where(is_earlier, guard_index, guard)
    return earliest_h, guard


def _find_earliest_root(
    g0: Array, linear_term: Array, curvature: Array, is_crossing: Array, is_initiating: Array
) -> tuple[Array, Array]:
    """Return the earliest zero of the crossing guards' parabolas, as a fraction of the step, and
    the guard's index.

    The zero is infinite if no parabola falls ahead. An initiating guard rises first: if its
    parabola falls at once, the step is too long for parabolas. The zero is minus infinity if such a
    parabola ends below zero.
    """
    discriminant = linear_term * linear_term - 4.0 * curvature * g0
    sqrt_discriminant = jnp.sqrt(jnp.maximum(discriminant, 0.0))
    is_falling = linear_term < 0.0
    numerator = jnp.where(is_falling, 2.0 * g0, -linear_term - sqrt_discriminant)
    denominator = jnp.where(is_falling, sqrt_discriminant - linear_term, 2.0 * curvature)
    root_fraction = numerator / jnp.where(denominator == 0.0, 1.0, denominator)
    has_root = is_crossing & (discriminant >= 0.0) & (denominator != 0.0) & (root_fraction > 0.0)
    has_root = has_root & ~(is_initiating & is_falling)
    is_already_below = is_crossing & ~has_root & (g0 + linear_term + curvature < 0.0)
    root_fraction, has_root = (
        jnp.where(is_already_below, -jnp.inf, root_fraction),
        has_root | is_already_below,
    )
    earliest_fraction = jnp.full_like(root_fraction[0], jnp.inf)
    guard = jnp.zeros(root_fraction.shape[-1:], jnp.int32)
    for guard_index in reversed(range(len(root_fraction))):
        guard = jnp.where(is_crossing[guard_index], guard_index, guard)
    for guard_index in range(len(root_fraction)):
        is_earlier = has_root[guard_index] & (root_fraction[guard_index] < earliest_fraction)
        earliest_fraction = jnp.where(is_earlier, root_fraction[guard_index], earliest_fraction)
        guard = jnp.where(is_earlier, guard_index, guard)
    return earliest_fraction, guard
