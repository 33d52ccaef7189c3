"""Minimum of a margin within a solver step, computed from its values and rates at both ends."""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from vrw_jax.lanes.batching import select_trees_by_condition

MINIMUM_LOCATION_TOLERANCE = 1e-6
"""Accuracy of the location of a minimum, as a fraction of the solver step. The value is chosen
because the error of the minimum is proportional to the square of the error of its location.
"""


def evaluate_cubic(
    x: Array,
    cubic_value_at_0: Array,
    cubic_rate_at_0: Array,
    cubic_value_at_1: Array,
    cubic_rate_at_1: Array,
) -> Array:
    """Return the value at `x`, between 0 and 1, of the cubic Hermite interpolant.

    The rates at 0 and 1 must be multiplied by the length of the solver step.
    """
    return (
        (1 + 2 * x) * (1 - x) ** 2 * cubic_value_at_0
        + x * (1 - x) ** 2 * cubic_rate_at_0
        + x * x * (3 - 2 * x) * cubic_value_at_1
        + x * x * (x - 1) * cubic_rate_at_1
    )


@jax.jit  # The function is traced once for all margins.
def find_cubic_minimum(
    cubic_value_at_0: Array, cubic_rate_at_0: Array, cubic_value_at_1: Array, cubic_rate_at_1: Array
) -> tuple[Array, Array]:
    """Return the location and the value of the interior minimum of the cubic Hermite interpolant.

    The location is between 0 and 1. If there is no interior minimum, the value is the
    lower of the values at the two ends.
    """
    quadratic_coefficient = 3.0 * (
        2.0 * cubic_value_at_0 + cubic_rate_at_0 - 2.0 * cubic_value_at_1 + cubic_rate_at_1
    )
    linear_coefficient = 2.0 * (
        -3.0 * cubic_value_at_0 - 2.0 * cubic_rate_at_0 + 3.0 * cubic_value_at_1 - cubic_rate_at_1
    )
    discriminant = (
        linear_coefficient * linear_coefficient - 4.0 * quadratic_coefficient * cubic_rate_at_0
    )
    sqrt_discriminant = jnp.sqrt(jnp.where(discriminant > 0.0, discriminant, 1.0))
    # The minimum is the root with positive curvature, computed without cancellation.
    location_denominator = jnp.where(
        linear_coefficient >= 0.0,
        -(linear_coefficient + sqrt_discriminant),
        2.0 * quadratic_coefficient,
    )
    location_numerator = jnp.where(
        linear_coefficient >= 0.0, 2.0 * cubic_rate_at_0, sqrt_discriminant - linear_coefficient
    )
    nonzero_denominator = jnp.where(location_denominator == 0.0, 1.0, location_denominator)
    x = jnp.where(location_denominator == 0.0, -1.0, location_numerator / nonzero_denominator)
    has_interior_minimum = (discriminant > 0.0) & (x > 0.0) & (x < 1.0)
    x = jnp.where(has_interior_minimum, x, 0.5)
    return x, jnp.where(
        has_interior_minimum,
        evaluate_cubic(x, cubic_value_at_0, cubic_rate_at_0, cubic_value_at_1, cubic_rate_at_1),
        jnp.minimum(cubic_value_at_0, cubic_value_at_1),
    )


def refine_minimum_location(
    step_length: Array,
    margin_rate: Array,
    max_step_length: Array,
    best_step_length: Array,
    best_margin_rate: Array,
) -> tuple[Array, Array, Array, Array]:
    """Return the next step of a secant iteration for the time at which a margin's rate is zero.

    The result consists of the next step length, the step length with the smallest rate so far, that
    rate, and whether the iteration has converged. The slope of the secant has no derivative.

    - `margin_rate`: time derivative of the margin after a solver step of `step_length`, s;
    - `max_step_length`: length of the solver step that contains the minimum, s.
    """
    length_value, rate_value = lax.stop_gradient((step_length, margin_rate))
    length_change = length_value - best_step_length
    rate_slope = (rate_value - best_margin_rate) / jnp.where(
        length_change == 0.0, 1.0, length_change
    )
    is_secant_usable = (length_change != 0.0) & (rate_slope > 0.0)
    length_correction = jnp.where(
        is_secant_usable, -margin_rate / jnp.where(is_secant_usable, rate_slope, 1.0), 0.0
    )
    next_step_length = jnp.clip(step_length + length_correction, 0.0, max_step_length)
    has_converged = (
        jnp.abs(next_step_length - step_length) <= MINIMUM_LOCATION_TOLERANCE * max_step_length
    )
    best_step_length, best_margin_rate = select_trees_by_condition(
        jnp.abs(rate_value) < jnp.abs(best_margin_rate),
        (length_value, rate_value),
        (best_step_length, best_margin_rate),
    )
    return next_step_length, best_step_length, best_margin_rate, has_converged
