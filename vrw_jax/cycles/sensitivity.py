"""How every measure of a gait answers to every parameter, as a labelled table."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from vrw_jax.cycles.cycle import Guess, LimitCycle, limit_cycle
from vrw_jax.cycles.ground import MOVED, ground_gait, told, values_of
from vrw_jax.cycles.options import CycleOptions
from vrw_jax.cycles.section_cycle import WalkedCycle
from vrw_jax.models import AbstractWheel, UnilateralWheel, refuse_ladder
from vrw_jax.numerics import Options
from vrw_jax.results import MEASURES as MEASURES_BY_NAME
from vrw_jax.results import ON_GROUND
from vrw_jax.runtime import xarray as xr
from vrw_jax.walks import checked
from vrw_jax.wheel import DOMAINS, Outcome, WheelParams, parameters_of, wheel_of

MEASURES: dict[str, tuple[str, Callable[[LimitCycle | WalkedCycle], Array]]] = {
    "dls_fraction": ("1", lambda cycle: cycle.dls_fraction),
    "period": ("s", lambda cycle: cycle.period),
    "speed": ("m/s", lambda cycle: cycle.speed),
    "step_length": ("m", lambda cycle: cycle.step_length),
    "duration_dls": ("s", lambda cycle: cycle.durations[0]),
    "duration_sls1": ("s", lambda cycle: cycle.durations[1]),
    "duration_sls2": ("s", lambda cycle: cycle.durations[2]),
    "theta_post_impact": ("rad", lambda cycle: cycle.post_impact[0]),
    "dtheta_post_impact": ("rad/s", lambda cycle: cycle.post_impact[1]),
    "lambda_I4": ("N s", lambda cycle: cycle.indicators.lambda_I4),
    "lambda_2": ("N", lambda cycle: cycle.indicators.lambda_2),
    "lambda_4": ("N", lambda cycle: cycle.indicators.lambda_4),
    "spectral_radius": ("1", lambda cycle: cycle.spectral_radius),
    "stability_margin": ("1", lambda cycle: cycle.stability_margin),
}
"""Unit and definition of each measure; the last two are second derivatives of the motion."""


@eqx.filter_jit
def _jacobian(
    vector: Array,
    guess: Guess | None,
    n_legs: int,
    measures: tuple[str, ...],
    model: AbstractWheel | None,
    options: CycleOptions | Options | None,
) -> tuple[Array, tuple[Array, Array]]:
    """d(measures)/d(parameters) with the measures and the outcome; compiled once."""

    def evaluate(vector: Array) -> tuple[Array, tuple[Array, Array]]:
        wheel = wheel_of(vector, n_legs)
        cycle: LimitCycle | WalkedCycle
        if model is None:
            cycle = limit_cycle(wheel, guess=guess, options=options)
        else:
            cycle = limit_cycle(wheel, guess=guess, model=model, options=options)
        values = jnp.stack([MEASURES[name][1](cycle) for name in measures])
        return values, (values, cycle.outcome)

    return jax.jacfwd(evaluate, has_aux=True)(vector)


def sensitivities(
    params: WheelParams,
    *,
    measures: Sequence[str] | None = None,
    guess: Guess | None = None,
    model: AbstractWheel | None = None,
    options: CycleOptions | Options | None = None,
) -> xr.Dataset:
    """d(measure)/d(parameter) of one gait, plain and as elasticities, with the measures' values.

    An elasticity is the relative change of the measure over that of the parameter; NaN where the
    measure is zero. Leaving out the measures of stability saves most of the compile time. `guess`,
    `model` and `options` are those of `limit_cycle`. On real ground friction is a parameter too.
    """
    refuse_ladder(model, "differentiated")
    if isinstance(model, UnilateralWheel):
        return _on_ground(params, measures, guess, model, options)
    known = list(MEASURES)
    measures = known if measures is None else measures
    _check_known(measures, known)
    vector = parameters_of(params)
    jacobian, (values, outcome) = _jacobian(
        vector, guess, params.n_legs, tuple(measures), model, options
    )
    if int(outcome) != Outcome.STEPPED:
        raise ValueError(f"there is no gait to differentiate: {Outcome(int(outcome)).meaning}")
    units = [MEASURES[name][0] for name in measures]
    domains = {name: domain.unit or "1" for name, domain in DOMAINS.items()}
    return _table(measures, units, domains, vector, values, jacobian)


def _check_known(measures: Sequence[str], known: Sequence[str]) -> None:
    unknown = sorted(set(measures) - set(known))
    if unknown:
        raise ValueError(
            f"measures holds {', '.join(unknown)}, but the measures of a cycle are "
            f"{', '.join(known)}: choose among these."
        )


def _on_ground(
    params: WheelParams,
    measures: Sequence[str] | None,
    guess: Guess | None,
    model: UnilateralWheel,
    options: CycleOptions | Options | None,
) -> xr.Dataset:
    """The same of real ground, from one Jacobian of the step."""
    if isinstance(options, CycleOptions):
        raise TypeError("options is a CycleOptions, but real ground needs the Options of its step.")
    measures = ON_GROUND if measures is None else measures
    _check_known(measures, ON_GROUND)
    begin = guess.section_state if isinstance(guess, LimitCycle | WalkedCycle) else guess
    begin = model.start(params) if begin is None else begin
    params, x, _, options = checked(params, begin, model, options)
    values = values_of(params, model)
    gait = ground_gait(values, x, params.n_legs, model, options)
    if not bool(gait.cycle.found):
        outcome = Outcome(int(gait.cycle.outcome))
        raise ValueError(f"there is no gait to differentiate: {outcome.meaning}")
    both = told(gait, tuple(measures))
    value, by = (jnp.stack([both[name][k] for name in measures]) for k in (0, 1))
    units = [MEASURES_BY_NAME[name].unit for name in measures]
    domains = {name: MEASURES_BY_NAME[name].unit for name in MOVED}
    return _table(measures, units, domains, values, value, by)


def _table(
    measures: Sequence[str],
    units: Sequence[str],
    parameters: Mapping[str, str],
    vector: Array,
    values: Array,
    jacobian: Array,
) -> xr.Dataset:
    """The labelled table; `parameters` are names with units."""
    derivative, value = np.asarray(jacobian), np.asarray(values)
    with np.errstate(divide="ignore", invalid="ignore"):
        elasticity = derivative * np.asarray(vector) / value[:, None]
    axes = ("measure", "parameter")
    return xr.Dataset(
        {
            "value": ("measure", value),
            "derivative": (axes, derivative, {"long_name": "d(measure)/d(parameter)"}),
            "elasticity": (
                axes,
                np.where(np.isfinite(elasticity), elasticity, np.nan),
                {"long_name": "relative change of measure per relative change of parameter"},
            ),
            "measure_unit": ("measure", list(units)),
            "parameter_unit": ("parameter", list(parameters.values())),
            "parameter_value": ("parameter", np.asarray(vector)),
        },
        coords={"measure": list(measures), "parameter": list(parameters)},
    )
