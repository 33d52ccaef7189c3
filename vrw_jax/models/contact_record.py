"""Section state and record of a walking step with unilateral contact, elementwise for a batch.

A walking step is a sequence of events, each followed by an interval with constant contact state.
The first event is the landing at which the step starts. The step is complete when the foremost foot
lands. The section state is the motion with the contacts just before this landing, as one vector.
"""

import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from vrw_jax.base.elementwise import Elementwise
from vrw_jax.base.options import StepOptions
from vrw_jax.models.contact_impacts import ContactEvent, ContactEventResult
from vrw_jax.models.contact_mechanics import (
    WheelMotion,
    align_with_batch,
    compute_foot_heights,
    compute_foot_positions,
    compute_leg_directions,
)
from vrw_jax.models.contact_state import (
    N_LOSSES,
    ContactModeDynamics,
    ContactState,
    compute_forces,
    compute_normal_force_rates,
    find_kink_sides,
    split_normal_forces,
)
from vrw_jax.models.phase_sequence import (
    is_slope_in_domain,
    is_valid_start_state,
    replace_invalid_inputs,
)
from vrw_jax.models.step_results import PAPER_START_STATE, AbstractContactStep
from vrw_jax.wheel.dynamics import compute_length_at_touchdown
from vrw_jax.wheel.params import MAX_SI_VALUE, Symbols, WheelParams, WheelUnits
from vrw_jax.wheel.transitions import ContactMode, GroundAhead, compute_line_slope

FullState = Float[Array, "n_full ..."]
"""State just before the foremost foot lands, as one vector of 4 + 3 n entries.

The entries are (theta-, dtheta-, vx-, vz-, L_1 ... L_n, dL_1 ... dL_n, code_1 ... code_n), in the
leg numbering of the step that ends. The units are rad, rad/s, m/s for the hub velocity, m and m/s.

The contact code of a leg is the contact mode of its foot: 0 in the air, 1 at rest, 2 sliding
downhill, 3 sliding uphill. The code of a leg on its stopper is larger by 4. The height of the hub
follows from the landing foot.
"""

LOCKED_CODE_OFFSET = 4
"""Difference between the contact code of a leg on its stopper and the contact mode of its foot."""


def compute_full_section_size(n_legs: int) -> int:
    """Return the number of entries in a full section state of a wheel with `n_legs` legs."""
    return 4 + 3 * n_legs


def compute_section_units(wheel_units: WheelUnits, n_legs: int) -> list[Elementwise]:
    """Return a list with the wheel's unit for each entry of a full section state.

    Angles and contact codes have the unit 1.
    """
    angle_unit = wheel_units.length_unit / wheel_units.length_unit
    return [
        angle_unit,
        wheel_units.rate_unit,
        *[wheel_units.velocity_unit] * 2,
        *[wheel_units.length_unit] * n_legs,
        *[wheel_units.velocity_unit] * n_legs,
        *[angle_unit] * n_legs,
    ]


def embed_section_state(s: Symbols, paper_state: Float[Array, "3 ..."]) -> FullState:
    """Return the full section state for (theta-, dtheta-, dL1-), the section state of the paper.

    Leg 1 is at rest on the ground, and all other legs are in the air on their stoppers.
    """
    theta, dtheta, dL1 = paper_state
    sin, cos, L1 = jnp.sin(theta), jnp.cos(theta), compute_length_at_touchdown(s, theta)
    is_leg_1 = (jnp.arange(s.n) == 0).reshape(-1, *(1,) * theta.ndim)
    vx, vz = dL1 * sin + L1 * dtheta * cos, dL1 * cos - L1 * dtheta * sin
    return jnp.concatenate(
        [
            jnp.stack([theta, dtheta, vx, vz]),
            jnp.where(is_leg_1, L1, s.L0),
            jnp.where(is_leg_1, dL1, 0.0),
            jnp.where(
                is_leg_1,
                float(ContactMode.STICK),
                LOCKED_CODE_OFFSET + ContactMode.OFF + 0.0 * theta,
            ),
        ]
    )


def replace_invalid_start(
    params: WheelParams,
    friction: Elementwise,
    section_state: FullState,
    ground_ahead: GroundAhead | None,
) -> tuple[Bool[Array, "..."], WheelParams, Elementwise, FullState]:
    """Return which starts of a step are valid, and the input with invalid starts replaced.

    An invalid element is replaced by the start of the wheel in Table 1 of the paper, with a
    friction coefficient of 1. The result is (is_valid, parameters, friction, section state).

    - `friction`: friction coefficient of the ground, invalid if negative;
    - `ground_ahead`: uneven ground, on which feet may be below the extension of the line with the
      last foothold.
    """
    valid_state = embed_section_state(
        WheelParams(n_legs=params.n_legs).symbols(),
        jnp.asarray(PAPER_START_STATE, section_state.dtype),
    )
    valid_column = valid_state.reshape(-1, *(1,) * (section_state.ndim - 1))
    is_valid = is_valid_start_state(params, section_state) & (friction >= 0.0)
    if ground_ahead is not None:
        is_valid = is_valid & is_slope_in_domain(params.slope + ground_ahead.tilt)
        if ground_ahead.rise is not None:
            is_valid = is_valid & (jnp.abs(ground_ahead.rise) < MAX_SI_VALUE)
    else:
        # No foot may be below the ground, and no leg longer than its stopper allows. Loaded feet
        # must be on the ground.
        s = params.symbols()
        motion, contact_state = unpack_section_state(s, section_state)
        foot_heights = compute_foot_heights(motion, compute_leg_directions(s, motion.theta))
        height_tolerance = PENETRATION_TOLERANCE * s.L0
        is_contact_consistent = (contact_state.contact_modes == ContactMode.OFF) | (
            foot_heights <= height_tolerance
        )
        is_leg_consistent = (
            (foot_heights >= -height_tolerance)
            & is_contact_consistent
            & (height_tolerance >= motion.L - s.L0)
        )
        is_valid = is_valid & jnp.all(is_leg_consistent, axis=0)
    params, section_state = replace_invalid_inputs(is_valid, params, section_state, valid_column)
    return is_valid, params, jnp.where(is_valid, friction, 1.0), section_state


PENETRATION_TOLERANCE = 1e-3
"""Largest accepted position error in a section state, as a fraction of the leg length.

The value is larger than the errors of integration and of Newton's method. It is small enough for
the first events to correct the error.
"""


def unpack_section_state(s: Symbols, section_state: FullState) -> tuple[WheelMotion, ContactState]:
    """Return the motion and the contact state just before the landing that starts a step.

    The legs are numbered as in the step that starts, and the landing foot is the origin. Lengths of
    loaded legs are replaced so that their feet are on the slope. Every vector near a section state
    is therefore valid. The impact at landing brings sticking feet to rest.
    """
    n_legs = s.n
    theta = section_state[0] - s.alpha
    leg_entries = (section_state[4 + i * n_legs : 4 + (i + 1) * n_legs] for i in range(3))
    L, dL, contact_codes = (
        jnp.concatenate([entries_by_leg[-1:], entries_by_leg[:-1]])
        for entries_by_leg in leg_entries
    )
    contact_codes = jnp.floor(contact_codes + 0.5).astype(jnp.int32)
    contact_modes = contact_codes & (LOCKED_CODE_OFFSET - 1)
    is_leg_locked = contact_codes >= LOCKED_CODE_OFFSET
    L = jnp.where(is_leg_locked, s.L0, L)
    leg_directions = compute_leg_directions(s, theta)
    hub_x, hub_z = L[0] * leg_directions.sin[0], L[0] * leg_directions.cos[0]
    L = jnp.where(
        (contact_modes != ContactMode.OFF) & ~is_leg_locked, hub_z / leg_directions.cos, L
    )
    dtheta, vx, vz = section_state[1], section_state[2], section_state[3]
    motion = WheelMotion(hub_x, hub_z, theta, vx, vz, dtheta, L, dL)
    is_kink_positive = find_kink_sides(s, L, dL)
    return motion, ContactState.without_recent_changes(
        contact_modes, is_leg_locked, is_kink_positive
    )


def pack_section_state(
    s: Symbols,
    motion: WheelMotion,
    contact_state: ContactState,
    ground_ahead: GroundAhead | None = None,
) -> FullState:
    """Return the section state for a motion just before the next landing.

    On uneven ground, the section state is in the frame of the line on which the foot lands.

    - `ground_ahead`: uneven ground; None on flat ground.
    """
    contact_codes = contact_state.contact_modes + LOCKED_CODE_OFFSET * contact_state.is_leg_locked
    theta, vx, vz = motion.theta, motion.vx, motion.vz
    if ground_ahead is not None:
        tilt = _compute_next_line_tilt(s, motion, ground_ahead)
        sin, cos = jnp.sin(tilt), jnp.cos(tilt)
        theta, vx, vz = theta - tilt, vx * cos - vz * sin, vz * cos + vx * sin
    return jnp.concatenate(
        [
            jnp.stack([theta, motion.dtheta, vx, vz]),
            motion.L,
            motion.dL,
            contact_codes.astype(motion.L.dtype),
        ]
    )


def compute_section_foot_distance(s: Symbols, section_state: FullState) -> Elementwise:
    """Return the distance between the landing foot and the foot of Leg 1 along the slope, m."""
    motion, _ = unpack_section_state(s, section_state)
    return -compute_foot_positions(motion, compute_leg_directions(s, motion.theta))[1]


def _compute_next_line_tilt(
    s: Symbols, motion: WheelMotion, ground_ahead: GroundAhead
) -> Elementwise:
    """Return the angle by which the line on which the foremost foot lands is steeper, rad.

    If heights are given and Leg 1 is in the air, the rise is that of the line from below its foot
    to the landing foot, as in `compute_section_foot_distance`.
    """
    if ground_ahead.rise is None:
        return ground_ahead.tilt
    leg_directions = compute_leg_directions(s, motion.theta)
    positions, heights = (
        function(motion, leg_directions)
        for function in (compute_foot_positions, compute_foot_heights)
    )
    dx, dz = positions[-1] - positions[0], heights[-1] - heights[0]
    sin, cos = jnp.sin(ground_ahead.tilt), jnp.cos(ground_ahead.tilt)
    foot_rise, distance = dz * cos + dx * sin, jnp.sqrt(dx * dx + dz * dz)
    # With Leg 1 on the ground, its foot is `rise` below the landing foot, and both terms agree.
    return 0.5 * (
        compute_line_slope(ground_ahead.tilt, foot_rise, distance)
        + compute_line_slope(ground_ahead.tilt, 2.0 * ground_ahead.rise - foot_rise, distance)
    )


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
