"""Gait steps of many wheels by collocation, in a fixed amount of work, near known gaits.

The method is Gauss collocation of order 8 on a few graded mesh intervals. The unknowns are the
accelerations at the four nodes of an interval. The airborne leg's fast mode, near c/m, forces an
explicit method to small steps and needs no extra work here. The node equations are solved by a
fixed number of Newton iterations ("sweeps") with one Jacobian. In the eigenvectors of the Gauss
rule they are two complex systems of the phase's size. In the last interval the duration is also
corrected, towards the event.

All lanes do the same work. A fixed amount of work does not detect errors, so each phase returns
indicators of its accuracy. These are the last corrections, the minimum of all guards, and the
residual of the equations of motion at each interval's start, which is no node. A lane that fails
these checks is stepped again by the adaptive engine.
"""

import functools
import operator
from collections.abc import Iterable, Sequence
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
from vrw_jax.wheel import (
    AbstractPhase,
    PhaseInstant,
    WheelParams,
    compute_wheel_units,
    convert_to_wheel_units,
    make_phases,
    transitions,
)

_EIGENVALUES, _EIGENVECTORS = np.linalg.eig(INTEGRATION_MATRIX)
_UPPER_HALF_PLANE_INDICES = np.flatnonzero(_EIGENVALUES.imag > 0.0)
GAUSS_EIGENVALUES = _EIGENVALUES[_UPPER_HALF_PLANE_INDICES]
"""One eigenvalue of each conjugate pair of the Gauss rule's integration matrix."""
EIGENVECTOR_PROJECTION = np.linalg.inv(_EIGENVECTORS)[_UPPER_HALF_PLANE_INDICES]
"""Matrix that projects node values onto the eigenvectors of `GAUSS_EIGENVALUES`, one row each."""
EIGENVECTOR_COLUMNS = _EIGENVECTORS[:, _UPPER_HALF_PLANE_INDICES]
"""Eigenvectors of `GAUSS_EIGENVALUES`, as columns."""

START_WEIGHTS = lagrange_weights(0.0)
"""Weights that extrapolate node values to the start of a mesh interval."""
MIDDLE_WEIGHTS = lagrange_weights(0.5)
"""Weights that interpolate node values to the middle of a mesh interval."""
END_NODE_WEIGHTS = lagrange_weights(1.0)
"""Weights that extrapolate node values to the end of a mesh interval."""
MIDDLE_INTEGRATION_WEIGHTS = integration_weights(0.5)
"""Weights that integrate node values once and twice from the start to the middle of an interval."""
_DIFFERENTIATION_MATRIX = differentiation_matrix()
STRETCH_WEIGHTS = GAUSS_NODES[:, None] * _DIFFERENTIATION_MATRIX
"""Weights of the first derivative of the node values by the relative length of the interval."""
CURVATURE_WEIGHTS = (
    0.5 * (GAUSS_NODES * GAUSS_NODES)[:, None] * (_DIFFERENTIATION_MATRIX @ _DIFFERENTIATION_MATRIX)
)
"""Weights of half of the second derivative of the node values by the relative length."""

PHASE_MESHES = PhaseMesh(4, 1.0), PhaseMesh(5, 4.0), PhaseMesh(2, 1.0)


@dataclass(frozen=True)
class CollocationStepOptions:
    """Options of the amount of work of a collocated step, and limits for trusted lanes."""

    meshes: tuple[PhaseMesh, ...] = PHASE_MESHES
    """Meshes of DLS, SLS-I and SLS-II.

    They are chosen because they are the cheapest of those tried with errors below 1e-8. The errors
    are the 99th percentile over lanes near their gaits. The cost includes the lanes that the
    adaptive engine repeats (experiments/speed/engine_benchmark.py)."""
    n_sweeps_per_step: int = 3
    """Number of Newton sweeps in each mesh interval except the last one of a phase."""
    n_event_rounds: int = 2
    """Number of corrections of the duration in the last mesh interval."""
    n_sweeps_per_event_round: int = 2
    """Number of Newton sweeps after each of these corrections."""
    max_duration: float = 10.0
    """Bound of the expected durations in the wheel's unit of time, chosen because no phase of a
    gait lasts that long."""
    max_correction: float = 5e-8
    """Largest accepted `CollocatedPhase.correction`, in the wheel's units of rates."""
    max_event_shift: float = 1e-5
    """Largest accepted `CollocatedPhase.event_shift`, in the wheel's unit of time.

    The end is extrapolated by the last shift, with an error of half of its square times a rate."""
    max_mismatch: tuple[float, float, float] = (2e-3, 1.2e-1, 8e-5)
    """Largest accepted `CollocatedPhase.mismatch` in DLS, SLS-I and SLS-II.

    The values are chosen because errors are at most the square of a mismatch. One in a hundred
    lanes near its gait exceeds one of the limits."""


COLLOCATION_STEP_OPTIONS = CollocationStepOptions()


class CollocatedPhase(NamedTuple):
    """End of a phase by collocation, with indicators of its accuracy."""

    q: Vector
    v: Vector
    duration: Array  # s
    correction: Array  # estimated change of a rate by one more sweep, rad/s and m/s
    event_shift: Array  # last correction of the duration, s
    mismatch: Array  # largest error of a rate at the start of an interval
    min_guard: Array  # lowest guard at ends and middles; positive if valid


NodeAccelerations = tuple[Vector, ...]
"""Accelerations at the nodes of a mesh interval."""


class _SweepState(NamedTuple):
    """State of the Newton sweeps of one mesh interval."""

    h: Array
    node_accelerations: NodeAccelerations
    correction: Array
    previous_correction: Array  # correction of the previous sweep


class _SolvedStep(NamedTuple):
    """Solution of one mesh interval."""

    sweep_state: _SweepState
    end_state: tuple[Vector, Vector]
    event_shift: Array  # s
    mismatch: Array
    nonlinear_part: NodeAccelerations  # part that the linearized equations omit


def collocate_phase(
    phase: AbstractPhase,
    q: Vector,
    v: Vector,
    expected_duration: Array,
    mesh: PhaseMesh,
    options: CollocationStepOptions = COLLOCATION_STEP_OPTIONS,
) -> CollocatedPhase:
    """Return the end of a phase from (q, v), at its first guard near the expected duration."""
    interval_fractions, float_zeros = mesh.interval_fractions, jnp.zeros_like(expected_duration)
    # The nonlinear part grows with the squared ratio of successive interval lengths.
    growth_factor = float(interval_fractions[-1] / interval_fractions[0]) ** (
        2.0 / max(mesh.n_intervals - 1, 1)
    )

    def advance_interval(carry: tuple, interval_fraction: Array) -> tuple[tuple, None]:
        q, v, correction, mismatch, min_guard, end_guards, nonlinear_part = carry
        h = interval_fraction * expected_duration
        solved_step = _solve_step(phase, q, v, h, nonlinear_part, options)
        lowest_guard, end_guards = _find_min_guard(phase, q, v, solved_step, end_guards, 0)
        carry = (
            *solved_step.end_state,
            jnp.maximum(correction, _estimate_correction(solved_step.sweep_state)),
            jnp.maximum(mismatch, solved_step.mismatch),
            jnp.minimum(min_guard, lowest_guard),
            end_guards,
            tuple(tuple(growth_factor * x for x in node) for node in solved_step.nonlinear_part),
        )
        return carry, None

    guards = phase.guards(PhaseInstant(phase, phase.motion_at(q, v), None))
    carry = (
        q,
        v,
        float_zeros,
        float_zeros,
        float_zeros + jnp.inf,
        guards,
        ((float_zeros,) * len(q),) * N_GAUSS_NODES,
    )
    if len(interval_fractions) > 1:
        carry, _ = lax.scan(
            advance_interval, carry, jnp.asarray(interval_fractions[:-1], expected_duration.dtype)
        )
    q, v, correction, mismatch, min_guard, guards, nonlinear_part = carry
    h = float(interval_fractions[-1]) * expected_duration
    last_step = _solve_step(phase, q, v, h, nonlinear_part, options, ends_at_event=True)
    lowest_guard, _ = _find_min_guard(phase, q, v, last_step, guards, 1)
    return CollocatedPhase(
        *last_step.end_state,
        duration=float(1.0 - interval_fractions[-1]) * expected_duration
        + last_step.sweep_state.h
        + last_step.event_shift,
        correction=jnp.maximum(correction, _estimate_correction(last_step.sweep_state)),
        event_shift=jnp.abs(last_step.event_shift),
        mismatch=jnp.maximum(mismatch, last_step.mismatch),
        min_guard=jnp.minimum(jnp.minimum(min_guard, lowest_guard), last_step.sweep_state.h),
    )


def _estimate_correction(sweep_state: _SweepState) -> Array:
    """Return the estimated correction of one more sweep, from the last two."""
    correction_ratio = sweep_state.correction / jnp.maximum(sweep_state.previous_correction, 1e-300)
    return sweep_state.correction * jnp.minimum(correction_ratio, 1.0)


def _weighted_sum(
    weights: np.ndarray, node_accelerations: NodeAccelerations, coordinate: int
) -> Any:
    """Return the weighted sum over the nodes of one coordinate's acceleration."""
    return sum(
        float(weight) * acceleration[coordinate]
        for weight, acceleration in zip(weights, node_accelerations, strict=True)
    )


def _compute_end_state(
    q: Vector, v: Vector, h: Array, node_accelerations: NodeAccelerations
) -> tuple[Vector, Vector]:
    """Return coordinates and rates at the end of a mesh interval."""
    n = range(len(q))
    return (
        tuple(
            q[d] + h * (v[d] + h * _weighted_sum(DOUBLE_END_WEIGHTS, node_accelerations, d))
            for d in n
        ),
        tuple(v[d] + h * _weighted_sum(END_WEIGHTS, node_accelerations, d) for d in n),
    )


def _compute_node_state(
    node_index: int, q: Vector, v: Vector, h: Array, node_accelerations: NodeAccelerations
) -> tuple:
    """Return coordinates and rates at a node of a mesh interval."""
    n, node_position = range(len(q)), float(GAUSS_NODES[node_index])
    return (
        tuple(
            q[d]
            + h
            * (
                node_position * v[d]
                + h * _weighted_sum(DOUBLE_INTEGRATION_MATRIX[node_index], node_accelerations, d)
            )
            for d in n
        ),
        tuple(
            v[d] + h * _weighted_sum(INTEGRATION_MATRIX[node_index], node_accelerations, d)
            for d in n
        ),
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
    """Return the solution of one mesh interval by Newton sweeps.

    If the interval ends at an event, its length is also an unknown. The Jacobian is taken at the
    middle of the interval; a sweep then gains some two digits. The sweeps start from the solution
    of the equations linearized there, plus `nonlinear_part`, the omitted part of the previous
    interval. If the length changes, the nodes move along the polynomial through them.
    """
    n_dof = len(q)
    start_acceleration = phase.acceleration(phase.motion_at(q, v))[:n_dof]
    coordinate_indices = range(n_dof)
    middle_state = (
        tuple(
            q[d] + 0.5 * h * (v[d] + 0.25 * h * start_acceleration[d]) for d in coordinate_indices
        ),
        tuple(v[d] + 0.5 * h * start_acceleration[d] for d in coordinate_indices),
    )
    residual, residual_by_q, residual_by_v, residual_by_a = _linearize_residual(
        phase, *middle_state, start_acceleration
    )
    inverse_stage_matrices = [
        _invert_stage_matrix(complex(value), h, residual_by_q, residual_by_v, residual_by_a)
        for value in GAUSS_EIGENVALUES
    ]

    def correct_accelerations(
        node_accelerations: NodeAccelerations, h: Array, projections: list
    ) -> tuple[NodeAccelerations, Array]:
        corrections = []
        for inverse_matrix, projection in zip(inverse_stage_matrices, projections, strict=True):
            products = [
                [
                    _multiply_complex(matrix_entry, x)
                    for matrix_entry, x in zip(matrix_row, projection, strict=True)
                ]
                for matrix_row in inverse_matrix
            ]
            corrections.append([_add_complex_numbers(matrix_row) for matrix_row in products])
        return _correct_nodes(node_accelerations, corrections, h)

    def run_sweep(sweep_state: _SweepState, _: None) -> tuple[_SweepState, None]:
        residuals = []
        for node_index in range(N_GAUSS_NODES):
            Q, V = _compute_node_state(
                node_index, q, v, sweep_state.h, sweep_state.node_accelerations
            )
            residuals.append(
                phase.dynamics_residual(
                    phase.motion_at(Q, V), sweep_state.node_accelerations[node_index]
                )
            )
        projections = [
            _project_residuals(weights, tuple(residuals)) for weights in EIGENVECTOR_PROJECTION
        ]
        node_accelerations, largest_correction = correct_accelerations(
            sweep_state.node_accelerations, sweep_state.h, projections
        )
        return _SweepState(
            sweep_state.h, node_accelerations, largest_correction, sweep_state.correction
        ), None

    def evaluate_event(q: Vector, v: Vector) -> tuple[Array, Vector]:
        instant = PhaseInstant(phase, phase.motion_at(q, v), None)
        return phase.end_guard(instant), instant.acceleration[: phase.n_dof]

    def shift_to_event(sweep_state: _SweepState) -> Array:
        """Return the time from the interval's end to the event, by Newton's method, s."""
        end_q, end_v = _compute_end_state(q, v, sweep_state.h, sweep_state.node_accelerations)
        _, acceleration = evaluate_event(end_q, end_v)
        (guard_value, _), (guard_rate, _) = jax.jvp(
            evaluate_event, (end_q, end_v), (end_v, acceleration)
        )
        event_shift = -guard_value / jnp.where(guard_rate < 0.0, guard_rate, -jnp.inf)
        return jnp.clip(event_shift, -0.5 * sweep_state.h, 0.5 * sweep_state.h)

    def correct_duration(
        sweep_state_and_shift: tuple[_SweepState, Array], _: None
    ) -> tuple[tuple[_SweepState, Array], None]:
        sweep_state, event_shift = sweep_state_and_shift
        sweep_state = sweep_state._replace(
            h=sweep_state.h + event_shift,
            node_accelerations=_stretch_nodes(
                sweep_state.node_accelerations, event_shift / sweep_state.h
            ),
        )
        sweep_state, _ = lax.scan(
            run_sweep, sweep_state, None, length=options.n_sweeps_per_event_round
        )
        return (sweep_state, shift_to_event(sweep_state)), None

    linear_accelerations, largest_correction = correct_accelerations(
        (start_acceleration,) * N_GAUSS_NODES,
        h,
        _project_linear_residuals(residual, residual_by_q, residual_by_v, v, start_acceleration, h),
    )
    initial_accelerations = _add_nodes(linear_accelerations, nonlinear_part, 1.0)
    sweep_state = _SweepState(h, initial_accelerations, largest_correction, largest_correction)
    event_shift = jnp.zeros_like(h)
    if ends_at_event:
        (sweep_state, event_shift), _ = lax.scan(
            correct_duration,
            (sweep_state, shift_to_event(sweep_state)),
            None,
            length=options.n_event_rounds,
        )
    else:
        sweep_state, _ = lax.scan(run_sweep, sweep_state, None, length=options.n_sweeps_per_step)
    mismatches = [
        jnp.abs(
            _weighted_sum(START_WEIGHTS, sweep_state.node_accelerations, d) - start_acceleration[d]
        )
        for d in coordinate_indices
    ]
    mismatch = sweep_state.h * functools.reduce(jnp.maximum, mismatches)
    # The end is extrapolated by the last shift, whose square is negligible.
    Q, V = _compute_end_state(q, v, sweep_state.h, sweep_state.node_accelerations)
    end_state = (
        tuple(Q[d] + event_shift * V[d] for d in coordinate_indices),
        tuple(
            V[d] + event_shift * _weighted_sum(END_NODE_WEIGHTS, sweep_state.node_accelerations, d)
            for d in coordinate_indices
        ),
    )
    return _SolvedStep(
        sweep_state,
        end_state,
        event_shift,
        mismatch,
        _add_nodes(sweep_state.node_accelerations, linear_accelerations, -1.0),
    )


def _add_nodes(
    node_accelerations: NodeAccelerations, other_accelerations: NodeAccelerations, weight: float
) -> NodeAccelerations:
    """Return the accelerations plus a factor times other accelerations."""
    pairs = zip(node_accelerations, other_accelerations, strict=True)
    return tuple(
        tuple(x + weight * y for x, y in zip(*node_pair, strict=True)) for node_pair in pairs
    )


def _stretch_nodes(
    node_accelerations: NodeAccelerations, relative_growth: Array
) -> NodeAccelerations:
    """Return the node accelerations of an interval that is longer by a small fraction of its
    length.
    """
    coordinates = range(len(node_accelerations[0]))
    return tuple(
        tuple(
            node_accelerations[node_index][coordinate]
            + relative_growth
            * (
                _weighted_sum(STRETCH_WEIGHTS[node_index], node_accelerations, coordinate)
                + relative_growth
                * _weighted_sum(CURVATURE_WEIGHTS[node_index], node_accelerations, coordinate)
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

    residual, partial_rows = value_and_partials(evaluate_residual, (*q, *v, *a))
    derivative_columns = list(zip(*partial_rows, strict=True))
    return residual, *(derivative_columns[i * n : (i + 1) * n] for i in range(3))


ComplexPair = tuple[Array, Array]


def _multiply_complex(x: ComplexPair, y: ComplexPair) -> ComplexPair:
    """Return the product of two complex numbers."""
    return x[0] * y[0] - x[1] * y[1], x[0] * y[1] + x[1] * y[0]


def _subtract_complex(x: ComplexPair, y: ComplexPair) -> ComplexPair:
    """Return the difference of two complex numbers."""
    return x[0] - y[0], x[1] - y[1]


def _add_complex_numbers(complex_numbers: Sequence[ComplexPair]) -> ComplexPair:
    """Return the sum of complex numbers."""
    first_number, *other_numbers = complex_numbers
    real_part, imaginary_part = first_number
    for complex_number in other_numbers:
        real_part, imaginary_part = (
            real_part + complex_number[0],
            imaginary_part + complex_number[1],
        )
    return real_part, imaginary_part


def _invert_stage_matrix(
    eigenvalue: complex, h: Array, residual_by_q: Any, residual_by_v: Any, residual_by_a: Any
) -> Any:
    """Return the inverse of A + h e V + (h e)^2 Q.

    Here e is the eigenvalue. A, V and Q are the derivatives of the residual by accelerations, rates
    and coordinates.
    """
    n, squared_eigenvalue = len(residual_by_q), eigenvalue * eigenvalue
    scaled_value = (h * eigenvalue.real, h * eigenvalue.imag)
    scaled_square = (h * h * squared_eigenvalue.real, h * h * squared_eigenvalue.imag)
    stage_matrix: list[list[ComplexPair]] = [
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
    adjugate, determinant = _adjugate_and_determinant(stage_matrix)

    squared_modulus = determinant[0] * determinant[0] + determinant[1] * determinant[1]
    reciprocal = (determinant[0] / squared_modulus, -determinant[1] / squared_modulus)
    return [
        [_multiply_complex(reciprocal, matrix_entry) for matrix_entry in matrix_row]
        for matrix_row in adjugate
    ]


def _adjugate_and_determinant(matrix: list[list[ComplexPair]]) -> tuple[Any, ComplexPair]:
    """Return adjugate and determinant of a matrix of one to three rows."""
    n = len(matrix)
    if n == 1:
        complex_one = (jnp.ones_like(matrix[0][0][0]), jnp.zeros_like(matrix[0][0][0]))
        return [[complex_one]], matrix[0][0]
    if n == 2:
        negate = lambda x: (-x[0], -x[1])
        adjugate_rows = [[matrix[1][1], negate(matrix[0][1])], [negate(matrix[1][0]), matrix[0][0]]]
        return adjugate_rows, _subtract_complex(
            _multiply_complex(matrix[0][0], matrix[1][1]),
            _multiply_complex(matrix[0][1], matrix[1][0]),
        )

    def cofactor(i: int, j: int) -> ComplexPair:
        (a, b), (c, d) = ((i + 1) % 3, (i + 2) % 3), ((j + 1) % 3, (j + 2) % 3)
        return _subtract_complex(
            _multiply_complex(matrix[a][c], matrix[b][d]),
            _multiply_complex(matrix[a][d], matrix[b][c]),
        )

    adjugate_rows = [[cofactor(j, i) for j in range(3)] for i in range(3)]
    products = [_multiply_complex(matrix[0][k], adjugate_rows[k][0]) for k in range(3)]
    return adjugate_rows, _add_complex_numbers(products)


def _project_residuals(weights: np.ndarray, residuals: NodeAccelerations) -> list[ComplexPair]:
    """Return the projection of the nodes' residuals onto one pair of eigenvectors.

    The sign is that of a correction.
    """
    return [
        (_weighted_sum(-weights.real, residuals, d), _weighted_sum(-weights.imag, residuals, d))
        for d in range(len(residuals[0]))
    ]


def _project_linear_residuals(
    residual: Vector, residual_by_q: Any, residual_by_v: Any, v: Vector, a: Vector, h: Array
) -> list[list[ComplexPair]]:
    """Return `_project_residuals` for accelerations `a` and the equations linearized about the
    middle.
    """
    n = range(len(v))
    multiply_columns = lambda derivative_columns, x: tuple(
        sum(derivative_columns[j][i] * x[j] for j in n) for i in n
    )
    damping_term = multiply_columns(residual_by_v, a)
    stiffness_rate_term = multiply_columns(residual_by_q, v)
    stiffness_acceleration_term = multiply_columns(residual_by_q, a)
    projections = []
    for weights in EIGENVECTOR_PROJECTION:
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
                    select_part(constant_weight) * residual[i]
                    + h
                    * (
                        select_part(linear_weight) * (stiffness_rate_term[i] + damping_term[i])
                        + select_part(quadratic_weight) * h * stiffness_acceleration_term[i]
                    )
                    for select_part in (lambda x: x.real, lambda x: x.imag)
                )
                for i in n
            ]
        )
    return projections


def _correct_nodes(
    node_accelerations: NodeAccelerations, corrections: list[list[ComplexPair]], h: Array
) -> tuple[NodeAccelerations, Array]:
    """Return the corrected accelerations, and the largest change of a rate."""
    corrected_nodes, largest_change = [], jnp.zeros_like(h)
    for node_index in range(N_GAUSS_NODES):
        corrected_node = []
        for coordinate in range(len(node_accelerations[0])):
            acceleration_change = sum(
                float(2.0 * EIGENVECTOR_COLUMNS[node_index, pair_index].real)
                * complex_pair[coordinate][0]
                - float(2.0 * EIGENVECTOR_COLUMNS[node_index, pair_index].imag)
                * complex_pair[coordinate][1]
                for pair_index, complex_pair in enumerate(corrections)
            )
            corrected_node.append(node_accelerations[node_index][coordinate] + acceleration_change)
            largest_change = jnp.maximum(largest_change, jnp.abs(acceleration_change))
        corrected_nodes.append(tuple(corrected_node))
    return tuple(corrected_nodes), h * largest_change


def _find_min_guard(
    phase: AbstractPhase,
    q: Vector,
    v: Vector,
    solved_step: _SolvedStep,
    start_guards: Vector,
    n_skipped: int,
) -> tuple[Array, Vector]:
    """Return the smallest guard at the interval's middle and end, and all guards at the end.

    The smallest guard is -1 if a guard may be negative between the points. There, a guard may be
    lower by a quarter of its second difference.

    - `start_guards`: guards at the start;
    - `n_skipped`: 1 in the last interval, whose first guard is the event and zero at the end.
    """
    sweep_state, coordinate_indices = solved_step.sweep_state, range(len(q))
    middle_acceleration = tuple(
        _weighted_sum(MIDDLE_WEIGHTS, sweep_state.node_accelerations, i) for i in coordinate_indices
    )
    end_acceleration = tuple(
        _weighted_sum(END_NODE_WEIGHTS, sweep_state.node_accelerations, i)
        for i in coordinate_indices
    )
    velocity_integral, position_integral = (
        tuple(_weighted_sum(w, sweep_state.node_accelerations, i) for i in coordinate_indices)
        for w in MIDDLE_INTEGRATION_WEIGHTS
    )
    middle_state = (
        tuple(
            q[i] + sweep_state.h * (0.5 * v[i] + sweep_state.h * position_integral[i])
            for i in coordinate_indices
        ),
        tuple(v[i] + sweep_state.h * velocity_integral[i] for i in coordinate_indices),
    )
    evaluate_guards = lambda q, v, a: phase.guards(PhaseInstant(phase, phase.motion_at(q, v), a))
    middle_guards = evaluate_guards(*middle_state, middle_acceleration)
    end_guards = evaluate_guards(*solved_step.end_state, end_acceleration)
    min_guard = jnp.full_like(sweep_state.h, jnp.inf)
    for i, (start_value, middle_value, end_value) in enumerate(
        zip(start_guards, middle_guards, end_guards, strict=True)
    ):
        lowest_guard = jnp.minimum(start_value, middle_value)
        if i >= n_skipped:
            lowest_guard = jnp.minimum(lowest_guard, end_value)
            possible_decrease = 0.25 * jnp.abs(start_value - 2.0 * middle_value + end_value)
            lowest_guard = jnp.where(lowest_guard > possible_decrease, lowest_guard, -1.0)
        min_guard = jnp.minimum(min_guard, lowest_guard)
    return min_guard, end_guards


class CollocationStep(NamedTuple):
    """Result of one gait step of a block of lanes, and whether each lane passes the checks."""

    section_state: Vector  # (theta-, dtheta-, dL1-), three arrays
    durations: Vector  # of DLS, SLS-I, SLS-II, s
    is_trusted: Bool[Array, " lanes"]


def collocation_gait_step(
    params: WheelParams,
    x: Vector,
    expected_durations: Vector,
    stop_at_lift_off: bool,
    options: CollocationStepOptions = COLLOCATION_STEP_OPTIONS,
) -> CollocationStep:
    """Return one gait step of every lane, near the expected durations of DLS, SLS-I and
    SLS-II (s).

    It is computed in the wheel's units, in which the limits of `options` hold.
    """
    is_valid = is_valid_start(params, x)
    params, x = replace_invalid(is_valid, params, x, PAPER_START)
    units = compute_wheel_units(params.symbols())
    state_units: tuple[Any, ...] = (1.0, units.rate, units.speed)
    params = convert_to_wheel_units(params)
    x = tuple(value / unit for value, unit in zip(x, state_units, strict=True))
    expected_durations = tuple(duration / units.time for duration in expected_durations)
    has_valid_duration = [
        (duration > 0.0) & (duration < options.max_duration) for duration in expected_durations
    ]
    is_valid = functools.reduce(operator.and_, has_valid_duration, is_valid)
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
        start_state = phase.select_coordinates(theta, motion)
        phase_end = collocate_phase(phase, *start_state, duration, mesh, options)
        is_trusted = (
            is_trusted
            & (phase_end.correction <= options.max_correction)
            & (phase_end.event_shift <= options.max_event_shift)
            & (phase_end.mismatch <= max_mismatch)
            & (phase_end.min_guard > 0.0)
        )
        theta, motion = phase_end.q[0], phase.reset_map(phase.motion_at(phase_end.q, phase_end.v))
        durations.append(phase_end.duration)

    def to_trusted_si(values: Iterable[Array], units: Iterable[Any]) -> Vector:
        """Return values in SI; zeros for lanes that are not trusted."""
        return tuple(
            jnp.where(is_trusted, value * unit, 0.0)
            for value, unit in zip(values, units, strict=True)
        )

    return CollocationStep(
        to_trusted_si((theta, motion.dtheta, motion.dL1), state_units),
        to_trusted_si(durations, [units.time] * len(durations)),
        is_trusted,
    )
