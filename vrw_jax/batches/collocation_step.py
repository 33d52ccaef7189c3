"""Gait steps of many wheels by collocation, in a fixed amount of work, near known gaits.

The method is Gauss collocation of order 8 on a few graded steps. The unknowns are the accelerations
at the four nodes of a step. The airborne leg's fast mode, near c/m, which forces an explicit method
to small steps, needs no extra work here. The node equations are solved by a fixed number of Newton
sweeps with one Jacobian. In the eigenvectors of the rule they are two complex systems of the
phase's size. In the last step the duration is corrected too, towards the event.

All lanes do the same work. A fixed amount of work does not detect its own errors, so each phase
returns indicators of its accuracy. They are the last corrections, the mismatch with the equations
of motion at each step's start, and the minimum of all guards. The start of a step is not a node. A
lane that fails these checks is stepped again by the adaptive engine.
"""

import functools
import operator
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool

from vrw_jax.collocation import (
    DOUBLE_END_WEIGHTS,
    DOUBLE_INTEGRATION_MATRIX,
    END_WEIGHTS,
    GAUSS_NODES,
    INTEGRATION_MATRIX,
    N_GAUSS_NODES,
    PhaseMesh,
    differentiation_matrix,
    integration_weights,
    lagrange_weights,
)
from vrw_jax.models import PAPER_START, is_valid_start, replace_invalid
from vrw_jax.numerics import Vector, value_and_partials
from vrw_jax.wheel import AbstractPhase, PhaseInstant, WheelParams, make_phases, transitions

_EIGENVALUES, _EIGENVECTORS = np.linalg.eig(INTEGRATION_MATRIX)
_UPPER_HALF = np.flatnonzero(_EIGENVALUES.imag > 0.0)
RULE_EIGENVALUES = _EIGENVALUES[_UPPER_HALF]
"""One eigenvalue of each conjugate pair of the rule."""
TO_EIGENVECTORS = np.linalg.inv(_EIGENVECTORS)[_UPPER_HALF]
"""Rows that project node values onto the eigenvectors of these eigenvalues."""
FROM_EIGENVECTORS = _EIGENVECTORS[:, _UPPER_HALF]
"""The eigenvectors of these eigenvalues, as columns."""

START_WEIGHTS = lagrange_weights(0.0)
"""Weights that interpolate node values to the start of a step."""
MIDDLE_WEIGHTS = lagrange_weights(0.5)
"""Weights that interpolate node values to the middle of a step."""
END_NODE_WEIGHTS = lagrange_weights(1.0)
"""Weights that interpolate node values to the end of a step."""
MIDDLE_INTEGRATION_WEIGHTS = integration_weights(0.5)
"""Weights that integrate node values once and twice from the start to the middle of a step."""
_DIFFERENTIATION_MATRIX = differentiation_matrix()
STRETCH_WEIGHTS = GAUSS_NODES[:, None] * _DIFFERENTIATION_MATRIX
"""Weights of the first derivative of the node values by the length of the step, relative to it."""
CURVATURE_WEIGHTS = (
    0.5 * (GAUSS_NODES * GAUSS_NODES)[:, None] * (_DIFFERENTIATION_MATRIX @ _DIFFERENTIATION_MATRIX)
)
"""Weights of half of the second derivative of the same."""

PHASE_MESHES = PhaseMesh(4, 1.0), PhaseMesh(5, 4.0), PhaseMesh(2, 1.0)


@dataclass(frozen=True)
class CollocationStepOptions:
    """Amount of work of a collocated step, and limits of the indicators of a trusted lane."""

    meshes: tuple[PhaseMesh, ...] = PHASE_MESHES
    """Meshes of DLS, SLS-I and SLS-II.

    They are chosen because they are the cheapest of those tried with errors below 1e-8. The errors
    are the 99th percentile over lanes near their gaits. The cost includes that of the lanes left to
    the adaptive engine (experiments/speed/engine_benchmark.py).
    """
    sweeps_per_step: int = 3
    """Number of sweeps in each step except the last of a phase."""
    n_event_rounds: int = 2
    """Number of corrections of the duration in the last step."""
    sweeps_per_round: int = 2
    """Number of sweeps after each of these corrections."""
    max_correction: float = 5e-8
    """Limit of `CollocatedPhase.correction`, rad/s and m/s."""
    max_event_shift: float = 1e-5
    """Limit of `CollocatedPhase.event_shift`, s.

    The end is extrapolated by the last shift, with an error of half of its square times a rate.
    """
    max_mismatch: tuple[float, float, float] = (2e-3, 1.2e-1, 8e-5)
    """Limits of `CollocatedPhase.mismatch` in DLS, SLS-I and SLS-II.

    They are chosen because errors are at most the square of a mismatch. One in a hundred lanes near
    its gait exceeds one of the limits.
    """


COLLOCATION_STEP_OPTIONS = CollocationStepOptions()


class CollocatedPhase(NamedTuple):
    """End of a phase, with indicators of its accuracy."""

    q: Vector
    v: Vector
    duration: Array  # s
    correction: Array  # estimated change of a rate by one more sweep, rad/s and m/s
    event_shift: Array  # last correction of the duration, s
    mismatch: Array  # largest error of the polynomial's rate at the start of a step
    min_guard: Array  # over all guards but the event, at ends and middles; positive if valid


NodeAccelerations = tuple[Vector, ...]
"""Accelerations at the nodes of a step."""


class _SweepState(NamedTuple):
    """State of the Newton sweeps of one step."""

    h: Array
    nodes: NodeAccelerations
    correction: Array
    previous_correction: Array  # correction of the previous sweep


class _SolvedStep(NamedTuple):
    """Solution of one step."""

    step: _SweepState
    end: tuple[Vector, Vector]
    event_shift: Array  # s
    mismatch: Array
    nonlinear_part: NodeAccelerations  # part that the equations linearized about its middle omit


def collocate_phase(
    phase: AbstractPhase,
    q: Vector,
    v: Vector,
    expected_duration: Array,
    mesh: PhaseMesh,
    options: CollocationStepOptions = COLLOCATION_STEP_OPTIONS,
) -> CollocatedPhase:
    """Integrate from (q, v) to the phase's own end, its first guard, near the expected duration."""
    fractions, zero = mesh.interval_fractions, jnp.zeros_like(expected_duration)
    # Squared ratio of successive step lengths: the growth of the nonlinear part.
    growth_factor = float(fractions[-1] / fractions[0]) ** (2.0 / max(mesh.n_intervals - 1, 1))

    def march(carry: tuple, fraction: Array) -> tuple[tuple, None]:
        q, v, correction, mismatch, min_guard, guards, nonlinear_part = carry
        h = fraction * expected_duration
        solved_step = _solve_step(phase, q, v, h, nonlinear_part, options)
        low_guard, guards = _min_guard(phase, q, v, solved_step, guards, 0)
        carry = (
            *solved_step.end,
            jnp.maximum(correction, _estimate_correction(solved_step.step)),
            jnp.maximum(mismatch, solved_step.mismatch),
            jnp.minimum(min_guard, low_guard),
            guards,
            tuple(tuple(growth_factor * x for x in node) for node in solved_step.nonlinear_part),
        )
        return carry, None

    guards = phase.guards(PhaseInstant(phase, phase.motion_at(q, v), None))
    carry = (q, v, zero, zero, zero + jnp.inf, guards, ((zero,) * len(q),) * N_GAUSS_NODES)
    if len(fractions) > 1:
        carry, _ = lax.scan(march, carry, jnp.asarray(fractions[:-1], expected_duration.dtype))
    q, v, correction, mismatch, min_guard, guards, nonlinear_part = carry
    h = float(fractions[-1]) * expected_duration
    last_step = _solve_step(phase, q, v, h, nonlinear_part, options, ends_at_event=True)
    low_guard, _ = _min_guard(phase, q, v, last_step, guards, 1)
    return CollocatedPhase(
        *last_step.end,
        duration=float(1.0 - fractions[-1]) * expected_duration
        + last_step.step.h
        + last_step.event_shift,
        correction=jnp.maximum(correction, _estimate_correction(last_step.step)),
        event_shift=jnp.abs(last_step.event_shift),
        mismatch=jnp.maximum(mismatch, last_step.mismatch),
        min_guard=jnp.minimum(jnp.minimum(min_guard, low_guard), last_step.step.h),
    )


def _estimate_correction(step: _SweepState) -> Array:
    """Estimate the correction of a further sweep from the last two."""
    ratio = step.correction / jnp.maximum(step.previous_correction, 1e-300)
    return step.correction * jnp.minimum(ratio, 1.0)


def _weighted_sum(weights: np.ndarray, nodes: NodeAccelerations, coordinate: int) -> Any:
    """Return the weighted sum of one coordinate over the nodes."""
    return sum(
        float(weight) * acceleration[coordinate]
        for weight, acceleration in zip(weights, nodes, strict=True)
    )


def _end_state(q: Vector, v: Vector, h: Array, nodes: NodeAccelerations) -> tuple[Vector, Vector]:
    """Return coordinates and rates at the end of a step."""
    n = range(len(q))
    return (
        tuple(q[d] + h * (v[d] + h * _weighted_sum(DOUBLE_END_WEIGHTS, nodes, d)) for d in n),
        tuple(v[d] + h * _weighted_sum(END_WEIGHTS, nodes, d) for d in n),
    )


def _node_state(node_index: int, q: Vector, v: Vector, h: Array, nodes: NodeAccelerations) -> tuple:
    """Return coordinates and rates at a node of a step."""
    n, node = range(len(q)), float(GAUSS_NODES[node_index])
    return (
        tuple(
            q[d]
            + h * (node * v[d] + h * _weighted_sum(DOUBLE_INTEGRATION_MATRIX[node_index], nodes, d))
            for d in n
        ),
        tuple(v[d] + h * _weighted_sum(INTEGRATION_MATRIX[node_index], nodes, d) for d in n),
    )


def _solve_step(
    phase: AbstractPhase,
    q: Vector,
    v: Vector,
    h: Array,
    nonlinear_part: NodeAccelerations,
    options: CollocationStepOptions,
    ends_at_event: bool = False,
) -> _SolvedStep:
    """Solve for the node accelerations of one step by sweeps, and for its length if it ends at an
    event.

    The Jacobian is taken at the step's middle; a sweep then gains some two digits. The sweeps start
    from the solution of the equations linearized there, plus `nonlinear_part`, the omitted part of
    the previous step. If the length changes, the nodes move along the polynomial through them.
    """
    dimension = len(q)
    start_acceleration = phase.acceleration(phase.motion_at(q, v))[:dimension]
    coordinates = range(dimension)
    middle_state = (
        tuple(q[d] + 0.5 * h * (v[d] + 0.25 * h * start_acceleration[d]) for d in coordinates),
        tuple(v[d] + 0.5 * h * start_acceleration[d] for d in coordinates),
    )
    residual, residual_by_q, residual_by_v, residual_by_a = _linearize_residual(
        phase, *middle_state, start_acceleration
    )
    inverses = [
        _invert_stage_matrix(complex(value), h, residual_by_q, residual_by_v, residual_by_a)
        for value in RULE_EIGENVALUES
    ]

    def correct(
        nodes: NodeAccelerations, h: Array, projections: list
    ) -> tuple[NodeAccelerations, Array]:
        corrections = []
        for inverse, projection in zip(inverses, projections, strict=True):
            products = [
                [_multiply(entry, x) for entry, x in zip(row, projection, strict=True)]
                for row in inverse
            ]
            corrections.append([_add_terms(row) for row in products])
        return _correct_nodes(nodes, corrections, h)

    def sweep(step: _SweepState, _: None) -> tuple[_SweepState, None]:
        residuals = []
        for node_index in range(N_GAUSS_NODES):
            Q, V = _node_state(node_index, q, v, step.h, step.nodes)
            residuals.append(phase.dynamics_residual(phase.motion_at(Q, V), step.nodes[node_index]))
        projections = [_project_residuals(weights, tuple(residuals)) for weights in TO_EIGENVECTORS]
        nodes, largest_correction = correct(step.nodes, step.h, projections)
        return _SweepState(step.h, nodes, largest_correction, step.correction), None

    def evaluate_event(q: Vector, v: Vector) -> tuple[Array, Vector]:
        instant = PhaseInstant(phase, phase.motion_at(q, v), None)
        return phase.end_guard(instant), instant.acceleration[: phase.n_dof]

    def shift_to_event(step: _SweepState) -> Array:
        """Return the time from the step's end to the event, by Newton's method."""
        end_q, end_v = _end_state(q, v, step.h, step.nodes)
        _, acceleration = evaluate_event(end_q, end_v)
        (value, _), (rate, _) = jax.jvp(evaluate_event, (end_q, end_v), (end_v, acceleration))
        event_shift = -value / jnp.where(rate < 0.0, rate, -jnp.inf)
        return jnp.clip(event_shift, -0.5 * step.h, 0.5 * step.h)

    def run_round(
        step_and_shift: tuple[_SweepState, Array], _: None
    ) -> tuple[tuple[_SweepState, Array], None]:
        step, event_shift = step_and_shift
        step = step._replace(
            h=step.h + event_shift, nodes=_stretch_step(step.nodes, event_shift / step.h)
        )
        step, _ = lax.scan(sweep, step, None, length=options.sweeps_per_round)
        return (step, shift_to_event(step)), None

    linear_nodes, largest_correction = correct(
        (start_acceleration,) * N_GAUSS_NODES,
        h,
        _project_linear_residuals(residual, residual_by_q, residual_by_v, v, start_acceleration, h),
    )
    first_nodes = _add_nodes(linear_nodes, nonlinear_part, 1.0)
    step = _SweepState(h, first_nodes, largest_correction, largest_correction)
    event_shift = jnp.zeros_like(h)
    if ends_at_event:
        (step, event_shift), _ = lax.scan(
            run_round, (step, shift_to_event(step)), None, length=options.n_event_rounds
        )
    else:
        step, _ = lax.scan(sweep, step, None, length=options.sweeps_per_step)
    mismatches = [
        jnp.abs(_weighted_sum(START_WEIGHTS, step.nodes, d) - start_acceleration[d])
        for d in coordinates
    ]
    mismatch = step.h * functools.reduce(jnp.maximum, mismatches)
    # The end is extrapolated by the last shift, whose square is negligible.
    Q, V = _end_state(q, v, step.h, step.nodes)
    end_state = (
        tuple(Q[d] + event_shift * V[d] for d in coordinates),
        tuple(
            V[d] + event_shift * _weighted_sum(END_NODE_WEIGHTS, step.nodes, d) for d in coordinates
        ),
    )
    return _SolvedStep(
        step, end_state, event_shift, mismatch, _add_nodes(step.nodes, linear_nodes, -1.0)
    )


def _add_nodes(
    nodes: NodeAccelerations, other_nodes: NodeAccelerations, factor: float
) -> NodeAccelerations:
    """Return the accelerations plus a factor times other ones."""
    pairs = zip(nodes, other_nodes, strict=True)
    return tuple(tuple(x + factor * y for x, y in zip(*pair, strict=True)) for pair in pairs)


def _stretch_step(nodes: NodeAccelerations, relative_growth: Array) -> NodeAccelerations:
    """Return the accelerations at the nodes of a step that is longer by a small fraction of its
    length."""
    coordinates = range(len(nodes[0]))
    return tuple(
        tuple(
            nodes[node_index][coordinate]
            + relative_growth
            * (
                _weighted_sum(STRETCH_WEIGHTS[node_index], nodes, coordinate)
                + relative_growth * _weighted_sum(CURVATURE_WEIGHTS[node_index], nodes, coordinate)
            )
            for coordinate in coordinates
        )
        for node_index in range(N_GAUSS_NODES)
    )


def _linearize_residual(phase: AbstractPhase, q: Vector, v: Vector, a: Vector) -> tuple:
    """Return the residual, and the columns of its derivatives with respect to q, v and a."""
    n = len(q)

    def evaluate_residual(*arguments: Array) -> Vector:
        q, v, a = (arguments[i * n : (i + 1) * n] for i in range(3))
        return phase.dynamics_residual(phase.motion_at(q, v), a)

    residual, rows = value_and_partials(evaluate_residual, (*q, *v, *a))
    columns = list(zip(*rows, strict=True))
    return residual, *(columns[i * n : (i + 1) * n] for i in range(3))


ComplexPair = tuple[Array, Array]


def _multiply(x: ComplexPair, y: ComplexPair) -> ComplexPair:
    """Return the product of complex numbers."""
    return x[0] * y[0] - x[1] * y[1], x[0] * y[1] + x[1] * y[0]


def _subtract(x: ComplexPair, y: ComplexPair) -> ComplexPair:
    """Return the difference of complex numbers."""
    return x[0] - y[0], x[1] - y[1]


def _add_terms(terms: Sequence[ComplexPair]) -> ComplexPair:
    """Return the sum of complex numbers."""
    first, *others = terms
    real, imaginary = first
    for term in others:
        real, imaginary = real + term[0], imaginary + term[1]
    return real, imaginary


def _invert_stage_matrix(
    eigenvalue: complex, h: Array, residual_by_q: Any, residual_by_v: Any, residual_by_a: Any
) -> Any:
    """Return the inverse of A + h e V + (h e)^2 Q.

    e is the eigenvalue. A, V and Q are the derivatives of the residual by accelerations, rates and
    coordinates.
    """
    n, square = len(residual_by_q), eigenvalue * eigenvalue
    scaled_value = (h * eigenvalue.real, h * eigenvalue.imag)
    scaled_square = (h * h * square.real, h * h * square.imag)
    matrix: list[list[ComplexPair]] = [
        [
            (
                residual_by_a[j][i]
                + scaled_value[0] * residual_by_v[j][i]
                + scaled_square[0] * residual_by_q[j][i],
                scaled_value[1] * residual_by_v[j][i] + scaled_square[1] * residual_by_q[j][i],
            )
            for j in range(n)
        ]
        for i in range(n)
    ]
    adjugate, determinant = _adjugate_and_determinant(matrix)

    squared_modulus = determinant[0] * determinant[0] + determinant[1] * determinant[1]
    reciprocal = (determinant[0] / squared_modulus, -determinant[1] / squared_modulus)
    return [[_multiply(reciprocal, entry) for entry in row] for row in adjugate]


def _adjugate_and_determinant(matrix: list[list[ComplexPair]]) -> tuple[Any, ComplexPair]:
    """Return adjugate and determinant of a matrix of one to three rows."""
    n = len(matrix)
    if n == 1:
        unit = (jnp.ones_like(matrix[0][0][0]), jnp.zeros_like(matrix[0][0][0]))
        return [[unit]], matrix[0][0]
    if n == 2:
        negate = lambda x: (-x[0], -x[1])
        rows = [[matrix[1][1], negate(matrix[0][1])], [negate(matrix[1][0]), matrix[0][0]]]
        return rows, _subtract(
            _multiply(matrix[0][0], matrix[1][1]), _multiply(matrix[0][1], matrix[1][0])
        )

    def cofactor(i: int, j: int) -> ComplexPair:
        (a, b), (c, d) = ((i + 1) % 3, (i + 2) % 3), ((j + 1) % 3, (j + 2) % 3)
        return _subtract(
            _multiply(matrix[a][c], matrix[b][d]), _multiply(matrix[a][d], matrix[b][c])
        )

    rows = [[cofactor(j, i) for j in range(3)] for i in range(3)]
    products = [_multiply(matrix[0][k], rows[k][0]) for k in range(3)]
    return rows, _add_terms(products)


def _project_residuals(weights: np.ndarray, residuals: NodeAccelerations) -> list[ComplexPair]:
    """Project the residuals of the nodes onto one pair of eigenvectors, with the sign of a
    correction."""
    return [
        (_weighted_sum(-weights.real, residuals, d), _weighted_sum(-weights.imag, residuals, d))
        for d in range(len(residuals[0]))
    ]


def _project_linear_residuals(
    residual: Vector, residual_by_q: Any, residual_by_v: Any, v: Vector, a: Vector, h: Array
) -> list[list[ComplexPair]]:
    """Return `_project_residuals` for accelerations `a` and the equations linearized about the
    middle."""
    n = range(len(v))
    multiply_columns = lambda columns, x: tuple(sum(columns[j][i] * x[j] for j in n) for i in n)
    damping_term = multiply_columns(residual_by_v, a)
    stiffness_rate_term = multiply_columns(residual_by_q, v)
    stiffness_acceleration_term = multiply_columns(residual_by_q, a)
    projections = []
    for weights in TO_EIGENVECTORS:
        constant_weight, linear_weight, quadratic_weight = (
            -complex(np.sum(weights * power))
            for power in (
                np.ones(N_GAUSS_NODES),
                GAUSS_NODES - 0.5,
                0.5 * GAUSS_NODES * GAUSS_NODES - 0.125,
            )
        )
        projections.append(
            [
                tuple(
                    part(constant_weight) * residual[i]
                    + h
                    * (
                        part(linear_weight) * (stiffness_rate_term[i] + damping_term[i])
                        + part(quadratic_weight) * h * stiffness_acceleration_term[i]
                    )
                    for part in (lambda x: x.real, lambda x: x.imag)
                )
                for i in n
            ]
        )
    return projections


def _correct_nodes(
    nodes: NodeAccelerations, corrections: list[list[ComplexPair]], h: Array
) -> tuple[NodeAccelerations, Array]:
    """Return the accelerations after the correction, and the largest rate that it changed."""
    corrected_nodes, largest_change = [], jnp.zeros_like(h)
    for node_index in range(N_GAUSS_NODES):
        row = []
        for coordinate in range(len(nodes[0])):
            change = sum(
                float(2.0 * FROM_EIGENVECTORS[node_index, pair_index].real) * pair[coordinate][0]
                - float(2.0 * FROM_EIGENVECTORS[node_index, pair_index].imag) * pair[coordinate][1]
                for pair_index, pair in enumerate(corrections)
            )
            row.append(nodes[node_index][coordinate] + change)
            largest_change = jnp.maximum(largest_change, jnp.abs(change))
        corrected_nodes.append(tuple(row))
    return tuple(corrected_nodes), h * largest_change


def _min_guard(
    phase: AbstractPhase,
    q: Vector,
    v: Vector,
    solved_step: _SolvedStep,
    start_guards: Vector,
    n_skipped: int,
) -> tuple[Array, Vector]:
    """Return the smallest guard at the step's middle and end, and all guards at the end.

    The smallest guard is -1 if a guard may be negative in between. Between the three points a guard
    may dip by a quarter of its second difference. `start_guards` are those at the start.
    `n_skipped` is 1 in the last step, whose first guard is the event itself and zero at the end.
    """
    step, coordinates = solved_step.step, range(len(q))
    middle_acceleration = tuple(_weighted_sum(MIDDLE_WEIGHTS, step.nodes, i) for i in coordinates)
    end_acceleration = tuple(_weighted_sum(END_NODE_WEIGHTS, step.nodes, i) for i in coordinates)
    velocity_integral, position_integral = (
        tuple(_weighted_sum(w, step.nodes, i) for i in coordinates)
        for w in MIDDLE_INTEGRATION_WEIGHTS
    )
    middle_state = (
        tuple(q[i] + step.h * (0.5 * v[i] + step.h * position_integral[i]) for i in coordinates),
        tuple(v[i] + step.h * velocity_integral[i] for i in coordinates),
    )
    evaluate_guards = lambda q, v, a: phase.guards(PhaseInstant(phase, phase.motion_at(q, v), a))
    middle_guards = evaluate_guards(*middle_state, middle_acceleration)
    end_guards = evaluate_guards(*solved_step.end, end_acceleration)
    min_guard = jnp.full_like(step.h, jnp.inf)
    for i, (start_value, middle_value, end_value) in enumerate(
        zip(start_guards, middle_guards, end_guards, strict=True)
    ):
        low_guard = jnp.minimum(start_value, middle_value)
        if i >= n_skipped:
            low_guard = jnp.minimum(low_guard, end_value)
            possible_dip = 0.25 * jnp.abs(start_value - 2.0 * middle_value + end_value)
            low_guard = jnp.where(low_guard > possible_dip, low_guard, -1.0)
        min_guard = jnp.minimum(min_guard, low_guard)
    return min_guard, end_guards


class CollocationStep(NamedTuple):
    """One gait step of a block of lanes, with the lanes that pass the checks."""

    section_state: Vector  # three arrays
    durations: Vector  # of DLS, SLS-I, SLS-II, s
    is_trusted: Bool[Array, " lanes"]


def collocation_gait_step(
    params: WheelParams,
    x: Vector,
    expected_durations: Vector,
    stop_at_lift_off: bool,
    options: CollocationStepOptions = COLLOCATION_STEP_OPTIONS,
) -> CollocationStep:
    """Take one gait step of every lane, near the expected durations of DLS, SLS-I and SLS-II."""
    has_valid_duration = [(duration > 0.0) & (duration < 10.0) for duration in expected_durations]
    is_valid = functools.reduce(operator.and_, has_valid_duration, is_valid_start(params, x))
    params, x = replace_invalid(is_valid, params, x, PAPER_START)
    expected_durations = tuple(
        jnp.where(is_valid, duration, 0.1) for duration in expected_durations
    )
    s = params.symbols()
    landing = transitions.land(s, *x)
    is_trusted = is_valid & landing.keeps_rear_foot
    theta, motion = landing.theta, landing.motion
    phases = make_phases(s, landing.distance, stop_at_lift_off)
    durations = []
    for phase, duration, mesh, max_mismatch in zip(
        phases, expected_durations, options.meshes, options.max_mismatch, strict=True
    ):
        start = phase.own_coordinates(theta, motion)
        end = collocate_phase(phase, *start, duration, mesh, options)
        is_trusted = (
            is_trusted
            & (end.correction <= options.max_correction)
            & (end.event_shift <= options.max_event_shift)
            & (end.mismatch <= max_mismatch)
            & (end.min_guard > 0.0)
        )
        theta, motion = end.q[0], phase.reset_map(phase.motion_at(end.q, end.v))
        durations.append(end.duration)
    mask = lambda values: tuple(jnp.where(is_trusted, value, 0.0) for value in values)
    return CollocationStep(mask((theta, motion.dtheta, motion.dL1)), mask(durations), is_trusted)
