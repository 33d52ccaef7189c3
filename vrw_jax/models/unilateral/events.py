"""What an event changes: impacts by momentum, then which feet and stoppers carry the motion on."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
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
from vrw_jax.numerics import Elementwise, Scalar, select
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


def event_of(place: Guards, n: int, guard: Int[Array, ""]) -> Event:
    """The event of a guard's index."""
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


MOST_SWITCHES = 40
"""Rounds in search of the stoppers that hold; a few are enough unless friction is paradoxical."""


def _that_push(
    solve: Callable[[Array], tuple[Any, Legs, Legs]], at_stopper: Array, asked: Array
) -> tuple[Any, Array, Array]:
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

    shapes = jax.eval_shape(solve, at_stopper)[0]
    empty = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
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
    in_slot = slots.first | slots.second
    dL = free.legs + hub.legs.sin * vx + hub.legs.cos * vz
    dL = jnp.where(in_slot, slots.spread(choice.answer.length), jnp.where(airborne, 0.0, dL))
    return motion._replace(vx=vx, vz=vz, dtheta=dtheta, dL=dL)


class Law(NamedTuple):
    """What is asked of all events alike."""

    one_sided: bool  # stoppers of legs in the air only push
    counted: bool  # whether `solutions` is the number of admissible ones, or says if there is one


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


def _impact(
    s: Symbols,
    friction: Scalar,
    motion: WheelMotion,
    stance: Stance,
    event: Event,
    law: Law,
    stay: Staying,
) -> tuple[_Shock, Slots, Bool[Array, " n"]]:
    """Velocity level: simultaneous, inelastic, with Coulomb's law in the impulse.

    Also says which legs in the air are held: with one-sided stoppers those that need not pull, and
    those that `stay`. Infinite friction keeps feet at rest planted when a leg meets its stopper, as
    the paper does.
    """
    touching = (stance.contact != OFF) | event.lands
    slots = slots_of(touching)
    at_stopper = stance.locked | event.closes
    in_slot = slots.first | slots.second
    loaded = jnp.stack([jnp.any(slots.first), jnp.any(slots.second)])
    stops = jnp.stack(slots.of(at_stopper.astype(jnp.int32))) > 0
    before = jnp.stack(slots.of(stance.contact))
    planted = (before == STICK) & ~jnp.any(event.lands) & ~jnp.isfinite(friction)
    any_mode = jnp.asarray([True, True, True, True])
    only = lambda mode: jnp.arange(4) == mode
    modes = jnp.where(loaded[:, None], any_mode, only(OFF))
    planted = planted | (jnp.stack(slots.of(stay.feet.astype(jnp.int32))) > 0)
    modes = jnp.where(planted[:, None], jnp.arange(4) == before[:, None], modes)
    allowed = Allowed(
        contact=modes & event.impact,  # else nothing is to be looked at
        held=jnp.stack([jnp.ones((2,), bool), stops], axis=1),
        stays=planted,
        known_contact=~loaded[:, None] & only(OFF),
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

    airborne = at_stopper & ~in_slot
    if not law.one_sided:
        return solve(airborne)[0], slots, airborne
    shock, held, right = _that_push(solve, airborne, airborne & ~stay.legs & event.impact)
    return shock._replace(choice=_if(right, shock.choice)), slots, held


def _if(right: Array, choice: Choice) -> Choice:
    """The same, not admissible where the stoppers in the air found no right signs."""
    return choice._replace(solutions=jnp.where(right, choice.solutions, 0))


def _support(
    s: Symbols,
    friction: Scalar,
    motion: WheelMotion,
    contact: Int[Array, " n"],
    at_stopper: Bool[Array, " n"],
    event: Event,
    law: Law,
) -> tuple[Choice, Slots, Array, Bool[Array, " n"], Thrown]:
    """Acceleration level: who carries the motion that follows.

    Also says which feet were at rest, which legs in the air are held, and how what is off comes
    back. What an event has just ended is not asked again: its force is zero, and its sign rounding.
    It is followed by what it was about to become, if that goes the right way (see `leaves`).
    """
    slots = slots_of(contact != OFF)
    in_slot = slots.first | slots.second
    mode = jnp.stack(slots.of(contact))
    stops = jnp.stack(slots.of(at_stopper.astype(jnp.int32))) > 0
    only = lambda mode: jnp.arange(4) == mode
    rests = (mode == STICK) | event.stops
    ways = jnp.where(
        (mode == STICK)[:, None],
        jnp.ones((4,), bool),
        (jnp.arange(4) == mode[:, None]) | only(OFF),
    )
    back = jnp.where(mode == SLIP_DOWN, SLIP_UP, SLIP_DOWN)
    stopped = only(STICK) | only(OFF) | (jnp.arange(4) == back[:, None])
    ways = jnp.where(event.stops[:, None], stopped, ways)
    moves = (jnp.arange(4) == mode[:, None]) & ~rests[:, None]
    rigid = (mode == STICK) & ~jnp.isfinite(friction)  # a tangential force jumps to zero
    up, down = event.slides_up, event.slides_down
    second = (event.lifts | up | down)[1]
    direction = jnp.any(down).astype(jnp.int32) - jnp.any(up).astype(jnp.int32)
    opens = ~stops | event.releases

    def solve(airborne: Array) -> tuple[tuple[Choice, Thrown], Legs, Legs]:
        hub = hub_of(s, motion, slots, airborne)
        free = free_acceleration(s, motion, slots, hub)
        leaving = leaves(s, hub, free, (mode, stops), friction, second, direction)
        goes = (leaving & ~rigid)[:, None]
        modes, known = ways, moves
        for flags, forced, ended in (
            (event.lifts, OFF, mode),
            (up, SLIP_UP, jnp.full((2,), STICK)),
            (down, SLIP_DOWN, jnp.full((2,), STICK)),
        ):
            tested = ~(jnp.arange(4) == ended[:, None]) & (goes | rigid[:, None] | ~only(forced))
            modes = jnp.where(flags[:, None], jnp.where(goes, only(forced), tested), modes)
            known = jnp.where(flags[:, None], goes & only(forced), known)
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

    airborne = at_stopper & ~in_slot
    if not law.one_sided:
        choice, thrown = solve(airborne)[0]
        return choice, slots, rests, airborne, thrown
    (choice, thrown), held, right = _that_push(solve, airborne, airborne)
    return _if(right, choice), slots, rests, held, thrown


def resolve(
    s: Symbols,
    friction: Scalar,
    motion: WheelMotion,
    stance: Stance,
    event: Event,
    law: Law,
    unseen: Elementwise,
) -> Change:
    """Everything that an event changes.

    What an impact throws off the ground, or off a stopper that only pushes, comes back: where it
    would go no farther than `unseen`, m, it stays. It would give the hub its momentum a moment
    later, so the motion is the same to about `unseen`; else each return throws others off, ever
    less, without end.
    """
    nothing = Staying(stance.locked & False, stance.locked & False)
    legs = directions(s, motion.theta)

    def again(now: tuple) -> tuple:
        stay, _, _ = now
        change, back = _resolved(s, friction, motion, stance, event, law, stay)
        after, now_stance = change.motion, change.stance
        rise = after.vz - after.dL * legs.cos + after.L * after.dtheta * legs.sin
        returns = lambda speed, back: (back > 0.0) & (speed**2 < 2.0 * back * unseen)
        in_air = now_stance.contact == OFF
        more = Staying(
            now_stance.new_leg & in_air & returns(after.dL, back.legs) & law.one_sided,
            now_stance.new_foot & (stance.contact != OFF) & returns(rise, back.feet),
        )
        new = jnp.any(more.legs & ~stay.legs) | jnp.any(more.feet & ~stay.feet)
        stay = Staying(stay.legs | more.legs, stay.feet | more.feet)
        return stay, new & event.impact, change

    blank = lambda leaf: jnp.zeros(leaf.shape, leaf.dtype)
    resolved = lambda: _resolved(s, friction, motion, stance, event, law, nothing)
    shapes = jax.eval_shape(resolved)
    begin = nothing, jnp.asarray(True), jax.tree.map(blank, shapes[0])
    return lax.while_loop(lambda now: now[1], again, begin)[2]


def _resolved(
    s: Symbols,
    friction: Scalar,
    motion: WheelMotion,
    stance: Stance,
    event: Event,
    law: Law,
    stay: Staying,
) -> tuple[Change, Thrown]:
    """`resolve` where some stay whatever it takes; also how what was thrown off comes back."""
    impact = event.impact
    touched = (stance.contact != OFF) | event.lands
    was_locked = (stance.locked | event.closes) & ~event.loosens
    shock, slots, held = _impact(s, friction, motion, stance, event, law, stay)
    after = select(impact, shock.after, motion)
    in_slot = slots.first | slots.second
    struck = slots.spread(shock.choice.contact).astype(jnp.int32)
    contact = jnp.where(impact, struck, stance.contact)
    kept = jnp.where(in_slot, slots.spread(shock.choice.held) > 0, was_locked & held)
    at_stopper = jnp.where(impact, kept, was_locked)
    legs = directions(s, motion.theta)
    dropped = touched & ~in_slot
    foot_z = after.vz - after.dL * legs.cos + after.L * after.dtheta * legs.sin

    support, slots, rests, held, back = _support(
        s, friction, after, contact, at_stopper, event, law
    )
    in_slot = slots.first | slots.second
    contact = slots.spread(support.contact).astype(jnp.int32)
    locked = jnp.where(in_slot, slots.spread(support.held) > 0, at_stopper & held)
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
    airborne = locked & ~slots.first & ~slots.second
    hub = hub_of(s, motion, slots, airborne)
    free = free_velocity(s, motion, slots, hub)
    modes, held = jnp.stack(slots.of(contact)), jnp.stack(slots.of(locked.astype(jnp.int32))) > 0
    zero = jnp.zeros_like(motion.theta)
    found = answer(s, hub, free, modes, held, zero)
    choice = Choice(modes, held, found, jnp.ones((), jnp.int32))
    return moved_by(s, motion, slots, hub, airborne, choice)
