"""Mechanics of the free wheel: hub and legs as coordinates, and the response to contact forces.

The coordinates are the hub (x, z), the angle theta of Leg 1 and the n leg lengths. A leg couples
with the hub alone, so the mass matrix is an arrow matrix. Eliminating the legs of free length
leaves a 3 x 3 system. Up to two *slots* hold the legs whose feet may be loaded. The force on a foot
has a radial part along u (foot to hub) and a transverse part along e = du/dtheta. Only the
transverse part acts on the hub. The same equations are used for accelerations and, with momenta in
place of forces, for impacts. All functions work elementwise over a batch, on one more axis behind
that of the legs.
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
"""Quantity of every leg, on the first axis."""
HubVector = tuple[Any, Any, Any]
"""Components of a vector along hub x, hub z and theta."""
SlotPair = tuple[Any, Any]
"""Quantity of each of the two slots."""


class WheelMotion(NamedTuple):
    """Coordinates and rates of the free wheel in the frame of the slope."""

    x: Scalar  # of the hub, m, downhill
    z: Scalar  # of the hub above the slope, m
    theta: Scalar  # of Leg 1, rad
    vx: Scalar  # of the hub, m/s
    vz: Scalar
    dtheta: Scalar  # rad/s
    L: LegArray  # m
    dL: LegArray  # m/s


class LegDirections(NamedTuple):
    """Directions of all legs: radial u = (sin, cos) and transverse e = (cos, -sin)."""

    sin: LegArray
    cos: LegArray


def leg_directions(s: Symbols, theta: Elementwise) -> LegDirections:
    """Return the directions of all legs at the angle `theta` (rad) of Leg 1.

    The angle may have any number of turns.
    """
    leg_angles = (s.alpha * np.arange(s.n)).reshape(-1, *(1,) * jnp.ndim(theta))
    half_turns = lax.stop_gradient(jnp.floor(theta / math.pi + 0.5))
    is_odd = half_turns - 2.0 * jnp.floor(0.5 * half_turns)
    sin, cos = (x - 2.0 * is_odd * x for x in compute_sine_cosine(theta - math.pi * half_turns))
    sin_leg, cos_leg = np.sin(leg_angles), np.cos(leg_angles)
    return LegDirections(sin * cos_leg + cos * sin_leg, cos * cos_leg - sin * sin_leg)


def sum_over_legs(values: Array) -> Array:
    """Return the sum over the legs, which are on the first axis."""
    return jnp.sum(values, axis=0)


def prevent_fusion(tree: Any, unit_divisor: Array) -> Any:
    """Return the tree with every float divided by `unit_divisor`, which is 1 at run time.

    Fusions of XLA on a CPU repeat chains of cheap operations for each use, which multiplies their
    number by a hundred here. A division is computed only once.
    """
    is_float = lambda leaf: jnp.issubdtype(jnp.result_type(leaf), jnp.floating)
    return jax.tree.map(lambda leaf: leaf / unit_divisor if is_float(leaf) else leaf, tree)


def opaque_one(motion: "WheelMotion") -> Array:
    """Return 1 as an array that no compiler can simplify."""
    return lax.stop_gradient(1.0 + 0.0 * motion.theta)


def stop_gradients(tree: Any) -> Any:
    """Return the tree with its floats constant for differentiation."""
    float_leaves, other_leaves = eqx.partition(tree, eqx.is_inexact_array)
    return eqx.combine(lax.stop_gradient(float_leaves), other_leaves)


class ContactSlots(NamedTuple):
    """Masks of the two legs whose feet may be loaded (the contact slots), fore first.

    The mask of an empty slot is False for all legs.
    """

    first_mask: Bool[Array, "n_legs ..."]
    second_mask: Bool[Array, "n_legs ..."]

    @property
    def is_filled(self) -> Bool[Array, "n_legs ..."]:
        """Return whether each leg occupies one of the two contact slots, (n_legs, ...)."""
        return self.first_mask | self.second_mask

    def gather_codes(self, values: Array) -> Int[Array, "2 ..."]:
        """Return the entries of an integer per leg for both slots, as one array (2, ...).

        The entry of an empty slot is 0.
        """
        return jnp.stack(self.gather(values))

    def gather_flags(self, values: Array) -> Bool[Array, "2 ..."]:
        """Return the entries of a flag per leg for both slots, as one array (2, ...).

        The entry of an empty slot is False.
        """
        return self.gather_codes(values.astype(jnp.int32)) > 0

    def gather(self, values: Array) -> SlotPair:
        """Return the entries of a quantity per leg for both slots; 0 for an empty slot."""
        zeros = jnp.zeros_like(values)
        return (
            sum_over_legs(jnp.where(self.first_mask, values, zeros)),
            sum_over_legs(jnp.where(self.second_mask, values, zeros)),
        )

    def scatter(self, slot_pair: Any) -> LegArray:
        """Return a quantity per leg from that of both slots; 0 for legs in no slot.

        This is the inverse of `gather`.
        """
        return jnp.where(self.first_mask, slot_pair[0], 0.0) + jnp.where(
            self.second_mask, slot_pair[1], 0.0
        )


def find_slots(is_touching: Bool[Array, "n_legs ..."]) -> ContactSlots:
    """Return the contact slots of the first two legs whose feet touch the ground."""
    touching_rank = jnp.cumsum(is_touching.astype(jnp.int32), axis=0)
    return ContactSlots(is_touching & (touching_rank == 1), is_touching & (touching_rank == 2))


def slot_friction(
    friction: Elementwise | SlotPair, contact_slots: ContactSlots
) -> Elementwise | SlotPair:
    """Return the friction coefficient of the foot in each contact slot, or the common coefficient.

    A pair `friction` holds the coefficient of the foot that landed last, Leg 1's, and that of all
    others. A single number is the coefficient of all feet.
    """
    if not isinstance(friction, tuple):
        return friction
    last_friction, other_friction = friction
    return jnp.where(contact_slots.first_mask[0], last_friction, other_friction), other_friction


class ContactInverseInertia(NamedTuple):
    """Inverse inertia of the hub, and responses of hub and slots to the slots' forces."""

    leg_directions: LegDirections
    is_released: Bool[Array, " n_legs"]  # whether a leg is eliminated: free in length, or in a slot
    inverse_inertia: tuple[Any, ...]  # xx, xz, x theta, zz, z theta, theta theta
    sin: SlotPair
    cos: SlotPair
    L: SlotPair
    response_transverse: tuple[HubVector, HubVector]  # of the hub to a unit transverse force
    response_radial: tuple[HubVector, HubVector]  # of the hub to a unit stopper force
    G: tuple[Any, Any, Any]  # 11, 12, 22: of feet to transverse forces
    H: tuple[Any, Any, Any, Any]  # 11, 12, 21, 22: of feet to stopper forces
    K: tuple[Any, Any, Any]  # 11, 12, 22: of legs to stopper forces


def apply_inverse(inverse_inertia: tuple[Any, ...], generalized_force: HubVector) -> HubVector:
    """Return the product of the symmetric inverse inertia and a vector."""
    xx, xz, xt, zz, zt, tt = inverse_inertia
    return (
        xx * generalized_force[0] + xz * generalized_force[1] + xt * generalized_force[2],
        xz * generalized_force[0] + zz * generalized_force[1] + zt * generalized_force[2],
        xt * generalized_force[0] + zt * generalized_force[1] + tt * generalized_force[2],
    )


def _invert_inertia(
    s: Symbols, directions: LegDirections, b: LegArray, is_released: Array
) -> tuple[Any, ...]:
    """Return the inverse of the hub's 3 x 3 inertia after elimination of the released legs.

    The entries are xx, xz, x theta, zz, z theta, theta theta.
    """
    sin = jnp.where(is_released, directions.sin, 0.0)
    cos = jnp.where(is_released, directions.cos, 0.0)
    xx = s.Mt - s.m * sum_over_legs(sin * sin)
    xz = -s.m * sum_over_legs(sin * cos)
    zz = s.Mt - s.m * sum_over_legs(cos * cos)
    xt = -s.m * sum_over_legs(b * directions.cos)
    zt = s.m * sum_over_legs(b * directions.sin)
    tt = s.m * sum_over_legs(b * b)
    c_xx, c_xz, c_xt = zz * tt - zt * zt, xt * zt - xz * tt, xz * zt - zz * xt
    inverse_determinant = 1.0 / (xx * c_xx + xz * c_xz + xt * c_xt)
    return (
        c_xx * inverse_determinant,
        c_xz * inverse_determinant,
        c_xt * inverse_determinant,
        (xx * tt - xt * xt) * inverse_determinant,
        (xz * xt - xx * zt) * inverse_determinant,
        (xx * zz - xz * xz) * inverse_determinant,
    )


class Posture(NamedTuple):
    """Directions of all legs, and directions and lengths of the slots' legs."""

    leg_directions: LegDirections
    sin: SlotPair
    cos: SlotPair
    L: SlotPair


def make_posture(s: Symbols, motion: WheelMotion, contact_slots: ContactSlots) -> Posture:
    """Return the directions of all legs, and the directions and lengths of the slots' legs."""
    directions = leg_directions(s, motion.theta)
    return Posture(
        directions,
        contact_slots.gather(directions.sin),
        contact_slots.gather(directions.cos),
        contact_slots.gather(motion.L),
    )


def make_inverse_inertia(
    s: Symbols, motion: WheelMotion, contact_slots: ContactSlots, is_airborne_locked: Array
) -> ContactInverseInertia:
    """Return the responses of hub and slots to contact forces at this posture.

    - `is_airborne_locked`: whether a leg is in the air on its stopper.
    """
    directions, sin, cos, L = make_posture(s, motion, contact_slots)
    is_released = contact_slots.is_filled | ~is_airborne_locked
    inverse_inertia = _invert_inertia(s, directions, motion.L - s.a, is_released)
    e = [(cos[i], -sin[i], -L[i]) for i in range(2)]
    u = [(sin[i], cos[i], jnp.zeros_like(sin[i])) for i in range(2)]
    z = (apply_inverse(inverse_inertia, e[0]), apply_inverse(inverse_inertia, e[1]))
    y = (apply_inverse(inverse_inertia, u[0]), apply_inverse(inverse_inertia, u[1]))
    dot = lambda a, b: a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    plane_dot = lambda a, b: a[0] * b[0] + a[1] * b[1]
    return ContactInverseInertia(
        directions,
        is_released,
        inverse_inertia,
        sin,
        cos,
        L,
        response_transverse=z,
        response_radial=y,
        G=(dot(e[0], z[0]), dot(e[0], z[1]), dot(e[1], z[1])),
        H=(
            plane_dot(u[0], z[0]),
            plane_dot(u[0], z[1]),
            plane_dot(u[1], z[0]),
            plane_dot(u[1], z[1]),
        ),
        K=(plane_dot(u[0], y[0]), plane_dot(u[0], y[1]), plane_dot(u[1], y[1])),
    )


class FreeMotion(NamedTuple):
    """Motion without contact forces: accelerations, or velocities in an impact."""

    hub_vector: HubVector
    leg_motion: LegArray  # of a released leg's length, minus the part u . hub
    slot_leg_motion: SlotPair  # the same for the slots' legs
    foot_transverse_motion: SlotPair  # of the slots' feet, transverse to the leg
    foot_radial_motion: SlotPair  # of the slots' feet, along the leg


def free_leg_motion(s: Symbols, motion: WheelMotion, directions: LegDirections) -> LegArray:
    """Return the acceleration of each leg's length without contact force, m/s^2.

    The hub's acceleration along the leg is not included.
    """
    gx, gz = s.g * s.sin_phi, -s.g * s.cos_phi
    centrifugal_acceleration = (motion.L - s.a) * motion.dtheta * motion.dtheta
    spring_force = s.k * (s.Ls - motion.L) - s.c * motion.dL
    return (
        centrifugal_acceleration - (directions.sin * gx + directions.cos * gz) + spring_force / s.m
    )


def free_acceleration(
    s: Symbols, motion: WheelMotion, contact_slots: ContactSlots, inertia: ContactInverseInertia
) -> FreeMotion:
    """Return the accelerations due to gravity, springs, dampers and rotation alone.

    The slots' feet and stoppers exert no force.
    """
    sin, cos = inertia.leg_directions
    b, dtheta = motion.L - s.a, motion.dtheta
    gx, gz = s.g * s.sin_phi, -s.g * s.cos_phi
    centrifugal_acceleration, leg_acceleration = (
        b * dtheta * dtheta,
        free_leg_motion(s, motion, inertia.leg_directions),
    )
    coriolis_acceleration = 2.0 * motion.dL * dtheta
    radial_acceleration = (
        jnp.where(inertia.is_released, leg_acceleration, 0.0) - centrifugal_acceleration
    )
    force_x = s.Mt * gx + s.m * sum_over_legs(
        radial_acceleration * sin + coriolis_acceleration * cos
    )
    force_z = s.Mt * gz + s.m * sum_over_legs(
        radial_acceleration * cos - coriolis_acceleration * sin
    )
    torque = -s.m * sum_over_legs(b * (coriolis_acceleration + cos * gx - sin * gz))
    hub_acceleration = apply_inverse(inertia.inverse_inertia, (force_x, force_z, torque))
    slot_coriolis, slot_leg_acceleration = (
        contact_slots.gather(coriolis_acceleration),
        contact_slots.gather(leg_acceleration),
    )
    foot_transverse = [
        inertia.cos[i] * hub_acceleration[0]
        - inertia.sin[i] * hub_acceleration[1]
        - inertia.L[i] * hub_acceleration[2]
        - slot_coriolis[i]
        for i in range(2)
    ]
    foot_radial = [inertia.L[i] * dtheta * dtheta - slot_leg_acceleration[i] for i in range(2)]
    return FreeMotion(
        hub_acceleration,
        leg_acceleration,
        slot_leg_acceleration,
        (foot_transverse[0], foot_transverse[1]),
        (foot_radial[0], foot_radial[1]),
    )


def free_velocity(
    s: Symbols, motion: WheelMotion, contact_slots: ContactSlots, inertia: ContactInverseInertia
) -> FreeMotion:
    """Return the velocities after an impact without impulses at feet or slots' stoppers.

    An airborne leg on its stopper whose length still changes meets the stopper, inelastically.
    """
    sin, cos = inertia.leg_directions
    b, dtheta = motion.L - s.a, motion.dtheta
    hub_outward = sin * motion.vx + cos * motion.vz
    leg_velocity = jnp.where(inertia.is_released, motion.dL - hub_outward, 0.0)
    radial_velocity = leg_velocity - motion.dL
    transverse_velocity = b * dtheta
    px = s.Mt * motion.vx + s.m * sum_over_legs(radial_velocity * sin - transverse_velocity * cos)
    pz = s.Mt * motion.vz + s.m * sum_over_legs(radial_velocity * cos + transverse_velocity * sin)
    angular_momentum = -s.m * sum_over_legs(
        b * (cos * motion.vx - sin * motion.vz - transverse_velocity)
    )
    hub_velocity = apply_inverse(inertia.inverse_inertia, (px, pz, angular_momentum))
    slot_leg_velocity = contact_slots.gather(leg_velocity)
    foot_transverse = [
        inertia.cos[i] * hub_velocity[0]
        - inertia.sin[i] * hub_velocity[1]
        - inertia.L[i] * hub_velocity[2]
        for i in range(2)
    ]
    return FreeMotion(
        hub_velocity,
        leg_velocity,
        slot_leg_velocity,
        (foot_transverse[0], foot_transverse[1]),
        (-slot_leg_velocity[0], -slot_leg_velocity[1]),
    )


class FootVelocity(NamedTuple):
    """Velocity of the slots' feet along the slope and normal to the slope, m/s."""

    x: SlotPair
    z: SlotPair


def foot_velocity(
    motion: WheelMotion, contact_slots: ContactSlots, posture: ContactInverseInertia | Posture
) -> FootVelocity:
    """Return the velocity of the slots' feet along the slope and normal to the slope, m/s."""
    dL = contact_slots.gather(motion.dL)
    x = [
        motion.vx - dL[i] * posture.sin[i] - posture.L[i] * motion.dtheta * posture.cos[i]
        for i in range(2)
    ]
    z = [
        motion.vz - dL[i] * posture.cos[i] + posture.L[i] * motion.dtheta * posture.sin[i]
        for i in range(2)
    ]
    return FootVelocity((x[0], x[1]), (z[0], z[1]))


def foot_heights(
    motion: WheelMotion, directions: LegDirections, tilt: Elementwise | None = None
) -> LegArray:
    """Return the height of every foot above the slope, m.

    - `tilt`: angle by which the next line is steeper, rad. The height of the foremost foot is then
      that above the next line, which begins under the foot of Leg 1.
    """
    heights = motion.z - motion.L * directions.cos
    if tilt is None:
        return heights
    downhill_positions = foot_positions(motion, directions)
    foremost_distance = downhill_positions[-1] - downhill_positions[0]
    foremost_height = heights[-1] * jnp.cos(tilt) + foremost_distance * jnp.sin(tilt)
    return jnp.concatenate([heights[:-1], foremost_height[None]])


def foot_speeds(motion: WheelMotion, directions: LegDirections) -> tuple[LegArray, LegArray]:
    """Return the velocity of every foot along the slope and normal to the slope, m/s."""
    transverse_velocity = motion.L * motion.dtheta
    tangential_speed = motion.vx - motion.dL * directions.sin - transverse_velocity * directions.cos
    return (
        tangential_speed,
        motion.vz - motion.dL * directions.cos + transverse_velocity * directions.sin,
    )


def foot_positions(motion: WheelMotion, directions: LegDirections) -> LegArray:
    """Return the downhill position of every foot, m."""
    return motion.x - motion.L * directions.sin


def landing_position(n: int, motion: WheelMotion) -> Elementwise:
    """Return the downhill position of the foremost of `n` feet, m."""
    foremost_angle = motion.theta + (n - 1) * 2.0 * math.pi / n
    return motion.x - motion.L[n - 1] * jnp.sin(foremost_angle)


def kinetic_energy(s: Symbols, motion: WheelMotion) -> Elementwise:
    """Return the kinetic energy of the hub and all leg masses, J."""
    directions = leg_directions(s, motion.theta)
    transverse_velocity = (motion.L - s.a) * motion.dtheta
    x = motion.vx - motion.dL * directions.sin - transverse_velocity * directions.cos
    z = motion.vz - motion.dL * directions.cos + transverse_velocity * directions.sin
    hub_mass = s.Mt - s.n * s.m
    return 0.5 * (hub_mass * (motion.vx**2 + motion.vz**2) + s.m * sum_over_legs(x * x + z * z))


def potential_energy(s: Symbols, motion: WheelMotion) -> SlotPair:
    """Return the gravitational energy relative to the origin, and the elastic energy of all
    springs, J.
    """
    directions = leg_directions(s, motion.theta)
    x = s.Mt * motion.x - s.m * sum_over_legs((motion.L - s.a) * directions.sin)
    z = s.Mt * motion.z - s.m * sum_over_legs((motion.L - s.a) * directions.cos)
    elastic_energy = 0.5 * s.k * sum_over_legs((motion.L - s.Ls) ** 2)
    return s.g * (z * s.cos_phi - x * s.sin_phi), elastic_energy
