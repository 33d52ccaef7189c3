"""Limit cycles: finders, checks and derivatives for each model."""

from vrw_jax.cycles.attracting import (
    START_DISTANCE,
    compute_fallback_starts,
    compute_walk_starts,
    find_attracting_gaits,
    find_slow_gaits,
    find_slowest_indices,
)
from vrw_jax.cycles.by_collocation import CollocationFinder
from vrw_jax.cycles.by_walking import ReturnMapCycle
from vrw_jax.cycles.collocated import LimitCycle, transfer_to_mesh
from vrw_jax.cycles.cycle import CYCLE_MEASURE_FUNCTIONS, AbstractCycle, format_multipliers
from vrw_jax.cycles.derivatives import compile_batched
from vrw_jax.cycles.finder import (
    STATE_AGREEMENT_TOLERANCE,
    AbstractGaitFinder,
    Gait,
    MeasureReader,
    confirm_outcome,
    evaluate_on_gait,
    evaluate_on_gaits,
    is_same_branch,
)
from vrw_jax.cycles.finding import (
    Guess,
    check_guess,
    make_finder,
    resolve_finder,
    resolve_model,
    resolve_model_with_reason,
)
from vrw_jax.cycles.on_ground import PeriodMap, solve_linear_systems
from vrw_jax.cycles.options import CycleOptions
from vrw_jax.cycles.premises import default_margins, gait_takeoff_acceleration
from vrw_jax.cycles.search import (
    CollocationState,
    CollocationSystem,
    collocation_correction_norm,
    init_search_flags,
)
from vrw_jax.cycles.sensitivity import sensitivities
