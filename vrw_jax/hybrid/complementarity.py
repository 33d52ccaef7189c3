"""Enumerate all solutions of a linear complementarity problem (LCP) for unilateral contacts."""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

from vrw_jax.numerics import StatusCode
from vrw_jax.validation import has_traced_leaf, require_no_masked_entries

MAX_LCP_CONTACTS = 10
"""Largest number of contacts in an LCP.

For n contacts, the enumeration solves 2^n linear systems. The value is chosen to limit this number.
"""


class LCPStatus(StatusCode):
    """Number of solutions of an LCP: none, one or several."""

    NO_SOLUTION = 0, "No forces satisfy the conditions: a rigid body would have to jump."
    UNIQUE_SOLUTION = 1, "There is one solution."
    MULTIPLE_SOLUTIONS = 2, "There are several solutions: the contact law selects none."


class LCPSolutions(NamedTuple):
    """Solutions of an LCP: forces z >= 0 and gaps w = matrix z + free_gap >= 0 with z . w = 0."""

    # forces of the solution with most closed contacts; NaN if there is none
    force: Float[Array, " n"]
    gap: Float[Array, " n"]
    status: Int[Array, ""]  # an LCPStatus
    is_solution: Bool[Array, " combinations"]  # which combinations of closed contacts are solutions
    candidate_forces: Float[Array, "combinations n"]


def enumerate_lcp_solutions(
    matrix: ArrayLike | Sequence, free_gap: ArrayLike | Sequence, tolerance: float = 1e-12
) -> LCPSolutions:
    """Return all solutions of w = `matrix` z + `free_gap`, z >= 0, w >= 0, z . w = 0.

    The unknowns are the forces z and the gaps w.

    `matrix` has the shape (n, n) and need not be symmetric. `free_gap` has the shape (n,). Values
    are compared with zero to within `tolerance`, relative to the largest force or gap. Solutions
    with the same forces are counted once. The result is differentiable as long as the same contacts
    are closed. A wrong shape or a value that is not finite raises a ValueError.
    """
    require_no_masked_entries("matrix or free_gap", (matrix, free_gap))
    free_gap = jnp.asarray(free_gap, float)
    matrix = jnp.asarray(matrix, free_gap.dtype)
    n_contacts = free_gap.size
    if (
        free_gap.ndim != 1
        or matrix.shape != (n_contacts, n_contacts)
        or not 0 < n_contacts <= MAX_LCP_CONTACTS
    ):
        raise ValueError(
            f"matrix has shape {matrix.shape} and free_gap {free_gap.shape}, but they must be "
            f"(n, n) and (n,) with n from 1 to {MAX_LCP_CONTACTS}."
        )
    if not has_traced_leaf(matrix, free_gap) and not np.isfinite(np.append(matrix, free_gap)).all():
        raise ValueError(
            "matrix or free_gap contains a number that is not finite: give finite numbers."
        )
    largest_matrix_entry = jnp.max(jnp.abs(matrix))
    matrix_scale = jnp.where(largest_matrix_entry > 0.0, largest_matrix_entry, 1.0)
    free_gap, matrix = free_gap / matrix_scale, matrix / matrix_scale
    # Combinations with more closed contacts come first.
    is_closed = np.array(list(itertools.product((True, False), repeat=n_contacts)))
    is_closed = is_closed[np.argsort(-is_closed.sum(1), kind="stable")]

    def solve_combination(is_closed: Array) -> tuple[Array, Array]:
        is_pair_closed = is_closed[:, None] & is_closed[None]
        closed_contact_matrix = jnp.where(
            is_pair_closed, matrix, jnp.eye(n_contacts, dtype=free_gap.dtype)
        )
        is_singular = jnp.abs(jnp.linalg.det(closed_contact_matrix)) <= tolerance
        closed_contact_matrix = jnp.where(
            is_singular, jnp.eye(n_contacts, dtype=free_gap.dtype), closed_contact_matrix
        )
        contact_forces = jnp.where(
            is_closed,
            jnp.linalg.solve(closed_contact_matrix, jnp.where(is_closed, -free_gap, 0.0)),
            0.0,
        )
        contact_gaps = jnp.where(is_closed, 0.0, matrix @ contact_forces + free_gap)
        are_forces_nonnegative = jnp.all(
            contact_forces >= -tolerance * jnp.max(jnp.abs(contact_forces))
        )
        are_gaps_nonnegative = jnp.all(
            contact_gaps
            >= -tolerance * (jnp.max(jnp.abs(contact_gaps)) + jnp.max(jnp.abs(free_gap)))
        )
        return contact_forces, are_forces_nonnegative & are_gaps_nonnegative & ~is_singular

    candidate_forces, is_solution = jax.vmap(solve_combination)(jnp.asarray(is_closed))
    same_solution_tolerance = tolerance * (1.0 + jnp.max(jnp.abs(candidate_forces)))
    is_same_solution = (
        jnp.max(jnp.abs(candidate_forces[:, None] - candidate_forces[None]), -1)
        <= same_solution_tolerance
    )
    is_duplicate = jnp.any(jnp.tril(is_same_solution & is_solution[None], -1), 1)
    is_solution = is_solution & ~is_duplicate
    contact_forces = jnp.where(
        jnp.any(is_solution), candidate_forces[jnp.argmax(is_solution)], jnp.nan
    )
    solution_status = jnp.minimum(jnp.sum(is_solution), int(LCPStatus.MULTIPLE_SOLUTIONS)).astype(
        jnp.int32
    )
    return LCPSolutions(
        contact_forces,
        matrix_scale * (matrix @ contact_forces + free_gap),
        solution_status,
        is_solution,
        candidate_forces,
    )
