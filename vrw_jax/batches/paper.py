"""Gait steps of many wheels at once: the fast engine for batches.

The same phases as the single wheel's; arrays hold one quantity of all wheels instead of one wheel's
quantities.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from vrw_jax.models import End, Walked, through_phases
from vrw_jax.numerics import (
    LanePhase,
    Monitors,
    Options,
    Place,
    Slope,
    Tableau,
    Vector,
    integrate_lanes,
    sine_cosine,
)
from vrw_jax.wheel import AbstractPhase, Instant, Outcome, WheelParams

INTO_SINGLE_SUPPORT = 0.3
"""First step of SLS-I over the last of DLS: dropping the rear foot's force excites the airborne
leg's fast mode, which dies within 0.05 s."""


class LaneStep(NamedTuple):
    """One gait step of a block of lanes."""

    section_state: Vector  # three arrays
    durations: Vector  # of DLS, SLS-I, SLS-II, s
    outcome: Int[Array, " lanes"]  # an Outcome
    solver_steps: Int[Array, " lanes"]
    unfinished: Bool[Array, " lanes"]  # not waited for: everything else there is void


class _Handed(NamedTuple):
    """From one phase to the next."""

    next_step: Array  # that the controller would try, s
    ran: Bool[Array, " lanes"]  # where the phase took place
    unfinished: Bool[Array, " lanes"]


def lane_phase(phase: AbstractPhase, monitored: bool) -> LanePhase:
    """A phase as the march takes it. `monitored`: watch its premises as well as its guards."""

    def evaluate(q: Vector, v: Vector) -> Slope:
        sin, cos = sine_cosine(q[0])
        return Slope(sin, cos, phase.acceleration(phase.motion(sin, cos, q, v))[: phase.n])

    def instant(place: Place) -> Instant:
        sin, cos, acceleration = place.slope
        return Instant(phase, phase.motion(sin, cos, place.q, place.v), acceleration)

    watched = Monitors(lambda place: phase.premises(instant(place)), phase.counts_at_start)
    return LanePhase(
        evaluate, lambda place: phase.guards(instant(place)), watched if monitored else None
    )


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
    section = (ends[2].q[0], *ends[2].v)
    return LaneStep(
        section_state=tuple(jnp.where(stepped, value, 0.0) for value in section),
        durations=tuple(end.duration for end in ends),
        outcome=walked.outcome,
        solver_steps=ends[0].tried + ends[1].tried + ends[2].tried,
        unfinished=ends[0].own.unfinished | ends[1].own.unfinished | ends[2].own.unfinished,
    )


def walk(
    params: WheelParams,
    x: Vector,
    options: Options,
    tableau: Tableau,
    stop_at_lift_off: bool,
    monitored: bool,
    few: Array | None = None,
) -> Walked:
    """One gait step of every lane, phase by phase."""

    def run(phase: AbstractPhase, q: Vector, v: Vector, active: Array, before: End | None) -> End:
        first = options.first_step + jnp.zeros_like(q[0])
        if before is not None:
            known: _Handed = before.own
            first = known.next_step
            if phase.stiff_start:
                first = jnp.where(known.ran, INTO_SINGLE_SUPPORT * first, first)
        march = lane_phase(phase, monitored)
        end = integrate_lanes(march, tableau, q, v, active, first, options, few)
        return End(
            *end.place[:2],
            duration=end.duration,
            guard=end.guard,
            timed_out=end.timed_out,
            tried=end.tried,
            minima=end.minima,
            own=_Handed(end.next_step, active, end.unfinished),
        )

    return through_phases(run, params, x, stop_at_lift_off)
