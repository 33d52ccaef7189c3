"""Gauss nodes and integration matrices of a mesh in time, independent of the model."""

from typing import NamedTuple

import numpy as np
from numpy.polynomial import legendre

N_NODES = 4
"""Number of Gauss nodes in a mesh interval."""


NODES = (legendre.leggauss(N_NODES)[0] + 1.0) / 2.0
"""Nodes of the Gauss collocation on [0, 1]."""
_POWERS = np.arange(N_NODES)
_TO_POLYNOMIAL = np.linalg.inv(NODES[:, None] ** _POWERS)
"""Matrix from values at the nodes to the coefficients of their polynomial, the constant first."""
ONCE = (NODES[:, None] ** (_POWERS + 1) / (_POWERS + 1)) @ _TO_POLYNOMIAL
"""Matrix that integrates node values from an interval's start to its nodes."""
ENDS_ONCE = (1.0 / (_POWERS + 1)) @ _TO_POLYNOMIAL
"""Weights that integrate node values over an interval."""
TWICE, ENDS_TWICE = ONCE @ ONCE, ENDS_ONCE @ ONCE
"""Matrix and weights that integrate node values twice, to the nodes and to the end."""


class Mesh(NamedTuple):
    """Mesh intervals of one phase as fractions of its duration.

    Their lengths grow by the factor `grading` from first to last.
    """

    n_steps: int
    growth: float

    @property
    def fractions(self) -> np.ndarray:
        """Length of each interval as a fraction of the phase's duration."""
        places = np.linspace(0.0, 1.0, self.n_steps + 1)
        rate = np.log(self.growth)
        if abs(rate) > 1e-12:
            places = np.expm1(rate * places) / np.expm1(rate)
        return np.diff(places)

    @property
    def node_times(self) -> np.ndarray:
        """Times of all nodes, as fractions of the phase's duration."""
        begins = np.cumsum(self.fractions) - self.fractions
        return (begins[:, None] + self.fractions[:, None] * NODES).ravel()


def node_weights(mesh: Mesh) -> tuple[np.ndarray, ...]:
    """Return matrices from a phase's accelerations to rates and positions at its nodes and its end.

    They hold for a phase of duration 1 from rest at the origin. Nodes are in order; the end is the
    last row.
    """
    n = mesh.n_steps * N_NODES
    rates, places = np.zeros((n + 1, n)), np.zeros((n + 1, n))
    times = np.ones(n + 1)
    rate, place, time = np.zeros(n), np.zeros(n), 0.0
    for i, h in enumerate(mesh.fractions):
        own = slice(i * N_NODES, (i + 1) * N_NODES)
        rates[own], places[own] = rate, place + h * NODES[:, None] * rate
        rates[own, own] += h * ONCE
        places[own, own] += h * h * TWICE
        times[own] = time + h * NODES
        place = place + h * rate
        place[own] += h * h * ENDS_TWICE
        rate = rate.copy()
        rate[own] += h * ENDS_ONCE
        time += h
    rates[n], places[n] = rate, place
    return times, rates, places


def lagrange(place: float) -> np.ndarray:
    """Return the weights of an interval's nodes for their polynomial at `location`,
    in intervals.
    """
    gaps = NODES[:, None] - NODES + np.eye(N_NODES)
    others = np.where(np.eye(N_NODES, dtype=bool), 1.0, (place - NODES) / gaps)
    return np.prod(others, axis=1)


def transfer_matrix(source: Mesh, target: Mesh) -> np.ndarray:
    """Return the (target, source) matrix from node accelerations of one mesh to those of another.

    It is exact where the accelerations are cubic in each interval of the source.
    """

    def ends(mesh: Mesh) -> np.ndarray:
        return np.concatenate([[0.0], np.cumsum(mesh.fractions)])

    borders = ends(source)
    times = (ends(target)[:-1, None] + target.fractions[:, None] * NODES).ravel()
    matrix = np.zeros((times.size, source.n_steps * N_NODES))
    for row, time in enumerate(times):
        step = int(np.clip(np.searchsorted(borders, time) - 1, 0, source.n_steps - 1))
        place = (time - borders[step]) / source.fractions[step]
        matrix[row, step * N_NODES : (step + 1) * N_NODES] = lagrange(place)
    return matrix


def differentiation() -> np.ndarray:
    """Return the matrix from an interval's node values to the derivatives there, per interval."""
    higher = _POWERS[1:]
    return (higher * NODES[:, None] ** (higher - 1)) @ _TO_POLYNOMIAL[1:]


def integrated(place: float) -> tuple[np.ndarray, np.ndarray]:
    """Return node weights for the once and twice integrated polynomial up to `location`."""
    once = place ** (_POWERS + 1) / (_POWERS + 1)
    return once @ _TO_POLYNOMIAL, place * once / (_POWERS + 2) @ _TO_POLYNOMIAL
