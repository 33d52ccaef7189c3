"""Differentiable, batched simulation of the passive viscoelastic-legged rimless wheel."""

import importlib
import importlib.metadata
from typing import TYPE_CHECKING, Any

from vrw_jax.batches import StepBatchResult, step_batch
from vrw_jax.branches import (
    Branch,
    SpecialPoint,
    SpecialPointCurve,
    continue_branch,
    continue_branches,
    continue_map,
    continue_special_point,
)
from vrw_jax.contact import UnilateralStep, UnilateralWheel
from vrw_jax.continuation import ArclengthOptions, FixedPointResult, solve_fixed_point
from vrw_jax.cycles import (
    CycleOptions,
    LimitCycle,
    ReturnMapCycle,
    default_margins,
    limit_cycle,
    limit_cycles,
    sensitivities,
)
from vrw_jax.measures import MEASURES
from vrw_jax.models import (
    AbstractWheel,
    DoubleSupportIndicators,
    EnergyLoss,
    Margins,
    RequiredFriction,
    RigidWheel,
    StepResult,
    ViscoelasticWheel,
)
from vrw_jax.numerics import StepOptions
from vrw_jax.robustness import (
    BasinShare,
    FirstPassage,
    GaitSensitivity,
    SmallestDisturbance,
    basin_share,
    first_passage,
    gait_sensitivity,
    measure_basins,
    measure_gait_sensitivity,
    smallest_disturbance,
)
from vrw_jax.runtime import start_jax
from vrw_jax.scans import (
    SpecialPointMap,
    grid,
    map_special_points,
    open_scan,
    saltelli,
    samples,
    scan,
    sobol,
    sobol_indices,
    uniform,
)
from vrw_jax.selection import LadderStep, LadderWheel, ModelChoice
from vrw_jax.simulation import (
    Walk,
    basin,
    choose_model,
    force_peaks,
    paper_start,
    return_map,
    simulate,
    step,
    walk,
)
from vrw_jax.tolerance import (
    MeasureResult,
    MultifidelityMean,
    measure_to_tolerance,
    multifidelity_mean,
)
from vrw_jax.tuning import TuneResult, WheelObjective, tune
from vrw_jax.validation import format_name_suggestion
from vrw_jax.web import explore
from vrw_jax.wheel import Outcome, ParameterSet, WheelParams, parameter_sets

__all__ = (
    "MEASURES",
    "AbstractWheel",
    "ArclengthOptions",
    "BasinShare",
    "Branch",
    "CycleOptions",
    "DoubleSupportIndicators",
    "EnergyLoss",
    "FirstPassage",
    "FixedPointResult",
    "GaitSensitivity",
    "LadderStep",
    "LadderWheel",
    "LimitCycle",
    "Margins",
    "MeasureResult",
    "ModelChoice",
    "MultifidelityMean",
    "Outcome",
    "ParameterSet",
    "RequiredFriction",
    "ReturnMapCycle",
    "RigidWheel",
    "SmallestDisturbance",
    "SpecialPoint",
    "SpecialPointCurve",
    "SpecialPointMap",
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
    "continue_branch",
    "continue_branches",
    "continue_map",
    "continue_special_point",
    "default_margins",
    "explore",
    "first_passage",
    "force_peaks",
    "gait_sensitivity",
    "grid",
    "limit_cycle",
    "limit_cycles",
    "map_special_points",
    "measure_basins",
    "measure_gait_sensitivity",
    "measure_to_tolerance",
    "multifidelity_mean",
    "open_scan",
    "paper_start",
    "parameter_sets",
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
    from vrw_jax import figures as plot

    __version__: str


def __getattr__(name: str) -> Any:
    """Return the version, or the package of figures, which is imported on first use."""
    if name == "__version__":
        return importlib.metadata.version("vrw-jax")
    if name == "plot":  # imports matplotlib only if figures are drawn
        return importlib.import_module("vrw_jax.figures")
    raise AttributeError(
        f"vrw_jax has no {name!r}{format_name_suggestion(name, __all__)}: dir(vrw_jax) lists "
        "what it has."
    )


def __dir__() -> list[str]:
    """Return the public names."""
    return [*__all__, "__version__"]
