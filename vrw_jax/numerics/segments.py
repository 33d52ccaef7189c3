"""Multipliers of a periodic orbit from its segments, without forming their product.

A product of matrices keeps what grows and loses what decays: a multiplier of 1e-20 beside one of 1
has no correct digit in it. Orthogonal iteration around the period makes every factor triangular
instead (a periodic Schur form). A multiplier is then a product of diagonal entries, each correct.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from vrw_jax.numerics.events import Field, sample_phase
from vrw_jax.numerics.options import Options
from vrw_jax.numerics.types import Scalar


class Segments(NamedTuple):
    """A flow in segments of equal time."""

    states: Float[Array, "n_ends dim"]  # at the segments' ends, the start first
    maps: Float[Array, "n_segments n n"]  # Jacobian of each segment's end with respect to its start
    divergence: Scalar  # integrated over all segments: logarithm of the determinant


def segment_maps(
    field: Field,
    start: ArrayLike | Sequence,
    duration: ArrayLike,
    n_segments: int,
    options: Options,
    directions: int | None = None,
) -> Segments:
    """Return the flow of `field` with its Jacobians by the first `n_directions` coordinates
    (default all).

    Derivatives take part in the step-size control. Each tangent is a direction of about constant
    length and the logarithm of its growth, so that decaying directions keep their digits. A segment
    whose solver steps are spent is NaN. A clock among the coordinates is no direction and must
    follow those that are.
    """
    start = jnp.asarray(start, float)
    told = jax.eval_shape(field, start)
    n = start.size if directions is None else directions
    if start.ndim != 1 or told.shape != start.shape:
        raise ValueError(
            f"the field gives shape {told.shape} for a start of shape {start.shape}, but both must "
            "be one row of the same length."
        )
    if not (0 < n <= start.size and n_segments > 0):
        raise ValueError(
            f"directions is {n} and n_segments {n_segments}, but the first must be from 1 to "
            f"{start.size} and the other positive."
        )
    dim, size = start.size, start.size * (1 + n)
    length = jnp.asarray(duration, start.dtype) / n_segments

    def along(z: Array) -> Array:
        y, columns = z[:dim], z[dim:size].reshape(n, dim)
        push = lambda tangent: jax.jvp(field, (y,), (tangent,))[1]
        moved = jax.vmap(push)(columns)
        growth = jnp.sum(columns * moved, axis=1) / jnp.sum(columns * columns, axis=1)
        turned = moved - growth[:, None] * columns
        own = jax.vmap(push)(jnp.eye(n, dim, dtype=z.dtype))
        clock = jnp.ones_like(y[:1])
        return jnp.concatenate([field(y), turned.ravel(), growth, jnp.trace(own)[None], clock])

    def passed(state: Array, _: None) -> tuple[Array, tuple]:
        begin = jnp.concatenate([state, jnp.eye(n, dim).ravel(), jnp.zeros(n + 2)])
        end = sample_phase(along, begin, length, 2, options)[-1]
        reached = (
            jnp.abs(end[-1] - length) <= 1e-9 * length
        )  # otherwise the solver steps were spent
        columns, grown = end[dim:size].reshape(n, dim), jnp.exp(end[size : size + n])
        one = jnp.where(reached, columns[:, :n].T * grown, jnp.nan)
        return end[:dim], (end[:dim], one, end[-2])

    _, (states, maps, divergences) = lax.scan(passed, start, None, length=n_segments)
    return Segments(jnp.concatenate([start[None], states]), maps, jnp.sum(divergences))


class Multipliers(NamedTuple):
    """Eigenvalues of a product of matrices, the largest first."""

    values: np.ndarray  # complex; NaN where `is_known` is False
    logarithms: np.ndarray  # of their moduli, finite even if the value underflows
    uncertainty: np.ndarray  # estimated
    known: np.ndarray  # whether the relative error is within `accuracy`


SWEEPS = 60
"""Number of sweeps around the period.

It is chosen because moduli that differ by a factor of two are then separated to the last digit.
Closer moduli stay together in one block, whose product loses few digits.
"""


def product_multipliers(
    maps: ArrayLike | Sequence, accuracy: float = 1e-6, tolerance: float = 1e-15
) -> Multipliers:
    """Return the eigenvalues of jacobians[-1] @ ... @ jacobians[0] and whether each has `accuracy`.

    `tolerance` is the error of each Jacobian relative to its norm. The function accepts concrete
    matrices only.
    """
    maps = np.asarray(maps, float)
    if maps.ndim != 3 or maps.shape[1] != maps.shape[2] or not maps.size:
        raise ValueError(f"maps has shape {maps.shape}, but it must be (n_segments, n, n).")
    if not np.all(np.isfinite(maps)):
        raise ValueError(
            "maps holds a number that is not finite: the flow left its domain, or its steps were "
            "spent; take more segments, or raise Options.max_solver_steps."
        )
    n, basis, close = maps.shape[1], np.eye(maps.shape[1]), np.eye(maps.shape[1])
    triangles = np.zeros_like(maps)
    for _ in range(SWEEPS):
        moved = basis
        for i, one in enumerate(maps):
            moved, triangles[i] = np.linalg.qr(one @ moved)
        close, basis = basis.T @ moved, moved
        joined = np.abs(np.tril(close, -1)) > 1e-14
        if not joined.any():
            break
    blocks, first = [], 0
    for last in range(1, n + 1):
        if not joined[last:, :last].any():
            blocks.append(slice(first, last))
            first = last
    norms = np.linalg.norm(maps, axis=(1, 2))
    parts = [_of_block(triangles, close, block, norms, tolerance) for block in blocks]
    values, logarithms, uncertainty = (np.concatenate(x) for x in zip(*parts, strict=True))
    known = uncertainty <= accuracy
    order = np.argsort(-logarithms, kind="stable")
    told = np.where(known, values, np.nan)
    return Multipliers(told[order], logarithms[order], uncertainty[order], known[order])


def _of_block(
    triangles: np.ndarray, close: np.ndarray, block: slice, norms: np.ndarray, tolerance: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the multipliers of one diagonal block, their logarithms and relative errors."""
    part, size = triangles[:, block, block], block.stop - block.start
    diagonal = np.abs(np.diagonal(part, axis1=1, axis2=2))
    with np.errstate(divide="ignore", invalid="ignore"):
        each = np.log(diagonal)
        weakest = np.where(diagonal > 0.0, norms[:, None] / diagonal, 0.0)
        error = tolerance * np.max(np.sum(weakest, axis=0))
        total, scale, spread = np.eye(size), 0.0, np.ptp(np.sum(each, axis=0)) if size > 1 else 0.0
        for one in part:
            total = one @ total
            largest = np.max(np.abs(total)) or 1.0
            total, scale = total / largest, scale + np.log(largest)
        values = np.linalg.eigvals(close[block, block] @ total)
        logarithms = np.log(np.abs(values)) + scale
        if size == 1:
            logarithms = np.sum(each, axis=0)
        phases = np.where(values == 0.0, 1.0, values / np.abs(values))
        told = phases * np.exp(logarithms)
    return told, logarithms, np.full(size, error * np.exp(spread))
