"""Gait steps of batches of wheels: one function for several engines.

On a CPU the "lanes" engine is machine code for a few lanes at a time (`simd`). On a GPU it is an
XLA program for very many lanes, and stragglers are run again in smaller batches. In both cases
every lane runs the same code, and no data pass between lanes. The result of a batch element is
bitwise the same alone, in any batch and in any order. Wheels of similar work are placed side by
side.
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from vrw_jax import simd
from vrw_jax.batches.collocation_step import collocation_gait_step
from vrw_jax.batches.contact_step import CONTACT_STEP_INPUTS, step_batch_with_contact
from vrw_jax.batches.programs import run_compiled
from vrw_jax.batches.stiffness import (
    SOLVER_SELECTION_OPTIONS,
    SolverIndex,
    SolverSelectionOptions,
    select_solver,
)
from vrw_jax.batches.walk_batch import (
    START_NAME,
    StepBatchResult,
    StepwiseParameter,
    WalkBatch,
    complete_batch_slopes,
    lane_index,
)
from vrw_jax.integrator import load_explicit_tableau
from vrw_jax.models import (
    N_STEP_INPUTS,
    AbstractWheel,
    AdvanceResult,
    complete_jacobian_columns,
    compute_jacobian_columns,
    take_gait_step,
)
from vrw_jax.numerics import StepOptions, batch_sizes, map_in_batches
from vrw_jax.runtime import with_default_settings
from vrw_jax.simulation import check_model, check_options, check_section_state
from vrw_jax.validation import (
    check_choice,
    check_int,
    check_names,
    check_not_traced,
    check_numpy_reals,
    check_type,
)
from vrw_jax.wheel import (
    FRICTION_NAME,
    PARAMETER_NAMES,
    Outcome,
    WheelParams,
    wheel_from_parameters,
)

BatchEngine = Literal["auto", "lanes", "diffrax", "collocation"]
BATCH_ENGINE_NAMES: tuple[str, ...] = get_args(BatchEngine)

PAPER_STEP_INPUTS = (START_NAME, *PARAMETER_NAMES)
"""Inputs with respect to which a step of the paper's model can be differentiated."""

SLOPE_INDEX = PARAMETER_NAMES.index("slope")
"""Index of the slope among the inputs of a step: parameters, section state, slope of the next
line."""
NEXT_SLOPE_INDEX = len(PARAMETER_NAMES) + 3
"""Index of the slope of the next line among the same inputs."""


@with_default_settings
def step_batch(
    params: WheelParams,
    states: Array | np.ndarray,
    n_steps: int = 1,
    *,
    model: AbstractWheel | None = None,
    options: StepOptions | None = None,
    engine: BatchEngine = "auto",
    durations: Array | np.ndarray | None = None,
    derivatives: Sequence[str] = (),
) -> StepBatchResult:
    """Return the result of up to `n_steps` gait steps of many wheels, with derivatives if
    requested.

    Engine "lanes" is the fast one, for the viscoelastic wheel and explicit solvers. "diffrax" maps
    `model.advance` over the batch and accepts any solver. "auto" selects "lanes" if it is possible;
    `StepBatchResult.engine` gives the selected one. Both have the errors of `options`, which apply
    to each solver step. The results of the two differ by some ten times the tolerance.

    "auto" also selects another solver than the named one if the airborne leg is so stiff that
    another is cheaper; `StepBatchResult.solver_index` gives the selected one. It is Tsit5 if
    stability limits the steps. At the default options this is the case from c/m = 1,900 1/s; at a
    tolerance of 1e-6, from 300 1/s. It is Kvaerno5 by "diffrax" if explicit solvers need too many
    steps (from 4e5, or from 1.4e5) or Tsit5 failed.

    Derivatives include all steps and their events. They are zero for an element that fell, and are
    not available by collocation. With unilateral contact (`UnilateralWheel`) the only engine is
    "lanes"; friction is a scalar or an array over the batch. The function compiles itself once, so
    that it cannot be called inside `jax.jit`.

    On uneven ground the slope has the shape (elements, n_steps) or (elements, n_steps + 1), over
    the steps of each element as in `walk`. With unilateral contact, friction may have these shapes
    too. Derivatives with respect to such an array have the axis over steps last.

    Args:
        params: the wheels; fields are scalars or of shape (elements,); the slope as above.
        states: section states, shape (elements, 3), rad, rad/s, m/s, or those of the model.
        n_steps: largest number of steps.
        model: model of the wheel; by default the paper's, `ViscoelasticWheel()`.
        options: numerical options of the steps.
        engine: "auto", "lanes", "diffrax" or "collocation", as above.
        durations: durations of the phases, shape (elements, 3), s, for "collocation".
        derivatives: "section_state" and names of parameters; with unilateral contact "friction"
            too.

    Returns:
        A `StepBatchResult`, for the last step of each element.

    Raises:
        TypeError, ValueError: an invalid argument, described in one sentence.

    Examples:
        >>> params = vrw.WheelParams(damping=np.array([120.0, 150.0, 180.0]))
        >>> result = vrw.step_batch(params, np.tile(vrw.paper_start(), (3, 1)), 10)
        >>> result.durations.shape, result.n_stepped.tolist(), result.engine
        ((3, 3), [10, 10, 10], 'lanes')
    """
    check_not_traced(
        "vrw.step_batch", "map vrw.return_map over the lanes", params, states, durations
    )
    check_type("params", params, WheelParams, "write vrw.WheelParams(damping=..., slope=...)")
    checked_model, options = check_model(model, allows_arrays=True), check_options(options)
    check_choice("engine", engine, BATCH_ENGINE_NAMES)
    n_steps = check_int("n_steps", n_steps)
    derivatives = check_names("derivatives", derivatives, '"section_state", "damping"')
    checked_states: np.ndarray = check_section_state(states, "states", check_numpy_reals)
    columns = _check_parameters(params, checked_states, checked_model, options, n_steps)
    checked_states = checked_states.astype(columns[0].dtype, copy=False)
    has_contact_kernel = checked_model.batch_kernel == "legs"
    arguments = checked_model, columns, checked_states, n_steps, options, engine, params.n_legs
    derivative_names = _check_derivatives(
        derivatives, CONTACT_STEP_INPUTS if has_contact_kernel else PAPER_STEP_INPUTS, engine
    )
    return (
        step_batch_with_contact(*arguments, derivative_names)
        if has_contact_kernel
        else _step_paper_model(*arguments, durations, derivative_names)
    )


def _check_derivatives(
    derivatives: Sequence[str], known_names: tuple[str, ...], engine: str
) -> list[str]:
    """Return the requested derivatives, or raise a ValueError if one is not available."""
    names = list(derivatives)
    for name in names:
        if name not in known_names:
            raise ValueError(
                f"derivatives contain {name!r}, but a step depends on {', '.join(known_names)}: "
                "give names of these."
            )
    if names and engine == "collocation":
        raise ValueError(
            "derivatives are not available by collocation in batches: take "
            "engine='lanes', or jax.jacfwd of vrw.return_map."
        )
    return names


def _check_parameters(
    params: WheelParams,
    states: np.ndarray,
    model: AbstractWheel,
    options: StepOptions,
    n_steps: int,
) -> list[np.ndarray]:
    """Return the parameters, one value for all or one per element, with slopes of each step too.

    Raises: ValueError: the shapes of states or parameters do not fit.
    """
    sizes = [3]
    if states.ndim != 2 or states.shape[1] != 3:
        sizes = sorted({3, model.section_size(params)})
    if states.ndim != 2 or states.shape[1] not in sizes:
        raise ValueError(
            f"states have shape {states.shape}, but section states have the shape (elements, "
            f"{' or '.join(map(str, sizes))}): write states[None] for a single one."
        )
    n_states, columns = len(states), [getattr(params, name) for name in PARAMETER_NAMES]
    parameter_dtype = np.result_type(*(column.dtype for column in columns))
    StepOptions.check_tolerances(options, parameter_dtype)  # a bound method takes 0.1 ms
    friction = getattr(model, FRICTION_NAME, np.zeros(()))
    for name, column in zip((*PARAMETER_NAMES, FRICTION_NAME), (*columns, friction), strict=True):
        varies_by_step = name in ("slope", FRICTION_NAME) and np.ndim(column) == 2
        over_steps = [(n_states, n_steps), (n_states, n_steps + 1)] * varies_by_step
        if np.shape(column) not in ((), (n_states,), *over_steps):
            raise ValueError(
                f"{name} has shape {np.shape(column)}, but there are {n_states} states"
                f"{f' and {n_steps} steps' * varies_by_step}: give one value for all, or one for "
                "each"
                f"{f' and {n_steps} or {n_steps + 1} of each over its steps' * varies_by_step}."
            )
    dtype = np.promote_types(parameter_dtype, states.dtype)
    return [np.asarray(column, dtype) for column in columns]


def _step_paper_model(
    model: Any,
    parameter_columns: list[np.ndarray],
    states: np.ndarray,
    n_steps: int,
    options: StepOptions,
    engine: str,
    n_legs: int,
    durations: Any,
    derivative_names: Sequence[str],
    selection: SolverSelectionOptions = SOLVER_SELECTION_OPTIONS,
) -> StepBatchResult:
    """Return `step_batch` of the paper's wheel, or of another model by the diffrax engine."""
    slopes, stepwise = _split_slopes_by_step(parameter_columns[SLOPE_INDEX], n_steps, engine)
    parameter_columns = [
        slopes[0] if i == SLOPE_INDEX else x for i, x in enumerate(parameter_columns)
    ]
    order = sort_by_work(parameter_columns, states)
    wheels = np.empty((len(parameter_columns), len(states)), states.dtype)
    for row, column in zip(wheels, parameter_columns, strict=True):
        row[:] = column[order] if column.ndim else column
    is_uneven = bool(stepwise)
    slopes = slopes.take(order, -1) if is_uneven else slopes
    walks = WalkBatch(states.T.take(order, -1), derivative_names, PARAMETER_NAMES, stepwise)
    settings = n_legs, walks.input_indices
    engines = {SolverIndex.NAMED: _select_engine(engine, model, options, *settings)}
    solver_index = np.full(len(states), SolverIndex.NAMED, np.int32)
    solver_names: tuple[str, ...] = (options.solver,)
    engine_name = engines[SolverIndex.NAMED].name
    if engine == "auto" and engine_name == "lanes":
        solver_names = (options.solver, selection.stable_solver, selection.implicit_solver)
        actual_options = options.with_derivative_tolerances() if derivative_names else options
        solver_index = select_solver(wheels, actual_options, selection)
    if np.any(solver_index != SolverIndex.NAMED):
        implicit_options = dataclasses.replace(options, solver=selection.implicit_solver)
        stable_options = dataclasses.replace(options, solver=selection.stable_solver)
        stable_options = stable_options.with_tightened_tolerances(selection.stable_tolerance_factor)
        engines[SolverIndex.STABLE] = _select_engine("lanes", model, stable_options, *settings)
        engines[SolverIndex.IMPLICIT] = _select_engine(
            "diffrax", model, implicit_options, *settings
        )
    if engine == "collocation":
        engine_name = engine
        if durations is None or np.shape(durations) != states.shape:
            shape = None if durations is None else np.shape(durations)
            raise ValueError(
                f"durations have shape {shape}, but collocation needs those of DLS, SLS-I and "
                "SLS-II to some per cent, shape (elements, 3): give those of a limit cycle, or "
                "take 'lanes'."
            )
        expected_durations = check_numpy_reals("durations", durations)
        walks.durations[:] = expected_durations.astype(wheels.dtype).T.take(order, -1)
    for k in range(n_steps):
        active = walks.active_lanes()
        if is_uneven:
            wheels[SLOPE_INDEX] = slopes[k]
        if engine == "collocation" and len(active):
            index = lane_index(active, walks)
            lane_arrays = wheels[:, index], walks.section_state[:, index], walks.durations[:, index]
            collocated = _step_by_collocation(
                engines[SolverIndex.NAMED], model, n_legs, *lane_arrays
            )
            walks.record_step(active, *collocated)
            continue
        for engine_index, selected_engine in engines.items():
            lane_indices = active[solver_index[active] == engine_index]
            if len(lane_indices) > 0:
                index = lane_index(lane_indices, walks)
                next_slopes = (slopes[k + 1][index],) if is_uneven else ()
                result = selected_engine.take_step(
                    wheels[:, index], walks.section_state[:, index], *next_slopes
                )
                if engine_index == SolverIndex.STABLE:
                    # A phase may last longer than `select_solver` assumes. The implicit solver,
                    # whose turn is next, then repeats the step.
                    has_failed = result[2] == Outcome.SOLVER_FAILED
                    solver_index[lane_indices[has_failed]] = SolverIndex.IMPLICIT
                    lane_indices = lane_indices[~has_failed]
                    result = tuple(part[..., ~has_failed] for part in result)
                walks.record_step(lane_indices, result, np.zeros(len(lane_indices), bool))
    return walks.to_result(order, solver_index, engine_name, solver_names)


def _split_slopes_by_step(
    slope: np.ndarray, n_steps: int, engine: str
) -> tuple[Any, dict[str, StepwiseParameter]]:
    """Return the slopes of the lines of all steps, and how they enter the steps.

    On flat ground they are a list with the slope, and an empty mapping.
    """
    if slope.ndim < 2:
        return [slope], {}
    if engine == "collocation":
        raise ValueError(
            "engine is 'collocation', which takes one slope, but slope is an array over steps: "
            "take 'auto', 'lanes' or 'diffrax'."
        )
    n_values = slope.shape[1]
    terms = lambda k: ((0, k, 1.0), (1, min(k + 1, n_values - 1), 1.0))
    stepwise_slope = StepwiseParameter((SLOPE_INDEX, NEXT_SLOPE_INDEX), n_values, terms)
    return complete_batch_slopes(slope, n_steps), {"slope": stepwise_slope}


def sort_by_work(columns: list[np.ndarray], states: np.ndarray) -> np.ndarray:
    """Return an order of the batch in which wheels of similar work are side by side.

    A group of lanes takes as long as its slowest lane. Most of a step's work is in SLS-I. There
    stability limits the solver's steps by m/c, and Leg 2 extends at the rate k (Ls - L)/c from its
    length at release. The exponents are rounded from a fit to the solver's steps of wheels near
    their gaits and away from them (`python -m experiments.speed.straggler_steps`).
    """
    values_by_name = dict(zip(PARAMETER_NAMES, columns, strict=True))
    single_precision = lambda name: np.asarray(values_by_name[name], np.float32)
    with np.errstate(all="ignore"):
        theta, dtheta = states.T[:2].astype(np.float32)
        length, mass = single_precision("locked_length"), single_precision("leg_mass")
        work = np.log(single_precision("damping") / mass) - 0.25 * np.log(
            single_precision("stiffness") / mass
        )
        work = work + 0.8 * np.log(dtheta) + 0.65 * np.log(length / single_precision("gravity"))
        work = work + theta - 7.0 * single_precision("natural_length") / length
    return np.argsort(work)


class _BatchEngine(NamedTuple):
    """One gait step of any number of lanes, from numpy to numpy, lanes on the last axis."""

    name: str
    take_step: Callable[..., tuple[np.ndarray, ...]]
    """A function of parameters, section states and, on uneven ground, slopes of the next lines. It
    returns section state, durations, outcome, solver steps and, if requested, the Jacobian."""


def _select_engine(
    engine: str, model: Any, options: StepOptions, n_legs: int, input_indices: tuple[int, ...]
) -> _BatchEngine:
    """Return the engine of that name, or the fastest possible one for "auto"."""
    has_lane_kernel = (
        model.batch_kernel == "phases" and load_explicit_tableau(options.solver) is not None
    )
    if engine in ("lanes", "collocation") and not has_lane_kernel:
        raise ValueError(
            f"the lane engine can't run {type(model).__name__} with {options.solver}: it supports "
            "the viscoelastic wheel and explicit Runge-Kutta solvers; take engine='diffrax'."
        )
    if engine == "diffrax" or not has_lane_kernel:
        take_diffrax_step = functools.partial(
            _step_by_diffrax, model, options.with_engine("diffrax"), n_legs, input_indices
        )
        return _BatchEngine("diffrax", take_diffrax_step)
    take_lane_step = functools.partial(
        _step_by_lanes, model.stop_at_lift_off, options, n_legs, input_indices
    )
    return _BatchEngine("lanes", take_lane_step)


def _step_by_lanes(
    stop_at_lift_off: bool,
    options: StepOptions,
    n_legs: int,
    input_indices: tuple[int, ...],
    wheels: np.ndarray,
    states: np.ndarray,
    *next_slopes: np.ndarray,
) -> tuple[np.ndarray, ...]:
    """Take one gait step by the lane engine; see `_BatchEngine.take_step`."""
    option_leaves, structure = jax.tree.flatten(options)
    uniform = [np.asarray(leaf, wheels.dtype) for leaf in option_leaves]
    tableau, n_parameters = load_explicit_tableau(options.solver), len(PARAMETER_NAMES)
    assert tableau is not None  # checked by `_select_engine`

    def lane_step(uniform: Any, lanes: Any, straggler_count: Array | None = None) -> tuple:
        current_options = jax.tree.unflatten(structure, uniform)
        if input_indices:
            current_options = current_options.with_derivative_tolerances()

        def step_outputs(*lanes: Array) -> tuple:
            params = wheel_from_parameters(lanes[:n_parameters], n_legs, *lanes[NEXT_SLOPE_INDEX:])
            x = lanes[n_parameters:NEXT_SLOPE_INDEX]
            result = take_gait_step(
                params, x, current_options, tableau, stop_at_lift_off, straggler_count
            )
            diagnostics = result.is_unfinished, result.outcome, result.solver_steps
            return jnp.stack([*result.section_state, *result.durations]), diagnostics

        if not input_indices:
            values, diagnostics = step_outputs(*lanes)
            return (*diagnostics, values)
        # With respect to all inputs, two columns follow from the units.
        needs_all = len(input_indices) == len(lanes)
        compute_columns = complete_jacobian_columns if needs_all else compute_jacobian_columns
        jacobian, values, diagnostics = compute_columns(step_outputs, lanes, input_indices)
        return (*diagnostics, values, jacobian)

    settings = (
        "gait step",
        n_legs,
        stop_at_lift_off,
        structure,
        input_indices,
        *("uneven" for _ in next_slopes),
    )
    n_inputs = N_STEP_INPUTS + len(next_slopes)
    limits = simd.RegisterLimits(n_inputs) if input_indices else simd.DEFAULT_LIMITS
    lane_arrays = [*wheels, *states, *next_slopes]
    results = run_compiled(lane_step, uniform, lane_arrays, settings, limits)
    _, outcome, n_solver_steps, values, *jacobian = results
    return values[:3], values[3:], outcome, n_solver_steps, *jacobian


def _step_by_collocation(
    lane_engine: _BatchEngine,
    model: Any,
    n_legs: int,
    wheels: np.ndarray,
    states: np.ndarray,
    durations: np.ndarray,
) -> tuple[tuple[np.ndarray, ...], np.ndarray]:
    """Take one step by collocation, and by the lane engine for lanes that fail the check.

    Returns the results as `_BatchEngine.take_step` does, and which lanes passed the check.
    """
    stop_at_lift_off, n_parameters = model.stop_at_lift_off, len(PARAMETER_NAMES)

    def lane_step(uniform: Any, lanes: Any, straggler_count: Array | None = None) -> tuple:
        params = wheel_from_parameters(lanes[:n_parameters], n_legs)
        x, expected_durations = tuple(lanes[n_parameters:-3]), tuple(lanes[-3:])
        result = collocation_gait_step(params, x, expected_durations, stop_at_lift_off)
        is_unfinished = jnp.zeros_like(result.is_trusted)
        values = jnp.stack([*result.section_state, *result.durations])
        return is_unfinished, result.is_trusted, values

    settings = ("gait step by collocation", n_legs, stop_at_lift_off)
    _, is_trusted, values = run_compiled(lane_step, [], [*wheels, *states, *durations], settings)
    outcome, n_solver_steps = np.zeros((2, len(is_trusted)), np.int32)
    result = values[:3], values[3:], outcome, n_solver_steps
    untrusted = np.flatnonzero(~is_trusted)
    if len(untrusted) > 0:
        repeated = lane_engine.take_step(wheels[:, untrusted], states[:, untrusted])
        for all_values, new_values in zip(result, repeated, strict=True):
            all_values[..., untrusted] = new_values
    return result, is_trusted


def _step_by_diffrax(
    model: AbstractWheel,
    options: StepOptions,
    n_legs: int,
    input_indices: tuple[int, ...],
    wheels: np.ndarray,
    states: np.ndarray,
    *next_slopes: np.ndarray,
) -> tuple[np.ndarray, ...]:
    """Take one step by the model's own step under `jax.vmap`; see `_BatchEngine.take_step`."""
    convert = functools.partial(jax.tree.map, lambda leaf: np.asarray(leaf, wheels.dtype))
    tight_options = convert(options.with_derivative_tolerances())
    options = convert(options)
    rows = np.concatenate([wheels, states, *(row[None] for row in next_slopes)]).T

    def step_rows(rows: np.ndarray, options: StepOptions, input_indices: tuple[int, ...]) -> Any:
        step = functools.partial(_vmapped_step, model, options, n_legs, input_indices)
        results = map_in_batches(step, (batch_sizes.DIFFRAX_BATCH_SIZE,), rows)
        return jax.tree.map(lambda x: np.array(x).T, results)

    def differentiate_rows(rows: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return the step with derivatives; these are zeros for elements without them.

        diffrax raises for the whole batch if the linear equations of an implicit solver's
        derivative cannot be solved for one element. That element is isolated by bisection.
        """
        try:
            results: tuple[np.ndarray, ...] = step_rows(rows, options, input_indices)
        except eqx.EquinoxRuntimeError:
            *values, n_solver_steps = step_rows(rows, tight_options, ())
            outcome = values[2]
            jacobian = np.zeros((len(input_indices), 6, len(rows)), wheels.dtype)
            results = (*values, n_solver_steps, jacobian)
            has_stepped = np.flatnonzero(outcome == Outcome.STEPPED)
            if len(has_stepped) < len(rows):
                parts = [has_stepped]
            elif len(rows) > 1:
                parts = np.array_split(has_stepped, 2)
            else:
                parts, outcome[:] = [], Outcome.SOLVER_FAILED
            for part in (part for part in parts if len(part)):
                own_results = differentiate_rows(rows[part])
                for all_values, own_values in zip(results, own_results, strict=True):
                    all_values[..., part] = own_values
        return results

    return differentiate_rows(rows) if input_indices else step_rows(rows, options, ())


@eqx.filter_jit
def _vmapped_step(
    model: AbstractWheel,
    options: StepOptions,
    n_legs: int,
    input_indices: tuple[int, ...],
    rows: Array,
) -> tuple[Array, ...]:
    """Return one step of each row of inputs, with the Jacobian if requested."""
    n_parameters = len(PARAMETER_NAMES)

    def step_one(inputs: Array) -> tuple[Array, ...]:
        def step_from_inputs(varied_inputs: Array) -> tuple[Array, AdvanceResult]:
            all_inputs = inputs.at[np.array(input_indices, int)].set(varied_inputs)
            next_slope = all_inputs[NEXT_SLOPE_INDEX:]
            params = wheel_from_parameters(all_inputs[:n_parameters], n_legs, *next_slope)
            x = all_inputs[n_parameters:NEXT_SLOPE_INDEX]
            result = model.advance(params, x, options)
            return jnp.concatenate([result.section_state, result.durations]), result

        varied_inputs = inputs[np.array(input_indices, int)]
        if not input_indices:
            _, result = step_from_inputs(varied_inputs)
            return result.section_state, result.durations, result.outcome, result.solver_steps
        jacobian, result = jax.jacfwd(step_from_inputs, has_aux=True)(varied_inputs)
        values = result.section_state, result.durations, result.outcome, result.solver_steps
        return *values, jacobian

    return jax.vmap(step_one)(rows)
