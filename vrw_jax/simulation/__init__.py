"""Simulation of single steps, walks, trajectories, attractors and basins."""

from vrw_jax.simulation.basins import (
    basin,
    compute_section_states_of_starts,
    select_start_components,
)
from vrw_jax.simulation.force_peaks import SAMPLED_FORCE_PEAK_MEASURES, force_peaks
from vrw_jax.simulation.provenance import collect_provenance_attributes
from vrw_jax.simulation.stepping import (
    ModelLike,
    Walk,
    choose_model,
    convert_model_argument,
    convert_section_state,
    convert_step_arguments,
    convert_step_options,
    paper_start,
    require_compliant_model,
    require_single_wheel,
    return_map,
    start_walk_toward_gait,
    step,
    walk,
)
from vrw_jax.simulation.trajectory import simulate
