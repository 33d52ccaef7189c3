"""Continue branches and locate their special points, for any walker.

Several branches are continued concurrently, each in both directions. The ends of the admissible
part of each branch are located next. Finally, all sign changes and changes of stepwise quantities
between neighboring admissible points are located.
"""

import abc
import functools
import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np

from vrw_jax.base.outcomes import Outcome
from vrw_jax.branches.arclength import (
    AbstractContinuationProblem,
    ArclengthDriver,
    ArclengthOptions,
    ContinuationPoint,
    ContinuationStatus,
    Track,
    run_together,
)
from vrw_jax.branches.branch import FixedPoint, SpecialPoint
from vrw_jax.branches.jumps import continue_beyond_jumps, find_state_jumps
from vrw_jax.branches.roots import locate_function_roots
from vrw_jax.branches.test_functions import (
    BIFURCATIONS,
    BRANCH_POINT,
    FOLD,
    NEIMARK_SACKER,
    TestFunction,
    classify_multipliers,
    compute_multipliers,
    evaluate_bifurcations,
    has_unit_circle_pair,
)
from vrw_jax.gaits.finder import STATE_AGREEMENT_TOLERANCE
from vrw_jax.gaits.floquet import EQUAL_MODULI_DISTANCE, UNIT_CIRCLE_DISTANCE
from vrw_jax.lanes.batching import concatenate_tree_rows, select_tree_rows

COARSE_MESH_END_NAME = Outcome.MESH_TOO_COARSE.name.lower()
"""Name of a branch end at which the mesh is too coarse. Event-driven steps that start from the
computed gaits then do not repeat.
"""

ADMISSIBILITY = "sequence"
"""Name of the test function that is 1 at admissible points and -1 at all other points."""

MODULI = "multiplier_moduli"
"""Name of the test function that contains the moduli of all multipliers, largest first."""

EVENT_ORDER, EVENT_ORDER_CHANGE = "contact_order", "order_of_contacts_changes"
"""Name of the number that identifies the order of events, and of the special point at which it
changes.
"""

BORDER_COLLISION = "border_collision"
"""Kind of a special point at which a margin vanishes."""

# Estimated mesh error above which the mesh is refined.
MAX_SPECIAL_POINT_MESH_ERROR = 1e-8

QuantitiesByName = dict[str, np.ndarray]
"""Arrays of quantities with one element per point, by the name of the quantity."""


class PointTable(NamedTuple):
    """Points of branches with their quantities, in the order of each wheel's branch.

    Each array has a leading axis over the points, so that `select_tree_rows` and
    `concatenate_tree_rows` apply to the whole table.
    """

    points: ContinuationPoint
    owners: np.ndarray  # index of the wheel to which each point belongs
    quantities: QuantitiesByName
    tests: QuantitiesByName  # values of the test functions

    def reverse(self) -> "PointTable":
        """Return the table with the rates along the branch in the opposite direction."""
        points = self.points._replace(
            fraction_rate=-self.points.fraction_rate,
            arclength_tangent=-self.points.arclength_tangent,
        )
        return self._replace(
            points=points, tests=self.tests | {BRANCH_POINT: -self.tests[BRANCH_POINT]}
        )

    def find_pairs(self, indices: np.ndarray) -> list[tuple[int, int]]:
        """Return the pairs of successive points in `indices` that belong to the same branch."""
        pairs = zip(indices[:-1].tolist(), indices[1:].tolist(), strict=True)
        return [(i, j) for i, j in pairs if self.owners[i] == self.owners[j]]

    def changes_sign(self, name: str, pair: tuple[int, int]) -> bool:
        """Return whether a test function has opposite signs at two points."""
        left, right = self.tests[name][list(pair)]
        return bool(left * right < 0.0)


@dataclass(frozen=True)
class AbstractContinuation(abc.ABC):
    """Continuation of gaits of several wheels, with the quantities that locate special points."""

    continuation_problem: AbstractContinuationProblem
    arclength_options: ArclengthOptions
    wheels: Any  # tree of arrays with a leading axis over wheels
    parameter_bounds: np.ndarray

    test_functions: ClassVar[Mapping[str, TestFunction]] = BIFURCATIONS
    """Test functions by name; the name of one of a leg has the number of the leg in brackets."""

    linear_margin_substitutes: ClassVar[Mapping[str, str]] = {}
    """Names of margins whose roots are ill-conditioned. Each margin is mapped to the name of a
    quantity that vanishes linearly at the same point.
    """

    @property
    def driver(self) -> ArclengthDriver:
        """Return the driver of the continuation."""
        return ArclengthDriver(
            self.continuation_problem, self.arclength_options, np.asarray(self.parameter_bounds)
        )

    @property
    def parameter_unit(self) -> float:
        """Return the unit of the parameter in which special points are located."""
        return 1.0

    def make_fixed_point(self, point: ContinuationPoint) -> FixedPoint:
        """Return the fixed point of the return map at one point of a branch."""
        section_state, tangent = map(
            self.continuation_problem.section_state, (point.z, point.arclength_tangent)
        )
        tangent = np.append(tangent, point.fraction_rate)
        return FixedPoint(section_state, float(point.p), point.return_map_jacobian, tangent)

    @abc.abstractmethod
    def evaluate_point_quantities(self, wheels: Any, points: ContinuationPoint) -> QuantitiesByName:
        """Return quantities at each point by name, except those computed from the Jacobian.

        - `wheels`: one wheel per point.
        """

    def are_points_admissible(self, quantities: QuantitiesByName) -> np.ndarray:
        """Return whether each point is admissible, computed from the quantities at the points.

        A gait is admissible if its event-driven step returns to its section state. A fixed point of
        another map has no such step, and every finite fixed point is admissible.
        """
        if "outcome" not in quantities:
            return np.asarray(True)
        return (quantities["outcome"] == Outcome.STEPPED) & (
            quantities["closure"] <= STATE_AGREEMENT_TOLERANCE
        )

    def find_test_function(self, name: str) -> TestFunction | None:
        """Return the test function of a quantity, whose name may end with the label of a leg."""
        return self.test_functions.get(name.partition("[")[0])

    def evaluate_margin(self, name: str, quantities: QuantitiesByName) -> np.ndarray:
        """Return a margin at each point, combined with its substitute if there is one.

        The combined quantity is positive if and only if both are positive. It crosses zero
        continuously, because the substitute vanishes linearly where the margin vanishes. If the
        substitute is negative, the combined quantity equals the substitute.
        """
        margin = quantities[name]
        substitute = quantities.get(self.linear_margin_substitutes.get(name, ""))
        if substitute is None:
            return margin
        return np.where(substitute < 0.0, substitute, np.minimum(substitute, margin))

    def mask_undefined_quantities(
        self, quantities: QuantitiesByName, owners: np.ndarray
    ) -> QuantitiesByName:
        """Replace each quantity that is undefined for the wheel of a point by NaN."""
        return quantities

    def name_branch_end(self, quantities: QuantitiesByName, point_index: int) -> str:
        """Return the name of the special point at the end of a branch.

        The name is that of the failure of the event-driven step, if the step fails.

        - `point_index`: index of the first point beyond the end.
        """
        if "outcome" in quantities:
            step_outcome = Outcome(int(quantities["outcome"][point_index]))
            if step_outcome != Outcome.STEPPED:
                return step_outcome.name.lower()
        return COARSE_MESH_END_NAME if "mesh_error" in quantities else ADMISSIBILITY

    def is_same_gait(self, before: PointTable, after: PointTable) -> np.ndarray:
        """Return for each jump whether the points on both sides belong to the same branch."""
        return after.tests[ADMISSIBILITY] > 0.0

    def describe_branch_end(self, end_name: str, parameter_value: float) -> str:
        """Return a sentence that describes the end of a branch."""
        return f"{end_name.replace('_', ' ')} at {parameter_value:.9g} ends it."

    def is_mesh_limited(self, quantities: QuantitiesByName, end_names: Sequence[str]) -> bool:
        """Return whether the mesh limits the extent or the accuracy of a branch.

        `end_names` contains the names of the special points at the ends of the branch.
        """
        return COARSE_MESH_END_NAME in end_names or bool(
            np.max(quantities.get("mesh_error", 0.0)) > MAX_SPECIAL_POINT_MESH_ERROR
        )

    def make_table(self, points: ContinuationPoint, owners: np.ndarray) -> PointTable:
        """Return the table of points, of the wheels with the indices `owners`."""
        quantities = self.evaluate_point_quantities(select_tree_rows(self.wheels, owners), points)
        quantities |= evaluate_bifurcations(points.return_map_jacobian)
        quantities = self.mask_undefined_quantities(quantities, owners)
        tests = {
            name: self.evaluate_margin(name, quantities)
            for name, values in quantities.items()
            if values.ndim == 1
            and self.find_test_function(name)
            and name not in self.linear_margin_substitutes.values()
        }
        with np.errstate(divide="ignore", invalid="ignore"):
            tests[BRANCH_POINT] = tests[FOLD] / points.fraction_rate
        tests[MODULI] = np.abs(compute_multipliers(points.return_map_jacobian))
        is_admissible = points.is_admissible & self.are_points_admissible(quantities)
        tests[ADMISSIBILITY] = np.where(is_admissible, 1.0, -1.0)
        return PointTable(points, owners, quantities, tests)

    def continue_branches(
        self, owners: np.ndarray, z: np.ndarray, p: np.ndarray, direction_signs: np.ndarray
    ) -> list[Track]:
        """Continue branches of the wheels with the indices `owners` from given starts."""
        starts = zip(owners, z, p, direction_signs, strict=True)
        tasks = [
            self.driver.trace(select_tree_rows(self.wheels, owner), *start)
            for owner, *start in starts
        ]
        return run_together(self.continuation_problem, self.wheels, owners, tasks)

    def continue_in_both_directions(
        self, z: np.ndarray, p: np.ndarray, is_requested: np.ndarray
    ) -> dict[int, list[Track]]:
        """Continue the requested branches, and return two tracks for each index of a wheel.

        The first track decreases the parameter.
        """
        owners = np.repeat(np.flatnonzero(is_requested), 2)
        signs = np.tile([-1.0, 1.0], len(owners) // 2)
        tracks = self.continue_branches(owners, z[owners], p[owners], signs)
        if self.continuation_problem.has_kinks:
            tracks = continue_beyond_jumps(self, owners, tracks)
        return {int(owners[i]): tracks[i : i + 2] for i in range(0, len(owners), 2)}

    def solve_on_chords(
        self,
        owners: np.ndarray,
        left: ContinuationPoint,
        right: ContinuationPoint,
        fractions: np.ndarray,
    ) -> tuple[ContinuationPoint, np.ndarray]:
        """Solve for points of branches between neighboring points, and return whether each exists.

        Each new point lies in a plane that divides the chord between its neighbors.
        """
        problem, driver = self.continuation_problem, self.driver
        z = problem.interpolate(left.z, right.z, fractions)
        p = driver.compute_fraction(left.p + fractions * (right.p - left.p))
        slopes = (right.p - left.p) / driver.parameter_range
        tasks = [
            driver.solve_on_plane(
                select_tree_rows(self.wheels, owners[i]),
                z[i],
                p[i],
                (driver.coordinates(z[i], p[i]),
                 driver.coordinates(right.z[i] - left.z[i], slopes[i])),
            )
            for i in range(len(owners))
        ]  # fmt: skip
        points, is_found = zip(*run_together(problem, self.wheels, owners, tasks), strict=True)
        return stack_points(points), np.array(is_found)


def stack_points(points: Sequence[ContinuationPoint]) -> ContinuationPoint:
    """Return points with a leading axis."""
    return ContinuationPoint(*(np.stack(values) for values in zip(*points, strict=True)))


class RootRequest(NamedTuple):
    """Request to locate the root of a quantity between two points of a branch."""

    pair: tuple[int, int]  # indices of the left and the right point
    name: str  # name of the special point at the root
    # returns the quantity at each point, from the test functions; it changes its sign in the pair
    evaluate: Callable[[QuantitiesByName], np.ndarray]
    ranks: range = range(0)  # ranks of the multipliers whose moduli the quantity combines

    @classmethod
    def of_test(cls, pair: tuple[int, int], name: str, test_name: str) -> "RootRequest":
        """Request the root of one test function."""
        return cls(pair, name, operator.itemgetter(test_name))

    @classmethod
    def of_moduli(cls, pair: tuple[int, int], ranks: range) -> "RootRequest":
        """Request the root at which the mean modulus of the multipliers with these ranks is 1."""
        evaluate = lambda tests: np.mean(tests[MODULI][:, ranks.start : ranks.stop], -1) - 1.0
        return cls(pair, MODULI, evaluate, ranks)


# Largest ratio of the quantity next to its root to the quantity at an end of the bracket; at a jump
# the ratio is larger. The value is chosen because the point next to the root may be at nine tenths
# of the distance to the root.
MAX_VALUE_BESIDE_ROOT = 0.2


class LocatedRoot(NamedTuple):
    """Located root of a quantity between two points of a branch."""

    request: RootRequest
    name: str
    n_multipliers: int  # number of multipliers that cross the unit circle, 0 for other kinds
    parameter: float  # value of the continued parameter at the root
    fraction: float  # location of the root on the chord from the left to the right point
    beside: PointTable  # the point on the side of the left point

    @property
    def position(self) -> float:
        """Return the position of the root along its branch."""
        return self.request.pair[0] + self.fraction

    def is_between(self, pair: tuple[int, int]) -> bool:
        """Return whether the root is located between two points."""
        return pair[0] <= self.request.pair[0] and self.request.pair[1] <= pair[1]

    def vanishes(self, tests: QuantitiesByName) -> bool:
        """Return whether the quantity vanishes at its root. Otherwise it jumps there.

        - `tests`: test functions of the branch on which the root is located.
        """
        (beside,) = np.abs(self.request.evaluate(self.beside.tests))
        at_ends = np.max(np.abs(self.request.evaluate(tests)[list(self.request.pair)]))
        return not beside > MAX_VALUE_BESIDE_ROOT * at_ends


class _AdmissibleRange(NamedTuple):
    """Admissible points of one wheel's branch."""

    owner: int
    indices: np.ndarray
    # last point of the range and first point beyond it, for the ends 0 and 1; an end is omitted if
    # the branch has no point beyond it
    end_pairs: dict[int, tuple[int, int]]


# Width of the bracket, in the parameter, at which the search ends; for maps it is a fraction of the
# range of the parameter.
LOCATION_PARAMETER_ACCURACY = 1e-10
# Largest distance of an extrapolated zero of a margin from the last point, in shortest steps. The
# value is chosen because the last step is at most twice as long as the shortest one.
MAX_EXTRAPOLATED_STEPS = 4.0
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
# Fraction of a bracket within which ranks are treated as crossing together. The value is chosen
# because three equal multipliers are computed to 1e-5, which is 1e-4 of a bracket.
MAX_EQUAL_LOCATION_DISTANCE = 1e-3
# Relative distance below which two changes of a stepwise quantity are the same change. The value is
# chosen because two searches may differ by the change of the parameter over the shortest
# continuation step.
MAX_EQUAL_PARAMETER_DISTANCE = 1e-7


class _SpecialPointLocator(NamedTuple):
    """Locator of special points and branch ends between the computed points of branches."""

    continuation: AbstractContinuation
    table: PointTable

    def find_admissible_ranges(self, start_indices: Mapping[int, int]) -> list[_AdmissibleRange]:
        """Find for each wheel the range of admissible points that contains the start of its branch.

        `start_indices` contains the number of points before the start, for each wheel.
        """
        ranges = []
        for owner, n_before_start in start_indices.items():
            # An inadmissible entry on each side represents the missing point beyond that end.
            indices = np.pad(np.flatnonzero(self.table.owners == owner), 1, constant_values=-1)
            is_admissible = self.table.tests[ADMISSIBILITY][indices] > 0.0
            is_admissible[[0, -1]] = False
            # If the start is a special point, it may lie beyond the end. A neighbor is then used.
            candidates = np.minimum(n_before_start + np.array([1, 2, 0]), len(indices) - 1)
            admissible_positions = candidates[is_admissible[candidates]]
            if not len(admissible_positions):
                continue
            inadmissible_positions = np.flatnonzero(~is_admissible)
            i = np.searchsorted(inadmissible_positions, admissible_positions[0])
            below, above = inadmissible_positions[[i - 1, i]]
            indices_in_range = indices[below + 1 : above]
            beyond = indices[[below, above]].tolist()
            end_pairs = zip(indices_in_range[[0, -1]].tolist(), beyond, strict=True)
            ranges.append(
                _AdmissibleRange(
                    owner,
                    indices_in_range,
                    {end: pair for end, pair in enumerate(end_pairs) if pair[1] >= 0},
                )
            )
        return ranges

    def join_located_ends(
        self,
        admissible_ranges: list[_AdmissibleRange],
        located_ends: Mapping[tuple[int, int], LocatedRoot],
    ) -> PointTable:
        """Return a table with the points of all ranges and those next to located ends."""
        tables = []
        for owner, indices, end_pairs in admissible_ranges:
            tables_of_range = [select_tree_rows(self.table, indices)]
            for end in end_pairs:
                beside = located_ends[owner, end].beside
                if not beside.tests[ADMISSIBILITY][0] > 0.0:
                    continue
                if end == 0:  # The end was located in the opposite direction.
                    tables_of_range.insert(0, beside.reverse())
                else:
                    tables_of_range.append(beside)
            tables += tables_of_range
        return concatenate_tree_rows(*tables)

    def locate_roots(self, requests: list[RootRequest]) -> list[LocatedRoot]:
        """Locate the root that each request describes."""
        if not requests:
            return []
        left, right = (
            select_tree_rows(self.table, indices)
            for indices in np.array([request.pair for request in requests]).T
        )
        every = np.arange(len(requests))
        parameters = {
            (i, fraction): p
            for fraction, end in ((0.0, left), (1.0, right))
            for i, p in enumerate(end.points.p)
        }

        def solve(fractions: np.ndarray, indices: np.ndarray) -> PointTable:
            left_points, right_points = select_tree_rows((left.points, right.points), indices)
            points, is_found = self.continuation.solve_on_chords(
                left.owners[indices], left_points, right_points, fractions
            )
            parameters.update(zip(zip(indices, fractions, strict=True), points.p, strict=True))
            points = points._replace(is_admissible=points.is_admissible & is_found)
            table = self.continuation.make_table(points, left.owners[indices])
            # A transposed array has its points on the last axis.
            return table._replace(
                tests={
                    name: np.where(is_found, values.T, np.nan).T
                    for name, values in table.tests.items()
                }
            )

        def evaluate(table: PointTable, indices: np.ndarray) -> np.ndarray:
            return np.array(
                [requests[i].evaluate(table.tests)[row] for row, i in enumerate(indices)]
            )

        accuracy = LOCATION_PARAMETER_ACCURACY * self.continuation.parameter_unit
        distances = np.maximum(np.abs(right.points.p - left.points.p), accuracy)
        tolerances = np.minimum(accuracy / distances, MIN_BRACKET_FRACTION)
        locations = locate_function_roots(
            lambda fractions, indices: evaluate(solve(fractions, indices), indices),
            (evaluate(left, every), evaluate(right, every)),
            tolerances,
        )
        # Even for an exact root, the point next to it lies to the left, where the gaits are
        # admissible.
        beside = solve(np.maximum(locations.left_bracket_ends - tolerances, 0.0), every)
        for retry_fraction in RETRY_CHORD_FRACTIONS:
            failed = np.flatnonzero(~(beside.tests[ADMISSIBILITY] > 0.0))
            if len(failed):
                retried = solve(retry_fraction * locations.left_bracket_ends[failed], failed)
                rows = every.copy()
                rows[failed] = len(rows) + np.arange(len(failed))
                beside = select_tree_rows(concatenate_tree_rows(beside, retried), rows)
        return [
            LocatedRoot(
                request,
                request.name,
                BIFURCATIONS[FOLD if request.name == BRANCH_POINT else request.name].n_multipliers
                if request.name in (*BIFURCATIONS, BRANCH_POINT)
                else 0,
                float(parameters[i, fraction]),
                float(fraction),
                select_tree_rows(beside, slice(i, i + 1)),
            )
            for i, (request, fraction) in enumerate(
                zip(requests, locations.best_locations, strict=True)
            )
        ]

    def find_crossed_ends(self, pair: tuple[int, int]) -> list[str]:
        """Return the names of the branch-ending quantities that change sign between two points."""
        return [
            name
            for name in self.table.tests
            if (test := self.continuation.find_test_function(name))
            and test.ends_branch
            and self.table.changes_sign(name, pair)
        ]

    def is_mesh_limited(self, admissible_range: _AdmissibleRange) -> bool:
        """Return whether the mesh limits a branch, before its special points are located."""
        quantities = self.table.quantities
        unexplained_ends = [
            self.continuation.name_branch_end(quantities, pair[1])
            for pair in admissible_range.end_pairs.values()
            if not self.find_crossed_ends(pair)
        ]
        return self.continuation.is_mesh_limited(
            select_tree_rows(quantities, admissible_range.indices), unexplained_ends
        )

    def locate_branch_ends(
        self, admissible_ranges: list[_AdmissibleRange]
    ) -> dict[tuple[int, int], LocatedRoot]:
        """Locate the nearest root of a quantity beyond each end of each branch.

        The keys of the result are (wheel index, end), where the end is 0 or 1.
        """
        requests = {
            (owner, end, name): RootRequest.of_test(pair, name, name)
            for owner, _, end_pairs in admissible_ranges
            for end, pair in end_pairs.items()
            for name in self.find_crossed_ends(pair) or [ADMISSIBILITY]
        }
        located_ends: dict[tuple[int, int], LocatedRoot] = {}
        for (owner, end, _), root in zip(
            requests, self.locate_roots(list(requests.values())), strict=True
        ):
            nearest = located_ends.setdefault((owner, end), root)
            if root.fraction < nearest.fraction:
                located_ends[owner, end] = root
        return located_ends

    def extrapolate_stalled_ends(
        self,
        admissible_ranges: list[_AdmissibleRange],
        statuses: Mapping[int, Sequence[ContinuationStatus]],
    ) -> dict[tuple[int, int], LocatedRoot]:
        """Return the zeros of margins just beyond ends at which no step is short enough.

        Where an orbit touches a guard, the return map has an infinite derivative on one side. The
        margin is smooth on the other side, up to the last point of the branch.
        """
        p, located_ends = self.table.points.p, {}
        driver = self.continuation.driver
        max_distance = (
            MAX_EXTRAPOLATED_STEPS * self.continuation.arclength_options.min_ds
        ) * driver.parameter_range
        for owner, indices, end_pairs in admissible_ranges:
            for end, status in enumerate(statuses[owner]):
                last = indices[2::-1] if end == 0 else indices[-3:]
                if (
                    status != ContinuationStatus.STEP_SIZE_UNDERFLOW
                    or end in end_pairs
                    or len(last) < 3
                ):
                    continue
                for name, values in self.table.tests.items():
                    test, margin = self.continuation.find_test_function(name), values[last]
                    if test is None or test.kind != BORDER_COLLISION or not margin[-1] > 0.0:
                        continue
                    # The parameter is a quadratic polynomial of the margin, evaluated at zero.
                    root = float(np.polyval(np.polyfit(margin, p[last] - p[last[-1]], 2), 0.0))
                    is_falling = margin[-1] < margin[-2] < margin[0]
                    if is_falling and abs(root) <= max_distance:
                        index = int(last[-1])
                        located_ends[owner, end] = LocatedRoot(
                            RootRequest.of_test((index, index), name, name),
                            name,
                            0,
                            float(p[index] + root),
                            0.0,
                            select_tree_rows(self.table, slice(index, index + 1)),
                        )
        return located_ends

    def locate_inner_special_points(self) -> list[LocatedRoot]:
        """Locate all special points of the branches except their ends."""
        points, tests = self.table.points, self.table.tests
        problem, jump_pairs = self.continuation.continuation_problem, []
        if problem.has_kinks:
            lower_bound, upper_bound = self.continuation.parameter_bounds
            jump_pairs = find_state_jumps(
                problem.section_state(points.z),
                points.p / (upper_bound - lower_bound),
                points.fraction_rate,
                self.table.find_pairs(np.arange(len(points.p))),
            )
        has_jump = lambda pair: any(pair[0] <= i and j <= pair[1] for i, j in jump_pairs)
        is_special = lambda root: (
            (root.n_multipliers == 0 or root.vanishes(tests))
            and (
                root.name != NEIMARK_SACKER
                or has_unit_circle_pair(root.beside.points.return_map_jacobian[0])
            )
        )
        requests = [request for request in self.list_root_requests() if not has_jump(request.pair)]
        roots = [
            *filter(is_special, self.locate_roots(requests)),
            *map(self._represent_jump, jump_pairs),
        ]
        is_off_circle = (np.abs(tests[MODULI] - 1.0) > UNIT_CIRCLE_DISTANCE).all(-1)
        pairs = self.table.find_pairs(np.flatnonzero(is_off_circle))
        return self.add_multiple_bifurcations(
            [pair for pair in pairs if not has_jump(pair)], self._drop_duplicates(roots)
        )

    def _represent_jump(self, pair: tuple[int, int]) -> LocatedRoot:
        """Represent a jump as a root, at the point of the pair where the continuation stalled."""
        (i, j), p = pair, self.table.points.p
        change_before = abs(p[i] - p[max(i - 1, 0)])
        change_after = abs(p[min(j + 1, len(p) - 1)] - p[j])
        fraction, index = (0.0, i) if change_before <= change_after else (1.0, j)
        return LocatedRoot(
            RootRequest.of_test(pair, EVENT_ORDER_CHANGE, EVENT_ORDER),
            EVENT_ORDER_CHANGE,
            0,
            float(p[index]),
            fraction,
            select_tree_rows(self.table, slice(index, index + 1)),
        )

    def list_root_requests(self) -> list[RootRequest]:
        """List the roots of bifurcation functions, margins and stepwise quantities to locate."""
        points, _, _, tests = self.table[0], *self.table[1:]
        # At a branch point the sign of the fold's margin is determined by round-off.
        regular = np.flatnonzero(~(np.abs(tests[FOLD]) < MAX_ZERO_FOLD_MARGIN))
        regular_pairs = self.table.find_pairs(regular)
        has_turned = {
            pair: np.prod(points.fraction_rate[list(pair)]) < 0.0 for pair in regular_pairs
        }
        located = {
            name: test
            for name in tests
            if (test := self.continuation.find_test_function(name))
            and (not test.ends_branch or test.kind == BORDER_COLLISION)
        }
        requests = [
            RootRequest.of_test(
                pair, BRANCH_POINT if name == FOLD and not has_turned[pair] else name, name
            )
            for pair in regular_pairs
            for name, test in located.items()
            if not test.is_stepwise and self.table.changes_sign(name, pair)
        ]
        # On the side branch of a pitchfork, the margin touches zero where the parameter turns.
        requests += [
            RootRequest.of_test(pair, BRANCH_POINT, BRANCH_POINT)
            for pair in regular_pairs
            if has_turned[pair] and np.prod(tests[FOLD][list(pair)]) > 0.0
        ]
        for name, test in located.items():
            if not test.is_stepwise:
                continue
            for pair in self.table.find_pairs(np.flatnonzero(np.isfinite(tests[name]))):
                values = tests[name][list(pair)].tolist()
                if values[0] != values[1]:
                    # Between the two values of the quantity there may be further values.
                    requests += [
                        RootRequest(pair, test.kind, functools.partial(_compare_with, name, value))
                        for value in values
                    ]
        return requests

    def _drop_duplicates(self, roots: list[LocatedRoot]) -> list[LocatedRoot]:
        """Return the roots, with each change of a stepwise quantity only once.

        Each change is located twice, as the end of one value and as the start of the next value. A
        change is also omitted at a root of a quantity that explains it.
        """
        stepwise_kinds = [
            t.kind for t in self.continuation.test_functions.values() if t.is_stepwise
        ]

        def is_same_change(root: LocatedRoot, earlier: LocatedRoot) -> bool:
            test = self.continuation.find_test_function(earlier.name)
            is_explained = test is not None and test.explains == root.name
            return (
                (root.name == earlier.name in stepwise_kinds or is_explained)
                and root.request.pair == earlier.request.pair
                and abs(root.parameter - earlier.parameter)
                <= MAX_EQUAL_PARAMETER_DISTANCE * abs(earlier.parameter)
            )

        distinct: list[LocatedRoot] = []
        for root in roots:
            if not any(is_same_change(root, earlier) for earlier in distinct):
                distinct.append(root)
        return distinct

    def add_multiple_bifurcations(
        self, pairs: list[tuple[int, int]], roots: list[LocatedRoot]
    ) -> list[LocatedRoot]:
        """Replace bifurcations that explain only some of the crossing multipliers.

        Several multipliers that cross at once change no sign of a determinant. Multipliers are
        ranked by modulus, the largest first. If ranks are unexplained, the point at which the
        modulus of each crosses 1 is located; if several cross together, that of their mean.
        """
        moduli = self.table.tests[MODULI]
        requests = []
        for pair in pairs:
            n_explained = sum(root.n_multipliers for root in roots if root.is_between(pair))
            ranks = range(*sorted(np.sum(moduli[list(pair)] > 1.0, -1).tolist()))
            if len(ranks) > n_explained:
                requests += [RootRequest.of_moduli(pair, range(i, i + 1)) for i in ranks]
        # Each group contains the roots for ranks that may cross the unit circle together.
        groups: list[list[LocatedRoot]] = []
        for root in self.locate_roots(requests):
            if not root.vanishes(self.table.tests):
                continue
            last = groups[-1][-1] if groups else None
            if (
                last is not None
                and last.request.pair == root.request.pair
                and abs(root.fraction - last.fraction) <= MAX_EQUAL_LOCATION_DISTANCE
            ):
                groups[-1].append(root)
            else:
                groups.append([root])
        first_ranks = [group[0].request.ranks.start for group in groups]
        mean_roots = self.locate_roots(
            [
                RootRequest.of_moduli(group[0].request.pair, range(first, first + len(group)))
                for group, first in zip(groups, first_ranks, strict=True)
            ]
        )
        multiple: list[LocatedRoot] = []
        for group, mean_root in zip(groups, mean_roots, strict=True):
            moduli_beside = mean_root.beside.tests[MODULI][0, list(mean_root.request.ranks)]
            cross_together = (
                len(group) == 1 or np.max(np.abs(moduli_beside - 1.0)) <= EQUAL_MODULI_DISTANCE
            )
            for root in [mean_root] if cross_together else group:
                rates = self.table.points.fraction_rate[list(root.request.pair)]
                counts = classify_multipliers(
                    root.beside.points.return_map_jacobian[0],
                    root.request.ranks,
                    bool(np.prod(rates) < 0.0),
                )
                multiple += [
                    root._replace(name=name, n_multipliers=n) for name, n in counts.items()
                ]
        replaced_pairs = {root.request.pair for root in multiple}
        is_replaced = lambda root: (
            root.n_multipliers > 0 and any(map(root.is_between, replaced_pairs))
        )
        return [root for root in roots if not is_replaced(root)] + multiple


def _compare_with(name: str, value: float, tests: QuantitiesByName) -> np.ndarray:
    """Return 1 for each point at which a stepwise quantity has the given value, and else -1."""
    values = tests[name]
    return np.where(np.isnan(values), np.nan, np.where(values == value, 1.0, -1.0))


class BranchData(NamedTuple):
    """Branch of one wheel and its located special points, as arrays without labels."""

    points: ContinuationPoint
    quantities: QuantitiesByName
    special_points: tuple[SpecialPoint, ...]
    end_reasons: tuple[str, str]
    # whether the mesh limits the branch, see `AbstractContinuation.is_mesh_limited`
    is_mesh_limited: bool


CycleFinderFactory = Callable[[int, ContinuationPoint], Callable[[], Any]]
"""Function that maps (wheel index, point) to a function that finds the limit cycle at
that point.
"""


def continue_and_locate_special_points(
    continuation: AbstractContinuation,
    z: np.ndarray,
    parameter_values: np.ndarray,
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
    branches: list[BranchData | None] = [None] * len(has_branch_start)
    statuses, start_indices, points, owners = {}, {}, [], []
    for owner, tracks in continuation.continue_in_both_directions(
        np.asarray(z), np.asarray(parameter_values), has_branch_start
    ).items():
        statuses[owner] = [track.status for track in tracks]
        reversed_points, forward_points = (track.points for track in tracks)
        if statuses[owner] == [ContinuationStatus.CURVE_CLOSED] * 2:
            forward_points = []  # In the first direction, a closed curve is complete.
        turned = [
            point._replace(
                fraction_rate=-point.fraction_rate, arclength_tangent=-point.arclength_tangent
            )
            for point in reversed(reversed_points)
        ]
        # Both directions contain the start.
        branch_points = [*turned, *forward_points[min(len(turned), 1) :]]
        if branch_points:
            start_indices[owner] = max(len(turned) - 1, 0)
            points += branch_points
            owners += [owner] * len(branch_points)
    if not points:
        return branches
    table = continuation.make_table(stack_points(points), np.array(owners))
    locator = _SpecialPointLocator(continuation, table)
    admissible_ranges = locator.find_admissible_ranges(start_indices)
    if not is_finest_mesh:
        for owner, indices, _ in filter(locator.is_mesh_limited, admissible_ranges):
            rows = select_tree_rows(table, indices)
            branches[owner] = BranchData(rows.points, rows.quantities, (), ("", ""), True)
        admissible_ranges = [x for x in admissible_ranges if branches[x.owner] is None]
    if not admissible_ranges:
        return branches
    located_ends = locator.locate_branch_ends(admissible_ranges)
    stalled_ends = locator.extrapolate_stalled_ends(admissible_ranges, statuses)
    joined = locator.join_located_ends(admissible_ranges, located_ends)
    inner_roots = _SpecialPointLocator(continuation, joined).locate_inner_special_points()

    kinds = {BRANCH_POINT, *(test.kind for test in continuation.test_functions.values())}

    def make_special_point(root: LocatedRoot, ends_branch: bool) -> SpecialPoint:
        beside, name = select_tree_rows(root.beside.points, 0), root.name
        if name == ADMISSIBILITY:
            name = continuation.name_branch_end(table.quantities, root.request.pair[1])
        test = continuation.find_test_function(name)
        return SpecialPoint(
            name if name in kinds else test.kind if test else "lost",
            name,
            root.parameter,
            continuation.make_fixed_point(beside),
            ends_branch,
            make_cycle_finder(int(root.beside.owners[0]), beside) if make_cycle_finder else None,
            root.n_multipliers,
        )

    for owner, _, _ in admissible_ranges:
        roots = [root for root in inner_roots if root.beside.owners[0] == owner]
        roots.sort(key=lambda root: root.position)
        special_points = [make_special_point(root, False) for root in roots]
        end_reasons = []
        for end, status in enumerate(statuses[owner]):
            located_end = located_ends.get((owner, end), stalled_ends.get((owner, end)))
            if located_end is None:
                end_reasons.append(status.meaning)
                continue
            end_point = make_special_point(located_end, True)
            special_points.insert(0 if end == 0 else len(special_points), end_point)
            end_reasons.append(continuation.describe_branch_end(end_point.name, end_point.value))
        rows = select_tree_rows(joined, joined.owners == owner)
        end_names = [point.name for point in special_points if point.ends_branch]
        branches[owner] = BranchData(
            rows.points,
            rows.quantities,
            tuple(special_points),
            (end_reasons[0], end_reasons[1]),
            continuation.is_mesh_limited(rows.quantities, end_names),
        )
    return branches
