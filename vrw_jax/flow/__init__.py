"""Integration of motion exactly to the next event, with minima and derivatives."""

from vrw_jax.flow.integrate import (
    divide_equally,
    integrate_batch_phase,
    sample_batch_phase,
)
from vrw_jax.flow.tableaus import compute_real_stability_limit, load_explicit_tableau
from vrw_jax.flow.tangents import with_batched_jvp
