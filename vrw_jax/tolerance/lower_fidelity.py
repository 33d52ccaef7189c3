"""Gaits of the simpler models, with the matrices that propagate a defect to measures."""

import enum
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vrw_jax.batches import step_batch
from vrw_jax.contact import UnilateralWheel
from vrw_jax.cycles import make_finder, retry_from_walks
from vrw_jax.models import RigidWheel, ViscoelasticWheel
from vrw_jax.numerics import StepOptions, batch_sizes, map_in_batches, take_rows, value_and_jacobian
from vrw_jax.tolerance.step_quantities import N_STEP_QUANTITIES
from vrw_jax.wheel import Outcome, WheelParams


class ModelIndex(enum.IntEnum):
    """Index of the model of a gait, in the order of fidelity."""

    NONE = 0
    RIGID = 1
    VISCOELASTIC = 2
    UNILATERAL = 3


MODEL_NAMES = (
    "none",
    *(entry.model_name for entry in (RigidWheel, ViscoelasticWheel, UnilateralWheel)),
)
"""Names of the models by index."""

SECTION_STATE_NAME = "section_state"

FINAL_OUTCOMES = (Outcome.STEPPED, Outcome.EVENT_ORDER_MISMATCH)
"""Outcomes of a search after which no walk is tried. Of 210 wheels with 6 to 12 legs whose
solution has another order of phases, only 3 reach a gait by a walk.
"""


class LowerFidelityGait(NamedTuple):
    """Gait of each element, of a model with the paper's section state; the batch axis is first."""

    model_index: np.ndarray  # a ModelIndex, NONE if there is no gait
    section_state: np.ndarray  # (elements, 3)
    quantities: np.ndarray  # (elements, 7): quantities of the step from the section state
    newton_matrix: np.ndarray  # (elements, 3, 3): (I - DP)^-1
    # (elements, 7, 3): derivatives of the quantities with respect to the section state
    quantity_jacobian: np.ndarray
    defect: np.ndarray  # (elements, 3): numerical defect of the gait times `newton_matrix`
    outcome: np.ndarray


def empty_gaits(n_elements: int) -> LowerFidelityGait:
    """Return gaits without content for a batch of `n_elements`."""
    return LowerFidelityGait(
        np.full(n_elements, ModelIndex.NONE),
        np.zeros((n_elements, 3)),
        np.full((n_elements, N_STEP_QUANTITIES), np.nan),
        np.zeros((n_elements, 3, 3)),
        np.zeros((n_elements, N_STEP_QUANTITIES, 3)),
        np.zeros((n_elements, 3)),
        np.full(n_elements, int(Outcome.NO_CYCLE_FOUND)),
    )


def replace_gaits(
    gaits: LowerFidelityGait, indices: np.ndarray, new_gaits: LowerFidelityGait
) -> None:
    """Replace the gaits at these indices by new ones, in place."""
    for all_values, new_values in zip(gaits, new_gaits, strict=True):
        all_values[indices] = new_values


def find_paper_gaits(params: WheelParams, options: StepOptions) -> LowerFidelityGait:
    """Return the gaits of the paper's model by collocation, with derivatives from one step by
    machine code.
    """

    finder = make_finder(None, params.n_legs)
    cycles = map_in_batches(finder.find_cycles, batch_sizes.GAIT_BATCH_SIZES, params)
    section_states, outcome = np.array(cycles.section_state), np.array(cycles.outcome)
    (missing_indices,) = np.nonzero(~np.isin(outcome, FINAL_OUTCOMES))
    if len(missing_indices):  # One mesh for all elements makes the digits independent of the batch.
        cycles = retry_from_walks(
            finder, *jax.device_put(take_rows((params, cycles), missing_indices))
        )
        section_states[missing_indices], outcome[missing_indices] = (
            cycles.section_state,
            cycles.outcome,
        )
    all_gaits = empty_gaits(len(section_states))
    all_gaits.outcome[:] = outcome
    (found_indices,) = np.nonzero(outcome == Outcome.STEPPED)
    if not len(found_indices):
        return all_gaits
    found_params = jax.device_put(take_rows(params, found_indices))
    step = step_batch(
        found_params,
        section_states[found_indices],
        options=options,
        derivatives=[SECTION_STATE_NAME],
    )
    step_jacobian = jax.tree.map(np.asarray, step.derivatives[SECTION_STATE_NAME])
    end_states, durations = np.asarray(step.section_state), np.asarray(step.durations)
    has_stepped = np.asarray(step.outcome) == Outcome.STEPPED
    # The feet's distance at touchdown is L0 sin(alpha) / cos(theta-), m.
    leg_span = np.asarray(found_params.locked_length) * np.sin(found_params.leg_angle)
    foot_distance = leg_span / np.cos(end_states[:, 0])
    zeros = np.zeros(len(found_indices))
    quantities = np.column_stack(
        [durations[:, 0], durations[:, 1] + durations[:, 2], zeros, foot_distance, end_states]
    )
    length_jacobian = (foot_distance * np.tan(end_states[:, 0]))[
        :, None
    ] * step_jacobian.section_state[:, 0]
    dls_jacobian, sls1_jacobian, sls2_jacobian = np.moveaxis(step_jacobian.durations, 1, 0)
    jacobian_rows = [
        dls_jacobian,
        sls1_jacobian + sls2_jacobian,
        0.0 * dls_jacobian,
        length_jacobian,
    ]
    quantity_jacobian = np.concatenate([np.stack(jacobian_rows, 1), step_jacobian.section_state], 1)
    gaits = _make_gaits(
        ModelIndex.VISCOELASTIC,
        section_states[found_indices],
        end_states,
        quantities,
        step_jacobian.section_state,
        quantity_jacobian,
    )
    replace_gaits(
        all_gaits,
        found_indices[has_stepped],
        LowerFidelityGait(*(gait_array[has_stepped] for gait_array in gaits)),
    )
    all_gaits.outcome[found_indices[~has_stepped]] = np.asarray(step.outcome)[~has_stepped]
    return all_gaits


def find_rigid_gaits(params: WheelParams) -> LowerFidelityGait:
    """Return the rigid gaits in closed form, with the classic landing, in which the rear foot
    leaves.

    Stiff legs with unilateral contact approach this gait. The paper's landing, whose rear foot is
    held, has a gait half as fast again.
    """
    section_states, end_states, step_length, duration, jacobian, duration_jacobian = map(
        np.asarray, map_in_batches(_compute_rigid_gaits, batch_sizes.GAIT_BATCH_SIZES, params)
    )
    zeros = np.zeros_like(duration)
    quantities = np.column_stack([zeros, duration, zeros, step_length, end_states])
    zero_row = 0.0 * duration_jacobian
    quantity_jacobian = np.concatenate(
        [np.stack([zero_row, duration_jacobian, zero_row, zero_row], 1), jacobian], 1
    )
    return _make_gaits(
        ModelIndex.RIGID, section_states, end_states, quantities, jacobian, quantity_jacobian
    )


def compute_static_contraction(params: WheelParams) -> np.ndarray:
    """Return the relative static contraction of a leg, the order of magnitude of the rigid
    model's error.
    """
    s = jax.tree.map(np.asarray, params.symbols())
    return s.Mt * s.g / (np.asarray(params.stiffness) * s.L0)


def _make_gaits(
    model_index: int,
    section_states: np.ndarray,
    end_states: np.ndarray,
    quantities: np.ndarray,
    jacobian: np.ndarray,
    quantity_jacobian: np.ndarray,
) -> LowerFidelityGait:
    """Return the gaits of one model from the states and derivatives of their steps."""
    with np.errstate(all="ignore"):
        newton_matrix = np.linalg.inv(np.eye(3) - jacobian)
    defect = np.einsum("ijk,ik->ij", newton_matrix, end_states - section_states)
    outcomes = np.full(len(section_states), int(Outcome.STEPPED))
    return LowerFidelityGait(
        np.full(len(section_states), model_index),
        section_states,
        quantities,
        newton_matrix,
        quantity_jacobian,
        defect,
        outcomes,
    )


@jax.jit
def _compute_rigid_gaits(params: WheelParams) -> tuple:
    """Return states, step length, m, duration, s, and their Jacobians of the rigid gaits of a
    batch.
    """
    model, options = RigidWheel(stop_at_lift_off=False), StepOptions()

    def compute_rigid_gait(params: WheelParams) -> tuple:
        def evaluate_step(x: jax.Array) -> tuple:
            step = model.take_step(params, x, options)
            return step.section_state, step.step_length, jnp.sum(step.durations)

        section_state = model.default_start(params)
        (next_section_state, step_length, duration), (jacobian, _, duration_jacobian) = (
            value_and_jacobian(evaluate_step, section_state)
        )
        return section_state, next_section_state, step_length, duration, jacobian, duration_jacobian

    return jax.vmap(compute_rigid_gait)(params)
