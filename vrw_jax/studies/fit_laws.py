"""Laws of the force along a leg that fits compare with the paper's spring and damper."""

from __future__ import annotations

import math
from typing import Any

import equinox as eqx
import jax.numpy as jnp

from vrw_jax.base.parameters import parameter


class QuadraticDamper(eqx.Module):
    """The paper's leg with a quadratic damper in addition."""

    c2: float = parameter(
        0.0, unit="N s^2/m^2", symbol="c_2", domain=(0.0, math.inf), meaning="quadratic damping"
    )

    def __call__(self, L: Any, dL: Any, params: Any) -> Any:
        spring = params.stiffness * (params.natural_length - L)
        return spring - params.damping * dL - self.c2 * jnp.abs(dL) * dL


class ProgressiveSpring(eqx.Module):
    """The paper's leg with a spring that becomes stiffer."""

    k3: float = parameter(
        0.0, unit="N/m^3", symbol="k_3", domain=(0.0, math.inf), meaning="cubic stiffness"
    )

    def __call__(self, L: Any, dL: Any, params: Any) -> Any:
        compression = params.natural_length - L
        return params.stiffness * compression + self.k3 * compression**3 - params.damping * dL


def make_leg_laws(params: Any) -> dict[str, Any]:
    """Return the laws that `compare_laws` always compares, by name. None is the paper's law.

    A search starts at their values, at which the forces change by some per cent. At zero, a bound,
    a search would not move.
    """
    length, speed = params.locked_length, jnp.sqrt(params.gravity * params.locked_length)
    return {
        "linear": None,
        "quadratic damper": QuadraticDamper(float(0.3 * params.damping / speed)),
        "progressive spring": ProgressiveSpring(float(4.0 * params.stiffness / length**2)),
    }
