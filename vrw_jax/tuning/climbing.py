"""Maximization along a branch of gaits by SciPy's SLSQP, in a box that shrinks where the branch is
lost.

SLSQP is sequential quadratic programming with exact gradients. It does not handle trial wheels
without a gait, or with a gait of another branch. After such a trial the maximization continues from
the last iterate within half the distance, and the path records it. Parameters are measured in
widths of their bounds, so that every free one is between 0 and 1.
"""

import enum
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from vrw_jax.numerics import Code
from vrw_jax.tuning.objective import Evaluated, breach, slack_scales
from vrw_jax.wheel import Outcome


class Ending(Code):
    """Status of a maximization at its end."""

    CONVERGED = 0, "The gait can't be improved nearby without breaking a constraint."
    AT_A_BORDER = 1, "The branch ends here: no smaller step finds a gait."
    OUT_OF_EVALUATIONS = 2, "The allowed number of gaits was spent before it converged."
    NO_FEASIBLE_GAIT = 3, "No gait that keeps every constraint was found from this start."


class Kind(enum.IntEnum):
    """Role of an evaluated gait in the maximization."""

    START = 0
    TRIAL = 1
    ITERATE = 2
    LOST = 3


class Trial(NamedTuple):
    """Evaluated wheel. If its gait is lost, the numbers are NaN."""

    u: np.ndarray  # free parameters in widths of their bounds
    outcome: Outcome
    on_branch: bool
    objective: float
    gradient: np.ndarray  # with respect to u
    slack: np.ndarray  # constraint values minus their margins, in their own units
    slopes: np.ndarray  # (n_constraints, n_free)
    told: Evaluated | None

    @property
    def found(self) -> bool:
        """Return whether there is a gait, on the same branch."""
        return self.outcome == Outcome.STEPPED and self.on_branch


class Climb(NamedTuple):
    best: Trial
    ending: Ending
    trials: list[Trial]
    kinds: list[Kind]


class _LostError(Exception):
    def __init__(self, trial: Trial) -> None:
        self.trial = trial


class _SpentError(Exception):
    pass


class _ArrivedError(Exception):
    def __init__(self, trial: Trial) -> None:
        self.trial = trial


WHOLE, SMALLEST_RADIUS = 1.0, 1e-7
"""Half the side of a box that contains all bounds, and of a box at which the end of a branch counts
as reached."""

LOOSE, STALLED = 1e-3, 1e-10
"""Relative change of the objective at which SLSQP stops. The first value is for a smaller box,
whose optimum is only a point to continue from. The second is for the whole box, and the gaits are
not more accurate than that."""

ACTIVE = 1e-6
"""Slack of an active constraint, in widths of the bounds."""

Evaluate = Callable[[np.ndarray, Trial | None], Trial]
"""Function that returns the gait at u, searched for from a neighbor's gait."""


class _Record:
    """All trials in order; each point is evaluated once."""

    def __init__(self, evaluate: Evaluate, start: Trial, allowed: int) -> None:
        self.trials, self.kinds = [start], [Kind.START]
        self._evaluate, self._allowed = evaluate, allowed
        self._places = {start.u.tobytes(): 0}

    def at(self, u: np.ndarray) -> Trial:
        place = self._places.get(u.tobytes())
        if place is None:
            if len(self.trials) >= self._allowed:
                raise _SpentError
            place = len(self.trials)
            self.trials.append(self._evaluate(np.array(u), self._nearest(u)))
            self.kinds.append(Kind.TRIAL)
            self._places[u.tobytes()] = place
        trial = self.trials[place]
        if not trial.found:
            self.kinds[place] = Kind.LOST
            raise _LostError(trial)
        return trial

    def iterate(self, u: np.ndarray) -> Trial:
        trial = self.at(u)
        place = self._places[u.tobytes()]
        if place:
            self.kinds[place] = Kind.ITERATE
        return trial

    def _nearest(self, u: np.ndarray) -> Trial:
        found = [trial for trial in self.trials if trial.found]
        return min(found, key=lambda trial: float(np.linalg.norm(trial.u - u)))


def climb(evaluate: Evaluate, start: Trial, *, tolerance: float, max_evaluations: int) -> Climb:
    """Maximize the objective locally from `start`, with every slack at least zero."""
    from scipy.optimize import minimize  # imported here because it is slow

    record = _Record(evaluate, start, max_evaluations)
    size = max(float(np.linalg.norm(start.gradient)), 1e-12)
    scales = slack_scales(start.slack, start.slopes)

    def arrive(trial: Trial) -> Trial:
        if breach(trial.slack, scales) <= ACTIVE and optimality(trial).residual <= tolerance:
            raise _ArrivedError(trial)
        return trial

    centre, radius, widest = start, WHOLE, WHOLE
    ending, known = Ending.CONVERGED, 0
    while True:
        # A round without a new evaluation would only be repeated, so the next box is smaller.
        widest = widest if len(record.trials) > known else 0.5 * widest
        known, radius = len(record.trials), min(radius, widest)
        if radius < SMALLEST_RADIUS:
            ending = Ending.AT_A_BORDER
            break
        low, high = np.maximum(centre.u - radius, 0.0), np.minimum(centre.u + radius, 1.0)
        iterates = [centre]
        try:
            result = minimize(
                lambda u: -record.at(u).objective / size,
                centre.u,
                jac=lambda u: -record.at(u).gradient / size,
                bounds=list(zip(low, high, strict=True)),
                constraints={
                    "type": "ineq",
                    "fun": lambda u: record.at(u).slack / scales,
                    "jac": lambda u: record.at(u).slopes / scales[:, None],
                },
                method="SLSQP",
                options={"ftol": STALLED if radius >= widest else LOOSE, "maxiter": 100},
                callback=lambda u, seen=iterates: seen.append(arrive(record.iterate(u))),
            )
            reached = record.iterate(np.clip(result.x, low, high))
        except _LostError as lost:
            centre = iterates[-1]
            radius = 0.5 * float(np.max(np.abs(lost.trial.u - centre.u)))
            continue
        except _ArrivedError as arrived:
            centre = arrived.trial
            break
        except _SpentError:
            ending = Ending.OUT_OF_EVALUATIONS
            break
        at_wall = (reached.u <= low + 1e-9) & (low > 0.0)
        at_wall |= (reached.u >= high - 1e-9) & (high < 1.0)
        centre = reached
        if radius >= WHOLE:
            break
        radius = min(2.0 * radius, WHOLE) if at_wall.any() else WHOLE
    best = centre if ending == Ending.CONVERGED else _best(record, scales, centre)
    if ending == Ending.CONVERGED and breach(best.slack, scales) > 10.0 * ACTIVE:
        best, ending = _best(record, scales, centre), Ending.NO_FEASIBLE_GAIT
    return Climb(best, ending, record.trials, record.kinds)


def _best(record: _Record, scales: np.ndarray, last: Trial) -> Trial:
    """Return the best gait that satisfies all constraints, else the one with the smallest
    breach."""
    found = [trial for trial in record.trials if trial.found]
    kept = [trial for trial in found if breach(trial.slack, scales) <= ACTIVE]
    if not kept:
        return min(found, key=lambda trial: breach(trial.slack, scales))
    if breach(last.slack, scales) <= ACTIVE:
        kept.append(last)
    return max(kept, key=lambda trial: trial.objective)


class Optimality(NamedTuple):
    """Multipliers of the constraints and bounds that hold a gait in place."""

    prices: np.ndarray  # gain of the objective per unit of a relaxed margin
    low: np.ndarray  # loss of the objective per width of a relaxed lower bound, < 0: gain
    high: np.ndarray
    residual: float  # of the first-order condition, relative to the objective's gradient


def optimality(trial: Trial) -> Optimality:
    """Return the first-order (Karush-Kuhn-Tucker) condition at a gait, by non-negative least
    squares."""
    from scipy.optimize import nnls  # slow to import

    n = trial.u.size
    scales = slack_scales(trial.slack, trial.slopes)
    active = np.flatnonzero(np.abs(trial.slack) <= 10.0 * ACTIVE * scales)
    low, high = np.flatnonzero(trial.u <= ACTIVE), np.flatnonzero(trial.u >= 1.0 - ACTIVE)
    unit = np.eye(n)
    columns = np.concatenate(
        [trial.slopes[active] / scales[active, None], unit[low], -unit[high]]
    ).T
    size = max(float(np.linalg.norm(trial.gradient)), 1e-300)
    prices, at_low, at_high = np.zeros(trial.slack.size), np.zeros(n), np.zeros(n)
    if not columns.shape[1]:
        return Optimality(prices, at_low, at_high, 1.0)
    weights, residual = nnls(columns, -trial.gradient)
    first, second = len(active), len(active) + len(low)
    prices[active] = weights[:first] / scales[active]
    at_low[low], at_high[high] = weights[first:second], weights[second:]
    return Optimality(prices, at_low, at_high, float(residual) / size)
