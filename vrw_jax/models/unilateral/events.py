"""What an event changes: impacts by momentum, then which feet and stoppers carry the motion on."""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Int

from vrw_jax.models.unilateral.contacts import (
    OFF,
    SLIP_DOWN,
    SLIP_UP,
    STICK,
    Allowed,
    Choice,
    answer,
    choose,
    leaves,
)
from vrw_jax.models.unilateral.mechanics import (
    Hub,
    Legs,
    Slots,
    WheelMotion,
    directions,
    free_acceleration,
    free_velocity,
    hub_of,
    kinetic_energy,
    slots_of,
)
from vrw_jax.models.unilateral.motion import Guards, Stance
from vrw_jax.numerics import Elementwise, Scalar, select, zeros_of
from vrw_jax.wheel import Symbols


class Event(NamedTuple):
    """What happened: one flag is set."""

    lands: Bool[Array, " n_legs"]  # its foot met the ground
    closes: Bool[Array, " n_legs"]  # it met its stopper
    loosens: Bool[Array, " n_legs"]  # in the air, its stopper force vanished
    lifts: Bool[Array, "2"]  # the slot's normal force vanished
    slides_up: Bool[Array, "2"]  # friction no longer holds the slot's foot
    slides_down: Bool[Array, "2"]
    stops: Bool[Array, "2"]  # the slot's foot no longer slides
    releases: Bool[Array, "2"]  # the stopper force of the slot's leg vanished

    @property
    def impact(self) -> Bool[Array, ""]:
        """Whether velocities jump."""
        return jnp.any(self.lands) | jnp.any(self.closes)


def event_of(place: Guards, guard: Int[Array, ""]) -> Event:
    """The event of a guard's index."""
    n = place.n_legs
    flags = lambda start, count: guard == start + jnp.arange(count)
    loosens = flags(place.loosen, n) if place.total > place.loosen else jnp.zeros((n,), bool)
    return Event(
        lands=flags(place.foot, n),
        closes=flags(place.leg, n),
        loosens=loosens,
        lifts=flags(place.lift, 2),
        slides_up=flags(place.cone_up, 2),
        slides_down=flags(place.cone_down, 2),
        stops=flags(place.slip, 2),
        releases=flags(place.release, 2),
    )


class Law(NamedTuple):
    """The wheel on its ground, and what is asked of all events alike."""

    s: Symbols
    friction: Elementwise
    one_sided: bool  # stoppers of legs in the air only push
    counted: bool  # whether `solutions` is the number of admissible ones, or says if there is one
    unseen: Elementwise  # least excursion that is followed, m


MOST_SWITCHES = 40
"""Rounds in search of the stoppers that hold; a few are enough unless friction is paradoxical."""


def _that_push(solve: Callable[[Array], tuple], at_stopper: Array, asked: Array) -> tuple:
    """What `solve` finds, with which legs in the air are held, and whether their signs are right.

    `solve(held)` returns its result, the stoppers' pushes, and how each free leg's length moves.
    Of `at_stopper` those that are `asked` are held where their stopper pushes, else they move
    inwards. All of the wrong sign switch at once, then, against going in circles, only the last:
    principal pivoting, finite where no friction couples the legs (Murty 1974, Kostreva 1978).
    """
    place = jnp.arange(at_stopper.shape[0])

    def switch(now: tuple) -> tuple:
        held, wrong, tries, _ = now
        last = place == jnp.max(jnp.where(wrong, place, -1))
        held = held ^ jnp.where(tries <= MOST_SWITCHES // 2, wrong, last)
        result, push, outward = solve(held)
        wrong = asked & jnp.where(held, push < 0.0, outward > 0.0)
        return held, wrong, tries + 1, result

    def goes_on(now: tuple) -> Array:
        _, wrong, tries, _ = now
        return (tries == 0) | (jnp.any(wrong) & (tries < MOST_SWITCHES))

    empty = zeros_of(solve, at_stopper)[0]
    begin = at_stopper, at_stopper & False, jnp.zeros((), jnp.int32), empty
    held, wrong, _, result = lax.while_loop(goes_on, switch, begin)
    return result, held, ~jnp.any(wrong)


class Change(NamedTuple):
    """What an event left behind."""

    motion: WheelMotion
    stance: Stance
    energy_lost: Scalar  # J
    normal_impulse: tuple[Scalar, Scalar]  # on the slots' feet, N s
    tangential_impulse: tuple[Scalar, Scalar]
    stopper_impulse: Scalar  # least of the locked legs in the air, N s; inf without an impact
    solutions: Int[Array, ""]  # admissible combinations: the worse of both levels
    most_solutions: Int[Array, ""]
    third_foot: Bool[Array, ""]  # three feet would have to be loaded


def moved_by(
    s: Symbols, motion: WheelMotion, slots: Slots, hub: Hub, airborne: Array, choice: Choice
) -> WheelMotion:
    """The motion with the velocities of an impact's answer."""
    free = free_velocity(s, motion, slots, hub)
    vx, vz, dtheta = choice.answer.hub
    dL = free.legs + hub.legs.sin * vx + hub.legs.cos * vz
    held = jnp.where(airborne, 0.0, dL)
    dL = jnp.where(slots.filled, slots.spread(choice.answer.length), held)
    return motion._replace(vx=vx, vz=vz, dtheta=dtheta, dL=dL)


class Staying(NamedTuple):
    """What an impact may not throw off."""

    legs: Bool[Array, " n_legs"]  # from their stoppers, in the air
    feet: Bool[Array, " n_legs"]  # from the ground


class Thrown(NamedTuple):
    """How fast what has just been thrown off comes back, m/s^2."""

    legs: Legs  # to the stopper
    feet: Legs  # to the slope


class _Shock(NamedTuple):
    """The answer of an impact."""

    after: WheelMotion
    choice: Choice
    impulse: Legs  # of the stoppers in the air, N s; inf for other legs


def _is(mode: Array | int) -> Bool[Array, "... 4"]:
    """A flag for each of the four contact modes: whether it is this one."""
    return jnp.arange(4) == jnp.asarray(mode)[..., None]


def _impact(
    law: Law, motion: WheelMotion, stance: Stance, event: Event, stay: Staying
) -> tuple[_Shock, Slots, Bool[Array, " n"]]:
    """Velocity level: simultaneous, inelastic, with Coulomb's law in the impulse.

    Also says which legs in the air are held: with one-sided stoppers those that need not pull, and
    those that `stay`. Infinite friction keeps feet at rest planted when a leg meets its stopper, as
    the paper does.
    """
    s, friction = law.s, law.friction
    slots = slots_of((stance.contact != OFF) | event.lands)
    at_stopper = stance.locked | event.closes
    loaded = jnp.stack([jnp.any(slots.first), jnp.any(slots.second)])
    stops, before = slots.flags(at_stopper), slots.codes(stance.contact)
    planted = (before == STICK) & ~jnp.any(event.lands) & ~jnp.isfinite(friction)
    planted = planted | slots.flags(stay.feet)
    modes = jnp.where(loaded[:, None], jnp.ones((4,), bool), _is(OFF))
    modes = jnp.where(planted[:, None], _is(before), modes)
    allowed = Allowed(
        contact=modes & event.impact,  # else nothing is to be looked at
        held=jnp.stack([jnp.ones((2,), bool), stops], axis=1),
        stays=planted,
        known_contact=~loaded[:, None] & _is(OFF),
        known_open=~stops,
    )

    def solve(airborne: Array) -> tuple[_Shock, Legs, Legs]:
        hub = hub_of(s, motion, slots, airborne)
        free = free_velocity(s, motion, slots, hub)
        choice = choose(s, hub, free, allowed, friction, law.counted)
        after = moved_by(s, motion, slots, hub, airborne, choice)
        jump_x, jump_z = after.vx - motion.vx, after.vz - motion.vz
        impulse = s.m * (hub.legs.sin * jump_x + hub.legs.cos * jump_z + motion.dL)
        return _Shock(after, choice, jnp.where(airborne, impulse, jnp.inf)), impulse, after.dL

    airborne = at_stopper & ~slots.filled
    if not law.one_sided:
        return solve(airborne)[0], slots, airborne
    shock, held, right = _that_push(solve, airborne, airborne & ~stay.legs & event.impact)
    return shock._replace(choice=_if(right, shock.choice)), slots, held


def _if(right: Array, choice: Choice) -> Choice:
    """The same, not admissible where the stoppers in the air found no right signs."""
    return choice._replace(solutions=jnp.where(right, choice.solutions, 0))


def _following(
    event: Event, mode: Array, goes: Array, rigid: Array
) -> tuple[Bool[Array, "2 4"], Bool[Array, "2 4"]]:
    """Modes that may follow an event in each slot, and those of them that need no test.

    `goes`: what a slot's foot was about to become goes the right way (see `leaves`).
    """
    rests = (mode == STICK) | event.stops
    modes = jnp.where((mode == STICK)[:, None], jnp.ones((4,), bool), _is(mode) | _is(OFF))
    back = jnp.where(mode == SLIP_DOWN, SLIP_UP, SLIP_DOWN)
    modes = jnp.where(event.stops[:, None], _is(STICK) | _is(OFF) | _is(back), modes)
    known = _is(mode) & ~rests[:, None]
    stuck = jnp.full((2,), STICK)
    for flags, forced, ended in (
        (event.lifts, OFF, mode),
        (event.slides_up, SLIP_UP, stuck),
        (event.slides_down, SLIP_DOWN, stuck),
    ):
        tested = ~_is(ended) & (goes | rigid | ~_is(forced))
        modes = jnp.where(flags[:, None], jnp.where(goes, _is(forced), tested), modes)
        known = jnp.where(flags[:, None], goes & _is(forced), known)
    return modes, known


def _support(
    law: Law, motion: WheelMotion, contact: Int[Array, " n"], at_stopper: Array, event: Event
) -> tuple[Choice, Slots, Array, Bool[Array, " n"], Thrown]:
    """Acceleration level: who carries the motion that follows.

    Also says which feet were at rest, which legs in the air are held, and how what is off comes
    back. What an event has just ended is not asked again: its force is zero, and its sign rounding.
    It is followed by what it was about to become, if that goes the right way (see `leaves`).
    """
    s, friction = law.s, law.friction
    slots = slots_of(contact != OFF)
    mode, stops = slots.codes(contact), slots.flags(at_stopper)
    rests = (mode == STICK) | event.stops
    rigid = (mode == STICK) & ~jnp.isfinite(friction)  # a tangential force jumps to zero
    up, down = event.slides_up, event.slides_down
    second = (event.lifts | up | down)[1]
    direction = jnp.any(down).astype(jnp.int32) - jnp.any(up).astype(jnp.int32)
    opens = ~stops | event.releases

    def solve(airborne: Array) -> tuple[tuple[Choice, Thrown], Legs, Legs]:
        hub = hub_of(s, motion, slots, airborne)
        free = free_acceleration(s, motion, slots, hub)
        leaving = leaves(s, hub, free, (mode, stops), friction, second, direction)
        modes, known = _following(event, mode, (leaving & ~rigid)[:, None], rigid[:, None])
        allowed = Allowed(
            contact=modes,
            held=jnp.stack([jnp.ones((2,), bool), ~opens], axis=1),
            stays=rests & False,
            known_contact=known,
            known_open=opens,
        )
        choice = choose(s, hub, free, allowed, friction, law.counted)
        ax, az, turning = choice.answer.hub
        sin, cos, dtheta = *hub.legs, motion.dtheta
        outward = free.legs + sin * ax + cos * az
        ddL = jnp.where(airborne, 0.0, outward)
        turned = 2.0 * motion.dL * dtheta * sin + motion.L * (turning * sin + dtheta**2 * cos)
        return (choice, Thrown(outward, ddL * cos - az - turned)), outward, outward

    airborne = at_stopper & ~slots.filled
    if not law.one_sided:
        choice, thrown = solve(airborne)[0]
        return choice, slots, rests, airborne, thrown
    (choice, thrown), held, right = _that_push(solve, airborne, airborne)
    return _if(right, choice), slots, rests, held, thrown


def resolve(law: Law, motion: WheelMotion, stance: Stance, event: Event) -> Change:
    """Everything that an event changes.

    What an impact throws off the ground, or off a stopper that only pushes, comes back: where it
    would go no farther than `law.unseen` it stays. It would give the hub its momentum a moment
    later, so the motion is the same to about that; else each return throws others off, ever
    less, without end.
    """
    nothing = Staying(stance.locked & False, stance.locked & False)
    legs = directions(law.s, motion.theta)
    resolved = lambda stay: _resolved(law, motion, stance, event, stay)

    def again(now: tuple) -> tuple:
        stay, _, _ = now
        change, back = resolved(stay)
        after, now_stance = change.motion, change.stance
        rise = after.vz - after.dL * legs.cos + after.L * after.dtheta * legs.sin
        returns = lambda speed, back: (back > 0.0) & (speed**2 < 2.0 * back * law.unseen)
        in_air = now_stance.contact == OFF
        more = Staying(
            now_stance.new_leg & in_air & returns(after.dL, back.legs) & law.one_sided,
            now_stance.new_foot & (stance.contact != OFF) & returns(rise, back.feet),
        )
        new = jnp.any(more.legs & ~stay.legs) | jnp.any(more.feet & ~stay.feet)
        stay = Staying(stay.legs | more.legs, stay.feet | more.feet)
        return stay, new & event.impact, change

    begin = nothing, jnp.asarray(True), zeros_of(resolved, nothing)[0]
    return lax.while_loop(lambda now: now[1], again, begin)[2]


def _resolved(
    law: Law, motion: WheelMotion, stance: Stance, event: Event, stay: Staying
) -> tuple[Change, Thrown]:
    """`resolve` where some stay whatever it takes; also how what was thrown off comes back."""
    s, impact = law.s, event.impact
    touched = (stance.contact != OFF) | event.lands
    was_locked = (stance.locked | event.closes) & ~event.loosens
    shock, slots, held = _impact(law, motion, stance, event, stay)
    after = select(impact, shock.after, motion)
    struck = slots.spread(shock.choice.contact).astype(jnp.int32)
    contact = jnp.where(impact, struck, stance.contact)
    kept = jnp.where(slots.filled, slots.spread(shock.choice.held) > 0, was_locked & held)
    at_stopper = jnp.where(impact, kept, was_locked)
    legs = directions(s, motion.theta)
    dropped = touched & ~slots.filled
    foot_z = after.vz - after.dL * legs.cos + after.L * after.dtheta * legs.sin

    support, slots, rests, held, back = _support(law, after, contact, at_stopper, event)
    contact = slots.spread(support.contact).astype(jnp.int32)
    locked = jnp.where(slots.filled, slots.spread(support.held) > 0, at_stopper & held)
    slides = (support.contact == SLIP_DOWN) | (support.contact == SLIP_UP)
    stance = Stance(
        contact=contact,
        locked=locked,
        new_foot=touched & (contact == OFF),
        new_leg=(stance.locked | event.closes) & ~locked,
        new_slip=slots.spread(slides & rests) > 0,
    )
    lost = kinetic_energy(s, motion) - kinetic_energy(s, after)
    shocked, stands = shock.choice.solutions, support.solutions
    blank = lambda pair: (jnp.where(impact, pair[0], 0.0), jnp.where(impact, pair[1], 0.0))
    change = Change(
        motion=after._replace(
            L=jnp.where(locked, s.L0, after.L), dL=jnp.where(locked, 0.0, after.dL)
        ),
        stance=stance,
        energy_lost=jnp.where(impact, lost, 0.0),
        normal_impulse=blank(shock.choice.answer.normal),
        tangential_impulse=blank(shock.choice.answer.tangential),
        stopper_impulse=jnp.where(impact, jnp.min(shock.impulse), jnp.inf),
        solutions=jnp.where(impact, jnp.minimum(shocked, stands), stands),
        most_solutions=jnp.where(impact, jnp.maximum(shocked, stands), stands),
        third_foot=jnp.any(dropped & (foot_z < 0.0)) & impact,
    )
    return change, back


def settled(
    s: Symbols, motion: WheelMotion, contact: Int[Array, " n"], locked: Bool[Array, " n"]
) -> WheelMotion:
    """The motion that keeps to its contacts: loaded feet on the slope, sticking ones at rest.

    Velocities are projected by bilateral, frictionless impulses; a motion that keeps to its
    contacts already is returned as it is, to round-off.
    """
    legs = directions(s, motion.theta)
    L = jnp.where((contact != OFF) & ~locked, motion.z / legs.cos, motion.L)
    L = jnp.where(locked, s.L0, L)
    motion = motion._replace(L=L, dL=jnp.where(locked, 0.0, motion.dL))
    slots = slots_of(contact != OFF)
    airborne = locked & ~slots.filled
    hub = hub_of(s, motion, slots, airborne)
    free = free_velocity(s, motion, slots, hub)
    modes, held = slots.codes(contact), slots.flags(locked)
    zero = jnp.zeros_like(motion.theta)
    found = answer(s, hub, free, modes, held, zero)
    choice = Choice(modes, held, found, jnp.ones((), jnp.int32))
    return moved_by(s, motion, slots, hub, airborne, choice)
