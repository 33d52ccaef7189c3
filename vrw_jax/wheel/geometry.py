"""Positions of the hub and the feet, and the distances that guards evaluate.

The frame is tilted with the slope: x points downhill along the slope, and z is normal to the slope.
Angles are measured from the normal, and theta increases as the wheel rolls downhill. Leg j has the
angle theta + (j - 1) alpha. Leg 1 is the fore leg on the ground, Leg 2 is the rear leg, and leg n,
at theta - alpha, lands next. The origin is the foot of Leg 1. A posture depends on theta only
through sin(theta) and cos(theta).
"""

from typing import NamedTuple

from vrw_jax.base.elementwise import compute_sine_cosine
from vrw_jax.base.types import Elementwise, Vector
from vrw_jax.wheel.params import Symbols


class Motion(NamedTuple):
    """Posture and rates of change of (theta, L1, L2), with the foot of Leg 1 at rest."""

    sin_theta: Elementwise  # sine of theta
    cos_theta: Elementwise  # cosine of theta
    L1: Elementwise  # m
    L2: Elementwise  # m
    dtheta: Elementwise  # rad/s
    dL1: Elementwise  # m/s
    dL2: Elementwise  # m/s

    @classmethod
    def from_angle(
        cls,
        theta: Elementwise,
        L1: Elementwise,
        L2: Elementwise,
        dtheta: Elementwise,
        dL1: Elementwise,
        dL2: Elementwise,
    ) -> "Motion":
        """Return the motion for the angle theta (rad), the leg lengths (m), and their rates."""
        return cls(*compute_sine_cosine(theta), L1, L2, dtheta, dL1, dL2)

    @property
    def lengths_and_rates(self) -> Vector:
        """Return the leg lengths, and the rates of (theta, L1, L2)."""
        return self[2:]


class SineCosine(NamedTuple):
    """Sine and cosine of one angle."""

    sin: Elementwise
    cos: Elementwise


def rotate_to_rear_leg(s: Symbols, sin_theta: Elementwise, cos_theta: Elementwise) -> SineCosine:
    """Return the sine and cosine of theta + alpha, the angle of Leg 2."""
    return SineCosine(
        sin_theta * s.cos_alpha + cos_theta * s.sin_alpha,
        cos_theta * s.cos_alpha - sin_theta * s.sin_alpha,
    )


def rotate_to_landing_leg(s: Symbols, sin_theta: Elementwise, cos_theta: Elementwise) -> SineCosine:
    """Return the sine and cosine of theta - alpha, the angle of the leg that lands next."""
    return SineCosine(
        sin_theta * s.cos_alpha - cos_theta * s.sin_alpha,
        cos_theta * s.cos_alpha + sin_theta * s.sin_alpha,
    )


def rotate_to_vertical(s: Symbols, sin_angle: Elementwise, cos_angle: Elementwise) -> SineCosine:
    """Return the sine and cosine of an angle plus phi, which is the angle from the vertical."""
    return SineCosine(
        sin_angle * s.cos_phi + cos_angle * s.sin_phi,
        cos_angle * s.cos_phi - sin_angle * s.sin_phi,
    )


def compute_rear_foot_height(s: Symbols, motion: Motion) -> Elementwise:
    """Return the height of foot 2 above the slope, m.

    The height is negative if the foot scuffs (Section 3.3.1 of the paper).
    """
    return (
        motion.L1 * motion.cos_theta
        - motion.L2 * rotate_to_rear_leg(s, motion.sin_theta, motion.cos_theta).cos
    )


def compute_landing_foot_height(s: Symbols, motion: Motion) -> Elementwise:
    """Return the height above the slope of the foot that lands next, m. It is 0 at touchdown."""
    return (
        motion.L1 * motion.cos_theta
        - s.L0 * rotate_to_landing_leg(s, motion.sin_theta, motion.cos_theta).cos
    )


def compute_length_at_touchdown(s: Symbols, theta: Elementwise) -> Elementwise:
    """Return the length of Leg 1 at which the next foot meets the ground at the angle theta, m."""
    sin_theta, cos_theta = compute_sine_cosine(theta)
    return s.L0 * rotate_to_landing_leg(s, sin_theta, cos_theta).cos / cos_theta


class DoubleSupportCircle(NamedTuple):
    """Leg lengths and their derivatives with respect to theta, for a hub on its circle."""

    L1: Elementwise  # m
    L2: Elementwise  # m
    dL1_dtheta: Elementwise  # dL1/dtheta, m/rad; the second derivative is -L1
    dL2_dtheta: Elementwise  # dL2/dtheta, m/rad; the second derivative is -L2


def compute_double_support_circle(
    s: Symbols, foot_distance: Elementwise, sin_theta: Elementwise, cos_theta: Elementwise
) -> DoubleSupportCircle:
    """Return the leg lengths and their derivatives in double support.

    The distance between the feet is `foot_distance`, m. The hub moves on a circle with the
    inscribed angle alpha (Section 2 of the paper).
    """
    hub_circle_diameter = foot_distance / s.sin_alpha
    rear_leg = rotate_to_rear_leg(s, sin_theta, cos_theta)
    return DoubleSupportCircle(
        hub_circle_diameter * rear_leg.cos,
        hub_circle_diameter * cos_theta,
        -hub_circle_diameter * rear_leg.sin,
        -hub_circle_diameter * sin_theta,
    )
