"""Least squares within bounds, against SciPy."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from vrw_jax.studies.least_squares import FitPoint, minimize_squares

N_FITS, N_RESIDUALS = 150, 8


@pytest.mark.parametrize("n", [1, 2, 4])
def test_minima_within_bounds_are_those_of_scipy(n):
    """Many starts, and most minima, lie on bounds. Each fit has one minimum."""
    random = np.random.default_rng(n)
    factors = random.standard_normal((N_FITS, N_RESIDUALS, n))
    constants = random.standard_normal((N_FITS, N_RESIDUALS))
    lower, upper = -random.random(n), random.random(n)
    starts = np.clip(random.uniform(-2.0, 2.0, (N_FITS, n)), lower, upper)

    def evaluate(rows, x):
        residuals = np.einsum("bmn,bn->bm", factors[rows], x + 0.1 * x**3) + constants[rows]
        return FitPoint(x, residuals, factors[rows] * (1.0 + 0.3 * x**2)[:, None], ())

    fits = minimize_squares(evaluate, starts, lower, upper)
    for i in range(N_FITS):
        reference = least_squares(
            lambda x, i=i: evaluate([i], x[None]).residuals[0],
            0.5 * (lower + upper),
            bounds=(lower, upper),
            xtol=1e-14,
            ftol=1e-14,
            gtol=1e-14,
        )
        # A fit ends 1e-6 above the smallest chi2, and its last change then makes it more exact.
        assert fits.chi2[i] == pytest.approx(2.0 * reference.cost, abs=1e-9)
    for i in range(20):  # A fit does not depend on the others of its batch.
        alone = minimize_squares(
            lambda _, x, i=i: evaluate([i], x), starts[i : i + 1], lower, upper
        )
        np.testing.assert_allclose(fits.unknowns[i], alone.unknowns[0], atol=1e-13)  # round-off


def test_a_fixed_unknown_keeps_its_value_and_a_missing_prediction_its_start():
    """The reference is the mean of two numbers, of which one unknown is given."""
    targets = np.array([1.0, 3.0])

    def evaluate(rows, x):
        residuals = x[:, :1] + x[:, 1:] - targets
        is_valid = x[:, :1] < 10.0
        jacobian = np.where(is_valid[..., None], np.ones((len(x), 2, 2)), 0.0)
        return FitPoint(x, np.where(is_valid, residuals, np.inf), jacobian, ())

    starts, large = np.array([[0.5, 0.0], [20.0, 0.0]]), np.full(2, np.inf)
    fits = minimize_squares(evaluate, starts, -large, large, np.array([True, False]))
    np.testing.assert_allclose(fits.unknowns, [[0.5, 1.5], [20.0, 0.0]], atol=1e-9)
    np.testing.assert_allclose(fits.chi2, [2.0, np.inf])
