"""Numerical options of the event-driven step."""

import dataclasses
import functools
from typing import TYPE_CHECKING, Any, Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from vrw_jax.numerics.types import Number, Scalar
from vrw_jax.wording import AbstractTold, Row, chosen, positive, reals, told, whole

SolverName = Literal[
    "Dopri8", "Tsit5", "Dopri5", "Bosh3", "Heun", "Midpoint", "Ralston",
    "Kvaerno3", "Kvaerno4", "Kvaerno5", "ImplicitEuler",
]  # fmt: skip
"""Names of diffrax's Runge-Kutta solvers with an error estimate: explicit ones, then implicit
ones."""
SOLVERS: tuple[str, ...] = get_args(SolverName)

Engine = Literal["auto", "lanes", "diffrax"]
"""Names of the engines that integrate the steps of wheels with compliant legs."""

FLOOR = 90.0
"""Units of round-off below which tolerances are not tightened (2e-14 in float64).

It is chosen because a walk of many steps gains nothing below it.
"""
LEAST = 4.5
"""Least tolerance allowed in float64, in units of round-off.

It is chosen because a walk of few steps that grazes a guard gains accuracy down to it.
"""


def _positive(name: str, default: float) -> Any:
    return eqx.field(converter=functools.partial(reals, name), default=default)


class Options(AbstractTold):
    """Numerical options of an event-driven step; the tolerances may change without recompiling.

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
    engine: Engine = eqx.field(static=True, default="auto")
    rtol: Scalar = _positive("rtol", 1e-10)
    atol: Scalar = _positive("atol", 1e-10)
    derivative_tightening: Scalar = _positive("derivative_tightening", 20.0)
    max_phase_time: Scalar = _positive("max_phase_time", 20.0)
    max_solver_steps: int = eqx.field(static=True, default=20_000)
    first_step: Scalar = _positive("first_step", 5e-3)
    event_steps: int = eqx.field(static=True, default=100)
    monitor_steps: int = eqx.field(static=True, default=5)

    if TYPE_CHECKING:

        def __init__(
            self,
            solver: SolverName = "Dopri8",
            engine: Engine = "auto",
            rtol: Number = 1e-10,
            atol: Number = 1e-10,
            derivative_tightening: Number = 20.0,
            max_phase_time: Number = 20.0,
            max_solver_steps: int = 20_000,
            first_step: Number = 5e-3,
            event_steps: int = 100,
            monitor_steps: int = 5,
        ) -> None: ...

    def __check_init__(self) -> None:
        chosen("solver", self.solver, SOLVERS)
        chosen("engine", self.engine, get_args(Engine))
        for name in ("rtol", "atol", "derivative_tightening", "max_phase_time", "first_step"):
            value = getattr(self, name)
            if not isinstance(value, jax.core.Tracer) and jnp.ndim(value) == 0:
                positive(name, value)
        for name in ("max_solver_steps", "event_steps", "monitor_steps"):
            whole(name, getattr(self, name))

    def rows(self) -> list[Row]:
        units = {"max_phase_time": "s", "first_step": "s"}
        return [
            (name, value if isinstance(value, str) else told(value, units.get(name, "")))
            for name, value in vars(self).items()
        ]

    def by(self, engine: Engine) -> "Options":
        """Return these options with another engine; "auto" leaves the engine as it is."""
        chosen("engine", engine, get_args(Engine))
        return self if engine == "auto" else dataclasses.replace(self, engine=engine)

    @classmethod
    def tight(cls) -> "Options":
        """Return options with the tightest useful tolerances in float64: steps accurate to about
        1e-12.
        """
        return cls(rtol=1e-13, atol=1e-13)

    def for_derivatives(self) -> "Options":
        """Return these options with tolerances tightened for derivatives, down to round-off."""
        return self.tightened(self.derivative_tightening)

    def tightened(self, factor: Scalar | float) -> "Options":
        """Return these options with tolerances divided by `factor`, down to round-off."""
        both = self.rtol, self.atol
        return eqx.tree_at(lambda o: (o.rtol, o.atol), self, _tightened(both, factor))

    def require_reachable(self, dtype: np.dtype) -> None:
        """Raise a ValueError for a tolerance below the resolution of the number format."""
        floor = (LEAST if dtype == np.float64 else FLOOR) * float(jnp.finfo(dtype).eps)
        for name in ("rtol", "atol"):
            value = getattr(self, name)
            if isinstance(value, jax.core.Tracer) or np.ndim(value) or np.asarray(value) >= floor:
                continue
            enough = 1e2 * floor
            hint = f"ask for no less, as with Options(rtol={enough:.0e}, atol={enough:.0e})"
            if dtype == np.float32:
                hint = "call vrw.start_jax() before anything else, or " + hint
            raise ValueError(
                f"{name} is {float(value):g}, but {np.dtype(dtype).name} numbers can't resolve "
                f"less than {floor:.0e}: {hint}."
            )


@jax.jit
def _tightened(tolerances: tuple[Scalar, ...], factor: Scalar | float) -> tuple[Scalar, ...]:
    floor = FLOOR * jnp.finfo(tolerances[0].dtype).eps
    return tuple(jnp.maximum(x / factor, jnp.minimum(floor, x)) for x in tolerances)
