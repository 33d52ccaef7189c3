"""Bifurcations of several multipliers at once, which no sign of a determinant shows.

Multipliers are ranked by modulus, the largest first. If their number outside the unit circle
changes by more than the bifurcations found between two points account for, the modulus of each
rank that passes 1 is a quantity to locate, and their mean where ranks pass at once.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from vrw_jax.continuation import ON_CIRCLE_TOLERANCE, SMALLEST_ANGLE

BRANCH_POINT_KIND = "branch_point"
"""A multiplier passes 1 but the branch does not turn back: another branch crosses it. There the
equations are singular, and the place is only as good as the steps are short."""

MODULI = "multiplier_moduli"
"""Column of the moduli, ranked."""

CONTACT_ORDER, ORDER_CHANGES = "contact_order", "order_of_contacts_changes"
"""Column that is a number for each order of contacts, and the border where it becomes another."""

ZERO_MARGIN = 1e-11
"""Size of a fold's margin below which its sign is round-off; chosen because a determinant of
numbers of order one is computed to 1e-15, and a point as near to a branch point is a chance."""

SAME_PLACE = 1e-3
"""Share of a bracket within which ranks are taken to pass at once at first; chosen because three
equal multipliers are computed to 1e-5, which is 1e-4 of a bracket."""

SAME_MODULUS = 1e-6
"""Distance from modulus 1 of ranks that pass at once; chosen as for `ON_CIRCLE_TOLERANCE`."""

LARGEST_SHARE_LEFT = 0.2
"""Share of its value at a bracket's end that may be left of a quantity beside its zero: at a jump
more is left. Chosen because a point may be found at nine tenths of the way only."""

Found = tuple[str, Any, int]
"""Name of a border, its zero, and how many multipliers pass the unit circle there."""

ORDER_ACCURACY = 1e-7
"""Relative distance below which two changes of the order of contacts are one; chosen because both
searches may end beside it by the parameter's change over one shortest step."""

WEIGHTS = {"fold": 1, BRANCH_POINT_KIND: 1, "period_doubling": 1, "neimark_sacker": 2}
"""Multipliers that pass the unit circle at a bifurcation."""


def moduli_of(jacobians: np.ndarray) -> np.ndarray:
    """Return the moduli of the multipliers, ranked; NaN for a matrix that is not finite."""
    finite = np.isfinite(jacobians).all((-1, -2))
    values = np.abs(np.linalg.eigvals(np.where(finite[..., None, None], jacobians, 0.0)))
    return np.where(finite[..., None], np.sort(values, -1)[..., ::-1], np.nan)


def name_ranks(first: int, last: int) -> str:
    """Return the name of the quantity that is zero where ranks first … last - 1 pass 1 at once."""
    return f"{MODULI}:{first}:{last}"


def name_order(order: float) -> str:
    """Return the name of the quantity that is positive where contacts come in this order."""
    return f"{CONTACT_ORDER}:{int(order)}"


def quantity_of(table: dict[str, np.ndarray], name: str) -> np.ndarray:
    """Return a column of a table, or a quantity of `name_ranks` or `name_order`."""
    if name.startswith(CONTACT_ORDER + ":"):
        order = table[CONTACT_ORDER]
        sign = np.where(order == int(name.split(":")[1]), 1.0, -1.0)
        return np.where(np.isnan(order), np.nan, sign)
    if not name.startswith(MODULI + ":"):
        return table[name]
    first, last = map(int, name.split(":")[1:])
    return np.asarray(np.mean(table[MODULI][:, first:last], -1) - 1.0)


def is_off_circle(moduli: np.ndarray) -> np.ndarray:
    """Return for which points every multiplier is surely inside or outside the unit circle."""
    return np.asarray((np.abs(moduli - 1.0) > ON_CIRCLE_TOLERANCE).all(-1))


def ranks_left_over(before: np.ndarray, after: np.ndarray, names: list[str]) -> range:
    """Return the ranks that pass 1 between two points if the bifurcations `names` miss some."""
    first, last = sorted(int(np.sum(moduli > 1.0)) for moduli in (before, after))
    explained = last - first <= sum(WEIGHTS[name] for name in names)
    return range(0) if explained else range(first, last)


def kinds_of(jacobian: np.ndarray, ranks: range, turns_back: bool) -> dict[str, int]:
    """Return which bifurcations ranks on the unit circle are, with how many multipliers."""
    values = np.linalg.eigvals(jacobian)
    values = values[np.argsort(-np.abs(values), kind="stable")][list(ranks)]
    is_pair = np.abs(values.imag) > SMALLEST_ANGLE
    at_one = "fold" if turns_back else BRANCH_POINT_KIND
    counts = {
        at_one: int(np.sum(~is_pair & (values.real > 0.0))),
        "period_doubling": int(np.sum(~is_pair & (values.real < 0.0))),
        "neimark_sacker": int(np.sum(is_pair)),
    }
    return {kind: count for kind, count in counts.items() if count}


def is_zero(table: dict[str, np.ndarray], zero: Any) -> bool:
    """Return whether a quantity vanishes at its zero; else it jumps there."""
    left, right, name = zero.bracket
    ends = quantity_of(table, name)[[left, right]]
    beside = float(np.abs(quantity_of(zero.table, name)[0]))
    return not beside > LARGEST_SHARE_LEFT * float(np.max(np.abs(ends)))


def drop_twins(zeros: list[Found]) -> list[Found]:
    """Return the borders without those found both as an order's end and as the next one's begin."""
    kept: list[Found] = []
    for name, zero, count in zeros:
        twins = [z for n, z, _ in kept if n == name == ORDER_CHANGES]
        twins = [z for z in twins if z.bracket[:2] == zero.bracket[:2]]
        if not any(abs(zero.value - z.value) <= ORDER_ACCURACY * abs(z.value) for z in twins):
            kept.append((name, zero, count))
    return kept


def with_ranks(
    table: dict[str, np.ndarray],
    share_slopes: np.ndarray,
    pairs: list[tuple[int, int]],
    zeros: list[Found],
    locate: Callable[[list[tuple[int, int, str]]], list[Any]],
) -> list[Found]:
    """Return the borders with bifurcations of several multipliers in place of what misses some.

    `pairs` are neighbours on a branch, `locate` finds zeros of quantities between them.
    """
    within = lambda zero, span: span[0] <= zero.bracket[0] and zero.bracket[1] <= span[1]
    moduli, alone = table[MODULI], []
    for left, right in pairs:
        names = [name for name, z, _ in zeros if name in WEIGHTS and within(z, (left, right))]
        for rank in ranks_left_over(moduli[left], moduli[right], names):
            alone.append((left, right, name_ranks(rank, rank + 1)))
    if not alone:
        return zeros
    groups: list[list[Any]] = []
    for zero in locate(alone):
        if not is_zero(table, zero):
            continue
        last = groups[-1][-1] if groups else zero
        apart = abs(zero.fraction - last.fraction) > SAME_PLACE
        if not groups or last.bracket[:2] != zero.bracket[:2] or apart:
            groups.append([])
        groups[-1].append(zero)
    span = lambda group: (int(group[0].bracket[2].split(":")[1]), len(group))
    several = [
        (*group[0].bracket[:2], name_ranks(span(group)[0], sum(span(group)))) for group in groups
    ]
    found = []
    for group, mean in zip(groups, locate(several), strict=True):
        first, count = span(group)
        off = np.abs(mean.table[MODULI][0, first : first + count] - 1.0)
        members = [(mean, range(first, first + count))]
        if count > 1 and not np.max(off) <= SAME_MODULUS:
            members = [(zero, range(first + i, first + i + 1)) for i, zero in enumerate(group)]
        for zero, ranks in members:
            slopes = share_slopes[list(zero.bracket[:2])]
            kinds = kinds_of(
                np.asarray(zero.point_beside.jacobian[0]), ranks, bool(slopes[0] * slopes[1] < 0.0)
            )
            found += [(kind, zero, count) for kind, count in kinds.items()]
    spans = {zero.bracket[:2] for _, zero, _ in found}
    is_missed = lambda name, zero: name in WEIGHTS and any(within(zero, span) for span in spans)
    return [z for z in zeros if not is_missed(z[0], z[1])] + found
