"""Location of the earliest zero of the guards within a solver step, for a batch."""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from vrw_jax.integrator.minima import values_and_rates
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
    """Solver steps within which guards cross zero."""

    start: StageState  # at the start of the step
    start_values: Vector  # of the guards at the start
    middle_values: Vector  # at the tableau's stage `middle`
    end_values: Vector  # at the end
    length: Array
    crossing_bits: Array  # bits of the guards that cross
    has_crossed: Array  # batch elements with such a step


class EventSearch(NamedTuple):
    """State and result of the event search."""

    length: Array  # of the next try, or of the event once it is found
    lower_bound: Array
    upper_bound: Array
    is_unresolved: Array
    end: StageState
    remaining_time: Array  # from `end` to the event, by Newton's method
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
    """Return the earliest event inside each crossing step, by Newton's method on the step's length.

    The first try is the crossing of the guards' parabolas. Every guard that crossed proposes its
    own time and the earliest proposal is taken, inside a bracket that bisection shrinks. Once a
    proposal is near, and no guard is too curved for Newton's method, a short step of low order
    reaches it; the remainder is an extrapolation along the state's rate.
    """
    h, root_rtol = step.length, jnp.sqrt(options.rtol)
    linear_limit, short_step_limit = 0.1 * root_rtol * h, 0.3 * jnp.sqrt(root_rtol) * h
    is_crossing = [(step.crossing_bits >> i) & 1 == 1 for i in range(len(step.start_values))]

    def improve(search: EventSearch) -> EventSearch:
        end = step_function(step.start, search.length).end
        values, rates = values_and_rates(guards, evaluate, end)
        change, guard = _propose_earliest(values, rates, step.crossing_bits)
        is_before_event, is_straight = jnp.ones(h.shape, bool), jnp.ones(h.shape, bool)
        for g0, g, rate, is_crossing_guard in zip(
            step.start_values, values, rates, is_crossing, strict=True
        ):
            is_past, is_curved = _is_past_or_curved(g0, g, rate, search.length)
            is_before_event = is_before_event & ~(is_crossing_guard & is_past)
            is_straight = is_straight & ~(is_crossing_guard & is_curved)
        low = jnp.where(is_before_event, search.length, search.lower_bound)
        high = jnp.where(is_before_event, search.upper_bound, search.length)
        proposal = search.length + change
        is_inside = (proposal >= low - linear_limit) & (proposal <= high + linear_limit)
        length = jnp.where(is_inside, proposal, 0.5 * (low + high))
        has_arrived = (
            search.is_unresolved
            & is_inside
            & (jnp.abs(change) <= jnp.where(is_straight, short_step_limit, linear_limit))
        )
        return EventSearch(
            length=jnp.where(search.is_unresolved, length, search.length),
            lower_bound=low,
            upper_bound=high,
            is_unresolved=search.is_unresolved & ~has_arrived,
            end=tree_where(has_arrived, end, search.end),
            remaining_time=jnp.where(has_arrived, change, search.remaining_time),
            guard=jnp.where(has_arrived, guard, search.guard),
            n_tried_steps=search.n_tried_steps + search.is_unresolved,
            n_iterations=search.n_iterations + 1,
        )

    first_fraction = jnp.ones_like(h)
    values_by_guard = zip(step.start_values, step.middle_values, step.end_values, strict=True)
    for is_crossing_guard, values in zip(is_crossing, values_by_guard, strict=True):
        fraction = _parabola_zero(tableau, is_crossing_guard, *values)
        first_fraction = jnp.where(
            is_crossing_guard, jnp.minimum(first_fraction, fraction), first_fraction
        )
    zero_index, zero = jnp.zeros(h.shape, jnp.int32), jnp.zeros_like(h)
    count = jnp.zeros((), jnp.int32)
    start = EventSearch(
        h * first_fraction,
        zero,
        h,
        step.has_crossed,
        step.start,
        zero,
        zero_index,
        zero_index,
        count,
    )
    needs_iteration = lambda search: (
        jnp.any(search.is_unresolved) & (search.n_iterations < options.max_event_iterations)
    )
    search_result = lax.while_loop(needs_iteration, improve, start)

    return _refine_event(
        guards, evaluate, step, search_result, (linear_limit, short_step_limit), options
    )


def _refine_event(
    guards: Callable[[StageState], Vector],
    evaluate: AccelerationFn,
    step: CrossingStep,
    search: EventSearch,
    limits: tuple[Array, Array],
    options: StepOptions,
) -> EventSearch:
    """Return the event from a state near it, by short steps of low order.

    One step suffices, except for guards that graze zero; the event stays unresolved if Newton's
    method diverges. `limits`: the largest time left to the extrapolation, and the largest time of a
    short step, s.
    """
    linear_limit, short_step_limit = limits
    # Over a thousandth of a step, a method of order 3 is exact to round-off.
    low_order_tableau = load_explicit_tableau("Bosh3")
    assert low_order_tableau is not None

    def can_step(is_distant: Array, remaining_time: Array) -> Array:
        return is_distant & (jnp.abs(remaining_time) <= short_step_limit)

    def take_short_step(carry: tuple) -> tuple:
        end, remaining_time, length, guard, is_distant, n_iterations = carry
        is_moving = can_step(is_distant, remaining_time)
        end = tree_where(
            is_moving,
            rk_step(low_order_tableau, evaluate, end, remaining_time, with_error=False).end,
            end,
        )
        time_left, earliest_guard = _propose_earliest(
            *values_and_rates(guards, evaluate, end), step.crossing_bits
        )
        remaining_time = jnp.where(is_moving, time_left, remaining_time)
        length = jnp.where(can_step(is_moving, time_left), length + time_left, length)
        guard = jnp.where(is_moving, earliest_guard, guard)
        return (
            end,
            remaining_time,
            length,
            guard,
            is_distant & (jnp.abs(remaining_time) > linear_limit),
            n_iterations + 1,
        )

    is_distant = (
        step.has_crossed & ~search.is_unresolved & (jnp.abs(search.remaining_time) > linear_limit)
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
    end, remaining_time, length, guard, is_distant, _ = lax.while_loop(
        needs_iteration, take_short_step, initial_carry
    )
    q = tuple(x + remaining_time * y for x, y in zip(end.q, end.v, strict=True))
    v = tuple(
        x + remaining_time * y for x, y in zip(end.v, end.acceleration.acceleration, strict=False)
    )
    end = tree_where(is_distant, step.start, end._replace(q=q, v=v))
    return search._replace(
        length=length, is_unresolved=search.is_unresolved | is_distant, end=end, guard=guard
    )


@jax.jit  # traced once, for whichever guard
def _is_past_or_curved(start: Array, g: Array, rate: Array, length: Array) -> tuple[Array, Array]:
    """Return whether a guard has crossed, and whether it is too curved for Newton's
    method alone.
    """
    is_past = (g < 0.0) | ((g == 0.0) & (rate <= 0.0))  # a guard that rises from zero is not past
    fall = rate * length
    return is_past, jnp.abs(2.0 * (start - g + fall) * g) > 0.25 * fall * fall


def _propose_earliest(values: Vector, rates: Vector, crossing_bits: Array) -> tuple[Array, Array]:
    """Return the time to the earliest event proposed by a crossing guard, and the index of that
    guard.

    A guard that rises below zero has crossed at an unknown earlier time, which counts as minus
    infinity.
    """
    change = jnp.full_like(values[0], jnp.inf)
    guard = jnp.zeros_like(crossing_bits)
    for index, (g, rate) in enumerate(zip(values, rates, strict=True)):
        guard_time = _time_to_zero((crossing_bits >> index) & 1 == 1, g, rate)
        guard = jnp.where(guard_time < change, index, guard)
        change = jnp.minimum(guard_time, change)
    return change, guard


@jax.jit  # traced once, for whichever guard
def _time_to_zero(is_crossing: Array, g: Array, rate: Array) -> Array:
    """Return the time to a guard's zero along its tangent, infinite if the guard does not cross."""
    is_falling = is_crossing & (rate < 0.0)
    unknown = jnp.where(is_crossing & (g < 0.0), -jnp.inf, jnp.inf)
    return jnp.where(is_falling, -g / jnp.where(is_falling, rate, -1.0), unknown)


@functools.partial(jax.jit, static_argnums=0)  # traced once, for whichever guard
def _parabola_zero(
    tableau: ButcherTableau, is_crossing: Array, g0: Array, gm: Array, g1: Array
) -> Array:
    """Return the fraction of the step to the zero of a guard's parabola.

    The zero is found by the secant, then by Newton's method.
    """
    curvature, linear_rate = fit_guard_parabola(tableau, g0, gm, g1)
    fall = jnp.where(is_crossing & (g0 > g1), g0 - g1, 1.0)
    fraction = jnp.clip(g0 / fall, 0.0, 1.0)
    # A guard that rises from zero vanishes at the start of the step: the other root counts.
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
