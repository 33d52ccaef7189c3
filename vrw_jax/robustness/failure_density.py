"""Gaussian mixtures fitted to rare failures, from which failing walks are drawn with known weights.

The fit is the cross-entropy method (Rubinstein and Kroese 2004): the standard deviation is inflated
until failures are frequent, a mixture is fitted to the failures, and the inflation is lowered to 1.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

DeviationSampler = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
"""Function that runs one walk for each row of standardized deviations. It returns the walks that
fail in their last step, and those that fail in any step, as two arrays of bools."""


@dataclass(frozen=True)
class DensityOptions:
    """Numerical choices of the fitted density."""

    n_samples: int = 6144
    """Number of walks of each stage, chosen because fits to fewer vary by tens of per cent."""
    n_components: int = 4
    """Number of Gaussians, chosen because the paper's wheel fails in two ways, and each failing
    region is curved."""
    nominal_share: float = 0.1
    """Share of walks that are drawn without bias; it bounds all weights by its inverse, and finds
    failures that the fit missed if they are frequent enough to matter."""
    frequent_failure_share: float = 0.15
    """Share of failing walks at which the inflation is large enough, chosen because about a third
    of them fail in their last step."""
    inflation_factor: float = 1.3
    """Factor between inflations that are tried."""
    max_inflation: float = 100.0
    """Largest inflation, chosen because failures beyond have probabilities below the least
    number."""
    min_effective_samples: float = 300.0
    """Effective number of failures that the next, smaller inflation must have, chosen because each
    Gaussian in five dimensions has 20 numbers."""
    covariance_floor: float = 0.02
    """Variance added in every direction; it keeps weights bounded where failures are few."""
    n_em_iterations: int = 25
    """Number of iterations of expectation maximization, chosen because later ones change the
    variance of the weights by less than 5 %."""
    n_em_samples: int = 2000
    """Number of failures drawn by weight for a fit."""


DENSITY_OPTIONS = DensityOptions()


@dataclass(frozen=True)
class GaussianMixture:
    """Mixture of Gaussians over standardized deviations."""

    shares: np.ndarray  # (components,), sum 1
    means: np.ndarray  # (components, dimensions)
    factors: np.ndarray  # Cholesky factors of the covariances, (components, dimensions, dimensions)

    @classmethod
    def isotropic(cls, n_dimensions: int, scale: float) -> "GaussianMixture":
        """Return one Gaussian of mean zero with the same standard deviation in all directions."""
        return cls(np.ones(1), np.zeros((1, n_dimensions)), scale * np.eye(n_dimensions)[None])

    def with_component(self, other: "GaussianMixture", share: float) -> "GaussianMixture":
        """Return the mixture of this one with a share of another."""
        return GaussianMixture(
            np.concatenate([(1.0 - share) * self.shares, share * other.shares]),
            np.concatenate([self.means, other.means]),
            np.concatenate([self.factors, other.factors]),
        )

    def component_log_densities(self, deviations: np.ndarray) -> np.ndarray:
        """Return the logarithms of share times density, (components, samples)."""
        rows = []
        for share, mean, factor in zip(self.shares, self.means, self.factors, strict=True):
            whitened = np.linalg.solve(factor, (deviations - mean).T)
            log_scale = np.sum(np.log(np.diag(factor)))
            constant = np.log(share) - log_scale - 0.5 * len(mean) * np.log(2.0 * np.pi)
            rows.append(constant - 0.5 * np.sum(whitened**2, 0))
        return np.stack(rows)

    def log_density(self, deviations: np.ndarray) -> np.ndarray:
        """Return the logarithm of the density of each sample."""
        densities: np.ndarray = np.logaddexp.reduce(self.component_log_densities(deviations), 0)
        return densities

    def sample(self, n_samples: int, random: np.random.Generator) -> np.ndarray:
        """Return independent samples, (samples, dimensions)."""
        component = random.choice(len(self.shares), n_samples, p=self.shares)
        normal = random.standard_normal((n_samples, self.means.shape[1]))
        deviations = self.means[component]
        for index, factor in enumerate(self.factors):
            is_member = component == index
            deviations[is_member] += normal[is_member] @ factor.T
        return deviations


def fit_mixture(
    deviations: np.ndarray, random: np.random.Generator, options: DensityOptions
) -> GaussianMixture:
    """Return a Gaussian mixture fitted to samples by expectation maximization.

    The first means are samples far from each other (Arthur and Vassilvitskii 2007).
    """
    n_samples, n_dimensions = deviations.shape
    floor = options.covariance_floor * np.eye(n_dimensions)
    means = deviations[random.integers(n_samples)][None]
    for _ in range(options.n_components - 1):
        distances = np.min(np.sum((deviations[:, None] - means) ** 2, -1), 1)
        total = np.sum(distances)
        share = distances / total if total > 0.0 else None
        means = np.concatenate([means, deviations[random.choice(n_samples, p=share)][None]])
    covariance = np.cov(deviations.T).reshape(n_dimensions, n_dimensions) + floor
    factors = np.tile(np.linalg.cholesky(covariance), (len(means), 1, 1))
    mixture = GaussianMixture(np.full(len(means), 1.0 / len(means)), means, factors)
    for _ in range(options.n_em_iterations):
        log_densities = mixture.component_log_densities(deviations)
        members = np.exp(log_densities - np.logaddexp.reduce(log_densities, 0))
        counts = np.sum(members, 1) + 1.0  # one more keeps an empty component
        means = (members @ deviations + mixture.means) / counts[:, None]
        factors = np.empty_like(mixture.factors)
        for index, (member, mean) in enumerate(zip(members, means, strict=True)):
            centered = deviations - mean
            covariance = (member * centered.T) @ centered / counts[index] + floor
            factors[index] = np.linalg.cholesky(covariance)
        mixture = GaussianMixture(counts / np.sum(counts), means, factors)
    return mixture


def fit_failure_density(
    run_walks: DeviationSampler,
    n_dimensions: int,
    random: np.random.Generator,
    options: DensityOptions = DENSITY_OPTIONS,
) -> GaussianMixture | None:
    """Return a density from which walks fail often in their last step; None if none failed.

    It contains a share of the nominal density, the standard normal one.
    """
    nominal = GaussianMixture.isotropic(n_dimensions, 1.0)
    inflation = 1.0
    while True:
        density = GaussianMixture.isotropic(n_dimensions, inflation)
        deviations = density.sample(options.n_samples, random)
        fails_last, fails = run_walks(deviations)
        if np.mean(fails) >= options.frequent_failure_share:
            break
        inflation *= options.inflation_factor
        if inflation > options.max_inflation:
            return None
    while True:
        if not np.any(fails_last):
            return None
        failures = deviations[fails_last]
        log_proposal = density.log_density(failures)
        next_inflation, weights = _lower_inflation(failures, log_proposal, inflation, options)
        chosen = random.choice(len(failures), options.n_em_samples, p=weights)
        fitted = fit_mixture(failures[chosen], random, options)
        if inflation == 1.0:
            return fitted.with_component(nominal, options.nominal_share)
        inflation = next_inflation
        density = fitted.with_component(
            GaussianMixture.isotropic(n_dimensions, inflation), options.nominal_share
        )
        deviations = density.sample(options.n_samples, random)
        fails_last, _ = run_walks(deviations)


def _lower_inflation(
    failures: np.ndarray, log_proposal: np.ndarray, inflation: float, options: DensityOptions
) -> tuple[float, np.ndarray]:
    """Return the least inflation at which enough failures keep weight, and the weights there."""

    def weights_at(scale: float) -> np.ndarray:
        target = GaussianMixture.isotropic(failures.shape[1], scale).log_density(failures)
        log_weights = target - log_proposal
        weights = np.exp(log_weights - np.max(log_weights))
        normalized: np.ndarray = weights / np.sum(weights)
        return normalized

    has_enough = lambda w: 1.0 / np.sum(w**2) >= min(options.min_effective_samples, 0.3 * len(w))
    next_inflation = inflation
    while next_inflation > 1.0:
        candidate = max(next_inflation / 1.05, 1.0)
        if not has_enough(weights_at(candidate)) and next_inflation < inflation:
            break
        next_inflation = candidate
    return next_inflation, weights_at(next_inflation)
