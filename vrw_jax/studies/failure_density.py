"""Gaussian mixtures that are fitted to rare failures of walks, for importance sampling.

The method is the cross-entropy method (Rubinstein and Kroese 2004). At first the standard deviation
of the slopes is multiplied by an inflation factor, so that failures are frequent. A mixture is then
fitted to the failures, and the inflation decreases to 1 in stages.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from vrw_jax.lanes.batching import concatenate_tree_rows

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
    slope_deviations: np.ndarray,
    random_generator: np.random.Generator,
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
    failing_deviations: np.ndarray,
    log_proposal_density: np.ndarray,
    slope_inflation: float,
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
