"""Maximization along a branch of gaits by SciPy's SLSQP, in a box that shrinks after lost gaits.

SLSQP is sequential quadratic programming with exact gradients. It does not handle trial wheels
without a gait, or with a gait of another branch. After such a trial the maximization continues from
the last iterate within half the distance, and the path records it. Parameters are measured in
widths of their bounds, so that every free one is between 0 and 1.
"""

import enum
from collections.abc import Callable
from dataclasses import dataclass
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
    """Reason why a maximization ended."""

    CONVERGED = 0, "The gait can't be improved nearby without breaking a constraint."
    BRANCH_ENDED = 1, "The branch ends here: every smaller step loses the gait or a finite value."
    MAX_EVALUATIONS_REACHED = 2, "The allowed number of gaits was evaluated before convergence."
    NO_FEASIBLE_GAIT = 3, "No gait that satisfies every constraint was found from this start."


class TrialKind(enum.IntEnum):
    """Role of an evaluated gait in the maximization."""

    START = 0
    TRIAL = 1
    ITERATE = 2
    LOST = 3
    NOT_FINITE = 4


class EvaluatedTrial(NamedTuple):
    """Wheel with its evaluated gait; if the gait is lost, the numbers are NaN."""

    normalized_parameters: np.ndarray  # free parameters in widths of their bounds
    outcome: Outcome
    is_on_branch: bool
    objective: float
    gradient: np.ndarray  # gradient of the objective by normalized parameters
    slack: np.ndarray  # constraint values minus their margins, in their own units
    slack_jacobian: np.ndarray  # (n_constraints, n_free)
    evaluation: GaitEvaluation | None

    @property
    def is_found(self) -> bool:
        """Return whether there is a gait, on the same branch."""
        return self.outcome == Outcome.STEPPED and self.is_on_branch

    @property
    def is_finite(self) -> bool:
        """Return whether objective, constraints and their derivatives are finite numbers."""
        arrays = (self.objective, self.gradient, self.slack, self.slack_jacobian)
        return all(bool(np.isfinite(array).all()) for array in arrays)

    @property
    def is_usable(self) -> bool:
        """Return whether the maximization may continue from this trial."""
        return self.is_found and self.is_finite

    def describe_nonfinite(
        self, label: str, constraints: tuple[str, ...], min_constraint_values: np.ndarray
    ) -> str:
        """Return a text on the first number that is not finite: the objective, or else a
        constraint.
        """
        values = self.objective, *map(float, self.slack + min_constraint_values)
        gradients = self.gradient, *self.slack_jacobian
        for name, value, gradient in zip((label, *constraints), values, gradients, strict=True):
            measure = name.removeprefix(UPPER_BOUND_PREFIX)
            if not np.isfinite(value):
                return f"{measure} is {signed_bound(name, value):g}"
            if not np.isfinite(gradient).all():
                return f"{measure} has a derivative that is not finite"
        raise ValueError("Every number of this trial is finite: describe another.")


class MaximizationResult(NamedTuple):
    """Best trial, status, and all trials in order with their kinds."""

    best: EvaluatedTrial
    status: TuneStatus
    trials: list[EvaluatedTrial]
    kinds: list[TrialKind]


class _LostBranchError(Exception):
    """Exception raised if a trial has no usable gait."""

    def __init__(self, trial: EvaluatedTrial) -> None:
        self.trial = trial


class _BudgetSpentError(Exception):
    """Exception raised if the allowed number of gaits is evaluated."""


class _OptimumReachedError(Exception):
    """Exception raised if a trial satisfies the first-order condition and the constraints."""

    def __init__(self, trial: EvaluatedTrial) -> None:
        self.trial = trial


@dataclass(frozen=True)
class MaximizationOptions:
    """Options of the maximization; lengths are in widths of the bounds.

    - `full_radius`: half the side of the largest box, chosen because it contains all bounds from
      any center;
    - `min_radius`: half the side of the box at which the end of a branch counts as reached;
    - `coarse_objective_tolerance`: relative change of the objective at which SLSQP stops in a
      smaller box, chosen because the optimum in it is only a point from which the search continues;
    - `fine_objective_tolerance`: that change in the whole box, chosen because gaits are not more
      accurate;
    - `active_bound_tolerance`: slack below which a constraint counts as active.
    """

    full_radius: float = 1.0
    min_radius: float = 1e-7
    coarse_objective_tolerance: float = 1e-3
    fine_objective_tolerance: float = 1e-10
    active_bound_tolerance: float = 1e-6


MAXIMIZATION_OPTIONS = MaximizationOptions()
"""Options of the maximization by `vrw.tune`."""

EvaluateTrial = Callable[[np.ndarray, EvaluatedTrial | None], EvaluatedTrial]
"""Function that returns the trial at normalized parameters, searched for from a neighbor's gait."""


class _TrialRecord:
    """Record of trials in order, in which each point is evaluated once."""

    def __init__(
        self, evaluate: EvaluateTrial, start: EvaluatedTrial, max_evaluations: int
    ) -> None:
        self.trials, self.kinds = [start], [TrialKind.START]
        self._evaluate, self._max_evaluations = evaluate, max_evaluations
        self._indices = {start.normalized_parameters.tobytes(): 0}

    def evaluate_once(self, normalized_parameters: np.ndarray) -> EvaluatedTrial:
        """Return the trial at these normalized parameters, from the record if it exists there;
        raise an exception if the trial is unusable.
        """
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
        """Return the trial at these normalized parameters, and record it as an iterate."""
        trial = self.evaluate_once(normalized_parameters)
        trial_index = self._indices[normalized_parameters.tobytes()]
        if trial_index:
            self.kinds[trial_index] = TrialKind.ITERATE
        return trial

    def _nearest_gait(self, normalized_parameters: np.ndarray) -> EvaluatedTrial:
        """Return the usable trial nearest to these normalized parameters."""
        gaits = [trial for trial in self.trials if trial.is_usable]
        return min(
            gaits,
            key=lambda trial: float(
                np.linalg.norm(trial.normalized_parameters - normalized_parameters)
            ),
        )


def maximize_objective(
    evaluate: EvaluateTrial,
    start: EvaluatedTrial,
    *,
    tolerance: float,
    max_evaluations: int,
    options: MaximizationOptions = MAXIMIZATION_OPTIONS,
) -> MaximizationResult:
    """Maximize the objective locally from `start` with every slack at least zero, and return the
    result.
    """
    from scipy.optimize import minimize  # This import is slow.

    record = _TrialRecord(evaluate, start, max_evaluations)
    gradient_norm = max(float(np.linalg.norm(start.gradient)), 1e-12)
    slack_scales = scale_slacks(start.slack, start.slack_jacobian)

    def stop_at_optimum(trial: EvaluatedTrial) -> EvaluatedTrial:
        if (
            max_breach(trial.slack, slack_scales) <= options.active_bound_tolerance
            and compute_optimality(trial, options).residual <= tolerance
        ):
            raise _OptimumReachedError(trial)
        return trial

    center, radius, max_radius = start, options.full_radius, options.full_radius
    status, n_known_trials = TuneStatus.CONVERGED, 0
    while True:
        # If this box had no new evaluation, the next box is smaller, because the search would be
        # repeated.
        max_radius = max_radius if len(record.trials) > n_known_trials else 0.5 * max_radius
        n_known_trials, radius = len(record.trials), min(radius, max_radius)
        if radius < options.min_radius:
            status = TuneStatus.BRANCH_ENDED
            break
        lower = np.maximum(center.normalized_parameters - radius, 0.0)
        upper = np.minimum(center.normalized_parameters + radius, 1.0)
        iterates = [center]
        try:
            result = minimize(
                lambda u: -record.evaluate_once(u).objective / gradient_norm,
                center.normalized_parameters,
                jac=lambda u: -record.evaluate_once(u).gradient / gradient_norm,
                bounds=list(zip(lower, upper, strict=True)),
                constraints={
                    "type": "ineq",
                    "fun": lambda u: record.evaluate_once(u).slack / slack_scales,
                    "jac": lambda u: record.evaluate_once(u).slack_jacobian / slack_scales[:, None],
                },
                method="SLSQP",
                options={
                    "ftol": options.fine_objective_tolerance
                    if radius >= max_radius
                    else options.coarse_objective_tolerance,
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
        is_at_box_side = (end_trial.normalized_parameters <= lower + 1e-9) & (lower > 0.0)
        is_at_box_side |= (end_trial.normalized_parameters >= upper - 1e-9) & (upper < 1.0)
        center = end_trial
        if radius >= options.full_radius:
            break
        radius = (
            min(2.0 * radius, options.full_radius) if is_at_box_side.any() else options.full_radius
        )
    best_trial = center
    if status != TuneStatus.CONVERGED:
        best_trial = _find_best_trial(record, slack_scales, center, options)
    elif max_breach(center.slack, slack_scales) > 10.0 * options.active_bound_tolerance:
        best_trial = _find_best_trial(record, slack_scales, center, options)
        status = TuneStatus.NO_FEASIBLE_GAIT
    return MaximizationResult(best_trial, status, record.trials, record.kinds)


def _find_best_trial(
    record: _TrialRecord,
    scales: np.ndarray,
    last_trial: EvaluatedTrial,
    options: MaximizationOptions,
) -> EvaluatedTrial:
    """Return the best gait that satisfies all constraints, or else the one with the least
    violation.
    """
    gaits = [trial for trial in record.trials if trial.is_usable]
    is_feasible = lambda trial: max_breach(trial.slack, scales) <= options.active_bound_tolerance
    feasible_gaits = [trial for trial in gaits if is_feasible(trial)]
    if not feasible_gaits:
        return min(gaits, key=lambda trial: max_breach(trial.slack, scales))
    if is_feasible(last_trial):
        feasible_gaits.append(last_trial)
    return max(feasible_gaits, key=lambda trial: trial.objective)


class OptimalityConditions(NamedTuple):
    """Multipliers of the constraints and bounds that are active at an optimum."""

    prices: np.ndarray  # gain of the objective per unit of a relaxed margin
    lower_bound_prices: np.ndarray  # gain of the objective per width of a relaxed lower bound
    upper_bound_prices: np.ndarray
    residual: float  # residual of the first-order condition, relative to the objective's gradient


def compute_optimality(
    trial: EvaluatedTrial, options: MaximizationOptions = MAXIMIZATION_OPTIONS
) -> OptimalityConditions:
    """Return the multipliers of the Karush-Kuhn-Tucker conditions at a gait, by non-negative
    least squares.
    """
    from scipy.optimize import nnls  # This import is slow.

    n_free, tolerance = trial.normalized_parameters.size, options.active_bound_tolerance
    scales = scale_slacks(trial.slack, trial.slack_jacobian)
    active_indices = np.flatnonzero(np.abs(trial.slack) <= 10.0 * tolerance * scales)
    lower_indices = np.flatnonzero(trial.normalized_parameters <= tolerance)
    upper_indices = np.flatnonzero(trial.normalized_parameters >= 1.0 - tolerance)
    identity = np.eye(n_free)
    constraint_normals = np.concatenate(
        [
            trial.slack_jacobian[active_indices] / scales[active_indices, None],
            identity[lower_indices],
            -identity[upper_indices],
        ]
    ).T
    gradient_norm = max(float(np.linalg.norm(trial.gradient)), 1e-300)
    prices = np.zeros(trial.slack.size)
    lower_prices, upper_prices = np.zeros(n_free), np.zeros(n_free)
    if not constraint_normals.shape[1]:
        return OptimalityConditions(prices, lower_prices, upper_prices, 1.0)
    weights, residual = nnls(constraint_normals, -trial.gradient)
    lower_weights_start, upper_weights_start = (
        len(active_indices),
        len(active_indices) + len(lower_indices),
    )
    prices[active_indices] = weights[:lower_weights_start] / scales[active_indices]
    lower_prices[lower_indices] = weights[lower_weights_start:upper_weights_start]
    upper_prices[upper_indices] = weights[upper_weights_start:]
    return OptimalityConditions(prices, lower_prices, upper_prices, float(residual) / gradient_norm)
