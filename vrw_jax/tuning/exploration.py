"""Exploration of many starts: an augmented Lagrangian, maximized by optax's Adam in one batch.

First-order steps bring every start near a local optimum, and the best one is selected for the
maximization. If a trial loses its gait, its start keeps its place and takes half the step size from
then on.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vrw_jax.cycles import is_same_branch
from vrw_jax.numerics import take_rows
from vrw_jax.runtime import lazy_import
from vrw_jax.tuning.objective import GaitEvaluation, max_breach, scale_slacks
from vrw_jax.wheel import Outcome

optax = lazy_import("optax")


@dataclass(frozen=True)
class ExplorationOptions:
    """Options of the exploration of many starts.

    - `n_steps`: number of first-order steps;
    - `learning_rate`: length of Adam's first step, in widths of the bounds;
    - `gradient_decay`, `square_decay`: decay rates of Adam's averages of the gradient and of its
      square;
    - `penalty_weight`: penalty on a violation of one width of the bounds, in units of the
      objective.
    """

    n_steps: int = 25
    learning_rate: float = 0.06
    gradient_decay: float = 0.7
    square_decay: float = 0.9
    penalty_weight: float = 4.0


EXPLORATION_OPTIONS = ExplorationOptions()
"""Options of the exploration by `vrw.tune`."""

EvaluateBatch = Callable[[np.ndarray, GaitEvaluation | None], GaitEvaluation]
"""Function that returns the gaits at rows of normalized parameters, one per start, searched for
from neighboring gaits.
"""


class Exploration(NamedTuple):
    """Results of the exploration, one row per start."""

    normalized_starts: np.ndarray  # (n_starts, n_free): starts in widths of the bounds
    normalized_parameters: np.ndarray
    objective: np.ndarray  # objective at the end; NaN if no gait was found
    max_breach: np.ndarray  # largest violation of a constraint, in widths of the bounds
    merit: np.ndarray  # objective minus the penalty on the violation
    n_lost: np.ndarray  # number of trials that lost the gait or its branch
    n_evaluations: int  # number of evaluated gaits

    @property
    def best_index(self) -> int:
        """Return the index of the start with the highest merit, from which the maximization
        continues.
        """
        return int(np.nanargmax(self.merit))


def explore_starts(
    evaluate: EvaluateBatch,
    starts: np.ndarray,
    parameter_change: Callable[[np.ndarray], np.ndarray],
    free_indices: list[int],
    widths: np.ndarray,
    min_constraint_values: np.ndarray,
    options: ExplorationOptions = EXPLORATION_OPTIONS,
) -> Exploration:
    """Take first-order steps from every start, and return where they end.

    `parameter_change` converts changes of u to changes of the parameters. Jacobians of a gait are
    with respect to all parameters; `free_indices` select the free ones.
    """
    n_starts = starts.shape[0]
    trial_evaluation = evaluate(starts, None)
    is_active = has_gait(trial_evaluation) & _is_finite(trial_evaluation, free_indices)
    slacks, slack_jacobian = _slack_and_jacobian(
        trial_evaluation, free_indices, widths, min_constraint_values
    )
    scales = scale_slacks(slacks, slack_jacobian)[is_active]
    scales = np.median(scales, axis=0) if is_active.any() else np.ones(min_constraint_values.size)
    objective_scale = _objective_gradient(trial_evaluation, free_indices, widths)[is_active]
    objective_scale = np.median(np.linalg.norm(objective_scale, axis=1)) if is_active.any() else 1.0
    learning_rates = np.full((n_starts, 1), options.learning_rate)
    optimizer = optax.scale_by_adam(b1=options.gradient_decay, b2=options.square_decay)
    optimizer_state = optimizer.init(jnp.asarray(starts))
    multipliers = np.zeros((n_starts, min_constraint_values.size))
    normalized_parameters, evaluation = starts.copy(), trial_evaluation
    n_lost = np.zeros(n_starts, int)
    for step_index in range(options.n_steps):
        slacks, slack_jacobian = _slack_and_jacobian(
            evaluation, free_indices, widths, min_constraint_values
        )
        weights = np.maximum(0.0, multipliers - options.penalty_weight * slacks / scales)
        multipliers = np.where(is_active[:, None], weights, multipliers)
        penalty_gradient = np.einsum("lc,lcf->lf", weights / scales, slack_jacobian)
        ascent_direction = (
            _objective_gradient(evaluation, free_indices, widths) / objective_scale
            + penalty_gradient
        )
        ascent_direction = np.where(is_active[:, None], ascent_direction, 0.0)
        adam_update, optimizer_state = optimizer.update(
            jnp.asarray(ascent_direction), optimizer_state
        )
        step_sizes = learning_rates * 0.5 * (1.0 + np.cos(np.pi * step_index / options.n_steps))
        trial_parameters = np.clip(
            normalized_parameters + step_sizes * np.asarray(adam_update), 0.0, 1.0
        )
        trial_evaluation = evaluate(trial_parameters, evaluation)
        is_accepted = (
            has_gait(trial_evaluation)
            & _is_finite(trial_evaluation, free_indices)
            & is_active
            & _stays_on_branch(
                evaluation,
                trial_evaluation,
                parameter_change(trial_parameters - normalized_parameters),
            )
        )
        n_lost += is_active & ~is_accepted
        learning_rates = np.where(is_accepted[:, None], learning_rates, 0.5 * learning_rates)
        normalized_parameters = np.where(
            is_accepted[:, None], trial_parameters, normalized_parameters
        )
        select_accepted = lambda new_leaf, old_leaf, accepted=is_accepted: jnp.where(
            accepted.reshape(-1, *(1,) * (jnp.ndim(new_leaf) - 1)), new_leaf, old_leaf
        )
        evaluation = jax.tree.map(select_accepted, trial_evaluation, evaluation)
    slacks, _ = _slack_and_jacobian(evaluation, free_indices, widths, min_constraint_values)
    objective = np.where(is_active, np.asarray(evaluation.values)[:, 0], np.nan)
    largest_breach = max_breach(slacks, scales)
    merit = objective - options.penalty_weight * np.abs(objective) * largest_breach
    n_evaluations = n_starts * (options.n_steps + 1)
    return Exploration(
        starts, normalized_parameters, objective, largest_breach, merit, n_lost, n_evaluations
    )


def has_gait(evaluation: GaitEvaluation) -> np.ndarray:
    """Return whether each start has a gait that the event-driven step confirms."""
    return evaluation.gait.outcome == Outcome.STEPPED


def _is_finite(evaluation: GaitEvaluation, free_indices: list[int]) -> np.ndarray:
    """Return whether all values, and derivatives with respect to the free parameters, of each
    start are finite.
    """
    jacobian = np.asarray(evaluation.jacobian)[:, free_indices]
    return np.isfinite(evaluation.values).all(-1) & np.isfinite(jacobian).all((-1, -2))


def _objective_gradient(
    evaluation: GaitEvaluation, free_indices: list[int], widths: np.ndarray
) -> np.ndarray:
    """Return the gradient of the objective with respect to the normalized parameters, (starts,
    free).
    """
    return np.asarray(evaluation.jacobian)[:, free_indices, 0] * widths


def _slack_and_jacobian(
    evaluation: GaitEvaluation,
    free_indices: list[int],
    widths: np.ndarray,
    min_constraint_values: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return slacks (starts, constraints), and their derivatives by normalized parameters (starts,
    constraints, free).
    """
    jacobian = np.swapaxes(np.asarray(evaluation.jacobian)[:, free_indices, 1:], 1, 2) * widths
    return np.asarray(evaluation.values)[:, 1:] - min_constraint_values, jacobian


def _stays_on_branch(
    previous_evaluation: GaitEvaluation,
    trial_evaluation: GaitEvaluation,
    parameter_changes: np.ndarray,
) -> np.ndarray:
    """Return whether each trial's gait is on the branch of the previous gait of its start."""
    previous_points, trial_points = (
        previous_evaluation.gait.branch_point,
        trial_evaluation.gait.branch_point,
    )
    point_pairs = (
        (*take_rows((previous_points, trial_points), start_index), parameter_change)
        for start_index, parameter_change in enumerate(parameter_changes)
    )
    return np.array([is_same_branch(*point_pair) for point_pair in point_pairs])
