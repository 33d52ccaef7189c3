"""Walks of a batch with unilateral contact, with tangents along many directions.

Everything that determines the motion (events, contacts, step sizes) is computed once. At each stage
of a Runge-Kutta step and at each event, quantities that all tangents share are computed once. Each
tangent then needs only linear operations. The derivatives are those of the discrete flow at the
accepted step sizes, and of the times of its events: see `numerics.tangents`.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from vrw_jax.models.unilateral.contacts import OFF
from vrw_jax.models.unilateral.lanes import UNDER_WAY, Lane, Moves, Walk, Walked
from vrw_jax.models.unilateral.march import (
    EVENT,
    MARCHING,
    N_TALLIED,
    FlowAt,
    March,
    Place,
    advanced,
    guards_at,
    motion_of,
    slope_at,
    stage_at,
    tried_by,
    until_none_marches,
)
from vrw_jax.models.unilateral.motion import Flow, Stance, guard_sizes
from vrw_jax.models.unilateral.shares import FEW, Shares
from vrw_jax.numerics import Options, Tableau, if_any, real_stability_limit, select


class _March(NamedTuple):
    """Tangent of a lane's state during an interval."""

    q: Array
    v: Array
    told: Array | None
    slope: Array  # of accelerations and, if requested, accumulators
    later: Array  # tangent of the time, s


class _Way(NamedTuple):
    """Tangent of all of a lane's state."""

    march: _March
    rest: Moves  # those not in the interval

    @classmethod
    def of(cls, moves: Moves, slope: Array) -> "_Way":
        """Return the tangent of these lane tangents and dynamics rows."""
        tally, told = moves.told
        rest: Any = moves._asdict() | {"q": None, "v": None, "told": (tally, None), "time": None}
        return cls(_March(moves.q, moves.v, told, slope, moves.time), Moves(**rest))

    def moves(self) -> Moves:
        """Return the lane tangents."""
        q, v, told, _, later = self.march
        return self.rest._replace(q=q, v=v, told=(self.rest.told[0], told), time=later)


class Ways(NamedTuple):
    """Tangents of each lane: arrays have them on the first axis, lanes on the last."""

    many: Array  # number of tangents of a lane
    by_columns: Array  # number of leading ones that may have column parts
    columns: Array
    rows: Array  # all numbers of a `_Tangent` in one array, for few loops and short compilation

    def blank(self, size: int) -> Array:
        """Return uninitialized rows of each tangent, to be written."""
        return lax.empty((len(self.columns), size, *self.many.shape), self.columns.dtype)

    def each(
        self, function: Callable[[Array, Array], Any], rows: Array, begin: Array | int = 0
    ) -> Array:
        """Return the rows of each tangent, overwritten from row `first_row` on by `function(k,
        rows)`.
        """
        goes_on = lambda state: jnp.any(state[0] < self.many)

        def turn(state: tuple[Array, Array]) -> tuple[Array, Array]:
            k, rows = state
            told = _packed(function(k, lax.dynamic_index_in_dim(rows, k, 0, False)))
            # Stacking row by row keeps the rows in registers.
            told = jnp.stack([told[i] for i in range(len(told))])
            place = k, jnp.int32(begin), jnp.int32(0)
            return k + 1, lax.dynamic_update_slice(rows, told[None], place)

        return lax.while_loop(goes_on, turn, (jnp.zeros((), jnp.int32), rows))[1]


def _packed(tree: Any) -> Array:
    """Return all numbers of a tree in one array of rows."""
    return jnp.concatenate([x.reshape(-1, x.shape[-1]) for x in jax.tree.leaves(tree)])


def _unpacked(rows: Array, like: Any) -> Any:
    """Return the rows as a tree of the template's structure: the inverse of `_pack_rows`."""
    leaves, structure = jax.tree.flatten(like)
    found, begin = [], 0
    for leaf in leaves:
        size = math.prod(leaf.shape[:-1])
        own = rows[..., begin : begin + size, :]
        found.append(own.reshape(*rows.shape[:-2], *leaf.shape))
        begin += size
    return jax.tree.unflatten(structure, found)


def _at(rows: Array, k: Array, like: Any) -> Any:
    """Return tangent k as a tree of the template's structure."""
    return _unpacked(lax.dynamic_index_in_dim(rows, k, 0, False), like)


def walked_along(
    on: Walk, columns: Array, x: Array, d_columns: Array, d_x: Array, many: Array
) -> tuple[Walked, Any]:
    """Return the result of `run_walks`, and the tangents of its floats for each lane.

    Tangents are the first axis of `d_columns`, `d_x` and the returned tangents; a lane has
    `n_tangents` of them.
    """
    columns, x, good = on.sound(columns, x)
    n_rows = lambda tree: len(_packed(tree))

    def begun(columns: Array, x: Array) -> tuple[Moves, Lane]:
        lane = on.barred(on.begun(columns, x), good)
        return lane.moves(), lane

    moves, push, lane = jax.linearize(begun, columns, x, has_aux=True)
    slope = jnp.zeros((len(moves.q) + N_TALLIED * on.detailed, *many.shape), x.dtype)
    like = _Way.of(moves, slope)
    by_columns = jnp.zeros_like(many)
    for k in range(len(d_columns)):
        by_columns = jnp.where(jnp.any(d_columns[k] != 0.0, axis=0), k + 1, by_columns)
    ways = Ways(many, by_columns, d_columns, d_columns)
    start = lambda k, _: _Way.of(push(_at(d_columns, k, columns), _at(d_x, k, x)), slope)
    ways = ways._replace(rows=ways.each(start, ways.blank(n_rows(like))))

    def turn(state: tuple[Lane, Ways]) -> tuple[Lane, Ways]:
        lane, ways = state

        def past_events(columns: Array, moves: Moves) -> tuple[Moves, Lane]:
            after = on.past_events(columns, lane.moved(moves))
            return after.moves(), after

        _, push, after = jax.linearize(past_events, columns, lane.moves(), has_aux=True)

        def passed(k: Array, row: Array) -> _Way:
            way = _unpacked(row, like)
            return _Way.of(push(_at(d_columns, k, columns), way.moves()), way.march.slope)

        ways = ways._replace(rows=ways.each(passed, ways.rows))
        under_way, flow_at = after.outcome == UNDER_WAY, lambda c: on.flow(c, after.now.stance)
        given = flow_at, columns, after.now, ways, like.march, under_way, on.options, on.tableau
        now, rows = _marched(*given)
        return after._replace(now=now), ways._replace(rows=rows)

    goes_on = lambda state: jnp.any(state[0].outcome == UNDER_WAY)
    lane, ways = lax.while_loop(goes_on, turn, (lane, ways))

    def told(moves: Moves) -> tuple[Any, Any]:
        return eqx.partition(on.told(lane.moved(moves)), eqx.is_inexact_array)

    floats, push, rest = jax.linearize(told, lane.moves(), has_aux=True)
    push_at = lambda k, _: push(_at(ways.rows, k, like).moves())
    moved = ways.each(push_at, ways.blank(n_rows(floats)))
    step = eqx.combine(floats, rest)
    walk = Walked(step, lane.outcome, lane.n_stepped, lane.ledger.tried)
    return walk, _unpacked(moved, floats)


def _marched(
    flow_at: FlowAt,
    columns: Array,
    begin: March,
    ways: Ways,
    like: _March,
    walks: Array,
    options: Options,
    tableau: Tableau,
) -> tuple[March, Array]:
    """Return the result of `integrate_interval`, with the tangents propagated to the event."""
    flow = flow_at(columns)
    sizes, last = guard_sizes(flow), len(tableau.places) - 1
    more, longest = _more(ways, like, begin.stance), _longest(flow, tableau)

    def advance(state: tuple[March, Array]) -> tuple[March, Array]:
        now, rows = state
        h = jnp.where(now.search.on, now.h, jnp.minimum(now.h, longest))
        now = now._replace(h=h)
        slopes, moved = _stages(
            flow_at, columns, now, ways._replace(rows=rows), like, tableau, more
        )
        tried = tried_by(flow, tableau, options, now, slopes)
        after = advanced(now, tried, sizes, tableau, options)
        taken, n = after.time != now.time, len(now.here.q)

        def end(k: Array, row: Array) -> _March:
            here = _unpacked(row, like)
            known = lax.dynamic_index_in_dim(moved, k, 0, False).reshape(-1, *like.slope.shape)
            at = lambda some: stage_at(
                tableau, last, here.q[some], here.v[some], known[:, :n][:, some], now.h
            )
            few, others = slice(0, 3 + FEW), slice(3 + FEW, None)
            still = here.q[others], here.v[others]
            ends = zip(at(few), if_any(more, lambda _: at(others), still), strict=True)
            q, v = map(jnp.concatenate, ends)
            told = here.told
            if told is not None:
                once = tableau.once[last]
                told = told + now.h * sum(once[j] * known[j, n:] for j in range(last))
            there = _March(q, v, told, known[last], here.later)
            return select(taken, there, here._replace(slope=known[0]))

        return after, ways.each(end, rows)

    marching = lambda state: state[0].verdict == MARCHING
    now, rows = until_none_marches(marching, walks, advance, (begin, ways.rows))
    return now, ways.each(_met(flow_at, columns, begin, now, ways, like), rows)


def _stages(
    flow_at: FlowAt,
    columns: Array,
    now: March,
    ways: Ways,
    like: _March,
    tableau: Tableau,
    more: Array,
) -> tuple[Array, Array]:
    """Return the dynamics rows at the stages of a step, and the tangents of these rows.

    The tangents are processed one after another.
    """
    here, h = now.here, now.h
    size, last = len(like.slope), len(tableau.places) - 1
    fresh = (now.verdict == MARCHING) & (now.time == 0.0)

    def stage(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        i, slopes, moved = state

        place = stage_at(tableau, i, here.q, here.v, slopes, h)
        flow = flow_at(columns)
        shares = Shares.at(flow, motion_of(Place(*place, place[0])), more)
        none = shares.nothing()
        by = lambda k, _: shares.by_columns(flow_at, columns, _at(ways.columns, k, columns))
        own = ways._replace(many=ways.by_columns).each(by, ways.blank(len(_packed(none))))

        def along(k: Array, known: Array) -> Array:
            way = _at(ways.rows, k, like)
            before = known.reshape(-1, *like.slope.shape)
            ends = lambda some: _ends(tableau, i, way, before, h, some)
            column = if_any(jnp.any(k < ways.by_columns), lambda _: _at(own, k, none), none)
            row = shares.along(ends, column, more)
            return jnp.where((i > 0) | fresh, row, known[:size])

        slope = jnp.where(i > 0, slope_at(flow, *place), here.slope)
        slopes = lax.dynamic_update_index_in_dim(slopes, slope, i, 0)
        return i + 1, slopes, ways.each(along, moved, i * size)

    others = jnp.zeros((last, *here.slope.shape), h.dtype)
    slopes = jnp.concatenate([here.slope[None], others])
    moved = ways.each(lambda k, _: _at(ways.rows, k, like).slope, ways.blank((last + 1) * size))
    # The first stage is the last one of the previous step, except after an event.
    first = jnp.where(jnp.any(fresh), 0, 1).astype(jnp.int32)
    goes_on = lambda state: state[0] <= last
    return lax.while_loop(goes_on, stage, (first, slopes, moved))[1:]


def _ends(
    tableau: Tableau, i: Array, way: _March, known: Array, h: Array, some: slice
) -> tuple[Array, Array]:
    """Return the tangent of `stage_state` for some coordinates, from the earlier stages."""
    rows = [jnp.asarray(np.reshape(x, -1)) for x in (tableau.once, tableau.twice)]
    width, place = len(tableau.once[0]), jnp.asarray(tableau.places)[i]

    def turn(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        j, first, second = state
        a, b = (lax.dynamic_index_in_dim(row, i * width + j, 0, False) for row in rows)
        slope = lax.dynamic_index_in_dim(known, j, 0, False)[: len(way.q)][some]
        return j + 1, first + a * slope, second + b * slope

    q, v = way.q[some], way.v[some]
    begin = jnp.zeros((), jnp.int32), jnp.zeros_like(q), jnp.zeros_like(q)
    _, first, second = lax.while_loop(lambda state: state[0] < i, turn, begin)
    return q + h * (place * v + h * second), v + h * first


CALM = 0.85
"""Fraction of the longest stable step size that is used for tangents of a swinging leg."""


def _longest(flow: Flow, tableau: Tableau) -> Array:
    """Return the step size above which tangents of a swinging leg grow.

    The damper of such a leg stops it within m / c. Step-size control is based on the motion alone,
    in which such a leg may be almost at rest.
    """
    swings = jnp.any(~flow.stance.locked & (flow.stance.contact == OFF), axis=0)
    steps = CALM * real_stability_limit(tableau)
    return jnp.where(swings, steps * flow.s.m / flow.s.c, jnp.inf)


def _more(ways: Ways, like: _March, stance: Stance) -> Array:
    """Return whether any leg after the first ones moves, in any lane and along any tangent."""

    def turn(state: tuple[Array, Array]) -> tuple[Array, Array]:
        k, moves = state
        way = _at(ways.rows, k, like)
        lengths = jnp.concatenate([way.q[3 + FEW :], way.v[3 + FEW :]])
        return k + 1, moves | jnp.any(lengths != 0.0, axis=0)

    begin = jnp.zeros((), jnp.int32), jnp.any(~stance.locked[FEW:], axis=0)
    goes_on = lambda state: jnp.any(state[0] < ways.many)
    return jnp.any(lax.while_loop(goes_on, turn, begin)[1])


def _met(
    flow_at: FlowAt,
    columns: Array,
    begin: March,
    now: March,
    ways: Ways,
    like: _March,
) -> Callable[[Array, Array], _March]:
    """Return the function that shifts tangents by the tangent of the event time."""
    here, n = now.here, len(now.here.q)

    def guards(columns: Array, q: Array, v: Array) -> Array:
        flow = flow_at(columns)
        return guards_at(flow, Place(q, v, slope_at(flow, q, v)))

    _, push = jax.linearize(guards, columns, here.q, here.v)
    rates = push(jnp.zeros_like(columns), here.v, here.slope[:n])
    arrived = (begin.verdict == MARCHING) & (now.verdict == EVENT)

    def met(k: Array, row: Array) -> _March:
        way, later = _unpacked(row, like), jnp.zeros_like(now.time)
        moves = push(_at(ways.columns, k, columns), way.q, way.v)
        for index in range(len(moves)):
            at = arrived & (now.guard == index) & (rates[index] < 0.0)
            later = jnp.where(at, -moves[index] / jnp.where(at, rates[index], -1.0), later)
        told = way.told
        if told is not None:
            told = told + later * here.slope[-N_TALLIED:]
        return _March(
            q=way.q + later * here.v,
            v=way.v + later * here.slope[:n],
            told=told,
            slope=way.slope,
            later=later,
        )

    return met
