"""The model ladder: one file per rung, one face."""

from vrw_jax.models.base import (
    AbstractWheel,
    EnergyLoss,
    Indicators,
    Margins,
    StepResult,
    Trajectory,
)
from vrw_jax.models.ladder import LadderStep, LadderWheel, ModelChoice
from vrw_jax.models.rigid import RigidWheel
from vrw_jax.models.unilateral import UnilateralStep, UnilateralWheel
from vrw_jax.models.viscoelastic import ViscoelasticWheel

__all__ = [
    "AbstractWheel",
    "EnergyLoss",
    "Indicators",
    "LadderStep",
    "LadderWheel",
    "Margins",
    "ModelChoice",
    "RigidWheel",
    "StepResult",
    "Trajectory",
    "UnilateralStep",
    "UnilateralWheel",
    "ViscoelasticWheel",
]
