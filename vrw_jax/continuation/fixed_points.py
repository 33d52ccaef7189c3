"""Fixed points of any return map, by Newton's method on the section."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from vrw_jax.hybrid import ReturnMap, Termination, find_program
from vrw_jax.numerics import Scalar, evaluate_with_jacobian, make_zero_tangent
from vrw_jax.printing import (
    format_heading_and_rows,
    format_numbers,
    format_quantity,
    map_text_of_elements,
)
from vrw_jax.runtime import with_default_jax_settings
from vrw_jax.validation import (
    check_callable,
    check_int,
    check_positive,
    check_reals,
    with_renamed_arguments,
)


class FixedPointResult(NamedTuple):
    """A fixed point of a map, and the map's Jacobian at it.

    - `x`: the point, shape (n,);
    - `jacobian`: Jacobian of the map, or of its period_n-th iterate;
    - `residual`: largest entry of map(x) - x;
    - `converged`: whether Newton's method converged;
    - `n_iterations`: number of Newton's iterations;
    - `termination`: how the simulation of a `ReturnMap` from `x` ended; None for any other map.

    Examples:
        >>> result = vrw.solve_fixed_point(lambda x: 0.5 * x + 1.0, jnp.zeros(1))
        >>> float(result.x[0]), float(result.jacobian[0, 0])
        (2.0, 0.5)
    """

    x: Float[Array, " n"]
    jacobian: Float[Array, "n n"]
    residual: Scalar
    converged: Bool[Array, ""]
    n_iterations: Int[Array, ""]
    termination: Int[Array, ""] | None = None

    @property
    def ending(self) -> Any:
        """Return a sentence about whether Newton's method converged; for a batch, an array of
        sentences.
        """
        return map_text_of_elements(_describe_newton_convergence, self.converged, self.n_iterations)

    def __repr__(self) -> str:
        if isinstance(self.x, jax.core.Tracer) or np.ndim(self.x) != 1:
            return f"FixedPointResult{tuple(self)}"
        multipliers = np.full(len(self.x), np.nan)
        if np.all(np.isfinite(self.jacobian)):
            multipliers = np.linalg.eigvals(self.jacobian)
        text_rows = [
            ("converged", f"{bool(self.converged)}, after {int(self.n_iterations)} iterations"),
            ("x", format_numbers(self.x)),
            ("residual", format_quantity(self.residual, "")),
            ("multipliers", format_numbers(multipliers)),
        ]
        if self.termination is not None:
            text_rows.append(("simulation", Termination(int(self.termination)).meaning))
        return format_heading_and_rows("FixedPointResult", text_rows)


def _describe_newton_convergence(converged: bool, n_iterations: int) -> str:
    """Return a sentence about the convergence to one fixed point."""
    if converged:
        return f"Newton's method converged after {n_iterations} iterations."
    return (
        f"Newton's method did not converge after {n_iterations} iterations: start nearer to the "
        "fixed point."
    )


MAX_NEWTON_ITERATIONS = 30
"""Default limit of Newton's iterations. The value is chosen far above the number that a start near
the fixed point needs."""


@with_renamed_arguments(iterations="max_iterations")
def solve_fixed_point(
    function: Callable[[Array], Array],
    start: Float[Array, " n"],
    *,
    period_n: int = 1,
    tolerance: float | Scalar = 1e-12,
    max_iterations: int = MAX_NEWTON_ITERATIONS,
) -> FixedPointResult:
    """Return a fixed point of `function` applied `period_n` times, by Newton's method.

    The result is differentiable with respect to everything that `function` closes over, by two
    further iterations with derivatives: the point to third order, the Jacobian to first order. If a
    start does not converge, it is returned unchanged, without derivative.

    Args:
        function: map of a vector to a vector of its shape, differentiable in forward mode. For a
            hybrid system it is a `ReturnMap`, which has no fixed point if its simulation ends
            early.
        start: start of Newton's method, shape (n,).
        period_n: number of times that the map is applied.
        tolerance: tolerance of Newton's last correction, in units of `start`.
        max_iterations: limit of Newton's iterations.

    Returns:
        A `FixedPointResult`.

    Raises:
        TypeError, ValueError: if an argument is invalid; the message names the remedy.

    Examples:
        >>> result = vrw.solve_fixed_point(lambda x: jnp.cos(x), jnp.array([0.7]))
        >>> print(f"{result.x[0]:.6f} {bool(result.converged)}")
        0.739085 True
    """

    fixed_point = _check_and_solve(
        _run_newton_loop, function, start, period_n, tolerance, max_iterations
    )
    if isinstance(function, ReturnMap):
        fixed_point = fixed_point._replace(
            termination=function.find_termination(fixed_point.x, period_n)
        )
    return fixed_point


def solve_fixed_point_implicit(
    function: Callable[[Array], Array],
    start: Float[Array, " n"],
    *,
    period_n: int = 1,
    tolerance: float | Scalar = 1e-12,
) -> FixedPointResult:
    """Return a fixed point of a map whose second derivatives are expensive.

    First derivatives of the point need only first derivatives of `function`, and second derivatives
    need second ones. Derivatives of the Jacobian are NaN.
    """
    return _check_and_solve(
        _run_newton_implicit, function, start, period_n, tolerance, MAX_NEWTON_ITERATIONS
    )


def _check_and_solve(
    run_newton: Callable[..., FixedPointResult],
    function: Callable[[Array], Array],
    start: Any,
    period_n: int,
    tolerance: float | Scalar,
    max_iterations: int,
) -> FixedPointResult:
    """Check the arguments, and return the fixed point by the given form of Newton's method."""
    check_callable("function", function, "that maps a state to the next")
    start, period_n = check_reals("start", start), check_int("period_n", period_n)
    max_iterations = check_int("max_iterations", max_iterations)
    if start.ndim != 1 or not start.size:
        raise ValueError(
            f"start has shape {start.shape}, but it is a vector: give an array of shape (n,)."
        )
    if isinstance(tolerance, jax.Array):
        tolerance = check_reals("tolerance", tolerance)
    else:
        check_positive("tolerance", tolerance)

    start = lax.stop_gradient(start)
    map_output = jax.eval_shape(function, start)
    if getattr(map_output, "shape", None) != start.shape:
        map_description = getattr(map_output, "shape", type(map_output).__name__)
        raise ValueError(
            f"the map gives {map_description} for a start of shape {start.shape}, but it must give "
            "an array of that shape: take a map of a state to the next state."
        )
    tolerance = lax.stop_gradient(jnp.asarray(tolerance, start.dtype))
    map_and_iterations = (run_newton, function, period_n, max_iterations)
    newton_arguments = start, tolerance
    uses_program_cache = isinstance(function, ReturnMap)
    compiled_program = (
        find_program(_solve_iterated_map, map_and_iterations, *newton_arguments)
        if uses_program_cache
        else None
    )
    return (compiled_program or functools.partial(_solve_iterated_map, map_and_iterations))(
        *newton_arguments
    )


def _solve_iterated_map(
    map_and_iterations: tuple, start: Array, tolerance: Array
) -> FixedPointResult:
    run_newton, function, period_n, iterations = map_and_iterations

    def iterate(x: Array) -> Array:
        for _ in range(period_n):
            x = function(x)
        return x

    converted_map, closed_over_values = jax.closure_convert(iterate, start)
    return run_newton(converted_map, iterations, start, tolerance, *closed_over_values)


ClosureConvertedMap = Callable[..., Array]


def _compute_newton_correction(
    converted_map: ClosureConvertedMap, x: Array, closed_over_values: tuple
) -> tuple[Array, Array, Array]:
    """Return Newton's correction, the map's Jacobian, and the defect map(x) - x."""
    image_point, jacobian = evaluate_with_jacobian(
        lambda y: converted_map(y, *closed_over_values), x
    )
    map_defect = image_point - x
    return (
        jnp.linalg.solve(jnp.eye(x.size, dtype=x.dtype) - jacobian, map_defect),
        jacobian,
        map_defect,
    )


N_DERIVATIVE_ITERATIONS = 2
"""Number of iterations with derivatives, chosen because a single one gives only first
derivatives of the point.
"""


@functools.partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def _run_newton_loop(
    converted_map: ClosureConvertedMap,
    iterations: int,
    start: Array,
    tolerance: Array,
    *closed_over_values: Any,
) -> FixedPointResult:
    """Return the fixed point by Newton's method in one loop.

    The loop compiles the map, often a large program, once.
    """

    def is_newton_searching(correction_norm: Array, n_iterations: Array) -> Array:
        return (
            (correction_norm > tolerance)
            & (n_iterations < iterations)
            & jnp.isfinite(correction_norm)
        )

    def needs_newton_iteration(loop_state: tuple) -> Array:
        _, correction_norm, n_iterations, n_derivative_iterations, *_ = loop_state
        return is_newton_searching(correction_norm, n_iterations) | (
            (correction_norm <= tolerance) & (n_derivative_iterations < N_DERIVATIVE_ITERATIONS)
        )

    def iterate_newton(loop_state: tuple) -> tuple:
        x, correction_norm, n_iterations, n_derivative_iterations, *_ = loop_state
        n_searching = is_newton_searching(correction_norm, n_iterations).astype(n_iterations.dtype)
        correction, jacobian, map_defect = _compute_newton_correction(
            converted_map, x, closed_over_values
        )
        # The correction is also checked in the last iterations, because the map may jump near the
        # point.
        correction_norm = jnp.max(jnp.abs(correction))
        next_x = jnp.where(jnp.all(jnp.isfinite(correction)), x + correction, x)
        return (
            next_x,
            correction_norm,
            n_iterations + n_searching,
            n_derivative_iterations + 1 - n_searching,
            jacobian,
            jnp.max(jnp.abs(map_defect)),
        )

    zero_count, unit_norm = jnp.zeros((), jnp.int32), jnp.ones((), start.dtype)
    initial_state = (
        start,
        unit_norm,
        zero_count,
        zero_count,
        jnp.zeros((start.size,) * 2, start.dtype),
        unit_norm,
    )
    x, correction_norm, n_iterations, _, jacobian, residual = lax.while_loop(
        needs_newton_iteration, iterate_newton, initial_state
    )
    is_converged = correction_norm <= tolerance
    return FixedPointResult(
        jnp.where(is_converged, x, start), jacobian, residual, is_converged, n_iterations
    )


@_run_newton_loop.defjvp
@with_default_jax_settings
def _run_newton_jvp(
    converted_map: ClosureConvertedMap, iterations: int, primals: tuple, tangents: tuple
) -> tuple[FixedPointResult, FixedPointResult]:
    """Return the fixed point and its tangent, by iterations with derivatives from the point."""
    start, _, *closed_over_values = primals
    newton_result = _run_newton_loop(converted_map, iterations, *lax.stop_gradient(primals))

    def solve_from_fixed_point(*closed_over_values: Any) -> FixedPointResult:
        def iterate_with_derivatives(point: Array, _: None) -> tuple[Array, tuple[Array, Array]]:
            correction, jacobian, map_defect = _compute_newton_correction(
                converted_map, point, closed_over_values
            )
            next_point = point + jnp.where(newton_result.converged, correction, 0.0)
            return next_point, (jacobian, jnp.max(jnp.abs(map_defect)))

        point, (jacobians, residuals) = lax.scan(
            iterate_with_derivatives, newton_result.x, None, length=N_DERIVATIVE_ITERATIONS
        )
        x = jnp.where(newton_result.converged, point, start)
        return FixedPointResult(
            x, jacobians[-1], residuals[-1], newton_result.converged, newton_result.n_iterations
        )

    return jax.jvp(solve_from_fixed_point, tuple(closed_over_values), tuple(tangents[2:]))


@functools.partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def _run_newton_implicit(
    converted_map: ClosureConvertedMap,
    iterations: int,
    start: Array,
    tolerance: Array,
    *closed_over_values: Any,
) -> FixedPointResult:
    """Return the fixed point by Newton's method, with the implicit function theorem as derivative
    rule.
    """
    return _run_newton_loop(converted_map, iterations, start, tolerance, *closed_over_values)


@_run_newton_implicit.defjvp
@with_default_jax_settings
def _run_newton_implicit_jvp(
    converted_map: ClosureConvertedMap, iterations: int, primals: tuple, tangents: tuple
) -> tuple[FixedPointResult, FixedPointResult]:
    """Return the fixed point and its tangent by the implicit function theorem.

    The same rule differentiates the fixed point that the tangent contains.
    """
    newton_result = _run_newton_implicit(converted_map, iterations, *primals)
    closed_over_values, closed_over_tangents = tuple(primals[2:]), tuple(tangents[2:])
    _, map_tangent = jax.jvp(
        lambda *arguments: converted_map(newton_result.x, *arguments),
        closed_over_values,
        closed_over_tangents,
    )
    _, jacobian = evaluate_with_jacobian(
        lambda x: converted_map(x, *closed_over_values), newton_result.x
    )
    point_tangent = jnp.linalg.solve(
        jnp.eye(newton_result.x.size, dtype=newton_result.x.dtype) - jacobian, map_tangent
    )
    point_tangent = jnp.where(newton_result.converged, point_tangent, 0.0)
    nan_jacobian_tangent = jnp.full_like(jacobian, jnp.nan) * jnp.sum(point_tangent)
    zero_tangents = make_zero_tangent(newton_result)
    return newton_result, zero_tangents._replace(x=point_tangent, jacobian=nan_jacobian_tangent)
