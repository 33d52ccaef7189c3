"""Positions of the wheel's points: hub, feet and the distances in guards.

The frame is tilted with the slope: x points downhill along the slope, and z is normal to the slope.
Angles are measured from the normal, and theta grows as the wheel rolls downhill. Leg j has the
angle theta + (j - 1) alpha. Leg 1 is the fore leg on the ground, Leg 2 is the rear leg, and leg n,
at theta - alpha, lands next. The origin is the foot of Leg 1. A posture depends on theta only
through its sine and cosine.
"""

from typing import NamedTuple

from vrw_jax.numerics import Elementwise, sine_cosine
from vrw_jax.wheel.params import Symbols


class Motion(NamedTuple):
    """Posture and rates in the coordinates (theta, L1, L2), with the foot of Leg 1 at rest."""

    sin: Elementwise  # of theta
    cos: Elementwise  # of theta
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
        """Return the motion at the angle theta (rad) with these lengths (m) and rates."""
        return cls(*sine_cosine(theta), L1, L2, dtheta, dL1, dL2)


class SineCosine(NamedTuple):
    """Sine and cosine of an angle."""

    sin: Elementwise
    cos: Elementwise


def rear_direction(s: Symbols, sin: Elementwise, cos: Elementwise) -> SineCosine:
    """Return the sine and cosine of theta + alpha, the angle of Leg 2."""
    return SineCosine(sin * s.cos_alpha + cos * s.sin_alpha, cos * s.cos_alpha - sin * s.sin_alpha)


def landing_direction(s: Symbols, sin: Elementwise, cos: Elementwise) -> SineCosine:
    """Return the sine and cosine of theta - alpha, the angle of the leg that lands next."""
    return SineCosine(sin * s.cos_alpha - cos * s.sin_alpha, cos * s.cos_alpha + sin * s.sin_alpha)


def rear_foot_height(s: Symbols, motion: Motion) -> Elementwise:
    """Return the height of foot 2 above the slope, m; negative if the foot scuffs (Section
    3.3.1).
    """
    return motion.L1 * motion.cos - motion.L2 * rear_direction(s, motion.sin, motion.cos).cos


def landing_foot_height(s: Symbols, motion: Motion) -> Elementwise:
    """Return the height of the next leg's foot above the slope, m; zero at touchdown."""
    return motion.L1 * motion.cos - s.L0 * landing_direction(s, motion.sin, motion.cos).cos


def length_at_touchdown(s: Symbols, theta: Elementwise) -> Elementwise:
    """Return the length of Leg 1 if the next foot meets the ground at the angle theta, m."""
    sin, cos = sine_cosine(theta)
    return s.L0 * landing_direction(s, sin, cos).cos / cos


class DoubleSupportCircle(NamedTuple):
    """Leg lengths, and their derivatives by theta, with the hub on its circle in double support."""

    L1: Elementwise  # m
    L2: Elementwise  # m
    G1: Elementwise  # dL1/dtheta, m/rad; the second derivative is -L1
    G2: Elementwise  # dL2/dtheta, m/rad; the second derivative is -L2


def double_support_circle(
    s: Symbols, distance: Elementwise, sin: Elementwise, cos: Elementwise
) -> DoubleSupportCircle:
    """Return the leg lengths and their derivatives with both feet planted `distance` m apart.

    The hub moves on a circle with the inscribed angle alpha (Section 2).
    """
    diameter = distance / s.sin_alpha
    rear_leg = rear_direction(s, sin, cos)
    return DoubleSupportCircle(
        diameter * rear_leg.cos, diameter * cos, -diameter * rear_leg.sin, -diameter * sin
    )
