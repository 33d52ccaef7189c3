"""Continue special points of gaits as curves in two parameters, and map all of them.

A map is checked against a scan. If a quantity has opposite signs at neighboring samples, a curve of
special points lies between the samples. A curve that is not traced yet is found on branches through
these samples.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from vrw_jax.base.checks import (
    check_names,
    check_range,
    check_type,
    require_known_name,
    require_untraced_arguments,
)
from vrw_jax.base.options import StepOptions, find_tree_parameter
from vrw_jax.base.progress import announce_wait
from vrw_jax.base.results import Outcome
from vrw_jax.base.results import xarray as xr
from vrw_jax.base.walker import AbstractWalker, is_own_walker
from vrw_jax.branches.arclength import ArclengthOptions
from vrw_jax.branches.branch import BIFURCATIONS, Codim2Point, SpecialPointCurve
from vrw_jax.branches.branch_continuation import COARSE_MESH_END_NAME, Continuation
from vrw_jax.branches.branch_location import continue_and_locate_special_points
from vrw_jax.branches.continuation_problems import (
    BRANCH_ENDING_QUANTITIES,
    LINEAR_MARGIN_SUBSTITUTES,
    SECOND_PEAK_RATE_NAME,
    split_legs,
)
from vrw_jax.branches.curve_problems import (
    DLS_VANISHING_NAME,
    FORCE_QUANTITY_NAMES,
    RANGE_EDGE,
    CurveWheel,
    GaitCurveProblem,
)
from vrw_jax.branches.curve_tracing import (
    CurveSeed,
    CurveTracer,
    TracedCurve,
    compute_distances_to_polyline,
)
from vrw_jax.branches.map_branch import (
    MarginFunctions,
    check_arclength_options,
    make_stability_variables,
    make_walker_problem,
    trace_fixed_points,
)
from vrw_jax.gaits.fixed_points import estimate_state_units
from vrw_jax.gaits.limit_cycle_result import LimitCycle
from vrw_jax.gaits.walker_finder import HybridGait
from vrw_jax.lanes.batching import select_tree_rows
from vrw_jax.lanes.environment import with_default_jax_settings
from vrw_jax.models.measures import MARGIN_MEASURES
from vrw_jax.models.viscoelastic import ViscoelasticWheel
from vrw_jax.wheel.params import PARAMETER_NAMES, WheelParams, check_parameter_name

DEFAULT_CURVE_OPTIONS = ArclengthOptions(initial_ds=5e-4)
"""Default continuation options of curves. The first continuation step is short because some curves
are short.
"""


def continue_walker_special_point(
    walker: AbstractWalker,
    params: Any,
    name: str,
    parameters: Any,
    bounds: Any,
    gait: Any,
    options: ArclengthOptions | None,
    step_options: StepOptions | None,
    margins: MarginFunctions | None,
) -> SpecialPointCurve:
    """Return the curve of `continue_special_point` for a walker of the user."""
    check_type("cycle", gait, HybridGait, "give vrw.limit_cycle(params, model=)")
    require_untraced_arguments(
        "vrw.continue_special_point", "differentiate vrw.limit_cycle", params, gait
    )
    require_known_name(name, (*BIFURCATIONS, *(margins or {})), "special point or margin")
    if np.any(np.asarray(gait.outcome) != Outcome.STEPPED):
        raise ValueError(f"a curve begins at a gait, but {gait.why}: give another gait.")
    find_leaf = functools.partial(find_tree_parameter, params)
    names, limits, options, step_options = check_curve_arguments(
        parameters, bounds, find_leaf, {}, options, step_options
    )
    period_n = int(gait.period_n)
    gaits, wheel = make_walker_problem(walker, params, names, gait, period_n, step_options, margins)
    values = wheel.values[..., gaits.parameter_indices].copy()
    for parameter_name, value, (lower, upper) in zip(names, values, limits, strict=True):
        if not lower <= value <= upper:
            raise ValueError(
                f"{parameter_name} is {value}, but the curve is traced from a gait with one value "
                f"within the bounds: give one in [{lower:g}, {upper:g}]."
            )
    along = [dataclasses.replace(gaits, continued_names=(name,)) for name in names]
    find_on_branch = lambda i: [
        (point.name, point.value, (i, point))
        for point in trace_fixed_points(
            along[i], gait.section_state, values[i], limits[i], wheel, names[i], None, None
        ).special_points
    ]
    i, start = find_nearest_points((name,), names, values, find_on_branch)[name]
    values[i] = start.value
    wheel, x = wheel._replace(values=gaits.replace_parameters(wheel, values)), start.point[0]
    units = estimate_state_units(along[0].function, wheel, x, values[0], limits[0])
    gaits = dataclasses.replace(gaits, units=tuple(units.tolist()))
    group = tuple(BIFURCATIONS) if name in BIFURCATIONS else (name,)
    problem = GaitCurveProblem(
        second_bounds=limits[1], gaits=gaits, quantity_names=group, special_point_names=(name,),
        first_range=float(np.ptp(limits[0])),
    )  # fmt: skip
    fraction = (values[1] - limits[1][0]) / np.ptp(limits[1])
    curve_wheel = CurveWheel(wheel, np.asarray(group.index(name)))
    (data,) = continue_and_locate_special_points(
        Continuation(problem, options, np.array(limits[0]), select_tree_rows(curve_wheel, None)),
        np.append(fraction, x / units)[None],
        values[:1],
        np.array([True]),
    )
    if data is None:
        raise ValueError(UNTRACED_CURVE_TEXT.format(name, start.value))
    variables, coordinates = gaits.label(data.quantities)
    points = dict(zip(names, (np.asarray(data.points.p), data.quantities["second"]), strict=True))
    dataset = xr.Dataset(
        variables | make_stability_variables(data.points.return_map_jacobian[:, :-1, :-1]),
        {key: ("point", x, gaits.describe_parameter(key)) for key, x in points.items()}
        | coordinates,
        {"title": f"Curve of {name} over {names[0]} and {names[1]}"},
    )
    codim2_points = tuple(
        Codim2Point(
            point.name,
            (point.value, float(problem.compute_second_parameter(point.cycle.z))),
            point.ends_branch,
        )
        for point in data.special_points
        if point.name != RANGE_EDGE
    )
    return SpecialPointCurve(name, names, dataset, codim2_points, data.end_reasons)


def check_curve_arguments(
    parameters: Any,
    bounds: Any,
    check_name: Callable[[str], object],
    default_bounds: Mapping[str, tuple[float, float]],
    options: ArclengthOptions | None,
    step_options: StepOptions | None,
) -> tuple[tuple[str, str], list[tuple[float, float]], ArclengthOptions, StepOptions]:
    """Return the names of two parameters, their bounds, and the options, or raise an error.

    - `check_name`: function that raises an error for the name of no parameter.
    """
    names = check_names("parameters", parameters)
    if len(set(names)) != 2 or len(names) != 2:
        raise ValueError(
            f"parameters are {names}, but a curve needs two different ones: write ('damping', "
            "'slope'), say."
        )
    check_type("bounds", bounds, (Mapping, type(None)), "write {'damping': (100.0, 200.0)}")
    limits = {**default_bounds, **(bounds or {})}
    for name in (*limits, *names):
        check_name(name)
        if name not in limits:
            raise ValueError(f"bounds has no {name!r}: give (lower, upper) of each parameter.")
        limits[name] = check_range(f"bounds[{name!r}]", limits[name])
    options = check_arclength_options(options, DEFAULT_CURVE_OPTIONS)
    step_options = StepOptions.tight() if step_options is None else step_options
    check_type("step_options", step_options, StepOptions, "give vrw.StepOptions()")
    first, second = names
    return (first, second), [limits[first], limits[second]], options, step_options


UNTRACED_CURVE_TEXT = (
    "special point {} at {:.9g} can't be continued: give a gait nearer to the special point."
)


def find_nearest_points(
    names: Sequence[str],
    parameters: tuple[str, str],
    start_values: Any,
    find_on_branch: Callable[[int], list],
) -> dict[str, Any]:
    """Return the special points nearest to a gait by name, or raise an error.

    They are on a branch in the first parameter, or else on one in the second.

    - `start_values`: values of both parameters at the gait;
    - `find_on_branch`: function of the index of a parameter that returns the name, the value of the
      parameter and data of each special point on the branch.
    """
    nearest: dict[str, Any] = {}
    for i, start_value in enumerate(start_values):
        if not nearest.keys() >= {*names}:
            # The nearest point of each name comes last and replaces the others.
            found = sorted(find_on_branch(i), key=lambda x: -abs(x[1] - start_value))
            nearest = {name: point for name, _, point in found} | nearest
    for name in sorted({*names} - nearest.keys()):
        raise ValueError(
            f"no special point {name!r} on branches along {' and '.join(parameters)} within their "
            f"bounds (found: {', '.join(sorted(nearest)) or 'none'}): give a gait nearer to it, or "
            "wider bounds."
        )
    return nearest


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
    leaves the bounds, or when the gaits end. Each point is accurate to 1e-9. The equations are
    singular at a fold, so that a curve of folds is that of gaits with det(1 - J) = 1e-6, where J is
    the Jacobian of the return map. `codim2_points` are the points at which other special points
    occur. On the curve of an indicator, the other special points are indicators and bifurcations.
    On all other curves, they also include margins.

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
        if params is None:
            raise ValueError(
                "a curve of a walker of yours needs its parameters: give params, which cycle has."
            )
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
    check_name = lambda name: check_parameter_name(name, known_names, "parameter")
    parameters, limits, options, step_options = check_curve_arguments(
        parameters, bounds, check_name, DEFAULT_PARAMETER_BOUNDS, options, step_options
    )
    check_type(
        "cycle",
        cycle,
        LimitCycle,
        "give vrw.limit_cycle(params), or model= and params= of a walker of yours",
    )
    if not np.all(cycle.found):
        raise ValueError(
            "the cycle was not found, but a curve begins at a gait: give a cycle that was found."
        )
    if cycle.period_n != 1:
        raise ValueError(
            f"the gait has {cycle.period_n} steps, but a curve needs a gait of one step: give one."
        )
    curve_tracer = CurveTracer(
        parameters,
        np.array(limits),
        cycle.model,
        options,
        step_options,
        measures_force_peaks=not set(names).isdisjoint(FORCE_QUANTITY_NAMES),
    )
    params = cycle.system.make_wheel(cycle.parameters)
    start_values = [float(cycle.model.get_parameter(params, x)) for x in parameters]
    batch = select_tree_rows((params, cycle), None)
    find_on_branch = lambda i: [
        (seed.special_point_name, seed.parameter_values[i], seed)
        for seed in curve_tracer.find_seeds(i, *batch)
    ]
    seeds = find_nearest_points(names, parameters, start_values, find_on_branch)
    traced = curve_tracer.trace_curves([seeds[name] for name in names], ())
    curves = {x.special_point_curve.name: x.special_point_curve for x in traced}
    for name in sorted(set(names) - set(curves)):
        raise ValueError(UNTRACED_CURVE_TEXT.format(name, seeds[name].parameter_values[0]))
    return tuple(curves[name] for name in names)


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
    first, second = map(str, scan_dataset.outcome.dims)
    axes = [scan_dataset[name].values.astype(float) for name in (first, second)]
    tracer = CurveTracer(
        (first, second),
        np.array([values[[0, -1]] for values in axes]),
        model,
        DEFAULT_CURVE_OPTIONS,
        StepOptions.tight(),
        on_stage or (lambda stage: None),
        measures_force_peaks=SECOND_PEAK_RATE_NAME in scan_dataset,
    )
    seeds = find_seeds_on_parallel_lines(tracer, params)
    traced = _trace_curves_and_meetings(tracer, seeds, [])
    sign_changes = find_sign_changes_in_scan(scan_dataset, (first, second))
    examined: list[ScanSignChange] = []
    find_remaining = lambda: find_unexplained_sign_changes(
        sign_changes, [curve.special_point_curve for curve in traced], scan_dataset
    )
    for _ in range(MAX_SEARCH_ROUNDS):
        n_examined, seeds = len(examined), []
        for change in find_remaining():
            if not any(map(change.is_near, examined)):
                examined.append(change)
        if len(examined) == n_examined:
            break
        for parameter_index in range(2):
            starts = [
                [values[i] for values, i in zip(axes, change.sample_indices, strict=True)]
                for change in examined[n_examined:]
                if change.parameter_index == parameter_index
            ]
            seeds += _find_seeds_in_batches(tracer, parameter_index, params, np.array(starts))
        traced = _trace_curves_and_meetings(tracer, seeds, traced)
    return tuple(curve.special_point_curve for curve in traced), tuple(find_remaining())


# Number of rounds in which special points on new curves are continued.
N_MEETING_ROUNDS = 3


def _trace_curves_and_meetings(
    tracer: CurveTracer, seeds: list[CurveSeed], traced: list[TracedCurve]
) -> list[TracedCurve]:
    """Trace the curves through the seeds, and the curves through special points on new curves.

    Return these curves together with the known curves.
    """
    for _ in range(N_MEETING_ROUNDS):
        new = tracer.trace_curves(seeds, traced)
        traced = [*(curve for curve in traced if not curve.is_on_any(new)), *new]
        seeds = [seed for curve in new for seed in curve.meeting_seeds]
    return traced


def find_seeds_on_parallel_lines(tracer: CurveTracer, params: WheelParams) -> list[CurveSeed]:
    """Find seeds on parallel branches in each of the two parameters.

    A branch in one parameter starts at the middle of that parameter's range. The branches differ by
    evenly spaced values of the other parameter.
    """
    seeds = []
    for parameter_index in range(2):
        fractions = (np.arange(N_PARALLEL_BRANCHES) + 0.5) / N_PARALLEL_BRANCHES
        lower, upper = tracer.parameter_ranges.T
        starts = lower + fractions[:, None] * (upper - lower)
        starts[:, parameter_index] = tracer.parameter_ranges[parameter_index].mean()
        seeds += _find_seeds_in_batches(tracer, parameter_index, params, starts)
    return seeds


def _find_seeds_in_batches(
    tracer: CurveTracer, parameter_index: int, params: WheelParams, starts: np.ndarray
) -> list[CurveSeed]:
    """Find seeds on branches that start at values of the two parameters, shape (branches, 2).

    The branches are continued in batches of a single size, which needs only one compiled program.
    """
    seeds, n = [], N_PARALLEL_BRANCHES
    for first in range(0, len(starts), n):
        batch = starts[np.minimum(np.arange(first, first + n), len(starts) - 1)]
        seeds += tracer.find_seeds(parameter_index, tracer.with_parameters(params, batch))
    return seeds


def find_sign_changes_in_scan(
    scan_dataset: xr.Dataset, parameter_names: tuple[str, str]
) -> list[ScanSignChange]:
    """Return the sign changes of all quantities between neighboring samples.

    A sign change of a measure is ignored if exactly one of the two samples has double support.
    """
    scan_dataset = scan_dataset.transpose(*parameter_names, ...)
    outcome = scan_dataset.outcome.values
    has_gait, is_coarse = outcome == Outcome.STEPPED, outcome == Outcome.MESH_TOO_COARSE
    names = [
        "lambda_4_plus",
        *(name for name in MARGIN_MEASURES if name not in LINEAR_MARGIN_SUBSTITUTES),
    ]
    if SECOND_PEAK_RATE_NAME in scan_dataset:
        names.append(SECOND_PEAK_RATE_NAME)
    measures = {name: scan_dataset[name].values for name in names}
    quantities = {
        STABILITY_CHANGE_NAME: 1.0 - scan_dataset[STABILITY_CHANGE_NAME].values,
        **split_legs(measures, 2 + scan_dataset.sizes.get("leg", 0)),
        GAIT_CHANGE_NAME: np.select([has_gait, is_coarse], [1.0, np.nan], -1.0),
        COARSE_MESH_END_NAME: np.select([has_gait, is_coarse], [1.0, -1.0], np.nan),
    }
    sign_changes = []
    for axis in range(2):
        # The first index is that of the parameter that varies.
        select_neighbors = lambda x, axis=axis: (x.swapaxes(0, axis)[:-1], x.swapaxes(0, axis)[1:])
        starts_at_gait, ends_at_gait = select_neighbors(has_gait)
        has_same_support = np.equal(*select_neighbors(quantities["lambda_4_plus"] > 0.0))
        for name, values in quantities.items():
            if values.ndim > 2:
                continue  # Each leg has its own quantity.
            before, after = select_neighbors(values)
            has_changed = before * after < 0.0
            if name not in (GAIT_CHANGE_NAME, COARSE_MESH_END_NAME):
                has_changed &= starts_at_gait & ends_at_gait
                has_changed &= has_same_support | (name == "lambda_4_plus")
            for i, j in np.argwhere(has_changed).tolist():
                start = i if starts_at_gait[i, j] else i + 1
                position = i + float(before[i, j] / (before[i, j] - after[i, j]))
                sample, place = (
                    ((start, j), (position, j)) if axis == 0 else ((j, start), (j, position))
                )
                sign_changes.append(ScanSignChange(name, axis, sample, place))
    return sign_changes


# Largest distance of a sign change from a curve that explains it, in cells of the scan.
MAX_DISTANCE_TO_EXPLAINING_CURVE = 1.0


def find_unexplained_sign_changes(
    sign_changes: Sequence[ScanSignChange],
    special_point_curves: Sequence[SpecialPointCurve],
    scan_dataset: xr.Dataset,
) -> list[ScanSignChange]:
    """Return the sign changes that are not near any curve that explains them."""
    lines = [
        (
            curve.name,
            np.stack(
                [
                    np.interp(
                        curve.dataset[name], scan_dataset[name], range(scan_dataset.sizes[name])
                    )
                    for name in curve.parameters
                ],
                -1,
            ),
        )
        for curve in special_point_curves
    ]

    def is_unexplained(change: ScanSignChange) -> bool:
        names = EXPLAINING_CURVE_NAMES.get(change.quantity_name, (change.quantity_name,))
        position = np.array([change.scan_position_in_cells])
        return all(
            compute_distances_to_polyline(position, line) > MAX_DISTANCE_TO_EXPLAINING_CURVE
            for name, line in lines
            if name in names
        )

    return sorted(filter(is_unexplained, sign_changes), key=lambda change: change.quantity_name)
