"""Continue branches of stable and unstable gaits in one parameter, with all their special points.

A special point is a bifurcation or a border collision. At a border collision an indicator or a
margin vanishes. During the search for a special point, the gait is computed anew at every trial.
Special points are therefore as accurate as the gaits.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from vrw_jax.base.checks import (
    check_bool,
    check_callable,
    check_int,
    check_range,
    check_real,
    check_reals,
    check_type,
    require_no_masked_entries,
    require_untraced_arguments,
)
from vrw_jax.base.lazy_xarray import xarray as xr
from vrw_jax.base.options import StepOptions
from vrw_jax.base.progress import announce_wait
from vrw_jax.branches.arclength import ArclengthOptions, ContinuationPoint, Track, run_together
from vrw_jax.branches.branch import Branch, FixedPoint
from vrw_jax.branches.branch_location import (
    EVENT_ORDER,
    EVENT_ORDER_CHANGE,
    AbstractContinuation,
    BranchData,
    PointTable,
    QuantitiesByName,
    continue_and_locate_special_points,
)
from vrw_jax.branches.branch_starts import START_FUNCTION_BY_METHOD, BranchRequest
from vrw_jax.branches.continuation_problems import FRICTION_SURPLUS, BranchWheel, MapProblem
from vrw_jax.branches.hybrid_branch import find_parameter, make_section_map
from vrw_jax.branches.test_functions import BIFURCATIONS, TestFunction, compute_multipliers
from vrw_jax.flow.hybrid_system import HybridSystem
from vrw_jax.gaits.cycle import AbstractCycle
from vrw_jax.gaits.finder_selection import make_finder
from vrw_jax.gaits.fixed_points import (
    UNIT_MULTIPLIER_ADVICE,
    check_state_units,
    check_vector_map,
    estimate_state_units,
    has_unit_multiplier,
)
from vrw_jax.gaits.gait_search import resolve_model
from vrw_jax.gaits.hybrid_gait import HybridGait
from vrw_jax.gaits.limit_cycle_result import LimitCycle
from vrw_jax.gaits.options import CycleOptions
from vrw_jax.gaits.return_map_finder import ReturnMapCycle
from vrw_jax.lanes.batching import select_tree_rows
from vrw_jax.models.interface import AbstractWheel
from vrw_jax.models.measures import (
    FORCE_PEAK_MEASURES,
    MARGIN_MEASURES,
    MEASURES,
    STEP_MEASURES,
    UNILATERAL_STEP_MEASURES,
    describe_parameter,
    make_labeled_variables,
    make_locked_leg_coordinate,
)
from vrw_jax.models.provenance import collect_provenance_attributes
from vrw_jax.models.stepping import (
    ModelLike,
    convert_model_argument,
    convert_step_options,
    require_single_wheel,
)
from vrw_jax.wheel.outcomes import Outcome
from vrw_jax.wheel.params import FRICTION_NAME, WheelParams, check_parameter_name

DOUBLE_SUPPORT_INDICATOR_NAMES = ("lambda_I4", "lambda_2_plus", "lambda_4_plus")
BRANCH_ENDING_QUANTITIES = (
    *DOUBLE_SUPPORT_INDICATOR_NAMES,
    "duration_dls",
    "duration_sls1",
    "duration_sls2",
)
"""Names of the quantities that end a branch if they vanish, because the order of events changes."""

SECOND_PEAK_RATE_NAME = "second_peak_rate"
"""Name of a measure of the gait's force. If it is zero, a force peak appears inside a phase."""
FORCE_PEAK_COUNT, FORCE_PEAK_COUNT_CHANGE = "n_force_peaks", "number_of_force_peaks_changes"
"""Name of the number of force peaks, and of the special point at which a peak appears or
disappears, at an event or inside a phase.
"""

_BORDER = "border_collision"
GAIT_TEST_FUNCTIONS: Mapping[str, TestFunction] = {
    **BIFURCATIONS,
    **{name: TestFunction("lost", "A phase vanishes.", True) for name in BRANCH_ENDING_QUANTITIES},
    FRICTION_SURPLUS: TestFunction("lost", "No contact carries the weight along the slope.", True),
    **{name: TestFunction(_BORDER, MEASURES[name].description) for name in MARGIN_MEASURES},
    **{
        name: TestFunction(_BORDER, "A landing without double support begins.", True)
        for name in DOUBLE_SUPPORT_INDICATOR_NAMES
    },
    SECOND_PEAK_RATE_NAME: TestFunction(
        _BORDER, "A force peak appears inside a phase.", explains=FORCE_PEAK_COUNT_CHANGE
    ),
    EVENT_ORDER: TestFunction(EVENT_ORDER_CHANGE, "Events change their order.", is_stepwise=True),
    FORCE_PEAK_COUNT: TestFunction(
        FORCE_PEAK_COUNT_CHANGE, "A force peak appears or disappears.", is_stepwise=True
    ),
}
"""Test functions of gaits by name."""

DIFFERENTIATION_ADVICE = "differentiate vrw.limit_cycle"
"""Advice in the error message for a caller who differentiates a branch."""


# Largest relative change of period and step length at a jump of the section state within one
# branch. The value is chosen because a change in the order of two impacts changes period and step
# length by 1e-4.
MAX_MEASURE_CHANGE_AT_JUMP = 0.01


def split_legs(quantities: QuantitiesByName, n_legs: int) -> QuantitiesByName:
    """Return quantities with one for each leg, in addition to margins that have a value per leg."""
    for name, margin in MARGIN_MEASURES.items():
        if margin.leg_dimension and name in quantities:
            quantities |= {
                f"{name}[{leg}]": quantities[name][:, leg - 3] for leg in range(3, n_legs + 1)
            }
    return quantities


@dataclass(frozen=True)
class GaitContinuation(AbstractContinuation):
    """Continuation of gaits."""

    test_functions: ClassVar[Mapping[str, TestFunction]] = GAIT_TEST_FUNCTIONS
    linear_margin_substitutes: ClassVar[Mapping[str, str]] = {
        "clearance_sls1": "takeoff_acceleration"
    }
    """Names of margins that vanish as a cube. Each margin is mapped to a quantity that vanishes
    linearly at the same point.

    A foot that takes off less steeply descends less deeply, until it rises immediately. A solver
    cannot resolve the shallowest descents, but the linear quantity changes its sign.
    """

    def evaluate_point_quantities(
        self, wheels: BranchWheel, points: ContinuationPoint
    ) -> QuantitiesByName:
        """Return the measures of the gaits by name.

        If a margin has one value per leg, the result contains one quantity for each leg.
        """
        problem: Any = self.continuation_problem
        return split_legs(problem.measure_gaits(wheels, points), problem.n_legs)

    def is_same_gait(self, before: PointTable, after: PointTable) -> np.ndarray:
        """Return whether period and step length are about equal before and after each jump."""
        is_similar = super().is_same_gait(before, after)
        for name in ("period", "step_length"):
            values, new_values = before.quantities[name], after.quantities[name]
            is_similar &= np.abs(new_values - values) <= MAX_MEASURE_CHANGE_AT_JUMP * np.abs(values)
        return is_similar

    def describe_branch_end(self, end_name: str, parameter_value: float) -> str:
        if end_name != FRICTION_SURPLUS:
            return super().describe_branch_end(end_name, parameter_value)
        return (
            f"At {parameter_value:.9g} the friction coefficient is the tangent of the slope: "
            "with less no contact carries the weight along the slope, and no gait repeats."
        )


@announce_wait("gaits, their derivatives and special points", "30 s")
def continue_branch(
    params: Any,
    name: str,
    bounds: tuple[float, float],
    *,
    cycle: Any = None,
    period_n: int = 1,
    model: ModelLike | HybridSystem | None = None,
    options: ArclengthOptions | None = None,
    cycle_options: CycleOptions | None = None,
    step_options: StepOptions | None = None,
    force_peaks: bool = False,
) -> Branch:
    """Continue the branch of limit cycles through `params` in one parameter, within `bounds`.

    The continuation starts from the limit cycle at `params`, or from `cycle`, which belongs to the
    same parameters. The branch is continued in both directions, through folds, over stable and
    unstable gaits, to the bounds or to its end. `Branch.ends` contains the reasons for both ends. A
    branch ends if the events change their order, or if the mesh is too coarse (`mesh_too_coarse`).
    Without `cycle_options` the mesh is first refined, up to eight times.

    Each special point is located to 1e-9 in the parameter. Two sign changes within one continuation
    step (`options.max_ds`) cancel and are not found. The gaits use `cycle_options`, by default at
    least `CycleOptions.tight()`. One event-driven gait step checks each gait, and determines its
    indicators and margins.

    For models other than the paper's, the gaits are fixed points of the return map, as accurate as
    `step_options`. With unilateral contact `name` may also be "friction". The start is then a
    `ReturnMapCycle` in `cycle`, or the end of a walk. If the order of contacts changes, the branch
    continues with a kink or a jump, which is a special point. The branch ends if friction equals
    tan(slope).

    Model "auto" is replaced by the model that is selected for the start. If a margin of the paper's
    model is violated, the branch has a special point with the name of the margin. Beyond this point
    unilateral contact would be selected.

    For a `HybridSystem`, `params` are its parameters, `name` is that of one of their entries, and
    `cycle` is the `HybridGait` at `params`. Its bifurcations are located, as by `continue_map`.

    Args:
        params: one wheel; its gait is on the branch.
        name: name of the continued parameter.
        bounds: lower and upper bound of the parameter.
        cycle: the gait at `params`, if it is known.
        period_n: number of gait steps after which the gaits repeat.
        model: the model; the paper's, `ViscoelasticWheel()`, by default.
        options: `ArclengthOptions` of the branch.
        cycle_options: options of the gaits.
        step_options: options of the event-driven steps that check gaits, and of the gaits of other
            models.
        force_peaks: for the paper's model and for unilateral contact, add the measures of the
            gait's force. The branch then has the special point "second_peak_rate", at which a
            second peak appears. There the first and the second time derivative of the force are
            zero at the same time. The special point "number_of_force_peaks_changes" is any other
            change of the number of peaks, such as at a landing or at the start of slip.

    Returns:
        A `Branch`. If there is no gait from which to start, `outcome` is the reason.

    Raises:
        TypeError, ValueError: if an argument is invalid; the message names the remedy.

    Examples:
        >>> branch = vrw.continue_branch(vrw.WheelParams(), "damping", (190.0, 230.0))
        >>> point = branch.special_points[-1]
        >>> print(point.name, f"{point.value:.6f}", branch.ends[1])
        lambda_4_plus 219.847688 lambda 4 plus at 219.847688 ends it.
    """
    if isinstance(model, HybridSystem):
        check_type("cycle", cycle, HybridGait, "give vrw.limit_cycle(params, model=, guess=)")
        return continue_map(
            make_section_map(model, name, period_n, step_options),
            cycle.section_state,
            float(find_parameter(params, name)),
            bounds,
            constants=params,
            name=name,
            options=options,
        )
    require_single_wheel(params, "use vrw.continue_branches for a batch")
    if cycle is not None:
        check_type("cycle", cycle, AbstractCycle, "give vrw.limit_cycle(params)")
    require_untraced_arguments("vrw.continue_branch", DIFFERENTIATION_ADVICE, params, cycle)
    params_batch, cycle = jax.device_put(select_tree_rows((params, cycle), None))
    (branch,) = continue_branches(
        params_batch, name, bounds, cycle=cycle, period_n=period_n, options=options,
        model=convert_model_argument(resolve_model(params, model)),
        cycle_options=cycle_options, step_options=step_options, force_peaks=force_peaks,
    )  # fmt: skip
    return branch


@announce_wait("gaits, their derivatives and special points", "30 s")
def continue_branches(
    params: WheelParams,
    name: str,
    bounds: tuple[float, float],
    *,
    cycle: LimitCycle | ReturnMapCycle | None = None,
    period_n: int = 1,
    model: AbstractWheel | None = None,
    options: ArclengthOptions | None = None,
    cycle_options: CycleOptions | None = None,
    step_options: StepOptions | None = None,
    force_peaks: bool = False,
) -> tuple[Branch, ...]:
    """Continue the branches of a batch of wheels, as `continue_branch` does for one wheel.

    Every parameter has one leading axis. If a wheel has no limit cycle from which to start, its
    branch has no points, and its outcome is the reason.

    Args:
        params: the wheels; every field has the shape (wheels,).
        name: name of the continued parameter.
        bounds: lower and upper bound of the parameter.
        cycle: the gaits at `params`, if they are known.
        period_n: number of gait steps after which the gaits repeat.
        model: the model; the paper's, `ViscoelasticWheel()`, by default.
        options: `ArclengthOptions` of the branches.
        cycle_options: options of the gaits.
        step_options: as in `continue_branch`.
        force_peaks: as in `continue_branch`.

    Returns:
        One `Branch` per wheel.

    Raises:
        TypeError, ValueError: if an argument is invalid; the message names the remedy.

    Examples:
        >>> wheel = vrw.WheelParams(damping=np.array([205.0, 210.0]))
        >>> wheels = jax.tree.map(lambda v: jnp.broadcast_to(v, (2,)), wheel)
        >>> branches = vrw.continue_branches(wheels, "damping", (200.0, 230.0))
        >>> [round(branch.special_points[-1].value, 4) for branch in branches]
        [219.8477, 219.8477]
    """
    require_untraced_arguments("vrw.continue_branch", DIFFERENTIATION_ADVICE, params, cycle)
    check_type("params", params, WheelParams, "write vrw.WheelParams(damping=..., slope=...)")
    model, step_options = (
        convert_model_argument(model),
        convert_step_options(step_options or StepOptions.tight()),
    )
    if model.fallback_model is not model:
        raise TypeError(
            "the ladder can't be followed, since its gaits jump where the model changes: give "
            "vrw.ViscoelasticWheel() or vrw.UnilateralWheel()."
        )
    check_parameter_name(name, model.parameter_names, "parameter")
    params = model.attach_leg_force(params)
    if check_int("period_n", period_n) > 1 and cycle is None:
        raise ValueError(
            f"period_n is {period_n} and there is no cycle, but a gait of several steps is one of "
            "many beside the gait of one step: give cycle=vrw.limit_cycle(..., guess=...)."
        )
    (lower_bound, upper_bound), options = (
        check_range("bounds", bounds),
        _check_arclength_options(options),
    )
    gait_finder = make_finder(
        model, params.n_legs, cycle_options=cycle_options, step_options=step_options
    )
    has_force_peaks = FORCE_PEAK_MEASURES.keys() <= set(gait_finder.differentiable_measures)
    if check_bool("force_peaks", force_peaks) and not has_force_peaks:
        raise ValueError(
            f"force_peaks is True, but the branch of a {type(model).__name__} has no measures of "
            "the force: take vrw.ViscoelasticWheel() or vrw.UnilateralWheel()."
        )
    gait_finder.search_options.check_tolerances(jnp.result_type(*jax.tree.leaves(params)))
    batch_shape = np.broadcast_shapes(
        *(parameter_values_of_field.shape for parameter_values_of_field in jax.tree.leaves(params))
    )
    if len(batch_shape) != 1:
        raise ValueError(f"the wheels' batch has shape {batch_shape}, but it must have one axis.")
    (n_wheels,) = batch_shape
    if n_wheels == 0:
        return ()
    # The batch is padded to a power of two, because each size compiles programs.
    padded_batch_size = 1 << (n_wheels - 1).bit_length()
    wheel_indices = np.minimum(np.arange(padded_batch_size), n_wheels - 1)
    batch_padder = lambda parameter_values_of_field: np.broadcast_to(
        np.asarray(parameter_values_of_field), batch_shape
    )[wheel_indices]
    start_parameter_values = batch_padder(model.get_parameter(params, name))
    params, parameter_values = jax.device_put(
        (
            jax.tree.map(batch_padder, params),
            np.clip(start_parameter_values, lower_bound, upper_bound),
        )
    )
    if isinstance(cycle, AbstractCycle) and padded_batch_size > n_wheels:
        cycle = jax.device_put(select_tree_rows(cycle, wheel_indices))
    if name != FRICTION_NAME:
        _, params = model.with_parameter(params, name, parameter_values)
    branch_request = BranchRequest(
        params, model, name, parameter_values, period_n, cycle_options, step_options, force_peaks
    )
    start_outcomes, branch_data = _continue_gait_branches(
        branch_request, cycle, options, np.array([lower_bound, upper_bound]), n_wheels
    )
    return tuple(
        _make_labeled_gait_branch(
            branch_data[wheel_index],
            jax.device_put(select_tree_rows(params, wheel_index)),
            name,
            model,
            step_options,
            int(start_outcomes[wheel_index]),
        )
        for wheel_index in range(n_wheels)
    )


# Largest number of mesh refinements of a gait on a branch or a curve.
MAX_BRANCH_MESH_REFINEMENTS = 3


def _continue_gait_branches(
    branch_request: BranchRequest,
    start_cycle: Any,
    arclength_options: ArclengthOptions,
    parameter_bounds: np.ndarray,
    n_wheels: int,
) -> tuple[np.ndarray, list[BranchData | None]]:
    """Continue the branches of the first `n_wheels` wheels from their start gaits.

    Return the outcomes of the starts, and the data of the branches. Any further wheels only pad the
    batch. The mesh is that of the cycle options. Without cycle options the mesh is refined until it
    limits no branch.
    """
    can_refine_mesh = branch_request.cycle_options is None
    for refinement_index in range(1 + MAX_BRANCH_MESH_REFINEMENTS):
        branch_start = START_FUNCTION_BY_METHOD[branch_request.model.capabilities.gait_method](
            branch_request, start_cycle
        )
        branch_continuation = GaitContinuation(
            branch_start.continuation_problem,
            arclength_options,
            branch_start.wheels,
            parameter_bounds,
        )
        has_branch_start = branch_start.start_outcomes == Outcome.STEPPED
        has_branch_start &= np.arange(len(has_branch_start)) < n_wheels
        is_finest_mesh = (
            not can_refine_mesh
            or branch_start.finer_cycle_options is None
            or refinement_index == MAX_BRANCH_MESH_REFINEMENTS
        )
        branch_data_by_wheel = continue_and_locate_special_points(
            branch_continuation,
            branch_start.start_unknowns,
            np.asarray(branch_request.parameter_values),
            has_branch_start,
            branch_start.make_cycle_finder,
            is_finest_mesh,
        )
        # If a gait exists but no branch starts from it, its step does not repeat on this mesh.
        needs_finer_mesh = (
            gait_exists if branch_data is None else branch_data.is_mesh_limited
            for gait_exists, branch_data in zip(has_branch_start, branch_data_by_wheel, strict=True)
        )
        if is_finest_mesh or not any(needs_finer_mesh):
            break
        branch_request = branch_request._replace(cycle_options=branch_start.finer_cycle_options)
        start_cycle = branch_start.start_cycles
    return branch_start.start_outcomes, branch_data_by_wheel


MEASURES_OUTSIDE_BRANCHES = ("outcome", "solver_steps")
"""Names of measures of the event-driven step that the dataset of a branch does not contain."""


def _check_arclength_options(options: ArclengthOptions | None) -> ArclengthOptions:
    """Check the options of a continuation.

    Return them, or `ArclengthOptions()` if they are None.
    """
    options = ArclengthOptions() if options is None else options
    check_type("options", options, ArclengthOptions, "give vrw.ArclengthOptions()")
    return options


def _make_labeled_gait_branch(
    branch_data: BranchData | None,
    params: WheelParams,
    parameter_name: str,
    model: AbstractWheel,
    step_options: StepOptions,
    start_outcome: int,
) -> Branch:
    start_provenance = collect_provenance_attributes(params, model, step_options)
    start_provenance.pop(f"parameter_{parameter_name}", None)
    branch_attrs = {"title": f"Branch of limit cycles along {parameter_name}"} | start_provenance
    if branch_data is None:
        branch_outcome = Outcome(start_outcome)
        if branch_outcome == Outcome.STEPPED:
            branch_outcome = Outcome.NO_CYCLE_FOUND
        empty_dataset = xr.Dataset(
            coords={parameter_name: ("point", np.zeros(0))}, attrs=branch_attrs
        )
        return Branch(parameter_name, empty_dataset, (), ("", ""), branch_outcome)
    points, quantity_table, special_points, end_reasons, _ = branch_data
    measures = STEP_MEASURES | MARGIN_MEASURES | UNILATERAL_STEP_MEASURES | FORCE_PEAK_MEASURES
    branch_variables = make_labeled_variables(
        {
            measure_name: quantity_table[measure_name]
            for measure_name in measures
            if measure_name in quantity_table and measure_name not in MEASURES_OUTSIDE_BRANCHES
        },
        "point",
    )
    branch_variables["section_state"] = xr.Variable(
        ("point", "component"),
        quantity_table["section_state"],
        {"long_name": "section state just before touchdown"},
    )
    branch_variables["closure"] = xr.Variable(
        "point",
        quantity_table["closure"],
        {"units": "1", "long_name": "miss of the section state after one event-driven period"},
    )
    component_names = ["theta", "dtheta", "dL1"]
    if quantity_table["section_state"].shape[-1] != len(component_names):
        leg_names = [
            f"{quantity_name}{leg_number}"
            for quantity_name in ("L", "dL", "code")
            for leg_number in range(1, params.n_legs + 1)
        ]
        component_names = ["theta", "dtheta", "vx", "vz", *leg_names]
    branch_coordinates = {
        parameter_name: xr.Variable(
            "point",
            points.p,
            describe_parameter(
                parameter_name, model.parameter_domains[parameter_name]
            ).variable_attributes,
        ),
        "component": component_names,
        "leg": make_locked_leg_coordinate(params.n_legs),
    }
    branch_dataset = xr.Dataset(
        branch_variables | _make_stability_variables(points.return_map_jacobian),
        branch_coordinates,
        branch_attrs,
    )
    return Branch(parameter_name, branch_dataset, special_points, end_reasons, Outcome.STEPPED)


def _make_stability_variables(return_map_jacobians: np.ndarray) -> dict[str, xr.Variable]:
    """Build labeled variables with the multipliers and the stability measures at each point of a
    branch.
    """
    multipliers = compute_multipliers(return_map_jacobians)
    spectral_radius = np.max(np.abs(multipliers), -1)
    multiplier_parts = (
        ("multiplier_real", multipliers.real, "real part of a multiplier"),
        ("multiplier_imag", multipliers.imag, "imaginary part"),
    )
    multiplier_variables = {
        variable_name: xr.Variable(
            ("point", "multiplier"), multiplier_part, {"units": "1", "long_name": long_name}
        )
        for variable_name, multiplier_part, long_name in multiplier_parts
    }
    return multiplier_variables | make_labeled_variables(
        {"spectral_radius": spectral_radius, "spectral_margin": 1.0 - spectral_radius}, "point"
    )


MAX_START_DISTANCE_FACTOR = 10.0
"""Largest distance of a regular start from a singular start, as a multiple of the first
continuation step. The value is chosen because branches may cross at small angles.
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
class MapContinuation(AbstractContinuation):
    """Continuation of the fixed points of any map. All finite fixed points are admissible.

    - `state_units`: units of the components of the state in which points are stored.
    """

    state_units: Any = 1.0

    @property
    def parameter_unit(self) -> float:
        return float(np.ptp(self.parameter_bounds))

    def make_fixed_point(self, point: ContinuationPoint) -> FixedPoint:
        section_state, p, jacobian = super().make_fixed_point(point)
        units = np.broadcast_to(self.state_units, section_state.shape)
        return FixedPoint(units * section_state, p, units[:, None] * jacobian / units)

    def evaluate_point_quantities(self, wheels: Any, points: ContinuationPoint) -> QuantitiesByName:
        return {"x": self.state_units * self.continuation_problem.section_state(points.z)}

    def continue_in_both_directions(
        self, z: np.ndarray, p: np.ndarray, is_requested: np.ndarray
    ) -> dict[int, list[Track]]:
        """Continue the branch of one map in both directions.

        If the equations are singular at the start, the branch starts at a fixed point next to it.
        """
        tracks = super().continue_in_both_directions(z, p, is_requested)
        points = tracks[0][0].points
        if points and are_equations_regular(points[0].return_map_jacobian):
            return tracks
        start = self._find_regular_start(z, p)
        if start is None:
            return {}
        return super().continue_in_both_directions(start.z[None], np.array([start.p]), is_requested)

    def _find_regular_start(self, z: np.ndarray, p: np.ndarray) -> ContinuationPoint | None:
        """Find a fixed point next to a start at which the equations are singular.

        Each search is in a plane whose distance from the start is about that of the first
        continuation step. A branch that turns at the start does not cross all planes. Return None
        if no plane contains a fixed point near the start.
        """
        problem, distance = self.continuation_problem, self.arclength_options.initial_ds
        jacobian = np.asarray(problem.linearize(self.wheels, z, p).return_map_jacobian)[0]
        singular_direction = np.linalg.svd(np.eye(z.shape[-1]) - np.nan_to_num(jacobian))[2][-1]
        tasks = []
        # Along one branch through a crossing, the state may be constant.
        for state_part, parameter_part in itertools.product((0.0, 0.5, -0.5), (1.0, -1.0)):
            normal = distance * self.driver.coordinates(
                state_part * singular_direction, parameter_part
            )
            start = self.driver.coordinates(z[0], self.driver.compute_fraction(p[0])) + normal
            tasks.append(
                self.driver.solve_on_plane(self.wheels, start[:-1], start[-1], (start, normal))
            )
        lower_bound, upper_bound = self.parameter_bounds
        for point, is_found in run_together(problem, self.wheels, [0] * len(tasks), tasks):
            if (
                is_found
                and np.abs(point.z - z[0]).max() <= MAX_START_DISTANCE_FACTOR * distance
                and lower_bound <= point.p <= upper_bound
                and are_equations_regular(point.return_map_jacobian)
            ):
                return point
        return None


@announce_wait("the map and its derivatives", "10 s")
def continue_map(
    function: Callable[[Any, Array, Array], Array],
    x: object,
    p: float,
    bounds: tuple[float, float],
    *,
    constants: Any = (),
    name: str = "parameter",
    units: Any = None,
    options: ArclengthOptions | None = None,
) -> Branch:
    """Continue the branch of fixed points through (x, p) for a map x -> `function(constants, x,
    p)`.

    The map must be differentiable in forward mode, and return NaN where it is undefined.
    Bifurcations are located as in `continue_branch`, to 1e-9 of the range between the bounds. The
    start may be a fold or a crossing of branches.

    Args:
        function: `function(constants, x, p)`, which returns an array of the shape of `x`.
        x: a fixed point or a state near one, shape (n,).
        p: value of the parameter at `x`.
        bounds: lower and upper bound of the parameter.
        constants: any pytree, passed to the function.
        name: name of the parameter in the result.
        units: units of the components of `x`, a number or shape (n,), in which continuation steps
            are measured. By default, the unit of a component is its size at the start, or the size
            of its change within the bounds if it is larger.
        options: `ArclengthOptions` of the branch.

    Returns:
        A `Branch`: the fixed points, their stability, the special points, and why the branch ends.

    Raises:
        TypeError, ValueError: if an argument is invalid; the message names the remedy.

    Examples:
        >>> logistic = lambda _, x, r: r * x * (1.0 - x)
        >>> branch = vrw.continue_map(logistic, [0.6], 2.5, (2.0, 3.5))
        >>> [(point.kind, round(point.value, 6)) for point in branch.special_points]
        [('period_doubling', 3.0)]
    """
    check_callable("function", function, "of constants, x and p")
    require_untraced_arguments("vrw.continue_map", "use vrw.solve_fixed_point", x, p, constants)
    lower_bound, upper_bound = check_range("bounds", bounds)
    if not lower_bound <= check_real("p", p) <= upper_bound:
        raise ValueError(
            f"p is {p:g}, but the branch must start within its bounds: give one in "
            f"[{lower_bound:g}, {upper_bound:g}]."
        )
    options, x = _check_arclength_options(options), check_reals("x", x)
    require_no_masked_entries("constants", jax.tree.leaves(constants))
    constants = jax.tree.map(lambda leaf: jnp.asarray(leaf, float), constants)
    check_vector_map(lambda x: function(constants, x, jnp.asarray(p, float)), "x", x)
    state_units = (
        estimate_state_units(function, constants, np.asarray(x), p, (lower_bound, upper_bound))
        if units is None
        else np.asarray(check_state_units(units, x))
    )
    units = tuple(np.broadcast_to(state_units, x.shape).tolist())
    continuation = MapContinuation(
        MapProblem(function, units),
        options,
        jax.tree.map(lambda leaf: np.asarray(leaf)[None], constants),
        np.array([lower_bound, upper_bound]),
        np.array(units),
    )
    (branch_data,) = continue_and_locate_special_points(
        continuation, np.asarray(x / state_units)[None], np.array([p], float), np.array([True])
    )
    if branch_data is None:
        empty_dataset = xr.Dataset(coords={name: ("point", np.zeros(0))})
        start_jacobian = jax.jacfwd(function, 1)(constants, x, jnp.asarray(p, float))
        is_singular = has_unit_multiplier(np.asarray(start_jacobian))
        reasons = (UNIT_MULTIPLIER_ADVICE if is_singular else "",) * 2
        return Branch(name, empty_dataset, (), reasons, Outcome.NO_CYCLE_FOUND)
    dataset = xr.Dataset(
        {"x": (("point", "component"), branch_data.quantities["x"])}
        | _make_stability_variables(branch_data.points.return_map_jacobian),
        {name: ("point", branch_data.points.p)},
        {"title": f"Branch of fixed points along {name}"},
    )
    return Branch(
        name, dataset, branch_data.special_points, branch_data.end_reasons, Outcome.STEPPED
    )
