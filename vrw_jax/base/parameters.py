"""Parameters as fields of modules, with their symbols, units and domains."""

import dataclasses
import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import equinox as eqx
import jax

from vrw_jax.base.checks import check_real, require_known_name


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
    lower_bound, upper_bound = domain
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
