"""Operations on each element of a batch: selection, trigonometric functions, small linear systems.

Sine, cosine and arcsine are polynomials, which all engines evaluate identically. Linear algebra
consists of sums of elementwise products, with the batch on the last axis. XLA on CPU recomputes
inexpensive intermediate results for each use, which costs more than all arithmetic. A `lax.cond`
prevents this recomputation, because XLA cannot prove at compile time that the predicate of the
`lax.cond` is always true.
"""

import functools
import math
import operator
from collections.abc import Callable, Sequence
from types import ModuleType
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Inexact, PyTree

from vrw_jax import lanes
from vrw_jax.lanes.environment import with_default_jax_settings

Scalar = Float[Array, ""]
if TYPE_CHECKING:
    Elementwise = Array
else:
    Elementwise = Inexact[Array, "..."] | Inexact[np.ndarray, "..."] | float
"""Quantity with any leading axes, because formulas in lower layers than `studies` act element by
element.

Complex numbers are also allowed, because complex-step derivatives need them.
"""

Vector = tuple[Elementwise, ...]
"""Tuple with one array per component."""


RealInput = float | Array | np.ndarray
"""Real number in any form that users may pass, or an array of numbers."""


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


LaneArray = Float[Array, "... lanes"]

FusionBarrierFn = Callable[[Any], Any]


def make_fusion_barrier(nan_free_values: Float[Array, "... lanes"]) -> FusionBarrierFn:
    """Return an identity function across which XLA cannot fuse operations.

    `nan_free_values` must not contain NaN, which XLA cannot prove.
    """
    if lanes.targets_machine_code():
        return lax.optimization_barrier
    is_always_true = ~jnp.isnan(jnp.max(nan_free_values))

    def apply_fusion_barrier(tree: Any) -> Any:
        return lax.cond(
            is_always_true, lambda t: t, lambda t: jax.tree.map(jnp.zeros_like, t), tree
        )

    return apply_fusion_barrier


def apply_matrix(matrix: np.ndarray, x: Array) -> Array:
    """Return the product of a matrix with `x` along the leading axis, as a sum of elementwise
    products.
    """
    broadcast_shape = (-1,) + (1,) * (x.ndim - 1)
    weighted_terms = [
        x[j] * matrix[:, j].astype(x.dtype).reshape(broadcast_shape) for j in range(matrix.shape[1])
    ]
    return functools.reduce(operator.add, weighted_terms)


def sum_with_weights(weights: np.ndarray, x: Array) -> Array:
    """Return the weighted sum of `x` over its leading axis."""
    return functools.reduce(operator.add, [float(weights[j]) * x[j] for j in range(len(weights))])


def contract_inner_axis(left_array: Array, right_array: Array) -> Array:
    """Return the sum over s of left[..., s, lanes] * right[s, ..., lanes] for each lane.

    A lane is one element of the batch, on the last axis.
    """
    broadcast_slices = (slice(None),) * (left_array.ndim - 2) + (None,) * (right_array.ndim - 2)
    product_terms = [
        left_array[..., s, :][(*broadcast_slices, slice(None))] * right_array[s]
        for s in range(right_array.shape[0])
    ]
    return functools.reduce(operator.add, product_terms)


def invert_small_matrices(matrix: Float[Array, "n n lanes"]) -> Float[Array, "n n lanes"]:
    """Return the inverse of each 1x1, 2x2 or 3x3 matrix, computed by cofactors."""
    n = len(matrix)
    if n == 1:
        return 1.0 / matrix
    if n > 3:
        raise ValueError(f"the matrix has {n} rows, but only 1, 2 or 3 are built.")

    def compute_cofactor(i: int, j: int) -> Array:
        (a, b), (c, d) = ((i + 1) % 3, (i + 2) % 3), ((j + 1) % 3, (j + 2) % 3)
        return matrix[a, c] * matrix[b, d] - matrix[a, d] * matrix[b, c]

    adjugate = (
        [[matrix[1, 1], -matrix[0, 1]], [-matrix[1, 0], matrix[0, 0]]]
        if n == 2
        else [[compute_cofactor(j, i) for j in range(3)] for i in range(3)]
    )
    determinant = functools.reduce(operator.add, [matrix[0, j] * adjugate[j][0] for j in range(n)])
    return jnp.stack([jnp.stack(adjugate_row) for adjugate_row in adjugate]) / determinant


@jax.custom_jvp
def solve_node_equations(
    matrix: Float[Array, "nodes dim nodes dim lanes"],
    rhs: Float[Array, "nodes dim columns lanes"],
    nan_free_values: LaneArray,
) -> Float[Array, "nodes dim columns lanes"]:
    """Return the solution of the linear equations at the collocation nodes of one mesh interval.

    The method is block elimination without pivoting. The matrix is the mass matrix plus terms of
    order h, the length of the mesh interval, so its diagonal blocks stay regular. `nan_free_values`
    is the argument of `make_fusion_barrier`.
    """
    apply_fusion_barrier = make_fusion_barrier(nan_free_values)
    n_nodes, n_coordinates = matrix.shape[:2]
    remaining_system = jnp.concatenate(
        [matrix.reshape(n_nodes, n_coordinates, n_nodes * n_coordinates, -1), rhs], axis=2
    )
    eliminated_block_rows: list[Array] = []
    for _ in range(n_nodes):
        pivot_block_row = remaining_system[0]
        solved_block_row = contract_inner_axis(
            invert_small_matrices(pivot_block_row[:, :n_coordinates]),
            pivot_block_row[:, n_coordinates:],
        )
        if len(eliminated_block_rows) < n_nodes - 1:
            solved_block_row = apply_fusion_barrier(solved_block_row)
            remaining_system = apply_fusion_barrier(
                remaining_system[1:, :, n_coordinates:]
                - contract_inner_axis(remaining_system[1:, :, :n_coordinates], solved_block_row)
            )
        eliminated_block_rows.append(solved_block_row)
    node_solution = eliminated_block_rows[-1]
    for solved_block_row in eliminated_block_rows[-2::-1]:
        n_solved_blocks = node_solution.shape[0]
        block_solution = solved_block_row[:, n_solved_blocks:] - contract_inner_axis(
            solved_block_row[:, :n_solved_blocks], node_solution
        )
        node_solution = jnp.concatenate([block_solution, node_solution])
    return node_solution.reshape(n_nodes, n_coordinates, *node_solution.shape[1:])


@solve_node_equations.defjvp
@with_default_jax_settings
def _solve_node_equations_jvp(primals: tuple, tangents: tuple) -> tuple:
    """Return the solution and its tangent. A second linear solve computes the tangent.

    Differentiation of the elimination would double its work.
    """
    (matrix, _, nan_free_values), (matrix_tangent, rhs_tangent, _) = primals, tangents
    node_solution = solve_node_equations(*primals)
    n_nodes, n_coordinates = matrix.shape[:2]
    flat_matrix_tangent = matrix_tangent.reshape(
        n_nodes, n_coordinates, n_nodes * n_coordinates, -1
    )
    matrix_tangent_product = contract_inner_axis(
        flat_matrix_tangent,
        node_solution.reshape(n_nodes * n_coordinates, *node_solution.shape[2:]),
    )
    return node_solution, solve_node_equations(
        matrix, rhs_tangent - matrix_tangent_product, nan_free_values
    )


def evaluate_with_jvps(function: Callable, primals: tuple, tangents: tuple) -> tuple:
    """Return the value of `function`, and its JVPs for tangents with a leading axis over
    directions.
    """
    linearized_function = lambda *t: jax.jvp(function, primals, t)
    return jax.vmap(linearized_function, out_axes=(None, 0))(*tangents)


def evaluate_with_partial_derivatives(
    function: Callable[..., Vector], arguments: Sequence[Array]
) -> tuple[Vector, list[Vector]]:
    """Return the value of an elementwise function, and the derivatives of each of its outputs.

    The derivatives are with respect to all arguments. The function uses reverse mode, because a
    phase has fewer equations than arguments.
    """
    function_values, linearized_function = jax.linearize(function, *arguments)
    partial_derivatives_by_output = []
    for i, function_value in enumerate(function_values):
        transposed_function = jax.linear_transpose(
            lambda *t, i=i: linearized_function(*t)[i], *arguments
        )
        partial_derivatives_by_output.append(transposed_function(jnp.ones_like(function_value)))
    return function_values, partial_derivatives_by_output
