"""Trace curves of special points in two parameters, in batches, each curve once.

A special point and its gait are unknowns of the same equations, so that the points of a curve are
as accurate as the gaits. If a curve meets another special point, a new curve is traced from the
meeting point.
"""

import itertools
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from vrw_jax.base.options import StepOptions
from vrw_jax.base.results import xarray as xr
from vrw_jax.branches.arclength import ArclengthOptions
from vrw_jax.branches.branch import BIFURCATIONS, Codim2Point, SpecialPointCurve
from vrw_jax.branches.branch_continuation import Continuation
from vrw_jax.branches.branch_location import BranchData, continue_and_locate_special_points
from vrw_jax.branches.continuation import MAX_BRANCH_MESH_REFINEMENTS, continue_branches
from vrw_jax.branches.continuation_problems import (
    PHASE_DURATIONS,
    BranchWheel,
    CollocationProblem,
    GaitSearch,
)
from vrw_jax.branches.curve_problems import (
    CONTINUED_QUANTITIES,
    DISCONTINUOUS_QUANTITIES,
    DLS_VANISHING_NAME,
    FORCE_QUANTITY_NAMES,
    INITIAL_FORCE_FALL_NAME,
    RANGE_EDGE,
    CollocationCurveProblem,
    CurveWheel,
    compute_continued_quantities,
    find_test_quantity_group,
    locate_jump_onset,
    select_test_quantity,
)
from vrw_jax.gaits.gauss import CollocationSolution
from vrw_jax.gaits.limit_cycle_result import LimitCycle, transfer_solution_to_mesh
from vrw_jax.gaits.phase_sequence import CollocationSystem
from vrw_jax.models.ladder import collect_provenance_attributes
from vrw_jax.models.measures import MARGIN_MEASURES, make_labeled_variables
from vrw_jax.models.viscoelastic import ViscoelasticWheel
from vrw_jax.wheel.params import WheelParams

CURVE_BATCH_SIZE = 8
"""Number of curves of special points that are traced together, fixed so that one shape is
compiled.
"""


class CurveSeed(NamedTuple):
    """Point on or near a curve of special points, from which the curve is traced."""

    special_point_name: str
    parameter_values: tuple[float, ...]  # of the two parameters
    collocation_system: CollocationSystem
    branch_wheel: BranchWheel
    z: CollocationSolution

    def transfer(self, system: CollocationSystem) -> "CurveSeed":
        """Return the seed on the mesh of another system."""
        if self.collocation_system == system:
            return self
        z = transfer_solution_to_mesh(self.collocation_system, system, self.z)
        return self._replace(collocation_system=system, z=jax.tree.map(np.asarray, z))


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

    def is_on_any(self, curves: Iterable["TracedCurve"]) -> bool:
        """Return whether this curve is one of several curves, or a part of it."""
        name = self.special_point_curve.name
        return any(curve.contains_points(name, self.scaled_vertices) for curve in curves)


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
    report_stage: Callable[[str], Any] = lambda stage: None
    measures_force_peaks: bool = False  # whether branches measure the peaks of the gait's force

    def with_parameters(self, params: WheelParams, values: np.ndarray) -> WheelParams:
        """Return a batch of wheels with new values of the two parameters, shape (wheels, 2)."""
        wheels = jax.tree.map(lambda x: jnp.broadcast_to(x, len(values)), params)
        select = lambda wheel: [getattr(wheel, name) for name in self.parameter_names]
        return eqx.tree_at(select, wheels, list(jnp.asarray(values.T)))

    def compute_parameter_fractions(self, parameter_values: Any) -> np.ndarray:
        """Return the two parameters as fractions of their ranges, on the last axis."""
        lower_bounds = self.parameter_ranges[:, 0]
        return (np.asarray(parameter_values) - lower_bounds) / np.ptp(self.parameter_ranges, 1)

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
        seeds = []
        for special_point in itertools.chain(*(branch.special_points for branch in branches)):
            if not can_continue_special_point(special_point.name):
                continue
            # Newton's method at a fixed parameter may miss the gait, such as at a fold.
            search = special_point.find_cycle
            assert isinstance(search, GaitSearch)
            parameters, z = search.values, search.guess.solution
            wheel = BranchWheel(parameters, search.guess.is_phase_active)
            name = choose_continued_special_point_name(special_point.name, wheel, z)
            indices = map(self.model.parameter_names.index, self.parameter_names)
            values = tuple(float(parameters[index]) for index in indices)
            seeds.append(CurveSeed(name, values, search.finder.collocation_system, wheel, z))
        return seeds

    def trace_curves(
        self, curve_seeds: Sequence[CurveSeed], known_curves: Sequence[TracedCurve]
    ) -> list[TracedCurve]:
        """Trace the curves through all seeds that lie on no known curve."""
        curves = list(known_curves)

        def is_known(seed: CurveSeed) -> bool:
            fractions = self.compute_parameter_fractions(seed.parameter_values)
            point = np.append(seed.z.section_state, fractions)[None]
            return any(curve.contains_points(seed.special_point_name, point) for curve in curves)

        seeds_by_group: dict[tuple[str, ...], list[CurveSeed]] = {}
        for seed in curve_seeds:
            group = find_test_quantity_group(
                seed.special_point_name, seed.collocation_system.n_legs
            )
            seeds_by_group.setdefault(group, []).append(seed)
        for group in sorted(seeds_by_group):
            remaining = seeds_by_group[group]
            while remaining := [seed for seed in remaining if not is_known(seed)]:
                # A batch has one seed per name, because seeds of one name may lie on one curve.
                first_by_name = {seed.special_point_name: seed for seed in reversed(remaining)}
                names = dict.fromkeys(seed.special_point_name for seed in remaining)
                batch = [first_by_name[name] for name in names][:CURVE_BATCH_SIZE]
                for curve in self._trace_curves_of_batch(group, batch):
                    if not curve.is_on_any(curves):
                        curves.append(curve)
                remaining = [seed for seed in remaining if not any(seed is x for x in batch)]
        return curves[len(known_curves) :]

    def _trace_curves_of_batch(
        self, quantity_group: tuple[str, ...], curve_seeds: list[CurveSeed]
    ) -> list[TracedCurve]:
        """Trace the curves through the seeds of one batch, on a sufficiently fine mesh.

        A seed is omitted if there is no curve through it.

        - `quantity_group`: names of the quantities that are evaluated together.
        """
        names = ", ".join(sorted({seed.special_point_name for seed in curve_seeds}))
        self.report_stage(f"following special points: {names}")
        traced_curves = []
        for n_refinements_left in range(MAX_BRANCH_MESH_REFINEMENTS, -1, -1):
            # All curves are continued on the finest mesh that any of the seeds has.
            system = max(
                (seed.collocation_system for seed in curve_seeds),
                key=lambda system: system.cycle_options.mesh_intervals,
            )
            curve_seeds = [seed.transfer(system) for seed in curve_seeds]
            data_by_seed = self._continue_curves_of_batch(
                quantity_group, curve_seeds, not n_refinements_left
            )
            options, coarse_seeds = system.cycle_options.refine_mesh(), []
            for seed, data in zip(curve_seeds, data_by_seed, strict=False):
                if data is not None and data.is_mesh_limited and n_refinements_left:
                    coarse_seeds.append(seed.transfer(system._replace(cycle_options=options)))
                elif data is not None:
                    traced_curves.append(self._make_traced_curve(seed, data))
            if not coarse_seeds:
                break
            curve_seeds = coarse_seeds
        return traced_curves

    def _continue_curves_of_batch(
        self, quantity_group: tuple[str, ...], curve_seeds: list[CurveSeed], is_finest_mesh: bool
    ) -> list[BranchData | None]:
        """Continue the curve through each seed, and return its data; further entries are None."""
        n_padding = -len(curve_seeds) % CURVE_BATCH_SIZE
        padded_seeds = [*curve_seeds, *curve_seeds[-1:] * n_padding]
        names = tuple(seed.special_point_name for seed in padded_seeds)
        problem = self.make_problem(curve_seeds[0], quantity_group, names)

        def make_start(seed: CurveSeed) -> tuple[CurveWheel, CollocationSolution, Any, Any]:
            has_double_support = bool(seed.branch_wheel.is_phase_active[0, 0] > 0.5)
            name = select_test_quantity(seed.special_point_name, has_double_support)
            fraction = self.compute_parameter_fractions(seed.parameter_values)[1]
            wheel = CurveWheel(seed.branch_wheel, np.asarray(quantity_group.index(name)))
            return wheel, seed.z, fraction, seed.parameter_values[0]

        wheels, z, fractions, first_values = jax.tree.map(
            lambda *leaves: np.stack(leaves), *map(make_start, padded_seeds)
        )
        return continue_and_locate_special_points(
            Continuation(problem, self.arclength_options, self.parameter_ranges[0], wheels),
            np.column_stack([fractions, problem.gaits.pack(z)]),
            first_values,
            np.arange(len(padded_seeds)) < len(curve_seeds),
            is_finest_mesh,
        )

    def make_problem(
        self, seed: CurveSeed, quantity_group: tuple[str, ...], names: tuple[str, ...]
    ) -> CollocationCurveProblem:
        """Return the problem of curves of named special points, for solutions like that of a seed.

        - `quantity_group`: quantities that are evaluated together.
        """
        gaits = CollocationProblem(
            model=self.model,
            step_options=self.step_options,
            n_legs=seed.collocation_system.n_legs,
            continued_names=self.parameter_names,
            period_n=1,
            collocation_system=seed.collocation_system,
            shapes=tuple(x.shape for x in jax.tree.leaves(seed.z)),
            additional_quantity_function=compute_continued_quantities,
        )
        lower_bound, upper_bound = map(float, self.parameter_ranges[1])
        return CollocationCurveProblem(
            second_bounds=(lower_bound, upper_bound), gaits=gaits, quantity_names=quantity_group,
            special_point_names=names,
        )  # fmt: skip

    def _make_traced_curve(self, seed: CurveSeed, branch_data: BranchData) -> TracedCurve:
        """Build a labeled curve, and seeds at the special points that the curve meets."""
        parameter_points = np.stack([branch_data.points.p, branch_data.quantities["second"]], -1)
        problem = self.make_problem(seed, CONTINUED_QUANTITIES, (seed.special_point_name,))
        gaits, rows = problem.gaits, branch_data.points.z[:, 1:]
        vertices = np.column_stack(
            [gaits.section_state(rows), self.compute_parameter_fractions(parameter_points)]
        )
        codim2_points, new_seeds, end_reasons = [], [], branch_data.end_reasons
        for special_point in branch_data.special_points:
            if special_point.name == RANGE_EDGE:
                continue
            beside = special_point.cycle
            z, second = gaits.unpack(beside.z[1:]), problem.compute_second_parameter(beside.z)
            meeting: Any = special_point.value, float(second)
            name = choose_continued_special_point_name(special_point.name, seed.branch_wheel, z)
            if {name, seed.special_point_name} == {"lambda_4_plus", DLS_VANISHING_NAME}:
                onset, last_change = locate_jump_onset(
                    problem, seed.branch_wheel, beside.z[1:], np.array(meeting)
                )
                if last_change < RELATIVE_CODIM2_TOLERANCE:
                    meeting = tuple(onset.tolist())
                renamed = seed._replace(special_point_name=name)
                new_seeds.append(
                    self._seed_beyond_meeting(
                        renamed, vertices, parameter_points, gaits.unpack(rows), meeting
                    )
                )
                first_reason, last_reason = (
                    reason.replace(f"{special_point.value:.9g}", f"{meeting[0]:.9g}")
                    for reason in end_reasons
                )
                end_reasons = first_reason, last_reason
            elif can_continue_special_point(name):
                values = float(beside.p), meeting[1]
                new_seeds.append(
                    seed._replace(special_point_name=name, parameter_values=values, z=z)
                )
            codim2_points.append(Codim2Point(name, meeting, special_point.ends_branch))
        jacobians, quantities = branch_data.points.return_map_jacobian, branch_data.quantities
        spectral_radius = np.abs(np.linalg.eigvals(jacobians)).max(-1)
        columns = {"spectral_radius": spectral_radius}
        columns |= {name: quantities[name] for name in PHASE_DURATIONS}
        variables: dict[str, Any] = make_labeled_variables(columns, "point")
        variables["mesh_error"] = ("point", quantities["mesh_error"])
        variables["section_state"] = (("point", "component"), quantities["section_state"])
        coordinates = dict(zip(self.parameter_names, parameter_points.T, strict=True))
        start_provenance = collect_provenance_attributes(
            seed.collocation_system.make_wheel(jnp.asarray(seed.branch_wheel.values)),
            self.model,
            self.step_options,
        )
        name, axes = seed.special_point_name, " and ".join(self.parameter_names)
        dataset = xr.Dataset(
            variables,
            make_labeled_variables(coordinates, "point"),
            {"title": f"Curve of {name} over {axes}"} | start_provenance,
        )
        curve = SpecialPointCurve(
            name, self.parameter_names, dataset, tuple(codim2_points), end_reasons
        )
        return TracedCurve(curve, vertices, tuple(new_seeds))

    def _seed_beyond_meeting(
        self,
        seed: CurveSeed,
        vertices: np.ndarray,
        parameter_points: np.ndarray,
        z: CollocationSolution,
        meeting: Any,
    ) -> CurveSeed:
        """Build a seed beyond the point at which the rear foot's force starts to rise or to fall.

        The force is zero on the curve. Two curves cross at that point and continue in the same
        direction. `meeting` contains the two parameters at the crossing.
        """
        distances = abs(parameter_points[[0, -1]] - meeting).max(-1)
        vertices, parameter_points, z = jax.tree.map(
            lambda x: x if distances[0] < distances[1] else x[::-1], (vertices, parameter_points, z)
        )
        distances = np.linalg.norm(vertices - vertices[0], axis=1)
        index = int(np.argmax(distances >= min(CODIM2_OVERRUN_DISTANCE, distances[-1])))
        extrapolate = lambda x: (
            x[0] + CODIM2_OVERRUN_DISTANCE / distances[index] * (x[0] - x[index])
        )
        z = jax.tree.map(extrapolate, z)
        z.durations[0, 0] = (
            0.0 if seed.special_point_name == DLS_VANISHING_NAME else DLS_DURATION_GUESS_S
        )
        return seed._replace(parameter_values=tuple(extrapolate(parameter_points)), z=z)


def compute_distances_to_polyline(
    query_points: np.ndarray, polyline_vertices: np.ndarray
) -> np.ndarray:
    """Return the distance of each point from a polyline, shape (points,).

    Each row of `polyline_vertices` is a vertex of the polyline.
    """
    segments = np.diff(polyline_vertices, axis=0)
    offsets = query_points[:, None] - polyline_vertices[:-1]
    squared_lengths = np.maximum(np.sum(segments**2, 1), 1e-300)
    fractions = np.clip(np.sum(offsets * segments, 2) / squared_lengths, 0.0, 1.0)
    distances = np.linalg.norm(offsets - fractions[..., None] * segments, axis=2)
    return np.min(distances, axis=1, initial=np.inf)


# Largest duration of double support that is treated as zero, s. The value is chosen above round-off
# because the duration is ill-conditioned near zero.
MAX_ZERO_DLS_DURATION_S = 1e-4


def choose_continued_special_point_name(
    special_point_name: str, branch_wheel: BranchWheel, z: CollocationSolution
) -> str:
    """Return the name under which a special point of a gait is continued as a curve.

    In gaits with double support, special points of the rear foot's force are continued as
    `DLS_VANISHING_NAME` or "lambda_4_plus".
    """
    ends_by_rear_force = special_point_name in ("lambda_4_plus", DLS_VANISHING_NAME)
    has_double_support = branch_wheel.is_phase_active[0, 0] >= 0.5
    if has_double_support and ends_by_rear_force and z.durations[0, 0] < MAX_ZERO_DLS_DURATION_S:
        return DLS_VANISHING_NAME
    is_of_rear_force = ends_by_rear_force or special_point_name == INITIAL_FORCE_FALL_NAME
    return "lambda_4_plus" if has_double_support and is_of_rear_force else special_point_name


def can_continue_special_point(special_point_name: str) -> bool:
    """Return whether the named special point can be continued as a curve."""
    names = *BIFURCATIONS, *DISCONTINUOUS_QUANTITIES, DLS_VANISHING_NAME, *FORCE_QUANTITY_NAMES
    return special_point_name.partition("[")[0] in (*names, *MARGIN_MEASURES)
