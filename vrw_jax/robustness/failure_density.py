"""Gaussian mixtures that are fitted to rare failures of walks, for importance sampling.

The method is the cross-entropy method (Rubinstein and Kroese 2004). At first the standard deviation
of the slopes is multiplied by an inflation factor, so that failures are frequent. A mixture is then
fitted to the failures, and the inflation decreases to 1 in stages.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

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


@dataclass(frozen=True)
class FailureDensityOptions:
    """Numerical options for fitting a Gaussian mixture to the slopes of failing walks."""

    max_walks_per_stage: int = 4096
    """Largest number of walks per stage.

    The value is chosen because the variance of the likelihood ratios is hardly smaller with more
    walks."""
    n_gaussians: int = 4
    """Number of Gaussians in a mixture.

    The value is chosen because the paper's wheel fails in two ways, each in a curved region of
    slopes."""
    nominal_walk_fraction: float = 0.1
    """Fraction of walks whose slopes are drawn from the nominal density.

    The inverse of the fraction bounds all likelihood ratios. The nominal walks also find frequent
    failures that the fit missed.
    """
    wide_walk_fraction: float = 0.2
    """Fraction of walks whose slopes are drawn from the fitted Gaussians with wider standard
    deviations.

    The wide Gaussians bound the likelihood ratios of failures outside the fitted ones.
    """
    widening_factor: float = 1.7
    """Ratio of the standard deviations of the wide Gaussians to those of the fitted Gaussians."""
    n_uninflated_fits: int = 2
    """Number of fits with the nominal standard deviation of the slopes.

    The value is chosen because the second fit uses failures of walks that the first fit proposes.
    """
    max_inflation_test_walks: int = 256
    """Largest number of walks with which an inflation factor of the slopes is tested.

    The value is chosen because the standard error of the fraction of failing walks is then 0.02.
    """
    min_failure_fraction: float = 0.15
    """Smallest fraction of failing walks at which the inflation of the slopes is not increased
    further.

    The value is chosen because about a third of the failing walks fail in their last step.
    """
    slope_inflation_factor: float = 1.3
    """Ratio of successive inflation factors of the slopes' standard deviation."""
    max_slope_inflation: float = 20.0
    """Largest inflation factor of the slopes' standard deviation.

    The value is chosen because failures that need a larger inflation have probabilities below
    1e-80.
    """
    min_effective_failures_per_dimension: float = 60.0
    """Smallest effective number of failures at the next, smaller inflation, per dimension of the
    mixture.

    The value is chosen because each Gaussian in five dimensions has 20 parameters.
    """
    min_gaussian_variance: float = 0.02
    """Variance that is added to each fitted Gaussian in every direction.

    The variance bounds the likelihood ratios if only few walks fail.
    """
    n_em_iterations: int = 12
    """Number of iterations of expectation maximization.

    The value is chosen because the variance of the likelihood ratios is hardly smaller with 25
    iterations."""
    n_em_samples: int = 2000
    """Number of failures that are resampled by weight for each fit."""


FAILURE_DENSITY_OPTIONS = FailureDensityOptions()


@dataclass(frozen=True)
class GaussianMixture:
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
        return GaussianMixture(
            np.concatenate(
                [
                    (1.0 - added_mixture_weight) * self.gaussian_weights,
                    added_mixture_weight * added_mixture.gaussian_weights,
                ]
            ),
            np.concatenate([self.gaussian_means, added_mixture.gaussian_means]),
            np.concatenate(
                [self.covariance_cholesky_factors, added_mixture.covariance_cholesky_factors]
            ),
        )

    def widen_gaussians(self, standard_deviation_factor: float) -> "GaussianMixture":
        """Return the mixture with all standard deviations multiplied by
        `standard_deviation_factor`."""
        return GaussianMixture(
            self.gaussian_weights,
            self.gaussian_means,
            standard_deviation_factor * self.covariance_cholesky_factors,
        )

    def compute_gaussian_log_densities(self, slope_deviations: np.ndarray) -> np.ndarray:
        """Return the logarithm of each Gaussian's density times its weight, shape (components,
        samples).
        """
        gaussian_log_densities = []
        for gaussian_weight, gaussian_mean, covariance_cholesky_factor in zip(
            self.gaussian_weights,
            self.gaussian_means,
            self.covariance_cholesky_factors,
            strict=True,
        ):
            whitened_deviations = np.linalg.solve(
                covariance_cholesky_factor, (slope_deviations - gaussian_mean).T
            )
            log_cholesky_determinant = np.sum(np.log(np.diag(covariance_cholesky_factor)))
            log_normalization = (
                np.log(gaussian_weight)
                - log_cholesky_determinant
                - 0.5 * len(gaussian_mean) * np.log(2.0 * np.pi)
            )
            gaussian_log_densities.append(
                log_normalization - 0.5 * np.sum(whitened_deviations**2, 0)
            )
        return np.stack(gaussian_log_densities)

    def compute_log_density(self, slope_deviations: np.ndarray) -> np.ndarray:
        """Return the logarithm of the mixture's density at each sample, shape (samples,)."""
        gaussian_log_densities: np.ndarray = np.logaddexp.reduce(
            self.compute_gaussian_log_densities(slope_deviations), 0
        )
        return gaussian_log_densities

    def draw_samples(self, n_samples: int, random_generator: np.random.Generator) -> np.ndarray:
        """Return independent samples from the mixture, shape (samples, dimensions)."""
        return self.map_uniform_numbers(
            random_generator.random((n_samples, 1 + self.gaussian_means.shape[1]))
        )

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
        for gaussian_index, covariance_cholesky_factor in enumerate(
            self.covariance_cholesky_factors
        ):
            is_sample_from_gaussian = gaussian_indices == gaussian_index
            slope_deviations[is_sample_from_gaussian] += (
                normal_samples[is_sample_from_gaussian] @ covariance_cholesky_factor.T
            )
        return slope_deviations


def fit_gaussian_mixture(
    slope_deviations: np.ndarray,
    random_generator: np.random.Generator,
    density_options: FailureDensityOptions,
) -> GaussianMixture:
    """Return a Gaussian mixture, fitted to samples by expectation maximization.

    The initial means are samples far from each other (Arthur and Vassilvitskii 2007).

    - `slope_deviations`: samples, shape (samples, dimensions).
    """
    n_samples, n_dimensions = slope_deviations.shape
    covariance_floor = density_options.min_gaussian_variance * np.eye(n_dimensions)
    gaussian_means = slope_deviations[random_generator.integers(n_samples)][None]
    for _ in range(density_options.n_gaussians - 1):
        squared_distances_to_means = np.min(
            np.sum((slope_deviations[:, None] - gaussian_means) ** 2, -1), 1
        )
        total_squared_distance = np.sum(squared_distances_to_means)
        mean_selection_probabilities = (
            squared_distances_to_means / total_squared_distance
            if total_squared_distance > 0.0
            else None
        )
        gaussian_means = np.concatenate(
            [
                gaussian_means,
                slope_deviations[
                    random_generator.choice(n_samples, p=mean_selection_probabilities)
                ][None],
            ]
        )
    weighted_covariance = (
        np.cov(slope_deviations.T).reshape(n_dimensions, n_dimensions) + covariance_floor
    )
    cholesky_factors = np.tile(np.linalg.cholesky(weighted_covariance), (len(gaussian_means), 1, 1))
    gaussian_mixture = GaussianMixture(
        np.full(len(gaussian_means), 1.0 / len(gaussian_means)), gaussian_means, cholesky_factors
    )
    for _ in range(density_options.n_em_iterations):
        gaussian_log_densities = gaussian_mixture.compute_gaussian_log_densities(slope_deviations)
        membership_probabilities = np.exp(
            gaussian_log_densities - np.logaddexp.reduce(gaussian_log_densities, 0)
        )
        # The additional sample prevents an empty Gaussian.
        effective_gaussian_sizes = np.sum(membership_probabilities, 1) + 1.0
        gaussian_means = (
            membership_probabilities @ slope_deviations + gaussian_mixture.gaussian_means
        ) / effective_gaussian_sizes[:, None]
        cholesky_factors = np.empty_like(gaussian_mixture.covariance_cholesky_factors)
        for gaussian_index, (gaussian_membership, gaussian_mean) in enumerate(
            zip(membership_probabilities, gaussian_means, strict=True)
        ):
            centered_slope_deviations = slope_deviations - gaussian_mean
            weighted_covariance = (
                gaussian_membership * centered_slope_deviations.T
            ) @ centered_slope_deviations / effective_gaussian_sizes[
                gaussian_index
            ] + covariance_floor
            cholesky_factors[gaussian_index] = np.linalg.cholesky(weighted_covariance)
        gaussian_mixture = GaussianMixture(
            effective_gaussian_sizes / np.sum(effective_gaussian_sizes),
            gaussian_means,
            cholesky_factors,
        )
    return gaussian_mixture


def fit_failure_density(
    run_walks: DeviationWalkFunction,
    n_dimensions: int,
    random_generator: np.random.Generator,
    density_options: FailureDensityOptions = FAILURE_DENSITY_OPTIONS,
) -> GaussianMixture | None:
    """Return a density of standardized slopes on which walks often fail in their last step.

    The nominal density of standardized slopes is the standard normal density. The returned mixture
    includes it with the weight `nominal_walk_fraction`. The result is None if no walk fails.

    - `n_dimensions`: number of slopes per walk.
    """
    nominal_density = GaussianMixture.make_isotropic_gaussian(n_dimensions, 1.0)
    n_inflation_test_walks = min(
        density_options.max_inflation_test_walks, density_options.max_walks_per_stage
    )
    slope_inflation = 1.0
    while True:
        proposal_density = GaussianMixture.make_isotropic_gaussian(n_dimensions, slope_inflation)
        _, has_walk_failed = run_walks(
            proposal_density.draw_samples(n_inflation_test_walks, random_generator)
        )
        if np.mean(has_walk_failed) >= density_options.min_failure_fraction:
            break
        slope_inflation *= density_options.slope_inflation_factor
        if slope_inflation > density_options.max_slope_inflation:
            return None
    n_finished_fits = 0
    while True:
        slope_deviations = proposal_density.draw_samples(
            density_options.max_walks_per_stage, random_generator
        )
        has_failed_in_last_step, _ = run_walks(slope_deviations)
        if not np.any(has_failed_in_last_step):
            return None
        failing_deviations = slope_deviations[has_failed_in_last_step]
        log_proposal_density = proposal_density.compute_log_density(failing_deviations)
        next_slope_inflation, failure_importance_weights = _find_next_slope_inflation(
            failing_deviations, log_proposal_density, slope_inflation, density_options
        )
        resampled_failure_indices = random_generator.choice(
            len(failing_deviations), density_options.n_em_samples, p=failure_importance_weights
        )
        fitted_mixture = fit_gaussian_mixture(
            failing_deviations[resampled_failure_indices], random_generator, density_options
        )
        widened_mixture = fitted_mixture.widen_gaussians(density_options.widening_factor)
        fitted_mixture = fitted_mixture.add_mixture(
            widened_mixture, density_options.wide_walk_fraction
        )
        n_finished_fits += slope_inflation == 1.0
        if n_finished_fits == density_options.n_uninflated_fits:
            return fitted_mixture.add_mixture(
                nominal_density, density_options.nominal_walk_fraction
            )
        slope_inflation = next_slope_inflation
        proposal_density = fitted_mixture.add_mixture(
            GaussianMixture.make_isotropic_gaussian(n_dimensions, slope_inflation),
            density_options.nominal_walk_fraction,
        )


def _find_next_slope_inflation(
    failing_deviations: np.ndarray,
    log_proposal_density: np.ndarray,
    slope_inflation: float,
    density_options: FailureDensityOptions,
) -> tuple[float, np.ndarray]:
    """Return the next inflation factor, and the normalized importance weights of the failures at
    that inflation.

    The next inflation is the smallest one at which the effective number of failures suffices.

    - `failing_deviations`: standardized slopes of failing walks, shape (failures, dimensions);
    - `log_proposal_density`: logarithm of the density from which these slopes were drawn, shape
      (failures,).
    """

    def compute_importance_weights(target_slope_inflation: float) -> np.ndarray:
        log_target_density = GaussianMixture.make_isotropic_gaussian(
            failing_deviations.shape[1], target_slope_inflation
        ).compute_log_density(failing_deviations)
        log_importance_weights = log_target_density - log_proposal_density
        unnormalized_importance_weights = np.exp(
            log_importance_weights - np.max(log_importance_weights)
        )
        normalized_importance_weights: np.ndarray = unnormalized_importance_weights / np.sum(
            unnormalized_importance_weights
        )
        return normalized_importance_weights

    min_effective_samples = min(
        density_options.min_effective_failures_per_dimension * failing_deviations.shape[1],
        0.3 * len(failing_deviations),
    )
    has_enough_effective_samples = lambda failure_importance_weights: (
        1.0 / np.sum(failure_importance_weights**2) >= min_effective_samples
    )
    next_slope_inflation = slope_inflation
    while next_slope_inflation > 1.0:
        candidate_slope_inflation = max(next_slope_inflation / 1.05, 1.0)
        if (
            not has_enough_effective_samples(compute_importance_weights(candidate_slope_inflation))
            and next_slope_inflation < slope_inflation
        ):
            break
        next_slope_inflation = candidate_slope_inflation
    return next_slope_inflation, compute_importance_weights(next_slope_inflation)
