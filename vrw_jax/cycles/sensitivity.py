"""Sensitivities of every measure of a gait to every parameter, as a labeled table."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vrw_jax.cycles.finding import Guess, finder_for, near, serving
from vrw_jax.cycles.options import CycleOptions
from vrw_jax.numerics import Options
from vrw_jax.results import MEASURES
from vrw_jax.runtime import xarray as xr
from vrw_jax.walks import ModelLike
from vrw_jax.wheel import Outcome, WheelParams
from vrw_jax.wording import names_of, nearest, untraced


def sensitivities(
    params: WheelParams,
    *,
    measures: Sequence[str] | None = None,
    guess: Guess | None = None,
    model: ModelLike | None = None,
    options: CycleOptions | Options | None = None,
) -> xr.Dataset:
    """Return d(measure)/d(parameter) of one gait, with elasticities and the values of the measures.

    An elasticity is the relative change of the measure per relative change of the parameter. It is
    NaN where the measure is zero. Leaving out the stability measures saves most of the compile
    time. With unilateral contact, friction is a parameter too. With model "auto", `attrs` names the
    model that was selected for the gait.

    Args:
        params: the wheel.
        measures: names of measures; by default all that the model's gait has.
        guess: as in `limit_cycle`.
        model: the model; the paper's, `ViscoelasticWheel()`, by default.
        options: as in `limit_cycle`.

    Returns:
        A dataset of `value` (measure), `derivative` and `elasticity` (measure, parameter).

    Raises:
        TypeError, ValueError: an invalid argument, described in one sentence.

    Examples:
        >>> table = vrw.sensitivities(vrw.WheelParams(), measures=["dls_fraction", "speed"])
        >>> round(float(table.elasticity.sel(measure="speed", parameter="slope")), 3)
        1.887
    """
    untraced("vrw.sensitivities", "differentiate vrw.limit_cycle", params, guess)
    model = serving(params, model)
    finder = finder_for(params, model, options)
    names = finder.usual if measures is None else names_of("measures", measures)
    unknown = sorted(set(names) - set(finder.differentiable))
    if unknown or not names:
        raise ValueError(
            f"measures holds {', '.join(unknown) or 'nothing'}"
            f"{nearest(unknown[0], finder.differentiable) if unknown else ''}, "
            "but the measures of a cycle are "
            f"{', '.join(finder.differentiable)}: choose among these."
        )
    vector = finder.model.values(params)
    found = finder.measured(vector, near(guess), names)
    if int(found.outcome) != Outcome.STEPPED:
        outcome = Outcome(int(found.outcome))
        raise ValueError(f"there is no gait to differentiate: {outcome.meaning}")
    derivative, value = np.asarray(found.slopes), np.asarray(found.values)
    with np.errstate(divide="ignore", invalid="ignore"):
        elasticity = derivative * np.asarray(vector) / value[:, None]
    axes, moved = ("measure", "parameter"), finder.model.parameter_names
    return xr.Dataset(
        {
            "value": ("measure", value),
            "derivative": (axes, derivative, {"long_name": "d(measure)/d(parameter)"}),
            "elasticity": (
                axes,
                np.where(np.isfinite(elasticity), elasticity, np.nan),
                {"long_name": "relative change of measure per relative change of parameter"},
            ),
            "measure_unit": ("measure", [MEASURES[name].unit for name in names]),
            "parameter_unit": ("parameter", [MEASURES[name].unit for name in moved]),
            "parameter_value": ("parameter", np.asarray(vector)),
        },
        coords={"measure": list(names), "parameter": list(moved)},
        attrs={"rung": finder.model.rung},
    )
