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

from vrw_jax.numerics import StatusCode
from vrw_jax.tuning.objective import (
    UPPER_BOUND_PREFIX,
    GaitEvaluation,
    max_breach,
    scale_slacks,
    signed_bound,
)
from vrw_jax.wheel import Outcome


class TuneStatus(StatusCode):
    """Status of a maximization at its end."""

    CONVERGED = 0, "The gait can't be improved nearby without breaking a constraint."
    BRANCH_ENDED = 1, "The branch ends here: every smaller step on lost the gait or a finite value."
    MAX_EVALUATIONS_REACHED = 2, "The allowed number of gaits was spent before it converged."
    NO_FEASIBLE_GAIT = 3, "No gait that keeps every constraint was found from this start."


class TrialKind(enum.IntEnum):
    """Role of an evaluated gait in the maximization."""

    START = 0
    TRIAL = 1
    ITERATE = 2
    LOST = 3
    NOT_FINITE = 4


class EvaluatedTrial(NamedTuple):
    """Evaluated wheel. If its gait is lost, the numbers are NaN."""

    normalized_parameters: np.ndarray  # free parameters in widths of their bounds
    outcome: Outcome
    is_on_branch: bool
    objective: float
    gradient: np.ndarray  # with respect to u
    slack: np.ndarray  # constraint values minus their margins, in their own units
    slack_jacobian: np.ndarray  # (n_constraints, n_free)
    evaluation: GaitEvaluation | None

    @property
    def is_found(self) -> bool:
        """Return whether there is a gait, on the same branch."""
        return self.outcome == Outcome.STEPPED and self.is_on_branch

    @property
    def is_finite(self) -> bool:
        """Whether objective, constraints and their derivatives are finite numbers."""
        parts = (self.objective, self.gradient, self.slack, self.slack_jacobian)
        return all(bool(np.isfinite(part).all()) for part in parts)

    @property
    def is_usable(self) -> bool:
        """Whether the climb may go on from here."""
        return self.is_found and self.is_finite

    def describe_nonfinite(
        self, label: str, constraints: tuple[str, ...], least: np.ndarray
    ) -> str:
        """Return which number is not finite: the objective's, else a constraint's."""
        values = self.objective, *map(float, self.slack + least)
        slopes = self.gradient, *self.slack_jacobian
        for name, value, slope in zip((label, *constraints), values, slopes, strict=True):
            measure = name.removeprefix(UPPER_BOUND_PREFIX)
            if not np.isfinite(value):
                return f"{measure} is {signed_bound(name, value):g}"
            if not np.isfinite(slope).all():
                return f"{measure} has a derivative that is not finite"
        raise ValueError("Every number of this trial is finite: describe another.")


class ClimbResult(NamedTuple):
    best: EvaluatedTrial
    status: TuneStatus
    trials: list[EvaluatedTrial]
    kinds: list[TrialKind]


class _LostBranchError(Exception):
    def __init__(self, trial: EvaluatedTrial) -> None:
        self.trial = trial


class _BudgetSpentError(Exception):
    pass


class _OptimumReachedError(Exception):
    def __init__(self, trial: EvaluatedTrial) -> None:
        self.trial = trial


FULL_RADIUS, MIN_RADIUS = 1.0, 1e-7
"""Half the side of a box that contains all bounds, and of a box at which the end of a branch counts
as reached."""

COARSE_OBJECTIVE_TOLERANCE, FINE_OBJECTIVE_TOLERANCE = 1e-3, 1e-10
"""Relative change of the objective at which SLSQP stops. The first value is for a smaller box,
whose optimum is only a point to continue from. The second is for the whole box, and the gaits are
not more accurate than that."""

ACTIVE_BOUND_TOLERANCE = 1e-6
"""Slack of an active constraint, in widths of the bounds."""

EvaluateTrial = Callable[[np.ndarray, EvaluatedTrial | None], EvaluatedTrial]
"""Function that returns the gait at u, searched for from a neighbor's gait."""


class _TrialRecord:
    """All trials in order; each point is evaluated once."""

    def __init__(
        self, evaluate: EvaluateTrial, start: EvaluatedTrial, max_evaluations: int
    ) -> None:
        self.trials, self.kinds = [start], [TrialKind.START]
        self._evaluate, self._max_evaluations = evaluate, max_evaluations
        self._indices = {start.normalized_parameters.tobytes(): 0}

    def evaluate_once(self, normalized_parameters: np.ndarray) -> EvaluatedTrial:
        trial_index = self._indices.get(normalized_parameters.tobytes())
        if trial_index is None:
            if len(self.trials) >= self._max_evaluations:
                raise _BudgetSpentError
            trial_index = len(self.trials)
            self.trials.append(
                self._evaluate(
                    np.array(normalized_parameters), self._nearest_gait(normalized_parameters)
                )
            )
            self.kinds.append(TrialKind.TRIAL)
            self._indices[normalized_parameters.tobytes()] = trial_index
        trial = self.trials[trial_index]
        if not trial.is_usable:
            self.kinds[trial_index] = TrialKind.NOT_FINITE if trial.is_found else TrialKind.LOST
            raise _LostBranchError(trial)
        return trial

    def evaluate_iterate(self, normalized_parameters: np.ndarray) -> EvaluatedTrial:
        trial = self.evaluate_once(normalized_parameters)
        trial_index = self._indices[normalized_parameters.tobytes()]
        if trial_index:
            self.kinds[trial_index] = TrialKind.ITERATE
        return trial

    def _nearest_gait(self, normalized_parameters: np.ndarray) -> EvaluatedTrial:
        gaits = [trial for trial in self.trials if trial.is_usable]
        return min(
            gaits,
            key=lambda trial: float(
                np.linalg.norm(trial.normalized_parameters - normalized_parameters)
            ),
        )


def maximize_objective(
    evaluate: EvaluateTrial, start: EvaluatedTrial, *, tolerance: float, max_evaluations: int
) -> ClimbResult:
    """Maximize the objective locally from `start`, with every slack at least zero."""
    from scipy.optimize import minimize  # imported here because it is slow

    record = _TrialRecord(evaluate, start, max_evaluations)
    gradient_norm = max(float(np.linalg.norm(start.gradient)), 1e-12)
    scales = scale_slacks(start.slack, start.slack_jacobian)

    def stop_at_optimum(trial: EvaluatedTrial) -> EvaluatedTrial:
        if (
            max_breach(trial.slack, scales) <= ACTIVE_BOUND_TOLERANCE
            and compute_optimality(trial).residual <= tolerance
        ):
            raise _OptimumReachedError(trial)
        return trial

    center, radius, max_radius = start, FULL_RADIUS, FULL_RADIUS
    status, n_known_trials = TuneStatus.CONVERGED, 0
    while True:
        # A round without a new evaluation would only be repeated, so the next box is smaller.
        max_radius = max_radius if len(record.trials) > n_known_trials else 0.5 * max_radius
        n_known_trials, radius = len(record.trials), min(radius, max_radius)
        if radius < MIN_RADIUS:
            status = TuneStatus.BRANCH_ENDED
            break
        lower, upper = (
            np.maximum(center.normalized_parameters - radius, 0.0),
            np.minimum(center.normalized_parameters + radius, 1.0),
        )
        iterates = [center]
        try:
            result = minimize(
                lambda u: -record.evaluate_once(u).objective / gradient_norm,
                center.normalized_parameters,
                jac=lambda u: -record.evaluate_once(u).gradient / gradient_norm,
                bounds=list(zip(lower, upper, strict=True)),
                constraints={
                    "type": "ineq",
                    "fun": lambda u: record.evaluate_once(u).slack / scales,
                    "jac": lambda u: record.evaluate_once(u).slack_jacobian / scales[:, None],
                },
                method="SLSQP",
                options={
                    "ftol": FINE_OBJECTIVE_TOLERANCE
                    if radius >= max_radius
                    else COARSE_OBJECTIVE_TOLERANCE,
                    "maxiter": 100,
                },
                callback=lambda u, visited=iterates: visited.append(
                    stop_at_optimum(record.evaluate_iterate(u))
                ),
            )
            end_trial = record.evaluate_iterate(np.clip(result.x, lower, upper))
        except _LostBranchError as lost:
            center = iterates[-1]
            radius = 0.5 * float(
                np.max(np.abs(lost.trial.normalized_parameters - center.normalized_parameters))
            )
            continue
        except _OptimumReachedError as arrived:
            center = arrived.trial
            break
        except _BudgetSpentError:
            status = TuneStatus.MAX_EVALUATIONS_REACHED
            break
        is_at_wall = (end_trial.normalized_parameters <= lower + 1e-9) & (lower > 0.0)
        is_at_wall |= (end_trial.normalized_parameters >= upper - 1e-9) & (upper < 1.0)
        center = end_trial
        if radius >= FULL_RADIUS:
            break
        radius = min(2.0 * radius, FULL_RADIUS) if is_at_wall.any() else FULL_RADIUS
    best_trial = center if status == TuneStatus.CONVERGED else _best_trial(record, scales, center)
    if (
        status == TuneStatus.CONVERGED
        and max_breach(best_trial.slack, scales) > 10.0 * ACTIVE_BOUND_TOLERANCE
    ):
        best_trial, status = _best_trial(record, scales, center), TuneStatus.NO_FEASIBLE_GAIT
    return ClimbResult(best_trial, status, record.trials, record.kinds)


def _best_trial(
    record: _TrialRecord, scales: np.ndarray, last_trial: EvaluatedTrial
) -> EvaluatedTrial:
    """The best gait that keeps all constraints; else the one that comes nearest to it."""
    gaits = [trial for trial in record.trials if trial.is_usable]
    feasible = [
        trial for trial in gaits if max_breach(trial.slack, scales) <= ACTIVE_BOUND_TOLERANCE
    ]
    if not feasible:
        return min(gaits, key=lambda trial: max_breach(trial.slack, scales))
    if max_breach(last_trial.slack, scales) <= ACTIVE_BOUND_TOLERANCE:
        feasible.append(last_trial)
    return max(feasible, key=lambda trial: trial.objective)


class OptimalityConditions(NamedTuple):
    """Multipliers of the constraints and bounds that hold a gait in place."""

    prices: np.ndarray  # gain of the objective per unit of a relaxed margin
    lower_bound_prices: (
        np.ndarray
    )  # loss of the objective per width of a relaxed lower bound, < 0: gain
    upper_bound_prices: np.ndarray
    residual: float  # of the first-order condition, relative to the objective's gradient


def compute_optimality(trial: EvaluatedTrial) -> OptimalityConditions:
    """Return the first-order (Karush-Kuhn-Tucker) condition at a gait, by non-negative least
    squares."""
    from scipy.optimize import nnls  # slow to import

    n_free = trial.normalized_parameters.size
    scales = scale_slacks(trial.slack, trial.slack_jacobian)
    active_indices = np.flatnonzero(np.abs(trial.slack) <= 10.0 * ACTIVE_BOUND_TOLERANCE * scales)
    lower_indices, upper_indices = (
        np.flatnonzero(trial.normalized_parameters <= ACTIVE_BOUND_TOLERANCE),
        np.flatnonzero(trial.normalized_parameters >= 1.0 - ACTIVE_BOUND_TOLERANCE),
    )
    identity = np.eye(n_free)
    columns = np.concatenate(
        [
            trial.slack_jacobian[active_indices] / scales[active_indices, None],
            identity[lower_indices],
            -identity[upper_indices],
        ]
    ).T
    gradient_norm = max(float(np.linalg.norm(trial.gradient)), 1e-300)
    prices, lower_prices, upper_prices = (
        np.zeros(trial.slack.size),
        np.zeros(n_free),
        np.zeros(n_free),
    )
    if not columns.shape[1]:
        return OptimalityConditions(prices, lower_prices, upper_prices, 1.0)
    weights, residual = nnls(columns, -trial.gradient)
    lower_start, upper_start = len(active_indices), len(active_indices) + len(lower_indices)
    prices[active_indices] = weights[:lower_start] / scales[active_indices]
    lower_prices[lower_indices], upper_prices[upper_indices] = (
        weights[lower_start:upper_start],
        weights[upper_start:],
    )
    return OptimalityConditions(prices, lower_prices, upper_prices, float(residual) / gradient_norm)
