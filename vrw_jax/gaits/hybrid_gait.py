"""Gaits of hybrid systems: steps that repeat, found by Newton's method on the section."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float

from vrw_jax.base.checks import check_int, check_reals, check_type
from vrw_jax.base.options import StepOptions
from vrw_jax.base.printing import format_heading_and_rows, format_numbers, format_quantity
from vrw_jax.base.types import Scalar
from vrw_jax.flow.hybrid_system import HybridStep, HybridSystem
from vrw_jax.gaits.fixed_points import FixedPointResult, solve_fixed_point_implicit
from vrw_jax.lanes.saved_traces import call_compiled_program


class HybridGait(NamedTuple):
    """Gait of a hybrid system, which repeats after `period_n` steps.

    - `section_state`: section coordinates at which the gait begins, shape (n,);
    - `period`: duration of all its steps, s;
    - `last_step`: the last `HybridStep` of the gait;
    - `fixed_point`: the fixed point, with the Jacobian and the status of Newton's method.

    Examples:
        >>> decay = lambda y, p: jnp.stack([-p["rate"] * y[0], 1.0 + 0.0 * y[1]])
        >>> kick = lambda y, p: jnp.stack([y[0] + 1.0, 0.0 * y[1]])
        >>> guards = {"kick": vrw.hybrid.Guard(lambda y, p: 1.0 - y[1], kick)}
        >>> system = vrw.HybridSystem(
        ...     modes={"decay": vrw.hybrid.Mode(decay, guards)},
        ...     section="kick",
        ...     state=("level", "time"),
        ...     project=lambda y, p: y[:1],
        ...     embed=lambda x, p: jnp.stack([x[0], 0.0 * x[0]]),
        ... )
        >>> gait = vrw.limit_cycle({"rate": 1.0}, model=system, guess=[1.0])
        >>> print(f"{gait.section_state[0]:.6f} {gait.multipliers[0].real:.6f}")
        1.581977 0.367879
    """

    section_state: Float[Array, " n"]
    period: Scalar
    last_step: HybridStep
    fixed_point: FixedPointResult

    @property
    def converged(self) -> Bool[Array, ""]:
        """Return whether the gait was found."""
        return self.fixed_point.converged & jnp.asarray(self.last_step.is_complete)

    @property
    def multipliers(self) -> Complex[Array, " n"]:
        """Return the Floquet multipliers in the order of decreasing modulus, shape (n,)."""
        return self.fixed_point.multipliers

    @property
    def why(self) -> Any:
        """Return a sentence on how the search ended."""
        if np.all(self.last_step.is_complete):
            return self.fixed_point.ending
        return self.last_step.ending

    def __repr__(self) -> str:
        if isinstance(self.period, jax.core.Tracer) or np.ndim(self.period):
            return f"HybridGait{tuple(self)}"
        rows = [
            ("section state", format_numbers(self.section_state)),
            ("period", format_quantity(self.period, "s")),
            ("multipliers", format_numbers(np.asarray(self.multipliers))),
            ("search", self.why),
        ]
        return format_heading_and_rows("HybridGait", rows)


def find_hybrid_gait(
    system: HybridSystem, params: Any, guess: Any, period_n: int, options: Any
) -> HybridGait:
    """Return the gait near section coordinates `guess`, differentiable by the parameters."""
    if guess is None:
        raise ValueError(
            "guess is None, but the search for a gait of a HybridSystem starts there: give section "
            "coordinates near the gait."
        )
    options = StepOptions() if options is None else options
    check_type("options", options, StepOptions, "give vrw.StepOptions()")
    params = jax.tree.map(lambda leaf: check_reals("a parameter", leaf), params)
    period_n = check_int("period_n", period_n)
    return call_compiled_program(
        _find_gait, (system, period_n), params, check_reals("guess", guess), options
    )


def _evaluate_invariant(invariant: Callable, system: HybridSystem, params: Any, x: Array) -> Array:
    return invariant(system.embed(x, params), params)


def _find_gait(
    system_and_period: tuple[HybridSystem, int], params: Any, guess: Array, options: StepOptions
) -> HybridGait:
    system, period_n = system_and_period
    fixed_point = solve_fixed_point_implicit(
        system.return_map(params, options),
        guess,
        period_n=period_n,
        invariants=[
            functools.partial(_evaluate_invariant, invariant, system, params)
            for invariant in system.invariants
        ],
    )
    x, period = fixed_point.x, jnp.zeros((), fixed_point.x.dtype)
    for _ in range(period_n):
        step = system.step(params, x, options)
        x, period = step.section_state, period + step.duration
    return HybridGait(fixed_point.x, period, step, fixed_point)
