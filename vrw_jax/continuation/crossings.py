"""Whether the special points between two points of a branch account for their multipliers.

A continuation may step over several special points at once, or onto another branch nearby. Either
shows in the number of multipliers outside the unit circle, or in the sign of the determinant of
Newton's equations along the branch, which changes at branch points alone.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from vrw_jax.continuation.floquet import (
    MAX_CLOSED_FORM_SIZE,
    bifurcation_margins,
    floquet_multipliers,
)
from vrw_jax.numerics import Scalar

ON_CIRCLE_TOLERANCE = 1e-6
"""Distance from modulus 1 within which a multiplier counts to either side; chosen because
multipliers of maps that keep areas lie on the circle to their round-off, 1e-8 where two meet."""


def is_accounted_for(
    before: Float[Array, "n n"], after: Float[Array, "n n"], turns_back: Bool[Array, ""]
) -> Bool[Array, ""]:
    """Return whether folds, period doublings and pairs explain all that changes between two points.

    `before` and `after` are the Jacobians of the map there; `turns_back`: the parameter turns back
    between them.
    """
    changes = bifurcation_margins(before) * bifurcation_margins(after) < 0.0
    crosses_branch = changes[0] != turns_back
    if before.shape[-1] > MAX_CLOSED_FORM_SIZE and jax.default_backend() != "cpu":
        return ~crosses_branch  # eigenvalues of larger matrices are computed on CPUs alone
    most = changes[0].astype(int) + changes[1] + (2 * changes[2] if len(changes) > 2 else 0)
    (least_before, most_before), (least_after, most_after) = map(_count_outside, (before, after))
    change = jnp.maximum(least_after - most_before, least_before - most_after)
    return ~crosses_branch & (change <= most)


def _count_outside(matrix: Float[Array, "n n"]) -> tuple[Array, Array]:
    """Return the least and the largest number of multipliers that lie outside the unit circle."""
    moduli = jnp.abs(floquet_multipliers(matrix))
    return (
        jnp.sum(moduli > 1.0 + ON_CIRCLE_TOLERANCE),
        jnp.sum(moduli > 1.0 - ON_CIRCLE_TOLERANCE),
    )


class Doubt(NamedTuple):
    """Whether steps of a continuation are shortened because the last one may leave the branch.

    - `step`: the first that was shortened, 0 if none is;
    - `is_over`: no shorter step helped, and the next one counts whatever its multipliers.
    """

    step: Scalar
    is_over: Bool[Array, ""]

    def raised(self, doubtful: Bool[Array, ""], step: Scalar) -> "Doubt":
        """Return the doubt after a trial of length `step` that was or was not doubtful."""
        first = doubtful & (self.step == 0.0)
        return self._replace(step=jnp.where(first, step, self.step))

    def resolved(
        self, accepted: Bool[Array, ""], step: Scalar, smallest: float
    ) -> tuple["Doubt", Scalar]:
        """Return the doubt before the next trial and its length: of `step` if none is left."""
        ends = (self.step > 0.0) & ~self.is_over & (step < smallest)
        following = jnp.where(ends, self.step, step)
        clear = accepted & (self.is_over | (following >= self.step))
        return Doubt(
            jnp.where(clear, 0.0, self.step), jnp.where(accepted, False, self.is_over | ends)
        ), following
