"""Differentiable, batched simulation of the passive viscoelastic-legged rimless wheel."""

from vrw_jax.arclength import ArclengthOptions
from vrw_jax.basin import basin
from vrw_jax.branch import Border, Branch
from vrw_jax.continuation import continue_branch, continue_branches, continue_map
from vrw_jax.cycle_options import CycleOptions
from vrw_jax.designs import grid, saltelli, samples, sobol, uniform
from vrw_jax.lane_batch import Steps, steps
from vrw_jax.limit_cycle import LimitCycle, limit_cycle
from vrw_jax.model_choice import choose_model
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
from vrw_jax.options import Options
from vrw_jax.outcomes import Outcome
from vrw_jax.params import WheelParams
from vrw_jax.return_map import Walk, paper_start, return_map, step, walk
from vrw_jax.scan import scan
from vrw_jax.scan_store import open_scan
from vrw_jax.section_newton import SectionCycle, newton_cycle
from vrw_jax.sensitivities import sensitivities
from vrw_jax.simulate import simulate
from vrw_jax.start import start_jax
from vrw_jax.tune import Tuned, tune
from vrw_jax.variance import sobol_indices
from vrw_jax.walked_cycle import WalkedCycle

__all__ = [
    "AbstractWheel",
    "ArclengthOptions",
    "Border",
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
    "basin",
    "choose_model",
    "continue_branch",
    "continue_branches",
    "continue_map",
    "grid",
    "limit_cycle",
    "newton_cycle",
    "open_scan",
    "paper_start",
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
]
