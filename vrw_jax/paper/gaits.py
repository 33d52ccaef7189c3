"""Gaits that a wheel reaches by walking, also along a parameter from one gait to the next.

No equation is solved for a fixed point. Every gait here is the limit of a walk, so the gait is
stable and tests the Newton search independently. The model continues formally if the ground would
have to pull on Leg 1, and if a foot scuffs. Gaits can therefore be continued past the c at which
λ2⁺ vanishes. Other gaits are unaffected.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from vrw_jax.measures import (
    MARGIN_MEASURES,
    STEP_MEASURES,
    locked_leg_coordinate,
    make_variables,
    measure_attrs,
    provenance,
)
from vrw_jax.models import SectionState, ViscoelasticWheel
from vrw_jax.numerics import StepOptions
from vrw_jax.runtime import xarray as xr
from vrw_jax.simulation import step, walk
from vrw_jax.wheel import Outcome, WheelParams


@dataclasses.dataclass(frozen=True)
class SettlingOptions:
    """Conditions under which a walk counts as settled in a gait.

    - `n_steps`: number of steps of a walk, chosen because the slowest gait, c = 70, converges to
      round-off in as many;
    - `max_change`: largest change of the section state per step in a settled gait, chosen as ten
      times the error of a step at the default options;
    - `n_settled_steps`: number of last steps that must change less, chosen because a longer period
      may repeat once by chance.
    """

    n_steps: int = 30
    max_change: float = 1e-8
    n_settled_steps: int = 5


SETTLING_OPTIONS = SettlingOptions()
"""Options of all walks of the reproduction."""


def make_paper_model() -> ViscoelasticWheel:
    """Return the paper's model, which continues after Leg 1 lifts off."""
    return ViscoelasticWheel(stop_at_lift_off=False)


def replace_parameter(params: WheelParams, parameter_name: str, value: float) -> WheelParams:
    """Return the wheel with another value of one parameter."""
    replaced_fields: dict[str, Any] = {parameter_name: value}
    return dataclasses.replace(params, **replaced_fields)


def walk_into_gait(
    params: WheelParams, x: SectionState, options: SettlingOptions = SETTLING_OPTIONS
) -> xr.Dataset:
    """Return a dataset of the section states of a walk and their change per step.

    `change` is the Euclidean distance to the previous section state in (rad, rad/s, m/s). `settled`
    is whether the walk reached a period-1 gait: each of the last changes is small enough.
    """
    gait_walk = walk(params, x, options.n_steps, model=make_paper_model())
    n_stepped = int(gait_walk.n_stepped)
    states = np.concatenate([gait_walk.start[None], gait_walk.steps.section_state[:n_stepped]])
    state_change = np.full(n_stepped + 1, np.nan)
    state_change[1:] = np.linalg.norm(np.diff(states, axis=0), axis=1)
    outcome = Outcome(int(gait_walk.outcome))
    n_settled_steps = options.n_settled_steps
    last_change = (
        float(state_change[-n_settled_steps:].max()) if n_stepped >= n_settled_steps else math.inf
    )
    is_settled = outcome == Outcome.STEPPED and last_change < options.max_change
    return xr.Dataset(
        {
            "section_state": (("step", "component"), states),
            "change": (
                "step",
                state_change,
                {"units": "1", "long_name": "change since the step before"},
            ),
        },
        {"component": ["theta", "dtheta", "dL1"]},
        {
            "outcome": outcome.name,
            "outcome_meaning": outcome.meaning,
            "last_change": last_change,
            "settled": int(is_settled),
        }
        | provenance(params, make_paper_model(), StepOptions()),
    )


def walk_along_parameter(
    params: WheelParams, parameter_name: str, values: Sequence[float], x: SectionState
) -> Iterator[xr.Dataset]:
    """Yield a dataset of the walk at each of `values` of the parameter `name`, see
    `walk_into_gait`.

    The start is extrapolated from the last two settled gaits. Walks that fail or do not settle are
    not used for this.
    """
    settled_values: list[float] = []
    settled_states: list[np.ndarray] = []
    for value in values:
        start_state = _extrapolate_start(settled_values, settled_states, value, x)
        gait_walk = walk_into_gait(replace_parameter(params, parameter_name, value), start_state)
        if gait_walk.settled:
            settled_values.append(value)
            settled_states.append(gait_walk.section_state.values[-1])
        yield gait_walk


def measure_gaits_along(
    params: WheelParams,
    parameter_name: str,
    values: Sequence[float],
    x: SectionState,
    on_progress: Callable[[float], None] | None = None,
) -> xr.Dataset:
    """Return a dataset of the gaits of `walk_along_parameter` with all measures, over the parameter
    `name`.

    The measures are those of one more step. `settled` is whether the walk reached a period-1 gait,
    and `change` is the largest change of its last steps.

    - `on_progress`: function of the completed fraction.
    """
    measures_by_value: list[dict[str, np.ndarray]] = []
    for value, gait_walk in zip(
        values, walk_along_parameter(params, parameter_name, values, x), strict=True
    ):
        last_state = gait_walk.section_state.values[-1]
        step_result = step(
            replace_parameter(params, parameter_name, value),
            jnp.asarray(last_state),
            model=make_paper_model(),
        )
        gait_measures = {
            measure_name: np.asarray(values)
            for measure_name, values in step_result.measures().items()
        }
        if gait_walk.outcome != Outcome.STEPPED.name:
            gait_measures["outcome"] = np.asarray(int(Outcome[gait_walk.outcome]))
        gait_measures["section_state"] = last_state
        gait_measures["change"] = np.asarray(gait_walk.attrs["last_change"])
        gait_measures["settled"] = np.asarray(bool(gait_walk.settled))
        measures_by_value.append(gait_measures)
        if on_progress is not None:
            on_progress(len(measures_by_value) / len(values))
    return _make_dataset(
        params,
        parameter_name,
        values,
        {
            measure_name: np.stack([r[measure_name] for r in measures_by_value])
            for measure_name in measures_by_value[0]
        },
    )


def _extrapolate_start(
    values: list[float], states: list[np.ndarray], value: float, x: SectionState
) -> SectionState:
    """Return a start at `value` on the line through the last two settled gaits."""
    if not states:
        return x
    if len(states) == 1:
        return jnp.asarray(states[0])
    extrapolation_factor = (value - values[-1]) / (values[-1] - values[-2])
    return jnp.asarray(states[-1] + extrapolation_factor * (states[-1] - states[-2]))


def _make_dataset(
    params: WheelParams,
    parameter_name: str,
    values: Sequence[float],
    columns: dict[str, np.ndarray],
) -> xr.Dataset:
    """Return the labeled dataset of columns over the parameter `name`."""
    variables = make_variables(
        {measure_name: columns[measure_name] for measure_name in STEP_MEASURES | MARGIN_MEASURES},
        parameter_name,
    )
    change_attrs = {"units": "1", "long_name": "largest change of the last five steps"}
    variables |= {
        "section_state": xr.Variable(
            (parameter_name, "component"), columns["section_state"], {"long_name": "section state"}
        ),
        "change": xr.Variable(parameter_name, columns["change"], change_attrs),
        "settled": xr.Variable(
            parameter_name,
            columns["settled"],
            {"long_name": "whether the walk settled into a period-1 gait"},
        ),
    }
    coordinates = {
        parameter_name: xr.Variable(
            parameter_name, np.asarray(values, float), measure_attrs(parameter_name)
        ),
        "component": ["theta", "dtheta", "dL1"],
        "leg": locked_leg_coordinate(params.n_legs),
    }
    provenance_attrs = provenance(params, make_paper_model(), StepOptions())
    provenance_attrs.pop(f"parameter_{parameter_name}")
    attrs = {"title": f"Gaits walked to along {parameter_name}"} | provenance_attrs
    return xr.Dataset(variables, coordinates, attrs).sortby(parameter_name)
