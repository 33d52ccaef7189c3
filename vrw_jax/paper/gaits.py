"""Which gait a wheel settles into by walking, and along a parameter from neighbour to neighbour.

No equation is solved for a fixed point: what stands here has been walked to, so it is stable, and
it checks the Newton search independently. The rung continues formally where the ground would have
to pull on Leg 1, as it does for scuffing, so that gaits can be followed past the c at which λ2⁺
vanishes; elsewhere that changes nothing.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from vrw_jax.models import SectionState, ViscoelasticWheel
from vrw_jax.numerics import Options
from vrw_jax.results import MARGINS, STEP, attrs_of, locked_legs, provenance, variables
from vrw_jax.runtime import xarray as xr
from vrw_jax.walks import step, walk
from vrw_jax.wheel import Outcome, WheelParams

N_STEPS = 30
"""Steps of each walk: the slowest gait on the branch, c = 70, settles to rounding in them."""

SETTLED = 1e-8
"""Largest change of the section state from step to step in a settled gait: ten times the error of
a step at the default options."""

LAST = 5
"""Steps that must not change it: a gait of longer period may by chance repeat once."""


def paper_wheel() -> ViscoelasticWheel:
    return ViscoelasticWheel(stop_at_lift_off=False)


def changed(params: WheelParams, name: str, value: float) -> WheelParams:
    change: dict[str, Any] = {name: value}
    return dataclasses.replace(params, **change)


def approach(params: WheelParams, x: SectionState) -> xr.Dataset:
    """Section states of a walk and how much each step still changes them.

    `change` is the Euclidean distance to the section state before, over (rad, rad/s, m/s); the
    walk has `settled` into a period-1 gait when each of the last five is below `SETTLED`.
    """
    walked = walk(params, x, N_STEPS, model=paper_wheel())
    stepped = int(walked.n_stepped)
    states = np.concatenate([walked.start[None], walked.steps.section_state[:stepped]])
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
        | provenance(params, paper_wheel(), Options()),
    )


def states_along(
    params: WheelParams, name: str, values: Sequence[float], x: SectionState
) -> Iterator[xr.Dataset]:
    """The walks at each of `values` of the parameter `name`, each begun from its neighbour's gait.

    The start is extrapolated from the last two settled gaits; a walk that fails or does not settle
    leaves no start behind. See `approach`; `settled` is added to its attributes.
    """
    settled_values: list[float] = []
    settled_states: list[np.ndarray] = []
    for value in values:
        start = _extrapolated(settled_values, settled_states, value, x)
        walked = approach(changed(params, name, value), start)
        if walked.settled:
            settled_values.append(value)
            settled_states.append(walked.section_state.values[-1])
        yield walked


def along(
    params: WheelParams,
    name: str,
    values: Sequence[float],
    x: SectionState,
    progress: Callable[[float], None] | None = None,
) -> xr.Dataset:
    """The gaits of `states_along` with all measures of one more step, over the parameter `name`.

    `settled` says whether the walk had come to a period-1 gait, `change` how much its last steps
    still changed it. `progress` is told the share that is done.
    """
    rows: list[dict[str, np.ndarray]] = []
    for value, walked in zip(values, states_along(params, name, values, x), strict=True):
        state = walked.section_state.values[-1]
        result = step(changed(params, name, value), jnp.asarray(state), model=paper_wheel())
        row = {key: np.asarray(values) for key, values in result.measures().items()}
        if walked.outcome != Outcome.STEPPED.name:
            row["outcome"] = np.asarray(int(Outcome[walked.outcome]))
        row["section_state"] = state
        row["change"] = np.asarray(walked.attrs["last_change"])
        row["settled"] = np.asarray(bool(walked.settled))
        rows.append(row)
        if progress is not None:
            progress(len(rows) / len(values))
    return _table(params, name, values, {key: np.stack([r[key] for r in rows]) for key in rows[0]})


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
    params: WheelParams, name: str, values: Sequence[float], columns: dict[str, np.ndarray]
) -> xr.Dataset:
    data = variables({key: columns[key] for key in STEP | MARGINS}, name)
    told = {"units": "1", "long_name": "largest change of the last five steps"}
    data |= {
        "section_state": xr.Variable(
            (name, "component"), columns["section_state"], {"long_name": "section state"}
        ),
        "change": xr.Variable(name, columns["change"], told),
        "settled": xr.Variable(
            name, columns["settled"], {"long_name": "whether the walk settled into a period-1 gait"}
        ),
    }
    labels = {
        name: xr.Variable(name, np.asarray(values, float), attrs_of(name)),
        "component": ["theta", "dtheta", "dL1"],
        "leg": locked_legs(params.n_legs),
    }
    origin = provenance(params, paper_wheel(), Options())
    origin.pop(f"parameter_{name}")
    attrs = {"title": f"Gaits walked to along {name}"} | origin
    return xr.Dataset(data, labels, attrs).sortby(name)
