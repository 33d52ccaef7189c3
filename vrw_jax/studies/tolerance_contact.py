"""Batched walking steps with unilateral contact, and their Jacobians."""

import dataclasses
from collections.abc import Iterable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vrw_jax.base.options import StepOptions
from vrw_jax.models.contact_record import compute_min_bounce_height
from vrw_jax.models.contact_walks import embed_section_states, step_batch_with_jacobian, walk_batch
from vrw_jax.models.unilateral_wheel import UnilateralWheel
from vrw_jax.wheel.params import PARAMETER_NAMES, WheelParams


def replace_rows(
    arrays: Iterable[np.ndarray], row_indices: np.ndarray, new_arrays: Iterable[np.ndarray]
) -> None:
    """Replace, in place, the rows with the indices `row_indices` of each array by new rows."""
    for array, new_array in zip(arrays, new_arrays, strict=True):
        array[row_indices] = new_array


class StepQuantities(NamedTuple):
    """Section states, step quantities and outcomes of walking steps, one for each wheel."""

    # (wheels, 4 + 3 n): section states after the step; zeros if the step failed
    section_states: np.ndarray
    step_quantities: np.ndarray  # (wheels, 7), in the order of `QUANTITY_NAMES`
    step_outcomes: np.ndarray


# Tolerance for most steps, chosen because steps at a looser tolerance save a seventh of the time
# but miss events.
TIGHT_TOLERANCE = 1e-10
# Tolerance for measures with a small allowed error. A step at this tolerance costs a third more
# than a step at `TIGHT_TOLERANCE`.
VERY_TIGHT_TOLERANCE = 1e-12
# Tolerance for walks with the solver Tsit5. A step at this tolerance costs a quarter of a step at
# `TIGHT_TOLERANCE`. The value is chosen because walks at 1e-5 miss three of 118 gaits.
WALK_TOLERANCE = 3e-6
# Further tolerances at which steps are repeated if feet may graze the ground. The numerical error
# is estimated from the differences between these steps.
TIGHT_COMPARISON_TOLERANCES = (1e-12, 1e-11, 3e-11)
# Such tolerances for steps at `VERY_TIGHT_TOLERANCE`.
VERY_TIGHT_COMPARISON_TOLERANCES = (1e-13, 3e-12, 1e-11)


@dataclasses.dataclass(frozen=True)
class ContactWheelBatch:
    """Batch of wheels with unilateral contact, each with its own friction coefficient."""

    parameter_matrix: np.ndarray  # (10, wheels): parameters and friction
    n_legs: int  # number of legs of each wheel
    contact_model: UnilateralWheel
    step_options: StepOptions

    @classmethod
    def from_params(
        cls, params: WheelParams, friction: np.ndarray, stoppers: str, options: StepOptions
    ) -> "ContactWheelBatch":
        """Return the batch of wheels whose `params` and `friction` have one batch axis."""
        parameter_matrix = [
            *(np.asarray(getattr(params, parameter_name)) for parameter_name in PARAMETER_NAMES),
            friction,
        ]
        contact_model = UnilateralWheel(stoppers=stoppers)  # type: ignore[arg-type]
        return cls(np.stack(parameter_matrix), params.n_legs, contact_model, options)

    def embed_paper_states(
        self, wheel_indices: np.ndarray, section_states: np.ndarray
    ) -> np.ndarray:
        """Return full section states, (wheels, 4 + 3 n), for states of the paper, (wheels, 3).

        `wheel_indices` selects the wheels.
        """
        return np.array(
            embed_section_states(
                self.parameter_matrix[:, wheel_indices], section_states, self.n_legs
            )
        )

    def take_steps(
        self, wheel_indices: np.ndarray, section_states: np.ndarray, n_steps: int = 1
    ) -> StepQuantities:
        """Return the result of `n_steps` walking steps that begin at `section_states`.

        The section states are full, (wheels, 4 + 3 n). `wheel_indices` selects the wheels.
        """
        end_states, durations, step_outcomes, *_, step_length = walk_batch(
            self.parameter_matrix[:, wheel_indices],
            section_states,
            n_steps,
            self.contact_model,
            self.step_options,
            self.n_legs,
        )
        step_quantities = self._stack_step_quantities(durations, step_length, end_states)
        return StepQuantities(end_states, step_quantities, step_outcomes)

    def linearize_steps(
        self, wheel_indices: np.ndarray, section_states: np.ndarray
    ) -> tuple[StepQuantities, np.ndarray, np.ndarray]:
        """Return the result of one walking step from full section states, and two Jacobians.

        The first Jacobian is that of the next section state, (wheels, 4 + 3 n, 4 + 3 n). The second
        is that of the step quantities, (wheels, 7, 4 + 3 n). The derivatives are with respect to
        the full section state at the start.
        """
        parameter_matrix = self.parameter_matrix[:, wheel_indices]
        n_contact_parameters = len(parameter_matrix)
        input_indices = range(n_contact_parameters, n_contact_parameters + section_states.shape[1])
        contact_step, step_jacobian = jax.tree.map(
            np.asarray,
            step_batch_with_jacobian(
                parameter_matrix,
                section_states,
                self.contact_model,
                self.step_options,
                self.n_legs,
                input_indices,
            ),
        )
        step_quantities, quantity_jacobian = (
            self._stack_step_quantities(
                step_result_or_jacobian.durations,
                step_result_or_jacobian.step_length,
                step_result_or_jacobian.section_state,
            )
            for step_result_or_jacobian in (contact_step, step_jacobian)
        )
        return (
            StepQuantities(contact_step.section_state, step_quantities, contact_step.outcome),
            step_jacobian.section_state[:, :, n_contact_parameters:],
            quantity_jacobian[:, :, n_contact_parameters:],
        )

    def _stack_step_quantities(
        self, durations: Any, step_length: Any, end_states: Any
    ) -> np.ndarray:
        """Return the step quantities or their derivatives as one array, (wheels, 7, ...)."""
        paper_section_states = end_states[:, self.list_paper_state_indices()]
        return np.concatenate([durations, step_length[:, None], paper_section_states], 1)

    def make_walk_batch(self) -> "ContactWheelBatch":
        """Return a copy of the batch with the looser solver tolerance for walks."""
        return dataclasses.replace(
            self,
            step_options=StepOptions(solver="Tsit5", rtol=WALK_TOLERANCE, atol=WALK_TOLERANCE),
        )

    def make_comparison_batches(self) -> list["ContactWheelBatch"]:
        """Return a copy of the batch for each solver tolerance at which steps are compared."""
        comparison_tolerances = (
            VERY_TIGHT_COMPARISON_TOLERANCES
            if float(self.step_options.rtol) < 0.5 * TIGHT_TOLERANCE
            else TIGHT_COMPARISON_TOLERANCES
        )
        return [
            dataclasses.replace(
                self, step_options=StepOptions(rtol=solver_tolerance, atol=solver_tolerance)
            )
            for solver_tolerance in comparison_tolerances
        ]

    def compute_min_contact_duration(self, wheel_indices: np.ndarray) -> np.ndarray:
        """Return the shortest contact duration that the solver resolves for each selected wheel, s.

        It is the flight time of the smallest bounce that the solver resolves.
        """
        # A scalar is used because JAX would compile a program for each batch size.
        relative_bounce_height = float(compute_min_bounce_height(jnp.ones(()), self.step_options))
        locked_length, gravity = (
            self.parameter_matrix[PARAMETER_NAMES.index(parameter_name)]
            for parameter_name in ("locked_length", "gravity")
        )
        bounce_height = relative_bounce_height * locked_length
        return np.sqrt(8.0 * bounce_height / gravity)[wheel_indices]

    def list_paper_state_indices(self) -> np.ndarray:
        """Return the indices of theta-, dtheta- and dL1- in a full section state."""
        return np.array([0, 1, 4 + self.n_legs])
