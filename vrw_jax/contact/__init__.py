"""Wheel with unilateral contact: mechanics, contact laws, impacts, batched walks and tangents."""

from vrw_jax.contact import batch_walks
from vrw_jax.contact.batch_walks import embed_section_states, step_batch_with_jacobian, walk_batch
from vrw_jax.contact.contact_state import PackedState, unpack_state
from vrw_jax.contact.mechanics import (
    compute_foot_heights,
    compute_foot_positions,
    compute_kinetic_energy,
    compute_leg_directions,
    compute_potential_energy,
)
from vrw_jax.contact.section import LOCKED_CODE_OFFSET, FullState, embed_section_state
from vrw_jax.contact.step_record import UnilateralStep, compute_min_bounce_height
from vrw_jax.contact.unilateral_wheel import (
    AbstractContactWheel,
    UnilateralTrajectory,
    UnilateralWheel,
)
