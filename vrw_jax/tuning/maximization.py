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
from typing import NamedTuple

import numpy as np

from vrw_jax.numerics import StatusCode
from vrw_jax.tuning.objective import (
    UPPER_BOUND_PREFIX,
    GaitEvaluation,
    compute_max_violation,
    compute_slack_scales,
    restore_sign_of_bound,
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
    """Trial wheel with its evaluated gait. If the wheel has no gait, all values are NaN."""

    normalized_parameters: np.ndarray  # free parameters in widths of their bounds
    outcome: Outcome
    is_on_branch: bool
    objective: float
    objective_gradient: np.ndarray  # gradient of the objective by normalized parameters
    constraint_slacks: np.ndarray  # constraint values minus their margins, in their own units
    slack_jacobian: np.ndarray  # (n_constraints, n_free_parameters)
    gait_evaluation: GaitEvaluation | None

    @property
    def has_gait_on_branch(self) -> bool:
        """Return whether the trial wheel has a gait on the branch of the start."""
        return self.outcome == Outcome.STEPPED and self.is_on_branch

    @property
    def has_finite_values(self) -> bool:
        """Return whether the objective, the constraints and their derivatives are finite."""
        trial_values = (
            self.objective,
            self.objective_gradient,
            self.constraint_slacks,
            self.slack_jacobian,
        )
        return all(bool(np.isfinite(trial_value).all()) for trial_value in trial_values)

    @property
    def is_usable_trial(self) -> bool:
        """Return whether the maximization may continue from this trial."""
        return self.has_gait_on_branch and self.has_finite_values

    def describe_first_nonfinite_value(
        self,
        objective_label: str,
        constraint_names: tuple[str, ...],
        min_constraint_values: np.ndarray,
    ) -> str:
        """Return a text that names the first value or derivative that is not finite.

        The objective is checked first, then the constraints in their order.
        """
        objective_and_constraint_values = (
            self.objective,
            *map(float, self.constraint_slacks + min_constraint_values),
        )
        objective_and_constraint_gradients = self.objective_gradient, *self.slack_jacobian
        for measure_name, objective_or_constraint_value, objective_or_constraint_gradient in zip(
            (objective_label, *constraint_names),
            objective_and_constraint_values,
            objective_and_constraint_gradients,
            strict=True,
        ):
            unprefixed_measure_name = measure_name.removeprefix(UPPER_BOUND_PREFIX)
            if not np.isfinite(objective_or_constraint_value):
                measure_value = restore_sign_of_bound(measure_name, objective_or_constraint_value)
                return f"{unprefixed_measure_name} is {measure_value:g}"
            if not np.isfinite(objective_or_constraint_gradient).all():
                return f"{unprefixed_measure_name} has a derivative that is not finite"
        raise ValueError("Every number of this trial is finite: describe another.")


class MaximizationResult(NamedTuple):
    """Best trial of a maximization, the reason why it ended, and all trials in order with their
    kinds.
    """

    best_trial: EvaluatedTrial
    status: TuneStatus
    evaluated_trials: list[EvaluatedTrial]
    trial_kinds: list[TrialKind]


class _LostBranchError(Exception):
    """Exception that signals a trial without a usable gait."""

    def __init__(self, lost_trial: EvaluatedTrial) -> None:
        self.lost_trial = lost_trial


class _EvaluationLimitReachedError(Exception):
    """Exception that signals that the allowed number of gaits has been evaluated."""


class _OptimumReachedError(Exception):
    """Exception that signals a trial that satisfies the first-order condition and the
    constraints.
    """

    def __init__(self, optimal_trial: EvaluatedTrial) -> None:
        self.optimal_trial = optimal_trial


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


DEFAULT_MAXIMIZATION_OPTIONS = MaximizationOptions()
"""Options of the maximization that `vrw.tune` uses."""

TrialEvaluator = Callable[[np.ndarray, EvaluatedTrial | None], EvaluatedTrial]
"""Function that evaluates the trial with given normalized parameters. If a neighboring trial is
given, the search for the gait begins at its gait.
"""


class _TrialRecord:
    """Record of all trials in order. Each point is evaluated only once."""

    def __init__(
        self,
        trial_evaluator: TrialEvaluator,
        start_trial: EvaluatedTrial,
        max_evaluations: int,
    ) -> None:
        self.evaluated_trials, self.trial_kinds = [start_trial], [TrialKind.START]
        self._evaluate_trial_gait, self._max_evaluations = trial_evaluator, max_evaluations
        self._trial_index_by_parameters = {start_trial.normalized_parameters.tobytes(): 0}

    def evaluate_trial_once(self, normalized_parameters: np.ndarray) -> EvaluatedTrial:
        """Return the trial with these normalized parameters, and evaluate it if it is not yet
        recorded.

        Raise an exception if the trial is unusable, or if the allowed number of evaluations is
        reached.
        """
        trial_index = self._trial_index_by_parameters.get(normalized_parameters.tobytes())
        if trial_index is None:
            if len(self.evaluated_trials) >= self._max_evaluations:
                raise _EvaluationLimitReachedError
            nearest_gait = min(
                (trial for trial in self.evaluated_trials if trial.is_usable_trial),
                key=lambda trial: float(
                    np.linalg.norm(trial.normalized_parameters - normalized_parameters)
                ),
            )
            trial_index = len(self.evaluated_trials)
            self.evaluated_trials.append(
                self._evaluate_trial_gait(np.array(normalized_parameters), nearest_gait)
            )
            self.trial_kinds.append(TrialKind.TRIAL)
            self._trial_index_by_parameters[normalized_parameters.tobytes()] = trial_index
        trial = self.evaluated_trials[trial_index]
        if not trial.is_usable_trial:
            self.trial_kinds[trial_index] = (
                TrialKind.NOT_FINITE if trial.has_gait_on_branch else TrialKind.LOST
            )
            raise _LostBranchError(trial)
        return trial

    def evaluate_iterate_once(self, normalized_parameters: np.ndarray) -> EvaluatedTrial:
        """Return the trial with these normalized parameters, and record it as an iterate."""
        trial = self.evaluate_trial_once(normalized_parameters)
        trial_index = self._trial_index_by_parameters[normalized_parameters.tobytes()]
        if trial_index:
            self.trial_kinds[trial_index] = TrialKind.ITERATE
        return trial


def maximize_objective(
    trial_evaluator: TrialEvaluator,
    start_trial: EvaluatedTrial,
    *,
    tolerance: float,
    max_evaluations: int,
    maximization_options: MaximizationOptions = DEFAULT_MAXIMIZATION_OPTIONS,
) -> MaximizationResult:
    """Maximize the objective locally from `start_trial`, subject to slacks of at least 0."""
    from scipy.optimize import minimize  # This import is slow.

    trial_record = _TrialRecord(trial_evaluator, start_trial, max_evaluations)
    gradient_norm = max(float(np.linalg.norm(start_trial.objective_gradient)), 1e-12)
    slack_scales = compute_slack_scales(start_trial.constraint_slacks, start_trial.slack_jacobian)

    def stop_at_optimum(trial: EvaluatedTrial) -> EvaluatedTrial:
        if (
            compute_max_violation(trial.constraint_slacks, slack_scales)
            <= maximization_options.active_bound_tolerance
            and compute_optimality_conditions(trial, maximization_options).kkt_residual <= tolerance
        ):
            raise _OptimumReachedError(trial)
        return trial

    center_trial, trust_box_radius, max_trust_box_radius = (
        start_trial,
        maximization_options.full_trust_box_radius,
        maximization_options.full_trust_box_radius,
    )
    tune_status, n_trials_before_trust_box = TuneStatus.CONVERGED, 0
    while True:
        # If this box had no new evaluation, the next box is smaller, because the search would be
        # repeated.
        max_trust_box_radius = (
            max_trust_box_radius
            if len(trial_record.evaluated_trials) > n_trials_before_trust_box
            else 0.5 * max_trust_box_radius
        )
        n_trials_before_trust_box, trust_box_radius = (
            len(trial_record.evaluated_trials),
            min(trust_box_radius, max_trust_box_radius),
        )
        if trust_box_radius < maximization_options.min_trust_box_radius:
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
                lambda trial_parameters: (
                    -trial_record.evaluate_trial_once(trial_parameters).objective / gradient_norm
                ),
                center_trial.normalized_parameters,
                jac=lambda trial_parameters: (
                    -trial_record.evaluate_trial_once(trial_parameters).objective_gradient
                    / gradient_norm
                ),
                bounds=list(zip(lower_trust_box_side, upper_trust_box_side, strict=True)),
                constraints={
                    "type": "ineq",
                    "fun": lambda trial_parameters: (
                        trial_record.evaluate_trial_once(trial_parameters).constraint_slacks
                        / slack_scales
                    ),
                    "jac": lambda trial_parameters: (
                        trial_record.evaluate_trial_once(trial_parameters).slack_jacobian
                        / slack_scales[:, None]
                    ),
                },
                method="SLSQP",
                options={
                    "ftol": maximization_options.fine_objective_tolerance
                    if trust_box_radius >= max_trust_box_radius
                    else maximization_options.coarse_objective_tolerance,
                    "maxiter": 100,
                },
                callback=lambda trial_parameters, trust_box_iterates=trust_box_iterates: (
                    trust_box_iterates.append(
                        stop_at_optimum(trial_record.evaluate_iterate_once(trial_parameters))
                    )
                ),
            )
            end_trial = trial_record.evaluate_iterate_once(
                np.clip(slsqp_result.x, lower_trust_box_side, upper_trust_box_side)
            )
        except _LostBranchError as lost_branch:
            center_trial = trust_box_iterates[-1]
            trust_box_radius = 0.5 * float(
                np.max(
                    np.abs(
                        lost_branch.lost_trial.normalized_parameters
                        - center_trial.normalized_parameters
                    )
                )
            )
            continue
        except _OptimumReachedError as reached_optimum:
            center_trial = reached_optimum.optimal_trial
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
        if trust_box_radius >= maximization_options.full_trust_box_radius:
            break
        trust_box_radius = (
            min(2.0 * trust_box_radius, maximization_options.full_trust_box_radius)
            if has_reached_inner_box_side.any()
            else maximization_options.full_trust_box_radius
        )
    best_trial = center_trial
    if tune_status != TuneStatus.CONVERGED:
        best_trial = _find_best_trial(
            trial_record, slack_scales, center_trial, maximization_options
        )
    elif (
        compute_max_violation(center_trial.constraint_slacks, slack_scales)
        > 10.0 * maximization_options.active_bound_tolerance
    ):
        best_trial = _find_best_trial(
            trial_record, slack_scales, center_trial, maximization_options
        )
        tune_status = TuneStatus.NO_FEASIBLE_GAIT
    return MaximizationResult(
        best_trial, tune_status, trial_record.evaluated_trials, trial_record.trial_kinds
    )


def _find_best_trial(
    trial_record: _TrialRecord,
    slack_scales: np.ndarray,
    last_trial: EvaluatedTrial,
    maximization_options: MaximizationOptions,
) -> EvaluatedTrial:
    """Return the best trial that satisfies all constraints.

    If there is none, return the trial with the smallest violation.
    """
    usable_trials = [trial for trial in trial_record.evaluated_trials if trial.is_usable_trial]
    is_trial_feasible = lambda trial: (
        compute_max_violation(trial.constraint_slacks, slack_scales)
        <= maximization_options.active_bound_tolerance
    )
    feasible_trials = [trial for trial in usable_trials if is_trial_feasible(trial)]
    if not feasible_trials:
        return min(
            usable_trials,
            key=lambda trial: compute_max_violation(trial.constraint_slacks, slack_scales),
        )
    if is_trial_feasible(last_trial):
        feasible_trials.append(last_trial)
    return max(feasible_trials, key=lambda trial: trial.objective)


class OptimalityConditions(NamedTuple):
    """Lagrange multipliers of the active constraints and bounds at an optimum."""

    constraint_prices: np.ndarray  # gain of the objective per unit of a relaxed margin
    lower_bound_prices: np.ndarray  # gain of the objective per width of a relaxed lower bound
    upper_bound_prices: np.ndarray
    kkt_residual: (
        float  # residual of the first-order condition, relative to the objective's gradient
    )


def compute_optimality_conditions(
    trial: EvaluatedTrial, maximization_options: MaximizationOptions = DEFAULT_MAXIMIZATION_OPTIONS
) -> OptimalityConditions:
    """Return the multipliers of the Karush-Kuhn-Tucker conditions for a gait.

    They are computed by non-negative least squares.
    """
    from scipy.optimize import nnls  # This import is slow.

    n_free_parameters, active_bound_tolerance = (
        trial.normalized_parameters.size,
        maximization_options.active_bound_tolerance,
    )
    slack_scales = compute_slack_scales(trial.constraint_slacks, trial.slack_jacobian)
    active_constraint_indices = np.flatnonzero(
        np.abs(trial.constraint_slacks) <= 10.0 * active_bound_tolerance * slack_scales
    )
    active_lower_bound_indices = np.flatnonzero(
        trial.normalized_parameters <= active_bound_tolerance
    )
    active_upper_bound_indices = np.flatnonzero(
        trial.normalized_parameters >= 1.0 - active_bound_tolerance
    )
    identity_matrix = np.eye(n_free_parameters)
    constraint_normals = np.concatenate(
        [
            trial.slack_jacobian[active_constraint_indices]
            / slack_scales[active_constraint_indices, None],
            identity_matrix[active_lower_bound_indices],
            -identity_matrix[active_upper_bound_indices],
        ]
    ).T
    gradient_norm = max(float(np.linalg.norm(trial.objective_gradient)), 1e-300)
    constraint_prices = np.zeros(trial.constraint_slacks.size)
    lower_bound_prices, upper_bound_prices = (
        np.zeros(n_free_parameters),
        np.zeros(n_free_parameters),
    )
    if not constraint_normals.shape[1]:
        return OptimalityConditions(constraint_prices, lower_bound_prices, upper_bound_prices, 1.0)
    constraint_normal_weights, least_squares_residual = nnls(
        constraint_normals, -trial.objective_gradient
    )
    first_lower_bound_weight, first_upper_bound_weight = (
        len(active_constraint_indices),
        len(active_constraint_indices) + len(active_lower_bound_indices),
    )
    constraint_prices[active_constraint_indices] = (
        constraint_normal_weights[:first_lower_bound_weight]
        / slack_scales[active_constraint_indices]
    )
    lower_bound_prices[active_lower_bound_indices] = constraint_normal_weights[
        first_lower_bound_weight:first_upper_bound_weight
    ]
    upper_bound_prices[active_upper_bound_indices] = constraint_normal_weights[
        first_upper_bound_weight:
    ]
    return OptimalityConditions(
        constraint_prices,
        lower_bound_prices,
        upper_bound_prices,
        float(least_squares_residual) / gradient_norm,
    )
