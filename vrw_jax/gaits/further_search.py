"""Search again for gaits that the first search missed: from the ends of walks, on finer meshes.

Each wheel has its own mesh, which is refined until the gait is accurate. The result of a wheel
therefore does not depend on other wheels. NumPy selects and joins wheels, because JAX would compile
a program for each number of wheels.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

from vrw_jax.base.options import StepOptions
from vrw_jax.base.outcomes import Outcome
from vrw_jax.gaits.collocation_finder import CollocationFinder
from vrw_jax.gaits.cycle import RETRY_OUTCOMES
from vrw_jax.gaits.gait_walks import (
    MAX_NEWTON_START_DEFECT,
    MAX_SETTLED_DEFECT,
    can_walk_from_fast_starts,
    compute_all_walk_starts,
    measure_period_defects,
    walk_to_gaits,
)
from vrw_jax.gaits.limit_cycle_result import transfer_solution_to_mesh
from vrw_jax.gaits.phase_sequence import CollocationState
from vrw_jax.lanes.batching import concatenate_tree_rows, map_in_batches, select_tree_rows
from vrw_jax.models.step_batch import SolverIndex, select_cheapest_solver
from vrw_jax.wheel.params import WheelParams

MAX_UNREFINED_MESH_ERROR = 1e-7
"""Estimated mesh error above which a finer mesh is used. The value is chosen because actual errors
are a hundredth of the estimate.
"""
MESH_DOUBLINGS = (2, 1)
"""Number of times that the mesh intervals are doubled in each refinement of the mesh.

The value is chosen because the search is compiled for each mesh, which takes longer than the search
of a few gaits on a mesh with more intervals than they need.
"""


class MeshSearch(NamedTuple):
    """Gaits of a batch of wheels on one mesh. All arrays have a leading axis over the wheels."""

    outcome: Any
    mesh_error: Any
    collocation_state: CollocationState
    gaits: Any  # further results


FindGaits = Callable[[CollocationFinder, WheelParams, CollocationState], MeshSearch]
"""Function that searches for gaits on the mesh of a finder, from given starts."""


def search_further(
    find_gaits: FindGaits,
    gait_finder: CollocationFinder,
    params: WheelParams,
    first_search: MeshSearch,
    batch_sizes: tuple[int, ...],
    guess_states: np.ndarray | None = None,
    can_refine_mesh: bool = True,
    max_mesh_error: float = MAX_UNREFINED_MESH_ERROR,
) -> list[tuple[CollocationFinder, np.ndarray, MeshSearch]]:
    """Return further gaits of a batch: for each mesh its finder, indices of wheels, and gaits.

    The meshes become finer, and a gait on a later mesh replaces that on an earlier one.

    - `first_search`: result of the search on the mesh of `gait_finder`;
    - `guess_states`: section states of the user's guesses, shape (wheels, 3);
    - `can_refine_mesh`: whether a finer mesh may be used;
    - `max_mesh_error`: estimated mesh error above which it is used.
    """
    outcomes, mesh_errors, collocation_state = jax.tree.map(np.asarray, first_search[:3])
    is_coarse = (outcomes == Outcome.MESH_TOO_COARSE) | (mesh_errors > max_mesh_error)
    is_walk_needed = (
        np.isin(outcomes, RETRY_OUTCOMES)
        & ~(is_coarse & can_refine_mesh)
        & ~gait_finder.collocation_system.is_beyond_border(
            collocation_state.failed_check, collocation_state.is_phase_active[:, 0, 0] > 0.5
        )
    )
    parameter_values = gait_finder.model.collect_batch_parameter_values(params)
    if gait_finder.n_legs == WheelParams().n_legs and guess_states is None:
        scouted_wheels = np.flatnonzero(is_walk_needed & (outcomes == Outcome.EVENT_ORDER_MISMATCH))
        if len(scouted_wheels):
            is_walk_needed[scouted_wheels] = can_walk_from_fast_starts(
                gait_finder, parameter_values[scouted_wheels]
            )
    walk_end_states, is_settled = _find_walk_end_states(
        gait_finder, parameter_values, is_walk_needed, guess_states
    )
    walking_wheels = np.flatnonzero(np.isfinite(walk_end_states[:, 0]))
    coarse_wheels = np.flatnonzero(is_coarse)
    roots = select_tree_rows(collocation_state, coarse_wheels)
    gaits_by_mesh = []
    for n_doublings in (0, *(MESH_DOUBLINGS if can_refine_mesh else ())):
        if n_doublings:
            finer_finder = gait_finder.with_finer_mesh(n_doublings)
            if len(coarse_wheels):
                roots = transfer_to_mesh(gait_finder, finer_finder, roots, batch_sizes)
            gait_finder = finer_finder
        starts_by_origin, wheels_by_origin = [], [walking_wheels]
        if len(walking_wheels):
            starts_by_origin.append(
                map_in_batches(
                    jax.vmap(gait_finder.guess_cycle_from_state),
                    batch_sizes,
                    select_tree_rows(params, walking_wheels),
                    walk_end_states[walking_wheels],
                )
            )
        if n_doublings and len(coarse_wheels):
            starts_by_origin.append(roots)
            wheels_by_origin.append(coarse_wheels)
        searched_wheels = np.concatenate(wheels_by_origin)
        if len(searched_wheels):
            mesh_search = jax.tree.map(
                np.asarray,
                find_gaits(
                    gait_finder,
                    select_tree_rows(params, searched_wheels),
                    concatenate_tree_rows(*starts_by_origin),
                ),
            )
            is_found = mesh_search.outcome == Outcome.STEPPED
            if is_found.any():
                found_gaits = select_tree_rows(mesh_search, is_found)
                gaits_by_mesh.append((gait_finder, searched_wheels[is_found], found_gaits))
            # The end of a walk is a better start than a root whose mesh is too coarse.
            is_mesh_too_coarse = mesh_search.outcome == Outcome.MESH_TOO_COARSE
            can_walk_help = is_mesh_too_coarse | (~is_found & is_settled[searched_wheels])
            is_walking = np.isin(searched_wheels, walking_wheels)
            is_coarse = mesh_search.mesh_error > max_mesh_error
            is_coarse |= is_mesh_too_coarse & ~is_walking
            new_roots = select_tree_rows(mesh_search.collocation_state, is_coarse)
            walking_wheels = searched_wheels[is_walking & can_walk_help]
            if n_doublings:
                coarse_wheels, roots = searched_wheels[is_coarse], new_roots
            else:
                coarse_wheels = np.concatenate([coarse_wheels, searched_wheels[is_coarse]])
                roots = concatenate_tree_rows(roots, new_roots)
    return gaits_by_mesh


def transfer_to_mesh(
    source_finder: CollocationFinder,
    target_finder: CollocationFinder,
    collocation_state: CollocationState,
    batch_sizes: tuple[int, ...],
) -> CollocationState:
    """Return the states of a batch of wheels on the mesh of another finder."""
    transfer_solution = functools.partial(
        transfer_solution_to_mesh,
        source_finder.collocation_system,
        target_finder.collocation_system,
    )
    return collocation_state._replace(
        solution=map_in_batches(
            jax.vmap(transfer_solution), batch_sizes, collocation_state.solution
        )
    )


def _find_walk_end_states(
    gait_finder: CollocationFinder,
    parameter_values: np.ndarray,
    is_walk_needed: np.ndarray,
    guess_states_by_wheel: np.ndarray | None,
) -> tuple[np.ndarray, np.ndarray]:
    """Return for each wheel the state at the end of its walk with the smallest period defect, and
    whether the walk has settled.

    The states are section states, shape (wheels, 3). A state is NaN if no walk of the wheel nearly
    repeats, or if the wheel requires no walk. If a guess nearly repeats, it is returned instead of
    the end of a walk, and treated as settled. No walks are computed for wheels that are too stiff
    for explicit solvers. With an implicit solver, the walks of one such wheel would take minutes.
    """
    solver_indices = select_cheapest_solver(parameter_values.T, StepOptions())
    is_solver_explicit = solver_indices != SolverIndex.IMPLICIT_SOLVER
    unsettled_wheel_indices = np.flatnonzero(is_walk_needed & is_solver_explicit)
    walk_end_states = np.full((len(is_walk_needed), 3), np.nan)
    smallest_period_defects = np.full(len(is_walk_needed), MAX_NEWTON_START_DEFECT)
    if guess_states_by_wheel is not None:
        guess_states = guess_states_by_wheel[unsettled_wheel_indices]
        guess_defects = measure_period_defects(
            gait_finder, parameter_values[unsettled_wheel_indices], guess_states
        )
        is_guess_usable = guess_defects < MAX_NEWTON_START_DEFECT
        guessed_wheel_indices = unsettled_wheel_indices[is_guess_usable]
        walk_end_states[guessed_wheel_indices] = guess_states[is_guess_usable]
        smallest_period_defects[guessed_wheel_indices] = 0.0
        unsettled_wheel_indices = unsettled_wheel_indices[~is_guess_usable]
    if len(unsettled_wheel_indices):
        wheel_indices, *walk_ends = walk_to_gaits(
            gait_finder, parameter_values[unsettled_wheel_indices], compute_all_walk_starts
        )
        for wheel_index, walk_end_state, period_defect in zip(
            unsettled_wheel_indices[wheel_indices], *walk_ends, strict=True
        ):
            if period_defect < smallest_period_defects[wheel_index]:
                smallest_period_defects[wheel_index] = period_defect
                walk_end_states[wheel_index] = walk_end_state
    return walk_end_states, smallest_period_defects < MAX_SETTLED_DEFECT
