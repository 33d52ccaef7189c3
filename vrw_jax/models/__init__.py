"""Models of the wheel with a common interface, one model per file."""

from vrw_jax.models import batch_step, unit_scaling
from vrw_jax.models.batch_step import (
    N_STEP_INPUTS,
    can_use_batch_kernel,
    compute_jacobian_columns,
    split_jacobian_by_leaf,
    take_gait_step,
)
from vrw_jax.models.capabilities import GaitMethod, ModelCapabilities, PassageMethod
from vrw_jax.models.interface import AbstractWheel, StepGroundValues
from vrw_jax.models.rigid import RigidWheel
from vrw_jax.models.step_inputs import (
    PAPER_START_STATE,
    AnySectionState,
    SectionState,
    check_stepwise_shape,
    complete_line_slopes,
    is_valid_slope,
    is_valid_start_state,
    replace_invalid_inputs,
    split_slopes,
)
from vrw_jax.models.step_results import (
    AbstractContactStep,
    AbstractStep,
    AdvanceResult,
    DoubleSupportIndicators,
    EnergyLoss,
    Margins,
    StepResult,
    Trajectory,
)
from vrw_jax.models.unit_scaling import complete_jacobian_columns
from vrw_jax.models.viscoelastic import ViscoelasticWheel
