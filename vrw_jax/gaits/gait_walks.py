"""Simulate walks of many wheels from fixed starts until they settle on gaits."""

import math
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from vrw_jax.base.options import StepOptions
from vrw_jax.base.outcomes import Outcome
from vrw_jax.models.contact_walks import embed_section_states
from vrw_jax.models.step_batch import step_batch
from vrw_jax.wheel.params import WheelParams, compute_wheel_units_of_rows

WALK_STARTS = ((1.0, 0.45), (1.0, 0.7), (1.0, 1.0), (0.5, 1.0), (0.0, 1.0))
"""Starts of walks, each described by a contraction and a rate.

The first number is the static contraction of Leg 1 at touchdown, as a fraction. The second number
is the rate of the hub, as a fraction of the rate in the rigid rolling gait. A test used 4,800
random wheels with 5 to 16 legs. Of these wheels, 1,240 reach a gait from one of these starts or
from a grid of 78 starts. These starts alone suffice for 1,175 wheels (ranges:
experiments/gaits/off_the_box.py).
"""

FALLBACK_WALK_STARTS = (
    (0.002, 0.4), (0.002, 0.3), (0.002, 0.5), (0.5, 1.1), (0.2, 0.4), (0.2, 1.1), (0.2, 0.8),
    (0.35, 1.0), (0.35, 1.1), (0.43, 1.6), (0.4, 1.35), (0.46, 1.6), (0.43, 1.35),
)  # fmt: skip
"""Starts of walks for wheels that reach no gait from WALK_STARTS, each described by an angle and a
rate.

The first number is Leg 1's angle to the slope's normal at touchdown, as a fraction of the angle
between legs. The second number is the rate, as in WALK_STARTS. The first nine starts reach gaits of
65 wheels for which WALK_STARTS reach none. With many legs, double support can follow directly on
double support, with an angle near 0. The last four starts are chosen because some gaits with few
legs are reached only from large angles and high rates. A test used 442 wheels with 5 to 7 legs.
Each of them reaches a gait from one of these starts or from a grid of 30 starts. For 18 of these
wheels only the last four starts reach a gait.
"""


def compute_walk_starts(params: WheelParams) -> np.ndarray:
    """Return the section states that WALK_STARTS describe for each wheel, shape
    (starts, wheels, 3).
    """
    # With JAX arrays, each operation would be compiled for every number of wheels.
    wheels = jax.tree.map(np.asarray, params)
    leg_angle_sine = math.sin(wheels.leg_angle)
    leg_angle_cosine = math.cos(wheels.leg_angle)
    weight_normal_to_slope = (
        (wheels.hub_mass + wheels.n_legs * wheels.leg_mass) * wheels.gravity * np.cos(wheels.slope)
    )
    static_length_ratio = (
        wheels.natural_length - weight_normal_to_slope / wheels.stiffness
    ) / wheels.locked_length
    contraction_shares, rate_shares = np.array(WALK_STARTS).T[..., None]
    leg_lengths = np.clip(
        1.0 + contraction_shares * (static_length_ratio - 1.0), leg_angle_cosine + 0.02, 1.0
    )
    touchdown_angles = np.arctan((leg_lengths - leg_angle_cosine) / leg_angle_sine)
    return _make_section_states(wheels, touchdown_angles, rate_shares)


def compute_fallback_walk_starts(params: WheelParams) -> np.ndarray:
    """Return the section states that FALLBACK_WALK_STARTS describe for each wheel.

    The shape is (starts, wheels, 3).
    """
    wheels = jax.tree.map(np.asarray, params)
    angle_shares, rate_shares = np.array(FALLBACK_WALK_STARTS).T[..., None]
    return _make_section_states(wheels, angle_shares * wheels.leg_angle, rate_shares)


def compute_all_walk_starts(params: WheelParams) -> np.ndarray:
    """Return the section states of WALK_STARTS and FALLBACK_WALK_STARTS, in this order."""
    return np.concatenate([compute_walk_starts(params), compute_fallback_walk_starts(params)])


def can_walk_from_fast_starts(gait_finder: Any, parameter_values: np.ndarray) -> np.ndarray:
    """Return for each wheel whether one of three walks from fast starts makes eight steps.

    Wheels whose root has another order of events are worth more walks only in this case. Of 59 such
    wheels with 8 legs to whose gaits walks led, 57 make these steps. Of 327 such wheels in the
    paper's ranges, which have no gait, none does.
    """
    starts = compute_all_walk_starts(_split_parameter_values(gait_finder, parameter_values)[1])
    walk_outcomes = _simulate_wheel_walks(
        gait_finder,
        np.tile(parameter_values, (len(FAST_START_INDICES), 1)),
        np.concatenate(starts[list(FAST_START_INDICES)]),
        N_WALK_STEPS_BY_ROUND[0],
    )[1]
    return (walk_outcomes == Outcome.STEPPED).reshape(-1, len(parameter_values)).any(0)


FAST_START_INDICES = (2, 14, 17)
"""Indices in the result of `compute_all_walk_starts` that `can_walk_from_fast_starts` uses."""


def _make_section_states(
    wheels: WheelParams, touchdown_angles: np.ndarray, rolling_rate_shares: np.ndarray
) -> np.ndarray:
    """Build section states from touchdown angles (rad) and rates, shape (starts, wheels, 3).

    - `rolling_rate_shares`: rate of the hub as a fraction of its rate in the rigid rolling gait,
      for each start.
    """
    rigid_leg_rate = np.sqrt(
        4.0
        * wheels.gravity
        / wheels.locked_length
        * np.sin(0.5 * wheels.leg_angle)
        * np.sin(np.maximum(wheels.slope, 0.0))  # Without descent, no rolling gait exists.
    )
    rolling_rate = rigid_leg_rate / np.sin(wheels.leg_angle)
    leg_rate = -0.1 * np.sqrt(wheels.gravity * wheels.locked_length) / 3.0
    return np.stack(
        np.broadcast_arrays(touchdown_angles, rolling_rate_shares * rolling_rate, leg_rate), -1
    )


def stack_section_units(model: Any, parameter_values: np.ndarray, n_legs: int) -> np.ndarray:
    """Return the units of the section state for each wheel, shape (wheels, section)."""
    return np.stack(
        model.collect_section_units(compute_wheel_units_of_rows(parameter_values, n_legs), n_legs),
        -1,
    )


def scale_section_states(
    gait_finder: Any, parameter_values: np.ndarray, section_states: np.ndarray
) -> np.ndarray:
    """Return the continuous components of the section state of each wheel, in units of the wheel.

    The remaining components are discrete codes. The last two axes of `section_states` are
    (wheels, components).
    """
    section_units = stack_section_units(gait_finder.model, parameter_values, gait_finder.n_legs)
    n_coordinates = gait_finder.model.count_continuous_section_entries(
        WheelParams(n_legs=gait_finder.n_legs)
    )
    return (section_states / section_units)[..., :n_coordinates]


# Number of gait steps in each round. After a round, settled walks stop, and walks to the same gait
# are merged.
N_WALK_STEPS_BY_ROUND = (8, 12, 30, 50, 100)
# Largest distance between two states of a settled walk that are one period apart, in units of the
# wheel.
MAX_SETTLED_DEFECT = 1e-3
# Largest period defect of an unsettled walk from whose end Newton's method starts. The period
# defect is the distance between two states that are one period apart, in units of the wheel.
MAX_NEWTON_START_DEFECT = 0.1


def walk_to_gaits(
    gait_finder: Any,
    parameter_values: np.ndarray,
    start_state_function: Callable[[WheelParams], np.ndarray],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Simulate walks of each wheel, and return the distinct states at their ends.

    The result contains the index of the wheel, the section state and the period defect (see
    `measure_period_defects`) of each end, sorted by wheel, with at least one end per wheel. If
    several walks reach the same state, only the walk with the smallest period defect is returned.
    For a walk that fails, the returned state is that of its last round, which may be near a
    repelling gait. If no walk of a wheel nearly repeats, the end of its first walk is returned.

    Args:
        gait_finder: finder of gaits, whose model computes the gait steps.
        parameter_values: parameters of each wheel, shape (wheels, n_parameter_values), in the order
            of `AbstractWheel.collect_parameter_values`.
        start_state_function: function that maps wheels to section states, shape (starts, wheels,
            3).
    """
    start_section_states = start_state_function(
        _split_parameter_values(gait_finder, parameter_values)[1]
    )
    n_wheels = len(parameter_values)
    walk_wheel_indices = np.tile(np.arange(n_wheels), len(start_section_states))
    parameter_values_by_walk = parameter_values[walk_wheel_indices]
    section_states = np.concatenate(start_section_states)
    if gait_finder.model.batch_kernel == "legs":
        section_states = np.array(
            embed_section_states(parameter_values_by_walk.T, section_states, gait_finder.n_legs)
        )
    period_defects = np.full(len(walk_wheel_indices), np.inf)
    is_walk_duplicate = np.zeros(len(walk_wheel_indices), bool)
    active_walk_indices = np.arange(len(walk_wheel_indices))
    find_duplicates = lambda max_settled_defect: _find_duplicate_walks(
        scale_section_states(gait_finder, parameter_values_by_walk, section_states),
        period_defects,
        n_wheels,
        max_settled_defect,
    )
    for n_steps in N_WALK_STEPS_BY_ROUND:
        end_states, walk_outcomes = _simulate_wheel_walks(
            gait_finder,
            parameter_values_by_walk[active_walk_indices],
            section_states[active_walk_indices],
            n_steps,
        )
        is_walking = walk_outcomes == Outcome.STEPPED
        active_walk_indices = active_walk_indices[is_walking]
        section_states[active_walk_indices] = end_states[is_walking]
        period_defects[active_walk_indices] = measure_period_defects(
            gait_finder,
            parameter_values_by_walk[active_walk_indices],
            section_states[active_walk_indices],
        )
        is_walk_duplicate |= find_duplicates(MAX_SETTLED_DEFECT)
        has_not_settled = period_defects >= MAX_SETTLED_DEFECT
        active_walk_indices = active_walk_indices[
            (has_not_settled & ~is_walk_duplicate)[active_walk_indices]
        ]
        if not len(active_walk_indices):
            break
    is_walk_duplicate = find_duplicates(MAX_NEWTON_START_DEFECT)
    is_near_gait = period_defects < MAX_NEWTON_START_DEFECT
    is_walk_selected = ~is_walk_duplicate & is_near_gait
    # If a wheel has no usable walk, its first start is selected.
    is_walk_selected[np.setdiff1d(np.arange(n_wheels), walk_wheel_indices[is_walk_selected])] = True
    selected_walk_indices = np.flatnonzero(is_walk_selected)
    selected_walk_indices = selected_walk_indices[
        np.argsort(walk_wheel_indices[selected_walk_indices], kind="stable")
    ]
    return (
        walk_wheel_indices[selected_walk_indices],
        section_states[selected_walk_indices],
        period_defects[selected_walk_indices],
    )


def measure_period_defects(
    gait_finder: Any,
    parameter_values: np.ndarray,
    section_states: np.ndarray,
) -> np.ndarray:
    """Return the largest change of each section state over one period, shape (wheels,).

    Changes are in units of the wheel. The result is infinite if a gait step fails.
    """
    end_states, period_outcomes = _simulate_wheel_walks(
        gait_finder, parameter_values, section_states, gait_finder.period_n
    )
    period_defects = np.abs(
        scale_section_states(gait_finder, parameter_values, end_states - section_states)
    ).max(-1)
    return np.where(period_outcomes == Outcome.STEPPED, period_defects, np.inf)


# Tolerance of the Tsit5 solver in walks, which is independent of the tolerance of the gait.
WALK_STEP_TOLERANCE = 1e-8


def _simulate_wheel_walks(
    gait_finder: Any,
    parameter_values: np.ndarray,
    section_states: np.ndarray,
    n_steps: int,
) -> tuple[np.ndarray, np.ndarray]:
    model, params = _split_parameter_values(gait_finder, parameter_values)
    step_options = StepOptions(
        solver="Tsit5",
        rtol=WALK_STEP_TOLERANCE,
        atol=WALK_STEP_TOLERANCE,
    )
    # For the stiffest wheels, the implicit solver would take minutes per walk.
    walk_result = step_batch(
        params, section_states, n_steps, model=model, options=step_options, engine="lanes"
    )
    return np.asarray(walk_result.section_state), np.asarray(walk_result.outcome)


def _split_parameter_values(
    gait_finder: Any, parameter_values: np.ndarray
) -> tuple[Any, WheelParams]:
    """Return the model and the wheels that `parameter_values` of shape (wheels,
    n_parameter_values) describe.
    """
    return gait_finder.model.from_parameter_values(
        tuple(jax.device_put(list(parameter_values.T))), gait_finder.n_legs
    )


# Largest distance between the ends of two walks that are treated as walks to the same gait, in
# units of the wheel.
WALK_MERGE_DISTANCE = 0.02


def _find_duplicate_walks(
    scaled_walk_states: np.ndarray,
    period_defects: np.ndarray,
    n_wheels: int,
    max_settled_defect: float,
) -> np.ndarray:
    """Return whether each walk is a duplicate of another walk of the same wheel.

    A walk is a duplicate if the other walk reaches the same state with a smaller period defect. Two
    states are the same if their distance is within `walk_merge_distance`. If the period defect of
    the other walk is below `max_settled_defect`, a distance of three times the first walk's period
    defect is also allowed. The axes of the arguments are starts, wheels and, for states,
    coordinates.
    """
    scaled_walk_states = scaled_walk_states.reshape(-1, n_wheels, scaled_walk_states.shape[-1])
    period_defects = period_defects.reshape(-1, n_wheels)
    is_walk_duplicate = np.zeros(period_defects.shape, bool)
    for start_index, (other_states, other_defects) in enumerate(
        zip(scaled_walk_states, period_defects, strict=True)
    ):
        is_later_start = np.arange(len(period_defects))[:, None] > start_index
        has_smaller_defect = (other_defects < period_defects) | (
            (other_defects == period_defects) & is_later_start
        )
        merge_distances = np.where(
            other_defects < max_settled_defect,
            np.maximum(WALK_MERGE_DISTANCE, 3.0 * period_defects),
            WALK_MERGE_DISTANCE,
        )
        is_end_state_same = np.abs(scaled_walk_states - other_states).max(-1) <= merge_distances
        is_walk_duplicate |= has_smaller_defect & is_end_state_same
    is_near_gait = period_defects < MAX_NEWTON_START_DEFECT
    return (is_walk_duplicate & is_near_gait).ravel()
