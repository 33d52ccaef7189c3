"""Derivatives of sampled mean numbers of gait steps with respect to the parameters of the wheel.

Let z be the vector of the standardized deviations of the slopes in a walk. The walk fails if z is
far enough from zero. The failure radius of the walk is the smallest factor r at which the walk with
the deviations r z/|z| fails. The failure radius is a smooth function of the parameters, although
the outcome of a walk is not. The norm |z| of n independent normal numbers has the chi distribution
with n degrees of freedom. The derivative of the logarithm of the mean number of steps is therefore
a mean over failing walks. The terms of this mean are the hazard rate of the chi distribution at the
failure radius, times the derivative of the failure radius.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from vrw_jax.base.outcomes import Outcome
from vrw_jax.gaits.gait_search import limit_cycle
from vrw_jax.studies.failure_density import GaussianMixture
from vrw_jax.studies.sampled_passage import WalkerGroups
from vrw_jax.wheel.params import WheelParams


class FailingWalks(NamedTuple):
    """Walks that start from the quasi-stationary distribution and fail in their last step."""

    section_states: np.ndarray  # at the starts, (walks, components)
    start_ground: np.ndarray  # slope or heights at the starts, as in `WalkerGroups`
    slope_deviation_directions: np.ndarray  # unit vectors of slope deviations, (walks, lines)
    slope_deviation_norms: np.ndarray  # norms of the slope deviations, (walks,)

    def test_failures(
        self, walker_groups: WalkerGroups, params: WheelParams, norms: np.ndarray
    ) -> np.ndarray:
        """Return whether each walk of the wheel `params` fails if its slope deviations are scaled
        to `norms`, shape (walks,).
        """
        walk_results = walker_groups.run_walks_with_changes(
            params,
            self.section_states,
            self.start_ground,
            norms[:, None] * self.slope_deviation_directions,
        )
        return walk_results.outcome != Outcome.STEPPED

    def bisect_failure_radii(
        self,
        walker_groups: WalkerGroups,
        params: WheelParams,
        lower_radii: np.ndarray,
        upper_radii: np.ndarray,
        n_bisections: int,
    ) -> np.ndarray:
        """Return the failure radius of each walk, shape (walks,), by bisection.

        - `lower_radii`: radii at which the walks do not fail;
        - `upper_radii`: radii at which the walks fail.
        """
        for _ in range(n_bisections):
            middle_radii = 0.5 * (lower_radii + upper_radii)
            has_failed = self.test_failures(walker_groups, params, middle_radii)
            lower_radii = np.where(has_failed, lower_radii, middle_radii)
            upper_radii = np.where(has_failed, middle_radii, upper_radii)
        return 0.5 * (lower_radii + upper_radii)


# Relative change of a parameter in a difference quotient of failure radii. The value is chosen
# because the resulting changes of failure radii are below `BRACKET_HALF_WIDTH`.
RELATIVE_PARAMETER_STEP = 3e-4
# Half the width of the interval that brackets the failure radius for a changed parameter. The unit
# is the standard deviation of a slope.
BRACKET_HALF_WIDTH = 0.2
# Number of bisections for each failure radius at the original parameters.
N_RADIUS_BISECTIONS = 22
# Number of bisections for each failure radius at a changed parameter. The value is chosen because
# the error of the radius is then a hundredth of a typical change.
N_CHANGED_WHEEL_BISECTIONS = 14


def differentiate_log_mean_steps(
    walker_groups: WalkerGroups,
    walk_density: GaussianMixture,
    parameter_names: tuple[str, ...],
) -> dict[str, float]:
    """Return the derivatives of the logarithm of the mean number of gait steps, by parameter name.

    The name `walker_groups.sd_name` means the standard deviation of the ground. A derivative is NaN
    if a wheel with a slightly changed parameter has no gait. The result neglects the influence of
    failures on the quasi-stationary distribution. The neglected terms have the relative size
    1/`mean_steps`.

    - `walk_density`: density from which the slope deviations of walks are drawn.
    """
    from scipy import stats  # This import is slow.

    params, ground_sd = walker_groups.params, walker_groups.ground_sd
    failing_walks = _draw_failing_walks(walker_groups, walk_density)
    zero_radii = np.zeros_like(failing_walks.slope_deviation_norms)
    survives_on_mean_slopes = ~failing_walks.test_failures(walker_groups, params, zero_radii)
    failure_radii = failing_walks.bisect_failure_radii(
        walker_groups,
        params,
        zero_radii,
        failing_walks.slope_deviation_norms,
        N_RADIUS_BISECTIONS,
    )
    radius_distribution = stats.chi(failing_walks.slope_deviation_directions.shape[1])
    hazard_rates = np.exp(
        radius_distribution.logpdf(failure_radii) - radius_distribution.logsf(failure_radii)
    )
    hazard_rates = np.where(survives_on_mean_slopes, hazard_rates, 0.0)

    def differentiate_failure_radii(parameter_name: str) -> np.ndarray:
        """Return the derivatives of all failure radii with respect to one parameter, shape
        (walks,).
        """
        if parameter_name == walker_groups.sd_name:
            return -failure_radii / ground_sd
        parameter_value = float(getattr(params, parameter_name))
        change_size = RELATIVE_PARAMETER_STEP * abs(parameter_value)
        changed_failure_radii = []
        for parameter_change in (change_size, -change_size):
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
                - walker_groups.gait_state,
                start_ground=failing_walks.start_ground
                + (
                    parameter_change
                    if parameter_name == "slope" and not walker_groups.has_heights
                    else 0.0
                ),
            )
            changed_failure_radii.append(
                walks_of_changed_wheel.bisect_failure_radii(
                    walker_groups,
                    changed_params,
                    np.maximum(failure_radii - BRACKET_HALF_WIDTH, 0.0),
                    failure_radii + BRACKET_HALF_WIDTH,
                    N_CHANGED_WHEEL_BISECTIONS,
                )
            )
        return (changed_failure_radii[0] - changed_failure_radii[1]) / (2.0 * change_size)

    n_differentiated_walks = np.sum(survives_on_mean_slopes)
    return {
        parameter_name: float(
            np.sum(hazard_rates * differentiate_failure_radii(parameter_name))
            / n_differentiated_walks
        )
        for parameter_name in parameter_names
    }


# Number of failing walks whose failure radii are computed. The value is chosen because the error of
# a derivative is then a few percent.
N_FAILING_WALKS = 1024
# Largest number of rounds in which failing walks are drawn.
MAX_SAMPLING_ROUNDS = 20


def _draw_failing_walks(walker_groups: WalkerGroups, walk_density: GaussianMixture) -> FailingWalks:
    """Return failing walks with equal weights, resampled from many walks.

    The slopes of the many walks are drawn from `walk_density`. Raise ValueError if no walk fails in
    its last step.
    """
    n_effective_walks = 0.0
    n_walkers = walker_groups.n_walkers
    deviations_by_round: list[np.ndarray] = []
    weights_by_round: list[np.ndarray] = []
    while n_effective_walks < N_FAILING_WALKS and len(weights_by_round) < MAX_SAMPLING_ROUNDS:
        drawn_deviations = walk_density.draw_samples(n_walkers, walker_groups.random)
        deviations_by_round.append(drawn_deviations)
        weights_by_round.append(walker_groups.run_biased_walks(walk_density, drawn_deviations))
        walk_weights = np.concatenate(weights_by_round)
        if np.any(walk_weights):
            n_effective_walks = np.sum(walk_weights) ** 2 / np.sum(walk_weights**2)
    if n_effective_walks == 0.0:
        sd_text = f"{walker_groups.sd_name} {walker_groups.ground_sd:g}"
        raise ValueError(
            f"no sampled walk failed with {sd_text} {'m' if walker_groups.has_heights else 'rad'}, "
            "so that the mean number of steps has no derivative: give a larger "
            f"{walker_groups.sd_name} or n_walkers."
        )
    walk_indices = walker_groups.random.choice(
        len(walk_weights), N_FAILING_WALKS, p=walk_weights / np.sum(walk_weights)
    )
    slope_deviations = np.concatenate(deviations_by_round)[walk_indices]
    slope_deviation_norms = np.linalg.norm(slope_deviations, axis=1)
    return FailingWalks(
        walker_groups.states[walk_indices % n_walkers],
        walker_groups.ground[walk_indices % n_walkers],
        slope_deviations / slope_deviation_norms[:, None],
        slope_deviation_norms,
    )
