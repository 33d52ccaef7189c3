"""Full section state of the model with unilateral contact as one vector.

The functions convert it to and from motions.
"""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from vrw_jax.base.types import Elementwise
from vrw_jax.models.contact_mechanics import (
    WheelMotion,
    compute_foot_heights,
    compute_foot_positions,
    compute_leg_directions,
)
from vrw_jax.models.contact_state import ContactState, find_kink_sides
from vrw_jax.models.phase_sequence import (
    is_slope_in_domain,
    is_valid_start_state,
    replace_invalid_inputs,
)
from vrw_jax.models.step_results import PAPER_START_STATE
from vrw_jax.wheel.dynamics import compute_length_at_touchdown
from vrw_jax.wheel.ground import GroundAhead, compute_line_slope
from vrw_jax.wheel.outcomes import ContactMode
from vrw_jax.wheel.params import MAX_SI_VALUE, Symbols, WheelParams, WheelUnits

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
