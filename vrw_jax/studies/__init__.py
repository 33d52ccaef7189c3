"""Studies of many gaits: tuning, scans, basins, robustness, tolerances, fits."""

from vrw_jax.studies.scan_execution import ScanProgress, run_scan
from vrw_jax.studies.scan_planning import ScanPlan, plan_scan
from vrw_jax.studies.special_point_map import SpecialPointMap, follow_special_points
from vrw_jax.studies.tune_maximization import TrialKind
from vrw_jax.studies.tune_problem import tune
