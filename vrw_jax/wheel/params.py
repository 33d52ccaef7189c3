"""Parameters of the wheel, their units and domains, and their symbols in the paper."""

import functools
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool

from vrw_jax.base.checks import check_int, check_reals, format_value, require_known_name
from vrw_jax.base.elementwise import Elementwise, RealInput, Scalar, compute_sine_cosine
from vrw_jax.base.options import (
    ModuleParameter,
    ParameterDomain,
    StepOptions,
    list_parameters,
    make_real_field,
)
from vrw_jax.base.results import AbstractPrintable, LabelAndText, format_quantity

MIN_SI_VALUE = 1e-15
"""Smallest value of a positive parameter in SI units, chosen because quotients of smaller values
overflow.
"""
MAX_SI_VALUE = 1e60
"""Upper bound on the parameters of a wheel in SI units. The value is chosen because products of
four larger values come near the largest 64-bit floating-point number.
"""
MAX_RELATIVE_VALUE = 1e9
"""Upper bound on the natural length, stiffness and damping in units of total mass, locked length
and gravity. The value is chosen because it is far above the values for legs whose motion a solver
resolves.
"""

PARAMETER_DOMAINS: dict[str, ParameterDomain] = {
    "hub_mass": ParameterDomain("m_H", "kg", 0.0, MAX_SI_VALUE, "mass of the body frame"),
    "leg_mass": ParameterDomain(
        "m", "kg", MIN_SI_VALUE, MAX_SI_VALUE, "mass of one leg frame, a point"
    ),
    "leg_com": ParameterDomain("a", "m", 0.0, MAX_SI_VALUE, "distance from foot to the leg's mass"),
    "locked_length": ParameterDomain(
        "L_0", "m", MIN_SI_VALUE, MAX_SI_VALUE, "length of a leg on its stopper"
    ),
    "natural_length": ParameterDomain(
        "L*", "m", MIN_SI_VALUE, MAX_SI_VALUE, "length of the unloaded spring"
    ),
    "stiffness": ParameterDomain("k", "N/m", 0.0, MAX_SI_VALUE, "spring constant of each leg"),
    "damping": ParameterDomain("c", "N s/m", 0.0, MAX_SI_VALUE, "viscous damping of each leg"),
    "slope": ParameterDomain("phi", "rad", -math.pi / 2, math.pi / 2, "downhill slope", False),
    "gravity": ParameterDomain(
        "g", "m/s^2", MIN_SI_VALUE, MAX_SI_VALUE, "gravitational acceleration"
    ),
}
"""Domain of each floating-point parameter of `WheelParams`, in the order of its fields."""

UNIT_POWERS = {
    "kg": (0, 0, 1), "m": (1, 0, 0), "N/m": (0, -2, 1), "N s/m": (0, -1, 1), "rad": (0, 0, 0),
    "m/s^2": (1, -2, 0), "rad/s": (0, -1, 0), "m/s": (1, -1, 0), "s": (0, 1, 0),
}  # fmt: skip
"""Exponents of length, time and mass in the units of the wheel's parameters and of the outputs of a
step.
"""


class Symbols(NamedTuple):
    """Parameters by their symbols in the paper, and quantities that several formulas share."""

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
    """Mass of the hub and of the n - 1 legs other than Leg 1, kg."""
    Mt: Elementwise
    """Total mass, kg."""
    c0: Elementwise
    """Distance from the hub to the mass of a locked leg, L0 - a, m."""
    n: int
    sin_alpha: float
    cos_alpha: float
    alpha: float
    leg_force: Any = None
    """Force along a leg as a function of its length and rate; None for the paper's force."""
    hub_torque: Any = None
    """Torque on the hub as a function of its rate; None without a motor."""


class WheelLaws(eqx.Module):
    """Laws that a user gives instead of the paper's; None where there is none."""

    leg: Any = None
    hub: Any = None

    @property
    def leg_period(self) -> int:
        """Return the number of steps after which each leg has its first law again."""
        return 2 if hasattr(self.leg, "exchange") else 1

    def exchange_legs(self, parity: Any) -> "WheelLaws":
        """Return the laws as they are in a later step of a walk.

        - `parity`: 1 if the number of steps until then is odd, otherwise 0.
        """
        if self.leg_period == 1:
            return self
        return WheelLaws(self.leg.exchange(parity > 0.5), self.hub)


LAW_NAMES = ("leg_force", "hub_torque")
"""Settings of a model that are laws."""


def list_law_parameters(laws: WheelLaws | None) -> Iterator[ModuleParameter]:
    """Yield the parameters of laws, whose names begin with `leg.` and `hub.`."""
    if laws is not None:
        yield from list_parameters(laws.leg, "leg")
        yield from list_parameters(laws.hub, "hub")


_check_n_legs = functools.partial(
    check_int,
    "n_legs",
    min_value=5,
    min_value_reason=" (with fewer the angle between legs is 90 degrees or more)",
)


class WheelParams(AbstractPrintable):
    """Parameters of the viscoelastic-legged rimless wheel. The defaults are Table 1 of the paper at
    slope 0.30 rad.

    All fields except `n_legs` are pytree leaves in SI units and may be swept and differentiated.
    The paper does not print g; 9.81 m/s^2 reproduces its results. A value outside its domain raises
    an error. In a batch, a wheel with such a value has `Outcome.BAD_INPUT` instead. In units of
    total mass, locked length and gravity, natural length, stiffness and damping must be below 1e9.

    - `hub_mass`: m_H, mass of the body frame, in [0, 1e+60) kg;
    - `leg_mass`: m, mass of one leg frame, a point, in [1e-15, 1e+60) kg;
    - `leg_com`: a, distance from foot to the leg's mass, in [0, 1e+60) m;
    - `locked_length`: L_0, length of a leg on its stopper, in [1e-15, 1e+60) m;
    - `natural_length`: L*, length of the unloaded spring, in [1e-15, 1e+60) m;
    - `stiffness`: k, spring constant of each leg, in [0, 1e+60) N/m;
    - `damping`: c, viscous damping of each leg, in [0, 1e+60) N s/m;
    - `slope`: phi, downhill slope, in (-1.5708, 1.5708) rad;
    - `gravity`: g, gravitational acceleration, in [1e-15, 1e+60) m/s^2;
    - `n_legs`: number of legs, at least 5; the angle between two legs is 2 pi / n_legs.

    Examples:
        >>> params = vrw.WheelParams(damping=150.0)
        >>> float(params.damping), params.n_legs
        (150.0, 8)
        >>> vrw.WheelParams(damping=np.linspace(100.0, 200.0, 3)).damping.shape
        (3,)
    """

    hub_mass: Scalar = make_real_field("hub_mass", 10.0)
    leg_mass: Scalar = make_real_field("leg_mass", 1.0)
    leg_com: Scalar = make_real_field("leg_com", 0.3)
    locked_length: Scalar = make_real_field("locked_length", 1.0)
    natural_length: Scalar = make_real_field("natural_length", 1.02)
    stiffness: Scalar = make_real_field("stiffness", 500.0)
    damping: Scalar = make_real_field("damping", 200.0)
    slope: Scalar = make_real_field("slope", 0.30)
    gravity: Scalar = make_real_field("gravity", 9.81)
    n_legs: int = eqx.field(static=True, converter=_check_n_legs, default=8)
    laws: WheelLaws | None = eqx.field(init=False, default_factory=lambda: None)
    """Laws of the model that computes with these parameters, see `attach_laws`. None means the
    paper's.
    """

    def __new__(cls, *_: Any, **given_parameters: Any) -> "WheelParams":
        """Raise a `TypeError` for keywords that are not parameters, before an instance is
        created.
        """
        for parameter_name in given_parameters:
            try:
                parameter_names = (*PARAMETER_DOMAINS, "n_legs")
                check_parameter_name(parameter_name, parameter_names, "parameter of the wheel")
            except ValueError as error:
                raise TypeError(str(error)) from None
        return super().__new__(cls)

    if TYPE_CHECKING:

        def __init__(
            self,
            hub_mass: RealInput = 10.0,
            leg_mass: RealInput = 1.0,
            leg_com: RealInput = 0.3,
            locked_length: RealInput = 1.0,
            natural_length: RealInput = 1.02,
            stiffness: RealInput = 500.0,
            damping: RealInput = 200.0,
            slope: RealInput = 0.30,
            gravity: RealInput = 9.81,
            n_legs: int = 8,
        ) -> None: ...

    def __check_init__(self) -> None:
        known_parameter_values = {
            parameter_name: float(parameter_value)
            for parameter_name, parameter_value in self._parameters.items()
            if not isinstance(parameter_value, jax.core.Tracer) and parameter_value.ndim == 0
        }
        for parameter_name, parameter_value in known_parameter_values.items():
            PARAMETER_DOMAINS[parameter_name].require_value_in_domain(
                parameter_name, parameter_value
            )
        if len(known_parameter_values) == len(PARAMETER_DOMAINS):
            for parameter_name, squared_relative_value in _square_relative_parameters(
                known_parameter_values, self.n_legs
            ).items():
                if not squared_relative_value < MAX_RELATIVE_VALUE**2:
                    raise ValueError(
                        f"{parameter_name} is {known_parameter_values[parameter_name]:g} "
                        f"{PARAMETER_DOMAINS[parameter_name].unit}, which is "
                        f"{math.sqrt(squared_relative_value):.1e} in units of the wheel's mass, "
                        "locked length and gravity, "
                        f"but it must be below {MAX_RELATIVE_VALUE:g} in them: give a smaller "
                        "value."
                    )
        leg_com, locked_length = (
            known_parameter_values.get(parameter_name)
            for parameter_name in ("leg_com", "locked_length")
        )
        if leg_com is not None and locked_length is not None and not leg_com < locked_length:
            raise ValueError(
                f"leg_com is {leg_com:g} m and locked_length {locked_length:g} m, but a leg's mass "
                "is between foot and hub: give leg_com < locked_length."
            )
        parameter_shapes = {
            parameter_name: parameter_value.shape
            for parameter_name, parameter_value in self._parameters.items()
            if parameter_value.ndim
        }
        if len({parameter_shape[0] for parameter_shape in parameter_shapes.values()}) > 1:
            raise ValueError(
                f"the parameters have shapes {parameter_shapes}, but a batch has one wheel for "
                "each element of its axis: give arrays of one length."
            )

    @property
    def _parameters(self) -> dict[str, Any]:
        """Return the floating-point parameters by their names, in the order of their fields."""
        return {
            parameter_name: getattr(self, parameter_name) for parameter_name in PARAMETER_DOMAINS
        }

    @property
    def in_axes(self) -> "WheelParams":
        """Return the argument `in_axes` for `jax.vmap`: 0 for each parameter with an axis, and None
        otherwise.

        For example `jax.vmap(vrw.limit_cycle, in_axes=(params.in_axes,))(params)`.
        """
        return jax.tree.map(lambda leaf: 0 if jnp.ndim(leaf) else None, self)

    def require_single_wheel(self, remedy_text: str) -> None:
        """Raise a `ValueError` if a parameter has an axis. The message ends with `remedy_text`."""
        for parameter_name, parameter_value in self._parameters.items():
            if parameter_value.ndim:
                raise ValueError(
                    f"{parameter_name} has shape {parameter_value.shape}, but this is about one "
                    f"wheel: {remedy_text}."
                )

    @property
    def printed_heading(self) -> str:
        """Return the class name, with a note if a parameter lies outside its domain."""
        title_suffix = (
            "" if np.all(self.is_in_domain()) else " out of its domain: a gradient or a difference"
        )
        return "WheelParams" + title_suffix

    def summary_rows(self) -> list[LabelAndText]:
        """Return the label and the printed value of each parameter.

        A gradient has labels that begin with "by", one for each parameter.
        """
        parameters_with_domains = [
            (name, value, PARAMETER_DOMAINS[name]) for name, value in self._parameters.items()
        ]
        if not np.all(self.is_in_domain()):
            return [
                (f"by {name} {domain.symbol}, {domain.unit}", format_quantity(value, ""))
                for name, value, domain in parameters_with_domains
            ]
        printed_parameter_rows = [
            (f"{name} {domain.symbol}", format_quantity(value, domain.unit))
            for name, value, domain in parameters_with_domains
        ]
        return [*printed_parameter_rows, ("n_legs", str(self.n_legs))]

    @property
    def leg_angle(self) -> float:
        """Return the angle between neighboring legs, alpha = 2 pi / n_legs, rad."""
        return 2.0 * math.pi / self.n_legs

    def is_in_domain(self) -> Bool[Array, "..."]:
        """Return whether all parameters of each wheel are finite and in their domains.

        The product of any four parameters must also be finite in their floating-point type. If the
        slope has an axis over steps, so has the result.
        """
        n_axes = max(map(jnp.ndim, self._parameters.values()))

        def align(value: Any) -> Any:
            """Return a value whose first axis is that of parameters with a further axis."""
            if isinstance(value, float | int):  # Dividing Python's numbers by zero raises an error.
                return np.float64(value)
            return value[:, None] if n_axes == 2 and value.ndim == 1 else value

        value_by_parameter = {name: align(value) for name, value in self._parameters.items()}
        is_in_all_domains = value_by_parameter["leg_com"] < value_by_parameter["locked_length"]
        for parameter_name, parameter_value in value_by_parameter.items():
            max_value_of_dtype = float(jnp.finfo(jnp.result_type(parameter_value)).max) ** 0.25
            parameter_domain = PARAMETER_DOMAINS[parameter_name]
            upper_bound = min(parameter_domain.upper_bound, max_value_of_dtype)
            is_in_all_domains &= parameter_domain._replace(
                upper_bound=upper_bound
            ).contains_parameter_value(parameter_value)
        with np.errstate(divide="ignore", invalid="ignore"):
            relative_values = _square_relative_parameters(value_by_parameter, self.n_legs)
        for squared_relative_value in relative_values.values():
            is_in_all_domains &= squared_relative_value < MAX_RELATIVE_VALUE**2
        for law_parameter in list_law_parameters(self.laws):
            law_value = align(law_parameter.value)
            is_in_all_domains &= law_parameter.domain.contains_parameter_value(law_value)
        return is_in_all_domains

    def describe_error(self) -> str:
        """Return a sentence on the first parameter of one wheel outside its domain, or ""."""
        try:
            self.__check_init__()
            for law_parameter in list_law_parameters(self.laws):
                law_parameter.domain.require_value_in_domain(
                    law_parameter.name, float(law_parameter.value)
                )
        except ValueError as error:
            return str(error)
        return ""

    def attach_laws(self, laws: WheelLaws | None) -> "WheelParams":
        """Return these parameters with the laws of a model, so that all equations contain them.

        None means the paper's laws.
        """
        if laws is self.laws:
            return self
        return eqx.tree_at(lambda p: p.laws, self, laws, is_leaf=lambda x: x is None)

    def make_table_1_wheel(self) -> "WheelParams":
        """Return the wheel in Table 1 of the paper with as many legs.

        The parameters of its laws have their defaults.
        """
        law_defaults = [x.default for x in list_law_parameters(self.laws)]
        default_laws = jax.tree.unflatten(
            jax.tree.structure(self.laws), list(map(jnp.asarray, law_defaults))
        )
        return WheelParams(n_legs=self.n_legs).attach_laws(default_laws)

    def scaled(
        self,
        *,
        mass: RealInput | int = 1.0,
        length: RealInput | int = 1.0,
        time: RealInput | int = 1.0,
    ) -> "WheelParams":
        """Return the similar wheel whose masses, lengths and times are scaled by the given factors.

        Similar wheels have the same gaits: a period grows by `time`, a speed by `length / time`, a
            force by `mass * length / time**2`. Angles, fractions and multipliers stay the same. By
            Buckingham's theorem the nine parameters form six dimensionless groups. The same factors
            convert units: `mass=1000, length=1000` expresses the wheel in grams and millimetres.

        Args:
            mass: factor of masses, positive.
            length: factor of lengths, positive.
            time: factor of times, positive; gravity grows by `length / time**2`.

        Returns:
            WheelParams: the wheel with every parameter times the factors of its unit.

        Raises:
            ValueError: if a factor is not positive, or a parameter leaves its domain.

        Examples:
            >>> small = vrw.WheelParams().scaled(mass=0.01, length=0.2, time=0.2**0.5)
            >>> print(f"{small.locked_length:.2f} m, {small.gravity:.2f} m/s^2")
            0.20 m, 9.81 m/s^2
        """
        factor_by_dimension: dict[str, Any] = {"length": length, "time": time, "mass": mass}
        for dimension_name, given_scale_factor in factor_by_dimension.items():
            checked_scale_factor = check_reals(dimension_name, given_scale_factor)
            if not isinstance(checked_scale_factor, jax.core.Tracer) and not np.all(
                checked_scale_factor > 0.0
            ):
                raise ValueError(
                    f"{dimension_name} is {format_value(given_scale_factor)}, but a factor of "
                    "scale is positive: give 2, say, for twice as much."
                )
            if not isinstance(given_scale_factor, int | float):
                factor_by_dimension[dimension_name] = checked_scale_factor
        scaled_parameter_values = {}
        for parameter_name, parameter_value in self._parameters.items():
            unit_powers = UNIT_POWERS[PARAMETER_DOMAINS[parameter_name].unit]
            scale_factor = math.prod(map(pow, factor_by_dimension.values(), unit_powers))
            scaled_parameter_values[parameter_name] = parameter_value * scale_factor
        return WheelParams(**scaled_parameter_values, n_legs=self.n_legs)

    def symbols(self) -> Symbols:
        """Return the parameters by their symbols in the paper, and quantities that several formulas
        share.
        """
        return add_laws(compute_symbols(self.n_legs, **self._parameters), self.laws)


def _square_relative_parameters(
    value_by_parameter: Mapping[str, Any], n_legs: int
) -> dict[str, Any]:
    """Return the squares of the relative natural length, stiffness and damping, by parameter name.

    Relative values are values in units of total mass, locked length and gravity.

    - `value_by_parameter`: values of all parameters in SI units.
    """
    locked_length, gravity = value_by_parameter["locked_length"], value_by_parameter["gravity"]
    total_mass = value_by_parameter["hub_mass"] + n_legs * value_by_parameter["leg_mass"]
    relative_stiffness = value_by_parameter["stiffness"] * locked_length / (total_mass * gravity)
    return {
        "natural_length": (value_by_parameter["natural_length"] / locked_length) ** 2,
        "stiffness": relative_stiffness**2,
        "damping": (value_by_parameter["damping"] / total_mass) ** 2 * locked_length / gravity,
    }


def compute_symbols(
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
    """Return the `Symbols` for parameters in SI units. The parameters may be complex numbers."""
    alpha = 2.0 * math.pi / n_legs
    sin_phi, cos_phi = compute_sine_cosine(slope)
    return Symbols(
        m=leg_mass,
        a=leg_com,
        L0=locked_length,
        Ls=natural_length,
        k=stiffness,
        c=damping,
        g=gravity,
        sin_phi=sin_phi,
        cos_phi=cos_phi,
        Mh=hub_mass + (n_legs - 1) * leg_mass,
        Mt=hub_mass + n_legs * leg_mass,
        c0=locked_length - leg_com,
        n=n_legs,
        sin_alpha=math.sin(alpha),
        cos_alpha=math.cos(alpha),
        alpha=alpha,
    )


def add_laws(s: Symbols, laws: WheelLaws | None) -> Symbols:
    """Return symbols whose forces are those of a user's laws, or the paper's for None."""
    laws = laws or WheelLaws()
    return s._replace(leg_force=laws.leg, hub_torque=laws.hub)


PARAMETER_NAMES: tuple[str, ...] = tuple(PARAMETER_DOMAINS)
FRICTION_NAME = "friction"
"""Name of the friction coefficient of the ground, which designs and branches may also vary."""
FRICTION_DOMAIN = ParameterDomain("mu", "1", 0.0, math.inf, "friction coefficient of the ground")

PARAMETER_BY_SYMBOL: dict[str, str] = {
    **{parameter_domain.symbol: name for name, parameter_domain in PARAMETER_DOMAINS.items()},
    **{"mH": "hub_mass", "L0": "locked_length", "L_s": "natural_length", "Ls": "natural_length"},
    **{"φ": "slope", "n": "n_legs", "mu": FRICTION_NAME, "μ": FRICTION_NAME},
}
"""Parameter name for each symbol of the paper, in the usual spellings of the symbol."""


def raise_for_parameter_symbol(given_name: Any, allowed_names: Iterable[str]) -> None:
    """Raise a `ValueError` if a name is the paper's symbol for a parameter whose name is
    allowed.
    """
    allowed_names = tuple(allowed_names)
    parameter_name = PARAMETER_BY_SYMBOL.get(given_name) if isinstance(given_name, str) else None
    if given_name not in allowed_names and parameter_name in allowed_names:
        raise ValueError(f"{given_name} is called {parameter_name}: write {parameter_name}.")


def check_parameter_name(given_name: Any, allowed_names: Sequence[str], name_kind: str) -> None:
    """Raise a `ValueError` if `given_name` is not the name of an allowed parameter.

    If the given name is a symbol of the paper, the error message states the parameter's name.
    """
    raise_for_parameter_symbol(given_name, allowed_names)
    require_known_name(given_name, allowed_names, name_kind)


def convert_friction(given_friction: object) -> Array:
    """Return one friction coefficient, or an array of them, as a JAX array.

    Raise a `ValueError` for a negative number or NaN.
    """
    friction_coefficient = check_reals(FRICTION_NAME, given_friction)
    is_friction_concrete = (
        not isinstance(friction_coefficient, jax.core.Tracer) and friction_coefficient.ndim == 0
    )
    if is_friction_concrete and not float(friction_coefficient) >= 0.0:
        raise ValueError(
            f"friction is {float(friction_coefficient):g}, but a coefficient of friction is at "
            "least 0: give 0.7, say, or math.inf for feet that never slide."
        )
    return friction_coefficient


def require_known_friction(given_friction: Any) -> float:
    """Return the friction coefficient as a float, for models whose motion does not depend on
    friction.

    Raise a `TypeError` for an array with an axis, or for a traced value.
    """
    if convert_friction(given_friction).ndim or isinstance(given_friction, jax.core.Tracer):
        raise TypeError(
            f"friction is {format_value(given_friction)}, but one known number is needed here: "
            "give a "
            "float, or take vrw.UnilateralWheel, whose friction may be an array or traced."
        )
    return float(given_friction)


NO_LAWS = jax.tree.structure(None)
"""Structure of the laws of wheels with the paper's force and without a motor."""


def stack_parameters(params: WheelParams) -> Array:
    """Return the floating-point parameters of a wheel as one array.

    The first axis has the order of `PARAMETER_NAMES`, with the parameters of the laws after
    them.
    """
    wheel_values = [getattr(params, parameter_name) for parameter_name in PARAMETER_NAMES]
    return jnp.stack([*wheel_values, *jax.tree.leaves(params.laws)])


def make_wheel_from_parameters(
    parameter_values: Array | tuple[Array, ...],
    n_legs: int,
    *ground: Elementwise,
    law_structure: Any = NO_LAWS,
) -> WheelParams:
    """Return a wheel from its floating-point parameters in the order of `stack_parameters`.

    - `ground`: values that describe uneven ground in addition to the slope. The parameter `slope`
      then has all of them on a leading axis, see `models.phase_sequence.select_stance_line`;
    - `law_structure`: structure of the laws as a pytree.
    """
    value_by_name = dict(zip(PARAMETER_NAMES, parameter_values, strict=False))
    wheel_params = WheelParams(**value_by_name, n_legs=n_legs).attach_laws(
        jax.tree.unflatten(law_structure, list(parameter_values[len(PARAMETER_NAMES) :]))
    )
    if not ground:
        return wheel_params
    return eqx.tree_at(
        lambda wheel_params: wheel_params.slope,
        wheel_params,
        jnp.stack([wheel_params.slope, *ground]),
    )


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
