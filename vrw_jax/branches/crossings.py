"""Test by Floquet multipliers whether two neighboring points belong to the same branch.

A continuation step may pass several special points, or may end on a nearby branch. Each of these
events changes the number of multipliers outside the unit circle, or the sign of the determinant of
Newton's equations. On a single branch the sign of the determinant changes only at branch points.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from vrw_jax.base.types import Scalar
from vrw_jax.gaits.floquet import (
    MAX_CLOSED_FORM_SIZE,
    UNIT_CIRCLE_DISTANCE,
    compute_bifurcation_margins,
    floquet_multipliers,
)


def is_multiplier_change_explained(
    previous_point_jacobian: Float[Array, "n n"],
    next_point_jacobian: Float[Array, "n n"],
    has_parameter_turned_back: Bool[Array, ""],
) -> Bool[Array, ""]:
    """Return whether bifurcations explain the change of the multipliers between two points.

    `previous_point_jacobian` and `next_point_jacobian` are the Jacobians of the return map at the
    two points. `has_parameter_turned_back` is whether the parameter changes its direction between
    the points.
    """
    previous_point_margins, next_point_margins = map(
        compute_bifurcation_margins, (previous_point_jacobian, next_point_jacobian)
    )
    has_margin_sign_change = previous_point_margins * next_point_margins < 0.0
    has_crossed_other_branch = has_margin_sign_change[0] != has_parameter_turned_back
    if previous_point_jacobian.shape[-1] > MAX_CLOSED_FORM_SIZE and jax.default_backend() != "cpu":
        return (
            ~has_crossed_other_branch
        )  # JAX computes eigenvalues of larger matrices only on CPUs.
    # A Neimark-Sacker bifurcation explains two multipliers.
    n_explained_multipliers = jnp.sum(has_margin_sign_change) + jnp.sum(has_margin_sign_change[2:])

    def count_unstable_multipliers(return_map_jacobian: Array) -> tuple[Array, Array]:
        """Return the least and the largest possible number of multipliers outside the
        unit circle.
        """
        multiplier_moduli = jnp.abs(floquet_multipliers(return_map_jacobian))
        tolerance = UNIT_CIRCLE_DISTANCE
        return jnp.sum(multiplier_moduli > 1.0 + tolerance), jnp.sum(
            multiplier_moduli > 1.0 - tolerance
        )

    min_n_unstable_at_previous, max_n_unstable_at_previous = count_unstable_multipliers(
        previous_point_jacobian
    )
    min_n_unstable_at_next, max_n_unstable_at_next = count_unstable_multipliers(next_point_jacobian)
    n_changed_multipliers = jnp.maximum(
        min_n_unstable_at_next - max_n_unstable_at_previous,
        min_n_unstable_at_previous - max_n_unstable_at_next,
    )
    return ~has_crossed_other_branch & (n_changed_multipliers <= n_explained_multipliers)


class BranchJumpSuspicion(NamedTuple):
    """Suspicion that the last continuation step reached another branch.

    A suspicion shortens the next continuation steps.

    - `suspicious_ds`: length of the first suspicious continuation step; 0 if no step is suspicious;
    - `accepts_any_multipliers`: whether the next continuation step is accepted with any
      multipliers, because shorter steps did not help.
    """

    suspicious_ds: Scalar
    accepts_any_multipliers: Bool[Array, ""]

    def update_after_trial(
        self,
        is_trial_suspicious: Bool[Array, ""],
        is_trial_accepted: Bool[Array, ""],
        trial_ds: Scalar,
        proposed_ds: Scalar,
        min_ds: float,
    ) -> tuple["BranchJumpSuspicion", Scalar]:
        """Return the suspicion after a trial, and the length of the next continuation step.

        `trial_ds` is the length of the continuation step of the trial. The next length is
        `proposed_ds`, or `suspicious_ds` if `proposed_ds` is below `min_ds`.
        """
        is_first_suspicion = is_trial_suspicious & (self.suspicious_ds == 0.0)
        suspicious_ds = jnp.where(is_first_suspicion, trial_ds, self.suspicious_ds)
        is_below_min_ds = (
            (suspicious_ds > 0.0) & ~self.accepts_any_multipliers & (proposed_ds < min_ds)
        )
        next_ds = jnp.where(is_below_min_ds, suspicious_ds, proposed_ds)
        has_passed_suspicious_ds = is_trial_accepted & (
            self.accepts_any_multipliers | (next_ds >= suspicious_ds)
        )
        accepts_any_multipliers = jnp.where(
            is_trial_accepted, False, self.accepts_any_multipliers | is_below_min_ds
        )
        return BranchJumpSuspicion(
            jnp.where(has_passed_suspicious_ds, 0.0, suspicious_ds), accepts_any_multipliers
        ), next_ds
