"""Continuation of branches and location of their special points, independent of the wheel.

Several branches are continued concurrently, each in both directions. Then their ends are located,
at which they stop being admissible. Finally, every other change of sign on them is located.
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
    MODULI_COLUMN,
    N_CROSSING_MULTIPLIERS,
    ZERO_TOLERANCES,
    NamedZero,
    add_multiple_bifurcations,
    contact_order_quantity_name,
    drop_duplicate_order_changes,
    evaluate_quantity,
    is_off_circle,
    rank_moduli,
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
    concat_rows,
    map_in_batches,
    map_in_numpy_batches,
    take_rows,
)


@dataclass(frozen=True)
class LocationOptions:
    """Options of the location of special points.

    - `accuracy`: width of the bracket in the parameter at which the search ends;
    - `min_bracket_fraction`: that width as a fraction of the initial bracket, chosen because near a
      fold the parameter varies with the square of the distance;
    - `retry_fractions`: fractions of the distance to an ill-conditioned zero at which the point
      beside it is computed again.
    """

    accuracy: float = 1e-10
    min_bracket_fraction: float = 1e-6
    retry_fractions: tuple[float, ...] = (0.99, 0.9)


LOCATION_OPTIONS = LocationOptions()
"""Options of the location of special points on all branches."""


ADMISSIBLE_COLUMN = "sequence"
"""Name of the column that is 1 if a point is admissible, else -1."""

QuantityTable = dict[str, np.ndarray]
"""Table of quantities by name, each an array over a batch of points."""


@dataclass(frozen=True)
class AbstractContinuation(abc.ABC):
    """Continuation of the gaits of several wheels, with the quantities that are evaluated at its
    points.
    """

    problem: AbstractContinuationProblem
    options: ArclengthOptions
    wheels: Any  # tree with a leading axis over wheels
    bounds: np.ndarray

    ending_quantities: ClassVar[tuple[str, ...]] = ()
    """Names of the columns at whose zeros a branch ends because the order of events changes."""

    margin_names: ClassVar[tuple[str, ...]] = ()
    """Names of margins and indicators, whose zeros are border collisions."""

    linear_substitutes: ClassVar[Mapping[str, str]] = {}
    """Names of margins whose zero is ill-conditioned, each with the column that vanishes at the
    same point.
    """

    @abc.abstractmethod
    def evaluate_points(self, wheels: Any, points: ContinuationPoint) -> QuantityTable:
        """Return the quantities at points that need more than the Jacobian, for one wheel per
        point.
        """

    @abc.abstractmethod
    def is_admissible(self, table: QuantityTable) -> np.ndarray:
        """Return whether each point of a table is admissible."""

    def is_margin(self, name: str) -> bool:
        """Return whether a column's zero is a border collision; the name may end with the number
        of a leg.
        """
        return name.partition("[")[0] in self.margin_names

    def mask_undefined(self, table: QuantityTable, wheel_indices: np.ndarray) -> QuantityTable:
        """Return the table with NaN for quantities that are undefined for the wheel of a point."""
        return table

    def name_end(self, table: QuantityTable, row_index: int) -> str:
        """Return a name for the end of a branch from the first point beyond it."""
        return ADMISSIBLE_COLUMN

    def is_same_gait(self, table_before: QuantityTable, table_after: QuantityTable) -> np.ndarray:
        """Return whether each point beyond a jump belongs to the branch before the jump."""
        return table_after[ADMISSIBLE_COLUMN] > 0.0

    def describe_end(self, name: str, value: float) -> str:
        """Return a sentence about an end of a branch from the name of its special point and the
        parameter's value.
        """
        return f"{name.replace('_', ' ')} at {value:.9g} ends it."

    def is_mesh_limited(self, table: QuantityTable, ends: tuple[str, ...]) -> bool:
        """Return whether the mesh limits the extent or the accuracy of a branch with these ends."""
        return False

    def map_batched(self, function: Callable, batch_size: int, *trees: Any) -> Any:
        """Return a function of rows of NumPy arrays, computed in batches if the function is
        compiled.
        """
        if self.problem.is_traceable:
            return map_in_numpy_batches(function, (batch_size,), *trees)
        return jax.tree.map(
            np.asarray, map_in_batches(function, batch_sizes.LOCATION_BATCH_SIZES, *trees)
        )

    def make_table(self, points: ContinuationPoint, wheel_indices: np.ndarray) -> QuantityTable:
        """Return all quantities at each point, with bifurcation functions and ADMISSIBLE_COLUMN."""
        wheels = take_rows(self.wheels, wheel_indices)
        table = self.evaluate_points(wheels, points)
        test_functions = map_in_numpy_batches(
            evaluate_bifurcation_functions, (batch_sizes.POINT_BATCH_SIZE,), points.jacobian
        )
        table |= {
            name: test_functions[:, column_index]
            for column_index, name in enumerate(BIFURCATION_NAMES)
        }
        table = self.mask_undefined(table, wheel_indices)
        with np.errstate(divide="ignore", invalid="ignore"):
            table[BRANCH_POINT_KIND] = table["fold"] / points.fraction_rate
        table[MODULI_COLUMN] = rank_moduli(np.asarray(points.jacobian))
        for name, substitute in self.linear_substitutes.items():
            if substitute in table and name in table:
                table[_combined_margin_name(name)] = combine_margin_with_substitute(
                    table[name], table[substitute]
                )
        is_valid = np.asarray(points.is_admissible) & self.is_admissible(table)
        return table | {ADMISSIBLE_COLUMN: np.where(is_valid, 1.0, -1.0)}


def _combined_margin_name(name: str) -> str:
    """Return the name of the column that combines a margin with its substitute."""
    return f"{name} for certain"


def combine_margin_with_substitute(margin: np.ndarray, substitute: np.ndarray) -> np.ndarray:
    """Return a quantity that is positive if a margin and its substitute are, and crosses zero
    continuously.

    If `substitute` is negative, the result equals it.
    """
    return np.where(substitute < 0.0, substitute, np.minimum(substitute, margin))


def _continue_both_ways(
    continuation: AbstractContinuation, z: Any, parameter_values: Array, is_requested: np.ndarray
) -> ContinuationResult:
    """Continue the branches of all wheels in both directions, and return the results, axes (wheel,
    direction).

    The first direction leads to smaller values of the parameter.
    """
    repeat_for_directions = lambda tree: jax.device_put(
        take_rows(tree, np.repeat(np.arange(len(parameter_values)), 2))
    )
    bounds = jnp.asarray(continuation.bounds)
    directions = jnp.tile(jnp.asarray([-1.0, 1.0], bounds.dtype), parameter_values.shape[0])
    arguments = (
        repeat_for_directions(continuation.wheels),
        repeat_for_directions(z),
        repeat_for_directions(parameter_values),
        bounds,
        directions,
        repeat_for_directions(is_requested),
    )
    continue_all = (
        arclength.continue_from if continuation.problem.is_traceable else continue_many_from
    )
    continue_all = functools.partial(continue_all, continuation.problem, continuation.options)
    results: ContinuationResult = jax.tree.map(np.asarray, continue_all(*arguments))
    if continuation.problem.has_kinks:
        results = continue_beyond_jumps(continuation, continue_all, arguments[0], results)
    return jax.tree.map(lambda x: x.reshape(-1, 2, *x.shape[1:]), results)


@eqx.filter_jit
def _solve_between(
    problem: AbstractContinuationProblem,
    options: ArclengthOptions,
    bounds: Array,
    wheels: Any,
    left: ContinuationPoint,
    right: ContinuationPoint,
    fractions: Array,
) -> tuple[ContinuationPoint, Array]:
    """Return points of a branch between neighboring points, at `fractions` in [0, 1] of their
    chord.

    The second result states whether each point was found.
    """

    def solve_one(
        wheel: Any, left: ContinuationPoint, right: ContinuationPoint, fraction: Array
    ) -> tuple[ContinuationPoint, Array]:
        z, plane = _make_start_between(problem, bounds, left, right, fraction)
        return solve_on_plane(problem, options, wheel, z, plane, bounds)

    return jax.vmap(solve_one)(wheels, left, right, fractions)


def _make_start_between(
    problem: AbstractContinuationProblem,
    bounds: Array,
    left: ContinuationPoint,
    right: ContinuationPoint,
    fraction: Array,
) -> tuple[Any, ConstraintPlane]:
    """Return the start of a search between neighboring points, and the plane that contains the
    solution.
    """
    z = problem.interpolate(left.z, right.z, fraction)
    parameter_range = bounds[1] - bounds[0]
    normal_section = problem.section_state(right.z) - problem.section_state(left.z)
    normal_fraction = (right.p - left.p) / parameter_range
    parameter_fraction = (left.p + fraction * (right.p - left.p) - bounds[0]) / parameter_range
    return z, ConstraintPlane(
        problem.section_state(z), parameter_fraction, normal_section, normal_fraction
    )


_make_starts_between = eqx.filter_jit(
    eqx.filter_vmap(_make_start_between, in_axes=(None, None, 0, 0, 0))
)


def _solve_between_untraced(
    problem: AbstractContinuationProblem,
    options: ArclengthOptions,
    bounds: Array,
    wheels: Any,
    left: ContinuationPoint,
    right: ContinuationPoint,
    fractions: Array,
) -> tuple[ContinuationPoint, Array]:
    """Return the result of `_solve_between` outside of compiled code."""
    z, planes = _make_starts_between(problem, bounds, left, right, fractions)
    return solve_many_on_planes(problem, options, wheels, z, planes, bounds)


class _ValidRange(NamedTuple):
    """Admissible points of one wheel's branch, and the first point beyond each end, -1 if there
    is none.
    """

    wheel_index: int
    point_indices: np.ndarray
    beyond_indices: tuple[int, int]


class _PointTable(NamedTuple):
    """Points of all wheels in one array, each wheel's in the order of its branch."""

    points: ContinuationPoint
    wheel_indices: np.ndarray  # index of the wheel of each point
    table: QuantityTable

    @classmethod
    def from_results(
        cls, continuation: AbstractContinuation, results: ContinuationResult
    ) -> "_PointTable":
        """Return all points of all results; the two directions of a wheel are joined at its
        start.
        """
        point_groups, wheel_indices = [], []
        for wheel_index in range(results.n_points.shape[0]):
            n_toward_lower, n_toward_upper = (int(n) for n in results.n_points[wheel_index])
            if n_toward_lower:
                points = take_rows(results.points, (wheel_index, 0))
                points = take_rows(points, np.arange(n_toward_lower)[::-1])
                point_groups.append(points._replace(fraction_rate=-points.fraction_rate))
            if n_toward_upper:
                points = take_rows(results.points, (wheel_index, 1))
                point_groups.append(
                    take_rows(points, np.arange(1 if n_toward_lower else 0, n_toward_upper))
                )
            wheel_indices += [wheel_index] * (
                n_toward_lower + max(n_toward_upper - (1 if n_toward_lower else 0), 0)
            )
        if not wheel_indices:
            return cls(take_rows(results.points, (0, 0, slice(0, 0))), np.zeros(0, int), {})
        points = concat_rows(*point_groups)
        return cls(
            points,
            np.array(wheel_indices),
            continuation.make_table(points, np.array(wheel_indices)),
        )

    def find_neighbor_pairs(self, point_indices: np.ndarray) -> list[tuple[int, int]]:
        """Return the pairs of successive points of `point_indices` that belong to one branch."""
        pairs = zip(point_indices[:-1].tolist(), point_indices[1:].tolist(), strict=True)
        is_same_wheel = lambda i, j: self.wheel_indices[i] == self.wheel_indices[j]
        return [(i, j) for i, j in pairs if is_same_wheel(i, j)]

    def find_valid_ranges(self, starts: Mapping[int, int]) -> list[_ValidRange]:
        """Return the range of admissible points of each wheel that contains its start."""
        ranges = []
        for wheel_index, start_position in starts.items():
            point_indices = np.flatnonzero(self.wheel_indices == wheel_index)
            is_valid = self.table[ADMISSIBLE_COLUMN][point_indices] > 0.0
            # If the start is a special point, it may be beyond the branch's end; then a neighbor is
            # used.
            start_candidates = [
                i
                for i in (start_position, start_position + 1, start_position - 1)
                if 0 <= i < len(point_indices) and is_valid[i]
            ]
            if not start_candidates:
                continue
            start_position = start_candidates[0]
            first_index = last_index = start_position
            while first_index > 0 and is_valid[first_index - 1]:
                first_index -= 1
            while last_index < len(point_indices) - 1 and is_valid[last_index + 1]:
                last_index += 1
            index_below = int(point_indices[first_index - 1]) if first_index > 0 else -1
            index_above = (
                int(point_indices[last_index + 1]) if last_index < len(point_indices) - 1 else -1
            )
            ranges.append(
                _ValidRange(
                    wheel_index,
                    point_indices[first_index : last_index + 1],
                    (index_below, index_above),
                )
            )
        return ranges

    def join_ends(
        self,
        ranges: list[_ValidRange],
        located_ends: Mapping[tuple[int, int], "_LocatedZero"],
    ) -> "_PointTable":
        """Return the admissible points of all ranges, joined with the points beside the located
        ends.
        """
        points, wheel_indices, tables = [], [], []

        def append_points(
            new_points: ContinuationPoint, wheel_index: int, table: QuantityTable
        ) -> None:
            points.append(new_points)
            wheel_indices.append(np.full(len(new_points.p), wheel_index))
            tables.append(table)

        for valid_range in ranges:
            lower_end, upper_end = (
                located_ends.get((valid_range.wheel_index, end)) for end in (0, 1)
            )
            if lower_end is not None and lower_end.table[ADMISSIBLE_COLUMN][0] > 0.0:
                # The end was located in the opposite direction, so its rates have the opposite
                # sign.
                point = lower_end.point_beside
                append_points(
                    point._replace(fraction_rate=-point.fraction_rate),
                    valid_range.wheel_index,
                    lower_end.table | {BRANCH_POINT_KIND: -lower_end.table[BRANCH_POINT_KIND]},
                )
            append_points(
                take_rows(self.points, valid_range.point_indices),
                valid_range.wheel_index,
                take_rows(self.table, valid_range.point_indices),
            )
            if upper_end is not None and upper_end.table[ADMISSIBLE_COLUMN][0] > 0.0:
                append_points(upper_end.point_beside, valid_range.wheel_index, upper_end.table)
        return _PointTable(
            concat_rows(*points), np.concatenate(wheel_indices), concat_rows(*tables)
        )


class _LocatedZero(NamedTuple):
    """Located zero of a quantity between two points of a branch."""

    bracket: tuple[int, int, str]  # indices of the left and the right point, name of the quantity
    value: float  # value of the parameter
    fraction: float  # position on the chord between the points, in [0, 1]
    point_beside: ContinuationPoint  # point on the side of the left point, leading axis 1
    table: QuantityTable  # quantities at `point_beside`

    @classmethod
    def at_jump(cls, point_table: _PointTable, pair: tuple[int, int]) -> "_LocatedZero":
        """Return the zero at a jump, which is the point of the pair at which the continuation
        stalled.
        """
        i, j = pair
        p, last_index = point_table.points.p, len(point_table.points.p) - 1
        is_left = abs(p[i] - p[max(i - 1, 0)]) <= abs(p[min(j + 1, last_index)] - p[j])
        fraction = 0.0 if is_left else 1.0
        point_index = i if is_left else j
        point, table = take_rows(
            (point_table.points, point_table.table), slice(point_index, point_index + 1)
        )
        return cls((i, j, CONTACT_ORDER_CHANGE), float(p[point_index]), fraction, point, table)


def _locate_zeros(
    continuation: AbstractContinuation,
    point_table: _PointTable,
    requests: list[tuple[int, int, str]],
    options: LocationOptions = LOCATION_OPTIONS,
) -> list[_LocatedZero]:
    """Return the located zero of each request (left point, right point, name of the quantity).

    The quantity has different signs at the two points.
    """
    if not requests:
        return []
    left_indices, right_indices = (np.array([request[i] for request in requests]) for i in (0, 1))
    names = [request[2] for request in requests]
    left_points, right_points = (
        take_rows(point_table.points, left_indices),
        take_rows(point_table.points, right_indices),
    )
    wheel_indices = point_table.wheel_indices[left_indices]
    wheels = take_rows(continuation.wheels, wheel_indices)
    solve_points = _solve_between if continuation.problem.is_traceable else _solve_between_untraced
    solve_between = functools.partial(
        solve_points, continuation.problem, continuation.options, jnp.asarray(continuation.bounds)
    )

    parameter_by_location = {
        (i, 1.0 * end_fraction): end_points.p[i]
        for end_fraction, end_points in enumerate((left_points, right_points))
        for i in range(len(requests))
    }

    def solve_at_fractions(
        fractions: np.ndarray, bracket_indices: np.ndarray
    ) -> tuple[ContinuationPoint, QuantityTable]:
        bracket_data = take_rows((wheels, left_points, right_points), bracket_indices)
        points, is_found = continuation.map_batched(
            solve_between, batch_sizes.LOCATION_BATCH_SIZES[-1], *bracket_data, fractions
        )
        parameter_by_location.update(
            zip(zip(bracket_indices, fractions, strict=True), points.p, strict=True)
        )
        points = points._replace(is_admissible=points.is_admissible & is_found)
        table = continuation.make_table(points, wheel_indices[bracket_indices])
        match_axes = lambda flags, values: flags.reshape(-1, *(1,) * (values.ndim - 1))
        return points, {
            name: np.where(match_axes(is_found, values), values, np.nan)
            for name, values in table.items()
        }

    def evaluate_at_fractions(fractions: np.ndarray, bracket_indices: np.ndarray) -> np.ndarray:
        table = solve_at_fractions(fractions, bracket_indices)[1]
        return np.array(
            [
                evaluate_quantity(table, names[bracket_index])[position]
                for position, bracket_index in enumerate(bracket_indices)
            ]
        )

    evaluate_at_points = lambda selected_indices: np.array(
        [
            evaluate_quantity(point_table.table, name)[i]
            for name, i in zip(names, selected_indices, strict=True)
        ]
    )
    parameter_distance = np.maximum(np.abs(right_points.p - left_points.p), options.accuracy)
    tolerances = np.minimum(options.accuracy / parameter_distance, options.min_bracket_fraction)
    location = locate_zeros(
        evaluate_at_fractions,
        (evaluate_at_points(left_indices), evaluate_at_points(right_indices)),
        tolerances,
    )
    all_indices = np.arange(len(requests))
    # The point beside is to the left even of an exact zero, so that it is still admissible.
    points_beside, table = solve_at_fractions(
        np.maximum(location.left_end - tolerances, 0.0), all_indices
    )
    for retry_fraction in options.retry_fractions:
        failed_indices = np.flatnonzero(~(table[ADMISSIBLE_COLUMN] > 0.0))
        selected_indices = np.arange(len(requests))
        if len(failed_indices):
            retried_points = solve_at_fractions(
                retry_fraction * location.left_end[failed_indices], failed_indices
            )
            selected_indices[failed_indices] = len(selected_indices) + np.arange(
                len(failed_indices)
            )
            points_beside, table = take_rows(
                concat_rows((points_beside, table), retried_points), selected_indices
            )
    return [
        _LocatedZero(
            requests[i],
            float(parameter_by_location[i, location.best[i]]),
            float(location.best[i]),
            take_rows(points_beside, slice(i, i + 1)),
            take_rows(table, slice(i, i + 1)),
        )
        for i in range(len(requests))
    ]


def _is_mesh_limited(
    continuation: AbstractContinuation, point_table: _PointTable, valid_range: _ValidRange
) -> bool:
    """Return whether the mesh limits a branch whose special points are not located yet."""
    lost_indices = [
        i
        for i in valid_range.beyond_indices
        if i >= 0 and not _find_crossings(continuation, point_table, valid_range, i)
    ]
    names = tuple(continuation.name_end(point_table.table, i) for i in lost_indices)
    return continuation.is_mesh_limited(
        take_rows(point_table.table, valid_range.point_indices), names
    )


def _find_crossings(
    continuation: AbstractContinuation,
    point_table: _PointTable,
    valid_range: _ValidRange,
    beyond_index: int,
) -> list[str]:
    """Return the ending quantities that change sign between the last point of a range and the
    first beyond it.
    """
    last_index = valid_range.point_indices[0 if beyond_index < valid_range.point_indices[0] else -1]
    known_names = [name for name in continuation.ending_quantities if name in point_table.table]
    return [
        name
        for name in known_names
        if point_table.table[name][last_index] * point_table.table[name][beyond_index] < 0.0
    ]


def _locate_ends(
    continuation: AbstractContinuation, point_table: _PointTable, ranges: list[_ValidRange]
) -> dict[tuple[int, int], _LocatedZero]:
    """Return the nearest zero at each end of each branch, by (index of the wheel, 0 or 1 for the
    end).
    """
    requests, wheel_and_end = [], []
    for valid_range in ranges:
        for end_index, beyond_index in enumerate(valid_range.beyond_indices):
            if beyond_index < 0:
                continue
            last_index = int(valid_range.point_indices[0 if end_index == 0 else -1])
            for name in _find_crossings(continuation, point_table, valid_range, beyond_index) or [
                ADMISSIBLE_COLUMN
            ]:
                requests.append((last_index, beyond_index, name))
                wheel_and_end.append((valid_range.wheel_index, end_index))
    nearest_zeros: dict[tuple[int, int], _LocatedZero] = {}
    for key, zero in zip(
        wheel_and_end, _locate_zeros(continuation, point_table, requests), strict=True
    ):
        if key not in nearest_zeros or zero.fraction < nearest_zeros[key].fraction:
            nearest_zeros[key] = zero
    return nearest_zeros


def _locate_inner_zeros(
    continuation: AbstractContinuation, point_table: _PointTable
) -> list[NamedZero]:
    """Return all special points between neighboring points of a branch, without its ends."""
    requests, names = _request_sign_changes(continuation, point_table)
    table, all_indices = point_table.table, np.arange(len(point_table.wheel_indices))
    fraction_rates = np.asarray(point_table.points.fraction_rate)
    jumps: list[tuple[int, int]] = []
    if continuation.problem.has_kinks:
        states = np.asarray(jax.vmap(continuation.problem.section_state)(point_table.points.z))
        fractions = point_table.points.p / (continuation.bounds[1] - continuation.bounds[0])
        neighbors = point_table.find_neighbor_pairs(all_indices)
        jumps = find_jumps(states, fractions, fraction_rates, neighbors)
    contact_orders = table.get(CONTACT_ORDER_COLUMN, np.zeros(len(all_indices)))
    for left, right in point_table.find_neighbor_pairs(all_indices):
        if contact_orders[left] != contact_orders[right]:
            # Other orders may exist between the end of the left order and the start of the right
            # one.
            requests += [
                (left, right, contact_order_quantity_name(contact_orders[i])) for i in (left, right)
            ]
            names += [CONTACT_ORDER_CHANGE] * 2
    contains_jump = lambda left, right: any(left <= i and j <= right for i, j in jumps)
    is_continuous = [not contains_jump(left, right) for left, right, _ in requests]
    requests = [x for x, is_selected in zip(requests, is_continuous, strict=True) if is_selected]
    names = [x for x, is_selected in zip(names, is_continuous, strict=True) if is_selected]
    located_zeros = _locate_zeros(continuation, point_table, requests)
    named_zeros = []
    for name, zero in zip(names, located_zeros, strict=True):
        if name in N_CROSSING_MULTIPLIERS and not vanishes_at_zero(table, zero):
            continue
        jacobian = np.asarray(zero.point_beside.jacobian[0])
        if name != "neimark_sacker" or has_unit_circle_pair(jacobian):
            named_zeros.append((name, zero, N_CROSSING_MULTIPLIERS.get(name, 0)))
    named_zeros += [
        (CONTACT_ORDER_CHANGE, _LocatedZero.at_jump(point_table, pair), 0) for pair in jumps
    ]
    pairs = point_table.find_neighbor_pairs(np.flatnonzero(is_off_circle(table[MODULI_COLUMN])))
    pairs = [pair for pair in pairs if not contains_jump(*pair)]
    locate_zeros_between = functools.partial(_locate_zeros, continuation, point_table)
    return add_multiple_bifurcations(
        table,
        fraction_rates,
        pairs,
        drop_duplicate_order_changes(named_zeros),
        locate_zeros_between,
    )


def _request_sign_changes(
    continuation: AbstractContinuation, point_table: _PointTable
) -> tuple[list[tuple[int, int, str]], list[str]]:
    """Return requests (left point, right point, column) for all sign changes of bifurcations and
    margins.

    The second result is the name of the special point of each request.
    """
    table = point_table.table
    skipped_names = (
        ADMISSIBLE_COLUMN,
        BRANCH_POINT_KIND,
        *continuation.linear_substitutes.values(),
    )
    quantity_names = [
        name for name, values in table.items() if values.ndim == 1 and name not in skipped_names
    ]
    quantity_names = [
        name for name in quantity_names if name in BIFURCATION_NAMES or continuation.is_margin(name)
    ]
    columns = [
        _combined_margin_name(name) if _combined_margin_name(name) in table else name
        for name in quantity_names
    ]
    # At a branch point the sign of the fold's margin is round-off.
    regular_indices = np.flatnonzero(~(np.abs(table["fold"]) < ZERO_TOLERANCES.zero_margin))
    fraction_rates = np.asarray(point_table.points.fraction_rate)
    requests, names = [], []
    for i, j, column_index in find_sign_changes(
        np.stack([table[name] for name in columns], 1)[regular_indices]
    ):
        left, right, name = (
            int(regular_indices[i]),
            int(regular_indices[j]),
            quantity_names[column_index],
        )
        if point_table.wheel_indices[left] == point_table.wheel_indices[right]:
            if name == "fold" and fraction_rates[left] * fraction_rates[right] > 0.0:
                name = BRANCH_POINT_KIND
            requests.append((left, right, columns[column_index]))
            names.append(name)
    for left, right in point_table.find_neighbor_pairs(regular_indices):
        # On the side branch of a pitchfork the margin touches zero where the parameter turns.
        has_same_margin_sign = table["fold"][left] * table["fold"][right] > 0.0
        if has_same_margin_sign and fraction_rates[left] * fraction_rates[right] < 0.0:
            requests.append((left, right, BRANCH_POINT_KIND))
            names.append(BRANCH_POINT_KIND)
    return requests, names


class BranchData(NamedTuple):
    """Finished branch of one wheel, before it is labeled."""

    points: ContinuationPoint
    table: QuantityTable
    special_points: tuple[SpecialPoint, ...]
    ends: tuple[str, str]
    # whether the mesh limits the branch, see `AbstractContinuation.is_mesh_limited`
    is_mesh_limited: bool


CycleFactory = Callable[[int, ContinuationPoint], Callable[[], Any] | None]
"""Function of a wheel's index and a point, which returns a function that finds the limit cycle
there.
"""


def continue_and_locate(
    continuation: AbstractContinuation,
    z: Any,
    parameter_values: Array,
    has_start: np.ndarray,
    make_cycle: CycleFactory,
    is_finest: bool = True,
) -> list[BranchData | None]:
    """Continue branches, locate their special points, and return the data of each wheel; None
    without a start.

    `z` and `parameter_values` are the starts. Unless `is_finest`, special points of mesh-limited
    branches are not located, because these branches are continued again on a finer mesh.
    """
    results = _continue_both_ways(continuation, z, parameter_values, has_start)
    # The first result of a closed curve contains the whole curve.
    is_closed = (results.status == int(ContinuationStatus.CURVE_CLOSED)).all(
        1, keepdims=True
    ) & np.array([True, False])
    point_counts: Any = np.where(is_closed, 0, results.n_points)
    results = results._replace(n_points=point_counts)
    point_table = _PointTable.from_results(continuation, results)
    n_wheels, n_before_start = len(has_start), np.maximum(results.n_points[:, 0] - 1, 0)
    start_indices = {
        wheel_index: int(n_before_start[wheel_index])
        for wheel_index in range(n_wheels)
        if wheel_index in point_table.wheel_indices
    }
    ranges = point_table.find_valid_ranges(start_indices)
    branches: list[BranchData | None] = [None] * n_wheels
    if not is_finest:
        for valid_range in ranges:
            if _is_mesh_limited(continuation, point_table, valid_range):
                points, table = take_rows(
                    (point_table.points, point_table.table), valid_range.point_indices
                )
                branches[valid_range.wheel_index] = BranchData(points, table, (), ("", ""), True)
        ranges = [
            valid_range for valid_range in ranges if branches[valid_range.wheel_index] is None
        ]
    if not ranges:
        return branches
    located_ends = _locate_ends(continuation, point_table, ranges)
    all_points = point_table.join_ends(ranges, located_ends)
    inner_zeros = _locate_inner_zeros(continuation, all_points)

    def make_special_point(
        name: str, zero: _LocatedZero, wheel_index: int, ends_branch: bool, n_multipliers: int = 0
    ) -> SpecialPoint:
        """Return the special point at a located zero."""
        point_beside = take_rows(zero.point_beside, 0)
        section_state = np.asarray(
            continuation.problem.section_state(jax.device_put(point_beside.z))
        )
        point = FixedPoint(section_state, float(point_beside.p), point_beside.jacobian)
        if name == ADMISSIBLE_COLUMN:
            name = continuation.name_end(point_table.table, zero.bracket[1])
        kind = "border_collision" if continuation.is_margin(name) else "lost"
        if name in N_CROSSING_MULTIPLIERS or name == CONTACT_ORDER_CHANGE:
            kind = name
        return SpecialPoint(
            kind,
            name,
            zero.value,
            point,
            ends_branch,
            make_cycle(wheel_index, point_beside),
            n_multipliers,
        )

    for valid_range in ranges:
        point_indices = np.flatnonzero(all_points.wheel_indices == valid_range.wheel_index)
        positioned_points = [
            (
                located_zero.bracket[0] + located_zero.fraction,
                make_special_point(name, located_zero, valid_range.wheel_index, False, count),
            )
            for name, located_zero, count in inner_zeros
            if located_zero.bracket[0] in point_indices
        ]
        end_reasons = []
        for end in (0, 1):
            located_zero = located_ends.get((valid_range.wheel_index, end))
            if located_zero is None:
                end_reasons.append(
                    ContinuationStatus(int(results.status[valid_range.wheel_index, end])).meaning
                )
                continue
            end_point = make_special_point(
                located_zero.bracket[2], located_zero, valid_range.wheel_index, True
            )
            positioned_points.append(
                (point_indices[0] - 1.0 if end == 0 else point_indices[-1] + 1.0, end_point)
            )
            end_reasons.append(continuation.describe_end(end_point.name, end_point.value))
        positioned_points.sort(key=lambda pair: pair[0])
        special_points = tuple(special_point for _, special_point in positioned_points)
        table = take_rows(all_points.table, point_indices)
        end_names = tuple(
            special_point.name for special_point in special_points if special_point.ends_branch
        )
        branches[valid_range.wheel_index] = BranchData(
            take_rows(all_points.points, point_indices),
            table,
            special_points,
            (end_reasons[0], end_reasons[1]),
            continuation.is_mesh_limited(table, end_names),
        )
    return branches
