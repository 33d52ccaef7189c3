"""Continuation of several branches at once, with the quantities that locate special points."""

import abc
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
from vrw_jax.branches.branch import (
    BIFURCATIONS,
    BRANCH_POINT,
    FOLD,
    FixedPoint,
    TestFunction,
    compute_multipliers,
    evaluate_bifurcations,
)
from vrw_jax.gaits.finder import STATE_AGREEMENT_TOLERANCE
from vrw_jax.lanes.batching import select_tree_rows

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
        tests = self.tests | {BRANCH_POINT: -self.tests[BRANCH_POINT]}
        return self._replace(points=self.points.reverse(), tests=tests)

    def find_pairs(self, indices: np.ndarray) -> list[tuple[int, int]]:
        """Return the pairs of successive points in `indices` that belong to the same branch."""
        pairs = zip(indices[:-1].tolist(), indices[1:].tolist(), strict=True)
        return [(i, j) for i, j in pairs if self.owners[i] == self.owners[j]]

    def changes_sign(self, name: str, pair: tuple[int, int]) -> bool:
        """Return whether a test function has opposite signs at two points."""
        left, right = self.tests[name][list(pair)]
        return bool(left * right < 0.0)


# Largest number of jumps in one direction of a branch.
MAX_JUMPS_PER_DIRECTION = 20
# Largest relative change of period and step length at a jump within one branch. The value is chosen
# because a change in the order of two impacts changes period and step length by 1e-4.
MAX_MEASURE_CHANGE_AT_JUMP = 0.01
# Changes of the parameter, as fractions of its range, after which a gait beyond a jump is searched
# for. The values are chosen because two impacts with unilateral contact change their order within a
# fraction of 1e-4.
PARAMETER_CHANGE_FRACTIONS = (
    1e-9, 1e-7, 1e-5, 3e-5, 1e-4, 2e-4, 3e-4, 5e-4, 1e-3,
)  # fmt: skip


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

    def make_point_reader(self, owner: int, point: ContinuationPoint) -> Callable | None:
        """Return a function that finds the gait at a point, or None if no gait can be found."""
        return None

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
        """Return whether period and step length are about equal before and after each jump."""
        is_same = after.tests[ADMISSIBILITY] > 0.0
        for name in {"period", "step_length"} & before.quantities.keys():
            values, new_values = before.quantities[name], after.quantities[name]
            is_same &= np.abs(new_values - values) <= MAX_MEASURE_CHANGE_AT_JUMP * np.abs(values)
        return is_same

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
            name: values
            for name, values in quantities.items()
            if values.ndim == 1
            and self.find_test_function(name)
            and name not in self.linear_margin_substitutes.values()
        }
        # The combined quantity is positive if and only if both are positive. It crosses zero
        # continuously, because the substitute vanishes linearly where the margin vanishes.
        for name in tests.keys() & self.linear_margin_substitutes.keys():
            if (substitute := quantities.get(self.linear_margin_substitutes[name])) is not None:
                least = np.minimum(substitute, tests[name])
                tests[name] = np.where(substitute < 0.0, substitute, least)
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
            self._continue_beyond_jumps(owners, tracks)
        return {int(owners[i]): tracks[i : i + 2] for i in range(0, len(owners), 2)}

    def _continue_beyond_jumps(self, owners: np.ndarray, tracks: list[Track]) -> None:
        """Continue stalled tracks beyond jumps of the section state, all of them together.

        With unilateral contact, the state jumps if two impacts change their order, because the
        effects of two impacts do not commute. The search for the gait beyond a jump starts from the
        last gait, with the smallest change of the parameter that leads to a similar gait.
        """
        lower_bound, upper_bound = self.parameter_bounds
        may_continue = set(range(len(tracks)))
        for _ in range(MAX_JUMPS_PER_DIRECTION):
            stalled = [
                i
                for i in sorted(may_continue)
                if tracks[i].status == ContinuationStatus.STEP_SIZE_UNDERFLOW
                and len(tracks[i].points) > 1
            ]
            may_continue.clear()
            for change in PARAMETER_CHANGE_FRACTIONS:
                rows = np.array([i for i in stalled if i not in may_continue], int)
                if not len(rows):
                    break
                ends = stack_points([tracks[i].points[-1] for i in rows])
                p = ends.p + np.sign(ends.fraction_rate) * change * (upper_bound - lower_bound)
                is_inside = (lower_bound < p) & (p < upper_bound)
                rows, ends, p = select_tree_rows((rows, ends, p), is_inside)
                signs = np.sign(ends.fraction_rate)
                new_tracks = self.continue_branches(owners[rows], ends.z, p, signs)
                is_found = np.array([len(track.points) > 1 for track in new_tracks], bool)
                found = np.flatnonzero(is_found)
                if not len(found):
                    continue
                starts = stack_points([new_tracks[k].points[0] for k in found])
                before, after = (
                    self.make_table(points, owners[rows[found]])
                    for points in (select_tree_rows(ends, found), starts)
                )
                for k in found[self.is_same_gait(before, after)]:
                    i, track = int(rows[k]), new_tracks[k]
                    tracks[i] = track._replace(points=[*tracks[i].points, *track.points])
                    may_continue.add(i)

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
