"""Locate the earliest root of the guards inside a solver step, for each batch element."""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from vrw_jax.integrator.minima import evaluate_with_rates
from vrw_jax.integrator.tableaus import (
    ButcherTableau,
    EvaluateAcceleration,
    StageState,
    TakeStep,
    fit_guard_parabola,
    load_explicit_tableau,
    take_rk_step,
)
from vrw_jax.numerics import StepOptions, Vector, select_trees_by_condition


class GuardCrossingStep(NamedTuple):
    """Last solver step of each batch element, with the guards that cross zero during this step."""

    start_state: StageState  # state at the start of the solver step
    start_guard_values: Vector  # guards at the start of the solver step
    middle_guard_values: Vector  # guards at the tableau's stage `middle_stage_index`
    end_guard_values: Vector  # guards at the end of the solver step
    step_length: Array
    crossing_guard_bits: Array  # bit i is set if guard i crosses
    has_guard_crossed: Array  # whether the step of this batch element contains a crossing


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
    evaluate_guards: Callable[[StageState], Vector],
    evaluate_acceleration: EvaluateAcceleration,
    solver_step_function: TakeStep,
    tableau: ButcherTableau,
    guard_crossing_step: GuardCrossingStep,
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
    step_length, event_time_rtol = guard_crossing_step.step_length, jnp.sqrt(options.rtol)
    max_extrapolation_time = 0.1 * event_time_rtol * step_length
    max_short_step_duration = 0.3 * jnp.sqrt(event_time_rtol) * step_length
    is_crossing = [
        (guard_crossing_step.crossing_guard_bits >> i) & 1 == 1
        for i in range(len(guard_crossing_step.start_guard_values))
    ]

    def improve_event_search(event_search: EventSearch) -> EventSearch:
        step_end = solver_step_function(
            guard_crossing_step.start_state, event_search.event_step_length
        ).end_state
        guard_values, guard_rates = evaluate_with_rates(
            evaluate_guards, evaluate_acceleration, step_end
        )
        time_to_event, guard_index = _propose_earliest_event(
            guard_values, guard_rates, guard_crossing_step.crossing_guard_bits
        )
        is_before_event = jnp.ones(step_length.shape, bool)
        is_guard_straight = jnp.ones(step_length.shape, bool)
        for start_guard_value, guard_value, guard_rate, is_crossing_guard in zip(
            guard_crossing_step.start_guard_values,
            guard_values,
            guard_rates,
            is_crossing,
            strict=True,
        ):
            has_crossed, is_guard_curved = _classify_guard_crossing(
                start_guard_value, guard_value, guard_rate, event_search.event_step_length
            )
            is_before_event = is_before_event & ~(is_crossing_guard & has_crossed)
            is_guard_straight = is_guard_straight & ~(is_crossing_guard & is_guard_curved)
        lower_step_length_bound = jnp.where(
            is_before_event, event_search.event_step_length, event_search.lower_step_length_bound
        )
        upper_step_length_bound = jnp.where(
            is_before_event, event_search.upper_step_length_bound, event_search.event_step_length
        )
        proposed_step_length = event_search.event_step_length + time_to_event
        is_proposal_in_bracket = (
            proposed_step_length >= lower_step_length_bound - max_extrapolation_time
        ) & (proposed_step_length <= upper_step_length_bound + max_extrapolation_time)
        next_event_step_length = jnp.where(
            is_proposal_in_bracket,
            proposed_step_length,
            0.5 * (lower_step_length_bound + upper_step_length_bound),
        )
        is_at_event = (
            event_search.is_event_unresolved
            & is_proposal_in_bracket
            & (
                jnp.abs(time_to_event)
                <= jnp.where(is_guard_straight, max_short_step_duration, max_extrapolation_time)
            )
        )
        return EventSearch(
            event_step_length=jnp.where(
                event_search.is_event_unresolved,
                next_event_step_length,
                event_search.event_step_length,
            ),
            lower_step_length_bound=lower_step_length_bound,
            upper_step_length_bound=upper_step_length_bound,
            is_event_unresolved=event_search.is_event_unresolved & ~is_at_event,
            end_state=select_trees_by_condition(is_at_event, step_end, event_search.end_state),
            remaining_time_to_event=jnp.where(
                is_at_event, time_to_event, event_search.remaining_time_to_event
            ),
            guard_index=jnp.where(is_at_event, guard_index, event_search.guard_index),
            n_tried_steps=event_search.n_tried_steps + event_search.is_event_unresolved,
            n_iterations=event_search.n_iterations + 1,
        )

    first_crossing_fraction = jnp.ones_like(step_length)
    stage_values_by_guard = zip(
        guard_crossing_step.start_guard_values,
        guard_crossing_step.middle_guard_values,
        guard_crossing_step.end_guard_values,
        strict=True,
    )
    for is_crossing_guard, crossing_values in zip(is_crossing, stage_values_by_guard, strict=True):
        fraction_to_zero = _find_parabola_zero(tableau, is_crossing_guard, *crossing_values)
        first_crossing_fraction = jnp.where(
            is_crossing_guard,
            jnp.minimum(first_crossing_fraction, fraction_to_zero),
            first_crossing_fraction,
        )
    initial_indices, zero_duration = (
        jnp.zeros(step_length.shape, jnp.int32),
        jnp.zeros_like(step_length),
    )
    initial_count = jnp.zeros((), jnp.int32)
    initial_search = EventSearch(
        step_length * first_crossing_fraction,
        zero_duration,
        step_length,
        guard_crossing_step.has_guard_crossed,
        guard_crossing_step.start_state,
        zero_duration,
        initial_indices,
        initial_indices,
        initial_count,
    )
    needs_iteration = lambda event_search: (
        jnp.any(event_search.is_event_unresolved)
        & (event_search.n_iterations < options.max_event_iterations)
    )
    search_result = lax.while_loop(needs_iteration, improve_event_search, initial_search)

    return _refine_event_location(
        evaluate_guards,
        evaluate_acceleration,
        guard_crossing_step,
        search_result,
        (max_extrapolation_time, max_short_step_duration),
        options,
    )


def _refine_event_location(
    evaluate_guards: Callable[[StageState], Vector],
    evaluate_acceleration: EvaluateAcceleration,
    guard_crossing_step: GuardCrossingStep,
    event_search: EventSearch,
    extrapolation_and_step_limits: tuple[Array, Array],
    options: StepOptions,
) -> EventSearch:
    """Return the search result after short solver steps of low order from a state near the event.

    - `extrapolation_and_step_limits`: largest time of the linear extrapolation, and largest length
      of a short solver step, s.

    One short solver step suffices unless a guard grazes zero. The event stays unresolved if
    Newton's method diverges.
    """
    max_extrapolation_time, max_short_step_duration = extrapolation_and_step_limits
    # During a thousandth of a solver step, a method of order 3 is accurate to round-off.
    low_order_tableau = load_explicit_tableau("Bosh3")
    assert low_order_tableau is not None

    def can_take_short_solver_step(
        is_event_distant: Array, remaining_time_to_event: Array
    ) -> Array:
        return is_event_distant & (jnp.abs(remaining_time_to_event) <= max_short_step_duration)

    def take_short_solver_step(loop_carry: tuple) -> tuple:
        (
            step_end,
            remaining_time_to_event,
            short_solver_step_length,
            guard_index,
            is_event_distant,
            n_iterations,
        ) = loop_carry
        is_short_solver_step_taken = can_take_short_solver_step(
            is_event_distant, remaining_time_to_event
        )
        step_end = select_trees_by_condition(
            is_short_solver_step_taken,
            take_rk_step(
                low_order_tableau,
                evaluate_acceleration,
                step_end,
                remaining_time_to_event,
                computes_error_estimate=False,
            ).end_state,
            step_end,
        )
        new_remaining_time_to_event, earliest_guard_index = _propose_earliest_event(
            *evaluate_with_rates(evaluate_guards, evaluate_acceleration, step_end),
            guard_crossing_step.crossing_guard_bits,
        )
        remaining_time_to_event = jnp.where(
            is_short_solver_step_taken, new_remaining_time_to_event, remaining_time_to_event
        )
        short_solver_step_length = jnp.where(
            can_take_short_solver_step(is_short_solver_step_taken, new_remaining_time_to_event),
            short_solver_step_length + new_remaining_time_to_event,
            short_solver_step_length,
        )
        guard_index = jnp.where(is_short_solver_step_taken, earliest_guard_index, guard_index)
        return (
            step_end,
            remaining_time_to_event,
            short_solver_step_length,
            guard_index,
            is_event_distant & (jnp.abs(remaining_time_to_event) > max_extrapolation_time),
            n_iterations + 1,
        )

    is_event_distant = (
        guard_crossing_step.has_guard_crossed
        & ~event_search.is_event_unresolved
        & (jnp.abs(event_search.remaining_time_to_event) > max_extrapolation_time)
    )
    initial_loop_carry = (
        event_search.end_state,
        event_search.remaining_time_to_event,
        event_search.event_step_length,
        event_search.guard_index,
        is_event_distant,
        jnp.zeros((), jnp.int32),
    )
    needs_iteration = lambda loop_carry: (
        jnp.any(can_take_short_solver_step(loop_carry[4], loop_carry[1]))
        & (loop_carry[5] < options.max_event_iterations)
    )
    (
        event_state,
        remaining_time_to_event,
        short_solver_step_length,
        guard_index,
        is_event_distant,
        _,
    ) = lax.while_loop(needs_iteration, take_short_solver_step, initial_loop_carry)
    q = tuple(
        x + remaining_time_to_event * y for x, y in zip(event_state.q, event_state.v, strict=True)
    )
    v = tuple(
        x + remaining_time_to_event * y
        for x, y in zip(event_state.v, event_state.acceleration.acceleration, strict=False)
    )
    event_state = select_trees_by_condition(
        is_event_distant, guard_crossing_step.start_state, event_state._replace(q=q, v=v)
    )
    return event_search._replace(
        event_step_length=short_solver_step_length,
        is_event_unresolved=event_search.is_event_unresolved | is_event_distant,
        end_state=event_state,
        guard_index=guard_index,
    )


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
    guard_values: Vector, guard_rates: Vector, crossing_guard_bits: Array
) -> tuple[Array, Array]:
    """Return the time to the earliest event, s, by one Newton step, and the guard's index.

    The time is negative if the event is earlier than the present state. It is minus infinity for a
    guard that is negative and rises, because this guard crossed zero at an unknown earlier time.
    `crossing_guard_bits` has bit i set if guard i crosses zero.
    """
    time_to_event = jnp.full_like(guard_values[0], jnp.inf)
    guard_index = jnp.zeros_like(crossing_guard_bits)
    for candidate_guard_index, (guard_value, guard_rate) in enumerate(
        zip(guard_values, guard_rates, strict=True)
    ):
        guard_zero_time = _compute_time_to_zero(
            (crossing_guard_bits >> candidate_guard_index) & 1 == 1, guard_value, guard_rate
        )
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
