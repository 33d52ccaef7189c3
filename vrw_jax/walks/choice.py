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

    Args:
        params: the wheel.
        start: section state, shape (3,), or the ground's own.
        friction: coefficient of the ground.
        options: numerical choices of the steps.

    Returns:
        A `ModelChoice`: `rung`, `why`, and the `model` to go on with.

    Raises:
        TypeError, ValueError: an argument that can't be meant, in one sentence.

    Examples:
        >>> choice = vrw.choose_model(vrw.WheelParams(), vrw.paper_start(), friction=0.7)
        >>> type(choice.model).__name__
        'UnilateralWheel'
    """
    model = LadderWheel(friction=friction)
    params, x, _, options = checked(params, start, model, options)
    return model.choose(params, x, options)[0]
