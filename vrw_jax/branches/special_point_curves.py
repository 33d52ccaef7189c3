"""Continue special points of gaits as curves in two parameters, and map all of them.

A map is checked against a scan. If a quantity has opposite signs at neighboring samples, a curve of
special points lies between the samples. A curve that is not traced yet is found on branches through
these samples.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vrw_jax.base.checks import check_names, check_range, check_type
from vrw_jax.base.lazy_xarray import xarray as xr
from vrw_jax.base.options import StepOptions
from vrw_jax.base.outcomes import Outcome
from vrw_jax.base.progress import announce_wait
from vrw_jax.base.walker import AbstractWalker, is_own_walker
from vrw_jax.branches.abstract_continuation import COARSE_MESH_END_NAME
from vrw_jax.branches.arclength import ArclengthOptions
from vrw_jax.branches.branch import SpecialPointCurve
from vrw_jax.branches.continuation import BRANCH_ENDING_QUANTITIES, SECOND_PEAK_RATE_NAME
from vrw_jax.branches.curve_problems import (
    DLS_VANISHING_NAME,
    FORCE_QUANTITY_NAMES,
    LINEAR_MARGIN_SUBSTITUTES,
)
from vrw_jax.branches.curve_tracing import (
    CurveSeed,
    CurveTracer,
    TracedCurve,
    compute_distances_to_polyline,
)
from vrw_jax.branches.map_branch import MarginFunctions
from vrw_jax.branches.test_functions import BIFURCATIONS
from vrw_jax.branches.walker_curves import DEFAULT_CURVE_OPTIONS, continue_walker_special_point
from vrw_jax.gaits.limit_cycle_result import LimitCycle
from vrw_jax.gaits.walker_finder import HybridGait
from vrw_jax.lanes.batching import select_tree_rows
from vrw_jax.lanes.settings import with_default_jax_settings
from vrw_jax.models.measures import MARGIN_MEASURES
from vrw_jax.models.viscoelastic import ViscoelasticWheel
from vrw_jax.wheel.params import PARAMETER_NAMES, WheelParams, check_parameter_name

ParameterBounds = Mapping[str, tuple[float, float]]

DEFAULT_PARAMETER_BOUNDS: ParameterBounds = {
    "damping": (1.0, 250.0),
    "stiffness": (200.0, 1200.0),
    "natural_length": (1.001, 1.06),
    "slope": (0.05, 0.5),
}
"""Default bounds of the two parameters of a curve, for wheels with legs of 1 m."""


@announce_wait("gaits and the second derivatives of the special point", "90 s")
def continue_special_point(
    name: str,
    parameters: tuple[str, str],
    cycle: LimitCycle | HybridGait,
    *,
    bounds: ParameterBounds | None = None,
    options: ArclengthOptions | None = None,
    step_options: StepOptions | None = None,
    model: AbstractWalker | None = None,
    params: Any = None,
    margins: MarginFunctions | None = None,
) -> SpecialPointCurve:
    """Continue the special point `name` as a curve in two parameters, near a gait of one gait step.

    `name` is the name of a `SpecialPoint`. It may be an indicator, the duration of a phase, a
    margin (of a locked leg as "locked_stopper_force[5]"), or "second_peak_rate" of the force. It
    may also be "fold", "period_doubling" or "neimark_sacker". The search for the special point
    starts from the gait and varies the first parameter, then the second parameter. The curve is
    continued through turning points, within `bounds` of the two parameters. The default bounds are
    `branches.special_point_curves.DEFAULT_PARAMETER_BOUNDS`. The curve ends when it closes or
    leaves the bounds, or when the gaits end. Each point is accurate to 1e-9. `codim2_points` are
    the points at which other special points occur. On the curve of an indicator, the other special
    points are indicators and bifurcations. On all other curves, they also include margins.

    For a walker of yours, give `model`, its `params`, and `bounds` of both parameters. `name` is
    that of a bifurcation or of one of the `margins`. A margin must be defined on both sides of the
    curve: if an orbit touches a guard there, leave the guard out of the walker.

    Args:
        name: name of the special point.
        parameters: names of the two parameters.
        cycle: the gait near which the search starts.
        bounds: bounds of the parameters, by name.
        options: `ArclengthOptions` of the curve.
        step_options: options of the event-driven steps that evaluate margins.
        model: a walker of yours.
        params: the parameters of this walker, which `cycle` has.
        margins: functions of state and parameters by name, as in `continue_branch`.

    Returns:
        A `SpecialPointCurve`: the points of the curve in two parameters, and why it ends.

    Raises:
        TypeError, ValueError: if an argument is invalid, or if the special point does not occur on
            the branches.

    Examples:
        >>> cycle = vrw.limit_cycle(vrw.WheelParams(damping=150.0))
        >>> curve = vrw.continue_special_point("clearance_sls1", ("damping", "stiffness"), cycle)
        >>> [point.name for point in curve.codim2_points[-3:-1]]
        ['fold', 'hit_planted_impulse']
    """
    if is_own_walker(model):
        return continue_walker_special_point(
            model, params, name, parameters, bounds, cycle, options, step_options, margins
        )
    if any(argument is not None for argument in (model, params, margins)):
        raise ValueError(
            "model, params and margins are for a walker of yours, but the cycle of a wheel "
            "contains its model and parameters: leave them out."
        )
    (curve,) = continue_special_points(
        (name,), parameters, cycle, bounds=bounds, options=options, step_options=step_options
    )
    return curve


def _check_parameter_plane(
    parameters: Any, bounds: Any, known_names: Sequence[str] = PARAMETER_NAMES
) -> tuple[tuple[str, str], np.ndarray]:
    """Check the names and bounds of two parameters.

    Return the names, and the bounds as an array of shape (2, 2). Raise TypeError or ValueError if
    names or bounds are invalid.
    """
    check_type("bounds", bounds, (Mapping, type(None)), "write {'damping': (100.0, 200.0)}")
    bounds_by_parameter = {**DEFAULT_PARAMETER_BOUNDS, **(bounds or {})}
    parameter_names = check_names("parameters", parameters)
    for parameter_name, bounds_of_parameter in bounds_by_parameter.items():
        check_parameter_name(parameter_name, known_names, "parameter that has bounds")
        bounds_by_parameter[parameter_name] = check_range(
            f"bounds[{parameter_name!r}]", bounds_of_parameter
        )
    for parameter_name in parameter_names:
        check_parameter_name(parameter_name, tuple(bounds_by_parameter), "parameter with bounds")
    if len(parameter_names) != 2 or len(set(parameter_names)) != 2:
        raise ValueError(
            f"parameters are {parameter_names}, but a curve needs two different ones: write "
            "('damping', 'slope')."
        )
    return (parameter_names[0], parameter_names[1]), np.array(
        [bounds_by_parameter[parameter_name] for parameter_name in parameter_names], float
    )


@with_default_jax_settings
def continue_special_points(
    names: tuple[str, ...],
    parameters: tuple[str, str],
    cycle: Any,
    *,
    bounds: ParameterBounds | None = None,
    options: ArclengthOptions | None = None,
    step_options: StepOptions | None = None,
) -> tuple[SpecialPointCurve, ...]:
    """Continue several special points as curves in two parameters, as
    `continue_special_point` does.
    """
    known_names = cycle.model.parameter_names if isinstance(cycle, LimitCycle) else PARAMETER_NAMES
    parameters, parameter_ranges = _check_parameter_plane(parameters, bounds, known_names)
    first_parameter_name, second_parameter_name = parameters
    check_type(
        "cycle",
        cycle,
        LimitCycle,
        "give vrw.limit_cycle(params), or model= and params= of a walker of yours",
    )
    if cycle.period_n != 1:
        raise ValueError(
            f"the gait has {cycle.period_n} steps, but a curve needs a gait of one step: give one."
        )
    options = DEFAULT_CURVE_OPTIONS if options is None else options
    step_options = StepOptions.tight() if step_options is None else step_options
    check_type("options", options, ArclengthOptions, "give vrw.ArclengthOptions()")
    check_type("step_options", step_options, StepOptions, "give vrw.StepOptions()")
    curve_tracer = CurveTracer(
        parameters,
        parameter_ranges,
        cycle.model,
        options,
        step_options,
        measures_force_peaks=not set(names).isdisjoint(FORCE_QUANTITY_NAMES),
    )
    params = cycle.system.make_wheel(cycle.parameters)
    seeds_by_name: dict[str, CurveSeed] = {}
    for parameter_index, parameter_name in enumerate(parameters):
        if set(names) - set(seeds_by_name):
            curve_seeds = curve_tracer.find_seeds(
                parameter_index, *select_tree_rows((params, cycle), None)
            )
            start_value = float(cycle.model.get_parameter(params, parameter_name))
            compute_distance = lambda seed, index=parameter_index, start_value=start_value: abs(
                seed.parameter_values[index] - start_value
            )
            # The nearest seed of each name comes last and replaces the others.
            seeds_by_name = {
                curve_seed.special_point_name: curve_seed
                for curve_seed in sorted(curve_seeds, key=compute_distance, reverse=True)
            } | seeds_by_name
    missing_special_point_names = sorted(set(names) - set(seeds_by_name))
    if missing_special_point_names:
        raise ValueError(
            f"no special point {missing_special_point_names[0]!r} on branches along "
            f"{first_parameter_name} and {second_parameter_name} within their bounds (found: "
            f"{', '.join(sorted(seeds_by_name)) or 'none'}): give a gait nearer to it, or wider "
            "bounds."
        )
    curves_by_name = {
        traced_curve.special_point_curve.name: traced_curve.special_point_curve
        for traced_curve in curve_tracer.trace_curves(
            [seeds_by_name[special_point_name] for special_point_name in names], ()
        )
    }
    untraced_special_point_names = sorted(set(names) - set(curves_by_name))
    if untraced_special_point_names:
        raise ValueError(
            f"special point {untraced_special_point_names[0]} at "
            f"{seeds_by_name[untraced_special_point_names[0]].parameter_values[0]:.9g} can't be "
            "continued: give a gait nearer to the special point."
        )
    return tuple(curves_by_name[special_point_name] for special_point_name in names)


GAIT_CHANGE_NAME = "gait"
"""Name of the change between a sample with a gait and a sample without a gait."""

STABILITY_CHANGE_NAME = "spectral_radius"
"""Name of the change between a stable and an unstable gait."""

SPECIAL_POINT_MEASURES = ("lambda_4_plus", STABILITY_CHANGE_NAME)
"""Names of the measures of a scan that vanish or cross 1 at special points, in addition to the
margins.
"""

EXPLAINING_CURVE_NAMES: Mapping[str, tuple[str, ...]] = {
    GAIT_CHANGE_NAME: (*BRANCH_ENDING_QUANTITIES, *BIFURCATIONS),
    STABILITY_CHANGE_NAME: tuple(BIFURCATIONS),
    "lambda_4_plus": ("lambda_4_plus", DLS_VANISHING_NAME),
    **{
        substitute_name: (margin_name,)
        for margin_name, substitute_name in LINEAR_MARGIN_SUBSTITUTES.items()
    },
}
"""Names of the curves that explain a sign change, by the name of the quantity.

By default the curve with the name of the quantity explains the change.
"""


# Smallest distance between examined sign changes, in cells of the scan.
MIN_DISTANCE_TO_EXAMINED = 5.0


class ScanSignChange(NamedTuple):
    """Sign change of a quantity between two neighboring samples of a scan."""

    quantity_name: str
    parameter_index: int
    sample_indices: tuple[int, int]  # indices of the first sample, which has a gait
    scan_position_in_cells: tuple[float, float]  # position of the change in each parameter

    def is_near(self, other: "ScanSignChange") -> bool:
        """Return whether another sign change is one of the same quantity and near this one."""
        return (
            self.quantity_name == other.quantity_name
            and self.parameter_index == other.parameter_index
            and math.dist(self.scan_position_in_cells, other.scan_position_in_cells)
            <= MIN_DISTANCE_TO_EXAMINED
        )


# Number of parallel branches in each parameter, from which the map starts.
N_PARALLEL_BRANCHES = 5
# Largest number of rounds in which sign changes are examined.
MAX_SEARCH_ROUNDS = 8


@with_default_jax_settings
def trace_special_points(
    scan_dataset: xr.Dataset,
    params: WheelParams,
    model: ViscoelasticWheel,
    on_stage: Callable[[str], None] | None,
) -> tuple[tuple[SpecialPointCurve, ...], tuple[ScanSignChange, ...]]:
    """Trace the curves of special points in the two parameters of a scan.

    Return the curves, and the sign changes that no curve explains. The scan contains
    `SPECIAL_POINT_MEASURES` and margins. If it contains "second_peak_rate", the curves on which a
    second force peak appears are also traced. A sign change between two samples is unexplained if
    no curve is near it. `on_stage` is called with a description of each stage.
    """
    parameter_names = tuple(map(str, scan_dataset.outcome.dims))
    parameter_ranges = np.array(
        [scan_dataset[parameter_name].values[[0, -1]] for parameter_name in parameter_names], float
    )
    curve_tracer = CurveTracer(
        (parameter_names[0], parameter_names[1]),
        parameter_ranges,
        model,
        DEFAULT_CURVE_OPTIONS,
        StepOptions.tight(),
        on_stage,
        measures_force_peaks=SECOND_PEAK_RATE_NAME in scan_dataset,
    )
    curve_seeds = find_seeds_on_parallel_lines(curve_tracer, params)
    traced_curves = _trace_curves_and_meetings(curve_tracer, curve_seeds, [])
    sign_changes = find_sign_changes_in_scan(scan_dataset, curve_tracer.parameter_names)
    examined_sign_changes: list[ScanSignChange] = []
    find_remaining_sign_changes = lambda: find_unexplained_sign_changes(
        sign_changes,
        [traced_curve.special_point_curve for traced_curve in traced_curves],
        scan_dataset,
    )
    for _ in range(MAX_SEARCH_ROUNDS):
        new_sign_changes: list[ScanSignChange] = []
        for sign_change in find_remaining_sign_changes():
            if not any(map(sign_change.is_near, (*examined_sign_changes, *new_sign_changes))):
                new_sign_changes.append(sign_change)
        if not new_sign_changes:
            break
        examined_sign_changes += new_sign_changes
        curve_seeds = []
        for parameter_index in range(2):
            wheels_beside_sign_change = [
                curve_tracer.with_parameters(
                    params,
                    [
                        float(scan_dataset[parameter_name][sample_index])
                        for parameter_name, sample_index in zip(
                            curve_tracer.parameter_names, sign_change.sample_indices, strict=True
                        )
                    ],
                )
                for sign_change in new_sign_changes
                if sign_change.parameter_index == parameter_index
            ]
            curve_seeds += _find_seeds_in_batches(
                curve_tracer,
                parameter_index,
                wheels_beside_sign_change,
            )
        traced_curves = _trace_curves_and_meetings(curve_tracer, curve_seeds, traced_curves)
    return tuple(traced_curve.special_point_curve for traced_curve in traced_curves), tuple(
        find_remaining_sign_changes()
    )


# Number of rounds in which special points on new curves are continued.
N_MEETING_ROUNDS = 3


def _trace_curves_and_meetings(
    curve_tracer: CurveTracer,
    curve_seeds: list[CurveSeed],
    traced_curves: list[TracedCurve],
) -> list[TracedCurve]:
    """Trace the curves through the seeds, and the curves through special points on new curves.

    Return these curves together with the known curves.
    """
    for _ in range(N_MEETING_ROUNDS):
        new_curves = curve_tracer.trace_curves(curve_seeds, traced_curves)
        known_curves = [
            traced_curve for traced_curve in traced_curves if not traced_curve.is_on_any(new_curves)
        ]
        traced_curves = [*known_curves, *new_curves]
        curve_seeds = [
            curve_seed for traced_curve in new_curves for curve_seed in traced_curve.meeting_seeds
        ]
    return traced_curves


def find_seeds_on_parallel_lines(
    curve_tracer: CurveTracer,
    params: WheelParams,
) -> list[CurveSeed]:
    """Find seeds on parallel branches in each of the two parameters.

    A branch in one parameter starts at the middle of that parameter's range. The branches differ by
    evenly spaced values of the other parameter.
    """
    curve_seeds = []
    for parameter_index in range(2):
        lower_bound, upper_bound = curve_tracer.parameter_ranges[1 - parameter_index]
        line_parameter_values = lower_bound + (
            np.arange(N_PARALLEL_BRANCHES) + 0.5
        ) / N_PARALLEL_BRANCHES * (upper_bound - lower_bound)
        start_values = np.empty((N_PARALLEL_BRANCHES, 2))
        start_values[:, parameter_index] = curve_tracer.parameter_ranges[parameter_index].mean()
        start_values[:, 1 - parameter_index] = line_parameter_values
        wheels_on_line = [
            curve_tracer.with_parameters(params, start_values_on_line)
            for start_values_on_line in start_values
        ]
        curve_seeds += _find_seeds_in_batches(curve_tracer, parameter_index, wheels_on_line)
    return curve_seeds


def _find_seeds_in_batches(
    curve_tracer: CurveTracer, parameter_index: int, wheels: list[WheelParams]
) -> list[CurveSeed]:
    """Find seeds on the wheels' branches, which are continued in batches of the same size.

    A single size needs only one compiled program.
    """
    curve_seeds = []
    for first_wheel_index in range(0, len(wheels), N_PARALLEL_BRANCHES):
        wheels_of_batch = wheels[first_wheel_index : first_wheel_index + N_PARALLEL_BRANCHES]
        padded_wheels = [
            *wheels_of_batch,
            *wheels_of_batch[-1:] * (N_PARALLEL_BRANCHES - len(wheels_of_batch)),
        ]
        curve_seeds += curve_tracer.find_seeds(
            parameter_index, jax.tree.map(lambda *x: jnp.stack(x), *padded_wheels)
        )
    return curve_seeds


def find_sign_changes_in_scan(
    scan_dataset: xr.Dataset, parameter_names: tuple[str, str]
) -> list[ScanSignChange]:
    """Return the sign changes of all quantities between neighboring samples.

    A sign change of a measure is ignored if exactly one of the two samples has double support.
    """
    scan_dataset = scan_dataset.transpose(*parameter_names, ...)
    has_gait_at_sample = scan_dataset.outcome.values == Outcome.STEPPED
    has_coarse_mesh_at_sample = scan_dataset.outcome.values == Outcome.MESH_TOO_COARSE
    signed_quantities = {STABILITY_CHANGE_NAME: 1.0 - scan_dataset[STABILITY_CHANGE_NAME].values}
    margin_names = [name for name in MARGIN_MEASURES if name not in LINEAR_MARGIN_SUBSTITUTES]
    peak_names = [SECOND_PEAK_RATE_NAME] if SECOND_PEAK_RATE_NAME in scan_dataset else []
    for measure_name in ("lambda_4_plus", *peak_names, *margin_names):
        measure = scan_dataset[measure_name]
        if "leg" in measure.dims:
            signed_quantities |= {
                f"{measure_name}[{leg_number}]": measure.values[..., i]
                for i, leg_number in enumerate(scan_dataset.leg.values)
            }
        else:
            signed_quantities[measure_name] = measure.values
    signed_quantities[GAIT_CHANGE_NAME] = np.where(
        has_gait_at_sample, 1.0, np.where(has_coarse_mesh_at_sample, np.nan, -1.0)
    )
    signed_quantities[COARSE_MESH_END_NAME] = np.where(
        has_gait_at_sample, 1.0, np.where(has_coarse_mesh_at_sample, -1.0, np.nan)
    )
    sign_changes = []
    for parameter_index in range(2):
        get_neighbor_values = lambda x, parameter_index=parameter_index: (
            np.moveaxis(x, parameter_index, 0)[:-1],
            np.moveaxis(x, parameter_index, 0)[1:],
        )
        has_first_sample_gait, has_second_sample_gait = get_neighbor_values(has_gait_at_sample)
        has_same_double_support = np.equal(
            *get_neighbor_values(signed_quantities["lambda_4_plus"] > 0.0)
        )
        for quantity_name, quantity_values in signed_quantities.items():
            first_sample_values, second_sample_values = get_neighbor_values(quantity_values)
            has_sign_change = first_sample_values * second_sample_values < 0.0
            if quantity_name not in (GAIT_CHANGE_NAME, COARSE_MESH_END_NAME):
                has_sign_change &= (
                    has_first_sample_gait
                    & has_second_sample_gait
                    & (has_same_double_support | (quantity_name == "lambda_4_plus"))
                )
            for i, j in np.argwhere(has_sign_change).tolist():
                sign_change_fraction = first_sample_values[i, j] / (
                    first_sample_values[i, j] - second_sample_values[i, j]
                )
                sample_indices = (i if has_first_sample_gait[i, j] else i + 1), j
                position_in_cells = float(i + sign_change_fraction), float(j)
                if parameter_index == 1:  # The first index is that of the second parameter.
                    sample_indices = sample_indices[::-1]
                    position_in_cells = position_in_cells[::-1]
                sign_changes.append(
                    ScanSignChange(
                        quantity_name, parameter_index, sample_indices, position_in_cells
                    )
                )
    return sign_changes


# Largest distance of a sign change from a curve that explains it, in cells of the scan.
MAX_DISTANCE_TO_EXPLAINING_CURVE = 1.0


def find_unexplained_sign_changes(
    sign_changes: Sequence[ScanSignChange],
    special_point_curves: Sequence[SpecialPointCurve],
    scan_dataset: xr.Dataset,
) -> list[ScanSignChange]:
    """Return the sign changes that are not near any curve that explains them."""
    unexplained_sign_changes = []
    for quantity_name in sorted({sign_change.quantity_name for sign_change in sign_changes}):
        sign_changes_of_quantity = [
            sign_change
            for sign_change in sign_changes
            if sign_change.quantity_name == quantity_name
        ]
        explaining_names = EXPLAINING_CURVE_NAMES.get(quantity_name, (quantity_name,))
        sign_change_positions = np.array(
            [sign_change.scan_position_in_cells for sign_change in sign_changes_of_quantity]
        )
        curve_distances = np.full(len(sign_changes_of_quantity), np.inf)
        for special_point_curve in special_point_curves:
            if special_point_curve.name not in explaining_names:
                continue
            curve_positions = [
                np.interp(
                    special_point_curve.dataset[parameter_name].values,
                    scan_dataset[parameter_name].values,
                    np.arange(scan_dataset.sizes[parameter_name]),
                )
                for parameter_name in special_point_curve.parameters
            ]
            curve_distances = np.minimum(
                curve_distances,
                compute_distances_to_polyline(sign_change_positions, np.stack(curve_positions, -1)),
            )
        unexplained_sign_changes += [
            sign_change
            for sign_change, curve_distance in zip(
                sign_changes_of_quantity, curve_distances, strict=True
            )
            if curve_distance > MAX_DISTANCE_TO_EXPLAINING_CURVE
        ]
    return unexplained_sign_changes
