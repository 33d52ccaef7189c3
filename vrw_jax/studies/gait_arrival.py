"""Walks of one wheel from many start states, until each walk arrives at a stable gait or fails."""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vrw_jax.base.checks import check_type, require_untraced_arguments
from vrw_jax.base.options import StepOptions
from vrw_jax.base.outcomes import Outcome
from vrw_jax.gaits.cycle import AbstractCycle
from vrw_jax.gaits.gait_search import limit_cycle
from vrw_jax.models.interface import AbstractWheel
from vrw_jax.models.step_batch import step_batch
from vrw_jax.models.stepping import (
    ModelLike,
    convert_model_argument,
    convert_step_options,
    require_single_wheel,
)
from vrw_jax.wheel.params import WheelParams, compute_wheel_units

# Largest distance between the section states of a walk and of the gait at which the walk has
# arrived. Distances are in units of the wheel. The value is chosen far above the errors of a gait
# step and of a gait. It is far below the distances of most gaits from the boundaries of their
# basins.
MAX_ARRIVAL_DISTANCE = 1e-6


class StableGait(NamedTuple):
    """Stable gait of one wheel, with the wheel's parameters, the model and the step options."""

    params: WheelParams
    model: AbstractWheel
    step_options: StepOptions
    section_states: np.ndarray  # before the landing of each step, (period_n, m)

    @classmethod
    def from_cycle(
        cls,
        caller_name: str,
        params: WheelParams,
        model: ModelLike | None,
        cycle: AbstractCycle | None,
        options: StepOptions | None,
    ) -> "StableGait":
        """Return the stable gait of `cycle`, which is by default the result of `limit_cycle`.

        Raise TypeError or ValueError if an argument is invalid or the gait is not stable. The
        messages contain `caller_name`, the name of the public function.
        """
        require_untraced_arguments(
            caller_name, "map vrw.walk over the starts", params, options, cycle
        )
        require_single_wheel(params, f"call {caller_name} for one wheel after the other")
        checked_model = convert_model_argument(model).fallback_model  # valid for any start
        checked_step_options = convert_step_options(options)
        checked_step_options.check_tolerances(np.dtype(params.damping.dtype))
        if cycle is None:
            cycle = limit_cycle(params, model=checked_model)
        check_type("cycle", cycle, AbstractCycle, "give vrw.limit_cycle(params)")
        if int(cycle.outcome) != Outcome.STEPPED:
            raise ValueError(
                f"this wheel has no gait that could have a basin: {cycle.why} Take a wheel for "
                "which vrw.limit_cycle finds a gait."
            )
        spectral_radius = float(cycle.spectral_radius_value)
        if not spectral_radius < 1.0:
            raise ValueError(
                f"the gait has spectral radius {spectral_radius:.6g}, so that it is not stable "
                "and has no basin: take a wheel whose gait has a spectral radius below 1."
            )
        section_states = [np.asarray(cycle.section_state)[None]]
        for _ in range(cycle.period_n):
            section_states.append(
                step_batch(
                    params, section_states[-1], model=checked_model, options=checked_step_options
                ).section_state
            )
        stable_gait = cls(
            params, checked_model, checked_step_options, np.concatenate(section_states[:-1])
        )
        if not stable_gait.is_on_gait(section_states[-1])[0]:
            raise ValueError(
                f"cycle does not repeat after {cycle.period_n} steps of this wheel with "
                f"{type(checked_model).__name__}: give a cycle of the same wheel and model."
            )
        return stable_gait

    def require_start_within_step(self, changes: str) -> None:
        """Raise a ValueError unless the gait has one step, within which its model can start."""
        if not self.model.can_start_within_gait_step:
            raise ValueError(
                f"{type(self.model).__name__} cannot begin within a step, so that {changes} within "
                "a step are not available: take ViscoelasticWheel() or RigidWheel(), or disturb "
                "starts by vrw.basin_share."
            )
        if len(self.section_states) > 1:
            raise ValueError(
                f"cycle repeats after {len(self.section_states)} steps, but {changes} within a "
                "step need a gait of one step: give a cycle with period_n=1."
            )

    def is_on_gait(self, section_states: np.ndarray) -> np.ndarray:
        """Return whether each section state agrees with a section state of the gait, shape
        (states,).

        Two states agree if their distance is at most `max_gait_distance`.
        """
        state_units = self.model.collect_section_units(
            compute_wheel_units(self.params.symbols()), self.params.n_legs
        )
        n_entries = self.model.count_continuous_section_entries(self.params)
        state_differences = section_states[:, None, :n_entries] - self.section_states[:, :n_entries]
        scaled_differences = state_differences / np.asarray(state_units)[:n_entries]
        return np.abs(scaled_differences).max(-1).min(-1) <= MAX_ARRIVAL_DISTANCE


# Number of gait steps between two tests, chosen because more frequent tests need many calls.
N_STEPS_PER_ARRIVAL_TEST = 10


def walk_until_on_gait(
    stable_gait: StableGait,
    start_states: np.ndarray,
    max_steps: int,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Walk at most `max_steps` gait steps from `start_states`, until the walks are on the gait.

    Return whether each walk arrives, its `Outcome` (STEPPED if it continues), and its number of
    gait steps up to arrival, failure or `max_steps`.

    - `start_states`: section states before the first landing, shape (starts, components).
    """
    n_starts = len(start_states)
    has_arrived = np.zeros(n_starts, bool)
    walk_outcomes = np.full(n_starts, int(Outcome.STEPPED))
    n_steps_walked = np.zeros(n_starts, int)
    embed_section_states: Any = jax.vmap(
        functools.partial(stable_gait.model.complete_section_state, stable_gait.params)
    )
    walking_indices = np.arange(n_starts)
    section_states = np.asarray(embed_section_states(jnp.asarray(start_states)))
    for first_step in range(0, max_steps, N_STEPS_PER_ARRIVAL_TEST):
        if not len(walking_indices):
            break
        walk_results = step_batch(
            stable_gait.params,
            section_states,
            min(N_STEPS_PER_ARRIVAL_TEST, max_steps - first_step),
            model=stable_gait.model,
            options=stable_gait.step_options,
        )
        has_stepped = walk_results.outcome == Outcome.STEPPED
        is_on_gait = has_stepped & stable_gait.is_on_gait(walk_results.section_state)
        has_arrived[walking_indices] = is_on_gait
        walk_outcomes[walking_indices] = walk_results.outcome
        n_steps_walked[walking_indices] += walk_results.n_stepped
        is_walking = has_stepped & ~is_on_gait
        walking_indices = walking_indices[is_walking]
        section_states = walk_results.section_state[is_walking]
    return has_arrived, walk_outcomes, n_steps_walked
