"""Single steps, the return map, and walks of many steps.

All functions are pure and take a single wheel. They work with `jit`, `vmap` and every mode of
differentiation. The function that computes a step is compiled once per model.
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any, Literal, overload

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Int

from vrw_jax import lanes
from vrw_jax.base.checks import check_int, check_reals, check_type, format_value
from vrw_jax.base.options import EngineName, StepOptions
from vrw_jax.base.progress import announce_wait
from vrw_jax.base.results import (
    AbstractPrintable,
    LabelAndText,
    Outcome,
    describe_outcomes,
    format_numbers,
    format_outcome_counts,
    format_quantity,
)
from vrw_jax.base.walker import (
    AbstractWalker,
    AdvanceResult,
    check_arguments,
    check_parameters,
    compile_step,
    is_own_walker,
    name_section,
)
from vrw_jax.models.contact_record import UnilateralStep
from vrw_jax.models.interface import AbstractWheel, StepGroundValues
from vrw_jax.models.ladder import LadderStep, LadderWheel, ModelChoice, describe_accepted_models
from vrw_jax.models.step_results import SectionState, StepResult
from vrw_jax.models.unilateral_wheel import UnilateralWheel
from vrw_jax.models.viscoelastic import ViscoelasticWheel
from vrw_jax.wheel.params import WheelParams, list_law_parameters

SectionStateLike = Array | np.ndarray | Sequence[float]
"""Section state in any form that users may pass.

`convert_step_arguments` converts it to an array.
"""
ModelLike = AbstractWalker | Literal["auto"]
"""Model in any form that users may pass, a walker of theirs included. "auto" means `LadderWheel()`,
which uses the simplest valid model.
"""


@lanes.with_default_jax_settings
def paper_start() -> SectionState:
    """Return a section state in the basin of attraction of the gait of Table 1 of the paper.

    Returns:
        The section state (theta-, dtheta-, dL1-), shape (3,), in rad, rad/s, m/s.

    Examples:
        >>> vrw.paper_start().round(4).tolist()
        [0.1, 1.6, -0.1]
    """
    return ViscoelasticWheel().compute_default_start(WheelParams())


def convert_model_argument(
    model: ModelLike | None, allows_friction_arrays: bool = False
) -> AbstractWheel:
    """Return the given model, the paper's model for None, or a `LadderWheel` for "auto".

    Raise a `TypeError` if the argument is not a model. Raise a `ValueError` if the model's friction
    is an array although `allows_friction_arrays` is False.
    """
    if model is None:
        return _make_default_model()
    if isinstance(model, str) and model == "auto":
        return LadderWheel()
    if is_own_walker(model):
        raise TypeError(
            f"model is {format_value(model)}, but this function computes with equations of the "
            "wheel, which a walker of yours does not have: the page on your own walker lists the "
            "functions that take it."
        )
    if not isinstance(model, AbstractWheel):
        raise TypeError(
            f"model is {format_value(model)}, but a model of the wheel is needed: give "
            f"{describe_accepted_models()}."
        )
    for name, other_remedy in {
        "friction": "vary it in a design of vrw.scan; vrw.step_batch takes one for each element, "
        "vrw.walk one for each of its steps",
        "restitution": "map over it with jax.vmap",
    }.items():
        shape = getattr(getattr(model, name, None), "shape", ())
        if shape and not allows_friction_arrays:
            raise ValueError(
                f"{name} has shape {shape}, but this call is for one ground: give one number, or "
                f"{other_remedy}."
            )
    for law_parameter in list_law_parameters(model.laws):
        if jnp.ndim(law_parameter.value) and not allows_friction_arrays:
            raise ValueError(
                f"{law_parameter.name} has shape {jnp.shape(law_parameter.value)}, but this call "
                "is for one wheel: give one number; vrw.step_batch and vrw.limit_cycles "
                "take one for each element."
            )
    return model


def require_compliant_model(model: Any, computation_text: str, command_name: str) -> None:
    """Raise a `TypeError` if springs and dampers do not affect the motion of a model.

    - `computation_text`: clause in the error message that states why compliant legs are required;
    - `command_name`: command whose accepted models the error message lists.
    """
    if not model.is_compliant:
        raise TypeError(
            f"model is {model!r}, but {computation_text} compliant legs: give "
            f"{describe_accepted_models(command_name)}."
        )


def require_legs_in_turn_by_collocation(model: Any, command_name: str) -> None:
    """Raise a `ValueError` if the legs of a model without collocation alternate."""
    if model.leg_period > 1 and model.batch_kernel != "phases":
        raise ValueError(
            f"the legs alternate, but with a {type(model).__name__} {command_name} takes gaits of "
            "one step only: give vrw.ViscoelasticWheel(leg_force=...), or one law for all legs."
        )


_make_default_model = functools.cache(ViscoelasticWheel)


def require_single_wheel(params: Any, remedy_text: str) -> None:
    """Raise a `TypeError` or a `ValueError` if `params` is not a single wheel.

    - `remedy_text`: advice with which the error message ends.
    """
    check_type("params", params, WheelParams, "write vrw.WheelParams(damping=..., slope=...)")
    WheelParams.require_single_wheel(params, remedy_text)  # An unbound call is much faster.


def convert_step_options(options: StepOptions | None) -> StepOptions:
    """Return the given step options, or `StepOptions()` for None.

    Raise a `TypeError` if the argument has another type.
    """
    if options is not None:
        check_type(
            "options", options, StepOptions, "give vrw.StepOptions(), or vrw.StepOptions.tight()"
        )
        StepOptions.require_scalar_options(
            options
        )  # An unbound call is faster: binding takes 0.1 ms.
    return _make_default_step_options(jnp.result_type(float)) if options is None else options


@functools.cache
def _make_default_step_options(dtype: np.dtype) -> StepOptions:
    """Return the default step options for a floating-point type.

    They are concrete even inside `jit`, and are created once per type.
    """
    with jax.ensure_compile_time_eval():
        return StepOptions()


def convert_section_state(
    x: Any, state_argument_name: str = "the section state", state_converter: Callable = check_reals
) -> Any:
    """Return the section state as an array, converted by `state_converter`.

    - `state_argument_name`: name of the argument in error messages;
    - `state_converter`: function that checks and converts the state, and raises an error if the
      state is invalid.
    """
    return state_converter(
        state_argument_name,
        x,
        "give (theta-, dtheta-, dL1-), as vrw.paper_start(), or that of a cycle, "
        "cycle.section_state",
    )


def convert_step_arguments(
    params: WheelParams,
    x: object,
    model: ModelLike | None,
    options: StepOptions | None,
    engine: EngineName = "auto",
    batch_remedy_text: str = "map over batches of parameters with jax.vmap, or use vrw.scan",
    allows_default_start: bool = False,
) -> tuple[WheelParams, Array, AbstractWheel, StepOptions]:
    """Return wheel, section state, model and options, converted to one floating-point type.

    Raise a `TypeError` or a `ValueError` if an argument is invalid.

    - `batch_remedy_text`: advice with which the error message for a batch of wheels ends;
    - `allows_default_start`: whether None as `x` is the default start of the model.
    """
    require_single_wheel(params, batch_remedy_text)
    model = convert_model_argument(model)
    options = StepOptions.with_engine(convert_step_options(options), engine)
    if x is None and allows_default_start:
        x = model.compute_default_start(params)
    section_state = convert_section_state(x)
    section_size = model.count_section_entries(params)
    if section_state.shape == (3,) and section_size != 3:
        section_state = model.complete_section_state(params, section_state)
    if section_state.shape != (section_size,):
        full_state_shape_text = (
            "" if section_size == 3 else f", or this model’s own of shape ({section_size},)"
        )
        raise ValueError(
            f"the section state has shape {section_state.shape}, but it is (theta-, dtheta-, "
            f"dL1-), shape (3,){full_state_shape_text}: for batches map over it with jax.vmap."
        )
    # Parameters made in single precision stay inaccurate after a conversion to double precision.
    parameter_dtype = jnp.result_type(*jax.tree.leaves(params))
    common_dtype = jnp.result_type(section_state, parameter_dtype)
    for dtype in {parameter_dtype, common_dtype}:
        StepOptions.check_tolerances(options, dtype)

    converted_arguments = params, section_state, options
    if any(leaf.dtype != common_dtype for leaf in jax.tree.leaves(converted_arguments)):
        converted_arguments = jax.tree.map(
            lambda leaf: leaf.astype(common_dtype), converted_arguments
        )
    params, section_state, options = converted_arguments
    return params, section_state, model, options


@overload
def step(  # type: ignore[overload-overlap]
    params: WheelParams,
    x: SectionStateLike,
    *,
    model: UnilateralWheel,
    options: StepOptions | None = None,
    engine: EngineName = "auto",
) -> UnilateralStep: ...


@overload
def step(  # type: ignore[overload-overlap]
    params: WheelParams,
    x: SectionStateLike,
    *,
    model: LadderWheel | Literal["auto"],
    options: StepOptions | None = None,
    engine: EngineName = "auto",
) -> LadderStep: ...


@overload
def step(
    params: WheelParams,
    x: SectionStateLike,
    *,
    model: AbstractWheel | None = None,
    options: StepOptions | None = None,
    engine: EngineName = "auto",
) -> StepResult: ...


@overload
def step(
    params: Any, x: Any, *, model: AbstractWalker, options: StepOptions | None = None
) -> Any: ...


@announce_wait("a gait step", "5 s")
def step(
    params: Any,
    x: Any,
    *,
    model: ModelLike | None = None,
    options: StepOptions | None = None,
    engine: EngineName = "auto",
) -> Any:
    """Compute one step from touchdown to touchdown, with its indicators, margins and energies.

    The `outcome` of the step describes how the step ended. A fall raises no exception. Numerical
    errors of the results and of their first derivatives are below 1e-9 with the default options,
    and below 1e-12 with `StepOptions.tight()`.

    Args:
        params: the wheel.
        x: section state (theta-, dtheta-, dL1-) just before touchdown, in rad, rad/s, m/s.
        model: the model; by default that of the paper, `ViscoelasticWheel()`. "auto" chooses the
            simplest valid model.
        options: numerical options of the steps.
        engine: engine that computes the steps; see `StepOptions`.

    Returns:
        A `StepResult`; a `UnilateralStep` with unilateral contact, a `LadderStep` for "auto", or a
        `HybridStep` for a `HybridSystem`. For a walker of yours, `params` are its parameters.

    Raises:
        TypeError, ValueError: if an argument is invalid; the message names the remedy.

    Examples:
        >>> step = vrw.step(vrw.WheelParams(damping=150.0), vrw.paper_start())
        >>> print(f"{step.period:.3f} s, {vrw.Outcome(int(step.outcome)).name}")
        0.714 s, STEPPED
    """
    if is_own_walker(model):
        options = convert_step_options(options).with_engine(engine)
        return compile_step(model)(*check_arguments(model, params, x, options, 1))
    params, section_state, model, options = _convert_single_step_arguments(
        params, x, model, options, engine
    )
    return model.take_step(params, section_state, options)


@announce_wait("a gait step", "5 s")
def return_map(
    params: WheelParams,
    x: SectionStateLike,
    *,
    model: ModelLike | None = None,
    options: StepOptions | None = None,
    engine: EngineName = "auto",
) -> Array:
    """Return the section state after one step, or zeros if the step failed.

    The function computes no margins. The map is differentiable in forward and reverse mode, to any
    order.

    Args:
        params: the wheel.
        x: section state (theta-, dtheta-, dL1-) just before touchdown, in rad, rad/s, m/s.
        model: the model; by default that of the paper, `ViscoelasticWheel()`. "auto" chooses the
            simplest valid model.
        options: numerical options of the steps.
        engine: engine that computes the steps; see `StepOptions`.

    Returns:
        The section state just before the next touchdown, with all entries of the model: shape (3,),
        and more with unilateral contact.

    Raises:
        TypeError, ValueError: if an argument is invalid; the message names the remedy.

    Examples:
        >>> params, x = vrw.WheelParams(damping=150.0), vrw.paper_start()
        >>> vrw.return_map(params, x).round(4).tolist()
        [0.091, 1.7355, -0.1587]
        >>> jax.jacfwd(vrw.return_map, argnums=1)(params, x).shape
        (3, 3)
    """
    params, section_state, model, options = _convert_single_step_arguments(
        params, x, model, options, engine
    )
    return model.advance(params, section_state, options).section_state


class Walk(AbstractPrintable):
    """Results of consecutive steps, without margins. Arrays have a leading axis over steps.

    - `start`: section state at the start;
    - `steps`: section state, durations and outcome of each step;
    - `n_stepped`: number of steps before the first failure;
    - `units`: units of the section state, for printing;
    - `section`: name of the section of a walker of yours, for printing.

    Examples:
        >>> walk = vrw.walk(vrw.WheelParams(damping=150.0), vrw.paper_start(), 5)
        >>> walk.steps.section_state.shape
        (5, 3)
    """

    start: Array
    steps: AdvanceResult
    n_stepped: Int[Array, ""]
    units: str = eqx.field(static=True, default="(rad, rad/s, m/s)")
    section: str = eqx.field(static=True, default="")

    @property
    def outcome(self) -> Array:
        """Return the outcome of the first failed step, or STEPPED if no step failed."""
        last_step_index = self.steps.outcome.shape[-1] - 1
        return jnp.take_along_axis(
            self.steps.outcome, jnp.minimum(self.n_stepped, last_step_index)[..., None], axis=-1
        )[..., 0]

    @property
    def ending(self) -> Any:
        """Return a sentence that describes how the walk ended, or an array of sentences for a
        batch.
        """
        return describe_outcomes(self.outcome, self.section)

    def summary_rows(self) -> list[LabelAndText]:
        """Return labels and printed texts: outcome, number of steps, start, last state and time."""
        walk_outcome = np.asarray(self.outcome)
        if walk_outcome.ndim:
            return [("walks", format_outcome_counts(walk_outcome, Outcome))]
        last_step_index = max(int(self.n_stepped) - 1, 0)
        return [
            ("outcome", self.ending),
            ("steps", f"{int(self.n_stepped)} of {self.steps.outcome.shape[-1]}"),
            ("start", f"{format_numbers(self.start)} {self.units}".strip()),
            ("last section state", format_numbers(self.steps.section_state[last_step_index])),
            ("time", format_quantity(np.sum(self.steps.durations), "s")),
        ]


@eqx.filter_jit
def _simulate_walk_by_scan(
    model: Any,
    params: Any,
    x: Array,
    options: StepOptions,
    n_steps: int,
    stepwise_ground: Any,
) -> Walk:
    """Simulate a walk of `n_steps` steps. Steps after a failure repeat the outcome of the failed
    step.

    - `stepwise_ground`: ground of each step, see `convert_walk_arguments`; None for flat ground.
    """

    def advance_walk_by_one_step(state_and_outcome: tuple, step_ground: Any) -> tuple:
        """Return the state and the outcome after one step, and the results of this step.

        After a failure, the state and the outcome do not change.
        """
        x, outcome = state_and_outcome
        is_walking = outcome == Outcome.STEPPED
        step_model, step_params = (
            (model, params) if step_ground is None else model.with_step_ground(params, step_ground)
        )
        x_or_nan = jnp.where(is_walking, x, jnp.nan)
        step_result = step_model.advance_checked(step_params, x_or_nan, options)
        outcome = jnp.where(is_walking, step_result.outcome, outcome)
        step_result = dataclasses.replace(
            step_result,
            durations=jnp.where(is_walking, step_result.durations, 0.0),
            outcome=outcome,
            solver_steps=jnp.where(is_walking, step_result.solver_steps, 0),
        )
        return (step_result.section_state, outcome), step_result

    step_results: AdvanceResult
    _, step_results = lax.scan(
        advance_walk_by_one_step, (x, jnp.int32(Outcome.STEPPED)), stepwise_ground, length=n_steps
    )
    n_stepped = jnp.sum(step_results.outcome == Outcome.STEPPED)
    labels = {} if model.is_wheel else {"units": "", "section": name_section(model)}
    return Walk(x, step_results, n_stepped, **labels)


@announce_wait("a gait step", "5 s")
def walk(
    params: Any,
    x: SectionStateLike,
    n_steps: int,
    *,
    model: ModelLike | None = None,
    options: StepOptions | None = None,
    engine: EngineName = "auto",
    heights: Array | np.ndarray | Sequence[float] | None = None,
) -> Walk:
    """Simulate a walk of `n_steps` steps. Steps after a failure repeat the outcome of the failed
    step.

    On uneven ground, `params.slope` is an array with one slope per step. The ground then consists
    of straight lines between the footholds with these slopes. In the double support of step k both
    feet are on line k. The step begins at the foothold where this line ends. The step ends when the
    next foot meets line k + 1. Therefore n steps use n + 1 slopes; if n slopes are given, the last
    one is used twice. A section state is in the frame of the line that ends at its landing; the
    start is in the frame of line 0. Force components are tangential and normal to line k. With
    unilateral contact, the friction of the model may also be an array with one coefficient per
    step. The coefficient of each foot is that of the step in which it landed.

    If `heights` are given, `params.slope` is the slope of a mean line, and foothold k lies at the
    height `heights[k]` above this line. Step k begins on foothold k and ends when the next foot is
    at the height of foothold k + 1. The foothold before the walk lies on the mean line, unless n +
    2 heights are given, of which the first is that of this foothold. The slope of the line between
    two footholds follows from their heights and from the distance of the feet at touchdown. A
    sliding foot keeps its height.

    For a walker of yours, `params` are its parameters. One that is an array has a value for each
    step.

    Args:
        params: the wheel.
        x: section state (theta-, dtheta-, dL1-) just before touchdown, in rad, rad/s, m/s.
        n_steps: largest number of steps.
        model: the model; by default that of the paper, `ViscoelasticWheel()`. "auto" chooses the
            simplest valid model.
        options: numerical options of the steps.
        engine: engine that computes the steps; see `StepOptions`.
        heights: heights of the footholds above the mean line, normal to it, shape (n_steps + 1,) or
            (n_steps + 2,), m.

    Returns:
        A `Walk` whose fields have a leading axis over the steps.

    Raises:
        TypeError, ValueError: if an argument is invalid; the message names the remedy.

    Examples:
        >>> walk = vrw.walk(vrw.WheelParams(damping=150.0), vrw.paper_start(), 5)
        >>> int(walk.n_stepped), walk.steps.durations.shape
        (5, (5, 3))
    """
    n_steps = check_int("n_steps", n_steps)
    convert: Any = convert_own_walk_arguments if is_own_walker(model) else convert_walk_arguments
    params, section_state, checked_model, options, stepwise_ground = convert(
        params, x, n_steps, model, options, engine, heights
    )
    return _simulate_walk_by_scan(
        checked_model, params, section_state, options, n_steps, stepwise_ground
    )


def convert_own_walk_arguments(
    params: Any,
    x: Any,
    n_steps: int,
    model: AbstractWalker,
    options: StepOptions | None,
    engine: EngineName,
    heights: object | None,
) -> tuple[Any, Array, AbstractWalker, StepOptions, Any]:
    """Return the arguments of a walk of a walker of the user, as `convert_walk_arguments` does.

    The ground of the steps consists of the parameters that are arrays.
    """
    options = convert_step_options(options).with_engine(engine)
    params = check_parameters(params)
    if heights is not None:
        params = model.put_on_heights(params, heights, n_steps)
    for leaf in jax.tree.leaves(params):
        if leaf.shape not in ((), (n_steps,)):
            raise ValueError(
                f"a parameter has shape {leaf.shape}, but a walk of {n_steps} steps takes one "
                f"number, or an array of {n_steps}: map over batches with jax.vmap."
            )
    stepwise, constant = eqx.partition(params, lambda leaf: leaf.ndim > 0)
    first_params = jax.tree.map(lambda leaf: leaf[0] if leaf.ndim else leaf, params)
    _, x, options = check_arguments(model, first_params, x, options, 1)
    return constant, x, model, options, stepwise if jax.tree.leaves(stepwise) else None


def _convert_single_step_arguments(
    params: Any, x: object, model: ModelLike | None, options: StepOptions | None, engine: EngineName
) -> tuple[WheelParams, Array, AbstractWheel, StepOptions]:
    """Return the wheel, the section state, the model and the options of one step on its ground."""
    params, section_state, model, options, stepwise_ground = convert_walk_arguments(
        params, x, 1, model, options, engine
    )
    if stepwise_ground is not None:
        model, params = model.with_step_ground(params, tuple(x[0] for x in stepwise_ground))
    return params, section_state, model, options


def convert_walk_arguments(
    params: Any,
    x: object | None,
    n_steps: int,
    model: ModelLike | None,
    options: StepOptions | None,
    engine: EngineName,
    heights: object | None = None,
    **start_checks: Any,
) -> tuple[WheelParams, Array, AbstractWheel, StepOptions, StepGroundValues | None]:
    """Return wheel, section state, model and options of a walk, and the ground of each step.

    They are converted to one floating-point type. The wheel and the model are those on the ground
    of the first step. On flat ground, the ground of the steps is None.

    - `heights`: heights of the footholds above the mean line, see `walk`;
    - `start_checks`: further arguments of `convert_step_arguments`.
    """
    checked_model = convert_model_argument(model, allows_friction_arrays=True)
    stepwise_ground = None
    if isinstance(params, WheelParams):
        checked_heights = convert_heights(heights, checked_model, jnp.ndim(params.slope) > 0)
        stepwise_ground = checked_model.split_ground_by_step(params, n_steps, checked_heights)
    if stepwise_ground is not None:
        checked_model, _ = checked_model.with_step_ground(
            params, tuple(ground_by_step[0] for ground_by_step in stepwise_ground)
        )
        first_step_slope = jnp.reshape(params.slope, -1)[0]
        params = eqx.tree_at(lambda wheel: wheel.slope, params, first_step_slope)
    params, section_state, checked_model, options = convert_step_arguments(
        params, x, checked_model, options, engine, **start_checks
    )
    if stepwise_ground is not None:
        stepwise_ground = tuple(
            ground_by_step.astype(section_state.dtype) for ground_by_step in stepwise_ground
        )
    return params, section_state, checked_model, options, stepwise_ground


def convert_heights(
    heights: object | None,
    model: AbstractWheel,
    is_slope_stepwise: bool,
    height_converter: Callable = check_reals,
) -> Any:
    """Return the heights of footholds as an array, or None if there are none.

    Raise a `TypeError` or a `ValueError` if the heights are no real numbers, if the slope is an
    array over steps, or if the model walks on even ground only.
    """
    if heights is None:
        return None
    if is_slope_stepwise:
        raise ValueError(
            "heights are given and slope is an array over steps, but heights are measured from a "
            "line of one slope: give one slope, or no heights."
        )
    if not model.can_walk_on_uneven_ground:
        raise ValueError(
            f"heights are given, but a {type(model).__name__} walks on even ground only: take "
            "vrw.UnilateralWheel()."
        )
    return height_converter("heights", heights, "give one height for each foothold, in m")


def start_walk_toward_gait(model: AbstractWheel, params: WheelParams, options: StepOptions) -> Walk:
    """Simulate a walk from the default start of the model toward an attracting gait.

    The walk need not reach the gait, because a search from its last state follows.
    """
    return walk(params, model.compute_default_start(params), 100, model=model, options=options)


@announce_wait("a gait step of each model", "5 s")
def choose_model(
    params: WheelParams,
    start: SectionStateLike,
    *,
    friction: float | Array = 0.7,
    options: StepOptions | None = None,
) -> ModelChoice:
    """Return the simplest model whose margins hold over one step from `start`.

    `start` is the section state (theta-, dtheta-, dL1-) of the paper's model, or the full section
    state of `UnilateralWheel`. `jax.vmap` can map the function over batches.

    Args:
        params: the wheel.
        start: section state, shape (3,), or a full state of `UnilateralWheel`.
        friction: friction coefficient of the ground.
        options: numerical options of the steps.

    Returns:
        A `ModelChoice` with the chosen `model` and the reason.

    Raises:
        TypeError, ValueError: if an argument is invalid; the message names the remedy.

    Examples:
        >>> choice = vrw.choose_model(vrw.WheelParams(), vrw.paper_start(), friction=0.7)
        >>> type(choice.model).__name__
        'UnilateralWheel'
    """
    model = LadderWheel(friction=friction)
    params, x, _, options = convert_step_arguments(params, start, model, options)
    return model.choose_model(params, x, options)[0]
