"""Minimum of a margin within a solver step, from its values and rates at both ends."""

import jax
import jax.numpy as jnp
from jaxtyping import Array

MINIMUM_LOCATION_TOLERANCE = 1e-6
"""Accuracy of a minimum's location, in lengths of the step that contains the minimum. The value is
chosen because the error of the minimum is the square of this number."""


def evaluate_cubic(x: Array, v0: Array, r0: Array, v1: Array, r1: Array) -> Array:
    """Return the cubic Hermite interpolant at `x` in [0, 1].

    The rates r0 and r1 are multiplied by the step length.
    """
    return (
        (1 + 2 * x) * (1 - x) ** 2 * v0
        + x * (1 - x) ** 2 * r0
        + x * x * (3 - 2 * x) * v1
        + x * x * (x - 1) * r1
    )


@jax.jit  # The function is traced once for all margins.
def find_cubic_minimum(v0: Array, r0: Array, v1: Array, r1: Array) -> tuple[Array, Array]:
    """Return location in (0, 1) and value of the cubic's interior minimum.

    The value is infinite if no interior minimum exists.
    """
    quadratic_coefficient = 3.0 * (2.0 * v0 + r0 - 2.0 * v1 + r1)
    linear_coefficient = 2.0 * (-3.0 * v0 - 2.0 * r0 + 3.0 * v1 - r1)
    discriminant = linear_coefficient * linear_coefficient - 4.0 * quadratic_coefficient * r0
    discriminant_root = jnp.sqrt(jnp.where(discriminant > 0.0, discriminant, 1.0))
    # The minimum is the root with positive curvature, computed without cancellation.
    location_denominator = jnp.where(
        linear_coefficient >= 0.0,
        -(linear_coefficient + discriminant_root),
        2.0 * quadratic_coefficient,
    )
    location_numerator = jnp.where(
        linear_coefficient >= 0.0, 2.0 * r0, discriminant_root - linear_coefficient
    )
    nonzero_denominator = jnp.where(location_denominator == 0.0, 1.0, location_denominator)
    x = jnp.where(location_denominator == 0.0, -1.0, location_numerator / nonzero_denominator)
    has_minimum = (discriminant > 0.0) & (x > 0.0) & (x < 1.0)
    x = jnp.where(has_minimum, x, 0.5)
    return x, jnp.where(has_minimum, evaluate_cubic(x, v0, r0, v1, r1), jnp.inf)
