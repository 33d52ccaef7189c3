"""Gaussian mixtures fitted to rare failures, from which failing walks are drawn with known weights.

The fit is the cross-entropy method (Rubinstein and Kroese 2004). The standard deviation of the
slopes is inflated until failures are frequent. A mixture is then fitted to the failures, and the
inflation is lowered to 1 in stages.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

DeviationSampler = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
"""Function that runs one walk for each row of standardized slope deviations. It returns whether
each walk fails in its last step, and whether each walk fails in any step."""


@dataclass(frozen=True)
class DensityOptions:
    """Options of the fitted density."""

    n_samples: int = 6144
    """Largest number of walks of each stage. The value is chosen because fits to fewer walks vary
    by tens of per cent."""
    n_components: int = 4
    """Number of Gaussians. The value is chosen because the paper's wheel fails in two ways, and
    each failing region is curved."""
    nominal_fraction: float = 0.1
    """Fraction of walks that are drawn without bias. Its inverse bounds all weights. These walks
    also find failures that the fit missed, if such failures are frequent enough to matter."""
    wide_fraction: float = 0.2
    """Fraction of walks that are drawn from the fitted Gaussians with larger standard deviations.
    These walks bound the weights where the failures extend beyond the fit."""
    wide_factor: float = 1.7
    """Factor of these standard deviations."""
    n_refits: int = 2
    """Number of fits without inflation. The value is chosen because the second fit uses failures
    that the first one produces."""
    min_failure_fraction: float = 0.15
    """Fraction of failing walks at which the inflation is large enough. The value is chosen because
    about a third of failing walks fail in their last step."""
    inflation_factor: float = 1.3
    """Factor between successive inflations."""
    max_inflation: float = 20.0
    """Largest inflation. The value is chosen because rarer failures have probabilities below
    1e-80."""
    effective_samples_per_dimension: float = 60.0
    """Smallest effective number of failures at the next, smaller inflation, per dimension. The
    value is chosen because each Gaussian in five dimensions has 20 parameters."""
    covariance_floor: float = 0.02
    """Variance that is added in every direction. It bounds the weights if failures are few."""
    n_em_iterations: int = 25
    """Number of iterations of expectation maximization. The value is chosen because later
    iterations change the variance of the weights by less than 5 %."""
    n_em_samples: int = 2000
    """Number of failures that are drawn by weight for a fit."""


DENSITY_OPTIONS = DensityOptions()


@dataclass(frozen=True)
class GaussianMixture:
    """Mixture of Gaussians over standardized slope deviations."""

    component_weights: np.ndarray  # (components,), sum 1
    means: np.ndarray  # (components, dimensions)
    cholesky_factors: (
        np.ndarray
    )  # Cholesky factors of the covariances, (components, dimensions, dimensions)

    @classmethod
    def isotropic(cls, n_dimensions: int, scale: float) -> "GaussianMixture":
        """Return one Gaussian of mean zero with the same standard deviation `scale` in all
        directions.
        """
        return cls(np.ones(1), np.zeros((1, n_dimensions)), scale * np.eye(n_dimensions)[None])

    def with_component(self, other_mixture: "GaussianMixture", weight: float) -> "GaussianMixture":
        """Return the mixture of this mixture and another one, which has the total weight
        `weight`.
        """
        return GaussianMixture(
            np.concatenate(
                [(1.0 - weight) * self.component_weights, weight * other_mixture.component_weights]
            ),
            np.concatenate([self.means, other_mixture.means]),
            np.concatenate([self.cholesky_factors, other_mixture.cholesky_factors]),
        )

    def widen(self, factor: float) -> "GaussianMixture":
        """Return the mixture with standard deviations multiplied by `factor`."""
        return GaussianMixture(self.component_weights, self.means, factor * self.cholesky_factors)

    def compute_component_log_densities(self, deviations: np.ndarray) -> np.ndarray:
        """Return the logarithm of each component's weighted density, (components, samples)."""
        log_densities = []
        for component_weight, component_mean, cholesky_factor in zip(
            self.component_weights, self.means, self.cholesky_factors, strict=True
        ):
            whitened = np.linalg.solve(cholesky_factor, (deviations - component_mean).T)
            log_scale = np.sum(np.log(np.diag(cholesky_factor)))
            log_constant = (
                np.log(component_weight)
                - log_scale
                - 0.5 * len(component_mean) * np.log(2.0 * np.pi)
            )
            log_densities.append(log_constant - 0.5 * np.sum(whitened**2, 0))
        return np.stack(log_densities)

    def compute_log_density(self, deviations: np.ndarray) -> np.ndarray:
        """Return the logarithm of the density at each sample, (samples,)."""
        densities: np.ndarray = np.logaddexp.reduce(
            self.compute_component_log_densities(deviations), 0
        )
        return densities

    def draw_samples(self, n_samples: int, generator: np.random.Generator) -> np.ndarray:
        """Return independent samples, (samples, dimensions)."""
        component_index = generator.choice(
            len(self.component_weights), n_samples, p=self.component_weights
        )
        standard_normal = generator.standard_normal((n_samples, self.means.shape[1]))
        deviations = self.means[component_index]
        for member_index, cholesky_factor in enumerate(self.cholesky_factors):
            is_member = component_index == member_index
            deviations[is_member] += standard_normal[is_member] @ cholesky_factor.T
        return deviations


def fit_mixture(
    deviations: np.ndarray, generator: np.random.Generator, options: DensityOptions
) -> GaussianMixture:
    """Return a Gaussian mixture fitted to samples by expectation maximization.

    The initial means are samples far from each other (Arthur and Vassilvitskii 2007).

    - `deviations`: samples, (samples, dimensions).
    """
    n_samples, n_dimensions = deviations.shape
    covariance_floor = options.covariance_floor * np.eye(n_dimensions)
    means = deviations[generator.integers(n_samples)][None]
    for _ in range(options.n_components - 1):
        distances = np.min(np.sum((deviations[:, None] - means) ** 2, -1), 1)
        total_distance = np.sum(distances)
        selection_probabilities = distances / total_distance if total_distance > 0.0 else None
        means = np.concatenate(
            [means, deviations[generator.choice(n_samples, p=selection_probabilities)][None]]
        )
    covariance = np.cov(deviations.T).reshape(n_dimensions, n_dimensions) + covariance_floor
    cholesky_factors = np.tile(np.linalg.cholesky(covariance), (len(means), 1, 1))
    mixture = GaussianMixture(np.full(len(means), 1.0 / len(means)), means, cholesky_factors)
    for _ in range(options.n_em_iterations):
        log_densities = mixture.compute_component_log_densities(deviations)
        membership = np.exp(log_densities - np.logaddexp.reduce(log_densities, 0))
        component_counts = (
            np.sum(membership, 1) + 1.0
        )  # One more sample prevents an empty component.
        means = (membership @ deviations + mixture.means) / component_counts[:, None]
        cholesky_factors = np.empty_like(mixture.cholesky_factors)
        for component_index, (component_membership, component_mean) in enumerate(
            zip(membership, means, strict=True)
        ):
            centered = deviations - component_mean
            covariance = (component_membership * centered.T) @ centered / component_counts[
                component_index
            ] + covariance_floor
            cholesky_factors[component_index] = np.linalg.cholesky(covariance)
        mixture = GaussianMixture(
            component_counts / np.sum(component_counts), means, cholesky_factors
        )
    return mixture


def fit_failure_density(
    run_walks: DeviationSampler,
    n_dimensions: int,
    generator: np.random.Generator,
    options: DensityOptions = DENSITY_OPTIONS,
) -> GaussianMixture | None:
    """Return a density from which walks often fail in their last step; None if no walk failed.

    The density contains a fraction of the nominal density, which is standard normal.
    """
    nominal_density = GaussianMixture.isotropic(n_dimensions, 1.0)
    inflation = 1.0
    while True:
        density = GaussianMixture.isotropic(n_dimensions, inflation)
        deviations = density.draw_samples(options.n_samples, generator)
        has_failed_last, has_failed = run_walks(deviations)
        if np.mean(has_failed) >= options.min_failure_fraction:
            break
        inflation *= options.inflation_factor
        if inflation > options.max_inflation:
            return None
    n_refits = 0
    while True:
        if not np.any(has_failed_last):
            return None
        failing_deviations = deviations[has_failed_last]
        log_proposal_density = density.compute_log_density(failing_deviations)
        next_inflation, weights = _lower_inflation(
            failing_deviations, log_proposal_density, inflation, options
        )
        chosen_indices = generator.choice(len(failing_deviations), options.n_em_samples, p=weights)
        fitted_mixture = fit_mixture(failing_deviations[chosen_indices], generator, options)
        wide_mixture = fitted_mixture.widen(options.wide_factor)
        fitted_mixture = fitted_mixture.with_component(wide_mixture, options.wide_fraction)
        n_refits += inflation == 1.0
        if n_refits == options.n_refits:
            return fitted_mixture.with_component(nominal_density, options.nominal_fraction)
        inflation = next_inflation
        density = fitted_mixture.with_component(
            GaussianMixture.isotropic(n_dimensions, inflation), options.nominal_fraction
        )
        deviations = density.draw_samples(options.n_samples, generator)
        has_failed_last, _ = run_walks(deviations)


def _lower_inflation(
    failing_deviations: np.ndarray,
    log_proposal_density: np.ndarray,
    inflation: float,
    options: DensityOptions,
) -> tuple[float, np.ndarray]:
    """Return the smallest inflation at which enough failures have weight, and their weights
    there.
    """

    def compute_weights(inflation_of_target: float) -> np.ndarray:
        log_target_density = GaussianMixture.isotropic(
            failing_deviations.shape[1], inflation_of_target
        ).compute_log_density(failing_deviations)
        log_weights = log_target_density - log_proposal_density
        weights = np.exp(log_weights - np.max(log_weights))
        normalized_weights: np.ndarray = weights / np.sum(weights)
        return normalized_weights

    n_required = min(
        options.effective_samples_per_dimension * failing_deviations.shape[1],
        0.3 * len(failing_deviations),
    )
    has_enough_samples = lambda w: 1.0 / np.sum(w**2) >= n_required
    next_inflation = inflation
    while next_inflation > 1.0:
        candidate_inflation = max(next_inflation / 1.05, 1.0)
        if (
            not has_enough_samples(compute_weights(candidate_inflation))
            and next_inflation < inflation
        ):
            break
        next_inflation = candidate_inflation
    return next_inflation, compute_weights(next_inflation)
