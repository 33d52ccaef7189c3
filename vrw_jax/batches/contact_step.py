"""Steps of batches with unilateral contact."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from vrw_jax.batches.uneven_ground import walk_uneven_ground
from vrw_jax.batches.walk_batch import (
    START_NAME,
    StepBatchResult,
    StepwiseParameter,
    WalkBatch,
    complete_batch_slopes,
)
from vrw_jax.contact import embed_section_states, step_batch_with_jacobian, walk_batch
from vrw_jax.integrator import load_explicit_tableau
from vrw_jax.numerics import StepOptions
from vrw_jax.wheel import PARAMETER_NAMES

CONTACT_PARAMETERS = (*PARAMETER_NAMES, "friction")
UNEVEN_COLUMNS = "friction_before", "tilt"
"""Columns that uneven ground adds: friction of the feet that landed before, and by how much the
line ahead is steeper, rad."""
SLOPE, FRICTION = CONTACT_PARAMETERS.index("slope"), CONTACT_PARAMETERS.index("friction")
CONTACT_STEP_INPUTS = (START_NAME, *CONTACT_PARAMETERS)
"""Inputs with respect to which a step can be differentiated."""


def step_batch_with_contact(
    model: Any,
    parameters: list[np.ndarray],
    states: np.ndarray,
    n_steps: int,
    options: StepOptions,
    engine: str,
    n_legs: int,
    derivative_names: Sequence[str],
) -> StepBatchResult:
    """See `steps`; without derivatives all steps of a lane on flat ground are one walk."""
    friction = np.asarray(model.friction, states.dtype)
    uneven = any(np.ndim(x) == 2 for x in (*parameters, friction))
    if uneven and (engine == "diffrax" or model.restitution is not None):
        return walk_uneven_ground(
            model, parameters, states, n_steps, options, engine, n_legs, derivative_names
        )
    if engine not in ("auto", "lanes") or load_explicit_tableau(options.solver) is None:
        raise ValueError(
            f"engine is {engine!r} and solver {options.solver}, but batches with contact need "
            "'lanes' and an explicit Runge-Kutta solver: map vrw.return_map over the wheels."
        )
    ground = _Ground.of(parameters[SLOPE], friction, len(states), n_steps)
    parameters = [ground.slopes[0] if i == SLOPE else x for i, x in enumerate(parameters)]
    columns = np.stack([np.broadcast_to(x, len(states)) for x in (*parameters, ground.friction[0])])
    states = embed_section_states(columns, states, n_legs)
    zeros = np.zeros(len(states), np.int32)
    if not derivative_names and not uneven:
        walk_result = walk_batch(columns, states, n_steps, model, options, n_legs)
        x, durations, outcome, n_stepped, n_solver_steps, _ = map(np.asarray, walk_result)
        results = x, durations, outcome, n_stepped, n_solver_steps, zeros > 0, zeros
        return StepBatchResult(*results, engine="lanes", solver_names=(options.solver,))
    names, over_steps = CONTACT_PARAMETERS, {}
    if uneven:
        names, over_steps = (*CONTACT_PARAMETERS, *UNEVEN_COLUMNS), ground.over_steps()
    walks = WalkBatch(states.T.copy(), derivative_names, names, over_steps)
    for k in range(n_steps):
        active = walks.active_lanes()
        if not len(active):
            break
        columns = ground.columns_at(k, columns) if uneven else columns
        arguments = columns[:, active], walks.section_state[:, active].T, model, options, n_legs
        if not derivative_names:
            args = arguments[0], arguments[1], 1, *arguments[2:]
            x, durations, outcome, _, n_solver_steps, _ = map(np.asarray, walk_batch(*args))
            walks.record_step(
                active, (x.T, durations.T, outcome, n_solver_steps), zeros[active] > 0
            )
            continue
        step_result, step_jacobian = step_batch_with_jacobian(*arguments, walks.input_indices)
        input_jacobian = np.concatenate([step_jacobian.section_state, step_jacobian.durations], 1)[
            :, :, list(walks.input_indices)
        ]
        step_values = (
            step_result.section_state,
            step_result.durations,
            step_result.outcome,
            step_result.solver_steps,
        )
        walks.record_step(
            active,
            tuple(np.asarray(x).T for x in (*step_values, input_jacobian)),
            zeros[active] > 0,
        )
    return walks.to_result(np.arange(len(states)), zeros, "lanes", (options.solver,))


class _Ground(NamedTuple):
    """Lines and footholds of walks of some steps."""

    slopes: np.ndarray  # (n_steps + 1, wheels), rad
    friction: np.ndarray  # (n_steps, wheels)
    n_slopes: int | None  # given for each wheel; None: no array over steps
    n_frictions: int | None

    @classmethod
    def of(cls, slope: np.ndarray, friction: np.ndarray, n: int, n_steps: int) -> "_Ground":
        sizes = (x.shape[1] if x.ndim == 2 else None for x in (slope, friction))
        over = lambda x, n_rows: x if x.ndim == 2 else np.tile(np.broadcast_to(x, n), (n_rows, 1)).T
        slopes = complete_batch_slopes(over(slope, n_steps + 1), n_steps)
        return cls(slopes, over(friction, n_steps).T[:n_steps], *sizes)

    def columns_at(self, k: int, columns: np.ndarray) -> np.ndarray:
        """Those of step k."""
        columns = np.concatenate(
            [columns[: len(CONTACT_PARAMETERS)], np.empty((2, columns.shape[1]))]
        )
        columns[SLOPE], columns[FRICTION] = self.slopes[k], self.friction[k]
        columns[-2:] = self.friction[max(k - 1, 0)], self.slopes[k + 1] - self.slopes[k]
        return columns

    def over_steps(self) -> dict[str, StepwiseParameter]:
        """How steps move with slopes and frictions over steps."""
        before, tilt = len(CONTACT_PARAMETERS), len(CONTACT_PARAMETERS) + 1
        last = (self.n_slopes or 1) - 1
        on_lines = lambda k: ((0, k, 1.0), (1, k, -1.0), (1, min(k + 1, last), 1.0))
        own, others = (lambda k: k), (lambda k: max(k - 1, 0))
        if self.n_frictions is None:
            own = others = lambda k: 0
        feet = lambda k: ((0, own(k), 1.0), (1, others(k), 1.0))
        slopes = {"slope": StepwiseParameter((SLOPE, tilt), self.n_slopes, on_lines)}
        friction = {"friction": StepwiseParameter((FRICTION, before), self.n_frictions, feet)}
        return (slopes if self.n_slopes else {}) | friction
