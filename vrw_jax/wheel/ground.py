"""Geometry of uneven ground: where the next foot lands, and the slope of the line under two feet.

Straight lines join the footholds, and both feet of a double support stand on one of them. The
slopes of the lines are given, or the heights of the footholds above a mean line. A slope between
two heights depends on the distance of the feet, and therefore on the motion.
"""

from typing import NamedTuple

import jax.numpy as jnp

from vrw_jax.base.elementwise import compute_arcsine, compute_sine_cosine
from vrw_jax.base.types import Elementwise
from vrw_jax.wheel.params import Symbols


def compute_line_slope(
    mean_slope: Elementwise, rise: Elementwise, foot_distance: Elementwise
) -> Elementwise:
    """Return the slope of the line from one foothold to the next one, rad.

    - `mean_slope`: slope of the line from which heights are measured, rad;
    - `rise`: height of the next foothold minus that of the foothold, m;
    - `foot_distance`: distance between both footholds, m.
    """
    return mean_slope - compute_arcsine(rise / foot_distance)


class GroundAhead(NamedTuple):
    """Ground ahead of a step, seen from the line under both feet of its double support.

    The reference line begins under the foot of Leg 1. It is the next line of the ground if slopes
    are given, and parallel to the mean line if heights are given.
    """

    tilt: Elementwise  # angle by which the reference line is steeper, rad
    rise: Elementwise | None = None  # height of the next foothold above it, m; None for slopes

    def compute_next_line_tilt(self, foot_distance: Elementwise) -> Elementwise:
        """Return the angle by which the next line of the ground is steeper, rad.

        - `foot_distance`: distance between the next foothold and the foot of Leg 1, m.
        """
        if self.rise is None:
            return self.tilt
        return compute_line_slope(self.tilt, self.rise, foot_distance)


def compute_foot_distance(s: Symbols, theta: Elementwise) -> Elementwise:
    """Return the distance between both feet at the touchdown with the angle theta, m."""
    return s.L0 * s.sin_alpha / compute_sine_cosine(theta)[1]


def compute_foot_distance_for_length(s: Symbols, L1: Elementwise) -> Elementwise:
    """Return the distance between the foot of Leg 1 and the foot that lands next, m."""
    return jnp.sqrt(L1 * L1 + s.L0 * s.L0 - 2.0 * s.L0 * s.cos_alpha * L1)
