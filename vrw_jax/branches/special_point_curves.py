"""Continue special points of gaits as curves in two parameters."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from vrw_jax.base.checks import check_names, check_range, check_type
from vrw_jax.base.options import StepOptions
from vrw_jax.base.progress import announce_wait
from vrw_jax.branches.arclength import ArclengthOptions
from vrw_jax.branches.branch import SpecialPointCurve
from vrw_jax.branches.curve_problems import FORCE_QUANTITY_NAMES
from vrw_jax.branches.curve_tracing import DEFAULT_CURVE_OPTIONS, CurveSeed, CurveTracer
from vrw_jax.gaits.limit_cycle_result import LimitCycle
from vrw_jax.lanes.batching import select_tree_rows
from vrw_jax.lanes.settings import with_default_jax_settings
from vrw_jax.wheel.params import PARAMETER_NAMES, check_parameter_name

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
    cycle: LimitCycle,
    *,
    bounds: ParameterBounds | None = None,
    options: ArclengthOptions | None = None,
    step_options: StepOptions | None = None,
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

    Args:
        name: name of the special point.
        parameters: names of the two parameters.
        cycle: the gait near which the search starts.
        bounds: bounds of the parameters, by name.
        options: `ArclengthOptions` of the curve.
        step_options: options of the event-driven steps that evaluate margins.

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
    cycle: LimitCycle,
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
    check_type("cycle", cycle, LimitCycle, "give vrw.limit_cycle(params)")
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
            f"{first_parameter_name} and {second_parameter_name} within their bounds, but "
            f"{', '.join(sorted(seeds_by_name)) or 'none'}: give a gait nearer to it, or wider "
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
