"""The lowest rung whose premises hold: the paper's wheel where it may, else real ground."""

from jaxtyping import Array

from vrw_jax.models import LadderWheel, ModelChoice
from vrw_jax.numerics import Options
from vrw_jax.walks.stepping import SectionLike, checked
from vrw_jax.wheel import WheelParams


def choose_model(
    params: WheelParams,
    start: SectionLike,
    *,
    friction: float | Array = 0.7,
    options: Options | None = None,
) -> ModelChoice:
    """The lowest rung whose premises hold over one step from `start`, on ground of `friction`.

    `start` is the paper's section state (theta-, dtheta-, dL1-) or the full one of the unilateral
    rung. Maps over lanes by `jax.vmap`.
    """
    model = LadderWheel(friction=friction)
    params, x, _, options = checked(params, start, model, options)
    return model.choose(params, x, options)[0]
