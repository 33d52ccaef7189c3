"""Results of batches of walks, and their derivatives with respect to starts and parameters."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float, Int

from vrw_jax.wheel import Outcome
from vrw_jax.wording import AbstractTold, Row, counted, told


class By(eqx.Module):
    """Derivative of the end of a walk with respect to a parameter, or to the start, which adds an
    axis."""

    section_state: Float[np.ndarray, "lanes section *start"]
    durations: Float[np.ndarray, "lanes 3 *start"]


class Steps(AbstractTold):
    """Results of batches of walks for the last step of each element. The leading axis is the batch.

    Arrays are numpy arrays: the conversion of thousands of values to JAX takes as long as some
    hundred steps.

    - `section_state`: before the next touchdown; zeros if the step failed;
    - `durations`: of DLS, SLS-I, SLS-II, s; with unilateral contact see its step;
    - `outcome`: an Outcome; the walk ends at the first that is not STEPPED;
    - `n_stepped`: number of steps that ended in a touchdown;
    - `solver_steps`: tried by the integrator, over all steps;
    - `is_collocated`: whether the last step was taken in fixed work, by collocation;
    - `solver_index`: index in `solver_names` of the solver of the element; "auto" selects by
      stiffness;
    - `engine`: "lanes", "diffrax" or "collocation";
    - `solver_names`: the named one first;
    - `derivatives`: by name of the requested input.

    Examples:
        >>> params, states = vrw.WheelParams(damping=150.0), np.tile(vrw.paper_start(), (3, 1))
        >>> vrw.step_batch(params, states).outcome.tolist()
        [0, 0, 0]
    """

    section_state: Float[np.ndarray, "lanes section"]
    durations: Float[np.ndarray, "lanes 3"]
    outcome: Int[np.ndarray, " lanes"]
    n_stepped: Int[np.ndarray, " lanes"]
    solver_steps: Int[np.ndarray, " lanes"]
    fixed: Bool[np.ndarray, " lanes"]
    solver: Int[np.ndarray, " lanes"]
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
    """Batch of walks in progress. Lanes are the last axis of every array."""

    def __init__(
        self, states: np.ndarray, asked: Sequence[str], parameters: tuple[str, ...]
    ) -> None:
        """Start walks. `derivative_names` are START_NAME and names of these parameters, the first
        values of a lane."""
        size, n = states.shape
        self.section_state, self.durations = states, np.zeros((3, n), states.dtype)
        self.outcome, self.n_stepped, self.solver_steps = np.zeros((3, n), np.int32)
        self.fixed = np.zeros(n, bool)
        # Inputs of the Jacobian: the requested parameters, then the start.
        self.asked, self.names = asked, [name for name in asked if name != START]
        state = range(len(parameters), len(parameters) + size)
        self.moved = (*(parameters.index(x) for x in self.names), *state) if asked else ()
        self.jacobian = np.zeros((len(self.moved), size + 3, n), states.dtype)

    def on(self) -> np.ndarray:
        """Return the indices of the lanes that continue."""
        return np.flatnonzero(self.outcome == Outcome.STEPPED)

    def told(
        self, order: np.ndarray, solver: np.ndarray, engine: str, solvers: tuple[str, ...]
    ) -> Steps:
        """Return the result, with each lane at its index before sorting by `order`."""
        back = np.empty_like(order)
        back[order] = np.arange(len(order))
        there = lambda x: x.take(back, -1).T
        return Steps(
            there(self.section_state),
            there(self.durations),
            there(self.outcome),
            there(self.n_stepped),
            there(self.solver_steps),
            there(self.fixed),
            there(solver),
            engine,
            solvers,
            self.derivatives(back),
        )

    def derivatives(self, back: np.ndarray) -> dict[str, By]:
        """Return the derivatives of the walk by name of the input; zero where it failed."""
        if not self.asked:
            return {}
        self.jacobian[..., self.outcome != Outcome.STEPPED] = 0.0
        by, n, size = self.jacobian.take(back, -1).T, len(self.names), len(self.section_state)
        columns: dict[str, Any] = {name: i for i, name in enumerate(self.names)}
        columns[START] = slice(n, None)
        told = {name: by[:, :, columns[name]] for name in self.asked}
        return {name: By(x[:, :size], x[:, size:]) for name, x in told.items()}

    def take(self, lanes: np.ndarray, told: tuple[np.ndarray, ...], fixed: np.ndarray) -> None:
        """Record a step of these lanes: state, durations, outcome, solver steps and Jacobian."""
        state, durations, outcome, tried, *by = told
        some = only(lanes, self)
        if by:
            self.jacobian = _put(self.jacobian, some, self._after(some, *by))
        self.section_state = _put(self.section_state, some, state)
        self.durations = _put(self.durations, some, durations)
        self.outcome = _put(self.outcome, some, outcome)
        self.fixed = _put(self.fixed, some, fixed)
        self.n_stepped[some] += outcome == Outcome.STEPPED
        self.solver_steps[some] += tried

    def _after(self, some: Any, by: np.ndarray) -> np.ndarray:
        """Return the Jacobian of the walk from that of its last step, (columns, rows, lanes).

        Products are summed one by one, so that a lane's digits do not depend on the batch.
        """
        n, size = len(self.names), len(self.section_state)
        if not self.n_stepped[some].any():
            return by
        before = self.jacobian[:, :size, some]
        moved = sum(by[n + i] * before[:, i, None] for i in range(size))
        moved[:n] += by[:n]
        return moved


def only(lanes: np.ndarray, walked: Walked) -> Any:
    """Return an index of these lanes, which copies nothing if they are all lanes."""
    return slice(None) if len(lanes) == len(walked.outcome) else lanes


def _put(values: np.ndarray, some: Any, part: np.ndarray) -> np.ndarray:
    """Replace the values of some lanes and return the array."""
    if isinstance(some, slice):
        return part
    values[..., some] = part
    return values
