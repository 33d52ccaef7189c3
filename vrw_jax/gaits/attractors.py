"""Attractors: walks from many starts, until the motion is periodic or the wheel falls.

Starts may belong to different wheels. Walks are tested after each round of several walking steps.
Only walks that are neither periodic nor failed continue, so that long transients cost little.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vrw_jax.base.options import StepOptions
from vrw_jax.base.outcomes import Outcome
from vrw_jax.lanes.batching import select_tree_rows
from vrw_jax.models.step_batch import step_batch


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
    repeated_wheels = jax.tree.map(lambda x: np.broadcast_to(np.asarray(x), n_starts), params)
    n_rounds = -(-max_steps // N_STEPS_PER_ROUND)
    state_history = np.full(
        (n_starts, 1 + n_rounds * N_STEPS_PER_ROUND, start_states.shape[1]), np.nan
    )
    state_history[:, 0] = start_states
    walk_outcomes = np.full(n_starts, int(Outcome.STEPPED))
    orbit_periods, n_steps_to_orbit = np.zeros(n_starts, int), np.zeros(n_starts, int)
    unsettled_walk_indices = np.arange(n_starts)
    for first_step in range(0, n_rounds * N_STEPS_PER_ROUND, N_STEPS_PER_ROUND):
        last_step = first_step + N_STEPS_PER_ROUND
        wheels = select_tree_rows(repeated_wheels, unsettled_walk_indices)
        section_states = state_history[unsettled_walk_indices, first_step]
        outcomes = np.zeros(len(section_states), int)
        for step_index in range(first_step, last_step):
            steps = step_batch(
                wheels, section_states, model=model, options=options, engine=options.engine
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
        orbit_states[i, : orbit_periods[i]] = np.roll(
            last_period_states,
            -int(np.argmin(last_period_states[:, min(1, start_states.shape[1] - 1)])),
            axis=0,
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
    """Return all measures of one step from each section state, by name.

    `section_states` has the shape (states, entries).
    """
    measures = [model.take_step(params, jnp.asarray(x), options).measures() for x in section_states]
    return jax.tree.map(lambda *values: np.stack(values), *measures)
