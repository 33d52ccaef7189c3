"""The paper's phases as data for the collocation: dynamics, end events and resets.

`make_held_landing_sequence` uses the plane section (theta+, dtheta+) just after an impact that ends
with both feet on the ground. Its double support may be absent; then the rear foot lifts immediately
(case B3). An impact that throws the rear foot off (case A3) leaves that plane, so the search does
not find such gaits.
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
from vrw_jax.numerics import Elementwise, Vector, compute_sine_cosine
from vrw_jax.wheel import (
    PAPER_PHASES,
    SHARED_FAILURE_OUTCOMES,
    AbstractPhase,
    Motion,
    PhaseInstant,
    Symbols,
    compute_symbols,
    rotate_to_rear_leg,
    transitions,
)

N_LANE_SYMBOLS = 12
"""Number of fields of `Symbols` that vary between lanes. The other fields follow from the number of
legs."""


def compute_phase_constants(n_legs: int, *parameters: Elementwise) -> PhaseConstants:
    """Return the combinations of parameters that all formulas need.

    The arguments are the parameters in their order.
    """
    symbols: tuple[Any, ...] = compute_symbols(n_legs, *parameters)
    return symbols[:N_LANE_SYMBOLS]


def _restore_symbols(n_legs: int, phase_constants: PhaseConstants) -> Symbols:
    """Return all symbols of the wheel from the symbols that vary between lanes."""
    leg_angle = 2.0 * math.pi / n_legs
    symbol_values: tuple[Any, ...] = (
        *phase_constants[:N_LANE_SYMBOLS],
        n_legs,
        math.sin(leg_angle),
        math.cos(leg_angle),
        leg_angle,
    )
    return Symbols(*symbol_values)


def _has_line_turn(phase_constants: PhaseConstants) -> bool:
    """Return whether the last constant is an angle, rad, by which the next line is steeper."""
    return len(phase_constants) > N_LANE_SYMBOLS


def _make_collocation_phase(
    n_legs: int, stop_at_lift_off: bool, phase_index: int
) -> CollocationPhase:
    """Return a phase of the wheel as functions of the constants of `compute_phase_constants`."""
    phase_class = PAPER_PHASES[phase_index]

    def evaluate_phase(
        phase_constants: PhaseConstants, point: PhasePoint
    ) -> tuple[AbstractPhase, Motion]:
        line_turn = (
            compute_sine_cosine(phase_constants[N_LANE_SYMBOLS])
            if _has_line_turn(phase_constants)
            else ()
        )
        phase = phase_class(
            _restore_symbols(n_legs, phase_constants), point.held_constants, True, line_turn
        )
        return phase, phase.compute_motion(point.q, point.v)

    def residual(
        phase_constants: PhaseConstants, point: PhasePoint, acceleration: Vector
    ) -> Vector:
        phase, motion = evaluate_phase(phase_constants, point)
        return phase.compute_dynamics_residual(motion, acceleration)

    def end_event(phase_constants: PhaseConstants, point: PhasePoint) -> Elementwise:
        phase, motion = evaluate_phase(phase_constants, point)
        return phase.compute_end_guard(PhaseInstant(phase, motion, None))

    def guards(phase_constants: PhaseConstants, point: PhasePoint) -> Vector:
        phase, motion = evaluate_phase(phase_constants, point)
        guard_values = phase.compute_guards(PhaseInstant(phase, motion, None))
        # Every guard keeps its index in ADMISSIBILITY_CHECKS, even if it is not checked.
        return (
            guard_values
            if stop_at_lift_off
            else (*guard_values[:-1], jnp.ones_like(guard_values[-1]))
        )

    def reset_to_next_phase(phase_constants: PhaseConstants, point: PhasePoint) -> PhasePoint:
        phase, motion = evaluate_phase(phase_constants, point)
        return PhasePoint(
            (),
            *PAPER_PHASES[phase_index + 1].select_coordinates(
                point.q[0], phase.reset_motion(motion)
            ),
        )

    def reset_to_section(phase_constants: PhaseConstants, point: PhasePoint) -> PhasePoint:
        (theta, _), (dtheta, dL1) = point.q, point.v
        s = _restore_symbols(n_legs, phase_constants)
        theta = (
            theta - phase_constants[N_LANE_SYMBOLS] if _has_line_turn(phase_constants) else theta
        )
        return PhasePoint((), transitions.resolve_two_foot_landing(s, theta, dtheta, dL1), ())

    reset_function = reset_to_section if phase_class is PAPER_PHASES[-1] else reset_to_next_phase
    return CollocationPhase(
        phase_class.name,
        phase_class.n_dof,
        residual,
        end_event,
        reset_function,
        guards,
        is_smooth=not phase_class.has_stiff_start,
    )


def _admissibility_checks() -> tuple[str, ...]:
    """Return the checks of all phases and transitions, each as a phrase."""
    check_phrases: list[str] = []
    for phase_class in PAPER_PHASES:
        failure_outcomes = (*phase_class.guard_outcomes[1:], *SHARED_FAILURE_OUTCOMES)
        check_phrases += [f"{phase_class.name} lasts", f"{phase_class.name} ends only once"]
        check_phrases += [
            f"no {outcome.name} in {phase_class.name}" for outcome in failure_outcomes
        ]
    return (
        *check_phrases,
        "λ4⁺ says whether there is DLS",
        "λ_I4 holds the rear foot",
        "Leg 2 extends",
    )


ADMISSIBILITY_CHECKS = (*_admissibility_checks(), "mesh")
"""Assumptions about a gait, in the order of the checks. The duration and the guards of each phase
come first. The checks at the transitions between phases and the resolution of the mesh follow."""


@functools.cache
def make_held_landing_sequence(n_legs: int, stop_at_lift_off: bool = True) -> PhaseSequence:
    """Return DLS, SLS-I and SLS-II on the plane section (theta+, dtheta+) after the impact."""
    phases = tuple(
        _make_collocation_phase(n_legs, stop_at_lift_off, phase_index)
        for phase_index in range(len(PAPER_PHASES))
    )

    def make_start_point(phase_constants: PhaseConstants, section_state: Vector) -> PhasePoint:
        s = _restore_symbols(n_legs, phase_constants)
        sin, cos = compute_sine_cosine(section_state[0])
        foot_distance = s.L0 * s.sin_alpha / rotate_to_rear_leg(s, sin, cos).cos
        return PhasePoint((foot_distance,), section_state[:1], section_state[1:])

    def evaluate_transition_margins(
        phase_constants: PhaseConstants,
        phase_points: tuple[PhasePoints, ...],
        is_phase_active: Array,
    ) -> Vector:
        dls, sls1, sls2 = phase_points
        lift_off_guard = phases[0].event(phase_constants, dls.start)
        (theta, _), (dtheta, dL1) = sls2.end.q, sls2.end.v
        landing = transitions.resolve_landing(
            _restore_symbols(n_legs, phase_constants), theta, dtheta, dL1
        )
        return (
            jnp.where(is_phase_active[0], lift_off_guard, -lift_off_guard),
            landing.rear_impulse.normal,
            sls1.end.v[2],
        )

    return PhaseSequence(2, make_start_point, phases, evaluate_transition_margins)
