"""Solve for limit cycles by Gauss collocation, with the durations of the phases as unknowns."""

from vrw_jax.collocation.extrema import (
    CollocatedPhaseMotion,
    PhaseExtrema,
    find_quantity_extrema,
)
from vrw_jax.collocation.gauss import (
    END_WEIGHTS,
    GAUSS_NODES,
    INTEGRATION_MATRIX,
    N_GAUSS_NODES,
    PhaseMesh,
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
