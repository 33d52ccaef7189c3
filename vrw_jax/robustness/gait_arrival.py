"""Walks from many starts of one wheel, until each walk is on a stable gait or has failed."""

import functools
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vrw_jax.batches import step_batch
from vrw_jax.continuation import floquet
from vrw_jax.cycles import AbstractCycle, limit_cycle
from vrw_jax.models import AbstractWheel
from vrw_jax.numerics import StepOptions
from vrw_jax.simulation import ModelLike, check_model, check_options, check_single_wheel
from vrw_jax.validation import check_not_traced, check_type
from vrw_jax.wheel import Outcome, WheelParams, compute_wheel_units


@dataclass(frozen=True)
class ArrivalOptions:
    """Options of the test that a walk has arrived at a gait."""

    max_distance: float = 1e-6
    """Largest difference of a section state from one of the gait, in the wheel's own units.

    It is chosen because it is far above the errors of a step and of a gait, and far below the
    distances of most gaits from the borders of their basins."""
    steps_per_round: int = 10
    """Number of steps between two tests, chosen because a round of few steps costs many calls."""


ARRIVAL_OPTIONS = ArrivalOptions()


class StableGait(NamedTuple):
    """Stable gait of one wheel, with the wheel, model and options of its steps."""

    params: WheelParams
    model: AbstractWheel
    options: StepOptions
    section_states: np.ndarray  # before the landing of each step, (period_n, m)

    @classmethod
    def find(
        cls,
        function: str,
        params: WheelParams,
        model: ModelLike | None,
        cycle: AbstractCycle | None,
        options: StepOptions | None,
    ) -> "StableGait":
        """Return the gait of `cycle`, or by default that of `limit_cycle`.

        Raise a TypeError or a ValueError if an argument is invalid or the gait is not stable.
        `function` is the name of the caller for messages.
        """
        check_not_traced(function, "map vrw.walk over the starts", params, options, cycle)
        check_single_wheel(params, f"call {function} for one wheel after the other")
        checked_model = check_model(model).fallback_model  # valid for any start
        checked_options = check_options(options)
        checked_options.check_tolerances(np.dtype(params.damping.dtype))
        if cycle is None:
            cycle = limit_cycle(params, model=checked_model)
        check_type("cycle", cycle, AbstractCycle, "give vrw.limit_cycle(params)")
        if int(cycle.outcome) != Outcome.STEPPED:
            raise ValueError(
                f"this wheel has no gait that could have a basin: {cycle.why} Take a wheel for "
                "which vrw.limit_cycle finds a gait."
            )
        radius = float(floquet.compute_spectral_radius(cycle.monodromy_value))
        if not radius < 1.0:
            raise ValueError(
                f"the gait has spectral radius {radius:.6g}, so that it is not stable and has no "
                "basin: take a wheel whose gait has a spectral radius below 1."
            )
        states = [np.asarray(cycle.section_state)[None]]
        for _ in range(cycle.period_n):
            step = step_batch(params, states[-1], model=checked_model, options=checked_options)
            states.append(step.section_state)
        gait = cls(params, checked_model, checked_options, np.concatenate(states[:-1]))
        if not gait.contains(states[-1])[0]:
            raise ValueError(
                f"cycle does not repeat after {cycle.period_n} steps of this wheel with "
                f"{type(checked_model).__name__}: give a cycle of the same wheel and model."
            )
        return gait

    def contains(self, states: np.ndarray, arrival: ArrivalOptions = ARRIVAL_OPTIONS) -> np.ndarray:
        """Return whether each section state is one of the gait's section states."""
        units = self.model.section_units(
            compute_wheel_units(self.params.symbols()), self.params.n_legs
        )
        n = self.model.n_continuous(self.params)
        differences = (states[:, None, :n] - self.section_states[:, :n]) / np.asarray(units)[:n]
        return np.abs(differences).max(-1).min(-1) <= arrival.max_distance


class WalkVerdicts(NamedTuple):
    """Ends of walks, with a leading axis over starts."""

    is_on_gait: np.ndarray
    outcome: np.ndarray  # an Outcome, STEPPED if the walk goes on
    n_stepped: np.ndarray  # number of steps until the gait, the failure or the largest number


def walk_to_gait(
    gait: StableGait,
    starts: np.ndarray,
    max_steps: int,
    arrival: ArrivalOptions = ARRIVAL_OPTIONS,
) -> WalkVerdicts:
    """Return the end of a walk of at most `max_steps` steps from each section state."""
    n_starts = len(starts)
    is_on_gait, outcome = np.zeros(n_starts, bool), np.full(n_starts, int(Outcome.STEPPED))
    n_stepped = np.zeros(n_starts, int)
    embed: Any = jax.vmap(functools.partial(gait.model.embed_section, gait.params))
    states = np.array(embed(jnp.asarray(starts)))
    walking, n_walked = np.arange(n_starts), 0
    while len(walking) and n_walked < max_steps:
        n_round_steps = min(arrival.steps_per_round, max_steps - n_walked)
        walks = step_batch(
            gait.params, states[walking], n_round_steps, model=gait.model, options=gait.options
        )
        states[walking], outcome[walking] = walks.section_state, walks.outcome
        n_stepped[walking] += walks.n_stepped
        has_stepped = walks.outcome == Outcome.STEPPED
        is_on_gait[walking] = has_stepped & gait.contains(walks.section_state, arrival)
        walking = walking[has_stepped & ~is_on_gait[walking]]
        n_walked += n_round_steps
    return WalkVerdicts(is_on_gait, outcome, n_stepped)
