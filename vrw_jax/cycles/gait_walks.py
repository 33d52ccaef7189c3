"""Walks of many wheels from a fixed set of starts until they settle on gaits."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, NamedTuple

import jax
import numpy as np

from vrw_jax.batches import step_batch
from vrw_jax.contact import embed_section_states
from vrw_jax.numerics import StepOptions
from vrw_jax.wheel import PARAMETER_NAMES, Outcome, WheelParams, compute_wheel_units_of_rows


@dataclass(frozen=True)
class GaitWalkOptions:
    """Options of the walks toward gaits. Distances are those of section states, in the wheel's own
    units.
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


GAIT_WALK_OPTIONS = GaitWalkOptions()

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


def stack_section_units(model: Any, values: np.ndarray, n_legs: int) -> np.ndarray:
    """Return each wheel's own units of its section state, shape (wheels, section)."""
    return np.stack(model.section_units(compute_wheel_units_of_rows(values, n_legs), n_legs), -1)


def count_section_coordinates(finder: Any) -> int:
    """Return the number of continuous entries of a section state; the others are codes."""
    return int(finder.model.n_continuous(WheelParams(n_legs=finder.n_legs)))


class WalkEnds(NamedTuple):
    """Distinct ends of walks, in the order of the wheels. Each wheel has at least one end."""

    wheel_index: np.ndarray  # (ends,)
    section_states: np.ndarray  # (ends, section)
    period_defect: np.ndarray  # (ends,); see `measure_period_defect`


def walk_to_gaits(
    finder: Any,
    values: np.ndarray,
    compute_starts: Callable[[WheelParams], np.ndarray],
    options: GaitWalkOptions = GAIT_WALK_OPTIONS,
) -> WalkEnds:
    """Return the distinct ends of the walks of each wheel.

    Of walks that reach the same state, the one with the smallest period defect is returned. A walk
    that fails ends at the state of its last round, which may be near a repelling gait. If no walk
    of a wheel nearly repeats, the end of its first walk is returned.

    Args:
        finder: finder of gaits, whose model takes the steps.
        values: values of each wheel, (wheels, n_values); see `AbstractWheel.parameter_values`.
        compute_starts: function that returns section states of shape (starts, wheels, 3).
        options: options of the walks.
    """
    starts = compute_starts(_make_model_and_wheels(finder, values)[1])
    n_wheels, n_coordinates = len(values), count_section_coordinates(finder)
    wheel_index = np.tile(np.arange(n_wheels), len(starts))
    walk_values, states = values[wheel_index], np.concatenate(starts)
    if finder.model.batch_kernel == "legs":
        states = np.array(embed_section_states(walk_values.T, states, finder.n_legs))
    period_defect = np.full(len(wheel_index), np.inf)
    is_duplicate = np.zeros(len(wheel_index), bool)
    units = stack_section_units(finder.model, walk_values, finder.n_legs)
    scale_coordinates = lambda states: (states / units)[:, :n_coordinates]
    active_indices = np.arange(len(wheel_index))
    for n_steps in options.round_steps:
        end_states, outcome = _take_steps(
            finder, walk_values[active_indices], states[active_indices], n_steps, options
        )
        is_walking = outcome == Outcome.STEPPED
        active_indices = active_indices[is_walking]
        states[active_indices] = end_states[is_walking]
        period_defect[active_indices] = measure_period_defect(
            finder, walk_values[active_indices], states[active_indices], options
        )
        is_duplicate |= _find_duplicates(
            scale_coordinates(states), period_defect, n_wheels, options.settled_defect, options
        )
        is_unsettled = period_defect >= options.settled_defect
        active_indices = active_indices[(is_unsettled & ~is_duplicate)[active_indices]]
        if not len(active_indices):
            break
    is_duplicate = _find_duplicates(
        scale_coordinates(states), period_defect, n_wheels, options.start_defect, options
    )
    is_selected = ~is_duplicate & (period_defect < options.start_defect)
    # The first start is selected for a wheel without any usable walk.
    is_selected[np.setdiff1d(np.arange(n_wheels), wheel_index[is_selected])] = True
    selected_indices = np.flatnonzero(is_selected)
    selected_indices = selected_indices[np.argsort(wheel_index[selected_indices], kind="stable")]
    return WalkEnds(
        wheel_index[selected_indices], states[selected_indices], period_defect[selected_indices]
    )


def measure_period_defect(
    finder: Any,
    values: np.ndarray,
    section_states: np.ndarray,
    options: GaitWalkOptions = GAIT_WALK_OPTIONS,
) -> np.ndarray:
    """Return the largest change of each section state over one period, in the wheel's own units.

    The result has the shape (wheels,). It is infinite if a step fails.
    """
    end_states, outcome = _take_steps(finder, values, section_states, finder.period_n, options)
    units = stack_section_units(finder.model, values, finder.n_legs)
    distance = np.abs((end_states - section_states) / units)
    distance = distance[:, : count_section_coordinates(finder)].max(-1)
    return np.where(outcome == Outcome.STEPPED, distance, np.inf)


def _take_steps(
    finder: Any, values: np.ndarray, states: np.ndarray, n_steps: int, options: GaitWalkOptions
) -> tuple[np.ndarray, np.ndarray]:
    """Return the section states after `n_steps` steps of each wheel, and the outcomes."""
    model, params = _make_model_and_wheels(finder, values)
    step_options = StepOptions(
        solver="Tsit5", rtol=options.step_tolerance, atol=options.step_tolerance
    )
    # The implicit solver of the stiffest wheels would take minutes for a walk.
    walk = step_batch(params, states, n_steps, model=model, options=step_options, engine="lanes")
    return np.asarray(walk.section_state), np.asarray(walk.outcome)


def _make_model_and_wheels(finder: Any, values: np.ndarray) -> tuple[Any, WheelParams]:
    """Return the model and the wheels of these values, whose first axis is over wheels."""
    model, params = finder.model.from_values(tuple(jax.device_put(list(values.T))), finder.n_legs)
    return model, params


def _find_duplicates(
    scaled_states: np.ndarray,
    period_defect: np.ndarray,
    n_wheels: int,
    settled_defect: float,
    options: GaitWalkOptions,
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
