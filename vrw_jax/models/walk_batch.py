"""Walks of batches of walkers, and derivatives with respect to their starts and parameters.

Some derivatives follow from the units of length, time and mass by Euler's theorem. The choice of
these units does not affect a gait. So every output of a step or a cycle is a homogeneous function
of the parameters and the start, and each unit determines one column of the Jacobian from the other
columns. Two columns of the Jacobian of a step are computed in this way. The unit of mass would
determine a third column, but no mass is always large enough to divide by: the column for the mass
of a light leg would lose its digits. The columns of the Jacobian of a cycle are more expensive. For
a cycle, the unit of mass also determines the derivative in the direction in which both masses grow.
"""

import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from vrw_jax.base.options import StepOptions
from vrw_jax.base.results import (
    AbstractPrintable,
    LabelAndText,
    Outcome,
    describe_outcomes,
    format_outcome_counts,
    format_quantity,
)
from vrw_jax.flow.solver_steps import load_explicit_tableau
from vrw_jax.lanes.autodiff import compute_jacobian_columns
from vrw_jax.lanes.batching import BatchFunction
from vrw_jax.models.contact_walks import embed_section_states, step_batch_with_jacobian, walk_batch
from vrw_jax.wheel.params import FRICTION_NAME, PARAMETER_DOMAINS, PARAMETER_NAMES, UNIT_POWERS

DIFFRAX_BATCH_SIZE = 256
"""Number of walking steps that one call with the diffrax engine computes. The value is chosen
because the loop of this engine runs until the slowest element ends.
"""
XLA_LANE_BATCH_SIZE = 32_768
"""Number of walking steps that one call of the "lanes" engine computes if XLA compiles it. The
value is chosen because a GPU needs many batch elements.
"""


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


_SECTION_STATE_UNITS = ("rad", "rad/s", "m/s")
_STEP_INPUT_UNITS = (
    *(parameter_domain.unit for parameter_domain in PARAMETER_DOMAINS.values()),
    *_SECTION_STATE_UNITS,
    "rad",
)


class UnitScalingPowers(NamedTuple):
    """Exponents of one unit in the units of the inputs and outputs of a step."""

    step_input_powers: tuple[int, ...]  # exponents for parameters, start, slope of the next line
    step_output_powers: tuple[int, ...]  # exponents for section state and durations

    def subtract_known_jacobian_columns(
        self,
        scaled_output: Array,
        step_inputs: Sequence[Array],
        known_jacobian_columns: Mapping[int, Array],
    ) -> Array:
        """Subtract the contribution of each known Jacobian column from the sum in Euler's theorem.

        `scaled_output` is an output times the exponent of the unit in that output. The contribution
        of a column is the column times its input and the exponent of the unit in that input. By
        Euler's theorem, the result is the sum of the contributions of the unknown columns.
        """
        for i, known_jacobian_column in known_jacobian_columns.items():
            if self.step_input_powers[i]:
                scaled_output = (
                    scaled_output
                    - (self.step_input_powers[i] * step_inputs[i]) * known_jacobian_column
                )
        return scaled_output


LENGTH_UNIT_SCALING, TIME_UNIT_SCALING, MASS_UNIT_SCALING = (
    UnitScalingPowers(
        *(
            tuple(UNIT_POWERS[unit_name][unit_index] for unit_name in unit_names)
            for unit_names in (_STEP_INPUT_UNITS, (*_SECTION_STATE_UNITS, "s", "s", "s"))
        )
    )
    for unit_index in range(3)
)
UNIT_SCALING_BY_PARAMETER_INDEX = {
    PARAMETER_NAMES.index("gravity"): TIME_UNIT_SCALING,
    PARAMETER_NAMES.index("locked_length"): LENGTH_UNIT_SCALING,
}
"""Unit scaling that determines the Jacobian column of a parameter, by the index of the parameter.
Gravity comes first, because its unit contains a length.
"""


def complete_jacobian_by_scaling(
    step_inputs: Sequence[Array],
    known_jacobian_columns: Mapping[int, Array],
    scaled_outputs: Mapping[int, Array],
) -> dict[int, Array]:
    """Return all columns of a Jacobian, by the index of the input.

    Euler's theorem determines the columns of `UNIT_SCALING_BY_PARAMETER_INDEX`.

    - `known_jacobian_columns`: all other columns, by the index of the input;
    - `scaled_outputs`: outputs times the exponents of a unit, by the index of the parameter whose
      column the unit determines.
    """
    known_jacobian_columns = dict(known_jacobian_columns)
    for parameter_index, unit_scaling in UNIT_SCALING_BY_PARAMETER_INDEX.items():
        unknown_column_product = unit_scaling.subtract_known_jacobian_columns(
            scaled_outputs[parameter_index], step_inputs, known_jacobian_columns
        )
        known_jacobian_columns[parameter_index] = unknown_column_product / (
            unit_scaling.step_input_powers[parameter_index] * step_inputs[parameter_index]
        )
    return known_jacobian_columns


def complete_jacobian_columns(
    batch_function: BatchFunction, step_inputs: Sequence[Array], input_indices: Sequence[int]
) -> tuple:
    """Compute the Jacobian of section state and durations with respect to all inputs of a step.

    The results are those of `compute_jacobian_columns`. Two columns are computed from all other
    columns by unit scaling.

    - `batch_function`: function that computes the step for a batch;
    - `step_inputs`: parameters, then the start, then on uneven ground the slope of the next line of
      the ground;
    - `input_indices`: indices of all inputs, in the order of the returned columns.
    """
    computed_indices = [
        i for i in range(len(step_inputs)) if i not in UNIT_SCALING_BY_PARAMETER_INDEX
    ]
    computed_jacobian_columns, step_outputs, nonfloat_outputs = compute_jacobian_columns(
        batch_function, step_inputs, computed_indices
    )
    scaled_outputs = {
        i: jnp.asarray(unit_scaling.step_output_powers, step_outputs.dtype)[:, None] * step_outputs
        for i, unit_scaling in UNIT_SCALING_BY_PARAMETER_INDEX.items()
    }
    jacobian_columns_by_input = complete_jacobian_by_scaling(
        step_inputs,
        dict(zip(computed_indices, computed_jacobian_columns, strict=True)),
        scaled_outputs,
    )
    return (
        jnp.stack([jacobian_columns_by_input[i] for i in input_indices]),
        step_outputs,
        nonfloat_outputs,
    )


def step_batch_with_contact(
    model: Any,
    inputs: list[StepInput],
    next_line: list[StepInput],
    section_states: np.ndarray,
    n_steps: int,
    options: StepOptions,
    requested_engine: str,
    n_legs: int,
    derivative_names: Sequence[str],
) -> StepBatchResult:
    """Return the result of `step_batch` for a model with unilateral contact.

    Without derivatives on flat ground, one call of the kernel computes all gait steps. On uneven
    ground, further inputs are the friction of the feet that landed earlier, and the increase of the
    slope to the next line of the ground, rad, or two rises (see `models.select_stance_line`), m.

    - `next_line`: slope of the next line, or two rises; empty if all lines have one slope.
    """
    if requested_engine not in ("auto", "lanes") or load_explicit_tableau(options.solver) is None:
        raise ValueError(
            f"engine is {requested_engine!r} and solver {options.solver}, but batches with contact "
            "need 'lanes' and an explicit Runge-Kutta solver: map vrw.walk over the wheels."
        )
    if np.ndim(model.restitution):
        raise ValueError(
            f"restitution has shape {np.shape(model.restitution)}, but a batch needs one number "
            "for all elements: call vrw.step_batch for each restitution."
        )
    first_values = np.stack([x.select_values(0) for x in inputs])
    section_states = embed_section_states(first_values, section_states, n_legs)
    friction = np.asarray(model.friction, section_states.dtype)
    is_ground_uneven = bool(next_line) or friction.ndim == 2
    if not (derivative_names or is_ground_uneven or model.leg_period > 1):
        x, durations, outcome, n_stepped, solver_steps, _ = map(
            np.asarray, walk_batch(first_values, section_states, n_steps, model, options, n_legs)
        )
        solver_index = np.zeros_like(n_stepped)
        return StepBatchResult(
            x, durations, outcome, n_stepped, solver_steps, solver_index, "lanes", (options.solver,)
        )
    if is_ground_uneven:
        slope = inputs[PARAMETER_NAMES.index("slope")]
        if len(next_line) == 1:
            next_slope = next_line[0]
            tilt = next_slope._replace(
                values=next_slope.values - slope.values,
                list_terms=lambda k: [(k, -1.0), *next_slope.list_terms(k)],
            )
            next_line = [tilt]
        inputs = [
            *inputs,
            make_step_input(FRICTION_NAME, friction, n_steps, len(section_states), -1),
            *(next_line or [StepInput("", np.zeros_like(slope.values))]),
        ]
    batch = WalkBatch(section_states.T.copy(), inputs, derivative_names)
    input_indices = list(batch.input_indices)

    def step_lanes(_: Any, inputs: np.ndarray, x: np.ndarray, k: int) -> tuple[np.ndarray, ...]:
        if not derivative_names:
            x, durations, outcome, _, solver_steps, _ = walk_batch(
                inputs, x.T, 1, model, options, n_legs
            )
            outputs: tuple[Any, ...] = x, durations, outcome, solver_steps
        else:
            step, jacobian = step_batch_with_jacobian(
                inputs, x.T, model, options, n_legs, input_indices
            )
            columns = np.concatenate([jacobian.section_state, jacobian.durations], 1)
            outputs = step.section_state, step.durations, step.outcome, step.solver_steps
            outputs += (columns[:, :, input_indices],)
        return tuple(np.asarray(x).T for x in outputs)

    batch.take_steps(n_steps, step_lanes, model)
    return batch.make_batch_result("lanes", (options.solver,))
