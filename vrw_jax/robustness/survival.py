"""Leading eigenvalues of a survival operator, and mean first-passage times that follow from them.

The operator K is given by a matrix: (K f)(i) is the mean of f over the states that survive one step
from state i. F(i) is the probability of failure there, so that K 1 = 1 - F. See Byl and Tedrake,
"Metastable walking machines" (2009).
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from vrw_jax.numerics import Scalar

MAX_POWER_ITERATIONS = 5000
"""Largest number of power iterations, chosen because it suffices for kappa_2 up to 0.99 kappa_1."""

POWER_ITERATION_TOLERANCE = 1e-15
"""Change of an eigenvector at which power iteration ends, chosen near round-off."""


class Survival(NamedTuple):
    """Leading eigenvalues and eigenvectors of a survival operator."""

    failure_probability: Scalar  # 1 - kappa_1, without a difference of near numbers
    kappa_2: Scalar
    distribution: Float[Array, " n"]  # quasi-stationary: weights of the nodes, whose sum is 1
    life: Float[Array, " n"]  # right eigenvector, whose mean over the distribution is 1


def analyze_survival(matrix: Float[Array, "n n"], failure: Float[Array, " n"]) -> Survival:
    """Return the leading eigenvalues and eigenvectors of a survival operator.

    With distribution q and right eigenvector u, q.1 = q.u = 1, the failure probability is q.F. It
    has the derivatives of q.(F - K (u - 1)) with q and u held fixed, once.
    """
    K = lax.stop_gradient(matrix)
    distribution = _iterate_power(K.T)
    right = _iterate_power(K)
    life = right / (distribution @ right)
    eigenvalues = jnp.sort(jnp.abs(jnp.linalg.eigvals(K)))
    correction = matrix @ (life - 1.0)
    probability = distribution @ (failure - (correction - lax.stop_gradient(correction)))
    return Survival(probability, eigenvalues[-2], distribution, life)


def _iterate_power(matrix: Array) -> Array:
    """Return the leading eigenvector of a matrix, its sum 1.

    Power iteration keeps relative digits of small entries, as sums of products without
    cancellation do.
    """

    def is_running(carry: tuple) -> Array:
        iteration, _, change = carry
        return (iteration < MAX_POWER_ITERATIONS) & (change > POWER_ITERATION_TOLERANCE)

    def iterate(carry: tuple) -> tuple:
        iteration, vector, _ = carry
        image = matrix @ vector
        image = image / jnp.sum(image)
        return iteration + 1, image, jnp.max(jnp.abs(image - vector)) / jnp.max(jnp.abs(image))

    n = matrix.shape[0]
    start = jnp.full(n, 1.0 / n, matrix.dtype)
    return lax.while_loop(is_running, iterate, (0, start, jnp.ones((), matrix.dtype)))[1]


def mean_steps_from(
    survival: Survival, matrix: Array, row: Array, failure_at_start: Scalar
) -> Scalar:
    """Return the mean number of steps from one start, the failing step included.

    `row` is the operator's row of the start. The mean is m = 1 + K m. It is split into M u, with
    M = 1/(1 - kappa_1), and a rest g with (I - K + u q) g = 1 - u, which stays small.
    """
    p, u, q = survival.failure_probability, survival.life, survival.distribution
    n = len(u)
    rest = jnp.linalg.solve(jnp.eye(n) - matrix + jnp.outer(u, q), 1.0 - u)
    life_at_start = (1.0 - failure_at_start + row @ (u - 1.0)) / (1.0 - p)
    return life_at_start / p + 1.0 - life_at_start + row @ rest
