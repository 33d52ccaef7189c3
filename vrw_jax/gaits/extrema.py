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
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import export, lax
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


class LocatedExtrema(NamedTuple):
    """Extrema of quantities F in one phase, and of their rates R, each in the order of time.

    Nothing here has derivatives. An element that is no extremum has false flags, and its time is
    meaningless. The last two fields describe additional intervals that end at `times` and then at
    `rate_times`: the accelerations at their Gauss nodes, and the inverse of the Jacobian by these
    accelerations of the equations of motion at the nodes.
    """

    times: Float[Array, "quantities extrema"]  # since the start of the phase, s
    is_maximum: Bool[Array, "quantities extrema"]
    is_minimum: Bool[Array, "quantities extrema"]
    rate_times: Float[Array, "quantities rate_extrema"]  # since the start of the phase, s
    is_rate_maximum: Bool[Array, "quantities rate_extrema"]
    node_accelerations: Float[Array, "quantities times unknowns"]
    inverse_jacobian: Float[Array, "quantities times unknowns unknowns"]


class ExtremumValues(NamedTuple):
    """Values of quantities at their extrema, of their rates R at its extrema, and at both ends.

    They have exact first derivatives, because F and R are stationary in time at their extrema, and
    because the ends move with the motion.
    """

    values: Float[Array, "quantities extrema"]
    rates: Float[Array, "quantities rate_extrema"]
    ends: Float[Array, "quantities 2"]  # F at the start and at the end of the phase


# Saved traces contain this named tuple.
export.register_namedtuple_serialization(LocatedExtrema, serialized_name="vrw_jax.LocatedExtrema")

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

    def begin_interval(
        self, time: Scalar, compute_acceleration: FunctionOfCoordinatesAndRates
    ) -> tuple[Array, Callable, Callable]:
        """Return an additional interval from the last mesh boundary before a time to this time.

        The result contains a guess of the accelerations at its Gauss nodes, flat, and two functions
        of these accelerations: the residual of the equations of motion, and the state (q, v) at the
        end. They are differentiable by the motion, but not by the time, s since the phase's start.
        """
        interval_index = find_mesh_intervals(self.interval_boundary_times, time)
        start_q, start_v = (
            x[interval_index] for x in (self.interval_boundary_q, self.interval_boundary_v)
        )
        h = lax.stop_gradient(time - self.interval_boundary_times[interval_index])

        def compute_residual(flat_accelerations: Array) -> Array:
            accelerations = flat_accelerations.reshape(N_GAUSS_NODES, -1)
            q = start_q + h * (
                GAUSS_NODES[:, None] * start_v + h * (DOUBLE_INTEGRATION_MATRIX @ accelerations)
            )
            v = start_v + h * (INTEGRATION_MATRIX @ accelerations)
            return (accelerations - jax.vmap(compute_acceleration)(q, v)).ravel()

        def compute_end(flat_accelerations: Array) -> tuple[Array, Array]:
            accelerations = flat_accelerations.reshape(N_GAUSS_NODES, -1)
            end_q = start_q + h * (start_v + h * (DOUBLE_END_WEIGHTS @ accelerations))
            return end_q, start_v + h * (END_WEIGHTS @ accelerations)

        guess = lax.stop_gradient(self.node_accelerations[interval_index].ravel())
        return guess, compute_residual, compute_end


class _PiecewiseQuantityPolynomial(NamedTuple):
    """Quantity in one phase as a polynomial of time in each mesh interval."""

    interval_boundary_times: Float[Array, " boundaries"]
    interval_coefficients: Float[Array, "intervals powers"]  # in powers of the location in [0, 1]

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


def _sample_quantities(
    motion: CollocatedPhaseMotion, compute_quantities: FunctionOfCoordinatesAndRates
) -> Float[Array, "quantities intervals powers"]:
    """Return the coefficients of the polynomials through samples of quantities in each interval."""
    angles = np.pi * (np.arange(N_SAMPLES_PER_INTERVAL) + 0.5) / N_SAMPLES_PER_INTERVAL
    locations = 0.5 - 0.5 * np.cos(angles)
    states = [motion.evaluate_states_in_intervals(location) for location in locations]
    q, v = jax.tree.map(lambda *states: jnp.stack(states, 1), *states)
    samples = jax.vmap(jax.vmap(compute_quantities))(q, v)
    interpolation = np.linalg.inv(locations[:, None] ** np.arange(N_SAMPLES_PER_INTERVAL))
    return jnp.einsum("isq,ps->qip", samples, interpolation)


def locate_extrema(
    motion: CollocatedPhaseMotion,
    compute_acceleration: FunctionOfCoordinatesAndRates,
    compute_quantities: FunctionOfCoordinatesAndRates,
) -> LocatedExtrema:
    """Locate the extrema of several quantities inside a phase.

    Args:
        motion: motion during the phase.
        compute_acceleration: function that maps coordinates and rates to accelerations.
        compute_quantities: function that maps them to the quantities, shape (quantities,).
    """
    phase_duration = motion.interval_boundary_times[-1]

    def append_time_derivative(function_of_state: Callable) -> Callable:
        return lambda q, v: jax.jvp(function_of_state, (q, v), (v, compute_acceleration(q, v)))

    compute_time_derivatives = append_time_derivative(append_time_derivative(compute_quantities))

    def evaluate_at(time: Array) -> tuple[Array, Array, Array, Array]:
        """Return the rates R and S of all quantities at a time, and the additional interval."""
        guess, compute_residual, compute_end = motion.begin_interval(time, compute_acceleration)

        def refine(accelerations: Array, _: None) -> tuple[Array, Array]:
            inverse_jacobian = jnp.linalg.inv(jax.jacfwd(compute_residual)(accelerations))
            residual = compute_residual(accelerations)
            return accelerations - inverse_jacobian @ residual, inverse_jacobian

        accelerations, inverse_jacobians = lax.scan(refine, guess, length=N_STATE_NEWTON_ITERATIONS)
        (_, rates), (_, second_rates) = compute_time_derivatives(*compute_end(accelerations))
        return rates, second_rates, accelerations, inverse_jacobians[-1]

    def locate(coefficients: Array, quantity_index: Array) -> LocatedExtrema:
        """Locate the extrema of one quantity with the given polynomials."""
        polynomial = _PiecewiseQuantityPolynomial(motion.interval_boundary_times, coefficients)
        rate_times, slopes = _locate_rate_extrema(polynomial)
        is_rate_extremum = slopes != 0.0
        # The start and the end of the phase bound the extrema of R.
        starts = jnp.concatenate([jnp.zeros(1), rate_times, phase_duration[None]])
        inverse_slopes = jnp.pad(jnp.where(is_rate_extremum, 1.0 / slopes, 0.0), 1)

        def locate_next(carry: Any, seeks_extrema: Any) -> tuple[Any, tuple]:
            """Locate the extrema of R, or of F between those of R in `carry`."""
            times, rates, has_extremum = carry
            bisected_times = _bisect_zeros(
                lambda t: polynomial.evaluate_polynomial_time_derivative(t, 1),
                jnp.stack([times[:-1], times[1:]]),
                rates[:-1],
            )
            times = jnp.where(seeks_extrema, jnp.append(bisected_times, phase_duration), times)
            has_extremum = (rates[:-1] * rates[1:] < 0.0) & (phase_duration > 0.0)

            def correct(times_and_interval: tuple, _: None) -> tuple[tuple, None]:
                times, (rates, second_rates, *_) = times_and_interval
                newton_correction = jnp.where(
                    jnp.append(has_extremum, False),
                    rates / jnp.where(second_rates == 0.0, 1.0, second_rates),
                    0.0,
                )
                correction = jnp.where(
                    seeks_extrema, newton_correction, second_rates * inverse_slopes
                )
                times = jnp.clip(times - correction, 0.0, phase_duration)
                rates, second_rates, *interval = jax.vmap(evaluate_at)(times)
                quantity_rates = rates[:, quantity_index], second_rates[:, quantity_index]
                return (times, (*quantity_rates, *interval)), None

            n_unknowns = motion.node_accelerations[0].size
            zeros = jnp.zeros_like(times)
            no_interval = (
                jnp.zeros((len(times), n_unknowns)),
                jnp.zeros((len(times), n_unknowns, n_unknowns)),
            )
            (times, (rates, _, *interval)), _ = lax.scan(
                correct, (times, (zeros, zeros, *no_interval)), length=N_TIME_CORRECTIONS
            )
            return (times, rates, has_extremum), (times, rates, interval)

        no_extremum = jnp.zeros(len(starts) - 1, bool)
        (times, _, has_extremum), (all_times, all_rates, intervals) = lax.scan(
            locate_next, (starts, jnp.zeros_like(starts), no_extremum), np.array([False, True])
        )
        is_rising = all_rates[0, :-1] > 0.0
        join = lambda x: jnp.concatenate([x[1, :-1], x[0, 1:-1]])
        return LocatedExtrema(
            times[:-1],
            has_extremum & is_rising,
            has_extremum & ~is_rising,
            all_times[0, 1:-1],
            is_rate_extremum & (slopes < 0.0) & (phase_duration > 0.0),
            *map(join, intervals),
        )

    coefficients = _sample_quantities(motion, compute_quantities)
    return jax.vmap(locate)(coefficients, jnp.arange(len(coefficients)))


def _locate_rate_extrema(polynomial: _PiecewiseQuantityPolynomial) -> tuple[Array, Array]:
    """Return where the second time derivative of the polynomials is zero, and its slope there.

    Unused elements lie at the end of the phase, and their slope is zero.
    """
    times = polynomial.sample_times_in_phase
    second_rates = polynomial.evaluate_polynomial_time_derivative(times, 2)
    last = len(times) - 1
    starts = jnp.nonzero(
        second_rates[:-1] * second_rates[1:] < 0.0,
        size=MAX_RATE_EXTREMA_PER_PHASE,
        fill_value=last,
    )[0]
    brackets = jnp.stack([starts, jnp.minimum(starts + 1, last)])
    is_used = starts < last
    (first_rates, last_rates), (first_times, last_times) = second_rates[brackets], times[brackets]
    roots = _bisect_zeros(
        lambda t: polynomial.evaluate_polynomial_time_derivative(t, 2),
        times[brackets],
        first_rates,
    )
    slopes = (last_rates - first_rates) / jnp.where(is_used, last_times - first_times, 1.0)
    return jnp.where(is_used, roots, times[-1]), jnp.where(is_used, slopes, 0.0)


def evaluate_extrema(
    motion: CollocatedPhaseMotion,
    compute_acceleration: FunctionOfCoordinatesAndRates,
    compute_quantities: FunctionOfCoordinatesAndRates,
    extrema: LocatedExtrema,
) -> ExtremumValues:
    """Return the values of several quantities at their located extrema, with derivatives.

    The arguments are those of `locate_extrema`. One Newton iteration with the constant Jacobian of
    `extrema` gives the state at each extremum its derivatives.
    """

    def evaluate_at(time: Array, accelerations: Array, inverse_jacobian: Array) -> tuple:
        _, compute_residual, compute_end = motion.begin_interval(time, compute_acceleration)
        q, v = compute_end(accelerations - inverse_jacobian @ compute_residual(accelerations))
        return jax.jvp(compute_quantities, (q, v), (v, compute_acceleration(q, v)))

    times = jnp.concatenate([extrema.times, extrema.rate_times], 1)
    values, rates = jax.vmap(jax.vmap(evaluate_at))(
        times, extrema.node_accelerations, extrema.inverse_jacobian
    )
    # each quantity at its own times
    values, rates = (jnp.einsum("qtq->qt", x) for x in (values, rates))
    n_extrema = extrema.times.shape[1]
    end_indices = np.array([0, -1])
    ends = jax.vmap(compute_quantities)(
        motion.interval_boundary_q[end_indices], motion.interval_boundary_v[end_indices]
    )
    return ExtremumValues(values[:, :n_extrema], rates[:, n_extrema:], ends.T)


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
