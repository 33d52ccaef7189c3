"""Gaits that simulated walks approach, also for a sequence of parameter values.

Every gait of this module is the limit of a walk, without Newton's method for a fixed point. The
gaits are therefore stable, and they test the Newton search independently. If the ground would have
to pull on Leg 1, or if a foot scuffs, the motion continues formally. Gaits can therefore be
continued past the damping at which λ2⁺ vanishes. Formal continuation does not change other gaits.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from vrw_jax.base.lazy_xarray import xarray as xr
from vrw_jax.base.outcomes import Outcome
from vrw_jax.models.measures import (
    MARGIN_MEASURES,
    STEP_MEASURES,
    make_labeled_variables,
    make_locked_leg_coordinate,
    make_measure_attributes,
)
from vrw_jax.models.provenance import collect_provenance_attributes
from vrw_jax.models.step_results import SectionState
from vrw_jax.models.stepping import step, walk
from vrw_jax.models.viscoelastic import ViscoelasticWheel
from vrw_jax.wheel.params import WheelParams


def make_formally_continued_model() -> ViscoelasticWheel:
    """Return the paper's model with motion that continues formally after Leg 1 lifts off."""
    return ViscoelasticWheel(stop_at_lift_off=False)


def replace_wheel_parameter(
    params: WheelParams, parameter_name: str, parameter_value: float
) -> WheelParams:
    """Return the wheel with a new value of one parameter."""
    value_by_parameter: dict[str, Any] = {parameter_name: parameter_value}
    return dataclasses.replace(params, **value_by_parameter)


# Number of steps of a walk, chosen because the gait with the slowest convergence (c = 70 N s/m)
# converges to round-off in 30 steps.
N_SETTLING_STEPS = 30
# Largest change of the section state per step after a walk has settled. The value is ten times the
# error of a step with the default options.
MAX_SETTLED_STATE_CHANGE = 1e-8
# Number of last steps whose change must be below that limit. It is above 1 because two states of a
# gait with a longer period may agree by chance.
N_SETTLED_STEPS = 5


def walk_into_gait(params: WheelParams, x: SectionState) -> xr.Dataset:
    """Simulate a walk into a gait, and return its section states and their change per step.

    The variable `change` of the dataset is the Euclidean distance to the previous section state in
    (rad, rad/s, m/s). `settled` states whether the walk reached a period-1 gait, that is, whether
    each of the last changes is small enough.
    """
    gait_walk = walk(params, x, N_SETTLING_STEPS, model=make_formally_continued_model())
    n_stepped = int(gait_walk.n_stepped)
    section_states = np.concatenate(
        [gait_walk.start[None], gait_walk.steps.section_state[:n_stepped]]
    )
    section_state_changes = np.linalg.norm(np.diff(section_states, axis=0), axis=1)
    walk_outcome = Outcome(int(gait_walk.outcome))
    last_state_change = (
        float(section_state_changes[-N_SETTLED_STEPS:].max())
        if n_stepped >= N_SETTLED_STEPS
        else math.inf
    )
    is_settled = walk_outcome == Outcome.STEPPED and last_state_change < MAX_SETTLED_STATE_CHANGE
    return xr.Dataset(
        {
            "section_state": (("step", "component"), section_states),
            "change": (
                "step",
                np.append(np.nan, section_state_changes),
                {"units": "1", "long_name": "change since the step before"},
            ),
        },
        {"component": ["theta", "dtheta", "dL1"]},
        {
            "outcome": walk_outcome.name,
            "outcome_meaning": walk_outcome.meaning,
            "last_change": last_state_change,
            "settled": int(is_settled),
        }
        | collect_provenance_attributes(params, make_formally_continued_model()),
    )


def walk_along_parameter(
    params: WheelParams, parameter_name: str, parameter_values: Sequence[float], x: SectionState
) -> Iterator[xr.Dataset]:
    """Yield the dataset that `walk_into_gait` returns for each value of a parameter.

    The start of each walk is extrapolated from the last two settled gaits. Walks that fail or do
    not settle are not used for the extrapolation.
    """
    settled_gaits: list[tuple[float, np.ndarray]] = []
    for parameter_value in parameter_values:
        start_state = jnp.asarray(settled_gaits[-1][1]) if settled_gaits else x
        if len(settled_gaits) > 1:
            (previous_value, previous_state), (last_value, last_state) = settled_gaits[-2:]
            extrapolation_factor = (parameter_value - last_value) / (last_value - previous_value)
            start_state = jnp.asarray(
                last_state + extrapolation_factor * (last_state - previous_state)
            )
        gait_walk = walk_into_gait(
            replace_wheel_parameter(params, parameter_name, parameter_value), start_state
        )
        if gait_walk.settled:
            settled_gaits.append((parameter_value, gait_walk.section_state.values[-1]))
        yield gait_walk


def measure_gaits_along_parameter(
    params: WheelParams,
    parameter_name: str,
    parameter_values: Sequence[float],
    x: SectionState,
    on_progress: Callable[[float], None] | None = None,
) -> xr.Dataset:
    """Return all measures of the gaits that `walk_along_parameter` reaches, over the parameter.

    The measures are those of one further step. The variable `settled` states whether the walk
    reached a period-1 gait, and `change` is the largest change in its last steps.

    - `on_progress`: function that is called with the completed fraction of the work.
    """
    measures_by_gait = []
    for parameter_value, gait_walk in zip(
        parameter_values,
        walk_along_parameter(params, parameter_name, parameter_values, x),
        strict=True,
    ):
        last_section_state = gait_walk.section_state.values[-1]
        step_result = step(
            replace_wheel_parameter(params, parameter_name, parameter_value),
            jnp.asarray(last_section_state),
            model=make_formally_continued_model(),
        )
        gait_measures: dict[str, Any] = dict(step_result.measures())
        if gait_walk.outcome != Outcome.STEPPED.name:
            gait_measures["outcome"] = int(Outcome[gait_walk.outcome])
        gait_measures |= {
            "section_state": last_section_state,
            "change": gait_walk.attrs["last_change"],
            "settled": bool(gait_walk.settled),
        }
        measures_by_gait.append(gait_measures)
        if on_progress is not None:
            on_progress(len(measures_by_gait) / len(parameter_values))
    stack_measure = lambda measure_name: np.stack(
        [gait_measures[measure_name] for gait_measures in measures_by_gait]
    )
    dataset_variables = make_labeled_variables(
        {
            measure_name: stack_measure(measure_name)
            for measure_name in STEP_MEASURES | MARGIN_MEASURES
        },
        parameter_name,
    )
    dataset_variables |= {
        "section_state": xr.Variable(
            (parameter_name, "component"),
            stack_measure("section_state"),
            {"long_name": "section state"},
        ),
        "change": xr.Variable(
            parameter_name,
            stack_measure("change"),
            {"units": "1", "long_name": "largest change of the last five steps"},
        ),
        "settled": xr.Variable(
            parameter_name,
            stack_measure("settled"),
            {"long_name": "whether the walk settled into a period-1 gait"},
        ),
    }
    dataset_coordinates = {
        parameter_name: xr.Variable(
            parameter_name,
            np.asarray(parameter_values, float),
            make_measure_attributes(parameter_name),
        ),
        "component": ["theta", "dtheta", "dL1"],
        "leg": make_locked_leg_coordinate(params.n_legs),
    }
    provenance_attributes = collect_provenance_attributes(params, make_formally_continued_model())
    provenance_attributes.pop(f"parameter_{parameter_name}")
    dataset_title = {"title": f"Gaits walked to along {parameter_name}"}
    return xr.Dataset(
        dataset_variables, dataset_coordinates, dataset_title | provenance_attributes
    ).sortby(parameter_name)
