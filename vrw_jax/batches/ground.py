"""Gait steps of many wheels on real ground at once: values only, no derivatives.

The laws are those of `models.unilateral`, element by element over lanes. All lanes march
(`ground_march`) until some, on a CPU all, have come to events; these are taken through them
together, and all march on. A landing of the foremost foot is an event like others; a lane whose
wheel has made its steps takes the next wheel in the queue. So hardly a lane waits for another.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from vrw_jax import simd
from vrw_jax.batches.ground_march import (
    EVENT,
    MARCHING,
    WAITING,
    March,
    Search,
    begun_guards,
    guard_rates,
    guards_at,
    march,
    motion_of,
    place_of,
)
from vrw_jax.models import (
    OFF,
    PAPER_START,
    Law,
    Stance,
    UnilateralWheel,
    WheelMotion,
    closed,
    embedded,
    event_of,
    flow_of,
    guards_of,
    least_dip,
    opened,
    replaced_where_bad,
    resolve,
    settled,
    unpack,
    usable,
)
from vrw_jax.numerics import Options, Tableau, explicit_tableau, select
from vrw_jax.runtime import fusion_emitters, lane_function
from vrw_jax.wheel import (
    PARAMETER_NAMES,
    Outcome,
    Symbols,
    WheelParams,
    parameters_of,
    symbols_of,
    wheel_of,
)

LANES = 256
"""Lanes that march side by side where XLA compiles the march. In machine code a lane that has come
to its event costs nothing, and as many march as are taken through their events together."""
TOGETHER = 64
"""Lanes that are taken through their events together: they stay in cache."""
QUEUE = 2048
"""Wheels of one call of the compiled program."""


class _Queue(NamedTuple):
    """Wheels that wait, and what became of those that do no more; wheels on the last axis."""

    columns: Array  # parameters and friction
    start: Array  # section states, (n_full, wheels)
    good: Array
    next: Array  # wheel to be taken
    section: Array  # after the last step
    durations: Array  # (3, wheels), of the last step
    outcome: Array
    n_stepped: Array
    tried: Array


class _Lanes(NamedTuple):
    """What a lane keeps beside its march."""

    wheel: Array  # its place in the queue
    columns: Array
    events: Array  # in this step
    durations: Array  # (3, lanes), of this step
    n_stepped: Array
    tried: Array


def walk_lanes(
    columns: np.ndarray,
    states: np.ndarray,
    n_steps: int,
    model: UnilateralWheel,
    options: Options,
    n: int,
) -> tuple[np.ndarray, ...]:
    """`n_steps` steps of many wheels with `n` legs: section states, durations, outcomes, steps
    made and steps tried. What is static of the model holds for all.

    `columns` are the parameters in their order and friction, shape (10, wheels); `states` full
    section states, shape (wheels, 4 + 3 n).
    """
    dynamic, static = eqx.partition(options, eqx.is_array)
    dynamic = jax.tree.map(lambda leaf: np.asarray(leaf, columns.dtype), dynamic)
    program = _program(static, n, model.max_events, model.one_sided)
    if not len(states):
        none = np.zeros(0, np.int32)
        return states, np.zeros((0, 3), states.dtype), none, none, none
    parts = []
    # Most work first, so that no lane is left alone with much of it at the end: stability bounds
    # the step where damping is high.
    order = np.argsort(-columns[PARAMETER_NAMES.index("damping")], kind="stable")
    for begin in range(0, len(states), QUEUE):
        some = order[begin : begin + QUEUE]
        filled = np.concatenate([some, np.repeat(some[-1:], QUEUE - len(some))])
        given = columns[:, filled], states[filled].T.copy(), np.int32(len(some)), np.int32(n_steps)
        out = program(*given, dynamic)
        parts.append([np.asarray(x)[..., : len(some)] for x in out])
    back = np.argsort(order, kind="stable")
    return tuple(
        np.moveaxis(np.concatenate(part, -1), -1, 0)[back] for part in zip(*parts, strict=True)
    )


def as_full_states(columns: np.ndarray, states: np.ndarray, n: int) -> np.ndarray:
    """The full section states of the paper's, wheel by wheel; others are left as they are."""
    if states.shape[1] != 3:
        return states
    embed = lambda values, x: embedded(symbols_of(n, *values), x)
    return np.asarray(jax.vmap(embed, (1, 0))(columns[:-1], jnp.asarray(states)))


def _symbols(columns: Array, n: int) -> Symbols:
    return symbols_of(n, *columns[:-1])


@functools.cache
def _program(
    static: Options, n_legs: int, max_events: int, one_sided: bool
) -> Callable[..., tuple]:
    """The compiled walk of one queue: one program for every batch and number of steps."""

    def walk(columns: Array, x: Array, wanted: Array, n_steps: Array, dynamic: Options) -> tuple:
        options = eqx.combine(dynamic, static)
        tableau = explicit_tableau(options.solver)
        assert tableau is not None  # `batch` looked
        queue = _queue_of(columns, x, n_legs)
        return _walked(queue, wanted, n_steps, n_legs, max_events, one_sided, options, tableau)

    return jax.jit(walk, compiler_options=fusion_emitters(False))


def _queue_of(columns: Array, x: Array, n: int) -> _Queue:
    def made_safe(values: Array, x: Array) -> tuple[Array, Array, Array]:
        params = wheel_of(values[:-1], n)
        safe_x = embedded(WheelParams(n_legs=n).symbols(), jnp.asarray(PAPER_START, x.dtype))
        good = usable(params, x) & (values[-1] >= 0.0)
        params, x = replaced_where_bad(good, params, x, safe_x)
        return jnp.stack([*parameters_of(params), jnp.where(good, values[-1], 1.0)]), x, good

    columns, x, good = jax.vmap(made_safe, -1, -1)(columns, x)
    none = jnp.zeros(x.shape[-1:], jnp.int32)
    return _Queue(
        columns=columns,
        start=x,
        good=good,
        next=jnp.zeros((), jnp.int32),
        section=jnp.zeros_like(x),
        durations=jnp.zeros((3, x.shape[-1]), x.dtype),
        outcome=jnp.where(good, Outcome.STEPPED, Outcome.BAD_INPUT).astype(jnp.int32),
        n_stepped=none,
        tried=none,
    )


def _walked(
    queue: _Queue,
    wanted: Array,
    n_steps: Array,
    n: int,
    max_events: int,
    one_sided: bool,
    options: Options,
    tableau: Tableau,
) -> tuple:
    """Every wanted wheel through `n_steps` landings of its foremost foot."""
    place = guards_of(n, one_sided)
    over = functools.partial(jax.vmap, in_axes=-1, out_axes=-1)
    dtype = queue.start.dtype

    def begins(columns: Array, x: Array) -> tuple[WheelMotion, Stance]:
        state, stance = opened(_symbols(columns, n), x)
        return unpack(state)[0], stance

    def through(columns: Array, motion: WheelMotion, stance: Stance, guard: Array) -> tuple:
        """Past an event: motion, stance and outcome.

        The integrator lets feet drift by its error. One that lifts rises like the third power of
        time, from the slope and from rest: else it would land again at once.
        """
        s, friction = _symbols(columns, n), columns[-1]
        motion = settled(s, motion, stance.contact, stance.locked)
        law, unseen = Law(one_sided, counted=False), least_dip(s, options, one_sided)
        change = resolve(s, friction, motion, stance, event_of(place, n, guard), law, unseen)
        outcome = jnp.where(change.solutions > 0, Outcome.STEPPED, Outcome.NO_ADMISSIBLE_CONTACT)
        outcome = jnp.where(change.third_foot, Outcome.THREE_FEET_LOADED, outcome)
        return change.motion, change.stance, outcome.astype(jnp.int32)

    lanes, now = _empty(queue, n, one_sided)
    n_lanes = now.h.shape[-1]
    on = _marches(n, one_sided, options, tableau)

    def events(queue: _Queue, lanes: _Lanes, now: March) -> tuple[_Queue, _Lanes, March]:
        """Some lanes through their events, or on to the next wheels."""
        ready = (now.verdict != MARCHING) & ((now.verdict != WAITING) | (queue.next < wanted))
        (index,) = jnp.nonzero(ready, size=TOGETHER, fill_value=n_lanes)
        pick = lambda leaf: jnp.take(leaf, index, axis=-1, mode="clip")
        here, lane = jax.tree.map(pick, (now, lanes))
        chosen = index < n_lanes
        came = chosen & (here.verdict != WAITING)

        # How the phase ended.
        loaded = jnp.sum(here.stance.contact != OFF, axis=0)
        share = jnp.arange(3)[:, None] == 2 - loaded
        durations = lane.durations + jnp.where(share, here.time, 0.0)
        tried = lane.tried + here.tried
        at_event = here.verdict == EVENT
        landed = came & at_event & (here.guard == place.foot + n - 1)
        code = jnp.where(lane.events >= max_events, Outcome.TOO_MANY_EVENTS, Outcome.STEPPED)
        code = jnp.where(here.guard == place.rate, Outcome.FELL_BACK, code)
        code = jnp.where(here.guard == place.length, Outcome.COLLAPSED, code)
        code = jnp.where(at_event, jnp.where(landed, Outcome.STEPPED, code), here.verdict)
        n_stepped = lane.n_stepped + landed
        motion, stance = motion_of(here.here), here.stance
        reached = over(closed)(motion, stance)

        # A wheel that is done or lost is told, and makes room for the next one.
        failed = came & (code != Outcome.STEPPED)
        leaves = failed | (landed & (n_stepped >= n_steps))
        to = jnp.where(leaves, lane.wheel, QUEUE)
        put = lambda old, new: old.at[..., to].set(new, mode="drop")
        free = leaves | (chosen & ~came)
        following = queue.next + jnp.cumsum(free.astype(jnp.int32)) - 1
        fills = free & (following < wanted)
        wheel = jnp.where(fills, following, lane.wheel)
        fresh = lambda leaf: jnp.take(leaf, wheel, axis=-1, mode="clip")
        queue = queue._replace(
            next=jnp.minimum(queue.next + jnp.sum(free, dtype=jnp.int32), wanted),
            section=put(queue.section, jnp.where(failed, 0.0, reached)),
            durations=put(queue.durations, durations),
            outcome=put(queue.outcome, code.astype(jnp.int32)),
            n_stepped=put(queue.n_stepped, n_stepped),
            tried=put(queue.tried, tried),
        )

        # A landing of the foremost foot opens the next step; all go through their events.
        opens = fills | (landed & ~leaves)
        columns = jnp.where(fills, fresh(queue.columns), lane.columns)
        x = jnp.where(fills, fresh(queue.start), reached)
        motion, stance = select(opens, over(begins)(columns, x), (motion, stance))
        guard = jnp.where(opens, place.foot, here.guard)
        motion, stance, outcome = over(through)(columns, motion, stance, guard)
        outcome = jnp.where(fills & ~fresh(queue.good), Outcome.BAD_INPUT, outcome)
        flow = flow_of(_symbols(columns, n), columns[-1], one_sided, stance)
        start = place_of(flow, motion)
        values, rates, begun = guards_at(flow, start), guard_rates(flow, start), begun_guards(flow)
        past = ~begun & ((values < 0.0) | ((values == 0.0) & (rates <= 0.0)))
        offset = jnp.where(begun, values, 0.0)
        verdict = jnp.where(jnp.any(past, axis=0), EVENT, MARCHING)
        verdict = jnp.where(outcome != Outcome.STEPPED, outcome, verdict)
        verdict = jnp.where(free & ~fills, WAITING, verdict).astype(jnp.int32)
        zero, none = jnp.zeros(index.shape, dtype), jnp.zeros(index.shape, jnp.int32)
        after = March(
            here=start,
            stance=stance,
            values=values - offset,
            offset=offset,
            h=zero + options.first_step,
            time=zero,
            search=Search(none > 0, jnp.zeros_like(begun), zero, zero, zero, none),
            verdict=verdict,
            guard=jnp.argmax(past, axis=0).astype(jnp.int32),
            tried=none,
        )
        kept = _Lanes(
            wheel=wheel,
            columns=columns,
            events=jnp.where(opens, 1, lane.events + 1),
            durations=jnp.where(opens, 0.0, durations),
            n_stepped=jnp.where(fills, 0, n_stepped),
            tried=jnp.where(fills, 0, tried),
        )
        put_back = lambda old, new: old.at[..., index].set(new, mode="drop")
        now, lanes = jax.tree.map(put_back, (now, lanes), (after, kept))
        return queue, lanes, now

    def round_(state: tuple) -> tuple:
        queue, lanes, now = events(*state)
        to_fill = jnp.where(queue.next < wanted, jnp.sum(now.verdict == WAITING), 0)
        return queue, lanes, on(lanes.columns, now, TOGETHER - to_fill)

    def goes_on(state: tuple) -> Array:
        queue, _, now = state
        return (queue.next < wanted) | jnp.any(now.verdict != WAITING)

    queue, *_ = lax.while_loop(goes_on, round_, (queue, lanes, now))
    return queue.section, queue.durations, queue.outcome, queue.n_stepped, queue.tried


def _marches(
    n: int, one_sided: bool, options: Options, tableau: Tableau
) -> Callable[[Array, March, Array], March]:
    """The march by columns: by machine code each lane to its event, else until enough are."""
    dynamic, static = eqx.partition(options, eqx.is_array)

    def far(columns: Array, now: March, dynamic: Options, enough: Array | None = None) -> March:
        known = eqx.combine(dynamic, static)
        s, friction = _symbols(columns, n), columns[-1]
        return march(s, friction, one_sided, now, enough, known, tableau)

    if not simd.serves():
        return lambda columns, now, enough: far(columns, now, dynamic, enough)
    like = lambda columns, now, dynamic: now
    settings = ("march on real ground", n, one_sided, static)
    by_machine_code = lane_function(far, like, settings)
    return lambda columns, now, enough: by_machine_code(columns, now, dynamic)


def _empty(queue: _Queue, n: int, one_sided: bool) -> tuple[_Lanes, March]:
    """Lanes without wheels, in place of which stands the first one."""
    dtype, guards = queue.start.dtype, guards_of(n, one_sided).total
    n_lanes = TOGETHER if simd.serves() else LANES
    many = lambda value: jnp.broadcast_to(value[..., None], (*value.shape, n_lanes))
    zero, none = jnp.zeros((n_lanes,), dtype), jnp.zeros((n_lanes,), jnp.int32)
    first = queue.columns[:, 0]
    state, stance = opened(_symbols(first, n), queue.start[:, 0])
    stance = jax.tree.map(many, stance)
    motion = jax.tree.map(many, unpack(state)[0])
    columns = many(first)
    here = place_of(flow_of(_symbols(columns, n), columns[-1], one_sided, stance), motion)
    blank = jnp.zeros((guards, n_lanes), dtype)
    march = March(
        here=here,
        stance=stance,
        values=blank,
        offset=blank,
        h=zero,
        time=zero,
        search=Search(none > 0, blank > 0.0, zero, zero, zero, none),
        verdict=none + WAITING,
        guard=none,
        tried=none,
    )
    return _Lanes(none, columns, none, jnp.zeros((3, n_lanes), dtype), none, none), march
