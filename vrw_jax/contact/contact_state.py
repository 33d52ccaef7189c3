"""Dynamics of the wheel between two events, and the guards that detect the next event.

A *contact state* is the set of contact modes of all feet and of stopper flags of all legs. The
contact state is constant between two events.
"""

from collections.abc import Iterable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from vrw_jax.contact.contact_modes import ContactMode, Friction, finite_friction
from vrw_jax.contact.dynamics_jvp import (
    ContactConfiguration,
    ForceSolution,
    slip_sign,
    solve_contact_forces,
)
from vrw_jax.contact.mechanics import (
    ContactSlots,
    FootVelocity,
    LegArray,
    LegDirections,
    SlotPair,
    WheelMotion,
    find_slots,
    foot_heights,
    foot_velocity,
    free_leg_motion,
    make_posture,
    opaque_one,
    prevent_fusion,
    slot_friction,
    sum_over_legs,
)
from vrw_jax.numerics import Elementwise, Scalar
from vrw_jax.wheel import (
    Symbols,
    are_coordinates_at_rest,
    are_rates_negligible,
    compute_wheel_units,
)

PackedState = Float[Array, "dim ..."]
"""Hub (x, z, theta), their rates, leg lengths, their rates, then the accumulators: see
`Accumulators`."""


class Accumulators(NamedTuple):
    """Integrals along the motion, integrated beside the state."""

    time_since_event: Scalar  # time since the last event, s
    damping_loss: Scalar  # energy lost in the dampers, J
    friction_loss: Scalar  # energy lost by sliding, J
    slip_length: Scalar  # path length of all sliding feet, m


def pack_state(motion: WheelMotion, accumulators: Accumulators) -> PackedState:
    """Return motion and accumulators as one vector of 10 + 2 n entries."""
    return jnp.concatenate([jnp.stack(motion[:6]), motion.L, motion.dL, jnp.stack(accumulators)])


def unpack_state(state: PackedState) -> tuple[WheelMotion, Accumulators]:
    """Return motion and accumulators of a packed state: the inverse of `pack_state`."""
    n = (state.shape[0] - 10) // 2
    L, dL, accumulators = state[6 : 6 + n], state[6 + n : 6 + 2 * n], state[6 + 2 * n :]
    motion = WheelMotion(state[0], state[1], state[2], state[3], state[4], state[5], L, dL)
    return motion, Accumulators(accumulators[0], accumulators[1], accumulators[2], accumulators[3])


class ContactState(NamedTuple):
    """Contact modes of the feet, stopper flags of the legs, and the changes at the last event."""

    contact_modes: Int[Array, " n_legs"]  # `ContactMode` of every foot
    locked: Bool[Array, " n_legs"]  # whether a leg is on its stopper
    has_just_lifted: Bool[Array, " n_legs"]  # whether a foot has left the ground at the last event
    has_just_unlocked: Bool[Array, " n_legs"]  # whether a leg has left its stopper then
    has_just_slid: Bool[Array, " n_legs"]  # whether a foot at rest has begun to slide then


class ModeDynamics(NamedTuple):
    """Dynamics of the wheel in one contact state, from the last event to the next."""

    s: Symbols
    friction: Friction  # friction coefficient of the slots' feet
    is_one_sided: bool  # whether legs in the air may leave their stoppers
    contact_state: ContactState
    contact_slots: ContactSlots
    slot_modes: Int[Array, "2"]  # `ContactMode` of each slot's foot
    is_held: Bool[Array, "2"]  # whether the leg of each slot is on its stopper
    is_airborne_locked: Bool[Array, " n_legs"]  # whether a leg is in the air on its stopper
    has_accumulators: bool  # whether a batch integrates the accumulators
    tilt: Elementwise | None = None  # angle by which the next line is steeper, rad

    def configure(self, motion: WheelMotion) -> ContactConfiguration:
        """Return the contact configuration at this motion, for the solution of its forces."""
        contact_slots = self.contact_slots, self.slot_modes, self.is_held, self.is_airborne_locked
        return ContactConfiguration(self.s, motion, self.friction, *contact_slots)


def make_mode_dynamics(
    s: Symbols,
    friction: Friction,
    is_one_sided: bool,
    contact_state: ContactState,
    has_accumulators: bool = False,
    tilt: Elementwise | None = None,
) -> ModeDynamics:
    """Return the dynamics of the wheel in this contact state.

    - `friction`: of all feet, or of the foot that landed last and of the others;
    - `tilt`: angle by which the next line is steeper, rad.
    """
    contact_slots = find_slots(contact_state.contact_modes != ContactMode.OFF)
    slot_modes = contact_slots.gather_codes(contact_state.contact_modes)
    is_held = contact_slots.gather_flags(contact_state.locked)
    is_airborne_locked = contact_state.locked & ~contact_slots.is_filled
    friction = slot_friction(friction, contact_slots)
    return ModeDynamics(
        s,
        friction,
        is_one_sided,
        contact_state,
        contact_slots,
        slot_modes,
        is_held,
        is_airborne_locked,
        has_accumulators,
        tilt,
    )


class ContactForces(NamedTuple):
    """Contact forces, and the leg directions and foot velocities that they depend on."""

    leg_directions: LegDirections
    free_leg_acceleration: LegArray  # see `free_leg_motion`, m/s^2
    solution: ForceSolution
    foot_velocity: FootVelocity


def compute_forces(dynamics: ModeDynamics, motion: WheelMotion) -> ContactForces:
    """Return the forces of ground and stoppers (N), with the resulting accelerations."""
    unit_divisor, posture = (
        opaque_one(motion),
        make_posture(dynamics.s, motion, dynamics.contact_slots),
    )
    leg_acceleration = prevent_fusion(
        free_leg_motion(dynamics.s, motion, posture.leg_directions), unit_divisor
    )
    velocity = prevent_fusion(foot_velocity(motion, dynamics.contact_slots, posture), unit_divisor)
    return ContactForces(
        posture.leg_directions,
        leg_acceleration,
        solve_contact_forces(dynamics.configure(motion)),
        velocity,
    )


def airborne_stopper_force(dynamics: ModeDynamics, forces: ContactForces) -> LegArray:
    """Return the stopper force of each locked leg in the air, N; 0 for the other legs."""
    sin, cos = forces.leg_directions
    ax, az, _ = forces.solution.hub_vector
    # This is the acceleration of each leg's length without forces of slots and stoppers, m/s^2.
    free_acceleration = forces.free_leg_acceleration + sin * ax + cos * az
    return jnp.where(dynamics.is_airborne_locked, dynamics.s.m * free_acceleration, 0.0)


def min_stopper_force(dynamics: ModeDynamics, forces: ContactForces) -> Elementwise:
    """Return the minimum of `airborne_stopper_force` over the legs, N.

    The minimum is infinite if no leg in the air is locked.
    """
    return jnp.min(
        jnp.where(dynamics.is_airborne_locked, airborne_stopper_force(dynamics, forces), jnp.inf),
        axis=0,
    )


def accumulator_rates(
    dynamics: ModeDynamics, motion: WheelMotion, forces: ContactForces
) -> Accumulators:
    """Return the time derivatives of the accumulators: 1 (time), damping and sliding loss in W,
    slip in m/s.
    """
    slip_signs = slip_sign(dynamics.slot_modes)
    slip_speeds = [slip_signs[i] * forces.foot_velocity.x[i] for i in range(2)]
    friction_forces = [-forces.solution.tangential[i] * slip_signs[i] for i in range(2)]
    return Accumulators(
        time_since_event=jnp.ones_like(motion.x),
        damping_loss=dynamics.s.c * sum_over_legs(motion.dL * motion.dL),
        friction_loss=friction_forces[0] * slip_speeds[0] + friction_forces[1] * slip_speeds[1],
        slip_length=slip_speeds[0] + slip_speeds[1],
    )


def vector_field(dynamics: ModeDynamics, state: PackedState) -> PackedState:
    """Return the time derivative of the packed state in this contact state."""
    motion, _ = unpack_state(state)
    forces = compute_forces(dynamics, motion)
    rates = WheelMotion(
        motion.vx,
        motion.vz,
        motion.dtheta,
        *forces.solution.hub_vector,
        jnp.where(dynamics.contact_state.locked, 0.0, motion.dL),
        forces.solution.length_motion,
    )
    return prevent_fusion(
        pack_state(rates, accumulator_rates(dynamics, motion, forces)), opaque_one(motion)
    )


class GuardLayout(NamedTuple):
    """Index of the first guard of each kind in the vector of `compute_guard_values`."""

    landing: int  # height of a foot in the air, one per leg: zero at a landing
    stopper: int  # distance to the stopper, one per leg
    liftoff: int  # normal force, one per slot
    slip_up: int  # friction margin before the foot slides uphill, one per slot
    slip_down: int  # friction margin before the foot slides downhill, one per slot
    slip_end: int  # speed of a sliding foot, one per slot
    stopper_release: int  # stopper force of a loaded leg, one per slot
    rolling_rate: int  # rate of rolling, dtheta
    collapse: int  # length of the shortest leg minus a
    airborne_release: int  # stopper force in the air, one per leg, if one-sided
    n_guards: int

    @property
    def n_legs(self) -> int:
        """Number of legs of the wheel."""
        return self.stopper - self.landing

    @property
    def foremost_landing(self) -> int:
        """Return the index of the guard of the foremost foot, whose landing ends a step."""
        return self.stopper - 1


def make_guard_layout(n: int, is_one_sided: bool) -> GuardLayout:
    """Return the guard layout of a wheel with `n` legs.

    - `is_one_sided`: whether legs in the air may leave their stoppers.
    """
    sizes = (n, n, 2, 2, 2, 2, 2, 1, 1, n if is_one_sided else 0)
    offsets = np.concatenate([[0], np.cumsum(sizes)])
    return GuardLayout(*(int(guard_offset) for guard_offset in offsets))


class ContactQuantities(NamedTuple):
    """Forces and foot speeds that the guards depend on, besides the motion."""

    leg_directions: LegDirections
    normal: SlotPair
    tangential: SlotPair
    stopper: SlotPair
    slip_speed: SlotPair  # speed of the slots' feet along the slope, m/s
    painleve_determinant: Array  # see `contact_modes.ContactSolution`
    airborne_stopper: LegArray | None  # stopper force of legs in the air, if stoppers are one-sided


def collect_contact_quantities(dynamics: ModeDynamics, forces: ContactForces) -> ContactQuantities:
    """Return the quantities of the forces that `evaluate_guards` needs."""
    solution = forces.solution
    airborne_stopper = airborne_stopper_force(dynamics, forces) if dynamics.is_one_sided else None
    force_pairs = solution.normal, solution.tangential, solution.stopper
    return ContactQuantities(
        forces.leg_directions,
        *force_pairs,
        forces.foot_velocity.x,
        solution.painleve_determinant,
        airborne_stopper,
    )


def stack_friction(friction: Friction) -> Array:
    """Return the friction of the slots as one array (2, ...), or the common friction unchanged."""
    return jnp.stack(friction) if isinstance(friction, tuple) else friction


def evaluate_guards(
    dynamics: ModeDynamics,
    motion: WheelMotion,
    quantities: ContactQuantities,
    is_after_start: Array,
) -> list[Array]:
    """Return the guards in the order of `GuardLayout`, one array for each kind.

    - `is_after_start`: False at the start of the contact state.

    The event that starts a contact state leaves a guard at zero: the guard of a foot off the
    ground, of a leg off its stopper, or of a sliding foot. That guard is not evaluated at that
    instant; its value is 1.
    """
    s, contact_state = dynamics.s, dynamics.contact_state
    ones = jnp.ones_like(motion.L)
    is_airborne = (contact_state.contact_modes == ContactMode.OFF) & (
        is_after_start | ~contact_state.has_just_lifted
    )
    is_free_leg = ~contact_state.locked & (is_after_start | ~contact_state.has_just_unlocked)
    has_just_slid = dynamics.contact_slots.gather_flags(contact_state.has_just_slid)
    coefficient = stack_friction(finite_friction(dynamics.friction))
    normal, tangential = jnp.stack(quantities.normal), jnp.stack(quantities.tangential)
    # In the limit of large friction, a resting foot begins to slide when its normal force vanishes
    # (see `impacts.resolve_event`). A sliding foot lifts off when its friction vanishes.
    uses_friction_limit = stack_friction(dynamics.friction) == jnp.inf
    slip_signs = jnp.stack(slip_sign(dynamics.slot_modes))
    supporting_force = jnp.where(
        uses_friction_limit & (slip_signs != 0.0), -slip_signs * tangential, normal
    )
    has_friction_cone = (dynamics.slot_modes == ContactMode.STICK) & jnp.isfinite(
        stack_friction(dynamics.friction)
    )
    is_sliding = (slip_signs != 0.0) & (is_after_start | ~has_just_slid)
    if_evaluated = lambda condition, guard_value: jnp.where(condition, guard_value, 1.0)
    airborne_guards = (
        []
        if quantities.airborne_stopper is None
        else [jnp.where(dynamics.is_airborne_locked, quantities.airborne_stopper, ones)]
    )
    return [
        jnp.where(
            is_airborne, foot_heights(motion, quantities.leg_directions, dynamics.tilt), ones
        ),
        jnp.where(is_free_leg, s.L0 - motion.L, ones),
        if_evaluated(dynamics.slot_modes != ContactMode.OFF, supporting_force),
        if_evaluated(has_friction_cone, coefficient * normal - tangential),
        if_evaluated(has_friction_cone, coefficient * normal + tangential),
        if_evaluated(is_sliding, slip_signs * jnp.stack(quantities.slip_speed)),
        if_evaluated(dynamics.is_held, jnp.stack(quantities.stopper)),
        motion.dtheta[None],
        (jnp.min(motion.L, axis=0) - s.a)[None],
        *airborne_guards,
    ]


def compute_guard_scales(dynamics: ModeDynamics) -> Array:
    """Return the scale of each guard in the order of `GuardLayout`: m, N, m/s or rad/s."""
    s = dynamics.s
    force_scale, speed_scale = s.Mt * s.g, jnp.sqrt(s.g * s.L0)
    guard_scales = (
        [s.L0] * 2 * s.n
        + [force_scale] * 6
        + [speed_scale] * 2
        + [force_scale] * 2
        + [speed_scale / s.L0, s.L0]
    )
    return jnp.stack(guard_scales + [force_scale] * s.n * dynamics.is_one_sided)


def compute_state_units(s: Symbols) -> tuple[Array, Array]:
    """Return the wheel's units of (hub x, z, theta, lengths) and of their rates."""
    units, angle_unit = compute_wheel_units(s), jnp.ones_like(s.L0)
    position_units = [units.length_unit, units.length_unit, angle_unit, *[units.length_unit] * s.n]
    rate_units = [
        units.velocity_unit,
        units.velocity_unit,
        units.rate_unit,
        *[units.velocity_unit] * s.n,
    ]
    return jnp.stack(position_units), jnp.stack(rate_units)


def is_wheel_at_rest(
    s: Symbols, rates: Array, accelerations: Iterable[Array], atol: Elementwise
) -> Bool[Array, "..."]:
    """Return whether the wheel is at rest, from rates and accelerations of all coordinates.

    - `atol`: absolute tolerance in the wheel's units.
    """
    rate_units, time_unit = compute_state_units(s)[1], compute_wheel_units(s).time_unit
    return are_coordinates_at_rest(rates, accelerations, rate_units, time_unit, atol)


def choose_stopping_guard(
    guard_layout: GuardLayout,
    dynamics: ModeDynamics,
    rates: Array,
    guard: Int[Array, "..."],
    atol: Elementwise,
) -> Int[Array, "..."]:
    """Return the guard that has triggered, with the end of rolling replaced by that of a foot's
    slide.

    The guard is replaced if both end together, because rounding decides which of the two vanishes
    first. The friction of the stopped foot then decides whether the wheel rests or falls back.
    """
    slip_signs = slip_sign(dynamics.slot_modes)
    has_just_slid = dynamics.contact_slots.gather_flags(dynamics.contact_state.has_just_slid)
    is_stopping = guard == guard_layout.rolling_rate
    is_stopping &= are_rates_negligible(rates, compute_state_units(dynamics.s)[1], atol)
    for slot_index in reversed(range(2)):
        slide_ends = is_stopping & (slip_signs[slot_index] != 0.0) & ~has_just_slid[slot_index]
        guard = jnp.where(slide_ends, guard_layout.slip_end + slot_index, guard)
    return guard


def compute_packed_units(s: Symbols) -> PackedState:
    """Return the wheel's unit of each entry of `pack_state`."""
    units, (position_units, rate_units) = compute_wheel_units(s), compute_state_units(s)
    accumulator_units = Accumulators(
        units.time_unit, units.energy_unit, units.energy_unit, units.length_unit
    )
    packed_units = (
        position_units[:3],
        rate_units[:3],
        position_units[3:],
        rate_units[3:],
        jnp.stack(accumulator_units),
    )
    return lax.stop_gradient(jnp.concatenate(packed_units))


def compute_guard_values(dynamics: ModeDynamics, state: PackedState) -> Float[Array, " n_guards"]:
    """Return all guards at a packed state: positive inside the contact state, zero at its end.

    A guard that is not evaluated is 1.
    """
    motion, accumulators = unpack_state(state)
    quantities = collect_contact_quantities(dynamics, compute_forces(dynamics, motion))
    guard_parts = evaluate_guards(dynamics, motion, quantities, accumulators.time_since_event > 0.0)
    return jnp.concatenate(prevent_fusion(guard_parts, opaque_one(motion)))
