"""Batched integration between events: each lane has its own step size and contact state.

Arrays have lanes on the last axis. One Runge-Kutta step serves integration and event search: a lane
whose step crosses a guard repeats it with smaller steps until the step ends at the earliest event.
No computation in this module combines values of different lanes.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
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
    stance_guards,
    tally_rates,
)
from vrw_jax.numerics import (
    ROUNDING,
    Options,
    Tableau,
    below,
    change_of_length,
    parabola,
    select,
)
from vrw_jax.wheel import Outcome

N_FELT = 9
"""Number of rows after the accelerations that hold the contact quantities of the guards. They are
followed by those of legs in the air, if stoppers are one-sided, and by `N_ACCUMULATOR_ROWS` rows
if these are requested."""
N_TALLIED = 3
"""Number of accumulated rows: energy lost in dampers and by sliding, slip."""
MARCHING, EVENT = -1, -2
"""Status codes of a lane that is integrating or at an event; every other status is its
`Outcome`."""
BURST = 8
"""Number of solver-step attempts after which a lane at an event ends the loop for all lanes."""
SINGULAR = 1e-8, 1e2
"""Absolute tolerance, and factor of the relative tolerance, below which the determinant counts as
zero at Painlevé's singularity. Forces there are a ratio of two vanishing numbers, resolved
neither by rounding nor by integration. Chosen because with 18 tolerances one singularity was
missed."""
PARABOLAS = 3
"""Number of event iterations by parabolas; the later ones use secants, which converge better in
stiff dips."""
PATIENT = 15
"""Number of event iterations after which a guard that starts at its own event may be the event
found."""
STILL = 1e-3
"""Time (s) within which a guard must fall by its own rounding to count as falling."""
CLOSE = 30.0
"""Largest last correction to the time of an event, in tolerances of the step. Chosen because the
proposal is a parabola's, whose own error is about a hundredth of the correction."""


class Place(NamedTuple):
    """Coordinates (hub x, z, theta, lengths), their rates, and the rows of the dynamics at a
    point.
    """

    q: Array  # (3 + n, lanes)
    v: Array
    slope: Array  # accelerations, then contact rows: (3 + n + N_CONTACT_ROWS [+ n], lanes)


class Search(NamedTuple):
    """Bracket of the earliest event inside a step."""

    on: Array
    crossing: Array  # (guards, lanes)
    low: Array  # bracket of the event, s from the start of the step
    high: Array
    accuracy: Array  # s
    tries: Array
    last: Array  # previously attempted step, s
    values: Array  # guards at its end, (guards, lanes)


class March(NamedTuple):
    """State of all lanes between two of their events."""

    here: Place
    stance: Stance
    values: Array  # guards at the point, (guards, lanes)
    offset: Array  # value at the own event of a guard that starts there, minus rounding
    told: Array | None  # integrals since the last event, (N_ACCUMULATOR_ROWS, lanes)
    h: Array  # of the next attempt, s
    time: Array  # since the last event, s
    search: Search
    verdict: Array  # MARCHING, EVENT or an Outcome
    guard: Array  # that has triggered
    tried: Array  # attempted since the last event


def motion_of(place: Place) -> WheelMotion:
    """Return the motion at a point."""
    x, z, theta, L = place.q[0], place.q[1], place.q[2], place.q[3:]
    return WheelMotion(x, z, theta, place.v[0], place.v[1], place.v[2], L, place.v[3:])


def place_of(flow: Flow, motion: WheelMotion) -> Place:
    """Return the point of a motion, with its dynamics: the inverse of `motion_from_point`."""
    q, v = coordinates(motion)
    return Place(q, v, slope_at(flow, q, v))


def coordinates(motion: WheelMotion) -> tuple[Array, Array]:
    """Return the coordinates of a motion, and their rates, as two arrays."""
    q = jnp.concatenate([jnp.stack([motion.x, motion.z, motion.theta]), motion.L])
    return q, jnp.concatenate([jnp.stack([motion.vx, motion.vz, motion.dtheta]), motion.dL])


def slope_at(flow: Flow, q: Array, v: Array) -> Array:
    """Return the accelerations of all coordinates, then `ContactQuantities` without the
    directions.
    """
    motion = motion_of(Place(q, v, q))
    now = forces(flow, motion)
    told = felt(flow, now)
    feet = [*told.normal, *told.tangential, *told.stopper, *told.speed, told.regular]
    more = [] if told.in_air is None else [told.in_air]
    if flow.tallied:
        tally = tally_rates(flow, motion, now)
        rows = tally.damping, tally.friction, tally.slip
        more.append(jnp.stack(kept(rows, one_of(motion))))
    return jnp.concatenate([jnp.stack(now.answer.hub), now.answer.lengths, jnp.stack(feet), *more])


def guards_at(flow: Flow, place: Place) -> Array:
    """Return all guards in the order of `GuardLayout`, as long after the start of the contact
    state.
    """
    motion = motion_of(place)
    of_felt = place.slope[len(place.q) :]
    n1, n2, t1, t2, s1, s2, x1, x2, regular = of_felt[:N_FELT]
    in_air = of_felt[N_FELT : N_FELT + flow.s.n] if flow.one_sided else None
    legs, pairs = directions(flow.s, motion.theta), ((n1, n2), (t1, t2), (s1, s2), (x1, x2))
    now = Felt(legs, *pairs, regular, in_air)
    begun = jnp.ones(place.q.shape[-1:], bool)
    return jnp.concatenate(stance_guards(flow, motion, now, begun))


def guard_rates(flow: Flow, place: Place) -> Array:
    """Return the time derivatives of the guards along the motion."""

    def along(q: Array, v: Array) -> Array:
        return guards_at(flow, Place(q, v, slope_at(flow, q, v)))

    return jax.jvp(along, (place.q, place.v), (place.v, place.slope[: len(place.q)]))[1]


def begun_guards(flow: Flow) -> Array:
    """Return which guards are at the event that has just started the contact state."""
    stance = flow.stance
    slid = flow.slots.flags(stance.new_slip)
    no = jnp.zeros((2, stance.contact.shape[-1]), bool)
    in_air = [stance.locked & False] if flow.one_sided else []
    return jnp.concatenate([stance.new_foot, stance.new_leg, no, no, no, slid, no, no, *in_air])


@eqx.filter_jit  # traced once for all call sites
def set_off(flow: Flow, motion: WheelMotion, h: Array) -> March:
    """Return the lanes at the start of a contact state.

    A lane is at an event again if one of its guards falls at once.
    """
    here, begun = place_of(flow, motion), begun_guards(flow)
    values, rates = guards_at(flow, here), guard_rates(flow, here)
    # A contact released from rest has a guard within rounding for 1e-8 s and longer. One that
    # rises from below has no event before it falls; events without duration leave several such.
    unread = guard_sizes(flow) * (ROUNDING * jnp.finfo(values.dtype).eps)
    begun = begun | ((values <= unread) & (rates > -unread / STILL))
    past = ~begun & ((values < 0.0) | ((values == 0.0) & (rates <= 0.0)))
    offset = jnp.where(begun, values - 2.0 * unread, 0.0)
    zero, none = jnp.zeros_like(motion.x), jnp.zeros(motion.x.shape, jnp.int32)
    return March(
        here=here,
        stance=flow.stance,
        values=values - offset,
        offset=offset,
        told=jnp.zeros((N_TALLIED, *zero.shape), zero.dtype) if flow.tallied else None,
        h=zero + h,
        time=zero,
        search=Search(none > 0, jnp.zeros_like(begun), zero, zero, zero, none, zero, values),
        verdict=jnp.where(jnp.any(past, axis=0), EVENT, MARCHING).astype(jnp.int32),
        guard=_first(past),
        tried=none,
    )


def _first(flags: Array) -> Array:
    """Return the index of the first row whose flag is set; 0 if none is."""
    first = jnp.zeros(flags.shape[1:], jnp.int32)
    for row in reversed(range(len(flags))):
        first = jnp.where(flags[row], row, first)
    return first


FlowAt = Callable[[Array], Flow]
"""Function of the lanes' columns: parameters and friction."""


def marched(
    flow_at: FlowAt,
    columns: Array,
    begin: March,
    walks: Array,
    options: Options,
    tableau: Tableau,
) -> March:
    """Return the lanes integrated until none is running.

    After `MAX_WAIT_TRIES` attempts, the loop ends as soon as a lane with `is_walking` is at an
    event.
    """
    flow = flow_at(columns)
    sizes = guard_sizes(flow)

    def advance(now: March) -> March:
        return advanced(now, tried_step(flow, tableau, options, now), sizes, tableau, options)

    return until_none_marches(lambda now: now.verdict == MARCHING, walks, advance, begin)


def until_none_marches(
    marching: Callable[[Any], Array], walks: Array, advance: Callable, begin: Any
) -> Any:
    """Return the state after repeated `iterate`, until no lane is running.

    After `MAX_WAIT_TRIES` attempts, the loop ends as soon as a lane with `is_walking` has stopped.
    """

    def goes_on(state: tuple) -> Array:
        now, tries = state
        still = marching(now)
        return jnp.any(still) & ((tries < BURST) | ~jnp.any(walks & ~still))

    none = jnp.zeros((), jnp.int32)
    turn = lambda state: (advance(state[0]), state[1] + 1)
    return lax.while_loop(goes_on, turn, (begin, none))[0]


class Try(NamedTuple):
    """An attempted solver step."""

    end: Place
    squared: Array  # of the error over the tolerance
    values: Array  # at the end
    bend: Array  # of the guards' parabolas
    slope: Array
    to_dip: Array  # fraction of the step to a possible guard dip below zero, else 1
    told: Array | None  # increment of `IntervalState.accumulated`


def stage_at(
    tableau: Tableau, i: Array | int, q: Array, v: Array, slopes: Array, h: Array
) -> tuple[Array, Array]:
    """Return coordinates and rates at a stage, from the accelerations of the stages before it."""
    a, b, place = (jnp.asarray(x)[i] for x in (tableau.once, tableau.twice, tableau.places))
    n, last = len(q), len(tableau.places) - 1
    first = sum(a[j] * slopes[j, :n] for j in range(last))
    second = sum(b[j] * slopes[j, :n] for j in range(last))
    return q + h * (place * v + h * second), v + h * first


def tried_step(flow: Flow, tableau: Tableau, options: Options, now: March) -> Try:
    """Return an attempted step of every lane."""
    h, here, last = now.h, now.here, len(tableau.places) - 1

    def stage(i: Array, slopes: Array) -> Array:
        slope = slope_at(flow, *stage_at(tableau, i, here.q, here.v, slopes, h))
        return lax.dynamic_update_index_in_dim(slopes, slope, i, 0)

    others = jnp.zeros((last, *here.slope.shape), h.dtype)
    slopes = jnp.concatenate([here.slope[None], others])
    slopes = lax.fori_loop(1, last + 1, stage, slopes)
    return tried_by(flow, tableau, options, now, slopes)


def tried_by(flow: Flow, tableau: Tableau, options: Options, now: March, slopes: Array) -> Try:
    """Return the attempted step with these rows of the dynamics at its stages."""
    h, here, last = now.h, now.here, len(tableau.places) - 1
    n = len(here.q)
    end = Place(*stage_at(tableau, last, here.q, here.v, slopes, h), slopes[last])
    told = None
    if flow.tallied:
        told = h * sum(tableau.once[last][j] * slopes[j, -N_TALLIED:] for j in range(last))
    inside = {
        i: Place(*stage_at(tableau, i, here.q, here.v, slopes, h), slopes[i])
        for i in tableau.inside
    }
    looked = *inside.values(), end
    *within, values = (guards_at(flow, place) - now.offset for place in looked)
    weigh = lambda weights: sum(float(w) * slopes[j, :n] for j, w in enumerate(weights) if w != 0.0)
    errors = h * h * weigh(tableau.error_twice), h * weigh(tableau.error_once)
    squared = _squared_error(options, errors, here, looked[-1], values)
    middle = within[tableau.inside.index(tableau.middle)] if within else now.values
    bent = parabola(tableau, now.values, middle, values)
    to_dip = _to_earliest_dip(tableau, [now.values, *within, values], _stands(now))
    return Try(end, squared, values, *bent, to_dip, told)


def at_singularity(before: Array, after: Array, options: Options) -> Array:
    """Return whether the determinant has vanished at Painlevé's singularity, from its values at
    both ends.
    """
    return (before * after <= 0.0) | (jnp.abs(after) <= SINGULAR[0] + SINGULAR[1] * options.rtol)


def advanced(now: March, tried: Try, sizes: Array, tableau: Tableau, options: Options) -> March:
    """Return the lanes after one attempt: accepted, repeated with another step size, or at an
    event.
    """
    here, h, search, end = now.here, now.h, now.search, tried.end
    running = now.verdict == MARCHING
    keep = running & ~search.on & (tried.squared <= 1.0)
    retry = keep & (tried.to_dip < 1.0) & (now.time + h * tried.to_dip > now.time)
    crossed = keep & ~retry & jnp.any(tried.values <= 0.0, axis=0)
    accepted = keep & ~retry & ~crossed
    searched, found = _searched(now, tried, crossed, sizes, options)
    arrived = found.arrived
    change = jnp.where(retry, tried.to_dip, change_of_length(tableau, tried.squared, h.dtype))
    following = jnp.where(search.on | crossed, found.following, h * change)

    moved = jnp.where(arrived, found.shift, 0.0)
    end = Place(end.q + moved * end.v, end.v + moved * end.slope[: len(end.q)], end.slope)
    taken = accepted | arrived
    told = now.told
    if told is not None and tried.told is not None:
        told = told + jnp.where(taken, tried.told, 0.0)
    time = jnp.where(taken, now.time + h + moved, now.time)
    late = accepted & (time >= options.max_phase_time)
    late = late | (arrived & (time > options.max_phase_time))
    stuck = (searched.tries >= options.event_steps) | (now.tried + 1 >= options.max_solver_steps)
    stuck = stuck | (~search.on & (now.time + following == now.time))
    regular = len(here.q) + N_FELT - 1
    before, after = here.slope[regular], end.slope[regular]
    verdict = jnp.where(stuck, Outcome.SOLVER_GAVE_UP, MARCHING)
    verdict = jnp.where(arrived, EVENT, verdict)
    verdict = jnp.where(late, Outcome.NO_TOUCHDOWN_IN_TIME, verdict)
    singular = taken & at_singularity(before, after, options)
    verdict = jnp.where(singular, Outcome.FRICTION_PARADOX, verdict)
    return now._replace(
        here=select(taken, end, here),
        values=jnp.where(accepted, tried.values, now.values),
        told=told,
        h=jnp.where(running, following, h),
        time=time,
        search=select(running, searched, search),
        verdict=jnp.where(running, verdict, now.verdict).astype(jnp.int32),
        guard=jnp.where(arrived, found.guard, now.guard),
        tried=now.tried + running,
    )


class _Found(NamedTuple):
    """Result of one iteration of the search for the earliest event inside a step."""

    following: Array  # step size of the next attempt, s
    shift: Array  # from this step size to the event's, s
    arrived: Array  # whether the event is within tolerance
    guard: Array


def _searched(
    now: March, tried: Try, crossed: Array, sizes: Array, options: Options
) -> tuple[Search, _Found]:
    """Return one more iteration of the search, from the zeros of the guards' parabolas or
    secants.
    """
    h, search = now.h, now.search
    crosses = tried.values <= 0.0
    crossing = jnp.where(search.on, search.crossing | crosses, crosses)
    parabolas = now.values, tried.slope, tried.bend
    first, guard = _earliest_root(*parabolas, crossing, _stands(now))
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
    # In a dip of microseconds, rounding moves proposals out of the bracket: bisect it instead.
    halve = ~within | (slow & ((search.tries & 3) == 3))
    # A guard that starts at its own event falls again soon, or not at all.
    middle = jnp.where((low == 0.0) & jnp.isinf(proposal), 0.125 * high, 0.5 * (low + high))
    following = jnp.where(halve, middle, proposal)
    shift = following - h
    # If a guard is within its rounding, no other step size is better than this one.
    beside, lowest = _lowest(tried.values / sizes, crossing)
    # A guard at its own event is within twice its rounding; without another event, it is the event.
    reads = ROUNDING * jnp.where(search.tries < PATIENT, 1.0, 3.0) * jnp.finfo(h.dtype).eps
    at_rest = search.on & (jnp.abs(lowest) <= reads)
    shift, guard = jnp.where(at_rest, 0.0, shift), jnp.where(at_rest, beside, guard)
    close = search.on & (jnp.abs(shift) <= accuracy)
    tries = jnp.where(search.on, search.tries + 1, 0)
    on = (search.on | crossed) & ~close
    searched = Search(on, crossing, low, high, accuracy, tries, h, tried.values)
    return searched, _Found(following, shift, close & (now.verdict == MARCHING), guard)


def _squared_error(
    options: Options, errors: tuple[Array, Array], here: Place, end: Place, guards: Array
) -> Array:
    """Return the mean square of the error over its tolerance; infinite for a step that is not
    finite.
    """
    total = 0.0 * jnp.sum(guards, axis=0)
    for error, a, b in zip(errors, here[:2], end[:2], strict=True):
        allowed = options.atol + options.rtol * jnp.maximum(jnp.abs(a), jnp.abs(b))
        total = total + jnp.sum(jnp.square(error / allowed), axis=0)
    return jnp.where(jnp.isfinite(total), total / (2 * here.q.shape[0]), jnp.inf)


def _stands(now: March) -> Array:
    """Return the guards at their own event, for lanes at the start of the contact state."""
    return (now.time == 0.0) & (now.offset != 0.0)


def _to_earliest_dip(tableau: Tableau, values: list[Array], stands: Array) -> Array:
    """Return the fraction of the step before a guard that may dip below zero in it; 1 if there is
    none.

    See `numerics.find_dip`. A guard that starts at its own event is not considered.
    """
    looks, at = below(tableau, values)
    return jnp.min(jnp.where(looks & (values[0] > 0.0) & ~stands, at, 1.0), axis=0)


def _lowest(values: Array, crossing: Array) -> tuple[Array, Array]:
    """Return the lowest of the crossing guards, and its value; infinite if none crosses."""
    least, guard = jnp.full_like(values[0], jnp.inf), jnp.zeros(values.shape[1:], jnp.int32)
    for index in range(len(values)):
        lower = crossing[index] & (values[index] < least)
        least, guard = jnp.where(lower, values[index], least), jnp.where(lower, index, guard)
    return guard, least


def _earliest_secant(
    search: Search, values: Array, h: Array, crossing: Array
) -> tuple[Array, Array]:
    """Return the earliest zero of the crossing guards' secants through the last two attempts.

    It also returns the guard. The zero is infinite if no guard falls, and minus infinity if a guard
    is below zero and no longer falls, because it fell before. The ends of attempts are as accurate
    as the integration; the inner stage is not.
    """
    rate = (values - search.values) / jnp.where(h == search.last, jnp.inf, h - search.last)
    first, guard = jnp.full_like(h, jnp.inf), jnp.zeros(h.shape, jnp.int32)
    for index in range(len(values)):
        falls = crossing[index] & (rate[index] < 0.0)
        place = h - values[index] / jnp.where(falls, rate[index], 1.0)
        fell = crossing[index] & ~falls & (values[index] < 0.0)
        place = jnp.where(fell, -jnp.inf, place)
        earlier = (falls | fell) & (place < first)
        first, guard = jnp.where(earlier, place, first), jnp.where(earlier, index, guard)
    return first, guard


def _earliest_root(
    g0: Array, slope: Array, bend: Array, crossing: Array, stands: Array
) -> tuple[Array, Array]:
    """Return the earliest zero of the crossing guards' parabolas, in step lengths, and the guard.

    The zero is infinite if no parabola falls ahead. A guard that starts at its own event rises: if
    its parabola falls at once, the step is too long for parabolas. The zero is minus infinity if
    such a parabola ends below zero.
    """
    discriminant = slope * slope - 4.0 * bend * g0
    root = jnp.sqrt(jnp.maximum(discriminant, 0.0))
    falling = slope < 0.0
    over = jnp.where(falling, 2.0 * g0, -slope - root)
    under = jnp.where(falling, root - slope, 2.0 * bend)
    place = over / jnp.where(under == 0.0, 1.0, under)
    exists = crossing & (discriminant >= 0.0) & (under != 0.0) & (place > 0.0)
    exists = exists & ~(stands & falling)
    fell = crossing & ~exists & (g0 + slope + bend < 0.0)
    place, exists = jnp.where(fell, -jnp.inf, place), exists | fell
    first, guard = jnp.full_like(place[0], jnp.inf), jnp.zeros(place.shape[-1:], jnp.int32)
    for index in reversed(range(len(place))):
        guard = jnp.where(crossing[index], index, guard)
    for index in range(len(place)):
        earlier = exists[index] & (place[index] < first)
        first = jnp.where(earlier, place[index], first)
        guard = jnp.where(earlier, index, guard)
    return first, guard
