"""Walks with unilateral contact until they settle, by loose steps with leaps between them.

On a fast wheel the states of the legs decay within a few steps, and the remaining motion drifts
slowly along one curve, for hundreds of steps. A few steps determine the drift and its decay. A leap
along the drift replaces the remaining steps (projective integration: C. W. Gear and I. G.
Kevrekidis, SIAM J. Sci. Comput. 24, 2003). A leap ends at the latest at the predicted limit of the
drift. The end of a walk is not a gait but the start of corrections by exact steps.
"""

from typing import NamedTuple

import numpy as np

from vrw_jax.answers.top import Ground, Stepped
from vrw_jax.wheel import Outcome

STEPS, ROUNDS, BETWEEN = 20, 10, 7
"""Number of steps of a walk before the first leap, largest number of leaps, and number of steps
after each. With five steps after a leap, three gaits in 118 are missed, among 451 wheels without a
gait of the paper's model."""
LEAP = 0.15
"""Longest leap, rad, rad/s, m, m/s. Pairs of gaits that are closer to each other can be passed
over."""
FARTHER, LATE = 2.0, 3
"""A walk ends if its drift would fade beyond the first factor times the remaining leaps, and at
most the second number of leaps is left. Earlier, drifts may grow for a while and yet fade."""
RESTS = 5e-4
"""Drift per step, and distance to its predicted limit, below which a walk has settled."""
STILL = 1e-5
"""Drift at the level of the steps' own error."""


class Led(NamedTuple):
    """Ends of walks."""

    rests: np.ndarray  # whether the walk has settled, probably near a gait
    x: np.ndarray  # (elements, 4 + 3 n)
    outcome: np.ndarray  # STEPPED, or the failure that ended the walk
    n_steps: np.ndarray


def led(ground: Ground, lanes: np.ndarray, x: np.ndarray) -> Led:
    """Walk from section states until each walk settles or ends."""
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
        if len(lost):  # after a leap, or at first due to the tolerance
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
    """Analyze the drift of three successive section states.

    Return whether they have settled, the leap from the last one, and the distance at which the
    drift would fade. Leap and distance are zero if the legs' codes change.
    """
    same = np.all((before[:, m:] == here[:, m:]) & (last[:, m:] == here[:, m:]), axis=1)
    u, v = (last - before)[:, :m], (here - last)[:, :m]
    speed = np.abs(v).max(1)
    with np.errstate(all="ignore"):
        share = np.nan_to_num(np.sum(u * v, axis=1) / np.sum(u * u, axis=1))
        ahead = np.where(share < 1.0, share / (1.0 - share), np.inf)  # number of steps
        way = np.where(speed < STILL, 0.0, np.abs(ahead) * speed)
        steps = np.where(speed > 0.0, np.minimum(ahead, LEAP / speed), 0.0)
    # A drift that changes sign at each step leads to a gait of two steps.
    rests = same & (way < RESTS) & (speed < RESTS)
    goes = same & ~rests & (share > 0.0)
    return rests, np.where(goes, steps, 0.0)[:, None] * v, np.where(same, way, 0.0)
