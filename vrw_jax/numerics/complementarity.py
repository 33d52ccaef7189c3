"""Contacts that push or open: all answers of a linear complementarity problem, by enumeration."""

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
"""Two to the power of that many combinations are solved."""


class Answers(Code):
    """How many answers there are."""

    NONE = 0, "No force fits: a rigid body would have to jump at once."
    ONE = 1, "One answer."
    SEVERAL = 2, "Several answers fit: the law of contact does not choose."


class Contact(NamedTuple):
    """Forces z >= 0 and what they leave, w = matrix z + free >= 0, with z w = 0 in each contact."""

    force: Float[Array, " n"]  # of the answer with most closed contacts; not a number without any
    gap: Float[Array, " n"]
    answers: Int[Array, ""]  # an Answers
    fits: Bool[Array, " combinations"]  # which combinations of closed contacts are answers
    forces: Float[Array, "combinations n"]


def complementary(
    matrix: ArrayLike | Sequence, free: ArrayLike | Sequence, slack: float = 1e-12
) -> Contact:
    """All answers for any matrix, symmetric or not; signs hold to `slack` of the largest entry.

    Combinations that differ only by contacts without force count once. Differentiable where one
    answer stays.
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
        raise ValueError("matrix or free holds a number that is not finite: nothing can be told.")
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
