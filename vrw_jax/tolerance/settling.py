"""Walks with unilateral contact until they settle, by loose steps with leaps between them.

On a fast wheel the states of the legs decay within a few steps, and the remaining motion drifts
slowly along one curve, for hundreds of steps. A few steps determine the drift and its decay. A leap
along the drift replaces the remaining steps (projective integration: C. W. Gear and I. G.
Kevrekidis, SIAM J. Sci. Comput. 24, 2003). A leap ends at the latest at the predicted limit of the
drift. The end of a walk is not a gait but the start of corrections by exact steps.
"""

from typing import NamedTuple

import numpy as np

from vrw_jax.tolerance.contact_steps import GroundBatch, StepQuantities
from vrw_jax.wheel import Outcome

WARMUP_STEPS, MAX_LEAPS, STEPS_PER_LEAP = 20, 10, 7
"""Number of steps of a walk before the first leap, largest number of leaps, and number of steps
after each. With five steps after a leap, three gaits in 118 are missed, among 451 wheels without a
gait of the paper's model."""
MAX_LEAP = 0.15
"""Longest leap, rad, rad/s, m, m/s. Pairs of gaits that are closer to each other can be passed
over."""
GIVE_UP_FACTOR, GIVE_UP_LEAPS_LEFT = 2.0, 3
"""A walk ends if its drift would fade beyond the first factor times the remaining leaps, and at
most the second number of leaps is left. Earlier, drifts may grow for a while and yet fade."""
REST_DRIFT = 5e-4
"""Drift per step, and distance to its predicted limit, below which a walk has settled."""
NOISE_DRIFT = 1e-5
"""Drift at the level of the steps' own error."""


class WalkEnd(NamedTuple):
    """Ends of walks."""

    is_settled: np.ndarray  # whether the walk has settled, probably near a gait
    section_states: np.ndarray  # (elements, 4 + 3 n)
    outcome: np.ndarray  # STEPPED, or the failure that ended the walk
    n_steps: np.ndarray


def walk_until_settled(
    ground: GroundBatch, indices: np.ndarray, section_states: np.ndarray
) -> WalkEnd:
    """Walk from section states until each walk settles or ends."""
    n_elements, n_numbers, loose_ground = (
        len(indices),
        section_states.shape[1] - ground.n_legs,
        ground.with_loose_steps(),
    )
    walk_end = WalkEnd(
        np.zeros(n_elements, bool),
        section_states.copy(),
        np.full(n_elements, int(Outcome.STEPPED)),
        np.zeros(n_elements, int),
    )
    active, start = np.arange(n_elements), section_states
    for round_index, n_steps in enumerate((WARMUP_STEPS, *MAX_LEAPS * (STEPS_PER_LEAP,))):
        if not len(active):
            break
        walk_end.n_steps[active] += n_steps
        own_indices, current_states = indices[active], walk_end.section_states[active]
        earlier_step = loose_ground.take_steps(own_indices, start, n_steps - 2)
        failed = np.flatnonzero(earlier_step.outcome != Outcome.STEPPED)
        if len(failed):  # after a leap, or at first due to the tolerance
            retry = (loose_ground if round_index else ground).take_steps(
                own_indices[failed], current_states[failed], n_steps - 2
            )
            earlier_step = StepQuantities(*map(_replace_rows, earlier_step, 3 * (failed,), retry))
        previous_step = loose_ground.take_steps(own_indices, earlier_step.section_states)
        current_step = loose_ground.take_steps(own_indices, previous_step.section_states)
        step_outcomes = np.stack(
            [earlier_step.outcome, previous_step.outcome, current_step.outcome]
        )
        is_stepping = np.all(step_outcomes == Outcome.STEPPED, axis=0)
        first_failure = np.argmax(step_outcomes != Outcome.STEPPED, axis=0)
        walk_end.outcome[active] = step_outcomes[first_failure, np.arange(len(active))]
        active = active[is_stepping]
        walk_end.section_states[active] = current_step.section_states[is_stepping]
        walk_end.is_settled[active], leap_vectors, fade_distance = _analyze_drift(
            earlier_step.section_states[is_stepping],
            previous_step.section_states[is_stepping],
            current_step.section_states[is_stepping],
            n_numbers,
        )
        n_leaps_left = MAX_LEAPS - round_index
        continues = ~walk_end.is_settled[active] & (
            (n_leaps_left > GIVE_UP_LEAPS_LEFT)
            | (fade_distance <= GIVE_UP_FACTOR * MAX_LEAP * n_leaps_left)
        )
        active, leap_vectors = (part[continues] for part in (active, leap_vectors))
        start = walk_end.section_states[active]
        has_leap = np.any(leap_vectors != 0.0, axis=1)
        start[has_leap, :n_numbers] += leap_vectors[has_leap]
        start[has_leap] = ground.complete_states(start[has_leap])
    return walk_end


def _replace_rows(
    values: np.ndarray, row_indices: np.ndarray, new_values: np.ndarray
) -> np.ndarray:
    values = np.array(values)
    values[row_indices] = new_values
    return values


def _analyze_drift(
    earlier: np.ndarray, previous: np.ndarray, current: np.ndarray, n_numbers: int
) -> tuple[np.ndarray, ...]:
    """Analyze the drift of three successive section states.

    Return whether they have settled, the leap from the last one, and the distance at which the
    drift would fade. Leap and distance are zero if the legs' codes change.
    """
    same_codes = np.all(
        (earlier[:, n_numbers:] == current[:, n_numbers:])
        & (previous[:, n_numbers:] == current[:, n_numbers:]),
        axis=1,
    )
    earlier_change, last_change = (
        (previous - earlier)[:, :n_numbers],
        (current - previous)[:, :n_numbers],
    )
    speed = np.abs(last_change).max(1)
    with np.errstate(all="ignore"):
        decay_rate = np.nan_to_num(
            np.sum(earlier_change * last_change, axis=1)
            / np.sum(earlier_change * earlier_change, axis=1)
        )
        n_steps_to_fade = np.where(
            decay_rate < 1.0, decay_rate / (1.0 - decay_rate), np.inf
        )  # number of steps
        fade_distance = np.where(speed < NOISE_DRIFT, 0.0, np.abs(n_steps_to_fade) * speed)
        n_leap_steps = np.where(speed > 0.0, np.minimum(n_steps_to_fade, MAX_LEAP / speed), 0.0)
    # A drift that changes sign at each step leads to a gait of two steps.
    is_settled = same_codes & (fade_distance < REST_DRIFT) & (speed < REST_DRIFT)
    has_leap = same_codes & ~is_settled & (decay_rate > 0.0)
    return (
        is_settled,
        np.where(has_leap, n_leap_steps, 0.0)[:, None] * last_change,
        np.where(same_codes, fade_distance, 0.0),
    )
