"""Attracting gaits of a wheel, found by walks from a stated set of starts and refined by Newton's
method."""

import math
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace
from typing import Any

import equinox as eqx
import jax
import numpy as np

from vrw_jax.models import as_full_states, walk_lanes
from vrw_jax.numerics import Options, joined, taken
from vrw_jax.wheel import PARAMETER_NAMES, Outcome, WheelParams, wheel_of

ROUNDS = (8, 12, 30, 50, 100)
"""Numbers of steps towards a gait. After each round, settled walks stop and walks to the same gait
are merged."""

SETTLED = 1e-3
"""Largest difference between a settled walk's state and its state one period ago, rad, rad/s and
m/s."""

STARTS = ((1.0, 0.45), (1.0, 0.7), (1.0, 1.0), (0.5, 1.0), (0.0, 1.0))
"""Starts of walks: the share of Leg 1's static contraction at touchdown, and the rate of the hub as
a share of the rigid rolling gait's rate. Of 4,800 random wheels with 5 to 16 legs, 1,240 walk from
one of these starts or from a grid of 78. From these starts alone, 1,175 walk (ranges:
experiments/gaits/off_the_box.py)."""

FURTHER = ((0.002, 0.4), (0.002, 0.3), (0.002, 0.5), (0.5, 1.1), (0.2, 0.4), (0.2, 1.1), (0.2, 0.8),
           (0.35, 1.0), (0.35, 1.1))  # fmt: skip
"""Starts of walks of the paper's model that are tried if none of WALK_STARTS leads to a gait. The
first number is Leg 1's angle to the slope's normal at touchdown as a share of the angle between
legs. The second number is the rate, as in WALK_STARTS. These starts reach the other 65 wheels. With
many legs, gaits roll from double support into double support, with an angle near 0."""

NEAR = 0.1
"""Largest period defect of an unsettled walk that is used as a start, rad, rad/s and m/s."""

APART, SAME = 0.02, 1e-5
"""Distance above which walks have reached different gaits, and distance below which two gaits are
the same one."""

TOLERANCE_TOWARDS = 1e-8
"""Tolerance of the Tsit5 steps towards a gait, independent of the tolerance of the gait itself."""


def starts_of(params: WheelParams) -> np.ndarray:
    """Return WALK_STARTS of each wheel, section states of shape (start, wheel, 3)."""
    p, sin, cos = _in_numpy(params), math.sin(params.leg_angle), math.cos(params.leg_angle)
    weight = (p.hub_mass + params.n_legs * p.leg_mass) * p.gravity * np.cos(p.slope)
    static = (p.natural_length - weight / p.stiffness) / p.locked_length
    lengths = [np.clip(1.0 + c * (static - 1.0), cos + 0.02, 1.0) for c, _ in STARTS]
    thetas = [np.arctan((length - cos) / sin) for length in lengths]
    return _at(params, thetas, [share for _, share in STARTS])


def further_starts_of(params: WheelParams) -> np.ndarray:
    """Return FALLBACK_STARTS of each wheel, section states of shape (start, wheel, 3)."""
    thetas = [np.full(np.shape(params.slope), a * params.leg_angle) for a, _ in FURTHER]
    return _at(params, thetas, [share for _, share in FURTHER])


def _in_numpy(params: WheelParams) -> Any:
    """Return the parameters as numpy arrays, because JAX would compile each operation on them."""
    return SimpleNamespace(**{name: np.asarray(getattr(params, name)) for name in PARAMETER_NAMES})


def _at(params: WheelParams, thetas: list[np.ndarray], shares: list[float]) -> np.ndarray:
    """Return section states with these angles and with rates as shares of the rigid rolling gait's
    rate."""
    p, alpha = _in_numpy(params), params.leg_angle
    stiff = np.sqrt(4.0 * p.gravity / p.locked_length * np.sin(0.5 * alpha) * np.sin(p.slope))
    rolling, fall = stiff / np.sin(alpha), -0.1 * np.sqrt(p.gravity * p.locked_length) / 3.0
    each = zip(thetas, shares, strict=True)
    return np.stack([np.stack([x, share * rolling, fall], -1) for x, share in each])


def _walked(
    finder: Any, columns: np.ndarray, x: np.ndarray, n_steps: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Walk `n_steps` from each state and measure the defect of one more period.

    Return the states after the walk, whether each walk still continues, and the largest change of
    the state over the next period. The defect is infinite where a walk ended early.
    """
    loose = Options(solver="Tsit5", rtol=TOLERANCE_TOWARDS, atol=TOLERANCE_TOWARDS)
    given = finder.model, loose, finder.n_legs
    states, _, outcome, *_ = walk_lanes(columns, x, n_steps, *given)
    later, _, ends, *_ = walk_lanes(columns, states, finder.period_n, *given)
    walking = outcome == Outcome.STEPPED
    away = np.abs(later - states)[:, : _numbers(finder)].max(-1)
    return states, walking, np.where(walking & (ends == Outcome.STEPPED), away, np.inf)


def gaits_attracting(
    finder: Any, values: Any, n_starts: int = len(STARTS)
) -> tuple[np.ndarray, Any]:
    """Return the attracting gaits of each wheel, slowest first.

    A wheel without an attracting gait gets one entry whose outcome is a failure.

    Args:
        finder: finds gaits with unilateral contact.
        values: of each wheel, (wheels, n_values); see `AbstractWheel.parameter_values`.
        n_starts: number of WALK_STARTS to use, slow ones first.

    Returns:
        Index of the wheel of each gait, (gaits,), and a cycle with that leading axis.
    """
    wheels = len(values)
    owner, x = _walked_to(finder, np.asarray(values), n_starts)
    found = finder.near(np.asarray(values)[owner], x)
    # Numpy is used because JAX compiles each operation for every number of wheels.
    attracts = np.abs(np.linalg.eigvals(found.matrix)).max(-1) < 1.0
    good = (np.asarray(found.outcome) == Outcome.STEPPED) & attracts
    states = np.asarray(found.steps.section_state)  # of every step
    of_all = lambda x: np.asarray(x).reshape(len(owner), -1).sum(-1)
    speed = of_all(found.step_length) / np.where(good, of_all(found.durations), 1.0)
    own = states[:, :, : _numbers(finder)]
    good &= ~(np.abs(own[:, :-1] - own[:, -1:]).max(-1) < SAME).any(1)  # shorter period
    kept: list[int] = []
    for places in np.split(np.arange(len(owner)), slowest(owner, wheels)[1:]):
        first = len(kept)
        for i in sorted(places[good[places]], key=lambda i: speed[i]):
            known = (np.abs(own[j] - own[i, -1]).max(-1) < SAME for j in kept[first:])
            if not any(same.any() for same in known):
                kept.append(int(i))
        kept += [] if len(kept) > first else [int(places[0])]
    return owner[kept], _none_where(~good[kept], taken(found, kept))


def slow_gaits(finder: Any, values: Any) -> Any:
    """Return for each wheel the gait that a slow start reaches, else the slowest gait that any
    start reaches.

    For 1,200 random wheels it is the slowest attracting gait of each.
    """
    values = np.asarray(values)
    _, gaits = gaits_attracting(finder, values, 1)
    lost = np.flatnonzero(np.asarray(gaits.outcome) != Outcome.STEPPED)
    if len(lost):
        owner, others = gaits_attracting(finder, values[lost])
        places = np.arange(len(values))
        places[lost] = len(values) + slowest(owner, len(lost))
        gaits = jax.device_put(taken(joined(gaits, others), places))
    return gaits


def slowest(owner: np.ndarray, wheels: int) -> np.ndarray:
    return np.searchsorted(owner, np.arange(wheels))


def _none_where(lost: np.ndarray, cycle: Any) -> Any:
    """Mark the cycles where `is_missing` as not found: they repeat sooner, do not attract, or do
    not exist."""
    fits = lambda leaf: lost.reshape(-1, *[1] * (leaf.ndim - 1))
    none = jax.tree.map(lambda leaf: np.where(fits(leaf), np.zeros_like(leaf), leaf), cycle)
    code = np.where(cycle.outcome == Outcome.STEPPED, Outcome.NO_CYCLE_FOUND, cycle.outcome)
    code = np.where(lost, code, cycle.outcome).astype(np.int32)
    none = eqx.tree_at(lambda cycle: cycle.outcome, none, code)
    return jax.device_put(none)


def _numbers(finder: Any) -> int:
    return int(finder.model.section_numbers(WheelParams(n_legs=finder.n_legs)))


def _walked_to(finder: Any, values: np.ndarray, n_starts: int) -> tuple[np.ndarray, np.ndarray]:
    """Walk from the starts and return the distinct end states.

    Return the index of the wheel of each state, in order, and section states. Each wheel has at
    least one state. Of equivalent walks, the one with the smallest period defect is returned.
    """
    rows = jax.device_put(list(values.T[: len(PARAMETER_NAMES)]))
    starts = starts_of(wheel_of(tuple(rows), finder.n_legs))[:n_starts]
    n, m, owner = len(values), _numbers(finder), np.tile(np.arange(len(values)), len(starts))
    columns = values.T[:, owner]
    begun = as_full_states(columns, np.concatenate(starts), finder.n_legs)
    x, missed, open_ = np.array(begun), np.full(len(owner), np.inf), np.arange(len(owner))
    walking, like = np.ones(len(owner), bool), np.zeros(len(owner), bool)
    with ThreadPoolExecutor(1) as pool:
        pool.submit(finder.prepare, values[:1], begun[:1])
        for n_steps in ROUNDS:
            there = _walked(finder, columns[:, open_], x[open_], n_steps)
            x[open_], walking[open_], missed[open_] = there
            like |= _like(x[:, :m], missed, n, SETTLED)
            open_ = np.flatnonzero(walking & ~like & (missed >= SETTLED))
            if not len(open_):
                break
    chosen = ~_like(x[:, :m], missed, n, NEAR) & (missed < NEAR)
    chosen[np.setdiff1d(np.arange(n), owner[chosen])] = True  # else the first start
    some = np.flatnonzero(chosen)
    some = some[np.argsort(owner[some], kind="stable")]
    return owner[some], np.where(walking[some, None], x[some], begun[some])


def _like(x: np.ndarray, missed: np.ndarray, wheels: int, settled: float) -> np.ndarray:
    """Return which walks reach the same state as another walk of the same wheel with a smaller
    defect.

    Two states are the same if they are within MERGE_DISTANCE. If the other walk has settled, the
    limit is the walk's own remaining defect if that is larger. The wheels are the last axis of all
    arrays (in `x`, the last but one, before the coordinates), and the starts are the axis before
    it.
    """
    x, missed = x.reshape(-1, wheels, x.shape[-1]), missed.reshape(-1, wheels)
    place = np.arange(len(x))[:, None]
    like = np.zeros(missed.shape, bool)
    for other in range(len(x)):
        better = (missed[other] < missed) | ((missed[other] == missed) & (other < place))
        away = np.abs(x - x[other]).max(-1)
        near = away <= np.where(missed[other] < settled, np.maximum(APART, 3.0 * missed), APART)
        like |= better & near & (missed < NEAR)
    return like.ravel()
