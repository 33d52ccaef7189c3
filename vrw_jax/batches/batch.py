"""Gait steps of batches of wheels, by the engine that suits: one face, two engines.

On a CPU the lane engine is machine code for a few lanes at a time (`simd`), on a GPU a program of
XLA for very many, of which a few late ones run again among their like. Either way the same code
runs for every lane, and nothing reaches from one to another: a lane's result is bitwise the same
alone, among others, and in any order. Wheels of similar work go side by side.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from vrw_jax import simd
from vrw_jax.batches.fixed_work import fixed_gait_step
from vrw_jax.batches.ground import as_full_states, walk_lanes
from vrw_jax.models.lane_step import gait_step
from vrw_jax.models import AbstractWheel
from vrw_jax.numerics import Options, explicit_tableau, real_stability_limit
from vrw_jax.runtime import lane_program
from vrw_jax.walks import options_of, rung_of, state_of
from vrw_jax.wheel import PARAMETER_NAMES, Outcome, WheelParams, wheel_of
from vrw_jax.wording import (
    AbstractTold,
    Row,
    chosen,
    counted,
    instance,
    reals,
    told,
    untraced,
    whole,
)

Engine = Literal["auto", "lanes", "diffrax", "collocation"]
ENGINES: tuple[str, ...] = get_args(Engine)

BLOCK = 32_768
"""Lanes that march side by side where XLA compiles them, as on a GPU."""
MAPPED = 256
"""Lanes that the diffrax engine takes at a time."""
NAMED, STABLE, IMPLICIT = range(3)
"""Solvers that take a lane: that of the options, and two for stiff wheels."""
STABLE_SOLVER, TIGHTER = "Tsit5", 4.0
"""Explicit solver of wheels whose steps stability limits, and how much tighter it is set.

Of diffrax's of order 5 and more it goes farthest for an evaluation there: 0.58 over the mode's
rate, Dopri8 0.40. So much tighter it costs little more, and from a tolerance of 1e-6 down its error
is no larger than Dopri8's at the named one."""
IMPLICIT_SOLVER = "Kvaerno5"
"""Solver of wheels that are too stiff for explicit ones."""
WORTH = 6e4
"""Evaluations by an explicit solver that cost what IMPLICIT_SOLVER does at a tolerance of 1e-6
(docs/stability_atlas.md). Its own cost goes with the tolerance's power of -0.17, from 1e-4 to
1e-10; at the limit of stability theirs does not."""
FEW = 8
"""A block waits no longer than usual once less than one in `FEW` of its lanes is running."""


class Steps(AbstractTold):
    """Lean results of walks of some steps, leading axis: lanes; each tells of its last step.

    - `section_state`: before the next touchdown; zeros if it failed;
    - `durations`: of DLS, SLS-I, SLS-II, s; on real ground see its step;
    - `outcome`: an Outcome; the walk ends at the first that is not STEPPED;
    - `n_stepped`: steps that ended in a touchdown;
    - `solver_steps`: tried by the integrator, over all steps;
    - `fixed`: whether the last step was taken in fixed work, by collocation;
    - `solver`: which of `solvers` took the lane: "auto" goes by stiffness;
    - `engine`: that computed it: "lanes", "diffrax" or "collocation";
    - `solvers`: the named one first.
    """

    section_state: Float[Array, "lanes section"]
    durations: Float[Array, "lanes 3"]
    outcome: Int[Array, " lanes"]
    n_stepped: Int[Array, " lanes"]
    solver_steps: Int[Array, " lanes"]
    fixed: Bool[Array, " lanes"]
    solver: Int[Array, " lanes"]
    engine: str = eqx.field(static=True)
    solvers: tuple[str, ...] = eqx.field(static=True)

    def rows(self) -> list[Row]:
        n = np.bincount(np.ravel(self.solver), minlength=len(self.solvers))
        by = (f"{count:,} by {name}" for count, name in zip(n, self.solvers, strict=True) if count)
        return [
            ("lanes", counted(self.outcome, Outcome)),
            ("steps each", told(self.n_stepped, "")),
            ("engine", f"{self.engine}; {', '.join(by)}"),
            ("duration of the last step", told(jnp.sum(self.durations, -1), "s")),
        ]


def steps(
    params: WheelParams,
    states: Array | np.ndarray,
    n_steps: int = 1,
    *,
    model: AbstractWheel | None = None,
    options: Options | None = None,
    engine: Engine = "auto",
    durations: Array | np.ndarray | None = None,
) -> Steps:
    """`n_steps` gait steps of many wheels, or as many as each can: values only, no derivatives.

    `states` are section states, shape (lanes, 3), in rad, rad/s, m/s; fields of `params` are
    scalars or have the lanes' axis. "lanes" is the fast engine, for the viscoelastic wheel and
    explicit solvers; "diffrax" maps `model.advance` over the lanes and takes any solver; "auto"
    takes the first wherever it can, whatever the number of lanes, and `Steps.engine` says which it
    was. Both keep the errors of `options`, which count for each local step; between them lie some
    ten times the tolerance. "auto" also takes another solver than the named one where the airborne
    leg is so stiff that another is cheaper, and `Steps.solver` says which: Tsit5 where stability
    limits the steps (c/m from 1,900 1/s up at the default options, from 300 at a tolerance of
    1e-6), Kvaerno5 by "diffrax" where explicit ones take too many (from 4e5, from 1.4e5) or Tsit5
    gave up.

    "collocation" is faster still near a known gait: `durations`, shape (lanes, 3), s, are those of
    DLS, SLS-I and SLS-II to some per cent, as of a limit cycle or a neighbour's step; later steps
    take those of the step before. Its error is fixed, about 1e-8 for 99 lanes in 100, whatever
    `options` say. Each lane checks itself, and one that fails is left to the lane engine; `fixed`
    says which was which.

    On real ground (`UnilateralWheel`, its friction a scalar or of the lanes' axis) states may be
    the rung's own too, shape (lanes, 4 + 3 n), and the only engine is "lanes".

    Not for use inside `jax.jit`: it compiles itself, once.
    """
    untraced("vrw.steps", "map vrw.return_map over the lanes", params, states, durations)
    instance("params", params, WheelParams, "write vrw.WheelParams(damping=..., slope=...)")
    rung, options = rung_of(model), options_of(options)
    chosen("engine", engine, ENGINES)
    n_steps = whole("n_steps", n_steps)
    states = np.asarray(state_of(states, "states"))
    wheels = _wheels(params, states, rung, n_steps, options)
    states = states.astype(wheels.dtype)
    by_legs = rung.rung == "unilateral"
    given = rung, wheels, states, n_steps, options, engine, params.n_legs
    return _on_ground(*given) if by_legs else _by_phases(*given, durations)


def _wheels(
    params: WheelParams, states: np.ndarray, model: AbstractWheel, n_steps: int, options: Options
) -> np.ndarray:
    """Parameters of each lane, (parameters, lanes); one clear sentence for what can't be walked."""
    sizes = sorted({3, model.section_size(params)})
    if states.ndim != 2 or states.shape[1] not in sizes:
        raise ValueError(
            f"states have shape {states.shape}, but they are section states, shape (lanes, "
            f"{' or '.join(map(str, sizes))}): write states[None] for a single one."
        )
    options.require_reachable(jnp.result_type(*jax.tree.leaves(params)))
    dtype = np.dtype(jnp.result_type(params.damping, states.dtype))
    options.require_reachable(dtype)
    columns = [getattr(params, name) for name in PARAMETER_NAMES]
    for name, column in zip(PARAMETER_NAMES, columns, strict=True):
        if column.shape not in ((), states.shape[:1]):
            raise ValueError(
                f"{name} has shape {column.shape}, but there are {len(states)} states: give one "
                "value for all, or one for each."
            )
    wheels = np.empty((len(columns), len(states)), dtype)
    for row, column in zip(wheels, columns, strict=True):
        row[:] = np.asarray(column)
    return wheels


def _by_phases(
    model: Any,
    wheels: np.ndarray,
    states: np.ndarray,
    n_steps: int,
    options: Options,
    engine: str,
    n_legs: int,
    durations: Any,
) -> Steps:
    """Of rungs that step through the paper's phases."""
    walked = _Walked.start(states)
    runs = {NAMED: _chosen(engine, model, options, n_legs)}
    solver = np.full(len(states), NAMED, np.int32)
    solvers: tuple[str, ...] = (options.solver,)
    name = runs[NAMED].name
    if engine == "auto" and name == "lanes":
        solvers, solver = (
            (options.solver, STABLE_SOLVER, IMPLICIT_SOLVER),
            _cheapest(wheels, options),
        )
    if np.any(solver != NAMED):
        by = lambda solver: dataclasses.replace(options, solver=solver)
        stable = by(STABLE_SOLVER).tightened(TIGHTER)
        runs[STABLE] = _chosen("lanes", model, stable, n_legs)
        runs[IMPLICIT] = _chosen("diffrax", model, by(IMPLICIT_SOLVER), n_legs)
    if engine == "collocation":
        name = engine
        walked.durations[:] = _expected(durations, states, wheels.dtype)
    for _ in range(n_steps):
        open_ = np.flatnonzero(walked.outcome == Outcome.STEPPED)
        fixed = np.zeros(len(open_), bool)
        if engine == "collocation":
            given = wheels[:, open_], walked.section_state[open_], walked.durations[open_]
            fixed, told = _by_collocation(model, n_legs, *given)
            walked.take(open_[fixed], tuple(part[fixed] for part in told), fixed=True)
        open_ = open_[~fixed]
        for which, solve in runs.items():
            lanes = open_[solver[open_] == which]
            if len(lanes) > 0:
                told = solve(wheels[:, lanes], walked.section_state[lanes])
                # A phase may last longer than `_cheapest` expects: IMPLICIT comes next.
                lost = (which == STABLE) & (told[2] == Outcome.SOLVER_GAVE_UP)
                solver[lanes[lost]] = IMPLICIT
                walked.take(lanes[~lost], tuple(part[~lost] for part in told), fixed=False)
    return walked.told(solver, name, solvers)


def _on_ground(
    model: Any,
    wheels: np.ndarray,
    states: np.ndarray,
    n_steps: int,
    options: Options,
    engine: str,
    n_legs: int,
) -> Steps:
    if engine not in ("auto", "lanes") or explicit_tableau(options.solver) is None:
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
    return Steps(
        section_state, durations, outcome, n_stepped, tried, none, none.astype(jnp.int32),
        engine="lanes", solvers=(options.solver,),
    )  # fmt: skip


def _expected(durations: Any, states: np.ndarray, dtype: np.dtype) -> np.ndarray:
    if durations is None or np.shape(durations) != states.shape:
        shape = None if durations is None else np.shape(durations)
        raise ValueError(
            f"durations have shape {shape}, but collocation needs those of DLS, SLS-I and SLS-II "
            "to some per cent, shape (lanes, 3): give those of a limit cycle, or take 'lanes'."
        )
    return np.asarray(reals("durations", durations), dtype)


class _Walked:
    """Results so far, as numpy arrays."""

    def __init__(self, states: np.ndarray, n: int) -> None:
        self.section_state, self.durations = states, np.zeros_like(states)
        self.outcome, self.n_stepped, self.solver_steps = (np.zeros(n, np.int32) for _ in range(3))
        self.fixed = np.zeros(n, bool)

    @classmethod
    def start(cls, states: np.ndarray) -> "_Walked":
        return cls(states.copy(), len(states))

    def told(self, solver: np.ndarray, engine: str, solvers: tuple[str, ...]) -> Steps:
        states, outcome = jnp.asarray(self.section_state), jnp.asarray(self.outcome)
        counts = jnp.asarray(self.n_stepped), jnp.asarray(self.solver_steps)
        fixed, which = jnp.asarray(self.fixed), jnp.asarray(solver)
        durations = jnp.asarray(self.durations)
        return Steps(states, durations, outcome, *counts, fixed, which, engine, solvers)

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


def _chosen(engine: str, model: Any, options: Options, n_legs: int) -> _Engine:
    fits = model.rung == "viscoelastic" and explicit_tableau(options.solver) is not None
    if engine in ("lanes", "collocation") and not fits:
        raise ValueError(
            f"the lane engine can't run {type(model).__name__} with {options.solver}: it knows "
            "the viscoelastic wheel and explicit Runge-Kutta solvers; take engine='diffrax'."
        )
    if engine == "diffrax" or not fits:
        return _Engine("diffrax", functools.partial(_by_diffrax, model, options.by("diffrax"), n_legs))
    by_lanes = functools.partial(_by_lanes, model.stop_at_lift_off, options, n_legs)
    return _Engine("lanes", by_lanes)


def _cheapest(wheels: np.ndarray, options: Options) -> np.ndarray:
    """Which solver takes each lane at the least cost: NAMED, STABLE or IMPLICIT.

    The airborne leg's fast mode decays at 1.03 c/m for some 0.67 sqrt(L0 / g), s, where legs are
    light, and a step times that rate must stay below an explicit solver's limit of stability;
    rejected steps add a tenth. Where accuracy asks STABLE for more steps than that, about its
    tolerance to the power of -1/5, the solver remains that of `options`. More than
    `max_solver_steps` are no choice.
    """
    damping, mass, length, gravity = (
        wheels[PARAMETER_NAMES.index(name)]
        for name in ("damping", "leg_mass", "locked_length", "gravity")
    )
    tolerance = float(options.rtol)
    with np.errstate(all="ignore"):
        decays = 1.03 * damping / mass * 0.74 * np.sqrt(length / gravity)

        def evaluations(solver: str) -> tuple[np.ndarray, np.ndarray]:
            stages, bears = _stages_and_limit(solver)
            steps = decays / bears
            return steps, np.where(steps > options.max_solver_steps, np.inf, steps * stages)

        _, named = evaluations(options.solver)
        steps, stable = evaluations(STABLE_SOLVER)
        limited = steps > (tolerance / TIGHTER) ** -0.2
        implicit = np.full_like(decays, WORTH * (1e-6 / tolerance) ** 0.17)
        costs = named, np.where(limited, stable, np.inf), implicit
        return np.argmin(costs, axis=0).astype(np.int32)  # a wheel that is none: the first


@functools.cache
def _stages_and_limit(solver: str) -> tuple[int, float]:
    """Of an explicit solver: evaluations of a step; its length times a mode's rate, at most."""
    tableau = explicit_tableau(solver)
    assert tableau is not None  # `_chosen` looked
    return len(tableau.places) - 1, real_stability_limit(tableau)


def _by_lanes(
    stop_at_lift_off: bool,
    options: Options,
    n_legs: int,
    wheels: np.ndarray,
    states: np.ndarray,
) -> tuple[np.ndarray, ...]:
    """By the lane engine: wheels of like work side by side."""
    dynamic, static = eqx.partition(options, eqx.is_array)
    uniform = [np.asarray(leaf, wheels.dtype) for leaf in jax.tree.leaves(dynamic)]
    tableau = explicit_tableau(options.solver)
    assert tableau is not None  # `_chosen` looked
    structure, n = jax.tree.structure(dynamic), len(PARAMETER_NAMES)

    def step(uniform: Any, lanes: Any, few: Array | None = None) -> tuple:
        known = eqx.combine(jax.tree.unflatten(structure, uniform), static)
        params, x = wheel_of(lanes[:n], n_legs), tuple(lanes[n:])
        told = gait_step(params, x, known, tableau, stop_at_lift_off, few)
        return (
            told.unfinished, told.outcome, told.solver_steps, *told.section_state, *told.durations
        )  # fmt: skip

    # The airborne leg's fast rate, near c/m, sets the step where stability does.
    damping, mass = (wheels[PARAMETER_NAMES.index(name)] for name in ("damping", "leg_mass"))
    with np.errstate(all="ignore"):
        order = np.argsort(damping / mass, kind="stable")
    lanes = [*wheels[:, order], *states[order].T]
    settings = ("gait step", n_legs, stop_at_lift_off, static)
    told = _run(step, uniform, lanes, settings)
    back = np.empty_like(order)
    back[order] = np.arange(len(order))
    outcome, tried, *numbers = (x[back] for x in told[1:])
    return np.stack(numbers[:3], 1), np.stack(numbers[3:], 1), outcome, tried


def _by_collocation(
    model: Any,
    n_legs: int,
    wheels: np.ndarray,
    states: np.ndarray,
    durations: np.ndarray,
) -> tuple[np.ndarray, tuple[np.ndarray, ...]]:
    """Which lanes can be trusted, and their states, durations, outcomes and solver steps."""
    stop_at_lift_off, n = model.stop_at_lift_off, len(PARAMETER_NAMES)

    def step(uniform: Any, lanes: Any, few: Array | None = None) -> tuple:
        params, rest = wheel_of(lanes[:n], n_legs), tuple(lanes[n:])
        told = fixed_gait_step(params, rest[:3], rest[3:], stop_at_lift_off)
        never = jnp.zeros_like(told.trusted)
        return never, told.trusted, *told.section_state, *told.durations

    lanes = [*wheels, *states.T, *durations.T]
    settings = ("gait step by collocation", n_legs, stop_at_lift_off)
    _, trusted, *numbers = _run(step, [], lanes, settings)
    none = np.zeros(len(states), np.int32)
    return trusted, (np.stack(numbers[:3], 1), np.stack(numbers[3:], 1), none, none)


_programs: dict[Any, Callable] = {}
"""Compiled steps by what they depend on, see `_run`."""


def _run(
    step: Callable[..., tuple], uniform: list[np.ndarray], lanes: list[np.ndarray], settings: Any
) -> list[np.ndarray]:
    """`step(uniform, lanes, few)` compiled and run; its first result: lanes that it left undone.

    `settings`: all that `step` depends on but its arguments.
    """
    if len(lanes[0]) == 0:
        return [np.empty(0)] * 9
    dtype, cpu = lanes[0].dtype, simd.serves()
    key = (settings, dtype, cpu, BLOCK)
    if key not in _programs:
        if cpu:
            kinds = [x.dtype for x in uniform]
            _programs[key] = lane_program(step, kinds, len(lanes), dtype, settings)
        else:
            _programs[key] = functools.partial(_by_xla, jax.jit(step))
    return _programs[key](uniform, lanes)


def _by_xla(
    program: Callable, uniform: list[np.ndarray], lanes: list[np.ndarray]
) -> list[np.ndarray]:
    """Block by block; late lanes run again among their like."""
    told: list[np.ndarray] = []
    open_ = np.arange(len(lanes[0]))
    while len(open_) > 0:
        few = np.int32(BLOCK // FEW if len(open_) > BLOCK else 0)
        late = []
        for begin in range(0, len(open_), BLOCK):
            some = open_[begin : begin + BLOCK]
            filled = np.concatenate([some, np.repeat(some[-1:], BLOCK - len(some))])
            given = tuple(x[filled] for x in lanes)
            out = [np.asarray(x)[: len(some)] for x in program(tuple(uniform), given, few)]
            told = told or [np.empty(len(lanes[0]), x.dtype) for x in out]
            for told_whole, part in zip(told, out, strict=True):
                told_whole[some[~out[0]]] = part[~out[0]]
            late.append(some[out[0]])
        open_ = np.concatenate(late)
    return told


def _by_diffrax(
    model: AbstractWheel,
    options: Options,
    n_legs: int,
    wheels: np.ndarray,
    states: np.ndarray,
) -> tuple[np.ndarray, ...]:
    """By the model's own step under `jax.vmap`, MAPPED at a time."""
    options = jax.tree.map(lambda leaf: np.asarray(leaf, wheels.dtype), options)
    parts: list[Any] = []
    for begin in range(0, len(states), MAPPED):
        some = np.arange(begin, min(begin + MAPPED, len(states)))
        filled = np.minimum(np.arange(begin, begin + MAPPED), len(states) - 1)
        out = _mapped(model, options, n_legs, wheels[:, filled], states[filled].T)
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
