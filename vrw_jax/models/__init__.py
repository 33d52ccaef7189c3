"""The models of the wheel, one per file, with one interface."""

from vrw_jax.models import scales
from vrw_jax.models.interface import AbstractWheel, StepGround
from vrw_jax.models.ladder import (
    SELECTION_ATTRS,
    SELECTION_MARGINS,
    UNILATERAL_MODEL,
    VISCOELASTIC_MODEL,
    LadderStep,
    LadderWheel,
    ModelChoice,
    find_selection_reason,
    refuse_ladder,
)
from vrw_jax.models.lane_step import N_STEP_INPUTS, gait_step, jacobian_columns
from vrw_jax.models.rigid import RigidWheel
from vrw_jax.models.scales import scaled_jacobian_columns
from vrw_jax.models.section_states import (
    PAPER_START,
    AnySectionState,
    SectionState,
    is_valid_start,
    replace_invalid,
)
from vrw_jax.models.step_results import (
    AbstractStep,
    AdvanceResult,
    DoubleSupportIndicators,
    EnergyLoss,
    Margins,
    StepResult,
    Trajectory,
)
from vrw_jax.models.unilateral.contacts import CONTACT_STICK
from vrw_jax.models.unilateral.ledger import UnilateralStep, min_dip_depth
from vrw_jax.models.unilateral.mechanics import (
    foot_heights,
    foot_positions,
    kinetic_energy,
    leg_directions,
    potential_energy,
)
from vrw_jax.models.unilateral.motion import PackedState, unpack_state
from vrw_jax.models.unilateral.queues import (
    embed_section_states,
    step_batch_with_jacobian,
    walk_batch,
)
from vrw_jax.models.unilateral.section import LOCKED_CODE_OFFSET
from vrw_jax.models.unilateral.wheel import UnilateralTrajectory, UnilateralWheel
from vrw_jax.models.viscoelastic import ViscoelasticWheel
