"""Gait steps of batches of wheels: one function for several engines.

On a CPU the "lanes" engine is machine code for a few lanes at a time (`simd`). On a GPU the engine
is an XLA program for very many lanes, and stragglers are run again in smaller batches. In both
cases every lane runs the same code, and no data pass between lanes. The result of a batch element
is bitwise the same alone, in any batch and in any order. Wheels of similar work are placed side by
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
    make_lane_index,
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
"""Inputs of a step of the paper's model with respect to which derivatives are available."""

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
    `model.advance` over the batch and accepts any solver. "auto" selects "lanes" if possible;
    `StepBatchResult.engine` gives the selected engine. Both have the errors of `options`, which
    apply to each solver step. The results of the two differ by some ten times the tolerance.

    "auto" also replaces the named solver if the airborne leg is so stiff that another solver is
    cheaper. `StepBatchResult.solver_index` gives the selected solver. Tsit5 is selected if
    stability limits the steps. At the default options this is the case from c/m = 1,900 1/s; at a
    tolerance of 1e-6, from 300 1/s. Kvaerno5 by "diffrax" is selected if Tsit5 failed,
    or if explicit solvers need too many steps. At the default options this is the case from c/m =
    4e5 1/s; at a tolerance of 1e-6, from 1.4e5 1/s.

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
    parameter_columns = _check_parameters(params, checked_states, checked_model, options, n_steps)
    checked_states = checked_states.astype(parameter_columns[0].dtype, copy=False)
    has_contact_kernel = checked_model.batch_kernel == "legs"
    step_arguments = (
        checked_model,
        parameter_columns,
        checked_states,
        n_steps,
        options,
        engine,
        params.n_legs,
    )
    derivative_names = _check_derivatives(
        derivatives, CONTACT_STEP_INPUTS if has_contact_kernel else PAPER_STEP_INPUTS, engine
    )
    return (
        step_batch_with_contact(*step_arguments, derivative_names)
        if has_contact_kernel
        else _step_paper_model(*step_arguments, durations, derivative_names)
    )


def _check_derivatives(
    derivatives: Sequence[str], known_names: tuple[str, ...], engine: str
) -> list[str]:
    """Return the names of the requested derivatives as a list.

    Raises `ValueError` if one is not available.
    """
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
    """Return the parameters, one array for all elements or per element, with slopes over steps too.

    Raises `ValueError` if the shapes of states or parameters do not fit.
    """
    section_sizes = [3]
    if states.ndim != 2 or states.shape[1] != 3:
        section_sizes = sorted({3, model.section_size(params)})
    if states.ndim != 2 or states.shape[1] not in section_sizes:
        raise ValueError(
            f"states have shape {states.shape}, but section states have the shape (elements, "
            f"{' or '.join(map(str, section_sizes))}): write states[None] for a single one."
        )
    n_states, parameter_columns = len(states), [getattr(params, name) for name in PARAMETER_NAMES]
    parameter_dtype = np.result_type(
        *(parameter_values.dtype for parameter_values in parameter_columns)
    )
    StepOptions.check_tolerances(options, parameter_dtype)  # a bound method takes 0.1 ms
    friction = getattr(model, FRICTION_NAME, np.zeros(()))
    for name, parameter_values in zip(
        (*PARAMETER_NAMES, FRICTION_NAME), (*parameter_columns, friction), strict=True
    ):
        varies_by_step = name in ("slope", FRICTION_NAME) and np.ndim(parameter_values) == 2
        shapes_over_steps = [(n_states, n_steps), (n_states, n_steps + 1)] * varies_by_step
        if np.shape(parameter_values) not in ((), (n_states,), *shapes_over_steps):
            raise ValueError(
                f"{name} has shape {np.shape(parameter_values)}, but there are {n_states} states"
                f"{f' and {n_steps} steps' * varies_by_step}: give one value for all, or one for "
                "each"
                f"{f' and {n_steps} or {n_steps + 1} of each over its steps' * varies_by_step}."
            )
    dtype = np.promote_types(parameter_dtype, states.dtype)
    return [np.asarray(parameter_values, dtype) for parameter_values in parameter_columns]


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
    selection_options: SolverSelectionOptions = SOLVER_SELECTION_OPTIONS,
) -> StepBatchResult:
    """Return the result of `step_batch` for the paper's wheel, or for another model by diffrax."""
    slopes, stepwise_parameters = _split_slopes_by_step(
        parameter_columns[SLOPE_INDEX], n_steps, engine
    )
    parameter_columns = [
        slopes[0] if i == SLOPE_INDEX else x for i, x in enumerate(parameter_columns)
    ]
    work_order = sort_by_work(parameter_columns, states)
    parameter_rows = np.empty((len(parameter_columns), len(states)), states.dtype)
    for parameter_row, parameter_values in zip(parameter_rows, parameter_columns, strict=True):
        parameter_row[:] = (
            parameter_values[work_order] if parameter_values.ndim else parameter_values
        )
    is_uneven = bool(stepwise_parameters)
    slopes = slopes.take(work_order, -1) if is_uneven else slopes
    walks = WalkBatch(
        states.T.take(work_order, -1), derivative_names, PARAMETER_NAMES, stepwise_parameters
    )
    engine_settings = n_legs, walks.input_indices
    engine_by_solver = {
        SolverIndex.REQUESTED: _select_engine(engine, model, options, *engine_settings)
    }
    solver_index = np.full(len(states), SolverIndex.REQUESTED, np.int32)
    solver_names: tuple[str, ...] = (options.solver,)
    engine_name = engine_by_solver[SolverIndex.REQUESTED].name
    if engine == "auto" and engine_name == "lanes":
        solver_names = (
            options.solver,
            selection_options.stable_solver,
            selection_options.implicit_solver,
        )
        tightened_options = options.with_derivative_tolerances() if derivative_names else options
        solver_index = select_solver(parameter_rows, tightened_options, selection_options)
    if np.any(solver_index != SolverIndex.REQUESTED):
        implicit_options = dataclasses.replace(options, solver=selection_options.implicit_solver)
        stable_options = dataclasses.replace(options, solver=selection_options.stable_solver)
        stable_options = stable_options.with_tightened_tolerances(
            selection_options.stable_tolerance_factor
        )
        engine_by_solver[SolverIndex.STABLE] = _select_engine(
            "lanes", model, stable_options, *engine_settings
        )
        engine_by_solver[SolverIndex.IMPLICIT] = _select_engine(
            "diffrax", model, implicit_options, *engine_settings
        )
    if engine == "collocation":
        engine_name = engine
        if durations is None or np.shape(durations) != states.shape:
            durations_shape = None if durations is None else np.shape(durations)
            raise ValueError(
                f"durations have shape {durations_shape}, but collocation needs those of DLS, "
                "SLS-I and SLS-II to some per cent, shape (elements, 3): give those of a limit "
                "cycle, or take 'lanes'."
            )
        expected_durations = check_numpy_reals("durations", durations)
        walks.durations[:] = expected_durations.astype(parameter_rows.dtype).T.take(work_order, -1)
    for k in range(n_steps):
        active_lanes = walks.active_lanes()
        if is_uneven:
            parameter_rows[SLOPE_INDEX] = slopes[k]
        if engine == "collocation" and len(active_lanes):
            lane_index = make_lane_index(active_lanes, walks)
            lane_arrays = (
                parameter_rows[:, lane_index],
                walks.section_state[:, lane_index],
                walks.durations[:, lane_index],
            )
            collocation_result = _step_by_collocation(
                engine_by_solver[SolverIndex.REQUESTED], model, n_legs, *lane_arrays
            )
            walks.record_step(active_lanes, *collocation_result)
            continue
        for engine_index, selected_engine in engine_by_solver.items():
            lane_indices = active_lanes[solver_index[active_lanes] == engine_index]
            if len(lane_indices) > 0:
                lane_index = make_lane_index(lane_indices, walks)
                next_slopes = (slopes[k + 1][lane_index],) if is_uneven else ()
                result = selected_engine.take_step(
                    parameter_rows[:, lane_index], walks.section_state[:, lane_index], *next_slopes
                )
                if engine_index == SolverIndex.STABLE:
                    # A phase may last longer than `select_solver` assumes. The implicit solver,
                    # which is next, then repeats the step.
                    has_failed = result[2] == Outcome.SOLVER_FAILED
                    solver_index[lane_indices[has_failed]] = SolverIndex.IMPLICIT
                    lane_indices = lane_indices[~has_failed]
                    result = tuple(result_part[..., ~has_failed] for result_part in result)
                walks.record_step(lane_indices, result, np.zeros(len(lane_indices), bool))
    return walks.to_result(work_order, solver_index, engine_name, solver_names)


def _split_slopes_by_step(
    slope: np.ndarray, n_steps: int, engine: str
) -> tuple[Any, dict[str, StepwiseParameter]]:
    """Return the slopes of the lines of all steps, and the role of the slope in the steps.

    On flat ground the results are a list with the slope, and an empty mapping.
    """
    if slope.ndim < 2:
        return [slope], {}
    if engine == "collocation":
        raise ValueError(
            "engine is 'collocation', which takes one slope, but slope is an array over steps: "
            "take 'auto', 'lanes' or 'diffrax'."
        )
    n_values = slope.shape[1]
    chain_rule_terms = lambda k: ((0, k, 1.0), (1, min(k + 1, n_values - 1), 1.0))
    stepwise_slope = StepwiseParameter((SLOPE_INDEX, NEXT_SLOPE_INDEX), n_values, chain_rule_terms)
    return complete_batch_slopes(slope, n_steps), {"slope": stepwise_slope}


def sort_by_work(parameter_columns: list[np.ndarray], states: np.ndarray) -> np.ndarray:
    """Return an order of the batch in which wheels of similar work are side by side.

    A group of lanes takes as long as its slowest lane. Most of a step's work is in SLS-I. There,
    stability limits the solver's steps by m/c. Leg 2 extends at the rate k (Ls - L)/c from its
    length at release. The exponents are rounded from a fit to solver steps of wheels near and away
    from their gaits (`python -m experiments.speed.straggler_steps`).
    """
    values_by_name = dict(zip(PARAMETER_NAMES, parameter_columns, strict=True))
    as_float32 = lambda name: np.asarray(values_by_name[name], np.float32)
    with np.errstate(all="ignore"):
        theta, dtheta = states.T[:2].astype(np.float32)
        leg_length, leg_mass = as_float32("locked_length"), as_float32("leg_mass")
        log_work = np.log(as_float32("damping") / leg_mass) - 0.25 * np.log(
            as_float32("stiffness") / leg_mass
        )
        log_work = (
            log_work + 0.8 * np.log(dtheta) + 0.65 * np.log(leg_length / as_float32("gravity"))
        )
        log_work = log_work + theta - 7.0 * as_float32("natural_length") / leg_length
    return np.argsort(log_work)


class _BatchEngine(NamedTuple):
    """Engine that takes one gait step of any number of lanes, in numpy arrays with lanes on the
    last axis.
    """

    name: str
    take_step: Callable[..., tuple[np.ndarray, ...]]
    """Function of parameters, section states and, on uneven ground, slopes of the next lines. It
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
    parameter_rows: np.ndarray,
    states: np.ndarray,
    *next_slopes: np.ndarray,
) -> tuple[np.ndarray, ...]:
    """Return one gait step by the lane engine; see `_BatchEngine.take_step`."""
    option_leaves, options_structure = jax.tree.flatten(options)
    lane_independent = [np.asarray(leaf, parameter_rows.dtype) for leaf in option_leaves]
    tableau, n_parameters = load_explicit_tableau(options.solver), len(PARAMETER_NAMES)
    assert tableau is not None  # `_select_engine` has checked the solver.

    def lane_step(
        lane_independent: Any, lane_inputs: Any, straggler_count: Array | None = None
    ) -> tuple:
        current_options = jax.tree.unflatten(options_structure, lane_independent)
        if input_indices:
            current_options = current_options.with_derivative_tolerances()

        def step_outputs(*lane_inputs: Array) -> tuple:
            params = wheel_from_parameters(
                lane_inputs[:n_parameters], n_legs, *lane_inputs[NEXT_SLOPE_INDEX:]
            )
            x = lane_inputs[n_parameters:NEXT_SLOPE_INDEX]
            step_result = take_gait_step(
                params, x, current_options, tableau, stop_at_lift_off, straggler_count
            )
            diagnostics = step_result.is_unfinished, step_result.outcome, step_result.solver_steps
            return jnp.stack([*step_result.section_state, *step_result.durations]), diagnostics

        if not input_indices:
            step_values, diagnostics = step_outputs(*lane_inputs)
            return (*diagnostics, step_values)
        # With respect to all inputs, two columns follow from the units.
        needs_all_inputs = len(input_indices) == len(lane_inputs)
        compute_columns = (
            complete_jacobian_columns if needs_all_inputs else compute_jacobian_columns
        )
        jacobian, step_values, diagnostics = compute_columns(
            step_outputs, lane_inputs, input_indices
        )
        return (*diagnostics, step_values, jacobian)

    cache_key = (
        "gait step",
        n_legs,
        stop_at_lift_off,
        options_structure,
        input_indices,
        *("uneven" for _ in next_slopes),
    )
    n_inputs = N_STEP_INPUTS + len(next_slopes)
    register_limits = simd.RegisterLimits(n_inputs) if input_indices else simd.DEFAULT_LIMITS
    lane_arrays = [*parameter_rows, *states, *next_slopes]
    results = run_compiled(lane_step, lane_independent, lane_arrays, cache_key, register_limits)
    _, outcome, n_solver_steps, step_values, *jacobian = results
    return step_values[:3], step_values[3:], outcome, n_solver_steps, *jacobian


def _step_by_collocation(
    lane_engine: _BatchEngine,
    model: Any,
    n_legs: int,
    parameter_rows: np.ndarray,
    states: np.ndarray,
    durations: np.ndarray,
) -> tuple[tuple[np.ndarray, ...], np.ndarray]:
    """Return one step by collocation, and which lanes passed its check.

    Lanes that failed are stepped by the lane engine. The results are those of
    `_BatchEngine.take_step`.
    """
    stop_at_lift_off, n_parameters = model.stop_at_lift_off, len(PARAMETER_NAMES)

    def lane_step(
        lane_independent: Any, lane_inputs: Any, straggler_count: Array | None = None
    ) -> tuple:
        params = wheel_from_parameters(lane_inputs[:n_parameters], n_legs)
        x, expected_durations = tuple(lane_inputs[n_parameters:-3]), tuple(lane_inputs[-3:])
        collocation_step = collocation_gait_step(params, x, expected_durations, stop_at_lift_off)
        is_unfinished = jnp.zeros_like(collocation_step.is_trusted)
        step_values = jnp.stack([*collocation_step.section_state, *collocation_step.durations])
        return is_unfinished, collocation_step.is_trusted, step_values

    cache_key = ("gait step by collocation", n_legs, stop_at_lift_off)
    _, is_trusted, step_values = run_compiled(
        lane_step, [], [*parameter_rows, *states, *durations], cache_key
    )
    outcome, n_solver_steps = np.zeros((2, len(is_trusted)), np.int32)
    step_results = step_values[:3], step_values[3:], outcome, n_solver_steps
    untrusted_lanes = np.flatnonzero(~is_trusted)
    if len(untrusted_lanes) > 0:
        repeated_results = lane_engine.take_step(
            parameter_rows[:, untrusted_lanes], states[:, untrusted_lanes]
        )
        for all_values, new_values in zip(step_results, repeated_results, strict=True):
            all_values[..., untrusted_lanes] = new_values
    return step_results, is_trusted


def _step_by_diffrax(
    model: AbstractWheel,
    options: StepOptions,
    n_legs: int,
    input_indices: tuple[int, ...],
    parameter_rows: np.ndarray,
    states: np.ndarray,
    *next_slopes: np.ndarray,
) -> tuple[np.ndarray, ...]:
    """Return one step by the model's step under `jax.vmap`; see `_BatchEngine.take_step`."""
    convert_leaves = functools.partial(
        jax.tree.map, lambda leaf: np.asarray(leaf, parameter_rows.dtype)
    )
    tight_options = convert_leaves(options.with_derivative_tolerances())
    options = convert_leaves(options)
    input_rows = np.concatenate(
        [parameter_rows, states, *(slope_values[None] for slope_values in next_slopes)]
    ).T

    def step_rows(
        input_rows: np.ndarray, options: StepOptions, input_indices: tuple[int, ...]
    ) -> Any:
        step_block = functools.partial(_vmapped_step, model, options, n_legs, input_indices)
        results = map_in_batches(step_block, (batch_sizes.DIFFRAX_BATCH_SIZE,), input_rows)
        return jax.tree.map(lambda x: np.array(x).T, results)

    def differentiate_rows(input_rows: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return the step with derivatives, which are zero for elements without derivatives.

        diffrax raises an error for the whole batch if the linear equations of an implicit solver's
        derivative cannot be solved for one element. Bisection isolates that element.
        """
        try:
            results: tuple[np.ndarray, ...] = step_rows(input_rows, options, input_indices)
        except eqx.EquinoxRuntimeError:
            *step_values, n_solver_steps = step_rows(input_rows, tight_options, ())
            outcome = step_values[2]
            jacobian = np.zeros((len(input_indices), 6, len(input_rows)), parameter_rows.dtype)
            results = (*step_values, n_solver_steps, jacobian)
            has_stepped = np.flatnonzero(outcome == Outcome.STEPPED)
            if len(has_stepped) < len(input_rows):
                row_parts = [has_stepped]
            elif len(input_rows) > 1:
                row_parts = np.array_split(has_stepped, 2)
            else:
                row_parts, outcome[:] = [], Outcome.SOLVER_FAILED
            for row_part in (row_part for row_part in row_parts if len(row_part)):
                part_results = differentiate_rows(input_rows[row_part])
                for all_values, part_values in zip(results, part_results, strict=True):
                    all_values[..., row_part] = part_values
        return results

    return differentiate_rows(input_rows) if input_indices else step_rows(input_rows, options, ())


@eqx.filter_jit
def _vmapped_step(
    model: AbstractWheel,
    options: StepOptions,
    n_legs: int,
    input_indices: tuple[int, ...],
    input_rows: Array,
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
        step_values = result.section_state, result.durations, result.outcome, result.solver_steps
        return *step_values, jacobian

    return jax.vmap(step_one)(input_rows)
