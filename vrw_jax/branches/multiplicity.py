"""Bifurcations of several multipliers at once, which no sign of a determinant shows.

Multipliers are ranked by modulus, the largest first. The number of multipliers outside the unit
circle may change by more than the located bifurcations explain. Then the modulus of each rank that
crosses 1 is located, or the mean of the moduli of ranks that cross at once.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from vrw_jax.continuation import MULTIPLIER_TOLERANCES, MultiplierTolerances

BRANCH_POINT_KIND = "branch_point"
"""Kind of a special point at which a multiplier is 1 and the branch does not turn back. Another
branch crosses it, and the equations are singular there. The accuracy of its location is limited by
the continuation step."""

MODULI_COLUMN = "multiplier_moduli"
"""Name of the column of ranked moduli."""

CONTACT_ORDER_COLUMN = "contact_order"
"""Name of the column with a number for each order of contacts."""

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
    """Tolerances at which located zeros of a branch are equal, or are no zeros.

    - `zero_margin`: size of a fold's margin below which its sign is round-off, chosen because a
      determinant of numbers of order one is computed to 1e-15, and points so near to a branch
      point are rare;
    - `equal_location`: fraction of a bracket within which ranks are assumed to cross at once,
      chosen because three equal multipliers are computed to 1e-5, which is 1e-4 of a bracket;
    - `max_remainder`: largest size of a quantity beside its zero, as a fraction of that at an end
      of the bracket; at a jump more remains. It is chosen because the point beside may be at nine
      tenths of the way to the zero;
    - `equal_parameter`: relative distance below which two changes of the order of contacts are one,
      chosen because the two searches may end apart by the parameter's change over a shortest step.
    """

    zero_margin: float = 1e-11
    equal_location: float = 1e-3
    max_remainder: float = 0.2
    equal_parameter: float = 1e-7


ZERO_TOLERANCES = ZeroTolerances()
"""Tolerances of all branches."""


def rank_moduli(jacobians: np.ndarray) -> np.ndarray:
    """Return the ranked moduli of the multipliers, NaN for a matrix that is not finite."""
    is_finite = np.isfinite(jacobians).all((-1, -2))
    moduli = np.abs(np.linalg.eigvals(np.where(is_finite[..., None, None], jacobians, 0.0)))
    return np.where(is_finite[..., None], np.sort(moduli, -1)[..., ::-1], np.nan)


def rank_quantity_name(first: int, last: int) -> str:
    """Return the name of the quantity that is zero if ranks first … last - 1 cross 1 at once."""
    return f"{MODULI_COLUMN}:{first}:{last}"


def contact_order_quantity_name(order: float) -> str:
    """Return the name of the quantity that is positive for this order of contacts."""
    return f"{CONTACT_ORDER_COLUMN}:{int(order)}"


def evaluate_quantity(table: dict[str, np.ndarray], name: str) -> np.ndarray:
    """Return a column of a table, or a quantity of ranks or of an order of contacts."""
    if name.startswith(CONTACT_ORDER_COLUMN + ":"):
        order = table[CONTACT_ORDER_COLUMN]
        sign = np.where(order == int(name.split(":")[1]), 1.0, -1.0)
        return np.where(np.isnan(order), np.nan, sign)
    if not name.startswith(MODULI_COLUMN + ":"):
        return table[name]
    first, last = map(int, name.split(":")[1:])
    return np.asarray(np.mean(table[MODULI_COLUMN][:, first:last], -1) - 1.0)


def is_off_circle(
    moduli: np.ndarray, tolerances: MultiplierTolerances = MULTIPLIER_TOLERANCES
) -> np.ndarray:
    """Return for each point whether no multiplier is on the unit circle within its tolerance."""
    return np.asarray((np.abs(moduli - 1.0) > tolerances.on_circle).all(-1))


def find_unexplained_ranks(
    moduli_before: np.ndarray, moduli_after: np.ndarray, names: list[str]
) -> range:
    """Return the ranks that cross 1 between two points if the bifurcations `names` are too few."""
    first, last = sorted(int(np.sum(moduli > 1.0)) for moduli in (moduli_before, moduli_after))
    n_explained = sum(N_CROSSING_MULTIPLIERS[name] for name in names)
    return range(0) if last - first <= n_explained else range(first, last)


def classify_ranks(
    jacobian: np.ndarray,
    ranks: range,
    turns_back: bool,
    tolerances: MultiplierTolerances = MULTIPLIER_TOLERANCES,
) -> dict[str, int]:
    """Return the names of the bifurcations of ranks on the unit circle, with their multiplicity."""
    values = np.linalg.eigvals(jacobian)
    values = values[np.argsort(-np.abs(values), kind="stable")][list(ranks)]
    is_pair = np.abs(values.imag) > tolerances.min_imaginary
    name_at_one = "fold" if turns_back else BRANCH_POINT_KIND
    counts = {
        name_at_one: int(np.sum(~is_pair & (values.real > 0.0))),
        "period_doubling": int(np.sum(~is_pair & (values.real < 0.0))),
        "neimark_sacker": int(np.sum(is_pair)),
    }
    return {name: count for name, count in counts.items() if count}


def vanishes_at(
    table: dict[str, np.ndarray], zero: Any, tolerances: ZeroTolerances = ZERO_TOLERANCES
) -> bool:
    """Return whether a quantity vanishes at its located zero; otherwise it jumps there."""
    left, right, name = zero.bracket
    end_values = evaluate_quantity(table, name)[[left, right]]
    value_beside = float(np.abs(evaluate_quantity(zero.table, name)[0]))
    return not value_beside > tolerances.max_remainder * float(np.max(np.abs(end_values)))


def drop_duplicate_order_changes(
    zeros: list[NamedZero], tolerances: ZeroTolerances = ZERO_TOLERANCES
) -> list[NamedZero]:
    """Return the zeros with each change of the order of contacts once.

    A change is located both as the end of one order and as the begin of the next one.
    """
    distinct: list[NamedZero] = []
    for name, zero, count in zeros:
        others = [z for n, z, _ in distinct if n == name == CONTACT_ORDER_CHANGE]
        others = [z for z in others if z.bracket[:2] == zero.bracket[:2]]
        max_distance = lambda other: tolerances.equal_parameter * abs(other.value)
        if not any(abs(zero.value - other.value) <= max_distance(other) for other in others):
            distinct.append((name, zero, count))
    return distinct


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

    `pairs` are neighbors on a branch, and `locate` returns zeros of quantities between them.
    """
    is_within = lambda zero, span: span[0] <= zero.bracket[0] and zero.bracket[1] <= span[1]
    moduli, rank_requests = table[MODULI_COLUMN], []
    for left, right in pairs:
        names = [
            name
            for name, zero, _ in zeros
            if name in N_CROSSING_MULTIPLIERS and is_within(zero, (left, right))
        ]
        for rank in find_unexplained_ranks(moduli[left], moduli[right], names):
            rank_requests.append((left, right, rank_quantity_name(rank, rank + 1)))
    if not rank_requests:
        return zeros
    groups: list[list[Any]] = []  # of ranks that may cross at once
    for zero in locate(rank_requests):
        if not vanishes_at(table, zero, tolerances):
            continue
        last_zero = groups[-1][-1] if groups else zero
        is_apart = abs(zero.fraction - last_zero.fraction) > tolerances.equal_location
        if not groups or last_zero.bracket[:2] != zero.bracket[:2] or is_apart:
            groups.append([])
        groups[-1].append(zero)
    first_rank_of = lambda group: int(group[0].bracket[2].split(":")[1])
    mean_requests = []
    for group in groups:
        name = rank_quantity_name(first_rank_of(group), first_rank_of(group) + len(group))
        mean_requests.append((*group[0].bracket[:2], name))
    multiple_zeros = []
    for group, mean_zero in zip(groups, locate(mean_requests), strict=True):
        first, count = first_rank_of(group), len(group)
        distances = np.abs(mean_zero.table[MODULI_COLUMN][0, first : first + count] - 1.0)
        members = [(mean_zero, range(first, first + count))]
        if count > 1 and not np.max(distances) <= multiplier_tolerances.equal_moduli:
            members = [(zero, range(first + i, first + i + 1)) for i, zero in enumerate(group)]
        for zero, ranks in members:
            left_rate, right_rate = fraction_rates[list(zero.bracket[:2])]
            names_and_counts = classify_ranks(
                np.asarray(zero.point_beside.jacobian[0]), ranks, bool(left_rate * right_rate < 0.0)
            )
            multiple_zeros += [(name, zero, n) for name, n in names_and_counts.items()]
    spans = {zero.bracket[:2] for _, zero, _ in multiple_zeros}
    is_replaced = lambda name, zero: (
        name in N_CROSSING_MULTIPLIERS and any(is_within(zero, span) for span in spans)
    )
    return [zero for zero in zeros if not is_replaced(zero[0], zero[1])] + multiple_zeros
