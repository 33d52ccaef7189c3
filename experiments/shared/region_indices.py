"""Sobol' indices over a region of a box, for functions that have no value outside the region.

The parameters are uniformly distributed over the region, so that they depend on each other. The
indices are ratios of variances that remain defined for such parameters:

- the first-order index of x_i is Var(E[y | x_i]) / Var(y), the share of the variance that would
  vanish on average if x_i alone were fixed;
- the total index of x_i is E[Var(y | all but x_i)] / Var(y), the share that would remain on average
  if all other parameters were fixed.

For independent parameters these are the usual indices. For dependent parameters a first-order index
may exceed the total index, and the first-order indices may add up to more than 1.

Both variances are means over pairs of points that share some coordinates. The first point is
uniform over the region. The other coordinates of the second point are uniform over their slice of
the region: they are drawn again until the point lies in the region. Omitting pairs with a point
outside the region instead would weight each slice by its size, and the means would be biased.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

Evaluate = Callable[[np.ndarray], np.ndarray]
"""Function of points in the unit cube, shape (points, parameters), that returns values of shape
(points, values). The values of points outside the region are NaN."""


class RegionIndices(NamedTuple):
    """Sobol' indices over a region, shape (parameters, values), with 95 % bootstrap intervals."""

    first_order: np.ndarray
    first_order_bounds: np.ndarray  # (2, parameters, values)
    total: np.ndarray
    total_bounds: np.ndarray  # (2, parameters, values)
    region_share: float  # volume of the region, as a fraction of the cube
    n_evaluations: int


def estimate_region_indices(
    evaluate: Evaluate,
    n_parameters: int,
    n_rows: int,
    random: np.random.Generator,
    *,
    max_rounds: int = 2000,
    n_resamples: int = 400,
) -> RegionIndices:
    """Return the Sobol' indices of `evaluate` over its region.

    Args:
        evaluate: function to analyze.
        n_parameters: number of coordinates of a point.
        n_rows: number of independent first points; each has two partners per parameter.
        random: generator of the points.
        max_rounds: largest number of draws for one point.
        n_resamples: number of bootstrap resamples of the rows.

    Raises:
        RuntimeError: if some point has no partner in the region after `max_rounds` draws. Its pair
            is not omitted, because that would bias the indices.
    """
    sampler = _RegionSampler(evaluate, random, max_rounds)
    every_coordinate = np.ones((n_rows, n_parameters), bool)
    points, values = sampler.redraw(np.zeros((n_rows, n_parameters)), every_coordinate)
    region_share = n_rows / sampler.n_evaluations
    identity = np.eye(n_parameters, dtype=bool)
    # Partners for the total indices redraw one coordinate, and those for first-order indices keep
    # one. All partners are drawn together, so that few large batches are evaluated.
    redrawn = np.concatenate([identity, ~identity])
    partners = sampler.redraw(
        np.tile(points, (2 * n_parameters, 1)), np.repeat(redrawn, n_rows, axis=0)
    )[1].reshape(2, n_parameters, n_rows, -1)

    def compute_indices(rows: np.ndarray) -> np.ndarray:
        """Return first-order and total indices from these rows, shape (2, parameters, values)."""
        first, (total_partner, first_order_partner) = values[rows], partners[:, :, rows]
        # Every point is uniform over the region, so that all contribute to mean and variance.
        pooled = np.concatenate([first[None], total_partner, first_order_partner])
        mean, variance = pooled.mean((0, 1)), pooled.var((0, 1))
        covariance = ((first - mean) * (first_order_partner - mean)).mean(1)
        half_squared_change = 0.5 * ((first - total_partner) ** 2).mean(1)
        return np.stack([covariance, half_squared_change]) / variance

    estimate = compute_indices(np.arange(n_rows))
    resampled = [compute_indices(random.integers(0, n_rows, n_rows)) for _ in range(n_resamples)]
    bounds = np.quantile(resampled, (0.025, 0.975), axis=0)
    return RegionIndices(
        first_order=estimate[0],
        first_order_bounds=bounds[:, 0],
        total=estimate[1],
        total_bounds=bounds[:, 1],
        region_share=region_share,
        n_evaluations=sampler.n_evaluations,
    )


class _RegionSampler:
    """Sampler of points whose redrawn coordinates are uniform over their slice of the region."""

    def __init__(self, evaluate: Evaluate, random: np.random.Generator, max_rounds: int) -> None:
        self.evaluate, self.random, self.max_rounds = evaluate, random, max_rounds
        self.n_evaluations = 0

    def redraw(self, points: np.ndarray, is_redrawn: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return points in the region and their values; coordinates that are not `is_redrawn` are
        those of `points`."""
        points, values = points.copy(), np.empty((0, 0))
        pending = np.arange(len(points))
        for _ in range(self.max_rounds):
            fresh = self.random.random((len(pending), points.shape[1]))
            candidates = np.where(is_redrawn[pending], fresh, points[pending])
            candidate_values = self.evaluate(candidates)
            self.n_evaluations += len(pending)
            if not values.size:
                values = np.empty((len(points), candidate_values.shape[1]))
            is_inside = np.isfinite(candidate_values).all(1)
            points[pending[is_inside]] = candidates[is_inside]
            values[pending[is_inside]] = candidate_values[is_inside]
            pending = pending[~is_inside]
            if not len(pending):
                return points, values
        raise RuntimeError(
            f"{len(pending)} of {len(points)} points have no partner in the region after "
            f"{self.max_rounds} draws: allow more rounds."
        )
