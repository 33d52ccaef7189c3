"""Where walks on real ground come to rest, by loose steps and leaps between them.

A wheel that runs fast forgets its legs within a few steps, and what is left of its motion drifts
slowly along one curve, for hundreds of steps. A few steps tell how it drifts and whether that
fades; a leap along the drift does the rest (projective integration: C. W. Gear and I. G.
Kevrekidis, SIAM J. Sci. Comput. 24, 2003), no farther than to where it would fade away. What a walk
comes to is not told as a gait but where corrections by exact steps begin.
"""

from typing import NamedTuple

import numpy as np

from vrw_jax.answers.top import Ground, Stepped
from vrw_jax.wheel import Outcome

STEPS, ROUNDS, BETWEEN = 20, 10, 7
"""Of a walk before the first leap, leaps at most, and steps after each. Of 451 wheels without a
gait of the paper's, with five steps after a leap three gaits in 118 are missed."""
LEAP = 0.15
"""Longest leap, rad, rad/s, m, m/s: pairs of gaits that are nearer to each other are leapt over."""
FARTHER, LATE = 2.0, 3
"""A walk ends where its drift would fade farther off than so many times what is left of leaps, once
so few are left: before, drifts may grow for a while and yet fade."""
RESTS = 5e-4
"""Drift of a step, and way to where it would fade, below which a walk has come to rest."""
STILL = 1e-5
"""Drift that is the steps' own error."""


class Led(NamedTuple):
    """Where walks have come to."""

    rests: np.ndarray  # whether next to a gait, as it seems
    x: np.ndarray  # (lanes, 4 + 3 n)
    outcome: np.ndarray  # STEPPED, or how the walk ended
    n_steps: np.ndarray


def led(ground: Ground, lanes: np.ndarray, x: np.ndarray) -> Led:
    """Where walks of the lanes lead from section states `x`."""
    n, m, loose = len(lanes), x.shape[1] - ground.n, ground.loosely()
    told = Led(np.zeros(n, bool), x.copy(), np.full(n, int(Outcome.STEPPED)), np.zeros(n, int))
    open_, start = np.arange(n), x
    for k, n_steps in enumerate((STEPS, *ROUNDS * (BETWEEN,))):
        if not len(open_):
            break
        told.n_steps[open_] += n_steps
        own, now = lanes[open_], told.x[open_]
        before = loose.step(own, start, n_steps - 2)
        lost = np.flatnonzero(before.outcome != Outcome.STEPPED)
        if len(lost):  # by a leap, or at first by the tolerance
            again = (loose if k else ground).step(own[lost], now[lost], n_steps - 2)
            before = Stepped(*map(_put, before, 3 * (lost,), again))
        last = loose.step(own, before.x)
        here = loose.step(own, last.x)
        ends = np.stack([before.outcome, last.outcome, here.outcome])
        on = np.all(ends == Outcome.STEPPED, axis=0)
        first = np.argmax(ends != Outcome.STEPPED, axis=0)
        told.outcome[open_] = ends[first, np.arange(len(open_))]
        open_ = open_[on]
        told.x[open_] = here.x[on]
        told.rests[open_], leap, way = _drift(before.x[on], last.x[on], here.x[on], m)
        left = ROUNDS - k
        goes_on = ~told.rests[open_] & ((left > LATE) | (way <= FARTHER * LEAP * left))
        open_, leap = (part[goes_on] for part in (open_, leap))
        start = told.x[open_]
        leaps = np.any(leap != 0.0, axis=1)
        start[leaps, :m] += leap[leaps]
        start[leaps] = ground.consistent(start[leaps])
    return told


def _put(whole: np.ndarray, places: np.ndarray, part: np.ndarray) -> np.ndarray:
    whole = np.array(whole)
    whole[places] = part
    return whole


def _drift(
    before: np.ndarray, last: np.ndarray, here: np.ndarray, m: int
) -> tuple[np.ndarray, ...]:
    """Whether three section states in a row have come to rest, how far to leap from the last, and
    how far off the drift would fade; no leap and no way where the legs' codes change."""
    same = np.all((before[:, m:] == here[:, m:]) & (last[:, m:] == here[:, m:]), axis=1)
    u, v = (last - before)[:, :m], (here - last)[:, :m]
    speed = np.abs(v).max(1)
    with np.errstate(all="ignore"):
        share = np.nan_to_num(np.sum(u * v, axis=1) / np.sum(u * u, axis=1))
        ahead = np.where(share < 1.0, share / (1.0 - share), np.inf)  # steps until it has faded
        way = np.where(speed < STILL, 0.0, np.abs(ahead) * speed)
        steps = np.where(speed > 0.0, np.minimum(ahead, LEAP / speed), 0.0)
    # What turns round at each step is on its way to a gait of two.
    rests = same & (way < RESTS) & (speed < RESTS)
    goes = same & ~rests & (share > 0.0)
    return rests, np.where(goes, steps, 0.0)[:, None] * v, np.where(same, way, 0.0)
