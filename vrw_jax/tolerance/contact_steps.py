"""Batched steps with unilateral contact, without derivatives."""

import dataclasses
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from vrw_jax.contact import (
    LOCKED_CODE_OFFSET,
    ContactMode,
    UnilateralWheel,
    embed_section_states,
    min_bounce_height,
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
        quantities = np.column_stack([durations, step_length, end_states[:, self.plane_indices()]])
        return StepQuantities(end_states, quantities, outcome)

    def with_loose_steps(self) -> "GroundBatch":
        """Return the batch with looser step tolerances, for walks."""
        tolerance = self.tolerances.walk
        options = StepOptions(solver="Tsit5", rtol=tolerance, atol=tolerance)
        return dataclasses.replace(self, options=options)

    def list_with_other_tolerances(self) -> list["GroundBatch"]:
        """Return copies of the batch with other step tolerances, for comparison."""
        is_very_tight = float(self.options.rtol) < 0.5 * self.tolerances.tight_tolerance
        comparison_tolerances = (
            self.tolerances.very_tight_comparisons
            if is_very_tight
            else self.tolerances.tight_comparisons
        )
        options = [
            StepOptions(rtol=tolerance, atol=tolerance) for tolerance in comparison_tolerances
        ]
        return [dataclasses.replace(self, options=step_options) for step_options in options]

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

    def find_free_coordinates(self, section_states: np.ndarray) -> np.ndarray:
        """Return whether each number of the section states is free, shape (elements, 4 + 2 n).

        The other numbers follow from the free ones. The hub's rates follow from a sticking foot,
        Leg 1's length from touchdown, and the lengths of legs on their stoppers from the stoppers.
        """
        n_legs = self.n_legs
        contact_codes = np.round(section_states[:, 4 + 2 * n_legs :]).astype(int)
        is_free = np.zeros((len(section_states), 4 + 2 * n_legs), bool)
        is_free[:, :2] = is_free[:, 4 + n_legs] = True
        is_free[:, 2] = contact_codes[:, 0] != ContactMode.STICK
        is_free[:, 3] = is_free[:, 4] = contact_codes[:, 0] % LOCKED_CODE_OFFSET == 0
        is_off_stopper = contact_codes[:, 1:] < LOCKED_CODE_OFFSET
        is_free[:, 5 : 4 + n_legs], is_free[:, 5 + n_legs :] = is_off_stopper, is_off_stopper
        return is_free

    def complete_states(self, section_states: np.ndarray) -> np.ndarray:
        """Return section states in which the numbers that are not free are recomputed; see
        `find_free_coordinates`.
        """
        n_legs, section_states = self.n_legs, section_states.copy()
        theta, hub_rate = section_states[:, 0], section_states[:, 1]
        leg_1_code = np.round(section_states[:, 4 + 2 * n_legs]).astype(int)
        foot_code = leg_1_code % LOCKED_CODE_OFFSET
        # The landing leg determines the height of the hub.
        height = section_states[:, 3 + n_legs] * np.cos(theta - 2.0 * np.pi / n_legs)
        sin, cos, leg_1_rate = np.sin(theta), np.cos(theta), section_states[:, 4 + n_legs]
        section_states[:, 4] = np.where(
            (foot_code != 0) & (leg_1_code < LOCKED_CODE_OFFSET), height / cos, section_states[:, 4]
        )
        length = section_states[:, 4]
        section_states[:, 2] = np.where(
            foot_code == ContactMode.STICK,
            leg_1_rate * sin + length * hub_rate * cos,
            section_states[:, 2],
        )
        section_states[:, 3] = np.where(
            foot_code != 0, leg_1_rate * cos - length * hub_rate * sin, section_states[:, 3]
        )
        return section_states

    def plane_indices(self) -> np.ndarray:
        """Return the indices of the paper's section state in a full section state."""
        return np.array([0, 1, 4 + self.n_legs])
