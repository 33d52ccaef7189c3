"""First-passage times of the rigid wheel by quadrature, with a kernel in closed form.

The state is one number: the squared angular rate at the instant at which the stance leg is
vertical. This rate and the slope of the next line of the ground determine the next rate. The
probability density of the slopes therefore determines the kernel.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.scipy.special import ndtr
from jaxtyping import Array, Float

from vrw_jax.base.types import Scalar
from vrw_jax.studies.survival import SurvivalAnalysis, analyze_survival_operator, compute_mean_steps
from vrw_jax.wheel.params import WheelParams

MAX_SLOPE_STANDARD_DEVIATIONS = 10.0
"""Largest deviation of a slope from its mean, in standard deviations.

The limit bounds the states. The value is chosen because larger deviations have a probability of
only 1e-23.
"""


@functools.partial(jax.jit, static_argnums=(2, 3))
def solve_rigid_passage(
    params: WheelParams, slope_sd: Scalar, rigid_model: Any, n_nodes: int
) -> tuple[SurvivalAnalysis, Scalar, Float[Array, " n"]]:
    """Analyze the survival of the rigid wheel, by quadrature with `n_nodes` nodes.

    Return the analysis, the mean number of steps from the gait until the wheel fails, and the
    nodes. The nodes are squared angular rates with the stance leg vertical, 1/s^2.

    - `slope_sd`: standard deviation of the slopes, rad.
    """
    vertical_rate_map, mean_slope = rigid_model.make_vertical_rate_map(params), params.slope
    steepest_slope = jnp.minimum(
        mean_slope + MAX_SLOPE_STANDARD_DEVIATIONS * slope_sd,
        vertical_rate_map.slope_of_largest_squared_rate,
    )
    largest_squared_rate = lax.stop_gradient(vertical_rate_map.compute_fixed_point(steepest_slope))
    legendre_nodes, legendre_weights = np.polynomial.legendre.leggauss(n_nodes)
    squared_rate_nodes = 0.5 * largest_squared_rate * (1.0 + legendre_nodes)
    node_weights = 0.5 * largest_squared_rate * legendre_weights

    def evaluate_kernel_row(squared_rate: Array) -> tuple[Array, Array]:
        """Return the row of the survival operator for a start at `squared_rate`, and the
        probability that the step fails.

        The row contains the kernel at all nodes, multiplied by the quadrature weights.
        """
        compute_slope_cosine = lambda next_squared_rate: (
            (
                next_squared_rate
                - vertical_rate_map.compute_slope_independent_squared_rate(squared_rate)
            )
            / vertical_rate_map.squared_rate_amplitude
        )
        slope_cosine = compute_slope_cosine(squared_rate_nodes)
        is_node_reachable = jnp.abs(slope_cosine) < 1.0
        slope_cosine = jnp.where(is_node_reachable, slope_cosine, 0.0)
        slope_deviation = (
            vertical_rate_map.slope_of_largest_squared_rate - jnp.arccos(slope_cosine) - mean_slope
        ) / slope_sd
        squared_rate_density = jnp.exp(-0.5 * slope_deviation**2) / (
            jnp.sqrt(2.0 * jnp.pi) * slope_sd
        )
        squared_rate_density = squared_rate_density / (
            vertical_rate_map.squared_rate_amplitude * jnp.sqrt(1.0 - slope_cosine**2)
        )
        flattest_slope = vertical_rate_map.slope_of_largest_squared_rate - jnp.arccos(
            jnp.clip(compute_slope_cosine(0.0), -1.0, 1.0)
        )
        return jnp.where(is_node_reachable, squared_rate_density, 0.0) * node_weights, ndtr(
            (flattest_slope - mean_slope) / slope_sd
        )

    survival_matrix, failure_probabilities = jax.vmap(evaluate_kernel_row)(squared_rate_nodes)
    survival_analysis = analyze_survival_operator(survival_matrix, failure_probabilities)
    survival_row_of_gait = evaluate_kernel_row(vertical_rate_map.compute_fixed_point(mean_slope))
    mean_steps_from_gait = compute_mean_steps(
        survival_analysis, survival_matrix, *survival_row_of_gait
    )
    return survival_analysis, mean_steps_from_gait, squared_rate_nodes
