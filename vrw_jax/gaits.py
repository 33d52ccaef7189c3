"""Which gait a wheel settles into by walking, and along a parameter from neighbour to neighbour.

No equation is solved for a fixed point: what stands here has been walked to, so it is stable, and
it checks the Newton search independently.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
import xarray as xr

from vrw_jax.measures import MARGINS, STEP, attrs_of, step_measures
from vrw_jax.models import AbstractWheel
from vrw_jax.models.base import SectionState
from vrw_jax.options import Options
from vrw_jax.outcomes import Outcome
from vrw_jax.params import WheelParams
from vrw_jax.return_map import checked, step, walk
from vrw_jax.simulate import provenance

SETTLED = 1e-8
"""Largest change of the section state from step to step in a settled gait: ten times the error of
a step at the default options."""


def approach(
    params: WheelParams,
    x: SectionState,
    n_steps: int,
    *,
    model: AbstractWheel | None = None,
    options: Options | None = None,
) -> xr.Dataset:
    """Section states of a walk and how much each step still changes them.

    `change` is the Euclidean distance to the section state before, over (rad, rad/s, m/s).
    """
    walked = walk(params, x, n_steps, model=model, options=options)
    params, x, model, options = checked(params, x, model, options)
    stepped = int(walked.n_stepped)
    states = np.concatenate([np.asarray(x)[None], walked.steps.section_state[:stepped]])
    change = np.full(stepped + 1, np.nan)
    change[1:] = np.linalg.norm(np.diff(states, axis=0), axis=1)
    outcome = Outcome(int(walked.outcome))
    return xr.Dataset(
        {
            "section_state": (("step", "component"), states),
            "change": ("step", change, {"units": "1", "long_name": "change since the step before"}),
        },
        {"component": ["theta", "dtheta", "dL1"]},
        {"outcome": outcome.name, "outcome_meaning": outcome.meaning}
        | provenance(params, model, options),
    )


def along(
    params: WheelParams,
    name: str,
    values: Sequence[float],
    x: SectionState,
    n_steps: int,
    *,
    model: AbstractWheel | None = None,
    options: Options | None = None,
    progress: Callable[[float], None] | None = None,
) -> xr.Dataset:
    """The gaits met by walking `n_steps` at each of `values`, each begun from its neighbour's.

    A labelled set over the parameter `name`: section state, all measures of one more step, whether
    the walk had settled into a period-1 gait, and the outcome. The next start is extrapolated from
    the last two settled gaits; a walk that fails or does not settle leaves no start behind.
    `progress` is told the share that is done.
    """
    settled_values: list[float] = []
    settled_states: list[np.ndarray] = []
    rows: list[dict[str, np.ndarray]] = []
    for index, value in enumerate(values):
        changed: dict[str, Any] = {name: value}
        wheel = dataclasses.replace(params, **changed)
        start = _extrapolated(settled_values, settled_states, value, x)
        walked = approach(wheel, start, n_steps, model=model, options=options)
        state, change = walked.section_state.values[-1], walked.change.values[-1]
        settled = walked.outcome == Outcome.STEPPED.name and change < SETTLED
        if settled:
            settled_values.append(value)
            settled_states.append(state)
        result = step(wheel, state, model=model, options=options)
        row = {key: np.asarray(values) for key, values in step_measures(result).items()}
        if walked.outcome != Outcome.STEPPED.name:
            row["outcome"] = np.asarray(int(Outcome[walked.outcome]))
        rows.append(row | {"section_state": state, "change": change, "settled": settled})
        if progress is not None:
            progress((index + 1) / len(values))
    return _table(params, name, values, rows, checked(params, x, model, options)[2:])


def _extrapolated(
    values: list[float], states: list[np.ndarray], value: float, x: SectionState
) -> SectionState:
    """A start at `value` on the line through the last two settled gaits."""
    if not states:
        return x
    if len(states) == 1:
        return jnp.asarray(states[0])
    ratio = (value - values[-1]) / (values[-1] - values[-2])
    return jnp.asarray(states[-1] + ratio * (states[-1] - states[-2]))


def _table(
    params: WheelParams,
    name: str,
    values: Sequence[float],
    rows: list[dict[str, np.ndarray]],
    choices: tuple[AbstractWheel, Options],
) -> xr.Dataset:
    columns = {key: np.stack([row[key] for row in rows]) for key in rows[0]}
    data = {
        key: xr.Variable(
            (name, "leg") if MARGINS.get(key, STEP["period"]).axis else name,
            columns[key],
            attrs_of(key),
        )
        for key in STEP | MARGINS
    }
    data["section_state"] = xr.Variable(
        (name, "component"), columns["section_state"], {"long_name": "section state"}
    )
    data["change"] = xr.Variable(
        name, columns["change"], {"units": "1", "long_name": "change of the last step"}
    )
    data["settled"] = xr.Variable(
        name, columns["settled"], {"long_name": "whether the walk settled into a period-1 gait"}
    )
    labels = {
        name: xr.Variable(name, np.asarray(values, float), attrs_of(name)),
        "component": ["theta", "dtheta", "dL1"],
        "leg": xr.Variable("leg", np.arange(3, params.n_legs + 1), {"long_name": "locked leg"}),
    }
    origin = provenance(params, *choices)
    origin.pop(f"parameter_{name}")
    return xr.Dataset(data, labels, {"title": f"Gaits walked to along {name}"} | origin).sortby(
        name
    )
