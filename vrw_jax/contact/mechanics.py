"""Mechanics of the free wheel in coordinates of hub and legs, and its response to forces.

The coordinates are the hub position (x, z), the angle theta of Leg 1 and the n leg lengths. Each
leg is coupled only to the hub, so the mass matrix is an arrow matrix. Eliminating the legs of free
length leaves a 3 x 3 system. At most two feet are loaded at a time. Their legs are in two *contact
slots*, fore leg first.

The force on a foot has a radial part along u (foot to hub) and a transverse part along e =
du/dtheta. Only the transverse part acts on the hub. The same equations apply to accelerations and,
with momenta in place of forces, to impacts. All functions work elementwise over a batch, whose axis
follows that of the legs.
"""

import math
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from vrw_jax.numerics import Elementwise, Scalar, compute_sine_cosine
from vrw_jax.wheel import Symbols

LegArray = Float[Array, "n_legs ..."]
"""Array with one entry per leg on the first axis."""
HubVector = tuple[Any, Any, Any]
"""Components of a generalized vector for the coordinates hub x, hub z and theta."""
SlotPair = tuple[Any, Any]
"""Pair of quantities, one for the leg in each of the two contact slots."""


class WheelMotion(NamedTuple):
    """Coordinates and rates of the free wheel in a frame whose x axis points down the slope."""

    x: Scalar  # downhill position of the hub, m
    z: Scalar  # height of the hub above the slope, m
    theta: Scalar  # angle of Leg 1, rad
    vx: Scalar  # downhill velocity of the hub, m/s
    vz: Scalar
    dtheta: Scalar  # angular rate, rad/s
    L: LegArray  # leg lengths, m
    dL: LegArray  # rates of the leg lengths, m/s


class LegDirections(NamedTuple):
    """Directions of all legs: radial u = (sin, cos) and transverse e = (cos, -sin)."""

    sin: LegArray
    cos: LegArray


def compute_leg_directions(s: Symbols, theta: Elementwise) -> LegDirections:
    """Return the directions of all legs for the angle `theta` (rad) of Leg 1.

    The angle may include any number of turns.
    """
    leg_angles = (s.alpha * np.arange(s.n)).reshape(-1, *(1,) * jnp.ndim(theta))
    n_half_turns = lax.stop_gradient(jnp.floor(theta / math.pi + 0.5))
    is_half_turn_odd = n_half_turns - 2.0 * jnp.floor(0.5 * n_half_turns)
    sin, cos = (
        x - 2.0 * is_half_turn_odd * x for x in compute_sine_cosine(theta - math.pi * n_half_turns)
    )
    sin_leg, cos_leg = np.sin(leg_angles), np.cos(leg_angles)
    return LegDirections(sin * cos_leg + cos * sin_leg, cos * cos_leg - sin * sin_leg)


def sum_over_legs(leg_quantities: Array) -> Array:
    """Return the sum over the legs, which are on the first axis."""
    return jnp.sum(leg_quantities, axis=0)


def prevent_fusion(tree: Any, opaque_one: Array) -> Any:
    """Return the tree with every float array divided by `opaque_one`, which is 1 at run time.

    When XLA fuses operations on a CPU, it repeats chains of cheap operations for each use. Here the
    repetitions would multiply the number of operations by a hundred. XLA computes a division only
    once.
    """
    is_float_array = lambda leaf: jnp.issubdtype(jnp.result_type(leaf), jnp.floating)
    return jax.tree.map(lambda leaf: leaf / opaque_one if is_float_array(leaf) else leaf, tree)


def make_opaque_one(motion: "WheelMotion") -> Array:
    """Return an array of ones with the shape of `theta` that no compiler can simplify."""
    return lax.stop_gradient(1.0 + 0.0 * motion.theta)


def stop_gradients(tree: Any) -> Any:
    """Return the tree with its float arrays excluded from differentiation."""
    float_leaves, nonfloat_leaves = eqx.partition(tree, eqx.is_inexact_array)
    return eqx.combine(lax.stop_gradient(float_leaves), nonfloat_leaves)


class ContactSlots(NamedTuple):
    """Masks of the legs in the two contact slots, fore leg first.

    The feet of these legs may be loaded. The mask of an empty slot is False for all legs.
    """

    first_slot_mask: Bool[Array, "n_legs ..."]
    second_slot_mask: Bool[Array, "n_legs ..."]

    @property
    def is_in_slot(self) -> Bool[Array, "n_legs ..."]:
        """Return whether each leg is in one of the two contact slots, shape (n_legs, ...)."""
        return self.first_slot_mask | self.second_slot_mask

    def gather_slot_codes(self, leg_quantities: Array) -> Int[Array, "2 ..."]:
        """Return the integers of the legs in both contact slots, (2, ...), from an integer per leg.

        The result for an empty slot is 0.
        """
        return jnp.stack(self.gather_slot_pair(leg_quantities))

    def gather_slot_flags(self, leg_quantities: Array) -> Bool[Array, "2 ..."]:
        """Return the flags of the legs in both contact slots, (2, ...), from a flag per leg.

        The result for an empty slot is False.
        """
        return self.gather_slot_codes(leg_quantities.astype(jnp.int32)) > 0

    def gather_slot_pair(self, leg_quantities: Array) -> SlotPair:
        """Return the entries of `leg_quantities` for the legs in both contact slots.

        The result for an empty slot is 0.
        """
        zero_slot_values = jnp.zeros_like(leg_quantities)
        return (
            sum_over_legs(jnp.where(self.first_slot_mask, leg_quantities, zero_slot_values)),
            sum_over_legs(jnp.where(self.second_slot_mask, leg_quantities, zero_slot_values)),
        )

    def scatter_to_legs(self, slot_pair: Any) -> LegArray:
        """Return an array over all legs with the entries of `slot_pair` at the legs in contact.

        Other legs have the entry 0. The function is the inverse of `gather_slot_pair`.
        """
        return jnp.where(self.first_slot_mask, slot_pair[0], 0.0) + jnp.where(
            self.second_slot_mask, slot_pair[1], 0.0
        )


def find_contact_slots(is_foot_touching: Bool[Array, "n_legs ..."]) -> ContactSlots:
    """Return contact slots with the first two legs whose feet touch the ground."""
    touching_leg_rank = jnp.cumsum(is_foot_touching.astype(jnp.int32), axis=0)
    return ContactSlots(
        is_foot_touching & (touching_leg_rank == 1), is_foot_touching & (touching_leg_rank == 2)
    )


def select_slot_friction(
    friction: Elementwise | SlotPair, contact_slots: ContactSlots
) -> Elementwise | SlotPair:
    """Return the friction coefficient for the foot in each contact slot.

    If `friction` is a pair, it contains the coefficient for the foot of Leg 1, which landed last,
    and that for all other feet. A single coefficient applies to all feet and is returned unchanged.
    """
    if not isinstance(friction, tuple):
        return friction
    last_landed_friction, other_feet_friction = friction
    return jnp.where(
        contact_slots.first_slot_mask[0], last_landed_friction, other_feet_friction
    ), other_feet_friction


class ContactInverseInertia(NamedTuple):
    """Inverse inertia of the hub, and responses of hub, feet and legs to contact forces."""

    leg_directions: LegDirections
    # whether a leg is eliminated: free in length, or in a contact slot
    is_leg_released: Bool[Array, " n_legs"]
    inverse_inertia: tuple[Any, ...]  # entries xx, xz, x theta, zz, z theta, theta theta
    sin: SlotPair
    cos: SlotPair
    L: SlotPair
    # response of the hub to a unit transverse force
    hub_response_transverse: tuple[HubVector, HubVector]
    hub_response_radial: tuple[HubVector, HubVector]  # response of the hub to a unit stopper force
    G: tuple[Any, Any, Any]  # entries 11, 12, 22: response of the feet to transverse forces
    H: tuple[Any, Any, Any, Any]  # entries 11, 12, 21, 22: response of the feet to stopper forces
    K: tuple[Any, Any, Any]  # entries 11, 12, 22: response of the legs to stopper forces


def multiply_by_inverse_inertia(
    inverse_inertia: tuple[Any, ...], generalized_force: HubVector
) -> HubVector:
    """Return the product of the symmetric inverse inertia matrix and a generalized force."""
    inverse_xx, inverse_xz, inverse_xt, inverse_zz, inverse_zt, inverse_tt = inverse_inertia
    return (
        inverse_xx * generalized_force[0]
        + inverse_xz * generalized_force[1]
        + inverse_xt * generalized_force[2],
        inverse_xz * generalized_force[0]
        + inverse_zz * generalized_force[1]
        + inverse_zt * generalized_force[2],
        inverse_xt * generalized_force[0]
        + inverse_zt * generalized_force[1]
        + inverse_tt * generalized_force[2],
    )


def _invert_inertia(
    s: Symbols, leg_directions: LegDirections, b: LegArray, is_leg_released: Array
) -> tuple[Any, ...]:
    """Return the inverse of the hub's 3 x 3 inertia matrix without the released legs.

    The entries are `xx, xz, x theta, zz, z theta, theta theta`. `b` contains the distances of the
    leg masses from the hub, m.
    """
    sin = jnp.where(is_leg_released, leg_directions.sin, 0.0)
    cos = jnp.where(is_leg_released, leg_directions.cos, 0.0)
    inertia_xx = s.Mt - s.m * sum_over_legs(sin * sin)
    inertia_xz = -s.m * sum_over_legs(sin * cos)
    inertia_zz = s.Mt - s.m * sum_over_legs(cos * cos)
    inertia_xt = -s.m * sum_over_legs(b * leg_directions.cos)
    inertia_zt = s.m * sum_over_legs(b * leg_directions.sin)
    inertia_tt = s.m * sum_over_legs(b * b)
    cofactor_xx = inertia_zz * inertia_tt - inertia_zt * inertia_zt
    cofactor_xz = inertia_xt * inertia_zt - inertia_xz * inertia_tt
    cofactor_xt = inertia_xz * inertia_zt - inertia_zz * inertia_xt
    inverse_determinant = 1.0 / (
        inertia_xx * cofactor_xx + inertia_xz * cofactor_xz + inertia_xt * cofactor_xt
    )
    return (
        cofactor_xx * inverse_determinant,
        cofactor_xz * inverse_determinant,
        cofactor_xt * inverse_determinant,
        (inertia_xx * inertia_tt - inertia_xt * inertia_xt) * inverse_determinant,
        (inertia_xz * inertia_xt - inertia_xx * inertia_zt) * inverse_determinant,
        (inertia_xx * inertia_zz - inertia_xz * inertia_xz) * inverse_determinant,
    )


class WheelPosture(NamedTuple):
    """Directions of all legs, and the directions and lengths of the legs in the contact slots."""

    leg_directions: LegDirections
    sin: SlotPair
    cos: SlotPair
    L: SlotPair


def make_wheel_posture(
    s: Symbols, motion: WheelMotion, contact_slots: ContactSlots
) -> WheelPosture:
    """Return the directions of all legs, and the lengths of the legs in the contact slots."""
    leg_directions = compute_leg_directions(s, motion.theta)
    return WheelPosture(
        leg_directions,
        contact_slots.gather_slot_pair(leg_directions.sin),
        contact_slots.gather_slot_pair(leg_directions.cos),
        contact_slots.gather_slot_pair(motion.L),
    )


def make_inverse_inertia(
    s: Symbols, motion: WheelMotion, contact_slots: ContactSlots, is_airborne_leg_locked: Array
) -> ContactInverseInertia:
    """Return the inverse inertia of the hub and the responses to contact forces for a posture.

    - `is_airborne_leg_locked`: whether a leg is in the air on its stopper.
    """
    leg_directions, sin, cos, L = make_wheel_posture(s, motion, contact_slots)
    is_leg_released = contact_slots.is_in_slot | ~is_airborne_leg_locked
    inverse_inertia = _invert_inertia(s, leg_directions, motion.L - s.a, is_leg_released)
    e = [(cos[i], -sin[i], -L[i]) for i in range(2)]
    u = [(sin[i], cos[i], jnp.zeros_like(sin[i])) for i in range(2)]
    z = (
        multiply_by_inverse_inertia(inverse_inertia, e[0]),
        multiply_by_inverse_inertia(inverse_inertia, e[1]),
    )
    y = (
        multiply_by_inverse_inertia(inverse_inertia, u[0]),
        multiply_by_inverse_inertia(inverse_inertia, u[1]),
    )
    multiply_hub_vectors = lambda a, b: a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    multiply_plane_vectors = lambda a, b: a[0] * b[0] + a[1] * b[1]
    return ContactInverseInertia(
        leg_directions,
        is_leg_released,
        inverse_inertia,
        sin,
        cos,
        L,
        hub_response_transverse=z,
        hub_response_radial=y,
        G=(
            multiply_hub_vectors(e[0], z[0]),
            multiply_hub_vectors(e[0], z[1]),
            multiply_hub_vectors(e[1], z[1]),
        ),
        H=(
            multiply_plane_vectors(u[0], z[0]),
            multiply_plane_vectors(u[0], z[1]),
            multiply_plane_vectors(u[1], z[0]),
            multiply_plane_vectors(u[1], z[1]),
        ),
        K=(
            multiply_plane_vectors(u[0], y[0]),
            multiply_plane_vectors(u[0], y[1]),
            multiply_plane_vectors(u[1], y[1]),
        ),
    )


class FreeMotion(NamedTuple):
    """Accelerations without contact forces, or velocities after an impact without impulses."""

    hub_motion: HubVector
    leg_motion: LegArray  # motion of each released leg's length, minus the part u . hub
    slot_leg_motion: SlotPair  # the same for the legs in the contact slots
    foot_transverse_motion: SlotPair  # motion of the feet in contact, transverse to the leg
    foot_radial_motion: SlotPair  # motion of the feet in contact, along the leg


def compute_free_leg_acceleration(
    s: Symbols, motion: WheelMotion, leg_directions: LegDirections
) -> LegArray:
    """Return the acceleration of each leg's length without contact forces, m/s^2.

    The acceleration of the hub in the direction of the leg is not included.
    """
    gravity_x, gravity_z = s.g * s.sin_phi, -s.g * s.cos_phi
    centrifugal_acceleration = (motion.L - s.a) * motion.dtheta * motion.dtheta
    spring_force = s.k * (s.Ls - motion.L) - s.c * motion.dL
    return (
        centrifugal_acceleration
        - (leg_directions.sin * gravity_x + leg_directions.cos * gravity_z)
        + spring_force / s.m
    )


def compute_free_acceleration(
    s: Symbols,
    motion: WheelMotion,
    contact_slots: ContactSlots,
    inverse_inertia: ContactInverseInertia,
) -> FreeMotion:
    """Return the accelerations due to gravity, springs, dampers and rotation alone.

    The computation assumes that feet and stoppers of the legs in `contact_slots` exert no force.
    """
    sin, cos = inverse_inertia.leg_directions
    b, dtheta = motion.L - s.a, motion.dtheta
    gravity_x, gravity_z = s.g * s.sin_phi, -s.g * s.cos_phi
    centrifugal_acceleration = b * dtheta * dtheta
    leg_acceleration = compute_free_leg_acceleration(s, motion, inverse_inertia.leg_directions)
    coriolis_acceleration = 2.0 * motion.dL * dtheta
    radial_acceleration = (
        jnp.where(inverse_inertia.is_leg_released, leg_acceleration, 0.0) - centrifugal_acceleration
    )
    hub_force_x = s.Mt * gravity_x + s.m * sum_over_legs(
        radial_acceleration * sin + coriolis_acceleration * cos
    )
    hub_force_z = s.Mt * gravity_z + s.m * sum_over_legs(
        radial_acceleration * cos - coriolis_acceleration * sin
    )
    hub_torque = -s.m * sum_over_legs(
        b * (coriolis_acceleration + cos * gravity_x - sin * gravity_z)
    )
    hub_acceleration = multiply_by_inverse_inertia(
        inverse_inertia.inverse_inertia, (hub_force_x, hub_force_z, hub_torque)
    )
    slot_coriolis = contact_slots.gather_slot_pair(coriolis_acceleration)
    slot_leg_acceleration = contact_slots.gather_slot_pair(leg_acceleration)
    foot_transverse = [
        inverse_inertia.cos[i] * hub_acceleration[0]
        - inverse_inertia.sin[i] * hub_acceleration[1]
        - inverse_inertia.L[i] * hub_acceleration[2]
        - slot_coriolis[i]
        for i in range(2)
    ]
    foot_radial = [
        inverse_inertia.L[i] * dtheta * dtheta - slot_leg_acceleration[i] for i in range(2)
    ]
    return FreeMotion(
        hub_acceleration,
        leg_acceleration,
        slot_leg_acceleration,
        (foot_transverse[0], foot_transverse[1]),
        (foot_radial[0], foot_radial[1]),
    )


def compute_free_velocity(
    s: Symbols,
    motion: WheelMotion,
    contact_slots: ContactSlots,
    inverse_inertia: ContactInverseInertia,
) -> FreeMotion:
    """Return the velocities after an impact without impulses on legs in the contact slots.

    A leg in the air that reaches its stopper strikes it inelastically.
    """
    sin, cos = inverse_inertia.leg_directions
    b, dtheta = motion.L - s.a, motion.dtheta
    hub_outward = sin * motion.vx + cos * motion.vz
    leg_velocity = jnp.where(inverse_inertia.is_leg_released, motion.dL - hub_outward, 0.0)
    radial_velocity = leg_velocity - motion.dL
    transverse_velocity = b * dtheta
    momentum_x = s.Mt * motion.vx + s.m * sum_over_legs(
        radial_velocity * sin - transverse_velocity * cos
    )
    momentum_z = s.Mt * motion.vz + s.m * sum_over_legs(
        radial_velocity * cos + transverse_velocity * sin
    )
    angular_momentum = -s.m * sum_over_legs(
        b * (cos * motion.vx - sin * motion.vz - transverse_velocity)
    )
    hub_velocity = multiply_by_inverse_inertia(
        inverse_inertia.inverse_inertia, (momentum_x, momentum_z, angular_momentum)
    )
    slot_leg_velocity = contact_slots.gather_slot_pair(leg_velocity)
    foot_transverse = [
        inverse_inertia.cos[i] * hub_velocity[0]
        - inverse_inertia.sin[i] * hub_velocity[1]
        - inverse_inertia.L[i] * hub_velocity[2]
        for i in range(2)
    ]
    return FreeMotion(
        hub_velocity,
        leg_velocity,
        slot_leg_velocity,
        (foot_transverse[0], foot_transverse[1]),
        (-slot_leg_velocity[0], -slot_leg_velocity[1]),
    )


class SlotFootVelocity(NamedTuple):
    """Velocities of the feet in the contact slots, tangential and normal to the slope, m/s."""

    velocity_along_slope: SlotPair
    velocity_normal_to_slope: SlotPair


def compute_slot_foot_velocity(
    motion: WheelMotion,
    contact_slots: ContactSlots,
    wheel_posture: ContactInverseInertia | WheelPosture,
) -> SlotFootVelocity:
    """Return the tangential and normal velocities of the feet in the contact slots, m/s."""
    dL = contact_slots.gather_slot_pair(motion.dL)
    x = [
        motion.vx
        - dL[i] * wheel_posture.sin[i]
        - wheel_posture.L[i] * motion.dtheta * wheel_posture.cos[i]
        for i in range(2)
    ]
    z = [
        motion.vz
        - dL[i] * wheel_posture.cos[i]
        + wheel_posture.L[i] * motion.dtheta * wheel_posture.sin[i]
        for i in range(2)
    ]
    return SlotFootVelocity((x[0], x[1]), (z[0], z[1]))


def compute_foot_heights(
    motion: WheelMotion, leg_directions: LegDirections, next_line_tilt: Elementwise | None = None
) -> LegArray:
    """Return the height of every foot above the slope, m.

    - `next_line_tilt`: angle by which the next straight line of uneven ground is steeper, rad. This
      line begins under the foot of Leg 1, and the height of the foremost foot is measured from it.
    """
    foot_heights = motion.z - motion.L * leg_directions.cos
    if next_line_tilt is None:
        return foot_heights
    downhill_positions = compute_foot_positions(motion, leg_directions)
    foremost_distance = downhill_positions[-1] - downhill_positions[0]
    foremost_height = foot_heights[-1] * jnp.cos(next_line_tilt) + foremost_distance * jnp.sin(
        next_line_tilt
    )
    return jnp.concatenate([foot_heights[:-1], foremost_height[None]])


def compute_foot_velocities(
    motion: WheelMotion, leg_directions: LegDirections
) -> tuple[LegArray, LegArray]:
    """Return the tangential and the normal velocity of every foot relative to the slope, m/s."""
    transverse_velocity = motion.L * motion.dtheta
    tangential_speed = (
        motion.vx - motion.dL * leg_directions.sin - transverse_velocity * leg_directions.cos
    )
    return (
        tangential_speed,
        motion.vz - motion.dL * leg_directions.cos + transverse_velocity * leg_directions.sin,
    )


def compute_foot_positions(motion: WheelMotion, leg_directions: LegDirections) -> LegArray:
    """Return the downhill position of every foot, m."""
    return motion.x - motion.L * leg_directions.sin


def compute_landing_position(n_legs: int, motion: WheelMotion) -> Elementwise:
    """Return the downhill position of the foremost foot of a wheel with `n_legs` legs, m."""
    foremost_angle = motion.theta + (n_legs - 1) * 2.0 * math.pi / n_legs
    return motion.x - motion.L[n_legs - 1] * jnp.sin(foremost_angle)


def compute_kinetic_energy(s: Symbols, motion: WheelMotion) -> Elementwise:
    """Return the kinetic energy of the hub and all leg masses, J."""
    leg_directions = compute_leg_directions(s, motion.theta)
    transverse_velocity = (motion.L - s.a) * motion.dtheta
    x = motion.vx - motion.dL * leg_directions.sin - transverse_velocity * leg_directions.cos
    z = motion.vz - motion.dL * leg_directions.cos + transverse_velocity * leg_directions.sin
    hub_mass = s.Mt - s.n * s.m
    return 0.5 * (hub_mass * (motion.vx**2 + motion.vz**2) + s.m * sum_over_legs(x * x + z * z))


def compute_potential_energy(s: Symbols, motion: WheelMotion) -> SlotPair:
    """Return the gravitational energy and the elastic energy of all springs, J.

    The gravitational energy is relative to the origin.
    """
    leg_directions = compute_leg_directions(s, motion.theta)
    x = s.Mt * motion.x - s.m * sum_over_legs((motion.L - s.a) * leg_directions.sin)
    z = s.Mt * motion.z - s.m * sum_over_legs((motion.L - s.a) * leg_directions.cos)
    elastic_energy = 0.5 * s.k * sum_over_legs((motion.L - s.Ls) ** 2)
    return s.g * (z * s.cos_phi - x * s.sin_phi), elastic_energy
