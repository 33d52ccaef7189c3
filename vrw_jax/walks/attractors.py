"""What attracts: many starts walked until each repeats itself or falls.

Starts may belong to different wheels. Those still undecided after a round are packed together for
the next one, so that long transients cost little.
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
"""Steps between two looks at who has settled."""

BLOCK = 128
"""Starts walked side by side: one shape, compiled once."""

REPEATS = 1e-7
"""Most by which a settled walk may miss its own section states one period ago."""

ARRIVED = 1e-3
"""Distance from its orbit below which a walk counts as having got there."""

SAME = 1e-4
"""Distance below which two orbits are one."""


class Settled(NamedTuple):
    """How each start ended; numpy arrays with a leading axis over starts."""

    outcome: np.ndarray  # STEPPED where it still walked
    period: np.ndarray  # of the orbit that it settled on, in steps; 0 where it did not settle
    steps: np.ndarray  # until it was at its orbit, or fell
    orbit: np.ndarray  # (start, longest period, m): section states, lowest dtheta- first, then NaN


@eqx.filter_jit
def _walk_block(
    model: AbstractWheel, options: Options, params: WheelParams, x: Array
) -> tuple[Array, Array]:
    one = lambda params, x: walk(params, x, ROUND, model=model, options=options)
    walks = jax.vmap(one)(params, x)
    return walks.steps.section_state, walks.steps.outcome


def _by_lanes(
    model: Any, options: Options, params: WheelParams, x: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The same on real ground, any number of wheels at once."""
    n, columns = params.n_legs, np.asarray(jax.vmap(model.values)(params)).T
    x = as_full_states(columns, np.asarray(x), n)
    states, codes = list[np.ndarray](), list[np.ndarray]()
    for _ in range(ROUND):
        x, _, outcome, *_ = walk_lanes(columns, x, 1, model, options, n)
        # A wheel that fell is at no section state: its code stays.
        outcome = outcome if not codes else np.where(codes[-1] > 0, codes[-1], outcome)
        states.append(x)
        codes.append(outcome)
    return np.stack(states, 1), np.stack(codes, 1)


WALKS: dict[str, Callable[..., tuple]] = {"unilateral": _by_lanes}
"""Rounds of many starts by rung, where it is not by blocks of the rung's own steps."""


def settle(
    params: WheelParams,
    starts: np.ndarray,
    model: AbstractWheel,
    options: Options,
    most_steps: int,
    longest_period: int,
) -> Settled:
    """Walk every start; `params` are those of one wheel or have the starts' leading axis."""
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
    """The shortest period of the last states, over as many steps as two of it; 0 for none."""
    found = np.zeros(len(history), int)
    last = history.shape[1]
    for p in range(min(longest, (last - 1) // 3), 0, -1):
        change = np.abs(history[:, last - 2 * p :] - history[:, last - 3 * p : last - p])
        found[change.max((1, 2)) < REPEATS] = p
    return found


class Attractors(NamedTuple):
    """The different orbits among many starts, the one with most starts first."""

    of_start: np.ndarray  # index of each start's orbit; -1 where it did not settle
    orbits: list[np.ndarray]  # (period, m) each


def distinct(settled: Settled) -> Attractors:
    """Orbits told apart, whatever the step at which they were entered."""
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
    return jax.vmap(lambda p, x: model.step(p, x, options).measures())(params, x)


def orbit_measures(
    params: WheelParams, states: np.ndarray, model: AbstractWheel, options: Options
) -> dict[str, np.ndarray]:
    """All measures of the step from each of `states` (n, m); `params` as in `settle`."""
    n = len(states)
    wheels = jax.tree.map(lambda x: np.broadcast_to(np.asarray(x), n), params)
    if model.rung in WALKS:
        columns, rung = np.asarray(jax.vmap(model.values)(wheels)).T, cast(UnilateralWheel, model)
        told, _ = step_lanes(columns, states, rung, options, params.n_legs, ())
        return jax.tree.map(np.asarray, jax.tree.map(jnp.asarray, told).measures())
    measured = functools.partial(_measure_block, model, options)
    return jax.tree.map(np.asarray, in_batches(measured, (BLOCK,), wheels, states))
