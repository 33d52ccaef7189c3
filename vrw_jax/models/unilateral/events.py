"""Effects of an event: impacts by momentum, then the contact modes that carry the motion.

Everything is elementwise: for one wheel or a batch.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Int

from vrw_jax.models.unilateral.carrying import Carried, Stand, in_impact, in_motion, told_by
from vrw_jax.models.unilateral.contacts import (
    ACCEPTED,
    ANY_MODE,
    OFF,
    SLIP_DOWN,
    SLIP_UP,
    STICK,
    THE_PAPERS,
    Allowed,
    Chosen,
    Negligible,
    Roughness,
    choose,
    leaves,
)
from vrw_jax.models.unilateral.mechanics import (
    Free,
    Hub,
    Legs,
    Pair,
    Slots,
    WheelMotion,
    directions,
    foot_heights,
    foot_speeds,
    foot_velocity,
    free_acceleration,
    free_velocity,
    hub_of,
    kinetic_energy,
    of_slots,
    slots_of,
    stilled,
)
from vrw_jax.models.unilateral.motion import Guards, Stance, as_row
from vrw_jax.numerics import Elementwise, if_any, select
from vrw_jax.wheel import Symbols


class Event(NamedTuple):
    """Kind of an event: one flag is set."""

    lands: Bool[Array, "n_legs ..."]  # the foot meets the ground
    closes: Bool[Array, "n_legs ..."]  # the leg meets its stopper
    loosens: Bool[Array, "n_legs ..."]  # in the air, the stopper force vanishes
    lifts: Bool[Array, "2 ..."]  # the slot's normal force vanishes
    slides_up: Bool[Array, "2 ..."]  # friction no longer holds the slot's foot
    slides_down: Bool[Array, "2 ..."]
    stops: Bool[Array, "2 ..."]  # the slot's foot stops sliding
    releases: Bool[Array, "2 ..."]  # the stopper force of the slot's leg vanishes

    @property
    def impact(self) -> Bool[Array, "..."]:
        """Whether velocities jump."""
        return jnp.any(self.lands, axis=0) | jnp.any(self.closes, axis=0)


def _counted(n: int, like: Array) -> np.ndarray:
    """Return 0 ... n - 1 on the first axis, for arrays of this shape."""
    return np.arange(n, dtype=np.int32).reshape(-1, *(1,) * jnp.ndim(like))


def event_of(place: Guards, guard: Int[Array, "..."]) -> Event:
    """Return the event of a guard."""
    n = place.n_legs
    flags = lambda start, count: guard == start + _counted(count, guard)
    loosens = flags(place.loosen, n) if place.total > place.loosen else flags(place.foot, n) & False
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
    """The wheel on its ground, with the settings that all events share."""

    s: Symbols
    friction: Roughness  # of all feet; or (of the last landed foot, of the others)
    one_sided: bool  # stoppers of legs in the air only push
    counted: bool  # whether all admissible solutions are counted
    rest: Elementwise  # contacts slower than this after an impact are at rest, m/s
    restitution: Elementwise | None = None  # of the feet: speed ratio
    tilt: Elementwise | None = None  # by which the ground ahead is steeper, rad


AT_ONCE, IN_TURN = 8, 16
"""Numbers of block pivots and single pivots in the search for the holding stoppers; a few suffice
unless friction couples the legs."""
MOST_LEGS = 8
"""Largest number of legs on stoppers whose combinations are enumerated if pivoting fails."""


class _Solved(NamedTuple):
    """Solution for an assumed set of held legs in the air."""

    chosen: Chosen
    answer: Carried
    push: Legs  # of the stoppers, N or N s
    outward: Legs  # of the legs, m/s^2 or m/s
    motion: WheelMotion  # of an impact: after it


_Solve = Callable[[Law, WheelMotion, Array, Chosen | None], _Solved]
"""Function of the held legs in the air and, if known, of the chosen combination."""


def _that_push(
    solve: _Solve,
    law: Law,
    motion: WheelMotion,
    at_stopper: Array,
    asked: Array,
    small: Negligible,
) -> tuple[_Solved, Array]:
    """Return the solution for the legs in the air that are held, and which legs are held.

    Of the legs `at_stopper`, those in `is_tested` are held if their stopper pushes; otherwise they
    move inwards. All legs of the wrong sign switch together. Then, against cycling, only the last
    one switches. This is principal pivoting, which is finite if no friction couples the legs (Murty
    1974, Kostreva 1978). After that, all combinations are enumerated. The least violating solution
    is taken; it is admissible if its violation is at most `MAX_VIOLATION`.
    """
    still = stilled((law, motion))
    rank = jnp.cumsum(asked.astype(jnp.int32), axis=0) - 1
    many = 1 << jnp.minimum(jnp.sum(asked, axis=0, dtype=jnp.int32), MOST_LEGS)
    place = _counted(len(at_stopper), many)

    def goes_on(now: tuple) -> Array:
        _, code, tries, best = now
        return (tries == 0) | ((best[0] > 1.0) & (code < many))

    def switch(now: tuple) -> tuple:
        held, code, tries, best = now
        found = solve(still[0], still[1], held, None)
        off = jnp.where(held, -found.push / small.force, found.outward / small.motion)
        off = jnp.where(asked, lax.stop_gradient(off), 0.0)
        wrong = off > 1.0
        worst = jnp.maximum(jnp.max(off, axis=0), found.chosen.wrong)
        best = select(worst < best[0], (worst, held, found.chosen), best)
        last = place == jnp.max(jnp.where(wrong, place, -1), axis=0)
        pivoted = held ^ jnp.where(tries < AT_ONCE, wrong, last)
        pivots = (code < 0) & jnp.any(wrong, axis=0) & (tries < AT_ONCE + IN_TURN)
        code = jnp.where(pivots, code, code + 1)
        counted = jnp.where(asked, ((code >> rank) & 1) == 1, at_stopper)
        return select(
            goes_on(now), (jnp.where(pivots, pivoted, counted), code, tries + 1, best), now
        )

    none, two = jnp.zeros_like(many), jnp.stack([many, many]) * 0
    far = jnp.full_like(still[1].theta, jnp.inf)
    begin = at_stopper, none - 1, none, (far, at_stopper, Chosen(two, two > 0, far, none))
    found = lax.while_loop(lambda now: jnp.any(goes_on(now)), switch, begin)
    worst, held, chosen = found[3]
    chosen = chosen._replace(solutions=jnp.where(worst <= ACCEPTED, chosen.solutions, 0))
    return solve(law, motion, held, chosen), held


class Change(NamedTuple):
    """Result of an event."""

    motion: WheelMotion
    stance: Stance
    energy_lost: Elementwise  # J
    normal_impulse: Pair  # on the slots' feet, N s
    tangential_impulse: Pair
    stopper_impulse: Elementwise  # minimum over airborne locked legs, N s; inf without an impact
    solutions: Int[Array, "..."]  # admissible combinations: the minimum of both levels
    paradox: Bool[Array, "..."]  # no forces can continue the motion
    most_solutions: Int[Array, "..."]
    third_foot: Bool[Array, "..."]  # a third foot would have to be loaded


def _after(motion: WheelMotion, found: Carried) -> WheelMotion:
    """Return the motion with the velocities of an impact's solution."""
    vx, vz, dtheta = found.hub
    return motion._replace(vx=vx, vz=vz, dtheta=dtheta, dL=found.lengths)


def _thrown_back(law: Law, motion: WheelMotion, slots: Slots, hub: Hub, free: Free) -> Free:
    """Return the free velocities with the rebound of striking feet by Newton's law."""
    if law.restitution is None:
        return free
    back = [law.restitution * z for z in foot_velocity(motion, slots, hub).z]
    # A rebound slower than the rest speed is at rest.
    back = [jnp.where(z < -law.rest, z, 0.0) for z in back]
    return free._replace(
        e=(free.e[0] - hub.sin[0] * back[0], free.e[1] - hub.sin[1] * back[1]),
        u=(free.u[0] + hub.cos[0] * back[0], free.u[1] + hub.cos[1] * back[1]),
    )


def _without_gain(law: Law, motion: WheelMotion, thrown: _Solved, inelastic: _Solved) -> _Solved:
    """Return the part of Newton's rebound that energy allows.

    With Coulomb's friction the law can create energy (Kane 1984). Energy is a parabola between the
    inelastic impact, which cannot create any, and Newton's. The result is the largest part without
    a gain. Impulses stay in the cone, because it is convex.
    """
    energy = lambda at: kinetic_energy(law.s, at)
    low, high = energy(inelastic.motion), energy(thrown.motion)
    half = energy(jax.tree.map(lambda a, b: 0.5 * (a + b), inelastic.motion, thrown.motion))
    bend, slope = 2.0 * (low - 2.0 * half + high), 4.0 * half - 3.0 * low - high
    room = jnp.maximum(energy(motion) - low, 0.0)
    gains = high > energy(motion)
    root = jnp.sqrt(jnp.where(gains, slope * slope + 4.0 * bend * room, 1.0))
    share = jnp.where(gains, 2.0 * room / jnp.where(gains, slope + root, 1.0), 1.0)
    mixed = lambda a, b: jnp.where(gains, a + share * (b - a), b)
    return _Solved(thrown.chosen, *jax.tree.map(mixed, inelastic[1:], thrown[1:]))


def _impact(
    law: Law, motion: WheelMotion, stance: Stance, event: Event
) -> tuple[_Solved, Slots, Bool[Array, "n ..."]]:
    """Return the velocity-level solution: simultaneous and inelastic, with Coulomb's law for
    impulses.

    It also returns the held legs in the air: with one-sided stoppers, those that need not pull. The
    paper's rule keeps resting feet planted when a leg meets its stopper.
    """
    s, slots = law.s, slots_of((stance.contact != OFF) | event.lands)
    friction = of_slots(law.friction, slots)
    at_stopper = stance.locked | event.closes
    loaded = jnp.stack([jnp.any(slots.first, axis=0), jnp.any(slots.second, axis=0)])
    stops, before = slots.flags(at_stopper), slots.codes(stance.contact)
    lands = jnp.any(event.lands, axis=0)
    planted = (before == STICK) & ~lands & (as_row(friction) == THE_PAPERS)
    modes = jnp.where(loaded, ANY_MODE, 1 << OFF).astype(jnp.int32)
    modes = jnp.where(planted, 1 << before, modes)
    allowed = Allowed(
        contact=jnp.where(event.impact, modes, 0),  # without an impact, no mode is examined
        held=stops,
        stays=planted,
        known_contact=jnp.where(loaded, 0, 1 << OFF).astype(jnp.int32),
        known_open=~stops,
    )
    small = Negligible(s.m * law.rest / ACCEPTED, law.rest / ACCEPTED)

    def solve(law: Law, motion: WheelMotion, airborne: Array, chosen: Chosen | None) -> _Solved:
        s, friction = law.s, of_slots(law.friction, slots)
        legs, hub = directions(s, motion.theta), hub_of(s, motion, slots, airborne)
        free = free_velocity(s, motion, slots, hub)
        given = _thrown_back(law, motion, slots, hub, free)
        if chosen is None:
            chosen = choose(s, hub, given, allowed, friction, small, law.counted)
        stand = Stand(s, motion, friction, slots, chosen.contact, chosen.held, airborne)
        found = in_impact(stand) if law.restitution is None else told_by(stand, hub, given)
        after = _after(motion, found)
        jump_x, jump_z = after.vx - motion.vx, after.vz - motion.vz
        impulse = s.m * (legs.sin * jump_x + legs.cos * jump_z + motion.dL)
        return _Solved(chosen, found, impulse, after.dL, after)

    airborne = at_stopper & ~slots.filled
    if not law.one_sided:
        return solve(law, motion, airborne, None), slots, airborne
    asked = airborne & event.impact
    found, held = _that_push(solve, law, motion, airborne, asked, small)
    return found, slots, held


def _following(
    event: Event, mode: Array, goes: Array, rigid: Array
) -> tuple[Int[Array, "2 ..."], Int[Array, "2 ..."]]:
    """Return the modes that may follow an event in each slot, and those that need no test, as bits.

    - `is_consistent`: the next mode of a slot's foot has the direction of release (see
      `is_release_consistent`).
    """
    own, off = 1 << mode, 1 << OFF
    modes = jnp.where(mode == STICK, ANY_MODE, own | off)
    back = jnp.where(mode == SLIP_DOWN, 1 << SLIP_UP, 1 << SLIP_DOWN)
    modes = jnp.where(event.stops, 1 << STICK | off | back, modes)
    known = jnp.where((mode == STICK) | event.stops, 0, own)
    for flags, following, ended in (
        (event.lifts, off, own),
        (event.slides_up, 1 << SLIP_UP, 1 << STICK),
        (event.slides_down, 1 << SLIP_DOWN, 1 << STICK),
    ):
        tested = ANY_MODE & ~ended & jnp.where(goes | rigid, ANY_MODE, ~following)
        modes = jnp.where(flags, jnp.where(goes, following, tested), modes)
        known = jnp.where(flags, jnp.where(goes, following, 0), known)
    return modes, known


SOUND = 1e-9
"""Fraction of the wheel's weight, and of gravity, that counts as zero, chosen because forces are
accurate to rounding."""


def _support(
    law: Law, motion: WheelMotion, contact: Int[Array, "n ..."], at_stopper: Array, event: Event
) -> tuple[Chosen, Slots, Array, Bool[Array, "n ..."]]:
    """Return the acceleration-level solution: the contacts that carry the following motion.

    It also returns the feet that were at rest, and the held legs in the air. The contact that an
    event has just ended is not tested again: its force is zero up to rounding. It is followed by
    the mode of its release, if that is consistent (see `is_release_consistent`). The result has no
    derivatives.
    """
    law, motion = stilled((law, motion))
    s, slots = law.s, slots_of(contact != OFF)
    friction = of_slots(law.friction, slots)
    mode, stops = slots.codes(contact), slots.flags(at_stopper)
    rests = (mode == STICK) | event.stops
    # At the release of such a foot, its tangential force jumps to zero.
    rigid = (mode == STICK) & (as_row(friction) == THE_PAPERS)
    up, down = event.slides_up, event.slides_down
    second = (event.lifts | up | down)[1]
    one_of = lambda flags: jnp.any(flags, axis=0).astype(jnp.int32)
    direction = one_of(down) - one_of(up)
    opens = ~stops | event.releases
    small = Negligible(SOUND * s.Mt * s.g, SOUND * s.g)

    def solve(law: Law, motion: WheelMotion, airborne: Array, chosen: Chosen | None) -> _Solved:
        hub = hub_of(s, motion, slots, airborne)
        free = free_acceleration(s, motion, slots, hub)
        if chosen is None:
            leaving = leaves(s, hub, free, (mode, stops), friction, second, direction)
            modes, known = _following(event, mode, leaving & ~rigid, rigid)
            allowed = Allowed(modes, ~opens, rests & False, known, opens)
            chosen = choose(s, hub, free, allowed, friction, small, law.counted)
        stand = Stand(s, motion, friction, slots, chosen.contact, chosen.held, airborne)
        found = told_by(stand, hub, free)
        ax, az, _ = found.hub
        outward = free.legs + hub.legs.sin * ax + hub.legs.cos * az
        return _Solved(chosen, found, s.m * outward, outward, motion)

    airborne = at_stopper & ~slots.filled
    if not law.one_sided:
        return solve(law, motion, airborne, None).chosen, slots, rests, airborne
    found, held = _that_push(solve, law, motion, airborne, airborne, small)
    return found.chosen, slots, rests, held


def _at_rest(
    law: Law, motion: WheelMotion, slots: Slots, contact: Array, at_stopper: Array, struck: Array
) -> tuple[WheelMotion, Array, Array]:
    """Return the motion after an impact, the modes of the touching feet, and the legs on their
    stoppers.

    A contact slower than `ContactLaw.rest_speed` after the impact is at rest. Otherwise it would
    return after a dip too small to follow, and separate again at a lower speed, without end. The
    forces decide the contacts of the following motion.

    - `was_locked`: legs that were at their stoppers.
    """
    legs = directions(law.s, motion.theta)
    along, off = foot_speeds(motion, legs)
    stays = slots.filled & (off < law.rest)
    slips = jnp.where(along > 0.0, SLIP_DOWN, SLIP_UP)
    mode = jnp.where(jnp.abs(along) < law.rest, STICK, slips)
    mode = jnp.where(stays, jnp.where(contact == STICK, STICK, mode), OFF)
    on = at_stopper | (struck & (jnp.abs(motion.dL) < law.rest))
    new = jnp.any((mode != contact) | (on != at_stopper), axis=0)
    s, still, friction = stilled((law.s, motion, law.friction))

    def turned(_: Array) -> Array:
        """Return the feet whose slip would be reversed by this: they come to rest as well."""
        after, _ = foot_speeds(settled(s, still, mode, on, friction), legs)
        return ((mode == SLIP_DOWN) & (after < 0.0)) | ((mode == SLIP_UP) & (after > 0.0))

    turns = new & if_any(jnp.any(new), turned, on & False)
    mode = jnp.where(turns, STICK, mode)
    return select(new, settled(law.s, motion, mode, on, law.friction), motion), mode, on


def _joined(law: Law, motion: WheelMotion, stance: Stance, event: Event) -> Event:
    """Return the event extended to everything that touches, whether or not its own guard is zero.

    A contact touches if it is closer than the smallest followed dip and does not separate. Resolved
    one by one, such contacts would throw each other off forever.
    """
    s, legs = law.s, directions(law.s, motion.theta)
    near = law.rest**2 / (2.0 * s.g)
    low = (foot_heights(motion, legs) <= near) & (foot_speeds(motion, legs)[1] <= law.rest)
    lands = event.lands | (low & (stance.contact == OFF) & event.impact)
    few = jnp.sum(lands | (stance.contact != OFF), axis=0, dtype=jnp.int32) <= 2
    out = (near >= s.L0 - motion.L) & (motion.dL >= -law.rest)
    closes = event.closes | (out & ~stance.locked & event.impact)
    return event._replace(lands=jnp.where(few, lands, event.lands), closes=closes)


def _sided(law: Law, motion: WheelMotion, stance: Stance, event: Event) -> Event:
    """Return the event with lift-off replaced by slip, in the limit of large friction.

    A resting foot whose normal force vanishes begins to slide in the direction that its tangential
    force no longer resists.
    """
    law, motion = stilled((law, motion))
    slots = slots_of(stance.contact != OFF)
    friction, mode = of_slots(law.friction, slots), slots.codes(stance.contact)
    slides = event.lifts & (mode == STICK) & (as_row(friction) == jnp.inf)
    stops = slots, mode, slots.flags(stance.locked), stance.locked & ~slots.filled
    forces = lambda _: in_motion(Stand(law.s, motion, friction, *stops)).tangential
    none = jnp.zeros_like(motion.theta), jnp.zeros_like(motion.theta)
    uphill = jnp.stack(if_any(jnp.any(slides), forces, none)) > 0.0
    return event._replace(
        lifts=event.lifts & ~slides,
        slides_up=event.slides_up | (slides & uphill),
        slides_down=event.slides_down | (slides & ~uphill),
    )


def resolve(law: Law, motion: WheelMotion, stance: Stance, event: Event) -> Change:
    """Return the result of an event."""
    event = _joined(law, motion, stance, _sided(law, motion, stance, event))
    s, impact = law.s, event.impact
    touched = (stance.contact != OFF) | event.lands
    was_locked = (stance.locked | event.closes) & ~event.loosens
    shock, slots, held = _impact(law, motion, stance, event)
    if law.restitution is not None:
        inelastic = _impact(law._replace(restitution=None), motion, stance, event)[0]
        shock = _without_gain(law, motion, shock, inelastic)
    struck = slots.spread(shock.chosen.contact).astype(jnp.int32)
    kept = jnp.where(slots.filled, slots.spread(shock.chosen.held) > 0, was_locked & held)
    if law.restitution is not None:  # only a part of the impulse may act
        kept = kept & (jnp.abs(shock.motion.dL) < law.rest)
    left = _at_rest(law, shock.motion, slots, struck, kept, was_locked)
    after, contact, at_stopper = select(impact, left, (motion, stance.contact, was_locked))
    legs = directions(s, motion.theta)
    dropped = touched & ~slots.filled
    lost = kinetic_energy(s, motion) - kinetic_energy(s, after)
    impulse = jnp.where(held, shock.push, jnp.inf)

    support, slots, rests, held = _support(law, after, contact, at_stopper, event)
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
    shocked, stands = shock.chosen.solutions, support.solutions
    blank = lambda pair: (jnp.where(impact, pair[0], 0.0), jnp.where(impact, pair[1], 0.0))
    return Change(
        motion=after._replace(
            L=jnp.where(locked, s.L0, after.L), dL=jnp.where(locked, 0.0, after.dL)
        ),
        stance=stance,
        energy_lost=jnp.where(impact, lost, 0.0),
        normal_impulse=blank(shock.answer.normal),
        tangential_impulse=blank(shock.answer.tangential),
        stopper_impulse=jnp.where(impact, jnp.min(impulse, axis=0), jnp.inf),
        solutions=jnp.where(impact, jnp.minimum(shocked, stands), stands),
        paradox=(stands == 0) & ((shocked > 0) | ~impact),
        most_solutions=jnp.where(impact, jnp.maximum(shocked, stands), stands),
        third_foot=jnp.any(dropped & (foot_speeds(after, legs)[1] < 0.0), axis=0) & impact,
    )


def settled(
    s: Symbols,
    motion: WheelMotion,
    contact: Int[Array, "n ..."],
    locked: Bool[Array, "n ..."],
    friction: Any = None,
) -> WheelMotion:
    """Return the motion projected onto its contacts: loaded feet on the slope, sticking ones at
    rest.

    Velocities are projected by bilateral, frictionless impulses. A motion that already satisfies
    its contacts is unchanged up to round-off.
    """
    legs = directions(s, motion.theta)
    L = jnp.where((contact != OFF) & ~locked, motion.z / legs.cos, motion.L)
    motion = motion._replace(L=jnp.where(locked, s.L0, L))
    slots = slots_of(contact != OFF)
    airborne = locked & ~slots.filled
    modes, held = slots.codes(contact), slots.flags(locked)
    # Two resting feet on two held legs would constrain the hub twice.
    twice = jnp.all((modes == STICK) & held, axis=0)
    held = jnp.stack([held[0], held[1] & ~twice])
    rough = jnp.zeros_like(motion.theta) if friction is None else of_slots(friction, slots)
    stand = Stand(s, motion, rough, slots, modes, held, airborne)
    moved = _after(motion, in_impact(stand))
    return moved._replace(dL=jnp.where(locked, 0.0, moved.dL))
