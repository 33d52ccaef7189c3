"""Laws of the force along a leg, for the library and for the reference code."""

import math
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from reference_code.five_coordinates import TABLE_1

import vrw_jax as vrw


class QuadraticDamper(eqx.Module):
    """The paper's spring and damper, and a quadratic damper.

    The other two numbers make the spring stiffer and the damper stronger with the compression, so
    that tests of either law share compiled programs.
    """

    c2: Any = vrw.parameter(60.0, unit="N s^2/m^2", symbol="c_2", domain=(0.0, math.inf))
    k3: Any = vrw.parameter(0.0, unit="N/m^3", domain=(0.0, math.inf))
    c1: Any = 0.0

    def __call__(self, L, dL, params):
        compression = params.natural_length - L
        damping = params.damping + self.c1 * compression + self.c2 * jnp.abs(dL)
        return params.stiffness * compression + self.k3 * compression**3 - damping * dL


def make_progressive_leg(k3=2000.0, c1=300.0):
    """Return a spring that becomes stiffer, and a damper that grows with the compression."""
    return QuadraticDamper(0.0, k3, c1)


class PaperLeg(eqx.Module):
    """The paper's law, with a stiffness of its own."""

    k: Any = 500.0

    def __call__(self, L, dL, params):
        return self.k * (params.natural_length - L) - params.damping * dL


class BumpStop(eqx.Module):
    """A second spring, which touches below a length: the force has a kink."""

    k2: float = 300.0
    length: float = 0.9

    def __call__(self, L, dL, params):
        spring = params.stiffness * (params.natural_length - L)
        return spring - params.damping * dL + self.k2 * jnp.maximum(self.length - L, 0.0)

    def kinks(self, L, dL, params):
        return (L - self.length,)


def make_wheel(law) -> vrw.ViscoelasticWheel:
    return vrw.ViscoelasticWheel(leg_force=law)


def make_reference_params(law, **changes) -> dict:
    """Return parameters of the reference code, whose legs have a law of this module."""
    params = TABLE_1 | changes

    def leg_force(length, rate):
        compression = params["natural_length"] - length
        damping = params["damping"] + law.c1 * compression + law.c2 * np.abs(rate)
        return params["stiffness"] * compression + law.k3 * compression**3 - damping * rate

    return params | {"leg_force": leg_force}
