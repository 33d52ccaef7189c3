"""Find limit cycles of one wheel and of batches, and the sensitivities of their measures."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any, Literal, get_args, overload

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from vrw_jax.base.checks import (
    check_choice,
    check_int,
    check_names,
    check_type,
    format_name_suggestion,
    has_traced_leaf,
    require_untraced_arguments,
)
from vrw_jax.base.options import StepOptions
from vrw_jax.base.progress import announce_wait
from vrw_jax.base.results import (
    Measure,
    NoGaitError,
    Outcome,
    find_own_measures,
    format_numbers,
    name_measures,
)
from vrw_jax.base.results import xarray as xr
from vrw_jax.base.walker import AbstractWalker, is_own_walker
from vrw_jax.gaits.cycle import LAST_GAIT_DESCRIBERS, AbstractCycle, CycleOptions, replace_by_nan
from vrw_jax.gaits.finder import AbstractGaitFinder, GaitMeasures
from vrw_jax.gaits.further_search import describe_last_gait, search_with_fallbacks
from vrw_jax.gaits.gait_walks import GaitChoice, find_attracting_gaits, parse_gait_choice
from vrw_jax.gaits.limit_cycle_result import LimitCycle
from vrw_jax.gaits.phase_sequence import CollocationState
from vrw_jax.gaits.unilateral_finder import UnilateralFinder
from vrw_jax.gaits.walker_finder import (
    HybridGait,
    WalkerFinder,
    convert_gait_guess,
    find_walker_gaits,
    is_known_missing,
    make_walker_finder,
)
from vrw_jax.gaits.wheel_finders import (
    CollocationFinder,
    KinkedGaitFinder,
    ReturnMapCycle,
    ReturnMapFinder,
)
from vrw_jax.lanes.batching import (
    select_rows_on_device,
    select_tree_rows,
)
from vrw_jax.lanes.environment import with_default_jax_settings
from vrw_jax.models.stepping import (
    ModelLike,
    convert_model_argument,
    convert_section_state,
    convert_step_options,
    require_legs_in_turn_by_collocation,
    require_single_wheel,
)
from vrw_jax.wheel.params import WheelParams

UserCycleGuess = LimitCycle | ReturnMapCycle | Array | np.ndarray | Sequence[float]
"""Guess that a user provides: a similar wheel's cycle, or a section state near the gait."""


def make_finder(
    model: ModelLike | None,
    n_legs: int,
    *,
    period_n: int = 1,
    cycle_options: CycleOptions | None = None,
    step_options: StepOptions | None = None,
) -> AbstractGaitFinder:
    """Return the gait finder for a model."""
    if cycle_options is not None:
        check_type("cycle_options", cycle_options, CycleOptions, "give vrw.CycleOptions()")
    resolved_model = convert_model_argument(model)
    if period_n % resolved_model.leg_period:
        raise ValueError(
            f"period_n is {period_n}, but the legs alternate, so that a gait repeats after an even "
            "number of steps: give period_n=2 where there is such an argument, or one law for all "
            "legs."
        )
    kernel = resolved_model.batch_kernel
    finder_class: Any = UnilateralFinder if kernel == "legs" else ReturnMapFinder
    search_options = {}
    if kernel == "phases":
        finder_class = CollocationFinder
        default_options = CycleOptions()
        if resolved_model.own_parameters is not None:
            # With a user's law, the fast mode of the airborne leg may decay at a varying rate. The
            # default mesh then has errors of 3e-9.
            default_options = default_options.refine_mesh()
        search_options = {"cycle_options": cycle_options or default_options}
        if resolved_model.has_kinks:
            finder_class = KinkedGaitFinder
    return finder_class(
        model=resolved_model,
        n_legs=n_legs,
        step_options=convert_step_options(step_options),
        period_n=period_n,
        **search_options,
    )


def check_cycle_guess(cycle_guess: Any) -> Any:
    """Convert a user's guess to a cycle, a `CollocationState` or a finite section state.

    A cycle that was not found is no guess.
    Raise ValueError if the section state is not finite.
    """
    cycle_guess = convert_gait_guess(cycle_guess)
    if isinstance(cycle_guess, AbstractCycle):
        return None if is_known_missing(cycle_guess.outcome) else cycle_guess
    if cycle_guess is None or isinstance(cycle_guess, CollocationState):
        return cycle_guess
    section_state = convert_section_state(cycle_guess, "guess")
    if not has_traced_leaf(section_state) and not np.isfinite(section_state).all():
        raise ValueError(
            f"guess is {format_numbers(section_state)}, but a search can begin at finite numbers "
            "only: give a neighbour's cycle, or a section state near the gait."
        )
    return section_state


def resolve_finder(
    params: Any,
    model: ModelLike | None,
    options: CycleOptions | StepOptions | None,
    period_n: int = 1,
    guess: Any = None,
) -> AbstractGaitFinder:
    """Check the arguments of a search, and return the gait finder for a model and options.

    Raise TypeError or ValueError if the arguments do not fit the model.
    """
    if is_own_walker(model):
        step_options: Any = options
        return make_walker_finder(
            model, params, convert_step_options(step_options), guess, period_n
        )
    require_single_wheel(
        params, "map over batches with jax.vmap, in_axes=(params.in_axes,), or use vrw.scan"
    )
    if options is not None:
        check_type("options", options, (CycleOptions, StepOptions), "give vrw.CycleOptions()")
    has_cycle_options = isinstance(options, CycleOptions)
    gait_finder = make_finder(
        model,
        params.n_legs,
        period_n=check_int("period_n", period_n),
        cycle_options=options if has_cycle_options else None,  # type: ignore[arg-type]
        step_options=None if has_cycle_options else options,  # type: ignore[arg-type]
    )
    if options is not None and not isinstance(options, gait_finder.options_type):
        if has_cycle_options:
            raise TypeError(
                f"options is a CycleOptions, but {type(gait_finder.model).__name__} is solved on "
                "its return map: give the vrw.StepOptions of its step."
            )
        raise TypeError(
            "options is a StepOptions, but the paper's wheel is solved by collocation: "
            "give vrw.CycleOptions(), or CycleOptions.tight()."
        )
    gait_finder.search_options.check_tolerances(jnp.result_type(*jax.tree.leaves(params)))
    return gait_finder


FailureFillName = Literal["zeros", "nan"]
FAILURE_FILLS: tuple[str, ...] = get_args(FailureFillName)


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
    cycle = search_with_fallbacks(gait_finder, params, guess, options is None, which)
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
    return search_with_fallbacks(gait_finder, params, None, options is None, which)


LAST_GAIT_DESCRIBERS[:] = [functools.partial(describe_last_gait, limit_cycles, make_finder)]


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


@announce_wait("the gait with its derivatives", "10 s")
def sensitivities(
    params: Any,
    *,
    measures: Sequence[str | Measure] | None = None,
    guess: Any = None,
    model: ModelLike | None = None,
    options: CycleOptions | StepOptions | None = None,
) -> xr.Dataset:
    """Return the values, derivatives and elasticities of one gait's measures.

    The derivatives and elasticities are with respect to all parameters. An elasticity is the
    relative change of a measure per relative change of a parameter. It is NaN if the measure is
    zero. If the stability measures are omitted, compilation takes much less time. With unilateral
    contact, friction is also a parameter. With model "auto", `attrs` contains the name of the model
    that was selected for the gait. For a walker of yours, the measures are the period, the section
    coordinates and its own `measures`, by all its parameters.

    Args:
        params: the wheel, or the parameters of a walker of yours.
        measures: names of measures, or measures of your own, see `vrw.measure`; by default all
            measures of the model's gait.
        guess: as in `limit_cycle`.
        model: the model; the paper's, `ViscoelasticWheel()`, by default.
        options: as in `limit_cycle`.

    Returns:
        A dataset with `value` (measure), `derivative` and `elasticity` (measure, parameter).

    Raises:
        TypeError, ValueError: if an argument is invalid; the message names the remedy.

    Examples:
        >>> table = vrw.sensitivities(vrw.WheelParams(), measures=["dls_fraction", "speed"])
        >>> round(float(table.elasticity.sel(measure="speed", parameter="slope")), 3)
        1.887
    """
    require_untraced_arguments("vrw.sensitivities", "differentiate vrw.limit_cycle", params, guess)
    guess = check_cycle_guess(guess)
    if not is_own_walker(model):
        model = convert_model_argument(resolve_model(params, model))  # type: ignore[arg-type]
        require_legs_in_turn_by_collocation(model, "vrw.sensitivities")
    period_n = model.leg_period
    gait_finder = resolve_finder(params, model, options, period_n, guess)
    measure_names = (
        gait_finder.default_measures
        if measures is None
        else check_names("measures", name_measures(measures))
    )
    own_measures = (
        find_own_measures(measures, gait_finder.readable_measures)
        if gait_finder.model.is_wheel
        else {}
    )
    unknown_names = sorted(
        set(measure_names) - set(gait_finder.differentiable_measures) - own_measures.keys()
    )
    if unknown_names or not measure_names:
        raise ValueError(
            f"measures holds {', '.join(unknown_names) or 'nothing'}"
            f"{format_name_suggestion(unknown_names[0], gait_finder.differentiable_measures) if unknown_names else ''}, "  # noqa: E501
            "but the measures of a cycle are "
            f"{', '.join(gait_finder.differentiable_measures)}: choose among these."
        )
    measure_gait = functools.partial(
        gait_finder.measure_gait,
        gait_finder.model.collect_parameter_values(params),
        measure_names=tuple(own_measures.get(name, name) for name in measure_names),
    )
    gait_measures = measure_gait(guess)
    if isinstance(gait_finder, WalkerFinder) and guess is None:
        has_gait = int(gait_measures.outcome) == Outcome.STEPPED
        start = None if has_gait else gait_finder.find_gait_by_walk(params)
        gait_measures = gait_measures if start is None else measure_gait(start)
    if int(gait_measures.outcome) != Outcome.STEPPED:
        failure_outcome = Outcome(int(gait_measures.outcome))
        raise NoGaitError(f"there is no gait to differentiate: {failure_outcome.meaning}")
    unit_of = lambda name: (own_measures.get(name) or gait_finder.get_measure(name)).unit
    units = [unit_of(name) for name in measure_names]
    return _make_sensitivity_table(gait_finder, params, measure_names, units, gait_measures)


def _make_sensitivity_table(
    gait_finder: Any, params: Any, measure_names: Any, units: list[str], gait_measures: GaitMeasures
) -> xr.Dataset:
    """Return the result of `sensitivities`, from measures and derivatives of the gait."""
    model = gait_finder.model
    parameter_values = np.asarray(model.collect_parameter_values(params))
    measure_values, measure_derivatives = map(np.asarray, gait_measures[:2])
    with np.errstate(divide="ignore", invalid="ignore"):
        elasticities = measure_derivatives * parameter_values / measure_values[:, None]
    table_axes = ("measure", "parameter")
    return xr.Dataset(
        {
            "value": ("measure", measure_values),
            "derivative": (
                table_axes,
                measure_derivatives,
                {"long_name": "d(measure)/d(parameter)"},
            ),
            "elasticity": (
                table_axes,
                np.where(np.isfinite(elasticities), elasticities, np.nan),
                {"long_name": "relative change of measure per relative change of parameter"},
            ),
            "measure_unit": ("measure", units),
            "parameter_unit": ("parameter", [x.unit for x in model.parameter_domains.values()]),
            "parameter_value": ("parameter", parameter_values),
        },
        coords={"measure": list(measure_names), "parameter": list(model.parameter_names)},
        attrs={"rung": model.model_name} if model.is_wheel else {},
    )
