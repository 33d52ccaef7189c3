"""Continue branches and locate their special points, for any model.

Several branches are continued concurrently, each in both directions. The ends of the admissible
part of each branch are located next. Finally, all sign changes between neighboring admissible
points are located.
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
from vrw_jax.branches.jumps import continue_beyond_jumps, find_state_jumps
from vrw_jax.branches.multiplicity import (
    BRANCH_POINT_KIND,
    CONTACT_ORDER_CHANGE,
    CROSSING_MULTIPLIER_COUNTS,
    LOCATED_ROOT_TOLERANCES,
    MULTIPLIER_MODULI_COLUMN,
    STEPWISE_CHANGE_NAMES,
    NamedLocatedRoot,
    add_multiple_bifurcations,
    are_multipliers_off_circle,
    drop_duplicate_changes,
    evaluate_named_quantity,
    format_equality_quantity_name,
    sort_multiplier_moduli,
    vanishes_at_root,
)
from vrw_jax.continuation import (
    BIFURCATION_NAMES,
    AbstractContinuationProblem,
    ArclengthOptions,
    ContinuationPoint,
    ContinuationResult,
    ContinuationStatus,
    CorrectorPlane,
    arclength,
    continue_branches_uncompiled,
    evaluate_bifurcation_functions,
    find_sign_changes,
    has_unit_circle_pair,
    locate_function_roots,
    solve_on_many_planes,
    solve_on_plane,
)
from vrw_jax.cycles import STATE_AGREEMENT_TOLERANCE
from vrw_jax.numerics import (
    batch_sizes,
    concatenate_tree_rows,
    map_in_batches,
    map_in_numpy_batches,
    select_tree_rows,
)
from vrw_jax.wheel import Outcome


@dataclass(frozen=True)
class SpecialPointLocationOptions:
    """Numerical options for the location of special points.

    - `parameter_accuracy`: width of the bracket, in the parameter, at which the search ends;
    - `min_bracket_fraction`: smallest width of the bracket as a fraction of its initial width. The
      value is chosen because near a fold the parameter varies with the square of the distance;
    - `retry_chord_fractions`: fractions of the chord up to an ill-conditioned root, at which the
      point next to the root is computed again;
    - `max_unrefined_mesh_error`: estimated mesh error above which the mesh is refined.
    """

    parameter_accuracy: float = 1e-10
    min_bracket_fraction: float = 1e-6
    retry_chord_fractions: tuple[float, ...] = (0.99, 0.9)
    max_unrefined_mesh_error: float = 1e-8


DEFAULT_LOCATION_OPTIONS = SpecialPointLocationOptions()
"""Default options for the location of special points."""


ADMISSIBILITY_COLUMN = "sequence"
"""Name of the quantity that is 1 at admissible points and -1 at all other points."""

COARSE_MESH_END_NAME = Outcome.MESH_TOO_COARSE.name.lower()
"""Name of a branch end at which the mesh is too coarse. Event-driven steps that start from the
computed gaits then do not repeat.
"""

QuantitiesByName = dict[str, np.ndarray]
"""Arrays of quantities with one element per point, by the name of the quantity."""


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
            np.max(quantity_table.get("mesh_error", 0.0))
            > DEFAULT_LOCATION_OPTIONS.max_unrefined_mesh_error
        )

    def map_over_points(
        self, function_of_points: Callable, batch_size: int, *point_trees: Any
    ) -> Any:
        """Evaluate a function of points in batches of `batch_size` points, and return its results.

        Leaves of `point_trees`, the arguments of the function, are NumPy arrays with a leading axis
        over the points.
        """
        if self.continuation_problem.is_traceable:
            return map_in_numpy_batches(function_of_points, (batch_size,), *point_trees)
        return jax.tree.map(
            np.asarray,
            map_in_batches(function_of_points, batch_sizes.LOCATION_BATCH_SIZES, *point_trees),
        )

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
        for margin_name, substitute_name in self.linear_margin_substitutes.items():
            if substitute_name in quantity_table and margin_name in quantity_table:
                quantity_table[_format_combined_margin_name(margin_name)] = (
                    combine_margin_with_substitute(
                        quantity_table[margin_name], quantity_table[substitute_name]
                    )
                )
        is_point_admissible = np.asarray(points.is_admissible) & self.are_points_admissible(
            quantity_table
        )
        return quantity_table | {ADMISSIBILITY_COLUMN: np.where(is_point_admissible, 1.0, -1.0)}


def _format_combined_margin_name(margin_name: str) -> str:
    """Return the name of the quantity that `combine_margin_with_substitute` computes for a
    margin.
    """
    return f"{margin_name} for certain"


def combine_margin_with_substitute(
    margin_values: np.ndarray, substitute_values: np.ndarray
) -> np.ndarray:
    """Return a quantity that is positive if and only if a margin and its substitute are positive.

    The substitute is a quantity that vanishes linearly where the margin vanishes. The combined
    quantity crosses zero continuously. If the substitute is negative, the combined quantity equals
    the substitute.
    """
    return np.where(
        substitute_values < 0.0, substitute_values, np.minimum(substitute_values, margin_values)
    )


def _continue_in_both_directions(
    branch_continuation: AbstractContinuation,
    z: Any,
    parameter_values: Array,
    is_branch_requested: np.ndarray,
) -> ContinuationResult:
    """Continue the branches of all wheels in both directions, and return all points.

    The result has the axes (wheel, direction). The first direction decreases the parameter.

    - `z`, `parameter_values`: unknowns and parameter at the start of each branch;
    - `is_branch_requested`: whether each branch is continued.
    """
    direction_repeater = lambda tree_over_wheels: jax.device_put(
        select_tree_rows(tree_over_wheels, np.repeat(np.arange(len(parameter_values)), 2))
    )
    parameter_bounds = jnp.asarray(branch_continuation.parameter_bounds)
    direction_signs = jnp.tile(
        jnp.asarray([-1.0, 1.0], parameter_bounds.dtype), parameter_values.shape[0]
    )
    continuation_arguments = (
        direction_repeater(branch_continuation.wheels),
        direction_repeater(z),
        direction_repeater(parameter_values),
        parameter_bounds,
        direction_signs,
        direction_repeater(is_branch_requested),
    )
    continue_all_branches = (
        arclength.continue_from
        if branch_continuation.continuation_problem.is_traceable
        else continue_branches_uncompiled
    )
    continue_all_branches = functools.partial(
        continue_all_branches,
        branch_continuation.continuation_problem,
        branch_continuation.arclength_options,
    )
    results_by_direction: ContinuationResult = jax.tree.map(
        np.asarray, continue_all_branches(*continuation_arguments)
    )
    if branch_continuation.continuation_problem.has_kinks:
        results_by_direction = continue_beyond_jumps(
            branch_continuation,
            continue_all_branches,
            continuation_arguments[0],
            results_by_direction,
        )
    return jax.tree.map(lambda x: x.reshape(-1, 2, *x.shape[1:]), results_by_direction)


@eqx.filter_jit
def _solve_for_points_on_chords(
    continuation_problem: AbstractContinuationProblem,
    arclength_options: ArclengthOptions,
    parameter_bounds: Array,
    wheels: Any,
    left_points: ContinuationPoint,
    right_points: ContinuationPoint,
    chord_fractions: Array,
) -> tuple[ContinuationPoint, Array]:
    """Solve for points of a branch between neighboring points.

    Return the points, and whether Newton's method converged. Each new point lies in a plane that
    divides the chord between its neighbors at the fraction in `chord_fractions`, in [0, 1].
    """

    def solve_for_point_on_chord(
        point_wheel: Any,
        left_point: ContinuationPoint,
        right_point: ContinuationPoint,
        chord_fraction: Array,
    ) -> tuple[ContinuationPoint, Array]:
        z, constraint_plane = _guess_point_on_chord(
            continuation_problem, parameter_bounds, left_point, right_point, chord_fraction
        )
        return solve_on_plane(
            continuation_problem,
            arclength_options,
            point_wheel,
            z,
            constraint_plane,
            parameter_bounds,
        )

    return jax.vmap(solve_for_point_on_chord)(wheels, left_points, right_points, chord_fractions)


def _guess_point_on_chord(
    continuation_problem: AbstractContinuationProblem,
    parameter_bounds: Array,
    left_point: ContinuationPoint,
    right_point: ContinuationPoint,
    chord_fraction: Array,
) -> tuple[Any, CorrectorPlane]:
    """Return the initial guess for a point between two neighboring points, and the plane of the
    point.

    The plane divides the chord between the neighboring points at the fraction `chord_fraction`.
    """
    z = continuation_problem.interpolate_unknowns(left_point.z, right_point.z, chord_fraction)
    parameter_range = parameter_bounds[1] - parameter_bounds[0]
    chord_section_change = continuation_problem.section_state(
        right_point.z
    ) - continuation_problem.section_state(left_point.z)
    chord_fraction_change = (right_point.p - left_point.p) / parameter_range
    parameter_fraction = (
        left_point.p + chord_fraction * (right_point.p - left_point.p) - parameter_bounds[0]
    ) / parameter_range
    return z, CorrectorPlane(
        continuation_problem.section_state(z),
        parameter_fraction,
        chord_section_change,
        chord_fraction_change,
    )


_guess_points_on_chords = eqx.filter_jit(
    eqx.filter_vmap(_guess_point_on_chord, in_axes=(None, None, 0, 0, 0))
)


def _solve_for_points_on_chords_untraced(
    continuation_problem: AbstractContinuationProblem,
    arclength_options: ArclengthOptions,
    parameter_bounds: Array,
    wheels: Any,
    left_points: ContinuationPoint,
    right_points: ContinuationPoint,
    chord_fractions: Array,
) -> tuple[ContinuationPoint, Array]:
    """Return the result of `_solve_for_points_on_chords` for a problem that JAX cannot trace."""
    z, corrector_planes = _guess_points_on_chords(
        continuation_problem, parameter_bounds, left_points, right_points, chord_fractions
    )
    return solve_on_many_planes(
        continuation_problem, arclength_options, wheels, z, corrector_planes, parameter_bounds
    )


class _AdmissibleRange(NamedTuple):
    """Admissible points of one wheel's branch, and the first points beyond the two ends of their
    range.

    An index is -1 if the branch has no point beyond that end.
    """

    wheel_index: int
    admissible_point_indices: np.ndarray
    point_indices_beyond_ends: tuple[int, int]


class _BranchPointTable(NamedTuple):
    """Points of all wheels in one array, in the order of each wheel's branch."""

    all_points: ContinuationPoint
    wheel_indices: np.ndarray  # index of the wheel to which each point belongs
    quantity_table: QuantitiesByName

    @classmethod
    def from_results(
        cls, branch_continuation: AbstractContinuation, results_by_direction: ContinuationResult
    ) -> "_BranchPointTable":
        """Return the points of branches that were continued in two directions from their starts.

        The points of the first direction are reversed and precede those of the second.
        """
        points_by_direction, wheel_indices = [], []
        for wheel_index in range(results_by_direction.n_points.shape[0]):
            n_toward_lower, n_toward_upper = (
                int(n_points_of_direction)
                for n_points_of_direction in results_by_direction.n_points[wheel_index]
            )
            if n_toward_lower:
                points_of_both_directions = select_tree_rows(
                    results_by_direction.points, (wheel_index, 0)
                )
                points_of_both_directions = select_tree_rows(
                    points_of_both_directions, np.arange(n_toward_lower)[::-1]
                )
                points_by_direction.append(
                    points_of_both_directions._replace(
                        fraction_rate=-points_of_both_directions.fraction_rate
                    )
                )
            if n_toward_upper:
                points_of_both_directions = select_tree_rows(
                    results_by_direction.points, (wheel_index, 1)
                )
                points_by_direction.append(
                    select_tree_rows(
                        points_of_both_directions,
                        np.arange(1 if n_toward_lower else 0, n_toward_upper),
                    )
                )
            wheel_indices += [wheel_index] * (
                n_toward_lower + max(n_toward_upper - (1 if n_toward_lower else 0), 0)
            )
        if not wheel_indices:
            return cls(
                select_tree_rows(results_by_direction.points, (0, 0, slice(0, 0))),
                np.zeros(0, int),
                {},
            )
        points_of_both_directions = concatenate_tree_rows(*points_by_direction)
        return cls(
            points_of_both_directions,
            np.array(wheel_indices),
            branch_continuation.make_quantity_table(
                points_of_both_directions, np.array(wheel_indices)
            ),
        )

    def find_neighbor_pairs(self, point_indices: np.ndarray) -> list[tuple[int, int]]:
        """Return the pairs of successive points in `point_indices` that belong to the
        same branch.
        """
        successive_pairs = zip(point_indices[:-1].tolist(), point_indices[1:].tolist(), strict=True)
        is_same_wheel = lambda i, j: self.wheel_indices[i] == self.wheel_indices[j]
        return [(i, j) for i, j in successive_pairs if is_same_wheel(i, j)]

    def find_admissible_ranges(
        self, start_point_positions: Mapping[int, int]
    ) -> list[_AdmissibleRange]:
        """Find for each wheel the range of admissible points that contains the start of its branch.

        `start_point_positions` maps the index of a wheel to the position of the start on its
        branch.
        """
        admissible_ranges = []
        for wheel_index, start_point_position in start_point_positions.items():
            point_indices = np.flatnonzero(self.wheel_indices == wheel_index)
            is_point_admissible = self.quantity_table[ADMISSIBILITY_COLUMN][point_indices] > 0.0
            # If the start is a special point, it may lie beyond the end. A neighbor is then used.
            admissible_positions = [
                i
                for i in (start_point_position, start_point_position + 1, start_point_position - 1)
                if 0 <= i < len(point_indices) and is_point_admissible[i]
            ]
            if not admissible_positions:
                continue
            start_point_position = admissible_positions[0]
            first_admissible_position = last_admissible_position = start_point_position
            while (
                first_admissible_position > 0 and is_point_admissible[first_admissible_position - 1]
            ):
                first_admissible_position -= 1
            while (
                last_admissible_position < len(point_indices) - 1
                and is_point_admissible[last_admissible_position + 1]
            ):
                last_admissible_position += 1
            point_index_below_range = (
                int(point_indices[first_admissible_position - 1])
                if first_admissible_position > 0
                else -1
            )
            point_index_above_range = (
                int(point_indices[last_admissible_position + 1])
                if last_admissible_position < len(point_indices) - 1
                else -1
            )
            admissible_ranges.append(
                _AdmissibleRange(
                    wheel_index,
                    point_indices[first_admissible_position : last_admissible_position + 1],
                    (point_index_below_range, point_index_above_range),
                )
            )
        return admissible_ranges

    def join_located_ends(
        self,
        admissible_ranges: list[_AdmissibleRange],
        located_ends: Mapping[tuple[int, int], "_LocatedRoot"],
    ) -> "_BranchPointTable":
        """Return a table with the admissible points of all ranges and the points next to the
        located ends.
        """
        points_by_range, wheel_index_groups, quantity_tables_by_range = [], [], []

        def append_branch_points(
            added_points: ContinuationPoint, wheel_index: int, added_quantities: QuantitiesByName
        ) -> None:
            points_by_range.append(added_points)
            wheel_index_groups.append(np.full(len(added_points.p), wheel_index))
            quantity_tables_by_range.append(added_quantities)

        for admissible_range in admissible_ranges:
            lower_located_end, upper_located_end = (
                located_ends.get((admissible_range.wheel_index, range_end_index))
                for range_end_index in (0, 1)
            )
            if (
                lower_located_end is not None
                and lower_located_end.quantities_beside_root[ADMISSIBILITY_COLUMN][0] > 0.0
            ):
                # The end was located in the opposite direction, so signs of rates are reversed.
                end_point = lower_located_end.point_beside_root
                append_branch_points(
                    end_point._replace(fraction_rate=-end_point.fraction_rate),
                    admissible_range.wheel_index,
                    lower_located_end.quantities_beside_root
                    | {
                        BRANCH_POINT_KIND: -lower_located_end.quantities_beside_root[
                            BRANCH_POINT_KIND
                        ]
                    },
                )
            append_branch_points(
                select_tree_rows(self.all_points, admissible_range.admissible_point_indices),
                admissible_range.wheel_index,
                select_tree_rows(self.quantity_table, admissible_range.admissible_point_indices),
            )
            if (
                upper_located_end is not None
                and upper_located_end.quantities_beside_root[ADMISSIBILITY_COLUMN][0] > 0.0
            ):
                append_branch_points(
                    upper_located_end.point_beside_root,
                    admissible_range.wheel_index,
                    upper_located_end.quantities_beside_root,
                )
        return _BranchPointTable(
            concatenate_tree_rows(*points_by_range),
            np.concatenate(wheel_index_groups),
            concatenate_tree_rows(*quantity_tables_by_range),
        )


class _LocatedRoot(NamedTuple):
    """Located root of a quantity between two points of a branch."""

    bracket_and_quantity: tuple[
        int, int, str
    ]  # index of the left point, index of the right point, name of the quantity
    parameter_value: float  # value of the continued parameter at the root
    chord_fraction: float  # location of the root on the chord from the left to the right point
    point_beside_root: ContinuationPoint  # on the side of the left point; leading axis of length 1
    quantities_beside_root: QuantitiesByName  # at `point_beside_root`

    @classmethod
    def from_jump(
        cls, point_table: _BranchPointTable, jump_pair: tuple[int, int]
    ) -> "_LocatedRoot":
        """Represent a jump as a located root, at the point of `jump_pair` where the continuation
        stalled.
        """
        i, j = jump_pair
        jump_parameter_values, last_point_index = (
            point_table.all_points.p,
            len(point_table.all_points.p) - 1,
        )
        is_root_at_left = abs(
            jump_parameter_values[i] - jump_parameter_values[max(i - 1, 0)]
        ) <= abs(jump_parameter_values[min(j + 1, last_point_index)] - jump_parameter_values[j])
        chord_fraction = 0.0 if is_root_at_left else 1.0
        point_index = i if is_root_at_left else j
        point_beside_root, quantities_beside_root = select_tree_rows(
            (point_table.all_points, point_table.quantity_table),
            slice(point_index, point_index + 1),
        )
        return cls(
            (i, j, CONTACT_ORDER_CHANGE),
            float(jump_parameter_values[point_index]),
            chord_fraction,
            point_beside_root,
            quantities_beside_root,
        )


class _SpecialPointLocator(NamedTuple):
    """Locator of special points and branch ends between the computed points of branches."""

    branch_continuation: AbstractContinuation
    point_table: _BranchPointTable

    def locate_requested_roots(
        self,
        root_requests: list[tuple[int, int, str]],
        location_options: SpecialPointLocationOptions = DEFAULT_LOCATION_OPTIONS,
    ) -> list[_LocatedRoot]:
        """Locate the root that each request describes.

        A request is (left point, right point, name of the quantity). The quantity has opposite
        signs at the two points.
        """
        if not root_requests:
            return []
        left_indices, right_indices = (
            np.array([root_request[bracket_end_index] for root_request in root_requests])
            for bracket_end_index in (0, 1)
        )
        quantity_names = [root_request[2] for root_request in root_requests]
        left_points, right_points = (
            select_tree_rows(self.point_table.all_points, left_indices),
            select_tree_rows(self.point_table.all_points, right_indices),
        )
        wheel_indices = self.point_table.wheel_indices[left_indices]
        bracket_wheels = select_tree_rows(self.branch_continuation.wheels, wheel_indices)
        chord_solver = (
            _solve_for_points_on_chords
            if self.branch_continuation.continuation_problem.is_traceable
            else _solve_for_points_on_chords_untraced
        )
        chord_point_solver = functools.partial(
            chord_solver,
            self.branch_continuation.continuation_problem,
            self.branch_continuation.arclength_options,
            jnp.asarray(self.branch_continuation.parameter_bounds),
        )

        parameter_by_location = {
            (request_index, 1.0 * chord_end_fraction): chord_end_points.p[request_index]
            for chord_end_fraction, chord_end_points in enumerate((left_points, right_points))
            for request_index in range(len(root_requests))
        }

        def solve_for_points_at_fractions(
            chord_fractions: np.ndarray, bracket_indices: np.ndarray
        ) -> tuple[ContinuationPoint, QuantitiesByName]:
            selected_brackets = select_tree_rows(
                (bracket_wheels, left_points, right_points), bracket_indices
            )
            solved_chord_points, is_solve_successful = self.branch_continuation.map_over_points(
                chord_point_solver,
                batch_sizes.LOCATION_BATCH_SIZES[-1],
                *selected_brackets,
                chord_fractions,
            )
            parameter_by_location.update(
                zip(
                    zip(bracket_indices, chord_fractions, strict=True),
                    solved_chord_points.p,
                    strict=True,
                )
            )
            solved_chord_points = solved_chord_points._replace(
                is_admissible=solved_chord_points.is_admissible & is_solve_successful
            )
            quantity_table = self.branch_continuation.make_quantity_table(
                solved_chord_points, wheel_indices[bracket_indices]
            )
            found_flag_broadcaster = lambda is_point_found, quantity_values: is_point_found.reshape(
                -1, *(1,) * (quantity_values.ndim - 1)
            )
            return solved_chord_points, {
                quantity_name: np.where(
                    found_flag_broadcaster(is_solve_successful, quantity_values),
                    quantity_values,
                    np.nan,
                )
                for quantity_name, quantity_values in quantity_table.items()
            }

        def evaluate_quantities_at_fractions(
            chord_fractions: np.ndarray, bracket_indices: np.ndarray
        ) -> np.ndarray:
            quantity_table = solve_for_points_at_fractions(chord_fractions, bracket_indices)[1]
            return np.array(
                [
                    evaluate_named_quantity(quantity_table, quantity_names[bracket_index])[
                        bracket_position
                    ]
                    for bracket_position, bracket_index in enumerate(bracket_indices)
                ]
            )

        evaluate_at_points = lambda point_indices: np.array(
            [
                evaluate_named_quantity(self.point_table.quantity_table, quantity_name)[point_index]
                for quantity_name, point_index in zip(quantity_names, point_indices, strict=True)
            ]
        )
        parameter_distances = np.maximum(
            np.abs(right_points.p - left_points.p), location_options.parameter_accuracy
        )
        bracket_tolerances = np.minimum(
            location_options.parameter_accuracy / parameter_distances,
            location_options.min_bracket_fraction,
        )
        root_locations = locate_function_roots(
            evaluate_quantities_at_fractions,
            (evaluate_at_points(left_indices), evaluate_at_points(right_indices)),
            bracket_tolerances,
        )
        request_indices = np.arange(len(root_requests))
        # Even for an exact root, the point next to it lies to the left, where the gaits are
        # admissible.
        points_beside_roots, quantities_beside_roots = solve_for_points_at_fractions(
            np.maximum(root_locations.left_bracket_ends - bracket_tolerances, 0.0), request_indices
        )
        for retry_chord_fraction in location_options.retry_chord_fractions:
            inadmissible_request_indices = np.flatnonzero(
                ~(quantities_beside_roots[ADMISSIBILITY_COLUMN] > 0.0)
            )
            point_indices = np.arange(len(root_requests))
            if len(inadmissible_request_indices):
                retried_points_and_quantities = solve_for_points_at_fractions(
                    retry_chord_fraction
                    * root_locations.left_bracket_ends[inadmissible_request_indices],
                    inadmissible_request_indices,
                )
                point_indices[inadmissible_request_indices] = len(point_indices) + np.arange(
                    len(inadmissible_request_indices)
                )
                points_beside_roots, quantities_beside_roots = select_tree_rows(
                    concatenate_tree_rows(
                        (points_beside_roots, quantities_beside_roots),
                        retried_points_and_quantities,
                    ),
                    point_indices,
                )
        return [
            _LocatedRoot(
                root_requests[request_index],
                float(
                    parameter_by_location[
                        request_index, root_locations.best_locations[request_index]
                    ]
                ),
                float(root_locations.best_locations[request_index]),
                select_tree_rows(points_beside_roots, slice(request_index, request_index + 1)),
                select_tree_rows(quantities_beside_roots, slice(request_index, request_index + 1)),
            )
            for request_index in range(len(root_requests))
        ]

    def is_mesh_limited(
        self,
        admissible_range: _AdmissibleRange,
    ) -> bool:
        """Return whether the mesh limits a branch in `admissible_range`, before its special points
        are located.
        """
        unexplained_range_ends = [
            i
            for i in admissible_range.point_indices_beyond_ends
            if i >= 0 and not self.find_crossed_quantities(admissible_range, i)
        ]
        end_names = tuple(
            self.branch_continuation.name_branch_end(self.point_table.quantity_table, i)
            for i in unexplained_range_ends
        )
        return self.branch_continuation.is_mesh_limited(
            select_tree_rows(
                self.point_table.quantity_table, admissible_range.admissible_point_indices
            ),
            end_names,
        )

    def find_crossed_quantities(
        self,
        admissible_range: _AdmissibleRange,
        point_index_beyond_end: int,
    ) -> list[str]:
        """Return the names of the branch-ending quantities that change sign at one end of a range.

        The signs are compared between the last point of the range and the first point beyond the
        range.
        """
        last_point_index = admissible_range.admissible_point_indices[
            0 if point_index_beyond_end < admissible_range.admissible_point_indices[0] else -1
        ]
        known_quantity_names = [
            quantity_name
            for quantity_name in self.branch_continuation.branch_ending_quantities
            if quantity_name in self.point_table.quantity_table
        ]
        return [
            quantity_name
            for quantity_name in known_quantity_names
            if self.point_table.quantity_table[quantity_name][last_point_index]
            * self.point_table.quantity_table[quantity_name][point_index_beyond_end]
            < 0.0
        ]

    def locate_branch_ends(
        self,
        admissible_ranges: list[_AdmissibleRange],
    ) -> dict[tuple[int, int], _LocatedRoot]:
        """Locate the nearest root of a quantity beyond each end of each branch.

        The keys of the result are (wheel index, end), where the end is 0 or 1.
        """
        root_requests, wheel_and_end_keys = [], []
        for admissible_range in admissible_ranges:
            for range_end_index, point_index_beyond_end in enumerate(
                admissible_range.point_indices_beyond_ends
            ):
                if point_index_beyond_end < 0:
                    continue
                last_point_index = int(
                    admissible_range.admissible_point_indices[0 if range_end_index == 0 else -1]
                )
                for quantity_name in self.find_crossed_quantities(
                    admissible_range, point_index_beyond_end
                ) or [ADMISSIBILITY_COLUMN]:
                    root_requests.append((last_point_index, point_index_beyond_end, quantity_name))
                    wheel_and_end_keys.append((admissible_range.wheel_index, range_end_index))
        nearest_root_by_end: dict[tuple[int, int], _LocatedRoot] = {}
        for wheel_and_end_key, located_root in zip(
            wheel_and_end_keys,
            self.locate_requested_roots(root_requests),
            strict=True,
        ):
            if (
                wheel_and_end_key not in nearest_root_by_end
                or located_root.chord_fraction
                < nearest_root_by_end[wheel_and_end_key].chord_fraction
            ):
                nearest_root_by_end[wheel_and_end_key] = located_root
        return nearest_root_by_end

    def locate_inner_special_points(
        self,
    ) -> list[NamedLocatedRoot]:
        """Locate all special points of the branches except their ends."""
        root_requests, special_point_names = self.list_root_requests()
        quantity_table, all_point_indices = (
            self.point_table.quantity_table,
            np.arange(len(self.point_table.wheel_indices)),
        )
        fraction_rates = np.asarray(self.point_table.all_points.fraction_rate)
        jump_pairs: list[tuple[int, int]] = []
        if self.branch_continuation.continuation_problem.has_kinks:
            section_states = np.asarray(
                jax.vmap(self.branch_continuation.continuation_problem.section_state)(
                    self.point_table.all_points.z
                )
            )
            parameter_fractions = self.point_table.all_points.p / (
                self.branch_continuation.parameter_bounds[1]
                - self.branch_continuation.parameter_bounds[0]
            )
            neighbor_pairs = self.point_table.find_neighbor_pairs(all_point_indices)
            jump_pairs = find_state_jumps(
                section_states, parameter_fractions, fraction_rates, neighbor_pairs
            )
        for stepwise_name, change_name in STEPWISE_CHANGE_NAMES.items():
            integer_values = quantity_table.get(stepwise_name, np.zeros(len(all_point_indices)))
            for left_index, right_index in self.point_table.find_neighbor_pairs(
                np.flatnonzero(np.isfinite(integer_values))
            ):
                if integer_values[left_index] != integer_values[right_index]:
                    # Between the two values of the quantity there may be further values.
                    root_requests += [
                        (
                            left_index,
                            right_index,
                            format_equality_quantity_name(stepwise_name, integer_values[i]),
                        )
                        for i in (left_index, right_index)
                    ]
                    special_point_names += [change_name] * 2
        has_jump_between = lambda left_index, right_index: any(
            left_index <= i and j <= right_index for i, j in jump_pairs
        )
        is_request_without_jump = [
            not has_jump_between(left_index, right_index)
            for left_index, right_index, _ in root_requests
        ]
        root_requests = [
            root_request
            for root_request, has_no_jump in zip(
                root_requests, is_request_without_jump, strict=True
            )
            if has_no_jump
        ]
        special_point_names = [
            special_point_name
            for special_point_name, has_no_jump in zip(
                special_point_names, is_request_without_jump, strict=True
            )
            if has_no_jump
        ]
        located_roots = self.locate_requested_roots(root_requests)
        named_roots = []
        for special_point_name, located_root in zip(
            special_point_names, located_roots, strict=True
        ):
            if special_point_name in CROSSING_MULTIPLIER_COUNTS and not vanishes_at_root(
                quantity_table, located_root
            ):
                continue
            return_map_jacobian = np.asarray(located_root.point_beside_root.return_map_jacobian[0])
            if special_point_name != "neimark_sacker" or has_unit_circle_pair(return_map_jacobian):
                named_roots.append(
                    (
                        special_point_name,
                        located_root,
                        CROSSING_MULTIPLIER_COUNTS.get(special_point_name, 0),
                    )
                )
        named_roots += [
            (CONTACT_ORDER_CHANGE, _LocatedRoot.from_jump(self.point_table, point_pair), 0)
            for point_pair in jump_pairs
        ]
        off_circle_point_pairs = self.point_table.find_neighbor_pairs(
            np.flatnonzero(are_multipliers_off_circle(quantity_table[MULTIPLIER_MODULI_COLUMN]))
        )
        off_circle_point_pairs = [
            point_pair for point_pair in off_circle_point_pairs if not has_jump_between(*point_pair)
        ]
        return add_multiple_bifurcations(
            quantity_table,
            fraction_rates,
            off_circle_point_pairs,
            drop_duplicate_changes(named_roots),
            self.locate_requested_roots,
        )

    def list_root_requests(
        self,
    ) -> tuple[list[tuple[int, int, str]], list[str]]:
        """List the roots of bifurcation functions and margins that are to be located.

        Return requests and names. A request is (left point, right point, name of the quantity). The
        list of names contains the name of the special point for each request.
        """
        quantity_table = self.point_table.quantity_table
        skipped_quantity_names = (
            ADMISSIBILITY_COLUMN,
            BRANCH_POINT_KIND,
            *self.branch_continuation.linear_margin_substitutes.values(),
        )
        quantity_names = [
            quantity_name
            for quantity_name, quantity_values in quantity_table.items()
            if quantity_values.ndim == 1 and quantity_name not in skipped_quantity_names
        ]
        quantity_names = [
            quantity_name
            for quantity_name in quantity_names
            if quantity_name in BIFURCATION_NAMES
            or self.branch_continuation.is_margin_name(quantity_name)
        ]
        column_names = [
            _format_combined_margin_name(quantity_name)
            if _format_combined_margin_name(quantity_name) in quantity_table
            else quantity_name
            for quantity_name in quantity_names
        ]
        # At a branch point the sign of the fold's margin is determined by round-off.
        regular_point_indices = np.flatnonzero(
            ~(np.abs(quantity_table["fold"]) < LOCATED_ROOT_TOLERANCES.max_zero_margin)
        )
        fraction_rates = np.asarray(self.point_table.all_points.fraction_rate)
        root_requests, special_point_names = [], []
        for i, j, column_index in find_sign_changes(
            np.stack([quantity_table[quantity_name] for quantity_name in column_names], 1)[
                regular_point_indices
            ]
        ):
            left_index, right_index, quantity_name = (
                int(regular_point_indices[i]),
                int(regular_point_indices[j]),
                quantity_names[column_index],
            )
            if (
                self.point_table.wheel_indices[left_index]
                == self.point_table.wheel_indices[right_index]
            ):
                if (
                    quantity_name == "fold"
                    and fraction_rates[left_index] * fraction_rates[right_index] > 0.0
                ):
                    quantity_name = BRANCH_POINT_KIND
                root_requests.append((left_index, right_index, column_names[column_index]))
                special_point_names.append(quantity_name)
        for left_index, right_index in self.point_table.find_neighbor_pairs(regular_point_indices):
            # On the side branch of a pitchfork, the margin touches zero where the parameter turns.
            has_same_fold_sign = (
                quantity_table["fold"][left_index] * quantity_table["fold"][right_index] > 0.0
            )
            if (
                has_same_fold_sign
                and fraction_rates[left_index] * fraction_rates[right_index] < 0.0
            ):
                root_requests.append((left_index, right_index, BRANCH_POINT_KIND))
                special_point_names.append(BRANCH_POINT_KIND)
        return root_requests, special_point_names


class BranchData(NamedTuple):
    """Branch of one wheel and its located special points, as arrays without labels."""

    points: ContinuationPoint
    quantity_table: QuantitiesByName
    special_points: tuple[SpecialPoint, ...]
    end_reasons: tuple[str, str]
    # whether the mesh limits the branch, see `AbstractContinuation.is_mesh_limited`
    is_mesh_limited: bool


CycleFinderFactory = Callable[[int, ContinuationPoint], Callable[[], Any] | None]
"""Function that maps (wheel index, point) to a function that finds the limit cycle at
that point.
"""


def continue_and_locate_special_points(
    branch_continuation: AbstractContinuation,
    z: Any,
    parameter_values: Array,
    has_branch_start: np.ndarray,
    make_cycle_finder: CycleFinderFactory,
    is_finest_mesh: bool = True,
) -> list[BranchData | None]:
    """Continue branches, and return them with their located special points.

    The result is None for a wheel without a start. A branch that the mesh limits is later continued
    again on a finer mesh. Its special points are located only if `is_finest_mesh` is true.

    - `z`, `parameter_values`: unknowns and parameter at the start of each branch;
    - `has_branch_start`: whether each wheel has a start;
    - `make_cycle_finder`: function that returns finders of the limit cycles at special points.
    """
    results_by_direction = _continue_in_both_directions(
        branch_continuation, z, parameter_values, has_branch_start
    )
    # In the first direction, a closed curve is complete.
    is_curve_closed = (results_by_direction.status == int(ContinuationStatus.CURVE_CLOSED)).all(
        1, keepdims=True
    ) & np.array([True, False])
    n_points_by_direction: Any = np.where(is_curve_closed, 0, results_by_direction.n_points)
    results_by_direction = results_by_direction._replace(n_points=n_points_by_direction)
    point_table = _BranchPointTable.from_results(branch_continuation, results_by_direction)
    n_wheels, n_points_before_start = (
        len(has_branch_start),
        np.maximum(results_by_direction.n_points[:, 0] - 1, 0),
    )
    start_point_positions = {
        wheel_index: int(n_points_before_start[wheel_index])
        for wheel_index in range(n_wheels)
        if wheel_index in point_table.wheel_indices
    }
    admissible_ranges = point_table.find_admissible_ranges(start_point_positions)
    point_locator = _SpecialPointLocator(branch_continuation, point_table)
    branch_data_by_wheel: list[BranchData | None] = [None] * n_wheels
    if not is_finest_mesh:
        for admissible_range in admissible_ranges:
            if point_locator.is_mesh_limited(admissible_range):
                admissible_points, branch_quantities = select_tree_rows(
                    (point_table.all_points, point_table.quantity_table),
                    admissible_range.admissible_point_indices,
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
    joined_point_table = point_table.join_located_ends(admissible_ranges, located_ends)
    inner_special_points = _SpecialPointLocator(
        branch_continuation, joined_point_table
    ).locate_inner_special_points()

    def make_special_point(
        special_point_name: str,
        located_root: _LocatedRoot,
        wheel_index: int,
        ends_branch: bool,
        n_multipliers: int = 0,
    ) -> SpecialPoint:
        """Build the special point at a located root.

        - `special_point_name`: name of the bifurcation or of the quantity that vanishes;
        - `n_multipliers`: number of multipliers that cross the unit circle, 0 for other kinds.
        """
        point_beside_root = select_tree_rows(located_root.point_beside_root, 0)
        section_state = np.asarray(
            branch_continuation.continuation_problem.section_state(
                jax.device_put(point_beside_root.z)
            )
        )
        fixed_point = FixedPoint(
            section_state, float(point_beside_root.p), point_beside_root.return_map_jacobian
        )
        if special_point_name == ADMISSIBILITY_COLUMN:
            special_point_name = branch_continuation.name_branch_end(
                point_table.quantity_table, located_root.bracket_and_quantity[1]
            )
        special_point_kind = (
            "border_collision" if branch_continuation.is_margin_name(special_point_name) else "lost"
        )
        if (
            special_point_name in CROSSING_MULTIPLIER_COUNTS
            or special_point_name in STEPWISE_CHANGE_NAMES.values()
        ):
            special_point_kind = special_point_name
        return SpecialPoint(
            special_point_kind,
            special_point_name,
            located_root.parameter_value,
            fixed_point,
            ends_branch,
            make_cycle_finder(wheel_index, point_beside_root),
            n_multipliers,
        )

    for admissible_range in admissible_ranges:
        point_indices = np.flatnonzero(
            joined_point_table.wheel_indices == admissible_range.wheel_index
        )
        special_points_with_position = [
            (
                located_root.bracket_and_quantity[0] + located_root.chord_fraction,
                make_special_point(
                    special_point_name,
                    located_root,
                    admissible_range.wheel_index,
                    False,
                    n_multipliers,
                ),
            )
            for special_point_name, located_root, n_multipliers in inner_special_points
            if located_root.bracket_and_quantity[0] in point_indices
        ]
        end_reasons = []
        for range_end_index in (0, 1):
            located_root = located_ends.get((admissible_range.wheel_index, range_end_index))
            if located_root is None:
                end_reasons.append(
                    ContinuationStatus(
                        int(
                            results_by_direction.status[
                                admissible_range.wheel_index, range_end_index
                            ]
                        )
                    ).meaning
                )
                continue
            end_point = make_special_point(
                located_root.bracket_and_quantity[2],
                located_root,
                admissible_range.wheel_index,
                True,
            )
            special_points_with_position.append(
                (
                    point_indices[0] - 1.0 if range_end_index == 0 else point_indices[-1] + 1.0,
                    end_point,
                )
            )
            end_reasons.append(
                branch_continuation.describe_branch_end(end_point.name, end_point.value)
            )
        special_points_with_position.sort(
            key=lambda position_and_special_point: position_and_special_point[0]
        )
        special_points = tuple(special_point for _, special_point in special_points_with_position)
        branch_quantities = select_tree_rows(joined_point_table.quantity_table, point_indices)
        end_names = tuple(
            special_point.name for special_point in special_points if special_point.ends_branch
        )
        branch_data_by_wheel[admissible_range.wheel_index] = BranchData(
            select_tree_rows(joined_point_table.all_points, point_indices),
            branch_quantities,
            special_points,
            (end_reasons[0], end_reasons[1]),
            branch_continuation.is_mesh_limited(branch_quantities, end_names),
        )
    return branch_data_by_wheel
