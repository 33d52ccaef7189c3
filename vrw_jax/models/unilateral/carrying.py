"""Forces or impulses of a contact configuration, and their derivatives.

The equations are linear in accelerations and forces, or in impulses and the velocities after an
impact. So the tangents of these solve the same equations with the tangent of the residual on the
right-hand side. Only that residual is differentiated.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from vrw_jax.models.unilateral.contacts import SLIP_DOWN, SLIP_UP, Roughness, answer, rough_of
from vrw_jax.models.unilateral.mechanics import (
    Free,
    Hub,
    Legs,
    Pair,
    Slots,
    Vector3,
    WheelMotion,
    free_acceleration,
    free_velocity,
    hub_of,
    kept,
    one_of,
    over_legs,
    times,
)
from vrw_jax.wheel import Symbols


class Stand(NamedTuple):
    """A wheel with known contact modes and stopper states."""

    s: Symbols
    motion: WheelMotion
    friction: Roughness  # of the slots' feet
    slots: Slots
    contact: Array  # of the slots
    held: Array  # the slots' legs on their stoppers
    airborne: Array  # other legs on their stoppers

    @property
    def stays(self) -> Array:
        """Whether the length of a leg is fixed."""
        return self.airborne | (self.slots.spread(self.held) > 0)


class Carried(NamedTuple):
    """Forces of ground and slots' stoppers and the hub's motion: see `contacts.ContactSolution`."""

    tangential: Pair
    normal: Pair
    stopper: Pair
    pull: Pair
    hub: Vector3
    regular: Array
    lengths: Legs  # accelerations of the legs' lengths, or rates after an impact


def sliding(contact: Array) -> Pair:
    """Return 1 for a slot's foot that slides downhill, -1 for uphill and 0 otherwise."""
    sign = lambda mode: jnp.where(mode == SLIP_DOWN, 1.0, jnp.where(mode == SLIP_UP, -1.0, 0.0))
    return sign(contact[0]), sign(contact[1])


class _Stays(NamedTuple):
    """Quantities that are frozen for a tangent of the residual: accelerations, or velocity
    jumps.
    """

    along: Legs  # of leg masses, beyond the hub's: along the legs
    across: Legs  # and transverse to them
    hub: Pair  # beyond gravity's


class _Moves(NamedTuple):
    """Tangents of the equations' rows with the frozen terms fixed."""

    along: Legs
    across: Legs
    hub: Pair
    springs: Legs | float  # N
    foot_e: Pair
    foot_u: Pair


_Rows = Callable[[Stand, Stand, Hub, Carried], tuple[_Stays, _Moves]]


@eqx.filter_jit  # traced once for all call sites
def in_motion(stand: Stand) -> Carried:
    """Return the forces, and the resulting accelerations."""
    return _carried(free_acceleration, rows_of_motion, stand)


@eqx.filter_jit
def in_impact(stand: Stand) -> Carried:
    """Return the impulses, and the velocities after them."""
    return _carried(free_velocity, _rows_of_impact, stand)


def told_by(stand: Stand, hub: Hub, free: Free) -> Carried:
    """Return the forces of a configuration for this free motion."""
    s, _, friction, slots, contact, held, _ = stand
    found = answer(s, hub, free, contact, held, friction)
    out = free.legs + hub.legs.sin * found.hub[0] + hub.legs.cos * found.hub[1]
    lengths = jnp.where(stand.stays, 0.0, out - slots.spread(found.pull) / s.m)
    forces = found.tangential, found.normal, found.stopper, found.pull
    return Carried(*forces, found.hub, found.regular, lengths)


def _solved(free_of: Callable[..., Free], stand: Stand) -> tuple[Hub, Free, Carried]:
    """Return inertia, free motion and forces of a configuration."""
    s, motion, one = stand.s, stand.motion, one_of(stand.motion)
    hub = kept(hub_of(s, motion, stand.slots, stand.airborne), one)
    free = kept(free_of(s, motion, stand.slots, hub), one)
    return hub, free, kept(told_by(stand, hub, free), one)


def solved_motion(stand: Stand) -> tuple[Hub, Free, Carried]:
    """Return the inertia, the motion free of contact forces, and the forces."""
    return _solved(free_acceleration, stand)


def _carried(free_of: Callable[..., Free], rows: _Rows, stand: Stand) -> Carried:
    """Return the forces, with a derivative rule by the tangent of the residual."""
    floats, rest = eqx.partition(stand, eqx.is_inexact_array)
    arrays, rest = eqx.partition(rest, eqx.is_array)
    whole = lambda floats, arrays: eqx.combine(floats, arrays, rest)
    found = jax.custom_jvp(lambda *given: _solved(free_of, whole(*given))[2])

    @found.defjvp
    def rule(at: tuple, ways: tuple) -> tuple[Carried, Carried]:
        stand, way = whole(*at), whole(ways[0], at[1])
        hub, free, told = _solved(free_of, stand)
        left = left_over(stand, way, hub, told, *rows(stand, way, hub, told))
        given = asked(hub, left.legs, in_all(stand.slots, left))
        _, moved = jax.jvp(lambda free: told_by(stand, hub, free), (free,), (given,))
        sum_of = lambda one, other: (one[0] + other[0], one[1] + other[1])
        return told, moved._replace(
            tangential=sum_of(moved.tangential, left.grip), pull=sum_of(moved.pull, left.pull)
        )

    return found(floats, arrays)


class Left(NamedTuple):
    """Tangent of the residual, in the form of its effect on the unknowns."""

    legs: Legs  # their lengths
    hub: tuple[Legs, Legs, Legs]  # each leg's part of the forces there
    rest: Vector3  # the forces there without the legs' part
    foot_e: Pair
    foot_u: Pair
    grip: Pair  # tangent of friction by its coefficient
    pull: Pair  # tangent of the slots' pulls by that, and by their legs' rotation


def left_over(
    stand: Stand, way: Stand, hub: Hub, told: Carried, stays: _Stays, moves: _Moves
) -> Left:
    """Return the tangent of the residual along a tangent of the configuration."""
    s, ds, slots, (sin, cos), two = stand.s, way.s, stand.slots, hub.legs, range(2)
    b, db, dtheta = stand.motion.L - s.a, way.motion.L - ds.a, way.motion.theta
    slides, rough = sliding(stand.contact), jax.jvp(rough_of, (stand.friction,), (way.friction,))[1]
    rough = rough if isinstance(rough, tuple) else (rough, rough)
    t, n, L, dL = told.tangential, told.normal, hub.L, slots.of(way.motion.L)
    grip = [-slides[i] * rough[i] * n[i] for i in two]
    across = [t[i] * hub.cos[i] - n[i] * hub.sin[i] for i in two]
    along = [t[i] * hub.sin[i] + n[i] * hub.cos[i] for i in two]
    pull = [grip[i] * hub.sin[i] + across[i] * dtheta for i in two]
    drag = [dL[i] * across[i] + L[i] * (grip[i] * hub.cos[i] - along[i] * dtheta) for i in two]

    (ax, az), (dx, dz) = stays.hub, moves.hub
    outward, lever = sin * ax + cos * az, stays.across - cos * ax + sin * az
    legs = (cos * ax - sin * az) * dtheta - moves.along + sin * dx + cos * dz
    legs = legs + (moves.springs - slots.spread(pull) + (outward - stays.along) * ds.m) / s.m
    legs = jnp.where(hub.released, legs, 0.0)
    net = legs + moves.along
    x, z = stays.along * sin + stays.across * cos, stays.along * cos - stays.across * sin
    torque = db * lever + b * (moves.across + outward * dtheta - cos * dx + sin * dz)
    return Left(
        legs=legs,
        hub=(
            s.m * (net * sin + moves.across * cos + z * dtheta) + ds.m * x,
            s.m * (net * cos - moves.across * sin - x * dtheta) + ds.m * z,
            -s.m * torque - ds.m * (b * lever) - slots.spread(drag),
        ),
        rest=(grip[0] + grip[1] - ds.Mt * ax - s.Mt * dx, -ds.Mt * az - s.Mt * dz, 0.0),
        foot_e=moves.foot_e,
        foot_u=moves.foot_u,
        grip=(grip[0], grip[1]),
        pull=(pull[0], pull[1]),
    )


class Acts(NamedTuple):
    """Tangent of the residual, summed over all legs and gathered for the slots."""

    hub: Vector3
    own: Pair
    foot_e: Pair
    foot_u: Pair
    grip: Pair


def in_all(slots: Slots, left: Left) -> Acts:
    """Return the residual tangent summed over the legs."""
    x, z, turn = (over_legs(legs) + rest for legs, rest in zip(left.hub, left.rest, strict=True))
    return Acts((x, z, turn), slots.of(left.legs), left.foot_e, left.foot_u, left.grip)


def asked(hub: Hub, legs: Legs, left: Acts) -> Free:
    """Return the tangent of the free motion that the residual tangent is equivalent to."""
    to, own, (u, v) = times(hub.inverse, left.hub), left.own, left.foot_u
    e = [hub.cos[i] * to[0] - hub.sin[i] * to[1] - hub.L[i] * to[2] for i in range(2)]
    e = [e[i] + left.foot_e[i] for i in range(2)]
    return Free(to, legs, own, (e[0], e[1]), (u - own[0], v - own[1]))


def rows_of_motion(stand: Stand, way: Stand, hub: Hub, told: Carried) -> tuple[_Stays, _Moves]:
    """Return the frozen terms and the tangents of the rows of the equations of motion."""
    s, motion, slots = stand.s, stand.motion, stand.slots
    ds, moved, dtheta = way.s, way.motion, way.motion.theta
    b, db, turn = motion.L - s.a, moved.L - ds.a, told.hub[2]
    spin, twice = motion.dtheta * motion.dtheta, 2.0 * motion.dtheta
    dspin, dtwice = twice * moved.dtheta, 2.0 * moved.dtheta
    springs = ds.k * (s.Ls - motion.L) - ds.c * motion.dL
    springs = springs + s.k * (ds.Ls - moved.L) - s.c * moved.dL
    stays = _Stays(
        along=told.lengths - b * spin,
        across=twice * motion.dL + b * turn,
        hub=(told.hub[0] - s.g * s.sin_phi, told.hub[1] + s.g * s.cos_phi),
    )
    L, dL, back, dback = hub.L, *map(slots.of, (moved.L, motion.dL, moved.dL))
    own = slots.of(told.lengths)
    foot_e = [
        (L[i] * spin - own[i]) * dtheta - twice * dback[i] - back[i] * dtwice - turn * dL[i]
        for i in range(2)
    ]
    foot_u = [
        (twice * back[i] + turn * L[i]) * dtheta + spin * dL[i] + L[i] * dspin for i in range(2)
    ]
    return stays, _Moves(
        along=-(db * spin + b * dspin),
        across=twice * moved.dL + motion.dL * dtwice + turn * db,
        hub=(-ds.g * s.sin_phi - s.g * ds.sin_phi, ds.g * s.cos_phi + s.g * ds.cos_phi),
        springs=springs,
        foot_e=(foot_e[0], foot_e[1]),
        foot_u=(foot_u[0], foot_u[1]),
    )


def _rows_of_impact(stand: Stand, way: Stand, hub: Hub, told: Carried) -> tuple[_Stays, _Moves]:
    """Return the frozen terms and the tangents of the rows of the impact equations."""
    s, motion, moved, slots = stand.s, stand.motion, way.motion, stand.slots
    turn = told.hub[2]
    jump, b = turn - motion.dtheta, motion.L - s.a
    stays = _Stays(
        along=told.lengths - motion.dL,
        across=b * jump,
        hub=(told.hub[0] - motion.vx, told.hub[1] - motion.vz),
    )
    own, dL = slots.of(told.lengths), slots.of(moved.L)
    foot_e = [-turn * dL[i] - own[i] * moved.theta for i in range(2)]
    return stays, _Moves(
        along=-moved.dL,
        across=(moved.L - way.s.a) * jump - b * moved.dtheta,
        hub=(-moved.vx, -moved.vz),
        springs=0.0,
        foot_e=(foot_e[0], foot_e[1]),
        foot_u=(hub.L[0] * turn * moved.theta, hub.L[1] * turn * moved.theta),
    )
