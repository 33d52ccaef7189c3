"""Simulation of any hybrid system: modes, guards, resets, events."""

from vrw_jax.base.small_matrices import LCPStatus, enumerate_lcp_solutions
from vrw_jax.flow.hybrid_simulation import (
    Guard,
    HybridSolution,
    HybridStep,
    Mode,
    Termination,
    simulate_hybrid,
)
from vrw_jax.flow.hybrid_system import HybridSystem
from vrw_jax.flow.integrate import PhaseEnd
from vrw_jax.flow.orbits import (
    ReturnMap,
    flow_jacobian_determinant,
    product_multipliers,
    segment_maps,
    time_errors,
)
from vrw_jax.flow.phase_integration import GuardsAndMargins, integrate_phase

__all__ = (
    "Guard",
    "HybridSolution",
    "HybridStep",
    "HybridSystem",
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
)  # The list of `help`.
