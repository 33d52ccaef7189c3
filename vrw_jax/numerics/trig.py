"""Sines of angles as polynomials, which every engine computes alike."""

import math

import jax
import jax.numpy as jnp

from vrw_jax.numerics.types import Elementwise

_SINE = tuple((-1) ** k / math.factorial(2 * k + 1) for k in range(10))
_COSINE = tuple((-1) ** k / math.factorial(2 * k) for k in range(11))


@jax.custom_jvp
def sine_cosine(angle: Elementwise) -> tuple[Elementwise, Elementwise]:
    """Sine and cosine by their Taylor series, right to rounding for |angle| < 1.8 rad.

    The standard functions are scalar calls in float64 on CPU; these are fused and vectorised.
    """
    square = angle * angle

    def series(coefficients: tuple[float, ...]) -> Elementwise:
        value = jnp.full_like(square, coefficients[-1])
        for coefficient in coefficients[-2::-1]:
            value = value * square + coefficient
        return value

    return angle * series(_SINE), series(_COSINE)


@sine_cosine.defjvp
def _sine_cosine_jvp(primals: tuple, tangents: tuple) -> tuple:
    sin, cos = sine_cosine(*primals)
    (moved,) = tangents
    return (sin, cos), (cos * moved, -sin * moved)
