"""Many wheels on real ground marching side by side, each with its own step size and stance.

Numbers lie in arrays with lanes last. One Runge-Kutta step serves marching and searching: a lane
whose step crosses a guard takes that step again, shortened, until it ends on the earliest event.
Nothing here looks from one lane to another.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from vrw_jax.models import (
    Felt,
    Flow,
    Stance,
    WheelMotion,
    directions,
    felt,
    flow_of,
    forces,
    kept,
    leg_acceleration,
    one_of,
    stance_guards,
)
from vrw_jax.numerics import Elementwise, Options, Tableau, dips, parabola
from vrw_jax.wheel import Outcome, Symbols

N_FELT = 8
"""Rows of a slope after the accelerations: what guards need of the forces. Then, where stoppers are
one-sided, those of legs in the air."""
MARCHING, EVENT, WAITING = -1, -2, -3
"""Where a lane stands: on its way, at an event, without a wheel; else the `Outcome` it met."""
SAFETY, LEAST, MOST = 0.9, 0.2, 5.0
"""Of the step-size controller: the usual safety factor, and the limits of a step's change."""
CLOSE = 30.0
"""An event is found where the last correction to its time is no more than so many tolerances of the
step: the proposal is a parabola's, whose own error is about a hundredth of the correction."""


class Place(NamedTuple):
    """Coordinates (hub x, z, theta, lengths), their rates, and the slope: accelerations, forces."""

    q: Array  # (3 + n, lanes)
    v: Array
    slope: Array  # (3 + n + N_FELT or 3 + n + N_FELT + n, lanes)


class Search(NamedTuple):
    """For the earliest event inside a step."""

    on: Array
    crossing: Array  # (guards, lanes)
    low: Array  # bracket of the event, s from the step's start
    high: Array
    accuracy: Array  # s
    tries: Array


class March(NamedTuple):
    """All lanes, between two of their events."""

    here: Place
    stance: Stance
    values: Array  # guards here, (guards, lanes)
    offset: Array  # what a guard that stands on its own event reads there: rounding
    h: Array  # of the next try, s
    time: Array  # since the last event, s
    search: Search
    verdict: Array  # MARCHING, EVENT, WAITING or an Outcome
    guard: Array  # at which it stands
    tried: Array  # steps since the last event


def motion_of(place: Place) -> WheelMotion:
    """The lanes' motions."""
    x, z, theta, L = place.q[0], place.q[1], place.q[2], place.q[3:]
    return WheelMotion(x, z, theta, place.v[0], place.v[1], place.v[2], L, place.v[3:])


def place_of(flow: Flow, motion: WheelMotion) -> Place:
    """The inverse of `motion_of`, with the slope there."""
    q = jnp.concatenate([jnp.stack([motion.x, motion.z, motion.theta]), motion.L])
    v = jnp.concatenate([jnp.stack([motion.vx, motion.vz, motion.dtheta]), motion.dL])
    return Place(q, v, _slope(flow, q, v))


def _slope(flow: Flow, q: Array, v: Array) -> Array:
    """Accelerations of all coordinates, then `Felt` without the directions."""
    motion = motion_of(Place(q, v, q))
    now = forces(flow, motion)
    told = felt(flow, now)
    ddL = kept(leg_acceleration(flow, now), one_of(motion))
    feet = [*told.normal, *told.tangential, *told.stopper, *told.speed]
    in_air = [] if told.in_air is None else [told.in_air]
    return jnp.concatenate([jnp.stack(now.answer.hub), ddL, jnp.stack(feet), *in_air])


def guards_at(flow: Flow, place: Place) -> Array:
    """All guards, in the order of `Guards`, whether or not the stance has just begun."""
    motion = motion_of(place)
    of_felt = place.slope[len(place.q) :]
    n1, n2, t1, t2, s1, s2, x1, x2 = of_felt[:N_FELT]
    in_air = of_felt[N_FELT:] if flow.one_sided else None
    now = Felt(directions(flow.s, motion.theta), (n1, n2), (t1, t2), (s1, s2), (x1, x2), in_air)
    begun = jnp.ones(place.q.shape[-1:], bool)
    return jnp.concatenate(stance_guards(flow, motion, now, begun))


def guard_rates(flow: Flow, place: Place) -> Array:
    """Derivatives of the guards in time along the motion."""

    def along(q: Array, v: Array) -> Array:
        return guards_at(flow, Place(q, v, _slope(flow, q, v)))

    return jax.jvp(along, (place.q, place.v), (place.v, place.slope[: len(place.q)]))[1]


def begun_guards(flow: Flow) -> Array:
    """Guards that stand on the event which has just begun the stance, in the order of `Guards`."""
    stance = flow.stance
    slid = jnp.stack(flow.slots.of(stance.new_slip.astype(jnp.int32))) > 0
    no = jnp.zeros((2, stance.contact.shape[-1]), bool)
    in_air = [stance.locked & False] if flow.one_sided else []
    return jnp.concatenate([stance.new_foot, stance.new_leg, no, no, no, slid, no, no, *in_air])


def march(
    s: Symbols,
    friction: Elementwise,
    one_sided: bool,
    begin: March,
    enough: Array | None,
    options: Options,
    tableau: Tableau,
) -> March:
    """On until `enough` lanes no longer march, or none does. Errors: as `integrate_phase`."""
    flow = flow_of(s, friction, one_sided, begin.stance)
    order, n = tableau.order, begin.here.q.shape[0]
    middle, last = tableau.middle, len(tableau.places) - 1

    def watched(place: Place, offset: Array) -> Array:
        return guards_at(flow, place) - offset

    once, twice, places = (jnp.asarray(x) for x in (tableau.once, tableau.twice, tableau.places))

    def goes_on(now: March) -> Array:
        if enough is None:
            return jnp.any(now.verdict == MARCHING)
        ended = (now.verdict != MARCHING) & (now.verdict != WAITING)
        return jnp.any(now.verdict == MARCHING) & (jnp.sum(ended) < enough)

    def advance(now: March) -> March:
        here, h, search = now.here, now.h, now.search

        def at(i: Array | int, slopes: Array) -> tuple[Array, Array]:
            a, b = once[i], twice[i]
            first = sum(a[j] * slopes[j, :n] for j in range(last))
            second = sum(b[j] * slopes[j, :n] for j in range(last))
            return here.q + h * (places[i] * here.v + h * second), here.v + h * first

        def stage(i: Array, slopes: Array) -> Array:
            slope = _slope(flow, *at(i, slopes))
            return lax.dynamic_update_index_in_dim(slopes, slope, i, 0)

        others = jnp.zeros((last, *here.slope.shape), h.dtype)
        slopes = jnp.concatenate([here.slope[None], others])
        slopes = lax.fori_loop(1, last + 1, stage, slopes)
        reached = lambda i: Place(*at(i, slopes), slopes[i])
        end, mid = reached(last), reached(middle)
        gm, g1 = (watched(place, now.offset) for place in (mid, end))
        g0 = now.values

        error = _squared_error(tableau, options, here, end, slopes, h, g1)
        power = jnp.exp(jnp.log(jnp.clip(error, 1e-20, 1e20)) * (-0.5 / order))
        running, marching = now.verdict == MARCHING, (now.verdict == MARCHING) & ~search.on
        keep = marching & (error <= 1.0)
        change = jnp.clip(SAFETY * power, LEAST, jnp.where(keep, MOST, 1.0))
        bend, slope = parabola(tableau, g0, gm, g1)
        crosses = g1 <= 0.0
        to_dip = _to_earliest_dip(g0, g1, slope, bend)
        retry = keep & (to_dip < 1.0) & (now.time + h * to_dip > now.time)
        crossed = keep & ~retry & jnp.any(crosses, axis=0)
        accepted = keep & ~retry & ~crossed

        crossing = jnp.where(search.on, search.crossing | crosses, crosses)
        first, guard = _earliest_root(g0, slope, bend, crossing)
        proposal = h * first
        past = jnp.any(crossing & crosses, axis=0)
        low = jnp.where(search.on & ~past, h, search.low)
        high = jnp.where(search.on & past, h, search.high)
        low, high = jnp.where(crossed, 0.0, low), jnp.where(crossed, h, high)
        resolution = 1e3 * jnp.finfo(h.dtype).eps * (now.time + h)
        accuracy = jnp.maximum(CLOSE * options.rtol * h, resolution)
        accuracy = jnp.where(search.on, search.accuracy, accuracy)
        within = (proposal >= low - accuracy) & (proposal <= high + accuracy)
        shift = proposal - h
        arrived = running & search.on & within & (jnp.abs(shift) <= accuracy)
        following = jnp.where(within, proposal, 0.5 * (low + high))
        following = jnp.where(search.on | crossed, following, h * jnp.where(retry, to_dip, change))

        moved = jnp.where(arrived, shift, 0.0)
        end = Place(end.q + moved * end.v, end.v + moved * end.slope[:n], end.slope)
        taken = accepted | arrived
        time = jnp.where(taken, now.time + h + moved, now.time)
        tries = jnp.where(search.on, search.tries + 1, 0)
        late = accepted & (time >= options.max_phase_time)
        late = late | (arrived & (time > options.max_phase_time))
        stuck = (tries >= options.event_steps) | (now.tried + 1 >= options.max_solver_steps)
        stuck = stuck | (~search.on & (now.time + following == now.time))
        verdict = jnp.where(stuck, Outcome.SOLVER_GAVE_UP, MARCHING)
        verdict = jnp.where(arrived, EVENT, verdict)
        verdict = jnp.where(late, Outcome.NO_TOUCHDOWN_IN_TIME, verdict)
        return March(
            here=Place(*(jnp.where(taken, a, b) for a, b in zip(end, here, strict=True))),
            stance=now.stance,
            values=jnp.where(accepted, g1, now.values),
            offset=now.offset,
            h=jnp.where(running, following, h),
            time=time,
            search=Search(
                on=(search.on | crossed) & ~arrived,
                crossing=jnp.where(running, crossing, search.crossing),
                low=jnp.where(running, low, search.low),
                high=jnp.where(running, high, search.high),
                accuracy=jnp.where(running, accuracy, search.accuracy),
                tries=jnp.where(running, tries, search.tries),
            ),
            verdict=jnp.where(running, verdict, now.verdict).astype(jnp.int32),
            guard=jnp.where(arrived, guard, now.guard),
            tried=now.tried + running,
        )

    return lax.while_loop(goes_on, advance, begin)


def _squared_error(
    tableau: Tableau,
    options: Options,
    here: Place,
    end: Place,
    slopes: Array,
    h: Array,
    guards: Array,
) -> Array:
    """Mean square of the error over its tolerance; infinite where the step went nowhere."""
    n = here.q.shape[0]
    weigh = lambda weights: sum(float(w) * slopes[j, :n] for j, w in enumerate(weights) if w != 0.0)
    total = 0.0 * jnp.sum(guards, axis=0)
    errors = h * h * weigh(tableau.error_twice), h * weigh(tableau.error_once)
    for error, a, b in zip(errors, here[:2], end[:2], strict=True):
        allowed = options.atol + options.rtol * jnp.maximum(jnp.abs(a), jnp.abs(b))
        total = total + jnp.sum(jnp.square(error / allowed), axis=0)
    return jnp.where(jnp.isfinite(total), total / (2 * n), jnp.inf)


def _to_earliest_dip(g0: Array, g1: Array, slope: Array, bend: Array) -> Array:
    """Share of the step up to where a guard that falls and rises again is lowest, if near zero.

    See `numerics.dips`. A guard that stands on its own event at the start has no such place.
    """
    low = dips(g0, g1, bend, slope) & (g0 > 0.0)
    place = -slope / jnp.where(low, 2.0 * bend, 1.0)
    return jnp.min(jnp.where(low, place, 1.0), axis=0)


def _earliest_root(g0: Array, slope: Array, bend: Array, crossing: Array) -> tuple[Array, Array]:
    """Where the first of the crossing guards' parabolas falls through zero, in step lengths, and
    which; infinite where none does ahead."""
    discriminant = slope * slope - 4.0 * bend * g0
    root = jnp.sqrt(jnp.maximum(discriminant, 0.0))
    falling = slope < 0.0
    over = jnp.where(falling, 2.0 * g0, -slope - root)
    under = jnp.where(falling, root - slope, 2.0 * bend)
    place = over / jnp.where(under == 0.0, 1.0, under)
    exists = crossing & (discriminant >= 0.0) & (under != 0.0) & (place > 0.0)
    first, guard = jnp.full_like(place[0], jnp.inf), jnp.zeros(place.shape[-1:], jnp.int32)
    for index in range(len(place)):
        earlier = exists[index] & (place[index] < first)
        first = jnp.where(earlier, place[index], first)
        guard = jnp.where(earlier, index, guard)
    return first, guard
