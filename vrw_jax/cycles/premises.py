"""Premises of the paper's rung as smooth functions of a gait, for whoever searches along them.

The margins of a step are minima over time. Two of them are no use to a search near their border:
foot 2 always starts single support I at height zero, so its clearance is its lowest *later* height,
which vanishes with the cube of the distance to the border on one side and jumps on the other. What
decides is whether the foot leaves the ground upwards: `takeoff_acceleration`, smooth throughout.
"""

from collections.abc import Mapping

import jax
import jax.numpy as jnp
from jaxtyping import Array

from vrw_jax.numerics import Passage, Scalar
from vrw_jax.results import MEASURES
from vrw_jax.wheel import Motion, Symbols, WheelParams, dynamics, rear_foot_height


def takeoff_acceleration(s: Symbols, sls1: Passage) -> Scalar:
    """Normal acceleration of foot 2 at the start of SLS-I, m/s^2, for one wheel.

    The foot is at rest on the ground there, so its sign says whether it rises or scuffs; the jump
    from zero is the tangential force that the ground no longer gives.
    """
    q, v = jnp.stack(sls1.start.q), jnp.stack(sls1.start.v)
    a = jnp.stack(dynamics.single_support_1_acceleration(s, Motion.of(*q, *v)))

    def height(time: Array) -> Array:
        return rear_foot_height(s, Motion.of(*(q + time * (v + 0.5 * time * a)), *v))

    return jax.jacfwd(jax.jacfwd(height))(jnp.zeros_like(q[0]))


PREMISES: tuple[str, ...] = (
    "fore_foot_force",
    "takeoff_acceleration",
    "clearance_sls1",
    "clearance_sls2",
    "locked_stopper_force",
    "rear_stopper_force",
    "contraction",
    "friction_fore",
    "lambda_I4",
    "lambda_2_plus",
    "lambda_4_plus",
)
"""Premises on forces, clearances and indicators that gaits of this rung can keep."""

SHARE = 1e-3
"""Default margin of a premise, as a share of the wheel's weight, leg length or gravity."""


def default_margins(params: WheelParams) -> Mapping[str, float]:
    """Least values of `PREMISES`: a thousandth of what their unit measures on this wheel.

    Not zero: at lambda_4_plus = 0, for one, the gait itself ends, and a search needs room.

    Args:
        params: the wheel, one.

    Returns:
        Measures by name, each with its least value in its unit.

    Raises:
        TypeError, ValueError: an argument that can't be meant, in one sentence.

    Examples:
        >>> round(vrw.default_margins(vrw.WheelParams())["lambda_4_plus"], 3)
        0.177
    """
    mass = float(params.hub_mass + params.n_legs * params.leg_mass)
    length, gravity = float(params.locked_length), float(params.gravity)
    natural = {
        "N": mass * gravity,
        "m": length,
        "m/s^2": gravity,
        "N s": mass * (gravity * length) ** 0.5,
        "1": 1.0,
    }
    return {name: SHARE * natural[MEASURES[name].unit] for name in PREMISES}
