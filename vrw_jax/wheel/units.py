"""Units of length, time and mass that are derived from each wheel. Numerical options use these
units.

The tolerances and time limits of a step refer to a wheel with the length, mass and gravity of Table
1 of the paper. In its own units, every wheel has the size of that wheel. Therefore no result
depends on the units of the parameters.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax

from vrw_jax.base.options import StepOptions
from vrw_jax.base.types import Elementwise
from vrw_jax.wheel.params import PARAMETER_NAMES, UNIT_POWERS, Symbols

TABLE_1_LENGTH_M = 1.0
"""Locked leg length of the wheel whose own units are those of SI. The value is chosen because the
defaults of `StepOptions` are for the wheel of Table 1 of the paper.
"""
TABLE_1_GRAVITY_M_PER_S2 = 9.81
"""Gravity of the wheel whose own units are those of SI."""
TABLE_1_MASS_KG = 18.0
"""Total mass of the wheel whose own units are those of SI."""


class WheelUnits(NamedTuple):
    """A wheel's own units of length, time and mass, in SI units and without derivatives."""

    length_unit: Any  # m
    time_unit: Any  # s
    mass_unit: Any  # kg

    def compute_unit_in_si(self, si_unit: str) -> Elementwise:
        """Return the wheel's own unit of a quantity, in SI units.

        - `si_unit`: SI unit of the quantity, such as "N s/m".
        """
        length_power, time_power, mass_power = UNIT_POWERS[si_unit]
        return (
            self.length_unit**length_power * self.time_unit**time_power * self.mass_unit**mass_power
        )

    @property
    def velocity_unit(self) -> Elementwise:
        """Return the wheel's own unit of velocity, m/s."""
        return self.length_unit / self.time_unit

    @property
    def rate_unit(self) -> Elementwise:
        """Return the wheel's own unit of angular velocity, rad/s."""
        return 1.0 / self.time_unit

    @property
    def acceleration_unit(self) -> Elementwise:
        """Return the wheel's own unit of acceleration, m/s^2."""
        return self.velocity_unit / self.time_unit

    @property
    def energy_unit(self) -> Elementwise:
        """Return the wheel's own unit of energy, J."""
        return self.mass_unit * self.velocity_unit * self.velocity_unit

    def scale_times_to_seconds(self, options: StepOptions) -> StepOptions:
        """Convert the times in step options from the wheel's own unit to seconds."""
        return eqx.tree_at(
            lambda o: (o.max_phase_time, o.dt0), options, replace_fn=lambda x: self.time_unit * x
        )


def compute_wheel_units(s: Symbols) -> WheelUnits:
    """Return a wheel's own units. For the wheel of Table 1 of the paper, they are exactly 1 m, 1 s
    and 1 kg.
    """
    length_ratio = s.L0 / TABLE_1_LENGTH_M
    gravity_ratio = s.g / TABLE_1_GRAVITY_M_PER_S2
    return lax.stop_gradient(
        WheelUnits(length_ratio, jnp.sqrt(length_ratio / gravity_ratio), s.Mt / TABLE_1_MASS_KG)
    )


def compute_wheel_units_of_rows(parameter_values_by_row: np.ndarray, n_legs: int) -> WheelUnits:
    """Return the units of many wheels, computed with NumPy. The units of an invalid wheel are 1.

    - `parameter_values_by_row`: parameters of each wheel in the order of `PARAMETER_NAMES`.
    """
    # Only these parameters are read. The sine of an invalid slope may overflow.
    values_by_name = dict(zip(PARAMETER_NAMES, np.asarray(parameter_values_by_row).T, strict=False))
    length_ratio = values_by_name["locked_length"] / TABLE_1_LENGTH_M
    gravity_ratio = values_by_name["gravity"] / TABLE_1_GRAVITY_M_PER_S2
    total_mass = values_by_name["hub_mass"] + n_legs * values_by_name["leg_mass"]
    mass_ratio = total_mass / TABLE_1_MASS_KG
    is_valid_wheel = np.isfinite(length_ratio + gravity_ratio + mass_ratio) & (
        np.minimum(length_ratio, gravity_ratio) > 0.0
    )
    valid_length_ratio, valid_gravity_ratio, valid_mass_ratio = (
        np.where(is_valid_wheel, x, 1.0) for x in (length_ratio, gravity_ratio, mass_ratio)
    )
    return WheelUnits(
        valid_length_ratio, np.sqrt(valid_length_ratio / valid_gravity_ratio), valid_mass_ratio
    )
