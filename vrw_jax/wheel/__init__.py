"""Wheel parameters, geometry, dynamics, phases, transitions and outcomes."""

from vrw_jax.wheel import dynamics, geometry, transitions
from vrw_jax.wheel.dynamics import compute_damping_power, compute_mass_matrix, compute_momentum
from vrw_jax.wheel.foot_contact import ContactMode
from vrw_jax.wheel.geometry import (
    Motion,
    compute_landing_foot_height,
    compute_length_at_touchdown,
    compute_rear_foot_height,
    rotate_to_landing_leg,
    rotate_to_rear_leg,
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
    make_wheel_from_parameters,
    raise_for_parameter_symbol,
    require_known_friction,
    stack_parameters,
)
from vrw_jax.wheel.phases import (
    PAPER_PHASES,
    TRANSITION_ASSUMPTIONS,
    AbstractPhase,
    Assumption,
    PhaseInstant,
    PhaseMargins,
    make_paper_phases,
)
from vrw_jax.wheel.rest import are_coordinates_at_rest, are_rates_negligible, replace_rest_outcome
from vrw_jax.wheel.transitions import Landing
from vrw_jax.wheel.units import (
    WheelUnits,
    compute_wheel_units,
    compute_wheel_units_of_rows,
)
