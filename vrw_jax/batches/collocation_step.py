"""Gait steps of many wheels by collocation with a fixed amount of work, near known gaits.

The method is Gauss collocation of order 8 on a few graded mesh intervals. The unknowns are the
accelerations at the four nodes of an interval. The airborne leg's fast mode, whose rate is near
c/m, forces explicit solvers to small solver steps, but costs collocation no additional work. A
fixed number of Newton iterations ("sweeps") with one Jacobian solves the equations at the nodes. In
the eigenvectors of the Gauss rule these equations separate into two complex systems, each of the
size of the phase. In the last interval, Newton iterations also correct the duration of the phase,
toward the event.

All lanes do the same work, which cannot adapt to errors. Each phase therefore returns three
indicators of its accuracy. The first indicator is the size of the last corrections. The second
indicator is the minimum of all guards. The third indicator is the residual of the equations of
motion at the start of each interval, which is no node. The adaptive engine repeats the step of each
lane that fails a check of these indicators.
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
    build_differentiation_matrix,
    compute_integration_weights,
    compute_lagrange_weights,
)
from vrw_jax.models import PAPER_START_STATE, is_valid_start_state, replace_invalid_inputs
from vrw_jax.numerics import Vector, evaluate_with_partial_derivatives
from vrw_jax.wheel import (
    AbstractPhase,
    PhaseInstant,
    WheelParams,
    compute_wheel_units,
    convert_to_wheel_units,
    make_paper_phases,
    transitions,
)

_INTEGRATION_MATRIX_EIGENVALUES, _INTEGRATION_MATRIX_EIGENVECTORS = np.linalg.eig(
    INTEGRATION_MATRIX
)
_UPPER_HALF_PLANE_INDICES = np.flatnonzero(_INTEGRATION_MATRIX_EIGENVALUES.imag > 0.0)
INTEGRATION_MATRIX_EIGENVALUES = _INTEGRATION_MATRIX_EIGENVALUES[_UPPER_HALF_PLANE_INDICES]
"""Eigenvalues of the Gauss rule's integration matrix with positive imaginary part, one for each
complex conjugate pair.
"""
EIGENVECTOR_PROJECTION_MATRIX = np.linalg.inv(_INTEGRATION_MATRIX_EIGENVECTORS)[
    _UPPER_HALF_PLANE_INDICES
]
"""Matrix that projects node values onto the eigenvectors of `INTEGRATION_MATRIX_EIGENVALUES`."""
EIGENVECTOR_COLUMNS = _INTEGRATION_MATRIX_EIGENVECTORS[:, _UPPER_HALF_PLANE_INDICES]
"""Eigenvectors of `INTEGRATION_MATRIX_EIGENVALUES`, as columns."""

START_EXTRAPOLATION_WEIGHTS = compute_lagrange_weights(0.0)
"""Weights that extrapolate node values to the start of a mesh interval."""
MIDPOINT_INTERPOLATION_WEIGHTS = compute_lagrange_weights(0.5)
"""Weights that interpolate node values to the middle of a mesh interval."""
END_EXTRAPOLATION_WEIGHTS = compute_lagrange_weights(1.0)
"""Weights that extrapolate node values to the end of a mesh interval."""
MIDPOINT_INTEGRATION_WEIGHTS = compute_integration_weights(0.5)
"""Weights of node values in the single and the double integral over the first half of a mesh
interval.
"""
_DIFFERENTIATION_MATRIX = build_differentiation_matrix()
INTERVAL_STRETCH_WEIGHTS = GAUSS_NODES[:, None] * _DIFFERENTIATION_MATRIX
"""Matrix that maps node values to their first derivatives with respect to the relative length of
the mesh interval.
"""
INTERVAL_STRETCH_CURVATURE_WEIGHTS = (
    0.5 * (GAUSS_NODES * GAUSS_NODES)[:, None] * (_DIFFERENTIATION_MATRIX @ _DIFFERENTIATION_MATRIX)
)
"""Matrix that maps node values to half of their second derivatives with respect to the relative
length of the mesh interval.
"""

DEFAULT_COLLOCATION_PHASE_MESHES = PhaseMesh(4, 1.0), PhaseMesh(5, 4.0), PhaseMesh(2, 1.0)


@dataclass(frozen=True)
class CollocationStepOptions:
    """Options of a gait step by collocation: the amount of work, and limits of the accuracy
    indicators.
    """

    phase_meshes: tuple[PhaseMesh, ...] = DEFAULT_COLLOCATION_PHASE_MESHES
    """Meshes of DLS, SLS-I and SLS-II.

    These meshes are the cheapest tested ones with an error below 1e-8. The error is the 99th
    percentile over lanes near their gaits. The cost includes the lanes that the adaptive engine
    repeats (experiments/speed/engine_benchmark.py).
    """
    n_sweeps_per_interval: int = 3
    """Number of Newton sweeps in each mesh interval except the last one of a phase."""
    n_duration_corrections: int = 2
    """Number of Newton corrections of the phase's duration in the last mesh interval."""
    n_sweeps_per_duration_correction: int = 2
    """Number of Newton sweeps after each correction of the phase's duration."""
    max_expected_duration: float = 10.0
    """Largest accepted expected duration in the wheel's unit of time, chosen because no phase of a
    gait lasts that long."""
    max_rate_correction: float = 5e-8
    """Largest accepted `CollocatedPhaseEnd.estimated_rate_correction`, in the wheel's units."""
    max_duration_correction: float = 1e-5
    """Largest accepted `CollocatedPhaseEnd.last_duration_correction`, in the wheel's unit of time.

    The end state is extrapolated over the last correction of the duration. Its error is half the
    square of that correction times the rate of an acceleration.
    """
    max_start_rate_errors: tuple[float, float, float] = (2e-3, 1.2e-1, 8e-5)
    """Largest accepted `CollocatedPhaseEnd.largest_start_rate_error` in DLS, SLS-I and SLS-II.

    The limits are chosen because the error of the result is at most the square of the start rate
    error. One in a hundred lanes near their gaits exceeds a limit.
    """


COLLOCATION_STEP_OPTIONS = CollocationStepOptions()


class CollocatedPhaseEnd(NamedTuple):
    """State at the end of a phase computed by collocation, with indicators of its accuracy."""

    q: Vector
    v: Vector
    phase_duration: Array  # s
    estimated_rate_correction: Array  # change of a rate by one more sweep, rad/s and m/s
    last_duration_correction: Array  # of the duration, s
    largest_start_rate_error: Array  # over the starts of all intervals
    lowest_guard_value: Array  # at middles and ends of intervals; positive if valid


NodeAccelerations = tuple[Vector, ...]
"""Accelerations at the nodes of a mesh interval, one vector per node."""


class _NewtonSweepState(NamedTuple):
    """Unknowns of one mesh interval during the Newton sweeps, and the sizes of their last
    corrections.
    """

    interval_length: Array
    node_accelerations: NodeAccelerations
    rate_correction: Array
    previous_rate_correction: Array  # of the sweep before the last one


class _SolvedMeshInterval(NamedTuple):
    """Solution of the collocation equations in one mesh interval, with accuracy indicators."""

    newton_sweep_state: _NewtonSweepState
    interval_end_state: tuple[Vector, Vector]
    last_duration_correction: Array  # s
    largest_start_rate_error: Array
    nonlinear_accelerations: NodeAccelerations  # the part that the linearized equations omit


def solve_phase_by_collocation(
    phase: AbstractPhase,
    q: Vector,
    v: Vector,
    expected_duration: Array,
    phase_mesh: PhaseMesh,
    options: CollocationStepOptions = COLLOCATION_STEP_OPTIONS,
) -> CollocatedPhaseEnd:
    """Return the state at the end of a phase that starts with coordinates `q` and rates `v`.

    The phase ends at the root of its event guard that is near `expected_duration`.
    """
    interval_length_fractions, lane_zeros = (
        phase_mesh.interval_length_fractions,
        jnp.zeros_like(expected_duration),
    )
    # The nonlinear part scales with the squared ratio of successive interval lengths.
    nonlinear_growth_factor = float(
        interval_length_fractions[-1] / interval_length_fractions[0]
    ) ** (2.0 / max(phase_mesh.n_intervals - 1, 1))

    def advance_interval(
        interval_carry: tuple, interval_length_fraction: Array
    ) -> tuple[tuple, None]:
        (
            q,
            v,
            rate_correction,
            start_rate_error,
            lowest_guard_value,
            end_guard_values,
            nonlinear_accelerations,
        ) = interval_carry
        h = interval_length_fraction * expected_duration
        solved_mesh_interval = _solve_mesh_interval(
            phase, q, v, h, nonlinear_accelerations, options
        )
        lowest_interval_guard_value, end_guard_values = _find_lowest_guard_value(
            phase, q, v, solved_mesh_interval, end_guard_values, 0
        )
        interval_carry = (
            *solved_mesh_interval.interval_end_state,
            jnp.maximum(
                rate_correction, _estimate_next_correction(solved_mesh_interval.newton_sweep_state)
            ),
            jnp.maximum(start_rate_error, solved_mesh_interval.largest_start_rate_error),
            jnp.minimum(lowest_guard_value, lowest_interval_guard_value),
            end_guard_values,
            tuple(
                tuple(nonlinear_growth_factor * x for x in node_acceleration)
                for node_acceleration in solved_mesh_interval.nonlinear_accelerations
            ),
        )
        return interval_carry, None

    start_guard_values = phase.compute_guards(PhaseInstant(phase, phase.compute_motion(q, v), None))
    interval_carry = (
        q,
        v,
        lane_zeros,
        lane_zeros,
        lane_zeros + jnp.inf,
        start_guard_values,
        ((lane_zeros,) * len(q),) * N_GAUSS_NODES,
    )
    if len(interval_length_fractions) > 1:
        interval_carry, _ = lax.scan(
            advance_interval,
            interval_carry,
            jnp.asarray(interval_length_fractions[:-1], expected_duration.dtype),
        )
    (
        q,
        v,
        estimated_rate_correction,
        largest_start_rate_error,
        lowest_guard_value,
        start_guard_values,
        nonlinear_accelerations,
    ) = interval_carry
    h = float(interval_length_fractions[-1]) * expected_duration
    last_mesh_interval = _solve_mesh_interval(
        phase, q, v, h, nonlinear_accelerations, options, ends_at_event=True
    )
    lowest_interval_guard_value, _ = _find_lowest_guard_value(
        phase, q, v, last_mesh_interval, start_guard_values, 1
    )
    return CollocatedPhaseEnd(
        *last_mesh_interval.interval_end_state,
        phase_duration=float(1.0 - interval_length_fractions[-1]) * expected_duration
        + last_mesh_interval.newton_sweep_state.interval_length
        + last_mesh_interval.last_duration_correction,
        estimated_rate_correction=jnp.maximum(
            estimated_rate_correction,
            _estimate_next_correction(last_mesh_interval.newton_sweep_state),
        ),
        last_duration_correction=jnp.abs(last_mesh_interval.last_duration_correction),
        largest_start_rate_error=jnp.maximum(
            largest_start_rate_error, last_mesh_interval.largest_start_rate_error
        ),
        lowest_guard_value=jnp.minimum(
            jnp.minimum(lowest_guard_value, lowest_interval_guard_value),
            last_mesh_interval.newton_sweep_state.interval_length,
        ),
    )


def _estimate_next_correction(newton_sweep_state: _NewtonSweepState) -> Array:
    """Return the correction that one more Newton sweep would make, extrapolated from the last two
    sweeps.
    """
    rate_correction_ratio = newton_sweep_state.rate_correction / jnp.maximum(
        newton_sweep_state.previous_rate_correction, 1e-300
    )
    return newton_sweep_state.rate_correction * jnp.minimum(rate_correction_ratio, 1.0)


def _sum_weighted_accelerations(
    acceleration_weights: np.ndarray, node_accelerations: NodeAccelerations, coordinate_index: int
) -> Any:
    """Return the sum of one coordinate's accelerations at all nodes, weighted by
    `acceleration_weights`.
    """
    return sum(
        float(node_weight) * node_acceleration[coordinate_index]
        for node_weight, node_acceleration in zip(
            acceleration_weights, node_accelerations, strict=True
        )
    )


def _compute_interval_end_state(
    q: Vector, v: Vector, h: Array, node_accelerations: NodeAccelerations
) -> tuple[Vector, Vector]:
    """Return coordinates and rates at the end of a mesh interval of length `h` that starts at
    (q, v).
    """
    n = range(len(q))
    return (
        tuple(
            q[d]
            + h
            * (v[d] + h * _sum_weighted_accelerations(DOUBLE_END_WEIGHTS, node_accelerations, d))
            for d in n
        ),
        tuple(
            v[d] + h * _sum_weighted_accelerations(END_WEIGHTS, node_accelerations, d) for d in n
        ),
    )


def _compute_node_state(
    node_index: int, q: Vector, v: Vector, h: Array, node_accelerations: NodeAccelerations
) -> tuple:
    """Return coordinates and rates at one node of a mesh interval of length `h` that starts at
    (q, v).
    """
    n, node_fraction = range(len(q)), float(GAUSS_NODES[node_index])
    return (
        tuple(
            q[d]
            + h
            * (
                node_fraction * v[d]
                + h
                * _sum_weighted_accelerations(
                    DOUBLE_INTEGRATION_MATRIX[node_index], node_accelerations, d
                )
            )
            for d in n
        ),
        tuple(
            v[d]
            + h * _sum_weighted_accelerations(INTEGRATION_MATRIX[node_index], node_accelerations, d)
            for d in n
        ),
    )


def _solve_mesh_interval(
    phase: AbstractPhase,
    q: Vector,
    v: Vector,
    h: Array,
    nonlinear_accelerations: NodeAccelerations,
    options: CollocationStepOptions,
    ends_at_event: bool = False,
) -> _SolvedMeshInterval:
    """Return the solution of the collocation equations in one mesh interval by Newton sweeps.

    The interval starts at (q, v) and has the length `h`. If the interval ends at an event, its
    length is an additional unknown. The Jacobian is evaluated at the middle of the interval, and
    each sweep gains about two digits. The sweeps start from the solution of the equations that are
    linearized at the middle, plus the `nonlinear_accelerations` of the previous interval. If the
    length changes, the new node accelerations are values of the polynomial through the old ones.
    """
    n_dof = len(q)
    interval_start_acceleration = phase.solve_acceleration(phase.compute_motion(q, v))[:n_dof]
    coordinate_indices = range(n_dof)
    interval_midpoint_state = (
        tuple(
            q[d] + 0.5 * h * (v[d] + 0.25 * h * interval_start_acceleration[d])
            for d in coordinate_indices
        ),
        tuple(v[d] + 0.5 * h * interval_start_acceleration[d] for d in coordinate_indices),
    )
    dynamics_residual, residual_jacobian_q, residual_jacobian_v, residual_jacobian_a = (
        _linearize_dynamics_residual(phase, *interval_midpoint_state, interval_start_acceleration)
    )
    inverse_stage_matrices = [
        _invert_stage_matrix(
            complex(gauss_eigenvalue),
            h,
            residual_jacobian_q,
            residual_jacobian_v,
            residual_jacobian_a,
        )
        for gauss_eigenvalue in INTEGRATION_MATRIX_EIGENVALUES
    ]

    def apply_projected_correction(
        node_accelerations: NodeAccelerations, h: Array, residual_projections: list
    ) -> tuple[NodeAccelerations, Array]:
        eigenvector_corrections = []
        for inverse_stage_matrix, residual_projection in zip(
            inverse_stage_matrices, residual_projections, strict=True
        ):
            matrix_products = [
                [
                    _multiply_complex_pairs(matrix_entry, x)
                    for matrix_entry, x in zip(matrix_row, residual_projection, strict=True)
                ]
                for matrix_row in inverse_stage_matrix
            ]
            eigenvector_corrections.append(
                [_add_complex_pairs(matrix_row) for matrix_row in matrix_products]
            )
        return _correct_node_accelerations(node_accelerations, eigenvector_corrections, h)

    def run_newton_sweep(
        newton_sweep_state: _NewtonSweepState, _: None
    ) -> tuple[_NewtonSweepState, None]:
        node_residuals = []
        for node_index in range(N_GAUSS_NODES):
            Q, V = _compute_node_state(
                node_index,
                q,
                v,
                newton_sweep_state.interval_length,
                newton_sweep_state.node_accelerations,
            )
            node_residuals.append(
                phase.compute_dynamics_residual(
                    phase.compute_motion(Q, V), newton_sweep_state.node_accelerations[node_index]
                )
            )
        # The projections have the sign of a correction.
        residual_projections = [
            [
                (
                    _sum_weighted_accelerations(
                        -eigenvector_weights.real, tuple(node_residuals), d
                    ),
                    _sum_weighted_accelerations(
                        -eigenvector_weights.imag, tuple(node_residuals), d
                    ),
                )
                for d in range(len(node_residuals[0]))
            ]
            for eigenvector_weights in EIGENVECTOR_PROJECTION_MATRIX
        ]
        node_accelerations, largest_rate_correction = apply_projected_correction(
            newton_sweep_state.node_accelerations,
            newton_sweep_state.interval_length,
            residual_projections,
        )
        return _NewtonSweepState(
            newton_sweep_state.interval_length,
            node_accelerations,
            largest_rate_correction,
            newton_sweep_state.rate_correction,
        ), None

    def evaluate_event_guard(q: Vector, v: Vector) -> tuple[Array, Vector]:
        phase_instant = PhaseInstant(phase, phase.compute_motion(q, v), None)
        return phase.compute_end_guard(phase_instant), phase_instant.acceleration[: phase.n_dof]

    def compute_time_to_event(newton_sweep_state: _NewtonSweepState) -> Array:
        """Return the time from the end of the interval to the event, estimated by one Newton step,
        in the unit of `h`.
        """
        interval_end_q, interval_end_v = _compute_interval_end_state(
            q, v, newton_sweep_state.interval_length, newton_sweep_state.node_accelerations
        )
        _, interval_end_acceleration = evaluate_event_guard(interval_end_q, interval_end_v)
        (guard_value, _), (guard_rate, _) = jax.jvp(
            evaluate_event_guard,
            (interval_end_q, interval_end_v),
            (interval_end_v, interval_end_acceleration),
        )
        time_to_event = -guard_value / jnp.where(guard_rate < 0.0, guard_rate, -jnp.inf)
        return jnp.clip(
            time_to_event,
            -0.5 * newton_sweep_state.interval_length,
            0.5 * newton_sweep_state.interval_length,
        )

    def correct_interval_duration(
        sweep_state_and_correction: tuple[_NewtonSweepState, Array], _: None
    ) -> tuple[tuple[_NewtonSweepState, Array], None]:
        newton_sweep_state, duration_correction = sweep_state_and_correction
        newton_sweep_state = newton_sweep_state._replace(
            interval_length=newton_sweep_state.interval_length + duration_correction,
            node_accelerations=_stretch_node_accelerations(
                newton_sweep_state.node_accelerations,
                duration_correction / newton_sweep_state.interval_length,
            ),
        )
        newton_sweep_state, _ = lax.scan(
            run_newton_sweep,
            newton_sweep_state,
            None,
            length=options.n_sweeps_per_duration_correction,
        )
        return (newton_sweep_state, compute_time_to_event(newton_sweep_state)), None

    linearized_solution, largest_rate_correction = apply_projected_correction(
        (interval_start_acceleration,) * N_GAUSS_NODES,
        h,
        _project_linearized_residuals(
            dynamics_residual,
            residual_jacobian_q,
            residual_jacobian_v,
            v,
            interval_start_acceleration,
            h,
        ),
    )
    initial_node_accelerations = _add_node_accelerations(
        linearized_solution, nonlinear_accelerations, 1.0
    )
    newton_sweep_state = _NewtonSweepState(
        h, initial_node_accelerations, largest_rate_correction, largest_rate_correction
    )
    duration_correction = jnp.zeros_like(h)
    if ends_at_event:
        (newton_sweep_state, duration_correction), _ = lax.scan(
            correct_interval_duration,
            (newton_sweep_state, compute_time_to_event(newton_sweep_state)),
            None,
            length=options.n_duration_corrections,
        )
    else:
        newton_sweep_state, _ = lax.scan(
            run_newton_sweep, newton_sweep_state, None, length=options.n_sweeps_per_interval
        )
    start_rate_errors = [
        jnp.abs(
            _sum_weighted_accelerations(
                START_EXTRAPOLATION_WEIGHTS, newton_sweep_state.node_accelerations, d
            )
            - interval_start_acceleration[d]
        )
        for d in coordinate_indices
    ]
    start_rate_error = newton_sweep_state.interval_length * functools.reduce(
        jnp.maximum, start_rate_errors
    )
    # The end state is extrapolated by the last correction of the duration, whose square is
    # negligible.
    Q, V = _compute_interval_end_state(
        q, v, newton_sweep_state.interval_length, newton_sweep_state.node_accelerations
    )
    interval_end_state = (
        tuple(Q[d] + duration_correction * V[d] for d in coordinate_indices),
        tuple(
            V[d]
            + duration_correction
            * _sum_weighted_accelerations(
                END_EXTRAPOLATION_WEIGHTS, newton_sweep_state.node_accelerations, d
            )
            for d in coordinate_indices
        ),
    )
    return _SolvedMeshInterval(
        newton_sweep_state,
        interval_end_state,
        duration_correction,
        start_rate_error,
        _add_node_accelerations(newton_sweep_state.node_accelerations, linearized_solution, -1.0),
    )


def _add_node_accelerations(
    node_accelerations: NodeAccelerations,
    added_accelerations: NodeAccelerations,
    acceleration_factor: float,
) -> NodeAccelerations:
    """Return `node_accelerations` plus `acceleration_factor` times `added_accelerations`."""
    node_acceleration_pairs = zip(node_accelerations, added_accelerations, strict=True)
    return tuple(
        tuple(x + acceleration_factor * y for x, y in zip(*node_acceleration_pair, strict=True))
        for node_acceleration_pair in node_acceleration_pairs
    )


def _stretch_node_accelerations(
    node_accelerations: NodeAccelerations, relative_length_change: Array
) -> NodeAccelerations:
    """Return the node accelerations of the interval after a small relative change of its length."""
    coordinate_indices = range(len(node_accelerations[0]))
    return tuple(
        tuple(
            node_accelerations[node_index][coordinate_index]
            + relative_length_change
            * (
                _sum_weighted_accelerations(
                    INTERVAL_STRETCH_WEIGHTS[node_index], node_accelerations, coordinate_index
                )
                + relative_length_change
                * _sum_weighted_accelerations(
                    INTERVAL_STRETCH_CURVATURE_WEIGHTS[node_index],
                    node_accelerations,
                    coordinate_index,
                )
            )
            for coordinate_index in coordinate_indices
        )
        for node_index in range(N_GAUSS_NODES)
    )


def _linearize_dynamics_residual(phase: AbstractPhase, q: Vector, v: Vector, a: Vector) -> tuple:
    """Return the residual of the equations of motion, and its Jacobians with respect to `q`, `v`
    and `a` as lists of columns.
    """
    n = len(q)

    def evaluate_dynamics_residual(*residual_arguments: Array) -> Vector:
        q, v, a = (residual_arguments[i * n : (i + 1) * n] for i in range(3))
        return phase.compute_dynamics_residual(phase.compute_motion(q, v), a)

    dynamics_residual, partial_derivative_rows = evaluate_with_partial_derivatives(
        evaluate_dynamics_residual, (*q, *v, *a)
    )
    derivative_columns = list(zip(*partial_derivative_rows, strict=True))
    return dynamics_residual, *(derivative_columns[i * n : (i + 1) * n] for i in range(3))


ComplexNumberPair = tuple[Array, Array]


def _multiply_complex_pairs(x: ComplexNumberPair, y: ComplexNumberPair) -> ComplexNumberPair:
    """Return the product of two complex numbers as a pair (real part, imaginary part)."""
    return x[0] * y[0] - x[1] * y[1], x[0] * y[1] + x[1] * y[0]


def _subtract_complex_pairs(x: ComplexNumberPair, y: ComplexNumberPair) -> ComplexNumberPair:
    """Return the difference x - y of two complex numbers as a pair (real part, imaginary part)."""
    return x[0] - y[0], x[1] - y[1]


def _add_complex_pairs(complex_numbers: Sequence[ComplexNumberPair]) -> ComplexNumberPair:
    """Return the sum of all `complex_numbers` as a pair (real part, imaginary part)."""
    first_complex_number, *remaining_complex_numbers = complex_numbers
    real_part, imaginary_part = first_complex_number
    for complex_number in remaining_complex_numbers:
        real_part, imaginary_part = (
            real_part + complex_number[0],
            imaginary_part + complex_number[1],
        )
    return real_part, imaginary_part


def _invert_stage_matrix(
    gauss_eigenvalue: complex,
    h: Array,
    residual_jacobian_q: Any,
    residual_jacobian_v: Any,
    residual_jacobian_a: Any,
) -> Any:
    """Return the inverse of the complex stage matrix A + h e V + (h e)^2 Q as nested lists of
    complex pairs.

    Here e is `gauss_eigenvalue`, and h is the length of the interval. A, V and Q are the
    derivatives of the residual with respect to accelerations, rates and coordinates.
    """
    n, squared_eigenvalue = len(residual_jacobian_q), gauss_eigenvalue * gauss_eigenvalue
    scaled_eigenvalue = (h * gauss_eigenvalue.real, h * gauss_eigenvalue.imag)
    scaled_squared_eigenvalue = (h * h * squared_eigenvalue.real, h * h * squared_eigenvalue.imag)
    stage_matrix: list[list[ComplexNumberPair]] = [
        [
            (
                residual_jacobian_a[j][i]
                + scaled_eigenvalue[0] * residual_jacobian_v[j][i]
                + scaled_squared_eigenvalue[0] * residual_jacobian_q[j][i],
                scaled_eigenvalue[1] * residual_jacobian_v[j][i]
                + scaled_squared_eigenvalue[1] * residual_jacobian_q[j][i],
            )
            for j in range(n)
        ]
        for i in range(n)
    ]
    adjugate_matrix, stage_determinant = _compute_adjugate_and_determinant(stage_matrix)

    squared_determinant_modulus = (
        stage_determinant[0] * stage_determinant[0] + stage_determinant[1] * stage_determinant[1]
    )
    inverse_determinant = (
        stage_determinant[0] / squared_determinant_modulus,
        -stage_determinant[1] / squared_determinant_modulus,
    )
    return [
        [_multiply_complex_pairs(inverse_determinant, matrix_entry) for matrix_entry in matrix_row]
        for matrix_row in adjugate_matrix
    ]


def _compute_adjugate_and_determinant(
    complex_matrix: list[list[ComplexNumberPair]],
) -> tuple[Any, ComplexNumberPair]:
    """Return the adjugate, as nested lists, and the determinant of a complex square matrix.

    The matrix has one, two or three rows of complex pairs.
    """
    n = len(complex_matrix)
    if n == 1:
        complex_one = (
            jnp.ones_like(complex_matrix[0][0][0]),
            jnp.zeros_like(complex_matrix[0][0][0]),
        )
        return [[complex_one]], complex_matrix[0][0]
    if n == 2:
        negate_complex_pair = lambda x: (-x[0], -x[1])
        adjugate_rows = [
            [complex_matrix[1][1], negate_complex_pair(complex_matrix[0][1])],
            [negate_complex_pair(complex_matrix[1][0]), complex_matrix[0][0]],
        ]
        return adjugate_rows, _subtract_complex_pairs(
            _multiply_complex_pairs(complex_matrix[0][0], complex_matrix[1][1]),
            _multiply_complex_pairs(complex_matrix[0][1], complex_matrix[1][0]),
        )

    def compute_cofactor(i: int, j: int) -> ComplexNumberPair:
        (a, b), (c, d) = ((i + 1) % 3, (i + 2) % 3), ((j + 1) % 3, (j + 2) % 3)
        return _subtract_complex_pairs(
            _multiply_complex_pairs(complex_matrix[a][c], complex_matrix[b][d]),
            _multiply_complex_pairs(complex_matrix[a][d], complex_matrix[b][c]),
        )

    adjugate_rows = [[compute_cofactor(j, i) for j in range(3)] for i in range(3)]
    first_row_products = [
        _multiply_complex_pairs(complex_matrix[0][k], adjugate_rows[k][0]) for k in range(3)
    ]
    return adjugate_rows, _add_complex_pairs(first_row_products)


def _project_linearized_residuals(
    midpoint_residual: Vector,
    residual_jacobian_q: Any,
    residual_jacobian_v: Any,
    v: Vector,
    a: Vector,
    h: Array,
) -> list[list[ComplexNumberPair]]:
    """Return the projections of the negative node residuals onto all eigenvectors, as complex
    pairs.

    The residuals are those of constant accelerations `a` in the equations of motion that are
    linearized about the middle of the interval.
    """
    n = range(len(v))
    multiply_by_columns = lambda derivative_columns, x: tuple(
        sum(derivative_columns[j][i] * x[j] for j in n) for i in n
    )
    damping_term = multiply_by_columns(residual_jacobian_v, a)
    stiffness_rate_term = multiply_by_columns(residual_jacobian_q, v)
    stiffness_acceleration_term = multiply_by_columns(residual_jacobian_q, a)
    residual_projections = []
    for eigenvector_weights in EIGENVECTOR_PROJECTION_MATRIX:
        weight_of_constant_term, weight_of_linear_term, weight_of_quadratic_term = (
            -complex(np.sum(eigenvector_weights * node_fraction_powers))
            for node_fraction_powers in (
                np.ones(N_GAUSS_NODES),
                GAUSS_NODES - 0.5,
                0.5 * GAUSS_NODES * GAUSS_NODES - 0.125,
            )
        )
        residual_projections.append(
            [
                tuple(
                    take_real_or_imaginary_part(weight_of_constant_term) * midpoint_residual[i]
                    + h
                    * (
                        take_real_or_imaginary_part(weight_of_linear_term)
                        * (stiffness_rate_term[i] + damping_term[i])
                        + take_real_or_imaginary_part(weight_of_quadratic_term)
                        * h
                        * stiffness_acceleration_term[i]
                    )
                    for take_real_or_imaginary_part in (lambda x: x.real, lambda x: x.imag)
                )
                for i in n
            ]
        )
    return residual_projections


def _correct_node_accelerations(
    node_accelerations: NodeAccelerations,
    eigenvector_corrections: list[list[ComplexNumberPair]],
    h: Array,
) -> tuple[NodeAccelerations, Array]:
    """Return the corrected node accelerations, and the largest change of a rate that results."""
    corrected_accelerations, largest_acceleration_change = [], jnp.zeros_like(h)
    for node_index in range(N_GAUSS_NODES):
        corrected_node_acceleration = []
        for coordinate_index in range(len(node_accelerations[0])):
            acceleration_change = sum(
                float(2.0 * EIGENVECTOR_COLUMNS[node_index, eigenvalue_index].real)
                * eigenvector_correction[coordinate_index][0]
                - float(2.0 * EIGENVECTOR_COLUMNS[node_index, eigenvalue_index].imag)
                * eigenvector_correction[coordinate_index][1]
                for eigenvalue_index, eigenvector_correction in enumerate(eigenvector_corrections)
            )
            corrected_node_acceleration.append(
                node_accelerations[node_index][coordinate_index] + acceleration_change
            )
            largest_acceleration_change = jnp.maximum(
                largest_acceleration_change, jnp.abs(acceleration_change)
            )
        corrected_accelerations.append(tuple(corrected_node_acceleration))
    return tuple(corrected_accelerations), h * largest_acceleration_change


def _find_lowest_guard_value(
    phase: AbstractPhase,
    q: Vector,
    v: Vector,
    solved_mesh_interval: _SolvedMeshInterval,
    start_guard_values: Vector,
    n_event_guards: int,
) -> tuple[Array, Vector]:
    """Return the lowest of all guard values in an interval, and the value of each guard at the end.

    The guards are evaluated at the middle and the end. Between start, middle and end, a guard may
    be lower by a quarter of its second difference. If a guard may be negative there, the lowest
    guard value is -1.

    - `start_guard_values`: guard values at the start of the interval;
    - `n_event_guards`: 1 in the last interval, whose first guard is that of the event and has the
      value 0 at the end; otherwise 0.
    """
    newton_sweep_state, coordinate_indices = solved_mesh_interval.newton_sweep_state, range(len(q))
    midpoint_acceleration = tuple(
        _sum_weighted_accelerations(
            MIDPOINT_INTERPOLATION_WEIGHTS, newton_sweep_state.node_accelerations, i
        )
        for i in coordinate_indices
    )
    interval_end_acceleration = tuple(
        _sum_weighted_accelerations(
            END_EXTRAPOLATION_WEIGHTS, newton_sweep_state.node_accelerations, i
        )
        for i in coordinate_indices
    )
    velocity_integral, position_integral = (
        tuple(
            _sum_weighted_accelerations(w, newton_sweep_state.node_accelerations, i)
            for i in coordinate_indices
        )
        for w in MIDPOINT_INTEGRATION_WEIGHTS
    )
    interval_midpoint_state = (
        tuple(
            q[i]
            + newton_sweep_state.interval_length
            * (0.5 * v[i] + newton_sweep_state.interval_length * position_integral[i])
            for i in coordinate_indices
        ),
        tuple(
            v[i] + newton_sweep_state.interval_length * velocity_integral[i]
            for i in coordinate_indices
        ),
    )
    evaluate_phase_guards = lambda q, v, a: phase.compute_guards(
        PhaseInstant(phase, phase.compute_motion(q, v), a)
    )
    midpoint_guard_values = evaluate_phase_guards(*interval_midpoint_state, midpoint_acceleration)
    end_guard_values = evaluate_phase_guards(
        *solved_mesh_interval.interval_end_state, interval_end_acceleration
    )
    lowest_of_all_guard_values = jnp.full_like(newton_sweep_state.interval_length, jnp.inf)
    for i, (start_guard_value, midpoint_guard_value, end_guard_value) in enumerate(
        zip(start_guard_values, midpoint_guard_values, end_guard_values, strict=True)
    ):
        lowest_guard_value = jnp.minimum(start_guard_value, midpoint_guard_value)
        if i >= n_event_guards:
            lowest_guard_value = jnp.minimum(lowest_guard_value, end_guard_value)
            guard_decrease_bound = 0.25 * jnp.abs(
                start_guard_value - 2.0 * midpoint_guard_value + end_guard_value
            )
            lowest_guard_value = jnp.where(
                lowest_guard_value > guard_decrease_bound, lowest_guard_value, -1.0
            )
        lowest_of_all_guard_values = jnp.minimum(lowest_of_all_guard_values, lowest_guard_value)
    return lowest_of_all_guard_values, end_guard_values


class CollocationStep(NamedTuple):
    """Result of one gait step for each lane, computed by collocation."""

    section_state: Vector  # (theta-, dtheta-, dL1-), three arrays
    phase_durations: Vector  # of DLS, SLS-I, SLS-II, s
    is_collocation_trusted: Bool[Array, " lanes"]  # whether the lane passes all checks


def take_collocation_step(
    params: WheelParams,
    x: Vector,
    expected_durations: Vector,
    stop_at_lift_off: bool,
    options: CollocationStepOptions = COLLOCATION_STEP_OPTIONS,
) -> CollocationStep:
    """Return the result of one gait step of every lane, computed near expected phase durations.

    - `x`: components of the section states, arrays over lanes, rad, rad/s, m/s;
    - `expected_durations`: expected durations of DLS, SLS-I and SLS-II, arrays over lanes, s;
    - `options`: amount of work and limits, in units of the wheel.
    """
    is_start_state_valid = is_valid_start_state(params, x)
    params, x = replace_invalid_inputs(is_start_state_valid, params, x, PAPER_START_STATE)
    wheel_units = compute_wheel_units(params.symbols())
    state_units: tuple[Any, ...] = (1.0, wheel_units.rate_unit, wheel_units.velocity_unit)
    params = convert_to_wheel_units(params)
    x = tuple(
        state_component / state_unit
        for state_component, state_unit in zip(x, state_units, strict=True)
    )
    expected_durations = tuple(
        expected_duration / wheel_units.time_unit for expected_duration in expected_durations
    )
    has_valid_duration = [
        (expected_duration > 0.0) & (expected_duration < options.max_expected_duration)
        for expected_duration in expected_durations
    ]
    is_start_state_valid = functools.reduce(operator.and_, has_valid_duration, is_start_state_valid)
    expected_durations = tuple(
        jnp.where(is_start_state_valid, expected_duration, 0.1)
        for expected_duration in expected_durations
    )
    s = params.symbols()
    landing_result = transitions.resolve_landing(s, *x)
    is_collocation_trusted = is_start_state_valid & landing_result.is_rear_foot_planted
    wheel_angle, wheel_motion = landing_result.theta_after_landing, landing_result.motion_after
    phases_of_step = make_paper_phases(s, landing_result.foot_distance, stop_at_lift_off)
    phase_durations = []
    for collocated_phase, expected_duration, phase_mesh, max_start_rate_error in zip(
        phases_of_step,
        expected_durations,
        options.phase_meshes,
        options.max_start_rate_errors,
        strict=True,
    ):
        phase_start_state = collocated_phase.select_phase_coordinates(wheel_angle, wheel_motion)
        phase_end = solve_phase_by_collocation(
            collocated_phase, *phase_start_state, expected_duration, phase_mesh, options
        )
        is_collocation_trusted = (
            is_collocation_trusted
            & (phase_end.estimated_rate_correction <= options.max_rate_correction)
            & (phase_end.last_duration_correction <= options.max_duration_correction)
            & (phase_end.largest_start_rate_error <= max_start_rate_error)
            & (phase_end.lowest_guard_value > 0.0)
        )
        wheel_angle, wheel_motion = (
            phase_end.q[0],
            collocated_phase.reset_motion(
                collocated_phase.compute_motion(phase_end.q, phase_end.v)
            ),
        )
        phase_durations.append(phase_end.phase_duration)

    def convert_trusted_lanes_to_si(
        lane_result_arrays: Iterable[Array], si_units: Iterable[Any]
    ) -> Vector:
        """Return the arrays in SI units, with the value 0 in lanes that failed a check."""
        return tuple(
            jnp.where(is_collocation_trusted, dimensionless_array * si_unit, 0.0)
            for dimensionless_array, si_unit in zip(lane_result_arrays, si_units, strict=True)
        )

    return CollocationStep(
        convert_trusted_lanes_to_si(
            (wheel_angle, wheel_motion.dtheta, wheel_motion.dL1), state_units
        ),
        convert_trusted_lanes_to_si(
            phase_durations, [wheel_units.time_unit] * len(phase_durations)
        ),
        is_collocation_trusted,
    )
