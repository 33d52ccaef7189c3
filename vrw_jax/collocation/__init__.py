"""Solve for limit cycles by Gauss collocation, with the durations of the phases as unknowns."""

from vrw_jax.collocation.extrema import (
    CollocatedPhaseMotion,
    PhaseExtrema,
    find_quantity_extrema,
)
from vrw_jax.collocation.gauss import (
    DOUBLE_END_WEIGHTS,
    DOUBLE_INTEGRATION_MATRIX,
    END_WEIGHTS,
    GAUSS_NODES,
    INTEGRATION_MATRIX,
    N_GAUSS_NODES,
    PhaseMesh,
    build_differentiation_matrix,
    compute_integration_weights,
    compute_lagrange_weights,
    transfer_accelerations,
)
from vrw_jax.collocation.phase_collocation import (
    CollocationPhase,
    CollocationSolution,
    CycleLinearization,
    PhaseConstants,
    PhasePoint,
    PhasePoints,
    PhaseSequence,
    estimate_mesh_error,
    linearize_cycle,
    reconstruct_gait_step,
)
