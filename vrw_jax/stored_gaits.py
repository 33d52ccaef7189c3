"""Gaits of Table 1's wheel at several dampings, as starts of a search; in units of length and time.

Lengths are in L0, times in sqrt(L0 / g), masses in the total mass, so that a wheel of any size finds
its start here. Made by tests/make_stored_gaits.py.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from vrw_jax.params import PARAMETER_NAMES, Elementwise, WheelParams


def coordinates(params: WheelParams) -> tuple[Elementwise, ...]:
    """Where a wheel stands among others: damping, stiffness, natural length, slope, unitless."""
    mass = params.hub_mass + params.n_legs * params.leg_mass
    length, gravity = params.locked_length, params.gravity
    pace = jnp.sqrt(length / gravity)
    return (
        params.damping * pace / mass,
        params.stiffness * length / (mass * gravity),
        params.natural_length / length,
        params.slope,
    )


SPREAD = (1.0, 0.4, 0.01, 0.03)
"""Distances in `coordinates` that change a gait about as much as each other."""

TABLE = np.array(
    [
        # c, k, L*, slope; theta+, dtheta+, durations of DLS, SLS-I, SLS-II
        [
            3.547454, 2.831578, 1.02, 0.30,
            -0.682671, 0.334985, 1.360207, 1.043027, 0.155821,
        ],
    ]
)  # fmt: skip


def parameters_of_table(dtype: object) -> Array:
    """Parameters of the wheel that the table's first gait belongs to."""
    params = WheelParams()
    return jnp.stack([getattr(params, name) for name in PARAMETER_NAMES]).astype(dtype)
