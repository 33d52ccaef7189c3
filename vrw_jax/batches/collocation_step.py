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
from collections.abc import Iterable
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


class _PhaseProgress(NamedTuple):
    """State at the end of a mesh interval, with the accuracy indicators of all intervals so far."""

    q: Vector
    v: Vector
    estimated_rate_correction: Array
    largest_start_rate_error: Array
    lowest_guard_value: Array
    guard_values: Vector
    nonlinear_accelerations: NodeAccelerations


def solve_phase_by_collocation(
    phase: AbstractPhase, q: Vector, v: Vector, expected_duration: Array, phase_mesh: PhaseMesh
) -> CollocatedPhaseEnd:
    """Return the state at the end of a phase that starts with coordinates `q` and rates `v`.

    The phase ends at the root of its event guard that is near `expected_duration`.
    """
    length_fractions = phase_mesh.interval_length_fractions
    # The nonlinear part scales with the squared ratio of successive interval lengths.
    nonlinear_growth_factor = float(length_fractions[-1] / length_fractions[0]) ** (
        2.0 / max(phase_mesh.n_intervals - 1, 1)
    )

    def advance_interval(
        progress: _PhaseProgress, length_fraction: Any, ends_at_event: bool = False
    ) -> tuple[_PhaseProgress, _SolvedMeshInterval]:
        interval = _solve_mesh_interval(
            phase,
            progress.q,
            progress.v,
            length_fraction * expected_duration,
            jax.tree.map(lambda x: nonlinear_growth_factor * x, progress.nonlinear_accelerations),
            ends_at_event,
        )
        lowest_guard_value, end_guard_values = _find_lowest_guard_value(
            phase, progress.q, progress.v, interval, progress.guard_values, int(ends_at_event)
        )
        # The correction by one more sweep is extrapolated from those by the last two sweeps.
        _, _, correction, previous_correction = interval.newton_sweep_state
        correction_ratio = correction / jnp.maximum(previous_correction, 1e-300)
        next_correction = correction * jnp.minimum(correction_ratio, 1.0)
        return _PhaseProgress(
            *interval.interval_end_state,
            jnp.maximum(progress.estimated_rate_correction, next_correction),
            jnp.maximum(progress.largest_start_rate_error, interval.largest_start_rate_error),
            jnp.minimum(progress.lowest_guard_value, lowest_guard_value),
            end_guard_values,
            interval.nonlinear_accelerations,
        ), interval

    lane_zeros = jnp.zeros_like(expected_duration)
    progress = _PhaseProgress(
        q,
        v,
        lane_zeros,
        lane_zeros,
        lane_zeros + jnp.inf,
        phase.compute_guards(PhaseInstant(phase, phase.compute_motion(q, v), None)),
        ((lane_zeros,) * len(q),) * N_GAUSS_NODES,
    )
    progress, _ = lax.scan(
        lambda progress, length_fraction: (advance_interval(progress, length_fraction)[0], None),
        progress,
        jnp.asarray(length_fractions[:-1], expected_duration.dtype),
    )
    last_length_fraction = float(length_fractions[-1])
    progress, last_interval = advance_interval(progress, last_length_fraction, ends_at_event=True)
    last_interval_length = last_interval.newton_sweep_state.interval_length
    return CollocatedPhaseEnd(
        progress.q,
        progress.v,
        phase_duration=(1.0 - last_length_fraction) * expected_duration
        + last_interval_length
        + last_interval.last_duration_correction,
        estimated_rate_correction=progress.estimated_rate_correction,
        last_duration_correction=jnp.abs(last_interval.last_duration_correction),
        largest_start_rate_error=progress.largest_start_rate_error,
        lowest_guard_value=jnp.minimum(progress.lowest_guard_value, last_interval_length),
    )


def _sum_over_nodes(node_weights: np.ndarray, node_accelerations: NodeAccelerations) -> Vector:
    """Return the weighted sum of the accelerations at all nodes, for each coordinate."""
    return tuple(
        sum(
            float(node_weight) * acceleration
            for node_weight, acceleration in zip(node_weights, accelerations, strict=True)
        )
        for accelerations in zip(*node_accelerations, strict=True)
    )


def _compute_interval_state(
    q: Vector,
    v: Vector,
    h: Array,
    node_accelerations: NodeAccelerations,
    length_fraction: float,
    integration_weights: np.ndarray,
    double_integration_weights: np.ndarray,
) -> tuple[Vector, Vector]:
    """Return coordinates and rates at one location in a mesh interval of length `h` that starts at
    (q, v).

    - `length_fraction`: time from the start of the interval to the location, divided by `h`;
    - `integration_weights`, `double_integration_weights`: weights of the node values in the single
      and the double integral up to the location.
    """
    return (
        jax.tree.map(
            lambda q, v, a: q + h * (length_fraction * v + h * a),
            q,
            v,
            _sum_over_nodes(double_integration_weights, node_accelerations),
        ),
        jax.tree.map(
            lambda v, a: v + h * a, v, _sum_over_nodes(integration_weights, node_accelerations)
        ),
    )


def _solve_mesh_interval(
    phase: AbstractPhase,
    q: Vector,
    v: Vector,
    h: Array,
    nonlinear_accelerations: NodeAccelerations,
    ends_at_event: bool,
) -> _SolvedMeshInterval:
    """Return the solution of the collocation equations in one mesh interval by Newton sweeps.

    The interval starts at (q, v) and has the length `h`. If the interval ends at an event, its
    length is an additional unknown. The Jacobian is evaluated at the middle of the interval, and
    each sweep gains about two digits. The sweeps start from the solution of the equations that are
    linearized at the middle, plus the `nonlinear_accelerations` of the previous interval. If the
    length changes, the new node accelerations are values of the polynomial through the old ones.
    """
    start_acceleration = phase.solve_acceleration(phase.compute_motion(q, v))[: len(q)]
    midpoint_state = (
        jax.tree.map(lambda q, v, a: q + 0.5 * h * (v + 0.25 * h * a), q, v, start_acceleration),
        jax.tree.map(lambda v, a: v + 0.5 * h * a, v, start_acceleration),
    )
    dynamics_residual, jacobian_q, jacobian_v, jacobian_a = _linearize_dynamics_residual(
        phase, *midpoint_state, start_acceleration
    )
    inverse_stage_matrices = [
        _invert_stage_matrix(complex(gauss_eigenvalue), h, jacobian_q, jacobian_v, jacobian_a)
        for gauss_eigenvalue in INTEGRATION_MATRIX_EIGENVALUES
    ]

    def run_newton_sweep(
        newton_sweep_state: _NewtonSweepState, _: None
    ) -> tuple[_NewtonSweepState, None]:
        interval_length, node_accelerations, rate_correction = newton_sweep_state[:3]
        node_residuals = []
        for node_index, acceleration in enumerate(node_accelerations):
            node_state = _compute_interval_state(
                q,
                v,
                interval_length,
                node_accelerations,
                float(GAUSS_NODES[node_index]),
                INTEGRATION_MATRIX[node_index],
                DOUBLE_INTEGRATION_MATRIX[node_index],
            )
            node_residuals.append(
                phase.compute_dynamics_residual(phase.compute_motion(*node_state), acceleration)
            )
        # The projections have the sign of a correction.
        residual_projections = [
            list(
                map(
                    _ComplexNumber,
                    _sum_over_nodes(-eigenvector_weights.real, tuple(node_residuals)),
                    _sum_over_nodes(-eigenvector_weights.imag, tuple(node_residuals)),
                )
            )
            for eigenvector_weights in EIGENVECTOR_PROJECTION_MATRIX
        ]
        node_accelerations, largest_rate_correction = _correct_node_accelerations(
            node_accelerations, inverse_stage_matrices, residual_projections, interval_length
        )
        return _NewtonSweepState(
            interval_length, node_accelerations, largest_rate_correction, rate_correction
        ), None

    def compute_end_state(newton_sweep_state: _NewtonSweepState) -> tuple[Vector, Vector]:
        return _compute_interval_state(
            q, v, *newton_sweep_state[:2], 1.0, END_WEIGHTS, DOUBLE_END_WEIGHTS
        )

    def evaluate_event_guard(q: Vector, v: Vector) -> tuple[Array, Vector]:
        phase_instant = PhaseInstant(phase, phase.compute_motion(q, v), None)
        return phase.compute_end_guard(phase_instant), phase_instant.acceleration[: phase.n_dof]

    def compute_time_to_event(newton_sweep_state: _NewtonSweepState) -> Array:
        """Return the time from the end of the interval to the event, estimated by one Newton step,
        in the unit of `h`.
        """
        end_state = compute_end_state(newton_sweep_state)
        _, end_acceleration = evaluate_event_guard(*end_state)
        (guard_value, _), (guard_rate, _) = jax.jvp(
            evaluate_event_guard, end_state, (end_state[1], end_acceleration)
        )
        time_to_event = -guard_value / jnp.where(guard_rate < 0.0, guard_rate, -jnp.inf)
        half_length = 0.5 * newton_sweep_state.interval_length
        return jnp.clip(time_to_event, -half_length, half_length)

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
            length=COLLOCATION_STEP_OPTIONS.n_sweeps_per_duration_correction,
        )
        return (newton_sweep_state, compute_time_to_event(newton_sweep_state)), None

    linearized_solution, largest_rate_correction = _correct_node_accelerations(
        (start_acceleration,) * N_GAUSS_NODES,
        inverse_stage_matrices,
        _project_linearized_residuals(
            dynamics_residual, jacobian_q, jacobian_v, v, start_acceleration, h
        ),
        h,
    )
    newton_sweep_state = _NewtonSweepState(
        h,
        jax.tree.map(operator.add, linearized_solution, nonlinear_accelerations),
        largest_rate_correction,
        largest_rate_correction,
    )
    duration_correction = jnp.zeros_like(h)
    if ends_at_event:
        (newton_sweep_state, duration_correction), _ = lax.scan(
            correct_interval_duration,
            (newton_sweep_state, compute_time_to_event(newton_sweep_state)),
            None,
            length=COLLOCATION_STEP_OPTIONS.n_duration_corrections,
        )
    else:
        newton_sweep_state, _ = lax.scan(
            run_newton_sweep,
            newton_sweep_state,
            None,
            length=COLLOCATION_STEP_OPTIONS.n_sweeps_per_interval,
        )
    node_accelerations = newton_sweep_state.node_accelerations
    start_rate_errors = [
        jnp.abs(extrapolated_acceleration - acceleration)
        for extrapolated_acceleration, acceleration in zip(
            _sum_over_nodes(START_EXTRAPOLATION_WEIGHTS, node_accelerations),
            start_acceleration,
            strict=True,
        )
    ]
    # The end state is extrapolated by the last correction of the duration, whose square is
    # negligible.
    Q, V = compute_end_state(newton_sweep_state)
    end_acceleration = _sum_over_nodes(END_EXTRAPOLATION_WEIGHTS, node_accelerations)
    return _SolvedMeshInterval(
        newton_sweep_state,
        jax.tree.map(lambda x, rate: x + duration_correction * rate, (Q, V), (V, end_acceleration)),
        duration_correction,
        newton_sweep_state.interval_length * functools.reduce(jnp.maximum, start_rate_errors),
        jax.tree.map(operator.sub, node_accelerations, linearized_solution),
    )


def _stretch_node_accelerations(
    node_accelerations: NodeAccelerations, relative_length_change: Array
) -> NodeAccelerations:
    """Return the node accelerations of the interval after a small relative change of its length."""
    first_derivatives, second_derivatives = (
        tuple(_sum_over_nodes(node_weights, node_accelerations) for node_weights in weight_matrix)
        for weight_matrix in (INTERVAL_STRETCH_WEIGHTS, INTERVAL_STRETCH_CURVATURE_WEIGHTS)
    )
    return jax.tree.map(
        lambda a, da, dda: a + relative_length_change * (da + relative_length_change * dda),
        node_accelerations,
        first_derivatives,
        second_derivatives,
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


@dataclass(frozen=True)
class _ComplexNumber:
    """Complex number. Machine code has no complex type."""

    real: Any
    imag: Any

    def __add__(self, other: "_ComplexNumber") -> "_ComplexNumber":
        return _ComplexNumber(self.real + other.real, self.imag + other.imag)

    def __neg__(self) -> "_ComplexNumber":
        return _ComplexNumber(-self.real, -self.imag)

    def __sub__(self, other: "_ComplexNumber") -> "_ComplexNumber":
        return _ComplexNumber(self.real - other.real, self.imag - other.imag)

    def __mul__(self, other: "_ComplexNumber") -> "_ComplexNumber":
        return _ComplexNumber(
            self.real * other.real - self.imag * other.imag,
            self.real * other.imag + self.imag * other.real,
        )


def _multiply_and_sum(
    left_factors: Iterable[_ComplexNumber], right_factors: Iterable[_ComplexNumber]
) -> _ComplexNumber:
    """Return the sum of the products of corresponding factors."""
    return functools.reduce(operator.add, map(operator.mul, left_factors, right_factors))


def _invert_stage_matrix(
    gauss_eigenvalue: complex,
    h: Array,
    residual_jacobian_q: Any,
    residual_jacobian_v: Any,
    residual_jacobian_a: Any,
) -> list[list[_ComplexNumber]]:
    """Return the inverse of the complex stage matrix A + h e V + (h e)^2 Q as nested lists.

    Here e is `gauss_eigenvalue`, and h is the length of the interval. A, V and Q are the
    derivatives of the residual with respect to accelerations, rates and coordinates. The inverse is
    the adjugate divided by the determinant.
    """
    n, squared_eigenvalue = len(residual_jacobian_q), gauss_eigenvalue * gauss_eigenvalue
    scaled_eigenvalue = _ComplexNumber(h * gauss_eigenvalue.real, h * gauss_eigenvalue.imag)
    scaled_square = _ComplexNumber(h * h * squared_eigenvalue.real, h * h * squared_eigenvalue.imag)
    stage_matrix = [
        [
            _ComplexNumber(
                residual_jacobian_a[j][i]
                + scaled_eigenvalue.real * residual_jacobian_v[j][i]
                + scaled_square.real * residual_jacobian_q[j][i],
                scaled_eigenvalue.imag * residual_jacobian_v[j][i]
                + scaled_square.imag * residual_jacobian_q[j][i],
            )
            for j in range(n)
        ]
        for i in range(n)
    ]

    def compute_cofactor(i: int, j: int) -> _ComplexNumber:
        (a, b), (c, d) = ((i + 1) % 3, (i + 2) % 3), ((j + 1) % 3, (j + 2) % 3)
        return stage_matrix[a][c] * stage_matrix[b][d] - stage_matrix[a][d] * stage_matrix[b][c]

    if n == 1:
        adjugate_matrix, determinant = [[_ComplexNumber(1.0, 0.0)]], stage_matrix[0][0]
    elif n == 2:
        adjugate_matrix = [
            [stage_matrix[1][1], -stage_matrix[0][1]],
            [-stage_matrix[1][0], stage_matrix[0][0]],
        ]
        determinant = (
            stage_matrix[0][0] * stage_matrix[1][1] - stage_matrix[0][1] * stage_matrix[1][0]
        )
    else:
        adjugate_matrix = [[compute_cofactor(j, i) for j in range(3)] for i in range(3)]
        determinant = _multiply_and_sum(
            stage_matrix[0], [matrix_row[0] for matrix_row in adjugate_matrix]
        )
    squared_modulus = determinant.real * determinant.real + determinant.imag * determinant.imag
    inverse_determinant = _ComplexNumber(
        determinant.real / squared_modulus, -determinant.imag / squared_modulus
    )
    return [
        [inverse_determinant * matrix_entry for matrix_entry in matrix_row]
        for matrix_row in adjugate_matrix
    ]


def _project_linearized_residuals(
    midpoint_residual: Vector,
    residual_jacobian_q: Any,
    residual_jacobian_v: Any,
    v: Vector,
    a: Vector,
    h: Array,
) -> list[list[_ComplexNumber]]:
    """Return the projections of the negative node residuals onto all eigenvectors.

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

    node_fraction_powers = np.stack(
        [np.ones(N_GAUSS_NODES), GAUSS_NODES - 0.5, 0.5 * GAUSS_NODES * GAUSS_NODES - 0.125]
    )
    projected_node_fraction_powers = np.sum(
        EIGENVECTOR_PROJECTION_MATRIX[:, None] * node_fraction_powers, -1
    )

    def sum_weighted_terms(term_weights: np.ndarray) -> Vector:
        constant_weight, linear_weight, quadratic_weight = map(float, term_weights)
        return tuple(
            constant_weight * midpoint_residual[i]
            + h
            * (
                linear_weight * (stiffness_rate_term[i] + damping_term[i])
                + quadratic_weight * h * stiffness_acceleration_term[i]
            )
            for i in n
        )

    return [
        list(map(_ComplexNumber, sum_weighted_terms(-w.real), sum_weighted_terms(-w.imag)))
        for w in projected_node_fraction_powers
    ]


def _correct_node_accelerations(
    node_accelerations: NodeAccelerations,
    inverse_stage_matrices: list,
    residual_projections: list,
    h: Array,
) -> tuple[NodeAccelerations, Array]:
    """Return the corrected node accelerations, and the largest change of a rate that results.

    - `inverse_stage_matrices`, `residual_projections`: one entry per eigenvector.
    """
    eigenvector_corrections = [
        [_multiply_and_sum(matrix_row, residual_projection) for matrix_row in inverse_stage_matrix]
        for inverse_stage_matrix, residual_projection in zip(
            inverse_stage_matrices, residual_projections, strict=True
        )
    ]
    acceleration_changes = tuple(
        tuple(
            sum(
                float(2.0 * eigenvector_entry.real) * correction.real
                - float(2.0 * eigenvector_entry.imag) * correction.imag
                for eigenvector_entry, correction in zip(
                    eigenvector_entries, coordinate_corrections, strict=True
                )
            )
            for coordinate_corrections in zip(*eigenvector_corrections, strict=True)
        )
        for eigenvector_entries in EIGENVECTOR_COLUMNS
    )
    largest_change = functools.reduce(
        jnp.maximum, map(jnp.abs, jax.tree.leaves(acceleration_changes))
    )
    return jax.tree.map(operator.add, node_accelerations, acceleration_changes), h * largest_change


def _find_lowest_guard_value(
    phase: AbstractPhase,
    q: Vector,
    v: Vector,
    interval: _SolvedMeshInterval,
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
    interval_length, node_accelerations, *_ = interval.newton_sweep_state
    midpoint_state = _compute_interval_state(
        q, v, interval_length, node_accelerations, 0.5, *MIDPOINT_INTEGRATION_WEIGHTS
    )
    midpoint_guard_values, end_guard_values = (
        phase.compute_guards(
            PhaseInstant(
                phase,
                phase.compute_motion(*interval_state),
                _sum_over_nodes(acceleration_weights, node_accelerations),
            )
        )
        for interval_state, acceleration_weights in (
            (midpoint_state, MIDPOINT_INTERPOLATION_WEIGHTS),
            (interval.interval_end_state, END_EXTRAPOLATION_WEIGHTS),
        )
    )
    lowest_of_all_guard_values = jnp.full_like(interval_length, jnp.inf)
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
) -> CollocationStep:
    """Return the result of one gait step of every lane, computed near expected phase durations.

    - `x`: components of the section states, arrays over lanes, rad, rad/s, m/s;
    - `expected_durations`: expected durations of DLS, SLS-I and SLS-II, arrays over lanes, s.
    """
    options = COLLOCATION_STEP_OPTIONS
    is_start_state_valid = is_valid_start_state(params, x)
    params, x = replace_invalid_inputs(is_start_state_valid, params, x, PAPER_START_STATE)
    wheel_units = compute_wheel_units(params.symbols())
    state_units: tuple[Any, ...] = (1.0, wheel_units.rate_unit, wheel_units.velocity_unit)
    params = convert_to_wheel_units(params)
    x = tuple(a / state_unit for a, state_unit in zip(x, state_units, strict=True))
    expected_durations = tuple(duration / wheel_units.time_unit for duration in expected_durations)
    for duration in expected_durations:
        is_start_state_valid &= (duration > 0.0) & (duration < options.max_expected_duration)
    expected_durations = tuple(
        jnp.where(is_start_state_valid, duration, 0.1) for duration in expected_durations
    )
    s = params.symbols()
    landing_result = transitions.resolve_landing(s, *x)
    is_collocation_trusted = is_start_state_valid & landing_result.is_rear_foot_planted
    wheel_angle, wheel_motion = landing_result.theta_after_landing, landing_result.motion_after
    phase_durations = []
    for collocated_phase, expected_duration, phase_mesh, max_start_rate_error in zip(
        make_paper_phases(s, landing_result.foot_distance, stop_at_lift_off),
        expected_durations,
        options.phase_meshes,
        options.max_start_rate_errors,
        strict=True,
    ):
        phase_start_state = collocated_phase.select_phase_coordinates(wheel_angle, wheel_motion)
        phase_end = solve_phase_by_collocation(
            collocated_phase, *phase_start_state, expected_duration, phase_mesh
        )
        is_collocation_trusted = (
            is_collocation_trusted
            & (phase_end.estimated_rate_correction <= options.max_rate_correction)
            & (phase_end.last_duration_correction <= options.max_duration_correction)
            & (phase_end.largest_start_rate_error <= max_start_rate_error)
            & (phase_end.lowest_guard_value > 0.0)
        )
        end_motion = collocated_phase.compute_motion(phase_end.q, phase_end.v)
        wheel_angle, wheel_motion = phase_end.q[0], collocated_phase.reset_motion(end_motion)
        phase_durations.append(phase_end.phase_duration)

    results = (wheel_angle, wheel_motion.dtheta, wheel_motion.dL1, *phase_durations)
    si_units = (*state_units, *(wheel_units.time_unit,) * len(phase_durations))
    trusted_results = tuple(
        jnp.where(is_collocation_trusted, x * si_unit, 0.0)
        for x, si_unit in zip(results, si_units, strict=True)
    )
    return CollocationStep(trusted_results[:3], trusted_results[3:], is_collocation_trusted)
