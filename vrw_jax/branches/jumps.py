"""Continue branches beyond jumps of the section state.

With unilateral contact, the section state jumps if two impacts change their order, because the
effects of two impacts do not commute. No continuation step leads to the gait beyond the jump,
however short the step is.
"""

from typing import Any

import jax
import numpy as np

from vrw_jax.branches.arclength import ContinuationResult, ContinuationStatus
from vrw_jax.lanes.batching import select_tree_rows

# Largest number of jumps in one direction of a branch.
MAX_JUMPS_PER_DIRECTION = 20
# Changes of the parameter, as fractions of its range, after which a gait beyond a jump is searched
# for. The values are chosen because two impacts with unilateral contact change their order within a
# fraction of 1e-4.
PARAMETER_CHANGE_FRACTIONS = (
    1e-9, 1e-7, 1e-5, 3e-5, 1e-4, 2e-4, 3e-4, 5e-4, 1e-3,
)  # fmt: skip


def continue_beyond_jumps(
    branch_continuation: Any,
    wheels: Any,
    results_by_direction: ContinuationResult,
) -> ContinuationResult:
    """Continue stalled branches beyond jumps, and return the points of all branches.

    The search for the gait beyond a jump starts from the last gait. It uses the smallest change of
    the parameter that leads to a similar gait.
    """
    branch_indices = np.arange(len(results_by_direction.n_points))
    lower_bound, upper_bound = branch_continuation.parameter_bounds
    wheel_indices, has_search_failed = branch_indices // 2, np.zeros(len(branch_indices), bool)
    for _ in range(MAX_JUMPS_PER_DIRECTION):
        n_points = np.asarray(results_by_direction.n_points)
        is_branch_stalled = (
            (results_by_direction.status == int(ContinuationStatus.STEP_SIZE_UNDERFLOW))
            & (n_points > 1)
            & ~has_search_failed
        )
        if not is_branch_stalled.any():
            break
        branch_end_points = select_tree_rows(
            results_by_direction.points, (branch_indices, np.maximum(n_points - 1, 0))
        )
        direction_signs = np.sign(branch_end_points.fraction_rate)
        branch_end_quantities = branch_continuation.make_quantity_table(
            branch_end_points, wheel_indices
        )
        for parameter_change_fraction in PARAMETER_CHANGE_FRACTIONS:
            parameter_values = branch_end_points.p + direction_signs * parameter_change_fraction * (
                upper_bound - lower_bound
            )
            is_branch_requested = (
                is_branch_stalled
                & (parameter_values > lower_bound)
                & (parameter_values < upper_bound)
            )
            if not is_branch_requested.any():
                continue
            new_branch_results = branch_continuation.continue_branches(
                wheels, branch_end_points.z, parameter_values, direction_signs, is_branch_requested
            )
            first_quantities_beyond_jump = branch_continuation.make_quantity_table(
                select_tree_rows(new_branch_results.points, (branch_indices, 0)), wheel_indices
            )
            is_gait_found = (
                is_branch_requested
                & (new_branch_results.n_points > 1)
                & branch_continuation.is_same_gait(
                    branch_end_quantities, first_quantities_beyond_jump
                )
            )
            results_by_direction = append_branch_results(
                results_by_direction, new_branch_results, is_gait_found
            )
            is_branch_stalled &= ~is_gait_found
        has_search_failed |= is_branch_stalled
    return results_by_direction


def append_branch_results(
    results_by_direction: ContinuationResult,
    new_branch_results: ContinuationResult,
    is_branch_extended: np.ndarray,
) -> ContinuationResult:
    """Append the points in `new_branch_results` to the branches, and return all results.

    - `is_branch_extended`: whether the points of each branch are appended.
    """
    if not is_branch_extended.any():
        return results_by_direction
    n_old_points, capacity = results_by_direction.n_points, results_by_direction.points.p.shape[1]
    n_points = n_old_points + np.where(is_branch_extended, new_branch_results.n_points, 0)
    n_buffer_points = max(int(np.max(n_points)), capacity)
    # In the joined buffers of a branch, the new points follow the whole buffer of the old points.
    positions, first_new_position = np.arange(n_buffer_points), n_old_points[:, None]
    source_positions = np.where(
        positions < first_new_position, positions, capacity + positions - first_new_position
    )
    n_joined_points = capacity + new_branch_results.points.p.shape[1]
    source_positions = np.minimum(source_positions, n_joined_points - 1)
    branch_indices = np.arange(len(n_points))[:, None]
    append_points = lambda points, new_points: np.concatenate([points, new_points], 1)[
        branch_indices, source_positions
    ]
    joined_results: Any = (
        jax.tree.map(append_points, results_by_direction.points, new_branch_results.points),
        n_points,
        np.where(is_branch_extended, new_branch_results.status, results_by_direction.status),
        results_by_direction.n_linearizations + new_branch_results.n_linearizations,
    )
    return ContinuationResult(*joined_results)


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
