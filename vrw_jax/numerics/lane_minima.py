"""Minima of margins along a phase, for a batch, at the integrator's accuracy.

The method is that of `minima` for one wheel. During the integration, the step that holds the lowest
minimum of each margin is stored; afterwards, secant steps on the margin's rate locate it, one
margin after the other.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from vrw_jax.numerics.lanes import select
from vrw_jax.numerics.minima import AT_MINIMUM, cubic_minimum
from vrw_jax.numerics.options import Options
from vrw_jax.numerics.tableaus import Evaluate, Place, Tableau, Take
from vrw_jax.numerics.tangents import Moving
from vrw_jax.numerics.types import Vector


class Monitors(NamedTuple):
    """Margins whose minima are searched; `includes_start`: see `minima.MonitoredFunctions`."""

    values: Callable[[Place], Vector]
    counts_at_start: tuple[bool, ...]


class Lowest(NamedTuple):
    """Margins at the present state, and the step that holds the lowest minimum of each so far."""

    values: Array  # (margins, batch)
    rates: Array
    so_far: Array  # lowest interior minimum, (margins, batch); infinite if there is none
    q: Array  # start of that step, (margins, coordinates, batch)
    v: Array
    length: Array  # of that step, (margins, batch), s
    offset: Array  # of the minimum from the step's start, s
    rate: Array  # at the step's start
    direction: Array | None = None  # of that start, (margins, directions, ., batch)


def with_rates(
    function: Callable[[Place], Vector], evaluate: Evaluate, place: Place
) -> tuple[Vector, Vector]:
    """Return a function of the state and its time derivatives along the motion."""
    n = len(place.q)

    def along(q: Vector, v: Vector) -> Vector:
        return function(Place(q, v, evaluate(q, v)))

    return jax.jvp(along, (place.q, place.v), (place.v, place.slope.acceleration[:n]))


def at_start(monitors: Monitors, evaluate: Evaluate, place: Place, moving: Moving | None) -> Lowest:
    """Return the minima before the first step.

    A margin that is zero at the start by construction rests there: its negative rates are round-off
    and count as zero.
    """
    values, rates = map(jnp.stack, with_rates(monitors.values, evaluate, place))
    counts = jnp.asarray(monitors.counts_at_start)[:, None]
    zeros = jnp.zeros_like(values)
    held = jnp.zeros((len(values), len(place.q), values.shape[-1]), values.dtype)
    rates = jnp.where(counts, rates, jnp.maximum(rates, 0.0))
    moves = None if moving is None else jnp.stack([jnp.zeros_like(moving.start)] * len(values))
    return Lowest(values, rates, zeros + jnp.inf, held, held, zeros, zeros, zeros, moves)


class Passed(NamedTuple):
    """A solver step of the batch elements that accepted it."""

    here: Place
    end: Place
    length: Array
    taken: Array
    direction: Array | None  # of the step's start


def lowered(monitors: Monitors, evaluate: Evaluate, lowest: Lowest, step: Passed) -> Lowest:
    """Return the minima, updated with the interior minima of an accepted step."""
    here, end, length, taken, _ = step
    values, rates = map(jnp.stack, with_rates(monitors.values, evaluate, end))
    x, value = cubic_minimum(lowest.values, lowest.rates * length, values, rates * length)
    value = jnp.where(jnp.isfinite(value), value, jnp.minimum(lowest.values, values))
    turns = (lowest.rates < 0.0) & (rates >= 0.0)
    better = taken & turns & (value < lowest.so_far)
    keep = lambda new, old: jnp.where(better, new, old)
    held = lambda new, old: jnp.where(better[:, None], jnp.stack(new), old)
    direction = lowest.direction
    if direction is not None and step.direction is not None:
        direction = jnp.where(better[:, None, None], step.direction[None], direction)
    return Lowest(
        values=jnp.where(taken, values, lowest.values),
        rates=jnp.where(taken, rates, lowest.rates),
        so_far=keep(value, lowest.so_far),
        q=held(here.q, lowest.q),
        v=held(here.v, lowest.v),
        length=keep(length, lowest.length),
        offset=keep(x * length, lowest.offset),
        rate=keep(lowest.rates, lowest.rate),
        direction=direction,
    )


class Settled(NamedTuple):
    """Minima of margins over a phase, each of shape (margins, batch)."""

    lowest: Array  # ends included
    inside: Array  # infinite if there is none
    length: Array  # of the step to the interior minimum, from the stored start


class _Search(NamedTuple):
    length: Array  # of the next try
    at: Array  # length with the smallest rate so far
    rate_at: Array
    value: Array
    open: Array
    tries: Array


def settled(
    monitors: Monitors,
    take: Take,
    evaluate: Evaluate,
    lowest: Lowest,
    start: Array,
    options: Options,
) -> Settled:
    """Return the minima over the phase; `start_values` are the margins at its start.

    Each minimum takes at most `max_margin_search_iterations` secant steps, all from the start of
    the step that holds it.
    """

    def one(_: None, given: tuple) -> tuple[None, tuple[Array, Array]]:
        index, held = given
        q, v = tuple(held.q), tuple(held.v)
        begin = Place(q, v, evaluate(q, v))

        def own(place: Place) -> Array:
            chosen = jnp.arange(len(monitors.counts_at_start)) == index
            return jnp.sum(jnp.where(chosen[:, None], jnp.stack(monitors.values(place)), 0.0), 0)

        def improve(search: _Search) -> _Search:
            end = take(begin, search.length).end
            (value,), (rate,) = with_rates(lambda place: (own(place),), evaluate, end)
            gap = search.length - search.at
            slope = (rate - search.rate_at) / jnp.where(gap == 0.0, 1.0, gap)
            usable = (gap != 0.0) & (slope > 0.0)
            change = jnp.where(usable, -rate / jnp.where(usable, slope, 1.0), 0.0)
            length = jnp.clip(search.length + change, 0.0, held.length)
            still = jnp.abs(length - search.length) <= AT_MINIMUM * held.length
            nearer = jnp.abs(rate) < jnp.abs(search.rate_at)
            told = _Search(
                length=length,
                at=jnp.where(nearer, search.length, search.at),
                rate_at=jnp.where(nearer, rate, search.rate_at),
                value=value,
                open=search.open & ~still,
                tries=search.tries,
            )
            return select(search.open, told, search)._replace(tries=search.tries + 1)

        found = jnp.isfinite(held.so_far)
        zero = jnp.zeros_like(held.length)
        tries = jnp.zeros((), jnp.int32)
        search = _Search(held.offset, zero, held.rate, zero + jnp.inf, found, tries)
        goes_on = lambda search: jnp.any(search.open) & (search.tries < options.monitor_steps)
        last = lax.while_loop(goes_on, improve, search)
        return None, (last.value, last.length)

    counts = np.asarray(monitors.counts_at_start)[:, None]
    least = jnp.minimum(jnp.where(counts, start, jnp.inf), lowest.values)
    indices = jnp.arange(len(counts), dtype=jnp.int32)
    inside, length = lax.scan(one, None, (indices, lowest._replace(direction=None)))[1]
    return Settled(jnp.minimum(inside, least), inside, length)


def moved(
    monitors_of: Callable[..., tuple[Monitors, Evaluate]],
    take: Take,
    tableau: Tableau,
    moving: Moving,
    lowest: Lowest,
    found: Settled,
    ends: tuple[Place, Place],
    direction: Array,
) -> Array:
    """Return the tangents of the minima, directions first.

    They are tangents along the motion at each minimum, because its location has no first-order
    effect. `phase_ends`: the start and the end of the phase; `end_tangents`: tangents of the end
    state.
    """
    monitors, evaluate = monitors_of(moving.constants, moving.held)

    def values(constants: Any, held: Vector, q: Vector, v: Vector) -> Array:
        watched, slope = monitors_of(constants, held)
        return jnp.stack(watched.values(Place(q, v, slope(q, v))))

    along = functools.partial(moving.of_values, values)

    def one(_: None, given: tuple) -> tuple[None, Array]:
        index, held, length = given
        q, v = tuple(held.q), tuple(held.v)
        begin = Place(q, v, evaluate(q, v))
        taken = take(begin, length)
        way = moving.along(tableau, taken.stages, held.direction, length)
        chosen = jnp.arange(len(monitors.counts_at_start)) == index
        return None, jnp.sum(jnp.where(chosen[:, None], along(taken.end, way), 0.0), 1)

    indices = jnp.arange(len(found.lowest), dtype=jnp.int32)
    inside = jnp.moveaxis(lax.scan(one, None, (indices, lowest, found.length))[1], 0, 1)
    first, last = along(ends[0], moving.start), along(ends[1], direction)
    at_end = jnp.where(lowest.values <= found.lowest, last, first)
    return jnp.where(found.inside <= found.lowest, inside, at_end)
