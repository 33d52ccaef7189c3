"""Motion of a hybrid system during steps, as a labeled trajectory over time."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from vrw_jax.base.lazy_xarray import xarray as xr
from vrw_jax.base.options import StepOptions
from vrw_jax.base.outcomes import Outcome
from vrw_jax.flow.hybrid_simulation import Termination
from vrw_jax.flow.hybrid_system import (
    OUTCOME_BY_TERMINATION,
    HybridSystem,
    compile_simulation,
    describe_step_ending,
)
from vrw_jax.flow.phase_integration import sample_phase


def sample_walk_of_system(
    system: HybridSystem,
    params_of_steps: Sequence[Any],
    x: Any,
    options: StepOptions,
    n_samples: int,
) -> xr.Dataset:
    """Return the states of a walk at `n_samples` times of each mode, over time.

    The walk ends at the first step that fails, with the motion until its end.
    """
    mode_names, time, step, outcome = tuple(system.modes), 0.0, 0, Outcome.STEPPED
    pieces: list[tuple[np.ndarray, np.ndarray, int, int]] = []
    for step, params in enumerate(params_of_steps):
        start = system.embed(jnp.asarray(x), params)
        motion = jax.tree.map(np.asarray, compile_simulation(system)(params, start, options))
        n_events = int(motion.n_events)
        outcome = Outcome(OUTCOME_BY_TERMINATION[motion.termination])
        ending = describe_step_ending(Termination(int(motion.termination)))
        end_times, modes = motion.times[:n_events], motion.modes[:n_events]
        if outcome != Outcome.STEPPED and not (n_events and end_times[-1] == motion.time):
            end_times, modes = np.append(end_times, motion.time), np.append(modes, motion.mode)
        starts = [start, *motion.states_after[: len(modes) - 1]]
        for begin, end, state, mode in zip(
            [0.0, *end_times], end_times, starts, modes, strict=False
        ):
            sample = _compile_sampling(system, mode_names[mode], n_samples)
            states = np.asarray(sample(params, jnp.asarray(state), end - begin, options))
            pieces.append((time + np.linspace(begin, end, n_samples), states, step, int(mode)))
        if outcome != Outcome.STEPPED:
            break
        x = system.project(jnp.asarray(motion.states_after[n_events - 1]), params)
        time += float(end_times[-1])
    times, states, steps, modes = zip(*pieces, strict=True)
    repeat = lambda values: np.repeat(values, n_samples)
    units = system.state_units
    columns = dict(zip(system.state, np.concatenate(states).T, strict=True))
    flags = {"flag_values": list(range(len(mode_names))), "flag_meanings": " ".join(mode_names)}
    coordinates = {
        "time": ("time", np.concatenate(times), {"units": "s"}),
        "step": ("time", repeat(steps)),
        "phase": ("time", repeat(modes), {"long_name": "mode", **flags}),
    }
    return xr.Dataset(
        {
            f"state_{name}" if name in coordinates else name: (
                "time",
                column,
                {"units": units[name]} if name in units else {},
            )
            for name, column in columns.items()
        },
        coordinates,
        {
            "title": "Walk of a HybridSystem",
            "section": system.section,
            "n_steps": step + (outcome == Outcome.STEPPED),
            "outcome": outcome.name,
            "outcome_meaning": ending,
        },
    )


@functools.lru_cache
def _compile_sampling(system: HybridSystem, mode_name: str, n_samples: int) -> Any:
    evaluate: Any = system.modes[mode_name].field

    @jax.jit
    def sample(params: Any, state: Any, duration: Any, options: StepOptions) -> Any:
        return sample_phase(lambda y: evaluate(y, params), state, duration, n_samples, options)

    return sample
