"""Walks of many wheels with unilateral contact, in lanes side by side.

The laws are those of one wheel, elementwise over lanes. A lane at an event is resolved, and then
all lanes are integrated further (`integrate_interval`). A landing of the foremost foot is an event
like any other. On a CPU all of it is one machine-code program in which few lanes are idle;
elsewhere XLA compiles the same source.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from vrw_jax.models.unilateral.ledger import (
    Details,
    Ledger,
    as_ruled,
    blank,
    event_noted,
    law_of,
    no_details,
    outcome_at,
    passed,
    past,
    section_reached,
    step_told,
    stretch_noted,
)
from vrw_jax.models.unilateral.march import (
    EVENT,
    MARCHING,
    N_TALLIED,
    March,
    Place,
    coordinates,
    marched,
    motion_of,
    set_off,
)
from vrw_jax.models.unilateral.mechanics import WheelMotion, place_of_landing, stilled
from vrw_jax.models.unilateral.motion import (
    Flow,
    Stance,
    Tally,
    flow_of,
    forces,
    guards_of,
    least_stopper_force,
)
from vrw_jax.models.unilateral.section import closed, made_sound, opened
from vrw_jax.numerics import Options, Tableau, select, zeros_of
from vrw_jax.wheel import Outcome, Symbols, parameters_of, symbols_of, wheel_of

UNDER_WAY = -1
"""Code of an unfinished lane in place of its outcome."""


class Lean(NamedTuple):
    """Summary of the last step of a walk."""

    section_state: Array
    durations: Array  # (3, lanes)
    step_length: Array


class Walked(NamedTuple):
    """Result of a walk, for every lane."""

    told: Any  # of the last step: `StepSummary`, or a `UnilateralStep`
    outcome: Array
    n_stepped: Array
    tried: Array


def told_like(n: int, dtype: Any, detailed: bool) -> Walked:
    """Return zeros in the structure of the result of one wheel with n legs."""
    zero, none = jnp.zeros((), dtype), jnp.zeros((), jnp.int32)
    legs, off = jnp.zeros(n, dtype), jnp.zeros(n, jnp.int32)
    stands = WheelMotion(*(zero,) * 6, legs, legs), Stance(off, *(off > 0,) * 4)
    told: Any = Lean(closed(*stands), jnp.zeros(3, dtype), zero)
    if detailed:
        tally = Tally(zero, zero, zero, zero)
        told = step_told(*stands, tally, blank(zero), no_details(dtype), none, "lanes")
    return Walked(told, none, none, none)


class Moves(NamedTuple):
    """Differentiable part of a lane's state."""

    q: Array
    v: Array
    told: tuple[Array | None, Array | None]  # in this step, and since the last event
    time: Array
    durations: Array
    details: Any  # their floats


class Lane(NamedTuple):
    """State of a lane."""

    now: March
    ledger: Ledger  # of this step; attempted solver steps count over the walk
    details: Details | None  # of this step, if requested
    tally: Array | None  # rows of `IntervalState.accumulated`, of this step
    n_stepped: Array
    outcome: Array

    def moves(self) -> Moves:
        """Return the differentiable part of the state."""
        here, details = self.now.here, eqx.filter(self.details, eqx.is_inexact_array)
        told = self.tally, self.now.told
        return Moves(here.q, here.v, told, self.now.time, self.ledger.durations, details)

    def moved(self, moves: Moves) -> "Lane":
        """Return the state with another differentiable part."""
        tally, told = moves.told
        here = self.now.here._replace(q=moves.q, v=moves.v)
        rest = eqx.filter(self.details, eqx.is_inexact_array, inverse=True)
        return self._replace(
            now=self.now._replace(here=here, told=told, time=moves.time),
            ledger=self.ledger._replace(durations=moves.durations),
            details=eqx.combine(moves.details, rest),
            tally=tally,
        )


class Walk(NamedTuple):
    """Settings common to all wheels of a batch."""

    n: int
    n_steps: Array | int
    max_events: int
    one_sided: bool
    by_paper: bool
    detailed: bool  # whether full results of the step are requested
    options: Options
    tableau: Tableau

    def flow(self, columns: Array, stance: Stance) -> Flow:
        """Return the dynamics of the lanes in this contact state."""
        s, friction = self.of(columns)
        return flow_of(s, friction, self.one_sided, stance, self.detailed)

    def of(self, columns: Array) -> tuple[Symbols, Array]:
        """Return symbols and friction of the columns."""
        return symbols_of(self.n, *columns[:-1]), as_ruled(columns[-1], self.by_paper)

    def begun(self, columns: Array, x: Array) -> Lane:
        """Return the lanes at the first landing of their walk, before it is resolved."""
        motion, stance = opened(self.of(columns)[0], x)
        flow = self.flow(columns, stance)
        now = zeros_of(lambda: set_off(flow, motion, self.options.first_step))
        q, v = coordinates(motion)
        here = Place(q, v, jnp.full_like(now.here.slope, jnp.inf))
        now = now._replace(here=here, stance=stance, verdict=now.verdict + EVENT)
        return Lane(now, *self._blank(x[0]), now.guard * 0, now.guard * 0 + UNDER_WAY)

    def _blank(self, like: Array) -> tuple[Ledger, Details | None, Array | None]:
        """Return counters, details and accumulators at the start of a step."""
        if not self.detailed:
            return blank(like), None, None
        many = lambda leaf: jnp.broadcast_to(leaf[..., None], (*leaf.shape, *like.shape))
        details = jax.tree.map(many, no_details(like.dtype))
        return blank(like), details, jnp.zeros((N_TALLIED, *like.shape), like.dtype)

    def past_events(self, columns: Array, lane: Lane) -> Lane:
        """Return the stopped lanes after their events, or at the end of their walk."""
        now, place = lane.now, guards_of(self.n, self.one_sided)
        s, friction = self.of(columns)
        ledger = passed(lane.ledger, now.stance, now.time, now.tried)
        details, tally = lane.details, lane.tally
        if details is not None and tally is not None and now.told is not None:
            before = self.flow(columns, now.stance)
            details = stretched(details, before, motion_of(now.here), now.time)
            tally = tally + now.told
        at_event = now.verdict == EVENT
        landed = at_event & (now.guard == place.foremost)
        known = ledger, place, at_event, now.guard, landed, now.verdict
        outcome = outcome_at(*known, self.max_events).astype(jnp.int32)
        n_stepped = lane.n_stepped + landed
        ends = (outcome != Outcome.STEPPED) | (landed & (n_stepped >= self.n_steps))
        over = Lane(now, ledger, details, tally, n_stepped, outcome)

        # A landing of the foremost foot opens the next step; every event is processed.
        opens, motion = landed & ~ends, motion_of(now.here)
        reopened = opened(s, closed(motion, now.stance))
        motion, stance = select(opens, reopened, (motion, now.stance))
        fresh, *others = self._blank(motion.x)
        fresh = fresh._replace(tried=ledger.tried)
        ledger, details, tally = select(opens, (fresh, *others), (ledger, details, tally))
        guard = jnp.where(opens, place.foot, now.guard)
        law = law_of(s, friction, self.options, self.one_sided, counted=self.detailed)
        at = guard, ledger.events, self.max_events
        change, event, code = past(law, place, motion, stance, *at)
        flow = self.flow(columns, change.stance)
        after = set_off(*stilled((flow, change.motion, self.options.first_step)))
        q, v = coordinates(change.motion)
        verdict = jnp.where(code != Outcome.STEPPED, code, after.verdict)
        after = after._replace(here=after.here._replace(q=q, v=v), verdict=verdict)
        if details is not None:
            details = event_noted(details, ledger.events == 0, change, event)
            none = jnp.zeros_like(motion.x)
            details = stretched(details, flow, change.motion, none)
        ledger = ledger._replace(events=ledger.events + 1)
        goes = Lane(after, ledger, details, tally, n_stepped, lane.outcome)
        ended = (now.verdict != MARCHING) & (lane.outcome == UNDER_WAY)
        return select(ended, select(ends, over, goes), lane)

    def told(self, lane: Lane) -> Any:
        """Return the result of the last step, for finished lanes."""
        stands, code = (motion_of(lane.now.here), lane.now.stance), lane.outcome
        if lane.details is not None and lane.tally is not None:
            tally = Tally(jnp.zeros_like(lane.tally[0]), *lane.tally)
            return step_told(*stands, tally, lane.ledger, lane.details, code, "lanes")
        return self.lean(stands, lane.ledger, code)

    def lean(self, stands: tuple[WheelMotion, Stance], ledger: Ledger, code: Array) -> Lean:
        """Return the summary of a step with this final state."""
        landed = jnp.where(code == Outcome.STEPPED, place_of_landing(self.n, stands[0]), 0.0)
        return Lean(section_reached(*stands, code), ledger.durations, landed)

    def sound(self, columns: Array, x: Array) -> tuple[Array, Array, Array]:
        """Return columns and states with valid input in every lane, and which lanes were valid."""
        good, params, friction, x = made_sound(wheel_of(columns[:-1], self.n), columns[-1], x)
        return jnp.stack([*parameters_of(params), friction]), x, good

    def barred(self, lane: Lane, good: Array) -> Lane:
        """Return the lane state with invalid lanes deactivated."""
        return lane._replace(outcome=jnp.where(good, lane.outcome, Outcome.BAD_INPUT))


def stretched(details: Details, flow: Flow, motion: WheelMotion, duration: Array) -> Details:
    """Return the details with the stopper forces at one end of an interval."""
    force = least_stopper_force(flow, forces(flow, motion))
    return stretch_noted(details, flow.contact, duration, force)


def started(on: Walk, columns: Array, x: Array) -> tuple[Array, Lane]:
    """Return valid columns, and the lanes before their first landing."""
    columns, x, good = on.sound(columns, x)
    return columns, on.barred(on.begun(columns, x), good)


def turned(on: Walk, columns: Array, lane: Lane, waits: bool = False) -> tuple[Lane, Lane]:
    """Return the lanes after their events, and the lanes integrated further.

    - `waits_for_events`: integrate every lane to its next event.
    """
    past = on.past_events(columns, lane)
    hurry, flow_at = past.outcome == UNDER_WAY, lambda c: on.flow(c, past.now.stance)
    hurry = hurry & (not waits)
    now = marched(flow_at, columns, past.now, hurry, on.options, on.tableau)
    return past, past._replace(now=now)


def walked(on: Walk, columns: Array, x: Array) -> Walked:
    """Return every lane after `n_steps` landings of the foremost foot."""
    columns, lane = started(on, columns, x)
    turn = lambda lane: turned(on, columns, lane)[1]
    goes_on = lambda lane: jnp.any(lane.outcome == UNDER_WAY)
    lane = lax.while_loop(goes_on, turn, lane)
    return Walked(on.told(lane), lane.outcome, lane.n_stepped, lane.ledger.tried)
