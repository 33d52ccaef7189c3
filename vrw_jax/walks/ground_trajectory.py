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
    slope = float(params.slope)
    weight = float(params.gravity) * float(params.hub_mass + params.n_legs * params.leg_mass)
    parts: list[dict[str, np.ndarray]] = []
    outcome, stepped, time, place = Outcome.STEPPED, 0, 0.0, 0.0
    while outcome == Outcome.STEPPED and stepped < n_steps:
        result = model.step(params, x, options)
        trace, columns = jax.tree.map(np.asarray, _columns(model, params, x, options, n_samples))
        outcome = Outcome(int(result.outcome))
        for phase in np.flatnonzero(trace.duration > 0.0):
            part = {name: values[phase].copy() for name, values in columns.items()}
            for name in ("hub_x", "foot_x"):
                part[name] += place
            part["gravitational_energy"] -= weight * np.sin(slope) * place
            part["time"] = trace.time[phase] + time
            part["step"] = np.full(n_samples, stepped)
            part["contact"] = np.tile(trace.contact[phase], (n_samples, 1))
            for name, value in result.served().items():
                part[name] = np.full(n_samples, int(value))
            part["on_stopper"] = np.tile(trace.locked[phase], (n_samples, 1))
            parts.append(part)
        time += float(result.period)
        if outcome == Outcome.STEPPED:
            stepped += 1
            place += float(result.step_length)
            x = result.section_state
    joined = lambda name, width: (
        np.concatenate([part[name] for part in parts]) if parts else np.zeros((0, *width))
    )
    variables = {
        name: xr.Variable("time", joined(name, ()), {"units": unit, "long_name": long_name})
        for name, (unit, long_name) in SCALAR.items()
    } | {
        name: xr.Variable(
            ("time", "leg"),
            joined(name, (params.n_legs,)),
            {"units": unit, "long_name": long_name},
        )
        for name, (unit, long_name) in LEGWISE.items()
    }
    variables["contact"].attrs |= {"flag_values": [0, 1, 2, 3], "flag_meanings": MODES}
    for name in result.served():
        variables[name] = xr.Variable("time", joined(name, ()), SERVED[name])
    return xr.Dataset(
        variables,
        {
            "time": xr.Variable("time", joined("time", ()), {"units": "s", "long_name": "time"}),
            "step": xr.Variable("time", joined("step", ()), {"long_name": "number of the step"}),
            "leg": np.arange(1, params.n_legs + 1),
        },
        {
            "title": f"Walk of the {type(model).__name__}",
            "frame": "x downhill along the slope, z normal to it, first landing at the origin",
            "friction": float(model.friction),
            "n_steps": stepped,
            "outcome": outcome.name,
            "outcome_meaning": outcome.meaning,
        },
    )
