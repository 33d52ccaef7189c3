"""Section states: their types, validity and the default start."""

import functools
import operator
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from vrw_jax.wheel import MAX_SI_VALUE, WheelParams

SectionState = Float[Array, "3"]
"""(theta-, dtheta-, dL1-) just before touchdown, in the leg labels of the ending step: rad, rad/s,
m/s. The length of Leg 1 follows from the touchdown condition; Leg 2 is on its stopper."""
AnySectionState = Float[Array, "section ..."]
"""A `SectionState`, or the longer one of another model; in a batch, elements are on the last
axis."""
PAPER_START = (0.1, 1.6, -0.1)
"""A start near the gait of Table 1, inside its basin: rad, rad/s, m/s."""


StateValues = Float[Array, "section ..."] | tuple[Array, ...]
"""A section state, or its entries one by one, each of which may be an array over a batch."""


def is_valid_start(params: WheelParams, x: StateValues) -> Array:
    """Return whether parameters and start are finite, in their domains and rolling forward."""
    theta, dtheta = x[0], x[1]
    is_upright = (jnp.abs(theta) < 0.5 * jnp.pi) & (
        jnp.abs(theta - params.leg_angle) < 0.5 * jnp.pi
    )
    is_bounded = functools.reduce(operator.and_, [jnp.abs(value) < MAX_SI_VALUE for value in x])
    return params.is_in_domain() & is_bounded & is_upright & (dtheta > 0.0)  # False for NaN


def replace_invalid(
    is_valid: Array,
    params: WheelParams,
    x: StateValues,
    fallback_x: Any,
) -> tuple[WheelParams, Any]:
    """Return Table 1 and a safe start in place of invalid input, so that no NaN is ever
    computed.
    """
    return jax.tree.map(
        lambda value, default: jnp.where(is_valid, value, jnp.asarray(default, value.dtype)),
        (params, x),
        (type(params)(n_legs=params.n_legs), fallback_x),
    )
