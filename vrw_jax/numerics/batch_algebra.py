"""Linear algebra of many small systems together, batch last, as sums of elementwise products.

XLA on CPU computes cheap producers again for each consumer, which costs more than all arithmetic
here. `lax.cond` on a predicate that is always true, but only known at run time, is a barrier that
XLA can't remove.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from vrw_jax import simd
from vrw_jax.numerics.types import Vector
from vrw_jax.runtime import with_default_settings

LaneArray = Float[Array, "... lanes"]

HoldFn = Callable[[Any], Any]


def fusion_barrier(lanes: Float[Array, "... lanes"]) -> HoldFn:
    """Return an identity function that XLA can't fuse across.

    `lanes` must not hold NaN, which XLA can't prove.
    """
    if simd.targets_machine_code():
        return lax.optimization_barrier
    is_always_true = ~jnp.isnan(jnp.max(lanes))

    def hide_from_fusion(tree: Any) -> Any:
        return lax.cond(
            is_always_true, lambda t: t, lambda t: jax.tree.map(jnp.zeros_like, t), tree
        )

    return hide_from_fusion


def apply_matrix(matrix: np.ndarray, x: Array) -> Array:
    """Return a matrix product over the leading axis as a sum of elementwise products."""
    shape = (-1,) + (1,) * (x.ndim - 1)
    terms = [x[j] * matrix[:, j].astype(x.dtype).reshape(shape) for j in range(matrix.shape[1])]
    return sum(terms[1:], start=terms[0])


def weighted_sum(weights: np.ndarray, x: Array) -> Array:
    """Return the weighted sum over the leading axis."""
    terms = [float(weights[j]) * x[j] for j in range(len(weights))]
    return sum(terms[1:], start=terms[0])


def contract_axes(left_array: Array, right_array: Array) -> Array:
    """Return the sum over s of left[..., s, lanes] * right[s, ..., lanes], elementwise over the
    batch.
    """
    new_axes = (slice(None),) * (left_array.ndim - 2) + (None,) * (right_array.ndim - 2)
    terms = [
        left_array[..., s, :][(*new_axes, slice(None))] * right_array[s]
        for s in range(right_array.shape[0])
    ]
    return sum(terms[1:], start=terms[0])


def invert_small(matrix: Float[Array, "n n lanes"]) -> Float[Array, "n n lanes"]:
    """Return the inverse of a 1x1, 2x2 or 3x3 matrix by cofactors."""
    m = matrix
    if m.shape[0] == 1:
        return 1.0 / m
    if m.shape[0] == 2:
        determinant = m[0, 0] * m[1, 1] - m[0, 1] * m[1, 0]
        adjugate_2x2 = jnp.stack([jnp.stack([m[1, 1], -m[0, 1]]), jnp.stack([-m[1, 0], m[0, 0]])])
        return adjugate_2x2 / determinant
    if m.shape[0] != 3:
        raise ValueError(f"the matrix has {m.shape[0]} rows, but only 1, 2 or 3 are built.")

    def cofactor(i: int, j: int) -> Array:
        (a, b), (c, d) = ((i + 1) % 3, (i + 2) % 3), ((j + 1) % 3, (j + 2) % 3)
        return m[a, c] * m[b, d] - m[a, d] * m[b, c]

    adjugate = [[cofactor(j, i) for j in range(3)] for i in range(3)]
    determinant = m[0, 0] * adjugate[0][0] + m[0, 1] * adjugate[1][0] + m[0, 2] * adjugate[2][0]
    return jnp.stack([jnp.stack(row) for row in adjugate]) / determinant


@jax.custom_jvp
def solve_node_equations(
    matrix: Float[Array, "nodes dim nodes dim lanes"],
    rhs: Float[Array, "nodes dim columns lanes"],
    for_barrier: LaneArray,
) -> Float[Array, "nodes dim columns lanes"]:
    """Solve the node equations of one mesh interval, block by block without pivoting.

    The matrix is the mass matrix plus terms of order h; its diagonal blocks stay regular.
    """
    hide_from_fusion = fusion_barrier(for_barrier)
    n, dim = matrix.shape[:2]
    remaining = jnp.concatenate([matrix.reshape(n, dim, n * dim, -1), rhs], axis=2)
    rows: list[Array] = []
    for _ in range(n):
        pivot = remaining[0]
        row = contract_axes(invert_small(pivot[:, :dim]), pivot[:, dim:])
        if len(rows) < n - 1:
            row = hide_from_fusion(row)
            remaining = hide_from_fusion(
                remaining[1:, :, dim:] - contract_axes(remaining[1:, :, :dim], row)
            )
        rows.append(row)
    solution = rows[-1]
    for row in rows[-2::-1]:
        n_solved = solution.shape[0]
        block_solution = row[:, n_solved:] - contract_axes(row[:, :n_solved], solution)
        solution = jnp.concatenate([block_solution, solution])
    return solution.reshape(n, dim, *solution.shape[1:])


@solve_node_equations.defjvp
@with_default_settings
def _eliminate_jvp(primals: tuple, tangents: tuple) -> tuple:
    """Return the tangent by a second solve; differentiating the elimination would double
    its work.
    """
    (matrix, _, for_barrier), (d_matrix, d_right, _) = primals, tangents
    solution = solve_node_equations(*primals)
    n, dim = matrix.shape[:2]
    flat_tangent = d_matrix.reshape(n, dim, n * dim, -1)
    matrix_term = contract_axes(flat_tangent, solution.reshape(n * dim, *solution.shape[2:]))
    return solution, solve_node_equations(matrix, d_right - matrix_term, for_barrier)


def value_and_jvps(function: Callable, primals: tuple, tangents: tuple) -> tuple:
    """Return value and JVPs of `function` along tangents with a leading axis of directions."""
    jvp_along = lambda *t: jax.jvp(function, primals, t)
    return jax.vmap(jvp_along, in_axes=0, out_axes=(None, 0))(*tangents)


def value_and_partials(
    function: Callable[..., Vector], arguments: Sequence[Array]
) -> tuple[Vector, list[Vector]]:
    """Return the value of an elementwise function, and each output's derivatives by all arguments.

    The derivatives use reverse mode, because a phase has fewer equations than arguments.
    """
    value, apply_jvp = jax.linearize(function, *arguments)
    partials_by_output = []
    for i, output in enumerate(value):
        apply_transpose = jax.linear_transpose(lambda *t, i=i: apply_jvp(*t)[i], *arguments)
        partials_by_output.append(apply_transpose(jnp.ones_like(output)))
    return value, partials_by_output
