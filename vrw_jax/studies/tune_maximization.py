"""Maximization on a branch of gaits with SciPy's SLSQP, in a box that shrinks after failed trials.

SLSQP is sequential quadratic programming with exact gradients. It cannot handle trial wheels
without a gait, or with a gait on another branch. After such a trial, the maximization continues
from the last iterate in a smaller box: half the side of the box is half the distance to the trial.
The path records the trial. Parameters are normalized by the widths between their bounds, so that
every free parameter is between 0 and 1.

A margin is a minimum over time. Where several instants have the same minimum, its gradient jumps,
and SLSQP does not satisfy the first-order condition. Cutting planes then continue the maximization:
each step maximizes the linear model from the values and gradients of all nearby trials.
"""

import enum
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from vrw_jax.base.outcomes import Outcome
from vrw_jax.base.printing import StatusCode
from vrw_jax.base.progress import report_progress
from vrw_jax.gaits.finder import Gait
from vrw_jax.studies.tune_objective import compute_max_violation, compute_slack_scales


class TuneStatus(StatusCode):
    """Reason why a maximization ended."""

    CONVERGED = 0, "The gait can't be improved nearby without breaking a constraint."
    BRANCH_ENDED = 1, "The branch ends here: every smaller step loses the gait or a finite value."
    MAX_EVALUATIONS_REACHED = 2, "The allowed number of gaits was evaluated before convergence."
    NO_FEASIBLE_GAIT = 3, "No gait that satisfies every constraint was found from this start."
    STALLED = 4, "No better gait was found nearby, but the first-order condition is not met."


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
    gait: Gait

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


class _SlowConvergenceError(Exception):
    """Exception that signals that SLSQP has used its evaluations, as it does at kinks."""


FULL_TRUST_BOX_RADIUS = 1.0
"""Half the side of the largest box, in widths between the bounds, chosen because that box contains
all bounds from any center.
"""
MIN_TRUST_BOX_RADIUS = 1e-7
"""Half the side of a box so small that the branch is considered to end there, in widths between the
bounds.
"""
COARSE_OBJECTIVE_TOLERANCE = 1e-3
"""Relative change of the objective at which SLSQP stops in a box smaller than the largest, chosen
because another search continues from the result.
"""
FINE_OBJECTIVE_TOLERANCE = 1e-10
"""Relative change of the objective at which SLSQP stops in the largest box, chosen because the
objective of a gait is not more accurate.
"""
ACTIVE_BOUND_TOLERANCE = 1e-6
"""Relative slack below which a constraint is treated as active."""
MAX_SMOOTH_KKT_RESIDUAL = 1e-3
"""Largest residual of the first-order condition at the end of SLSQP, chosen because SLSQP leaves
less than a tenth of it at smooth optima, and more at kinks.
"""
MAX_SLSQP_EVALUATIONS = 40
"""Evaluations of one run of SLSQP. It needs about 20 at smooth optima."""
CUTTING_PLANE_BOX_RADIUS = 0.1
"""Largest half side of the box of the cutting planes, in widths between the bounds."""
VIOLATION_PENALTY = 1e3
"""Loss of objective per violation, in units of its largest gradient. It must exceed the
multipliers, and a larger number only loses digits.
"""
MAX_PIECE_DISTANCE = 1e-4
"""Distance from the optimum within which gradients are compared, in widths between the bounds."""
MIN_GRADIENT_JUMP = 1e-2
"""Relative difference of two gradients at a kink. It is a hundred times the difference that a
smooth function has over `MAX_PIECE_DISTANCE`.
"""
PRICE_ACCURACY = 1e-2
"""Relative width of a price's range below which the price is unique."""

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
                self.usable_trials,
                key=lambda trial: float(
                    np.linalg.norm(trial.normalized_parameters - normalized_parameters)
                ),
            )
            self.trials[trial_key] = self._evaluate_trial_gait(
                np.array(normalized_parameters), nearest_trial
            )
            self.kinds[trial_key] = TrialKind.TRIAL
            report_progress(f"{len(self.trials):,} gaits evaluated")
        trial = self.trials[trial_key]
        if not trial.is_usable_trial:
            self.kinds[trial_key] = (
                TrialKind.NOT_FINITE if trial.has_gait_on_branch else TrialKind.LOST
            )
            raise _LostBranchError(trial)
        return trial

    @property
    def usable_trials(self) -> list[EvaluatedTrial]:
        """Return all trials with a usable gait, in order."""
        return [trial for trial in self.trials.values() if trial.is_usable_trial]

    @property
    def gradient_norm(self) -> float:
        """Return the largest norm of the objective's gradient, which is the objective's scale.

        The gradient at an optimum within the bounds vanishes.
        """
        return max(map(_compute_gradient_norm, self.usable_trials))

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
    gradient_norm = _compute_gradient_norm(start_trial)
    slack_scales = compute_slack_scales(start_trial.constraint_slacks, start_trial.slack_jacobian)

    compute_violation_of = lambda trial: compute_max_violation(
        trial.constraint_slacks, slack_scales
    )
    active_bound_tolerance = ACTIVE_BOUND_TOLERANCE

    def record_iterate(trial_parameters: np.ndarray) -> None:
        """Record an iterate of the present box, and stop if it is an optimum."""
        trial = trial_record.evaluate_iterate_once(trial_parameters)
        if (
            compute_violation_of(trial) <= active_bound_tolerance
            and compute_optimality_conditions(trial, [trial]).kkt_residual <= tolerance
        ):
            raise _OptimumReachedError(trial)
        trust_box_iterates.append(trial)

    def evaluate_loss(trial_parameters: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the function that SLSQP minimizes, and its gradient."""
        n_box_trials = len(trial_record.trials) - n_trials_before_trust_box
        if n_box_trials > MAX_SLSQP_EVALUATIONS:
            raise _SlowConvergenceError
        trial = trial_record.evaluate_trial_once(trial_parameters)
        return -trial.objective / gradient_norm, -trial.objective_gradient / gradient_norm

    def find_end_status(trial: EvaluatedTrial) -> TuneStatus:
        """Return the status of a maximization that finds no better trial than this one."""
        if compute_violation_of(trial) > 10.0 * active_bound_tolerance:
            return TuneStatus.NO_FEASIBLE_GAIT
        conditions = compute_optimality_conditions(trial, trial_record.usable_trials)
        return TuneStatus.CONVERGED if conditions.are_satisfied else TuneStatus.STALLED

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
    trust_box_radius = max_trust_box_radius = FULL_TRUST_BOX_RADIUS
    tune_status, n_trials_before_trust_box = TuneStatus.CONVERGED, 0
    while True:
        # If this box had no new evaluation, the next box is smaller, because the search would be
        # repeated.
        if len(trial_record.trials) == n_trials_before_trust_box:
            max_trust_box_radius *= 0.5
        n_trials_before_trust_box = len(trial_record.trials)
        trust_box_radius = min(trust_box_radius, max_trust_box_radius)
        if trust_box_radius < MIN_TRUST_BOX_RADIUS:
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
                    "ftol": FINE_OBJECTIVE_TOLERANCE
                    if trust_box_radius >= max_trust_box_radius
                    else COARSE_OBJECTIVE_TOLERANCE,
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
        except _SlowConvergenceError:
            break
        has_reached_inner_box_side = (
            end_trial.normalized_parameters <= lower_trust_box_side + 1e-9
        ) & (lower_trust_box_side > 0.0)
        has_reached_inner_box_side |= (
            end_trial.normalized_parameters >= upper_trust_box_side - 1e-9
        ) & (upper_trust_box_side < 1.0)
        center_trial = end_trial
        if trust_box_radius >= FULL_TRUST_BOX_RADIUS:
            break
        trust_box_radius = (
            min(2.0 * trust_box_radius, FULL_TRUST_BOX_RADIUS)
            if has_reached_inner_box_side.any()
            else FULL_TRUST_BOX_RADIUS
        )
    if (
        tune_status == TuneStatus.CONVERGED
        and find_end_status(center_trial) != TuneStatus.CONVERGED
    ):
        center_trial, tune_status = _maximize_by_cutting_planes(
            trial_record, slack_scales, tolerance
        )
        if tune_status == TuneStatus.CONVERGED:
            tune_status = find_end_status(center_trial)
    best_trial = center_trial
    if tune_status != TuneStatus.CONVERGED:
        feasible_trials = [
            trial
            for trial in trial_record.usable_trials
            if compute_violation_of(trial) <= active_bound_tolerance
        ]
        best_trial = (
            max(feasible_trials, key=lambda trial: trial.objective)
            if feasible_trials
            else min(trial_record.usable_trials, key=compute_violation_of)
        )
    return MaximizationResult(
        best_trial, tune_status, [*trial_record.trials.values()], [*trial_record.kinds.values()]
    )


def _compute_gradient_norm(trial: EvaluatedTrial) -> float:
    """Return the norm of the objective's gradient, or 1 if the objective does not change."""
    # Unlike the norm of NumPy, this norm does not underflow for objectives in large units.
    return math.hypot(*trial.objective_gradient) or 1.0


def _maximize_by_cutting_planes(
    trial_record: _TrialRecord, slack_scales: np.ndarray, tolerance: float
) -> tuple[EvaluatedTrial, TuneStatus]:
    """Continue the maximization from the best recorded trial, where functions have kinks.

    Each step maximizes the smallest linear model of the nearby trials in a box around the center.
    A step without a gain shrinks the box, and its trial improves the model. The method is that of
    bundles with a trust region (Kiwiel, Methods of Descent for Nondifferentiable Optimization).
    """
    gradient_norm = trial_record.gradient_norm

    def compute_merit(trial: EvaluatedTrial) -> float:
        return float(
            trial.objective / gradient_norm
            - VIOLATION_PENALTY * compute_max_violation(trial.constraint_slacks, slack_scales)
        )

    trust_box_radius = CUTTING_PLANE_BOX_RADIUS
    center_trial, is_box_lost = max(trial_record.usable_trials, key=compute_merit), False
    n_null_steps = 0
    while trust_box_radius >= MIN_TRUST_BOX_RADIUS:
        model_step, predicted_gain = _maximize_linear_model(
            center_trial, trial_record.usable_trials, trust_box_radius, gradient_norm, slack_scales
        )
        if predicted_gain <= tolerance * trust_box_radius:
            trust_box_radius *= 0.1
            continue
        try:
            trial = trial_record.evaluate_iterate_once(
                np.clip(center_trial.normalized_parameters + model_step, 0.0, 1.0)
            )
        except _LostBranchError:
            is_box_lost, trust_box_radius = True, 0.5 * trust_box_radius
            continue
        except _EvaluationLimitReachedError:
            return center_trial, TuneStatus.MAX_EVALUATIONS_REACHED
        gain = compute_merit(trial) - compute_merit(center_trial)
        n_null_steps += 1
        if gain > 0.1 * predicted_gain:
            center_trial, is_box_lost, n_null_steps = trial, False, 0
        # Each trial adds tangents to the model, at most one for each instant and parameter.
        if n_null_steps > len(model_step):
            trust_box_radius, n_null_steps = 0.5 * trust_box_radius, 0
        elif gain > 0.75 * predicted_gain:
            trust_box_radius = min(2.0 * trust_box_radius, CUTTING_PLANE_BOX_RADIUS)
    return center_trial, TuneStatus.BRANCH_ENDED if is_box_lost else TuneStatus.CONVERGED


def _maximize_linear_model(
    center_trial: EvaluatedTrial,
    trials: list[EvaluatedTrial],
    trust_box_radius: float,
    gradient_norm: float,
    slack_scales: np.ndarray,
) -> tuple[np.ndarray, float]:
    """Return the step from the center that maximizes the linear model, and the gain of merit.

    The model of a function is the smallest of the tangents at all trials in a box of twice the
    size. A tangent that is too low at the center, as those of convex functions are, is raised.
    """
    from scipy.optimize import linprog  # This import is slow.

    center, n_free = center_trial.normalized_parameters, center_trial.normalized_parameters.size
    rows, right_hand_sides = [], []
    violation = compute_max_violation(center_trial.constraint_slacks, slack_scales)
    for trial in trials:
        distance = center - trial.normalized_parameters
        if np.max(np.abs(distance)) > 2.0 * trust_box_radius:
            continue
        objective_excess = (
            trial.objective + trial.objective_gradient @ distance - center_trial.objective
        )
        rows.append(np.r_[-trial.objective_gradient / gradient_norm, 1.0, 0.0])
        right_hand_sides.append(max(objective_excess / gradient_norm, 0.0))
        slacks_at_center = np.maximum(
            trial.constraint_slacks + trial.slack_jacobian @ distance,
            center_trial.constraint_slacks,
        )
        for slack, slack_gradient, slack_scale in zip(
            slacks_at_center, trial.slack_jacobian, slack_scales, strict=True
        ):
            rows.append(np.r_[-slack_gradient / slack_scale, 0.0, -1.0])
            right_hand_sides.append(slack / slack_scale)
    penalty = VIOLATION_PENALTY
    lower_sides = np.maximum(-center, -trust_box_radius)
    upper_sides = np.minimum(1.0 - center, trust_box_radius)
    # The unknowns are the step, the gain of the objective, and the largest violation.
    solution = linprog(
        np.r_[np.zeros(n_free), -1.0, penalty],
        np.array(rows),
        right_hand_sides,
        bounds=[*zip(lower_sides, upper_sides, strict=True), (None, None), (0.0, None)],
    )
    if solution.x is None:  # The box is smaller than the tolerances of the linear program.
        return np.zeros(n_free), 0.0
    return solution.x[:n_free], float(-solution.fun + penalty * violation)


class OptimalityConditions(NamedTuple):
    """Lagrange multipliers of the constraints and bounds at an optimum, as prices.

    A price is the gain of the objective per unit of a relaxed constraint, or per width of a relaxed
    bound, unless `TuneProblem.compute_conditions_per_unit` has converted it. Constraints come
    first, then lower and upper bounds.
    """

    price_ranges: np.ndarray  # (n_limits, 2): smallest and largest price that satisfy the condition
    # residual of the first-order condition, relative to the objective's largest gradient
    kkt_residual: float
    has_kink: np.ndarray  # whether the gradient jumps: first the objective, then the constraints

    @property
    def are_satisfied(self) -> bool:
        """Return whether the residual is as small as at an optimum, so that prices are defined."""
        return self.kkt_residual <= MAX_SMOOTH_KKT_RESIDUAL


def compute_optimality_conditions(
    trial: EvaluatedTrial, evaluated_trials: list[EvaluatedTrial]
) -> OptimalityConditions:
    """Return the multipliers of the Karush-Kuhn-Tucker conditions for a gait.

    They are computed by non-negative least squares from the gradients of the trial. At a kink,
    gradients of the nearest `evaluated_trials` are added, because any of their convex combinations
    may satisfy the conditions (Clarke's subdifferential).
    """
    from scipy.optimize import linprog, nnls  # This import is slow.

    parameters, n_free = trial.normalized_parameters, trial.normalized_parameters.size
    slack_scales = compute_slack_scales(trial.constraint_slacks, trial.slack_jacobian)
    tolerance = ACTIVE_BOUND_TOLERANCE
    gradient_norm = max(map(_compute_gradient_norm, evaluated_trials))
    objective_pieces, *constraint_pieces = _collect_gradient_pieces(
        trial, evaluated_trials, np.r_[gradient_norm, slack_scales]
    )
    identity_matrix = np.eye(n_free)
    limit_pieces = [
        *(
            [piece / scale for piece in pieces] if abs(slack) <= 10.0 * tolerance * scale else []
            for pieces, scale, slack in zip(
                constraint_pieces, slack_scales, trial.constraint_slacks, strict=True
            )
        ),
        *([row] * bool(u <= tolerance) for row, u in zip(identity_matrix, parameters, strict=True)),
        *(
            [-row] * bool(u >= 1.0 - tolerance)
            for row, u in zip(identity_matrix, parameters, strict=True)
        ),
    ]
    n_limits, n_weights = len(limit_pieces), len(objective_pieces)
    # The weights of the objective's gradients have the sum 1. Each gradient of a limit has a price.
    gradients = [
        *(gradient / gradient_norm for gradient in objective_pieces),
        *(gradient for pieces in limit_pieces for gradient in pieces),
    ]
    is_weight = np.arange(len(gradients)) < n_weights
    limit_indices = np.repeat(np.arange(n_limits), [len(pieces) for pieces in limit_pieces])
    weights_and_prices, _ = nnls(
        np.vstack([np.transpose(gradients), is_weight]), np.r_[np.zeros(n_free), 1.0]
    )
    weights_and_prices /= weights_and_prices[:n_weights].sum()
    imbalance = np.transpose(gradients) @ weights_and_prices
    price_of_limit = np.hstack(
        [np.zeros((n_limits, n_weights)), np.arange(n_limits)[:, None] == limit_indices]
    )
    prices = price_of_limit @ weights_and_prices
    max_imbalance = np.max(np.abs(imbalance)) + tolerance
    price_ranges = np.zeros((n_limits, 2))
    for limit_index in np.unique(limit_indices):
        for end, sign in enumerate((1.0, -1.0)):
            solution = linprog(
                sign * price_of_limit[limit_index],
                np.vstack([np.transpose(gradients), -np.transpose(gradients)]),
                np.full(2 * n_free, max_imbalance),
                is_weight[None].astype(float),
                [1.0],
            )
            price_ranges[limit_index, end] = np.inf if solution.x is None else sign * solution.fun
    is_unique = np.diff(price_ranges)[:, 0] <= PRICE_ACCURACY * prices
    price_ranges[is_unique] = prices[is_unique, None]
    price_ranges[price_ranges[:, 1] <= tolerance] = 0.0  # round-off of limits that hold nothing
    price_units = gradient_norm / np.r_[slack_scales, np.ones(2 * n_free)]
    return OptimalityConditions(
        price_ranges * price_units[:, None],
        float(np.linalg.norm(imbalance)),
        np.array([len(pieces) > 1 for pieces in (objective_pieces, *limit_pieces[: -2 * n_free])]),
    )


def _collect_gradient_pieces(
    trial: EvaluatedTrial, evaluated_trials: list[EvaluatedTrial], scales: np.ndarray
) -> list[list[np.ndarray]]:
    """Return the gradients of the objective and of each constraint that a kink at a trial has.

    The first gradient is that of the trial. The other gradients are those of the nearest trials.

    - `scales`: scales of the objective and of the constraints.
    """
    collect_values = lambda trial: np.r_[trial.objective, trial.constraint_slacks]
    collect_gradients = lambda trial: np.vstack([trial.objective_gradient, trial.slack_jacobian])
    compute_changes = lambda other: trial.normalized_parameters - other.normalized_parameters
    compute_distance = lambda other: float(np.max(np.abs(compute_changes(other))))
    pieces = [[gradient] for gradient in collect_gradients(trial)]
    for neighbor in sorted(evaluated_trials, key=compute_distance):
        if compute_distance(neighbor) > MAX_PIECE_DISTANCE:
            break
        gradients = collect_gradients(neighbor)
        # The value of a tied instant, extrapolated to the trial, equals that of the trial.
        value_gaps = (
            collect_values(neighbor) + gradients @ compute_changes(neighbor) - collect_values(trial)
        )
        for function_pieces, gradient, value_gap, scale in zip(
            pieces, gradients, value_gaps, scales, strict=True
        ):
            gradient_jump = min(np.linalg.norm(gradient - piece) for piece in function_pieces)
            if (
                abs(value_gap) <= 10.0 * ACTIVE_BOUND_TOLERANCE * scale
                and gradient_jump > MIN_GRADIENT_JUMP * scale
            ):
                function_pieces.append(gradient)
    return pieces
