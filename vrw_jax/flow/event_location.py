"""Locate the earliest root of the guards inside a solver step, for each batch element."""

from collections.abc import Callable
from enum import IntEnum
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from vrw_jax.base.elementwise import select_trees_by_condition
from vrw_jax.base.options import StepOptions
from vrw_jax.flow.extrema import MarginMinimaState
from vrw_jax.flow.solver_steps import (
    BatchPhase,
    ButcherTableau,
    SolverStepFunction,
    StageState,
    load_explicit_tableau,
    take_rk_step,
)
from vrw_jax.lanes.batching import make_zeros_like_output


class IntegrationStatus(IntEnum):
    """Status of a batch element in the integration loop."""

    RUNNING = 0
    TIMED_OUT = 1
    FAILED = 2
    CROSSED = 3  # The last tried step crosses a guard.
    IDLE = 4  # The element is inactive, or its start is already an event.
    PAUSED = 5  # The element waits for others that take their last solver step.


class IntegratorState(NamedTuple):
    """State of the integration loop for each batch element."""

    state: StageState
    guard_values: Array  # guards at `state`, (guards, batch)
    next_step_length: Array
    elapsed_time: Array
    integration_status: Array  # an IntegrationStatus, after the last tried step
    middle_guard_values: Array  # guards at the middle stage of the last tried step
    end_guard_values: Array
    n_tried_steps: Array
    # number of iterations after which half of the batch had ended
    n_iterations_until_half_ended: Array
    n_iterations: Array
    margin_minima_state: MarginMinimaState | None
    state_tangents: (
        Array | None
    )  # tangents of the state, (directions, components, batch), see `tangents`
    is_arriving: Array | None = None  # whether the next solver step ends at the located event

    @property
    def is_running(self) -> Array:
        """Return whether each batch element needs more solver steps."""
        return self.integration_status == IntegrationStatus.RUNNING

    @property
    def has_guard_crossed(self) -> Array:
        """Return whether the last tried step of each batch element crosses a guard."""
        return self.integration_status == IntegrationStatus.CROSSED


def make_idle_state(
    start_state: StageState, guard_values: Array, initial_dt: Array
) -> IntegratorState:
    """Return the state of the loop before the first solver step, in which no element runs."""
    counts, count = jnp.zeros(initial_dt.shape, jnp.int32), jnp.zeros((), jnp.int32)
    return IntegratorState(
        state=start_state,
        guard_values=guard_values,
        next_step_length=initial_dt,
        elapsed_time=jnp.zeros_like(initial_dt),
        integration_status=counts + IntegrationStatus.IDLE,
        middle_guard_values=guard_values,
        end_guard_values=guard_values,
        n_tried_steps=counts,
        n_iterations_until_half_ended=count,
        n_iterations=count,
        margin_minima_state=None,
        state_tangents=None,
    )


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
    correction: Array | None  # change of the step length by the last iteration, s

    @classmethod
    def begin(
        cls, step_start: IntegratorState, event_step_length: Array, is_exact: bool
    ) -> "EventSearch":
        """Return a search before its first iteration, with a first length of the solver step."""
        initial_indices = jnp.zeros(event_step_length.shape, jnp.int32)
        zero_duration = jnp.zeros_like(event_step_length)
        return cls(
            event_step_length,
            zero_duration,
            step_start.next_step_length,
            step_start.has_guard_crossed,
            step_start.state,
            zero_duration,
            initial_indices,
            initial_indices,
            jnp.zeros((), jnp.int32),
            zero_duration + jnp.inf if is_exact else None,
        )


EVENT_TIME_ACCURACY = 1e-8
"""Largest correction of an exact event's time that ends the search.

The correction is relative to the time since the phase began. The value is chosen because the state
is extrapolated linearly over the correction, with an error of its square, which is round-off.
"""
STALLED_CORRECTION_RATIO = 0.9
"""Ratio of successive corrections of the event's time above which a correction is round-off.

The value is chosen because Newton's method halves the corrections, or reduces them to two thirds at
a triple root. Round-off does neither.
"""
GUARD_ROUNDOFF_IN_EPS = 32.0
"""Largest round-off error of a guard, in units of the machine epsilon times the guard's scale.

The value is chosen because a guard is a sum of several terms, each with its own round-off.
"""


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
    remaining time. A phase with `has_exact_events` takes no short step.
    """
    step_length = integrator_state.next_step_length
    end_time = integrator_state.elapsed_time + step_length
    event_time_rtol, max_correction = jnp.sqrt(options.rtol), phase.max_event_correction
    locator = _EventLocator(
        phase,
        solver_step_function,
        tableau,
        integrator_state,
        options,
        is_crossing=integrator_state.end_guard_values <= 0.0,
        max_extrapolation_time=jnp.maximum(
            (options.rtol if max_correction is None else max_correction) * step_length,
            1e3 * jnp.finfo(end_time.dtype).eps * end_time,
        )
        if phase.has_exact_events
        else 0.1 * event_time_rtol * step_length,
        max_short_step_duration=0.3 * jnp.sqrt(event_time_rtol) * step_length,
    )
    needs_iteration = lambda search: (
        jnp.any(search.is_event_unresolved) & (search.n_iterations < options.max_event_iterations)
    )
    search = lax.while_loop(needs_iteration, locator.iterate, locator.begin())
    is_failed = search.is_event_unresolved
    if not phase.has_exact_events:
        search = locator.take_short_steps(search)
    extrapolate = lambda x, y: x + search.remaining_time_to_event * y
    event_state = search.end_state
    event_state = event_state._replace(
        q=jax.tree.map(extrapolate, event_state.q, event_state.v[: len(event_state.q)]),
        v=jax.tree.map(
            extrapolate,
            event_state.v,
            event_state.acceleration.acceleration[: len(event_state.v)],
        ),
    )
    return search._replace(
        is_event_unresolved=is_failed | search.is_event_unresolved,
        end_state=select_trees_by_condition(
            search.is_event_unresolved, integrator_state.state, event_state
        ),
    )


class _EventLocator(NamedTuple):
    """Iterations of `locate_event`, whose arguments are the first fields."""

    phase: BatchPhase
    take_solver_step: SolverStepFunction
    tableau: ButcherTableau
    step_start: IntegratorState
    options: StepOptions
    is_crossing: Array  # whether each guard crosses zero in the solver step
    max_extrapolation_time: Array  # longest time to the event that ends the search, s
    max_short_step_duration: Array  # s

    def begin(self) -> EventSearch:
        """Return the search before its first iteration."""
        step_start, middle_node = self.step_start, self.tableau.middle_node
        start_guard_value, middle_guard_value, end_guard_value = (
            step_start.guard_values,
            step_start.middle_guard_values,
            step_start.end_guard_values,
        )
        # The parabola of each guard passes through its values at the start, at the middle stage and
        # at the end. The secant method, followed by Newton's method, locates its root.
        secant_rate = (middle_guard_value - start_guard_value) / middle_node
        quadratic_coefficient = (end_guard_value - start_guard_value - secant_rate) / (
            1.0 - middle_node
        )
        linear_coefficient = end_guard_value - start_guard_value - quadratic_coefficient
        guard_decrease = jnp.where(
            self.is_crossing & (start_guard_value > end_guard_value),
            start_guard_value - end_guard_value,
            1.0,
        )
        fraction_to_zero = jnp.clip(start_guard_value / guard_decrease, 0.0, 1.0)
        # A guard that rises from zero vanishes at the start of the step: the other root counts.
        is_guard_rising = self.is_crossing & (linear_coefficient > 0.0)
        if self.phase.guards_rising_at_start is None:
            is_guard_rising = is_guard_rising & (start_guard_value == 0.0)
        fraction_to_zero = jnp.where(
            is_guard_rising,
            jnp.clip(
                -linear_coefficient / jnp.where(is_guard_rising, quadratic_coefficient, -1.0),
                0.0,
                1.0,
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
        first_crossing_fraction = jnp.min(
            jnp.where(self.is_crossing, fraction_to_zero, 1.0), axis=0
        )
        return EventSearch.begin(
            step_start,
            step_start.next_step_length * first_crossing_fraction,
            self.phase.has_exact_events,
        )

    def iterate(self, search: EventSearch) -> EventSearch:
        """Return the search after one more solver step."""
        step_length = search.event_step_length
        step_end = self.take_solver_step(self.step_start.state, step_length)[0][-1]
        step_end, guard_values, guard_rates = lax.stop_gradient(
            (step_end, *self.phase.evaluate_with_rates(self.phase.evaluate_guards, step_end))
        )
        time_to_event, guard_index = _propose_earliest_event(
            guard_values, guard_rates, self.is_crossing
        )
        is_before_event = ~jnp.any(
            self.is_crossing & has_guard_crossed(guard_values, guard_rates), axis=0
        )
        lower_bound = jnp.where(is_before_event, step_length, search.lower_step_length_bound)
        upper_bound = jnp.where(is_before_event, search.upper_step_length_bound, step_length)
        proposed_step_length = step_length + time_to_event
        is_proposal_in_bracket = (
            proposed_step_length >= lower_bound - self.max_extrapolation_time
        ) & (proposed_step_length <= upper_bound + self.max_extrapolation_time)
        # From an end where it has been, Newton's method would return, as at the kink of a guard.
        is_return = ((proposed_step_length <= lower_bound) & (lower_bound > 0.0)) | (
            (proposed_step_length >= upper_bound) & (upper_bound < self.step_start.next_step_length)
        )
        is_proposal_in_bracket &= ~is_return | (
            jnp.abs(time_to_event) <= self.max_extrapolation_time
        )
        bisected_length = 0.5 * (lower_bound + upper_bound)
        if self.phase.guards_rising_at_start is not None:
            # A guard that rises at the start of the phase and falls soon after it has two roots
            # there, to which Newton's method and bisections only halve the distance.
            is_near_start = lower_bound < 0.1 * upper_bound
            bisected_length = jnp.where(is_near_start, 0.125 * upper_bound, bisected_length)
            is_halving = jnp.abs(proposed_step_length - 0.5 * step_length) < 0.1 * step_length
            is_proposal_in_bracket = is_proposal_in_bracket & ~(is_near_start & is_halving)
        next_step_length = jnp.where(is_proposal_in_bracket, proposed_step_length, bisected_length)
        if self.phase.has_exact_events:
            guard_index = jnp.where(jnp.isposinf(time_to_event), -1, guard_index)
            time_to_event = next_step_length - step_length
            is_near, guard_index = self._confirm_exact_event(
                search, time_to_event, guard_index, guard_values
            )
        else:
            linear_decrease = guard_rates * step_length
            is_curved = self.is_crossing & (
                jnp.abs(
                    2.0
                    * (self.step_start.guard_values - guard_values + linear_decrease)
                    * guard_values
                )
                > 0.25 * linear_decrease * linear_decrease
            )
            # A guard that is too curved for Newton's method takes no short step.
            is_near = is_proposal_in_bracket & (
                jnp.abs(time_to_event)
                <= jnp.where(
                    jnp.any(is_curved, axis=0),
                    self.max_extrapolation_time,
                    self.max_short_step_duration,
                )
            )
        is_at_event = search.is_event_unresolved & is_near
        end_state, remaining_time_to_event, guard_index = select_trees_by_condition(
            is_at_event,
            (step_end, time_to_event, guard_index),
            (search.end_state, search.remaining_time_to_event, search.guard_index),
        )
        return EventSearch(
            event_step_length=jnp.where(search.is_event_unresolved, next_step_length, step_length),
            lower_step_length_bound=lower_bound,
            upper_step_length_bound=upper_bound,
            is_event_unresolved=search.is_event_unresolved & ~is_at_event,
            end_state=end_state,
            remaining_time_to_event=remaining_time_to_event,
            guard_index=guard_index,
            n_tried_steps=search.n_tried_steps + search.is_event_unresolved,
            n_iterations=search.n_iterations + 1,
            correction=None if search.correction is None else jnp.abs(time_to_event),
        )

    def _confirm_exact_event(
        self, search: EventSearch, time_to_event: Array, guard_index: Array, guard_values: Array
    ) -> tuple[Array, Array]:
        """Return whether an exact event is located, and the index of its guard.

        The last correction must be small compared with the solver step and with the time since the
        phase began. The second comparison is skipped if the correction is only the guard's
        round-off. A guard within round-off of its scale is at its event.

        - `guard_index`: index of the guard that proposes the event; -1 if none does.
        """
        assert search.correction is not None
        correction = jnp.abs(time_to_event)
        event_time = self.step_start.elapsed_time + search.event_step_length + time_to_event
        is_near = correction <= self.max_extrapolation_time
        if self.phase.max_event_correction is None:
            is_near = is_near & (
                (correction <= EVENT_TIME_ACCURACY * event_time)
                | (correction >= STALLED_CORRECTION_RATIO * search.correction)
            )
        scales = self.phase.guard_scales
        scaled_values = jnp.where(
            self.is_crossing, guard_values if scales is None else guard_values / scales, jnp.inf
        )
        roundoff = GUARD_ROUNDOFF_IN_EPS * jnp.finfo(guard_values.dtype).eps
        lowest = jnp.min(scaled_values, axis=0)
        is_at_roundoff = (jnp.abs(lowest) <= roundoff) & (scales is not None)
        return is_near | is_at_roundoff, jnp.where(
            is_at_roundoff | (guard_index < 0),
            find_first_guard(scaled_values == lowest, 0),
            guard_index,
        )

    def take_short_steps(self, search: EventSearch) -> EventSearch:
        """Return the search after short solver steps of low order to distant events.

        One short solver step suffices unless a guard grazes zero. The event stays unresolved if
        Newton's method diverges. A method of order 3 is accurate to round-off during a thousandth
        of a solver step.
        """
        needs_short_step = lambda search: (
            jnp.any(
                self._can_take_short_step(
                    search.is_event_unresolved, search.remaining_time_to_event
                )
            )
            & (search.n_iterations < self.options.max_event_iterations)
        )
        is_event_distant = (
            self.step_start.has_guard_crossed
            & ~search.is_event_unresolved
            & (jnp.abs(search.remaining_time_to_event) > self.max_extrapolation_time)
        )
        search = search._replace(
            is_event_unresolved=is_event_distant, n_iterations=jnp.zeros((), jnp.int32)
        )
        return lax.while_loop(needs_short_step, self._take_short_step, search)

    def _can_take_short_step(self, is_event_distant: Array, time_to_event: Array) -> Array:
        return is_event_distant & (jnp.abs(time_to_event) <= self.max_short_step_duration)

    def _take_short_step(self, search: EventSearch) -> EventSearch:
        low_order_tableau = load_explicit_tableau("Bosh3")
        assert low_order_tableau is not None
        is_step_taken = self._can_take_short_step(
            search.is_event_unresolved, search.remaining_time_to_event
        )
        short_step = take_rk_step(
            low_order_tableau,
            self.phase.evaluate_acceleration,
            search.end_state,
            search.remaining_time_to_event,
        )
        end_state = select_trees_by_condition(is_step_taken, short_step[-1], search.end_state)
        time_to_event, guard_index = _propose_earliest_event(
            *self.phase.evaluate_with_rates(self.phase.evaluate_guards, end_state),
            self.is_crossing,
        )
        remaining_time_to_event = jnp.where(
            is_step_taken, time_to_event, search.remaining_time_to_event
        )
        return search._replace(
            event_step_length=jnp.where(
                self._can_take_short_step(is_step_taken, time_to_event),
                search.event_step_length + time_to_event,
                search.event_step_length,
            ),
            is_event_unresolved=search.is_event_unresolved
            & (jnp.abs(remaining_time_to_event) > self.max_extrapolation_time),
            end_state=end_state,
            remaining_time_to_event=remaining_time_to_event,
            guard_index=jnp.where(is_step_taken, guard_index, search.guard_index),
            n_iterations=search.n_iterations + 1,
        )


def evaluate_motion_rates(state: StageState) -> Array:
    """Return the time derivatives of positions and rates, (components, batch)."""
    return jnp.stack([*state.v[: len(state.q)], *state.acceleration.acceleration[: len(state.v)]])


def has_guard_crossed(guard_value: Array, guard_rate: Array) -> Array:
    """Return whether a guard has fallen through zero: it is negative, or zero and not rising."""
    return (guard_value < 0.0) | ((guard_value == 0.0) & (guard_rate <= 0.0))


def find_first_guard(is_guard_met: Array, index_if_none: int) -> Array:
    """Return the index of the first guard whose flag is True, or `index_if_none`."""
    n_guards = len(is_guard_met)
    indices = np.arange(n_guards, dtype=np.int32).reshape(-1, *(1,) * (is_guard_met.ndim - 1))
    first_guard = jnp.min(jnp.where(is_guard_met, indices, n_guards), axis=0)
    return jnp.where(first_guard < n_guards, first_guard, index_if_none)


def _propose_earliest_event(
    guard_values: Array, guard_rates: Array, is_crossing: Array
) -> tuple[Array, Array]:
    """Return the time to the earliest event, s, by one Newton step, and the guard's index.

    The time is negative if the event is earlier than the present state. It is minus infinity for a
    guard that is negative and rises, because this guard crossed zero at an unknown earlier time.
    `is_crossing` states for each guard whether it crosses zero.
    """
    is_guard_falling = is_crossing & (guard_rates < 0.0)
    times_to_zero = jnp.where(
        is_guard_falling,
        -guard_values / jnp.where(is_guard_falling, guard_rates, -1.0),
        jnp.where(is_crossing & (guard_values < 0.0), -jnp.inf, jnp.inf),
    )
    time_to_event = jnp.min(times_to_zero, axis=0)
    return time_to_event, find_first_guard(times_to_zero == time_to_event, 0)


def find_events(
    take_steps: Callable[[IntegratorState], IntegratorState],
    locate: Callable[[IntegratorState], EventSearch],
    integrator_state: IntegratorState,
) -> tuple[IntegratorState, EventSearch]:
    """Return the state of the loop before the solver steps to the events, and the events."""
    integrator_state = take_steps(integrator_state)
    return integrator_state, locate(integrator_state)


def arrive_at_events(
    take_steps: Callable[[IntegratorState], IntegratorState],
    locate: Callable[[IntegratorState], EventSearch],
    integrator_state: IntegratorState,
) -> tuple[IntegratorState, EventSearch]:
    """Return the state of the loop after a last solver step to each event, and the events.

    A second pass through the same loop takes the last steps and propagates tangents over them, so
    that the program contains both only once.
    """

    no_count: Any = None

    def run_pass(carry: tuple) -> tuple:
        n_passes, crossing_step_length, integrator_state, event_search = carry
        integrator_state = take_steps(integrator_state)
        is_arriving: Any = integrator_state.is_arriving
        has_crossed = integrator_state.has_guard_crossed & ~is_arriving
        located = locate(integrator_state)._replace(n_iterations=no_count)
        event_search = select_trees_by_condition(has_crossed, located, event_search)
        begins_last_step = has_crossed & ~event_search.is_event_unresolved
        status = integrator_state.integration_status
        status = jnp.where(integrator_state.is_running, IntegrationStatus.PAUSED, status)
        status = jnp.where(begins_last_step, IntegrationStatus.RUNNING, status)
        step_length = integrator_state.next_step_length
        return (
            n_passes + 1,
            jnp.where(begins_last_step, step_length, crossing_step_length),
            integrator_state._replace(
                integration_status=status.astype(jnp.int32),
                next_step_length=jnp.where(
                    begins_last_step, event_search.event_step_length, step_length
                ),
                n_iterations=jnp.zeros((), jnp.int32),
                is_arriving=is_arriving | begins_last_step,
            ),
            event_search,
        )

    no_search = make_zeros_like_output(
        lambda: locate(integrator_state)._replace(n_iterations=no_count)
    )
    initial_state = integrator_state._replace(
        is_arriving=jnp.zeros_like(integrator_state.is_running)
    )
    _, crossing_step_length, integrator_state, event_search = lax.while_loop(
        lambda carry: carry[0] < 2,
        run_pass,
        (jnp.zeros((), jnp.int32), initial_state.next_step_length, initial_state, no_search),
    )
    status = integrator_state.integration_status
    has_arrived: Any = integrator_state.is_arriving
    status = jnp.where(status == IntegrationStatus.PAUSED, IntegrationStatus.RUNNING, status)
    return (
        # The search has counted the last step.
        integrator_state._replace(
            integration_status=status.astype(jnp.int32),
            next_step_length=jnp.where(
                has_arrived, crossing_step_length, integrator_state.next_step_length
            ),
            n_tried_steps=integrator_state.n_tried_steps - has_arrived,
            is_arriving=None,
        ),
        event_search._replace(
            event_step_length=jnp.where(has_arrived, 0.0, event_search.event_step_length)
        ),
    )
