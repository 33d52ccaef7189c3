"""The lowest rung whose premises hold: the paper's wheel where it may, real ground where it must.

The rigid wheel is never chosen: its premise, legs that do not yield, fails for every finite
stiffness.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from vrw_jax.models import AbstractWheel, UnilateralWheel, ViscoelasticWheel
from vrw_jax.models.base import SectionState
from vrw_jax.options import Options
from vrw_jax.outcomes import Outcome
from vrw_jax.params import Scalar, WheelParams, as_float_array
from vrw_jax.return_map import SectionLike, checked

PREMISES: dict[str, str] = {
    "fore_foot_force": "the ground would have to pull on the fore foot",
    "clearance_sls1": "the rear foot scuffs in single support I",
    "clearance_sls2": "the rear foot scuffs in single support II",
    "contraction": "the fore leg would pass its stopper",
    "friction_fore": "the fore foot would slide",
    "friction_rear": "the rear foot would slide just after landing",
    "landing_friction_fore": "the fore foot would slide in the landing impulse",
    "landing_friction_rear": "the rear foot would slide in the landing impulse",
}
"""Premises that the paper's rung needs and the unilateral rung does not, with what breaks them."""

VISCOELASTIC, UNILATERAL = 1, 2
"""Numbers of the rungs; 0 is the rigid one."""


class ModelChoice(eqx.Module):
    """Which rung serves, and why. Batched under vmap: every field gains the axis.

    `reason` is 0 where the paper's rung serves, 1 + the place in PREMISES of the first premise that
    breaks, and minus the paper's outcome where that rung's step does not reach a touchdown.
    """

    rung: Int[Array, ""]  # VISCOELASTIC or UNILATERAL
    reason: Int[Array, ""]
    margins: Float[Array, " n_premises"]  # of PREMISES, negative where broken
    friction: Scalar

    @property
    def model(self) -> AbstractWheel:
        """The rung itself, for one wheel."""
        if int(self.rung) == VISCOELASTIC:
            return ViscoelasticWheel(friction=float(self.friction))
        return UnilateralWheel(friction=self.friction)

    @property
    def why(self) -> str:
        """One sentence, for one wheel."""
        reason = int(self.reason)
        if reason == 0:
            return "The paper's wheel serves: all its premises hold over this step."
        if reason < 0:
            return f"The paper's wheel can't step: {Outcome(-reason).meaning}"
        return f"The paper's premises break: {list(PREMISES.values())[reason - 1]}."


def choose_model(
    params: WheelParams,
    start: SectionLike,
    *,
    friction: float | Array = 0.7,
    options: Options | None = None,
) -> ModelChoice:
    """The lowest rung whose premises hold over one step from `start`, on ground of `friction`.

    `start` is the paper's section state (theta-, dtheta-, dL1-). Maps over lanes by `jax.vmap`.
    """
    model = ViscoelasticWheel(friction=0.0)
    params, x, _, options = checked(params, start, model, options)
    ground = as_float_array(friction).astype(x.dtype)
    return _chosen(model, params, x, ground, options)


@eqx.filter_jit
def _chosen(
    model: ViscoelasticWheel, params: WheelParams, x: SectionState, ground: Array, options: Options
) -> ModelChoice:
    result = model.step(params, x, options)
    margins = jnp.stack(
        [
            getattr(result.monitors, name) + (ground if "friction" in name else 0.0)
            for name in PREMISES
        ]
    )
    broken = margins < 0.0
    stepped = result.outcome == Outcome.STEPPED
    first = 1 + jnp.argmax(broken)
    reason = jnp.where(stepped, jnp.where(jnp.any(broken), first, 0), -result.outcome)
    return ModelChoice(
        rung=jnp.where(reason == 0, VISCOELASTIC, UNILATERAL).astype(jnp.int32),
        reason=reason.astype(jnp.int32),
        margins=margins,
        friction=ground,
    )
