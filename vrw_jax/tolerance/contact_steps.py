"""Batched steps with unilateral contact, and their derivatives."""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vrw_jax.contact import (
    LOCKED_CODE_OFFSET,
    UnilateralWheel,
    embed_section_states,
    min_bounce_height,
    step_batch_with_jacobian,
    walk_batch,
)
from vrw_jax.numerics import StepOptions
from vrw_jax.wheel import PARAMETER_NAMES, WheelParams


@dataclasses.dataclass(frozen=True)
class StepTolerances:
    """Tolerances of the solver in steps with unilateral contact.

    - `tight_tolerance`: tolerance of most steps, chosen because looser ones save a seventh of the
      time but miss events;
    - `very_tight_tolerance`: tolerance for measures with a small error, which costs a third more;
    - `walk`: tolerance of walks by Tsit5, whose steps cost a quarter. It is chosen because at 1e-5
      three of 118 gaits are missed;
    - `tight_comparisons`, `very_tight_comparisons`: other tolerances, with which steps are compared
      if feet may graze the ground.
    """

    tight_tolerance: float = 1e-10
    very_tight_tolerance: float = 1e-12
    walk: float = 3e-6
    tight_comparisons: tuple[float, ...] = (1e-12, 1e-11, 3e-11)
    very_tight_comparisons: tuple[float, ...] = (1e-13, 3e-12, 1e-11)


STEP_TOLERANCES = StepTolerances()
"""Tolerances of steps for all measures."""


class StepQuantities(NamedTuple):
    """Result of a step of some elements of a batch."""

    # (elements, 4 + 3 n): section state after the step; zeros if the step failed
    section_states: np.ndarray
    quantities: np.ndarray  # (elements, 7): quantities of `step_quantities`
    outcome: np.ndarray


@dataclasses.dataclass(frozen=True)
class GroundBatch:
    """Batch of wheels with unilateral contact, each with its own friction coefficient."""

    parameter_columns: np.ndarray  # (10, elements): parameters and friction
    n_legs: int  # number of legs of each wheel
    model: UnilateralWheel
    options: StepOptions
    tolerances: StepTolerances = STEP_TOLERANCES

    @classmethod
    def from_params(
        cls, params: WheelParams, friction: np.ndarray, stoppers: str, options: StepOptions
    ) -> "GroundBatch":
        """Return the batch of wheels with one batch axis on ground of this friction."""
        parameter_columns = [
            *(np.asarray(getattr(params, name)) for name in PARAMETER_NAMES),
            friction,
        ]
        model = UnilateralWheel(stoppers=stoppers)  # type: ignore[arg-type]
        return cls(np.stack(parameter_columns), params.n_legs, model, options)

    def embed_states(
        self, indices: np.ndarray, section_states: np.ndarray, is_rigid: Any = False
    ) -> np.ndarray:
        """Return full section states from those of the paper's model, shape (elements, 3).

        Leg 1 is on its stopper if `is_rigid`.
        """
        full_states = np.array(
            embed_section_states(self.parameter_columns[:, indices], section_states, self.n_legs)
        )
        full_states[:, 4 + 2 * self.n_legs] += np.where(is_rigid, LOCKED_CODE_OFFSET, 0)
        return full_states

    def take_steps(
        self, indices: np.ndarray, section_states: np.ndarray, n_steps: int = 1
    ) -> StepQuantities:
        """Return the result of `n_steps` steps from full section states."""
        parameter_columns = self.parameter_columns[:, indices]
        end_states, durations, outcome, *_, step_length = walk_batch(
            parameter_columns, section_states, n_steps, self.model, self.options, self.n_legs
        )
        quantities = self._stack_quantities(durations, step_length, end_states)
        return StepQuantities(end_states, quantities, outcome)

    def linearize_steps(
        self, indices: np.ndarray, section_states: np.ndarray
    ) -> tuple[StepQuantities, np.ndarray, np.ndarray]:
        """Return the result of one step from full section states, and the Jacobians of the end
        state and of the quantities with respect to these states.
        """
        parameter_columns = self.parameter_columns[:, indices]
        n_columns = len(parameter_columns)
        input_indices = range(n_columns, n_columns + section_states.shape[1])
        step, step_jacobian = jax.tree.map(
            np.asarray,
            step_batch_with_jacobian(
                parameter_columns,
                section_states,
                self.model,
                self.options,
                self.n_legs,
                input_indices,
            ),
        )
        quantities, quantity_jacobian = (
            self._stack_quantities(tree.durations, tree.step_length, tree.section_state)
            for tree in (step, step_jacobian)
        )
        return (
            StepQuantities(step.section_state, quantities, step.outcome),
            step_jacobian.section_state[:, :, n_columns:],
            quantity_jacobian[:, :, n_columns:],
        )

    def _stack_quantities(self, durations: Any, step_length: Any, end_states: Any) -> np.ndarray:
        """Return the quantities of steps, or their derivatives, along the second axis."""
        plane_states = end_states[:, self.plane_indices()]
        return np.concatenate([durations, step_length[:, None], plane_states], 1)

    def with_loose_steps(self) -> "GroundBatch":
        """Return the batch with looser step tolerances, for walks."""
        tolerance = self.tolerances.walk
        return dataclasses.replace(
            self, options=StepOptions(solver="Tsit5", rtol=tolerance, atol=tolerance)
        )

    def list_with_other_tolerances(self) -> list["GroundBatch"]:
        """Return copies of the batch with other step tolerances, for comparison."""
        comparison_tolerances = (
            self.tolerances.very_tight_comparisons
            if float(self.options.rtol) < 0.5 * self.tolerances.tight_tolerance
            else self.tolerances.tight_comparisons
        )
        return [
            dataclasses.replace(self, options=StepOptions(rtol=tolerance, atol=tolerance))
            for tolerance in comparison_tolerances
        ]

    def min_resolved_contact_duration(self, indices: np.ndarray) -> np.ndarray:
        """Return the shortest duration of a contact that the solver resolves, s, for each selected
        element.

        It follows from the height of the smallest bounce that the solver resolves.
        """
        get_parameter = lambda name: self.parameter_columns[PARAMETER_NAMES.index(name)]
        # A scalar is used because JAX would compile a program for each batch size.
        relative_height = float(min_bounce_height(jnp.ones(()), self.options))
        bounce_height = relative_height * get_parameter("locked_length")
        return np.sqrt(8.0 * bounce_height / get_parameter("gravity"))[indices]

    def plane_indices(self) -> np.ndarray:
        """Return the indices of the paper's section state in a full section state."""
        return np.array([0, 1, 4 + self.n_legs])
