"""Locate bifurcations of several multipliers at once, which change no sign of a determinant.

Multipliers are ranked by modulus, the largest first. The located bifurcations may explain only some
of the multipliers that leave the unit circle. In that case, the point at which the modulus of each
single rank crosses 1 is located. If several ranks cross together, the point at which the mean of
their moduli crosses 1 is located.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from vrw_jax.continuation import MULTIPLIER_TOLERANCES, MultiplierTolerances

BRANCH_POINT_KIND = "branch_point"
"""Kind of a special point at which a multiplier is 1 but the branch does not turn back.

Another branch crosses at this point, and the equations are singular. The length of the continuation
step limits the accuracy of the location.
"""

MULTIPLIER_MODULI_COLUMN = "multiplier_moduli"
"""Name of the quantity that contains the moduli of all multipliers, largest first."""

CONTACT_ORDER_COLUMN = "contact_order"
"""Name of the quantity whose value is a number that identifies the order of contacts."""

CONTACT_ORDER_CHANGE = "order_of_contacts_changes"
"""Name of the special point at which the order of contacts changes."""

FORCE_PEAK_COUNT_COLUMN = "n_force_peaks"
"""Name of the measure that counts the force peaks of a gait."""

FORCE_PEAK_COUNT_CHANGE = "number_of_force_peaks_changes"
"""Name of the special point at which a force peak appears or disappears, at an event or inside a
phase.
"""

SECOND_PEAK_RATE_NAME = "second_peak_rate"
"""Name of a measure of the gait's force. If it is zero, a force peak appears inside a phase."""

STEPWISE_CHANGE_NAMES = {
    CONTACT_ORDER_COLUMN: CONTACT_ORDER_CHANGE,
    FORCE_PEAK_COUNT_COLUMN: FORCE_PEAK_COUNT_CHANGE,
}
"""Names of the special points at which a quantity with integer values changes, by its name."""

NamedLocatedRoot = tuple[str, Any, int]
"""Name of a special point, its located root, and the number of multipliers on the unit circle."""

CROSSING_MULTIPLIER_COUNTS = {
    "fold": 1,
    BRANCH_POINT_KIND: 1,
    "period_doubling": 1,
    "neimark_sacker": 2,
}
"""Number of multipliers that cross the unit circle, by the name of the bifurcation."""


@dataclass(frozen=True)
class LocatedRootTolerances:
    """Tolerances that decide whether two located roots are equal, and whether a located root is
    valid.

    - `max_zero_margin`: largest absolute value of a margin to the fold whose sign is only
      round-off. The value is chosen above the round-off of a determinant of numbers of order one,
      which is 1e-15. Points so near to a branch point are rare;
    - `max_equal_location_distance`: fraction of a bracket within which ranks are treated as
      crossing together. The value is chosen because three equal multipliers are computed to 1e-5,
      which is 1e-4 of a bracket;
    - `max_value_beside_root`: largest ratio of the quantity next to its root to the quantity at an
      end of the bracket; at a jump the ratio is larger. The value is chosen because the point next
      to the root may be at nine tenths of the distance to the root;
    - `max_equal_parameter_distance`: relative distance below which two changes of a stepwise
      quantity are the same change. The value is chosen because two searches may differ by the
      change of the parameter over the shortest continuation step.
    """

    max_zero_margin: float = 1e-11
    max_equal_location_distance: float = 1e-3
    max_value_beside_root: float = 0.2
    max_equal_parameter_distance: float = 1e-7


LOCATED_ROOT_TOLERANCES = LocatedRootTolerances()
"""Tolerances for located roots on all branches."""


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


def format_rank_quantity_name(first_multiplier_rank: int, last_multiplier_rank: int) -> str:
    """Return the name of the quantity that vanishes if several ranks cross modulus 1 together.

    The ranks are `first_multiplier_rank`, ..., `last_multiplier_rank` - 1.
    """
    return f"{MULTIPLIER_MODULI_COLUMN}:{first_multiplier_rank}:{last_multiplier_rank}"


def format_equality_quantity_name(stepwise_name: str, integer_value: float) -> str:
    """Return the name of the quantity that is positive only where another quantity has one value.

    The quantity is negative for all other values.

    - `stepwise_name`: name of the other quantity, one of `STEPWISE_CHANGE_NAMES`.
    """
    return f"{stepwise_name}:{int(integer_value)}"


def evaluate_named_quantity(
    quantity_table: dict[str, np.ndarray], quantity_name: str
) -> np.ndarray:
    """Return the quantity with the given name at each point.

    The quantity is one of three kinds: a quantity of the table, the mean modulus of several ranks
    minus 1, or a sign that identifies one value of a stepwise quantity.
    """
    column_name, _, column_value = quantity_name.partition(":")
    if column_name in STEPWISE_CHANGE_NAMES and column_value:
        integer_values = quantity_table[column_name]
        equality_sign = np.where(integer_values == int(column_value), 1.0, -1.0)
        return np.where(np.isnan(integer_values), np.nan, equality_sign)
    if not quantity_name.startswith(MULTIPLIER_MODULI_COLUMN + ":"):
        return quantity_table[quantity_name]
    first_multiplier_rank, last_multiplier_rank = map(int, quantity_name.split(":")[1:])
    return np.asarray(
        np.mean(
            quantity_table[MULTIPLIER_MODULI_COLUMN][:, first_multiplier_rank:last_multiplier_rank],
            -1,
        )
        - 1.0
    )


def are_multipliers_off_circle(
    multiplier_moduli: np.ndarray,
    multiplier_tolerances: MultiplierTolerances = MULTIPLIER_TOLERANCES,
) -> np.ndarray:
    """Return for each point whether all multipliers are off the unit circle by more than the
    tolerance.
    """
    return np.asarray(
        (np.abs(multiplier_moduli - 1.0) > multiplier_tolerances.unit_circle_distance).all(-1)
    )


def find_unexplained_ranks(
    multiplier_moduli_before: np.ndarray,
    multiplier_moduli_after: np.ndarray,
    bifurcation_names: list[str],
) -> range:
    """Return the ranks whose moduli cross 1 between two points.

    The moduli are in decreasing order. The result is empty if the bifurcations in
    `bifurcation_names` explain all crossings.
    """
    first_multiplier_rank, last_multiplier_rank = sorted(
        int(np.sum(multiplier_moduli > 1.0))
        for multiplier_moduli in (multiplier_moduli_before, multiplier_moduli_after)
    )
    n_explained_crossings = sum(
        CROSSING_MULTIPLIER_COUNTS[bifurcation_name] for bifurcation_name in bifurcation_names
    )
    return (
        range(0)
        if last_multiplier_rank - first_multiplier_rank <= n_explained_crossings
        else range(first_multiplier_rank, last_multiplier_rank)
    )


def classify_crossing_ranks(
    return_map_jacobian: np.ndarray,
    crossing_multiplier_ranks: range,
    has_parameter_turned: bool,
    multiplier_tolerances: MultiplierTolerances = MULTIPLIER_TOLERANCES,
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
    is_multiplier_complex = np.abs(multipliers.imag) > multiplier_tolerances.min_imaginary_part
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


def vanishes_at_root(
    quantity_table: dict[str, np.ndarray],
    located_root: Any,
    root_tolerances: LocatedRootTolerances = LOCATED_ROOT_TOLERANCES,
) -> bool:
    """Return whether a quantity vanishes at its located root. Otherwise it jumps there."""
    left_index, right_index, quantity_name = located_root.bracket_and_quantity
    quantity_at_bracket_ends = evaluate_named_quantity(quantity_table, quantity_name)[
        [left_index, right_index]
    ]
    quantity_value_beside_root = float(
        np.abs(evaluate_named_quantity(located_root.quantities_beside_root, quantity_name)[0])
    )
    return not quantity_value_beside_root > root_tolerances.max_value_beside_root * float(
        np.max(np.abs(quantity_at_bracket_ends))
    )


def drop_duplicate_changes(
    named_roots: list[NamedLocatedRoot],
    root_tolerances: LocatedRootTolerances = LOCATED_ROOT_TOLERANCES,
) -> list[NamedLocatedRoot]:
    """Return the roots, with each change of a stepwise quantity only once.

    Each change is located twice, as the end of one value and as the start of the next value. A
    change of the number of force peaks is omitted at a zero of the second peak's rate.
    """
    is_same_change = lambda special_point_name, earlier_name: (
        special_point_name == earlier_name in STEPWISE_CHANGE_NAMES.values()
        or (special_point_name, earlier_name) == (FORCE_PEAK_COUNT_CHANGE, SECOND_PEAK_RATE_NAME)
    )
    distinct_named_roots: list[NamedLocatedRoot] = []
    for special_point_name, located_root, n_multipliers in named_roots:
        roots_of_same_change = [
            compared_located_root
            for compared_special_point_name, compared_located_root, _ in distinct_named_roots
            if is_same_change(special_point_name, compared_special_point_name)
        ]
        roots_of_same_change = [
            compared_located_root
            for compared_located_root in roots_of_same_change
            if compared_located_root.bracket_and_quantity[:2]
            == located_root.bracket_and_quantity[:2]
        ]
        compute_max_root_distance = lambda compared_located_root: (
            root_tolerances.max_equal_parameter_distance
            * abs(compared_located_root.parameter_value)
        )
        if not any(
            abs(located_root.parameter_value - compared_located_root.parameter_value)
            <= compute_max_root_distance(compared_located_root)
            for compared_located_root in roots_of_same_change
        ):
            distinct_named_roots.append((special_point_name, located_root, n_multipliers))
    return distinct_named_roots


def add_multiple_bifurcations(
    quantity_table: dict[str, np.ndarray],
    fraction_rates: np.ndarray,
    neighbor_pairs: list[tuple[int, int]],
    named_roots: list[NamedLocatedRoot],
    root_locator: Callable[[list[tuple[int, int, str]]], list[Any]],
    root_tolerances: LocatedRootTolerances = LOCATED_ROOT_TOLERANCES,
    multiplier_tolerances: MultiplierTolerances = MULTIPLIER_TOLERANCES,
) -> list[NamedLocatedRoot]:
    """Replace bifurcations that explain only some of the crossing multipliers.

    Bifurcations of several multipliers replace them. Return all roots.

    - `neighbor_pairs`: pairs of neighboring points on a branch;
    - `root_locator`: function that locates roots of quantities between two neighboring points.
    """
    root_pair_test = lambda located_root, point_pair: (
        point_pair[0] <= located_root.bracket_and_quantity[0]
        and located_root.bracket_and_quantity[1] <= point_pair[1]
    )
    multiplier_moduli, multiplier_root_requests = quantity_table[MULTIPLIER_MODULI_COLUMN], []
    for left_index, right_index in neighbor_pairs:
        explaining_bifurcation_names = [
            quantity_name
            for quantity_name, located_root, _ in named_roots
            if quantity_name in CROSSING_MULTIPLIER_COUNTS
            and root_pair_test(located_root, (left_index, right_index))
        ]
        for multiplier_rank in find_unexplained_ranks(
            multiplier_moduli[left_index],
            multiplier_moduli[right_index],
            explaining_bifurcation_names,
        ):
            multiplier_root_requests.append(
                (
                    left_index,
                    right_index,
                    format_rank_quantity_name(multiplier_rank, multiplier_rank + 1),
                )
            )
    if not multiplier_root_requests:
        return named_roots
    root_groups: list[
        list[Any]
    ] = []  # Each group contains the roots for ranks that may cross the unit circle together.
    for located_root in root_locator(multiplier_root_requests):
        if not vanishes_at_root(quantity_table, located_root, root_tolerances):
            continue
        last_located_root = root_groups[-1][-1] if root_groups else located_root
        starts_new_root_group = (
            abs(located_root.chord_fraction - last_located_root.chord_fraction)
            > root_tolerances.max_equal_location_distance
        )
        if (
            not root_groups
            or last_located_root.bracket_and_quantity[:2] != located_root.bracket_and_quantity[:2]
            or starts_new_root_group
        ):
            root_groups.append([])
        root_groups[-1].append(located_root)
    first_group_rank_getter = lambda root_group: int(
        root_group[0].bracket_and_quantity[2].split(":")[1]
    )
    mean_multiplier_requests = []
    for root_group in root_groups:
        quantity_name = format_rank_quantity_name(
            first_group_rank_getter(root_group),
            first_group_rank_getter(root_group) + len(root_group),
        )
        mean_multiplier_requests.append((*root_group[0].bracket_and_quantity[:2], quantity_name))
    multiple_bifurcation_roots = []
    for root_group, located_mean_root in zip(
        root_groups, root_locator(mean_multiplier_requests), strict=True
    ):
        first_multiplier_rank, n_multiplier_ranks = (
            first_group_rank_getter(root_group),
            len(root_group),
        )
        unit_circle_distances = np.abs(
            located_mean_root.quantities_beside_root[MULTIPLIER_MODULI_COLUMN][
                0, first_multiplier_rank : first_multiplier_rank + n_multiplier_ranks
            ]
            - 1.0
        )
        roots_and_ranks = [
            (
                located_mean_root,
                range(first_multiplier_rank, first_multiplier_rank + n_multiplier_ranks),
            )
        ]
        if (
            n_multiplier_ranks > 1
            and not np.max(unit_circle_distances) <= multiplier_tolerances.equal_moduli_distance
        ):
            roots_and_ranks = [
                (
                    located_root,
                    range(
                        first_multiplier_rank + index_in_root_group,
                        first_multiplier_rank + index_in_root_group + 1,
                    ),
                )
                for index_in_root_group, located_root in enumerate(root_group)
            ]
        for located_root, crossing_multiplier_ranks in roots_and_ranks:
            left_fraction_rate, right_fraction_rate = fraction_rates[
                list(located_root.bracket_and_quantity[:2])
            ]
            names_and_multiplier_counts = classify_crossing_ranks(
                np.asarray(located_root.point_beside_root.return_map_jacobian[0]),
                crossing_multiplier_ranks,
                bool(left_fraction_rate * right_fraction_rate < 0.0),
            )
            multiple_bifurcation_roots += [
                (quantity_name, located_root, n_multipliers)
                for quantity_name, n_multipliers in names_and_multiplier_counts.items()
            ]
    replaced_point_pairs = {
        located_root.bracket_and_quantity[:2] for _, located_root, _ in multiple_bifurcation_roots
    }
    is_root_replaced = lambda quantity_name, located_root: (
        quantity_name in CROSSING_MULTIPLIER_COUNTS
        and any(root_pair_test(located_root, point_pair) for point_pair in replaced_point_pairs)
    )
    return [
        located_root
        for located_root in named_roots
        if not is_root_replaced(located_root[0], located_root[1])
    ] + multiple_bifurcation_roots
