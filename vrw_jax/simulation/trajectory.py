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

from vrw_jax.contact import (
    PackedState,
    UnilateralTrajectory,
    foot_heights,
    foot_positions,
    kinetic_energy,
    leg_directions,
    potential_energy,
    unpack_state,
)
from vrw_jax.measures import CONTACT_MEASURES, TRAJECTORY_MEASURES, make_variables, provenance
from vrw_jax.models import AbstractWheel, Trajectory
from vrw_jax.numerics import EngineName, StepOptions
from vrw_jax.runtime import xarray as xr
from vrw_jax.selection import SELECTION_ATTRS
from vrw_jax.simulation.stepping import (
    ModelLike,
    SectionLike,
    check_model,
    check_single_wheel,
    validate_arguments,
)
from vrw_jax.validation import check_int, check_not_traced
from vrw_jax.wheel import (
    Motion,
    Outcome,
    Symbols,
    WheelParams,
    damping_power,
    landing_direction,
    rear_direction,
)


def simulate(
    params: WheelParams,
    x: SectionLike | None = None,
    n_steps: int = 10,
    *,
    model: ModelLike | None = None,
    options: StepOptions | None = None,
    engine: EngineName = "auto",
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
    check_not_traced("vrw.simulate", "use vrw.walk", params, x)
    n_steps, n_samples = check_int("n_steps", n_steps), check_int("n_samples", n_samples, 2)
    check_single_wheel(params, "simulate one at a time")
    start = check_model(model).default_start(params) if x is None else x
    params, x, model, options = validate_arguments(params, start, model, options, engine)
    make_spec = make_contact_spec if model.reports_contacts else make_phase_spec
    s = jax.tree.map(float, params).symbols()
    spec = make_spec(params, s, model, options, n_samples)
    sampled_walk = sample_walk(spec, x, n_steps, float(s.Mt * s.g * s.sin_phi))
    columns = sampled_walk.columns
    data = make_variables({name: columns[name] for name in spec.variable_names}, "time")
    for name in filter(columns.__contains__, SELECTION_ATTRS):
        data[name] = xr.Variable("time", columns[name], SELECTION_ATTRS[name])
    attrs = {
        "title": f"Walk of the {type(model).__name__}",
        "n_steps": sampled_walk.n_stepped,
        "outcome": sampled_walk.outcome.name,
        "outcome_meaning": sampled_walk.outcome.meaning,
        "start": np.asarray(x).tolist(),
    }
    provenance_attrs = spec.attrs | provenance(params, model, options)
    coordinates = {name: data.pop(name) for name in ("step", "phase") if name in data}
    return xr.Dataset(data, spec.coordinates | coordinates, attrs | provenance_attrs)


class SampledStep(NamedTuple):
    """One step, sampled in each interval between two events."""

    columns: dict[str, np.ndarray]  # (interval, sample, ...), time in s since the landing
    durations: np.ndarray  # of each interval, s; 0 if it did not occur
    outcome: Outcome
    next_section_state: Array  # section state at the end of the step
    period: float  # s
    step_length: float  # distance from the landing of this step to the next landing, m


class TrajectorySpec(NamedTuple):
    """Specification of a trajectory: how a model samples a step, and the variables."""

    sample_step: Callable[[Array], SampledStep]  # samples the step from a section state
    variable_names: tuple[str, ...]  # measures over time
    slope_position_names: tuple[
        str, ...
    ]  # those of the measures that are positions along the slope
    coordinates: dict[str, Any]  # coordinates other than those among the measures
    attrs: dict[str, object]


class SampledWalk(NamedTuple):
    """Samples of a walk, with the outcome of its last step."""

    columns: dict[str, np.ndarray]  # (time, ...), with `step`; empty if no interval occurred
    n_stepped: int
    outcome: Outcome


HEIGHT_DEPENDENT_ENERGIES = ("gravitational_energy", "total_energy")
"""Energies that are measured relative to the height of the first foot of the walk."""


def sample_walk(
    spec: TrajectorySpec, x: Array, n_steps: int, downslope_weight: float
) -> SampledWalk:
    """Return the samples of up to `n_steps` steps from the section state x.

    Positions along the slope, in m, are relative to the first landing. Energies that depend on the
    height, in J, decrease by `downslope_weight`, in N, times the distance.
    """
    parts: list[dict[str, np.ndarray]] = []
    outcome, n_stepped, time, position = Outcome.STEPPED, 0, 0.0, 0.0
    while outcome == Outcome.STEPPED and n_stepped < n_steps:
        sampled_step = spec.sample_step(x)
        has_occurred, part = sampled_step.durations > 0.0, dict[str, np.ndarray]()
        selection = (
            slice(None) if has_occurred.all() else has_occurred
        )  # a full slice copies nothing
        for name, values in sampled_step.columns.items():
            part[name] = values[selection].reshape(-1, *values.shape[2:])
        for name in spec.slope_position_names:
            part[name] = part[name] + position
        for name in part.keys() & HEIGHT_DEPENDENT_ENERGIES:
            part[name] = part[name] - downslope_weight * position
        part["time"] = part["time"] + time
        part["step"] = np.full(len(part["time"]), n_stepped)
        parts.append(part)
        outcome = sampled_step.outcome
        if outcome == Outcome.STEPPED:
            n_stepped, time, position = (
                n_stepped + 1,
                time + sampled_step.period,
                position + sampled_step.step_length,
            )
            x = sampled_step.next_section_state
    columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    return SampledWalk(columns, n_stepped, outcome)


@functools.cache
def _compile_trace(
    model: AbstractWheel, structure: Any, n_samples: int
) -> Callable[..., Trajectory]:
    """Return the compiled function that samples a step from x and the leaves of its inputs."""

    def trace(x: Array, *leaves: Array) -> Trajectory:
        params, options = jax.tree.unflatten(structure, leaves)
        return model.sample_step(params, x, options, n_samples)

    return jax.jit(trace)


def _make_columns(s: Symbols, trajectory: Trajectory) -> dict[str, np.ndarray]:
    """Return a step by the names of `TRAJECTORY_MEASURES`, shape (phase, sample), from Leg 1's foot.

    The column `ahead` is the position along the slope of the leg that lands next, in m.
    """
    theta, L1, L2, dtheta, dL1, dL2 = np.moveaxis(np.asarray(trajectory.state), -1, 0)
    kinetic, gravitational, elastic = np.moveaxis(np.asarray(trajectory.energy), -1, 0)
    forces = np.moveaxis(np.asarray(trajectory.forces), -1, 0)
    motion = Motion.from_angle(theta, L1, L2, dtheta, dL1, dL2)
    rear_leg = rear_direction(s, motion.sin, motion.cos)
    hub_x, hub_z, zero = L1 * motion.sin, L1 * motion.cos, np.zeros_like(L1)
    return {
        "time": np.array(trajectory.time),
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
        "foot_2_x": hub_x - L2 * rear_leg.sin,
        "foot_2_z": hub_z - L2 * rear_leg.cos,
        "hub_x": hub_x,
        "hub_z": hub_z,
        "ahead": hub_x - s.L0 * landing_direction(s, motion.sin, motion.cos).sin,
    }


def make_phase_spec(
    params: WheelParams, s: Symbols, model: AbstractWheel, options: StepOptions, n_samples: int
) -> TrajectorySpec:
    """Return the specification for models whose steps consist of the paper's phases."""
    leaves, structure = jax.tree.flatten((params, options))
    sample_phases = _compile_trace(model, structure, n_samples)

    def sample_step(x: Array) -> SampledStep:
        """Return the samples of the step from x."""
        trajectory = sample_phases(x, *leaves)
        columns, durations = _make_columns(s, trajectory), np.asarray(trajectory.durations)
        landing_position = columns.pop("ahead")
        columns["phase"] = np.tile(np.arange(len(durations))[:, None], (1, n_samples))
        phases_occurred = np.flatnonzero(durations > 0.0)
        step_length = (
            float(landing_position[phases_occurred[-1], -1]) if phases_occurred.size else 0.0
        )
        outcome, period = Outcome(int(trajectory.outcome)), float(durations.sum())
        return SampledStep(
            columns, durations, outcome, trajectory.section_state, period, step_length
        )

    attrs: dict[str, object] = {
        "frame": "x downhill along the slope, z normal to it, first foot at the origin",
        "start_meaning": "theta-, dtheta-, dL1- just before the first landing, rad, rad/s, m/s",
    }
    return TrajectorySpec(sample_step, tuple(TRAJECTORY_MEASURES), PHASE_SLOPE_POSITIONS, {}, attrs)


PHASE_SLOPE_POSITIONS = ("x", "foot_1_x", "foot_2_x", "hub_x")
"""Columns that are positions along the slope."""


CONTACT_MOTION_NAMES = ("time", "step", "hub_x", "hub_z", "theta", "dtheta")
CONTACT_ENERGY_NAMES = ("kinetic_energy", "gravitational_energy", "elastic_energy")


@eqx.filter_jit
def _make_contact_columns(
    model: Any, params: WheelParams, x: Array, options: StepOptions, n_samples: int
) -> tuple[UnilateralTrajectory, dict[str, Array]]:
    """Return the samples of a step and its quantities, shape (phase, sample[, leg])."""
    s, trace = params.symbols(), model.sample_step(params, x, options, n_samples)

    def describe(y: PackedState) -> dict[str, Array]:
        """Return positions, rates and energies of one state."""
        motion, _ = unpack_state(y)
        legs = leg_directions(s, motion.theta)
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
            "foot_x": foot_positions(motion, legs),
            "foot_z": foot_heights(motion, legs),
        }

    columns = jax.vmap(jax.vmap(describe))(trace.state)
    return trace, columns | {"tangential": trace.tangential, "normal": trace.normal}


def make_contact_spec(
    params: WheelParams, s: Symbols, model: Any, options: StepOptions, n_samples: int
) -> TrajectorySpec:
    """Return the specification for models with contacts, over time and leg.

    Legs have the labels of their step. Each interval between two events has `n_samples` times,
    including both ends. For a `LadderWheel`, `rung` and `reason` give the model used at each time
    and the cause (see `ModelChoice`).
    """

    def sample_step(x: Array) -> SampledStep:
        """Return the samples of the step from x."""
        trace, columns = jax.tree.map(
            np.array, _make_contact_columns(model, params, x, options, n_samples)
        )
        shape = (len(trace.duration), n_samples)
        repeat_over_samples = lambda legs: np.repeat(legs[:, None], n_samples, axis=1)
        columns |= {"time": trace.time, "contact": repeat_over_samples(trace.contact)}
        columns |= {
            name: np.full(shape, int(value)) for name, value in trace.model_selection.items()
        }
        columns["on_stopper"] = repeat_over_samples(trace.locked)
        return SampledStep(
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
    names = (*CONTACT_MOTION_NAMES, *CONTACT_ENERGY_NAMES, *CONTACT_MEASURES)
    leg_coordinate = {"leg": np.arange(1, params.n_legs + 1)}
    return TrajectorySpec(sample_step, names, ("hub_x", "foot_x"), leg_coordinate, attrs)
