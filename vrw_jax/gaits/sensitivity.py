"""Compute the sensitivities of a gait's measures to all parameters, as a labeled table."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import numpy as np

from vrw_jax.base.checks import check_names, format_name_suggestion, require_untraced_arguments
from vrw_jax.base.lazy_xarray import xarray as xr
from vrw_jax.base.measures import Measure, find_own_measures, name_measures
from vrw_jax.base.options import StepOptions
from vrw_jax.base.outcomes import Outcome
from vrw_jax.base.progress import announce_wait
from vrw_jax.base.walker import is_own_walker
from vrw_jax.gaits.finder_selection import (
    check_cycle_guess,
    resolve_finder,
)
from vrw_jax.gaits.gait_search import resolve_model
from vrw_jax.gaits.options import CycleOptions
from vrw_jax.gaits.walker_finder import WalkerFinder
from vrw_jax.models.stepping import (
    ModelLike,
    convert_model_argument,
    require_legs_in_turn_by_collocation,
)


@announce_wait("the gait with its derivatives", "15 s")
def sensitivities(
    params: Any,
    *,
    measures: Sequence[str | Measure] | None = None,
    guess: Any = None,
    model: ModelLike | None = None,
    options: CycleOptions | StepOptions | None = None,
) -> xr.Dataset:
    """Return the values, derivatives and elasticities of one gait's measures.

    The derivatives and elasticities are with respect to all parameters. An elasticity is the
    relative change of a measure per relative change of a parameter. It is NaN if the measure is
    zero. If the stability measures are omitted, compilation takes much less time. With unilateral
    contact, friction is also a parameter. With model "auto", `attrs` contains the name of the model
    that was selected for the gait. For a walker of yours, the measures are the period, the section
    coordinates and its own `measures`, by all its parameters.

    Args:
        params: the wheel, or the parameters of a walker of yours.
        measures: names of measures, or measures of your own, see `vrw.measure`; by default all
            measures of the model's gait.
        guess: as in `limit_cycle`.
        model: the model; the paper's, `ViscoelasticWheel()`, by default.
        options: as in `limit_cycle`.

    Returns:
        A dataset with `value` (measure), `derivative` and `elasticity` (measure, parameter).

    Raises:
        TypeError, ValueError: if an argument is invalid; the message names the remedy.

    Examples:
        >>> table = vrw.sensitivities(vrw.WheelParams(), measures=["dls_fraction", "speed"])
        >>> round(float(table.elasticity.sel(measure="speed", parameter="slope")), 3)
        1.887
    """
    require_untraced_arguments("vrw.sensitivities", "differentiate vrw.limit_cycle", params, guess)
    guess = check_cycle_guess(guess)
    if not is_own_walker(model):
        model = convert_model_argument(resolve_model(params, model))  # type: ignore[arg-type]
        require_legs_in_turn_by_collocation(model, "vrw.sensitivities")
    period_n = model.leg_period
    gait_finder = resolve_finder(params, model, options, period_n, guess)
    measure_names = (
        gait_finder.default_measures
        if measures is None
        else check_names("measures", name_measures(measures))
    )
    own_measures = (
        find_own_measures(measures, gait_finder.readable_measures)
        if gait_finder.model.is_wheel
        else {}
    )
    unknown_names = sorted(
        set(measure_names) - set(gait_finder.differentiable_measures) - own_measures.keys()
    )
    if unknown_names or not measure_names:
        raise ValueError(
            f"measures holds {', '.join(unknown_names) or 'nothing'}"
            f"{format_name_suggestion(unknown_names[0], gait_finder.differentiable_measures) if unknown_names else ''}, "  # noqa: E501
            "but the measures of a cycle are "
            f"{', '.join(gait_finder.differentiable_measures)}: choose among these."
        )
    parameter_values = gait_finder.model.collect_parameter_values(params)
    measure_gait = functools.partial(
        gait_finder.measure_gait,
        parameter_values,
        measure_names=tuple(own_measures.get(name, name) for name in measure_names),
    )
    gait_measures = measure_gait(guess)
    if isinstance(gait_finder, WalkerFinder) and guess is None:
        has_gait = int(gait_measures.outcome) == Outcome.STEPPED
        start = None if has_gait else gait_finder.find_gait_by_walk(params)
        gait_measures = gait_measures if start is None else measure_gait(start)
    if int(gait_measures.outcome) != Outcome.STEPPED:
        failure_outcome = Outcome(int(gait_measures.outcome))
        raise ValueError(f"there is no gait to differentiate: {failure_outcome.meaning}")
    measure_derivatives = np.asarray(gait_measures.parameter_jacobian)
    measure_values = np.asarray(gait_measures.measure_values)
    with np.errstate(divide="ignore", invalid="ignore"):
        measure_elasticities = (
            measure_derivatives * np.asarray(parameter_values) / measure_values[:, None]
        )
    table_axes = ("measure", "parameter")
    parameter_names = gait_finder.model.parameter_names
    unit_of = lambda name: (own_measures.get(name) or gait_finder.get_measure(name)).unit
    return xr.Dataset(
        {
            "value": ("measure", measure_values),
            "derivative": (
                table_axes,
                measure_derivatives,
                {"long_name": "d(measure)/d(parameter)"},
            ),
            "elasticity": (
                table_axes,
                np.where(np.isfinite(measure_elasticities), measure_elasticities, np.nan),
                {"long_name": "relative change of measure per relative change of parameter"},
            ),
            "measure_unit": (
                "measure",
                [unit_of(name) for name in measure_names],
            ),
            "parameter_unit": (
                "parameter",
                [x.unit for x in gait_finder.model.parameter_domains.values()],
            ),
            "parameter_value": ("parameter", np.asarray(parameter_values)),
        },
        coords={"measure": list(measure_names), "parameter": list(parameter_names)},
        attrs={"rung": gait_finder.model.model_name} if gait_finder.model.is_wheel else {},
    )
