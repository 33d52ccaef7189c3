"""Record of a walking step with unilateral contact, for one wheel or elementwise for a batch.

A walking step is a sequence of events, each followed by an interval with constant contact state.
The first event is the landing at which the step starts. The step is complete when the foremost foot
lands.
"""

import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from vrw_jax.base.options import StepOptions
from vrw_jax.base.types import Elementwise
from vrw_jax.models.contact_impacts import ContactEvent, ContactEventResult
from vrw_jax.models.contact_mechanics import WheelMotion, align_with_batch
from vrw_jax.models.contact_modes import PAPER_RULE_SENTINEL
from vrw_jax.models.contact_state import (
    N_LOSSES,
    ContactModeDynamics,
    compute_forces,
    compute_normal_force_rates,
    split_normal_forces,
)
from vrw_jax.models.step_results import AbstractContactStep
from vrw_jax.wheel.outcomes import ContactMode
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


class UnilateralMargins(eqx.Module):
    """Margins for bilateral stoppers during one walking step.

    A margin is negative if a one-sided stopper would have released a leg in the air.
    """

    stopper_force: Elementwise  # minimum over locked legs in the air, N
    stopper_impulse: Elementwise  # minimum over locked legs in the air, N s


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


def record_force_extremum(
    force_peak_record: ForcePeakRecord,
    is_rate_zero: Bool[Array, "3 ..."],
    contact_mode_dynamics: ContactModeDynamics,
    motion: WheelMotion,
) -> ForcePeakRecord:
    """Return the record after an extremum of a force or of its rate.

    - `is_rate_zero`: which force rate is zero; if none is, the record is unchanged;
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


class StepRecord(NamedTuple):
    """Results of the present walking step so far, as in `UnilateralStep`. Solver steps are those of
    the whole walk.

    Without details, the fields other than the first three are None.
    """

    events: Int[Array, "..."]
    durations: Float[Array, "3 ..."]
    solver_steps: Int[Array, "..."]  # counted over the walk
    losses: Any = None  # losses in dampers and by sliding, J, and slip, m, (N_LOSSES, ...)
    post_impact: Any = None
    mode_durations: Any = None
    landing_normal: Any = None
    landing_tangential: Any = None
    energy_impacts: Any = None
    margins: Any = None
    impacts: Any = None
    fewest_solutions: Any = None
    most_solutions: Any = None
    force_peaks: Any = None


def init_step_record(
    lane_template: Array, is_detailed: bool, measures_force_peaks: bool
) -> StepRecord:
    """Return the record at the start of a walking step.

    The batch shape and the dtype are those of `lane_template`.
    """
    zero, zero_count = jnp.zeros_like(lane_template), jnp.zeros_like(lane_template, jnp.int32)
    make_zeros = lambda *shape: jnp.zeros((*shape, *zero.shape), zero.dtype)
    step_record = StepRecord(zero_count, make_zeros(3), zero_count)
    if not is_detailed:
        return step_record
    force_peaks = ForcePeakRecord(
        n_force_peaks=zero_count,
        smooth_peak_force=zero - jnp.inf,
        lowest_force_after_peak=zero + jnp.inf,
        trough_depth=zero,
        second_peak_rate=zero - jnp.inf,
        n_total_force_peaks=zero_count,
        smooth_peak_total_force=zero - jnp.inf,
        n_force_extrema=zero_count,
        peak_force=zero,
        peak_total_force=zero,
    )
    return step_record._replace(
        losses=make_zeros(N_LOSSES),
        post_impact=make_zeros(2),
        mode_durations=make_zeros(4, 4),
        landing_normal=make_zeros(2),
        landing_tangential=make_zeros(2),
        energy_impacts=zero,
        margins=UnilateralMargins(zero + jnp.inf, zero + jnp.inf),
        impacts=zero_count,
        fewest_solutions=zero_count + jnp.iinfo(jnp.int32).max,
        most_solutions=zero_count,
        force_peaks=force_peaks if measures_force_peaks else None,
    )


def record_event(
    step_record: StepRecord, event_result: ContactEventResult, contact_event: ContactEvent
) -> StepRecord:
    """Return the record after one more event, which the caller counts."""
    keep_first = lambda first, later: jnp.where(step_record.events == 0, first, later)
    post_impact = jnp.stack([event_result.motion.theta, event_result.motion.dtheta])
    stopper_impulse = jnp.minimum(step_record.margins.stopper_impulse, event_result.stopper_impulse)
    force_peaks = step_record.force_peaks
    if force_peaks is not None:  # The force before the first event belongs to the previous step.
        force_peaks = force_peaks._replace(
            peak_force=keep_first(0.0, force_peaks.peak_force),
            peak_total_force=keep_first(0.0, force_peaks.peak_total_force),
        )
    return step_record._replace(
        force_peaks=force_peaks,
        post_impact=keep_first(post_impact, step_record.post_impact),
        landing_normal=keep_first(event_result.normal_impulse, step_record.landing_normal),
        landing_tangential=keep_first(
            event_result.tangential_impulse, step_record.landing_tangential
        ),
        energy_impacts=step_record.energy_impacts + event_result.impact_energy_loss,
        margins=UnilateralMargins(step_record.margins.stopper_force, stopper_impulse),
        impacts=step_record.impacts + contact_event.is_impact,
        fewest_solutions=jnp.minimum(step_record.fewest_solutions, event_result.n_solutions),
        most_solutions=jnp.maximum(step_record.most_solutions, event_result.max_n_solutions),
    )


def record_contact_interval(
    step_record: StepRecord,
    contact_mode_dynamics: ContactModeDynamics,
    motion: WheelMotion,
    duration: Elementwise,
) -> StepRecord:
    """Return the record updated at the start or at the end of an interval.

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
    stopper_force = jnp.minimum(step_record.margins.stopper_force, stopper_force)
    force_peaks = step_record.force_peaks
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
    return step_record._replace(
        force_peaks=force_peaks,
        mode_durations=step_record.mode_durations
        + is_first_slot_mode[:, None] * is_second_slot_mode[None, :] * duration,
        margins=UnilateralMargins(stopper_force, step_record.margins.stopper_impulse),
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

    mode_durations: Float[Array, "4 4 ..."]
    landing_normal: Float[Array, "2 ..."]
    landing_tangential: Float[Array, "2 ..."]
    margins: UnilateralMargins
    events: Int[Array, "..."]
    impacts: Int[Array, "..."]
    fewest_solutions: Int[Array, "..."]
    most_solutions: Int[Array, "..."]
    engine: str = eqx.field(static=True, default="")
    force_peaks: ForcePeakRecord | None = None

    def collect_model_measures(self) -> dict[str, Array]:
        """Return the measures of steps with contacts and the stopper margins, by name."""
        return AbstractContactStep.collect_model_measures(self) | {
            margin_field.name: getattr(self.margins, margin_field.name)
            for margin_field in dataclasses.fields(self.margins)
        }
