"""First-passage times of the rigid wheel by quadrature, with a map in closed form.

The state is the squared angular rate at the instant at which the stance leg is vertical. If the
ground consists of independent heights, the height of the foothold is a second component. This state
and the next line of the ground determine the next rate.

The survival operator K is a matrix. (K f)(i) is the mean of f over the states after one step from
state i, with the value 0 for failures. F(i) is the probability that this step fails, so that
K 1 = 1 - F. The source is Byl and Tedrake, "Metastable walking machines" (2009).
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.scipy.linalg import lu_factor, lu_solve
from jax.scipy.special import ndtr
from jaxtyping import Array, Float

from vrw_jax.base.elementwise import Scalar
from vrw_jax.wheel.params import WheelParams
from vrw_jax.wheel.transitions import compute_line_slope

MAX_POWER_ITERATIONS = 5000
"""Largest number of power iterations, chosen because it suffices for kappa_2 up to 0.99 kappa_1."""

SECOND_EIGENVALUE_TOLERANCE = 1e-12
"""Change of the second eigenvalue at which power iteration ends, chosen above round-off."""

POWER_ITERATION_TOLERANCE = 1e-15
"""Relative change of an eigenvector at which power iteration ends, chosen near round-off."""


def _analyze_survival_operator(
    survival_matrix: Float[Array, "n n"], failure_probabilities: Float[Array, " n"]
) -> tuple[Scalar, Scalar, Array, Array]:
    """Return the leading eigenvalues and eigenvectors of the survival operator `survival_matrix`.

    The result is (1 - kappa_1 without cancellation, kappa_2, quasi-stationary weights of the nodes
    with the sum 1, right eigenvector with a mean of 1 over this distribution).

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
    factors = lu_factor(regular_matrix)
    u_change = lu_solve(factors, K_change @ u - kappa_change * u)
    # Two solves of a batch that run at once may wait for each other forever on CPUs (JAX 0.10).
    q_residual, u_change = lax.optimization_barrier((q @ K_change - kappa_change * q, u_change))
    q_change = lu_solve(factors, q_residual, trans=1)
    scale_change = jnp.sum(q_change)
    return (
        failure_probability,
        kappa_2,
        q + q_change - scale_change * q,
        u + u_change + scale_change * u,
    )


def _compute_leading_eigenvector(nonnegative_matrix: Array) -> Array:
    """Return the leading eigenvector of a nonnegative matrix, scaled so that its sum is 1.

    The sums contain only nonnegative terms, so that no cancellation occurs and small components are
    relatively accurate.
    """

    def apply(vector: Array) -> tuple[Array, Array]:
        following = nonnegative_matrix @ vector
        following = following / jnp.sum(following)
        return following, jnp.max(jnp.abs(following - vector)) / jnp.max(jnp.abs(following))

    n = nonnegative_matrix.shape[0]
    start = jnp.full(n, 1.0 / n, nonnegative_matrix.dtype)
    return _iterate(apply, POWER_ITERATION_TOLERANCE, start)[0]


def _compute_second_eigenvalue(K: Array, q: Array, u: Array) -> Scalar:
    """Return the modulus of the second eigenvalue, by iteration without the leading eigenvectors q
    and u, which have q.u = 1.
    """

    def apply(vector: Array, modulus: Array) -> tuple[Array, Array, Array]:
        vector = K @ vector
        vector = vector - (q @ vector) * u
        norm = jnp.linalg.norm(vector)
        return vector / norm, norm, jnp.abs(norm - modulus)

    start = jnp.cos(jnp.arange(len(u), dtype=u.dtype))
    return _iterate(apply, SECOND_EIGENVALUE_TOLERANCE, start, jnp.inf * q[0])[1]


def _iterate(apply: Callable[..., tuple], tolerance: float, *start: Array) -> tuple[Array, ...]:
    """Return the state of a power iteration whose change, which `apply` adds, is small."""
    first_loop: Any = (0, *start, jnp.ones((), start[0].dtype))
    _, *state, _ = lax.while_loop(
        lambda loop: (loop[0] < MAX_POWER_ITERATIONS) & (loop[-1] > tolerance),
        lambda loop: (loop[0] + 1, *apply(*loop[1:-1])),
        first_loop,
    )
    return tuple(state)


N_DEVIATION_NODES = 80
"""Number of quadrature nodes over the next slope or height.

The value is chosen because the normal density over 20 standard deviations is then integrated to
round-off.
"""
MAX_SLOPE_DEVIATION = 10.0
MAX_HEIGHT_DEVIATION = 8.0
"""Largest deviations of a slope and of a height from their means, in standard deviations.

The limits bound the states. The values are chosen because larger slopes have a probability of
1e-23, and larger heights one of 1e-15. More heights would need more nodes.
"""


class RigidPassage(NamedTuple):
    """First-passage times of the rigid wheel, computed with one number of nodes."""

    failure_probability: Scalar  # 1 - kappa_1
    kappa_2: Scalar
    quasi_stationary_weights: Float[Array, " n"]
    mean_steps_from_gait: Scalar
    mean_step_distance: Scalar  # to the next foothold, from the quasi-stationary distribution, m
    states: Float[Array, "n n_state"]
    omitted_probability: Scalar  # of slopes or heights that the operator omits

    def compute_means(self) -> tuple[Scalar, Scalar]:
        """Return the mean number of steps, and the mean distance of their footholds, m."""
        mean_steps = 1.0 / self.failure_probability
        return mean_steps, mean_steps * self.mean_step_distance


@functools.partial(jax.jit, static_argnums=(2, 3))
def solve_passage_on_slopes(
    params: WheelParams, slope_sd: Scalar, rigid_model: Any, n_nodes: int
) -> RigidPassage:
    """Analyze the survival of the rigid wheel on random slopes, by quadrature over the next state.

    All terms are positive, so that the failure probability of the longest life has digits. The
    kernel omits slopes beyond that of the largest next rate.

    - `slope_sd`: standard deviation of the slopes, rad.
    """
    rate_map, mean_slope = rigid_model.make_vertical_rate_map(params), params.slope
    foot_distance = rigid_model.compute_foot_distance(params, jnp.zeros_like(mean_slope)[None])
    steepest_slope = jnp.minimum(
        mean_slope + MAX_SLOPE_DEVIATION * slope_sd, rate_map.slope_of_largest_squared_rate
    )
    largest_squared_rate = lax.stop_gradient(rate_map.compute_fixed_point(steepest_slope))
    legendre_nodes, legendre_weights = np.polynomial.legendre.leggauss(n_nodes)
    squared_rate_nodes = 0.5 * largest_squared_rate * (1.0 + legendre_nodes)
    node_weights = 0.5 * largest_squared_rate * legendre_weights

    def evaluate_kernel_row(squared_rate: Array) -> tuple[Array, Array]:
        """Return the row of the survival operator, and the probability that the step fails.

        The row contains the kernel at all nodes, multiplied by the quadrature weights.
        """
        slope_cosine = (
            squared_rate_nodes - rate_map.compute_slope_independent_squared_rate(squared_rate)
        ) / rate_map.squared_rate_amplitude
        is_node_reachable = jnp.abs(slope_cosine) < 1.0
        slope_cosine = jnp.where(is_node_reachable, slope_cosine, 0.0)
        slope_deviation = (
            rate_map.slope_of_largest_squared_rate - jnp.arccos(slope_cosine) - mean_slope
        ) / slope_sd
        squared_rate_density = jnp.exp(-0.5 * slope_deviation**2) / (
            jnp.sqrt(2.0 * jnp.pi) * slope_sd
        )
        squared_rate_density = squared_rate_density / (
            rate_map.squared_rate_amplitude * jnp.sqrt(1.0 - slope_cosine**2)
        )
        survival_row = jnp.where(is_node_reachable, squared_rate_density, 0.0) * node_weights
        failure_probability = ndtr(
            (rate_map.compute_flattest_slope(squared_rate) - mean_slope) / slope_sd
        )
        return survival_row, failure_probability

    rows = jax.vmap(evaluate_kernel_row)(squared_rate_nodes)
    start_row = evaluate_kernel_row(rate_map.compute_fixed_point(mean_slope))
    # The cosine of a normal number has this mean.
    step_distances = foot_distance * jnp.exp(-0.5 * slope_sd**2) * jnp.ones(n_nodes)
    omitted_probability = ndtr((mean_slope - rate_map.slope_of_largest_squared_rate) / slope_sd)
    return _analyze_passage(
        *rows, step_distances, start_row, squared_rate_nodes[:, None], omitted_probability
    )


class _RandomGround(NamedTuple):
    """Ground of random slopes or heights, as deviations z from the mean in standard deviations."""

    rate_map: Any
    mean_slope: Scalar
    ground_sd: Scalar
    foot_distance: Scalar
    has_heights: bool

    @property
    def max_deviation(self) -> float:
        """Return the largest deviation that the survival operator contains."""
        return MAX_HEIGHT_DEVIATION if self.has_heights else MAX_SLOPE_DEVIATION

    def find_slope(self, z: Array, next_z: Array) -> Array:
        """Return the slope of a line, from the standardized deviations of its two ends."""
        if self.has_heights:
            return compute_line_slope(
                self.mean_slope, self.ground_sd * (next_z - z), self.foot_distance
            )
        return self.mean_slope + self.ground_sd * next_z

    def find_next_deviation(self, z: Array, slope: Array | float) -> Array:
        """Return the deviation with which `find_slope` returns the slope."""
        if self.has_heights:
            return z + jnp.sin(self.mean_slope - slope) * self.foot_distance / self.ground_sd
        return (slope - self.mean_slope) / self.ground_sd

    def find_level_rate(self, squared_rate: Array, z: Array) -> Array:
        """Return the next squared rate if the next foothold is on the mean line.

        After a foothold of any height, the probability of a failure depends on hardly anything
        else. On random slopes, the squared rate itself has this property.
        """
        if not self.has_heights:
            return squared_rate
        linear_slope = self.mean_slope + self.ground_sd * z / self.foot_distance
        return self.rate_map.compute_next_squared_rate(squared_rate, linear_slope)

    def make_deviation_quadrature(
        self, z: Array, flattest_slope: Array | float
    ) -> tuple[Array, Array, Array]:
        """Return nodes and weights of the deviations between a slope and the vertical line, and the
        probability of all other deviations.
        """
        legendre_nodes, legendre_weights = np.polynomial.legendre.leggauss(N_DEVIATION_NODES)
        limits = [
            jnp.clip(self.find_next_deviation(z, slope), -self.max_deviation, self.max_deviation)
            for slope in (flattest_slope, 0.5 * np.pi)
        ]
        lower, upper = reversed(limits) if self.has_heights else limits
        next_z = lower + 0.5 * (upper - lower) * (1.0 + legendre_nodes)
        density = jnp.exp(-0.5 * next_z**2) / np.sqrt(2.0 * np.pi)
        weights = 0.5 * (upper - lower) * legendre_weights * density
        return next_z, weights, ndtr(lower) + ndtr(-upper)

    def compute_step_distance(self, z: Array) -> Array:
        """Return the mean distance to a next foothold that the wheel can reach, m."""
        steepest_climb = self.mean_slope - 0.5 * np.pi if self.has_heights else -0.5 * np.pi
        next_z, weights, _ = self.make_deviation_quadrature(z, steepest_climb)
        line_angles = self.find_slope(z, next_z) - self.mean_slope
        return self.foot_distance * (weights @ jnp.cos(line_angles)) / jnp.sum(weights)


@functools.partial(jax.jit, static_argnums=(2, 3, 4))
def solve_passage_by_interpolation(
    params: WheelParams, ground_sd: Scalar, rigid_model: Any, n_nodes: int, has_heights: bool
) -> RigidPassage:
    """Analyze the survival of the rigid wheel on random heights, or on slopes of any size.

    Functions of the state are interpolated between Chebyshev nodes, about `n_nodes` in all. They
    are integrated over the slopes or heights on which a step succeeds, in which they are smooth. A
    vertical line ends the walk. Terms have both signs, so that extremely long lives lose digits.

    - `ground_sd`: standard deviation of the slopes, rad, or of the heights, m;
    - `has_heights`: whether heights are random, so that the last height is part of the state.
    """
    rate_map, mean_slope = rigid_model.make_vertical_rate_map(params), params.slope
    foot_distance = rigid_model.compute_foot_distance(params, jnp.zeros_like(mean_slope)[None])
    ground = _RandomGround(rate_map, mean_slope, ground_sd, foot_distance, has_heights)
    n_heights = round(0.5 * n_nodes**0.5) if has_heights else 1
    n_rates = n_nodes // n_heights
    z_max = ground.max_deviation
    level_rate_limits = [
        rate_map.compute_fixed_point(jnp.minimum(slope, rate_map.slope_of_largest_squared_rate))
        for slope in map(ground.find_slope, jnp.zeros(2), jnp.array([z_max, -z_max]))
    ]
    gait_squared_rate = rate_map.compute_fixed_point(mean_slope)
    retained_fraction = rate_map.retained_squared_rate_fraction
    if has_heights:  # Extreme heights cannot follow each other as steep slopes can.
        lowest, highest = (
            gait_squared_rate + (1.0 - retained_fraction) * (limit - gait_squared_rate)
            for limit in level_rate_limits
        )
    else:
        lowest, highest = jnp.zeros_like(mean_slope), level_rate_limits[0]
    lowest, highest = lax.stop_gradient((lowest, highest))
    rate_angles, height_angles = ((np.arange(n) + 0.5) * (np.pi / n) for n in (n_rates, n_heights))
    level_rates = lowest + 0.5 * (highest - lowest) * (1.0 + np.cos(rate_angles))
    level_rates = jnp.repeat(level_rates, n_heights)
    deviations = jnp.tile(jnp.asarray(z_max * np.cos(height_angles)), n_rates)
    squared_rates = level_rates
    if has_heights:
        rates_from_rest = ground.find_level_rate(jnp.zeros_like(level_rates), deviations)
        squared_rates = (level_rates - rates_from_rest) / retained_fraction

    def evaluate_kernel_row(
        z: Array, flattest_slope: Array, compute_next_squared_rate: Callable[[Array], Array]
    ) -> tuple[Array, Array]:
        """Return the row of the survival operator, and the probability that the step fails.

        The arguments are those of a foothold: its deviation, the slope of the next line below which
        the wheel falls back, and the next squared rate for each slope.
        """
        next_z, weights, failure_probability = ground.make_deviation_quadrature(z, flattest_slope)
        next_slopes = ground.find_slope(z, next_z)
        next_level_rates = ground.find_level_rate(compute_next_squared_rate(next_slopes), next_z)
        rate_basis = _evaluate_chebyshev_basis(
            2.0 * (next_level_rates - lowest) / (highest - lowest) - 1.0, rate_angles
        )
        height_basis = _evaluate_chebyshev_basis(next_z / z_max, height_angles)
        return jnp.ravel((weights[:, None] * rate_basis).T @ height_basis), failure_probability

    evaluate_state_row = lambda squared_rate, z: evaluate_kernel_row(
        z,
        rate_map.compute_flattest_slope(squared_rate),
        functools.partial(rate_map.compute_next_squared_rate, squared_rate),
    )
    rows = jax.vmap(evaluate_state_row)(squared_rates, deviations)
    mean_deviation = jnp.zeros_like(mean_slope)
    start_row = evaluate_state_row(gait_squared_rate, mean_deviation)
    if has_heights:
        # The gait lands on a foothold of random height, and the step before is not counted.
        landing_rate = rate_map.compute_rate_after_landing(gait_squared_rate, mean_slope)
        start_row = evaluate_kernel_row(
            mean_deviation,
            rate_map.find_flattest_landing_slope(landing_rate),
            lambda slope: landing_rate - rate_map.compute_climb(slope),
        )
    states = jnp.stack([squared_rates, ground_sd * deviations][: 1 + has_heights], 1)
    step_distances = jax.vmap(ground.compute_step_distance)(deviations)
    passage = _analyze_passage(*rows, step_distances, start_row, states, 2.0 * ndtr(-z_max))
    return passage._replace(mean_steps_from_gait=passage.mean_steps_from_gait - int(has_heights))


def _analyze_passage(
    survival_matrix: Array,
    failure_probabilities: Array,
    step_distances: Array,
    start_row: Any,
    states: Array,
    omitted_probability: Any,
) -> RigidPassage:
    """Return first-passage times for a survival operator, see `RigidPassage`.

    The mean number m of steps, including the failing step, solves m = 1 + K m. The solution is
    M u + g with M = 1/(1 - kappa_1). Here u is the leading eigenvector and q the quasi-stationary
    distribution. The remainder g stays small and solves the equation (I - K + u q) g = 1 - u.

    - `step_distances`: mean distance to the next foothold from each state, m;
    - `start_row`: row of the operator for a start on the gait, and its failure probability.
    """
    p, kappa_2, q, u = _analyze_survival_operator(survival_matrix, failure_probabilities)
    n, (start_survival, start_failure) = len(u), start_row
    remainder = jnp.linalg.solve(jnp.eye(n) - survival_matrix + jnp.outer(u, q), 1.0 - u)
    factor = (1.0 - start_failure + start_survival @ (u - 1.0)) / (1.0 - p)
    return RigidPassage(
        p,
        kappa_2,
        q,
        factor / p + 1.0 - factor + start_survival @ remainder,
        q @ step_distances,
        states,
        omitted_probability,
    )


def _evaluate_chebyshev_basis(x: Array, node_angles: np.ndarray) -> Array:
    """Return the polynomials that are 1 at one Chebyshev node and 0 at all others, at each of the
    points x in [-1, 1], shape (points, nodes).
    """
    degrees = np.arange(len(node_angles))
    coefficients = np.cos(degrees[:, None] * node_angles) * (2.0 / len(node_angles))
    coefficients[0] *= 0.5
    x = jnp.clip(x, -1.0 + 1e-15, 1.0 - 1e-15)  # where the arccosine has finite derivatives
    return jnp.cos(degrees * jnp.arccos(x)[:, None]) @ coefficients
