"""Integrate a phase whose equations have kinks, from one kink to the next.

Between two kinks, the equations are those of `BatchPhase.on_sides`. They are smooth beyond the kink
too, so that a solver step may cross it, and the search for events locates it. The integration then
goes on from there on the other side. Tangents pass the kink by a saltation matrix, which is the
identity if the accelerations do not jump.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from vrw_jax.base.elementwise import run_if_any_element_active, select_trees_by_condition
from vrw_jax.base.options import StepOptions
from vrw_jax.base.types import Vector
from vrw_jax.flow.event_location import (
    EventSearch,
    IntegrationStatus,
    IntegratorState,
    evaluate_motion_rates,
    find_first_guard,
    has_guard_crossed,
    propagate_to_event,
)
from vrw_jax.flow.minima import EnterSides, pass_kink_of_margins, update_margin_minima_state
from vrw_jax.flow.tableaus import ButcherTableau, SolverStepFunction, StageState
from vrw_jax.flow.tangents import BatchPhase


def find_sides(phase: BatchPhase, state: StageState) -> Vector:
    """Return the sides of the kinks on which the motion goes on from a state."""
    assert phase.evaluate_kinks is not None
    values, rates = lax.stop_gradient(phase.evaluate_with_rates(phase.evaluate_kinks, state))
    return tuple(
        jnp.where(has_guard_crossed(*kink), -jnp.ones_like(kink[0]), 1.0)
        for kink in zip(values, rates, strict=True)
    )


class KinkLog(NamedTuple):
    """Kinks that a phase has passed, on the first axis of each array."""

    n_kinks: Array  # number of passed kinks, of which only the first ones are listed
    times: Array  # since the start of the phase, s
    states: Array  # positions and rates at each kink
    sides: Array  # sides of all kinks on which the motion goes on from each kink
    tangents: Array | None  # of time, positions and rates, with the directions on the first axis

    @classmethod
    def begin(cls, n_logged: int, sides: Vector, state: IntegratorState) -> "KinkLog":
        repeat = lambda x: jnp.zeros((n_logged, *x.shape), x.dtype)
        time, motion = state.elapsed_time, jnp.stack([*state.state.q, *state.state.v])
        tangents: Any = state.state_tangents
        if tangents is not None:
            n_directions, n_rows = len(tangents), 1 + len(motion)
            tangents = jnp.zeros((n_directions, n_logged, n_rows, *time.shape), tangents.dtype)
        n_kinks = jnp.zeros_like(state.n_tried_steps)
        return cls(n_kinks, repeat(time), repeat(motion), repeat(jnp.stack(sides)), tangents)

    def append(
        self, is_passed: Array, time: Array, motion: Array, sides: Vector, tangents: Any
    ) -> "KinkLog":
        """Return the log after a kink, which only some batch elements have passed."""
        indices = jnp.arange(len(self.times)).reshape(-1, *(1,) * jnp.ndim(time))
        is_entry = is_passed & (indices == self.n_kinks)
        write = lambda entry, log: jnp.where(is_entry[:, None], entry, log)
        return KinkLog(
            self.n_kinks + is_passed,
            jnp.where(is_entry, time, self.times),
            write(motion, self.states),
            write(jnp.stack(sides), self.sides),
            None if self.tangents is None else write(tangents[:, None], self.tangents),
        )


class KinkPassage(NamedTuple):
    """State of the integration over kinks."""

    sides: Vector
    integrator_state: IntegratorState
    search: EventSearch  # search for the event that ended the last segment
    end_guard_index: Array
    """Index of the guard that ends the phase; -1 if the guard that the search found does.

    They differ if a jump of the force makes a guard negative. A kink ends the phase if the motion
    would slide along it, because the force drives the motion back from both sides.
    """
    is_passed: Array  # whether the last segment ended at a kink, and the phase goes on
    log: KinkLog | None


def integrate_over_kinks(
    integrate_segment: Callable[..., tuple[IntegratorState, EventSearch]],
    enter_sides: EnterSides,
    sides: Vector,
    n_guards: int,
    tableau: ButcherTableau,
    integrator_state: IntegratorState,
    options: StepOptions,
    attach_derivatives: Callable | None = None,
    n_logged_kinks: int = 0,
) -> KinkPassage:
    """Integrate each batch element to the first guard that ends the phase.

    - `integrate_segment`: function of phase, solver, tangents and state that integrates to the next
      crossing of a guard, and locates it;
    - `sides`: sides of the kinks at the start;
    - `n_guards`: number of guards that end the phase, which precede those of the kinks;
    - `attach_derivatives`: function that returns the time and the rates at a kink with derivatives;
    - `n_logged_kinks`: see `BatchPhase`.
    """

    def integrate_to_next_kink(passage: KinkPassage) -> KinkPassage:
        phase, solver_step_function, phase_tangents = enter_sides(passage.sides)
        state, search = integrate_segment(
            phase, solver_step_function, phase_tangents, passage.integrator_state
        )
        is_at_kink = (
            state.has_guard_crossed & ~search.is_event_unresolved & (search.guard_index >= n_guards)
        )
        q, v = search.end_state.q, search.end_state.v
        elapsed_time = state.elapsed_time + search.event_step_length
        if attach_derivatives is not None:
            elapsed_time, v = attach_derivatives(
                phase,
                solver_step_function,
                state,
                elapsed_time,
                search.end_state,
                search.guard_index,
                is_at_kink,
            )
        next_sides, next_phase, kink_state, guard_values, end_guard_index = _cross_kinks(
            phase, enter_sides, passage.sides, n_guards, q, v, search.guard_index, is_at_kink
        )
        is_passed = is_at_kink & (end_guard_index < 0)
        next_state = state._replace(
            state=kink_state,
            guard_values=guard_values,
            next_step_length=jnp.minimum(
                state.next_step_length, options.max_phase_time - lax.stop_gradient(elapsed_time)
            ),
            elapsed_time=elapsed_time,
            integration_status=jnp.full_like(state.integration_status, IntegrationStatus.RUNNING),
            n_tried_steps=state.n_tried_steps + search.n_tried_steps,
        )
        next_state, kink_tangents = _select_passed_state(
            tableau,
            solver_step_function,
            phase_tangents,
            (phase, next_phase),
            (state, next_state),
            search,
            is_passed,
        )
        log = passage.log
        if log is not None:
            motion = jnp.stack([*q, *v])
            log = log.append(is_passed, elapsed_time, motion, next_sides, kink_tangents)
        return KinkPassage(
            select_trees_by_condition(is_passed, next_sides, passage.sides),
            next_state,
            search,
            end_guard_index,
            is_passed,
            log,
        )

    no_search = EventSearch.begin(
        integrator_state,
        jnp.zeros_like(integrator_state.elapsed_time),
        enter_sides(sides)[0].has_exact_events,
    )
    start = KinkPassage(
        sides,
        integrator_state,
        no_search,
        jnp.full_like(no_search.guard_index, -1),
        jnp.ones_like(no_search.is_event_unresolved),
        KinkLog.begin(n_logged_kinks, sides, integrator_state) if n_logged_kinks else None,
    )
    return lax.while_loop(lambda passage: jnp.any(passage.is_passed), integrate_to_next_kink, start)


def _cross_kinks(
    phase: BatchPhase,
    enter_sides: EnterSides,
    sides: Vector,
    n_guards: int,
    q: Vector,
    v: Vector,
    located_guard_index: Array,
    is_at_kink: Array,
) -> tuple[Vector, BatchPhase, StageState, Array, Array]:
    """Return sides, phase, state and guards after a kink, and the index of `KinkPassage`."""
    kink_values = lax.stop_gradient(phase.evaluate_guards(phase.make_state(q, v))[n_guards:])
    # Functions that are zero at the same point change their signs together.
    is_located = jnp.stack([located_guard_index == n_guards + i for i in range(len(kink_values))])
    is_crossed = is_at_kink & (is_located | (kink_values <= 0.0))
    next_sides = tuple(map(lambda x, side: jnp.where(x, -side, side), is_crossed, sides))
    next_phase, *_ = enter_sides(next_sides)
    kink_state = next_phase.make_state(q, v)
    guard_values, guard_rates = lax.stop_gradient(
        next_phase.evaluate_with_rates(next_phase.evaluate_guards, kink_state)
    )
    is_sliding = jnp.any(is_crossed & (guard_rates[n_guards:] <= 0.0), axis=0)
    end_guard_index = find_first_guard(
        has_guard_crossed(guard_values[:n_guards], guard_rates[:n_guards]), -1
    )
    end_guard_index = jnp.where(
        is_sliding & (end_guard_index < 0), located_guard_index, end_guard_index
    )
    end_guard_index = jnp.where(is_at_kink, end_guard_index, -1)
    # The function of a kink is zero there, up to round-off.
    guard_values = jnp.concatenate(
        [guard_values[:n_guards], jnp.where(is_crossed, 0.0, guard_values[n_guards:])]
    )
    return next_sides, next_phase, kink_state, guard_values, end_guard_index


def _select_passed_state(
    tableau: ButcherTableau,
    solver_step_function: SolverStepFunction,
    phase_tangents: Any,
    phases: tuple[BatchPhase, BatchPhase],
    states: tuple[IntegratorState, IntegratorState],
    search: EventSearch,
    is_passed: Array,
) -> tuple[IntegratorState, Array | None]:
    """Return the state of the integration, with tangents and minima, in which kinks are passed.

    The second result contains the tangents of time, positions and rates at the kinks.

    - `phases`: phase before and after a kink;
    - `states`: state before the solver step to the kink, and after the kink.
    """
    (phase, next_phase), (state, next_state) = phases, states
    unbatched: dict[str, Any] = {
        name: getattr(state, name) for name in ("n_iterations_until_half_ended", "n_iterations")
    }
    kink_tangents = logged_tangents = None
    if phase_tangents is not None:
        pass_kink = functools.partial(
            _pass_tangents,
            phase_tangents,
            tableau,
            solver_step_function,
            state,
            search,
            next_state.state,
            is_passed,
        )
        tangents: Any = state.state_tangents
        unchanged_tangents = tangents, tangents, tangents[:, 0]
        tangents, kink_tangents, time_tangent = run_if_any_element_active(
            jnp.any(is_passed), pass_kink, unchanged_tangents
        )
        unbatched["state_tangents"] = tangents
        n_rows = len(state.state.q) + len(state.state.v)
        logged_tangents = jnp.concatenate([time_tangent[:, None], kink_tangents[:, :n_rows]], 1)
    if state.margin_minima_state is not None:
        minima = update_margin_minima_state(
            phase, state.margin_minima_state, state.state, search.end_state,
            search.event_step_length, is_passed, state.state_tangents,
        )  # fmt: skip
        unbatched["margin_minima_state"] = pass_kink_of_margins(
            phase, next_phase, minima, next_state.state, is_passed, kink_tangents
        )
    drop: dict[str, Any] = dict.fromkeys(unbatched)
    selected_state = select_trees_by_condition(
        is_passed, next_state._replace(**drop), state._replace(**drop)
    )
    return selected_state._replace(**unbatched), logged_tangents


def _pass_tangents(
    phase_tangents: Any,
    tableau: ButcherTableau,
    solver_step_function: SolverStepFunction,
    integrator_state: IntegratorState,
    search: EventSearch,
    kink_state: StageState,
    is_passed: Array,
    tangents: tuple[Array, Array, Array],
) -> tuple[Array, Array, Array]:
    """Return tangents after a kink at a fixed time, and of the state and the time at the kink.

    - `kink_state`: state after the kink;
    - `tangents`: results for batch elements that are not at a kink.
    """
    end_tangents, time_tangent, kink_tangents = propagate_to_event(
        tableau,
        solver_step_function,
        phase_tangents,
        integrator_state,
        jnp.where(is_passed, search.event_step_length, 0.0),
        search.guard_index,
    )
    tangents_after = kink_tangents - time_tangent[:, None] * evaluate_motion_rates(kink_state)
    held_tangents = end_tangents[:, kink_tangents.shape[1] :]
    return (
        *(
            jnp.where(is_passed, jnp.concatenate([x, held_tangents], 1), y)
            for x, y in zip((tangents_after, kink_tangents), tangents[:2], strict=True)
        ),
        jnp.where(is_passed, time_tangent, tangents[2]),
    )  # type: ignore[return-value]
