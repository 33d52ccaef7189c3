"""Continue special points of any walker as curves in two parameters."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from vrw_jax.base.checks import (
    check_names,
    check_range,
    check_type,
    require_known_name,
    require_untraced_arguments,
)
from vrw_jax.base.lazy_xarray import xarray as xr
from vrw_jax.base.options import StepOptions, find_tree_parameter
from vrw_jax.base.outcomes import Outcome
from vrw_jax.base.walker import AbstractWalker
from vrw_jax.branches.arclength import ArclengthOptions
from vrw_jax.branches.branch import BIFURCATIONS, Codim2Point, SpecialPointCurve
from vrw_jax.branches.branch_continuation import Continuation
from vrw_jax.branches.branch_location import continue_and_locate_special_points
from vrw_jax.branches.curve_problems import RANGE_EDGE, CurveWheel, GaitCurveProblem
from vrw_jax.branches.map_branch import (
    MarginFunctions,
    check_arclength_options,
    make_stability_variables,
    make_walker_problem,
    trace_fixed_points,
)
from vrw_jax.gaits.fixed_points import estimate_state_units
from vrw_jax.gaits.walker_finder import HybridGait
from vrw_jax.lanes.batching import select_tree_rows

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
