"""Walk with unilateral contact until the motion settles, with extrapolation between walking steps.

In a fast walk, the states of the legs decay within a few steps. The remaining motion then drifts
slowly on one curve for hundreds of steps. A few steps determine the drift per step and its decay. A
leap in the direction of the drift replaces the remaining steps (projective integration: C. W. Gear
and I. G. Kevrekidis, SIAM J. Sci. Comput. 24, 2003). A leap ends at the latest at the predicted
limit of the drift. The state at the end of a walk is not the gait but the initial guess for its
refinement.
"""

from typing import NamedTuple

import numpy as np

from vrw_jax.base.outcomes import Outcome
from vrw_jax.studies.tolerance_contact import ContactWheelBatch, StepQuantities, replace_rows


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
            third_last_step = StepQuantities(*map(np.array, third_last_step))
            replace_rows(third_last_step, failed_walk_indices, retried_step)
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
