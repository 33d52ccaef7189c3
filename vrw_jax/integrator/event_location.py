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
    AccelerationFn,
    ButcherTableau,
    StageState,
    StepFn,
    fit_guard_parabola,
    load_explicit_tableau,
    rk_step,
)
from vrw_jax.numerics import StepOptions, Vector, tree_where


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
    evaluate: AccelerationFn,
    step_function: StepFn,
    tableau: ButcherTableau,
    step: CrossingStep,
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
    step_length, root_rtol = step.length, jnp.sqrt(options.rtol)
    max_extrapolation_time, max_short_step_time = (
        0.1 * root_rtol * step_length,
        0.3 * jnp.sqrt(root_rtol) * step_length,
    )
    is_crossing = [(step.crossing_bits >> i) & 1 == 1 for i in range(len(step.start_values))]

    def improve_search(search: EventSearch) -> EventSearch:
        end = step_function(step.start, search.length).end
        values, rates = evaluate_with_rates(guards, evaluate, end)
        time_change, guard_index = _propose_earliest_event(values, rates, step.crossing_bits)
        is_before_event, is_straight = (
            jnp.ones(step_length.shape, bool),
            jnp.ones(step_length.shape, bool),
        )
        for start_value, value, rate, is_crossing_guard in zip(
            step.start_values, values, rates, is_crossing, strict=True
        ):
            has_crossed, is_curved = _has_crossed_or_is_curved(
                start_value, value, rate, search.length
            )
            is_before_event = is_before_event & ~(is_crossing_guard & has_crossed)
            is_straight = is_straight & ~(is_crossing_guard & is_curved)
        lower_bound = jnp.where(is_before_event, search.length, search.lower_bound)
        upper_bound = jnp.where(is_before_event, search.upper_bound, search.length)
        proposal = search.length + time_change
        is_inside = (proposal >= lower_bound - max_extrapolation_time) & (
            proposal <= upper_bound + max_extrapolation_time
        )
        length = jnp.where(is_inside, proposal, 0.5 * (lower_bound + upper_bound))
        has_arrived = (
            search.is_unresolved
            & is_inside
            & (
                jnp.abs(time_change)
                <= jnp.where(is_straight, max_short_step_time, max_extrapolation_time)
            )
        )
        return EventSearch(
            length=jnp.where(search.is_unresolved, length, search.length),
            lower_bound=lower_bound,
            upper_bound=upper_bound,
            is_unresolved=search.is_unresolved & ~has_arrived,
            end=tree_where(has_arrived, end, search.end),
            remaining_time=jnp.where(has_arrived, time_change, search.remaining_time),
            guard=jnp.where(has_arrived, guard_index, search.guard),
            n_tried_steps=search.n_tried_steps + search.is_unresolved,
            n_iterations=search.n_iterations + 1,
        )

    first_fraction = jnp.ones_like(step_length)
    values_by_guard = zip(step.start_values, step.middle_values, step.end_values, strict=True)
    for is_crossing_guard, values in zip(is_crossing, values_by_guard, strict=True):
        fraction = _parabola_zero(tableau, is_crossing_guard, *values)
        first_fraction = jnp.where(
            is_crossing_guard, jnp.minimum(first_fraction, fraction), first_fraction
        )
    zero_index, zero_time = jnp.zeros(step_length.shape, jnp.int32), jnp.zeros_like(step_length)
    zero_count = jnp.zeros((), jnp.int32)
    initial_search = EventSearch(
        step_length * first_fraction,
        zero_time,
        step_length,
        step.has_crossed,
        step.start,
        zero_time,
        zero_index,
        zero_index,
        zero_count,
    )
    needs_iteration = lambda search: (
        jnp.any(search.is_unresolved) & (search.n_iterations < options.max_event_iterations)
    )
    search_result = lax.while_loop(needs_iteration, improve_search, initial_search)

    return _refine_event(
        guards,
        evaluate,
        step,
        search_result,
        (max_extrapolation_time, max_short_step_time),
        options,
    )


def _refine_event(
    guards: Callable[[StageState], Vector],
    evaluate: AccelerationFn,
    step: CrossingStep,
    search: EventSearch,
    time_limits: tuple[Array, Array],
    options: StepOptions,
) -> EventSearch:
    """Return the search with its event located by short steps of low order from a state near it.

    `time_limits` are the largest time bridged by extrapolation, and the largest length of a short
    step, s. One step suffices, except for guards that graze zero. The event stays unresolved if
    Newton's method diverges.
    """
    max_extrapolation_time, max_short_step_time = time_limits
    # Over a thousandth of a step, a method of order 3 is accurate to round-off.
    low_order_tableau = load_explicit_tableau("Bosh3")
    assert low_order_tableau is not None

    def can_step(is_distant: Array, remaining_time: Array) -> Array:
        return is_distant & (jnp.abs(remaining_time) <= max_short_step_time)

    def take_short_step(carry: tuple) -> tuple:
        end, remaining_time, length, guard_index, is_distant, n_iterations = carry
        takes_short_step = can_step(is_distant, remaining_time)
        end = tree_where(
            takes_short_step,
            rk_step(low_order_tableau, evaluate, end, remaining_time, with_error=False).end,
            end,
        )
        new_remaining_time, earliest_guard = _propose_earliest_event(
            *evaluate_with_rates(guards, evaluate, end), step.crossing_bits
        )
        remaining_time = jnp.where(takes_short_step, new_remaining_time, remaining_time)
        length = jnp.where(
            can_step(takes_short_step, new_remaining_time), length + new_remaining_time, length
        )
        guard_index = jnp.where(takes_short_step, earliest_guard, guard_index)
        return (
            end,
            remaining_time,
            length,
            guard_index,
            is_distant & (jnp.abs(remaining_time) > max_extrapolation_time),
            n_iterations + 1,
        )

    is_distant = (
        step.has_crossed
        & ~search.is_unresolved
        & (jnp.abs(search.remaining_time) > max_extrapolation_time)
    )
    initial_carry = (
        search.end,
        search.remaining_time,
        search.length,
        search.guard,
        is_distant,
        jnp.zeros((), jnp.int32),
    )
    needs_iteration = lambda carry: (
        jnp.any(can_step(carry[4], carry[1])) & (carry[5] < options.max_event_iterations)
    )
    end, remaining_time, length, guard_index, is_distant, _ = lax.while_loop(
        needs_iteration, take_short_step, initial_carry
    )
    q = tuple(x + remaining_time * y for x, y in zip(end.q, end.v, strict=True))
    v = tuple(
        x + remaining_time * y for x, y in zip(end.v, end.acceleration.acceleration, strict=False)
    )
    end = tree_where(is_distant, step.start, end._replace(q=q, v=v))
    return search._replace(
        length=length, is_unresolved=search.is_unresolved | is_distant, end=end, guard=guard_index
    )


@jax.jit  # The function is traced once for all guards.
def _has_crossed_or_is_curved(
    start_value: Array, value: Array, rate: Array, length: Array
) -> tuple[Array, Array]:
    """Return whether a guard has crossed zero, and whether it is too curved for Newton's method
    alone.

    `value` and `rate` are the guard and its rate after `length`, and `start_value` is the guard at
    the step's start.
    """
    # A guard that rises from zero has not crossed.
    has_crossed = (value < 0.0) | ((value == 0.0) & (rate <= 0.0))
    linear_decrease = rate * length
    return has_crossed, jnp.abs(
        2.0 * (start_value - value + linear_decrease) * value
    ) > 0.25 * linear_decrease * linear_decrease


def _propose_earliest_event(
    values: Vector, rates: Vector, crossing_bits: Array
) -> tuple[Array, Array]:
    """Return the time to the earliest event that a crossing guard proposes, s, and the index of
    that guard.

    A guard that rises below zero has crossed at an unknown earlier time, which counts as minus
    infinity.
    """
    time_change = jnp.full_like(values[0], jnp.inf)
    guard_index = jnp.zeros_like(crossing_bits)
    for index, (g, rate) in enumerate(zip(values, rates, strict=True)):
        guard_time = _time_to_zero((crossing_bits >> index) & 1 == 1, g, rate)
        guard_index = jnp.where(guard_time < time_change, index, guard_index)
        time_change = jnp.minimum(guard_time, time_change)
    return time_change, guard_index


@jax.jit  # The function is traced once for all guards.
def _time_to_zero(is_crossing: Array, g: Array, rate: Array) -> Array:
    """Return the time to the zero of a guard's tangent line, s; infinity if the guard does not
    cross.
    """
    is_falling = is_crossing & (rate < 0.0)
    time_if_not_falling = jnp.where(is_crossing & (g < 0.0), -jnp.inf, jnp.inf)
    return jnp.where(is_falling, -g / jnp.where(is_falling, rate, -1.0), time_if_not_falling)


@functools.partial(jax.jit, static_argnums=0)  # The function is traced once for all guards.
def _parabola_zero(
    tableau: ButcherTableau, is_crossing: Array, g0: Array, gm: Array, g1: Array
) -> Array:
    """Return the zero of the parabola through a guard's three values, as a fraction of the step.

    The values are those at the start, at the middle stage and at the end. The zero is found by the
    secant, then by Newton's method.
    """
    curvature, linear_rate = fit_guard_parabola(tableau, g0, gm, g1)
    fall = jnp.where(is_crossing & (g0 > g1), g0 - g1, 1.0)
    fraction = jnp.clip(g0 / fall, 0.0, 1.0)
    # A guard that rises from zero vanishes at the start of the step, so the other root is returned.
    is_rising = is_crossing & (g0 == 0.0) & (linear_rate > 0.0)
    fraction = jnp.where(
        is_rising,
        jnp.clip(-linear_rate / jnp.where(is_rising, curvature, -1.0), 0.0, 1.0),
        fraction,
    )
    for _ in range(3):
        rate = linear_rate + 2.0 * curvature * fraction
        is_falling = rate < 0.0
        fraction_change = (g0 + fraction * (linear_rate + curvature * fraction)) / jnp.where(
            is_falling, rate, 1.0
        )
        fraction = jnp.where(is_falling, jnp.clip(fraction - fraction_change, 0.0, 1.0), fraction)
    return fraction
