"""A walk as a labelled trajectory: motion, forces, energy and points, with units and origin.

The slope's frame: x downhill along the slope, z normal to it; the first foot stands at the origin.
Angles and leg labels are those of the present step, so theta and the lengths jump at a landing.
"""

import importlib.metadata
import platform

import equinox as eqx
import jax
import numpy as np
import xarray as xr

from vrw_jax.dynamics import damping_power
from vrw_jax.geometry import Motion, landing_direction, rear_direction
from vrw_jax.measures import TRAJECTORY, attrs_of
from vrw_jax.models import AbstractWheel
from vrw_jax.models.base import SectionState, Trajectory
from vrw_jax.options import Options
from vrw_jax.outcomes import Outcome
from vrw_jax.params import PARAMETER_NAMES, Symbols, WheelParams
from vrw_jax.return_map import _advance, checked


@eqx.filter_jit
def _trace(
    model: AbstractWheel, params: WheelParams, x: SectionState, options: Options, n_samples: int
) -> Trajectory:
    return model.trace(params, x, options, n_samples)


def simulate(
    params: WheelParams,
    x: SectionState,
    n_steps: int = 10,
    *,
    model: AbstractWheel | None = None,
    options: Options | None = None,
    n_samples: int = 100,
) -> xr.Dataset:
    """Walk `n_steps` steps from the section state `x`, as a labelled trajectory over time.

    Each phase has `n_samples` equal times, both ends included: an instant at which something jumps
    stands there twice, just before and just after it. A step that fails ends the trajectory at the
    event; the attributes `outcome` and `outcome_meaning` say why. Errors as in `vrw.step`.
    """
    if not n_steps >= 1:
        raise ValueError(f"n_steps is {n_steps}, but a trajectory needs at least one step.")
    if not n_samples >= 2:
        raise ValueError(f"n_samples is {n_samples}, but a phase has two ends: give 2 or more.")
    params, x, model, options = checked(params, x, model, options)
    s = jax.tree.map(np.asarray, params.symbols())
    parts: list[dict[str, np.ndarray]] = []
    start, outcome, stepped, time, foot = x, Outcome.STEPPED, 0, 0.0, 0.0
    while outcome == Outcome.STEPPED and stepped < n_steps:
        advance = _advance(model, params, x, options)
        trajectory = jax.tree.map(np.asarray, _trace(model, params, x, options, n_samples))
        outcome = Outcome(int(advance.outcome))
        durations = np.asarray(advance.durations)
        for phase in np.flatnonzero(durations > 0.0):
            columns = _columns(s, jax.tree.map(lambda leaf, i=phase: leaf[i], trajectory), foot)
            columns["time"] = columns["time"] + time
            columns["step"] = np.full(n_samples, stepped)
            columns["phase"] = np.full(n_samples, phase)
            parts.append(columns)
        if outcome == Outcome.STEPPED:
            stepped += 1
            time += float(durations.sum())
            foot = _next_foot(s, parts[-1])
            x = advance.section_state
    columns = {
        name: np.concatenate([part[name] for part in parts]) if parts else np.zeros(0)
        for name in TRAJECTORY
    }
    attrs = {
        "title": f"Walk of the {type(model).__name__}",
        "frame": "x downhill along the slope, z normal to it, first foot at the origin",
        "start": [float(v) for v in start],
        "start_meaning": "theta-, dtheta-, dL1- just before the first landing, rad, rad/s, m/s",
        "n_steps": stepped,
        "outcome": outcome.name,
        "outcome_meaning": outcome.meaning,
    }
    variables = {
        name: xr.Variable("time", values, attrs_of(name)) for name, values in columns.items()
    }
    labels = {name: variables.pop(name) for name in ("time", "step", "phase")}
    return xr.Dataset(variables, labels, attrs | provenance(params, model, options))


def provenance(
    params: WheelParams, model: AbstractWheel, options: Options
) -> dict[str, str | float | int]:
    """Where a result comes from: versions, device, number format, tolerances, parameters."""
    names = ("vrw-jax", "jax", "diffrax", "numpy")
    values: dict[str, str | float | int] = {
        f"parameter_{name}": float(getattr(params, name))
        for name in PARAMETER_NAMES
        if getattr(params, name).ndim == 0
    }
    return values | {
        "parameter_n_legs": params.n_legs,
        "model": repr(model),
        "versions": ", ".join(f"{name} {_version(name)}" for name in names)
        + f", python {platform.python_version()}",
        "device": jax.devices()[0].device_kind,
        "dtype": str(params.damping.dtype),
        "solver": options.solver,
        "rtol": float(options.rtol),
        "atol": float(options.atol),
    }


def _version(name: str) -> str:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"


def _columns(s: Symbols, phase: Trajectory, foot: float) -> dict[str, np.ndarray]:
    """One phase by the names of `TRAJECTORY`, with Leg 1's foot at `foot`, m."""
    theta, L1, L2, dtheta, dL1, dL2 = np.asarray(phase.state).T
    kinetic, gravitational, elastic = np.asarray(phase.energy).T
    gravitational = gravitational - s.Mt * s.g * s.sin_phi * foot
    motion = Motion(np.sin(theta), np.cos(theta), L1, L2, dtheta, dL1, dL2)
    rear = rear_direction(s, motion.sin, motion.cos)
    hub_x, hub_z = foot + L1 * motion.sin, L1 * motion.cos
    zero = np.zeros_like(L1)
    return {
        "time": np.asarray(phase.time),
        "x": foot + zero,
        "z": zero,
        "theta": theta,
        "L1": L1,
        "L2": L2,
        "dx": zero,
        "dz": zero,
        "dtheta": dtheta,
        "dL1": dL1,
        "dL2": dL2,
        **{f"lambda_{i + 1}": force for i, force in enumerate(np.asarray(phase.forces).T)},
        "kinetic_energy": kinetic,
        "gravitational_energy": gravitational,
        "elastic_energy": elastic,
        "total_energy": kinetic + gravitational + elastic,
        "damping_power": np.asarray(damping_power(s, motion)),
        "foot_1_x": foot + zero,
        "foot_1_z": zero,
        "foot_2_x": hub_x - L2 * rear.sin,
        "foot_2_z": hub_z - L2 * rear.cos,
        "hub_x": hub_x,
        "hub_z": hub_z,
    }


def _next_foot(s: Symbols, last: dict[str, np.ndarray]) -> float:
    """Where the landing leg stands, m: one step length ahead of the present foot."""
    theta = last["theta"][-1]
    ahead = landing_direction(s, np.sin(theta), np.cos(theta))
    return float(last["hub_x"][-1] - s.L0 * ahead.sin)
