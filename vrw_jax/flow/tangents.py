"""Tangents from the start and the constants of a phase to its end, also over kinks, for a batch.

Each Runge-Kutta step is repeated for the linearized equations, for all requested directions. The
Jacobians at the stages are the same for all directions and are computed once. Each direction then
costs about a hundred products. Step sizes and iterations of the event search are not
differentiated. The derivative is that of the discrete flow with constant step lengths, and of the
time at which the guard becomes zero. The first axis of arrays contains the directions.

A phase whose equations have kinks is integrated from one kink to the next. Between two kinks, the
equations are those of `BatchPhase.on_sides`. They are smooth beyond the kink too, so that a solver
step may cross it, and the search for events locates it. The integration then goes on from there on
the other side. Tangents pass the kink by a saltation matrix, which is the identity if the
accelerations do not jump.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from vrw_jax.base.elementwise import (
    Vector,
    run_if_any_element_active,
    select_entry_by_mask,
    select_trees_by_condition,
)
from vrw_jax.base.options import StepOptions
from vrw_jax.flow.event_location import (
    EventSearch,
    IntegrationStatus,
    IntegratorState,
    evaluate_motion_rates,
    find_first_guard,
    has_guard_crossed,
)
from vrw_jax.flow.extrema import EnterSides, pass_kink_of_margins, update_margin_minima_state
from vrw_jax.flow.solver_steps import (
    BatchPhase,
    ButcherTableau,
    ImplicitDynamics,
    MakeBatchPhase,
    SolverStepFunction,
    StageAccelerations,
    StageState,
    evaluate_stage,
)
from vrw_jax.lanes.autodiff import compute_each_jvp, map_directions


def stack_directions(directions: Vector) -> Array:
    """Return the tangents of several quantities as one array (directions, quantities, batch)."""
    return jnp.stack(jnp.broadcast_arrays(*directions), 1)


@functools.partial(jax.jit, static_argnums=0)
def _compute_stage_jacobians(
    make_phase: MakeBatchPhase,
    equation_constants: Any,
    equation_constants_directions: Any,
    held_constants: Vector,
    stage_states: list[StageState],
) -> tuple[Array, Array]:
    """Return derivatives of the accelerations at all stages of a solver step except the last.

    The first array contains the Jacobians with respect to positions, rates and held constants,
    shape (stages, coordinates, components, batch). The second array contains the tangents due to
    the constants of the phase, shape (stages, directions, coordinates, batch).
    """

    def linearize_stage(packed_state: Array) -> tuple[Array, Array]:
        # inverse of `_pack_stage_state`
        n = (len(packed_state) - 2) // 3
        state_components = tuple(packed_state)
        sin, cos, *accelerations = state_components[2 * n :]
        stage_state = StageState(
            state_components[:n],
            state_components[n : 2 * n],
            StageAccelerations(sin, cos, tuple(accelerations)),
        )
        implicit_dynamics = make_phase(equation_constants, held_constants).implicit_dynamics
        implicit_dynamics = ImplicitDynamics(*[jax.jit(f) for f in implicit_dynamics])
        evaluate_residual = lambda *constants: make_phase(
            *constants
        ).implicit_dynamics.evaluate_residual(stage_state)
        compute_acceleration_derivative = lambda *tangent: _solve_acceleration(
            implicit_dynamics, stage_state, jax.jvp(evaluate_residual, *tangent)[1]
        )
        zero_equation_constants, zero_held_constants, zero_accelerations = jax.tree.map(
            jnp.zeros_like, (equation_constants, held_constants, tuple(accelerations))
        )
        jacobian_columns = []
        for unit_vector in _make_unit_vectors((*stage_state.q, *stage_state.v)):
            theta_tangent = unit_vector[0]
            state_tangent = StageState(
                unit_vector[:n],
                unit_vector[n:],
                StageAccelerations(cos * theta_tangent, -sin * theta_tangent, zero_accelerations),
            )
            _, residual_tangent = jax.jvp(
                implicit_dynamics.evaluate_residual, (stage_state,), (state_tangent,)
            )
            jacobian_columns.append(
                _solve_acceleration(implicit_dynamics, stage_state, residual_tangent)
            )
        jacobian_columns += [
            compute_acceleration_derivative(
                (equation_constants, held_constants), (zero_equation_constants, unit_vector)
            )
            for unit_vector in _make_unit_vectors(held_constants)
        ]
        differentiate_by_equation_constants = lambda equation_constants_direction: (
            compute_acceleration_derivative(
                (equation_constants, held_constants),
                (equation_constants_direction, zero_held_constants),
            )
        )
        return jnp.stack(jacobian_columns, 1), map_directions(
            differentiate_by_equation_constants, equation_constants_directions, is_unrolled=True
        )

    return lax.map(
        linearize_stage, jnp.stack([_pack_stage_state(state) for state in stage_states[:-1]])
    )


def _pack_stage_state(state: StageState) -> Array:
    """Return positions, rates, sine and cosine of theta, and accelerations as one array.

    The array has the shape (components, batch).
    """
    sin, cos, acceleration = state.acceleration
    return jnp.stack([*state.q, *state.v, sin, cos, *acceleration[: len(state.q)]])


def _make_unit_vectors(template_state: Vector) -> list[Vector]:
    n = len(template_state)
    return [
        tuple(jnp.full_like(template_state[j], float(i == j)) for j in range(n)) for i in range(n)
    ]


def _solve_acceleration(
    implicit_dynamics: ImplicitDynamics, state: StageState, residual_tangent: Vector
) -> Array:
    """Return the tangent of the accelerations that cancels a tangent of the residual.

    The result follows from the implicit function theorem.
    """
    return -jnp.stack(implicit_dynamics.solve_for_accelerations(state, residual_tangent))


@functools.partial(jax.jit, static_argnums=0)  # The function is traced once for all its calls.
def _propagate_tangents(
    tableau: ButcherTableau,
    state_jacobians: Array,
    equation_constants_tangents: Array,
    start_tangents: Array,
    h: Array,
) -> Array:
    """Return the tangents at the end of a solver step, given the tangents at its start.

    The tangents are those of positions, rates and held constants. `h` is the length of the step, s.
    """
    n = state_jacobians.shape[1]

    def propagate_tangent_direction(tangent_direction: tuple[Array, Array]) -> Array:
        equation_constants_tangent, start_tangent = tangent_direction
        start_position_tangents = tuple(start_tangent[:n])
        start_rate_tangents = tuple(start_tangent[n : 2 * n])
        held_constants_tangents = tuple(start_tangent[2 * n :])
        stage_tangents: list[Vector] = []
        q, v = start_position_tangents, start_rate_tangents
        for i in range(len(tableau.stage_nodes) - 1):
            state_tangents = (*q, *v, *held_constants_tangents)
            acceleration_tangents = [
                functools.reduce(
                    lax.add,
                    map(lax.mul, state_jacobians[i, coordinate_index], state_tangents),
                    equation_constants_tangent[i, coordinate_index],
                )
                for coordinate_index in range(n)
            ]
            stage_tangents.append(tuple(acceleration_tangents))
            q, v = evaluate_stage(
                tableau, i + 1, start_position_tangents, start_rate_tangents, stage_tangents, h
            )
        return jnp.stack([*q, *v, *held_constants_tangents])

    return map_directions(
        propagate_tangent_direction,
        (jnp.moveaxis(equation_constants_tangents, 1, 0), start_tangents),
    )


class PhaseTangents(NamedTuple):
    """Tangents of the start state, of the constants and of the held constants of a phase."""

    make_phase: MakeBatchPhase
    equation_constants: Any
    held_constants: Vector
    equation_constants_tangents: Any  # tree of the constants, directions first
    # tangents of positions, rates, held constants, (directions, components, batch)
    start_tangents: Array

    def on_sides(self, sides: Vector) -> "PhaseTangents":
        """Return the tangents in a phase with smooth equations, see `BatchPhase.on_sides`."""
        return self._replace(
            make_phase=lambda *constants: self.make_phase(*constants).on_sides(sides)
        )

    def propagate_to_step_end(
        self,
        tableau: ButcherTableau,
        stage_states: list[StageState],
        start_tangents: Array,
        h: Array,
        is_accepted: Array | bool = True,
    ) -> Array:
        """Return the tangents at the end of a solver step, given the tangents at its start.

        `h` is the length of the step, s. Elements that do not accept the step keep their tangents.
        """
        stage_jacobians = _compute_stage_jacobians(
            self.make_phase,
            self.equation_constants,
            self.equation_constants_tangents,
            self.held_constants,
            stage_states,
        )
        end_tangents = _propagate_tangents(tableau, *stage_jacobians, start_tangents, h)
        return (
            end_tangents
            if is_accepted is True
            else jnp.where(is_accepted, end_tangents, start_tangents)
        )

    def evaluate_rate_and_tangents(
        self,
        evaluate_function: Callable[[BatchPhase, StageState], Array],
        state: StageState,
        directions: Array,
    ) -> tuple[Array, Array]:
        """Return the time derivative of a function, and the result of `evaluate_tangents`."""
        phase = self.make_phase(self.equation_constants, self.held_constants)
        _, (rate,) = phase.evaluate_with_rates(
            lambda state: (evaluate_function(phase, state),), state
        )
        return rate, self.evaluate_tangents(evaluate_function, state, directions)

    def evaluate_tangents(
        self,
        evaluate_function: Callable[[BatchPhase, StageState], Any],
        state: StageState,
        directions: Array,
    ) -> Any:
        """Return the tangents of a function of phase and state, for tangents of a state.

        The first axis of the result contains the directions.
        """

        def evaluate_for_constants(
            equation_constants: Any, held_constants: Vector, q: Vector, v: Vector
        ) -> Any:
            phase = self.make_phase(equation_constants, held_constants)
            return evaluate_function(phase, phase.make_state(q, v))

        n, direction_components = len(state.q), tuple(jnp.moveaxis(directions, 1, 0))
        return compute_each_jvp(
            evaluate_for_constants,
            (self.equation_constants, self.held_constants, state.q, state.v),
            (
                self.equation_constants_tangents,
                direction_components[2 * n :],
                direction_components[:n],
                direction_components[n : 2 * n],
            ),
        )


def propagate_to_event(
    tableau: ButcherTableau,
    solver_step_function: SolverStepFunction | None,
    phase_tangents: Any,
    integrator_state: IntegratorState,
    last_step_length: Array,
    event_guard_index: Array,
) -> tuple[Array, Array, Array]:
    """Return the tangents after the last solver step of a phase.

    They are those at a fixed time, that of the event's time, and those of positions and rates at
    the event. The axes are those of directions, components and the batch. Without an event, or if
    its guard does not fall, the tangent of the time is zero.

    - `solver_step_function`: None if the last solver step is already taken;
    - `last_step_length`: time from `integrator_state` to the event, s.
    """
    end_state, end_tangents = integrator_state.state, integrator_state.state_tangents
    assert end_tangents is not None
    if solver_step_function is not None:
        stage_states, _ = solver_step_function(end_state, last_step_length)
        end_state = stage_states[-1]
        end_tangents = phase_tangents.propagate_to_step_end(
            tableau, stage_states, end_tangents, last_step_length
        )
    guard_rate, guard_tangent = phase_tangents.evaluate_rate_and_tangents(
        lambda phase, state: select_entry_by_mask(event_guard_index, phase.evaluate_guards(state)),
        end_state,
        end_tangents,
    )
    # The guard is zero at the event of the perturbed motion too.
    is_guard_falling = integrator_state.has_guard_crossed & (guard_rate < 0.0)
    event_time_tangent = jnp.where(
        is_guard_falling, -guard_tangent / jnp.where(is_guard_falling, guard_rate, -1.0), 0.0
    )
    motion_rates = evaluate_motion_rates(end_state)
    motion_tangents = end_tangents[:, : len(motion_rates)]
    return (
        end_tangents,
        event_time_tangent,
        motion_tangents + event_time_tangent[:, None] * motion_rates,
    )


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
        phase, solver, tangents = enter_sides(passage.sides)
        state, search = integrate_segment(phase, solver, tangents, passage.integrator_state)
        is_at_kink = (
            state.has_guard_crossed & ~search.is_event_unresolved & (search.guard_index >= n_guards)
        )
        q, v = search.end_state.q, search.end_state.v
        elapsed_time = state.elapsed_time + search.event_step_length
        if attach_derivatives is not None:
            elapsed_time, v = attach_derivatives(
                phase,
                solver,
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
            solver,
            tangents,
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

        def pass_kink(tangents: tuple[Array, Array, Array]) -> Any:
            """Return tangents after a kink at a fixed time, and of the state and the time at it."""
            end_tangents, time_tangent, kink_tangents = propagate_to_event(
                tableau,
                solver_step_function,
                phase_tangents,
                state,
                jnp.where(is_passed, search.event_step_length, 0.0),
                search.guard_index,
            )
            tangents_after = kink_tangents - time_tangent[:, None] * evaluate_motion_rates(
                next_state.state
            )
            held_tangents = end_tangents[:, kink_tangents.shape[1] :]
            return (
                *(
                    jnp.where(is_passed, jnp.concatenate([x, held_tangents], 1), y)
                    for x, y in zip((tangents_after, kink_tangents), tangents[:2], strict=True)
                ),
                jnp.where(is_passed, time_tangent, tangents[2]),
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
