"""Attracting gaits of a wheel, found by walks from a fixed set of starts and refined by Newton's
method.
"""

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import equinox as eqx
import jax
import numpy as np

from vrw_jax.contact import embed_section_states, walk_batch
from vrw_jax.numerics import StepOptions, concat_rows, take_rows
from vrw_jax.runtime import with_default_settings
from vrw_jax.wheel import (
    PARAMETER_NAMES,
    Outcome,
    WheelParams,
    compute_wheel_units_of_rows,
    wheel_from_parameters,
)


@dataclass(frozen=True)
class AttractingGaitOptions:
    """Options of the walks toward attracting gaits. Distances are those of section states, in
    the wheel's own units.
    """

    round_steps: tuple[int, ...] = (8, 12, 30, 50, 100)
    """Numbers of steps toward a gait, one for each round. After a round, settled walks stop and
    walks to the same gait are merged.
    """
    step_tolerance: float = 1e-8
    """Tolerance of the Tsit5 steps toward a gait, which is independent of the tolerance of the
    gait.
    """
    settled_defect: float = 1e-3
    """Largest distance between the state of a settled walk and its state one period earlier."""
    start_defect: float = 0.1
    """Largest such distance of an unsettled walk from which Newton's method starts."""
    merge_distance: float = 0.02
    """Distance up to which two walks are considered to reach the same gait."""
    duplicate_distance: float = 1e-5
    """Distance below which two gaits are considered equal."""


ATTRACTING_GAIT_OPTIONS = AttractingGaitOptions()

WALK_STARTS = ((1.0, 0.45), (1.0, 0.7), (1.0, 1.0), (0.5, 1.0), (0.0, 1.0))
"""Starts of walks. The first number is the static contraction of Leg 1 at touchdown, as a
fraction. The second is the rate of the hub as a fraction of the rigid rolling gait's rate. Of 4,800
random wheels with 5 to 16 legs, 1,240 walk from one of these starts or from a grid of 78. From
these starts alone, 1,175 walk (ranges: experiments/gaits/off_the_box.py).
"""

FALLBACK_STARTS = (
    (0.002, 0.4), (0.002, 0.3), (0.002, 0.5), (0.5, 1.1), (0.2, 0.4), (0.2, 1.1), (0.2, 0.8),
    (0.35, 1.0), (0.35, 1.1), (0.43, 1.6), (0.4, 1.35), (0.46, 1.6), (0.43, 1.35),
)  # fmt: skip
"""Starts of walks that are tried if none of WALK_STARTS leads to a gait. The first number is Leg
1's angle to the slope's normal at touchdown, as a fraction of the angle between legs. The second
number is the rate, as in WALK_STARTS. The first nine starts reach the other 65 wheels. With many
legs, gaits roll from double support into double support, with an angle near 0. The last four are
chosen because some gaits of few legs are only reached from large angles and high rates. Of 442
wheels with 5 to 7 legs that walk from one of these starts or from a grid of 30, they reach the last
18.
"""


def compute_walk_starts(params: WheelParams) -> np.ndarray:
    """Return the states of WALK_STARTS for each wheel, section states of shape (starts, wheels,
    3).
    """
    p, sin, cos = _params_as_numpy(params), math.sin(params.leg_angle), math.cos(params.leg_angle)
    weight = (p.hub_mass + params.n_legs * p.leg_mass) * p.gravity * np.cos(p.slope)
    static_length_ratio = (p.natural_length - weight / p.stiffness) / p.locked_length
    leg_lengths = [
        np.clip(1.0 + contraction_share * (static_length_ratio - 1.0), cos + 0.02, 1.0)
        for contraction_share, _ in WALK_STARTS
    ]
    thetas = [np.arctan((length - cos) / sin) for length in leg_lengths]
    return _make_section_states(params, thetas, [rate_share for _, rate_share in WALK_STARTS])


def compute_fallback_starts(params: WheelParams) -> np.ndarray:
    """Return the states of FALLBACK_STARTS for each wheel, section states of shape (starts,
    wheels, 3).
    """
    thetas = [
        np.full(np.shape(params.slope), angle_share * params.leg_angle)
        for angle_share, _ in FALLBACK_STARTS
    ]
    return _make_section_states(params, thetas, [rate_share for _, rate_share in FALLBACK_STARTS])


def _params_as_numpy(params: WheelParams) -> Any:
    """Return the parameters as NumPy arrays, because JAX would compile each operation on them."""
    return SimpleNamespace(**{name: np.asarray(getattr(params, name)) for name in PARAMETER_NAMES})


def _make_section_states(
    params: WheelParams, thetas: list[np.ndarray], rate_shares: list[float]
) -> np.ndarray:
    """Return section states with these angles, rad, and with rates as fractions of the rigid
    rolling gait's rate.

    The shape is (starts, wheels, 3).
    """
    p, alpha = _params_as_numpy(params), params.leg_angle
    rigid_leg_rate = np.sqrt(
        4.0 * p.gravity / p.locked_length * np.sin(0.5 * alpha) * np.sin(p.slope)
    )
    rolling_rate, leg_rate = (
        rigid_leg_rate / np.sin(alpha),
        -0.1 * np.sqrt(p.gravity * p.locked_length) / 3.0,
    )
    angles_and_shares = zip(thetas, rate_shares, strict=True)
    return np.stack(
        [
            np.stack([theta, rate_share * rolling_rate, leg_rate], -1)
            for theta, rate_share in angles_and_shares
        ]
    )


def _walk_and_measure_defect(
    finder: Any,
    value_columns: np.ndarray,
    start_states: np.ndarray,
    n_steps: int,
    step_tolerance: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the states after walks of `n_steps`, whether each walk continues, and the defect of
    one more period.

    The period defect is the largest change of the state over the next period, in the wheel's own
    units. It is infinite if a walk ended early.
    """
    loose_options = StepOptions(solver="Tsit5", rtol=step_tolerance, atol=step_tolerance)
    step_arguments = finder.model, loose_options, finder.n_legs
    states, _, outcome, *_ = walk_batch(value_columns, start_states, n_steps, *step_arguments)
    next_states, _, next_outcome, *_ = walk_batch(
        value_columns, states, finder.period_n, *step_arguments
    )
    is_walking = outcome == Outcome.STEPPED
    units = stack_section_units(finder.model, value_columns.T, finder.n_legs)
    distance = np.abs((next_states - states) / units)
    distance = distance[:, : _count_section_coordinates(finder)].max(-1)
    return (
        states,
        is_walking,
        np.where(is_walking & (next_outcome == Outcome.STEPPED), distance, np.inf),
    )


def find_attracting_gaits(
    finder: Any, values: Any, options: AttractingGaitOptions = ATTRACTING_GAIT_OPTIONS
) -> tuple[np.ndarray, Any]:
    """Return the attracting gaits of each wheel, slowest first.

    Walks begin at WALK_STARTS. If none of them leads to a gait, walks also begin at
    FALLBACK_STARTS. A wheel without an attracting gait gets one entry whose outcome is a failure.

    Args:
        finder: finder of gaits with unilateral contact.
        values: values of each wheel, (wheels, n_values); see `AbstractWheel.parameter_values`.
        options: options of the walks and of the comparison of gaits.

    Returns:
        Index of the wheel of each gait, (gaits,), and a cycle with that leading axis.
    """
    values = np.asarray(values)
    wheel_index, gaits = _find_gaits_from_starts(finder, values, compute_walk_starts, options)
    is_missing = np.asarray(gaits.outcome) != Outcome.STEPPED
    missing_wheels = wheel_index[is_missing]
    if not len(missing_wheels):
        return wheel_index, gaits
    fallback_index, fallback_gaits = _find_gaits_from_starts(
        finder, values[missing_wheels], compute_fallback_starts, options
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
    options: AttractingGaitOptions,
) -> tuple[np.ndarray, Any]:
    """Return the attracting gaits that walks from these starts reach, slowest first, and the
    wheel of each.
    """
    n_wheels = len(values)
    wheel_index, walk_states = _walk_to_distinct_states(finder, values, compute_starts, options)
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
    coordinates = (states / units[:, None])[:, :, : _count_section_coordinates(finder)]
    # A gait that repeats after fewer steps has a shorter period.
    step_distances = np.abs(coordinates[:, :-1] - coordinates[:, -1:]).max(-1)
    is_valid &= ~(step_distances < options.duplicate_distance).any(1)
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
                < options.duplicate_distance
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
    _, gaits = _find_gaits_from_starts(finder, values, compute_slow_start, ATTRACTING_GAIT_OPTIONS)
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


def stack_section_units(model: Any, values: np.ndarray, n_legs: int) -> np.ndarray:
    """Return each wheel's own units of its section state, shape (wheels, section)."""
    return np.stack(model.section_units(compute_wheel_units_of_rows(values, n_legs), n_legs), -1)


def _count_section_coordinates(finder: Any) -> int:
    """Return the number of continuous entries of a section state; the others are codes."""
    return int(finder.model.n_continuous(WheelParams(n_legs=finder.n_legs)))


def _walk_to_distinct_states(
    finder: Any,
    values: np.ndarray,
    compute_starts: Callable[[WheelParams], np.ndarray],
    options: AttractingGaitOptions,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the index of a wheel and the section state of each distinct end of a walk.

    The states are in the order of the wheels, at least one for each. Of walks that reach the same
    state, the one with the smallest period defect is returned.
    """
    parameter_arrays = jax.device_put(list(values.T[: len(PARAMETER_NAMES)]))
    starts = compute_starts(wheel_from_parameters(tuple(parameter_arrays), finder.n_legs))
    n_wheels, n_coordinates = len(values), _count_section_coordinates(finder)
    wheel_index = np.tile(np.arange(len(values)), len(starts))
    value_columns = values.T[:, wheel_index]
    start_states = embed_section_states(value_columns, np.concatenate(starts), finder.n_legs)
    walk_states, period_defect = np.array(start_states), np.full(len(wheel_index), np.inf)
    active_indices = np.arange(len(wheel_index))
    is_walking, is_duplicate = np.ones(len(wheel_index), bool), np.zeros(len(wheel_index), bool)
    units = stack_section_units(finder.model, value_columns.T, finder.n_legs)
    scale_coordinates = lambda walk_states: (walk_states / units)[:, :n_coordinates]
    with ThreadPoolExecutor(1) as compile_thread:
        compile_thread.submit(
            with_default_settings(finder.precompile_newton), values[:1], start_states[:1]
        )
        for n_steps in options.round_steps:
            walk_result = _walk_and_measure_defect(
                finder,
                value_columns[:, active_indices],
                walk_states[active_indices],
                n_steps,
                options.step_tolerance,
            )
            (
                walk_states[active_indices],
                is_walking[active_indices],
                period_defect[active_indices],
            ) = walk_result
            is_duplicate |= _find_duplicates(
                scale_coordinates(walk_states),
                period_defect,
                n_wheels,
                options.settled_defect,
                options,
            )
            is_unsettled = period_defect >= options.settled_defect
            active_indices = np.flatnonzero(is_walking & ~is_duplicate & is_unsettled)
            if not len(active_indices):
                break
    is_duplicate = _find_duplicates(
        scale_coordinates(walk_states), period_defect, n_wheels, options.start_defect, options
    )
    is_selected = ~is_duplicate & (period_defect < options.start_defect)
    # The first start is selected for a wheel without any usable walk.
    is_selected[np.setdiff1d(np.arange(n_wheels), wheel_index[is_selected])] = True
    selected_indices = np.flatnonzero(is_selected)
    selected_indices = selected_indices[np.argsort(wheel_index[selected_indices], kind="stable")]
    return wheel_index[selected_indices], np.where(
        is_walking[selected_indices, None],
        walk_states[selected_indices],
        start_states[selected_indices],
    )


def _find_duplicates(
    scaled_states: np.ndarray,
    period_defect: np.ndarray,
    n_wheels: int,
    settled_defect: float,
    options: AttractingGaitOptions,
) -> np.ndarray:
    """Return which walks reach the same state as another walk of the same wheel with a smaller
    defect.

    Two states are the same if their distance is within `merge_distance`. If the other walk has
    settled to within `settled_defect`, the limit is three times the walk's own defect if that is
    larger. The wheels are the last axis of all arrays, except that coordinates follow in the
    states. The starts are the axis before the wheels.
    """
    scaled_states, period_defect = (
        scaled_states.reshape(-1, n_wheels, scaled_states.shape[-1]),
        period_defect.reshape(-1, n_wheels),
    )
    start_index = np.arange(len(scaled_states))[:, None]
    is_duplicate = np.zeros(period_defect.shape, bool)
    for other_start in range(len(scaled_states)):
        is_better = (period_defect[other_start] < period_defect) | (
            (period_defect[other_start] == period_defect) & (other_start < start_index)
        )
        distance = np.abs(scaled_states - scaled_states[other_start]).max(-1)
        is_near = distance <= np.where(
            period_defect[other_start] < settled_defect,
            np.maximum(options.merge_distance, 3.0 * period_defect),
            options.merge_distance,
        )
        is_duplicate |= is_better & is_near & (period_defect < options.start_defect)
    return is_duplicate.ravel()
