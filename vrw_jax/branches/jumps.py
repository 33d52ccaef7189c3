"""Branches whose section state jumps, as with unilateral contact if two impacts change their order.

The effects of two impacts do not commute. The gait beyond the change of their order therefore has
another section state. No step along the branch leads to it, however short the step is.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from vrw_jax.continuation import ContinuationResult, ContinuationStatus
from vrw_jax.numerics import take_rows


@dataclass(frozen=True)
class JumpOptions:
    """Options of the continuation beyond jumps of the section state.

    - `max_jumps`: largest number of jumps beyond which one direction of a branch is continued;
    - `parameter_changes`: changes of the parameter, as fractions of its range, after which a gait
      beyond a jump is searched for. They are chosen because two impacts change their order within a
      fraction of 1e-4 with unilateral contact;
    - `min_steepness_factor`: factor by which the chord between two points is steeper than both
      tangents at a jump. It is chosen because the slope of a chord is between those of the tangents
      to some tenths if a continuation step turns by at most 0.2 rad, also at a kink.
    """

    max_jumps: int = 20
    parameter_changes: tuple[float, ...] = (
        1e-9, 1e-7, 1e-5, 3e-5, 1e-4, 2e-4, 3e-4, 5e-4, 1e-3,
    )  # fmt: skip
    min_steepness_factor: float = 5.0


JUMP_OPTIONS = JumpOptions()
"""Options of the continuation beyond jumps, for all branches."""


def continue_beyond_jumps(
    continuation: Any,
    continue_all: Callable[..., Any],
    wheels: Any,
    results: ContinuationResult,
    options: JumpOptions = JUMP_OPTIONS,
) -> ContinuationResult:
    """Return the results with the points beyond jumps of the section state, at which the
    continuation stalled.

    The gait beyond a jump is searched for from the last gait, at the smallest change of the
    parameter that leads to a similar one. `continuation` is an `AbstractContinuation`, and
    `continue_all` continues its branches.
    """
    branch_indices, bounds = np.arange(len(results.n_points)), np.asarray(continuation.bounds)
    wheel_indices, has_failed = branch_indices // 2, np.zeros(len(branch_indices), bool)
    for _ in range(options.max_jumps):
        n_points, status = np.asarray(results.n_points), np.asarray(results.status)
        is_stalled = status == int(ContinuationStatus.STEP_SIZE_UNDERFLOW)
        is_stalled = is_stalled & (n_points > 1) & ~has_failed
        if not is_stalled.any():
            break
        end_points = take_rows(results.points, (branch_indices, np.maximum(n_points - 1, 0)))
        directions = np.sign(end_points.fraction_rate)
        end_table = continuation.make_table(end_points, wheel_indices)
        for parameter_change in options.parameter_changes:
            parameter_values = end_points.p + directions * parameter_change * (
                bounds[1] - bounds[0]
            )
            is_requested = (
                is_stalled & (parameter_values > bounds[0]) & (parameter_values < bounds[1])
            )
            if not is_requested.any():
                continue
            arguments = jax.device_put(
                (wheels, end_points.z, parameter_values, bounds, directions, is_requested)
            )
            new_results = jax.tree.map(np.asarray, continue_all(*arguments))
            first_points = take_rows(new_results.points, (branch_indices, 0))
            is_found = is_requested & (np.asarray(new_results.n_points) > 1)
            first_table = continuation.make_table(first_points, wheel_indices)
            is_found = is_found & continuation.is_same_gait(end_table, first_table)
            results = append_results(results, new_results, is_found)
            is_stalled = is_stalled & ~is_found
        has_failed = has_failed | is_stalled
    return results


def append_results(
    results: ContinuationResult, new_results: ContinuationResult, is_appended: np.ndarray
) -> ContinuationResult:
    """Return the results with the points of `new_results` appended to the selected branches."""
    if not is_appended.any():
        return results
    n_points = results.n_points + np.where(is_appended, new_results.n_points, 0)
    buffer_length = max(int(np.max(n_points)), results.points.p.shape[1])

    def append_points(points: np.ndarray, new_points: np.ndarray) -> np.ndarray:
        point_buffer = np.zeros((len(points), buffer_length, *points.shape[2:]), points.dtype)
        point_buffer[:, : points.shape[1]] = points
        for branch_index in np.flatnonzero(is_appended):
            point_buffer[branch_index, results.n_points[branch_index] : n_points[branch_index]] = (
                new_points[branch_index, : new_results.n_points[branch_index]]
            )
        return point_buffer

    points: Any = jax.tree.map(append_points, results.points, new_results.points)
    status: Any = np.where(is_appended, new_results.status, results.status)
    point_counts: Any = n_points
    n_linearizations = results.n_linearizations + new_results.n_linearizations
    return ContinuationResult(points, point_counts, status, n_linearizations)


def find_jumps(
    states: np.ndarray,
    fractions: np.ndarray,
    fraction_rates: np.ndarray,
    pairs: list[tuple[int, int]],
    options: JumpOptions = JUMP_OPTIONS,
) -> list[tuple[int, int]]:
    """Return the pairs of points between which the section state jumps.

    `fractions` are the parameter as a fraction of its range, and `fraction_rates` are the
    derivatives of these with respect to the arc length.
    """

    def has_jump(i: int, j: int) -> bool:
        change = fractions[j] - fractions[i]
        chord_length = np.hypot(np.linalg.norm(states[j] - states[i]), change)
        min_change = min(abs(fraction_rates[i]), abs(fraction_rates[j])) * chord_length
        # Across a fold the rates differ in sign, and the two ends may have the same parameter.
        has_one_direction = fraction_rates[i] * fraction_rates[j] > 0.0
        is_steeper = options.min_steepness_factor * abs(change) < min_change
        return bool(has_one_direction and is_steeper)

    return [pair for pair in pairs if has_jump(*pair)]
