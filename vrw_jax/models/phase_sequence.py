"""The paper's step from landing to landing, for any engine that integrates its phases.

An engine provides a `PhaseRunner`, which integrates one phase to its end. This module determines
the phases that take place, their starts, the end of the step and its results. All functions work
elementwise, for one wheel or a batch.
"""

import functools
import operator
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from vrw_jax.models.step_inputs import PAPER_START, StateValues, replace_invalid, select_stance_line
from vrw_jax.models.step_results import (
    AdvanceResult,
    DoubleSupportIndicators,
    EnergyLoss,
    Margins,
    StepResult,
    Trajectory,
)
from vrw_jax.numerics import Elementwise, StepOptions, Vector, sine_cosine, tree_where
from vrw_jax.wheel import (
    MAX_SI_VALUE,
    AbstractPhase,
    Landing,
    Motion,
    Outcome,
    PhaseInstant,
    PhaseMargins,
    Symbols,
    WheelParams,
    dynamics,
    make_phases,
    replace_rest_outcome,
    transitions,
)

SAFE_SINGLE_SUPPORT_STATE = (-0.3, 0.9, 0.95, 1.0, 0.0, 0.0)
"""Regular posture (theta, L1, L2 and rates) in place of the state of a wheel whose step has failed.
This state is never integrated."""


class PhaseResult(NamedTuple):
    """End of a phase; equal to its start if the phase was not active."""

    q: Vector
    v: Vector
    duration: Elementwise  # s
    guard: Int[Array, "..."]  # index of the guard that ended the phase; -1 if none did
    is_timed_out: Bool[Array, "..."]
    n_solver_steps: Int[Array, "..."]  # attempted, accepted or not
    margin_minima: Array | None  # of the margins, on the leading axis, if recorded
    engine_carry: Any = None  # data that the engine passes to the next phase


PhaseRunner = Callable[[AbstractPhase, Vector, Vector, Array, PhaseResult | None], PhaseResult]
"""Function to the end of a phase from its start (q, v), its active mask and the end of the previous
phase."""


class PhaseSequenceResult(NamedTuple):
    """Starts and ends of all phases of a step, and its outcome."""

    s: Symbols
    landing: Landing
    phases: tuple[AbstractPhase, ...]
    phase_starts: tuple[tuple[Vector, Vector], ...]
    phase_ends: tuple[PhaseResult, ...]
    phases_happened: tuple[Bool[Array, "..."], ...]
    outcome: Int[Array, "..."]  # an Outcome
    tilt: Elementwise | None = None  # of the next line, rad; None on flat ground


def run_phases(
    run_phase: PhaseRunner,
    params: WheelParams,
    x: StateValues,
    options: StepOptions,
    stop_at_lift_off: bool,
    land: Callable[..., Landing] = transitions.land,
) -> PhaseSequenceResult:
    """Return the result of all phases of one step from the section state `x`, given entry by entry.

    The motion is in the frame of the line under both feet in double support. On uneven ground (see
    `split_slopes`), the touchdown and the section state at the end refer to the next line.

    - `run_phase`: engine;
    - `land`: function of the landing that opens the step.
    """
    params, is_valid, tilt = select_stance_line(params, x)
    params, x = replace_invalid(is_valid, params, x, PAPER_START)
    s = params.symbols()
    landing = land(s, *x)
    tilt_sin_cos = () if tilt is None else sine_cosine(tilt)
    phases = make_phases(s, landing.distance, stop_at_lift_off, tilt_sin_cos)
    # A landing that releases the rear foot continues in SLS-I.
    is_active = is_valid & landing.keeps_rear_foot
    last_phases = _run_last_phases(
        run_phase, phases, landing.theta, landing.motion, is_valid, is_active, options
    )
    return PhaseSequenceResult(s, landing, phases, *last_phases, tilt)


class _LastPhases(NamedTuple):
    """Starts and ends of the last phases of a step; see `PhaseSequenceResult`."""

    phase_starts: tuple[tuple[Vector, Vector], ...]
    phase_ends: tuple[PhaseResult, ...]
    phases_happened: tuple[Bool[Array, "..."], ...]
    outcome: Int[Array, "..."]


def _run_last_phases(
    run_phase: PhaseRunner,
    phases: tuple[AbstractPhase, ...],
    theta: Elementwise,
    motion: Motion,
    is_valid: Array,
    is_active: Array,
    options: StepOptions,
) -> _LastPhases:
    """Return the results of the last phases of a step, from a motion in the first of them.

    - `is_valid`: whether a step takes place;
    - `is_active`: whether the first of the phases takes place.
    """
    outcome = jnp.where(is_valid, jnp.int32(Outcome.STEPPED), jnp.int32(Outcome.BAD_INPUT))
    phase_starts, phases_happened = [], []
    phase_ends: list[PhaseResult] = []
    for previous_phase, phase in zip((None, *phases), phases, strict=False):
        if previous_phase is not None:
            end_state = (
                phase_ends[-1].q[0],
                previous_phase.motion_at(phase_ends[-1].q, phase_ends[-1].v),
            )
            theta, motion = tree_where(is_active, end_state, (theta, motion))
            is_active = outcome == Outcome.STEPPED
            safe_theta, *safe_lengths_and_rates = (
                jnp.asarray(value, jnp.result_type(theta)) for value in SAFE_SINGLE_SUPPORT_STATE
            )
            safe_state = safe_theta, Motion(*sine_cosine(safe_theta), *safe_lengths_and_rates)
            theta, motion = tree_where(is_active, (theta, motion), safe_state)
            motion = previous_phase.reset_map(motion)
        start_state = phase.select_coordinates(theta, motion)
        phase_end = run_phase(
            phase, *start_state, is_active, phase_ends[-1] if phase_ends else None
        )
        phase_outcome = phase.outcome_of_guard(phase_end.guard, phase_end.is_timed_out)
        if phase.can_come_to_rest:
            is_at_rest = phase.is_at_rest(phase_end.q, phase_end.v, options.atol)
            phase_outcome = replace_rest_outcome(phase_outcome, is_at_rest)
        outcome = jnp.where(is_active, phase_outcome, outcome)
        phase_starts.append(start_state)
        phase_ends.append(phase_end)
        # The start of the last phase is itself an event: Leg 2 hits its stopper.
        phases_happened.append(
            is_active if phase is phases[-1] else is_active & (phase_end.duration > 0.0)
        )
    return _LastPhases(tuple(phase_starts), tuple(phase_ends), tuple(phases_happened), outcome)


def finish_step(
    run_phase: PhaseRunner,
    params: WheelParams,
    phase_index: int,
    distance: Elementwise,
    state: Vector,
    options: StepOptions,
    stop_at_lift_off: bool,
    engine: str,
) -> AdvanceResult:
    """Return the end of a step on flat ground, from a state within one of its phases.

    - `phase_index`: index of the phase in the step;
    - `distance`: distance between both feet in the double support of the step, m;
    - `state`: (theta, L1, L2) and their rates; those that follow from others in the phase are
      ignored.
    """
    is_bounded = [jnp.abs(value) < MAX_SI_VALUE for value in (*state, distance)]
    is_valid = params.is_in_domain() & functools.reduce(operator.and_, is_bounded)
    is_valid = is_valid & (jnp.abs(state[0]) < 0.5 * jnp.pi)
    params, (theta, *lengths_and_rates) = replace_invalid(
        is_valid, params, state, SAFE_SINGLE_SUPPORT_STATE
    )
    phases = make_phases(params.symbols(), distance, stop_at_lift_off)[phase_index:]
    motion = Motion.from_angle(theta, *lengths_and_rates)
    last_phases = _run_last_phases(run_phase, phases, theta, motion, is_valid, is_valid, options)
    phase_ends, has_stepped = last_phases.phase_ends, last_phases.outcome == Outcome.STEPPED
    section_state = phase_ends[-1].q[0], *phase_ends[-1].v
    durations = [jnp.zeros_like(theta)] * phase_index + [end.duration for end in phase_ends]
    return AdvanceResult(
        section_state=jnp.stack([jnp.where(has_stepped, x, 0.0) for x in section_state]),
        durations=jnp.stack(durations),
        outcome=last_phases.outcome,
        solver_steps=functools.reduce(operator.add, [end.n_solver_steps for end in phase_ends]),
        engine=engine,
    )


def next_section_state(phase_sequence: PhaseSequenceResult) -> Vector:
    """Return (theta-, dtheta-, dL1-) at the end of the step, in the frame of the line of the next
    landing.

    The units are rad, rad/s and m/s.
    """
    theta, rates = phase_sequence.phase_ends[2].q[0], phase_sequence.phase_ends[2].v
    return (theta if phase_sequence.tilt is None else theta - phase_sequence.tilt), *rates


def make_advance_result(phase_sequence: PhaseSequenceResult, engine: str) -> AdvanceResult:
    """Return the minimal results of a step; the section state is zero if the step failed."""
    theta, dtheta, dL1 = next_section_state(phase_sequence)
    has_stepped = phase_sequence.outcome == Outcome.STEPPED
    solver_steps = [phase_end.n_solver_steps for phase_end in phase_sequence.phase_ends]
    return AdvanceResult(
        section_state=jnp.stack([jnp.where(has_stepped, x, 0.0) for x in (theta, dtheta, dL1)]),
        durations=jnp.stack([phase_end.duration for phase_end in phase_sequence.phase_ends]),
        outcome=phase_sequence.outcome,
        solver_steps=solver_steps[0] + solver_steps[1] + solver_steps[2],
        engine=engine,
    )


def make_step_result(
    phase_sequence: PhaseSequenceResult, friction: Elementwise | float, engine: str
) -> StepResult:
    """Return all results of a step, for one wheel or a batch.

    The margins must have been recorded.
    """
    s, landing, phase_ends = phase_sequence.s, phase_sequence.landing, phase_sequence.phase_ends
    has_begun = phase_sequence.outcome != Outcome.BAD_INPUT
    hits_stopper, has_stepped = (
        phase_sequence.phases_happened[2],
        phase_sequence.outcome == Outcome.STEPPED,
    )
    dls, sls1, sls2 = make_phases(s, landing.distance, stop_at_lift_off=True)
    liftoff_motion = dls.motion_at(phase_ends[0].q, phase_ends[0].v)
    stopper_state = [
        jnp.where(hits_stopper, x, jnp.asarray(safe_value, x.dtype))
        for x, safe_value in zip(
            (*phase_ends[1].q, *phase_ends[1].v), SAFE_SINGLE_SUPPORT_STATE, strict=True
        )
    ]
    stopper_hit = transitions.hit_stopper(
        s, sls1.motion_at(tuple(stopper_state[:3]), tuple(stopper_state[3:]))
    )
    last_motion = sls2.motion_at(phase_ends[2].q, phase_ends[2].v)
    initial_energy, final_energy = (
        dynamics.mechanical_energy(s, m).total for m in (landing.motion, last_motion)
    )
    fore_force, rear_force = transitions.landing_forces(s, landing)
    advance_result = make_advance_result(phase_sequence, engine)
    return StepResult(
        section_state=advance_result.section_state,
        post_impact=jnp.stack(
            [jnp.where(has_begun, x, 0.0) for x in (landing.theta, landing.motion.dtheta)]
        ),
        durations=advance_result.durations,
        step_length=jnp.where(has_begun, landing.distance, 0.0),
        indicators=DoubleSupportIndicators(
            lambda_I4=jnp.where(has_begun, landing.rear_impulse.normal, 0.0),
            lambda_2=jnp.where(has_begun, fore_force.normal, 0.0),
            lambda_4=jnp.where(has_begun, rear_force.normal, 0.0),
        ),
        margins=_make_margins(phase_sequence, rear_force, liftoff_motion, stopper_hit, friction),
        energy=EnergyLoss(
            landing=jnp.where(has_begun, landing.energy_lost, 0.0),
            stopper=jnp.where(hits_stopper, stopper_hit.energy_lost, 0.0),
            damping=jnp.where(
                has_stepped, initial_energy - final_energy - stopper_hit.energy_lost, 0.0
            ),
        ),
        outcome=advance_result.outcome,
        solver_steps=advance_result.solver_steps,
        engine=engine,
    )


def make_trajectory(phase_sequence: PhaseSequenceResult, samples: Sequence[Array]) -> Trajectory:
    """Return the trajectory of a step from samples at equal times of each phase.

    - `samples`: of each phase, with axes (sample, coordinates and rates, ...).
    """
    advance_result = make_advance_result(phase_sequence, "")
    durations, n_samples = advance_result.durations, len(samples[0])
    start_times = jnp.stack([0.0 * durations[0], durations[0], durations[0] + durations[1]])
    time_fractions = jnp.linspace(0.0, 1.0, n_samples).reshape(
        -1, *(1 for _ in durations.shape[1:])
    )
    phase_arrays = [
        evaluate_states(phase, jnp.moveaxis(states, 1, 0))
        for phase, states in zip(phase_sequence.phases, samples, strict=True)
    ]
    states, forces, energies = (
        jnp.stack([jnp.moveaxis(phase_rows, 0, 1) for phase_rows in arrays])
        for arrays in zip(*phase_arrays, strict=True)
    )
    times = start_times[:, None] + time_fractions * durations[:, None]
    end_state = advance_result.section_state, durations, advance_result.outcome
    return Trajectory(times, states, forces, energies, *end_state)


def evaluate_states(phase: AbstractPhase, y: Array) -> tuple[Array, Array, Array]:
    """Return coordinates with rates, ground forces (N) and energies (J) at states of a phase.

    - `y`: the phase's coordinates, then their rates, on the first axis. Results have the same other
      axes.
    """
    coordinates = tuple(y)
    motion = phase.motion_at(coordinates[: phase.n_dof], coordinates[phase.n_dof :])
    instant = PhaseInstant(phase, motion, None)
    zero = 0.0 * motion.L1
    rear_force = instant.rear_force or dynamics.FootForce(zero, zero)
    return (
        jnp.stack([y[0], motion.L1, motion.L2, motion.dtheta, motion.dL1, motion.dL2]),
        jnp.stack([*instant.fore_force, *rear_force]),
        jnp.stack(dynamics.mechanical_energy(phase.s, motion)),
    )


def _make_margins(
    phase_sequence: PhaseSequenceResult,
    rear_force: dynamics.FootForce,
    liftoff_motion: Motion,
    stopper_hit: transitions.StopperHit,
    friction: Elementwise | float,
) -> Margins:
    """Return the margins of the step.

    - `rear_force`: force on the rear foot just after the landing, N;
    - `liftoff_motion`: motion at the end of double support;
    - `stopper_hit`: collision of Leg 2 with its stopper.
    """
    s, landing, phases_happened = (
        phase_sequence.s,
        phase_sequence.landing,
        phase_sequence.phases_happened,
    )
    has_begun, hits_stopper = phase_sequence.outcome != Outcome.BAD_INPUT, phases_happened[2]
    margin_rows = [
        phase_end.margin_minima
        for phase_end in phase_sequence.phase_ends
        if phase_end.margin_minima is not None
    ]
    phase_minima = [
        PhaseMargins.from_values(tuple(phase_margins), s.n) for phase_margins in margin_rows
    ]

    def lowest_margin(margin_name: str, *phase_indices: int) -> Array:
        """Return the minimum of a margin over those phases that happened; 0 if none did."""
        value: Any = jnp.inf
        for phase_index in phase_indices:
            phase_minimum = jnp.asarray(getattr(phase_minima[phase_index], margin_name))
            value = jnp.minimum(
                value, jnp.where(phases_happened[phase_index], phase_minimum, jnp.inf)
            )
        return jnp.where(jnp.isfinite(value), value, 0.0)

    def friction_margin(force: dynamics.FootForce, is_loaded: Array) -> Array:
        required = jnp.where(is_loaded, dynamics.required_friction(force), 0.0)
        return jnp.where(has_begun, friction - required, 0.0)

    def stopper_impulses(motion: Motion, hub_jump: tuple, has_collision: Array) -> Array:
        impulses = transitions.locked_leg_impulses(s, motion, hub_jump, range(3, s.n + 1))
        return jnp.where(has_collision, impulses, 0.0)

    return Margins(
        fore_foot_force=lowest_margin("fore_foot_force", 0, 1, 2),
        takeoff_acceleration=jnp.where(
            phases_happened[1] & landing.keeps_rear_foot,
            dynamics.takeoff_acceleration(s, liftoff_motion),
            0.0,
        ),
        clearance_sls1=lowest_margin("rear_clearance", 1),
        clearance_sls2=lowest_margin("rear_clearance", 2),
        locked_stopper_force=lowest_margin("locked_stopper_force", 0, 1, 2),
        rear_stopper_force=lowest_margin("rear_stopper_force", 2),
        contraction=lowest_margin("contraction", 0, 1, 2),
        friction_fore=jnp.where(has_begun, friction + lowest_margin("friction", 0, 1, 2), 0.0),
        friction_rear=friction_margin(rear_force, phases_happened[0]),
        landing_stopper_impulse=stopper_impulses(landing.motion, landing.hub_jump, has_begun),
        hit_stopper_impulse=stopper_impulses(
            stopper_hit.motion, stopper_hit.hub_jump, hits_stopper
        ),
        hit_planted_impulse=jnp.where(hits_stopper, stopper_hit.foot_impulse.normal, 0.0),
        landing_friction_fore=friction_margin(landing.fore_impulse, has_begun),
        landing_friction_rear=friction_margin(
            landing.rear_impulse, has_begun & landing.keeps_rear_foot
        ),
    )
