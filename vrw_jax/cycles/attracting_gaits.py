"""Attracting gaits of a wheel, found by walks from a fixed set of starts and refined by Newton's
method.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import equinox as eqx
import jax
import numpy as np

from vrw_jax.cycles.gait_walks import (
    compute_fallback_starts,
    compute_walk_starts,
    count_section_coordinates,
    stack_section_units,
    walk_to_gaits,
)
from vrw_jax.numerics import concat_rows, take_rows
from vrw_jax.runtime import with_default_settings
from vrw_jax.wheel import Outcome, WheelParams

DUPLICATE_DISTANCE = 1e-5
"""Distance of section states, in the wheel's own units, below which two gaits are considered equal.
"""


def find_attracting_gaits(finder: Any, values: Any) -> tuple[np.ndarray, Any]:
    """Return the attracting gaits of each wheel, slowest first.

    Walks begin at WALK_STARTS. If none of them leads to a gait, walks also begin at
    FALLBACK_STARTS. A wheel without an attracting gait gets one entry whose outcome is a failure.

    Args:
        finder: finder of gaits with unilateral contact.
        values: values of each wheel, (wheels, n_values); see `AbstractWheel.parameter_values`.

    Returns:
        Index of the wheel of each gait, (gaits,), and a cycle with that leading axis.
    """
    values = np.asarray(values)
    wheel_index, gaits = _find_gaits_from_starts(finder, values, compute_walk_starts)
    is_missing = np.asarray(gaits.outcome) != Outcome.STEPPED
    missing_wheels = wheel_index[is_missing]
    if not len(missing_wheels):
        return wheel_index, gaits
    fallback_index, fallback_gaits = _find_gaits_from_starts(
        finder, values[missing_wheels], compute_fallback_starts
    )
    is_found = np.asarray(fallback_gaits.outcome) == Outcome.STEPPED
    found_wheels = missing_wheels[fallback_index[is_found]]
    is_unchanged = ~np.isin(wheel_index, found_wheels)
    all_gaits = concat_rows(take_rows(gaits, is_unchanged), take_rows(fallback_gaits, is_found))
    wheel_index = np.concatenate([wheel_index[is_unchanged], found_wheels])
    wheel_order = np.argsort(wheel_index, kind="stable")
    return wheel_index[wheel_order], jax.device_put(take_rows(all_gaits, wheel_order))


def _find_gaits_from_starts(
    finder: Any,
    values: np.ndarray,
    compute_starts: Callable[[WheelParams], np.ndarray],
) -> tuple[np.ndarray, Any]:
    """Return the attracting gaits that walks from these starts reach, slowest first, and the
    wheel of each.
    """
    n_wheels = len(values)
    with ThreadPoolExecutor(1) as compile_thread:
        compile_thread.submit(with_default_settings(finder.precompile_newton), values[:1])
        wheel_index, walk_states, _ = walk_to_gaits(finder, values, compute_starts)
    candidates = finder.find_cycles_near(values[wheel_index], walk_states)
    # Numpy is used because JAX compiles each operation for every number of wheels.
    is_attracting = np.abs(np.linalg.eigvals(candidates.monodromy_value)).max(-1) < 1.0
    is_valid = (np.asarray(candidates.outcome) == Outcome.STEPPED) & is_attracting
    states = np.asarray(candidates.steps.section_state)  # section states of every step
    sum_over_steps = lambda walk_states: (
        np.asarray(walk_states).reshape(len(wheel_index), -1).sum(-1)
    )
    speed = sum_over_steps(candidates.step_length) / np.where(
        is_valid, sum_over_steps(candidates.durations), 1.0
    )
    units = stack_section_units(finder.model, np.asarray(values)[wheel_index], finder.n_legs)
    coordinates = (states / units[:, None])[:, :, : count_section_coordinates(finder)]
    # A gait that repeats after fewer steps has a shorter period.
    step_distances = np.abs(coordinates[:, :-1] - coordinates[:, -1:]).max(-1)
    is_valid &= ~(step_distances < DUPLICATE_DISTANCE).any(1)
    selected: list[int] = []
    for candidate_indices in np.split(
        np.arange(len(wheel_index)), find_slowest_indices(wheel_index, n_wheels)[1:]
    ):
        n_before = len(selected)
        for candidate_index in sorted(
            candidate_indices[is_valid[candidate_indices]],
            key=lambda candidate_index: speed[candidate_index],
        ):
            is_duplicate = (
                np.abs(coordinates[selected_index] - coordinates[candidate_index, -1]).max(-1)
                < DUPLICATE_DISTANCE
                for selected_index in selected[n_before:]
            )
            if not any(is_same_step.any() for is_same_step in is_duplicate):
                selected.append(int(candidate_index))
        selected += [] if len(selected) > n_before else [int(candidate_indices[0])]
    return wheel_index[selected], _mark_missing_gaits(
        ~is_valid[selected], take_rows(candidates, selected)
    )


def find_slow_gaits(finder: Any, values: Any) -> Any:
    """Return for each wheel the gait that a walk from a slow start reaches, else its slowest
    attracting gait.

    For 1,200 random wheels, the result is the slowest attracting gait of each.
    """
    values = np.asarray(values)
    compute_slow_start = lambda params: compute_walk_starts(params)[:1]
    _, gaits = _find_gaits_from_starts(finder, values, compute_slow_start)
    missing_wheels = np.flatnonzero(np.asarray(gaits.outcome) != Outcome.STEPPED)
    if len(missing_wheels):
        wheel_index, other_gaits = find_attracting_gaits(finder, values[missing_wheels])
        indices = np.arange(len(values))
        indices[missing_wheels] = len(values) + find_slowest_indices(
            wheel_index, len(missing_wheels)
        )
        gaits = jax.device_put(take_rows(concat_rows(gaits, other_gaits), indices))
    return gaits


def find_slowest_indices(wheel_index: np.ndarray, n_wheels: int) -> np.ndarray:
    """Return the index of the first gait of each wheel, which is its slowest, shape (wheels,)."""
    return np.searchsorted(wheel_index, np.arange(n_wheels))


def _mark_missing_gaits(is_missing: np.ndarray, cycle: Any) -> Any:
    """Return the cycles with those of `is_missing` marked as not found, and their numbers set to
    zero.

    Such a cycle has a shorter period, does not attract, or does not exist.
    """
    broadcast_mask = lambda leaf: is_missing.reshape(-1, *[1] * (leaf.ndim - 1))
    masked_cycle = jax.tree.map(
        lambda leaf: np.where(broadcast_mask(leaf), np.zeros_like(leaf), leaf), cycle
    )
    outcome_code = np.where(cycle.outcome == Outcome.STEPPED, Outcome.NO_CYCLE_FOUND, cycle.outcome)
    outcome_code = np.where(is_missing, outcome_code, cycle.outcome).astype(np.int32)
    masked_cycle = eqx.tree_at(lambda cycle: cycle.outcome, masked_cycle, outcome_code)
    return jax.device_put(masked_cycle)
