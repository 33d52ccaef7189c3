"""Derivatives of sampled mean numbers of steps with respect to the parameters of the wheel.

A walk over slopes with standardized deviations z fails if z is far enough from zero. The smallest
factor r at which the walk over deviations r z/|z| fails is the failure radius of the walk. It is a
smooth function of the parameters, although the outcome of a walk is not. The radius |z| of n
independent normal numbers has the chi distribution with n degrees of freedom. So the derivative of
the logarithm of the mean number of steps is a mean over failing walks: the hazard rate of that
distribution at the failure radius, times the derivative of the failure radius.
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
    """Options of the derivatives of sampled mean numbers of steps."""

    n_failing_walks: int = 1024
    """Number of failing walks whose failure radii are computed. The value is chosen because the
    error of a derivative is then some per cent."""
    max_sampling_rounds: int = 20
    """Largest number of rounds in which failing walks are drawn."""
    relative_parameter_step: float = 3e-4
    """Relative change of a parameter in a difference quotient of failure radii. The value is chosen
    because failure radii then change by less than `bracket_half_width`."""
    bracket_half_width: float = 0.2
    """Half the width of the interval that contains the failure radius of a changed wheel, in
    standard deviations of a slope."""
    n_bisections: int = 22
    """Number of bisections for a failure radius of the given wheel."""
    n_changed_bisections: int = 14
    """Number of bisections for a changed wheel. The value is chosen because the radius then has an
    error of a hundredth of a typical change."""


PASSAGE_GRADIENT_OPTIONS = PassageGradientOptions()


class FailingWalks(NamedTuple):
    """Walks that fail in their last step, drawn from the quasi-stationary distribution."""

    section_states: np.ndarray  # at the start, (walks, components)
    start_slopes: np.ndarray  # of the line at the start, (walks,), rad
    directions: np.ndarray  # unit vectors of slope deviations, (walks, lines)
    radii: np.ndarray  # norms of the slope deviations, (walks,)


def differentiate_log_mean_steps(
    walker_groups: WalkerGroups,
    walk_density: GaussianMixture,
    parameter_names: tuple[str, ...],
    gradient_options: PassageGradientOptions = PASSAGE_GRADIENT_OPTIONS,
) -> dict[str, float]:
    """Return the derivatives of the logarithm of the mean number of steps, by parameter name.

    The name "slope_sd" stands for the standard deviation of the slopes. A derivative is NaN if a
    wheel with a slightly changed parameter has no gait. The result neglects the dependence of the
    quasi-stationary distribution on failures, which has the relative size 1/`mean_steps`.
    """
    from scipy import stats  # This import is slow.

    params, slope_sd = walker_groups.params, walker_groups.slope_sd
    walks = _draw_failing_walks(walker_groups, walk_density, gradient_options)
    lower, upper = np.zeros_like(walks.radii), walks.radii
    survives_on_mean_slopes = ~_find_failures(walker_groups, params, walks, lower)
    radii = _bisect_failure_radii(
        walker_groups, params, walks, lower, upper, gradient_options.n_bisections
    )
    radius_distribution = stats.chi(walks.directions.shape[1])
    hazard_rates = np.exp(radius_distribution.logpdf(radii) - radius_distribution.logsf(radii))
    hazard_rates = np.where(survives_on_mean_slopes, hazard_rates, 0.0)
    half_width = gradient_options.bracket_half_width
    gait_state = walker_groups.gait_states[0]

    def differentiate_radii(name: str) -> np.ndarray:
        """Return the derivatives of all failure radii with respect to one parameter."""
        if name == "slope_sd":
            return -radii / slope_sd
        value = float(getattr(params, name))
        parameter_step = gradient_options.relative_parameter_step * abs(value)
        changed_radii = []
        for change in (parameter_step, -parameter_step):
            _, changed_params = walker_groups.model.with_parameter(
                params, name, jnp.asarray(value + change, params.damping.dtype)
            )
            cycle: Any = limit_cycle(changed_params, model=walker_groups.model)
            if int(cycle.outcome) != Outcome.STEPPED:
                return np.full_like(radii, np.nan)
            changed_walks = walks._replace(
                section_states=walks.section_states + np.asarray(cycle.section_state) - gait_state,
                start_slopes=walks.start_slopes + (change if name == "slope" else 0.0),
            )
            changed_radii.append(
                _bisect_failure_radii(
                    walker_groups,
                    changed_params,
                    changed_walks,
                    np.maximum(radii - half_width, 0.0),
                    radii + half_width,
                    gradient_options.n_changed_bisections,
                )
            )
        return (changed_radii[0] - changed_radii[1]) / (2.0 * parameter_step)

    n_used_walks = np.sum(survives_on_mean_slopes)
    return {
        name: float(np.sum(hazard_rates * differentiate_radii(name)) / n_used_walks)
        for name in parameter_names
    }


def _draw_failing_walks(
    walker_groups: WalkerGroups,
    walk_density: GaussianMixture,
    gradient_options: PassageGradientOptions,
) -> FailingWalks:
    """Return failing walks with equal weights, resampled from rounds of biased walks.

    Raise ValueError if no walk fails in its last step.
    """
    n_walks, effective_size = gradient_options.n_failing_walks, 0.0
    rounds: list[tuple[np.ndarray, np.ndarray]] = []
    while effective_size < n_walks and len(rounds) < gradient_options.max_sampling_rounds:
        rounds.append(run_biased_walks(walker_groups, walk_density))
        slope_deviations, weights = map(np.concatenate, zip(*rounds, strict=True))
        effective_size = np.sum(weights) ** 2 / np.sum(weights**2) if np.any(weights) else 0.0
    if effective_size == 0.0:
        raise ValueError(
            f"no sampled walk failed with slope_sd {walker_groups.slope_sd:g} rad, so that the "
            "mean number of steps has no derivative: give a larger slope_sd or n_walkers."
        )
    walk_indices = walker_groups.random.choice(len(weights), n_walks, p=weights / np.sum(weights))
    walker_indices = walk_indices % len(walker_groups.states)
    radii = np.linalg.norm(slope_deviations[walk_indices], axis=1)
    return FailingWalks(
        walker_groups.states[walker_indices],
        walker_groups.slopes[walker_indices],
        slope_deviations[walk_indices] / radii[:, None],
        radii,
    )


def _find_failures(
    walker_groups: WalkerGroups, params: WheelParams, walks: FailingWalks, radii: np.ndarray
) -> np.ndarray:
    """Return whether each walk fails if its slope deviations have these norms."""
    landing_slopes = (
        float(params.slope) + walker_groups.slope_sd * radii[:, None] * walks.directions
    )
    line_slopes = np.concatenate([walks.start_slopes[:, None], landing_slopes], 1)
    walk_results = step_batch(
        eqx.tree_at(lambda wheel: wheel.slope, params, line_slopes),
        walks.section_states,
        landing_slopes.shape[1],
        model=walker_groups.model,
        options=walker_groups.step_options,
    )
    has_failed: np.ndarray = walk_results.outcome != Outcome.STEPPED
    return has_failed


def _bisect_failure_radii(
    walker_groups: WalkerGroups,
    params: WheelParams,
    walks: FailingWalks,
    lower: np.ndarray,
    upper: np.ndarray,
    n_bisections: int,
) -> np.ndarray:
    """Return the failure radius of each walk between a radius of survival and one of failure."""
    for _ in range(n_bisections):
        middle = 0.5 * (lower + upper)
        has_failed = _find_failures(walker_groups, params, walks, middle)
        lower, upper = np.where(has_failed, lower, middle), np.where(has_failed, middle, upper)
    return 0.5 * (lower + upper)
