"""Scans: the steady gait for every sample of a design, as one labeled dataset."""

from vrw_jax.scans import dask, design, execution, forecast, integrity, planning, store
from vrw_jax.scans.design import (
    MAX_LISTED_SAMPLES,
    SALTELLI_DESIGN_KIND,
    SWEEPABLE_PARAMETERS,
    grid,
    saltelli,
    samples,
    sobol,
    uniform,
)
from vrw_jax.scans.execution import (
    ScanProgress,
    find_matching_store,
    open_or_create_store,
    resolve_executor,
    run_scan,
    scan,
)
from vrw_jax.scans.forecast import forecast_scan, format_duration
from vrw_jax.scans.integrity import compute_store_digest, read_metadata_file, read_scan_manifest
from vrw_jax.scans.measure_catalog import (
    DIFFERENTIABLE_MEASURES,
    check_measure_names,
    select_measure_catalog,
)
from vrw_jax.scans.planning import ScanPlan, plan_scan
from vrw_jax.scans.sensitivity_indices import sobol_indices
from vrw_jax.scans.special_point_map import (
    SpecialPointMap,
    follow_special_points,
    map_special_points,
    require_map_grid,
)
from vrw_jax.scans.store import open_scan
