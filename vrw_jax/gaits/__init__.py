"""Gaits: steps that repeat, with multipliers and derivatives."""

from vrw_jax.gaits.cycle import CYCLE_MEASURE_FUNCTIONS
from vrw_jax.gaits.derivatives import compute_sensitivity_norms
from vrw_jax.gaits.finder import STATE_AGREEMENT_TOLERANCE, confirm_outcome_by_step
from vrw_jax.gaits.gait_search import make_finder
from vrw_jax.gaits.gait_walks import find_attracting_gaits
from vrw_jax.gaits.gauss import (
    END_WEIGHTS,
    GAUSS_NODES,
    INTEGRATION_MATRIX,
    N_GAUSS_NODES,
    CollocationSolution,
    PhasePoint,
)
