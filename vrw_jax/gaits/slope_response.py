"""Compute the linear response of a gait's step to uneven ground, and the gait sensitivity norm.

Uneven ground consists of straight lines with different slopes. The norm is that of Hobbelen and
Wisse, "A disturbance rejection measure for limit cycle walkers: the gait sensitivity norm" (2007).
Its sum over all later gait steps has a closed form.
"""

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from vrw_jax.base.options import StepOptions
from vrw_jax.gaits import floquet
from vrw_jax.gaits.collocation_search import CollocationState, CollocationSystem
from vrw_jax.gaits.phase_collocation import reconstruct_gait_step
from vrw_jax.lanes.autodiff import ForwardFunction, compute_square_root, enable_all_ad_modes
from vrw_jax.models.interface import AbstractWheel
from vrw_jax.wheel.params import PARAMETER_NAMES, WheelParams

N_CHORD_ITERATIONS = 3
"""Number of Newton iterations that use the same Jacobian.

Each iteration makes the derivatives of one more order exact. The value is chosen because a gradient
of the norm needs derivatives of second order.
"""


class SlopeResponse(NamedTuple):
    """Derivatives of a gait step with respect to its start state and the slopes of the ground.

    A gait step depends on two successive lines of the ground. Let x[k] be the start state of step
    k, y[k] its measures, and e[k] the deviation of the slope of line k. Then x[k+1] = A x[k] + B1
    e[k] + B0 e[k+1] and y[k] = C x[k] + D1 e[k] + D0 e[k+1].
    """

    A: Float[Array, "n n"]
    B1: Float[Array, " n"]
    B0: Float[Array, " n"]
    C: Float[Array, "n_measures n"]
    D1: Float[Array, " n_measures"]
    D0: Float[Array, " n_measures"]

    @classmethod
    def from_jacobian(cls, step_jacobian: Array, n_state_entries: int) -> "SlopeResponse":
        """Build the response from the Jacobian of (end state, measures).

        The Jacobian is with respect to (start state, slope, next slope). A state has
        `n_state_entries` entries.
        """
        end_state_rows, measure_rows = (
            step_jacobian[:n_state_entries],
            step_jacobian[n_state_entries:],
        )
        return cls(
            end_state_rows[:, :n_state_entries],
            end_state_rows[:, n_state_entries],
            end_state_rows[:, n_state_entries + 1],
            measure_rows[:, :n_state_entries],
            measure_rows[:, n_state_entries],
            measure_rows[:, n_state_entries + 1],
        )

    def select_measures(self, measure_indices: Sequence[int]) -> "SlopeResponse":
        """Return the response of the measures with the indices `measure_indices`."""
        measure_index_array = jnp.asarray(measure_indices)
        return self._replace(
            C=self.C[measure_index_array],
            D1=self.D1[measure_index_array],
            D0=self.D0[measure_index_array],
        )


class SensitivityNormParts(NamedTuple):
    """Gait sensitivity norm of each measure and its three parts, in the measure's unit per rad.

    The squares of the parts sum to the square of the norm. Each part is a response to the deviation
    of the slope of one line of the ground. The first two parts have a sign. They belong to the gait
    step that ends on that line and to the step that begins on it. The third part belongs to all
    later steps.
    """

    sensitivity_norms: Float[Array, " n_measures"]
    ending_step_response: Float[Array, " n_measures"]
    beginning_step_response: Float[Array, " n_measures"]
    later_steps_response: Float[Array, " n_measures"]


def compute_sensitivity_norms(slope_response: SlopeResponse) -> SensitivityNormParts:
    """Return the ratio of each measure's standard deviation to that of independent slopes.

    The responses to the deviation of one line are D0, then C B0 + D1, then C A^j b. Here b = A B0 +
    B1 and j = 0, 1, .... The squares of C A^j b sum to C P C^T. The matrix P solves the discrete
    Lyapunov equation `P = A P A^T + b b^T`. The norm is infinite if the gait is not stable.
    """
    A, B1, B0, C, D1, D0 = slope_response
    n = len(A)
    is_gait_stable = floquet.compute_spectral_radius(lax.stop_gradient(A)) < 1.0
    A = jnp.where(is_gait_stable, A, 0.0)
    b = A @ B0 + B1
    lyapunov_matrix = jnp.eye(n * n, dtype=A.dtype) - jnp.kron(A, A)
    approximate_inverse = invert_by_elimination(lax.stop_gradient(lyapunov_matrix))
    forcing_vector = jnp.outer(b, b).ravel()
    response_covariance = approximate_inverse @ forcing_vector
    for _ in range(N_CHORD_ITERATIONS):
        response_covariance = response_covariance - approximate_inverse @ (
            lyapunov_matrix @ response_covariance - forcing_vector
        )
    P = response_covariance.reshape(n, n)
    later_steps_squared = jnp.einsum("mi,ij,mj->m", C, P, C)
    beginning_step_response = C @ B0 + D1
    sensitivity_norm = compute_square_root(D0**2 + beginning_step_response**2 + later_steps_squared)
    infinite_if_unstable = lambda unbounded_sensitivity: jnp.where(
        is_gait_stable, unbounded_sensitivity, jnp.inf
    )
    return SensitivityNormParts(
        infinite_if_unstable(sensitivity_norm),
        D0,
        beginning_step_response,
        infinite_if_unstable(compute_square_root(later_steps_squared)),
    )


def invert_by_elimination(square_matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Invert a matrix by Gauss-Jordan elimination with row exchanges.

    LAPACK's batched solver uses threads of the pool on which XLA runs the program. If two such
    programs run at a time, as in a scan on two cores, they block each other (jaxlib 0.10).
    """
    matrix_size = len(square_matrix)
    augmented_matrix = jnp.concatenate(
        [square_matrix, jnp.eye(matrix_size, dtype=square_matrix.dtype)], axis=1
    )

    def eliminate_column(column_index: Array, augmented_matrix: Array) -> Array:
        pivot_candidates = jnp.where(
            jnp.arange(matrix_size) >= column_index,
            jnp.abs(augmented_matrix[:, column_index]),
            -1.0,
        )
        pivot_row_index = jnp.argmax(pivot_candidates)
        pivot_row, row_at_pivot_position = (
            augmented_matrix[pivot_row_index],
            augmented_matrix[column_index],
        )
        augmented_matrix = augmented_matrix.at[pivot_row_index].set(row_at_pivot_position)
        pivot_row = pivot_row / pivot_row[column_index]
        eliminated_matrix = augmented_matrix - augmented_matrix[:, column_index, None] * pivot_row
        return eliminated_matrix.at[column_index].set(pivot_row)

    return lax.fori_loop(0, matrix_size, eliminate_column, augmented_matrix)[:, matrix_size:]


def compute_step_slope_response(
    model: AbstractWheel,
    params: WheelParams,
    section_state: Array,
    measure_names: Sequence[str],
    options: StepOptions,
) -> SlopeResponse:
    """Return the slope response of an event-driven step that starts at the section state of a gait.

    The discrete codes in the section state do not vary.
    """
    n_state_entries = model.count_continuous_section_entries(params)
    section_state_codes = section_state[n_state_entries:]

    def evaluate_step(step_start_and_slopes: Array) -> Array:
        stepwise_ground: Any = model.split_ground_by_step(
            eqx.tree_at(lambda p: p.slope, params, step_start_and_slopes[n_state_entries:]), 1
        )
        step_model, step_params = model.with_step_ground(
            params, tuple(ground_quantity_by_step[0] for ground_quantity_by_step in stepwise_ground)
        )
        gait_step = step_model.take_step(
            step_params,
            jnp.concatenate([step_start_and_slopes[:n_state_entries], section_state_codes]),
            options,
        )
        step_measures = gait_step.measures()
        measure_values = [jnp.ravel(step_measures[measure_name]) for measure_name in measure_names]
        return jnp.concatenate([gait_step.section_state[:n_state_entries], *measure_values])

    step_start_and_slopes = jnp.concatenate(
        [section_state[:n_state_entries], jnp.stack([params.slope, params.slope])]
    )
    return SlopeResponse.from_jacobian(
        jax.jacfwd(evaluate_step)(step_start_and_slopes), n_state_entries
    )


COLLOCATION_RESPONSE_MEASURES = (
    "dls_fraction",
    "period",
    "speed",
    "step_length",
    "duration_dls",
    "duration_sls1",
    "duration_sls2",
)
"""Names of the measures of a gait step that follow from its durations and its first landing."""


def compute_collocation_slope_response(
    collocation_system: CollocationSystem, parameters: Array, collocation_state: CollocationState
) -> SlopeResponse:
    """Return the slope response of a gait step of the paper's model, computed from its collocation.

    The measures are `COLLOCATION_RESPONSE_MEASURES`. The state is (theta+, dtheta+) just after a
    landing, in the frame of the line of the ground under both feet. The response is differentiable
    on the branch of gaits in every mode, up to second order.
    """
    collocation_solution, is_phase_active = (
        collocation_state.solution,
        collocation_state.is_phase_active[0],
    )
    gait_unknowns = lax.stop_gradient(
        (
            collocation_solution.durations[0],
            *(phase_accelerations[0] for phase_accelerations in collocation_solution.accelerations),
        )
    )
    return _make_collocation_response_function(collocation_system)(
        parameters,
        collocation_solution.section_state,
        lax.stop_gradient(is_phase_active),
        *gait_unknowns,
    )[0]


@functools.cache
def _make_collocation_response_function(collocation_system: CollocationSystem) -> ForwardFunction:
    """Return a function that computes the slope response of a collocated gait step.

    The arguments of the function are the parameters, the section state and the solution of the
    step. Newton's method computes durations and accelerations for other start states and slopes.
    Its Jacobian is that of the gait's step.
    """
    slope_index = PARAMETER_NAMES.index("slope")

    def compute_response(
        parameters: Array, section_state: Array, is_phase_active: Array, *gait_unknowns: Array
    ) -> tuple:
        gait_unknown_vector, unflatten_unknowns = ravel_pytree(gait_unknowns)

        def reconstruct_from_unknowns(
            unknown_vector: Array, step_start_and_slopes: Array, parameters: Array
        ) -> tuple:
            durations, *accelerations = unflatten_unknowns(unknown_vector)
            line_parameters = parameters.at[slope_index].set(step_start_and_slopes[2])
            phase_constants = (
                *collocation_system.phase_constants_function(*line_parameters),
                step_start_and_slopes[3] - step_start_and_slopes[2],
            )
            end_section_state, phase_points = reconstruct_gait_step(
                collocation_system.phase_sequence,
                collocation_system.phase_meshes,
                phase_constants,
                tuple(step_start_and_slopes[:2]),
                durations,
                tuple(accelerations),
            )
            return phase_constants, end_section_state, phase_points

        def evaluate_cycle_residual(
            unknown_vector: Array, step_start_and_slopes: Array, parameters: Array
        ) -> Array:
            durations, *accelerations = unflatten_unknowns(unknown_vector)
            phase_constants, _, phase_points = reconstruct_from_unknowns(
                unknown_vector, step_start_and_slopes, parameters
            )
            cycle_residual_parts: list[Array] = []
            for phase_index, (phase, points_of_phase) in enumerate(
                zip(collocation_system.phase_sequence.phases, phase_points, strict=True)
            ):
                node_accelerations = accelerations[phase_index].reshape(-1, phase.n_coordinates).T
                cycle_residual_parts += phase.residual_function(
                    phase_constants, points_of_phase.node_points, tuple(node_accelerations)
                )
                end_event_value = phase.end_event_function(
                    phase_constants, points_of_phase.phase_end_point
                )
                cycle_residual_parts.append(
                    jnp.where(
                        is_phase_active[phase_index] > 0.5, end_event_value, durations[phase_index]
                    )[None]
                )
            return jnp.concatenate(cycle_residual_parts)

        step_start_and_slopes = jnp.concatenate(
            [section_state, jnp.full(2, parameters[slope_index])]
        )
        residual_jacobian = jax.jacfwd(evaluate_cycle_residual)(
            gait_unknown_vector, *lax.stop_gradient((step_start_and_slopes, parameters))
        )
        inverse_jacobian = invert_by_elimination(residual_jacobian)

        def evaluate_step_outputs(step_start_and_slopes: Array) -> Array:
            def refine_gait_unknowns(unknown_vector: Array, _: None) -> tuple[Array, None]:
                newton_correction = inverse_jacobian @ evaluate_cycle_residual(
                    unknown_vector, step_start_and_slopes, parameters
                )
                return unknown_vector - newton_correction, None

            unknown_vector, _ = lax.scan(
                refine_gait_unknowns, gait_unknown_vector, length=N_CHORD_ITERATIONS
            )
            _, end_section_state, phase_points = reconstruct_from_unknowns(
                unknown_vector, step_start_and_slopes, parameters
            )
            durations, (step_length,) = (
                unflatten_unknowns(unknown_vector)[0],
                phase_points[0].phase_start_point.held_constants,
            )
            period = jnp.sum(durations)
            measure_values = (
                durations[0] / period,
                period,
                step_length / period,
                step_length,
                *durations,
            )
            return jnp.stack([*end_section_state, *measure_values])

        return SlopeResponse.from_jacobian(
            jax.jacfwd(evaluate_step_outputs)(step_start_and_slopes), len(section_state)
        ), ()

    return enable_all_ad_modes(compute_response)
