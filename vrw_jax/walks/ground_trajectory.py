"""A walk with contacts as a labelled trajectory: every leg, every foot, every contact.

Of the unilateral wheel, and of the ladder, whose motion is told alike on both its rungs.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array

from vrw_jax.models import (
    SERVED,
    State,
    UnilateralTrajectory,
    directions,
    foot_heights,
    foot_places,
    kinetic_energy,
    potential_energy,
    unpack,
)
from vrw_jax.numerics import Options
from vrw_jax.runtime import xarray as xr
from vrw_jax.walks.samples import Joined, Stretches, joined
from vrw_jax.wheel import Outcome, WheelParams

LEGWISE = {  # unit, long name
    "length": ("m", "length of the leg"),
    "length_rate": ("m/s", "rate of the leg's length"),
    "foot_x": ("m", "downhill position of the foot"),
    "foot_z": ("m", "height of the foot above the slope"),
    "tangential": ("N", "tangential force on the foot, downhill positive"),
    "normal": ("N", "normal force on the foot"),
    "contact": ("1", "contact mode of the foot"),
    "on_stopper": ("1", "whether the leg is on its stopper"),
}
SCALAR = {
    "hub_x": ("m", "downhill position of the hub"),
    "hub_z": ("m", "height of the hub above the slope"),
    "theta": ("rad", "angle of Leg 1 from the slope's normal"),
    "dtheta": ("rad/s", "angular rate"),
    "kinetic_energy": ("J", "kinetic energy"),
    "gravitational_energy": ("J", "gravitational energy, from the first landing's place"),
    "elastic_energy": ("J", "elastic energy of all springs"),
}
MODES = "in_the_air at_rest sliding_downhill sliding_uphill"


@eqx.filter_jit
def _columns(
    model: Any,
    params: WheelParams,
    x: Array,
    options: Options,
    n_samples: int,
) -> tuple[UnilateralTrajectory, dict[str, Array]]:
    """One step's trace and its quantities, shape (phase, sample) or (phase, sample, leg)."""
    s, trace = params.symbols(), model.trace(params, x, options, n_samples)

    def describe(y: State) -> dict[str, Array]:
        motion, _ = unpack(y)
        legs = directions(s, motion.theta)
        gravitational, elastic = potential_energy(s, motion)
        return {
            "hub_x": motion.x,
            "hub_z": motion.z,
            "theta": motion.theta,
            "dtheta": motion.dtheta,
            "kinetic_energy": kinetic_energy(s, motion),
            "gravitational_energy": gravitational,
            "elastic_energy": elastic,
            "length": motion.L,
            "length_rate": motion.dL,
            "foot_x": foot_places(motion, legs),
            "foot_z": foot_heights(motion, legs),
        }

    told = jax.vmap(jax.vmap(describe))(trace.state)
    return trace, told | {"tangential": trace.tangential, "normal": trace.normal}


def simulate_ground(
    params: WheelParams,
    x: Array,
    n_steps: int,
    *,
    model: Any,
    options: Options,
    n_samples: int,
) -> xr.Dataset:
    """Walk `n_steps` steps as a trajectory over time and leg; legs bear the labels of their step.

    Each stretch between two events has `n_samples` times, both ends included. A step that fails
    ends the trajectory; the attributes `outcome` and `outcome_meaning` say why. Of the ladder,
    `rung` and `reason` say for each time which rung served and why (see `ModelChoice`).
    """
    served: dict[str, Array] = {}

    def stretches(x: Array) -> Stretches:
        result = model.step(params, x, options)
        trace, columns = jax.tree.map(np.array, _columns(model, params, x, options, n_samples))
        served.update(result.served())
        shape = (len(trace.duration), n_samples)
        over_samples = lambda legs: np.repeat(legs[:, None], n_samples, axis=1)
        columns |= {"time": trace.time, "contact": over_samples(trace.contact)}
        columns |= {name: np.full(shape, int(value)) for name, value in result.served().items()}
        columns["on_stopper"] = over_samples(trace.locked)
        return Stretches(
            columns,
            trace.duration,
            Outcome(int(result.outcome)),
            result.section_state,
            float(result.period),
            float(result.step_length),
        )

    s = params.symbols()
    told = joined(
        stretches, x, n_steps, ("hub_x", "foot_x"), ("gravitational_energy",),
        float(s.Mt * s.g * s.sin_phi),
    )  # fmt: skip
    variables = {
        name: xr.Variable(dims, told.columns[name], {"units": unit, "long_name": long_name})
        for dims, table in ((("time",), SCALAR), (("time", "leg"), LEGWISE))
        for name, (unit, long_name) in table.items()
    }
    variables["contact"].attrs |= {"flag_values": [0, 1, 2, 3], "flag_meanings": MODES}
    variables |= {name: xr.Variable("time", told.columns[name], SERVED[name]) for name in served}
    time = {"units": "s", "long_name": "time"}
    return xr.Dataset(
        variables,
        {
            "time": xr.Variable("time", told.columns["time"], time),
            "step": xr.Variable("time", told.columns["step"], {"long_name": "number of the step"}),
            "leg": np.arange(1, params.n_legs + 1),
        },
        _attrs(model, told),
    )


def _attrs(model: Any, told: Joined) -> dict[str, object]:
    return {
        "title": f"Walk of the {type(model).__name__}",
        "frame": "x downhill along the slope, z normal to it, first landing at the origin",
        "friction": float(model.friction),
        "n_steps": told.n_stepped,
        "outcome": told.outcome.name,
        "outcome_meaning": told.outcome.meaning,
    }
