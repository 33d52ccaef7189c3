"""Simulation of single steps, walks, trajectories, attractors and basins."""

from vrw_jax.simulation.basins import basin, invert_landing_map
from vrw_jax.simulation.force_peaks import SAMPLED_FORCE_PEAK_MEASURES, force_peaks
from vrw_jax.simulation.stepping import (
    ModelLike,
    Walk,
    check_model,
    check_section_state,
    check_single_wheel,
    check_step_options,
    choose_model,
    paper_start,
    return_map,
    step,
    validate_arguments,
    walk,
    walk_toward_gait,
)
from vrw_jax.simulation.trajectory import simulate
