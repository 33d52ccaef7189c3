"""Smooth extrema of a quantity within a phase, located on its collocated motion.

Let F be a quantity of the state, and R and S its first and second time derivative. The extrema of R
are zeros of S. Between two of them R is monotone, so each change of its sign is one extremum of F.
Zeros are first located on a polynomial of F in each mesh interval. The state there is then the end
of one more interval of Gauss nodes, at which F, R and S are evaluated and the time is corrected.
Extrema are therefore as accurate as the cycle.
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
    """Numbers of the search for extrema in a phase."""

    n_samples: int = 8
    """Samples of F in each mesh interval, chosen because their polynomial is then more accurate
    than the motion between two nodes."""
    max_rate_extrema: int = 6
    """Largest number of extrema of R in a phase, chosen because phases of stiff, lightly damped
    legs have at most five."""
    n_bracket_iterations: int = 12
    """Iterations on the polynomials, chosen because the error is then that of the polynomials."""
    n_corrections: int = 3
    """Corrections of the time of an extremum, chosen because the error of 1e-4 of a mesh interval
    shrinks by at least a factor of a hundred in each."""
    n_newton_iterations: int = 3
    """Newton iterations for a state, chosen because the polynomial is accurate to 1e-5 and
    convergence is quadratic."""


EXTREMUM_OPTIONS = ExtremumOptions()


class QuantityRates(NamedTuple):
    """A quantity at a state, with its first and second time derivative."""

    value: Scalar
    rate: Scalar
    second_rate: Scalar


class PhaseExtrema(NamedTuple):
    """Extrema of a quantity in one phase in the order of time, and maxima of its rate.

    Entries without an extremum have false flags, and other numbers that are meaningless. Times have
    no derivatives. First derivatives of values and rates need none, because both are stationary in
    time.
    """

    time: Float[Array, " pieces"]  # since the start of the phase, s
    value: Float[Array, " pieces"]
    is_maximum: Bool[Array, " pieces"]
    is_minimum: Bool[Array, " pieces"]
    rate_time: Float[Array, " rates"]  # of an extremum of the rate, s
    rate: Float[Array, " rates"]  # at that time
    is_rate_maximum: Bool[Array, " rates"]


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
        h = jnp.asarray(mesh.interval_fractions, duration.dtype)[:, None] * duration
        rate_steps, position_steps = (
            jnp.einsum("n,ind->id", weights, accelerations)
            for weights in (END_WEIGHTS, DOUBLE_END_WEIGHTS)
        )
        accumulate = lambda start, steps: jnp.concatenate(
            [start[None], start + jnp.cumsum(steps, axis=0)]
        )
        rates = accumulate(v, h * rate_steps)
        positions = accumulate(q, h * rates[:-1] + h * h * position_steps)
        return cls(accumulate(jnp.zeros(1), h)[:, 0], positions, rates, accelerations)

    def interval_at(self, time: Scalar) -> Array:
        """Return the index of the mesh interval that contains a time."""
        last = len(self.times) - 2
        return jnp.clip(jnp.searchsorted(self.times, time, side="right") - 1, 0, last)

    def states_at(self, location: float) -> tuple[Array, Array]:
        """Return coordinates and rates at one location of every interval, in [0, 1]."""
        h = jnp.diff(self.times)[:, None]
        rate_weights, position_weights = integration_weights(location)
        rate_steps, position_steps = (
            jnp.einsum("n,ind->id", weights, self.accelerations)
            for weights in (rate_weights, position_weights)
        )
        q, v = self.q[:-1], self.v[:-1]
        return q + h * (location * v + h * position_steps), v + h * rate_steps

    def integrate_to(
        self, time: Scalar, acceleration_of: StateFunction, n_iterations: int
    ) -> tuple[Array, Array]:
        """Return coordinates and rates at a time, which is the end of one more interval.

        That interval begins at the mesh boundary before the time. Newton's method solves for its
        accelerations. They have derivatives with respect to the motion but not to the time.
        """
        index = self.interval_at(time)
        start_time, q, v = self.times[index], self.q[index], self.v[index]
        h = lax.stop_gradient(time - start_time)

        def residual(accelerations: Array) -> Array:
            a = accelerations.reshape(N_GAUSS_NODES, -1)
            node_q = q + h * (GAUSS_NODES[:, None] * v + h * (DOUBLE_INTEGRATION_MATRIX @ a))
            node_v = v + h * (INTEGRATION_MATRIX @ a)
            return (a - jax.vmap(acceleration_of)(node_q, node_v)).ravel()

        def refine(accelerations: Array, _: None) -> tuple[Array, None]:
            # The tangents of the last iteration are exact because the Jacobian has none.
            jacobian = lax.stop_gradient(jax.jacfwd(residual)(accelerations))
            return accelerations - jnp.linalg.solve(jacobian, residual(accelerations)), None

        guess = lax.stop_gradient(self.accelerations[index].ravel())
        a = lax.scan(refine, guess, length=n_iterations)[0].reshape(N_GAUSS_NODES, -1)
        return q + h * (v + h * (DOUBLE_END_WEIGHTS @ a)), v + h * (END_WEIGHTS @ a)


class _SampledQuantity(NamedTuple):
    """A quantity as a polynomial in each mesh interval, and its rates, without derivatives."""

    times: Float[Array, " boundaries"]
    coefficients: Float[Array, "intervals powers"]  # over the location in the interval

    @classmethod
    def from_motion(
        cls, motion: CollocatedPhase, quantity_of: StateFunction, n_samples: int
    ) -> "_SampledQuantity":
        """Return the polynomials through `n_samples` values in each interval."""
        locations = _chebyshev_nodes(n_samples)
        states = [motion.states_at(location) for location in locations]
        q, v = (jnp.stack(parts, 1) for parts in zip(*states, strict=True))
        values = jax.vmap(jax.vmap(quantity_of))(q, v)
        matrix = np.linalg.inv(locations[:, None] ** np.arange(n_samples))
        return lax.stop_gradient(cls(motion.times, values @ matrix.T))

    def rate_at(self, times: Array, order: int) -> Array:
        """Return the time derivative of first or second order at many times."""
        last = len(self.times) - 2
        index = jnp.clip(jnp.searchsorted(self.times, times, side="right") - 1, 0, last)
        h = jnp.diff(self.times)[index]
        h = jnp.where(h > 0.0, h, 1.0)
        location = (times - self.times[index]) / h
        value = jnp.zeros_like(times)
        for power in range(self.coefficients.shape[1] - 1, order - 1, -1):
            factor = power if order == 1 else power * (power - 1)
            value = value * location + factor * self.coefficients[index, power]
        return value / h**order

    @property
    def sample_times(self) -> Array:
        """Return the times of many samples in order, both ends of the phase included."""
        fractions = np.linspace(0.0, 1.0, self.coefficients.shape[1], endpoint=False)
        inner = self.times[:-1, None] + jnp.diff(self.times)[:, None] * fractions
        return jnp.append(inner.ravel(), self.times[-1])


def _chebyshev_nodes(n: int) -> np.ndarray:
    """Return the Chebyshev nodes on [0, 1]."""
    return 0.5 - 0.5 * np.cos(np.pi * (np.arange(n) + 0.5) / n)


def find_extrema(
    motion: CollocatedPhase,
    acceleration_of: StateFunction,
    quantity_of: StateFunction,
    options: ExtremumOptions = EXTREMUM_OPTIONS,
) -> PhaseExtrema:
    """Return the extrema of a quantity inside a phase, with first derivatives.

    Args:
        motion: the collocated motion.
        acceleration_of: accelerations, by the equations of motion.
        quantity_of: the quantity.
        options: numbers of the search.
    """
    sampled = _SampledQuantity.from_motion(motion, quantity_of, options.n_samples)
    duration, sample_times = sampled.times[-1], sampled.sample_times
    samples = sampled.rate_at(sample_times, 2)
    last = len(samples) - 1
    # Without another zero the bracket is the end of the phase.
    has_zero = samples[:-1] * samples[1:] < 0.0
    lower = jnp.nonzero(has_zero, size=options.max_rate_extrema, fill_value=last)[0]
    upper = jnp.minimum(lower + 1, last)
    is_rate_extremum = lower < last
    times = _find_zeros(
        lambda t: sampled.rate_at(t, 2),
        (sample_times[lower], sample_times[upper]),
        (samples[lower], samples[upper]),
        options.n_bracket_iterations,
    )
    bracket_length = sample_times[upper] - sample_times[lower]
    slopes = (samples[upper] - samples[lower]) / jnp.where(is_rate_extremum, bracket_length, 1.0)
    ends = jnp.stack([0.0 * duration, duration])
    times = jnp.concatenate([ends[:1], jnp.where(is_rate_extremum, times, duration), ends[1:]])
    inner = slice(1, -1)
    inverse_slopes = jnp.where(is_rate_extremum, 1.0 / jnp.where(slopes == 0.0, 1.0, slopes), 0.0)
    inverse_slopes = jnp.pad(inverse_slopes, 1)

    def correct(rates_to_time: Callable[[QuantityRates], Array], times: Array) -> tuple:
        """Return corrected times, and the quantity with its rates there."""

        def evaluate(time: Array) -> QuantityRates:
            n_iterations = options.n_newton_iterations
            state = motion.integrate_to(time, acceleration_of, n_iterations)
            return differentiate_twice(quantity_of, acceleration_of, *state)

        def iterate(carry: tuple, _: None) -> tuple[tuple, None]:
            times, rates = carry
            correction = lax.stop_gradient(rates_to_time(rates))
            times = jnp.clip(times - correction, 0.0, duration)
            return (times, jax.vmap(evaluate)(times)), None

        zeros = jnp.zeros_like(times)
        carry = times, QuantityRates(zeros, zeros, zeros)
        return lax.scan(iterate, carry, length=options.n_corrections)[0]

    times, rates = correct(lambda rates: rates.second_rate * inverse_slopes, times)
    before, after = rates.rate[:-1], rates.rate[1:]
    has_extremum = (before * after < 0.0) & (duration > 0.0)
    extremum_times = _find_zeros(
        lambda t: sampled.rate_at(t, 1),
        (times[:-1], times[1:]),
        (before, after),
        options.n_bracket_iterations,
    )
    newton_correction = lambda rates: jnp.where(
        has_extremum, rates.rate / jnp.where(rates.second_rate == 0.0, 1.0, rates.second_rate), 0.0
    )
    extremum_times, at_extrema = correct(newton_correction, extremum_times)
    return PhaseExtrema(
        time=extremum_times,
        value=at_extrema.value,
        is_maximum=has_extremum & (before > 0.0),
        is_minimum=has_extremum & (before < 0.0),
        rate_time=times[inner],
        rate=rates.rate[inner],
        is_rate_maximum=is_rate_extremum & (slopes < 0.0) & (duration > 0.0),
    )


def differentiate_twice(
    quantity_of: StateFunction, acceleration_of: StateFunction, q: Array, v: Array
) -> QuantityRates:
    """Return a quantity and its first and second time derivative at a state."""

    def with_rate(function: Callable, q: Array, v: Array) -> tuple:
        return jax.jvp(function, (q, v), (v, acceleration_of(q, v)))

    value_and_rate = lambda q, v: with_rate(quantity_of, q, v)
    (value, rate), (_, second_rate) = with_rate(value_and_rate, q, v)
    return QuantityRates(value, rate, second_rate)


def _find_zeros(
    function: Callable[[Array], Array],
    bracket: tuple[Array, Array],
    values: tuple[Array, Array],
    n_iterations: int,
) -> Array:
    """Return a zero of `function` in each bracket, without derivative.

    `values` are those at the ends of the brackets. If they have one sign, the result is the start.
    The method is Chandrupatla's (Adv. Eng. Softw. 28, 145-149, 1997).
    """
    start, end, at_start, at_end = lax.stop_gradient((*bracket, *values))
    has_zero = at_start * at_end < 0.0
    safe = lambda x: jnp.where(x == 0.0, 1.0, x)

    def iterate(carry: tuple, _: None) -> tuple[tuple, None]:
        a, fa, b, fb, c, fc, fraction = carry
        x = a + fraction * (b - a)
        fx = function(x)
        is_same_side = jnp.sign(fx) == jnp.sign(fa)
        c, fc = jnp.where(is_same_side, a, b), jnp.where(is_same_side, fa, fb)
        b, fb = jnp.where(is_same_side, b, a), jnp.where(is_same_side, fb, fa)
        a, fa = x, fx
        xi = (a - b) / safe(c - b)
        phi = (fa - fb) / safe(fc - fb)
        is_smooth = (phi * phi < xi) & ((1.0 - phi) * (1.0 - phi) < 1.0 - xi)
        inverse_quadratic = fa / safe(fb - fa) * fc / safe(fb - fc) + (c - a) / safe(
            b - a
        ) * fa / safe(fc - fa) * fb / safe(fc - fb)
        fraction = jnp.where(is_smooth, jnp.clip(inverse_quadratic, 0.0, 1.0), 0.5)
        fraction = jnp.where(fa == 0.0, 0.0, fraction)
        return (a, fa, b, fb, c, fc, fraction), None

    carry = (end, at_end, start, at_start, start, at_start, jnp.full_like(start, 0.5))
    a, fa, b, fb, *_ = lax.scan(iterate, carry, None, length=n_iterations)[0]
    return jnp.where(has_zero, jnp.where(jnp.abs(fa) <= jnp.abs(fb), a, b), start)
