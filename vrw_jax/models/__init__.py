"""Models of the wheel with a common interface, one model per file."""

from vrw_jax.models import batch_step, unit_scaling
from vrw_jax.models.batch_step import (
    N_STEP_INPUTS,
    advance_gait_step,
    can_use_batch_kernel,
    compute_jacobian_columns,
    split_jacobian_by_leaf,
)
from vrw_jax.models.capabilities import GaitMethod, ModelCapabilities, PassageMethod
from vrw_jax.models.interface import AbstractWheel, StepGroundValues
from vrw_jax.models.rigid import RigidWheel
from vrw_jax.models.step_inputs import (
    PAPER_START_STATE,
    AnySectionState,
    SectionState,
    complete_ground_line_slopes,
    is_slope_in_domain,
    is_valid_start_state,
    replace_invalid_inputs,
    require_stepwise_shape,
    separate_next_slope,
)
from vrw_jax.models.step_results import (
    AbstractContactStep,
    AbstractStep,
    AdvanceResult,
    DoubleSupportIndicators,
    EnergyLoss,
    Margins,
    RequiredFriction,
    StepResult,
)
from vrw_jax.models.unit_scaling import complete_jacobian_columns
from vrw_jax.models.viscoelastic import ViscoelasticWheel
