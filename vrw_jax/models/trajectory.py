"""Labeled trajectories of walks: motion, forces, energy and positions, with units and provenance.

The axis x points downhill along the slope, and z is normal to the slope. The origin is the first
foothold. Angles and leg labels refer to the present step, so theta and the lengths jump at a
landing.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from vrw_jax.base.checks import check_int, check_type, require_untraced_arguments
from vrw_jax.base.options import EngineName, StepOptions
from vrw_jax.base.progress import announce_wait
from vrw_jax.base.results import Outcome
from vrw_jax.base.results import xarray as xr
from vrw_jax.base.walker import check_parameters, is_own_walker, propose_starts
from vrw_jax.flow.extrema import StepForceExtrema, summarize_forces
from vrw_jax.flow.hybrid_system import HybridSystem, sample_walk_of_system
from vrw_jax.models.contact_mechanics import (
    compute_foot_heights,
    compute_foot_positions,
    compute_kinetic_energy,
    compute_leg_directions,
    compute_potential_energy,
)
from vrw_jax.models.contact_state import PackedState, unpack_state
from vrw_jax.models.interface import complete_ground_line_slopes, compute_rises
from vrw_jax.models.ladder import SELECTION_VARIABLE_ATTRIBUTES, collect_provenance_attributes
from vrw_jax.models.measures import (
    CONTACT_MEASURES,
    FORCE_PEAK_MEASURES,
    TRAJECTORY_MEASURES,
    make_labeled_variables,
    make_measure_attributes,
)
from vrw_jax.models.phase_sequence import select_stance_line
from vrw_jax.models.stepping import (
    ModelLike,
    SectionStateLike,
    convert_own_walk_arguments,
    convert_step_options,
    convert_walk_arguments,
)
from vrw_jax.models.unilateral_wheel import UnilateralTrajectory
from vrw_jax.wheel.dynamics import (
    Motion,
    compute_damping_power,
    rotate_to_landing_leg,
    rotate_to_rear_leg,
)
from vrw_jax.wheel.params import WheelParams
from vrw_jax.wheel.transitions import compute_line_slope


@announce_wait("gait steps and their samples", "5 s")
def simulate(
    params: Any,
    x: SectionStateLike | None = None,
    n_steps: int = 10,
    *,
    model: ModelLike | None = None,
    options: StepOptions | None = None,
    engine: EngineName = "auto",
    n_samples: int = 100,
    heights: Array | np.ndarray | Sequence[float] | None = None,
) -> xr.Dataset:
    """Simulate a walk from the section state `x` and return it as a labeled trajectory over time.

    If `x` is None, the walk begins at the default start of the model, near the gait of Table 1 of
    the paper. Uneven ground is specified as in `vrw.walk`. Positions are then in the frame of the
    first line of the ground, or of the mean line if heights are given. Angles and forces of a step
    are in the frame of the line under both feet in double support. The attribute `slopes` contains
    the slopes of all lines.

    Each phase has `n_samples` equidistant times, including both ends. A time at which a quantity
    jumps is therefore listed twice, with the values before and after the jump. A failed step ends
    the trajectory at the event, and the attributes `outcome` and `outcome_meaning` state the cause.
    Numerical errors are those of `vrw.step`.

    For a `HybridSystem`, `params` are its parameters. One that is an array has a value for each
    step. The variables are the coordinates of its state, one that is called "time" as "state_time",
    and `phase` is the number of the mode.

    Args:
        params: the wheel.
        x: section state (theta-, dtheta-, dL1-) just before touchdown, in rad, rad/s, m/s.
        n_steps: largest number of steps.
        model: the model; by default that of the paper, `ViscoelasticWheel()`. "auto" chooses the
            simplest valid model.
        options: numerical options of the steps.
        engine: engine that computes the steps; see `StepOptions`.
        n_samples: number of times per phase, including both ends, at least 2.
        heights: heights of the footholds above the mean line, as in `vrw.walk`, m.

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
    require_untraced_arguments("vrw.simulate", "use vrw.walk", params, x, heights, model, options)
    n_steps, n_samples = check_int("n_steps", n_steps), check_int("n_samples", n_samples, 2)
    if is_own_walker(model):
        options = convert_step_options(options).with_engine(engine)
        return _simulate_own_walker(params, x, n_steps, model, options, n_samples, heights)
    return _simulate_wheel(params, x, n_steps, model, options, engine, n_samples, heights)


def _simulate_wheel(
    given_params: Any,
    x: Any,
    n_steps: int,
    model: Any,
    options: Any,
    engine: EngineName,
    n_samples: int,
    heights: Any,
) -> xr.Dataset:
    params, x, model, options, stepwise_ground = convert_walk_arguments(
        given_params,
        x,
        n_steps,
        model,
        options,
        engine,
        heights,
        batch_remedy_text="simulate one at a time",
        allows_default_start=True,
    )
    s = jax.tree.map(float, params).symbols()
    ground = _make_ground(params, given_params.slope, heights, n_steps, model)
    models_and_wheels = [(model, params)] * n_steps
    if stepwise_ground is not None:
        models_and_wheels = [
            model.with_step_ground(params, step_ground)
            for step_ground in zip(*stepwise_ground, strict=True)
        ]
    specify = specify_contact_trajectory if model.reports_contacts else specify_phase_trajectory
    sample_step, variable_names, position_names, coordinates, attributes = specify(
        models_and_wheels, options, n_samples
    )
    columns, walked_slopes, n_stepped, outcome = sample_walk_steps(
        sample_step, position_names, x, n_steps, ground, float(s.Mt * s.g)
    )
    variables = make_labeled_variables({name: columns[name] for name in variable_names}, "time")
    for name in filter(columns.__contains__, SELECTION_VARIABLE_ATTRIBUTES):
        variables[name] = xr.Variable("time", columns[name], SELECTION_VARIABLE_ATTRIBUTES[name])
    attributes = {
        "title": f"Walk of the {type(model).__name__}",
        "n_steps": n_stepped,
        "outcome": outcome.name,
        "outcome_meaning": outcome.meaning,
        "start": np.asarray(x).tolist(),
        **attributes,
        **collect_provenance_attributes(params, model, options),
    }
    if heights is not None:
        heights = np.asarray(heights, float).tolist()
        attributes |= {"frame": HEIGHTS_FRAME_TEXT, "slopes": walked_slopes, "heights": heights}
    elif given_params.slope.ndim:
        slopes = [ground.find_line_slope(k, x) for k in range(n_steps + 1)]
        attributes |= {"frame": SLOPES_FRAME_TEXT, "slopes": slopes}
        del attributes["parameter_slope"]
    dataset = xr.Dataset(variables, coordinates, attributes)
    return dataset.set_coords(variables.keys() & {"step", "phase"})


def _make_ground(
    params: WheelParams, slope: Array, heights: Any, n_steps: int, model: Any
) -> TrajectoryGround:
    """Return the ground of a walk, for slopes of its lines or heights of its footholds."""
    if heights is None:
        line_slopes = slope if slope.ndim else jnp.full(n_steps, params.slope)
        slopes = np.asarray(complete_ground_line_slopes(line_slopes, n_steps), float)
        return TrajectoryGround(
            lambda k, _: float(slopes[k]), float(slopes[0]), 0.0, np.ptp(slopes) > 0.0
        )
    rises = np.asarray(compute_rises(jnp.asarray(heights), n_steps), float)
    return TrajectoryGround(
        lambda k, x: float(
            compute_line_slope(params.slope, rises[k], model.compute_foot_distance(params, x))
        ),
        float(params.slope),
        float(heights[-n_steps - 1]),
        True,
    )


def _simulate_own_walker(
    params: Any, x: Any, n_steps: int, walker: Any, options: Any, n_samples: int, heights: Any
) -> xr.Dataset:
    check_type(
        "model", walker, HybridSystem, "only its motion within a step is known; take vrw.walk"
    )
    first_params = jax.tree.map(lambda leaf: jnp.ravel(leaf)[0], check_parameters(params))
    x = propose_starts(walker, first_params)[0] if x is None else x
    params, x, _, options, stepwise = convert_own_walk_arguments(
        params, x, n_steps, walker, options, "auto", heights
    )
    params_of_steps = [params] * n_steps
    if stepwise is not None:
        params_of_steps = [
            walker.with_step_ground(params, jax.tree.map(operator.itemgetter(k), stepwise))[1]
            for k in range(n_steps)
        ]
    return sample_walk_of_system(walker, params_of_steps, x, options, n_samples)


SampledStep = tuple[dict[str, np.ndarray], np.ndarray, Outcome, Array]
"""Samples of one step in each interval between two events, by name, (interval, sample, ...),
durations of the intervals, s, outcome, and section state at the end of the step.

Times are in s since the landing. The duration of an interval that did not occur is 0. Besides the
variables of the trajectory, the samples contain `landing_foot_x` and `landing_foot_z`. Their last
values are the position (m) at which the next foot lands.
"""


HEIGHT_DEPENDENT_ENERGIES = ("gravitational_energy", "total_energy")
"""Energies that depend on the height of the reference point, which is the origin of positions."""


ANGLES_FRAME_TEXT = (
    "angles and forces: along and normal to the line under both feet of the step's double support"
)
SLOPES_FRAME_TEXT = (
    "positions: x downhill along line 0, z normal to it, first foot at the origin; "
    + ANGLES_FRAME_TEXT
)
HEIGHTS_FRAME_TEXT = (
    "positions: x downhill along the mean line, z above it, first foot at x = 0; "
    + ANGLES_FRAME_TEXT
)
"""Text for the attribute `frame` of a trajectory on ground with given heights."""


class TrajectoryGround(NamedTuple):
    """Ground of a trajectory, and the frame of its positions."""

    # of the line under both feet, from the index of the step and its section state, rad
    find_line_slope: Callable[[int, Array], float]
    frame_slope: float  # rad
    first_height: float  # normal component of the first foothold, m
    is_uneven: bool

    def rotate_to_frame(self, line_slope: float, x: Any, z: Any) -> tuple[Any, Any]:
        """Return the components of a vector, given those along and normal to a line."""
        angle_from_frame = line_slope - self.frame_slope
        sine_of_angle, cosine_of_angle = np.sin(angle_from_frame), np.cos(angle_from_frame)
        return x * cosine_of_angle + z * sine_of_angle, z * cosine_of_angle - x * sine_of_angle


def sample_walk_steps(
    sample_step: Callable[[Array, int], SampledStep],
    slope_position_names: tuple[str, ...],
    x: Array,
    n_steps: int,
    ground: TrajectoryGround,
    wheel_weight: float,
) -> tuple[dict[str, np.ndarray], list[float], int, Outcome]:
    """Return samples of the walk from the section state x. The walk ends at the first failed step.

    Return also the slopes of the lines under the feet (rad), the number of completed steps and the
    outcome of the last step. The samples have the shape (time, ...); they are empty if no interval
    occurred.

    The samples of a step are in the frame of the line of the ground under both feet in double
    support. Positions (m) and energies (J) are converted to the frame of the ground.

    - `sample_step`, `slope_position_names`: see `specify_phase_trajectory`;
    - `wheel_weight`: weight of the wheel, N.
    """
    columns_by_step = []
    walk_outcome, k, step_start_time = Outcome.STEPPED, 0, 0.0
    foothold_x, foothold_z = 0.0, ground.first_height
    line_slopes = [ground.find_line_slope(0, x)]
    while walk_outcome == Outcome.STEPPED and k < n_steps:
        samples_by_name, durations, walk_outcome, next_x = sample_step(x, k)
        has_occurred = durations > 0.0
        occurred_intervals = (
            slice(None) if has_occurred.all() else has_occurred
        )  # slices copy nothing
        columns = {
            name: samples[occurred_intervals].reshape(-1, *samples.shape[2:])
            for name, samples in samples_by_name.items()
        }
        landing_foot_x = columns.pop("landing_foot_x")
        landing_foot_z = columns.pop("landing_foot_z")
        for name in slope_position_names:
            normal_name = f"{name[:-1]}z"
            position_x, position_z = ground.rotate_to_frame(
                line_slopes[k], columns[name], columns[normal_name]
            )
            columns[name], columns[normal_name] = position_x + foothold_x, position_z + foothold_z
        for name in columns.keys() & HEIGHT_DEPENDENT_ENERGIES:
            foothold_height = foothold_z * np.cos(ground.frame_slope) - foothold_x * np.sin(
                ground.frame_slope
            )
            columns[name] = columns[name] + wheel_weight * foothold_height
        columns["time"] = columns["time"] + step_start_time
        columns["step"] = np.full(len(columns["time"]), k)
        columns_by_step.append(columns)
        if walk_outcome == Outcome.STEPPED:
            # On even ground, the height of a foot that lands is a numerical error.
            displacement_x, displacement_z = ground.rotate_to_frame(
                line_slopes[k],
                float(landing_foot_x[-1]),
                float(landing_foot_z[-1]) * ground.is_uneven,
            )
            foothold_x, foothold_z = foothold_x + displacement_x, foothold_z + displacement_z
            k += 1
            step_start_time += float(durations.sum())
            x = next_x
            line_slopes.append(ground.find_line_slope(k, x))
    walk_columns = {
        name: np.concatenate([columns[name] for columns in columns_by_step])
        for name in columns_by_step[0]
    }
    return walk_columns, line_slopes, k, walk_outcome


_sample_step = eqx.filter_jit(lambda model, *arguments: model.sample_step(*arguments))


StepwiseModelsAndWheels = list[tuple[Any, WheelParams]]
"""Model and wheel for each step."""


def specify_phase_trajectory(
    models_and_wheels: StepwiseModelsAndWheels, options: StepOptions, n_samples: int
) -> tuple:
    """Return how to sample the steps of a model that has the paper's phases.

    The result is (function that samples the step from a section state with an index, names of the
    measures over time, names of the positions along the slope, additional coordinates of the
    dataset, its attributes).
    """

    def sample_phase_step(x: Array, k: int) -> SampledStep:
        step_model, step_params = models_and_wheels[k]
        trajectory = _sample_step(step_model, step_params, x, options, n_samples)
        step_params = step_model.attach_laws(step_params)
        s = jax.tree.map(float, select_stance_line(step_params, x)[0]).symbols()
        phase_durations = np.asarray(trajectory.durations)
        state, energies, foot_forces = (
            np.moveaxis(np.asarray(samples), -1, 0)
            for samples in (trajectory.state, trajectory.energy, trajectory.forces)
        )
        motion = Motion.from_angle(*state)
        rear_leg_direction = rotate_to_rear_leg(s, motion.sin_theta, motion.cos_theta)
        landing_leg_direction = rotate_to_landing_leg(s, motion.sin_theta, motion.cos_theta)
        # Positions are relative to the foot of Leg 1.
        hub_x, hub_z = motion.L1 * motion.sin_theta, motion.L1 * motion.cos_theta
        zero_names = ("x", "z", "dx", "dz", "foot_1_x", "foot_1_z")
        step_columns = {
            **dict.fromkeys(zero_names, np.zeros_like(hub_x)),
            **dict(zip(("theta", "L1", "L2", "dtheta", "dL1", "dL2"), state, strict=True)),
            "time": np.array(trajectory.time),
            **{f"lambda_{i + 1}": foot_force for i, foot_force in enumerate(foot_forces)},
            **dict(zip(ENERGY_NAMES, energies, strict=True)),
            "total_energy": sum(energies),
            "damping_power": np.asarray(compute_damping_power(s, motion)),
            "foot_2_x": hub_x - motion.L2 * rear_leg_direction.sin,
            "foot_2_z": hub_z - motion.L2 * rear_leg_direction.cos,
            "hub_x": hub_x,
            "hub_z": hub_z,
            "landing_foot_x": hub_x - s.L0 * landing_leg_direction.sin,
            "landing_foot_z": hub_z - s.L0 * landing_leg_direction.cos,
            "phase": np.tile(np.arange(len(phase_durations))[:, None], (1, n_samples)),
        }
        outcome = Outcome(int(trajectory.outcome))
        return step_columns, phase_durations, outcome, trajectory.section_state

    return (
        sample_phase_step,
        tuple(TRAJECTORY_MEASURES),
        ("x", "foot_1_x", "foot_2_x", "hub_x"),
        {},
        {
            "frame": "x downhill along the slope, z normal to it, first foot at the origin",
            "start_meaning": "theta-, dtheta-, dL1- just before the first landing, rad, rad/s, m/s",
        },
    )


CONTACT_MOTION_NAMES = ("time", "step", "hub_x", "hub_z", "theta", "dtheta")
ENERGY_NAMES = ("kinetic_energy", "gravitational_energy", "elastic_energy")


@eqx.filter_jit
def _compute_contact_columns(
    model: Any, params: WheelParams, x: Array, options: StepOptions, n_samples: int
) -> tuple[UnilateralTrajectory, dict[str, Array]]:
    """Compute a step with unilateral contact, and return its trajectory and its sampled variables.

    The samples have the shape (phase, sample) or (phase, sample, leg).
    """
    params = model.attach_laws(params)
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
) -> tuple:
    """Return how to sample the steps of a model with unilateral contact, as
    `specify_phase_trajectory` does.

    Its variables are over time and leg. Leg labels are those of the current step. Each interval
    between two events has `n_samples` times, including both ends. For a `LadderWheel`, the
    variables `rung` and `reason` contain the codes of the model and of the reason at each time (see
    `ModelChoice`).
    """

    friction_by_step = [float(model.friction) for model, _ in models_and_wheels]

    def sample_contact_step(x: Array, k: int) -> SampledStep:
        trajectory, step_columns = jax.tree.map(
            np.array, _compute_contact_columns(*models_and_wheels[k], x, options, n_samples)
        )
        sample_shape = (len(trajectory.duration), n_samples)
        repeat_over_samples = lambda values_by_leg: np.repeat(
            values_by_leg[:, None], n_samples, axis=1
        )
        step_columns |= {
            "time": trajectory.time,
            "contact": repeat_over_samples(trajectory.contact),
            "on_stopper": repeat_over_samples(trajectory.locked),
            "landing_foot_x": np.full(sample_shape, trajectory.step_length),
            "landing_foot_z": step_columns["foot_z"][..., -1],  # The foremost foot has landed.
        }
        step_columns |= {
            variable_name: np.full(sample_shape, int(model_selection_code))
            for variable_name, model_selection_code in trajectory.model_selection.items()
        }
        outcome = Outcome(int(trajectory.outcome))
        return step_columns, trajectory.duration, outcome, jnp.asarray(trajectory.section_state)

    return (
        sample_contact_step,
        (*CONTACT_MOTION_NAMES, *ENERGY_NAMES, *CONTACT_MEASURES),
        ("hub_x", "foot_x"),
        {"leg": np.arange(1, models_and_wheels[0][1].n_legs + 1)},
        {
            "frame": "x downhill along the slope, z normal to it, first landing at the origin",
            "friction": friction_by_step[0]
            if len(set(friction_by_step)) == 1
            else friction_by_step,
        },
    )


SPLINE_DEGREE = 7
"""Degree of the spline through the samples of an interval. The value is chosen because the spline's
error with the default number of samples is that of the solver.
"""


MIN_EXTREMUM_HEIGHT_FRACTION = 1e-7
"""Smallest height of an extremum above or below its neighborhood, as a fraction of the largest
force. The value is chosen because errors of the solver would otherwise be extrema of a constant
force.
"""


SAMPLED_FORCE_PEAK_MEASURES = tuple(
    name for name in FORCE_PEAK_MEASURES if name != "landing_impulse"
)
"""Measures of the peaks of the normal force between impacts."""


@announce_wait("samples of gait steps", "10 s")
def force_peaks(walk: xr.Dataset) -> xr.Dataset:
    """Return the peaks of the normal force in each step of a walk that `vrw.simulate` returned.

    A peak is a smooth maximum of the force on the fore foot, Leg 1, between two events. Impacts and
    changes of phase or contact are not peaks, but the largest force may occur there. Peaks are
    located on a spline of degree 7 through the samples of each interval. For gaits, the method
    `measures` of the result of `vrw.limit_cycle` returns the same measures without samples, and
    with derivatives.

    Args:
        walk: a trajectory with at least 9 samples per phase.

    Returns:
        A dataset of the force measures over `step`. Its variables `force`, `force_time`,
        `force_step` and `is_maximum` over `extremum` describe the extrema of the fore foot's force.

    Raises:
        TypeError, ValueError: an invalid argument, described in one sentence.

    Examples:
        >>> wheel = vrw.parameter_sets["two_peaks"].params
        >>> start = vrw.limit_cycle(wheel).section_state
        >>> peaks = vrw.force_peaks(vrw.simulate(wheel, start, n_steps=1))
        >>> peaks.n_force_peaks.values, peaks.force.values.round(2)
        (array([2]), array([223.2 , 133.5 , 158.84]))
    """
    check_type("walk", walk, xr.Dataset, "give the result of vrw.simulate")
    if "lambda_2" in walk:
        fore_force, rear_force = walk.lambda_2.values, walk.lambda_4.values
        total_force = fore_force + rear_force
    elif "normal" in walk:
        fore_force, total_force = walk.normal.values[:, 0], walk.normal.values.sum(1)
    else:
        raise ValueError(
            f"walk holds {', '.join(map(str, walk)) or 'nothing'}, but no normal force of the "
            "feet: give the result of vrw.simulate."
        )
    sample_times, sample_steps = walk.time.values, walk.step.values
    if not len(sample_times):
        raise ValueError(
            f"the walk has no samples, because its outcome is {walk.attrs.get('outcome')}: give a "
            "walk that leaves its start."
        )
    # The time of an event is listed twice, up to round-off.
    time_roundoff = 4.0 * np.finfo(float).eps * np.max(sample_times)
    is_interval_end = (np.diff(sample_times) <= time_roundoff) | (np.diff(sample_steps) != 0)
    interval_starts = np.flatnonzero(is_interval_end) + 1
    sampled_intervals = np.split(np.arange(len(sample_times)), interval_starts)
    n_samples, min_samples = max(map(len, sampled_intervals)), SPLINE_DEGREE + 2
    if n_samples < min_samples:
        raise ValueError(
            f"the phases of the walk have {n_samples} samples, but its peaks need at least "
            f"{min_samples}: give simulate(..., n_samples={min_samples}) or more."
        )
    step_indices = np.unique(sample_steps)
    fore_force_extrema, measures_by_step = [], []
    for step_index in step_indices:
        intervals_of_step = [
            sample_indices
            for sample_indices in sampled_intervals
            if len(sample_indices) == n_samples and sample_steps[sample_indices[0]] == step_index
        ]
        extrema = [
            _find_force_extrema(sample_times, force, intervals_of_step)._replace(
                other_forces=force[sample_steps == step_index]
            )
            for force in (fore_force, total_force)
        ]
        fore_force_extrema.append(extrema[0])
        measures_by_step.append(summarize_forces(np, *extrema))
    dataset_variables = {
        name: ("step", np.array([x[name] for x in measures_by_step]), make_measure_attributes(name))
        for name in SAMPLED_FORCE_PEAK_MEASURES
    }
    extremum_times, extremum_forces, is_maximum, *_ = map(
        np.concatenate, zip(*fore_force_extrema, strict=True)
    )
    step_index_by_extremum = np.repeat(
        step_indices, [len(extrema.times) for extrema in fore_force_extrema]
    )
    dataset_variables |= {
        "force": ("extremum", extremum_forces, make_measure_attributes("lambda_2")),
        "force_time": ("extremum", extremum_times, make_measure_attributes("time")),
        "force_step": ("extremum", step_index_by_extremum, make_measure_attributes("step")),
        "is_maximum": ("extremum", is_maximum, {"long_name": "whether a maximum"}),
    }
    return xr.Dataset(dataset_variables, {"step": step_indices}, dict(walk.attrs))


def _find_force_extrema(
    sample_times: np.ndarray,
    sampled_forces: np.ndarray,
    sample_indices_by_interval: list[np.ndarray],
) -> StepForceExtrema:
    """Return the extrema of a force within the intervals between the events of one step.

    - `sample_indices_by_interval`: indices of the samples in each interval between two events.
    """
    from scipy.interpolate import PPoly, make_interp_spline  # This import is slow.

    extrema_by_interval = [(np.zeros(0), np.zeros(0), np.zeros(0, bool))]
    rate_maxima_by_interval = [(np.zeros(0), np.zeros(0))]

    def find_interior_roots(polynomial: Any) -> np.ndarray:
        roots = PPoly.from_spline(polynomial).roots()
        return roots[(roots > 0.0) & (roots < 1.0)]

    min_extremum_height = MIN_EXTREMUM_HEIGHT_FRACTION * np.max(np.abs(sampled_forces))
    for sample_indices in sample_indices_by_interval:
        if np.ptp(sampled_forces[sample_indices]) < min_extremum_height:
            continue
        interval_sample_times = sample_times[sample_indices]
        interval_start, interval_duration = interval_sample_times[0], np.ptp(interval_sample_times)
        time_fractions = (interval_sample_times - interval_start) / interval_duration
        force_spline = make_interp_spline(
            time_fractions, sampled_forces[sample_indices], SPLINE_DEGREE
        )
        extremum_fractions = find_interior_roots(force_spline.derivative(1))
        forces_at_extrema_and_ends = force_spline(
            np.concatenate([[0.0], extremum_fractions, [1.0]])
        )
        force_changes = np.abs(np.diff(forces_at_extrema_and_ends))
        extremum_fractions = extremum_fractions[
            np.minimum(force_changes[:-1], force_changes[1:]) > min_extremum_height
        ]
        extrema_by_interval.append(
            (
                interval_start + interval_duration * extremum_fractions,
                force_spline(extremum_fractions),
                force_spline(extremum_fractions, 2) < 0.0,
            )
        )
        rate_maximum_fractions = find_interior_roots(force_spline.derivative(2))
        rate_maximum_fractions = rate_maximum_fractions[
            force_spline(rate_maximum_fractions, 3) < 0.0
        ]
        rate_maxima_by_interval.append(
            (
                interval_start + interval_duration * rate_maximum_fractions,
                force_spline(rate_maximum_fractions, 1) / interval_duration,
            )
        )
    times, forces, is_maximum = map(np.concatenate, zip(*extrema_by_interval, strict=True))
    rate_times, rate_maxima = map(np.concatenate, zip(*rate_maxima_by_interval, strict=True))
    return StepForceExtrema(
        times, forces, is_maximum, ~is_maximum, rate_times, rate_maxima, rate_times > 0.0, ()
    )
