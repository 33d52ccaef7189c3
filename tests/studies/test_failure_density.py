"""Densities fitted to rare failures, against probabilities in closed form."""

import numpy as np
import pytest
from scipy.special import ndtr

from vrw_jax.studies.walker_groups import GaussianMixture, fit_failure_density

DIRECTION = np.array([0.1, 0.2, 0.3, 0.6, -0.2])
DIRECTION = DIRECTION / np.linalg.norm(DIRECTION)


def estimate_probability(fails, n_samples=40_000):
    """Return a region's probability by samples of the fitted density, and its standard error."""
    random, n = np.random.default_rng(0), len(DIRECTION)
    density = fit_failure_density(lambda e: (fails(e), fails(e)), n, random)
    deviations = density.draw_samples(n_samples, random)
    log_ratios = GaussianMixture.make_isotropic_gaussian(n, 1.0).compute_log_density(deviations)
    weights = np.exp(log_ratios - density.compute_log_density(deviations)) * fails(deviations)
    return np.mean(weights), np.std(weights) / np.sqrt(n_samples)


@pytest.mark.parametrize("distance", [1.0, 3.0, 6.0, 12.0])
def test_a_half_space_has_the_probability_of_the_normal_distribution(distance):
    probability, error = estimate_probability(lambda e: e @ DIRECTION > distance)
    assert error < 0.03 * probability
    assert abs(probability - ndtr(-distance)) < 3.0 * error


def test_two_opposite_regions_are_both_found():
    probability, error = estimate_probability(lambda e: np.abs(e @ DIRECTION) > 5.0)
    assert abs(probability - 2.0 * ndtr(-5.0)) < 3.0 * error
    assert error < 0.03 * probability


def test_a_region_without_failures_has_no_density():
    never = lambda e: (np.zeros(len(e), bool), np.zeros(len(e), bool))
    assert fit_failure_density(never, 3, np.random.default_rng(0)) is None
