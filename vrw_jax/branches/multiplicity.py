"""Locate bifurcations of several multipliers at once, which change no sign of a determinant.

Multipliers are ranked by modulus, the largest first. The located bifurcations may explain only some
of the multipliers that leave the unit circle. In that case, the point at which the modulus of each
single rank crosses 1 is located. If several ranks cross together, the point at which the mean of
their moduli crosses 1 is located.
"""

from collections.abc import Callable

import numpy as np

from vrw_jax.branches.branch_points import (
    BRANCH_POINT_KIND,
    MULTIPLIER_MODULI_COLUMN,
    BranchPointTable,
    LocatedRoot,
    RootRequest,
)
from vrw_jax.gaits.floquet import EQUAL_MODULI_DISTANCE, MIN_IMAGINARY_PART, UNIT_CIRCLE_DISTANCE


def sort_multiplier_moduli(return_map_jacobians: np.ndarray) -> np.ndarray:
    """Return the moduli of the multipliers in decreasing order, or NaN if a matrix is
    not finite.
    """
    is_jacobian_finite = np.isfinite(return_map_jacobians).all((-1, -2))
    multiplier_moduli = np.abs(
        np.linalg.eigvals(np.where(is_jacobian_finite[..., None, None], return_map_jacobians, 0.0))
    )
    return np.where(
        is_jacobian_finite[..., None], np.sort(multiplier_moduli, -1)[..., ::-1], np.nan
    )


def request_mean_modulus_root(point_pair: tuple[int, int], ranks: range) -> RootRequest:
    """Request the root at which the mean modulus of the multipliers with these ranks is 1."""
    return RootRequest(
        point_pair,
        MULTIPLIER_MODULI_COLUMN,
        lambda quantity_table: np.asarray(
            np.mean(quantity_table[MULTIPLIER_MODULI_COLUMN][:, ranks.start : ranks.stop], -1) - 1.0
        ),
        ranks,
    )


def are_multipliers_off_circle(multiplier_moduli: np.ndarray) -> np.ndarray:
    """Return for each point whether all multipliers are off the unit circle by more than the
    tolerance.
    """
    return np.asarray((np.abs(multiplier_moduli - 1.0) > UNIT_CIRCLE_DISTANCE).all(-1))


def classify_crossing_ranks(
    return_map_jacobian: np.ndarray,
    crossing_multiplier_ranks: range,
    has_parameter_turned: bool,
) -> dict[str, int]:
    """Return the number of multipliers for each bifurcation, by the name of the bifurcation.

    - `crossing_multiplier_ranks`: ranks of the multipliers on the unit circle;
    - `has_parameter_turned`: whether the parameter changes its direction at the point. A multiplier
      of 1 is then that of a fold, and otherwise that of a branch point.
    """
    multipliers = np.linalg.eigvals(return_map_jacobian)
    multipliers = multipliers[np.argsort(-np.abs(multipliers), kind="stable")][
        list(crossing_multiplier_ranks)
    ]
    is_multiplier_complex = np.abs(multipliers.imag) > MIN_IMAGINARY_PART
    bifurcation_at_multiplier_one = "fold" if has_parameter_turned else BRANCH_POINT_KIND
    n_multipliers_by_name = {
        bifurcation_at_multiplier_one: int(
            np.sum(~is_multiplier_complex & (multipliers.real > 0.0))
        ),
        "period_doubling": int(np.sum(~is_multiplier_complex & (multipliers.real < 0.0))),
        "neimark_sacker": int(np.sum(is_multiplier_complex)),
    }
    return {
        bifurcation_name: n_multipliers
        for bifurcation_name, n_multipliers in n_multipliers_by_name.items()
        if n_multipliers
    }


# Fraction of a bracket within which ranks are treated as crossing together. The value is chosen
# because three equal multipliers are computed to 1e-5, which is 1e-4 of a bracket.
MAX_EQUAL_LOCATION_DISTANCE = 1e-3


def add_multiple_bifurcations(
    point_table: BranchPointTable,
    point_pairs: list[tuple[int, int]],
    located_roots: list[LocatedRoot],
    locate_roots: Callable[[list[RootRequest]], list[LocatedRoot]],
) -> list[LocatedRoot]:
    """Replace bifurcations that explain only some of the crossing multipliers.

    Bifurcations of several multipliers replace them. Return all roots.

    - `point_pairs`: pairs of neighboring points on a branch, whose multipliers are compared;
    - `locate_roots`: function that locates roots of quantities between points of the table.
    """
    is_root_between = lambda root, point_pair: (
        point_pair[0] <= root.request.point_pair[0] and root.request.point_pair[1] <= point_pair[1]
    )
    multiplier_moduli = point_table.quantity_table[MULTIPLIER_MODULI_COLUMN]
    root_requests = []
    for point_pair in point_pairs:
        n_explained_crossings = sum(
            root.n_multipliers for root in located_roots if is_root_between(root, point_pair)
        )
        crossing_ranks = range(
            *sorted(np.sum(multiplier_moduli[list(point_pair)] > 1.0, -1).tolist())
        )
        if len(crossing_ranks) > n_explained_crossings:
            root_requests += [
                request_mean_modulus_root(point_pair, range(rank, rank + 1))
                for rank in crossing_ranks
            ]
    # Each group contains the roots for ranks that may cross the unit circle together.
    root_groups: list[list[LocatedRoot]] = []
    for root in locate_roots(root_requests):
        if not root.vanishes_at_root(point_table.quantity_table):
            continue
        last_root = root_groups[-1][-1] if root_groups else None
        if (
            last_root is not None
            and last_root.request.point_pair == root.request.point_pair
            and abs(root.chord_fraction - last_root.chord_fraction) <= MAX_EQUAL_LOCATION_DISTANCE
        ):
            root_groups[-1].append(root)
        else:
            root_groups.append([root])
    requests_for_mean_modulus_roots = []
    for root_group in root_groups:
        point_pair, first_rank = (
            root_group[0].request.point_pair,
            root_group[0].request.multiplier_ranks.start,
        )
        requests_for_mean_modulus_roots.append(
            request_mean_modulus_root(point_pair, range(first_rank, first_rank + len(root_group)))
        )
    multiple_bifurcations = []
    for root_group, mean_root in zip(
        root_groups, locate_roots(requests_for_mean_modulus_roots), strict=True
    ):
        moduli_beside_root = mean_root.table_beside_root.quantity_table[MULTIPLIER_MODULI_COLUMN][0]
        unit_circle_distances = np.abs(
            moduli_beside_root[list(mean_root.request.multiplier_ranks)] - 1.0
        )
        do_ranks_cross_together = (
            len(root_group) == 1 or np.max(unit_circle_distances) <= EQUAL_MODULI_DISTANCE
        )
        for root in [mean_root] if do_ranks_cross_together else root_group:
            left_fraction_rate, right_fraction_rate = point_table.points.fraction_rate[
                list(root.request.point_pair)
            ]
            multiplier_counts = classify_crossing_ranks(
                root.return_map_jacobian,
                root.request.multiplier_ranks,
                bool(left_fraction_rate * right_fraction_rate < 0.0),
            )
            multiple_bifurcations += [
                root._replace(special_point_name=bifurcation_name, n_multipliers=n_multipliers)
                for bifurcation_name, n_multipliers in multiplier_counts.items()
            ]
    replaced_pairs = {root.request.point_pair for root in multiple_bifurcations}
    is_root_replaced = lambda root: (
        root.n_multipliers > 0
        and any(is_root_between(root, point_pair) for point_pair in replaced_pairs)
    )
    return [root for root in located_roots if not is_root_replaced(root)] + multiple_bifurcations
