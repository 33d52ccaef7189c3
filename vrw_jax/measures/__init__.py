"""Table of measures and margins: names, symbols, units and descriptions; labeled datasets."""

from vrw_jax.measures.lazy_xarray import xarray
from vrw_jax.measures.mathtext import format_mathtext
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
    SELECTION_MARGIN_NAMES,
    SHARED_STEP_MEASURE_NAMES,
    STEP_MEASURES,
    STOPPER_MARGIN_MEASURES,
    TRAJECTORY_MEASURES,
    UNILATERAL_DIFFERENTIABLE_NAMES,
    UNILATERAL_STEP_MEASURES,
    describe_violation,
    get_measure,
    make_flag_attributes,
    make_labeled_variables,
    make_locked_leg_coordinate,
    make_measure_attributes,
)
