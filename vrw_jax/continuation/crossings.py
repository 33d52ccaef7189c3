"""Test by the multipliers whether two neighboring points are on one branch.

A continuation step may pass several special points, or reach another branch nearby. Both change the
number of multipliers outside the unit circle, or the sign of the determinant of Newton's equations
along the branch. The sign of the determinant changes only at branch points.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from vrw_jax.continuation.floquet import (
    MAX_CLOSED_FORM_SIZE,
    MULTIPLIER_TOLERANCES,
    MultiplierTolerances,
    bifurcation_margins,
    floquet_multipliers,
)
from vrw_jax.numerics import Scalar


def is_multiplier_change_explained(
    jacobian_before: Float[Array, "n n"],
    jacobian_after: Float[Array, "n n"],
    has_turned_back: Bool[Array, ""],
    tolerances: MultiplierTolerances = MULTIPLIER_TOLERANCES,
) -> Bool[Array, ""]:
    """Return whether bifurcations explain the change of the multipliers between two points.

    `has_turned_back` states whether the parameter turns back between the points.
    """
    margins_before, margins_after = map(bifurcation_margins, (jacobian_before, jacobian_after))
    has_margin_sign_change = margins_before * margins_after < 0.0
    crosses_other_branch = has_margin_sign_change[0] != has_turned_back
    if jacobian_before.shape[-1] > MAX_CLOSED_FORM_SIZE and jax.default_backend() != "cpu":
        return ~crosses_other_branch  # Eigenvalues of larger matrices are computed on CPUs alone.
    n_explained_multipliers = has_margin_sign_change[0].astype(int) + has_margin_sign_change[1]
    n_explained_multipliers = n_explained_multipliers + (
        2 * has_margin_sign_change[2] if len(has_margin_sign_change) > 2 else 0
    )

    def count_outside(jacobian: Array) -> tuple[Array, Array]:
        """Return the least and the largest possible number of multipliers outside the unit
        circle.
        """
        multiplier_moduli, tolerance = jnp.abs(floquet_multipliers(jacobian)), tolerances.on_circle
        return jnp.sum(multiplier_moduli > 1.0 + tolerance), jnp.sum(
            multiplier_moduli > 1.0 - tolerance
        )

    min_outside_before, max_outside_before = count_outside(jacobian_before)
    min_outside_after, max_outside_after = count_outside(jacobian_after)
    n_changed_multipliers = jnp.maximum(
        min_outside_after - max_outside_before, min_outside_before - max_outside_after
    )
    return ~crosses_other_branch & (n_changed_multipliers <= n_explained_multipliers)


class BranchJumpSuspicion(NamedTuple):
    """Suspicion that the last step of a continuation left the branch.

    The suspicion shortens the next steps.

    - `suspicious_step`: length of the first suspicious step, 0 if there is none;
    - `is_resolved`: whether no shorter step helped, so that the next step is accepted whatever its
      multipliers are.
    """

    suspicious_step: Scalar
    is_resolved: Bool[Array, ""]

    def record_trial(
        self, is_suspicious: Bool[Array, ""], trial_step: Scalar
    ) -> "BranchJumpSuspicion":
        """Return the suspicion after a trial of length `trial_step`."""
        is_first_suspicion = is_suspicious & (self.suspicious_step == 0.0)
        return self._replace(
            suspicious_step=jnp.where(is_first_suspicion, trial_step, self.suspicious_step)
        )

    def resolve(
        self, is_accepted: Bool[Array, ""], proposed_step: Scalar, min_step: float
    ) -> tuple["BranchJumpSuspicion", Scalar]:
        """Return the suspicion before the next trial, and the length of that trial's step.

        The length is `proposed_step`. If `proposed_step` is too short, the length is that of the
        first suspicious step.
        """
        is_too_short = (self.suspicious_step > 0.0) & ~self.is_resolved & (proposed_step < min_step)
        trial_step = jnp.where(is_too_short, self.suspicious_step, proposed_step)
        has_passed_suspicious_step = is_accepted & (
            self.is_resolved | (trial_step >= self.suspicious_step)
        )
        is_resolved = jnp.where(is_accepted, False, self.is_resolved | is_too_short)
        return BranchJumpSuspicion(
            jnp.where(has_passed_suspicious_step, 0.0, self.suspicious_step), is_resolved
        ), trial_step
