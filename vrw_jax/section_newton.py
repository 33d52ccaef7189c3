"""Limit cycles of any return map by Newton's method on the section: it needs nothing else."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from vrw_jax.params import Scalar


class SectionCycle(NamedTuple):
    """A point that a map repeats, and how disturbances of it grow."""

    x: Float[Array, " n"]
    jacobian: Float[Array, "n n"]  # of the map, or of its period_n-th iterate
    residual: Scalar  # largest entry of map(x) - x
    converged: Bool[Array, ""]
    iterations: Int[Array, ""]


def newton_cycle(
    function: Callable[[Array], Array],
    start: Float[Array, " n"],
    *,
    period_n: int = 1,
    tolerance: float | Scalar = 1e-12,
    iterations: int = 30,
) -> SectionCycle:
    """A fixed point of `function` applied `period_n` times, by Newton's method from `start`.

    Differentiable (to third order) in whatever `function` closes over, by two further iterations
    that carry derivatives. A start that does not converge is returned as it is, without derivative.
    """

    def iterate(x: Array) -> Array:
        for _ in range(period_n):
            x = function(x)
        return x

    def correction(x: Array) -> tuple[Array, Array, Array]:
        """Newton's change, the map's Jacobian, and by how much the map misses."""

        def twice(y: Array) -> tuple[Array, Array]:
            image = iterate(y)
            return image, image

        jacobian, image = jax.jacfwd(twice, has_aux=True)(x)
        miss = image - x
        return jnp.linalg.solve(jnp.eye(x.size, dtype=x.dtype) - jacobian, miss), jacobian, miss

    def going(state: tuple) -> Array:
        _, size, count = state
        return (size > tolerance) & (count < iterations) & jnp.isfinite(size)

    def step(state: tuple) -> tuple:
        x, _, count = state
        change, _, _ = correction(x)
        size = jnp.max(jnp.abs(change))
        return jnp.where(jnp.isfinite(size), x + change, x), size, count + 1

    zero = jnp.zeros((), jnp.int32)
    begin = (lax.stop_gradient(start), jnp.ones((), start.dtype), zero)
    x, size, count = lax.while_loop(going, step, begin)
    x, size = lax.stop_gradient((x, size))
    converged = size <= tolerance
    point = jnp.where(converged, x, lax.stop_gradient(start))

    def polish(point: Array, _: None) -> tuple[Array, tuple[Array, Array]]:
        change, jacobian, miss = correction(point)
        moved = point + jnp.where(converged, change, 0.0)
        return moved, (jacobian, jnp.max(jnp.abs(miss)))

    point, (jacobians, residuals) = lax.scan(polish, point, None, length=2)
    point = jnp.where(converged, point, start)
    return SectionCycle(point, jacobians[-1], residuals[-1], converged, count)
