"""The paper's phases as data for the collocation: dynamics, end events and resets.

`held_landing_sequence` uses the plane section (theta+, dtheta+) just after an impact that ends with
both feet on the ground. Its double support may be absent; then the rear foot lifts at once (case
B3). An impact that throws the rear foot off (case A3) leaves that plane, so such gaits are not
found here.
"""

import functools
import math
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array

from vrw_jax.numerics import (
    Constants,
    Elementwise,
    Passage,
    Phase,
    PhaseSequence,
    Point,
    Vector,
    sine_cosine,
)
from vrw_jax.wheel import (
    FALLS,
    PHASES,
    AbstractPhase,
    Instant,
    Motion,
    Symbols,
    rear_direction,
    symbols_of,
    transitions,
)

N_CONSTANTS = 12
"""Number of fields of `Symbols` that vary between lanes. The other fields follow from the number of
legs."""


def constants_of(n_legs: int, *parameters: Elementwise) -> Constants:
    """Return the combinations that every formula needs, from the parameters in their order."""
    symbols: tuple[Any, ...] = symbols_of(n_legs, *parameters)
    return symbols[:N_CONSTANTS]


def _symbols(n_legs: int, constants: Constants) -> Symbols:
    alpha = 2.0 * math.pi / n_legs
    fields: tuple[Any, ...] = (*constants, n_legs, math.sin(alpha), math.cos(alpha), alpha)
    return Symbols(*fields)


def _collocated(n_legs: int, stop_at_lift_off: bool, index: int) -> Phase:
    """Return a phase of the wheel as a function of the constants of `compute_constants`."""
    kind = PHASES[index]

    def at(constants: Constants, point: Point) -> tuple[AbstractPhase, Motion]:
        phase = kind(_symbols(n_legs, constants), point.held, stop_at_lift_off=True)
        return phase, phase.at(point.q, point.v)

    def residual(constants: Constants, point: Point, acceleration: Vector) -> Vector:
        phase, motion = at(constants, point)
        return phase.residual(motion, acceleration)

    def event(constants: Constants, point: Point) -> Elementwise:
        phase, motion = at(constants, point)
        return phase.end(Instant(phase, motion, None))

    def guards(constants: Constants, point: Point) -> Vector:
        phase, motion = at(constants, point)
        guards = phase.guards(Instant(phase, motion, None))
        # Every guard keeps its index in ADMISSIBILITY_CHECKS, even a guard that is not checked.
        return guards if stop_at_lift_off else (*guards[:-1], jnp.ones_like(guards[-1]))

    def to_next_phase(constants: Constants, point: Point) -> Point:
        phase, motion = at(constants, point)
        return Point((), *PHASES[index + 1].own(point.q[0], phase.after(motion)))

    def to_section(constants: Constants, point: Point) -> Point:
        (theta, _), (dtheta, dL1) = point.q, point.v
        s = _symbols(n_legs, constants)
        return Point((), transitions.land_on_both(s, theta, dtheta, dL1), ())

    reset = to_section if kind is PHASES[-1] else to_next_phase
    return Phase(kind.name, kind.n, residual, event, reset, guards, smooth=not kind.stiff_start)


def _signs() -> tuple[str, ...]:
    told: list[str] = []
    for kind in PHASES:
        others = (*kind.own_outcomes[1:], *FALLS)
        told += [f"{kind.name} lasts", f"{kind.name} ends only once"]
        told += [f"no {outcome.name} in {kind.name}" for outcome in others]
    return (*told, "λ4⁺ says whether there is DLS", "λ_I4 holds the rear foot", "Leg 2 extends")


SIGNS = (*_signs(), "mesh")
"""Assumptions about a gait, in the order of the checks. Each phase has its duration and its guards;
then follow the checks at the transitions between phases and the resolution of the mesh."""


@functools.cache
def held_landing(n_legs: int, stop_at_lift_off: bool = True) -> PhaseSequence:
    """Return DLS, SLS-I and SLS-II on the plane section (theta+, dtheta+) after the impact."""
    phases = tuple(_collocated(n_legs, stop_at_lift_off, index) for index in range(len(PHASES)))

    def start(constants: Constants, section: Vector) -> Point:
        s = _symbols(n_legs, constants)
        sin, cos = sine_cosine(section[0])
        distance = s.L0 * s.sin_alpha / rear_direction(s, sin, cos).cos
        return Point((distance,), section[:1], section[1:])

    def border_checks(
        constants: Constants, passages: tuple[Passage, ...], happens: Array
    ) -> Vector:
        dls, sls1, sls2 = passages
        lift_off = phases[0].event(constants, dls.start)
        (theta, _), (dtheta, dL1) = sls2.end.q, sls2.end.v
        landing = transitions.land(_symbols(n_legs, constants), theta, dtheta, dL1)
        return jnp.where(happens[0], lift_off, -lift_off), landing.rear.normal, sls1.end.v[2]

    return PhaseSequence(2, start, phases, border_checks)
