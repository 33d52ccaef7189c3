"""What repeats: one step, the return map, a walk of many steps.

Everything here is pure and single-wheel, and works under `jit`, `vmap` and every mode of
differentiation. A model compiles its own step once.
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

from vrw_jax.models import (
    AbstractWheel,
    Advance,
    GroundOfStep,
    LadderStep,
    LadderWheel,
    ModelChoice,
    SectionState,
    StepResult,
    UnilateralStep,
    UnilateralWheel,
    ViscoelasticWheel,
)
from vrw_jax.numerics import Engine, Options
from vrw_jax.wheel import Outcome, WheelParams
from vrw_jax.wording import AbstractTold, Row, counted, instance, listed, reals, told, whole

SectionLike = Array | np.ndarray | Sequence[float]
"""A section state as given by a caller; `checked` makes it an array of shape (3,)."""
ModelLike = AbstractWheel | Literal["auto"]
"""A rung as given by a caller; "auto" is `LadderWheel()`, the lowest rung that serves."""


def paper_start() -> SectionState:
    """A section state (theta-, dtheta-, dL1-) inside the basin of the gait of Table 1.

    Returns:
        Shape (3,), rad, rad/s, m/s.

    Examples:
        >>> vrw.paper_start().round(4).tolist()
        [0.1, 1.6, -0.1]
    """
    return ViscoelasticWheel().start(WheelParams())


def rung_of(model: ModelLike | None, many: bool = False) -> AbstractWheel:
    """The rung that a caller names: the paper's by default, the lowest that serves for "auto".

    Its ground is one, unless there may be `many`: of lanes, or of steps.
    """
    if model is None:
        return _paper_wheel()
    if isinstance(model, str) and model == "auto":
        return LadderWheel()
    if not isinstance(model, AbstractWheel):
        raise TypeError(
            f"model is {model!r}, but a rung of the ladder is needed: give "
            'vrw.ViscoelasticWheel(), vrw.RigidWheel(), vrw.UnilateralWheel() or "auto".'
        )
    if not many and (shape := jnp.shape(getattr(model, "friction", 0.0))):
        raise ValueError(
            f"friction has shape {shape}, but this is about one ground: give one number, or vary "
            "it in a design of vrw.scan; vrw.steps takes one for each lane, vrw.walk one for each "
            "of its steps."
        )
    return model


_paper_wheel = functools.cache(ViscoelasticWheel)


def one_wheel(params: Any, instead: str) -> None:
    """Refuse what is no wheel, or more than one."""
    instance("params", params, WheelParams, "write vrw.WheelParams(damping=..., slope=...)")
    WheelParams.require_one(params, instead)  # a bound method takes equinox as long as a step


def options_of(options: Options | None) -> Options:
    if options is not None:
        instance("options", options, Options, "give vrw.Options(), or vrw.Options.tight()")
    return _usual(jnp.result_type(float)) if options is None else options


@functools.cache
def _usual(dtype: np.dtype) -> Options:
    """Made once for each of JAX's default types; numbers, whatever is being traced."""
    with jax.ensure_compile_time_eval():
        return Options()


def state_of(x: Any, what: str = "the section state", read: Callable = reals) -> Any:
    """`read` it: by `reals`, or by `known_reals`."""
    return read(
        what,
        x,
        "give (theta-, dtheta-, dL1-), as vrw.paper_start(), or that of a cycle, "
        "cycle.section_state",
    )


def checked(
    params: WheelParams,
    x: object,
    model: ModelLike | None,
    options: Options | None,
    engine: Engine = "auto",
) -> tuple[WheelParams, Array, AbstractWheel, Options]:
    """Arguments with their defaults; one clear sentence for what can be seen to be wrong."""
    one_wheel(params, "map over batches of parameters with jax.vmap, or use vrw.scan")
    model, options = rung_of(model), Options.by(options_of(options), engine)
    state = state_of(x)
    size = model.section_size(params)
    if state.shape == (3,) and size != 3:
        state = model.full_section(params, state)
    if state.shape != (size,):
        raise ValueError(
            f"the section state has shape {state.shape}, but it is (theta-, dtheta-, dL1-), shape "
            f"(3,){'' if size == 3 else f', or this rung’s own of shape ({size},)'}: "
            "for batches map over it with jax.vmap."
        )
    # Numbers made before 64 bits were asked for stay coarse, whatever they are mixed with.
    Options.require_reachable(options, jnp.result_type(*jax.tree.leaves(params)))
    dtype = jnp.result_type(state, params.damping)
    Options.require_reachable(options, dtype)

    def convert(tree: Any) -> Any:
        if all(leaf.dtype == dtype for leaf in jax.tree.leaves(tree)):
            return tree
        return jax.tree.map(lambda leaf: leaf.astype(dtype), tree)

    return convert(params), convert(state), model, convert(options)


@overload
def step(  # type: ignore[overload-overlap]
    params: WheelParams,
    x: SectionLike,
    *,
    model: UnilateralWheel,
    options: Options | None = None,
    engine: Engine = "auto",
) -> UnilateralStep: ...


@overload
def step(  # type: ignore[overload-overlap]
    params: WheelParams,
    x: SectionLike,
    *,
    model: LadderWheel | Literal["auto"],
    options: Options | None = None,
    engine: Engine = "auto",
) -> LadderStep: ...


@overload
def step(
    params: WheelParams,
    x: SectionLike,
    *,
    model: AbstractWheel | None = None,
    options: Options | None = None,
    engine: Engine = "auto",
) -> StepResult: ...


def step(
    params: WheelParams,
    x: SectionLike,
    *,
    model: ModelLike | None = None,
    options: Options | None = None,
    engine: Engine = "auto",
) -> StepResult | UnilateralStep | LadderStep:
    """One step from touchdown to touchdown, with indicators, monitors and energies.

    `x` is (theta-, dtheta-, dL1-) just before touchdown, in rad, rad/s, m/s. How the step ended is
    its `outcome`; nothing is raised for a wheel that falls. Errors: below 1e-9 at the default
    options and 1e-12 at `Options.tight()`, for values and first derivatives.

    Args:
        params: the wheel.
        x: section state (theta-, dtheta-, dL1-) just before touchdown, rad, rad/s, m/s.
        model: the rung; the paper's, `ViscoelasticWheel()`, by default, "auto" for the lowest that
            serves.
        options: numerical choices of the steps.
        engine: who takes the steps, see `Options`.

    Returns:
        A `StepResult`; a `UnilateralStep` on real ground, a `LadderStep` for "auto".

    Raises:
        TypeError, ValueError: an argument that can't be meant, in one sentence.

    Examples:
        >>> step = vrw.step(vrw.WheelParams(damping=150.0), vrw.paper_start())
        >>> print(f"{step.period:.3f} s, {vrw.Outcome(int(step.outcome)).name}")
        0.714 s, STEPPED
    """
    params, state, model, options = checked(params, x, model, options, engine)
    return model.step(params, state, options)


def return_map(
    params: WheelParams,
    x: SectionLike,
    *,
    model: ModelLike | None = None,
    options: Options | None = None,
    engine: Engine = "auto",
) -> Array:
    """The section state one step later; all zeros (no section state) where the step failed.

    The lean path: no monitors are computed. Differentiable forwards and in reverse, to any order.

    Args:
        params: the wheel.
        x: section state (theta-, dtheta-, dL1-) just before touchdown, rad, rad/s, m/s.
        model: the rung; the paper's, `ViscoelasticWheel()`, by default, "auto" for the lowest that
            serves.
        options: numerical choices of the steps.
        engine: who takes the steps, see `Options`.

    Returns:
        Shape of `x`.

    Raises:
        TypeError, ValueError: an argument that can't be meant, in one sentence.

    Examples:
        >>> params, x = vrw.WheelParams(damping=150.0), vrw.paper_start()
        >>> vrw.return_map(params, x).round(4).tolist()
        [0.091, 1.7355, -0.1587]
        >>> jax.jacfwd(vrw.return_map, argnums=1)(params, x).shape
        (3, 3)
    """
    params, state, model, options = checked(params, x, model, options, engine)
    return model.advance(params, state, options).section_state


class Walk(AbstractTold):
    """Lean results of consecutive steps, with a leading axis over steps.

    - `start`: the section state that it began with;
    - `steps`: section state, durations and outcome of each step;
    - `n_stepped`: steps before the first that failed.

    Examples:
        >>> walk = vrw.walk(vrw.WheelParams(damping=150.0), vrw.paper_start(), 5)
        >>> walk.steps.section_state.shape
        (5, 3)
    """

    start: Array
    steps: Advance
    n_stepped: Int[Array, ""]

    @property
    def outcome(self) -> Array:
        """Outcome of the whole walk: of its first failing step, or STEPPED."""
        last = self.steps.outcome.shape[-1] - 1
        return jnp.take_along_axis(
            self.steps.outcome, jnp.minimum(self.n_stepped, last)[..., None], axis=-1
        )[..., 0]

    def rows(self) -> list[Row]:
        outcome = np.asarray(self.outcome)
        if outcome.ndim:
            return [("walks", counted(outcome, Outcome))]
        last = max(int(self.n_stepped) - 1, 0)
        return [
            ("outcome", Outcome(int(outcome)).meaning),
            ("steps", f"{int(self.n_stepped)} of {self.steps.outcome.shape[-1]}"),
            ("start", f"{listed(self.start)} (rad, rad/s, m/s)"),
            ("last section state", listed(self.steps.section_state[last])),
            ("time", told(np.sum(self.steps.durations), "s")),
        ]


@eqx.filter_jit
def _walk(
    model: AbstractWheel,
    params: WheelParams,
    x: Array,
    options: Options,
    n_steps: int,
    over_steps: GroundOfStep | None,
) -> Walk:
    def one(carry: tuple, ground: GroundOfStep | None) -> tuple:
        x, outcome = carry
        walking = outcome == Outcome.STEPPED
        here = (model, params) if ground is None else model.on_ground(params, ground)
        advance = here[0].advance(here[1], jnp.where(walking, x, jnp.nan), options)
        outcome = jnp.where(walking, advance.outcome, outcome)
        advance = dataclasses.replace(
            advance,
            durations=jnp.where(walking, advance.durations, 0.0),
            outcome=outcome,
            solver_steps=jnp.where(walking, advance.solver_steps, 0),
        )
        return (advance.section_state, outcome), advance

    carry = (x, jnp.int32(Outcome.STEPPED))
    steps: Advance
    _, steps = lax.scan(one, carry, over_steps, length=n_steps)
    return Walk(x, steps, jnp.sum(steps.outcome == Outcome.STEPPED))


def walk(
    params: WheelParams,
    x: SectionLike,
    n_steps: int,
    *,
    model: ModelLike | None = None,
    options: Options | None = None,
    engine: Engine = "auto",
) -> Walk:
    """`n_steps` steps, or as many as it can; the steps after a failure repeat its outcome.

    On real ground `params.slope` and the model's friction may be arrays over steps, of a floor
    whose footholds are joined by lines of these slopes: the k-th ends where the k-th step begins by
    a landing. Each foot keeps the friction of its own landing; forces are along and off the line
    that the last landing ended. A section state is told off the line that ends in its landing.

    Args:
        params: the wheel.
        x: section state (theta-, dtheta-, dL1-) just before touchdown, rad, rad/s, m/s.
        n_steps: at most so many.
        model: the rung; the paper's, `ViscoelasticWheel()`, by default, "auto" for the lowest that
            serves.
        options: numerical choices of the steps.
        engine: who takes the steps, see `Options`.

    Returns:
        A `Walk`, whose fields have a leading axis over the steps.

    Raises:
        TypeError, ValueError: an argument that can't be meant, in one sentence.

    Examples:
        >>> walk = vrw.walk(vrw.WheelParams(damping=150.0), vrw.paper_start(), 5)
        >>> int(walk.n_stepped), walk.steps.durations.shape
        (5, (5, 3))
    """
    n_steps = whole("n_steps", n_steps)
    rung, over_steps = rung_of(model, many=True), None
    if isinstance(params, WheelParams):
        over_steps = rung.over_steps(params, n_steps)
    if over_steps is not None:
        rung, params = rung.on_ground(params, jax.tree.map(lambda row: row[0], over_steps))
    params, state, rung, options = checked(params, x, rung, options, engine)
    return _walk(rung, params, state, options, n_steps, over_steps)


N_TOWARDS = 100
"""Steps towards a gait, from the rung's start, where its search needs a place nearby."""


def walk_towards(model: AbstractWheel, params: WheelParams, options: Options) -> Walk:
    """Towards a gait that attracts, from the rung's own start."""
    return walk(params, model.start(params), N_TOWARDS, model=model, options=options)


def choose_model(
    params: WheelParams,
    start: SectionLike,
    *,
    friction: float | Array = 0.7,
    options: Options | None = None,
) -> ModelChoice:
    """The lowest rung whose premises hold over one step from `start`, on ground of `friction`.

    `start` is the paper's section state (theta-, dtheta-, dL1-) or the full one of the unilateral
    rung. Maps over lanes by `jax.vmap`.

    Args:
        params: the wheel.
        start: section state, shape (3,), or the ground's own.
        friction: coefficient of the ground.
        options: numerical choices of the steps.

    Returns:
        A `ModelChoice`: `rung`, `why`, and the `model` to go on with.

    Raises:
        TypeError, ValueError: an argument that can't be meant, in one sentence.

    Examples:
        >>> choice = vrw.choose_model(vrw.WheelParams(), vrw.paper_start(), friction=0.7)
        >>> type(choice.model).__name__
        'UnilateralWheel'
    """
    model = LadderWheel(friction=friction)
    params, x, _, options = checked(params, start, model, options)
    return model.choose(params, x, options)[0]
