"""Minima of margins along a phase, at the integrator's accuracy.

During the integration, the step that holds the lowest minimum of each margin is stored. After it,
secant steps on the margin's rate locate the minimum, one margin after the other.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from vrw_jax.numerics.types import Scalar

State = Float[Array, " dim"]
Watch = Callable[[State], Float[Array, " n_watched"]]
"""Guards and margins as functions of the state."""


class Watched(NamedTuple):
    """Functions monitored along a phase: guards that end it, then margins whose minimum is
    searched.

    `values` returns the `n_guards` guards followed by the margins. A margin's minimum is searched
    at every interior local minimum and at the phase's end. The phase's start counts too
    (`includes_start`), unless the margin is zero there by construction, like the height of a foot
    that leaves the ground. `guard_scales`: magnitudes of the terms whose difference is the guard. A
    guard within some round-off of its scale is at zero, because in a dip of microseconds no other
    time brings it closer.
    """

    values: Watch
    n_guards: int
    count_start: tuple[bool, ...] = ()
    sizes: Array | None = None


ROUNDING = 32.0
"""Round-off of a guard's value, in units of round-off of its scale."""


def at_rounding(
    watched: Watched, crossing: Bool[Array, " n_guards"], guards: Float[Array, " n_guards"]
) -> tuple[Bool[Array, ""], Int[Array, ""]]:
    """Return whether the lowest crossing guard is only round-off, and the index of that guard."""
    sizes = jnp.ones_like(guards) if watched.sizes is None else watched.sizes
    lowest = jnp.where(crossing, guards / sizes, jnp.inf)
    near = jnp.abs(jnp.min(lowest)) <= ROUNDING * jnp.finfo(lowest.dtype).eps
    known = watched.sizes is not None
    return near & known, jnp.argmin(lowest).astype(jnp.int32)


class Step(NamedTuple):
    """The end of the last accepted step, which a rejected step does not change."""

    time: Scalar
    state: State
    solver_state: Any
    values: Float[Array, " n_watched"]
    rates: Float[Array, " n_watched"]


class Minimum(NamedTuple):
    """Lowest interior minimum so far of each margin, and the step that holds it."""

    value: Float[Array, " n"]
    left: Float[Array, "n dim"]
    length: Float[Array, " n"]  # of the step from its start, s
    offset: Float[Array, " n"]  # of the minimum from the step's start, s
    rate_left: Float[Array, " n"]

    @property
    def found(self) -> Bool[Array, " n"]:
        """Whether each margin has an interior minimum."""
        return jnp.isfinite(self.value)


class Settling(NamedTuple):
    """State of the secant steps on a margin's rate after the integration, one margin at a time."""

    monitor: Int[Array, ""]
    tries: Int[Array, ""]
    at: Scalar  # time with the smallest rate so far, from the step's start, s
    rate_at: Scalar
    lowest: Float[Array, " n"]  # refined minima, and the values at the phase's start


def cubic(x: Array, v0: Array, r0: Array, v1: Array, r1: Array) -> Array:
    """Return the cubic Hermite interpolant on [0, 1]; the rates are multiplied by the length."""
    return (
        (1 + 2 * x) * (1 - x) ** 2 * v0
        + x * (1 - x) ** 2 * r0
        + x * x * (3 - 2 * x) * v1
        + x * x * (x - 1) * r1
    )


@jax.jit  # traced once for all margins
def cubic_minimum(v0: Array, r0: Array, v1: Array, r1: Array) -> tuple[Array, Array]:
    """Return location in (0, 1) and value of the cubic's interior minimum; the value is inf if none
    exists.
    """
    a = 3.0 * (2.0 * v0 + r0 - 2.0 * v1 + r1)
    b = 2.0 * (-3.0 * v0 - 2.0 * r0 + 3.0 * v1 - r1)
    discriminant = b * b - 4.0 * a * r0
    root = jnp.sqrt(jnp.where(discriminant > 0.0, discriminant, 1.0))
    # The minimum is the root with positive curvature, written without cancellation.
    denominator = jnp.where(b >= 0.0, -(b + root), 2.0 * a)
    numerator = jnp.where(b >= 0.0, 2.0 * r0, root - b)
    safe = jnp.where(denominator == 0.0, 1.0, denominator)
    x = jnp.where(denominator == 0.0, -1.0, numerator / safe)
    exists = (discriminant > 0.0) & (x > 0.0) & (x < 1.0)
    x = jnp.where(exists, x, 0.5)
    return x, jnp.where(exists, cubic(x, v0, r0, v1, r1), jnp.inf)


def no_minimum(watched: Watched, start: State) -> Minimum:
    """Return the state without interior minima."""
    n = len(watched.count_start)
    zeros = jnp.zeros((n,), start.dtype)
    return Minimum(zeros + jnp.inf, jnp.tile(start, (n, 1)), zeros, zeros, zeros)


def lower(
    watched: Watched,
    minimum: Minimum,
    left: Step,
    right: Step,
    length: Scalar,
    counts: Bool[Array, ""],
) -> Minimum:
    """Return the minima, with the step in which a margin turns from falling to rising if it is the
    lowest.

    A margin that is zero at the phase's start by construction is at rest there: a negative rate is
    round-off and counts as zero.
    """
    if not watched.count_start:
        return minimum
    v0, r0, v1, r1 = (
        lax.stop_gradient(v)[watched.n_guards :]
        for v in (left.values, left.rates, right.values, right.rates)
    )
    at_rest = (left.time == 0.0) & ~jnp.asarray(watched.count_start)
    r0 = jnp.where(at_rest, jnp.maximum(r0, 0.0), r0)
    length = lax.stop_gradient(length)
    x, value = cubic_minimum(v0, r0 * length, v1, r1 * length)
    value = jnp.where(jnp.isfinite(value), value, jnp.minimum(v0, v1))
    better = counts & (r0 < 0.0) & (r1 >= 0.0) & (value < minimum.value)
    return Minimum(
        jnp.where(better, value, minimum.value),
        jnp.where(better[:, None], left.state, minimum.left),
        jnp.where(better, length, minimum.length),
        jnp.where(better, x * length, minimum.offset),
        jnp.where(better, r0, minimum.rate_left),
    )


def row_of(index: Int[Array, ""], rows: Array) -> Array:
    """Return the row with this index; a gather would cost more in a batch."""
    chosen = jnp.arange(rows.shape[0]) == index
    return jnp.sum(jnp.where(chosen.reshape(-1, *(1,) * (rows.ndim - 1)), rows, 0.0), axis=0)


def settle(
    settling: Settling,
    watched: Watched,
    minimum: Minimum,
    step: Step,
    length: Scalar,
    on: Bool[Array, ""],
    starting: Bool[Array, ""],
    ends: Bool[Array, ""],
    n_steps: int,
) -> tuple[Settling, Bool[Array, ""], Scalar]:
    """Locate each margin's minimum at the integrator's accuracy, by steps after the integration
    ends.

    At most `max_iterations` secant steps on the rate are taken, each a step of `length` from the
    start of the step that holds the minimum. Return the state of the refinement, whether another
    step is needed (this one was a refinement if `is_refining`), and its length.
    """
    values, rates = step.values[watched.n_guards :], step.rates[watched.n_guards :]
    monitor, tries = settling.monitor, settling.tries + on
    value, rate, room = (row_of(monitor, x) for x in (values, rates, minimum.length))
    fixed_rate, fixed_length = lax.stop_gradient((rate, length))
    gap = fixed_length - settling.at
    slope = (fixed_rate - settling.rate_at) / jnp.where(gap == 0.0, 1.0, gap)
    usable = (gap != 0.0) & (slope > 0.0)
    secant = length - jnp.where(usable, rate / jnp.where(usable, slope, 1.0), 0.0)
    secant = jnp.clip(secant, 0.0, lax.stop_gradient(room))
    still = jnp.abs(secant - length) <= AT_MINIMUM * room
    done = on & ((tries == n_steps) | (still & (tries >= FEWEST)))
    nearer = jnp.abs(fixed_rate) < jnp.abs(settling.rate_at)

    monitors = jnp.arange(values.shape[0])
    lowest = jnp.where(
        done & (monitors == monitor), jnp.minimum(value, settling.lowest), settling.lowest
    )
    at_start = jnp.where(jnp.asarray(watched.count_start), values, jnp.inf)
    left = minimum.found & (ends | (monitors > monitor))
    turns = ends | done
    monitor = jnp.where(turns, jnp.argmax(left).astype(jnp.int32), monitor)
    offset, rate_left = lax.stop_gradient(
        (row_of(monitor, minimum.offset), row_of(monitor, minimum.rate_left))
    )
    told = Settling(
        monitor=monitor,
        tries=jnp.where(turns, 0, tries),
        at=jnp.where(turns, 0.0, jnp.where(nearer, fixed_length, settling.at)),
        rate_at=jnp.where(turns, rate_left, jnp.where(nearer, fixed_rate, settling.rate_at)),
        lowest=jnp.where(starting, at_start, lowest),
    )
    return told, jnp.where(turns, jnp.any(left), on), jnp.where(turns, offset, secant)


FEWEST = 3
"""Least number of tries at a minimum, chosen because each makes the location's derivatives accurate
to more digits."""
AT_MINIMUM = 1e-6
"""Accuracy of a minimum's location, in lengths of the step that holds it, chosen because the error
of the value is the square of it."""
