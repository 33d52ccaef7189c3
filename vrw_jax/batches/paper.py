"""Gait steps of many wheels at once: the fast engine for batches.

The same physics as `models.viscoelastic`, whose functions work element by element; arrays hold one
quantity of all wheels instead of one wheel's quantities.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from vrw_jax.models import (
    PAPER_START,
    SAFE_SINGLE_SUPPORT,
    PhaseBuilder,
    replaced_where_bad,
    usable,
    viscoelastic,
)
from vrw_jax.numerics import (
    LanePhase,
    LanePhaseEnd,
    Monitors,
    Options,
    Place,
    Slope,
    Tableau,
    Vector,
    integrate_lanes,
    sine_cosine,
)
from vrw_jax.wheel import (
    Motion,
    Outcome,
    WheelParams,
    double_support_circle,
    dynamics,
    landing_foot_height,
    rear_foot_height,
    transitions,
)

INTO_SINGLE_SUPPORT = 0.3
"""First step of SLS-I over the last of DLS: dropping the rear foot's force excites the airborne
leg's fast mode, which dies within 0.05 s."""


class Walk(NamedTuple):
    """A gait step of a block of lanes from landing to landing, phase by phase."""

    ends: tuple[LanePhaseEnd, LanePhaseEnd, LanePhaseEnd]
    happened: tuple[Array, Array, Array]
    outcome: Int[Array, " lanes"]  # an Outcome


class LaneStep(NamedTuple):
    """One gait step of a block of lanes."""

    section_state: Vector  # three arrays
    durations: Vector  # of DLS, SLS-I, SLS-II, s
    outcome: Int[Array, " lanes"]  # an Outcome
    solver_steps: Int[Array, " lanes"]
    unfinished: Bool[Array, " lanes"]  # not waited for: everything else there is void


def double_support(build: PhaseBuilder, distance: Array) -> LanePhase:
    """DLS over theta. Section 3.3.1."""
    s = build.s

    def motion(sin: Array, cos: Array, dtheta: Array) -> Motion:
        circle = double_support_circle(s, distance, sin, cos)
        return Motion(
            sin, cos, circle.L1, circle.L2, dtheta, circle.G1 * dtheta, circle.G2 * dtheta
        )

    def accelerate(sin: Array, cos: Array, dtheta: Array) -> Vector:
        return (
            dynamics.double_support_acceleration(s, distance, motion(sin, cos, dtheta)).ddtheta,
        )

    def evaluate(q: Vector, v: Vector) -> Slope:
        sin, cos = sine_cosine(q[0])
        return Slope(sin, cos, accelerate(sin, cos, v[0]))

    def at(place: Place) -> tuple:
        m = motion(place.slope.sin, place.slope.cos, place.v[0])
        a = dynamics.double_support_acceleration(s, distance, m)
        rear = dynamics.rear_foot_force(s, m, a)
        return m, a, rear, dynamics.fore_foot_force(s, m, a, rear)

    def guards(place: Place) -> Vector:
        m, _, rear, fore = at(place)
        return (rear.normal, s.L0 - m.L2, landing_foot_height(s, m), *build.falls(m, fore))

    def premises(place: Place) -> Vector:
        m, a, _, fore = at(place)
        return tuple(build.premises(m, a, fore))

    return LanePhase(
        evaluate,
        guards,
        build.outcomes(
            Outcome.STEPPED, Outcome.STOPPER_IN_DOUBLE_SUPPORT, Outcome.TOUCHDOWN_BEFORE_STOPPER
        ),
        _monitors(build, premises, viscoelastic.double_support(build, distance)),
    )


def _monitors(
    build: PhaseBuilder, values: Callable[[Place], Vector], of_one_wheel: viscoelastic.Phase
) -> Monitors | None:
    """What the single wheel's phase watches, too."""
    return Monitors(values, of_one_wheel.watched.count_start) if build.monitored else None


def single_support_1(build: PhaseBuilder) -> LanePhase:
    """SLS-I over (theta, L1, L2). Section 3.3.2."""
    s = build.s

    def evaluate(q: Vector, v: Vector) -> Slope:
        sin, cos = sine_cosine(q[0])
        motion = Motion(sin, cos, q[1], q[2], *v)
        return Slope(sin, cos, tuple(dynamics.single_support_1_acceleration(s, motion)))

    def at(place: Place) -> tuple:
        slope = place.slope
        m = Motion(slope.sin, slope.cos, place.q[1], place.q[2], *place.v)
        a = dynamics.Acceleration(*slope.acceleration)
        return m, a, dynamics.fore_foot_force(s, m, a)

    def guards(place: Place) -> Vector:
        m, _, fore = at(place)
        return (s.L0 - m.L2, landing_foot_height(s, m), *build.falls(m, fore))

    def premises(place: Place) -> Vector:
        m, a, fore = at(place)
        return (*build.premises(m, a, fore), rear_foot_height(s, m))

    return LanePhase(
        evaluate,
        guards,
        build.outcomes(Outcome.STEPPED, Outcome.TOUCHDOWN_BEFORE_STOPPER),
        _monitors(build, premises, viscoelastic.single_support_1(build)),
    )


def single_support_2(build: PhaseBuilder) -> LanePhase:
    """SLS-II over (theta, L1). Section 3.3.3."""
    s = build.s

    def motion(sin: Array, cos: Array, L1: Array, v: Vector) -> Motion:
        return Motion(sin, cos, L1, s.L0 + 0.0 * L1, v[0], v[1], 0.0 * v[1])

    def accelerate(sin: Array, cos: Array, L1: Array, v: Vector) -> Vector:
        return dynamics.single_support_2_acceleration(s, motion(sin, cos, L1, v))[:2]

    def evaluate(q: Vector, v: Vector) -> Slope:
        sin, cos = sine_cosine(q[0])
        return Slope(sin, cos, accelerate(sin, cos, q[1], v))

    def at(place: Place) -> tuple:
        slope = place.slope
        m = motion(slope.sin, slope.cos, place.q[1], place.v)
        ddtheta, ddL1 = slope.acceleration
        a = dynamics.Acceleration(ddtheta, ddL1, 0.0 * m.L1)
        return m, a, dynamics.fore_foot_force(s, m, a)

    def guards(place: Place) -> Vector:
        m, _, fore = at(place)
        return (landing_foot_height(s, m), *build.falls(m, fore))

    def premises(place: Place) -> Vector:
        m, a, fore = at(place)
        rear_stopper = dynamics.stopper_force(s, m, a, range(2, 3))
        return (*build.premises(m, a, fore), rear_foot_height(s, m), *rear_stopper)

    return LanePhase(
        evaluate,
        guards,
        build.outcomes(Outcome.STEPPED),
        _monitors(build, premises, viscoelastic.single_support_2(build)),
    )


def _outcome(phase: LanePhase, end: LanePhaseEnd) -> Array:
    """STEPPED where the phase ended as in the paper."""
    code = jnp.full(end.guard.shape, int(Outcome.SOLVER_GAVE_UP), jnp.int32)
    for index, meaning in enumerate(phase.outcomes):
        code = jnp.where(end.guard == index, jnp.int32(meaning), code)
    return jnp.where(end.timed_out, jnp.int32(Outcome.NO_TOUCHDOWN_IN_TIME), code)


def gait_step(
    params: WheelParams,
    x: Vector,
    options: Options,
    tableau: Tableau,
    stop_at_lift_off: bool,
    few: Array | None = None,
) -> LaneStep:
    """One gait step of every lane, from touchdown to touchdown. `few`: see `integrate_lanes`."""
    walked = walk(params, x, options, tableau, stop_at_lift_off, monitored=False, few=few)
    ends, stepped = walked.ends, walked.outcome == Outcome.STEPPED
    section = (ends[2].place.q[0], *ends[2].place.v)
    return LaneStep(
        section_state=tuple(jnp.where(stepped, value, 0.0) for value in section),
        durations=tuple(end.duration for end in ends),
        outcome=walked.outcome,
        solver_steps=ends[0].tried + ends[1].tried + ends[2].tried,
        unfinished=ends[0].unfinished | ends[1].unfinished | ends[2].unfinished,
    )


def walk(
    params: WheelParams,
    x: Vector,
    options: Options,
    tableau: Tableau,
    stop_at_lift_off: bool,
    monitored: bool,
    few: Array | None = None,
) -> Walk:
    """One gait step of every lane, with the ends of its phases and the minima of their monitors."""
    good = usable(params, x)
    params, x = replaced_where_bad(good, params, x, PAPER_START)
    s = params.symbols()
    build = PhaseBuilder(s, stop_at_lift_off, monitored)
    landing = transitions.land(s, *x)
    first = options.first_step + jnp.zeros_like(landing.theta)
    stepped = jnp.int32(Outcome.STEPPED)
    safe = [jnp.asarray(value, x[0].dtype) for value in SAFE_SINGLE_SUPPORT]

    def run(
        phase: LanePhase, q: Vector, v: Vector, active: Array, first: Array
    ) -> tuple[LanePhaseEnd, Array]:
        end = integrate_lanes(phase, tableau, q, v, active, first, options, few)
        return end, jnp.where(active, _outcome(phase, end), stepped)

    dls = double_support(build, landing.distance)
    active1 = good & landing.stays
    end1, code1 = run(dls, (landing.theta,), (landing.motion.dtheta,), active1, first)

    active2 = good & (code1 == stepped) & ~end1.unfinished
    lifted = double_support_at(build, landing.distance, end1.place.q[0], end1.place.v[0])
    freed = landing.motion
    starts = (
        (end1.place.q[0], landing.theta),
        *((getattr(lifted, name), getattr(freed, name)) for name in Motion._fields[2:]),
    )
    begin = [
        jnp.where(active2, jnp.where(landing.stays, held, free), harmless)
        for (held, free), harmless in zip(starts, safe, strict=True)
    ]
    sls1 = single_support_1(build)
    first2 = jnp.where(landing.stays, INTO_SINGLE_SUPPORT * end1.next_step, first)
    end2, code2 = run(sls1, tuple(begin[:3]), tuple(begin[3:]), active2, first2)

    active3 = active2 & (code2 == stepped) & ~end2.unfinished
    q = [jnp.where(active3, x, harmless) for x, harmless in zip(end2.place.q, safe, strict=False)]
    v = [jnp.where(active3, x, y) for x, y in zip(end2.place.v, safe[3:], strict=True)]

    hit = transitions.hit_stopper(s, Motion(*sine_cosine(q[0]), q[1], q[2], *v)).motion
    sls2 = single_support_2(build)
    end3, code3 = run(sls2, (q[0], hit.L1), (hit.dtheta, hit.dL1), active3, end2.next_step)

    code = jnp.where(active2, jnp.where(active3, code3, code2), code1)
    code = jnp.where(good, code, jnp.int32(Outcome.BAD_INPUT))
    return Walk(
        ends=(end1, end2, end3),
        happened=(active1 & (end1.duration > 0.0), active2 & (end2.duration > 0.0), active3),
        outcome=code,
    )


def double_support_at(build: PhaseBuilder, distance: Array, theta: Array, dtheta: Array) -> Motion:
    """The motion in double support there."""
    sin, cos = sine_cosine(theta)
    circle = double_support_circle(build.s, distance, sin, cos)
    return Motion(sin, cos, circle.L1, circle.L2, dtheta, circle.G1 * dtheta, circle.G2 * dtheta)
