"""Search for limit cycles, with finer meshes and walks as fallbacks.

The search in `collocation_search` starts from predicted gaits for the paper's parameter ranges, on
a mesh that suits these gaits. If it fails, batches of walks (`models.step_batch`) begin at starts
that scale with the wheel. The end of a walk that settles is the start of another search. If the
mesh is too coarse, it is refined. These fallbacks depend on concrete values. Under a caller's `jit`
or `vmap`, only the search runs.
"""

import functools
from typing import Any, Literal, get_args, overload

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from vrw_jax.base import batch_sizes
from vrw_jax.base.checks import (
    check_choice,
    check_real,
    check_type,
    has_traced_leaf,
    require_untraced_arguments,
)
from vrw_jax.base.options import StepOptions
from vrw_jax.base.progress import announce_wait
from vrw_jax.flow.hybrid_system import HybridSystem
from vrw_jax.gaits.attracting_gaits import find_attracting_gaits, find_slowest_gait_indices
from vrw_jax.gaits.collocation_finder import CollocationFinder
from vrw_jax.gaits.collocation_search import CollocationState
from vrw_jax.gaits.cycle import LAST_GAIT_DESCRIBERS, RETRY_OUTCOMES
from vrw_jax.gaits.finder import AbstractGaitFinder
from vrw_jax.gaits.finder_selection import (
    UserCycleGuess,
    check_cycle_guess,
    resolve_finder,
    resolve_model,
)
from vrw_jax.gaits.gait_walks import (
    MAX_NEWTON_START_DEFECT,
    MAX_SETTLED_DEFECT,
    compute_fallback_walk_starts,
    compute_walk_starts,
    measure_period_defects,
    walk_to_gaits,
)
from vrw_jax.gaits.hybrid_gait import HybridGait, find_hybrid_gait
from vrw_jax.gaits.last_gait import describe_last_gait
from vrw_jax.gaits.limit_cycle_result import LimitCycle, transfer_solution_to_mesh
from vrw_jax.gaits.options import CycleOptions
from vrw_jax.gaits.return_map_finder import ReturnMapCycle
from vrw_jax.lanes.batching import map_in_batches, select_tree_rows
from vrw_jax.lanes.settings import with_default_jax_settings
from vrw_jax.models.batch_stiffness import SolverIndex, select_cheapest_solver
from vrw_jax.models.step_batch import step_batch
from vrw_jax.models.stepping import ModelLike
from vrw_jax.wheel.outcomes import Outcome
from vrw_jax.wheel.params import PARAMETER_NAMES, WheelParams, stack_parameters

FailureFillName = Literal["zeros", "nan"]
FAILURE_FILLS: tuple[str, ...] = get_args(FailureFillName)

GaitChoice = Literal["slowest", "fastest"] | int
"""Choice among the attracting gaits of a wheel: the slowest, the fastest, or an index.

Index 0 selects the slowest gait, and speed increases with the index.
"""


@overload
def limit_cycle(
    params: WheelParams,
    *,
    guess: UserCycleGuess | None = None,
    period_n: int = 1,
    model: None = None,
    options: CycleOptions | StepOptions | None = None,
    on_failure: FailureFillName = "zeros",
    which: GaitChoice = "slowest",
) -> LimitCycle: ...


@overload
def limit_cycle(
    params: WheelParams,
    *,
    guess: UserCycleGuess | None = None,
    period_n: int = 1,
    model: ModelLike,
    options: CycleOptions | StepOptions | None = None,
    on_failure: FailureFillName = "zeros",
    which: GaitChoice = "slowest",
) -> LimitCycle | ReturnMapCycle: ...


@overload
def limit_cycle(
    params: Any,
    *,
    guess: Any,
    period_n: int = 1,
    model: HybridSystem,
    options: StepOptions | None = None,
) -> HybridGait: ...


@with_default_jax_settings
@announce_wait("the search for a gait", "10 s, or 50 s if it finds no gait")
def limit_cycle(
    params: Any,
    *,
    guess: Any = None,
    period_n: int = 1,
    model: ModelLike | HybridSystem | None = None,
    options: CycleOptions | StepOptions | None = None,
    on_failure: FailureFillName = "zeros",
    which: GaitChoice = "slowest",
) -> LimitCycle | ReturnMapCycle | HybridGait:
    """Find the limit cycle of a wheel: the gait that repeats after `period_n` gait steps.

    For `period_n` 1 no start is needed. A `guess` is the cycle of a similar wheel, or a section
    state (theta-, dtheta-, dL1-) near the gait. It makes the search faster and selects a branch.
    Each returned cycle, stable or not, satisfies the paper's sequence of phases at all nodes.
    Relative errors are 1e-9 in values and 1e-8 in first derivatives. Without `options` the mesh is
    made as fine as these errors require. With `options` the mesh is fixed, and `mesh_error`
    estimates its error. The cycle is differentiable in every mode and to every order.

    If the search fails, walks and finer meshes are used. Under `jax.jit` and `jax.vmap` this is not
    possible. Only the search then runs, on the mesh of the options. See `limit_cycles`.

    If no gait is found, `outcome` and `why` contain the reason, and numbers and derivatives are
    zero. With `on_failure="nan"` they are NaN, so that an optimization loop does not stop
    unnoticed.

    For any model other than the paper's, the fixed point of its return map is computed, with the
    `StepOptions` of its gait step. The result is a `ReturnMapCycle`, whose errors are those of the
    gait step. With unilateral contact a wheel may have several attracting gaits. Without a `guess`,
    walks from fixed starts find these gaits (`cycles.gait_walks`). `which` then selects the
    "slowest" gait, the "fastest" gait, or an index in the order of increasing speed. `limit_cycles`
    returns all attracting gaits. Model "auto" selects the lowest model whose margins are positive
    for the gait on its ground. A `LimitCycle` then belongs to the paper's model, a `ReturnMapCycle`
    to unilateral contact.

    For a `HybridSystem`, `params` are its parameters, and Newton's method starts at the `guess`,
    section coordinates near the gait. The result is a `HybridGait`.

    Args:
        params: the wheel.
        guess: a similar wheel's cycle, or a section state near the gait; a cycle that was not found
            is ignored.
        period_n: number of gait steps after which the gait repeats.
        model: the model; the paper's, `ViscoelasticWheel()`, by default.
        options: `CycleOptions`; for other models `StepOptions`.
        on_failure: values that are returned if there is no gait, "zeros" or "nan".
        which: with unilateral contact "slowest", "fastest", or an index in the order of increasing
            speed.

    Returns:
        A `LimitCycle`; a `ReturnMapCycle` for other models, a `HybridGait` for a `HybridSystem`.

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
    if isinstance(model, HybridSystem):
        return find_hybrid_gait(model, params, guess, period_n, options)
    model = resolve_model(params, model)
    gait_finder = resolve_finder(params, model, options, period_n)
    fills_missing_gait_with_nan = check_choice("on_failure", on_failure, FAILURE_FILLS) == "nan"
    if guess is None and period_n > 1 and not gait_finder.is_multistable:
        raise ValueError(
            f"period_n is {period_n} and there is no guess, but a gait of several steps is one of "
            "many beside the gait of one step: give guess=, a section state near it."
        )
    cycle = _search_with_fallbacks(
        gait_finder, params, check_cycle_guess(guess), options is None, which
    )
    return cycle.replace_missing_gaits_by_nan(params) if fills_missing_gait_with_nan else cycle


@with_default_jax_settings
@announce_wait("the search for gaits", "10 s, or 50 s if it finds no gait")
def limit_cycles(
    params: WheelParams,
    *,
    period_n: int = 1,
    model: ModelLike | None = None,
    options: CycleOptions | StepOptions | None = None,
    which: GaitChoice = "slowest",
) -> LimitCycle | ReturnMapCycle:
    """Find the limit cycles of a batch of wheels, as `limit_cycle` does for one wheel.

    Fields of `params` and of the result have one leading axis. All cycles are computed on one mesh,
    which is as fine as any of the cycles requires. For a single wheel with unilateral contact, all
    attracting gaits are returned, in the order of increasing speed.

    Args:
        params: the wheels; fields are scalars or of shape (wheels,).
        period_n: number of gait steps after which the gaits repeat.
        model: the model; the paper's, `ViscoelasticWheel()`, by default.
        options: as in `limit_cycle`.
        which: as in `limit_cycle`, for batches.

    Returns:
        A `LimitCycle` or `ReturnMapCycle` whose fields have a leading axis over the wheels.

    Raises:
        TypeError, ValueError: if an argument is invalid; the message names the remedy.

    Examples:
        >>> cycles = vrw.limit_cycles(vrw.WheelParams(damping=np.array([100.0, 150.0, 300.0])))
        >>> cycles.found.tolist(), cycles.period.round(3).tolist()
        ([True, True, False], [0.595, 0.6980000000000001, 0.0])
    """
    check_type("params", params, WheelParams, "write vrw.WheelParams(damping=...)")
    parse_gait_choice(which)
    batch_shape = np.broadcast_shapes(*(np.shape(x) for x in jax.tree.leaves(params)))
    if not batch_shape:
        model = resolve_model(params, model)
        gait_finder = resolve_finder(params, model, options, period_n)
        if gait_finder.is_multistable:
            require_untraced_arguments("vrw.limit_cycles", "give vrw.limit_cycle a guess", params)
            return find_attracting_gaits(
                gait_finder, gait_finder.model.collect_parameter_values(params)[None]
            )[1]
    if len(batch_shape) != 1:
        raise ValueError(f"the wheels' batch has shape {batch_shape}, but it must have one axis.")
    if batch_shape == (0,):
        invalid_params = jax.tree.map(lambda x: jnp.full((1,), jnp.nan, x.dtype), params)
        cycle_without_gait = limit_cycles(
            invalid_params, period_n=period_n, model=model, options=options, which=which
        )
        return _take_wheels_on_device(cycle_without_gait, slice(0, 0))
    if has_traced_leaf(params):
        params = jax.tree.map(lambda x: jnp.broadcast_to(x, batch_shape), params)
        first_wheel_params = jax.tree.map(lambda x: x[0], params)
    else:  # NumPy is used because JAX would compile a program for each batch size.
        params = jax.tree.map(lambda x: np.broadcast_to(np.asarray(x), batch_shape), params)
        params, first_wheel_params = jax.device_put((params, select_tree_rows(params, 0)))
    gait_finder = resolve_finder(first_wheel_params, model, options, period_n)
    return _search_with_fallbacks(gait_finder, params, None, options is None, which)


LAST_GAIT_DESCRIBERS[:] = [functools.partial(describe_last_gait, limit_cycle, limit_cycles)]


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


def _find_chosen_gaits(gait_finder: Any, params: WheelParams, gait_choice: GaitChoice) -> Any:
    n_wheels = len(params.damping)
    gait_rank = parse_gait_choice(gait_choice)
    gait_wheel_indices, attracting_gaits = find_attracting_gaits(
        gait_finder, gait_finder.model.collect_batch_parameter_values(params)
    )
    n_gaits_per_wheel = np.bincount(gait_wheel_indices, minlength=n_wheels)
    insufficient_gait_counts = n_gaits_per_wheel[
        (gait_rank >= n_gaits_per_wheel) | (gait_rank < -n_gaits_per_wheel)
    ]
    if len(insufficient_gait_counts):
        n_available_gaits = int(insufficient_gait_counts[0])
        raise ValueError(
            f"which is {gait_choice}, but {n_available_gaits} gait{'s' * (n_available_gaits > 1)} "
            f"of this wheel attract{'s' * (n_available_gaits == 1)}: "
            "vrw.limit_cycles(params, model=...) returns them."
        )
    return _take_wheels_on_device(
        attracting_gaits,
        find_slowest_gait_indices(gait_wheel_indices, n_wheels) + gait_rank % n_gaits_per_wheel,
    )


def _search_with_fallbacks(
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
    add_batch_axis = lambda tree: tree if has_batch_axis else _take_wheels_on_device(tree, None)
    drop_added_axis = lambda tree: tree if has_batch_axis else _take_wheels_on_device(tree, 0)
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
    cycle = _search_without_fallbacks(gait_finder, params, cycle_guess)
    # Differentiated arrays also have concrete values.
    params_and_cycle: tuple[WheelParams, Any] = lax.stop_gradient((params, cycle))
    if not gait_finder.supports_cold_start or has_traced_leaf(params_and_cycle):
        return cycle
    params_and_cycle = add_batch_axis(params_and_cycle)
    section_state = None
    if cycle_guess is not None:
        if isinstance(cycle_guess, CollocationState):
            guess_section_state = cycle_guess.gait_step_end_states[-1][jnp.array([0, 2, 3])]
        else:
            guess_section_state = getattr(cycle_guess, "section_state", cycle_guess)
        section_state = np.asarray(lax.stop_gradient(guess_section_state))[None]
    finder_and_starts = _find_fallback_starts(
        gait_finder, *params_and_cycle, section_state, can_refine_mesh
    )
    if gait_finder.period_n > 1 and section_state is not None:
        finder_and_starts = _choose_first_step(
            gait_finder, *params_and_cycle, section_state, finder_and_starts
        )
    if finder_and_starts is None:
        return cycle
    gait_finder, collocation_state = finder_and_starts
    if are_params_concrete:
        retried_cycle = drop_added_axis(
            map_in_batches(
                gait_finder.find_cycles,
                batch_sizes.GAIT_BATCH_SIZES,
                params_and_cycle[0],
                collocation_state,
            )
        )  # a compiled program
    else:
        retried_cycle = _search_without_fallbacks(
            gait_finder, params, jax.device_put(drop_added_axis(collocation_state))
        )
    return _restore_first_failure_reason(cycle, retried_cycle)


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
        lambda first, last: array_module.where(is_gait_missing, first, last),
        first_reason,
        last_reason,
    )
    return eqx.tree_at(get_failure_reason, retried_cycle, jax.device_put(failure_reason))


def _search_without_fallbacks(
    gait_finder: AbstractGaitFinder, params: WheelParams, cycle_guess: Any
) -> Any:
    if not params.damping.ndim:
        return gait_finder.find_cycle(params, cycle_guess)
    if cycle_guess is not None or has_traced_leaf(params):
        return gait_finder.find_cycles(params, cycle_guess)
    return map_in_batches(gait_finder.find_cycles, batch_sizes.GAIT_BATCH_SIZES, params)


def _take_wheels_on_device(tree_over_wheels: Any, wheel_indices: Any) -> Any:
    """Return the selected wheels of a tree as arrays on the device.

    NumPy selects the wheels, because JAX would compile a program for each shape.
    """
    return jax.device_put(select_tree_rows(tree_over_wheels, wheel_indices))


def _replace_wheels(
    tree_over_wheels: Any, wheel_indices: np.ndarray, tree_of_new_wheels: Any
) -> Any:

    def replace_wheel_rows(array_over_wheels: Any, array_of_new_wheels: Any) -> np.ndarray:
        array_over_wheels = np.array(array_over_wheels)
        array_over_wheels[wheel_indices] = array_of_new_wheels
        return array_over_wheels

    return jax.tree.map(replace_wheel_rows, tree_over_wheels, tree_of_new_wheels)


def _find_walk_end_states(
    gait_finder: CollocationFinder,
    params: WheelParams,
    is_walk_needed: np.ndarray,
    guess_states_by_wheel: np.ndarray | None,
) -> np.ndarray:
    """Return for each wheel the state at the end of its walk with the smallest period defect.

    The states are section states, shape (wheels, 3). A state is NaN if no walk of the wheel nearly
    repeats, or if the wheel requires no walk. If a guess nearly repeats, it is returned instead of
    the end of a walk. No walks are computed for wheels that are too stiff for explicit solvers.
    With an implicit solver, the walks of one such wheel would take minutes.
    """
    # NumPy is used, because JAX would compile a program for each number of wheels.
    parameter_matrix = np.stack([np.asarray(getattr(params, name)) for name in PARAMETER_NAMES])
    solver_indices = select_cheapest_solver(parameter_matrix, StepOptions())
    is_solver_explicit = solver_indices != SolverIndex.IMPLICIT_SOLVER
    unsettled_wheel_indices = np.flatnonzero(is_walk_needed & is_solver_explicit)
    parameter_values = parameter_matrix.T
    walk_end_states = np.full((len(is_walk_needed), 3), np.nan)
    smallest_period_defects = np.full(len(is_walk_needed), MAX_NEWTON_START_DEFECT)
    if guess_states_by_wheel is not None:
        guess_states = guess_states_by_wheel[unsettled_wheel_indices]
        guess_defects = measure_period_defects(
            gait_finder, parameter_values[unsettled_wheel_indices], guess_states
        )
        is_guess_usable = guess_defects < MAX_NEWTON_START_DEFECT
        walk_end_states[unsettled_wheel_indices[is_guess_usable]] = guess_states[is_guess_usable]
        unsettled_wheel_indices = unsettled_wheel_indices[~is_guess_usable]
    for start_state_function in (compute_walk_starts, compute_fallback_walk_starts):
        if not len(unsettled_wheel_indices):
            break
        wheel_indices, *walk_ends = walk_to_gaits(
            gait_finder, parameter_values[unsettled_wheel_indices], start_state_function
        )
        for wheel_index, walk_end_state, period_defect in zip(
            unsettled_wheel_indices[wheel_indices], *walk_ends, strict=True
        ):
            if period_defect < smallest_period_defects[wheel_index]:
                smallest_period_defects[wheel_index] = period_defect
                walk_end_states[wheel_index] = walk_end_state
        has_not_settled = smallest_period_defects[unsettled_wheel_indices] >= MAX_SETTLED_DEFECT
        unsettled_wheel_indices = unsettled_wheel_indices[has_not_settled]
    return walk_end_states


def _make_search_starts(
    gait_finder: CollocationFinder,
    params: WheelParams,
    collocation_state: CollocationState,
    has_known_state: np.ndarray,
    walk_end_states: np.ndarray,
) -> CollocationState:
    """Return the start of the search for each wheel.

    - `collocation_state`: starts of the wheels for which `has_known_state` is true;
    - `walk_end_states`: section states, NaN if a wheel has none. They are the starts of wheels
      without a known state.

    The gait surface predicts the starts of all remaining wheels.
    """
    start_states = map_in_batches(
        lambda batch_params: gait_finder.make_initial_guesses(stack_parameters(batch_params).T),
        batch_sizes.GAIT_BATCH_SIZES,
        params,
    )
    wheels_with_walk = np.flatnonzero(np.isfinite(walk_end_states[:, 0]) & ~has_known_state)
    if len(wheels_with_walk):
        start_states = _replace_wheels(
            start_states,
            wheels_with_walk,
            map_in_batches(
                jax.vmap(gait_finder.guess_cycle_from_state),
                batch_sizes.GAIT_BATCH_SIZES,
                _take_wheels_on_device(params, wheels_with_walk),
                walk_end_states[wheels_with_walk],
            ),
        )
    return _replace_wheels(
        start_states, has_known_state, _take_wheels_on_device(collocation_state, has_known_state)
    )


# Estimated mesh error above which a finer mesh is used. The value is chosen because actual errors
# are a hundredth of the estimate.
MAX_UNREFINED_MESH_ERROR = 1e-7


def _has_large_mesh_error(cycle: LimitCycle) -> np.ndarray:
    """Return for each wheel whether its mesh error is too large without a finer mesh."""
    mesh_errors = map_in_batches(
        lambda cycle: cycle.mesh_error, batch_sizes.GAIT_BATCH_SIZES, cycle
    )
    return np.asarray(mesh_errors) > MAX_UNREFINED_MESH_ERROR


# Largest number of times that the number of mesh intervals is doubled.
MAX_SEARCH_MESH_REFINEMENTS = 3


def _find_fallback_starts(
    gait_finder: CollocationFinder,
    params: WheelParams,
    cycle: LimitCycle,
    guess_states_by_wheel: np.ndarray | None,
    can_refine_mesh: bool,
) -> tuple[CollocationFinder, CollocationState] | None:
    """Return a finder and the starts from which it finds more gaits of a batch.

    The result is None if no more gaits are found.

    - `guess_states_by_wheel`: section states of the user's guesses, shape (wheels, 3);
    - `can_refine_mesh`: whether a finer mesh may be used.
    """
    search_outcomes = np.asarray(cycle.outcome)
    has_large_mesh_error = can_refine_mesh & _has_large_mesh_error(cycle)
    is_gait_missing = np.isin(search_outcomes, RETRY_OUTCOMES)
    needs_better_gait = is_gait_missing | has_large_mesh_error
    if not needs_better_gait.any():
        return None
    walk_end_states = _find_walk_end_states(
        gait_finder, params, is_gait_missing, guess_states_by_wheel
    )
    # `collocation_state` contains the best start so far of each wheel, on the last finder's mesh.
    collocation_state = cycle.collocation_state
    has_known_state = has_large_mesh_error.copy()
    is_mesh_too_coarse = search_outcomes == Outcome.MESH_TOO_COARSE
    best_finder_and_starts = None
    n_refinements = MAX_SEARCH_MESH_REFINEMENTS if can_refine_mesh else 0
    for refinement_index in range(1 + n_refinements):
        if refinement_index:
            coarser_finder = gait_finder
            gait_finder = coarser_finder.with_finer_mesh()
            transfer_solution = functools.partial(
                transfer_solution_to_mesh,
                coarser_finder.collocation_system,
                gait_finder.collocation_system,
            )
            collocation_state = collocation_state._replace(
                solution=map_in_batches(
                    jax.vmap(transfer_solution),
                    batch_sizes.GAIT_BATCH_SIZES,
                    collocation_state.solution,
                )
            )
        # The search without walks has already used this mesh. One finer mesh is always used.
        is_retry_promising = (
            np.isfinite(walk_end_states[:, 0])
            | has_known_state
            | (is_mesh_too_coarse & (refinement_index > 0))
            | (refinement_index == 1)
        )
        retried_wheel_indices = np.flatnonzero(needs_better_gait & is_retry_promising)
        if not len(retried_wheel_indices):
            continue
        retried_params = _take_wheels_on_device(params, retried_wheel_indices)
        start_states = _make_search_starts(
            gait_finder,
            retried_params,
            _take_wheels_on_device(collocation_state, retried_wheel_indices),
            has_known_state[retried_wheel_indices],
            walk_end_states[retried_wheel_indices],
        )
        retried_cycle = map_in_batches(
            gait_finder.find_cycles, batch_sizes.GAIT_BATCH_SIZES, retried_params, start_states
        )
        # JAX would compile a comparison for every number of wheels.
        retried_outcomes = np.asarray(retried_cycle.outcome)
        is_gait_found = retried_outcomes == Outcome.STEPPED
        found_wheel_indices = retried_wheel_indices[is_gait_found]
        collocation_state = _replace_wheels(
            collocation_state,
            found_wheel_indices,
            _take_wheels_on_device(retried_cycle.collocation_state, is_gait_found),
        )
        if len(found_wheel_indices):
            best_finder_and_starts = gait_finder, collocation_state
        has_known_state[found_wheel_indices] = True
        is_mesh_too_coarse[retried_wheel_indices] = retried_outcomes == Outcome.MESH_TOO_COARSE
        needs_better_gait[found_wheel_indices] = (
            can_refine_mesh & _has_large_mesh_error(retried_cycle)[is_gait_found]
        )
    return best_finder_and_starts


def search_again_from_walks(
    gait_finder: Any, params: WheelParams, search_result: LimitCycle
) -> LimitCycle:
    """Search again for the wheels without a cycle, starting from walks on the same mesh.

    Return the search result, completed by the cycles of the second search.
    """
    finder_and_starts = _find_fallback_starts(
        gait_finder, params, search_result, None, can_refine_mesh=False
    )
    if finder_and_starts is None:
        return search_result
    retried_cycle = map_in_batches(
        gait_finder.find_cycles, batch_sizes.GAIT_BATCH_SIZES, params, finder_and_starts[1]
    )
    return _restore_first_failure_reason(search_result, retried_cycle)


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
        cycle = map_in_batches(
            gait_finder.find_cycles, batch_sizes.GAIT_BATCH_SIZES, params, section_states
        )
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
