"""Names, units and attributes of all quantities, and the provenance of results."""

from vrw_jax.results.measures import (
    CONTACT_MEASURES,
    LIMIT_CYCLE_MEASURES,
    MARGIN_MEASURES,
    MEASURES,
    PHASE_NAMES,
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
from vrw_jax.results.origin import provenance
