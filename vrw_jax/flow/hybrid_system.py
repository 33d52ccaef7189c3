"""Walkers and other hybrid systems of named modes, whose functions take parameters.

A `HybridSystem` is compiled for one element and for batches of thousands, and is differentiable in
every mode. Its functions are called with a state and with parameters, so that other values of the
parameters compile nothing anew.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from vrw_jax import lanes
from vrw_jax.base.checks import (
    check_callable,
    check_int,
    check_type,
    require_known_name,
)
from vrw_jax.base.elementwise import Scalar
from vrw_jax.base.options import StepOptions, is_tree_in_domain
from vrw_jax.base.results import Measure, Outcome
from vrw_jax.base.results import xarray as xr
from vrw_jax.base.walker import (
    AbstractWalker,
    AdvanceResult,
    check_arguments,
    check_measure_names,
    compile_step,
    find_batch_axes,
    make_return_map,
    step_batch_of_walker,
)
from vrw_jax.flow.hybrid_simulation import (
    OUTCOME_BY_TERMINATION,
    Event,
    EventRun,
    Guard,
    HybridSolution,
    HybridStep,
    Mode,
    Termination,
    check_mode_functions,
    continue_after_event,
    describe_step,
    no_margins,
    run_events,
    simulate_modes,
)
from vrw_jax.flow.phase_integration import StateArray, sample_phase

MAX_EVENTS_PER_STEP = 16
"""Default limit of the events in one step, chosen above those of walkers with several legs."""


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class HybridSystem(AbstractWalker):
    """A walker, or another hybrid system, defined by its modes, guards and resets.

    Use it for your own legs and walkers: one step in a batch of thousands takes microseconds, and
    derivatives go through events. All functions take the state `y`, shape (dim,), and the
    parameters, which are any tree of numbers and arrays: a field returns the time derivative of the
    state, a guard one number, and a reset the next state.

    - `modes`: a `Mode(field, guards)` for each name. The guards of a mode are a dictionary, and the
      `target_mode` of a `Guard` is the name of a mode;
    - `section`: name of the guard whose event ends a step, in any mode;
    - `state`: names of the coordinates of the state, or their units by name;
    - `project`, `embed`: functions from state and parameters to section coordinates and back,
      `project(y, params)` after the reset of the section's event, and `embed(x, params)`. By
      default, the section coordinates are the whole state;
    - `invariants`: functions of state and parameters that a step conserves, such as the energy;
    - `coordinates`: units of the section coordinates by name, such as {"angle": "rad"};
    - `starts`: function of the parameters that returns section coordinates, one row for each start,
      from which the search for a gait begins if no guess is given;
    - `measures`: measures of its gaits, see `vrw.measure`;
    - `ground`: `{"height": name}` names the parameter that is the rise from the foothold of a step
      to the next one, `{"slope": name}` the slope of a step;
    - `max_events`: largest number of events in one step.

    Examples:
        >>> fall = lambda y, p: jnp.stack([y[1], -p["gravity"] + 0.0 * y[1]])
        >>> bounce = lambda y, p: jnp.stack([0.0 * y[0], -p["restitution"] * y[1]])
        >>> impact = vrw.hybrid.Guard(lambda y, p: y[0], bounce)
        >>> ball = vrw.HybridSystem(
        ...     modes={"flight": vrw.hybrid.Mode(fall, {"impact": impact})},
        ...     section="impact",
        ...     state=("height", "velocity"),
        ...     project=lambda y, p: y[1:],
        ...     embed=lambda x, p: jnp.stack([0.0 * x[0], x[0]]),
        ... )
        >>> params = {"gravity": 9.81, "restitution": 0.5}
        >>> print(f"{ball.step(params, [2.0]).section_state[0]:.3f}")
        1.000
    """

    modes: Mapping[str, Mode]
    section: str
    state: Sequence[str] | Mapping[str, str]
    project: Callable[[StateArray, Any], Array] = lambda y, params: y
    embed: Callable[[Array, Any], StateArray] = lambda x, params: x
    invariants: Sequence[Callable[[StateArray, Any], Scalar]] = ()
    coordinates: Mapping[str, str] = dataclasses.field(default_factory=dict)
    starts: Callable[[Any], Any] | None = None
    measures: Sequence[Measure] = ()
    ground: Mapping[str, str] = dataclasses.field(default_factory=dict)
    max_events: int = MAX_EVENTS_PER_STEP

    can_start_within_gait_step: ClassVar[bool] = True

    def __post_init__(self) -> None:
        check_type("modes", self.modes, Mapping, "give a dictionary of Modes by name")
        check_int("max_events", self.max_events)
        if not self.state or not all(isinstance(name, str) for name in self.state):
            raise ValueError(
                f"state is {self.state}, but it names each coordinate: give a tuple of names."
            )
        for mode_name, mode in self.modes.items():
            check_type(f"mode {mode_name!r}", mode, Mode, "give Mode(field, guards)")
            check_callable(f"the field of {mode_name!r}", mode.field, "of state and parameters")
            check_type(
                f"guards of {mode_name!r}",
                mode.guards,
                Mapping,
                "give a dictionary of Guards by name",
            )
            if not mode.guards:
                raise ValueError(
                    f"mode {mode_name!r} has no guard, but only a guard can end it: give one."
                )
            for guard_name, guard in mode.guards.items():
                check_type(
                    f"guard {guard_name!r}", guard, Guard, "give Guard(value, reset, target_mode)"
                )
                if guard.target_mode is not None:
                    require_known_name(guard.target_mode, tuple(self.modes), "mode")
        require_known_name(self.section, tuple(self.guard_names), "guard")
        check_type("invariants", self.invariants, Sequence, "give a tuple of functions")
        for invariant in self.invariants:
            check_callable("an invariant", invariant, "of state and parameters")
        for name in self.ground:
            require_known_name(name, ("height", "slope"), "property of the ground")
        for measure in self.measures:
            check_type("a measure", measure, Measure, "decorate its function with vrw.measure")
            self.find_modes(measure)
        check_measure_names(self, ())
        if any(
            guard.ends_walk
            for mode in self.modes.values()
            for name, guard in mode.guards.items()
            if name == self.section
        ):
            raise ValueError(
                f"the guard {self.section!r} has ends_walk, but it is the section, from which the "
                "next step begins: give the guard of a fall another name."
            )
        if len(self._start_modes) > 1:
            raise ValueError(
                f"{self.section!r} leads to the modes {sorted(self._start_modes)}, but each step "
                "begins in one mode: give the other guards another name, or let the section lead "
                "to a mode whose guards, with `armed`, lead on to these modes at once."
            )

    def evaluate_invariants(self, params: Any, x: Array) -> Array:
        y = self.embed(x, params)
        return jnp.stack([invariant(y, params) for invariant in self.invariants])

    def __repr__(self) -> str:
        modes = ", ".join(f"{name}: {'/'.join(mode.guards)}" for name, mode in self.modes.items())
        return f"HybridSystem({modes}; section {self.section!r})"

    def measure_step(
        self,
        params: Any,
        x: Array,
        step: HybridStep,
        options: StepOptions,
        measures: Sequence[Measure] | None = None,
    ) -> dict[str, Array]:
        measures = self.measures if measures is None else measures
        of_modes = tuple(measure for measure in measures if measure.phases)
        values = {m.name: jnp.asarray(m(step, params)) for m in measures if not m.phases}
        return values | (
            _compile_mode_measures(self, of_modes)(params, x, options) if of_modes else {}
        )

    @property
    def guard_names(self) -> tuple[str, ...]:
        """Return the names of the guards of all modes, in the order of `HybridStep.events`."""
        return tuple(name for mode in self.modes.values() for name in mode.guards)

    @property
    def state_units(self) -> dict[str, str]:
        """Return the units of the coordinates of the state by name, if they are given."""
        return dict(self.state) if isinstance(self.state, Mapping) else {}

    @property
    def _start_modes(self) -> set[str]:
        return {
            str(guard.target_mode or mode_name)
            for mode_name, mode in self.modes.items()
            for name, guard in mode.guards.items()
            if name == self.section
        }

    def _find_mode(self, mode_name: str | None) -> int:
        """Return the index of a mode, by default of that in which a step begins."""
        names = tuple(self.modes)
        if mode_name is None:
            return names.index(next(iter(self._start_modes)))
        require_known_name(mode_name, names, "mode")
        return names.index(mode_name)

    def find_modes(self, measure: Measure) -> np.ndarray:
        """Return the indices of the modes in which a measure is taken, or raise an error."""
        return np.array([self._find_mode(name) for name in measure.phases], np.int32)

    def is_inside_mode(self, params: Any, y: StateArray, mode_index: Array) -> Any:
        """Return whether all guards of a mode are zero or positive at a state."""
        guard_values = [mode.guard_values for mode in self._bind_modes(params)]
        are_inside = [lambda y, f=f: jnp.all(f(y) >= 0.0) for f in guard_values]
        return lax.switch(mode_index, are_inside, y)

    def _bind_modes(self, params: Any) -> tuple[Mode, ...]:
        """Return the modes by index, with functions of the state alone."""
        bind = lambda function: lambda y: function(y, params)
        return tuple(
            Mode(
                bind(mode.field),
                tuple(
                    guard.wrap_functions(bind, bind)._replace(
                        target_mode=None
                        if guard.target_mode is None
                        else self._find_mode(guard.target_mode)
                    )
                    for guard in mode.guards.values()
                ),
            )
            for mode in self.modes.values()
        )

    def _run_step(
        self,
        params: Any,
        start: StateArray,
        mode_index: Array,
        options: StepOptions,
        log: Any,
        update_log: Callable,
        evaluate_margins: Callable[[StateArray], Array] = no_margins,
    ) -> EventRun:
        """Simulate until the end of a step, and record its events in a log."""
        return run_events(
            self._bind_modes(params),
            options,
            start,
            mode_index,
            self.max_events,
            log,
            update_log,
            self.reaches_section,
            evaluate_margins,
        )

    def reaches_section(self, event: Event) -> Array:
        """Return whether an event ends a step."""
        section_guards = [
            (event.mode == mode_index) & (event.guard == guard_index)
            for mode_index, mode in enumerate(self.modes.values())
            for guard_index, name in enumerate(mode.guards)
            if name == self.section
        ]
        return jnp.any(jnp.stack(section_guards))

    def take_step(self, params: Any, x: Array, options: StepOptions) -> HybridStep:
        """Return one step of one element; `compile_step` compiles this function."""
        mode_index = jnp.asarray(self._find_mode(None), jnp.int32)
        step = self.finish_step(params, self.embed(x, params), mode_index, options)
        return dataclasses.replace(step, termination=_check_input(params, x, step.termination))

    def finish_step(
        self, params: Any, start: StateArray, mode_index: Array, options: StepOptions
    ) -> HybridStep:
        """Return the rest of a step that is in a mode, from a state of one element."""
        n_guards, n_modes = [len(mode.guards) for mode in self.modes.values()], len(self.modes)
        first_guards = np.cumsum([0, *n_guards])[:-1]

        def log_event(log: Any, n_events: Array, has_event: Array, event: Event) -> tuple:
            mode_durations, events = log
            is_mode = has_event & (jnp.arange(n_modes) == event.mode)
            guard = event.guard + sum(
                jnp.where(event.mode == i, int(first), 0) for i, first in enumerate(first_guards)
            )
            is_entry = has_event & (jnp.arange(self.max_events) == n_events)
            return (
                mode_durations + jnp.where(is_mode, event.duration, 0.0),
                jnp.where(is_entry, guard, events).astype(jnp.int32),
            )

        log = jnp.zeros(n_modes) + 0.0 * start[0], jnp.full(self.max_events, -1, jnp.int32)
        run = self._run_step(params, start, mode_index, options, log, log_event)
        mode_durations, events = run.log
        return HybridStep(
            self.project(run.state, params),
            run.time,
            mode_durations,
            events,
            run.n_events,
            run.solver_steps,
            run.termination,
            run.mode,
            run.last_guard,
            tuple((name, tuple(mode.guards)) for name, mode in self.modes.items()),
        )

    def sample_motion(
        self, params: Any, x: Array, options: StepOptions, n_samples: int
    ) -> tuple[dict[str, Array], Array]:
        """Return the state, and the measures of modes, at times between the events of a step.

        A measure is zero outside its mode. The phases are the intervals between events, of which
        there are `max_events`; those after the step have the duration zero.
        """
        return _compile_sampling(self, n_samples)(params, x, options)

    def _sample_motion(
        self, n_samples: int, params: Any, x: Array, options: StepOptions
    ) -> tuple[dict[str, Array], Array]:
        def log_event(log: Any, n_events: Array, has_event: Array, event: Event) -> tuple:
            is_entry = has_event & (jnp.arange(self.max_events) == n_events)
            states, durations, modes = log
            return (
                jnp.where(is_entry[:, None], event.state_after, states),
                jnp.where(is_entry, event.duration, durations),
                jnp.where(is_entry, event.mode, modes),
            )

        start, mode_index = self.embed(x, params), jnp.asarray(self._find_mode(None), jnp.int32)
        log = (
            jnp.zeros((self.max_events, len(start))) + start,
            jnp.zeros(self.max_events) + 0.0 * start[0],
            jnp.zeros(self.max_events, jnp.int32),
        )
        run = self._run_step(params, start, mode_index, options, log, log_event)
        states, durations, modes = run.log
        starts = jnp.concatenate([start[None], states[:-1]])
        samplers = [
            lambda state, duration, field=mode.field: sample_phase(
                field, state, duration, n_samples, options, controls_tangents=True
            )
            for mode in self._bind_modes(params)
        ]
        samples = lax.map(
            lambda interval: lax.switch(interval[0], samplers, *interval[1:]),
            (modes, starts, durations),
        )
        columns = {name: samples[..., i] for i, name in enumerate(self.state)}
        for measure in self.measures:
            if measure.phases:
                evaluate = lambda y, measure=measure: measure(y, params)
                is_mode = jnp.isin(modes, self.find_modes(measure))
                values = jax.vmap(jax.vmap(evaluate))(samples)
                columns[measure.name] = jnp.where(is_mode[:, None], values, 0.0)
        return columns, durations

    def step(self, params: Any, x: Any, options: StepOptions | None = None) -> HybridStep:
        """Return the step that begins at section coordinates `x`, shape (n,).

        `jax.jit`, `vmap`, `grad`, `jacfwd`, `jacrev` and `hessian` apply to it.

        Args:
            params: parameters, a tree of numbers and arrays.
            x: section coordinates at the start, shape (n,).
            options: options of the integration.

        Returns:
            A `HybridStep`. A step that fails has a code of `Termination`.

        Raises:
            TypeError, ValueError: if an argument is invalid, or a function returns a wrong shape.
        """
        return compile_step(self)(*check_arguments(self, params, x, options, 1))

    def step_batch(self, params: Any, x: Any, options: StepOptions | None = None) -> HybridStep:
        """Return one step of each element of a batch, as NumPy arrays, computed on all cores.

        The result of an element is bitwise the same in any batch.

        Args:
            params: parameters. A number is the same for all elements, and an array has the batch on
                its first axis.
            x: section coordinates, shape (batch, n), or (n,) for all elements.
            options: options of the integration.

        Returns:
            A `HybridStep` whose arrays have the batch on their first axis.

        Raises:
            TypeError, ValueError: as for `step`, or if batches have different lengths.
        """
        return step_batch_of_walker(self, params, x, options)

    def advance(self, params: Any, x: Array, options: StepOptions) -> AdvanceResult:
        """Return the end of one step of one element."""
        step = compile_step(self)(params, x, options)
        return AdvanceResult(
            step.section_state, step.mode_durations, step.outcome, step.solver_steps
        )

    def simulate(
        self,
        params: Any,
        start: Any,
        *,
        events: int,
        mode: str | None = None,
        options: StepOptions | None = None,
    ) -> HybridSolution:
        """Return the simulation that passes through at most `events` events.

        Args:
            params: parameters, a tree of numbers and arrays.
            start: state at the start, shape (dim,).
            events: largest number of events.
            mode: name of the first mode, by default that in which a step begins.
            options: options of the integration.

        Returns:
            A `HybridSolution`. Its modes are counted in the order of `modes`, and the guards in the
            order of those of their mode.

        Raises:
            TypeError, ValueError: if an argument is invalid, or a function returns a wrong shape.
        """
        params, start, options = check_arguments(self, params, start, options, 1, "start")
        simulate = compile_simulation(self, check_int("events", events), self._find_mode(mode))
        return simulate(params, start, options)

    def simulate_batch(
        self,
        params: Any,
        start: Any,
        *,
        events: int,
        mode: str | None = None,
        options: StepOptions | None = None,
    ) -> HybridSolution:
        """Return the simulations of a batch, as NumPy arrays, computed on all cores.

        The arguments are those of `simulate`. Parameters that are arrays have the batch on their
        first axis, and `start` has the shape (batch, dim), or (dim,) for all elements.
        """
        params, start, options = check_arguments(self, params, start, options, 2, "start")
        simulate = compile_simulation(self, check_int("events", events), self._find_mode(mode))
        return simulate.batch(params, start, options, in_axes=find_batch_axes(params, start))

    def return_map(
        self, params: Any, options: StepOptions | None = None
    ) -> Callable[[Float[Array, " n"]], Float[Array, " n"]]:
        """Return the map from section coordinates to those after one step, for Newton's method.

        The map returns NaN if the step fails, so that its last state is not taken for a return.
        """
        return make_return_map(self, params, StepOptions() if options is None else options)

    def check_definition(self, params: Any, x: Any, name: str) -> None:
        start = jax.eval_shape(self.embed, x, params) if name == "x" else x
        if getattr(start, "shape", None) != (len(self.state),):
            raise ValueError(
                f"{'embed' if name == 'x' else name} gives "
                f"{getattr(start, 'shape', type(start).__name__)}, but the coordinates of the "
                f"state are {self.state}: give an array of shape {(len(self.state),)}."
            )
        if name == "x":
            projected: Any = jax.eval_shape(self.project, start, params)
            if getattr(projected, "shape", None) != x.shape:
                raise ValueError(
                    f"x has {x.size} entries, but project returns "
                    f"{getattr(projected, 'shape', projected)}: give one entry for each section "
                    "coordinate, or mend project."
                )
        check_mode_functions(self.modes, f"the state {self.state}", start, params)


@functools.lru_cache
def _append_integrals(system: HybridSystem, measures: tuple[Measure, ...]) -> HybridSystem:
    """Return the system whose state also contains the integrals of measures over their modes.

    The solver steps then control the errors of the integrals as those of the state.
    """
    n = len(system.state)

    def append_rates(mode_name: str, field: Any) -> Callable:
        def evaluate(y: Array, params: Any) -> Array:
            rates = [
                measure(y[:n], params) if mode_name in measure.phases else 0.0 * y[0]
                for measure in measures
            ]
            return jnp.concatenate([field(y[:n], params), jnp.stack(rates)])

        return evaluate

    drop_integrals = lambda function: lambda y, params: function(y[:n], params)
    keep_integrals = lambda reset: lambda y, params: jnp.concatenate([reset(y[:n], params), y[n:]])
    return HybridSystem(
        modes={
            name: Mode(
                append_rates(name, mode.field),
                {
                    guard_name: guard.wrap_functions(drop_integrals, keep_integrals)
                    for guard_name, guard in mode.guards.items()
                },
            )
            for name, mode in system.modes.items()
        },
        section=system.section,
        state=(*system.state, *(measure.name for measure in measures)),
        embed=lambda x, params: jnp.concatenate(
            [system.embed(x, params), jnp.zeros(len(measures)) + 0.0 * x[0]]
        ),
        max_events=system.max_events,
    )


@functools.lru_cache
def _compile_mode_measures(system: HybridSystem, measures: tuple[Measure, ...]) -> Any:
    """Return the compiled function of the measures of modes in a step, by name."""
    extrema = tuple(m for m in measures if m.reduction in ("min", "max"))
    integrals = tuple(m for m in measures if m not in extrema)
    extended = _append_integrals(system, integrals) if integrals else system
    n, names = len(system.state), tuple(system.modes)
    signs = np.array([1.0 if m.reduction == "min" else -1.0 for m in extrema])
    is_measured = np.array([[name in m.phases for m in extrema] for name in names], bool)

    def measure_modes(params: Any, x: Array, options: StepOptions) -> dict[str, Array]:
        evaluate_extrema = lambda y: jnp.stack(
            [sign * m(y[:n], params) for sign, m in zip(signs, extrema, strict=True)]
        )

        def log_event(log: Any, n_events: Array, has_event: Array, event: Event) -> tuple:
            durations, minima = log
            is_mode = has_event & (jnp.arange(len(names)) == event.mode)
            is_entry = jnp.any(is_mode[:, None] & is_measured, 0) & (event.duration > 0.0)
            return (
                durations + jnp.where(is_mode, event.duration, 0.0),
                jnp.where(is_entry, jnp.minimum(minima, event.margin_minima), minima),
            )

        start, mode_index = extended.embed(x, params), jnp.asarray(system._find_mode(None))
        zero = 0.0 * start[0]
        log = jnp.zeros(len(names)) + zero, jnp.full(len(extrema), jnp.inf) + zero
        run = extended._run_step(
            params,
            start,
            mode_index.astype(jnp.int32),
            options,
            log,
            log_event,
            evaluate_extrema if extrema else no_margins,
        )
        durations, minima = run.log
        values = {}
        for m, integral in zip(integrals, run.state[n:], strict=True):
            duration = jnp.sum(durations[system.find_modes(m)])
            divisor = jnp.where(duration > 0.0, duration, 1.0)
            values[m.name] = integral / divisor if m.reduction == "mean" else integral
        minima = jnp.where(jnp.isfinite(minima), signs * minima, 0.0)
        return values | {m.name: minimum for m, minimum in zip(extrema, minima, strict=True)}

    return lanes.jit(measure_modes)


@functools.lru_cache
def compile_finish(system: HybridSystem) -> Any:
    """Return the compiled rest of a step, from a state in any mode."""
    return lanes.jit(system.finish_step)


@functools.lru_cache
def _compile_sampling(system: HybridSystem, n_samples: int) -> Any:
    return lanes.jit(functools.partial(system._sample_motion, n_samples))


@functools.lru_cache
def compile_simulation(
    system: HybridSystem, events: int | None = None, mode: int | None = None
) -> Any:
    """Return the compiled simulation of at most `events` events, by default of one step."""
    first_mode = system._find_mode(None) if mode is None else mode
    ends_at_event = system.reaches_section if events is None else continue_after_event

    def simulate(params: Any, start: Array, options: StepOptions) -> HybridSolution:
        modes = system._bind_modes(params), events or system.max_events
        solution = simulate_modes(
            modes, options, start, jnp.asarray(first_mode, jnp.int32), ends_at_event
        )
        return solution._replace(termination=_check_input(params, start, solution.termination))

    return lanes.jit(simulate)


def _check_input(params: Any, start: Array, termination: Array) -> Array:
    """Return the reason why a simulation ended, or BAD_INPUT for parameters out of domain or a
    start that is not finite.
    """
    is_valid = is_tree_in_domain(params) & jnp.all(jnp.isfinite(start))
    return jnp.where(is_valid, termination, jnp.asarray(Termination.BAD_INPUT, termination.dtype))


def sample_walk_of_system(
    system: HybridSystem,
    params_of_steps: Sequence[Any],
    x: Any,
    options: StepOptions,
    n_samples: int,
) -> xr.Dataset:
    """Return the states of a walk at `n_samples` times of each mode, over time.

    The walk ends at the first step that fails, with the motion until its end.
    """
    mode_names, time, step, outcome = tuple(system.modes), 0.0, 0, Outcome.STEPPED
    pieces: list[tuple[np.ndarray, np.ndarray, int, int]] = []
    for step, params in enumerate(params_of_steps):
        start = system.embed(jnp.asarray(x), params)
        motion = jax.tree.map(np.asarray, compile_simulation(system)(params, start, options))
        n_events = int(motion.n_events)
        outcome = Outcome(OUTCOME_BY_TERMINATION[motion.termination])
        ending = describe_step(Termination(int(motion.termination)))
        end_times, modes = motion.times[:n_events], motion.modes[:n_events]
        if outcome != Outcome.STEPPED and not (n_events and end_times[-1] == motion.time):
            end_times, modes = np.append(end_times, motion.time), np.append(modes, motion.mode)
        starts = [start, *motion.states_after[: len(modes) - 1]]
        for begin, end, state, mode in zip(
            [0.0, *end_times], end_times, starts, modes, strict=False
        ):
            sample = _compile_mode_sampling(system, mode_names[mode], n_samples)
            states = np.asarray(sample(params, jnp.asarray(state), end - begin, options))
            pieces.append((time + np.linspace(begin, end, n_samples), states, step, int(mode)))
        if outcome != Outcome.STEPPED:
            break
        x = system.project(jnp.asarray(motion.states_after[n_events - 1]), params)
        time += float(end_times[-1])
    times, states, steps, modes = zip(*pieces, strict=True)
    repeat = lambda values: np.repeat(values, n_samples)
    units = system.state_units
    columns = dict(zip(system.state, np.concatenate(states).T, strict=True))
    flags = {"flag_values": list(range(len(mode_names))), "flag_meanings": " ".join(mode_names)}
    coordinates = {
        "time": ("time", np.concatenate(times), {"units": "s"}),
        "step": ("time", repeat(steps)),
        "phase": ("time", repeat(modes), {"long_name": "mode", **flags}),
    }
    return xr.Dataset(
        {
            f"state_{name}" if name in coordinates else name: (
                "time",
                column,
                {"units": units[name]} if name in units else {},
            )
            for name, column in columns.items()
        },
        coordinates,
        {
            "title": "Walk of a HybridSystem",
            "section": system.section,
            "n_steps": step + (outcome == Outcome.STEPPED),
            "outcome": outcome.name,
            "outcome_meaning": ending,
        },
    )


@functools.lru_cache
def _compile_mode_sampling(system: HybridSystem, mode_name: str, n_samples: int) -> Any:
    evaluate: Any = system.modes[mode_name].field

    @jax.jit
    def sample(params: Any, state: Any, duration: Any, options: StepOptions) -> Any:
        return sample_phase(lambda y: evaluate(y, params), state, duration, n_samples, options)

    return sample
