"""A walk as a labelled trajectory: motion, forces, energy and points, with units and provenance.

Frame: x downhill along the slope, z normal to it, with the first foot at the origin. Angles and leg
labels refer to the present step, so theta and the lengths jump at a landing.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from vrw_jax.models import (
    SERVED,
    AbstractWheel,
    State,
    Trajectory,
    UnilateralTrajectory,
    directions,
    foot_heights,
    foot_places,
    kinetic_energy,
    potential_energy,
    unpack,
)
from vrw_jax.numerics import Engine, Options
from vrw_jax.results import CONTACTS, TRAJECTORY, provenance, variables
from vrw_jax.runtime import xarray as xr
from vrw_jax.walks.stepping import ModelLike, SectionLike, checked, one_wheel, rung_of
from vrw_jax.wheel import (
    Motion,
    Outcome,
    Symbols,
    WheelParams,
    damping_power,
    landing_direction,
    rear_direction,
)
from vrw_jax.wording import untraced, whole


def simulate(
    params: WheelParams,
    x: SectionLike | None = None,
    n_steps: int = 10,
    *,
    model: ModelLike | None = None,
    options: Options | None = None,
    engine: Engine = "auto",
    n_samples: int = 100,
) -> xr.Dataset:
    """Return a walk from the section state `x` as a labelled trajectory over time.

    By default the walk starts at the default start of the model, near the gait of Table 1.

    Each phase has `n_samples` equidistant times, including both ends. A time at which a quantity
    jumps is therefore listed twice, with the values before and after the jump. A failed step ends
    the trajectory at the event, and the attributes `outcome` and `outcome_meaning` give the cause.
    Errors are those of `vrw.step`.

    Args:
        params: the wheel.
        x: section state (theta-, dtheta-, dL1-) just before touchdown, in rad, rad/s, m/s.
        n_steps: largest number of steps.
        model: the model; by default that of the paper, `ViscoelasticWheel()`. "auto" chooses the
            simplest valid model.
        options: numerical options of the steps.
        engine: engine that computes the steps; see `StepOptions`.
        n_samples: number of times per phase, including both ends, at least 2.

    Returns:
        A dataset over `time` of coordinates, rates, feet, forces and energies, with units. With
        unilateral contact it is also over `leg`.

    Raises:
        TypeError, ValueError: if an argument is invalid; the message names the remedy.

    Examples:
        >>> walk = vrw.simulate(vrw.WheelParams(damping=150.0), n_steps=1)
        >>> walk.lambda_2.attrs["units"], walk.attrs["outcome"]
        ('N', 'STEPPED')
    """
    untraced("vrw.simulate", "use vrw.walk", params, x)
    n_steps, n_samples = whole("n_steps", n_steps), whole("n_samples", n_samples, 2)
    one_wheel(params, "simulate one at a time")
    start = rung_of(model).start(params) if x is None else x
    params, x, model, options = checked(params, start, model, options, engine)
    sampled = over_contacts if model.tells_contacts else over_phases
    s = jax.tree.map(float, params).symbols()
    telling = sampled(params, s, model, options, n_samples)
    told = joined(telling, x, n_steps, float(s.Mt * s.g * s.sin_phi))
    columns = told.columns
    data = variables({name: columns[name] for name in telling.names}, "time")
    for name in filter(columns.__contains__, SERVED):
        data[name] = xr.Variable("time", columns[name], SERVED[name])
    attrs = {
        "title": f"Walk of the {type(model).__name__}",
        "n_steps": told.n_stepped,
        "outcome": told.outcome.name,
        "outcome_meaning": told.outcome.meaning,
        "start": np.asarray(x).tolist(),
    }
    origin = telling.attrs | provenance(params, model, options)
    labels = {name: data.pop(name) for name in ("step", "phase") if name in data}
    return xr.Dataset(data, telling.labels | labels, attrs | origin)


class Stretches(NamedTuple):
    """One step, sampled in each interval between two events."""

    columns: dict[str, np.ndarray]  # (interval, sample, ...), time in s since the landing
    durations: np.ndarray  # of each interval, s; 0 if it did not occur
    outcome: Outcome
    following: Array  # section state at the end of the step
    period: float  # s
    length: float  # distance from the landing of this step to the next landing, m


class Telling(NamedTuple):
    """Specification of a trajectory: how a model samples a step, and the variables."""

    stretches_of: Callable[[Array], Stretches]  # samples the step from a section state
    names: tuple[str, ...]  # measures over time
    along: tuple[str, ...]  # those of the measures that are positions along the slope
    labels: dict[str, Any]  # coordinates other than those among the measures
    attrs: dict[str, object]


class Joined(NamedTuple):
    """Samples of a walk, with the outcome of its last step."""

    columns: dict[str, np.ndarray]  # (time, ...), with `step`; empty if no interval occurred
    n_stepped: int
    outcome: Outcome


FALLING = ("gravitational_energy", "total_energy")
"""Energies that are measured relative to the height of the first foot of the walk."""


def joined(telling: Telling, x: Array, n_steps: int, weight_along: float) -> Joined:
    """Return the samples of up to `n_steps` steps from the section state x.

    Positions along the slope, in m, are relative to the first landing. Energies that depend on the
    height, in J, decrease by `downslope_weight`, in N, times the distance.
    """
    parts: list[dict[str, np.ndarray]] = []
    outcome, stepped, time, place = Outcome.STEPPED, 0, 0.0, 0.0
    while outcome == Outcome.STEPPED and stepped < n_steps:
        told = telling.stretches_of(x)
        happened, part = told.durations > 0.0, dict[str, np.ndarray]()
        some = slice(None) if happened.all() else happened  # a full slice copies nothing
        for name, values in told.columns.items():
            part[name] = values[some].reshape(-1, *values.shape[2:])
        for name in telling.along:
            part[name] = part[name] + place
        for name in part.keys() & FALLING:
            part[name] = part[name] - weight_along * place
        part["time"] = part["time"] + time
        part["step"] = np.full(len(part["time"]), stepped)
        parts.append(part)
        outcome = told.outcome
        if outcome == Outcome.STEPPED:
            stepped, time, place = stepped + 1, time + told.period, place + told.length
            x = told.following
    columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    return Joined(columns, stepped, outcome)


@functools.cache
def _traced(model: AbstractWheel, structure: Any, n_samples: int) -> Callable[..., Trajectory]:
    """Return the compiled function that samples a step from x and the leaves of its inputs."""

    def trace(x: Array, *leaves: Array) -> Trajectory:
        params, options = jax.tree.unflatten(structure, leaves)
        return model.trace(params, x, options, n_samples)

    return jax.jit(trace)


def _columns(s: Symbols, moved: Trajectory) -> dict[str, np.ndarray]:
    """Return a step by the names of `TRAJECTORY`, shape (phase, sample), from Leg 1's foot.

    The column `ahead` is the position along the slope of the leg that lands next, in m.
    """
    theta, L1, L2, dtheta, dL1, dL2 = np.moveaxis(np.asarray(moved.state), -1, 0)
    kinetic, gravitational, elastic = np.moveaxis(np.asarray(moved.energy), -1, 0)
    forces = np.moveaxis(np.asarray(moved.forces), -1, 0)
    motion = Motion.of(theta, L1, L2, dtheta, dL1, dL2)
    rear = rear_direction(s, motion.sin, motion.cos)
    hub_x, hub_z, zero = L1 * motion.sin, L1 * motion.cos, np.zeros_like(L1)
    return {
        "time": np.array(moved.time),
        "x": zero,
        "z": zero,
        "theta": theta,
        "L1": L1,
        "L2": L2,
        "dx": zero,
        "dz": zero,
        "dtheta": dtheta,
        "dL1": dL1,
        "dL2": dL2,
        **{f"lambda_{i + 1}": force for i, force in enumerate(forces)},
        "kinetic_energy": kinetic,
        "gravitational_energy": gravitational,
        "elastic_energy": elastic,
        "total_energy": kinetic + gravitational + elastic,
        "damping_power": damping_power(s, motion),
        "foot_1_x": zero,
        "foot_1_z": zero,
        "foot_2_x": hub_x - L2 * rear.sin,
        "foot_2_z": hub_z - L2 * rear.cos,
        "hub_x": hub_x,
        "hub_z": hub_z,
        "ahead": hub_x - s.L0 * landing_direction(s, motion.sin, motion.cos).sin,
    }


def over_phases(
    params: WheelParams, s: Symbols, model: AbstractWheel, options: Options, n_samples: int
) -> Telling:
    """Return the specification for models whose steps consist of the paper's phases."""
    leaves, structure = jax.tree.flatten((params, options))
    trace = _traced(model, structure, n_samples)

    def stretches(x: Array) -> Stretches:
        """Return the samples of the step from x."""
        moved = trace(x, *leaves)
        columns, durations = _columns(s, moved), np.asarray(moved.durations)
        ahead = columns.pop("ahead")
        columns["phase"] = np.tile(np.arange(len(durations))[:, None], (1, n_samples))
        happened = np.flatnonzero(durations > 0.0)
        length = float(ahead[happened[-1], -1]) if happened.size else 0.0
        outcome, period = Outcome(int(moved.outcome)), float(durations.sum())
        return Stretches(columns, durations, outcome, moved.section_state, period, length)

    attrs: dict[str, object] = {
        "frame": "x downhill along the slope, z normal to it, first foot at the origin",
        "start_meaning": "theta-, dtheta-, dL1- just before the first landing, rad, rad/s, m/s",
    }
    return Telling(stretches, tuple(TRAJECTORY), ALONG, {}, attrs)


ALONG = ("x", "foot_1_x", "foot_2_x", "hub_x")
"""Columns that are positions along the slope."""


OF_WALK = ("time", "step", "hub_x", "hub_z", "theta", "dtheta")
ENERGIES = ("kinetic_energy", "gravitational_energy", "elastic_energy")


@eqx.filter_jit
def _contact_columns(
    model: Any, params: WheelParams, x: Array, options: Options, n_samples: int
) -> tuple[UnilateralTrajectory, dict[str, Array]]:
    """Return the samples of a step and its quantities, shape (phase, sample[, leg])."""
    s, trace = params.symbols(), model.trace(params, x, options, n_samples)

    def describe(y: State) -> dict[str, Array]:
        """Return positions, rates and energies of one state."""
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


def over_contacts(
    params: WheelParams, s: Symbols, model: Any, options: Options, n_samples: int
) -> Telling:
    """Return the specification for models with contacts, over time and leg.

    Legs have the labels of their step. Each interval between two events has `n_samples` times,
    including both ends. For a `LadderWheel`, `rung` and `reason` give the model used at each time
    and the cause (see `ModelChoice`).
    """

    def stretches(x: Array) -> Stretches:
        """Return the samples of the step from x."""
        trace, columns = jax.tree.map(
            np.array, _contact_columns(model, params, x, options, n_samples)
        )
        shape = (len(trace.duration), n_samples)
        over_samples = lambda legs: np.repeat(legs[:, None], n_samples, axis=1)
        columns |= {"time": trace.time, "contact": over_samples(trace.contact)}
        columns |= {name: np.full(shape, int(value)) for name, value in trace.served.items()}
        columns["on_stopper"] = over_samples(trace.locked)
        return Stretches(
            columns,
            trace.duration,
            Outcome(int(trace.outcome)),
            jnp.asarray(trace.section_state),
            float(trace.duration.sum()),
            float(trace.step_length),
        )

    attrs: dict[str, object] = {
        "frame": "x downhill along the slope, z normal to it, first landing at the origin",
        "friction": float(model.friction),
    }
    names = (*OF_WALK, *ENERGIES, *CONTACTS)
    legs = {"leg": np.arange(1, params.n_legs + 1)}
    return Telling(stretches, names, ("hub_x", "foot_x"), legs, attrs)
