"""Define the margins that searches for gaits of the paper's model keep positive, and
their limits.
"""

from collections.abc import Mapping

from vrw_jax.base.checks import check_type
from vrw_jax.base.types import Elementwise
from vrw_jax.gaits.phase_collocation import PhasePoints
from vrw_jax.lanes.settings import with_default_jax_settings
from vrw_jax.models.measures import MEASURES
from vrw_jax.wheel import dynamics
from vrw_jax.wheel.dynamics import Motion
from vrw_jax.wheel.params import Symbols, WheelParams


def compute_takeoff_acceleration(s: Symbols, sls1_points: PhasePoints) -> Elementwise:
    """Return the acceleration of the rear foot at the start of SLS-I, m/s^2.

    See `dynamics.compute_takeoff_acceleration`.
    """
    return dynamics.compute_takeoff_acceleration(
        s, Motion.from_angle(*sls1_points.phase_start_point.q, *sls1_points.phase_start_point.v)
    )


DEFAULT_MARGIN_NAMES: tuple[str, ...] = (
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
"""Names of the margins (forces, clearances and indicators) that a search can keep positive."""

DEFAULT_MARGIN_SHARE = 1e-3
"""Default lower limit of a margin, as a fraction of the wheel's weight, leg length or gravity."""


@with_default_jax_settings
def default_margins(params: WheelParams) -> Mapping[str, float]:
    """Return the default lower limit for each margin in `DEFAULT_MARGIN_NAMES`.

    Each limit is a thousandth of the margin's natural scale for this wheel. The limits are above
    zero, because a search needs a distance from the boundary. At lambda_4_plus = 0, for example,
    the branch of gaits ends.

    Args:
        params: one wheel.

    Returns:
        Lower limits by the name of the margin, each in the unit of the margin.

    Raises:
        TypeError, ValueError: if an argument is invalid; the message names the remedy.

    Examples:
        >>> round(vrw.default_margins(vrw.WheelParams())["lambda_4_plus"], 3)
        0.177
    """
    check_type("params", params, WheelParams, "write vrw.WheelParams(damping=..., slope=...)")
    params.require_single_wheel("take one after the other")
    total_mass = float(params.hub_mass + params.n_legs * params.leg_mass)
    leg_length = float(params.locked_length)
    gravity_acceleration = float(params.gravity)
    margin_unit_values = {
        "N": total_mass * gravity_acceleration,
        "m": leg_length,
        "m/s^2": gravity_acceleration,
        "N s": total_mass * (gravity_acceleration * leg_length) ** 0.5,
        "1": 1.0,
    }
    return {
        margin_name: DEFAULT_MARGIN_SHARE * margin_unit_values[MEASURES[margin_name].unit]
        for margin_name in DEFAULT_MARGIN_NAMES
    }
