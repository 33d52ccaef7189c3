"""Integration of motion exactly to the next event, with minima and derivatives."""

from vrw_jax.flow.integrate import integrate_batch_phase
from vrw_jax.flow.solver_steps import (
    compute_real_stability_limit,
    divide_equally,
    load_explicit_tableau,
    sample_batch_phase,
)
