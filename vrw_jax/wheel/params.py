"""What the wheel is made of: parameters with units and domains, and the paper's symbols."""

import math
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from vrw_jax.numerics import Elementwise, Scalar, as_float_array


class Domain(NamedTuple):
    """Unit, symbol and allowed open/closed range of one parameter."""

    symbol: str
    unit: str
    lower: float
    upper: float
    lower_is_allowed: bool
    description: str

    def contains(self, value: Array) -> Array:
        """Whether value lies in the range; False for NaN."""
        above = value >= self.lower if self.lower_is_allowed else value > self.lower
        return above & (value < self.upper)

    def __str__(self) -> str:
        bracket = "[" if self.lower_is_allowed else "("
        unit = f" {self.unit}" if self.unit else ""
        return f"{bracket}{self.lower:g}, {self.upper:g}){unit}"


SMALLEST, LARGEST = 1e-15, 1e9
"""Where SI numbers of a wheel end: beyond them, products overflow instead of telling something."""

DOMAINS: dict[str, Domain] = {
    "hub_mass": Domain("m_H", "kg", 0.0, LARGEST, True, "mass of the body frame"),
    "leg_mass": Domain("m", "kg", SMALLEST, LARGEST, True, "mass of one leg frame, a point"),
    "leg_com": Domain("a", "m", 0.0, LARGEST, True, "distance from foot to the leg's mass"),
    "locked_length": Domain("L_0", "m", SMALLEST, LARGEST, True, "length of a leg on its stopper"),
    "natural_length": Domain("L*", "m", SMALLEST, LARGEST, True, "length of the unloaded spring"),
    "stiffness": Domain("k", "N/m", 0.0, LARGEST, True, "spring constant of each leg"),
    "damping": Domain("c", "N s/m", 0.0, LARGEST, True, "viscous damping of each leg"),
    "slope": Domain("phi", "rad", -math.pi / 2, math.pi / 2, False, "downhill slope"),
    "gravity": Domain("g", "m/s^2", SMALLEST, LARGEST, True, "gravitational acceleration"),
}
"""Every float parameter of `WheelParams`, in the order of its fields."""


class Symbols(NamedTuple):
    """The paper's symbols and the combinations that every formula needs, unpacked once."""

    m: Elementwise
    a: Elementwise
    L0: Elementwise
    Ls: Elementwise
    k: Elementwise
    c: Elementwise
    g: Elementwise
    sin_phi: Elementwise
    cos_phi: Elementwise
    Mh: Elementwise
    """Mass that hangs on Leg 1: hub and n - 1 legs, kg."""
    Mt: Elementwise
    """Total mass, kg."""
    c0: Elementwise
    """Distance of a locked leg's mass from the hub, L0 - a, m."""
    n: int
    sin_alpha: float
    cos_alpha: float
    alpha: float


class WheelParams(eqx.Module):
    """Parameters of the viscoelastic-legged rimless wheel; the defaults are Table 1, slope 0.30.

    All fields but `n_legs` are pytree leaves in SI units and may be swept and differentiated.
    The paper does not print g; 9.81 m/s^2 reproduces its numbers. A number out of its domain is
    refused here when it is a plain scalar; inside a batch it becomes `Outcome.BAD_INPUT`.
    """

    hub_mass: Scalar = eqx.field(converter=as_float_array, default=10.0)  # m_H, kg, >= 0
    leg_mass: Scalar = eqx.field(converter=as_float_array, default=1.0)  # m, kg, > 0
    leg_com: Scalar = eqx.field(converter=as_float_array, default=0.3)  # a, m, 0 <= a < L0
    locked_length: Scalar = eqx.field(converter=as_float_array, default=1.0)  # L_0, m, > 0
    natural_length: Scalar = eqx.field(converter=as_float_array, default=1.02)  # L*, m, > 0
    stiffness: Scalar = eqx.field(converter=as_float_array, default=500.0)  # k, N/m, >= 0
    damping: Scalar = eqx.field(converter=as_float_array, default=200.0)  # c, N s/m, >= 0
    slope: Scalar = eqx.field(converter=as_float_array, default=0.30)  # phi, rad, |phi| < pi/2
    gravity: Scalar = eqx.field(converter=as_float_array, default=9.81)  # g, m/s^2, > 0
    n_legs: int = eqx.field(static=True, default=8)  # alpha = 2 pi / n_legs, >= 5

    def __check_init__(self) -> None:
        if not isinstance(self.n_legs, int) or self.n_legs < 5:
            raise ValueError(
                f"n_legs is {self.n_legs!r}, but the wheel needs a whole number of at least 5 legs "
                "(with fewer the angle between legs is 90 degrees or more): choose 5 or more."
            )
        for name, domain in DOMAINS.items():
            value = getattr(self, name)
            if isinstance(value, jax.core.Tracer) or jnp.ndim(value) > 0:
                continue
            if not bool(domain.contains(value)):
                raise ValueError(
                    f"{name} is {float(value):g}, but {domain.description} must lie in {domain}: "
                    "give a value in that range."
                )
        if not any(
            isinstance(x, jax.core.Tracer) or jnp.ndim(x) > 0
            for x in (self.leg_com, self.locked_length)
        ) and not float(self.leg_com) < float(self.locked_length):
            raise ValueError(
                f"leg_com is {float(self.leg_com):g} m and locked_length "
                f"{float(self.locked_length):g} m, but a leg's mass sits between foot and hub: "
                "give leg_com < locked_length."
            )

    @property
    def leg_angle(self) -> float:
        """Angle between neighbouring legs, alpha = 2 pi / n_legs, rad."""
        return 2.0 * math.pi / self.n_legs

    def in_domain(self) -> Bool[Array, "..."]:
        """Whether every parameter is finite and in its domain, lane by lane."""
        inside = self.leg_com < self.locked_length
        for name, domain in DOMAINS.items():
            value = getattr(self, name)
            inside = inside & domain.contains(value) & jnp.isfinite(value)
        return inside

    def symbols(self) -> Symbols:
        """The paper's symbols with the combinations shared by every formula."""
        return symbols_of(self.n_legs, *(getattr(self, name) for name in DOMAINS))


def symbols_of(
    n_legs: int,
    hub_mass: Elementwise,
    leg_mass: Elementwise,
    leg_com: Elementwise,
    locked_length: Elementwise,
    natural_length: Elementwise,
    stiffness: Elementwise,
    damping: Elementwise,
    slope: Elementwise,
    gravity: Elementwise,
) -> Symbols:
    """`WheelParams.symbols` of bare numbers, which may be complex too."""
    alpha = 2.0 * math.pi / n_legs
    return Symbols(
        m=leg_mass,
        a=leg_com,
        L0=locked_length,
        Ls=natural_length,
        k=stiffness,
        c=damping,
        g=gravity,
        sin_phi=jnp.sin(slope),
        cos_phi=jnp.cos(slope),
        Mh=hub_mass + (n_legs - 1) * leg_mass,
        Mt=hub_mass + n_legs * leg_mass,
        c0=locked_length - leg_com,
        n=n_legs,
        sin_alpha=math.sin(alpha),
        cos_alpha=math.cos(alpha),
        alpha=alpha,
    )


PARAMETER_NAMES: tuple[str, ...] = tuple(DOMAINS)
FRICTION = "friction"
"""What a design or a branch may move beside them: a parameter of the ground, held by its model."""


def parameters_of(params: WheelParams) -> Array:
    """The float parameters as one array, first axis in the order of PARAMETER_NAMES."""
    return jnp.stack([getattr(params, name) for name in PARAMETER_NAMES])


def wheel_of(parameters: Array | tuple[Array, ...], n_legs: int) -> WheelParams:
    """The inverse of `parameters_of`."""
    return WheelParams(**dict(zip(PARAMETER_NAMES, parameters, strict=True)), n_legs=n_legs)
