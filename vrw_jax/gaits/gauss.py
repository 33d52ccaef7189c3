"""Define Gauss nodes, integration matrices and graded meshes in time, independent of any model."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from numpy.polynomial import legendre

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
