"""The paper's step from landing to landing, whoever integrates its phases: one wheel or lanes.

An engine brings `run`, which takes one phase to its end. Which phases take place, where they start,
how the step ended and what it tells is written here, element by element.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from vrw_jax.models.base import (
    EnergyLoss,
    Indicators,
    Margins,
    Numbers,
    SectionState,
    StepResult,
    replaced_where_bad,
    usable,
)
from vrw_jax.numerics import Elementwise, Vector, select, sine_cosine
from vrw_jax.wheel import (
    AbstractPhase,
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
"""A harmless posture (theta, L1, L2 and rates) that stands in where a wheel has already failed; it
is never integrated."""


class End(NamedTuple):
    """Where an engine left a phase; the phase's start where it was not active."""

    q: Vector
    v: Vector
    duration: Elementwise  # s
    guard: Int[Array, "..."]  # index of the guard that ended it; -1 if none did
    timed_out: Bool[Array, "..."]
    tried: Int[Array, "..."]  # steps, accepted or not
    minima: Array | None  # of the phase's premises, leading axis, if they were watched
    own: Any = None  # what the engine hands on to its next phase


Run = Callable[[AbstractPhase, Vector, Vector, Array, End | None], End]
"""From a phase's start (q, v), where it is active, to its end; and the end of the phase before."""


class Walked(NamedTuple):
    s: Symbols
    landing: Landing
    phases: tuple[AbstractPhase, ...]
    starts: tuple[tuple[Vector, Vector], ...]
    ends: tuple[End, ...]
    happened: tuple[Bool[Array, "..."], ...]
    outcome: Int[Array, "..."]  # an Outcome


class Told(NamedTuple):
    """What `result_of` needs of a step's phases, whoever integrated them."""

    states: tuple[Array, ...]  # by phase: coordinates, then rates, at its end
    durations: Array  # (3, ...), s
    happened: Array  # (3, ...)
    minima: tuple[Array, ...]  # by phase: of its premises
    outcome: Array
    tried: Array  # (3, ...)


def through_phases(
    run: Run,
    params: WheelParams,
    x: Numbers,
    stop_at_lift_off: bool,
    land: Callable[..., Landing] = transitions.land,
) -> Walked:
    """One step from the section state `x`, its numbers one by one."""
    good = usable(params, x)
    params, x = replaced_where_bad(good, params, x, PAPER_START)
    s = params.symbols()
    landing = land(s, *x)
    phases = phases_of(s, landing.distance, stop_at_lift_off)
    theta, motion = landing.theta, landing.motion
    active = good & landing.stays  # a landing that frees the rear foot goes on to SLS-I
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
        # The last one's start is an event of its own: Leg 2 has hit its stopper.
        happened.append(active if phase is phases[-1] else active & (end.duration > 0.0))
    return Walked(s, landing, phases, tuple(starts), tuple(ends), tuple(happened), code)


def _safe(like: Elementwise) -> tuple[Elementwise, Motion]:
    theta, *others = (jnp.asarray(value, jnp.result_type(like)) for value in SAFE_SINGLE_SUPPORT)
    return theta, Motion(*sine_cosine(theta), *others)


def told_of(walked: Walked) -> Told:
    """The step without what can be computed again."""
    ends = walked.ends
    return Told(
        states=tuple(jnp.stack([*end.q, *end.v]) for end in ends),
        durations=jnp.stack([end.duration for end in ends]),
        happened=jnp.stack(walked.happened),
        minima=tuple(end.minima for end in ends if end.minima is not None),
        outcome=walked.outcome,
        tried=jnp.stack([end.tried for end in ends]),
    )


def section_state_of(told: Told) -> SectionState:
    """The state at the next touchdown; zeros where there is none."""
    theta, _, dtheta, dL1 = told.states[2]
    state = jnp.stack([theta, dtheta, dL1])
    return jnp.where(told.outcome == Outcome.STEPPED, state, jnp.zeros_like(state))


def result_of(
    s: Symbols, landing: Landing, told: Told, friction: Elementwise | float
) -> StepResult:
    """All that a step tells, of one wheel or of lanes."""
    began = told.outcome != Outcome.BAD_INPUT
    hits, stepped = told.happened[2], told.outcome == Outcome.STEPPED
    dls, sls1, sls2 = phases_of(s, landing.distance, stop_at_lift_off=True)
    lets_go = dls.at((told.states[0][0],), (told.states[0][1],))
    safe = jnp.asarray(SAFE_SINGLE_SUPPORT, s.L0.dtype)
    at_stopper = tuple(jnp.where(hits, told.states[1][i], value) for i, value in enumerate(safe))
    hit = transitions.hit_stopper(s, sls1.at(at_stopper[:3], at_stopper[3:]))
    last = sls2.at(tuple(told.states[2][:2]), tuple(told.states[2][2:]))
    begins, finishes = (dynamics.energy(s, m).total for m in (landing.motion, last))
    fore_after, rear_after = transitions.landing_forces(s, landing)
    return StepResult(
        section_state=section_state_of(told),
        post_impact=jnp.where(began, jnp.stack([landing.theta, landing.motion.dtheta]), 0.0),
        durations=told.durations,
        step_length=jnp.where(began, landing.distance, 0.0),
        indicators=Indicators(
            lambda_I4=jnp.where(began, landing.rear.normal, 0.0),
            lambda_2=jnp.where(began, fore_after.normal, 0.0),
            lambda_4=jnp.where(began, rear_after.normal, 0.0),
        ),
        monitors=_margins(s, landing, rear_after, lets_go, hit, told, friction),
        energy=EnergyLoss(
            landing=jnp.where(began, landing.energy_lost, 0.0),
            stopper=jnp.where(hits, hit.energy_lost, 0.0),
            damping=jnp.where(stepped, begins - finishes - hit.energy_lost, 0.0),
        ),
        outcome=told.outcome,
        solver_steps=jnp.sum(told.tried, axis=0),
    )


def _margins(
    s: Symbols,
    landing: Landing,
    rear_after: dynamics.FootForce,
    lets_go: Motion,
    hit: transitions.StopperHit,
    told: Told,
    friction: Elementwise | float,
) -> Margins:
    """`rear_after`: force on the rear foot just after the landing; `lets_go`: motion at the end of
    double support."""
    began = told.outcome != Outcome.BAD_INPUT
    hits = told.happened[2]
    minima = [Premises.named(tuple(row), s.n) for row in told.minima]

    def lowest(name: str, *indices: int) -> Array:
        """Over those phases that happened; 0 if none did."""
        value: Any = jnp.inf
        for index in indices:
            least = jnp.asarray(getattr(minima[index], name))
            value = jnp.minimum(value, jnp.where(told.happened[index], least, jnp.inf))
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
            told.happened[1] & landing.stays, dynamics.takeoff_acceleration(s, lets_go), 0.0
        ),
        clearance_sls1=lowest("rear_clearance", 1),
        clearance_sls2=lowest("rear_clearance", 2),
        locked_stopper_force=lowest("locked_stopper_force", 0, 1, 2),
        rear_stopper_force=lowest("rear_stopper_force", 2),
        contraction=lowest("contraction", 0, 1, 2),
        friction_fore=jnp.where(began, friction + lowest("friction", 0, 1, 2), 0.0),
        friction_rear=friction_left(rear_after, told.happened[0]),
        landing_stopper_impulse=impulses(landing.motion, landing.hub_jump, began),
        hit_stopper_impulse=impulses(hit.motion, hit.hub_jump, hits),
        hit_planted_impulse=jnp.where(hits, hit.planted.normal, 0.0),
        landing_friction_fore=friction_left(landing.fore, began),
        landing_friction_rear=friction_left(landing.rear, began & landing.stays),
    )
