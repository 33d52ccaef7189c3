"""Hybrid dynamical systems of any kind: modes, guards and resets, integrated by diffrax."""

from vrw_jax.hybrid.complementarity import LCPStatus, enumerate_lcp_solutions
from vrw_jax.hybrid.minima import (
    GUARD_ROUNDOFF_IN_EPS,
    GuardsAndMargins,
    StateArray,
)
from vrw_jax.hybrid.phase_integration import (
    PhaseEnd,
    VectorField,
    integrate_phase,
)
from vrw_jax.hybrid.return_map import ReturnMap
from vrw_jax.hybrid.saltation import flow_jacobian_determinant
from vrw_jax.hybrid.scaled_integration import (
    integrate_phase_in_scaled_units,
    sample_phase_in_scaled_units,
)
from vrw_jax.hybrid.segments import product_multipliers, segment_maps
from vrw_jax.hybrid.simulation import (
    Guard,
    HybridSolution,
    Mode,
    Termination,
    simulate_hybrid,
    time_errors,
)
from vrw_jax.simd.program_cache import get_compiled_program

__all__ = (
    "Guard",
    "HybridSolution",
    "LCPStatus",
    "Mode",
    "ReturnMap",
    "Termination",
    "enumerate_lcp_solutions",
    "flow_jacobian_determinant",
    "product_multipliers",
    "segment_maps",
    "simulate_hybrid",
    "time_errors",
)  # The list of `help(vrw_jax.hybrid)`.
