"""Trace curves of special points in two parameters, in batches, each curve once.

A special point and its gait are unknowns of the same equations, so that the points of a curve are
as accurate as the gaits. If a curve meets another special point, a new curve is traced from the
meeting point.
"""

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from vrw_jax.base import batch_sizes
from vrw_jax.base.lazy_xarray import xarray as xr
from vrw_jax.base.options import StepOptions
from vrw_jax.base.outcomes import Outcome
from vrw_jax.branches.arclength import ArclengthOptions, ContinuationPoint
from vrw_jax.branches.branch import Codim2Point, SpecialPointCurve
from vrw_jax.branches.branch_location import (
    AbstractContinuation,
    BranchData,
    QuantitiesByName,
    continue_and_locate_special_points,
)
from vrw_jax.branches.continuation import (
    GAIT_TEST_FUNCTIONS,
    MAX_BRANCH_MESH_REFINEMENTS,
    continue_branches,
    split_legs,
)
from vrw_jax.branches.continuation_problems import BranchWheel, CollocationProblem
from vrw_jax.branches.curve_problems import (
    CONTINUED_QUANTITIES,
    DISCONTINUOUS_QUANTITIES,
    DLS_VANISHING_NAME,
    FORCE_QUANTITY_NAMES,
    INITIAL_FORCE_FALL_NAME,
    LINEAR_MARGIN_SUBSTITUTES,
    CurveWheel,
    GaitCurveProblem,
    compute_continued_quantities,
    find_test_quantity_group,
    locate_jump_onset,
    select_test_quantity,
)
from vrw_jax.branches.test_functions import BIFURCATIONS, BRANCH_POINT, FOLD, TestFunction
from vrw_jax.gaits.collocation_search import CollocationSystem
from vrw_jax.gaits.limit_cycle_result import LimitCycle, transfer_solution_to_mesh
from vrw_jax.gaits.phase_collocation import CollocationSolution
from vrw_jax.models.measures import MARGIN_MEASURES, make_labeled_variables
from vrw_jax.models.provenance import collect_provenance_attributes
from vrw_jax.models.viscoelastic import ViscoelasticWheel
from vrw_jax.wheel.params import WheelParams

RANGE_EDGE_COLUMN = "edge of the box"
"""Name of the quantity that vanishes if the second parameter is at an end of its range."""

DEFAULT_CURVE_OPTIONS = ArclengthOptions(initial_ds=5e-4)
"""Default continuation options of curves. The first continuation step is short because some curves
are short.
"""


@dataclass(frozen=True)
class CurveContinuation(AbstractContinuation):
    """Continuation of special points as curves in two parameters.

    The quantities at a point of a curve are those of its gait, except the quantity that vanishes on
    the whole curve.
    """

    continuation_problem: GaitCurveProblem
    special_point_names: tuple[str, ...]  # one name per wheel

    test_functions: ClassVar[Mapping[str, TestFunction]] = {
        **GAIT_TEST_FUNCTIONS,
        RANGE_EDGE_COLUMN: TestFunction("lost", "The second parameter's range ends.", True),
        INITIAL_FORCE_FALL_NAME: TestFunction("lost", "The force begins to rise.", True),
    }
    linear_margin_substitutes: ClassVar[Mapping[str, str]] = LINEAR_MARGIN_SUBSTITUTES

    def evaluate_point_quantities(
        self, wheels: CurveWheel, points: ContinuationPoint
    ) -> QuantitiesByName:
        problem = self.continuation_problem
        quantities = split_legs(problem.measure_gaits(wheels, points), problem.gait_problem.n_legs)
        # Without double support, the rear foot's force must not be positive.
        rear_force_sign = np.where(wheels.branch_wheel.is_phase_active[:, 0, 0] > 0.5, 1.0, -1.0)
        fraction = points.z[:, 0]
        return quantities | {
            "lambda_4_plus": rear_force_sign * quantities["lambda_4_plus"],
            "second": problem.compute_second_parameter(points.z),
            RANGE_EDGE_COLUMN: np.minimum(fraction, 1.0 - fraction),
        }

    def mask_undefined_quantities(
        self, quantities: QuantitiesByName, owners: np.ndarray
    ) -> QuantitiesByName:
        """Replace each quantity that is zero or undefined on the whole curve by NaN."""
        special_point_names = np.array(self.special_point_names)[owners]
        is_dls_vanishing = special_point_names == DLS_VANISHING_NAME
        is_step_discontinuous = np.isin(
            special_point_names, (*DISCONTINUOUS_QUANTITIES, DLS_VANISHING_NAME)
        )

        def is_undefined(quantity_name: str) -> np.ndarray:
            if quantity_name == INITIAL_FORCE_FALL_NAME:
                return ~is_dls_vanishing
            is_step_margin = quantity_name.partition("[")[0] in MARGIN_MEASURES
            substituted_names = [
                margin_name
                for margin_name, substitute_name in LINEAR_MARGIN_SUBSTITUTES.items()
                if substitute_name == quantity_name
            ]
            is_zero_on_curve = np.isin(special_point_names, [quantity_name, *substituted_names])
            if quantity_name == "lambda_4_plus":
                return is_zero_on_curve | is_dls_vanishing
            if is_step_margin and quantity_name not in CONTINUED_QUANTITIES:
                return is_zero_on_curve | is_step_discontinuous
            return is_zero_on_curve

        # A transposed array has its points on the last axis.
        masked_quantities = {
            quantity_name: np.where(is_undefined(quantity_name), np.nan, quantity_values.T).T
            for quantity_name, quantity_values in quantities.items()
        }
        return masked_quantities | {
            "outcome": np.where(is_step_discontinuous, Outcome.STEPPED, quantities["outcome"]),
            "closure": np.where(is_step_discontinuous, 0.0, quantities["closure"]),
        }

    def are_points_admissible(self, quantities: QuantitiesByName) -> np.ndarray:
        are_positive = [
            ~(values <= 0.0)
            for name, values in quantities.items()
            if (test := self.find_test_function(name)) and test.ends_branch
        ]
        return np.all(are_positive, axis=0) & super().are_points_admissible(quantities)


class CurveSeed(NamedTuple):
    """Point on or near a curve of special points, from which the curve is traced."""

    special_point_name: str
    parameter_values: tuple[float, ...]  # of the two parameters
    collocation_system: CollocationSystem
    branch_wheel: BranchWheel
    z: CollocationSolution


# Largest distance from a curve, in arc length, at which a point is treated as a point of the curve.
MAX_DISTANCE_ON_SAME_CURVE = 2e-3


class TracedCurve(NamedTuple):
    """Traced curve of special points, and seeds at the other special points that it meets."""

    special_point_curve: SpecialPointCurve
    # section state, and the two parameters as fractions of their ranges: (point, coordinate)
    scaled_vertices: np.ndarray
    meeting_seeds: tuple[CurveSeed, ...]

    def contains_points(self, special_point_name: str, scaled_points: np.ndarray) -> bool:
        """Return whether all points lie on this curve, and the curve is that of the named special
        point.

        The rows of `scaled_points` are points in the coordinates of `scaled_vertices`.
        """
        if special_point_name != self.special_point_curve.name:
            return False
        distances = compute_distances_to_polyline(scaled_points, self.scaled_vertices)
        return bool(np.max(distances) < MAX_DISTANCE_ON_SAME_CURVE)


# Arc length beyond a point of codimension two at which the continuation of the second curve through
# that point starts.
CODIM2_OVERRUN_DISTANCE = 3e-3
# Tolerance for Newton's last correction at a point of codimension two, relative to the values of
# the parameters.
RELATIVE_CODIM2_TOLERANCE = 1e-9
# Initial guess for a nonzero duration of double support, s.
DLS_DURATION_GUESS_S = 0.1


class CurveTracer(NamedTuple):
    """Tracer of curves of special points within the ranges of two parameters."""

    parameter_names: tuple[str, str]
    parameter_ranges: np.ndarray  # bounds of each parameter, (parameter, 2)
    model: ViscoelasticWheel
    arclength_options: ArclengthOptions
    step_options: StepOptions
    stage_reporter: Callable[[str], None] | None = None
    measures_force_peaks: bool = False  # whether branches measure the peaks of the gait's force

    def report_stage(self, stage_description: str) -> None:
        """Pass a description of the next stage to `stage_reporter`, unless it is None."""
        if self.stage_reporter is not None:
            self.stage_reporter(stage_description)

    def with_parameters(
        self, params: WheelParams, parameter_values: Iterable[float]
    ) -> WheelParams:
        """Return the wheel with new values of the two parameters."""
        get_values = lambda params: [getattr(params, name) for name in self.parameter_names]
        return eqx.tree_at(get_values, params, [jnp.asarray(value) for value in parameter_values])

    def compute_parameter_fractions(self, parameter_values: np.ndarray) -> np.ndarray:
        """Return the two parameters as fractions of their ranges, on the last axis."""
        return (parameter_values - self.parameter_ranges[:, 0]) / np.ptp(self.parameter_ranges, 1)

    def find_seeds(
        self, parameter_index: int, params: WheelParams, start_cycles: LimitCycle | None = None
    ) -> list[CurveSeed]:
        """Find seeds at the special points on the wheels' branches in one of the two parameters.

        `parameter_index` selects the parameter. `start_cycles` contains the gaits of the wheels, if
        they are known.
        """
        parameter_name = self.parameter_names[parameter_index]
        lower_bound, upper_bound = self.parameter_ranges[parameter_index]
        self.report_stage(f"following {len(params.damping)} branches along {parameter_name}")
        branches = continue_branches(
            params,
            parameter_name,
            (lower_bound, upper_bound),
            cycle=start_cycles,
            model=self.model,
            force_peaks=self.measures_force_peaks,
        )
        curve_seeds = []
        for special_point in itertools.chain(*(branch.special_points for branch in branches)):
            if not can_continue_special_point(special_point.name):
                continue
            limit_cycle = special_point.cycle
            parameters, state = jax.tree.map(
                np.asarray, (limit_cycle.parameters, limit_cycle.collocation_state)
            )
            branch_wheel, z = BranchWheel(parameters, state.is_phase_active), state.solution
            curve_seeds.append(
                CurveSeed(
                    choose_continued_special_point_name(special_point.name, branch_wheel, z),
                    tuple(
                        float(parameters[self.model.parameter_names.index(name)])
                        for name in self.parameter_names
                    ),
                    limit_cycle.system,
                    branch_wheel,
                    z,
                )
            )
        return curve_seeds

    def trace_curves(
        self, curve_seeds: Sequence[CurveSeed], known_curves: Sequence[TracedCurve]
    ) -> list[TracedCurve]:
        """Trace the curves through all seeds that lie on no known curve."""
        new_curves: list[TracedCurve] = []
        seeds_by_group: dict[tuple[str, ...], list[CurveSeed]] = {}
        for curve_seed in curve_seeds:
            if not any(self._is_on_curve(curve_seed, known_curve) for known_curve in known_curves):
                quantity_group = find_test_quantity_group(
                    curve_seed.special_point_name, curve_seed.collocation_system.n_legs
                )
                seeds_by_group.setdefault(quantity_group, []).append(curve_seed)
        for quantity_group in sorted(seeds_by_group):
            remaining_seeds = seeds_by_group[quantity_group]
            while remaining_seeds:
                # A batch has one seed per name, because seeds of one name may lie on one curve.
                first_seed_by_name: dict[str, CurveSeed] = {}
                for curve_seed in remaining_seeds:
                    first_seed_by_name.setdefault(curve_seed.special_point_name, curve_seed)
                batch_seeds = [*first_seed_by_name.values()][: batch_sizes.CURVE_BATCH_SIZE]
                for candidate_curve in self._trace_curves_of_batch(quantity_group, batch_seeds):
                    if not any(
                        self.are_same_curve(candidate_curve, compared_curve)
                        for compared_curve in (*known_curves, *new_curves)
                    ):
                        new_curves.append(candidate_curve)
                remaining_seeds = [
                    curve_seed
                    for curve_seed in remaining_seeds
                    if not any(curve_seed is batch_seed for batch_seed in batch_seeds)
                    and not any(
                        self._is_on_curve(curve_seed, new_curve) for new_curve in new_curves
                    )
                ]
        return new_curves

    def _is_on_curve(self, curve_seed: CurveSeed, traced_curve: TracedCurve) -> bool:
        """Return whether a seed lies on a curve of the same special point."""
        seed_point = np.append(
            curve_seed.z.section_state,
            self.compute_parameter_fractions(np.array(curve_seed.parameter_values)),
        )
        return traced_curve.contains_points(curve_seed.special_point_name, seed_point[None])

    @staticmethod
    def are_same_curve(traced_curve: TracedCurve, compared_curve: TracedCurve) -> bool:
        """Return whether two curves are the same curve.

        The special points must have the same name, and all points of the first curve must lie on
        the second curve.
        """
        return compared_curve.contains_points(
            traced_curve.special_point_curve.name, traced_curve.scaled_vertices
        )

    def _trace_curves_of_batch(
        self, quantity_group: tuple[str, ...], curve_seeds: list[CurveSeed]
    ) -> list[TracedCurve]:
        """Trace the curves through the seeds of one batch, on a sufficiently fine mesh.

        A seed is omitted if there is no curve through it.

        - `quantity_group`: names of the quantities that are evaluated together.
        """
        traced_curves = []
        special_point_names = ", ".join(
            sorted({curve_seed.special_point_name for curve_seed in curve_seeds})
        )
        self.report_stage(f"following special points: {special_point_names}")
        for refinement_index in range(1 + MAX_BRANCH_MESH_REFINEMENTS):
            is_finest_mesh = refinement_index == MAX_BRANCH_MESH_REFINEMENTS
            branch_data_by_seed, collocation_system = self._continue_curves_of_batch(
                quantity_group, curve_seeds, is_finest_mesh
            )
            mesh_limited_seeds = []
            for curve_seed, branch_data in zip(curve_seeds, branch_data_by_seed, strict=True):
                if branch_data is not None and branch_data.is_mesh_limited and not is_finest_mesh:
                    options = collocation_system.cycle_options.refine_mesh()
                    mesh_limited_seeds.append(
                        self._transfer_seed(
                            curve_seed, collocation_system._replace(cycle_options=options)
                        )
                    )
                elif branch_data is not None:
                    traced_curves.append(
                        self._make_traced_curve(
                            curve_seed._replace(collocation_system=collocation_system), branch_data
                        )
                    )
            if not mesh_limited_seeds:
                break
            curve_seeds = mesh_limited_seeds
        return traced_curves

    @staticmethod
    def _transfer_seed(curve_seed: CurveSeed, collocation_system: CollocationSystem) -> CurveSeed:
        if curve_seed.collocation_system == collocation_system:
            return curve_seed
        return curve_seed._replace(
            collocation_system=collocation_system,
            z=jax.tree.map(
                np.asarray,
                transfer_solution_to_mesh(
                    curve_seed.collocation_system, collocation_system, curve_seed.z
                ),
            ),
        )

    def _continue_curves_of_batch(
        self, quantity_group: tuple[str, ...], curve_seeds: list[CurveSeed], is_finest_mesh: bool
    ) -> tuple[list[BranchData | None], CollocationSystem]:
        """Continue the curve through each seed, and return its data and the collocation system.

        The collocation system has the finest mesh that any of the seeds has.
        """
        collocation_system = max(
            (curve_seed.collocation_system for curve_seed in curve_seeds),
            key=lambda collocation_system: collocation_system.cycle_options.mesh_intervals,
        )
        curve_seeds = [
            self._transfer_seed(curve_seed, collocation_system) for curve_seed in curve_seeds
        ]
        padded_seeds = [
            *curve_seeds,
            *curve_seeds[-1:] * (-len(curve_seeds) % batch_sizes.CURVE_BATCH_SIZE),
        ]
        problem = self.make_problem(collocation_system, quantity_group, padded_seeds[0].z)

        def make_start(curve_seed: CurveSeed) -> tuple[CurveWheel, CollocationSolution, Any, Any]:
            has_double_support = bool(curve_seed.branch_wheel.is_phase_active[0, 0] > 0.5)
            name = select_test_quantity(curve_seed.special_point_name, has_double_support)
            index = np.asarray(quantity_group.index(name))
            fraction = self.compute_parameter_fractions(np.array(curve_seed.parameter_values))[1]
            first_value = curve_seed.parameter_values[0]
            return CurveWheel(curve_seed.branch_wheel, index), curve_seed.z, fraction, first_value

        wheels, z, fractions, first_values = jax.tree.map(
            lambda *leaves: np.stack(leaves), *map(make_start, padded_seeds)
        )
        continuation = CurveContinuation(
            problem,
            self.arclength_options,
            wheels,
            self.parameter_ranges[0],
            tuple(curve_seed.special_point_name for curve_seed in padded_seeds),
        )
        branch_data_by_seed = continue_and_locate_special_points(
            continuation,
            np.column_stack([fractions, problem.gait_problem.pack(z)]),
            first_values,
            np.arange(len(padded_seeds)) < len(curve_seeds),
            lambda wheel_index, point: lambda: point,
            is_finest_mesh,
        )
        return branch_data_by_seed[: len(curve_seeds)], collocation_system

    def make_problem(
        self,
        collocation_system: CollocationSystem,
        quantity_group: tuple[str, ...],
        z: CollocationSolution,
    ) -> GaitCurveProblem:
        """Return the problem of the curves of a group of quantities, for solutions like z."""
        gait_problem = CollocationProblem(
            model=self.model,
            step_options=self.step_options,
            n_legs=collocation_system.n_legs,
            parameter_name=self.parameter_names[0],
            period_n=1,
            measures_force_peaks=False,
            collocation_system=collocation_system,
            shapes=tuple(x.shape for x in jax.tree.leaves(z)),
            additional_quantity_function=compute_continued_quantities,
        )
        lower_bound, upper_bound = map(float, self.parameter_ranges[1])
        return GaitCurveProblem(
            second_bounds=(lower_bound, upper_bound),
            gait_problem=gait_problem,
            second_name=self.parameter_names[1],
            quantity_names=quantity_group,
        )

    def _make_traced_curve(self, curve_seed: CurveSeed, branch_data: BranchData) -> TracedCurve:
        """Build a labeled curve, and seeds at the special points that the curve meets."""
        parameter_points = np.stack([branch_data.points.p, branch_data.quantities["second"]], -1)
        gaits = self.make_problem(
            curve_seed.collocation_system, tuple(BIFURCATIONS), curve_seed.z
        ).gait_problem
        rows = branch_data.points.z[:, 1:]
        scaled_vertices = np.column_stack(
            [gaits.section_state(rows), self.compute_parameter_fractions(parameter_points)]
        )
        codim2_points, new_seeds, end_reasons = [], [], branch_data.end_reasons
        for special_point in branch_data.special_points:
            if special_point.name == RANGE_EDGE_COLUMN:
                continue
            point_beside_root = special_point.cycle
            second_fraction, z = point_beside_root.z[0], gaits.unpack(point_beside_root.z[1:])
            second_parameter_value = float(
                self.parameter_ranges[1, 0] + np.ptp(self.parameter_ranges[1]) * second_fraction
            )
            meeting_parameter_values = special_point.value, second_parameter_value
            special_point_name = choose_continued_special_point_name(
                special_point.name, curve_seed.branch_wheel, z
            )
            if {special_point_name, curve_seed.special_point_name} == {
                "lambda_4_plus",
                DLS_VANISHING_NAME,
            }:
                meeting_parameter_values = self._locate_jump_onset(
                    curve_seed, z, meeting_parameter_values
                )
                new_seeds.append(
                    self._seed_beyond_meeting(
                        special_point_name,
                        curve_seed,
                        scaled_vertices,
                        parameter_points,
                        gaits.unpack(rows),
                        meeting_parameter_values,
                    )
                )
                first_reason, last_reason = (
                    end_reason.replace(
                        f"{special_point.value:.9g}", f"{meeting_parameter_values[0]:.9g}"
                    )
                    for end_reason in end_reasons
                )
                end_reasons = first_reason, last_reason
            elif can_continue_special_point(special_point_name):
                new_seeds.append(
                    curve_seed._replace(
                        special_point_name=special_point_name,
                        parameter_values=(float(point_beside_root.p), second_parameter_value),
                        z=z,
                    )
                )
            codim2_points.append(
                Codim2Point(special_point_name, meeting_parameter_values, special_point.ends_branch)
            )
        special_point_curve = self._make_labeled_curve(
            curve_seed, branch_data._replace(end_reasons=end_reasons), tuple(codim2_points)
        )
        return TracedCurve(special_point_curve, scaled_vertices, tuple(new_seeds))

    def _locate_jump_onset(
        self, curve_seed: CurveSeed, z: CollocationSolution, start_parameter_values: Any
    ) -> tuple[float, float]:
        """Return the two parameters at the onset of the jump.

        If the onset is not found, return `start_parameter_values`.
        """
        problem = self.make_problem(curve_seed.collocation_system, CONTINUED_QUANTITIES, z)
        onset_parameter_values, last_relative_parameter_change = locate_jump_onset(
            problem,
            curve_seed.branch_wheel,
            problem.gait_problem.pack(jax.tree.map(lambda x: x[None], z))[0],
            np.array(start_parameter_values),
        )
        is_onset_found = last_relative_parameter_change < RELATIVE_CODIM2_TOLERANCE
        first_parameter_value, second_parameter_value = (
            onset_parameter_values if is_onset_found else start_parameter_values
        )
        return float(first_parameter_value), float(second_parameter_value)

    def _seed_beyond_meeting(
        self,
        special_point_name: str,
        curve_seed: CurveSeed,
        scaled_vertices: np.ndarray,
        parameter_points: np.ndarray,
        z: CollocationSolution,
        meeting_parameter_values: Any,
    ) -> CurveSeed:
        """Build a seed beyond the point at which the rear foot's force starts to rise or to fall.

        The force is zero on the curve. Two curves cross at that point and continue in the same
        direction. `meeting_parameter_values` contains the two parameters at the crossing.
        """
        is_meeting_at_start = (
            abs(parameter_points[0] - meeting_parameter_values).max()
            < abs(parameter_points[-1] - meeting_parameter_values).max()
        )
        curve_traversal_sign = 1 if is_meeting_at_start else -1
        scaled_vertices, parameter_points = (
            scaled_vertices[::curve_traversal_sign],
            parameter_points[::curve_traversal_sign],
        )
        z = jax.tree.map(lambda x: x[::curve_traversal_sign], z)
        distances_to_meeting = np.linalg.norm(scaled_vertices - scaled_vertices[0], axis=1)
        point_index = int(
            np.argmax(
                distances_to_meeting >= min(CODIM2_OVERRUN_DISTANCE, distances_to_meeting[-1])
            )
        )
        extrapolate_from_meeting = lambda x: (
            x[0]
            + CODIM2_OVERRUN_DISTANCE / distances_to_meeting[point_index] * (x[0] - x[point_index])
        )
        z = jax.tree.map(extrapolate_from_meeting, z)
        z.durations[0, 0] = (
            0.0 if special_point_name == DLS_VANISHING_NAME else DLS_DURATION_GUESS_S
        )
        return curve_seed._replace(
            special_point_name=special_point_name,
            parameter_values=tuple(extrapolate_from_meeting(parameter_points)),
            z=z,
        )

    def _make_labeled_curve(
        self, curve_seed: CurveSeed, branch_data: BranchData, codim2_points: tuple[Codim2Point, ...]
    ) -> SpecialPointCurve:
        spectral_radius = np.abs(np.linalg.eigvals(branch_data.points.return_map_jacobian)).max(-1)
        quantities = branch_data.quantities | {"spectral_radius": spectral_radius}
        column_names = ("duration_dls", "duration_sls1", "duration_sls2", "spectral_radius")
        curve_variables: dict[str, Any] = make_labeled_variables(
            {column_name: quantities[column_name] for column_name in column_names}, "point"
        )
        curve_variables["mesh_error"] = ("point", quantities["mesh_error"])
        curve_variables["section_state"] = (("point", "component"), quantities["section_state"])
        first_parameter_name, second_parameter_name = self.parameter_names
        curve_coordinates = make_labeled_variables(
            {
                first_parameter_name: np.asarray(branch_data.points.p),
                second_parameter_name: quantities["second"],
            },
            "point",
        )
        start_provenance = collect_provenance_attributes(
            curve_seed.collocation_system.make_wheel(jnp.asarray(curve_seed.branch_wheel.values)),
            self.model,
            self.step_options,
        )
        curve_axes_description = " and ".join(self.parameter_names)
        dataset_attrs = {
            "title": f"Curve of {curve_seed.special_point_name} over {curve_axes_description}"
        }
        curve_dataset = xr.Dataset(
            curve_variables, curve_coordinates, dataset_attrs | start_provenance
        )
        return SpecialPointCurve(
            curve_seed.special_point_name,
            self.parameter_names,
            curve_dataset,
            codim2_points,
            branch_data.end_reasons,
        )


def compute_distances_to_polyline(
    query_points: np.ndarray, polyline_vertices: np.ndarray
) -> np.ndarray:
    """Return the distance of each point from a polyline, shape (points,).

    Each row of `polyline_vertices` is a vertex of the polyline.
    """
    segment_starts, segment_vectors = polyline_vertices[:-1], np.diff(polyline_vertices, axis=0)
    squared_segment_lengths = np.maximum(np.sum(segment_vectors**2, 1), 1e-300)
    offsets_from_segment_start = query_points[:, None] - segment_starts
    segment_fractions = np.clip(
        np.sum(offsets_from_segment_start * segment_vectors, 2) / squared_segment_lengths, 0.0, 1.0
    )
    segment_distances = np.linalg.norm(
        offsets_from_segment_start - segment_fractions[..., None] * segment_vectors, axis=2
    )
    return np.min(segment_distances, axis=1, initial=np.inf)


# Largest duration of double support that is treated as zero, s. The value is chosen above round-off
# because the duration is ill-conditioned near zero.
MAX_ZERO_DLS_DURATION_S = 1e-4


def choose_continued_special_point_name(
    special_point_name: str,
    branch_wheel: BranchWheel,
    z: CollocationSolution,
) -> str:
    """Return the name under which a special point of a gait is continued as a curve.

    A branch point is continued as a fold. In gaits with double support, special points of the rear
    foot's force are continued as `DLS_VANISHING_NAME` or "lambda_4_plus".
    """
    # A curve of folds may continue in one direction at its special points.
    if special_point_name == BRANCH_POINT:
        return FOLD
    if (
        special_point_name not in ("lambda_4_plus", DLS_VANISHING_NAME, INITIAL_FORCE_FALL_NAME)
        or branch_wheel.is_phase_active[0, 0] < 0.5
    ):
        return special_point_name
    dls_vanishes = (
        special_point_name != INITIAL_FORCE_FALL_NAME
        and z.durations[0, 0] < MAX_ZERO_DLS_DURATION_S
    )
    return DLS_VANISHING_NAME if dls_vanishes else "lambda_4_plus"


def can_continue_special_point(special_point_name: str) -> bool:
    """Return whether `GaitTestFunction` can continue the named special point as a curve."""
    continued_special_point_names = (
        *BIFURCATIONS,
        *DISCONTINUOUS_QUANTITIES,
        DLS_VANISHING_NAME,
        *FORCE_QUANTITY_NAMES,
    )
    return (
        special_point_name in continued_special_point_names
        or special_point_name.partition("[")[0] in MARGIN_MEASURES
    )
