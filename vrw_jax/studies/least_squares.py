"""Least squares within bounds by the method of Levenberg and Marquardt, for a batch of fits.

A compiled program evaluates the residuals of all fits that still run. The small matrices of each
fit are of NumPy, so that the program depends on no detail of the method.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from vrw_jax.lanes.batching import replace_rows, select_tree_rows

MAX_ITERATIONS = 64
NEGLIGIBLE_REDUCTION = 1e-6
"""Predicted decrease of chi2 at which a fit ends: a distance of 1e-3 standard errors."""
FIRST_DAMPING = 1e-3
"""Damping of the first change, relative to the diagonal of the Hessian."""
MIN_DAMPING = 1e-8
"""Smallest damping. It limits changes of unknowns about which the data contain no information. Such
changes are only errors of derivatives."""
MAX_DAMPING = 1e10
HESSIAN_ROUND_OFF = 1e-12
"""Error of a Hessian whose diagonal is 1, below which its eigenvalues are unknown."""


class FitPoint(NamedTuple):
    """Unknowns of a batch of fits, and what was computed from them.

    - `unknowns`: shape (batch, n);
    - `residuals`: in standard errors, infinite where there is no prediction, shape (batch, m);
    - `jacobian`: their derivatives by the unknowns, shape (batch, m, n);
    - `prediction`: tree of further arrays with the axis of the batch first.
    """

    unknowns: Any
    residuals: Any
    jacobian: Any
    prediction: Any

    @property
    def chi2(self) -> Any:
        """Return the sum of squared residuals of each fit."""
        return np.sum(self.residuals**2, -1)


def propose_unknowns(
    point: FitPoint, lower: np.ndarray, upper: np.ndarray, is_fixed: Any, damping: Any
) -> tuple[np.ndarray, np.ndarray]:
    """Return the minimum of the linearized residuals within bounds, and the decrease of chi2 there.

    - `is_fixed`: which unknowns keep their values;
    - `damping`: one number for each fit, which shortens its change.
    """
    x, jacobian = point.unknowns, point.jacobian
    first_residuals = np.where(np.isfinite(point.residuals), point.residuals, 0.0)
    sizes = np.linalg.norm(jacobian, axis=1)
    sizes = np.where(sizes > 0.0, sizes, 1.0)
    columns = jacobian / sizes[:, None, :]
    damping_matrix = (np.reshape(damping, (-1, 1, 1)) + HESSIAN_ROUND_OFF) * np.eye(x.shape[-1])
    # On a bound, an unknown rests if chi2 would decrease only beyond it.
    slopes = np.einsum("bmn,bm->bn", jacobian, first_residuals)
    rests = is_fixed | (x <= lower) & (slopes > 0.0) | (x >= upper) & (slopes < 0.0)
    residuals, proposed, is_done = first_residuals, x, np.zeros((len(x), 1), bool)
    for _ in range(x.shape[-1]):
        moving = np.where(rests[:, None, :], 0.0, columns)
        transposed = np.swapaxes(moving, -1, -2)
        hessian, gradient = transposed @ moving + damping_matrix, transposed @ residuals[..., None]
        steps = -np.linalg.solve(hessian, gradient)[..., 0]
        changes = np.where(rests | is_done, 0.0, steps / sizes)
        # An unknown that reaches a bound stays there, and the others move on.
        bounds = np.where(changes > 0.0, upper, lower)
        room = bounds - proposed
        shares = np.where(changes != 0.0, room / np.where(changes != 0.0, changes, 1.0), np.inf)
        share = np.minimum(shares.min(-1, keepdims=True), 1.0)
        has_reached = (shares <= share) & (share < 1.0)
        proposed = np.where(has_reached, bounds, np.clip(proposed + share * changes, lower, upper))
        residuals = first_residuals + np.einsum("bmn,bn->bm", jacobian, proposed - x)
        is_done |= share == 1.0
        if is_done.all():
            break
        rests = rests | has_reached
    return proposed, np.sum(first_residuals**2 - residuals**2, -1)


def minimize_squares(
    evaluate: Callable[[np.ndarray, np.ndarray], FitPoint],
    starts: np.ndarray,
    lower: np.ndarray,
    upper: np.ndarray,
    is_fixed: Any = False,
) -> FitPoint:
    """Return the minimum of chi2 that each fit of a batch reaches from its start.

    - `evaluate`: function of the indices of fits, and of their unknowns;
    - `starts`: shape (batch, n); the arrays `lower`, `upper` and `is_fixed` have the shape (n,).
    """
    running = np.arange(len(starts))
    point = evaluate(running, np.clip(starts, lower, upper))
    damping, growth = np.full(len(starts), FIRST_DAMPING), np.full(len(starts), 2.0)
    for _ in range(MAX_ITERATIONS):
        current = select_tree_rows(point, running)
        proposed, decrease = propose_unknowns(current, lower, upper, is_fixed, damping[running])
        trial = evaluate(running, proposed)
        is_better = trial.chi2 < current.chi2
        point = replace_rows(point, running[is_better], select_tree_rows(trial, is_better))
        # Nielsen's rule: the damping follows the ratio of the actual to the predicted decrease.
        with np.errstate(invalid="ignore", divide="ignore"):  # Missing predictions are infinite.
            ratio = np.clip((current.chi2 - trial.chi2) / decrease, 0.0, 1e3)
        factor = np.where(
            is_better, np.maximum(1.0 - (2.0 * ratio - 1.0) ** 3, 1.0 / 3.0), growth[running]
        )
        damping[running] = np.clip(damping[running] * factor, MIN_DAMPING, MAX_DAMPING)
        growth[running] = np.where(is_better, 2.0, 2.0 * growth[running])
        running = running[decrease > NEGLIGIBLE_REDUCTION]
        if not running.size:
            break
    return point
