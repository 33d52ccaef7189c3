"""Steps, walks, trajectories, and the attractors that walks reach."""

from vrw_jax.walks.basins import PRE_TOUCHDOWN_NAMES, basin
from vrw_jax.walks.stepping import (
    ModelLike,
    Walk,
    check_model,
    check_options,
    check_section_state,
    check_single_wheel,
    choose_model,
    paper_start,
    return_map,
    step,
    validate_arguments,
    walk,
    walk_toward_gait,
)
from vrw_jax.walks.trajectory import simulate
