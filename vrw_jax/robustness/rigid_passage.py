"""First passage of the rigid wheel by quadrature of a closed-form kernel over one number.

The state is the squared rate x with the stance leg vertical. The slope of the next line and x
determine the next x. So the probability density of the slope gives the kernel.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.scipy.special import ndtr
from jaxtyping import Array, Float

from vrw_jax.numerics import Scalar
from vrw_jax.robustness.survival import SurvivalAnalysis, analyze_survival, compute_mean_steps
from vrw_jax.wheel import WheelParams

MAX_SLOPE_DEVIATIONS = 10.0
"""Largest deviation of a slope that bounds the states, in standard deviations, chosen because
steeper lines have a probability of 1e-23."""


class RigidPassage(NamedTuple):
    """First passage of the rigid wheel, computed on one set of nodes."""

    survival: SurvivalAnalysis
    mean_steps_from_gait: Scalar
    nodes: Float[Array, " n"]  # squared rate with the stance leg vertical, 1/s^2


@functools.partial(jax.jit, static_argnums=(2, 3))
def solve_rigid_passage(
    params: WheelParams, slope_sd: Scalar, model: Any, n_nodes: int
) -> RigidPassage:
    """Return the first passage by Gauss-Legendre quadrature at `n_nodes` squared rates.

    - `slope_sd`: standard deviation of the slopes, rad.
    """
    vertical_map, mean_slope = model.vertical_map(params), params.slope
    steepest_slope = jnp.minimum(
        mean_slope + MAX_SLOPE_DEVIATIONS * slope_sd, vertical_map.slope_of_maximum
    )
    largest_state = lax.stop_gradient(vertical_map.fixed_point(steepest_slope))
    reference_nodes, reference_weights = np.polynomial.legendre.leggauss(n_nodes)
    nodes = 0.5 * largest_state * (1.0 + reference_nodes)
    weights = 0.5 * largest_state * reference_weights

    def evaluate_kernel_row(x: Array) -> tuple[Array, Array]:
        """Return the row of the survival operator at x, and the probability of failure."""
        cosine_for_state = lambda target_state: (
            (target_state - vertical_map.offset(x)) / vertical_map.amplitude
        )
        target_cosine = cosine_for_state(nodes)
        is_reached = jnp.abs(target_cosine) < 1.0
        target_cosine = jnp.where(is_reached, target_cosine, 0.0)
        standardized_deviation = (
            vertical_map.slope_of_maximum - jnp.arccos(target_cosine) - mean_slope
        ) / slope_sd
        state_density = jnp.exp(-0.5 * standardized_deviation**2) / (
            jnp.sqrt(2.0 * jnp.pi) * slope_sd
        )
        state_density = state_density / (vertical_map.amplitude * jnp.sqrt(1.0 - target_cosine**2))
        flattest_slope = vertical_map.slope_of_maximum - jnp.arccos(
            jnp.clip(cosine_for_state(0.0), -1.0, 1.0)
        )
        return jnp.where(is_reached, state_density, 0.0) * weights, ndtr(
            (flattest_slope - mean_slope) / slope_sd
        )

    survival_matrix, failure_probabilities = jax.vmap(evaluate_kernel_row)(nodes)
    survival = analyze_survival(survival_matrix, failure_probabilities)
    gait_row = evaluate_kernel_row(vertical_map.fixed_point(mean_slope))
    return RigidPassage(survival, compute_mean_steps(survival, survival_matrix, *gait_row), nodes)
