"""Which gait a wheel settles into by walking, and along a parameter from neighbour to neighbour.

No equation is solved for a fixed point: what stands here has been walked to, so it is stable, and
it checks the Newton search independently.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from vrw_jax.models import AbstractWheel, SectionState
from vrw_jax.numerics import Options
from vrw_jax.results import MARGINS, STEP, attrs_of, provenance
from vrw_jax.runtime import xarray as xr
from vrw_jax.walks import checked, step, walk
from vrw_jax.wheel import Outcome, WheelParams

SETTLED = 1e-8
"""Largest change of the section state from step to step in a settled gait: ten times the error of
a step at the default options."""

LAST = 5
"""Steps that must not change it: a gait of longer period may by chance repeat once."""


def approach(
    params: WheelParams,
    x: SectionState,
    n_steps: int,
    *,
    model: AbstractWheel | None = None,
    options: Options | None = None,
) -> xr.Dataset:
    """Section states of a walk and how much each step still changes them.

    `change` is the Euclidean distance to the section state before, over (rad, rad/s, m/s); the
    walk has `settled` into a period-1 gait when each of the last five is below `SETTLED`.
    """
    walked = walk(params, x, n_steps, model=model, options=options)
    params, x, model, options = checked(params, x, model, options)
    stepped = int(walked.n_stepped)
    states = np.concatenate([np.asarray(x)[None], walked.steps.section_state[:stepped]])
    change = np.full(stepped + 1, np.nan)
    change[1:] = np.linalg.norm(np.diff(states, axis=0), axis=1)
    outcome = Outcome(int(walked.outcome))
    last = float(change[-LAST:].max()) if stepped >= LAST else math.inf
    settled = outcome == Outcome.STEPPED and last < SETTLED
    return xr.Dataset(
        {
            "section_state": (("step", "component"), states),
            "change": ("step", change, {"units": "1", "long_name": "change since the step before"}),
        },
        {"component": ["theta", "dtheta", "dL1"]},
        {
            "outcome": outcome.name,
            "outcome_meaning": outcome.meaning,
            "last_change": last,
            "settled": int(settled),
        }
        | provenance(params, model, options),
    )


def states_along(
    params: WheelParams,
    name: str,
    values: Sequence[float],
    x: SectionState,
    n_steps: int,
    *,
    model: AbstractWheel | None = None,
    options: Options | None = None,
) -> Iterator[xr.Dataset]:
    """The walks at each of `values` of the parameter `name`, each begun from its neighbour's gait.

    The start is extrapolated from the last two settled gaits; a walk that fails or does not settle
    leaves no start behind. See `approach`; `settled` is added to its attributes.
    """
    settled_values: list[float] = []
    settled_states: list[np.ndarray] = []
    for value in values:
        start = _extrapolated(settled_values, settled_states, value, x)
        wheel = changed(params, name, value)
        walked = approach(wheel, start, n_steps, model=model, options=options)
        if walked.settled:
            settled_values.append(value)
            settled_states.append(walked.section_state.values[-1])
        yield walked


def changed(params: WheelParams, name: str, value: float) -> WheelParams:
    """The same wheel with one parameter changed."""
    change: dict[str, Any] = {name: value}
    return dataclasses.replace(params, **change)


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
    """The gaits of `states_along` with all measures of one more step, over the parameter `name`.

    `settled` says whether the walk had come to a period-1 gait, `change` how much its last steps
    still changed it. `progress` is told the share that is done.
    """
    rows: list[dict[str, np.ndarray]] = []
    walks = states_along(params, name, values, x, n_steps, model=model, options=options)
    for value, walked in zip(values, walks, strict=True):
        state = walked.section_state.values[-1]
        result = step(
            changed(params, name, value), jnp.asarray(state), model=model, options=options
        )
        row = {key: np.asarray(values) for key, values in result.measures().items()}
        if walked.outcome != Outcome.STEPPED.name:
            row["outcome"] = np.asarray(int(Outcome[walked.outcome]))
        row["section_state"] = state
        row["change"] = np.asarray(walked.attrs["last_change"])
        row["settled"] = np.asarray(bool(walked.settled))
        rows.append(row)
        if progress is not None:
            progress(len(rows) / len(values))
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
        name,
        columns["change"],
        {"units": "1", "long_name": "largest change of the last five steps"},
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
