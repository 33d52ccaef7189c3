"""Forces along the legs that a user gives instead of the paper's spring and damper.

Such a law is a function `f(L, dL, params)` of the length of a leg and of its rate. It is an
equinox module, whose fields are parameters with derivatives.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from vrw_jax.base.checks import check_reals, format_value
from vrw_jax.base.parameters import list_parameters
from vrw_jax.base.types import Elementwise
from vrw_jax.wheel.params import PARAMETER_DOMAINS, Symbols, WheelUnits


class LegParameters(NamedTuple):
    """Parameters of the wheel that a leg force may use: those of `WheelParams` except the slope."""

    hub_mass: Elementwise
    leg_mass: Elementwise
    leg_com: Elementwise
    locked_length: Elementwise
    natural_length: Elementwise
    stiffness: Elementwise
    damping: Elementwise
    gravity: Elementwise
    n_legs: int


class FunctionLegForce(eqx.Module):
    """Leg force by a function without parameters of its own."""

    function: Callable = eqx.field(static=True)

    def __call__(self, L: Any, dL: Any, params: LegParameters) -> Any:
        return self.function(L, dL, params)


class ScaledLegForce(eqx.Module):
    """User's law of a leg in other units of length and time, on the way from the paper's force.

    A search continues gaits with the paper's force to gaits with the law, whose share grows to 1.
    """

    leg_force: Any  # in SI units
    share: Elementwise
    length_unit: Elementwise
    time_unit: Elementwise

    def __call__(self, L: Elementwise, dL: Elementwise, params: LegParameters) -> Elementwise:
        units = WheelUnits(self.length_unit, self.time_unit, 1.0)
        si_params = params._replace(
            **{
                name: getattr(params, name) * units.compute_unit_in_si(PARAMETER_DOMAINS[name].unit)
                for name in params._fields
                if name != "n_legs"
            }
        )
        si_force = self.leg_force(L * units.length_unit, dL * units.velocity_unit, si_params)
        paper_force = params.stiffness * (params.natural_length - L) - params.damping * dL
        return self.share * (si_force / units.acceleration_unit) + (1.0 - self.share) * paper_force


def _collect_leg_parameters(s: Symbols) -> LegParameters:
    return LegParameters(s.Mt - s.n * s.m, s.m, s.a, s.L0, s.Ls, s.k, s.c, s.g, s.n)


def evaluate_leg_force(s: Symbols, L: Elementwise, dL: Elementwise) -> Elementwise:
    """Return the force of a user's law along a leg, N; positive pushes the hub off the foot."""
    return s.leg_force(L, dL, _collect_leg_parameters(s))


_POTENTIAL_NODES, _POTENTIAL_WEIGHTS = np.polynomial.legendre.leggauss(16)
"""Gauss's rule for the potential of a law, which is exact to round-off for smooth forces."""


def compute_leg_potential(s: Symbols, L: Elementwise) -> Elementwise:
    """Return the elastic energy of a leg with a user's law, J.

    If the law has no method `potential(L, params)`, the energy is the work that compresses the leg
    slowly from its locked length: the integral of the force at rest.
    """
    if hasattr(s.leg_force, "potential"):
        return s.leg_force.potential(L, _collect_leg_parameters(s))
    half_compression = 0.5 * (s.L0 - L)
    zero_rate = 0.0 * L
    energy = zero_rate
    for node, weight in zip(_POTENTIAL_NODES.tolist(), _POTENTIAL_WEIGHTS.tolist(), strict=True):
        length = L + half_compression * (1.0 + node)
        energy = energy + weight * evaluate_leg_force(s, length, zero_rate)
    return half_compression * energy


def convert_leg_force(leg_force: Any) -> Any:
    """Return a user's law as a module whose leaves are arrays, or None for the paper's force.

    Raise a `TypeError` or a `ValueError` if the law is no elementwise function of (L, dL, params),
    or if a field has no value in its domain.
    """
    if leg_force is None:
        return None
    if not callable(leg_force) or isinstance(leg_force, type):
        raise TypeError(
            f"leg_force is {format_value(leg_force)}, but it is the force along a leg: give a "
            "function f(L, dL, params) that returns N, or an object of a module with such a "
            "__call__."
        )
    if not isinstance(leg_force, eqx.Module):
        leg_force = FunctionLegForce(leg_force)
    law_parameters = list(list_parameters(leg_force, "leg"))
    remedy_text = "give a number, or declare the field with eqx.field(static=True)"
    values = [check_reals(x.name, x.value, remedy_text) for x in law_parameters]
    values = [x if jnp.issubdtype(x.dtype, jnp.floating) else x.astype(float) for x in values]
    for law_parameter, value in zip(law_parameters, values, strict=True):
        if value.ndim == 0 and not isinstance(value, jax.core.Tracer):
            law_parameter.domain.require_value_in_domain(law_parameter.name, float(value))
        if value.ndim > 1:
            raise ValueError(
                f"{law_parameter.name} has shape {value.shape}, but a field of a leg force is one "
                "number, or one for each element of a batch: give each number its own field."
            )
    structure: Any = jax.tree.structure(leg_force)
    if structure.num_leaves != len(values):
        raise TypeError(
            f"the fields of {type(leg_force).__name__} contain {structure.num_leaves} values in "
            f"{len(values)} fields, but each field of a leg force is one number: give each number "
            "its own field."
        )
    _check_result(jax.tree.unflatten(structure, [jnp.ones(())] * len(values)))
    return jax.tree.unflatten(structure, values)


def _check_result(leg_force: Any) -> None:
    """Raise an error unless a law is an elementwise function that JAX can trace."""
    for shape in ((), (3,)):
        lengths = jax.ShapeDtypeStruct(shape, jnp.result_type(float))
        evaluate = lambda L: jnp.asarray(leg_force(L, L, LegParameters._make([*[L] * 8, 8])))
        try:
            force: Any = jax.eval_shape(evaluate, lengths)
        except jax.errors.ConcretizationTypeError as error:
            raise TypeError(
                "leg_force decides by the value of a length, a rate or a parameter, which is not "
                "known when JAX compiles it: write jnp.where(condition, force, other_force)."
            ) from error
        if force.shape != shape or not jnp.issubdtype(force.dtype, jnp.floating):
            raise ValueError(
                f"leg_force returns {force.dtype.name} of shape {force.shape} for lengths of shape "
                f"{shape}, but it acts element by element: return one real number for each length."
            )
