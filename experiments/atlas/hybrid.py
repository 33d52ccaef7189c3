"""One hybrid system walked by four methods: this library, diffrax's events, SciPy and heyoka.

A system is written once, elementwise: field, guards and resets take a tuple of numbers and the
functions (`sin`, `cos`, ...) of whoever integrates. Guards are positive inside their mode.
"""

import functools
import math
import types
from collections.abc import Callable, Sequence
from importlib.metadata import version
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from scipy.integrate import solve_ivp

import vrw_jax as vrw
from experiments.atlas.results import EXACT_ERROR, Row, compute_error, time_second_call
from experiments.shared.command import require_extra
from vrw_jax.hybrid import Guard, Mode, Termination, simulate_hybrid, time_errors

hy = require_extra("heyoka")
Numbers = Sequence[Any]
NO_EVENT = "no event to the end of time"
MAX_INSTANT_EVENTS = 5
"""Events in a row that take no time: a peer that has come to this is stopped here."""


class GuardEdge(NamedTuple):
    """A guard, what it does, and where it leads."""

    value: Callable[[Numbers, Any], Any]
    reset: Callable[[Numbers, Any], Numbers] = lambda y, m: y
    target_part: int = 0


class Part(NamedTuple):
    """A mode of a system."""

    field: Callable[[Numbers, Any], Numbers]
    edges: tuple[GuardEdge, ...]


class MethodRun(NamedTuple):
    """Events as a method found them, and what it says of itself."""

    method: str
    times: np.ndarray
    states: np.ndarray  # on the guards, before resets
    edges: np.ndarray
    says: str  # empty: all events that were asked for
    admits: bool  # whether it tells a failure; to meet no event is to claim that there is none
    work: int
    seconds: float
    options: str
    version: str
    end: np.ndarray  # the last state, past the reset
    resolution: np.ndarray = np.zeros(0)  # of each time: what the tolerances are in it, if told
    rounding: np.ndarray = np.zeros(0)  # and one rounding of the state
    stated_errors: np.ndarray = np.zeros(0)  # and what it may be off by in all


JAX = types.SimpleNamespace(sin=jnp.sin, cos=jnp.cos, exp=jnp.exp, sqrt=jnp.sqrt, stack=jnp.stack)


def modes(system: Sequence[Part]) -> tuple[Mode, ...]:
    """Return the modes of the system for `vrw_jax.hybrid`."""
    row = lambda function: lambda y: jnp.stack([jnp.asarray(x, float) for x in function(y, JAX)])

    def guard(edge: GuardEdge) -> Guard:
        return Guard(lambda y: jnp.asarray(edge.value(y, JAX)), row(edge.reset), edge.target_part)

    return tuple(Mode(row(part.field), tuple(map(guard, part.edges))) for part in system)


@functools.lru_cache
def _our_run(system: tuple[Part, ...], events: int, options: tuple) -> tuple[Callable, Callable]:
    """Simulate with this library, and return the walk with the errors of its event times."""
    parts, chosen = modes(system), vrw.StepOptions(**dict(options))
    return (
        jax.jit(lambda y: simulate_hybrid(parts, y, events=events, options=chosen)),
        jax.jit(lambda y, solution: time_errors(parts, y, solution, chosen)),
    )


def run_library(
    system: Sequence[Part], start: Numbers, events: int, limit: float, solver: str = "Dopri8",
    tolerance: float = 1e-13, **changed: Any,
) -> MethodRun:  # fmt: skip
    chosen = {"rtol": tolerance, "atol": tolerance, "max_phase_time": limit, **changed}
    run, errors = _our_run(tuple(system), events, (("solver", solver), *chosen.items()))
    y = jnp.asarray(start, float)
    result, seconds = time_second_call(lambda: jax.block_until_ready(run(y)))
    n, stop = int(result.n_events), Termination(int(result.termination))
    return MethodRun(
        "ours",
        np.asarray(result.times[:n]),
        np.asarray(result.states_before[:n]),
        np.asarray(result.guards[:n]),
        "" if stop == Termination.MAX_EVENTS_REACHED else stop.name,
        stop not in (Termination.MAX_EVENTS_REACHED, Termination.MAX_TIME_REACHED),
        int(result.solver_steps),
        seconds,
        f"{solver} {tolerance:g}",
        version("vrw-jax"),
        np.asarray(result.state),
        np.asarray(result.time_tolerance[:n]),
        np.asarray(result.time_roundoff[:n]),
        np.asarray(errors(y, result)[:n]),
    )


class _ModeExit(NamedTuple):
    """How a peer left one mode; `edge` is None where it met no event."""

    state: np.ndarray
    duration: float
    edge: int | None
    work: int
    says: str


def _simulate_modes(
    leave: Callable[[int, np.ndarray], _ModeExit],
    system: Sequence[Part],
    start: Numbers,
    events: int,
) -> tuple:
    """Simulate the modes one after another by another library, restarted as its documentation
    describes.
    """
    mode, time, n_events_at_once, work = 0, 0.0, 0, 0
    y, says = np.asarray(start, float), ""
    times, states, edges = [], [], []
    while len(times) < events and not says:
        try:
            solution = leave(mode, y)
        except Exception as failure:
            says = f"{type(failure).__name__}: {failure}".split("\n")[0][:120]
            break
        work += solution.work
        if solution.edge is None:
            says = solution.says or NO_EVENT
            break
        n_events_at_once = 0 if time + solution.duration > time else n_events_at_once + 1
        if n_events_at_once > MAX_INSTANT_EVENTS:
            says = "stands still (stopped here)"
            break
        edge = system[mode].edges[solution.edge]
        time += solution.duration
        times.append(time)
        states.append(solution.state)
        edges.append(solution.edge)
        y, mode = np.array(edge.reset(solution.state, math), float), edge.target_part
    return np.array(times), np.array(states).reshape(-1, len(start)), np.array(edges), says, work, y


def _run_method(
    method: str, leave: Callable, system: Sequence[Part], start: Numbers, events: int,
    options: str, package: str,
) -> MethodRun:  # fmt: skip
    result, seconds = time_second_call(lambda: _simulate_modes(leave, system, start, events))
    times, states, edges, says, work, end = result
    return MethodRun(
        method,
        times,
        states,
        edges,
        says,
        says not in ("", NO_EVENT),
        work,
        seconds,
        options,
        version(package),
        end,
    )


def run_scipy(
    system: Sequence[Part], start: Numbers, events: int, limit: float, method: str = "DOP853",
    tolerance: float = 1e-13,
) -> MethodRun:  # fmt: skip
    def event(edge: GuardEdge) -> Callable:
        watched = lambda t, y: edge.value(y, math)
        watched.terminal, watched.direction = True, -1  # type: ignore[attr-defined]
        return watched

    def leave(mode: int, y: np.ndarray) -> _ModeExit:
        part = system[mode]
        result = solve_ivp(
            lambda t, y: part.field(y, math), (0.0, limit), y, method=method, rtol=tolerance,
            atol=tolerance, events=[event(edge) for edge in part.edges],
        )  # fmt: skip
        event_rows = [i for i, times in enumerate(result.t_events) if len(times)]
        says = "" if result.status >= 0 else result.message
        if not event_rows:
            return _ModeExit(result.y[:, -1], result.t[-1], None, result.nfev, says)
        edge = min(event_rows, key=lambda i: result.t_events[i][0])
        return _ModeExit(
            result.y_events[edge][0], result.t_events[edge][0], edge, result.nfev, says
        )

    options = f"{method} {tolerance:g}"
    return _run_method("SciPy", leave, system, start, events, options, "scipy")


@functools.lru_cache
def _diffrax_solves(
    system: tuple[Part, ...], limit: float, solver: str, tolerance: float
) -> list[Callable]:
    solves = []
    for part in system:
        field = lambda t, y, args, part=part: jnp.stack(
            [jnp.asarray(x, float) for x in part.field(y, JAX)]
        )
        conditions = [
            lambda t, y, args, edge=edge, **_: jnp.asarray(edge.value(y, JAX), float)
            for edge in part.edges
        ]
        event = diffrax.Event(
            conditions, optx.Newton(1e-14, 1e-14), direction=[False] * len(conditions)
        )

        def solve(y: jax.Array, field: Callable = field, event: diffrax.Event = event) -> Any:
            return diffrax.diffeqsolve(
                diffrax.ODETerm(field), getattr(diffrax, solver)(), 0.0, limit, 5e-3, y,
                stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=tolerance),
                event=event, max_steps=100_000, throw=False,
            )  # fmt: skip

        solves.append(eqx.filter_jit(solve))
    return solves


def run_diffrax(
    system: Sequence[Part], start: Numbers, events: int, limit: float, solver: str = "Dopri8",
    tolerance: float = 1e-13,
) -> MethodRun:  # fmt: skip
    solves = _diffrax_solves(tuple(system), limit, solver, tolerance)

    def leave(mode: int, y: np.ndarray) -> _ModeExit:
        result = solves[mode](jnp.asarray(y))
        state, time = np.asarray(result.ys[-1]), float(result.ts[-1])
        work = int(result.stats["num_steps"])
        event_indices = np.flatnonzero([bool(x) for x in result.event_mask])
        if result.result == diffrax.RESULTS.event_occurred and len(event_indices):
            return _ModeExit(state, time, int(event_indices[0]), work, "")
        good = result.result == diffrax.RESULTS.successful
        says = "" if good else str(result.result).split("<")[-1].split(".")[0][:90]
        return _ModeExit(state, time, None, work, says)

    options = f"{solver} {tolerance:g}, Newton 1e-14"
    return _run_method("diffrax", leave, system, start, events, options, "diffrax")


@functools.lru_cache
def _heyoka_flows(system: tuple[Part, ...], dim: int) -> list[Any]:
    fall = hy.event_direction.negative
    names = hy.make_vars(*[f"y{i}" for i in range(dim)])
    names = names if isinstance(names, list | tuple) else [names]
    flows = []
    for part in system:
        right = [x + 0.0 * names[0] for x in part.field(names, hy)]
        watched = [hy.t_event(edge.value(names, hy), direction=fall) for edge in part.edges]
        flow = hy.taylor_adaptive(
            list(zip(names, right, strict=True)), [1.0] * dim, t_events=watched
        )
        flows.append(flow)
    return flows


def run_heyoka(system: Sequence[Part], start: Numbers, events: int, limit: float) -> MethodRun:
    flows = _heyoka_flows(tuple(system), len(start))
    last = [-1]

    def leave(mode: int, y: np.ndarray) -> _ModeExit:
        flow = flows[mode]
        if last[0] != mode:  # else the cooldown keeps the event just met from firing again
            flow.reset_cooldowns()
        last[0] = mode
        flow.time, flow.state[:] = 0.0, y
        outcome, _, _, steps, *_ = flow.propagate_until(limit)
        code = int(outcome)
        state = flow.state.copy()
        if code < 0 and -code <= len(system[mode].edges):
            return _ModeExit(state, flow.time, -code - 1, steps, "")
        says = "" if outcome == hy.taylor_outcome.time_limit else str(outcome).split(".")[-1]
        return _ModeExit(state, flow.time, None, steps, says)

    return _run_method("heyoka", leave, system, start, events, "Taylor, 2.2e-16", "heyoka")


METHODS = (run_library, run_diffrax, run_scipy, run_heyoka)


def make_row(
    walk_result: MethodRun,
    quantity: str,
    solution: float,
    reference: float,
    *,
    relative: bool = False,
    condition: float = 1.0,
    digits: int | None = None,
    event: int = 0,
) -> Row:
    """Return the table row of one quantity at an event, with the condition number if it is
    large.
    """
    of_values, says = slice(event or None), walk_result.says
    stated, rounding = walk_result.stated_errors[of_values], walk_result.rounding[of_values]
    if not says and len(stated) and stated[-1] > EXACT_ERROR:
        says = f"time to {stated[-1]:.0e}"
        if rounding[-1] > EXACT_ERROR:
            says += f", one rounding: {rounding[-1]:.1e}"
    return Row(
        quantity, walk_result.method, solution, reference, compute_error(solution, reference,
        relative=relative), says,
        walk_result.admits, walk_result.work, walk_result.seconds, walk_result.options,
        walk_result.version,
        condition, digits,
    )  # fmt: skip


def last_time(walk_result: MethodRun, events: int) -> float:
    """Time of the last of `events` events; not a number if there are fewer."""
    return float(walk_result.times[events - 1]) if len(walk_result.times) >= events else math.nan
