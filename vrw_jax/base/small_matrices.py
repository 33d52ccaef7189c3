"""Algebra of small real matrices: Floquet multipliers, and linear complementarity problems (LCPs).

Multipliers are those of Jacobians of return maps, of shape (..., n, n). They are computed in closed
form for n at most 3, differentiably and in batches. For larger matrices LAPACK computes the
multipliers, the spectral radius and the bifurcation margins on a CPU. An eigenvalue is not
differentiable if it equals another eigenvalue. The Jury margins are polynomials of the matrix
entries and always differentiable. For LCPs of unilateral contacts, all solutions are enumerated.
"""

import functools
import itertools
import operator
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Complex, Float, Inexact, Int

from vrw_jax.base.checks import has_traced_leaf, require_no_masked_entries
from vrw_jax.base.results import StatusCode
from vrw_jax.lanes.autodiff import compute_square_root

RealSquareMatrix = Float[Array, "... n n"]

MAX_CLOSED_FORM_SIZE = 3
"""Size of the largest matrix whose characteristic polynomial is solved in closed form."""

SMOOTH_MIN_SHARPNESS = 50.0
"""Sharpness of the smooth minimum in `compute_stability_margin`. The value is chosen because the
result is then at most log(4)/50 below the exact minimum.
"""


UNIT_CIRCLE_DISTANCE = 1e-6
"""Largest distance from modulus 1 at which a multiplier may lie on either side of the circle. The
value is chosen because area-preserving maps have multipliers on the circle up to round-off,
which is 1e-8 for two equal multipliers.
"""
LOCATED_PAIR_CIRCLE_DISTANCE = 1e-4
"""Largest distance from modulus 1 of the pair at a located Neimark-Sacker bifurcation."""
MIN_IMAGINARY_PART = 1e-3
"""Imaginary part below which a multiplier on the unit circle is treated as real. The value is
chosen because three equal real multipliers are computed with imaginary parts of 1e-5.
"""
EQUAL_MODULI_DISTANCE = 1e-6
"""Largest difference of two moduli that are treated as equal. The value is that of
`UNIT_CIRCLE_DISTANCE`.
"""


def compute_characteristic_polynomial(
    matrix: Inexact[Array | np.ndarray, "... n n"],
) -> tuple[Any, ...]:
    """Return the coefficients (a_0, ..., a_{n-1}) of det(z - matrix) = z^n + ... + a_1 z + a_0."""
    n = matrix.shape[-1]
    if matrix.shape[-2:] != (n, n) or n not in (1, 2, 3):
        raise ValueError(
            f"the matrix has shape {matrix.shape}, but multipliers are built for 1x1, 2x2 and 3x3."
        )
    entry = lambda i, j: matrix[..., i, j]
    compute_minor = lambda rows, columns: (
        entry(rows[0], columns[0]) * entry(rows[1], columns[1])
        - entry(rows[0], columns[1]) * entry(rows[1], columns[0])
    )
    add_terms = functools.partial(functools.reduce, operator.add)
    trace = add_terms([entry(i, i) for i in range(n)])
    if n == 1:
        return (-trace,)
    sum_of_principal_minors = add_terms(
        [compute_minor(pair, pair) for pair in itertools.combinations(range(n), 2)]
    )
    if n == 2:
        return sum_of_principal_minors, -trace
    determinant = add_terms(
        [
            entry(0, column) * compute_minor((1, 2), other_columns)
            for column, other_columns in enumerate(((1, 2), (2, 0), (0, 1)))
        ]
    )
    return -determinant, sum_of_principal_minors, -trace


class _EigenvaluePair(NamedTuple):
    """Pair of eigenvalues, which are real or complex conjugates.

    The eigenvalues are pair_mean ± real_offset if they are real, and pair_mean ± i imaginary_offset
    otherwise.
    """

    pair_mean: Array
    real_eigenvalue_offset: Array
    imaginary_eigenvalue_offset: Array

    @property
    def pair_modulus(self) -> Array:
        """Return the common modulus of a complex pair."""
        return compute_square_root(
            self.pair_mean * self.pair_mean
            + self.imaginary_eigenvalue_offset * self.imaginary_eigenvalue_offset
        )


def _solve_quadratic_pair(a0: Array, a1: Array) -> _EigenvaluePair:
    """Return the two roots of z^2 + a1 z + a0."""
    pair_mean = -0.5 * a1
    discriminant = pair_mean * pair_mean - a0
    return _EigenvaluePair(
        pair_mean,
        compute_square_root(discriminant),
        compute_square_root(-discriminant),
    )


def _solve_cubic_real_root(a0: Array, a1: Array, a2: Array) -> Array:
    """Return the real root of z^3 + a2 z^2 + a1 z + a0 that is farthest from the other roots.

    A closed form first computes the root without derivatives. Newton's method then makes the root
    exact, and provides derivatives up to order 3.
    """
    b0, b1, b2 = map(lax.stop_gradient, (a0, a1, a2))
    mean_root = -b2 / 3.0
    p = b1 - b2 * b2 / 3.0  # The shifted root y = z - mean_root satisfies y^3 + p y + q = 0.
    q = b0 + mean_root * (b1 + mean_root * (b2 + mean_root))
    discriminant = 0.25 * q * q + p * p * p / 27.0
    has_three_real_roots = discriminant < 0.0
    # A single real root is the sum of two cube roots, computed without cancellation.
    larger_cube_root = jnp.cbrt(
        -0.5 * q - jnp.where(q >= 0.0, 1.0, -1.0) * compute_square_root(discriminant)
    )
    unique_real_root = larger_cube_root - jnp.where(
        larger_cube_root == 0.0,
        0.0,
        p / (3.0 * jnp.where(larger_cube_root == 0, 1, larger_cube_root)),
    )
    # If three roots are real, the extreme root on the isolated side is computed.
    trigonometric_radius = 2.0 * compute_square_root(-p / 3.0)
    root_cosine = -4.0 * q / jnp.where(trigonometric_radius == 0.0, 1.0, trigonometric_radius**3)
    extreme_root = trigonometric_radius * jnp.cos(
        jnp.arccos(jnp.clip(jnp.abs(root_cosine), 0.0, 1.0)) / 3.0
    )
    z = mean_root + jnp.where(
        has_three_real_roots,
        jnp.where(root_cosine >= 0.0, extreme_root, -extreme_root),
        unique_real_root,
    )
    for _ in range(3):
        cubic_value = a0 + z * (a1 + z * (a2 + z))
        cubic_derivative = a1 + z * (2.0 * a2 + 3.0 * z)
        z = z - jnp.where(
            cubic_derivative == 0.0,
            0.0,
            cubic_value / jnp.where(cubic_derivative == 0.0, 1.0, cubic_derivative),
        )
    return z


def _split_into_isolated_and_pair(
    matrix: RealSquareMatrix,
) -> tuple[list[Array], _EigenvaluePair | None]:
    """Return the isolated real eigenvalues of a small matrix, and the remaining pair of
    eigenvalues.

    The pair is None for a 1x1 matrix.
    """
    polynomial_coefficients = compute_characteristic_polynomial(matrix)
    if len(polynomial_coefficients) == 1:
        return [-polynomial_coefficients[0]], None
    if len(polynomial_coefficients) == 2:
        return [], _solve_quadratic_pair(*polynomial_coefficients)
    a0, a1, a2 = polynomial_coefficients
    isolated_root = _solve_cubic_real_root(a0, a1, a2)
    linear_coefficient = a2 + isolated_root
    return [isolated_root], _solve_quadratic_pair(
        a1 + isolated_root * linear_coefficient, linear_coefficient
    )


@jax.jit
def floquet_multipliers(matrix: RealSquareMatrix) -> Complex[Array, "... n"]:
    """Return all eigenvalues of a return map's Jacobian, shape (..., n).

    The eigenvalues are in the order of decreasing modulus.
    """
    if matrix.shape[-1] > MAX_CLOSED_FORM_SIZE:
        return _sort_eigenvalues_by_modulus(jnp.linalg.eigvals(matrix))
    isolated_eigenvalues, remaining_pair = _split_into_isolated_and_pair(matrix)
    eigenvalues = [lax.complex(x, jnp.zeros_like(x)) for x in isolated_eigenvalues]
    if remaining_pair is not None:
        pair_mean, real_eigenvalue_offset, imaginary_eigenvalue_offset = remaining_pair
        eigenvalues += [
            lax.complex(
                pair_mean + offset_sign * real_eigenvalue_offset,
                offset_sign * imaginary_eigenvalue_offset,
            )
            for offset_sign in (1.0, -1.0)
        ]
    return _sort_eigenvalues_by_modulus(jnp.stack(eigenvalues, -1))


def _sort_eigenvalues_by_modulus(eigenvalues: Array) -> Array:
    """Return the eigenvalues in the order of decreasing modulus."""
    eigenvalue_moduli = jnp.square(eigenvalues.real) + jnp.square(eigenvalues.imag)
    descending_order = jnp.argsort(-lax.stop_gradient(eigenvalue_moduli), axis=-1)
    return jnp.take_along_axis(eigenvalues, descending_order, -1)


def compute_multipliers(jacobians: np.ndarray) -> np.ndarray:
    """Return the multipliers of NumPy matrices in the order of decreasing modulus, by LAPACK.

    They are NaN if a matrix is not finite.
    """
    is_finite = np.isfinite(jacobians).all((-1, -2))[..., None]
    multipliers = np.linalg.eigvals(np.where(is_finite[..., None], jacobians, 0.0))
    order = np.argsort(-np.abs(multipliers), -1, kind="stable")
    return np.where(is_finite, np.take_along_axis(multipliers, order, -1), np.nan)


@jax.jit
def compute_spectral_radius(matrix: RealSquareMatrix) -> Float[Array, "..."]:
    """Return the largest modulus of the eigenvalues of `matrix`.

    If two eigenvalues are equal, the derivative is one-sided or zero.
    """
    if matrix.shape[-1] > MAX_CLOSED_FORM_SIZE:
        return jnp.abs(floquet_multipliers(matrix)[..., 0])
    isolated_eigenvalues, remaining_pair = _split_into_isolated_and_pair(matrix)
    eigenvalue_moduli = [jnp.abs(x) for x in isolated_eigenvalues]
    if remaining_pair is not None:
        max_real_modulus = jnp.abs(remaining_pair.pair_mean) + remaining_pair.real_eigenvalue_offset
        eigenvalue_moduli.append(
            jnp.where(
                remaining_pair.imaginary_eigenvalue_offset > 0.0,
                remaining_pair.pair_modulus,
                max_real_modulus,
            )
        )
    return functools.reduce(jnp.maximum, eigenvalue_moduli)


@jax.jit
def compute_jury_margins(matrix: RealSquareMatrix) -> Float[Array, "... n_margins"]:
    """Return the Jury margins, which are all positive if and only if all multipliers are stable.

    The first margin vanishes at a fold (multiplier 1), and the second at a period doubling
    (multiplier -1). For n > 1 the third margin vanishes when a pair of multipliers crosses the unit
    circle. For n = 3 the fourth margin completes the criterion.
    """
    return jnp.stack(list_jury_margins(matrix), -1)


def list_jury_margins(matrix: Any) -> list[Any]:
    """Return the Jury margins of NumPy or JAX matrices, each of shape (...)."""
    a = compute_characteristic_polynomial(matrix)
    margins = [
        1.0 + sum(sign ** (len(a) - i) * coefficient for i, coefficient in enumerate(a))
        for sign in (1.0, -1.0)
    ]
    if len(a) == 2:
        margins.append(1.0 - a[0])
    elif len(a) == 3:
        margins += [1.0 - a[0] * a[0] - a[1] + a[0] * a[2], 1.0 - a[0] * a[0]]
    return margins


@jax.jit
def compute_stability_margin(matrix: RealSquareMatrix) -> Float[Array, "..."]:
    """Return a smooth minimum of the Jury margins, which is at most their exact minimum.

    A positive result implies that the gait is stable.
    """
    jury_margin_values = SMOOTH_MIN_SHARPNESS * compute_jury_margins(matrix)
    lowest_jury_margin = lax.stop_gradient(jnp.min(jury_margin_values, -1))
    sum_of_exponentials = jnp.sum(jnp.exp(lowest_jury_margin[..., None] - jury_margin_values), -1)
    return (lowest_jury_margin - jnp.log(sum_of_exponentials)) / SMOOTH_MIN_SHARPNESS


@jax.jit
def has_double_multiplier(
    matrix: RealSquareMatrix, modulus_tolerance: float = 1e-6
) -> Bool[Array, "..."]:
    """Return whether the two largest moduli are equal within `modulus_tolerance`.

    The spectral radius then has a kink. The moduli of a complex pair are equal and smooth. Such a
    pair therefore satisfies the test only if its imaginary part is at most `modulus_tolerance`, or
    if a real multiplier has the same modulus.
    """
    isolated_eigenvalues, remaining_pair = _split_into_isolated_and_pair(matrix)
    if remaining_pair is None:
        return jnp.zeros(matrix.shape[:-2], bool)
    pair_mean, real_eigenvalue_offset, imaginary_eigenvalue_offset = remaining_pair
    real_eigenvalues = [
        *isolated_eigenvalues,
        pair_mean + real_eigenvalue_offset,
        pair_mean - real_eigenvalue_offset,
    ]
    is_complex_pair = imaginary_eigenvalue_offset > 0.0
    eigenvalue_moduli = jnp.sort(jnp.abs(jnp.stack(real_eigenvalues, -1)), -1)
    has_equal_real_moduli = (
        eigenvalue_moduli[..., -1] - eigenvalue_moduli[..., -2] <= modulus_tolerance
    )
    has_equal_moduli = imaginary_eigenvalue_offset <= modulus_tolerance
    for x in isolated_eigenvalues:
        distance = jnp.abs(x) - remaining_pair.pair_modulus
        # A larger real multiplier is the only one of its modulus.
        has_equal_moduli = (jnp.abs(distance) <= modulus_tolerance) | (
            has_equal_moduli & (distance < 0.0)
        )
    return jnp.where(is_complex_pair, has_equal_moduli, has_equal_real_moduli)


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
