"""A wheel's own units of length, time and mass, in which numerical options hold.

A step's tolerances and time limits are stated for a wheel of Table 1's length, mass and gravity. In
its own units every wheel has that size, so no result depends on the units of its parameters.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax

from vrw_jax.numerics import Elementwise, StepOptions
from vrw_jax.wheel.params import PARAMETER_NAMES, UNIT_POWERS, Symbols

TABLE_1_LENGTH_M = 1.0
"""Length of a locked leg of the wheel whose own units are those of SI. Chosen because the defaults
of `StepOptions` are for the wheel of Table 1."""
TABLE_1_GRAVITY_M_PER_S2 = 9.81
"""Gravity of that wheel."""
TABLE_1_MASS_KG = 18.0
"""Total mass of that wheel."""


class OwnUnits(NamedTuple):
    """A wheel's own units, as numbers in SI. They have no derivatives."""

    length: Any  # m
    time: Any  # s
    mass: Any  # kg

    def si_value(self, unit: str) -> Elementwise:
        """Return the own unit that corresponds to an SI unit, such as "N s/m", in SI."""
        length, time, mass = UNIT_POWERS[unit]
        return self.length**length * self.time**time * self.mass**mass

    @property
    def speed(self) -> Elementwise:
        return self.length / self.time

    @property
    def rate(self) -> Elementwise:
        """Unit of an angular velocity, rad/s."""
        return 1.0 / self.time

    @property
    def energy(self) -> Elementwise:
        return self.mass * self.speed * self.speed

    def scale_times(self, options: StepOptions) -> StepOptions:
        """Return the options with their times, stated in own units, in seconds."""
        times = lambda o: (o.max_phase_time, o.dt0)
        return eqx.tree_at(times, options, tuple(self.time * x for x in times(options)))


def compute_own_units(s: Symbols) -> OwnUnits:
    """Return the wheel's own units: 1 m, 1 s and 1 kg for Table 1's wheel, to the last bit."""
    length, gravity = s.L0 / TABLE_1_LENGTH_M, s.g / TABLE_1_GRAVITY_M_PER_S2
    return lax.stop_gradient(OwnUnits(length, jnp.sqrt(length / gravity), s.Mt / TABLE_1_MASS_KG))


def compute_own_units_of_rows(rows: np.ndarray, n_legs: int) -> OwnUnits:
    """Return `compute_own_units` of many wheels by numpy; units are 1 for an invalid wheel.

    - `rows`: parameters of each wheel in the order of `PARAMETER_NAMES`.
    """
    value = dict(zip(PARAMETER_NAMES, np.asarray(rows).T, strict=False))
    length = value["locked_length"] / TABLE_1_LENGTH_M
    gravity = value["gravity"] / TABLE_1_GRAVITY_M_PER_S2
    mass = (value["hub_mass"] + n_legs * value["leg_mass"]) / TABLE_1_MASS_KG
    is_valid = np.isfinite(length + gravity + mass) & (np.minimum(length, gravity) > 0.0)
    length, gravity, mass = (np.where(is_valid, x, 1.0) for x in (length, gravity, mass))
    return OwnUnits(length, np.sqrt(length / gravity), mass)
