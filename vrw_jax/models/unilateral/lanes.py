"""Gait steps of many wheels on real ground at once, and along a direction of each.

The laws are those of one wheel, element by element over lanes. All lanes march
(`march`) until some, on a CPU all, have come to events; these are taken through them
together, and all march on. A landing of the foremost foot is an event like others; a lane whose
wheel has made its steps takes the next wheel in the queue. So hardly a lane waits for another.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from vrw_jax import simd
from vrw_jax.models.unilateral.ledger import (
    Details,
    Ledger,
    blank,
    event_noted,
    law_of,
    no_details,
    outcome_at,
    passed,
    past,
    stretch_noted,
)
from vrw_jax.models.unilateral.march import (
    EVENT,
    FORCE,
    MARCHING,
    N_TALLIED,
    WAITING,
    March,
    Way,
    marched,
    marched_along,
    motion_of,
    place_of,
    set_off,
)
from vrw_jax.models.unilateral.mechanics import WheelMotion, place_of_landing
from vrw_jax.models.unilateral.motion import Flow, Stance, Tally, flow_of, guards_of, unpack
from vrw_jax.models.unilateral.section import closed, made_sound, opened
from vrw_jax.models.unilateral.wheel import (
    as_ruled,
    section_reached,
    step_told,
)
from vrw_jax.numerics import (
    Options,
    Tableau,
    select,
    without_derivative,
    zeros_of,
)
from vrw_jax.runtime import lane_function
from vrw_jax.wheel import (
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


class _Lean(NamedTuple):
    """What a walk tells of its last step where no more is wanted."""

    section_state: Array
    durations: Array  # (3, wheels)
    step_length: Array


class _Queue(NamedTuple):
    """Wheels that wait, and what became of those that do no more; wheels on the last axis."""

    columns: Array  # parameters and friction
    start: Array  # section states, (n_full, wheels)
    good: Array
    next: Array  # wheel to be taken
    told: Any  # of the last step: `_Lean`, or a `UnilateralStep`
    outcome: Array
    n_stepped: Array
    tried: Array


class _Lanes(NamedTuple):
    """What a lane keeps beside its march."""

    wheel: Array  # its place in the queue
    columns: Array
    ledger: Ledger  # of this step; steps tried are all of the wheel's
    n_stepped: Array
    details: Details | None  # of this step, where they are wanted
    tally: Array | None  # rows of `March.told`, of this step


class Walk(NamedTuple):
    """What holds for all wheels of a batch."""

    n: int
    n_steps: Array
    max_events: int
    one_sided: bool
    by_paper: bool
    detailed: bool  # everything that a step tells is wanted
    options: Options
    tableau: Tableau

    def symbols(self, columns: Array) -> Symbols:
        """Of one wheel, or of lanes."""
        return symbols_of(self.n, *columns[:-1])

    def flow(self, columns: Array, stance: Stance) -> Flow:
        """Of lanes in their stances."""
        s, friction = self.symbols(columns), self.friction(columns)
        return flow_of(s, friction, self.one_sided, stance, self.detailed)

    def begun(self, columns: Array, x: Array) -> tuple[WheelMotion, Stance]:
        """One wheel at its section state, in the labels of the step that begins."""
        state, stance = opened(self.symbols(columns), x)
        return unpack(state)[0], stance

    def friction(self, columns: Array) -> Array:
        """Of lanes, or of one."""
        return as_ruled(columns[-1], self.by_paper)

    def told(self, stands: tuple[WheelMotion, Stance], lane: "_Lanes", code: Array) -> Any:
        """Of the last step of lanes that stand there."""
        if lane.details is None or lane.tally is None:
            section = _over_lanes(section_reached)(*stands, code)
            length = place_of_landing(self.n, stands[0])
            landed = jnp.where(code == Outcome.STEPPED, length, 0.0)
            return _Lean(section, lane.ledger.durations, landed)
        tally = Tally(jnp.zeros_like(lane.tally[0]), *lane.tally)
        given = *stands, tally, lane.ledger, lane.details, code
        return _over_lanes(step_told)(*given)

    def untold(self, columns: Array, x: Array) -> Any:
        """The same with zeros, of wheels at these section states."""

        def told(columns: Array, x: Array) -> Any:
            stands, none = _over_lanes(self.begun)(columns, x), jnp.zeros(x.shape[1:], jnp.int32)
            ledger, details, tally = self.blank_step(x[0])
            return self.told(stands, _Lanes(none, columns, ledger, none, details, tally), none)

        return zeros_of(told, columns, x)

    def blank_step(self, like: Array) -> tuple[Ledger, Details | None, Array | None]:
        """What a step of lanes begins with."""
        if not self.detailed:
            return blank(like), None, None
        many = lambda leaf: jnp.broadcast_to(leaf[..., None], (*leaf.shape, *like.shape))
        details = jax.tree.map(many, no_details(like.dtype))
        return blank(like), details, jnp.zeros((N_TALLIED, *like.shape), like.dtype)


def queue_of(columns: Array, x: Array, on: Walk) -> _Queue:
    n = on.n

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
        told=on.untold(columns, x),
        outcome=jnp.where(good, Outcome.STEPPED, Outcome.BAD_INPUT).astype(jnp.int32),
        n_stepped=none,
        tried=none,
    )


def walked_through(queue: _Queue, wanted: Array, on: Walk) -> tuple:
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
    return queue.told, queue.outcome, queue.n_stepped, queue.tried


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
    lane: _Lanes  # with what it told


def _ended(on: Walk, chosen: Array, lane: _Lanes, here: March) -> _Ended:
    place = guards_of(on.n, on.one_sided)
    came = chosen & (here.verdict != WAITING)
    lane = lane._replace(ledger=passed(lane.ledger, here.stance, here.time, here.tried))
    if lane.details is not None and lane.tally is not None and here.told is not None:
        contact = on.flow(lane.columns, here.stance).contact
        given = contact, here.time, here.here.slope[FORCE]
        details = _over_lanes(stretch_noted)(lane.details, *given)
        lane = lane._replace(details=details, tally=lane.tally + here.told)
    at_event = here.verdict == EVENT
    landed = came & at_event & (here.guard == place.foremost)
    known = lane.ledger, place, at_event, here.guard, landed, here.verdict
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
        lane=lane._replace(n_stepped=n_stepped),
    )


_over_lanes = functools.partial(jax.vmap, in_axes=-1, out_axes=-1)


def _handed_over(
    on: Walk, queue: _Queue, wanted: Array, ended: _Ended
) -> tuple[_Queue, Array, Array, Array]:
    """Wheels that are done or lost are told, and make room for the next ones.

    Also says which lanes are free, which of them are filled, and each lane's place in the queue.
    """
    lane = ended.lane
    to = jnp.where(ended.leaves, lane.wheel, QUEUE)
    put = lambda old, new: old.at[..., to].set(new, mode="drop")
    told = on.told(ended.stands, lane, ended.code)
    free = ended.leaves | (ended.chosen & ~ended.came)
    following = queue.next + jnp.cumsum(free.astype(jnp.int32)) - 1
    fills = free & (following < wanted)
    wheel = jnp.where(fills, following, lane.wheel)
    queue = queue._replace(
        next=jnp.minimum(queue.next + jnp.sum(free, dtype=jnp.int32), wanted),
        told=jax.tree.map(put, queue.told, told),
        outcome=put(queue.outcome, ended.code),
        n_stepped=put(queue.n_stepped, lane.n_stepped),
        tried=put(queue.tried, lane.ledger.tried),
    )
    return queue, free, fills, wheel


def _events(
    on: Walk, wanted: Array, queue: _Queue, lanes: _Lanes, now: March
) -> tuple[_Queue, _Lanes, March]:
    """Some lanes through their events, or on to the next wheels."""
    n_lanes = now.h.shape[-1]
    ready = (now.verdict != MARCHING) & ((now.verdict != WAITING) | (queue.next < wanted))
    (index,) = jnp.nonzero(ready, size=TOGETHER, fill_value=n_lanes)
    pick = lambda leaf: jnp.take(leaf, index, axis=-1, mode="clip")
    here, lane = jax.tree.map(pick, (now, lanes))
    ended = _ended(on, index < n_lanes, lane, here)
    queue, free, fills, wheel = _handed_over(on, queue, wanted, ended)
    fresh = lambda leaf: jnp.take(leaf, wheel, axis=-1, mode="clip")

    def through(
        columns: Array,
        motion: WheelMotion,
        stance: Stance,
        guard: Array,
        first: Array,
        details: Details | None,
    ) -> tuple:
        given = on.symbols(columns), on.friction(columns), on.options, on.one_sided
        law = law_of(*given, counted=on.detailed)
        change, event, outcome = past(law, place, motion, stance, guard)
        if details is not None:
            details = event_noted(details, first, change, event)
        return change.motion, change.stance, outcome, details

    # A landing of the foremost foot opens the next step; all go through their events.
    place = guards_of(on.n, on.one_sided)
    opens = fills | (ended.landed & ~ended.leaves)
    columns = jnp.where(fills, fresh(queue.columns), lane.columns)
    x = jnp.where(fills, fresh(queue.start), ended.reached)
    motion, stance = select(opens, _over_lanes(on.begun)(columns, x), ended.stands)
    guard = jnp.where(opens, place.foot, here.guard)
    ledger, details, tally = ended.lane.ledger, ended.lane.details, ended.lane.tally
    tried = jnp.where(fills, 0, ledger.tried)
    known = on.blank_step(motion.x), (ledger, details, tally)
    ledger, details, tally = select(opens, *known)
    led = _over_lanes(through)(columns, motion, stance, guard, opens, details)
    motion, stance, outcome, details = led
    outcome = jnp.where(fills & ~fresh(queue.good), Outcome.BAD_INPUT, outcome)
    after = _still(set_off(on.flow(columns, stance), motion, on.options.first_step))
    verdict = jnp.where(outcome != Outcome.STEPPED, outcome, after.verdict)
    verdict = jnp.where(free & ~fills, WAITING, verdict).astype(jnp.int32)

    if details is not None:
        contact, none = on.flow(columns, stance).contact, jnp.zeros_like(motion.x)
        details = _over_lanes(stretch_noted)(details, contact, none, after.here.slope[FORCE])
    ledger = ledger._replace(events=ledger.events + 1, tried=tried)
    n_stepped = jnp.where(fills, 0, ended.lane.n_stepped)
    lane = _Lanes(wheel, columns, ledger, n_stepped, details, tally)
    kept = after._replace(verdict=verdict), lane
    put_back = lambda old, new: old.at[..., index].set(new, mode="drop")
    now, lanes = jax.tree.map(put_back, (now, lanes), kept)
    return queue, lanes, now


def _still(now: March) -> March:
    """Only the place moves along a direction, and what is told."""
    q, v = now.here.q, now.here.v
    still = lax.stop_gradient(now)
    return still._replace(here=still.here._replace(q=q, v=v))


def _marches(on: Walk) -> Callable[[Array, March, Array], March]:
    """The march by columns: by machine code each lane to its event, else until enough are.

    Along a direction of columns and place it is `marched_along`.
    """
    dynamic, static = eqx.partition(on.options, eqx.is_array)

    def of(
        march: Callable, columns: Array, now: March, more: tuple, dynamic: Options, *few: Array
    ) -> Any:
        flow_at = lambda columns: on.flow(columns, now.stance)
        enough = few[0] if few else None
        return march(flow_at, columns, now, *more, enough, eqx.combine(dynamic, static), on.tableau)

    def far(columns: Array, now: March, dynamic: Options, *few: Array) -> March:
        return of(marched, columns, now, (), dynamic, *few)

    def along(
        columns: Array, now: March, way: Way, dynamic: Options, *few: Array
    ) -> tuple[March, Way]:
        return of(marched_along, columns, now, (way,), dynamic, *few)

    goes, goes_along, waits = far, along, True
    if simd.serves():
        settings, waits = (
            ("march on real ground", on.n, on.one_sided, on.by_paper, on.detailed, static),
            False,
        )
        goes = lane_function(far, lambda columns, now, dynamic: now, settings)
        like = lambda columns, now, way, dynamic: (now, way)
        goes_along = lane_function(along, like, ("along", *settings))

    @jax.custom_jvp
    def marches(columns: Array, now: March, dynamic: Options, *few: Array) -> March:
        return goes(columns, now, dynamic, *few)

    @marches.defjvp
    def rule(at: tuple, along: tuple) -> tuple[March, March]:
        columns, now, dynamic, *few = at
        d_columns, moves, *_ = along
        later = jnp.zeros_like(now.time)
        way = Way(d_columns, moves.here.q, moves.here.v, moves.told, later)
        after, way = goes_along(columns, now, way, dynamic, *few)
        nothing = without_derivative(after)
        here = nothing.here._replace(q=way.q, v=way.v)
        return after, nothing._replace(here=here, told=way.told, time=way.later)

    return lambda columns, now, enough: marches(columns, now, dynamic, *((enough,) * waits))


def _empty(queue: _Queue, on: Walk) -> tuple[_Lanes, March]:
    """Lanes without wheels, in place of which stands the first one."""
    n_lanes = TOGETHER if simd.serves() else LANES
    many = lambda value: jnp.broadcast_to(value[..., None], (*value.shape, n_lanes))
    columns, x = queue.columns[:, 0], queue.start[:, 0]
    state, stance = opened(on.symbols(columns), x)
    columns, motion, stance = jax.tree.map(many, (columns, unpack(state)[0], stance))
    flow = on.flow(columns, stance)
    now = zeros_of(lambda: set_off(flow, motion, on.options.first_step))
    waiting = now.verdict + WAITING
    ledger, details, tally = on.blank_step(motion.x)
    lanes = _Lanes(waiting * 0, columns, ledger, waiting * 0, details, tally)
    return lanes, now._replace(here=place_of(flow, motion), stance=stance, verdict=waiting)
