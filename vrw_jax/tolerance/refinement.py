"""Refinement of gaits with unilateral contact by Newton's method, with bounds of their errors.

One step with unilateral contact from a state x gives the defect r = P(x) - x. Multiplied by the
inverse of I - DP, it is Newton's correction d. The gait's quantities are near those of this step
plus their change along d. The exact Jacobian of one step serves several corrections (chord
iteration). If corrections contract slowly or the legs' codes change, it is computed again.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from vrw_jax.cycles import solve_linear_systems
from vrw_jax.tolerance.contact_steps import GroundBatch, StepQuantities
from vrw_jax.tolerance.step_quantities import (
    N_DURATIONS,
    N_STEP_QUANTITIES,
    compute_measure_derivatives,
    evaluate_measures,
)
from vrw_jax.wheel import Outcome


@dataclasses.dataclass(frozen=True)
class RefinementOptions:
    """Options of the refinement of gaits; section states are in rad, rad/s, m, m/s.

    - `max_jacobians`: largest number of Jacobians for one gait;
    - `max_corrections`: largest number of corrections by one Jacobian, chosen because so many
      corrections reach round-off at `max_contraction_rate`;
    - `max_contraction_rate`: contraction rate of corrections above which the Jacobian is computed
      again;
    - `max_correction`: longest accepted correction, chosen because the linearization is unknown
      beyond it;
    - `stall_level`: length of a correction, in tolerances of the step, below which corrections that
      contract slowly are at the level of the integrator's errors;
    - `safety_factor`: bound of the remaining error over the effect of the last correction, and of
      the numerical error over the difference between steps at two tolerances. It is chosen because
      a factor of four was too small for 4 of 10,365 results;
    - `step_error_factor`: error of a step over the tolerance of its solver steps, chosen because 99
      of 100 errors are within a third of it;
    - `n_presumed_missed_contacts`: number of shortest contacts of a foot that a step may miss or
      add;
    - `max_presumed_error_fraction`: largest fraction of the allowed error that is assumed for such
      contacts; otherwise their error is measured;
    - `jacobian_cost`: cost of a step with its Jacobian, in steps, chosen because it takes 3.7 times
      the CPU time of a step.
    """

    max_jacobians: int = 4
    max_corrections: int = 20
    max_contraction_rate: float = 0.3
    max_correction: float = 1.0
    stall_level: float = 1e4
    safety_factor: float = 6.0
    step_error_factor: float = 30.0
    n_presumed_missed_contacts: float = 3.0
    max_presumed_error_fraction: float = 0.1
    jacobian_cost: int = 4


REFINEMENT_OPTIONS = RefinementOptions()
"""Options of the refinement for all measures."""


class StepEstimate(NamedTuple):
    """Estimates of gaits' measures from one step with unilateral contact; the batch axis is first.

    - `same_codes`: whether the step does not change the legs' codes;
    - `correction`: Newton's correction of these coordinates of the section state;
    - `values`: estimated measures of the gait, (elements, measures), as are the errors below;
    - `correction_effect`: sum of the absolute effects of the correction on the measures;
    - `measure_jacobian`: derivatives with respect to the step's quantities, (elements, measures,
      7);
    - `numerical_error`: bound of the integrator's error;
    - `missed_contact_error`: bound of the error due to contacts that are too short to be resolved.
    """

    same_codes: np.ndarray
    correction: np.ndarray
    values: np.ndarray
    correction_effect: np.ndarray
    measure_jacobian: np.ndarray
    numerical_error: np.ndarray
    missed_contact_error: np.ndarray


def estimate_measures(
    ground: GroundBatch,
    indices: np.ndarray,
    section_states: np.ndarray,
    step: StepQuantities,
    newton_matrix: np.ndarray,
    quantity_jacobian: np.ndarray,
    names: Sequence[str],
    coordinates: Any = slice(None),
    options: RefinementOptions = REFINEMENT_OPTIONS,
) -> StepEstimate:
    """Return estimates of the measures of gaits near section states, from one step of each.

    Args:
        ground: the batch of wheels.
        indices: index of the wheel of each element.
        section_states: full section states at the start of the step.
        step: result of the step.
        newton_matrix: inverse of I - DP in some coordinates of the section state.
        quantity_jacobian: derivatives of the quantities, (elements, 7, coordinates).
        names: names of the measures.
        coordinates: indices of these coordinates, all by default.
        options: options of the bounds.
    """
    n_numbers = section_states.shape[1] - ground.n_legs
    same_codes = np.all(
        section_states[:, n_numbers:] == step.section_states[:, n_numbers:], axis=1
    ) & (step.outcome == Outcome.STEPPED)
    defect = (step.section_states - section_states)[:, coordinates] * same_codes[:, None]
    with np.errstate(all="ignore"):
        correction = np.einsum("ijk,ik->ij", newton_matrix, defect)
        quantities = step.quantities + np.einsum("ijk,ik->ij", quantity_jacobian, correction)
        measure_jacobian = compute_measure_derivatives(names, quantities)
        state_sensitivity = np.abs(measure_jacobian @ quantity_jacobian)
        correction_effect = np.einsum("ijk,ik->ij", state_sensitivity, np.abs(correction))
        step_error = options.step_error_factor * float(ground.options.rtol)
        total_sensitivity = np.abs(measure_jacobian).sum(-1) + np.sum(
            state_sensitivity @ np.abs(newton_matrix), axis=-1
        )
        # A contact that is not resolved moves time from one duration to another.
        duration_sensitivity_range = np.ptp(measure_jacobian[:, :, :N_DURATIONS], axis=-1)
        missed_contact_duration = (
            options.n_presumed_missed_contacts * ground.min_resolved_contact_duration(indices)
        )
        return StepEstimate(
            same_codes,
            correction,
            evaluate_measures(names, quantities),
            correction_effect,
            measure_jacobian,
            step_error * total_sensitivity,
            missed_contact_duration[:, None] * duration_sensitivity_range,
        )


class RefinedGaits(NamedTuple):
    """Gaits with unilateral contact and their measures, for each element."""

    is_found: np.ndarray
    is_attracting: np.ndarray
    values: np.ndarray  # (elements, measures)
    errors: np.ndarray  # (elements, measures): bound of the errors of iteration and integrator
    n_steps: np.ndarray  # number of steps, where a Jacobian counts as `jacobian_cost` steps
    section_states: np.ndarray  # (elements, 4 + 3 n)
    speed: np.ndarray  # speed in the last step, m/s


def refine_gaits(
    ground: GroundBatch,
    indices: np.ndarray,
    section_states: np.ndarray,
    names: Sequence[str],
    compute_error_goal: Callable[[np.ndarray], np.ndarray],
    always_compares: bool,
    options: RefinementOptions = REFINEMENT_OPTIONS,
) -> RefinedGaits:
    """Return the gaits near section states, with their measures and bounds of the errors.

    Corrections end if the remaining error is below the goal. `compute_error_goal` returns the
    allowed errors of measures with about these values. If `always_compares` or if the error
    of presumed short contacts matters, steps at other tolerances measure the numerical error.
    """
    n_elements, m = section_states.shape
    states, values = section_states.copy(), np.full((n_elements, len(names)), np.nan)
    remaining_error, numerical_error = np.full((2, *values.shape), np.inf)
    is_found, needs_comparison = np.zeros((2, n_elements), bool)
    speed, n_steps = np.full(n_elements, np.nan), np.zeros(n_elements, int)
    newton_matrix = np.zeros((n_elements, m, m))
    quantity_jacobian = np.zeros((n_elements, N_STEP_QUANTITIES, m))

    def estimate(
        step_ground: GroundBatch, positions: np.ndarray, step: StepQuantities
    ) -> StepEstimate:
        return estimate_measures(
            step_ground,
            indices[positions],
            states[positions],
            step,
            newton_matrix[positions],
            quantity_jacobian[positions],
            names,
        )

    next_positions = np.arange(n_elements)
    for _ in range(options.max_jacobians):
        if not len(next_positions):
            break
        positions, next_positions = next_positions, next_positions[:0]
        step, return_jacobian, quantity_jacobian[positions] = ground.linearize_steps(
            indices[positions], states[positions]
        )
        newton_matrix[positions] = solve_linear_systems(
            np.eye(m) - return_jacobian, np.broadcast_to(np.eye(m), return_jacobian.shape)
        )
        n_steps[positions] += options.jacobian_cost
        previous_length = np.full(len(positions), np.inf)
        for n_corrections in range(options.max_corrections):
            gait = estimate(ground, positions, step)
            length = np.linalg.norm(gait.correction, axis=1)
            rate = length / np.maximum(previous_length, np.finfo(float).tiny)
            is_slow = rate > options.max_contraction_rate
            error = options.safety_factor * gait.correction_effect
            error_goal = compute_error_goal(gait.values)
            is_accurate = (n_corrections > 0) & np.all(
                error <= np.maximum(error_goal - gait.numerical_error, gait.numerical_error), axis=1
            )
            has_stalled = length <= options.stall_level * float(ground.options.rtol)
            is_done = gait.same_codes & np.where(is_slow, has_stalled, is_accurate)
            done = positions[is_done]
            is_found[done], values[done] = True, gait.values[is_done]
            remaining_error[done] = error[is_done]
            numerical_error[done] = (gait.numerical_error + gait.missed_contact_error)[is_done]
            speed[done] = evaluate_measures(("speed",), step.quantities[is_done])[:, 0]
            needs_comparison[done] = (
                always_compares
                | np.any(
                    gait.missed_contact_error > options.max_presumed_error_fraction * error_goal,
                    axis=1,
                )[is_done]
            )
            is_continued = (
                ~is_done
                & (step.outcome == Outcome.STEPPED)
                & (length <= options.max_correction)
                & (rate < 1.0)
            )
            states[positions[is_continued]] = np.where(
                gait.same_codes[:, None], states[positions] + gait.correction, step.section_states
            )[is_continued]
            needs_jacobian = is_continued & (is_slow | ~gait.same_codes)
            next_positions = np.append(next_positions, positions[needs_jacobian])
            is_continued &= ~needs_jacobian
            positions, previous_length = positions[is_continued], length[is_continued]
            if not len(positions):
                break
            step = ground.take_steps(indices[positions], states[positions])
            n_steps[positions] += 1
    compared = np.flatnonzero(needs_comparison)
    errors_by_comparison = [np.zeros((len(compared), len(names)))]
    for other_ground in ground.list_with_other_tolerances():
        # At another tolerance the shortest resolved contact is shorter or longer.
        step = other_ground.take_steps(indices[compared], states[compared])
        gait = estimate(other_ground, compared, step)
        error = options.safety_factor * np.abs(gait.values - values[compared])
        error += np.minimum(gait.numerical_error, numerical_error[compared])
        # A step with another motion gives no bound.
        errors_by_comparison.append(np.where(gait.same_codes[:, None], error, np.inf))
        n_steps[compared] += 1
    numerical_error[compared] = np.max(errors_by_comparison, axis=0)
    errors = remaining_error + numerical_error
    is_found &= np.isfinite(errors).all(1)
    # All multipliers are inside the unit circle if all eigenvalues of (I - DP)^-1 have real parts
    # above a half.
    eigenvalues = np.linalg.eigvals(np.nan_to_num(newton_matrix, posinf=0.0, neginf=0.0))
    is_attracting = eigenvalues.real.min(-1) > 0.5
    return RefinedGaits(is_found, is_attracting, values, errors, n_steps, states, speed)
