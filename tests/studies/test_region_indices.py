"""Sobol' indices over a region of a box agree with those by quadrature."""

import numpy as np

from experiments.shared.region_indices import estimate_region_indices

LEAST_WIDTH, LARGEST_WIDTH = 0.2, 1.0
"""Half widths of the region |z| <= w(x) at the two ends of x, in units of pi."""
N_ROWS = 8192
FIRST_ORDER_ERRORS, TOTAL_ERRORS = (0.045, 0.025, 0.045), (0.005, 0.04, 0.008)
"""Four standard deviations of the estimates at this number of rows, over 20 other seeds."""


def compute_half_width(x: np.ndarray) -> np.ndarray:
    """Return the half width w(x) of the region in z, which grows linearly with x."""
    share = 0.5 * (1.0 + x / np.pi)
    return np.pi * (LEAST_WIDTH + (LARGEST_WIDTH - LEAST_WIDTH) * share)


def compute_ishigami(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    return np.sin(x) + 7.0 * np.sin(y) ** 2 + 0.1 * z**4 * np.sin(x)


def evaluate_in_region(points: np.ndarray) -> np.ndarray:
    """Return Ishigami's function of points in the unit cube, NaN outside the region."""
    x, y, z = np.pi * (2.0 * points.T - 1.0)
    return np.where(np.abs(z) <= compute_half_width(x), compute_ishigami(x, y, z), np.nan)[:, None]


def compute_reference_indices() -> np.ndarray:
    """Return first-order and total indices by Gauss-Legendre quadrature, shape (2, 3).

    Nodes are x and y in their ranges, and z = w(x) t; the density of (x, y, t) is w(x). For a given
    z the values of x lie above the inverse of w.
    """
    nodes, weights = np.polynomial.legendre.leggauss(60)
    x, wx = np.pi * nodes, weights / np.sum(weights)
    y, wy, t, wt = x, wx, nodes, wx
    width = compute_half_width(x)
    density = wx * width / np.sum(wx * width)
    values = compute_ishigami(
        x[:, None, None], y[None, :, None], width[:, None, None] * t[None, None, :]
    )
    weight = density[:, None, None] * wy[None, :, None] * wt[None, None, :]
    mean, square = np.sum(weight * values), np.sum(weight * values**2)
    variance = square - mean**2
    mean_given_x = np.einsum("y,t,xyt->x", wy, wt, values)
    mean_given_y = np.einsum("x,t,xyt->y", density, wt, values)
    first_x = np.sum(density * mean_given_x**2) - mean**2
    first_y = np.sum(wy * mean_given_y**2) - mean**2
    # Variance that remains if all but one parameter are fixed: y, and z = w(x) t, are independent
    # of each other at a fixed x.
    total_y = np.einsum("x,t,xt->", density, wt, np.einsum("y,xyt->xt", wy, values**2)) - np.einsum(
        "x,t,xt->", density, wt, np.einsum("y,xyt->xt", wy, values) ** 2
    )
    total_z = np.einsum("x,y,xy->", density, wy, np.einsum("t,xyt->xy", wt, values**2)) - np.einsum(
        "x,y,xy->", density, wy, np.einsum("t,xyt->xy", wt, values) ** 2
    )
    # Slices of fixed z, in two intervals that meet where w(x) has its least value.
    first_z = total_x = 0.0
    for lower, upper in ((0.0, LEAST_WIDTH), (LEAST_WIDTH, LARGEST_WIDTH)):
        z = 0.5 * np.pi * (lower + upper + (upper - lower) * nodes)
        least_x = np.pi * (
            2.0 * (z / np.pi - LEAST_WIDTH) / (LARGEST_WIDTH - LEAST_WIDTH) - 1.0
        ).clip(-1.0)
        length = np.pi - least_x
        x_in_slice = least_x[:, None] + 0.5 * length[:, None] * (1.0 + nodes)
        z_density = wx * (upper - lower) * length
        z_density /= 2.0 * np.sum(wx * width)
        slices = compute_ishigami(x_in_slice[:, None, :], y[None, :, None], z[:, None, None])
        mean_of_slice = np.einsum("zyx,x->zy", slices, wx)
        mean_given_z = mean_of_slice @ wy
        first_z += np.sum(z_density * mean_given_z**2)
        square_of_slice = np.einsum("zyx,x->zy", slices**2, wx)
        total_x += np.sum(z_density[:, None] * wy * (square_of_slice - mean_of_slice**2))
    return np.array([[first_x, first_y, first_z - mean**2], [total_x, total_y, total_z]]) / variance


def test_indices_over_a_region_of_ishigamis_function_equal_those_by_quadrature() -> None:
    indices = estimate_region_indices(evaluate_in_region, 3, N_ROWS, np.random.default_rng(0))
    reference = compute_reference_indices()
    for estimate, expected, errors in (
        (indices.first_order, reference[0], FIRST_ORDER_ERRORS),
        (indices.total, reference[1], TOTAL_ERRORS),
    ):
        assert np.all(np.abs(estimate[:, 0] - expected) <= errors)
    region_share = 0.5 * (LEAST_WIDTH + LARGEST_WIDTH)
    np.testing.assert_allclose(indices.region_share, region_share, atol=0.02)


def test_omitted_pairs_bias_the_indices_of_a_region() -> None:
    """The total indices of x and z differ from the reference although the rows are 50 times as
    many, because a pair with a point outside the region does not count."""
    random = np.random.default_rng(0)
    points = random.random((50 * N_ROWS, 3))
    for i in (0, 2):
        partners = points.copy()
        partners[:, i] = random.random(len(points))
        values, partner_values = evaluate_in_region(points), evaluate_in_region(partners)
        is_kept = np.isfinite(values + partner_values)
        half_squared_change = 0.5 * np.mean((values - partner_values)[is_kept] ** 2)
        total = half_squared_change / np.nanvar(values)
        assert abs(total - compute_reference_indices()[1, i]) > TOTAL_ERRORS[i]


def test_indices_of_a_whole_box_are_those_of_independent_parameters() -> None:
    """A sum of independent terms: each index is the share of the term's variance."""
    evaluate = lambda points: (points @ np.array([2.0, 1.0, 0.0]))[:, None]
    indices = estimate_region_indices(evaluate, 3, 2048, np.random.default_rng(1))
    for estimate in (indices.first_order, indices.total):
        np.testing.assert_allclose(estimate[:, 0], [0.8, 0.2, 0.0], atol=0.06)  # 2,048 rows
    assert indices.region_share == 1.0
