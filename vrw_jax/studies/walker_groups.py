"""Groups of walkers on random ground, and densities of ground on which walks often fail.

Gaussian mixtures are fitted to rare failures of walks, for importance sampling. The method is the
cross-entropy method (Rubinstein and Kroese 2004). At first the standard deviation of the slopes is
multiplied by an inflation factor, so that failures are frequent. A mixture is then fitted to the
failures, and the inflation decreases to 1 in stages.
"""

import collections
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from vrw_jax.base.options import StepOptions, find_tree_parameter, replace_tree_parameter
from vrw_jax.base.results import Outcome
from vrw_jax.lanes.batching import concatenate_tree_rows, replace_rows
from vrw_jax.models.step_batch import step_batch
from vrw_jax.models.walk_batch import StepBatchResult

DeviationWalkFunction = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
"""Function that simulates one walk for each sequence of standardized slopes.

The argument has the shape (walks, lines), with one slope for each line of the ground between two
footholds. The function returns two boolean arrays of shape (walks,): whether a walk fails in its
last step, and whether it fails in any step.
"""


MIN_UNIFORM_NUMBER = 2.0**-31
"""Smallest uniform number that is mapped to a normal number.

The value is chosen because it is half the resolution of the points of a Sobol' sequence.
"""


class GaussianMixture(NamedTuple):
    """Mixture of Gaussian densities of standardized slope deviations."""

    gaussian_weights: np.ndarray  # (components,), sum 1
    gaussian_means: np.ndarray  # (components, dimensions)
    # Cholesky factors of the covariances, (components, dimensions, dimensions)
    covariance_cholesky_factors: np.ndarray

    @classmethod
    def make_isotropic_gaussian(
        cls, n_dimensions: int, standard_deviation: float
    ) -> "GaussianMixture":
        """Return a mixture of one Gaussian with mean zero and covariance `standard_deviation`^2
        times the identity.
        """
        return cls(
            np.ones(1), np.zeros((1, n_dimensions)), standard_deviation * np.eye(n_dimensions)[None]
        )

    def add_mixture(
        self, added_mixture: "GaussianMixture", added_mixture_weight: float
    ) -> "GaussianMixture":
        """Return the weighted sum of this mixture and `added_mixture`, whose weight is
        `added_mixture_weight`.

        The weight of this mixture is 1 - `added_mixture_weight`.
        """
        scale = lambda mixture, weight: mixture._replace(
            gaussian_weights=weight * mixture.gaussian_weights
        )
        return concatenate_tree_rows(
            scale(self, 1.0 - added_mixture_weight), scale(added_mixture, added_mixture_weight)
        )

    def compute_gaussian_log_densities(self, slope_deviations: np.ndarray) -> np.ndarray:
        """Return the logarithm of each Gaussian's density times its weight, shape (components,
        samples).
        """
        centered_deviations = slope_deviations - self.gaussian_means[:, None]
        whitened_deviations = np.linalg.solve(
            self.covariance_cholesky_factors, centered_deviations.transpose(0, 2, 1)
        )
        log_determinants = np.log(
            np.diagonal(self.covariance_cholesky_factors, axis1=1, axis2=2)
        ).sum(1)
        log_normalizations = (
            np.log(self.gaussian_weights)
            - log_determinants
            - 0.5 * self.gaussian_means.shape[1] * np.log(2.0 * np.pi)
        )
        return log_normalizations[:, None] - 0.5 * np.sum(whitened_deviations**2, 1)

    def compute_log_density(self, slope_deviations: np.ndarray) -> np.ndarray:
        """Return the logarithm of the mixture's density at each sample, shape (samples,)."""
        return np.logaddexp.reduce(self.compute_gaussian_log_densities(slope_deviations), 0)

    def draw_samples(self, n_samples: int, random_generator: np.random.Generator) -> np.ndarray:
        """Return independent samples from the mixture, shape (samples, dimensions)."""
        n_dimensions = self.gaussian_means.shape[1]
        return self.map_uniform_numbers(random_generator.random((n_samples, 1 + n_dimensions)))

    def map_uniform_numbers(self, uniform_numbers: np.ndarray) -> np.ndarray:
        """Return samples from the mixture, shape (samples, dimensions).

        - `uniform_numbers`: uniformly distributed points of the unit cube, shape (samples,
          1 + dimensions). The first coordinate selects a Gaussian of the mixture.
        """
        from scipy import special  # This import is slow.

        gaussian_indices = np.searchsorted(
            np.cumsum(self.gaussian_weights[:-1]), uniform_numbers[:, 0]
        )
        normal_samples = special.ndtri(
            np.clip(uniform_numbers[:, 1:], MIN_UNIFORM_NUMBER, 1.0 - MIN_UNIFORM_NUMBER)
        )
        slope_deviations = self.gaussian_means[gaussian_indices]
        for gaussian_index, cholesky_factor in enumerate(self.covariance_cholesky_factors):
            is_from_gaussian = gaussian_indices == gaussian_index
            slope_deviations[is_from_gaussian] += (
                normal_samples[is_from_gaussian] @ cholesky_factor.T
            )
        return slope_deviations


# Number of Gaussians in a mixture. The value is chosen because the paper's wheel fails in two ways,
# each in a curved region of slopes.
N_GAUSSIANS = 4
# Variance that is added to each fitted Gaussian in every direction. The variance bounds the
# likelihood ratios if only few walks fail.
MIN_GAUSSIAN_VARIANCE = 0.02
# Number of iterations of expectation maximization. The value is chosen because the variance of the
# likelihood ratios is hardly smaller with 25 iterations.
N_EM_ITERATIONS = 12


def fit_gaussian_mixture(
    slope_deviations: np.ndarray, random_generator: np.random.Generator
) -> GaussianMixture:
    """Return a Gaussian mixture, fitted to samples by expectation maximization.

    The initial means are samples far from each other (Arthur and Vassilvitskii 2007).

    - `slope_deviations`: samples, shape (samples, dimensions).
    """
    n_samples, n_dimensions = slope_deviations.shape
    covariance_floor = MIN_GAUSSIAN_VARIANCE * np.eye(n_dimensions)
    gaussian_means = slope_deviations[random_generator.integers(n_samples)][None]
    for _ in range(N_GAUSSIANS - 1):
        squared_distances = np.min(np.sum((slope_deviations[:, None] - gaussian_means) ** 2, -1), 1)
        total_distance = np.sum(squared_distances)
        next_mean_index = random_generator.choice(
            n_samples, p=squared_distances / total_distance if total_distance > 0.0 else None
        )
        gaussian_means = np.concatenate([gaussian_means, slope_deviations[next_mean_index][None]])
    covariance = np.cov(slope_deviations.T).reshape(n_dimensions, n_dimensions) + covariance_floor
    n_gaussians = len(gaussian_means)
    gaussian_mixture = GaussianMixture(
        np.full(n_gaussians, 1.0 / n_gaussians),
        gaussian_means,
        np.tile(np.linalg.cholesky(covariance), (n_gaussians, 1, 1)),
    )
    for _ in range(N_EM_ITERATIONS):
        log_densities = gaussian_mixture.compute_gaussian_log_densities(slope_deviations)
        membership_probabilities = np.exp(log_densities - np.logaddexp.reduce(log_densities, 0))
        # The additional sample prevents an empty Gaussian.
        effective_sizes = np.sum(membership_probabilities, 1) + 1.0
        gaussian_means = (
            membership_probabilities @ slope_deviations + gaussian_mixture.gaussian_means
        ) / effective_sizes[:, None]
        centered_deviations = slope_deviations - gaussian_means[:, None]
        covariances = (
            membership_probabilities[:, None] * centered_deviations.transpose(0, 2, 1)
        ) @ centered_deviations / effective_sizes[:, None, None] + covariance_floor
        gaussian_mixture = GaussianMixture(
            effective_sizes / np.sum(effective_sizes),
            gaussian_means,
            np.linalg.cholesky(covariances),
        )
    return gaussian_mixture


# Largest number of walks per stage. The value is chosen because the variance of the likelihood
# ratios is hardly smaller with more walks.
MAX_WALKS_PER_STAGE = 4096
# Fraction of walks whose slopes are drawn from the nominal density. The inverse of the fraction
# bounds all likelihood ratios. The nominal walks also find frequent failures that the fit missed.
NOMINAL_WALK_FRACTION = 0.1
# Fraction of walks whose slopes are drawn from the fitted Gaussians with wider standard deviations.
# The wide Gaussians bound the likelihood ratios of failures outside the fitted ones.
WIDE_WALK_FRACTION = 0.2
# Ratio of the standard deviations of the wide Gaussians to those of the fitted Gaussians.
WIDENING_FACTOR = 1.7
# Number of fits with the nominal standard deviation of the slopes. The value is chosen because the
# second fit uses failures of walks that the first fit proposes.
N_UNINFLATED_FITS = 2
# Largest number of walks with which an inflation factor of the slopes is tested. The value is
# chosen because the standard error of the fraction of failing walks is then 0.02.
MAX_INFLATION_TEST_WALKS = 256
# Smallest fraction of failing walks at which the inflation of the slopes is not increased further.
# The value is chosen because about a third of the failing walks fail in their last step.
MIN_FAILURE_FRACTION = 0.15
# Ratio of successive inflation factors of the slopes' standard deviation.
SLOPE_INFLATION_FACTOR = 1.3
# Largest inflation factor of the slopes' standard deviation. The value is chosen because failures
# that need a larger inflation have probabilities below 1e-80.
MAX_SLOPE_INFLATION = 20.0
# Number of failures that are resampled by weight for each fit.
N_EM_SAMPLES = 2000


def fit_failure_density(
    run_walks: DeviationWalkFunction,
    n_dimensions: int,
    random_generator: np.random.Generator,
    max_walks_per_stage: int = MAX_WALKS_PER_STAGE,
) -> GaussianMixture | None:
    """Return a density of standardized slopes on which walks often fail in their last step.

    The nominal density of standardized slopes is the standard normal density. The returned mixture
    includes it with the weight `nominal_walk_fraction`. The result is None if no walk fails.

    - `n_dimensions`: number of slopes per walk;
    - `max_walks_per_stage`: a smaller limit than that of the options.
    """
    n_walks = min(MAX_WALKS_PER_STAGE, max_walks_per_stage)
    n_inflation_test_walks = min(MAX_INFLATION_TEST_WALKS, n_walks)
    slope_inflation = 1.0
    while True:
        proposal_density = GaussianMixture.make_isotropic_gaussian(n_dimensions, slope_inflation)
        _, has_walk_failed = run_walks(
            proposal_density.draw_samples(n_inflation_test_walks, random_generator)
        )
        if np.mean(has_walk_failed) >= MIN_FAILURE_FRACTION:
            break
        slope_inflation *= SLOPE_INFLATION_FACTOR
        if slope_inflation > MAX_SLOPE_INFLATION:
            return None
    n_uninflated_fits = 0
    while n_uninflated_fits < N_UNINFLATED_FITS:
        slope_deviations = proposal_density.draw_samples(n_walks, random_generator)
        has_failed_in_last_step, _ = run_walks(slope_deviations)
        if not np.any(has_failed_in_last_step):
            return None
        failing_deviations = slope_deviations[has_failed_in_last_step]
        next_slope_inflation, failure_weights = _find_next_slope_inflation(
            failing_deviations,
            proposal_density.compute_log_density(failing_deviations),
            slope_inflation,
        )
        resampled_indices = random_generator.choice(
            len(failing_deviations), N_EM_SAMPLES, p=failure_weights
        )
        fitted_mixture = fit_gaussian_mixture(
            failing_deviations[resampled_indices], random_generator
        )
        wide_mixture = fitted_mixture._replace(
            covariance_cholesky_factors=WIDENING_FACTOR * fitted_mixture.covariance_cholesky_factors
        )
        fitted_mixture = fitted_mixture.add_mixture(wide_mixture, WIDE_WALK_FRACTION)
        n_uninflated_fits += slope_inflation == 1.0
        slope_inflation = next_slope_inflation
        proposal_density = fitted_mixture.add_mixture(
            GaussianMixture.make_isotropic_gaussian(n_dimensions, slope_inflation),
            NOMINAL_WALK_FRACTION,
        )
    return proposal_density


# Smallest effective number of failures at the next, smaller inflation, per dimension of the
# mixture. The value is chosen because each Gaussian in five dimensions has 20 parameters.
MIN_EFFECTIVE_FAILURES_PER_DIMENSION = 60.0


def _find_next_slope_inflation(
    failing_deviations: np.ndarray, log_proposal_density: np.ndarray, slope_inflation: float
) -> tuple[float, np.ndarray]:
    """Return the next inflation factor, and the normalized importance weights of the failures at
    that inflation.

    The next inflation is the smallest one at which the effective number of failures suffices.

    - `failing_deviations`: standardized slopes of failing walks, shape (failures, dimensions);
    - `log_proposal_density`: logarithm of the density from which these slopes were drawn, shape
      (failures,).
    """

    def compute_importance_weights(target_slope_inflation: float) -> np.ndarray:
        target_density = GaussianMixture.make_isotropic_gaussian(
            failing_deviations.shape[1], target_slope_inflation
        )
        log_weights = target_density.compute_log_density(failing_deviations) - log_proposal_density
        unnormalized_weights = np.exp(log_weights - np.max(log_weights))
        return unnormalized_weights / np.sum(unnormalized_weights)

    min_effective_samples = min(
        MIN_EFFECTIVE_FAILURES_PER_DIMENSION * failing_deviations.shape[1],
        0.3 * len(failing_deviations),
    )
    next_slope_inflation = slope_inflation
    while next_slope_inflation > 1.0:
        candidate_inflation = max(next_slope_inflation / 1.05, 1.0)
        n_effective_samples = 1.0 / np.sum(compute_importance_weights(candidate_inflation) ** 2)
        if n_effective_samples < min_effective_samples and next_slope_inflation < slope_inflation:
            break
        next_slope_inflation = candidate_inflation
    return next_slope_inflation, compute_importance_weights(next_slope_inflation)


class ExtinctGroupError(ValueError):
    """Error that is raised if all walkers of a group fail in the same step."""


class StepTransition(NamedTuple):
    """States of all walkers before and after the steps in which all legs have their turn.

    The states are those of `stack_states_and_ground`.
    """

    states_before_step: np.ndarray
    is_walker_alive: np.ndarray
    ground_deviations: np.ndarray  # of the slopes or heights on which the steps end
    states_after_step: np.ndarray
    step_distances: np.ndarray  # mean distance of each step along the mean slope, m
    n_stepped: np.ndarray  # number of completed steps


@dataclass
class WalkerGroups:
    """Groups of walkers (simulated wheels) on random slopes or heights, simulated as one batch.

    By the Markov property, the section state and the ground of a walker determine the distribution
    of later states. The ground is the slope of its line, or the heights of the two last footholds.
    For a walker of the user, it is the height of the last one.
    At first, the state of every walker is the section state of the gait. The number of walkers per
    group is rounded up to a power of two, because a digital net has such a number of points.
    """

    params: Any
    gait_state: np.ndarray
    ground_sd: float  # of slopes, rad, or of heights, m
    model: Any
    step_options: StepOptions
    n_walkers: int
    random: np.random.Generator
    n_groups: int = 32
    """Number of independent groups of walkers.

    The value is chosen because the quantile for 99 % of Student's distribution is then within 7 %
    of that of the normal distribution.
    """
    negligible_ground_line_effect: float = 0.01
    """Relative effect of a line's slope below which the slope is drawn without bias.

    A line joins two footholds. The effect is that on a later state, divided by that on the next
    state. The result has no bias for any value. The value is chosen because likelihood ratios are
    then similar.
    """
    min_forgetting_steps: int = 6
    """Smallest number of gait steps after which the effect of the start is considered to have
    decayed.
    """
    min_effective_failures: float = 100.0
    """Smallest effective number of sampled failures for which an error is estimated.

    The value is chosen because a few likelihood ratios dominate smaller samples. The spread of
    these ratios is then no estimate of the error.
    """
    sd_name: str = "slope_sd"  # or "height_sd"

    @property
    def has_heights(self) -> bool:
        """Return whether heights of footholds are random, instead of slopes."""
        return self.sd_name == "height_sd"

    @property
    def leg_period(self) -> int:
        """Return the number of steps after which the legs are in the same roles again.

        So many steps are one step of the survival operator.
        """
        return self.model.leg_period

    @property
    def n_continuous_entries(self) -> int:
        """Return the number of components of a section state that are no codes."""
        if not self.model.is_wheel:
            return len(self.gait_state)
        return int(self.model.count_continuous_section_entries(self.params))

    def __post_init__(self) -> None:
        self.n_walkers_per_group = 1 << (-(-self.n_walkers // self.n_groups) - 1).bit_length()
        self.n_walkers = self.n_groups * self.n_walkers_per_group
        self.n_steps = 0
        # total weight of walks that failed, by outcome and number of legs that had their turn
        self.weight_by_outcome: Any = collections.Counter()
        self.restart_at_gait()

    def run_walks(
        self, ground_deviations: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, StepBatchResult]:
        """Return whether walks fail in their last step, whether they fail, and their results.

        The walks begin at the current states of the walkers. Walk i begins at walker i modulo the
        number of walkers.

        - `ground_deviations`: standardized deviations of the slopes or heights on which the wheels
          land, shape (walks, lines).
        """
        walker_indices = np.arange(len(ground_deviations)) % self.n_walkers
        walk_results = self.run_walks_with_changes(
            self.params, self.states[walker_indices], self.ground[walker_indices], ground_deviations
        )
        has_failed = walk_results.outcome != Outcome.STEPPED
        self.n_steps += int(np.sum(walk_results.n_stepped) + np.sum(has_failed))
        is_in_last_step = walk_results.n_stepped >= ground_deviations.shape[1] - self.leg_period
        return has_failed & is_in_last_step, has_failed, walk_results

    def run_walks_with_changes(
        self,
        params: Any,
        section_states: np.ndarray,
        start_ground: np.ndarray,
        ground_deviations: np.ndarray,
    ) -> StepBatchResult:
        """Return the results of walks of the wheel `params` from given states on given ground."""
        ground = np.concatenate([start_ground, self.compute_ground(params, ground_deviations)], 1)
        heights = ground if self.has_heights else None
        if heights is None and not self.model.is_wheel:
            params = replace_tree_parameter(params, self.model.ground["slope"], ground[:, 1:])
        elif heights is None:
            params = eqx.tree_at(lambda wheel_on_lines: wheel_on_lines.slope, params, ground)
        return step_batch(
            params,
            section_states,
            ground_deviations.shape[1],
            model=self.model,
            options=self.step_options,
            heights=heights,
        )

    def compute_ground(self, params: Any, ground_deviations: np.ndarray) -> np.ndarray:
        """Return slopes (rad) or heights (m) for their standardized deviations."""
        mean = 0.0
        if not self.has_heights:
            name = "slope" if self.model.is_wheel else self.model.ground["slope"]
            mean = float(jax.tree.leaves(params)[find_tree_parameter(params, name)])
        return mean + self.ground_sd * ground_deviations

    def run_biased_walks(
        self, walk_density: GaussianMixture, slope_deviations: np.ndarray
    ) -> np.ndarray:
        """Return the failure weights of one walk from every walker, shape (walkers,).

        The weight of a walk is the likelihood ratio if the walk fails in its last step, and 0
        otherwise. The mean weight is the probability of a failure in the last step.

        - `walk_density`: density from which the slope deviations are drawn;
        - `slope_deviations`: standardized deviations of the slopes, shape (walkers, lines).
        """
        has_failed_in_last_step, _, walk_results = self.run_walks(slope_deviations)
        nominal_density = GaussianMixture.make_isotropic_gaussian(slope_deviations.shape[1], 1.0)
        likelihood_ratios = np.exp(
            nominal_density.compute_log_density(slope_deviations)
            - walk_density.compute_log_density(slope_deviations)
        )
        failure_importance_weights = np.where(has_failed_in_last_step, likelihood_ratios, 0.0)
        self.add_failure_weights(walk_results, failure_importance_weights)
        return failure_importance_weights

    def add_failure_weights(self, walk_results: StepBatchResult, walk_weights: np.ndarray) -> None:
        """Add the weights of failed walks to `weight_by_outcome`."""
        turns = walk_results.n_stepped % self.leg_period
        for turn in range(self.leg_period):
            weights = np.where(turns == turn, walk_weights, 0.0)
            for outcome_code in np.unique(walk_results.outcome[weights > 0.0]):
                outcome_weight = float(np.sum(weights[walk_results.outcome == outcome_code]))
                self.weight_by_outcome[int(outcome_code), turn] += outcome_weight

    def compute_mean_last_turn(self) -> float:
        """Return the mean number of steps without failure since the legs began their turns."""
        total = self.weight_by_outcome.total()
        turns = (turn * weight for (_, turn), weight in self.weight_by_outcome.items())
        return sum(turns) / total if total else 0.0

    def restart_at_gait(self) -> None:
        """Reset all walkers to the section state of the gait, on a line of the mean slope, or from
        the mean line to a foothold of random height.
        """
        self.states = np.tile(self.gait_state, (self.n_walkers, 1))
        start_deviations = np.zeros(
            (self.n_walkers, 1 + (self.has_heights and self.model.is_wheel))
        )
        if self.has_heights:
            start_deviations[:, -1] = self.random.standard_normal(self.n_walkers)
        self.ground = self.compute_ground(self.params, start_deviations)

    def stack_states_and_ground(self) -> np.ndarray:
        """Return section states with the ground as last components, shape (walkers, components)."""
        return np.concatenate([self.states, self.ground], 1)

    def compute_step_distances(self, states_after_step: np.ndarray) -> np.ndarray:
        """Return the distance of each step along the mean slope, m; NaN for a walker of the user.

        - `states_after_step`: as in `StepTransition`, shape (steps, components).
        """
        if not self.model.is_wheel:
            return np.full(len(states_after_step), np.nan)
        foot_distances = np.asarray(
            self.model.compute_foot_distance(
                self.params, jnp.asarray(states_after_step[:, : self.states.shape[1]].T)
            )
        )
        if self.has_heights:
            rises = states_after_step[:, -1] - states_after_step[:, -2]
            return np.sqrt(foot_distances**2 - rises**2)
        return foot_distances * np.cos(states_after_step[:, -1] - float(self.params.slope))

    def step_and_replace_failures(self) -> StepTransition:
        """Simulate one gait step of every walker, and replace walkers that fail by copies of
        survivors.

        Raise `ExtinctGroupError` if no walker of a group survived.
        """
        states_before_step = self.stack_states_and_ground()
        ground_deviations = self.random.standard_normal((self.n_walkers, self.leg_period))
        _, has_failed, walk_results = self.run_walks(ground_deviations)
        self.add_failure_weights(walk_results, has_failed.astype(float))
        step_distances = self.measure_step_distances(
            ground_deviations, walk_results.section_state, ~has_failed
        )
        source_indices = np.arange(self.n_walkers).reshape(self.n_groups, -1)
        for indices_of_group, has_walk_failed in zip(
            source_indices, has_failed.reshape(source_indices.shape), strict=True
        ):
            if np.all(has_walk_failed):
                raise ExtinctGroupError
            indices_of_group[has_walk_failed] = self.random.choice(
                indices_of_group[~has_walk_failed], np.sum(has_walk_failed)
            )
        self.states = walk_results.section_state[source_indices.ravel()]
        ground = np.concatenate(
            [self.ground, self.compute_ground(self.params, ground_deviations)], 1
        )
        self.ground = ground[source_indices.ravel(), self.leg_period :]
        return StepTransition(
            states_before_step,
            ~has_failed,
            ground_deviations,
            self.stack_states_and_ground(),
            step_distances,
            walk_results.n_stepped,
        )

    def measure_step_distances(
        self, ground_deviations: np.ndarray, end_states: np.ndarray, is_alive: np.ndarray
    ) -> np.ndarray:
        """Return the mean distance of the steps of each walker, 0 for those that fail, m."""
        distances = np.zeros(len(is_alive))
        for k in range(1, self.leg_period + 1):
            # JAX compiles for each number of walkers, so that those that failed are included.
            states, deviations = end_states, ground_deviations[:, :k]
            if k < self.leg_period:
                walks = self.run_walks_with_changes(
                    self.params, *(x[is_alive] for x in (self.states, self.ground, deviations))
                )
                states = replace_rows(end_states, is_alive, walks.section_state)
            ground = np.concatenate([self.ground, self.compute_ground(self.params, deviations)], 1)
            with np.errstate(invalid="ignore"):
                walked = self.compute_step_distances(np.concatenate([states, ground], 1))
            distances += np.where(is_alive, walked, 0.0)
        return distances / self.leg_period

    def advance_without_counting(self, n_steps: int = 1) -> collections.Counter:
        """Advance all walkers by `n_steps` gait steps, and return their failures by outcome.

        The failures are not added to `weight_by_outcome`.
        """
        weight_by_outcome, self.weight_by_outcome = self.weight_by_outcome, collections.Counter()
        for _ in range(n_steps):
            self.step_and_replace_failures()
        n_failures, self.weight_by_outcome = self.weight_by_outcome, weight_by_outcome
        return n_failures
