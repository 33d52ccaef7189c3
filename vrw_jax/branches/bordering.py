"""Continuation of special points of gaits as curves in two parameters."""

from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

from vrw_jax.branches.branch import BorderCurve
from vrw_jax.branches.tracing import OF_CURVES, Seed, Tracer
from vrw_jax.cycles import LimitCycle
from vrw_jax.numerics import ArclengthOptions, Options
from vrw_jax.wheel import DOMAINS, wheel_of
from vrw_jax.wording import instance, names_of, range_of, require_known

Box = Mapping[str, tuple[float, float]]

BOX: Box = {
    "damping": (1.0, 250.0),
    "stiffness": (200.0, 1200.0),
    "natural_length": (1.001, 1.06),
    "slope": (0.05, 0.5),
}
"""Default bounds of the parameters for the continuation, for a wheel with legs of 1 m."""


def border_curve(
    name: str,
    parameters: tuple[str, str],
    cycle: LimitCycle,
    *,
    bounds: Box | None = None,
    options: ArclengthOptions | None = None,
    step_options: Options | None = None,
) -> BorderCurve:
    """Return the curve of the special point `name` over two parameters, starting nearest to a gait
    of one step.

    `name` is that of a `SpecialPoint`: an indicator, a phase's duration, a margin (of a locked leg
    "locked_stopper_force[5]") or "fold", "period_doubling", "neimark_sacker". The special point is
    searched for along the first parameter from the gait, then along the second. It is continued
    within `bounds` of the two, by default `branches.special_point_curves.DEFAULT_BOUNDS`, through
    turning points. The curve ends when it closes or leaves the bounds, or when the gaits end. Each
    point is accurate to 1e-9. `codim2_points` are the points where other special points occur. On
    the curve of an indicator these are other indicators and bifurcations, on other curves margins
    too.

    Args:
        name: of the special point.
        parameters: names of the two parameters.
        cycle: the gait near which the search starts.
        bounds: of the parameters, by name.
        options: `ArclengthOptions` of the curve.
        step_options: of the steps that evaluate margins.

    Returns:
        A `SpecialPointCurve`.

    Raises:
        TypeError, ValueError: an invalid argument, or a special point that does not occur on the
            branches.

    Examples:
        >>> cycle = vrw.limit_cycle(vrw.WheelParams(damping=150.0))
        >>> curve = vrw.continue_special_point("clearance_sls1", ("damping", "stiffness"), cycle)
        >>> [point.name for point in curve.codim2_points[-3:-1]]
        ['fold', 'hit_planted_impulse']
    """
    (curve,) = border_curves(
        (name,), parameters, cycle, bounds=bounds, options=options, step_options=step_options
    )
    return curve


def _plane(parameters: Any, bounds: Any) -> tuple[tuple[str, str], np.ndarray]:
    """Return the two parameters and their ranges.

    Raises: TypeError, ValueError: the parameters or bounds are invalid.
    """
    instance("bounds", bounds, (Mapping, type(None)), "write {'damping': (100.0, 200.0)}")
    box = {**BOX, **(bounds or {})}
    pair = names_of("parameters", parameters)
    for name in box:
        require_known(name, tuple(DOMAINS), "parameter that has bounds")
    for name in pair:
        require_known(name, tuple(box), "parameter with bounds")
    if len(pair) != 2 or len(set(pair)) != 2:
        raise ValueError(
            f"parameters are {pair}, but a curve needs two different ones: write "
            "('damping', 'slope')."
        )
    ranges = {name: range_of(f"bounds[{name!r}]", ends) for name, ends in box.items()}
    return (pair[0], pair[1]), np.array([ranges[name] for name in pair], float)


def border_curves(
    names: tuple[str, ...],
    parameters: tuple[str, str],
    cycle: LimitCycle,
    *,
    bounds: Box | None = None,
    options: ArclengthOptions | None = None,
    step_options: Options | None = None,
) -> tuple[BorderCurve, ...]:
    """Return `continue_special_point` of several special points."""
    parameters, box = _plane(parameters, bounds)
    first, second = parameters
    instance("cycle", cycle, LimitCycle, "give vrw.limit_cycle(params)")
    if cycle.period_n != 1:
        raise ValueError(
            f"the gait has {cycle.period_n} steps: a curve of special points takes one step."
        )
    options = OF_CURVES if options is None else options
    step_options = Options.tight() if step_options is None else step_options
    instance("options", options, ArclengthOptions, "give vrw.ArclengthOptions()")
    instance("step_options", step_options, Options, "give vrw.Options()")
    tracer = Tracer(parameters, box, cycle.model, options, step_options)
    params = wheel_of(cycle.parameters, cycle.problem.n_legs)
    found: dict[str, Seed] = {}
    for axis, parameter in enumerate(parameters):
        if set(names) - set(found):
            seeds = tracer.along(axis, jax.tree.map(lambda x: x[None], params))
            at = float(getattr(params, parameter))
            away = np.argsort([-abs(seed.at[axis] - at) for seed in seeds])
            found = {seeds[i].name: seeds[i] for i in away} | found
    missing = sorted(set(names) - set(found))
    if missing:
        raise ValueError(
            f"no special point {missing[0]!r} on branches along {first} and {second} within their "
            f"bounds, but {', '.join(sorted(found)) or 'none'}: give a gait nearer to it, or wider "
            "bounds."
        )
    told = {one.curve.name: one.curve for one in tracer.followed([found[n] for n in names], ())}
    lost = sorted(set(names) - set(told))
    if lost:
        raise ValueError(
            f"special point {lost[0]} at {found[lost[0]].at[0]:.9g} can't be followed from there."
        )
    return tuple(told[name] for name in names)
