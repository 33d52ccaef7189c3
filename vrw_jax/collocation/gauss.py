"""Gauss nodes and integration matrices of a mesh in time, independent of the model."""

from typing import NamedTuple

import numpy as np
from numpy.polynomial import legendre

N_GAUSS_NODES = 4
"""Number of Gauss nodes in a mesh interval, chosen because order 8 reaches errors of 1e-8 with
few intervals.
"""

GAUSS_NODES = (legendre.leggauss(N_GAUSS_NODES)[0] + 1.0) / 2.0
"""Nodes of the Gauss collocation on [0, 1]."""
_MONOMIAL_POWERS = np.arange(N_GAUSS_NODES)
_INTERPOLATION_MATRIX = np.linalg.inv(GAUSS_NODES[:, None] ** _MONOMIAL_POWERS)
"""Matrix from values at the nodes to the coefficients of their polynomial, the constant first."""
INTEGRATION_MATRIX = (
    GAUSS_NODES[:, None] ** (_MONOMIAL_POWERS + 1) / (_MONOMIAL_POWERS + 1)
) @ _INTERPOLATION_MATRIX
"""Matrix that integrates node values from an interval's start to its nodes, for an interval of
length 1.
"""
END_WEIGHTS = (1.0 / (_MONOMIAL_POWERS + 1)) @ _INTERPOLATION_MATRIX
"""Weights that integrate node values over an interval."""
DOUBLE_INTEGRATION_MATRIX = INTEGRATION_MATRIX @ INTEGRATION_MATRIX
"""Matrix that integrates node values twice, from an interval's start to its nodes."""
DOUBLE_END_WEIGHTS = END_WEIGHTS @ INTEGRATION_MATRIX
"""Weights that integrate node values twice over an interval."""


class PhaseMesh(NamedTuple):
    """Mesh intervals of one phase as fractions of its duration.

    The length of the last interval is `grading` times that of the first.
    """

    n_intervals: int
    grading: float

    @property
    def interval_fractions(self) -> np.ndarray:
        """Return the length of each interval as a fraction of the phase's duration."""
        boundary_fractions = np.linspace(0.0, 1.0, self.n_intervals + 1)
        log_grading = np.log(self.grading)
        if abs(log_grading) > 1e-12:
            boundary_fractions = np.expm1(log_grading * boundary_fractions) / np.expm1(log_grading)
        return np.diff(boundary_fractions)

    @property
    def node_fractions(self) -> np.ndarray:
        """Return the times of all nodes as fractions of the phase's duration."""
        interval_starts = np.cumsum(self.interval_fractions) - self.interval_fractions
        return (interval_starts[:, None] + self.interval_fractions[:, None] * GAUSS_NODES).ravel()


def phase_integration_matrices(mesh: PhaseMesh) -> tuple[np.ndarray, ...]:
    """Return matrices from a phase's accelerations to its rates and positions, at its nodes and its
    end.

    They hold for a phase of duration 1 that begins at rest at the origin. Nodes are in order, and
    the end is the last row.
    """
    n = mesh.n_intervals * N_GAUSS_NODES
    rate_matrix, position_matrix = np.zeros((n + 1, n)), np.zeros((n + 1, n))
    node_times = np.ones(n + 1)
    interval_rate_weights, interval_position_weights, interval_start = np.zeros(n), np.zeros(n), 0.0
    for i, h in enumerate(mesh.interval_fractions):
        node_slice = slice(i * N_GAUSS_NODES, (i + 1) * N_GAUSS_NODES)
        rate_matrix[node_slice] = interval_rate_weights
        position_matrix[node_slice] = (
            interval_position_weights + h * GAUSS_NODES[:, None] * interval_rate_weights
        )
        rate_matrix[node_slice, node_slice] += h * INTEGRATION_MATRIX
        position_matrix[node_slice, node_slice] += h * h * DOUBLE_INTEGRATION_MATRIX
        node_times[node_slice] = interval_start + h * GAUSS_NODES
        interval_position_weights = interval_position_weights + h * interval_rate_weights
        interval_position_weights[node_slice] += h * h * DOUBLE_END_WEIGHTS
        interval_rate_weights = interval_rate_weights.copy()
        interval_rate_weights[node_slice] += h * END_WEIGHTS
        interval_start += h
    rate_matrix[n], position_matrix[n] = interval_rate_weights, interval_position_weights
    return node_times, rate_matrix, position_matrix


def lagrange_weights(interval_location: float) -> np.ndarray:
    """Return the weights of node values that give the value of their polynomial at a location.

    The location is the time from the start of the mesh interval, in interval lengths.
    """
    node_differences = GAUSS_NODES[:, None] - GAUSS_NODES + np.eye(N_GAUSS_NODES)
    lagrange_factors = np.where(
        np.eye(N_GAUSS_NODES, dtype=bool), 1.0, (interval_location - GAUSS_NODES) / node_differences
    )
    return np.prod(lagrange_factors, axis=1)


def mesh_transfer_matrix(source_mesh: PhaseMesh, target_mesh: PhaseMesh) -> np.ndarray:
    """Return the (target, source) matrix from node accelerations of one mesh to those of another.

    It is exact for accelerations that are cubic in each interval of the source.
    """

    def interval_ends(mesh: PhaseMesh) -> np.ndarray:
        return np.concatenate([[0.0], np.cumsum(mesh.interval_fractions)])

    source_ends = interval_ends(source_mesh)
    target_times = (
        interval_ends(target_mesh)[:-1, None]
        + target_mesh.interval_fractions[:, None] * GAUSS_NODES
    ).ravel()
    transfer_matrix = np.zeros((target_times.size, source_mesh.n_intervals * N_GAUSS_NODES))
    for target_index, target_time in enumerate(target_times):
        source_interval = int(
            np.clip(np.searchsorted(source_ends, target_time) - 1, 0, source_mesh.n_intervals - 1)
        )
        source_location = (
            target_time - source_ends[source_interval]
        ) / source_mesh.interval_fractions[source_interval]
        transfer_matrix[
            target_index, source_interval * N_GAUSS_NODES : (source_interval + 1) * N_GAUSS_NODES
        ] = lagrange_weights(source_location)
    return transfer_matrix


def differentiation_matrix() -> np.ndarray:
    """Return the matrix from node values to the derivatives at the nodes, for an interval of
    length 1.
    """
    higher_powers = _MONOMIAL_POWERS[1:]
    return (higher_powers * GAUSS_NODES[:, None] ** (higher_powers - 1)) @ _INTERPOLATION_MATRIX[1:]


def integration_weights(location: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the node weights that integrate a polynomial once and twice from 0 to `location`."""
    integrated_powers = location ** (_MONOMIAL_POWERS + 1) / (_MONOMIAL_POWERS + 1)
    twice_integrated_powers = location * integrated_powers / (_MONOMIAL_POWERS + 2)
    return (
        integrated_powers @ _INTERPOLATION_MATRIX,
        twice_integrated_powers @ _INTERPOLATION_MATRIX,
    )
