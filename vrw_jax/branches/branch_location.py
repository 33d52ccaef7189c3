"""Continuation of branches and location of their special points, independent of the wheel.

Several branches are continued concurrently, each in both directions. Then the ends of the
admissible points of each branch are located. Finally, every other change of sign between points is
located.
"""

import abc
import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from vrw_jax.branches.branch import FixedPoint, SpecialPoint
from vrw_jax.branches.jumps import continue_beyond_jumps, find_jumps
from vrw_jax.branches.multiplicity import (
    BRANCH_POINT_KIND,
    CONTACT_ORDER_CHANGE,
    CONTACT_ORDER_COLUMN,
    CROSSING_MULTIPLIER_COUNTS,
    MULTIPLIER_MODULI_COLUMN,
    ZERO_TOLERANCES,
    NamedLocatedZero,
    add_multiple_bifurcations,
    are_multipliers_off_circle,
    drop_duplicate_order_changes,
    evaluate_quantity,
    make_contact_order_quantity_name,
    sort_multiplier_moduli,
    vanishes_at_zero,
)
from vrw_jax.continuation import (
    BIFURCATION_NAMES,
    AbstractContinuationProblem,
    ArclengthOptions,
    ConstraintPlane,
    ContinuationPoint,
    ContinuationResult,
    ContinuationStatus,
    arclength,
    continue_many_from,
    evaluate_bifurcation_functions,
    find_sign_changes,
    has_unit_circle_pair,
    locate_zeros,
    solve_many_on_planes,
    solve_on_plane,
)
from vrw_jax.numerics import (
    batch_sizes,
    concatenate_tree_rows,
    map_in_batches,
    map_in_numpy_batches,
    select_tree_rows,
)


@dataclass(frozen=True)
class LocationOptions:
    """Options of the location of special points.

    - `location_accuracy`: width of the bracket in the parameter at which the search ends;
    - `min_bracket_fraction`: smallest width of the bracket as a fraction of the initial bracket,
      chosen because near a fold the parameter varies with the square of the distance;
    - `retry_fractions`: fractions of the distance to an ill-conditioned zero at which the point
      beside the zero is computed again.
    """

    location_accuracy: float = 1e-10
    min_bracket_fraction: float = 1e-6
    retry_fractions: tuple[float, ...] = (0.99, 0.9)


LOCATION_OPTIONS = LocationOptions()
"""Options of the location of special points on all branches."""


ADMISSIBILITY_COLUMN = "sequence"
"""Name of the quantity that is 1 at admissible points and -1 at all others."""

PointQuantities = dict[str, np.ndarray]
"""Quantities by name, each an array over a batch of points."""


@dataclass(frozen=True)
class AbstractContinuation(abc.ABC):
    """Continuation of the gaits of several wheels, with the quantities at its points."""

    problem: AbstractContinuationProblem
    arclength_options: ArclengthOptions
    wheels: Any  # tree with a leading axis over wheels
    parameter_bounds: np.ndarray

    branch_ending_quantities: ClassVar[tuple[str, ...]] = ()
    """Names of the quantities at whose zeros a branch ends because the order of events changes."""

    margin_names: ClassVar[tuple[str, ...]] = ()
    """Names of margins and indicators, whose zeros are border collisions."""

    linear_margin_substitutes: ClassVar[Mapping[str, str]] = {}
    """Names of margins whose zero is ill-conditioned, each with a quantity that vanishes linearly
    at the same point."""

    @abc.abstractmethod
    def evaluate_point_quantities(self, wheels: Any, points: ContinuationPoint) -> PointQuantities:
        """Return the quantities at points that need more than the Jacobian, for one wheel per
        point.
        """

    @abc.abstractmethod
    def are_points_admissible(self, table: PointQuantities) -> np.ndarray:
        """Return whether each point of a table is admissible."""

    def is_margin_name(self, column_name: str) -> bool:
        """Return whether a column's zero is a border collision.

        The name may end with the number of a leg in brackets.
        """
        return column_name.partition("[")[0] in self.margin_names

    def mask_undefined_quantities(
        self, table: PointQuantities, wheel_indices: np.ndarray
    ) -> PointQuantities:
        """Return the table with NaN for quantities that are undefined for the wheel of a point."""
        return table

    def name_branch_end(self, table: PointQuantities, row_index: int) -> str:
        """Return a name for the end of a branch from the first point beyond the end."""
        return ADMISSIBILITY_COLUMN

    def is_same_gait(
        self, table_before: PointQuantities, table_after: PointQuantities
    ) -> np.ndarray:
        """Return whether each point beyond a jump belongs to the branch before the jump."""
        return table_after[ADMISSIBILITY_COLUMN] > 0.0

    def describe_branch_end(self, end_name: str, parameter_value: float) -> str:
        """Return a sentence about the end of a branch.

        The arguments are the name of the special point and the value of the parameter.
        """
        return f"{end_name.replace('_', ' ')} at {parameter_value:.9g} ends it."

    def is_mesh_limited(self, table: PointQuantities, end_names: tuple[str, ...]) -> bool:
        """Return whether the mesh limits the extent or the accuracy of a branch with the given
        ends.
        """
        return False

    def map_over_rows(self, function: Callable, batch_size: int, *row_trees: Any) -> Any:
        """Return the result of a function of rows of NumPy arrays.

        A compiled function is called in batches of rows.
        """
        if self.problem.is_traceable:
            return map_in_numpy_batches(function, (batch_size,), *row_trees)
        return jax.tree.map(
            np.asarray, map_in_batches(function, batch_sizes.LOCATION_BATCH_SIZES, *row_trees)
        )

    def make_table(self, points: ContinuationPoint, wheel_indices: np.ndarray) -> PointQuantities:
        """Return all quantities at each point.

        They include the bifurcation functions and ADMISSIBILITY_COLUMN.
        """
        point_wheels = select_tree_rows(self.wheels, wheel_indices)
        table = self.evaluate_point_quantities(point_wheels, points)
        test_functions = map_in_numpy_batches(
            evaluate_bifurcation_functions, (batch_sizes.POINT_BATCH_SIZE,), points.jacobian
        )
        table |= {
            name: test_functions[:, column_index]
            for column_index, name in enumerate(BIFURCATION_NAMES)
        }
        table = self.mask_undefined_quantities(table, wheel_indices)
        with np.errstate(divide="ignore", invalid="ignore"):
            table[BRANCH_POINT_KIND] = table["fold"] / points.fraction_rate
        table[MULTIPLIER_MODULI_COLUMN] = sort_multiplier_moduli(np.asarray(points.jacobian))
        for name, substitute_name in self.linear_margin_substitutes.items():
            if substitute_name in table and name in table:
                table[_make_combined_margin_name(name)] = combine_margin_with_substitute(
                    table[name], table[substitute_name]
                )
        is_valid = np.asarray(points.is_admissible) & self.are_points_admissible(table)
        return table | {ADMISSIBILITY_COLUMN: np.where(is_valid, 1.0, -1.0)}


def _make_combined_margin_name(name: str) -> str:
    """Return the name of the column that combines a margin with its substitute."""
    return f"{name} for certain"


def combine_margin_with_substitute(
    margin_values: np.ndarray, substitute_values: np.ndarray
) -> np.ndarray:
    """Return a quantity that is positive if a margin and its substitute are positive.

    The quantity crosses zero continuously. If the substitute is negative, the result is the
    substitute.
    """
    return np.where(
        substitute_values < 0.0, substitute_values, np.minimum(substitute_values, margin_values)
    )


def _continue_in_both_directions(
    continuation: AbstractContinuation,
    z: Any,
    parameter_values: Array,
    is_branch_requested: np.ndarray,
) -> ContinuationResult:
    """Continue the branches of all wheels in both directions.

    Return the results with axes (wheel, direction). The first direction leads to smaller values of
    the parameter.
    """
    repeat_for_both_directions = lambda tree: jax.device_put(
        select_tree_rows(tree, np.repeat(np.arange(len(parameter_values)), 2))
    )
    parameter_bounds = jnp.asarray(continuation.parameter_bounds)
    direction_signs = jnp.tile(
        jnp.asarray([-1.0, 1.0], parameter_bounds.dtype), parameter_values.shape[0]
    )
    continuation_arguments = (
        repeat_for_both_directions(continuation.wheels),
        repeat_for_both_directions(z),
        repeat_for_both_directions(parameter_values),
        parameter_bounds,
        direction_signs,
        repeat_for_both_directions(is_branch_requested),
    )
    continue_all = (
        arclength.continue_from if continuation.problem.is_traceable else continue_many_from
    )
    continue_all = functools.partial(
        continue_all, continuation.problem, continuation.arclength_options
    )
    direction_results: ContinuationResult = jax.tree.map(
        np.asarray, continue_all(*continuation_arguments)
    )
    if continuation.problem.has_kinks:
        direction_results = continue_beyond_jumps(
            continuation, continue_all, continuation_arguments[0], direction_results
        )
    return jax.tree.map(lambda x: x.reshape(-1, 2, *x.shape[1:]), direction_results)


@eqx.filter_jit
def _solve_on_chords(
    problem: AbstractContinuationProblem,
    arclength_options: ArclengthOptions,
    parameter_bounds: Array,
    wheels: Any,
    left_points: ContinuationPoint,
    right_points: ContinuationPoint,
    chord_fractions: Array,
) -> tuple[ContinuationPoint, Array]:
    """Return points of a branch between neighboring points, and whether each point was found.

    The new points are at `chord_fractions` in [0, 1] of the chords between neighboring points.
    """

    def solve_one(
        point_wheel: Any,
        left_point: ContinuationPoint,
        right_point: ContinuationPoint,
        chord_fraction: Array,
    ) -> tuple[ContinuationPoint, Array]:
        z, constraint_plane = _make_start_on_chord(
            problem, parameter_bounds, left_point, right_point, chord_fraction
        )
        return solve_on_plane(
            problem, arclength_options, point_wheel, z, constraint_plane, parameter_bounds
        )

    return jax.vmap(solve_one)(wheels, left_points, right_points, chord_fractions)


def _make_start_on_chord(
    problem: AbstractContinuationProblem,
    parameter_bounds: Array,
    left_point: ContinuationPoint,
    right_point: ContinuationPoint,
    chord_fraction: Array,
) -> tuple[Any, ConstraintPlane]:
    """Return the start of a search between neighboring points, and the plane of the solution."""
    z = problem.interpolate(left_point.z, right_point.z, chord_fraction)
    parameter_range = parameter_bounds[1] - parameter_bounds[0]
    chord_section_change = problem.section_state(right_point.z) - problem.section_state(
        left_point.z
    )
    chord_fraction_change = (right_point.p - left_point.p) / parameter_range
    parameter_fraction = (
        left_point.p + chord_fraction * (right_point.p - left_point.p) - parameter_bounds[0]
    ) / parameter_range
    return z, ConstraintPlane(
        problem.section_state(z), parameter_fraction, chord_section_change, chord_fraction_change
    )


_make_starts_on_chords = eqx.filter_jit(
    eqx.filter_vmap(_make_start_on_chord, in_axes=(None, None, 0, 0, 0))
)


def _solve_on_chords_untraced(
    problem: AbstractContinuationProblem,
    arclength_options: ArclengthOptions,
    parameter_bounds: Array,
    wheels: Any,
    left_points: ContinuationPoint,
    right_points: ContinuationPoint,
    chord_fractions: Array,
) -> tuple[ContinuationPoint, Array]:
    """Return the result of `_solve_on_chords` outside of compiled code."""
    z, constraint_planes = _make_starts_on_chords(
        problem, parameter_bounds, left_points, right_points, chord_fractions
    )
    return solve_many_on_planes(
        problem, arclength_options, wheels, z, constraint_planes, parameter_bounds
    )


class _AdmissibleRange(NamedTuple):
    """Admissible points of one wheel's branch, and the first point beyond each end.

    The index of a point that does not exist is -1.
    """

    wheel_index: int
    point_indices: np.ndarray
    beyond_point_indices: tuple[int, int]


class _BranchPointTable(NamedTuple):
    """Points of all wheels in one array, with the points of each wheel in the order of its
    branch.
    """

    points: ContinuationPoint
    wheel_indices: np.ndarray  # index of the wheel of each point
    quantity_table: PointQuantities

    @classmethod
    def from_results(
        cls, continuation: AbstractContinuation, direction_results: ContinuationResult
    ) -> "_BranchPointTable":
        """Return all points of all results.

        The two directions of a wheel are joined at the wheel's start.
        """
        points_by_direction, wheel_indices = [], []
        for wheel_index in range(direction_results.n_points.shape[0]):
            n_toward_lower, n_toward_upper = (
                int(n) for n in direction_results.n_points[wheel_index]
            )
            if n_toward_lower:
                direction_points = select_tree_rows(direction_results.points, (wheel_index, 0))
                direction_points = select_tree_rows(
                    direction_points, np.arange(n_toward_lower)[::-1]
                )
                points_by_direction.append(
                    direction_points._replace(fraction_rate=-direction_points.fraction_rate)
                )
            if n_toward_upper:
                direction_points = select_tree_rows(direction_results.points, (wheel_index, 1))
                points_by_direction.append(
                    select_tree_rows(
                        direction_points, np.arange(1 if n_toward_lower else 0, n_toward_upper)
                    )
                )
            wheel_indices += [wheel_index] * (
                n_toward_lower + max(n_toward_upper - (1 if n_toward_lower else 0), 0)
            )
        if not wheel_indices:
            return cls(
                select_tree_rows(direction_results.points, (0, 0, slice(0, 0))),
                np.zeros(0, int),
                {},
            )
        direction_points = concatenate_tree_rows(*points_by_direction)
        return cls(
            direction_points,
            np.array(wheel_indices),
            continuation.make_table(direction_points, np.array(wheel_indices)),
        )

    def find_neighbor_pairs(self, point_indices: np.ndarray) -> list[tuple[int, int]]:
        """Return the pairs of successive points of `point_indices` that belong to one branch."""
        successive_pairs = zip(point_indices[:-1].tolist(), point_indices[1:].tolist(), strict=True)
        is_same_wheel = lambda i, j: self.wheel_indices[i] == self.wheel_indices[j]
        return [(i, j) for i, j in successive_pairs if is_same_wheel(i, j)]

    def find_admissible_ranges(self, start_positions: Mapping[int, int]) -> list[_AdmissibleRange]:
        """Return the range of admissible points of each wheel that contains the wheel's start."""
        valid_ranges = []
        for wheel_index, start_position in start_positions.items():
            point_indices = np.flatnonzero(self.wheel_indices == wheel_index)
            is_point_admissible = self.quantity_table[ADMISSIBILITY_COLUMN][point_indices] > 0.0
            # A start that is a special point may be beyond the branch's end. Then a neighbor is
            # used.
            admissible_positions = [
                i
                for i in (start_position, start_position + 1, start_position - 1)
                if 0 <= i < len(point_indices) and is_point_admissible[i]
            ]
            if not admissible_positions:
                continue
            start_position = admissible_positions[0]
            first_index = last_index = start_position
            while first_index > 0 and is_point_admissible[first_index - 1]:
                first_index -= 1
            while last_index < len(point_indices) - 1 and is_point_admissible[last_index + 1]:
                last_index += 1
            point_index_below = int(point_indices[first_index - 1]) if first_index > 0 else -1
            point_index_above = (
                int(point_indices[last_index + 1]) if last_index < len(point_indices) - 1 else -1
            )
            valid_ranges.append(
                _AdmissibleRange(
                    wheel_index,
                    point_indices[first_index : last_index + 1],
                    (point_index_below, point_index_above),
                )
            )
        return valid_ranges

    def join_located_ends(
        self,
        valid_ranges: list[_AdmissibleRange],
        located_ends: Mapping[tuple[int, int], "_LocatedZero"],
    ) -> "_BranchPointTable":
        """Return the admissible points of all ranges, joined with the points beside the located
        ends.
        """
        point_groups, wheel_index_groups, quantity_tables = [], [], []

        def append_points(
            new_points: ContinuationPoint, wheel_index: int, new_quantities: PointQuantities
        ) -> None:
            point_groups.append(new_points)
            wheel_index_groups.append(np.full(len(new_points.p), wheel_index))
            quantity_tables.append(new_quantities)

        for valid_range in valid_ranges:
            lower_end, upper_end = (
                located_ends.get((valid_range.wheel_index, end)) for end in (0, 1)
            )
            if lower_end is not None and lower_end.quantities_beside[ADMISSIBILITY_COLUMN][0] > 0.0:
                # The end was located in the opposite direction, so its rates have the opposite
                # sign.
                end_point = lower_end.point_beside
                append_points(
                    end_point._replace(fraction_rate=-end_point.fraction_rate),
                    valid_range.wheel_index,
                    lower_end.quantities_beside
                    | {BRANCH_POINT_KIND: -lower_end.quantities_beside[BRANCH_POINT_KIND]},
                )
            append_points(
                select_tree_rows(self.points, valid_range.point_indices),
                valid_range.wheel_index,
                select_tree_rows(self.quantity_table, valid_range.point_indices),
            )
            if upper_end is not None and upper_end.quantities_beside[ADMISSIBILITY_COLUMN][0] > 0.0:
                append_points(
                    upper_end.point_beside, valid_range.wheel_index, upper_end.quantities_beside
                )
        return _BranchPointTable(
            concatenate_tree_rows(*point_groups),
            np.concatenate(wheel_index_groups),
            concatenate_tree_rows(*quantity_tables),
        )


class _LocatedZero(NamedTuple):
    """Located zero of a quantity between two points of a branch."""

    zero_bracket: tuple[
        int, int, str
    ]  # indices of the left and the right point, name of the quantity
    parameter_value: float  # value of the parameter
    chord_fraction: float  # position on the chord between the points, in [0, 1]
    point_beside: ContinuationPoint  # point on the side of the left point, leading axis 1
    quantities_beside: PointQuantities  # quantities at `point_beside`

    @classmethod
    def from_jump(
        cls, point_table: _BranchPointTable, jump_pair: tuple[int, int]
    ) -> "_LocatedZero":
        """Return the zero at a jump, which is the point of the pair at which the continuation
        stalled.
        """
        i, j = jump_pair
        p, last_index = point_table.points.p, len(point_table.points.p) - 1
        is_jump_at_left = abs(p[i] - p[max(i - 1, 0)]) <= abs(p[min(j + 1, last_index)] - p[j])
        chord_fraction = 0.0 if is_jump_at_left else 1.0
        point_index = i if is_jump_at_left else j
        point_beside, quantities_beside = select_tree_rows(
            (point_table.points, point_table.quantity_table), slice(point_index, point_index + 1)
        )
        return cls(
            (i, j, CONTACT_ORDER_CHANGE),
            float(p[point_index]),
            chord_fraction,
            point_beside,
            quantities_beside,
        )


def _locate_zeros(
    continuation: AbstractContinuation,
    point_table: _BranchPointTable,
    zero_requests: list[tuple[int, int, str]],
    location_options: LocationOptions = LOCATION_OPTIONS,
) -> list[_LocatedZero]:
    """Return the located zero of each request (left point, right point, name of the quantity).

    The quantity has different signs at the two points.
    """
    if not zero_requests:
        return []
    left_indices, right_indices = (
        np.array([request[i] for request in zero_requests]) for i in (0, 1)
    )
    quantity_names = [request[2] for request in zero_requests]
    left_points, right_points = (
        select_tree_rows(point_table.points, left_indices),
        select_tree_rows(point_table.points, right_indices),
    )
    wheel_indices = point_table.wheel_indices[left_indices]
    bracket_wheels = select_tree_rows(continuation.wheels, wheel_indices)
    solve_on_chords = (
        _solve_on_chords if continuation.problem.is_traceable else _solve_on_chords_untraced
    )
    solve_chord_points = functools.partial(
        solve_on_chords,
        continuation.problem,
        continuation.arclength_options,
        jnp.asarray(continuation.parameter_bounds),
    )

    parameter_by_location = {
        (i, 1.0 * end_fraction): end_points.p[i]
        for end_fraction, end_points in enumerate((left_points, right_points))
        for i in range(len(zero_requests))
    }

    def solve_at_fractions(
        chord_fractions: np.ndarray, bracket_indices: np.ndarray
    ) -> tuple[ContinuationPoint, PointQuantities]:
        bracket_rows = select_tree_rows(
            (bracket_wheels, left_points, right_points), bracket_indices
        )
        solved_points, is_found = continuation.map_over_rows(
            solve_chord_points, batch_sizes.LOCATION_BATCH_SIZES[-1], *bracket_rows, chord_fractions
        )
        parameter_by_location.update(
            zip(zip(bracket_indices, chord_fractions, strict=True), solved_points.p, strict=True)
        )
        solved_points = solved_points._replace(is_admissible=solved_points.is_admissible & is_found)
        quantity_table = continuation.make_table(solved_points, wheel_indices[bracket_indices])
        broadcast_flags = lambda flag_values, values: flag_values.reshape(
            -1, *(1,) * (values.ndim - 1)
        )
        return solved_points, {
            name: np.where(broadcast_flags(is_found, values), values, np.nan)
            for name, values in quantity_table.items()
        }

    def evaluate_at_fractions(
        chord_fractions: np.ndarray, bracket_indices: np.ndarray
    ) -> np.ndarray:
        quantity_table = solve_at_fractions(chord_fractions, bracket_indices)[1]
        return np.array(
            [
                evaluate_quantity(quantity_table, quantity_names[bracket_index])[position]
                for position, bracket_index in enumerate(bracket_indices)
            ]
        )

    evaluate_at_points = lambda row_indices: np.array(
        [
            evaluate_quantity(point_table.quantity_table, name)[i]
            for name, i in zip(quantity_names, row_indices, strict=True)
        ]
    )
    parameter_distance = np.maximum(
        np.abs(right_points.p - left_points.p), location_options.location_accuracy
    )
    bracket_tolerances = np.minimum(
        location_options.location_accuracy / parameter_distance,
        location_options.min_bracket_fraction,
    )
    zero_location = locate_zeros(
        evaluate_at_fractions,
        (evaluate_at_points(left_indices), evaluate_at_points(right_indices)),
        bracket_tolerances,
    )
    all_requests = np.arange(len(zero_requests))
    # The point beside the zero is to the left even of an exact zero, so that it is admissible.
    points_beside, quantities_beside = solve_at_fractions(
        np.maximum(zero_location.left_bracket_ends - bracket_tolerances, 0.0), all_requests
    )
    for retry_fraction in location_options.retry_fractions:
        inadmissible_requests = np.flatnonzero(~(quantities_beside[ADMISSIBILITY_COLUMN] > 0.0))
        row_indices = np.arange(len(zero_requests))
        if len(inadmissible_requests):
            retried_points_and_quantities = solve_at_fractions(
                retry_fraction * zero_location.left_bracket_ends[inadmissible_requests],
                inadmissible_requests,
            )
            row_indices[inadmissible_requests] = len(row_indices) + np.arange(
                len(inadmissible_requests)
            )
            points_beside, quantities_beside = select_tree_rows(
                concatenate_tree_rows(
                    (points_beside, quantities_beside), retried_points_and_quantities
                ),
                row_indices,
            )
    return [
        _LocatedZero(
            zero_requests[i],
            float(parameter_by_location[i, zero_location.best_locations[i]]),
            float(zero_location.best_locations[i]),
            select_tree_rows(points_beside, slice(i, i + 1)),
            select_tree_rows(quantities_beside, slice(i, i + 1)),
        )
        for i in range(len(zero_requests))
    ]


def _is_mesh_limited(
    continuation: AbstractContinuation,
    point_table: _BranchPointTable,
    valid_range: _AdmissibleRange,
) -> bool:
    """Return whether the mesh limits a branch whose special points are not located yet."""
    unexplained_ends = [
        i
        for i in valid_range.beyond_point_indices
        if i >= 0 and not _find_crossed_quantities(continuation, point_table, valid_range, i)
    ]
    end_names = tuple(
        continuation.name_branch_end(point_table.quantity_table, i) for i in unexplained_ends
    )
    return continuation.is_mesh_limited(
        select_tree_rows(point_table.quantity_table, valid_range.point_indices), end_names
    )


def _find_crossed_quantities(
    continuation: AbstractContinuation,
    point_table: _BranchPointTable,
    valid_range: _AdmissibleRange,
    beyond_index: int,
) -> list[str]:
    """Return the ending quantities that change sign at the end of a range.

    The signs are compared between the last point of the range and the first point beyond it.
    """
    last_point_index = valid_range.point_indices[
        0 if beyond_index < valid_range.point_indices[0] else -1
    ]
    known_quantity_names = [
        name for name in continuation.branch_ending_quantities if name in point_table.quantity_table
    ]
    return [
        name
        for name in known_quantity_names
        if point_table.quantity_table[name][last_point_index]
        * point_table.quantity_table[name][beyond_index]
        < 0.0
    ]


def _locate_branch_ends(
    continuation: AbstractContinuation,
    point_table: _BranchPointTable,
    valid_ranges: list[_AdmissibleRange],
) -> dict[tuple[int, int], _LocatedZero]:
    """Return the nearest zero at each end of each branch.

    The keys are (index of the wheel, 0 or 1 for the end).
    """
    zero_requests, wheel_and_end_keys = [], []
    for valid_range in valid_ranges:
        for end_index, beyond_index in enumerate(valid_range.beyond_point_indices):
            if beyond_index < 0:
                continue
            last_point_index = int(valid_range.point_indices[0 if end_index == 0 else -1])
            for name in _find_crossed_quantities(
                continuation, point_table, valid_range, beyond_index
            ) or [ADMISSIBILITY_COLUMN]:
                zero_requests.append((last_point_index, beyond_index, name))
                wheel_and_end_keys.append((valid_range.wheel_index, end_index))
    nearest_zeros: dict[tuple[int, int], _LocatedZero] = {}
    for wheel_and_end_key, located_zero in zip(
        wheel_and_end_keys, _locate_zeros(continuation, point_table, zero_requests), strict=True
    ):
        if (
            wheel_and_end_key not in nearest_zeros
            or located_zero.chord_fraction < nearest_zeros[wheel_and_end_key].chord_fraction
        ):
            nearest_zeros[wheel_and_end_key] = located_zero
    return nearest_zeros


def _locate_inner_zeros(
    continuation: AbstractContinuation, point_table: _BranchPointTable
) -> list[NamedLocatedZero]:
    """Return all special points between neighboring points of a branch, without the ends of the
    branch.
    """
    zero_requests, special_point_names = _request_zeros_at_sign_changes(continuation, point_table)
    quantity_table, all_point_indices = (
        point_table.quantity_table,
        np.arange(len(point_table.wheel_indices)),
    )
    fraction_rates = np.asarray(point_table.points.fraction_rate)
    jump_pairs: list[tuple[int, int]] = []
    if continuation.problem.has_kinks:
        section_states = np.asarray(
            jax.vmap(continuation.problem.section_state)(point_table.points.z)
        )
        parameter_fractions = point_table.points.p / (
            continuation.parameter_bounds[1] - continuation.parameter_bounds[0]
        )
        neighbor_pairs = point_table.find_neighbor_pairs(all_point_indices)
        jump_pairs = find_jumps(section_states, parameter_fractions, fraction_rates, neighbor_pairs)
    contact_orders = quantity_table.get(CONTACT_ORDER_COLUMN, np.zeros(len(all_point_indices)))
    for left_index, right_index in point_table.find_neighbor_pairs(all_point_indices):
        if contact_orders[left_index] != contact_orders[right_index]:
            # Other orders may exist between the end of the left order and the start of the right
            # one.
            zero_requests += [
                (left_index, right_index, make_contact_order_quantity_name(contact_orders[i]))
                for i in (left_index, right_index)
            ]
            special_point_names += [CONTACT_ORDER_CHANGE] * 2
    has_jump_between = lambda left_index, right_index: any(
        left_index <= i and j <= right_index for i, j in jump_pairs
    )
    is_without_jump = [
        not has_jump_between(left_index, right_index)
        for left_index, right_index, _ in zero_requests
    ]
    zero_requests = [
        item
        for item, is_selected in zip(zero_requests, is_without_jump, strict=True)
        if is_selected
    ]
    special_point_names = [
        item
        for item, is_selected in zip(special_point_names, is_without_jump, strict=True)
        if is_selected
    ]
    located_zeros = _locate_zeros(continuation, point_table, zero_requests)
    named_zeros = []
    for name, located_zero in zip(special_point_names, located_zeros, strict=True):
        if name in CROSSING_MULTIPLIER_COUNTS and not vanishes_at_zero(
            quantity_table, located_zero
        ):
            continue
        jacobian = np.asarray(located_zero.point_beside.jacobian[0])
        if name != "neimark_sacker" or has_unit_circle_pair(jacobian):
            named_zeros.append((name, located_zero, CROSSING_MULTIPLIER_COUNTS.get(name, 0)))
    named_zeros += [
        (CONTACT_ORDER_CHANGE, _LocatedZero.from_jump(point_table, pair), 0) for pair in jump_pairs
    ]
    off_circle_pairs = point_table.find_neighbor_pairs(
        np.flatnonzero(are_multipliers_off_circle(quantity_table[MULTIPLIER_MODULI_COLUMN]))
    )
    off_circle_pairs = [pair for pair in off_circle_pairs if not has_jump_between(*pair)]
    locate_zeros_between = functools.partial(_locate_zeros, continuation, point_table)
    return add_multiple_bifurcations(
        quantity_table,
        fraction_rates,
        off_circle_pairs,
        drop_duplicate_order_changes(named_zeros),
        locate_zeros_between,
    )


def _request_zeros_at_sign_changes(
    continuation: AbstractContinuation, point_table: _BranchPointTable
) -> tuple[list[tuple[int, int, str]], list[str]]:
    """Return requests (left point, right point, column) for all sign changes.

    The quantities are bifurcation functions and margins. The second result is the name of the
    special point of each request.
    """
    quantity_table = point_table.quantity_table
    skipped_names = (
        ADMISSIBILITY_COLUMN,
        BRANCH_POINT_KIND,
        *continuation.linear_margin_substitutes.values(),
    )
    quantity_names = [
        name
        for name, values in quantity_table.items()
        if values.ndim == 1 and name not in skipped_names
    ]
    quantity_names = [
        name
        for name in quantity_names
        if name in BIFURCATION_NAMES or continuation.is_margin_name(name)
    ]
    column_names = [
        _make_combined_margin_name(name)
        if _make_combined_margin_name(name) in quantity_table
        else name
        for name in quantity_names
    ]
    # At a branch point the sign of the fold's margin is round-off.
    regular_indices = np.flatnonzero(
        ~(np.abs(quantity_table["fold"]) < ZERO_TOLERANCES.max_zero_margin)
    )
    fraction_rates = np.asarray(point_table.points.fraction_rate)
    zero_requests, special_point_names = [], []
    for i, j, column_index in find_sign_changes(
        np.stack([quantity_table[name] for name in column_names], 1)[regular_indices]
    ):
        left_index, right_index, name = (
            int(regular_indices[i]),
            int(regular_indices[j]),
            quantity_names[column_index],
        )
        if point_table.wheel_indices[left_index] == point_table.wheel_indices[right_index]:
            if name == "fold" and fraction_rates[left_index] * fraction_rates[right_index] > 0.0:
                name = BRANCH_POINT_KIND
            zero_requests.append((left_index, right_index, column_names[column_index]))
            special_point_names.append(name)
    for left_index, right_index in point_table.find_neighbor_pairs(regular_indices):
        # On the side branch of a pitchfork the margin touches zero where the parameter turns.
        has_same_fold_sign = (
            quantity_table["fold"][left_index] * quantity_table["fold"][right_index] > 0.0
        )
        if has_same_fold_sign and fraction_rates[left_index] * fraction_rates[right_index] < 0.0:
            zero_requests.append((left_index, right_index, BRANCH_POINT_KIND))
            special_point_names.append(BRANCH_POINT_KIND)
    return zero_requests, special_point_names


class BranchData(NamedTuple):
    """Finished branch of one wheel, before it is labeled."""

    points: ContinuationPoint
    quantity_table: PointQuantities
    special_points: tuple[SpecialPoint, ...]
    end_reasons: tuple[str, str]
    # whether the mesh limits the branch, see `AbstractContinuation.is_mesh_limited`
    is_mesh_limited: bool


MakeCycleFinder = Callable[[int, ContinuationPoint], Callable[[], Any] | None]
"""Function of a wheel's index and a point. It returns a function that finds the limit cycle at the
point."""


def continue_and_locate_points(
    continuation: AbstractContinuation,
    z: Any,
    parameter_values: Array,
    has_start: np.ndarray,
    make_cycle_finder: MakeCycleFinder,
    is_finest_mesh: bool = True,
) -> list[BranchData | None]:
    """Continue branches and locate their special points.

    Return the data of each wheel's branch, or None for a wheel without a start. `z` and
    `parameter_values` are the starts. Unless `is_finest_mesh`, special points of mesh-limited
    branches are not located, because these branches are continued again on a finer mesh.
    """
    direction_results = _continue_in_both_directions(continuation, z, parameter_values, has_start)
    # The first result of a closed curve contains the whole curve.
    is_curve_closed = (direction_results.status == int(ContinuationStatus.CURVE_CLOSED)).all(
        1, keepdims=True
    ) & np.array([True, False])
    point_counts: Any = np.where(is_curve_closed, 0, direction_results.n_points)
    direction_results = direction_results._replace(n_points=point_counts)
    point_table = _BranchPointTable.from_results(continuation, direction_results)
    n_wheels, n_before_start = len(has_start), np.maximum(direction_results.n_points[:, 0] - 1, 0)
    start_indices = {
        wheel_index: int(n_before_start[wheel_index])
        for wheel_index in range(n_wheels)
        if wheel_index in point_table.wheel_indices
    }
    valid_ranges = point_table.find_admissible_ranges(start_indices)
    branch_data_by_wheel: list[BranchData | None] = [None] * n_wheels
    if not is_finest_mesh:
        for valid_range in valid_ranges:
            if _is_mesh_limited(continuation, point_table, valid_range):
                points, branch_quantities = select_tree_rows(
                    (point_table.points, point_table.quantity_table), valid_range.point_indices
                )
                branch_data_by_wheel[valid_range.wheel_index] = BranchData(
                    points, branch_quantities, (), ("", ""), True
                )
        valid_ranges = [
            valid_range
            for valid_range in valid_ranges
            if branch_data_by_wheel[valid_range.wheel_index] is None
        ]
    if not valid_ranges:
        return branch_data_by_wheel
    located_ends = _locate_branch_ends(continuation, point_table, valid_ranges)
    joined_points = point_table.join_located_ends(valid_ranges, located_ends)
    inner_zeros = _locate_inner_zeros(continuation, joined_points)

    def make_special_point(
        name: str,
        located_zero: _LocatedZero,
        wheel_index: int,
        ends_branch: bool,
        n_multipliers: int = 0,
    ) -> SpecialPoint:
        """Return the special point at a located zero."""
        point_beside = select_tree_rows(located_zero.point_beside, 0)
        section_state = np.asarray(
            continuation.problem.section_state(jax.device_put(point_beside.z))
        )
        fixed_point = FixedPoint(section_state, float(point_beside.p), point_beside.jacobian)
        if name == ADMISSIBILITY_COLUMN:
            name = continuation.name_branch_end(
                point_table.quantity_table, located_zero.zero_bracket[1]
            )
        special_point_kind = "border_collision" if continuation.is_margin_name(name) else "lost"
        if name in CROSSING_MULTIPLIER_COUNTS or name == CONTACT_ORDER_CHANGE:
            special_point_kind = name
        return SpecialPoint(
            special_point_kind,
            name,
            located_zero.parameter_value,
            fixed_point,
            ends_branch,
            make_cycle_finder(wheel_index, point_beside),
            n_multipliers,
        )

    for valid_range in valid_ranges:
        point_indices = np.flatnonzero(joined_points.wheel_indices == valid_range.wheel_index)
        points_with_position = [
            (
                located_zero.zero_bracket[0] + located_zero.chord_fraction,
                make_special_point(
                    name, located_zero, valid_range.wheel_index, False, n_multipliers
                ),
            )
            for name, located_zero, n_multipliers in inner_zeros
            if located_zero.zero_bracket[0] in point_indices
        ]
        end_reasons = []
        for end_index in (0, 1):
            located_zero = located_ends.get((valid_range.wheel_index, end_index))
            if located_zero is None:
                end_reasons.append(
                    ContinuationStatus(
                        int(direction_results.status[valid_range.wheel_index, end_index])
                    ).meaning
                )
                continue
            end_point = make_special_point(
                located_zero.zero_bracket[2], located_zero, valid_range.wheel_index, True
            )
            points_with_position.append(
                (point_indices[0] - 1.0 if end_index == 0 else point_indices[-1] + 1.0, end_point)
            )
            end_reasons.append(continuation.describe_branch_end(end_point.name, end_point.value))
        points_with_position.sort(key=lambda pair: pair[0])
        special_points = tuple(special_point for _, special_point in points_with_position)
        branch_quantities = select_tree_rows(joined_points.quantity_table, point_indices)
        end_names = tuple(
            special_point.name for special_point in special_points if special_point.ends_branch
        )
        branch_data_by_wheel[valid_range.wheel_index] = BranchData(
            select_tree_rows(joined_points.points, point_indices),
            branch_quantities,
            special_points,
            (end_reasons[0], end_reasons[1]),
            continuation.is_mesh_limited(branch_quantities, end_names),
        )
    return branch_data_by_wheel
