"""Tangents of the dynamics along many directions, from the responses to unit coordinates.

At a point everything is linear: a unit of the angle has the same effect in every direction. A
length and its rate affect only their own leg, the hub and the slots. So legs are skipped if none of
them moves, and so are input columns.
"""

import operator
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from vrw_jax.models.unilateral.carrying import (
    Acts,
    Carried,
    Left,
    Stand,
    asked,
    in_all,
    left_over,
    rows_of_motion,
    solved_motion,
)
from vrw_jax.models.unilateral.contacts import answer
from vrw_jax.models.unilateral.march import FlowAt
from vrw_jax.models.unilateral.mechanics import (
    FootVelocity,
    Free,
    Hub,
    Legs,
    Legwise,
    Pair,
    Slots,
    Vector3,
    WheelMotion,
    foot_velocity,
    over_legs,
    posture_of,
)
from vrw_jax.models.unilateral.motion import Flow, Forces, forces, tally_rates
from vrw_jax.numerics import if_any
from vrw_jax.wheel import PARAMETER_NAMES

FEW = 3
"""Number of leading legs that usually include all that move: the others are on their stoppers."""
_LEGS = slice(0, FEW), slice(FEW, None)
_BY_MASSES = "hub_mass", "leg_mass", "leg_com"
_BY_SPRINGS = "natural_length", "stiffness", "damping"
_COLUMNS = *PARAMETER_NAMES, "friction"
ALIKE = [
    tuple(map(_COLUMNS.index, names))
    for names in (_BY_MASSES, _BY_SPRINGS, ("slope", "gravity"), ("friction",))
]
"""Groups of inputs with the same kind of effect; the stoppers' position acts through lengths
alone."""

Ends = Callable[[slice], tuple[Array, Array]]
"""Function that returns some coordinates and rates of a tangent at a point."""


class Share(NamedTuple):
    """Response to a unit input, with forces and accelerations fixed."""

    legs: Legs  # of their lengths
    acts: Acts
    speed: Pair  # of the slots' feet along the slope
    damping: Array  # W


class _Metres(NamedTuple):
    """Response to a unit length of each leg, or to a unit rate.

    - `slots`: responses of lengths, of feet along e and along u, and of foot speed.
    """

    legs: Legs  # of its own length
    hub: tuple[Legs, Legs, Legs]
    slots: tuple[Pair, Pair, Pair, Pair]


class _Lengths(NamedTuple):
    """Response to the lengths and rates of some legs along a tangent."""

    hub: Vector3
    L: Pair  # the slots'
    dL: Pair
    damping: Array


class _Moving(NamedTuple):
    """Linearization at one point."""

    flow: Flow
    motion: WheelMotion
    stand: Stand
    hub: Hub
    free: Free
    told: Carried
    still: Stand  # floats of the zero tangent

    @classmethod
    def at(cls, flow: Flow, motion: WheelMotion) -> "_Moving":
        """Return the linearization at this motion."""
        stand = flow.stand(motion)
        solved = solved_motion(stand)
        floats = eqx.filter(stand, eqx.is_inexact_array)
        still = jax.tree.map(jnp.zeros_like, floats)
        return cls(flow, motion, stand, *solved, still)

    def left(self, some: slice) -> Callable[[Stand], tuple[Left, Slots]]:
        """Return the residual tangent of some legs along a tangent, and the slots of these legs."""
        rest = eqx.filter(self.stand, eqx.is_inexact_array, inverse=True)
        stand, legs = _part_of(self.stand, some), Legwise(*(row[some] for row in self.hub.legs))
        hub = self.hub._replace(legs=legs, released=self.hub.released[some])
        told = self.told._replace(lengths=self.told.lengths[some])

        @jax.jit  # traced once
        def left(way: Stand) -> Left:
            given = stand, _part_of(eqx.combine(way, rest), some), hub, told
            return left_over(*given, *rows_of_motion(*given))

        return lambda way: (left(way), stand.slots)

    def speed(self, way: WheelMotion) -> Pair:
        """Return the tangent of the foot speeds."""
        s, slots = self.flow.s, self.flow.slots
        speeds = lambda motion: foot_velocity(motion, slots, posture_of(s, motion, slots)).x
        return jax.jvp(speeds, (self.motion,), (way,))[1]

    def along(self, motion: WheelMotion, some: Callable[[Stand], tuple[Left, Slots]]) -> tuple:
        """Return the residual tangent of legs along a motion tangent, their slots, and the feet's
        speed.
        """
        return *some(self.still._replace(motion=motion)), self.speed(motion)

    def metres(self, some: slice) -> tuple[_Metres, _Metres]:
        """Return the responses to some legs' lengths, and to their rates."""
        legs = self.left(some)

        def of(name: str) -> _Metres:
            row = getattr(self.still.motion, name)
            ones = jnp.stack([x + float(i in range(len(row))[some]) for i, x in enumerate(row)])
            left, slots, speed = self.along(self.still.motion._replace(**{name: ones}), legs)
            return _Metres(
                left.legs, left.hub, (slots.of(left.legs), left.foot_e, left.foot_u, speed)
            )

        return of("L"), of("dL")

    def answered(self) -> Callable[[Free], tuple[Vector3, Pair, Pair]]:
        """Return the tangent map from free motion to hub acceleration, pulls and tangential
        forces.
        """
        s, friction = self.stand.s, self.stand.friction
        contact, held = self.stand.contact, self.stand.held

        def found(free: Free) -> tuple[Vector3, Pair, Pair]:
            told = answer(s, self.hub, free, contact, held, friction)
            return told.hub, told.pull, told.tangential

        return jax.linearize(found, self.free)[1]


def _part_of(stand: Stand, some: slice) -> Stand:
    """Return the configuration restricted to some legs."""
    motion, slots = stand.motion, stand.slots
    return stand._replace(
        motion=motion._replace(L=motion.L[some], dL=motion.dL[some]),
        slots=Slots(slots.first[some], slots.second[some]),
        airborne=stand.airborne[some],
    )


class Shares(NamedTuple):
    """Quantities at a point that all tangents share.

    - `whole_residual`: residual of all legs along any tangent;
    - `length_responses`: those of the first legs, and of the others;
    - `slot_responses`: the sum of these for the slots.
    """

    moving: _Moving
    now: Forces
    answered: Callable[[Free], tuple[Vector3, Pair, Pair]]
    whole: Callable[[Stand], tuple[Left, Slots]]
    angle: tuple[Share, Share]  # to the angle, and to its rate
    metres: tuple[tuple[_Metres, _Metres], tuple[_Metres, _Metres]]
    slots: tuple[tuple[Pair, Pair, Pair, Pair], ...]
    damping: Legs  # W, for a unit rate of each leg
    slid: Callable[[Pair, Pair], Array]  # tangent of sliding loss and slip

    @classmethod
    def at(cls, flow: Flow, motion: WheelMotion, more: Array) -> "Shares":
        """Return the basis at this motion; `has_more_moving`: more than the first legs move."""
        moving, now = _Moving.at(flow, motion), forces(flow, motion)
        whole = moving.left(slice(None))
        few, n = moving.metres(_LEGS[0]), len(motion.L)
        none = lambda x: jnp.zeros((n - FEW, *x.shape[1:]) if x.ndim > 1 else x.shape, x.dtype)
        others = if_any(more, lambda _: moving.metres(_LEGS[1]), jax.tree.map(none, few))

        def slid(x: Pair, tangential: Pair) -> Array:
            answer = now.answer._replace(tangential=tangential)
            told = tally_rates(flow, motion, now._replace(answer=answer, feet=FootVelocity(x, x)))
            return jnp.stack([told.friction, told.slip])

        damped = lambda dL: tally_rates(flow, motion._replace(dL=dL), now).damping
        (damping,) = jax.vjp(damped, motion.dL)[1](jnp.ones_like(motion.theta))
        _, push = jax.linearize(slid, now.feet.x, now.answer.tangential)
        one = jnp.ones_like(motion.theta)

        def angle(name: str) -> Share:
            left, slots, speed = moving.along(moving.still.motion._replace(**{name: one}), whole)
            return Share(left.legs, in_all(slots, left), speed, jnp.zeros_like(one))

        rows = angle("theta"), angle("dtheta")
        slots = [
            jax.tree.map(operator.add, *(x.slots for x in both))
            for both in zip(few, others, strict=True)
        ]
        return cls(
            moving, now, moving.answered(), whole, rows, (few, others), tuple(slots), damping, push
        )

    def by_columns(self, flow_at: FlowAt, columns: Array, way: Array) -> Share:
        """Return the response to a tangent of the input columns."""
        moving, none = self.moving, self.nothing()

        def acting(columns: Array) -> tuple[Stand, Array]:
            flow = flow_at(columns)
            tally = tally_rates(flow, moving.motion, self.now)
            return eqx.filter(flow.stand(moving.motion), eqx.is_inexact_array), tally.damping

        _, push = jax.linearize(acting, columns)
        total = none
        for which in ALIKE:
            some = jnp.stack([row if i in which else 0.0 * row for i, row in enumerate(way)])

            def add(total: Share, some: Array = some) -> Share:
                stand, damping = push(some)
                left, slots = self.whole(stand)
                share = Share(left.legs, in_all(slots, left), none.speed, damping)
                return jax.tree.map(operator.add, total, share)

            moves = jnp.any(jnp.stack([way[i] != 0.0 for i in which]))
            total = if_any(moves, add, total)
        return total

    def nothing(self) -> Share:
        """Return the zero response."""
        return jax.tree.map(jnp.zeros_like, self.angle[0])

    def along(self, ends: Ends, column: Share, more: Array) -> Array:
        """Return the tangent of the accelerations and, if requested, of the accumulators."""
        q, v = ends(slice(0, 3 + FEW))
        theta, dtheta, few = q[2], v[2], (q[3:], v[3:])
        others = lambda: ends(slice(3 + FEW, None))
        plus = lambda one, other: jax.tree.map(operator.add, one, other)
        lengths = self._lengths(0, *few)
        lengths = if_any(more, lambda _: plus(lengths, self._lengths(1, *others())), lengths)
        at = lambda a, b, c: a * theta + b * dtheta + c
        parts = [jax.tree.map(at, *rows) for rows in zip(*self.angle, column, strict=True)][1:]
        acts, speed, damping = parts
        rows = acts.own, acts.foot_e, acts.foot_u, speed
        own, foot_e, foot_u, speed = (
            tuple(a[i] + b[i] * lengths.L[i] + c[i] * lengths.dL[i] for i in range(2))
            for a, b, c in zip(rows, *self.slots, strict=True)
        )
        hub = tuple(map(operator.add, acts.hub, lengths.hub))
        acts = Acts(hub, own, foot_e, foot_u, acts.grip)
        free = asked(self.moving.hub, jnp.zeros_like(self.moving.motion.L), acts)
        hub, pull, tangential = self.answered(free)
        legs = lambda which, *way: self._legs(which, hub, pull, at, column.legs, *way)
        none = jnp.zeros((len(self.damping) - FEW, *theta.shape), theta.dtype)
        moved = [jnp.stack(hub), legs(0, *few), if_any(more, lambda _: legs(1, *others()), none)]
        if self.moving.flow.tallied:
            speed = speed[0] + v[0], speed[1] + v[0]
            tangential = tuple(map(operator.add, tangential, acts.grip))
            moved += [(damping + lengths.damping)[None], self.slid(speed, tangential)]
        return jnp.concatenate(moved)

    def _lengths(self, which: int, L: Any, dL: Any) -> _Lengths:
        longer, faster = self.metres[which]
        some = _LEGS[which]
        total = lambda a, b: over_legs(a * L + b * dL)
        x, z, turn = map(total, longer.hub, faster.hub)
        slots = self.moving.flow.slots
        own = Slots(slots.first[some], slots.second[some])
        return _Lengths((x, z, turn), own.of(L), own.of(dL), over_legs(self.damping[some] * dL))

    def _legs(
        self, which: int, hub: Vector3, pull: Pair, at: Callable, column: Any, L: Any, dL: Any
    ) -> Array:
        (longer, faster), some, moving = self.metres[which], _LEGS[which], self.moving
        by_angle = at(*(share.legs[some] for share in self.angle), column[some])
        stand = _part_of(moving.stand, some)
        sin, cos = (row[some] for row in moving.hub.legs)
        out = by_angle + longer.legs * L + faster.legs * dL + sin * hub[0] + cos * hub[1]
        out = out - stand.slots.spread(pull) / stand.s.m
        return jnp.where(moving.stand.stays[some], 0.0, out)
