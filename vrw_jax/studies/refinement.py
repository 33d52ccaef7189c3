"""Refine gaits with unilateral contact by Newton's method, with bounds for the errors of measures.

One walking step with unilateral contact from a section state x yields the defect r = P(x) - x,
where P is the return map. Newton's correction is d = (I - DP)^-1 r. The gait's step quantities are
those of this step plus their first-order change due to d. The Jacobian DP of one step is used for
several corrections (chord iteration). It is computed again if corrections contract slowly or the
contact codes of the legs change.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from vrw_jax.base.outcomes import Outcome
from vrw_jax.gaits.unilateral_finder import solve_linear_systems
from vrw_jax.models.contact_section import LOCKED_CODE_OFFSET
from vrw_jax.studies.lower_fidelity import LowerFidelityGaits, ModelIndex
from vrw_jax.studies.step_quantities import (
    N_DURATIONS,
    N_STEP_QUANTITIES,
    compute_measure_derivatives,
    evaluate_measures,
)
from vrw_jax.studies.tolerance_contact import ContactWheelBatch, StepQuantities


class MeasureEstimates(NamedTuple):
    """Estimated measures of gaits, each from one walking step with unilateral contact.

    - `has_same_leg_codes`: whether the contact codes of the legs are the same before and after the
      step, (gaits,);
    - `newton_correction`: Newton's correction of the section state, (gaits, coordinates);
    - `measure_values`: estimated measures of the gaits, (gaits, measures);
    - `correction_effect_on_measures`: sum of the absolute effects of the correction's coordinates
      on each measure, (gaits, measures);
    - `measure_jacobian`: derivatives of the measures with respect to the step quantities, (gaits,
      measures, 7);
    - `numerical_error_bound`: bound for the measures' error due to the integrator, (gaits,
      measures);
    - `missed_contact_error_bound`: bound for the measures' error due to contacts too short to be
      resolved, (gaits, measures).
    """

    has_same_leg_codes: np.ndarray
    newton_correction: np.ndarray
    measure_values: np.ndarray
    correction_effect_on_measures: np.ndarray
    measure_jacobian: np.ndarray
    numerical_error_bound: np.ndarray
    missed_contact_error_bound: np.ndarray


# Ratio of the bound for a walking step's error to the solver tolerance, chosen because 99 of 100
# errors are within a third of this bound.
STEP_ERROR_IN_TOLERANCES = 30.0
# Presumed number of contacts of shortest duration that a walking step misses or adds.
N_PRESUMED_MISSED_CONTACTS = 3.0


def estimate_measures(
    wheel_batch: ContactWheelBatch,
    wheel_indices: np.ndarray,
    section_states: np.ndarray,
    contact_step: StepQuantities,
    inverse_newton_matrix: np.ndarray,
    step_quantity_jacobian: np.ndarray,
    measure_names: Sequence[str],
    section_coordinates: Any = slice(None),
) -> MeasureEstimates:
    """Return estimated measures of the gaits near section states, each from one walking step.

    Args:
        wheel_batch: batch of wheels.
        wheel_indices: index of the wheel of each gait.
        section_states: full section states at which the steps begin, (gaits, 4 + 3 n).
        contact_step: section states and step quantities after the steps.
        inverse_newton_matrix: inverse of I - DP, where P is the return map, (gaits, coordinates,
            coordinates).
        step_quantity_jacobian: derivatives of the step quantities with respect to the section
            state, (gaits, 7, coordinates).
        measure_names: names of the measures.
        section_coordinates: indices of the corrected coordinates of a section state.
    """
    n_continuous_entries = section_states.shape[1] - wheel_batch.n_legs
    has_same_leg_codes = np.all(
        section_states[:, n_continuous_entries:]
        == contact_step.section_states[:, n_continuous_entries:],
        axis=1,
    ) & (contact_step.step_outcomes == Outcome.STEPPED)
    section_state_defect = (contact_step.section_states - section_states)[
        :, section_coordinates
    ] * has_same_leg_codes[:, None]
    with np.errstate(all="ignore"):
        newton_correction = np.einsum("ijk,ik->ij", inverse_newton_matrix, section_state_defect)
        gait_quantities = contact_step.step_quantities + np.einsum(
            "ijk,ik->ij", step_quantity_jacobian, newton_correction
        )
        measure_jacobian = compute_measure_derivatives(measure_names, gait_quantities)
        section_state_sensitivity = np.abs(measure_jacobian @ step_quantity_jacobian)
        correction_effect_on_measures = np.einsum(
            "ijk,ik->ij", section_state_sensitivity, np.abs(newton_correction)
        )
        step_error_bound = STEP_ERROR_IN_TOLERANCES * float(wheel_batch.step_options.rtol)
        total_quantity_sensitivity = np.abs(measure_jacobian).sum(-1) + np.sum(
            section_state_sensitivity @ np.abs(inverse_newton_matrix), axis=-1
        )
        # An unresolved contact adds its time to one duration and takes the time from another.
        duration_sensitivity_range = np.ptp(measure_jacobian[:, :, :N_DURATIONS], axis=-1)
        missed_contact_duration = (
            N_PRESUMED_MISSED_CONTACTS * wheel_batch.compute_min_contact_duration(wheel_indices)
        )
        return MeasureEstimates(
            has_same_leg_codes,
            newton_correction,
            evaluate_measures(measure_names, gait_quantities),
            correction_effect_on_measures,
            measure_jacobian,
            step_error_bound * total_quantity_sensitivity,
            missed_contact_duration[:, None] * duration_sensitivity_range,
        )


def estimate_measures_from_lower_gaits(
    wheel_batch: ContactWheelBatch,
    wheel_indices: np.ndarray,
    lower_gaits: LowerFidelityGaits,
    measure_names: Sequence[str],
) -> tuple[np.ndarray, StepQuantities, MeasureEstimates]:
    """Return estimated measures of the gaits near gaits of a lower model, from one step each.

    The result is (full section states at which the steps begin, results of the steps, estimates).
    """
    section_states = wheel_batch.embed_paper_states(wheel_indices, lower_gaits.section_states)
    section_states[lower_gaits.model_index == ModelIndex.RIGID, 4 + 2 * wheel_batch.n_legs] += (
        LOCKED_CODE_OFFSET  # Leg 1 of a rigid wheel is on its stopper.
    )
    contact_step = wheel_batch.take_steps(wheel_indices, section_states)
    measure_estimates = estimate_measures(
        wheel_batch,
        wheel_indices,
        section_states,
        contact_step,
        lower_gaits.inverse_newton_matrix,
        lower_gaits.step_quantity_jacobian,
        measure_names,
        wheel_batch.list_paper_state_indices(),
    )
    return section_states, contact_step, measure_estimates


class RefinedGaits(NamedTuple):
    """Gaits with unilateral contact after the refinement, with their measures."""

    is_found: np.ndarray  # whether the iteration has converged
    is_attracting: np.ndarray  # whether all multipliers are inside the unit circle
    measure_values: np.ndarray  # (gaits, measures)
    measure_error_bounds: np.ndarray  # (gaits, measures)
    n_steps: np.ndarray  # walking steps; a Jacobian costs `jacobian_cost_in_steps`
    section_states: np.ndarray  # (gaits, 4 + 3 n)
    walking_speed: np.ndarray  # mean speed of the last step, m/s

    def find_distinct_gaits(self, gait_indices: np.ndarray) -> list[int]:
        """Return the indices of the different attracting gaits of one wheel, slowest first.

        `gait_indices` are the indices of the wheel's gaits. Two gaits are different if a measure
        differs by more than the sum of both error bounds.
        """
        distinct_indices: list[int] = []
        is_attracting_gait = (self.is_found & self.is_attracting)[gait_indices]
        for gait_index in gait_indices[is_attracting_gait].tolist():
            measure_differences = np.abs(
                self.measure_values[gait_index] - self.measure_values[distinct_indices]
            )
            error_bound_sums = (
                self.measure_error_bounds[gait_index] + self.measure_error_bounds[distinct_indices]
            )
            if np.all(np.any(measure_differences > error_bound_sums, axis=1)):
                distinct_indices.append(gait_index)
        return sorted(distinct_indices, key=lambda gait_index: self.walking_speed[gait_index])


# Largest number of Jacobians computed for one gait.
MAX_JACOBIANS_PER_GAIT = 4
# Largest number of Newton corrections with one Jacobian, chosen because this number of corrections
# reaches round-off at `MAX_CONTRACTION_RATE`.
MAX_CORRECTIONS_PER_JACOBIAN = 20
# Largest ratio of successive correction lengths. If it is exceeded, the Jacobian is computed again.
MAX_CONTRACTION_RATE = 0.3
# Largest length of an accepted correction, in rad, rad/s, m and m/s, chosen because the
# linearization may be invalid beyond this length.
MAX_CORRECTION_LENGTH = 1.0
# Ratio of a correction's length to the solver tolerance. Below this ratio, corrections that
# contract slowly are at the level of the integrator's errors.
STALL_LENGTH_IN_TOLERANCES = 1e4
# Ratio of the bound for the remaining error to the effect of the last correction. It is also the
# ratio of the bound for the numerical error to the difference between steps at two tolerances. The
# value is chosen because a factor of four was too small for 4 of 10,365 results.
REFINEMENT_SAFETY_FACTOR = 6.0
# Largest fraction of the allowed error that may be presumed for missed contacts. If it is exceeded,
# the error is estimated from steps at other tolerances.
MAX_PRESUMED_ERROR_FRACTION = 0.1
# Cost of a walking step with its Jacobian, in steps without derivatives, chosen because the
# measured ratio of CPU times is 3.7.
JACOBIAN_COST_IN_STEPS = 4


def refine_gaits(
    wheel_batch: ContactWheelBatch,
    wheel_indices: np.ndarray,
    section_states: np.ndarray,
    measure_names: Sequence[str],
    compute_error_goal: Callable[[np.ndarray], np.ndarray],
    is_every_gait_compared: bool,
) -> RefinedGaits:
    """Return the gaits near full section states, with their measures and bounds for the errors.

    - `wheel_indices`: index of the wheel of each gait, (gaits,);
    - `section_states`: initial guesses for the section states, (gaits, 4 + 3 n);
    - `compute_error_goal`: function that returns the allowed errors for given measures;
    - `is_every_gait_compared`: whether the numerical error is always estimated from walking
      steps at other tolerances. Otherwise it is so only for gaits whose error due to missed
      contacts is too large to be presumed.

    Newton's corrections of a gait end when the remaining error is below the allowed error.
    """
    n_gaits, n_coordinates = section_states.shape
    measure_values = np.full((n_gaits, len(measure_names)), np.nan)
    gaits = RefinedGaits(
        is_found=np.zeros(n_gaits, bool),
        is_attracting=np.zeros(n_gaits, bool),
        measure_values=measure_values,
        measure_error_bounds=np.full_like(measure_values, np.inf),
        n_steps=np.zeros(n_gaits, int),
        section_states=section_states.copy(),
        walking_speed=np.full(n_gaits, np.nan),
    )
    numerical_error_bounds = np.full_like(measure_values, np.inf)
    needs_tolerance_comparison = np.zeros(n_gaits, bool)
    inverse_newton_matrix = np.zeros((n_gaits, n_coordinates, n_coordinates))
    step_quantity_jacobian = np.zeros((n_gaits, N_STEP_QUANTITIES, n_coordinates))

    def estimate_gait_measures(
        stepping_batch: ContactWheelBatch, gait_indices: np.ndarray, contact_step: StepQuantities
    ) -> MeasureEstimates:
        return estimate_measures(
            stepping_batch,
            wheel_indices[gait_indices],
            gaits.section_states[gait_indices],
            contact_step,
            inverse_newton_matrix[gait_indices],
            step_quantity_jacobian[gait_indices],
            measure_names,
        )

    next_gait_indices = np.arange(n_gaits)
    for _ in range(MAX_JACOBIANS_PER_GAIT):
        if not len(next_gait_indices):
            break
        gait_indices, next_gait_indices = next_gait_indices, next_gait_indices[:0]
        contact_step, return_map_jacobian, step_quantity_jacobian[gait_indices] = (
            wheel_batch.linearize_steps(
                wheel_indices[gait_indices], gaits.section_states[gait_indices]
            )
        )
        inverse_newton_matrix[gait_indices] = solve_linear_systems(
            np.eye(n_coordinates) - return_map_jacobian,
            np.broadcast_to(np.eye(n_coordinates), return_map_jacobian.shape),
        )
        gaits.n_steps[gait_indices] += JACOBIAN_COST_IN_STEPS
        previous_correction_length = np.full(len(gait_indices), np.inf)
        for n_corrections in range(MAX_CORRECTIONS_PER_JACOBIAN):
            measure_estimates = estimate_gait_measures(wheel_batch, gait_indices, contact_step)
            correction_length = np.linalg.norm(measure_estimates.newton_correction, axis=1)
            contraction_rate = correction_length / np.maximum(
                previous_correction_length, np.finfo(float).tiny
            )
            is_contraction_slow = contraction_rate > MAX_CONTRACTION_RATE
            error_bound = REFINEMENT_SAFETY_FACTOR * measure_estimates.correction_effect_on_measures
            error_bound_goal = compute_error_goal(measure_estimates.measure_values)
            is_error_within_goal = (n_corrections > 0) & np.all(
                error_bound
                <= np.maximum(
                    error_bound_goal - measure_estimates.numerical_error_bound,
                    measure_estimates.numerical_error_bound,
                ),
                axis=1,
            )
            is_correction_at_stall_length = correction_length <= STALL_LENGTH_IN_TOLERANCES * float(
                wheel_batch.step_options.rtol
            )
            is_refinement_finished = measure_estimates.has_same_leg_codes & np.where(
                is_contraction_slow, is_correction_at_stall_length, is_error_within_goal
            )
            finished_gait_indices = gait_indices[is_refinement_finished]
            gaits.is_found[finished_gait_indices] = True
            has_large_presumed_error = np.any(
                measure_estimates.missed_contact_error_bound
                > MAX_PRESUMED_ERROR_FRACTION * error_bound_goal,
                axis=1,
            )
            for gait_results, new_results in (
                (gaits.measure_values, measure_estimates.measure_values),
                (gaits.measure_error_bounds, error_bound),
                (
                    numerical_error_bounds,
                    measure_estimates.numerical_error_bound
                    + measure_estimates.missed_contact_error_bound,
                ),
                (
                    gaits.walking_speed,
                    evaluate_measures(("speed",), contact_step.step_quantities)[:, 0],
                ),
                (needs_tolerance_comparison, is_every_gait_compared | has_large_presumed_error),
            ):
                gait_results[finished_gait_indices] = new_results[is_refinement_finished]
            is_refinement_continued = (
                ~is_refinement_finished
                & (contact_step.step_outcomes == Outcome.STEPPED)
                & (correction_length <= MAX_CORRECTION_LENGTH)
                & (contraction_rate < 1.0)
            )
            gaits.section_states[gait_indices[is_refinement_continued]] = np.where(
                measure_estimates.has_same_leg_codes[:, None],
                gaits.section_states[gait_indices] + measure_estimates.newton_correction,
                contact_step.section_states,
            )[is_refinement_continued]
            needs_new_jacobian = is_refinement_continued & (
                is_contraction_slow | ~measure_estimates.has_same_leg_codes
            )
            next_gait_indices = np.append(next_gait_indices, gait_indices[needs_new_jacobian])
            is_refinement_continued &= ~needs_new_jacobian
            gait_indices = gait_indices[is_refinement_continued]
            previous_correction_length = correction_length[is_refinement_continued]
            if not len(gait_indices):
                break
            contact_step = wheel_batch.take_steps(
                wheel_indices[gait_indices], gaits.section_states[gait_indices]
            )
            gaits.n_steps[gait_indices] += 1
    compared_gait_indices = np.flatnonzero(needs_tolerance_comparison)
    error_bounds_by_tolerance = [np.zeros((len(compared_gait_indices), len(measure_names)))]
    for comparison_batch in wheel_batch.make_comparison_batches():
        # The duration of the shortest resolved contact depends on the tolerance.
        contact_step = comparison_batch.take_steps(
            wheel_indices[compared_gait_indices], gaits.section_states[compared_gait_indices]
        )
        measure_estimates = estimate_gait_measures(
            comparison_batch, compared_gait_indices, contact_step
        )
        error_bound = REFINEMENT_SAFETY_FACTOR * np.abs(
            measure_estimates.measure_values - gaits.measure_values[compared_gait_indices]
        )
        error_bound += np.minimum(
            measure_estimates.numerical_error_bound, numerical_error_bounds[compared_gait_indices]
        )
        # A step that changes the legs' codes gives no bound.
        error_bounds_by_tolerance.append(
            np.where(measure_estimates.has_same_leg_codes[:, None], error_bound, np.inf)
        )
        gaits.n_steps[compared_gait_indices] += 1
    numerical_error_bounds[compared_gait_indices] = np.max(error_bounds_by_tolerance, axis=0)
    measure_error_bounds = gaits.measure_error_bounds + numerical_error_bounds
    # All multipliers are inside the unit circle if all eigenvalues of (I - DP)^-1 have real parts
    # above a half.
    inverse_newton_eigenvalues = np.linalg.eigvals(
        np.nan_to_num(inverse_newton_matrix, posinf=0.0, neginf=0.0)
    )
    return gaits._replace(
        is_found=gaits.is_found & np.isfinite(measure_error_bounds).all(1),
        is_attracting=inverse_newton_eigenvalues.real.min(-1) > 0.5,
        measure_error_bounds=measure_error_bounds,
    )
