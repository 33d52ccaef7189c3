"""Single steps, the return map, and walks of many steps.

All functions are pure, take a single wheel, and work with `jit`, `vmap` and every mode of
differentiation. A model compiles its step once.
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

from vrw_jax.contact import UnilateralStep, UnilateralWheel
from vrw_jax.models import (
    AbstractWheel,
    AdvanceResult,
    SectionState,
    StepGround,
    StepResult,
    ViscoelasticWheel,
)
from vrw_jax.numerics import EngineName, StepOptions
from vrw_jax.printing import (
    AbstractPrintable,
    TextRow,
    describe_ending,
    format_numbers,
    format_outcome_counts,
    format_quantity,
)
from vrw_jax.runtime import with_default_settings
from vrw_jax.selection import LadderStep, LadderWheel, ModelChoice, describe_models
from vrw_jax.validation import check_int, check_reals, check_type, format_value
from vrw_jax.wheel import Outcome, WheelParams

SectionLike = Array | np.ndarray | Sequence[float]
"""Section state as a caller gives it; `validate_arguments` converts it to an array."""
ModelLike = AbstractWheel | Literal["auto"]
"""Model as a caller gives it; "auto" means `LadderWheel()`, the simplest valid model."""


@with_default_settings
def paper_start() -> SectionState:
    """Return a section state (theta-, dtheta-, dL1-) in the basin of the gait of Table 1.

    Returns:
        The section state, shape (3,), in rad, rad/s, m/s.

    Examples:
        >>> vrw.paper_start().round(4).tolist()
        [0.1, 1.6, -0.1]
    """
    return ViscoelasticWheel().default_start(WheelParams())


def check_model(model: ModelLike | None, allows_arrays: bool = False) -> AbstractWheel:
    """Return the model of an argument: by default the paper's, for "auto" a `LadderWheel`.

    Raises `TypeError` if the argument is no model. Raises `ValueError` if its friction is an array
    although `allows_arrays` is False.
    """
    if model is None:
        return _make_default_model()
    if isinstance(model, str) and model == "auto":
        return LadderWheel()
    if not isinstance(model, AbstractWheel):
        raise TypeError(
            f"model is {format_value(model)}, but a model of the wheel is needed: give "
            f"{describe_models()}."
        )
    if not allows_arrays and (shape := jnp.shape(getattr(model, "friction", 0.0))):
        raise ValueError(
            f"friction has shape {shape}, but this call is for one ground: give one number, or "
            "vary it in a design of vrw.scan; vrw.step_batch takes one for each element, vrw.walk "
            "one for each of its steps."
        )
    return model


_make_default_model = functools.cache(ViscoelasticWheel)


def check_single_wheel(params: Any, remedy: str) -> None:
    """Raise `TypeError` or `ValueError` unless `params` is a single wheel.

    - `remedy`: end of the message.
    """
    check_type("params", params, WheelParams, "write vrw.WheelParams(damping=..., slope=...)")
    WheelParams.require_single(params, remedy)  # An unbound call is much faster.


def check_options(options: StepOptions | None) -> StepOptions:
    """Return the options, by default `StepOptions()`.

    Raises `TypeError` if the argument has another type.
    """
    if options is not None:
        check_type(
            "options", options, StepOptions, "give vrw.StepOptions(), or vrw.StepOptions.tight()"
        )
        StepOptions.require_scalars(options)  # An unbound call is faster: binding takes 0.1 ms.
    return _make_default_options(jnp.result_type(float)) if options is None else options


@functools.cache
def _make_default_options(dtype: np.dtype) -> StepOptions:
    """Return the default options for a floating type, made once and concrete even under a trace."""
    with jax.ensure_compile_time_eval():
        return StepOptions()


def check_section_state(
    x: Any, description: str = "the section state", converter: Callable = check_reals
) -> Any:
    """Return the section state as converted by `converter`.

    Raises an error if the argument is invalid.
    """
    return converter(
        description,
        x,
        "give (theta-, dtheta-, dL1-), as vrw.paper_start(), or that of a cycle, "
        "cycle.section_state",
    )


def validate_arguments(
    params: WheelParams,
    x: object,
    model: ModelLike | None,
    options: StepOptions | None,
    engine: EngineName = "auto",
) -> tuple[WheelParams, Array, AbstractWheel, StepOptions]:
    """Return wheel, section state, model and options, all of one floating type.

    Raises `TypeError` or `ValueError` if an argument is invalid.
    """
    check_single_wheel(params, "map over batches of parameters with jax.vmap, or use vrw.scan")
    model, options = check_model(model), StepOptions.with_engine(check_options(options), engine)
    state = check_section_state(x)
    section_size = model.section_size(params)
    if state.shape == (3,) and section_size != 3:
        state = model.embed_section(params, state)
    if state.shape != (section_size,):
        longer_shape_text = (
            "" if section_size == 3 else f", or this model’s own of shape ({section_size},)"
        )
        raise ValueError(
            f"the section state has shape {state.shape}, but it is (theta-, dtheta-, dL1-), shape "
            f"(3,){longer_shape_text}: "
            "for batches map over it with jax.vmap."
        )
    # Parameters made in single precision stay inaccurate after a conversion to double precision.
    StepOptions.check_tolerances(options, jnp.result_type(*jax.tree.leaves(params)))
    dtype = jnp.result_type(state, params.damping)
    StepOptions.check_tolerances(options, dtype)

    def convert_dtype(tree: Any) -> Any:
        """Return the tree with all leaves of the common floating type."""
        if all(leaf.dtype == dtype for leaf in jax.tree.leaves(tree)):
            return tree
        return jax.tree.map(lambda leaf: leaf.astype(dtype), tree)

    return convert_dtype(params), convert_dtype(state), model, convert_dtype(options)


@overload
def step(  # type: ignore[overload-overlap]
    params: WheelParams,
    x: SectionLike,
    *,
    model: UnilateralWheel,
    options: StepOptions | None = None,
    engine: EngineName = "auto",
) -> UnilateralStep: ...


@overload
def step(  # type: ignore[overload-overlap]
    params: WheelParams,
    x: SectionLike,
    *,
    model: LadderWheel | Literal["auto"],
    options: StepOptions | None = None,
    engine: EngineName = "auto",
) -> LadderStep: ...


@overload
def step(
    params: WheelParams,
    x: SectionLike,
    *,
    model: AbstractWheel | None = None,
    options: StepOptions | None = None,
    engine: EngineName = "auto",
) -> StepResult: ...


@with_default_settings
def step(
    params: WheelParams,
    x: SectionLike,
    *,
    model: ModelLike | None = None,
    options: StepOptions | None = None,
    engine: EngineName = "auto",
) -> StepResult | UnilateralStep | LadderStep:
    """Return one step from touchdown to touchdown, with indicators, margins and energies.

    The `outcome` of the result describes how the step ended; a fall raises no error. Errors of
    values and first derivatives are below 1e-9 at the default options and below 1e-12 at
    `StepOptions.tight()`.

    Args:
        params: the wheel.
        x: section state (theta-, dtheta-, dL1-) just before touchdown, in rad, rad/s, m/s.
        model: the model; by default that of the paper, `ViscoelasticWheel()`. "auto" chooses the
            simplest valid model.
        options: numerical options of the steps.
        engine: engine that computes the steps; see `StepOptions`.

    Returns:
        A `StepResult`; a `UnilateralStep` with unilateral contact, or a `LadderStep` for "auto".

    Raises:
        TypeError, ValueError: if an argument is invalid; the message names the remedy.

    Examples:
        >>> step = vrw.step(vrw.WheelParams(damping=150.0), vrw.paper_start())
        >>> print(f"{step.period:.3f} s, {vrw.Outcome(int(step.outcome)).name}")
        0.714 s, STEPPED
    """
    model, params, ground = read_ground(params, model, 1)
    params, state, model, options = validate_arguments(params, x, model, options, engine)
    if ground is not None:
        model, params = model.with_ground(params, _first_ground(ground, state.dtype))
    return model.take_step(params, state, options)


@with_default_settings
def return_map(
    params: WheelParams,
    x: SectionLike,
    *,
    model: ModelLike | None = None,
    options: StepOptions | None = None,
    engine: EngineName = "auto",
) -> Array:
    """Return the section state one step later; all zeros (no section state) if the step failed.

    No margins are computed. The map is differentiable in forward and reverse mode, to any order.

    Args:
        params: the wheel.
        x: section state (theta-, dtheta-, dL1-) just before touchdown, in rad, rad/s, m/s.
        model: the model; by default that of the paper, `ViscoelasticWheel()`. "auto" chooses the
            simplest valid model.
        options: numerical options of the steps.
        engine: engine that computes the steps; see `StepOptions`.

    Returns:
        The section state just before the next touchdown, of the shape of `x`.

    Raises:
        TypeError, ValueError: if an argument is invalid; the message names the remedy.

    Examples:
        >>> params, x = vrw.WheelParams(damping=150.0), vrw.paper_start()
        >>> vrw.return_map(params, x).round(4).tolist()
        [0.091, 1.7355, -0.1587]
        >>> jax.jacfwd(vrw.return_map, argnums=1)(params, x).shape
        (3, 3)
    """
    model, params, ground = read_ground(params, model, 1)
    params, state, model, options = validate_arguments(params, x, model, options, engine)
    if ground is not None:
        model, params = model.with_ground(params, _first_ground(ground, state.dtype))
    return model.advance(params, state, options).section_state


class Walk(AbstractPrintable):
    """Results of consecutive steps without margins, with a leading axis over steps.

    - `start`: section state at the start;
    - `steps`: section state, durations and outcome of each step;
    - `n_stepped`: number of steps before the first failure.

    Examples:
        >>> walk = vrw.walk(vrw.WheelParams(damping=150.0), vrw.paper_start(), 5)
        >>> walk.steps.section_state.shape
        (5, 3)
    """

    start: Array
    steps: AdvanceResult
    n_stepped: Int[Array, ""]

    @property
    def outcome(self) -> Array:
        """Return the outcome of the walk: that of the first failed step, or STEPPED."""
        last_index = self.steps.outcome.shape[-1] - 1
        return jnp.take_along_axis(
            self.steps.outcome, jnp.minimum(self.n_stepped, last_index)[..., None], axis=-1
        )[..., 0]

    @property
    def ending(self) -> Any:
        """Return how the walk ended, as a sentence; a batch has an array of sentences."""
        return describe_ending(self.outcome, Outcome)

    def summary_rows(self) -> list[TextRow]:
        """Return labels and texts of outcome, steps, start, last state and time."""
        outcome = np.asarray(self.outcome)
        if outcome.ndim:
            return [("walks", format_outcome_counts(outcome, Outcome))]
        last_index = max(int(self.n_stepped) - 1, 0)
        return [
            ("outcome", Outcome(int(outcome)).meaning),
            ("steps", f"{int(self.n_stepped)} of {self.steps.outcome.shape[-1]}"),
            ("start", f"{format_numbers(self.start)} (rad, rad/s, m/s)"),
            ("last section state", format_numbers(self.steps.section_state[last_index])),
            ("time", format_quantity(np.sum(self.steps.durations), "s")),
        ]


@eqx.filter_jit
def _scan_steps(
    model: AbstractWheel,
    params: WheelParams,
    x: Array,
    options: StepOptions,
    n_steps: int,
    ground_per_step: StepGround | None,
) -> Walk:
    """Return a walk of `n_steps` steps; the steps after a failure repeat its outcome."""

    def advance_walk(carry: tuple, ground: StepGround | None) -> tuple:
        """Return the next carry and the results of one step, which is not taken after a failure."""
        x, outcome = carry
        is_unfinished = outcome == Outcome.STEPPED
        model_and_params = (model, params) if ground is None else model.with_ground(params, ground)
        step_result = model_and_params[0].advance(
            model_and_params[1], jnp.where(is_unfinished, x, jnp.nan), options
        )
        outcome = jnp.where(is_unfinished, step_result.outcome, outcome)
        step_result = dataclasses.replace(
            step_result,
            durations=jnp.where(is_unfinished, step_result.durations, 0.0),
            outcome=outcome,
            solver_steps=jnp.where(is_unfinished, step_result.solver_steps, 0),
        )
        return (step_result.section_state, outcome), step_result

    carry = (x, jnp.int32(Outcome.STEPPED))
    steps: AdvanceResult
    _, steps = lax.scan(advance_walk, carry, ground_per_step, length=n_steps)
    return Walk(x, steps, jnp.sum(steps.outcome == Outcome.STEPPED))


@with_default_settings
def walk(
    params: WheelParams,
    x: SectionLike,
    n_steps: int,
    *,
    model: ModelLike | None = None,
    options: StepOptions | None = None,
    engine: EngineName = "auto",
) -> Walk:
    """Return a walk of `n_steps` steps; the steps after a failure repeat its outcome.

    On uneven ground `params.slope` is an array over steps. The ground then consists of straight
    lines of these slopes, which join the footholds. In the double support of step k both feet are
    on line k. The step begins at the foothold where this line ends. The step ends when the next
    foot meets line k + 1. Therefore n steps use n + 1 slopes; if n slopes are given, the last one
    is used twice. A section state is in the frame of the line that ends at its landing; the start
    is in the frame of line 0. Forces are along and normal to line k. With unilateral contact the
    friction of the model may also be an array over steps. Each foot then keeps the friction of the
    step in which it landed.

    Args:
        params: the wheel.
        x: section state (theta-, dtheta-, dL1-) just before touchdown, in rad, rad/s, m/s.
        n_steps: largest number of steps.
        model: the model; by default that of the paper, `ViscoelasticWheel()`. "auto" chooses the
            simplest valid model.
        options: numerical options of the steps.
        engine: engine that computes the steps; see `StepOptions`.

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
    checked_model, params, ground_per_step = read_ground(params, model, n_steps)
    params, state, checked_model, options = validate_arguments(
        params, x, checked_model, options, engine
    )
    if ground_per_step is not None:
        ground_per_step = tuple(
            ground_values.astype(state.dtype) for ground_values in ground_per_step
        )
    return _scan_steps(checked_model, params, state, options, n_steps, ground_per_step)


def read_ground(
    params: Any, model: ModelLike | None, n_steps: int
) -> tuple[AbstractWheel, Any, StepGround | None]:
    """Return model and wheel on the ground of the first step, and the ground of each step.

    On flat ground, the last result is None and model and wheel are unchanged.
    """
    checked_model = check_model(model, allows_arrays=True)
    if not isinstance(params, WheelParams):
        return checked_model, params, None
    ground_per_step = checked_model.split_ground(params, n_steps)
    if ground_per_step is None:
        return checked_model, params, None
    first_model, _ = checked_model.with_ground(
        params, tuple(ground_values[0] for ground_values in ground_per_step)
    )
    first_slope = jnp.reshape(params.slope, -1)[0]
    first_wheel = eqx.tree_at(lambda wheel: wheel.slope, params, first_slope)
    return first_model, first_wheel, ground_per_step


def _first_ground(ground_per_step: StepGround, dtype: Any) -> StepGround:
    """Return the ground of the first step."""
    return tuple(ground_values[0].astype(dtype) for ground_values in ground_per_step)


def walk_toward_gait(
    model: AbstractWheel, params: WheelParams, options: StepOptions, n_steps: int = 100
) -> Walk:
    """Return a walk toward an attracting gait from the default start of the model.

    - `n_steps`: number of steps. The search that follows needs only a state near the gait.
    """
    return walk(params, model.default_start(params), n_steps, model=model, options=options)


@with_default_settings
def choose_model(
    params: WheelParams,
    start: SectionLike,
    *,
    friction: float | Array = 0.7,
    options: StepOptions | None = None,
) -> ModelChoice:
    """Return the simplest model whose margins hold over one step from `start`.

    `start` is the section state (theta-, dtheta-, dL1-) of the paper's model, or the full one of
    `UnilateralWheel`. The function can be mapped over batches with `jax.vmap`.

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
    params, x, _, options = validate_arguments(params, start, model, options)
    return model.choose_model(params, x, options)[0]
