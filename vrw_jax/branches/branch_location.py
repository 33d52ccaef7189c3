"""Continue branches and locate their special points, for any walker.

Several branches are continued concurrently, each in both directions. The ends of the admissible
part of each branch are located next. Finally, all sign changes and changes of stepwise quantities
between neighboring admissible points are located.
"""

import operator
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from vrw_jax.base.small_matrices import EQUAL_MODULI_DISTANCE, UNIT_CIRCLE_DISTANCE
from vrw_jax.branches.arclength import ContinuationPoint, ContinuationStatus, QuantitiesByName
from vrw_jax.branches.branch import (
    BIFURCATIONS,
    BRANCH_POINT,
    FOLD,
    NEIMARK_SACKER,
    SpecialPoint,
    classify_multipliers,
    has_unit_circle_pair,
)
from vrw_jax.branches.branch_continuation import (
    ADMISSIBILITY,
    BORDER_COLLISION,
    EVENT_ORDER,
    EVENT_ORDER_CHANGE,
    MODULI,
    Continuation,
    PointTable,
    stack_points,
)
from vrw_jax.lanes.batching import concatenate_tree_rows, replace_rows, select_tree_rows

# Largest ratio of the quantity next to its root to the quantity at an end of the bracket; at a jump
# the ratio is larger. The value is chosen because the point next to the root may be at nine tenths
# of the distance to the root.
MAX_VALUE_BESIDE_ROOT = 0.2


class Root(NamedTuple):
    """Root of a quantity between two points of a branch, without its location until it is known."""

    pair: tuple[int, int]  # indices of the left and the right point
    name: str  # name of the special point at the root
    # returns the quantity at each point, from the test functions; it changes its sign in the pair
    evaluate: Callable[[QuantitiesByName], np.ndarray]
    ranks: range = range(0)  # ranks of the multipliers whose moduli the quantity combines
    n_multipliers: int = 0  # number of multipliers that cross the unit circle, 0 for other kinds
    parameter: float = np.nan  # value of the continued parameter at the root
    fraction: float = 0.0  # location of the root on the chord from the left to the right point
    beside: Any = None  # table of the point on the side of the left point

    @classmethod
    def of_test(cls, pair: tuple[int, int], name: str, test_name: str, **location: Any) -> "Root":
        """Return a root of one test function."""
        bifurcation = BIFURCATIONS.get(FOLD if name == BRANCH_POINT else name)
        n_multipliers = bifurcation.n_multipliers if bifurcation else 0
        evaluate = operator.itemgetter(test_name)
        return cls(pair, name, evaluate, n_multipliers=n_multipliers, **location)

    @classmethod
    def of_moduli(cls, pair: tuple[int, int], ranks: range) -> "Root":
        """Return a root at which the mean modulus of the multipliers with these ranks is 1."""
        evaluate = lambda tests: np.mean(tests[MODULI][:, ranks.start : ranks.stop], -1) - 1.0
        return cls(pair, MODULI, evaluate, ranks)

    def is_between(self, pair: tuple[int, int]) -> bool:
        """Return whether the root is located between two points."""
        return pair[0] <= self.pair[0] and self.pair[1] <= pair[1]

    def vanishes(self, tests: QuantitiesByName) -> bool:
        """Return whether the quantity vanishes at its root. Otherwise it jumps there.

        - `tests`: test functions of the branch on which the root is located.
        """
        (beside,) = np.abs(self.evaluate(self.beside.tests))
        at_ends = np.max(np.abs(self.evaluate(tests)[list(self.pair)]))
        return not beside > MAX_VALUE_BESIDE_ROOT * at_ends


def locate_function_roots(
    function: Callable[[np.ndarray, np.ndarray], np.ndarray],
    bracket_end_values: tuple[np.ndarray, np.ndarray],
    max_bracket_width: np.ndarray,
) -> np.ndarray:
    """Locate the roots of functions that have opposite signs at 0 and 1, by Chandrupatla's method.

    `function` maps locations and the indices of their brackets to function values. Each round
    evaluates it once for all brackets. `bracket_end_values` contains the function values at 0 and
    at 1. The search ends when every bracket is narrower than `max_bracket_width` or has an exact
    root. If the function is NaN at a location, that location is treated as having the sign of
    location 1.

    Return three locations of each root, shape (3, brackets): the bracket end with the smaller
    absolute value, that with the sign of location 0, and that with the sign of location 1.
    """
    from scipy.optimize import elementwise  # its import takes longer than that of the library

    end_values, widths_per_bracket = np.stack(bracket_end_values), 1.0 / max_bracket_width

    def evaluate(locations: np.ndarray, indices: np.ndarray) -> np.ndarray:
        # The unit of the locations is the width, and the values at both ends are known.
        indices = indices.astype(int)
        locations = locations / widths_per_bracket[indices]
        values = np.array(end_values[(locations > 0.5).astype(int), indices])
        inner = (locations > 0.0) & (locations < 1.0)
        if inner.any():
            values[inner] = function(locations[inner], indices[inner])
        return np.where(np.isnan(values), end_values[1, indices], values)

    result = elementwise.find_root(
        evaluate,
        (0.0 * widths_per_bracket, widths_per_bracket),
        args=(np.arange(len(widths_per_bracket)),),
        tolerances={"xatol": 1.0, "xrtol": 0.0, "fatol": 0.0, "frtol": 0.0},
    )
    left, right = np.stack(result.bracket) / widths_per_bracket
    is_left_better = np.abs(result.f_bracket[0]) <= np.abs(result.f_bracket[1])
    best = np.where(is_left_better, left, right)
    is_exact = np.any(np.stack(result.f_bracket) == 0.0, 0)
    return np.stack([best, *np.where(is_exact, best, [left, right])])


AdmissibleRange = tuple[int, np.ndarray, dict[int, tuple[int, int]]]
"""Admissible points of one wheel's branch: index of the wheel, and indices of the points. For the
ends 0 and 1 a pair follows, the last point of the range and the first point beyond it. An end is
omitted if the branch has no point beyond it.
"""

# Smallest ratio, at a jump, of the steepness of the chord between two points to that of both
# tangents. The value is chosen because continuation steps turn by at most 0.2 rad. The slope of a
# chord is then between those of the tangents to some tenths, even at a kink.
MIN_CHORD_STEEPNESS_FACTOR = 5.0


def find_state_jumps(
    section_states: np.ndarray,
    parameter_fractions: np.ndarray,
    fraction_rates: np.ndarray,
    point_pairs: list[tuple[int, int]],
) -> list[tuple[int, int]]:
    """Return the pairs of points between which the section state jumps.

    `parameter_fractions` contains the parameter at each point as a fraction of its range.
    `fraction_rates` contains the derivative of that fraction with respect to arc length.
    """

    def has_state_jump(pair: tuple[int, int]) -> bool:
        (left, right), rates = pair, fraction_rates[list(pair)]
        change = parameter_fractions[right] - parameter_fractions[left]
        chord = np.hypot(np.linalg.norm(section_states[right] - section_states[left]), change)
        is_chord_steeper = MIN_CHORD_STEEPNESS_FACTOR * abs(change) < np.min(abs(rates)) * chord
        # Across a fold the rates have opposite signs, and both parameters may be equal.
        return bool(np.prod(rates) > 0.0 and is_chord_steeper)

    return list(filter(has_state_jump, point_pairs))


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
# Arc lengths between the six points from which a crossing of two branches is interpolated. Next to
# the crossing, Newton's method amplifies round-off or fails. The first length is chosen because it
# keeps the errors of round-off and interpolation below 1e-9. The second is for crossings that are
# nearer to another special point.
CROSSING_DISTANCES = (1e-2, 1e-3)
# Tolerance of these points. The value is chosen above their amplified round-off. Two converged
# Newton iterations reduce the errors to this round-off.
CROSSING_TOLERANCE = 1e-8
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

    continuation: Continuation
    table: PointTable

    def find_admissible_ranges(self, start_indices: Mapping[int, int]) -> list[AdmissibleRange]:
        """Find for each wheel the range of admissible points that contains the start of its branch.

        `start_indices` contains the number of points before the start, for each wheel.
        """
        ranges = []
        for owner, start in start_indices.items():
            indices = np.flatnonzero(self.table.owners == owner)
            is_admissible = self.table.tests[ADMISSIBILITY][indices] > 0.0
            # If the start is a special point, it may lie beyond the end. A neighbor is then used.
            starts = [start, start + 1, start - 1]
            starts = [i for i in starts if 0 <= i < len(indices) and is_admissible[i]]
            if not starts:
                continue
            inadmissible = np.flatnonzero(~is_admissible)
            first = max(inadmissible[inadmissible < starts[0]], default=-1) + 1
            beyond = min(inadmissible[inadmissible > starts[0]], default=len(indices))
            end_pairs = {}
            if first > 0:
                end_pairs[0] = int(indices[first]), int(indices[first - 1])
            if beyond < len(indices):
                end_pairs[1] = int(indices[beyond - 1]), int(indices[beyond])
            ranges.append((owner, indices[first:beyond], end_pairs))
        return ranges

    def join_located_ends(
        self, ranges: list[AdmissibleRange], located_ends: Mapping[tuple[int, int], Root]
    ) -> PointTable:
        """Return a table with the points of all ranges and those next to located ends."""
        tables: list[PointTable] = []
        for owner, indices, _ in ranges:
            beside = [
                root.beside if root and root.beside.tests[ADMISSIBILITY][0] > 0.0 else None
                for root in (located_ends.get((owner, end)) for end in (0, 1))
            ]
            if beside[0]:  # The end was located in the opposite direction.
                beside[0] = beside[0].reverse()
            tables += filter(None, [beside[0], select_tree_rows(self.table, indices), beside[1]])
        return concatenate_tree_rows(*tables)

    def locate_roots(self, requests: list[Root]) -> list[Root]:
        """Return the roots with their locations."""
        if not requests:
            return []
        left, right = (
            select_tree_rows(self.table, indices)
            for indices in np.array([request.pair for request in requests]).T
        )
        every = np.arange(len(requests))

        def solve(
            fractions: np.ndarray,
            indices: np.ndarray,
            tolerance: float = self.continuation.options.tolerance,
        ) -> PointTable:
            left_points, right_points = select_tree_rows((left.points, right.points), indices)
            points, is_found = self.continuation.with_tolerance(tolerance).solve_on_chords(
                left.owners[indices], left_points, right_points, fractions
            )
            points = points._replace(is_admissible=points.is_admissible & is_found)
            table = self.continuation.make_table(points, left.owners[indices])
            # A transposed array has its points on the last axis.
            mask = lambda values: np.where(is_found, values.T, np.nan).T
            return table._replace(tests={name: mask(x) for name, x in table.tests.items()})

        def evaluate(table: PointTable, indices: np.ndarray) -> np.ndarray:
            return np.array(
                [requests[i].evaluate(table.tests)[row] for row, i in enumerate(indices)]
            )

        accuracy = LOCATION_PARAMETER_ACCURACY * self.continuation.location_unit
        distances = np.maximum(np.abs(right.points.p - left.points.p), accuracy)
        tolerances = np.minimum(accuracy / distances, MIN_BRACKET_FRACTION)
        fractions, left_ends, _ = locate_function_roots(
            lambda fractions, indices: evaluate(solve(fractions, indices), indices),
            (evaluate(left, every), evaluate(right, every)),
            tolerances,
        )
        # Even for an exact root, the point next to it lies to the left, where the gaits are
        # admissible.
        beside = solve(np.maximum(left_ends - tolerances, 0.0), every)
        for retry_fraction in RETRY_CHORD_FRACTIONS:
            failed = np.flatnonzero(~(beside.tests[ADMISSIBILITY] > 0.0))
            if len(failed):
                retried = solve(retry_fraction * left_ends[failed], failed)
                beside = replace_rows(beside, failed, retried)
        roots = solve(fractions, every).points.p
        crossings = np.array([i for i in every if requests[i].name == BRANCH_POINT], int)
        section_state = self.continuation.problem.section_state
        state_chords = section_state(right.points.z) - section_state(left.points.z)
        parameter_chords = (right.points.p - left.points.p) / self.continuation.parameter_range
        chords = np.hypot(np.linalg.norm(state_chords, axis=1), parameter_chords)
        for distance in CROSSING_DISTANCES:
            if not len(crossings):
                break
            offsets = distance * np.arange(-2.5, 3.0)
            nodes = fractions[crossings, None] + offsets / chords[crossings, None]
            indices = np.repeat(crossings, len(offsets))
            table = solve(nodes.ravel(), indices, CROSSING_TOLERANCE)
            values, p = (x.reshape(nodes.shape) for x in (evaluate(table, indices), table.points.p))
            is_monotonic = np.abs(np.sum(np.sign(np.diff(values)), -1)) == len(offsets) - 1
            is_found = is_monotonic & (np.prod(values[:, 2:4], -1) < 0.0)
            for row in np.flatnonzero(is_found):
                scaled_values, i = values[row] / np.ptp(values[row]), crossings[row]
                # The location and the parameter are polynomials of the value.
                data = np.stack([nodes[row], p[row] - p[row, 0]], -1)
                fit = np.polyfit(scaled_values, data, len(offsets) - 1)
                fractions[i], roots[i] = fit[-1] + [0.0, p[row, 0]]
            crossings = crossings[~is_found]
        return [
            request._replace(
                parameter=float(roots[i]),
                fraction=float(fractions[i]),
                beside=select_tree_rows(beside, slice(i, i + 1)),
            )
            for i, request in enumerate(requests)
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

    def is_mesh_limited(self, admissible_range: AdmissibleRange) -> bool:
        """Return whether the mesh limits a branch, before its special points are located."""
        _, indices, end_pairs = admissible_range
        unexplained_ends = [
            self.continuation.name_branch_end(self.table.quantities, pair[1])
            for pair in end_pairs.values()
            if not self.find_crossed_ends(pair)
        ]
        return self.continuation.is_mesh_limited(
            select_tree_rows(self.table.quantities, indices), unexplained_ends
        )

    def locate_branch_ends(self, ranges: list[AdmissibleRange]) -> dict[tuple[int, int], Root]:
        """Locate the nearest root of a quantity beyond each end of each branch.

        The keys of the result are (wheel index, end), where the end is 0 or 1.
        """
        requests = [
            ((owner, end), Root.of_test(pair, name, name))
            for owner, _, end_pairs in ranges
            for end, pair in end_pairs.items()
            for name in self.find_crossed_ends(pair) or [ADMISSIBILITY]
        ]
        located_ends: dict[tuple[int, int], Root] = {}
        roots = self.locate_roots([request for _, request in requests])
        for (key, _), root in zip(requests, roots, strict=True):
            # Of quantities that vanish together, the first one is the end.
            nearest = located_ends.setdefault(key, root)
            if root.fraction < nearest.fraction - MIN_BRACKET_FRACTION:
                located_ends[key] = root
        return located_ends

    def extrapolate_stalled_ends(
        self, ranges: list[AdmissibleRange], statuses: Mapping[int, Sequence[ContinuationStatus]]
    ) -> dict[tuple[int, int], Root]:
        """Return the zeros of margins just beyond ends at which no step is short enough.

        Where an orbit touches a guard, the return map has an infinite derivative on one side. The
        margin is smooth on the other side, up to the last point of the branch.
        """
        p, located_ends = self.table.points.p, {}
        max_distance = MAX_EXTRAPOLATED_STEPS * self.continuation.options.min_ds
        max_distance = max_distance * self.continuation.parameter_range
        stalled = [
            (owner, end, indices[2::-1] if end == 0 else indices[-3:])
            for owner, indices, end_pairs in ranges
            for end, status in enumerate(statuses[owner])
            if status == ContinuationStatus.STEP_SIZE_UNDERFLOW
            and end not in end_pairs
            and len(indices) > 2
        ]
        for owner, end, last in stalled:
            index = int(last[-1])
            for name, values in self.table.tests.items():
                test, margin = self.continuation.find_test_function(name), values[last]
                if test is None or test.kind != BORDER_COLLISION:
                    continue
                if not 0.0 < margin[-1] < margin[-2] < margin[0]:
                    continue
                # The parameter is a quadratic polynomial of the margin, evaluated at zero. A fit to
                # large and nearly equal margins, instead of their differences, is singular.
                fit = np.polyfit(margin - margin[-1], p[last] - p[index], 2)
                root = float(np.polyval(fit, -margin[-1]))
                if abs(root) <= max_distance:
                    located_ends[owner, end] = Root.of_test(
                        (index, index), name, name, **self._locate_at(index, root)
                    )
        return located_ends

    def _locate_at(self, index: int, distance: float = 0.0) -> dict[str, Any]:
        """Return the location of a root at a point, or at a distance of the parameter from it."""
        beside = select_tree_rows(self.table, slice(index, index + 1))
        return {"parameter": float(self.table.points.p[index] + distance), "beside": beside}

    def locate_inner_special_points(self) -> list[Root]:
        """Locate all special points of the branches except their ends."""
        points, tests = self.table.points, self.table.tests
        problem, jump_pairs = self.continuation.problem, []
        if problem.has_kinks:
            jump_pairs = find_state_jumps(
                problem.section_state(points.z),
                points.p / self.continuation.parameter_range,
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

    def _represent_jump(self, pair: tuple[int, int]) -> Root:
        """Represent a jump as a root, at the point of the pair where the continuation stalled."""
        (i, j), p = pair, self.table.points.p
        is_before = abs(p[i] - p[max(i - 1, 0)]) <= abs(p[min(j + 1, len(p) - 1)] - p[j])
        location = self._locate_at(i if is_before else j)
        fraction = 0.0 if is_before else 1.0
        return Root.of_test(pair, EVENT_ORDER_CHANGE, EVENT_ORDER, fraction=fraction, **location)

    def list_root_requests(self) -> list[Root]:
        """List the roots of bifurcation functions, margins and stepwise quantities to locate."""
        rates, tests = self.table.points.fraction_rate, self.table.tests
        # At a branch point the sign of the fold's margin is determined by round-off.
        regular = np.flatnonzero(~(np.abs(tests[FOLD]) < MAX_ZERO_FOLD_MARGIN))
        regular_pairs = self.table.find_pairs(regular)
        has_turned = {pair: np.prod(rates[list(pair)]) < 0.0 for pair in regular_pairs}
        located = {
            name: test
            for name in tests
            if (test := self.continuation.find_test_function(name))
            and (not test.ends_branch or test.kind == BORDER_COLLISION)
        }
        requests = [
            Root.of_test(
                pair, BRANCH_POINT if name == FOLD and not has_turned[pair] else name, name
            )
            for pair in regular_pairs
            for name, test in located.items()
            if not test.is_stepwise
            and self.table.changes_sign(name, pair, test.kind == BORDER_COLLISION)
        ]
        # On the side branch of a pitchfork, the margin touches zero where the parameter turns.
        requests += [
            Root.of_test(pair, BRANCH_POINT, BRANCH_POINT)
            for pair in regular_pairs
            if has_turned[pair]
            and self.continuation.problem.has_multipliers
            and np.prod(tests[FOLD][list(pair)]) > 0.0
        ]
        # The sum is NaN where the quantity is.
        compare = lambda name, value: (
            lambda tests: np.where(tests[name] == value, 1.0, -1.0) + 0.0 * tests[name]
        )
        # Between two values of a stepwise quantity there may be further values.
        requests += [
            Root(pair, test.kind, compare(name, value))
            for name, test in located.items()
            if test.is_stepwise
            for pair in self.table.find_pairs(np.flatnonzero(np.isfinite(tests[name])))
            if np.ptp(tests[name][list(pair)])
            for value in tests[name][list(pair)]
        ]
        return requests

    def _drop_duplicates(self, roots: list[Root]) -> list[Root]:
        """Return the roots, with each change of a stepwise quantity only once.

        Each change is located twice, as the end of one value and as the start of the next value. A
        change is also omitted at a root of a quantity that explains it.
        """
        stepwise_kinds = [
            t.kind for t in self.continuation.problem.test_functions.values() if t.is_stepwise
        ]

        def is_same_change(root: Root, earlier: Root) -> bool:
            test = self.continuation.find_test_function(earlier.name)
            is_explained = test is not None and test.explains == root.name
            return (
                (root.name == earlier.name in stepwise_kinds or is_explained)
                and root.pair == earlier.pair
                and abs(root.parameter - earlier.parameter)
                <= MAX_EQUAL_PARAMETER_DISTANCE * abs(earlier.parameter)
            )

        distinct: list[Root] = []
        for root in roots:
            if not any(is_same_change(root, earlier) for earlier in distinct):
                distinct.append(root)
        return distinct

    def add_multiple_bifurcations(
        self, pairs: list[tuple[int, int]], roots: list[Root]
    ) -> list[Root]:
        """Replace bifurcations that explain only some of the crossing multipliers.

        Several multipliers that cross at once change no sign of a determinant. Multipliers are
        ranked by modulus, the largest first. If ranks are unexplained, the point at which the
        modulus of each crosses 1 is located; if several cross together, that of their mean.
        """
        moduli, requests = self.table.tests[MODULI], []
        for pair in pairs:
            n_explained = sum(root.n_multipliers for root in roots if root.is_between(pair))
            ranks = range(*sorted(np.sum(moduli[list(pair)] > 1.0, -1).tolist()))
            if len(ranks) > n_explained:
                requests += [Root.of_moduli(pair, range(i, i + 1)) for i in ranks]
        # Each group contains the roots for ranks that may cross the unit circle together.
        groups: list[list[Root]] = []
        for root in self.locate_roots(requests):
            if not root.vanishes(self.table.tests):
                continue
            last = groups[-1][-1] if groups else root
            is_near = abs(root.fraction - last.fraction) <= MAX_EQUAL_LOCATION_DISTANCE
            if groups and last.pair == root.pair and is_near:
                groups[-1].append(root)
            else:
                groups.append([root])
        multiple: list[Root] = []
        mean_requests = [
            Root.of_moduli(group[0].pair, range(first := group[0].ranks.start, first + len(group)))
            for group in groups
        ]
        for group, mean_root in zip(groups, self.locate_roots(mean_requests), strict=True):
            moduli_beside = mean_root.beside.tests[MODULI][0, list(mean_root.ranks)]
            cross_together = (
                len(group) == 1 or np.max(np.abs(moduli_beside - 1.0)) <= EQUAL_MODULI_DISTANCE
            )
            for root in [mean_root] if cross_together else group:
                rates = self.table.points.fraction_rate[list(root.pair)]
                counts = classify_multipliers(
                    root.beside.points.return_map_jacobian[0],
                    root.ranks,
                    bool(np.prod(rates) < 0.0),
                )
                multiple += [
                    root._replace(name=name, n_multipliers=n) for name, n in counts.items()
                ]
        replaced_pairs = {root.pair for root in multiple}
        is_replaced = lambda root: (
            root.n_multipliers > 0 and any(map(root.is_between, replaced_pairs))
        )
        return [root for root in roots if not is_replaced(root)] + multiple

    def make_special_point(self, root: Root, ends_branch: bool) -> SpecialPoint:
        """Return the special point at a located root. The name of an end is found in this table."""
        beside, name = select_tree_rows(root.beside.points, 0), root.name
        continuation, problem = self.continuation, self.continuation.problem
        if name == ADMISSIBILITY:
            name = continuation.name_branch_end(self.table.quantities, root.pair[1])
        if name == BRANCH_POINT and not problem.has_multipliers:
            name = FOLD  # A curve of special points may meet a fold without turning back.
        test = continuation.find_test_function(name)
        kinds = {BRANCH_POINT, *(test.kind for test in problem.test_functions.values())}
        return SpecialPoint(
            name if name in kinds else test.kind if test else "lost",
            name,
            root.parameter,
            continuation.make_fixed_point(beside),
            ends_branch,
            problem.make_point_reader(
                select_tree_rows(continuation.wheels, root.beside.owners[0]), beside
            ),
            root.n_multipliers,
        )


class BranchData(NamedTuple):
    """Branch of one wheel and its located special points, as arrays without labels."""

    points: ContinuationPoint
    quantities: QuantitiesByName
    special_points: tuple[SpecialPoint, ...]
    end_reasons: tuple[str, str]
    # whether the mesh limits the branch, see `Continuation.is_mesh_limited`
    is_mesh_limited: bool


def continue_and_locate_special_points(
    continuation: Continuation,
    z: np.ndarray,
    parameter_values: np.ndarray,
    has_branch_start: np.ndarray,
    is_finest_mesh: bool = True,
) -> list[BranchData | None]:
    """Continue branches, and return them with their located special points.

    The result is None for a wheel without a start. A branch that the mesh limits is later continued
    again on a finer mesh. Its special points are located only if `is_finest_mesh` is true.

    - `z`, `parameter_values`: unknowns and parameter at the start of each branch;
    - `has_branch_start`: whether each wheel has a start.
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
        turned = [point.reverse() for point in reversed(reversed_points)]
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
        admissible_ranges = [x for x in admissible_ranges if branches[x[0]] is None]
    if not admissible_ranges:
        return branches
    located_ends = locator.locate_branch_ends(admissible_ranges)
    joined = locator.join_located_ends(admissible_ranges, located_ends)
    inner_roots = _SpecialPointLocator(continuation, joined).locate_inner_special_points()
    located_ends = locator.extrapolate_stalled_ends(admissible_ranges, statuses) | located_ends
    for owner, _, _ in admissible_ranges:
        roots = [root for root in inner_roots if root.beside.owners[0] == owner]
        roots.sort(key=lambda root: root.pair[0] + root.fraction * np.ptp(root.pair))
        special_points = [locator.make_special_point(root, False) for root in roots]
        end_reasons = [status.meaning for status in statuses[owner]]
        rows = select_tree_rows(joined, joined.owners == owner)
        for end in (0, 1):
            if (located_end := located_ends.get((owner, end))) is None:
                if statuses[owner][end] == ContinuationStatus.STEP_SIZE_UNDERFLOW:
                    last = select_tree_rows(rows.quantities, np.array([-end]))
                    end_reasons[end] = (
                        continuation.problem.explain_stalled_end(last) or end_reasons[end]
                    )
                continue
            end_point = locator.make_special_point(located_end, True)
            special_points.insert(end * len(special_points), end_point)
            end_reasons[end] = continuation.problem.describe_branch_end(
                end_point.name, end_point.value
            )
        end_names = [point.name for point in special_points if point.ends_branch]
        branches[owner] = BranchData(
            rows.points,
            rows.quantities,
            tuple(special_points),
            (end_reasons[0], end_reasons[1]),
            continuation.is_mesh_limited(rows.quantities, end_names),
        )
    return branches
