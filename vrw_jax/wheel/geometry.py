"""Where the wheel's points are: hub, feet and guards' distances, in the slope's frame.

The frame is tilted with the slope: x downhill along it, z normal to it, angles from the normal,
theta growing as the wheel rolls downhill. Leg j stands at theta + (j - 1) alpha; Leg 1 is the fore
leg on the ground, Leg 2 the rear leg, and leg n (at theta - alpha) lands next. The origin is the
foot of Leg 1. A posture never needs theta itself, only its sine and cosine.
"""

from typing import NamedTuple

from vrw_jax.numerics import Elementwise, sine_cosine
from vrw_jax.wheel.params import Symbols


class Motion(NamedTuple):
    """Posture and rates with Leg 1's foot at rest: the three coordinates (theta, L1, L2)."""

    sin: Elementwise  # of theta
    cos: Elementwise  # of theta
    L1: Elementwise  # m
    L2: Elementwise  # m
    dtheta: Elementwise  # rad/s
    dL1: Elementwise  # m/s
    dL2: Elementwise  # m/s

    @classmethod
    def of(
        cls,
        theta: Elementwise,
        L1: Elementwise,
        L2: Elementwise,
        dtheta: Elementwise,
        dL1: Elementwise,
        dL2: Elementwise,
    ) -> "Motion":
        """From the angle theta, rad, lengths, m, and rates."""
        return cls(*sine_cosine(theta), L1, L2, dtheta, dL1, dL2)


class Trig(NamedTuple):
    sin: Elementwise
    cos: Elementwise


def rear_direction(s: Symbols, sin: Elementwise, cos: Elementwise) -> Trig:
    """Sine and cosine of theta + alpha, Leg 2."""
    return Trig(sin * s.cos_alpha + cos * s.sin_alpha, cos * s.cos_alpha - sin * s.sin_alpha)


def landing_direction(s: Symbols, sin: Elementwise, cos: Elementwise) -> Trig:
    """Sine and cosine of theta - alpha, the leg that lands next."""
    return Trig(sin * s.cos_alpha - cos * s.sin_alpha, cos * s.cos_alpha + sin * s.sin_alpha)


def rear_foot_height(s: Symbols, motion: Motion) -> Elementwise:
    """Height of Leg 2's foot above the slope, m; negative when it scuffs. Section 3.3.1."""
    return motion.L1 * motion.cos - motion.L2 * rear_direction(s, motion.sin, motion.cos).cos


def landing_foot_height(s: Symbols, motion: Motion) -> Elementwise:
    """Height of the next leg's foot above the slope, m; zero at touchdown."""
    return motion.L1 * motion.cos - s.L0 * landing_direction(s, motion.sin, motion.cos).cos


def length_at_touchdown(s: Symbols, theta: Elementwise) -> Elementwise:
    """Length of Leg 1 when the next foot meets the ground at angle theta, m."""
    sin, cos = sine_cosine(theta)
    return s.L0 * landing_direction(s, sin, cos).cos / cos


class CircleOfDoubleSupport(NamedTuple):
    """Both leg lengths on the hub's circle in double support and their slopes over theta."""

    L1: Elementwise  # m
    L2: Elementwise  # m
    G1: Elementwise  # dL1/dtheta, m/rad; the second derivative is -L1
    G2: Elementwise  # dL2/dtheta, m/rad; the second derivative is -L2


def double_support_circle(
    s: Symbols, distance: Elementwise, sin: Elementwise, cos: Elementwise
) -> CircleOfDoubleSupport:
    """Leg lengths with both feet planted `distance` apart (inscribed angle alpha, Section 2)."""
    scale = distance / s.sin_alpha
    rear = rear_direction(s, sin, cos)
    return CircleOfDoubleSupport(scale * rear.cos, scale * cos, -scale * rear.sin, -scale * sin)
