"""What the page computes: the library's own step by lanes, as functions of plain arrays.

A wheel is a column of nine parameters in the order of `WheelParams`, a start one of three numbers.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from vrw_jax import simd
from vrw_jax.models import (
    DIRECTIONS,
    RigidWheel,
    StepResult,
    UnilateralWheel,
    along_units,
    gait_step,
)
from vrw_jax.models.lane_step import lane_phase, walk
from vrw_jax.models.paper_step import result_of, told_of
from vrw_jax.models.rigid import Roll
from vrw_jax.models.unilateral.lanes import Walk, walked
from vrw_jax.models.unilateral.section import embedded, section_size
from vrw_jax.models.viscoelastic import described
from vrw_jax.numerics import Options, explicit_tableau, sample_lanes
from vrw_jax.results import MARGINS
from vrw_jax.wheel import PARAMETER_NAMES, WheelParams, wheel_of

LEGS = (6, 8, 10)
"""Numbers of legs that the page offers: each is code of its own."""
SAMPLES = 24
"""Times of each phase that the animation knows, ends included."""

SOLVER = Options.__dataclass_fields__["solver"].default


class Program(NamedTuple):
    """A function of `numbers` numbers and of a wheel and a start."""

    function: Callable[..., tuple]
    numbers: int
    small: int = simd.SMALL
    section: int = 3

    def object(self, name: str) -> bytes:
        """As code for WebAssembly."""
        rows = len(PARAMETER_NAMES), self.section
        return simd.web_object(self.function, self.numbers, rows, name, self.small)


TOLD = {name: m for name, m in MARGINS.items() if name != "takeoff_acceleration"}
"""Margins on the page: of scuffing the clearances tell there."""


def programs(n_legs: int) -> dict[str, Program]:
    """By name: what of a step is told, of wheels with so many legs."""

    def wheel(parameters: Array) -> WheelParams:
        return wheel_of(tuple(parameters), n_legs)

    def linearised(tolerance: Array, parameters: Array, x: Array) -> tuple:
        """Section state and durations; outcome and solver's steps; how the first two move with each
        of the start's numbers."""
        params, options = wheel(parameters), _options(tolerance)
        moved = lambda *start: _advance(params, start, options)
        columns, numbers, codes = along_units(moved, tuple(x), range(3))
        return jnp.stack(numbers), jnp.stack(codes), jnp.stack(columns, 1)

    def told(tolerance: Array, friction: Array, parameters: Array, x: Array) -> tuple:
        """All that the step tells, in `result_of`'s order, and its motion phase by phase."""
        params, options = wheel(parameters), _options(tolerance)
        walked = walk(params, tuple(x), options, explicit_tableau(SOLVER), True, monitored=True)
        step = result_of(walked.s, walked.landing, told_of(walked), friction)
        motion = []
        for phase, start, end in zip(walked.phases, walked.starts, walked.ends, strict=True):
            flow = lane_phase(phase, monitored=False)
            samples = sample_lanes(
                flow, explicit_tableau(SOLVER), *start, end.duration, SAMPLES, options
            )
            motion.append(jnp.concatenate(described(phase, jnp.moveaxis(samples, 1, 0))))
        codes = jnp.stack([step.outcome, step.solver_steps]).astype(jnp.int32)
        return _numbers_of(step), codes, *motion

    return {
        "linearised": Program(linearised, 1, DIRECTIONS),
        "told": Program(told, 2),
        **_of_rigid_legs(wheel),
        **_on_ground(wheel, n_legs),
    }


def _on_ground(wheel: Callable[[Array], WheelParams], n_legs: int) -> dict[str, Program]:
    """The section state of real ground that a state of the paper's is, and a step from there."""
    model = UnilateralWheel()

    def begun(parameters: Array, x: Array) -> tuple:
        return (embedded(wheel(parameters).symbols(), x),)

    def advance(tolerance: Array, friction: Array, parameters: Array, x: Array) -> tuple:
        """Section state, durations and length; outcome and solver's steps."""
        rules = jnp.int32(1), model.max_events, model.one_sided, model.by_paper, False
        walk = Walk(n_legs, *rules, _options(tolerance), explicit_tableau(SOLVER))
        columns = jnp.concatenate([parameters, (friction + 0.0 * x[0])[None]])
        end = walked(walk, columns, x)
        codes = jnp.stack([end.outcome, end.tried])
        return jnp.concatenate([*end.told[:2], end.told.step_length[None]]), codes

    size = section_size(n_legs)
    return {"ground_begun": Program(begun, 0), "ground_advance": Program(advance, 2, section=size)}


def _of_rigid_legs(wheel: Callable[[Array], WheelParams]) -> dict[str, Program]:
    """The same of the lowest rung, in whose formulas no tolerance stands."""

    def rolled(parameters: Array, x: tuple) -> tuple[tuple, tuple]:
        step = RigidWheel().rolled(wheel(parameters), x, jnp.ones_like(x[0]))
        return (*step.section_state, *step.durations), (step.outcome, step.solver_steps)

    def linearised(tolerance: Array, parameters: Array, x: Array) -> tuple:
        moved = lambda *start: rolled(parameters, start)
        columns, numbers, codes = along_units(moved, tuple(x), range(3))
        return jnp.stack(numbers), jnp.stack(codes), jnp.stack(columns, 1)

    def told(tolerance: Array, friction: Array, parameters: Array, x: Array) -> tuple:
        params = wheel(parameters)
        step = RigidWheel().rolled(params, tuple(x), friction + 0.0 * x[0])
        half = 0.5 * params.leg_angle
        share = jnp.arange(SAMPLES)[:, None] * (1.0 / (SAMPLES - 1))
        roll = Roll(params.symbols(), params.slope, step.post_impact[1])
        theta = half * (2.0 * share - 1.0) + 0.0 * x[0]
        rows = jnp.concatenate([*roll.described(theta), roll.time(theta)[None]])
        codes = jnp.stack([step.outcome, step.solver_steps])
        return _numbers_of(step), codes, rows

    return {
        "rigid_linearised": Program(linearised, 1, DIRECTIONS),
        "rigid_told": Program(told, 2),
    }


def _numbers_of(step: StepResult) -> Array:
    """What a step tells, row by row."""
    parts = (
        step.section_state, step.post_impact, step.durations, step.step_length,
        *vars(step.indicators).values(), *(getattr(step.monitors, name) for name in TOLD),
        *vars(step.energy).values(),
    )  # fmt: skip
    return jnp.concatenate([jnp.atleast_2d(part) for part in parts])


def _advance(params: WheelParams, x: tuple[Array, ...], options: Options) -> tuple[tuple, tuple]:
    step = gait_step(params, x, options, explicit_tableau(SOLVER), stop_at_lift_off=True)
    return (*step.section_state, *step.durations), (step.outcome, step.solver_steps)


def _options(tolerance: Array) -> Options:
    """The library's own, but for the tolerance."""
    return eqx.tree_at(lambda o: (o.rtol, o.atol), Options(), (tolerance, tolerance))
