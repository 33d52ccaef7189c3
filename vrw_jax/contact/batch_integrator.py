"""Batched integration between events: each lane has its own step size and contact state.

Arrays have lanes on the last axis. One Runge-Kutta step serves integration and event search: a lane
whose step crosses a guard repeats it with smaller steps until the step ends at the earliest event.
No computation in this module combines values of different lanes.
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
    find_guard_minimum,
    fit_guard_parabola,
    step_size_factor,
)
from vrw_jax.numerics import StepOptions, tree_where
from vrw_jax.wheel import Outcome, Symbols, compute_own_units

N_CONTACT_ROWS = 9
"""Number of rows after the accelerations that hold the contact quantities of the guards. They are
followed by those of legs in the air, if stoppers are one-sided, and by `N_ACCUMULATOR_ROWS` rows
if these are requested."""
N_ACCUMULATOR_ROWS = 3
"""Number of accumulated rows: energy lost in dampers and by sliding, slip."""


class LaneStatus(IntEnum):
    """Status of a lane between two events; a non-negative status is its `Outcome`."""

    RUNNING = -1
    EVENT = -2


@dataclass(frozen=True)
class IntervalOptions:
    """Search for events with unilateral contact, and the loop over lanes."""

    max_wait_attempts: int = 8
    """Number of solver-step attempts after which a lane at an event ends the loop for all lanes."""
    painleve_atol: float = 1e-8
    """Determinant below which it counts as zero at Painlevé's singularity.

    Forces there are a ratio of two vanishing numbers, resolved neither by round-off nor by
    integration.
    """
    painleve_rtol_factor: float = 1e2
    """Factor of the relative tolerance that is added to `painleve_atol`.

    It is chosen because with a factor of 18 one singularity was missed.
    """
    n_parabola_iterations: int = 3
    """Number of event iterations by parabolas; the later ones use secants, which converge better in
    stiff dips."""
    min_iterations_of_initiating_guard: int = 15
    """Number of event iterations after which a guard that starts at its own event may be the
    event."""
    max_roundoff_fall_time: float = 1e-3
    """Time within which a guard must fall by its own round-off to count as falling, in the wheel's
    own unit: seconds for a wheel of Table 1's size."""
    event_time_tolerance_factor: float = 30.0
    """Largest last correction to the time of an event, in tolerances of the step.

    It is chosen because the error of a parabola's proposal is about a hundredth of the correction.
    """


INTERVAL_OPTIONS = IntervalOptions()


class IntervalPoint(NamedTuple):
    """Coordinates (hub x, z, theta, lengths), their rates, and the rows of the dynamics at a
    point.
    """

    q: Array  # (3 + n, lanes)
    v: Array
    dynamics_rows: Array  # accelerations, then contact rows: (3 + n + N_CONTACT_ROWS [+ n], lanes)


class EventBracket(NamedTuple):
    """Bracket of the earliest event inside a step."""

    is_active: Array
    is_crossing: Array  # (guards, lanes)
    low_h: Array  # bracket of the event, s from the start of the step
    high_h: Array
    time_tolerance: Array  # s
    n_iterations: Array
    previous_h: Array  # previously attempted step, s
    guard_values: Array  # guards at its end, (guards, lanes)


class IntervalState(NamedTuple):
    """State of all lanes between two of their events."""

    point: IntervalPoint
    contact_state: ContactState
    guard_values: Array  # guards at the point, (guards, lanes)
    guard_offset: Array  # value at the own event of a guard that starts there, minus rounding
    interval_accumulators: (
        Array | None
    )  # integrals since the last event, (N_ACCUMULATOR_ROWS, lanes)
    h: Array  # of the next attempt, s
    time: Array  # since the last event, s
    event_bracket: EventBracket
    status: Array  # a LaneStatus or an Outcome
    triggered_guard: Array  # index of the guard that has triggered
    n_solver_steps: Array  # attempted since the last event


def motion_from_point(point: IntervalPoint) -> WheelMotion:
    """Return the motion at a point."""
    x, z, theta, L = point.q[0], point.q[1], point.q[2], point.q[3:]
    return WheelMotion(x, z, theta, point.v[0], point.v[1], point.v[2], L, point.v[3:])


def make_point(dynamics: ModeDynamics, motion: WheelMotion) -> IntervalPoint:
    """Return the point of a motion, with its dynamics: the inverse of `motion_from_point`."""
    q, v = pack_coordinates(motion)
    return IntervalPoint(q, v, evaluate_dynamics(dynamics, q, v))


def pack_coordinates(motion: WheelMotion) -> tuple[Array, Array]:
    """Return the coordinates of a motion, and their rates, as two arrays."""
    q = jnp.concatenate([jnp.stack([motion.x, motion.z, motion.theta]), motion.L])
    return q, jnp.concatenate([jnp.stack([motion.vx, motion.vz, motion.dtheta]), motion.dL])


def evaluate_dynamics(dynamics: ModeDynamics, q: Array, v: Array) -> Array:
    """Return the accelerations of all coordinates, then `ContactQuantities` without the
    directions.
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
            jnp.stack(forces.solution.hub),
            forces.solution.length_motion,
            jnp.stack(contact_rows),
            *optional_rows,
        ]
    )


def evaluate_guards_at_point(dynamics: ModeDynamics, point: IntervalPoint) -> Array:
    """Return all guards in the order of `GuardLayout`, as long after the start of the contact
    state.
    """
    motion = motion_from_point(point)
    contact_rows = point.dynamics_rows[len(point.q) :]
    n1, n2, t1, t2, s1, s2, x1, x2, painleve_determinant = contact_rows[:N_CONTACT_ROWS]
    airborne_stopper = (
        contact_rows[N_CONTACT_ROWS : N_CONTACT_ROWS + dynamics.s.n]
        if dynamics.is_one_sided
        else None
    )
    legs, slot_pairs = (
        leg_directions(dynamics.s, motion.theta),
        ((n1, n2), (t1, t2), (s1, s2), (x1, x2)),
    )
    quantities = ContactQuantities(legs, *slot_pairs, painleve_determinant, airborne_stopper)
    is_after_start = jnp.ones(point.q.shape[-1:], bool)
    return jnp.concatenate(evaluate_guards(dynamics, motion, quantities, is_after_start))


def compute_guard_rates(dynamics: ModeDynamics, point: IntervalPoint) -> Array:
    """Return the time derivatives of the guards along the motion."""

    def evaluate_guards_at(q: Array, v: Array) -> Array:
        return evaluate_guards_at_point(
            dynamics, IntervalPoint(q, v, evaluate_dynamics(dynamics, q, v))
        )

    return jax.jvp(
        evaluate_guards_at, (point.q, point.v), (point.v, point.dynamics_rows[: len(point.q)])
    )[1]


def find_initiating_guards(dynamics: ModeDynamics) -> Array:
    """Return which guards are at the event that has just started the contact state."""
    contact_state = dynamics.contact_state
    has_just_slid = dynamics.slots.gather_flags(contact_state.has_just_slid)
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


@eqx.filter_jit  # traced once for all call sites
def init_interval(
    dynamics: ModeDynamics,
    motion: WheelMotion,
    h: Array,
    interval_options: IntervalOptions = INTERVAL_OPTIONS,
) -> IntervalState:
    """Return the lanes at the start of a contact state.

    A lane is at an event again if one of its guards falls immediately.
    """
    point, is_initiating = make_point(dynamics, motion), find_initiating_guards(dynamics)
    guard_values, guard_rates = (
        evaluate_guards_at_point(dynamics, point),
        compute_guard_rates(dynamics, point),
    )
    # A contact released from rest has a guard within rounding for 1e-8 s and longer. One that
    # rises from below has no event before it falls; events without duration leave several such.
    roundoff = compute_guard_scales(dynamics) * (
        GUARD_ROUNDOFF_IN_EPS * jnp.finfo(guard_values.dtype).eps
    )
    time_unit = compute_own_units(dynamics.s).time
    min_rate = -roundoff / (interval_options.max_roundoff_fall_time * time_unit)
    is_initiating = is_initiating | ((guard_values <= roundoff) & (guard_rates > min_rate))
    is_triggered = ~is_initiating & (
        (guard_values < 0.0) | ((guard_values == 0.0) & (guard_rates <= 0.0))
    )
    triggered_guard = jnp.zeros(is_triggered.shape[1:], jnp.int32)
    for index in reversed(range(len(is_triggered))):
        triggered_guard = jnp.where(is_triggered[index], index, triggered_guard)
    guard_offset = jnp.where(is_initiating, guard_values - 2.0 * roundoff, 0.0)
    float_zeros, int_zeros = jnp.zeros_like(motion.x), jnp.zeros(motion.x.shape, jnp.int32)
    return IntervalState(
        point=point,
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
"""Function of the lanes' columns: parameters and friction."""


def integrate_interval(
    dynamics_fn: DynamicsFn,
    input_columns: Array,
    initial_state: IntervalState,
    has_unfinished_walk: Array,
    options: StepOptions,
    tableau: ButcherTableau,
) -> IntervalState:
    """Return the lanes integrated until none is running.

    After `max_wait_tries` attempts, the loop ends as soon as a lane with `is_walking` is at an
    event.
    """
    dynamics = dynamics_fn(input_columns)
    guard_scales, options = (
        compute_guard_scales(dynamics),
        compute_own_units(dynamics.s).scale_times(options),
    )

    def try_step(state: IntervalState) -> IntervalState:
        return integrator_step(
            state, attempt_step(dynamics, tableau, options, state), guard_scales, tableau, options
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
    """Return the state after repeated `iterate`, until no lane is running.

    After `max_wait_tries` attempts, the loop ends as soon as a lane with `is_walking` has stopped.
    """

    def should_continue(loop_state: tuple) -> Array:
        state, n_attempts = loop_state
        is_active = is_running(state)
        has_stopped = jnp.any(has_unfinished_walk & ~is_active)
        return jnp.any(is_active) & ((n_attempts < max_wait_attempts) | ~has_stopped)

    n_initial = jnp.zeros((), jnp.int32)
    advance_loop = lambda loop_state: (advance_state(loop_state[0]), loop_state[1] + 1)
    return lax.while_loop(should_continue, advance_loop, (initial_state, n_initial))[0]


class AttemptedStep(NamedTuple):
    """An attempted solver step."""

    end_point: IntervalPoint
    squared_error: Array  # of the error over the tolerance
    guard_values: Array  # at the end
    parabola_curvature: Array  # of the guards' parabolas
    parabola_linear_term: Array
    dip_fraction: Array  # fraction of the step to a possible guard dip below zero, else 1
    accumulator_increments: Array | None  # increment of `IntervalState.accumulated`


def compute_stage_state(
    tableau: ButcherTableau, i: Array | int, q: Array, v: Array, stage_rows: Array, h: Array
) -> tuple[Array, Array]:
    """Return coordinates and rates at a stage, from the accelerations of the stages before it."""
    a, b, node = (
        jnp.asarray(x)[i] for x in (tableau.matrix, tableau.matrix_squared, tableau.nodes)
    )
    n, n_previous = len(q), len(tableau.nodes) - 1
    first_sum = sum(a[j] * stage_rows[j, :n] for j in range(n_previous))
    second_sum = sum(b[j] * stage_rows[j, :n] for j in range(n_previous))
    return q + h * (node * v + h * second_sum), v + h * first_sum


def attempt_step(
    dynamics: ModeDynamics, tableau: ButcherTableau, options: StepOptions, state: IntervalState
) -> AttemptedStep:
    """Return an attempted step of every lane."""
    h, point, last_stage = state.h, state.point, len(tableau.nodes) - 1

    def evaluate_stage(i: Array, stage_rows: Array) -> Array:
        stage_row = evaluate_dynamics(
            dynamics, *compute_stage_state(tableau, i, point.q, point.v, stage_rows, h)
        )
        return lax.dynamic_update_index_in_dim(stage_rows, stage_row, i, 0)

    later_stage_rows = jnp.zeros((last_stage, *point.dynamics_rows.shape), h.dtype)
    stage_rows = jnp.concatenate([point.dynamics_rows[None], later_stage_rows])
    stage_rows = lax.fori_loop(1, last_stage + 1, evaluate_stage, stage_rows)
    return complete_attempt(dynamics, tableau, options, state, stage_rows)


def complete_attempt(
    dynamics: ModeDynamics,
    tableau: ButcherTableau,
    options: StepOptions,
    state: IntervalState,
    stage_rows: Array,
) -> AttemptedStep:
    """Return the attempted step with these rows of the dynamics at its stages."""
    h, point, last_stage = state.h, state.point, len(tableau.nodes) - 1
    n = len(point.q)
    end_point = IntervalPoint(
        *compute_stage_state(tableau, last_stage, point.q, point.v, stage_rows, h),
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
            *compute_stage_state(tableau, i, point.q, point.v, stage_rows, h), stage_rows[i]
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
    squared_error = _squared_error(
        dynamics.s, options, error_estimates, point, guard_points[-1], end_guard_values
    )
    middle_guard_values = (
        inner_guard_values[tableau.guard_stages.index(tableau.middle_stage)]
        if inner_guard_values
        else state.guard_values
    )
    parabola_terms = fit_guard_parabola(
        tableau, state.guard_values, middle_guard_values, end_guard_values
    )
    dip_fraction = _earliest_dip_fraction(
        tableau, [state.guard_values, *inner_guard_values, end_guard_values], _is_initiating(state)
    )
    return AttemptedStep(
        end_point,
        squared_error,
        end_guard_values,
        *parabola_terms,
        dip_fraction,
        accumulator_increments,
    )


def is_at_singularity(
    value_before: Array,
    value_after: Array,
    options: StepOptions,
    interval_options: IntervalOptions = INTERVAL_OPTIONS,
) -> Array:
    """Return whether the determinant has vanished at Painlevé's singularity, from its values at
    both ends.
    """
    atol, rtol_factor = interval_options.painleve_atol, interval_options.painleve_rtol_factor
    is_zero = jnp.abs(value_after) <= atol + rtol_factor * options.rtol
    return (value_before * value_after <= 0.0) | is_zero


def integrator_step(
    state: IntervalState,
    attempt: AttemptedStep,
    guard_scales: Array,
    tableau: ButcherTableau,
    options: StepOptions,
    interval_options: IntervalOptions = INTERVAL_OPTIONS,
) -> IntervalState:
    """Return the lanes after one attempt: accepted, repeated with another step size, or at an
    event.
    """
    point, h, event_bracket, end_point = (
        state.point,
        state.h,
        state.event_bracket,
        attempt.end_point,
    )
    is_running = state.status == LaneStatus.RUNNING
    is_accurate = is_running & ~event_bracket.is_active & (attempt.squared_error <= 1.0)
    needs_retry = (
        is_accurate
        & (attempt.dip_fraction < 1.0)
        & (state.time + h * attempt.dip_fraction > state.time)
    )
    has_crossed = is_accurate & ~needs_retry & jnp.any(attempt.guard_values <= 0.0, axis=0)
    is_accepted = is_accurate & ~needs_retry & ~has_crossed
    next_bracket, event = _search_event(
        state, attempt, has_crossed, guard_scales, options, interval_options
    )
    has_reached_event = event.has_reached_event
    step_size_ratio = jnp.where(
        needs_retry, attempt.dip_fraction, step_size_factor(tableau, attempt.squared_error, h.dtype)
    )
    # The last step ends at the time limit.
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
    determinant_row = len(point.q) + N_CONTACT_ROWS - 1
    determinant_before = point.dynamics_rows[determinant_row]
    determinant_after = end_point.dynamics_rows[determinant_row]
    status = jnp.where(has_failed, Outcome.SOLVER_FAILED, LaneStatus.RUNNING)
    status = jnp.where(has_reached_event, LaneStatus.EVENT, status)
    status = jnp.where(is_past_time_limit, Outcome.NO_TOUCHDOWN_IN_TIME, status)
    is_singular = is_state_updated & is_at_singularity(
        determinant_before, determinant_after, options, interval_options
    )
    status = jnp.where(is_singular, Outcome.PAINLEVE_PARADOX, status)
    return state._replace(
        point=tree_where(is_state_updated, end_point, point),
        guard_values=jnp.where(is_accepted, attempt.guard_values, state.guard_values),
        interval_accumulators=interval_accumulators,
        h=jnp.where(is_running, next_h, h),
        time=time,
        event_bracket=tree_where(is_running, next_bracket, event_bracket),
        status=jnp.where(is_running, status, state.status).astype(jnp.int32),
        triggered_guard=jnp.where(has_reached_event, event.guard, state.triggered_guard),
        n_solver_steps=state.n_solver_steps + is_running,
    )


class _LocatedEvent(NamedTuple):
    """Result of one iteration of the search for the earliest event inside a step."""

    next_h: Array  # step size of the next attempt, s
    time_shift: Array  # from this step size to the event's, s
    has_reached_event: Array  # whether the event is within tolerance
    guard: Array


def _search_event(
    state: IntervalState,
    attempt: AttemptedStep,
    has_crossed: Array,
    guard_scales: Array,
    options: StepOptions,
    interval_options: IntervalOptions,
) -> tuple[EventBracket, _LocatedEvent]:
    """Return one more iteration of the search, from the zeros of the guards' parabolas or
    secants.
    """
    h, bracket = state.h, state.event_bracket
    is_below_zero = attempt.guard_values <= 0.0
    is_crossing = jnp.where(bracket.is_active, bracket.is_crossing | is_below_zero, is_below_zero)
    parabolas = state.guard_values, attempt.parabola_linear_term, attempt.parabola_curvature
    root_fraction, guard = _earliest_root(*parabolas, is_crossing, _is_initiating(state))
    secant_h, secant_guard = _earliest_secant(bracket, attempt.guard_values, h, is_crossing)
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
    # In a dip of microseconds, round-off moves proposals out of the bracket: it is bisected.
    needs_bisection = ~is_in_bracket | (uses_secant & ((bracket.n_iterations & 3) == 3))
    # A guard that starts at its own event falls again soon, or not at all.
    bisection_h = jnp.where(
        (low_h == 0.0) & jnp.isinf(proposed_h), 0.125 * high_h, 0.5 * (low_h + high_h)
    )
    next_h = jnp.where(needs_bisection, bisection_h, proposed_h)
    time_shift = next_h - h
    # If a guard is within its rounding, no other step size is better than this one.
    lowest_guard, lowest_value = _lowest_guard(attempt.guard_values / guard_scales, is_crossing)
    # A guard at its own event is within twice its rounding; without another event, it is the event.
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


def _squared_error(
    s: Symbols,
    options: StepOptions,
    error_estimates: tuple[Array, Array],
    point: IntervalPoint,
    end_point: IntervalPoint,
    guard_values: Array,
) -> Array:
    """Return the mean square of the error over its tolerance; infinite for a step that is not
    finite.
    """
    total_error = 0.0 * jnp.sum(guard_values, axis=0)
    units = compute_state_units(s)
    for error, a, b, coordinate_unit in zip(
        error_estimates, point[:2], end_point[:2], units, strict=True
    ):
        tolerance = options.atol * coordinate_unit + options.rtol * jnp.maximum(
            jnp.abs(a), jnp.abs(b)
        )
        total_error = total_error + jnp.sum(jnp.square(error / tolerance), axis=0)
    return jnp.where(jnp.isfinite(total_error), total_error / (2 * point.q.shape[0]), jnp.inf)


def _is_initiating(state: IntervalState) -> Array:
    """Return the guards at their own event, for lanes at the start of the contact state."""
    return (state.time == 0.0) & (state.guard_offset != 0.0)


def _earliest_dip_fraction(
    tableau: ButcherTableau, guard_values: list[Array], is_initiating: Array
) -> Array:
    """Return the fraction of the step before a guard that may dip below zero in it; 1 if there is
    none.

    See `integrator.find_guard_minimum`. A guard that starts at its own event is not considered.
    """
    has_dip, dip_fraction = find_dip(tableau, guard_values)
    return jnp.min(
        jnp.where(has_dip & (guard_values[0] > 0.0) & ~is_initiating, dip_fraction, 1.0), axis=0
    )


def _lowest_guard(guard_values: Array, is_crossing: Array) -> tuple[Array, Array]:
    """Return the lowest of the crossing guards, and its value; infinite if none crosses."""
    lowest_value, guard = (
        jnp.full_like(guard_values[0], jnp.inf),
        jnp.zeros(guard_values.shape[1:], jnp.int32),
    )
    for index in range(len(guard_values)):
        is_lower = is_crossing[index] & (guard_values[index] < lowest_value)
        lowest_value = jnp.where(is_lower, guard_values[index], lowest_value)
        guard = jnp.where(is_lower, index, guard)
    return guard, lowest_value


def _earliest_secant(
    bracket: EventBracket, guard_values: Array, h: Array, is_crossing: Array
) -> tuple[Array, Array]:
    """Return the earliest zero of the crossing guards' secants through the last two attempts.

    It also returns the guard. The zero is infinite if no guard falls, and minus infinity if a guard
    is below zero and no longer falls, because it fell before. The ends of attempts are as accurate
    as the integration; the inner stage is not.
    """
    secant_slope = (guard_values - bracket.guard_values) / jnp.where(
        h == bracket.previous_h, jnp.inf, h - bracket.previous_h
    )
    earliest_h, guard = jnp.full_like(h, jnp.inf), jnp.zeros(h.shape, jnp.int32)
    for index in range(len(guard_values)):
        is_falling = is_crossing[index] & (secant_slope[index] < 0.0)
        root_h = h - guard_values[index] / jnp.where(is_falling, secant_slope[index], 1.0)
        is_already_below = is_crossing[index] & ~is_falling & (guard_values[index] < 0.0)
        root_h = jnp.where(is_already_below, -jnp.inf, root_h)
        is_earlier = (is_falling | is_already_below) & (root_h < earliest_h)
        earliest_h = jnp.where(is_earlier, root_h, earliest_h)
        guard = jnp.where(is_earlier, index, guard)
    return earliest_h, guard


def _earliest_root(
    g0: Array, linear_term: Array, curvature: Array, is_crossing: Array, is_initiating: Array
) -> tuple[Array, Array]:
    """Return the earliest zero of the crossing guards' parabolas, in step lengths, and the guard.

    The zero is infinite if no parabola falls ahead. A guard that starts at its own event rises: if
    its parabola falls at once, the step is too long for parabolas. The zero is minus infinity if
    such a parabola ends below zero.
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
    for index in reversed(range(len(root_fraction))):
        guard = jnp.where(is_crossing[index], index, guard)
    for index in range(len(root_fraction)):
        is_earlier = has_root[index] & (root_fraction[index] < earliest_fraction)
        earliest_fraction = jnp.where(is_earlier, root_fraction[index], earliest_fraction)
        guard = jnp.where(is_earlier, index, guard)
    return earliest_fraction, guard
