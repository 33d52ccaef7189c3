"""Units of length, time and mass of a wheel, in which numerical options hold.

The tolerances and time limits of a step are stated for a wheel of Table 1's length, mass and
gravity. In its units every wheel has the size of Table 1's wheel. So no result depends on the units
of the parameters.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax

from vrw_jax.numerics import Elementwise, StepOptions
from vrw_jax.wheel.params import (
    PARAMETER_DOMAINS,
    PARAMETER_NAMES,
    UNIT_POWERS,
    Symbols,
    WheelParams,
)

TABLE_1_LENGTH_M = 1.0
"""Length of a locked leg of the wheel whose units are those of SI, chosen because the defaults of
`StepOptions` are for the wheel of Table 1."""
TABLE_1_GRAVITY_M_PER_S2 = 9.81
"""Gravity of the wheel whose units are those of SI."""
TABLE_1_MASS_KG = 18.0
"""Total mass of the wheel whose units are those of SI."""


class WheelUnits(NamedTuple):
    """Units of length, time and mass of a wheel, as numbers in SI. They have no derivatives."""

    length: Any  # m
    time: Any  # s
    mass: Any  # kg

    def si_value(self, unit: str) -> Elementwise:
        """Return the wheel's unit for an SI unit such as "N s/m", as a number in SI."""
        length, time, mass = UNIT_POWERS[unit]
        return self.length**length * self.time**time * self.mass**mass

    @property
    def velocity(self) -> Elementwise:
        """Return the unit of a velocity, m/s."""
        return self.length / self.time

    @property
    def rate(self) -> Elementwise:
        """Return the unit of an angular velocity, rad/s."""
        return 1.0 / self.time

    @property
    def acceleration(self) -> Elementwise:
        """Return the unit of an acceleration, m/s^2."""
        return self.velocity / self.time

    @property
    def energy(self) -> Elementwise:
        """Return the unit of an energy, J."""
        return self.mass * self.velocity * self.velocity

    def scale_times(self, options: StepOptions) -> StepOptions:
        """Return the options with times in seconds, from options with times in the wheel's unit."""
        select_times = lambda o: (o.max_phase_time, o.dt0)
        return eqx.tree_at(
            select_times, options, tuple(self.time * x for x in select_times(options))
        )


def compute_wheel_units(s: Symbols) -> WheelUnits:
    """Return the units of a wheel: 1 m, 1 s and 1 kg for Table 1's wheel, to the last bit."""
    length, gravity = s.L0 / TABLE_1_LENGTH_M, s.g / TABLE_1_GRAVITY_M_PER_S2
    return lax.stop_gradient(WheelUnits(length, jnp.sqrt(length / gravity), s.Mt / TABLE_1_MASS_KG))


def convert_to_wheel_units(params: WheelParams) -> WheelParams:
    """Return the similar wheel of Table 1's length, gravity and mass: `params` in its own units."""
    units = compute_wheel_units(params.symbols())
    return WheelParams(
        **{
            name: getattr(params, name) / units.si_value(domain.unit)
            for name, domain in PARAMETER_DOMAINS.items()
        },
        n_legs=params.n_legs,
    )


def compute_wheel_units_of_rows(parameter_rows: np.ndarray, n_legs: int) -> WheelUnits:
    """Return `compute_wheel_units` of many wheels by numpy; the units of an invalid wheel are 1.

    - `parameter_rows`: parameters of each wheel in the order of `PARAMETER_NAMES`.
    """
    values_by_name = dict(zip(PARAMETER_NAMES, np.asarray(parameter_rows).T, strict=False))
    length = values_by_name["locked_length"] / TABLE_1_LENGTH_M
    gravity = values_by_name["gravity"] / TABLE_1_GRAVITY_M_PER_S2
    mass = (values_by_name["hub_mass"] + n_legs * values_by_name["leg_mass"]) / TABLE_1_MASS_KG
    is_valid = np.isfinite(length + gravity + mass) & (np.minimum(length, gravity) > 0.0)
    length, gravity, mass = (np.where(is_valid, x, 1.0) for x in (length, gravity, mass))
    return WheelUnits(length, np.sqrt(length / gravity), mass)
