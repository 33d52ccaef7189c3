"""Results of batches of walks, and their derivatives with respect to starts and parameters."""

import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

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
    """How the end of a walk moves with its start or a parameter; the start and parameters that are
    arrays over steps have an axis of their own."""

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


class StepwiseParameter(NamedTuple):
    """A parameter that one step moves with in several places, or that is an array over steps."""

    inputs: tuple[int, ...]  # its places among the numbers of a step
    size: int | None  # values of a lane; None: one that is no array
    parts: Callable[[int], tuple[tuple[int, int, float], ...]]
    """Of a step: which of the inputs, which value, and how the one moves with the other."""


def complete_batch_slopes(slopes: np.ndarray, n_steps: int) -> np.ndarray:
    """Slopes of the lines that n steps use, (n_steps + 1, lanes): the last of n is used twice."""
    return slopes.T if slopes.shape[1] > n_steps else np.concatenate([slopes.T, slopes.T[-1:]])


class WalkBatch:
    """Batch of walks in progress. Lanes are the last axis of every array."""

    def __init__(
        self,
        states: np.ndarray,
        derivative_names: Sequence[str],
        parameters: tuple[str, ...],
        over_steps: Mapping[str, StepwiseParameter],
    ) -> None:
        """`asked`: START and names of these parameters, which lead the numbers of a lane; some may
        be `over_steps`."""
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
        own = lambda name: StepwiseParameter(
            (parameters.index(name),), None, lambda _: ((0, 0, 1.0),)
        )
        self.columns = [over_steps.get(name, own(name)) for name in self.parameter_names]
        inputs = [i for column in self.columns for i in column.inputs]
        self.input_indices = (*inputs, *state_inputs) if derivative_names else ()
        rows = [1 if column.size is None else column.size for column in self.columns]
        self.begins = np.cumsum([0, *rows])  # of each name's rows, then of the start's
        self.simple = not over_steps
        n_rows = self.begins[-1] + state_size if derivative_names else 0
        self.jacobian = np.zeros((n_rows, state_size + 3, n_lanes), states.dtype)

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
        jacobian, state_size = self.jacobian.take(inverse_order, -1).T, len(self.section_state)
        columns_by_name: dict[str, Any] = {START_NAME: slice(self.begins[-1], None)}
        for name, column, begin in zip(
            self.parameter_names, self.columns, self.begins[:-1], strict=True
        ):
            columns_by_name[name] = (
                begin if column.size is None else slice(begin, begin + column.size)
            )
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
        if not self.simple:
            return self._after_uneven(index, step_jacobian)
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

    def _after_uneven(self, some: Any, by: np.ndarray) -> np.ndarray:
        """The same, with rows for each value over steps; later steps' values move nothing yet."""
        size, start = len(self.section_state), self.begins[-1]
        n = len(by) - size
        k = int(np.max(self.n_stepped[some], initial=0))
        total = np.zeros((len(self.jacobian), *by.shape[1:]), by.dtype)
        if k == 0:
            total[start:] = by[n:]
        else:
            known = [range(b, min(b + k + 1, e)) for b, e in itertools.pairwise(self.begins)]
            rows = np.array([*itertools.chain(*known), *range(start, len(total))])
            before = self.jacobian[rows, :size][..., some]
            total[rows] = sum(by[n + i] * before[:, i, None] for i in range(size))
        first = 0
        for column, begin in zip(self.columns, self.begins[:-1], strict=True):
            for which, value, factor in column.parts(k):
                total[begin + value] += factor * by[first + which]
            first += len(column.inputs)
        return total


def lane_index(lanes: np.ndarray, walks: WalkBatch) -> Any:
    """Return an index of these lanes, which copies nothing if they are all lanes."""
    return slice(None) if len(lanes) == len(walks.outcome) else lanes


def _replace_lanes(values: np.ndarray, index: Any, new_values: np.ndarray) -> np.ndarray:
    """Replace the values of some lanes and return the array."""
    if isinstance(index, slice):
        return new_values
    values[..., index] = new_values
    return values
