"""Integrate a batch of wheels between events, with a separate step size and contact state for each.

A batch element is called a *lane*, and arrays have the lanes on the last axis. One Runge-Kutta step
serves both the integration and the event search. If a guard crosses zero in a solver step, the lane
repeats this step with smaller sizes until it ends at the earliest event. No computation in this
module combines values of different lanes.

Arrays of accelerations and contact forces have one row per quantity, the *dynamics rows*. They
begin with the accelerations and Painlevé's determinant, followed by the
`contact_state.ContactQuantities`. If accumulators are requested, their rates are last. The
*initiating guard* of a contact state is the guard that was zero at the event before this state. An
example is the guard for the normal force on a foot that has just lifted off.
"""

import itertools
from collections.abc import Callable
from enum import IntEnum
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from vrw_jax.base.elementwise import select_trees_by_condition
from vrw_jax.base.options import StepOptions
from vrw_jax.base.outcomes import Outcome
from vrw_jax.flow.event_location import (
    GUARD_ROUNDOFF_IN_EPS,
    find_first_guard,
    has_guard_crossed,
)
from vrw_jax.flow.tableaus import (
    ButcherTableau,
    compute_step_size_factor,
    find_guard_minimum,
    fit_guard_parabola,
)
from vrw_jax.models.contact_mechanics import WheelMotion, make_opaque_one, prevent_fusion
from vrw_jax.models.contact_state import (
    ContactModeDynamics,
    ContactQuantities,
    ContactState,
    NormalForceRates,
    collect_contact_quantities,
    compute_accumulator_rates,
    compute_forces,
    compute_guard_scales,
    compute_state_units,
    evaluate_guards,
)
from vrw_jax.wheel.params import Symbols, compute_wheel_units

N_ACCUMULATOR_ROWS = 3
"""Number of accumulators: energy losses in dampers and by sliding, and slip length."""


class LaneStatus(IntEnum):
    """Status of a batch element between two events; a non-negative status is an `Outcome`."""

    RUNNING = -1
    EVENT = -2


class ContactIntervalPoint(NamedTuple):
    """Coordinates, rates and dynamics rows of all batch elements at one time.

    The coordinates are the hub position x and z, the angle theta and the leg lengths.
    """

    q: Array  # (3 + n, batch)
    v: Array
    dynamics_rows: Array  # accelerations and contact quantities, (rows, batch)


class EventBracket(NamedTuple):
    """Bracket of the earliest event inside a solver step, and the last attempt to locate it."""

    is_event_search_active: Array
    is_guard_crossing: Array  # whether a guard crosses zero in the bracket, (guards, batch)
    lower_step_size_bound: Array  # bracket of the event, s from the start of the step
    upper_step_size_bound: Array
    time_tolerance: Array  # s
    n_iterations: Array
    previous_step_size: Array  # size of the previous attempt, s
    guard_values: Array  # guards at the end of the previous attempt, (guards, batch)

    def find_earliest_secant_root(
        self, guard_values: Array, h: Array, is_guard_crossing: Array
    ) -> tuple[Array, Array]:
        """Return the step size to the earliest root of a guard's secant, s, and the guard's index.

        The secants pass through the guards at the ends of the last two attempts, which are more
        accurate than guards at inner stages. The step size is infinite if no guard falls. It is
        minus infinity if a guard is negative and does not fall, because this guard fell to zero
        earlier.
        """
        guard_secant_rate = (guard_values - self.guard_values) / jnp.where(
            h == self.previous_step_size, jnp.inf, h - self.previous_step_size
        )
        is_guard_falling = is_guard_crossing & (guard_secant_rate < 0.0)
        root_step_size = h - guard_values / jnp.where(is_guard_falling, guard_secant_rate, 1.0)
        is_already_negative = is_guard_crossing & ~is_guard_falling & (guard_values < 0.0)
        return _find_lowest_guard(
            jnp.where(is_already_negative, -jnp.inf, root_step_size),
            is_guard_falling | is_already_negative,
        )


class ContactIntervalState(NamedTuple):
    """State of all batch elements in the interval between two events."""

    contact_interval_point: ContactIntervalPoint
    contact_state: ContactState
    guard_values: Array  # guards at the interval point, (guards, batch)
    guard_offset: Array  # initial value of an initiating guard, minus round-off; else 0
    # integrals since the last event, (N_ACCUMULATOR_ROWS, batch)
    interval_accumulators: Array | None
    h: Array  # size of the next attempted solver step, s
    time_since_event: Array  # time since the last event, s
    event_bracket: EventBracket
    lane_status: Array  # a `LaneStatus` or an `Outcome`
    triggered_guard_index: Array  # index of the guard that has triggered
    n_solver_steps: Array  # number of attempts since the last event


def unpack_motion(contact_interval_point: ContactIntervalPoint) -> WheelMotion:
    """Return coordinates and rates of the wheel at a point of an interval."""
    q, v, _ = contact_interval_point
    x, z, theta = q[:3]
    vx, vz, dtheta = v[:3]
    return WheelMotion(x, z, theta, vx, vz, dtheta, q[3:], v[3:])


def pack_coordinates(motion: WheelMotion) -> tuple[Array, Array]:
    """Return the coordinates of a motion and their rates, as two arrays (3 + n, ...)."""
    q = jnp.concatenate([jnp.stack([motion.x, motion.z, motion.theta]), motion.L])
    return q, jnp.concatenate([jnp.stack([motion.vx, motion.vz, motion.dtheta]), motion.dL])


def evaluate_dynamics(contact_mode_dynamics: ContactModeDynamics, q: Array, v: Array) -> Array:
    """Return the dynamics rows, (rows, batch).

    `q` and `v` are coordinates and rates, (3 + n, batch).
    """
    motion = unpack_motion(ContactIntervalPoint(q, v, q))
    contact_forces = compute_forces(contact_mode_dynamics, motion)
    force_solution = contact_forces.force_solution
    contact_quantities = collect_contact_quantities(contact_mode_dynamics, motion, contact_forces)
    row_blocks = [
        jnp.stack(force_solution.hub_motion),
        force_solution.length_motion,
        force_solution.painleve_determinant[None],
        *jax.tree.leaves(contact_quantities),
    ]
    if contact_mode_dynamics.has_accumulators:
        _, *loss_rates = compute_accumulator_rates(contact_mode_dynamics, motion, contact_forces)
        row_blocks.append(jnp.stack(prevent_fusion(loss_rates, make_opaque_one(motion.theta))))
    return jnp.concatenate(row_blocks)


def evaluate_guards_at_point(
    contact_mode_dynamics: ContactModeDynamics, contact_interval_point: ContactIntervalPoint
) -> Array:
    """Return the values of all guards in the order of `GuardLayout`, (guards, batch).

    The point must be after the start of the contact state, so that no guard has a placeholder
    value.
    """
    row_counts = [2] * 4
    row_counts += [contact_mode_dynamics.s.n * contact_mode_dynamics.has_one_sided_stoppers]
    row_counts += [len(NormalForceRates._fields) * contact_mode_dynamics.measures_force_peaks]
    contact_rows = contact_interval_point.dynamics_rows[len(contact_interval_point.q) + 1 :]
    row_blocks: list[Any] = [
        contact_rows[row_end - row_count : row_end] if row_count else None
        for row_count, row_end in zip(row_counts, itertools.accumulate(row_counts), strict=True)
    ]
    contact_quantities = ContactQuantities(*row_blocks)
    motion = unpack_motion(contact_interval_point)
    is_after_start = jnp.ones(contact_interval_point.q.shape[-1:], bool)
    return jnp.concatenate(
        evaluate_guards(contact_mode_dynamics, motion, contact_quantities, is_after_start)
    )


def evaluate_guards_of_coordinates(
    contact_mode_dynamics: ContactModeDynamics, q: Array, v: Array
) -> Array:
    """Return the values of all guards for coordinates and rates, (guards, batch)."""
    return evaluate_guards_at_point(
        contact_mode_dynamics,
        ContactIntervalPoint(q, v, evaluate_dynamics(contact_mode_dynamics, q, v)),
    )


def compute_guard_rates(
    contact_mode_dynamics: ContactModeDynamics, contact_interval_point: ContactIntervalPoint
) -> Array:
    """Return the time derivatives of all guards during the motion, (guards, batch)."""
    q, v, dynamics_rows = contact_interval_point
    return jax.jvp(
        partial(evaluate_guards_of_coordinates, contact_mode_dynamics),
        (q, v),
        (v, dynamics_rows[: len(q)]),
    )[1]


def find_initiating_guards(contact_mode_dynamics: ContactModeDynamics) -> Array:
    """Return whether each guard is an initiating guard of the contact state, (guards, batch).

    An initiating guard was zero at the event that started the contact state.
    """
    contact_state = contact_mode_dynamics.contact_state
    guard_layout = contact_mode_dynamics.guard_layout
    make_false_flags = lambda n_guards: jnp.zeros(
        (n_guards, contact_state.contact_modes.shape[-1]), bool
    )
    return jnp.concatenate(
        [
            contact_state.has_just_lifted,
            contact_state.has_just_unlocked,
            make_false_flags(guard_layout.first_slip_end_guard - guard_layout.first_liftoff_guard),
            contact_mode_dynamics.contact_slots.gather_flags_from_legs(contact_state.has_just_slid),
            make_false_flags(guard_layout.n_guards - guard_layout.first_stopper_release_guard),
        ]
    )


# Time in which a guard must fall by its own round-off to be treated as falling. The value is in the
# wheel's unit of time, which is 1 s for the wheel in Table 1 of the paper.
MAX_ROUNDOFF_FALL_DURATION = 1e-3


@eqx.filter_jit  # This function is traced once for all call sites.
def init_contact_interval(
    contact_mode_dynamics: ContactModeDynamics,
    motion: WheelMotion,
    h: Array,
) -> ContactIntervalState:
    """Return the state of all batch elements at the start of an interval between events.

    The status of an element is `LaneStatus.EVENT` if one of its guards falls immediately.

    - `h`: size of the first solver step, in the wheel's unit of time.
    """
    q, v = pack_coordinates(motion)
    start_point = ContactIntervalPoint(q, v, evaluate_dynamics(contact_mode_dynamics, q, v))
    is_initiating = find_initiating_guards(contact_mode_dynamics)
    guard_values = evaluate_guards_at_point(contact_mode_dynamics, start_point)
    guard_rates = compute_guard_rates(contact_mode_dynamics, start_point)
    # The guard of a contact released from rest is within round-off for 1e-8 s and longer. A guard
    # that rises from below zero has no event before it falls. Several events at one time leave
    # several such guards.
    guard_roundoff = compute_guard_scales(contact_mode_dynamics) * (
        GUARD_ROUNDOFF_IN_EPS * jnp.finfo(guard_values.dtype).eps
    )
    time_unit = compute_wheel_units(contact_mode_dynamics.s).time_unit
    min_initiating_guard_rate = -guard_roundoff / (MAX_ROUNDOFF_FALL_DURATION * time_unit)
    is_initiating = is_initiating | (
        (guard_values <= guard_roundoff) & (guard_rates > min_initiating_guard_rate)
    )
    is_guard_triggered = ~is_initiating & has_guard_crossed(guard_values, guard_rates)
    guard_offset = jnp.where(is_initiating, guard_values - 2.0 * guard_roundoff, 0.0)
    float_zero_lanes = jnp.zeros_like(motion.x)
    int_zero_lanes = jnp.zeros(motion.x.shape, jnp.int32)
    return ContactIntervalState(
        contact_interval_point=start_point,
        contact_state=contact_mode_dynamics.contact_state,
        guard_values=guard_values - guard_offset,
        guard_offset=guard_offset,
        interval_accumulators=jnp.zeros(
            (N_ACCUMULATOR_ROWS, *float_zero_lanes.shape), float_zero_lanes.dtype
        )
        if contact_mode_dynamics.has_accumulators
        else None,
        h=float_zero_lanes + h * time_unit,
        time_since_event=float_zero_lanes,
        event_bracket=EventBracket(
            int_zero_lanes > 0,
            jnp.zeros_like(is_initiating),
            float_zero_lanes,
            float_zero_lanes,
            float_zero_lanes,
            int_zero_lanes,
            float_zero_lanes,
            guard_values,
        ),
        lane_status=jnp.where(
            jnp.any(is_guard_triggered, axis=0), LaneStatus.EVENT, LaneStatus.RUNNING
        ).astype(jnp.int32),
        triggered_guard_index=find_first_guard(is_guard_triggered, 0),
        n_solver_steps=int_zero_lanes,
    )


DynamicsFn = Callable[[Array], ContactModeDynamics]
"""Function that returns the dynamics in the contact states of all batch elements.

Its argument contains wheel parameters, friction and uneven ground, (inputs, batch).
"""


def integrate_contact_interval(
    make_contact_dynamics: DynamicsFn,
    input_columns: Array,
    initial_state: ContactIntervalState,
    has_unfinished_walk: Array,
    options: StepOptions,
    tableau: ButcherTableau,
) -> ContactIntervalState:
    """Return the state of all batch elements at their next events or failures.

    After `max_attempts_with_waiting_lane` solver steps, the integration ends as soon as an element
    with an unfinished walk is at an event.

    - `input_columns`: parameters, friction and uneven ground, (inputs, batch);
    - `has_unfinished_walk`: whether the walk of each element is unfinished, (batch,).
    """
    contact_mode_dynamics = make_contact_dynamics(input_columns)
    guard_scales = compute_guard_scales(contact_mode_dynamics)
    options = compute_wheel_units(contact_mode_dynamics.s).scale_times_to_seconds(options)

    def try_solver_step(lane_states: ContactIntervalState) -> ContactIntervalState:
        return advance_running_lanes(
            lane_states,
            attempt_solver_step(contact_mode_dynamics, tableau, options, lane_states),
            guard_scales,
            tableau,
            options,
        )

    return iterate_until_stopped(
        lambda lane_states: lane_states.lane_status == LaneStatus.RUNNING,
        has_unfinished_walk,
        try_solver_step,
        initial_state,
    )


# Number of solver steps after which an element at an event ends the loop for the batch.
MAX_ATTEMPTS_WITH_WAITING_LANE = 8


def iterate_until_stopped(
    is_running: Callable[[Any], Array],
    has_unfinished_walk: Array,
    advance_state: Callable,
    initial_state: Any,
) -> Any:
    """Return the loop state after `advance_state` was applied until no element is running.

    After `MAX_ATTEMPTS_WITH_WAITING_LANE` applications, the loop ends as soon as
    an element with an unfinished walk has stopped.
    """

    def should_continue(loop_state: tuple) -> Array:
        lane_states, n_attempts = loop_state
        is_event_search_active = is_running(lane_states)
        has_stopped = jnp.any(has_unfinished_walk & ~is_event_search_active)
        return jnp.any(is_event_search_active) & (
            (n_attempts < MAX_ATTEMPTS_WITH_WAITING_LANE) | ~has_stopped
        )

    advance_loop_state = lambda loop_state: (advance_state(loop_state[0]), loop_state[1] + 1)
    return lax.while_loop(
        should_continue, advance_loop_state, (initial_state, jnp.zeros((), jnp.int32))
    )[0]


class AttemptedSolverStep(NamedTuple):
    """Result of one solver step of every batch element, before it is accepted or rejected."""

    end_point: ContactIntervalPoint
    mean_squared_error: Array  # mean square of the error over the tolerance
    guard_values: Array  # guards at the end of the solver step, (guards, batch)
    guard_parabola_curvature: Array  # curvature of the parabola through each guard, (guards, batch)
    guard_parabola_linear_term: Array
    guard_minimum_fraction: Array  # fraction of the solver step to a negative guard minimum, else 1
    accumulator_increments: (
        Array | None
    )  # increment of `ContactIntervalState.interval_accumulators`


def compute_stage_state(
    tableau: ButcherTableau, i: Array | int, q: Array, v: Array, stage_rows: Array, h: Array
) -> tuple[Array, Array]:
    """Return coordinates and rates at Runge-Kutta stage `i`, each of shape (3 + n, batch).

    They are computed from the accelerations at the earlier stages in `stage_rows`.

    - `h`: size of the solver step, s.
    """
    a, b, stage_node = (
        jnp.asarray(x)[i]
        for x in (tableau.stage_matrix, tableau.squared_stage_matrix, tableau.stage_nodes)
    )
    n, n_previous_stages = len(q), len(tableau.stage_nodes) - 1
    rate_increment = sum(a[j] * stage_rows[j, :n] for j in range(n_previous_stages))
    coordinate_increment = sum(b[j] * stage_rows[j, :n] for j in range(n_previous_stages))
    return q + h * (stage_node * v + h * coordinate_increment), v + h * rate_increment


def attempt_solver_step(
    contact_mode_dynamics: ContactModeDynamics,
    tableau: ButcherTableau,
    options: StepOptions,
    lane_states: ContactIntervalState,
) -> AttemptedSolverStep:
    """Return the result of one attempted solver step of every batch element."""
    h = lane_states.h
    start_point = lane_states.contact_interval_point
    last_stage = len(tableau.stage_nodes) - 1

    def evaluate_stage_dynamics(i: Array, stage_rows: Array) -> Array:
        stage_row = evaluate_dynamics(
            contact_mode_dynamics,
            *compute_stage_state(tableau, i, start_point.q, start_point.v, stage_rows, h),
        )
        return lax.dynamic_update_index_in_dim(stage_rows, stage_row, i, 0)

    later_stage_rows = jnp.zeros((last_stage, *start_point.dynamics_rows.shape), h.dtype)
    stage_rows = jnp.concatenate([start_point.dynamics_rows[None], later_stage_rows])
    stage_rows = lax.fori_loop(1, last_stage + 1, evaluate_stage_dynamics, stage_rows)
    return complete_solver_step(contact_mode_dynamics, tableau, options, lane_states, stage_rows)


def complete_solver_step(
    contact_mode_dynamics: ContactModeDynamics,
    tableau: ButcherTableau,
    options: StepOptions,
    lane_states: ContactIntervalState,
    stage_rows: Array,
) -> AttemptedSolverStep:
    """Return the result of a solver step from the dynamics rows at all stages.

    - `stage_rows`: dynamics rows, (stages, rows, batch).
    """
    h = lane_states.h
    start_point = lane_states.contact_interval_point
    last_stage = len(tableau.stage_nodes) - 1
    n = len(start_point.q)
    *inner_stage_points, end_point = (
        ContactIntervalPoint(
            *compute_stage_state(tableau, i, start_point.q, start_point.v, stage_rows, h),
            stage_rows[i],
        )
        for i in (*tableau.guard_stage_indices, last_stage)
    )
    accumulator_increments = None
    if contact_mode_dynamics.has_accumulators:
        accumulator_increments = h * sum(
            tableau.stage_matrix[last_stage][j] * stage_rows[j, -N_ACCUMULATOR_ROWS:]
            for j in range(last_stage)
        )
    guard_values = [
        lane_states.guard_values,
        *(
            evaluate_guards_at_point(contact_mode_dynamics, guard_point) - lane_states.guard_offset
            for guard_point in (*inner_stage_points, end_point)
        ),
    ]
    sum_weighted_stages = lambda weights: sum(
        float(w) * stage_rows[j, :n] for j, w in enumerate(weights) if w != 0.0
    )
    error_estimates = (
        h * h * sum_weighted_stages(tableau.position_error_weights),
        h * sum_weighted_stages(tableau.rate_error_weights),
    )
    mean_squared_error = _compute_squared_error(
        contact_mode_dynamics.s,
        options,
        error_estimates,
        start_point,
        end_point,
        guard_values[-1],
    )
    parabola_terms = fit_guard_parabola(
        tableau, guard_values[0], guard_values[tableau.middle_guard_index], guard_values[-1]
    )
    # A guard that is positive at both ends of a solver step may be negative between them.
    has_guard_minimum, guard_minimum_fraction = find_guard_minimum(tableau, guard_values)
    is_minimum_counted = (
        has_guard_minimum & (guard_values[0] > 0.0) & ~_flag_initiating_guards(lane_states)
    )
    return AttemptedSolverStep(
        end_point,
        mean_squared_error,
        guard_values[-1],
        *parabola_terms,
        jnp.min(jnp.where(is_minimum_counted, guard_minimum_fraction, 1.0), axis=0),
        accumulator_increments,
    )


# Absolute value below which the determinant is treated as zero at Painlevé's singularity. There,
# forces are a ratio of two vanishing quantities, which neither round-off nor integration resolves.
PAINLEVE_ATOL = 1e-8
# Factor by which the relative tolerance is multiplied before it is added to `PAINLEVE_ATOL`. The
# value is chosen because one singularity was missed with a factor of 18.
PAINLEVE_RTOL_FACTOR = 1e2


def is_at_painleve_singularity(
    determinant_before: Array,
    determinant_after: Array,
    options: StepOptions,
) -> Array:
    """Return whether a contact determinant vanishes between two times, at Painlevé's singularity.

    - `determinant_before`, `determinant_after`: determinants at the two times.
    """
    zero_tolerance = PAINLEVE_ATOL + PAINLEVE_RTOL_FACTOR * options.rtol
    is_near_zero = jnp.abs(determinant_after) <= zero_tolerance
    return (determinant_before * determinant_after <= 0.0) | is_near_zero


def advance_running_lanes(
    lane_states: ContactIntervalState,
    attempted_step: AttemptedSolverStep,
    guard_scales: Array,
    tableau: ButcherTableau,
    options: StepOptions,
) -> ContactIntervalState:
    """Return the state of all batch elements after one attempted solver step.

    Each running element accepts the step, repeats it with another size, or stops at an event.
    """
    start_point = lane_states.contact_interval_point
    h, start_time = lane_states.h, lane_states.time_since_event
    event_bracket = lane_states.event_bracket
    is_searching = event_bracket.is_event_search_active
    end_point = attempted_step.end_point
    is_running = lane_states.lane_status == LaneStatus.RUNNING
    is_step_accurate = is_running & ~is_searching & (attempted_step.mean_squared_error <= 1.0)
    must_retry_step = (
        is_step_accurate
        & (attempted_step.guard_minimum_fraction < 1.0)
        & (start_time + h * attempted_step.guard_minimum_fraction > start_time)
    )
    is_crossing = (
        is_step_accurate & ~must_retry_step & jnp.any(attempted_step.guard_values <= 0.0, axis=0)
    )
    is_accepted = is_step_accurate & ~must_retry_step & ~is_crossing
    next_bracket, search_step_size, event_time_shift, has_reached_event, event_guard = (
        _iterate_event_search(lane_states, attempted_step, is_crossing, guard_scales, options)
    )
    step_size_ratio = jnp.where(
        must_retry_step,
        attempted_step.guard_minimum_fraction,
        compute_step_size_factor(tableau, attempted_step.mean_squared_error, h.dtype),
    )
    # The last step ends exactly at the time limit.
    latest_event_time = options.max_phase_time
    end_time = jnp.where(
        is_accepted & (h == latest_event_time - start_time),
        latest_event_time,
        start_time + h,
    )
    reached_time = jnp.where(is_accepted, end_time, start_time)
    next_step_size = jnp.where(
        is_searching | is_crossing,
        search_step_size,
        jnp.minimum(h * step_size_ratio, latest_event_time - reached_time),
    )

    event_time_shift = jnp.where(has_reached_event, event_time_shift, 0.0)
    end_point = ContactIntervalPoint(
        end_point.q + event_time_shift * end_point.v,
        end_point.v + event_time_shift * end_point.dynamics_rows[: len(end_point.q)],
        end_point.dynamics_rows,
    )
    is_state_updated = is_accepted | has_reached_event
    interval_accumulators = lane_states.interval_accumulators
    if interval_accumulators is not None and attempted_step.accumulator_increments is not None:
        interval_accumulators = interval_accumulators + jnp.where(
            is_state_updated, attempted_step.accumulator_increments, 0.0
        )
    time = jnp.where(is_state_updated, end_time + event_time_shift, start_time)
    is_past_time_limit = (is_accepted & (time >= latest_event_time)) | (
        has_reached_event & (time > latest_event_time)
    )
    has_step_failed = (
        (next_bracket.n_iterations >= options.max_event_iterations)
        | (lane_states.n_solver_steps + 1 >= options.max_solver_steps)
        | (~is_searching & (start_time + next_step_size == start_time))
    )
    painleve_determinant_row = len(start_point.q)
    determinant_before = start_point.dynamics_rows[painleve_determinant_row]
    determinant_after = end_point.dynamics_rows[painleve_determinant_row]
    lane_status = jnp.where(has_step_failed, Outcome.SOLVER_FAILED, LaneStatus.RUNNING)
    lane_status = jnp.where(has_reached_event, LaneStatus.EVENT, lane_status)
    lane_status = jnp.where(is_past_time_limit, Outcome.NO_TOUCHDOWN_IN_TIME, lane_status)
    is_at_singularity = is_state_updated & is_at_painleve_singularity(
        determinant_before, determinant_after, options
    )
    lane_status = jnp.where(is_at_singularity, Outcome.PAINLEVE_PARADOX, lane_status)
    return lane_states._replace(
        contact_interval_point=select_trees_by_condition(is_state_updated, end_point, start_point),
        guard_values=jnp.where(is_accepted, attempted_step.guard_values, lane_states.guard_values),
        interval_accumulators=interval_accumulators,
        h=jnp.where(is_running, next_step_size, h),
        time_since_event=time,
        event_bracket=select_trees_by_condition(is_running, next_bracket, event_bracket),
        lane_status=jnp.where(is_running, lane_status, lane_states.lane_status).astype(jnp.int32),
        triggered_guard_index=jnp.where(
            has_reached_event, event_guard, lane_states.triggered_guard_index
        ),
        n_solver_steps=lane_states.n_solver_steps + is_running,
    )


# Number of event iterations with parabolas. Later iterations use secants. Secants converge better
# if a guard is negative only for a short time.
N_PARABOLA_ITERATIONS = 3
# Number of event iterations after which an initiating guard may be the event.
MIN_ITERATIONS_OF_INITIATING_GUARD = 15
# Ratio of the event's time tolerance to the relative tolerance times the step size. The time
# tolerance limits the last correction to the time of an event. The value is chosen because the
# error of a parabola's root is about a hundredth of this correction.
EVENT_TIME_TOLERANCE_FACTOR = 30.0


def _iterate_event_search(
    lane_states: ContactIntervalState,
    attempted_step: AttemptedSolverStep,
    is_crossing: Array,
    guard_scales: Array,
    options: StepOptions,
) -> tuple[EventBracket, Array, Array, Array, Array]:
    """Return the event bracket after one more iteration, and the event if it has been located.

    The result is (bracket, step size of the next attempt in s, correction from this step size to
    that of the event in s, whether the event is within tolerance, index of its guard).

    The next step size is the earliest root of the parabolas or secants through the guards.
    """
    h, event_bracket = lane_states.h, lane_states.event_bracket
    is_searching = event_bracket.is_event_search_active
    is_guard_negative = attempted_step.guard_values <= 0.0
    is_guard_crossing = jnp.where(
        is_searching,
        event_bracket.is_guard_crossing | is_guard_negative,
        is_guard_negative,
    )
    parabolas = (
        lane_states.guard_values,
        attempted_step.guard_parabola_linear_term,
        attempted_step.guard_parabola_curvature,
    )
    root_fraction, guard_index = _find_earliest_root(
        *parabolas, is_guard_crossing, _flag_initiating_guards(lane_states)
    )
    secant_step_size, secant_guard = event_bracket.find_earliest_secant_root(
        attempted_step.guard_values, h, is_guard_crossing
    )
    uses_secant_step = is_searching & (event_bracket.n_iterations >= N_PARABOLA_ITERATIONS)
    proposed_step_size = jnp.where(uses_secant_step, secant_step_size, h * root_fraction)
    guard_index = jnp.where(uses_secant_step, secant_guard, guard_index)
    is_past_event = jnp.any(is_guard_crossing & is_guard_negative, axis=0)
    lower_step_size_bound = jnp.where(
        is_searching & ~is_past_event,
        h,
        event_bracket.lower_step_size_bound,
    )
    upper_step_size_bound = jnp.where(
        is_searching & is_past_event, h, event_bracket.upper_step_size_bound
    )
    lower_step_size_bound = jnp.where(is_crossing, 0.0, lower_step_size_bound)
    upper_step_size_bound = jnp.where(is_crossing, h, upper_step_size_bound)
    time_resolution = 1e3 * jnp.finfo(h.dtype).eps * (lane_states.time_since_event + h)
    time_tolerance = jnp.maximum(EVENT_TIME_TOLERANCE_FACTOR * options.rtol * h, time_resolution)
    time_tolerance = jnp.where(is_searching, event_bracket.time_tolerance, time_tolerance)
    is_step_in_bracket = (proposed_step_size >= lower_step_size_bound - time_tolerance) & (
        proposed_step_size <= upper_step_size_bound + time_tolerance
    )
    # If a guard is below zero for microseconds only, round-off moves proposals out of the bracket.
    # The bracket is then bisected.
    needs_bisection = ~is_step_in_bracket | (
        uses_secant_step & ((event_bracket.n_iterations & 3) == 3)
    )
    # An initiating guard falls again soon, or not at all.
    bisection_step_size = jnp.where(
        (lower_step_size_bound == 0.0) & jnp.isinf(proposed_step_size),
        0.125 * upper_step_size_bound,
        0.5 * (lower_step_size_bound + upper_step_size_bound),
    )
    next_step_size = jnp.where(needs_bisection, bisection_step_size, proposed_step_size)
    event_time_shift = next_step_size - h
    # If a guard is within its round-off, no other step size is better than this one.
    lowest_guard_value, lowest_guard = _find_lowest_guard(
        attempted_step.guard_values / guard_scales, is_guard_crossing
    )
    # An initiating guard is within twice its round-off. Without another event, the guard is the
    # event.
    guard_roundoff = (
        GUARD_ROUNDOFF_IN_EPS
        * jnp.where(
            event_bracket.n_iterations < MIN_ITERATIONS_OF_INITIATING_GUARD,
            1.0,
            3.0,
        )
        * jnp.finfo(h.dtype).eps
    )
    is_guard_within_roundoff = is_searching & (jnp.abs(lowest_guard_value) <= guard_roundoff)
    event_time_shift = jnp.where(is_guard_within_roundoff, 0.0, event_time_shift)
    guard_index = jnp.where(is_guard_within_roundoff, lowest_guard, guard_index)
    is_within_tolerance = is_searching & (jnp.abs(event_time_shift) <= time_tolerance)
    n_iterations = jnp.where(is_searching, event_bracket.n_iterations + 1, 0)
    is_event_search_active = (is_searching | is_crossing) & ~is_within_tolerance
    next_bracket = EventBracket(
        is_event_search_active,
        is_guard_crossing,
        lower_step_size_bound,
        upper_step_size_bound,
        time_tolerance,
        n_iterations,
        h,
        attempted_step.guard_values,
    )
    has_reached_event = is_within_tolerance & (lane_states.lane_status == LaneStatus.RUNNING)
    return next_bracket, next_step_size, event_time_shift, has_reached_event, guard_index


def _compute_squared_error(
    s: Symbols,
    options: StepOptions,
    error_estimates: tuple[Array, Array],
    start_point: ContactIntervalPoint,
    end_point: ContactIntervalPoint,
    guard_values: Array,
) -> Array:
    """Return the mean square of the error of a solver step, divided by the tolerance.

    The result is infinite for a solver step whose end is not finite.
    """
    squared_error_sum = 0.0 * jnp.sum(guard_values, axis=0)
    for error_rows, a, b, coordinate_unit in zip(
        error_estimates, start_point[:2], end_point[:2], compute_state_units(s), strict=True
    ):
        error_tolerance = options.atol * coordinate_unit + options.rtol * jnp.maximum(
            jnp.abs(a), jnp.abs(b)
        )
        squared_error_sum = squared_error_sum + jnp.sum(
            jnp.square(error_rows / error_tolerance), axis=0
        )
    return jnp.where(
        jnp.isfinite(squared_error_sum), squared_error_sum / (2 * start_point.q.shape[0]), jnp.inf
    )


def _flag_initiating_guards(lane_states: ContactIntervalState) -> Array:
    """Return which guards are initiating guards at the start of their interval, (guards, batch)."""
    return (lane_states.time_since_event == 0.0) & (lane_states.guard_offset != 0.0)


def _find_lowest_guard(
    guard_values: Array, is_candidate: Array, index_without_candidate: Array | None = None
) -> tuple[Array, Array]:
    """Return the lowest of the candidates' values, one per guard, and the index of its guard.

    Without a candidate the value is infinite, and the index is `index_without_candidate`, or 0.
    """
    lowest_value = jnp.full_like(guard_values[0], jnp.inf)
    lowest_guard = (
        jnp.zeros(guard_values.shape[1:], jnp.int32)
        if index_without_candidate is None
        else index_without_candidate
    )
    for guard_index in range(len(guard_values)):
        is_lower = is_candidate[guard_index] & (guard_values[guard_index] < lowest_value)
        lowest_value = jnp.where(is_lower, guard_values[guard_index], lowest_value)
        lowest_guard = jnp.where(is_lower, guard_index, lowest_guard)
    return lowest_value, lowest_guard


def _find_earliest_root(
    start_guard_values: Array,
    parabola_linear_term: Array,
    parabola_curvature: Array,
    is_guard_crossing: Array,
    is_initiating: Array,
) -> tuple[Array, Array]:
    """Return the earliest root of the crossing guards' parabolas, and the index of the guard.

    The root is a fraction of the solver step. It is infinite if no parabola falls to zero in the
    step. An initiating guard rises first. If its parabola falls immediately, the step is too long
    for parabolas. The root is minus infinity if such a parabola ends below zero.
    """
    discriminant = (
        parabola_linear_term * parabola_linear_term - 4.0 * parabola_curvature * start_guard_values
    )
    sqrt_discriminant = jnp.sqrt(jnp.maximum(discriminant, 0.0))
    is_guard_falling = parabola_linear_term < 0.0
    root_numerator = jnp.where(
        is_guard_falling, 2.0 * start_guard_values, -parabola_linear_term - sqrt_discriminant
    )
    parabola_root_denominator = jnp.where(
        is_guard_falling, sqrt_discriminant - parabola_linear_term, 2.0 * parabola_curvature
    )
    root_fraction = root_numerator / jnp.where(
        parabola_root_denominator == 0.0, 1.0, parabola_root_denominator
    )
    has_guard_root = (
        is_guard_crossing
        & (discriminant >= 0.0)
        & (parabola_root_denominator != 0.0)
        & (root_fraction > 0.0)
    )
    has_guard_root = has_guard_root & ~(is_initiating & is_guard_falling)
    is_already_negative = (
        is_guard_crossing
        & ~has_guard_root
        & (start_guard_values + parabola_linear_term + parabola_curvature < 0.0)
    )
    root_fraction = jnp.where(is_already_negative, -jnp.inf, root_fraction)
    has_guard_root = has_guard_root | is_already_negative
    return _find_lowest_guard(root_fraction, has_guard_root, find_first_guard(is_guard_crossing, 0))
