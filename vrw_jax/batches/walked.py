"""What a batch of walks tells of its lanes, and how that moves with their starts and parameters."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from vrw_jax.wheel import Outcome
from vrw_jax.wording import AbstractTold, Row, counted, told


class By(eqx.Module):
    """How the end of a walk moves with its start, which has an axis of its own, or a parameter."""

    section_state: Float[Array, "lanes section *start"]
    durations: Float[Array, "lanes 3 *start"]


class Steps(AbstractTold):
    """Lean results of walks of some steps, leading axis: lanes; each tells of its last step.

    - `section_state`: before the next touchdown; zeros if it failed;
    - `durations`: of DLS, SLS-I, SLS-II, s; on real ground see its step;
    - `outcome`: an Outcome; the walk ends at the first that is not STEPPED;
    - `n_stepped`: steps that ended in a touchdown;
    - `solver_steps`: tried by the integrator, over all steps;
    - `fixed`: whether the last step was taken in fixed work, by collocation;
    - `solver`: which of `solvers` took the lane: "auto" goes by stiffness;
    - `engine`: that computed it: "lanes", "diffrax" or "collocation";
    - `solvers`: the named one first;
    - `derivatives`: by what was asked for.

    Examples:
        >>> params, states = vrw.WheelParams(damping=150.0), np.tile(vrw.paper_start(), (3, 1))
        >>> vrw.steps(params, states).outcome.tolist()
        [0, 0, 0]
    """

    section_state: Float[Array, "lanes section"]
    durations: Float[Array, "lanes 3"]
    outcome: Int[Array, " lanes"]
    n_stepped: Int[Array, " lanes"]
    solver_steps: Int[Array, " lanes"]
    fixed: Bool[Array, " lanes"]
    solver: Int[Array, " lanes"]
    engine: str = eqx.field(static=True)
    solvers: tuple[str, ...] = eqx.field(static=True)
    derivatives: dict[str, By] = eqx.field(default_factory=dict)

    def rows(self) -> list[Row]:
        n = np.bincount(np.ravel(self.solver), minlength=len(self.solvers))
        by = (f"{count:,} by {name}" for count, name in zip(n, self.solvers, strict=True) if count)
        return [
            ("lanes", counted(self.outcome, Outcome)),
            ("steps each", told(self.n_stepped, "")),
            ("engine", f"{self.engine}; {', '.join(by)}"),
            ("duration of the last step", told(self.durations.sum(-1), "s")),
        ]


START = "section_state"


class Walked:
    def __init__(
        self, states: np.ndarray, asked: Sequence[str], parameters: tuple[str, ...]
    ) -> None:
        """`asked`: START and names of these parameters, which lead the numbers of a lane."""
        n, size = states.shape
        self.section_state, self.durations = states.copy(), np.zeros((n, 3), states.dtype)
        self.outcome, self.n_stepped, self.solver_steps = (np.zeros(n, np.int32) for _ in range(3))
        self.fixed = np.zeros(n, bool)
        # Of a step, and of the walk: by the start and then by the other names asked for.
        self.asked, self.names = asked, [name for name in asked if name != START]
        state = range(len(parameters), len(parameters) + size)
        self.moved = (*(parameters.index(x) for x in self.names), *state) if asked else ()
        shape = (n if asked else 0, size + 3, size + len(self.names))
        self.jacobian = np.zeros(shape, states.dtype)
        self.jacobian[:, :size, :size] = np.eye(size)

    def told(self, solver: np.ndarray, engine: str, solvers: tuple[str, ...]) -> Steps:
        fields = self.section_state, self.durations, self.outcome, self.n_stepped
        told = *fields, self.solver_steps, self.fixed, solver
        return told_steps(told, engine, solvers, self.derivatives())

    def derivatives(self) -> dict[str, By]:
        """Of the walk, by what was asked for; zero where it failed."""
        if not self.asked:
            return {}
        stepped = (self.outcome == Outcome.STEPPED)[:, None, None]
        by = np.where(stepped, self.jacobian, 0.0)
        size = self.section_state.shape[1]
        columns: dict[str, Any] = {name: size + i for i, name in enumerate(self.names)}
        columns[START] = slice(size)
        told = {name: by[:, :, columns[name]] for name in self.asked}
        return {name: By(*jax.device_put((x[:, :size], x[:, size:]))) for name, x in told.items()}

    def take(self, lanes: np.ndarray, told: tuple[np.ndarray, ...], fixed: bool) -> None:
        state, durations, outcome, tried, *jacobian = told
        self.section_state[lanes], self.durations[lanes] = state, durations
        self.outcome[lanes] = outcome
        self.n_stepped[lanes] += outcome == Outcome.STEPPED
        self.solver_steps[lanes] += tried
        self.fixed[lanes] = fixed
        if jacobian:
            (by,), n, size = jacobian, len(self.names), state.shape[1]
            before = self.jacobian[lanes, :size]
            self.jacobian[lanes] = by[:, :, n:] @ before
            self.jacobian[lanes, :, size:] += by[:, :, :n]


def told_steps(
    told: tuple[Any, ...], engine: str, solvers: tuple[str, ...], by: dict[str, By]
) -> Steps:
    """Of numpy's arrays, which are put side by side: one by one JAX compiles a copy of each."""
    x, durations, outcome, n_stepped, tried, fixed, solver = jax.device_put(told)
    return Steps(x, durations, outcome, n_stepped, tried, fixed, solver, engine, solvers, by)
