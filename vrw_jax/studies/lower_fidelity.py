"""Gaits of the rigid model and of the paper's model, with their Jacobians.

The Jacobians are used to propagate a defect of the return map to the measures.
"""

import enum
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vrw_jax.base import batch_sizes
from vrw_jax.base.options import StepOptions
from vrw_jax.base.outcomes import Outcome
from vrw_jax.gaits.finder_selection import make_finder
from vrw_jax.gaits.further_search import search_further
from vrw_jax.gaits.gait_search import find_cycles_from_starts, summarize_search
from vrw_jax.lanes.autodiff import evaluate_with_jacobian
from vrw_jax.lanes.batching import map_in_batches, select_tree_rows
from vrw_jax.models.rigid import RigidWheel
from vrw_jax.models.step_batch import step_batch
from vrw_jax.models.unilateral_wheel import UnilateralWheel
from vrw_jax.models.viscoelastic import ViscoelasticWheel
from vrw_jax.studies.step_quantities import N_STEP_QUANTITIES
from vrw_jax.studies.tolerance_contact import replace_rows
from vrw_jax.wheel.params import WheelParams


class ModelIndex(enum.IntEnum):
    """Index of a wheel model, in order of increasing fidelity."""

    NONE = 0
    RIGID = 1
    VISCOELASTIC = 2
    UNILATERAL = 3


MODEL_NAMES = (
    "none",
    *(model_class.model_name for model_class in (RigidWheel, ViscoelasticWheel, UnilateralWheel)),
)
"""Names of the models, in the order of `ModelIndex`."""

SECTION_STATE_NAME = "section_state"


class LowerFidelityGaits(NamedTuple):
    """Gait of each wheel, computed with a model whose section state is (theta-, dtheta-, dL1-).

    The first axis of each field contains the wheels.
    """

    model_index: np.ndarray  # a ModelIndex, NONE if there is no gait
    section_states: np.ndarray  # (wheels, 3)
    step_quantities: np.ndarray  # (wheels, 7): step quantities from the section state
    inverse_newton_matrix: np.ndarray  # (wheels, 3, 3): (I - DP)^-1, where P is the return map
    # (wheels, 7, 3): derivatives of the step quantities with respect to the section state
    step_quantity_jacobian: np.ndarray
    # (wheels, 3): `inverse_newton_matrix` times the defect of the return map
    section_state_error: np.ndarray
    search_outcomes: np.ndarray


def make_empty_gaits(n_wheels: int) -> LowerFidelityGaits:
    """Return a `LowerFidelityGaits` in which none of `n_wheels` wheels has a gait."""
    return LowerFidelityGaits(
        np.full(n_wheels, ModelIndex.NONE),
        np.zeros((n_wheels, 3)),
        np.full((n_wheels, N_STEP_QUANTITIES), np.nan),
        np.zeros((n_wheels, 3, 3)),
        np.zeros((n_wheels, N_STEP_QUANTITIES, 3)),
        np.zeros((n_wheels, 3)),
        np.full(n_wheels, int(Outcome.NO_CYCLE_FOUND)),
    )


def select_wheels(params: WheelParams, wheel_indices: np.ndarray) -> WheelParams:
    """Return the parameters of the wheels with the indices `wheel_indices`."""
    return jax.device_put(select_tree_rows(params, wheel_indices))


def find_paper_gaits(params: WheelParams, step_options: StepOptions) -> LowerFidelityGaits:
    """Return the gaits of the paper's model for a batch of wheels, computed by collocation.

    The Jacobians are those of one walking step from each gait's section state.
    """
    cycle_finder: Any = make_finder(None, params.n_legs)
    limit_cycles = map_in_batches(cycle_finder.find_cycles, batch_sizes.GAIT_BATCH_SIZES, params)
    section_states = np.array(limit_cycles.section_state)
    search_outcomes = np.array(limit_cycles.outcome)
    # Each element has its own mesh, so that its digits do not depend on the batch.
    for _, wheel_indices, mesh_search in search_further(
        find_cycles_from_starts,
        cycle_finder,
        params,
        summarize_search(limit_cycles),
        batch_sizes.GAIT_BATCH_SIZES,
    ):
        section_states[wheel_indices] = mesh_search.gaits.section_state
        search_outcomes[wheel_indices] = mesh_search.outcome
    gaits_of_all_wheels = make_empty_gaits(len(section_states))
    gaits_of_all_wheels.search_outcomes[:] = search_outcomes
    (found_wheel_indices,) = np.nonzero(search_outcomes == Outcome.STEPPED)
    if not len(found_wheel_indices):
        return gaits_of_all_wheels
    params_with_gait = select_wheels(params, found_wheel_indices)
    gait_step = step_batch(
        params_with_gait,
        section_states[found_wheel_indices],
        options=step_options,
        derivatives=[SECTION_STATE_NAME],
    )
    step_jacobian = jax.tree.map(np.asarray, gait_step.derivatives[SECTION_STATE_NAME])
    gait_step_end_states = np.asarray(gait_step.section_state)
    has_stepped = np.asarray(gait_step.outcome) == Outcome.STEPPED
    # The feet's distance at touchdown is L0 sin(alpha) / cos(theta-), m.
    leg_span = np.asarray(params_with_gait.locked_length) * np.sin(params_with_gait.leg_angle)
    foot_distance = leg_span / np.cos(gait_step_end_states[:, 0])
    foot_distance_rate = foot_distance * np.tan(gait_step_end_states[:, 0])
    foot_distance_jacobian = foot_distance_rate[:, None] * step_jacobian.section_state[:, 0]

    def stack_step_quantities(
        durations: np.ndarray, foot_distances: np.ndarray, end_states: np.ndarray
    ) -> np.ndarray:
        """Return the step quantities or their Jacobian as one array, (wheels, 7, ...)."""
        dls_duration, sls1_duration, sls2_duration = np.moveaxis(durations, 1, 0)
        single_durations = sls1_duration + sls2_duration
        flight_duration = 0.0 * dls_duration
        durations_and_distance = [dls_duration, single_durations, flight_duration, foot_distances]
        return np.concatenate([np.stack(durations_and_distance, 1), end_states], 1)

    stepped_gaits = _make_lower_fidelity_gaits(
        ModelIndex.VISCOELASTIC,
        section_states[found_wheel_indices],
        stack_step_quantities(np.asarray(gait_step.durations), foot_distance, gait_step_end_states),
        stack_step_quantities(
            step_jacobian.durations, foot_distance_jacobian, step_jacobian.section_state
        ),
    )
    gaits_of_all_wheels.search_outcomes[found_wheel_indices] = gait_step.outcome
    replace_rows(
        gaits_of_all_wheels,
        found_wheel_indices[has_stepped],
        select_tree_rows(stepped_gaits, has_stepped),
    )
    return gaits_of_all_wheels


def find_rigid_gaits(params: WheelParams) -> LowerFidelityGaits:
    """Return the gaits of rigid wheels with the classic impact, in closed form.

    In the classic impact, the rear foot leaves the ground at landing. If legs are stiff, gaits with
    unilateral contact approach this gait. If the rear foot stays on the ground at landing, as in
    the paper, the gait is half as fast again.
    """
    return _make_lower_fidelity_gaits(
        ModelIndex.RIGID,
        *map(
            np.asarray, map_in_batches(_compute_rigid_gaits, batch_sizes.GAIT_BATCH_SIZES, params)
        ),
    )


def compute_static_leg_contraction(params: WheelParams) -> np.ndarray:
    """Return the static contraction of one leg under the wheel's weight, divided by the leg length.

    The relative error of the rigid model has this order of magnitude.
    """
    s = jax.tree.map(np.asarray, params.symbols())
    return s.Mt * s.g / (np.asarray(params.stiffness) * s.L0)


def _make_lower_fidelity_gaits(
    model_index: int,
    section_states: np.ndarray,
    step_quantities: np.ndarray,
    step_quantity_jacobian: np.ndarray,
) -> LowerFidelityGaits:
    """Return the gaits of one model from the starts, results and Jacobians of their walking
    steps.

    The last step quantities are the section state after the step.
    """
    with np.errstate(all="ignore"):
        inverse_newton_matrix = np.linalg.inv(np.eye(3) - step_quantity_jacobian[:, -3:])
    section_state_error = np.einsum(
        "ijk,ik->ij", inverse_newton_matrix, step_quantities[:, -3:] - section_states
    )
    search_outcomes = np.full(len(section_states), int(Outcome.STEPPED))
    return LowerFidelityGaits(
        np.full(len(section_states), model_index),
        section_states,
        step_quantities,
        inverse_newton_matrix,
        step_quantity_jacobian,
        section_state_error,
        search_outcomes,
    )


@jax.jit
@jax.vmap
def _compute_rigid_gaits(params: WheelParams) -> tuple:
    """Return section states of the gaits of rigid wheels, step quantities and their Jacobians."""
    rigid_model = RigidWheel(stop_at_lift_off=False)

    def compute_step_quantities(x: jax.Array) -> jax.Array:
        gait_step = rigid_model.take_step(params, x, StepOptions())
        no_time = jnp.zeros_like(gait_step.step_length)
        step_duration = jnp.sum(gait_step.durations)
        return jnp.stack(
            [no_time, step_duration, no_time, gait_step.step_length, *gait_step.section_state]
        )

    section_state = rigid_model.compute_default_start(params)
    return section_state, *evaluate_with_jacobian(compute_step_quantities, section_state)
