"""Leading eigenvalues of a survival operator, and the mean first-passage times that follow.

The operator K is given by a matrix: (K f)(i) is the mean of f over the states that survive one step
from state i. F(i) is the probability of failure there, so that K 1 = 1 - F. The source is Byl and
Tedrake, "Metastable walking machines" (2009).
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from vrw_jax.numerics import Scalar

MAX_POWER_ITERATIONS = 5000
"""Largest number of power iterations, chosen because this number suffices for kappa_2 up to 0.99
kappa_1."""

POWER_ITERATION_TOLERANCE = 1e-15
"""Change of an eigenvector at which power iteration ends, chosen near round-off."""


class SurvivalAnalysis(NamedTuple):
    """Leading eigenvalues and eigenvectors of a survival operator."""

    failure_probability: Scalar  # 1 - kappa_1, without cancellation
    kappa_2: Scalar
    distribution: Float[Array, " n"]  # quasi-stationary weights of the nodes, sum 1
    right_eigenvector: Float[Array, " n"]  # scaled to a mean of 1 over the distribution


def analyze_survival(
    survival_matrix: Float[Array, "n n"], failure_probabilities: Float[Array, " n"]
) -> SurvivalAnalysis:
    """Return the leading eigenvalues and eigenvectors of a survival operator.

    Let q be the distribution and u the right eigenvector, with q.1 = q.u = 1. The failure
    probability is q.F. Its first derivatives are those of q.(F - K (u - 1)) with q and u held
    fixed.
    """
    K = lax.stop_gradient(survival_matrix)
    distribution = _iterate_power(K.T)
    unnormalized_eigenvector = _iterate_power(K)
    right_eigenvector = unnormalized_eigenvector / (distribution @ unnormalized_eigenvector)
    eigenvalues = jnp.sort(jnp.abs(jnp.linalg.eigvals(K)))
    correction = survival_matrix @ (right_eigenvector - 1.0)
    failure_probability = distribution @ (
        failure_probabilities - (correction - lax.stop_gradient(correction))
    )
    return SurvivalAnalysis(failure_probability, eigenvalues[-2], distribution, right_eigenvector)


def _iterate_power(matrix: Array) -> Array:
    """Return the leading eigenvector of a matrix, scaled to a sum of 1.

    Power iteration keeps the relative accuracy of small entries, because sums of products have no
    cancellation.
    """

    def is_running(carry: tuple) -> Array:
        iteration, _, relative_change = carry
        return (iteration < MAX_POWER_ITERATIONS) & (relative_change > POWER_ITERATION_TOLERANCE)

    def iterate(carry: tuple) -> tuple:
        iteration, vector, _ = carry
        next_vector = matrix @ vector
        next_vector = next_vector / jnp.sum(next_vector)
        return (
            iteration + 1,
            next_vector,
            jnp.max(jnp.abs(next_vector - vector)) / jnp.max(jnp.abs(next_vector)),
        )

    n = matrix.shape[0]
    initial_vector = jnp.full(n, 1.0 / n, matrix.dtype)
    return lax.while_loop(is_running, iterate, (0, initial_vector, jnp.ones((), matrix.dtype)))[1]


def compute_mean_steps(
    survival: SurvivalAnalysis,
    survival_matrix: Array,
    survival_row: Array,
    failure_at_start: Scalar,
) -> Scalar:
    """Return the mean number of steps from one start, including the failing step.

    The mean is m = 1 + K m. The solution is the sum of M u, with M = 1/(1 - kappa_1), and a
    remainder g with (I - K + u q) g = 1 - u, which stays small.

    - `survival_row`: row of the operator at the start;
    - `failure_at_start`: probability of failure there.
    """
    p, u, q = survival.failure_probability, survival.right_eigenvector, survival.distribution
    n = len(u)
    remainder = jnp.linalg.solve(jnp.eye(n) - survival_matrix + jnp.outer(u, q), 1.0 - u)
    life_at_start = (1.0 - failure_at_start + survival_row @ (u - 1.0)) / (1.0 - p)
    return life_at_start / p + 1.0 - life_at_start + survival_row @ remainder
