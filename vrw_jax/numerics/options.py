"""Every numerical choice of the event-driven step in one visible object."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from vrw_jax.numerics.types import Scalar, as_float_array

FLOOR = 90.0
"""Smallest useful tolerance in units of round-off (2e-14 in float64): below it rounding rules."""


class Options(eqx.Module):
    """Numerical choices of an event-driven step. The tolerances may change without recompiling.

    `solver` names any diffrax Runge-Kutta solver with an error estimate, explicit or implicit:
    "Dopri8", "Tsit5", "Dopri5", "Bosh3", "Kvaerno3", "Kvaerno5", ...
    """

    solver: str = eqx.field(static=True, default="Dopri8")
    rtol: Scalar = eqx.field(converter=as_float_array, default=1e-10)  # of each local step
    atol: Scalar = eqx.field(converter=as_float_array, default=1e-10)  # m, rad, m/s, rad/s
    # Derivatives are computed this much tighter: tangents take no part in the step-size control,
    # and at equal tolerances their error is up to 100 times that of the values.
    derivative_tightening: Scalar = eqx.field(converter=as_float_array, default=100.0)
    max_phase_time: Scalar = eqx.field(converter=as_float_array, default=20.0)  # s
    max_solver_steps: int = eqx.field(static=True, default=20_000)  # of one phase, tried steps
    first_step: Scalar = eqx.field(converter=as_float_array, default=5e-3)  # of each phase, s
    event_steps: int = eqx.field(static=True, default=30)  # at most, to locate an event
    monitor_steps: int = eqx.field(static=True, default=5)  # secant re-steps to a monitor's minimum

    def __check_init__(self) -> None:
        for name in ("rtol", "atol", "derivative_tightening", "max_phase_time", "first_step"):
            value = getattr(self, name)
            if isinstance(value, jax.core.Tracer) or jnp.ndim(value) > 0:
                continue
            if not float(value) > 0.0:
                raise ValueError(f"{name} is {float(value):g}, but it must be positive.")
        for name in ("max_solver_steps", "event_steps", "monitor_steps"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}, but it must be at least 1.")

    @classmethod
    def tight(cls) -> "Options":
        """The tightest useful tolerances in float64: a step is right to about 1e-12."""
        return cls(rtol=as_float_array(1e-13), atol=as_float_array(1e-13))

    def for_derivatives(self) -> "Options":
        """The same choices with tolerances tightened for derivatives, down to round-off."""
        return self.tightened(self.derivative_tightening)

    def tightened(self, factor: Scalar | float) -> "Options":
        """The same choices with tolerances divided by `factor`, down to round-off."""
        floor = FLOOR * jnp.finfo(self.rtol.dtype).eps
        tighten = lambda tolerance: jnp.maximum(tolerance / factor, jnp.minimum(floor, tolerance))
        return eqx.tree_at(
            lambda o: (o.rtol, o.atol), self, (tighten(self.rtol), tighten(self.atol))
        )

    def require_reachable(self, dtype: np.dtype) -> None:
        """Refuse, in one sentence, a tolerance below what the number format can resolve."""
        floor = FLOOR * float(jnp.finfo(dtype).eps)
        for name in ("rtol", "atol"):
            value = getattr(self, name)
            if isinstance(value, jax.core.Tracer) or jnp.ndim(value) > 0 or float(value) >= floor:
                continue
            enough = 1e2 * floor
            hint = f"ask for no less, as with Options(rtol={enough:.0e}, atol={enough:.0e})"
            if dtype == np.float32:
                hint = (
                    'call jax.config.update("jax_enable_x64", True) before anything else, or '
                    + hint
                )
            raise ValueError(
                f"{name} is {float(value):g}, but {np.dtype(dtype).name} numbers can't resolve "
                f"less than {floor:.0e}: {hint}."
            )
