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
    """Find the Chenciner point of the map returned(x, parameters) with two parameters, from a
    guess.
    """
    first = jax.jit(lambda x, k: (returned(x, k), jax.jacfwd(returned)(x, k)))

    def higher(x, k, a, b, c):
        """Second derivative along a, b, and third along a, b, c."""
        evaluate_along = lambda f, v: lambda x: jax.jvp(f, (x,), (v,))[1]
        second = evaluate_along(evaluate_along(lambda x: returned(x, k), a), b)
        return jax.jvp(second, (x,), (c,))

    higher = jax.jit(jax.vmap(higher, (None, None, 0, 0, 0)))

    def cycle(x: np.ndarray, k: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        for _ in range(20):
            end_state, matrix = map(np.asarray, first(x, k))
            move = np.linalg.solve(np.eye(len(x)) - matrix, end_state - x)
            x = x + move
            if np.abs(move).max() < 1e-13:
                break
        return x, matrix

    def form(x: np.ndarray, k: np.ndarray, *vectors: np.ndarray) -> np.ndarray:
        """Evaluate the second or third derivative along complex vectors, from real derivatives."""
        parts: list[tuple] = [()]
        for v in vectors:
            parts = [(*p, (w, u)) for p in parts for w, u in ((1.0, v.real), (1j, v.imag))]
        columns = [np.array([p[min(i, len(p) - 1)][1] for p in parts]) for i in range(3)]
        derivative_values = np.asarray(higher(x, k, *columns)[len(vectors) - 2])
        return np.array([np.prod([w for w, _ in p]) for p in parts]) @ derivative_values

    def conditions(k: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        """Return |multiplier| − 1 and the real part of the cubic coefficient, with state and
        angle.
        """
        value_at_2, matrix = cycle(x, k)
        values, right = np.linalg.eig(matrix)
        place = np.argmax(values.imag)
        pair, q = values[place], right[:, place] / np.linalg.norm(right[:, place])
        others, left_eigenvectors = np.linalg.eig(matrix.T)
        p = left_eigenvectors[:, np.argmin(np.abs(others - pair.conj()))]
        p = p / np.vdot(p, q).conj()
        angle, one = float(np.angle(pair)), np.eye(len(value_at_2))
        turned = np.linalg.solve(np.exp(2j * angle) * one - matrix, form(value_at_2, k, q, q))
        second_order_state = np.linalg.solve(one - matrix, form(value_at_2, k, q, q.conj()))
        cubic = form(value_at_2, k, q, q, q.conj()) + 2.0 * form(
            value_at_2, k, q, second_order_state
        )
        cubic = cubic + form(value_at_2, k, q.conj(), turned)
        real = 0.5 * (np.exp(-1j * angle) * np.vdot(p, cubic)).real
        return np.array([abs(pair) - 1.0, real]), value_at_2, angle

    solution = root(lambda k: conditions(k)[0], parameters, tol=1e-14, options={"eps": 1e-12})
    _, normal_form, angle = conditions(solution.x)
    return Point(solution.x, normal_form, angle)
