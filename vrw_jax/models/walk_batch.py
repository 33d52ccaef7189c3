"""Walks of batches of walkers, and derivatives with respect to their starts and parameters."""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from vrw_jax.base.outcomes import Outcome, describe_outcomes
from vrw_jax.base.printing import (
    AbstractPrintable,
    LabelAndText,
    format_outcome_counts,
    format_quantity,
)


class StepSensitivity(eqx.Module):
    """Derivatives of the last section state and durations of walks with respect to one input.

    The input is the start or a parameter. The arrays have an additional last axis if the input is
    the start, or a parameter that varies over gait steps.
    """

    section_state: Float[np.ndarray, "lanes section *start"]
    durations: Float[np.ndarray, "lanes 3 *start"]


class StepBatchResult(AbstractPrintable):
    """Results of the last gait step of each walk in a batch; the first axis of every array is that
    of the batch.

    Arrays are NumPy arrays, because a conversion of thousands of values to JAX takes as long as
    some hundred gait steps.

    - `section_state`: state before the next touchdown; zeros if the step failed;
    - `durations`: durations of DLS, SLS-I and SLS-II, s; see `UnilateralWheel` for unilateral
      contact. For a walker of yours, durations of its modes;
    - `outcome`: `Outcome` of the walk, which ends at the first outcome that is not STEPPED;
    - `n_stepped`: number of gait steps that ended in a touchdown;
    - `solver_steps`: number of attempted solver steps, summed over all gait steps;
    - `solver_index`: index of the element's solver in `solver_names`, which "auto" selects by
      stiffness;
    - `engine`: "lanes" or "diffrax";
    - `solver_names`: names of the solvers; the first is the solver in the options;
    - `derivatives`: `StepSensitivity` by the name of the requested input;
    - `section`: name of the section of a walker of yours, for printing.

    Examples:
        >>> params, states = vrw.WheelParams(damping=150.0), np.tile(vrw.paper_start(), (3, 1))
        >>> vrw.step_batch(params, states).outcome.tolist()
        [0, 0, 0]
    """

    section_state: Float[np.ndarray, "lanes section"]
    durations: Float[np.ndarray, "lanes phases"]
    outcome: Int[np.ndarray, " lanes"]
    n_stepped: Int[np.ndarray, " lanes"]
    solver_steps: Int[np.ndarray, " lanes"]
    solver_index: Int[np.ndarray, " lanes"]
    engine: str = eqx.field(static=True)
    solver_names: tuple[str, ...] = eqx.field(static=True)
    derivatives: dict[str, StepSensitivity] = eqx.field(default_factory=dict)
    section: str = eqx.field(static=True, default="")

    @property
    def ending(self) -> Any:
        """Return one sentence on the end of each walk, as an array over the batch."""
        return describe_outcomes(self.outcome, self.section)

    def summary_rows(self) -> list[LabelAndText]:
        """Return pairs of label and text for outcomes, numbers of gait steps, engine and time."""
        n_lanes_by_solver = np.bincount(
            np.ravel(self.solver_index), minlength=len(self.solver_names)
        )
        solver_count_texts = (
            f"{n_elements:,} by {solver_name}"
            for n_elements, solver_name in zip(n_lanes_by_solver, self.solver_names, strict=True)
            if n_elements
        )
        return [
            ("lanes", format_outcome_counts(self.outcome, Outcome)),
            ("steps each", format_quantity(self.n_stepped, "")),
            ("engine", f"{self.engine}; {', '.join(solver_count_texts)}"),
            ("duration of the last step", format_quantity(self.durations.sum(-1), "s")),
        ]


START_INPUT_NAME = "section_state"


class StepInput(NamedTuple):
    """One input of every step, for all lanes, and its derivatives with respect to the argument that
    it is computed from.
    """

    argument: str
    values: np.ndarray  # (lanes,), or (n_steps, lanes) if they differ from step to step
    list_terms: Callable[[int], list[tuple[int, float]]] = lambda k: [(0, 1.0)]
    """Function that maps the index of a step to pairs of the index of a value of the argument, and
    the derivative by this value.
    """
    n_argument_values: int | None = None  # for each lane; None for a single number

    def select_values(self, k: int) -> np.ndarray:
        """Return the values in step `k`, one for each lane."""
        return self.values[k] if self.values.ndim > 1 else self.values


def make_step_input(
    argument: str, values: np.ndarray, n_steps: int, n_lanes: int, offset: int = 0
) -> StepInput:
    """Return the input that is the value of an argument in each step, or in one `offset` steps
    later.

    `values` is a number, or has the shape (lanes,) or (lanes, values). The first and the last value
    continue beyond the walk.
    """
    if values.ndim < 2:
        return StepInput(argument, np.broadcast_to(values, n_lanes))
    n_values = values.shape[1]
    index = np.clip(np.arange(n_steps) + offset, 0, n_values - 1)
    return StepInput(argument, values.T[index], lambda k: [(index[k], 1.0)], n_values)


def list_rises(heights: np.ndarray, n_steps: int) -> list[StepInput]:
    """Return two inputs: in step k, the height of foothold k and that of foothold k + 1, each minus
    that of the foothold before, m; see `models.compute_rises`.

    - `heights`: n_steps + 1 or n_steps + 2 heights of footholds for each lane, m.
    """
    n_given = heights.shape[1]
    first_foothold = n_steps + 1 - n_given
    rises = np.diff(heights.T, axis=0, prepend=0.0)[-(n_steps + 1) :]

    def list_terms(offset: int, k: int) -> list[tuple[int, float]]:
        index = k + offset - first_foothold
        return [(index, 1.0), (index - 1, -1.0)][: index + 1]

    return [
        StepInput("heights", rises[i:][:n_steps], functools.partial(list_terms, i), n_given)
        for i in (0, 1)
    ]


class WalkBatch:
    """State of a batch of walks, with lanes on the last axis of every array."""

    def __init__(
        self,
        section_states: np.ndarray,
        inputs: Sequence[StepInput] = (),
        derivative_names: Sequence[str] = (),
    ) -> None:
        """Start the walks from section states of shape (components, lanes).

        - `inputs`: inputs of a step besides the section state;
        - `derivative_names`: names of the requested derivatives, which are `START_INPUT_NAME` and
          arguments of the inputs.
        """
        n_components, n_lanes = section_states.shape
        self.section_state, self.inputs = section_states, inputs
        if inputs:
            self.input_matrix = np.stack([x.select_values(0) for x in inputs])
        self.outcome, self.n_stepped, self.solver_steps = np.zeros((3, n_lanes), np.int32)
        self.derivative_names = derivative_names
        self.differentiated_inputs = {
            name: [i for i, x in enumerate(inputs) if x.argument == name]
            for name in derivative_names
            if name != START_INPUT_NAME
        }
        self.n_values_by_argument = {
            name: inputs[indices[-1]].n_argument_values
            for name, indices in self.differentiated_inputs.items()
        }
        # Inputs of the Jacobian of a step: those above, and then the section state.
        self.input_indices: tuple[int, ...] = ()
        if derivative_names:
            self.input_indices = (
                *(i for indices in self.differentiated_inputs.values() for i in indices),
                *range(len(inputs), len(inputs) + n_components),
            )
        # The first index of each argument on axis 0 of the walk's Jacobian, and then of the start.
        self.first_rows = np.cumsum([0, *(n or 1 for n in self.n_values_by_argument.values())])
        self._allocate_results(3, section_states.dtype)  # DLS, SLS-I and SLS-II

    def _allocate_results(self, n_phases: int, dtype: Any) -> None:
        n, n_lanes = self.section_state.shape
        self.durations = np.zeros((n_phases, n_lanes), dtype)
        n_rows = (self.first_rows[-1] + n) * bool(self.derivative_names)
        self.walk_jacobian = np.zeros((n_rows, n + n_phases, n_lanes), dtype)

    def take_steps(
        self,
        n_steps: int,
        step_lanes: Callable[..., tuple[np.ndarray, ...]],
        model: Any = None,
    ) -> None:
        """Compute `n_steps` steps of each walk, or fewer if it ends earlier.

        - `step_lanes`: function of the indices of the walking lanes, their inputs (None if there
          are none) and section states, and the index of the step. It returns section states,
          durations, outcomes, numbers of solver steps and, if derivatives are requested, Jacobians;
        - `model`: model of the wheel, whose legs may alternate.
        """
        for k in range(n_steps):
            walking = np.flatnonzero(self.outcome == Outcome.STEPPED)
            # A walker without inputs takes a step of no lanes, which has its number of phases.
            if not len(walking) and (k or self.inputs):
                break
            lanes = select_lanes(walking, len(self.outcome))
            inputs = self._select_inputs(k, model)[:, lanes] if self.inputs else None
            section_state, durations, outcome, solver_steps, *jacobian = step_lanes(
                walking, inputs, self.section_state[:, lanes], k
            )
            if k == 0:
                self._allocate_results(len(durations), durations.dtype)
            if jacobian:
                self.walk_jacobian[..., lanes] = self._chain_walk_jacobian(k, lanes, *jacobian)
            self.section_state[:, lanes] = section_state
            self.durations[:, lanes] = durations
            self.outcome[lanes] = outcome
            self.n_stepped[lanes] += outcome == Outcome.STEPPED
            self.solver_steps[lanes] += solver_steps

    def _select_inputs(self, k: int, model: Any) -> np.ndarray:
        """Return the inputs in step `k` for all lanes, in the matrix that all steps share."""
        for row, step_input in zip(self.input_matrix, self.inputs, strict=True):
            if step_input.values.ndim > 1:
                row[:] = step_input.select_values(k)
        if k > 0 and model is not None:
            model.exchange_legs(self.input_matrix)
        return self.input_matrix

    def make_batch_result(
        self,
        engine: str,
        solver_names: tuple[str, ...],
        lane_order: np.ndarray | None = None,
        solver_index: np.ndarray | None = None,
    ) -> StepBatchResult:
        """Return the result for the lanes in their original order.

        - `lane_order`: original index of each lane of this batch, if it was sorted.
        """
        n_lanes = len(self.outcome)
        position = slice(None) if lane_order is None else np.argsort(lane_order)
        restore_order = lambda x: x[..., position].T
        names = "section_state", "durations", "outcome", "n_stepped", "solver_steps"
        return StepBatchResult(
            **{name: restore_order(getattr(self, name)) for name in names},
            solver_index=restore_order(
                np.zeros(n_lanes, np.int32) if solver_index is None else solver_index
            ),
            engine=engine,
            solver_names=solver_names,
            derivatives=self._split_jacobian(restore_order),
        )

    def _split_jacobian(self, restore_order: Callable) -> dict[str, StepSensitivity]:
        """Return the derivatives of the walks by the name of the input, with the value 0 for failed
        walks.
        """
        if not self.derivative_names:
            return {}
        self.walk_jacobian[..., self.outcome != Outcome.STEPPED] = 0.0
        names = *self.differentiated_inputs, START_INPUT_NAME
        blocks = np.split(restore_order(self.walk_jacobian), self.first_rows[1:], -1)
        block_by_name = dict(zip(names, blocks, strict=True))
        for name, n_values in self.n_values_by_argument.items():
            if n_values is None:
                block_by_name[name] = block_by_name[name][..., 0]
        n = len(self.section_state)
        return {
            name: StepSensitivity(block_by_name[name][:, :n], block_by_name[name][:, n:])
            for name in self.derivative_names
        }

    def _chain_walk_jacobian(self, k: int, lanes: Any, step_jacobian: np.ndarray) -> np.ndarray:
        """Return the Jacobian of the walk after step `k`, shape (inputs, outputs, lanes).

        Axis 0 has one index for each value of an argument that varies over steps. The products
        are summed one after another, so that a lane's digits do not depend on the batch.
        """
        n = len(self.section_state)
        state_jacobian = step_jacobian[-n:]
        chained = np.zeros((len(self.walk_jacobian), *step_jacobian.shape[1:]), step_jacobian.dtype)
        if k == 0:
            chained[-n:] = state_jacobian
        else:
            # The derivatives with respect to values of later steps are still 0.
            rows = np.flatnonzero(self.walk_jacobian.any((1, 2)))
            previous = self.walk_jacobian[rows, :n][..., lanes]
            chained[rows] = sum(state_jacobian[i] * previous[:, i, None] for i in range(n))
        columns = iter(step_jacobian)
        for indices, first_row in zip(
            self.differentiated_inputs.values(), self.first_rows, strict=False
        ):
            for i in indices:
                column = next(columns)
                for value_index, derivative in self.inputs[i].list_terms(k):
                    chained[first_row + value_index] += derivative * column
        return chained


def select_lanes(lane_indices: np.ndarray, n_lanes: int) -> Any:
    """Return an index that selects the lanes at `lane_indices`.

    If these are all lanes, the index is a slice, which copies nothing.
    """
    return slice(None) if len(lane_indices) == n_lanes else lane_indices
