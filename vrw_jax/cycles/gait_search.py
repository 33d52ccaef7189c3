"""Limit cycles by a search and, if it fails, by searches on finer meshes or from walks.

The search (`cycles`) starts from predicted gaits of the paper's parameter ranges, on a mesh that
suits them. If it fails, batches of walks (`batches`) begin at starts that scale with the wheel. A
walk that continues is the start of another search. If the mesh is too coarse, it is refined. These
fallbacks depend on concrete values, so under a `jit` or `vmap` of the caller only the search runs.
"""

import functools
from dataclasses import dataclass
from typing import Any, Literal, get_args, overload

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from vrw_jax.batches import SolverIndex, select_solver, step_batch
from vrw_jax.cycles.attracting_gaits import find_attracting_gaits, find_slowest_indices
from vrw_jax.cycles.collocation_finder import CollocationFinder
from vrw_jax.cycles.collocation_search import CollocationState
from vrw_jax.cycles.finder import AbstractGaitFinder
from vrw_jax.cycles.finder_selection import Guess, check_guess, resolve_finder, resolve_model
from vrw_jax.cycles.gait_walks import (
    GAIT_WALK_OPTIONS,
    compute_fallback_starts,
    compute_walk_starts,
    measure_period_defect,
    walk_to_gaits,
)
from vrw_jax.cycles.limit_cycle_result import LimitCycle
from vrw_jax.cycles.options import CycleOptions
from vrw_jax.cycles.return_map_finder import ReturnMapCycle
from vrw_jax.numerics import StepOptions, batch_sizes, map_in_batches, take_rows
from vrw_jax.runtime import with_default_settings
from vrw_jax.simulation import ModelLike
from vrw_jax.validation import (
    check_choice,
    check_int,
    check_not_traced,
    check_real,
    check_type,
    is_traced,
    raise_for_renamed_arguments,
)
from vrw_jax.wheel import PARAMETER_NAMES, Outcome, WheelParams, stack_parameters

RETRY_OUTCOMES = (
    Outcome.NO_CYCLE_FOUND,
    Outcome.EVENT_ORDER_MISMATCH,
    Outcome.BRANCH_ENDS_BEFORE_TARGET,
    Outcome.MESH_TOO_COARSE,
)
"""Outcomes of a search that may have missed a gait."""


@dataclass(frozen=True)
class FallbackOptions:
    """Options of finer meshes, which are fallbacks of the search for gaits of the paper's model."""

    refine_above: float = 1e-7
    """Estimate of the mesh error above which a finer mesh is used.

    It is chosen because the errors themselves are a hundredth of the estimate.
    """
    max_refinements: int = 3
    """Largest number of times that the number of mesh intervals is doubled."""


FALLBACK_OPTIONS = FallbackOptions()

FailureValue = Literal["zeros", "nan"]
FAILURE_VALUES: tuple[str, ...] = get_args(FailureValue)

GaitChoice = Literal["slowest", "fastest"] | int
"""Choice among the attracting gaits of a wheel, by speed: the slowest, the fastest, or an index,
slowest first."""


@overload
def limit_cycle(
    params: WheelParams,
    *,
    guess: Guess | None = None,
    period_n: int = 1,
    model: None = None,
    options: CycleOptions | StepOptions | None = None,
    on_failure: FailureValue = "zeros",
    which: GaitChoice = "slowest",
) -> LimitCycle: ...


@overload
def limit_cycle(
    params: WheelParams,
    *,
    guess: Guess | None = None,
    period_n: int = 1,
    model: ModelLike,
    options: CycleOptions | StepOptions | None = None,
    on_failure: FailureValue = "zeros",
    which: GaitChoice = "slowest",
) -> LimitCycle | ReturnMapCycle: ...


@with_default_settings
@raise_for_renamed_arguments(lost="on_failure")
def limit_cycle(
    params: WheelParams,
    *,
    guess: Guess | None = None,
    period_n: int = 1,
    model: ModelLike | None = None,
    options: CycleOptions | StepOptions | None = None,
    on_failure: FailureValue = "zeros",
    which: GaitChoice = "slowest",
) -> LimitCycle | ReturnMapCycle:
    """Return the limit cycle of this wheel: the gait that repeats after `period_n` steps.

    For `period_n` 1 no start is needed. With a `guess`, a neighbor's cycle or a section state
    (theta-, dtheta-, dL1-) near the gait, the search is faster and selects that branch. Found
    cycles satisfy the paper's sequence of phases at all nodes, stable or not. Errors are 1e-9
    relative in values and 1e-8 in first derivatives. Without `options` the mesh is made as fine as
    these errors require. With `options` the mesh is fixed, and `mesh_error` estimates its error.
    The cycle is differentiable in every mode and order.

    If the search fails, walks and finer meshes are tried. Under `jax.jit` and `jax.vmap` neither is
    possible; the search then runs alone, on the mesh of the options. See `limit_cycles`.

    If no gait is found, `outcome` and `why` give the reason, and numbers and derivatives
    are zero. With `on_failure="nan"` they are NaN, so that an optimization loop does not stop
    unnoticed.

    For any other model, the fixed point of its return map is computed, with the `StepOptions` of
    its step. The result is a `ReturnMapCycle` with the errors of the step. With unilateral contact
    several gaits may attract. Without a `guess`, walks from a stated set of starts distinguish them
    (`cycles.gait_walks`). `which` selects the "slowest", the "fastest" or an index in their
    list, slowest first. `limit_cycles` returns all. Model "auto" selects the lowest model whose
    margins the gait meets on its ground. A `LimitCycle` then belongs to the paper's model, a
    `ReturnMapCycle` to unilateral contact.

    Args:
        params: the wheel.
        guess: a neighbor's cycle, or a section state near the gait; a cycle that was not found
            counts as no guess.
        period_n: number of steps after which the gait repeats.
        model: the model; the paper's, `ViscoelasticWheel()`, by default.
        options: `CycleOptions`; for other models `StepOptions`.
        on_failure: values where there is no gait, "zeros" or "nan".
        which: with unilateral contact "slowest", "fastest", or an index in the list, slowest first.

    Returns:
        A `LimitCycle`; a `ReturnMapCycle` for other models.

    Raises:
        TypeError, ValueError: if an argument is invalid; the message names the remedy.

    Examples:
        >>> cycle = vrw.limit_cycle(vrw.WheelParams())
        >>> print(f"{cycle.dls_fraction:.4f} {cycle.speed:.4f} m/s")
        0.5315 0.8700 m/s
        >>> gradient = jax.grad(lambda p: vrw.limit_cycle(p).dls_fraction)(vrw.WheelParams())
        >>> print(f"{gradient.damping:.6f} per N s/m")
        0.000115 per N s/m
    """
    parse_gait_choice(which)
    model = resolve_model(params, model)
    finder = resolve_finder(params, model, options, check_int("period_n", period_n))
    uses_nan = check_choice("on_failure", on_failure, FAILURE_VALUES) == "nan"
    if guess is None and period_n > 1 and not finder.is_multistable:
        raise ValueError(
            f"period_n is {period_n} and there is no guess, but a gait of several steps is one of "
            "many beside the gait of one step: give guess=, a section state near it."
        )
    cycle: Any = _search_with_fallbacks(finder, params, check_guess(guess), options is None, which)
    return cycle.replace_missing_by_nan(params) if uses_nan else cycle


@with_default_settings
def limit_cycles(
    params: WheelParams,
    *,
    period_n: int = 1,
    model: ModelLike | None = None,
    options: CycleOptions | StepOptions | None = None,
    which: GaitChoice = "slowest",
) -> LimitCycle | ReturnMapCycle:
    """Return `limit_cycle` of a batch of wheels. Fields of `params` and of the result have one
    leading axis.

    All cycles are computed on one mesh, as fine as any of them needs. For a single wheel with
    unilateral contact, return all attracting gaits, slowest first.

    Args:
        params: the wheels; fields are scalars or of shape (wheels,).
        period_n: number of steps after which the gaits repeat.
        model: the model; the paper's, `ViscoelasticWheel()`, by default.
        options: as in `limit_cycle`.
        which: as in `limit_cycle`, for batches.

    Returns:
        A `LimitCycle` or `ReturnMapCycle` whose fields have a leading axis over wheels.

    Raises:
        TypeError, ValueError: if an argument is invalid; the message names the remedy.

    Examples:
        >>> cycles = vrw.limit_cycles(vrw.WheelParams(damping=np.array([100.0, 150.0, 300.0])))
        >>> cycles.found.tolist(), cycles.period.round(3).tolist()
        ([True, True, False], [0.595, 0.6980000000000001, 0.0])
    """
    check_type("params", params, WheelParams, "write vrw.WheelParams(damping=...)")
    parse_gait_choice(which)
    shape = np.broadcast_shapes(*(np.shape(x) for x in jax.tree.leaves(params)))
    if not shape:
        model = resolve_model(params, model)
        finder = resolve_finder(params, model, options, check_int("period_n", period_n))
        if finder.is_multistable:
            check_not_traced("vrw.limit_cycles", "give vrw.limit_cycle a guess", params)
            return find_attracting_gaits(finder, finder.model.parameter_values(params)[None])[1]
    if len(shape) != 1:
        raise ValueError(f"the wheels' batch has shape {shape}, but it must have one axis.")
    if shape == (0,):
        invalid_params = jax.tree.map(lambda x: jnp.full((1,), jnp.nan, x.dtype), params)
        missing_cycle = limit_cycles(
            invalid_params, period_n=period_n, model=model, options=options, which=which
        )
        return _take_rows_on_device(missing_cycle, slice(0, 0))
    if is_traced(params):
        params = jax.tree.map(lambda x: jnp.broadcast_to(x, shape), params)
        single_params = jax.tree.map(lambda x: x[0], params)
    else:  # NumPy is used because JAX would compile a program for each batch size.
        params = jax.tree.map(lambda x: np.broadcast_to(np.asarray(x), shape), params)
        params, single_params = jax.device_put((params, take_rows(params, 0)))
    finder = resolve_finder(single_params, model, options, check_int("period_n", period_n))
    cycle: Any = _search_with_fallbacks(finder, params, None, options is None, which)
    return cycle


def parse_gait_choice(which: GaitChoice) -> int:
    """Return the index of the chosen gait in a list of gaits, slowest first."""
    if isinstance(which, str):
        return 0 if check_choice("which", which, ("slowest", "fastest")) == "slowest" else -1
    if not check_real("which", which).is_integer():
        raise ValueError(
            f"which is {which!r}, but it selects one of a wheel's gaits: give 'slowest', "
            "'fastest' or an index in vrw.limit_cycles(params, model=...)."
        )
    return int(which)


def _select_gait(finder: Any, params: WheelParams, which: GaitChoice) -> Any:
    """Return the attracting gait that `which` selects for each wheel."""
    n_wheels, gait_rank = params.damping.shape[0], parse_gait_choice(which)
    wheel_index, gaits = find_attracting_gaits(
        finder, jax.vmap(finder.model.parameter_values)(params)
    )
    n_gaits_per_wheel = np.bincount(wheel_index, minlength=n_wheels)
    has_too_few_gaits = n_gaits_per_wheel[
        (gait_rank >= n_gaits_per_wheel) | (gait_rank < -n_gaits_per_wheel)
    ]
    if len(has_too_few_gaits):
        n_gaits = int(has_too_few_gaits[0])
        raise ValueError(
            f"which is {which}, but {n_gaits} gait{'s' * (n_gaits > 1)} of this wheel attract"
            f"{'s' * (n_gaits == 1)}: vrw.limit_cycles(params, model=...) returns them."
        )
    return _take_rows_on_device(
        gaits, find_slowest_indices(wheel_index, n_wheels) + gait_rank % n_gaits_per_wheel
    )


def _search_with_fallbacks(
    finder: Any, params: WheelParams, guess: Any, refines_mesh: bool, which: GaitChoice
) -> Any:
    """Return the cycle of one wheel or of a batch, by the search and all fallbacks."""
    is_batch = params.damping.ndim > 0
    params_without_tangents = lax.stop_gradient(params)
    is_traced_value, is_concrete = is_traced(params_without_tangents), not is_traced(params)
    if finder.is_multistable and guess is None and not is_traced_value:
        cycle = _select_gait(
            finder,
            params_without_tangents
            if is_batch
            else _take_rows_on_device(params_without_tangents, None),
            which,
        )
        cycle = cycle if is_batch else _take_rows_on_device(cycle, 0)
        return cycle if is_concrete else _search(finder, params, cycle.section_state)
    cycle = _search(finder, params, guess)
    params_and_cycle = lax.stop_gradient((params, cycle))  # Differentiated arrays have values, too.
    if not finder.supports_cold_start or is_traced(params_and_cycle):
        return cycle
    if not is_batch:
        params_and_cycle = _take_rows_on_device(params_and_cycle, None)
    section_state = None
    if guess is not None:
        section_state = np.asarray(lax.stop_gradient(_guess_section_state(guess)))[None]
    fallback = _fallback_starts(finder, *params_and_cycle, section_state, refines_mesh)
    if finder.period_n > 1 and section_state is not None:
        if fallback is None:
            fallback = _retry_from_other_steps(finder, *params_and_cycle, section_state)
        fallback = _align_first_step(finder, *params_and_cycle, section_state, fallback)
    if fallback is None:
        return cycle
    finder, collocation_state = fallback
    if is_concrete:
        retried_cycle = map_in_batches(
            finder.find_cycles, batch_sizes.GAIT_BATCH_SIZES, params_and_cycle[0], collocation_state
        )  # a compiled program
        retried_cycle = retried_cycle if is_batch else _take_rows_on_device(retried_cycle, 0)
    else:
        retried_cycle = _search(
            finder,
            params,
            jax.device_put(collocation_state)
            if is_batch
            else _take_rows_on_device(collocation_state, 0),
        )
    return _keep_first_reason(cycle, retried_cycle)


def _keep_first_reason(cycle: LimitCycle, retried_cycle: LimitCycle) -> LimitCycle:
    """Return the cycles of the retry; a wheel without a gait keeps the reason of the first search.

    All functions therefore report the same reason, with or without fallbacks, and in any batch.
    """
    get_reason = lambda x: (x.outcome, x.collocation_state.failed_check)
    first_reason, last_reason = get_reason(cycle), get_reason(retried_cycle)
    select_array: Any = jnp.where
    if not is_traced((first_reason, last_reason)):  # numpy compiles nothing for a new batch size
        first_reason, last_reason = jax.tree.map(np.asarray, (first_reason, last_reason))
        select_array = lambda *arrays: jax.device_put(np.where(*arrays))
    is_missing = (first_reason[0] != Outcome.STEPPED) & (last_reason[0] != Outcome.STEPPED)
    reason = [
        select_array(is_missing, *pair) for pair in zip(first_reason, last_reason, strict=True)
    ]
    return eqx.tree_at(get_reason, retried_cycle, tuple(reason))


def _search(finder: AbstractGaitFinder, params: WheelParams, guess: Any) -> Any:
    """Return the cycle of one wheel, or the cycles of a batch."""
    if not params.damping.ndim:
        return finder.find_cycle(params, guess)
    if guess is not None or is_traced(params):
        return finder.find_cycles(params, guess)
    return map_in_batches(finder.find_cycles, batch_sizes.GAIT_BATCH_SIZES, params)


def _take_rows_on_device(tree: Any, row_indices: Any) -> Any:
    """Return rows of a tree on the device, selected by NumPy because JAX would compile a program
    for each shape.
    """
    return jax.device_put(take_rows(tree, row_indices))


def _stack_known_parameters(params: WheelParams) -> np.ndarray:
    """Return `stack_parameters` of a batch by numpy, for the same reason."""
    return np.stack([np.asarray(getattr(params, name)) for name in PARAMETER_NAMES])


def _replace_rows(tree: Any, row_indices: np.ndarray, values: Any) -> Any:
    """Return a tree of arrays with these rows replaced by `values`."""

    def replace_leaf_rows(leaf: Any, new_rows: Any) -> np.ndarray:
        leaf = np.array(leaf)
        leaf[row_indices] = new_rows
        return leaf

    return jax.tree.map(replace_leaf_rows, tree, values)


def _walk_from_all_starts(
    finder: CollocationFinder,
    params: WheelParams,
    needs_walk: np.ndarray,
    guess_states: np.ndarray | None,
) -> np.ndarray:
    """Return the ends of the walks with the smallest period defects, from all starts of the wheels
    that need a walk.

    The ends are section states, (wheels, 3), NaN if no walk of the wheel nearly repeats. A guess
    that nearly repeats replaces the walks of its wheel. Wheels too stiff for explicit solvers do
    not walk, because the walks of one such wheel would take minutes with an implicit solver.
    """
    parameter_rows = _stack_known_parameters(params)
    is_explicit = select_solver(parameter_rows, StepOptions()) != SolverIndex.IMPLICIT
    wheel_indices = np.flatnonzero(needs_walk & is_explicit)
    values, end_states = parameter_rows.T, np.full((len(needs_walk), 3), np.nan)
    smallest_defect = np.full(len(needs_walk), GAIT_WALK_OPTIONS.start_defect)
    if guess_states is not None:
        states = guess_states[wheel_indices]
        is_usable = (
            measure_period_defect(finder, values[wheel_indices], states)
            < GAIT_WALK_OPTIONS.start_defect
        )
        end_states[wheel_indices[is_usable]] = states[is_usable]
        wheel_indices = wheel_indices[~is_usable]
    for compute_starts in (compute_walk_starts, compute_fallback_starts):
        if not len(wheel_indices):
            break
        walk_ends = walk_to_gaits(finder, values[wheel_indices], compute_starts)
        for wheel, state, period_defect in zip(
            wheel_indices[walk_ends.wheel_index], *walk_ends[1:], strict=True
        ):
            if period_defect < smallest_defect[wheel]:
                smallest_defect[wheel], end_states[wheel] = period_defect, state
        is_unsettled = smallest_defect[wheel_indices] >= GAIT_WALK_OPTIONS.settled_defect
        wheel_indices = wheel_indices[is_unsettled]
    return end_states


def _initial_guesses(
    finder: CollocationFinder,
    params: WheelParams,
    collocation_state: CollocationState,
    has_state: np.ndarray,
    walk_end_states: np.ndarray,
) -> CollocationState:
    """Return the starts of searches: the known states, else states from walks, else predictions
    of the surface.
    """
    guesses = map_in_batches(
        lambda batch_params: finder.initial_guesses(stack_parameters(batch_params).T),
        batch_sizes.GAIT_BATCH_SIZES,
        params,
    )
    walk_indices = np.flatnonzero(np.isfinite(walk_end_states[:, 0]) & ~has_state)
    if len(walk_indices):
        guess_from_state = jax.vmap(finder.guess_from_state)
        guesses = _replace_rows(
            guesses,
            walk_indices,
            map_in_batches(
                guess_from_state,
                batch_sizes.GAIT_BATCH_SIZES,
                _take_rows_on_device(params, walk_indices),
                walk_end_states[walk_indices],
            ),
        )
    return _replace_rows(guesses, has_state, _take_rows_on_device(collocation_state, has_state))


def _fallback_starts(
    finder: CollocationFinder,
    params: WheelParams,
    cycle: LimitCycle,
    guess_states: np.ndarray | None,
    refines_mesh: bool,
    options: FallbackOptions = FALLBACK_OPTIONS,
) -> tuple[CollocationFinder, CollocationState] | None:
    """Return a finder and starts from which it finds more gaits of a batch, or None if there are
    none.

    `guess_states` are the section states of guesses, (wheels, 3). `refines_mesh` allows a finer
    mesh.
    """
    outcome = np.asarray(cycle.outcome)
    mesh_error = map_in_batches(lambda x: x.mesh_error, batch_sizes.GAIT_BATCH_SIZES, cycle)
    has_large_mesh_error = refines_mesh & (np.asarray(mesh_error) > options.refine_above)
    is_missing = np.isin(outcome, RETRY_OUTCOMES)
    is_unresolved = is_missing | has_large_mesh_error
    if not is_unresolved.any():
        return None
    walk_end_states = _walk_from_all_starts(finder, params, is_missing, guess_states)
    # The best start of each wheel so far was found by a search, on the mesh of `finder`.
    collocation_state, has_state = cycle.collocation_state, has_large_mesh_error.copy()
    is_coarse = outcome == Outcome.MESH_TOO_COARSE
    best_result = None
    for refinement_index in range(1 + options.max_refinements * refines_mesh):
        if refinement_index:
            coarser_finder, finder = finder, finder.with_finer_mesh()
            transfer_solution = jax.vmap(
                functools.partial(finder.transfer_to_mesh, coarser_finder.system)
            )
            collocation_state = map_in_batches(
                transfer_solution, batch_sizes.GAIT_BATCH_SIZES, collocation_state
            )
        # The search without walks has used this mesh already. One finer mesh is always tried.
        is_promising = (
            np.isfinite(walk_end_states[:, 0])
            | has_state
            | (is_coarse & (refinement_index > 0))
            | (refinement_index == 1)
        )
        wheel_indices = np.flatnonzero(is_unresolved & is_promising)
        if not len(wheel_indices):
            continue
        subset_params = _take_rows_on_device(params, wheel_indices)
        guesses = _initial_guesses(
            finder,
            subset_params,
            _take_rows_on_device(collocation_state, wheel_indices),
            has_state[wheel_indices],
            walk_end_states[wheel_indices],
        )
        retried_cycle = map_in_batches(
            finder.find_cycles, batch_sizes.GAIT_BATCH_SIZES, subset_params, guesses
        )
        is_found = np.asarray(retried_cycle.outcome) == Outcome.STEPPED
        mesh_error = np.asarray(
            map_in_batches(lambda x: x.mesh_error, batch_sizes.GAIT_BATCH_SIZES, retried_cycle)
        )
        collocation_state = _replace_rows(
            collocation_state,
            wheel_indices[is_found],
            _take_rows_on_device(retried_cycle.collocation_state, is_found),
        )
        if is_found.any():
            best_result = finder, collocation_state
        has_state[wheel_indices[is_found]] = True
        is_coarse[wheel_indices] = np.asarray(retried_cycle.outcome) == Outcome.MESH_TOO_COARSE
        is_unresolved[
            wheel_indices[is_found & ((mesh_error <= options.refine_above) | (not refines_mesh))]
        ] = False
    return best_result


def retry_from_walks(finder: Any, params: WheelParams, search_result: LimitCycle) -> LimitCycle:
    """Return the search's result, with cycles from walks for wheels without a cycle, on the same
    mesh.
    """
    fallback = _fallback_starts(finder, params, search_result, None, refines_mesh=False)
    if fallback is None:
        return search_result
    retried_cycle = map_in_batches(
        finder.find_cycles, batch_sizes.GAIT_BATCH_SIZES, params, fallback[1]
    )
    return _keep_first_reason(search_result, retried_cycle)


def _guess_section_state(guess: Any) -> Any:
    """Return the section state of a guess, which is a cycle, a `CollocationState` or a section
    state.
    """
    if isinstance(guess, CollocationState):
        return guess.ends[-1][jnp.array([0, 2, 3])]
    return getattr(guess, "section_state", guess)


def _retry_from_other_steps(
    finder: CollocationFinder, params: WheelParams, cycle: LimitCycle, section_states: np.ndarray
) -> tuple[CollocationFinder, CollocationState] | None:
    """Return a finder and the same orbits, found with another of their steps as the first one; None
    if none is found.

    A guess contains the accelerations of all steps, whose errors accumulate. A step without double
    support is the most sensitive one. As the first or last step it may make the guess fail.
    """
    missing_indices = np.flatnonzero(np.isin(np.asarray(cycle.outcome), RETRY_OUTCOMES))
    if not len(missing_indices):
        return None
    subset_params = _take_rows_on_device(params, missing_indices)
    section_states = np.array(section_states[missing_indices])
    best_result = None
    collocation_state = cycle.collocation_state
    for _ in range(1, finder.period_n):
        section_states = np.asarray(
            step_batch(subset_params, section_states, model=finder.model).section_state
        )
        retried_cycle = map_in_batches(
            finder.find_cycles, batch_sizes.GAIT_BATCH_SIZES, subset_params, section_states
        )
        found_indices = np.flatnonzero(
            np.asarray(retried_cycle.found)
            & (np.asarray(collocation_state.found)[missing_indices] < 0.5)
        )
        if len(found_indices):
            collocation_state = _replace_rows(
                collocation_state,
                missing_indices[found_indices],
                _take_rows_on_device(retried_cycle.collocation_state, found_indices),
            )
            best_result = finder, collocation_state
    return best_result


def _align_first_step(
    finder: CollocationFinder,
    params: WheelParams,
    cycle: LimitCycle,
    first_states: np.ndarray,
    fallback: tuple[CollocationFinder, CollocationState] | None,
) -> tuple[CollocationFinder, CollocationState] | None:
    """Return a finder and the same orbits with the step nearest to `first_states` as the first
    one.
    """
    finder, collocation_state = fallback or (finder, cycle.collocation_state)
    ends = np.asarray(collocation_state.ends)[:, :, [0, 2, 3]]
    distances = np.abs(np.roll(ends, 1, axis=1) - first_states[:, None]).max(-1)
    distances = np.where(np.asarray(collocation_state.found)[:, None] > 0.5, distances, 0.0)
    for step_index in range(1, finder.period_n):
        indices = np.flatnonzero(np.argmin(distances, 1) == step_index)
        if len(indices):
            shift_step = jax.vmap(functools.partial(finder.shift_first_step, step_index))
            collocation_state = _replace_rows(
                collocation_state,
                indices,
                shift_step(
                    _take_rows_on_device(params, indices),
                    _take_rows_on_device(collocation_state, indices),
                ),
            )
            fallback = finder, collocation_state
    return fallback
