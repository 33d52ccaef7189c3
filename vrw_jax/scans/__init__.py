"""The steady gait of every sample of a design, as one labelled dataset."""

from vrw_jax.scans import design
from vrw_jax.scans.design import SALTELLI, SWEPT, grid, saltelli, samples, sobol, uniform
from vrw_jax.scans.indices import sobol_indices
from vrw_jax.scans.offer import DEFAULT_MEASURES, OF_CYCLE, check_measures
from vrw_jax.scans.running import (
    Plan,
    Progress,
    carried,
    explained,
    in_words,
    open_store,
    plan,
    run,
    scan,
)
from vrw_jax.scans.store import open_scan
