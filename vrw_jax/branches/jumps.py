"""Continue branches beyond jumps of the section state.

With unilateral contact, the section state jumps if two impacts change their order, because the
effects of two impacts do not commute. No continuation step leads to the gait beyond the jump,
however short the step is.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from vrw_jax.branches.arclength import ContinuationPoint, ContinuationStatus, Track

# Largest number of jumps in one direction of a branch.
MAX_JUMPS_PER_DIRECTION = 20
# Changes of the parameter, as fractions of its range, after which a gait beyond a jump is searched
# for. The values are chosen because two impacts with unilateral contact change their order within a
# fraction of 1e-4.
PARAMETER_CHANGE_FRACTIONS = (
    1e-9, 1e-7, 1e-5, 3e-5, 1e-4, 2e-4, 3e-4, 5e-4, 1e-3,
)  # fmt: skip


def continue_beyond_jumps(
    continuation: Any, owners: np.ndarray, tracks: Sequence[Track]
) -> list[Track]:
    """Continue stalled branches beyond jumps, and return the tracks of all branches.

    The search for the gait beyond a jump starts from the last gait. It uses the smallest change of
    the parameter that leads to a similar gait.
    """
    tracks, has_search_failed = list(tracks), np.zeros(len(tracks), bool)
    lower_bound, upper_bound = continuation.parameter_bounds
    for _ in range(MAX_JUMPS_PER_DIRECTION):
        stalled = [
            i
            for i, track in enumerate(tracks)
            if track.status == ContinuationStatus.STEP_SIZE_UNDERFLOW
            and len(track.points) > 1
            and not has_search_failed[i]
        ]
        if not stalled:
            break
        has_search_failed[stalled] = True
        for change_fraction in PARAMETER_CHANGE_FRACTIONS:
            ends = {i: tracks[i].points[-1] for i in stalled if has_search_failed[i]}
            values = {
                i: end.p
                + np.sign(end.fraction_rate) * change_fraction * (upper_bound - lower_bound)
                for i, end in ends.items()
            }
            searched = [i for i, value in values.items() if lower_bound < value < upper_bound]
            if not searched:
                continue
            new_tracks = continuation.continue_branches(
                owners[searched],
                [ends[i].z for i in searched],
                [values[i] for i in searched],
                [np.sign(ends[i].fraction_rate) for i in searched],
            )
            found = [
                (i, track)
                for i, track in zip(searched, new_tracks, strict=True)
                if len(track.points) > 1
            ]
            if not found:
                continue
            indices = [i for i, _ in found]
            before, after = (
                continuation.make_table(
                    ContinuationPoint(*(np.stack(x) for x in zip(*points, strict=True))),
                    owners[indices],
                )
                for points in ([ends[i] for i in indices], [track.points[0] for _, track in found])
            )
            for (i, track), is_same in zip(
                found, continuation.is_same_gait(before, after), strict=True
            ):
                if is_same:
                    has_search_failed[i] = False
                    tracks[i] = track._replace(points=[*tracks[i].points, *track.points])
    return tracks


# Smallest ratio, at a jump, of the steepness of the chord between two points to that of both
# tangents. The value is chosen because continuation steps turn by at most 0.2 rad. The slope of a
# chord is then between those of the tangents to some tenths, even at a kink.
MIN_CHORD_STEEPNESS_FACTOR = 5.0


def find_state_jumps(
    section_states: np.ndarray,
    parameter_fractions: np.ndarray,
    fraction_rates: np.ndarray,
    point_pairs: list[tuple[int, int]],
) -> list[tuple[int, int]]:
    """Return the pairs of points between which the section state jumps.

    `parameter_fractions` contains the parameter at each point as a fraction of its range.
    `fraction_rates` contains the derivative of that fraction with respect to arc length.
    """

    def has_state_jump_between(left_index: int, right_index: int) -> bool:
        parameter_fraction_change = (
            parameter_fractions[right_index] - parameter_fractions[left_index]
        )
        chord_length = np.hypot(
            np.linalg.norm(section_states[right_index] - section_states[left_index]),
            parameter_fraction_change,
        )
        min_parameter_fraction_change = (
            min(abs(fraction_rates[left_index]), abs(fraction_rates[right_index])) * chord_length
        )
        # Across a fold the rates have opposite signs, and both parameters may be equal.
        has_same_direction = fraction_rates[left_index] * fraction_rates[right_index] > 0.0
        is_chord_steeper = (
            MIN_CHORD_STEEPNESS_FACTOR * abs(parameter_fraction_change)
            < min_parameter_fraction_change
        )
        return bool(has_same_direction and is_chord_steeper)

    return [point_pair for point_pair in point_pairs if has_state_jump_between(*point_pair)]
