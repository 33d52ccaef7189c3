"""Attracting gaits of a wheel, found by walks from a stated set of starts and refined by Newton's
method."""

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
    """Walks toward attracting gaits. Distances are those of section states, in the wheel's
    own units."""

    round_steps: tuple[int, ...] = (8, 12, 30, 50, 100)
    """Numbers of steps toward a gait. After each round, settled walks stop and walks to the same
    gait are merged."""
    step_tolerance: float = 1e-8
    """Tolerance of the Tsit5 steps toward a gait, independent of the tolerance of the gait."""
    settled_defect: float = 1e-3
    """Largest distance of a settled walk's state from its state one period earlier."""
    start_defect: float = 0.1
    """The same distance for an unsettled walk that is used as a start of Newton's method."""
    merge_distance: float = 0.02
    """Distance up to which two walks are taken to reach the same gait."""
    duplicate_distance: float = 1e-5
    """Distance below which two gaits are the same one."""


ATTRACTING_GAIT_OPTIONS = AttractingGaitOptions()

WALK_STARTS = ((1.0, 0.45), (1.0, 0.7), (1.0, 1.0), (0.5, 1.0), (0.0, 1.0))
"""Starts of walks: the share of Leg 1's static contraction at touchdown, and the rate of the hub as
a share of the rigid rolling gait's rate. Of 4,800 random wheels with 5 to 16 legs, 1,240 walk from
one of these starts or from a grid of 78. From these starts alone, 1,175 walk (ranges:
experiments/gaits/off_the_box.py)."""

FALLBACK_STARTS = (
    (0.002, 0.4), (0.002, 0.3), (0.002, 0.5), (0.5, 1.1), (0.2, 0.4), (0.2, 1.1), (0.2, 0.8),
    (0.35, 1.0), (0.35, 1.1), (0.43, 1.6), (0.4, 1.35), (0.46, 1.6), (0.43, 1.35),
)  # fmt: skip
"""Starts of walks that are tried if none of WALK_STARTS leads to a gait. The first number is Leg
1's angle to the slope's normal at touchdown as a share of the angle between legs. The second number
is the rate, as in WALK_STARTS. The first nine starts reach the other 65 wheels. With many legs,
gaits roll from double support into double support, with an angle near 0. The last four are chosen
because some gaits of few legs are only reached from large angles and high rates: of 442 wheels with
5 to 7 legs that walk from one of these starts or from a grid of 30, they reach the last 18."""


def compute_walk_starts(params: WheelParams) -> np.ndarray:
    """Return WALK_STARTS of each wheel, section states of shape (start, wheel, 3)."""
    p, sin, cos = _params_as_numpy(params), math.sin(params.leg_angle), math.cos(params.leg_angle)
    weight = (p.hub_mass + params.n_legs * p.leg_mass) * p.gravity * np.cos(p.slope)
    static = (p.natural_length - weight / p.stiffness) / p.locked_length
    lengths = [np.clip(1.0 + c * (static - 1.0), cos + 0.02, 1.0) for c, _ in WALK_STARTS]
    thetas = [np.arctan((length - cos) / sin) for length in lengths]
    return _section_states(params, thetas, [share for _, share in WALK_STARTS])


def compute_fallback_starts(params: WheelParams) -> np.ndarray:
    """Return FALLBACK_STARTS of each wheel, section states of shape (start, wheel, 3)."""
    thetas = [np.full(np.shape(params.slope), a * params.leg_angle) for a, _ in FALLBACK_STARTS]
    return _section_states(params, thetas, [share for _, share in FALLBACK_STARTS])


def _params_as_numpy(params: WheelParams) -> Any:
    """Return the parameters as numpy arrays, because JAX would compile each operation on them."""
    return SimpleNamespace(**{name: np.asarray(getattr(params, name)) for name in PARAMETER_NAMES})


def _section_states(
    params: WheelParams, thetas: list[np.ndarray], rate_shares: list[float]
) -> np.ndarray:
    """Return section states with these angles and with rates as shares of the rigid rolling gait's
    rate."""
    p, alpha = _params_as_numpy(params), params.leg_angle
    stiff = np.sqrt(4.0 * p.gravity / p.locked_length * np.sin(0.5 * alpha) * np.sin(p.slope))
    rolling, fall = stiff / np.sin(alpha), -0.1 * np.sqrt(p.gravity * p.locked_length) / 3.0
    pairs = zip(thetas, rate_shares, strict=True)
    return np.stack([np.stack([theta, share * rolling, fall], -1) for theta, share in pairs])


def _walk_and_measure_defect(
    finder: Any, columns: np.ndarray, x: np.ndarray, n_steps: int, step_tolerance: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Walk `n_steps` from each state and measure the defect of one more period.

    Returns the states after the walk, whether each walk continues, and the period defect: the
    largest change of the state over the next period. It is infinite if a walk ended early.
    """
    loose_options = StepOptions(solver="Tsit5", rtol=step_tolerance, atol=step_tolerance)
    settings = finder.model, loose_options, finder.n_legs
    states, _, outcome, *_ = walk_batch(columns, x, n_steps, *settings)
    next_states, _, next_outcome, *_ = walk_batch(columns, states, finder.period_n, *settings)
    is_walking = outcome == Outcome.STEPPED
    units = stack_section_units(finder.model, columns.T, finder.n_legs)
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

    Walks begin at WALK_STARTS; of a wheel for which none of them leads to a gait, also at
    FALLBACK_STARTS. A wheel without an attracting gait gets one entry whose outcome is a failure.

    Args:
        finder: finds gaits with unilateral contact.
        values: of each wheel, (wheels, n_values); see `AbstractWheel.parameter_values`.
        options: options of the walks and of the comparison of gaits.

    Returns:
        Index of the wheel of each gait, (gaits,), and a cycle with that leading axis.
    """
    values = np.asarray(values)
    wheel_index, gaits = _find_gaits_from_starts(finder, values, compute_walk_starts, options)
    is_missing = np.asarray(gaits.outcome) != Outcome.STEPPED
    missing = wheel_index[is_missing]
    if not len(missing):
        return wheel_index, gaits
    fallback_index, fallback_gaits = _find_gaits_from_starts(
        finder, values[missing], compute_fallback_starts, options
    )
    is_found = np.asarray(fallback_gaits.outcome) == Outcome.STEPPED
    found_wheels = missing[fallback_index[is_found]]
    is_kept = ~np.isin(wheel_index, found_wheels)
    all_gaits = concat_rows(take_rows(gaits, is_kept), take_rows(fallback_gaits, is_found))
    wheel_index = np.concatenate([wheel_index[is_kept], found_wheels])
    order = np.argsort(wheel_index, kind="stable")
    return wheel_index[order], jax.device_put(take_rows(all_gaits, order))


def _find_gaits_from_starts(
    finder: Any,
    values: np.ndarray,
    compute_starts: Callable[[WheelParams], np.ndarray],
    options: AttractingGaitOptions,
) -> tuple[np.ndarray, Any]:
    """Return the attracting gaits that walks from these starts reach, slowest first."""
    n_wheels = len(values)
    wheel_index, x = _walk_to_distinct_states(finder, values, compute_starts, options)
    candidates = finder.find_cycles_near(values[wheel_index], x)
    # Numpy is used because JAX compiles each operation for every number of wheels.
    is_attracting = np.abs(np.linalg.eigvals(candidates.monodromy_value)).max(-1) < 1.0
    is_valid = (np.asarray(candidates.outcome) == Outcome.STEPPED) & is_attracting
    states = np.asarray(candidates.steps.section_state)  # of every step
    sum_over_steps = lambda x: np.asarray(x).reshape(len(wheel_index), -1).sum(-1)
    speed = sum_over_steps(candidates.step_length) / np.where(
        is_valid, sum_over_steps(candidates.durations), 1.0
    )
    units = stack_section_units(finder.model, np.asarray(values)[wheel_index], finder.n_legs)
    coordinates = (states / units[:, None])[:, :, : _count_section_coordinates(finder)]
    # A gait that repeats earlier has a shorter period.
    step_distances = np.abs(coordinates[:, :-1] - coordinates[:, -1:]).max(-1)
    is_valid &= ~(step_distances < options.duplicate_distance).any(1)
    selected: list[int] = []
    for candidate_indices in np.split(
        np.arange(len(wheel_index)), find_slowest_indices(wheel_index, n_wheels)[1:]
    ):
        n_before = len(selected)
        for i in sorted(candidate_indices[is_valid[candidate_indices]], key=lambda i: speed[i]):
            is_duplicate = (
                np.abs(coordinates[j] - coordinates[i, -1]).max(-1) < options.duplicate_distance
                for j in selected[n_before:]
            )
            if not any(same.any() for same in is_duplicate):
                selected.append(int(i))
        selected += [] if len(selected) > n_before else [int(candidate_indices[0])]
    return wheel_index[selected], _mark_missing_gaits(
        ~is_valid[selected], take_rows(candidates, selected)
    )


def find_slow_gaits(finder: Any, values: Any) -> Any:
    """Return for each wheel the gait that a slow start reaches, else the slowest gait that any
    start reaches.

    For 1,200 random wheels it is the slowest attracting gait of each.
    """
    values = np.asarray(values)
    slow_start = lambda params: compute_walk_starts(params)[:1]
    _, gaits = _find_gaits_from_starts(finder, values, slow_start, ATTRACTING_GAIT_OPTIONS)
    missing = np.flatnonzero(np.asarray(gaits.outcome) != Outcome.STEPPED)
    if len(missing):
        wheel_index, other_gaits = find_attracting_gaits(finder, values[missing])
        indices = np.arange(len(values))
        indices[missing] = len(values) + find_slowest_indices(wheel_index, len(missing))
        gaits = jax.device_put(take_rows(concat_rows(gaits, other_gaits), indices))
    return gaits


def find_slowest_indices(wheel_index: np.ndarray, n_wheels: int) -> np.ndarray:
    """Return the index of the first, slowest gait of each wheel."""
    return np.searchsorted(wheel_index, np.arange(n_wheels))


def _mark_missing_gaits(is_missing: np.ndarray, cycle: Any) -> Any:
    """Return the cycles with those of `is_missing` marked as not found.

    Such a cycle has a shorter period, does not attract, or does not exist.
    """
    broadcast_mask = lambda leaf: is_missing.reshape(-1, *[1] * (leaf.ndim - 1))
    masked_cycle = jax.tree.map(
        lambda leaf: np.where(broadcast_mask(leaf), np.zeros_like(leaf), leaf), cycle
    )
    code = np.where(cycle.outcome == Outcome.STEPPED, Outcome.NO_CYCLE_FOUND, cycle.outcome)
    code = np.where(is_missing, code, cycle.outcome).astype(np.int32)
    masked_cycle = eqx.tree_at(lambda cycle: cycle.outcome, masked_cycle, code)
    return jax.device_put(masked_cycle)


def stack_section_units(model: Any, values: np.ndarray, n_legs: int) -> np.ndarray:
    """Return each wheel's own units of its section state, (wheels, section)."""
    return np.stack(model.section_units(compute_wheel_units_of_rows(values, n_legs), n_legs), -1)


def _count_section_coordinates(finder: Any) -> int:
    """Return the number of continuous entries of a section state."""
    return int(finder.model.n_continuous(WheelParams(n_legs=finder.n_legs)))


def _walk_to_distinct_states(
    finder: Any,
    values: np.ndarray,
    compute_starts: Callable[[WheelParams], np.ndarray],
    options: AttractingGaitOptions,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the index of a wheel and the section state of each distinct end of a walk.

    The states are in the order of the wheels, and each wheel has at least one. Of equivalent walks,
    the one with the smallest period defect is returned.
    """
    rows = jax.device_put(list(values.T[: len(PARAMETER_NAMES)]))
    starts = compute_starts(wheel_from_parameters(tuple(rows), finder.n_legs))
    n_wheels, n_coordinates = len(values), _count_section_coordinates(finder)
    wheel_index = np.tile(np.arange(len(values)), len(starts))
    columns = values.T[:, wheel_index]
    start_states = embed_section_states(columns, np.concatenate(starts), finder.n_legs)
    x, period_defect = np.array(start_states), np.full(len(wheel_index), np.inf)
    active = np.arange(len(wheel_index))
    is_walking, is_duplicate = np.ones(len(wheel_index), bool), np.zeros(len(wheel_index), bool)
    units = stack_section_units(finder.model, columns.T, finder.n_legs)
    scaled = lambda x: (x / units)[:, :n_coordinates]
    with ThreadPoolExecutor(1) as pool:
        pool.submit(with_default_settings(finder.precompile_newton), values[:1], start_states[:1])
        for n_steps in options.round_steps:
            walk_result = _walk_and_measure_defect(
                finder, columns[:, active], x[active], n_steps, options.step_tolerance
            )
            x[active], is_walking[active], period_defect[active] = walk_result
            is_duplicate |= _find_duplicates(
                scaled(x), period_defect, n_wheels, options.settled_defect, options
            )
            is_unsettled = period_defect >= options.settled_defect
            active = np.flatnonzero(is_walking & ~is_duplicate & is_unsettled)
            if not len(active):
                break
    is_duplicate = _find_duplicates(
        scaled(x), period_defect, n_wheels, options.start_defect, options
    )
    is_selected = ~is_duplicate & (period_defect < options.start_defect)
    # The first start is selected for a wheel without any usable walk.
    is_selected[np.setdiff1d(np.arange(n_wheels), wheel_index[is_selected])] = True
    selected = np.flatnonzero(is_selected)
    selected = selected[np.argsort(wheel_index[selected], kind="stable")]
    return wheel_index[selected], np.where(
        is_walking[selected, None], x[selected], start_states[selected]
    )


def _find_duplicates(
    x: np.ndarray,
    period_defect: np.ndarray,
    n_wheels: int,
    settled_defect: float,
    options: AttractingGaitOptions,
) -> np.ndarray:
    """Return which walks reach the same state as another walk of the same wheel with a smaller
    defect.

    Two states are the same if they are within `merge_distance`. If the other walk has settled, to
    within `settled_defect`, the limit is three times the walk's own defect if that is larger. The
    wheels are the last axis of all
    arrays (in `x`, the last but one, before the coordinates), and the starts are the axis before
    it.
    """
    x, period_defect = x.reshape(-1, n_wheels, x.shape[-1]), period_defect.reshape(-1, n_wheels)
    start_index = np.arange(len(x))[:, None]
    is_duplicate = np.zeros(period_defect.shape, bool)
    for other in range(len(x)):
        is_better = (period_defect[other] < period_defect) | (
            (period_defect[other] == period_defect) & (other < start_index)
        )
        distance = np.abs(x - x[other]).max(-1)
        is_near = distance <= np.where(
            period_defect[other] < settled_defect,
            np.maximum(options.merge_distance, 3.0 * period_defect),
            options.merge_distance,
        )
        is_duplicate |= is_better & is_near & (period_defect < options.start_defect)
    return is_duplicate.ravel()
