"""Models of the wheel: what one step is."""

from vrw_jax.lanes.autodiff import compute_jacobian_columns
from vrw_jax.models.contact_mechanics import compute_foot_heights, compute_leg_directions
from vrw_jax.models.contact_state import unpack_state
from vrw_jax.models.contact_walks import embed_section_states, step_batch_with_jacobian
from vrw_jax.models.interface import AbstractWheel
from vrw_jax.models.ladder import (
    MODEL_CLASSES,
    describe_accepted_models,
    list_model_config_names,
)
from vrw_jax.models.measures import (
    FORCE_PEAK_MEASURES,
    LIMIT_CYCLE_MEASURES,
    MARGIN_MEASURES,
    MEASURES,
    POST_LANDING_COMPONENT_NAMES,
    PRE_TOUCHDOWN_COMPONENT_NAMES,
    SELECTION_MARGIN_NAMES,
    STEP_MEASURES,
    STOPPER_MARGIN_MEASURES,
    UNILATERAL_STEP_MEASURES,
    describe_violation,
)
from vrw_jax.models.rigid import RigidWheel
from vrw_jax.models.step_results import (
    PAPER_START_STATE,
    DoubleSupportIndicators,
    EnergyLoss,
    RequiredFriction,
    StepResult,
)
from vrw_jax.models.stepping import walk
from vrw_jax.models.trajectory import SAMPLED_FORCE_PEAK_MEASURES
from vrw_jax.models.unilateral_wheel import UnilateralWheel
from vrw_jax.models.viscoelastic import N_STEP_INPUTS, advance_gait_step
