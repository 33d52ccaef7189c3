"""What an event changes: impacts by momentum, then which feet and stoppers carry the motion on."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from vrw_jax.models.unilateral_contacts import (
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
from vrw_jax.models.unilateral_mechanics import (
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
from vrw_jax.models.unilateral_motion import Guards, Stance
from vrw_jax.params import Scalar, Symbols


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


def _impact(
    s: Symbols,
    friction: Scalar,
    motion: WheelMotion,
    stance: Stance,
    event: Event,
) -> tuple[WheelMotion, Slots, Choice, Legs]:
    """Velocity level: simultaneous, inelastic, with Coulomb's law in the impulse.

    Infinite friction keeps feet at rest planted when a leg meets its stopper, as the paper does.
    """
    touching = (stance.contact != OFF) | event.lands
    slots = slots_of(touching)
    at_stopper = stance.locked | event.closes
    in_slot = slots.first | slots.second
    airborne = at_stopper & ~in_slot
    hub = hub_of(s, motion, slots, airborne)
    free = free_velocity(s, motion, slots, hub)
    loaded = jnp.stack([jnp.any(slots.first), jnp.any(slots.second)])
    stops = jnp.stack(slots.of(at_stopper.astype(jnp.int32))) > 0
    before = jnp.stack(slots.of(stance.contact))
    planted = (before == STICK) & ~jnp.any(event.lands) & ~jnp.isfinite(friction)
    any_mode = jnp.asarray([True, True, True, True])
    only = lambda mode: jnp.arange(4) == mode
    modes = jnp.where(loaded[:, None], any_mode, only(OFF))
    allowed = Allowed(
        contact=jnp.where(planted[:, None], only(STICK), modes),
        held=jnp.stack([jnp.ones((2,), bool), stops], axis=1),
        known_contact=jnp.where(loaded[:, None], planted[:, None] & only(STICK), only(OFF)),
        known_open=~stops,
    )
    choice = choose(s, hub, free, allowed, friction)
    after = moved_by(s, motion, slots, hub, airborne, choice)
    jump_x, jump_z = after.vx - motion.vx, after.vz - motion.vz
    impulse = s.m * (hub.legs.sin * jump_x + hub.legs.cos * jump_z + motion.dL)
    return after, slots, choice, jnp.where(airborne, impulse, jnp.inf)


def _support(
    s: Symbols,
    friction: Scalar,
    motion: WheelMotion,
    contact: Int[Array, " n"],
    at_stopper: Bool[Array, " n"],
    event: Event,
) -> tuple[Slots, Choice, Array]:
    """Acceleration level: who carries the motion that follows. Also says which feet were at rest.

    What an event has just ended is not asked again: its force is zero, and its sign rounding. It
    is followed by what it was about to become, if that goes the right way (see `leaves`).
    """
    slots = slots_of(contact != OFF)
    in_slot = slots.first | slots.second
    hub = hub_of(s, motion, slots, at_stopper & ~in_slot)
    free = free_acceleration(s, motion, slots, hub)
    mode = jnp.stack(slots.of(contact))
    stops = jnp.stack(slots.of(at_stopper.astype(jnp.int32))) > 0
    only = lambda mode: jnp.arange(4) == mode
    rests = (mode == STICK) | event.stops
    modes = jnp.where(
        (mode == STICK)[:, None],
        jnp.ones((4,), bool),
        (jnp.arange(4) == mode[:, None]) | only(OFF),
    )
    back = jnp.where(mode == SLIP_DOWN, SLIP_UP, SLIP_DOWN)
    stopped = only(STICK) | only(OFF) | (jnp.arange(4) == back[:, None])
    modes = jnp.where(event.stops[:, None], stopped, modes)
    known = (jnp.arange(4) == mode[:, None]) & ~rests[:, None]
    rigid = (mode == STICK) & ~jnp.isfinite(friction)  # a tangential force jumps to zero
    up, down = event.slides_up, event.slides_down
    second = (event.lifts | up | down)[1]
    direction = jnp.any(down).astype(jnp.int32) - jnp.any(up).astype(jnp.int32)
    leaving = leaves(s, hub, free, (mode, stops), friction, second, direction)
    goes = (leaving & ~rigid)[:, None]
    for flags, forced, ended in (
        (event.lifts, OFF, mode),
        (up, SLIP_UP, jnp.full((2,), STICK)),
        (down, SLIP_DOWN, jnp.full((2,), STICK)),
    ):
        tested = ~(jnp.arange(4) == ended[:, None]) & (goes | rigid[:, None] | ~only(forced))
        modes = jnp.where(flags[:, None], jnp.where(goes, only(forced), tested), modes)
        known = jnp.where(flags[:, None], goes & only(forced), known)
    opens = ~stops | event.releases
    allowed = Allowed(
        contact=modes,
        held=jnp.stack([jnp.ones((2,), bool), ~opens], axis=1),
        known_contact=known,
        known_open=opens,
    )
    return slots, choose(s, hub, free, allowed, friction), rests


def resolve(
    s: Symbols,
    friction: Scalar,
    motion: WheelMotion,
    stance: Stance,
    event: Event,
) -> Change:
    """Everything that an event changes."""
    impact = event.impact
    touched = (stance.contact != OFF) | event.lands
    was_locked = (stance.locked | event.closes) & ~event.loosens
    after, slots, shock, impulses = _impact(s, friction, motion, stance, event)
    after = WheelMotion(*(jnp.where(impact, a, b) for a, b in zip(after, motion, strict=True)))
    in_slot = slots.first | slots.second
    contact = jnp.where(impact, slots.spread(shock.contact).astype(jnp.int32), stance.contact)
    kept = jnp.where(in_slot, slots.spread(shock.held) > 0, was_locked)
    at_stopper = jnp.where(impact, kept, was_locked)
    legs = directions(s, motion.theta)
    dropped = touched & ~in_slot
    foot_z = after.vz - after.dL * legs.cos + after.L * after.dtheta * legs.sin

    slots, support, rests = _support(s, friction, after, contact, at_stopper, event)
    in_slot = slots.first | slots.second
    contact = slots.spread(support.contact).astype(jnp.int32)
    locked = jnp.where(in_slot, slots.spread(support.held) > 0, at_stopper)
    slides = (support.contact == SLIP_DOWN) | (support.contact == SLIP_UP)
    stance = Stance(
        contact=contact,
        locked=locked,
        new_foot=touched & (contact == OFF),
        new_leg=(stance.locked | event.closes) & ~locked,
        new_slip=slots.spread(slides & rests) > 0,
    )
    lost = kinetic_energy(s, motion) - kinetic_energy(s, after)
    fewest = jnp.where(impact, jnp.minimum(shock.solutions, support.solutions), support.solutions)
    most = jnp.where(impact, jnp.maximum(shock.solutions, support.solutions), support.solutions)
    blank = lambda pair: (jnp.where(impact, pair[0], 0.0), jnp.where(impact, pair[1], 0.0))
    return Change(
        motion=after._replace(
            L=jnp.where(locked, s.L0, after.L), dL=jnp.where(locked, 0.0, after.dL)
        ),
        stance=stance,
        energy_lost=jnp.where(impact, lost, 0.0),
        normal_impulse=blank(shock.answer.normal),
        tangential_impulse=blank(shock.answer.tangential),
        stopper_impulse=jnp.where(impact, jnp.min(impulses), jnp.inf),
        solutions=fewest,
        most_solutions=most,
        third_foot=jnp.any(dropped & (foot_z < 0.0)) & impact,
    )


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
