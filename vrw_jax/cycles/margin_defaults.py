"""Margins that searches along gaits of the paper's model keep positive, with default least
values.
"""

from collections.abc import Mapping

from vrw_jax.collocation import PhasePoints
from vrw_jax.measures import MEASURES
from vrw_jax.numerics import Elementwise
from vrw_jax.runtime import with_default_jax_settings
from vrw_jax.validation import check_type
from vrw_jax.wheel import Motion, Symbols, WheelParams, dynamics


def compute_takeoff_acceleration(s: Symbols, sls1: PhasePoints) -> Elementwise:
    """Return the rear foot's acceleration at the start of SLS-I of a gait, m/s^2.

    See `dynamics.takeoff_acceleration`.
    """
    return dynamics.compute_takeoff_acceleration(s, Motion.from_angle(*sls1.start.q, *sls1.start.v))


KEPT_MARGIN_NAMES: tuple[str, ...] = (
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
"""Names of the margins on forces, clearances and indicators that gaits of the paper's model can
keep."""

DEFAULT_MARGIN_SHARE = 1e-3
"""Default least value of a margin, as a fraction of the wheel's weight, leg length or gravity."""


@with_default_jax_settings
def default_margins(params: WheelParams) -> Mapping[str, float]:
    """Return least values of `KEPT_MARGIN_NAMES`: a thousandth of each unit's natural scale on this
    wheel.

    The values are not zero because a search needs a distance from the limits. At lambda_4_plus = 0,
    for example, the gait itself ends.

    Args:
        params: one wheel.

    Returns:
        Least values by name of the measure, each in the measure's unit.

    Raises:
        TypeError, ValueError: if an argument is invalid; the message names the remedy.

    Examples:
        >>> round(vrw.default_margins(vrw.WheelParams())["lambda_4_plus"], 3)
        0.177
    """
    check_type("params", params, WheelParams, "write vrw.WheelParams(damping=..., slope=...)")
    params.require_single_wheel("take one after the other")
    mass = float(params.hub_mass + params.n_legs * params.leg_mass)
    length, gravity = float(params.locked_length), float(params.gravity)
    unit_scales = {
        "N": mass * gravity,
        "m": length,
        "m/s^2": gravity,
        "N s": mass * (gravity * length) ** 0.5,
        "1": 1.0,
    }
    return {
        name: DEFAULT_MARGIN_SHARE * unit_scales[MEASURES[name].unit] for name in KEPT_MARGIN_NAMES
    }
