"""One wheel with unilateral contact, by the machine code of the batch kernel within JAX programs.

`build_contact_step_function` returns a function of one wheel that `jax.vmap` maps onto lanes. For
derivatives, each tangent is a lane of its own beside the wheel's motion. For samples of a step, a
JAX program advances from event to event and records the start of each interval. Then every interval
becomes a lane that is integrated again, sample by sample.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from vrw_jax.models.lane_step import by_argument
from vrw_jax.models.unilateral.along import walked_along
from vrw_jax.models.unilateral.contacts import OFF
from vrw_jax.models.unilateral.lanes import (
    UNDER_WAY,
    Lean,
    Walk,
    Walked,
    started,
    told_like,
    turned,
    walked,
)
from vrw_jax.models.unilateral.march import Place, motion_of, set_off, tried_step
from vrw_jax.models.unilateral.mechanics import WheelMotion, slots_of
from vrw_jax.models.unilateral.motion import Flow, Stance, Tally, pack, unpack
from vrw_jax.numerics import Forward, Options, Tableau, explicit_tableau, one_wheel, sampled
from vrw_jax.runtime import lane_function
from vrw_jax.wheel import parameters_of


class Setting(NamedTuple):
    """Static configuration of a step."""

    structure: Any  # of (wheel, params, x, options), whose leaves are the arrays
    detailed: bool

    def given(self, leaves: tuple[Array, ...]) -> tuple[Array, Array, Any]:
        """Return columns and section states of lanes, and the other settings."""
        wheel, params, x, options = jax.tree.unflatten(self.structure, leaves)
        return jnp.stack([*parameters_of(params), wheel.friction]), x, (wheel, params, options)

    def walk(self, others: Any) -> Walk:
        """Return the batch settings of a walk of one step."""
        wheel, params, options = others
        tableau = explicit_tableau(options.solver)
        assert tableau is not None  # checked by the caller
        rules = wheel.max_events, wheel.one_sided, wheel.by_paper, self.detailed
        return Walk(params.n_legs, 1, *rules, options, tableau)

    def like(self, *leaves: Array) -> tuple:
        """Return arrays in the structure of `compute_outputs`."""
        params = self.given(leaves)[2][1]
        return _parted(told_like(params.n_legs, leaves[0].dtype, self.detailed))

    def told(self, *leaves: Array) -> tuple:
        """Return the result over lanes, which the leaves have on their last axis."""
        columns, x, others = self.given(leaves)
        return _parted(walked(self.walk(others), columns, x))

    def told_along(self, leaves: tuple[Array, ...], ways: tuple[Array, ...]) -> tuple:
        """Return the tangents of the result's floats for one tangent of each lane, the floats, and
        the rest.
        """
        columns, x, others = self.given(leaves)
        d_columns, d_x = (rows[None] for rows in self.given(ways)[:2])
        one = jnp.ones_like(columns[0], jnp.int32)
        walk, moves = walked_along(self.walk(others), columns, x, d_columns, d_x, one)
        moves = jax.tree.map(lambda leaf: leaf[0], moves)
        return _parted(walk._replace(told=moves))[0], *_parted(walk)


def _parted(walk: Walked) -> tuple[Any, Any]:
    """Return floats and other parts of a step: of the full result, or of the four minimal ones."""
    step = walk.told
    if isinstance(step, Lean):
        step = step.section_state, step.durations, walk.outcome, walk.tried
    return eqx.partition(step, eqx.is_inexact_array)


def told_by_lanes(structure: Any, detailed: bool) -> Forward:
    """Return the step over the leaves of (wheel, params, x, options), as a forward rule for any AD
    mode.
    """
    setting = Setting(structure, detailed)
    key = "step on real ground", str(structure), detailed
    return one_wheel(lane_function(setting.told, setting.like, key))


def moved_by_lanes(structure: Any, detailed: bool, moved: tuple[int, ...]) -> Forward:
    """Return the Jacobian of `build_contact_step_function`.

    It gives (Jacobian with respect to the leaves at `input_indices`, floats) and the other outputs.
    """
    setting = Setting(structure, detailed)

    def like(leaves: tuple[Array, ...], _ways: tuple[Array, ...]) -> tuple:
        value, other = setting.like(*leaves)
        return value, value, other

    key = "step on real ground along directions", str(structure), detailed
    along = one_wheel(lane_function(setting.told_along, like, key))

    def jacobian(*leaves: Array) -> tuple:
        *others, options = jax.tree.unflatten(structure, leaves)
        leaves = tuple(jax.tree.leaves((*others, options.for_derivatives())))
        units = np.eye(sum(np.size(leaves[i]) for i in moved))
        ways, begin = [jnp.zeros_like(leaf) for leaf in leaves], 0
        for i in moved:
            rows = units[:, begin : (begin := begin + np.size(leaves[i]))]
            ways[i] = jnp.asarray(rows.reshape(-1, *jnp.shape(leaves[i])), leaves[i].dtype)
        axes = tuple(0 if i in moved else None for i in range(len(leaves)))
        columns, value, other = jax.vmap(along, (None, axes))(leaves, tuple(ways))
        value, other = jax.tree.map(lambda x: x[0], (value, other))
        return (by_argument(columns, leaves, moved), value), other

    return jacobian


class Log(NamedTuple):
    """Start and duration of each interval of a step between two events."""

    state: Array  # (intervals, dim), see `motion.PackedState`
    contact: Array  # (intervals, legs)
    locked: Array
    duration: Array  # s


class Sampled(NamedTuple):
    """Intervals at equal times, both ends included."""

    log: Log
    ends: Lean
    outcome: Array
    state: Array  # (intervals, samples, dim)
    tangential: Array  # on every foot, N, (intervals, samples, legs)
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
    """Return one interval at equal times, ends included, with axes (sample, ., lanes).

    The rows are coordinates, rates, accumulators starting at `accumulated`, and normal and
    tangential forces of the slots.
    """
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
    """Return the sampled motion of a step over the leaves of (wheel, params, x, options).

    It has no derivatives.
    """
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
    """Return rows of `sample_interval` as packed states, and tangential and normal forces of all
    legs.
    """
    n_samples, size = rows.shape[1], 3 + n
    clock = jnp.linspace(0.0, 1.0, n_samples) * log.duration[:, None]
    q, v, tally, forces = jnp.split(rows, (size, 2 * size, 2 * size + 3), -1)
    state = [q[..., :3], v[..., :3], q[..., 3:], v[..., 3:], clock[..., None], tally]
    slots = jax.vmap(lambda contact: slots_of(contact != OFF))(log.contact)
    of_legs = jax.vmap(jax.vmap(lambda slots, pair: slots.spread(pair), (None, 0)))
    normal, tangential = (of_legs(slots, forces[..., i : i + 2]) for i in (0, 2))
    return jnp.concatenate(state, -1), tangential, normal
