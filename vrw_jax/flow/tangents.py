"""Propagate tangents from the start and the constants of a phase to its end, for a batch.

Each Runge-Kutta step is repeated for the linearized equations, for all requested directions. The
Jacobians at the stages are the same for all directions and are computed once. Each direction then
costs about a hundred products. Step sizes and iterations of the event search are not
differentiated. The derivative is that of the discrete flow with constant step lengths, and of the
time at which the guard becomes zero. The first axis of arrays contains the directions.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from vrw_jax.base.elementwise import select_entry_by_mask
from vrw_jax.base.types import Vector
from vrw_jax.flow.event_location import IntegratorState, evaluate_motion_rates
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
