"""First passage of the rigid wheel: quadrature of the closed-form kernel over one number.

The state is the squared rate x with the stance leg vertical. The slope of the next line and x give
the next x, so that the probability density of the slope gives the kernel.
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
from vrw_jax.robustness.survival import Survival, analyze_survival, mean_steps_from
from vrw_jax.wheel import WheelParams

REACH_SD = 10.0
"""Largest deviation of a slope, in standard deviations, that bounds the states; chosen because
steeper lines have probability 1e-23."""


class RigidPassage(NamedTuple):
    """First passage of the rigid wheel on one set of nodes."""

    survival: Survival
    mean_steps_from_gait: Scalar
    nodes: Float[Array, " n"]  # squared rate with the stance leg vertical, 1/s^2


@functools.partial(jax.jit, static_argnums=(2, 3))
def solve_rigid_passage(
    params: WheelParams, slope_sd: Scalar, model: Any, n_nodes: int
) -> RigidPassage:
    """Return the first passage by Gauss-Legendre quadrature at `n_nodes` squared rates."""
    vertical, mean_slope = model.vertical_map(params), params.slope
    steepest = jnp.minimum(mean_slope + REACH_SD * slope_sd, vertical.peak)
    largest = lax.stop_gradient(vertical.fixed_point(steepest))
    reference_nodes, reference_weights = np.polynomial.legendre.leggauss(n_nodes)
    nodes = 0.5 * largest * (1.0 + reference_nodes)
    weights = 0.5 * largest * reference_weights

    def kernel_row(x: Array) -> tuple[Array, Array]:
        """Return the row of the operator at x, and the probability of failure."""
        reach = lambda end: (end - vertical.offset(x)) / vertical.amplitude
        cosine = reach(nodes)
        is_reached = jnp.abs(cosine) < 1.0
        cosine = jnp.where(is_reached, cosine, 0.0)
        deviation = (vertical.peak - jnp.arccos(cosine) - mean_slope) / slope_sd
        density = jnp.exp(-0.5 * deviation**2) / (jnp.sqrt(2.0 * jnp.pi) * slope_sd)
        density = density / (vertical.amplitude * jnp.sqrt(1.0 - cosine**2))
        flattest = vertical.peak - jnp.arccos(jnp.clip(reach(0.0), -1.0, 1.0))
        return jnp.where(is_reached, density, 0.0) * weights, ndtr(
            (flattest - mean_slope) / slope_sd
        )

    matrix, failure = jax.vmap(kernel_row)(nodes)
    survival = analyze_survival(matrix, failure)
    start = kernel_row(vertical.fixed_point(mean_slope))
    return RigidPassage(survival, mean_steps_from(survival, matrix, *start), nodes)
