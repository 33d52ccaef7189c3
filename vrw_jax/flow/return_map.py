"""Return maps of hybrid systems, with the termination of each simulation."""

import dataclasses
from collections.abc import Callable, Sequence

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from vrw_jax.base.options import StepOptions
from vrw_jax.flow.hybrid_simulation import HybridSolution, Mode, Termination, simulate_hybrid
from vrw_jax.flow.phase_integration import StateArray


@dataclasses.dataclass(frozen=True, eq=False)
class ReturnMap:
    """Map from section coordinates to the section coordinates after `events` events.

    The map returns NaN if the simulation ends early, so that its last state is not taken for a
    return. `solve_fixed_point` reports the termination of the simulation in addition to the fixed
    point.

    - `modes`: modes of the system, as in `simulate_hybrid`;
    - `embed`: function from section coordinates to the state in which the simulation begins;
    - `project`: function from the state after the last event to its section coordinates;
    - `events`: number of events per return;
    - `mode`: index of the mode in which the simulation begins;
    - `options`: options of the simulation.
    """

    modes: Sequence[Mode] | Mode
    embed: Callable[[Float[Array, " n"]], StateArray]
    project: Callable[[StateArray], Float[Array, " n"]]
    events: int = 1
    mode: int = 0
    options: StepOptions | None = None

    def simulate(self, x: Float[Array, " n"]) -> HybridSolution:
        """Return the simulation that begins at section coordinates `x`, shape (n,)."""
        return simulate_hybrid(
            self.modes, self.embed(x), events=self.events, mode=self.mode, options=self.options
        )

    def __call__(self, x: Float[Array, " n"]) -> Float[Array, " n"]:
        """Return the section coordinates after one return from `x`, shape (n,).

        The result is NaN if the simulation ends early.
        """
        hybrid_solution = self.simulate(x)
        section_coordinates = self.project(hybrid_solution.state)
        return section_coordinates * jnp.where(
            hybrid_solution.termination == Termination.MAX_EVENTS_REACHED, 1.0, jnp.nan
        ).astype(section_coordinates.dtype)

    def find_termination(self, x: Float[Array, " n"], period_n: int = 1) -> Int[Array, ""]:
        """Return the `Termination` of the first of `period_n` returns from `x` that ends early.

        If no return ends early, the result is the termination of the last return.
        """
        x = lax.stop_gradient(x)
        termination = jnp.full((), Termination.MAX_EVENTS_REACHED, jnp.int32)
        for _ in range(period_n):
            solution = self.simulate(x)
            termination = jnp.where(
                termination == Termination.MAX_EVENTS_REACHED, solution.termination, termination
            )
            x = self.project(solution.state)
        return termination
