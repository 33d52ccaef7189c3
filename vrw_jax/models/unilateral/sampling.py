"""The motion of a step on real ground, sampled between its events by the machine code of lanes.

A program of JAX goes from event to event and notes where each stretch begins; then every stretch is
a lane that is walked again, sample by sample.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from vrw_jax.models.unilateral.contacts import OFF
from vrw_jax.models.unilateral.lanes import UNDER_WAY, Lean, started, turned
from vrw_jax.models.unilateral.march import Place, motion_of, set_off, tried_step
from vrw_jax.models.unilateral.mechanics import WheelMotion, slots_of
from vrw_jax.models.unilateral.motion import Flow, Stance, Tally, pack, unpack
from vrw_jax.models.unilateral.single import Setting
from vrw_jax.numerics import Options, Tableau, one_wheel, sampled
from vrw_jax.runtime import lane_function


class Log(NamedTuple):
    """Where each stretch of a step between two events begins, and how long it lasts."""

    state: Array  # (stretches, dim), see `motion.State`
    contact: Array  # (stretches, legs)
    locked: Array
    duration: Array  # s


class Sampled(NamedTuple):
    """Stretches at equal times, both ends included."""

    log: Log
    ends: Lean
    outcome: Array
    state: Array  # (stretches, samples, dim)
    tangential: Array  # forces on every foot, N, (stretches, samples, legs)
    normal: Array


def samples(
    flow: Flow,
    motion: WheelMotion,
    told: Array,
    duration: Array,
    n_samples: int,
    options: Options,
    tableau: Tableau,
) -> Array:
    """Of a stretch, at equal times, ends included: coordinates, rates, what is summed up, beginning
    with `told`, normal and tangential forces of the slots; (samples, ., lanes)."""
    begin = set_off(flow, motion, options.first_step)

    def take(now: tuple[Place, Array], length: Array) -> tuple[tuple[Place, Array], Array]:
        here, told = now
        tried = tried_step(flow, tableau, options, begin._replace(here=here, h=length))
        assert tried.told is not None
        return (tried.end, told + tried.told), tried.squared

    def rows(now: tuple[Place, Array]) -> Array:
        (q, v, slope), told = now
        return jnp.concatenate([q, v, told, slope[len(q) : len(q) + 4]])

    return sampled(take, rows, (begin.here, told), tableau, duration, n_samples, options)


@functools.cache
def sampled_by_lanes(structure: Any, n_samples: int) -> Callable[..., Sampled]:
    """The motion of a step, over the leaves of (wheel, params, x, options): without derivatives."""
    setting = Setting(structure, True)
    key = str(structure)

    def first(*leaves: Array) -> Any:
        columns, x, others = setting.given(leaves)
        return started(setting.walk(others), columns, x)[1]

    def following(leaves: tuple[Array, ...], lane: Any) -> tuple[Any, Log]:
        columns, x, others = setting.given(leaves)
        on = setting.walk(others)
        past, lane = turned(on, on.sound(columns, x)[0], lane, waits=True)
        assert past.tally is not None
        (here, stance), zero = (past.now.here, past.now.stance), jnp.zeros_like(lane.now.time)
        state = pack(motion_of(here), Tally(zero, *past.tally))
        return lane, Log(state, stance.contact, stance.locked, lane.now.time)

    def between(leaves: tuple[Array, ...], log: Log) -> Array:
        columns, x, others = setting.given(leaves)
        on, none = setting.walk(others), log.locked & False
        stance = Stance(log.contact, log.locked, none, none, none)
        motion, tally = unpack(log.state)
        flow = on.flow(on.sound(columns, x)[0], stance)
        given = jnp.stack(tally[1:]), log.duration, n_samples, on.options, on.tableau
        return samples(flow, motion, *given)

    def run(*leaves: Array) -> Sampled:
        wheel, params, *_ = jax.tree.unflatten(structure, leaves)
        begin = lane_at_first(*leaves)
        form = jax.eval_shape(to_next, leaves, begin)[1]
        many = lambda leaf: jnp.zeros((wheel.max_events, *leaf.shape), leaf.dtype)

        def go_on(state: tuple) -> tuple:
            before, log = state
            lane, row = to_next(leaves, before)
            place = before.ledger.events
            place = jnp.where(lane.ledger.events > place, place, wheel.max_events)
            noted = lambda old, new: old.at[place].set(new, mode="drop")
            return lane, jax.tree.map(noted, log, row)

        goes_on = lambda state: state[0].outcome == UNDER_WAY
        lane, log = lax.while_loop(goes_on, go_on, (begin, jax.tree.map(many, form)))
        stands, on = (
            (motion_of(lane.now.here), lane.now.stance),
            setting.walk(setting.given(leaves)[2]),
        )
        ends = on.lean(stands, lane.ledger, lane.outcome)
        rows = jax.vmap(lambda log: within(leaves, log))(log)
        return Sampled(log, ends, lane.outcome, *_spread(params.n_legs, log, rows))

    lane_at_first = one_wheel(lane_function(first, first, ("start on real ground", key)))
    like = lambda leaves, lane: (lane, Log(*(lane.now.time,) * 4))
    to_next = one_wheel(lane_function(following, like, ("to the next event", key)))
    within = one_wheel(
        lane_function(
            between, lambda leaves, log: log.duration, ("samples on real ground", key, n_samples)
        )
    )
    return jax.jit(run)


def _spread(n: int, log: Log, rows: Array) -> tuple[Array, Array, Array]:
    """Rows of `samples` as states, and tangential and normal forces of all legs."""
    n_samples, size = rows.shape[1], 3 + n
    clock = jnp.linspace(0.0, 1.0, n_samples) * log.duration[:, None]
    q, v, tally, forces = jnp.split(rows, (size, 2 * size, 2 * size + 3), -1)
    state = [q[..., :3], v[..., :3], q[..., 3:], v[..., 3:], clock[..., None], tally]
    slots = jax.vmap(lambda contact: slots_of(contact != OFF))(log.contact)
    of_legs = jax.vmap(jax.vmap(lambda slots, pair: slots.spread(pair), (None, 0)))
    normal, tangential = (of_legs(slots, forces[..., i : i + 2]) for i in (0, 2))
    return jnp.concatenate(state, -1), tangential, normal
