"""Return maps of hybrid simulations: they carry the termination of each simulation."""

import dataclasses
from collections.abc import Callable, Sequence

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from vrw_jax.hybrid.minima import StateVector
from vrw_jax.hybrid.simulation import HybridSolution, Mode, Termination, simulate_hybrid
from vrw_jax.numerics import StepOptions


@dataclasses.dataclass(frozen=True, eq=False)
class ReturnMap:
    """Map of section coordinates to those after `events` events of a hybrid simulation.

    It is NaN if the simulation ends early, so that no method mistakes its last state for a return.
    `solve_fixed_point` reports the termination with the point.

    - `modes`: as in `simulate_hybrid`;
    - `embed`: the state of given section coordinates, where the simulation begins;
    - `project`: section coordinates of a state, past the last event;
    - `events`: of one return;
    - `mode`: in which the simulation begins;
    - `options`: of the simulation.
    """

    modes: Sequence[Mode] | Mode
    embed: Callable[[Float[Array, " n"]], StateVector]
    project: Callable[[StateVector], Float[Array, " n"]]
    events: int = 1
    mode: int = 0
    options: StepOptions | None = None

    def simulate(self, x: Float[Array, " n"]) -> HybridSolution:
        """Return the simulation from section coordinates `x`."""
        start, events = self.embed(x), self.events
        return simulate_hybrid(
            self.modes, start, events=events, mode=self.mode, options=self.options
        )

    def __call__(self, x: Float[Array, " n"]) -> Float[Array, " n"]:
        """Return the next section coordinates; NaN if the simulation ended early."""
        solution = self.simulate(x)
        section = self.project(solution.state)
        return section * jnp.where(
            solution.termination == Termination.MAX_EVENTS_REACHED, 1.0, jnp.nan
        ).astype(section.dtype)

    def find_termination(self, x: Float[Array, " n"], period_n: int = 1) -> Int[Array, ""]:
        """Return the `Termination` of the first of `period_n` returns that ends early."""
        x = lax.stop_gradient(x)
        termination = jnp.full((), int(Termination.MAX_EVENTS_REACHED), jnp.int32)
        for _ in range(period_n):
            solution = self.simulate(x)
            termination = jnp.where(
                termination == Termination.MAX_EVENTS_REACHED, solution.termination, termination
            )
            x = self.project(solution.state)
        return termination
