"""Continuation of special points as curves in two parameters, in batches, each curve once.

A special point is computed together with its gait, so that a point of a curve is as accurate as the
gait. If a curve meets another special point, a new curve starts there.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from vrw_jax.branches.branch import Codim2Point, SpecialPoint, SpecialPointCurve
from vrw_jax.branches.branch_location import (
    AbstractContinuation,
    BranchData,
    QuantityTable,
    continue_and_locate,
)
from vrw_jax.branches.continuation import (
    BRANCH_ENDING_QUANTITIES,
    GAIT_BRANCH_OPTIONS,
    GaitContinuation,
    continue_branches,
)
from vrw_jax.branches.continuation_problems import BranchWheel
from vrw_jax.branches.gait_test_functions import (
    CONTINUED_QUANTITIES,
    DISCONTINUOUS_QUANTITIES,
    DLS_VANISHES,
    FORCE_FALL_NAME,
    LINEAR_SUBSTITUTES,
    GaitTestFunction,
    TestFunctionArgs,
    find_quantity_group,
    locate_jump_onset,
    select_test_quantity,
)
from vrw_jax.branches.multiplicity import BRANCH_POINT_KIND
from vrw_jax.collocation import CollocationSolution
from vrw_jax.continuation import (
    BIFURCATION_NAMES,
    ArclengthOptions,
    ContinuationPoint,
    TestFunctionCurve,
    TestFunctionPoint,
)
from vrw_jax.cycles import CollocationSystem, transfer_solution_to_mesh
from vrw_jax.measures import MARGIN_MEASURES, measure_attrs, provenance
from vrw_jax.models import ViscoelasticWheel
from vrw_jax.numerics import StepOptions, batch_sizes
from vrw_jax.runtime import xarray as xr
from vrw_jax.wheel import Outcome, WheelParams, wheel_from_parameters

EDGE_COLUMN = "edge of the box"
"""Name of the column that is zero if the second parameter is at an end of its range."""

DEFAULT_CURVE_OPTIONS = ArclengthOptions(initial_ds=5e-4)
"""Default options of curves, with a short first step because some curves are short."""


@dataclass(frozen=True)
class TracingOptions:
    """Options of the tracing of curves; lengths are arc lengths of curves.

    - `same_curve_distance`: largest distance of a point from a curve that contains it;
    - `overrun_distance`: distance from a point of codimension two at which the continuation of the
      other curve starts;
    - `codim2_tolerance`: tolerance of Newton's last step to a point of codimension two, relative to
      the values of the parameters;
    - `max_zero_duration`: duration of double support that counts as zero, s. It is chosen above
      round-off because the duration is ill-conditioned there;
    - `duration_guess`: first guess of a nonzero duration of double support, s.
    """

    same_curve_distance: float = 2e-3
    overrun_distance: float = 3e-3
    codim2_tolerance: float = 1e-9
    max_zero_duration: float = 1e-4
    duration_guess: float = 0.1


TRACING_OPTIONS = TracingOptions()
"""Options of the tracing of all curves."""


@dataclass(frozen=True)
class CurveContinuation(AbstractContinuation):
    """Continuation of special points, which are evaluated like gaits except for the quantity
    that vanishes.
    """

    problem: TestFunctionCurve
    second_parameter: str
    special_point_names: tuple[str, ...]  # name of the special point of each wheel
    gait_continuation: GaitContinuation  # continuation of gaits along the first parameter

    ending_quantities: ClassVar[tuple[str, ...]] = (
        *BRANCH_ENDING_QUANTITIES,
        EDGE_COLUMN,
        FORCE_FALL_NAME,
    )
    margin_names: ClassVar[tuple[str, ...]] = GaitContinuation.margin_names
    linear_substitutes: ClassVar[Mapping[str, str]] = LINEAR_SUBSTITUTES

    def evaluate_points(self, wheels: TestFunctionArgs, points: ContinuationPoint) -> QuantityTable:
        z, fraction = points.z
        (lower, upper), fraction = self.problem.bounds, np.asarray(fraction)
        second_values = lower + (upper - lower) * fraction
        get_second_parameter = lambda params: getattr(params, self.second_parameter)
        gait_wheels = wheels.gait._replace(
            params=eqx.tree_at(get_second_parameter, wheels.gait.params, second_values)
        )
        table = self.gait_continuation.evaluate_points(gait_wheels, points._replace(z=z))
        # Without double support the rear foot's force must not be positive.
        rear_force_sign = np.where(wheels.gait.phase_active[:, 0, 0] > 0.5, 1.0, -1.0)
        curve_quantities = {
            "lambda_4_plus": rear_force_sign * table["lambda_4_plus"],
            "second": second_values,
        }
        return table | curve_quantities | {EDGE_COLUMN: np.minimum(fraction, 1.0 - fraction)}

    def mask_undefined(self, table: QuantityTable, wheel_indices: np.ndarray) -> QuantityTable:
        """Return the table with NaN for quantities that are zero or undefined on a whole curve."""
        names_of_points = np.array(self.special_point_names)[wheel_indices]
        is_dls_vanishing = names_of_points == DLS_VANISHES
        is_discontinuous = np.isin(names_of_points, (*DISCONTINUOUS_QUANTITIES, DLS_VANISHES))
        step_names = {name for name in table if name.partition("[")[0] in MARGIN_MEASURES} - set(
            CONTINUED_QUANTITIES
        )
        masks = {name: names_of_points == name for name in {*self.special_point_names} & {*table}}
        masks |= {
            substitute: names_of_points == name for name, substitute in LINEAR_SUBSTITUTES.items()
        }
        masks |= {name: is_discontinuous | masks.get(name, False) for name in step_names}
        rear_force_mask = masks.get("lambda_4_plus", False) | is_dls_vanishing
        masks |= {"lambda_4_plus": rear_force_mask, FORCE_FALL_NAME: ~is_dls_vanishing}
        table = table | {
            name: np.where(mask if table[name].ndim == 1 else mask[:, None], np.nan, table[name])
            for name, mask in masks.items()
        }
        outcomes = np.where(is_discontinuous, Outcome.STEPPED, table["outcome"])
        return table | {
            "outcome": outcomes,
            "closure": np.where(is_discontinuous, 0.0, table["closure"]),
        }

    def is_admissible(self, table: QuantityTable) -> np.ndarray:
        is_positive = np.all([~(table[name] <= 0.0) for name in self.ending_quantities], axis=0)
        return is_positive & self.gait_continuation.is_admissible(table)

    def is_mesh_limited(self, table: QuantityTable, ends: tuple[str, ...]) -> bool:
        return self.gait_continuation.is_mesh_limited(table, ends)

    def name_end(self, table: QuantityTable, row_index: int) -> str:
        return self.gait_continuation.name_end(table, row_index)


class CurveSeed(NamedTuple):
    """Point on or near a curve of special points, from which the curve is continued."""

    name: str
    parameter_values: tuple[float, float]  # values of the two parameters
    system: CollocationSystem
    gait: BranchWheel
    z: CollocationSolution


class TracedCurve(NamedTuple):
    """Traced curve, with seeds at the special points that it meets."""

    curve: SpecialPointCurve
    # section states and both parameters as fractions of their ranges, (point, coordinate)
    vertices: np.ndarray
    new_seeds: tuple[CurveSeed, ...]


class CurveTracer(NamedTuple):
    """Tracer of curves of special points within the ranges of two parameters."""

    parameters: tuple[str, str]
    parameter_ranges: np.ndarray  # bounds of each parameter, (parameter, 2)
    model: ViscoelasticWheel
    options: ArclengthOptions
    step_options: StepOptions
    on_stage: Callable[[str], None] | None = None
    tracing_options: TracingOptions = TRACING_OPTIONS

    def report_stage(self, stage: str) -> None:
        """Call `on_stage`, if it is given, with a description of the next stage."""
        if self.on_stage is not None:
            self.on_stage(stage)

    def with_parameters(self, params: WheelParams, values: Mapping[str, float]) -> WheelParams:
        """Return the wheel with other values of some parameters."""
        for name, value in values.items():
            params = self.model.with_parameter(params, name, jnp.asarray(value))[1]
        return params

    def parameter_fractions(self, values: np.ndarray) -> np.ndarray:
        """Return both parameters, on the last axis, as fractions of their ranges."""
        return (values - self.parameter_ranges[:, 0]) / np.ptp(self.parameter_ranges, 1)

    def find_seeds(self, axis: int, params: WheelParams) -> list[CurveSeed]:
        """Return seeds at the special points on branches of the wheels along the parameter of
        index `axis`.
        """
        name, seeds = self.parameters[axis], []
        lower_bound, upper_bound = self.parameter_ranges[axis]
        self.report_stage(f"following {len(params.damping)} branches along {name}")
        for branch in continue_branches(params, name, (lower_bound, upper_bound), model=self.model):
            for special_point in branch.special_points:
                if can_continue(special_point.name):
                    seeds.append(self._make_seed(special_point))
        return seeds

    def _make_seed(self, special_point: SpecialPoint) -> CurveSeed:
        """Return the seed at a special point of a branch."""
        cycle = special_point.cycle
        params = wheel_from_parameters(cycle.parameters, cycle.system.n_legs)
        first_value, second_value = (float(getattr(params, name)) for name in self.parameters)
        gait = BranchWheel(params, cycle.collocation_state.is_phase_active)
        z = cycle.collocation_state.solution
        name = name_special_point(special_point.name, gait, z, self.tracing_options)
        return CurveSeed(name, (first_value, second_value), cycle.system, gait, z)

    def trace_curves(
        self, seeds: Sequence[CurveSeed], known_curves: Sequence[TracedCurve]
    ) -> list[TracedCurve]:
        """Return the curves through all seeds that are on none of the known curves."""
        new_curves: list[TracedCurve] = []
        new_seeds = [
            seed
            for seed in seeds
            if not any(self._is_on_curve(seed, curve) for curve in known_curves)
        ]
        quantity_groups = {find_quantity_group(seed.name, seed.system.n_legs) for seed in new_seeds}
        for quantity_group in sorted(quantity_groups):
            remaining_seeds = [
                s
                for s in new_seeds
                if find_quantity_group(s.name, s.system.n_legs) == quantity_group
            ]
            while remaining_seeds:
                batch_seeds: list[CurveSeed] = []
                # A batch contains each name once, because other seeds of the name may be on its
                # curve.
                for seed in remaining_seeds:
                    if (
                        seed.name not in {s.name for s in batch_seeds}
                        and len(batch_seeds) < batch_sizes.CURVE_BATCH_SIZE
                    ):
                        batch_seeds.append(seed)
                accepted_curves: list[TracedCurve] = []
                for curve in self._trace_batch(quantity_group, batch_seeds):
                    if not any(
                        self.is_same_curve(curve, other_curve)
                        for other_curve in (*known_curves, *new_curves, *accepted_curves)
                    ):
                        accepted_curves.append(curve)
                new_curves += accepted_curves
                remaining_seeds = [
                    seed
                    for seed in remaining_seeds
                    if not any(seed is batch_seed for batch_seed in batch_seeds)
                    and not any(self._is_on_curve(seed, curve) for curve in accepted_curves)
                ]
        return new_curves

    def _is_on_curve(self, seed: CurveSeed, curve: TracedCurve) -> bool:
        """Return whether a seed is on a curve of the same special point."""
        seed_point = np.append(
            seed.z.section_state, self.parameter_fractions(np.array(seed.parameter_values))
        )
        has_same_name = seed.name == curve.curve.name
        max_distance = self.tracing_options.same_curve_distance
        return has_same_name and bool(
            distance_to_polyline(seed_point[None], curve.vertices)[0] < max_distance
        )

    def is_same_curve(self, curve: TracedCurve, other_curve: TracedCurve) -> bool:
        """Return whether each point of a curve is on the other curve, and both have the same
        name.
        """
        has_same_name = curve.curve.name == other_curve.curve.name
        max_distance = self.tracing_options.same_curve_distance
        return has_same_name and bool(
            np.max(distance_to_polyline(curve.vertices, other_curve.vertices)) < max_distance
        )

    def _trace_batch(
        self, quantity_group: tuple[str, ...], seeds: list[CurveSeed]
    ) -> list[TracedCurve]:
        """Return a curve through each seed that has one, on a sufficiently fine mesh."""
        curves: list[TracedCurve] = []
        names = ", ".join(sorted({seed.name for seed in seeds}))
        self.report_stage(f"following special points: {names}")
        max_refinements = GAIT_BRANCH_OPTIONS.max_refinements
        for refinement in range(1 + max_refinements):
            is_finest = refinement == max_refinements
            branches = self._continue_batch(quantity_group, seeds, is_finest)
            mesh_limited_seeds = []
            for seed, (branch, system) in zip(seeds, branches, strict=True):
                if branch is not None and branch.is_mesh_limited and not is_finest:
                    options = system.cycle_options.refine_mesh()
                    mesh_limited_seeds.append(
                        self._transfer_seed(seed, system._replace(cycle_options=options))
                    )
                elif branch is not None:
                    curves.append(self._label_traced(seed._replace(system=system), branch))
            if not mesh_limited_seeds:
                break
            seeds = mesh_limited_seeds
        return curves

    @staticmethod
    def _transfer_seed(seed: CurveSeed, system: CollocationSystem) -> CurveSeed:
        """Return the seed transferred to the mesh of `system`."""
        if seed.system == system:
            return seed
        return seed._replace(
            system=system, z=transfer_solution_to_mesh(seed.system, system, seed.z)
        )

    def _continue_batch(
        self, quantity_group: tuple[str, ...], seeds: list[CurveSeed], is_finest: bool
    ) -> list[tuple[BranchData | None, CollocationSystem]]:
        """Return the data of a curve through each seed, with the system of the finest mesh among
        the seeds.
        """
        system = max(
            (seed.system for seed in seeds), key=lambda system: system.cycle_options.mesh_intervals
        )
        seeds = [self._transfer_seed(seed, system) for seed in seeds]
        padded_seeds = [*seeds, *seeds[-1:] * (-len(seeds) % batch_sizes.CURVE_BATCH_SIZE)]
        test_function = GaitTestFunction(
            system, self.parameters, quantity_group, self.model, self.step_options
        )
        stack_trees = lambda *trees: jax.tree.map(lambda *x: np.stack(x), *trees)
        quantity_names = [
            select_test_quantity(seed.name, bool(seed.gait.phase_active[0, 0] > 0.5))
            for seed in padded_seeds
        ]
        quantity_indices = [jnp.asarray(quantity_group.index(name)) for name in quantity_names]
        wheels = stack_trees(
            *(
                TestFunctionArgs(seed.gait, quantity_index)
                for seed, quantity_index in zip(padded_seeds, quantity_indices, strict=True)
            )
        )
        lower, upper = map(float, self.parameter_ranges[1])
        second_fraction = lambda seed: jnp.asarray(
            (seed.parameter_values[1] - lower) / (upper - lower)
        )
        z = stack_trees(
            *(TestFunctionPoint(seed.z, second_fraction(seed)) for seed in padded_seeds)
        )
        gait_continuation = GaitContinuation(
            test_function.gait_problem,
            self.options,
            wheels.gait,
            self.parameter_ranges[0],
            self.model,
            self.step_options,
            system.n_legs,
        )
        continuation = CurveContinuation(
            TestFunctionCurve(test_function, (lower, upper)),
            self.options,
            wheels,
            self.parameter_ranges[0],
            self.parameters[1],
            tuple(seed.name for seed in padded_seeds),
            gait_continuation,
        )
        first_values = jnp.asarray([seed.parameter_values[0] for seed in padded_seeds])
        is_requested = np.arange(len(padded_seeds)) < len(seeds)
        branches = continue_and_locate(
            continuation,
            z,
            first_values,
            is_requested,
            lambda wheel_index, point: lambda: point,
            is_finest,
        )
        return [(branch, system) for branch in branches[: len(seeds)]]

    def _label_traced(self, seed: CurveSeed, branch: BranchData) -> TracedCurve:
        """Return the labeled curve from its data, with seeds at the special points that it
        meets.
        """
        values = np.stack([branch.points.p, branch.table["second"]], -1)
        vertices = np.column_stack(
            [branch.points.z.z.section_state, self.parameter_fractions(values)]
        )
        codim2_points, new_seeds, end_reasons = [], [], branch.ends
        for special_point in branch.special_points:
            if special_point.name == EDGE_COLUMN:
                continue
            point_beside = special_point.cycle
            meeting_values = (
                special_point.value,
                float(
                    self.parameter_ranges[1, 0]
                    + np.ptp(self.parameter_ranges[1]) * point_beside.z.fraction
                ),
            )
            name = name_special_point(
                special_point.name, seed.gait, point_beside.z.z, self.tracing_options
            )
            if {name, seed.name} == {"lambda_4_plus", DLS_VANISHES}:
                meeting_values = self._locate_jump_onset(seed, point_beside.z.z, meeting_values)
                new_seeds.append(
                    self._seed_beyond_meeting(
                        name, seed, vertices, values, branch.points.z.z, meeting_values
                    )
                )
                text_replacement = f"{special_point.value:.9g}", f"{meeting_values[0]:.9g}"
                end_reasons = (
                    end_reasons[0].replace(*text_replacement),
                    end_reasons[1].replace(*text_replacement),
                )
            elif can_continue(name):
                seed_values = float(point_beside.p), meeting_values[1]
                new_seeds.append(
                    CurveSeed(name, seed_values, seed.system, seed.gait, point_beside.z.z)
                )
            codim2_points.append(Codim2Point(name, meeting_values, special_point.ends_branch))
        curve = self._label_curve(seed, branch._replace(ends=end_reasons), tuple(codim2_points))
        return TracedCurve(curve, vertices, tuple(new_seeds))

    def _locate_jump_onset(
        self, seed: CurveSeed, z: CollocationSolution, start_values: Any
    ) -> tuple[float, float]:
        """Return both parameters at the onset of the jump, or `start_values` if it is not found."""
        test_function = GaitTestFunction(
            seed.system, self.parameters, CONTINUED_QUANTITIES, self.model, self.step_options
        )
        onset_values, last_change = locate_jump_onset(
            test_function, seed.gait, jax.device_put(z), jnp.asarray(start_values)
        )
        is_found = last_change < self.tracing_options.codim2_tolerance
        first_value, second_value = onset_values if is_found else start_values
        return float(first_value), float(second_value)

    def _seed_beyond_meeting(
        self,
        name: str,
        seed: CurveSeed,
        vertices: np.ndarray,
        values: np.ndarray,
        z: CollocationSolution,
        meeting_values: Any,
    ) -> CurveSeed:
        """Return a seed beyond the point at which the rear foot's force starts to rise or fall.

        The force is zero along the curve. Both curves cross there and continue in the same
        direction. `meeting_values` are both parameters at the crossing.
        """
        starts_at_meeting = (
            abs(values[0] - meeting_values).max() < abs(values[-1] - meeting_values).max()
        )
        direction = 1 if starts_at_meeting else -1
        vertices, values = vertices[::direction], values[::direction]
        z = jax.tree.map(lambda x: x[::direction], z)
        overrun_distance = self.tracing_options.overrun_distance
        distances = np.linalg.norm(vertices - vertices[0], axis=1)
        point_index = int(np.argmax(distances >= min(overrun_distance, distances[-1])))
        extrapolate = lambda x: (
            x[0] + overrun_distance / distances[point_index] * (x[0] - x[point_index])
        )
        z = jax.tree.map(lambda x: jnp.asarray(extrapolate(x)), z)
        first_value, second_value = extrapolate(values)
        dls_duration = 0.0 if name == DLS_VANISHES else self.tracing_options.duration_guess
        z = z._replace(durations=z.durations.at[0, 0].set(dls_duration))
        return CurveSeed(name, (first_value, second_value), seed.system, seed.gait, z)

    def _label_curve(
        self, seed: CurveSeed, branch: BranchData, codim2_points: tuple[Codim2Point, ...]
    ) -> SpecialPointCurve:
        """Return the labeled curve from its data."""
        spectral_radius = np.abs(np.linalg.eigvals(np.asarray(branch.points.jacobian))).max(-1)
        table = branch.table | {"spectral_radius": spectral_radius}
        column_names = ("duration_dls", "duration_sls1", "duration_sls2", "spectral_radius")
        variables: dict[str, Any] = {
            column_name: ("point", table[column_name], measure_attrs(column_name))
            for column_name in column_names
        }
        variables["mesh_error"] = ("point", table["mesh_error"])
        variables["section_state"] = (("point", "component"), table["section_state"])
        values = np.asarray(branch.points.p), table["second"]
        labels = {
            parameter: ("point", value, measure_attrs(parameter))
            for parameter, value in zip(self.parameters, values, strict=True)
        }
        start_wheel = provenance(seed.gait.params, self.model, self.step_options)
        title = {"title": f"Curve of {seed.name} over {' and '.join(self.parameters)}"}
        dataset = xr.Dataset(variables, labels, title | start_wheel)
        return SpecialPointCurve(seed.name, self.parameters, dataset, codim2_points, branch.ends)


def distance_to_polyline(points: np.ndarray, vertices: np.ndarray) -> np.ndarray:
    """Return the distance of each point from a polyline, whose vertices are rows of `vertices`,
    shape (points,).
    """
    segment_starts, segment_vectors = vertices[:-1], np.diff(vertices, axis=0)
    squared_lengths = np.maximum(np.sum(segment_vectors**2, 1), 1e-300)
    offsets = points[:, None] - segment_starts
    fractions = np.clip(np.sum(offsets * segment_vectors, 2) / squared_lengths, 0.0, 1.0)
    distances = np.linalg.norm(offsets - fractions[..., None] * segment_vectors, axis=2)
    return np.min(distances, axis=1, initial=np.inf)


def name_special_point(
    name: str,
    gait: BranchWheel,
    z: CollocationSolution,
    options: TracingOptions = TRACING_OPTIONS,
) -> str:
    """Return the name of a special point of a curve or branch, given its gait."""
    if name == BRANCH_POINT_KIND:  # A curve of folds need not turn back at its special points.
        return "fold"
    if (
        name not in ("lambda_4_plus", DLS_VANISHES, FORCE_FALL_NAME)
        or gait.phase_active[0, 0] < 0.5
    ):
        return name
    dls_vanishes = name != FORCE_FALL_NAME and z.durations[0, 0] < options.max_zero_duration
    return DLS_VANISHES if dls_vanishes else "lambda_4_plus"


def can_continue(name: str) -> bool:
    """Return whether the special point of this name can be continued as a curve by
    `GaitTestFunction`.
    """
    return (
        name in (*BIFURCATION_NAMES, *DISCONTINUOUS_QUANTITIES, DLS_VANISHES)
        or name.partition("[")[0] in MARGIN_MEASURES
    )
