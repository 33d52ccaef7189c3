"""Leading eigenvalues of a survival operator, and mean first-passage times.

The operator K is a matrix. (K f)(i) is the mean of f over the states after one step from state i,
with the value 0 for failures. F(i) is the probability that this step fails, so that K 1 = 1 - F.
The source is Byl and Tedrake, "Metastable walking machines" (2009).
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from vrw_jax.base.types import Scalar

MAX_POWER_ITERATIONS = 5000
"""Largest number of power iterations, chosen because it suffices for kappa_2 up to 0.99 kappa_1."""

SECOND_EIGENVALUE_TOLERANCE = 1e-12
"""Change of the second eigenvalue at which power iteration ends, chosen above round-off."""

POWER_ITERATION_TOLERANCE = 1e-15
"""Relative change of an eigenvector at which power iteration ends, chosen near round-off."""


class SurvivalAnalysis(NamedTuple):
    """Leading eigenvalues of a survival operator, and its left and right leading eigenvectors."""

    failure_probability: Scalar  # 1 - kappa_1, without cancellation
    kappa_2: Scalar
    quasi_stationary_weights: Float[Array, " n"]  # of the nodes, sum 1
    survival_eigenvector: Float[Array, " n"]  # scaled to a mean of 1 over the distribution


def analyze_survival_operator(
    survival_matrix: Float[Array, "n n"], failure_probabilities: Float[Array, " n"]
) -> SurvivalAnalysis:
    """Return the leading eigenvalues and eigenvectors of the survival operator `survival_matrix`.

    Let q be the quasi-stationary distribution and u the right eigenvector, with q.1 = q.u = 1. The
    failure probability is q.F, where F is `failure_probabilities`. Its first derivatives are those
    of q.(F - K (u - 1)) with constant q and u. Derivatives of q and u solve linear equations.
    """
    K = lax.stop_gradient(survival_matrix)
    q = _compute_leading_eigenvector(K.T)
    unscaled_eigenvector = _compute_leading_eigenvector(K)
    u = unscaled_eigenvector / (q @ unscaled_eigenvector)
    eigenvector_correction = survival_matrix @ (u - 1.0)
    failure_probability = q @ (
        failure_probabilities - (eigenvector_correction - lax.stop_gradient(eigenvector_correction))
    )
    kappa_2 = _compute_second_eigenvalue(K, q, u)
    # The change of K is zero and has the derivative of K.
    K_change, kappa_1 = survival_matrix - K, q @ K @ u
    kappa_change = q @ K_change @ u
    regular_matrix = kappa_1 * jnp.eye(len(q)) - K + jnp.outer(u, q)
    q_change = jnp.linalg.solve(regular_matrix.T, q @ K_change - kappa_change * q)
    u_change = jnp.linalg.solve(regular_matrix, K_change @ u - kappa_change * u)
    scale_change = jnp.sum(q_change)
    return SurvivalAnalysis(
        failure_probability,
        kappa_2,
        q + q_change - scale_change * q,
        u + u_change + scale_change * u,
    )


def _compute_leading_eigenvector(nonnegative_matrix: Array) -> Array:
    """Return the leading eigenvector of a nonnegative matrix, scaled so that its sum is 1.

    The method is power iteration. The sums contain only nonnegative terms, so that no cancellation
    occurs and small components are relatively accurate.
    """

    def has_not_converged(loop_state: tuple) -> Array:
        iteration_index, _, eigenvector_change = loop_state
        return (iteration_index < MAX_POWER_ITERATIONS) & (
            eigenvector_change > POWER_ITERATION_TOLERANCE
        )

    def apply_matrix(loop_state: tuple) -> tuple:
        iteration_index, normalized_eigenvector, _ = loop_state
        next_eigenvector = nonnegative_matrix @ normalized_eigenvector
        next_eigenvector = next_eigenvector / jnp.sum(next_eigenvector)
        return (
            iteration_index + 1,
            next_eigenvector,
            jnp.max(jnp.abs(next_eigenvector - normalized_eigenvector))
            / jnp.max(jnp.abs(next_eigenvector)),
        )

    n = nonnegative_matrix.shape[0]
    initial_eigenvector = jnp.full(n, 1.0 / n, nonnegative_matrix.dtype)
    return lax.while_loop(
        has_not_converged,
        apply_matrix,
        (0, initial_eigenvector, jnp.ones((), nonnegative_matrix.dtype)),
    )[1]


def _compute_second_eigenvalue(K: Array, q: Array, u: Array) -> Scalar:
    """Return the modulus of the second eigenvalue, by power iteration without the leading
    eigenvectors q and u, which have q.u = 1.
    """

    def has_not_converged(loop_state: tuple) -> Array:
        iteration_index, _, modulus, previous_modulus = loop_state
        return (iteration_index < MAX_POWER_ITERATIONS) & (
            jnp.abs(modulus - previous_modulus) > SECOND_EIGENVALUE_TOLERANCE
        )

    def apply_deflated_matrix(loop_state: tuple) -> tuple:
        iteration_index, vector, modulus, _ = loop_state
        vector = K @ vector
        vector = vector - (q @ vector) * u
        norm = jnp.linalg.norm(vector)
        return iteration_index + 1, vector / norm, norm, modulus

    initial_vector = jnp.cos(jnp.arange(len(u), dtype=u.dtype))
    return lax.while_loop(
        has_not_converged,
        apply_deflated_matrix,
        (0, initial_vector, jnp.inf * q[0], jnp.zeros_like(q[0])),
    )[2]


def compute_mean_steps(
    survival_analysis: SurvivalAnalysis,
    survival_matrix: Array,
    start_survival_row: Array,
    start_failure_probability: Scalar,
) -> Scalar:
    """Return the mean number of gait steps from one start, including the failing step.

    The mean m solves m = 1 + K m. The solution is M u + g with M = 1/(1 - kappa_1). Here u is the
    leading eigenvector and q the quasi-stationary distribution. The remainder g stays small and
    solves the equation
    (I - K + u q) g = 1 - u.

    - `start_survival_row`: row of the survival operator for the start;
    - `start_failure_probability`: probability that the first step fails.
    """
    p, u, q = (
        survival_analysis.failure_probability,
        survival_analysis.survival_eigenvector,
        survival_analysis.quasi_stationary_weights,
    )
    n = len(u)
    bounded_remainder = jnp.linalg.solve(jnp.eye(n) - survival_matrix + jnp.outer(u, q), 1.0 - u)
    survival_factor = (1.0 - start_failure_probability + start_survival_row @ (u - 1.0)) / (1.0 - p)
    return survival_factor / p + 1.0 - survival_factor + start_survival_row @ bounded_remainder
