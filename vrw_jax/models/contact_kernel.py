"""Event loop for walks with unilateral contact, common to all engines.

All laws of contact and impact are elementwise over the batch. A batch element is called a *lane*.
Each iteration resolves the events of all elements at an event, then integrates all elements
further. The landing of the foremost foot is an event like any other.

The batch kernel integrates many elements (`integrate_contact_interval`). On a CPU, its loop is one
machine-code program in which few elements are idle. On other devices, XLA compiles the same source.
diffrax integrates a single element (`integrate_by_diffrax`).
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from vrw_jax.base.elementwise import make_opaque_loop_condition, select_trees_by_condition
from vrw_jax.base.options import StepOptions
from vrw_jax.base.outcomes import Outcome
from vrw_jax.flow.tableaus import ButcherTableau
from vrw_jax.lanes.batching import make_zeros_like_output
from vrw_jax.models.contact_diffrax import init_diffrax_contact_interval, integrate_by_diffrax
from vrw_jax.models.contact_impacts import ContactLaw
from vrw_jax.models.contact_integrator import (
    N_ACCUMULATOR_ROWS,
    ContactIntervalPoint,
    ContactIntervalState,
    LaneStatus,
    init_contact_interval,
    integrate_contact_interval,
    pack_coordinates,
    unpack_motion,
)
from vrw_jax.models.contact_mechanics import (
    Friction,
    WheelMotion,
    compute_landing_position,
    stop_gradients,
)
from vrw_jax.models.contact_record import (
    GaitStepCounters,
    GaitStepSummary,
    UnilateralStepDetails,
    apply_friction_rule,
    compute_rest_speed,
    count_contact_interval,
    determine_interval_outcome,
    init_step_counters,
    init_step_details,
    make_unilateral_step,
    process_event,
    record_contact_interval,
    record_event,
    record_force_extremum,
)
from vrw_jax.models.contact_section import (
    compute_section_foot_distance,
    pack_section_state,
    replace_invalid_start,
    unpack_section_state,
)
from vrw_jax.models.contact_state import (
    ContactModeDynamics,
    ContactState,
    NormalForceRates,
    choose_stopping_guard,
    flag_zero_force_rates,
    is_wheel_at_rest,
    make_contact_mode_dynamics,
    update_force_rate_signs,
)
from vrw_jax.models.phase_sequence import find_stance_slope
from vrw_jax.wheel.ground import GroundAhead
from vrw_jax.wheel.params import (
    NO_LAWS,
    PARAMETER_NAMES,
    Symbols,
    add_laws,
    compute_symbols,
    make_wheel_from_parameters,
    stack_parameters,
)

SLOPE_INDEX = PARAMETER_NAMES.index("slope")
N_HEIGHT_COLUMNS = 3
"""Number of further input columns if the heights of the footholds are given.

They are the friction coefficient of the feet that landed earlier, and the two rises of
`models.select_stance_line`, m. If slopes are given, two further columns are this friction
coefficient and the angle by which the next straight line is steeper, rad. If restitution is an
input, its column is last.
"""
STATUS_UNFINISHED = -1
"""Value that replaces the outcome code as long as a walk is unfinished."""


class BatchWalkResult(NamedTuple):
    """Results of the walks of all batch elements."""

    step_result: Any  # `GaitStepSummary` or `UnilateralStep` of the last step
    outcome: Array
    n_stepped: Array
    n_solver_steps: Array


class DifferentiableLaneState(NamedTuple):
    """Differentiable arrays in the state of all batch elements, or tangents of these arrays."""

    q: Array
    v: Array
    interval_accumulators: Array | None
    time_since_event: Array
    step_accumulators: Array | None
    durations: Array
    step_details: Any  # floats of the details


class LaneState(NamedTuple):
    """State of all batch elements between two iterations of the event loop."""

    contact_interval_state: ContactIntervalState
    step_counters: GaitStepCounters  # counters of this step; solver steps are counted over the walk
    step_details: UnilateralStepDetails | None  # details of this step, if requested
    step_energy_loss_accumulators: (
        Array | None
    )  # integrals over this step, rows as in `ContactIntervalState`
    n_stepped: Array
    walk_outcome: Array

    def get_differentiable_state(self) -> DifferentiableLaneState:
        """Return the differentiable arrays of the state."""
        interval_state = self.contact_interval_state
        return DifferentiableLaneState(
            interval_state.contact_interval_point.q,
            interval_state.contact_interval_point.v,
            interval_state.interval_accumulators,
            interval_state.time_since_event,
            self.step_energy_loss_accumulators,
            self.step_counters.durations,
            eqx.filter(self.step_details, eqx.is_inexact_array),
        )

    def replace_differentiable_state(
        self, differentiable_state: DifferentiableLaneState
    ) -> "LaneState":
        """Return the state with its differentiable arrays replaced."""
        q, v, interval_accumulators, time_since_event, step_accumulators, durations, details = (
            differentiable_state
        )
        nonfloat_details = eqx.filter(self.step_details, eqx.is_inexact_array, inverse=True)
        interval_state = self.contact_interval_state
        return self._replace(
            contact_interval_state=interval_state._replace(
                contact_interval_point=interval_state.contact_interval_point._replace(q=q, v=v),
                interval_accumulators=interval_accumulators,
                time_since_event=time_since_event,
            ),
            step_counters=self.step_counters._replace(durations=durations),
            step_details=eqx.combine(details, nonfloat_details),
            step_energy_loss_accumulators=step_accumulators,
        )


class BatchWalkSettings(NamedTuple):
    """Settings that are common to all wheels of a batch, and functions of their walks."""

    n_legs: int
    n_steps: Array | int
    max_events: int
    has_one_sided_stoppers: bool
    uses_paper_rule: bool
    is_detailed: bool  # whether a `UnilateralStep` is requested
    step_options: StepOptions
    tableau: ButcherTableau | None  # tableau of the batch kernel; None if diffrax integrates
    n_ground_columns: int = 0  # see `N_HEIGHT_COLUMNS`; on uneven ground, walks have one step
    has_restitution: bool = False  # whether the last input column is restitution
    engine_name: str = "lanes"  # name of the engine in the results
    # whether the extrema of normal forces are located; only if details are requested
    measures_force_peaks: bool = False
    law_structure: Any = NO_LAWS  # structure of the laws as a pytree

    @property
    def friction_index(self) -> int:
        """Return the index of friction in the input columns, after those of wheel and laws."""
        return len(PARAMETER_NAMES) + self.law_structure.num_leaves

    def make_lane_contact_dynamics(
        self, input_columns: Array, contact_state: ContactState
    ) -> ContactModeDynamics:
        """Return the dynamics of all batch elements in their contact states."""
        s, friction = self.unpack_input_columns(input_columns)
        return make_contact_mode_dynamics(
            s,
            friction,
            self.has_one_sided_stoppers,
            contact_state,
            self.is_detailed,
            self.extract_ground_ahead(input_columns),
        )

    def unpack_input_columns(self, input_columns: Array) -> tuple[Symbols, Friction]:
        """Return wheel symbols and friction coefficients from the input columns, (inputs, batch).

        On uneven ground, the second result is a pair: friction of the foot that landed last, and of
        the feet that landed earlier.
        """
        n_wheel_columns = len(PARAMETER_NAMES)
        laws: Any = jax.tree.unflatten(
            self.law_structure, list(input_columns[n_wheel_columns : self.friction_index])
        )
        s = add_laws(compute_symbols(self.n_legs, *input_columns[:n_wheel_columns]), laws)
        friction = apply_friction_rule(input_columns[self.friction_index], self.uses_paper_rule)
        if not self.n_ground_columns:
            return s, friction
        previous_friction = apply_friction_rule(
            input_columns[self.friction_index + 1], self.uses_paper_rule
        )
        return s, (friction, previous_friction)

    def extract_ground_ahead(self, input_columns: Array) -> GroundAhead | None:
        """Return the ground ahead for columns that `resolve_heights` returned, or None on flat
        ground.
        """
        first, end = self.friction_index + 2, self.friction_index + 1 + self.n_ground_columns
        return GroundAhead(*input_columns[first:end]) if self.n_ground_columns else None

    def resolve_heights(self, input_columns: Array, section_state: Array) -> Array:
        """Return the input columns with the slope under both feet, and with the tilt and the rise
        of `GroundAhead` instead of two rises.

        Columns without heights are unchanged.
        """
        if self.n_ground_columns != N_HEIGHT_COLUMNS:
            return input_columns
        columns, rise_index = list(input_columns), self.friction_index + 2
        mean_slope, rise = columns[SLOPE_INDEX], columns[rise_index]
        foot_distance = compute_section_foot_distance(
            self.unpack_input_columns(input_columns)[0], section_state
        )
        columns[SLOPE_INDEX] = find_stance_slope(mean_slope, rise, foot_distance)
        columns[rise_index] = mean_slope - columns[SLOPE_INDEX]
        return jnp.stack(columns)

    def begin_walk(self, input_columns: Array, section_state: Array) -> LaneState:
        """Return the state of all batch elements at the first landing, before the impact."""
        motion, contact_state = unpack_section_state(
            self.unpack_input_columns(input_columns)[0], section_state
        )
        if self.measures_force_peaks:
            unit_signs = jnp.stack([jnp.ones_like(motion.x)] * len(NormalForceRates._fields))
            contact_state = contact_state._replace(force_rate_signs=unit_signs)
        contact_mode_dynamics = self.make_lane_contact_dynamics(input_columns, contact_state)
        interval_state = make_zeros_like_output(
            lambda: self.begin_contact_interval(contact_mode_dynamics, motion)
        )
        q, v = pack_coordinates(motion)
        infinite_rows = jnp.full_like(interval_state.contact_interval_point.dynamics_rows, jnp.inf)
        interval_state = interval_state._replace(
            contact_interval_point=ContactIntervalPoint(q, v, infinite_rows),
            contact_state=contact_state,
            lane_status=interval_state.lane_status + LaneStatus.EVENT,
        )
        int_zero_lanes = jnp.zeros_like(interval_state.triggered_guard_index)
        return LaneState(
            interval_state,
            *self._init_step_records(section_state[0]),
            int_zero_lanes,
            int_zero_lanes + STATUS_UNFINISHED,
        )

    def begin_contact_interval(
        self, contact_mode_dynamics: ContactModeDynamics, motion: WheelMotion
    ) -> ContactIntervalState:
        """Return the state at the start of an interval between events, without derivatives."""
        contact_mode_dynamics, motion, dt0 = stop_gradients(
            (contact_mode_dynamics, motion, self.step_options.dt0)
        )
        if self.tableau is None:
            return init_diffrax_contact_interval(contact_mode_dynamics, motion)
        return init_contact_interval(contact_mode_dynamics, motion, dt0)

    def _init_step_records(
        self, lane_template: Array
    ) -> tuple[GaitStepCounters, UnilateralStepDetails | None, Array | None]:
        """Return step counters, step details and loss accumulators at the start of a step.

        Details and accumulators are None if no details are requested.
        """
        if not self.is_detailed:
            return init_step_counters(lane_template), None, None
        return (
            init_step_counters(lane_template),
            init_step_details(lane_template, self.measures_force_peaks),
            jnp.zeros((N_ACCUMULATOR_ROWS, *lane_template.shape), lane_template.dtype),
        )

    def process_events(self, input_columns: Array, lane_state: LaneState) -> LaneState:
        """Return the state of all batch elements after their events are resolved.

        If a walk ends, its outcome is set. Running elements are unchanged.
        """
        interval_state = lane_state.contact_interval_state
        contact_state = interval_state.contact_state
        motion = unpack_motion(interval_state.contact_interval_point)
        s, friction = self.unpack_input_columns(input_columns)
        dynamics_before = self.make_lane_contact_dynamics(input_columns, contact_state)
        guard_layout = dynamics_before.guard_layout
        _, rates, dynamics_rows = lax.stop_gradient(interval_state.contact_interval_point)
        is_resting = is_wheel_at_rest(s, rates, dynamics_rows[: len(rates)], self.step_options.atol)
        guard_index = choose_stopping_guard(
            dynamics_before, rates, interval_state.triggered_guard_index, self.step_options.atol
        )
        interval_state = interval_state._replace(triggered_guard_index=guard_index)
        step_counters = count_contact_interval(
            lane_state.step_counters,
            contact_state,
            interval_state.time_since_event,
            interval_state.n_solver_steps,
        )
        step_details: Any = lane_state.step_details
        step_accumulators: Any = lane_state.step_energy_loss_accumulators
        n_events = step_counters.n_events
        if self.is_detailed:
            step_details = record_contact_interval(
                step_details, dynamics_before, motion, interval_state.time_since_event
            )
            step_accumulators = step_accumulators + interval_state.interval_accumulators
        if self.measures_force_peaks:
            n_events = n_events + step_details.force_peaks.n_force_extrema
        is_at_event = interval_state.lane_status == LaneStatus.EVENT
        has_landed = is_at_event & (guard_index == guard_layout.foremost_landing_guard)
        outcome = determine_interval_outcome(
            n_events,
            guard_layout,
            is_at_event,
            guard_index,
            has_landed,
            interval_state.lane_status,
            is_resting,
            self.max_events,
        ).astype(jnp.int32)
        n_stepped = lane_state.n_stepped + has_landed
        has_ended = (outcome != Outcome.STEPPED) | (has_landed & (n_stepped >= self.n_steps))
        ended_lane_state = LaneState(
            interval_state, step_counters, step_details, step_accumulators, n_stepped, outcome
        )

        # A landing of the foremost foot opens the next step. Then every event is processed.
        begins_step = has_landed & ~has_ended
        motion_at_step_start, contact_state_at_step_start = unpack_section_state(
            s, pack_section_state(s, motion, contact_state)
        )
        contact_state_at_step_start = contact_state_at_step_start._replace(
            force_rate_signs=contact_state.force_rate_signs
        )
        motion, contact_state = select_trees_by_condition(
            begins_step,
            (motion_at_step_start, contact_state_at_step_start),
            (motion, contact_state),
        )
        initial_counters, *initial_records = self._init_step_records(motion.x)
        initial_counters = initial_counters._replace(n_solver_steps=step_counters.n_solver_steps)
        step_counters, step_details, step_accumulators = select_trees_by_condition(
            begins_step,
            (initial_counters, *initial_records),
            (step_counters, step_details, step_accumulators),
        )
        guard_index = jnp.where(begins_step, guard_layout.first_landing_guard, guard_index)
        contact_law = ContactLaw(
            s,
            friction,
            self.has_one_sided_stoppers,
            self.is_detailed,
            compute_rest_speed(s, self.step_options),
            input_columns[-1] if self.has_restitution else None,
            self.extract_ground_ahead(input_columns),
        )
        event_result, contact_event, event_outcome = process_event(
            contact_law,
            guard_layout,
            motion,
            contact_state,
            guard_index,
            step_counters.n_events,
            self.max_events,
        )
        # At the extremum of a force, motion and contacts continue without change.
        n_contact_events: Any = 1
        if self.measures_force_peaks:
            is_contact_event = guard_index < guard_layout.first_force_rate_guard
            n_contact_events = is_contact_event.astype(jnp.int32)
            is_rate_zero = flag_zero_force_rates(guard_layout, guard_index)
            step_details = step_details._replace(
                force_peaks=record_force_extremum(
                    step_details.force_peaks, is_rate_zero, dynamics_before, motion
                )
            )
            event_outcome = jnp.where(is_contact_event, event_outcome, Outcome.STEPPED)
            motion_after, contact_state_after = select_trees_by_condition(
                is_contact_event,
                (event_result.motion, event_result.contact_state),
                (motion, ContactState.without_recent_changes(*contact_state[:2])),
            )
            dynamics_after = self.make_lane_contact_dynamics(input_columns, contact_state_after)
            force_rate_signs = update_force_rate_signs(
                dynamics_after, motion_after, contact_state.force_rate_signs, is_rate_zero
            )
            event_result = event_result._replace(
                motion=motion_after,
                contact_state=contact_state_after._replace(force_rate_signs=force_rate_signs),
            )
        contact_mode_dynamics = self.make_lane_contact_dynamics(
            input_columns, event_result.contact_state
        )
        next_interval = self.begin_contact_interval(contact_mode_dynamics, event_result.motion)
        q, v = pack_coordinates(event_result.motion)
        next_interval = next_interval._replace(
            contact_interval_point=next_interval.contact_interval_point._replace(q=q, v=v),
            lane_status=jnp.where(
                event_outcome != Outcome.STEPPED, event_outcome, next_interval.lane_status
            ),
        )
        if self.is_detailed:
            step_details = record_event(
                step_details, step_counters.n_events == 0, event_result, contact_event
            )
            step_details = record_contact_interval(
                step_details, contact_mode_dynamics, event_result.motion, jnp.zeros_like(motion.x)
            )
        continued_lane_state = LaneState(
            next_interval,
            step_counters._replace(n_events=step_counters.n_events + n_contact_events),
            step_details,
            step_accumulators,
            n_stepped,
            lane_state.walk_outcome,
        )
        has_interval_ended = (interval_state.lane_status != LaneStatus.RUNNING) & (
            lane_state.walk_outcome == STATUS_UNFINISHED
        )
        return select_trees_by_condition(
            has_interval_ended,
            select_trees_by_condition(has_ended, ended_lane_state, continued_lane_state),
            lane_state,
        )

    def compute_step_result(self, lane_state: LaneState, input_columns: Array) -> Any:
        """Return the results of the last step of all batch elements, whose walks have ended."""
        step_summary = self.summarize_step(lane_state, input_columns)
        if lane_state.step_details is None or lane_state.step_energy_loss_accumulators is None:
            return step_summary
        return make_unilateral_step(
            step_summary,
            lane_state.step_energy_loss_accumulators,
            lane_state.step_counters,
            lane_state.step_details,
            lane_state.walk_outcome,
            self.engine_name,
        )

    def summarize_step(self, lane_state: LaneState, input_columns: Array) -> GaitStepSummary:
        """Return the section state, durations and length of a step that has ended.

        If the step failed, the section state and the step length are zero.
        """
        motion = unpack_motion(lane_state.contact_interval_state.contact_interval_point)
        contact_state = lane_state.contact_interval_state.contact_state
        section_state = pack_section_state(
            self.unpack_input_columns(input_columns)[0],
            motion,
            contact_state,
            self.extract_ground_ahead(input_columns),
        )
        zero_unless_stepped = lambda value: jnp.where(
            lane_state.walk_outcome == Outcome.STEPPED, value, 0.0
        )
        return GaitStepSummary(
            zero_unless_stepped(section_state),
            lane_state.step_counters.durations,
            zero_unless_stepped(compute_landing_position(motion)),
        )

    def replace_invalid_lanes(
        self, input_columns: Array, section_state: Array
    ) -> tuple[Array, Array, Array]:
        """Return inputs and section states with invalid elements replaced, and validity flags."""
        is_valid, params, friction, section_state = replace_invalid_start(
            make_wheel_from_parameters(
                input_columns[: self.friction_index],
                self.n_legs,
                law_structure=self.law_structure,
            ),
            input_columns[self.friction_index],
            section_state,
            self.extract_ground_ahead(input_columns),
        )
        column_rows = [*stack_parameters(params), friction]
        if self.n_ground_columns:
            previous_friction, *ground_values = input_columns[
                self.friction_index + 1 : self.friction_index + 1 + self.n_ground_columns
            ]
            column_rows += [
                jnp.where(is_valid, previous_friction, 1.0),
                *(jnp.where(is_valid, value, 0.0) for value in ground_values),
            ]
        if self.has_restitution:
            column_rows.append(input_columns[-1])
        return jnp.stack(column_rows), section_state, is_valid


def init_lane_states(
    walk_settings: BatchWalkSettings, input_columns: Array, section_state: Array
) -> tuple[Array, LaneState]:
    """Return valid input columns, and the state of all batch elements before the first landing.

    Invalid elements are replaced and have the outcome BAD_INPUT.
    """
    input_columns, section_state, is_valid = walk_settings.replace_invalid_lanes(
        input_columns, section_state
    )
    lane_state = walk_settings.begin_walk(input_columns, section_state)
    return input_columns, lane_state._replace(
        walk_outcome=jnp.where(is_valid, lane_state.walk_outcome, Outcome.BAD_INPUT)
    )


def process_and_integrate(
    walk_settings: BatchWalkSettings,
    input_columns: Array,
    lane_state: LaneState,
    waits_for_events: bool = False,
) -> tuple[LaneState, LaneState]:
    """Return the state of the batch after its events, and the state after further integration.

    - `waits_for_events`: whether every element is integrated to its next event.
    """
    state_after_events = walk_settings.process_events(input_columns, lane_state)
    interval_state = state_after_events.contact_interval_state
    if walk_settings.tableau is None:
        interval_state = integrate_by_diffrax(
            walk_settings.make_lane_contact_dynamics,
            input_columns,
            interval_state,
            walk_settings.step_options,
        )
    else:
        has_unfinished_walk = state_after_events.walk_outcome == STATUS_UNFINISHED
        contact_state = interval_state.contact_state
        interval_state = integrate_contact_interval(
            lambda columns: walk_settings.make_lane_contact_dynamics(columns, contact_state),
            input_columns,
            interval_state,
            has_unfinished_walk & (not waits_for_events),
            walk_settings.step_options,
            walk_settings.tableau,
        )
    return state_after_events, state_after_events._replace(contact_interval_state=interval_state)


def run_walks(
    walk_settings: BatchWalkSettings, input_columns: Array, section_state: Array
) -> BatchWalkResult:
    """Return the results of all walks after `n_steps` landings of the foremost foot."""
    if walk_settings.measures_force_peaks and walk_settings.tableau is None:
        raise ValueError(
            "force peaks with unilateral contact are computed by diffrax, but only machine code "
            "locates them, with first derivatives: take StepOptions() on a CPU with llvmlite."
        )
    input_columns = walk_settings.resolve_heights(input_columns, section_state)
    input_columns, lane_state = init_lane_states(walk_settings, input_columns, section_state)
    run_iteration = lambda lane_state: process_and_integrate(
        walk_settings, input_columns, lane_state
    )[1]
    should_continue = lambda lane_state: jnp.any(
        make_opaque_loop_condition(
            lane_state.walk_outcome == STATUS_UNFINISHED, lane_state.step_counters.n_events
        )
    )
    lane_state = lax.while_loop(should_continue, run_iteration, lane_state)
    return BatchWalkResult(
        walk_settings.compute_step_result(lane_state, input_columns),
        lane_state.walk_outcome,
        lane_state.n_stepped,
        lane_state.step_counters.n_solver_steps,
    )
