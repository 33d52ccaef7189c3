"""Location of the earliest zero of the guards within a solver step, for each batch element."""

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
    rk_step,
)
from vrw_jax.numerics import StepOptions, Vector, select_tree_leaves


class CrossingStep(NamedTuple):
    """Solver steps of a batch, within some of which guards cross zero."""

    start: StageState  # state at the start of the step
    start_values: Vector  # guards at the start of the step
    middle_values: Vector  # guards at the tableau's stage `middle_stage`
    end_values: Vector  # guards at the end of the step
    length: Array
    crossing_bits: Array  # bit i is set if guard i crosses
    has_crossed: Array  # whether the step of this batch element contains a crossing


class EventSearch(NamedTuple):
    """State and result of the event search, for each batch element."""

    length: Array  # length of the next try, or of the event once it is found, s
    lower_bound: Array
    upper_bound: Array
    is_unresolved: Array
    end: StageState
    remaining_time: Array  # from `end` to the event, by Newton's method, s
    guard: Array
    n_tried_steps: Array
    n_iterations: Array


def locate_event(
    guards: Callable[[StageState], Vector],
    evaluate_acceleration: EvaluateAcceleration,
    step_function: TakeStep,
    tableau: ButcherTableau,
    crossing_step: CrossingStep,
    options: StepOptions,
) -> EventSearch:
    """Return the earliest event inside each crossing step, found by Newton's method on the step's
    length.

    The first try is the zero of the parabola through each crossing guard. Every crossing guard then
    proposes a time, and the earliest proposal inside the bracket is taken; otherwise bisection
    shrinks the bracket. Once a proposal is near, and no guard is too curved for Newton's method, a
    short step of low order reaches it. The remaining time is bridged by extrapolation along the
    state's rate.
    """
    step_length, event_time_rtol = crossing_step.length, jnp.sqrt(options.rtol)
    max_extrapolation_time, max_short_step_time = (
        0.1 * event_time_rtol * step_length,
        0.3 * jnp.sqrt(event_time_rtol) * step_length,
    )
    is_crossing = [
        (crossing_step.crossing_bits >> i) & 1 == 1 for i in range(len(crossing_step.start_values))
    ]

    def improve_search(event_search: EventSearch) -> EventSearch:
        step_end = step_function(crossing_step.start, event_search.length).end
        guard_values, guard_rates = evaluate_with_rates(guards, evaluate_acceleration, step_end)
        time_change, guard_index = _propose_earliest_event(
            guard_values, guard_rates, crossing_step.crossing_bits
        )
        is_before_event, is_guard_straight = (
            jnp.ones(step_length.shape, bool),
            jnp.ones(step_length.shape, bool),
        )
        for earliest_start_value, earliest_value, earliest_rate, is_crossing_guard in zip(
            crossing_step.start_values, guard_values, guard_rates, is_crossing, strict=True
        ):
            has_crossed, is_curved = _needs_bracketing(
                earliest_start_value, earliest_value, earliest_rate, event_search.length
            )
            is_before_event = is_before_event & ~(is_crossing_guard & has_crossed)
            is_guard_straight = is_guard_straight & ~(is_crossing_guard & is_curved)
        lower_bound = jnp.where(is_before_event, event_search.length, event_search.lower_bound)
        upper_bound = jnp.where(is_before_event, event_search.upper_bound, event_search.length)
        proposed_length = event_search.length + time_change
        is_proposal_inside = (proposed_length >= lower_bound - max_extrapolation_time) & (
            proposed_length <= upper_bound + max_extrapolation_time
        )
        length = jnp.where(is_proposal_inside, proposed_length, 0.5 * (lower_bound + upper_bound))
        has_arrived = (
            event_search.is_unresolved
            & is_proposal_inside
            & (
                jnp.abs(time_change)
                <= jnp.where(is_guard_straight, max_short_step_time, max_extrapolation_time)
            )
        )
        return EventSearch(
            length=jnp.where(event_search.is_unresolved, length, event_search.length),
            lower_bound=lower_bound,
            upper_bound=upper_bound,
            is_unresolved=event_search.is_unresolved & ~has_arrived,
            end=select_tree_leaves(has_arrived, step_end, event_search.end),
            remaining_time=jnp.where(has_arrived, time_change, event_search.remaining_time),
            guard=jnp.where(has_arrived, guard_index, event_search.guard),
            n_tried_steps=event_search.n_tried_steps + event_search.is_unresolved,
            n_iterations=event_search.n_iterations + 1,
        )

    first_event_fraction = jnp.ones_like(step_length)
    values_by_guard = zip(
        crossing_step.start_values,
        crossing_step.middle_values,
        crossing_step.end_values,
        strict=True,
    )
    for is_crossing_guard, crossing_values in zip(is_crossing, values_by_guard, strict=True):
        zero_fraction = _find_parabola_zero(tableau, is_crossing_guard, *crossing_values)
        first_event_fraction = jnp.where(
            is_crossing_guard,
            jnp.minimum(first_event_fraction, zero_fraction),
            first_event_fraction,
        )
    zero_indices, zero_time = jnp.zeros(step_length.shape, jnp.int32), jnp.zeros_like(step_length)
    zero_count = jnp.zeros((), jnp.int32)
    initial_search = EventSearch(
        step_length * first_event_fraction,
        zero_time,
        step_length,
        crossing_step.has_crossed,
        crossing_step.start,
        zero_time,
        zero_indices,
        zero_indices,
        zero_count,
    )
    needs_iteration = lambda event_search: (
        jnp.any(event_search.is_unresolved)
        & (event_search.n_iterations < options.max_event_iterations)
    )
    search_result = lax.while_loop(needs_iteration, improve_search, initial_search)

    return _refine_event_location(
        guards,
        evaluate_acceleration,
        crossing_step,
        search_result,
        (max_extrapolation_time, max_short_step_time),
        options,
    )


def _refine_event_location(
    guards: Callable[[StageState], Vector],
    evaluate_acceleration: EvaluateAcceleration,
    crossing_step: CrossingStep,
    event_search: EventSearch,
    step_time_limits: tuple[Array, Array],
    options: StepOptions,
) -> EventSearch:
    """Return the search with its event located by short steps of low order from a state near it.

    `step_time_limits` are the largest time bridged by extrapolation, and the largest length of a
    short step, s. One step suffices, except for guards that graze zero. The event stays unresolved
    if Newton's method diverges.
    """
    max_extrapolation_time, max_short_step_time = step_time_limits
    # Over a thousandth of a step, a method of order 3 is accurate to round-off.
    low_order_tableau = load_explicit_tableau("Bosh3")
    assert low_order_tableau is not None

    def can_step(is_distant: Array, remaining_time: Array) -> Array:
        return is_distant & (jnp.abs(remaining_time) <= max_short_step_time)

    def take_short_step(loop_carry: tuple) -> tuple:
        step_end, remaining_time, length, guard_index, is_distant, n_iterations = loop_carry
        takes_short_step = can_step(is_distant, remaining_time)
        step_end = select_tree_leaves(
            takes_short_step,
            rk_step(
                low_order_tableau, evaluate_acceleration, step_end, remaining_time, with_error=False
            ).end,
            step_end,
        )
        new_remaining_time, earliest_guard = _propose_earliest_event(
            *evaluate_with_rates(guards, evaluate_acceleration, step_end),
            crossing_step.crossing_bits,
        )
        remaining_time = jnp.where(takes_short_step, new_remaining_time, remaining_time)
        length = jnp.where(
            can_step(takes_short_step, new_remaining_time), length + new_remaining_time, length
        )
        guard_index = jnp.where(takes_short_step, earliest_guard, guard_index)
        return (
            step_end,
            remaining_time,
            length,
            guard_index,
            is_distant & (jnp.abs(remaining_time) > max_extrapolation_time),
            n_iterations + 1,
        )

    is_distant = (
        crossing_step.has_crossed
        & ~event_search.is_unresolved
        & (jnp.abs(event_search.remaining_time) > max_extrapolation_time)
    )
    initial_carry = (
        event_search.end,
        event_search.remaining_time,
        event_search.length,
        event_search.guard,
        is_distant,
        jnp.zeros((), jnp.int32),
    )
    needs_iteration = lambda loop_carry: (
        jnp.any(can_step(loop_carry[4], loop_carry[1]))
        & (loop_carry[5] < options.max_event_iterations)
    )
    end, remaining_time, length, guard_index, is_distant, _ = lax.while_loop(
        needs_iteration, take_short_step, initial_carry
    )
    q = tuple(x + remaining_time * y for x, y in zip(end.q, end.v, strict=True))
    v = tuple(
        x + remaining_time * y for x, y in zip(end.v, end.acceleration.acceleration, strict=False)
    )
    end = select_tree_leaves(is_distant, crossing_step.start, end._replace(q=q, v=v))
    return event_search._replace(
        length=length,
        is_unresolved=event_search.is_unresolved | is_distant,
        end=end,
        guard=guard_index,
    )


@jax.jit  # The function is traced once for all guards.
def _needs_bracketing(
    start_guard_value: Array, guard_value: Array, guard_rate: Array, length: Array
) -> tuple[Array, Array]:
    """Return whether a guard has crossed zero, and whether it is too curved for Newton's method
    alone.

    `guard_value` and `guard_rate` are the guard and its rate after `length`. `start_guard_value` is
    the guard at the start of the step.
    """
    # A guard that rises from zero has not crossed.
    has_crossed = (guard_value < 0.0) | ((guard_value == 0.0) & (guard_rate <= 0.0))
    linear_decrease = guard_rate * length
    return has_crossed, jnp.abs(
        2.0 * (start_guard_value - guard_value + linear_decrease) * guard_value
    ) > 0.25 * linear_decrease * linear_decrease


def _propose_earliest_event(
    guard_values: Vector, guard_rates: Vector, crossing_bits: Array
) -> tuple[Array, Array]:
    """Return the time to the earliest event that a crossing guard proposes, s, and that guard's
    index.

    A guard that rises below zero has crossed at an unknown earlier time, which counts as minus
    infinity.
    """
    time_change = jnp.full_like(guard_values[0], jnp.inf)
    guard_index = jnp.zeros_like(crossing_bits)
    for guard_number, (g, guard_rate) in enumerate(zip(guard_values, guard_rates, strict=True)):
        guard_time = _compute_time_to_zero((crossing_bits >> guard_number) & 1 == 1, g, guard_rate)
        guard_index = jnp.where(guard_time < time_change, guard_number, guard_index)
        time_change = jnp.minimum(guard_time, time_change)
    return time_change, guard_index


@jax.jit  # The function is traced once for all guards.
def _compute_time_to_zero(is_crossing: Array, g: Array, guard_rate: Array) -> Array:
    """Return the time to the zero of a guard's tangent line, s; infinity if the guard does not
    cross.
    """
    is_falling = is_crossing & (guard_rate < 0.0)
    time_if_not_falling = jnp.where(is_crossing & (g < 0.0), -jnp.inf, jnp.inf)
    return jnp.where(is_falling, -g / jnp.where(is_falling, guard_rate, -1.0), time_if_not_falling)


@functools.partial(jax.jit, static_argnums=0)  # The function is traced once for all guards.
def _find_parabola_zero(
    tableau: ButcherTableau, is_crossing: Array, g0: Array, gm: Array, g1: Array
) -> Array:
    """Return the zero of the parabola through three values of a guard, as a fraction of the step.

    The values are those at the start, at the middle stage and at the end. The zero is found by the
    secant, then by Newton's method.
    """
    curvature, linear_rate = fit_guard_parabola(tableau, g0, gm, g1)
    guard_fall = jnp.where(is_crossing & (g0 > g1), g0 - g1, 1.0)
    zero_fraction = jnp.clip(g0 / guard_fall, 0.0, 1.0)
    # A guard that rises from zero vanishes at the start of the step, so the other root is returned.
    is_rising = is_crossing & (g0 == 0.0) & (linear_rate > 0.0)
    zero_fraction = jnp.where(
        is_rising,
        jnp.clip(-linear_rate / jnp.where(is_rising, curvature, -1.0), 0.0, 1.0),
        zero_fraction,
    )
    for _ in range(3):
        parabola_rate = linear_rate + 2.0 * curvature * zero_fraction
        is_falling = parabola_rate < 0.0
        fraction_change = (
            g0 + zero_fraction * (linear_rate + curvature * zero_fraction)
        ) / jnp.where(is_falling, parabola_rate, 1.0)
        zero_fraction = jnp.where(
            is_falling, jnp.clip(zero_fraction - fraction_change, 0.0, 1.0), zero_fraction
        )
    return zero_fraction
