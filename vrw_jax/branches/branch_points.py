"""Define tables of the points of branches, and the roots that are located between these points."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from vrw_jax.branches.arclength import ContinuationPoint

BRANCH_POINT_KIND = "branch_point"
"""Kind of a special point at which a multiplier is 1 but the branch does not turn back.

Another branch crosses at this point, and the equations are singular. The length of the continuation
step limits the accuracy of the location.
"""

ADMISSIBILITY_COLUMN = "sequence"
"""Name of the quantity that is 1 at admissible points and -1 at all other points."""

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

CROSSING_MULTIPLIER_COUNTS = {
    "fold": 1,
    BRANCH_POINT_KIND: 1,
    "period_doubling": 1,
    "neimark_sacker": 2,
}
"""Number of multipliers that cross the unit circle, by the name of the bifurcation."""

QuantitiesByName = dict[str, np.ndarray]
"""Arrays of quantities with one element per point, by the name of the quantity."""


class BranchPointTable(NamedTuple):
    """Points of branches with their quantities, in the order of each wheel's branch.

    Each array has a leading axis over the points, so that `select_tree_rows` and
    `concatenate_tree_rows` apply to the whole table.
    """

    points: ContinuationPoint
    wheel_indices: np.ndarray  # index of the wheel to which each point belongs
    quantity_table: QuantitiesByName

    def reverse_direction(self) -> "BranchPointTable":
        """Return the table with the rates along the branch in the opposite direction."""
        reversed_quantity = {BRANCH_POINT_KIND: -self.quantity_table[BRANCH_POINT_KIND]}
        return self._replace(
            points=self.points._replace(fraction_rate=-self.points.fraction_rate),
            quantity_table=self.quantity_table | reversed_quantity,
        )

    def find_neighbor_pairs(self, point_indices: np.ndarray) -> list[tuple[int, int]]:
        """Return the pairs of successive points in `point_indices` that belong to the
        same branch.
        """
        successive_pairs = zip(point_indices[:-1].tolist(), point_indices[1:].tolist(), strict=True)
        is_same_wheel = lambda i, j: self.wheel_indices[i] == self.wheel_indices[j]
        return [(i, j) for i, j in successive_pairs if is_same_wheel(i, j)]


class RootRequest(NamedTuple):
    """Request to locate the root of a quantity between two points of a branch."""

    point_pair: tuple[int, int]  # indices of the left and the right point
    special_point_name: str  # name of the special point at the root
    # returns the quantity at each point of a table; it has opposite signs at the two points
    evaluate_quantity: Callable[[QuantitiesByName], np.ndarray]
    # ranks of the multipliers whose moduli the quantity combines
    multiplier_ranks: range = range(0)


# Largest ratio of the quantity next to its root to the quantity at an end of the bracket; at a jump
# the ratio is larger. The value is chosen because the point next to the root may be at nine tenths
# of the distance to the root.
MAX_VALUE_BESIDE_ROOT = 0.2


class LocatedRoot(NamedTuple):
    """Located root of a quantity between two points of a branch."""

    request: RootRequest
    special_point_name: str
    n_multipliers: int  # number of multipliers that cross the unit circle, 0 for other kinds
    parameter_value: float  # value of the continued parameter at the root
    chord_fraction: float  # location of the root on the chord from the left to the right point
    table_beside_root: BranchPointTable  # the point on the side of the left point

    @property
    def return_map_jacobian(self) -> np.ndarray:
        """Return the Jacobian of the return map at the point next to the root."""
        return np.asarray(self.table_beside_root.points.return_map_jacobian[0])

    def vanishes_at_root(self, quantity_table: QuantitiesByName) -> bool:
        """Return whether the quantity vanishes at its root. Otherwise it jumps there.

        - `quantity_table`: quantities of the branch on which the root is located.
        """
        evaluate_quantity = self.request.evaluate_quantity
        (value_beside_root,) = np.abs(evaluate_quantity(self.table_beside_root.quantity_table))
        max_value_beside_root = MAX_VALUE_BESIDE_ROOT * np.max(
            np.abs(evaluate_quantity(quantity_table)[list(self.request.point_pair)])
        )
        return not value_beside_root > max_value_beside_root


def compare_with_integer(
    stepwise_quantity_name: str, integer_value: float, quantity_table: QuantitiesByName
) -> np.ndarray:
    """Return 1 for each point at which a stepwise quantity has the given value, and else -1.

    - `stepwise_quantity_name`: name of the quantity, one of `STEPWISE_CHANGE_NAMES`.
    """
    integer_values = quantity_table[stepwise_quantity_name]
    equality_sign = np.where(integer_values == integer_value, 1.0, -1.0)
    return np.where(np.isnan(integer_values), np.nan, equality_sign)


# Relative distance below which two changes of a stepwise quantity are the same change. The value is
# chosen because two searches may differ by the change of the parameter over the shortest
# continuation step.
MAX_EQUAL_PARAMETER_DISTANCE = 1e-7


def drop_duplicate_changes(located_roots: list[LocatedRoot]) -> list[LocatedRoot]:
    """Return the roots, with each change of a stepwise quantity only once.

    Each change is located twice, as the end of one value and as the start of the next value. A
    change of the number of force peaks is omitted at a zero of the second peak's rate.
    """

    def is_same_change(root: LocatedRoot, earlier_root: LocatedRoot) -> bool:
        name, earlier_name = root.special_point_name, earlier_root.special_point_name
        has_same_kind = name == earlier_name in STEPWISE_CHANGE_NAMES.values() or (
            (name, earlier_name) == (FORCE_PEAK_COUNT_CHANGE, SECOND_PEAK_RATE_NAME)
        )
        max_distance = MAX_EQUAL_PARAMETER_DISTANCE * abs(earlier_root.parameter_value)
        return (
            has_same_kind
            and root.request.point_pair == earlier_root.request.point_pair
            and abs(root.parameter_value - earlier_root.parameter_value) <= max_distance
        )

    distinct_roots: list[LocatedRoot] = []
    for root in located_roots:
        if not any(is_same_change(root, earlier_root) for earlier_root in distinct_roots):
            distinct_roots.append(root)
    return distinct_roots
