"""One explicit Runge-Kutta step for a batch, with separate arrays per component.

The equations of motion are of second order, q'' = f(q, q'), so a step stores only the accelerations
of its stages. Positions use the square of the tableau's matrix, rates the matrix. The method is the
same, with half of the stored derivatives. The tableaus are those of diffrax.
"""

import functools
import itertools
import json
import math
import operator
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from vrw_jax.numerics import Vector, run_if_any


class ButcherTableau(NamedTuple):
    """An explicit method whose last stage is the step's end and the first stage of the
    next step.
    """

    order: int
    nodes: np.ndarray  # Butcher's c: of the stages, in step lengths
    matrix: np.ndarray  # Butcher's A: from accelerations to rates
    matrix_squared: np.ndarray  # A squared: from accelerations to positions
    b_error: np.ndarray
    b_error_position: np.ndarray
    middle_stage: int
    """Index of a stage well inside the step, at which the parabolas through guards are fitted."""
    guard_stages: tuple[int, ...]
    """Stages separated from each other and from both ends, at which guards are sampled to find
    dips."""
    bernstein_matrix: np.ndarray
    """Matrix from guard values to the inner Bernstein coefficients of the polynomial through them,
    which does not fall below its least coefficient. The values are those at the start, at
    `guard_stages` and at the end."""

    def __eq__(self, other: object) -> bool:
        return self is other  # `load_explicit_tableau` creates each tableau once

    def __hash__(self) -> int:
        return id(self)


@functools.cache
def load_explicit_tableau(name: str) -> ButcherTableau | None:
    """Return diffrax's tableau of that name; None if the method is not explicit Runge-Kutta.

    The numbers are stored beside this file, because loading diffrax takes a fifth of a cached
    start.
    """
    tableaus = json.loads(Path(__file__).with_name("tableaus.json").read_text(encoding="utf-8"))
    if name not in tableaus:
        return None
    entry = tableaus[name]
    n, has_step_end_stage = len(entry["b_sol"]), entry["ssal"]
    matrix = np.zeros((n + (not has_step_end_stage), n + (not has_step_end_stage)))
    for i, row in enumerate(entry["a_lower"]):
        matrix[i + 1, : i + 1] = row
    b_error = np.zeros(len(matrix))
    b_error[:n] = entry["b_error"]
    if not has_step_end_stage:
        matrix[n, :n] = entry["b_sol"]
    nodes = matrix.sum(axis=1)
    guard_stages = _choose_guard_stages(nodes)
    return ButcherTableau(
        order=entry["order"],
        nodes=nodes,
        matrix=matrix,
        matrix_squared=_zero_roundoff(matrix @ matrix),
        b_error=b_error,
        b_error_position=_zero_roundoff(b_error @ matrix),
        middle_stage=min(guard_stages, key=lambda i: abs(nodes[i] - 0.45), default=0),
        guard_stages=guard_stages,
        bernstein_matrix=_make_bernstein_matrix(np.array([0.0, *nodes[list(guard_stages)], 1.0])),
    )


GUARD_STAGE_NODES = (0.15, 0.47, 0.92)
"""Approximate nodes at which guards are sampled inside a step.

They are chosen nearer to the ends than equally spaced nodes, because a dip just after the start or
before the end is the hardest to detect.
"""


def _choose_guard_stages(nodes: np.ndarray) -> tuple[int, ...]:
    """Return the stages nearest to GUARD_STAGE_NODES; of several at one node the last, most
    accurate.
    """
    last_stage = {round(float(node), 3): i for i, node in enumerate(nodes) if 0.05 < node < 0.95}
    nearest_nodes = {
        min((abs(node - target_node), node) for node in last_stage)[1]
        for target_node in GUARD_STAGE_NODES
        if last_stage
    }
    return tuple(last_stage[node] for node in sorted(nearest_nodes))


def _make_bernstein_matrix(nodes: np.ndarray) -> np.ndarray:
    """Return the matrix of inner Bernstein coefficients for values at nodes of [0, 1]."""
    n = len(nodes) - 1
    basis = [math.comb(n, i) * nodes**i * (1.0 - nodes) ** (n - i) for i in range(n + 1)]
    return np.linalg.inv(np.stack(basis, 1))[1:-1]


def fit_guard_parabola(
    tableau: ButcherTableau, start_value: Array, middle_value: Array, end_value: Array
) -> tuple[Array, Array]:
    """Return curvature and rate, in step lengths, of the parabola through a guard's values.

    `middle_value` is the guard at the stage `middle_stage`.
    """
    middle_node = float(tableau.nodes[tableau.middle_stage])
    curvature = (end_value - start_value - (middle_value - start_value) / middle_node) / (
        1.0 - middle_node
    )
    return curvature, end_value - start_value - curvature


def _bernstein_coefficients(tableau: ButcherTableau, values: list[Array]) -> list[Array]:
    """Return a guard's Bernstein coefficients except the last; the guard is positive if all are.

    `values` are those at the start, at the `guard_stages`, and at the end.
    """
    return [values[0], *(_weighted_sum(row, values) for row in tableau.bernstein_matrix)]


@functools.partial(jax.jit, static_argnums=0)  # traced once, for whichever guard
def _may_dip(tableau: ButcherTableau, guard_values: list[Array]) -> Array:
    """Return whether a guard may fall below zero inside a step and be positive again at its end."""
    coefficients = _bernstein_coefficients(tableau, guard_values)
    return (functools.reduce(jnp.minimum, coefficients) <= 0.0) & (guard_values[-1] > 0.0)


@functools.partial(jax.jit, static_argnums=0)  # traced once, for whichever guard
def find_dip(tableau: ButcherTableau, values: list[Array]) -> tuple[Array, Array]:
    """Return whether a guard may dip and rises somewhere, and the fraction of the step to try
    first.

    A guard that only decays is no dip, however steep. The fraction is the node of the lowest
    Bernstein coefficient. `values`: at the start, at the `guard_stages`, at the end.
    """
    min_coefficient, *inner_coefficients = _bernstein_coefficients(tableau, values)
    dip_fraction = jnp.zeros_like(min_coefficient)
    for i, coefficient in enumerate(inner_coefficients):
        dip_fraction = jnp.where(
            coefficient < min_coefficient, (i + 1) / len(values[1:]), dip_fraction
        )
        min_coefficient = jnp.minimum(coefficient, min_coefficient)
    is_rising = inner_coefficients[-1] < values[-1]
    for previous_value, next_value in itertools.pairwise(values):
        is_rising = is_rising | (previous_value < next_value)
    has_dip = (min_coefficient <= 0.0) & (dip_fraction > 0.0) & is_rising & (values[-1] > 0.0)
    return has_dip, dip_fraction


def earliest_dip_fraction(tableau: ButcherTableau, guard_values: list[Vector]) -> Array:
    """Return the fraction of the step before a guard that may dip below zero in it; 1 if there is
    none.

    `guard_values`: at the start, at the `guard_stages` and at the end. The dip is located only if
    some batch element of the group may have one.
    """
    values_by_guard = [list(values) for values in zip(*guard_values, strict=True)]
    may_dip = functools.reduce(
        operator.or_, (_may_dip(tableau, values) for values in values_by_guard)
    )

    def find_first_dip(fraction: Array) -> Array:
        for values in values_by_guard:
            has_dip, dip_fraction = find_dip(tableau, values)
            fraction = jnp.where(has_dip, jnp.minimum(fraction, dip_fraction), fraction)
        return fraction

    whole_step = jnp.ones_like(guard_values[0][0])
    return run_if_any(jnp.any(may_dip), find_first_dip, whole_step)


@dataclass(frozen=True)
class StepSizeController:
    """Parameters of the step-size controller, chosen because they are usual for explicit methods
    (Hairer, Norsett and Wanner, Solving Ordinary Differential Equations I, Section II.4).
    """

    safety_factor: float = 0.9
    """Factor on the length that would meet the tolerance exactly."""
    min_factor: float = 0.2
    """Least ratio of successive lengths."""
    max_factor: float = 5.0
    """Largest ratio of successive lengths; after a rejected step it is 1."""


STEP_SIZE_CONTROLLER = StepSizeController()


def step_size_factor(
    tableau: ButcherTableau,
    squared_error: Array,
    dtype: Any,
    controller: StepSizeController = STEP_SIZE_CONTROLLER,
) -> Array:
    """Return the next step's length over this one's, from its squared error over tolerance."""
    error_power = jnp.exp(
        jnp.log(jnp.clip(squared_error, 1e-20, 1e20)) * (-0.5 / tableau.order)
    ).astype(dtype)
    return jnp.clip(
        controller.safety_factor * error_power,
        controller.min_factor,
        jnp.where(squared_error <= 1.0, controller.max_factor, 1.0),
    )


def _zero_roundoff(x: np.ndarray) -> np.ndarray:
    """Return the products of a tableau with entries that are only round-off set to zero."""
    return np.where(np.abs(x) < 1e-14 * np.max(np.abs(x)), 0.0, x)


class StageAcceleration(NamedTuple):
    """Accelerations at one state, with the sine and cosine of theta."""

    sin: Array  # of theta
    cos: Array
    acceleration: Vector  # of all three coordinates, those of the phase first


def real_stability_limit(tableau: ButcherTableau) -> float:
    """Return the largest z with |R(-z)| <= 1: a mode of decay rate r allows steps up to z / r."""
    z, stages, amplification = np.linspace(0.01, 20.0, 2000), np.ones(len(tableau.nodes)), 1.0
    for power in range(1, len(stages) + 1):  # R is the polynomial 1 - z w (1 - z A + ...)
        amplification = amplification + (-z) ** power * (tableau.matrix[-1] @ stages)
        stages = tableau.matrix @ stages
    return float(z[np.argmax(np.abs(amplification) > 1.0 + 1e-12)])


class StageState(NamedTuple):
    """Positions, rates and accelerations of one stage."""

    q: Vector
    v: Vector
    acceleration: StageAcceleration


class RKStep(NamedTuple):
    """A Runge-Kutta step: its end, the error estimate, and its stages."""

    end: StageState
    error: Vector  # of positions, then rates
    stage_states: list[StageState]  # the start first, the end last


AccelerationFn = Callable[[Vector, Vector], StageAcceleration]
StepFn = Callable[[StageState, Array], RKStep]


def rk_step(
    tableau: ButcherTableau,
    evaluate: AccelerationFn,
    start: StageState,
    h: Array,
    with_error: bool = True,
) -> RKStep:
    """Take one Runge-Kutta step of length `h` from `start`, elementwise over the batch."""
    n = len(start.q)
    stage_states, stage_accelerations = [start], [start.acceleration.acceleration[:n]]
    for i in range(1, len(tableau.nodes)):
        q, v = evaluate_stage(tableau, i, start.q, start.v, stage_accelerations, h)
        stage_acceleration = evaluate(q, v)
        stage_states.append(StageState(q, v, stage_acceleration))
        stage_accelerations.append(stage_acceleration.acceleration[:n])

    error: Vector = ()
    if with_error:
        accelerations_by_coordinate = [
            [stage_acceleration[d] for stage_acceleration in stage_accelerations] for d in range(n)
        ]
        position_errors = [
            h * h * _weighted_sum(tableau.b_error_position, accelerations)
            for accelerations in accelerations_by_coordinate
        ]
        rate_errors = [
            h * _weighted_sum(tableau.b_error, accelerations)
            for accelerations in accelerations_by_coordinate
        ]
        error = (*position_errors, *rate_errors)
    return RKStep(stage_states[-1], error, stage_states)


@functools.partial(jax.jit, static_argnums=(0, 1))  # traced once for all steps
def evaluate_stage(
    tableau: ButcherTableau,
    stage_index: int,
    q0: Vector,
    v0: Vector,
    stage_accelerations: list[Vector],
    h: Array,
) -> tuple[Vector, Vector]:
    """Return positions and rates of one stage, from the accelerations of those before."""
    position, rate = [], []
    for d in range(len(q0)):
        coordinate_accelerations = [
            stage_acceleration[d] for stage_acceleration in stage_accelerations
        ]
        double_sum = _weighted_sum(tableau.matrix_squared[stage_index], coordinate_accelerations)
        single_sum = _weighted_sum(tableau.matrix[stage_index], coordinate_accelerations)
        drift = float(tableau.nodes[stage_index]) * v0[d]
        position.append(q0[d] + h * (drift if double_sum is None else drift + h * double_sum))
        rate.append(v0[d] + h * single_sum)
    return tuple(position), tuple(rate)


def _weighted_sum(weights: np.ndarray, terms: list[Array]) -> Any:
    """Return a weighted sum, None if all weights vanish.

    It uses functions of `lax`, because half of a step's operations are such sums, and Python's
    operators take three times as long to trace.
    """
    pairs = zip(weights, terms, strict=False)
    parts = [lax.mul(x.dtype.type(w), x) for w, x in pairs if w != 0.0]
    return functools.reduce(lax.add, parts) if parts else None
