"""Bifurcations of several multipliers at once, which change no sign of a determinant.

Multipliers are ranked by modulus, the largest first. The number of multipliers outside the unit
circle may change by more than the located bifurcations explain. Then the modulus of each rank that
crosses 1 is located, or the mean of the moduli of ranks that cross together.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from vrw_jax.continuation import MULTIPLIER_TOLERANCES, MultiplierTolerances

BRANCH_POINT_KIND = "branch_point"
"""Kind of a special point at which a multiplier is 1 and the branch does not turn back. Another
branch crosses the branch at this point, and the equations are singular. The continuation step
limits the accuracy of the location."""

MULTIPLIER_MODULI_COLUMN = "multiplier_moduli"
"""Name of the column that contains the moduli of all multipliers, largest first."""

CONTACT_ORDER_COLUMN = "contact_order"
"""Name of the column with a number that identifies the order of contacts."""

CONTACT_ORDER_CHANGE = "order_of_contacts_changes"
"""Name of the special point at which the order of contacts changes."""

NamedLocatedZero = tuple[str, Any, int]
"""Name of a special point, its located zero, and its number of multipliers on the unit circle."""

CROSSING_MULTIPLIER_COUNTS = {
    "fold": 1,
    BRANCH_POINT_KIND: 1,
    "period_doubling": 1,
    "neimark_sacker": 2,
}
"""Number of multipliers that cross the unit circle at a bifurcation, by the name of the
bifurcation."""


@dataclass(frozen=True)
class ZeroTolerances:
    """Tolerances within which located zeros of a branch are equal, or are no zeros.

    - `max_zero_margin`: size of a fold's margin below which its sign is round-off. It is chosen
      because a determinant of numbers of order one is computed to 1e-15, and points so near to a
      branch point are rare;
    - `max_equal_location_distance`: fraction of a bracket within which ranks are assumed to cross
      together. It is chosen because three equal multipliers are computed to 1e-5, which is 1e-4 of
      a bracket;
    - `max_value_beside_zero`: largest size of a quantity beside its zero, as a fraction of the size
      at an end of the bracket; at a jump the size is larger. It is chosen because the point beside
      the zero may be at nine tenths of the way to the zero;
    - `max_equal_parameter_distance`: relative distance below which two changes of the order of
      contacts are one. It is chosen because the results of the two searches may differ by the
      parameter's change over the shortest step.
    """

    max_zero_margin: float = 1e-11
    max_equal_location_distance: float = 1e-3
    max_value_beside_zero: float = 0.2
    max_equal_parameter_distance: float = 1e-7


ZERO_TOLERANCES = ZeroTolerances()
"""Tolerances of located zeros, for all branches."""


def sort_multiplier_moduli(jacobians: np.ndarray) -> np.ndarray:
    """Return the moduli of the multipliers, largest first; NaN for a matrix that is not finite."""
    is_jacobian_finite = np.isfinite(jacobians).all((-1, -2))
    multiplier_moduli = np.abs(
        np.linalg.eigvals(np.where(is_jacobian_finite[..., None, None], jacobians, 0.0))
    )
    return np.where(
        is_jacobian_finite[..., None], np.sort(multiplier_moduli, -1)[..., ::-1], np.nan
    )


def make_rank_quantity_name(first_rank: int, last_rank: int) -> str:
    """Return the name of the quantity that is zero if several ranks cross 1 together.

    The ranks are those from `first_rank` to before `last_rank`.
    """
    return f"{MULTIPLIER_MODULI_COLUMN}:{first_rank}:{last_rank}"


def make_contact_order_quantity_name(contact_order: float) -> str:
    """Return the name of the quantity that is positive for one order of contacts and negative for
    others.
    """
    return f"{CONTACT_ORDER_COLUMN}:{int(contact_order)}"


def evaluate_quantity(quantity_table: dict[str, np.ndarray], quantity_name: str) -> np.ndarray:
    """Return a quantity at each point.

    The quantity is a column of the table, the mean modulus of ranks minus 1, or the sign of an
    order of contacts.
    """
    if quantity_name.startswith(CONTACT_ORDER_COLUMN + ":"):
        contact_orders = quantity_table[CONTACT_ORDER_COLUMN]
        margin_sign = np.where(contact_orders == int(quantity_name.split(":")[1]), 1.0, -1.0)
        return np.where(np.isnan(contact_orders), np.nan, margin_sign)
    if not quantity_name.startswith(MULTIPLIER_MODULI_COLUMN + ":"):
        return quantity_table[quantity_name]
    first_rank, last_rank = map(int, quantity_name.split(":")[1:])
    return np.asarray(
        np.mean(quantity_table[MULTIPLIER_MODULI_COLUMN][:, first_rank:last_rank], -1) - 1.0
    )


def are_multipliers_off_circle(
    multiplier_moduli: np.ndarray,
    multiplier_tolerances: MultiplierTolerances = MULTIPLIER_TOLERANCES,
) -> np.ndarray:
    """Return whether no multiplier is on the unit circle within its tolerance, for each point."""
    return np.asarray((np.abs(multiplier_moduli - 1.0) > multiplier_tolerances.on_circle).all(-1))


def find_unexplained_ranks(
    multiplier_moduli_before: np.ndarray,
    multiplier_moduli_after: np.ndarray,
    bifurcation_names: list[str],
) -> range:
    """Return the ranks that cross 1 between two points unless the bifurcations explain them."""
    first_rank, last_rank = sorted(
        int(np.sum(moduli > 1.0)) for moduli in (multiplier_moduli_before, multiplier_moduli_after)
    )
    n_explained_crossings = sum(CROSSING_MULTIPLIER_COUNTS[name] for name in bifurcation_names)
    return (
        range(0)
        if last_rank - first_rank <= n_explained_crossings
        else range(first_rank, last_rank)
    )


def classify_crossing_ranks(
    jacobian: np.ndarray,
    crossing_ranks: range,
    has_turning_parameter: bool,
    multiplier_tolerances: MultiplierTolerances = MULTIPLIER_TOLERANCES,
) -> dict[str, int]:
    """Return the bifurcations of ranks on the unit circle.

    The result gives the number of multipliers by the name of the bifurcation.
    """
    multipliers = np.linalg.eigvals(jacobian)
    multipliers = multipliers[np.argsort(-np.abs(multipliers), kind="stable")][list(crossing_ranks)]
    is_complex_pair = np.abs(multipliers.imag) > multiplier_tolerances.min_imaginary
    name_at_one = "fold" if has_turning_parameter else BRANCH_POINT_KIND
    count_by_name = {
        name_at_one: int(np.sum(~is_complex_pair & (multipliers.real > 0.0))),
        "period_doubling": int(np.sum(~is_complex_pair & (multipliers.real < 0.0))),
        "neimark_sacker": int(np.sum(is_complex_pair)),
    }
    return {name: count for name, count in count_by_name.items() if count}


def vanishes_at_zero(
    quantity_table: dict[str, np.ndarray],
    located_zero: Any,
    zero_tolerances: ZeroTolerances = ZERO_TOLERANCES,
) -> bool:
    """Return whether a quantity vanishes at its located zero; otherwise the quantity jumps."""
    left_index, right_index, quantity_name = located_zero.zero_bracket
    end_values = evaluate_quantity(quantity_table, quantity_name)[[left_index, right_index]]
    value_beside = float(
        np.abs(evaluate_quantity(located_zero.quantities_beside, quantity_name)[0])
    )
    return not value_beside > zero_tolerances.max_value_beside_zero * float(
        np.max(np.abs(end_values))
    )


def drop_duplicate_order_changes(
    named_zeros: list[NamedLocatedZero], zero_tolerances: ZeroTolerances = ZERO_TOLERANCES
) -> list[NamedLocatedZero]:
    """Return the zeros with each change of the order of contacts once.

    A change is located both as the end of one order and as the start of the next order.
    """
    distinct_zeros: list[NamedLocatedZero] = []
    for name, located_zero, n_multipliers in named_zeros:
        similar_zeros = [
            other_zero
            for other_name, other_zero, _ in distinct_zeros
            if other_name == name == CONTACT_ORDER_CHANGE
        ]
        similar_zeros = [
            other_zero
            for other_zero in similar_zeros
            if other_zero.zero_bracket[:2] == located_zero.zero_bracket[:2]
        ]
        compute_max_distance = lambda other_zero: (
            zero_tolerances.max_equal_parameter_distance * abs(other_zero.parameter_value)
        )
        if not any(
            abs(located_zero.parameter_value - other_zero.parameter_value)
            <= compute_max_distance(other_zero)
            for other_zero in similar_zeros
        ):
            distinct_zeros.append((name, located_zero, n_multipliers))
    return distinct_zeros


def add_multiple_bifurcations(
    quantity_table: dict[str, np.ndarray],
    fraction_rates: np.ndarray,
    neighbor_pairs: list[tuple[int, int]],
    named_zeros: list[NamedLocatedZero],
    locate_zeros: Callable[[list[tuple[int, int, str]]], list[Any]],
    zero_tolerances: ZeroTolerances = ZERO_TOLERANCES,
    multiplier_tolerances: MultiplierTolerances = MULTIPLIER_TOLERANCES,
) -> list[NamedLocatedZero]:
    """Return the zeros, in which bifurcations of several multipliers replace incomplete ones.

    `neighbor_pairs` are pairs of neighboring points on a branch, and `locate_zeros` returns zeros
    of quantities between these points.
    """
    is_zero_within = lambda located_zero, point_pair: (
        point_pair[0] <= located_zero.zero_bracket[0]
        and located_zero.zero_bracket[1] <= point_pair[1]
    )
    multiplier_moduli, rank_requests = quantity_table[MULTIPLIER_MODULI_COLUMN], []
    for left_index, right_index in neighbor_pairs:
        explaining_names = [
            quantity_name
            for quantity_name, located_zero, _ in named_zeros
            if quantity_name in CROSSING_MULTIPLIER_COUNTS
            and is_zero_within(located_zero, (left_index, right_index))
        ]
        for rank in find_unexplained_ranks(
            multiplier_moduli[left_index], multiplier_moduli[right_index], explaining_names
        ):
            rank_requests.append((left_index, right_index, make_rank_quantity_name(rank, rank + 1)))
    if not rank_requests:
        return named_zeros
    groups_of_zeros: list[
        list[Any]
    ] = []  # Each group contains the zeros of ranks that may cross together.
    for located_zero in locate_zeros(rank_requests):
        if not vanishes_at_zero(quantity_table, located_zero, zero_tolerances):
            continue
        last_zero = groups_of_zeros[-1][-1] if groups_of_zeros else located_zero
        is_in_new_group = (
            abs(located_zero.chord_fraction - last_zero.chord_fraction)
            > zero_tolerances.max_equal_location_distance
        )
        if (
            not groups_of_zeros
            or last_zero.zero_bracket[:2] != located_zero.zero_bracket[:2]
            or is_in_new_group
        ):
            groups_of_zeros.append([])
        groups_of_zeros[-1].append(located_zero)
    get_first_rank = lambda zero_group: int(zero_group[0].zero_bracket[2].split(":")[1])
    mean_rank_requests = []
    for zero_group in groups_of_zeros:
        quantity_name = make_rank_quantity_name(
            get_first_rank(zero_group), get_first_rank(zero_group) + len(zero_group)
        )
        mean_rank_requests.append((*zero_group[0].zero_bracket[:2], quantity_name))
    multiple_zeros = []
    for zero_group, mean_zero in zip(
        groups_of_zeros, locate_zeros(mean_rank_requests), strict=True
    ):
        first_rank, n_ranks = get_first_rank(zero_group), len(zero_group)
        unit_circle_distances = np.abs(
            mean_zero.quantities_beside[MULTIPLIER_MODULI_COLUMN][
                0, first_rank : first_rank + n_ranks
            ]
            - 1.0
        )
        zeros_and_their_ranks = [(mean_zero, range(first_rank, first_rank + n_ranks))]
        if n_ranks > 1 and not np.max(unit_circle_distances) <= multiplier_tolerances.equal_moduli:
            zeros_and_their_ranks = [
                (located_zero, range(first_rank + position, first_rank + position + 1))
                for position, located_zero in enumerate(zero_group)
            ]
        for located_zero, ranks in zeros_and_their_ranks:
            left_rate, right_rate = fraction_rates[list(located_zero.zero_bracket[:2])]
            names_and_counts = classify_crossing_ranks(
                np.asarray(located_zero.point_beside.jacobian[0]),
                ranks,
                bool(left_rate * right_rate < 0.0),
            )
            multiple_zeros += [
                (quantity_name, located_zero, n_multipliers)
                for quantity_name, n_multipliers in names_and_counts.items()
            ]
    replaced_pairs = {located_zero.zero_bracket[:2] for _, located_zero, _ in multiple_zeros}
    is_replaced = lambda quantity_name, located_zero: (
        quantity_name in CROSSING_MULTIPLIER_COUNTS
        and any(is_zero_within(located_zero, point_pair) for point_pair in replaced_pairs)
    )
    return [
        located_zero
        for located_zero in named_zeros
        if not is_replaced(located_zero[0], located_zero[1])
    ] + multiple_zeros
