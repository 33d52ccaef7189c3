"""Find gaits with unilateral contact by walks and Newton's method, and bound errors of measures.

In a fast walk, the states of the legs decay within a few steps. The remaining motion then drifts
slowly on one curve for hundreds of steps. A few steps determine the drift per step and its decay. A
leap in the direction of the drift replaces the remaining steps (projective integration: C. W. Gear
and I. G. Kevrekidis, SIAM J. Sci. Comput. 24, 2003). A leap ends at the latest at the predicted
limit of the drift. The state at the end of a walk is the initial guess for the refinement.

One walking step with unilateral contact from a section state x yields the defect r = P(x) - x,
where P is the return map. Newton's correction is d = (I - DP)^-1 r. The gait's step quantities are
those of this step plus their first-order change due to d. The Jacobian DP of one step is used for
several corrections (chord iteration). It is computed again if corrections contract slowly or the
contact codes of the legs change.
"""

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from vrw_jax.base.outcomes import Outcome
from vrw_jax.gaits.unilateral_finder import solve_linear_systems
from vrw_jax.lanes.batching import replace_rows
from vrw_jax.models.contact_section import LOCKED_CODE_OFFSET
from vrw_jax.studies.fidelity import (
    QUANTITY_NAMES,
    ContactWheelBatch,
    LowerFidelityGaits,
    ModelIndex,
    StepQuantities,
    compute_measure_derivatives,
    evaluate_measures,
    multiply_rows,
)


class WalkEnds(NamedTuple):
    """Full section state and outcome at the end of each walk."""

    has_settled: np.ndarray  # whether the walk has settled, probably near a gait
    section_states: np.ndarray  # (walks, 4 + 3 n)
    walk_outcomes: np.ndarray  # STEPPED, or the failure that ended the walk
    n_steps: np.ndarray  # number of walking steps


# Number of walking steps before the first leap.
N_WARMUP_STEPS = 20
# Largest number of leaps.
MAX_LEAPS = 10
# Number of walking steps after a leap. The value is chosen because five steps miss three of 118
# gaits, among 451 wheels for which the paper's model has no gait.
N_STEPS_PER_LEAP = 7
# Largest length of a leap, in rad, rad/s, m and m/s, chosen because longer leaps skip pairs of
# close gaits.
MAX_LEAP_DISTANCE = 0.15
# Largest ratio of the fade distance to the length of all remaining leaps together. A walk with a
# larger ratio ends. The fade distance is the distance to the predicted limit of the drift.
MAX_FADE_DISTANCE_RATIO = 2.0
# Largest number of remaining leaps at which `MAX_FADE_DISTANCE_RATIO` is tested, chosen because a
# drift may first grow and then decay.
MAX_LEAPS_LEFT_TO_GIVE_UP = 3


def walk_until_settled(
    wheel_batch: ContactWheelBatch,
    wheel_indices: np.ndarray,
    section_states: np.ndarray,
) -> WalkEnds:
    """Return the ends of walks that start at full section states, (walks, 4 + 3 n).

    Each walk settles, fails, or ends without settling after the last leap.
    """
    n_walks, n_continuous_entries = len(wheel_indices), section_states.shape[1] - wheel_batch.n_legs
    loose_step_batch = wheel_batch.make_walk_batch()
    walk_ends = WalkEnds(
        np.zeros(n_walks, bool),
        section_states.copy(),
        np.full(n_walks, int(Outcome.STEPPED)),
        np.zeros(n_walks, int),
    )
    active_walk_indices, start_states = np.arange(n_walks), section_states
    n_steps_before_leaps = (
        N_WARMUP_STEPS,
        *MAX_LEAPS * (N_STEPS_PER_LEAP,),
    )
    for leap_index, n_steps_before_leap in enumerate(n_steps_before_leaps):
        if not len(active_walk_indices):
            break
        walk_ends.n_steps[active_walk_indices] += n_steps_before_leap
        active_wheel_indices = wheel_indices[active_walk_indices]
        third_last_step = loose_step_batch.take_steps(
            active_wheel_indices, start_states, n_steps_before_leap - 2
        )
        failed_walk_indices = np.flatnonzero(third_last_step.step_outcomes != Outcome.STEPPED)
        if len(failed_walk_indices):
            # A leap failed, or the tolerance of the first steps is too loose.
            retried_step = (loose_step_batch if leap_index else wheel_batch).take_steps(
                active_wheel_indices[failed_walk_indices],
                walk_ends.section_states[active_walk_indices[failed_walk_indices]],
                n_steps_before_leap - 2,
            )
            third_last_step = replace_rows(third_last_step, failed_walk_indices, retried_step)
        last_steps = [third_last_step]
        for _ in range(2):
            last_steps.append(
                loose_step_batch.take_steps(active_wheel_indices, last_steps[-1].section_states)
            )
        step_outcomes = np.stack([step.step_outcomes for step in last_steps])
        has_stepped = np.all(step_outcomes == Outcome.STEPPED, axis=0)
        first_failed_step_index = np.argmax(step_outcomes != Outcome.STEPPED, axis=0)
        walk_ends.walk_outcomes[active_walk_indices] = step_outcomes[
            first_failed_step_index, np.arange(len(active_walk_indices))
        ]
        active_walk_indices = active_walk_indices[has_stepped]
        last_states = np.stack([step.section_states[has_stepped] for step in last_steps])
        walk_ends.section_states[active_walk_indices] = last_states[-1]
        walk_ends.has_settled[active_walk_indices], leap_vectors, fade_distance = (
            _extrapolate_drift(last_states, n_continuous_entries)
        )
        n_remaining_leaps = MAX_LEAPS - leap_index
        is_walk_continued = ~walk_ends.has_settled[active_walk_indices] & (
            (n_remaining_leaps > MAX_LEAPS_LEFT_TO_GIVE_UP)
            | (fade_distance <= MAX_FADE_DISTANCE_RATIO * MAX_LEAP_DISTANCE * n_remaining_leaps)
        )
        active_walk_indices = active_walk_indices[is_walk_continued]
        start_states = walk_ends.section_states[active_walk_indices]
        # Each walking step first places loaded feet on the slope, so a leap ends at a valid start.
        start_states[:, :n_continuous_entries] += leap_vectors[is_walk_continued]
    return walk_ends


# Largest drift per walking step, and largest fade distance, in a settled walk.
MAX_SETTLED_DRIFT = 5e-4
# Drift per walking step below which errors of the steps dominate.
DRIFT_NOISE_LEVEL = 1e-5


def _extrapolate_drift(
    last_states: np.ndarray, n_continuous_entries: int
) -> tuple[np.ndarray, ...]:
    """Return whether each walk has settled, the leap of each walk, and the fade distance.

    The first `n_continuous_entries` entries of a section state are continuous. A leap starts at the
    last state. The fade distance is the distance from this state to the predicted limit of the
    drift. The leap and the fade distance are zero if the contact codes of the legs change.

    - `last_states`: last three section states of each walk, (3, walks, 4 + 3 n).
    """
    leg_codes = last_states[:, :, n_continuous_entries:]
    has_same_leg_codes = np.all(leg_codes == leg_codes[-1], axis=(0, 2))
    earlier_state_change, last_state_change = np.diff(
        last_states[:, :, :n_continuous_entries], axis=0
    )
    drift_per_step = np.abs(last_state_change).max(1)
    with np.errstate(all="ignore"):
        decay_rate = np.nan_to_num(
            np.sum(earlier_state_change * last_state_change, axis=1)
            / np.sum(earlier_state_change * earlier_state_change, axis=1)
        )
        n_steps_to_fade = np.where(decay_rate < 1.0, decay_rate / (1.0 - decay_rate), np.inf)
        fade_distance = np.where(
            drift_per_step < DRIFT_NOISE_LEVEL,
            0.0,
            np.abs(n_steps_to_fade) * drift_per_step,
        )
        n_leap_steps = np.where(
            drift_per_step > 0.0,
            np.minimum(n_steps_to_fade, MAX_LEAP_DISTANCE / drift_per_step),
            0.0,
        )
    # A drift that changes sign at each step leads to a gait of two steps.
    has_settled = (
        has_same_leg_codes
        & (fade_distance < MAX_SETTLED_DRIFT)
        & (drift_per_step < MAX_SETTLED_DRIFT)
    )
    has_leap_vector = has_same_leg_codes & ~has_settled & (decay_rate > 0.0)
    return (
        has_settled,
        np.where(has_leap_vector, n_leap_steps, 0.0)[:, None] * last_state_change,
        np.where(has_same_leg_codes, fade_distance, 0.0),
    )


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
