"""Compute the linear response of a gait's step to uneven ground, and the gait sensitivity norm.

Uneven ground consists of straight lines with different slopes. The norm is that of Hobbelen and
Wisse, "A disturbance rejection measure for limit cycle walkers: the gait sensitivity norm" (2007).
Its sum over all later gait steps has a closed form.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from vrw_jax.base.elementwise import evaluate_with_jvps
from vrw_jax.base.options import StepOptions
from vrw_jax.gaits import floquet
from vrw_jax.gaits.derivatives import make_derivative_compiler, make_tangent_function
from vrw_jax.gaits.phase_collocation import linearize_steps
from vrw_jax.gaits.phase_sequence import CollocationState, CollocationSystem, LaneParameters
from vrw_jax.lanes.autodiff import compute_square_root, with_implicit_derivative
from vrw_jax.wheel.params import PARAMETER_NAMES, WheelParams

N_DOUBLINGS = 45
"""Number of doublings of the steps whose effects are summed. The value is chosen because the sum is
then complete, unless the modulus of a multiplier differs from 1 by little more than round-off.
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
    is_gait_stable = floquet.compute_spectral_radius(lax.stop_gradient(A)) < 1.0
    A = jnp.where(is_gait_stable, A, 0.0)
    b = A @ B0 + B1

    def double(_: Any, state: tuple[Array, Array]) -> tuple[Array, Array]:
        """Return A^2m and the sum of A^j b b^T A^Tj below j = 2m, from those of m."""
        power, covariance = state
        return power @ power, covariance + power @ covariance @ power.T

    _, P = lax.fori_loop(0, N_DOUBLINGS, double, (A, jnp.outer(b, b)))
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


@eqx.filter_jit
def compute_step_slope_response(
    model: Any,
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


@functools.cache
def make_slope_response_function(collocation_system: CollocationSystem) -> Callable:
    """Return the slope response of a gait step of the paper's model, computed from its collocation.

    The result is a function of the parameters and the collocation state of a gait. The measures are
    `COLLOCATION_RESPONSE_MEASURES`. The state is (theta+, dtheta+) just after a landing, in the
    frame of the line of the ground under both feet. The response is differentiable on the branch of
    gaits, in every mode and to any order.
    """
    compute_jacobian = with_implicit_derivative(
        functools.partial(_compute_step_jacobian, collocation_system),
        make_tangent_function(collocation_system),
        make_derivative_compiler(2, collocation_system),
    )
    n_state_entries = collocation_system.phase_sequence.section_size
    return jax.jit(
        lambda parameters, collocation_state: SlopeResponse.from_jacobian(
            compute_jacobian(parameters, lax.stop_gradient(collocation_state)), n_state_entries
        )
    )


def _compute_step_jacobian(
    collocation_system: CollocationSystem,
    parameters: LaneParameters,
    collocation_state: CollocationState,
) -> Array:
    """Return the Jacobian of (end state, measures) with respect to (start state, slope, next
    slope), for each wheel on the last axis.
    """
    solution, sequence = collocation_state.solution, collocation_system.phase_sequence
    # The last constant of a phase is the angle by which the next line is steeper.
    parameters = jnp.concatenate(
        [collocation_system.complete_parameters(parameters), jnp.zeros_like(parameters[:1])]
    )
    (_, end_tangents), (_, _, duration_tangents, _) = linearize_steps(
        collocation_system,
        parameters,
        solution,
        collocation_state.is_phase_active,
        (PARAMETER_NAMES.index("slope"), len(parameters) - 1),
    )
    phase_constants = collocation_system.phase_constants_function(*parameters)

    def measure(section_state: Array, durations: Array) -> Array:
        start = sequence.step_start_map(phase_constants, tuple(section_state))
        period, (step_length,) = jnp.sum(durations, 0), start.held_constants
        fraction, speed = durations[0] / period, step_length / period
        return jnp.stack([fraction, period, speed, step_length, *durations])

    n_directions, n_coordinates, _ = end_tangents.shape
    start_tangents = jnp.eye(n_directions, n_coordinates, -1, parameters.dtype)[..., None]
    _, measure_tangents = evaluate_with_jvps(
        measure,
        (solution.section_state, solution.durations[0]),
        (jnp.broadcast_to(start_tangents, end_tangents.shape), duration_tangents[0]),
    )
    tangents = jnp.concatenate([end_tangents, measure_tangents], 1)[1:]
    by_slope, by_tilt = tangents[-2:]
    return jnp.stack([*tangents[:-2], by_slope - by_tilt, by_tilt], 1)
