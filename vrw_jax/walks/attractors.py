"""Attractors: many starts, each walked until its motion is periodic or the wheel falls.

Starts may belong to different wheels. Starts without a result after a round are packed together
for the next round, so that long transients cost little.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from vrw_jax.models import (
    AbstractWheel,
    UnilateralWheel,
    as_full_states,
    step_lanes,
    walk_lanes,
)
from vrw_jax.numerics import Options, in_batches, taken
from vrw_jax.walks.stepping import walk
from vrw_jax.wheel import Outcome, WheelParams

ROUND = 10
"""Number of steps between two tests for periodic motion."""

BLOCK = 128
"""Number of starts per compiled call; one shape is compiled once."""

REPEATS = 1e-7
"""Largest change of the section states over one period in periodic motion."""

ARRIVED = 1e-3
"""Distance from its orbit below which a walk has reached the orbit."""

SAME = 1e-4
"""Distance below which two orbits are the same."""


class Settled(NamedTuple):
    """Ends of walks, as numpy arrays with a leading axis over starts."""

    outcome: np.ndarray  # STEPPED if it still walks
    period: np.ndarray  # of its orbit, in steps; 0 if the motion is not periodic
    steps: np.ndarray  # until it reached its orbit, or fell
    orbit: np.ndarray  # (start, max_period, m): section states, lowest dtheta- first, then NaN


@eqx.filter_jit
def _walk_block(
    model: AbstractWheel, options: Options, params: WheelParams, x: Array
) -> tuple[Array, Array]:
    """Return section states and outcomes of one round of steps from a block of starts."""
    one = lambda params, x: walk(params, x, ROUND, model=model, options=options)
    walks = jax.vmap(one)(params, x)
    return walks.steps.section_state, walks.steps.outcome


def _by_lanes(
    model: Any, options: Options, params: WheelParams, x: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the same for unilateral contact and any number of wheels, by the batch kernel."""
    n, columns = params.n_legs, np.asarray(jax.vmap(model.values)(params)).T
    x = as_full_states(columns, np.asarray(x), n)
    states, codes = list[np.ndarray](), list[np.ndarray]()
    for _ in range(ROUND):
        x, _, outcome, *_ = walk_lanes(columns, x, 1, model, options, n)
        # A wheel that fell has no section state, so its outcome is kept.
        outcome = outcome if not codes else np.where(codes[-1] > 0, codes[-1], outcome)
        states.append(x)
        codes.append(outcome)
    return np.stack(states, 1), np.stack(codes, 1)


WALKS: dict[str, Callable[..., tuple]] = {"unilateral": _by_lanes}
"""Functions that walk one round of many starts, for models that do not walk it by blocks."""


def settle(
    params: WheelParams,
    starts: np.ndarray,
    model: AbstractWheel,
    options: Options,
    most_steps: int,
    longest_period: int,
) -> Settled:
    """Return how each walk ends; `params` is one wheel or has the leading axis of the starts."""
    n = len(starts)
    fill = lambda x: np.broadcast_to(np.asarray(x), n)
    wheels = jax.tree.map(fill, params)
    n_rounds = -(-most_steps // ROUND)
    history = np.full((n, 1 + n_rounds * ROUND, starts.shape[1]), np.nan)
    history[:, 0] = starts
    outcome = np.full(n, int(Outcome.STEPPED))
    period, walked = np.zeros(n, int), np.zeros(n, int)
    open_ = np.arange(n)
    by_rung = WALKS.get(model.rung)
    walked_on = functools.partial(by_rung or _walk_block, model, options)
    step_on = walked_on if by_rung else functools.partial(in_batches, walked_on, (BLOCK,))
    for k in range(n_rounds):
        now = slice(1 + k * ROUND, 1 + (k + 1) * ROUND)
        here = taken(wheels, open_), history[open_, k * ROUND]
        states, codes = map(np.asarray, step_on(*here))
        history[open_, now], outcome[open_] = states, codes[:, -1]
        walked[open_] = k * ROUND + np.sum(codes == Outcome.STEPPED, 1)
        known = (k + 1) * ROUND
        period[open_] = _periods(history[open_, : known + 1], longest_period)
        period[outcome != Outcome.STEPPED] = 0
        open_ = open_[(outcome[open_] == Outcome.STEPPED) & (period[open_] == 0)]
        if not len(open_):
            break
    orbit = np.full((n, longest_period, starts.shape[1]), np.nan)
    for i in np.flatnonzero(period):
        last = history[i, walked[i] + 1 - period[i] : walked[i] + 1]
        orbit[i, : period[i]] = np.roll(last, -int(np.argmin(last[:, 1])), axis=0)
        away = np.linalg.norm(history[i, : walked[i] + 1, None] - last[None], axis=-1).min(1)
        beyond = np.flatnonzero(away > ARRIVED)
        walked[i] = beyond[-1] + 1 if len(beyond) else 0
    return Settled(outcome, period, walked, orbit)


def _periods(history: np.ndarray, longest: int) -> np.ndarray:
    """Return the shortest period, in steps, that the last two periods confirm, or 0."""
    found = np.zeros(len(history), int)
    last = history.shape[1]
    for p in range(min(longest, (last - 1) // 3), 0, -1):
        change = np.abs(history[:, last - 2 * p :] - history[:, last - 3 * p : last - p])
        found[change.max((1, 2)) < REPEATS] = p
    return found


class Attractors(NamedTuple):
    """Distinct orbits of many starts, ordered by decreasing number of starts."""

    of_start: np.ndarray  # index of the orbit of each start; -1 without an orbit
    orbits: list[np.ndarray]  # (period, m) each


def distinct(settled: Settled) -> Attractors:
    """Return the distinct orbits, compared without regard to their first step."""
    index = np.full(len(settled.period), -1)
    orbits: list[np.ndarray] = []
    for i in np.flatnonzero(settled.period):
        own = settled.orbit[i, : settled.period[i]]
        for j, known in enumerate(orbits):
            if len(known) == len(own) and np.abs(known - own).max() < SAME:
                index[i] = j
                break
        else:
            index[i] = len(orbits)
            orbits.append(own)
    count = [int(np.sum(index == j)) for j in range(len(orbits))]
    order = np.argsort(count)[::-1]
    place = np.full(len(orbits) + 1, -1)
    place[order] = np.arange(len(orbits))
    return Attractors(place[index], [orbits[j] for j in order])


@eqx.filter_jit
def _measure_block(
    model: AbstractWheel, options: Options, params: WheelParams, x: Array
) -> dict[str, Array]:
    """Return all measures of one step from each start of a block."""
    return jax.vmap(lambda p, x: model.step(p, x, options).measures())(params, x)


def orbit_measures(
    params: WheelParams, states: np.ndarray, model: AbstractWheel, options: Options
) -> dict[str, np.ndarray]:
    """Return all measures of one step from each of `states`, shape (n, m)."""
    n = len(states)
    wheels = jax.tree.map(lambda x: np.broadcast_to(np.asarray(x), n), params)
    if model.rung in WALKS:
        columns, rung = np.asarray(jax.vmap(model.values)(wheels)).T, cast(UnilateralWheel, model)
        told, _ = step_lanes(columns, states, rung, options, params.n_legs, ())
        return jax.tree.map(np.asarray, jax.tree.map(jnp.asarray, told).measures())
    measured = functools.partial(_measure_block, model, options)
    return jax.tree.map(np.asarray, in_batches(measured, (BLOCK,), wheels, states))
