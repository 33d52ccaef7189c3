"""Where on a curve of Neimark-Sacker points the cubic coefficient vanishes: the Chenciner point.

The coefficient is Kuznetsov's, Elements of Applied Bifurcation Theory, for maps: from the first
three derivatives of the return map, which JAX takes through walk and events. Where it vanishes does
not depend on the section: two sections that agree are the check.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np
from scipy.optimize import root


class Point(NamedTuple):
    """Parameters, the cycle's state on the section, and the pair's angle."""

    parameters: np.ndarray
    x: np.ndarray
    angle: float


def chenciner_point(returned: Callable, x: np.ndarray, parameters: np.ndarray) -> Point:
    """Of the map returned(x, parameters), with two parameters, from a guess near by."""
    first = jax.jit(lambda x, k: (returned(x, k), jax.jacfwd(returned)(x, k)))

    def higher(x, k, a, b, c):
        """Second derivative along a, b, and third along a, b, c."""
        along = lambda f, v: lambda x: jax.jvp(f, (x,), (v,))[1]
        second = along(along(lambda x: returned(x, k), a), b)
        return jax.jvp(second, (x,), (c,))

    higher = jax.jit(jax.vmap(higher, (None, None, 0, 0, 0)))

    def cycle(x: np.ndarray, k: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        for _ in range(20):
            there, matrix = map(np.asarray, first(x, k))
            move = np.linalg.solve(np.eye(len(x)) - matrix, there - x)
            x = x + move
            if np.abs(move).max() < 1e-13:
                break
        return x, matrix

    def form(x: np.ndarray, k: np.ndarray, *vectors: np.ndarray) -> np.ndarray:
        """The second or third derivative along two or three complex vectors, from real ones."""
        parts: list[tuple] = [()]
        for v in vectors:
            parts = [(*p, (w, u)) for p in parts for w, u in ((1.0, v.real), (1j, v.imag))]
        columns = [np.array([p[min(i, len(p) - 1)][1] for p in parts]) for i in range(3)]
        told = np.asarray(higher(x, k, *columns)[len(vectors) - 2])
        return np.array([np.prod([w for w, _ in p]) for p in parts]) @ told

    def conditions(k: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        """The pair's modulus less 1 and the cubic coefficient's real part; state and angle."""
        at, matrix = cycle(x, k)
        values, right = np.linalg.eig(matrix)
        place = np.argmax(values.imag)
        pair, q = values[place], right[:, place] / np.linalg.norm(right[:, place])
        others, left = np.linalg.eig(matrix.T)
        p = left[:, np.argmin(np.abs(others - pair.conj()))]
        p = p / np.vdot(p, q).conj()
        angle, one = float(np.angle(pair)), np.eye(len(at))
        turned = np.linalg.solve(np.exp(2j * angle) * one - matrix, form(at, k, q, q))
        still = np.linalg.solve(one - matrix, form(at, k, q, q.conj()))
        cubic = form(at, k, q, q, q.conj()) + 2.0 * form(at, k, q, still)
        cubic = cubic + form(at, k, q.conj(), turned)
        real = 0.5 * (np.exp(-1j * angle) * np.vdot(p, cubic)).real
        return np.array([abs(pair) - 1.0, real]), at, angle

    found = root(lambda k: conditions(k)[0], parameters, tol=1e-14, options={"eps": 1e-12})
    _, at, angle = conditions(found.x)
    return Point(found.x, at, angle)
