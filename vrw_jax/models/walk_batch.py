"""Results of batches of walks, and derivatives with respect to their starts and parameters."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from vrw_jax.base.outcomes import Outcome
from vrw_jax.base.printing import (
    AbstractPrintable,
    LabelAndText,
    describe_step_ending,
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
    - `derivatives`: `StepSensitivity` by the name of the requested input.

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

    @property
    def ending(self) -> Any:
        """Return one sentence on the end of each walk, as an array over the batch."""
        return describe_step_ending(self.outcome, Outcome)

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


class StepwiseParameter(NamedTuple):
    """Terms by which a parameter enters the chain rule over the gait steps of a walk.

    The parameter may determine several inputs of a gait step, and may vary from step to step.
    """

    input_indices: tuple[int, ...]  # among the inputs of a step
    n_stepwise_values: int | None  # per lane; None for a single number
    list_chain_rule_terms: Callable[[int], tuple[tuple[int, int, float], ...]]
    """Function that maps the index of a gait step to the terms of the chain rule.

    A term is (position of the input in `input_indices`, index of the parameter's value, derivative
    of the input with respect to the value).
    """


def complete_slopes_over_steps(known_slopes_by_step: np.ndarray, n_steps: int) -> np.ndarray:
    """Return the slopes of the ground for `n_steps` gait steps, shape (n_steps + 1, lanes), rad.

    If `known_slopes_by_step` has only `n_steps` slopes per lane, the last slope is repeated.
    """
    return (
        known_slopes_by_step.T
        if known_slopes_by_step.shape[1] > n_steps
        else np.concatenate([known_slopes_by_step.T, known_slopes_by_step.T[-1:]])
    )


def make_height_terms(
    input_indices: tuple[int, int], n_given: int, n_steps: int
) -> StepwiseParameter:
    """Return the terms by which heights of footholds enter the two rises of each gait step.

    - `n_given`: number of given heights, n_steps + 1 or n_steps + 2.
    """
    first_foothold = n_steps + 1 - n_given
    rise_terms = ((0, 0, 1.0), (0, -1, -1.0), (1, 1, 1.0), (1, 0, -1.0))
    return StepwiseParameter(
        input_indices,
        n_given,
        lambda k: tuple(
            (input_position, k + offset - first_foothold, derivative)
            for input_position, offset, derivative in rise_terms
            if k + offset >= first_foothold
        ),
    )


def compute_rises_over_steps(heights: np.ndarray, n_steps: int) -> np.ndarray:
    """Return the height of each foothold minus that of the foothold before, shape (n_steps + 1,
    lanes), m; see `models.compute_rises`.
    """
    return np.diff(heights.T, axis=0, prepend=0.0)[-(n_steps + 1) :]


LANE_ARRAY_NAMES = ("section_state", "durations", "outcome", "n_stepped", "solver_steps")
"""Names of the arrays that a `WalkBatch` has in common with its `StepBatchResult`."""


class WalkBatch:
    """State of a batch of walks, with lanes on the last axis of every array."""

    def __init__(
        self,
        section_states: np.ndarray,
        derivative_names: Sequence[str],
        step_parameter_names: tuple[str, ...],
        stepwise_parameters: Mapping[str, StepwiseParameter],
    ) -> None:
        """Start the walks from section states of shape (components, lanes).

        - `derivative_names`: names of the requested derivatives, from `START_INPUT_NAME` and
          `step_parameter_names`;
        - `step_parameter_names`: names of the inputs of a gait step that precede the section state;
        - `stepwise_parameters`: parameters that are not one equal input of every gait step, by
          name.
        """
        section_state_size, n_lanes = section_states.shape
        self.section_state = section_states
        self.durations = np.zeros((3, n_lanes), section_states.dtype)
        self.outcome, self.n_stepped, self.solver_steps = np.zeros((3, n_lanes), np.int32)
        self.derivative_names = derivative_names
        self.differentiated_parameters = {
            input_name: stepwise_parameters.get(input_name)
            or StepwiseParameter(
                (step_parameter_names.index(input_name),), None, lambda _: ((0, 0, 1.0),)
            )
            for input_name in derivative_names
            if input_name != START_INPUT_NAME
        }
        parameter_input_indices = [
            i
            for stepwise_parameter in self.differentiated_parameters.values()
            for i in stepwise_parameter.input_indices
        ]
        state_input_indices = len(step_parameter_names) + np.arange(section_state_size)
        self.input_indices: tuple[int, ...] = (
            (*parameter_input_indices, *state_input_indices.tolist()) if derivative_names else ()
        )
        n_jacobian_rows_by_parameter = [
            stepwise_parameter.n_stepwise_values or 1
            for stepwise_parameter in self.differentiated_parameters.values()
        ]
        # The first index of each parameter on axis 0 of the Jacobian, and then that of the start.
        self.first_jacobian_rows = np.cumsum([0, *n_jacobian_rows_by_parameter])
        n_jacobian_rows = (
            self.first_jacobian_rows[-1] + section_state_size if derivative_names else 0
        )
        self.walk_jacobian = np.zeros(
            (n_jacobian_rows, section_state_size + 3, n_lanes), section_states.dtype
        )

    def find_walking_lanes(self) -> np.ndarray:
        """Return the indices of the lanes whose walks have not ended."""
        return np.flatnonzero(self.outcome == Outcome.STEPPED)

    def make_batch_result(
        self,
        lane_order: np.ndarray,
        solver_index: np.ndarray,
        engine: str,
        solver_names: tuple[str, ...],
    ) -> StepBatchResult:
        """Return the result for the lanes in their original order.

        - `lane_order`: original index of each lane of this batch, which was sorted.
        """
        inverse_lane_order = np.empty_like(lane_order)
        inverse_lane_order[lane_order] = np.arange(len(lane_order))
        restore_order = lambda x: x.take(inverse_lane_order, -1).T
        lane_arrays = {name: restore_order(getattr(self, name)) for name in LANE_ARRAY_NAMES}
        return StepBatchResult(
            **lane_arrays,
            solver_index=restore_order(solver_index),
            engine=engine,
            solver_names=solver_names,
            derivatives=self.split_jacobian_by_input(inverse_lane_order),
        )

    def split_jacobian_by_input(self, inverse_lane_order: np.ndarray) -> dict[str, StepSensitivity]:
        """Return the derivatives of the walks by the name of the input, with the value 0 for failed
        walks.

        - `inverse_lane_order`: index in this batch of each lane of the original order.
        """
        if not self.derivative_names:
            return {}
        self.walk_jacobian[..., self.outcome != Outcome.STEPPED] = 0.0
        jacobian_blocks = np.split(
            self.walk_jacobian.take(inverse_lane_order, -1).T, self.first_jacobian_rows[1:], -1
        )
        jacobian_by_input = dict(
            zip((*self.differentiated_parameters, START_INPUT_NAME), jacobian_blocks, strict=True)
        )
        for input_name, stepwise_parameter in self.differentiated_parameters.items():
            if stepwise_parameter.n_stepwise_values is None:
                jacobian_by_input[input_name] = jacobian_by_input[input_name][..., 0]
        n_components = len(self.section_state)
        return {
            input_name: StepSensitivity(
                jacobian_by_input[input_name][:, :n_components],
                jacobian_by_input[input_name][:, n_components:],
            )
            for input_name in self.derivative_names
        }

    def store_lane_steps(
        self, lane_indices: np.ndarray, step_outputs: tuple[np.ndarray, ...]
    ) -> None:
        """Store the results of one gait step of the lanes at `lane_indices`.

        `step_outputs` contains section states, durations, outcomes, numbers of solver steps and, if
        derivatives are requested, Jacobians.
        """
        section_state, phase_durations, outcome, n_solver_steps, *step_jacobian = step_outputs
        lanes = select_lanes(lane_indices, self)
        if step_jacobian:
            self.walk_jacobian[..., lanes] = self._chain_walk_jacobian(lanes, *step_jacobian)
        self.section_state[:, lanes] = section_state
        self.durations[:, lanes] = phase_durations
        self.outcome[lanes] = outcome
        self.n_stepped[lanes] += outcome == Outcome.STEPPED
        self.solver_steps[lanes] += n_solver_steps

    def _chain_walk_jacobian(self, lanes: Any, step_jacobian: np.ndarray) -> np.ndarray:
        """Return the Jacobian of the walk after the last gait step, shape (inputs, outputs, lanes).

        Axis 0 has one index for each value of a parameter that varies over gait steps. The products
        are summed one after another, so that a lane's digits do not depend on the batch.
        """
        n_components = len(self.section_state)
        state_jacobian = step_jacobian[-n_components:]
        k = int(np.max(self.n_stepped[lanes], initial=0))
        walk_jacobian_shape = len(self.walk_jacobian), *step_jacobian.shape[1:]
        chained_walk_jacobian = np.zeros(walk_jacobian_shape, step_jacobian.dtype)
        if k == 0:
            chained_walk_jacobian[-n_components:] = state_jacobian
        else:
            # The derivatives with respect to values of later steps are still 0.
            nonzero_rows = np.flatnonzero(self.walk_jacobian.any((1, 2)))
            previous_jacobian = self.walk_jacobian[nonzero_rows, :n_components][..., lanes]
            chained_walk_jacobian[nonzero_rows] = sum(
                state_jacobian[i] * previous_jacobian[:, i, None] for i in range(n_components)
            )
        first_input_row = 0
        for stepwise_parameter, first_jacobian_row in zip(
            self.differentiated_parameters.values(), self.first_jacobian_rows[:-1], strict=True
        ):
            for input_position, value_index, derivative in stepwise_parameter.list_chain_rule_terms(
                k
            ):
                chained_walk_jacobian[first_jacobian_row + value_index] += (
                    derivative * step_jacobian[first_input_row + input_position]
                )
            first_input_row += len(stepwise_parameter.input_indices)
        return chained_walk_jacobian


def select_lanes(lane_indices: np.ndarray, walk_batch: WalkBatch) -> Any:
    """Return an index that selects the lanes at `lane_indices`.

    If these are all lanes, the index is a slice, which copies nothing.
    """
    return slice(None) if len(lane_indices) == len(walk_batch.outcome) else lane_indices
