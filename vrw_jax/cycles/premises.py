"""Premises of the paper's rung that whoever searches along gaits keeps, and with what margin."""

from collections.abc import Mapping

from vrw_jax.numerics import Elementwise, Passage
from vrw_jax.results import MEASURES
from vrw_jax.wheel import Motion, Symbols, WheelParams, dynamics
from vrw_jax.wording import instance


def takeoff_acceleration(s: Symbols, sls1: Passage) -> Elementwise:
    """That of a gait, see `dynamics`, at the start of its passage through SLS-I."""
    return dynamics.takeoff_acceleration(s, Motion.of(*sls1.start.q, *sls1.start.v))


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
    instance("params", params, WheelParams, "write vrw.WheelParams(damping=..., slope=...)")
    params.require_one("take one after the other")
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
