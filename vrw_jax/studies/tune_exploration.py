"""Exploration of many starts with an augmented Lagrangian that optax's Adam maximizes in one batch.

First-order optimizer steps bring every start near a local optimum. The maximization continues from
the best start. If a trial has no gait, the parameters of its start do not change, and its step size
is halved.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from vrw_jax.lanes.batching import concatenate_tree_rows, select_tree_rows
from vrw_jax.studies.tune_maximization import TrialEvaluator
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
