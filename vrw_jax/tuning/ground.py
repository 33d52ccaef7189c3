"""Objective and constraints of a gait on real ground, with gradients along its branch.

The face is that of the paper's engine (`objective.Engine`). Where the order of events changes,
gradients are one-sided.
"""

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from vrw_jax.cycles import ground_gait, told, values_of
from vrw_jax.models import UnilateralStep, UnilateralWheel
from vrw_jax.numerics import Options
from vrw_jax.results import ON_GROUND
from vrw_jax.tuning.objective import AbstractEngine, Gait, is_same_branch
from vrw_jax.walks import walk
from vrw_jax.wheel import PARAMETER_NAMES, WheelParams, parameters_of, wheel_of

N_TOWARDS = 150
"""Steps towards the first gait, from the rung's start."""


@dataclass(frozen=True)
class GroundEngine(AbstractEngine):
    """Evaluates gaits of one tuning problem on real ground."""

    weights: tuple[tuple[str, float], ...]  # of the objective, a weighted sum of measures
    constraints: tuple[str, ...]
    n_legs: int
    model: UnilateralWheel
    options: Options

    def first_guess(self, parameters: Array) -> Array:
        """Where a walk from the rung's start ends."""
        wheel = wheel_of(parameters, self.n_legs)
        start = self.model.start(wheel)
        walked = walk(wheel, start, N_TOWARDS, model=self.model, options=self.options)
        return walked.steps.section_state[-1]

    def guess_of(self, gait: Gait) -> Array:
        return gait.cycle.section_state

    def __call__(self, parameters: Array, guess: Array) -> Gait:
        values = values_of(wheel_of(parameters, self.n_legs), self.model)
        gait = ground_gait(values, guess, self.n_legs, self.model, self.options)
        measures = told(gait, ON_GROUND)
        n = len(PARAMETER_NAMES)
        asked = [measures[name] for name in self.constraints]
        objective = sum(weight * measures[name][0] for name, weight in self.weights)
        slope = sum(weight * measures[name][1] for name, weight in self.weights)
        numbers = self.model.section_numbers(wheel_of(parameters, self.n_legs))
        return Gait(
            cycle=gait.cycle,
            step=gait.step,
            values=jnp.stack([jnp.asarray(objective), *(value for value, _ in asked)]),
            columns=jnp.stack([jnp.asarray(slope), *(by for _, by in asked)], -1)[:n],
            posture=jnp.concatenate([gait.cycle.section_state[:numbers], gait.step.durations]),
            posture_columns=jnp.concatenate(
                [gait.section_columns[:n, :numbers], gait.columns.durations[:n]], -1
            ),
        )

    def same_branch(self, here: Gait, there: Gait, change: np.ndarray) -> bool:
        """Whether a branch leads from one gait to the other; the order of events may change."""
        numbers = here.posture.shape[-1] - 3
        sides = [
            (
                np.asarray(gait.posture),
                np.asarray(gait.posture_columns),
                np.ones(1),
                np.asarray(gait.cycle.matrix)[:numbers, :numbers],
            )
            for gait in (here, there)
        ]
        return is_same_branch(sides[0], sides[1], change)

    def step(self, params: WheelParams, x: np.ndarray) -> UnilateralStep:
        return self.model.step(params, jnp.asarray(x), self.options)

    def monitored(self, step: UnilateralStep) -> dict[str, np.ndarray]:
        return {name: np.asarray(value) for name, value in step.measures().items()}

    def unkept(self, step: UnilateralStep) -> tuple[str, ...]:
        """Premises that the step breaks: this rung has none of the paper's."""
        return ()

    def compile(self, params: WheelParams) -> None:
        self(parameters_of(params), self.model.start(params))
