"""Find the smooth extrema of a quantity within one phase of a collocated cycle.

Let F be a quantity that depends on the state. Let R and S be its first and second time derivatives.
The extrema of R are roots of S. Between two neighboring extrema R is monotone, so that each sign
change of R is one extremum of F.

The roots are first located on a polynomial approximation of F in each mesh interval. The state at a
root is then computed as the end of an additional interval with Gauss nodes. F, R and S are
evaluated at that state, and the time of the root is corrected. The extrema are therefore as
accurate as the cycle.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from vrw_jax.base.types import Scalar
from vrw_jax.gaits.gauss import (
    DOUBLE_END_WEIGHTS,
    DOUBLE_INTEGRATION_MATRIX,
    END_WEIGHTS,
    GAUSS_NODES,
    INTEGRATION_MATRIX,
    N_GAUSS_NODES,
    PhaseMesh,
    compute_integration_weights,
)

N_SAMPLES_PER_INTERVAL = 8
"""Number of samples of a quantity F per mesh interval. The value is chosen because the polynomial
through the samples is then more accurate than the motion between two nodes.
"""
MAX_RATE_EXTREMA_PER_PHASE = 6
"""Largest number of extrema of the rate of F per phase. The value is chosen because the rate has at
most five extrema if the legs are stiff and lightly damped.
"""
N_BISECTIONS = 24
"""Number of bisections on the polynomials. The value is chosen because the error of a root in a
phase of 20 mesh intervals is then 1e-6 mesh intervals, less than that of the polynomials.
"""
N_TIME_CORRECTIONS = 3
"""Number of corrections of the time of an extremum. The value is chosen because each correction
reduces the initial error, 1e-4 mesh intervals, at least a hundredfold.
"""
N_STATE_NEWTON_ITERATIONS = 3
"""Number of Newton iterations for the state at an extremum. The value is chosen because the initial
error is 1e-5 and Newton's method converges quadratically.
"""


class QuantityTimeDerivatives(NamedTuple):
    """Value of a quantity at one state, and its first and second time derivatives."""

    quantity_value: Scalar
    first_time_derivative: Scalar
    second_time_derivative: Scalar


class PhaseExtrema(NamedTuple):
    """Extrema of a quantity F in one phase, and extrema of its rate R, each in the order of time.

    All arrays have a fixed length. An element that is no extremum has false flags, and its times
    and values are meaningless. The times carry no derivatives. The values nevertheless have exact
    first derivatives, because F and R are stationary in time at their extrema. The values at the
    ends have first derivatives, too, because the ends move with the motion.
    """

    extremum_times: Float[Array, " pieces"]  # since the start of the phase, s
    extremum_values: Float[Array, " pieces"]
    is_quantity_maximum: Bool[Array, " pieces"]
    is_quantity_minimum: Bool[Array, " pieces"]
    rate_extremum_times: Float[Array, " rates"]  # since the start of the phase, s
    rate_extremum_values: Float[Array, " rates"]  # value of R at its extrema
    is_rate_maximum: Bool[Array, " rates"]
    end_values: Float[Array, "2"]  # value of F at the start and at the end of the phase


FunctionOfCoordinatesAndRates = Callable[[Array, Array], Array]
"""Function that maps coordinates and rates, each of shape (coordinates,), to an array."""


def find_mesh_intervals(interval_boundary_times: Array, times_in_phase: Array) -> Array:
    """Return for each time the index of the mesh interval that contains it.

    The times are in s since the start of the phase.
    """
    return jnp.clip(
        jnp.searchsorted(interval_boundary_times, times_in_phase, side="right") - 1,
        0,
        len(interval_boundary_times) - 2,
    )


class CollocatedPhaseMotion(NamedTuple):
    """Motion during one phase: states at the mesh boundaries and accelerations at the Gauss nodes.

    In each mesh interval the accelerations are a polynomial of time.
    """

    interval_boundary_times: Float[Array, " boundaries"]  # times of the interval boundaries, s
    interval_boundary_q: Float[Array, "boundaries coordinates"]
    interval_boundary_v: Float[Array, "boundaries coordinates"]
    node_accelerations: Float[Array, "intervals nodes coordinates"]

    @classmethod
    def from_node_accelerations(
        cls,
        phase_mesh: PhaseMesh,
        start_q: Array,
        start_v: Array,
        phase_duration: Scalar,
        node_accelerations: Array,
    ) -> "CollocatedPhaseMotion":
        """Build the motion from its initial state, its duration and its node accelerations.

        `start_q` and `start_v` have the shape (coordinates,). `phase_duration` is in s.
        `node_accelerations` has the shape (intervals, nodes, coordinates).
        """
        interval_lengths = (
            jnp.asarray(phase_mesh.interval_length_fractions, phase_duration.dtype)[:, None]
            * phase_duration
        )
        rate_increments, position_increments = (
            jnp.einsum("n,ind->id", end_weights, node_accelerations)
            for end_weights in (END_WEIGHTS, DOUBLE_END_WEIGHTS)
        )
        accumulate_increments = lambda initial_boundary_value, interval_increments: jnp.concatenate(
            [
                initial_boundary_value[None],
                initial_boundary_value + jnp.cumsum(interval_increments, axis=0),
            ]
        )
        interval_boundary_v = accumulate_increments(start_v, interval_lengths * rate_increments)
        interval_boundary_q = accumulate_increments(
            start_q,
            interval_lengths * interval_boundary_v[:-1]
            + interval_lengths * interval_lengths * position_increments,
        )
        return cls(
            accumulate_increments(jnp.zeros(1), interval_lengths)[:, 0],
            interval_boundary_q,
            interval_boundary_v,
            node_accelerations,
        )

    def evaluate_states_in_intervals(self, location_in_interval: float) -> tuple[Array, Array]:
        """Return the coordinates and the rates at one relative location in every mesh interval.

        `location_in_interval` is in [0, 1]. The two arrays have the shape (intervals, coordinates).
        """
        interval_lengths = jnp.diff(self.interval_boundary_times)[:, None]
        rate_node_weights, position_node_weights = compute_integration_weights(location_in_interval)
        rate_increments, position_increments = (
            jnp.einsum("n,ind->id", node_weights, self.node_accelerations)
            for node_weights in (rate_node_weights, position_node_weights)
        )
        interval_start_v = self.interval_boundary_v[:-1]
        return self.interval_boundary_q[:-1] + interval_lengths * (
            location_in_interval * interval_start_v + interval_lengths * position_increments
        ), interval_start_v + interval_lengths * rate_increments

    def integrate_motion_to_time(
        self, time_in_phase: Scalar, compute_acceleration: FunctionOfCoordinatesAndRates
    ) -> tuple[Array, Array]:
        """Return the coordinates and the rates at a time within the phase.

        `time_in_phase` is the time since the start of the phase, in s. It is the end of an
        additional mesh interval, which begins at the last mesh boundary before that time. Newton's
        method solves for the node accelerations of the additional interval. The result is
        differentiable with respect to the motion, but not with respect to the time.
        """
        interval_index = find_mesh_intervals(self.interval_boundary_times, time_in_phase)
        interval_start_q = self.interval_boundary_q[interval_index]
        interval_start_v = self.interval_boundary_v[interval_index]
        partial_interval_length = lax.stop_gradient(
            time_in_phase - self.interval_boundary_times[interval_index]
        )

        def compute_dynamics_residual(flat_accelerations: Array) -> Array:
            node_accelerations = flat_accelerations.reshape(N_GAUSS_NODES, -1)
            node_q = interval_start_q + partial_interval_length * (
                GAUSS_NODES[:, None] * interval_start_v
                + partial_interval_length * (DOUBLE_INTEGRATION_MATRIX @ node_accelerations)
            )
            node_v = interval_start_v + partial_interval_length * (
                INTEGRATION_MATRIX @ node_accelerations
            )
            return (node_accelerations - jax.vmap(compute_acceleration)(node_q, node_v)).ravel()

        def refine_node_accelerations(flat_accelerations: Array, _: None) -> tuple[Array, None]:
            # The tangents of the last iteration are exact because the Jacobian has none.
            residual_jacobian = lax.stop_gradient(
                jax.jacfwd(compute_dynamics_residual)(flat_accelerations)
            )
            return flat_accelerations - jnp.linalg.solve(
                residual_jacobian, compute_dynamics_residual(flat_accelerations)
            ), None

        node_accelerations = lax.scan(
            refine_node_accelerations,
            lax.stop_gradient(self.node_accelerations[interval_index].ravel()),
            length=N_STATE_NEWTON_ITERATIONS,
        )[0].reshape(N_GAUSS_NODES, -1)
        return interval_start_q + partial_interval_length * (
            interval_start_v + partial_interval_length * (DOUBLE_END_WEIGHTS @ node_accelerations)
        ), interval_start_v + partial_interval_length * (END_WEIGHTS @ node_accelerations)


class _PiecewiseQuantityPolynomial(NamedTuple):
    """Quantity in one phase as a polynomial of time in each mesh interval.

    The coefficients carry no derivatives.
    """

    interval_boundary_times: Float[Array, " boundaries"]
    interval_coefficients: Float[Array, "intervals powers"]  # in powers of the location in [0, 1]

    @classmethod
    def interpolate_quantity(
        cls,
        phase_motion: CollocatedPhaseMotion,
        compute_quantity: FunctionOfCoordinatesAndRates,
    ) -> "_PiecewiseQuantityPolynomial":
        """Interpolate samples of the quantity in each mesh interval."""
        n_samples_per_interval = N_SAMPLES_PER_INTERVAL
        chebyshev_angles = (
            np.pi * (np.arange(n_samples_per_interval) + 0.5) / n_samples_per_interval
        )
        sample_locations = 0.5 - 0.5 * np.cos(chebyshev_angles)
        sampled_states = [
            phase_motion.evaluate_states_in_intervals(sample_location)
            for sample_location in sample_locations
        ]
        q, v = jax.tree.map(lambda *states: jnp.stack(states, 1), *sampled_states)
        sampled_values = jax.vmap(jax.vmap(compute_quantity))(q, v)
        interpolation_matrix = np.linalg.inv(
            sample_locations[:, None] ** np.arange(n_samples_per_interval)
        )
        return lax.stop_gradient(
            cls(phase_motion.interval_boundary_times, sampled_values @ interpolation_matrix.T)
        )

    def evaluate_polynomial_time_derivative(
        self, evaluation_times: Array, derivative_order: int
    ) -> Array:
        """Return the first or the second time derivative of an interpolated quantity at each time.

        `derivative_order` is 1 or 2. Times are in s since the start of the phase.
        """
        interval_indices = find_mesh_intervals(self.interval_boundary_times, evaluation_times)
        interval_lengths = jnp.diff(self.interval_boundary_times)[interval_indices]
        interval_lengths = jnp.where(interval_lengths > 0.0, interval_lengths, 1.0)
        locations_in_intervals = (
            evaluation_times - self.interval_boundary_times[interval_indices]
        ) / interval_lengths
        derivatives_by_location = jnp.zeros_like(evaluation_times)
        for power in range(self.interval_coefficients.shape[1] - 1, derivative_order - 1, -1):
            power_factor = power if derivative_order == 1 else power * (power - 1)
            derivatives_by_location = (
                derivatives_by_location * locations_in_intervals
                + power_factor * self.interval_coefficients[interval_indices, power]
            )
        return derivatives_by_location / interval_lengths**derivative_order

    @property
    def sample_times_in_phase(self) -> Array:
        """Return increasing sample times in s since the start of the phase.

        Each mesh interval contains several sample times. The start and the end of the phase are
        included.
        """
        locations_in_interval = np.linspace(
            0.0, 1.0, self.interval_coefficients.shape[1], endpoint=False
        )
        times_before_phase_end = (
            self.interval_boundary_times[:-1, None]
            + jnp.diff(self.interval_boundary_times)[:, None] * locations_in_interval
        )
        return jnp.append(times_before_phase_end.ravel(), self.interval_boundary_times[-1])


def find_quantity_extrema(
    phase_motion: CollocatedPhaseMotion,
    compute_acceleration: FunctionOfCoordinatesAndRates,
    compute_quantity: FunctionOfCoordinatesAndRates,
) -> PhaseExtrema:
    """Find the extrema of a quantity inside a phase.

    The values of the extrema have exact first derivatives.

    Args:
        phase_motion: motion during the phase.
        compute_acceleration: function that maps coordinates and rates to accelerations.
        compute_quantity: function that maps coordinates and rates to the quantity, a scalar.
    """
    quantity_polynomial = _PiecewiseQuantityPolynomial.interpolate_quantity(
        phase_motion, compute_quantity
    )
    phase_duration = quantity_polynomial.interval_boundary_times[-1]
    sample_times = quantity_polynomial.sample_times_in_phase
    sampled_second_rates = quantity_polynomial.evaluate_polynomial_time_derivative(sample_times, 2)
    last_sample_index = len(sampled_second_rates) - 1
    # An unused bracket has zero length and lies at the end of the phase.
    bracket_start_indices = jnp.nonzero(
        sampled_second_rates[:-1] * sampled_second_rates[1:] < 0.0,
        size=MAX_RATE_EXTREMA_PER_PHASE,
        fill_value=last_sample_index,
    )[0]
    is_rate_extremum = bracket_start_indices < last_sample_index
    bracket_indices = jnp.stack(
        [bracket_start_indices, jnp.minimum(bracket_start_indices + 1, last_sample_index)]
    )
    bracket_times = sample_times[bracket_indices]
    bracket_second_rates = sampled_second_rates[bracket_indices]
    rate_extremum_times = _bisect_zeros(
        lambda t: quantity_polynomial.evaluate_polynomial_time_derivative(t, 2),
        bracket_times,
        bracket_second_rates[0],
    )
    second_rate_slopes = (bracket_second_rates[1] - bracket_second_rates[0]) / jnp.where(
        is_rate_extremum, bracket_times[1] - bracket_times[0], 1.0
    )
    # The start and the end of the phase bound the extrema of R.
    rate_extremum_times = jnp.concatenate(
        [
            0.0 * phase_duration[None],
            jnp.where(is_rate_extremum, rate_extremum_times, phase_duration),
            phase_duration[None],
        ]
    )
    inverse_second_rate_slopes = jnp.where(
        is_rate_extremum, 1.0 / jnp.where(second_rate_slopes == 0.0, 1.0, second_rate_slopes), 0.0
    )
    inverse_second_rate_slopes = jnp.pad(inverse_second_rate_slopes, 1)

    def correct_extremum_times(
        compute_time_corrections: Callable[[QuantityTimeDerivatives], Array], extremum_times: Array
    ) -> tuple:
        """Return the corrected times, and the time derivatives of the quantity at the corrected
        times.

        `compute_time_corrections` maps the time derivatives of the quantity to the error of each
        time.
        """

        def evaluate_quantity_at_time(time_in_phase: Array) -> QuantityTimeDerivatives:
            state_at_time = phase_motion.integrate_motion_to_time(
                time_in_phase, compute_acceleration
            )
            return evaluate_quantity_time_derivatives(
                compute_quantity, compute_acceleration, *state_at_time
            )

        def correct_extremum_times_once(
            times_and_quantity_derivatives: tuple, _: None
        ) -> tuple[tuple, None]:
            corrected_times, quantity_derivatives = times_and_quantity_derivatives
            time_corrections = lax.stop_gradient(compute_time_corrections(quantity_derivatives))
            corrected_times = jnp.clip(corrected_times - time_corrections, 0.0, phase_duration)
            return (corrected_times, jax.vmap(evaluate_quantity_at_time)(corrected_times)), None

        return lax.scan(
            correct_extremum_times_once,
            (extremum_times, QuantityTimeDerivatives(*jnp.zeros((3, *extremum_times.shape)))),
            length=N_TIME_CORRECTIONS,
        )[0]

    rate_extremum_times, derivatives_at_rate_extrema = correct_extremum_times(
        lambda derivatives_at_times: (
            derivatives_at_times.second_time_derivative * inverse_second_rate_slopes
        ),
        rate_extremum_times,
    )
    rates = derivatives_at_rate_extrema.first_time_derivative
    has_extremum = (rates[:-1] * rates[1:] < 0.0) & (phase_duration > 0.0)
    extremum_times = _bisect_zeros(
        lambda t: quantity_polynomial.evaluate_polynomial_time_derivative(t, 1),
        jnp.stack([rate_extremum_times[:-1], rate_extremum_times[1:]]),
        rates[:-1],
    )
    compute_newton_correction = lambda derivatives_at_times: jnp.where(
        has_extremum,
        derivatives_at_times.first_time_derivative
        / jnp.where(
            derivatives_at_times.second_time_derivative == 0.0,
            1.0,
            derivatives_at_times.second_time_derivative,
        ),
        0.0,
    )
    extremum_times, derivatives_at_extrema = correct_extremum_times(
        compute_newton_correction, extremum_times
    )
    return PhaseExtrema(
        extremum_times=extremum_times,
        extremum_values=derivatives_at_extrema.quantity_value,
        is_quantity_maximum=has_extremum & (rates[:-1] > 0.0),
        is_quantity_minimum=has_extremum & (rates[:-1] < 0.0),
        rate_extremum_times=rate_extremum_times[1:-1],
        rate_extremum_values=rates[1:-1],
        is_rate_maximum=is_rate_extremum & (second_rate_slopes < 0.0) & (phase_duration > 0.0),
        end_values=jax.vmap(compute_quantity)(
            phase_motion.interval_boundary_q[np.array([0, -1])],
            phase_motion.interval_boundary_v[np.array([0, -1])],
        ),
    )


def evaluate_quantity_time_derivatives(
    compute_quantity: FunctionOfCoordinatesAndRates,
    compute_acceleration: FunctionOfCoordinatesAndRates,
    q: Array,
    v: Array,
) -> QuantityTimeDerivatives:
    """Return the value and the first two time derivatives of a quantity at the state (q, v)."""

    def append_time_derivative(function_of_state: Callable) -> Callable:
        return lambda q, v: jax.jvp(function_of_state, (q, v), (v, compute_acceleration(q, v)))

    (quantity_value, first_time_derivative), (_, second_time_derivative) = append_time_derivative(
        append_time_derivative(compute_quantity)
    )(q, v)
    return QuantityTimeDerivatives(quantity_value, first_time_derivative, second_time_derivative)


def _bisect_zeros(
    bracketed_function: Callable[[Array], Array],
    bracket_end_points: Float[Array, "2 brackets"],
    bracket_start_values: Float[Array, " brackets"],
) -> Array:
    """Return one root of `bracketed_function` in each bracket. The roots carry no derivatives.

    `bracket_start_values` contains the values of `bracketed_function` at the first end of each
    bracket. Without a sign change in a bracket, the result is an arbitrary point of the bracket.
    """
    start_signs = jnp.sign(bracket_start_values)

    def halve_brackets(bracket_end_points: Array, _: None) -> tuple[Array, None]:
        starts, ends = bracket_end_points
        middles = 0.5 * (starts + ends)
        is_root_later = jnp.sign(bracketed_function(middles)) == start_signs
        return jnp.stack(
            [jnp.where(is_root_later, middles, starts), jnp.where(is_root_later, ends, middles)]
        ), None

    final_end_points, _ = lax.scan(
        halve_brackets,
        lax.stop_gradient(bracket_end_points),
        length=N_BISECTIONS,
    )
    return jnp.mean(final_end_points, axis=0)
