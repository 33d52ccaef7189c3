"""Laws that a user gives: the force along a leg, and the torque on the hub.

A law of a leg is a function `f(L, dL, params)` of the length of the leg and of its rate. A law of
the hub is a function `f(dtheta, params)` of the rate at which the wheel turns, or of its angle too,
`f(theta, dtheta, params)`. Laws are equinox modules, whose fields are parameters with derivatives.
"""

import dataclasses
import inspect
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from vrw_jax.base.checks import check_reals, format_value
from vrw_jax.base.elementwise import Elementwise, Vector, compute_sine_cosine
from vrw_jax.base.options import list_parameters, parameter
from vrw_jax.wheel.params import PARAMETER_DOMAINS, Symbols, WheelLaws, WheelUnits


class LawParameters(NamedTuple):
    """Parameters of the wheel that a law may use: those of `WheelParams` except the slope."""

    hub_mass: Elementwise
    leg_mass: Elementwise
    leg_com: Elementwise
    locked_length: Elementwise
    natural_length: Elementwise
    stiffness: Elementwise
    damping: Elementwise
    gravity: Elementwise
    n_legs: int


class FunctionLaw(eqx.Module):
    """Law by a function without parameters of its own."""

    function: Callable = eqx.field(static=True)

    def __call__(self, *arguments: Any) -> Any:
        return self.function(*arguments)


class ConstantTorque(eqx.Module):
    """Torque on the hub that does not depend on the motion."""

    torque: Any = parameter(0.0, unit="N m", symbol="tau", meaning="torque on the hub")

    def __call__(self, dtheta: Elementwise, params: LawParameters) -> Elementwise:
        return self.torque + 0.0 * dtheta


def _make_law_module(
    law: Any,
    law_name: str = "a law of AlternatingLegs",
    meaning: str = "force along a leg",
    signature: str = "f(L, dL, params)",
    unit: str = "N",
) -> Any:
    if not callable(law) or isinstance(law, type):
        raise TypeError(
            f"{law_name} is {format_value(law)}, but it is the {meaning}: give a "
            f"function {signature} that returns {unit}, or an object of a module with such a "
            "__call__."
        )
    return law if isinstance(law, eqx.Module) else FunctionLaw(law)


class AlternatingLegs(eqx.Module):
    """Two laws of the legs in turn: every second leg has the first law, and the others the second.

    Give the object as `leg_force` of `ViscoelasticWheel`. The wheel needs an even number of legs.
    Its gaits repeat after an even number of steps.

    - `first`, `second`: forces along the legs, as functions `f(L, dL, params)`; the names of their
      parameters begin with `leg.first.` and `leg.second.`;
    - `turn`: 0 if the leg that lands at the start of a walk has the first law, 1 if the second.

    Examples:
        >>> legs = vrw.AlternatingLegs(vrw.SpringDamper(damping=150.0), vrw.SpringDamper())
        >>> vrw.ViscoelasticWheel(leg_force=legs).parameter_names[-1]
        'leg.turn'
    """

    first: Any = eqx.field(converter=_make_law_module)
    second: Any = eqx.field(converter=_make_law_module)
    turn: Any = parameter(0.0, domain=(0.0, 2.0), meaning="the law of the landing leg, 0 or 1,")

    def __call__(self, L: Elementwise, dL: Elementwise, params: LawParameters) -> Elementwise:
        forces = self.first(L, dL, params), self.second(L, dL, params)
        return jnp.where(self.turn < 0.5, *forces)

    def potential(self, L: Elementwise, params: LawParameters) -> Elementwise:
        first, second = (_evaluate_potential(law, L, params) for law in (self.first, self.second))
        return jnp.where(self.turn < 0.5, first, second)

    def kinks(self, L: Elementwise, dL: Elementwise, params: LawParameters) -> tuple:
        is_first = self.turn < 0.5
        first, second = (evaluate_kinks(law, L, dL, params) for law in (self.first, self.second))
        return (
            *(jnp.where(is_first, value, 1.0) for value in first),
            *(jnp.where(is_first, 1.0, value) for value in second),
        )

    def exchange(self, has_changed: Any = True) -> "AlternatingLegs":
        """Return the laws as the next leg sees them, if `has_changed`."""
        is_first = (self.turn < 0.5) ^ has_changed
        return eqx.tree_at(lambda legs: legs.turn, self, jnp.where(is_first, 0.0 * self.turn, 1.0))


class SpringDamper(eqx.Module):
    """The paper's spring and damper as a law of a leg, with parameters of its own.

    - `stiffness`, `damping`, `natural_length`: parameters of the law, in N/m, N s/m and m. The
      defaults are those of Table 1 of the paper.

    Examples:
        >>> model = vrw.ViscoelasticWheel(leg_force=vrw.SpringDamper(damping=150.0))
        >>> step = vrw.step(vrw.WheelParams(), vrw.paper_start(), model=model)
        >>> print(f"{step.period:.3f} s")
        0.714 s
    """

    stiffness: Any = parameter(500.0, unit="N/m", symbol="k", domain=(0.0, np.inf))
    damping: Any = parameter(200.0, unit="N s/m", symbol="c", domain=(0.0, np.inf))
    natural_length: Any = parameter(1.02, unit="m", symbol="L*", domain=(0.0, np.inf))

    def __call__(self, L: Elementwise, dL: Elementwise, params: LawParameters) -> Elementwise:
        return self.stiffness * (self.natural_length - L) - self.damping * dL


def evaluate_kinks(law: Any, L: Elementwise, dL: Elementwise, params: LawParameters) -> tuple:
    """Return the values of the functions that change sign at the kinks of a law of a leg."""
    return tuple(law.kinks(L, dL, params)) if callable(getattr(law, "kinks", None)) else ()


def count_kinks(law: Any) -> int:
    """Return the number of kinks that a law of a leg declares."""
    if not callable(getattr(law, "kinks", None)):
        return 0
    return len(_evaluate_kink_shapes(law, jax.ShapeDtypeStruct((), jnp.result_type(float))))


def _evaluate_kink_shapes(law: Any, length: jax.ShapeDtypeStruct) -> tuple:
    evaluate = lambda L: evaluate_kinks(law, L, L, LawParameters._make([*[L] * 8, 8]))
    return jax.eval_shape(evaluate, length)


ONE_SIDED_DISTANCE = 1e-7
"""Distance from a kink at which a one-sided law is evaluated, in units of the wheel.

The value is chosen because the force is extrapolated linearly over the distance, with an error of
its square, which is round-off.
"""


class OneSidedLegForce(eqx.Module):
    """Law of a leg on one side of each of its kinks, continued smoothly to the other side.

    Beyond a kink, the force is linear, with the value and the derivatives next to the kink. A
    solver step that crosses the kink is therefore as accurate as within a smooth law.
    """

    law: Any
    sides: Vector  # signs of the functions of the kinks
    other_sides: Vector | None = None  # of the neighboring legs; None if `sides` has all legs
    # whether the force has two sides at kinks that depend on the rate, as for a leg at rest
    is_at_rest: bool = eqx.field(static=True, default=False)

    def __call__(self, L: Elementwise, dL: Elementwise, params: LawParameters) -> Elementwise:
        length_unit = params.locked_length
        velocity_unit = jnp.sqrt(params.gravity * length_unit)
        inner_L, inner_dL = L, dL
        for index, side in enumerate(self.sides):
            evaluate = lambda x, y, i=index, side=side: (
                side * evaluate_kinks(self.law, x, y, params)[i]
            )
            one, zero = jnp.ones_like(inner_L), jnp.zeros_like(inner_L)
            value, slope_L = jax.jvp(evaluate, (inner_L, inner_dL), (one, zero))
            slope_dL = jax.jvp(evaluate, (inner_L, inner_dL), (zero, one))[1]
            step_L, step_dL = slope_L * length_unit, slope_dL * velocity_unit
            if self.is_at_rest:
                step_L, step_dL = jnp.where(step_dL == 0.0, step_L, 0.0), 0.0 * step_dL
            squared_slope = step_L * step_L + step_dL * step_dL
            squared_slope = jnp.where(squared_slope > 0.0, squared_slope, 1.0)
            missing_value = ONE_SIDED_DISTANCE * jnp.sqrt(squared_slope) - value
            change = jnp.where(missing_value > 0.0, missing_value / squared_slope, 0.0)
            inner_L = inner_L + change * step_L * length_unit
            inner_dL = inner_dL + change * step_dL * velocity_unit
        force, force_change = jax.jvp(
            lambda L, dL: self.law(L, dL, params), (inner_L, inner_dL), (L - inner_L, dL - inner_dL)
        )
        return force + force_change

    def kinks(self, L: Elementwise, dL: Elementwise, params: LawParameters) -> tuple:
        return evaluate_kinks(self.law, L, dL, params)

    def exchange(self) -> "OneSidedLegForce":
        law = _exchange_legs(self.law)
        if self.other_sides is not None:
            return OneSidedLegForce(law, self.other_sides, self.sides, self.is_at_rest)
        if law is self.law:
            return self
        return OneSidedLegForce(law, self.sides, is_at_rest=self.is_at_rest)


class ScaledLegForce(eqx.Module):
    """User's law of a leg in other units of length and time, on the way from the paper's force.

    A search continues gaits with the paper's force to gaits with the law, whose share grows to 1.
    """

    law: Any  # in SI units
    share: Elementwise
    length_unit: Elementwise
    time_unit: Elementwise

    def __call__(self, L: Elementwise, dL: Elementwise, params: LawParameters) -> Elementwise:
        units = WheelUnits(self.length_unit, self.time_unit, 1.0)
        si_force = self.law(
            L * units.length_unit, dL * units.velocity_unit, _convert_to_si(params, units)
        )
        paper_force = params.stiffness * (params.natural_length - L) - params.damping * dL
        return self.share * (si_force / units.acceleration_unit) + (1.0 - self.share) * paper_force

    def exchange(self) -> "ScaledLegForce":
        return eqx.tree_at(lambda scaled: scaled.law, self, _exchange_legs(self.law))


class ScaledHubTorque(eqx.Module):
    """User's law of the hub in other units, whose share grows from 0 to 1 in a search."""

    law: Any  # in SI units
    share: Elementwise
    length_unit: Elementwise
    time_unit: Elementwise

    def __call__(self, *motion_and_params: Any) -> Elementwise:
        *angle, dtheta, params = motion_and_params
        units = WheelUnits(self.length_unit, self.time_unit, 1.0)
        si_torque = self.law(*angle, dtheta * units.rate_unit, _convert_to_si(params, units))
        return self.share * (si_torque / (units.acceleration_unit * units.length_unit))


def scale_laws(laws: WheelLaws, *scales: Elementwise) -> WheelLaws:
    """Return laws in other units of length and time, see `ScaledLegForce`.

    - `scales`: share of the laws, and the units of length and time in SI units.
    """
    return WheelLaws(
        None if laws.leg is None else ScaledLegForce(laws.leg, *scales),
        None if laws.hub is None else ScaledHubTorque(laws.hub, *scales),
    )


def _convert_to_si(params: LawParameters, units: WheelUnits) -> LawParameters:
    return params._replace(
        **{
            name: getattr(params, name) * units.compute_unit_in_si(PARAMETER_DOMAINS[name].unit)
            for name in params._fields
            if name != "n_legs"
        }
    )


def _collect_law_parameters(s: Symbols) -> LawParameters:
    return LawParameters(s.Mt - s.n * s.m, s.m, s.a, s.L0, s.Ls, s.k, s.c, s.g, s.n)


def _exchange_legs(leg_force: Any) -> Any:
    """Return the law of the neighboring legs, which differs only if the legs alternate."""
    return leg_force.exchange() if hasattr(leg_force, "exchange") else leg_force


def _apply_to_legs(
    s: Symbols, evaluate: Callable[[Any], Any], leg_numbers: int | np.ndarray
) -> Any:
    """Return `evaluate(law)` for the law of each leg. Even legs may have another law."""
    has_odd_number = leg_numbers % 2 == 1
    other_law = _exchange_legs(s.leg_force)
    if other_law is s.leg_force or np.all(has_odd_number):
        return evaluate(s.leg_force)
    if not np.any(has_odd_number):
        return evaluate(other_law)
    select_leg = lambda odd, even: jnp.where(has_odd_number, odd, even)
    return jax.tree.map(select_leg, evaluate(s.leg_force), evaluate(other_law))


def evaluate_leg_force(
    s: Symbols, L: Elementwise, dL: Elementwise, leg_numbers: int | np.ndarray = 1
) -> Elementwise:
    """Return the force along legs, N; positive pushes the hub off the foot.

    It is the force of spring and damper (eq. 3 of the paper), or that of a user's law.
    """
    if s.leg_force is None:
        return s.k * (s.Ls - L) - s.c * dL
    params = _collect_law_parameters(s)
    if np.ndim(leg_numbers) and getattr(s.leg_force, "other_sides", None) is not None:
        s = s._replace(leg_force=s.leg_force.law)  # The sides are those of Leg 1 and Leg 2.
    return _apply_to_legs(s, lambda law: law(L, dL, params), leg_numbers)


def evaluate_leg_kinks(
    s: Symbols, L: Elementwise, dL: Elementwise, leg_numbers: int | np.ndarray
) -> Vector:
    """Return the values of the functions that change sign at the kinks of the forces of legs."""
    params = _collect_law_parameters(s)
    return _apply_to_legs(s, lambda law: evaluate_kinks(law, L, dL, params), leg_numbers)


def compute_damping_coefficient(s: Symbols, L: Elementwise, dL: Elementwise) -> Elementwise:
    """Return minus the derivative of the force of each leg by its rate, N s/m."""
    evaluate = lambda dL: evaluate_leg_force(s, L, dL, number_legs(L))
    return -jax.jvp(evaluate, (dL,), (jnp.ones_like(dL),))[1]


def number_legs(leg_template: Elementwise) -> np.ndarray:
    """Return the number of each leg, whose axis is the first, with further axes of length 1."""
    return np.arange(1, len(leg_template) + 1).reshape(-1, *(1,) * (jnp.ndim(leg_template) - 1))


def takes_angle(hub_torque: Any) -> bool:
    """Return whether a law of the hub requires three arguments, of which the first is an angle."""
    if isinstance(hub_torque, ScaledHubTorque):
        return takes_angle(hub_torque.law)
    function = hub_torque.function if isinstance(hub_torque, FunctionLaw) else hub_torque
    try:
        parameters = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):  # a number, or a compiled function without a signature
        return False
    positional = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    return sum(x.kind in positional and x.default is x.empty for x in parameters) == 3


def evaluate_hub_torque(s: Symbols, dtheta: Elementwise, *sine_cosine: Elementwise) -> Elementwise:
    """Return the torque on the hub by a user's law, N m; positive drives the wheel forward.

    - `sine_cosine`: those of the angle of Leg 1, for a law that depends on the angle.
    """
    angle = (_compute_angle(*sine_cosine),) if takes_angle(s.hub_torque) else ()
    return s.hub_torque(*angle, dtheta, _collect_law_parameters(s))


def _compute_angle(sine: Elementwise, cosine: Elementwise) -> Elementwise:
    """Return an angle between -pi/2 and pi/2, by primitives that have machine code.

    A polynomial for the half angle (Abramowitz and Stegun 4.4.49) has an error of 1e-5. One step of
    Newton's method for the sine removes the error.
    """
    ratio = sine / (1.0 + cosine)
    square = ratio * ratio
    polynomial = 0.9998660 + square * (
        -0.3302995 + square * (0.1801410 + square * (-0.0851330 + square * 0.0208351))
    )
    angle = 2.0 * ratio * polynomial
    rough_sine, rough_cosine = compute_sine_cosine(angle)
    correction = sine * rough_cosine - cosine * rough_sine
    return angle + correction + correction * correction * correction / 6.0


def compute_motor_work(s: Symbols, angle: Elementwise) -> Elementwise:
    """Return the work of a constant torque on the hub that turns by `angle`, J.

    The work is zero for a torque that varies, which counts as a damper.
    """
    return s.hub_torque.torque * angle if isinstance(s.hub_torque, ConstantTorque) else 0.0 * angle


_POTENTIAL_NODES, _POTENTIAL_WEIGHTS = np.polynomial.legendre.leggauss(16)
"""Gauss's rule for the potential of a law, which is exact to round-off for smooth forces."""


def compute_leg_potential(
    s: Symbols, L: Elementwise, leg_numbers: int | np.ndarray = 1
) -> Elementwise:
    """Return the elastic energy of legs with a user's law, J."""
    params = _collect_law_parameters(s)
    return _apply_to_legs(s, lambda law: _evaluate_potential(law, L, params), leg_numbers)


def _evaluate_potential(law: Any, L: Elementwise, params: LawParameters) -> Elementwise:
    """Return the elastic energy of a leg, J.

    If the law has no method `potential(L, params)`, the energy is the work that compresses the leg
    slowly from its locked length: the integral of the force at rest.
    """
    if hasattr(law, "potential"):
        return law.potential(L, params)
    half_compression = 0.5 * (params.locked_length - L)
    zero_rate = 0.0 * L
    energy = zero_rate
    for node, weight in zip(_POTENTIAL_NODES.tolist(), _POTENTIAL_WEIGHTS.tolist(), strict=True):
        length = L + half_compression * (1.0 + node)
        energy = energy + weight * law(length, zero_rate, params)
    return half_compression * energy


def evaluate_damping_power(
    s: Symbols, L: Elementwise, dL: Elementwise, leg_numbers: int | np.ndarray = 1
) -> Elementwise:
    """Return the power that a user's law dissipates along each leg, W."""
    rest_law = s.leg_force
    if isinstance(rest_law, OneSidedLegForce):
        rest_law = dataclasses.replace(rest_law, is_at_rest=True)
    rest_force = evaluate_leg_force(s._replace(leg_force=rest_law), L, 0.0 * dL, leg_numbers)
    return (rest_force - evaluate_leg_force(s, L, dL, leg_numbers)) * dL


def convert_leg_force(leg_force: Any) -> Any:
    """Return a user's law of the legs as a module whose leaves are arrays, or None for the paper's.

    Raise a `TypeError` or a `ValueError` if the law is no elementwise function of (L, dL, params),
    or if a field has no value in its domain.
    """
    return _convert_law(leg_force, "leg_force", "force along a leg", "f(L, dL, params)", "N")


def convert_hub_torque(hub_torque: Any) -> Any:
    """Return a torque on the hub as a law of the hub, or None if there is none.

    Raise a `TypeError` or a `ValueError` as `convert_leg_force`.
    """
    if hub_torque is not None and not callable(hub_torque):
        hub_torque = ConstantTorque(hub_torque)
    has_angle = not isinstance(hub_torque, type) and takes_angle(hub_torque)
    signature = "f(theta, dtheta, params)" if has_angle else "f(dtheta, params)"
    return _convert_law(hub_torque, "hub_torque", "torque on the hub", signature, "N m")


def _convert_law(law: Any, law_name: str, meaning: str, signature: str, unit: str) -> Any:
    if law is None:
        return None
    law = _make_law_module(law, law_name, meaning, signature, unit)
    law_parameters = list(list_parameters(law, law_name[:3]))
    remedy_text = "give a number, or declare the field with eqx.field(static=True)"
    values = [check_reals(x.name, x.value, remedy_text) for x in law_parameters]
    values = [x if jnp.issubdtype(x.dtype, jnp.floating) else x.astype(float) for x in values]
    for law_parameter, value in zip(law_parameters, values, strict=True):
        if value.ndim == 0 and not isinstance(value, jax.core.Tracer):
            law_parameter.domain.require_value_in_domain(law_parameter.name, float(value))
        if value.ndim > 1:
            raise ValueError(
                f"{law_parameter.name} has shape {value.shape}, but a field of a law is one "
                "number, or one for each element of a batch: give each number its own field."
            )
    structure: Any = jax.tree.structure(law)
    if structure.num_leaves != len(values):
        raise TypeError(
            f"the fields of {type(law).__name__} contain {structure.num_leaves} values in "
            f"{len(values)} fields, but each field of a law is one number: give each number "
            "its own field."
        )
    _check_result(
        jax.tree.unflatten(structure, [jnp.ones(())] * len(values)), law_name, signature.count(",")
    )
    return jax.tree.unflatten(structure, values)


def _check_result(law: Any, law_name: str, n_arguments: int) -> None:
    """Raise an error unless a law is an elementwise function that JAX can trace.

    - `n_arguments`: number of arguments before the parameters.
    """
    for shape in ((), (3,)):
        lengths = jax.ShapeDtypeStruct(shape, jnp.result_type(float))
        evaluate = lambda L: jnp.asarray(
            law(*[L] * n_arguments, LawParameters._make([*[L] * 8, 8]))
        )
        try:
            result: Any = jax.eval_shape(evaluate, lengths)
        except jax.errors.ConcretizationTypeError as error:
            raise TypeError(
                f"{law_name} decides by the value of a length, a rate or a parameter, which is not "
                "known when JAX compiles it: write jnp.where(condition, force, other_force)."
            ) from error
        if result.shape != shape or not jnp.issubdtype(result.dtype, jnp.floating):
            raise ValueError(
                f"{law_name} returns {result.dtype.name} of shape {result.shape} for arguments of "
                f"shape {shape}, but it acts element by element: return one real number for each."
            )
        try:
            kinks = _evaluate_kink_shapes(law, lengths)
        except (TypeError, jax.errors.ConcretizationTypeError):
            kinks = (None,)
        if not all(
            getattr(kink, "shape", None) == shape and jnp.issubdtype(kink.dtype, jnp.floating)
            for kink in kinks
        ):
            raise ValueError(
                f"kinks of {law_name} do not act element by element: return a tuple of real "
                "functions of L, dL and params, which change sign where the force has a kink."
            )
