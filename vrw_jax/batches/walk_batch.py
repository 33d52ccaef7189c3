"""Results of batches of walks, and their derivatives with respect to starts and parameters."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float, Int

from vrw_jax.printing import (
    AbstractPrintable,
    TextRow,
    describe_ending,
    format_outcome_counts,
    format_quantity,
)
from vrw_jax.wheel import Outcome


class StepSensitivity(eqx.Module):
    """Derivative of the end of a walk with respect to a parameter, or to the start, which adds an
    axis."""

    section_state: Float[np.ndarray, "lanes section *start"]
    durations: Float[np.ndarray, "lanes 3 *start"]


class StepBatchResult(AbstractPrintable):
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
    is_collocated: Bool[np.ndarray, " lanes"]
    solver_index: Int[np.ndarray, " lanes"]
    engine: str = eqx.field(static=True)
    solver_names: tuple[str, ...] = eqx.field(static=True)
    derivatives: dict[str, StepSensitivity] = eqx.field(default_factory=dict)

    @property
    def ending(self) -> str:
        """Return how the walks ended, as a sentence; for a batch, each sentence with its count."""
        return describe_ending(self.outcome, Outcome)

    def summary_rows(self) -> list[TextRow]:
        n_by_solver = np.bincount(np.ravel(self.solver_index), minlength=len(self.solver_names))
        solver_texts = (
            f"{count:,} by {name}"
            for count, name in zip(n_by_solver, self.solver_names, strict=True)
            if count
        )
        return [
            ("lanes", format_outcome_counts(self.outcome, Outcome)),
            ("steps each", format_quantity(self.n_stepped, "")),
            ("engine", f"{self.engine}; {', '.join(solver_texts)}"),
            ("duration of the last step", format_quantity(self.durations.sum(-1), "s")),
        ]


START_NAME = "section_state"


class WalkBatch:
    """Batch of walks in progress. Lanes are the last axis of every array."""

    def __init__(
        self, states: np.ndarray, derivative_names: Sequence[str], parameters: tuple[str, ...]
    ) -> None:
        """Start walks. `derivative_names` are START_NAME and names of these parameters, the first
        values of a lane."""
        state_size, n_lanes = states.shape
        self.section_state, self.durations = states, np.zeros((3, n_lanes), states.dtype)
        self.outcome, self.n_stepped, self.solver_steps = np.zeros((3, n_lanes), np.int32)
        self.is_collocated = np.zeros(n_lanes, bool)
        # Inputs of the Jacobian: the requested parameters, then the start.
        self.derivative_names, self.parameter_names = (
            derivative_names,
            [name for name in derivative_names if name != START_NAME],
        )
        state_inputs = range(len(parameters), len(parameters) + state_size)
        self.input_indices = (
            (*(parameters.index(x) for x in self.parameter_names), *state_inputs)
            if derivative_names
            else ()
        )
        self.jacobian = np.zeros((len(self.input_indices), state_size + 3, n_lanes), states.dtype)

    def active_lanes(self) -> np.ndarray:
        """Return the indices of the lanes that continue."""
        return np.flatnonzero(self.outcome == Outcome.STEPPED)

    def to_result(
        self,
        order: np.ndarray,
        solver_index: np.ndarray,
        engine: str,
        solver_names: tuple[str, ...],
    ) -> StepBatchResult:
        """Return the result, with each lane at its index before sorting by `order`."""
        inverse_order = np.empty_like(order)
        inverse_order[order] = np.arange(len(order))
        reorder = lambda x: x.take(inverse_order, -1).T
        return StepBatchResult(
            reorder(self.section_state),
            reorder(self.durations),
            reorder(self.outcome),
            reorder(self.n_stepped),
            reorder(self.solver_steps),
            reorder(self.is_collocated),
            reorder(solver_index),
            engine,
            solver_names,
            self.named_derivatives(inverse_order),
        )

    def named_derivatives(self, inverse_order: np.ndarray) -> dict[str, StepSensitivity]:
        """Return the derivatives of the walk by name of the input; zero where it failed."""
        if not self.derivative_names:
            return {}
        self.jacobian[..., self.outcome != Outcome.STEPPED] = 0.0
        jacobian, n_parameters, state_size = (
            self.jacobian.take(inverse_order, -1).T,
            len(self.parameter_names),
            len(self.section_state),
        )
        columns_by_name: dict[str, Any] = {name: i for i, name in enumerate(self.parameter_names)}
        columns_by_name[START_NAME] = slice(n_parameters, None)
        jacobian_by_name = {
            name: jacobian[:, :, columns_by_name[name]] for name in self.derivative_names
        }
        return {
            name: StepSensitivity(x[:, :state_size], x[:, state_size:])
            for name, x in jacobian_by_name.items()
        }

    def record_step(
        self, lanes: np.ndarray, step_values: tuple[np.ndarray, ...], is_collocated: np.ndarray
    ) -> None:
        """Record a step of these lanes: state, durations, outcome, solver steps and Jacobian."""
        section_state, durations, outcome, n_solver_steps, *step_jacobian = step_values
        index = lane_index(lanes, self)
        if step_jacobian:
            self.jacobian = _replace_lanes(
                self.jacobian, index, self._chain_jacobian(index, *step_jacobian)
            )
        self.section_state = _replace_lanes(self.section_state, index, section_state)
        self.durations = _replace_lanes(self.durations, index, durations)
        self.outcome = _replace_lanes(self.outcome, index, outcome)
        self.is_collocated = _replace_lanes(self.is_collocated, index, is_collocated)
        self.n_stepped[index] += outcome == Outcome.STEPPED
        self.solver_steps[index] += n_solver_steps

    def _chain_jacobian(self, index: Any, step_jacobian: np.ndarray) -> np.ndarray:
        """Return the Jacobian of the walk from that of its last step, (columns, rows, lanes).

        Products are summed one by one, so that a lane's digits do not depend on the batch.
        """
        n_parameters, state_size = len(self.parameter_names), len(self.section_state)
        if not self.n_stepped[index].any():
            return step_jacobian
        previous_jacobian = self.jacobian[:, :state_size, index]
        chained = sum(
            step_jacobian[n_parameters + i] * previous_jacobian[:, i, None]
            for i in range(state_size)
        )
        chained[:n_parameters] += step_jacobian[:n_parameters]
        return chained


def lane_index(lanes: np.ndarray, walks: WalkBatch) -> Any:
    """Return an index of these lanes, which copies nothing if they are all lanes."""
    return slice(None) if len(lanes) == len(walks.outcome) else lanes


def _replace_lanes(values: np.ndarray, index: Any, new_values: np.ndarray) -> np.ndarray:
    """Replace the values of some lanes and return the array."""
    if isinstance(index, slice):
        return new_values
    values[..., index] = new_values
    return values
