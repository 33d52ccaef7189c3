"""Collocation of a limit cycle: all phases, their durations and the section state together.

Each phase is divided into mesh intervals of four Gauss nodes (order 8). The unknowns are the
section state, the durations of the phases and the accelerations at all nodes. Positions and rates
are explicit functions of the unknowns. `linearize_cycle` visits each interval once and propagates a
few tangents. They are the Newton correction, one tangent for each component of the section state,
one for each requested parameter, and one for the duration of the current phase. The node equations
of an interval are eliminated immediately, the duration of a phase at its event, and the section
state when the cycle is closed. The monodromy matrix and the sensitivities of all unknowns to the
parameters are therefore tangents of the same linearization.

Arrays have batch elements (independent wheels) on their last axis, and no code branches.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool

from vrw_jax.collocation.gauss import (
    DOUBLE_END_WEIGHTS,
    DOUBLE_INTEGRATION_MATRIX,
    END_WEIGHTS,
    GAUSS_NODES,
    INTEGRATION_MATRIX,
    N_GAUSS_NODES,
    PhaseMesh,
    lagrange_weights,
    phase_integration_matrices,
)
from vrw_jax.numerics import (
    Elementwise,
    FusionBarrierFn,
    LaneArray,
    Vector,
    apply_matrix,
    contract_inner_axis,
    evaluate_with_jvps,
    evaluate_with_partials,
    invert_small_matrices,
    make_fusion_barrier,
    solve_node_equations,
    sum_with_weights,
)

PhaseConstants = tuple[Elementwise, ...]
"""Constants of the equations of all phases, one array for each constant."""


class PhasePoint(NamedTuple):
    """State within a phase: the constants held since its start, coordinates and rates."""

    held_constants: Vector
    q: Vector
    v: Vector


class CollocationPhase(NamedTuple):
    """One phase as functions that are elementwise over the batch.

    `residual` is the residual of the equations of motion at (constants, point, acceleration), which
    is linear in the acceleration. The residual costs far less to differentiate than the solved
    equations. The functions `event`, zero at the end, and `guards`, positive inside, take
    (constants, point). `reset` maps the end of the phase to the start of the next phase, and the
    end of the last phase to the section state (in `q`).
    """

    name: str
    n_coordinates: int
    residual: Callable[[PhaseConstants, PhasePoint, Vector], Vector]
    event: Callable[[PhaseConstants, PhasePoint], Elementwise]
    reset: Callable[[PhaseConstants, PhasePoint], PhasePoint]
    guards: Callable[[PhaseConstants, PhasePoint], Vector]
    is_smooth: bool = True  # False if the first interval leaves a fast decaying mode unresolved


class PhaseSequence(NamedTuple):
    """The phases between two crossings of the section, which has `section_size` coordinates.

    `start` maps the section state to the start of the first phase. `admissibility_margins` takes
    the constants, the points of all phases and the flags of active phases. It returns the
    quantities that must be positive in a gait.
    """

    section_size: int
    start: Callable[[PhaseConstants, Vector], PhasePoint]
    phases: tuple[CollocationPhase, ...]
    admissibility_margins: Callable[[PhaseConstants, "tuple[PhasePoints, ...]", Array], Vector]


class CollocationSolution(NamedTuple):
    """Unknowns of a cycle of n gait steps, with the batch on the last axis.

    Each gait step runs the whole phase sequence.
    """

    section_state: LaneArray  # (section_size, batch), at the start of the first gait step
    durations: LaneArray  # (n, n_phases, batch), s
    # for each phase, (n, n_intervals, N_GAUSS_NODES, n_coordinates, batch)
    accelerations: tuple[LaneArray, ...]


class CycleLinearization(NamedTuple):
    """Results of the linearization of a cycle at a trial solution."""

    correction: CollocationSolution  # correction of Newton's method
    tangents: (
        # derivatives with respect to each requested parameter, on a leading axis
        CollocationSolution
    )
    # (n, 2 n_coordinates, batch): corrected coordinates and rates at each step's end
    step_ends: LaneArray
    # their derivatives with respect to each requested parameter, on a leading axis
    step_end_tangents: LaneArray
    monodromy: LaneArray  # (row, column, batch): Jacobian of the return map on the section


class _LinearizationContext(NamedTuple):
    """Inputs of a linearization, and the layout of its tangents.

    The order of the tangents is: the correction; one for each component of the section state; one
    for each parameter in `parameter_indices`; and, within a phase, one for the duration of the
    phase.
    """

    section_size: int
    parameter_indices: tuple[int, ...]
    parameters: LaneArray
    compute_constants: Callable[..., PhaseConstants]
    constants: PhaseConstants
    constants_tangents: tuple[
        LaneArray, ...
    ]  # the tangents of each constant, with respect to the parameters only
    prevent_fusion: FusionBarrierFn

    @property
    def n_tangents(self) -> int:
        """Return the number of tangents outside of a phase."""
        return 1 + self.section_size + len(self.parameter_indices)

    @property
    def section_slice(self) -> slice:
        """Return the slice of the tangents with respect to the section state."""
        return slice(1, 1 + self.section_size)

    def value_and_tangents(self, function: Callable, point: tuple, point_tangents: tuple) -> tuple:
        """Return the value and the tangents of `function(*point, *constants)`."""
        if not self.parameter_indices:
            return evaluate_with_jvps(
                lambda *point: function(*point, *self.constants), point, point_tangents
            )
        n_trailing_axes = point_tangents[0].shape[0] - self.n_tangents
        zero_tangents = (
            (self.section_slice.stop, n_trailing_axes),
            *((0, 0),) * (self.parameters.ndim - 1),
        )
        constants_tangents = (
            jnp.pad(tangent, zero_tangents) for tangent in self.constants_tangents
        )
        return evaluate_with_jvps(
            function, (*point, *self.constants), (*point_tangents, *constants_tangents)
        )


def _make_linearization_context(
    section_size: int,
    parameter_indices: tuple[int, ...],
    parameters: LaneArray,
    compute_constants: Callable[..., PhaseConstants],
) -> _LinearizationContext:
    """Return the context of a linearization, with the constants and their tangents."""
    prevent_fusion = make_fusion_barrier(parameters)
    dtype, lanes = parameters.dtype, parameters.shape[1:]
    unit_parameter_tangents = np.eye(parameters.shape[0], dtype=dtype)[list(parameter_indices)]
    parameter_tangents = tuple(
        jnp.broadcast_to(x[:, None], (len(parameter_indices), *lanes))
        for x in unit_parameter_tangents.T
    )
    if parameter_indices:
        constants, constants_tangents = evaluate_with_jvps(
            compute_constants, tuple(parameters), parameter_tangents
        )
    else:
        constants, constants_tangents = compute_constants(*parameters), ()
    return _LinearizationContext(
        section_size,
        parameter_indices,
        parameters,
        compute_constants,
        constants,
        constants_tangents,
        prevent_fusion,
    )


def _stack_phase_point(point: PhasePoint, template: Array) -> tuple[Array, ...]:
    """Return the parts of a point as arrays, some of which may be empty."""
    empty = jnp.zeros((0, *template.shape[1:]), template.dtype)
    return tuple(jnp.stack(components) if components else empty for components in point)


class _PhaseTangentState(NamedTuple):
    """State within a phase with its tangents, on a leading axis."""

    held_constants: LaneArray
    q: LaneArray
    v: LaneArray
    held_tangents: LaneArray
    q_tangents: LaneArray
    v_tangents: LaneArray


class _MeshInterval(NamedTuple):
    """One mesh interval of a phase."""

    duration_fraction: Array  # length as a fraction of the phase's duration
    h: LaneArray  # length, s
    accelerations: LaneArray  # (node, coordinate, batch)


def _make_unit_tangent(n_tangents: int, tangent_index: int, dtype: Any) -> np.ndarray:
    """Return a unit vector over the tangents, with trailing axes for multiplication."""
    return np.eye(n_tangents, dtype=dtype)[tangent_index][:, None, None, None]


def _evaluate_interval_nodes(
    tangent_state: _PhaseTangentState, mesh_interval: _MeshInterval
) -> tuple[Array, ...]:
    """Return coordinates and rates at the nodes of an interval, and their tangents."""
    duration_fraction, h, accelerations = mesh_interval
    v, q_tangents, v_tangents = tangent_state.v, tangent_state.q_tangents, tangent_state.v_tangents
    nodes = GAUSS_NODES.astype(h.dtype)[:, None, None]
    duration_unit = _make_unit_tangent(q_tangents.shape[0], -1, h.dtype)
    rate_increments = apply_matrix(INTEGRATION_MATRIX, accelerations)
    position_increments = apply_matrix(DOUBLE_INTEGRATION_MATRIX, accelerations)
    node_q = tangent_state.q + h * (nodes * v + h * position_increments)
    node_v = v + h * rate_increments
    node_q_tangents = (
        q_tangents[:, None]
        + (h * nodes) * v_tangents[:, None]
        + duration_unit * (duration_fraction * (nodes * v + 2.0 * h * position_increments))
    )
    node_v_tangents = v_tangents[:, None] + duration_unit * (duration_fraction * rate_increments)
    return node_q, node_v, node_q_tangents, node_v_tangents


def _evaluate_interval_end(
    tangent_state: _PhaseTangentState,
    mesh_interval: _MeshInterval,
    acceleration_tangents: LaneArray,
) -> _PhaseTangentState:
    """Return the state at the end of an interval from its accelerations and their tangents."""
    duration_fraction, h, accelerations = mesh_interval
    _, q, v, _, q_tangents, v_tangents = tangent_state
    duration_unit = _make_unit_tangent(q_tangents.shape[0], -1, h.dtype)[:, 0]
    rate_increment = sum_with_weights(END_WEIGHTS, accelerations)
    position_increment = sum_with_weights(DOUBLE_END_WEIGHTS, accelerations)
    rate_increment_tangents = sum_with_weights(END_WEIGHTS, acceleration_tangents).swapaxes(0, 1)
    position_increment_tangents = sum_with_weights(DOUBLE_END_WEIGHTS, acceleration_tangents)
    position_increment_tangents = position_increment_tangents.swapaxes(0, 1)
    q_tangents = (
        q_tangents
        + h * v_tangents
        + h * h * position_increment_tangents
        + duration_unit * (duration_fraction * (v + 2.0 * h * position_increment))
    )
    v_tangents = (
        v_tangents
        + h * rate_increment_tangents
        + duration_unit * (duration_fraction * rate_increment)
    )
    q, v = q + h * v + h * h * position_increment, v + h * rate_increment
    return tangent_state._replace(q=q, v=v, q_tangents=q_tangents, v_tangents=v_tangents)


def _linearize_residual(
    linearization_context: _LinearizationContext,
    phase: CollocationPhase,
    tangent_state: _PhaseTangentState,
    node_q: LaneArray,
    node_v: LaneArray,
    accelerations: LaneArray,
) -> tuple[Array, Array, Any]:
    """Return the residual of the equations at the nodes and its partial derivatives.

    The Jacobian, with axes (node, equation, argument, batch), is with respect to (q, v,
    acceleration, held constants). The derivatives with respect to the parameters are separate, with
    the parameters on a leading axis.
    """
    n_coordinates, n_held_constants = phase.n_coordinates, tangent_state.held_constants.shape[0]

    def evaluate_residual(*arguments: Array) -> Vector:
        q, v, a = (arguments[i * n_coordinates : (i + 1) * n_coordinates] for i in range(3))
        held_constants = arguments[3 * n_coordinates :][:n_held_constants]
        parameters = arguments[3 * n_coordinates :][n_held_constants:]
        constants = (
            linearization_context.compute_constants(*parameters)
            if linearization_context.parameter_indices
            else linearization_context.constants
        )
        return phase.residual(constants, PhasePoint(held_constants, q, v), a)

    residual_arguments = [
        residual_argument[:, argument_offset]
        for residual_argument in (node_q, node_v, accelerations)
        for argument_offset in range(n_coordinates)
    ]
    residual_arguments += [
        jnp.broadcast_to(residual_argument, node_q[:, 0].shape)
        for residual_argument in tangent_state.held_constants
    ]
    n_state_arguments = len(residual_arguments)
    if linearization_context.parameter_indices:
        residual_arguments += [
            jnp.broadcast_to(residual_argument, node_q[:, 0].shape)
            for residual_argument in linearization_context.parameters
        ]
    # The partial derivatives stay separate arrays at first, because each is a small kernel and
    # stacking them is a copy.
    residual_value, partials_by_output = linearization_context.prevent_fusion(
        evaluate_with_partials(evaluate_residual, residual_arguments)
    )
    partials_by_argument = list(zip(*partials_by_output, strict=True))
    jacobian = jnp.stack(
        [
            jnp.stack(partials_of_argument, 1)
            for partials_of_argument in partials_by_argument[:n_state_arguments]
        ],
        2,
    )
    parameter_partials = [
        jnp.stack(partials_by_argument[n_state_arguments + argument_offset], 1)
        for argument_offset in linearization_context.parameter_indices
    ]
    return linearization_context.prevent_fusion(
        (
            jnp.stack(residual_value, 1),
            jacobian,
            jnp.stack(parameter_partials) if parameter_partials else (),
        )
    )


def _assemble_node_system(
    linearization_context: _LinearizationContext,
    tangent_state: _PhaseTangentState,
    h: LaneArray,
    linearization: tuple,
    state_tangents: LaneArray,
) -> tuple[Array, Array]:
    """Return the matrix and the right-hand sides of the equations for corrections of the
    accelerations.

    There is one right-hand side for each tangent.
    """
    residual_value, jacobian, parameter_partials = linearization
    n_tangents, n_coordinates, dtype = state_tangents.shape[0], residual_value.shape[1], h.dtype
    tangent_terms = [
        jacobian[:, :, argument_index] * state_tangents[:, :, argument_index, None]
        for argument_index in range(2 * n_coordinates)
    ]
    tangent_terms += [
        jacobian[:, :, 3 * n_coordinates + argument_index]
        * tangent_state.held_tangents[:, argument_index, None, None]
        for argument_index in range(tangent_state.held_constants.shape[0])
    ]
    right_hand_sides = sum(
        tangent_terms, start=_make_unit_tangent(n_tangents, 0, dtype) * residual_value
    )
    if linearization_context.parameter_indices:
        n_leading = linearization_context.n_tangents - len(linearization_context.parameter_indices)
        right_hand_sides = right_hand_sides + jnp.pad(
            parameter_partials, ((n_leading, 1), *((0, 0),) * 3)
        )
    double_matrix, single_matrix = (
        matrix.astype(dtype)[:, None, :, None, None]
        for matrix in (DOUBLE_INTEGRATION_MATRIX, INTEGRATION_MATRIX)
    )
    jacobian_q, jacobian_v, jacobian_a = (
        jacobian[:, :, None, i * n_coordinates : (i + 1) * n_coordinates] for i in range(3)
    )
    node_diagonal = np.eye(N_GAUSS_NODES, dtype=dtype)[:, None, :, None, None]
    system_matrix = node_diagonal * jacobian_a + h * (
        h * double_matrix * jacobian_q + single_matrix * jacobian_v
    )
    return system_matrix, -jnp.moveaxis(right_hand_sides, 0, 2)


def _linearize_phase(
    linearization_context: _LinearizationContext,
    phase: CollocationPhase,
    mesh: PhaseMesh,
    tangent_state: _PhaseTangentState,
    duration: LaneArray,
    accelerations: LaneArray,
) -> tuple[_PhaseTangentState, LaneArray]:
    """Return the state at the end of a phase, and the tangents of the phase's accelerations.

    Within the phase there is one more tangent, the last one. It belongs to the duration of the
    phase.
    """
    append_duration_tangent = lambda x: jnp.concatenate([x, jnp.zeros_like(x[:1])])
    tangent_state = tangent_state._replace(
        held_tangents=append_duration_tangent(tangent_state.held_tangents),
        q_tangents=append_duration_tangent(tangent_state.q_tangents),
        v_tangents=append_duration_tangent(tangent_state.v_tangents),
    )

    def linearize_interval(interval_state: tuple, interval_inputs: tuple) -> tuple[tuple, Array]:
        accelerations, duration_fraction = interval_inputs
        mesh_interval = _MeshInterval(
            duration_fraction, duration_fraction * duration, accelerations
        )
        start_state = tangent_state._replace(
            **dict(zip(PROPAGATED_STATE_FIELDS, interval_state, strict=True))
        )
        node_q, node_v, node_q_tangents, node_v_tangents = linearization_context.prevent_fusion(
            _evaluate_interval_nodes(start_state, mesh_interval)
        )
        linearization = _linearize_residual(
            linearization_context, phase, start_state, node_q, node_v, accelerations
        )
        # Axes: (tangent, node, argument, batch).
        state_tangents = jnp.concatenate([node_q_tangents, node_v_tangents], 2)
        node_system = linearization_context.prevent_fusion(
            _assemble_node_system(
                linearization_context, start_state, mesh_interval.h, linearization, state_tangents
            )
        )
        # Axes: (node, row, tangent, batch).
        acceleration_tangents = linearization_context.prevent_fusion(
            solve_node_equations(*node_system, linearization_context.parameters)
        )
        end_state = _evaluate_interval_end(start_state, mesh_interval, acceleration_tangents)
        next_state = tuple(getattr(end_state, name) for name in PROPAGATED_STATE_FIELDS)
        return next_state, jnp.moveaxis(acceleration_tangents, 2, 0)

    start_state = tuple(getattr(tangent_state, name) for name in PROPAGATED_STATE_FIELDS)
    interval_fractions = jnp.asarray(mesh.interval_fractions, duration.dtype)
    end_state, acceleration_tangents = lax.scan(
        linearize_interval, start_state, (accelerations, interval_fractions)
    )
    end_fields = dict(zip(PROPAGATED_STATE_FIELDS, end_state, strict=True))
    return tangent_state._replace(**end_fields), acceleration_tangents


PROPAGATED_STATE_FIELDS = ("q", "v", "q_tangents", "v_tangents")
"""Names of the fields of `_PhaseTangentState` that change within a phase."""


def _eliminate_duration(
    linearization_context: _LinearizationContext,
    phase: CollocationPhase,
    tangent_state: _PhaseTangentState,
    duration: LaneArray,
    is_phase_active: Bool[Array, " lanes"],
) -> tuple[_PhaseTangentState, LaneArray, Callable[[Array], Array]]:
    """Eliminate the duration of a phase by its event, and apply the reset.

    Return the state of the next phase, the tangents of the duration, and the function that
    eliminates the duration's tangent from other tangents. An inactive phase has duration zero.
    """

    def evaluate_end(held_constants: Array, q: Array, v: Array, *constants: Array) -> tuple:
        point = PhasePoint(tuple(held_constants), tuple(q), tuple(v))
        return phase.event(constants, point), _stack_phase_point(phase.reset(constants, point), q)

    end_point = tangent_state.held_constants, tangent_state.q, tangent_state.v
    point_tangents = tangent_state.held_tangents, tangent_state.q_tangents, tangent_state.v_tangents
    (event_value, next_point), (event_tangents, next_point_tangents) = (
        linearization_context.value_and_tangents(evaluate_end, end_point, point_tangents)
    )
    correction_unit, duration_unit = (
        _make_unit_tangent(event_tangents.shape[0], i, duration.dtype)[:, 0, 0] for i in (0, -1)
    )
    event_value = jnp.where(is_phase_active, event_value, duration)
    event_tangents = jnp.where(is_phase_active, event_tangents, duration_unit)
    duration_tangents = (
        -(event_tangents[:-1] + correction_unit[:-1] * event_value) / event_tangents[-1]
    )

    def eliminate_duration(tangents: Array) -> Array:
        duration_factor = duration_tangents.reshape(
            duration_tangents.shape[:1] + (1,) * (tangents.ndim - 2) + (-1,)
        )
        return tangents[:-1] + duration_factor * tangents[-1:]

    next_state = _PhaseTangentState(
        *next_point, *(eliminate_duration(x) for x in next_point_tangents)
    )
    return next_state, duration_tangents, eliminate_duration


def _linearize_gait_step(
    linearization_context: _LinearizationContext,
    phase_sequence: PhaseSequence,
    phase_meshes: tuple[PhaseMesh, ...],
    section_and_tangents: tuple,
    step_inputs: tuple,
) -> tuple:
    """Propagate the section state and its tangents through one gait step, and return them."""
    section_state, section_tangents = section_and_tangents
    durations, accelerations, is_phase_active = step_inputs

    def evaluate_start(section_state: Array, *constants: Array) -> tuple:
        return _stack_phase_point(
            phase_sequence.start(constants, tuple(section_state)), section_state
        )

    start_point, start_tangents = linearization_context.value_and_tangents(
        evaluate_start, (section_state,), (section_tangents,)
    )
    tangent_state = _PhaseTangentState(*start_point, *start_tangents)
    duration_tangents, acceleration_tangents = [], []
    for i, phase in enumerate(phase_sequence.phases):
        tangent_state, phase_acceleration_tangents = _linearize_phase(
            linearization_context,
            phase,
            phase_meshes[i],
            tangent_state,
            durations[i],
            accelerations[i],
        )
        phase_end_state = jnp.concatenate((tangent_state.q, tangent_state.v), -2)
        phase_end_tangents = jnp.concatenate(
            (tangent_state.q_tangents, tangent_state.v_tangents), -2
        )
        tangent_state, phase_duration_tangents, eliminate_duration = _eliminate_duration(
            linearization_context, phase, tangent_state, durations[i], is_phase_active[i]
        )
        duration_tangents.append(phase_duration_tangents)
        # Axes: (tangent, interval, node, row, batch).
        acceleration_tangents.append(
            eliminate_duration(jnp.swapaxes(phase_acceleration_tangents, 0, 1))
        )
        tangent_state = linearization_context.prevent_fusion(tangent_state)
    # The end state and its tangents are those of the last phase.
    step_outputs = (
        phase_end_state,
        eliminate_duration(phase_end_tangents),
        jnp.stack(duration_tangents, 1),
        tuple(acceleration_tangents),
    )
    return (tangent_state.q, tangent_state.q_tangents), step_outputs


def linearize_cycle(
    phase_sequence: PhaseSequence,
    phase_meshes: tuple[PhaseMesh, ...],
    compute_constants: Callable[..., PhaseConstants],
    parameters: LaneArray,
    solution: CollocationSolution,
    is_phase_active: Bool[Array, "n n_phases lanes"],
    parameter_indices: tuple[int, ...] = (),
) -> CycleLinearization:
    """Return Newton's correction, the monodromy matrix and the requested tangents at `solution`.

    `is_phase_active` marks the phases that take place. An inactive phase has duration zero and only
    applies its reset.
    """
    linearization_context = _make_linearization_context(
        phase_sequence.section_size, parameter_indices, parameters, compute_constants
    )
    section_state, dtype, n_tangents = (
        solution.section_state,
        parameters.dtype,
        linearization_context.n_tangents,
    )
    section_units = np.eye(n_tangents, dtype=dtype)[:, linearization_context.section_slice, None]
    section_and_tangents = (
        section_state,
        jnp.broadcast_to(section_units, (n_tangents, *section_state.shape)),
    )
    step_inputs = (solution.durations, solution.accelerations, is_phase_active)
    linearize_step = functools.partial(
        _linearize_gait_step, linearization_context, phase_sequence, phase_meshes
    )
    if solution.durations.shape[0] == 1:
        (return_state, return_tangents), step_outputs = linearize_step(
            section_and_tangents, jax.tree.map(lambda x: x[0], step_inputs)
        )
        step_outputs = jax.tree.map(lambda x: x[None], step_outputs)
    else:
        (return_state, return_tangents), step_outputs = lax.scan(
            linearize_step, section_and_tangents, step_inputs
        )

    monodromy = jnp.swapaxes(return_tangents[linearization_context.section_slice], 0, 1)
    drop_section_tangents = lambda x: jnp.concatenate(
        [x[:1], x[linearization_context.section_slice.stop :]]
    )
    correction_unit_vector = np.eye(n_tangents - linearization_context.section_size, dtype=dtype)[
        0
    ][:, None, None]
    right_hand_sides = drop_section_tangents(return_tangents) + correction_unit_vector * (
        return_state - section_state
    )
    closing_matrix = invert_small_matrices(
        jnp.eye(linearization_context.section_size, dtype=dtype)[:, :, None] - monodromy
    )
    closed_section_tangents = jnp.swapaxes(
        contract_inner_axis(closing_matrix, jnp.swapaxes(right_hand_sides, 0, 1)), 0, 1
    )

    def close_cycle(tangents: Array) -> Array:
        """Return (tangent, n, ...) from (n, tangent, ...) without the tangents of the section
        state.
        """
        tangents = jnp.swapaxes(tangents, 0, 1)
        shape = (-1, *(1,) * (tangents.ndim - 2), *section_state.shape[1:])
        section_tangents = tangents[linearization_context.section_slice]
        section_terms = [
            closed_section_tangents[:, section_index].reshape(shape)
            * section_tangents[section_index]
            for section_index in range(len(section_state))
        ]
        return drop_section_tangents(tangents) + sum(section_terms[1:], start=section_terms[0])

    step_ends, *uncorrected_tangents = linearization_context.prevent_fusion(step_outputs)
    step_end_tangents, duration_tangents, acceleration_tangents = jax.tree.map(
        close_cycle, tuple(uncorrected_tangents)
    )
    step_end_tangents, solution_tangents = linearization_context.prevent_fusion(
        (
            step_end_tangents,
            CollocationSolution(closed_section_tangents, duration_tangents, acceleration_tangents),
        )
    )
    return CycleLinearization(
        correction=jax.tree.map(lambda x: x[0], solution_tangents),
        tangents=jax.tree.map(lambda x: x[1:], solution_tangents),
        step_ends=step_ends + step_end_tangents[0],
        step_end_tangents=step_end_tangents[1:],
        monodromy=monodromy,
    )


class PhasePoints(NamedTuple):
    """Points of one phase: its start, its end and all nodes (on a leading axis)."""

    start: PhasePoint
    nodes: PhasePoint
    end: PhasePoint


def reconstruct_step(
    phase_sequence: PhaseSequence,
    phase_meshes: tuple[PhaseMesh, ...],
    constants: PhaseConstants,
    section_state: Vector,
    durations: Array,
    accelerations: tuple[Array, ...],
) -> tuple[Vector, tuple[PhasePoints, ...]]:
    """Return the section state after a gait step, and the points of its phases.

    Durations and accelerations of the step are known, so no equation is solved. Any trailing axes
    are allowed.
    """
    start_point = phase_sequence.start(constants, section_state)
    phase_points = []
    for i, phase in enumerate(phase_sequence.phases):
        node_times, rate_matrix, position_matrix = (
            weights.astype(durations.dtype)
            for weights in phase_integration_matrices(phase_meshes[i])
        )
        phase_accelerations, duration = accelerations[i], durations[i]
        phase_accelerations = phase_accelerations.reshape(-1, *phase_accelerations.shape[2:])
        q, v = jnp.stack(start_point.q), jnp.stack(start_point.v)
        node_times = node_times.reshape(-1, *(1,) * q.ndim)
        node_q = q + duration * (
            node_times * v + duration * jnp.tensordot(position_matrix, phase_accelerations, 1)
        )
        node_v = v + duration * jnp.tensordot(rate_matrix, phase_accelerations, 1)
        node_points = PhasePoint(
            start_point.held_constants,
            tuple(node_q[:-1].swapaxes(0, 1)),
            tuple(node_v[:-1].swapaxes(0, 1)),
        )
        end_point = PhasePoint(start_point.held_constants, tuple(node_q[-1]), tuple(node_v[-1]))
        phase_points.append(PhasePoints(start_point, node_points, end_point))
        start_point = phase.reset(constants, end_point)
    return start_point.q, tuple(phase_points)


def estimate_mesh_error(
    phase_sequence: PhaseSequence,
    phase_meshes: tuple[PhaseMesh, ...],
    solution: CollocationSolution,
    error_per_jump: float = 0.05,
) -> LaneArray:
    """Return an estimate of the discretization error of a cycle, in rad, m and fractions of the
    period, (batch,).

    The accelerations of each interval are a separate polynomial. At an interval boundary the two
    polynomials differ by their errors. That jump times the square of the longer interval is a
    displacement, which is multiplied by `error_per_jump`. Phases with `is_smooth` False do not
    count, because their error in one interval hardly affects the next phase.

    - `error_per_jump`: factor chosen because the estimate then bounds the error except for
      round-off. It was tested with 346 random gaits of periods to 10 s on two meshes. For most of
      them the estimate is far above the error.
    """
    largest_acceleration_jump = jnp.zeros(
        solution.section_state.shape[-1], solution.section_state.dtype
    )
    for i, mesh in enumerate(phase_meshes):
        if mesh.n_intervals == 1 or not phase_sequence.phases[i].is_smooth:
            continue
        left_limits, right_limits = (
            jnp.tensordot(
                jnp.asarray(lagrange_weights(interval_location), largest_acceleration_jump.dtype),
                node_accelerations,
                (0, 2),
            )
            for interval_location, node_accelerations in (
                (1.0, solution.accelerations[i][:, :-1]),
                (0.0, solution.accelerations[i][:, 1:]),
            )
        )
        max_fraction = np.maximum(mesh.interval_fractions[1:], mesh.interval_fractions[:-1])
        longer_interval_length = (
            max_fraction[:, None, None].astype(largest_acceleration_jump.dtype)
            * solution.durations[:, None, None, i]
        )
        acceleration_jump = (
            jnp.abs(left_limits - right_limits) * longer_interval_length * longer_interval_length
        )
        largest_acceleration_jump = jnp.maximum(
            largest_acceleration_jump, jnp.max(acceleration_jump, axis=(0, 1, 2))
        )
    return error_per_jump * largest_acceleration_jump
