"""The wheel itself: parameters, points, accelerations and forces, phases, jumps, outcomes."""

from vrw_jax.wheel import dynamics, transitions
from vrw_jax.wheel.dynamics import damping_power, mass_matrix, momentum
from vrw_jax.wheel.geometry import (
    Motion,
    double_support_circle,
    double_support_motion,
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
    parameters_of,
    symbols_of,
    wheel_of,
)

__all__ = [
    "DOMAINS",
    "FRICTION",
    "LARGEST",
    "PARAMETER_NAMES",
    "Motion",
    "Outcome",
    "Symbols",
    "WheelParams",
    "damping_power",
    "double_support_circle",
    "double_support_motion",
    "dynamics",
    "landing_direction",
    "landing_foot_height",
    "length_at_touchdown",
    "mass_matrix",
    "momentum",
    "parameters_of",
    "rear_direction",
    "rear_foot_height",
    "symbols_of",
    "transitions",
    "wheel_of",
]
