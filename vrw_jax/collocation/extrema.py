"""Smooth extrema of a quantity within a phase, located on its collocated motion.

Let F be a quantity of the state, and R and S its first and second time derivative. The extrema of R
are zeros of S. Between two extrema R is monotone, so each change of sign of R is one extremum of F.
Zeros are first located on a polynomial of F in each mesh interval. The state at a zero is then the
end of one more interval of Gauss nodes, at which F, R and S are evaluated and the time is
corrected. Extrema are therefore as accurate as the cycle.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from vrw_jax.collocation.gauss import (
    DOUBLE_END_WEIGHTS,
    DOUBLE_INTEGRATION_MATRIX,
    END_WEIGHTS,
    GAUSS_NODES,
    INTEGRATION_MATRIX,
    N_GAUSS_NODES,
    PhaseMesh,
    integration_weights,
)
from vrw_jax.numerics import Scalar


@dataclass(frozen=True)
class ExtremumOptions:
    """Options of the search for extrema in a phase."""

    n_samples: int = 8
    """Samples of F in each mesh interval, chosen because their polynomial is then more accurate
    than the motion between two nodes."""
    max_rate_extrema: int = 6
    """Largest number of extrema of R in a phase, chosen because phases of stiff, lightly damped
    legs have at most five."""
    n_bracket_zero_iterations: int = 12
    """Iterations on the polynomials, chosen because the error is then that of the polynomials."""
    n_time_corrections: int = 3
    """Corrections of the time of an extremum, chosen because the error of 1e-4 of a mesh interval
    shrinks by at least a factor of a hundred in each."""
    n_newton_iterations: int = 3
    """Newton iterations for a state, chosen because the polynomial is accurate to 1e-5 and
    convergence is quadratic."""


EXTREMUM_OPTIONS = ExtremumOptions()


class QuantityRates(NamedTuple):
    """Quantity at a state, with its first and second time derivative."""

    value: Scalar
    rate: Scalar
    second_rate: Scalar


class PhaseExtrema(NamedTuple):
    """Extrema of a quantity in one phase in the order of time, and maxima of its rate.

    An array element without an extremum has false flags, and its other numbers are meaningless.
    Times have no derivatives. First derivatives of values and rates need no derivatives of times,
    because values and rates are stationary in time.
    """

    time: Float[Array, " pieces"]  # since the start of the phase, s
    value: Float[Array, " pieces"]
    is_maximum: Bool[Array, " pieces"]
    is_minimum: Bool[Array, " pieces"]
    rate_time: Float[Array, " rates"]  # of an extremum of the rate, s
    rate: Float[Array, " rates"]  # at that time
    is_maximum_of_rate: Bool[Array, " rates"]


StateFunction = Callable[[Array, Array], Array]
"""Function of coordinates and rates, each of shape (coordinates,)."""


class CollocatedPhase(NamedTuple):
    """Motion of one phase as polynomials, one for each mesh interval."""

    times: Float[Array, " boundaries"]  # of the interval boundaries, s
    q: Float[Array, "boundaries coordinates"]
    v: Float[Array, "boundaries coordinates"]
    accelerations: Float[Array, "intervals nodes coordinates"]

    @classmethod
    def from_nodes(
        cls, mesh: PhaseMesh, q: Array, v: Array, duration: Scalar, accelerations: Array
    ) -> "CollocatedPhase":
        """Return the motion from the start of a phase, its duration and its accelerations."""
        interval_lengths = jnp.asarray(mesh.interval_fractions, duration.dtype)[:, None] * duration
        rate_steps, position_steps = (
            jnp.einsum("n,ind->id", end_weights, accelerations)
            for end_weights in (END_WEIGHTS, DOUBLE_END_WEIGHTS)
        )
        accumulate_from_start = lambda start, interval_changes: jnp.concatenate(
            [start[None], start + jnp.cumsum(interval_changes, axis=0)]
        )
        rates = accumulate_from_start(v, interval_lengths * rate_steps)
        positions = accumulate_from_start(
            q, interval_lengths * rates[:-1] + interval_lengths * interval_lengths * position_steps
        )
        return cls(
            accumulate_from_start(jnp.zeros(1), interval_lengths)[:, 0],
            positions,
            rates,
            accelerations,
        )

    def find_interval_index(self, time: Scalar) -> Array:
        """Return the index of the mesh interval that contains a time."""
        last_index = len(self.times) - 2
        return jnp.clip(jnp.searchsorted(self.times, time, side="right") - 1, 0, last_index)

    def evaluate_states(self, location: float) -> tuple[Array, Array]:
        """Return coordinates and rates at one location of every interval, in [0, 1]."""
        interval_lengths = jnp.diff(self.times)[:, None]
        rate_weights, position_weights = integration_weights(location)
        rate_steps, position_steps = (
            jnp.einsum("n,ind->id", node_weights, self.accelerations)
            for node_weights in (rate_weights, position_weights)
        )
        q, v = self.q[:-1], self.v[:-1]
        return q + interval_lengths * (
            location * v + interval_lengths * position_steps
        ), v + interval_lengths * rate_steps

    def integrate_to_time(
        self, time: Scalar, acceleration_of: StateFunction, n_iterations: int
    ) -> tuple[Array, Array]:
        """Return coordinates and rates at a time, which is the end of one more interval.

        The additional interval begins at the mesh boundary before the time. Newton's method solves
        for its accelerations. They have derivatives with respect to the motion but not to the time.
        """
        interval_index = self.find_interval_index(time)
        start_time, q, v = (
            self.times[interval_index],
            self.q[interval_index],
            self.v[interval_index],
        )
        partial_length = lax.stop_gradient(time - start_time)

        def residual(accelerations: Array) -> Array:
            node_accelerations = accelerations.reshape(N_GAUSS_NODES, -1)
            node_q = q + partial_length * (
                GAUSS_NODES[:, None] * v
                + partial_length * (DOUBLE_INTEGRATION_MATRIX @ node_accelerations)
            )
            node_v = v + partial_length * (INTEGRATION_MATRIX @ node_accelerations)
            return (node_accelerations - jax.vmap(acceleration_of)(node_q, node_v)).ravel()

        def refine(accelerations: Array, _: None) -> tuple[Array, None]:
            # The tangents of the last iteration are exact because the Jacobian has none.
            jacobian = lax.stop_gradient(jax.jacfwd(residual)(accelerations))
            return accelerations - jnp.linalg.solve(jacobian, residual(accelerations)), None

        guessed_accelerations = lax.stop_gradient(self.accelerations[interval_index].ravel())
        node_accelerations = lax.scan(refine, guessed_accelerations, length=n_iterations)[
            0
        ].reshape(N_GAUSS_NODES, -1)
        return q + partial_length * (
            v + partial_length * (DOUBLE_END_WEIGHTS @ node_accelerations)
        ), v + partial_length * (END_WEIGHTS @ node_accelerations)


class _PiecewisePolynomial(NamedTuple):
    """Quantity as a polynomial in each mesh interval, without derivatives."""

    times: Float[Array, " boundaries"]
    coefficients: Float[Array, "intervals powers"]  # over the location in the interval

    @classmethod
    def from_motion(
        cls, motion: CollocatedPhase, quantity_of: StateFunction, n_samples: int
    ) -> "_PiecewisePolynomial":
        """Return the polynomials through `n_samples` values in each interval."""
        sample_locations = _chebyshev_nodes(n_samples)
        sampled_states = [motion.evaluate_states(location) for location in sample_locations]
        q, v = (jnp.stack(state_parts, 1) for state_parts in zip(*sampled_states, strict=True))
        sampled_values = jax.vmap(jax.vmap(quantity_of))(q, v)
        interpolation_matrix = np.linalg.inv(sample_locations[:, None] ** np.arange(n_samples))
        return lax.stop_gradient(cls(motion.times, sampled_values @ interpolation_matrix.T))

    def evaluate_rate(self, evaluation_times: Array, derivative_order: int) -> Array:
        """Return the time derivative of first or second order at many times."""
        last_index = len(self.times) - 2
        interval_indices = jnp.clip(
            jnp.searchsorted(self.times, evaluation_times, side="right") - 1, 0, last_index
        )
        interval_lengths = jnp.diff(self.times)[interval_indices]
        interval_lengths = jnp.where(interval_lengths > 0.0, interval_lengths, 1.0)
        interval_locations = (evaluation_times - self.times[interval_indices]) / interval_lengths
        scaled_rates = jnp.zeros_like(evaluation_times)
        for power in range(self.coefficients.shape[1] - 1, derivative_order - 1, -1):
            factor = power if derivative_order == 1 else power * (power - 1)
            scaled_rates = (
                scaled_rates * interval_locations
                + factor * self.coefficients[interval_indices, power]
            )
        return scaled_rates / interval_lengths**derivative_order

    @property
    def sample_times(self) -> Array:
        """Return the times of many samples in order, both ends of the phase included."""
        sample_fractions = np.linspace(0.0, 1.0, self.coefficients.shape[1], endpoint=False)
        inner_times = self.times[:-1, None] + jnp.diff(self.times)[:, None] * sample_fractions
        return jnp.append(inner_times.ravel(), self.times[-1])


def _chebyshev_nodes(n: int) -> np.ndarray:
    """Return the Chebyshev nodes on [0, 1]."""
    return 0.5 - 0.5 * np.cos(np.pi * (np.arange(n) + 0.5) / n)


def find_extrema(
    collocated_phase: CollocatedPhase,
    acceleration_of: StateFunction,
    quantity_of: StateFunction,
    extremum_options: ExtremumOptions = EXTREMUM_OPTIONS,
) -> PhaseExtrema:
    """Return the extrema of a quantity inside a phase, with first derivatives.

    Args:
        collocated_phase: the collocated motion.
        acceleration_of: accelerations, by the equations of motion.
        quantity_of: the quantity.
        extremum_options: options of the search.
    """
    sampled_quantity = _PiecewisePolynomial.from_motion(
        collocated_phase, quantity_of, extremum_options.n_samples
    )
    duration, sample_times = sampled_quantity.times[-1], sampled_quantity.sample_times
    sampled_second_rates = sampled_quantity.evaluate_rate(sample_times, 2)
    last_index = len(sampled_second_rates) - 1
    # Without another zero the bracket is the end of the phase.
    has_zero = sampled_second_rates[:-1] * sampled_second_rates[1:] < 0.0
    lower_indices = jnp.nonzero(
        has_zero, size=extremum_options.max_rate_extrema, fill_value=last_index
    )[0]
    upper_indices = jnp.minimum(lower_indices + 1, last_index)
    is_rate_extremum = lower_indices < last_index
    rate_extremum_times = _find_bracketed_zeros(
        lambda t: sampled_quantity.evaluate_rate(t, 2),
        (sample_times[lower_indices], sample_times[upper_indices]),
        (sampled_second_rates[lower_indices], sampled_second_rates[upper_indices]),
        extremum_options.n_bracket_zero_iterations,
    )
    bracket_length = sample_times[upper_indices] - sample_times[lower_indices]
    second_rate_slopes = (
        sampled_second_rates[upper_indices] - sampled_second_rates[lower_indices]
    ) / jnp.where(is_rate_extremum, bracket_length, 1.0)
    phase_ends = jnp.stack([0.0 * duration, duration])
    rate_extremum_times = jnp.concatenate(
        [phase_ends[:1], jnp.where(is_rate_extremum, rate_extremum_times, duration), phase_ends[1:]]
    )
    inner_slice = slice(1, -1)
    inverse_slopes = jnp.where(
        is_rate_extremum, 1.0 / jnp.where(second_rate_slopes == 0.0, 1.0, second_rate_slopes), 0.0
    )
    inverse_slopes = jnp.pad(inverse_slopes, 1)

    def correct_times(
        rates_to_time: Callable[[QuantityRates], Array], extremum_times: Array
    ) -> tuple:
        """Return corrected times, and the quantity with its rates there."""

        def evaluate(time: Array) -> QuantityRates:
            n_iterations = extremum_options.n_newton_iterations
            state_at_time = collocated_phase.integrate_to_time(time, acceleration_of, n_iterations)
            return evaluate_quantity_rates(quantity_of, acceleration_of, *state_at_time)

        def iterate(loop_carry: tuple, _: None) -> tuple[tuple, None]:
            corrected_times, quantity_rates = loop_carry
            time_corrections = lax.stop_gradient(rates_to_time(quantity_rates))
            corrected_times = jnp.clip(corrected_times - time_corrections, 0.0, duration)
            return (corrected_times, jax.vmap(evaluate)(corrected_times)), None

        zero_rates = jnp.zeros_like(extremum_times)
        loop_carry = extremum_times, QuantityRates(zero_rates, zero_rates, zero_rates)
        return lax.scan(iterate, loop_carry, length=extremum_options.n_time_corrections)[0]

    rate_extremum_times, quantity_rates = correct_times(
        lambda quantity_rates: quantity_rates.second_rate * inverse_slopes, rate_extremum_times
    )
    rate_before, rate_after = quantity_rates.rate[:-1], quantity_rates.rate[1:]
    has_extremum = (rate_before * rate_after < 0.0) & (duration > 0.0)
    extremum_times = _find_bracketed_zeros(
        lambda t: sampled_quantity.evaluate_rate(t, 1),
        (rate_extremum_times[:-1], rate_extremum_times[1:]),
        (rate_before, rate_after),
        extremum_options.n_bracket_zero_iterations,
    )
    newton_correction = lambda quantity_rates: jnp.where(
        has_extremum,
        quantity_rates.rate
        / jnp.where(quantity_rates.second_rate == 0.0, 1.0, quantity_rates.second_rate),
        0.0,
    )
    extremum_times, rates_at_extrema = correct_times(newton_correction, extremum_times)
    return PhaseExtrema(
        time=extremum_times,
        value=rates_at_extrema.value,
        is_maximum=has_extremum & (rate_before > 0.0),
        is_minimum=has_extremum & (rate_before < 0.0),
        rate_time=rate_extremum_times[inner_slice],
        rate=quantity_rates.rate[inner_slice],
        is_maximum_of_rate=is_rate_extremum & (second_rate_slopes < 0.0) & (duration > 0.0),
    )


def evaluate_quantity_rates(
    quantity_of: StateFunction, acceleration_of: StateFunction, q: Array, v: Array
) -> QuantityRates:
    """Return a quantity and its first and second time derivative at a state."""

    def with_rate(function: Callable, q: Array, v: Array) -> tuple:
        return jax.jvp(function, (q, v), (v, acceleration_of(q, v)))

    value_and_rate = lambda q, v: with_rate(quantity_of, q, v)
    (value, rate), (_, second_rate) = with_rate(value_and_rate, q, v)
    return QuantityRates(value, rate, second_rate)


def _find_bracketed_zeros(
    function: Callable[[Array], Array],
    bracket: tuple[Array, Array],
    bracket_values: tuple[Array, Array],
    n_iterations: int,
) -> Array:
    """Return a zero of `function` in each bracket, without derivative.

    `bracket_values` are the values of the function at the ends of the brackets. If both values have
    one sign, the result is the start of the bracket. The method is Chandrupatla's (Adv. Eng. Softw.
    28, 145-149, 1997).
    """
    bracket_starts, bracket_ends, start_values, end_values = lax.stop_gradient(
        (*bracket, *bracket_values)
    )
    has_zero = start_values * end_values < 0.0
    replace_zero_by_one = lambda x: jnp.where(x == 0.0, 1.0, x)

    def iterate(loop_carry: tuple, _: None) -> tuple[tuple, None]:
        node_accelerations, fa, b, fb, c, fc, fraction = loop_carry
        x = node_accelerations + fraction * (b - node_accelerations)
        fx = function(x)
        is_same_side = jnp.sign(fx) == jnp.sign(fa)
        c, fc = jnp.where(is_same_side, node_accelerations, b), jnp.where(is_same_side, fa, fb)
        b, fb = jnp.where(is_same_side, b, node_accelerations), jnp.where(is_same_side, fb, fa)
        node_accelerations, fa = x, fx
        xi = (node_accelerations - b) / replace_zero_by_one(c - b)
        phi = (fa - fb) / replace_zero_by_one(fc - fb)
        is_smooth = (phi * phi < xi) & ((1.0 - phi) * (1.0 - phi) < 1.0 - xi)
        inverse_quadratic = fa / replace_zero_by_one(fb - fa) * fc / replace_zero_by_one(
            fb - fc
        ) + (c - node_accelerations) / replace_zero_by_one(
            b - node_accelerations
        ) * fa / replace_zero_by_one(fc - fa) * fb / replace_zero_by_one(fc - fb)
        fraction = jnp.where(is_smooth, jnp.clip(inverse_quadratic, 0.0, 1.0), 0.5)
        fraction = jnp.where(fa == 0.0, 0.0, fraction)
        return (node_accelerations, fa, b, fb, c, fc, fraction), None

    loop_carry = (
        bracket_ends,
        end_values,
        bracket_starts,
        start_values,
        bracket_starts,
        start_values,
        jnp.full_like(bracket_starts, 0.5),
    )
    node_accelerations, fa, b, fb, *_ = lax.scan(iterate, loop_carry, None, length=n_iterations)[0]
    return jnp.where(
        has_zero, jnp.where(jnp.abs(fa) <= jnp.abs(fb), node_accelerations, b), bracket_starts
    )
