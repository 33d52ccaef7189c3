"""The paper's step from landing to landing, for any engine that integrates its phases.

An engine provides a `PhaseRunner`, which takes one phase to its end. This module determines which
phases take place, where they start, how the step ends and what it returns. Everything is
elementwise: for one wheel or a batch.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from vrw_jax.models.base import (
    Advance,
    EnergyLoss,
    Indicators,
    Margins,
    Numbers,
    StepResult,
    Trajectory,
    replaced_where_bad,
    usable,
)
from vrw_jax.numerics import Elementwise, Vector, select, sine_cosine
from vrw_jax.wheel import (
    AbstractPhase,
    Instant,
    Landing,
    Motion,
    Outcome,
    Premises,
    Symbols,
    WheelParams,
    dynamics,
    phases_of,
    transitions,
)

PAPER_START = (0.1, 1.6, -0.1)
"""A start near the gait of Table 1, inside its basin: rad, rad/s, m/s."""

SAFE_SINGLE_SUPPORT = (-0.3, 0.9, 0.95, 1.0, 0.0, 0.0)
"""A regular posture (theta, L1, L2 and rates) in place of a wheel whose step has already failed; it
is never integrated."""


class End(NamedTuple):
    """End of a phase; it equals the start where the phase was not active."""

    q: Vector
    v: Vector
    duration: Elementwise  # s
    guard: Int[Array, "..."]  # index of the guard that ended it; -1 if none did
    timed_out: Bool[Array, "..."]
    tried: Int[Array, "..."]  # attempted, accepted or not
    minima: Array | None  # of the phase's margins, on the leading axis, if recorded
    own: Any = None  # data that the engine passes to its next phase


Run = Callable[[AbstractPhase, Vector, Vector, Array, End | None], End]
"""Function from a phase's start (q, v), its active mask and the previous phase's end to its end."""


class Walked(NamedTuple):
    """Result of running all phases of a step."""

    s: Symbols
    landing: Landing
    phases: tuple[AbstractPhase, ...]
    starts: tuple[tuple[Vector, Vector], ...]
    ends: tuple[End, ...]
    happened: tuple[Bool[Array, "..."], ...]
    outcome: Int[Array, "..."]  # an Outcome


def through_phases(
    run: Run,
    params: WheelParams,
    x: Numbers,
    stop_at_lift_off: bool,
    land: Callable[..., Landing] = transitions.land,
) -> Walked:
    """Return all phases of one step from the section state `x`, given entry by entry."""
    good = usable(params, x)
    params, x = replaced_where_bad(good, params, x, PAPER_START)
    s = params.symbols()
    landing = land(s, *x)
    phases = phases_of(s, landing.distance, stop_at_lift_off)
    theta, motion = landing.theta, landing.motion
    active = good & landing.stays  # a landing that releases the rear foot continues in SLS-I
    code = jnp.where(good, jnp.int32(Outcome.STEPPED), jnp.int32(Outcome.BAD_INPUT))
    starts, happened = [], []
    ends: list[End] = []
    for before, phase in zip((None, *phases), phases, strict=False):
        if before is not None:
            here = ends[-1].q[0], before.at(ends[-1].q, ends[-1].v)
            theta, motion = select(active, here, (theta, motion))
            active = code == Outcome.STEPPED
            theta, motion = select(active, (theta, motion), _safe(theta))
            motion = before.after(motion)
        start = phase.own(theta, motion)
        end = run(phase, *start, active, ends[-1] if ends else None)
        code = jnp.where(active, phase.outcome(end.guard, end.timed_out), code)
        starts.append(start)
        ends.append(end)
        # The start of the last phase is itself an event: Leg 2 hits its stopper.
        happened.append(active if phase is phases[-1] else active & (end.duration > 0.0))
    return Walked(s, landing, phases, tuple(starts), tuple(ends), tuple(happened), code)


def _safe(like: Elementwise) -> tuple[Elementwise, Motion]:
    """Return `SAFE_SINGLE_SUPPORT` as an angle and a motion, in the dtype of the argument."""
    theta, *others = (jnp.asarray(value, jnp.result_type(like)) for value in SAFE_SINGLE_SUPPORT)
    return theta, Motion(*sine_cosine(theta), *others)


def advance_of(walked: Walked, engine: str) -> Advance:
    """Return the minimal result; its section state is zeros if the step failed."""
    theta, _, dtheta, dL1 = (*walked.ends[2].q, *walked.ends[2].v)
    stepped = walked.outcome == Outcome.STEPPED
    tried = [end.tried for end in walked.ends]
    return Advance(
        section_state=jnp.stack([jnp.where(stepped, x, 0.0) for x in (theta, dtheta, dL1)]),
        durations=jnp.stack([end.duration for end in walked.ends]),
        outcome=walked.outcome,
        solver_steps=tried[0] + tried[1] + tried[2],
        engine=engine,
    )


def result_of(walked: Walked, friction: Elementwise | float, engine: str) -> StepResult:
    """Return the full result, for one wheel or a batch; the margins must have been recorded."""
    s, landing, ends = walked.s, walked.landing, walked.ends
    began = walked.outcome != Outcome.BAD_INPUT
    hits, stepped = walked.happened[2], walked.outcome == Outcome.STEPPED
    dls, sls1, sls2 = phases_of(s, landing.distance, stop_at_lift_off=True)
    lets_go = dls.at(ends[0].q, ends[0].v)
    at_stopper = [
        jnp.where(hits, x, jnp.asarray(safe, x.dtype))
        for x, safe in zip((*ends[1].q, *ends[1].v), SAFE_SINGLE_SUPPORT, strict=True)
    ]
    hit = transitions.hit_stopper(s, sls1.at(tuple(at_stopper[:3]), tuple(at_stopper[3:])))
    last = sls2.at(ends[2].q, ends[2].v)
    begins, finishes = (dynamics.energy(s, m).total for m in (landing.motion, last))
    fore_after, rear_after = transitions.landing_forces(s, landing)
    lean = advance_of(walked, engine)
    return StepResult(
        section_state=lean.section_state,
        post_impact=jnp.stack(
            [jnp.where(began, x, 0.0) for x in (landing.theta, landing.motion.dtheta)]
        ),
        durations=lean.durations,
        step_length=jnp.where(began, landing.distance, 0.0),
        indicators=Indicators(
            lambda_I4=jnp.where(began, landing.rear.normal, 0.0),
            lambda_2=jnp.where(began, fore_after.normal, 0.0),
            lambda_4=jnp.where(began, rear_after.normal, 0.0),
        ),
        monitors=_margins(walked, rear_after, lets_go, hit, friction),
        energy=EnergyLoss(
            landing=jnp.where(began, landing.energy_lost, 0.0),
            stopper=jnp.where(hits, hit.energy_lost, 0.0),
            damping=jnp.where(stepped, begins - finishes - hit.energy_lost, 0.0),
        ),
        outcome=lean.outcome,
        solver_steps=lean.solver_steps,
        engine=engine,
    )


def trajectory_of(walked: Walked, samples: Sequence[Array]) -> Trajectory:
    """Return the step with states at equal times of each phase.

    - `samples`: of each phase, with axes (sample, coordinates and rates, ...).
    """
    lean = advance_of(walked, "")
    durations, n = lean.durations, len(samples[0])
    begins = jnp.stack([0.0 * durations[0], durations[0], durations[0] + durations[1]])
    shares = jnp.linspace(0.0, 1.0, n).reshape(-1, *(1 for _ in durations.shape[1:]))
    parts = [
        described(phase, jnp.moveaxis(states, 1, 0))
        for phase, states in zip(walked.phases, samples, strict=True)
    ]
    states, forces, energies = (
        jnp.stack([jnp.moveaxis(rows, 0, 1) for rows in part]) for part in zip(*parts, strict=True)
    )
    times = begins[:, None] + shares * durations[:, None]
    ends = lean.section_state, durations, lean.outcome
    return Trajectory(times, states, forces, energies, *ends)


def described(phase: AbstractPhase, y: Array) -> tuple[Array, Array, Array]:
    """Return coordinates and rates, forces of the ground and energies at states of the phase.

    - `y`: the phase's own coordinates, then their rates, on the first axis; other axes are kept.
    """
    numbers = tuple(y)
    m = phase.at(numbers[: phase.n], numbers[phase.n :])
    at = Instant(phase, m, None)
    zero = 0.0 * m.L1
    rear = at.rear or dynamics.FootForce(zero, zero)
    return (
        jnp.stack([y[0], m.L1, m.L2, m.dtheta, m.dL1, m.dL2]),
        jnp.stack([*at.fore, *rear]),
        jnp.stack(dynamics.energy(phase.s, m)),
    )


def _margins(
    walked: Walked,
    rear_after: dynamics.FootForce,
    lets_go: Motion,
    hit: transitions.StopperHit,
    friction: Elementwise | float,
) -> Margins:
    """Return the margins of the step.

    - `rear_force`: force on the rear foot just after the landing;
    - `liftoff_motion`: motion at the end of double support.
    """
    s, landing, happened = walked.s, walked.landing, walked.happened
    began, hits = walked.outcome != Outcome.BAD_INPUT, happened[2]
    watched = [end.minima for end in walked.ends if end.minima is not None]
    minima = [Premises.named(tuple(rows), s.n) for rows in watched]

    def lowest(name: str, *indices: int) -> Array:
        """Return the minimum over those phases that happened; 0 if none did."""
        value: Any = jnp.inf
        for index in indices:
            least = jnp.asarray(getattr(minima[index], name))
            value = jnp.minimum(value, jnp.where(happened[index], least, jnp.inf))
        return jnp.where(jnp.isfinite(value), value, 0.0)

    def friction_left(force: dynamics.FootForce, loaded: Array) -> Array:
        needed = jnp.where(loaded, dynamics.friction_needed(force), 0.0)
        return jnp.where(began, friction - needed, 0.0)

    def impulses(motion: Motion, jump: tuple, collides: Array) -> Array:
        thrown = transitions.locked_leg_impulses(s, motion, jump, range(3, s.n + 1))
        return jnp.where(collides, thrown, 0.0)

    return Margins(
        fore_foot_force=lowest("fore_foot_force", 0, 1, 2),
        takeoff_acceleration=jnp.where(
            happened[1] & landing.stays, dynamics.takeoff_acceleration(s, lets_go), 0.0
        ),
        clearance_sls1=lowest("rear_clearance", 1),
        clearance_sls2=lowest("rear_clearance", 2),
        locked_stopper_force=lowest("locked_stopper_force", 0, 1, 2),
        rear_stopper_force=lowest("rear_stopper_force", 2),
        contraction=lowest("contraction", 0, 1, 2),
        friction_fore=jnp.where(began, friction + lowest("friction", 0, 1, 2), 0.0),
        friction_rear=friction_left(rear_after, happened[0]),
        landing_stopper_impulse=impulses(landing.motion, landing.hub_jump, began),
        hit_stopper_impulse=impulses(hit.motion, hit.hub_jump, hits),
        hit_planted_impulse=jnp.where(hits, hit.planted.normal, 0.0),
        landing_friction_fore=friction_left(landing.fore, began),
        landing_friction_rear=friction_left(landing.rear, began & landing.stays),
    )
