"""Gait steps of batches of wheels: one function with a choice of engines.

On a CPU the engine "lanes" is machine code that computes a few lanes (elements of the batch) at a
time (`lanes`). On a GPU it is an XLA program for thousands of lanes, which runs again in smaller
batches for the unfinished lanes. Every lane runs the same code, and no data pass between lanes. The
result for a batch element is therefore bitwise the same alone, in any batch and in any order.
Wheels whose steps need similar work are neighbors in the batch. The cheapest solver is selected for
each wheel, based on the stiffness of its airborne leg.
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from enum import IntEnum
from typing import Any, Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from vrw_jax import lanes
from vrw_jax.base.checks import (
    check_choice,
    check_int,
    check_names,
    check_numpy_reals,
    check_reals,
    check_type,
    require_untraced_arguments,
)
from vrw_jax.base.options import SolverName, StepOptions
from vrw_jax.base.progress import announce_wait
from vrw_jax.base.results import Outcome
from vrw_jax.base.walker import (
    AbstractWalker,
    check_parameters,
    find_batch_length,
    is_own_walker,
    name_section,
    step_batch_of_walker,
)
from vrw_jax.flow.solver_steps import compute_real_stability_limit, load_explicit_tableau
from vrw_jax.lanes.autodiff import compute_jacobian_columns
from vrw_jax.lanes.batching import map_in_batches, select_tree_rows
from vrw_jax.lanes.lane_function import CompiledBatchFunction, compile_batch_function
from vrw_jax.models.interface import AbstractWheel
from vrw_jax.models.stepping import (
    convert_heights,
    convert_model_argument,
    convert_section_state,
    convert_step_options,
)
from vrw_jax.models.viscoelastic import N_STEP_INPUTS, advance_gait_step
from vrw_jax.models.walk_batch import (
    DIFFRAX_BATCH_SIZE,
    START_INPUT_NAME,
    XLA_LANE_BATCH_SIZE,
    StepBatchResult,
    StepInput,
    WalkBatch,
    complete_jacobian_columns,
    list_rises,
    make_step_input,
    select_lanes,
    step_batch_with_contact,
)
from vrw_jax.wheel.params import (
    FRICTION_NAME,
    NO_LAWS,
    PARAMETER_NAMES,
    WheelParams,
    make_wheel_from_parameters,
)

BatchEngineName = Literal["auto", "lanes", "diffrax"]
BATCH_ENGINE_NAMES: tuple[str, ...] = get_args(BatchEngineName)

SLOPE_INPUT_INDEX = PARAMETER_NAMES.index("slope")
"""Index of the slope among the inputs of a gait step.

The inputs are the parameters, the section state and, on uneven ground, the slope of the ground
after the next landing or two rises (see `models.select_stance_line`).
"""


@announce_wait("batches of gait steps", "10 s")
def step_batch(
    params: Any,
    states: Array | np.ndarray,
    n_steps: int = 1,
    *,
    model: AbstractWalker | None = None,
    options: StepOptions | None = None,
    engine: BatchEngineName = "auto",
    derivatives: Sequence[str] = (),
    heights: Array | np.ndarray | None = None,
) -> StepBatchResult:
    """Return the result of up to `n_steps` gait steps of many wheels, with derivatives if
    requested.

    The engine "lanes" is the fastest. It supports the viscoelastic wheel and explicit solvers. The
    engine "diffrax" maps `model.advance` over the batch and accepts any solver. "auto" selects
    "lanes" if possible; `StepBatchResult.engine` is the selected engine. `options` limits the error
    of each solver step. The results of the two engines differ by about ten times the tolerance.

    "auto" also replaces the requested solver if the airborne leg is so stiff that another solver is
    cheaper. `StepBatchResult.solver_index` identifies the selected solver. The stiffness is c/m,
    the ratio of damping to leg mass. Tsit5 is selected if stability limits the solver steps: from
    c/m = 1,900 1/s at the default options, and from 300 1/s at a tolerance of 1e-6. Kvaerno5 in
    "diffrax" is selected if Tsit5 failed, or if explicit solvers need too many solver steps: from
    c/m = 4e5 1/s at the default options, and from 1.4e5 1/s at a tolerance of 1e-6.

    Derivatives are those of the result of all gait steps and include their events. The derivatives
    are zero for a wheel that fell. With unilateral contact (`UnilateralWheel`) the only engine is
    "lanes", and friction is a scalar or an array over the batch. The function compiles its programs
    itself, so it cannot be called inside `jax.jit`.

    On uneven ground the slope has the shape (elements, n_steps) or (elements, n_steps + 1), with
    one value per gait step as in `walk`. With unilateral contact, friction may have these shapes
    too. Heights of footholds, as in `walk`, may be given instead of such slopes. Derivatives with
    respect to such an array have the axis over gait steps last.

    For a walker of yours, `params` are its parameters, and `states` are section coordinates. The
    only engine is "lanes", without derivatives. A parameter of shape (elements, n_steps) has a
    value for each step. With `ground`, the walker takes `heights` of shape (elements, n_steps + 1).

    Args:
        params: parameters of the wheels. Each field is a scalar or has the shape (elements,); the
            slope may also have the shapes above.
        states: section states in the form of the paper's model, shape (elements, 3), rad, rad/s,
            m/s, or in the form of `model`.
        n_steps: largest number of gait steps.
        model: model of the wheel; by default the paper's, `ViscoelasticWheel()`.
        options: numerical options of the gait steps.
        engine: "auto", "lanes" or "diffrax".
        derivatives: inputs with respect to which derivatives are computed: "section_state" and
            names of parameters; with unilateral contact "friction" too, and "heights" if given.
        heights: heights of the footholds above the mean line, shape (elements, n_steps + 1) or
            (elements, n_steps + 2), m.

    Returns:
        A `StepBatchResult` for the last gait step of each element.

    Raises:
        TypeError, ValueError: if an argument is invalid; the message names the remedy.

    Examples:
        >>> params = vrw.WheelParams(damping=np.array([120.0, 150.0, 180.0]))
        >>> result = vrw.step_batch(params, np.tile(vrw.paper_start(), (3, 1)), 10)
        >>> result.durations.shape, result.n_stepped.tolist(), result.engine
        ((3, 3), [10, 10, 10], 'lanes')
    """
    require_untraced_arguments(
        "vrw.step_batch",
        "map vrw.return_map over the lanes",
        *(params, states, heights, model, options),
    )
    check_choice("engine", engine, BATCH_ENGINE_NAMES)
    n_steps, options = check_int("n_steps", n_steps), convert_step_options(options)
    step_walker = _step_batch_of_own_walker if is_own_walker(model) else _step_batch_of_wheel
    return step_walker(model, params, states, n_steps, options, engine, derivatives, heights)


def _step_batch_of_wheel(
    model: Any,
    params: Any,
    states: Any,
    n_steps: int,
    options: StepOptions,
    engine: str,
    derivatives: Any,
    heights: Any,
) -> StepBatchResult:
    check_type("params", params, WheelParams, "write vrw.WheelParams(damping=..., slope=...)")
    model = convert_model_argument(model, allows_friction_arrays=True)
    if model.fallback_model is not model:
        raise ValueError(
            "model selects a model for each wheel, but a batch of steps has one: give "
            "vrw.ViscoelasticWheel() or vrw.UnilateralWheel(), or call vrw.step for each wheel."
        )
    derivatives = check_names("derivatives", derivatives, '"section_state", "damping"')
    params = model.attach_laws(params)
    states = convert_section_state(states, "states", check_numpy_reals)
    n_elements = len(states) if states.ndim else 0
    values_by_parameter = _check_parameter_shapes(params, states, model, options, n_steps)
    slopes, dtype = values_by_parameter[SLOPE_INPUT_INDEX], values_by_parameter[0].dtype
    heights = convert_heights(heights, model, slopes.ndim == 2, check_numpy_reals)
    known_input_names = START_INPUT_NAME, *model.parameter_names
    if heights is not None:
        known_input_names += ("heights",)
        if heights.shape not in ((n_elements, n_steps + 1), (n_elements, n_steps + 2)):
            raise ValueError(
                f"heights have shape {heights.shape}, but there are {n_elements} states "
                f"and {n_steps} steps: give {n_steps + 1} heights of footholds for each state, or "
                f"{n_steps + 2} with that before the walk."
            )
    for derivative_name in derivatives:
        if derivative_name not in known_input_names:
            raise ValueError(
                f"derivatives contain {derivative_name!r}, but a step depends on "
                f"{', '.join(known_input_names)}: give names of these."
            )
    make_input = lambda name, values, *offset: make_step_input(
        name, values, n_steps, n_elements, *offset
    )
    inputs = [*map(make_input, model.parameter_names, values_by_parameter)]
    if heights is not None:
        next_line = list_rises(heights.astype(dtype, copy=False), n_steps)
    else:
        next_line = [make_input("slope", slopes, 1)] * (slopes.ndim == 2)
    has_contacts = model.batch_kernel == "legs"
    step = step_batch_with_contact if has_contacts else _step_batch_without_contact
    return step(
        model,
        inputs,
        next_line,
        states.astype(dtype, copy=False),
        n_steps,
        options,
        engine,
        params.n_legs,
        derivatives,
    )


def _step_batch_of_own_walker(
    walker: Any,
    params: Any,
    states: Any,
    n_steps: int,
    options: StepOptions,
    engine: str,
    derivatives: Any,
    heights: Any,
) -> StepBatchResult:
    if derivatives or "diffrax" in (engine, options.engine):
        raise ValueError(
            'derivatives and engine="diffrax" are for models of the wheel only: differentiate '
            "vrw.step of your walker, and map it with jax.vmap."
        )
    if heights is not None:
        if np.ndim(heights) != 2 or (np.ndim(states) == 2 and len(heights) != len(states)):
            raise ValueError(
                f"heights have shape {np.shape(heights)}, but there are {len(states)} states "
                f"and {n_steps} steps: give {n_steps + 1} heights for each state."
            )
        params = walker.put_on_heights(check_parameters(params), heights, n_steps)
    params, states = jax.tree.map(np.asarray, (check_parameters(params), check_reals("x", states)))
    if states.ndim == 0:
        raise ValueError(
            "states is one number, but a start has section coordinates: give a row of them, or one "
            "row for each element of the batch."
        )
    n_elements = find_batch_length(params, states, "states")
    for leaf in jax.tree.leaves(params):
        if leaf.ndim > 1 and leaf.shape[1:] != (n_steps,):
            raise ValueError(
                f"a parameter has shape {leaf.shape}, but there are {n_elements} elements and "
                f"{n_steps} steps: give one number, {n_elements}, or one for each step of each."
            )
    batch = WalkBatch(np.array(np.broadcast_to(states, (n_elements, states.shape[-1]))).T)
    arrays, numbers = eqx.partition(params, lambda leaf: leaf.ndim > 0)

    def step_lanes(walking: np.ndarray, _: None, x: np.ndarray, k: int) -> tuple[np.ndarray, ...]:
        of_step = jax.tree.map(lambda leaf: leaf[:, k] if leaf.ndim > 1 else leaf, arrays)
        rows = eqx.combine(select_tree_rows(of_step, walking), numbers)
        step = step_batch_of_walker(walker, rows, x.T, options)
        has_stepped = (step.outcome == Outcome.STEPPED)[:, None]
        section_state = np.where(has_stepped, step.section_state, 0.0)
        return section_state.T, step.durations.T, step.outcome, step.solver_steps

    batch.take_steps(n_steps, step_lanes)
    result = batch.make_batch_result("lanes", (options.solver,))
    return dataclasses.replace(result, section=name_section(walker))


def _check_parameter_shapes(
    params: WheelParams,
    section_states: np.ndarray,
    model: AbstractWheel,
    options: StepOptions,
    n_steps: int,
) -> list[np.ndarray]:
    """Return each parameter as a scalar or an array over the batch, in the order of
    `parameter_names` of the model.

    The slope, and with unilateral contact the friction, may have a second axis over gait steps.
    Raise ValueError if the shapes of states and parameters do not fit.
    """
    allowed_section_sizes = sorted({3, model.count_section_entries(params)})
    if section_states.ndim != 2 or section_states.shape[1] not in allowed_section_sizes:
        raise ValueError(
            f"states have shape {section_states.shape}, but section states have the shape "
            f"(elements, {' or '.join(map(str, allowed_section_sizes))}): write states[None] for a "
            "single one."
        )
    n_section_states = len(section_states)
    values_by_parameter = model.list_parameter_values(params)
    n_parameters = len(values_by_parameter) - (FRICTION_NAME in model.parameter_names)
    parameter_dtype = np.result_type(*(x.dtype for x in values_by_parameter[:n_parameters]))
    StepOptions.check_tolerances(options, parameter_dtype)  # a bound method takes 0.1 ms
    for parameter_name, parameter_values in zip(
        model.parameter_names, values_by_parameter, strict=True
    ):
        is_parameter_stepwise = (
            parameter_name in ("slope", FRICTION_NAME) and np.ndim(parameter_values) == 2
        )
        allowed_shapes: list[tuple[int, ...]] = [(), (n_section_states,)]
        if is_parameter_stepwise:
            allowed_shapes += [(n_section_states, n_steps), (n_section_states, n_steps + 1)]
        if np.shape(parameter_values) not in allowed_shapes:
            stepwise_advice = f" and {n_steps} or {n_steps + 1} of each over its steps"
            raise ValueError(
                f"{parameter_name} has shape {np.shape(parameter_values)}, but there are "
                f"{n_section_states} states"
                f"{f' and {n_steps} steps' * is_parameter_stepwise}: give one value for all, or "
                "one for each"
                f"{stepwise_advice * is_parameter_stepwise}."
            )
    dtype = np.promote_types(parameter_dtype, section_states.dtype)
    return [np.asarray(x, dtype) for x in values_by_parameter]


def _step_batch_without_contact(
    model: Any,
    inputs: list[StepInput],
    next_line: list[StepInput],
    section_states: np.ndarray,
    n_steps: int,
    options: StepOptions,
    requested_engine: str,
    n_legs: int,
    derivative_names: Sequence[str],
) -> StepBatchResult:
    n_wheels, n_parameters = len(section_states), len(inputs)
    wheel_order = order_wheels_by_work([x.select_values(0) for x in inputs], section_states)
    inputs = [x._replace(values=x.values[..., wheel_order]) for x in (*inputs, *next_line)]
    batch = WalkBatch(section_states.T.take(wheel_order, -1), inputs, derivative_names)
    # The kernels take parameters, section states, and then values of the ground.
    kernel_order = [*range(n_parameters), *range(n_parameters + 3, len(inputs) + 3)]
    kernel_order += range(n_parameters, n_parameters + 3)
    select_engine = functools.partial(
        _select_batch_engine, model, n_legs, tuple(kernel_order[i] for i in batch.input_indices)
    )
    engine_by_solver = {SolverIndex.REQUESTED_SOLVER: select_engine(requested_engine, options)}
    solver_indices = np.full(n_wheels, SolverIndex.REQUESTED_SOLVER, np.int32)
    solver_names: tuple[str, ...] = (options.solver,)
    engine_name, _ = engine_by_solver[SolverIndex.REQUESTED_SOLVER]
    if requested_engine == "auto" and engine_name == "lanes":
        solver_names = (options.solver, STABLE_SOLVER_NAME, IMPLICIT_SOLVER_NAME)
        solver_indices = select_cheapest_solver(
            batch.input_matrix,
            options.with_derivative_tolerances() if derivative_names else options,
        )
        if np.any(solver_indices != SolverIndex.REQUESTED_SOLVER):
            engine_by_solver[SolverIndex.STABLE_SOLVER] = select_engine(
                "lanes",
                dataclasses.replace(options, solver=STABLE_SOLVER_NAME).with_tightened_tolerances(
                    STABLE_SOLVER_TIGHTENING_FACTOR
                ),
            )
            engine_by_solver[SolverIndex.IMPLICIT_SOLVER] = select_engine(
                "diffrax", dataclasses.replace(options, solver=IMPLICIT_SOLVER_NAME)
            )

    def step_lanes(walking: np.ndarray, inputs: np.ndarray, x: np.ndarray, k: int) -> tuple:
        positions, outputs = [], []
        for solver_index, (_name, take_lane_steps) in engine_by_solver.items():
            chosen = np.flatnonzero(solver_indices[walking] == solver_index)
            if not len(chosen):
                continue
            lanes = select_lanes(chosen, len(walking))
            parameters, ground = np.split(inputs[:, lanes], [n_parameters])
            step_outputs = take_lane_steps(parameters, x[:, lanes], *ground)
            if solver_index == SolverIndex.STABLE_SOLVER:
                # A phase may last longer than `select_cheapest_solver` assumes. The implicit
                # solver, which is next, then repeats the step.
                has_failed = step_outputs[2] == Outcome.SOLVER_FAILED
                solver_indices[walking[chosen[has_failed]]] = SolverIndex.IMPLICIT_SOLVER
                chosen = chosen[~has_failed]
                step_outputs = tuple(x[..., ~has_failed] for x in step_outputs)
            positions.append(chosen)
            outputs.append(step_outputs)
        if len(outputs) == 1:
            return outputs[0]
        order = np.argsort(np.concatenate(positions))
        return tuple(np.concatenate(x, -1)[..., order] for x in zip(*outputs, strict=True))

    batch.take_steps(n_steps, step_lanes, model)
    return batch.make_batch_result(engine_name, solver_names, wheel_order, solver_indices)


def order_wheels_by_work(
    values_by_parameter: list[np.ndarray], section_states: np.ndarray
) -> np.ndarray:
    """Return the batch indices sorted by the estimated work of a gait step, shape (elements,).

    A group of lanes takes as long as its slowest lane, so wheels that need similar work become
    neighbors. Most of the work is in SLS-I, in which stability limits the solver steps by m/c.
    Leg 2 extends at the rate k (Ls - L)/c from its length at release. The exponents are rounded
    from a fit to measured numbers of solver steps, for states near the gaits and far from them
    (`python -m experiments.speed.straggler_steps`).
    """
    with np.errstate(all="ignore"):
        float32_values = [np.asarray(x, np.float32) for x in values_by_parameter]
        p = dict(zip(PARAMETER_NAMES, float32_values, strict=False))
        theta, dtheta = section_states.T[:2].astype(np.float32)
        log_solver_work = (
            np.log(p["damping"] / p["leg_mass"])
            - 0.25 * np.log(p["stiffness"] / p["leg_mass"])
            + 0.8 * np.log(dtheta)
            + 0.65 * np.log(p["locked_length"] / p["gravity"])
            + theta
            - 7.0 * p["natural_length"] / p["locked_length"]
        )
    return np.argsort(log_solver_work)


LaneStepFunction = Callable[..., tuple[np.ndarray, ...]]
"""Function that computes one gait step for any number of lanes, which are on the last axis.

Its arguments are parameters, section states and, on uneven ground, the values of the ground. It
returns section states, durations, outcomes, numbers of solver steps and, if derivatives are
requested, Jacobians.
"""


def _select_batch_engine(
    model: Any,
    n_legs: int,
    input_indices: tuple[int, ...],
    requested_engine: str,
    options: StepOptions,
) -> tuple[str, LaneStepFunction]:
    """Return the name and the function of the requested engine, or those of the fastest engine that
    supports the model and the solver if "auto" is requested.
    """
    has_lane_kernel = (
        model.batch_kernel == "phases" and load_explicit_tableau(options.solver) is not None
    )
    if requested_engine == "lanes" and not has_lane_kernel:
        raise ValueError(
            f"the lane engine can't run {type(model).__name__} with {options.solver}: it supports "
            "the viscoelastic wheel and explicit Runge-Kutta solvers; take engine='diffrax'."
        )
    if requested_engine == "diffrax" or not has_lane_kernel:
        step_by_diffrax = functools.partial(
            _step_lanes_by_diffrax, model, options.with_engine("diffrax"), n_legs, input_indices
        )
        return "diffrax", step_by_diffrax

    def step_by_kernel(
        parameter_matrix: np.ndarray, section_states: np.ndarray, *ground_inputs: np.ndarray
    ) -> tuple[np.ndarray, ...]:
        compiled_step = _compile_lane_step(
            model.stop_at_lift_off,
            jax.tree.structure(model.laws),
            n_legs,
            input_indices,
            len(ground_inputs),
        )
        _, step_outcomes, n_solver_steps, step_outputs, *step_jacobian = compiled_step.run(
            jax.tree.map(lambda x: np.asarray(x, parameter_matrix.dtype), options),
            (*parameter_matrix, *section_states, *ground_inputs),
        )
        return step_outputs[:3], step_outputs[3:], step_outcomes, n_solver_steps, *step_jacobian

    return "lanes", step_by_kernel


@functools.cache
def _compile_lane_step(
    stop_at_lift_off: bool,
    law_structure: Any,
    n_legs: int,
    input_indices: tuple[int, ...],
    n_ground_inputs: int,
) -> CompiledBatchFunction:
    """Return a compiled gait step of lanes, a function of options and inputs."""
    n_law_parameters = law_structure.num_leaves
    n_parameters = len(PARAMETER_NAMES) + n_law_parameters

    def step_lanes(
        options: StepOptions, lane_step_inputs: Any, straggler_count: Array | None = None
    ) -> tuple:
        options = options.with_derivative_tolerances() if input_indices else options

        def compute_step_outputs(*lane_step_inputs: Array) -> tuple:
            params = make_wheel_from_parameters(
                lane_step_inputs[:n_parameters],
                n_legs,
                *lane_step_inputs[n_parameters + 3 :],
                law_structure=law_structure,
            )
            x = lane_step_inputs[n_parameters : n_parameters + 3]
            step_result, is_unfinished = advance_gait_step(
                params, x, options, stop_at_lift_off, straggler_count
            )
            step_diagnostics = is_unfinished, step_result.outcome, step_result.solver_steps
            return jnp.stack([*step_result.section_state, *step_result.durations]), step_diagnostics

        if not input_indices:
            step_outputs, step_diagnostics = compute_step_outputs(*lane_step_inputs)
            return (*step_diagnostics, step_outputs)
        # With respect to all inputs, two columns follow from the units, which a law may not have.
        differentiates_all_inputs = (
            len(input_indices) == len(lane_step_inputs) <= N_STEP_INPUTS + 1
            and law_structure == NO_LAWS
        )
        compute_jacobian_of_columns = (
            complete_jacobian_columns if differentiates_all_inputs else compute_jacobian_columns
        )
        step_jacobian, step_outputs, step_diagnostics = compute_jacobian_of_columns(
            compute_step_outputs, lane_step_inputs, input_indices
        )
        return (*step_diagnostics, step_outputs, step_jacobian)

    n_kernel_inputs = N_STEP_INPUTS + n_law_parameters + n_ground_inputs
    return compile_batch_function(
        step_lanes,
        XLA_LANE_BATCH_SIZE,
        n_kernel_inputs if input_indices else lanes.MAX_UNROLLED_ENTRIES,
        marks_unfinished_lanes=True,
    )


def _step_lanes_by_diffrax(
    model: AbstractWheel,
    options: StepOptions,
    n_legs: int,
    input_indices: tuple[int, ...],
    parameter_matrix: np.ndarray,
    section_states: np.ndarray,
    *ground_inputs: np.ndarray,
) -> tuple[np.ndarray, ...]:
    """Return the results of one gait step for all lanes, computed by `model.advance` under
    `jax.vmap`.

    The results are those of a `LaneStepFunction`.
    """
    to_dtype = functools.partial(jax.tree.map, lambda x: np.asarray(x, parameter_matrix.dtype))
    step_input_matrix = np.vstack([parameter_matrix, section_states, *ground_inputs]).T

    def step_elements(
        step_input_matrix: np.ndarray, options: StepOptions, input_indices: tuple[int, ...]
    ) -> Any:
        step_block = functools.partial(
            _step_elements_by_vmap, model, to_dtype(options), n_legs, input_indices
        )
        results = map_in_batches(step_block, (DIFFRAX_BATCH_SIZE,), step_input_matrix)
        return jax.tree.map(lambda x: np.array(x).T, results)

    def step_elements_with_jacobian(step_input_matrix: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return the results of one gait step for all elements, with Jacobians.

        A Jacobian is zero where no derivative exists. diffrax raises an error for the whole batch
        if the implicit solver's linear equations for the derivative of one element cannot be
        solved. Bisection isolates that element.
        """
        try:
            return step_elements(step_input_matrix, options, input_indices)
        except eqx.EquinoxRuntimeError:
            outputs = step_elements(step_input_matrix, options.with_derivative_tolerances(), ())
        outcomes, n_elements = outputs[2], len(step_input_matrix)
        jacobian = np.zeros((len(input_indices), 6, n_elements), parameter_matrix.dtype)
        results = (*outputs, jacobian)
        stepped = np.flatnonzero(outcomes == Outcome.STEPPED)
        retried_blocks = [stepped]
        if len(stepped) == n_elements > 1:
            retried_blocks = np.array_split(stepped, 2)
        elif len(stepped) == n_elements:
            retried_blocks, outcomes[:] = [], Outcome.SOLVER_FAILED
        for block in filter(len, retried_blocks):
            block_results = step_elements_with_jacobian(step_input_matrix[block])
            for result, block_result in zip(results, block_results, strict=True):
                result[..., block] = block_result
        return results

    return (
        step_elements_with_jacobian(step_input_matrix)
        if input_indices
        else step_elements(step_input_matrix, options, ())
    )


@eqx.filter_jit
def _step_elements_by_vmap(
    model: AbstractWheel,
    options: StepOptions,
    n_legs: int,
    input_indices: tuple[int, ...],
    step_input_matrix: Array,
) -> tuple[Array, ...]:
    """Return section state, durations, outcome and number of solver steps of one gait step for each
    element.

    If there are `input_indices`, return also the Jacobians.

    - `step_input_matrix`: inputs of the step, shape (elements, inputs);
    - `input_indices`: indices of the inputs with respect to which the Jacobian is computed.
    """
    law_structure: Any = jax.tree.structure(model.laws)
    n_parameters = len(PARAMETER_NAMES) + law_structure.num_leaves

    def step_one_element(step_inputs: Array) -> tuple[Array, ...]:
        def step_with_varied_inputs(varied_inputs: Array) -> tuple[Array, tuple[Array, ...]]:
            updated_step_inputs = step_inputs.at[np.array(input_indices, int)].set(varied_inputs)
            params = make_wheel_from_parameters(
                updated_step_inputs[:n_parameters],
                n_legs,
                *updated_step_inputs[n_parameters + 3 :],
                law_structure=law_structure,
            )
            x = updated_step_inputs[n_parameters : n_parameters + 3]
            step_result = model.advance(params, x, options)
            return jnp.concatenate([step_result.section_state, step_result.durations]), (
                step_result.section_state,
                step_result.durations,
                step_result.outcome,
                step_result.solver_steps,
            )

        varied_inputs = step_inputs[np.array(input_indices, int)]
        if not input_indices:
            return step_with_varied_inputs(varied_inputs)[1]
        step_jacobian, step_outputs = jax.jacfwd(step_with_varied_inputs, has_aux=True)(
            varied_inputs
        )
        return *step_outputs, step_jacobian

    return jax.vmap(step_one_element)(step_input_matrix)


class SolverIndex(IntEnum):
    """Index of a solver in `StepBatchResult.solver_names`."""

    REQUESTED_SOLVER = 0  # of the step options
    STABLE_SOLVER = 1  # explicit, for steps that stability limits
    IMPLICIT_SOLVER = 2  # for wheels that are too stiff for explicit solvers


# Explicit solver for wheels whose solver steps are limited by stability. Tsit5 is chosen because it
# has the largest stable solver step per evaluation among diffrax's solvers of order 5 and more.
# That step is 0.58 divided by the rate of the mode, and 0.40 for Dopri8.
STABLE_SOLVER_NAME: SolverName = "Tsit5"
# Factor by which the tolerances of the stable solver are divided. The factor is chosen because the
# tighter tolerance costs little. At tolerances of 1e-6 and below, the error is then at most that of
# Dopri8.
STABLE_SOLVER_TIGHTENING_FACTOR = 4.0
# Solver for wheels that are too stiff for explicit solvers.
IMPLICIT_SOLVER_NAME: SolverName = "Kvaerno5"
# Cost of the implicit solver at a tolerance of 1e-6, in evaluations of an explicit solver. The cost
# was measured (docs/verification/failures.md) and grows as the tolerance to the power of -0.17. The
# cost of explicit solvers at the limit of stability does not depend on the tolerance.
IMPLICIT_SOLVER_COST_EVALUATIONS = 6e4


def select_cheapest_solver(parameter_matrix: np.ndarray, options: StepOptions) -> np.ndarray:
    """Return the `SolverIndex` of the cheapest solver for each lane, shape (lanes,).

    Let c be the damping of a leg and m its mass. If legs are light, the airborne leg's fast mode
    decays at the rate 1.03 c/m for about 0.67 sqrt(L0 / g), s. Stability limits the product of
    solver step and decay rate. A tenth is added to the number of solver steps for rejected ones.
    The requested solver stays selected if accuracy requires more steps of the stable solver than
    stability does. The number that accuracy requires is about the tolerance to the power of -1/5. A
    solver that would need more than `max_solver_steps` is excluded.

    - `parameter_matrix`: parameters in the order of `PARAMETER_NAMES`, shape (9, lanes).
    """
    damping, leg_mass, locked_length, gravity = (
        parameter_matrix[PARAMETER_NAMES.index(name)]
        for name in ("damping", "leg_mass", "locked_length", "gravity")
    )
    rtol = float(options.rtol)
    with np.errstate(all="ignore"):
        n_decay_times = 1.03 * damping / leg_mass * 0.74 * np.sqrt(locked_length / gravity)

        def estimate_solver_cost(solver_name: str) -> tuple[np.ndarray, np.ndarray]:
            solver_tableau = load_explicit_tableau(solver_name)
            assert solver_tableau is not None  # The caller has checked the solver.
            n_evaluations_per_step = len(solver_tableau.stage_nodes) - 1
            n_solver_steps = n_decay_times / compute_real_stability_limit(solver_tableau)
            return n_solver_steps, np.where(
                n_solver_steps > options.max_solver_steps,
                np.inf,
                n_solver_steps * n_evaluations_per_step,
            )

        _, requested_solver_cost = estimate_solver_cost(options.solver)
        n_solver_steps, stable_solver_cost = estimate_solver_cost(STABLE_SOLVER_NAME)
        is_stability_limited = n_solver_steps > (rtol / STABLE_SOLVER_TIGHTENING_FACTOR) ** -0.2
        implicit_solver_cost = IMPLICIT_SOLVER_COST_EVALUATIONS * (1e-6 / rtol) ** 0.17
        solver_costs = (
            requested_solver_cost,
            np.where(is_stability_limited, stable_solver_cost, np.inf),
            np.full_like(n_decay_times, implicit_solver_cost),
        )
        return np.argmin(solver_costs, axis=0).astype(np.int32)  # 0 for an invalid wheel
