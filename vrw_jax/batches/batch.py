"""Gait steps of batches of wheels: one function for several engines.

On a CPU the "lanes" engine is machine code for a few lanes at a time (`simd`). On a GPU it is an
XLA program for very many lanes, and a few stragglers are run again in smaller batches. In both
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

from vrw_jax.batches.fixed_work import fixed_gait_step
from vrw_jax.batches.floors import over_floors
from vrw_jax.batches.ground import ON_GROUND, on_ground
from vrw_jax.batches.programs import run_lanes
from vrw_jax.batches.stiffness import (
    IMPLICIT,
    IMPLICIT_SOLVER,
    NAMED,
    STABLE,
    STABLE_SOLVER,
    TIGHTER,
    cheapest_solver,
)
from vrw_jax.batches.walked import START, Steps, Walked, only
from vrw_jax.models import (
    DIRECTIONS,
    AbstractWheel,
    Advance,
    along_all,
    along_units,
    gait_step,
)
from vrw_jax.numerics import Options, explicit_tableau, in_batches
from vrw_jax.walks import options_of, rung_of, state_of
from vrw_jax.wheel import FRICTION, PARAMETER_NAMES, Outcome, WheelParams, wheel_of
from vrw_jax.wording import (
    chosen,
    instance,
    known_reals,
    untraced,
    whole,
)

BatchEngine = Literal["auto", "lanes", "diffrax", "collocation"]
ENGINES: tuple[str, ...] = get_args(BatchEngine)

BY_PHASES = (START, *PARAMETER_NAMES)
"""Inputs with respect to which a step of the paper's model can be differentiated."""

MAPPED = 256
"""Number of batch elements that the diffrax engine takes at a time."""


def steps(
    params: WheelParams,
    states: Array | np.ndarray,
    n_steps: int = 1,
    *,
    model: AbstractWheel | None = None,
    options: Options | None = None,
    engine: BatchEngine = "auto",
    durations: Array | np.ndarray | None = None,
    derivatives: Sequence[str] = (),
) -> Steps:
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

    "collocation" is faster still near a known gait. `durations` are those of DLS, SLS-I and SLS-II
    to some per cent, as of a limit cycle or a neighbor's step. Later steps use those of the
    previous step. Its error is fixed, about 1e-8 for 99 elements in 100, independent of `options`.
    Each element is checked, and an element that fails the check is stepped by the lane engine.
    `is_collocated` marks the elements that passed.

    Derivatives go through all steps and their events. They are zero for an element whose walk
    failed, and are not available by collocation. With unilateral contact (`UnilateralWheel`, with
    friction a scalar or one value per element) the only engine is "lanes". It is "diffrax" if slope
    or friction differ from step to step, with shape (elements, n_steps) as in `walk`. This function
    cannot be used inside `jax.jit`; it compiles itself, once.

    Args:
        params: the wheels; fields are scalars or of shape (elements,).
        states: section states, shape (elements, 3), rad, rad/s, m/s, or full states with contact.
        n_steps: largest number of steps.
        model: the model; the paper's, `ViscoelasticWheel()`, by default.
        options: numerical choices of the steps.
        engine: "auto", "lanes", "diffrax" or "collocation", as above.
        durations: of the phases, shape (elements, 3), s, for "collocation".
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
    untraced("vrw.steps", "map vrw.return_map over the lanes", params, states, durations)
    instance("params", params, WheelParams, "write vrw.WheelParams(damping=..., slope=...)")
    rung, options = rung_of(model, many=True), options_of(options)
    chosen("engine", engine, ENGINES)
    n_steps = whole("n_steps", n_steps)
    x: np.ndarray = state_of(states, "states", known_reals)
    columns = _columns(params, x, rung, options, n_steps)
    x = x.astype(columns[0].dtype, copy=False)
    by_legs = rung.lanes == "legs"
    given = rung, columns, x, n_steps, options, engine, params.n_legs
    if any(np.ndim(column) == 2 for column in (*columns, getattr(rung, FRICTION, 0.0))):
        return over_floors(*given, derivatives)
    moved = _moved(derivatives, ON_GROUND if by_legs else BY_PHASES, engine)
    return on_ground(*given, moved) if by_legs else _by_phases(*given, durations, moved)


def _moved(derivatives: Sequence[str], known: tuple[str, ...], engine: str) -> list[str]:
    """Return the names of the inputs to differentiate by.

    Raises: ValueError: a name is unknown, or the engine has no derivatives.
    """
    names = [derivatives] if isinstance(derivatives, str) else list(derivatives)
    for name in names:
        if name not in known:
            raise ValueError(
                f"derivatives name {name!r}, but a step moves with one of {', '.join(known)}."
            )
    if names and engine == "collocation":
        raise ValueError(
            "derivatives are not available by collocation in batches: take "
            "engine='lanes', or jax.jacfwd of vrw.return_map."
        )
    return names


def _columns(
    params: WheelParams, states: np.ndarray, model: AbstractWheel, options: Options, n_steps: int
) -> list[np.ndarray]:
    """Return the parameters, one value for all or one per element, with slopes of each step too.

    Raises: ValueError: the shapes of states or parameters do not fit.
    """
    sizes = [3]
    if states.ndim != 2 or states.shape[1] != 3:
        sizes = sorted({3, model.section_size(params)})
    if states.ndim != 2 or states.shape[1] not in sizes:
        raise ValueError(
            f"states have shape {states.shape}, but they are section states, shape (lanes, "
            f"{' or '.join(map(str, sizes))}): write states[None] for a single one."
        )
    n, columns = len(states), [getattr(params, name) for name in PARAMETER_NAMES]
    held = np.result_type(*(column.dtype for column in columns))
    Options.require_reachable(options, held)  # equinox takes 0.1 ms for a bound method
    of_ground = getattr(model, FRICTION, np.zeros(()))
    for name, column in zip((*PARAMETER_NAMES, FRICTION), (*columns, of_ground), strict=True):
        of_steps = name in ("slope", FRICTION) and np.ndim(column) == 2
        if np.shape(column) not in ((), (n,), *[(n, n_steps)] * of_steps):
            raise ValueError(
                f"{name} has shape {np.shape(column)}, but there are {n} states"
                f"{f' and {n_steps} steps' * of_steps}: give one value for all, or one for each"
                f"{' and each of its steps' * of_steps}."
            )
    dtype = np.promote_types(held, states.dtype)
    return [np.asarray(column, dtype) for column in columns]


def _by_phases(
    model: Any,
    columns: list[np.ndarray],
    states: np.ndarray,
    n_steps: int,
    options: Options,
    engine: str,
    n_legs: int,
    durations: Any,
    asked: Sequence[str],
) -> Steps:
    order = work_order(columns, states)
    wheels = np.empty((len(columns), len(states)), states.dtype)
    for row, column in zip(wheels, columns, strict=True):
        row[:] = column[order] if column.ndim else column
    walked = Walked(states.T.take(order, -1), asked, PARAMETER_NAMES)
    some = n_legs, walked.moved
    runs = {NAMED: _chosen(engine, model, options, *some)}
    solver = np.full(len(states), NAMED, np.int32)
    solvers: tuple[str, ...] = (options.solver,)
    name = runs[NAMED].name
    if engine == "auto" and name == "lanes":
        solvers, solver = (
            (options.solver, STABLE_SOLVER, IMPLICIT_SOLVER),
            cheapest_solver(wheels, options.for_derivatives() if asked else options),
        )
    if np.any(solver != NAMED):
        by = lambda solver: dataclasses.replace(options, solver=solver)
        stable = by(STABLE_SOLVER).tightened(TIGHTER)
        runs[STABLE] = _chosen("lanes", model, stable, *some)
        runs[IMPLICIT] = _chosen("diffrax", model, by(IMPLICIT_SOLVER), *some)
    if engine == "collocation":
        name = engine
        walked.durations[:] = _expected(durations, states, wheels.dtype).T.take(order, -1)
    for _ in range(n_steps):
        open_ = walked.on()
        if engine == "collocation" and len(open_):
            all_ = only(open_, walked)
            given = wheels[:, all_], walked.section_state[:, all_], walked.durations[:, all_]
            walked.take(open_, *_by_collocation(runs[NAMED], model, n_legs, *given))
            continue
        for which, run in runs.items():
            lanes = open_[solver[open_] == which]
            if len(lanes) > 0:
                all_ = only(lanes, walked)
                told = run.step(wheels[:, all_], walked.section_state[:, all_])
                if which == STABLE:
                    # A phase may last longer than `select_solver` assumes; the next is implicit.
                    lost = told[2] == Outcome.SOLVER_GAVE_UP
                    solver[lanes[lost]] = IMPLICIT
                    lanes, told = lanes[~lost], tuple(part[..., ~lost] for part in told)
                walked.take(lanes, told, np.zeros(len(lanes), bool))
    return walked.told(order, solver, name, solvers)


def work_order(columns: list[np.ndarray], states: np.ndarray) -> np.ndarray:
    """Return an order of the batch in which wheels of similar work are side by side.

    A group of lanes takes as long as its slowest lane. Most of a step's work is in SLS-I. There
    stability limits the solver's steps by m/c, and Leg 2 extends at the rate k (Ls - L)/c from its
    length at release. The exponents are rounded from a fit to the solver's steps of wheels near
    their gaits and away from them (`python -m experiments.speed.lanes_that_wait`).
    """
    own = dict(zip(PARAMETER_NAMES, columns, strict=True))
    single = lambda name: np.asarray(own[name], np.float32)
    with np.errstate(all="ignore"):
        theta, dtheta = states.T[:2].astype(np.float32)
        length, mass = single("locked_length"), single("leg_mass")
        work = np.log(single("damping") / mass) - 0.25 * np.log(single("stiffness") / mass)
        work = work + 0.8 * np.log(dtheta) + 0.65 * np.log(length / single("gravity"))
        work = work + theta - 7.0 * single("natural_length") / length
    return np.argsort(work)


def _expected(durations: Any, states: np.ndarray, dtype: np.dtype) -> np.ndarray:
    if durations is None or np.shape(durations) != states.shape:
        shape = None if durations is None else np.shape(durations)
        raise ValueError(
            f"durations have shape {shape}, but collocation needs those of DLS, SLS-I and SLS-II "
            "to some per cent, shape (lanes, 3): give those of a limit cycle, or take 'lanes'."
        )
    return known_reals("durations", durations).astype(dtype, copy=False)


class _Engine(NamedTuple):
    """One gait step of any number of lanes, from numpy to numpy, lanes on the last axis."""

    name: str
    step: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, ...]]


def _chosen(
    engine: str, model: Any, options: Options, n_legs: int, moved: tuple[int, ...]
) -> _Engine:
    fits = model.lanes == "phases" and explicit_tableau(options.solver) is not None
    if engine in ("lanes", "collocation") and not fits:
        raise ValueError(
            f"the lane engine can't run {type(model).__name__} with {options.solver}: it supports "
            "the viscoelastic wheel and explicit Runge-Kutta solvers; take engine='diffrax'."
        )
    if engine == "diffrax" or not fits:
        by_diffrax = functools.partial(_by_diffrax, model, options.by("diffrax"), n_legs, moved)
        return _Engine("diffrax", by_diffrax)
    by_lanes = functools.partial(_by_lanes, model.stop_at_lift_off, options, n_legs, moved)
    return _Engine("lanes", by_lanes)


def _by_lanes(
    stop_at_lift_off: bool,
    options: Options,
    n_legs: int,
    moved: tuple[int, ...],
    wheels: np.ndarray,
    states: np.ndarray,
) -> tuple[np.ndarray, ...]:
    """Take one gait step by the lane engine."""
    dynamic, structure = jax.tree.flatten(options)
    uniform = [np.asarray(leaf, wheels.dtype) for leaf in dynamic]
    tableau, n = explicit_tableau(options.solver), len(PARAMETER_NAMES)
    assert tableau is not None  # checked by `_select_engine`

    def step(uniform: Any, lanes: Any, few: Array | None = None) -> tuple:
        known = jax.tree.unflatten(structure, uniform)
        known = known.for_derivatives() if moved else known

        def told(*lanes: Array) -> tuple:
            params, x = wheel_of(lanes[:n], n_legs), lanes[n:]
            step = gait_step(params, x, known, tableau, stop_at_lift_off, few)
            others = step.unfinished, step.outcome, step.solver_steps
            return jnp.stack([*step.section_state, *step.durations]), others

        if not moved:
            numbers, others = told(*lanes)
            return (*others, numbers)
        by_all = along_all if len(moved) == DIRECTIONS else along_units
        columns, numbers, others = by_all(told, lanes, moved)
        return (*others, numbers, columns)

    settings = ("gait step", n_legs, stop_at_lift_off, structure, moved)
    small = (DIRECTIONS,) if moved else ()
    told = run_lanes(step, uniform, [*wheels, *states], settings, *small)
    _, outcome, tried, numbers, *columns = told
    return numbers[:3], numbers[3:], outcome, tried, *columns


def _by_collocation(
    by_lanes: _Engine,
    model: Any,
    n_legs: int,
    wheels: np.ndarray,
    states: np.ndarray,
    durations: np.ndarray,
) -> tuple[tuple[np.ndarray, ...], np.ndarray]:
    """Take one step by collocation, and by the lane engine for lanes that fail the check; return
    which passed."""
    stop_at_lift_off, n = model.stop_at_lift_off, len(PARAMETER_NAMES)

    def step(uniform: Any, lanes: Any, few: Array | None = None) -> tuple:
        params, rest = wheel_of(lanes[:n], n_legs), tuple(lanes[n:])
        told = fixed_gait_step(params, rest[:3], rest[3:], stop_at_lift_off)
        never = jnp.zeros_like(told.trusted)
        return never, told.trusted, jnp.stack([*told.section_state, *told.durations])

    settings = ("gait step by collocation", n_legs, stop_at_lift_off)
    _, trusted, numbers = run_lanes(step, [], [*wheels, *states, *durations], settings)
    outcome, tried = np.zeros((2, len(trusted)), np.int32)
    told = numbers[:3], numbers[3:], outcome, tried
    rest = np.flatnonzero(~trusted)
    if len(rest) > 0:
        for whole_, part in zip(told, by_lanes.step(wheels[:, rest], states[:, rest]), strict=True):
            whole_[..., rest] = part
    return told, trusted


def _by_diffrax(
    model: AbstractWheel,
    options: Options,
    n_legs: int,
    moved: tuple[int, ...],
    wheels: np.ndarray,
    states: np.ndarray,
) -> tuple[np.ndarray, ...]:
    """Take one step by the model's own step under `jax.vmap`, DIFFRAX_BATCH_SIZE elements at a
    time."""
    options = jax.tree.map(lambda leaf: np.asarray(leaf, wheels.dtype), options)
    rows = np.concatenate([wheels, states]).T
    mapped = functools.partial(_mapped, model, options, n_legs, moved)
    return jax.tree.map(lambda x: np.array(x).T, in_batches(mapped, (MAPPED,), rows))


@eqx.filter_jit
def _mapped(
    model: AbstractWheel, options: Options, n_legs: int, moved: tuple[int, ...], rows: Array
) -> tuple[Array, ...]:
    n = len(PARAMETER_NAMES)

    def one(numbers: Array) -> tuple[Array, ...]:
        def told(some: Array) -> tuple[Array, Advance]:
            full = numbers.at[np.array(moved, int)].set(some)
            taken = model.advance(wheel_of(full[:n], n_legs), full[n:], options)
            return jnp.concatenate([taken.section_state, taken.durations]), taken

        some = numbers[np.array(moved, int)]
        if not moved:
            _, taken = told(some)
            return taken.section_state, taken.durations, taken.outcome, taken.solver_steps
        jacobian, taken = jax.jacfwd(told, has_aux=True)(some)
        values = taken.section_state, taken.durations, taken.outcome, taken.solver_steps
        return *values, jacobian

    return jax.vmap(one)(rows)
