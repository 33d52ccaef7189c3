"""Table of measures and margins: names, symbols, units and meanings."""

from vrw_jax.measures.provenance import provenance
from vrw_jax.measures.table import (
    CONTACT_MEASURES,
    CONTACT_MODE_NAMES,
    DIFFERENTIABLE_STEP_NAMES,
    FORCE_PEAK_MEASURES,
    GAIT_SENSITIVITY_MEASURES,
    LIMIT_CYCLE_MEASURES,
    MARGIN_MEASURES,
    MEASURES,
    PASSAGE_MEASURES,
    PHASE_NAMES,
    POST_LANDING_COMPONENT_NAMES,
    PRE_TOUCHDOWN_COMPONENT_NAMES,
    SHARED_STEP_MEASURE_NAMES,
    STEP_MEASURES,
    STOPPER_MARGIN_MEASURES,
    TRAJECTORY_MEASURES,
    UNILATERAL_DIFFERENTIABLE_NAMES,
    UNILATERAL_STEP_MEASURES,
    describe_violation,
    flag_attrs,
    get_measure,
    locked_leg_coordinate,
    make_variables,
    measure_attrs,
)
