"""The paper's step from landing to landing, for any engine that integrates its phases.

An engine provides a `PhaseRunner`, which integrates one phase to its end. This module determines
which phases occur, where they start, when the step ends, and the results of the step. All functions
work elementwise, for one wheel or for a batch.
"""

import functools
import itertools
import operator
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from vrw_jax.base.elementwise import (
    Elementwise,
    Vector,
    compute_sine_cosine,
    select_trees_by_condition,
)
from vrw_jax.base.options import StepOptions
from vrw_jax.base.results import Outcome
from vrw_jax.base.walker import AdvanceResult
from vrw_jax.flow.integrate import PhaseEnd
from vrw_jax.flow.phase_integration import (
    GuardsAndMargins,
    PhaseKinks,
    StateArray,
    VectorField,
    integrate_phase,
)
from vrw_jax.models.step_results import (
    PAPER_START_STATE,
    DoubleSupportIndicators,
    EnergyLoss,
    Margins,
    RequiredFriction,
    SectionStateEntries,
    StepResult,
    Trajectory,
)
from vrw_jax.wheel import dynamics, transitions
from vrw_jax.wheel.dynamics import Motion
from vrw_jax.wheel.laws import compute_motor_work
from vrw_jax.wheel.params import (
    MAX_SI_VALUE,
    PARAMETER_DOMAINS,
    Symbols,
    WheelParams,
    compute_wheel_units,
)
from vrw_jax.wheel.phases import (
    PAPER_PHASES,
    AbstractPhase,
    PhaseInstant,
    PhaseMargins,
    make_paper_phases,
)
from vrw_jax.wheel.transitions import (
    GroundAhead,
    Landing,
    compute_foot_distance,
    compute_foot_distance_for_length,
    compute_line_slope,
    replace_rest_outcome,
)

FALLBACK_SINGLE_SUPPORT_STATE = (-0.3, 0.9, 0.95, 1.0, 0.0, 0.0)
"""Regular posture (theta, L1, L2 and their rates) that replaces the state of a wheel after a failed
step. This state is never integrated.
"""


PhaseRunner = Callable[
    [AbstractPhase, Vector, Vector, Array, tuple[PhaseEnd, Array] | None], PhaseEnd
]
"""Function that integrates one phase. Its arguments are the phase, its start (q, v), the mask of
active elements, and the end of the previous phase with its mask. It returns the end of the phase,
whose `state` begins with q and v. It equals the start if the phase was not active.
"""


class PhaseSequenceResult(NamedTuple):
    """Starts and ends of all phases of a step, and the outcome of the step."""

    s: Symbols
    step_start_landing: Landing
    phases: tuple[AbstractPhase, ...]
    phase_start_states: tuple[tuple[Vector, Vector], ...]
    phase_end_results: tuple[PhaseEnd, ...]
    has_phase_occurred: tuple[Bool[Array, "..."], ...]
    outcome: Int[Array, "..."]  # an Outcome
    ground_ahead: GroundAhead | None = None  # None on flat ground


def run_step_phases(
    phase_runner: PhaseRunner,
    params: WheelParams,
    x: SectionStateEntries,
    options: StepOptions,
    stop_at_lift_off: bool,
    landing_function: Callable[..., Landing] = transitions.resolve_landing,
) -> PhaseSequenceResult:
    """Integrate all phases of one walking step from the section state `x`, and return the results.

    `x` contains one array per entry. The motion is in the frame of the line of the ground under
    both feet in double support. On uneven ground (see `select_stance_line`), the section state at
    the end refers to the next line of the ground.

    - `phase_runner`: engine that integrates a phase;
    - `landing_function`: function that computes the landing at the beginning of the step.
    """
    params, is_valid_step, ground_ahead = select_stance_line(params, x)
    params, x = replace_invalid_inputs(is_valid_step, params, x, PAPER_START_STATE)
    s = params.symbols()
    landing_result = landing_function(s, *x)
    ground_values: Vector = ()
    if ground_ahead is not None:
        rise = () if ground_ahead.rise is None else (ground_ahead.rise,)
        ground_values = (*compute_sine_cosine(ground_ahead.tilt), *rise)
    step_phases = make_paper_phases(
        s, landing_result.foot_distance, stop_at_lift_off, ground_values
    )
    # A landing that releases the rear foot continues in SLS-I.
    is_double_support_active = is_valid_step & landing_result.is_rear_foot_planted
    run_results = _run_phases(
        phase_runner,
        step_phases,
        landing_result.theta_after_landing,
        landing_result.motion_after,
        is_valid_step,
        is_double_support_active,
        options,
    )
    return PhaseSequenceResult(s, landing_result, step_phases, *run_results, ground_ahead)


def _run_phases(
    phase_runner: PhaseRunner,
    phases: tuple[AbstractPhase, ...],
    wheel_angle: Elementwise,
    wheel_motion: Motion,
    is_valid_step: Array,
    is_phase_active: Array,
    options: StepOptions,
) -> tuple[tuple[tuple[Vector, Vector], ...], tuple[PhaseEnd, ...], tuple[Array, ...], Array]:
    """Integrate the phases of a step from a motion in the first of them, to the end of the step.

    Return the starts and ends of the phases, whether each phase occurred, and the outcome, as in
    `PhaseSequenceResult`.

    - `is_valid_step`: whether the inputs are valid, so that a step takes place;
    - `is_phase_active`: whether the first phase takes place.
    """
    step_outcome = jnp.where(
        is_valid_step, jnp.int32(Outcome.STEPPED), jnp.int32(Outcome.BAD_INPUT)
    )
    phase_start_states, has_phase_occurred = [], []
    phase_end_results: list[PhaseEnd] = []
    previous_end = None
    fallback_theta, *fallback_lengths_and_rates = (
        jnp.asarray(state_component, jnp.result_type(wheel_angle))
        for state_component in FALLBACK_SINGLE_SUPPORT_STATE
    )
    fallback_state = (
        fallback_theta,
        Motion.from_angle(fallback_theta, *fallback_lengths_and_rates),
    )
    for previous_phase, phase in zip((None, *phases), phases, strict=False):
        if previous_phase is not None:
            q, v, *_ = phase_end_results[-1].state
            end_state = q[0], previous_phase.compute_motion(q, v)
            wheel_angle, wheel_motion = select_trees_by_condition(
                is_phase_active, end_state, (wheel_angle, wheel_motion)
            )
            # Until a phase fails, the outcome is STEPPED.
            is_phase_active = step_outcome == Outcome.STEPPED
            wheel_angle, wheel_motion = select_trees_by_condition(
                is_phase_active, (wheel_angle, wheel_motion), fallback_state
            )
            wheel_motion = previous_phase.reset_motion(wheel_motion)
        start_state = phase.select_phase_coordinates(wheel_angle, wheel_motion)
        phase_end = phase_runner(phase, *start_state, is_phase_active, previous_end)
        previous_end = phase_end, is_phase_active
        phase_outcome = phase.select_guard_outcome(
            phase_end.end_guard_index, phase_end.is_timed_out
        )
        if phase.can_come_to_rest:
            q, v, *_ = phase_end.state
            is_at_rest = phase.is_at_rest(q, v, options.atol)
            phase_outcome = replace_rest_outcome(phase_outcome, is_at_rest)
        step_outcome = jnp.where(is_phase_active, phase_outcome, step_outcome)
        phase_start_states.append(start_state)
        phase_end_results.append(phase_end)
        # The start of the last phase is itself an event: Leg 2 hits its stopper.
        has_phase_occurred.append(
            is_phase_active if phase is phases[-1] else is_phase_active & (phase_end.duration > 0.0)
        )
    starts, ends = tuple(phase_start_states), tuple(phase_end_results)
    return starts, ends, tuple(has_phase_occurred), step_outcome


def finish_gait_step(
    phase_runner: PhaseRunner,
    params: WheelParams,
    phase_index: int,
    foot_distance: Elementwise,
    phase_state: Vector,
    options: StepOptions,
    stop_at_lift_off: bool,
    engine: str,
) -> AdvanceResult:
    """Compute the rest of a step on flat ground, starting from a state within one of its phases.

    - `phase_runner`: function that integrates a phase;
    - `phase_index`: index of the phase in the step;
    - `foot_distance`: distance between the two feet in the double support of this step, m;
    - `phase_state`: (theta, L1, L2) and their rates. Entries that the constraints of the phase
      determine are ignored;
    - `engine`: name of the engine, which the result reports.
    """
    is_valid_state = is_valid_phase_state(params, phase_state, foot_distance)
    params, phase_state = replace_invalid_inputs(
        is_valid_state, params, phase_state, FALLBACK_SINGLE_SUPPORT_STATE
    )
    phases = make_paper_phases(params.symbols(), foot_distance, stop_at_lift_off)
    _, phase_end_results, _, step_outcome = _run_phases(
        phase_runner,
        phases[phase_index:],
        phase_state[0],
        Motion.from_angle(*phase_state),
        is_valid_state,
        is_valid_state,
        options,
    )
    q, v, *_ = phase_end_results[-1].state
    return _collect_advance_result((q[0], *v), phase_end_results, step_outcome, engine)


def make_advance_result(phase_sequence: PhaseSequenceResult, engine: str) -> AdvanceResult:
    """Return the section state after a step, the durations and the outcome.

    All entries of the section state are 0 after a failed step. The angle is measured in the frame
    of the line of the ground at the next landing. The result reports the name `engine`.
    """
    phase_end_results = phase_sequence.phase_end_results
    q, touchdown_rates, *_ = phase_end_results[2].state
    touchdown_angle = q[0]
    if phase_sequence.ground_ahead is not None:
        foot_distance = compute_foot_distance_for_length(phase_sequence.s, q[1])
        touchdown_angle = touchdown_angle - phase_sequence.ground_ahead.compute_next_line_tilt(
            foot_distance
        )
    section_state = touchdown_angle, *touchdown_rates
    return _collect_advance_result(section_state, phase_end_results, phase_sequence.outcome, engine)


def _collect_advance_result(
    section_state: Vector,
    phase_end_results: Sequence[PhaseEnd],
    step_outcome: Array,
    engine: str,
) -> AdvanceResult:
    """Return the result of a step that ends in `section_state`, or in zeros if it failed.

    Phases before the start of the motion have a duration of 0.
    """
    n_omitted_phases = len(PAPER_PHASES) - len(phase_end_results)
    has_stepped = step_outcome == Outcome.STEPPED
    durations = [phase_end.duration for phase_end in phase_end_results]
    solver_steps = [phase_end.solver_steps for phase_end in phase_end_results]
    return AdvanceResult(
        section_state=jnp.stack([jnp.where(has_stepped, x, 0.0) for x in section_state]),
        durations=jnp.stack([jnp.zeros_like(durations[0])] * n_omitted_phases + durations),
        outcome=step_outcome,
        solver_steps=functools.reduce(operator.add, solver_steps),
        engine=engine,
    )


def make_step_result(
    phase_sequence: PhaseSequenceResult, friction: Elementwise | float, engine: str
) -> StepResult:
    """Return all results of a step, for one wheel or for a batch.

    The phase results must contain the minima of the margins. The result reports the name `engine`.

    - `friction`: friction coefficient of the ground, for the friction margins.
    """
    s, landing_result = phase_sequence.s, phase_sequence.step_start_landing
    phase_end_results = phase_sequence.phase_end_results
    has_step_begun = phase_sequence.outcome != Outcome.BAD_INPUT
    has_stopper_collision = phase_sequence.has_phase_occurred[2]
    zero_unless_begun = lambda x: jnp.where(has_step_begun, x, 0.0)
    dls_phase, sls1_phase, sls2_phase = make_paper_phases(
        s, landing_result.foot_distance, stop_at_lift_off=True
    )
    liftoff_motion = dls_phase.compute_motion(*phase_end_results[0].state[:2])
    state_before_stopper = tuple(
        jnp.where(has_stopper_collision, x, jnp.asarray(fallback_value, x.dtype))
        for x, fallback_value in zip(
            itertools.chain(*phase_end_results[1].state[:2]),
            FALLBACK_SINGLE_SUPPORT_STATE,
            strict=True,
        )
    )
    stopper_collision = transitions.resolve_stopper_collision(
        s, sls1_phase.compute_motion(state_before_stopper[:3], state_before_stopper[3:])
    )
    motion_at_step_end = sls2_phase.compute_motion(*phase_end_results[2].state[:2])
    initial_energy, final_energy = (
        dynamics.compute_mechanical_energy(s, m).total_energy
        for m in (landing_result.motion_after, motion_at_step_end)
    )
    damping_loss = initial_energy - final_energy - stopper_collision.energy_loss
    if s.hub_torque is not None:
        turned_angle = phase_end_results[2].state[0][0] - landing_result.theta_after_landing
        damping_loss = damping_loss + compute_motor_work(s, turned_angle)
    fore_force, rear_force = transitions.compute_landing_forces(s, landing_result)
    advance_result = make_advance_result(phase_sequence, engine)
    margins, required_friction = _make_margins_and_required_friction(
        phase_sequence, rear_force, liftoff_motion, stopper_collision, friction
    )
    return StepResult(
        section_state=advance_result.section_state,
        post_impact=zero_unless_begun(
            jnp.stack([landing_result.theta_after_landing, landing_result.motion_after.dtheta])
        ),
        durations=advance_result.durations,
        step_length=zero_unless_begun(landing_result.foot_distance),
        indicators=DoubleSupportIndicators(
            lambda_I4=zero_unless_begun(landing_result.rear_impulse.normal),
            lambda_2=zero_unless_begun(fore_force.normal),
            lambda_4=zero_unless_begun(rear_force.normal),
        ),
        margins=margins,
        required_friction=required_friction,
        energy=EnergyLoss(
            landing=zero_unless_begun(landing_result.energy_loss),
            stopper=jnp.where(has_stopper_collision, stopper_collision.energy_loss, 0.0),
            damping=jnp.where(phase_sequence.outcome == Outcome.STEPPED, damping_loss, 0.0),
        ),
        outcome=advance_result.outcome,
        solver_steps=advance_result.solver_steps,
        engine=engine,
    )


def make_trajectory(
    phase_sequence: PhaseSequenceResult, sample_phase: Callable[..., Array], options: StepOptions
) -> Trajectory:
    """Return the trajectory of a step, computed from samples at equidistant times of each phase.

    - `sample_phase`: function of a phase, its start, its duration and options that returns samples,
      with axes (sample, coordinates and rates, ...).
    """
    phase_samples = [
        sample_phase(
            phase,
            *start,
            phase_end.duration,
            compute_wheel_units(phase.s).scale_times_to_seconds(options),
        )
        for phase, start, phase_end in zip(
            phase_sequence.phases,
            phase_sequence.phase_start_states,
            phase_sequence.phase_end_results,
            strict=True,
        )
    ]
    advance_result = make_advance_result(phase_sequence, "")
    phase_durations, n_samples = advance_result.durations, len(phase_samples[0])
    start_times = jnp.stack(
        [0.0 * phase_durations[0], phase_durations[0], phase_durations[0] + phase_durations[1]]
    )
    time_fractions = jnp.linspace(0.0, 1.0, n_samples).reshape(
        -1, *(1 for _ in phase_durations.shape[1:])
    )
    quantities_by_phase = [
        jax.vmap(functools.partial(evaluate_phase_states, phase))(phase_states)
        for phase, phase_states in zip(phase_sequence.phases, phase_samples, strict=True)
    ]
    phase_states, foot_forces, phase_energies = map(
        jnp.stack, zip(*quantities_by_phase, strict=True)
    )
    sample_times = start_times[:, None] + time_fractions * phase_durations[:, None]
    return Trajectory(
        sample_times,
        phase_states,
        foot_forces,
        phase_energies,
        advance_result.section_state,
        phase_durations,
        advance_result.outcome,
    )


def evaluate_phase_states(phase: AbstractPhase, phase_states: Array) -> tuple[Array, Array, Array]:
    """Return coordinates and rates, ground forces (N) and energies (J) for given states of a phase.

    - `phase_states`: coordinates of the phase, then their rates, on the first axis. The first axis
      of each result holds its components; the other axes are those of `phase_states`.
    """
    wheel_motion = phase.unpack_motion(phase_states)
    phase_instant = PhaseInstant(phase, wheel_motion, None)
    zero_force = 0.0 * wheel_motion.L1
    rear_force = phase_instant.rear_force or dynamics.FootForce(zero_force, zero_force)
    return (
        jnp.stack([phase_states[0], *wheel_motion.lengths_and_rates]),
        jnp.stack([*phase_instant.fore_force, *rear_force]),
        jnp.stack(dynamics.compute_mechanical_energy(phase.s, wheel_motion)),
    )


def _make_margins_and_required_friction(
    phase_sequence: PhaseSequenceResult,
    rear_force: dynamics.FootForce,
    liftoff_motion: Motion,
    stopper_collision: transitions.StopperCollision,
    friction: Elementwise | float,
) -> tuple[Margins, RequiredFriction]:
    """Return the margins of one step, and the friction coefficients that its feet need.

    - `rear_force`: force on the rear foot just after the landing, N;
    - `liftoff_motion`: motion at the end of double support;
    - `stopper_collision`: collision of Leg 2 with its stopper.
    """
    s, landing_result = phase_sequence.s, phase_sequence.step_start_landing
    has_phase_occurred = phase_sequence.has_phase_occurred
    has_step_begun = phase_sequence.outcome != Outcome.BAD_INPUT
    has_stopper_collision = has_phase_occurred[2]
    phase_minima = [
        PhaseMargins.from_margin_values(tuple(phase_end.margin_minima), s.n)
        for phase_end in phase_sequence.phase_end_results
        if phase_end.margin_minima is not None
    ]

    def find_lowest_margin(margin_name: str, *phase_indices: int) -> Array:
        """Return the lowest minimum of a margin over the phases that occurred.

        It is 0 if none occurred, or if the minimum is not finite, as in a step that failed.
        """
        lowest_margin: Any = jnp.inf
        for phase_index in phase_indices:
            phase_minimum = jnp.asarray(getattr(phase_minima[phase_index], margin_name))
            lowest_margin = jnp.minimum(
                lowest_margin, jnp.where(has_phase_occurred[phase_index], phase_minimum, jnp.inf)
            )
        return jnp.where(jnp.isfinite(lowest_margin), lowest_margin, 0.0)

    def compute_required_friction(foot_force: dynamics.FootForce, is_foot_loaded: Array) -> Array:
        return jnp.where(is_foot_loaded, dynamics.compute_required_friction(foot_force), 0.0)

    stopper_impulse = stopper_collision.foot_impulse
    required_friction = RequiredFriction.from_parts(
        fore=0.0 - find_lowest_margin("friction", 0, 1, 2),
        rear=compute_required_friction(rear_force, has_phase_occurred[0]),
        landing_fore=compute_required_friction(landing_result.fore_impulse, has_step_begun),
        landing_rear=compute_required_friction(
            landing_result.rear_impulse, has_step_begun & landing_result.is_rear_foot_planted
        ),
        stopper=jnp.where(
            has_stopper_collision & (stopper_impulse.normal <= 0.0),
            jnp.inf,
            compute_required_friction(stopper_impulse, has_stopper_collision),
        ),
    )
    subtract_from_friction = lambda required_coefficient: jnp.where(
        has_step_begun, friction - required_coefficient, 0.0
    )
    compute_locked_stopper_impulses = lambda impact, has_impact_occurred: jnp.where(
        has_impact_occurred,
        transitions.compute_locked_leg_impulses(s, impact.motion_after, impact.hub_velocity_jump),
        0.0,
    )
    margins = Margins(
        fore_foot_force=find_lowest_margin("fore_foot_force", 0, 1, 2),
        takeoff_acceleration=jnp.where(
            has_phase_occurred[1] & landing_result.is_rear_foot_planted,
            dynamics.compute_takeoff_acceleration(s, liftoff_motion),
            0.0,
        ),
        clearance_sls1=find_lowest_margin("rear_clearance", 1),
        clearance_sls2=find_lowest_margin("rear_clearance", 2),
        locked_stopper_force=find_lowest_margin("locked_stopper_force", 0, 1, 2),
        rear_stopper_force=find_lowest_margin("rear_stopper_force", 2),
        contraction=find_lowest_margin("contraction", 0, 1, 2),
        friction_fore=subtract_from_friction(required_friction.fore),
        friction_rear=subtract_from_friction(required_friction.rear),
        landing_stopper_impulse=compute_locked_stopper_impulses(landing_result, has_step_begun),
        hit_stopper_impulse=compute_locked_stopper_impulses(
            stopper_collision, has_stopper_collision
        ),
        hit_planted_impulse=jnp.where(has_stopper_collision, stopper_impulse.normal, 0.0),
        landing_friction_fore=subtract_from_friction(required_friction.landing_fore),
        landing_friction_rear=subtract_from_friction(required_friction.landing_rear),
    )
    return margins, required_friction


def is_valid_start_state(params: WheelParams, x: SectionStateEntries) -> Array:
    """Return whether the parameters and the start state are valid.

    They are valid if all values are finite and within their domains, and if the wheel rolls
    forward. NaN gives False.
    """
    wheel_angle, angular_rate = x[0], x[1]
    is_angle_in_range = (jnp.abs(wheel_angle) < 0.5 * jnp.pi) & (
        jnp.abs(wheel_angle - params.leg_angle) < 0.5 * jnp.pi
    )
    # In single precision the bound would overflow, with a warning.
    max_entry = min(MAX_SI_VALUE, float(jnp.finfo(jnp.result_type(angular_rate)).max))
    are_entries_bounded = functools.reduce(
        operator.and_, [jnp.abs(state_entry) < max_entry for state_entry in x]
    )
    return params.is_in_domain() & are_entries_bounded & is_angle_in_range & (angular_rate > 0.0)


def is_valid_phase_state(
    params: WheelParams, phase_state: Vector, foot_distance: Elementwise
) -> Array:
    """Return whether a step can go on from a state within one of its phases; False for NaN."""
    are_inputs_bounded = [jnp.abs(x) < MAX_SI_VALUE for x in (*phase_state, foot_distance)]
    is_angle_in_range = jnp.abs(phase_state[0]) < 0.5 * jnp.pi
    return params.is_in_domain() & functools.reduce(
        operator.and_, are_inputs_bounded, is_angle_in_range
    )


def replace_invalid_inputs(
    is_valid_start: Array,
    params: WheelParams,
    x: SectionStateEntries,
    fallback_state: Any,
) -> tuple[WheelParams, Any]:
    """Return the parameters and the start state, with invalid inputs replaced.

    The wheel of Table 1 of the paper and `fallback_state` replace them. The replacement prevents
    NaN in the step and its derivatives.
    """
    return jax.tree.map(
        lambda given_value, valid_input_value: jnp.where(
            is_valid_start, given_value, jnp.asarray(valid_input_value, given_value.dtype)
        ),
        (params, x),
        (params.make_table_1_wheel(), fallback_state),
    )


def is_slope_in_domain(slope: Elementwise) -> Array:
    """Return whether a slope (rad) lies in the allowed domain. NaN gives False."""
    return jnp.asarray(PARAMETER_DOMAINS["slope"].contains_parameter_value(slope))


def select_stance_line(
    params: WheelParams, x: SectionStateEntries
) -> tuple[WheelParams, Array, GroundAhead | None]:
    """Return the wheel on the line under both feet, the validity of the step, and the ground ahead.

    A step may start only if parameters, start and ground are valid. On flat ground, the slope has
    as many axes as the other parameters, and the ground ahead is None. On uneven ground, the slope
    has a leading axis: the slopes of this line and of the next one, or the mean slope and two
    rises. These are the heights of the foothold on which the step begins, and of the next one, each
    minus the height of the foothold before.
    """
    if jnp.ndim(params.slope) == jnp.ndim(params.damping):
        return params, is_valid_start_state(params, x), None
    first_slope, *other_values = params.slope
    replace_slope = lambda slope: eqx.tree_at(lambda wheel: wheel.slope, params, slope)
    if len(other_values) == 1:
        params, next_slope = replace_slope(first_slope), other_values[0]
        is_valid_step = is_valid_start_state(params, x) & is_slope_in_domain(next_slope)
        tilt = jnp.where(is_valid_step, next_slope - params.slope, 0.0)
        return params, is_valid_step, GroundAhead(tilt)
    rise, next_rise = other_values
    theta = jnp.where(jnp.abs(x[0]) < 0.5 * jnp.pi, x[0], 0.0)
    foot_distance = compute_foot_distance(replace_slope(first_slope).symbols(), theta)
    params = replace_slope(find_stance_slope(first_slope, rise, foot_distance))
    is_valid_step = is_valid_start_state(params, x) & (jnp.abs(next_rise) < MAX_SI_VALUE)
    mask_invalid = lambda value: jnp.where(is_valid_step, value, 0.0)
    ground_ahead = GroundAhead(mask_invalid(first_slope - params.slope), mask_invalid(next_rise))
    return params, is_valid_step, ground_ahead


def find_stance_slope(
    mean_slope: Elementwise, rise: Elementwise, foot_distance: Elementwise
) -> Elementwise:
    """Return the slope of the line under both feet, rad, or an invalid slope if the rise exceeds
    the distance of the feet.
    """
    is_rise_possible = jnp.abs(rise) < foot_distance
    possible_rise = jnp.where(is_rise_possible, rise, 0.0)
    slope = compute_line_slope(mean_slope, possible_rise, foot_distance)
    return jnp.where(is_rise_possible, slope, IMPOSSIBLE_SLOPE)


IMPOSSIBLE_SLOPE = jnp.pi
"""Slope outside the domain of slopes, so that a step on it is BAD_INPUT, rad."""


class ElementPhase(NamedTuple):
    """Equations of first order of a phase of one wheel. The state y = (q, v) is one vector."""

    motion_unpacker: Callable[[StateArray], Motion]
    vector_field: VectorField
    guards: GuardsAndMargins
    kinks: PhaseKinks | None


def make_element_phase(phase: AbstractPhase, records_margins: bool) -> ElementPhase:
    """Return the functions of a phase that `flow.phase_integration` calls.

    - `records_margins`: whether the integrator also evaluates margins.
    """

    def evaluate_vector_field(y: StateArray) -> StateArray:
        accelerations = phase.solve_acceleration(phase.unpack_motion(y))
        return jnp.stack([*y[phase.n_dof :], *accelerations[: phase.n_dof]])

    def evaluate_guards_and_margins(y: StateArray) -> Array:
        phase_instant = PhaseInstant(phase, phase.unpack_motion(y), None)
        margins = phase.compute_margins(phase_instant) if records_margins else ()
        return jnp.stack([*phase.compute_guards(phase_instant), *margins])

    guards_and_margins = GuardsAndMargins(
        evaluate_guards_and_margins,
        len(phase.all_guard_outcomes) - phase.n_kinks,
        phase.are_margins_counted_at_start if records_margins else (),
    )

    def enter_sides(sides: Vector) -> tuple[VectorField, Callable]:
        functions = make_element_phase(phase.on_sides(sides), records_margins)
        return functions.vector_field, functions.guards.evaluate_guards_and_margins

    return ElementPhase(
        phase.unpack_motion,
        evaluate_vector_field,
        guards_and_margins,
        PhaseKinks(lambda y: phase.compute_kinks(phase.unpack_motion(y)), enter_sides)
        if phase.n_kinks
        else None,
    )


def make_element_phase_runner(options: StepOptions, records_margins: bool) -> PhaseRunner:
    """Return a function that integrates one phase of one wheel to its end.

    diffrax takes the steps of implicit solvers, and of all solvers with `engine="diffrax"`.
    """

    def run_phase(
        phase: AbstractPhase, q: Vector, v: Vector, is_phase_active: Array, _: Any
    ) -> PhaseEnd:
        element_phase = make_element_phase(phase, records_margins)
        phase_end = integrate_phase(
            element_phase.vector_field,
            element_phase.guards,
            jnp.stack([*q, *v]),
            is_phase_active,
            compute_wheel_units(phase.s).scale_times_to_seconds(options),
            jnp.stack(phase.coordinate_units),
            element_phase.kinks,
        )
        y = tuple(phase_end.state)
        return phase_end._replace(
            state=(y[: phase.n_dof], y[phase.n_dof :]),
            margin_minima=phase_end.margin_minima if records_margins else None,
        )

    return run_phase
