"""Floquet multipliers of small maps: closed forms, derivatives, and equal multipliers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vrw_jax.base import small_matrices

RANDOM_GENERATOR = np.random.default_rng(3)


@pytest.mark.parametrize("size", [1, 2, 3])
def test_eigenvalues_agree_with_lapack(size):
    matrices = RANDOM_GENERATOR.normal(size=(400, size, size))
    eigenvalues = np.asarray(small_matrices.floquet_multipliers(jnp.asarray(matrices)))
    for computed_eigenvalues, expected in zip(
        eigenvalues, np.linalg.eigvals(matrices), strict=True
    ):
        gap = np.abs(computed_eigenvalues[:, None] - expected[None])
        assert gap.min(0).max() < 1e-10
        assert gap.min(1).max() < 1e-10
    radius = np.abs(np.linalg.eigvals(matrices)).max(1)
    np.testing.assert_allclose(
        small_matrices.compute_spectral_radius(jnp.asarray(matrices)), radius, rtol=1e-11
    )


@pytest.mark.parametrize("size", [2, 3])
def test_radius_differentiates_like_left_and_right_eigenvectors(size):
    for matrix in RANDOM_GENERATOR.normal(size=(20, size, size)):
        values, right = np.linalg.eig(matrix)
        left_eigenvectors = np.linalg.inv(right)
        k = np.argmax(np.abs(values))
        derivative = np.outer(left_eigenvectors[k], right[:, k])  # d value / d matrix
        expected = np.real(np.conj(values[k]) * derivative) / np.abs(values[k])
        solution = jax.grad(small_matrices.compute_spectral_radius)(jnp.asarray(matrix))
        np.testing.assert_allclose(solution, expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("size", [1, 2, 3])
def test_margins_are_positive_exactly_inside_the_circle(size):
    matrices = RANDOM_GENERATOR.normal(size=(2000, size, size)) * 0.8
    stable = np.abs(np.linalg.eigvals(matrices)).max(1) < 1.0
    margins = np.asarray(small_matrices.compute_jury_margins(jnp.asarray(matrices)))
    np.testing.assert_array_equal(np.all(margins > 0.0, axis=-1), stable)
    smooth = np.asarray(small_matrices.compute_stability_margin(jnp.asarray(matrices)))
    assert np.all(smooth <= margins.min(-1) + 1e-14)
    assert np.all(smooth >= margins.min(-1) - np.log(4.0) / small_matrices.SMOOTH_MIN_SHARPNESS)


def test_the_margin_is_differentiable_at_equal_eigenvalues():
    defective = jnp.array([[0.5, 1.0], [0.0, 0.5]])
    assert bool(small_matrices.has_double_multiplier(defective))
    assert not bool(small_matrices.has_double_multiplier(jnp.diag(jnp.array([0.5, 0.4]))))
    # Only the two largest moduli count, in any basis.
    bases = np.random.default_rng(0).normal(size=(50, 3, 3))
    for values, is_double in (((0.9, 0.1, 0.1), False), ((0.1, 0.9, -0.9), True)):
        matrices = bases @ np.diag(values) @ np.linalg.inv(bases)
        assert (small_matrices.has_double_multiplier(matrices, 1e-5) == is_double).all()
    gradient = jax.grad(small_matrices.compute_stability_margin)(defective)
    step = 1e-6
    direction = jnp.array([[0.3, -0.2], [0.7, 0.4]])
    slope = (
        small_matrices.compute_stability_margin(defective + step * direction)
        - small_matrices.compute_stability_margin(defective - step * direction)
    ) / (2 * step)
    np.testing.assert_allclose(jnp.sum(gradient * direction), slope, rtol=1e-7)
    assert np.all(np.isfinite(jax.grad(small_matrices.compute_spectral_radius)(defective)))


def test_rotation_by_a_right_angle_has_multipliers_plus_and_minus_i():
    solution = small_matrices.floquet_multipliers(jnp.array([[0.0, -1.0], [1.0, 0.0]]))
    np.testing.assert_allclose(sorted(np.asarray(solution).imag), [-1.0, 1.0])
    np.testing.assert_allclose(np.asarray(solution).real, 0.0, atol=1e-15)
