"""Linearize the collocation equations of a limit cycle.

The unknowns of the cycle are the section state, the durations of all phases and the accelerations
at all nodes. Each phase is divided into mesh intervals with four Gauss nodes (order 8). Positions
and rates are explicit functions of the unknowns.

`linearize_steps` visits each mesh interval once and propagates a few tangents. The first tangent is
the Newton correction. Further tangents belong to the components of the section state, to the
requested parameters, and to the duration of the current phase. The node equations are eliminated in
each interval. The duration of a phase is eliminated at its end event. The section state is
eliminated by `close_cycle`. The monodromy matrix and the sensitivities of all unknowns are
therefore tangents of one linearization.

The last axis of each array contains the batch elements, which are independent wheels. No branch of
the code depends on values.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool

from vrw_jax import lanes
from vrw_jax.base.elementwise import (
    FusionBarrierFn,
    LaneArray,
    Vector,
    apply_matrix,
    contract_inner_axis,
    evaluate_with_jvps,
    evaluate_with_partial_derivatives,
    invert_small_matrices,
    make_fusion_barrier,
    solve_node_equations,
    sum_with_weights,
)
from vrw_jax.gaits.gauss import (
    DOUBLE_END_WEIGHTS,
    DOUBLE_INTEGRATION_MATRIX,
    END_WEIGHTS,
    GAUSS_NODES,
    INTEGRATION_MATRIX,
    N_GAUSS_NODES,
    CollocationPhase,
    CollocationSolution,
    PhaseConstants,
    PhaseMesh,
    PhasePoint,
    PhaseSequence,
)

MIN_LOOPED_PARAMETERS = 3
"""Least number of parameters whose tangents machine code computes in a loop.

A loop over fewer tangents would shorten the code by less than it adds.
"""


class CycleLinearization(NamedTuple):
    """Newton correction, parameter tangents and monodromy matrix of a cycle at a trial solution."""

    newton_correction: CollocationSolution
    parameter_tangents: (
        # derivatives of the solution; requested parameters on a leading axis
        CollocationSolution
    )
    # corrected coordinates and rates at the end of each gait step: (n, 2 n_coordinates, batch)
    gait_step_end_states: LaneArray
    # derivatives of `gait_step_end_states`; requested parameters on a leading axis
    gait_step_end_tangents: LaneArray
    monodromy: LaneArray  # Jacobian of the return map: (row, column, batch)


class _PhaseState(NamedTuple):
    """State at one time of a phase, or the tangents of a state on an additional leading axis."""

    held_constants: LaneArray
    q: LaneArray
    v: LaneArray


def _stack_phase_point(phase_point: PhasePoint, template_component_array: Array) -> _PhaseState:
    """Stack the held constants, the coordinates and the rates of a point into one array each.

    A part without components becomes an empty array. Its trailing shape and type are those of
    `template_component_array`.
    """
    empty = jnp.zeros((0, *template_component_array.shape[1:]), template_component_array.dtype)
    return _PhaseState(*(jnp.stack(part) if part else empty for part in phase_point))


class _StateAndTangents(NamedTuple):
    """State at one time of a phase, and its tangents."""

    state: _PhaseState
    tangents: _PhaseState


class _MeshInterval(NamedTuple):
    """Mesh interval with the state at its start and the accelerations at its nodes.

    - `length_fraction`: length of the interval as a fraction of the phase's duration;
    - `h`: length of the interval, s;
    - `node_accelerations`: shape (node, coordinate, batch).
    """

    state: _PhaseState
    length_fraction: Array
    h: LaneArray
    node_accelerations: LaneArray

    def evaluate_nodes(self) -> tuple[Array, Array]:
        """Return the coordinates and the rates at the nodes."""
        state, _, h, node_accelerations = self
        gauss_nodes_as_column = GAUSS_NODES.astype(h.dtype)[:, None, None]
        rate_increments = apply_matrix(INTEGRATION_MATRIX, node_accelerations)
        position_increments = apply_matrix(DOUBLE_INTEGRATION_MATRIX, node_accelerations)
        node_q = state.q + h * (gauss_nodes_as_column * state.v + h * position_increments)
        return node_q, state.v + h * rate_increments

    def evaluate_node_tangents(
        self, tangents: _PhaseState, duration_direction: np.ndarray
    ) -> Array:
        """Return the tangents of coordinates and rates at the nodes: (tangent, node, argument,
        batch).

        - `duration_direction`: tangent of the phase's duration in each direction.
        """
        state, length_fraction, h, node_accelerations = self
        gauss_nodes_as_column = GAUSS_NODES.astype(h.dtype)[:, None, None]
        rate_increments = apply_matrix(INTEGRATION_MATRIX, node_accelerations)
        position_increments = apply_matrix(DOUBLE_INTEGRATION_MATRIX, node_accelerations)
        node_q_tangents = (
            tangents.q[:, None]
            + (h * gauss_nodes_as_column) * tangents.v[:, None]
            + duration_direction
            * (length_fraction * (gauss_nodes_as_column * state.v + 2.0 * h * position_increments))
        )
        node_v_tangents = tangents.v[:, None] + duration_direction * (
            length_fraction * rate_increments
        )
        return jnp.concatenate([node_q_tangents, node_v_tangents], 2)

    def evaluate_end(self) -> _PhaseState:
        """Return the state at the end of the interval."""
        (held_constants, q, v), _, h, node_accelerations = self
        rate_increment = sum_with_weights(END_WEIGHTS, node_accelerations)
        position_increment = sum_with_weights(DOUBLE_END_WEIGHTS, node_accelerations)
        return _PhaseState(
            held_constants, q + h * v + h * h * position_increment, v + h * rate_increment
        )

    def evaluate_end_tangents(
        self,
        tangents: _PhaseState,
        duration_direction: np.ndarray,
        acceleration_tangents: LaneArray,
    ) -> _PhaseState:
        """Return the tangents of the state at the end of the interval.

        - `acceleration_tangents`: tangents of the node accelerations, which have the axes (node,
          row, tangent, batch).
        """
        (_, _, v), length_fraction, h, node_accelerations = self
        duration_direction = duration_direction[:, 0]
        rate_increment = sum_with_weights(END_WEIGHTS, node_accelerations)
        position_increment = sum_with_weights(DOUBLE_END_WEIGHTS, node_accelerations)
        rate_increment_tangents, position_increment_tangents = (
            sum_with_weights(weights, acceleration_tangents).swapaxes(0, 1)
            for weights in (END_WEIGHTS, DOUBLE_END_WEIGHTS)
        )
        q_tangents = (
            tangents.q
            + h * tangents.v
            + h * h * position_increment_tangents
            + duration_direction * (length_fraction * (v + 2.0 * h * position_increment))
        )
        v_tangents = (
            tangents.v
            + h * rate_increment_tangents
            + duration_direction * (length_fraction * rate_increment)
        )
        return _PhaseState(tangents.held_constants, q_tangents, v_tangents)


def _make_unit_tangent(n_tangents: int, tangent_index: int, float_dtype: Any) -> np.ndarray:
    """Return the unit vector that selects one tangent, of shape (n_tangents, 1, 1, 1)."""
    return np.eye(n_tangents, dtype=float_dtype)[tangent_index][:, None, None, None]


class _LinearizationContext(NamedTuple):
    """Inputs of a linearization, which also define the order of the tangents.

    The first tangent is the Newton correction. Tangents for the components of the section state
    follow, and then tangents for the parameters in `parameter_indices`. Within a phase, the last
    tangent belongs to the duration of that phase.
    """

    phase_sequence: PhaseSequence
    phase_meshes: tuple[PhaseMesh, ...]
    parameter_indices: tuple[int, ...]
    parameters: LaneArray
    compute_phase_constants: Callable[..., PhaseConstants]
    phase_constants: PhaseConstants
    phase_constants_tangents: tuple[
        LaneArray, ...
    ]  # tangents of each constant with respect to the requested parameters
    prevent_fusion: FusionBarrierFn

    @property
    def n_tangents(self) -> int:
        """Return the number of tangents at a phase boundary, where no tangent belongs
        to a duration.
        """
        return 1 + self.phase_sequence.section_size + len(self.parameter_indices)

    @property
    def section_tangent_slice(self) -> slice:
        """Return the slice that selects the tangents for the section state."""
        return slice(1, 1 + self.phase_sequence.section_size)

    @property
    def has_parameter_loop(self) -> bool:
        """Return whether a loop computes the tangents for the parameters one after another, so that
        machine code is short.
        """
        return lanes.targets_machine_code() and len(self.parameter_indices) >= MIN_LOOPED_PARAMETERS

    def split_tangents(self, tangents: Any) -> tuple[Any, Any]:
        """Return the tangents that belong to no parameter, and those for the parameters."""
        parameter_slice = slice(self.section_tangent_slice.stop, self.n_tangents)
        others = lambda x: jnp.concatenate([x[: parameter_slice.start], x[self.n_tangents :]])
        return jax.tree.map(others, tangents), jax.tree.map(lambda x: x[parameter_slice], tangents)

    def join_tangents(self, others: Any, parameter_tangents: Any) -> Any:
        """Return the tangents whose parts `split_tangents` returns."""
        n = self.section_tangent_slice.stop
        join = lambda x, y: jnp.concatenate([x[:n], y, x[n:]])
        return jax.tree.map(join, others, parameter_tangents)

    def evaluate_function_with_tangents(
        self, function_of_point: Callable, phase_point: tuple, point_tangents: tuple
    ) -> tuple:
        """Evaluate `function_of_point(*point, *phase_constants)` and its tangents."""
        evaluate_at_constants = functools.partial(
            evaluate_with_jvps,
            lambda *phase_point: function_of_point(*phase_point, *self.phase_constants),
            tuple(phase_point),
        )
        if not self.parameter_indices:
            return evaluate_at_constants(point_tangents)
        if self.has_parameter_loop:
            others, parameter_tangents = self.split_tangents(tuple(point_tangents))
            value, other_tangents = evaluate_at_constants(others)
            primals = (*phase_point, *self.phase_constants)
            compute_tangent = lambda t: jax.jvp(function_of_point, primals, t)[1]
            return value, self.join_tangents(
                other_tangents,
                lax.map(compute_tangent, (*parameter_tangents, *self.phase_constants_tangents)),
            )
        tangent_padding = (
            (self.section_tangent_slice.stop, point_tangents[0].shape[0] - self.n_tangents),
            *((0, 0),) * (self.parameters.ndim - 1),
        )
        padded_phase_constants_tangents = (
            jnp.pad(phase_constant_tangent, tangent_padding)
            for phase_constant_tangent in self.phase_constants_tangents
        )
        return evaluate_with_jvps(
            function_of_point,
            (*phase_point, *self.phase_constants),
            (*point_tangents, *padded_phase_constants_tangents),
        )

    def linearize_residual(
        self,
        phase: CollocationPhase,
        held_constants: LaneArray,
        node_q: LaneArray,
        node_v: LaneArray,
        node_accelerations: LaneArray,
    ) -> tuple[Array, Array, Any]:
        """Return the residual of the equations of motion at the nodes, and its partial derivatives.

        The Jacobian has the axes (node, equation, argument, batch). Its arguments are the
        coordinates, the rates, the accelerations and the held constants. The partial derivatives
        with respect to the parameters are a separate array with the parameters on the leading axis.
        """
        n_coordinates = phase.n_coordinates
        n_state_arguments = 3 * n_coordinates + len(held_constants)

        def evaluate_residual_of_arguments(*residual_arguments: Array) -> Vector:
            q, v, a = (
                residual_arguments[i * n_coordinates : (i + 1) * n_coordinates] for i in range(3)
            )
            held_constants = residual_arguments[3 * n_coordinates : n_state_arguments]
            phase_constants = (
                self.compute_phase_constants(*residual_arguments[n_state_arguments:])
                if self.parameter_indices
                else self.phase_constants
            )
            return phase.residual_function(phase_constants, PhasePoint(held_constants, q, v), a)

        constant_arguments = [*held_constants]
        if self.parameter_indices:
            constant_arguments += [*self.parameters]
        residual_arguments = [
            node_array[:, coordinate_index]
            for node_array in (node_q, node_v, node_accelerations)
            for coordinate_index in range(n_coordinates)
        ] + [jnp.broadcast_to(x, node_q[:, 0].shape) for x in constant_arguments]
        # The partial derivatives are stacked only after they are computed, because each is a small
        # kernel and stacking copies it.
        dynamics_residual, partial_derivatives_by_output = self.prevent_fusion(
            evaluate_with_partial_derivatives(evaluate_residual_of_arguments, residual_arguments)
        )
        derivatives_by_argument = list(zip(*partial_derivatives_by_output, strict=True))
        residual_jacobian = jnp.stack(
            [
                jnp.stack(derivatives_of_argument, 1)
                for derivatives_of_argument in derivatives_by_argument[:n_state_arguments]
            ],
            2,
        )
        parameter_derivatives = [
            jnp.stack(derivatives_by_argument[n_state_arguments + parameter_index], 1)
            for parameter_index in self.parameter_indices
        ]
        return self.prevent_fusion(
            (
                jnp.stack(dynamics_residual, 1),
                residual_jacobian,
                jnp.stack(parameter_derivatives) if parameter_derivatives else (),
            )
        )

    def assemble_node_matrix(self, h: LaneArray, residual_jacobian: LaneArray) -> Any:
        """Return the matrix of the linear equations whose solutions are the tangents of the node
        accelerations.
        """
        n_coordinates = residual_jacobian.shape[1]
        double_integration_matrix, integration_matrix = (
            float64_matrix.astype(h.dtype)[:, None, :, None, None]
            for float64_matrix in (DOUBLE_INTEGRATION_MATRIX, INTEGRATION_MATRIX)
        )
        residual_by_q, residual_by_v, residual_by_a = (
            residual_jacobian[:, :, None, i * n_coordinates : (i + 1) * n_coordinates]
            for i in range(3)
        )
        node_identity = np.eye(N_GAUSS_NODES, dtype=h.dtype)[:, None, :, None, None]
        return node_identity * residual_by_a + h * (
            h * double_integration_matrix * residual_by_q + integration_matrix * residual_by_v
        )

    def assemble_right_hand_sides(
        self,
        linearized_residual: tuple,
        held_constants_tangents: LaneArray,
        node_tangents: LaneArray,
        correction_direction: np.ndarray,
    ) -> Array:
        """Return the right-hand sides of these equations, one for each tangent.

        - `linearized_residual`: the residual, its Jacobian, and its tangents for the parameters of
          these tangents, if any;
        - `correction_direction`: 1 for the tangent that is the Newton correction, 0 for others.
        """
        dynamics_residual, residual_jacobian, parameter_derivatives = linearized_residual
        n_coordinates = dynamics_residual.shape[1]
        tangent_terms = [
            residual_jacobian[:, :, state_index] * node_tangents[:, :, state_index, None]
            for state_index in range(2 * n_coordinates)
        ]
        tangent_terms += [
            residual_jacobian[:, :, 3 * n_coordinates + constant_index]
            * held_constants_tangents[:, constant_index, None, None]
            for constant_index in range(held_constants_tangents.shape[1])
        ]
        right_hand_sides = sum(tangent_terms, start=correction_direction * dynamics_residual)
        if not isinstance(parameter_derivatives, tuple):
            right_hand_sides = right_hand_sides + parameter_derivatives
        return -jnp.moveaxis(right_hand_sides, 0, 2)

    def linearize_phase(
        self,
        phase: CollocationPhase,
        phase_mesh: PhaseMesh,
        phase_start: _StateAndTangents,
        phase_duration: LaneArray,
        phase_accelerations: LaneArray,
    ) -> tuple[_StateAndTangents, LaneArray]:
        """Return the state at the end of a phase, and the tangents of its node accelerations.

        After the directions of `phase_start`, both have that of the phase's duration.
        """
        float_dtype = phase_duration.dtype
        append_zero = lambda x: jnp.concatenate([x, jnp.zeros_like(x[:1])])
        tangents = jax.tree.map(append_zero, phase_start.tangents)
        parts = self.split_tangents(tangents) if self.has_parameter_loop else (tangents,)
        n_tangents = len(parts[0].q)
        correction_direction, duration_direction = (
            _make_unit_tangent(n_tangents, i, float_dtype) for i in (0, -1)
        )
        no_direction = np.zeros((1, 1, 1, 1), float_dtype)

        def linearize_mesh_interval(
            start: tuple[_PhaseState, tuple[_PhaseState, ...]], interval_scan_inputs: tuple
        ) -> tuple[tuple, tuple[Array, ...]]:
            (state, (tangents, *parameter_tangents)) = start
            node_accelerations, length_fraction = interval_scan_inputs
            h = length_fraction * phase_duration
            interval = _MeshInterval(state, length_fraction, h, node_accelerations)
            node_q, node_v = self.prevent_fusion(interval.evaluate_nodes())
            residual, jacobian, parameter_derivatives = self.linearize_residual(
                phase, state.held_constants, node_q, node_v, node_accelerations
            )
            node_matrix = self.prevent_fusion(self.assemble_node_matrix(h, jacobian))

            def propagate_tangents(
                tangents: _PhaseState, directions: tuple, parameter_derivatives: Any
            ) -> tuple[_PhaseState, Array]:
                correction_direction, duration_direction = directions
                node_tangents = interval.evaluate_node_tangents(tangents, duration_direction)
                right_hand_sides = self.assemble_right_hand_sides(
                    (residual, jacobian, parameter_derivatives),
                    tangents.held_constants,
                    self.prevent_fusion(node_tangents),
                    correction_direction,
                )
                right_hand_sides = self.prevent_fusion(right_hand_sides)
                # Axes: (node, row, tangent, batch).
                acceleration_tangents = self.prevent_fusion(
                    solve_node_equations(node_matrix, right_hand_sides, self.parameters)
                )
                end_tangents = interval.evaluate_end_tangents(
                    tangents, duration_direction, acceleration_tangents
                )
                return end_tangents, jnp.moveaxis(acceleration_tangents, 2, 0)

            def propagate_parameter_tangent(inputs: tuple) -> tuple[_PhaseState, Array]:
                tangents, parameter_derivatives = jax.tree.map(lambda x: x[None], inputs)
                results = propagate_tangents(
                    tangents, (no_direction, no_direction), parameter_derivatives
                )
                return jax.tree.map(lambda x: x[0], results)

            if self.parameter_indices and not parameter_tangents:
                padding = (self.section_tangent_slice.stop, 1), *((0, 0),) * 3
                parameter_derivatives = jnp.pad(parameter_derivatives, padding)
            results = [
                propagate_tangents(
                    tangents,
                    (correction_direction, duration_direction),
                    () if parameter_tangents else parameter_derivatives,
                )
            ]
            results += [
                lax.map(propagate_parameter_tangent, (x, parameter_derivatives))
                for x in parameter_tangents
            ]
            end_tangents, acceleration_tangents = zip(*results, strict=True)
            return (interval.evaluate_end(), end_tangents), acceleration_tangents

        length_fractions = jnp.asarray(phase_mesh.interval_length_fractions, float_dtype)
        (state, parts), acceleration_tangents = lax.scan(
            linearize_mesh_interval,
            (phase_start.state, parts),
            (phase_accelerations, length_fractions),
        )
        # Axes: (tangent, interval, node, row, batch).
        acceleration_tangents = tuple(jnp.swapaxes(x, 0, 1) for x in acceleration_tangents)
        join = self.join_tangents if self.has_parameter_loop else lambda x: x
        return _StateAndTangents(state, join(*parts)), join(*acceleration_tangents)

    def eliminate_phase_duration(
        self,
        phase: CollocationPhase,
        phase_end: _StateAndTangents,
        phase_duration: LaneArray,
        is_phase_active: Bool[Array, " lanes"],
    ) -> tuple[_StateAndTangents, LaneArray, Callable[[Array], Array]]:
        """Eliminate the duration tangent of a phase by the phase's end event, and apply the reset.

        Return the state at the start of the next phase, the tangents of the duration, and a
        function. The function eliminates the duration tangent from other tangents. The duration of
        an inactive phase is 0 s.
        """

        def evaluate_phase_end(
            held_constants: Array, q: Array, v: Array, *phase_constants: Array
        ) -> tuple:
            phase_end_point = PhasePoint(tuple(held_constants), tuple(q), tuple(v))
            return phase.end_event_function(phase_constants, phase_end_point), _stack_phase_point(
                phase.reset_map(phase_constants, phase_end_point), q
            )

        (event_value, next_state), (event_tangents, next_tangents) = (
            self.evaluate_function_with_tangents(evaluate_phase_end, *phase_end)
        )
        newton_correction_unit_tangent, duration_unit_tangent = (
            _make_unit_tangent(event_tangents.shape[0], i, phase_duration.dtype)[:, 0, 0]
            for i in (0, -1)
        )
        event_value = jnp.where(is_phase_active, event_value, phase_duration)
        event_tangents = jnp.where(is_phase_active, event_tangents, duration_unit_tangent)
        duration_tangents = (
            -(event_tangents[:-1] + newton_correction_unit_tangent[:-1] * event_value)
            / event_tangents[-1]
        )

        def eliminate_duration_tangent(tangents_with_duration: Array) -> Array:
            duration_factor = duration_tangents.reshape(
                duration_tangents.shape[:1] + (1,) * (tangents_with_duration.ndim - 2) + (-1,)
            )
            return tangents_with_duration[:-1] + duration_factor * tangents_with_duration[-1:]

        next_phase_start = _StateAndTangents(
            next_state, jax.tree.map(eliminate_duration_tangent, next_tangents)
        )
        return next_phase_start, duration_tangents, eliminate_duration_tangent

    def select_gait_step(self, parity: Sequence[Array]) -> "_LinearizationContext":
        """Return the context with the constants of a gait step, see `list_parities`."""
        if not parity:
            return self
        select_constants = self.phase_sequence.select_constants
        return self._replace(
            compute_phase_constants=lambda *parameters: select_constants(
                self.compute_phase_constants(*parameters), parity
            ),
            phase_constants=select_constants(self.phase_constants, parity),
        )

    def linearize_gait_step(
        self, section_state_and_tangents: tuple, gait_step_inputs: tuple
    ) -> tuple:
        """Linearize one gait step, and return the section state after it, its tangents and outputs.

        The outputs are the state at the end of the gait step and its tangents. Further outputs are
        the tangents of the phase durations and of the node accelerations.
        """
        section_state, section_tangents = section_state_and_tangents
        phase_durations, accelerations_by_phase, is_phase_active, *parity = gait_step_inputs
        self = self.select_gait_step(parity)

        def evaluate_gait_step_start(section_state: Array, *phase_constants: Array) -> tuple:
            return _stack_phase_point(
                self.phase_sequence.step_start_map(phase_constants, tuple(section_state)),
                section_state,
            )

        phase_start = _StateAndTangents(
            *self.evaluate_function_with_tangents(
                evaluate_gait_step_start, (section_state,), (section_tangents,)
            )
        )
        duration_tangents = []
        acceleration_tangents = []
        for i, collocation_phase in enumerate(self.phase_sequence.phases):
            phase_end, phase_acceleration_tangents = self.linearize_phase(
                collocation_phase,
                self.phase_meshes[i],
                phase_start,
                phase_durations[i],
                accelerations_by_phase[i],
            )
            phase_start, phase_duration_tangents, eliminate_duration_tangent = (
                self.eliminate_phase_duration(
                    collocation_phase, phase_end, phase_durations[i], is_phase_active[i]
                )
            )
            duration_tangents.append(phase_duration_tangents)
            acceleration_tangents.append(eliminate_duration_tangent(phase_acceleration_tangents))
            phase_start = self.prevent_fusion(phase_start)
        # After the loop, the end belongs to the last phase, and the start to the next gait step.
        gait_step_tangent_outputs = (
            jnp.concatenate((phase_end.state.q, phase_end.state.v), -2),
            eliminate_duration_tangent(
                jnp.concatenate((phase_end.tangents.q, phase_end.tangents.v), -2)
            ),
            jnp.stack(duration_tangents, 1),
            tuple(acceleration_tangents),
        )
        return (phase_start.state.q, phase_start.tangents.q), gait_step_tangent_outputs


def linearize_steps(
    system: Any,
    parameters: LaneArray,
    trial_solution: CollocationSolution,
    is_phase_active: LaneArray,
    parameter_indices: tuple[int, ...],
) -> tuple[tuple, tuple]:
    """Linearize the equations of gait steps of a `CollocationSystem` at `trial_solution`.

    A phase is inactive if `is_phase_active` is 0. Its duration is 0 s, and only its reset is
    applied. `parameter_indices` selects the parameters to which the parameter tangents belong.

    Return the section state at the end and its tangents. The states at the ends of the steps
    follow, and the tangents of these states, of durations and of accelerations. The directions are
    the Newton correction, the components of the section state at the start, and the parameters.
    """
    float_dtype = parameters.dtype
    phase_constants_tangents: tuple[LaneArray, ...] = ()
    if parameter_indices:
        unit_tangents = np.eye(len(parameters), dtype=float_dtype)[list(parameter_indices)]
        phase_constants, phase_constants_tangents = evaluate_with_jvps(
            system.phase_constants_function,
            tuple(parameters),
            tuple(
                jnp.broadcast_to(x[:, None], (len(parameter_indices), *parameters.shape[1:]))
                for x in unit_tangents.T
            ),
        )
    else:
        phase_constants = system.phase_constants_function(*parameters)
    context = _LinearizationContext(
        system.phase_sequence,
        system.phase_meshes,
        parameter_indices,
        parameters,
        system.phase_constants_function,
        phase_constants,
        phase_constants_tangents,
        make_fusion_barrier(parameters),
    )
    section_state, n_tangents = trial_solution.section_state, context.n_tangents
    unit_tangents = np.eye(n_tangents, dtype=float_dtype)[:, context.section_tangent_slice, None]
    start = section_state, jnp.broadcast_to(unit_tangents, (n_tangents, *section_state.shape))
    step_inputs = (
        trial_solution.durations,
        trial_solution.accelerations,
        is_phase_active > 0.5,
        *system.phase_sequence.list_parities(len(trial_solution.durations), float_dtype),
    )
    if len(trial_solution.durations) > 1:
        return lax.scan(context.linearize_gait_step, start, step_inputs)
    end, outputs = context.linearize_gait_step(start, jax.tree.map(lambda x: x[0], step_inputs))
    return end, jax.tree.map(lambda x: x[None], outputs)


def close_cycle(
    parameters: LaneArray, section_state: LaneArray, end: tuple, outputs: tuple
) -> CycleLinearization:
    """Return the Newton correction, the monodromy matrix and the parameter tangents of a cycle.

    - `section_state`: section state at the start of its first gait step;
    - `end`, `outputs`: results of `linearize_steps`.
    """
    (end_state, end_tangents), n = end, len(section_state)
    prevent_fusion = make_fusion_barrier(parameters)
    section_tangents = slice(1, 1 + n)
    monodromy = jnp.swapaxes(end_tangents[section_tangents], 0, 1)
    drop_section_tangents = lambda x: jnp.concatenate([x[:1], x[1 + n :]])
    correction_direction = np.eye(len(end_tangents) - n, dtype=parameters.dtype)[0][:, None, None]
    right_hand_sides = drop_section_tangents(end_tangents) + correction_direction * (
        end_state - section_state
    )
    closing_matrix = invert_small_matrices(
        jnp.eye(n, dtype=parameters.dtype)[:, :, None] - monodromy
    )
    state_tangents = jnp.swapaxes(
        contract_inner_axis(closing_matrix, jnp.swapaxes(right_hand_sides, 0, 1)), 0, 1
    )

    def close_tangents(open_tangents: Array) -> Array:
        """Return the tangents of the closed cycle, whose section state is an unknown.

        The axes (n, tangent, ...) of the argument become (tangent, n, ...).
        """
        open_tangents = jnp.swapaxes(open_tangents, 0, 1)
        return drop_section_tangents(open_tangents) + contract_inner_axis(
            state_tangents, open_tangents[section_tangents]
        )

    step_end_states, *open_tangents = prevent_fusion(outputs)
    step_end_tangents, *solution_tangents = map(
        functools.partial(jax.tree.map, close_tangents), open_tangents
    )
    step_end_tangents, tangents = prevent_fusion(
        (step_end_tangents, CollocationSolution(state_tangents, *solution_tangents))
    )
    return CycleLinearization(
        newton_correction=jax.tree.map(lambda x: x[0], tangents),
        parameter_tangents=jax.tree.map(lambda x: x[1:], tangents),
        gait_step_end_states=step_end_states + step_end_tangents[0],
        gait_step_end_tangents=step_end_tangents[1:],
        monodromy=monodromy,
    )
