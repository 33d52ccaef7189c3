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

LaneArray = Float[Array, "... lanes"]

Hold = Callable[[Any], Any]


def fusion_barrier(lanes: Float[Array, "... lanes"]) -> Hold:
    """Return an identity function that XLA can't fuse across.

    `lanes` must not hold NaN, which XLA can't prove.
    """
    if simd.tracing():
        return lax.optimization_barrier
    always = ~jnp.isnan(jnp.max(lanes))

    def hold(tree: Any) -> Any:
        return lax.cond(always, lambda t: t, lambda t: jax.tree.map(jnp.zeros_like, t), tree)

    return hold


def mix(matrix: np.ndarray, x: Array) -> Array:
    """Return a matrix product over the leading axis as a sum of elementwise products."""
    shape = (-1,) + (1,) * (x.ndim - 1)
    terms = [x[j] * matrix[:, j].astype(x.dtype).reshape(shape) for j in range(matrix.shape[1])]
    return sum(terms[1:], start=terms[0])


def weigh(weights: np.ndarray, x: Array) -> Array:
    """Return the weighted sum over the leading axis."""
    terms = [float(weights[j]) * x[j] for j in range(len(weights))]
    return sum(terms[1:], start=terms[0])


def contract(left: Array, right: Array) -> Array:
    """Return the sum over s of left[..., s, lanes] * right[s, ..., lanes], elementwise over the
    batch.
    """
    gap = (slice(None),) * (left.ndim - 2) + (None,) * (right.ndim - 2)
    terms = [left[..., s, :][(*gap, slice(None))] * right[s] for s in range(right.shape[0])]
    return sum(terms[1:], start=terms[0])


def inverse(matrix: Float[Array, "n n lanes"]) -> Float[Array, "n n lanes"]:
    """Return the inverse of a 1x1, 2x2 or 3x3 matrix by cofactors."""
    m = matrix
    if m.shape[0] == 1:
        return 1.0 / m
    if m.shape[0] == 2:
        determinant = m[0, 0] * m[1, 1] - m[0, 1] * m[1, 0]
        swapped = jnp.stack([jnp.stack([m[1, 1], -m[0, 1]]), jnp.stack([-m[1, 0], m[0, 0]])])
        return swapped / determinant
    if m.shape[0] != 3:
        raise ValueError(f"the matrix has {m.shape[0]} rows, but only 1, 2 or 3 are built.")

    def cofactor(i: int, j: int) -> Array:
        (a, b), (c, d) = ((i + 1) % 3, (i + 2) % 3), ((j + 1) % 3, (j + 2) % 3)
        return m[a, c] * m[b, d] - m[a, d] * m[b, c]

    adjugate = [[cofactor(j, i) for j in range(3)] for i in range(3)]
    determinant = m[0, 0] * adjugate[0][0] + m[0, 1] * adjugate[1][0] + m[0, 2] * adjugate[2][0]
    return jnp.stack([jnp.stack(row) for row in adjugate]) / determinant


@jax.custom_jvp
def eliminate(
    matrix: Float[Array, "nodes dim nodes dim lanes"],
    right: Float[Array, "nodes dim columns lanes"],
    for_barrier: LaneArray,
) -> Float[Array, "nodes dim columns lanes"]:
    """Solve the node equations of one mesh interval, block by block without pivoting.

    The matrix is the mass matrix plus terms of order h; its diagonal blocks stay regular.
    """
    hold = fusion_barrier(for_barrier)
    n, dim = matrix.shape[:2]
    rest = jnp.concatenate([matrix.reshape(n, dim, n * dim, -1), right], axis=2)
    rows: list[Array] = []
    for _ in range(n):
        pivot = rest[0]
        row = contract(inverse(pivot[:, :dim]), pivot[:, dim:])
        if len(rows) < n - 1:
            row = hold(row)
            rest = hold(rest[1:, :, dim:] - contract(rest[1:, :, :dim], row))
        rows.append(row)
    solved = rows[-1]
    for row in rows[-2::-1]:
        n_known = solved.shape[0]
        known = row[:, n_known:] - contract(row[:, :n_known], solved)
        solved = jnp.concatenate([known, solved])
    return solved.reshape(n, dim, *solved.shape[1:])


@eliminate.defjvp
def _eliminate_jvp(primals: tuple, tangents: tuple) -> tuple:
    """Return the tangent by a second solve; differentiating the elimination would double
    its work.
    """
    (matrix, _, for_barrier), (d_matrix, d_right, _) = primals, tangents
    solved = eliminate(*primals)
    n, dim = matrix.shape[:2]
    flat = d_matrix.reshape(n, dim, n * dim, -1)
    moved = contract(flat, solved.reshape(n * dim, *solved.shape[2:]))
    return solved, eliminate(matrix, d_right - moved, for_barrier)


def push_columns(function: Callable, primals: tuple, tangents: tuple) -> tuple:
    """Return value and JVPs of `function` along tangents with a leading axis of directions."""
    columns = lambda *t: jax.jvp(function, primals, t)
    return jax.vmap(columns, in_axes=0, out_axes=(None, 0))(*tangents)


def partials_of(
    function: Callable[..., Vector], arguments: Sequence[Array]
) -> tuple[Vector, list[Vector]]:
    """Return the value of an elementwise function, and each output's derivatives by all arguments.

    The derivatives use reverse mode, because a phase has fewer equations than arguments.
    """
    value, forward = jax.linearize(function, *arguments)
    by_output = []
    for i, output in enumerate(value):
        backward = jax.linear_transpose(lambda *t, i=i: forward(*t)[i], *arguments)
        by_output.append(backward(jnp.ones_like(output)))
    return value, by_output
