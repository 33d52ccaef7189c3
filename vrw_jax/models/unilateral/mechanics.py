"""Mechanics of the free wheel: hub and legs as coordinates, and the response to contact forces.

The coordinates are the hub (x, z), the angle theta of Leg 1 and the n leg lengths. A leg couples
with the hub alone, so the mass matrix is an arrow. Eliminating the legs of free length leaves a 3 x
3 system. Up to two *slots* hold the legs whose feet may be loaded. A foot's force acts in the leg's
own directions u (foot to hub) and e = du/dtheta, and only its e part reaches the hub. The same
equations serve accelerations and, with momenta in place of forces, impacts. Everything works
elementwise over a batch, on one more axis behind that of the legs.
"""

import math
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from vrw_jax.numerics import Elementwise, Scalar, sine_cosine
from vrw_jax.wheel import Symbols

Legs = Float[Array, "n_legs ..."]
"""One quantity of every leg."""
Vector3 = tuple[Any, Any, Any]
"""Components along hub x, hub z and theta."""
Pair = tuple[Any, Any]
"""One quantity of each slot."""


class WheelMotion(NamedTuple):
    """Posture and rates of the free wheel in the slope's frame."""

    x: Scalar  # of the hub, m, downhill
    z: Scalar  # of the hub above the slope, m
    theta: Scalar  # of Leg 1, rad
    vx: Scalar  # of the hub, m/s
    vz: Scalar
    dtheta: Scalar  # rad/s
    L: Legs  # m
    dL: Legs  # m/s


class Legwise(NamedTuple):
    """Directions of all legs, u = (sin, cos) and e = (cos, -sin)."""

    sin: Legs
    cos: Legs


def directions(s: Symbols, theta: Elementwise) -> Legwise:
    """Return the directions of all legs, for any number of turns of the wheel."""
    turn = (s.alpha * np.arange(s.n)).reshape(-1, *(1,) * jnp.ndim(theta))
    halves = lax.stop_gradient(jnp.floor(theta / math.pi + 0.5))
    odd = halves - 2.0 * jnp.floor(0.5 * halves)
    sin, cos = (x - 2.0 * odd * x for x in sine_cosine(theta - math.pi * halves))
    sin_turn, cos_turn = np.sin(turn), np.cos(turn)
    return Legwise(sin * cos_turn + cos * sin_turn, cos * cos_turn - sin * sin_turn)


def over_legs(values: Array) -> Array:
    """Return the sum over the legs, the first axis."""
    return jnp.sum(values, axis=0)


def kept(tree: Any, one: Array) -> Any:
    """Return the same numbers, each divided by a `unit` that equals 1 but is known only at run
    time.

    XLA's fusions on a CPU repeat chains of cheap operations for each use, which multiplies their
    number by a hundred here. A division is computed only once.
    """
    floats = lambda x: jnp.issubdtype(jnp.result_type(x), jnp.floating)
    return jax.tree.map(lambda x: x / one if floats(x) else x, tree)


def one_of(motion: "WheelMotion") -> Array:
    """Return 1 in a form that no compiler can simplify."""
    return lax.stop_gradient(1.0 + 0.0 * motion.theta)


def stilled(tree: Any) -> Any:
    """Return the same tree without its derivatives."""
    moving, rest = eqx.partition(tree, eqx.is_inexact_array)
    return eqx.combine(lax.stop_gradient(moving), rest)


class Slots(NamedTuple):
    """The two legs whose feet may be loaded, fore first; an empty slot holds no leg."""

    first: Bool[Array, "n_legs ..."]
    second: Bool[Array, "n_legs ..."]

    @property
    def filled(self) -> Bool[Array, "n_legs ..."]:
        """Whether a leg is in a slot."""
        return self.first | self.second

    def codes(self, values: Array) -> Int[Array, "2 ..."]:
        """Return the slots' entries of an integer per leg, as one array."""
        return jnp.stack(self.of(values))

    def flags(self, values: Array) -> Bool[Array, "2 ..."]:
        """Return the slots' entries of a flag per leg; False for an empty slot."""
        return self.codes(values.astype(jnp.int32)) > 0

    def of(self, values: Array) -> Pair:
        """Return the slots' entries of a quantity per leg; 0 for an empty slot."""
        zero = jnp.zeros_like(values)
        return (
            over_legs(jnp.where(self.first, values, zero)),
            over_legs(jnp.where(self.second, values, zero)),
        )

    def spread(self, pair: Any) -> Legs:
        """Return the quantity per leg, zero for legs in no slot: the inverse of `gather`."""
        return jnp.where(self.first, pair[0], 0.0) + jnp.where(self.second, pair[1], 0.0)


def slots_of(touching: Bool[Array, "n_legs ..."]) -> Slots:
    """Return the slots of the first two touching legs."""
    rank = jnp.cumsum(touching.astype(jnp.int32), axis=0)
    return Slots(touching & (rank == 1), touching & (rank == 2))


def of_slots(friction: Elementwise | Pair, slots: Slots) -> Elementwise | Pair:
    """Return the friction of each slot's foot.

    A pair holds the friction of the foot that landed last, Leg 1's, and that of all others; a
    single number is the friction of all feet.
    """
    if not isinstance(friction, tuple):
        return friction
    last, others = friction
    return jnp.where(slots.first[0], last, others), others


class Hub(NamedTuple):
    """Inverse inertia at the slots' forces, and their mutual responses."""

    legs: Legwise
    released: Bool[Array, " n_legs"]  # legs eliminated: free in length, or in a slot
    inverse: tuple[Any, ...]  # xx, xz, x theta, zz, z theta, theta theta
    sin: Pair
    cos: Pair
    L: Pair
    along_e: tuple[Vector3, Vector3]  # hub's response to a unit force along e of each foot
    along_u: tuple[Vector3, Vector3]  # to a unit pull of each stopper
    G: tuple[Any, Any, Any]  # 11, 12, 22: e to e
    H: tuple[Any, Any, Any, Any]  # 11, 12, 21, 22: stopper to e
    K: tuple[Any, Any, Any]  # 11, 12, 22: stopper to stopper


def times(inverse: tuple[Any, ...], f: Vector3) -> Vector3:
    """Return the product of the symmetric inverse inertia and a vector."""
    xx, xz, xt, zz, zt, tt = inverse
    return (
        xx * f[0] + xz * f[1] + xt * f[2],
        xz * f[0] + zz * f[1] + zt * f[2],
        xt * f[0] + zt * f[1] + tt * f[2],
    )


def _inverse_inertia(s: Symbols, legs: Legwise, b: Legs, released: Array) -> tuple[Any, ...]:
    """Return the inverse of the 3 x 3 inertia that is left after the elimination of the released
    legs.
    """
    sin = jnp.where(released, legs.sin, 0.0)
    cos = jnp.where(released, legs.cos, 0.0)
    xx = s.Mt - s.m * over_legs(sin * sin)
    xz = -s.m * over_legs(sin * cos)
    zz = s.Mt - s.m * over_legs(cos * cos)
    xt = -s.m * over_legs(b * legs.cos)
    zt = s.m * over_legs(b * legs.sin)
    tt = s.m * over_legs(b * b)
    c_xx, c_xz, c_xt = zz * tt - zt * zt, xt * zt - xz * tt, xz * zt - zz * xt
    scale = 1.0 / (xx * c_xx + xz * c_xz + xt * c_xt)
    return (
        c_xx * scale,
        c_xz * scale,
        c_xt * scale,
        (xx * tt - xt * xt) * scale,
        (xz * xt - xx * zt) * scale,
        (xx * zz - xz * xz) * scale,
    )


class Posture(NamedTuple):
    """Directions of all legs, and directions and lengths of the slots' legs."""

    legs: Legwise
    sin: Pair
    cos: Pair
    L: Pair


def posture_of(s: Symbols, motion: WheelMotion, slots: Slots) -> Posture:
    """Return the directions of all legs, and the slots' directions and lengths."""
    legs = directions(s, motion.theta)
    return Posture(legs, slots.of(legs.sin), slots.of(legs.cos), slots.of(motion.L))


def hub_of(s: Symbols, motion: WheelMotion, slots: Slots, locked: Array) -> Hub:
    """Return the response of hub and slots to forces at this posture.

    - `airborne`: legs in the air on their stoppers.
    """
    legs, sin, cos, L = posture_of(s, motion, slots)
    released = slots.filled | ~locked
    inverse = _inverse_inertia(s, legs, motion.L - s.a, released)
    e = [(cos[i], -sin[i], -L[i]) for i in range(2)]
    u = [(sin[i], cos[i], jnp.zeros_like(sin[i])) for i in range(2)]
    z = (times(inverse, e[0]), times(inverse, e[1]))
    y = (times(inverse, u[0]), times(inverse, u[1]))
    dot = lambda a, b: a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    plane = lambda a, b: a[0] * b[0] + a[1] * b[1]
    return Hub(
        legs,
        released,
        inverse,
        sin,
        cos,
        L,
        along_e=z,
        along_u=y,
        G=(dot(e[0], z[0]), dot(e[0], z[1]), dot(e[1], z[1])),
        H=(plane(u[0], z[0]), plane(u[0], z[1]), plane(u[1], z[0]), plane(u[1], z[1])),
        K=(plane(u[0], y[0]), plane(u[0], y[1]), plane(u[1], y[1])),
    )


class Free(NamedTuple):
    """Motion without the slots' forces: accelerations, or velocities in an impact."""

    hub: Vector3
    legs: Legs  # of a released leg's length, minus the hub's share u . hub
    own: Pair  # the same for the slots' legs
    e: Pair  # of the slots' feet along e
    u: Pair  # along u


def free_legs(s: Symbols, motion: WheelMotion, legs: Legwise) -> Legs:
    """Return the acceleration of a leg's length without a holding force, minus the hub's share,
    m/s^2.
    """
    gx, gz = s.g * s.sin_phi, -s.g * s.cos_phi
    spin = (motion.L - s.a) * motion.dtheta * motion.dtheta
    spring = s.k * (s.Ls - motion.L) - s.c * motion.dL
    return spin - (legs.sin * gx + legs.cos * gz) + spring / s.m


def free_acceleration(s: Symbols, motion: WheelMotion, slots: Slots, hub: Hub) -> Free:
    """Return the accelerations by gravity, springs, dampers and rotation alone.

    The slots' feet and stoppers exert no force.
    """
    sin, cos = hub.legs
    b, dtheta = motion.L - s.a, motion.dtheta
    gx, gz = s.g * s.sin_phi, -s.g * s.cos_phi
    spin, legs = b * dtheta * dtheta, free_legs(s, motion, hub.legs)
    coriolis = 2.0 * motion.dL * dtheta
    radial = jnp.where(hub.released, legs, 0.0) - spin
    force_x = s.Mt * gx + s.m * over_legs(radial * sin + coriolis * cos)
    force_z = s.Mt * gz + s.m * over_legs(radial * cos - coriolis * sin)
    torque = -s.m * over_legs(b * (coriolis + cos * gx - sin * gz))
    at_hub = times(hub.inverse, (force_x, force_z, torque))
    across, own = slots.of(coriolis), slots.of(legs)
    e = [
        hub.cos[i] * at_hub[0] - hub.sin[i] * at_hub[1] - hub.L[i] * at_hub[2] - across[i]
        for i in range(2)
    ]
    u = [hub.L[i] * dtheta * dtheta - own[i] for i in range(2)]
    return Free(at_hub, legs, own, (e[0], e[1]), (u[0], u[1]))


def free_velocity(s: Symbols, motion: WheelMotion, slots: Slots, hub: Hub) -> Free:
    """Return the velocities by the wheel's momentum alone, with no impulse at feet or slots'
    stoppers.

    An airborne leg on its stopper whose length still changes meets the stopper, inelastically.
    """
    sin, cos = hub.legs
    b, dtheta = motion.L - s.a, motion.dtheta
    along = sin * motion.vx + cos * motion.vz
    legs = jnp.where(hub.released, motion.dL - along, 0.0)
    radial = legs - motion.dL
    across = b * dtheta
    px = s.Mt * motion.vx + s.m * over_legs(radial * sin - across * cos)
    pz = s.Mt * motion.vz + s.m * over_legs(radial * cos + across * sin)
    turning = -s.m * over_legs(b * (cos * motion.vx - sin * motion.vz - across))
    at_hub = times(hub.inverse, (px, pz, turning))
    own = slots.of(legs)
    e = [hub.cos[i] * at_hub[0] - hub.sin[i] * at_hub[1] - hub.L[i] * at_hub[2] for i in range(2)]
    return Free(at_hub, legs, own, (e[0], e[1]), (-own[0], -own[1]))


class FootVelocity(NamedTuple):
    """Velocity of the slots' feet, m/s."""

    x: Pair
    z: Pair


def foot_velocity(motion: WheelMotion, slots: Slots, hub: Hub | Posture) -> FootVelocity:
    """Return the velocity of the slots' feet along the slope and normal to it."""
    dL = slots.of(motion.dL)
    x = [motion.vx - dL[i] * hub.sin[i] - hub.L[i] * motion.dtheta * hub.cos[i] for i in range(2)]
    z = [motion.vz - dL[i] * hub.cos[i] + hub.L[i] * motion.dtheta * hub.sin[i] for i in range(2)]
    return FootVelocity((x[0], x[1]), (z[0], z[1]))


def foot_heights(motion: WheelMotion, legs: Legwise) -> Legs:
    """Return the height of every foot above the slope, m."""
    return motion.z - motion.L * legs.cos


def foot_speeds(motion: WheelMotion, legs: Legwise) -> tuple[Legs, Legs]:
    """Return the velocity of every foot along the slope and normal to it, m/s."""
    turn = motion.L * motion.dtheta
    along = motion.vx - motion.dL * legs.sin - turn * legs.cos
    return along, motion.vz - motion.dL * legs.cos + turn * legs.sin


def foot_places(motion: WheelMotion, legs: Legwise) -> Legs:
    """Return the downhill position of every foot, m."""
    return motion.x - motion.L * legs.sin


def place_of_landing(n: int, motion: WheelMotion) -> Elementwise:
    """Return the downhill position of the foremost of `n` feet, m."""
    turned = motion.theta + (n - 1) * 2.0 * math.pi / n
    return motion.x - motion.L[n - 1] * jnp.sin(turned)


def kinetic_energy(s: Symbols, motion: WheelMotion) -> Elementwise:
    """Return the kinetic energy of the hub and all leg masses, J."""
    legs = directions(s, motion.theta)
    across = (motion.L - s.a) * motion.dtheta
    x = motion.vx - motion.dL * legs.sin - across * legs.cos
    z = motion.vz - motion.dL * legs.cos + across * legs.sin
    hub_mass = s.Mt - s.n * s.m
    return 0.5 * (hub_mass * (motion.vx**2 + motion.vz**2) + s.m * over_legs(x * x + z * z))


def potential_energy(s: Symbols, motion: WheelMotion) -> Pair:
    """Return the gravitational energy from the slope's origin and the elastic energy of all
    springs, J.
    """
    legs = directions(s, motion.theta)
    x = s.Mt * motion.x - s.m * over_legs((motion.L - s.a) * legs.sin)
    z = s.Mt * motion.z - s.m * over_legs((motion.L - s.a) * legs.cos)
    elastic = 0.5 * s.k * over_legs((motion.L - s.Ls) ** 2)
    return s.g * (z * s.cos_phi - x * s.sin_phi), elastic
