"""Numerical options of the event-driven step."""

import dataclasses
import functools
from typing import TYPE_CHECKING, Any, Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from vrw_jax.numerics.types import RealInput, Scalar
from vrw_jax.printing import AbstractPrintable, LabelAndText, format_quantity
from vrw_jax.validation import (
    check_choice,
    check_int,
    check_positive,
    check_reals,
    raise_for_renamed_arguments,
)

SolverName = Literal[
    "Dopri8", "Tsit5", "Dopri5", "Bosh3", "Heun", "Midpoint", "Ralston",
    "Kvaerno3", "Kvaerno4", "Kvaerno5", "ImplicitEuler",
]  # fmt: skip
"""Names of diffrax's Runge-Kutta solvers with an error estimate: explicit ones, then implicit
ones.
"""
SOLVER_NAMES: tuple[str, ...] = get_args(SolverName)

EngineName = Literal["auto", "lanes", "diffrax"]
"""Names of the engines that integrate the steps of wheels with compliant legs."""

TIGHTENING_FLOOR_IN_EPS = 90.0
"""Smallest tightened tolerance, in units of round-off (2e-14 in float64).

The value is chosen because a walk of many steps gains nothing below it."""
MIN_TOLERANCE_IN_EPS = 4.5
"""Smallest tolerance allowed in float64, in units of round-off.

The value is chosen because a walk of few steps that grazes a guard gains accuracy down to this
tolerance."""


REAL_OPTION_NAMES = ("rtol", "atol", "derivative_tightening", "max_phase_time", "dt0")
"""Names of the options that are real numbers."""


def _make_positive_field(name: str, default: float) -> Any:
    """Return a field of a dataclass for a positive number."""
    return eqx.field(converter=functools.partial(check_reals, name), default=default)


def _make_positive_int_field(name: str, default: int) -> Any:
    """Return a field of a dataclass for a positive integer."""
    return eqx.field(static=True, converter=functools.partial(check_int, name), default=default)


@raise_for_renamed_arguments(
    first_step="dt0",
    event_steps="max_event_iterations",
    monitor_steps="max_margin_search_iterations",
)
class StepOptions(AbstractPrintable):
    """Numerical options of an event-driven step; the tolerances may change without recompiling.

    Lengths and times are in the wheel's own units, which are those of SI for a wheel of Table 1's
    size. For another wheel `atol`, `max_phase_time` and `dt0` are multiplied by its own units: the
    length L_0 / 1 m and the time sqrt((L_0 / 1 m) (9.81 m/s^2 / g)).

    - `solver`: one of `SOLVER_NAMES`, diffrax's Runge-Kutta solvers with an error estimate;
    - `engine`: "diffrax" is the reference for any solver, device and order of derivative; "lanes"
      is its machine code for explicit solvers on CPUs; "auto" takes "lanes" if it is available;
    - `rtol`, `atol`: relative and absolute tolerance of each solver step, in m, rad, m/s, rad/s;
    - `derivative_tightening`: factor by which tolerances are divided for derivatives, because
      derivatives take no part in the step-size control; their error is then at most ten times that
      of values without it, with unilateral contact up to 300 times;
    - `max_phase_time`: limit of one phase, s;
    - `max_solver_steps`: limit of tried solver steps in one phase;
    - `dt0`: first solver step of each phase, s;
    - `max_event_iterations`: limit of iterations to locate an event;
    - `max_margin_search_iterations`: limit of secant steps to the minimum of a margin.

    Examples:
        >>> options = vrw.StepOptions(rtol=1e-8, atol=1e-8)
        >>> vrw.step(vrw.WheelParams(), vrw.paper_start(), options=options).engine
        'lanes'
    """

    solver: str = eqx.field(static=True, default="Dopri8")
    engine: EngineName = eqx.field(static=True, default="auto")
    rtol: Scalar = _make_positive_field("rtol", 1e-10)
    atol: Scalar = _make_positive_field("atol", 1e-10)
    derivative_tightening: Scalar = _make_positive_field("derivative_tightening", 20.0)
    max_phase_time: Scalar = _make_positive_field("max_phase_time", 20.0)
    max_solver_steps: int = _make_positive_int_field("max_solver_steps", 20_000)
    dt0: Scalar = _make_positive_field("dt0", 5e-3)
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
        for name in REAL_OPTION_NAMES:
            value = getattr(self, name)
            if not isinstance(value, jax.core.Tracer):
                # Options under `jax.vmap` have several numbers.
                for number_dtype in np.ravel(np.asarray(value)):
                    check_positive(name, number_dtype)

    def summary_rows(self) -> list[LabelAndText]:
        units = {"max_phase_time": "s", "dt0": "s"}
        return [
            (name, value if isinstance(value, str) else format_quantity(value, units.get(name, "")))
            for name, value in vars(self).items()
        ]

    def with_engine(self, engine: EngineName) -> "StepOptions":
        """Return these options with another engine; "auto" leaves the engine unchanged."""
        check_choice("engine", engine, get_args(EngineName))
        return self if engine == "auto" else dataclasses.replace(self, engine=engine)

    @classmethod
    def tight(cls) -> "StepOptions":
        """Return options with the tightest useful tolerances in float64, for steps accurate to
        about 1e-12.
        """
        return cls(rtol=1e-13, atol=1e-13)

    def with_derivative_tolerances(self) -> "StepOptions":
        """Return these options with tolerances tightened for derivatives, down to round-off."""
        return self.with_tightened_tolerances(self.derivative_tightening)

    def with_tightened_tolerances(self, factor: Scalar | float) -> "StepOptions":
        """Return these options with tolerances divided by `factor`, down to round-off."""
        tolerances = self.rtol, self.atol
        return eqx.tree_at(
            lambda o: (o.rtol, o.atol), self, _tighten_tolerances(tolerances, factor)
        )

    def require_scalars(self) -> None:
        """Raise a ValueError if an option contains several numbers where one is required."""
        for name in REAL_OPTION_NAMES:
            if shape := getattr(getattr(self, name), "shape", ()):
                raise ValueError(
                    f"{name} has shape {shape}, but options hold one number each: give a float, or "
                    "map over the options with jax.vmap."
                )

    def check_tolerances(self, float_dtype: np.dtype) -> None:
        """Raise a ValueError for an `rtol` below the resolution of the number format.

        `atol` has no such limit, because states may be as small as their units make them. 64-bit
        arrays that were made before `jax_enable_x64` was switched off count as 32-bit ones.
        """
        float_dtype = jax.dtypes.canonicalize_dtype(float_dtype)
        min_tolerance = (
            MIN_TOLERANCE_IN_EPS if float_dtype == np.float64 else TIGHTENING_FLOOR_IN_EPS
        ) * float(jnp.finfo(float_dtype).eps)
        rtol = self.rtol
        if isinstance(rtol, jax.core.Tracer) or np.ndim(rtol) or np.asarray(rtol) >= min_tolerance:
            return
        remedy_text = f"ask for no less, as with StepOptions(rtol={1e2 * min_tolerance:.0e})"
        if float_dtype == np.float32:
            start_remedy_text = (
                "call vrw.start_jax() before anything else and leave jax_enable_x64 on"
            )
            remedy_text = f"{start_remedy_text}, or {remedy_text}"
        raise ValueError(
            f"rtol is {float(rtol):g}, but {np.dtype(float_dtype).name} numbers can't resolve less "
            f"than {min_tolerance:.0e}: {remedy_text}."
        )


@jax.jit
def _tighten_tolerances(
    tolerances: tuple[Scalar, ...], factor: Scalar | float
) -> tuple[Scalar, ...]:
    """Return tolerances divided by a factor, down to round-off."""
    min_tolerance = TIGHTENING_FLOOR_IN_EPS * jnp.finfo(tolerances[0].dtype).eps
    return tuple(jnp.maximum(x / factor, jnp.minimum(min_tolerance, x)) for x in tolerances)
