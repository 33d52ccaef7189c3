"""Find the attracting gaits of wheels by walks from fixed starts, refined by Newton's method."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import equinox as eqx
import jax
import numpy as np

from vrw_jax.base.outcomes import Outcome
from vrw_jax.gaits.gait_walks import (
    compute_fallback_walk_starts,
    compute_walk_starts,
    scale_section_states,
    walk_to_gaits,
)
from vrw_jax.lanes.batching import concatenate_tree_rows, select_tree_rows
from vrw_jax.lanes.settings import with_default_jax_settings
from vrw_jax.wheel.params import WheelParams

DUPLICATE_GAIT_DISTANCE = 1e-5
"""Distance between section states, in units of the wheel, below which two gaits are
treated as equal.
"""


def find_attracting_gaits(gait_finder: Any, parameter_values: Any) -> tuple[np.ndarray, Any]:
    """Find the attracting gaits of each wheel, in the order of increasing speed.

    Walks begin at WALK_STARTS. If a wheel has no gait from these starts, walks also begin at
    FALLBACK_WALK_STARTS. A wheel without an attracting gait has one cycle, whose outcome is a
    failure.

    Args:
        gait_finder: finder of gaits with unilateral contact.
        parameter_values: parameters of each wheel, shape (wheels, n_parameter_values), in the order
            of `AbstractWheel.collect_parameter_values`.

    Returns:
        Index of the wheel to which each gait belongs, shape (gaits,), and the cycles, whose leading
        axis is (gaits,).
    """
    parameter_values = np.asarray(parameter_values)
    gait_wheel_indices, gaits_from_first_starts = _find_gaits_from_starts(
        gait_finder, parameter_values, compute_walk_starts
    )
    is_gait_missing = np.asarray(gaits_from_first_starts.outcome) != Outcome.STEPPED
    wheels_without_gait = gait_wheel_indices[is_gait_missing]
    if not len(wheels_without_gait):
        return gait_wheel_indices, gaits_from_first_starts
    fallback_wheel_indices, fallback_gaits = _find_gaits_from_starts(
        gait_finder, parameter_values[wheels_without_gait], compute_fallback_walk_starts
    )
    is_fallback_found = np.asarray(fallback_gaits.outcome) == Outcome.STEPPED
    wheels_with_gait = wheels_without_gait[fallback_wheel_indices[is_fallback_found]]
    is_first_gait_kept = ~np.isin(gait_wheel_indices, wheels_with_gait)
    merged_gaits = concatenate_tree_rows(
        select_tree_rows(gaits_from_first_starts, is_first_gait_kept),
        select_tree_rows(fallback_gaits, is_fallback_found),
    )
    gait_wheel_indices = np.concatenate([gait_wheel_indices[is_first_gait_kept], wheels_with_gait])
    gait_sort_order = np.argsort(gait_wheel_indices, kind="stable")
    return gait_wheel_indices[gait_sort_order], jax.device_put(
        select_tree_rows(merged_gaits, gait_sort_order)
    )


def _find_gaits_from_starts(
    gait_finder: Any,
    parameter_values: np.ndarray,
    start_state_function: Callable[[WheelParams], np.ndarray],
) -> tuple[np.ndarray, Any]:
    """Find the attracting gaits that walks from given starts reach.

    Return the index of the wheel to which each gait belongs, and the gaits. The walks begin at the
    states that `start_state_function` returns. The gaits of a wheel are sorted by increasing speed.
    """
    n_wheels = len(parameter_values)
    with ThreadPoolExecutor(1) as compile_thread:
        compile_thread.submit(
            with_default_jax_settings(gait_finder.precompile_newton_programs), parameter_values[:1]
        )
        candidate_wheel_indices, walk_states, _ = walk_to_gaits(
            gait_finder, parameter_values, start_state_function
        )
    candidate_gaits = gait_finder.find_cycles_near(
        parameter_values[candidate_wheel_indices], walk_states
    )
    # NumPy is used, because JAX would compile each operation for every number of wheels.
    is_gait_attracting = np.abs(np.linalg.eigvals(candidate_gaits.monodromy_value)).max(-1) < 1.0
    is_gait_valid = (np.asarray(candidate_gaits.outcome) == Outcome.STEPPED) & is_gait_attracting
    sum_over_steps = lambda values_by_step: (
        np.asarray(values_by_step).reshape(len(candidate_wheel_indices), -1).sum(-1)
    )
    candidate_gait_speeds = sum_over_steps(candidate_gaits.step_length) / np.where(
        is_gait_valid, sum_over_steps(candidate_gaits.durations), 1.0
    )
    scaled_step_end_states = scale_section_states(
        gait_finder,
        parameter_values[candidate_wheel_indices],
        np.asarray(candidate_gaits.steps.section_state).swapaxes(0, 1),
    ).swapaxes(0, 1)
    # A gait that repeats after fewer steps is a gait of a shorter period.
    state_distances_to_last_step = np.abs(
        scaled_step_end_states[:, :-1] - scaled_step_end_states[:, -1:]
    ).max(-1)
    is_gait_valid &= ~(state_distances_to_last_step < DUPLICATE_GAIT_DISTANCE).any(1)
    selected_gait_indices = []
    for wheel_candidates in np.split(
        np.arange(len(candidate_wheel_indices)),
        find_slowest_gait_indices(candidate_wheel_indices, n_wheels)[1:],
    ):
        valid_candidates = wheel_candidates[is_gait_valid[wheel_candidates]]
        gaits_of_wheel: list[int] = []
        order_of_speeds = np.argsort(candidate_gait_speeds[valid_candidates], kind="stable")
        for candidate in valid_candidates[order_of_speeds]:
            distances_to_gaits = np.abs(
                scaled_step_end_states[gaits_of_wheel] - scaled_step_end_states[candidate, -1]
            ).max(-1)
            if not (distances_to_gaits < DUPLICATE_GAIT_DISTANCE).any():
                gaits_of_wheel.append(candidate)
        selected_gait_indices += gaits_of_wheel or [wheel_candidates[0]]
    # The cycle of a wheel without a valid candidate contains zeros and has a failure as outcome.
    selected_gaits = select_tree_rows(candidate_gaits, selected_gait_indices)
    is_gait_missing = ~is_gait_valid[selected_gait_indices]
    outcome_codes = np.where(
        is_gait_missing & (selected_gaits.outcome == Outcome.STEPPED),
        Outcome.NO_CYCLE_FOUND,
        selected_gaits.outcome,
    ).astype(np.int32)
    get_searched_wheels = lambda gaits: (gaits.model, gaits.params)
    searched_wheels = jax.tree.map(np.copy, get_searched_wheels(selected_gaits))
    for gait_array in jax.tree.leaves(selected_gaits):
        gait_array[is_gait_missing] = 0
    selected_gaits = eqx.tree_at(
        lambda gaits: (*get_searched_wheels(gaits), gaits.outcome),
        selected_gaits,
        (*searched_wheels, outcome_codes),
    )
    return candidate_wheel_indices[selected_gait_indices], jax.device_put(selected_gaits)


def find_slow_gaits(gait_finder: Any, parameter_values: Any) -> Any:
    """Find for each wheel the gait that a walk from a slow start reaches.

    If the walk reaches no gait, the slowest attracting gait is returned. The two gaits are equal
    for each of 1,200 random wheels.
    """
    parameter_values = np.asarray(parameter_values)
    slow_start_function = lambda params: compute_walk_starts(params)[:1]
    _, slow_gaits = _find_gaits_from_starts(gait_finder, parameter_values, slow_start_function)
    wheels_without_gait = np.flatnonzero(np.asarray(slow_gaits.outcome) != Outcome.STEPPED)
    if len(wheels_without_gait):
        attracting_gait_wheel_indices, attracting_gaits = find_attracting_gaits(
            gait_finder, parameter_values[wheels_without_gait]
        )
        gait_indices = np.arange(len(parameter_values))
        gait_indices[wheels_without_gait] = len(parameter_values) + find_slowest_gait_indices(
            attracting_gait_wheel_indices, len(wheels_without_gait)
        )
        slow_gaits = jax.device_put(
            select_tree_rows(concatenate_tree_rows(slow_gaits, attracting_gaits), gait_indices)
        )
    return slow_gaits


def find_slowest_gait_indices(gait_wheel_indices: np.ndarray, n_wheels: int) -> np.ndarray:
    """Return the index of the slowest gait of each wheel, shape (wheels,).

    - `gait_wheel_indices`: index of the wheel to which each gait belongs, in ascending order.
      The gaits of a wheel are sorted by increasing speed.
    """
    return np.searchsorted(gait_wheel_indices, np.arange(n_wheels))
