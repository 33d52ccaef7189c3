"""Derivatives of sampled mean numbers of gait steps with respect to the parameters of the wheel.

Let z be the vector of the standardized deviations of the slopes in a walk. The walk fails if z is
far enough from zero. The failure radius of the walk is the smallest factor r at which the walk with
the deviations r z/|z| fails. The failure radius is a smooth function of the parameters, although
the outcome of a walk is not. The norm |z| of n independent normal numbers has the chi distribution
with n degrees of freedom. The derivative of the logarithm of the mean number of steps is therefore
a mean over failing walks. The terms of this mean are the hazard rate of the chi distribution at the
failure radius, times the derivative of the failure radius.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from vrw_jax.batches import step_batch
from vrw_jax.cycles import limit_cycle
from vrw_jax.robustness.failure_density import GaussianMixture
from vrw_jax.robustness.sampled_passage import WalkerGroups, run_biased_walks
from vrw_jax.wheel import Outcome, WheelParams


@dataclass(frozen=True)
class PassageGradientOptions:
    """Numerical options for the derivatives of mean numbers of gait steps from sampled walks."""

    n_failing_walks: int = 1024
    """Number of failing walks whose failure radii are computed.

    The value is chosen because the error of a derivative is then a few percent."""
    max_sampling_rounds: int = 20
    """Largest number of rounds in which failing walks are drawn."""
    relative_parameter_step: float = 3e-4
    """Relative change of a parameter in a difference quotient of failure radii.

    The value is chosen because the resulting changes of failure radii are below
    `bracket_half_width`.
    """
    bracket_half_width: float = 0.2
    """Half the width of the interval that brackets the failure radius for a changed parameter.

    The unit is the standard deviation of a slope.
    """
    n_bisections: int = 22
    """Number of bisections for each failure radius at the original parameters."""
    n_changed_wheel_bisections: int = 14
    """Number of bisections for each failure radius at a changed parameter.

    The value is chosen because the error of the radius is then a hundredth of a typical change.
    """


PASSAGE_GRADIENT_OPTIONS = PassageGradientOptions()


class FailingWalks(NamedTuple):
    """Walks that start from the quasi-stationary distribution and fail in their last step."""

    section_states: np.ndarray  # at the starts, (walks, components)
    start_slopes: np.ndarray  # of the lines at the starts, (walks,), rad
    slope_deviation_directions: np.ndarray  # unit vectors of slope deviations, (walks, lines)
    slope_deviation_norms: np.ndarray  # norms of the slope deviations, (walks,)


def differentiate_log_mean_steps(
    walker_groups: WalkerGroups,
    walk_density: GaussianMixture,
    parameter_names: tuple[str, ...],
    gradient_options: PassageGradientOptions = PASSAGE_GRADIENT_OPTIONS,
) -> dict[str, float]:
    """Return the derivatives of the logarithm of the mean number of gait steps, by parameter name.

    The name "slope_sd" means the standard deviation of the slopes. A derivative is NaN if a wheel
    with a slightly changed parameter has no gait. The result neglects the influence of failures on
    the quasi-stationary distribution. The neglected terms have the relative size 1/`mean_steps`.

    - `walk_density`: density from which the slope deviations of walks are drawn.
    """
    from scipy import stats  # This import is slow.

    params, slope_sd = walker_groups.params, walker_groups.slope_sd
    failing_walks = _draw_failing_walks(walker_groups, walk_density, gradient_options)
    lower_failure_radii, upper_failure_radii = (
        np.zeros_like(failing_walks.slope_deviation_norms),
        failing_walks.slope_deviation_norms,
    )
    survives_on_mean_slopes = ~_test_walk_failures(
        walker_groups, params, failing_walks, lower_failure_radii
    )
    failure_radii = _bisect_failure_radii(
        walker_groups,
        params,
        failing_walks,
        lower_failure_radii,
        upper_failure_radii,
        gradient_options.n_bisections,
    )
    radius_distribution = stats.chi(failing_walks.slope_deviation_directions.shape[1])
    hazard_rates = np.exp(
        radius_distribution.logpdf(failure_radii) - radius_distribution.logsf(failure_radii)
    )
    hazard_rates = np.where(survives_on_mean_slopes, hazard_rates, 0.0)
    bracket_half_width = gradient_options.bracket_half_width
    gait_section_state = walker_groups.gait_states[0]

    def differentiate_failure_radii(parameter_name: str) -> np.ndarray:
        """Return the derivatives of all failure radii with respect to one parameter, shape
        (walks,).
        """
        if parameter_name == "slope_sd":
            return -failure_radii / slope_sd
        parameter_value = float(getattr(params, parameter_name))
        parameter_change_size = gradient_options.relative_parameter_step * abs(parameter_value)
        changed_failure_radii = []
        for parameter_change in (parameter_change_size, -parameter_change_size):
            _, changed_params = walker_groups.model.with_parameter(
                params,
                parameter_name,
                jnp.asarray(parameter_value + parameter_change, params.damping.dtype),
            )
            changed_cycle: Any = limit_cycle(changed_params, model=walker_groups.model)
            if int(changed_cycle.outcome) != Outcome.STEPPED:
                return np.full_like(failure_radii, np.nan)
            walks_of_changed_wheel = failing_walks._replace(
                section_states=failing_walks.section_states
                + np.asarray(changed_cycle.section_state)
                - gait_section_state,
                start_slopes=failing_walks.start_slopes
                + (parameter_change if parameter_name == "slope" else 0.0),
            )
            changed_failure_radii.append(
                _bisect_failure_radii(
                    walker_groups,
                    changed_params,
                    walks_of_changed_wheel,
                    np.maximum(failure_radii - bracket_half_width, 0.0),
                    failure_radii + bracket_half_width,
                    gradient_options.n_changed_wheel_bisections,
                )
            )
        return (changed_failure_radii[0] - changed_failure_radii[1]) / (2.0 * parameter_change_size)

    n_differentiated_walks = np.sum(survives_on_mean_slopes)
    return {
        parameter_name: float(
            np.sum(hazard_rates * differentiate_failure_radii(parameter_name))
            / n_differentiated_walks
        )
        for parameter_name in parameter_names
    }


def _draw_failing_walks(
    walker_groups: WalkerGroups,
    walk_density: GaussianMixture,
    gradient_options: PassageGradientOptions,
) -> FailingWalks:
    """Return failing walks with equal weights, resampled from many walks.

    The slopes of the many walks are drawn from `walk_density`. Raise ValueError if no walk fails in
    its last step.
    """
    n_walks, effective_number_of_walks = gradient_options.n_failing_walks, 0.0
    sampling_rounds: list[tuple[np.ndarray, np.ndarray]] = []
    while (
        effective_number_of_walks < n_walks
        and len(sampling_rounds) < gradient_options.max_sampling_rounds
    ):
        drawn_deviations = walk_density.draw_samples(
            len(walker_groups.states), walker_groups.random
        )
        sampling_rounds.append(
            (drawn_deviations, run_biased_walks(walker_groups, walk_density, drawn_deviations))
        )
        slope_deviations, failure_importance_weights = map(
            np.concatenate, zip(*sampling_rounds, strict=True)
        )
        effective_number_of_walks = (
            np.sum(failure_importance_weights) ** 2 / np.sum(failure_importance_weights**2)
            if np.any(failure_importance_weights)
            else 0.0
        )
    if effective_number_of_walks == 0.0:
        raise ValueError(
            f"no sampled walk failed with slope_sd {walker_groups.slope_sd:g} rad, so that the "
            "mean number of steps has no derivative: give a larger slope_sd or n_walkers."
        )
    resampled_walk_indices = walker_groups.random.choice(
        len(failure_importance_weights),
        n_walks,
        p=failure_importance_weights / np.sum(failure_importance_weights),
    )
    walker_indices = resampled_walk_indices % len(walker_groups.states)
    slope_deviation_norms = np.linalg.norm(slope_deviations[resampled_walk_indices], axis=1)
    return FailingWalks(
        walker_groups.states[walker_indices],
        walker_groups.slopes[walker_indices],
        slope_deviations[resampled_walk_indices] / slope_deviation_norms[:, None],
        slope_deviation_norms,
    )


def _test_walk_failures(
    walker_groups: WalkerGroups,
    params: WheelParams,
    failing_walks: FailingWalks,
    slope_deviation_norms: np.ndarray,
) -> np.ndarray:
    """Return whether each walk fails if its slope deviations are scaled to norm
    `slope_deviation_norms`.

    The result has the shape (walks,).
    """
    landing_slopes = (
        float(params.slope)
        + walker_groups.slope_sd
        * slope_deviation_norms[:, None]
        * failing_walks.slope_deviation_directions
    )
    ground_line_slopes = np.concatenate([failing_walks.start_slopes[:, None], landing_slopes], 1)
    walk_results = step_batch(
        eqx.tree_at(lambda wheel_on_lines: wheel_on_lines.slope, params, ground_line_slopes),
        failing_walks.section_states,
        landing_slopes.shape[1],
        model=walker_groups.model,
        options=walker_groups.step_options,
    )
    has_walk_failed: np.ndarray = walk_results.outcome != Outcome.STEPPED
    return has_walk_failed


def _bisect_failure_radii(
    walker_groups: WalkerGroups,
    params: WheelParams,
    failing_walks: FailingWalks,
    lower_failure_radii: np.ndarray,
    upper_failure_radii: np.ndarray,
    n_bisections: int,
) -> np.ndarray:
    """Return the failure radius of each walk, shape (walks,), by bisection.

    - `lower_failure_radii`: radii at which the walks do not fail;
    - `upper_failure_radii`: radii at which the walks fail.
    """
    for _ in range(n_bisections):
        middle_failure_radii = 0.5 * (lower_failure_radii + upper_failure_radii)
        has_walk_failed = _test_walk_failures(
            walker_groups, params, failing_walks, middle_failure_radii
        )
        lower_failure_radii, upper_failure_radii = (
            np.where(has_walk_failed, lower_failure_radii, middle_failure_radii),
            np.where(has_walk_failed, middle_failure_radii, upper_failure_radii),
        )
    return 0.5 * (lower_failure_radii + upper_failure_radii)
