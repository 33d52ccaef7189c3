"""Location of the earliest zero of the guards within a solver step, for a batch."""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from vrw_jax.numerics.lane_minima import with_rates
from vrw_jax.numerics.lanes import select
from vrw_jax.numerics.options import Options
from vrw_jax.numerics.tableaus import (
    Evaluate,
    Place,
    Tableau,
    Take,
    explicit_tableau,
    parabola,
    take_step,
)
from vrw_jax.numerics.types import Vector


class Crossing(NamedTuple):
    """Solver steps within which guards cross zero."""

    here: Place  # at the start of the step
    values: Vector  # of the guards at the start
    inside: Vector  # at the tableau's stage `middle`
    beyond: Vector  # at the end
    h: Array
    guards: Array  # bits of the guards that cross
    crossed: Array  # batch elements with such a step


class Located(NamedTuple):
    """State and result of the event search."""

    length: Array  # of the next try, or of the event once it is found
    low: Array
    high: Array
    open: Array
    end: Place
    shift: Array  # from `end` to the event, by Newton's method
    guard: Array
    tried: Array
    tries: Array


def locate(
    guards: Callable[[Place], Vector],
    evaluate: Evaluate,
    take: Take,
    tableau: Tableau,
    step: Crossing,
    options: Options,
) -> Located:
    """Return the earliest event inside each crossing step, by Newton's method on the step's length.

    The first try is the crossing of the guards' parabolas. Every guard that crossed proposes its
    own time and the earliest proposal is taken, inside a bracket that bisection shrinks. Once a
    proposal is near, and no guard is too curved for Newton's method, a short step of low order
    reaches it; the remainder is an extrapolation along the state's rate.
    """
    h, root = step.h, jnp.sqrt(options.rtol)
    enough, near = 0.1 * root * h, 0.3 * jnp.sqrt(root) * h
    bits = [(step.guards >> i) & 1 == 1 for i in range(len(step.values))]

    def improve(search: Located) -> Located:
        end = take(step.here, search.length).end
        values, rates = with_rates(guards, evaluate, end)
        change, guard = _newton(values, rates, step.guards)
        before, straight = jnp.ones(h.shape, bool), jnp.ones(h.shape, bool)
        for g0, g, rate, crosses in zip(step.values, values, rates, bits, strict=True):
            past, bent = _passed_or_bent(g0, g, rate, search.length)
            before, straight = before & ~(crosses & past), straight & ~(crosses & bent)
        low = jnp.where(before, search.length, search.low)
        high = jnp.where(before, search.high, search.length)
        proposal = search.length + change
        inside = (proposal >= low - enough) & (proposal <= high + enough)
        length = jnp.where(inside, proposal, 0.5 * (low + high))
        arrived = search.open & inside & (jnp.abs(change) <= jnp.where(straight, near, enough))
        return Located(
            length=jnp.where(search.open, length, search.length),
            low=low,
            high=high,
            open=search.open & ~arrived,
            end=select(arrived, end, search.end),
            shift=jnp.where(arrived, change, search.shift),
            guard=jnp.where(arrived, guard, search.guard),
            tried=search.tried + search.open,
            tries=search.tries + 1,
        )

    first = h * _first_guess(tableau, *step[1:4], step.guards)
    none, zero = jnp.zeros(h.shape, jnp.int32), jnp.zeros_like(h)
    count = jnp.zeros((), jnp.int32)
    start = Located(first, zero, h, step.crossed, step.here, zero, none, none, count)
    unsettled = lambda search: jnp.any(search.open) & (search.tries < options.event_steps)
    found = lax.while_loop(unsettled, improve, start)

    return _closed_in(guards, evaluate, step, found, (enough, near), options)


def _closed_in(
    guards: Callable[[Place], Vector],
    evaluate: Evaluate,
    step: Crossing,
    found: Located,
    limits: tuple[Array, Array],
    options: Options,
) -> Located:
    """Return the event from a state near it, by short steps of low order.

    One step suffices, except for guards that graze zero; the event stays unresolved if Newton's
    method diverges. `limits`: the largest time left to the extrapolation, and the largest time of a
    short step, s.
    """
    enough, near = limits
    short = explicit_tableau("Bosh3")  # exact to round-off over a thousandth of a step
    assert short is not None

    def goes(far: Array, shift: Array) -> Array:
        return far & (jnp.abs(shift) <= near)

    def approach(now: tuple) -> tuple:
        end, shift, length, guard, far, tries = now
        on = goes(far, shift)
        end = select(on, take_step(short, evaluate, end, shift, with_error=False).end, end)
        left, earliest = _newton(*with_rates(guards, evaluate, end), step.guards)
        shift = jnp.where(on, left, shift)
        length = jnp.where(goes(on, left), length + left, length)
        guard = jnp.where(on, earliest, guard)
        return end, shift, length, guard, far & (jnp.abs(shift) > enough), tries + 1

    far = step.crossed & ~found.open & (jnp.abs(found.shift) > enough)
    begin = found.end, found.shift, found.length, found.guard, far, jnp.zeros((), jnp.int32)
    more = lambda now: jnp.any(goes(now[4], now[1])) & (now[5] < options.event_steps)
    end, shift, length, guard, far, _ = lax.while_loop(more, approach, begin)
    end = select(far, step.here, _along(end, shift))
    return found._replace(length=length, open=found.open | far, end=end, guard=guard)


def _along(place: Place, shift: Array) -> Place:
    """Return the state a time step later, extrapolated along its rate."""
    q = tuple(x + shift * y for x, y in zip(place.q, place.v, strict=True))
    v = tuple(x + shift * y for x, y in zip(place.v, place.slope.acceleration, strict=False))
    return place._replace(q=q, v=v)


@jax.jit  # traced once, for whichever guard
def _passed_or_bent(start: Array, g: Array, rate: Array, length: Array) -> tuple[Array, Array]:
    """Return whether a guard has crossed, and whether it is too curved for Newton's
    method alone.
    """
    past = (g < 0.0) | ((g == 0.0) & (rate <= 0.0))  # a guard that rises from zero has not crossed
    fall = rate * length
    return past, jnp.abs(2.0 * (start - g + fall) * g) > 0.25 * fall * fall


def _newton(values: Vector, rates: Vector, crossing: Array) -> tuple[Array, Array]:
    """Return the time to the earliest event proposed by a crossing guard, and the index of that
    guard.

    A guard that rises below zero has crossed at an unknown earlier time, which counts as minus
    infinity.
    """
    change = jnp.full_like(values[0], jnp.inf)
    guard = jnp.zeros_like(crossing)
    for index, (g, rate) in enumerate(zip(values, rates, strict=True)):
        own = _to_zero((crossing >> index) & 1 == 1, g, rate)
        guard = jnp.where(own < change, index, guard)
        change = jnp.minimum(own, change)
    return change, guard


@jax.jit  # traced once, for whichever guard
def _to_zero(crosses: Array, g: Array, rate: Array) -> Array:
    """Return the time to a guard's zero along its tangent, infinite if the guard does not cross."""
    falling = crosses & (rate < 0.0)
    unknown = jnp.where(crosses & (g < 0.0), -jnp.inf, jnp.inf)
    return jnp.where(falling, -g / jnp.where(falling, rate, -1.0), unknown)


def _first_guess(
    tableau: Tableau, start: Vector, inside: Vector, end: Vector, crossing: Array
) -> Array:
    """Return the fraction of the step to the earliest zero of the guards' parabolas.

    The root is found by the secant, then by Newton's method.
    """
    earliest = jnp.ones_like(start[0])
    for index, values in enumerate(zip(start, inside, end, strict=True)):
        crosses = (crossing >> index) & 1 == 1
        at = _first_zero(tableau, crosses, *values)
        earliest = jnp.where(crosses, jnp.minimum(earliest, at), earliest)
    return earliest


@functools.partial(jax.jit, static_argnums=0)  # traced once, for whichever guard
def _first_zero(tableau: Tableau, crosses: Array, g0: Array, gm: Array, g1: Array) -> Array:
    """Return the fraction of the step to the zero of a guard's parabola."""
    bend, slope = parabola(tableau, g0, gm, g1)
    fall = jnp.where(crosses & (g0 > g1), g0 - g1, 1.0)
    at = jnp.clip(g0 / fall, 0.0, 1.0)
    # A guard that rises from zero vanishes at the start of the step: the other root counts.
    rises = crosses & (g0 == 0.0) & (slope > 0.0)
    at = jnp.where(rises, jnp.clip(-slope / jnp.where(rises, bend, -1.0), 0.0, 1.0), at)
    for _ in range(3):
        rate = slope + 2.0 * bend * at
        falls = rate < 0.0
        step = (g0 + at * (slope + bend * at)) / jnp.where(falls, rate, 1.0)
        at = jnp.where(falls, jnp.clip(at - step, 0.0, 1.0), at)
    return at
