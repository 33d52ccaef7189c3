"""Differentiable, batched simulation of the passive viscoelastic-legged rimless wheel."""

import importlib
import importlib.metadata
from typing import TYPE_CHECKING, Any

from vrw_jax.answers import Answer, Average, answer, average
from vrw_jax.batches import Steps, steps
from vrw_jax.branches import (
    Border,
    BorderCurve,
    Branch,
    border_curve,
    continue_branch,
    continue_branches,
    continue_map,
)
from vrw_jax.cycles import (
    CycleOptions,
    LimitCycle,
    WalkedCycle,
    default_margins,
    sensitivities,
)
from vrw_jax.gaits import limit_cycle, limit_cycles
from vrw_jax.models import (
    AbstractWheel,
    EnergyLoss,
    Indicators,
    LadderStep,
    LadderWheel,
    Margins,
    ModelChoice,
    RigidWheel,
    StepResult,
    UnilateralStep,
    UnilateralWheel,
    ViscoelasticWheel,
)
from vrw_jax.numerics import ArclengthOptions, Options, SectionCycle, newton_cycle
from vrw_jax.results import MEASURES
from vrw_jax.runtime import start_jax
from vrw_jax.scans import grid, open_scan, saltelli, samples, scan, sobol, sobol_indices, uniform
from vrw_jax.tuning import Tuned, tune
from vrw_jax.walks import Walk, basin, choose_model, paper_start, return_map, simulate, step, walk
from vrw_jax.web import explore
from vrw_jax.wheel import Outcome, WheelParams
from vrw_jax.wording import nearest

__all__ = (
    "MEASURES",
    "AbstractWheel",
    "Answer",
    "ArclengthOptions",
    "Average",
    "Border",
    "BorderCurve",
    "Branch",
    "CycleOptions",
    "EnergyLoss",
    "Indicators",
    "LadderStep",
    "LadderWheel",
    "LimitCycle",
    "Margins",
    "ModelChoice",
    "Options",
    "Outcome",
    "RigidWheel",
    "SectionCycle",
    "StepResult",
    "Steps",
    "Tuned",
    "UnilateralStep",
    "UnilateralWheel",
    "ViscoelasticWheel",
    "Walk",
    "WalkedCycle",
    "WheelParams",
    "answer",
    "average",
    "basin",
    "border_curve",
    "choose_model",
    "continue_branch",
    "continue_branches",
    "continue_map",
    "default_margins",
    "explore",
    "grid",
    "limit_cycle",
    "limit_cycles",
    "newton_cycle",
    "open_scan",
    "paper_start",
    "plot",
    "return_map",
    "saltelli",
    "samples",
    "scan",
    "sensitivities",
    "simulate",
    "sobol",
    "sobol_indices",
    "start_jax",
    "step",
    "steps",
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
        f"vrw_jax has no {name!r}{nearest(name, __all__)}: dir(vrw_jax) lists what it has."
    )


def __dir__() -> list[str]:
    """Return the public names."""
    return [*__all__, "__version__"]
