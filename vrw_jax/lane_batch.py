"""Gait steps of batches of wheels, by the engine that suits: one face, two engines.

The lane engine always runs the same compiled program over the same number of lanes, cut into
blocks, the last filled up with lanes that do nothing. So a lane's result is bitwise the same alone,
among others, and in any order. Wheels of similar work share a block; a block does not wait for a
few late lanes, which run again among their like. None of this reaches into a lane.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from vrw_jax.ground_lanes import as_full_states, walk_lanes
from vrw_jax.lane_engine import LaneStep, gait_step
from vrw_jax.lane_fixed import FixedStep, fixed_gait_step
from vrw_jax.lane_phase import Patience
from vrw_jax.models import AbstractWheel, UnilateralWheel, ViscoelasticWheel
from vrw_jax.options import Options
from vrw_jax.outcomes import Outcome
from vrw_jax.params import PARAMETER_NAMES, WheelParams, wheel_of
from vrw_jax.runge_kutta import explicit_tableau, real_stability_limit
from vrw_jax.start import fusion_emitters

BLOCK = 256
"""Lanes that march side by side on CPU: they stay in cache, and few wait for the slowest."""
BLOCKS = 8
"""Blocks in one call of the compiled program, so that the call itself costs little."""
LANES_ELSEWHERE = 32_768
"""Lanes of the one block of a call on a GPU."""
IMPLICIT = "Kvaerno5"
"""Solver of wheels that are too stiff for explicit ones."""
FEW = 8
"""A block waits no longer than usual once less than one in `FEW` of its lanes is running."""


class Steps(eqx.Module):
    """Lean results of walks of some steps, leading axis: lanes; each tells of its last step."""

    section_state: Float[Array, "lanes section"]  # before the next touchdown; zeros if it failed
    durations: Float[Array, "lanes 3"]  # of DLS, SLS-I, SLS-II, s; on real ground see its step
    outcome: Int[Array, " lanes"]  # an Outcome; the walk ends at the first that is not STEPPED
    n_stepped: Int[Array, " lanes"]  # steps that ended in a touchdown
    solver_steps: Int[Array, " lanes"]  # tried by the integrator, over all steps
    fixed: Bool[Array, " lanes"]  # whether the last step was taken in fixed work, by collocation
    implicit: Bool[Array, " lanes"]  # whether "auto" took an implicit solver, for stiffness
    engine: str = eqx.field(static=True)  # that computed it: "lanes", "diffrax" or "collocation"


def steps(
    params: WheelParams,
    states: Array | np.ndarray,
    n_steps: int = 1,
    *,
    model: AbstractWheel | None = None,
    options: Options | None = None,
    engine: str = "auto",
    durations: Array | np.ndarray | None = None,
) -> Steps:
    """`n_steps` gait steps of many wheels, or as many as each can: values only, no derivatives.

    `states` are section states, shape (lanes, 3), in rad, rad/s, m/s; fields of `params` are
    scalars or have the lanes' axis. "lanes" is the fast engine, for the viscoelastic wheel and
    explicit solvers; "diffrax" maps `model.advance` over the lanes and takes any solver; "auto"
    takes the first wherever it can, whatever the number of lanes, and `Steps.engine` says which it
    was; wheels whose airborne leg is too stiff for an explicit solver (c/m above 4e5 1/s at the
    default options) go to IMPLICIT by "diffrax", and `Steps.implicit` says which. Both keep the
    errors of `options`, which count for each local step; between them lie some ten times the
    tolerance.

    "collocation" is faster still near a known gait: `durations`, shape (lanes, 3), s, are those of
    DLS, SLS-I and SLS-II to some per cent, as of a limit cycle or a neighbour's step; later steps
    take those of the step before. Its error is fixed, about 1e-8 for 99 lanes in 100, whatever
    `options` say. Each lane checks itself, and one that fails is left to the lane engine; `fixed`
    says which was which.

    On real ground (`UnilateralWheel`, its friction a scalar or of the lanes' axis) states may be
    the rung's own too, shape (lanes, 4 + 3 n), and the only engine is "lanes".

    Not for use inside `jax.jit`: it compiles itself, once.
    """
    model = ViscoelasticWheel() if model is None else model
    options = Options() if options is None else options
    states = np.asarray(states)
    if isinstance(params.damping, jax.core.Tracer):
        raise TypeError(
            "the parameters are traced, but vrw.steps compiles itself and has no derivatives: call "
            "it outside of jit, vmap and grad, or map vrw.return_map over the lanes."
        )
    ground = isinstance(model, UnilateralWheel)
    sizes = (3, model.section_size(params)) if ground else (3,)
    if states.ndim != 2 or states.shape[1] not in sizes:
        raise ValueError(
            f"states have shape {states.shape}, but they are section states, shape (lanes, "
            f"{' or '.join(map(str, sizes))}): write states[None] for a single one."
        )
    if n_steps < 1:
        raise ValueError(f"n_steps is {n_steps}, but a walk needs at least one step.")
    dtype = np.dtype(jnp.result_type(params.damping, states.dtype))
    options.require_reachable(dtype)
    columns = [getattr(params, name) for name in PARAMETER_NAMES]
    wheels = np.empty((len(columns), len(states)), dtype)
    for row, column in zip(wheels, columns, strict=True):
        row[:] = np.asarray(column)
    if isinstance(model, UnilateralWheel):
        return _on_ground(
            model, wheels, states.astype(dtype), n_steps, options, engine, params.n_legs
        )
    walked = _Walked.start(states.astype(dtype))
    run = _chosen(engine, model, options, params.n_legs)
    stiff = np.zeros(len(states), bool)
    if engine == "auto" and run.name == "lanes":
        stiff = _too_stiff(wheels, options)
    implicit = dataclasses.replace(options, solver=IMPLICIT)
    for_stiffness = functools.partial(_by_diffrax, model, implicit, params.n_legs)
    if engine == "collocation":
        walked.durations[:] = _expected(durations, states, dtype)
    for _ in range(n_steps):
        open_ = np.flatnonzero(walked.outcome == Outcome.STEPPED)
        fixed = np.zeros(len(open_), bool)
        if engine == "collocation":
            given = wheels[:, open_], walked.section_state[open_], walked.durations[open_]
            fixed, told = _by_collocation(model, params.n_legs, *given)
            walked.take(open_[fixed], tuple(part[fixed] for part in told), fixed=True)
        open_ = open_[~fixed]
        for solve, lanes in ((run, open_[~stiff[open_]]), (for_stiffness, open_[stiff[open_]])):
            if len(lanes) > 0:
                told = solve(wheels[:, lanes], walked.section_state[lanes])
                walked.take(lanes, told, fixed=False)
    return Steps(
        jnp.asarray(walked.section_state),
        jnp.asarray(walked.durations),
        jnp.asarray(walked.outcome),
        jnp.asarray(walked.n_stepped),
        jnp.asarray(walked.solver_steps),
        jnp.asarray(walked.fixed),
        jnp.asarray(stiff),
        engine="collocation" if engine == "collocation" else run.name,
    )


def _on_ground(
    model: UnilateralWheel,
    wheels: np.ndarray,
    states: np.ndarray,
    n_steps: int,
    options: Options,
    engine: str,
    n_legs: int,
) -> Steps:
    if engine not in ("auto", "lanes") or explicit_tableau(options.solver, options) is None:
        raise ValueError(
            f"engine is {engine!r} and solver {options.solver}, but batches on real ground need "
            "'lanes' and an explicit Runge-Kutta solver: map vrw.return_map over the wheels."
        )
    friction = np.broadcast_to(np.asarray(model.friction, wheels.dtype), (len(states),))
    columns = np.concatenate([wheels, friction[None]])
    states = as_full_states(columns, states, n_legs)
    told = walk_lanes(columns, states, n_steps, model, options, n_legs)
    section_state, durations, outcome, n_stepped, tried = map(jnp.asarray, told)
    none = jnp.zeros(len(states), bool)
    return Steps(section_state, durations, outcome, n_stepped, tried, none, none, engine="lanes")


def _expected(durations: Any, states: np.ndarray, dtype: np.dtype) -> np.ndarray:
    if durations is None or np.shape(durations) != states.shape:
        shape = None if durations is None else np.shape(durations)
        raise ValueError(
            f"durations have shape {shape}, but collocation needs those of DLS, SLS-I and SLS-II "
            "to some per cent, shape (lanes, 3): give those of a limit cycle, or take 'lanes'."
        )
    return np.asarray(durations, dtype)


class _Walked:
    """Results so far, as numpy arrays."""

    def __init__(self, states: np.ndarray, n: int) -> None:
        self.section_state, self.durations = states, np.zeros_like(states)
        self.outcome, self.n_stepped, self.solver_steps = (np.zeros(n, np.int32) for _ in range(3))
        self.fixed = np.zeros(n, bool)

    @classmethod
    def start(cls, states: np.ndarray) -> "_Walked":
        return cls(states.copy(), len(states))

    def take(self, lanes: np.ndarray, told: tuple[np.ndarray, ...], fixed: bool) -> None:
        state, durations, outcome, tried = told
        self.section_state[lanes], self.durations[lanes] = state, durations
        self.outcome[lanes] = outcome
        self.n_stepped[lanes] += outcome == Outcome.STEPPED
        self.solver_steps[lanes] += tried
        self.fixed[lanes] = fixed


class _Engine(eqx.Module):
    """One gait step of any number of lanes, numpy in and out."""

    name: str = eqx.field(static=True)
    call: Callable = eqx.field(static=True)

    def __call__(self, wheels: np.ndarray, states: np.ndarray) -> tuple[np.ndarray, ...]:
        return self.call(wheels, states)


def _chosen(engine: str, model: AbstractWheel, options: Options, n_legs: int) -> _Engine:
    if engine not in ("auto", "lanes", "diffrax", "collocation"):
        raise ValueError(
            f"engine is {engine!r}, but it is 'auto', 'lanes', 'diffrax' or 'collocation'."
        )
    fits = isinstance(model, ViscoelasticWheel) and (
        explicit_tableau(options.solver, options) is not None
    )
    if engine in ("lanes", "collocation") and not fits:
        raise ValueError(
            f"the lane engine can't run {type(model).__name__} with {options.solver}: it knows "
            "the viscoelastic wheel and explicit Runge-Kutta solvers; take engine='diffrax'."
        )
    if engine == "diffrax" or not fits:
        return _Engine("diffrax", functools.partial(_by_diffrax, model, options, n_legs))
    assert isinstance(model, ViscoelasticWheel)
    by_lanes = functools.partial(_by_lanes, model.stop_at_lift_off, options, n_legs)
    return _Engine("lanes", by_lanes)


def _too_stiff(wheels: np.ndarray, options: Options) -> np.ndarray:
    """Which lanes an explicit solver can't take through single support I in `max_solver_steps`.

    The airborne leg's fast mode decays at 1.03 c/m for some 0.67 sqrt(L0 / g), s, where legs are
    light, and a step times that rate must stay below the solver's limit of stability; rejected
    steps add a tenth.
    """
    tableau = explicit_tableau(options.solver, options)
    assert tableau is not None  # `_chosen` looked
    damping, mass, length, gravity = (
        wheels[PARAMETER_NAMES.index(name)]
        for name in ("damping", "leg_mass", "locked_length", "gravity")
    )
    with np.errstate(all="ignore"):
        decays = 1.03 * damping / mass * 0.74 * np.sqrt(length / gravity)
        return decays > options.max_solver_steps * real_stability_limit(tableau)


def _by_lanes(
    stop_at_lift_off: bool,
    options: Options,
    n_legs: int,
    wheels: np.ndarray,
    states: np.ndarray,
) -> tuple[np.ndarray, ...]:
    """By the lane engine: wheels of like work side by side, late lanes again among their like."""
    dynamic, static = eqx.partition(options, eqx.is_array)
    dynamic = jax.tree.map(lambda leaf: np.asarray(leaf, wheels.dtype), dynamic)
    n, width = len(states), _width()
    program = _lane_program(static, n_legs, stop_at_lift_off, width)
    told = (np.empty((n, 3), wheels.dtype), np.empty((n, 3), wheels.dtype))
    counts = (np.empty(n, np.int32), np.empty(n, np.int32))
    # The airborne leg's fast rate, near c/m, sets the step where stability does.
    damping, mass = (wheels[PARAMETER_NAMES.index(name)] for name in ("damping", "leg_mass"))
    with np.errstate(all="ignore"):
        open_ = np.argsort(damping / mass, kind="stable")
    while len(open_) > 0:
        few = width[1] // FEW if len(open_) > width[1] else 0
        late = []
        for begin in range(0, len(open_), width[0] * width[1]):
            some = open_[begin : begin + width[0] * width[1]]
            step = program(*_filled(wheels, states, some, width), dynamic, np.int32(few))
            out = jax.tree.map(np.asarray, step)
            kept = ~out.unfinished[: len(some)]
            lanes = some[kept]
            for to, rows in zip(told, (out.section_state, out.durations), strict=True):
                to[lanes] = rows[: len(some)][kept]
            for count, rows in zip(counts, (out.outcome, out.solver_steps), strict=True):
                count[lanes] = rows[: len(some)][kept]
            late.append(some[~kept])
        open_ = np.concatenate(late)
    return (*told, *counts)


def _width() -> tuple[int, int]:
    """Blocks of a call, and lanes of a block."""
    return (BLOCKS, BLOCK) if jax.default_backend() == "cpu" else (1, LANES_ELSEWHERE)


def _filled(
    wheels: np.ndarray, states: np.ndarray, some: np.ndarray, width: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The chosen lanes, filled up to what the compiled program takes, and which are wanted."""
    size = width[0] * width[1]
    filled = np.concatenate([some, np.repeat(some[-1:], size - len(some))])
    wanted = np.arange(size) < len(some)
    return wheels[:, filled], states[filled].T.copy(), wanted


@functools.cache
def _lane_program(
    static: Options, n_legs: int, stop_at_lift_off: bool, width: tuple[int, int]
) -> Callable[..., LaneStep]:
    """The compiled step of some blocks of lanes: one program for every batch."""

    def block(dynamic: Options, few: Array, given: tuple[Array, Array, Array]) -> LaneStep:
        columns, x, wanted = given
        params = wheel_of(columns, n_legs)
        options = eqx.combine(dynamic, static)
        tableau = explicit_tableau(options.solver, options)
        assert tableau is not None  # `_chosen` looked
        return gait_step(params, x.T, wanted, options, tableau, stop_at_lift_off, Patience(few))

    def blocks(columns: Array, x: Array, wanted: Array, dynamic: Options, few: Array) -> LaneStep:
        return _in_blocks(functools.partial(block, dynamic, few), (columns, x, wanted), width)

    return jax.jit(blocks, compiler_options=fusion_emitters(True))


def _by_collocation(
    model: AbstractWheel,
    n_legs: int,
    wheels: np.ndarray,
    states: np.ndarray,
    durations: np.ndarray,
) -> tuple[np.ndarray, tuple[np.ndarray, ...]]:
    """Which lanes can be trusted, and their states, durations, outcomes and solver steps."""
    assert isinstance(model, ViscoelasticWheel)  # `_chosen` looked
    n, width = len(states), _width()
    program = _fixed_program(n_legs, model.stop_at_lift_off, width)
    found: list[FixedStep] = []
    for begin in range(0, n, width[0] * width[1]):
        some = np.arange(begin, min(begin + width[0] * width[1], n))
        filled = _filled(wheels, states, some, width)
        expected = durations[np.minimum(begin + np.arange(width[0] * width[1]), n - 1)].T.copy()
        out = program(*filled, expected)
        used = slice(len(some))
        found.append(jax.tree.map(lambda x, used=used: np.asarray(x)[used], out))
    none = np.zeros(n, np.int32)
    if not found:
        return np.zeros(0, bool), (states, durations, none, none)
    step = jax.tree.map(lambda *parts: np.concatenate(parts), *found)
    return step.trusted, (step.section_state, step.durations, none, none)


@functools.cache
def _fixed_program(
    n_legs: int, stop_at_lift_off: bool, width: tuple[int, int]
) -> Callable[..., FixedStep]:
    """The compiled step by collocation of some blocks of lanes."""

    def block(given: tuple[Array, Array, Array, Array]) -> FixedStep:
        columns, x, wanted, expected = given
        params = wheel_of(columns, n_legs)
        return fixed_gait_step(params, x.T, wanted, expected.T, stop_at_lift_off)

    blocks = lambda *given: _in_blocks(block, given, width)
    return jax.jit(blocks, compiler_options=fusion_emitters(True))


def _in_blocks(block: Callable, given: Any, width: tuple[int, int]) -> Any:
    """`block` on blocks of lanes, which are the last axis going in and the first coming out."""
    to_blocks = lambda a: jnp.moveaxis(a.reshape(*a.shape[:-1], *width), -2, 0)
    out = lax.map(block, jax.tree.map(to_blocks, given))
    flat = lambda a: jnp.moveaxis(a, 1, -1).reshape(-1, *a.shape[1:-1])
    return jax.tree.map(flat, out)


def _by_diffrax(
    model: AbstractWheel,
    options: Options,
    n_legs: int,
    wheels: np.ndarray,
    states: np.ndarray,
) -> tuple[np.ndarray, ...]:
    """By the model's own step under `jax.vmap`, as many lanes at a time as the lane engine."""
    size = BLOCK
    options = jax.tree.map(lambda leaf: np.asarray(leaf, wheels.dtype), options)
    parts: list[Any] = []
    for begin in range(0, len(states), size):
        some = np.arange(begin, min(begin + size, len(states)))
        columns, x, _ = _filled(wheels, states, some, (1, size))
        out = _mapped(model, options, n_legs, columns, x)
        used = slice(len(some))
        parts.append(jax.tree.map(lambda leaf, used=used: np.asarray(leaf)[used], out))
    advance = jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
    return advance.section_state, advance.durations, advance.outcome, advance.solver_steps


@eqx.filter_jit
def _mapped(model: AbstractWheel, options: Options, n_legs: int, columns: Any, x: Any) -> Any:
    def one(values: Array, state: Array) -> Any:
        params = wheel_of(values, n_legs)
        return model.advance(params, state, options)

    return jax.vmap(one, 1)(columns, x)
