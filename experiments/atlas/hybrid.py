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
from experiments.atlas.told import EXACT, Row, off, timed
from experiments.shared.command import extra
from vrw_jax.numerics import Guard, Mode, Stop, time_errors, walk

hy = extra("heyoka")
Numbers = Sequence[Any]
NO_EVENT = "no event to the end of time"
STILL = 5
"""Events in a row that take no time: a peer that has come to this is stopped here."""


class Edge(NamedTuple):
    """A guard, what it does, and where it leads."""

    value: Callable[[Numbers, Any], Any]
    reset: Callable[[Numbers, Any], Numbers] = lambda y, m: y
    to: int = 0


class Part(NamedTuple):
    """A mode of a system."""

    field: Callable[[Numbers, Any], Numbers]
    edges: tuple[Edge, ...]


class Walked(NamedTuple):
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
    stated: np.ndarray = np.zeros(0)  # and what it may be off by in all


JAX = types.SimpleNamespace(sin=jnp.sin, cos=jnp.cos, exp=jnp.exp, sqrt=jnp.sqrt, stack=jnp.stack)


def modes(system: Sequence[Part]) -> tuple[Mode, ...]:
    """The system as this library's face takes it."""
    row = lambda function: lambda y: jnp.stack([jnp.asarray(x, float) for x in function(y, JAX)])

    def guard(edge: Edge) -> Guard:
        return Guard(lambda y: jnp.asarray(edge.value(y, JAX)), row(edge.reset), edge.to)

    return tuple(Mode(row(part.field), tuple(map(guard, part.edges))) for part in system)


@functools.lru_cache
def _our_run(system: tuple[Part, ...], events: int, options: tuple) -> tuple[Callable, Callable]:
    """The walk, and what its event times may be off by."""
    parts, chosen = modes(system), vrw.Options(**dict(options))
    return (
        jax.jit(lambda y: walk(parts, y, events=events, options=chosen)),
        jax.jit(lambda y, told: time_errors(parts, y, told, chosen)),
    )


def ours(
    system: Sequence[Part], start: Numbers, events: int, limit: float, solver: str = "Dopri8",
    tolerance: float = 1e-13, **changed: Any,
) -> Walked:  # fmt: skip
    chosen = {"rtol": tolerance, "atol": tolerance, "max_phase_time": limit, **changed}
    run, errors = _our_run(tuple(system), events, (("solver", solver), *chosen.items()))
    y = jnp.asarray(start, float)
    told, seconds = timed(lambda: jax.block_until_ready(run(y)))
    n, stop = int(told.n_events), Stop(int(told.stop))
    return Walked(
        "ours",
        np.asarray(told.times[:n]),
        np.asarray(told.before[:n]),
        np.asarray(told.guards[:n]),
        "" if stop == Stop.EVENTS_DONE else stop.name,
        stop not in (Stop.EVENTS_DONE, Stop.TIME_OVER),
        int(told.solver_steps),
        seconds,
        f"{solver} {tolerance:g}",
        version("vrw-jax"),
        np.asarray(told.state),
        np.asarray(told.resolution[:n]),
        np.asarray(told.rounding[:n]),
        np.asarray(errors(y, told)[:n]),
    )


class _Found(NamedTuple):
    """How a peer left one mode; `edge` is None where it met no event."""

    state: np.ndarray
    duration: float
    edge: int | None
    work: int
    says: str


def _through(
    leave: Callable[[int, np.ndarray], _Found], system: Sequence[Part], start: Numbers, events: int
) -> tuple:
    """A peer's modes one after the other, as its documents tell to restart."""
    mode, time, still, work = 0, 0.0, 0, 0
    y, says = np.asarray(start, float), ""
    times, states, edges = [], [], []
    while len(times) < events and not says:
        try:
            found = leave(mode, y)
        except Exception as failure:
            says = f"{type(failure).__name__}: {failure}".split("\n")[0][:120]
            break
        work += found.work
        if found.edge is None:
            says = found.says or NO_EVENT
            break
        still = 0 if time + found.duration > time else still + 1
        if still > STILL:
            says = "stands still (stopped here)"
            break
        edge = system[mode].edges[found.edge]
        time += found.duration
        times.append(time)
        states.append(found.state)
        edges.append(found.edge)
        y, mode = np.array(edge.reset(found.state, math), float), edge.to
    return np.array(times), np.array(states).reshape(-1, len(start)), np.array(edges), says, work, y


def _walked(
    method: str, leave: Callable, system: Sequence[Part], start: Numbers, events: int,
    options: str, package: str,
) -> Walked:  # fmt: skip
    told, seconds = timed(lambda: _through(leave, system, start, events))
    times, states, edges, says, work, end = told
    return Walked(
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


def by_scipy(
    system: Sequence[Part], start: Numbers, events: int, limit: float, method: str = "DOP853",
    tolerance: float = 1e-13,
) -> Walked:  # fmt: skip
    def event(edge: Edge) -> Callable:
        watched = lambda t, y: edge.value(y, math)
        watched.terminal, watched.direction = True, -1  # type: ignore[attr-defined]
        return watched

    def leave(mode: int, y: np.ndarray) -> _Found:
        part = system[mode]
        told = solve_ivp(
            lambda t, y: part.field(y, math), (0.0, limit), y, method=method, rtol=tolerance,
            atol=tolerance, events=[event(edge) for edge in part.edges],
        )  # fmt: skip
        met = [i for i, times in enumerate(told.t_events) if len(times)]
        says = "" if told.status >= 0 else told.message
        if not met:
            return _Found(told.y[:, -1], told.t[-1], None, told.nfev, says)
        edge = min(met, key=lambda i: told.t_events[i][0])
        return _Found(told.y_events[edge][0], told.t_events[edge][0], edge, told.nfev, says)

    options = f"{method} {tolerance:g}"
    return _walked("SciPy", leave, system, start, events, options, "scipy")


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


def by_diffrax(
    system: Sequence[Part], start: Numbers, events: int, limit: float, solver: str = "Dopri8",
    tolerance: float = 1e-13,
) -> Walked:  # fmt: skip
    solves = _diffrax_solves(tuple(system), limit, solver, tolerance)

    def leave(mode: int, y: np.ndarray) -> _Found:
        told = solves[mode](jnp.asarray(y))
        state, time = np.asarray(told.ys[-1]), float(told.ts[-1])
        work = int(told.stats["num_steps"])
        met = np.flatnonzero([bool(x) for x in told.event_mask])
        if told.result == diffrax.RESULTS.event_occurred and len(met):
            return _Found(state, time, int(met[0]), work, "")
        good = told.result == diffrax.RESULTS.successful
        says = "" if good else str(told.result).split("<")[-1].split(".")[0][:90]
        return _Found(state, time, None, work, says)

    options = f"{solver} {tolerance:g}, Newton 1e-14"
    return _walked("diffrax", leave, system, start, events, options, "diffrax")


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


def by_heyoka(system: Sequence[Part], start: Numbers, events: int, limit: float) -> Walked:
    flows = _heyoka_flows(tuple(system), len(start))
    last = [-1]

    def leave(mode: int, y: np.ndarray) -> _Found:
        flow = flows[mode]
        if last[0] != mode:  # else the cooldown keeps the event just met from firing again
            flow.reset_cooldowns()
        last[0] = mode
        flow.time, flow.state[:] = 0.0, y
        outcome, _, _, steps, *_ = flow.propagate_until(limit)
        code = int(outcome)
        state = flow.state.copy()
        if code < 0 and -code <= len(system[mode].edges):
            return _Found(state, flow.time, -code - 1, steps, "")
        says = "" if outcome == hy.taylor_outcome.time_limit else str(outcome).split(".")[-1]
        return _Found(state, flow.time, None, steps, says)

    return _walked("heyoka", leave, system, start, events, "Taylor, 2.2e-16", "heyoka")


METHODS = (ours, by_diffrax, by_scipy, by_heyoka)


def row(
    walked: Walked,
    quantity: str,
    found: float,
    truth: float,
    *,
    relative: bool = False,
    condition: float = 1.0,
    digits: int | None = None,
    event: int = 0,
) -> Row:
    """What a walk says of one quantity, of the last event or another: also a bad condition."""
    of, says = slice(event or None), walked.says
    stated, rounding = walked.stated[of], walked.rounding[of]
    if not says and len(stated) and stated[-1] > EXACT:
        says = f"time to {stated[-1]:.0e}"
        if rounding[-1] > EXACT:
            says += f", one rounding: {rounding[-1]:.1e}"
    return Row(
        quantity, walked.method, found, truth, off(found, truth, relative=relative), says,
        walked.admits, walked.work, walked.seconds, walked.options, walked.version,
        condition, digits,
    )  # fmt: skip


def last_time(walked: Walked, events: int) -> float:
    """Time of the last of `events` events; not a number if there are fewer."""
    return float(walked.times[events - 1]) if len(walked.times) >= events else math.nan
