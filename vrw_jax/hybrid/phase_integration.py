"""Integration of one phase from its start to its earliest event by diffrax.

diffrax's solvers and step-size controller are called step by step, so that an event's state has the
accuracy of the integrator and not of an interpolant. An accepted step that brackets an event is
repeated with a length that Newton's method corrects until the step ends on the event. These last
steps are differentiated, so first and second derivatives of the event's state and time are accurate
as well.
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

from vrw_jax.hybrid.minima import (
    AcceptedPhaseStep,
    InteriorMinimum,
    MinimumRefinement,
    MonitoredFunctions,
    StateArray,
    advance_minimum_refinement,
    find_guards_met_at_start,
    is_guard_at_roundoff,
    make_empty_minimum,
    select_by_mask,
    update_interior_minimum,
)
from vrw_jax.numerics import (
    Scalar,
    StepOptions,
    evaluate_cubic,
    find_cubic_minimum,
    make_opaque_condition,
    select_tree_leaves,
)
from vrw_jax.runtime import lazy_import

if TYPE_CHECKING:
    import diffrax
else:
    diffrax = lazy_import("diffrax")

VectorField = Callable[[StateArray], StateArray]
"""Autonomous vector field of a phase: the time derivative of the state."""


class PhaseEnd(NamedTuple):
    """End of a phase: state, duration, the guard that ended the phase, and failure flags."""

    state: StateArray
    duration: Scalar  # duration of the phase, s
    guard: Int[Array, ""]  # index of the guard that ended the phase; -1 if none did
    timed_out: Bool[Array, ""]
    gave_up: Bool[Array, ""]
    solver_steps: Int[Array, ""]  # number of tried solver steps, accepted or not
    minima: Float[Array, " n_monitors"]  # minima of the margins, empty if there are none


class StepPurpose(IntEnum):
    """Purpose of the next solver step."""

    START = 0  # A step of length zero evaluates the start.
    INTEGRATION = 1
    EVENT_SEARCH = 2  # The step locates a bracketed event.
    REFINEMENT = 3  # The step refines the minimum of a margin.
    DONE = 4  # No further step is taken.


@dataclass(frozen=True)
class EventSearchOptions:
    """Options of the search for an event within a solver step, and of the growth of steps before
    it.
    """

    max_step_growth: float = 2.0
    """Largest ratio of the lengths of successive solver steps. The error estimate of a step far
    shorter than needed is round-off, and a length derived from that estimate would grow without
    bound. A batch element would then differ from the same element alone by 1e-12. The value is
    chosen to avoid this difference, which is more than a hundred times the element's round-off."""
    n_confirmations: int = 3
    """Number of tries at the located event that must confirm the event's time. The value is chosen
    because the first try makes the event's time accurate to first order in its derivatives and the
    second to third order. The last try evaluates the state at the event."""
    max_confirmed_change: float = 1e-4
    """Largest change of the event's time by a try that confirms it, as a fraction of the phase's
    duration. The value is chosen because Newton's method squares the change in each of the next two
    tries, to 1e-16 in the last try."""
    min_stalled_ratio: float = 0.9
    """Ratio of successive changes of the event's time above which the change is round-off. The
    value is chosen because Newton's method at least halves changes, and reduces them to two thirds
    at a triple root."""


EVENT_SEARCH_OPTIONS = EventSearchOptions()


class _EventSearch(NamedTuple):
    """State of Newton's search for the earliest event inside a step that brackets one."""

    is_crossing: Bool[Array, " n_guards"]
    lower_bound: Scalar  # bracket of the event, s from the step's start
    upper_bound: Scalar
    time_tolerance: Scalar  # tolerance of the event's time, s
    n_iterations: Int[Array, ""]
    n_confirmed: Int[Array, ""]  # number of tries that confirmed the event's time
    change: Scalar  # change of the event's time by the last try, s


class _PhaseState(NamedTuple):
    """State of the loop that integrates a phase."""

    purpose: Int[Array, ""]  # a StepPurpose
    accepted_step: AcceptedPhaseStep  # the last accepted step
    next_length: Scalar  # length of the next step to try, s
    controller_state: Any
    search: _EventSearch
    minimum: InteriorMinimum
    refinement: MinimumRefinement
    guard: Int[Array, ""]
    timed_out: Bool[Array, ""]
    gave_up: Bool[Array, ""]
    n_tried_steps: Int[Array, ""]


class _SolverStepper(NamedTuple):
    """A diffrax solver with its step-size controller, as a function that advances a state by a
    step.
    """

    vector_field: VectorField
    solver: diffrax.AbstractAdaptiveSolver
    controller: diffrax.PIDController
    term: diffrax.ODETerm

    def init_states(self, state: StateArray, options: StepOptions) -> tuple[Any, Any]:
        """Return diffrax's solver state and controller state at the start of a phase."""
        zero_time = jnp.zeros((), state.dtype)
        _, controller_state = self.controller.init(
            self.term,
            zero_time,
            options.dt0,
            lax.stop_gradient(state),
            options.dt0,
            None,
            lambda terms, t, y, args: terms.vf(t, y, args),
            self.solver.error_order(self.term),
        )
        return self.init_solver_state(state, options), controller_state

    def init_solver_state(self, state: StateArray, options: StepOptions) -> Any:
        """Return the solver's internal state at a state of the system."""
        zero_time = jnp.zeros((), state.dtype)
        return self.solver.init(self.term, zero_time, options.dt0, state, None)

    def advance_state(
        self, state: StateArray, solver_state: Any, length: Scalar
    ) -> tuple[StateArray, StateArray, Any]:
        """Return the state after a step of `length`, its error estimate, and the solver's internal
        state.
        """
        zero_time = jnp.zeros_like(length)
        end_state, error_estimate, _, solver_state, solver_result = self.solver.step(
            self.term, zero_time, length, state, None, solver_state, jnp.asarray(False)
        )
        if error_estimate is None:
            raise ValueError(
                f"{type(self.solver).__name__} gives no error estimate, but the step size is "
                "controlled by one: take 'Dopri8', 'Tsit5' or 'Kvaerno5'."
            )
        error_estimate = jnp.where(
            solver_result == diffrax.RESULTS.successful, error_estimate, jnp.inf
        )
        return end_state, error_estimate, solver_state

    def control_step(
        self,
        start_state: StateArray,
        end_state: StateArray,
        error_estimate: StateArray,
        length: Scalar,
        controller_state: Any,
    ) -> tuple[Bool[Array, ""], Scalar, Any]:
        """Return whether the step's error is within tolerance, the next length, and the
        controller's state.

        No result is differentiated, because derivatives are those of the steps taken.
        """
        start_state, end_state, error_estimate = lax.stop_gradient(
            (start_state, end_state, error_estimate)
        )
        is_finite = jnp.all(jnp.isfinite(end_state))
        is_within_tolerance, next_start, next_end, _, controller_state, _ = (
            self.controller.adapt_step_size(
                jnp.zeros_like(length),
                length,
                start_state,
                jnp.where(is_finite, end_state, start_state),
                None,
                jnp.where(is_finite, error_estimate, jnp.inf),
                self.solver.error_order(self.term),  # type: ignore[arg-type]
                controller_state,
            )
        )
        return (
            jnp.asarray(is_within_tolerance),
            jnp.asarray(next_end - next_start),
            controller_state,
        )


def make_solver(name: str, options: StepOptions) -> diffrax.AbstractAdaptiveSolver:
    """Return the diffrax solver with this name, configured for forward-mode derivatives."""
    solver_class = getattr(diffrax, name, None)
    if not (
        isinstance(solver_class, type) and issubclass(solver_class, diffrax.AbstractAdaptiveSolver)
    ):
        raise ValueError(
            f"solver is {name!r}, but it must name a diffrax solver with an error estimate: "
            "take 'Dopri8', 'Tsit5', 'Dopri5', 'Kvaerno3' or 'Kvaerno5'."
        )
    field_names = getattr(solver_class, "__dataclass_fields__", {})
    solver_arguments: dict[str, Any] = {}
    if "scan_kind" in field_names:
        solver_arguments["scan_kind"] = "lax"
    if "root_finder" in field_names:
        tolerances: dict[str, Any] = {"rtol": options.rtol, "atol": options.atol}
        solver_arguments["root_finder"] = diffrax.VeryChord(**tolerances)
    return solver_class(**solver_arguments)


def _make_stepper(field: VectorField, options: StepOptions, max_growth: float) -> _SolverStepper:
    """Return the solver and controller of the options for a vector field.

    `max_growth` limits the ratio of successive step lengths.
    """
    return _SolverStepper(
        vector_field=field,
        solver=make_solver(options.solver, options),
        controller=diffrax.PIDController(
            rtol=options.rtol, atol=options.atol, factormax=max_growth
        ),
        term=diffrax.ODETerm(lambda t, y, args: field(y)),
    )


def integrate_phase(
    field: VectorField,
    monitored_functions: MonitoredFunctions,
    start: StateArray,
    is_active: Bool[Array, ""],
    options: StepOptions,
    event_options: EventSearchOptions = EVENT_SEARCH_OPTIONS,
) -> PhaseEnd:
    """Integrate `field` from `start` until the earliest guard reaches zero from above, and return
    the end.

    A guard that is negative at the start, or zero and not rising, ends the phase immediately with
    duration 0. A guard that is zero and rising does not end the phase. If a guard falls through
    zero at the start, the event time has a derivative: minus the guard's derivative with respect to
    the start over the guard's rate.

    A guard that is negative only inside a step is found: if the cubic through values and rates may
    be negative, the step is repeated up to the cubic's minimum. Of two guards that are zero at the
    same time, the first in the list ends the phase. If `is_active` is False, nothing is integrated.
    Errors are those of the solver at the tolerances of `options`.
    """
    solver_stepper = _make_stepper(field, options, event_options.max_step_growth)
    phase_context = _PhaseContext(solver_stepper, monitored_functions, options, event_options)
    phase_state = lax.while_loop(
        lambda phase_state: make_opaque_condition(
            phase_state.purpose != StepPurpose.DONE, phase_state.n_tried_steps
        ),
        functools.partial(_advance_phase_state, phase_context),
        _init_phase_state(phase_context, start, is_active),
    )
    minima = jnp.minimum(
        phase_state.refinement.lowest_values,
        phase_state.accepted_step.values[monitored_functions.n_guards :],
    )
    return PhaseEnd(
        state=phase_state.accepted_step.state,
        duration=phase_state.accepted_step.time,
        guard=phase_state.guard,
        timed_out=phase_state.timed_out,
        gave_up=phase_state.gave_up,
        solver_steps=phase_state.n_tried_steps,
        minima=minima,
    )


class _PhaseContext(NamedTuple):
    """Arguments of a phase's loop that do not change."""

    stepper: _SolverStepper
    monitored_functions: MonitoredFunctions
    options: StepOptions
    event_options: EventSearchOptions


def _init_phase_state(
    phase_context: _PhaseContext, start_state: StateArray, is_active: Bool[Array, ""]
) -> _PhaseState:
    """Return the state of the loop before the first step.

    Every number that the loop will batch or perturb is batched or perturbed from the start.
    Otherwise JAX would trace the loop again for each round in which these properties spread.
    """
    solver_stepper, monitored_functions, options, _ = phase_context
    zero_time = 0.0 * start_state[0]
    zero_count = jnp.where(is_active, 0, 0).astype(jnp.int32)
    zero_values = (
        jnp.zeros(
            jax.eval_shape(monitored_functions.evaluate, start_state).shape, start_state.dtype
        )
        + zero_time
    )
    false_flag = is_active & False
    zero_number = lax.stop_gradient(zero_time)
    solver_state, controller_state = solver_stepper.init_states(start_state, options)
    is_crossing = jnp.zeros((monitored_functions.n_guards,), bool) | false_flag
    return _PhaseState(
        purpose=jnp.where(is_active, StepPurpose.START, StepPurpose.DONE).astype(jnp.int32),
        accepted_step=AcceptedPhaseStep(
            zero_time, start_state, solver_state, zero_values, zero_values
        ),
        next_length=zero_time,  # The first step has length zero and evaluates the start.
        controller_state=jax.tree.map(lambda x: x + zero_number, controller_state),
        search=_EventSearch(
            is_crossing,
            zero_number,
            zero_number,
            zero_number,
            zero_count,
            zero_count,
            zero_number,
        ),
        minimum=make_empty_minimum(monitored_functions, start_state),
        refinement=MinimumRefinement(
            zero_count,
            zero_count,
            zero_number,
            zero_number,
            zero_values[monitored_functions.n_guards :] + jnp.inf,
        ),
        guard=zero_count - 1,
        timed_out=false_flag,
        gave_up=false_flag,
        n_tried_steps=zero_count,
    )


def _advance_phase_state(context: _PhaseContext, phase_state: _PhaseState) -> _PhaseState:
    """Take one solver step, update the searches for the event and for minima, and return the loop's
    state.
    """
    _, monitored_functions, options, event_options = context
    n_guards, event_search = monitored_functions.n_guards, phase_state.search
    previous_step, length = phase_state.accepted_step, phase_state.next_length
    is_starting = phase_state.purpose == StepPurpose.START
    is_searching = phase_state.purpose == StepPurpose.EVENT_SEARCH
    accepted_step, error_estimate = _try_solver_step(context, phase_state)
    guard_values, guard_rates = accepted_step.values[:n_guards], accepted_step.rates[:n_guards]
    ends_phase, is_falling = find_guards_met_at_start(
        monitored_functions, guard_values, guard_rates
    )
    first_met_guard = jnp.argmax(ends_phase).astype(jnp.int32)
    # An event at time zero is searched for like any other, because its time depends on the start.
    begins_search_at_start = is_starting & is_falling[first_met_guard]
    has_immediate_event = is_starting & jnp.any(ends_phase) & ~is_falling[first_met_guard]
    step_assessment = _assess_solver_step(context, phase_state, accepted_step, error_estimate)
    event_proposal = _propose_event_time(event_search, guard_values, guard_rates, length)
    # A try confirms the event if it changes the event's time by little compared with the step. For
    # an event much earlier than the step's end, the change is also compared with the time since the
    # phase began. The comparison is skipped if the change is only the guard's round-off.
    constant_proposal, constant_length, start_time = lax.stop_gradient(
        (event_proposal.length, length, previous_step.time)
    )
    event_time_change = jnp.abs(constant_proposal - constant_length)
    is_small_change = event_time_change <= event_options.max_confirmed_change * (
        start_time + constant_proposal
    )
    is_search_stalled = event_time_change >= event_options.min_stalled_ratio * event_search.change
    is_event_confirmed = (event_time_change <= event_search.time_tolerance) & (
        is_small_change | is_search_stalled
    )
    is_at_zero, lowest_guard = is_guard_at_roundoff(
        monitored_functions, event_search.is_crossing, guard_values
    )
    event_proposal = event_proposal._replace(
        guard=jnp.where(is_at_zero, lowest_guard, event_proposal.guard)
    )
    n_confirmed = event_search.n_confirmed + (is_searching & (is_event_confirmed | is_at_zero))
    has_arrived = is_searching & (n_confirmed >= event_options.n_confirmations)

    timed_out = step_assessment.is_accepted & (accepted_step.time >= options.max_phase_time)
    timed_out = timed_out | (has_arrived & (accepted_step.time > options.max_phase_time))
    is_stuck = step_assessment.is_stuck | (
        is_searching & ~has_arrived & (event_search.n_iterations >= options.max_event_iterations)
    )
    is_phase_end = has_immediate_event | has_arrived | timed_out | is_stuck
    begins_event_search = step_assessment.has_crossed | begins_search_at_start
    purpose = jnp.where(is_starting, StepPurpose.INTEGRATION, phase_state.purpose)
    purpose = jnp.where(begins_event_search, StepPurpose.EVENT_SEARCH, purpose)
    purpose = jnp.where(is_phase_end, StepPurpose.DONE, purpose).astype(jnp.int32)
    following_length = jnp.where(
        begins_search_at_start, 0.0, lax.stop_gradient(step_assessment.following_length)
    )
    following_length = jnp.where(is_searching, event_proposal.length, following_length)
    is_crossing = jnp.where(
        step_assessment.has_crossed, step_assessment.is_crossing, event_search.is_crossing
    )
    is_first_met_guard = begins_search_at_start & (jnp.arange(n_guards) == first_met_guard)
    is_counted = (step_assessment.is_accepted & ~is_starting) | has_arrived
    minimum = update_interior_minimum(
        monitored_functions, phase_state.minimum, previous_step, accepted_step, length, is_counted
    )
    minimum_refinement = phase_state.refinement
    if monitored_functions.includes_start:
        was_refining = phase_state.purpose == StepPurpose.REFINEMENT
        minimum_refinement, is_refining, length_to_minimum = advance_minimum_refinement(
            minimum_refinement,
            monitored_functions,
            minimum,
            accepted_step,
            length,
            was_refining,
            is_starting,
            is_phase_end,
            options.max_margin_search_iterations,
        )
        purpose = jnp.where(was_refining, StepPurpose.DONE, purpose)
        purpose = jnp.where(is_refining, StepPurpose.REFINEMENT, purpose)
        following_length = jnp.where(is_refining, length_to_minimum, following_length)
    return _PhaseState(
        purpose=purpose,
        accepted_step=select_tree_leaves(
            step_assessment.is_accepted | has_arrived, accepted_step, previous_step
        ),
        next_length=following_length,
        controller_state=step_assessment.controller_state,
        search=_EventSearch(
            is_crossing=jnp.where(begins_search_at_start, is_first_met_guard, is_crossing),
            lower_bound=jnp.where(begins_event_search, 0.0, event_proposal.lower_bound),
            upper_bound=jnp.where(
                begins_event_search, lax.stop_gradient(length), event_proposal.upper_bound
            ),
            time_tolerance=jnp.where(
                step_assessment.has_crossed,
                step_assessment.time_tolerance,
                event_search.time_tolerance,
            ),
            n_iterations=event_search.n_iterations + is_searching,
            n_confirmed=n_confirmed,
            change=jnp.where(begins_event_search, jnp.inf, event_time_change),
        ),
        minimum=minimum,
        refinement=minimum_refinement,
        guard=jnp.where(
            has_immediate_event,
            first_met_guard,
            jnp.where(has_arrived & ~timed_out, event_proposal.guard, phase_state.guard),
        ),
        timed_out=timed_out | phase_state.timed_out,
        gave_up=is_stuck | phase_state.gave_up,
        n_tried_steps=step_assessment.n_tried_steps,
    )


def _try_solver_step(
    context: _PhaseContext, phase_state: _PhaseState
) -> tuple[AcceptedPhaseStep, Array]:
    """Return the end of the step to try, the monitored functions at its end, and its error
    estimate.

    One call of the solver and of the monitored functions serves every purpose, so that the code is
    compiled once.
    """
    stepper, monitored_functions, options, _ = context
    start_state = phase_state.accepted_step.state, phase_state.accepted_step.solver_state
    if monitored_functions.includes_start:
        minimum_start = select_by_mask(
            phase_state.refinement.margin_index, phase_state.minimum.start_state
        )
        restarts_at_minimum = minimum_start, stepper.init_solver_state(minimum_start, options)
        start_state = select_tree_leaves(
            phase_state.purpose == StepPurpose.REFINEMENT, restarts_at_minimum, start_state
        )
    end_state, error_estimate, solver_state = stepper.advance_state(
        *start_state, phase_state.next_length
    )
    monitored_values, monitored_rates = jax.jvp(
        monitored_functions.evaluate, (end_state,), (stepper.vector_field(end_state),)
    )
    error_estimate = jnp.where(jnp.all(jnp.isfinite(monitored_values)), error_estimate, jnp.inf)
    time_limit = lax.stop_gradient(options.max_phase_time)
    start_time, is_integrating = (
        phase_state.accepted_step.time,
        phase_state.purpose == StepPurpose.INTEGRATION,
    )
    is_last_step = is_integrating & (phase_state.next_length >= time_limit - start_time)
    end_time = jnp.where(is_last_step, time_limit, start_time + phase_state.next_length)
    return AcceptedPhaseStep(
        end_time, end_state, solver_state, monitored_values, monitored_rates
    ), error_estimate


class _StepAssessment(NamedTuple):
    """Result of the examination of a tried solver step."""

    is_accepted: Bool[Array, ""]  # whether the step is accepted; the start is
    has_crossed: Bool[Array, ""]  # whether the step brackets an event
    is_crossing: Bool[Array, " n_guards"]  # guards that are not positive at the step's end
    is_stuck: Bool[Array, ""]
    following_length: Scalar  # length of the next step, s
    time_tolerance: Scalar  # tolerance of the event's time, s
    controller_state: Any
    n_tried_steps: Int[Array, ""]


def _assess_solver_step(
    context: _PhaseContext,
    phase_state: _PhaseState,
    tried_step: AcceptedPhaseStep,
    error_estimate: Array,
) -> _StepAssessment:
    """Return whether the step is accepted, whether a guard crosses zero, and the next length.

    A guard may cross zero at the end of the step or inside it.
    """
    stepper, monitored_functions, options, _ = context
    n_guards, previous_step, length = (
        monitored_functions.n_guards,
        phase_state.accepted_step,
        phase_state.next_length,
    )
    is_starting = phase_state.purpose == StepPurpose.START
    is_integrating = phase_state.purpose == StepPurpose.INTEGRATION
    nominal_length = jnp.where(is_starting, options.dt0, length)
    is_within_tolerance, next_length, controller_state = stepper.control_step(
        previous_step.state,
        tried_step.state,
        error_estimate,
        nominal_length,
        phase_state.controller_state,
    )
    is_within_tolerance = is_within_tolerance & is_integrating
    is_crossing = tried_step.values[:n_guards] <= 0.0
    minimum_fractions, may_have_minimum = _find_guard_minima(
        previous_step, tried_step.values, tried_step.rates, length, n_guards
    )
    length_to_minimum = length * jnp.min(
        jnp.where(may_have_minimum & ~is_crossing, minimum_fractions, 1.0)
    )
    must_retry = is_within_tolerance & (length_to_minimum < length)
    has_crossed = is_within_tolerance & jnp.any(is_crossing) & ~must_retry
    n_tried_steps = phase_state.n_tried_steps + (phase_state.purpose != StepPurpose.REFINEMENT)
    cannot_continue = (n_tried_steps >= options.max_solver_steps) | (
        previous_step.time + next_length == previous_step.time
    )
    following_length = jnp.where(is_starting, options.dt0, next_length)
    following_length = jnp.where(must_retry, length_to_minimum, following_length)
    is_accepted = is_starting | (is_within_tolerance & ~has_crossed & ~must_retry)
    end_time = jnp.where(is_accepted, tried_step.time, previous_step.time)
    # The last step ends at the time limit.
    time_left = lax.stop_gradient(options.max_phase_time - end_time)
    following_length = jnp.minimum(following_length, time_left)
    event_length_guess = _guess_event_length(
        previous_step, tried_step.values, tried_step.rates, length, n_guards, is_crossing
    )
    time_resolution = 1e3 * jnp.finfo(length.dtype).eps * tried_step.time
    return _StepAssessment(
        is_accepted=is_accepted,
        has_crossed=has_crossed,
        is_crossing=is_crossing,
        is_stuck=is_integrating & ~has_crossed & cannot_continue,
        following_length=jnp.where(has_crossed, event_length_guess, following_length),
        time_tolerance=lax.stop_gradient(jnp.maximum(options.rtol * length, time_resolution)),
        controller_state=select_tree_leaves(
            is_integrating & ~must_retry, controller_state, phase_state.controller_state
        ),
        n_tried_steps=n_tried_steps,
    )


def _find_guard_minima(
    previous_step: AcceptedPhaseStep,
    guard_values: Array,
    guard_rates: Array,
    length: Scalar,
    n_guards: int,
) -> tuple[Array, Array]:
    """Return, for each guard, the fraction of the step to its minimum, and whether it may be
    negative.

    The cubic through values and rates does not fall below the least of its Bernstein coefficients,
    so a guard with positive coefficients stays positive. Otherwise the step is repeated up to the
    cubic's minimum, at most nine tenths of the step. Shorter steps have coefficients closer to the
    guard, until these are positive or a step ends where the guard is negative.
    """
    v0, r0, v1, r1 = lax.stop_gradient(
        (previous_step.values, previous_step.rates, guard_values, guard_rates)
    )
    v0, r0, v1, r1 = v0[:n_guards], r0[:n_guards], v1[:n_guards], r1[:n_guards]
    length = lax.stop_gradient(length)
    first_coefficient, second_coefficient = v0 + r0 * length / 3.0, v1 - r1 * length / 3.0
    minimum_fractions = jnp.clip(find_cubic_minimum(v0, r0 * length, v1, r1 * length)[0], 0.1, 0.9)
    advances_time = previous_step.time + minimum_fractions * length > previous_step.time
    may_be_negative = (jnp.minimum(first_coefficient, second_coefficient) <= 0.0) & (r1 >= 0.0)
    return minimum_fractions, may_be_negative & advances_time


def _guess_event_length(
    previous_step: AcceptedPhaseStep,
    guard_values: Array,
    guard_rates: Array,
    length: Scalar,
    n_guards: int,
    is_crossing: Array,
) -> Scalar:
    """Return the time from the step's start to the earliest zero of the crossing guards' cubics, s.

    The zero is found by the secant, then by Newton's method.
    """
    v0, r0, v1, r1 = lax.stop_gradient(
        (previous_step.values, previous_step.rates * length, guard_values, guard_rates * length)
    )
    v0, r0, v1, r1 = v0[:n_guards], r0[:n_guards], v1[:n_guards], r1[:n_guards]
    guard_decrease = jnp.where(is_crossing & (v0 > v1), v0 - v1, 1.0)
    zero_fraction = jnp.where(is_crossing, jnp.clip(v0 / guard_decrease, 0.0, 1.0), 1.0)
    # A guard that rises from zero, or from round-off above it, has its other zero where the cubic
    # divided by x vanishes.
    linear_coefficient, quadratic_coefficient = 3.0 * v1 - 2.0 * r0 - r1, r0 - 2.0 * v1 + r1
    root_denominator = (
        jnp.sqrt(
            jnp.maximum(
                linear_coefficient * linear_coefficient - 4.0 * r0 * quadratic_coefficient, 0.0
            )
        )
        - linear_coefficient
    )
    other_root = jnp.clip(
        2.0 * r0 / jnp.where(root_denominator > 0.0, root_denominator, 1.0), 0.0, 1.0
    )
    cubic_rate = lambda zero_fraction: (
        6.0 * zero_fraction * (zero_fraction - 1.0) * (v0 - v1)
        + (1.0 - zero_fraction) * (1.0 - 3.0 * zero_fraction) * r0
        + zero_fraction * (3.0 * zero_fraction - 2.0) * r1
    )
    rises_from_zero = is_crossing & (r0 > 0.0) & ((v0 == 0.0) | (cubic_rate(zero_fraction) >= 0.0))
    zero_fraction = jnp.where(rises_from_zero, other_root, zero_fraction)
    for _ in range(3):
        is_falling = (cubic_rate_value := cubic_rate(zero_fraction)) < 0.0
        fraction_change = evaluate_cubic(zero_fraction, v0, r0, v1, r1) / jnp.where(
            is_falling, cubic_rate_value, 1.0
        )
        zero_fraction = jnp.where(
            is_crossing & is_falling,
            jnp.clip(zero_fraction - fraction_change, 0.0, 1.0),
            zero_fraction,
        )
    return lax.stop_gradient(length) * jnp.min(jnp.where(is_crossing, zero_fraction, 1.0))


class _EventProposal(NamedTuple):
    """Newton's next proposal for an event's time, and the remaining bracket, s from the step's
    start.
    """

    length: Scalar
    guard: Int[Array, ""]
    lower_bound: Scalar
    upper_bound: Scalar


def _propose_event_time(
    event_search: _EventSearch, guard_values: Array, guard_rates: Array, length: Scalar
) -> _EventProposal:
    """Return the earliest of the event times that the crossing guards propose.

    Bisection keeps the proposal inside the shrinking bracket. The proposal carries derivatives:
    after k proposals in the quadratic regime, derivatives are accurate to order 2^k - 1.
    """
    is_falling = event_search.is_crossing & (guard_rates < 0.0)
    time_change = -guard_values / jnp.where(is_falling, guard_rates, -1.0)
    # A guard that rises below zero has crossed at an unknown earlier time.
    time_of_missed_event = jnp.where(
        event_search.is_crossing & (guard_values < 0.0), -jnp.inf, jnp.inf
    )
    proposed_lengths = jnp.where(is_falling, length + time_change, time_of_missed_event)
    # If no crossing guard falls here, the lowest of the crossing guards is taken.
    lowest_guard = jnp.argmin(jnp.where(event_search.is_crossing, guard_values, jnp.inf))
    guard = jnp.where(
        jnp.any(proposed_lengths < jnp.inf), jnp.argmin(proposed_lengths), lowest_guard
    ).astype(jnp.int32)
    # This happens at the start of the step.
    is_rising = (guard_values == 0.0) & (guard_rates > 0.0)
    is_before_event = jnp.all(
        jnp.where(event_search.is_crossing, (guard_values > 0.0) | is_rising, True)
    )
    lower_bound = jnp.where(is_before_event, lax.stop_gradient(length), event_search.lower_bound)
    upper_bound = jnp.where(is_before_event, event_search.upper_bound, lax.stop_gradient(length))
    earliest_proposal = proposed_lengths[guard]
    # A proposal within round-off of a collapsed bracket counts as inside.
    is_proposal_inside = (earliest_proposal >= lower_bound - event_search.time_tolerance) & (
        earliest_proposal <= upper_bound + event_search.time_tolerance
    )
    # If round-off moves Newton's proposal out of the bracket, its derivative is still valid.
    finite_proposal = jnp.where(jnp.isfinite(earliest_proposal), earliest_proposal, 0.0)
    bisected_length = 0.5 * (lower_bound + upper_bound) + (
        finite_proposal - lax.stop_gradient(finite_proposal)
    )
    next_length = jnp.where(is_proposal_inside, finite_proposal, bisected_length)
    return _EventProposal(next_length, guard, lower_bound, upper_bound)


def sample_phase(
    field: VectorField, start: StateArray, duration: Scalar, n_samples: int, options: StepOptions
) -> Float[Array, "n_samples dim"]:
    """Return the states at `n_samples` equal times of a phase, both ends included, at solver
    accuracy.
    """
    stepper = _make_stepper(field, options, EVENT_SEARCH_OPTIONS.max_step_growth)
    sample_interval = duration / (n_samples - 1)

    def integrate_to_next(state: StateArray, _sample: None) -> tuple[StateArray, StateArray]:
        next_state = _integrate_sample_interval(stepper, state, sample_interval, options)
        return next_state, next_state

    _, states = lax.scan(integrate_to_next, start, None, length=n_samples - 1)
    return jnp.concatenate([start[None], states])


def _integrate_sample_interval(
    solver_stepper: _SolverStepper, state: StateArray, interval: Scalar, options: StepOptions
) -> StateArray:
    """Return the state after the time `interval`, s, by adaptive steps of which the last ends
    exactly.
    """

    def advance_interval(loop_carry: tuple) -> tuple:
        time, state, solver_state, length, controller_state, n_tried_steps = loop_carry
        step_length = jnp.minimum(length, interval - time)
        end_state, error_estimate, end_solver_state = solver_stepper.advance_state(
            state, solver_state, step_length
        )
        is_within_tolerance, next_length, controller_state = solver_stepper.control_step(
            state, end_state, error_estimate, step_length, controller_state
        )
        is_last_step = is_within_tolerance & (step_length >= interval - time)
        time = jnp.where(
            is_last_step, interval, jnp.where(is_within_tolerance, time + step_length, time)
        )
        state, solver_state = select_tree_leaves(
            is_within_tolerance, (end_state, end_solver_state), (state, solver_state)
        )
        return time, state, solver_state, next_length, controller_state, n_tried_steps + 1

    needs_step = lambda c: (c[0] < interval) & (c[-1] < options.max_solver_steps)
    zero_count = jnp.zeros((), jnp.int32)
    solver_state, controller_state = solver_stepper.init_states(state, options)
    zero_time = jnp.zeros_like(interval)
    loop_carry = (
        zero_time,
        state,
        solver_state,
        zero_time + options.dt0,
        controller_state,
        zero_count,
    )
    return lax.while_loop(needs_step, advance_interval, loop_carry)[1]
