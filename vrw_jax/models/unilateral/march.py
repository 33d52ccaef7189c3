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

from vrw_jax.models.unilateral.mechanics import WheelMotion, directions, kept, one_of
from vrw_jax.models.unilateral.motion import (
    Felt,
    Flow,
    Stance,
    felt,
    forces,
    guard_sizes,
    leg_acceleration,
    stance_guards,
)
from vrw_jax.numerics import (
    ROUNDING,
    Options,
    Tableau,
    change_of_length,
    dips,
    parabola,
    select,
)
from vrw_jax.wheel import Outcome

N_FELT = 8
"""Rows of a slope after the accelerations: what guards need of the forces. Then, where stoppers are
one-sided, those of legs in the air."""
MARCHING, EVENT, WAITING = -1, -2, -3
"""Where a lane stands: on its way, at an event, without a wheel; else the `Outcome` it met."""
PARABOLAS = 3
"""Tries at an event by parabolas; then by secants, which in stiff dips are better."""
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
    last: Array  # step tried before this one, s
    values: Array  # guards at its end, (guards, lanes)


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
    slid = flow.slots.flags(stance.new_slip)
    no = jnp.zeros((2, stance.contact.shape[-1]), bool)
    in_air = [stance.locked & False] if flow.one_sided else []
    return jnp.concatenate([stance.new_foot, stance.new_leg, no, no, no, slid, no, no, *in_air])


def set_off(flow: Flow, motion: WheelMotion, h: Array) -> March:
    """Lanes at the start of a stance, at an event again where a guard falls at once."""
    here, begun = place_of(flow, motion), begun_guards(flow)
    values, rates = guards_at(flow, here), guard_rates(flow, here)
    past = ~begun & ((values < 0.0) | ((values == 0.0) & (rates <= 0.0)))
    offset = jnp.where(begun, values, 0.0)
    zero, none = jnp.zeros_like(motion.x), jnp.zeros(motion.x.shape, jnp.int32)
    return March(
        here=here,
        stance=flow.stance,
        values=values - offset,
        offset=offset,
        h=zero + h,
        time=zero,
        search=Search(none > 0, jnp.zeros_like(begun), zero, zero, zero, none, zero, values),
        verdict=jnp.where(jnp.any(past, axis=0), EVENT, MARCHING).astype(jnp.int32),
        guard=jnp.argmax(past, axis=0).astype(jnp.int32),
        tried=none,
    )


def marched(
    flow: Flow, begin: March, enough: Array | None, options: Options, tableau: Tableau
) -> March:
    """On until `enough` lanes no longer march, or none does. Errors: as `integrate_phase`."""

    sizes = guard_sizes(flow)

    def goes_on(now: March) -> Array:
        if enough is None:
            return jnp.any(now.verdict == MARCHING)
        ended = (now.verdict != MARCHING) & (now.verdict != WAITING)
        return jnp.any(now.verdict == MARCHING) & (jnp.sum(ended) < enough)

    def advance(now: March) -> March:
        return _advanced(now, _tried(flow, tableau, options, now), sizes, tableau, options)

    return lax.while_loop(goes_on, advance, begin)


class _Try(NamedTuple):
    """One Runge-Kutta step of every lane."""

    end: Place
    squared: Array  # error over tolerance
    values: Array  # guards at the end
    bend: Array  # of the guards' parabolas
    slope: Array


def _tried(flow: Flow, tableau: Tableau, options: Options, now: March) -> _Try:
    here, h, n = now.here, now.h, now.here.q.shape[0]
    last = len(tableau.places) - 1
    once, twice, places = (jnp.asarray(x) for x in (tableau.once, tableau.twice, tableau.places))

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
    end, middle = reached(last), reached(tableau.middle)
    inside, values = (guards_at(flow, place) - now.offset for place in (middle, end))
    weigh = lambda weights: sum(float(w) * slopes[j, :n] for j, w in enumerate(weights) if w != 0.0)
    errors = h * h * weigh(tableau.error_twice), h * weigh(tableau.error_once)
    squared = _squared_error(options, errors, here, end, values)
    return _Try(end, squared, values, *parabola(tableau, now.values, inside, values))


def _advanced(now: March, tried: _Try, sizes: Array, tableau: Tableau, options: Options) -> March:
    """The lane takes its step, tries another length, or has come to an event."""
    here, h, search, end = now.here, now.h, now.search, tried.end
    running = now.verdict == MARCHING
    keep = running & ~search.on & (tried.squared <= 1.0)
    to_dip = _to_earliest_dip(now.values, tried)
    retry = keep & (to_dip < 1.0) & (now.time + h * to_dip > now.time)
    crossed = keep & ~retry & jnp.any(tried.values <= 0.0, axis=0)
    accepted = keep & ~retry & ~crossed
    searched, found = _searched(now, tried, crossed, sizes, options)
    arrived = found.arrived
    change = jnp.where(retry, to_dip, change_of_length(tableau, tried.squared, h.dtype))
    following = jnp.where(search.on | crossed, found.following, h * change)

    moved = jnp.where(arrived, found.shift, 0.0)
    end = Place(end.q + moved * end.v, end.v + moved * end.slope[: len(end.q)], end.slope)
    taken = accepted | arrived
    time = jnp.where(taken, now.time + h + moved, now.time)
    late = accepted & (time >= options.max_phase_time)
    late = late | (arrived & (time > options.max_phase_time))
    stuck = (searched.tries >= options.event_steps) | (now.tried + 1 >= options.max_solver_steps)
    stuck = stuck | (~search.on & (now.time + following == now.time))
    verdict = jnp.where(stuck, Outcome.SOLVER_GAVE_UP, MARCHING)
    verdict = jnp.where(arrived, EVENT, verdict)
    verdict = jnp.where(late, Outcome.NO_TOUCHDOWN_IN_TIME, verdict)
    return now._replace(
        here=select(taken, end, here),
        values=jnp.where(accepted, tried.values, now.values),
        h=jnp.where(running, following, h),
        time=time,
        search=select(running, searched, search),
        verdict=jnp.where(running, verdict, now.verdict).astype(jnp.int32),
        guard=jnp.where(arrived, found.guard, now.guard),
        tried=now.tried + running,
    )


class _Found(NamedTuple):
    """Of the earliest event inside a step."""

    following: Array  # length to be tried next, s
    shift: Array  # from this length to the event's, s
    arrived: Array  # the event is that close
    guard: Array


def _searched(
    now: March, tried: _Try, crossed: Array, sizes: Array, options: Options
) -> tuple[Search, _Found]:
    """One more look for the earliest event, from where the guards' parabolas fall through zero."""
    h, search = now.h, now.search
    crosses = tried.values <= 0.0
    crossing = jnp.where(search.on, search.crossing | crosses, crosses)
    first, guard = _earliest_root(now.values, tried.slope, tried.bend, crossing)
    by_ends, guard_by_ends = _earliest_secant(search, tried.values, h, crossing)
    slow = search.on & (search.tries >= PARABOLAS)
    proposal, guard = jnp.where(slow, by_ends, h * first), jnp.where(slow, guard_by_ends, guard)
    past = jnp.any(crossing & crosses, axis=0)
    low = jnp.where(search.on & ~past, h, search.low)
    high = jnp.where(search.on & past, h, search.high)
    low, high = jnp.where(crossed, 0.0, low), jnp.where(crossed, h, high)
    resolution = 1e3 * jnp.finfo(h.dtype).eps * (now.time + h)
    accuracy = jnp.maximum(CLOSE * options.rtol * h, resolution)
    accuracy = jnp.where(search.on, search.accuracy, accuracy)
    within = (proposal >= low - accuracy) & (proposal <= high + accuracy)
    # In a dip of microseconds rounding throws proposals out of the bracket: its middle is as good.
    halve = ~within | (slow & ((search.tries & 3) == 3))
    following = jnp.where(halve, 0.5 * (low + high), proposal)
    shift = following - h
    # Where a guard reads no more than its rounding, no length is better than this one.
    beside, lowest = _lowest(tried.values / sizes, crossing)
    at_rest = search.on & (jnp.abs(lowest) <= ROUNDING * jnp.finfo(h.dtype).eps)
    shift, guard = jnp.where(at_rest, 0.0, shift), jnp.where(at_rest, beside, guard)
    close = search.on & (jnp.abs(shift) <= accuracy)
    tries = jnp.where(search.on, search.tries + 1, 0)
    on = (search.on | crossed) & ~close
    searched = Search(on, crossing, low, high, accuracy, tries, h, tried.values)
    return searched, _Found(following, shift, close & (now.verdict == MARCHING), guard)


def _squared_error(
    options: Options, errors: tuple[Array, Array], here: Place, end: Place, guards: Array
) -> Array:
    """Mean square of the error over its tolerance; infinite where the step went nowhere."""
    total = 0.0 * jnp.sum(guards, axis=0)
    for error, a, b in zip(errors, here[:2], end[:2], strict=True):
        allowed = options.atol + options.rtol * jnp.maximum(jnp.abs(a), jnp.abs(b))
        total = total + jnp.sum(jnp.square(error / allowed), axis=0)
    return jnp.where(jnp.isfinite(total), total / (2 * here.q.shape[0]), jnp.inf)


def _to_earliest_dip(values: Array, tried: _Try) -> Array:
    """Share of the step up to where a guard that falls and rises again is lowest, if near zero.

    See `numerics.dips`. A guard that stands on its own event at the start has no such place.
    """
    low = dips(values, tried.values, tried.bend, tried.slope) & (values > 0.0)
    place = -tried.slope / jnp.where(low, 2.0 * tried.bend, 1.0)
    return jnp.min(jnp.where(low, place, 1.0), axis=0)


def _lowest(values: Array, crossing: Array) -> tuple[Array, Array]:
    """Which of the crossing guards is lowest, and its value; infinite where none crosses."""
    least, guard = jnp.full_like(values[0], jnp.inf), jnp.zeros(values.shape[1:], jnp.int32)
    for index in range(len(values)):
        lower = crossing[index] & (values[index] < least)
        least, guard = jnp.where(lower, values[index], least), jnp.where(lower, index, guard)
    return guard, least


def _earliest_secant(
    search: Search, values: Array, h: Array, crossing: Array
) -> tuple[Array, Array]:
    """Where the first of the crossing guards falls through zero by the last two tries, and which;
    infinite where none does. Their ends are as right as the march, the inner stage is not."""
    rate = (values - search.values) / jnp.where(h == search.last, jnp.inf, h - search.last)
    first, guard = jnp.full_like(h, jnp.inf), jnp.zeros(h.shape, jnp.int32)
    for index in range(len(values)):
        falls = crossing[index] & (rate[index] < 0.0)
        place = h - values[index] / jnp.where(falls, rate[index], 1.0)
        earlier = falls & (place < first)
        first, guard = jnp.where(earlier, place, first), jnp.where(earlier, index, guard)
    return first, guard


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
    for index in reversed(range(len(place))):
        guard = jnp.where(crossing[index], index, guard)
    for index in range(len(place)):
        earlier = exists[index] & (place[index] < first)
        first = jnp.where(earlier, place[index], first)
        guard = jnp.where(earlier, index, guard)
    return first, guard
