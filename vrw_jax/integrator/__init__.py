"""Batched Runge-Kutta integrator with location of events and minima, and with tangents."""

from vrw_jax.integrator import tableaus
from vrw_jax.integrator.event_location import compute_event_time_tangent
from vrw_jax.integrator.integrate import (
    integrate_batch_phase,
    sample_at_equal_times,
    sample_batch_phase,
)
from vrw_jax.integrator.tableaus import (
    ButcherTableau,
    StageAccelerations,
    StageState,
    compute_real_stability_limit,
    compute_step_size_factor,
    find_guard_minimum,
    fit_guard_parabola,
    load_explicit_tableau,
)
from vrw_jax.integrator.tangents import BatchPhase, ImplicitDynamics, with_batched_jvp
