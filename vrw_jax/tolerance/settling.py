"""Walks with unilateral contact until they settle, by loose steps with extrapolation between them.

On a fast wheel the states of the legs decay within a few steps, and the remaining motion drifts
slowly along one curve, for hundreds of steps. A few steps determine the drift and its decay. A leap
along the drift replaces the remaining steps (projective integration: C. W. Gear and I. G.
Kevrekidis, SIAM J. Sci. Comput. 24, 2003). A leap ends at the latest at the predicted limit of the
drift. The end of a walk is not a gait but the start of corrections by exact steps.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from vrw_jax.tolerance.contact_steps import GroundBatch, StepQuantities
from vrw_jax.wheel import Outcome


@dataclass(frozen=True)
class LeapOptions:
    """Options of walks with leaps; states are in rad, rad/s, m, m/s.

    - `n_warmup_steps`: number of steps before the first leap;
    - `max_leaps`: largest number of leaps;
    - `steps_per_leap`: number of steps after a leap. It is chosen because five steps miss three of
      118 gaits, among 451 wheels without a gait of the paper's model;
    - `max_leap`: longest leap, chosen because longer ones pass over pairs of close gaits;
    - `give_up_factor`, `give_up_leaps_left`: a walk ends if its drift would fade beyond this factor
      times the remaining leaps, and at most so many leaps are left. They are chosen because a drift
      may first grow for a while and then fade;
    - `settled_drift`: drift per step, and distance to its predicted limit, below which a walk has
      settled;
    - `noise_drift`: drift at the level of the steps' own error.
    """

    n_warmup_steps: int = 20
    max_leaps: int = 10
    steps_per_leap: int = 7
    max_leap: float = 0.15
    give_up_factor: float = 2.0
    give_up_leaps_left: int = 3
    settled_drift: float = 5e-4
    noise_drift: float = 1e-5


LEAP_OPTIONS = LeapOptions()
"""Options of all walks with leaps."""


class WalkEnd(NamedTuple):
    """Ends of walks, for each element."""

    is_settled: np.ndarray  # whether the walk has settled, probably near a gait
    section_states: np.ndarray  # (elements, 4 + 3 n)
    outcome: np.ndarray  # STEPPED, or the failure that ended the walk
    n_steps: np.ndarray


def walk_until_settled(
    ground: GroundBatch,
    indices: np.ndarray,
    section_states: np.ndarray,
    options: LeapOptions = LEAP_OPTIONS,
) -> WalkEnd:
    """Walk from section states until each walk settles or ends, and return the ends."""
    n_elements, n_numbers = len(indices), section_states.shape[1] - ground.n_legs
    loose_ground = ground.with_loose_steps()
    walk_end = WalkEnd(
        np.zeros(n_elements, bool),
        section_states.copy(),
        np.full(n_elements, int(Outcome.STEPPED)),
        np.zeros(n_elements, int),
    )
    active_positions, start_states = np.arange(n_elements), section_states
    steps_of_rounds = (options.n_warmup_steps, *options.max_leaps * (options.steps_per_leap,))
    for round_index, n_steps in enumerate(steps_of_rounds):
        if not len(active_positions):
            break
        walk_end.n_steps[active_positions] += n_steps
        active_indices = indices[active_positions]
        earlier_step = loose_ground.take_steps(active_indices, start_states, n_steps - 2)
        failed_positions = np.flatnonzero(earlier_step.outcome != Outcome.STEPPED)
        if len(failed_positions):
            # A leap failed, or the tolerance of the first steps is too loose.
            retried_step = (loose_ground if round_index else ground).take_steps(
                active_indices[failed_positions],
                walk_end.section_states[active_positions[failed_positions]],
                n_steps - 2,
            )
            earlier_step = StepQuantities(*map(np.array, earlier_step))
            for step_array, retried_part in zip(earlier_step, retried_step, strict=True):
                step_array[failed_positions] = retried_part
        previous_step = loose_ground.take_steps(active_indices, earlier_step.section_states)
        current_step = loose_ground.take_steps(active_indices, previous_step.section_states)
        step_outcomes = np.stack(
            [earlier_step.outcome, previous_step.outcome, current_step.outcome]
        )
        is_stepping = np.all(step_outcomes == Outcome.STEPPED, axis=0)
        first_failure = np.argmax(step_outcomes != Outcome.STEPPED, axis=0)
        walk_end.outcome[active_positions] = step_outcomes[
            first_failure, np.arange(len(active_positions))
        ]
        active_positions = active_positions[is_stepping]
        walk_end.section_states[active_positions] = current_step.section_states[is_stepping]
        walk_end.is_settled[active_positions], leap_vectors, fade_distance = _analyze_drift(
            earlier_step.section_states[is_stepping],
            previous_step.section_states[is_stepping],
            current_step.section_states[is_stepping],
            n_numbers,
            options,
        )
        n_leaps_left = options.max_leaps - round_index
        is_continued = ~walk_end.is_settled[active_positions] & (
            (n_leaps_left > options.give_up_leaps_left)
            | (fade_distance <= options.give_up_factor * options.max_leap * n_leaps_left)
        )
        active_positions, leap_vectors = (
            step_array[is_continued] for step_array in (active_positions, leap_vectors)
        )
        start_states = walk_end.section_states[active_positions]
        # A step places loaded feet on the slope, so that the end of a leap is a valid start.
        start_states[:, :n_numbers] += leap_vectors
    return walk_end


def _analyze_drift(
    earlier_states: np.ndarray,
    previous_states: np.ndarray,
    current_states: np.ndarray,
    n_numbers: int,
    options: LeapOptions,
) -> tuple[np.ndarray, ...]:
    """Return whether walks have settled, the leap, and the distance at which the drift fades.

    The arguments are three successive section states of each walk. The leap starts from the last
    one. Leap and distance are zero if the legs' codes change.
    """
    same_codes = np.all(
        (earlier_states[:, n_numbers:] == current_states[:, n_numbers:])
        & (previous_states[:, n_numbers:] == current_states[:, n_numbers:]),
        axis=1,
    )
    earlier_change = (previous_states - earlier_states)[:, :n_numbers]
    last_change = (current_states - previous_states)[:, :n_numbers]
    drift_per_step = np.abs(last_change).max(1)
    with np.errstate(all="ignore"):
        decay_rate = np.nan_to_num(
            np.sum(earlier_change * last_change, axis=1)
            / np.sum(earlier_change * earlier_change, axis=1)
        )
        n_steps_to_fade = np.where(decay_rate < 1.0, decay_rate / (1.0 - decay_rate), np.inf)
        fade_distance = np.where(
            drift_per_step < options.noise_drift, 0.0, np.abs(n_steps_to_fade) * drift_per_step
        )
        n_leap_steps = np.where(
            drift_per_step > 0.0,
            np.minimum(n_steps_to_fade, options.max_leap / drift_per_step),
            0.0,
        )
    # A drift that changes sign at each step leads to a gait of two steps.
    is_settled = (
        same_codes
        & (fade_distance < options.settled_drift)
        & (drift_per_step < options.settled_drift)
    )
    has_leap = same_codes & ~is_settled & (decay_rate > 0.0)
    return (
        is_settled,
        np.where(has_leap, n_leap_steps, 0.0)[:, None] * last_change,
        np.where(same_codes, fade_distance, 0.0),
    )
