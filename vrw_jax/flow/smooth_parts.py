"""Extrema and integrals of quantities in the smooth parts of phases, between their kinks.

Each part is sampled at the nodes of Lobatto's rule in several intervals. In an interval, a quantity
is the polynomial through its values and rates at the five nodes, and its integral is that of
Lobatto's rule. Both are more accurate than the motion.
"""

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

N_INTERVALS = 8
"""Number of intervals in each part. The value is chosen because a relative error of the force is
then below 1e-9.
"""
INTERVAL_GRADING = 4.0
"""Ratio of the last interval's length to the first. The value is chosen because fast modes of light
legs decay after the start of a part.
"""
NODES = np.array([-1.0, -np.sqrt(3.0 / 7.0), 0.0, np.sqrt(3.0 / 7.0), 1.0])
"""Nodes of Lobatto's rule in an interval from -1 to 1."""
NODE_WEIGHTS = np.array([9.0, 49.0, 64.0, 49.0, 9.0]) / 180.0
"""Weights of the nodes in the mean over an interval."""
_BOUNDARIES = np.expm1(np.linspace(0.0, np.log(INTERVAL_GRADING), N_INTERVALS + 1)) / (
    INTERVAL_GRADING - 1.0
)
_INTERVAL_FRACTIONS = np.diff(_BOUNDARIES)
NODE_FRACTIONS = np.append(
    (_BOUNDARIES[:-1, None] + _INTERVAL_FRACTIONS[:, None] * (NODES[:-1] + 1.0) / 2.0).ravel(), 1.0
)
"""Time of each node as a fraction of the duration of a part. Neighboring intervals share a node."""
_NODE_INDICES = (len(NODES) - 1) * np.arange(N_INTERVALS)[:, None] + np.arange(len(NODES))
_POWERS = np.arange(2 * len(NODES))
N_BRACKETS = 8
"""Number of brackets in an interval, each of which may contain one inflection and two extrema."""
_BRACKET_ENDS = np.linspace(-1.0, 1.0, N_BRACKETS + 1)
N_BISECTIONS = 12
"""Number of bisections of a bracket. The value is chosen because Newton's method then converges."""
N_NEWTON_STEPS = 3
"""Number of Newton's steps after them. The value is chosen because they reach round-off."""


def _evaluate_powers(location: Any, order: int = 0) -> Any:
    """Return the derivatives of all powers of a location, on the last axis."""
    factors = np.prod([_POWERS - i for i in range(order)], axis=0) * np.ones(len(_POWERS))
    return factors * location[..., None] ** np.maximum(_POWERS - order, 0)


_COEFFICIENTS_FROM_NODES = np.linalg.inv(
    np.concatenate([_evaluate_powers(NODES), _evaluate_powers(NODES, 1)])
)


class SmoothParts(NamedTuple):
    """Parts of a phase between its kinks. Their first axis contains the parts, in order of time."""

    n_kinks: Array  # number of kinks, which may exceed the number of listed parts
    sides: Array  # sides of the kinks in each part
    durations: Array  # s, zero for absent parts
    states: Array  # coordinates and rates at the `NODE_FRACTIONS` of each part

    @property
    def is_complete(self) -> Array:
        return self.n_kinks < len(self.durations)


class PartExtrema(NamedTuple):
    """Extrema of a quantity in the parts of a phase, in order of time; most flags are false."""

    times: Array  # since the start of the phase, s
    values: Array
    is_maximum: Array
    is_minimum: Array


def find_extrema(values: Array, rates: Array, durations: Array) -> PartExtrema:
    """Return the smooth extrema of a quantity, with its values and rates at the nodes of parts.

    Their values have exact first derivatives, because the quantity is stationary there.
    """
    lengths = durations[:, None] * _INTERVAL_FRACTIONS.astype(values.dtype)
    slopes = rates[:, _NODE_INDICES] * (0.5 * lengths[..., None])
    samples = jnp.concatenate([values[:, _NODE_INDICES], slopes], -1)
    coefficients = samples @ _COEFFICIENTS_FROM_NODES.T.astype(values.dtype)
    fixed = lax.stop_gradient(coefficients)
    evaluate = lambda location, order: jnp.sum(
        fixed[..., None, :] * _evaluate_powers(location, order), -1
    )

    def find_roots(order: int, start: Array, end: Array, is_positive: Array) -> Array:
        """Return a root of a derivative in each bracket, or any location if there is none.

        - `is_positive`: whether the derivative is positive at the start of the bracket.
        """

        def halve(_: Any, bracket: tuple[Array, Array]) -> tuple[Array, Array]:
            middle = 0.5 * (bracket[0] + bracket[1])
            is_later = (evaluate(middle, order) > 0.0) == is_positive
            return jnp.where(is_later, middle, bracket[0]), jnp.where(is_later, bracket[1], middle)

        def correct(_: Any, location: Array) -> Array:
            rate = evaluate(location, order + 1)
            change = evaluate(location, order) / jnp.where(rate == 0.0, 1.0, rate)
            return jnp.clip(location - change, start, end)

        low, high = lax.fori_loop(0, N_BISECTIONS, halve, (start, end))
        return lax.fori_loop(0, N_NEWTON_STEPS, correct, 0.5 * (low + high))

    shape = (*fixed.shape[:-1], N_BRACKETS)
    start, end = (
        jnp.broadcast_to(x.astype(values.dtype), shape)
        for x in (_BRACKET_ENDS[:-1], _BRACKET_ENDS[1:])
    )
    # Two extrema in one bracket are separated by an inflection.
    inflections = find_roots(2, start, end, evaluate(start, 2) > 0.0)
    interleave = lambda *x: jnp.stack(x, -1).reshape(*shape[:-1], -1)
    start, end = interleave(start, inflections), interleave(inflections, end)
    # Neighboring intervals have the same slope at their common node.
    end_slopes = lax.stop_gradient(jnp.concatenate([slopes[..., :1], slopes[..., -1:]], -1))
    inner_slopes = evaluate(start[..., 1:], 1)
    all_slopes = jnp.concatenate([end_slopes[..., :1], inner_slopes, end_slopes[..., 1:]], -1)
    is_rising = all_slopes > 0.0
    locations = find_roots(1, start, end, is_rising[..., :-1])
    extremum_values = jnp.sum(coefficients[..., None, :] * _evaluate_powers(locations), -1)
    starts = (jnp.cumsum(durations) - durations)[:, None] + durations[:, None] * _BOUNDARIES[:-1]
    times = starts[..., None] + 0.5 * (locations + 1.0) * lengths[..., None]
    has_occurred = (durations > 0.0)[:, None, None]
    is_maximum = has_occurred & is_rising[..., :-1] & ~is_rising[..., 1:]
    is_minimum = has_occurred & ~is_rising[..., :-1] & is_rising[..., 1:]
    return PartExtrema(*map(jnp.ravel, (times, extremum_values, is_maximum, is_minimum)))


def mask_ends(values: Array, durations: Array) -> Array:
    """Return the values at both ends of each part, and -inf for absent parts."""
    return jnp.ravel(jnp.where((durations > 0.0)[:, None], values[:, np.array([0, -1])], -jnp.inf))


def mask_incomplete(value: Array, parts_by_phase: Sequence[SmoothParts]) -> Array:
    """Return a value, or NaN if a phase has more kinks than parts are listed."""
    is_complete = functools.reduce(jnp.logical_and, [x.is_complete for x in parts_by_phase])
    return jnp.where(is_complete, value, jnp.nan)


def integrate_over_parts(values: Array, durations: Array) -> Array:
    """Return the integral of a quantity over all parts, with its values at their nodes."""
    weights = _INTERVAL_FRACTIONS[:, None] * NODE_WEIGHTS
    return jnp.sum(durations[:, None, None] * weights * values[:, _NODE_INDICES])


class StepForceExtrema(NamedTuple):
    """Extrema of a force in one gait step, in chronological order."""

    times: Any  # s
    forces: Any  # N
    is_peak: Any
    is_trough: Any
    rate_times: Any  # of extrema of the rate, s
    rates: Any  # N/s
    is_rate_maximum: Any
    other_forces: Any  # at the ends of phases, or at all samples, N


def summarize_forces(xp: Any, fore: StepForceExtrema, total: StepForceExtrema) -> dict[str, Any]:
    """Return the measures of a step from extrema of the force on the fore foot and of their sum.

    - `xp`: `jax.numpy`, or `numpy` for numbers of extrema that differ from step to step.
    """
    fore_peaks, total_peaks = (_summarize_force(extrema, xp) for extrema in (fore, total))
    names = {"n_force_peaks": "n_total_force_peaks", "peak_force": "peak_total_force"}
    names["smooth_peak_force"] = "smooth_peak_total_force"
    return fore_peaks | {names[name]: total_peaks[name] for name in names}


def _summarize_force(extrema: StepForceExtrema, xp: Any) -> dict[str, Any]:
    """Return the measures of the fore foot in `measures.FORCE_PEAK_MEASURES`, by name."""
    find_largest = lambda values: xp.max(values, initial=-xp.inf)
    peak_forces = xp.where(extrema.is_peak, extrema.forces, -xp.inf)
    lower_neighbor_peak = xp.minimum(
        _find_highest_before(peak_forces, xp), _find_highest_before(peak_forces, xp, True)
    )
    is_trough = extrema.is_trough & xp.isfinite(lower_neighbor_peak)
    trough_depths = xp.where(
        is_trough, xp.where(is_trough, lower_neighbor_peak, 0.0) - extrema.forces, 0.0
    )
    first_peak_time = xp.min(xp.where(extrema.is_peak, extrema.times, xp.inf), initial=xp.inf)
    is_later_rate_maximum = extrema.is_rate_maximum & (extrema.rate_times > first_peak_time)
    largest_rate = find_largest(xp.where(is_later_rate_maximum, extrema.rates, -xp.inf))
    candidate_forces = xp.append(peak_forces, extrema.other_forces)
    return {
        "n_force_peaks": xp.sum(extrema.is_peak),
        # The maximum of tied forces has one-sided derivatives. Selection returns one of them.
        "peak_force": candidate_forces[xp.argmax(candidate_forces)],
        "smooth_peak_force": xp.where(xp.any(extrema.is_peak), find_largest(peak_forces), xp.nan),
        "force_trough_depth": xp.max(trough_depths, initial=0.0),
        "second_peak_rate": xp.where(xp.any(is_later_rate_maximum), largest_rate, xp.nan),
    }


def _find_highest_before(forces: Any, xp: Any, is_reversed: bool = False) -> Any:
    """Return the largest force before each one, or after it, and -inf if there is none.

    JAX computes it in a loop, because comparisons of all pairs would double the compiled code.
    """
    if xp is np:
        order = slice(None, None, -1 if is_reversed else 1)
        return np.maximum.accumulate(np.append(-np.inf, forces[order])[:-1])[order]
    start = jnp.asarray(-jnp.inf, forces.dtype)
    keep_highest = lambda highest, force: (jnp.maximum(highest, force), highest)
    return lax.scan(keep_highest, start, forces, reverse=is_reversed)[1]
