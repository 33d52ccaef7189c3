"""Find limit cycles of each model, check that they are admissible, and differentiate them."""

from vrw_jax.cycles import (
    collocation_search,
    finder,
    gait_surface,
    phase_sequence,
    unilateral_finder,
)
from vrw_jax.cycles.attracting_gaits import find_attracting_gaits, find_slow_gaits
from vrw_jax.cycles.collocation_finder import CollocationFinder
from vrw_jax.cycles.collocation_search import (
    CollocationSystem,
    compute_correction_norm,
)
from vrw_jax.cycles.cycle import CYCLE_MEASURE_FUNCTIONS, AbstractCycle, format_floquet_multipliers
from vrw_jax.cycles.finder import (
    STATE_AGREEMENT_TOLERANCE,
    AbstractGaitFinder,
    Gait,
    GaitFunction,
    GaitMeasureReader,
    MeasureReader,
    confirm_outcome_by_step,
    evaluate_on_gait,
    evaluate_on_gaits,
    is_same_branch,
)
from vrw_jax.cycles.finder_selection import (
    UserCycleGuess,
    make_finder,
    resolve_finder,
    resolve_model,
    resolve_model_with_reason,
)
from vrw_jax.cycles.force_peaks import compute_force_peaks
from vrw_jax.cycles.gait_search import (
    GaitChoice,
    limit_cycle,
    limit_cycles,
    parse_gait_choice,
    search_again_from_walks,
)
from vrw_jax.cycles.gait_walks import compute_walk_starts
from vrw_jax.cycles.limit_cycle_result import LimitCycle, transfer_solution_to_mesh
from vrw_jax.cycles.margin_defaults import compute_takeoff_acceleration, default_margins
from vrw_jax.cycles.options import CycleOptions
from vrw_jax.cycles.return_map_finder import ReturnMapCycle, measure_return_map_force_peaks
from vrw_jax.cycles.sensitivity import sensitivities
from vrw_jax.cycles.slope_response import compute_sensitivity_norms
from vrw_jax.cycles.unilateral_finder import PeriodMap, UnilateralFinder, solve_linear_systems
