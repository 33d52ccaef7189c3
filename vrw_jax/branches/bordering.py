"""Borders of gaits as curves in two parameters, as a user asks for them."""

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
"""Where borders are followed if nothing else is said; of a wheel with legs of 1 m."""


def border_curve(
    name: str,
    parameters: tuple[str, str],
    cycle: LimitCycle,
    *,
    bounds: Box | None = None,
    options: ArclengthOptions | None = None,
    step_options: Options | None = None,
) -> BorderCurve:
    """The border `name` as a curve over two parameters, nearest to a gait of one step.

    `name` is that of a `Border`: an indicator, a phase's duration, a margin (of a locked leg
    "locked_stopper_force[5]") or "fold", "period_doubling", "neimark_sacker". The border is looked
    for along the first parameter from the gait, then along the second, and followed within `bounds`
    of the two, by default `branches.bordering.BOX`: through turning points, until it closes, leaves
    them, or the gaits end. Each point is exact to 1e-9; `meetings` are where other borders are met:
    on that of an indicator other indicators and bifurcations, on others margins too.

    Args:
        name: of the border.
        parameters: names of the two.
        cycle: the gait near which it is looked for.
        bounds: of the parameters, by name.
        options: `ArclengthOptions` of the curve.
        step_options: of the steps that tell margins.

    Returns:
        A `BorderCurve`.

    Raises:
        TypeError, ValueError: an argument that can't be meant, or a border that is not met on the
            branches, in one sentence.

    Examples:
        >>> cycle = vrw.limit_cycle(vrw.WheelParams(damping=150.0))
        >>> curve = vrw.border_curve("clearance_sls1", ("damping", "stiffness"), cycle)
        >>> [meeting.name for meeting in curve.meetings[-3:-1]]
        ['fold', 'hit_planted_impulse']
    """
    (curve,) = border_curves(
        (name,), parameters, cycle, bounds=bounds, options=options, step_options=step_options
    )
    return curve


def _plane(parameters: Any, bounds: Any) -> tuple[tuple[str, str], np.ndarray]:
    """The two parameters and their ranges, or one sentence."""
    instance("bounds", bounds, (Mapping, type(None)), "write {'damping': (100.0, 200.0)}")
    box = {**BOX, **(bounds or {})}
    pair = names_of("parameters", parameters)
    for name in box:
        require_known(name, tuple(DOMAINS), "parameter that has bounds")
    for name in pair:
        require_known(name, tuple(box), "parameter with bounds")
    if len(pair) != 2 or len(set(pair)) != 2:
        raise ValueError(
            f"parameters are {pair}, but a border's curve needs two different ones: write "
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
    """`border_curve` of several."""
    parameters, box = _plane(parameters, bounds)
    first, second = parameters
    instance("cycle", cycle, LimitCycle, "give vrw.limit_cycle(params)")
    if cycle.period_n != 1:
        raise ValueError(f"the gait has {cycle.period_n} steps: a border's curve takes one step.")
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
            f"no border {missing[0]!r} on the branches along {first} and {second} within their "
            f"bounds, but {', '.join(sorted(found)) or 'none'}: give a gait nearer to it, or wider "
            "bounds."
        )
    told = {one.curve.name: one.curve for one in tracer.followed([found[n] for n in names], ())}
    lost = sorted(set(names) - set(told))
    if lost:
        raise ValueError(
            f"the border {lost[0]} at {found[lost[0]].at[0]:.9g} can't be followed from there."
        )
    return tuple(told[name] for name in names)
