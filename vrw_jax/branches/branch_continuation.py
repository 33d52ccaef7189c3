"""Continuation of several branches at once, with the quantities that locate special points."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from vrw_jax.base.results import Outcome
from vrw_jax.base.small_matrices import compute_multipliers
from vrw_jax.branches.arclength import (
    ArclengthDriver,
    ContinuationPoint,
    ContinuationStatus,
    NewtonStep,
    QuantitiesByName,
    Track,
    run_together,
)
from vrw_jax.branches.branch import (
    BRANCH_POINT,
    FOLD,
    FixedPoint,
    TestFunction,
    evaluate_bifurcations,
)
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

    def changes_sign(self, name: str, pair: tuple[int, int], counts_zero: bool = False) -> bool:
        """Return whether a test function has opposite signs at two points.

        - `counts_zero`: whether it may also be zero at one of them and positive at the other.
        """
        left, right = self.tests[name][list(pair)]
        is_zero = counts_zero and left * right == 0.0 and left + right > 0.0
        return bool(left * right < 0.0 or is_zero)


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


START_DISTANCE_FACTORS = (2.0, 10.0)
"""Largest distances of a start from a singular point, as multiples of that of the plane on which it
is searched for. The first excludes the known branch, which curves back to the plane. The second is
chosen because branches may cross at small angles.
"""

START_FRACTIONS = (1.0, 0.1, 0.01, 0.002)
"""Distances of these planes, as fractions of the first continuation step. The last ones are chosen
because a branch of gaits may end soon after it begins, when the events change their order.
"""

MIN_SINGULAR_VALUE = 1e-9
"""Relative singular value of the equations below which a tangent has few accurate digits."""


def are_equations_regular(return_map_jacobian: np.ndarray) -> bool:
    """Return whether the tangent of a branch is determined at a fixed point."""
    if not np.isfinite(return_map_jacobian).all():
        return False
    equations = np.eye(len(return_map_jacobian)) - return_map_jacobian
    singular_values = np.linalg.svd(equations, compute_uv=False)
    return bool(singular_values[-1] > MIN_SINGULAR_VALUE * max(1.0, singular_values[0]))


@dataclass(frozen=True)
class Continuation(ArclengthDriver):
    """Continuation of the branches of several wheels, with what locates their special points.

    - `wheels`: a tree of arrays with a leading axis over wheels;
    - `crossed_tangent`: tangent of a known branch at the start, which the continued branch crosses;
    - `is_doubled`: whether the continued branch then has twice the period of the known branch, so
      that both of its halves contain the same gaits.
    """

    wheels: Any
    crossed_tangent: np.ndarray | None = None
    is_doubled: bool = False

    @property
    def location_unit(self) -> float:
        """Return the unit of the parameter in which special points are located."""
        unit = self.problem.location_unit
        return float(self.parameter_range) if unit is None else unit

    def make_fixed_point(self, point: ContinuationPoint) -> FixedPoint:
        """Return the fixed point of the return map at one point of a branch."""
        section_state, tangent = map(self.problem.section_state, (point.z, point.arclength_tangent))
        units = np.broadcast_to(self.problem.section_units, section_state.shape)
        tangent = np.append(units * tangent, self.parameter_range * point.fraction_rate)
        jacobian = units[:, None] * point.return_map_jacobian / units
        return FixedPoint(units * section_state, float(point.p), jacobian, tangent)

    def find_test_function(self, name: str) -> TestFunction | None:
        """Return the test function of a quantity, whose name may end with the label of a leg."""
        return self.problem.test_functions.get(name.partition("[")[0])

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

    def is_mesh_limited(self, quantities: QuantitiesByName, end_names: Sequence[str]) -> bool:
        """Return whether the mesh limits the extent or the accuracy of a branch.

        `end_names` contains the names of the special points at the ends of the branch.
        """
        return COARSE_MESH_END_NAME in end_names or bool(
            np.max(quantities.get("mesh_error", 0.0)) > MAX_SPECIAL_POINT_MESH_ERROR
        )

    def make_table(self, points: ContinuationPoint, owners: np.ndarray) -> PointTable:
        """Return the table of points, of the wheels with the indices `owners`."""
        quantities = self.problem.measure(select_tree_rows(self.wheels, owners), points)
        quantities |= evaluate_bifurcations(points.return_map_jacobian)
        quantities = self.problem.mask_undefined_quantities(quantities, owners)
        tests = {
            name: values
            for name, values in quantities.items()
            if values.ndim == 1
            and self.find_test_function(name)
            and name not in self.problem.linear_margin_substitutes.values()
        }
        # The combined quantity is positive if and only if both are positive. It crosses zero
        # continuously, because the substitute vanishes linearly where the margin vanishes.
        for name in tests.keys() & self.problem.linear_margin_substitutes.keys():
            if (
                substitute := quantities.get(self.problem.linear_margin_substitutes[name])
            ) is not None:
                least = np.minimum(substitute, tests[name])
                tests[name] = np.where(substitute < 0.0, substitute, least)
        with np.errstate(divide="ignore", invalid="ignore"):
            tests[BRANCH_POINT] = tests[FOLD] / points.fraction_rate
        tests[MODULI] = np.abs(compute_multipliers(points.return_map_jacobian))
        is_admissible = points.is_admissible & self.problem.are_points_admissible(quantities)
        tests[ADMISSIBILITY] = np.where(is_admissible, 1.0, -1.0)
        return PointTable(points, owners, quantities, tests)

    def continue_branches(
        self, owners: np.ndarray, z: np.ndarray, p: np.ndarray, direction_signs: np.ndarray
    ) -> list[Track]:
        """Continue branches of the wheels with the indices `owners` from given starts."""
        starts = zip(owners, z, p, direction_signs, strict=True)
        tasks = [
            self.trace(select_tree_rows(self.wheels, owner), *start) for owner, *start in starts
        ]
        return run_together(self.problem, self.wheels, owners, tasks)

    def continue_in_both_directions(
        self, z: np.ndarray, p: np.ndarray, is_requested: np.ndarray
    ) -> dict[int, list[Track]]:
        """Continue the requested branches, and return two tracks for each index of a wheel.

        The first track decreases the parameter. On a branch that crosses, it goes back through the
        crossing.
        """
        if self.crossed_tangent is not None:
            start = self._find_crossing_branch(z[0], p[0], self.crossed_tangent)
            if start is None:
                return {}
            outward = np.sign(start.fraction_rate)
            signs = np.array([outward] if self.is_doubled else [-outward, outward])
            rows, p = np.repeat(start.z[None], len(signs), 0), np.repeat([start.p], len(signs))
            tracks = self._continue_from(np.zeros(len(signs), int), rows, p, signs)
            return {0: [Track([], ContinuationStatus.BRANCH_SWITCHED), *tracks][-2:]}
        owners = np.repeat(np.flatnonzero(is_requested), 2)
        signs = np.tile([-1.0, 1.0], len(owners) // 2)
        tracks = self._continue_from(owners, z[owners], p[owners], signs)
        if self.problem.may_start_singular:
            points = tracks[0].points
            if not points or not are_equations_regular(points[0].return_map_jacobian):
                start = self._find_regular_start(z, p)
                if start is None:
                    return {}
                rows, p = np.repeat(start.z[None], 2, 0), np.repeat([start.p], 2)
                tracks = self._continue_from(owners, rows, p, signs)
        return {int(owners[i]): tracks[i : i + 2] for i in range(0, len(owners), 2)}

    def _continue_from(
        self, owners: np.ndarray, z: np.ndarray, p: np.ndarray, signs: np.ndarray
    ) -> list[Track]:
        tracks = self.continue_branches(owners, z, p, signs)
        if self.problem.has_kinks:
            self._continue_beyond_jumps(owners, tracks)
        return tracks

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

    def _find_crossing_branch(
        self, z: np.ndarray, p: float, tangent: np.ndarray
    ) -> ContinuationPoint | None:
        """Find a fixed point on the branch that crosses that with the given tangent at (z, p).

        At the crossing, the linear equations have two solutions. The search is on planes across the
        one that is perpendicular to the tangent of the known branch.
        """
        tangent = tangent / np.linalg.norm(tangent)
        step = NewtonStep(
            *map(np.asarray, self.problem.linearize(self.wheels, z[None], np.array([p])))
        )
        equations = np.eye(step.return_map_jacobian.shape[-1]) - step.return_map_jacobian[0]
        known_tangent = self.problem.section_state(np.asarray(step.branch_tangent[0]))
        by_fraction = equations @ (self.parameter_range * known_tangent)
        extended = np.nan_to_num(np.column_stack([equations, -by_fraction]))
        null_space = np.linalg.svd(extended)[2][-2:]
        direction = null_space.T @ np.array([[0.0, 1.0], [-1.0, 0.0]]) @ (null_space @ tangent)
        direction = direction / np.linalg.norm(direction)
        center = self.coordinates(z, self.compute_fraction(p))
        for factor, fraction in itertools.product(START_DISTANCE_FACTORS, START_FRACTIONS):
            distance = fraction * self.options.initial_ds
            targets = [
                (center + distance * (normal + offset * tangent), distance * normal)
                for normal in (direction, -direction)
                for offset in (0.0, 1.0, -1.0)
            ]
            start = self._find_near(z, p, targets, factor * distance)
            if start is not None:
                return start
        return None

    def _find_near(
        self,
        z: np.ndarray,
        p: float,
        targets: Sequence[tuple[np.ndarray, np.ndarray]],
        max_distance: float,
    ) -> ContinuationPoint | None:
        """Return the first regular fixed point near z on planes with given points and normals."""
        wheel = select_tree_rows(self.wheels, 0)
        tasks = [
            self.solve_on_plane(
                wheel, self.problem.displace(wheel, z, p, point[:-1]), point[-1], (point, normal)
            )
            for point, normal in targets
        ]
        lower_bound, upper_bound = self.parameter_bounds
        center = self.coordinates(z, self.compute_fraction(p))
        for point, is_found in run_together(self.problem, self.wheels, [0] * len(tasks), tasks):
            if (
                is_found
                and point.is_admissible
                and np.abs(self.coordinates(point.z, self.compute_fraction(point.p)) - center).max()
                <= max_distance
                and lower_bound <= point.p <= upper_bound
                and are_equations_regular(point.return_map_jacobian)
            ):
                return point
        return None

    def _find_regular_start(self, z: np.ndarray, p: np.ndarray) -> ContinuationPoint | None:
        """Find a fixed point next to a start at which the equations are singular.

        Each search is in a plane whose distance from the start is about that of the first
        continuation step. A branch that turns at the start does not cross all planes. Return None
        if no plane contains a fixed point near the start.
        """
        problem, distance = self.problem, self.options.initial_ds
        jacobian = np.asarray(problem.linearize(self.wheels, z, p).return_map_jacobian)[0]
        singular_direction = np.linalg.svd(np.eye(z.shape[-1]) - np.nan_to_num(jacobian))[2][-1]
        start = self.coordinates(z[0], self.compute_fraction(p[0]))
        # Along one branch through a crossing, the state may be constant.
        normals = [
            distance * self.coordinates(state_part * singular_direction, parameter_part)
            for state_part, parameter_part in itertools.product((0.0, 0.5, -0.5), (1.0, -1.0))
        ]
        targets = [(start + normal, normal) for normal in normals]
        return self._find_near(z[0], p[0], targets, START_DISTANCE_FACTORS[-1] * distance)

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
        problem = self.problem
        z = problem.interpolate(left.z, right.z, fractions)
        p = self.compute_fraction(left.p + fractions * (right.p - left.p))
        slopes = (right.p - left.p) / self.parameter_range
        tasks = [
            self.solve_on_plane(
                select_tree_rows(self.wheels, owners[i]),
                z[i],
                p[i],
                (self.coordinates(z[i], p[i]),
                 self.coordinates(right.z[i] - left.z[i], slopes[i])),
            )
            for i in range(len(owners))
        ]  # fmt: skip
        points, is_found = zip(*run_together(problem, self.wheels, owners, tasks), strict=True)
        return stack_points(points), np.array(is_found)


def stack_points(points: Sequence[ContinuationPoint]) -> ContinuationPoint:
    """Return points with a leading axis."""
    return ContinuationPoint(*(np.stack(values) for values in zip(*points, strict=True)))
