"""Where in a step of many wheels the earliest of their guards vanishes."""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from vrw_jax.numerics.lane_minima import with_rates
from vrw_jax.numerics.lanes import select
from vrw_jax.numerics.options import Options
from vrw_jax.numerics.tableaus import Evaluate, Place, Tableau, parabola, take_step
from vrw_jax.numerics.types import Vector


class Crossing(NamedTuple):
    """Steps within which guards cross zero."""

    here: Place  # where they begin
    values: Vector  # of the guards there
    h: Array
    guards: Array  # bits of those that cross
    crossed: Array  # in which lanes there is such a step


class Located(NamedTuple):
    """The search, and what it found."""

    length: Array  # the next try; the event's, once found
    low: Array
    high: Array
    open: Array
    end: Place
    guard: Array
    tried: Array
    tries: Array


def locate(
    guards: Callable[[Place], Vector],
    evaluate: Evaluate,
    tableau: Tableau,
    step: Crossing,
    options: Options,
) -> Located:
    """The earliest event inside each crossing step, by Newton's method on the step's length.

    The first try is the whole step, the second where the guards' parabolas cross. Every guard that
    crossed proposes its own time and the earliest is taken, inside a bracket that bisection
    shrinks. The last proposal moves the end along its slope; it is so short that what the next
    order would add is a hundredth of the tolerance.
    """
    h = step.h
    enough = 0.1 * jnp.sqrt(options.rtol) * h
    bits = [(step.guards >> i) & 1 == 1 for i in range(len(step.values))]

    def propose(search: Located, end: Place, inside: Place) -> tuple:
        values, rates = with_rates(guards, evaluate, end)
        within = guards(inside)
        change, guard = _newton(values, rates, step.guards)
        at = _first_guess(tableau, step.values, within, values, step.guards)
        return following(search, values, change, guard, at)

    def following(search: Located, values: Vector, change: Array, guard: Array, at: Array) -> tuple:
        before = jnp.ones(h.shape, bool)
        for g, crosses in zip(values, bits, strict=True):
            before = before & ~(crosses & (g <= 0.0))
        low = jnp.where(before, search.length, search.low)
        high = jnp.where(before, search.high, search.length)
        proposal = jnp.where(search.tries == 0, at * h, search.length + change)
        inside = (proposal >= low - enough) & (proposal <= high + enough)
        length = jnp.where(inside, proposal, 0.5 * (low + high))
        arrived = inside & (jnp.abs(change) <= enough) & (search.tries > 0)
        length = jnp.where(search.open, length, search.length)
        return length, low, high, search.open & arrived, jnp.where(arrived, change, 0.0), guard

    def improve(search: Located) -> Located:
        taken = take_step(tableau, evaluate, step.here, search.length, with_error=False)
        length, low, high, arrived, shift, guard = propose(search, taken.end, taken.inside)

        return Located(
            length=length,
            low=low,
            high=high,
            open=search.open & ~arrived,
            end=select(arrived, _along(taken.end, shift), search.end),
            guard=jnp.where(arrived, guard, search.guard),
            tried=search.tried + search.open,
            tries=search.tries + 1,
        )

    none = jnp.zeros(h.shape, jnp.int32)
    start = Located(
        h, jnp.zeros_like(h), h, step.crossed, step.here, none, none,
        jnp.zeros((), jnp.int32),
    )  # fmt: skip
    unsettled = lambda search: jnp.any(search.open) & (search.tries < options.event_steps)
    return lax.while_loop(unsettled, improve, start)


def _along(place: Place, shift: Array) -> Place:
    """A little later, along the slope."""
    q = tuple(x + shift * y for x, y in zip(place.q, place.v, strict=True))
    v = tuple(x + shift * y for x, y in zip(place.v, place.slope.acceleration, strict=False))
    return place._replace(q=q, v=v)


def _newton(values: Vector, rates: Vector, crossing: Array) -> tuple[Array, Array]:
    """Time to the earliest event by each crossing guard's own proposal, and which guard it is."""
    change = jnp.full_like(values[0], jnp.inf)
    guard = jnp.zeros_like(crossing)
    for index, (g, rate) in enumerate(zip(values, rates, strict=True)):
        falling = ((crossing >> index) & 1 == 1) & (rate < 0.0)
        own = jnp.where(falling, -g / jnp.where(falling, rate, -1.0), jnp.inf)
        guard = jnp.where(own < change, index, guard)
        change = jnp.minimum(own, change)
    return change, guard


def _first_guess(
    tableau: Tableau, start: Vector, inside: Vector, end: Vector, crossing: Array
) -> Array:
    """Share of the step to the earliest zero of the guards' parabolas: secant, then Newton."""
    earliest = jnp.ones_like(start[0])
    for index, (g0, gm, g1) in enumerate(zip(start, inside, end, strict=True)):
        crosses = (crossing >> index) & 1 == 1
        bend, slope = parabola(tableau, g0, gm, g1)
        fall = jnp.where(crosses & (g0 > g1), g0 - g1, 1.0)
        at = jnp.clip(g0 / fall, 0.0, 1.0)
        for _ in range(3):
            rate = slope + 2.0 * bend * at
            falls = rate < 0.0
            step = (g0 + at * (slope + bend * at)) / jnp.where(falls, rate, 1.0)
            at = jnp.where(falls, jnp.clip(at - step, 0.0, 1.0), at)
        earliest = jnp.where(crosses, jnp.minimum(earliest, at), earliest)
    return earliest
