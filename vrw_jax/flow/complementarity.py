"""Enumerate all solutions of a linear complementarity problem (LCP) for unilateral contacts."""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

from vrw_jax.base.checks import has_traced_leaf, require_no_masked_entries
from vrw_jax.base.printing import StatusCode

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

    `matrix` has the shape (n, n) and need not be symmetric. `free_gap` has the shape (n,). A force,
    a gap or a determinant counts as zero if relative changes of all entries by `tolerance` may
    change its sign. The answer therefore does not depend on the units of any force or gap.

    Solutions with the same forces are counted once. Contacts whose matrix is singular are not
    closed together, so a continuum of solutions counts by its ends. The result is differentiable as
    long as the same contacts are closed. A wrong shape or a value that is not finite raises a
    ValueError.
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
    return _enumerate_solutions(matrix, free_gap, tolerance)


@jax.jit
def _enumerate_solutions(matrix: Array, free_gap: Array, tolerance: ArrayLike) -> LCPSolutions:
    """Return the result of `enumerate_lcp_solutions` by one program, which compiles at once."""
    n_contacts = free_gap.size
    # Round-off of sums of n terms changes signs as well.
    zero_tolerance = jnp.maximum(tolerance, n_contacts * jnp.finfo(free_gap.dtype).eps)
    # Combinations with more closed contacts come first.
    is_closed = np.array(list(itertools.product((True, False), repeat=n_contacts)))
    is_closed = is_closed[np.argsort(-is_closed.sum(1), kind="stable")]

    def solve_combination(is_closed: Array) -> tuple[Array, ...]:
        closed_matrix = jnp.where(
            is_closed[:, None] & is_closed, matrix, jnp.eye(n_contacts, dtype=matrix.dtype)
        )
        inverse = _invert_scaled(lax.stop_gradient(closed_matrix))
        # Relative changes of all entries by the tolerance change the determinant by this part.
        determinant_change = zero_tolerance * jnp.sum(jnp.abs(inverse.T * closed_matrix))
        is_regular = determinant_change < 1.0
        inverse = _invert_scaled(
            jnp.where(is_regular, closed_matrix, jnp.eye(n_contacts, dtype=matrix.dtype))
        )
        forces = -inverse @ jnp.where(is_closed, free_gap, 0.0)
        # One refinement makes also the smallest force accurate (Skeel 1980).
        forces = forces - inverse @ jnp.where(is_closed, matrix @ forces + free_gap, 0.0)
        gaps = jnp.where(is_closed, 0.0, matrix @ forces + free_gap)
        # Skeel's bounds (1979) of the changes due to relative changes of all entries by one.
        gap_terms = jnp.abs(matrix) @ jnp.abs(forces) + jnp.abs(free_gap)
        force_changes = jnp.abs(inverse) @ jnp.where(is_closed, gap_terms, 0.0)
        gap_changes = gap_terms + jnp.abs(matrix) @ force_changes
        is_solution = is_regular & jnp.all(
            (forces >= -zero_tolerance * force_changes) & (gaps >= -zero_tolerance * gap_changes)
        )
        return forces, gaps, zero_tolerance * force_changes, is_solution

    candidate_forces, candidate_gaps, force_errors, is_solution = jax.vmap(solve_combination)(
        jnp.asarray(is_closed)
    )
    is_same_solution = jnp.all(
        jnp.abs(candidate_forces[:, None] - candidate_forces)
        <= force_errors[:, None] + force_errors,
        axis=-1,
    )
    is_duplicate = jnp.any(jnp.tril(is_same_solution & is_solution, -1), axis=1)
    is_solution = is_solution & ~is_duplicate
    contact_forces, contact_gaps = (
        jnp.where(jnp.any(is_solution), candidates[jnp.argmax(is_solution)], jnp.nan)
        for candidates in (candidate_forces, candidate_gaps)
    )
    status = jnp.minimum(jnp.sum(is_solution), int(LCPStatus.MULTIPLE_SOLUTIONS))
    return LCPSolutions(
        contact_forces, contact_gaps, status.astype(jnp.int32), is_solution, candidate_forces
    )


def _invert_scaled(matrix: Array) -> Array:
    """Return the inverse, computed with the largest entry of each row and column scaled to 1.

    Without the scaling, a row in small units would supply pivots that lose all digits.
    """
    largest = lambda entries, axis: jnp.where(
        jnp.any(entries != 0.0, axis, keepdims=True),
        lax.stop_gradient(jnp.max(jnp.abs(entries), axis, keepdims=True)),
        1.0,
    )
    row_scale = largest(matrix, 1)
    column_scale = largest(matrix / row_scale, 0)
    return jnp.linalg.inv(matrix / row_scale / column_scale) / column_scale.T / row_scale.T
