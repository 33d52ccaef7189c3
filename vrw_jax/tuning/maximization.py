"""Maximization on a branch of gaits with SciPy's SLSQP, in a box that shrinks after failed trials.

SLSQP is sequential quadratic programming with exact gradients. It cannot handle trial wheels
without a gait, or with a gait on another branch. After such a trial, the maximization continues
from the last iterate in a smaller box: half the side of the box is half the distance to the trial.
The path records the trial. Parameters are normalized by the widths between their bounds, so that
every free parameter is between 0 and 1.
"""

import enum
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from vrw_jax.numerics import StatusCode
from vrw_jax.tuning.objective import (
    GaitEvaluation,
    compute_max_violation,
    compute_slack_scales,
)
from vrw_jax.wheel import Outcome


class TuneStatus(StatusCode):
    """Reason why a maximization ended."""

    CONVERGED = 0, "The gait can't be improved nearby without breaking a constraint."
    BRANCH_ENDED = 1, "The branch ends here: every smaller step loses the gait or a finite value."
    MAX_EVALUATIONS_REACHED = 2, "The allowed number of gaits was evaluated before convergence."
    NO_FEASIBLE_GAIT = 3, "No gait that satisfies every constraint was found from this start."


class TrialKind(enum.IntEnum):
    """Kind of a trial in the maximization."""

    START = 0
    TRIAL = 1
    ITERATE = 2
    LOST = 3
    NOT_FINITE = 4


class EvaluatedTrial(NamedTuple):
    """Trial wheel with its evaluated gait. If the wheel has no gait, all values are NaN.

    In a batch of trials, every array has a leading axis over the trials.
    """

    normalized_parameters: np.ndarray  # free parameters in widths of their bounds
    outcome: Any  # code of an `Outcome`
    is_on_branch: Any
    objective: Any
    objective_gradient: np.ndarray  # gradient of the objective by normalized parameters
    constraint_slacks: np.ndarray  # constraint values minus their margins, in their own units
    slack_jacobian: np.ndarray  # (n_constraints, n_free_parameters)
    gait_evaluation: GaitEvaluation

    @property
    def has_gait_on_branch(self) -> Any:
        """Return whether the trial wheel has a gait on the branch of the start."""
        return (self.outcome == Outcome.STEPPED) & self.is_on_branch

    @property
    def has_finite_values(self) -> Any:
        """Return whether the objective, the constraints and their derivatives are finite."""
        return (
            np.isfinite(self.objective)
            & np.isfinite(self.objective_gradient).all(-1)
            & np.isfinite(self.constraint_slacks).all(-1)
            & np.isfinite(self.slack_jacobian).all((-1, -2))
        )

    @property
    def is_usable_trial(self) -> Any:
        """Return whether the maximization may continue from this trial."""
        return self.has_gait_on_branch & self.has_finite_values


class MaximizationResult(NamedTuple):
    """Best trial of a maximization, the reason why it ended, and all trials in order with their
    kinds.
    """

    best_trial: EvaluatedTrial
    status: TuneStatus
    evaluated_trials: list[EvaluatedTrial]
    trial_kinds: list[TrialKind]


class _LostBranchError(Exception):
    """Exception that signals a trial without a usable gait. Its argument is the trial."""


class _EvaluationLimitReachedError(Exception):
    """Exception that signals that the allowed number of gaits has been evaluated."""


class _OptimumReachedError(Exception):
    """Exception that signals a trial that satisfies the first-order condition and the
    constraints. Its argument is the trial.
    """


@dataclass(frozen=True)
class MaximizationOptions:
    """Options of the maximization. Lengths are in widths between the bounds.

    - `full_trust_box_radius`: half the side of the largest box, chosen because that box contains
      all bounds from any center;
    - `min_trust_box_radius`: half the side of a box so small that the branch is considered to end
      there;
    - `coarse_objective_tolerance`: relative change of the objective at which SLSQP stops in a box
      smaller than the largest, chosen because another search continues from the result;
    - `fine_objective_tolerance`: relative change of the objective at which SLSQP stops in the
      largest box, chosen because the objective of a gait is not more accurate;
    - `active_bound_tolerance`: relative slack below which a constraint is treated as active.
    """

    full_trust_box_radius: float = 1.0
    min_trust_box_radius: float = 1e-7
    coarse_objective_tolerance: float = 1e-3
    fine_objective_tolerance: float = 1e-10
    active_bound_tolerance: float = 1e-6


MAXIMIZATION_OPTIONS = MaximizationOptions()
"""Options of the maximization that `vrw.tune` uses."""

TrialEvaluator = Callable[[np.ndarray, EvaluatedTrial | None], EvaluatedTrial]
"""Function that evaluates the trial with given normalized parameters. If a neighboring trial is
given, the search for the gait begins at its gait.
"""


class _TrialRecord:
    """Record of all trials in order. Each point is evaluated only once.

    The keys of `trials` and `kinds` are the bytes of the normalized parameters.
    """

    def __init__(
        self,
        trial_evaluator: TrialEvaluator,
        start_trial: EvaluatedTrial,
        max_evaluations: int,
    ) -> None:
        self._evaluate_trial_gait, self._max_evaluations = trial_evaluator, max_evaluations
        start_key = start_trial.normalized_parameters.tobytes()
        self.trials, self.kinds = {start_key: start_trial}, {start_key: TrialKind.START}

    def evaluate_trial_once(self, normalized_parameters: np.ndarray) -> EvaluatedTrial:
        """Return the trial with these normalized parameters, and evaluate it if it is not yet
        recorded.

        Raise an exception if the trial is unusable, or if the allowed number of evaluations is
        reached.
        """
        trial_key = normalized_parameters.tobytes()
        if trial_key not in self.trials:
            if len(self.trials) >= self._max_evaluations:
                raise _EvaluationLimitReachedError
            nearest_trial = min(
                (trial for trial in self.trials.values() if trial.is_usable_trial),
                key=lambda trial: float(
                    np.linalg.norm(trial.normalized_parameters - normalized_parameters)
                ),
            )
            self.trials[trial_key] = self._evaluate_trial_gait(
                np.array(normalized_parameters), nearest_trial
            )
            self.kinds[trial_key] = TrialKind.TRIAL
        trial = self.trials[trial_key]
        if not trial.is_usable_trial:
            self.kinds[trial_key] = (
                TrialKind.NOT_FINITE if trial.has_gait_on_branch else TrialKind.LOST
            )
            raise _LostBranchError(trial)
        return trial

    def evaluate_iterate_once(self, normalized_parameters: np.ndarray) -> EvaluatedTrial:
        """Return the trial with these normalized parameters, and record it as an iterate."""
        trial = self.evaluate_trial_once(normalized_parameters)
        trial_key = normalized_parameters.tobytes()
        if self.kinds[trial_key] != TrialKind.START:
            self.kinds[trial_key] = TrialKind.ITERATE
        return trial


def maximize_objective(
    trial_evaluator: TrialEvaluator,
    start_trial: EvaluatedTrial,
    *,
    tolerance: float,
    max_evaluations: int,
) -> MaximizationResult:
    """Maximize the objective locally from `start_trial`, subject to slacks of at least 0."""
    from scipy.optimize import minimize  # This import is slow.

    trial_record = _TrialRecord(trial_evaluator, start_trial, max_evaluations)
    gradient_norm = max(float(np.linalg.norm(start_trial.objective_gradient)), 1e-12)
    slack_scales = compute_slack_scales(start_trial.constraint_slacks, start_trial.slack_jacobian)

    compute_violation_of = lambda trial: compute_max_violation(
        trial.constraint_slacks, slack_scales
    )
    active_bound_tolerance = MAXIMIZATION_OPTIONS.active_bound_tolerance

    def record_iterate(trial_parameters: np.ndarray) -> None:
        """Record an iterate of the present box, and stop if it is an optimum."""
        trial = trial_record.evaluate_iterate_once(trial_parameters)
        if (
            compute_violation_of(trial) <= active_bound_tolerance
            and compute_optimality_conditions(trial).kkt_residual <= tolerance
        ):
            raise _OptimumReachedError(trial)
        trust_box_iterates.append(trial)

    def evaluate_loss(trial_parameters: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the function that SLSQP minimizes, and its gradient."""
        trial = trial_record.evaluate_trial_once(trial_parameters)
        return -trial.objective / gradient_norm, -trial.objective_gradient / gradient_norm

    slack_constraints = {
        "type": "ineq",
        "fun": lambda trial_parameters: (
            trial_record.evaluate_trial_once(trial_parameters).constraint_slacks / slack_scales
        ),
        "jac": lambda trial_parameters: (
            trial_record.evaluate_trial_once(trial_parameters).slack_jacobian
            / slack_scales[:, None]
        ),
    }
    center_trial = start_trial
    trust_box_radius = max_trust_box_radius = MAXIMIZATION_OPTIONS.full_trust_box_radius
    tune_status, n_trials_before_trust_box = TuneStatus.CONVERGED, 0
    while True:
        # If this box had no new evaluation, the next box is smaller, because the search would be
        # repeated.
        if len(trial_record.trials) == n_trials_before_trust_box:
            max_trust_box_radius *= 0.5
        n_trials_before_trust_box = len(trial_record.trials)
        trust_box_radius = min(trust_box_radius, max_trust_box_radius)
        if trust_box_radius < MAXIMIZATION_OPTIONS.min_trust_box_radius:
            tune_status = TuneStatus.BRANCH_ENDED
            break
        lower_trust_box_side = np.maximum(
            center_trial.normalized_parameters - trust_box_radius, 0.0
        )
        upper_trust_box_side = np.minimum(
            center_trial.normalized_parameters + trust_box_radius, 1.0
        )
        trust_box_iterates = [center_trial]
        try:
            slsqp_result = minimize(
                evaluate_loss,
                center_trial.normalized_parameters,
                jac=True,
                bounds=list(zip(lower_trust_box_side, upper_trust_box_side, strict=True)),
                constraints=slack_constraints,
                method="SLSQP",
                options={
                    "ftol": MAXIMIZATION_OPTIONS.fine_objective_tolerance
                    if trust_box_radius >= max_trust_box_radius
                    else MAXIMIZATION_OPTIONS.coarse_objective_tolerance,
                    "maxiter": 100,
                },
                callback=record_iterate,
            )
            end_trial = trial_record.evaluate_iterate_once(
                np.clip(slsqp_result.x, lower_trust_box_side, upper_trust_box_side)
            )
        except _LostBranchError as lost_branch:
            center_trial = trust_box_iterates[-1]
            (lost_trial,) = lost_branch.args
            distances_to_lost_trial = np.abs(
                lost_trial.normalized_parameters - center_trial.normalized_parameters
            )
            trust_box_radius = 0.5 * float(np.max(distances_to_lost_trial))
            continue
        except _OptimumReachedError as reached_optimum:
            (center_trial,) = reached_optimum.args
            break
        except _EvaluationLimitReachedError:
            tune_status = TuneStatus.MAX_EVALUATIONS_REACHED
            break
        has_reached_inner_box_side = (
            end_trial.normalized_parameters <= lower_trust_box_side + 1e-9
        ) & (lower_trust_box_side > 0.0)
        has_reached_inner_box_side |= (
            end_trial.normalized_parameters >= upper_trust_box_side - 1e-9
        ) & (upper_trust_box_side < 1.0)
        center_trial = end_trial
        if trust_box_radius >= MAXIMIZATION_OPTIONS.full_trust_box_radius:
            break
        trust_box_radius = (
            min(2.0 * trust_box_radius, MAXIMIZATION_OPTIONS.full_trust_box_radius)
            if has_reached_inner_box_side.any()
            else MAXIMIZATION_OPTIONS.full_trust_box_radius
        )
    if (
        tune_status == TuneStatus.CONVERGED
        and compute_violation_of(center_trial) > 10.0 * active_bound_tolerance
    ):
        tune_status = TuneStatus.NO_FEASIBLE_GAIT
    best_trial = center_trial
    if tune_status != TuneStatus.CONVERGED:
        usable_trials = [trial for trial in trial_record.trials.values() if trial.is_usable_trial]
        feasible_trials = [
            trial
            for trial in usable_trials
            if compute_violation_of(trial) <= active_bound_tolerance
        ]
        best_trial = (
            max(feasible_trials, key=lambda trial: trial.objective)
            if feasible_trials
            else min(usable_trials, key=compute_violation_of)
        )
    return MaximizationResult(
        best_trial, tune_status, [*trial_record.trials.values()], [*trial_record.kinds.values()]
    )


class OptimalityConditions(NamedTuple):
    """Lagrange multipliers of the active constraints and bounds at an optimum."""

    constraint_prices: np.ndarray  # gain of the objective per unit of a relaxed margin
    lower_bound_prices: np.ndarray  # gain of the objective per width of a relaxed lower bound
    upper_bound_prices: np.ndarray
    kkt_residual: (
        float  # residual of the first-order condition, relative to the objective's gradient
    )


def compute_optimality_conditions(trial: EvaluatedTrial) -> OptimalityConditions:
    """Return the multipliers of the Karush-Kuhn-Tucker conditions for a gait.

    They are computed by non-negative least squares.
    """
    from scipy.optimize import nnls  # This import is slow.

    normalized_parameters = trial.normalized_parameters
    slack_scales = compute_slack_scales(trial.constraint_slacks, trial.slack_jacobian)
    active_bound_tolerance = MAXIMIZATION_OPTIONS.active_bound_tolerance
    is_limit_active = np.concatenate(
        [
            np.abs(trial.constraint_slacks) <= 10.0 * active_bound_tolerance * slack_scales,
            normalized_parameters <= active_bound_tolerance,
            normalized_parameters >= 1.0 - active_bound_tolerance,
        ]
    )
    identity_matrix = np.eye(normalized_parameters.size)
    limit_normals = np.concatenate(
        [trial.slack_jacobian / slack_scales[:, None], identity_matrix, -identity_matrix]
    )
    gradient_norm = max(float(np.linalg.norm(trial.objective_gradient)), 1e-300)
    limit_prices, kkt_residual = np.zeros(len(is_limit_active)), 1.0
    if is_limit_active.any():
        limit_prices[is_limit_active], least_squares_residual = nnls(
            limit_normals[is_limit_active].T, -trial.objective_gradient
        )
        kkt_residual = float(least_squares_residual) / gradient_norm
    scaled_constraint_prices, lower_bound_prices, upper_bound_prices = np.split(
        limit_prices, [-2 * normalized_parameters.size, -normalized_parameters.size]
    )
    return OptimalityConditions(
        scaled_constraint_prices / slack_scales,
        lower_bound_prices,
        upper_bound_prices,
        kkt_residual,
    )
