"""Linear response of a gait's step to the slopes of uneven ground, and the gait sensitivity norm.

The norm is that of Hobbelen and Wisse, "A disturbance rejection measure for limit cycle walkers:
the gait sensitivity norm" (2007), with its sum over all later steps in closed form.
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

from vrw_jax.collocation import reconstruct_step
from vrw_jax.continuation import floquet
from vrw_jax.cycles.collocation_search import CollocationState, CollocationSystem
from vrw_jax.models import AbstractWheel
from vrw_jax.numerics import ForwardFunction, StepOptions, enable_all_ad_modes
from vrw_jax.wheel import PARAMETER_NAMES, WheelParams

N_REFINEMENTS = 3
"""Number of Newton iterations with one Jacobian. It is chosen because each makes derivatives of
one more order exact, and a gradient of the norm needs the second order.
"""


class SlopeResponse(NamedTuple):
    """Derivatives of a step's end state and measures with respect to its start and the slopes of
    its two lines.

    With x[k] the start of step k and e[k] the deviation of the slope of line k, x[k+1] = A x[k] +
    B1 e[k] + B0 e[k+1] and y[k] = C x[k] + D1 e[k] + D0 e[k+1].
    """

    A: Float[Array, "n n"]
    B1: Float[Array, " n"]
    B0: Float[Array, " n"]
    C: Float[Array, "n_measures n"]
    D1: Float[Array, " n_measures"]
    D0: Float[Array, " n_measures"]

    @classmethod
    def from_jacobian(cls, jacobian: Array, n: int) -> "SlopeResponse":
        """Return the response from the Jacobian of (end state, measures) with respect to (start,
        slope, next slope).
        """
        end, measures = jacobian[:n], jacobian[n:]
        return cls(
            end[:, :n],
            end[:, n],
            end[:, n + 1],
            measures[:, :n],
            measures[:, n],
            measures[:, n + 1],
        )

    def select(self, measure_indices: Sequence[int]) -> "SlopeResponse":
        """Return the response with some of its measures."""
        indices = jnp.asarray(measure_indices)
        return self._replace(C=self.C[indices], D1=self.D1[indices], D0=self.D0[indices])


class GaitSensitivityNorm(NamedTuple):
    """Norm of each measure, and the parts whose squares add up to its square, in its unit per rad.

    The parts are the response to the deviation of one line. They are that of the step that ends on
    it and that of the step that begins on it, both with their sign, and that of all later steps
    together.
    """

    norm: Float[Array, " n_measures"]
    ending_step: Float[Array, " n_measures"]
    beginning_step: Float[Array, " n_measures"]
    later_steps: Float[Array, " n_measures"]


def compute_gait_sensitivity(response: SlopeResponse) -> GaitSensitivityNorm:
    """Return the standard deviation of each measure over that of independent slopes.

    The response to one line is D0, then C B0 + D1, then C A^j b with b = A B0 + B1. The sum of the
    squares of the last ones is C P C^T, where P = A P A^T + b b^T is a discrete Lyapunov equation.
    The norm is infinite for a gait that is not stable.
    """
    A, B1, B0, C, D1, D0 = response
    n = len(A)
    is_stable = floquet.compute_spectral_radius(lax.stop_gradient(A)) < 1.0
    A = jnp.where(is_stable, A, 0.0)
    b = A @ B0 + B1
    equation = jnp.eye(n * n, dtype=A.dtype) - jnp.kron(A, A)
    inverse = invert_by_elimination(lax.stop_gradient(equation))
    forcing_vector = jnp.outer(b, b).ravel()
    covariance = inverse @ forcing_vector
    for _ in range(N_REFINEMENTS):
        covariance = covariance - inverse @ (equation @ covariance - forcing_vector)
    P = covariance.reshape(n, n)
    later_squared = jnp.einsum("mi,ij,mj->m", C, P, C)
    beginning_step = C @ B0 + D1
    sensitivity_norm = _root(D0**2 + beginning_step**2 + later_squared)
    if_stable = lambda value: jnp.where(is_stable, value, jnp.inf)
    return GaitSensitivityNorm(
        if_stable(sensitivity_norm), D0, beginning_step, if_stable(_root(later_squared))
    )


def invert_by_elimination(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Return the inverse of a matrix by Gauss-Jordan elimination with row exchanges.

    LAPACK's batched solver takes threads of the pool on which XLA runs the program. Two programs at
    a time, as a scan runs on two cores, then wait for each other and never end (jaxlib 0.10).
    """
    n = len(matrix)
    augmented = jnp.concatenate([matrix, jnp.eye(n, dtype=matrix.dtype)], axis=1)

    def eliminate_column(k: Array, augmented: Array) -> Array:
        candidates = jnp.where(jnp.arange(n) >= k, jnp.abs(augmented[:, k]), -1.0)
        pivot_index = jnp.argmax(candidates)
        pivot_row, replaced_row = augmented[pivot_index], augmented[k]
        augmented = augmented.at[pivot_index].set(replaced_row)
        pivot_row = pivot_row / pivot_row[k]
        eliminated = augmented - augmented[:, k, None] * pivot_row
        return eliminated.at[k].set(pivot_row)

    return lax.fori_loop(0, n, eliminate_column, augmented)[:, n:]


def _root(squared_value: Array) -> Array:
    """Return the square root, with a zero derivative at zero and for negative round-off."""
    is_positive = squared_value > 0.0
    return jnp.where(is_positive, jnp.sqrt(jnp.where(is_positive, squared_value, 1.0)), 0.0)


def step_slope_response(
    model: AbstractWheel,
    params: WheelParams,
    section_state: Array,
    names: Sequence[str],
    options: StepOptions,
) -> SlopeResponse:
    """Return the response of a model's own step from the section state of its gait.

    Entries of the section state that are codes do not vary.
    """
    n = model.n_continuous(params)
    codes = section_state[n:]

    def evaluate(inputs: Array) -> Array:
        ground: Any = model.split_ground(eqx.tree_at(lambda p: p.slope, params, inputs[n:]), 1)
        step_model, step_params = model.with_ground(
            params, tuple(line_values[0] for line_values in ground)
        )
        step = step_model.take_step(step_params, jnp.concatenate([inputs[:n], codes]), options)
        measures = step.measures()
        values = [jnp.ravel(measures[name]) for name in names]
        return jnp.concatenate([step.section_state[:n], *values])

    inputs = jnp.concatenate([section_state[:n], jnp.stack([params.slope, params.slope])])
    return SlopeResponse.from_jacobian(jax.jacfwd(evaluate)(inputs), n)


COLLOCATION_RESPONSE_MEASURES = (
    "dls_fraction",
    "period",
    "speed",
    "step_length",
    "duration_dls",
    "duration_sls1",
    "duration_sls2",
)
"""Measures of a step that its durations and its first landing determine."""


def collocation_slope_response(
    system: CollocationSystem, parameters: Array, collocation_state: CollocationState
) -> SlopeResponse:
    """Return the response of the paper's step, with `COLLOCATION_RESPONSE_MEASURES`, from its
    collocation.

    The state is (theta+, dtheta+) just after a landing, in the frame of the line under both feet.
    The response is differentiable along the branch of gaits in every mode, up to second order.
    """
    solution, is_active = collocation_state.solution, collocation_state.phase_active[0]
    gait_unknowns = lax.stop_gradient(
        (solution.durations[0], *(a[0] for a in solution.accelerations))
    )
    compute_response = _make_collocation_response(system)
    return compute_response(
        parameters, solution.section_state, lax.stop_gradient(is_active), *gait_unknowns
    )[0]


@functools.cache
def _make_collocation_response(system: CollocationSystem) -> ForwardFunction:
    """Return the function that computes the response from parameters, section state and a step's
    solution.

    Durations and accelerations for other starts and slopes follow by Newton's method with the
    Jacobian of the gait's own step.
    """
    slope_index = PARAMETER_NAMES.index("slope")

    def compute_response(
        parameters: Array, section: Array, is_active: Array, *gait_unknowns: Array
    ) -> tuple:
        unknowns_of_gait, unravel = ravel_pytree(gait_unknowns)

        def reconstruct(unknowns: Array, inputs: Array, parameters: Array) -> tuple:
            durations, *accelerations = unravel(unknowns)
            line_parameters = parameters.at[slope_index].set(inputs[2])
            constants = (*system.compute_constants(*line_parameters), inputs[3] - inputs[2])
            section, phase_points = reconstruct_step(
                system.sequence,
                system.meshes,
                constants,
                tuple(inputs[:2]),
                durations,
                tuple(accelerations),
            )
            return constants, section, phase_points

        def residual(unknowns: Array, inputs: Array, parameters: Array) -> Array:
            durations, *accelerations = unravel(unknowns)
            constants, _, phase_points = reconstruct(unknowns, inputs, parameters)
            residuals: list[Array] = []
            for i, (phase, points) in enumerate(
                zip(system.sequence.phases, phase_points, strict=True)
            ):
                node_accelerations = accelerations[i].reshape(-1, phase.n_coordinates).T
                residuals += phase.residual(constants, points.nodes, tuple(node_accelerations))
                event = phase.event(constants, points.end)
                residuals.append(jnp.where(is_active[i] > 0.5, event, durations[i])[None])
            return jnp.concatenate(residuals)

        inputs = jnp.concatenate([section, jnp.full(2, parameters[slope_index])])
        jacobian = jax.jacfwd(residual)(unknowns_of_gait, *lax.stop_gradient((inputs, parameters)))
        inverse_jacobian = invert_by_elimination(jacobian)

        def evaluate(inputs: Array) -> Array:
            def refine(unknowns: Array, _: None) -> tuple[Array, None]:
                correction = inverse_jacobian @ residual(unknowns, inputs, parameters)
                return unknowns - correction, None

            unknowns, _ = lax.scan(refine, unknowns_of_gait, length=N_REFINEMENTS)
            _, end, phase_points = reconstruct(unknowns, inputs, parameters)
            durations, (length,) = unravel(unknowns)[0], phase_points[0].start.held_constants
            period = jnp.sum(durations)
            values = durations[0] / period, period, length / period, length, *durations
            return jnp.stack([*end, *values])

        return SlopeResponse.from_jacobian(jax.jacfwd(evaluate)(inputs), len(section)), ()

    return enable_all_ad_modes(compute_response)
