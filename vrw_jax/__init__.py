"""Differentiable, batched simulation of the passive viscoelastic-legged rimless wheel."""

import importlib
import importlib.metadata
from typing import TYPE_CHECKING, Any

from vrw_jax.app.explorer import explore
from vrw_jax.base.checks import format_name_suggestion
from vrw_jax.base.options import StepOptions, parameter
from vrw_jax.base.progress import start_jax
from vrw_jax.base.results import Outcome, measure
from vrw_jax.base.walker import AbstractWalker, AdvanceResult
from vrw_jax.branches.arclength import ArclengthOptions
from vrw_jax.branches.branch import Branch, SpecialPoint, SpecialPointCurve
from vrw_jax.branches.continuation import continue_branch, continue_branches
from vrw_jax.branches.map_branch import continue_map
from vrw_jax.branches.special_point_curves import continue_special_point
from vrw_jax.flow.hybrid_system import HybridSystem
from vrw_jax.gaits.cycle import CycleOptions, default_margins
from vrw_jax.gaits.fixed_points import FixedPointResult, solve_fixed_point
from vrw_jax.gaits.gait_search import limit_cycle, limit_cycles, sensitivities
from vrw_jax.gaits.limit_cycle_result import LimitCycle
from vrw_jax.gaits.walker_finder import HybridGait
from vrw_jax.gaits.wheel_finders import ReturnMapCycle
from vrw_jax.models.contact_record import UnilateralStep
from vrw_jax.models.interface import AbstractWheel
from vrw_jax.models.ladder import LadderStep, LadderWheel, ModelChoice
from vrw_jax.models.measures import MEASURES
from vrw_jax.models.rigid import RigidWheel
from vrw_jax.models.step_batch import step_batch
from vrw_jax.models.step_results import (
    DoubleSupportIndicators,
    EnergyLoss,
    Margins,
    RequiredFriction,
    StepResult,
)
from vrw_jax.models.stepping import Walk, choose_model, paper_start, return_map, step, walk
from vrw_jax.models.trajectory import force_peaks, simulate
from vrw_jax.models.unilateral_wheel import UnilateralWheel
from vrw_jax.models.viscoelastic import ViscoelasticWheel
from vrw_jax.models.walk_batch import StepBatchResult
from vrw_jax.studies.basins import BasinShare, basin, basin_share
from vrw_jax.studies.first_passage import FirstPassage, first_passage
from vrw_jax.studies.fit import compare_laws, fit
from vrw_jax.studies.fit_result import FitResult
from vrw_jax.studies.robustness import (
    GaitSensitivity,
    gait_sensitivity,
    measure_basins,
    measure_gait_sensitivity,
)
from vrw_jax.studies.scan_design import grid, saltelli, samples, sobol, sobol_indices, uniform
from vrw_jax.studies.scan_execution import SpecialPointMap, map_special_points, scan
from vrw_jax.studies.scan_store import open_scan
from vrw_jax.studies.stride_pushes import (
    PhaseResponse,
    SmallestDisturbance,
    phase_response,
    smallest_disturbance,
)
from vrw_jax.studies.tolerances import (
    MeasureResult,
    MultifidelityMean,
    measure_to_tolerance,
    multifidelity_mean,
)
from vrw_jax.studies.tune_problem import WheelObjective
from vrw_jax.studies.tuning import ActiveSetChange, OptimumCurve, TuneResult, tune
from vrw_jax.wheel.laws import AlternatingLegs, SpringDamper
from vrw_jax.wheel.parameter_sets import ParameterSet, parameter_sets
from vrw_jax.wheel.params import WheelParams

__all__ = (
    "MEASURES",
    "AbstractWalker",
    "AbstractWheel",
    "ActiveSetChange",
    "AdvanceResult",
    "AlternatingLegs",
    "ArclengthOptions",
    "BasinShare",
    "Branch",
    "CycleOptions",
    "DoubleSupportIndicators",
    "EnergyLoss",
    "FirstPassage",
    "FitResult",
    "FixedPointResult",
    "GaitSensitivity",
    "HybridGait",
    "HybridSystem",
    "LadderStep",
    "LadderWheel",
    "LimitCycle",
    "Margins",
    "MeasureResult",
    "ModelChoice",
    "MultifidelityMean",
    "OptimumCurve",
    "Outcome",
    "ParameterSet",
    "PhaseResponse",
    "RequiredFriction",
    "ReturnMapCycle",
    "RigidWheel",
    "SmallestDisturbance",
    "SpecialPoint",
    "SpecialPointCurve",
    "SpecialPointMap",
    "SpringDamper",
    "StepBatchResult",
    "StepOptions",
    "StepResult",
    "TuneResult",
    "UnilateralStep",
    "UnilateralWheel",
    "ViscoelasticWheel",
    "Walk",
    "WheelObjective",
    "WheelParams",
    "basin",
    "basin_share",
    "choose_model",
    "compare_laws",
    "continue_branch",
    "continue_branches",
    "continue_map",
    "continue_special_point",
    "default_margins",
    "explore",
    "first_passage",
    "fit",
    "force_peaks",
    "gait_sensitivity",
    "grid",
    "limit_cycle",
    "limit_cycles",
    "map_special_points",
    "measure",
    "measure_basins",
    "measure_gait_sensitivity",
    "measure_to_tolerance",
    "multifidelity_mean",
    "open_scan",
    "paper_start",
    "parameter",
    "parameter_sets",
    "phase_response",
    "plot",
    "return_map",
    "saltelli",
    "samples",
    "scan",
    "sensitivities",
    "simulate",
    "smallest_disturbance",
    "sobol",
    "sobol_indices",
    "solve_fixed_point",
    "start_jax",
    "step",
    "step_batch",
    "tune",
    "uniform",
    "walk",
)  # fmt: skip

if TYPE_CHECKING:
    from vrw_jax import plot

    __version__: str


def __getattr__(name: str) -> Any:
    """Return the version, or a public module, which is imported on first use."""
    if name == "__version__":
        return importlib.metadata.version("vrw-jax")
    if name == "continuation":
        return importlib.import_module("vrw_jax.continuation")
    if name == "hybrid":
        return importlib.import_module("vrw_jax.hybrid")
    if name == "plot":  # imports matplotlib only if figures are drawn
        return importlib.import_module("vrw_jax.plot")
    raise AttributeError(
        f"vrw_jax has no {name!r}{format_name_suggestion(name, __all__)}: dir(vrw_jax) lists "
        "what it has."
    )


def __dir__() -> list[str]:
    """Return the public names."""
    return [*__all__, "__version__"]
