"""Event loop of walks with unilateral contact, for every engine.

The laws are elementwise over lanes. Each iteration resolves the events of all lanes at an event,
then integrates all lanes further. A landing of the foremost foot is an event like any other. The
batch kernel integrates many lanes (`integrate_interval`). On a CPU, its loop is one machine-code
program in which few lanes are idle. Elsewhere XLA compiles the same source. diffrax integrates a
single lane (`integrate_by_diffrax`).
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from vrw_jax.contact.batch_integrator import (
    N_ACCUMULATOR_ROWS,
    IntervalPoint,
    IntervalState,
    LaneStatus,
    init_interval,
    integrate_interval,
    motion_from_point,
    pack_coordinates,
)
from vrw_jax.contact.contact_modes import Friction
from vrw_jax.contact.contact_state import (
    Accumulators,
    ContactState,
    ModeDynamics,
    choose_stopping_guard,
    compute_forces,
    is_wheel_at_rest,
    make_guard_layout,
    make_mode_dynamics,
    min_stopper_force,
)
from vrw_jax.contact.diffrax_interval import init_diffrax_interval, integrate_by_diffrax
from vrw_jax.contact.mechanics import WheelMotion, landing_position, stop_gradients
from vrw_jax.contact.section import pack_section_state, replace_invalid_start, unpack_section_state
from vrw_jax.contact.step_record import (
    StepCounters,
    StepDetails,
    add_interval,
    apply_friction_rule,
    determine_interval_outcome,
    final_section_state,
    init_counters,
    init_details,
    make_contact_law,
    make_unilateral_step,
    process_event,
    record_event,
    record_interval,
)
from vrw_jax.integrator import ButcherTableau
from vrw_jax.numerics import (
    StepOptions,
    make_opaque_condition,
    make_zeros_like_output,
    select_tree_leaves,
)
from vrw_jax.wheel import (
    PARAMETER_NAMES,
    Outcome,
    Symbols,
    compute_symbols,
    make_wheel_from_parameters,
    stack_parameters,
)

N_PARAMETERS = len(PARAMETER_NAMES)
"""Number of input columns that hold parameters. The column of friction follows."""
N_UNEVEN_COLUMNS = 2
"""Number of further input columns on uneven ground: friction of the feet that landed earlier, and
the angle by which the next line is steeper, rad. The column of restitution, if given, is last."""
STATUS_UNFINISHED = -1
"""Code in place of the outcome of a lane whose walk is unfinished."""


class StepSummary(NamedTuple):
    """Section state, durations and length of the last step of a walk, without details."""

    section_state: Array
    durations: Array  # (3, lanes)
    step_length: Array


class BatchWalkResult(NamedTuple):
    """Result of a walk, for every lane."""

    step_result: Any  # `StepSummary` or `UnilateralStep` of the last step
    outcome: Array
    n_stepped: Array
    n_solver_steps: Array


def make_result_template(n: int, dtype: Any, is_detailed: bool) -> BatchWalkResult:
    """Return zeros in the structure of the batch kernel's result for one wheel with `n` legs.

    - `is_detailed`: whether the step is a `UnilateralStep`.
    """
    float_zero, int_zero = jnp.zeros((), dtype), jnp.zeros((), jnp.int32)
    leg_zeros, off_modes = jnp.zeros(n, dtype), jnp.zeros(n, jnp.int32)
    final_state = (
        WheelMotion(*(float_zero,) * 6, leg_zeros, leg_zeros),
        ContactState(off_modes, *(off_modes > 0,) * 4),
    )
    step_result: Any = StepSummary(
        pack_section_state(*final_state), jnp.zeros(3, dtype), float_zero
    )
    if is_detailed:
        accumulators = Accumulators(float_zero, float_zero, float_zero, float_zero)
        step_result = make_unilateral_step(
            *final_state,
            accumulators,
            init_counters(float_zero),
            init_details(dtype),
            int_zero,
            "lanes",
        )
    return BatchWalkResult(step_result, int_zero, int_zero, int_zero)


class DifferentiableLaneState(NamedTuple):
    """Differentiable part of a lane's state, or a tangent of this part."""

    q: Array
    v: Array
    accumulators: tuple[Array | None, Array | None]  # of this step, and since the last event
    time: Array
    durations: Array
    details: Any  # floats of the details


class LaneState(NamedTuple):
    """State of all lanes between two iterations of the kernel."""

    interval: IntervalState
    counters: StepCounters  # of this step, but solver steps of the walk
    details: StepDetails | None  # details of this step, if requested
    step_accumulators: Array | None  # integrals over this step, rows as in `IntervalState`
    n_stepped: Array
    outcome: Array

    def get_differentiable(self) -> DifferentiableLaneState:
        """Return the differentiable part of the lane state."""
        point, details = self.interval.point, eqx.filter(self.details, eqx.is_inexact_array)
        accumulators = self.step_accumulators, self.interval.interval_accumulators
        return DifferentiableLaneState(
            point.q, point.v, accumulators, self.interval.time, self.counters.durations, details
        )

    def replace_differentiable(self, differentiable_state: DifferentiableLaneState) -> "LaneState":
        """Return the lane state with its differentiable part replaced."""
        step_accumulators, interval_accumulators = differentiable_state.accumulators
        point = self.interval.point._replace(q=differentiable_state.q, v=differentiable_state.v)
        other_details = eqx.filter(self.details, eqx.is_inexact_array, inverse=True)
        return self._replace(
            interval=self.interval._replace(
                point=point,
                interval_accumulators=interval_accumulators,
                time=differentiable_state.time,
            ),
            counters=self.counters._replace(durations=differentiable_state.durations),
            details=eqx.combine(differentiable_state.details, other_details),
            step_accumulators=step_accumulators,
        )


class BatchWalkSettings(NamedTuple):
    """Settings common to all wheels of a batch, and the functions of a walk."""

    n_legs: int
    n_steps: Array | int
    max_events: int
    is_one_sided: bool
    uses_paper_rule: bool
    is_detailed: bool  # whether a `UnilateralStep` is requested
    options: StepOptions
    tableau: ButcherTableau | None  # tableau of the batch kernel; None if diffrax integrates
    is_uneven: bool = False  # whether the input has `N_UNEVEN_COLUMNS`; one step only
    has_restitution: bool = False  # whether the last input column is restitution
    engine_name: str = "lanes"  # name of the engine in the results

    def make_dynamics(self, input_columns: Array, contact_state: ContactState) -> ModeDynamics:
        """Return the dynamics of the lanes in this contact state."""
        s, friction = self.unpack_columns(input_columns)
        dynamics_arguments = (
            self.is_one_sided,
            contact_state,
            self.is_detailed,
            self.tilt(input_columns),
        )
        return make_mode_dynamics(s, friction, *dynamics_arguments)

    def unpack_columns(self, input_columns: Array) -> tuple[Symbols, Friction]:
        """Return the symbols and the friction of the lanes from their input columns."""
        s = compute_symbols(self.n_legs, *input_columns[:N_PARAMETERS])
        friction = apply_friction_rule(input_columns[N_PARAMETERS], self.uses_paper_rule)
        if not self.is_uneven:
            return s, friction
        previous_friction = apply_friction_rule(
            input_columns[N_PARAMETERS + 1], self.uses_paper_rule
        )
        return s, (friction, previous_friction)

    def tilt(self, input_columns: Array) -> Array | None:
        """Return the angle by which the next line is steeper, rad; None on flat ground."""
        return input_columns[N_PARAMETERS + 2] if self.is_uneven else None

    def restitution(self, input_columns: Array) -> Array | None:
        """Return Newton's coefficient of restitution of the feet, None if it is 0."""
        return input_columns[-1] if self.has_restitution else None

    def begin_walk(self, input_columns: Array, x: Array) -> LaneState:
        """Return the state of the lanes at the first landing of their walk, before the impact is
        resolved.
        """
        motion, contact_state = unpack_section_state(self.unpack_columns(input_columns)[0], x)
        dynamics = self.make_dynamics(input_columns, contact_state)
        interval = make_zeros_like_output(lambda: self.begin_interval(dynamics, motion))
        q, v = pack_coordinates(motion)
        point = IntervalPoint(q, v, jnp.full_like(interval.point.dynamics_rows, jnp.inf))
        interval = interval._replace(
            point=point, contact_state=contact_state, status=interval.status + LaneStatus.EVENT
        )
        return LaneState(
            interval,
            *self._init_records(x[0]),
            interval.triggered_guard * 0,
            interval.triggered_guard * 0 + STATUS_UNFINISHED,
        )

    def begin_interval(self, dynamics: ModeDynamics, motion: WheelMotion) -> IntervalState:
        """Return the lanes at the start of a contact state, without derivatives."""
        dynamics, motion, dt0 = stop_gradients((dynamics, motion, self.options.dt0))
        if self.tableau is None:
            return init_diffrax_interval(dynamics, motion)
        return init_interval(dynamics, motion, dt0)

    def _init_records(
        self, template: Array
    ) -> tuple[StepCounters, StepDetails | None, Array | None]:
        """Return counters, details and accumulators at the start of a step.

        Details and accumulators are None if they are not requested.
        """
        if not self.is_detailed:
            return init_counters(template), None, None
        broadcast_to_lanes = lambda leaf: jnp.broadcast_to(
            leaf[..., None], (*leaf.shape, *template.shape)
        )
        details = jax.tree.map(broadcast_to_lanes, init_details(template.dtype))
        return (
            init_counters(template),
            details,
            jnp.zeros((N_ACCUMULATOR_ROWS, *template.shape), template.dtype),
        )

    def process_events(self, input_columns: Array, lane_state: LaneState) -> LaneState:
        """Return the lanes with their events resolved.

        A lane at the end of its walk gets its outcome. Running lanes are unchanged.
        """
        interval, guard_layout = (
            lane_state.interval,
            make_guard_layout(self.n_legs, self.is_one_sided),
        )
        s, friction = self.unpack_columns(input_columns)
        dynamics_before = self.make_dynamics(input_columns, interval.contact_state)
        rates = lax.stop_gradient(interval.point.v)
        accelerations = lax.stop_gradient(interval.point.dynamics_rows[: len(rates)])
        is_resting = is_wheel_at_rest(s, rates, accelerations, self.options.atol)
        guard_arguments = (
            guard_layout,
            dynamics_before,
            rates,
            interval.triggered_guard,
            self.options.atol,
        )
        interval = interval._replace(triggered_guard=choose_stopping_guard(*guard_arguments))
        counters = add_interval(
            lane_state.counters, interval.contact_state, interval.time, interval.n_solver_steps
        )
        details, step_accumulators = lane_state.details, lane_state.step_accumulators
        if (
            details is not None
            and step_accumulators is not None
            and interval.interval_accumulators is not None
        ):
            details = record_stopper_force(
                details, dynamics_before, motion_from_point(interval.point), interval.time
            )
            step_accumulators = step_accumulators + interval.interval_accumulators
        is_at_event = interval.status == LaneStatus.EVENT
        has_landed = is_at_event & (interval.triggered_guard == guard_layout.foremost_landing)
        outcome_arguments = (
            counters,
            guard_layout,
            is_at_event,
            interval.triggered_guard,
            has_landed,
            interval.status,
        )
        outcome = determine_interval_outcome(
            *outcome_arguments, is_resting, self.max_events
        ).astype(jnp.int32)
        n_stepped = lane_state.n_stepped + has_landed
        has_ended = (outcome != Outcome.STEPPED) | (has_landed & (n_stepped >= self.n_steps))
        ended_lane = LaneState(interval, counters, details, step_accumulators, n_stepped, outcome)

        # A landing of the foremost foot opens the next step. Then every event is processed.
        opens_step, motion = has_landed & ~has_ended, motion_from_point(interval.point)
        opened_state = unpack_section_state(s, pack_section_state(motion, interval.contact_state))
        motion, contact_state = select_tree_leaves(
            opens_step, opened_state, (motion, interval.contact_state)
        )
        new_counters, *new_records = self._init_records(motion.x)
        new_counters = new_counters._replace(n_solver_steps=counters.n_solver_steps)
        counters, details, step_accumulators = select_tree_leaves(
            opens_step, (new_counters, *new_records), (counters, details, step_accumulators)
        )
        guard = jnp.where(opens_step, guard_layout.landing, interval.triggered_guard)
        law_arguments = s, friction, self.options, self.is_one_sided, self.is_detailed
        contact_law = make_contact_law(
            *law_arguments, self.restitution(input_columns), self.tilt(input_columns)
        )
        event_arguments = guard, counters.n_events, self.max_events
        event_result, event, event_outcome = process_event(
            contact_law, guard_layout, motion, contact_state, *event_arguments
        )
        dynamics = self.make_dynamics(input_columns, event_result.contact_state)
        next_interval = self.begin_interval(dynamics, event_result.motion)
        q, v = pack_coordinates(event_result.motion)
        status = jnp.where(event_outcome != Outcome.STEPPED, event_outcome, next_interval.status)
        next_interval = next_interval._replace(
            point=next_interval.point._replace(q=q, v=v), status=status
        )
        if details is not None:
            details = record_event(details, counters.n_events == 0, event_result, event)
            zero_duration = jnp.zeros_like(motion.x)
            details = record_stopper_force(details, dynamics, event_result.motion, zero_duration)
        counters = counters._replace(n_events=counters.n_events + 1)
        continued_lane = LaneState(
            next_interval, counters, details, step_accumulators, n_stepped, lane_state.outcome
        )
        has_interval_ended = (interval.status != LaneStatus.RUNNING) & (
            lane_state.outcome == STATUS_UNFINISHED
        )
        return select_tree_leaves(
            has_interval_ended,
            select_tree_leaves(has_ended, ended_lane, continued_lane),
            lane_state,
        )

    def compute_result(self, lane_state: LaneState, tilt: Array | None) -> Any:
        """Return the result of the last step of lanes whose walk has ended."""
        final_state = (
            motion_from_point(lane_state.interval.point),
            lane_state.interval.contact_state,
        )
        outcome = lane_state.outcome
        if lane_state.details is not None and lane_state.step_accumulators is not None:
            accumulators = Accumulators(
                jnp.zeros_like(lane_state.step_accumulators[0]), *lane_state.step_accumulators
            )
            return make_unilateral_step(
                *final_state,
                accumulators,
                lane_state.counters,
                lane_state.details,
                outcome,
                self.engine_name,
                tilt,
            )
        return self.summarize_step(final_state, lane_state.counters, outcome, tilt)

    def summarize_step(
        self,
        final_state: tuple[WheelMotion, ContactState],
        counters: StepCounters,
        outcome: Array,
        tilt: Array | None,
    ) -> StepSummary:
        """Return the summary of a step that has ended."""
        step_length = jnp.where(
            outcome == Outcome.STEPPED, landing_position(self.n_legs, final_state[0]), 0.0
        )
        return StepSummary(
            final_section_state(*final_state, outcome, tilt), counters.durations, step_length
        )

    def replace_invalid(self, input_columns: Array, x: Array) -> tuple[Array, Array, Array]:
        """Return input columns and states with invalid lanes replaced, and the valid lanes."""
        start_arguments = (
            make_wheel_from_parameters(input_columns[:N_PARAMETERS], self.n_legs),
            input_columns[N_PARAMETERS],
            x,
            self.tilt(input_columns),
        )
        is_valid, params, friction, x = replace_invalid_start(*start_arguments)
        column_rows = [*stack_parameters(params), friction]
        if self.is_uneven:
            previous_friction, tilt = input_columns[N_PARAMETERS + 1 : N_PARAMETERS + 3]
            column_rows += [
                jnp.where(is_valid, previous_friction, 1.0),
                jnp.where(is_valid, tilt, 0.0),
            ]
        if self.has_restitution:
            column_rows.append(input_columns[-1])
        return jnp.stack(column_rows), x, is_valid

    def deactivate_invalid(self, lane_state: LaneState, is_valid: Array) -> LaneState:
        """Return the lanes, with the outcome BAD_INPUT where a lane is invalid."""
        return lane_state._replace(
            outcome=jnp.where(is_valid, lane_state.outcome, Outcome.BAD_INPUT)
        )


def record_stopper_force(
    details: StepDetails, dynamics: ModeDynamics, motion: WheelMotion, duration: Array
) -> StepDetails:
    """Return the details with the stopper forces at one end of an interval of this duration (s)."""
    stopper_force = min_stopper_force(dynamics, compute_forces(dynamics, motion))
    return record_interval(details, dynamics.slot_modes, duration, stopper_force)


def init_lane_states(
    walk_settings: BatchWalkSettings, input_columns: Array, x: Array
) -> tuple[Array, LaneState]:
    """Return valid input columns, and the lanes before their first landing."""
    input_columns, x, is_valid = walk_settings.replace_invalid(input_columns, x)
    return input_columns, walk_settings.deactivate_invalid(
        walk_settings.begin_walk(input_columns, x), is_valid
    )


def process_and_integrate(
    walk_settings: BatchWalkSettings,
    input_columns: Array,
    lane_state: LaneState,
    waits_for_events: bool = False,
) -> tuple[LaneState, LaneState]:
    """Return the lanes after their events, and the lanes integrated further.

    - `waits_for_events`: whether every lane is integrated to its next event.
    """
    state_after_events = walk_settings.process_events(input_columns, lane_state)
    tableau = walk_settings.tableau
    if tableau is None:
        interval = integrate_by_diffrax(
            walk_settings.make_dynamics,
            input_columns,
            state_after_events.interval,
            walk_settings.options,
        )
        return state_after_events, state_after_events._replace(interval=interval)
    has_unfinished_walk = state_after_events.outcome == STATUS_UNFINISHED
    dynamics_fn = lambda input_columns_at: walk_settings.make_dynamics(
        input_columns_at, state_after_events.interval.contact_state
    )
    has_unfinished_walk = has_unfinished_walk & (not waits_for_events)
    interval = integrate_interval(
        dynamics_fn,
        input_columns,
        state_after_events.interval,
        has_unfinished_walk,
        walk_settings.options,
        tableau,
    )
    return state_after_events, state_after_events._replace(interval=interval)


def run_walks(walk_settings: BatchWalkSettings, input_columns: Array, x: Array) -> BatchWalkResult:
    """Return the result of every lane after `n_steps` landings of the foremost foot."""
    input_columns, lane_state = init_lane_states(walk_settings, input_columns, x)
    run_iteration = lambda lane_state: process_and_integrate(
        walk_settings, input_columns, lane_state
    )[1]
    should_continue = lambda lane_state: jnp.any(
        make_opaque_condition(lane_state.outcome == STATUS_UNFINISHED, lane_state.counters.n_events)
    )
    lane_state = lax.while_loop(should_continue, run_iteration, lane_state)
    return BatchWalkResult(
        walk_settings.compute_result(lane_state, walk_settings.tilt(input_columns)),
        lane_state.outcome,
        lane_state.n_stepped,
        lane_state.counters.n_solver_steps,
    )
