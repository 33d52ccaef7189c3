"""Continue branches and locate their special points, for any model.

Several branches are continued concurrently, each in both directions. The ends of the admissible
part of each branch are located next. Finally, all sign changes between neighboring admissible
points are located.
"""

import abc
import functools
import operator
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from vrw_jax.base import batch_sizes
from vrw_jax.branches import arclength
from vrw_jax.branches.arclength import (
    AbstractContinuationProblem,
    ArclengthOptions,
    ContinuationPoint,
    ContinuationResult,
    ContinuationSetup,
    ContinuationStatus,
    CorrectorPlane,
)
from vrw_jax.branches.batched_continuation import continue_branches_uncompiled, solve_on_planes
from vrw_jax.branches.branch import FixedPoint, SpecialPoint
from vrw_jax.branches.branch_points import (
    ADMISSIBILITY_COLUMN,
    BRANCH_POINT_KIND,
    CONTACT_ORDER_CHANGE,
    CONTACT_ORDER_COLUMN,
    CROSSING_MULTIPLIER_COUNTS,
    MULTIPLIER_MODULI_COLUMN,
    STEPWISE_CHANGE_NAMES,
    BranchPointTable,
    LocatedRoot,
    QuantitiesByName,
    RootRequest,
    compare_with_integer,
    drop_duplicate_changes,
)
from vrw_jax.branches.jumps import continue_beyond_jumps, find_state_jumps
from vrw_jax.branches.multiplicity import (
    add_multiple_bifurcations,
    are_multipliers_off_circle,
    sort_multiplier_moduli,
)
from vrw_jax.branches.sign_changes import (
    BIFURCATION_NAMES,
    evaluate_bifurcation_functions,
    find_sign_changes,
    has_unit_circle_pair,
    locate_function_roots,
)
from vrw_jax.gaits.finder import STATE_AGREEMENT_TOLERANCE
from vrw_jax.lanes.batching import concatenate_tree_rows, map_in_numpy_batches, select_tree_rows
from vrw_jax.wheel.outcomes import Outcome

COARSE_MESH_END_NAME = Outcome.MESH_TOO_COARSE.name.lower()
"""Name of a branch end at which the mesh is too coarse. Event-driven steps that start from the
computed gaits then do not repeat.
"""


# Estimated mesh error above which the mesh is refined.
MAX_SPECIAL_POINT_MESH_ERROR = 1e-8


@dataclass(frozen=True)
class AbstractContinuation(abc.ABC):
    """Continuation of gaits of several wheels, with the quantities that locate special points."""

    continuation_problem: AbstractContinuationProblem
    arclength_options: ArclengthOptions
    wheels: Any  # tree of arrays with a leading axis over wheels
    parameter_bounds: np.ndarray

    branch_ending_quantities: ClassVar[tuple[str, ...]] = ()
    """Names of the quantities that end a branch if they vanish, because the order of
    events changes.
    """

    border_collision_quantities: ClassVar[tuple[str, ...]] = ()
    """Names of margins and indicators. A border collision occurs if one of them vanishes."""

    linear_margin_substitutes: ClassVar[Mapping[str, str]] = {}
    """Names of margins whose roots are ill-conditioned. Each margin is mapped to the name of a
    quantity that vanishes linearly at the same point.
    """

    @property
    def parameter_unit(self) -> float:
        """Return the unit of the parameter in which special points are located."""
        return 1.0

    def make_fixed_point(self, point: ContinuationPoint) -> FixedPoint:
        """Return the fixed point of the return map at one point of a branch."""
        section_state = self.continuation_problem.section_state(jax.device_put(point.z))
        jacobian = np.asarray(point.return_map_jacobian)
        return FixedPoint(np.asarray(section_state), float(point.p), jacobian)

    @abc.abstractmethod
    def evaluate_point_quantities(self, wheels: Any, points: ContinuationPoint) -> QuantitiesByName:
        """Return quantities at each point by name, except those computed from the Jacobian.

        - `wheels`: one wheel per point.
        """

    def are_points_admissible(self, quantity_table: QuantitiesByName) -> np.ndarray:
        """Return whether each point is admissible, computed from the quantities at the points.

        A gait is admissible if its event-driven step returns to its section state. A fixed point of
        another map has no such step, and every finite fixed point is admissible.
        """
        if "outcome" not in quantity_table:
            return np.asarray(True)
        return (quantity_table["outcome"] == Outcome.STEPPED) & (
            quantity_table["closure"] <= STATE_AGREEMENT_TOLERANCE
        )

    def is_margin_name(self, column_name: str) -> bool:
        """Return whether a root of the quantity `column_name` is a border collision.

        The name may end with the label of a leg in brackets.
        """
        return column_name.partition("[")[0] in self.border_collision_quantities

    def evaluate_margin(self, quantity_name: str, quantity_table: QuantitiesByName) -> np.ndarray:
        """Return a margin at each point, combined with its substitute if the table contains one.

        The combined quantity is positive if and only if both are positive. It crosses zero
        continuously, because the substitute vanishes linearly where the margin vanishes. If the
        substitute is negative, the combined quantity equals the substitute.
        """
        margin_values = quantity_table[quantity_name]
        substitute_name = self.linear_margin_substitutes.get(quantity_name, "")
        if substitute_name not in quantity_table:
            return margin_values
        substitute_values = quantity_table[substitute_name]
        return np.where(
            substitute_values < 0.0, substitute_values, np.minimum(substitute_values, margin_values)
        )

    def mask_undefined_quantities(
        self, quantity_table: QuantitiesByName, wheel_indices: np.ndarray
    ) -> QuantitiesByName:
        """Replace each quantity that is undefined for the wheel of a point by NaN.

        - `wheel_indices`: index of the wheel of each point.
        """
        return quantity_table

    def name_branch_end(self, quantity_table: QuantitiesByName, point_index: int) -> str:
        """Return the name of the special point at the end of a branch.

        The name is that of the failure of the event-driven step, if the step fails.

        - `point_index`: index of the first point beyond the end.
        """
        if "outcome" in quantity_table:
            step_outcome = Outcome(int(quantity_table["outcome"][point_index]))
            if step_outcome != Outcome.STEPPED:
                return step_outcome.name.lower()
        return COARSE_MESH_END_NAME if "mesh_error" in quantity_table else ADMISSIBILITY_COLUMN

    def is_same_gait(
        self, table_before: QuantitiesByName, table_after: QuantitiesByName
    ) -> np.ndarray:
        """Return for each jump whether the points before and after the jump belong to the same
        branch.
        """
        return table_after[ADMISSIBILITY_COLUMN] > 0.0

    def describe_branch_end(self, end_name: str, parameter_value: float) -> str:
        """Return a sentence that describes the end of a branch.

        `end_name` is the name of the special point, and `parameter_value` is the value of the
        continued parameter.
        """
        return f"{end_name.replace('_', ' ')} at {parameter_value:.9g} ends it."

    def is_mesh_limited(self, quantity_table: QuantitiesByName, end_names: tuple[str, ...]) -> bool:
        """Return whether the mesh limits the extent or the accuracy of a branch.

        `end_names` contains the names of the special points at the ends of the branch.
        """
        return COARSE_MESH_END_NAME in end_names or bool(
            np.max(quantity_table.get("mesh_error", 0.0)) > MAX_SPECIAL_POINT_MESH_ERROR
        )

    def map_over_points(
        self, function_of_points: Callable, batch_size: int, *point_trees: Any
    ) -> Any:
        """Evaluate a function of points in batches of `batch_size` points, and return its results.

        Leaves of `point_trees`, the arguments of the function, are NumPy arrays with a leading axis
        over the points.
        """
        is_traceable = self.continuation_problem.is_traceable
        allowed_batch_sizes = (batch_size,) if is_traceable else batch_sizes.LOCATION_BATCH_SIZES
        return map_in_numpy_batches(function_of_points, allowed_batch_sizes, *point_trees)

    def make_quantity_table(
        self, points: ContinuationPoint, wheel_indices: np.ndarray
    ) -> QuantitiesByName:
        """Return all quantities at each point by name.

        The table includes the bifurcation functions and `ADMISSIBILITY_COLUMN`.

        - `wheel_indices`: index of the wheel of each point.
        """
        point_wheels = select_tree_rows(self.wheels, wheel_indices)
        quantity_table = self.evaluate_point_quantities(point_wheels, points)
        bifurcation_values = map_in_numpy_batches(
            evaluate_bifurcation_functions,
            (batch_sizes.POINT_BATCH_SIZE,),
            points.return_map_jacobian,
        )
        quantity_table |= {
            margin_name: bifurcation_values[:, bifurcation_index]
            for bifurcation_index, margin_name in enumerate(BIFURCATION_NAMES)
        }
        quantity_table = self.mask_undefined_quantities(quantity_table, wheel_indices)
        with np.errstate(divide="ignore", invalid="ignore"):
            quantity_table[BRANCH_POINT_KIND] = quantity_table["fold"] / points.fraction_rate
        quantity_table[MULTIPLIER_MODULI_COLUMN] = sort_multiplier_moduli(
            np.asarray(points.return_map_jacobian)
        )
        is_point_admissible = np.asarray(points.is_admissible) & self.are_points_admissible(
            quantity_table
        )
        return quantity_table | {ADMISSIBILITY_COLUMN: np.where(is_point_admissible, 1.0, -1.0)}

    def continue_branches(
        self,
        wheels: Any,
        z: Any,
        parameter_values: Any,
        direction_signs: np.ndarray,
        is_branch_requested: np.ndarray,
    ) -> ContinuationResult:
        """Continue branches from given starts, and return all points as NumPy arrays.

        The arguments are those of `arclength.continue_from`.
        """
        continue_all_branches = (
            arclength.continue_from
            if self.continuation_problem.is_traceable
            else continue_branches_uncompiled
        )
        arguments = jax.device_put(
            (
                wheels,
                z,
                parameter_values,
                self.parameter_bounds,
                direction_signs,
                is_branch_requested,
            )
        )
        return jax.tree.map(
            np.asarray,
            continue_all_branches(self.continuation_problem, self.arclength_options, *arguments),
        )

    def continue_in_both_directions(
        self, z: Any, parameter_values: Array, is_branch_requested: np.ndarray
    ) -> ContinuationResult:
        """Continue the branches of all wheels in both directions, and return all points.

        The result has the axes (wheel, direction). The first direction decreases the parameter.

        - `z`, `parameter_values`: unknowns and parameter at the start of each branch;
        - `is_branch_requested`: whether each branch is continued.
        """
        wheels, z, parameter_values, is_branch_requested = select_tree_rows(
            (self.wheels, z, parameter_values, is_branch_requested),
            np.repeat(np.arange(len(parameter_values)), 2),
        )
        direction_signs = np.tile([-1.0, 1.0], len(parameter_values) // 2)
        results = self.continue_branches(
            wheels, z, parameter_values, direction_signs, is_branch_requested
        )
        if self.continuation_problem.has_kinks:
            results = continue_beyond_jumps(self, wheels, results)
        return jax.tree.map(lambda x: x.reshape(len(x) // 2, 2, *x.shape[1:]), results)

    def make_point_table(self, results_by_direction: ContinuationResult) -> BranchPointTable:
        """Return the points of branches that were continued in two directions from their starts.

        The points of the first direction are reversed and precede those of the second.
        """
        row_indices = []  # (wheel, direction, point)
        for wheel_index, (n_toward_lower, n_toward_upper) in enumerate(
            results_by_direction.n_points
        ):
            row_indices += [(wheel_index, 0, i) for i in reversed(range(n_toward_lower))]
            # Both directions contain the start.
            first_point_index = min(n_toward_lower, 1)
            row_indices += [(wheel_index, 1, i) for i in range(first_point_index, n_toward_upper)]
        wheel_indices, direction_indices, point_indices = (
            np.array(row_indices, int).reshape(-1, 3).T
        )
        points = select_tree_rows(
            results_by_direction.points, (wheel_indices, direction_indices, point_indices)
        )
        fraction_rate = np.where(
            direction_indices == 0, -points.fraction_rate, points.fraction_rate
        )
        points = points._replace(fraction_rate=fraction_rate)
        quantity_table = self.make_quantity_table(points, wheel_indices) if row_indices else {}
        return BranchPointTable(points, wheel_indices, quantity_table)


@eqx.filter_jit
@eqx.filter_vmap(in_axes=(None, 0, 0, 0))
def _guess_points_on_chords(
    setup: ContinuationSetup,
    left_point: ContinuationPoint,
    right_point: ContinuationPoint,
    chord_fraction: Array,
) -> tuple[Any, CorrectorPlane]:
    """Return the initial guess for each point between neighboring points, and the point's plane.

    The plane divides the chord between the neighboring points at the fraction `chord_fraction`.
    """
    problem = setup.problem
    z = problem.interpolate_unknowns(left_point.z, right_point.z, chord_fraction)
    p = left_point.p + chord_fraction * (right_point.p - left_point.p)
    return z, CorrectorPlane(
        problem.section_state(z),
        setup.compute_parameter_fraction(p),
        problem.section_state(right_point.z) - problem.section_state(left_point.z),
        (right_point.p - left_point.p) / setup.parameter_range,
    )


def _solve_for_points_on_chords(
    setup: ContinuationSetup,
    wheels: Any,
    left_points: ContinuationPoint,
    right_points: ContinuationPoint,
    chord_fractions: Any,
) -> tuple[ContinuationPoint, Array]:
    """Solve for points of a branch between neighboring points.

    Return the points, and whether Newton's method converged. Each new point lies in a plane that
    divides the chord between its neighbors at the fraction in `chord_fractions`, in [0, 1].
    """
    z, corrector_planes = _guess_points_on_chords(setup, left_points, right_points, chord_fractions)
    return solve_on_planes(setup, wheels, z, corrector_planes)


_solve_for_points_on_chords_jit: Any = eqx.filter_jit(_solve_for_points_on_chords)


class _AdmissibleRange(NamedTuple):
    """Admissible points of one wheel's branch."""

    wheel_index: int
    point_indices: np.ndarray
    # last point of the range and first point beyond it, for the ends 0 and 1; an end is omitted if
    # the branch has no point beyond it
    point_pairs_at_ends: dict[int, tuple[int, int]]


# Width of the bracket, in the parameter, at which the search ends; for maps it is a fraction of the
# range of the parameter.
LOCATION_PARAMETER_ACCURACY = 1e-10
# Smallest width of the bracket as a fraction of its initial width. The value is chosen because near
# a fold the parameter varies with the square of the distance.
MIN_BRACKET_FRACTION = 1e-6
# Fractions of the chord up to an ill-conditioned root, at which the point next to the root is
# computed again.
RETRY_CHORD_FRACTIONS = (0.99, 0.9)
# Largest absolute value of a margin to the fold whose sign is only round-off. The value is chosen
# above the round-off of a determinant of numbers of order one, which is 1e-15. Points so near to a
# branch point are rare.
MAX_ZERO_FOLD_MARGIN = 1e-11


class _SpecialPointLocator(NamedTuple):
    """Locator of special points and branch ends between the computed points of branches."""

    branch_continuation: AbstractContinuation
    point_table: BranchPointTable

    def find_admissible_ranges(self, n_points_before_start: np.ndarray) -> list[_AdmissibleRange]:
        """Find for each wheel the range of admissible points that contains the start of its branch.

        `n_points_before_start` is the number of points before the start, for each wheel.
        """
        _, wheel_indices, quantity_table = self.point_table
        admissible_ranges = []
        for wheel_index in np.unique(wheel_indices).tolist():
            # An inadmissible entry on each side represents the missing point beyond that end.
            point_indices = np.pad(
                np.flatnonzero(wheel_indices == wheel_index), 1, constant_values=-1
            )
            is_admissible = quantity_table[ADMISSIBILITY_COLUMN][point_indices] > 0.0
            is_admissible[[0, -1]] = False
            # If the start is a special point, it may lie beyond the end. A neighbor is then used.
            candidate_positions = n_points_before_start[wheel_index] + np.array([1, 2, 0])
            admissible_positions = candidate_positions[is_admissible[candidate_positions]]
            if not len(admissible_positions):
                continue
            inadmissible_positions = np.flatnonzero(~is_admissible)
            i = np.searchsorted(inadmissible_positions, admissible_positions[0])
            position_below, position_above = inadmissible_positions[[i - 1, i]]
            indices_in_range = point_indices[position_below + 1 : position_above]
            point_pairs = zip(
                indices_in_range[[0, -1]].tolist(),
                point_indices[[position_below, position_above]].tolist(),
                strict=True,
            )
            point_pairs_at_ends = {
                end: pair for end, pair in enumerate(point_pairs) if pair[1] >= 0
            }
            admissible_ranges.append(
                _AdmissibleRange(wheel_index, indices_in_range, point_pairs_at_ends)
            )
        return admissible_ranges

    def join_located_ends(
        self,
        admissible_ranges: list[_AdmissibleRange],
        located_ends: Mapping[tuple[int, int], LocatedRoot],
    ) -> BranchPointTable:
        """Return a table with the admissible points of all ranges and the points next to the
        located ends.
        """
        joined_tables = []
        for admissible_range in admissible_ranges:
            tables_of_range = [select_tree_rows(self.point_table, admissible_range.point_indices)]
            for range_end_index in admissible_range.point_pairs_at_ends:
                located_end = located_ends[admissible_range.wheel_index, range_end_index]
                end_table = located_end.table_beside_root
                if not end_table.quantity_table[ADMISSIBILITY_COLUMN][0] > 0.0:
                    continue
                if range_end_index == 0:  # The end was located in the opposite direction.
                    tables_of_range.insert(0, end_table.reverse_direction())
                else:
                    tables_of_range.append(end_table)
            joined_tables += tables_of_range
        return concatenate_tree_rows(*joined_tables)

    def locate_roots(self, root_requests: list[RootRequest]) -> list[LocatedRoot]:
        """Locate the root that each request describes."""
        if not root_requests:
            return []
        all_request_indices = np.arange(len(root_requests))
        left_table, right_table = (
            select_tree_rows(self.point_table, point_indices)
            for point_indices in np.array([request.point_pair for request in root_requests]).T
        )
        bracket_wheels = select_tree_rows(self.branch_continuation.wheels, left_table.wheel_indices)
        problem = self.branch_continuation.continuation_problem
        solve_for_points_on_chords = functools.partial(
            _solve_for_points_on_chords_jit
            if problem.is_traceable
            else _solve_for_points_on_chords,
            ContinuationSetup(
                problem,
                self.branch_continuation.arclength_options,
                jnp.asarray(self.branch_continuation.parameter_bounds),
            ),
        )
        parameter_by_location = {
            (request_index, chord_fraction): parameter_value
            for chord_fraction, end_table in ((0.0, left_table), (1.0, right_table))
            for request_index, parameter_value in enumerate(end_table.points.p)
        }

        def solve_at_fractions(
            chord_fractions: np.ndarray, request_indices: np.ndarray
        ) -> BranchPointTable:
            solved_points, is_solve_successful = self.branch_continuation.map_over_points(
                solve_for_points_on_chords,
                batch_sizes.LOCATION_BATCH_SIZES[-1],
                *select_tree_rows(
                    (bracket_wheels, left_table.points, right_table.points), request_indices
                ),
                chord_fractions,
            )
            locations = zip(request_indices, chord_fractions, strict=True)
            parameter_by_location.update(zip(locations, solved_points.p, strict=True))
            solved_points = solved_points._replace(
                is_admissible=solved_points.is_admissible & is_solve_successful
            )
            wheel_indices = left_table.wheel_indices[request_indices]
            quantity_table = self.branch_continuation.make_quantity_table(
                solved_points, wheel_indices
            )
            # A transposed array has its points on the last axis.
            quantity_table = {
                quantity_name: np.where(is_solve_successful, quantity_values.T, np.nan).T
                for quantity_name, quantity_values in quantity_table.items()
            }
            return BranchPointTable(solved_points, wheel_indices, quantity_table)

        def evaluate_requested_quantities(
            table: BranchPointTable, request_indices: np.ndarray
        ) -> np.ndarray:
            return np.array(
                [
                    root_requests[request_index].evaluate_quantity(table.quantity_table)[row_index]
                    for row_index, request_index in enumerate(request_indices)
                ]
            )

        parameter_accuracy = LOCATION_PARAMETER_ACCURACY * self.branch_continuation.parameter_unit
        parameter_distances = np.abs(right_table.points.p - left_table.points.p)
        bracket_tolerances = np.minimum(
            parameter_accuracy / np.maximum(parameter_distances, parameter_accuracy),
            MIN_BRACKET_FRACTION,
        )
        root_locations = locate_function_roots(
            lambda chord_fractions, request_indices: evaluate_requested_quantities(
                solve_at_fractions(chord_fractions, request_indices), request_indices
            ),
            (
                evaluate_requested_quantities(left_table, all_request_indices),
                evaluate_requested_quantities(right_table, all_request_indices),
            ),
            bracket_tolerances,
        )
        # Even for an exact root, the point next to it lies to the left, where the gaits are
        # admissible.
        table_beside_roots = solve_at_fractions(
            np.maximum(root_locations.left_bracket_ends - bracket_tolerances, 0.0),
            all_request_indices,
        )
        for retry_chord_fraction in RETRY_CHORD_FRACTIONS:
            retried_indices = np.flatnonzero(
                ~(table_beside_roots.quantity_table[ADMISSIBILITY_COLUMN] > 0.0)
            )
            if len(retried_indices):
                retried_table = solve_at_fractions(
                    retry_chord_fraction * root_locations.left_bracket_ends[retried_indices],
                    retried_indices,
                )
                row_indices = all_request_indices.copy()
                row_indices[retried_indices] = len(row_indices) + np.arange(len(retried_indices))
                table_beside_roots = select_tree_rows(
                    concatenate_tree_rows(table_beside_roots, retried_table), row_indices
                )
        return [
            LocatedRoot(
                root_request,
                root_request.special_point_name,
                CROSSING_MULTIPLIER_COUNTS.get(root_request.special_point_name, 0),
                float(parameter_by_location[request_index, root_location]),
                float(root_location),
                select_tree_rows(table_beside_roots, slice(request_index, request_index + 1)),
            )
            for request_index, (root_request, root_location) in enumerate(
                zip(root_requests, root_locations.best_locations, strict=True)
            )
        ]

    def is_mesh_limited(self, admissible_range: _AdmissibleRange) -> bool:
        """Return whether the mesh limits a branch in `admissible_range`, before its special points
        are located.
        """
        quantity_table = self.point_table.quantity_table
        names_of_unexplained_ends = tuple(
            self.branch_continuation.name_branch_end(quantity_table, point_pair[1])
            for point_pair in admissible_range.point_pairs_at_ends.values()
            if not self.find_crossed_quantities(point_pair)
        )
        return self.branch_continuation.is_mesh_limited(
            select_tree_rows(quantity_table, admissible_range.point_indices),
            names_of_unexplained_ends,
        )

    def find_crossed_quantities(self, point_pair: tuple[int, int]) -> list[str]:
        """Return the names of the branch-ending quantities that change sign between two points."""
        quantity_table = self.point_table.quantity_table
        return [
            quantity_name
            for quantity_name in self.branch_continuation.branch_ending_quantities
            if quantity_name in quantity_table
            and np.prod(quantity_table[quantity_name][list(point_pair)]) < 0.0
        ]

    def locate_branch_ends(
        self, admissible_ranges: list[_AdmissibleRange]
    ) -> dict[tuple[int, int], LocatedRoot]:
        """Locate the nearest root of a quantity beyond each end of each branch.

        The keys of the result are (wheel index, end), where the end is 0 or 1.
        """
        root_requests, wheel_and_end_keys = [], []
        for admissible_range in admissible_ranges:
            for range_end_index, point_pair in admissible_range.point_pairs_at_ends.items():
                for quantity_name in self.find_crossed_quantities(point_pair) or [
                    ADMISSIBILITY_COLUMN
                ]:
                    root_requests.append(
                        RootRequest(point_pair, quantity_name, operator.itemgetter(quantity_name))
                    )
                    wheel_and_end_keys.append((admissible_range.wheel_index, range_end_index))
        nearest_root_by_end: dict[tuple[int, int], LocatedRoot] = {}
        for wheel_and_end_key, located_root in zip(
            wheel_and_end_keys, self.locate_roots(root_requests), strict=True
        ):
            nearest_root = nearest_root_by_end.setdefault(wheel_and_end_key, located_root)
            if located_root.chord_fraction < nearest_root.chord_fraction:
                nearest_root_by_end[wheel_and_end_key] = located_root
        return nearest_root_by_end

    def locate_inner_special_points(self) -> list[LocatedRoot]:
        """Locate all special points of the branches except their ends."""
        points, wheel_indices, quantity_table = self.point_table
        continuation_problem = self.branch_continuation.continuation_problem
        jump_pairs = []
        if continuation_problem.has_kinks:
            parameter_bounds = self.branch_continuation.parameter_bounds
            jump_pairs = find_state_jumps(
                np.asarray(jax.vmap(continuation_problem.section_state)(points.z)),
                points.p / (parameter_bounds[1] - parameter_bounds[0]),
                np.asarray(points.fraction_rate),
                self.point_table.find_neighbor_pairs(np.arange(len(wheel_indices))),
            )
        has_jump_between = lambda left_index, right_index: any(
            left_index <= i and j <= right_index for i, j in jump_pairs
        )
        is_special_point = lambda located_root: (
            (located_root.n_multipliers == 0 or located_root.vanishes_at_root(quantity_table))
            and (
                located_root.special_point_name != "neimark_sacker"
                or has_unit_circle_pair(located_root.return_map_jacobian)
            )
        )
        located_roots = self.locate_roots(
            [
                root_request
                for root_request in self.list_root_requests()
                if not has_jump_between(*root_request.point_pair)
            ]
        )
        located_roots = [
            *filter(is_special_point, located_roots),
            *map(self._represent_jump, jump_pairs),
        ]
        off_circle_point_pairs = self.point_table.find_neighbor_pairs(
            np.flatnonzero(are_multipliers_off_circle(quantity_table[MULTIPLIER_MODULI_COLUMN]))
        )
        return add_multiple_bifurcations(
            self.point_table,
            [pair for pair in off_circle_point_pairs if not has_jump_between(*pair)],
            drop_duplicate_changes(located_roots),
            self.locate_roots,
        )

    def _represent_jump(self, jump_pair: tuple[int, int]) -> LocatedRoot:
        """Represent a jump as a located root, at the point of `jump_pair` where the continuation
        stalled.
        """
        i, j = jump_pair
        parameter_values = self.point_table.points.p
        change_before = abs(parameter_values[i] - parameter_values[max(i - 1, 0)])
        next_index = min(j + 1, len(parameter_values) - 1)
        change_after = abs(parameter_values[next_index] - parameter_values[j])
        chord_fraction, point_index = (0.0, i) if change_before <= change_after else (1.0, j)
        return LocatedRoot(
            RootRequest(jump_pair, CONTACT_ORDER_CHANGE, operator.itemgetter(CONTACT_ORDER_COLUMN)),
            CONTACT_ORDER_CHANGE,
            0,
            float(parameter_values[point_index]),
            chord_fraction,
            select_tree_rows(self.point_table, slice(point_index, point_index + 1)),
        )

    def list_root_requests(self) -> list[RootRequest]:
        """List the roots of bifurcation functions, margins and stepwise quantities that are to be
        located.
        """
        points, wheel_indices, quantity_table = self.point_table
        substitute_names = self.branch_continuation.linear_margin_substitutes.values()
        quantity_names = [
            quantity_name
            for quantity_name, quantity_values in quantity_table.items()
            if quantity_values.ndim == 1
            and quantity_name not in substitute_names
            and (
                quantity_name in BIFURCATION_NAMES
                or self.branch_continuation.is_margin_name(quantity_name)
            )
        ]
        # At a branch point the sign of the fold's margin is determined by round-off.
        regular_point_indices = np.flatnonzero(
            ~(np.abs(quantity_table["fold"]) < MAX_ZERO_FOLD_MARGIN)
        )
        root_requests = []
        for i, j, column_index in find_sign_changes(
            np.stack(
                [
                    self.branch_continuation.evaluate_margin(quantity_name, quantity_table)
                    for quantity_name in quantity_names
                ],
                1,
            )[regular_point_indices]
        ):
            left_index, right_index = regular_point_indices[[i, j]].tolist()
            if wheel_indices[left_index] != wheel_indices[right_index]:
                continue
            special_point_name = quantity_names[column_index]
            evaluate_quantity = functools.partial(
                self.branch_continuation.evaluate_margin, special_point_name
            )
            has_same_direction = np.prod(points.fraction_rate[[left_index, right_index]]) > 0.0
            if special_point_name == "fold" and has_same_direction:
                special_point_name = BRANCH_POINT_KIND
            root_requests.append(
                RootRequest((left_index, right_index), special_point_name, evaluate_quantity)
            )
        # On the side branch of a pitchfork, the margin touches zero where the parameter turns.
        root_requests += [
            RootRequest(point_pair, BRANCH_POINT_KIND, operator.itemgetter(BRANCH_POINT_KIND))
            for point_pair in self.point_table.find_neighbor_pairs(regular_point_indices)
            if np.prod(quantity_table["fold"][list(point_pair)]) > 0.0
            and np.prod(points.fraction_rate[list(point_pair)]) < 0.0
        ]
        for stepwise_quantity_name, change_name in STEPWISE_CHANGE_NAMES.items():
            integer_values = quantity_table.get(
                stepwise_quantity_name, np.zeros(len(wheel_indices))
            )
            for point_pair in self.point_table.find_neighbor_pairs(
                np.flatnonzero(np.isfinite(integer_values))
            ):
                left_value, right_value = map(float, integer_values[list(point_pair)])
                if left_value != right_value:
                    # Between the two values of the quantity there may be further values.
                    root_requests += [
                        RootRequest(
                            point_pair,
                            change_name,
                            functools.partial(
                                compare_with_integer, stepwise_quantity_name, integer_value
                            ),
                        )
                        for integer_value in (left_value, right_value)
                    ]
        return root_requests


class BranchData(NamedTuple):
    """Branch of one wheel and its located special points, as arrays without labels."""

    points: ContinuationPoint
    quantity_table: QuantitiesByName
    special_points: tuple[SpecialPoint, ...]
    end_reasons: tuple[str, str]
    # whether the mesh limits the branch, see `AbstractContinuation.is_mesh_limited`
    is_mesh_limited: bool


CycleFinderFactory = Callable[[int, ContinuationPoint], Callable[[], Any]]
"""Function that maps (wheel index, point) to a function that finds the limit cycle at
that point.
"""


def continue_and_locate_special_points(
    branch_continuation: AbstractContinuation,
    z: Any,
    parameter_values: Array,
    has_branch_start: np.ndarray,
    make_cycle_finder: CycleFinderFactory | None = None,
    is_finest_mesh: bool = True,
) -> list[BranchData | None]:
    """Continue branches, and return them with their located special points.

    The result is None for a wheel without a start. A branch that the mesh limits is later continued
    again on a finer mesh. Its special points are located only if `is_finest_mesh` is true.

    - `z`, `parameter_values`: unknowns and parameter at the start of each branch;
    - `has_branch_start`: whether each wheel has a start;
    - `make_cycle_finder`: function that returns finders of the limit cycles at special points, if
      they can be found.
    """
    results_by_direction = branch_continuation.continue_in_both_directions(
        z, parameter_values, has_branch_start
    )
    # In the first direction, a closed curve is complete.
    is_curve_closed = (results_by_direction.status == int(ContinuationStatus.CURVE_CLOSED)).all(
        1, keepdims=True
    ) & np.array([True, False])
    n_points_by_direction: Any = np.where(is_curve_closed, 0, results_by_direction.n_points)
    results_by_direction = results_by_direction._replace(n_points=n_points_by_direction)
    point_table = branch_continuation.make_point_table(results_by_direction)
    point_locator = _SpecialPointLocator(branch_continuation, point_table)
    admissible_ranges = point_locator.find_admissible_ranges(
        np.maximum(results_by_direction.n_points[:, 0] - 1, 0)
    )
    branch_data_by_wheel: list[BranchData | None] = [None] * len(has_branch_start)
    if not is_finest_mesh:
        for admissible_range in admissible_ranges:
            if point_locator.is_mesh_limited(admissible_range):
                admissible_points, _, branch_quantities = select_tree_rows(
                    point_table, admissible_range.point_indices
                )
                branch_data_by_wheel[admissible_range.wheel_index] = BranchData(
                    admissible_points, branch_quantities, (), ("", ""), True
                )
        admissible_ranges = [
            admissible_range
            for admissible_range in admissible_ranges
            if branch_data_by_wheel[admissible_range.wheel_index] is None
        ]
    if not admissible_ranges:
        return branch_data_by_wheel
    located_ends = point_locator.locate_branch_ends(admissible_ranges)
    joined_point_table = point_locator.join_located_ends(admissible_ranges, located_ends)
    inner_special_points = _SpecialPointLocator(
        branch_continuation, joined_point_table
    ).locate_inner_special_points()

    def make_special_point(located_root: LocatedRoot, ends_branch: bool) -> SpecialPoint:
        points, wheel_indices, _ = located_root.table_beside_root
        point_beside_root = select_tree_rows(points, 0)
        special_point_name = located_root.special_point_name
        if special_point_name == ADMISSIBILITY_COLUMN:
            special_point_name = branch_continuation.name_branch_end(
                point_table.quantity_table, located_root.request.point_pair[1]
            )
        if (
            special_point_name in CROSSING_MULTIPLIER_COUNTS
            or special_point_name in STEPWISE_CHANGE_NAMES.values()
        ):
            special_point_kind = special_point_name
        elif branch_continuation.is_margin_name(special_point_name):
            special_point_kind = "border_collision"
        else:
            special_point_kind = "lost"
        return SpecialPoint(
            special_point_kind,
            special_point_name,
            located_root.parameter_value,
            branch_continuation.make_fixed_point(point_beside_root),
            ends_branch,
            make_cycle_finder(int(wheel_indices[0]), point_beside_root)
            if make_cycle_finder
            else None,
            located_root.n_multipliers,
        )

    for admissible_range in admissible_ranges:
        wheel_index = admissible_range.wheel_index
        roots_between_ends = sorted(
            (
                located_root
                for located_root in inner_special_points
                if located_root.table_beside_root.wheel_indices[0] == wheel_index
            ),
            key=lambda located_root: (
                located_root.request.point_pair[0] + located_root.chord_fraction
            ),
        )
        special_points = [make_special_point(root, False) for root in roots_between_ends]
        end_reasons = []
        for range_end_index, status_code in enumerate(results_by_direction.status[wheel_index]):
            located_end = located_ends.get((wheel_index, range_end_index))
            if located_end is None:
                end_reasons.append(ContinuationStatus(int(status_code)).meaning)
                continue
            end_point = make_special_point(located_end, True)
            special_points.insert(0 if range_end_index == 0 else len(special_points), end_point)
            end_reasons.append(
                branch_continuation.describe_branch_end(end_point.name, end_point.value)
            )
        branch_points, _, branch_quantities = select_tree_rows(
            joined_point_table, joined_point_table.wheel_indices == wheel_index
        )
        end_names = tuple(
            special_point.name for special_point in special_points if special_point.ends_branch
        )
        branch_data_by_wheel[wheel_index] = BranchData(
            branch_points,
            branch_quantities,
            tuple(special_points),
            (end_reasons[0], end_reasons[1]),
            branch_continuation.is_mesh_limited(branch_quantities, end_names),
        )
    return branch_data_by_wheel
