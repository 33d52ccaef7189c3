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
from vrw_jax.branches.arclength import ArclengthOptions, ContinuationPoint
from vrw_jax.branches.branch import Codim2Point, SpecialPointCurve
from vrw_jax.branches.branch_location import (
    AbstractContinuation,
    BranchData,
    continue_and_locate_special_points,
)
from vrw_jax.branches.branch_points import BRANCH_POINT_KIND, QuantitiesByName
from vrw_jax.branches.continuation import (
    BRANCH_ENDING_QUANTITIES,
    MAX_BRANCH_MESH_REFINEMENTS,
    GaitContinuation,
    continue_branches,
)
from vrw_jax.branches.continuation_problems import BranchWheel
from vrw_jax.branches.gait_test_functions import (
    CONTINUED_QUANTITIES,
    DISCONTINUOUS_QUANTITIES,
    DLS_VANISHING_NAME,
    FORCE_QUANTITY_NAMES,
    INITIAL_FORCE_FALL_NAME,
    LINEAR_MARGIN_SUBSTITUTES,
    GaitTestFunction,
    TestFunctionWheel,
    find_test_quantity_group,
    locate_jump_onset,
    select_test_quantity,
)
from vrw_jax.branches.sign_changes import BIFURCATION_NAMES
from vrw_jax.branches.test_functions import TestFunctionCurve, TestFunctionPoint
from vrw_jax.gaits.collocation_search import CollocationSystem
from vrw_jax.gaits.limit_cycle_result import LimitCycle, transfer_solution_to_mesh
from vrw_jax.gaits.phase_collocation import CollocationSolution
from vrw_jax.models.measures import MARGIN_MEASURES, make_labeled_variables
from vrw_jax.models.provenance import collect_provenance_attributes
from vrw_jax.models.viscoelastic import ViscoelasticWheel
from vrw_jax.wheel.outcomes import Outcome
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

    continuation_problem: TestFunctionCurve
    special_point_names: tuple[str, ...]  # one name per wheel

    branch_ending_quantities: ClassVar[tuple[str, ...]] = (
        *BRANCH_ENDING_QUANTITIES,
        RANGE_EDGE_COLUMN,
        INITIAL_FORCE_FALL_NAME,
    )
    border_collision_quantities: ClassVar[tuple[str, ...]] = (
        GaitContinuation.border_collision_quantities
    )
    linear_margin_substitutes: ClassVar[Mapping[str, str]] = LINEAR_MARGIN_SUBSTITUTES

    def evaluate_point_quantities(
        self, wheels: TestFunctionWheel, points: ContinuationPoint
    ) -> QuantitiesByName:
        test_function: Any = self.continuation_problem.test_function
        second_parameter_values = self.continuation_problem.compute_second_parameter(points.z)
        gait_wheels = test_function.with_parameters(
            wheels.branch_wheel, (points.p, second_parameter_values)
        )
        gait_continuation = GaitContinuation(
            test_function.gait_problem, self.arclength_options, gait_wheels, self.parameter_bounds
        )
        quantity_table = gait_continuation.evaluate_point_quantities(
            gait_wheels, points._replace(z=points.z.z)
        )
        # Without double support, the rear foot's force must not be positive.
        rear_force_sign = np.where(wheels.branch_wheel.is_phase_active[:, 0, 0] > 0.5, 1.0, -1.0)
        second_parameter_fractions = np.asarray(points.z.second_parameter_fraction)
        return quantity_table | {
            "lambda_4_plus": rear_force_sign * quantity_table["lambda_4_plus"],
            "second": second_parameter_values,
            RANGE_EDGE_COLUMN: np.minimum(
                second_parameter_fractions, 1.0 - second_parameter_fractions
            ),
        }

    def mask_undefined_quantities(
        self, quantity_table: QuantitiesByName, wheel_indices: np.ndarray
    ) -> QuantitiesByName:
        """Replace each quantity that is zero or undefined on the whole curve by NaN.

        - `wheel_indices`: index of the curve to which each point belongs.
        """
        special_point_names = np.array(self.special_point_names)[wheel_indices]
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
            for quantity_name, quantity_values in quantity_table.items()
        }
        return masked_quantities | {
            "outcome": np.where(is_step_discontinuous, Outcome.STEPPED, quantity_table["outcome"]),
            "closure": np.where(is_step_discontinuous, 0.0, quantity_table["closure"]),
        }

    def are_points_admissible(self, quantity_table: QuantitiesByName) -> np.ndarray:
        are_quantities_positive = np.all(
            [
                ~(quantity_table[quantity_name] <= 0.0)
                for quantity_name in self.branch_ending_quantities
            ],
            axis=0,
        )
        return are_quantities_positive & super().are_points_admissible(quantity_table)


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
            params = limit_cycle.system.make_wheel(limit_cycle.parameters)
            branch_wheel = BranchWheel(params, limit_cycle.collocation_state.is_phase_active)
            z = limit_cycle.collocation_state.solution
            curve_seeds.append(
                CurveSeed(
                    choose_continued_special_point_name(special_point.name, branch_wheel, z),
                    tuple(
                        float(self.model.get_parameter(params, name))
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
            z=transfer_solution_to_mesh(
                curve_seed.collocation_system, collocation_system, curve_seed.z
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
        test_function = GaitTestFunction(
            collocation_system, self.parameter_names, quantity_group, self.model, self.step_options
        )
        lower_bound, upper_bound = map(float, self.parameter_ranges[1])

        def make_start(curve_seed: CurveSeed) -> tuple[TestFunctionWheel, TestFunctionPoint, float]:
            has_double_support = bool(curve_seed.branch_wheel.is_phase_active[0, 0] > 0.5)
            quantity_name = select_test_quantity(curve_seed.special_point_name, has_double_support)
            first_parameter_value, second_parameter_value = curve_seed.parameter_values
            second_fraction = (second_parameter_value - lower_bound) / (upper_bound - lower_bound)
            return (
                TestFunctionWheel(
                    curve_seed.branch_wheel, jnp.asarray(quantity_group.index(quantity_name))
                ),
                TestFunctionPoint(curve_seed.z, jnp.asarray(second_fraction)),
                first_parameter_value,
            )

        wheels, z, first_parameter_values = jax.tree.map(
            lambda *leaves: np.stack(leaves), *map(make_start, padded_seeds)
        )
        branch_continuation = CurveContinuation(
            TestFunctionCurve(test_function, (lower_bound, upper_bound)),
            self.arclength_options,
            wheels,
            self.parameter_ranges[0],
            tuple(curve_seed.special_point_name for curve_seed in padded_seeds),
        )
        branch_data_by_seed = continue_and_locate_special_points(
            branch_continuation,
            z,
            jnp.asarray(first_parameter_values),
            np.arange(len(padded_seeds)) < len(curve_seeds),
            lambda wheel_index, point: lambda: point,
            is_finest_mesh,
        )
        return branch_data_by_seed[: len(curve_seeds)], collocation_system

    def _make_traced_curve(self, curve_seed: CurveSeed, branch_data: BranchData) -> TracedCurve:
        """Build a labeled curve, and seeds at the special points that the curve meets."""
        parameter_points = np.stack(
            [branch_data.points.p, branch_data.quantity_table["second"]], -1
        )
        scaled_vertices = np.column_stack(
            [
                branch_data.points.z.z.section_state,
                self.compute_parameter_fractions(parameter_points),
            ]
        )
        codim2_points, new_seeds, end_reasons = [], [], branch_data.end_reasons
        for special_point in branch_data.special_points:
            if special_point.name == RANGE_EDGE_COLUMN:
                continue
            point_beside_root = special_point.cycle
            second_fraction = point_beside_root.z.second_parameter_fraction
            second_parameter_value = float(
                self.parameter_ranges[1, 0] + np.ptp(self.parameter_ranges[1]) * second_fraction
            )
            meeting_parameter_values = special_point.value, second_parameter_value
            special_point_name = choose_continued_special_point_name(
                special_point.name, curve_seed.branch_wheel, point_beside_root.z.z
            )
            if {special_point_name, curve_seed.special_point_name} == {
                "lambda_4_plus",
                DLS_VANISHING_NAME,
            }:
                meeting_parameter_values = self._locate_jump_onset(
                    curve_seed, point_beside_root.z.z, meeting_parameter_values
                )
                new_seeds.append(
                    self._seed_beyond_meeting(
                        special_point_name,
                        curve_seed,
                        scaled_vertices,
                        parameter_points,
                        branch_data.points.z.z,
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
                        z=point_beside_root.z.z,
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
        test_function = GaitTestFunction(
            curve_seed.collocation_system,
            self.parameter_names,
            CONTINUED_QUANTITIES,
            self.model,
            self.step_options,
        )
        onset_parameter_values, last_relative_parameter_change = locate_jump_onset(
            test_function,
            curve_seed.branch_wheel,
            jax.device_put(z),
            jnp.asarray(start_parameter_values),
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
        z = jax.tree.map(lambda x: jnp.asarray(extrapolate_from_meeting(x)), z)
        dls_duration = 0.0 if special_point_name == DLS_VANISHING_NAME else DLS_DURATION_GUESS_S
        z = z._replace(durations=z.durations.at[0, 0].set(dls_duration))
        return curve_seed._replace(
            special_point_name=special_point_name,
            parameter_values=tuple(extrapolate_from_meeting(parameter_points)),
            z=z,
        )

    def _make_labeled_curve(
        self, curve_seed: CurveSeed, branch_data: BranchData, codim2_points: tuple[Codim2Point, ...]
    ) -> SpecialPointCurve:
        spectral_radius = np.abs(
            np.linalg.eigvals(np.asarray(branch_data.points.return_map_jacobian))
        ).max(-1)
        quantity_table = branch_data.quantity_table | {"spectral_radius": spectral_radius}
        column_names = ("duration_dls", "duration_sls1", "duration_sls2", "spectral_radius")
        curve_variables: dict[str, Any] = make_labeled_variables(
            {column_name: quantity_table[column_name] for column_name in column_names}, "point"
        )
        curve_variables["mesh_error"] = ("point", quantity_table["mesh_error"])
        curve_variables["section_state"] = (("point", "component"), quantity_table["section_state"])
        first_parameter_name, second_parameter_name = self.parameter_names
        curve_coordinates = make_labeled_variables(
            {
                first_parameter_name: np.asarray(branch_data.points.p),
                second_parameter_name: quantity_table["second"],
            },
            "point",
        )
        start_provenance = collect_provenance_attributes(
            curve_seed.branch_wheel.params, self.model, self.step_options
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
    if special_point_name == BRANCH_POINT_KIND:
        return "fold"
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
        *BIFURCATION_NAMES,
        *DISCONTINUOUS_QUANTITIES,
        DLS_VANISHING_NAME,
        *FORCE_QUANTITY_NAMES,
    )
    return (
        special_point_name in continued_special_point_names
        or special_point_name.partition("[")[0] in MARGIN_MEASURES
    )
