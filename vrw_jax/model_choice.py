"""The lowest rung whose premises hold: the paper's wheel where it may, else real ground."""

from jaxtyping import Array

from vrw_jax.models.ladder import LadderWheel, ModelChoice
from vrw_jax.options import Options
from vrw_jax.params import WheelParams, as_float_array
from vrw_jax.return_map import SectionLike, checked


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
    model = LadderWheel(friction=as_float_array(friction))
    params, x, _, options = checked(params, start, model, options)
    return model.choose(params, x, options)[0]
