"""Linear algebra for batches of small systems, as sums of elementwise products.

The batch is on the last axis. XLA on CPU recomputes inexpensive intermediate results for each use,
which costs more than all arithmetic of this module. A `lax.cond` prevents this recomputation,
because XLA cannot prove at compile time that the predicate of the `lax.cond` is always true.
"""

import functools
import operator
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from vrw_jax import lanes
from vrw_jax.base.types import Vector
from vrw_jax.lanes.settings import with_default_jax_settings

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
