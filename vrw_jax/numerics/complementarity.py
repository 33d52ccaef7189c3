"""Unilateral contacts: all solutions of a linear complementarity problem (LCP), by enumeration."""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

from vrw_jax.numerics.codes import Code
from vrw_jax.wording import traced

MOST_CONTACTS = 10
"""Most contacts of an LCP, chosen because two to the power of it combinations are solved."""


class Answers(Code):
    """Number of solutions of an LCP."""

    NONE = 0, "No force fits: a rigid body would have to jump at once."
    ONE = 1, "One answer."
    SEVERAL = 2, "Several answers fit: the law of contact does not choose."


class Contact(NamedTuple):
    """Forces z >= 0 and gaps w = matrix z + free_gap >= 0, with z w = 0 in each contact."""

    force: Float[Array, " n"]  # of the solution with most closed contacts; NaN if there is none
    gap: Float[Array, " n"]
    answers: Int[Array, ""]  # an LCPStatus
    fits: Bool[Array, " combinations"]  # which combinations of closed contacts are solutions
    forces: Float[Array, "combinations n"]


def complementary(
    matrix: ArrayLike | Sequence, free: ArrayLike | Sequence, slack: float = 1e-12
) -> Contact:
    """Return all solutions of an LCP with any matrix, symmetric or not.

    Signs hold to `tolerance` of the largest entry. Combinations that differ only by contacts
    without force count once. The result is differentiable where one solution persists.
    """
    free = jnp.asarray(free, float)
    matrix = jnp.asarray(matrix, free.dtype)
    n = free.size
    if free.ndim != 1 or matrix.shape != (n, n) or not 0 < n <= MOST_CONTACTS:
        raise ValueError(
            f"matrix has shape {matrix.shape} and free {free.shape}, but they must be (n, n) and "
            f"(n,) with n from 1 to {MOST_CONTACTS}."
        )
    if not traced(matrix, free) and not np.isfinite(np.append(matrix, free)).all():
        raise ValueError("matrix or free holds a number that is not finite: give finite numbers.")
    largest = jnp.max(jnp.abs(matrix))
    scale = jnp.where(largest > 0.0, largest, 1.0)
    free, matrix = free / scale, matrix / scale
    closed = np.array(list(itertools.product((True, False), repeat=n)))  # most closed first
    closed = closed[np.argsort(-closed.sum(1), kind="stable")]

    def answer(closed: Array) -> tuple[Array, Array]:
        both = closed[:, None] & closed[None]
        system = jnp.where(both, matrix, jnp.eye(n, dtype=free.dtype))
        singular = jnp.abs(jnp.linalg.det(system)) <= slack
        system = jnp.where(singular, jnp.eye(n, dtype=free.dtype), system)
        force = jnp.where(closed, jnp.linalg.solve(system, jnp.where(closed, -free, 0.0)), 0.0)
        gap = jnp.where(closed, 0.0, matrix @ force + free)
        pushes = jnp.all(force >= -slack * jnp.max(jnp.abs(force)))
        opens = jnp.all(gap >= -slack * (jnp.max(jnp.abs(gap)) + jnp.max(jnp.abs(free))))
        return force, pushes & opens & ~singular

    forces, fits = jax.vmap(answer)(jnp.asarray(closed))
    reach = slack * (1.0 + jnp.max(jnp.abs(forces)))
    same = jnp.max(jnp.abs(forces[:, None] - forces[None]), -1) <= reach
    again = jnp.any(jnp.tril(same & fits[None], -1), 1)
    fits = fits & ~again
    force = jnp.where(jnp.any(fits), forces[jnp.argmax(fits)], jnp.nan)
    count = jnp.minimum(jnp.sum(fits), int(Answers.SEVERAL)).astype(jnp.int32)
    return Contact(force, scale * (matrix @ force + free), count, fits, forces)
