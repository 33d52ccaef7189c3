"""Integrate one phase of a batch to its earliest event, with a separate step size for each element.

The elements are integrated together until each has ended or has a solver step in which a guard
crosses zero. Then all events are located together. The crossing solver step is repeated, and
Newton's method corrects its length. An element that has ended does not change, so its result never
depends on the other elements.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from vrw_jax import lanes
from vrw_jax.base.elementwise import (
    Vector,
    run_if_any_element_active,
    select_trees_by_condition,
)
from vrw_jax.base.options import StepOptions
from vrw_jax.flow.event_location import (
    EventSearch,
    IntegrationStatus,
    IntegratorState,
    arrive_at_events,
    find_events,
    find_first_guard,
    has_guard_crossed,
    locate_event,
    make_idle_state,
)
from vrw_jax.flow.extrema import (
    EnterSides,
    MarginMinimaResult,
    compute_margin_minima_jvp,
    init_margin_minima_state,
    refine_margin_minima,
    update_margin_minima_state,
)
from vrw_jax.flow.solver_steps import (
    BatchPhase,
    ButcherTableau,
    MakeBatchPhase,
    SolverStepFunction,
    StageState,
    compute_step_size_factor,
    find_earliest_guard_minimum_fraction,
    find_hidden_event_fraction,
    make_solver_step_function,
)
from vrw_jax.flow.tangents import (
    PhaseTangents,
    find_sides,
    integrate_over_kinks,
    propagate_to_event,
    stack_directions,
)
from vrw_jax.lanes.autodiff import apply_batched_jvp_rule


class PhaseEnd(NamedTuple):
    """State at the end of a phase, duration, triggered guard, failure flags and margin minima."""

    state: Any  # a StageState, positions and rates, or an array
    duration: Array  # s
    end_guard_index: Array  # index of the guard that ended the phase; -1 if none did
    is_timed_out: Array
    # whether the element is a straggler, see `integrate_batch_phase`
    is_unfinished: Array
    solver_steps: Array  # number of tried solver steps, accepted or not
    next_solver_dt: Array  # a first step length for the next phase, s
    margin_minima: Any  # minima of the margins, (margins, batch) or (margins,)
    kink_log: Any = None  # a `tangents.KinkLog` without tangents, if requested

    @property
    def has_integration_failed(self) -> Array:
        """Return whether a phase ended without event or time limit, if it was active."""
        return (self.end_guard_index < 0) & ~self.is_timed_out


STRAGGLER_ITERATION_FACTOR = 2
"""Ratio of two iteration counts: when stragglers are cut off, and when half of the batch had ended.

The value is chosen because a ratio near 1 would cut off regular elements.
"""


def integrate_batch_phase(
    make_phase: MakeBatchPhase,
    equation_constants: Any,
    held_constants: Vector,
    tableau: ButcherTableau,
    q: Vector,
    v: Vector,
    is_active: Array,
    initial_dt: Array,
    options: StepOptions,
    straggler_count: Array | None = None,
) -> PhaseEnd:
    """Return the end of a phase that begins at positions `q` and rates `v`, for each batch element.

    - `make_phase`: function that returns the phase for `equation_constants` and `held_constants`;
    - `equation_constants`, `held_constants`: constants of the equations, see
      `solver_steps.MakeBatchPhase`;
    - `tableau`: tableau of the Runge-Kutta method;
    - `q`, `v`: tuples of arrays (batch,), one array per coordinate;
    - `is_active`: which elements are integrated, (batch,);
    - `initial_dt`: length of the first solver step, (batch,), s;
    - `straggler_count`: largest number of elements that may be cut off; None for no cut-off.

    Each active element is integrated to its earliest event. Errors are those of
    `phase_integration.integrate_phase`. Stragglers are the last `straggler_count` elements of a
    large batch that take `STRAGGLER_ITERATION_FACTOR` times as many iterations as half of the
    batch. Their integration stops early, and the caller integrates them again in a batch of
    stragglers.

    The result is differentiable with respect to `equation_constants`, `held_constants`, `q` and
    `v`, see `tangents`.
    """

    def integrate(
        phase_tangents: Any, equation_constants: Any, held_constants: Vector, *arguments: Any
    ) -> tuple[PhaseEnd, Any]:
        phase = make_phase(equation_constants, held_constants)
        return integrate_to_event(phase, phase_tangents, tableau, *arguments)

    integrate_with_rule = jax.custom_jvp(lambda *arguments: integrate(None, *arguments)[0])

    @integrate_with_rule.defjvp
    @lanes.with_default_jax_settings
    def compute_integration_jvp(primals: tuple, state_tangents: tuple) -> tuple[PhaseEnd, PhaseEnd]:
        def integrate_with_tangents(primals: tuple, directions: tuple) -> tuple[PhaseEnd, Any]:
            equation_constants_tangents, held_constants, q, v = directions
            start_tangents = stack_directions((*q, *v, *held_constants))
            phase_tangents = PhaseTangents(
                make_phase, primals[0], primals[1], equation_constants_tangents, start_tangents
            )
            phase_end, search_end = integrate(phase_tangents, *primals)
            end_tangents = compute_phase_end_jvp(tableau, phase_tangents, phase_end, search_end)
            return phase_end, (*end_tangents, search_end.kink_tangents)

        phase_end, (motion_tangent, event_time_tangent, minima_tangents, kink_tangents) = (
            apply_batched_jvp_rule(integrate_with_tangents, primals, state_tangents[:4])
        )
        zero_phase_end = lanes.make_zero_tangent(phase_end)
        n = len(phase_end.state.q)
        state_tangent = zero_phase_end.state._replace(
            q=tuple(motion_tangent[:n]), v=tuple(motion_tangent[n:])
        )
        log = zero_phase_end.kink_log
        if log is not None:
            log = log._replace(times=kink_tangents[:, 0], states=kink_tangents[:, 1:])
        return phase_end, zero_phase_end._replace(
            state=state_tangent,
            duration=event_time_tangent,
            margin_minima=minima_tangents,
            kink_log=log,
        )

    return integrate_with_rule(
        equation_constants, held_constants, q, v, is_active, initial_dt, options, straggler_count
    )


class SearchEnd(NamedTuple):
    """What derivatives of the end of a phase need of its integration."""

    solver_step_function: Any  # None if the last solver step is already taken
    start_state: StageState
    integrator_state: IntegratorState  # after the loop, with the minima of the whole phase
    located_guard_index: Array  # guard that is zero at the end
    enter_sides: EnterSides | None  # None for phases without kinks
    sides: Vector  # sides of the kinks at the end
    margin_minima_result: MarginMinimaResult | None = None
    kink_tangents: Array | None = None  # see `tangents.KinkLog`


def compute_phase_end_jvp(
    tableau: ButcherTableau,
    phase_tangents: Any,
    phase_end: PhaseEnd,
    search_end: SearchEnd,
) -> tuple[Array, Array, Array | None]:
    """Return the tangents at the end of a phase, for given tangents of its start and constants.

    The result contains the tangents of positions and rates, of the duration, and of minima of the
    margins. The first axis contains the directions.
    """
    solver_step_function, start_state, integrator_state, located_guard_index = search_end[:4]
    enter_sides, margin_minima_result = search_end.enter_sides, search_end.margin_minima_result
    last_step_length = jnp.where(
        integrator_state.has_guard_crossed, phase_end.duration - integrator_state.elapsed_time, 0.0
    )
    end_tangents, event_time_tangent, motion_tangents = propagate_to_event(
        tableau,
        solver_step_function,
        phase_tangents if enter_sides is None else phase_tangents.on_sides(search_end.sides),
        integrator_state,
        last_step_length,
        located_guard_index,
    )
    margin_minima_state = integrator_state.margin_minima_state
    if margin_minima_state is None or margin_minima_result is None:
        return motion_tangents, event_time_tangent, None
    held_tangents = end_tangents[:, motion_tangents.shape[1] :]
    minima_tangents = compute_margin_minima_jvp(
        solver_step_function,
        tableau,
        phase_tangents,
        margin_minima_state,
        margin_minima_result,
        start_state,
        phase_end.state,
        jnp.concatenate([motion_tangents, held_tangents], 1),
        enter_sides,
    )
    return motion_tangents, event_time_tangent, minima_tangents


class Interruption(NamedTuple):
    """Interruption of a batch in which elements wait at their events, so that few are idle."""

    max_iterations: int  # number of iterations after which no element waits
    interrupted_state: IntegratorState  # elements that are running in this state continue


def integrate_to_event(
    phase: BatchPhase,
    phase_tangents: Any,
    tableau: ButcherTableau,
    q: Any,
    v: Any,
    is_active: Array,
    initial_dt: Array,
    options: StepOptions,
    straggler_count: Array | None = None,
    interruption: Interruption | None = None,
    attach_derivatives: Callable | None = None,
) -> tuple[PhaseEnd, SearchEnd]:
    """Return the end of a phase for each batch element, and what its derivatives need.

    The arguments are those of `integrate_batch_phase` and of `integrate_over_kinks`.

    Without kinks, `take_steps` moves each element to the solver step in which a guard falls to
    zero, and `locate` shortens this step. `integrate_over_kinks` repeats both between kinks.

    - `phase_tangents`: a `PhaseTangents` or an object with the same methods, or None;
    - `interruption`: when the integration is interrupted, and elements that continue after one.
    """
    phase = phase.wrap_functions(lanes.mark_noinline if phase.is_compiled_separately else jax.jit)
    n_guards: Any = None
    whole_phase, enter_sides = phase, None
    if phase.evaluate_kinks is not None:
        phase, enter_sides, n_guards = _enter_first_sides(
            whole_phase, phase_tangents, phase.make_state(q, v), tableau, options
        )
    solver = make_solver_step_function(phase, tableau, options)
    start_state = phase.make_state(q, v)
    guard_values, is_guard_met_at_start = _evaluate_start_guards(phase, start_state, n_guards)
    # The index is that of the first guard whose event is the start itself.
    start_event_guard_index = find_first_guard(is_guard_met_at_start, -1)
    is_phase_started = is_active & (start_event_guard_index < 0)
    integrator_state = _init_integrator_state(
        phase, start_state, guard_values, is_phase_started, initial_dt, phase_tangents, interruption
    )

    def make_loop(phase: BatchPhase, solver: SolverStepFunction, tangents: Any) -> Callable:
        return functools.partial(
            lax.while_loop,
            functools.partial(_needs_more_steps, is_phase_started, straggler_count, interruption),
            _make_step_attempt(phase, solver, tableau, options, straggler_count, tangents),
        )

    locate = lambda phase, solver, state: locate_event(
        phase, solver, tableau, lax.stop_gradient(state), options
    )
    sides, end_guard_index, has_last_step, log = phase.sides, None, False, None
    if enter_sides is None:
        take_steps = make_loop(phase, solver, phase_tangents)
        if phase.margins_include_start or phase_tangents is not None:
            has_last_step = phase_tangents is not None and phase.take_solver_step is not None
            # The functions are called, not inlined, because the program is already long.
            if not has_last_step:
                phase = whole_phase = phase.wrap_functions(lanes.mark_noinline)
                solver = make_solver_step_function(phase, tableau, options)
        if phase.take_last_step is not None:
            take_last_step = phase.take_last_step
            solver = jax.jit(lambda state, h: (take_last_step(state, h), jnp.zeros_like(h)))
        integrator_state, event_search = (arrive_at_events if has_last_step else find_events)(
            take_steps, functools.partial(locate, phase, solver), integrator_state
        )
    else:
        sides, integrator_state, event_search, end_guard_index, _, log = integrate_over_kinks(
            lambda phase, solver, tangents, state: find_events(
                make_loop(phase, solver, tangents), functools.partial(locate, phase, solver), state
            ),
            enter_sides, sides, n_guards, tableau, integrator_state, options, attach_derivatives,
            whole_phase.n_logged_kinks,
        )  # fmt: skip
        phase, solver, _ = enter_sides(sides)
    phase_end, located_guard_index = _make_phase_end(
        integrator_state,
        event_search,
        jnp.where(is_active, start_event_guard_index, -1),
        end_guard_index,
        options,
    )
    last_solver = None if has_last_step else solver
    search_end = SearchEnd(
        last_solver, start_state, integrator_state, located_guard_index, enter_sides, sides
    )
    if log is not None:
        phase_end = phase_end._replace(kink_log=log._replace(tangents=None))
        search_end = search_end._replace(kink_tangents=log.tangents)
    if integrator_state.margin_minima_state is None:
        return phase_end, search_end
    start_margins = jnp.stack(whole_phase.evaluate_margins(start_state))
    return _add_margin_minima(phase, start_margins, event_search, phase_end, search_end, options)


def _enter_first_sides(
    phase_with_kinks: BatchPhase,
    phase_tangents: Any,
    start_state: StageState,
    tableau: ButcherTableau,
    options: StepOptions,
) -> tuple[BatchPhase, EnterSides, int]:
    """Return the phase on its first sides, the function for the others, and the guards' number."""

    def enter_sides(sides: Vector) -> tuple[BatchPhase, SolverStepFunction, Any]:
        phase = phase_with_kinks.on_sides(sides).wrap_functions(lanes.mark_noinline)
        tangents = None if phase_tangents is None else phase_tangents.on_sides(sides)
        return phase, make_solver_step_function(phase, tableau, options), tangents

    return (
        phase_with_kinks.on_sides(find_sides(phase_with_kinks, start_state)),
        enter_sides,
        len(phase_with_kinks.evaluate_guards(start_state)),
    )


def _evaluate_start_guards(
    phase: BatchPhase, start_state: StageState, n_guards: int | None
) -> tuple[Array, Array]:
    """Return the guards at the start of a phase, and whether each ends the phase there.

    - `n_guards`: number of guards that end the phase; None for all.
    """
    if phase.guards_met_at_start is not None:
        return lax.stop_gradient(phase.evaluate_guards(start_state)), phase.guards_met_at_start
    guard_values, guard_rates = lax.stop_gradient(
        phase.evaluate_with_rates(phase.evaluate_guards, start_state)
    )
    return guard_values, has_guard_crossed(guard_values[:n_guards], guard_rates[:n_guards])


def _make_phase_end(
    integrator_state: IntegratorState,
    event_search: EventSearch,
    start_event_guard_index: Array,
    end_guard_index: Array | None,
    options: StepOptions,
) -> tuple[PhaseEnd, Array]:
    """Return the end of a phase without minima, and the index of the guard that is zero there.

    - `start_event_guard_index`: index of the guard whose event is the start itself, or -1;
    - `end_guard_index`: see `tangents.KinkPassage`.
    """
    is_crossing = integrator_state.has_guard_crossed
    is_event_unresolved = is_crossing & event_search.is_event_unresolved
    duration = integrator_state.elapsed_time + jnp.where(
        is_crossing, event_search.event_step_length, 0.0
    )
    end_state = select_trees_by_condition(
        is_crossing, event_search.end_state, integrator_state.state
    )
    is_event_too_late = (
        is_crossing & ~event_search.is_event_unresolved & (duration > options.max_phase_time)
    )
    has_no_event = is_event_unresolved | is_event_too_late
    select_index = lambda guard_index: jnp.where(
        has_no_event,
        -1,
        jnp.where(
            start_event_guard_index >= 0,
            start_event_guard_index,
            jnp.where(is_crossing, guard_index, -1),
        ),
    )
    located_guard_index = select_index(event_search.guard_index)
    if end_guard_index is not None:
        end_guard_index = select_index(
            jnp.where(end_guard_index < 0, event_search.guard_index, end_guard_index)
        )
    phase_end = PhaseEnd(
        state=end_state,
        duration=duration,
        end_guard_index=located_guard_index if end_guard_index is None else end_guard_index,
        is_timed_out=(integrator_state.integration_status == IntegrationStatus.TIMED_OUT)
        | is_event_too_late,
        is_unfinished=integrator_state.is_running,
        solver_steps=integrator_state.n_tried_steps
        + jnp.where(is_crossing, event_search.n_tried_steps, 0),
        next_solver_dt=integrator_state.next_step_length,
        margin_minima=None,
    )
    return phase_end, located_guard_index


def _add_margin_minima(
    phase: BatchPhase,
    start_margins: Array,
    event_search: EventSearch,
    phase_end: PhaseEnd,
    search_end: SearchEnd,
    options: StepOptions,
) -> tuple[PhaseEnd, SearchEnd]:
    """Return the end of a phase with the minima of its margins."""
    integrator_state = search_end.integrator_state
    assert integrator_state.margin_minima_state is not None
    margin_minima_state = update_margin_minima_state(
        phase,
        integrator_state.margin_minima_state,
        integrator_state.state,
        phase_end.state,
        event_search.event_step_length,
        integrator_state.has_guard_crossed,
        integrator_state.state_tangents,
    )
    margin_minima_result = refine_margin_minima(
        phase,
        search_end.solver_step_function,
        margin_minima_state,
        start_margins,
        options,
        min_iterations=3 if phase.has_exact_events else 1,
        enter_sides=search_end.enter_sides,
    )
    return (
        phase_end._replace(margin_minima=margin_minima_result.phase_margin_minima),
        search_end._replace(
            integrator_state=integrator_state._replace(margin_minima_state=margin_minima_state),
            margin_minima_result=margin_minima_result,
        ),
    )


def _make_step_attempt(
    phase: BatchPhase,
    solver_step_function: SolverStepFunction,
    tableau: ButcherTableau,
    options: StepOptions,
    straggler_count: Array | None,
    phase_tangents: Any,
) -> Callable[[IntegratorState], IntegratorState]:
    """Return a function that tries one adaptive solver step in all running batch elements.

    An element stops when a guard crosses zero, when it reaches the time limit, or when it fails.
    """

    def take_one_solver_step(integrator_state: IntegratorState) -> IntegratorState:
        step_length = integrator_state.next_step_length
        stage_states, inner_guard_values, end_guard_values, step_length_factor, is_rejected = (
            _try_solver_step(phase, solver_step_function, tableau, integrator_state)
        )
        next_state, is_accepted = _classify_solver_step(
            options, integrator_state, step_length_factor, is_rejected, end_guard_values
        )
        state, guard_values = select_trees_by_condition(
            is_accepted,
            (stage_states[-1], end_guard_values),
            (integrator_state.state, integrator_state.guard_values),
        )
        middle_guard_values, end_guard_values = select_trees_by_condition(
            integrator_state.is_running,
            (inner_guard_values[tableau.middle_guard_index], end_guard_values),
            (integrator_state.middle_guard_values, integrator_state.end_guard_values),
        )
        n_iterations = integrator_state.n_iterations + 1
        n_iterations_until_half_ended = integrator_state.n_iterations_until_half_ended
        margin_minima_state = integrator_state.margin_minima_state
        state_tangents = integrator_state.state_tangents
        if margin_minima_state is not None:
            margin_minima_state = update_margin_minima_state(
                phase,
                margin_minima_state,
                integrator_state.state,
                stage_states[-1],
                step_length,
                is_accepted,
                state_tangents,
            )
        if phase_tangents is not None and state_tangents is not None:
            propagate = lambda tangents: phase_tangents.propagate_to_step_end(
                tableau, stage_states, tangents, step_length, is_accepted
            )
            state_tangents = run_if_any_element_active(
                jnp.any(is_accepted), propagate, state_tangents
            )
        if straggler_count is not None:
            n_running_elements = jnp.sum(next_state.is_running, dtype=jnp.int32)
            n_iterations_until_half_ended = jnp.where(
                2 * n_running_elements > is_accepted.size,
                n_iterations,
                n_iterations_until_half_ended,
            )
        return next_state._replace(
            state=state,
            guard_values=guard_values,
            middle_guard_values=middle_guard_values,
            end_guard_values=end_guard_values,
            n_tried_steps=integrator_state.n_tried_steps + integrator_state.is_running,
            n_iterations_until_half_ended=n_iterations_until_half_ended,
            n_iterations=n_iterations,
            margin_minima_state=margin_minima_state,
            state_tangents=state_tangents,
        )

    return take_one_solver_step


def _try_solver_step(
    phase: BatchPhase,
    solver_step_function: SolverStepFunction,
    tableau: ButcherTableau,
    integrator_state: IntegratorState,
) -> tuple[list[StageState], list[Array], Array, Array, Array]:
    """Return stages of a solver step, guards within and at its end, the next length, and rejection.

    The next length is relative to this one.
    """
    step_length = integrator_state.next_step_length
    stage_states, mean_squared_error = solver_step_function(integrator_state.state, step_length)
    *later_guard_values, end_guard_values = lax.stop_gradient(
        [phase.evaluate_guards(stage_states[i]) for i in (*tableau.guard_stage_indices, -1)]
    )
    inner_guard_values = [integrator_state.guard_values, *later_guard_values]
    is_finite = jnp.all(jnp.isfinite(end_guard_values), axis=0)
    mean_squared_error = jnp.where(is_finite, mean_squared_error, jnp.inf)
    elapsed_time = integrator_state.elapsed_time
    may_have_minimum: Any = True
    if phase.guards_rising_at_start is not None:
        may_have_minimum = (elapsed_time > 0.0) | ~phase.guards_rising_at_start
    guard_minimum_fraction = find_earliest_guard_minimum_fraction(
        tableau, [*inner_guard_values, end_guard_values], may_have_minimum
    )
    if phase.evaluate_armed_guards is not None:
        stages = (stage_states[i] for i in (0, *tableau.guard_stage_indices, -1))
        armed_guards = lax.stop_gradient([phase.evaluate_armed_guards(stage) for stage in stages])
        values, others = map(list, zip(*armed_guards, strict=True))
        guard_minimum_fraction = jnp.minimum(
            guard_minimum_fraction, find_hidden_event_fraction(tableau, values, others)
        )
    is_within_tolerance = mean_squared_error <= 1.0
    # A step inside which a guard may be negative is repeated up to the guard's minimum.
    may_cross_inside = (
        is_within_tolerance
        & (guard_minimum_fraction < 1.0)
        & (elapsed_time + step_length * guard_minimum_fraction > elapsed_time)
    )
    controller_factor = compute_step_size_factor(
        tableau, mean_squared_error, guard_minimum_fraction.dtype
    )
    return (
        stage_states,
        inner_guard_values,
        end_guard_values,
        jnp.where(may_cross_inside, guard_minimum_fraction, controller_factor),
        may_cross_inside | ~is_within_tolerance,
    )


def _needs_more_steps(
    is_phase_started: Array,
    straggler_count: Array | None,
    interruption: Interruption | None,
    integrator_state: IntegratorState,
) -> Array:
    """Return whether the loop continues, which depends on the number of running elements.

    The loop ends when no element is running, or earlier if the caller allows the slowest elements
    to be left unfinished.
    """
    if interruption is not None:
        is_waiting = jnp.any(is_phase_started & ~integrator_state.is_running)
        is_patient = integrator_state.n_iterations < interruption.max_iterations
        return jnp.any(integrator_state.is_running) & (is_patient | ~is_waiting)
    if straggler_count is None:
        return jnp.any(integrator_state.is_running)
    n_running_elements = jnp.sum(integrator_state.is_running, dtype=jnp.int32)
    max_iterations = STRAGGLER_ITERATION_FACTOR * integrator_state.n_iterations_until_half_ended + 8
    is_iteration_limit_exceeded = integrator_state.n_iterations > max_iterations
    return (n_running_elements > 0) & ~(
        (n_running_elements <= straggler_count) & is_iteration_limit_exceeded
    )


def _init_integrator_state(
    phase: BatchPhase,
    start_state: StageState,
    guard_values: Array,
    is_phase_started: Array,
    initial_dt: Array,
    phase_tangents: Any,
    interruption: Interruption | None,
) -> IntegratorState:
    """Return the state before the first solver step, or the one that an interruption has left."""
    initial_minima = (
        init_margin_minima_state(phase, start_state, phase_tangents)
        if phase.margins_include_start
        else None
    )
    initial_state = make_idle_state(start_state, guard_values, initial_dt)._replace(
        integration_status=jnp.where(
            is_phase_started, IntegrationStatus.RUNNING, IntegrationStatus.IDLE
        ).astype(jnp.int32),
        margin_minima_state=initial_minima,
        state_tangents=None if phase_tangents is None else phase_tangents.start_tangents,
    )
    if interruption is not None:
        shared_fields = {
            name: getattr(initial_state, name)
            for name in ("n_iterations_until_half_ended", "n_iterations", "state_tangents")
        }
        without_shared = lambda state: state._replace(**dict.fromkeys(shared_fields))
        initial_state = select_trees_by_condition(
            interruption.interrupted_state.is_running,
            without_shared(interruption.interrupted_state),
            without_shared(initial_state),
        )._replace(**shared_fields)
    return initial_state


def _classify_solver_step(
    options: StepOptions,
    integrator_state: IntegratorState,
    step_length_factor: Array,
    is_step_rejected: Array,
    end_guard_values: Array,
) -> tuple[IntegratorState, Array]:
    """Return the status of each batch element after a solver step, and whether it accepts the step.

    The returned state has a new status, the new elapsed time, and the length of the next solver
    step. If a guard crosses zero within the solver step, the length is instead that of the step
    just taken. A step that would end after the time limit is shortened to end there. An element
    fails if its next step is too short for the time to advance, or if the number of its solver
    steps reaches the limit.
    """
    is_running = integrator_state.is_running
    is_valid_step = is_running & ~is_step_rejected
    is_crossing = is_valid_step & jnp.any(end_guard_values <= 0.0, axis=0)
    is_accepted = is_valid_step & ~is_crossing
    is_arriving = integrator_state.is_arriving
    if is_arriving is not None:
        is_crossing, is_accepted = (
            is_crossing & ~is_arriving,
            is_accepted | (is_running & is_arriving),
        )
    step_length = integrator_state.next_step_length
    elapsed_time = integrator_state.elapsed_time
    phase_time_limit = options.max_phase_time
    end_time = jnp.where(
        step_length == phase_time_limit - elapsed_time, phase_time_limit, elapsed_time + step_length
    )
    elapsed_time = jnp.where(is_accepted, end_time, elapsed_time)
    next_step_length_limit = jnp.minimum(
        step_length * step_length_factor, phase_time_limit - elapsed_time
    )
    has_timed_out = is_accepted & (elapsed_time >= phase_time_limit)
    is_step_too_short = (integrator_state.n_tried_steps + 1 >= options.max_solver_steps) | (
        elapsed_time + next_step_length_limit == elapsed_time
    )
    integration_status = jnp.where(
        is_step_too_short, IntegrationStatus.FAILED, IntegrationStatus.RUNNING
    )
    integration_status = jnp.where(
        has_timed_out,
        IntegrationStatus.TIMED_OUT,
        jnp.where(is_crossing, IntegrationStatus.CROSSED, integration_status),
    )
    if is_arriving is not None:
        integration_status = jnp.where(is_arriving, IntegrationStatus.CROSSED, integration_status)
    integration_status = jnp.where(
        is_running, integration_status, integrator_state.integration_status
    )
    next_state = integrator_state._replace(
        integration_status=integration_status.astype(jnp.int32),
        elapsed_time=elapsed_time,
        next_step_length=jnp.where(is_running & ~is_crossing, next_step_length_limit, step_length),
    )
    return next_state, is_accepted
