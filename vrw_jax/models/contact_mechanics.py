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
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Shaped

from vrw_jax.base.elementwise import Elementwise, Scalar, compute_sine_cosine
from vrw_jax.wheel.laws import (
    compute_leg_potential,
    evaluate_hub_torque,
    evaluate_leg_force,
    number_legs,
)
from vrw_jax.wheel.params import Symbols
from vrw_jax.wheel.transitions import GroundAhead

LegArray = Float[Array, "n_legs ..."]
"""Array with one entry per leg on the first axis."""
HubVector = tuple[Any, Any, Any]
"""Components of a generalized vector for the coordinates hub x, hub z and theta."""
SlotArray = Float[Array, "2 ..."]
"""Array with one entry for the leg in each of the two contact slots on the first axis."""


Friction = Elementwise | tuple[Any, Any]
"""Friction coefficient for all feet, or a pair for the foot that landed last and all other feet."""


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


def unpack_motion(q: Array, v: Array) -> WheelMotion:
    """Return the motion with the coordinates `q` (hub x, hub z, theta, leg lengths) and rates `v`.

    The first axis of `v` may have further entries.
    """
    (x, z, theta), (vx, vz, dtheta) = q[:3], v[:3]
    return WheelMotion(x, z, theta, vx, vz, dtheta, q[3:], v[3 : len(q)])


def pack_motion(motion: WheelMotion) -> tuple[Array, Array]:
    """Return the coordinates of a motion and their rates, which inverts `unpack_motion`."""
    return jnp.concatenate([jnp.stack(motion[:3]), motion.L]), jnp.concatenate(
        [jnp.stack(motion[3:6]), motion.dL]
    )


class LegDirections(NamedTuple):
    """Directions of all legs: radial u = (sin, cos) and transverse e = (cos, -sin)."""

    sin: LegArray
    cos: LegArray


def compute_leg_directions(s: Symbols, theta: Elementwise) -> LegDirections:
    """Return the directions of all legs for the angle `theta` (rad) of Leg 1.

    The angle may include any number of turns.
    """
    leg_angles = align_with_batch(s.alpha * np.arange(s.n), theta)
    n_half_turns = lax.stop_gradient(jnp.floor(theta / math.pi + 0.5))
    is_half_turn_odd = n_half_turns - 2.0 * jnp.floor(0.5 * n_half_turns)
    sin, cos = (
        x - 2.0 * is_half_turn_odd * x for x in compute_sine_cosine(theta - math.pi * n_half_turns)
    )
    sin_leg, cos_leg = np.sin(leg_angles), np.cos(leg_angles)
    return LegDirections(sin * cos_leg + cos * sin_leg, cos * cos_leg - sin * sin_leg)


def align_with_batch(values: ArrayLike, batch_template: ArrayLike) -> np.ndarray:
    """Return values with further axes of length 1, which broadcast over a batch.

    - `batch_template`: array whose axes are those of the batch.
    """
    return np.reshape(values, (*np.shape(values), *(1,) * jnp.ndim(batch_template)))


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


def make_opaque_one(batch_template: Array) -> Array:
    """Return an array of ones with the shape of `batch_template` that no compiler can simplify."""
    return lax.stop_gradient(1.0 + 0.0 * batch_template)


def stop_gradients(tree: Any) -> Any:
    """Return the tree with its float arrays excluded from differentiation."""
    float_leaves, nonfloat_leaves = eqx.partition(tree, eqx.is_inexact_array)
    return eqx.combine(lax.stop_gradient(float_leaves), nonfloat_leaves)


class ContactSlots(NamedTuple):
    """Masks of the legs in the two contact slots, fore leg first.

    The feet of these legs may be loaded. The mask of an empty slot is False for all legs.
    """

    slot_masks: Bool[Array, "2 n_legs ..."]

    @property
    def is_in_slot(self) -> Bool[Array, "n_legs ..."]:
        """Return whether each leg is in one of the two contact slots, shape (n_legs, ...)."""
        return self.slot_masks[0] | self.slot_masks[1]

    def gather_from_legs(self, leg_quantities: Array) -> Shaped[Array, "2 ..."]:
        """Return the entries of `leg_quantities` for the legs in both contact slots.

        The result for an empty slot is 0.
        """
        return jnp.sum(self.slot_masks.astype(leg_quantities.dtype) * leg_quantities, axis=1)

    def gather_flags_from_legs(self, leg_flags: Array) -> Bool[Array, "2 ..."]:
        """Return the flags of the legs in both contact slots; False for an empty slot."""
        return jnp.any(self.slot_masks & leg_flags, axis=1)

    def scatter_to_legs(self, slot_quantities: Shaped[Array, "2 ..."]) -> LegArray:
        """Return an array over all legs with the entries of `slot_quantities` at legs in contact.

        Other legs have the entry 0. The function is the inverse of `gather_from_legs`.
        """
        slot_weights = self.slot_masks.astype(jnp.result_type(slot_quantities, 0.0))
        return jnp.sum(slot_weights * slot_quantities[:, None], axis=0)


def find_contact_slots(is_foot_touching: Bool[Array, "n_legs ..."]) -> ContactSlots:
    """Return contact slots with the first two legs whose feet touch the ground."""
    touching_leg_rank = jnp.cumsum(is_foot_touching.astype(jnp.int32), axis=0)
    return ContactSlots(
        jnp.stack([is_foot_touching & (touching_leg_rank == rank) for rank in (1, 2)])
    )


def select_slot_friction(friction: Friction | float, contact_slots: ContactSlots) -> SlotArray:
    """Return the friction coefficient for the foot in each contact slot.

    In a pair, the first coefficient applies to the foot of Leg 1, which landed last.
    """
    last_landed_friction, other_friction = (
        friction if isinstance(friction, tuple) else (friction, friction)
    )
    return jnp.where(contact_slots.slot_masks[:, 0], last_landed_friction, other_friction)


class ContactInverseInertia(NamedTuple):
    """Inverse inertia of the hub, and responses of hub, feet and legs to contact forces.

    In a matrix, the first index is the slot of the response, and the second that of the force.
    """

    leg_directions: LegDirections
    # whether a leg is eliminated: free in length, or in a contact slot
    is_leg_released: Bool[Array, " n_legs"]
    inverse_inertia: tuple[Any, ...]  # entries xx, xz, x theta, zz, z theta, theta theta
    sin: SlotArray
    cos: SlotArray
    L: SlotArray
    hub_response_transverse: (
        HubVector  # response of the hub to unit transverse forces, `SlotArray`s
    )
    hub_response_radial: HubVector  # response of the hub to unit stopper forces, `SlotArray`s
    G: Float[Array, "2 2 ..."]  # response of the feet to transverse forces, symmetric
    H: Float[Array, "2 2 ..."]  # response of the legs to transverse forces
    K: Float[Array, "2 2 ..."]  # response of the legs to stopper forces, symmetric

    def compute_transverse_foot_motion(self, hub_motion: HubVector) -> SlotArray:
        """Return the part of the feet's motion transverse to the legs that is due to the hub."""
        return self.cos * hub_motion[0] - self.sin * hub_motion[1] - self.L * hub_motion[2]


def multiply_by_inverse_inertia(
    inverse_inertia: tuple[Any, ...], generalized_force: HubVector
) -> HubVector:
    """Return the product of the symmetric inverse inertia matrix and a generalized force."""
    inverse_xx, inverse_xz, inverse_xt, inverse_zz, inverse_zt, inverse_tt = inverse_inertia
    force_x, force_z, torque = generalized_force
    return (
        inverse_xx * force_x + inverse_xz * force_z + inverse_xt * torque,
        inverse_xz * force_x + inverse_zz * force_z + inverse_zt * torque,
        inverse_xt * force_x + inverse_zt * force_z + inverse_tt * torque,
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


def _make_exactly_symmetric(matrix: Array) -> Array:
    """Return a 2 x 2 matrix with its lower entry replaced by the upper one."""
    return jnp.stack([matrix[0], matrix[:, 1]])


def make_inverse_inertia(
    s: Symbols, motion: WheelMotion, contact_slots: ContactSlots, is_airborne_leg_locked: Array
) -> ContactInverseInertia:
    """Return the inverse inertia of the hub and the responses to contact forces for a posture.

    - `is_airborne_leg_locked`: whether a leg is in the air on its stopper.
    """
    leg_directions = compute_leg_directions(s, motion.theta)
    sin, cos, L = map(contact_slots.gather_from_legs, (*leg_directions, motion.L))
    is_leg_released = contact_slots.is_in_slot | ~is_airborne_leg_locked
    inverse_inertia = _invert_inertia(s, leg_directions, motion.L - s.a, is_leg_released)
    e, u = (cos, -sin, -L), (sin, cos, jnp.zeros_like(sin))
    z, y = (multiply_by_inverse_inertia(inverse_inertia, direction) for direction in (e, u))
    multiply_plane_vectors = lambda a, b: a[0][:, None] * b[0] + a[1][:, None] * b[1]
    return ContactInverseInertia(
        leg_directions,
        is_leg_released,
        inverse_inertia,
        sin,
        cos,
        L,
        hub_response_transverse=z,
        hub_response_radial=y,
        G=_make_exactly_symmetric(multiply_plane_vectors(e, z) + e[2][:, None] * z[2]),
        H=multiply_plane_vectors(u, z),
        K=_make_exactly_symmetric(multiply_plane_vectors(u, y)),
    )


class FreeMotion(NamedTuple):
    """Accelerations without contact forces, or velocities after an impact without impulses."""

    hub_motion: HubVector
    leg_motion: LegArray  # motion of each released leg's length, minus the part u . hub
    slot_leg_motion: SlotArray  # the same for the legs in the contact slots
    foot_transverse_motion: SlotArray  # motion of the feet in contact, transverse to the leg
    foot_radial_motion: SlotArray  # motion of the feet in contact, along the leg


def compute_free_leg_acceleration(
    s: Symbols, motion: WheelMotion, leg_directions: LegDirections
) -> LegArray:
    """Return the acceleration of each leg's length without contact forces, m/s^2.

    The acceleration of the hub in the direction of the leg is not included.
    """
    gravity_x, gravity_z = s.g * s.sin_phi, -s.g * s.cos_phi
    centrifugal_acceleration = (motion.L - s.a) * motion.dtheta * motion.dtheta
    spring_force = evaluate_leg_force(s, motion.L, motion.dL, number_legs(motion.L))
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
    """Return the accelerations due to gravity, springs, dampers, motor and rotation alone.

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
    if s.hub_torque is not None:
        hub_torque = hub_torque + evaluate_hub_torque(s, dtheta)
    hub_acceleration = multiply_by_inverse_inertia(
        inverse_inertia.inverse_inertia, (hub_force_x, hub_force_z, hub_torque)
    )
    slot_leg_acceleration = contact_slots.gather_from_legs(leg_acceleration)
    return FreeMotion(
        hub_acceleration,
        leg_acceleration,
        slot_leg_acceleration,
        inverse_inertia.compute_transverse_foot_motion(hub_acceleration)
        - contact_slots.gather_from_legs(coriolis_acceleration),
        inverse_inertia.L * dtheta * dtheta - slot_leg_acceleration,
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
    slot_leg_velocity = contact_slots.gather_from_legs(leg_velocity)
    return FreeMotion(
        hub_velocity,
        leg_velocity,
        slot_leg_velocity,
        inverse_inertia.compute_transverse_foot_motion(hub_velocity),
        -slot_leg_velocity,
    )


def compute_foot_heights(
    motion: WheelMotion, leg_directions: LegDirections, ground_ahead: GroundAhead | None = None
) -> LegArray:
    """Return the height of every foot above the slope, m.

    - `ground_ahead`: uneven ground. The height of the foremost foot is measured from the place
      where it lands.
    """
    foot_heights = motion.z - motion.L * leg_directions.cos
    if ground_ahead is None:
        return foot_heights
    downhill_positions = compute_foot_positions(motion, leg_directions)
    foremost_distance = downhill_positions[-1] - downhill_positions[0]
    foremost_foot_height = foot_heights[-1] * jnp.cos(
        ground_ahead.tilt
    ) + foremost_distance * jnp.sin(ground_ahead.tilt)
    if ground_ahead.rise is not None:
        foremost_foot_height = foremost_foot_height - ground_ahead.rise
    return jnp.concatenate([foot_heights[:-1], foremost_foot_height[None]])


class PlaneVelocities(NamedTuple):
    """Velocities of several points, tangential and normal to the slope, m/s."""

    along_slope: Array
    normal_to_slope: Array


def _compute_point_velocities(
    motion: WheelMotion,
    leg_directions: LegDirections,
    distances_from_hub: Array,
    distance_rates: Array,
) -> PlaneVelocities:
    sin, cos = leg_directions
    transverse_velocity = distances_from_hub * motion.dtheta
    return PlaneVelocities(
        motion.vx - distance_rates * sin - transverse_velocity * cos,
        motion.vz - distance_rates * cos + transverse_velocity * sin,
    )


def compute_foot_velocities(motion: WheelMotion, leg_directions: LegDirections) -> PlaneVelocities:
    """Return the velocity of every foot."""
    return _compute_point_velocities(motion, leg_directions, motion.L, motion.dL)


def compute_contact_foot_velocities(
    motion: WheelMotion, leg_directions: LegDirections, contact_slots: ContactSlots
) -> PlaneVelocities:
    """Return the velocities of the feet in the contact slots."""
    sin, cos, L, dL = map(contact_slots.gather_from_legs, (*leg_directions, motion.L, motion.dL))
    return _compute_point_velocities(motion, LegDirections(sin, cos), L, dL)


def compute_foot_positions(motion: WheelMotion, leg_directions: LegDirections) -> LegArray:
    """Return the downhill position of every foot, m."""
    return motion.x - motion.L * leg_directions.sin


def compute_landing_position(motion: WheelMotion) -> Elementwise:
    """Return the downhill position of the foremost foot, m."""
    n_legs = len(motion.L)
    foremost_angle = motion.theta + (n_legs - 1) * 2.0 * math.pi / n_legs
    return motion.x - motion.L[-1] * jnp.sin(foremost_angle)


def compute_kinetic_energy(s: Symbols, motion: WheelMotion) -> Elementwise:
    """Return the kinetic energy of the hub and all leg masses, J."""
    leg_directions = compute_leg_directions(s, motion.theta)
    x, z = _compute_point_velocities(motion, leg_directions, motion.L - s.a, motion.dL)
    hub_mass = s.Mt - s.n * s.m
    return 0.5 * (hub_mass * (motion.vx**2 + motion.vz**2) + s.m * sum_over_legs(x * x + z * z))


def find_rebound_fraction(
    s: Symbols, motion: WheelMotion, inelastic_motion: WheelMotion, newton_motion: WheelMotion
) -> tuple[Array, Array]:
    """Return whether Newton's rebound adds energy, and the largest fraction of it that adds none.

    With Coulomb friction, Newton's law of restitution can increase the energy (Kane 1984). The
    inelastic impact never increases the energy. On the straight line from the inelastic impact to
    Newton's impact, the energy is a quadratic function.

    - `motion`: motion before the impact.
    """
    midpoint_motion = jax.tree.map(lambda a, b: 0.5 * (a + b), inelastic_motion, newton_motion)
    energy, energy_inelastic, energy_newton, energy_midpoint = (
        compute_kinetic_energy(s, x)
        for x in (motion, inelastic_motion, newton_motion, midpoint_motion)
    )
    curvature = 2.0 * (energy_inelastic - 2.0 * energy_midpoint + energy_newton)
    linear_term = 4.0 * energy_midpoint - 3.0 * energy_inelastic - energy_newton
    allowed_gain = jnp.maximum(energy - energy_inelastic, 0.0)
    has_energy_gain = energy_newton > energy
    sqrt_discriminant = jnp.sqrt(
        jnp.where(
            has_energy_gain,
            linear_term * linear_term + 4.0 * curvature * allowed_gain,
            1.0,
        )
    )
    divisor = jnp.where(has_energy_gain, linear_term + sqrt_discriminant, 1.0)
    return has_energy_gain, jnp.where(has_energy_gain, 2.0 * allowed_gain / divisor, 1.0)


def compute_potential_energy(s: Symbols, motion: WheelMotion) -> tuple[Elementwise, Elementwise]:
    """Return the gravitational energy and the elastic energy of all springs, J.

    The gravitational energy is relative to the origin.
    """
    leg_directions = compute_leg_directions(s, motion.theta)
    x = s.Mt * motion.x - s.m * sum_over_legs((motion.L - s.a) * leg_directions.sin)
    z = s.Mt * motion.z - s.m * sum_over_legs((motion.L - s.a) * leg_directions.cos)
    if s.leg_force is None:
        elastic_energy = 0.5 * s.k * sum_over_legs((motion.L - s.Ls) ** 2)
    else:
        elastic_energy = sum_over_legs(compute_leg_potential(s, motion.L, number_legs(motion.L)))
    return s.g * (z * s.cos_phi - x * s.sin_phi), elastic_energy
