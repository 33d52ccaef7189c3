"""Parameters of walkers and numerical options of steps: fields of modules with domains."""

import dataclasses
import functools
import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from vrw_jax.base.checks import (
    check_choice,
    check_int,
    check_positive,
    check_real,
    check_reals,
    require_known_name,
)
from vrw_jax.base.elementwise import RealInput, Scalar
from vrw_jax.base.results import AbstractPrintable, LabelAndText, format_quantity


class ParameterDomain(NamedTuple):
    """Symbol, unit and allowed range of one parameter."""

    symbol: str
    unit: str
    lower_bound: float
    upper_bound: float
    description: str
    is_lower_bound_allowed: bool = True

    def contains_parameter_value(self, parameter_value: Any) -> Any:
        """Return whether a value lies in the allowed range. NaN gives False."""
        is_above_lower_bound = (
            parameter_value >= self.lower_bound
            if self.is_lower_bound_allowed
            else parameter_value > self.lower_bound
        )
        return is_above_lower_bound & (parameter_value < self.upper_bound)

    def require_value_in_domain(self, parameter_name: str, parameter_value: float) -> None:
        """Raise a `ValueError` if the value of a parameter lies outside the allowed range."""
        if not self.contains_parameter_value(parameter_value):
            raise ValueError(
                f"{parameter_name} is {parameter_value:g}, but {self.description or 'it'} must lie "
                f"in {self}: give a value in that range."
            )

    def __str__(self) -> str:
        opening_bracket = "[" if self.is_lower_bound_allowed else "("
        return f"{opening_bracket}{self.lower_bound:g}, {self.upper_bound:g}) {self.unit}"


def parameter(
    default: float,
    *,
    unit: str = "1",
    symbol: str = "",
    domain: tuple[float, float] = (-math.inf, math.inf),
    meaning: str = "",
) -> Any:
    """Declare a field of an equinox module as a parameter, with what messages and figures need.

    A field of a module without this declaration is a parameter too, of any finite value and without
    a unit.

    Args:
        default: value if none is given.
        unit: SI unit, "1" for a pure number.
        symbol: symbol in figures; by default the name of the field.
        domain: lower bound, which is allowed, and upper bound, which is not.
        meaning: what the parameter is, for messages; by default the name of the field.

    Returns:
        A field for the body of a class.

    Raises:
        TypeError, ValueError: if the default or a bound is no number.

    Examples:
        >>> import equinox as eqx, math
        >>> class QuadraticDamper(eqx.Module):
        ...     c2: float = vrw.parameter(60.0, unit="N s^2/m^2", domain=(0.0, math.inf))
        ...
        ...     def __call__(self, L, dL, params):
        ...         spring = params.stiffness * (params.natural_length - L)
        ...         return spring - params.damping * dL - self.c2 * jnp.abs(dL) * dL
        >>> QuadraticDamper().c2
        60.0
    """
    try:
        lower_bound, upper_bound = map(float, domain)
    except (TypeError, ValueError):
        raise TypeError(
            f"domain is {domain!r}, but it is a lower and an upper bound: give two numbers, and "
            "math.inf where there is no bound."
        ) from None
    parameter_domain = ParameterDomain(
        symbol, unit, lower_bound, upper_bound, meaning, lower_bound > -math.inf
    )
    return eqx.field(default=check_real("default", default), metadata={"domain": parameter_domain})


class ModuleParameter(NamedTuple):
    """Parameter of a module: a field that is not static."""

    name: str
    value: Any
    domain: ParameterDomain
    default: float


_UNDECLARED_DOMAIN = ParameterDomain("", "1", -math.inf, math.inf, "", False)


def list_parameters(module: eqx.Module | None, prefix: str) -> Iterator[ModuleParameter]:
    """Yield the parameters of a module and of the modules in it, in the order of its leaves.

    Names begin with `prefix` and a dot, as `leg.c2` or `leg.damper.c2`.
    """
    for field in dataclasses.fields(module) if module is not None else ():
        value, name = getattr(module, field.name), f"{prefix}.{field.name}"
        if isinstance(value, eqx.Module):
            yield from list_parameters(value, name)
        elif not field.metadata.get("static") and value is not None:
            domain = field.metadata.get("domain", _UNDECLARED_DOMAIN)
            domain = domain._replace(symbol=domain.symbol or field.name)
            default = 1.0 if field.default is dataclasses.MISSING else field.default
            yield ModuleParameter(name, value, domain, default)


def list_tree_parameters(params: Any) -> list[ModuleParameter]:
    """Return the parameters in a tree of dictionaries, sequences and modules, in leaf order.

    A nested parameter has a name with dots, such as `leg.damping`.
    """
    parameters = []
    for path, value in jax.tree_util.tree_flatten_with_path(params)[0]:
        owner, names, domain = params, [], _UNDECLARED_DOMAIN
        for key in path:
            name: Any = getattr(key, "name", getattr(key, "key", getattr(key, "idx", None)))
            names.append(str(name))
            if isinstance(key, jax.tree_util.GetAttrKey):
                fields = {field.name: field for field in dataclasses.fields(owner)}
                domain = fields[name].metadata.get("domain", _UNDECLARED_DOMAIN)
                owner = getattr(owner, name)
            else:
                owner, domain = owner[name], _UNDECLARED_DOMAIN
        domain = domain._replace(symbol=domain.symbol or "".join(names[-1:]))
        parameters.append(ModuleParameter(".".join(names), value, domain, 1.0))
    return parameters


def is_tree_in_domain(params: Any) -> Any:
    """Return whether all parameters in a tree are finite and within their domains.

    If parameters have a batch axis, the result has it too.
    """
    is_inside: Any = True
    for parameter in list_tree_parameters(params):
        is_inside &= parameter.domain.contains_parameter_value(parameter.value)
    return is_inside


def find_tree_parameter(params: Any, name: str) -> int:
    """Return the index of a parameter among the leaves of a tree, or raise an error."""
    names = tuple(parameter.name for parameter in list_tree_parameters(params))
    require_known_name(name, names, "parameter")
    return names.index(name)


def replace_tree_parameter(params: Any, name: str, value: Any) -> Any:
    """Return a tree of parameters with another value of the parameter with a name."""
    leaves, structure = jax.tree.flatten(params)
    leaves[find_tree_parameter(params, name)] = value
    return jax.tree.unflatten(structure, leaves)


SolverName = Literal[
    "Dopri8", "Tsit5", "Dopri5", "Bosh3", "Heun", "Midpoint", "Ralston",
    "Kvaerno3", "Kvaerno4", "Kvaerno5", "ImplicitEuler",
]  # fmt: skip
"""Names of diffrax's Runge-Kutta solvers with an error estimate: first explicit, then implicit
ones.
"""
SOLVER_NAMES: tuple[str, ...] = get_args(SolverName)

EngineName = Literal["auto", "lanes", "diffrax"]
"""Names of the engines that integrate walking steps of wheels with compliant legs."""

TIGHTENING_FLOOR_IN_EPS = 90.0
"""Smallest tightened tolerance in units of round-off; it is 2e-14 in float64.

The value is chosen because a walk of many steps gains no accuracy from smaller tolerances.
"""
MIN_TOLERANCE_IN_EPS = 4.5
"""Smallest tolerance that is allowed in float64, in units of round-off.

The value is chosen because a walk of few steps that grazes a guard gains accuracy down to this
tolerance.
"""


REAL_OPTION_NAMES = ("rtol", "atol", "derivative_tightening", "max_phase_time", "dt0")
"""Names of the options whose values are real numbers."""


def make_real_field(field_name: str, default_value: float) -> Any:
    """Return a dataclass field for an option or a parameter that is a real number."""
    return eqx.field(converter=functools.partial(check_reals, field_name), default=default_value)


def _make_positive_int_field(option_name: str, default_value: int) -> Any:
    """Return a dataclass field for an option that must be a positive integer."""
    return eqx.field(
        static=True, converter=functools.partial(check_int, option_name), default=default_value
    )


class StepOptions(AbstractPrintable):
    """Numerical options of an event-driven walking step. Tolerances may change without
    recompilation.

    Lengths and times are in the wheel's own units, which are SI units for the wheel of Table 1 of
    the paper. For another wheel, `atol`, `max_phase_time` and `dt0` are multiplied by its own
    units. The unit of length is L_0 / 1 m, and that of time is sqrt((L_0 / 1 m) (9.81 m/s^2 / g)).

    - `solver`: one of `SOLVER_NAMES`, diffrax's Runge-Kutta solvers with an error estimate;
    - `engine`: "diffrax" supports any solver, device and order of derivative; "lanes" runs the same
      method as machine code, for explicit solvers on CPUs; "auto" selects "lanes" if it is
      available. A `RigidWheel` integrates nothing, so that it has no engine;
    - `rtol`, `atol`: relative and absolute tolerance of each solver step, in m, rad, m/s, rad/s;
    - `derivative_tightening`: factor by which tolerances are divided for derivatives, because
      step-size control ignores derivatives. The error of a derivative is then at most ten times
      that of a value, and at most 300 times with unilateral contact;
    - `max_phase_time`: largest duration of one phase, s;
    - `max_solver_steps`: largest number of attempted solver steps in one phase;
    - `dt0`: size of the first solver step in each phase, s;
    - `max_event_iterations`: largest number of iterations that locate an event;
    - `max_margin_search_iterations`: largest number of secant iterations that locate the minimum of
      a margin.

    Examples:
        >>> options = vrw.StepOptions(rtol=1e-8, atol=1e-8)
        >>> vrw.step(vrw.WheelParams(), vrw.paper_start(), options=options).engine
        'lanes'
    """

    solver: str = eqx.field(static=True, default="Dopri8")
    engine: EngineName = eqx.field(static=True, default="auto")
    rtol: Scalar = make_real_field("rtol", 1e-10)
    atol: Scalar = make_real_field("atol", 1e-10)
    derivative_tightening: Scalar = make_real_field("derivative_tightening", 20.0)
    max_phase_time: Scalar = make_real_field("max_phase_time", 20.0)
    max_solver_steps: int = _make_positive_int_field("max_solver_steps", 20_000)
    dt0: Scalar = make_real_field("dt0", 5e-3)
    max_event_iterations: int = _make_positive_int_field("max_event_iterations", 100)
    max_margin_search_iterations: int = _make_positive_int_field("max_margin_search_iterations", 5)

    if TYPE_CHECKING:

        def __init__(
            self,
            solver: SolverName = "Dopri8",
            engine: EngineName = "auto",
            rtol: RealInput = 1e-10,
            atol: RealInput = 1e-10,
            derivative_tightening: RealInput = 20.0,
            max_phase_time: RealInput = 20.0,
            max_solver_steps: int = 20_000,
            dt0: RealInput = 5e-3,
            max_event_iterations: int = 100,
            max_margin_search_iterations: int = 5,
        ) -> None: ...

    def __check_init__(self) -> None:
        check_choice("solver", self.solver, SOLVER_NAMES)
        check_choice("engine", self.engine, get_args(EngineName))
        for option_name in REAL_OPTION_NAMES:
            option_value = getattr(self, option_name)
            if not isinstance(option_value, jax.core.Tracer):
                # Options under `jax.vmap` have several numbers.
                for option_number in np.ravel(np.asarray(option_value)):
                    check_positive(option_name, option_number)

    def summary_rows(self) -> list[LabelAndText]:
        unit_by_option = {"max_phase_time": "s", "dt0": "s"}
        return [
            (
                option_name,
                option_value
                if isinstance(option_value, str)
                else format_quantity(option_value, unit_by_option.get(option_name, "")),
            )
            for option_name, option_value in vars(self).items()
        ]

    def with_engine(self, engine: EngineName) -> "StepOptions":
        """Return these options with another engine. The value "auto" leaves the engine
        unchanged.
        """
        check_choice("engine", engine, get_args(EngineName))
        return self if engine == "auto" else dataclasses.replace(self, engine=engine)

    @classmethod
    def tight(cls) -> "StepOptions":
        """Return options with the tightest useful tolerances in float64.

        Walking steps are then accurate to about 1e-12.
        """
        return cls(rtol=1e-13, atol=1e-13)

    def with_derivative_tolerances(self) -> "StepOptions":
        """Return these options with tolerances for derivatives, which are tighter but not below
        round-off.
        """
        return self.with_tightened_tolerances(self.derivative_tightening)

    def with_tightened_tolerances(self, tightening_factor: Scalar | float) -> "StepOptions":
        """Return these options with tolerances divided by `tightening_factor`.

        The divided tolerances are not below round-off.
        """
        current_tolerances = self.rtol, self.atol
        return eqx.tree_at(
            lambda o: (o.rtol, o.atol),
            self,
            _tighten_tolerances(current_tolerances, tightening_factor),
        )

    def require_scalar_options(self) -> None:
        """Raise a `ValueError` if an option is an array with an axis."""
        for option_name in REAL_OPTION_NAMES:
            if option_shape := getattr(getattr(self, option_name), "shape", ()):
                raise ValueError(
                    f"{option_name} has shape {option_shape}, but options hold one number each: "
                    "give a float, or "
                    "map over the options with jax.vmap."
                )

    def check_tolerances(self, float_dtype: np.dtype) -> None:
        """Raise a `ValueError` if `rtol` is below the resolution of the floating-point type
        `float_dtype`.

        `atol` has no such limit, because states may have any magnitude in their units. If
        `jax_enable_x64` is off, 64-bit arrays that were created earlier are treated as 32-bit
        arrays.
        """
        float_dtype = jax.dtypes.canonicalize_dtype(float_dtype)
        min_rtol = (
            MIN_TOLERANCE_IN_EPS if float_dtype == np.float64 else TIGHTENING_FLOOR_IN_EPS
        ) * float(jnp.finfo(float_dtype).eps)
        rtol = self.rtol
        if isinstance(rtol, jax.core.Tracer) or np.ndim(rtol) or np.asarray(rtol) >= min_rtol:
            return
        remedy_text = f"ask for no less, as with StepOptions(rtol={1e2 * min_rtol:.0e})"
        if float_dtype == np.float32:
            restart_remedy_text = (
                "give parameters and start as float64 numbers, as np.asarray(x, float) makes them "
                "after vrw.start_jax()"
                if jax.config.jax_enable_x64  # type: ignore[attr-defined]
                else "call vrw.start_jax() before anything else and leave jax_enable_x64 on"
            )
            remedy_text = f"{restart_remedy_text}, or {remedy_text}"
        raise ValueError(
            f"rtol is {float(rtol):g}, but {np.dtype(float_dtype).name} numbers can't resolve less "
            f"than {min_rtol:.0e}: {remedy_text}."
        )


@jax.jit
def _tighten_tolerances(
    tolerances: tuple[Scalar, ...], tightening_factor: Scalar | float
) -> tuple[Scalar, ...]:
    """Return tolerances divided by `tightening_factor`, but not below round-off."""
    min_tolerance = TIGHTENING_FLOOR_IN_EPS * jnp.finfo(tolerances[0].dtype).eps
    return tuple(
        jnp.maximum(x / tightening_factor, jnp.minimum(min_tolerance, x)) for x in tolerances
    )
