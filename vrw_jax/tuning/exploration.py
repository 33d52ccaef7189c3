"""Exploration of many starts with an augmented Lagrangian that optax's Adam maximizes in one batch.

First-order optimizer steps bring every start near a local optimum. The maximization continues from
the best start. If a trial has no gait, the parameters of its start do not change, and its step size
is halved.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vrw_jax.cycles import is_same_branch
from vrw_jax.numerics import select_tree_rows
from vrw_jax.runtime import lazy_import
from vrw_jax.tuning.objective import GaitEvaluation, compute_max_violation, compute_slack_scales
from vrw_jax.wheel import Outcome

optax = lazy_import("optax")


@dataclass(frozen=True)
class ExplorationOptions:
    """Options of the exploration of many starts.

    - `n_first_order_steps`: number of first-order optimizer steps;
    - `first_optimizer_step_length`: length of Adam's first step, in widths between the bounds;
    - `gradient_decay`, `squared_gradient_decay`: decay rates of Adam's running averages of the
      gradient and of the squared gradient;
    - `penalty_weight`: penalty on a violation of one width between the bounds, in units of the
      objective.
    """

    n_first_order_steps: int = 25
    first_optimizer_step_length: float = 0.06
    gradient_decay: float = 0.7
    squared_gradient_decay: float = 0.9
    penalty_weight: float = 4.0


DEFAULT_EXPLORATION_OPTIONS = ExplorationOptions()
"""Options of the exploration that `vrw.tune` uses."""

GaitBatchEvaluator = Callable[[np.ndarray, GaitEvaluation | None], GaitEvaluation]
"""Function that finds and evaluates gaits for an array of normalized parameters, (starts, free). If
evaluations of neighboring gaits are given, the searches begin at these gaits.
"""


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
    gait_batch_evaluator: GaitBatchEvaluator,
    normalized_starts: np.ndarray,
    parameter_change_converter: Callable[[np.ndarray], np.ndarray],
    free_indices: list[int],
    bound_widths: np.ndarray,
    min_constraint_values: np.ndarray,
    exploration_options: ExplorationOptions = DEFAULT_EXPLORATION_OPTIONS,
) -> ExplorationResult:
    """Take first-order optimizer steps from every start, and return the parameters and gaits at the
    ends.

    - `parameter_change_converter`: function that converts changes of normalized parameters to
      changes of all parameters;
    - `free_indices`: indices of the free parameters in the Jacobian of a gait.
    """
    n_starts = normalized_starts.shape[0]
    trial_evaluation = gait_batch_evaluator(normalized_starts, None)
    has_active_gait = are_starts_on_gait(trial_evaluation) & _are_evaluations_finite(
        trial_evaluation, free_indices
    )
    constraint_slacks, slack_jacobians = _compute_slacks_and_jacobians(
        trial_evaluation, free_indices, bound_widths, min_constraint_values
    )
    slack_scales = compute_slack_scales(constraint_slacks, slack_jacobians)[has_active_gait]
    slack_scales = (
        np.median(slack_scales, axis=0)
        if has_active_gait.any()
        else np.ones(min_constraint_values.size)
    )
    objective_gradient_norm = _compute_objective_gradients(
        trial_evaluation, free_indices, bound_widths
    )[has_active_gait]
    objective_gradient_norm = (
        np.median(np.linalg.norm(objective_gradient_norm, axis=1)) if has_active_gait.any() else 1.0
    )
    optimizer_step_lengths = np.full((n_starts, 1), exploration_options.first_optimizer_step_length)
    optimizer = optax.scale_by_adam(
        b1=exploration_options.gradient_decay, b2=exploration_options.squared_gradient_decay
    )
    optimizer_state = optimizer.init(jnp.asarray(normalized_starts))
    constraint_multipliers = np.zeros((n_starts, min_constraint_values.size))
    normalized_parameters, current_evaluation = normalized_starts.copy(), trial_evaluation
    n_lost_trials = np.zeros(n_starts, int)
    for step_index in range(exploration_options.n_first_order_steps):
        constraint_slacks, slack_jacobians = _compute_slacks_and_jacobians(
            current_evaluation, free_indices, bound_widths, min_constraint_values
        )
        penalty_weights = np.maximum(
            0.0,
            constraint_multipliers
            - exploration_options.penalty_weight * constraint_slacks / slack_scales,
        )
        constraint_multipliers = np.where(
            has_active_gait[:, None], penalty_weights, constraint_multipliers
        )
        penalty_gradient = np.einsum("lc,lcf->lf", penalty_weights / slack_scales, slack_jacobians)
        ascent_direction = (
            _compute_objective_gradients(current_evaluation, free_indices, bound_widths)
            / objective_gradient_norm
            + penalty_gradient
        )
        ascent_direction = np.where(has_active_gait[:, None], ascent_direction, 0.0)
        adam_update, optimizer_state = optimizer.update(
            jnp.asarray(ascent_direction), optimizer_state
        )
        trial_step_lengths = (
            optimizer_step_lengths
            * 0.5
            * (1.0 + np.cos(np.pi * step_index / exploration_options.n_first_order_steps))
        )
        trial_parameters = np.clip(
            normalized_parameters + trial_step_lengths * np.asarray(adam_update), 0.0, 1.0
        )
        trial_evaluation = gait_batch_evaluator(trial_parameters, current_evaluation)
        previous_branch_points = current_evaluation.gait.branch_point
        trial_branch_points = trial_evaluation.gait.branch_point
        parameter_changes = parameter_change_converter(trial_parameters - normalized_parameters)
        are_trials_on_branch = [
            is_same_branch(
                select_tree_rows(previous_branch_points, start_index),
                select_tree_rows(trial_branch_points, start_index),
                parameter_change,
            )
            for start_index, parameter_change in enumerate(parameter_changes)
        ]
        is_trial_accepted = (
            are_starts_on_gait(trial_evaluation)
            & _are_evaluations_finite(trial_evaluation, free_indices)
            & has_active_gait
            & np.array(are_trials_on_branch)
        )
        n_lost_trials += has_active_gait & ~is_trial_accepted
        optimizer_step_lengths = np.where(
            is_trial_accepted[:, None], optimizer_step_lengths, 0.5 * optimizer_step_lengths
        )
        normalized_parameters = np.where(
            is_trial_accepted[:, None], trial_parameters, normalized_parameters
        )
        accepted_leaf_selector = lambda new_leaf, old_leaf, is_start_accepted=is_trial_accepted: (
            jnp.where(
                is_start_accepted.reshape(-1, *(1,) * (jnp.ndim(new_leaf) - 1)), new_leaf, old_leaf
            )
        )
        current_evaluation = jax.tree.map(
            accepted_leaf_selector, trial_evaluation, current_evaluation
        )
    constraint_slacks, _ = _compute_slacks_and_jacobians(
        current_evaluation, free_indices, bound_widths, min_constraint_values
    )
    end_objectives = np.where(
        has_active_gait,
        np.asarray(current_evaluation.objective_and_constraint_values)[:, 0],
        np.nan,
    )
    max_violations = compute_max_violation(constraint_slacks, slack_scales)
    penalized_objectives = (
        end_objectives
        - exploration_options.penalty_weight * np.abs(end_objectives) * max_violations
    )
    n_evaluations = n_starts * (exploration_options.n_first_order_steps + 1)
    return ExplorationResult(
        normalized_starts,
        normalized_parameters,
        end_objectives,
        max_violations,
        penalized_objectives,
        n_lost_trials,
        n_evaluations,
    )


def are_starts_on_gait(gait_evaluation: GaitEvaluation) -> np.ndarray:
    """Return whether each start has a gait that an event-driven step confirms."""
    return gait_evaluation.gait.outcome == Outcome.STEPPED


def _are_evaluations_finite(gait_evaluation: GaitEvaluation, free_indices: list[int]) -> np.ndarray:
    """Return, for each start, whether objective, constraints and their derivatives are finite."""
    free_parameter_jacobian = np.asarray(gait_evaluation.parameter_jacobian)[:, free_indices]
    return np.isfinite(gait_evaluation.objective_and_constraint_values).all(-1) & np.isfinite(
        free_parameter_jacobian
    ).all((-1, -2))


def _compute_objective_gradients(
    gait_evaluation: GaitEvaluation, free_indices: list[int], bound_widths: np.ndarray
) -> np.ndarray:
    """Return the gradient of the objective with respect to the normalized parameters.

    Its shape is (starts, free).
    """
    return np.asarray(gait_evaluation.parameter_jacobian)[:, free_indices, 0] * bound_widths


def _compute_slacks_and_jacobians(
    gait_evaluation: GaitEvaluation,
    free_indices: list[int],
    bound_widths: np.ndarray,
    min_constraint_values: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the slacks of the constraints and their Jacobians with respect to normalized
    parameters.

    The shapes are (starts, constraints) and (starts, constraints, free).
    """
    slack_jacobians = (
        np.swapaxes(np.asarray(gait_evaluation.parameter_jacobian)[:, free_indices, 1:], 1, 2)
        * bound_widths
    )
    return np.asarray(gait_evaluation.objective_and_constraint_values)[
        :, 1:
    ] - min_constraint_values, slack_jacobians
