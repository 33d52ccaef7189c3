"""Event loop for walks with unilateral contact, common to all engines.

All laws of contact and impact are elementwise over the batch. A batch element is called a *lane*.
Each iteration resolves the events of all elements at an event, then integrates all elements
further. The landing of the foremost foot is an event like any other.

The batch kernel integrates many elements (`integrate_to_event`). On a CPU, its loop is one
machine-code program in which few elements are idle. On other devices, XLA compiles the same source.
diffrax integrates a single element (`integrate_by_diffrax`).
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from vrw_jax.base.elementwise import make_opaque_loop_condition, select_trees_by_condition
from vrw_jax.base.options import StepOptions
from vrw_jax.base.results import Outcome
from vrw_jax.flow.event_location import IntegratorState, make_idle_state
from vrw_jax.flow.integrate import (
    Interruption,
    PhaseEnd,
    SearchEnd,
    integrate_to_event,
)
from vrw_jax.flow.solver_steps import ButcherTableau
from vrw_jax.lanes.batching import make_zeros_like_output
from vrw_jax.models.contact_impacts import (
    ContactEventResult,
    ContactLaw,
    classify_event,
    project_motion,
    resolve_event,
)
from vrw_jax.models.contact_integrator import (
    IntervalGuards,
    begin_interval,
    integrate_by_diffrax,
    make_contact_phase,
)
from vrw_jax.models.contact_mechanics import (
    Friction,
    WheelMotion,
    align_with_batch,
    compute_landing_position,
    pack_motion,
    stop_gradients,
    unpack_motion,
)
from vrw_jax.models.contact_modes import PAPER_RULE_SENTINEL
from vrw_jax.models.contact_record import (
    GaitStepSummary,
    StepRecord,
    UnilateralStep,
    compute_min_bounce_height,
    compute_section_foot_distance,
    init_step_record,
    pack_section_state,
    record_contact_interval,
    record_event,
    record_force_extremum,
    replace_invalid_start,
    unpack_section_state,
)
from vrw_jax.models.contact_state import (
    N_FORCE_RATES,
    N_LOSSES,
    ContactModeDynamics,
    ContactState,
    GuardLayout,
    choose_stopping_guard,
    compute_contact_quantities,
    compute_force_rates,
    compute_state_units,
    make_contact_mode_dynamics,
    make_guard_layout,
    unpack_state,
)
from vrw_jax.models.phase_sequence import find_stance_slope
from vrw_jax.wheel.laws import count_kinks
from vrw_jax.wheel.params import (
    NO_LAWS,
    PARAMETER_NAMES,
    Symbols,
    WheelLaws,
    add_laws,
    compute_symbols,
    compute_wheel_units,
    make_wheel_from_parameters,
    stack_parameters,
)
from vrw_jax.wheel.transitions import (
    ContactMode,
    GroundAhead,
    are_coordinates_at_rest,
    replace_rest_outcome,
)

SLOPE_INDEX = PARAMETER_NAMES.index("slope")
N_HEIGHT_COLUMNS = 3
"""Number of further input columns if the heights of the footholds are given.

They are the friction coefficient of the feet that landed earlier, and the two rises of
`models.select_stance_line`, m. If slopes are given, two further columns are this friction
coefficient and the angle by which the next straight line is steeper, rad. If restitution is an
input, its column is last.
"""
MAX_ITERATIONS_WITH_WAITING_LANE = 4
"""Number of solver steps after which an element at an event ends the loop for the batch."""
# Number of events in a step after which each event raises the rest speed by its initial value. If a
# quarter of the allowed events is more, that number is used instead. The value is chosen because
# walking steps have 4 to 60 events, and chains of ever smaller bounces have hundreds. After 400
# events, the smallest resolved bounce is as large as with a tolerance of 1e-6 at the first event.
N_EVENTS_BEFORE_REST_SPEED_RAMP = 100
STATUS_UNFINISHED = -1
"""Value that replaces the outcome code as long as a walk is unfinished."""


class BatchWalkResult(NamedTuple):
    """Results of the walks of all batch elements."""

    step_result: Any  # `GaitStepSummary` or `UnilateralStep` of the last step
    outcome: Array
    n_stepped: Array
    n_solver_steps: Array


class IntervalProgress(NamedTuple):
    """Intervals of which an interruption has left some unfinished."""

    interval_guards: IntervalGuards
    integrator_state: IntegratorState


class LaneState(NamedTuple):
    """State of all batch elements at their last events, or within an interval between two events.

    All floating-point arrays except those of `progress` have derivatives. The first three are those
    of an interval.
    """

    q: Array  # hub x, hub z, theta and leg lengths, (3 + n, batch)
    v: Array  # their rates and, if details are requested, the losses in the last interval
    interval_duration: Array  # s
    step_record: StepRecord
    contact_state: ContactState  # contact state in the last interval
    guard_index: Array  # index of the guard of the event
    is_resting: Array  # whether the wheel is at rest
    n_solver_steps: Array  # number of solver steps in the last interval
    interval_outcome: Array  # STEPPED if the last interval has ended, or shall end, at an event
    n_stepped: Array
    walk_outcome: Array
    progress: IntervalProgress | None = None  # None if all elements are at events

    @property
    def motion(self) -> WheelMotion:
        """Return the motion at the event."""
        return unpack_motion(self.q, self.v)

    @property
    def is_unfinished(self) -> Array:
        """Return whether the walk of each element continues."""
        return self.walk_outcome == STATUS_UNFINISHED


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
    def guard_layout(self) -> GuardLayout:
        """Return the order of the guards."""
        laws: Any = jax.tree.unflatten(self.law_structure, [1.0] * self.law_structure.num_leaves)
        return make_guard_layout(
            self.n_legs,
            self.has_one_sided_stoppers,
            self.measures_force_peaks,
            count_kinks((laws or WheelLaws()).leg),
        )

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
        first = self.friction_index
        friction = list(input_columns[first : first + 1 + bool(self.n_ground_columns)])
        if self.uses_paper_rule:
            friction = [jnp.where(x == jnp.inf, PAPER_RULE_SENTINEL, x) for x in friction]
        return s, tuple(friction) if self.n_ground_columns else friction[0]

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
            unit_signs = jnp.stack([jnp.ones_like(motion.x)] * N_FORCE_RATES)
            contact_state = contact_state._replace(force_rate_signs=unit_signs)
        zeros = jnp.zeros(motion.x.shape, jnp.int32)
        q, v = self._pack_start(motion)
        return LaneState(
            q,
            v,
            jnp.zeros_like(motion.x),
            init_step_record(motion.x, self.is_detailed, self.measures_force_peaks),
            contact_state,
            guard_index=zeros,
            is_resting=zeros > 0,
            n_solver_steps=zeros,
            interval_outcome=zeros + Outcome.STEPPED,
            n_stepped=zeros,
            walk_outcome=zeros + STATUS_UNFINISHED,
        )

    def _pack_start(self, motion: WheelMotion) -> tuple[Array, Array]:
        """Return coordinates and rates at the start of an interval, before any loss."""
        q, v = pack_motion(motion)
        return q, jnp.concatenate([v, jnp.zeros_like(q[: N_LOSSES * self.is_detailed])])

    def process_events(self, input_columns: Array, lane_state: LaneState) -> LaneState:
        """Return the state of all batch elements after their events are resolved.

        If a walk ends, its outcome is set. A landing of the foremost foot opens the next step.
        """
        progress, lane_state = lane_state.progress, lane_state._replace(progress=None)
        ended = self._end_interval(input_columns, lane_state)
        begun = self._begin_step(input_columns, ended)
        continued = self._resolve_event(input_columns, begun)
        after_event = select_trees_by_condition(ended.is_unfinished, continued, ended)
        is_at_event = lane_state.is_unfinished
        if progress is not None:
            is_at_event = is_at_event & ~progress.integrator_state.is_running
        lane_state = select_trees_by_condition(is_at_event, after_event, lane_state)
        return lane_state._replace(progress=progress)

    def begin_progress(self, input_columns: Array, lane_state: LaneState) -> IntervalProgress:
        """Return the progress before the first interval."""
        dynamics = self.make_lane_contact_dynamics(input_columns, lane_state.contact_state)
        assert self.tableau is not None
        phase = make_contact_phase(dynamics, self.tableau, self.step_options)
        start = lane_state.q, lane_state.v
        interval_guards, state = make_zeros_like_output(
            lambda: (
                begin_interval(dynamics, phase, *start, self.step_options),
                phase.make_state(*start),
            )
        )
        guard_values = jnp.zeros(interval_guards.is_met_at_start.shape, lane_state.q.dtype)
        return IntervalProgress(
            interval_guards, make_idle_state(state, guard_values, lane_state.interval_duration)
        )

    def _has_landed(self, lane_state: LaneState) -> Array:
        """Return whether the foremost foot lands at the event."""
        return (lane_state.interval_outcome == Outcome.STEPPED) & (
            lane_state.guard_index == self.guard_layout.landing[-1]
        )

    def _end_interval(self, input_columns: Array, lane_state: LaneState) -> LaneState:
        """Return the state with the last interval recorded, and the outcomes of ended walks."""
        record, duration = lane_state.step_record, lane_state.interval_duration
        n_loaded_feet = jnp.sum(lane_state.contact_state.contact_modes != ContactMode.OFF, axis=0)
        has_foot_count = jnp.stack([n_loaded_feet == n_feet for n_feet in (2, 1, 0)])
        record = record._replace(
            durations=record.durations + jnp.where(has_foot_count, duration, 0.0),
            solver_steps=record.solver_steps + lane_state.n_solver_steps,
        )
        n_events = record.events
        if self.is_detailed:
            dynamics = self.make_lane_contact_dynamics(input_columns, lane_state.contact_state)
            record = record_contact_interval(record, dynamics, lane_state.motion, duration)
            record = record._replace(losses=record.losses + lane_state.v[len(lane_state.q) :])
        if self.measures_force_peaks:
            n_events = n_events + record.force_peaks.n_force_extrema
        has_landed, interval_outcome = self._has_landed(lane_state), lane_state.interval_outcome
        outcome = jnp.where(n_events >= self.max_events, Outcome.TOO_MANY_EVENTS, Outcome.STEPPED)
        for guard, guard_outcome in (
            (self.guard_layout.rolling_rate.start, Outcome.FELL_BACK),
            (self.guard_layout.collapse.start, Outcome.COLLAPSED),
        ):
            outcome = jnp.where(lane_state.guard_index == guard, guard_outcome, outcome)
        outcome = jnp.where(has_landed, Outcome.STEPPED, outcome)
        outcome = jnp.where(interval_outcome == Outcome.STEPPED, outcome, interval_outcome)
        outcome = replace_rest_outcome(outcome, lane_state.is_resting).astype(jnp.int32)
        n_stepped = lane_state.n_stepped + has_landed
        has_ended = (outcome != Outcome.STEPPED) | (has_landed & (n_stepped >= self.n_steps))
        return lane_state._replace(
            step_record=record,
            n_stepped=n_stepped,
            walk_outcome=jnp.where(has_ended, outcome, lane_state.walk_outcome),
        )

    def _begin_step(self, input_columns: Array, lane_state: LaneState) -> LaneState:
        """Return the state with a new step, at a landing of the foremost foot."""
        s, contact_state = self.unpack_input_columns(input_columns)[0], lane_state.contact_state
        motion, start_contact_state = unpack_section_state(
            s, pack_section_state(s, lane_state.motion, contact_state)
        )
        q, v = self._pack_start(motion)
        record = init_step_record(motion.x, self.is_detailed, self.measures_force_peaks)
        begun = lane_state._replace(
            q=q,
            v=v,
            step_record=record._replace(solver_steps=lane_state.step_record.solver_steps),
            contact_state=start_contact_state._replace(
                force_rate_signs=contact_state.force_rate_signs
            ),
            guard_index=jnp.full_like(lane_state.guard_index, self.guard_layout.landing.start),
        )
        return select_trees_by_condition(self._has_landed(lane_state), begun, lane_state)

    def _resolve_event(self, input_columns: Array, lane_state: LaneState) -> LaneState:
        """Return the state at the start of the next interval."""
        s, friction = self.unpack_input_columns(input_columns)
        motion, contact_state = lane_state.motion, lane_state.contact_state
        guard_index, record = lane_state.guard_index, lane_state.step_record
        first_ramp_event = max(N_EVENTS_BEFORE_REST_SPEED_RAMP, self.max_events // 4)
        contact_law = ContactLaw(
            s,
            friction,
            self.has_one_sided_stoppers,
            self.is_detailed,
            # This is the landing speed after the smallest resolved bounce, m/s.
            jnp.sqrt(2.0 * s.g * compute_min_bounce_height(s.L0, self.step_options)),
            input_columns[-1] if self.has_restitution else None,
            self.extract_ground_ahead(input_columns),
            jnp.maximum(record.events - first_ramp_event, 0),
        )
        # Integration errors move feet off the ground. The height of a foot that lifts off grows
        # with the third power of time, so without the projection it would land again immediately.
        projected_motion = project_motion(s, motion, *contact_state[:2])
        contact_event = classify_event(self.guard_layout, guard_index)
        event_result = resolve_event(contact_law, projected_motion, contact_state, contact_event)
        is_solved = event_result.n_solutions > 0
        outcome = jnp.where(is_solved, Outcome.STEPPED, Outcome.NO_ADMISSIBLE_CONTACT)
        outcome = jnp.where(event_result.is_painleve_paradox, Outcome.PAINLEVE_PARADOX, outcome)
        outcome = jnp.where(event_result.has_third_foot, Outcome.THREE_FEET_LOADED, outcome)
        n_contact_events: Any = 1
        if self.measures_force_peaks:
            is_contact_event = guard_index < self.guard_layout.force_rates.start
            n_contact_events = is_contact_event.astype(jnp.int32)
            outcome = jnp.where(is_contact_event, outcome, Outcome.STEPPED)
            record, event_result = self._record_force_extrema(
                input_columns, lane_state, event_result, is_contact_event
            )
        if self.is_detailed:
            record = record_event(record, event_result, contact_event)
            record = record_contact_interval(
                record,
                self.make_lane_contact_dynamics(input_columns, event_result.contact_state),
                event_result.motion,
                jnp.zeros_like(motion.x),
            )
        q, v = self._pack_start(event_result.motion)
        return lane_state._replace(
            q=q,
            v=v,
            interval_duration=jnp.zeros_like(motion.x),
            step_record=record._replace(events=record.events + n_contact_events),
            contact_state=event_result.contact_state,
            n_solver_steps=jnp.zeros_like(guard_index),
            interval_outcome=outcome.astype(jnp.int32),
        )

    def _record_force_extrema(
        self,
        input_columns: Array,
        lane_state: LaneState,
        event_result: ContactEventResult,
        is_contact_event: Array,
    ) -> tuple[StepRecord, ContactEventResult]:
        """Return the record with the extrema of forces, and an event that continues through them.

        At the extremum of a force, motion and contacts continue without change.
        """
        record, guard_index = lane_state.step_record, lane_state.guard_index
        motion, contact_state = lane_state.motion, lane_state.contact_state
        assert contact_state.force_rate_signs is not None
        rate_guards = align_with_batch(np.array(self.guard_layout.force_rates), guard_index)
        is_rate_zero = guard_index == rate_guards
        force_peaks = record_force_extremum(
            record.force_peaks,
            is_rate_zero,
            self.make_lane_contact_dynamics(input_columns, contact_state),
            motion,
        )
        motion, next_contact_state = select_trees_by_condition(
            is_contact_event,
            (event_result.motion, event_result.contact_state),
            (
                motion,
                ContactState.without_recent_changes(
                    *contact_state[:2], contact_state.is_kink_positive
                ),
            ),
        )
        next_dynamics = self.make_lane_contact_dynamics(input_columns, next_contact_state)
        force_rates = compute_force_rates(*stop_gradients((next_dynamics, motion)))
        # A rate that is zero at the event changes its sign.
        force_rate_signs = jnp.where(
            is_rate_zero,
            -contact_state.force_rate_signs,
            jnp.where(force_rates < 0.0, -1.0, 1.0),
        )
        return record._replace(force_peaks=force_peaks), event_result._replace(
            motion=motion,
            contact_state=next_contact_state._replace(force_rate_signs=force_rate_signs),
        )

    def integrate(
        self, input_columns: Array, lane_state: LaneState, phase_tangents: Any = None
    ) -> tuple[LaneState, PhaseEnd, SearchEnd | None]:
        """Return the state of all batch elements at their next events, and how the phase ended.

        - `phase_tangents`: tangents that are integrated together with the motion, or None.
        """
        dynamics = self.make_lane_contact_dynamics(input_columns, lane_state.contact_state)
        units = compute_wheel_units(dynamics.s)
        options = units.scale_times_to_seconds(self.step_options)
        phase = make_contact_phase(
            dynamics, self.tableau, options, limits_tangents=phase_tangents is not None
        )
        interval_guards = begin_interval(dynamics, phase, lane_state.q, lane_state.v, options)
        is_active = lane_state.is_unfinished & (lane_state.interval_outcome == Outcome.STEPPED)
        progress, interruption, search_end = lane_state.progress, None, None
        if self.tableau is None:
            phase = interval_guards.limit_phase(phase, dynamics, options)
            phase_end = integrate_by_diffrax(dynamics, phase, lane_state.motion, is_active, options)
            motion, (_, *losses) = unpack_state(phase_end.state)
            q, v = pack_motion(motion)
            v = jnp.concatenate([v, jnp.stack(losses)[: N_LOSSES * self.is_detailed]])
            accelerations = compute_contact_quantities(
                *stop_gradients((dynamics, motion))
            ).accelerations
        else:
            if progress is not None:
                interruption = Interruption(
                    MAX_ITERATIONS_WITH_WAITING_LANE, progress.integrator_state
                )
                interval_guards = select_trees_by_condition(
                    progress.integrator_state.is_running, progress.interval_guards, interval_guards
                )
            phase_end, search_end = integrate_to_event(
                interval_guards.limit_phase(phase, dynamics, options),
                phase_tangents,
                self.tableau,
                lane_state.q,
                lane_state.v,
                is_active,
                options.dt0,
                options,
                interruption=interruption,
            )
            q, v, (_, _, rows) = phase_end.state
            accelerations = rows[: len(q)]
            if progress is not None:
                integrator_state = search_end.integrator_state._replace(state_tangents=None)
                progress = IntervalProgress(interval_guards, integrator_state)
        guard_index, atol = phase_end.end_guard_index, self.step_options.atol
        rates = lax.stop_gradient(v[: len(q)])
        outcome = jnp.where(
            phase_end.is_timed_out, Outcome.NO_TOUCHDOWN_IN_TIME, Outcome.SOLVER_FAILED
        )
        outcome = jnp.where((guard_index >= 0) | phase_end.is_unfinished, Outcome.STEPPED, outcome)
        outcome = jnp.where(
            guard_index == self.guard_layout.force_rates.stop, Outcome.PAINLEVE_PARADOX, outcome
        )
        lane_state = lane_state._replace(
            q=q,
            v=v,
            interval_duration=phase_end.duration,
            guard_index=choose_stopping_guard(dynamics, rates, guard_index, atol),
            is_resting=are_coordinates_at_rest(
                rates, accelerations, compute_state_units(dynamics.s)[1], units.time_unit, atol
            ),
            n_solver_steps=phase_end.solver_steps,
            interval_outcome=jnp.where(is_active, outcome, lane_state.interval_outcome).astype(
                jnp.int32
            ),
            progress=progress,
        )
        return lane_state, phase_end, search_end

    def compute_step_result(self, lane_state: LaneState, input_columns: Array) -> Any:
        """Return the results of the last step of all batch elements, whose walks have ended."""
        step_summary = self.summarize_step(lane_state, input_columns)
        if not self.is_detailed:
            return step_summary
        results = lane_state.step_record._asdict() | step_summary._asdict()
        damping_loss, friction_loss, slip = results.pop("losses")
        results["margins"] = jax.tree.map(
            lambda margin: jnp.where(jnp.isfinite(margin), margin, 0.0), results["margins"]
        )
        results["fewest_solutions"] = jnp.where(
            results["events"] > 0, results["fewest_solutions"], 0
        )
        return UnilateralStep(
            **results,
            energy_damping=damping_loss,
            energy_friction=friction_loss,
            slip=slip,
            outcome=lane_state.walk_outcome,
            engine=self.engine_name,
        )

    def summarize_step(self, lane_state: LaneState, input_columns: Array) -> GaitStepSummary:
        """Return the section state, durations and length of a step that has ended.

        If the step failed, the section state and the step length are zero.
        """
        motion = lane_state.motion
        section_state = pack_section_state(
            self.unpack_input_columns(input_columns)[0],
            motion,
            lane_state.contact_state,
            self.extract_ground_ahead(input_columns),
        )
        zero_unless_stepped = lambda value: jnp.where(
            lane_state.walk_outcome == Outcome.STEPPED, value, 0.0
        )
        return GaitStepSummary(
            zero_unless_stepped(section_state),
            lane_state.step_record.durations,
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


def advance_to_events(
    walk_settings: BatchWalkSettings, input_columns: Array, lane_state: LaneState
) -> tuple[LaneState, LaneState]:
    """Return the state of the batch after its events, and the state at the next events."""
    after_events = walk_settings.process_events(input_columns, lane_state)
    if walk_settings.tableau is not None:
        return after_events, walk_settings.integrate(input_columns, after_events)[0]
    remove_axis = lambda tree: jax.tree.map(lambda x: x[..., 0], tree)
    settings = walk_settings._replace(step_options=remove_axis(walk_settings.step_options))
    single_state = settings.integrate(*remove_axis((input_columns, after_events)))[0]
    return after_events, jax.tree.map(lambda x: x[..., None], single_state)


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
    if walk_settings.tableau is not None:
        progress = walk_settings.begin_progress(input_columns, lane_state)
        lane_state = lane_state._replace(progress=progress)
    run_iteration = lambda lane_state: advance_to_events(walk_settings, input_columns, lane_state)[
        1
    ]
    should_continue = lambda lane_state: jnp.any(
        make_opaque_loop_condition(lane_state.is_unfinished, lane_state.step_record.events)
    )
    lane_state = lax.while_loop(should_continue, run_iteration, lane_state)
    return make_walk_result(
        walk_settings.compute_step_result(lane_state, input_columns), lane_state
    )


def make_walk_result(step_result: Any, lane_state: LaneState) -> BatchWalkResult:
    """Return the results of walks that have ended."""
    return BatchWalkResult(
        step_result,
        lane_state.walk_outcome,
        lane_state.n_stepped,
        lane_state.step_record.solver_steps,
    )
