"""Refinement of gaits of the highest model by quasi-Newton steps that need only its values.

One step of the highest model from a state x gives the defect r = P(x) - x. Multiplied by the
inverse of I - DP, it is Newton's correction d. The gait's quantities are near those of this step
plus their change along d. At first both matrices are the lower model's, if it has a gait. Each
further step updates them by Broyden's update of rank one (C. G. Broyden, Math. Comp. 19, 1965).
Finite differences of a few more steps replace the matrices if the convergence is slow, or if the
legs' codes have changed.

The matrices of another motion predict a small correction in a slow direction, and an error bound
that follows from them is invalid. The contraction q of d from one step to the next is therefore
measured, and the larger of its last two values bounds the remaining error. As for a contraction
(Kantorovich), with a factor of two, the bound is 2q/(1 - q) times the last change but one.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import numpy as np

from vrw_jax.tolerance.contact_steps import GroundBatch, StepQuantities
from vrw_jax.tolerance.lower_fidelity import LowerFidelityGait
from vrw_jax.tolerance.step_quantities import (
    N_DURATIONS,
    N_STEP_QUANTITIES,
    compute_measure_derivatives,
    evaluate_measures,
)
from vrw_jax.wheel import Outcome

ErrorGoal = Callable[[np.ndarray], np.ndarray]
"""Function that returns the allowed errors of measures with about these values."""


@dataclasses.dataclass(frozen=True)
class BroydenOptions:
    """Options of the quasi-Newton iteration; section states are in rad, rad/s, m, m/s.

    - `refresh_above`: contraction rate above which matrices are recomputed;
    - `max_trusted_rate`: largest contraction rate that bounds the remaining error reliably;
    - `min_rate`: smallest contraction rate that is assumed. It is chosen because fast directions
      may hide slow ones. The corrections of one gait decreased by a third each, and the gait was
      four times as far away as its bound;
    - `curvature_per_length`: smallest assumed contraction rate over the length of a correction,
      which measures the curvature of the maps;
    - `max_correction`: longest accepted correction, chosen because the linearization is unknown
      beyond it;
    - `max_failures`: number of corrections that do not contract, or of changes of the legs' codes,
      after which an element fails;
    - `max_iterations`: largest number of corrections;
    - `refresh_interval`: number of corrections after which matrices are recomputed;
    - `step_error_factor`: error of a step over the tolerance of its solver steps, chosen because 99
      of 100 errors are within a third of it;
    - `min_update_share`: smallest fraction of a direction that must remain after a step for an
      update of the inverse;
    - `difference_step`: step of finite differences in a coordinate of the section state;
    - `max_difference`: derivative by differences above which these may cross a jump. It is chosen
      because one in a hundred of 1,042 derivatives at gaits is steeper. Across a jump a correction
      gives no information about the remaining error;
    - `roundoff_level`, `stall_level`: lengths of corrections, in tolerances, at the level of the
      integrator's errors, and below which corrections may stall;
    - `n_presumed_missed_contacts`: number of shortest contacts of a foot that a step may miss or
      add;
    - `max_presumed_error_fraction`: largest fraction of the allowed error that is assumed for such
      contacts; otherwise their error is measured;
    - `stall_safety_factor`: safety factor of stalled corrections, relative to their own effect, and
      of the difference between steps at two tolerances. It is chosen because a factor of four was
      too small for 4 of 10,365 results;
    - `max_gait_distance`: largest distance of a gait from a walk's end without a second walk;
    - `max_walk_drift`: largest drift of the second walk;
    - `min_resolved_change`: length below which a change is not resolved.
    """

    refresh_above: float = 0.5
    max_trusted_rate: float = 0.25
    min_rate: float = 0.1
    curvature_per_length: float = 5.0
    max_correction: float = 1.0
    max_failures: int = 4
    max_iterations: int = 24
    refresh_interval: int = 8
    step_error_factor: float = 30.0
    min_update_share: float = 1e-3
    difference_step: float = 1e-5
    max_difference: float = 10.0
    roundoff_level: float = 1e2
    stall_level: float = 1e4
    n_presumed_missed_contacts: float = 3.0
    max_presumed_error_fraction: float = 0.1
    stall_safety_factor: float = 6.0
    max_gait_distance: float = 1e-3
    max_walk_drift: float = 1e-3
    min_resolved_change: float = 1e-13


BROYDEN_OPTIONS = BroydenOptions()
"""Options of the iteration for all measures."""


class StepEstimate(NamedTuple):
    """Estimates of gaits' measures from one step of the highest model; the batch axis is first.

    - `same_codes`: whether the step does not change the legs' codes;
    - `values`: estimated measures of the gait, (elements, measures), as are the errors below;
    - `correction_effect`: sum of the absolute effects of the correction on the measures;
    - `quantity_jacobian`: derivatives with respect to the step's quantities, (elements, measures,
      7);
    - `numerical_error`: bound of the integrator's error;
    - `missed_contact_error`: bound of the error due to contacts that are too short to be resolved.
    """

    same_codes: np.ndarray
    values: np.ndarray
    correction_effect: np.ndarray
    quantity_jacobian: np.ndarray
    numerical_error: np.ndarray
    missed_contact_error: np.ndarray


class RefinementResult(NamedTuple):
    """Result of the refinement, for each element."""

    is_done: np.ndarray
    values: np.ndarray
    remaining_error: np.ndarray  # (elements, measures): bound of the iteration's error
    numerical_error: np.ndarray
    n_steps: np.ndarray  # number of steps of the highest model
    section_states: np.ndarray  # (elements, 4 + 3 n)
    speed: np.ndarray  # speed in the last step, m/s


@dataclasses.dataclass
class BroydenIteration:
    """Quasi-Newton iteration of a batch to fixed points of the highest model."""

    ground: GroundBatch
    options: BroydenOptions
    indices: np.ndarray
    section_states: np.ndarray
    newton_matrix: np.ndarray  # (elements, m, m): inverse of I - DP
    # (elements, 7, m): derivatives of the quantities with respect to the state
    quantity_jacobian: np.ndarray
    has_current_matrices: np.ndarray  # whether the matrices are those of this motion
    is_free: np.ndarray
    has_previous: np.ndarray  # whether the previous step had the same codes
    previous_step_data: tuple[np.ndarray, ...]  # start, defect and quantities of the previous step
    correction: np.ndarray

    @classmethod
    def from_states(
        cls,
        ground: GroundBatch,
        indices: np.ndarray,
        section_states: np.ndarray,
        lower_gaits: LowerFidelityGait | None,
        options: BroydenOptions = BROYDEN_OPTIONS,
    ) -> "BroydenIteration":
        """Return the iteration from these states, with the matrices of lower gaits if they are
        given.
        """
        n_elements, n_numbers = len(indices), section_states.shape[1] - ground.n_legs
        newton_matrix = np.tile(np.eye(n_numbers), (n_elements, 1, 1))
        quantity_jacobian = np.zeros((n_elements, N_STEP_QUANTITIES, n_numbers))
        if lower_gaits is not None:
            plane_indices = ground.plane_indices()
            newton_matrix[:, plane_indices[:, None], plane_indices] = lower_gaits.newton_matrix
            quantity_jacobian[:, :, plane_indices] = lower_gaits.quantity_jacobian
        previous_step_data = (
            np.zeros((n_elements, n_numbers)),
            np.zeros((n_elements, n_numbers)),
            np.zeros((n_elements, N_STEP_QUANTITIES)),
        )
        return cls(
            ground,
            options,
            indices,
            section_states.copy(),
            newton_matrix,
            quantity_jacobian,
            has_current_matrices=np.full(n_elements, lower_gaits is not None),
            is_free=ground.find_free_coordinates(section_states),
            has_previous=np.zeros(n_elements, bool),
            previous_step_data=previous_step_data,
            correction=np.zeros((n_elements, n_numbers)),
        )

    def select(self, selected: np.ndarray) -> "BroydenIteration":
        """Return the iteration of the selected elements."""
        ground, options, *arrays = (
            getattr(self, field_value.name) for field_value in dataclasses.fields(self)
        )
        return BroydenIteration(ground, options, *jax.tree.map(lambda x: x[selected], arrays))

    def update_and_estimate(
        self, positions: np.ndarray, step: StepQuantities, names: Sequence[str]
    ) -> StepEstimate:
        """Update the matrices from a step of some elements, and return estimates of their gaits."""
        n_numbers = self.is_free.shape[1]
        section_states, end_states = self.section_states[positions], step.section_states
        same_codes = self.has_same_codes(positions, step)
        defect = np.where(
            self.is_free[positions] & same_codes[:, None],
            end_states[:, :n_numbers] - section_states[:, :n_numbers],
            0.0,
        )
        self._update_matrices(
            positions, section_states[:, :n_numbers], defect, step.quantities, same_codes
        )
        newton_matrix = self.newton_matrix[positions]
        quantity_jacobian = self.quantity_jacobian[positions]
        correction = np.where(
            self.is_free[positions], np.einsum("ijk,ik->ij", newton_matrix, defect), 0.0
        )
        self.correction[positions] = correction
        for previous_values, current_values in zip(
            self.previous_step_data,
            (section_states[:, :n_numbers], defect, step.quantities),
            strict=True,
        ):
            previous_values[positions] = current_values
        with np.errstate(all="ignore"):
            estimate = step.quantities + np.einsum("ijk,ik->ij", quantity_jacobian, correction)
            measure_jacobian = compute_measure_derivatives(names, estimate)
            state_sensitivity = np.abs(measure_jacobian @ quantity_jacobian)
            correction_effect = np.einsum("ijk,ik->ij", state_sensitivity, np.abs(correction))
            tolerance = self.options.step_error_factor * float(self.ground.options.rtol)
            total_sensitivity = np.abs(measure_jacobian).sum(-1) + np.sum(
                state_sensitivity @ np.abs(newton_matrix), axis=-1
            )
            # A contact that is not resolved moves time from one duration to another.
            duration_sensitivity_range = np.ptp(measure_jacobian[:, :, :N_DURATIONS], axis=-1)
            missed_contact_error = (
                self.options.n_presumed_missed_contacts
                * self.ground.min_resolved_contact_duration(self.indices[positions])[:, None]
                * duration_sensitivity_range
            )
            values = evaluate_measures(names, estimate)
            return StepEstimate(
                same_codes,
                values,
                correction_effect,
                measure_jacobian,
                tolerance * total_sensitivity,
                missed_contact_error,
            )

    def _update_matrices(
        self,
        positions: np.ndarray,
        states: np.ndarray,
        defect: np.ndarray,
        quantities: np.ndarray,
        same_codes: np.ndarray,
    ) -> None:
        """Apply Broyden's updates to both matrices of those elements whose previous step is
        comparable.
        """
        previous_states, previous_defect, previous_quantities = (
            previous_values[positions] for previous_values in self.previous_step_data
        )
        state_change = np.where(self.is_free[positions], states - previous_states, 0.0)
        defect_change = previous_defect - defect
        newton_matrix = self.newton_matrix[positions]
        quantity_jacobian = self.quantity_jacobian[positions]
        squared_length = np.einsum("ij,ij->i", state_change, state_change)
        predicted_change = np.einsum("ijk,ik->ij", newton_matrix, defect_change)
        projection = np.einsum("ij,ij->i", state_change, predicted_change)
        can_update = (
            self.has_previous[positions]
            & same_codes
            & (squared_length > self.options.min_resolved_change**2)
        )
        is_well_conditioned = can_update & (
            np.abs(projection) > self.options.min_update_share * squared_length
        )
        update_row = (
            np.einsum("ij,ijk->ik", state_change, newton_matrix)
            / np.where(is_well_conditioned, projection, 1.0)[:, None]
        )
        updated_matrix = (
            newton_matrix + (state_change - predicted_change)[:, :, None] * update_row[:, None, :]
        )
        self.newton_matrix[positions] = np.where(
            is_well_conditioned[:, None, None], updated_matrix, newton_matrix
        )
        prediction_error = (
            quantities
            - previous_quantities
            - np.einsum("ijk,ik->ij", quantity_jacobian, state_change)
        )
        update_row = state_change / np.where(can_update, squared_length, 1.0)[:, None]
        updated_matrix = quantity_jacobian + prediction_error[:, :, None] * update_row[:, None, :]
        self.quantity_jacobian[positions] = np.where(
            can_update[:, None, None], updated_matrix, quantity_jacobian
        )
        self.has_previous[positions] = same_codes

    def step_elements(self, positions: np.ndarray) -> StepQuantities:
        """Return the result of one step from the current states of some elements."""
        return self.ground.take_steps(self.indices[positions], self.section_states[positions])

    def has_same_codes(self, positions: np.ndarray, step: StepQuantities) -> np.ndarray:
        """Return whether the step of these elements ended with the legs' codes at its start."""
        n_numbers = self.is_free.shape[1]
        same_codes = np.all(
            self.section_states[positions, n_numbers:] == step.section_states[:, n_numbers:], axis=1
        )
        return same_codes & (step.outcome == Outcome.STEPPED)

    def compute_errors_by_comparison(
        self, positions: np.ndarray, names: Sequence[str], refinement: "RefinementResult"
    ) -> np.ndarray:
        """Return numerical errors from steps at other tolerances, which include those of unresolved
        contacts.

        At another tolerance the shortest resolved contact is shorter or longer. The error is
        infinite if one of these steps has another motion.
        """
        largest_error = np.zeros_like(refinement.numerical_error[positions])
        for other_ground in self.ground.list_with_other_tolerances():
            other_iteration = dataclasses.replace(
                self.select(positions),
                ground=other_ground,
                has_previous=np.zeros(len(positions), bool),
            )
            estimate = other_iteration.update_and_estimate(
                np.arange(len(positions)),
                other_iteration.step_elements(np.arange(len(positions))),
                names,
            )
            difference_bound = self.options.stall_safety_factor * np.abs(
                estimate.values - refinement.values[positions]
            )
            error = difference_bound + np.minimum(
                estimate.numerical_error, refinement.numerical_error[positions]
            )
            largest_error = np.maximum(
                largest_error, np.where(estimate.same_codes[:, None], error, np.inf)
            )
        return largest_error

    def is_attracting(self) -> np.ndarray:
        """Return whether nearby walks converge to the current states.

        No multiplier is then outside the unit circle. Equivalently, no eigenvalue of (I - DP)^-1
        has a real part below a half.
        """
        return np.linalg.eigvals(self.newton_matrix).real.min(-1) > 0.5

    def max_distance_to(self, section_states: np.ndarray) -> np.ndarray:
        """Return the largest distance of the current states from `section_states`."""
        return np.abs(self.section_states - section_states)[:, : self.is_free.shape[1]].max(-1)

    def walk_stays_near(self, n_steps: int) -> np.ndarray:
        """Return whether a walk of `n_steps` stays near the current states.

        The walk checks `is_attracting`, because finite differences across a change of contacts give
        wrong multipliers.
        """
        end = self.ground.take_steps(self.indices, self.section_states, n_steps)
        return (end.outcome == Outcome.STEPPED) & (
            self.max_distance_to(end.section_states) <= self.options.max_walk_drift
        )

    def apply_correction(
        self, positions: np.ndarray, end_states: np.ndarray, same_codes: np.ndarray
    ) -> None:
        """Replace the states by the corrected ones, or by the end of the step if codes have
        changed.
        """
        n_numbers = self.is_free.shape[1]
        corrected_states = np.where(
            self.is_free[positions],
            self.section_states[positions, :n_numbers] + self.correction[positions],
            end_states[:, :n_numbers],
        )
        self.section_states[positions] = end_states
        self.section_states[positions[same_codes], :n_numbers] = corrected_states[same_codes]
        self.section_states[positions[same_codes]] = self.ground.complete_states(
            self.section_states[positions[same_codes]]
        )
        changed_positions = positions[~same_codes]
        self.newton_matrix[changed_positions] = np.eye(n_numbers)
        self.quantity_jacobian[changed_positions] = 0.0
        self.has_current_matrices[changed_positions] = False
        self.is_free[changed_positions] = self.ground.find_free_coordinates(
            self.section_states[changed_positions]
        )

    def compute_difference_matrices(
        self, positions: np.ndarray, step: StepQuantities
    ) -> np.ndarray:
        """Recompute both matrices by finite differences, with one more step for each free
        coordinate.

        `step` is the step from the current states. Return the number of steps taken for each
        element. A difference above `max_difference` is also computed on the other side, and the
        smaller one is used.
        """
        n_numbers = self.is_free.shape[1]
        element_positions, coordinate_indices = np.nonzero(self.is_free[positions])
        if not len(element_positions):
            return np.zeros(0, int)
        differences = self._finite_differences(
            positions, step, element_positions, coordinate_indices, self.options.difference_step
        )
        steep_pairs = np.flatnonzero(np.abs(differences).max(-1) > self.options.max_difference)
        if len(steep_pairs):
            reverse_differences = self._finite_differences(
                positions,
                step,
                element_positions[steep_pairs],
                coordinate_indices[steep_pairs],
                -self.options.difference_step,
            )
            is_smaller = np.abs(reverse_differences).max(-1) < np.abs(differences[steep_pairs]).max(
                -1
            )
            differences[steep_pairs[is_smaller]] = reverse_differences[is_smaller]
        jacobian = np.zeros((len(positions), n_numbers, n_numbers))
        quantity_jacobian = np.zeros((len(positions), N_STEP_QUANTITIES, n_numbers))
        jacobian[element_positions, :, coordinate_indices] = np.where(
            self.is_free[positions][element_positions], differences[:, :n_numbers], 0.0
        )
        quantity_jacobian[element_positions, :, coordinate_indices] = differences[:, n_numbers:]
        newton_system = np.eye(n_numbers) - jacobian
        is_singular = np.abs(np.linalg.det(newton_system)) < self.options.min_resolved_change
        newton_system[is_singular] = np.eye(n_numbers)
        self.newton_matrix[positions] = np.linalg.inv(newton_system)
        self.quantity_jacobian[positions] = quantity_jacobian
        self.has_previous[positions], self.has_current_matrices[positions] = False, True
        return np.bincount(
            np.concatenate([element_positions, element_positions[steep_pairs]]),
            minlength=len(positions),
        )

    def _finite_differences(
        self,
        positions: np.ndarray,
        step: StepQuantities,
        element_positions: np.ndarray,
        coordinate_indices: np.ndarray,
        difference_step: float,
    ) -> np.ndarray:
        """Return derivatives of section state and quantities with respect to single coordinates,
        (pairs, m + 7).

        A pair is the position of an element and a coordinate. The derivatives are zero if the step
        ends with other codes.
        """
        n_numbers = self.is_free.shape[1]
        section_states = self.section_states[positions][element_positions]
        section_states[np.arange(len(element_positions)), coordinate_indices] += difference_step
        perturbed_step = self.ground.take_steps(
            self.indices[positions][element_positions], self.ground.complete_states(section_states)
        )
        same_codes = np.all(
            perturbed_step.section_states[:, n_numbers:]
            == step.section_states[element_positions, n_numbers:],
            axis=1,
        )
        changes = np.concatenate(
            [
                perturbed_step.section_states[:, :n_numbers]
                - step.section_states[element_positions, :n_numbers],
                perturbed_step.quantities - step.quantities[element_positions],
            ],
            1,
        )
        return np.where(same_codes[:, None], changes, 0.0) / difference_step


class _ErrorBound:
    """Bounds of the remaining error from the measured contraction of each element's corrections."""

    def __init__(
        self, n_elements: int, n_measures: int, tolerance: float, options: BroydenOptions
    ) -> None:
        self.tolerance, self.options = tolerance, options
        self.correction_length = np.full(n_elements, np.inf)
        self.contraction_rate = np.zeros(n_elements)
        self.correction_effect = np.full((n_elements, n_measures), np.inf)
        self.measures = np.full((n_elements, n_measures), np.nan)

    def reset(self, positions: np.ndarray, contraction_rate: float) -> None:
        """Reset the contraction of these elements after their matrices have been replaced."""
        self.correction_length[positions] = np.inf
        self.contraction_rate[positions] = contraction_rate

    def bound_remaining_error(
        self, positions: np.ndarray, estimate: StepEstimate, correction_length: np.ndarray
    ) -> tuple[np.ndarray, ...]:
        """Return the bound of the remaining error, the contraction rate, and whether the
        corrections stall.

        The bound has the shape (elements, measures). Corrections stall if they stop decreasing and
        are as small as the integrator's errors allow.
        """
        options = self.options
        previous_length = self.correction_length[positions]
        with np.errstate(all="ignore"):
            contraction_rate = np.where(
                estimate.same_codes, correction_length / previous_length, np.inf
            )
            # With differences across a change of contacts, shorter corrections change measures as
            # much as before.
            effect_contraction_rate = np.max(
                estimate.correction_effect
                / np.maximum(self.correction_effect[positions], options.min_resolved_change),
                axis=1,
            )
            is_stalled = (
                estimate.same_codes
                & (np.maximum(contraction_rate, effect_contraction_rate) > options.refresh_above)
                & np.isfinite(previous_length)
            )
            is_stalled &= (
                np.maximum(correction_length, previous_length)
                <= options.stall_level * self.tolerance
            )
            contraction_rate = np.where(
                estimate.same_codes
                & (correction_length <= options.roundoff_level * self.tolerance),
                0.0,
                contraction_rate,
            )
            # No rate is reliable until there is a previous correction.
            min_rate = np.clip(
                options.curvature_per_length * previous_length,
                options.min_rate,
                options.max_trusted_rate,
            )
            min_rate = np.where(np.isfinite(previous_length), min_rate, np.inf)
            pessimistic_rate = np.maximum(
                np.maximum(contraction_rate, self.contraction_rate[positions]), min_rate
            )
            pessimistic_rate = np.maximum(
                pessimistic_rate, np.where(contraction_rate > 0.0, effect_contraction_rate, 0.0)
            )
            value_change = np.abs(estimate.values - self.measures[positions])
            largest_effect = np.fmax(
                np.fmax(estimate.correction_effect, self.correction_effect[positions]), value_change
            )
            error_per_effect = np.where(
                pessimistic_rate <= options.max_trusted_rate,
                2.0 * pessimistic_rate / (1.0 - pessimistic_rate),
                np.inf,
            )
            error_per_effect = np.where(
                is_stalled,
                np.minimum(error_per_effect, options.stall_safety_factor),
                error_per_effect,
            )
            remaining_error = np.nan_to_num(
                error_per_effect[:, None] * largest_effect, nan=np.inf, posinf=np.inf
            )
        has_previous = np.isfinite(previous_length)
        self.contraction_rate[positions] = np.where(
            has_previous,
            np.where(estimate.same_codes, contraction_rate, 0.0),
            self.contraction_rate[positions],
        )
        self.correction_length[positions] = np.where(estimate.same_codes, correction_length, np.inf)
        self.correction_effect[positions] = estimate.correction_effect
        self.measures[positions] = estimate.values
        return remaining_error, contraction_rate, is_stalled


def refine(
    iteration: BroydenIteration,
    names: Sequence[str],
    error_goal: ErrorGoal,
    n_steps_before_differences: int,
    first_step_and_estimate: tuple[StepQuantities, StepEstimate] | None = None,
) -> RefinementResult:
    """Apply corrections until the remaining error is below the goal, and return the result.

    Finite differences replace the matrices after `n_steps_before_differences` steps, and
    immediately if the matrices are those of another motion. `first_step_and_estimate` is the step
    from the current states with its estimate, if that step has been taken.
    """
    n_elements, n_measures = len(iteration.indices), len(names)
    result = RefinementResult(
        np.zeros(n_elements, bool),
        np.full((n_elements, n_measures), np.nan),
        np.full((n_elements, n_measures), np.inf),
        np.zeros((n_elements, n_measures)),
        np.zeros(n_elements, int),
        iteration.section_states,
        np.full(n_elements, np.nan),
    )
    options, tolerance = iteration.options, float(iteration.ground.options.rtol)
    error_bound = _ErrorBound(n_elements, n_measures, tolerance, options)
    n_failures, active_positions = np.zeros(n_elements, int), np.arange(n_elements)
    n_steps_since_refresh = np.full(
        n_elements, options.refresh_interval - n_steps_before_differences
    )
    needs_comparison = np.zeros(n_elements, bool)
    for iteration_index in range(options.max_iterations):
        if not len(active_positions):
            break
        if first_step_and_estimate is not None and iteration_index == 0:
            step, estimate = first_step_and_estimate
        else:
            step = iteration.step_elements(active_positions)
            result.n_steps[active_positions] += 1
            needs_refresh = iteration.has_same_codes(active_positions, step) & (
                (n_steps_since_refresh[active_positions] >= options.refresh_interval)
                | ~iteration.has_current_matrices[active_positions]
            )
            positions = active_positions[needs_refresh]
            result.n_steps[positions] += iteration.compute_difference_matrices(
                positions, StepQuantities(*(step_array[needs_refresh] for step_array in step))
            )
            error_bound.reset(positions, 0.0 if n_steps_before_differences else np.inf)
            n_steps_since_refresh[positions] = 0
            estimate = iteration.update_and_estimate(active_positions, step, names)
        correction_length = np.linalg.norm(iteration.correction[active_positions], axis=1)
        remaining_error, contraction_rate, is_stalled = error_bound.bound_remaining_error(
            active_positions, estimate, correction_length
        )
        error_goals = error_goal(estimate.values)
        is_done = is_stalled | np.all(
            remaining_error
            <= np.maximum(error_goals - estimate.numerical_error, estimate.numerical_error),
            axis=1,
        )
        result.values[active_positions], result.is_done[active_positions] = estimate.values, is_done
        result.remaining_error[active_positions] = remaining_error
        result.numerical_error[active_positions] = (
            estimate.numerical_error + estimate.missed_contact_error
        )
        result.speed[active_positions] = evaluate_measures(("speed",), step.quantities)[:, 0]
        # A walk may end at a gait with more short contacts than assumed.
        needs_comparison[active_positions] = is_done & (
            np.any(
                estimate.missed_contact_error > options.max_presumed_error_fraction * error_goals,
                axis=1,
            )
            | (n_steps_before_differences == 0)
        )
        converges_slowly = np.isfinite(contraction_rate) & (
            contraction_rate > options.refresh_above
        )
        n_failures[active_positions] += ~estimate.same_codes | converges_slowly
        n_steps_since_refresh[active_positions] = np.where(
            converges_slowly, options.refresh_interval, n_steps_since_refresh[active_positions] + 1
        )
        is_continued = (
            ~is_done
            & (step.outcome == Outcome.STEPPED)
            & (correction_length <= options.max_correction)
        )
        is_continued &= n_failures[active_positions] < options.max_failures
        iteration.apply_correction(
            active_positions[is_continued],
            step.section_states[is_continued],
            estimate.same_codes[is_continued],
        )
        active_positions = active_positions[is_continued]
    positions = np.flatnonzero(needs_comparison)
    if len(positions):
        result.numerical_error[positions] = iteration.compute_errors_by_comparison(
            positions, names, result
        )
        result.n_steps[positions] += len(iteration.ground.list_with_other_tolerances())
    result.is_done[positions] &= np.isfinite(result.numerical_error[positions]).all(1)
    return result
