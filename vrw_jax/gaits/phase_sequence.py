"""Describe the phases of the paper's model for the collocation: dynamics, end events and resets.

`make_post_impact_sequence` uses the plane section (theta+, dtheta+) just after an impact that ends
with both feet on the ground. If double support is absent, the rear foot lifts immediately (case B3
of the paper). An impact at which the rear foot leaves the ground (case A3) is not in that plane.
The search therefore does not find such gaits.
"""

import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from vrw_jax.base.elementwise import compute_sine_cosine
from vrw_jax.base.types import Elementwise, Vector
from vrw_jax.gaits.phase_collocation import (
    CollocationPhase,
    PhaseConstants,
    PhasePoint,
    PhasePoints,
    PhaseSequence,
)
from vrw_jax.wheel import transitions
from vrw_jax.wheel.dynamics import rotate_to_rear_leg
from vrw_jax.wheel.laws import scale_laws
from vrw_jax.wheel.params import (
    NO_LAWS,
    PARAMETER_NAMES,
    Symbols,
    WheelLaws,
    compute_symbols,
)
from vrw_jax.wheel.phases import PAPER_PHASES, TRANSITION_ASSUMPTIONS, Assumption, PhaseInstant

N_SYMBOL_CONSTANTS = 12
"""Number of those fields of `Symbols` that vary between wheels.

The other fields follow from the number of legs.
"""


N_LAW_SCALES = 3
"""Number of the values after those of the laws: their share, and the units of length and time."""


def count_phase_constants(law_structure: Any) -> int:
    """Return the number of constants on flat ground."""
    if law_structure == NO_LAWS:
        return N_SYMBOL_CONSTANTS
    return N_SYMBOL_CONSTANTS + law_structure.num_leaves + N_LAW_SCALES


def compute_phase_constants(
    n_legs: int, law_structure: Any, *parameters: Elementwise
) -> PhaseConstants:
    """Return the combinations of parameters that occur in the formulas of all phases.

    The arguments are the parameters in the order of `stack_parameters`. In a search, the values of
    `scale_laws` follow those of the laws.
    """
    n_wheel_parameters = len(PARAMETER_NAMES)
    wheel_symbols: tuple[Any, ...] = compute_symbols(n_legs, *parameters[:n_wheel_parameters])
    constants = (*wheel_symbols[:N_SYMBOL_CONSTANTS], *parameters[n_wheel_parameters:])
    n_missing_scales = count_phase_constants(law_structure) - len(constants)
    return constants + (jnp.ones_like(parameters[0]),) * n_missing_scales


def exchange_legs(
    law_structure: Any, phase_constants: PhaseConstants, parity: Any
) -> PhaseConstants:
    """Return the constants of a later step of a wheel whose legs may alternate.

    - `parity`: 1 if the number of steps until then is odd, otherwise 0.
    """
    end = N_SYMBOL_CONSTANTS + law_structure.num_leaves
    laws = jax.tree.unflatten(law_structure, phase_constants[N_SYMBOL_CONSTANTS:end])
    law_values = jax.tree.leaves(laws.exchange_legs(parity))
    return (*phase_constants[:N_SYMBOL_CONSTANTS], *law_values, *phase_constants[end:])


def has_alternating_legs(law_structure: Any) -> bool:
    """Return whether the laws of the legs alternate from step to step."""
    if law_structure == NO_LAWS:
        return False
    return jax.tree.unflatten(law_structure, [0.0] * law_structure.num_leaves).leg_period == 2


def _restore_symbols(n_legs: int, law_structure: Any, phase_constants: PhaseConstants) -> Symbols:
    """Return all symbols of a wheel, computed from the symbols that vary between wheels."""
    laws = WheelLaws()
    if law_structure != NO_LAWS:
        n_constants = count_phase_constants(law_structure)
        law_constants = phase_constants[N_SYMBOL_CONSTANTS:n_constants]
        law_values, scales = law_constants[:-N_LAW_SCALES], law_constants[-N_LAW_SCALES:]
        laws = scale_laws(jax.tree.unflatten(law_structure, law_values), *scales)
    leg_angle = 2.0 * math.pi / n_legs
    symbol_values: tuple[Any, ...] = (
        *phase_constants[:N_SYMBOL_CONSTANTS],
        n_legs,
        math.sin(leg_angle),
        math.cos(leg_angle),
        leg_angle,
        laws.leg,
        laws.hub,
    )
    return Symbols(*symbol_values)


def _make_collocation_phase(
    n_legs: int, stop_at_lift_off: bool, law_structure: Any, phase_index: int
) -> CollocationPhase:
    """Describe the phase with index `phase_index` by functions.

    The functions take the constants that `compute_phase_constants` returns. A further constant may
    follow, the angle by which the next line of the ground is steeper, rad.
    """
    phase_class = PAPER_PHASES[phase_index]
    n_constants = count_phase_constants(law_structure)

    def make_instant(phase_constants: PhaseConstants, phase_point: PhasePoint) -> PhaseInstant:
        tilt = phase_constants[n_constants:]
        wheel_phase = phase_class(
            _restore_symbols(n_legs, law_structure, phase_constants),
            phase_point.held_constants,
            True,
            compute_sine_cosine(*tilt) if tilt else (),
        )
        return PhaseInstant(wheel_phase, wheel_phase.compute_motion(phase_point.q, phase_point.v))

    def evaluate_dynamics_residual(
        phase_constants: PhaseConstants, phase_point: PhasePoint, phase_acceleration: Vector
    ) -> Vector:
        instant = make_instant(phase_constants, phase_point)
        return instant.phase.compute_dynamics_residual(instant.motion, phase_acceleration)

    def evaluate_end_event(phase_constants: PhaseConstants, phase_point: PhasePoint) -> Elementwise:
        instant = make_instant(phase_constants, phase_point)
        return instant.phase.compute_end_guard(instant)

    def evaluate_phase_guards(phase_constants: PhaseConstants, phase_point: PhasePoint) -> Vector:
        instant = make_instant(phase_constants, phase_point)
        guard_values = instant.phase.compute_guards(instant)
        # Every guard keeps its index in ADMISSIBILITY_CHECKS, even if it is not checked.
        return (
            guard_values
            if stop_at_lift_off
            else (*guard_values[:-1], jnp.ones_like(guard_values[-1]))
        )

    def reset_to_next_phase(phase_constants: PhaseConstants, phase_point: PhasePoint) -> PhasePoint:
        instant = make_instant(phase_constants, phase_point)
        return PhasePoint(
            (),
            *PAPER_PHASES[phase_index + 1].select_phase_coordinates(
                phase_point.q[0], instant.phase.reset_motion(instant.motion)
            ),
        )

    def reset_to_section(phase_constants: PhaseConstants, phase_point: PhasePoint) -> PhasePoint:
        (theta, _), (dtheta, dL1) = phase_point.q, phase_point.v
        s = _restore_symbols(n_legs, law_structure, phase_constants)
        if tilt := phase_constants[n_constants:]:
            theta = theta - tilt[0]
        return PhasePoint((), transitions.resolve_two_foot_landing(s, theta, dtheta, dL1), ())

    reset_function = reset_to_section if phase_class is PAPER_PHASES[-1] else reset_to_next_phase
    return CollocationPhase(
        phase_class.phase_name,
        phase_class.n_dof,
        evaluate_dynamics_residual,
        evaluate_end_event,
        reset_function,
        evaluate_phase_guards,
        is_motion_smooth=not phase_class.has_stiff_start,
    )


ADMISSIBILITY_CHECKS: tuple[Assumption, ...] = (
    *(
        assumption
        for phase_class in PAPER_PHASES
        for assumption in (
            Assumption(f"{phase_class.phase_title} has no duration", "the duration", "T", "s"),
            *phase_class.list_assumptions(),
        )
    ),
    *TRANSITION_ASSUMPTIONS,
    Assumption("the mesh is too coarse", "the mesh", "", ""),
)
"""Assumptions about a gait, in the order in which they are checked.

The first checks concern the duration and the guards of each phase. Checks of the transitions
between phases and of the mesh follow.
"""


@functools.cache
def make_post_impact_sequence(
    n_legs: int, stop_at_lift_off: bool = True, law_structure: Any = NO_LAWS
) -> PhaseSequence:
    """Build the sequence DLS, SLS-I and SLS-II on the plane section (theta+, dtheta+) after the
    impact.
    """
    collocation_phases = tuple(
        _make_collocation_phase(n_legs, stop_at_lift_off, law_structure, phase_index)
        for phase_index in range(len(PAPER_PHASES))
    )

    def make_start_point(phase_constants: PhaseConstants, section_state: Vector) -> PhasePoint:
        s = _restore_symbols(n_legs, law_structure, phase_constants)
        sine, cosine = compute_sine_cosine(section_state[0])
        foot_distance = s.L0 * s.sin_alpha / rotate_to_rear_leg(s, sine, cosine).cos
        return PhasePoint((foot_distance,), section_state[:1], section_state[1:])

    def evaluate_transition_margins(
        phase_constants: PhaseConstants,
        phase_points: tuple[PhasePoints, ...],
        is_phase_active: Array,
    ) -> Vector:
        dls_points, sls1_points, sls2_points = phase_points
        lift_off_guard = collocation_phases[0].end_event_function(
            phase_constants, dls_points.phase_start_point
        )
        (theta, _), (dtheta, dL1) = sls2_points.phase_end_point.q, sls2_points.phase_end_point.v
        landing_result = transitions.resolve_landing(
            _restore_symbols(n_legs, law_structure, phase_constants), theta, dtheta, dL1
        )
        return (
            jnp.where(is_phase_active[0], lift_off_guard, -lift_off_guard),
            landing_result.rear_impulse.normal,
            sls1_points.phase_end_point.v[2],
        )

    return PhaseSequence(
        2,
        make_start_point,
        collocation_phases,
        evaluate_transition_margins,
        functools.partial(exchange_legs, law_structure)
        if has_alternating_legs(law_structure)
        else None,
    )
