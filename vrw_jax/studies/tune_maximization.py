"""Maximization on a branch of gaits with SciPy's SLSQP, in a box that shrinks after failed trials.

SLSQP is sequential quadratic programming with exact gradients. It cannot handle trial wheels
without a gait, or with a gait on another branch. After such a trial, the maximization continues
from the last iterate in a smaller box: half the side of the box is half the distance to the trial.
The path records the trial. Parameters are normalized by the widths between their bounds, so that
every free parameter is between 0 and 1.

A margin is a minimum over time. Where several instants have the same minimum, its gradient jumps,
and SLSQP does not satisfy the first-order condition. Cutting planes then continue the maximization:
each step maximizes the linear model from the values and gradients of all nearby trials.

Many starts are explored before the maximization. In the exploration, optax's Adam maximizes an
augmented Lagrangian in one batch. Its first-order optimizer steps bring every start near a local
optimum. The maximization continues from the best start. If a trial has no gait, the parameters of
its start do not change, and its step size is halved.
"""

import enum
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from vrw_jax.base.progress import report_progress
from vrw_jax.base.results import Outcome, StatusCode
from vrw_jax.gaits.finder import Gait
from vrw_jax.lanes.batching import concatenate_tree_rows, select_tree_rows


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


class _SearchEndedError(Exception):
    """Exception that ends a run of SLSQP. Its arguments are the status and the last trial.

    The status BRANCH_ENDED is that of a trial without a usable gait.
    """


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


def compute_slack_scales(constraint_slacks: np.ndarray, slack_jacobian: np.ndarray) -> np.ndarray:
    """Return the scale of each slack.

    The scale is the norm of the slack's gradient with respect to normalized parameters, that is,
    the change of the slack per width between the bounds. A slack that is always 0 has the scale 1.
    """
    slack_scales = np.maximum(
        np.linalg.norm(slack_jacobian, axis=-1), 1e-3 * np.abs(constraint_slacks)
    )
    return np.where(slack_scales == 0.0, 1.0, slack_scales)


def compute_max_violation(constraint_slacks: np.ndarray, slack_scales: np.ndarray) -> Any:
    """Return the largest violation of a constraint, in widths between the bounds, or 0 if there is
    none.

    The result is NaN if the wheel has no gait.
    """
    return np.max(-constraint_slacks / slack_scales, axis=-1, initial=0.0)


TrialEvaluator = Callable[[np.ndarray, EvaluatedTrial | None], EvaluatedTrial]
"""Function that evaluates the trial with given normalized parameters. If a neighboring trial is
given, the search for the gait begins at its gait.
"""


class _TrialRecord:
    """Record of all trials in order. Each point is evaluated only once.

    The keys of `trials` and `kinds` are the bytes of the normalized parameters.
    """

    def __init__(
        self, evaluate_trial: TrialEvaluator, start_trial: EvaluatedTrial, max_evaluations: int
    ) -> None:
        self._evaluate_trial, self._max_evaluations = evaluate_trial, max_evaluations
        start_key = start_trial.normalized_parameters.tobytes()
        self.trials, self.kinds = {start_key: start_trial}, {start_key: TrialKind.START}
        self.slack_scales = compute_slack_scales(
            start_trial.constraint_slacks, start_trial.slack_jacobian
        )

    def evaluate_trial_once(self, normalized_parameters: np.ndarray) -> EvaluatedTrial:
        """Return the trial with these normalized parameters, and evaluate it if it is not yet
        recorded.

        Raise an exception if the trial is unusable, or if the allowed number of evaluations is
        reached.
        """
        key = normalized_parameters.tobytes()
        if key not in self.trials:
            if len(self.trials) >= self._max_evaluations:
                raise _SearchEndedError(TuneStatus.MAX_EVALUATIONS_REACHED, None)
            nearest_trial = min(
                self.usable_trials,
                key=lambda trial: float(
                    np.linalg.norm(trial.normalized_parameters - normalized_parameters)
                ),
            )
            self.trials[key] = self._evaluate_trial(np.array(normalized_parameters), nearest_trial)
            self.kinds[key] = TrialKind.TRIAL
            report_progress(f"{len(self.trials):,} gaits evaluated")
        trial = self.trials[key]
        if not trial.is_usable_trial:
            has_gait = trial.has_gait_on_branch
            self.kinds[key] = TrialKind.NOT_FINITE if has_gait else TrialKind.LOST
            raise _SearchEndedError(TuneStatus.BRANCH_ENDED, trial)
        return trial

    @property
    def usable_trials(self) -> list[EvaluatedTrial]:
        """Return all trials with a usable gait, in order."""
        return [trial for trial in self.trials.values() if trial.is_usable_trial]

    def evaluate_iterate_once(self, normalized_parameters: np.ndarray) -> EvaluatedTrial:
        """Return the trial with these normalized parameters, and record it as an iterate."""
        trial, key = (
            self.evaluate_trial_once(normalized_parameters),
            normalized_parameters.tobytes(),
        )
        if self.kinds[key] != TrialKind.START:
            self.kinds[key] = TrialKind.ITERATE
        return trial

    def compute_violation(self, trial: EvaluatedTrial) -> float:
        """Return the largest violation of a constraint, in widths between the bounds."""
        return float(compute_max_violation(trial.constraint_slacks, self.slack_scales))

    def find_end_status(self, trial: EvaluatedTrial) -> TuneStatus:
        """Return the status of a maximization that finds no better trial than this one."""
        if self.compute_violation(trial) > 10.0 * ACTIVE_BOUND_TOLERANCE:
            return TuneStatus.NO_FEASIBLE_GAIT
        conditions = compute_optimality_conditions(trial, self.usable_trials)
        return TuneStatus.CONVERGED if conditions.are_satisfied else TuneStatus.STALLED


def maximize_objective(
    trial_evaluator: TrialEvaluator,
    start_trial: EvaluatedTrial,
    tolerance: float,
    max_evaluations: int,
) -> MaximizationResult:
    """Maximize the objective locally from `start_trial`, subject to slacks of at least 0."""
    record = _TrialRecord(trial_evaluator, start_trial, max_evaluations)
    best_trial, status = _maximize_by_slsqp(record, start_trial, tolerance)
    if status == TuneStatus.CONVERGED and record.find_end_status(best_trial) != status:
        best_trial, status = _maximize_by_cutting_planes(record, tolerance)
        if status == TuneStatus.CONVERGED:
            status = record.find_end_status(best_trial)
    if status != TuneStatus.CONVERGED:
        trials = record.usable_trials
        feasible = [x for x in trials if record.compute_violation(x) <= ACTIVE_BOUND_TOLERANCE]
        best_trial = (
            max(feasible, key=lambda trial: trial.objective)
            if feasible
            else min(trials, key=record.compute_violation)
        )
    return MaximizationResult(
        best_trial, status, [*record.trials.values()], [*record.kinds.values()]
    )


def _maximize_by_slsqp(
    record: _TrialRecord, start_trial: EvaluatedTrial, tolerance: float
) -> tuple[EvaluatedTrial, TuneStatus]:
    """Return the trial at which SLSQP ends, in boxes that shrink around unusable trials."""
    from scipy.optimize import minimize  # This import is slow.

    gradient_norm, slack_scales = _compute_gradient_norm(start_trial), record.slack_scales

    def record_iterate(trial_parameters: np.ndarray) -> None:
        """Record an iterate of the present box, and stop if it is an optimum."""
        trial = record.evaluate_iterate_once(trial_parameters)
        if (
            record.compute_violation(trial) <= ACTIVE_BOUND_TOLERANCE
            and compute_optimality_conditions(trial, [trial]).kkt_residual <= tolerance
        ):
            raise _SearchEndedError(TuneStatus.CONVERGED, trial)
        iterates.append(trial)

    def evaluate_loss(trial_parameters: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the function that SLSQP minimizes, and its gradient."""
        if len(record.trials) - n_earlier_trials > MAX_SLSQP_EVALUATIONS:  # as at kinks
            raise _SearchEndedError(TuneStatus.CONVERGED, center)
        trial = record.evaluate_trial_once(trial_parameters)
        return -trial.objective / gradient_norm, -trial.objective_gradient / gradient_norm

    evaluate = record.evaluate_trial_once
    slack_constraints = {
        "type": "ineq",
        "fun": lambda x: evaluate(x).constraint_slacks / slack_scales,
        "jac": lambda x: evaluate(x).slack_jacobian / slack_scales[:, None],
    }
    center, n_earlier_trials = start_trial, 0
    radius = max_radius = FULL_TRUST_BOX_RADIUS
    while True:
        # If this box had no new evaluation, the next box is smaller, because the search would be
        # repeated.
        if len(record.trials) == n_earlier_trials:
            max_radius *= 0.5
        n_earlier_trials = len(record.trials)
        radius = min(radius, max_radius)
        if radius < MIN_TRUST_BOX_RADIUS:
            return center, TuneStatus.BRANCH_ENDED
        x, iterates = center.normalized_parameters, [center]
        lower, upper = np.maximum(x - radius, 0.0), np.minimum(x + radius, 1.0)
        is_largest = radius >= max_radius
        try:
            result = minimize(
                evaluate_loss,
                x,
                jac=True,
                bounds=list(zip(lower, upper, strict=True)),
                constraints=slack_constraints,
                method="SLSQP",
                options={
                    "ftol": FINE_OBJECTIVE_TOLERANCE if is_largest else COARSE_OBJECTIVE_TOLERANCE,
                    "maxiter": 100,
                },
                callback=record_iterate,
            )
            center = record.evaluate_iterate_once(np.clip(result.x, lower, upper))
        except _SearchEndedError as ended:
            status, trial = ended.args
            if status != TuneStatus.BRANCH_ENDED:
                return center if trial is None else trial, status
            center = iterates[-1]
            distances = np.abs(trial.normalized_parameters - center.normalized_parameters)
            radius = 0.5 * float(np.max(distances))
            continue
        if radius >= FULL_TRUST_BOX_RADIUS:
            return center, TuneStatus.CONVERGED
        x = center.normalized_parameters
        is_on_inner_side = (x <= lower + 1e-9) & (lower > 0.0) | (x >= upper - 1e-9) & (upper < 1.0)
        radius = 2.0 * radius if is_on_inner_side.any() else FULL_TRUST_BOX_RADIUS


def _compute_gradient_norm(trial: EvaluatedTrial) -> float:
    """Return the norm of the objective's gradient, or 1 if the objective does not change."""
    # Unlike the norm of NumPy, this norm does not underflow for objectives in large units.
    return math.hypot(*trial.objective_gradient) or 1.0


def _maximize_by_cutting_planes(
    record: _TrialRecord, tolerance: float
) -> tuple[EvaluatedTrial, TuneStatus]:
    """Continue the maximization from the best recorded trial, where functions have kinks.

    Each step maximizes the smallest linear model of the nearby trials in a box around the center.
    A step without a gain shrinks the box, and its trial improves the model. The method is that of
    bundles with a trust region (Kiwiel, Methods of Descent for Nondifferentiable Optimization).
    """
    # The gradient at an optimum within the bounds vanishes, so that the largest is the scale.
    gradient_norm = max(map(_compute_gradient_norm, record.usable_trials))
    compute_merit = lambda trial: float(
        trial.objective / gradient_norm - VIOLATION_PENALTY * record.compute_violation(trial)
    )
    radius, n_null_steps, is_box_lost = CUTTING_PLANE_BOX_RADIUS, 0, False
    center = max(record.usable_trials, key=compute_merit)
    while radius >= MIN_TRUST_BOX_RADIUS:
        step, predicted_gain = _maximize_linear_model(record, center, radius, gradient_norm)
        if predicted_gain <= tolerance * radius:
            radius *= 0.1
            continue
        try:
            trial = record.evaluate_iterate_once(
                np.clip(center.normalized_parameters + step, 0.0, 1.0)
            )
        except _SearchEndedError as ended:
            if ended.args[0] != TuneStatus.BRANCH_ENDED:
                return center, ended.args[0]
            is_box_lost, radius = True, 0.5 * radius
            continue
        gain = compute_merit(trial) - compute_merit(center)
        n_null_steps += 1
        if gain > 0.1 * predicted_gain:
            center, is_box_lost, n_null_steps = trial, False, 0
        # Each trial adds tangents to the model, at most one for each instant and parameter.
        if n_null_steps > len(step):
            radius, n_null_steps = 0.5 * radius, 0
        elif gain > 0.75 * predicted_gain:
            radius = min(2.0 * radius, CUTTING_PLANE_BOX_RADIUS)
    return center, TuneStatus.BRANCH_ENDED if is_box_lost else TuneStatus.CONVERGED


def _maximize_linear_model(
    record: _TrialRecord, center: EvaluatedTrial, radius: float, gradient_norm: float
) -> tuple[np.ndarray, float]:
    """Return the step from the center that maximizes the linear model, and the gain of merit.

    The model of a function is the smallest of the tangents at all trials in a box of twice the
    size. A tangent that is too low at the center, as those of convex functions are, is raised.
    """
    from scipy.optimize import linprog  # This import is slow.

    x, scales = center.normalized_parameters, record.slack_scales
    rows, right_hand_sides = [], []
    for trial in record.usable_trials:
        distance = x - trial.normalized_parameters
        if np.max(np.abs(distance)) > 2.0 * radius:
            continue
        objective_excess = trial.objective + trial.objective_gradient @ distance - center.objective
        rows.append(np.r_[-trial.objective_gradient / gradient_norm, 1.0, 0.0])
        right_hand_sides.append(max(objective_excess / gradient_norm, 0.0))
        slacks = trial.constraint_slacks + trial.slack_jacobian @ distance
        slacks = np.maximum(slacks, center.constraint_slacks) / scales
        right_hand_sides += slacks.tolist()
        rows += [np.r_[row, 0.0, -1.0] for row in -trial.slack_jacobian / scales[:, None]]
    lower_sides, upper_sides = np.maximum(-x, -radius), np.minimum(1.0 - x, radius)
    # The unknowns are the step, the gain of the objective, and the largest violation.
    solution = linprog(
        np.r_[np.zeros(x.size), -1.0, VIOLATION_PENALTY],
        np.array(rows),
        right_hand_sides,
        bounds=[*zip(lower_sides, upper_sides, strict=True), (None, None), (0.0, None)],
    )
    if solution.x is None:  # The box is smaller than the tolerances of the linear program.
        return np.zeros(x.size), 0.0
    violation = record.compute_violation(center)
    return solution.x[: x.size], float(-solution.fun + VIOLATION_PENALTY * violation)


class OptimalityConditions(NamedTuple):
    """Lagrange multipliers of the constraints and bounds at an optimum, as prices.

    A price is the gain of the objective per unit of a relaxed constraint, or per width of a relaxed
    bound, unless `TuneProblem.compute_conditions_per_unit` has converted it. Constraints come
    first, then lower and upper bounds.
    """

    price_ranges: np.ndarray  # (n_limits, 2): smallest and largest price that satisfy the condition
    # residual of the first-order condition, with the slacks of constraints that have a price,
    # relative to the objective's largest gradient
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

    parameters, tolerance = trial.normalized_parameters, ACTIVE_BOUND_TOLERANCE
    n_free, identity = parameters.size, np.eye(parameters.size)
    slack_scales = compute_slack_scales(trial.constraint_slacks, trial.slack_jacobian)
    gradient_norm = max(map(_compute_gradient_norm, evaluated_trials))
    objective_pieces, *constraint_pieces = _collect_gradient_pieces(
        trial, evaluated_trials, np.r_[gradient_norm, slack_scales]
    )
    limit_pieces = [
        *(
            [piece / scale for piece in pieces] if abs(slack) <= 10.0 * tolerance * scale else []
            for pieces, scale, slack in zip(
                constraint_pieces, slack_scales, trial.constraint_slacks, strict=True
            )
        ),
        *([identity[i]] * bool(u <= tolerance) for i, u in enumerate(parameters)),
        *([-identity[i]] * bool(u >= 1.0 - tolerance) for i, u in enumerate(parameters)),
    ]
    n_limits, n_weights = len(limit_pieces), len(objective_pieces)
    # The weights of the objective's gradients have the sum 1. Each gradient of a limit has a price.
    gradients = [
        *(gradient / gradient_norm for gradient in objective_pieces),
        *(gradient for pieces in limit_pieces for gradient in pieces),
    ]
    is_weight, columns = np.arange(len(gradients)) < n_weights, np.transpose(gradients)
    limit_indices = np.repeat(np.arange(n_limits), [len(pieces) for pieces in limit_pieces])
    weights_and_prices, _ = nnls(np.vstack([columns, is_weight]), np.r_[np.zeros(n_free), 1.0])
    weights_and_prices /= weights_and_prices[:n_weights].sum()
    imbalance = columns @ weights_and_prices
    price_of_limit = np.hstack(
        [np.zeros((n_limits, n_weights)), np.arange(n_limits)[:, None] == limit_indices]
    )
    prices = price_of_limit @ weights_and_prices
    # A limit has a price only where it has no slack.
    complementarity = prices[: -2 * n_free] * trial.constraint_slacks / slack_scales
    max_imbalance = np.max(np.abs(imbalance)) + tolerance
    price_ranges = np.zeros((n_limits, 2))
    for limit_index in np.unique(limit_indices):
        for end, sign in enumerate((1.0, -1.0)):
            solution = linprog(
                sign * price_of_limit[limit_index],
                np.vstack([columns, -columns]),
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
        float(np.linalg.norm(np.r_[imbalance, complementarity])),
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


N_FIRST_ORDER_STEPS = 25
"""Number of first-order optimizer steps."""
FIRST_OPTIMIZER_STEP_LENGTH = 0.06
"""Length of Adam's first step, in widths between the bounds."""
GRADIENT_DECAY = 0.7
"""Decay rate of Adam's running average of the gradient."""
SQUARED_GRADIENT_DECAY = 0.9
"""Decay rate of Adam's running average of the squared gradient."""
PENALTY_WEIGHT = 4.0
"""Penalty on a violation of one width between the bounds, in units of the objective."""


class ExplorationResult(NamedTuple):
    """Results of the exploration. Each array has a leading axis over starts."""

    normalized_starts: np.ndarray  # (n_starts, n_free_parameters): starts in widths of the bounds
    start_objective: np.ndarray  # objective at the start; NaN if no gait was found
    normalized_parameters: np.ndarray
    objective: np.ndarray  # objective at the end; NaN if no gait was found
    max_violations: np.ndarray  # largest violation of a constraint, in widths of the bounds
    penalized_objectives: np.ndarray  # objective minus the penalty on the violation
    n_lost_trials: np.ndarray  # number of trials that lost the gait or its branch
    n_evaluations: int  # number of evaluated gaits

    @property
    def best_start_index(self) -> int:
        """Return the index of the start with the highest penalized objective.

        The maximization continues from the end of this start's exploration.
        """
        return int(np.nanargmax(self.penalized_objectives))


def explore_starts(
    evaluate_trials: TrialEvaluator, normalized_starts: np.ndarray
) -> ExplorationResult:
    """Take first-order optimizer steps from every start, and return the parameters and gaits at the
    ends.

    - `evaluate_trials`: function that evaluates a batch of trials;
    - `normalized_starts`: normalized parameters of the starts, (n_starts, n_free_parameters).
    """
    import optax  # This import is slow.

    n_starts = len(normalized_starts)
    current_trials = evaluate_trials(normalized_starts, None)
    has_active_gait = current_trials.is_usable_trial
    if not has_active_gait.any():
        raise ValueError(
            f"none of {n_starts} starts within the bounds has a gait with a finite objective: "
            "narrow the bounds around wheels that walk, such as WheelParams()."
        )
    start_objectives = np.where(has_active_gait, current_trials.objective, np.nan)
    slack_scales = np.median(
        compute_slack_scales(current_trials.constraint_slacks, current_trials.slack_jacobian)[
            has_active_gait
        ],
        axis=0,
    )
    objective_gradient_norm = np.median(
        np.linalg.norm(current_trials.objective_gradient[has_active_gait], axis=1)
    )
    objective_gradient_norm = objective_gradient_norm or 1.0  # if the objective is constant
    optimizer_step_lengths = np.full((n_starts, 1), FIRST_OPTIMIZER_STEP_LENGTH)
    optimizer = optax.scale_by_adam(b1=GRADIENT_DECAY, b2=SQUARED_GRADIENT_DECAY)
    optimizer_state = optimizer.init(jnp.asarray(normalized_starts))
    constraint_multipliers = np.zeros((n_starts, len(slack_scales)))
    n_lost_trials = np.zeros(n_starts, int)
    for step_index in range(N_FIRST_ORDER_STEPS):
        penalty_weights = np.maximum(
            0.0,
            constraint_multipliers
            - PENALTY_WEIGHT * current_trials.constraint_slacks / slack_scales,
        )
        constraint_multipliers = np.where(
            has_active_gait[:, None], penalty_weights, constraint_multipliers
        )
        penalty_gradient = np.einsum(
            "lc,lcf->lf", penalty_weights / slack_scales, current_trials.slack_jacobian
        )
        ascent_direction = np.where(
            has_active_gait[:, None],
            current_trials.objective_gradient / objective_gradient_norm + penalty_gradient,
            0.0,
        )
        adam_update, optimizer_state = optimizer.update(
            jnp.asarray(ascent_direction), optimizer_state
        )
        trial_step_lengths = (
            optimizer_step_lengths * 0.5 * (1.0 + np.cos(np.pi * step_index / N_FIRST_ORDER_STEPS))
        )
        trial_parameters = np.clip(
            current_trials.normalized_parameters + trial_step_lengths * np.asarray(adam_update),
            0.0,
            1.0,
        )
        new_trials = evaluate_trials(trial_parameters, current_trials)
        is_trial_accepted = new_trials.is_usable_trial & has_active_gait
        n_lost_trials += has_active_gait & ~is_trial_accepted
        optimizer_step_lengths = np.where(
            is_trial_accepted[:, None], optimizer_step_lengths, 0.5 * optimizer_step_lengths
        )
        current_trials = select_tree_rows(
            concatenate_tree_rows(current_trials, new_trials),
            np.arange(n_starts) + np.where(is_trial_accepted, n_starts, 0),
        )
    end_objectives = np.where(has_active_gait, current_trials.objective, np.nan)
    max_violations = compute_max_violation(current_trials.constraint_slacks, slack_scales)
    penalized_objectives = end_objectives - PENALTY_WEIGHT * np.abs(end_objectives) * max_violations
    n_evaluations = n_starts * (N_FIRST_ORDER_STEPS + 1)
    return ExplorationResult(
        normalized_starts,
        start_objectives,
        current_trials.normalized_parameters,
        end_objectives,
        max_violations,
        penalized_objectives,
        n_lost_trials,
        n_evaluations,
    )
