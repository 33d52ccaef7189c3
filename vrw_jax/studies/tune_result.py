"""Result of tuning, and the exploration of many starts before the maximization.

The result contains the gait, all evaluated gaits, and the active constraints. In the exploration,
optax's Adam maximizes an augmented Lagrangian in one batch. Its first-order optimizer steps bring
every start near a local optimum. The maximization continues from the best start. If a trial has no
gait, the parameters of its start do not change, and its step size is halved.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from vrw_jax.base.lazy_xarray import xarray as xr
from vrw_jax.base.outcomes import Outcome
from vrw_jax.base.printing import (
    format_heading_and_rows,
    format_html_table,
    format_quantity,
)
from vrw_jax.lanes.batching import concatenate_tree_rows, select_tree_rows
from vrw_jax.studies.tune_maximization import TrialEvaluator, TuneStatus
from vrw_jax.studies.tune_objective import compute_max_violation, compute_slack_scales

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
        current_trials.normalized_parameters,
        end_objectives,
        max_violations,
        penalized_objectives,
        n_lost_trials,
        n_evaluations,
    )


NO_ACTIVE_CONSTRAINT_TEXTS = {
    TuneStatus.CONVERGED: "nothing: a maximum inside all bounds and constraints",
    TuneStatus.BRANCH_ENDED: "the end of the branch, no constraint and no bound",
    TuneStatus.MAX_EVALUATIONS_REACHED: "nothing so far: the maximization has not ended",
    TuneStatus.NO_FEASIBLE_GAIT: "nothing: a constraint is broken here",
    TuneStatus.STALLED: "nothing: the first-order condition is not met",
}
"""Texts that state why no constraint or bound is active, by the status of the maximization."""


class ActiveConstraint(NamedTuple):
    """Active constraint or bound at the optimum.

    - `name`: name of the parameter, or of the constraint with its leg label if it has one;
    - `limit`: bound on the parameter or on the constrained measure;
    - `unit`: unit of the limit;
    - `price`: gain of the objective per unit by which the limit is relaxed, which is the Lagrange
      multiplier. It is NaN if `price_range` contains more than one number;
    - `price_range`: smallest and largest price that satisfy the first-order condition. They differ
      if more limits are active than parameters are free, for example. Both are NaN if the gait does
      not satisfy the condition.
    """

    name: str
    limit: float
    unit: str
    price: float
    price_range: tuple[float, float]

    def describe_price(self) -> str:
        """Return the price, or its range, as text."""
        low, high = self.price_range
        if low == high:
            return f"{self.price:.4g}"
        if low != low:
            return "undefined, because the first-order condition is not met"
        return f"not unique: {low:.4g} to {high:.4g}"


class WalkValidation(NamedTuple):
    """Validation of the tuned wheel by a walk from a slightly displaced start.

    - `n_steps`: number of completed steps;
    - `outcome`: outcome of the last step;
    - `distance`: distance from the limit cycle after the last step, rad, rad/s and m/s;
    - `is_feasible`: whether every step satisfied every constraint on a margin, to within the sum of
      1e-3 of its value and 1e-2 of its default margin.
    """

    n_steps: int
    outcome: Outcome
    distance: float
    is_feasible: bool


@dataclasses.dataclass(frozen=True)
class TuneResult:
    """Result of tuning: the gait, the path of the maximization, and the active constraints.

    - `params`: the tuned wheel;
    - `status`: reason why the maximization ended;
    - `objective`, `value`, `start_value`: name of the objective, and its value at the tuned gait
      and at the start;
    - `active`: constraints and bounds that are active, each with its price;
    - `validation`: validation by a walk of ten steps of the tuned wheel;
    - `cycle`: the gait as a LimitCycle, or as a ReturnMapCycle with unilateral contact;
    - `step`: step of the gait, as a StepResult or a UnilateralStep;
    - `kkt_residual`: residual of the first-order condition, relative to the largest gradient of the
      objective on the path;
    - `kinks`: names of the objective and of active constraints that have a kink at the gait. A
      margin has a kink where its minimum occurs at several instants, or on several legs, at once.
      The multiplier of such a constraint is the sum over the instants;
    - `violated_margins`: names of violated margins that are not constraints;
    - `path`: every gait that was evaluated, in order;
    - `n_evaluations`: number of evaluated gaits, each with one walking step;
    - `n_backtracks`: number of trials without a gait on the branch, or with values that are not
      finite;
    - `seconds`: total time, s;
    - `compile_seconds`: time of compilation, and of the exploration if there are many starts, s;
    - `exploration`: results of many starts before the maximization;
    - `model`: the model with the tuned leg force, if it has one.

    Examples:
        >>> bounds = {"damping": (100.0, 215.0)}
        >>> result = vrw.tune(vrw.WheelParams(), "dls_fraction", ["damping"], bounds)
        >>> print(f"{result.params.damping:.1f} N s/m, {bool(result.cycle.found)}")
        215.0 N s/m, True
    """

    params: Any
    status: TuneStatus
    objective: str
    value: float
    start_value: float
    cycle: Any
    step: Any
    active: tuple[ActiveConstraint, ...]
    kkt_residual: float
    violated_margins: tuple[str, ...]
    validation: WalkValidation
    path: xr.Dataset
    n_evaluations: int
    n_backtracks: int
    seconds: float
    compile_seconds: float
    exploration: ExplorationResult | None = None
    kinks: tuple[str, ...] = ()
    model: Any = None

    @property
    def converged(self) -> bool:
        """Return whether the maximization ended at an optimum."""
        return self.status == TuneStatus.CONVERGED

    @property
    def ending(self) -> str:
        """Return a sentence with the reason why the maximization ended."""
        return self.status.meaning

    def describe(self) -> dict[str, str]:
        """Return the printed texts that summarize the result, by label."""

        def describe_value(name: str) -> str:
            value = self.model.get_parameter(self.params, name)
            return format_quantity(value, self.path[name].attrs["units"])

        names = self.path.free_parameter.values
        parameter_texts = [f"{name} {describe_value(name)}" for name in names]
        feasibility_text = (
            "every constraint kept" if self.validation.is_feasible else "a constraint broken"
        )
        if not self.path.sizes["constraint"]:
            feasibility_text = "no constraint to keep"
        active_constraint_texts = [
            f"{limit.name} at {format_quantity(limit.limit, limit.unit)}" for limit in self.active
        ]
        kink_texts = {
            "kink": f"{', '.join(self.kinks)}: the minimum occurs at several instants at once"
        }
        return {
            "objective": f"{self.objective}: {self.start_value:.6g} at the start, {self.value:.6g}",
            "wheel": ", ".join(parameter_texts),
            "ending": f"{self.status.name}: {self.status.meaning}",
            "held by": ", ".join(active_constraint_texts)
            or NO_ACTIVE_CONSTRAINT_TEXTS[self.status],
            **(kink_texts if self.kinks else {}),
            "not asked for, and broken": ", ".join(self.violated_margins) or "none",
            "walked": f"{self.validation.n_steps} steps, {self.validation.outcome.name}, "
            f"{self.validation.distance:.1e} from the cycle at last; {feasibility_text}",
            "cost": f"{self.n_evaluations} gaits, {self.n_backtracks} steps shortened, "
            f"{self.seconds - self.compile_seconds:.2f} s and {self.compile_seconds:.1f} s to "
            "compile",
        }

    def __repr__(self) -> str:
        return format_heading_and_rows("TuneResult", self.describe().items())

    def _repr_html_(self) -> str:
        return format_html_table("Tuned gait", self.describe().items())
