"""Operations on each element of a batch: selection, and trigonometric functions.

Sine, cosine and arcsine are polynomials, which all engines evaluate identically.
"""

import functools
import math
from collections.abc import Callable
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, PyTree

from vrw_jax import lanes
from vrw_jax.base.types import Elementwise


def select_entry_by_mask(entry_index: Array, stacked_entries: Array, axis: int = 0) -> Array:
    """Return the entry of `stacked_entries` at `entry_index` along an axis, using a masked sum.

    The index is a number, or an array whose axes are the last ones of `stacked_entries`. In a
    batch, the masked sum is cheaper than a gather.
    """
    indices = np.arange(stacked_entries.shape[axis], dtype=np.int32)
    indices = indices.reshape(-1, *(1,) * (stacked_entries.ndim - 1 - axis))
    return jnp.sum(jnp.where(indices == entry_index, stacked_entries, 0.0), axis)


def run_if_any_element_active(
    is_any_element_active: Array, function: Callable[[PyTree], PyTree], initial_value: PyTree
) -> PyTree:
    """Return `function(initial_value)` if `is_any_element_active` is true, and else
    `initial_value`.

    `is_any_element_active` is one flag for the whole batch. The call is a loop with at most one
    iteration, which machine code skips if the flag is false.
    """
    call_function_once = lambda loop_carry: (jnp.zeros((), bool), function(loop_carry[1]))
    return lax.while_loop(
        lambda loop_carry: loop_carry[0],
        call_function_once,
        (is_any_element_active, initial_value),
    )[1]


def make_opaque_loop_condition(loop_condition: Array, nonnegative_count: Array) -> Array:
    """Return a loop condition that equals `loop_condition` but also reads a nonnegative count.

    If a loop condition reads only one value, XLA looks for an iteration counter in a copy of the
    loop's body. This search takes a fifth of the compile time of a step with unilateral contact.
    """
    return loop_condition & (nonnegative_count >= 0)


def select_trees_by_condition(
    condition: Array, tree_if_true: PyTree, tree_if_false: PyTree
) -> PyTree:
    """Select each entry from `tree_if_true` where `condition` is true, and else from
    `tree_if_false`.
    """
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), tree_if_true, tree_if_false)


MAX_EXACT_ANGLE = 1.6
"""Largest angle for which the polynomials are accurate to round-off, rad. The value is chosen
because it exceeds pi/2, the largest angle of a valid start.
"""


def _compute_economized_coefficients(lowest_taylor_order: int) -> tuple[float, ...]:
    """Return nine coefficients of a polynomial in the squared angle.

    The polynomial approximates the cosine if `lowest_taylor_order` is 0, and the sine divided by
    the angle if it is 1. The coefficients are those of the Taylor series, in which Chebyshev
    polynomials of lower degree replace the last terms. The polynomial is as accurate as a Taylor
    series with three more terms.
    """
    factorial_of_order, squared_angle_limit = math.factorial, MAX_EXACT_ANGLE * MAX_EXACT_ANGLE
    series_coefficients = [
        (-1) ** taylor_order / factorial_of_order(2 * taylor_order + lowest_taylor_order)
        for taylor_order in range(1, 14)
    ]
    while len(series_coefficients) > 8:
        chebyshev_degree, last_coefficient = len(series_coefficients) - 1, series_coefficients.pop()
        # The list contains the coefficients of Chebyshev's polynomial over the range of the squared
        # angle, scaled so that the last coefficient is 1.
        for taylor_order in range(chebyshev_degree):
            chebyshev_coefficient = (
                chebyshev_degree
                * factorial_of_order(chebyshev_degree + taylor_order - 1)
                / (
                    factorial_of_order(chebyshev_degree - taylor_order)
                    * factorial_of_order(2 * taylor_order)
                )
            )
            series_coefficients[taylor_order] -= (
                last_coefficient
                * (-1) ** (chebyshev_degree - taylor_order)
                * chebyshev_coefficient
                * (squared_angle_limit / 4.0) ** (chebyshev_degree - taylor_order)
                * 2.0
            )
    return 1.0, *series_coefficients


_SINE_COEFFICIENTS = _compute_economized_coefficients(1)
_COSINE_COEFFICIENTS = _compute_economized_coefficients(0)


def compute_sine_cosine(angle: Elementwise) -> tuple[Elementwise, Elementwise]:
    """Return the sine and the cosine of an angle in rad, computed with polynomials.

    Both are accurate to round-off for |angle| < 1.6 rad, and to 1e-13 at 1.8 rad. JAX's functions
    are scalar calls in float64 on CPU, while the polynomials are fused and vectorized. For NumPy
    arrays and Python numbers the results are NumPy numbers, computed in a tenth of the time of JAX
    calls.
    """
    return (
        _evaluate_sine_and_cosine(np, angle)
        if isinstance(angle, (float, np.ndarray))
        else _differentiable_sine_cosine(angle)
    )


def _evaluate_sine_and_cosine(array_module: ModuleType, angle: Any) -> tuple[Any, Any]:
    """Evaluate the polynomials for sine and cosine with the module `array_module` (NumPy or
    JAX).
    """
    squared_angle = angle * angle

    def evaluate_polynomial(coefficients: tuple[float, ...]) -> Any:
        polynomial_value = array_module.full_like(squared_angle, coefficients[-1])
        for polynomial_coefficient in coefficients[-2::-1]:
            polynomial_value = polynomial_value * squared_angle + polynomial_coefficient
        return polynomial_value

    return angle * evaluate_polynomial(_SINE_COEFFICIENTS), evaluate_polynomial(
        _COSINE_COEFFICIENTS
    )


# The jit makes JAX trace the polynomials once.
_differentiable_sine_cosine = jax.custom_jvp(
    jax.jit(lambda angle: _evaluate_sine_and_cosine(jnp, angle))
)


@_differentiable_sine_cosine.defjvp
def _sine_cosine_jvp(primals: tuple, tangents: tuple) -> tuple:
    """Return (sine, cosine) and the tangents of sine and cosine."""
    sin, cos = _differentiable_sine_cosine(*primals)
    (angle_tangent,) = tangents
    return (sin, cos), (cos * angle_tangent, -sin * angle_tangent)


N_ARCSINE_ITERATIONS = 3
"""Number of Newton iterations for the arcsine.

The initial error is below 0.007 rad, and each iteration squares it.
"""


@jax.custom_jvp
def compute_arcsine(sine: Elementwise) -> Elementwise:
    """Return the angle with the given sine, rad, accurate to round-off.

    The sine is limited to [-1, 1], where derivatives are 0 at the limits. Machine code has no
    arcsine of its own.
    """
    sine = jnp.clip(sine, -1.0, 1.0)
    # Twice the angle with this sine is the result, and the sine is at most sqrt(1/2).
    half_sine = sine / jnp.sqrt(2.0 + 2.0 * jnp.sqrt(1.0 - sine * sine))
    square = half_sine * half_sine
    angle = half_sine * (1.0 + square * (1.0 / 6.0 + square * (3.0 / 40.0)))
    for _ in range(N_ARCSINE_ITERATIONS):
        sin, cos = compute_sine_cosine(angle)
        angle = angle - (sin - half_sine) / cos
    return 2.0 * angle


@compute_arcsine.defjvp
def _arcsine_jvp(primals: tuple, tangents: tuple) -> tuple:
    """Return the arcsine and its tangent."""
    (sine,), (sine_tangent,) = primals, tangents
    squared_cosine = 1.0 - sine * sine
    is_inside = squared_cosine > 0.0
    derivative = jnp.where(
        is_inside, 1.0 / jnp.sqrt(jnp.where(is_inside, squared_cosine, 1.0)), 0.0
    )
    return compute_arcsine(sine), derivative * sine_tangent


def _interpolate(function: Callable[[np.ndarray], np.ndarray]) -> list[float]:
    """Return a polynomial of degree 5 through values at Chebyshev's points of [0, 1], lowest power
    first.
    """
    x = 0.5 - 0.5 * np.cos(np.pi * (np.arange(6) + 0.5) / 6)
    return np.polynomial.polynomial.polyfit(x, function(x), 5).tolist()


LOGARITHM_COEFFICIENTS = _interpolate(np.log1p)
POWER_OF_TWO_COEFFICIENTS = _interpolate(np.exp2)


def approximate_power(x: Array, exponent: Any) -> Array:
    """Return x**exponent for estimates, to about 1e-5, where logarithm and power are in float32.

    In machine code, polynomials replace `exp` and `log`, which would call the C library once per
    batch element. `x` and the power are then between 1e-37 and 1e37.
    """
    if not lanes.targets_machine_code() or x.dtype != jnp.float32:
        return jnp.exp(jnp.log(x) * exponent)
    evaluate = lambda coefficients, z: functools.reduce(
        lambda total, coefficient: total * z + coefficient, coefficients[::-1]
    )
    as_float = lambda bits: lax.bitcast_convert_type(bits, jnp.float32)
    bits = lax.bitcast_convert_type(x, jnp.int32)
    binary_exponent = (bits >> 23) - 127  # sign, 8 bits of exponent + 127, 23 bits of mantissa
    mantissa = as_float((bits & 0x7FFFFF) | 0x3F800000)  # between 1 and 2
    logarithm = binary_exponent.astype(jnp.float32) * math.log(2.0) + evaluate(
        LOGARITHM_COEFFICIENTS, mantissa - 1.0
    )
    power_of_two = logarithm * exponent * (1.0 / math.log(2.0))
    whole_power = jnp.floor(power_of_two)
    return evaluate(POWER_OF_TWO_COEFFICIENTS, power_of_two - whole_power) * as_float(
        (whole_power.astype(jnp.int32) + 127) << 23
    )
