"""Scans: the steady gait of every sample of a design, as one labelled dataset."""

from vrw_jax.scans import design
from vrw_jax.scans.design import LONGEST, SALTELLI, SWEPT, grid, saltelli, samples, sobol, uniform
from vrw_jax.scans.forecast import explained, in_words
from vrw_jax.scans.indices import sobol_indices
from vrw_jax.scans.offer import OF_CYCLE, OFFERS, TO_TOLERANCE, check_measures
from vrw_jax.scans.running import (
    Plan,
    Progress,
    carried,
    found_store,
    open_store,
    plan,
    run,
    scan,
)
from vrw_jax.scans.soundness import manifest_of
from vrw_jax.scans.store import open_scan
