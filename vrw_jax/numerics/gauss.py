"""Time cut into steps of Gauss nodes: the numbers of the collocation that know no wheel."""

from typing import NamedTuple

import numpy as np
from numpy.polynomial import legendre

N_NODES = 4


NODES = (legendre.leggauss(N_NODES)[0] + 1.0) / 2.0
"""Of the Gauss collocation on [0, 1]."""
_POWERS = np.arange(N_NODES)
_TO_POLYNOMIAL = np.linalg.inv(NODES[:, None] ** _POWERS)
"""From values at the nodes to the coefficients of their polynomial, the constant first."""
ONCE = (NODES[:, None] ** (_POWERS + 1) / (_POWERS + 1)) @ _TO_POLYNOMIAL
ENDS_ONCE = (1.0 / (_POWERS + 1)) @ _TO_POLYNOMIAL
TWICE, ENDS_TWICE = ONCE @ ONCE, ENDS_ONCE @ ONCE
"""Once and twice integrated from a step's start to its nodes, and to its end."""


class Mesh(NamedTuple):
    """Steps of one phase as fractions of its duration, growing by `growth` from first to last."""

    n_steps: int
    growth: float

    @property
    def fractions(self) -> np.ndarray:
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
    """Matrices from a phase's accelerations to rates and positions at its nodes and its end.

    For a phase of duration 1 from rest at the origin, nodes in order; the end is the last row.
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
    """Weights of a step's nodes for the value of their polynomial at `place`, in steps."""
    gaps = NODES[:, None] - NODES + np.eye(N_NODES)
    others = np.where(np.eye(N_NODES, dtype=bool), 1.0, (place - NODES) / gaps)
    return np.prod(others, axis=1)


def transfer_matrix(source: Mesh, target: Mesh) -> np.ndarray:
    """From accelerations at the nodes of one mesh to those of another, (target, source) nodes.

    Exact where the accelerations are cubic in each step of the source.
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
    """From a step's node values to the slopes of their polynomial there, per step."""
    higher = _POWERS[1:]
    return (higher * NODES[:, None] ** (higher - 1)) @ _TO_POLYNOMIAL[1:]


def integrated(place: float) -> tuple[np.ndarray, np.ndarray]:
    """Weights of a step's nodes for their polynomial once and twice integrated up to `place`."""
    once = place ** (_POWERS + 1) / (_POWERS + 1)
    return once @ _TO_POLYNOMIAL, place * once / (_POWERS + 2) @ _TO_POLYNOMIAL
