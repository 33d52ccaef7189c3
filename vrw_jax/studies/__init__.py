"""Studies of many gaits: tuning, scans, basins, robustness, tolerances, fits."""

from vrw_jax.studies.scan_engines import find_selection_reasons
from vrw_jax.studies.scan_execution import (
    ScanProgress,
    SpecialPointMap,
    follow_special_points,
    run_scan,
)
from vrw_jax.studies.scan_planning import ScanPlan, plan_scan
from vrw_jax.studies.tune_maximization import TrialKind
from vrw_jax.studies.tuning import tune
