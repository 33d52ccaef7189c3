"""Test functions of branches: quantities that vanish, jump or change their value at special points.

`BIFURCATIONS` is the table of the test functions that follow from the Jacobian of the return map.
Each kind of branch adds test functions for its other quantities, such as margins.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from vrw_jax.gaits.floquet import (
    LOCATED_PAIR_CIRCLE_DISTANCE,
    MAX_CLOSED_FORM_SIZE,
    MIN_IMAGINARY_PART,
    UNIT_CIRCLE_DISTANCE,
    list_jury_margins,
)


class TestFunction(NamedTuple):
    """What it means that a quantity of a branch vanishes or changes, and what follows.

    - `kind`: kind of the `SpecialPoint`;
    - `meaning`: what happens there;
    - `ends_branch`: whether the branch ends, because the order of events changes;
    - `is_stepwise`: whether the quantity has integer values, of which each change is located;
    - `explains`: kind of a change that is not reported where this quantity vanishes;
    - `n_multipliers`: number of multipliers that cross the unit circle.
    """

    kind: str
    meaning: str
    ends_branch: bool = False
    is_stepwise: bool = False
    explains: str = ""
    n_multipliers: int = 0


FOLD, BRANCH_POINT, PERIOD_DOUBLING, NEIMARK_SACKER = (
    "fold", "branch_point", "period_doubling", "neimark_sacker",
)  # fmt: skip
BIFURCATIONS: Mapping[str, TestFunction] = {
    FOLD: TestFunction(FOLD, "The branch turns back, or crosses another one.", n_multipliers=1),
    PERIOD_DOUBLING: TestFunction(
        PERIOD_DOUBLING, "A branch of twice the period begins.", n_multipliers=1
    ),
    NEIMARK_SACKER: TestFunction(
        NEIMARK_SACKER, "A closed curve of states begins.", n_multipliers=2
    ),
}
"""Bifurcations by name."""


def evaluate_bifurcations(jacobians: np.ndarray) -> dict[str, np.ndarray]:
    """Return the test functions of `BIFURCATIONS` by name, each of shape (...).

    They are det(1 - J), det(1 + J), and the product of 1 - z_i z_j over all pairs of multipliers.
    The last is NaN if there is no pair. Up to a size of 3, they are the first Jury margins.
    """
    n = jacobians.shape[-1]
    if n <= MAX_CLOSED_FORM_SIZE:
        margins = [*list_jury_margins(jacobians), np.full(jacobians.shape[:-2], np.nan)]
        return dict(zip(BIFURCATIONS, margins, strict=False))
    first, second = np.triu_indices(n, 1)
    multipliers = compute_multipliers(jacobians)
    margins = [
        np.linalg.det(np.eye(n) - jacobians),
        np.linalg.det(np.eye(n) + jacobians),
        np.prod(1.0 - multipliers[..., first] * multipliers[..., second], -1).real,
    ]
    return dict(zip(BIFURCATIONS, margins, strict=True))


def compute_multipliers(jacobians: np.ndarray) -> np.ndarray:
    """Return the multipliers in the order of decreasing modulus, NaN if a matrix is not finite."""
    is_finite = np.isfinite(jacobians).all((-1, -2))[..., None]
    multipliers = np.linalg.eigvals(np.where(is_finite[..., None], jacobians, 0.0))
    order = np.argsort(-np.abs(multipliers), -1, kind="stable")
    return np.where(is_finite, np.take_along_axis(multipliers, order, -1), np.nan)


def has_unit_circle_pair(jacobian: np.ndarray) -> bool:
    """Return whether a complex pair of multipliers lies on the unit circle.

    The test function of the Neimark-Sacker bifurcation also vanishes for two real reciprocal
    multipliers. Such multipliers are no bifurcation.
    """
    multipliers = compute_multipliers(jacobian)
    is_complex_pair = np.abs(multipliers.imag) > MIN_IMAGINARY_PART
    is_on_circle = np.abs(np.abs(multipliers) - 1.0) < LOCATED_PAIR_CIRCLE_DISTANCE
    return bool(np.any(is_on_circle & is_complex_pair))


def is_multiplier_change_explained(
    previous_jacobian: np.ndarray, next_jacobian: np.ndarray, has_parameter_turned_back: bool
) -> bool:
    """Return whether bifurcations explain the change of the multipliers between two points.

    A continuation step may pass several special points, or may end on a nearby branch. Both change
    the number of multipliers outside the unit circle, or the sign of the determinant of Newton's
    equations. On a single branch that sign changes only at folds and branch points.
    """
    jacobians = np.stack([previous_jacobian, next_jacobian])
    has_sign_change = {
        name: bool(values[0] * values[1] < 0.0)
        for name, values in evaluate_bifurcations(jacobians).items()
    }
    n_explained = sum(
        test.n_multipliers for name, test in BIFURCATIONS.items() if has_sign_change[name]
    )
    moduli = np.abs(compute_multipliers(jacobians))
    (least_before, least_after), (most_before, most_after) = (
        np.sum(moduli > 1.0 + distance, -1)
        for distance in (UNIT_CIRCLE_DISTANCE, -UNIT_CIRCLE_DISTANCE)
    )
    n_changed = max(least_after - most_before, least_before - most_after)
    return has_sign_change[FOLD] == has_parameter_turned_back and bool(n_changed <= n_explained)


def classify_multipliers(
    jacobian: np.ndarray, ranks: range, has_parameter_turned: bool
) -> dict[str, int]:
    """Return the number of multipliers for each bifurcation, by the name of the bifurcation.

    - `ranks`: ranks by modulus of the multipliers on the unit circle;
    - `has_parameter_turned`: whether the parameter changes its direction at the point. A multiplier
      of 1 is then that of a fold, and otherwise that of a branch point.
    """
    multipliers = compute_multipliers(jacobian)[list(ranks)]
    is_complex = np.abs(multipliers.imag) > MIN_IMAGINARY_PART
    counts = {
        FOLD if has_parameter_turned else BRANCH_POINT: ~is_complex & (multipliers.real > 0.0),
        PERIOD_DOUBLING: ~is_complex & (multipliers.real < 0.0),
        NEIMARK_SACKER: is_complex,
    }
    return {name: int(np.sum(mask)) for name, mask in counts.items() if np.any(mask)}
