"""Search for limit cycles, with finer meshes and walks as fallbacks.

The search in `collocation_search` starts from predicted gaits for the paper's parameter ranges, on
a mesh that suits these gaits. If it fails, batches of walks (`models.step_batch`) begin at starts
that scale with the wheel. The end of a walk that settles is the start of another search. If the
mesh is too coarse, it is refined. These fallbacks depend on concrete values. Under a caller's `jit`
or `vmap`, a Python function runs them.
"""

import dataclasses
import functools
from typing import Any, Literal, get_args, overload

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from vrw_jax.base import batch_sizes
from vrw_jax.base.checks import (
    check_choice,
    check_real,
    check_type,
    has_traced_leaf,
    require_untraced_arguments,
)
from vrw_jax.base.options import StepOptions
from vrw_jax.base.outcomes import Outcome
from vrw_jax.base.progress import announce_wait
from vrw_jax.base.walker import AbstractWalker, is_own_walker
from vrw_jax.gaits.collocation_finder import CollocationFinder
from vrw_jax.gaits.collocation_search import CycleSearchResult
from vrw_jax.gaits.cycle import LAST_GAIT_DESCRIBERS, RETRY_OUTCOMES, replace_by_nan
from vrw_jax.gaits.finder_selection import (
    UserCycleGuess,
    check_cycle_guess,
    make_finder,
    resolve_finder,
)
from vrw_jax.gaits.further_search import (
    MeshSearch,
    search_further,
    transfer_to_mesh,
)
from vrw_jax.gaits.gait_walks import find_attracting_gaits, find_slowest_gait_indices
from vrw_jax.gaits.last_gait import describe_last_gait
from vrw_jax.gaits.limit_cycle_result import LimitCycle
from vrw_jax.gaits.options import CycleOptions
from vrw_jax.gaits.phase_sequence import CollocationState, CollocationSystem
from vrw_jax.gaits.return_map_finder import ReturnMapCycle
from vrw_jax.gaits.walker_finder import HybridGait, find_walker_gaits
from vrw_jax.lanes.batching import (
    is_inside_jit,
    map_in_batches,
    replace_rows,
    select_rows_on_device,
    select_tree_rows,
    unbatch,
)
from vrw_jax.lanes.settings import call_python, can_programs_call_jax, with_default_jax_settings
from vrw_jax.models.step_batch import step_batch
from vrw_jax.models.stepping import ModelLike, convert_model_argument
from vrw_jax.wheel.params import WheelParams

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
    guess: Any = None,
    period_n: int = 1,
    model: AbstractWalker,
    options: StepOptions | None = None,
) -> HybridGait: ...


@with_default_jax_settings
@announce_wait("the search for a gait", "10 s, or 30 s if it finds no gait")
def limit_cycle(
    params: Any,
    *,
    guess: Any = None,
    period_n: int = 1,
    model: ModelLike | None = None,
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

    If the search fails, walks and finer meshes are used. Under `jax.jit` and `jax.vmap` these need
    `start_jax` and a CPU with several cores, and the mesh is refined once.

    If no gait is found, `outcome` and `why` contain the reason, and numbers and derivatives are
    zero. With `on_failure="nan"` they are NaN, so that an optimization loop does not stop
    unnoticed.

    For any model other than the paper's, the fixed point of its return map is computed, with the
    `StepOptions` of its gait step. The result is a `ReturnMapCycle`, whose errors are those of the
    gait step. With unilateral contact a wheel may have several attracting gaits. Without a `guess`,
    walks from fixed starts find these gaits (`gaits.gait_walks`). `which` then selects the
    "slowest" gait, the "fastest" gait, or an index in the order of increasing speed. `limit_cycles`
    returns all attracting gaits. Model "auto" selects the lowest model whose margins are positive
    for the gait on its ground. A `LimitCycle` then belongs to the paper's model, a `ReturnMapCycle`
    to unilateral contact.

    For a `HybridSystem` or another walker of yours, `params` are its parameters. Newton's method
    starts at the `guess`, section coordinates near the gait, or at the walker's `starts`. If it
    fails, a walk begins at the same start, and the method starts again at its end. The result is a
    `HybridGait`.

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
        A `LimitCycle`; a `ReturnMapCycle` for other models, a `HybridGait` for a walker of yours.

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
    fills_missing_gait_with_nan = check_choice("on_failure", on_failure, FAILURE_FILLS) == "nan"
    if is_own_walker(model):
        gait = find_walker_gaits(model, params, guess, period_n, options)
        return replace_by_nan(~gait.found, params, gait) if fills_missing_gait_with_nan else gait
    model = resolve_model(params, model)
    gait_finder = resolve_finder(params, model, options, period_n)
    params = gait_finder.model.attach_laws(params)
    guess = check_cycle_guess(guess)
    has_unique_gait = gait_finder.is_multistable or gait_finder.model.leg_period == period_n
    if guess is None and period_n > 1 and not has_unique_gait:
        raise ValueError(
            f"period_n is {period_n} and there is no guess, but a gait of several steps is one of "
            "many beside the gait of one step: give guess=, a section state near it."
        )
    cycle = _search_with_fallbacks(gait_finder, params, guess, options is None, which)
    return cycle.replace_missing_gaits_by_nan(params) if fills_missing_gait_with_nan else cycle


@with_default_jax_settings
@announce_wait("the search for gaits", "10 s, or 30 s if it finds no gait")
def limit_cycles(
    params: Any,
    *,
    guess: Any = None,
    period_n: int = 1,
    model: ModelLike | None = None,
    options: CycleOptions | StepOptions | None = None,
    which: GaitChoice = "slowest",
) -> LimitCycle | ReturnMapCycle | HybridGait:
    """Find the limit cycles of a batch of wheels, as `limit_cycle` does for one wheel.

    Fields of `params` and of the result have one leading axis. All cycles are computed on one mesh,
    which is as fine as any of the cycles requires. For a single wheel with unilateral contact, all
    attracting gaits are returned, in the order of increasing speed. An element without a gait has a
    code in `outcome`, and never stops the batch.

    Args:
        params: the wheels; fields are scalars or of shape (wheels,). For a walker of yours, its
            parameters.
        guess: for a walker of yours, section coordinates for all elements or one row for each, or
            its gaits for similar parameters.
        period_n: number of gait steps after which the gaits repeat.
        model: the model; the paper's, `ViscoelasticWheel()`, by default.
        options: as in `limit_cycle`.
        which: as in `limit_cycle`, for batches.

    Returns:
        A `LimitCycle`, `ReturnMapCycle` or `HybridGait` whose fields have a leading axis over the
        batch.

    Raises:
        TypeError, ValueError: if an argument is invalid; the message names the remedy.

    Examples:
        >>> cycles = vrw.limit_cycles(vrw.WheelParams(damping=np.array([100.0, 150.0, 300.0])))
        >>> cycles.found.tolist(), cycles.period.round(3).tolist()
        ([True, True, False], [0.595, 0.6980000000000001, 0.0])
    """
    parse_gait_choice(which)
    if is_own_walker(model):
        return find_walker_gaits(model, params, guess, period_n, options, is_batch=True)
    check_type("params", params, WheelParams, "write vrw.WheelParams(damping=...)")
    if guess is not None:
        raise ValueError(
            "guess is given, but the gaits of many wheels are searched without guesses: leave it "
            "out, or map vrw.limit_cycle over the batch."
        )
    checked_model: Any = convert_model_argument(model, allows_friction_arrays=True)
    params = checked_model.attach_laws(params)
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
        return select_rows_on_device(cycle_without_gait, slice(0, 0))
    if has_traced_leaf(params):
        params = jax.tree.map(lambda x: jnp.broadcast_to(x, batch_shape), params)
        first_wheel_params = jax.tree.map(lambda x: x[0], params)
    else:  # NumPy is used because JAX would compile a program for each batch size.
        params = jax.tree.map(lambda x: np.broadcast_to(np.asarray(x), batch_shape), params)
        params, first_wheel_params = jax.device_put((params, select_tree_rows(params, 0)))
    if params.laws is not None:
        model = checked_model.with_laws(first_wheel_params.laws)
    gait_finder = resolve_finder(first_wheel_params, model, options, period_n)
    return _search_with_fallbacks(gait_finder, params, None, options is None, which)


LAST_GAIT_DESCRIBERS[:] = [functools.partial(describe_last_gait, limit_cycles)]


def resolve_model(params: WheelParams, model: ModelLike | None) -> ModelLike | None:
    """Return the model to which a wheel's gait belongs.

    A ladder of models is replaced by the simplest model that is valid for the gait. The gait is
    first computed with the paper's model. If this gait is not found or violates a margin on its
    ground, a more general model is returned. If the parameters have no concrete values, the ladder
    is returned unchanged. Any other model is also returned unchanged.
    """
    return resolve_model_with_reason(params, model)[0]


def resolve_model_with_reason(
    params: WheelParams, model: ModelLike | None
) -> tuple[ModelLike | None, str | None]:
    """Return the model to which a wheel's gait belongs and, for the ladder, the reason in one
    sentence.
    """
    selected_model: Any = convert_model_argument(model)
    if (
        selected_model.fallback_model is selected_model
        or not isinstance(params, WheelParams)
        or has_traced_leaf(params, model)
        or params.damping.ndim
    ):
        return model, None
    if selected_model.leg_period > 1:
        raise ValueError(
            'the legs alternate, but model "auto" tests gaits of one step only: give '
            "vrw.ViscoelasticWheel(leg_force=...) or vrw.UnilateralWheel(leg_force=...), or one "
            "law for all legs."
        )
    paper_cycle = limit_cycle(params, model=selected_model.viscoelastic_model)
    if not bool(paper_cycle.found):
        return selected_model.fallback_model, f"The paper's wheel has no gait: {paper_cycle.ending}"
    section_state = selected_model.complete_section_state(params, paper_cycle.section_state)
    model_choice = selected_model.choose_model(params, section_state, StepOptions())[0]
    return model_choice.model.with_laws(selected_model.laws), model_choice.why


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
            batch_sizes.GAIT_BATCH_SIZES,
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
    mesh_error = map_in_batches(lambda cycle: cycle.mesh_error, batch_sizes.GAIT_BATCH_SIZES, cycle)
    return MeshSearch(cycle.outcome, mesh_error, cycle.collocation_state, cycle)


def find_cycles_from_starts(
    gait_finder: CollocationFinder, params: WheelParams, starts: CollocationState
) -> MeshSearch:
    """Search for the cycles of a batch from the given starts only."""
    find_cycles = functools.partial(gait_finder.find_cycles, starts_only_from_guess=True)
    return summarize_search(
        map_in_batches(find_cycles, batch_sizes.GAIT_BATCH_SIZES, params, starts)
    )


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
                gait_finder, mesh_finder, collocation_state, batch_sizes.GAIT_BATCH_SIZES
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
        lambda first, last: array_module.where(is_gait_missing, first, last),
        first_reason,
        last_reason,
    )
    return eqx.tree_at(get_failure_reason, retried_cycle, jax.device_put(failure_reason))


def _search_without_fallbacks(
    gait_finder: Any, params: WheelParams, cycle_guess: Any, **search_options: Any
) -> Any:
    if not params.damping.ndim:
        return gait_finder.find_cycle(params, cycle_guess, **search_options)
    if cycle_guess is not None or has_traced_leaf(params):
        return gait_finder.find_cycles(params, cycle_guess, **search_options)
    return map_in_batches(gait_finder.find_cycles, batch_sizes.GAIT_BATCH_SIZES, params)


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
    gait_finder: Any = make_finder(
        dataclasses.replace(model, stop_at_lift_off=collocation_system.stop_at_lift_off),
        collocation_system.n_legs,
        period_n=collocation_system.period_n,
        cycle_options=collocation_system.cycle_options,
    )
    search = functools.partial(
        _search_with_fallbacks, gait_finder, can_refine_mesh=False, gait_choice="slowest"
    )
    if guess:
        guesses = jax.tree.map(lambda x: np.moveaxis(x[..., missing], -1, 0), guess[0])
        if collocation_system.coarse_options is not None:
            coarse_options = collocation_system.coarse_options
            coarse_finder = dataclasses.replace(gait_finder, cycle_options=coarse_options)
            guesses = transfer_to_mesh(
                coarse_finder, gait_finder, guesses, batch_sizes.GAIT_BATCH_SIZES
            )
        rows = [select_tree_rows((params, guesses), i) for i in range(len(missing))]
        cycles = [search(*jax.device_put(row)) for row in rows]
        cycle = jax.tree.map(lambda *x: np.stack(x), *cycles)
    else:
        cycle = search(params, None)
    is_found = np.asarray(cycle.found)
    for result, found in zip(
        jax.tree.leaves(search_result),
        jax.tree.leaves(
            (
                cycle.collocation_state,
                cycle.monodromy_value,
                cycle.residual,
                cycle.n_newton_iterations,
            )
        ),
        strict=True,
    ):
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
