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
branch crosses it, and the equations are singular there. The continuation step limits the accuracy
of its location.
"""

MODULI_COLUMN = "multiplier_moduli"
"""Name of the column that contains the moduli of all multipliers, largest first."""

CONTACT_ORDER_COLUMN = "contact_order"
"""Name of the column with a number that identifies the order of contacts."""

CONTACT_ORDER_CHANGE = "order_of_contacts_changes"
"""Name of the special point at which the order of contacts changes."""

NamedZero = tuple[str, Any, int]
"""Name of a special point, its located zero, and its number of multipliers on the unit circle."""

N_CROSSING_MULTIPLIERS = {
    "fold": 1,
    BRANCH_POINT_KIND: 1,
    "period_doubling": 1,
    "neimark_sacker": 2,
}
"""Number of multipliers that cross the unit circle at a bifurcation, by its name."""


@dataclass(frozen=True)
class ZeroTolerances:
    """Tolerances within which located zeros of a branch are equal, or are no zeros.

    - `zero_margin`: size of a fold's margin below which its sign is round-off. It is chosen because
      a determinant of numbers of order one is computed to 1e-15, and points so near to a branch
      point are rare;
    - `equal_location`: fraction of a bracket within which ranks are assumed to cross together. It
      is chosen because three equal multipliers are computed to 1e-5, which is 1e-4 of a bracket;
    - `max_remainder`: largest size of a quantity beside its zero, as a fraction of that at an end
      of the bracket; at a jump the size is larger. It is chosen because the point beside may be at
      nine tenths of the way to the zero;
    - `equal_parameter`: relative distance below which two changes of the order of contacts are one.
      It is chosen because the results of the two searches may differ by the parameter's change over
      the shortest step.
    """

    zero_margin: float = 1e-11
    equal_location: float = 1e-3
    max_remainder: float = 0.2
    equal_parameter: float = 1e-7


ZERO_TOLERANCES = ZeroTolerances()
"""Tolerances of located zeros, for all branches."""


def rank_moduli(jacobians: np.ndarray) -> np.ndarray:
    """Return the moduli of the multipliers, largest first; NaN for a matrix that is not finite."""
    is_finite = np.isfinite(jacobians).all((-1, -2))
    moduli = np.abs(np.linalg.eigvals(np.where(is_finite[..., None, None], jacobians, 0.0)))
    return np.where(is_finite[..., None], np.sort(moduli, -1)[..., ::-1], np.nan)


def rank_quantity_name(first_rank: int, last_rank: int) -> str:
    """Return the name of the quantity that is zero if the ranks from `first_rank` to before
    `last_rank` cross 1 together.
    """
    return f"{MODULI_COLUMN}:{first_rank}:{last_rank}"


def contact_order_quantity_name(order: float) -> str:
    """Return the name of the quantity that is positive for this order of contacts, and negative
    for any other.
    """
    return f"{CONTACT_ORDER_COLUMN}:{int(order)}"


def evaluate_quantity(table: dict[str, np.ndarray], name: str) -> np.ndarray:
    """Return a column of a table, or a quantity of ranks or of an order of contacts, at each
    point.
    """
    if name.startswith(CONTACT_ORDER_COLUMN + ":"):
        order = table[CONTACT_ORDER_COLUMN]
        margin_sign = np.where(order == int(name.split(":")[1]), 1.0, -1.0)
        return np.where(np.isnan(order), np.nan, margin_sign)
    if not name.startswith(MODULI_COLUMN + ":"):
        return table[name]
    first_rank, last_rank = map(int, name.split(":")[1:])
    return np.asarray(np.mean(table[MODULI_COLUMN][:, first_rank:last_rank], -1) - 1.0)


def is_off_circle(
    moduli: np.ndarray, tolerances: MultiplierTolerances = MULTIPLIER_TOLERANCES
) -> np.ndarray:
    """Return whether no multiplier is on the unit circle within its tolerance, for each point."""
    return np.asarray((np.abs(moduli - 1.0) > tolerances.on_circle).all(-1))


def find_unexplained_ranks(
    moduli_before: np.ndarray, moduli_after: np.ndarray, names: list[str]
) -> range:
    """Return the ranks that cross 1 between two points if the bifurcations `names` do not
    explain them.
    """
    first_rank, last_rank = sorted(
        int(np.sum(moduli > 1.0)) for moduli in (moduli_before, moduli_after)
    )
    n_explained = sum(N_CROSSING_MULTIPLIERS[name] for name in names)
    return range(0) if last_rank - first_rank <= n_explained else range(first_rank, last_rank)


def classify_ranks(
    jacobian: np.ndarray,
    ranks: range,
    turns_back: bool,
    tolerances: MultiplierTolerances = MULTIPLIER_TOLERANCES,
) -> dict[str, int]:
    """Return the bifurcations of ranks on the unit circle: their names, each with its number of
    multipliers.
    """
    values = np.linalg.eigvals(jacobian)
    values = values[np.argsort(-np.abs(values), kind="stable")][list(ranks)]
    is_pair = np.abs(values.imag) > tolerances.min_imaginary
    name_at_one = "fold" if turns_back else BRANCH_POINT_KIND
    count_by_name = {
        name_at_one: int(np.sum(~is_pair & (values.real > 0.0))),
        "period_doubling": int(np.sum(~is_pair & (values.real < 0.0))),
        "neimark_sacker": int(np.sum(is_pair)),
    }
    return {name: count for name, count in count_by_name.items() if count}


def vanishes_at_zero(
    table: dict[str, np.ndarray], zero: Any, tolerances: ZeroTolerances = ZERO_TOLERANCES
) -> bool:
    """Return whether a quantity vanishes at its located zero; otherwise the quantity jumps
    there.
    """
    left, right, name = zero.bracket
    end_values = evaluate_quantity(table, name)[[left, right]]
    value_beside = float(np.abs(evaluate_quantity(zero.table, name)[0]))
    return not value_beside > tolerances.max_remainder * float(np.max(np.abs(end_values)))


def drop_duplicate_order_changes(
    zeros: list[NamedZero], tolerances: ZeroTolerances = ZERO_TOLERANCES
) -> list[NamedZero]:
    """Return the zeros with each change of the order of contacts once.

    A change is located both as the end of one order and as the start of the next one.
    """
    distinct_zeros: list[NamedZero] = []
    for name, zero, count in zeros:
        similar_zeros = [
            other_zero
            for other_name, other_zero, _ in distinct_zeros
            if other_name == name == CONTACT_ORDER_CHANGE
        ]
        similar_zeros = [
            other_zero for other_zero in similar_zeros if other_zero.bracket[:2] == zero.bracket[:2]
        ]
        max_distance = lambda other_zero: tolerances.equal_parameter * abs(other_zero.value)
        if not any(
            abs(zero.value - other_zero.value) <= max_distance(other_zero)
            for other_zero in similar_zeros
        ):
            distinct_zeros.append((name, zero, count))
    return distinct_zeros


def add_multiple_bifurcations(
    table: dict[str, np.ndarray],
    fraction_rates: np.ndarray,
    pairs: list[tuple[int, int]],
    zeros: list[NamedZero],
    locate: Callable[[list[tuple[int, int, str]]], list[Any]],
    tolerances: ZeroTolerances = ZERO_TOLERANCES,
    multiplier_tolerances: MultiplierTolerances = MULTIPLIER_TOLERANCES,
) -> list[NamedZero]:
    """Return the zeros, in which bifurcations of several multipliers replace incomplete ones.

    `pairs` are pairs of neighboring points on a branch, and `locate` returns zeros of quantities
    between them.
    """
    is_zero_within = lambda zero, point_pair: (
        point_pair[0] <= zero.bracket[0] and zero.bracket[1] <= point_pair[1]
    )
    moduli, rank_requests = table[MODULI_COLUMN], []
    for left, right in pairs:
        names = [
            name
            for name, zero, _ in zeros
            if name in N_CROSSING_MULTIPLIERS and is_zero_within(zero, (left, right))
        ]
        for rank in find_unexplained_ranks(moduli[left], moduli[right], names):
            rank_requests.append((left, right, rank_quantity_name(rank, rank + 1)))
    if not rank_requests:
        return zeros
    zero_groups: list[
        list[Any]
    ] = []  # Each group contains the zeros of ranks that may cross together.
    for zero in locate(rank_requests):
        if not vanishes_at_zero(table, zero, tolerances):
            continue
        last_zero = zero_groups[-1][-1] if zero_groups else zero
        is_apart = abs(zero.fraction - last_zero.fraction) > tolerances.equal_location
        if not zero_groups or last_zero.bracket[:2] != zero.bracket[:2] or is_apart:
            zero_groups.append([])
        zero_groups[-1].append(zero)
    get_first_rank = lambda zero_group: int(zero_group[0].bracket[2].split(":")[1])
    mean_requests = []
    for zero_group in zero_groups:
        name = rank_quantity_name(
            get_first_rank(zero_group), get_first_rank(zero_group) + len(zero_group)
        )
        mean_requests.append((*zero_group[0].bracket[:2], name))
    multiple_zeros = []
    for zero_group, mean_zero in zip(zero_groups, locate(mean_requests), strict=True):
        first_rank, count = get_first_rank(zero_group), len(zero_group)
        distances = np.abs(mean_zero.table[MODULI_COLUMN][0, first_rank : first_rank + count] - 1.0)
        zeros_and_ranks = [(mean_zero, range(first_rank, first_rank + count))]
        if count > 1 and not np.max(distances) <= multiplier_tolerances.equal_moduli:
            zeros_and_ranks = [
                (zero, range(first_rank + position, first_rank + position + 1))
                for position, zero in enumerate(zero_group)
            ]
        for zero, ranks in zeros_and_ranks:
            left_rate, right_rate = fraction_rates[list(zero.bracket[:2])]
            names_and_counts = classify_ranks(
                np.asarray(zero.point_beside.jacobian[0]), ranks, bool(left_rate * right_rate < 0.0)
            )
            multiple_zeros += [
                (name, zero, n_multipliers) for name, n_multipliers in names_and_counts.items()
            ]
    replaced_pairs = {zero.bracket[:2] for _, zero, _ in multiple_zeros}
    is_replaced = lambda name, zero: (
        name in N_CROSSING_MULTIPLIERS
        and any(is_zero_within(zero, point_pair) for point_pair in replaced_pairs)
    )
    return [zero for zero in zeros if not is_replaced(zero[0], zero[1])] + multiple_zeros
