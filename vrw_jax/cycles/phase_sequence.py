"""The paper's phases as data for the collocation: dynamics, end events and resets.

`held_landing_sequence` uses the plane section (theta+, dtheta+) just after an impact that ends with
both feet on the ground. Its double support may be absent; then the rear foot lifts immediately
(case B3). An impact that throws the rear foot off (case A3) leaves that plane, so such gaits are
not found here.
"""

import functools
import math
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array

from vrw_jax.collocation import (
    CollocationPhase,
    PhaseConstants,
    PhasePoint,
    PhasePoints,
    PhaseSequence,
)
from vrw_jax.numerics import Elementwise, Vector, sine_cosine
from vrw_jax.wheel import (
    PAPER_PHASES,
    SHARED_FAILURE_OUTCOMES,
    AbstractPhase,
    Motion,
    PhaseInstant,
    Symbols,
    compute_symbols,
    rear_direction,
    transitions,
)

N_LANE_CONSTANTS = 12
"""Number of fields of `Symbols` that vary between lanes. The other fields follow from the number
of legs.
"""


def compute_constants(n_legs: int, *parameters: Elementwise) -> PhaseConstants:
    """Return the combinations of parameters that all formulas need, from the parameters in their
    order.
    """
    symbols: tuple[Any, ...] = compute_symbols(n_legs, *parameters)
    return symbols[:N_LANE_CONSTANTS]


def _make_symbols(n_legs: int, constants: PhaseConstants) -> Symbols:
    """Return all symbols of the wheel from those that vary between lanes."""
    alpha = 2.0 * math.pi / n_legs
    fields: tuple[Any, ...] = (
        *constants[:N_LANE_CONSTANTS],
        n_legs,
        math.sin(alpha),
        math.cos(alpha),
        alpha,
    )
    return Symbols(*fields)


def _is_uneven(constants: PhaseConstants) -> bool:
    """Return whether the last of the constants is the angle, rad, by which the next line is
    steeper.
    """
    return len(constants) > N_LANE_CONSTANTS


def _make_collocation_phase(
    n_legs: int, stop_at_lift_off: bool, phase_index: int
) -> CollocationPhase:
    """Return a phase of the wheel as functions of the constants of `compute_constants`."""
    phase_class = PAPER_PHASES[phase_index]

    def evaluate_phase(
        constants: PhaseConstants, point: PhasePoint
    ) -> tuple[AbstractPhase, Motion]:
        line_turn = sine_cosine(constants[N_LANE_CONSTANTS]) if _is_uneven(constants) else ()
        phase = phase_class(_make_symbols(n_legs, constants), point.held_constants, True, line_turn)
        return phase, phase.motion_at(point.q, point.v)

    def residual(constants: PhaseConstants, point: PhasePoint, acceleration: Vector) -> Vector:
        phase, motion = evaluate_phase(constants, point)
        return phase.dynamics_residual(motion, acceleration)

    def end_event(constants: PhaseConstants, point: PhasePoint) -> Elementwise:
        phase, motion = evaluate_phase(constants, point)
        return phase.end_guard(PhaseInstant(phase, motion, None))

    def guards(constants: PhaseConstants, point: PhasePoint) -> Vector:
        phase, motion = evaluate_phase(constants, point)
        guards = phase.guards(PhaseInstant(phase, motion, None))
        # Every guard keeps its index in ADMISSIBILITY_CHECKS, even a guard that is not checked.
        return guards if stop_at_lift_off else (*guards[:-1], jnp.ones_like(guards[-1]))

    def reset_to_next_phase(constants: PhaseConstants, point: PhasePoint) -> PhasePoint:
        phase, motion = evaluate_phase(constants, point)
        return PhasePoint(
            (),
            *PAPER_PHASES[phase_index + 1].select_coordinates(point.q[0], phase.reset_map(motion)),
        )

    def reset_to_section(constants: PhaseConstants, point: PhasePoint) -> PhasePoint:
        (theta, _), (dtheta, dL1) = point.q, point.v
        s = _make_symbols(n_legs, constants)
        theta = theta - constants[N_LANE_CONSTANTS] if _is_uneven(constants) else theta
        return PhasePoint((), transitions.land_on_both_feet(s, theta, dtheta, dL1), ())

    reset = reset_to_section if phase_class is PAPER_PHASES[-1] else reset_to_next_phase
    return CollocationPhase(
        phase_class.name,
        phase_class.n_dof,
        residual,
        end_event,
        reset,
        guards,
        is_smooth=not phase_class.has_stiff_start,
    )


def _admissibility_checks() -> tuple[str, ...]:
    """Return the checks of all phases and transitions, each as a phrase."""
    checks: list[str] = []
    for phase_class in PAPER_PHASES:
        failure_outcomes = (*phase_class.guard_outcomes[1:], *SHARED_FAILURE_OUTCOMES)
        checks += [f"{phase_class.name} lasts", f"{phase_class.name} ends only once"]
        checks += [f"no {outcome.name} in {phase_class.name}" for outcome in failure_outcomes]
    return (*checks, "λ4⁺ says whether there is DLS", "λ_I4 holds the rear foot", "Leg 2 extends")


ADMISSIBILITY_CHECKS = (*_admissibility_checks(), "mesh")
"""Assumptions about a gait, in the order of the checks. Each phase has its duration and its
guards. The checks at the transitions between phases and the resolution of the mesh follow.
"""


@functools.cache
def held_landing_sequence(n_legs: int, stop_at_lift_off: bool = True) -> PhaseSequence:
    """Return DLS, SLS-I and SLS-II on the plane section (theta+, dtheta+) after the impact."""
    phases = tuple(
        _make_collocation_phase(n_legs, stop_at_lift_off, phase_index)
        for phase_index in range(len(PAPER_PHASES))
    )

    def make_start_point(constants: PhaseConstants, section: Vector) -> PhasePoint:
        s = _make_symbols(n_legs, constants)
        sin, cos = sine_cosine(section[0])
        distance = s.L0 * s.sin_alpha / rear_direction(s, sin, cos).cos
        return PhasePoint((distance,), section[:1], section[1:])

    def transition_checks(
        constants: PhaseConstants, phase_points: tuple[PhasePoints, ...], is_active: Array
    ) -> Vector:
        dls, sls1, sls2 = phase_points
        lift_off_guard = phases[0].event(constants, dls.start)
        (theta, _), (dtheta, dL1) = sls2.end.q, sls2.end.v
        landing = transitions.land(_make_symbols(n_legs, constants), theta, dtheta, dL1)
        return (
            jnp.where(is_active[0], lift_off_guard, -lift_off_guard),
            landing.rear_impulse.normal,
            sls1.end.v[2],
        )

    return PhaseSequence(2, make_start_point, phases, transition_checks)
