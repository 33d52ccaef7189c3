"""Define Gauss nodes, integration matrices and graded meshes in time, independent of any model."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from numpy.polynomial import legendre

from vrw_jax.base.elementwise import Elementwise, LaneArray, Vector

N_GAUSS_NODES = 4
"""Number of Gauss nodes per mesh interval. The value is chosen because a method of order 8 reaches
errors of 1e-8 with few intervals.
"""

GAUSS_NODES = (legendre.leggauss(N_GAUSS_NODES)[0] + 1.0) / 2.0
"""Nodes of Gauss collocation as locations in [0, 1], in increasing order."""
_MONOMIAL_POWERS = np.arange(N_GAUSS_NODES)
_COEFFICIENTS_FROM_NODE_VALUES = np.linalg.inv(GAUSS_NODES[:, None] ** _MONOMIAL_POWERS)
"""Matrix that maps the values of a polynomial at the nodes to its coefficients, in
increasing powers.
"""
INTEGRATION_MATRIX = (
    GAUSS_NODES[:, None] ** (_MONOMIAL_POWERS + 1) / (_MONOMIAL_POWERS + 1)
) @ _COEFFICIENTS_FROM_NODE_VALUES
"""Matrix that maps node values to their integrals from the start of the interval to each node.

The interval has length 1.
"""
END_WEIGHTS = (1.0 / (_MONOMIAL_POWERS + 1)) @ _COEFFICIENTS_FROM_NODE_VALUES
"""Weights that the node values have in the integral over an interval of length 1."""
DOUBLE_INTEGRATION_MATRIX = INTEGRATION_MATRIX @ INTEGRATION_MATRIX
"""Matrix that maps node values to their double integrals from the start of the interval to each
node.

The interval has length 1.
"""
DOUBLE_END_WEIGHTS = END_WEIGHTS @ INTEGRATION_MATRIX
"""Weights that the node values have in the double integral over an interval of length 1."""


class PhaseMesh(NamedTuple):
    """Mesh of one phase, in which the lengths of the intervals form a geometric sequence.

    The last interval is about `grading` times as long as the first interval.
    """

    n_intervals: int
    grading: float

    @property
    def interval_length_fractions(self) -> np.ndarray:
        """Return the length of each mesh interval as a fraction of the phase's duration."""
        interval_boundary_fractions = np.linspace(0.0, 1.0, self.n_intervals + 1)
        log_grading = np.log(self.grading)
        if abs(log_grading) > 1e-12:
            interval_boundary_fractions = np.expm1(
                log_grading * interval_boundary_fractions
            ) / np.expm1(log_grading)
        return np.diff(interval_boundary_fractions)

    @property
    def interval_boundary_fractions(self) -> np.ndarray:
        """Return the time of each interval boundary as a fraction of the phase's duration."""
        return np.concatenate([[0.0], np.cumsum(self.interval_length_fractions)])

    @property
    def node_time_fractions(self) -> np.ndarray:
        """Return the time of each node as a fraction of the phase's duration.

        Times are measured from the start of the phase.
        """
        interval_starts = self.interval_boundary_fractions[:-1, None]
        return (interval_starts + self.interval_length_fractions[:, None] * GAUSS_NODES).ravel()


def build_phase_integration_matrices(phase_mesh: PhaseMesh) -> tuple[np.ndarray, ...]:
    """Return node times, and matrices that map node accelerations to rates and to positions.

    The phase has duration 1 and starts at rest at the origin. The times and the rows of the
    matrices belong to the nodes in the order of time. The last row belongs to the end of the phase.
    """
    n_nodes = phase_mesh.n_intervals * N_GAUSS_NODES
    integration_matrix = np.zeros((n_nodes + 1, n_nodes))
    for interval_index, h in enumerate(phase_mesh.interval_length_fractions):
        start, end = interval_index * N_GAUSS_NODES, (interval_index + 1) * N_GAUSS_NODES
        integration_matrix[start:end, start:end] = h * INTEGRATION_MATRIX
        integration_matrix[end:, start:end] = h * END_WEIGHTS
    # Positions are integrals of the rates at the nodes.
    position_matrix = integration_matrix @ integration_matrix[:-1]
    return np.append(phase_mesh.node_time_fractions, 1.0), integration_matrix, position_matrix


def compute_lagrange_weights(location_in_interval: float) -> np.ndarray:
    """Return the weights with which node values enter the interpolated value at one location.

    The value is that of the polynomial through the node values. `location_in_interval` is the time
    since the start of the mesh interval, in interval lengths. The weights have the shape
    (N_GAUSS_NODES,).
    """
    node_differences = GAUSS_NODES[:, None] - GAUSS_NODES + np.eye(N_GAUSS_NODES)
    lagrange_factors = np.where(
        np.eye(N_GAUSS_NODES, dtype=bool),
        1.0,
        (location_in_interval - GAUSS_NODES) / node_differences,
    )
    return np.prod(lagrange_factors, axis=1)


def transfer_accelerations(
    source_mesh: PhaseMesh, target_mesh: PhaseMesh, node_accelerations: Array
) -> Array:
    """Return the node accelerations of one phase on another mesh.

    The axes of the accelerations are (interval, node, ...). The transfer is exact for accelerations
    that are cubic polynomials in each interval of the source mesh.
    """
    source_boundaries = source_mesh.interval_boundary_fractions
    target_node_fractions = target_mesh.node_time_fractions
    transfer_matrix = np.zeros((len(target_node_fractions), len(source_mesh.node_time_fractions)))
    source_interval_indices = np.searchsorted(source_boundaries[1:-1], target_node_fractions)
    for node_index, interval_index in enumerate(source_interval_indices):
        location_in_interval = (
            target_node_fractions[node_index] - source_boundaries[interval_index]
        ) / source_mesh.interval_length_fractions[interval_index]
        first_source_node = interval_index * N_GAUSS_NODES
        transfer_matrix[node_index, first_source_node : first_source_node + N_GAUSS_NODES] = (
            compute_lagrange_weights(location_in_interval)
        )
    trailing_shape = node_accelerations.shape[2:]
    return jnp.tensordot(
        jnp.asarray(transfer_matrix, node_accelerations.dtype),
        node_accelerations.reshape(transfer_matrix.shape[1], *trailing_shape),
        1,
    ).reshape(target_mesh.n_intervals, N_GAUSS_NODES, *trailing_shape)


def compute_integration_weights(location_in_interval: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the weights with which node values enter the single and the double integral.

    The integrals extend from 0 to `location_in_interval`, the time since the start of the mesh
    interval in interval lengths. Each array of weights has the shape (N_GAUSS_NODES,).
    """
    monomial_integrals = location_in_interval ** (_MONOMIAL_POWERS + 1) / (_MONOMIAL_POWERS + 1)
    monomial_double_integrals = location_in_interval * monomial_integrals / (_MONOMIAL_POWERS + 2)
    return (
        monomial_integrals @ _COEFFICIENTS_FROM_NODE_VALUES,
        monomial_double_integrals @ _COEFFICIENTS_FROM_NODE_VALUES,
    )


PhaseConstants = tuple[Elementwise, ...]
"""Constants in the equations of motion of all phases, one array per constant."""


class PhasePoint(NamedTuple):
    """State at one time of a phase: coordinates, rates and held constants.

    The held constants are set at the start of the phase and do not change during the phase.
    """

    held_constants: Vector
    q: Vector
    v: Vector


class CollocationPhase(NamedTuple):
    """One phase of a gait step, described by functions that are elementwise over the batch.

    - `residual_function` maps (constants, point, accelerations) to the residual of the equations of
      motion. The residual is linear in the accelerations, and its derivatives are far cheaper than
      those of the solved equations.
    - `end_event_function` maps (constants, point) to a scalar that is zero at the end of the phase.
    - `guards_function` maps (constants, point) to guards that are positive during the phase.
    - `reset_map` maps (constants, end point) to the start point of the next phase. The reset of the
      last phase returns the section state as `q`.
    """

    phase_name: str
    n_coordinates: int
    residual_function: Callable[[PhaseConstants, PhasePoint, Vector], Vector]
    end_event_function: Callable[[PhaseConstants, PhasePoint], Elementwise]
    reset_map: Callable[[PhaseConstants, PhasePoint], PhasePoint]
    guards_function: Callable[[PhaseConstants, PhasePoint], Vector]
    # False if the first interval does not resolve a rapidly decaying mode
    is_motion_smooth: bool = True


class PhaseSequence(NamedTuple):
    """Sequence of the phases between two crossings of the section.

    `section_size` is the number of section coordinates. `step_start_map` maps (constants, section
    state) to the start point of the first phase. `margins_function` maps (constants, points of all
    phases, flags of active phases) to the margins, which are positive if the gait is admissible.
    `constants_of_step` maps (constants, parity) to the constants of a gait step, if they alternate.
    The parity is 1 for the second of two gait steps, and 0 for the first.
    """

    section_size: int
    step_start_map: Callable[[PhaseConstants, Vector], PhasePoint]
    phases: tuple[CollocationPhase, ...]
    margins_function: Callable[[PhaseConstants, "tuple[PhasePoints, ...]", Array], Vector]
    constants_of_step: Callable[[PhaseConstants, Any], PhaseConstants] | None = None

    def list_parities(self, n_gait_steps: int, dtype: Any) -> tuple[Array, ...]:
        """Return the parity of each gait step as an input of a loop, or nothing."""
        if self.constants_of_step is None:
            return ()
        return (jnp.asarray(np.arange(n_gait_steps) % 2, dtype),)

    def select_constants(
        self, phase_constants: PhaseConstants, parity: Sequence[Any]
    ) -> PhaseConstants:
        """Return the constants of a gait step, whose parity is the only entry if they alternate."""
        if self.constants_of_step is None:
            return phase_constants
        return self.constants_of_step(phase_constants, *parity)


class CollocationSolution(NamedTuple):
    """Unknowns of a cycle that consists of n gait steps. The last axis contains the batch elements.

    Each gait step consists of all phases of the sequence.
    """

    section_state: LaneArray  # (section_size, batch), at the start of the first gait step
    durations: LaneArray  # (n, n_phases, batch), s
    # one array per phase: (n, n_intervals, N_GAUSS_NODES, n_coordinates, batch)
    accelerations: tuple[LaneArray, ...]


class PhasePoints(NamedTuple):
    """Points of one phase: the start point, all node points (on a leading axis) and the
    end point.
    """

    phase_start_point: PhasePoint
    node_points: PhasePoint
    phase_end_point: PhasePoint


def reconstruct_gait_step(
    system: Any,
    phase_constants: PhaseConstants,
    section_state: Vector,
    phase_durations: Array,
    accelerations_by_phase: tuple[Array, ...],
) -> tuple[Vector, tuple[PhasePoints, ...]]:
    """Reconstruct the motion of a gait step from its phase durations and node accelerations.

    Return the section state at the end of the gait step, and the points of each phase. No equation
    is solved. Arrays may have additional trailing axes.
    """
    phase_start_point = system.phase_sequence.step_start_map(phase_constants, section_state)
    phase_points = []
    for i, collocation_phase in enumerate(system.phase_sequence.phases):
        node_times, rate_integration_matrix, position_integration_matrix = (
            float64_weights.astype(phase_durations.dtype)
            for float64_weights in build_phase_integration_matrices(system.phase_meshes[i])
        )
        phase_accelerations = accelerations_by_phase[i]
        phase_accelerations = phase_accelerations.reshape(-1, *phase_accelerations.shape[2:])
        phase_duration = phase_durations[i]
        q = jnp.stack(phase_start_point.q)
        v = jnp.stack(phase_start_point.v)
        node_times = node_times.reshape(-1, *(1,) * q.ndim)
        node_q = q + phase_duration * (
            node_times * v
            + phase_duration * jnp.tensordot(position_integration_matrix, phase_accelerations, 1)
        )
        node_v = v + phase_duration * jnp.tensordot(rate_integration_matrix, phase_accelerations, 1)
        node_points = PhasePoint(
            phase_start_point.held_constants,
            tuple(node_q[:-1].swapaxes(0, 1)),
            tuple(node_v[:-1].swapaxes(0, 1)),
        )
        phase_end_point = PhasePoint(
            phase_start_point.held_constants, tuple(node_q[-1]), tuple(node_v[-1])
        )
        phase_points.append(PhasePoints(phase_start_point, node_points, phase_end_point))
        phase_start_point = collocation_phase.reset_map(phase_constants, phase_end_point)
    return phase_start_point.q, tuple(phase_points)


ERROR_PER_ACCELERATION_JUMP = 0.05
"""Factor of `estimate_mesh_error`. The value is chosen because, except for round-off, the estimate
bounds the error in tests with random gaits that have periods up to 10 s. For most gaits the
estimate is far above the error.
"""


def estimate_mesh_error(system: Any, collocation_solution: CollocationSolution) -> LaneArray:
    """Estimate the discretization error of a cycle for each batch element, shape (batch,).

    The unit is rad for angles and m for lengths; times are in units of the period. The
    accelerations are a separate polynomial in each mesh interval. At the boundary between two
    intervals, the two polynomials differ by their errors. Each such jump is multiplied by the
    square of the longer interval. The estimate is the largest product, multiplied by
    `ERROR_PER_ACCELERATION_JUMP`. Phases whose `is_motion_smooth` is False are ignored, because
    their error in one interval hardly affects the next phase.
    """
    section_state = collocation_solution.section_state
    float_dtype = section_state.dtype
    largest_acceleration_jump = jnp.zeros(section_state.shape[-1], float_dtype)

    def interpolate_accelerations(location_in_interval: float, accelerations: Array) -> Array:
        lagrange_weights = compute_lagrange_weights(location_in_interval)
        return jnp.tensordot(jnp.asarray(lagrange_weights, float_dtype), accelerations, (0, 2))

    for i, phase_mesh in enumerate(system.phase_meshes):
        if phase_mesh.n_intervals == 1 or not system.phase_sequence.phases[i].is_motion_smooth:
            continue
        accelerations = collocation_solution.accelerations[i]
        before = interpolate_accelerations(1.0, accelerations[:, :-1])
        after = interpolate_accelerations(0.0, accelerations[:, 1:])
        fractions = phase_mesh.interval_length_fractions
        longer_fraction = np.maximum(fractions[1:], fractions[:-1])
        longer_length = (
            longer_fraction[:, None, None].astype(float_dtype)
            * collocation_solution.durations[:, None, None, i]
        )
        acceleration_jump = jnp.abs(before - after) * longer_length * longer_length
        largest_acceleration_jump = jnp.maximum(
            largest_acceleration_jump, jnp.max(acceleration_jump, axis=(0, 1, 2))
        )
    return ERROR_PER_ACCELERATION_JUMP * largest_acceleration_jump
