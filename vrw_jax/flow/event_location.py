"""Locate the earliest root of the guards inside a solver step, for each batch element."""

import functools
from enum import IntEnum
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from vrw_jax.base.elementwise import select_trees_by_condition
from vrw_jax.base.options import StepOptions
from vrw_jax.base.types import Vector
from vrw_jax.flow.minima import MarginMinimaState
from vrw_jax.flow.tableaus import (
    ButcherTableau,
    SolverStepFunction,
    StageState,
    fit_guard_parabola,
    load_explicit_tableau,
    take_rk_step,
)
from vrw_jax.flow.tangents import BatchPhase


class IntegrationStatus(IntEnum):
    """Status of a batch element in the integration loop."""

    RUNNING = 0
    TIMED_OUT = 1
    FAILED = 2
    CROSSED = 3  # The last tried step crosses a guard.
    IDLE = 4  # The element is inactive, or its start is already an event.


class IntegratorState(NamedTuple):
    """State of the integration loop for each batch element."""

    state: StageState
    guard_values: Vector  # guards at `state`
    next_step_length: Array
    elapsed_time: Array
    integration_status: Array  # an IntegrationStatus, after the last tried step
    crossing_guard_bits: Array  # bit i is set if guard i crosses zero in that step
    middle_guard_values: Vector  # guards at the middle stage of the crossing step
    end_guard_values: Vector
    n_tried_steps: Array
    # number of iterations after which half of the batch had ended
    n_iterations_until_half_ended: Array
    n_iterations: Array
    margin_minima_state: MarginMinimaState | None
    state_tangents: (
        Array | None
    )  # tangents of the state, (directions, components, batch), see `tangents`

    @property
    def is_running(self) -> Array:
        """Return whether each batch element needs more solver steps."""
        return self.integration_status == IntegrationStatus.RUNNING

    @property
    def has_guard_crossed(self) -> Array:
        """Return whether the last tried step of each batch element crosses a guard."""
        return self.integration_status == IntegrationStatus.CROSSED


class EventSearch(NamedTuple):
    """State and result of the search for the event of each batch element."""

    event_step_length: Array  # length of the next solver step, or time to the event, s
    lower_step_length_bound: Array
    upper_step_length_bound: Array
    is_event_unresolved: Array
    end_state: StageState
    remaining_time_to_event: Array  # time from `end_state` to the event, by Newton's method, s
    guard_index: Array
    n_tried_steps: Array
    n_iterations: Array


def locate_event(
    phase: BatchPhase,
    solver_step_function: SolverStepFunction,
    tableau: ButcherTableau,
    integrator_state: IntegratorState,
    options: StepOptions,
) -> EventSearch:
    """Return, for each batch element, the earliest event inside its crossing solver step.

    Newton's method corrects the length of the solver step until the step ends at the event. The
    first length is the earliest root of the parabolas through the values of the crossing guards.
    The next length is the earliest event time that Newton's method proposes for the crossing
    guards. If this time is outside the bracket, the bracket is bisected instead.

    When the event is near and no guard is too curved for Newton's method, a short solver step of
    low order replaces the last corrections. The state is then extrapolated linearly over the
    remaining time.
    """
    step_length, event_time_rtol = integrator_state.next_step_length, jnp.sqrt(options.rtol)
    max_extrapolation_time = 0.1 * event_time_rtol * step_length
    max_short_step_duration = 0.3 * jnp.sqrt(event_time_rtol) * step_length
    is_crossing = [
        (integrator_state.crossing_guard_bits >> i) & 1 == 1
        for i in range(len(integrator_state.guard_values))
    ]

    def improve_event_search(event_search: EventSearch) -> EventSearch:
        (
            event_step_length,
            lower_step_length_bound,
            upper_step_length_bound,
            is_event_unresolved,
            *previous_proposal,
            n_tried_steps,
            n_iterations,
        ) = event_search
        step_end = solver_step_function(integrator_state.state, event_step_length)[-1]
        guard_values, guard_rates = phase.evaluate_with_rates(phase.evaluate_guards, step_end)
        time_to_event, guard_index = _propose_earliest_event(guard_values, guard_rates, is_crossing)
        is_before_event = jnp.ones(step_length.shape, bool)
        is_guard_straight = jnp.ones(step_length.shape, bool)
        for start_guard_value, guard_value, guard_rate, is_crossing_guard in zip(
            integrator_state.guard_values, guard_values, guard_rates, is_crossing, strict=True
        ):
            has_crossed, is_guard_curved = _classify_guard_crossing(
                start_guard_value, guard_value, guard_rate, event_step_length
            )
            is_before_event = is_before_event & ~(is_crossing_guard & has_crossed)
            is_guard_straight = is_guard_straight & ~(is_crossing_guard & is_guard_curved)
        lower_step_length_bound = jnp.where(
            is_before_event, event_step_length, lower_step_length_bound
        )
        upper_step_length_bound = jnp.where(
            is_before_event, upper_step_length_bound, event_step_length
        )
        proposed_step_length = event_step_length + time_to_event
        is_proposal_in_bracket = (
            proposed_step_length >= lower_step_length_bound - max_extrapolation_time
        ) & (proposed_step_length <= upper_step_length_bound + max_extrapolation_time)
        next_event_step_length = jnp.where(
            is_proposal_in_bracket,
            proposed_step_length,
            0.5 * (lower_step_length_bound + upper_step_length_bound),
        )
        is_at_event = (
            is_event_unresolved
            & is_proposal_in_bracket
            & (
                jnp.abs(time_to_event)
                <= jnp.where(is_guard_straight, max_short_step_duration, max_extrapolation_time)
            )
        )
        end_state, remaining_time_to_event, guard_index = select_trees_by_condition(
            is_at_event,
            (step_end, time_to_event, guard_index),
            tuple(previous_proposal),
        )
        return EventSearch(
            event_step_length=jnp.where(
                is_event_unresolved,
                next_event_step_length,
                event_step_length,
            ),
            lower_step_length_bound=lower_step_length_bound,
            upper_step_length_bound=upper_step_length_bound,
            is_event_unresolved=is_event_unresolved & ~is_at_event,
            end_state=end_state,
            remaining_time_to_event=remaining_time_to_event,
            guard_index=guard_index,
            n_tried_steps=n_tried_steps + is_event_unresolved,
            n_iterations=n_iterations + 1,
        )

    first_crossing_fraction = jnp.ones_like(step_length)
    for is_crossing_guard, *crossing_values in zip(
        is_crossing,
        integrator_state.guard_values,
        integrator_state.middle_guard_values,
        integrator_state.end_guard_values,
        strict=True,
    ):
        fraction_to_zero = _find_parabola_zero(tableau, is_crossing_guard, *crossing_values)
        first_crossing_fraction = jnp.where(
            is_crossing_guard,
            jnp.minimum(first_crossing_fraction, fraction_to_zero),
            first_crossing_fraction,
        )
    initial_indices = jnp.zeros(step_length.shape, jnp.int32)
    zero_duration = jnp.zeros_like(step_length)
    initial_search = EventSearch(
        step_length * first_crossing_fraction,
        zero_duration,
        step_length,
        integrator_state.has_guard_crossed,
        integrator_state.state,
        zero_duration,
        initial_indices,
        initial_indices,
        jnp.zeros((), jnp.int32),
    )
    needs_iteration = lambda event_search: (
        jnp.any(event_search.is_event_unresolved)
        & (event_search.n_iterations < options.max_event_iterations)
    )
    event_search = lax.while_loop(needs_iteration, improve_event_search, initial_search)

    # One short solver step suffices unless a guard grazes zero. The event stays unresolved if
    # Newton's method diverges. A method of order 3 is accurate to round-off during a thousandth of
    # a solver step.
    low_order_tableau = load_explicit_tableau("Bosh3")
    assert low_order_tableau is not None

    can_take_short_step = lambda is_event_distant, remaining_time_to_event: (
        is_event_distant & (jnp.abs(remaining_time_to_event) <= max_short_step_duration)
    )

    def take_short_step(event_search: EventSearch) -> EventSearch:
        is_step_taken = can_take_short_step(
            event_search.is_event_unresolved, event_search.remaining_time_to_event
        )
        short_step = take_rk_step(
            low_order_tableau,
            phase.evaluate_acceleration,
            event_search.end_state,
            event_search.remaining_time_to_event,
        )
        end_state = select_trees_by_condition(is_step_taken, short_step[-1], event_search.end_state)
        time_to_event, guard_index = _propose_earliest_event(
            *phase.evaluate_with_rates(phase.evaluate_guards, end_state), is_crossing
        )
        remaining_time_to_event = jnp.where(
            is_step_taken, time_to_event, event_search.remaining_time_to_event
        )
        return event_search._replace(
            event_step_length=jnp.where(
                can_take_short_step(is_step_taken, time_to_event),
                event_search.event_step_length + time_to_event,
                event_search.event_step_length,
            ),
            is_event_unresolved=event_search.is_event_unresolved
            & (jnp.abs(remaining_time_to_event) > max_extrapolation_time),
            end_state=end_state,
            remaining_time_to_event=remaining_time_to_event,
            guard_index=jnp.where(is_step_taken, guard_index, event_search.guard_index),
            n_iterations=event_search.n_iterations + 1,
        )

    needs_short_step = lambda event_search: (
        jnp.any(
            can_take_short_step(
                event_search.is_event_unresolved, event_search.remaining_time_to_event
            )
        )
        & (event_search.n_iterations < options.max_event_iterations)
    )
    is_event_distant = (
        integrator_state.has_guard_crossed
        & ~event_search.is_event_unresolved
        & (jnp.abs(event_search.remaining_time_to_event) > max_extrapolation_time)
    )
    refined_search = lax.while_loop(
        needs_short_step,
        take_short_step,
        event_search._replace(
            is_event_unresolved=is_event_distant, n_iterations=jnp.zeros((), jnp.int32)
        ),
    )
    extrapolate = lambda x, y: x + refined_search.remaining_time_to_event * y
    event_state = refined_search.end_state
    event_state = event_state._replace(
        q=tuple(map(extrapolate, event_state.q, event_state.v)),
        v=tuple(map(extrapolate, event_state.v, event_state.acceleration.acceleration)),
    )
    return refined_search._replace(
        is_event_unresolved=event_search.is_event_unresolved | refined_search.is_event_unresolved,
        end_state=select_trees_by_condition(
            refined_search.is_event_unresolved, integrator_state.state, event_state
        ),
    )


def compute_event_time_tangent(
    is_at_event: Array, event_guard_index: Array, guard_rates: Any, guard_tangents: Any
) -> Array:
    """Return the tangent of the event's time, s, from rates and tangents of all guards.

    The tangent follows from the condition that the guard is zero at the event of the perturbed
    motion. Without an event, or if the guard does not fall, the tangent is zero.

    - `event_guard_index`: index of the guard that is zero at the event;
    - `guard_rates`, `guard_tangents`: time derivatives and tangents, one array for each guard.
    """
    event_time_tangent = jnp.zeros_like(guard_tangents[0])
    for guard_index in range(len(guard_tangents)):
        guard_rate = guard_rates[guard_index]
        is_event_guard = is_at_event & (event_guard_index == guard_index) & (guard_rate < 0.0)
        event_time_tangent = jnp.where(
            is_event_guard,
            -guard_tangents[guard_index] / jnp.where(is_event_guard, guard_rate, -1.0),
            event_time_tangent,
        )
    return event_time_tangent


@jax.jit  # The function is traced once for all guards.
def _classify_guard_crossing(
    start_guard_value: Array, guard_value: Array, guard_rate: Array, step_length: Array
) -> tuple[Array, Array]:
    """Return whether a guard has crossed zero, and whether it is too curved for Newton's method.

    - `start_guard_value`: value of the guard at the start of the solver step;
    - `guard_value`, `guard_rate`: value and time derivative of the guard after `step_length`, s.
    """
    # A guard that rises from zero has not crossed.
    has_crossed = (guard_value < 0.0) | ((guard_value == 0.0) & (guard_rate <= 0.0))
    linear_decrease = guard_rate * step_length
    return has_crossed, jnp.abs(
        2.0 * (start_guard_value - guard_value + linear_decrease) * guard_value
    ) > 0.25 * linear_decrease * linear_decrease


def _propose_earliest_event(
    guard_values: Vector, guard_rates: Vector, is_crossing: list[Array]
) -> tuple[Array, Array]:
    """Return the time to the earliest event, s, by one Newton step, and the guard's index.

    The time is negative if the event is earlier than the present state. It is minus infinity for a
    guard that is negative and rises, because this guard crossed zero at an unknown earlier time.
    `is_crossing` states for each guard whether it crosses zero.
    """
    time_to_event = jnp.full_like(guard_values[0], jnp.inf)
    guard_index = jnp.zeros(time_to_event.shape, jnp.int32)
    for candidate_guard_index, guard in enumerate(
        zip(is_crossing, guard_values, guard_rates, strict=True)
    ):
        guard_zero_time = _compute_time_to_zero(*guard)
        guard_index = jnp.where(guard_zero_time < time_to_event, candidate_guard_index, guard_index)
        time_to_event = jnp.minimum(guard_zero_time, time_to_event)
    return time_to_event, guard_index


@jax.jit  # The function is traced once for all guards.
def _compute_time_to_zero(is_crossing: Array, guard_value: Array, guard_rate: Array) -> Array:
    """Return the time from the present state to the root of a guard's tangent line, s.

    The time is infinite for a guard that does not cross zero. It is minus infinity for a crossing
    guard that is negative and does not fall.
    """
    is_guard_falling = is_crossing & (guard_rate < 0.0)
    time_to_zero_if_rising = jnp.where(is_crossing & (guard_value < 0.0), -jnp.inf, jnp.inf)
    return jnp.where(
        is_guard_falling,
        -guard_value / jnp.where(is_guard_falling, guard_rate, -1.0),
        time_to_zero_if_rising,
    )


@functools.partial(jax.jit, static_argnums=0)  # The function is traced once for all guards.
def _find_parabola_zero(
    tableau: ButcherTableau,
    is_crossing: Array,
    start_guard_value: Array,
    middle_guard_value: Array,
    end_guard_value: Array,
) -> Array:
    """Return the root of a guard's parabola, as a fraction of the solver step.

    The parabola passes through the guard's values at the start, at the middle stage and at the end.
    The secant method, followed by Newton's method, locates the root.
    """
    quadratic_coefficient, linear_coefficient = fit_guard_parabola(
        tableau, start_guard_value, middle_guard_value, end_guard_value
    )
    guard_decrease = jnp.where(
        is_crossing & (start_guard_value > end_guard_value),
        start_guard_value - end_guard_value,
        1.0,
    )
    fraction_to_zero = jnp.clip(start_guard_value / guard_decrease, 0.0, 1.0)
    # A guard that rises from zero vanishes at the start of the step, so the other root is returned.
    is_guard_rising = is_crossing & (start_guard_value == 0.0) & (linear_coefficient > 0.0)
    fraction_to_zero = jnp.where(
        is_guard_rising,
        jnp.clip(
            -linear_coefficient / jnp.where(is_guard_rising, quadratic_coefficient, -1.0), 0.0, 1.0
        ),
        fraction_to_zero,
    )
    for _ in range(3):
        parabola_rate = linear_coefficient + 2.0 * quadratic_coefficient * fraction_to_zero
        is_guard_falling = parabola_rate < 0.0
        fraction_change = (
            start_guard_value
            + fraction_to_zero * (linear_coefficient + quadratic_coefficient * fraction_to_zero)
        ) / jnp.where(is_guard_falling, parabola_rate, 1.0)
        fraction_to_zero = jnp.where(
            is_guard_falling,
            jnp.clip(fraction_to_zero - fraction_change, 0.0, 1.0),
            fraction_to_zero,
        )
    return fraction_to_zero
