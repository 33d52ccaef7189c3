"""The models of the wheel, one per file, with one interface."""

from vrw_jax.models import scales
from vrw_jax.models.base import (
    AbstractStep,
    AbstractWheel,
    Advance,
    EnergyLoss,
    GroundOfStep,
    Indicators,
    Margins,
    RungState,
    SectionState,
    StepResult,
    Trajectory,
    replaced_where_bad,
    usable,
)
from vrw_jax.models.ladder import (
    PREMISES,
    SERVED,
    UNILATERAL,
    VISCOELASTIC,
    LadderStep,
    LadderWheel,
    ModelChoice,
    reason_of,
    refuse_ladder,
)
from vrw_jax.models.lane_step import DIRECTIONS, along_units, gait_step
from vrw_jax.models.paper_step import PAPER_START
from vrw_jax.models.rigid import RigidWheel
from vrw_jax.models.scales import along_all
from vrw_jax.models.unilateral.contacts import STICK
from vrw_jax.models.unilateral.ledger import UnilateralStep, least_dip
from vrw_jax.models.unilateral.mechanics import (
    directions,
    foot_heights,
    foot_places,
    kinetic_energy,
    potential_energy,
)
from vrw_jax.models.unilateral.motion import State, unpack
from vrw_jax.models.unilateral.queues import as_full_states, step_lanes, walk_lanes
from vrw_jax.models.unilateral.section import LOCKED
from vrw_jax.models.unilateral.wheel import UnilateralTrajectory, UnilateralWheel
from vrw_jax.models.viscoelastic import ViscoelasticWheel
