"""Simulation of hybrid systems: any vector fields, the guards that end modes, and the resets.

    ball = Mode(lambda y: jnp.stack([y[1], -9.81 + 0.0 * y[1]]), (Guard(height, bounce),))
    simulate_hybrid((ball,), start, events=10)

A mode with wrong shapes raises an error of one sentence. A failure during the simulation is one
code, `Termination`, and the result keeps all events before it.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int

from vrw_jax.numerics.codes import Code
from vrw_jax.numerics.events import Field, PhaseEnd, integrate_phase
from vrw_jax.numerics.lanes import two_fold
from vrw_jax.numerics.minima import State, Watched
from vrw_jax.numerics.options import Options
from vrw_jax.numerics.types import Scalar
from vrw_jax.wording import function_of, instance, reals, whole

MOST_NUMBERS = 100_000_000
"""Most numbers stored in all events of a simulation, chosen because times, states before and states
after then take 2.4 GB."""


class Guard(NamedTuple):
    """A function that ends its mode where `value`, positive inside, falls to zero.

    Then `reset` is applied, and `target_mode` follows.
    """

    value: Callable[[State], Scalar]
    reset: Callable[[State], State] = lambda y: y
    to: int | None = None  # index of the next mode; None: the same mode


class Mode(NamedTuple):
    """An autonomous vector field, shape (dim,) to (dim,), and its guards; time is a coordinate if
    needed.
    """

    field: Field
    guards: tuple[Guard, ...]

    def values(self, y: State) -> Array:
        """Return the values of all guards at a state."""
        return jnp.stack([guard.value(y) for guard in self.guards])


class Stop(Code):
    """Reason why a simulation ended."""

    EVENTS_DONE = 0, "It has as many events as were asked for."
    TIME_OVER = 1, "No guard ended the mode within Options.max_phase_time."
    EVENTS_PILE_UP = 2, "Events follow each other so fast that the clock no longer moves (Zeno)."
    GUARD_PAST = 3, "A mode begins with a guard below zero: begin on it or inside, or elsewhere."
    STEPS_SPENT = 4, "The solver's steps are spent: raise Options.max_solver_steps."
    STUCK = 5, "Steps too short, or no event settled: a singular field or a guard lost in rounding."


class Walk(NamedTuple):
    """Events of a simulation in order of time; rows past `n_events` are zero."""

    times: Float[Array, " events"]
    resolution: Float[Array, " events"]  # the state's tolerances as an error of each time, no bound
    rounding: Float[Array, " events"]  # the state's round-off as an error of each time
    before: Float[Array, "events dim"]  # states on the guard
    after: Float[Array, "events dim"]  # states after the reset
    modes: Int[Array, " events"]  # modes that ended
    guards: Int[Array, " events"]  # guards that ended them
    n_events: Int[Array, ""]
    time: Scalar  # of the last state
    state: State  # at the end of the simulation
    mode: Int[Array, ""]
    solver_steps: Int[Array, ""]
    stop: Int[Array, ""]  # a Termination


def walk(
    modes: Sequence[Mode],
    start: ArrayLike | Sequence,
    *,
    events: int,
    mode: int = 0,
    options: Options | None = None,
) -> Walk:
    """Simulate `modes` from `start` through at most `events` events.

    Guards are treated as in `integrate_phase`: the earliest first, at the integrator's accuracy,
    with derivatives of event times and states. A guard within the clock's round-off of zero at the
    start of its mode counts as zero. A guard that is zero at rest there fires only if it will not
    rise. Transforms (`jax.jit`, `jax.jacfwd`, `jax.vmap`) apply.
    """
    options = Options() if options is None else options
    instance("options", options, Options, "give vrw.Options()")
    start, events = reals("start", start), whole("events", events)
    _require(modes, start, events, mode)
    options.require_reachable(start.dtype)
    return _walk(tuple(modes), events, options, start, mode)


LOOSER = (0.1, 0.01)
"""Factors by which the tolerances are divided in the simulations that `estimate_event_time_errors`
compares with."""


def time_errors(
    modes: Sequence[Mode], start: ArrayLike | Sequence, told: Walk, options: Options | None = None
) -> Float[Array, " events"]:
    """Return estimated errors of the event times, s, from simulations at two looser tolerances.

    The same events are computed again with tolerances ten and a hundred times as large. Each error
    is twice the largest change of any event so far, in units of its `time_tolerance`, and at least
    twice its `time_tolerance`. It includes what `time_tolerance` alone omits: accumulated errors of
    steps and errors that earlier events transfer to later ones. It also includes the part that an
    implicit solver's own estimate omits in a stiff field. It is infinite from the first event that
    the simulation at ten times the tolerance does not reach. The estimate is measured, not proved;
    `options` are those of the simulation.
    """
    options = Options() if options is None else options
    start, told = lax.stop_gradient((reals("start", start), told))
    count = jnp.arange(len(told.times))

    def moved(factor: Array) -> Array:
        other = _walk(tuple(modes), len(count), options.tightened(factor), start, told.modes[0])
        same = (other.guards == told.guards) & (other.modes == told.modes)
        same = jnp.cumprod(same & (count < other.n_events)) > 0
        return jnp.where(same, jnp.abs(other.times - told.times), jnp.inf)

    ten, hundred = lax.stop_gradient(lax.map(moved, jnp.asarray(LOOSER, start.dtype)))
    most = jnp.maximum(ten, jnp.where(jnp.isinf(hundred), 0.0, hundred)) / told.resolution
    most = lax.cummax(jnp.where(jnp.isnan(most), jnp.inf, jnp.maximum(most, 1.0)))
    return jnp.where(count < told.n_events, 2.0 * most * told.resolution, 0.0)


def _require(modes: Sequence[Mode], start: Array, events: int, mode: int) -> None:
    if start.ndim != 1 or not start.size:
        raise ValueError(f"start has shape {start.shape}, but a state is one row of numbers.")
    if not isinstance(start, jax.core.Tracer) and not np.all(np.isfinite(start)):
        raise ValueError("start holds a number that is not finite.")
    if events * start.size > MOST_NUMBERS:
        raise ValueError(f"events is {events}, but so many states don't fit: ask for fewer.")
    instance("modes", modes, (list, tuple), "give Modes in a list")
    for one in modes:
        instance("a mode", one, Mode, "give Mode(field, guards)")
        instance("guards", one.guards, (list, tuple), "give Guards in a tuple")
        for guard in one.guards:
            instance("a guard", guard, Guard, "give Guard(value, reset, to)")
    if not 0 <= mode < len(modes):
        raise ValueError(f"mode is {mode}, but there are {len(modes)} modes: count from 0.")
    for i, (field, guards) in enumerate(modes):
        if not guards:
            raise ValueError(f"mode {i} has no guard, but only a guard can end it: give one.")
        _require_shape(f"the field of mode {i}", field, start, start.shape)
        for k, guard in enumerate(guards):
            name = f"guard {k} of mode {i}"
            _require_shape(name, guard.value, start, ())
            _require_shape(f"the reset of {name}", guard.reset, start, start.shape)
            if guard.to is not None and not 0 <= guard.to < len(modes):
                raise ValueError(
                    f"{name} leads to mode {guard.to}, but there are {len(modes)}: count from 0."
                )


def _require_shape(name: str, function: Callable, start: Array, shape: tuple) -> None:
    function_of(name, function, "of the state")
    told: Any = jax.eval_shape(function, start)
    found = getattr(told, "shape", None)
    if found != shape or not jnp.issubdtype(told.dtype, jnp.floating):
        what = f"{told.dtype} of shape {found}" if found is not None else type(told).__name__
        raise ValueError(
            f"{name} gives {what} for a state of shape {start.shape}, but it must give floats of "
            f"shape {shape}: fields and resets give the state's shape, guards one number."
        )


def _entered(mode: Mode, state: Array, time: Array, options: Options) -> tuple[PhaseEnd, Array]:
    """Integrate a mode, and return its end and whether a guard is violated at its start."""
    rate = lambda y: jax.jvp(mode.values, (y,), (mode.field(y),))[1]
    first, (rates, bends) = mode.values(state), jax.jvp(rate, (state,), (mode.field(state),))
    first, rates, bends = lax.stop_gradient((first, rates, bends))
    clock = lax.stop_gradient(time + options.first_step)
    resolution = 1e3 * jnp.finfo(state.dtype).eps * clock
    near = -first <= jnp.abs(rates) * resolution
    past = jnp.any((first < 0.0) & ~near)
    lift = jnp.where((first < 0.0) & near & (rates > 0.0), -first, 0.0)
    # For a guard at rest the second derivative decides: it does not fire if it will rise.
    rises = (first == 0.0) & (rates == 0.0) & (bends > 0.0)
    lift = jnp.where(rises, jnp.finfo(state.dtype).tiny, lift)
    watched = Watched(lambda y: mode.values(y) + lift, len(mode.guards))
    return integrate_phase(mode.field, watched, state, ~past, options), past


def _in_time(mode: Mode, end: PhaseEnd, options: Options) -> tuple[Array, Array]:
    """Return tolerance and round-off of the state as times of the event, large where a guard is
    grazed.
    """
    state = lax.stop_gradient(end.state)
    across = jax.jacfwd(mode.values)(state)[jnp.maximum(end.guard, 0)]
    rounding = jnp.finfo(state.dtype).eps * jnp.abs(state)
    tolerance = options.atol + options.rtol * jnp.abs(state)
    rate = jnp.abs(across @ mode.field(state))
    told = [jnp.abs(across) @ error / rate for error in (tolerance, rounding)]
    return lax.stop_gradient((told[0], told[1]))


def _left(mode: Mode, guard: Array, state: Array, own: int) -> tuple[Array, Array]:
    """Return the state after the reset of the guard that ended the mode, and the next mode."""
    index = jnp.maximum(guard, 0)
    after = lax.switch(index, [g.reset for g in mode.guards], state)
    return after, jnp.asarray([own if g.to is None else g.to for g in mode.guards], jnp.int32)[
        index
    ]


def _walk(
    modes: tuple[Mode, ...], events: int, options: Options, start: Array, mode: int | Array
) -> Walk:
    def visit(own: int) -> Callable:
        def visited(state: Array, time: Array) -> tuple:
            end, past = _entered(modes[own], state, time, options)
            seen = _in_time(modes[own], end, options)
            return end, past, seen, *_left(modes[own], end.guard, end.state, own)

        return visited

    visits = [visit(own) for own in range(len(modes))]

    def event(carry: tuple) -> tuple:
        walked, still = carry
        end, past, seen, after, following = lax.switch(
            walked.mode, visits, walked.state, walked.time
        )
        happened = ~past & (end.guard >= 0)
        time = walked.time + end.duration
        still = jnp.where(time > walked.time, 0, still + 1)
        spent = end.solver_steps >= options.max_solver_steps
        stop = jnp.where(walked.n_events + 1 >= events, int(Stop.EVENTS_DONE), _GOING)
        stop = jnp.where(still > len(modes), int(Stop.EVENTS_PILE_UP), stop)
        unended = jnp.where(end.timed_out, int(Stop.TIME_OVER), int(Stop.STUCK))
        unended = jnp.where(end.gave_up & spent, int(Stop.STEPS_SPENT), unended)
        stop = jnp.where(happened, stop, jnp.where(past, int(Stop.GUARD_PAST), unended))
        place = jnp.where(happened, walked.n_events, events)
        put = lambda row, value: row.at[place].set(value, mode="drop")
        return (
            Walk(
                times=put(walked.times, time),
                resolution=put(walked.resolution, seen[0]),
                rounding=put(walked.rounding, seen[1]),
                before=put(walked.before, end.state),
                after=put(walked.after, after),
                modes=put(walked.modes, walked.mode),
                guards=put(walked.guards, end.guard),
                n_events=walked.n_events + happened,
                time=time,
                state=jnp.where(happened, after, end.state),
                mode=jnp.where(happened, following, walked.mode).astype(jnp.int32),
                solver_steps=walked.solver_steps + end.solver_steps,
                stop=stop.astype(jnp.int32),
            ),
            still,
        )

    none, zero = jnp.zeros((), jnp.int32), 0.0 * start[0]
    rows, places = jnp.zeros((events, start.size)) + zero, jnp.zeros((events,), jnp.int32)
    none_yet = jnp.zeros(events) + zero
    still = lax.stop_gradient(none_yet)
    first = Walk(
        times=none_yet, resolution=still, rounding=still, before=rows, after=rows,
        modes=places, guards=places, n_events=none, time=zero, state=start, mode=none + mode,
        solver_steps=none, stop=none + _GOING,
    )  # fmt: skip
    going = lambda carry: two_fold(carry[0].stop == _GOING, carry[0].n_events)
    return lax.while_loop(going, event, (first, none))[0]


_GOING = -1
