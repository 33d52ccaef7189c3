"""Labeled trajectories of walks: motion, forces, energy and positions, with units and provenance.

The axis x points downhill along the slope, and z is normal to the slope. The origin is the first
foothold. Angles and leg labels refer to the present step, so theta and the lengths jump at a
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
    compute_foot_heights,
    compute_foot_positions,
    compute_kinetic_energy,
    compute_leg_directions,
    compute_potential_energy,
    unpack_state,
)
from vrw_jax.measures import CONTACT_MEASURES, TRAJECTORY_MEASURES, make_labeled_variables
from vrw_jax.measures import xarray as xr
from vrw_jax.models import (
    AbstractWheel,
    Trajectory,
    complete_ground_line_slopes,
    separate_next_slope,
)
from vrw_jax.numerics import EngineName, StepOptions, with_default_jax_settings
from vrw_jax.selection import SELECTION_VARIABLE_ATTRIBUTES
from vrw_jax.simulation.provenance import collect_provenance_attributes
from vrw_jax.simulation.stepping import (
    ModelLike,
    SectionStateLike,
    convert_step_arguments,
    require_single_wheel,
    split_stepwise_ground,
)
from vrw_jax.validation import check_int, require_untraced_arguments
from vrw_jax.wheel import (
    Motion,
    Outcome,
    Symbols,
    WheelParams,
    compute_damping_power,
    rotate_to_landing_leg,
    rotate_to_rear_leg,
)


@with_default_jax_settings
def simulate(
    params: WheelParams,
    x: SectionStateLike | None = None,
    n_steps: int = 10,
    *,
    model: ModelLike | None = None,
    options: StepOptions | None = None,
    engine: EngineName = "auto",
    n_samples: int = 100,
) -> xr.Dataset:
    """Simulate a walk from the section state `x` and return it as a labeled trajectory over time.

    If `x` is None, the walk begins at the default start of the model, near the gait of Table 1 of
    the paper. Uneven ground is specified as in `vrw.walk`. Positions are then in the frame of the
    first line of the ground. Angles and forces of a step are in the frame of the line under both
    feet in double support. The attribute `line_slopes` contains the slopes of all lines.

    Each phase has `n_samples` equidistant times, including both ends. A time at which a quantity
    jumps is therefore listed twice, with the values before and after the jump. A failed step ends
    the trajectory at the event, and the attributes `outcome` and `outcome_meaning` state the cause.
    Numerical errors are those of `vrw.step`.

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
        A dataset over `time` with coordinates, rates, foot positions, forces and energies, and
        their units. With unilateral contact, some variables also have the dimension `leg`.

    Raises:
        TypeError, ValueError: if an argument is invalid; the message names the remedy.

    Examples:
        >>> walk = vrw.simulate(vrw.WheelParams(damping=150.0), n_steps=1)
        >>> walk.lambda_2.attrs["units"], walk.attrs["outcome"]
        ('N', 'STEPPED')
    """
    require_untraced_arguments("vrw.simulate", "use vrw.walk", params, x)
    n_steps, n_samples = check_int("n_steps", n_steps), check_int("n_samples", n_samples, 2)
    params_with_all_slopes = params
    checked_model, params, stepwise_ground = split_stepwise_ground(params, model, n_steps)
    require_single_wheel(params, "simulate one at a time")
    start_state = checked_model.compute_default_start(params) if x is None else x
    params, x, model, options = convert_step_arguments(
        params, start_state, checked_model, options, engine
    )
    specify_trajectory = (
        specify_contact_trajectory if model.reports_contacts else specify_phase_trajectory
    )
    s, models_and_wheels, ground_lines = (
        jax.tree.map(float, params).symbols(),
        [(model, params)],
        None,
    )
    if stepwise_ground is not None:
        ground_by_step = zip(
            *(step_ground.astype(x.dtype) for step_ground in stepwise_ground), strict=True
        )
        models_and_wheels = [
            model.with_step_ground(params, step_ground) for step_ground in ground_by_step
        ]
        ground_line_slopes = params_with_all_slopes.slope
        ground_line_slopes = (
            ground_line_slopes if ground_line_slopes.ndim else jnp.full(n_steps, ground_line_slopes)
        )
        ground_line_slopes = complete_ground_line_slopes(ground_line_slopes, n_steps)
        ground_lines = UnevenGroundLines(np.asarray(ground_line_slopes, float), float(s.Mt * s.g))
    trajectory_spec = specify_trajectory(models_and_wheels, options, n_samples)
    sampled_walk = sample_walk_steps(
        trajectory_spec, x, n_steps, float(s.Mt * s.g * s.sin_phi), ground_lines
    )
    sampled_columns = sampled_walk.sampled_columns
    dataset_variables = make_labeled_variables(
        {
            variable_name: sampled_columns[variable_name]
            for variable_name in trajectory_spec.variable_names
        },
        "time",
    )
    for variable_name in filter(sampled_columns.__contains__, SELECTION_VARIABLE_ATTRIBUTES):
        dataset_variables[variable_name] = xr.Variable(
            "time", sampled_columns[variable_name], SELECTION_VARIABLE_ATTRIBUTES[variable_name]
        )
    walk_attributes = {
        "title": f"Walk of the {type(model).__name__}",
        "n_steps": sampled_walk.n_stepped,
        "outcome": sampled_walk.outcome.name,
        "outcome_meaning": sampled_walk.outcome.meaning,
        "start": np.asarray(x).tolist(),
    }
    provenance_attributes = trajectory_spec.dataset_attributes | collect_provenance_attributes(
        params, model, options
    )
    if ground_lines is not None:
        provenance_attributes |= {
            "frame": UNEVEN_GROUND_FRAME_TEXT,
            "slopes": ground_lines.ground_line_slopes.tolist(),
        }
        del provenance_attributes["parameter_slope"]
    dataset_index_coordinates = {
        variable_name: dataset_variables.pop(variable_name)
        for variable_name in ("step", "phase")
        if variable_name in dataset_variables
    }
    return xr.Dataset(
        dataset_variables,
        trajectory_spec.extra_coordinates | dataset_index_coordinates,
        walk_attributes | provenance_attributes,
    )


class SampledStep(NamedTuple):
    """Samples of one step in each interval between two events."""

    sampled_columns: dict[str, np.ndarray]  # (interval, sample, ...), time in s since the landing
    durations: np.ndarray  # duration of each interval, s; 0 if it did not occur
    outcome: Outcome
    next_section_state: Array  # section state at the end of the step
    period: float  # s
    step_length: float  # distance of the landings along the step's line, m
    landing_normal_offset: float  # landing distance normal to that line, m; 0 on flat ground


class TrajectorySpecification(NamedTuple):
    """Function that samples a step of a model, and the names and attributes of trajectory
    variables.
    """

    step_sampler: Callable[[Array, int], SampledStep]  # arguments: section state, step index
    variable_names: tuple[str, ...]  # names of the measures over time
    slope_position_names: tuple[str, ...]  # names of the positions along the slope
    extra_coordinates: dict[str, Any]  # additional coordinates of the dataset
    dataset_attributes: dict[str, object]


class SampledWalk(NamedTuple):
    """Samples of a walk, and the outcome of the last step of the walk."""

    sampled_columns: dict[
        str, np.ndarray
    ]  # (time, ...), with `step`; empty if no interval occurred
    n_stepped: int
    outcome: Outcome


HEIGHT_DEPENDENT_ENERGIES = ("gravitational_energy", "total_energy")
"""Energies that depend on the height of the reference point, which is the first foothold of the
walk.
"""


UNEVEN_GROUND_FRAME_TEXT = (
    "positions: x downhill along line 0, z normal to it, first foot at the origin; angles and "
    "forces: along and normal to the line under both feet of the step's double support"
)
"""Text for the attribute `frame` of a trajectory on uneven ground."""


class UnevenGroundLines(NamedTuple):
    """Slopes of all lines of uneven ground, and the weight of the wheel."""

    ground_line_slopes: np.ndarray  # rad
    wheel_weight: float  # N

    def convert_to_walk_frame(
        self,
        step_columns: dict[str, np.ndarray],
        position_variable_names: Sequence[str],
        k: int,
        foothold: np.ndarray,
    ) -> None:
        """Convert the positions (m) and energies (J) in step k to the frame of line 0 of the
        ground.

        The arrays in `step_columns` are replaced by converted arrays. Before the conversion, they
        are in the frame of the line of the ground under both feet in double support.

        - `step_columns`: sampled variables of the step, by name;
        - `position_variable_names`: names of the variables that are positions along the slope;
        - `k`: index of the step;
        - `foothold`: position of the first foot of step k in the frame of line 0, m.
        """
        for sampled_column_name in position_variable_names:
            normal_column_name = f"{sampled_column_name[:-1]}z"
            x, z = self.rotate_to_line_0(
                k, step_columns[sampled_column_name], step_columns[normal_column_name]
            )
            step_columns[sampled_column_name], step_columns[normal_column_name] = (
                x + foothold[0],
                z + foothold[1],
            )
        first_ground_line_slope = self.ground_line_slopes[0]
        foothold_height = foothold[1] * np.cos(first_ground_line_slope) - foothold[0] * np.sin(
            first_ground_line_slope
        )
        for sampled_column_name in step_columns.keys() & HEIGHT_DEPENDENT_ENERGIES:
            step_columns[sampled_column_name] = (
                step_columns[sampled_column_name] + self.wheel_weight * foothold_height
            )

    def rotate_to_line_0(self, k: int, x: Any, z: Any) -> tuple[Any, Any]:
        """Return the components of a vector in the frame of line 0 of the ground.

        - `k`: index of the line of the ground in whose frame x and z are components of the vector.
        """
        angle_from_line_0 = self.ground_line_slopes[k] - self.ground_line_slopes[0]
        sine_of_angle, cosine_of_angle = np.sin(angle_from_line_0), np.cos(angle_from_line_0)
        return x * cosine_of_angle + z * sine_of_angle, z * cosine_of_angle - x * sine_of_angle


def sample_walk_steps(
    trajectory_spec: TrajectorySpecification,
    x: Array,
    n_steps: int,
    downslope_weight: float,
    ground_lines: UnevenGroundLines | None = None,
) -> SampledWalk:
    """Return samples of the walk from the section state x. The walk ends at the first failed step.

    Positions along the slope (m) are measured from the first foothold.

    - `downslope_weight`: component of the weight parallel to the slope, N. On flat ground, the
      energies in `HEIGHT_DEPENDENT_ENERGIES` decrease by this weight times the traveled distance;
    - `ground_lines`: slopes of uneven ground, or None on flat ground. On uneven ground,
      `UnevenGroundLines.convert_to_walk_frame` converts positions and energies.
    """
    sampled_columns_by_step: list[dict[str, np.ndarray]] = []
    walk_outcome, n_stepped, step_start_time, traveled_distance = Outcome.STEPPED, 0, 0.0, 0.0
    foothold_position = np.zeros(2)
    while walk_outcome == Outcome.STEPPED and n_stepped < n_steps:
        sampled_step = trajectory_spec.step_sampler(x, n_stepped)
        has_interval_occurred, step_columns = sampled_step.durations > 0.0, dict[str, np.ndarray]()
        # A full slice copies nothing.
        occurred_interval_selection = (
            slice(None) if has_interval_occurred.all() else has_interval_occurred
        )
        for sampled_column_name, column_samples in sampled_step.sampled_columns.items():
            step_columns[sampled_column_name] = column_samples[occurred_interval_selection].reshape(
                -1, *column_samples.shape[2:]
            )
        if ground_lines is None:
            for sampled_column_name in trajectory_spec.slope_position_names:
                step_columns[sampled_column_name] = (
                    step_columns[sampled_column_name] + traveled_distance
                )
            for sampled_column_name in step_columns.keys() & HEIGHT_DEPENDENT_ENERGIES:
                step_columns[sampled_column_name] = (
                    step_columns[sampled_column_name] - downslope_weight * traveled_distance
                )
        else:
            ground_lines.convert_to_walk_frame(
                step_columns, trajectory_spec.slope_position_names, n_stepped, foothold_position
            )
            foothold_displacement = ground_lines.rotate_to_line_0(
                n_stepped, sampled_step.step_length, sampled_step.landing_normal_offset
            )
            foothold_position = foothold_position + foothold_displacement
        step_columns["time"] = step_columns["time"] + step_start_time
        step_columns["step"] = np.full(len(step_columns["time"]), n_stepped)
        sampled_columns_by_step.append(step_columns)
        walk_outcome = sampled_step.outcome
        if walk_outcome == Outcome.STEPPED:
            n_stepped += 1
            step_start_time += sampled_step.period
            traveled_distance += sampled_step.step_length
            x = sampled_step.next_section_state
    walk_columns = {
        sampled_column_name: np.concatenate(
            [step_columns[sampled_column_name] for step_columns in sampled_columns_by_step]
        )
        for sampled_column_name in sampled_columns_by_step[0]
    }
    return SampledWalk(walk_columns, n_stepped, walk_outcome)


@functools.cache
def _compile_step_sampler(
    model: AbstractWheel, argument_structure: Any, n_samples: int
) -> Callable[..., Trajectory]:
    """Return a compiled function that samples a step.

    Its arguments are the section state and the leaves of (params, options), whose pytree structure
    is `argument_structure`.
    """

    def sample_paper_step(x: Array, *argument_leaves: Array) -> Trajectory:
        params, options = jax.tree.unflatten(argument_structure, argument_leaves)
        return model.sample_step(params, x, options, n_samples)

    return jax.jit(sample_paper_step)


def _make_phase_columns(s: Symbols, trajectory: Trajectory) -> dict[str, np.ndarray]:
    """Return the samples of each trajectory variable in a step, by name, shape (phase, sample).

    The names are those of `TRAJECTORY_MEASURES`. Positions are relative to the foot of Leg 1. Two
    additional entries, `landing_foot_x` and `landing_foot_z`, contain the position (m) of the foot
    that lands next.
    """
    theta, L1, L2, dtheta, dL1, dL2 = np.moveaxis(np.asarray(trajectory.state), -1, 0)
    kinetic_energy, gravitational_energy, elastic_energy = np.moveaxis(
        np.asarray(trajectory.energy), -1, 0
    )
    foot_forces = np.moveaxis(np.asarray(trajectory.forces), -1, 0)
    wheel_motion = Motion.from_angle(theta, L1, L2, dtheta, dL1, dL2)
    rear_leg_direction = rotate_to_rear_leg(s, wheel_motion.sin_theta, wheel_motion.cos_theta)
    hub_x, hub_z, zero_coordinates = (
        L1 * wheel_motion.sin_theta,
        L1 * wheel_motion.cos_theta,
        np.zeros_like(L1),
    )
    landing_leg_direction = rotate_to_landing_leg(s, wheel_motion.sin_theta, wheel_motion.cos_theta)
    return {
        "time": np.array(trajectory.time),
        "x": zero_coordinates,
        "z": zero_coordinates,
        "theta": theta,
        "L1": L1,
        "L2": L2,
        "dx": zero_coordinates,
        "dz": zero_coordinates,
        "dtheta": dtheta,
        "dL1": dL1,
        "dL2": dL2,
        **{f"lambda_{i + 1}": foot_force for i, foot_force in enumerate(foot_forces)},
        "kinetic_energy": kinetic_energy,
        "gravitational_energy": gravitational_energy,
        "elastic_energy": elastic_energy,
        "total_energy": kinetic_energy + gravitational_energy + elastic_energy,
        "damping_power": compute_damping_power(s, wheel_motion),
        "foot_1_x": zero_coordinates,
        "foot_1_z": zero_coordinates,
        "foot_2_x": hub_x - L2 * rear_leg_direction.sin,
        "foot_2_z": hub_z - L2 * rear_leg_direction.cos,
        "hub_x": hub_x,
        "hub_z": hub_z,
        "landing_foot_x": hub_x - s.L0 * landing_leg_direction.sin,
        "landing_foot_z": hub_z - s.L0 * landing_leg_direction.cos,
    }


StepwiseModelsAndWheels = list[tuple[Any, WheelParams]]
"""Model and wheel for each step, or one pair for all steps."""


def specify_phase_trajectory(
    models_and_wheels: StepwiseModelsAndWheels, options: StepOptions, n_samples: int
) -> TrajectorySpecification:
    """Return the trajectory specification for a model whose steps have the paper's phases."""

    def prepare_step_sampler(model: AbstractWheel, params: WheelParams) -> tuple:
        argument_leaves, argument_structure = jax.tree.flatten((params, options))
        s = jax.tree.map(float, separate_next_slope(params)[0]).symbols()
        return s, _compile_step_sampler(model, argument_structure, n_samples), argument_leaves

    prepared_samplers = [
        prepare_step_sampler(*step_model_and_wheel) for step_model_and_wheel in models_and_wheels
    ]

    def sample_phase_step(x: Array, k: int) -> SampledStep:
        s, step_sampler, argument_leaves = prepared_samplers[k if len(prepared_samplers) > 1 else 0]
        trajectory = step_sampler(x, *argument_leaves)
        step_columns, phase_durations = (
            _make_phase_columns(s, trajectory),
            np.asarray(trajectory.durations),
        )
        landing_foot_columns = (
            step_columns.pop("landing_foot_x"),
            step_columns.pop("landing_foot_z"),
        )
        step_columns["phase"] = np.tile(np.arange(len(phase_durations))[:, None], (1, n_samples))
        occurred_phase_indices = np.flatnonzero(phase_durations > 0.0)
        step_length, landing_normal_offset = 0.0, 0.0
        if occurred_phase_indices.size:
            step_length, landing_normal_offset = (
                float(x[occurred_phase_indices[-1], -1]) for x in landing_foot_columns
            )
        return SampledStep(
            step_columns,
            phase_durations,
            Outcome(int(trajectory.outcome)),
            trajectory.section_state,
            float(phase_durations.sum()),
            step_length,
            landing_normal_offset,
        )

    dataset_attributes: dict[str, object] = {
        "frame": "x downhill along the slope, z normal to it, first foot at the origin",
        "start_meaning": "theta-, dtheta-, dL1- just before the first landing, rad, rad/s, m/s",
    }
    return TrajectorySpecification(
        sample_phase_step,
        tuple(TRAJECTORY_MEASURES),
        POSITION_NAMES_ALONG_SLOPE,
        {},
        dataset_attributes,
    )


POSITION_NAMES_ALONG_SLOPE = ("x", "foot_1_x", "foot_2_x", "hub_x")
"""Names of the variables that are positions along the slope."""


CONTACT_MOTION_NAMES = ("time", "step", "hub_x", "hub_z", "theta", "dtheta")
CONTACT_ENERGY_NAMES = ("kinetic_energy", "gravitational_energy", "elastic_energy")


@eqx.filter_jit
def _compute_contact_columns(
    model: Any, params: WheelParams, x: Array, options: StepOptions, n_samples: int
) -> tuple[UnilateralTrajectory, dict[str, Array]]:
    """Compute a step with unilateral contact, and return its trajectory and its sampled variables.

    The samples have the shape (phase, sample) or (phase, sample, leg).
    """
    s, trajectory = params.symbols(), model.sample_step(params, x, options, n_samples)

    def compute_state_quantities(y: PackedState) -> dict[str, Array]:
        """Return positions (m), rates and energies (J) for one state, by the name of the
        variable.
        """
        wheel_motion, _ = unpack_state(y)
        leg_directions_of_state = compute_leg_directions(s, wheel_motion.theta)
        gravitational_energy, elastic_energy = compute_potential_energy(s, wheel_motion)
        return {
            "hub_x": wheel_motion.x,
            "hub_z": wheel_motion.z,
            "theta": wheel_motion.theta,
            "dtheta": wheel_motion.dtheta,
            "kinetic_energy": compute_kinetic_energy(s, wheel_motion),
            "gravitational_energy": gravitational_energy,
            "elastic_energy": elastic_energy,
            "length": wheel_motion.L,
            "length_rate": wheel_motion.dL,
            "foot_x": compute_foot_positions(wheel_motion, leg_directions_of_state),
            "foot_z": compute_foot_heights(wheel_motion, leg_directions_of_state),
        }

    state_quantities = jax.vmap(jax.vmap(compute_state_quantities))(trajectory.state)
    return trajectory, state_quantities | {
        "tangential": trajectory.tangential,
        "normal": trajectory.normal,
    }


def specify_contact_trajectory(
    models_and_wheels: StepwiseModelsAndWheels, options: StepOptions, n_samples: int
) -> TrajectorySpecification:
    """Return the trajectory specification for a model with unilateral contact.

    Its variables are over time and leg. Leg labels are those of the current step. Each interval
    between two events has `n_samples` times, including both ends. For a `LadderWheel`, the
    variables `rung` and `reason` contain the codes of the model and of the reason at each time (see
    `ModelChoice`).
    """

    friction_by_step = [float(model.friction) for model, _ in models_and_wheels]
    n_legs = models_and_wheels[0][1].n_legs

    def sample_contact_step(x: Array, k: int) -> SampledStep:
        step_model_and_wheel = models_and_wheels[k if len(models_and_wheels) > 1 else 0]
        trajectory, step_columns = jax.tree.map(
            np.array, _compute_contact_columns(*step_model_and_wheel, x, options, n_samples)
        )
        sample_shape = (len(trajectory.duration), n_samples)
        leg_value_repeater = lambda values_by_leg: np.repeat(
            values_by_leg[:, None], n_samples, axis=1
        )
        step_columns |= {
            "time": trajectory.time,
            "contact": leg_value_repeater(trajectory.contact),
        }
        step_columns |= {
            variable_name: np.full(sample_shape, int(model_selection_code))
            for variable_name, model_selection_code in trajectory.model_selection.items()
        }
        step_columns["on_stopper"] = leg_value_repeater(trajectory.locked)
        occurred_interval_indices = np.flatnonzero(trajectory.duration > 0.0)
        landing_normal_offset = 0.0
        if occurred_interval_indices.size:  # The foremost foot has landed.
            landing_normal_offset = float(
                step_columns["foot_z"][occurred_interval_indices[-1], -1, -1]
            )
        return SampledStep(
            step_columns,
            trajectory.duration,
            Outcome(int(trajectory.outcome)),
            jnp.asarray(trajectory.section_state),
            float(trajectory.duration.sum()),
            float(trajectory.step_length),
            landing_normal_offset,
        )

    dataset_attributes: dict[str, object] = {
        "frame": "x downhill along the slope, z normal to it, first landing at the origin",
        "friction": friction_by_step[0] if len(set(friction_by_step)) == 1 else friction_by_step,
    }
    variable_names = (*CONTACT_MOTION_NAMES, *CONTACT_ENERGY_NAMES, *CONTACT_MEASURES)
    leg_number_coordinate = {"leg": np.arange(1, n_legs + 1)}
    return TrajectorySpecification(
        sample_contact_step,
        variable_names,
        ("hub_x", "foot_x"),
        leg_number_coordinate,
        dataset_attributes,
    )
