"""Laws of the force along a leg, for the library and for the reference code."""

import math
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from reference_code.five_coordinates import TABLE_1

import vrw_jax as vrw


class QuadraticDamper(eqx.Module):
    """The paper's spring and damper, and a quadratic damper."""

    c2: Any = vrw.parameter(60.0, unit="N s^2/m^2", symbol="c_2", domain=(0.0, math.inf))

    def __call__(self, L, dL, params):
        spring = params.stiffness * (params.natural_length - L)
        return spring - params.damping * dL - self.c2 * jnp.abs(dL) * dL


class ProgressiveLeg(eqx.Module):
    """A spring that becomes stiffer, and a damper that grows with the compression."""

    k3: Any = vrw.parameter(2000.0, unit="N/m^3", domain=(0.0, math.inf))
    c1: Any = 300.0

    def __call__(self, L, dL, params):
        compression = params.natural_length - L
        damping = params.damping + self.c1 * compression
        return params.stiffness * compression + self.k3 * compression**3 - damping * dL


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

    class View:
        stiffness, damping = params["stiffness"], params["damping"]
        natural_length = params["natural_length"]

    def leg_force(length, rate):
        compression = View.natural_length - length
        if isinstance(law, QuadraticDamper):
            return View.stiffness * compression - (View.damping + law.c2 * np.abs(rate)) * rate
        return (
            View.stiffness * compression
            + law.k3 * compression**3
            - (View.damping + law.c1 * compression) * rate
        )

    return params | {"leg_force": leg_force}
