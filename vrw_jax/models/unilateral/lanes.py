"""Gait steps of many wheels on real ground at once: values only, no derivatives.

The laws are those of one wheel, element by element over lanes. All lanes march
(`march`) until some, on a CPU all, have come to events; these are taken through them
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
from vrw_jax.models.unilateral.ledger import Ledger, blank, law_of, outcome_at, passed, past
from vrw_jax.models.unilateral.march import (
    EVENT,
    MARCHING,
    WAITING,
    March,
    marched,
    motion_of,
    place_of,
    set_off,
)
from vrw_jax.models.unilateral.mechanics import WheelMotion, place_of_landing
from vrw_jax.models.unilateral.motion import Flow, Stance, flow_of, guards_of, unpack
from vrw_jax.models.unilateral.section import closed, embedded, made_sound, opened
from vrw_jax.models.unilateral.wheel import UnilateralWheel
from vrw_jax.numerics import Options, Tableau, explicit_tableau, select, zeros_of
from vrw_jax.runtime import fusion_emitters, lane_function
from vrw_jax.wheel import (
    PARAMETER_NAMES,
    Outcome,
    Symbols,
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
    length: Array  # of the last step, m
    outcome: Array
    n_stepped: Array
    tried: Array


class _Lanes(NamedTuple):
    """What a lane keeps beside its march."""

    wheel: Array  # its place in the queue
    columns: Array
    ledger: Ledger  # of this step; steps tried are all of the wheel's
    n_stepped: Array


class _Walk(NamedTuple):
    """What holds for all wheels of a batch."""

    n: int
    n_steps: Array
    max_events: int
    one_sided: bool
    options: Options
    tableau: Tableau

    def symbols(self, columns: Array) -> Symbols:
        """Of one wheel, or of lanes."""
        return symbols_of(self.n, *columns[:-1])

    def flow(self, columns: Array, stance: Stance) -> Flow:
        """Of lanes in their stances."""
        return flow_of(self.symbols(columns), columns[-1], self.one_sided, stance)


def walk_lanes(
    columns: np.ndarray,
    states: np.ndarray,
    n_steps: int,
    model: UnilateralWheel,
    options: Options,
    n: int,
) -> tuple[np.ndarray, ...]:
    """`n_steps` steps of many wheels with `n` legs: section states, durations, outcomes, steps
    made, steps tried and the last one's length, m. What is static of the model holds for all.

    `columns` are the parameters in their order and friction, shape (10, wheels); `states` full
    section states, shape (wheels, 4 + 3 n).
    """
    if model.restitution is not None:
        raise ValueError(
            "restitution is given, but in lanes feet don't come back: walk wheels one by one, by "
            "vrw.walk, or map vrw.return_map over them."
        )
    dynamic, static = eqx.partition(options, eqx.is_array)
    dynamic = jax.tree.map(lambda leaf: np.asarray(leaf, columns.dtype), dynamic)
    program = _program(static, n, model.max_events, model.one_sided)
    if not len(states):
        none = np.zeros(0, np.int32)
        return states, np.zeros((0, 3), states.dtype), none, none, none, np.zeros(0, states.dtype)
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


@functools.cache
def _program(
    static: Options, n_legs: int, max_events: int, one_sided: bool
) -> Callable[..., tuple]:
    """The compiled walk of one queue: one program for every batch and number of steps."""

    def walk(columns: Array, x: Array, wanted: Array, n_steps: Array, dynamic: Options) -> tuple:
        options = eqx.combine(dynamic, static)
        tableau = explicit_tableau(options.solver)
        assert tableau is not None  # the caller looked
        on = _Walk(n_legs, n_steps, max_events, one_sided, options, tableau)
        return _walked(_queue_of(columns, x, n_legs), wanted, on)

    return jax.jit(walk, compiler_options=fusion_emitters(False))


def _queue_of(columns: Array, x: Array, n: int) -> _Queue:
    def sound(values: Array, x: Array) -> tuple[Array, Array, Array]:
        good, params, friction, x = made_sound(wheel_of(values[:-1], n), values[-1], x)
        return jnp.stack([*parameters_of(params), friction]), x, good

    columns, x, good = jax.vmap(sound, -1, -1)(columns, x)
    none = jnp.zeros(x.shape[-1:], jnp.int32)
    return _Queue(
        columns=columns,
        start=x,
        good=good,
        next=jnp.zeros((), jnp.int32),
        section=jnp.zeros_like(x),
        durations=jnp.zeros((3, x.shape[-1]), x.dtype),
        length=jnp.zeros(x.shape[-1:], x.dtype),
        outcome=jnp.where(good, Outcome.STEPPED, Outcome.BAD_INPUT).astype(jnp.int32),
        n_stepped=none,
        tried=none,
    )


def _walked(queue: _Queue, wanted: Array, on: _Walk) -> tuple:
    """Every wanted wheel through its landings of the foremost foot."""
    marches = _marches(on)

    def round_(state: tuple) -> tuple:
        queue, lanes, now = _events(on, wanted, *state)
        to_fill = jnp.where(queue.next < wanted, jnp.sum(now.verdict == WAITING), 0)
        return queue, lanes, marches(lanes.columns, now, TOGETHER - to_fill)

    def goes_on(state: tuple) -> Array:
        queue, _, now = state
        return (queue.next < wanted) | jnp.any(now.verdict != WAITING)

    queue, *_ = lax.while_loop(goes_on, round_, (queue, *_empty(queue, on)))
    told = queue.section, queue.durations, queue.outcome, queue.n_stepped, queue.tried
    return *told, queue.length


class _Ended(NamedTuple):
    """Lanes that are looked at together, and how each one's last stretch ended."""

    chosen: Array  # else it fills the row only
    came: Array  # it has a wheel
    landed: Array
    failed: Array
    leaves: Array  # its wheel is done or lost
    code: Array  # STEPPED, or why it is lost
    stands: tuple[WheelMotion, Stance]
    reached: Array  # section state there
    length: Array  # of a step that ends there, m
    lane: _Lanes  # with what it told


def _ended(on: _Walk, chosen: Array, lane: _Lanes, here: March) -> _Ended:
    place = guards_of(on.n, on.one_sided)
    came = chosen & (here.verdict != WAITING)
    ledger = passed(lane.ledger, here.stance, here.time, here.tried)
    at_event = here.verdict == EVENT
    landed = came & at_event & (here.guard == place.foremost)
    known = ledger, place, at_event, here.guard, landed, here.verdict
    code = outcome_at(*known, on.max_events)
    n_stepped = lane.n_stepped + landed
    stands = motion_of(here.here), here.stance
    failed = came & (code != Outcome.STEPPED)
    return _Ended(
        chosen=chosen,
        came=came,
        landed=landed,
        failed=failed,
        leaves=failed | (landed & (n_stepped >= on.n_steps)),
        code=code.astype(jnp.int32),
        stands=stands,
        reached=_over_lanes(closed)(*stands),
        length=place_of_landing(on.n, stands[0]),
        lane=lane._replace(ledger=ledger, n_stepped=n_stepped),
    )


_over_lanes = functools.partial(jax.vmap, in_axes=-1, out_axes=-1)


def _handed_over(queue: _Queue, wanted: Array, ended: _Ended) -> tuple[_Queue, Array, Array, Array]:
    """Wheels that are done or lost are told, and make room for the next ones.

    Also says which lanes are free, which of them are filled, and each lane's place in the queue.
    """
    lane = ended.lane
    to = jnp.where(ended.leaves, lane.wheel, QUEUE)
    put = lambda old, new: old.at[..., to].set(new, mode="drop")
    free = ended.leaves | (ended.chosen & ~ended.came)
    following = queue.next + jnp.cumsum(free.astype(jnp.int32)) - 1
    fills = free & (following < wanted)
    wheel = jnp.where(fills, following, lane.wheel)
    queue = queue._replace(
        next=jnp.minimum(queue.next + jnp.sum(free, dtype=jnp.int32), wanted),
        section=put(queue.section, jnp.where(ended.failed, 0.0, ended.reached)),
        durations=put(queue.durations, lane.ledger.durations),
        length=put(queue.length, jnp.where(ended.failed, 0.0, ended.length)),
        outcome=put(queue.outcome, ended.code),
        n_stepped=put(queue.n_stepped, lane.n_stepped),
        tried=put(queue.tried, lane.ledger.tried),
    )
    return queue, free, fills, wheel


def _events(
    on: _Walk, wanted: Array, queue: _Queue, lanes: _Lanes, now: March
) -> tuple[_Queue, _Lanes, March]:
    """Some lanes through their events, or on to the next wheels."""
    n_lanes = now.h.shape[-1]
    ready = (now.verdict != MARCHING) & ((now.verdict != WAITING) | (queue.next < wanted))
    (index,) = jnp.nonzero(ready, size=TOGETHER, fill_value=n_lanes)
    pick = lambda leaf: jnp.take(leaf, index, axis=-1, mode="clip")
    here, lane = jax.tree.map(pick, (now, lanes))
    ended = _ended(on, index < n_lanes, lane, here)
    queue, free, fills, wheel = _handed_over(queue, wanted, ended)
    fresh = lambda leaf: jnp.take(leaf, wheel, axis=-1, mode="clip")

    def begins(columns: Array, x: Array) -> tuple[WheelMotion, Stance]:
        state, stance = opened(on.symbols(columns), x)
        return unpack(state)[0], stance

    def through(columns: Array, motion: WheelMotion, stance: Stance, guard: Array) -> tuple:
        given = on.symbols(columns), columns[-1], on.options, on.one_sided
        change, _, outcome = past(law_of(*given, counted=False), place, motion, stance, guard)
        return change.motion, change.stance, outcome

    # A landing of the foremost foot opens the next step; all go through their events.
    place = guards_of(on.n, on.one_sided)
    opens = fills | (ended.landed & ~ended.leaves)
    columns = jnp.where(fills, fresh(queue.columns), lane.columns)
    x = jnp.where(fills, fresh(queue.start), ended.reached)
    motion, stance = select(opens, _over_lanes(begins)(columns, x), ended.stands)
    guard = jnp.where(opens, place.foot, here.guard)
    motion, stance, outcome = _over_lanes(through)(columns, motion, stance, guard)
    outcome = jnp.where(fills & ~fresh(queue.good), Outcome.BAD_INPUT, outcome)
    after = set_off(on.flow(columns, stance), motion, on.options.first_step)
    verdict = jnp.where(outcome != Outcome.STEPPED, outcome, after.verdict)
    verdict = jnp.where(free & ~fills, WAITING, verdict).astype(jnp.int32)

    told = ended.lane.ledger
    ledger = select(opens, blank(motion.x), told)
    ledger = ledger._replace(events=ledger.events + 1, tried=jnp.where(fills, 0, told.tried))
    n_stepped = jnp.where(fills, 0, ended.lane.n_stepped)
    kept = after._replace(verdict=verdict), _Lanes(wheel, columns, ledger, n_stepped)
    put_back = lambda old, new: old.at[..., index].set(new, mode="drop")
    now, lanes = jax.tree.map(put_back, (now, lanes), kept)
    return queue, lanes, now


def _marches(on: _Walk) -> Callable[[Array, March, Array], March]:
    """The march by columns: by machine code each lane to its event, else until enough are."""
    dynamic, static = eqx.partition(on.options, eqx.is_array)

    def far(columns: Array, now: March, dynamic: Options, enough: Array | None = None) -> March:
        flow = on.flow(columns, now.stance)
        return marched(flow, now, enough, eqx.combine(dynamic, static), on.tableau)

    if not simd.serves():
        return lambda columns, now, enough: far(columns, now, dynamic, enough)
    like = lambda columns, now, dynamic: now
    settings = ("march on real ground", on.n, on.one_sided, static)
    by_machine_code = lane_function(far, like, settings)
    return lambda columns, now, enough: by_machine_code(columns, now, dynamic)


def _empty(queue: _Queue, on: _Walk) -> tuple[_Lanes, March]:
    """Lanes without wheels, in place of which stands the first one."""
    n_lanes = TOGETHER if simd.serves() else LANES
    many = lambda value: jnp.broadcast_to(value[..., None], (*value.shape, n_lanes))
    columns, x = queue.columns[:, 0], queue.start[:, 0]
    state, stance = opened(on.symbols(columns), x)
    columns, motion, stance = jax.tree.map(many, (columns, unpack(state)[0], stance))
    flow = on.flow(columns, stance)
    now = zeros_of(lambda: set_off(flow, motion, on.options.first_step))
    waiting = now.verdict + WAITING
    lanes = _Lanes(waiting * 0, columns, blank(motion.x), waiting * 0)
    return lanes, now._replace(here=place_of(flow, motion), stance=stance, verdict=waiting)
