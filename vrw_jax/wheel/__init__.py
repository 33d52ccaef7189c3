"""Wheel parameters, geometry, dynamics, phases, transitions and outcomes."""

from vrw_jax.wheel import dynamics, transitions
from vrw_jax.wheel.dynamics import damping_power, mass_matrix, momentum
from vrw_jax.wheel.geometry import (
    Motion,
    landing_direction,
    landing_foot_height,
    length_at_touchdown,
    rear_direction,
    rear_foot_height,
)
from vrw_jax.wheel.outcomes import Outcome
from vrw_jax.wheel.params import (
    DOMAINS,
    FRICTION,
    LARGEST,
    PARAMETER_NAMES,
    Symbols,
    WheelParams,
    friction_of,
    known_friction,
    parameters_of,
    symbols_of,
    wheel_of,
)
from vrw_jax.wheel.phases import FALLS, PHASES, AbstractPhase, Instant, Premises, phases_of
from vrw_jax.wheel.transitions import Landing
