"""Wheel parameters, geometry, dynamics, phases, transitions and outcomes."""

from vrw_jax.wheel import dynamics, geometry, transitions
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
from vrw_jax.wheel.parameter_sets import ParameterSet, parameter_sets
from vrw_jax.wheel.params import (
    FRICTION_NAME,
    MAX_SI_VALUE,
    PARAMETER_DOMAINS,
    PARAMETER_NAMES,
    UNIT_POWERS,
    Symbols,
    WheelParams,
    check_parameter_name,
    compute_symbols,
    convert_friction,
    refuse_symbol,
    require_known_friction,
    stack_parameters,
    wheel_from_parameters,
)
from vrw_jax.wheel.phases import (
    PAPER_PHASES,
    SHARED_FAILURE_OUTCOMES,
    AbstractPhase,
    PhaseInstant,
    PhaseMargins,
    make_phases,
)
from vrw_jax.wheel.rest import is_at_rest, is_still, replace_rest_outcome
from vrw_jax.wheel.transitions import Landing
from vrw_jax.wheel.units import (
    WheelUnits,
    compute_wheel_units,
    compute_wheel_units_of_rows,
    convert_to_wheel_units,
)
