"""Motion of the wheel between events, and the guards of the next event."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from vrw_jax.models.unilateral.carrying import (
    Carried,
    Stand,
    in_motion,
    sliding,
)
from vrw_jax.models.unilateral.contacts import OFF, STICK, Roughness, rough_of
from vrw_jax.models.unilateral.mechanics import (
    FootVelocity,
    Legs,
    Legwise,
    Pair,
    Slots,
    WheelMotion,
    foot_heights,
    foot_places,
    foot_velocity,
    free_legs,
    kept,
    of_slots,
    one_of,
    over_legs,
    posture_of,
    slots_of,
)
from vrw_jax.numerics import Elementwise, Scalar
from vrw_jax.wheel import Symbols

State = Float[Array, "dim ..."]
"""Hub (x, z, theta) and rates, lengths, rates of lengths, then the accumulators: see
`Accumulators`."""


class Tally(NamedTuple):
    """Integrals along the motion, besides the motion itself."""

    clock: Scalar  # time since the last event, s
    damping: Scalar  # energy lost in the dampers, J
    friction: Scalar  # energy lost by sliding, J
    slip: Scalar  # path length of all sliding feet, m


def pack(motion: WheelMotion, tally: Tally) -> State:
    """Return everything that is integrated as one vector of 10 + 2 n entries."""
    return jnp.concatenate([jnp.stack(motion[:6]), motion.L, motion.dL, jnp.stack(tally)])


def unpack(y: State) -> tuple[WheelMotion, Tally]:
    """Return motion and accumulators of a vector: the inverse of `pack_state`."""
    n = (y.shape[0] - 10) // 2
    L, dL, tally = y[6 : 6 + n], y[6 + n : 6 + 2 * n], y[6 + 2 * n :]
    motion = WheelMotion(y[0], y[1], y[2], y[3], y[4], y[5], L, dL)
    return motion, Tally(tally[0], tally[1], tally[2], tally[3])


class Stance(NamedTuple):
    """Contact modes of the feet, stopper states of the legs, and what has just changed."""

    contact: Int[Array, " n_legs"]  # mode of every foot
    locked: Bool[Array, " n_legs"]  # legs on their stoppers
    new_foot: Bool[Array, " n_legs"]  # feet that have just left the ground
    new_leg: Bool[Array, " n_legs"]  # legs that have just left their stoppers
    new_slip: Bool[Array, " n_legs"]  # feet that have just begun to slide, from rest


class Flow(NamedTuple):
    """The wheel in one contact state, with everything that the motion between two events needs."""

    s: Symbols
    friction: Roughness  # of the slots' feet
    one_sided: bool  # airborne legs may leave their stoppers
    stance: Stance
    slots: Slots
    contact: Int[Array, "2"]  # of the slots
    held: Bool[Array, "2"]  # the slots' legs on their stoppers
    airborne: Bool[Array, " n_legs"]  # other legs on their stoppers
    tallied: bool  # in batches: the accumulators are integrated as well
    tilt: Elementwise | None = None  # by which the ground ahead is steeper, rad

    def stand(self, motion: WheelMotion) -> Stand:
        """Return the contact configuration at this motion."""
        slots = self.slots, self.contact, self.held, self.airborne
        return Stand(self.s, motion, self.friction, *slots)


def flow_of(
    s: Symbols,
    friction: Roughness,
    one_sided: bool,
    stance: Stance,
    tallied: bool = False,
    tilt: Elementwise | None = None,
) -> Flow:
    """Return the dynamics of the wheel in this contact state."""
    slots = slots_of(stance.contact != OFF)
    contact, held = slots.codes(stance.contact), slots.flags(stance.locked)
    airborne = stance.locked & ~slots.filled
    friction = of_slots(friction, slots)
    return Flow(s, friction, one_sided, stance, slots, contact, held, airborne, tallied, tilt)


class Forces(NamedTuple):
    """Contact forces with the leg directions and foot velocities that they depend on."""

    legs: Legwise
    free: Legs  # see `free_legs`
    answer: Carried
    feet: FootVelocity


def forces(flow: Flow, motion: WheelMotion) -> Forces:
    """Return contact and stopper forces with the resulting accelerations."""
    one, posture = one_of(motion), posture_of(flow.s, motion, flow.slots)
    free = kept(free_legs(flow.s, motion, posture.legs), one)
    feet = kept(foot_velocity(motion, flow.slots, posture), one)
    return Forces(posture.legs, free, in_motion(flow.stand(motion)), feet)


def _outward(now: Forces) -> Legs:
    """Return the acceleration of each leg's length without forces of slots and stoppers, m/s^2."""
    sin, cos = now.legs
    ax, az, _ = now.answer.hub
    return now.free + sin * ax + cos * az


def airborne_stopper_force(flow: Flow, now: Forces) -> Legs:
    """Return the stopper force of locked legs in the air, N; 0 for the other legs."""
    return jnp.where(flow.airborne, flow.s.m * _outward(now), 0.0)


def least_stopper_force(flow: Flow, now: Forces) -> Elementwise:
    """Return the minimum of `airborne_stopper_force`; infinite if no leg in the air is locked."""
    return jnp.min(jnp.where(flow.airborne, airborne_stopper_force(flow, now), jnp.inf), axis=0)


def tally_rates(flow: Flow, motion: WheelMotion, now: Forces) -> Tally:
    """Return the rates of the accumulators."""
    direction = sliding(flow.contact)
    speeds = [direction[i] * now.feet.x[i] for i in range(2)]
    drag = [-now.answer.tangential[i] * direction[i] for i in range(2)]
    return Tally(
        clock=jnp.ones_like(motion.x),
        damping=flow.s.c * over_legs(motion.dL * motion.dL),
        friction=drag[0] * speeds[0] + drag[1] * speeds[1],
        slip=speeds[0] + speeds[1],
    )


def field(flow: Flow, y: State) -> State:
    """Return the time derivative of the packed state."""
    motion, _ = unpack(y)
    now = forces(flow, motion)
    rates = WheelMotion(
        motion.vx,
        motion.vz,
        motion.dtheta,
        *now.answer.hub,
        jnp.where(flow.stance.locked, 0.0, motion.dL),
        now.answer.lengths,
    )
    return kept(pack(rates, tally_rates(flow, motion, now)), one_of(motion))


class Guards(NamedTuple):
    """Index at which each kind of guard begins in the list of `guard_values`."""

    foot: int  # heights of airborne feet, one per leg: zero at a landing
    leg: int  # distance to the stopper, one per leg
    lift: int  # normal force, one per slot
    cone_up: int  # friction margin before the foot slides uphill, one per slot
    cone_down: int  # the same before it slides downhill
    slip: int  # speed of a sliding foot, one per slot
    release: int  # stopper force of a loaded leg, one per slot
    rate: int  # dtheta
    length: int  # shortest leg minus a
    loosen: int  # stopper force of airborne legs, one per leg, if one-sided
    total: int

    @property
    def n_legs(self) -> int:
        """Number of legs of the wheel."""
        return self.leg - self.foot

    @property
    def foremost(self) -> int:
        """Guard of the foremost foot, whose landing ends a step."""
        return self.leg - 1


def guards_of(n: int, one_sided: bool) -> Guards:
    """Return the guard layout of a wheel with `n` legs."""
    sizes = (n, n, 2, 2, 2, 2, 2, 1, 1, n if one_sided else 0)
    places = np.concatenate([[0], np.cumsum(sizes)])
    return Guards(*(int(p) for p in places))


class Felt(NamedTuple):
    """Quantities that determine the duration of a contact state, besides the motion itself."""

    legs: Legwise
    normal: Pair
    tangential: Pair
    stopper: Pair
    speed: Pair  # of the slots' feet along the slope
    regular: Array  # see `contacts.ContactSolution`
    in_air: Legs | None  # stopper force of legs in the air, if stoppers are one-sided


def felt(flow: Flow, now: Forces) -> Felt:
    """Return the quantities of the forces that `evaluate_guards` needs."""
    found = now.answer
    in_air = airborne_stopper_force(flow, now) if flow.one_sided else None
    forces = found.normal, found.tangential, found.stopper
    return Felt(now.legs, *forces, now.feet.x, found.regular, in_air)


def as_row(friction: Roughness) -> Array:
    """Return the slots' friction as one array, if it differs between slots."""
    return jnp.stack(friction) if isinstance(friction, tuple) else friction


def _heights(flow: Flow, motion: WheelMotion, legs: Legwise) -> Legs:
    """Return the height of every foot above its ground, m; the ground ahead begins under foot 1."""
    heights = foot_heights(motion, legs)
    if flow.tilt is None:
        return heights
    places = foot_places(motion, legs)
    ahead = heights[-1] * jnp.cos(flow.tilt) + (places[-1] - places[0]) * jnp.sin(flow.tilt)
    return heights.at[-1].set(ahead)


def stance_guards(flow: Flow, motion: WheelMotion, now: Felt, begun: Array) -> list[Array]:
    """Return the guards in the order of `GuardLayout`.

    - `has_begun`: False at the start of the contact state.

    The last event leaves its own guard at zero: of a foot off the ground, a leg off its stopper, or
    a sliding foot. That guard is not evaluated at that instant.
    """
    s, stance = flow.s, flow.stance
    one = jnp.ones_like(motion.L)
    in_air = (stance.contact == OFF) & (begun | ~stance.new_foot)
    moving = ~stance.locked & (begun | ~stance.new_leg)
    just_slid = flow.slots.flags(stance.new_slip)
    rough = as_row(rough_of(flow.friction))
    normal, tangential = jnp.stack(now.normal), jnp.stack(now.tangential)
    # In the limit of large friction a resting foot begins to slide where its normal force
    # vanishes, see `events.resolve_event`; a sliding foot lifts where its friction vanishes.
    limit = as_row(flow.friction) == jnp.inf
    direction = jnp.stack(sliding(flow.contact))
    pressed = jnp.where(limit & (direction != 0.0), -direction * tangential, normal)
    coned = (flow.contact == STICK) & jnp.isfinite(as_row(flow.friction))
    slides = (direction != 0.0) & (begun | ~just_slid)
    watched = lambda condition, value: jnp.where(condition, value, 1.0)
    in_the_air = [] if now.in_air is None else [jnp.where(flow.airborne, now.in_air, one)]
    return [
        jnp.where(in_air, _heights(flow, motion, now.legs), one),
        jnp.where(moving, s.L0 - motion.L, one),
        watched(flow.contact != OFF, pressed),
        watched(coned, rough * normal - tangential),
        watched(coned, rough * normal + tangential),
        watched(slides, direction * jnp.stack(now.speed)),
        watched(flow.held, jnp.stack(now.stopper)),
        motion.dtheta[None],
        (jnp.min(motion.L, axis=0) - s.a)[None],
        *in_the_air,
    ]


def guard_sizes(flow: Flow) -> Array:
    """Return the scale of each guard, in the order of `GuardLayout`: m, N, m/s, rad/s."""
    s = flow.s
    weight, speed = s.Mt * s.g, jnp.sqrt(s.g * s.L0)
    rows = [s.L0] * 2 * s.n + [weight] * 6 + [speed] * 2 + [weight] * 2 + [speed / s.L0, s.L0]
    return jnp.stack(rows + [weight] * s.n * flow.one_sided)


def guards(flow: Flow, y: State) -> Float[Array, " n_guards"]:
    """Return all guards: positive inside the contact state, zero at its end, 1 if not evaluated."""
    motion, tally = unpack(y)
    now = felt(flow, forces(flow, motion))
    parts = stance_guards(flow, motion, now, tally.clock > 0.0)
    return jnp.concatenate(kept(parts, one_of(motion)))
