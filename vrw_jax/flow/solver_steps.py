"""Single Runge-Kutta steps with an error estimate, for the search that integrates a phase.

A stepper takes one step at a time, so that the search decides about the length of each. Explicit
methods are computed here, for JAX and for machine code. diffrax takes the steps of implicit
methods, and of all methods with `engine="diffrax"`.
"""

from __future__ import annotations

import abc
import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool

from vrw_jax.base.options import StepOptions
from vrw_jax.base.types import Scalar
from vrw_jax.flow.diffrax_minima import StateArray
from vrw_jax.flow.tableaus import (
    MIN_STEP_LENGTH_RATIO,
    STEP_LENGTH_SAFETY_FACTOR,
    ButcherTableau,
    load_explicit_tableau,
)
from vrw_jax.lanes.lowering import mark_noinline

if TYPE_CHECKING:
    import diffrax

VectorField = Callable[[StateArray], StateArray]
"""Autonomous vector field of a phase: function that returns the time derivative of the state."""

MAX_STEP_GROWTH = 2.0
"""Largest ratio of the lengths of successive solver steps.

The error estimate for a solver step far shorter than needed is round-off. A length derived from
that estimate would grow without bound. The result for a batch element would then differ by
1e-12 from the result for the same system alone. The value is chosen to avoid this difference,
which is more than a hundred times the round-off.
"""


@dataclass(frozen=True)
class AbstractStepper(abc.ABC):
    """Solver steps in one vector field."""

    field: VectorField

    @abc.abstractmethod
    def start(self, y: StateArray, options: StepOptions) -> tuple[StateArray, Any, Any]:
        """Return the time derivative at `y`, and memory and control state before the first step."""

    @abc.abstractmethod
    def step(
        self, y: StateArray, memory: Any, h: Scalar
    ) -> tuple[StateArray, StateArray, StateArray, Any]:
        """Return the state after a step of `h`, s, its derivative, the error, and the memory."""

    @abc.abstractmethod
    def control(
        self,
        ends: tuple[StateArray, StateArray],
        error: StateArray,
        h: Scalar,
        control_state: Any,
    ) -> tuple[Bool[Array, ""], Scalar, Any]:
        """Return whether the error of a step is acceptable, and the next length, s.

        The results have no derivatives, because only solver steps are differentiated.
        """


@dataclass(frozen=True)
class ExplicitStepper(AbstractStepper):
    """Steps of an explicit method. The memory is the time derivative of the state."""

    tableau: ButcherTableau
    rtol: Scalar
    atol: Scalar

    def start(self, y: StateArray, options: StepOptions) -> tuple[StateArray, Any, Any]:
        rate = self.field(y)
        return rate, rate, ()

    def step(
        self, y: StateArray, memory: Any, h: Scalar
    ) -> tuple[StateArray, StateArray, StateArray, Any]:
        def weighted_sum(weights: np.ndarray) -> StateArray:
            # Small terms first: so the weights of Dopri8 add up to 1 without round-off.
            indices = sorted(np.flatnonzero(weights), key=lambda i: abs(weights[i]))
            return functools.reduce(jnp.add, [float(weights[i]) * rates[i] for i in indices])

        rates = [memory]
        field = mark_noinline(self.field)
        end = y
        for row in self.tableau.stage_matrix[1:]:
            end = y + h * weighted_sum(row)
            rates.append(field(end))
        return end, rates[-1], h * weighted_sum(self.tableau.rate_error_weights), rates[-1]

    def control(
        self,
        ends: tuple[StateArray, StateArray],
        error: StateArray,
        h: Scalar,
        control_state: Any,
    ) -> tuple[Bool[Array, ""], Scalar, Any]:
        (start, end), error, h = lax.stop_gradient((ends, error, h))
        tolerance = self.atol + self.rtol * jnp.maximum(jnp.abs(start), jnp.abs(end))
        scaled = error / tolerance
        mean_square = jnp.mean(scaled * scaled)
        mean_square = jnp.where(jnp.isfinite(mean_square), mean_square, jnp.inf)
        power = -0.5 / self.tableau.convergence_order
        factor = STEP_LENGTH_SAFETY_FACTOR * jnp.exp(
            jnp.log(jnp.clip(mean_square, 1e-30, 1e30)) * power
        )
        is_accepted = mean_square <= 1.0
        limit = jnp.where(is_accepted, MAX_STEP_GROWTH, 1.0)
        return is_accepted, h * jnp.clip(factor, MIN_STEP_LENGTH_RATIO, limit), ()


@dataclass(frozen=True)
class DiffraxStepper(AbstractStepper):
    """Steps of a solver of diffrax, with its step-size controller."""

    diffrax_solver: diffrax.AbstractAdaptiveSolver
    step_size_controller: diffrax.PIDController
    ode_term: diffrax.ODETerm

    def start(self, y: StateArray, options: StepOptions) -> tuple[StateArray, Any, Any]:
        no_time = jnp.zeros((), y.dtype)
        _, control_state = self.step_size_controller.init(
            self.ode_term,
            no_time,
            options.dt0,
            lax.stop_gradient(y),
            options.dt0,
            None,
            lambda terms, t, y, args: terms.vf(t, y, args),
            self.diffrax_solver.error_order(self.ode_term),
        )
        memory = self.diffrax_solver.init(self.ode_term, no_time, options.dt0, y, None)
        return self.field(y), memory, control_state

    def step(
        self, y: StateArray, memory: Any, h: Scalar
    ) -> tuple[StateArray, StateArray, StateArray, Any]:
        import diffrax  # This import is slow.

        end, error, _, memory, result = self.diffrax_solver.step(
            self.ode_term, jnp.zeros_like(h), h, y, None, memory, jnp.asarray(False)
        )
        if error is None:
            raise ValueError(
                f"{type(self.diffrax_solver).__name__} gives no error estimate, but the step size "
                "is controlled by one: take 'Dopri8', 'Tsit5' or 'Kvaerno5'."
            )
        error = jnp.where(result == diffrax.RESULTS.successful, error, jnp.inf)
        return end, self.field(end), error, memory

    def control(
        self,
        ends: tuple[StateArray, StateArray],
        error: StateArray,
        h: Scalar,
        control_state: Any,
    ) -> tuple[Bool[Array, ""], Scalar, Any]:
        (start, end), error = lax.stop_gradient((ends, error))
        is_finite = jnp.all(jnp.isfinite(end))
        is_accepted, next_start, next_end, _, control_state, _ = (
            self.step_size_controller.adapt_step_size(
                jnp.zeros_like(h),
                h,
                start,
                jnp.where(is_finite, end, start),
                None,
                jnp.where(is_finite, error, jnp.inf),
                self.diffrax_solver.error_order(self.ode_term),  # type: ignore[arg-type]
                control_state,
            )
        )
        return jnp.asarray(is_accepted), jnp.asarray(next_end - next_start), control_state


def make_stepper(field: VectorField, options: StepOptions) -> AbstractStepper:
    """Return the stepper that `options` select for a vector field.

    diffrax takes the steps of implicit solvers, and of all solvers with `engine="diffrax"`.
    """
    tableau = load_explicit_tableau(options.solver)
    if tableau is not None and options.engine != "diffrax":
        return ExplicitStepper(field, tableau, options.rtol, options.atol)
    import diffrax  # This import is slow.

    solver_class = getattr(diffrax, options.solver)
    field_names = solver_class.__dataclass_fields__
    settings: dict[str, Any] = {}
    tolerances: dict[str, Any] = {"rtol": options.rtol, "atol": options.atol}
    if "scan_kind" in field_names:
        settings["scan_kind"] = "lax"  # for forward-mode derivatives
    if "root_finder" in field_names:
        settings["root_finder"] = diffrax.VeryChord(**tolerances)
    return DiffraxStepper(
        field,
        solver_class(**settings),
        diffrax.PIDController(**tolerances, factormax=MAX_STEP_GROWTH),
        diffrax.ODETerm(lambda t, y, args: field(y)),
    )
