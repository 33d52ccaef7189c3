"""Labelled trajectories of walks: motion, forces, energy and positions, with units and provenance.

In the frame, x points downhill along the slope, z is normal to the slope, and the origin is the
first foot. Angles and leg labels refer to the present step, so theta and the lengths jump at a
landing.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
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
from vrw_jax.models import AbstractWheel, Trajectory, complete_slopes, split_slopes
from vrw_jax.numerics import EngineName, StepOptions
from vrw_jax.runtime import with_default_settings
from vrw_jax.runtime import xarray as xr
from vrw_jax.selection import SELECTION_ATTRS
from vrw_jax.simulation.stepping import (
    ModelLike,
    SectionLike,
    check_single_wheel,
    read_ground,
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


@with_default_settings
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

    Without `x` the walk begins at the default start of the model, near the gait of Table 1. Uneven
    ground is given as in `vrw.walk`. Positions are then in the frame of line 0. Angles and forces
    of a step are in the frame of the line under both feet of its double support. The attribute
    `slopes` holds the slopes of the lines.

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
    params_with_lines = params
    checked_model, params, ground_per_step = read_ground(params, model, n_steps)
    check_single_wheel(params, "simulate one at a time")
    start_state = checked_model.default_start(params) if x is None else x
    params, x, model, options = validate_arguments(
        params, start_state, checked_model, options, engine
    )
    make_spec = make_contact_spec if model.reports_contacts else make_phase_spec
    s, model_and_wheel_by_step, ground_lines = (
        jax.tree.map(float, params).symbols(),
        [(model, params)],
        None,
    )
    if ground_per_step is not None:
        ground_rows = zip(
            *(step_ground.astype(x.dtype) for step_ground in ground_per_step), strict=True
        )
        model_and_wheel_by_step = [
            model.with_ground(params, step_ground) for step_ground in ground_rows
        ]
        slopes = params_with_lines.slope
        slopes = slopes if slopes.ndim else jnp.full(n_steps, slopes)
        slopes = complete_slopes(slopes, n_steps)
        ground_lines = GroundLines(np.asarray(slopes, float), float(s.Mt * s.g))
    trajectory_spec = make_spec(model_and_wheel_by_step, options, n_samples)
    sampled_walk = sample_walk(
        trajectory_spec, x, n_steps, float(s.Mt * s.g * s.sin_phi), ground_lines
    )
    walk_columns = sampled_walk.columns
    variables = make_variables(
        {name: walk_columns[name] for name in trajectory_spec.variable_names}, "time"
    )
    for name in filter(walk_columns.__contains__, SELECTION_ATTRS):
        variables[name] = xr.Variable("time", walk_columns[name], SELECTION_ATTRS[name])
    attrs = {
        "title": f"Walk of the {type(model).__name__}",
        "n_steps": sampled_walk.n_stepped,
        "outcome": sampled_walk.outcome.name,
        "outcome_meaning": sampled_walk.outcome.meaning,
        "start": np.asarray(x).tolist(),
    }
    provenance_attrs = trajectory_spec.attrs | provenance(params, model, options)
    if ground_lines is not None:
        provenance_attrs |= {"frame": UNEVEN_GROUND_FRAME, "slopes": ground_lines.slopes.tolist()}
        del provenance_attrs["parameter_slope"]
    coordinates = {name: variables.pop(name) for name in ("step", "phase") if name in variables}
    return xr.Dataset(
        variables, trajectory_spec.coordinates | coordinates, attrs | provenance_attrs
    )


class SampledStep(NamedTuple):
    """Samples of one step, in each interval between two events."""

    columns: dict[str, np.ndarray]  # (interval, sample, ...), time in s since the landing
    durations: np.ndarray  # duration of each interval, s; 0 if it did not occur
    outcome: Outcome
    next_section_state: Array  # section state at the end of the step
    period: float  # s
    step_length: float  # distance of the landings along the step's line, m
    normal_rise: float  # the same normal to that line, m; 0 on flat ground


class TrajectorySpec(NamedTuple):
    """Specification of a trajectory: the sampling function of a model, and the variables."""

    sample_step: Callable[[Array, int], SampledStep]  # of a section state and a step index
    variable_names: tuple[str, ...]  # names of the measures over time
    slope_position_names: tuple[str, ...]  # names of the positions along the slope
    coordinates: dict[str, Any]  # coordinates besides the variables
    attrs: dict[str, object]


class SampledWalk(NamedTuple):
    """Samples of a walk, with the outcome of its last step."""

    columns: dict[str, np.ndarray]  # (time, ...), with `step`; empty if no interval occurred
    n_stepped: int
    outcome: Outcome


HEIGHT_DEPENDENT_ENERGIES = ("gravitational_energy", "total_energy")
"""Energies that are measured relative to the height of the first foot of the walk."""


UNEVEN_GROUND_FRAME = (
    "positions: x downhill along line 0, z normal to it, first foot at the origin; angles and "
    "forces: along and normal to the line under both feet of the step's double support"
)
"""Attribute `frame` of a trajectory on uneven ground."""


class GroundLines(NamedTuple):
    """Lines of uneven ground, with the weight of the wheel."""

    slopes: np.ndarray  # rad
    weight: float  # N

    def convert_to_walk_frame(
        self,
        columns: dict[str, np.ndarray],
        position_names: Sequence[str],
        k: int,
        foothold: np.ndarray,
    ) -> None:
        """Convert positions (m) and energies (J) of step k, in place, from its frame to that of
        line 0.

        - `position_names`: columns that are positions along the slope;
        - `foothold`: position of the first foot of step k in the frame of line 0, m.
        """
        for name in position_names:
            normal_name = f"{name[:-1]}z"
            x, z = self.rotate_to_line_0(k, columns[name], columns[normal_name])
            columns[name], columns[normal_name] = x + foothold[0], z + foothold[1]
        slope = self.slopes[0]
        height = foothold[1] * np.cos(slope) - foothold[0] * np.sin(slope)
        for name in columns.keys() & HEIGHT_DEPENDENT_ENERGIES:
            columns[name] = columns[name] + self.weight * height

    def rotate_to_line_0(self, k: int, x: Any, z: Any) -> tuple[Any, Any]:
        """Return the components in the frame of line 0 of a vector in the frame of line k."""
        angle = self.slopes[k] - self.slopes[0]
        sin, cos = np.sin(angle), np.cos(angle)
        return x * cos + z * sin, z * cos - x * sin


def sample_walk(
    trajectory_spec: TrajectorySpec,
    x: Array,
    n_steps: int,
    downslope_weight: float,
    ground_lines: GroundLines | None = None,
) -> SampledWalk:
    """Return the samples of a walk from the section state x, which ends at the first failure.

    Positions along the slope, m, are measured from the first landing. The energies in
    `HEIGHT_DEPENDENT_ENERGIES` decrease by `downslope_weight`, N, times the traveled distance. On
    uneven ground, `GroundLines.convert_to_walk_frame` replaces both conversions.
    """
    columns_by_step: list[dict[str, np.ndarray]] = []
    outcome, n_stepped, start_time, traveled_distance = Outcome.STEPPED, 0, 0.0, 0.0
    foothold = np.zeros(2)
    while outcome == Outcome.STEPPED and n_stepped < n_steps:
        sampled_step = trajectory_spec.sample_step(x, n_stepped)
        has_occurred, step_columns = sampled_step.durations > 0.0, dict[str, np.ndarray]()
        # A full slice copies nothing.
        occurred_selection = slice(None) if has_occurred.all() else has_occurred
        for name, values in sampled_step.columns.items():
            step_columns[name] = values[occurred_selection].reshape(-1, *values.shape[2:])
        if ground_lines is None:
            for name in trajectory_spec.slope_position_names:
                step_columns[name] = step_columns[name] + traveled_distance
            for name in step_columns.keys() & HEIGHT_DEPENDENT_ENERGIES:
                step_columns[name] = step_columns[name] - downslope_weight * traveled_distance
        else:
            ground_lines.convert_to_walk_frame(
                step_columns, trajectory_spec.slope_position_names, n_stepped, foothold
            )
            displacement = ground_lines.rotate_to_line_0(
                n_stepped, sampled_step.step_length, sampled_step.normal_rise
            )
            foothold = foothold + displacement
        step_columns["time"] = step_columns["time"] + start_time
        step_columns["step"] = np.full(len(step_columns["time"]), n_stepped)
        columns_by_step.append(step_columns)
        outcome = sampled_step.outcome
        if outcome == Outcome.STEPPED:
            n_stepped += 1
            start_time += sampled_step.period
            traveled_distance += sampled_step.step_length
            x = sampled_step.next_section_state
    columns = {
        name: np.concatenate([step_columns[name] for step_columns in columns_by_step])
        for name in columns_by_step[0]
    }
    return SampledWalk(columns, n_stepped, outcome)


@functools.cache
def _compile_step_sampling(
    model: AbstractWheel, structure: Any, n_samples: int
) -> Callable[..., Trajectory]:
    """Return the compiled function that samples a step from x and the leaves of its inputs."""

    def sample_paper_step(x: Array, *leaves: Array) -> Trajectory:
        params, options = jax.tree.unflatten(structure, leaves)
        return model.sample_step(params, x, options, n_samples)

    return jax.jit(sample_paper_step)


def _make_columns(s: Symbols, trajectory: Trajectory) -> dict[str, np.ndarray]:
    """Return the columns of a step by the names of `TRAJECTORY_MEASURES`, shape (phase, sample).

    Positions are relative to the foot of Leg 1. The columns `landing_foot_x` and `landing_foot_z`
    are added: the position of the foot of the leg that lands next, m.
    """
    theta, L1, L2, dtheta, dL1, dL2 = np.moveaxis(np.asarray(trajectory.state), -1, 0)
    kinetic, gravitational, elastic = np.moveaxis(np.asarray(trajectory.energy), -1, 0)
    forces = np.moveaxis(np.asarray(trajectory.forces), -1, 0)
    motion = Motion.from_angle(theta, L1, L2, dtheta, dL1, dL2)
    rear_leg = rear_direction(s, motion.sin, motion.cos)
    hub_x, hub_z, zeros = L1 * motion.sin, L1 * motion.cos, np.zeros_like(L1)
    landing_leg = landing_direction(s, motion.sin, motion.cos)
    return {
        "time": np.array(trajectory.time),
        "x": zeros,
        "z": zeros,
        "theta": theta,
        "L1": L1,
        "L2": L2,
        "dx": zeros,
        "dz": zeros,
        "dtheta": dtheta,
        "dL1": dL1,
        "dL2": dL2,
        **{f"lambda_{i + 1}": force for i, force in enumerate(forces)},
        "kinetic_energy": kinetic,
        "gravitational_energy": gravitational,
        "elastic_energy": elastic,
        "total_energy": kinetic + gravitational + elastic,
        "damping_power": damping_power(s, motion),
        "foot_1_x": zeros,
        "foot_1_z": zeros,
        "foot_2_x": hub_x - L2 * rear_leg.sin,
        "foot_2_z": hub_z - L2 * rear_leg.cos,
        "hub_x": hub_x,
        "hub_z": hub_z,
        "landing_foot_x": hub_x - s.L0 * landing_leg.sin,
        "landing_foot_z": hub_z - s.L0 * landing_leg.cos,
    }


StepWheels = list[tuple[Any, WheelParams]]
"""Model and wheel of each step, or one pair for all steps."""


def make_phase_spec(
    model_and_wheel_by_step: StepWheels, options: StepOptions, n_samples: int
) -> TrajectorySpec:
    """Return the specification of a trajectory for a model whose steps have the paper's phases."""

    def prepare_step(model: AbstractWheel, params: WheelParams) -> tuple:
        leaves, structure = jax.tree.flatten((params, options))
        s = jax.tree.map(float, split_slopes(params)[0]).symbols()
        return s, _compile_step_sampling(model, structure, n_samples), leaves

    prepared_steps = [prepare_step(*model_and_wheel) for model_and_wheel in model_and_wheel_by_step]

    def sample_paper_step(x: Array, k: int) -> SampledStep:
        s, sample_states, leaves = prepared_steps[k if len(prepared_steps) > 1 else 0]
        trajectory = sample_states(x, *leaves)
        columns, durations = _make_columns(s, trajectory), np.asarray(trajectory.durations)
        landing_foot = columns.pop("landing_foot_x"), columns.pop("landing_foot_z")
        columns["phase"] = np.tile(np.arange(len(durations))[:, None], (1, n_samples))
        occurred_phases = np.flatnonzero(durations > 0.0)
        step_length, normal_rise = 0.0, 0.0
        if occurred_phases.size:
            step_length, normal_rise = (float(x[occurred_phases[-1], -1]) for x in landing_foot)
        return SampledStep(
            columns,
            durations,
            Outcome(int(trajectory.outcome)),
            trajectory.section_state,
            float(durations.sum()),
            step_length,
            normal_rise,
        )

    attrs: dict[str, object] = {
        "frame": "x downhill along the slope, z normal to it, first foot at the origin",
        "start_meaning": "theta-, dtheta-, dL1- just before the first landing, rad, rad/s, m/s",
    }
    return TrajectorySpec(
        sample_paper_step, tuple(TRAJECTORY_MEASURES), PHASE_SLOPE_POSITIONS, {}, attrs
    )


PHASE_SLOPE_POSITIONS = ("x", "foot_1_x", "foot_2_x", "hub_x")
"""Names of the columns that are positions along the slope."""


CONTACT_MOTION_NAMES = ("time", "step", "hub_x", "hub_z", "theta", "dtheta")
CONTACT_ENERGY_NAMES = ("kinetic_energy", "gravitational_energy", "elastic_energy")


@eqx.filter_jit
def _make_contact_columns(
    model: Any, params: WheelParams, x: Array, options: StepOptions, n_samples: int
) -> tuple[UnilateralTrajectory, dict[str, Array]]:
    """Return the trajectory of a step and its columns, shape (phase, sample[, leg])."""
    s, trajectory = params.symbols(), model.sample_step(params, x, options, n_samples)

    def compute_state_quantities(y: PackedState) -> dict[str, Array]:
        """Return positions (m), rates and energies (J) of one state by column name."""
        motion, _ = unpack_state(y)
        directions = leg_directions(s, motion.theta)
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
            "foot_x": foot_positions(motion, directions),
            "foot_z": foot_heights(motion, directions),
        }

    columns = jax.vmap(jax.vmap(compute_state_quantities))(trajectory.state)
    return trajectory, columns | {"tangential": trajectory.tangential, "normal": trajectory.normal}


def make_contact_spec(
    model_and_wheel_by_step: StepWheels, options: StepOptions, n_samples: int
) -> TrajectorySpec:
    """Return the specification of a trajectory for a model with unilateral contact, over time and
    leg.

    Legs have the labels of their step. Each interval between two events has `n_samples` times,
    including both ends. For a `LadderWheel`, the variables `rung` and `reason` give the model used
    at each time and the reason (see `ModelChoice`).
    """

    frictions = [float(model.friction) for model, _ in model_and_wheel_by_step]
    n_legs = model_and_wheel_by_step[0][1].n_legs

    def sample_contact_step(x: Array, k: int) -> SampledStep:
        model_and_wheel = model_and_wheel_by_step[k if len(model_and_wheel_by_step) > 1 else 0]
        trajectory, columns = jax.tree.map(
            np.array, _make_contact_columns(*model_and_wheel, x, options, n_samples)
        )
        sample_shape = (len(trajectory.duration), n_samples)
        repeat_over_samples = lambda values_by_leg: np.repeat(
            values_by_leg[:, None], n_samples, axis=1
        )
        columns |= {"time": trajectory.time, "contact": repeat_over_samples(trajectory.contact)}
        columns |= {
            name: np.full(sample_shape, int(value))
            for name, value in trajectory.model_selection.items()
        }
        columns["on_stopper"] = repeat_over_samples(trajectory.locked)
        occurred_intervals = np.flatnonzero(trajectory.duration > 0.0)
        normal_rise = 0.0
        if occurred_intervals.size:  # The foremost foot has landed.
            normal_rise = float(columns["foot_z"][occurred_intervals[-1], -1, -1])
        return SampledStep(
            columns,
            trajectory.duration,
            Outcome(int(trajectory.outcome)),
            jnp.asarray(trajectory.section_state),
            float(trajectory.duration.sum()),
            float(trajectory.step_length),
            normal_rise,
        )

    attrs: dict[str, object] = {
        "frame": "x downhill along the slope, z normal to it, first landing at the origin",
        "friction": frictions[0] if len(set(frictions)) == 1 else frictions,
    }
    variable_names = (*CONTACT_MOTION_NAMES, *CONTACT_ENERGY_NAMES, *CONTACT_MEASURES)
    leg_coordinate = {"leg": np.arange(1, n_legs + 1)}
    return TrajectorySpec(
        sample_contact_step, variable_names, ("hub_x", "foot_x"), leg_coordinate, attrs
    )
