"""Integrate one phase with diffrax from its start to its earliest event.

The solvers and the step-size controller of diffrax are called for one solver step at a time. The
state at an event therefore has the accuracy of the integrator and not of an interpolant. An
accepted solver step that brackets an event is repeated. Newton's method corrects the length of the
repeated step until the step ends at the event. Derivatives of the event's state and time follow
from the implicit function theorem, so they are accurate to the order of the solver.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from vrw_jax.base.cubic_minima import evaluate_cubic, find_cubic_minimum
from vrw_jax.base.options import StepOptions
from vrw_jax.base.types import Scalar
from vrw_jax.flow.diffrax_minima import (
    GuardsAndMargins,
    InteriorMarginMinima,
    MarginMinimumRefinement,
    SolverStepEnd,
    StateArray,
    advance_margin_minimum_refinement,
    find_guards_met_at_start,
    interpolate_by_cubics,
    is_guard_at_roundoff,
    make_empty_interior_margin_minima,
    select_entry_by_mask,
    update_interior_margin_minima,
)
from vrw_jax.lanes.batching import make_opaque_loop_condition, select_trees_by_condition

if TYPE_CHECKING:
    import diffrax

VectorField = Callable[[StateArray], StateArray]
"""Autonomous vector field of a phase: function that returns the time derivative of the state."""


class PhaseEnd(NamedTuple):
    """State at the end of a phase, duration, triggered guard, failure flags and margin minima."""

    state: StateArray
    duration: Scalar  # duration of the phase, s
    end_guard_index: Int[Array, ""]  # index of the guard that ended the phase; -1 if none did
    is_timed_out: Bool[Array, ""]
    has_integration_failed: Bool[Array, ""]
    solver_steps: Int[Array, ""]  # number of tried solver steps, accepted or not
    margin_minima: Float[Array, " n_margins"]  # minima of the margins, empty if there are none


class StepPurpose(IntEnum):
    """Purpose of the next solver step."""

    START = 0  # A step of length zero evaluates the start.
    INTEGRATION = 1
    EVENT_SEARCH = 2  # The step locates a bracketed event.
    REFINEMENT = 3  # The step refines the minimum of a margin.
    DONE = 4  # No further step is taken.


@dataclass(frozen=True)
class EventSearchOptions:
    """Options of the search for an event, and of the growth of solver steps."""

    max_solver_step_growth: float = 2.0
    """Largest ratio of the lengths of successive solver steps.

    The error estimate for a solver step far shorter than needed is round-off. A length derived from
    that estimate would grow without bound. The result for a batch element would then differ by
    1e-12 from the result for the same system alone. The value is chosen to avoid this difference,
    which is more than a hundred times the round-off.
    """
    n_required_confirming_steps: int = 3
    """Number of solver steps to the located event that must confirm the event's time.

    The value is chosen because Newton's method squares `max_confirming_time_correction` twice. The
    last step evaluates the state at the event.
    """
    max_confirming_time_correction: float = 1e-4
    """Largest correction of the event's time by a Newton iteration that confirms this time.

    The correction is relative to the duration of the phase. The value is chosen because Newton's
    method squares the correction in each of the next two iterations, to 1e-16 in the last.
    """
    min_stalled_correction_ratio: float = 0.9
    """Ratio of successive corrections of the event's time above which a correction is round-off.

    The value is chosen because Newton's method at least halves the corrections. The exception is a
    triple root, at which it reduces them to two thirds.
    """


EVENT_SEARCH_OPTIONS = EventSearchOptions()


class _EventSearch(NamedTuple):
    """State of the Newton iteration that locates the earliest event inside a solver step."""

    is_guard_crossing: Bool[Array, " n_guards"]
    lower_step_length_bound: (
        Scalar  # bracket of the event's time, s from the start of the solver step
    )
    upper_step_length_bound: Scalar
    time_tolerance: Scalar  # tolerance of the event's time, s
    n_iterations: Int[Array, ""]
    n_confirming_steps: Int[Array, ""]  # number of solver steps that confirmed the time
    last_event_time_correction: Scalar  # last correction of the event's time, s

    def propose_event_time(
        self, guard_values: Array, guard_rates: Array, step_length: Scalar
    ) -> tuple[Scalar, Array, _EventSearch]:
        """Return the earliest event time that Newton's method proposes for the crossing guards.

        The result is (time from the start of the solver step, s, index of the proposing guard,
        search with the remaining bracket).

        A proposal outside the bracket is replaced by the bracket's midpoint. The proposal has
        derivatives. After k proposals in the range of quadratic convergence, derivatives are
        accurate to order 2^k - 1.
        """
        is_guard_falling = self.is_guard_crossing & (guard_rates < 0.0)
        time_to_zero = -guard_values / jnp.where(is_guard_falling, guard_rates, -1.0)
        # A guard that rises below zero has crossed at an unknown earlier time.
        missed_event_time = jnp.where(
            self.is_guard_crossing & (guard_values < 0.0), -jnp.inf, jnp.inf
        )
        proposed_step_lengths = jnp.where(
            is_guard_falling, step_length + time_to_zero, missed_event_time
        )
        # If no crossing guard falls here, the lowest of the crossing guards is taken.
        lowest_guard_index = jnp.argmin(jnp.where(self.is_guard_crossing, guard_values, jnp.inf))
        proposing_guard_index = jnp.where(
            jnp.any(proposed_step_lengths < jnp.inf),
            jnp.argmin(proposed_step_lengths),
            lowest_guard_index,
        ).astype(jnp.int32)
        # This happens at the start of the step.
        is_guard_rising = (guard_values == 0.0) & (guard_rates > 0.0)
        is_step_before_event = jnp.all(
            jnp.where(self.is_guard_crossing, (guard_values > 0.0) | is_guard_rising, True)
        )
        lower_step_length_bound = jnp.where(
            is_step_before_event, lax.stop_gradient(step_length), self.lower_step_length_bound
        )
        upper_step_length_bound = jnp.where(
            is_step_before_event, self.upper_step_length_bound, lax.stop_gradient(step_length)
        )
        earliest_proposed_step_length = proposed_step_lengths[proposing_guard_index]
        # A proposal within round-off of a collapsed bracket counts as inside.
        is_proposal_in_bracket = (
            earliest_proposed_step_length >= lower_step_length_bound - self.time_tolerance
        ) & (earliest_proposed_step_length <= upper_step_length_bound + self.time_tolerance)
        # If round-off moves Newton's proposal out of the bracket, its derivative is still valid.
        finite_proposed_step_length = jnp.where(
            jnp.isfinite(earliest_proposed_step_length), earliest_proposed_step_length, 0.0
        )
        bisected_step_length = 0.5 * (lower_step_length_bound + upper_step_length_bound) + (
            finite_proposed_step_length - lax.stop_gradient(finite_proposed_step_length)
        )
        next_step_length = jnp.where(
            is_proposal_in_bracket, finite_proposed_step_length, bisected_step_length
        )
        remaining_search = self._replace(
            lower_step_length_bound=lower_step_length_bound,
            upper_step_length_bound=upper_step_length_bound,
        )
        return next_step_length, proposing_guard_index, remaining_search


class _PhaseState(NamedTuple):
    """State of the loop that integrates a phase."""

    step_purpose: Int[Array, ""]  # a StepPurpose
    last_accepted_step_end: SolverStepEnd  # the last accepted solver step
    last_step_start: SolverStepEnd  # end of the solver step before the last accepted one
    next_step_length: Scalar  # length of the next solver step, s
    controller_state: Any
    event_search: _EventSearch
    interior_margin_minima: InteriorMarginMinima
    margin_minimum_refinement: MarginMinimumRefinement
    triggered_guard_index: Int[Array, ""]
    is_timed_out: Bool[Array, ""]
    has_integration_failed: Bool[Array, ""]
    n_tried_steps: Int[Array, ""]


class _SolverStepper(NamedTuple):
    """diffrax solver and step-size controller for single solver steps in one vector field."""

    vector_field: VectorField
    diffrax_solver: diffrax.AbstractAdaptiveSolver
    step_size_controller: diffrax.PIDController
    ode_term: diffrax.ODETerm

    def init_solver_and_controller(
        self, state: StateArray, options: StepOptions
    ) -> tuple[Any, Any]:
        """Return the initial internal states of diffrax's solver and step-size controller."""
        zero_duration = jnp.zeros((), state.dtype)
        _, controller_state = self.step_size_controller.init(
            self.ode_term,
            zero_duration,
            options.dt0,
            lax.stop_gradient(state),
            options.dt0,
            None,
            lambda terms, t, y, args: terms.vf(t, y, args),
            self.diffrax_solver.error_order(self.ode_term),
        )
        return self.init_solver_state(state, options), controller_state

    def init_solver_state(self, state: StateArray, options: StepOptions) -> Any:
        """Return the internal state of diffrax's solver for a start at `state`."""
        zero_duration = jnp.zeros((), state.dtype)
        return self.diffrax_solver.init(self.ode_term, zero_duration, options.dt0, state, None)

    def take_solver_step(
        self, state: StateArray, solver_state: Any, step_length: Scalar
    ) -> tuple[StateArray, StateArray, Any]:
        """Return the state after a solver step of `step_length`, s, and its error estimate.

        The third result is the new internal state of the solver.
        """
        import diffrax  # This import is slow.

        zero_duration = jnp.zeros_like(step_length)
        end_state, error_estimate, _, solver_state, solver_result = self.diffrax_solver.step(
            self.ode_term, zero_duration, step_length, state, None, solver_state, jnp.asarray(False)
        )
        if error_estimate is None:
            raise ValueError(
                f"{type(self.diffrax_solver).__name__} gives no error estimate, but the step size "
                "is controlled by one: take 'Dopri8', 'Tsit5' or 'Kvaerno5'."
            )
        error_estimate = jnp.where(
            solver_result == diffrax.RESULTS.successful, error_estimate, jnp.inf
        )
        return end_state, error_estimate, solver_state

    def control_step_size(
        self,
        start_state: StateArray,
        end_state: StateArray,
        error_estimate: StateArray,
        step_length: Scalar,
        controller_state: Any,
    ) -> tuple[Bool[Array, ""], Scalar, Any]:
        """Return whether the error of a solver step is acceptable, and the next step length, s.

        The third result is the new state of the controller. The results have no derivatives,
        because only the solver steps are differentiated.
        """
        start_state, end_state, error_estimate = lax.stop_gradient(
            (start_state, end_state, error_estimate)
        )
        is_end_state_finite = jnp.all(jnp.isfinite(end_state))
        is_within_tolerance, next_step_start, next_step_end, _, controller_state, _ = (
            self.step_size_controller.adapt_step_size(
                jnp.zeros_like(step_length),
                step_length,
                start_state,
                jnp.where(is_end_state_finite, end_state, start_state),
                None,
                jnp.where(is_end_state_finite, error_estimate, jnp.inf),
                self.diffrax_solver.error_order(self.ode_term),  # type: ignore[arg-type]
                controller_state,
            )
        )
        return (
            jnp.asarray(is_within_tolerance),
            jnp.asarray(next_step_end - next_step_start),
            controller_state,
        )


def _make_stepper(vector_field: VectorField, options: StepOptions) -> _SolverStepper:
    """Return the solver and step-size controller that `options` select for a vector field.

    The solver is configured for forward-mode derivatives.
    """
    import diffrax  # This import is slow.

    diffrax_solver_class = getattr(diffrax, options.solver)
    field_names = diffrax_solver_class.__dataclass_fields__
    solver_arguments: dict[str, Any] = {}
    if "scan_kind" in field_names:
        solver_arguments["scan_kind"] = "lax"
    if "root_finder" in field_names:
        tolerances: dict[str, Any] = {"rtol": options.rtol, "atol": options.atol}
        solver_arguments["root_finder"] = diffrax.VeryChord(**tolerances)
    return _SolverStepper(
        vector_field=vector_field,
        diffrax_solver=diffrax_solver_class(**solver_arguments),
        step_size_controller=diffrax.PIDController(
            rtol=options.rtol,
            atol=options.atol,
            factormax=EVENT_SEARCH_OPTIONS.max_solver_step_growth,
        ),
        ode_term=diffrax.ODETerm(lambda t, y, args: vector_field(y)),
    )


def integrate_phase(
    vector_field: VectorField,
    guards_and_margins: GuardsAndMargins,
    start_state: StateArray,
    is_active: Bool[Array, ""],
    options: StepOptions,
) -> PhaseEnd:
    """Return the end of the phase that begins at `start_state`, where a guard first falls to zero.

    A guard that is negative at the start, or zero and not rising, ends the phase immediately with
    duration 0. A guard that is zero and rising does not end the phase. If a guard falls through
    zero at the start, the event time has a derivative. This derivative is minus the guard's
    derivative with respect to the start, divided by the guard's time derivative.

    The integration also detects a guard that is negative only inside a solver step. If the cubic
    through the guard's values and time derivatives may be negative, the solver step is repeated up
    to the minimum of the cubic. If two guards are zero at the same time, the first in the list ends
    the phase. If `is_active` is False, nothing is integrated. Errors are those of the solver for
    the tolerances of `options`.
    """
    phase_context = _PhaseContext(_make_stepper(vector_field, options), guards_and_margins, options)
    phase_state = lax.while_loop(
        lambda phase_state: make_opaque_loop_condition(
            phase_state.step_purpose != StepPurpose.DONE, phase_state.n_tried_steps
        ),
        functools.partial(_advance_phase_state, phase_context),
        _init_phase_state(phase_context, start_state, is_active),
    )
    end_time, end_state = _attach_event_derivatives(phase_context, phase_state)
    margin_minima = jnp.minimum(
        phase_state.margin_minimum_refinement.lowest_margin_values,
        phase_state.last_accepted_step_end.guard_and_margin_values[guards_and_margins.n_guards :],
    )
    return PhaseEnd(
        state=end_state,
        duration=end_time,
        end_guard_index=phase_state.triggered_guard_index,
        is_timed_out=phase_state.is_timed_out,
        has_integration_failed=phase_state.has_integration_failed,
        solver_steps=phase_state.n_tried_steps,
        margin_minima=margin_minima,
    )


def _attach_event_derivatives(
    phase_context: _PhaseContext, phase_state: _PhaseState
) -> tuple[Scalar, StateArray]:
    """Return time and state at the end of a phase, with derivatives that the event's time affects.

    The derivatives of Newton's iteration, which located the event, are right to third order only.
    Time and state of the event also solve two equations: the guard is zero, and the last solver
    step reaches the state. All derivatives follow from them by the implicit function theorem.
    """
    solver_stepper, guards_and_margins, _ = phase_context
    step_start, step_end = phase_state.last_step_start, phase_state.last_accepted_step_end
    guard_index = phase_state.triggered_guard_index
    was_located = (guard_index >= 0) & (
        phase_state.event_search.n_confirming_steps
        >= EVENT_SEARCH_OPTIONS.n_required_confirming_steps
    )

    def evaluate_event_equations(event: tuple[Scalar, StateArray]) -> tuple[Scalar, StateArray]:
        end_time, state = event
        guard_value = guards_and_margins.evaluate_guards_and_margins(state)[guard_index]
        reached_state, _, _ = solver_stepper.take_solver_step(
            step_start.state, step_start.solver_state, end_time - step_start.end_time
        )
        return (
            jnp.where(was_located, guard_value, step_end.end_time - end_time),
            state - jnp.where(was_located, reached_state, step_end.state),
        )

    def solve_tangent_equations(linear_function: Callable, values: tuple) -> tuple:
        guard_value, state_change = values
        field = -linear_function((jnp.ones_like(guard_value), jnp.zeros_like(state_change)))[1]
        guard_change = linear_function((jnp.zeros_like(guard_value), state_change))[0]
        guard_rate = linear_function((jnp.ones_like(guard_value), field))[0]
        is_guard_falling = guard_rate < 0.0
        time_change = jnp.where(
            is_guard_falling,
            (guard_value - guard_change) / jnp.where(is_guard_falling, guard_rate, -1.0),
            0.0,
        )
        return time_change, state_change + field * time_change

    return lax.custom_root(
        evaluate_event_equations,
        (step_end.end_time, step_end.state),
        lambda _, located_event: located_event,
        solve_tangent_equations,
    )


class _PhaseContext(NamedTuple):
    """Arguments of the integration loop that do not change during a phase."""

    solver_stepper: _SolverStepper
    guards_and_margins: GuardsAndMargins
    step_options: StepOptions


def _init_phase_state(
    phase_context: _PhaseContext, start_state: StateArray, is_active: Bool[Array, ""]
) -> _PhaseState:
    """Return the state of the integration loop before the first solver step.

    All arrays that the loop batches or differentiates are batched or differentiated from the start.
    Otherwise JAX would trace the loop again for each array that becomes batched or differentiated.
    """
    solver_stepper, guards_and_margins, options = phase_context
    zero_duration = 0.0 * start_state[0]
    initial_count = jnp.where(is_active, 0, 0).astype(jnp.int32)
    initial_values = (
        jnp.zeros(
            jax.eval_shape(guards_and_margins.evaluate_guards_and_margins, start_state).shape,
            start_state.dtype,
        )
        + zero_duration
    )
    initial_flag = is_active & False
    float_zero = lax.stop_gradient(zero_duration)
    solver_state, controller_state = solver_stepper.init_solver_and_controller(start_state, options)
    is_guard_crossing = jnp.zeros((guards_and_margins.n_guards,), bool) | initial_flag
    start = SolverStepEnd(zero_duration, start_state, solver_state, initial_values, initial_values)
    return _PhaseState(
        step_purpose=jnp.where(is_active, StepPurpose.START, StepPurpose.DONE).astype(jnp.int32),
        last_accepted_step_end=start,
        last_step_start=start,
        next_step_length=zero_duration,  # The first step has length zero and evaluates the start.
        controller_state=jax.tree.map(lambda x: x + float_zero, controller_state),
        event_search=_EventSearch(
            is_guard_crossing,
            float_zero,
            float_zero,
            float_zero,
            initial_count,
            initial_count,
            float_zero,
        ),
        interior_margin_minima=make_empty_interior_margin_minima(guards_and_margins, start_state),
        margin_minimum_refinement=MarginMinimumRefinement(
            initial_count,
            initial_count,
            float_zero,
            float_zero,
            initial_values[guards_and_margins.n_guards :] + jnp.inf,
        ),
        triggered_guard_index=initial_count - 1,
        is_timed_out=initial_flag,
        has_integration_failed=initial_flag,
        n_tried_steps=initial_count,
    )


def _advance_phase_state(phase_context: _PhaseContext, phase_state: _PhaseState) -> _PhaseState:
    """Return the loop state after one solver step.

    The searches for the event and for minima of margins are updated.
    """
    _, guards_and_margins, options = phase_context
    n_guards, event_search = guards_and_margins.n_guards, phase_state.event_search
    previous_step_end = phase_state.last_accepted_step_end
    step_length = phase_state.next_step_length
    is_phase_start = phase_state.step_purpose == StepPurpose.START
    is_searching_event = phase_state.step_purpose == StepPurpose.EVENT_SEARCH
    tried_step_end, error_estimate = _try_solver_step(phase_context, phase_state)
    guard_values = tried_step_end.guard_and_margin_values[:n_guards]
    guard_rates = tried_step_end.guard_and_margin_rates[:n_guards]
    is_guard_met, is_guard_falling = find_guards_met_at_start(
        guards_and_margins, guard_values, guard_rates
    )
    first_met_guard_index = jnp.argmax(is_guard_met).astype(jnp.int32)
    # An event at time zero is searched for like any other, because its time depends on the start.
    is_start_event_searched = is_phase_start & is_guard_falling[first_met_guard_index]
    has_immediate_event = (
        is_phase_start & jnp.any(is_guard_met) & ~is_guard_falling[first_met_guard_index]
    )
    step_assessment = _assess_solver_step(
        phase_context, phase_state, tried_step_end, error_estimate
    )
    proposed_step_length, proposing_guard_index, event_search = event_search.propose_event_time(
        guard_values, guard_rates, step_length
    )
    # A try confirms the event if it changes the event's time by little compared with the step. For
    # an event much earlier than the step's end, the change is also compared with the time since the
    # phase began. The comparison is skipped if the change is only the guard's round-off.
    proposed_step_length_value, step_length_value, start_time = lax.stop_gradient(
        (proposed_step_length, step_length, previous_step_end.end_time)
    )
    event_time_correction = jnp.abs(proposed_step_length_value - step_length_value)
    is_time_correction_small = (
        event_time_correction
        <= EVENT_SEARCH_OPTIONS.max_confirming_time_correction
        * (start_time + proposed_step_length_value)
    )
    is_search_stalled = (
        event_time_correction
        >= EVENT_SEARCH_OPTIONS.min_stalled_correction_ratio
        * event_search.last_event_time_correction
    )
    is_event_confirmed = (event_time_correction <= event_search.time_tolerance) & (
        is_time_correction_small | is_search_stalled
    )
    is_guard_at_zero, lowest_guard_index = is_guard_at_roundoff(
        guards_and_margins, event_search.is_guard_crossing, guard_values
    )
    event_guard_index = jnp.where(is_guard_at_zero, lowest_guard_index, proposing_guard_index)
    n_confirming_steps = event_search.n_confirming_steps + (
        is_searching_event & (is_event_confirmed | is_guard_at_zero)
    )
    is_at_event = is_searching_event & (
        n_confirming_steps >= EVENT_SEARCH_OPTIONS.n_required_confirming_steps
    )

    is_timed_out = step_assessment.is_accepted & (tried_step_end.end_time >= options.max_phase_time)
    is_timed_out = is_timed_out | (is_at_event & (tried_step_end.end_time > options.max_phase_time))
    is_step_too_short = step_assessment.is_step_too_short | (
        is_searching_event
        & ~is_at_event
        & (event_search.n_iterations >= options.max_event_iterations)
    )
    is_phase_end = has_immediate_event | is_at_event | is_timed_out | is_step_too_short
    is_event_search_started = step_assessment.has_guard_crossed | is_start_event_searched
    step_purpose = jnp.where(is_phase_start, StepPurpose.INTEGRATION, phase_state.step_purpose)
    step_purpose = jnp.where(is_event_search_started, StepPurpose.EVENT_SEARCH, step_purpose)
    step_purpose = jnp.where(is_phase_end, StepPurpose.DONE, step_purpose).astype(jnp.int32)
    following_step_length = jnp.where(
        is_start_event_searched, 0.0, lax.stop_gradient(step_assessment.following_step_length)
    )
    following_step_length = jnp.where(
        is_searching_event, proposed_step_length, following_step_length
    )
    is_guard_crossing = jnp.where(
        step_assessment.has_guard_crossed,
        step_assessment.is_guard_crossing,
        event_search.is_guard_crossing,
    )
    is_first_met_guard = is_start_event_searched & (jnp.arange(n_guards) == first_met_guard_index)
    is_step_taken = step_assessment.is_accepted | is_at_event
    is_step_in_phase = (step_assessment.is_accepted & ~is_phase_start) | is_at_event
    interior_margin_minima = update_interior_margin_minima(
        guards_and_margins,
        phase_state.interior_margin_minima,
        previous_step_end,
        tried_step_end,
        step_length,
        is_step_in_phase,
    )
    margin_minimum_refinement = phase_state.margin_minimum_refinement
    if guards_and_margins.includes_phase_start:
        was_refining_minimum = phase_state.step_purpose == StepPurpose.REFINEMENT
        margin_minimum_refinement, is_refining, step_length_to_minimum = (
            advance_margin_minimum_refinement(
                margin_minimum_refinement,
                guards_and_margins,
                interior_margin_minima,
                tried_step_end,
                step_length,
                was_refining_minimum,
                is_phase_start,
                is_phase_end,
                options.max_margin_search_iterations,
            )
        )
        step_purpose = jnp.where(was_refining_minimum, StepPurpose.DONE, step_purpose)
        step_purpose = jnp.where(is_refining, StepPurpose.REFINEMENT, step_purpose)
        following_step_length = jnp.where(
            is_refining, step_length_to_minimum, following_step_length
        )
    return _PhaseState(
        step_purpose=step_purpose,
        last_accepted_step_end=select_trees_by_condition(
            is_step_taken, tried_step_end, previous_step_end
        ),
        last_step_start=select_trees_by_condition(
            is_step_taken, previous_step_end, phase_state.last_step_start
        ),
        next_step_length=following_step_length,
        controller_state=step_assessment.controller_state,
        event_search=_EventSearch(
            is_guard_crossing=jnp.where(
                is_start_event_searched, is_first_met_guard, is_guard_crossing
            ),
            lower_step_length_bound=jnp.where(
                is_event_search_started, 0.0, event_search.lower_step_length_bound
            ),
            upper_step_length_bound=jnp.where(
                is_event_search_started,
                lax.stop_gradient(step_length),
                event_search.upper_step_length_bound,
            ),
            time_tolerance=jnp.where(
                step_assessment.has_guard_crossed,
                step_assessment.time_tolerance,
                event_search.time_tolerance,
            ),
            n_iterations=event_search.n_iterations + is_searching_event,
            n_confirming_steps=n_confirming_steps,
            last_event_time_correction=jnp.where(
                is_event_search_started, jnp.inf, event_time_correction
            ),
        ),
        interior_margin_minima=interior_margin_minima,
        margin_minimum_refinement=margin_minimum_refinement,
        triggered_guard_index=jnp.where(
            has_immediate_event,
            first_met_guard_index,
            jnp.where(
                is_at_event & ~is_timed_out,
                event_guard_index,
                phase_state.triggered_guard_index,
            ),
        ),
        is_timed_out=is_timed_out | phase_state.is_timed_out,
        has_integration_failed=is_step_too_short | phase_state.has_integration_failed,
        n_tried_steps=step_assessment.n_tried_steps,
    )


def _try_solver_step(
    phase_context: _PhaseContext, phase_state: _PhaseState
) -> tuple[SolverStepEnd, Array]:
    """Return the end of one tried solver step with guards and margins, and the error estimate.

    All purposes of a solver step share this call of the solver and of the monitored functions, so
    this code is compiled once.
    """
    solver_stepper, guards_and_margins, options = phase_context
    start_state = (
        phase_state.last_accepted_step_end.state,
        phase_state.last_accepted_step_end.solver_state,
    )
    if guards_and_margins.includes_phase_start:
        state_before_minimum = select_entry_by_mask(
            phase_state.margin_minimum_refinement.margin_index,
            phase_state.interior_margin_minima.step_start_state,
        )
        starts_at_minimum_step = (
            state_before_minimum,
            solver_stepper.init_solver_state(state_before_minimum, options),
        )
        start_state = select_trees_by_condition(
            phase_state.step_purpose == StepPurpose.REFINEMENT, starts_at_minimum_step, start_state
        )
    end_state, error_estimate, solver_state = solver_stepper.take_solver_step(
        *start_state, phase_state.next_step_length
    )
    guard_and_margin_values, guard_and_margin_rates = jax.jvp(
        guards_and_margins.evaluate_guards_and_margins,
        (end_state,),
        (solver_stepper.vector_field(end_state),),
    )
    error_estimate = jnp.where(
        jnp.all(jnp.isfinite(guard_and_margin_values)), error_estimate, jnp.inf
    )
    phase_time_limit = lax.stop_gradient(options.max_phase_time)
    start_time = phase_state.last_accepted_step_end.end_time
    is_integrating = phase_state.step_purpose == StepPurpose.INTEGRATION
    is_last_step = is_integrating & (phase_state.next_step_length >= phase_time_limit - start_time)
    end_time = jnp.where(is_last_step, phase_time_limit, start_time + phase_state.next_step_length)
    return SolverStepEnd(
        end_time, end_state, solver_state, guard_and_margin_values, guard_and_margin_rates
    ), error_estimate


class _StepAssessment(NamedTuple):
    """Acceptance of a tried solver step, crossing guards, and length of the next step."""

    is_accepted: Bool[Array, ""]  # whether the step is accepted; the start is
    has_guard_crossed: Bool[Array, ""]  # whether the step brackets an event
    is_guard_crossing: Bool[Array, " n_guards"]  # guards that are not positive at the step's end
    is_step_too_short: Bool[Array, ""]
    following_step_length: Scalar  # length of the next step, s
    time_tolerance: Scalar  # tolerance of the event's time, s
    controller_state: Any
    n_tried_steps: Int[Array, ""]


def _assess_solver_step(
    phase_context: _PhaseContext,
    phase_state: _PhaseState,
    tried_step_end: SolverStepEnd,
    error_estimate: Array,
) -> _StepAssessment:
    """Return whether a solver step is accepted, which guards cross zero, and the next length.

    A guard may cross zero at the end of the solver step or inside it.
    """
    solver_stepper, guards_and_margins, options = phase_context
    n_guards = guards_and_margins.n_guards
    previous_step_end = phase_state.last_accepted_step_end
    step_length = phase_state.next_step_length
    is_phase_start = phase_state.step_purpose == StepPurpose.START
    is_integrating = phase_state.step_purpose == StepPurpose.INTEGRATION
    uninterrupted_step_length = jnp.where(is_phase_start, options.dt0, step_length)
    is_within_tolerance, next_step_length, controller_state = solver_stepper.control_step_size(
        previous_step_end.state,
        tried_step_end.state,
        error_estimate,
        uninterrupted_step_length,
        phase_state.controller_state,
    )
    is_within_tolerance = is_within_tolerance & is_integrating
    is_guard_crossing = tried_step_end.guard_and_margin_values[:n_guards] <= 0.0
    guard_cubics = tuple(
        x[:n_guards] for x in interpolate_by_cubics(previous_step_end, tried_step_end, step_length)
    )
    minimum_fractions, may_have_minimum = _find_guard_minima(
        guard_cubics, lax.stop_gradient(step_length), previous_step_end.end_time
    )
    step_length_to_minimum = step_length * jnp.min(
        jnp.where(may_have_minimum & ~is_guard_crossing, minimum_fractions, 1.0)
    )
    must_shorten_step = is_within_tolerance & (step_length_to_minimum < step_length)
    has_guard_crossed = is_within_tolerance & jnp.any(is_guard_crossing) & ~must_shorten_step
    n_tried_steps = phase_state.n_tried_steps + (phase_state.step_purpose != StepPurpose.REFINEMENT)
    has_step_failed = (n_tried_steps >= options.max_solver_steps) | (
        previous_step_end.end_time + next_step_length == previous_step_end.end_time
    )
    following_step_length = jnp.where(is_phase_start, options.dt0, next_step_length)
    following_step_length = jnp.where(
        must_shorten_step, step_length_to_minimum, following_step_length
    )
    is_accepted = is_phase_start | (is_within_tolerance & ~has_guard_crossed & ~must_shorten_step)
    end_time = jnp.where(is_accepted, tried_step_end.end_time, previous_step_end.end_time)
    # The last step ends at the time limit.
    remaining_phase_time = lax.stop_gradient(options.max_phase_time - end_time)
    following_step_length = jnp.minimum(following_step_length, remaining_phase_time)
    event_step_length_guess = lax.stop_gradient(step_length) * _guess_event_fraction(
        guard_cubics, is_guard_crossing
    )
    time_resolution = 1e3 * jnp.finfo(step_length.dtype).eps * tried_step_end.end_time
    return _StepAssessment(
        is_accepted=is_accepted,
        has_guard_crossed=has_guard_crossed,
        is_guard_crossing=is_guard_crossing,
        is_step_too_short=is_integrating & ~has_guard_crossed & has_step_failed,
        following_step_length=jnp.where(
            has_guard_crossed, event_step_length_guess, following_step_length
        ),
        time_tolerance=lax.stop_gradient(jnp.maximum(options.rtol * step_length, time_resolution)),
        controller_state=select_trees_by_condition(
            is_integrating & ~must_shorten_step, controller_state, phase_state.controller_state
        ),
        n_tried_steps=n_tried_steps,
    )


def _find_guard_minima(
    guard_cubics: tuple[Array, ...], step_length: Scalar, start_time: Scalar
) -> tuple[Array, Array]:
    """Return the location of each guard's minimum, and whether the guard may be negative there.

    The location is a fraction of the solver step, at most nine tenths. It is the minimum of the
    guard's cubic, whose coefficients are those of `interpolate_by_cubics`. In the solver step, the
    cubic is nowhere below the smallest of its Bernstein coefficients, so a guard with positive
    coefficients stays positive. For any other guard, the caller repeats the solver step up to the
    location. In shorter steps, the coefficients are closer to the guard. The caller stops when the
    coefficients are positive or the guard is negative at the end of a step.
    """
    start_values, start_rates, end_values, end_rates = guard_cubics
    minimum_fractions, _ = find_cubic_minimum(*guard_cubics)
    minimum_fractions = jnp.clip(minimum_fractions, 0.1, 0.9)
    does_step_advance_time = start_time + minimum_fractions * step_length > start_time
    lowest_bernstein_coefficient = jnp.minimum(
        start_values + start_rates / 3.0, end_values - end_rates / 3.0
    )
    may_be_negative = (lowest_bernstein_coefficient <= 0.0) & (end_rates >= 0.0)
    return minimum_fractions, may_be_negative & does_step_advance_time


def _guess_event_fraction(guard_cubics: tuple[Array, ...], is_guard_crossing: Array) -> Scalar:
    """Return the earliest root of a crossing guard's cubic, as a fraction of the solver step.

    The secant method, followed by Newton's method, locates the root of each cubic.
    """
    start_values, start_rates, end_values, end_rates = guard_cubics
    guard_decrease = jnp.where(
        is_guard_crossing & (start_values > end_values),
        start_values - end_values,
        1.0,
    )
    fraction_to_zero = jnp.where(
        is_guard_crossing, jnp.clip(start_values / guard_decrease, 0.0, 1.0), 1.0
    )
    # A guard that rises from zero, or from round-off above it, has its other zero where the cubic
    # divided by x vanishes.
    linear_coefficient = 3.0 * end_values - 2.0 * start_rates - end_rates
    quadratic_coefficient = start_rates - 2.0 * end_values + end_rates
    parabola_root_denominator = (
        jnp.sqrt(
            jnp.maximum(
                linear_coefficient * linear_coefficient - 4.0 * start_rates * quadratic_coefficient,
                0.0,
            )
        )
        - linear_coefficient
    )
    nonzero_parabola_root = jnp.clip(
        2.0
        * start_rates
        / jnp.where(parabola_root_denominator > 0.0, parabola_root_denominator, 1.0),
        0.0,
        1.0,
    )
    cubic_rate_function = lambda fraction_to_zero: (
        6.0 * fraction_to_zero * (fraction_to_zero - 1.0) * (start_values - end_values)
        + (1.0 - fraction_to_zero) * (1.0 - 3.0 * fraction_to_zero) * start_rates
        + fraction_to_zero * (3.0 * fraction_to_zero - 2.0) * end_rates
    )
    does_guard_rise_from_zero = (
        is_guard_crossing
        & (start_rates > 0.0)
        & ((start_values == 0.0) | (cubic_rate_function(fraction_to_zero) >= 0.0))
    )
    fraction_to_zero = jnp.where(does_guard_rise_from_zero, nonzero_parabola_root, fraction_to_zero)
    for _ in range(3):
        is_guard_falling = (cubic_rate_value := cubic_rate_function(fraction_to_zero)) < 0.0
        fraction_change = evaluate_cubic(fraction_to_zero, *guard_cubics) / jnp.where(
            is_guard_falling, cubic_rate_value, 1.0
        )
        fraction_to_zero = jnp.where(
            is_guard_crossing & is_guard_falling,
            jnp.clip(fraction_to_zero - fraction_change, 0.0, 1.0),
            fraction_to_zero,
        )
    return jnp.min(jnp.where(is_guard_crossing, fraction_to_zero, 1.0))


def sample_phase(
    vector_field: VectorField,
    start_state: StateArray,
    duration: Scalar,
    n_samples: int,
    options: StepOptions,
) -> Float[Array, "n_samples dim"]:
    """Return the states at `n_samples` equally spaced times of a phase, as accurate as the solver.

    The first sample is `start_state` and the last is the state after `duration`, s. Each interval
    between two samples is integrated with adaptive solver steps. The last of these solver steps
    ends exactly at the time of the sample.
    """
    solver_stepper = _make_stepper(vector_field, options)
    sample_interval = duration / (n_samples - 1)

    def take_adaptive_step(loop_carry: tuple) -> tuple:
        time, state, solver_state, step_length, controller_state, n_tried_steps = loop_carry
        step_length = jnp.minimum(step_length, sample_interval - time)
        end_state, error_estimate, end_solver_state = solver_stepper.take_solver_step(
            state, solver_state, step_length
        )
        is_within_tolerance, next_step_length, controller_state = solver_stepper.control_step_size(
            state, end_state, error_estimate, step_length, controller_state
        )
        is_last_step = is_within_tolerance & (step_length >= sample_interval - time)
        time = jnp.where(
            is_last_step, sample_interval, jnp.where(is_within_tolerance, time + step_length, time)
        )
        state, solver_state = select_trees_by_condition(
            is_within_tolerance, (end_state, end_solver_state), (state, solver_state)
        )
        return time, state, solver_state, next_step_length, controller_state, n_tried_steps + 1

    needs_step = lambda c: (c[0] < sample_interval) & (c[-1] < options.max_solver_steps)

    def integrate_to_next_sample(state: StateArray, _sample: None) -> tuple[StateArray, StateArray]:
        initial_count = jnp.zeros((), jnp.int32)
        solver_state, controller_state = solver_stepper.init_solver_and_controller(state, options)
        zero_duration = jnp.zeros_like(sample_interval)
        loop_carry = (
            zero_duration,
            state,
            solver_state,
            zero_duration + options.dt0,
            controller_state,
            initial_count,
        )
        next_state = lax.while_loop(needs_step, take_adaptive_step, loop_carry)[1]
        return next_state, next_state

    _, states = lax.scan(integrate_to_next_sample, start_state, None, length=n_samples - 1)
    return jnp.concatenate([start_state[None], states])
