"""Attractors: many starts, each walked until its motion is periodic or the wheel falls.

Starts may belong to different wheels. Starts without a result after a round are gathered for the
next round, so that long transients cost little.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from vrw_jax.contact import (
    UnilateralWheel,
    embed_section_states,
    step_batch_with_jacobian,
    walk_batch,
)
from vrw_jax.models import AbstractWheel
from vrw_jax.numerics import StepOptions, batch_sizes, map_in_batches, take_rows
from vrw_jax.simulation.stepping import walk
from vrw_jax.wheel import Outcome, WheelParams


@dataclass(frozen=True)
class AttractorOptions:
    """Options of the tests for periodic walks. Distances are those between section states."""

    n_steps_per_round: int = 10
    """Number of steps between two tests for periodic motion."""
    periodicity_tolerance: float = 1e-7
    """Largest change of the section states over one period in periodic motion."""
    arrival_distance: float = 1e-3
    """Largest distance to its orbit at which a walk counts as arrived."""
    same_orbit_distance: float = 1e-4
    """Largest distance between two orbits that count as the same.

    The value is chosen because it is far above the periodicity tolerance."""


ATTRACTOR_OPTIONS = AttractorOptions()


class WalkEnds(NamedTuple):
    """Ends of walks, as numpy arrays with a leading axis over starts."""

    outcome: np.ndarray  # STEPPED if the wheel still walks
    period: np.ndarray  # period of the orbit, in steps; 0 if not periodic
    n_steps: np.ndarray  # number of steps until the orbit, or until the fall
    orbit_states: np.ndarray
    """Section states of the orbit, (start, max_period, m): the state with the lowest dtheta- first,
    NaN after the last."""


@eqx.filter_jit
def _walk_block(
    model: AbstractWheel, options: StepOptions, n_steps: int, params: WheelParams, x: Array
) -> tuple[Array, Array]:
    """Return section states and outcomes of one round of steps from a block of starts, (starts,
    steps, ...).
    """
    walk_round = lambda params, x: walk(params, x, n_steps, model=model, options=options)
    walks = jax.vmap(walk_round)(params, x)
    return walks.steps.section_state, walks.steps.outcome


def _walk_round_batched(
    model: Any, options: StepOptions, n_steps: int, params: WheelParams, x: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the results of `_walk_block` with unilateral contact for any number of starts.

    The batch kernel takes the steps.
    """
    n, input_columns = params.n_legs, np.asarray(jax.vmap(model.parameter_values)(params)).T
    x = embed_section_states(input_columns, np.asarray(x), n)
    section_states, outcomes = list[np.ndarray](), list[np.ndarray]()
    for _ in range(n_steps):
        x, _, outcome, *_ = walk_batch(input_columns, x, 1, model, options, n)
        # A wheel that fell has no section state, so its outcome is kept.
        outcome = outcome if not outcomes else np.where(outcomes[-1] > 0, outcomes[-1], outcome)
        section_states.append(x)
        outcomes.append(outcome)
    return np.stack(section_states, 1), np.stack(outcomes, 1)


def walk_until_periodic(
    params: WheelParams,
    starts: np.ndarray,
    model: AbstractWheel,
    options: StepOptions,
    max_steps: int,
    max_period: int,
    attractor_options: AttractorOptions = ATTRACTOR_OPTIONS,
) -> WalkEnds:
    """Return the end of each walk.

    - `params`: one wheel, or wheels on the leading axis of the starts;
    - `starts`: section states, (starts, m);
    - `max_period`: longest period that is detected, in steps.
    """
    n = len(starts)
    broadcast_to_starts = lambda x: np.broadcast_to(np.asarray(x), n)
    wheels_by_start = jax.tree.map(broadcast_to_starts, params)
    n_round_steps = attractor_options.n_steps_per_round
    n_rounds = -(-max_steps // n_round_steps)
    history = np.full((n, 1 + n_rounds * n_round_steps, starts.shape[1]), np.nan)
    history[:, 0] = starts
    outcome = np.full(n, int(Outcome.STEPPED))
    period, n_steps_to_orbit = np.zeros(n, int), np.zeros(n, int)
    unsettled_indices = np.arange(n)
    walk_round: Callable[..., tuple]
    if model.batch_kernel == "legs":
        walk_round = functools.partial(_walk_round_batched, model, options, n_round_steps)
    else:
        walk_block = functools.partial(_walk_block, model, options, n_round_steps)
        walk_round = functools.partial(
            map_in_batches, walk_block, (batch_sizes.ATTRACTOR_BATCH_SIZE,)
        )
    for k in range(n_rounds):
        round_slice = slice(1 + k * n_round_steps, 1 + (k + 1) * n_round_steps)
        round_arguments = (
            take_rows(wheels_by_start, unsettled_indices),
            history[unsettled_indices, k * n_round_steps],
        )
        round_states, step_outcomes = map(np.asarray, walk_round(*round_arguments))
        history[unsettled_indices, round_slice], outcome[unsettled_indices] = (
            round_states,
            step_outcomes[:, -1],
        )
        n_steps_to_orbit[unsettled_indices] = k * n_round_steps + np.sum(
            step_outcomes == Outcome.STEPPED, 1
        )
        n_known_steps = (k + 1) * n_round_steps
        period[unsettled_indices] = _detect_periods(
            history[unsettled_indices, : n_known_steps + 1],
            max_period,
            attractor_options.periodicity_tolerance,
        )
        period[outcome != Outcome.STEPPED] = 0
        unsettled_indices = unsettled_indices[
            (outcome[unsettled_indices] == Outcome.STEPPED) & (period[unsettled_indices] == 0)
        ]
        if not len(unsettled_indices):
            break
    orbit_states = np.full((n, max_period, starts.shape[1]), np.nan)
    for i in np.flatnonzero(period):
        last_states = history[i, n_steps_to_orbit[i] + 1 - period[i] : n_steps_to_orbit[i] + 1]
        orbit_states[i, : period[i]] = np.roll(
            last_states, -int(np.argmin(last_states[:, 1])), axis=0
        )
        distances = np.linalg.norm(
            history[i, : n_steps_to_orbit[i] + 1, None] - last_states[None], axis=-1
        ).min(1)
        distant_steps = np.flatnonzero(distances > attractor_options.arrival_distance)
        n_steps_to_orbit[i] = distant_steps[-1] + 1 if len(distant_steps) else 0
    return WalkEnds(outcome, period, n_steps_to_orbit, orbit_states)


def _detect_periods(history: np.ndarray, max_period: int, tolerance: float) -> np.ndarray:
    """Return the shortest period, in steps, that the last two periods confirm; 0 without one.

    - `history`: section states, (starts, steps, m).
    """
    periods = np.zeros(len(history), int)
    n_states = history.shape[1]
    for period in range(min(max_period, (n_states - 1) // 3), 0, -1):
        max_change_by_entry = np.abs(
            history[:, n_states - 2 * period :]
            - history[:, n_states - 3 * period : n_states - period]
        )
        periods[max_change_by_entry.max((1, 2)) < tolerance] = period
    return periods


class Attractors(NamedTuple):
    """Distinct orbits of many starts, ordered by decreasing number of starts."""

    orbit_index: np.ndarray  # index of the orbit of each start; -1 without an orbit
    orbits: list[np.ndarray]  # section states of each orbit, (period, m)


def find_distinct_orbits(
    walk_ends: WalkEnds, options: AttractorOptions = ATTRACTOR_OPTIONS
) -> Attractors:
    """Return the distinct orbits of the walks.

    Orbits are compared from their state with the lowest dtheta- on.
    """
    orbit_index = np.full(len(walk_ends.period), -1)
    orbits: list[np.ndarray] = []
    for i in np.flatnonzero(walk_ends.period):
        orbit = walk_ends.orbit_states[i, : walk_ends.period[i]]
        for j, known_orbit in enumerate(orbits):
            if (
                len(known_orbit) == len(orbit)
                and np.abs(known_orbit - orbit).max() < options.same_orbit_distance
            ):
                orbit_index[i] = j
                break
        else:
            orbit_index[i] = len(orbits)
            orbits.append(orbit)
    n_starts_by_orbit = [int(np.sum(orbit_index == j)) for j in range(len(orbits))]
    orbit_order = np.argsort(n_starts_by_orbit)[::-1]
    orbit_rank = np.full(len(orbits) + 1, -1)
    orbit_rank[orbit_order] = np.arange(len(orbits))
    return Attractors(orbit_rank[orbit_index], [orbits[j] for j in orbit_order])


@eqx.filter_jit
def _measure_block(
    model: AbstractWheel, options: StepOptions, params: WheelParams, x: Array
) -> dict[str, Array]:
    """Return all measures of one step from each start of a block."""
    return jax.vmap(lambda p, x: model.take_step(p, x, options).measures())(params, x)


def measure_orbits(
    params: WheelParams, states: np.ndarray, model: AbstractWheel, options: StepOptions
) -> dict[str, np.ndarray]:
    """Return all measures of one step from each of `states`, shape (n, m), by name."""
    n = len(states)
    repeated_wheels = jax.tree.map(lambda x: np.broadcast_to(np.asarray(x), n), params)
    if model.batch_kernel == "legs":
        input_columns = np.asarray(jax.vmap(model.parameter_values)(repeated_wheels)).T
        unilateral_model = cast(UnilateralWheel, model)
        step_results, _ = step_batch_with_jacobian(
            input_columns, states, unilateral_model, options, params.n_legs, ()
        )
        return jax.tree.map(np.asarray, jax.tree.map(jnp.asarray, step_results).measures())
    measure_block = functools.partial(_measure_block, model, options)
    return jax.tree.map(
        np.asarray,
        map_in_batches(measure_block, (batch_sizes.ATTRACTOR_BATCH_SIZE,), repeated_wheels, states),
    )
