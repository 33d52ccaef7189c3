"""Continuation of branches and location of their special points, independent of the wheel.

Several branches run side by side. First, each is continued both ways. Then the points where it
stops being admissible are located; they are its ends. Then every other change of sign on it is
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
from vrw_jax.branches.jumps import find_jumps, follow_beyond_jumps
from vrw_jax.branches.multiplicity import (
    BRANCH_POINT_KIND,
    CONTACT_ORDER,
    MODULI,
    ORDER_CHANGES,
    WEIGHTS,
    ZERO_MARGIN,
    Found,
    drop_twins,
    is_off_circle,
    is_zero,
    moduli_of,
    name_order,
    quantity_of,
    with_ranks,
)
from vrw_jax.continuation import (
    BIFURCATION_NAMES,
    AbstractContinuationProblem,
    ArclengthOptions,
    ConstraintPlane,
    ContinuationPoint,
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
from vrw_jax.numerics import concat_rows, map_in_batches, map_in_numpy_batches, take_rows

LOCATION_ACCURACY = 1e-10
"""Accuracy of a special point in the parameter: the width of the bracket at which the search
ends."""

FOLD_BRACKET_FRACTION = 1e-6
"""Final width of the bracket as a fraction of the initial one, used near a fold, where the
parameter enters squared."""

RETRY_FRACTIONS = (0.99, 0.9)
"""Fractions of the distance to an ill-conditioned zero at which a point beside it is tried
again."""

LOCATION_BATCH_SIZES = (1, 8)
"""Numbers of points that are located side by side; only one of them is compiled where compilation
is expensive."""

READ_BATCH_SIZE = 32
"""Number of points that one program evaluates; fewer points take the same time."""

ADMISSIBLE_COLUMN = "sequence"
"""Name of the column that is 1 where a point is admissible, else -1."""

QuantityTable = dict[str, np.ndarray]
"""Named quantities over a batch of points, first axis."""


@dataclass(frozen=True)
class AbstractContinuation(abc.ABC):
    """Continuation of several wheels side by side, with the quantities to evaluate at its
    points."""

    problem: AbstractContinuationProblem
    options: ArclengthOptions
    wheels: Any  # with a leading axis over wheels
    bounds: np.ndarray

    ending_quantities: ClassVar[tuple[str, ...]] = ()
    """Names of columns at whose zeros a branch ends because the order of events changes."""
    linear_substitutes: ClassVar[Mapping[str, str]] = {}
    """Margins that vanish ill-conditioned, each with the column that vanishes at the same point."""

    @abc.abstractmethod
    def evaluate_points(self, wheels: Any, points: ContinuationPoint) -> QuantityTable:
        """Return the quantities that the Jacobian does not give, of the wheels with the same
        axis."""

    @abc.abstractmethod
    def is_admissible(self, table: QuantityTable) -> np.ndarray:
        """Return which points are admissible, from their table."""

    def is_margin(self, name: str) -> bool:
        """Return whether a column's zero is a border collision."""
        return False

    def mask_undefined(self, table: QuantityTable, wheel_indices: np.ndarray) -> QuantityTable:
        """Return the table with undefined quantities masked, which depend on the wheel of the
        point."""
        return table

    def name_end(self, table: QuantityTable, row_index: int) -> str:
        """Return a name for the end of a branch from the first point beyond it."""
        return ADMISSIBLE_COLUMN

    def is_alike(self, before: QuantityTable, after: QuantityTable) -> np.ndarray:
        """Return which points beyond a jump are still the branch's, row by row."""
        return after[ADMISSIBLE_COLUMN] > 0.0

    def describe_end(self, name: str, value: float) -> str:
        """Return the sentence for an end of a branch, by its border's name."""
        return f"{name.replace('_', ' ')} at {value:.9g} ends it."

    def is_mesh_limited(self, table: QuantityTable, ends: tuple[str, ...]) -> bool:
        """Return whether the mesh limits the extent or the accuracy of a branch; `ends` are names
        of ends."""
        return False

    def map_batched(self, function: Callable, batch_size: int, *trees: Any) -> Any:
        """Map over many numpy rows, `size` at a time if the function is compiled."""
        if self.problem.is_traceable:
            return map_in_numpy_batches(function, (batch_size,), *trees)
        return jax.tree.map(np.asarray, map_in_batches(function, LOCATION_BATCH_SIZES, *trees))

    def make_table(self, points: ContinuationPoint, wheel_indices: np.ndarray) -> QuantityTable:
        """Return every quantity at each point, with bifurcation functions and ADMISSIBLE_COLUMN."""
        wheels = take_rows(self.wheels, wheel_indices)
        table = self.evaluate_points(wheels, points)
        test_functions = map_in_numpy_batches(
            evaluate_bifurcation_functions, (READ_BATCH_SIZE,), points.jacobian
        )
        table |= {name: test_functions[:, i] for i, name in enumerate(BIFURCATION_NAMES)}
        table = self.mask_undefined(table, wheel_indices)
        with np.errstate(divide="ignore", invalid="ignore"):
            table[BRANCH_POINT_KIND] = table["fold"] / points.fraction_rate
        table[MODULI] = moduli_of(np.asarray(points.jacobian))
        for name, substitute in self.linear_substitutes.items():
            if substitute in table and name in table:
                table[_combined_name(name)] = combined_margin(table[name], table[substitute])
        is_valid = np.asarray(points.is_admissible) & self.is_admissible(table)
        return table | {ADMISSIBLE_COLUMN: np.where(is_valid, 1.0, -1.0)}


def _combined_name(name: str) -> str:
    """Return the name of the column that is positive where a margin and its substitute are."""
    return f"{name} for certain"


def combined_margin(margin: np.ndarray, substitute: np.ndarray) -> np.ndarray:
    """Return a quantity with the sign of both, and of `substitute` alone where that is negative.

    It crosses zero without a jump at the zeros of either.
    """
    return np.where(substitute < 0.0, substitute, np.minimum(substitute, margin))


def _continue_both_ways(
    continuation: AbstractContinuation, z: Any, parameter_values: Array, is_wanted: np.ndarray
) -> arclength.ContinuationResult:
    """Continue all wheels, axes (wheel, direction), the first direction towards smaller values."""
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
        repeat_for_directions(is_wanted),
    )
    continue_all = (
        arclength.continue_from if continuation.problem.is_traceable else continue_many_from
    )
    continue_all = functools.partial(continue_all, continuation.problem, continuation.options)
    results: arclength.ContinuationResult = jax.tree.map(np.asarray, continue_all(*arguments))
    if continuation.problem.has_kinks:
        results = follow_beyond_jumps(continuation, continue_all, arguments[0], results)
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
    """Return points of the branch between neighbors, at `fractions` in [0, 1] of the chord."""

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
    """Return the start of a search between neighbors, and the plane that contains the solution."""
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


def _solve_many_between(
    problem: AbstractContinuationProblem,
    options: ArclengthOptions,
    bounds: Array,
    wheels: Any,
    left: ContinuationPoint,
    right: ContinuationPoint,
    fractions: Array,
) -> tuple[ContinuationPoint, Array]:
    """Return `_solve_between` outside of compiled code."""
    z, planes = _make_starts_between(problem, bounds, left, right, fractions)
    return solve_many_on_planes(problem, options, wheels, z, planes, bounds)


class _PointTable(NamedTuple):
    """Points of all wheels in one array; each wheel's points are in the order of its branch."""

    points: ContinuationPoint
    wheel_indices: np.ndarray  # of each point
    table: QuantityTable


class _LocatedZero(NamedTuple):
    bracket: tuple[int, int, str]  # left and right point, name of the quantity
    value: float
    fraction: float
    point_beside: ContinuationPoint  # on the side of the left point, leading axis 1
    table: QuantityTable  # at `point_beside`


def _locate_zeros(
    continuation: AbstractContinuation,
    point_table: _PointTable,
    requests: list[tuple[int, int, str]],
) -> list[_LocatedZero]:
    """Locate the zero of each request (left, right, quantity) whose sign differs between two
    points."""
    if not requests:
        return []
    lefts, rights = (np.array([request[i] for request in requests]) for i in (0, 1))
    names = [request[2] for request in requests]
    left, right = take_rows(point_table.points, lefts), take_rows(point_table.points, rights)
    wheel_indices = point_table.wheel_indices[lefts]
    wheels = take_rows(continuation.wheels, wheel_indices)
    solve_points = _solve_between if continuation.problem.is_traceable else _solve_many_between
    solve_between = functools.partial(
        solve_points, continuation.problem, continuation.options, jnp.asarray(continuation.bounds)
    )

    parameter_at = {
        (i, 1.0 * end): side.p[i]
        for end, side in enumerate((left, right))
        for i in range(len(requests))
    }

    def solve_at_fractions(
        fractions: np.ndarray, bracket_indices: np.ndarray
    ) -> tuple[ContinuationPoint, QuantityTable]:
        bracket_rows = take_rows((wheels, left, right), bracket_indices)
        points, is_found = continuation.map_batched(
            solve_between, LOCATION_BATCH_SIZES[-1], *bracket_rows, fractions
        )
        parameter_at.update(
            zip(zip(bracket_indices, fractions, strict=True), points.p, strict=True)
        )
        points = points._replace(is_admissible=points.is_admissible & is_found)
        table = continuation.make_table(points, wheel_indices[bracket_indices])
        return points, {
            k: np.where(_broadcast_flags(is_found, v), v, np.nan) for k, v in table.items()
        }

    def quantity_at(fractions: np.ndarray, bracket_indices: np.ndarray) -> np.ndarray:
        table = solve_at_fractions(fractions, bracket_indices)[1]
        return np.array([quantity_of(table, names[k])[i] for i, k in enumerate(bracket_indices)])

    values_at = lambda row_indices: np.array(
        [quantity_of(point_table.table, n)[i] for n, i in zip(names, row_indices, strict=True)]
    )
    parameter_distance = np.maximum(np.abs(right.p - left.p), LOCATION_ACCURACY)
    tolerances = np.minimum(LOCATION_ACCURACY / parameter_distance, FOLD_BRACKET_FRACTION)
    location = locate_zeros(quantity_at, (values_at(lefts), values_at(rights)), tolerances)
    all_indices = np.arange(len(requests))
    # Slightly to the left even of an exact zero, where the point is still admissible.
    points_beside, table = solve_at_fractions(
        np.maximum(location.left_end - tolerances, 0.0), all_indices
    )
    for retry_fraction in RETRY_FRACTIONS:
        failed, row_indices = (
            np.flatnonzero(~(table[ADMISSIBLE_COLUMN] > 0.0)),
            np.arange(len(requests)),
        )
        if len(failed):
            retries = solve_at_fractions(retry_fraction * location.left_end[failed], failed)
            row_indices[failed] = len(row_indices) + np.arange(len(failed))
            points_beside, table = take_rows(
                concat_rows((points_beside, table), retries), row_indices
            )
    return [
        _LocatedZero(
            requests[i],
            float(parameter_at[i, location.best[i]]),
            float(location.best[i]),
            take_rows(points_beside, slice(i, i + 1)),
            take_rows(table, slice(i, i + 1)),
        )
        for i in range(len(requests))
    ]


def _broadcast_flags(flags: np.ndarray, values: np.ndarray) -> np.ndarray:
    return flags.reshape(-1, *(1,) * (values.ndim - 1))


def _collect_points(
    continuation: AbstractContinuation, results: arclength.ContinuationResult
) -> _PointTable:
    """Collect all points of all results, each wheel's two directions joined at its start."""
    point_parts, wheel_indices = [], []
    for wheel_index in range(results.n_points.shape[0]):
        n_down, n_up = (int(n) for n in results.n_points[wheel_index])
        if n_down:
            points = take_rows(results.points, (wheel_index, 0))
            points = take_rows(points, np.arange(n_down)[::-1])
            point_parts.append(points._replace(fraction_rate=-points.fraction_rate))
        if n_up:
            points = take_rows(results.points, (wheel_index, 1))
            point_parts.append(take_rows(points, np.arange(1 if n_down else 0, n_up)))
        wheel_indices += [wheel_index] * (n_down + max(n_up - (1 if n_down else 0), 0))
    if not wheel_indices:
        return _PointTable(take_rows(results.points, (0, 0, slice(0, 0))), np.zeros(0, int), {})
    points = concat_rows(*point_parts)
    return _PointTable(
        points, np.array(wheel_indices), continuation.make_table(points, np.array(wheel_indices))
    )


class _ValidRange(NamedTuple):
    """Admissible points of one wheel, and the first one beyond at either end (-1 if there is
    none)."""

    wheel_index: int
    point_indices: np.ndarray
    beyond_indices: tuple[int, int]


def _find_valid_ranges(point_table: _PointTable, starts: Mapping[int, int]) -> list[_ValidRange]:
    """Return the points of each wheel that are connected to its start through admissible points."""
    ranges = []
    for wheel_index, start in starts.items():
        point_indices = np.flatnonzero(point_table.wheel_indices == wheel_index)
        is_valid = point_table.table[ADMISSIBLE_COLUMN][point_indices] > 0.0
        # A start on a special point may be beyond it: then it is next to the branch's end.
        candidates = [
            i for i in (start, start + 1, start - 1) if 0 <= i < len(point_indices) and is_valid[i]
        ]
        if not candidates:
            continue
        start = candidates[0]
        first_index = last_index = start
        while first_index > 0 and is_valid[first_index - 1]:
            first_index -= 1
        while last_index < len(point_indices) - 1 and is_valid[last_index + 1]:
            last_index += 1
        below_index = int(point_indices[first_index - 1]) if first_index > 0 else -1
        above_index = (
            int(point_indices[last_index + 1]) if last_index < len(point_indices) - 1 else -1
        )
        ranges.append(
            _ValidRange(
                wheel_index, point_indices[first_index : last_index + 1], (below_index, above_index)
            )
        )
    return ranges


def _is_mesh_limited(
    continuation: AbstractContinuation, point_table: _PointTable, valid_range: _ValidRange
) -> bool:
    """Return `AbstractContinuation.is_mesh_limited` before special points are located."""
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
    """Return the quantities that change sign from the last point to the first one beyond."""
    last_index = valid_range.point_indices[0 if beyond_index < valid_range.point_indices[0] else -1]
    known_names = [name for name in continuation.ending_quantities if name in point_table.table]
    return [
        n
        for n in known_names
        if point_table.table[n][last_index] * point_table.table[n][beyond_index] < 0.0
    ]


def _locate_ends(
    continuation: AbstractContinuation, point_table: _PointTable, ranges: list[_ValidRange]
) -> dict[tuple[int, int], _LocatedZero]:
    """Locate where each branch stops being admissible, by (wheel, end: 0 or 1), at the nearest
    zero."""
    requests, keys = [], []
    for valid_range in ranges:
        for end_index, beyond_index in enumerate(valid_range.beyond_indices):
            if beyond_index < 0:
                continue
            last_index = int(valid_range.point_indices[0 if end_index == 0 else -1])
            for name in _find_crossings(continuation, point_table, valid_range, beyond_index) or [
                ADMISSIBLE_COLUMN
            ]:
                requests.append((last_index, beyond_index, name))
                keys.append((valid_range.wheel_index, end_index))
    nearest: dict[tuple[int, int], _LocatedZero] = {}
    for key, zero in zip(keys, _locate_zeros(continuation, point_table, requests), strict=True):
        if key not in nearest or zero.fraction < nearest[key].fraction:
            nearest[key] = zero
    return nearest


def _join_ends(
    point_table: _PointTable,
    ranges: list[_ValidRange],
    located_ends: Mapping[tuple[int, int], _LocatedZero],
) -> _PointTable:
    """Return the admissible points alone, joined with the points next to the located ends."""
    points, wheel_indices, tables = [], [], []

    def append_points(
        new_points: ContinuationPoint, wheel_index: int, table: QuantityTable
    ) -> None:
        points.append(new_points)
        wheel_indices.append(np.full(len(new_points.p), wheel_index))
        tables.append(table)

    for valid_range in ranges:
        lower_end, upper_end = (located_ends.get((valid_range.wheel_index, end)) for end in (0, 1))
        if lower_end is not None and lower_end.table[ADMISSIBLE_COLUMN][0] > 0.0:
            # Located the way back: its tangent leads against the branch.
            back = lower_end.point_beside._replace(
                fraction_rate=-lower_end.point_beside.fraction_rate
            )
            append_points(
                back,
                valid_range.wheel_index,
                lower_end.table | {BRANCH_POINT_KIND: -lower_end.table[BRANCH_POINT_KIND]},
            )
        append_points(
            take_rows(point_table.points, valid_range.point_indices),
            valid_range.wheel_index,
            take_rows(point_table.table, valid_range.point_indices),
        )
        if upper_end is not None and upper_end.table[ADMISSIBLE_COLUMN][0] > 0.0:
            append_points(upper_end.point_beside, valid_range.wheel_index, upper_end.table)
    return _PointTable(concat_rows(*points), np.concatenate(wheel_indices), concat_rows(*tables))


def _locate_inner_zeros(
    continuation: AbstractContinuation, point_table: _PointTable
) -> list[Found]:
    """Return every border between neighbours on the same branch, with its name.

    The number is that of the multipliers that pass the unit circle there.
    """
    skipped_names = (
        ADMISSIBLE_COLUMN,
        BRANCH_POINT_KIND,
        *continuation.linear_substitutes.values(),
    )
    names = [
        name
        for name, values in point_table.table.items()
        if values.ndim == 1 and name not in skipped_names
    ]
    names = [name for name in names if name in BIFURCATION_NAMES or continuation.is_margin(name)]
    columns = [
        _combined_name(name) if _combined_name(name) in point_table.table else name
        for name in names
    ]
    # At a branch point itself the sign of the fold's margin is round-off.
    rows = np.flatnonzero(~(np.abs(point_table.table["fold"]) < ZERO_MARGIN))
    requests, request_names = [], []
    for i, j, column_index in find_sign_changes(
        np.stack([point_table.table[name] for name in columns], 1)[rows]
    ):
        if point_table.wheel_indices[rows[i]] == point_table.wheel_indices[rows[j]]:
            requests.append((int(rows[i]), int(rows[j]), columns[column_index]))
            request_names.append(names[column_index])
    fraction_rates, fold = np.asarray(point_table.points.fraction_rate), point_table.table["fold"]
    for i, (left, right, _) in enumerate(requests):
        if request_names[i] == "fold" and fraction_rates[left] * fraction_rates[right] > 0.0:
            request_names[i] = BRANCH_POINT_KIND
    for left, right in _neighbours(point_table, rows):
        # Along the side branch of a pitchfork the margin touches zero where the parameter turns.
        if fold[left] * fold[right] > 0.0 and fraction_rates[left] * fraction_rates[right] < 0.0:
            requests.append((left, right, BRANCH_POINT_KIND))
            request_names.append(BRANCH_POINT_KIND)
    jumps: list[tuple[int, int]] = []
    if continuation.problem.has_kinks:
        states = np.asarray(jax.vmap(continuation.problem.section_state)(point_table.points.z))
        shares = point_table.points.p / (continuation.bounds[1] - continuation.bounds[0])
        jumps = find_jumps(
            states, shares, fraction_rates, _neighbours(point_table, np.arange(len(fold)))
        )
    order = point_table.table.get(CONTACT_ORDER, np.zeros(len(fold)))
    for left, right in _neighbours(point_table, np.arange(len(fold))):
        if order[left] != order[right]:
            # Where the first order ends, and where the last one begins: in between may be others.
            requests += [(left, right, name_order(order[i])) for i in (left, right)]
            request_names += [ORDER_CHANGES] * 2
    across = [any(left <= i and j <= right for i, j in jumps) for left, right, _ in requests]
    requests = [one for one, leaves in zip(requests, across, strict=True) if not leaves]
    request_names = [name for name, leaves in zip(request_names, across, strict=True) if not leaves]
    named_zeros = [
        (name, zero, WEIGHTS.get(name, 0))
        for name, zero in zip(
            request_names, _locate_zeros(continuation, point_table, requests), strict=True
        )
        if name not in WEIGHTS or is_zero(point_table.table, zero)
    ]
    named_zeros = [
        (name, zero, count)
        for name, zero, count in named_zeros
        if name != "neimark_sacker"
        or has_unit_circle_pair(np.asarray(zero.point_beside.jacobian[0]))
    ]
    named_zeros += [(ORDER_CHANGES, _zero_at_jump(point_table, pair), 0) for pair in jumps]
    pairs = _neighbours(point_table, np.flatnonzero(is_off_circle(point_table.table[MODULI])))
    pairs = [(a, b) for a, b in pairs if not any(a <= i and j <= b for i, j in jumps)]
    search = functools.partial(_locate_zeros, continuation, point_table)
    return with_ranks(point_table.table, fraction_rates, pairs, drop_twins(named_zeros), search)


def _neighbours(pieces: _PointTable, rows: np.ndarray) -> list[tuple[int, int]]:
    """Return pairs of the points `rows` that follow each other on the same branch."""
    pairs = zip(rows[:-1].tolist(), rows[1:].tolist(), strict=True)
    return [(i, j) for i, j in pairs if pieces.wheel_indices[i] == pieces.wheel_indices[j]]


def _zero_at_jump(pieces: _PointTable, pair: tuple[int, int]) -> _LocatedZero:
    """Return the border at a jump: the point at which the branch stalled, for lack of steps."""
    i, j = pair
    p, last = pieces.points.p, len(pieces.points.p) - 1
    stalled_first = abs(p[i] - p[max(i - 1, 0)]) <= abs(p[min(j + 1, last)] - p[j])
    place = 0 if stalled_first else 1
    point, table = take_rows((pieces.points, pieces.table), slice(pair[place], pair[place] + 1))
    return _LocatedZero((i, j, ORDER_CHANGES), float(p[pair[place]]), float(place), point, table)


def _classify(continuation: AbstractContinuation, name: str) -> str:
    if name in WEIGHTS or name == ORDER_CHANGES:
        return name
    return "border_collision" if continuation.is_margin(name) else "lost"


class BranchData(NamedTuple):
    """Finished branch of one wheel, before it is labeled."""

    points: ContinuationPoint
    table: QuantityTable
    special_points: tuple[SpecialPoint, ...]
    ends: tuple[str, str]
    is_mesh_limited: bool  # `AbstractContinuation.is_mesh_limited`


CycleFactory = Callable[[int, ContinuationPoint], Callable[[], Any] | None]
"""Function of a wheel's index and a point that returns a function for its limit cycle."""


def _collect_mesh_limited(
    continuation: AbstractContinuation,
    point_table: _PointTable,
    ranges: list[_ValidRange],
    n_wheels: int,
) -> list[BranchData | None]:
    branches: list[BranchData | None] = [None] * n_wheels
    for valid_range in ranges:
        if _is_mesh_limited(continuation, point_table, valid_range):
            points, table = take_rows(
                (point_table.points, point_table.table), valid_range.point_indices
            )
            branches[valid_range.wheel_index] = BranchData(points, table, (), ("", ""), True)
    return branches


def continue_and_locate(
    continuation: AbstractContinuation,
    z: Any,
    p: Array,
    has_start: np.ndarray,
    make_cycle: CycleFactory,
    is_finest: bool = True,
) -> list[BranchData | None]:
    """Continue the branches, locate special points, and return the branches by wheel; None without
    a start.

    Without `is_finest`, special points of mesh-limited branches are not located, because these are
    continued again.
    """
    results = _continue_both_ways(continuation, z, p, has_start)
    # A closed curve has both directions in one result.
    is_closed = (results.status == int(ContinuationStatus.CURVE_CLOSED)).all(
        1, keepdims=True
    ) & np.array([True, False])
    counts: Any = np.where(is_closed, 0, results.n_points)
    results = results._replace(n_points=counts)
    point_table = _collect_points(continuation, results)
    n_wheels, n_before = len(has_start), np.maximum(results.n_points[:, 0] - 1, 0)
    start_indices = {w: int(n_before[w]) for w in range(n_wheels) if w in point_table.wheel_indices}
    ranges = _find_valid_ranges(point_table, start_indices)
    branches: list[BranchData | None] = [None] * n_wheels
    if not is_finest:
        branches = _collect_mesh_limited(continuation, point_table, ranges, n_wheels)
        ranges = [
            valid_range for valid_range in ranges if branches[valid_range.wheel_index] is None
        ]
    if not ranges:
        return branches
    located_ends = _locate_ends(continuation, point_table, ranges)
    all_points = _join_ends(point_table, ranges, located_ends)
    inner_zeros = _locate_inner_zeros(continuation, all_points)

    def make_special_point(
        name: str, zero: _LocatedZero, wheel_index: int, ends_branch: bool, count: int = 0
    ) -> SpecialPoint:
        point_beside = take_rows(zero.point_beside, 0)
        section = np.asarray(continuation.problem.section_state(jax.device_put(point_beside.z)))
        point = FixedPoint(section, float(point_beside.p), point_beside.jacobian)
        if name == ADMISSIBLE_COLUMN:
            name = continuation.name_end(point_table.table, zero.bracket[1])
        return SpecialPoint(
            _classify(continuation, name),
            name,
            zero.value,
            point,
            ends_branch,
            make_cycle(wheel_index, point_beside),
            count,
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
        special_points = tuple(b for _, b in sorted(positioned_points, key=lambda pair: pair[0]))
        table = take_rows(all_points.table, point_indices)
        end_names = tuple(b.name for b in special_points if b.ends_branch)
        branch_fields = (
            take_rows(all_points.points, point_indices),
            table,
            special_points,
            (end_reasons[0], end_reasons[1]),
        )
        branches[valid_range.wheel_index] = BranchData(
            *branch_fields, continuation.is_mesh_limited(table, end_names)
        )
    return branches
