"""Fixed points of any return map, by Newton's method on the section."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from vrw_jax.numerics.derivatives import with_jacobian, without_derivative
from vrw_jax.numerics.types import Scalar
from vrw_jax.wording import as_text, function_of, listed, positive, reals, told, whole


class SectionCycle(NamedTuple):
    """A fixed point of a map, and the map's Jacobian there.

    - `x`: the point, shape (n,);
    - `jacobian`: of the map, or of its period_n-th iterate;
    - `residual`: largest entry of map(x) - x;
    - `converged`, `n_iterations`: of Newton's method.

    Examples:
        >>> result = vrw.solve_fixed_point(lambda x: 0.5 * x + 1.0, jnp.zeros(1))
        >>> float(result.x[0]), float(result.jacobian[0, 0])
        (2.0, 0.5)
    """

    x: Float[Array, " n"]
    jacobian: Float[Array, "n n"]
    residual: Scalar
    converged: Bool[Array, ""]
    iterations: Int[Array, ""]

    def __repr__(self) -> str:
        if isinstance(self.x, jax.core.Tracer) or np.ndim(self.x) != 1:
            return f"SectionCycle{tuple(self)}"
        rows = (
            ("converged", f"{bool(self.converged)}, after {int(self.iterations)} iterations"),
            ("x", listed(self.x)),
            ("residual", told(self.residual, "")),
            ("multipliers", listed(np.linalg.eigvals(self.jacobian))),
        )
        return as_text("SectionCycle", rows)


ITERATIONS = 30
"""Default limit of Newton's iterations."""


def newton_cycle(
    function: Callable[[Array], Array],
    start: Float[Array, " n"],
    *,
    period_n: int = 1,
    tolerance: float | Scalar = 1e-12,
    iterations: int = ITERATIONS,
) -> SectionCycle:
    """Solve for a fixed point of `function` applied `period_n` times, by Newton's method from
    `start`.

    The result is differentiable in whatever `function` closes over, by two further iterations that
    carry derivatives: the point to third order, the Jacobian to first. A start that does not
    converge is returned unchanged, without derivative.

    Args:
        function: a map of a vector to a vector of the same shape, differentiable in forward mode.
        start: shape (n,), near the fixed point.
        period_n: number of times the map is applied.
        tolerance: of Newton's last correction, in units of `start`.
        max_iterations: limit of Newton's iterations.

    Returns:
        A `FixedPointResult`.

    Raises:
        TypeError, ValueError: an invalid argument, in one sentence.

    Examples:
        >>> result = vrw.solve_fixed_point(lambda x: jnp.cos(x), jnp.array([0.7]))
        >>> print(f"{result.x[0]:.6f} {bool(result.converged)}")
        0.739085 True
    """

    return _cycle_of(_found, function, start, period_n, tolerance, iterations)


def moved_cycle(
    function: Callable[[Array], Array],
    start: Float[Array, " n"],
    *,
    period_n: int = 1,
    tolerance: float | Scalar = 1e-12,
) -> SectionCycle:
    """Solve for a fixed point of a map whose second derivatives are expensive.

    The point's first derivatives require only first derivatives of `function`, and its second
    derivatives second ones. Derivatives of the Jacobian are NaN.
    """
    return _cycle_of(_found_apart, function, start, period_n, tolerance, ITERATIONS)


def _cycle_of(
    found: Callable[..., SectionCycle],
    function: Callable[[Array], Array],
    start: Any,
    period_n: int,
    tolerance: float | Scalar,
    iterations: int,
) -> SectionCycle:
    """Validate the arguments, and solve with one of the two methods below."""
    function_of("function", function, "that maps a state to the next")
    start, period_n = reals("start", start), whole("period_n", period_n)
    iterations = whole("iterations", iterations)
    if not isinstance(tolerance, jax.Array):
        positive("tolerance", tolerance)

    def iterate(x: Array) -> Array:
        for _ in range(period_n):
            x = function(x)
        return x

    start = lax.stop_gradient(start)
    told = jax.eval_shape(function, start)
    if getattr(told, "shape", None) != start.shape:
        what = getattr(told, "shape", type(told).__name__)
        raise ValueError(
            f"the map gives {what} for a start of shape {start.shape}, but it must give its like: "
            "take a map of a state to the next."
        )
    image, closed_over = jax.closure_convert(iterate, start)
    tolerance = lax.stop_gradient(jnp.asarray(tolerance, start.dtype))
    return found(image, iterations, start, tolerance, *closed_over)


Map = Callable[..., Array]


def _correction(image: Map, x: Array, closed_over: tuple) -> tuple[Array, Array, Array]:
    """Return Newton's correction, the map's Jacobian, and the defect of the map."""
    reached, jacobian = with_jacobian(lambda y: image(y, *closed_over), x)
    miss = reached - x
    return jnp.linalg.solve(jnp.eye(x.size, dtype=x.dtype) - jacobian, miss), jacobian, miss


POLISHED = 2
"""Number of iterations with derivatives, chosen because one from a point without derivatives yields
only its first."""


@functools.partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def _found(
    image: Map, iterations: int, start: Array, tolerance: Array, *closed_over: Any
) -> SectionCycle:
    """Run Newton's method in one loop, so that the map, often a large program, is compiled once."""

    def searches(size: Array, count: Array) -> Array:
        return (size > tolerance) & (count < iterations) & jnp.isfinite(size)

    def going(state: tuple) -> Array:
        _, size, count, followed, *_ = state
        return searches(size, count) | ((size <= tolerance) & (followed < POLISHED))

    def step(state: tuple) -> tuple:
        x, size, count, followed, *_ = state
        searching = searches(size, count)
        change, jacobian, miss = _correction(image, x, closed_over)
        size = jnp.max(
            jnp.abs(change)
        )  # checked in the last iterations too: the map may jump next to the point
        moved = jnp.where(jnp.all(jnp.isfinite(change)), x + change, x)
        told = jacobian, jnp.max(jnp.abs(miss))
        return moved, size, count + searching, followed + ~searching, *told

    zero, one = jnp.zeros((), jnp.int32), jnp.ones((), start.dtype)
    begin = start, one, zero, zero, jnp.zeros((start.size,) * 2, start.dtype), one
    x, size, count, _, jacobian, residual = lax.while_loop(going, step, begin)
    converged = size <= tolerance
    return SectionCycle(jnp.where(converged, x, start), jacobian, residual, converged, count)


@_found.defjvp
def _found_and_moved(
    image: Map, iterations: int, primals: tuple, tangents: tuple
) -> tuple[SectionCycle, SectionCycle]:
    """Return the tangent, by iterations from the fixed point that carry derivatives."""
    start, _, *closed_over = primals
    found = _found(image, iterations, *lax.stop_gradient(primals))

    def polished(*closed_over: Any) -> SectionCycle:
        def polish(point: Array, _: None) -> tuple[Array, tuple[Array, Array]]:
            change, jacobian, miss = _correction(image, point, closed_over)
            moved = point + jnp.where(found.converged, change, 0.0)
            return moved, (jacobian, jnp.max(jnp.abs(miss)))

        point, (jacobians, residuals) = lax.scan(polish, found.x, None, length=POLISHED)
        x = jnp.where(found.converged, point, start)
        return SectionCycle(x, jacobians[-1], residuals[-1], found.converged, found.iterations)

    return jax.jvp(polished, tuple(closed_over), tuple(tangents[2:]))


@functools.partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def _found_apart(
    image: Map, iterations: int, start: Array, tolerance: Array, *closed_over: Any
) -> SectionCycle:
    return _found(image, iterations, start, tolerance, *closed_over)


@_found_apart.defjvp
def _point_moved(
    image: Map, iterations: int, primals: tuple, tangents: tuple
) -> tuple[SectionCycle, SectionCycle]:
    """Return the tangent by the implicit function theorem, at a point that is differentiated by
    this rule.
    """
    found = _found_apart(image, iterations, *primals)
    closed_over, moves = tuple(primals[2:]), tuple(tangents[2:])
    _, by_map = jax.jvp(lambda *some: image(found.x, *some), closed_over, moves)
    _, jacobian = with_jacobian(lambda x: image(x, *closed_over), found.x)
    moved = jnp.linalg.solve(jnp.eye(found.x.size, dtype=found.x.dtype) - jacobian, by_map)
    moved = jnp.where(found.converged, moved, 0.0)
    unknown = jnp.full_like(jacobian, jnp.nan) * jnp.sum(moved)
    nothing = without_derivative(found)
    return found, nothing._replace(x=moved, jacobian=unknown)
