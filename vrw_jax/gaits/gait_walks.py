"""Walks of many wheels from many starts, until they settle on gaits or orbits.

From the ends of walks, attracting gaits are found. Walks are tested after each round of several
steps. Only walks that have neither settled nor failed continue, so that long transients cost
little.
"""

import itertools
import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from vrw_jax.base.checks import check_choice, check_real
from vrw_jax.base.options import StepOptions
from vrw_jax.base.results import Outcome
from vrw_jax.base.walker import is_own_walker
from vrw_jax.lanes.batching import (
    concatenate_tree_rows,
    select_rows_on_device,
    select_tree_rows,
)
from vrw_jax.lanes.environment import with_default_jax_settings
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
    total_mass = wheels.hub_mass + wheels.n_legs * wheels.leg_mass
    normal_weight = total_mass * wheels.gravity * np.cos(wheels.slope)
    static_length = wheels.natural_length - normal_weight / wheels.stiffness
    static_length_ratio = static_length / wheels.locked_length
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


StartFunction = Callable[[WheelParams], np.ndarray]
"""Function that maps wheels to section states, shape (starts, wheels, 3)."""


def walk_to_gaits(
    gait_finder: Any, parameter_values: np.ndarray, compute_starts: StartFunction
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
        compute_starts: function that returns the starts of the walks.
    """
    starts = compute_starts(_split_parameter_values(gait_finder, parameter_values)[1])
    n_wheels = len(parameter_values)
    wheels = np.tile(np.arange(n_wheels), len(starts))
    values = parameter_values[wheels]
    states = gait_finder.complete_section_states(values, np.concatenate(starts))
    defects, is_duplicate = np.full(len(wheels), np.inf), np.zeros(len(wheels), bool)
    active = np.arange(len(wheels))
    find_duplicates = lambda max_settled_defect: _find_duplicate_walks(
        scale_section_states(gait_finder, values, states), defects, n_wheels, max_settled_defect
    )
    for n_steps in N_WALK_STEPS_BY_ROUND:
        ends, outcomes = _simulate_wheel_walks(gait_finder, values[active], states[active], n_steps)
        is_walking = outcomes == Outcome.STEPPED
        active = active[is_walking]
        states[active] = ends[is_walking]
        defects[active] = measure_period_defects(gait_finder, values[active], states[active])
        is_duplicate |= find_duplicates(MAX_SETTLED_DEFECT)
        active = active[((defects >= MAX_SETTLED_DEFECT) & ~is_duplicate)[active]]
        if not len(active):
            break
    is_selected = ~find_duplicates(MAX_NEWTON_START_DEFECT) & (defects < MAX_NEWTON_START_DEFECT)
    # If a wheel has no usable walk, its first start is selected.
    is_selected[np.setdiff1d(np.arange(n_wheels), wheels[is_selected])] = True
    selected = np.flatnonzero(is_selected)
    selected = selected[np.argsort(wheels[selected], kind="stable")]
    return wheels[selected], states[selected], defects[selected]


def measure_period_defects(
    gait_finder: Any, parameter_values: np.ndarray, section_states: np.ndarray
) -> np.ndarray:
    """Return the largest change of each section state over one period, shape (wheels,).

    Changes are in units of the wheel. The result is infinite if a gait step fails.
    """
    ends, outcomes = _simulate_wheel_walks(
        gait_finder, parameter_values, section_states, gait_finder.period_n
    )
    changes = scale_section_states(gait_finder, parameter_values, ends - section_states)
    return np.where(outcomes == Outcome.STEPPED, np.abs(changes).max(-1), np.inf)


# Tolerance of the Tsit5 solver in walks, which is independent of the tolerance of the gait.
WALK_STEP_TOLERANCE = 1e-8


def _simulate_wheel_walks(
    gait_finder: Any, parameter_values: np.ndarray, section_states: np.ndarray, n_steps: int
) -> tuple[np.ndarray, np.ndarray]:
    model, params = _split_parameter_values(gait_finder, parameter_values)
    tolerance = WALK_STEP_TOLERANCE
    # For the stiffest wheels, the implicit solver would take minutes per walk.
    options = StepOptions(solver="Tsit5", rtol=tolerance, atol=tolerance)
    walk = step_batch(params, section_states, n_steps, model=model, options=options, engine="lanes")
    return np.asarray(walk.section_state), np.asarray(walk.outcome)


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
    scaled_states: np.ndarray, defects: np.ndarray, n_wheels: int, max_settled_defect: float
) -> np.ndarray:
    """Return whether each walk is a duplicate of another walk of the same wheel.

    A walk is a duplicate if the other walk reaches the same state with a smaller period defect. Two
    states are the same if their distance is within `WALK_MERGE_DISTANCE`. If the period defect of
    the other walk is below `max_settled_defect`, a distance of three times the first walk's period
    defect is also allowed. The axes of the arguments are starts and wheels in one, and then
    coordinates.
    """
    states = scaled_states.reshape(-1, n_wheels, scaled_states.shape[-1])
    defects = defects.reshape(-1, n_wheels)
    is_duplicate = np.zeros(defects.shape, bool)
    for index, (other_states, other_defects) in enumerate(zip(states, defects, strict=True)):
        is_later = np.arange(len(defects))[:, None] > index
        has_smaller_defect = (other_defects < defects) | ((other_defects == defects) & is_later)
        max_distances = np.where(
            other_defects < max_settled_defect,
            np.maximum(WALK_MERGE_DISTANCE, 3.0 * defects),
            WALK_MERGE_DISTANCE,
        )
        is_same = np.abs(states - other_states).max(-1) <= max_distances
        is_duplicate |= has_smaller_defect & is_same
    return (is_duplicate & (defects < MAX_NEWTON_START_DEFECT)).ravel()


DUPLICATE_GAIT_DISTANCE = 1e-5
"""Distance between section states, in units of the wheel, below which two gaits are
treated as equal.
"""


def find_attracting_gaits(
    gait_finder: Any,
    parameter_values: Any,
    start_functions: tuple[StartFunction, ...] = (
        compute_walk_starts,
        compute_fallback_walk_starts,
    ),
) -> tuple[np.ndarray, Any]:
    """Find the attracting gaits of each wheel, in the order of increasing speed.

    By default, walks begin at WALK_STARTS. If a wheel has no gait from these starts, walks also
    begin at FALLBACK_WALK_STARTS. A wheel without an attracting gait has one cycle, whose outcome
    is a failure.

    Args:
        gait_finder: finder of gaits with unilateral contact.
        parameter_values: parameters of each wheel, shape (wheels, n_parameter_values), in the order
            of `AbstractWheel.collect_parameter_values`.
        start_functions: functions of wheels that return the starts of walks; the starts of each
            function are for wheels without a gait from those before.

    Returns:
        Index of the wheel to which each gait belongs, shape (gaits,), and the cycles, whose leading
        axis is (gaits,).
    """
    values = np.asarray(parameter_values)
    wheels, gaits = _find_gaits_from_starts(gait_finder, values, start_functions[0])
    missing = wheels[np.asarray(gaits.outcome) != Outcome.STEPPED]
    if not len(missing) or not start_functions[1:]:
        return wheels, gaits
    new_wheels, new_gaits = find_attracting_gaits(gait_finder, values[missing], start_functions[1:])
    is_found = np.asarray(new_gaits.outcome) == Outcome.STEPPED
    found = missing[new_wheels[is_found]]
    is_kept = ~np.isin(wheels, found)
    merged_gaits = concatenate_tree_rows(
        select_tree_rows(gaits, is_kept), select_tree_rows(new_gaits, is_found)
    )
    wheels = np.concatenate([wheels[is_kept], found])
    order = np.argsort(wheels, kind="stable")
    return wheels[order], select_rows_on_device(merged_gaits, order)


def _find_gaits_from_starts(
    gait_finder: Any, values: np.ndarray, compute_starts: StartFunction
) -> tuple[np.ndarray, Any]:
    """Find the attracting gaits that walks from given starts reach.

    Return the index of the wheel to which each gait belongs, and the gaits. The gaits of a wheel
    are sorted by increasing speed.
    """
    with ThreadPoolExecutor(1) as compile_thread:
        compile_thread.submit(
            with_default_jax_settings(gait_finder.precompile_newton_programs), values[:1]
        )
        wheels, states, _ = walk_to_gaits(gait_finder, values, compute_starts)
    candidates = gait_finder.find_cycles_near(values[wheels], states)
    # NumPy is used, because JAX would compile each operation for every number of wheels.
    is_attracting = np.abs(np.linalg.eigvals(candidates.monodromy_value)).max(-1) < 1.0
    is_valid = (np.asarray(candidates.outcome) == Outcome.STEPPED) & is_attracting
    sum_over_steps = lambda values: np.asarray(values).reshape(len(wheels), -1).sum(-1)
    speeds = sum_over_steps(candidates.step_length) / np.where(
        is_valid, sum_over_steps(candidates.durations), 1.0
    )
    step_ends = np.asarray(candidates.steps.section_state).swapaxes(0, 1)
    step_ends = scale_section_states(gait_finder, values[wheels], step_ends).swapaxes(0, 1)
    # A gait that repeats after fewer steps is a gait of a shorter period.
    distances = np.abs(step_ends[:, :-1] - step_ends[:, -1:]).max(-1)
    is_valid &= ~(distances < DUPLICATE_GAIT_DISTANCE).any(1)
    selected = []
    for of_wheel in np.split(
        np.arange(len(wheels)), find_slowest_gait_indices(wheels, len(values))[1:]
    ):
        valid = of_wheel[is_valid[of_wheel]]
        gaits_of_wheel: list[int] = []
        for candidate in valid[np.argsort(speeds[valid], kind="stable")]:
            distances = np.abs(step_ends[gaits_of_wheel] - step_ends[candidate, -1]).max(-1)
            if not (distances < DUPLICATE_GAIT_DISTANCE).any():
                gaits_of_wheel.append(candidate)
        selected += gaits_of_wheel or [of_wheel[0]]
    # The cycle of a wheel without a valid candidate contains zeros and has a failure as outcome.
    gaits, is_missing = select_tree_rows(candidates, selected), ~is_valid[selected]
    clear_missing = lambda x: np.where(is_missing, np.zeros_like(x).T, x.T).T
    outcome = np.where(
        is_missing & (gaits.outcome == Outcome.STEPPED), Outcome.NO_CYCLE_FOUND, gaits.outcome
    )
    gaits = eqx.tree_at(
        lambda gaits: (gaits.model, gaits.params, gaits.outcome),
        jax.tree.map(clear_missing, gaits),
        (gaits.model, gaits.params, outcome.astype(np.int32)),
    )
    return wheels[selected], jax.device_put(gaits)


def find_slow_gaits(gait_finder: Any, parameter_values: Any) -> Any:
    """Find for each wheel the gait that a walk from a slow start reaches.

    If the walk reaches no gait, the slowest attracting gait is returned. The two gaits are equal
    for each of 1,200 random wheels.
    """
    values = np.asarray(parameter_values)
    slow_start = lambda params: compute_walk_starts(params)[:1]
    _, slow_gaits = _find_gaits_from_starts(gait_finder, values, slow_start)
    missing = np.flatnonzero(np.asarray(slow_gaits.outcome) != Outcome.STEPPED)
    if not len(missing):
        return slow_gaits
    # A wheel without a gait has the failure of the walks from all starts.
    wheels, gaits = find_attracting_gaits(gait_finder, values[missing])
    rows = np.arange(len(values))
    rows[missing] = len(values) + find_slowest_gait_indices(wheels, len(missing))
    return select_rows_on_device(concatenate_tree_rows(slow_gaits, gaits), rows)


def find_slowest_gait_indices(gait_wheel_indices: np.ndarray, n_wheels: int) -> np.ndarray:
    """Return the index of the slowest gait of each wheel, shape (wheels,).

    - `gait_wheel_indices`: index of the wheel to which each gait belongs, in ascending order.
      The gaits of a wheel are sorted by increasing speed.
    """
    return np.searchsorted(gait_wheel_indices, np.arange(n_wheels))


GaitChoice = Literal["slowest", "fastest"] | int
"""Choice among the attracting gaits of a wheel: the slowest, the fastest, or an index.

Index 0 selects the slowest gait, and speed increases with the index.
"""


def parse_gait_choice(which: GaitChoice) -> int:
    """Return the index of the chosen gait in a list of gaits that are sorted by
    increasing speed.
    """
    if isinstance(which, str):
        return 0 if check_choice("which", which, ("slowest", "fastest")) == "slowest" else -1
    if not check_real("which", which).is_integer():
        raise ValueError(
            f"which is {which!r}, but it selects one of a wheel's gaits: give 'slowest', "
            "'fastest' or an index in vrw.limit_cycles(params, model=...)."
        )
    return int(which)


class PeriodicWalkEnds(NamedTuple):
    """Ends of the walks from many starts, as NumPy arrays with a leading axis over the starts."""

    outcome: np.ndarray  # STEPPED if the wheel still walks
    period: np.ndarray  # period of the orbit, in steps; 0 if not periodic
    n_steps_to_orbit: np.ndarray  # number of steps until the orbit, or until the fall
    orbit_states: np.ndarray
    """Section states of the orbit, (start, max_period, m), where m is the number of entries of a
    section state. The state with the lowest dtheta- comes first, and the array is padded with NaN.
    """


# Number of walking steps between two tests for periodic motion.
N_STEPS_PER_ROUND = 10
# Largest distance between the section states of a walk and of its orbit at which the walk has
# arrived at the orbit.
MAX_DISTANCE_ON_ARRIVAL = 1e-3


def walk_until_periodic(
    params: Any,
    start_states: np.ndarray,
    model: Any,
    options: StepOptions,
    max_steps: int,
    max_period: int,
) -> PeriodicWalkEnds:
    """Simulate the walk from each start until it is periodic or has failed, and return its end.

    - `params`: one wheel, or one wheel per start on the leading axis;
    - `start_states`: section states, (starts, entries);
    - `max_period`: longest period that is detected, in steps.
    """
    n_starts = len(start_states)
    leg_models = [model] if is_own_walker(model) else model.list_models_of_legs()
    repeated_wheels = jax.tree.map(lambda x: np.broadcast_to(np.asarray(x), n_starts), params)
    state_history = np.full((n_starts, 1 + max_steps, start_states.shape[1]), np.nan)
    state_history[:, 0] = start_states
    walk_outcomes = np.full(n_starts, int(Outcome.STEPPED))
    orbit_periods, n_steps_to_orbit = np.zeros(n_starts, int), np.zeros(n_starts, int)
    unsettled_walk_indices = np.arange(n_starts)
    for first_step in range(0, max_steps, N_STEPS_PER_ROUND):
        last_step = min(first_step + N_STEPS_PER_ROUND, max_steps)
        wheels = select_tree_rows(repeated_wheels, unsettled_walk_indices)
        section_states = state_history[unsettled_walk_indices, first_step]
        outcomes = np.zeros(len(section_states), int)
        for step_index in range(first_step, last_step):
            steps = step_batch(
                wheels,
                section_states,
                model=leg_models[step_index % len(leg_models)],
                options=options,
                engine=options.engine,
            )
            section_states = steps.section_state
            state_history[unsettled_walk_indices, step_index + 1] = section_states
            # A walk that has failed has no section state, so its outcome does not change.
            is_walking = outcomes == Outcome.STEPPED
            outcomes[is_walking] = steps.outcome[is_walking]
            is_walking = outcomes == Outcome.STEPPED
            n_steps_to_orbit[unsettled_walk_indices] += is_walking
        walk_outcomes[unsettled_walk_indices] = outcomes
        detected_periods = is_walking * _detect_walk_periods(
            state_history[unsettled_walk_indices, : last_step + 1], max_period
        )
        orbit_periods[unsettled_walk_indices] = detected_periods
        unsettled_walk_indices = unsettled_walk_indices[is_walking & (detected_periods == 0)]
        if not len(unsettled_walk_indices):
            break
    orbit_states = np.full((n_starts, max_period, start_states.shape[1]), np.nan)
    for i in np.flatnonzero(orbit_periods):
        states_of_walk = state_history[i, : n_steps_to_orbit[i] + 1]
        last_period_states = states_of_walk[-orbit_periods[i] :]
        # Legs that alternate are in their first roles in the first state of an orbit.
        step_indices = n_steps_to_orbit[i] + 1 + np.arange(-orbit_periods[i], 0)
        values = last_period_states[:, min(1, start_states.shape[1] - 1)]
        values = np.where(step_indices % len(leg_models) == 0, values, np.inf)
        orbit_states[i, : orbit_periods[i]] = np.roll(
            last_period_states, -int(np.argmin(values)), axis=0
        )
        orbit_distances = np.linalg.norm(states_of_walk[:, None] - last_period_states, axis=-1).min(
            1
        )
        distant_states = np.flatnonzero(orbit_distances > MAX_DISTANCE_ON_ARRIVAL)
        n_steps_to_orbit[i] = distant_states[-1] + 1 if len(distant_states) else 0
    return PeriodicWalkEnds(walk_outcomes, orbit_periods, n_steps_to_orbit, orbit_states)


# Largest change of a section state from one period to the next for which motion counts as periodic.
PERIODICITY_TOLERANCE = 1e-7


def _detect_walk_periods(state_history: np.ndarray, max_period: int) -> np.ndarray:
    """Return the shortest period that the last two periods of each walk confirm, in steps, or 0.

    - `state_history`: section states, (starts, steps, entries).
    """
    detected_periods = np.zeros(len(state_history), int)
    n_states = state_history.shape[1]
    for period in range(min(max_period, (n_states - 1) // 3), 0, -1):
        state_changes = np.abs(
            state_history[:, n_states - 2 * period :]
            - state_history[:, n_states - 3 * period : n_states - period]
        )
        is_periodic = state_changes.max((1, 2)) < PERIODICITY_TOLERANCE
        detected_periods[is_periodic] = period
    return detected_periods


# Largest distance between section states of two orbits that are treated as the same orbit. The
# value is chosen because it is far above the periodicity tolerance.
SAME_ORBIT_DISTANCE = 1e-4


def find_distinct_orbits(walk_ends: PeriodicWalkEnds) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return the index of the orbit that each walk reaches, and the states of the distinct orbits.

    The index is -1 without an orbit. The states have the shape (period, components). The orbit that
    the most walks reach is the first. Two orbits are compared state by state, beginning with the
    state that has the lowest dtheta-.
    """
    orbit_indices = np.full(len(walk_ends.period), -1)
    distinct_orbits: list[np.ndarray] = []
    for i in np.flatnonzero(walk_ends.period):
        orbit_states = walk_ends.orbit_states[i, : walk_ends.period[i]]
        for j, distinct_orbit_states in enumerate(distinct_orbits):
            if (
                len(distinct_orbit_states) == len(orbit_states)
                and np.abs(distinct_orbit_states - orbit_states).max() < SAME_ORBIT_DISTANCE
            ):
                orbit_indices[i] = j
                break
        else:
            orbit_indices[i] = len(distinct_orbits)
            distinct_orbits.append(orbit_states)
    n_starts_by_orbit = np.bincount(orbit_indices[orbit_indices >= 0])
    orbit_sort_order = np.argsort(n_starts_by_orbit)[::-1]
    rank_by_orbit = np.full(len(distinct_orbits) + 1, -1)
    rank_by_orbit[orbit_sort_order] = np.arange(len(distinct_orbits))
    return rank_by_orbit[orbit_indices], [distinct_orbits[j] for j in orbit_sort_order]


def measure_orbit_steps(
    params: Any, section_states: np.ndarray, model: Any, options: StepOptions
) -> dict[str, np.ndarray]:
    """Return all measures of the step from each section state of an orbit, by name.

    `section_states` has the shape (states, entries).
    """
    leg_models = itertools.cycle(model.list_models_of_legs())
    measures = [
        leg_model.take_step(params, jnp.asarray(x), options).measures()
        for leg_model, x in zip(leg_models, section_states, strict=False)
    ]
    return jax.tree.map(lambda *values: np.stack(values), *measures)
