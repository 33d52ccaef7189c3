"""Search for gaits with all fallbacks: from the ends of walks, and on finer meshes.

The first search, of `collocation_search`, starts from predicted gaits for the paper's parameter
ranges, on a mesh that suits these gaits. If it fails, batches of walks begin at starts that scale
with the wheel. The end of a walk that settles is the start of another search. If the mesh is too
coarse, it is refined. Under a caller's `jit` or `vmap`, a Python function runs these fallbacks. If
they fail too, `describe_last_gait` follows the gaits toward the wheel.

Each wheel has its own mesh, which is refined until the gait is accurate. The result of a wheel
therefore does not depend on other wheels. NumPy selects and joins wheels, because JAX would compile
a program for each number of wheels.
"""

import dataclasses
import functools
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from vrw_jax.base.checks import (
    has_traced_leaf,
)
from vrw_jax.base.options import StepOptions
from vrw_jax.base.results import Outcome
from vrw_jax.base.small_matrices import compute_multipliers
from vrw_jax.gaits.collocation_search import CycleSearchResult
from vrw_jax.gaits.cycle import RETRY_OUTCOMES, AbstractCycle
from vrw_jax.gaits.finder import GAIT_BATCH_SIZES
from vrw_jax.gaits.gait_walks import (
    MAX_NEWTON_START_DEFECT,
    MAX_SETTLED_DEFECT,
    GaitChoice,
    can_walk_from_fast_starts,
    compute_all_walk_starts,
    find_attracting_gaits,
    find_slowest_gait_indices,
    measure_period_defects,
    parse_gait_choice,
    walk_to_gaits,
)
from vrw_jax.gaits.limit_cycle_result import LimitCycle, transfer_solution_to_mesh
from vrw_jax.gaits.phase_sequence import ADMISSIBILITY_CHECKS, CollocationState, CollocationSystem
from vrw_jax.gaits.wheel_finders import CollocationFinder
from vrw_jax.lanes.batching import (
    concatenate_tree_rows,
    is_inside_jit,
    map_in_batches,
    replace_rows,
    select_rows_on_device,
    select_tree_rows,
    unbatch,
)
from vrw_jax.lanes.environment import call_python, can_programs_call_jax
from vrw_jax.models.measures import MEASURES
from vrw_jax.models.step_batch import SolverIndex, select_cheapest_solver, step_batch
from vrw_jax.models.stepping import convert_model_argument, convert_step_options
from vrw_jax.wheel.params import WheelParams
from vrw_jax.wheel.phases import PAPER_PHASES, TRANSITION_ASSUMPTIONS

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


N_SEGMENTS = 8
"""Number of segments into which a part of the way is divided."""
N_DIVISIONS = 3
"""Number of divisions, each of the segment in which the gait ends.

The way is then known to 1/512, three digits of the parameters that differ.
"""
MAX_WALK_STEPS = 30
"""Largest number of steps of the walk that shows what happens beyond the last gait."""
SMALL_QUANTITY_RATIO = 0.1
"""Ratio to the value in Table 1 below which a quantity is treated as the reason for the end."""


def describe_last_gait(find_gaits: Callable, make_finder: Callable, cycle: AbstractCycle) -> str:
    """Return sentences about the last gait on the way to the wheel of `cycle`, which has none.

    The text is empty if no gait of the wheel can exist, or if the gait has several steps.

    - `find_gaits`: function that searches for the gaits of a batch of wheels;
    - `make_finder`: function of a model and the number of legs that returns its gait finder.
    """
    model, params = cycle.searched_wheel
    if cycle.period_n > 1 or model.explain_impossible_gait(params):
        return ""
    start = np.asarray(model.collect_parameter_values(WheelParams(n_legs=params.n_legs)))
    change = np.asarray(model.collect_parameter_values(params)) - start

    def make_wheel(fraction: float) -> WheelParams:
        values = jnp.asarray(start + fraction * change)
        return model.from_parameter_values(values, params.n_legs)[1]

    finder = make_finder(model, params.n_legs)
    if isinstance(finder, CollocationFinder):  # One mesh is compiled, fine enough for most gaits.
        finder = finder.with_finer_mesh(MESH_DOUBLINGS[0])

    def search_on_way(fractions: Any) -> Iterator[Any]:
        """Yield the cycle at each fraction of the way."""
        wheels = list(map(make_wheel, fractions))
        if finder.is_multistable:
            # All wheels walk together.
            cycles = find_gaits(jax.tree.map(lambda *x: np.stack(x), *wheels), model=model)
            yield from (select_tree_rows(cycles, index) for index in range(len(wheels)))
        else:
            yield from map(finder.find_cycle, wheels)

    (first_gait,) = search_on_way([0.0])
    if first_gait.outcome != Outcome.STEPPED:
        return "The wheel in Table 1 of the paper has no gait of this model on this ground either."
    last_fraction, segment_size = 0.0, 1.0
    last_gait, missing_gait = first_gait, cycle
    for _ in range(N_DIVISIONS):
        segment_size /= N_SEGMENTS
        fractions = last_fraction + segment_size * np.arange(1, N_SEGMENTS)
        for fraction, gait in zip(fractions, search_on_way(fractions), strict=False):
            if gait.outcome != Outcome.STEPPED:
                missing_gait = gait
                break
            last_fraction, last_gait = fraction, gait
    wheel_text = ", ".join(
        f"{name.replace('_', ' ')} {MEASURES[name].format_with_unit(value)}"
        for name, value in zip(model.parameter_names, start + last_fraction * change, strict=True)
        if value != start[model.parameter_names.index(name)]
    )
    return (
        "On the straight line from the wheel in Table 1 of the paper to this wheel, the last gait "
        f"found has {wheel_text or 'the parameters of Table 1'}. "
        + (
            _describe_failing_quantity(first_gait, last_gait, missing_gait)
            if isinstance(last_gait, LimitCycle)
            else _describe_walk(model, make_wheel(last_fraction + segment_size), last_gait)
        )
    )


def _describe_walk(model: Any, params: WheelParams, last_gait: Any) -> str:
    """Return a sentence about the walk of the next wheel, which begins at the last gait."""
    batch = jax.tree.map(lambda x: np.asarray(x)[None], params)
    section_states = np.asarray(last_gait.section_state)[None]
    for step_index in range(MAX_WALK_STEPS):
        steps = step_batch(batch, section_states, model=model)
        outcome = Outcome(int(steps.outcome[0]))
        if outcome != Outcome.STEPPED:
            return f"Beyond it, step {step_index + 1} from this gait fails: {outcome.meaning}"
        section_states = np.asarray(steps.section_state)
    return f"Beyond it, the wheel makes {MAX_WALK_STEPS} steps from this gait, but none repeats."


def _describe_failing_quantity(
    first_gait: LimitCycle, last_gait: LimitCycle, missing_gait: Any
) -> str:
    """Return a sentence about the quantity that reaches zero where the gaits end.

    If no quantity does so, the sentence states the largest multiplier. Gaits merge and vanish where
    a multiplier is 1.
    """
    multiplier = compute_multipliers(np.asarray(last_gait.monodromy_value))[0]
    multiplier_text = f"The largest multiplier of this gait is {multiplier:.4g}."
    check_index = int(missing_gait.collocation_state.failed_check) - 1
    quantities, first_quantities = map(_collect_lowest_quantities, (last_gait, first_gait))
    if check_index >= 0:
        check_index %= len(ADMISSIBILITY_CHECKS)
    else:
        ratios = [
            value / first_value
            for (value, _), (first_value, _) in zip(quantities, first_quantities, strict=True)
        ]
        check_index = int(np.argmin(ratios))
        if ratios[check_index] > SMALL_QUANTITY_RATIO:
            return multiplier_text
    if check_index >= len(quantities):  # The mesh is no quantity.
        return multiplier_text
    if quantities[check_index][0] == 0.0:  # The last gait has no double support.
        check_index = len(quantities) - len(TRANSITION_ASSUMPTIONS)
    assumption, (value, instant) = ADMISSIBILITY_CHECKS[check_index], quantities[check_index]
    return (
        f"Beyond this wheel, {assumption.failure}: {assumption.quantity}, {assumption.symbol}, has "
        f"fallen to {value:.3g} {assumption.unit}{instant}."
    )


def _collect_lowest_quantities(gait: LimitCycle) -> list[tuple[float, str]]:
    """Return the lowest value of the quantity of each check, and the instant of this value."""
    state = gait.collocation_state
    values_by_check = iter(
        gait.system.trace_checks(gait.parameters, state.solution, state.is_phase_active)
    )
    lowest_quantities = []
    for phase_class, mesh in zip(PAPER_PHASES, gait.system.phase_meshes, strict=True):
        lowest_quantities.append((float(next(values_by_check)), ""))
        for guard_index in range(len(phase_class.list_assumptions())):
            values = np.asarray(next(values_by_check))
            if guard_index == 0:  # The guard of the regular end is lowest at the end.
                values = values[: len(values) // 2]
            index = int(np.argmin(values))
            instant = f" {phase_class.start_title}"
            if index:
                percentage = 100.0 * np.append(mesh.node_time_fractions, 1.0)[index - 1]
                instant = f" at {percentage:.0f} % of this phase"
            lowest_quantities.append((float(values[index]), instant))
    lowest_quantities += [(abs(float(value)), "") for value in values_by_check]
    return lowest_quantities


def _find_chosen_gaits(gait_finder: Any, params: WheelParams, gait_choice: GaitChoice) -> Any:
    n_wheels = len(params.damping)
    gait_rank = parse_gait_choice(gait_choice)
    gait_wheel_indices, attracting_gaits = find_attracting_gaits(
        gait_finder, gait_finder.model.collect_batch_parameter_values(params)
    )
    n_gaits_per_wheel = np.bincount(gait_wheel_indices, minlength=n_wheels)
    # A wheel without a gait has one row, with the code of the failure.
    has_gait = np.bincount(gait_wheel_indices, attracting_gaits.found, n_wheels) > 0
    insufficient_gait_counts = n_gaits_per_wheel[
        has_gait & ((gait_rank >= n_gaits_per_wheel) | (gait_rank < -n_gaits_per_wheel))
    ]
    if len(insufficient_gait_counts):
        n_available_gaits = int(insufficient_gait_counts[0])
        raise ValueError(
            f"which is {gait_choice}, but {n_available_gaits} gait{'s' * (n_available_gaits > 1)} "
            f"of this wheel attract{'s' * (n_available_gaits == 1)}: "
            "vrw.limit_cycles(params, model=...) returns them."
        )
    return select_rows_on_device(
        attracting_gaits,
        find_slowest_gait_indices(gait_wheel_indices, n_wheels) + gait_rank % n_gaits_per_wheel,
    )


def search_with_fallbacks(
    gait_finder: Any,
    params: WheelParams,
    cycle_guess: Any,
    can_refine_mesh: bool,
    gait_choice: GaitChoice,
) -> Any:
    """Find the cycle of one wheel or of each wheel in a batch, by the search and all fallbacks.

    - `can_refine_mesh`: whether a finer mesh may be used;
    - `gait_choice`: choice among several attracting gaits.
    """
    has_batch_axis = params.damping.ndim > 0
    params_without_tangents = lax.stop_gradient(params)
    are_params_concrete = not has_traced_leaf(params)
    add_batch_axis = lambda tree: tree if has_batch_axis else select_rows_on_device(tree, None)
    drop_added_axis = lambda tree: tree if has_batch_axis else select_rows_on_device(tree, 0)
    if (
        gait_finder.is_multistable
        and cycle_guess is None
        and not has_traced_leaf(params_without_tangents)
    ):
        cycle = drop_added_axis(
            _find_chosen_gaits(gait_finder, add_batch_axis(params_without_tangents), gait_choice)
        )
        return (
            cycle
            if are_params_concrete
            else _search_without_fallbacks(gait_finder, params, cycle.section_state)
        )
    # Differentiated arrays also have concrete values.
    is_traced = is_inside_jit() or has_traced_leaf(params_without_tangents, cycle_guess)
    search_options: dict[str, Any] = {}
    if is_traced and can_programs_call_jax():
        if gait_finder.supports_cold_start:
            gait_finder = gait_finder.with_second_mesh() if can_refine_mesh else gait_finder
            search_options = {"search_missing_cycles": _search_missing_cycles}
        elif gait_finder.is_multistable and cycle_guess is None:
            cycle_guess = _choose_gait_inside_jit(gait_finder, params_without_tangents, gait_choice)
    cycle = _search_without_fallbacks(gait_finder, params, cycle_guess, **search_options)
    if is_traced or not gait_finder.supports_cold_start:
        return cycle
    params_and_cycle: tuple[WheelParams, Any] = lax.stop_gradient((params, cycle))
    params_and_cycle = add_batch_axis(params_and_cycle)
    section_state = None
    if cycle_guess is not None:
        if isinstance(cycle_guess, CollocationState):
            guess_section_state = cycle_guess.gait_step_end_states[-1][jnp.array([0, 2, 3])]
        else:
            guess_section_state = getattr(cycle_guess, "section_state", cycle_guess)
        section_state = np.asarray(lax.stop_gradient(guess_section_state))[None]
    finder_and_starts = _collect_starts_on_finest_mesh(
        gait_finder,
        params_and_cycle[1],
        search_further(
            find_cycles_from_starts,
            gait_finder,
            params_and_cycle[0],
            summarize_search(params_and_cycle[1]),
            GAIT_BATCH_SIZES,
            section_state,
            can_refine_mesh,
        ),
    )
    has_equal_steps = gait_finder.model.leg_period == 1
    if gait_finder.period_n > 1 and has_equal_steps and section_state is not None:
        finder_and_starts = _choose_first_step(
            gait_finder, *params_and_cycle, section_state, finder_and_starts
        )
    if finder_and_starts is None:
        return cycle
    finest_finder, starts = finder_and_starts
    if are_params_concrete:
        return drop_added_axis(
            _find_cycles_on_finest_mesh(gait_finder, finest_finder, *params_and_cycle, starts)
        )
    retried_cycle = _search_without_fallbacks(
        finest_finder, params, jax.device_put(drop_added_axis(starts)), starts_only_from_guess=True
    )
    return _restore_first_failure_reason(cycle, retried_cycle)


def summarize_search(cycle: LimitCycle) -> MeshSearch:
    """Return the cycles of a batch with their mesh errors, from which a search goes on."""
    mesh_error = map_in_batches(lambda cycle: cycle.mesh_error, GAIT_BATCH_SIZES, cycle)
    return MeshSearch(cycle.outcome, mesh_error, cycle.collocation_state, cycle)


def find_cycles_from_starts(
    gait_finder: CollocationFinder, params: WheelParams, starts: CollocationState
) -> MeshSearch:
    """Search for the cycles of a batch from the given starts only."""
    find_cycles = functools.partial(gait_finder.find_cycles, starts_only_from_guess=True)
    return summarize_search(map_in_batches(find_cycles, GAIT_BATCH_SIZES, params, starts))


def _collect_starts_on_finest_mesh(
    gait_finder: CollocationFinder,
    cycle: LimitCycle,
    gaits_by_mesh: list[tuple[CollocationFinder, np.ndarray, MeshSearch]],
) -> tuple[CollocationFinder, CollocationState] | None:
    """Return the finder of the finest mesh, and the state of each wheel on this mesh.

    The result is None if there are no further gaits.
    """
    collocation_state = cycle.collocation_state
    for mesh_finder, wheel_indices, mesh_search in gaits_by_mesh:
        if gait_finder.cycle_options != mesh_finder.cycle_options:
            collocation_state = transfer_to_mesh(
                gait_finder, mesh_finder, collocation_state, GAIT_BATCH_SIZES
            )
            gait_finder = mesh_finder
        collocation_state = replace_rows(
            collocation_state, wheel_indices, mesh_search.collocation_state
        )
    return (gait_finder, collocation_state) if gaits_by_mesh else None


def _find_cycles_on_finest_mesh(
    gait_finder: CollocationFinder,
    finest_finder: CollocationFinder,
    params: WheelParams,
    cycle: LimitCycle,
    starts: CollocationState,
) -> LimitCycle:
    """Return the cycles of a batch on one mesh. Wheels without a gait keep their first result."""
    wheels_with_gait = np.flatnonzero(np.asarray(starts.has_cycle) > 0.5)
    cycle_on_finest_mesh = dataclasses.replace(
        cycle,
        collocation_state=cycle.collocation_state._replace(solution=starts.solution),
        system=finest_finder.collocation_system,
    )
    mesh_search = find_cycles_from_starts(
        finest_finder, *select_tree_rows((params, starts), wheels_with_gait)
    )
    is_found = np.asarray(mesh_search.outcome) == Outcome.STEPPED
    return jax.device_put(
        replace_rows(
            cycle_on_finest_mesh,
            wheels_with_gait[is_found],
            select_tree_rows(mesh_search.gaits, is_found),
        )
    )


def _restore_first_failure_reason(cycle: LimitCycle, retried_cycle: LimitCycle) -> LimitCycle:
    """Return the cycles of the second search, with the failure reasons of the first search.

    The reason of the first search replaces that of the second search if no gait exists. All
    functions therefore report the same reason, whether fallbacks are used or not, and for any
    batch.
    """
    get_failure_reason = lambda cycle: (cycle.outcome, cycle.collocation_state.failed_check)
    failure_reasons = get_failure_reason(cycle), get_failure_reason(retried_cycle)
    # NumPy compiles nothing for a new batch size.
    array_module: Any = jnp if has_traced_leaf(failure_reasons) else np
    first_reason, last_reason = jax.tree.map(array_module.asarray, failure_reasons)
    is_gait_missing = (first_reason[0] != Outcome.STEPPED) & (last_reason[0] != Outcome.STEPPED)
    failure_reason = jax.tree.map(
        functools.partial(array_module.where, is_gait_missing), first_reason, last_reason
    )
    return eqx.tree_at(get_failure_reason, retried_cycle, jax.device_put(failure_reason))


def _search_without_fallbacks(
    gait_finder: Any, params: WheelParams, cycle_guess: Any, **search_options: Any
) -> Any:
    if not params.damping.ndim:
        return gait_finder.find_cycle(params, cycle_guess, **search_options)
    if cycle_guess is not None or has_traced_leaf(params):
        return gait_finder.find_cycles(params, cycle_guess, **search_options)
    return map_in_batches(gait_finder.find_cycles, GAIT_BATCH_SIZES, params)


def _search_missing_cycles(
    collocation_system: CollocationSystem,
    parameters: Any,
    search_result: CycleSearchResult,
    *guess: CollocationState,
) -> CycleSearchResult:
    """Return the result of a search with the cycles that all fallbacks find on the fine mesh.

    JAX programs call this function. The last axis of the arrays is that of the wheels.
    """
    parameters, search_result, guess = jax.tree.map(np.array, (parameters, search_result, guess))
    missing = np.flatnonzero(search_result.collocation_state.has_cycle < 0.5)
    params = collocation_system.make_wheel(jax.device_put(parameters[:, missing]))
    model: Any = convert_model_argument(None).with_laws(params.laws)
    gait_finder: Any = CollocationFinder(
        dataclasses.replace(model, stop_at_lift_off=collocation_system.stop_at_lift_off),
        collocation_system.n_legs,
        convert_step_options(None),
        collocation_system.cycle_options,
        collocation_system.period_n,
    )
    search = functools.partial(
        search_with_fallbacks, gait_finder, can_refine_mesh=False, gait_choice="slowest"
    )
    if guess:
        guesses = jax.tree.map(lambda x: np.moveaxis(x[..., missing], -1, 0), guess[0])
        if collocation_system.coarse_options is not None:
            coarse_options = collocation_system.coarse_options
            coarse_finder = dataclasses.replace(gait_finder, cycle_options=coarse_options)
            guesses = transfer_to_mesh(coarse_finder, gait_finder, guesses, GAIT_BATCH_SIZES)
        rows = [select_tree_rows((params, guesses), i) for i in range(len(missing))]
        cycles = [search(*jax.device_put(row)) for row in rows]
        cycle = jax.tree.map(lambda *x: np.stack(x), *cycles)
    else:
        cycle = search(params, None)
    is_found = np.asarray(cycle.found)
    names = "collocation_state", "monodromy_value", "residual", "n_newton_iterations"
    found_values = jax.tree.leaves([getattr(cycle, name) for name in names])
    for result, found in zip(jax.tree.leaves(search_result), found_values, strict=True):
        result[..., missing[is_found]] = np.moveaxis(np.asarray(found)[is_found], 0, -1)
    return search_result


def _choose_gait_inside_jit(
    gait_finder: Any, params: WheelParams, gait_choice: GaitChoice
) -> Array:
    """Return the section state of the chosen gait, which a Python function finds."""
    section_state = gait_finder.prepare_search(params, None)[1]
    # The values of all traced numbers are among those of the parameters.
    concrete_finder = jax.tree.map(
        lambda x: np.ones(x.shape, x.dtype) if isinstance(x, jax.core.Tracer) else x, gait_finder
    )

    def find_section_states(parameter_values: Any) -> np.ndarray:
        columns = tuple(jax.device_put(list(np.asarray(parameter_values))))
        model, batch = concrete_finder.model.from_parameter_values(columns, gait_finder.n_legs)
        finder = dataclasses.replace(concrete_finder, model=model)
        gaits = _find_chosen_gaits(finder, model.attach_laws(batch), gait_choice)
        return np.asarray(gaits.section_state, section_state.dtype).T

    @unbatch
    def find_lanes(parameter_values: Array) -> Array:
        shape = (*section_state.shape, parameter_values.shape[-1])
        result_type = jax.ShapeDtypeStruct(shape, section_state.dtype)
        return call_python(find_section_states, result_type, parameter_values)

    return find_lanes(gait_finder.model.collect_parameter_values(params))


def _choose_first_step(
    gait_finder: CollocationFinder,
    params: WheelParams,
    cycle: LimitCycle,
    start_section_states: np.ndarray,
    finder_and_starts: tuple[CollocationFinder, CollocationState] | None,
) -> tuple[CollocationFinder, CollocationState] | None:
    """Return a finder and the same gait of one wheel, with the first step selected by its state.

    The first step is the gait step that starts nearest to `start_section_states`. If no gait is
    found, the search is repeated with each other gait step as the first step. A guess contains the
    accelerations of all gait steps, whose errors accumulate. A gait step without double support is
    the most sensitive step. If it is the first or the last step, the search may fail.
    """
    section_states = start_section_states
    for _ in range(1, gait_finder.period_n):
        if finder_and_starts is not None or int(cycle.outcome[0]) not in RETRY_OUTCOMES:
            break
        section_states = step_batch(params, section_states, model=gait_finder.model).section_state
        cycle = map_in_batches(gait_finder.find_cycles, GAIT_BATCH_SIZES, params, section_states)
        if cycle.found[0]:
            finder_and_starts = gait_finder, cycle.collocation_state
    gait_finder, collocation_state = finder_and_starts or (gait_finder, cycle.collocation_state)
    end_states = np.asarray(collocation_state.gait_step_end_states)[0][:, [0, 2, 3]]
    distances_to_start = np.abs(np.roll(end_states, 1, axis=0) - start_section_states).max(-1)
    first_step_index = int(np.argmin(distances_to_start))
    if not first_step_index or collocation_state.has_cycle[0] < 0.5:
        return finder_and_starts
    shift_to_first_step = jax.vmap(
        functools.partial(gait_finder.shift_first_step, first_step_index)
    )
    return gait_finder, shift_to_first_step(params, jax.device_put(collocation_state))
