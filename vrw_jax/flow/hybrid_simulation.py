"""Simulation of hybrid systems, which consist of modes, guards and resets.

    ball = Mode(lambda y: jnp.stack([y[1], -9.81 + 0.0 * y[1]]), (Guard(height, bounce),))
    simulate_hybrid((ball,), start, events=10)

Functions of wrong shapes raise a ValueError. If the simulation fails, the result has a code of
`Termination` and contains all earlier events.
"""

import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

from vrw_jax import lanes
from vrw_jax.base.checks import check_callable, check_int, check_reals, check_type
from vrw_jax.base.elementwise import Scalar, make_opaque_loop_condition, select_entry_by_mask
from vrw_jax.base.options import StepOptions
from vrw_jax.base.progress import announce_wait
from vrw_jax.base.results import (
    Outcome,
    StatusCode,
    describe_step_ending,
    format_each_batch_element,
    format_heading_and_rows,
    format_numbers,
    format_outcome_counts,
    format_quantity,
)
from vrw_jax.flow.integrate import PhaseEnd
from vrw_jax.flow.phase_integration import (
    GuardsAndMargins,
    StateArray,
    VectorField,
    evaluate_rise_from_rest,
    integrate_phase,
    is_machine_code_better,
)
from vrw_jax.lanes.autodiff import forbid_reverse_mode
from vrw_jax.lanes.program import call_compiled_program

MAX_STORED_NUMBERS = 100_000_000
"""Largest product of the number of events and the dimension of the state.

The value is chosen because the times, the states before and the states after the events then occupy
2.4 GB.
"""


class Guard(NamedTuple):
    """Guard function `value`, with the reset and the next mode that follow its event.

    The function `value` of the state is positive inside its mode. The mode ends when `value` falls
    to zero. Then `reset` is applied to the state, and the mode `target_mode` begins. A guard with a
    function `armed` counts only while `armed` is positive, for example so that a foot that swings
    through the ground at mid-stance does not land there. The mode also ends if `value` is negative
    when `armed` becomes positive. A guard with `ends_walk`, such as that of a fall, ends the
    simulation at its event.
    """

    value: Callable[..., Scalar]
    reset: Callable[..., StateArray] = lambda y, *_: y
    target_mode: Any = None  # index or name of the next mode; None stands for the same mode
    armed: Callable[..., Scalar] | None = None
    ends_walk: bool = False

    def wrap_functions(self, wrap: Callable, wrap_reset: Callable) -> "Guard":
        """Return the guard with `wrap` applied to its functions, and `wrap_reset` to its reset."""
        armed = None if self.armed is None else wrap(self.armed)
        return self._replace(value=wrap(self.value), reset=wrap_reset(self.reset), armed=armed)

    def evaluate(self, *state_and_parameters: Any) -> Any:
        """Return the value that ends the mode when it falls to zero."""
        value = self.value(*state_and_parameters)
        return (
            value if self.armed is None else jnp.maximum(value, -self.armed(*state_and_parameters))
        )


class Mode(NamedTuple):
    """Autonomous vector field, from shape (dim,) to (dim,), and the guards that end the mode.

    `simulate_hybrid` accepts a single guard without a tuple. If the field depends on time, time is
    one of the coordinates of the state.
    """

    field: VectorField
    guards: Any  # Guards in a tuple; in a `HybridSystem`, a dictionary of Guards by name

    def guard_values(self, y: StateArray) -> Array:
        """Return the values of all guards at the state `y`, shape (guards,)."""
        return jnp.stack([guard.evaluate(y) for guard in self.guards])


class Termination(StatusCode):
    """Reason why a simulation ended."""

    MAX_EVENTS_REACHED = 0, "The simulation has the requested number of events."
    MAX_TIME_REACHED = 1, "No guard ended the mode within StepOptions.max_phase_time."
    ZENO = 2, "Events follow each other so fast that the time does not advance (Zeno)."
    GUARD_VIOLATED_AT_ENTRY = (
        3,
        "A mode begins with a guard below zero: check its sign, the start or reset, and `armed`.",
    )
    MAX_STEPS_REACHED = 4, "The solver steps are exhausted: raise StepOptions.max_solver_steps."
    STEP_SIZE_UNDERFLOW = (
        5,
        "The steps are too short, or an event is not located: a singular field or a noisy guard.",
    )
    SECTION_REACHED = 6, "The step is complete: it has reached the section."
    ENDED_BY_GUARD = 7, "A guard that ends the walk has fallen to zero."
    BAD_INPUT = 8, "A parameter or the start is not finite, or outside its domain."


STATUS_RUNNING_CODE = -1
"""Termination code of a simulation that has not ended. It is no member of `Termination`."""


class HybridSolution(NamedTuple):
    """Events of a simulation in chronological order, and the final state of the simulation.

    Entries after the first `n_events` events are zero.
    """

    times: Float[Array, " events"]
    time_tolerance: Float[Array, " events"]
    """Error of each event's time due to the tolerances of the state, s. It is no bound."""
    time_roundoff: Float[Array, " events"]
    """Error of each event's time due to the round-off of the state, s."""
    states_before: Float[Array, "events dim"]  # states on the guard
    states_after: Float[Array, "events dim"]  # states after the reset
    modes: Int[Array, " events"]  # indices of the modes that ended
    guards: Int[Array, " events"]  # indices of the guards that ended the modes
    n_events: Int[Array, ""]
    time: Scalar  # time of the last state
    state: StateArray  # state at the end of the simulation
    mode: Int[Array, ""]
    solver_steps: Int[Array, ""]
    termination: Int[Array, ""]  # a Termination

    @property
    def ending(self) -> Any:
        """Return a sentence on how the simulation ended; for a batch, an array of sentences."""
        return describe_step_ending(self.termination, Termination)

    def __repr__(self) -> str:
        if isinstance(self.termination, jax.core.Tracer):
            return f"HybridSolution{tuple(self)}"
        if np.ndim(self.termination):
            return f"HybridSolution ({format_outcome_counts(self.termination, Termination)})"
        rows = [
            ("events", str(self.n_events)),
            ("time", format_quantity(self.time, "s")),
            ("ending", self.ending),
        ]
        return format_heading_and_rows("HybridSolution", rows)

    def find_phases(self, start: StateArray) -> tuple[Array, Array]:
        """Return the state at the start and the duration, s, of the phase before each event.

        - `start`: state at which the simulation begins, shape (dim,).
        """
        phase_starts = jnp.concatenate([start[None], self.states_after[:-1]])
        return phase_starts, jnp.diff(self.times, prepend=0.0)


@announce_wait("the system's equations and guards", "10 s")
def simulate_hybrid(
    modes: Sequence[Mode] | Mode,
    start: ArrayLike | Sequence,
    *,
    events: int,
    mode: int = 0,
    options: StepOptions | None = None,
) -> HybridSolution:
    """Return the simulation that starts at `start` and passes through at most `events` events.

    `integrate_phase` locates the earliest event of each mode as accurately as the integrator, with
    derivatives of the event's time and state. At the start of a mode, a guard is treated as zero if
    its root is within round-off of the start time. If the guard's time derivative is also zero, the
    guard ends the mode unless its second time derivative is positive.

    The transforms `jax.jit`, `jax.jacfwd` and `jax.vmap` are supported; reverse mode is not.
    Outside of `jax.jit`, functions with equal code and equal constants share a compiled program.

    Args:
        modes: modes of the system. A single mode, and a single guard of a mode, may be passed
            without a tuple.
        start: state at the start, shape (dim,).
        events: largest number of events.
        mode: index of the first mode.
        options: options of the integration.
    """
    options = StepOptions() if options is None else options
    check_type("options", options, StepOptions, "give vrw.StepOptions()")
    start, events = check_reals("start", start), check_int("events", events)
    modes = convert_modes_to_tuple(modes)
    if start.ndim != 1 or not start.size:
        raise ValueError(f"start has shape {start.shape}, but a state is one row of numbers.")
    if not isinstance(start, jax.core.Tracer) and not np.all(np.isfinite(start)):
        raise ValueError("start contains a number that is not finite: give finite numbers.")
    if events * start.size > MAX_STORED_NUMBERS:
        raise ValueError(f"events is {events}, but so many states don't fit: give fewer.")
    if check_int("mode", mode, 0) >= len(modes):
        raise ValueError(f"mode is {mode}, but there are {len(modes)} modes: count from 0.")
    for mode_number, (_, guards) in enumerate(modes):
        if not guards:
            raise ValueError(
                f"mode {mode_number} has no guard, but only a guard can end it: give one."
            )
        for guard_number, guard in enumerate(guards):
            target_mode = mode_number if guard.target_mode is None else guard.target_mode
            if check_int("target_mode", target_mode, 0) >= len(modes):
                raise ValueError(
                    f"guard {guard_number} of mode {mode_number} leads to mode {target_mode}, but "
                    f"there are {len(modes)}: count from 0."
                )
    check_mode_functions(
        {i: mode._replace(guards=dict(enumerate(mode.guards))) for i, mode in enumerate(modes)},
        f"a state of shape {start.shape}",
        start,
    )
    options.check_tolerances(start.dtype)
    if is_machine_code_better(modes, options, events * start.size):
        solution = _simulate_modes_compiled(lambda: (modes, events, mode), options, start)
    else:
        solution = call_compiled_program(
            simulate_modes, (modes, events), options, start, jnp.asarray(mode, jnp.int32)
        )
    return forbid_reverse_mode("hybrid.simulate_hybrid", solution)


@lanes.jit
def _simulate_modes_compiled(
    get_static_arguments: Callable, options: StepOptions, start: Array
) -> HybridSolution:
    """Return the simulation of modes that a function returns, with which the code is compiled."""
    modes, events, mode = get_static_arguments()
    return simulate_modes((modes, events), options, start, jnp.asarray(mode, jnp.int32))


def convert_modes_to_tuple(modes: Sequence[Mode] | Mode) -> tuple[Mode, ...]:
    """Return the modes as a tuple, with the guards of each mode as a tuple.

    A single mode or guard may be passed without a tuple. Other types raise a TypeError.
    """
    if isinstance(modes, Mode | Guard):  # Mode and Guard are tuples themselves.
        modes = (modes,)  # type: ignore[assignment]
    check_type("modes", modes, (list, tuple), "give Modes in a list")
    modes_with_guard_tuples = []
    mode: Any
    for mode in modes:
        check_type("a mode", mode, Mode, "give Mode(field, guards)")
        guards = (mode.guards,) if isinstance(mode.guards, Guard) else mode.guards
        check_type("guards", guards, (list, tuple), "give Guards in a tuple")
        for guard in guards:
            check_type("a guard", guard, Guard, "give Guard(value, reset, target_mode)")
        modes_with_guard_tuples.append(mode._replace(guards=tuple(guards)))
    return tuple(modes_with_guard_tuples)


def check_mode_functions(
    modes: Mapping[Any, Mode], state_text: str, start: Any, *params: Any
) -> None:
    """Raise an error unless fields, guards and resets return floats of the right shapes.

    - `modes`: modes by name or index, whose guards are by name or index too;
    - `state_text`: description of the state for the error message.
    """

    def check_output(function_name: str, function: Callable, expected_shape: tuple) -> None:
        check_callable(function_name, function, "of the state")
        output: Any = jax.eval_shape(function, start, *params)
        output_shape = getattr(output, "shape", None)
        if output_shape != expected_shape or not jnp.issubdtype(output.dtype, jnp.floating):
            output_description = (
                f"{output.dtype} of shape {output_shape}"
                if output_shape is not None
                else type(output).__name__
            )
            raise ValueError(
                f"{function_name} gives {output_description} for {state_text}, but it must give "
                f"floats of shape {expected_shape}: fields and resets give the state's shape, "
                "guards one number."
            )

    for mode_name, mode in modes.items():
        check_output(f"the field of mode {mode_name!r}", mode.field, start.shape)
        for guard_name, guard in mode.guards.items():
            place = f"guard {guard_name!r} of mode {mode_name!r}"
            check_output(place, guard.value, ())
            if guard.armed is not None:
                check_output(f"armed of {place}", guard.armed, ())
            check_output(f"the reset of {place}", guard.reset, start.shape)


def _simulate_one_event(
    modes: tuple[Mode, ...],
    mode_index: int,
    options: StepOptions,
    evaluate_margins: Callable[[StateArray], Array],
    state: Array,
    time: Array,
) -> tuple[PhaseEnd, Array, Array, Array]:
    """Integrate one phase in a mode, and apply the reset at its end.

    Return the end of the phase, the index of the guard that is violated at its start, or -1, the
    next state and the next mode, which is -1 if the guard ends the walk.
    """
    mode = modes[mode_index]
    compute_guard_rates = lambda y: jax.jvp(mode.guard_values, (y,), (mode.field(y),))[1]
    guard_values = mode.guard_values(state)
    guard_rates, second_guard_rates = jax.jvp(compute_guard_rates, (state,), (mode.field(state),))
    guard_values, guard_rates, second_guard_rates = lax.stop_gradient(
        (guard_values, guard_rates, second_guard_rates)
    )
    growth = evaluate_rise_from_rest(
        mode.field,
        mode.guard_values,
        guard_values,
        guard_rates,
        *lax.stop_gradient((state, options.dt0)),
    )
    # For a guard exactly at rest the second derivative decides, also if the growth is round-off.
    will_guard_rise = (guard_values == 0.0) & (guard_rates == 0.0) & (second_guard_rates > 0.0)
    will_guard_rise |= (growth > 0.0) | lax.stop_gradient(_find_rising_ties(mode, state))
    time_after_first_step = lax.stop_gradient(time + options.dt0)
    time_resolution = 1e3 * jnp.finfo(state.dtype).eps * time_after_first_step
    is_guard_near_zero = will_guard_rise | (-guard_values <= jnp.abs(guard_rates) * time_resolution)
    are_violated = (guard_values < 0.0) & ~is_guard_near_zero
    violated_guard = jnp.where(jnp.any(are_violated), jnp.argmax(are_violated), -1)
    guard_offset = jnp.where(
        (guard_values < 0.0) & is_guard_near_zero & (guard_rates > 0.0), -guard_values, 0.0
    )
    # Round-off of its rates may make a guard fall at first that will rise.
    least_value = jnp.finfo(state.dtype).tiny + GROWTH_SHARE_AT_START * growth
    guard_offset = jnp.where(
        will_guard_rise, least_value + jnp.maximum(-guard_values, 0.0), guard_offset
    )
    n_margins = jax.eval_shape(evaluate_margins, state).size
    armed_guards = [
        (guard.value, offset, guard.armed)
        for guard, offset in zip(mode.guards, guard_offset, strict=True)
        if guard.armed is not None
    ]

    def evaluate_armed_guards(y: StateArray) -> tuple[Array, Array]:
        values = jnp.stack([value(y) + offset for value, offset, _ in armed_guards])
        disarmed = -jnp.stack([armed(y) for _, _, armed in armed_guards])
        return jnp.append(values, disarmed), jnp.append(disarmed, values)

    guards_and_margins = GuardsAndMargins(
        lambda y: jnp.append(mode.guard_values(y) + guard_offset, evaluate_margins(y)),
        len(mode.guards),
        (True,) * n_margins,
        is_zero_at_start=(guard_values <= 0.0) & is_guard_near_zero & ~will_guard_rise,
        evaluate_armed_guards=evaluate_armed_guards if armed_guards else None,
    )
    phase_end = integrate_phase(
        mode.field,
        guards_and_margins,
        state,
        violated_guard < 0,
        options,
        controls_tangents=True,
    )
    guard_index = jnp.maximum(phase_end.end_guard_index, 0)
    next_state = lax.switch(guard_index, [g.reset for g in mode.guards], phase_end.state)
    next_modes = [
        -1 if g.ends_walk else mode_index if g.target_mode is None else g.target_mode
        for g in mode.guards
    ]
    next_mode = select_entry_by_mask(guard_index, jnp.asarray(next_modes, jnp.int32))
    return phase_end, violated_guard.astype(jnp.int32), next_state, next_mode.astype(jnp.int32)


GROWTH_SHARE_AT_START = 1e-9
"""Initial value of a guard that rises from rest, as a fraction of its growth over the probe. The
value is chosen above round-off at the start, and below round-off at the next event.
"""


def _find_rising_ties(mode: Mode, state: StateArray) -> Bool[Array, " n_guards"]:
    """Return which guards are zero together with `armed`, and positive or not armed from then on.

    These do not end the mode. The value that ends it is the maximum of the guard and -`armed`, and
    rises at the larger of both rates. JAX returns the mean of both where they are equal.
    """

    def is_rising_tie(guard: Guard) -> Array:
        if guard.armed is None:
            return jnp.asarray(False)
        evaluate = lambda y: jnp.stack([guard.value(y), -guard.armed(y)])
        values, rates = jax.jvp(evaluate, (state,), (mode.field(state),))
        return jnp.all(values == 0.0) & (jnp.max(rates) > 0.0)

    return jnp.stack([is_rising_tie(guard) for guard in mode.guards])


class EventRun(NamedTuple):
    """Simulation after some events."""

    time: Scalar
    time_remainder: Scalar  # rounding error of the sum of durations, s
    state: StateArray
    mode: Int[Array, ""]
    n_events: Int[Array, ""]
    n_events_without_progress: Int[Array, ""]
    solver_steps: Int[Array, ""]
    last_guard: Int[Array, ""]  # guard that ends the walk, or was below zero at first, or -1
    termination: Int[Array, ""]  # a Termination
    log: Any


class Event(NamedTuple):
    """Event of a simulation, with the state before and after its reset."""

    time: Scalar
    duration: Scalar  # since the event before, s
    state_before: StateArray
    state_after: StateArray
    mode: Int[Array, ""]
    guard: Int[Array, ""]
    margin_minima: Float[Array, " margins"]  # since the event before


no_margins = lambda y: y[:0]


def continue_after_event(_event: Event) -> Array:
    return jnp.asarray(False)


def run_events(
    modes: tuple[Mode, ...],
    options: StepOptions,
    start: StateArray,
    first_mode: Array,
    max_events: int,
    log: Any,
    update_log: Callable[[Any, Array, Array, Event], Any],
    is_last_event: Callable[[Event], Array] = continue_after_event,
    evaluate_margins: Callable[[StateArray], Array] = no_margins,
) -> EventRun:
    """Simulate until an event is the last, until `max_events` events, or until a failure.

    - `log`, `update_log`: what is recorded; `update_log(log, n_events, has_event, event)` returns
      the log after a phase, for the number of events before its end. If the phase ends without an
      event, `has_event` is False, and the log must not change;
    - `evaluate_margins`: function that returns the margins at a state, whose minima events have.
    """
    mode_branches = [
        functools.partial(_simulate_one_event, modes, mode_index, options, evaluate_margins)
        for mode_index in range(len(modes))
    ]
    # The n - 1 guards between n bodies that meet in one point have up to n (n - 1) / 2 events.
    max_simultaneous_events = sum(len(mode.guards) ** 2 for mode in modes)

    def simulate_next_event(run: EventRun) -> EventRun:
        phase_end, violated_guard, next_state, next_mode = lax.switch(
            run.mode, mode_branches, run.state, run.time
        )
        is_guard_violated = violated_guard >= 0
        has_event = ~is_guard_violated & (phase_end.end_guard_index >= 0)
        ends_walk = has_event & (next_mode < 0)
        # D. E. Knuth's two-sum returns the rounded sum of two times and its rounding error.
        duration = phase_end.duration + run.time_remainder
        time = run.time + duration
        rounded_duration = time - run.time
        time_remainder = (run.time - (time - rounded_duration)) + (duration - rounded_duration)
        n_without_progress = jnp.where(time > run.time, 0, run.n_events_without_progress + 1)
        event = Event(
            time, phase_end.duration, phase_end.state, next_state, run.mode,
            phase_end.end_guard_index, phase_end.margin_minima,
        )  # fmt: skip
        # The first condition that holds determines the termination.
        termination = jnp.select(
            [
                has_event & (n_without_progress > max_simultaneous_events),
                ends_walk,
                has_event & is_last_event(event),
                has_event & (run.n_events + 1 >= max_events),
                has_event,
                is_guard_violated,
                phase_end.has_integration_failed
                & (phase_end.solver_steps >= options.max_solver_steps),
                phase_end.is_timed_out,
            ],
            [
                Termination.ZENO,
                Termination.ENDED_BY_GUARD,
                Termination.SECTION_REACHED,
                Termination.MAX_EVENTS_REACHED,
                STATUS_RUNNING_CODE,
                Termination.GUARD_VIOLATED_AT_ENTRY,
                Termination.MAX_STEPS_REACHED,
                Termination.MAX_TIME_REACHED,
            ],
            Termination.STEP_SIZE_UNDERFLOW,
        )
        return EventRun(
            time=time,
            time_remainder=time_remainder,
            state=jnp.where(has_event, next_state, phase_end.state),
            mode=jnp.where(has_event & ~ends_walk, next_mode, run.mode).astype(jnp.int32),
            n_events=run.n_events + has_event,
            n_events_without_progress=n_without_progress.astype(jnp.int32),
            solver_steps=run.solver_steps + phase_end.solver_steps,
            last_guard=jnp.where(ends_walk, phase_end.end_guard_index, violated_guard),
            termination=termination.astype(jnp.int32),
            log=update_log(run.log, run.n_events, has_event, event),
        )

    count, zero = jnp.zeros((), jnp.int32), 0.0 * start[0]
    first_run = EventRun(
        zero, zero, start, count + first_mode, count, count, count, count - 1,
        count + STATUS_RUNNING_CODE, log,
    )  # fmt: skip
    is_running = lambda run: make_opaque_loop_condition(
        run.termination == STATUS_RUNNING_CODE, run.n_events
    )
    return lax.while_loop(is_running, simulate_next_event, first_run)


def simulate_modes(
    modes_and_max_events: tuple[tuple[Mode, ...], int],
    options: StepOptions,
    start: Array,
    first_mode_index: Array,
    is_last_event: Callable[[Event], Array] = continue_after_event,
) -> HybridSolution:
    """Return the simulation that begins at `start` in the mode with the index `first_mode_index`.

    `modes_and_max_events` is a pair of the modes and the largest number of events.
    """
    modes, events = modes_and_max_events

    def estimate_time_errors(state: Array, mode_index: int) -> list[Array]:
        """Return errors of an event's time due to tolerance and to round-off, for all guards, s."""
        mode = modes[mode_index]
        guard_gradients = jax.jacfwd(mode.guard_values)(state)
        guard_rates = jnp.abs(guard_gradients @ mode.field(state))
        n_absent = max(len(mode.guards) for mode in modes) - len(mode.guards)
        return [
            jnp.pad(jnp.abs(guard_gradients) @ state_errors / guard_rates, (0, n_absent))
            for state_errors in (
                options.atol + options.rtol * jnp.abs(state),
                jnp.finfo(state.dtype).eps * jnp.abs(state),
            )
        ]

    def record_event(log: list, n_events: Array, has_event: Array, event: Event) -> list[Array]:
        time_errors = lax.switch(
            event.mode,
            [functools.partial(estimate_time_errors, mode_index=i) for i in range(len(modes))],
            lax.stop_gradient(event.state_before),
        )
        entries = (
            event.time,
            *(select_entry_by_mask(event.guard, x) for x in lax.stop_gradient(time_errors)),
            *event[2:6],
        )

        is_entry = has_event & (jnp.arange(events) == n_events)

        def write(record: Array, entry: Array) -> Array:
            is_written = is_entry if record.ndim == 1 else is_entry[:, None]
            return jnp.where(is_written, entry, record).astype(record.dtype)

        return list(map(write, log, entries))

    zero = 0.0 * start[0]
    times, states = jnp.zeros(events) + zero, jnp.zeros((events, start.size)) + zero
    time_errors, indices = lax.stop_gradient(times), jnp.zeros((events,), jnp.int32)
    log = [times, time_errors, time_errors, states, states, indices, indices]
    run = run_events(
        modes, options, start, first_mode_index, events, log, record_event, is_last_event
    )
    last_values = run.n_events, run.time, run.state, run.mode, run.solver_steps, run.termination
    return HybridSolution._make((*run.log, *last_values))


OUTCOME_BY_TERMINATION = np.array(
    [
        Outcome.TOO_MANY_EVENTS,
        Outcome.NO_TOUCHDOWN_IN_TIME,
        Outcome.TOO_MANY_EVENTS,
        Outcome.GUARD_VIOLATED,
        Outcome.SOLVER_FAILED,
        Outcome.SOLVER_FAILED,
        Outcome.STEPPED,
        Outcome.ENDED_BY_GUARD,
        Outcome.BAD_INPUT,
    ],
    np.int32,
)
"""Outcome of a step by the `Termination` of its simulation."""


def describe_step(termination: Termination) -> str:
    """Return why the simulation of a step ended, as one sentence."""
    if termination == Termination.MAX_EVENTS_REACHED:
        return "The step has not ended after max_events events: raise it in the system."
    return termination.meaning


class HybridStep(eqx.Module):
    """One step of a hybrid system, from section to section.

    - `section_state`: section coordinates at the end of the step; where the simulation ended early,
      those of its last state;
    - `duration`: duration of the step, s;
    - `mode_durations`: time in each mode, s, in the order of the modes;
    - `events`: number of the guard of each event, counted over the guards of all modes; -1 after
      the last event;
    - `n_events`, `solver_steps`: numbers of events and of solver steps;
    - `termination`: a `Termination`; a complete step has `Termination.SECTION_REACHED`;
    - `last_mode`, `last_guard`: numbers of the mode in which the simulation ended, and of its guard
      that was negative when the mode began, or that ended the walk; otherwise -1;
    - `guard_names`: names of the guards by the name of each mode.
    """

    section_state: Float[Array, " n"]
    duration: Scalar
    mode_durations: Float[Array, " modes"]
    events: Int[Array, " max_events"]
    n_events: Int[Array, ""]
    solver_steps: Int[Array, ""]
    termination: Int[Array, ""]
    last_mode: Int[Array, ""]
    last_guard: Int[Array, ""]
    guard_names: tuple[tuple[str, tuple[str, ...]], ...] = eqx.field(static=True)

    @property
    def durations(self) -> Any:
        """Return the durations of all modes, s."""
        return self.mode_durations

    @property
    def outcome(self) -> Any:
        """Return the `Outcome` of the step, whose codes are the same for all walkers."""
        array_module: Any = jnp if isinstance(self.termination, jax.Array) else np
        return array_module.asarray(OUTCOME_BY_TERMINATION)[self.termination]

    @property
    def is_complete(self) -> Any:
        """Return whether the step has reached the section."""
        return self.termination == Termination.SECTION_REACHED

    @property
    def ending(self) -> Any:
        """Return sentences on how the step ended; for a batch, an array of texts."""

        def describe(termination: int, mode: int, guard: int) -> str:
            ending, (mode_name, guards) = Termination(int(termination)), self.guard_names[mode]
            if ending in (Termination.SECTION_REACHED, Termination.BAD_INPUT):
                return ending.meaning
            place = f"guard {guards[guard]!r} of mode" if guard >= 0 else "mode"
            return f"{describe_step(ending)} This is {place} {mode_name!r}."

        return format_each_batch_element(
            describe, self.termination, self.last_mode, self.last_guard
        )

    def __repr__(self) -> str:
        if isinstance(self.termination, jax.core.Tracer):
            return f"HybridStep({self.section_state}, {self.duration})"
        if np.ndim(self.termination):
            return f"HybridStep of a batch ({format_outcome_counts(self.outcome, Outcome)})"
        rows = [
            ("section state", format_numbers(self.section_state)),
            ("duration", format_quantity(self.duration, "s")),
            *(
                (f"duration of {name}", format_quantity(duration, "s"))
                for (name, _), duration in zip(self.guard_names, self.mode_durations, strict=True)
            ),
            ("ending", self.ending),
        ]
        return format_heading_and_rows("HybridStep", rows)
