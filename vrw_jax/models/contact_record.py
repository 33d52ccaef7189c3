"""Record of a walking step with unilateral contact, for one wheel or elementwise for a batch.

A walking step is a sequence of events, each followed by an interval with constant contact state.
The first event is the landing at which the step starts. The step is complete when the foremost foot
lands.
"""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from vrw_jax.base.options import StepOptions
from vrw_jax.base.outcomes import Outcome
from vrw_jax.base.types import Elementwise
from vrw_jax.models.contact_impacts import (
    ContactEvent,
    ContactEventResult,
    ContactLaw,
    classify_event,
    project_motion,
    resolve_event,
)
from vrw_jax.models.contact_mechanics import WheelMotion, align_with_batch
from vrw_jax.models.contact_modes import PAPER_RULE_SENTINEL
from vrw_jax.models.contact_section import FullState
from vrw_jax.models.contact_state import (
    ContactModeDynamics,
    ContactState,
    GuardLayout,
    compute_forces,
    compute_normal_force_rates,
    split_normal_forces,
)
from vrw_jax.models.step_results import AbstractContactStep
from vrw_jax.wheel.outcomes import ContactMode, replace_rest_outcome
from vrw_jax.wheel.params import Symbols

# Smallest height of a resolved bounce, divided by absolute tolerance and leg length.
MIN_BOUNCE_HEIGHT_PER_ATOL = 1e-2
# Smallest height of a resolved bounce, in units of the round-off of a leg's length. The height is
# about 1e-13 m in float64.
MIN_BOUNCE_HEIGHT_IN_EPS = 4e2


def compute_min_bounce_height(L0: Elementwise, options: StepOptions) -> Array:
    """Return the smallest height of a foot's bounce that a step resolves, m.

    - `L0`: leg length, m;
    - `options`: options whose absolute tolerance determines the height.
    """
    roundoff_height = MIN_BOUNCE_HEIGHT_IN_EPS * jnp.finfo(L0.dtype).eps
    return jnp.maximum(MIN_BOUNCE_HEIGHT_PER_ATOL * options.atol, roundoff_height) * L0


def apply_friction_rule(friction: Elementwise, uses_paper_rule: bool) -> Elementwise:
    """Return the friction coefficient, with infinity replaced if the rule of the paper applies.

    The replacement is `PAPER_RULE_SENTINEL`.

    - `uses_paper_rule`: whether the rule of the paper applies to infinite friction.
    """
    return (
        jnp.where(friction == jnp.inf, PAPER_RULE_SENTINEL, friction)
        if uses_paper_rule
        else friction
    )


def compute_rest_speed(s: Symbols, options: StepOptions) -> Elementwise:
    """Return the landing speed after the smallest resolved bounce, m/s."""
    return jnp.sqrt(2.0 * s.g * compute_min_bounce_height(s.L0, options))


# Number of events in a step after which each event raises the rest speed by its initial value. If a
# quarter of the allowed events is more, that number is used instead. The value is chosen because
# walking steps have 4 to 60 events, and chains of ever smaller bounces have hundreds. After 400
# events, the smallest resolved bounce is as large as with a tolerance of 1e-6 at the first event.
N_EVENTS_BEFORE_REST_SPEED_RAMP = 100


def process_event(
    contact_law: ContactLaw,
    guard_layout: GuardLayout,
    motion: WheelMotion,
    contact_state: ContactState,
    guard_index: Int[Array, "..."],
    n_events: Int[Array, "..."],
    max_events: int,
) -> tuple[ContactEventResult, ContactEvent, Int[Array, "..."]]:
    """Return the result of an event, its kind, and its outcome (STEPPED if the event is resolved).

    - `guard_index`: index of the guard that is zero at the event;
    - `n_events`: number of earlier events in this walking step;
    - `max_events`: largest number of events in a walking step.

    The motion is first projected onto its contact constraints, because integration errors move feet
    off the ground. The height of a foot that lifts off grows with the third power of time. Without
    the projection, the foot would land again immediately.
    """
    first_ramp_event = max(N_EVENTS_BEFORE_REST_SPEED_RAMP, max_events // 4)
    contact_law = contact_law._replace(n_late_events=jnp.maximum(n_events - first_ramp_event, 0))
    motion = project_motion(
        contact_law.s, motion, contact_state.contact_modes, contact_state.is_leg_locked
    )
    contact_event = classify_event(guard_layout, guard_index)
    event_result = resolve_event(contact_law, motion, contact_state, contact_event)
    outcome = jnp.where(
        event_result.n_solutions > 0, Outcome.STEPPED, Outcome.NO_ADMISSIBLE_CONTACT
    )
    outcome = jnp.where(event_result.is_painleve_paradox, Outcome.PAINLEVE_PARADOX, outcome)
    outcome = jnp.where(event_result.has_third_foot, Outcome.THREE_FEET_LOADED, outcome)
    return event_result, contact_event, outcome.astype(jnp.int32)


class UnilateralMargins(eqx.Module):
    """Margins for bilateral stoppers during one walking step.

    A margin is negative if a one-sided stopper would have released a leg in the air.
    """

    stopper_force: Elementwise  # minimum over locked legs in the air, N
    stopper_impulse: Elementwise  # minimum over locked legs in the air, N s


class GaitStepCounters(NamedTuple):
    """Numbers of events and solver steps in a walking step, and durations by loaded feet."""

    n_events: Int[Array, "..."]  # number of changes of contacts and stoppers, and of kinks
    durations: Float[Array, "3 ..."]  # durations with two, one and no loaded feet, s
    n_solver_steps: Int[Array, "..."]  # number of attempted solver steps


def init_step_counters(lane_template: Array) -> GaitStepCounters:
    """Return step counters with the value 0, with the batch shape and dtype of `lane_template`."""
    int_zeros = jnp.zeros(lane_template.shape, jnp.int32)
    return GaitStepCounters(
        int_zeros, jnp.zeros((3, *lane_template.shape), lane_template.dtype), int_zeros
    )


def count_contact_interval(
    step_counters: GaitStepCounters,
    contact_state: ContactState,
    duration: Elementwise,
    n_solver_steps: Array,
) -> GaitStepCounters:
    """Return the step counters after one more interval in the contact state `contact_state`.

    - `duration`: length of the interval, s;
    - `n_solver_steps`: number of solver steps in the interval.
    """
    n_loaded_feet = jnp.sum(contact_state.contact_modes != ContactMode.OFF, axis=0)
    has_foot_count = jnp.stack([n_loaded_feet == n_feet for n_feet in (2, 1, 0)])
    durations = step_counters.durations + jnp.where(has_foot_count, duration, 0.0)
    return step_counters._replace(
        durations=durations, n_solver_steps=step_counters.n_solver_steps + n_solver_steps
    )


def determine_interval_outcome(
    n_events: Int[Array, "..."],
    guard_layout: GuardLayout,
    guard_index: Array,
    has_landed: Array,
    interval_outcome: Array,
    is_resting: Array,
    max_events: int,
) -> Int[Array, "..."]:
    """Return the outcome after an interval of a walk.

    The result is STEPPED if the walk continues or the foremost foot has landed.

    If the interval did not end at an event, the result is `interval_outcome`. If the wheel is at
    rest, the result is CAME_TO_REST.
    """
    outcome = jnp.where(n_events >= max_events, Outcome.TOO_MANY_EVENTS, Outcome.STEPPED)
    outcome = jnp.where(guard_index == guard_layout.rolling_rate_guard, Outcome.FELL_BACK, outcome)
    outcome = jnp.where(guard_index == guard_layout.collapse_guard, Outcome.COLLAPSED, outcome)
    outcome = jnp.where(has_landed, Outcome.STEPPED, outcome)
    outcome = jnp.where(interval_outcome == Outcome.STEPPED, outcome, interval_outcome)
    return replace_rest_outcome(outcome, is_resting)


class ForcePeakRecord(NamedTuple):
    """Smooth extrema of normal forces between the events of one walking step, and largest forces.

    The extrema are those of the force on the foot of Leg 1, except for fields of the total force.
    """

    n_force_peaks: Int[Array, "..."]  # number of maxima
    smooth_peak_force: Elementwise  # largest maximum, N; -inf without a maximum
    lowest_force_after_peak: Elementwise  # smallest minimum after the largest maximum, N; else inf
    trough_depth: Elementwise  # lower of two maxima minus a minimum between them, largest, N
    second_peak_rate: Elementwise  # largest maximum of the rate after a maximum, N/s; else -inf
    n_total_force_peaks: Int[Array, "..."]  # number of maxima of the sum of the forces on all feet
    smooth_peak_total_force: Elementwise  # largest maximum of this sum, N; -inf without a maximum
    n_force_extrema: Int[Array, "..."]  # number of recorded extrema, rates included
    peak_force: Elementwise  # largest force in the step, ends of its intervals included, N
    peak_total_force: Elementwise  # largest sum in the step, ends of its intervals included, N

    def compute_force_measures(self) -> dict[str, Array]:
        """Return the measures of the peaks, by their names in `measures.FORCE_PEAK_MEASURES`."""
        nan_if_missing = lambda value: jnp.where(jnp.isfinite(value), value, jnp.nan)
        return {
            "n_force_peaks": self.n_force_peaks.astype(self.trough_depth.dtype),
            "peak_force": self.peak_force,
            "smooth_peak_force": nan_if_missing(self.smooth_peak_force),
            "force_trough_depth": self.trough_depth,
            "second_peak_rate": nan_if_missing(self.second_peak_rate),
            "n_total_force_peaks": self.n_total_force_peaks.astype(self.trough_depth.dtype),
            "peak_total_force": self.peak_total_force,
            "smooth_peak_total_force": nan_if_missing(self.smooth_peak_total_force),
        }


def init_force_peak_record(lane_template: Array) -> ForcePeakRecord:
    """Return the record before the first extremum, with the batch shape of `lane_template`."""
    float_zero, int_zero = jnp.zeros_like(lane_template), jnp.zeros_like(lane_template, jnp.int32)
    return ForcePeakRecord(
        n_force_peaks=int_zero,
        smooth_peak_force=float_zero - jnp.inf,
        lowest_force_after_peak=float_zero + jnp.inf,
        trough_depth=float_zero,
        second_peak_rate=float_zero - jnp.inf,
        n_total_force_peaks=int_zero,
        smooth_peak_total_force=float_zero - jnp.inf,
        n_force_extrema=int_zero,
        peak_force=float_zero,
        peak_total_force=float_zero,
    )


def record_force_extremum(
    force_peak_record: ForcePeakRecord,
    is_rate_zero: Bool[Array, "3 ..."],
    contact_mode_dynamics: ContactModeDynamics,
    motion: WheelMotion,
) -> ForcePeakRecord:
    """Return the record after an extremum of a force or of its rate.

    - `is_rate_zero`: which of the `NormalForceRates` is zero; if none is, the record is unchanged;
    - `contact_mode_dynamics`, `motion`: dynamics before the extremum, and motion at the extremum.
    """
    (
        n_force_peaks,
        smooth_peak_force,
        lowest_force_after_peak,
        trough_depth,
        second_peak_rate,
        n_total_force_peaks,
        smooth_peak_total_force,
        n_force_extrema,
        *_,
    ) = force_peak_record
    is_fore_extremum, is_total_extremum, is_rate_extremum = is_rate_zero
    assert contact_mode_dynamics.contact_state.force_rate_signs is not None
    is_fore_rising, is_total_rising, is_rate_rising = (
        contact_mode_dynamics.contact_state.force_rate_signs > 0.0
    )
    (force, total_force), (rate, _) = compute_normal_force_rates(contact_mode_dynamics, motion)
    is_peak = is_fore_extremum & is_fore_rising
    is_trough = is_fore_extremum & ~is_fore_rising & (n_force_peaks > 0)
    is_after_trough = jnp.isfinite(lowest_force_after_peak)
    last_trough_depth = jnp.where(
        is_peak & is_after_trough,
        jnp.minimum(force, smooth_peak_force)
        - jnp.where(is_after_trough, lowest_force_after_peak, 0.0),
        0.0,
    )
    is_highest_peak = is_peak & (force > smooth_peak_force)
    lowest_force_after_peak = jnp.where(
        is_trough & (force < lowest_force_after_peak),
        force,
        lowest_force_after_peak,
    )
    is_second_rise = is_rate_extremum & is_rate_rising & (n_force_peaks > 0)
    # If only the fore foot is loaded, both forces have the same extrema.
    is_fore_foot_alone = contact_mode_dynamics.slot_modes[1] == ContactMode.OFF
    is_total_peak = (is_total_extremum & is_total_rising) | (is_peak & is_fore_foot_alone)
    return force_peak_record._replace(
        n_force_peaks=n_force_peaks + is_peak,
        smooth_peak_force=jnp.where(is_highest_peak, force, smooth_peak_force),
        lowest_force_after_peak=jnp.where(is_highest_peak, jnp.inf, lowest_force_after_peak),
        trough_depth=jnp.maximum(trough_depth, last_trough_depth),
        second_peak_rate=jnp.where(
            is_second_rise & (rate > second_peak_rate),
            rate,
            second_peak_rate,
        ),
        n_total_force_peaks=n_total_force_peaks + is_total_peak,
        smooth_peak_total_force=jnp.where(
            is_total_peak & (total_force > smooth_peak_total_force),
            total_force,
            smooth_peak_total_force,
        ),
        n_force_extrema=n_force_extrema + jnp.any(is_rate_zero, axis=0),
    )


class GaitStepSummary(NamedTuple):
    """Section state, durations (s) and length (m) of the last step in a walk, without details."""

    section_state: Array
    durations: Array  # (3, batch)
    step_length: Array


class UnilateralStepDetails(NamedTuple):
    """Detailed results of a walking step; the fields are described in `UnilateralStep`."""

    post_impact: Float[Array, "2 ..."]
    mode_durations: Float[Array, "4 4 ..."]
    landing_normal: Float[Array, "2 ..."]
    landing_tangential: Float[Array, "2 ..."]
    energy_impacts: Elementwise
    margins: UnilateralMargins
    impacts: Int[Array, "..."]
    fewest_solutions: Int[Array, "..."]
    most_solutions: Int[Array, "..."]
    force_peaks: ForcePeakRecord | None


def init_step_details(lane_template: Array, measures_force_peaks: bool) -> UnilateralStepDetails:
    """Return the step details at the start of a walking step.

    The batch shape and the dtype are those of `lane_template`.
    """
    float_zero, int_zero = jnp.zeros_like(lane_template), jnp.zeros_like(lane_template, jnp.int32)
    zero_pair = jnp.stack([float_zero, float_zero])
    return UnilateralStepDetails(
        post_impact=zero_pair,
        mode_durations=jnp.zeros((4, 4, *lane_template.shape), lane_template.dtype),
        landing_normal=zero_pair,
        landing_tangential=zero_pair,
        energy_impacts=float_zero,
        margins=UnilateralMargins(float_zero + jnp.inf, float_zero + jnp.inf),
        impacts=int_zero,
        fewest_solutions=int_zero + jnp.iinfo(jnp.int32).max,
        most_solutions=int_zero,
        force_peaks=init_force_peak_record(lane_template) if measures_force_peaks else None,
    )


def record_event(
    step_details: UnilateralStepDetails,
    is_first_event: Array,
    event_result: ContactEventResult,
    contact_event: ContactEvent,
) -> UnilateralStepDetails:
    """Return the step details after one more event.

    - `is_first_event`: whether the event is the first in the walking step.
    """
    keep_first = lambda first, previous: jnp.where(is_first_event, first, previous)
    post_impact = jnp.stack([event_result.motion.theta, event_result.motion.dtheta])
    stopper_impulse = jnp.minimum(
        step_details.margins.stopper_impulse, event_result.stopper_impulse
    )
    force_peaks = step_details.force_peaks
    if force_peaks is not None:  # The force before the first event belongs to the previous step.
        force_peaks = force_peaks._replace(
            peak_force=keep_first(0.0, force_peaks.peak_force),
            peak_total_force=keep_first(0.0, force_peaks.peak_total_force),
        )
    return step_details._replace(
        force_peaks=force_peaks,
        post_impact=keep_first(post_impact, step_details.post_impact),
        landing_normal=keep_first(event_result.normal_impulse, step_details.landing_normal),
        landing_tangential=keep_first(
            event_result.tangential_impulse, step_details.landing_tangential
        ),
        energy_impacts=step_details.energy_impacts + event_result.impact_energy_loss,
        margins=UnilateralMargins(step_details.margins.stopper_force, stopper_impulse),
        impacts=step_details.impacts + contact_event.is_impact,
        fewest_solutions=jnp.minimum(step_details.fewest_solutions, event_result.n_solutions),
        most_solutions=jnp.maximum(step_details.most_solutions, event_result.max_n_solutions),
    )


def record_contact_interval(
    step_details: UnilateralStepDetails,
    contact_mode_dynamics: ContactModeDynamics,
    motion: WheelMotion,
    duration: Elementwise,
) -> UnilateralStepDetails:
    """Return the step details updated at the start or at the end of an interval.

    The minimum of the stopper force on legs in the air is updated. The duration is added to the
    entry of `mode_durations` for the present contact modes. If force peaks are measured, the
    largest normal forces are updated; between events the largest force is at an extremum.

    - `motion`: motion at this time;
    - `duration`: time to add, s. It is the length of the interval at one of the two times, and 0 at
      the other.
    """
    slot_modes = contact_mode_dynamics.slot_modes
    contact_forces = compute_forces(contact_mode_dynamics, motion)
    stopper_forces = contact_forces.airborne_stopper_forces
    stopper_force = jnp.min(
        jnp.where(contact_mode_dynamics.is_airborne_leg_locked, stopper_forces, jnp.inf), axis=0
    )
    mode_codes = align_with_batch(np.arange(4), stopper_force)
    is_first_slot_mode, is_second_slot_mode = (
        (mode_codes == slot_modes[i]).astype(jnp.result_type(stopper_force)) for i in range(2)
    )
    stopper_force = jnp.minimum(step_details.margins.stopper_force, stopper_force)
    force_peaks = step_details.force_peaks
    if force_peaks is not None:
        fore_force, total_force = split_normal_forces(
            contact_mode_dynamics, contact_forces.force_solution.normal_forces
        )
        # Two tied forces give the maximum one-sided derivatives. Selection returns one of them.
        select_larger = lambda force, largest: jnp.where(force > largest, force, largest)
        force_peaks = force_peaks._replace(
            peak_force=select_larger(fore_force, force_peaks.peak_force),
            peak_total_force=select_larger(total_force, force_peaks.peak_total_force),
        )
    return step_details._replace(
        force_peaks=force_peaks,
        mode_durations=step_details.mode_durations
        + is_first_slot_mode[:, None] * is_second_slot_mode[None, :] * duration,
        margins=UnilateralMargins(stopper_force, step_details.margins.stopper_impulse),
    )


class UnilateralStep(AbstractContactStep):
    """One step with unilateral contact, from a landing of the foremost foot to the next landing.

    If the outcome is not STEPPED, the fields are finite and describe the motion until the failure.
    The `section_state` is then zero in all entries, which is not a valid section state.

    - `section_state`: full section state just before the next landing;
    - `post_impact`: (theta, dtheta) just after the landing at which the step starts, rad, rad/s;
    - `durations`: durations with two, one and no loaded feet, s;
    - `mode_durations`: duration for each pair of contact modes of the first and the second loaded
      foot, s;
    - `step_length`: distance between the two landing positions, m;
    - `landing_normal`: normal impulses on fore and rear foot at the first landing, N s;
    - `landing_tangential`: tangential impulses on fore and rear foot at the first landing, N s;
    - `energy_impacts`: energy lost in impacts, J;
    - `energy_damping`: energy lost in the dampers, J;
    - `energy_friction`: energy lost by sliding between impacts, J;
    - `slip`: total path length of all sliding feet, m;
    - `events`: number of events, at which contacts or stoppers change, or a leg passes a kink of
      its force;
    - `impacts`: number of events in which velocities jumped;
    - `fewest_solutions`, `most_solutions`: smallest and largest number of admissible combinations
      at an event; both are 1 if all events are well posed;
    - `margins`: margins for bilateral stoppers, see `UnilateralMargins`;
    - `outcome`: outcome code, an `Outcome`;
    - `solver_steps`: number of attempted solver steps;
    - `engine`: name of the engine that computed the step, see `StepOptions`;
    - `force_peaks`: extrema of normal forces, or None if they are not requested.

    Examples:
        >>> wheel = vrw.UnilateralWheel(friction=0.7)
        >>> step = vrw.step(vrw.WheelParams(damping=300.0), vrw.paper_start(), model=wheel)
        >>> print(f"{step.energy_friction:.1f} J lost by sliding")
        1.3 J lost by sliding
    """

    section_state: FullState
    post_impact: Float[Array, "2 ..."]
    durations: Float[Array, "3 ..."]
    mode_durations: Float[Array, "4 4 ..."]
    step_length: Elementwise
    landing_normal: Float[Array, "2 ..."]
    landing_tangential: Float[Array, "2 ..."]
    energy_impacts: Elementwise
    energy_damping: Elementwise
    energy_friction: Elementwise
    slip: Elementwise
    margins: UnilateralMargins
    events: Int[Array, "..."]
    impacts: Int[Array, "..."]
    fewest_solutions: Int[Array, "..."]
    most_solutions: Int[Array, "..."]
    outcome: Int[Array, "..."]
    solver_steps: Int[Array, "..."]
    engine: str = eqx.field(static=True, default="")
    force_peaks: ForcePeakRecord | None = None

    def collect_model_measures(self) -> dict[str, Array]:
        """Return the measures of steps with contacts and the stopper margins, by name."""
        return AbstractContactStep.collect_model_measures(self) | {
            margin_field.name: getattr(self.margins, margin_field.name)
            for margin_field in dataclasses.fields(self.margins)
        }


def make_unilateral_step(
    step_summary: GaitStepSummary,
    loss_accumulators: Array,
    step_counters: GaitStepCounters,
    step_details: UnilateralStepDetails,
    outcome: Array,
    engine_name: str,
) -> UnilateralStep:
    """Return the results of a walking step from its records.

    - `loss_accumulators`: losses in dampers and by sliding, J, and slip length, m, (3, ...);
    - `engine_name`: name of the engine that computed the step.
    """
    damping_loss, friction_loss, slip_length = loss_accumulators
    replace_nonfinite = lambda detail_value: jnp.where(
        jnp.isfinite(detail_value), detail_value, 0.0
    )
    step_details = step_details._replace(
        margins=jax.tree.map(replace_nonfinite, step_details.margins),
        fewest_solutions=jnp.where(step_counters.n_events > 0, step_details.fewest_solutions, 0),
    )
    return UnilateralStep(
        **step_summary._asdict(),
        energy_damping=damping_loss,
        energy_friction=friction_loss,
        slip=slip_length,
        events=step_counters.n_events,
        outcome=outcome,
        solver_steps=step_counters.n_solver_steps,
        engine=engine_name,
        **step_details._asdict(),
    )
