"""The paper's equations for one wheel: parameters, geometry, dynamics, phases."""

from vrw_jax.base.results import Outcome
from vrw_jax.wheel.dynamics import Motion, compute_landing_foot_height, compute_rear_foot_height
from vrw_jax.wheel.params import (
    FRICTION_NAME,
    PARAMETER_DOMAINS,
    PARAMETER_NAMES,
    Symbols,
    WheelParams,
    compute_wheel_units_of_rows,
    make_wheel_from_parameters,
    stack_parameters,
)
from vrw_jax.wheel.phases import PAPER_PHASES, PhaseInstant, PhaseMargins, make_paper_phases
from vrw_jax.wheel.transitions import ContactMode, GroundAhead
