"""Refine gaits with unilateral contact by Newton's method, and bound the errors of their measures.

One walking step with unilateral contact from a section state x yields the defect r = P(x) - x,
where P is the return map. Newton's correction is d = (I - DP)^-1 r. The gait's step quantities are
those of this step plus their first-order change due to d. The Jacobian DP of one step is used for
several corrections (chord iteration). It is computed again if corrections contract slowly or the
contact codes of the legs change.

The first step starts at the gait of the lower model. Its defect, propagated to the measure by the
lower model's derivatives, approximates the model error to second order. The estimate is a
dual-weighted residual (R. Becker and R. Rannacher, Acta Numerica 10, 2001), in which the next model
replaces the finer mesh. If the error is within the tolerance, the lower model's measure is
returned. Otherwise Newton's method, starting at the end of that step, finds the gait with
unilateral contact. If that gait is far from the lower model's gait, a walk to another gait is
computed.
"""

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from vrw_jax.base.results import Outcome, StatusCode
from vrw_jax.gaits.gait_walks import compute_walk_starts
from vrw_jax.gaits.unilateral_finder import solve_linear_systems
from vrw_jax.lanes.batching import replace_rows, select_rows_on_device, select_tree_rows
from vrw_jax.models.contact_record import LOCKED_CODE_OFFSET
from vrw_jax.studies.fidelity import (
    QUANTITY_NAMES,
    ContactWheelBatch,
    LowerFidelityGaits,
    ModelIndex,
    StepQuantities,
    compute_measure_derivatives,
    evaluate_measures,
    multiply_rows,
    walk_until_settled,
)
from vrw_jax.wheel.params import WheelParams


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
    state_change = contact_step.section_states - section_states
    has_same_leg_codes = np.all(state_change[:, n_continuous_entries:] == 0.0, axis=1) & (
        contact_step.step_outcomes == Outcome.STEPPED
    )
    defect = state_change[:, section_coordinates] * has_same_leg_codes[:, None]
    with np.errstate(all="ignore"):
        correction = multiply_rows(inverse_newton_matrix, defect)
        quantities = contact_step.step_quantities + multiply_rows(
            step_quantity_jacobian, correction
        )
        measure_jacobian = compute_measure_derivatives(measure_names, quantities)
        state_sensitivity = np.abs(measure_jacobian @ step_quantity_jacobian)
        quantity_sensitivity = np.abs(measure_jacobian).sum(-1) + np.sum(
            state_sensitivity @ np.abs(inverse_newton_matrix), axis=-1
        )
        step_error_bound = STEP_ERROR_IN_TOLERANCES * float(wheel_batch.step_options.rtol)
        # An unresolved contact adds its time to one duration and takes the time from another.
        duration_sensitivity = np.ptp(measure_jacobian[:, :, :3], axis=-1)
        missed_duration = N_PRESUMED_MISSED_CONTACTS * wheel_batch.compute_min_contact_duration(
            wheel_indices
        )
        return MeasureEstimates(
            has_same_leg_codes,
            correction,
            evaluate_measures(measure_names, quantities),
            multiply_rows(state_sensitivity, np.abs(correction)),
            measure_jacobian,
            step_error_bound * quantity_sensitivity,
            missed_duration[:, None] * duration_sensitivity,
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
) -> "RefinedGaits":
    """Return the gaits near full section states, with their measures and bounds for the errors.

    - `wheel_indices`: index of the wheel of each gait, (gaits,);
    - `section_states`: initial guesses for the section states, (gaits, 4 + 3 n);
    - `compute_error_goal`: function that returns the allowed errors for given measures;
    - `is_every_gait_compared`: whether the numerical error is always estimated from walking
      steps at other tolerances. Otherwise it is so only for gaits whose error due to missed
      contacts is too large to be presumed.

    Newton's corrections of a gait end when the remaining error is below the allowed error.
    """
    gaits = RefinedGaits(
        wheel_batch, wheel_indices, section_states.copy(), measure_names, compute_error_goal
    )
    remaining = np.arange(len(section_states))
    for _ in range(MAX_JACOBIANS_PER_GAIT):
        if len(remaining):
            remaining = gaits.correct(remaining)
    gaits.compare_tolerances(
        gaits.is_found & (is_every_gait_compared | gaits.has_large_presumed_error)
    )
    gaits.error_bounds += gaits.numerical_bounds
    gaits.is_found &= np.isfinite(gaits.error_bounds).all(1)
    return gaits


@dataclass
class RefinedGaits:
    """Gaits with unilateral contact and their measures, with a leading axis over the gaits in
    every array.

    - `section_states`: full section states, (gaits, 4 + 3 n);
    - `is_found`: whether the iteration has converged;
    - `values`, `error_bounds`: measures and bounds of their errors, (gaits, measures);
    - `n_steps`: walking steps; a Jacobian costs `JACOBIAN_COST_IN_STEPS`;
    - `speeds`: mean speed of the last step, m/s.
    """

    wheel_batch: ContactWheelBatch
    wheel_indices: np.ndarray
    section_states: np.ndarray
    measure_names: Sequence[str]
    compute_error_goal: Callable[[np.ndarray], np.ndarray]

    def __post_init__(self) -> None:
        n_gaits, n_coordinates = self.section_states.shape
        self.values = np.full((n_gaits, len(self.measure_names)), np.nan)
        self.error_bounds, self.numerical_bounds = np.full((2, *self.values.shape), np.inf)
        self.is_found, self.has_large_presumed_error = np.zeros((2, n_gaits), bool)
        self.n_steps, self.speeds = np.zeros(n_gaits, int), np.full(n_gaits, np.nan)
        self.inverses = np.zeros((n_gaits, n_coordinates, n_coordinates))
        self.quantity_jacobians = np.zeros((n_gaits, len(QUANTITY_NAMES), n_coordinates))

    @functools.cached_property
    def is_attracting(self) -> np.ndarray:
        """Return whether all multipliers of each gait are inside the unit circle.

        This is so if all eigenvalues of (I - DP)^-1 have real parts above a half.
        """
        inverses = np.nan_to_num(self.inverses, posinf=0.0, neginf=0.0)
        return np.linalg.eigvals(inverses).real.min(-1) > 0.5

    def find_distinct_gaits(self, gait_indices: np.ndarray) -> list[int]:
        """Return the indices of the different attracting gaits of one wheel, slowest first.

        `gait_indices` are the indices of the wheel's gaits. Two gaits are different if a measure
        differs by more than the sum of both error bounds.
        """
        values, bounds, distinct = self.values, self.error_bounds, list[int]()
        for i in gait_indices[(self.is_found & self.is_attracting)[gait_indices]].tolist():
            is_different = np.abs(values[i] - values[distinct]) > bounds[i] + bounds[distinct]
            if np.all(np.any(is_different, axis=1)):
                distinct.append(i)
        return sorted(distinct, key=lambda i: self.speeds[i])

    def take_steps(self, batch: ContactWheelBatch, gaits: np.ndarray) -> StepQuantities:
        self.n_steps[gaits] += 1
        return batch.take_steps(self.wheel_indices[gaits], self.section_states[gaits])

    def estimate(
        self, batch: ContactWheelBatch, gaits: np.ndarray, step: StepQuantities
    ) -> MeasureEstimates:
        return estimate_measures(
            batch,
            self.wheel_indices[gaits],
            self.section_states[gaits],
            step,
            self.inverses[gaits],
            self.quantity_jacobians[gaits],
            self.measure_names,
        )

    def correct(self, gaits: np.ndarray) -> np.ndarray:
        """Correct gaits with one Jacobian, and return the indices of those that need another."""
        batch, remaining = self.wheel_batch, gaits[:0]
        step, jacobian, self.quantity_jacobians[gaits] = batch.linearize_steps(
            self.wheel_indices[gaits], self.section_states[gaits]
        )
        identity = np.eye(jacobian.shape[-1])
        self.inverses[gaits] = solve_linear_systems(
            identity - jacobian, np.broadcast_to(identity, jacobian.shape)
        )
        self.n_steps[gaits] += JACOBIAN_COST_IN_STEPS
        last_length = np.full(len(gaits), np.inf)
        for n_corrections in range(MAX_CORRECTIONS_PER_JACOBIAN):
            estimates = self.estimate(batch, gaits, step)
            has_same_codes = estimates.has_same_leg_codes
            length = np.linalg.norm(estimates.newton_correction, axis=1)
            contraction = length / np.maximum(last_length, np.finfo(float).tiny)
            is_slow = contraction > MAX_CONTRACTION_RATE
            is_stalled = length <= STALL_LENGTH_IN_TOLERANCES * float(batch.step_options.rtol)
            goal = self.compute_error_goal(estimates.measure_values)
            step_bound = estimates.numerical_error_bound
            remaining_bound = REFINEMENT_SAFETY_FACTOR * estimates.correction_effect_on_measures
            missed_bound = estimates.missed_contact_error_bound
            is_accurate = np.all(
                remaining_bound <= np.maximum(goal - step_bound, step_bound), axis=1
            ) & (n_corrections > 0)
            is_finished = has_same_codes & np.where(is_slow, is_stalled, is_accurate)
            finished = gaits[is_finished]
            self.is_found[finished] = True
            self.values[finished] = estimates.measure_values[is_finished]
            self.error_bounds[finished] = remaining_bound[is_finished]
            self.numerical_bounds[finished] = (step_bound + missed_bound)[is_finished]
            speeds = evaluate_measures(("speed",), step.step_quantities)[:, 0]
            self.speeds[finished] = speeds[is_finished]
            self.has_large_presumed_error[finished] = np.any(
                missed_bound > MAX_PRESUMED_ERROR_FRACTION * goal, axis=1
            )[is_finished]
            is_continued = (
                ~is_finished
                & (step.step_outcomes == Outcome.STEPPED)
                & (length <= MAX_CORRECTION_LENGTH)
                & (contraction < 1.0)
            )
            self.section_states[gaits[is_continued]] = np.where(
                has_same_codes[:, None],
                self.section_states[gaits] + estimates.newton_correction,
                step.section_states,
            )[is_continued]
            needs_jacobian = is_continued & (is_slow | ~has_same_codes)
            remaining = np.append(remaining, gaits[needs_jacobian])
            is_continued &= ~needs_jacobian
            gaits, last_length = gaits[is_continued], length[is_continued]
            if not len(gaits):
                break
            step = self.take_steps(batch, gaits)
        return remaining

    def compare_tolerances(self, is_compared: np.ndarray) -> None:
        """Replace the numerical errors of gaits by bounds from steps at other tolerances."""
        gaits = np.flatnonzero(is_compared)
        bounds = [np.zeros((len(gaits), len(self.measure_names)))]
        for batch in self.wheel_batch.make_comparison_batches():
            # The duration of the shortest resolved contact depends on the tolerance.
            estimates = self.estimate(batch, gaits, self.take_steps(batch, gaits))
            bound = REFINEMENT_SAFETY_FACTOR * np.abs(estimates.measure_values - self.values[gaits])
            bound += np.minimum(estimates.numerical_error_bound, self.numerical_bounds[gaits])
            # A step that changes the legs' codes gives no bound.
            bounds.append(np.where(estimates.has_same_leg_codes[:, None], bound, np.inf))
        self.numerical_bounds[gaits] = np.max(bounds, axis=0)


class MeasureStatus(StatusCode):
    """Method by which a measure was computed."""

    CHECKED_BY_ONE_STEP = 0, "checked by one step with unilateral contact"
    CONTINUES_LOWER_GAIT = 1, "the gait that continues the lower model's"
    REACHED_FROM_LOWER_GAIT = (2, "a gait to which a walk from the lower model's gait leads")
    REACHED_FROM_START = (
        3,
        "a gait to which a walk from a start leads, as the paper's wheel has no gait",
    )
    NO_GAIT = 4, "no such gait with unilateral contact"
    SELECTED_BY_RANK = 5, "one of the attracting gaits"


# Ratio of the error bound to the error estimated from one walking step. It is chosen because the
# bound holds if each Newton correction is at most 3/4 as long as the previous correction.
REQUEST_SAFETY_FACTOR = 4.0
# Number of starts of walks, slow starts first, for wheels for which the lower model has no gait. It
# is chosen because walks from the first two starts reach a gait for 100 of 232 wheels. Walks from
# further starts reach a gait for no other wheel.
N_COLD_STARTS = 2
# Largest accepted distance between the lower model's gait and the gait with unilateral contact, in
# lengths of the first correction. It is chosen because the sum of corrections that are halved each
# time is twice the first correction.
MAX_GAIT_DISTANCE_RATIO = 2.0


@dataclass
class MeasureRequest:
    """State of the computation of measures for a batch of wheels, with the results so far."""

    measure_names: tuple[str, ...]
    tol: float
    relative: bool
    wheel_batch: ContactWheelBatch
    params: WheelParams

    def __post_init__(self) -> None:
        n_wheels = self.wheel_batch.parameter_matrix.shape[1]
        self.lower_gaits = LowerFidelityGaits.without_gait(n_wheels)
        fill = lambda value: np.full((n_wheels, len(self.measure_names)), value)
        all_wheels = np.arange(n_wheels)
        self.result_arrays = {
            "values": fill(np.nan),
            "errors": fill(np.inf),
            "model_errors": fill(np.nan),
            "numerical_errors": fill(np.inf),
            "models": np.full(n_wheels, ModelIndex.NONE),
            "statuses": np.full(n_wheels, int(MeasureStatus.NO_GAIT)),
            "n_steps": np.zeros(n_wheels, int),
            "outcomes": np.full(n_wheels, int(Outcome.NO_CYCLE_FOUND)),
            "n_gaits": np.zeros(n_wheels, int),
            "states": self.wheel_batch.embed_paper_states(all_wheels, np.zeros((n_wheels, 3))),
        }

    def compute_error_goal(self, values: np.ndarray) -> np.ndarray:
        """Return the allowed absolute errors for measures with the given values."""
        return self.tol * (np.abs(values) if self.relative else np.ones_like(values))

    def find_unfinished_indices(self) -> np.ndarray:
        return np.flatnonzero(self.result_arrays["models"] == ModelIndex.NONE)

    def walk_to_gaits(self) -> None:
        """Compute walks of wheels without a result, and store the measures of the gaits reached."""
        unfinished = self.find_unfinished_indices()
        has_lower_gait = self.lower_gaits.model_index[unfinished] != ModelIndex.NONE
        wheels, unfinished = unfinished[has_lower_gait], unfinished[~has_lower_gait]
        self._walk_and_record_gaits(
            wheels, self.lower_gaits.section_states[wheels], MeasureStatus.REACHED_FROM_LOWER_GAIT
        )
        walk_starts = compute_walk_starts(select_rows_on_device(self.params, unfinished))
        for start in walk_starts[:N_COLD_STARTS]:
            is_missing = self.result_arrays["models"][unfinished] == ModelIndex.NONE
            self._walk_and_record_gaits(
                unfinished[is_missing], start[is_missing], MeasureStatus.REACHED_FROM_START
            )

    def select_gait_by_rank(self, gait_rank: int) -> None:
        """Store the measures of the gait with the index `gait_rank`, slowest first.

        The gaits are those that walks from all starts reach.
        """
        wheels = self.find_unfinished_indices()
        starts = compute_walk_starts(self.params)
        gait_wheels, gaits = self._walk_and_refine_gaits(
            np.tile(wheels, len(starts)), np.concatenate(starts)
        )
        selected = []
        for wheel in wheels:
            distinct = gaits.find_distinct_gaits(np.flatnonzero(gait_wheels == wheel))
            self.result_arrays["n_gaits"][wheel] = len(distinct)
            selected += distinct[gait_rank:][:1] if -len(distinct) <= gait_rank else []
        self._record_gaits(
            gait_wheels, gaits, np.array(selected, int), MeasureStatus.SELECTED_BY_RANK
        )

    def correct_lower_gaits(
        self,
        wheel_indices: np.ndarray,
        find_gaits: Callable[[WheelParams], LowerFidelityGaits],
        are_rejected_gaits_refined: bool,
    ) -> None:
        """Compute one step with unilateral contact from each lower gait, and store measures.

        The measures of a lower gait are stored if the estimated errors are within `tol`. If
        `are_rejected_gaits_refined` is True, the other lower gaits are the initial guesses for
        gaits with unilateral contact, whose measures are stored as well.
        """
        if not len(wheel_indices):
            return
        gaits = find_gaits(select_rows_on_device(self.params, wheel_indices))
        self.lower_gaits = replace_rows(self.lower_gaits, wheel_indices, gaits)
        has_gait = np.isfinite(gaits.step_quantities).all(1)
        wheel_indices, gaits = select_tree_rows((wheel_indices, gaits), has_gait)
        states, step, estimates = estimate_measures_from_lower_gaits(
            self.wheel_batch, wheel_indices, gaits, self.measure_names
        )
        values = evaluate_measures(self.measure_names, gaits.step_quantities)
        with np.errstate(all="ignore"):
            step_change = evaluate_measures(self.measure_names, step.step_quantities) - values
            total_change = np.abs(step_change) + estimates.correction_effect_on_measures
            model_error = values - estimates.measure_values
            sensitivity = np.abs(estimates.measure_jacobian @ gaits.step_quantity_jacobian)
            numerical_error = (
                multiply_rows(sensitivity, np.abs(gaits.section_state_error))
                + estimates.numerical_error_bound
                + estimates.missed_contact_error_bound
            )
            error = (
                np.abs(model_error) + (REQUEST_SAFETY_FACTOR - 1.0) * total_change + numerical_error
            )
            is_accepted = estimates.has_same_leg_codes & np.all(
                error <= self.compute_error_goal(values), axis=1
            )
        self.result_arrays["n_steps"][wheel_indices] += 1
        lower_results = {
            "models": gaits.model_index,
            "values": values,
            "errors": error,
            "model_errors": model_error,
            "numerical_errors": numerical_error,
            "states": states,
        }
        self._record_results(
            wheel_indices[is_accepted],
            select_tree_rows(lower_results, is_accepted),
            MeasureStatus.CHECKED_BY_ONE_STEP,
        )
        is_refined = are_rejected_gaits_refined & ~is_accepted & estimates.has_same_leg_codes
        wheel_indices = wheel_indices[is_refined]
        refined = self._refine_gaits(wheel_indices, step.section_states[is_refined], False)
        distances, correction_lengths = (
            np.linalg.norm(x, axis=1)
            for x in (
                (refined.section_states - states[is_refined])[
                    :, self.wheel_batch.list_paper_state_indices()
                ],
                estimates.newton_correction[is_refined],
            )
        )
        is_near = distances <= MAX_GAIT_DISTANCE_RATIO * correction_lengths
        self._record_gaits(
            wheel_indices, refined, refined.is_found & is_near, MeasureStatus.CONTINUES_LOWER_GAIT
        )

    def _refine_gaits(
        self, wheel_indices: np.ndarray, states: np.ndarray, is_every_gait_compared: bool
    ) -> RefinedGaits:
        """Return the gaits near full section states, and add their steps to the results."""
        gaits = refine_gaits(
            self.wheel_batch,
            wheel_indices,
            states,
            self.measure_names,
            self.compute_error_goal,
            is_every_gait_compared,
        )
        np.add.at(self.result_arrays["n_steps"], wheel_indices, gaits.n_steps)
        return gaits

    def _walk_and_record_gaits(
        self, wheel_indices: np.ndarray, section_states: np.ndarray, status: MeasureStatus
    ) -> None:
        """Compute walks from the paper's section states, and store measures of the gaits reached.

        The section states have the shape (wheels, 3).
        """
        gait_wheels, gaits = self._walk_and_refine_gaits(wheel_indices, section_states)
        self._record_gaits(gait_wheels, gaits, gaits.is_found & gaits.is_attracting, status)

    def _walk_and_refine_gaits(
        self, wheel_indices: np.ndarray, section_states: np.ndarray
    ) -> tuple[np.ndarray, RefinedGaits]:
        """Return the gaits at the ends of walks from the paper's section states, after refinement.

        The result is (wheel index of each gait, gaits).
        """
        walk_ends = walk_until_settled(
            self.wheel_batch,
            wheel_indices,
            self.wheel_batch.embed_paper_states(wheel_indices, section_states),
        )
        np.add.at(self.result_arrays["n_steps"], wheel_indices, walk_ends.n_steps)
        # A step cannot begin if a wheel has turned more than once in flight.
        is_reason_unknown = np.isin(walk_ends.walk_outcomes, (Outcome.STEPPED, Outcome.BAD_INPUT))
        is_in_domain = select_rows_on_device(self.params, wheel_indices).is_in_domain()
        failures = np.where(is_in_domain, Outcome.NO_CYCLE_FOUND, Outcome.BAD_INPUT)
        self.result_arrays["outcomes"][wheel_indices] = np.where(
            is_reason_unknown, failures, walk_ends.walk_outcomes
        )
        wheel_indices = wheel_indices[walk_ends.has_settled]
        states = walk_ends.section_states[walk_ends.has_settled]
        return wheel_indices, self._refine_gaits(wheel_indices, states, True)

    def _record_gaits(
        self,
        gait_wheels: np.ndarray,
        gaits: RefinedGaits,
        selected_gaits: np.ndarray,
        status: MeasureStatus,
    ) -> None:
        """Store the measures of the selected gaits with unilateral contact.

        - `gait_wheels`: index of the wheel of each gait;
        - `selected_gaits`: indices or mask of the selected gaits.
        """
        wheels, values, errors, states = select_tree_rows(
            (gait_wheels, gaits.values, gaits.error_bounds, gaits.section_states), selected_gaits
        )
        lower_values = evaluate_measures(
            self.measure_names, self.lower_gaits.step_quantities[wheels]
        )
        gait_results = {
            "models": ModelIndex.UNILATERAL,
            "values": values,
            "errors": errors,
            "model_errors": lower_values - values,
            "numerical_errors": errors,
            "states": states,
        }
        self._record_results(wheels, gait_results, status)

    def _record_results(
        self, wheel_indices: np.ndarray, results: dict[str, Any], status: MeasureStatus
    ) -> None:
        """Store the results of the wheels with the indices `wheel_indices`.

        The keys of `results` are those of `result_arrays`. `status` is the method of the results.
        """
        results = results | {"statuses": status, "outcomes": Outcome.STEPPED}
        for result_name, new_result_values in results.items():
            self.result_arrays[result_name][wheel_indices] = new_result_values
