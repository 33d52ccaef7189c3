"""Peaks of the ground's normal force in a gait of the paper's model, located on its collocation.

A peak is a smooth maximum inside a phase. Impacts and changes of phase are no peaks.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from vrw_jax.collocation import CollocatedPhase, CollocationSolution, PhaseExtrema, find_extrema
from vrw_jax.cycles.collocation_search import CollocationSystem
from vrw_jax.numerics import Scalar
from vrw_jax.wheel import (
    AbstractPhase,
    PhaseInstant,
    make_phases,
    transitions,
    wheel_from_parameters,
)


@functools.partial(jax.jit, static_argnums=0)
def compute_force_peaks(
    system: CollocationSystem, parameters: Array, solution: CollocationSolution
) -> dict[str, Scalar]:
    """Return the `measures.FORCE_PEAK_MEASURES` of a cycle by name, the largest over its steps."""
    s = wheel_from_parameters(parameters, system.n_legs).symbols()
    step_peaks, (_, steps) = [], system.evaluate_phase_points(parameters, solution)
    for step_index, phase_points in enumerate(steps):
        phases = make_phases(s, phase_points[0].start.held_constants[0], stop_at_lift_off=False)
        durations = solution.durations[step_index]
        fore_extrema, total_extrema = [], []
        for i, (phase, points) in enumerate(zip(phases, phase_points, strict=True)):
            motion = CollocatedPhase.from_nodes(
                system.meshes[i],
                jnp.stack(points.start.q),
                jnp.stack(points.start.v),
                durations[i],
                solution.accelerations[i][step_index],
            )
            fore_extrema.append(_find_force_extrema(phase, motion, with_rear_foot=False))
            has_rear_foot = i == 0
            total_extrema.append(
                _find_force_extrema(phase, motion, with_rear_foot=True)
                if has_rear_foot
                else fore_extrema[-1]
            )
        fore, total = (_summarize(extrema, durations) for extrema in (fore_extrema, total_extrema))
        end = phase_points[-1].end
        landing = transitions.land(s, end.q[0], *end.v)
        step_peaks.append(
            {
                "n_force_peaks": fore.n_peaks,
                "peak_force": fore.peak_force,
                "force_trough_depth": fore.trough_depth,
                "second_peak_rate": fore.second_peak_rate,
                "n_total_force_peaks": total.n_peaks,
                "peak_total_force": total.peak_force,
                "landing_impulse": landing.fore_impulse.normal,
            }
        )
    return jax.tree.map(lambda *values: jnp.nanmax(jnp.stack(values)), *step_peaks)


def _find_force_extrema(
    phase: AbstractPhase, motion: CollocatedPhase, with_rear_foot: bool
) -> PhaseExtrema:
    """Return the extrema of the normal force on the fore foot, or on both feet, in a phase."""

    def acceleration_at(q: Array, v: Array) -> Array:
        return jnp.stack(phase.acceleration(phase.motion_at(tuple(q), tuple(v)))[: phase.n_dof])

    def normal_force_at(q: Array, v: Array) -> Array:
        instant = PhaseInstant(phase, phase.motion_at(tuple(q), tuple(v)), None)
        force = jnp.asarray(instant.fore_force.normal)
        if with_rear_foot and instant.rear_force is not None:
            force = force + instant.rear_force.normal
        return force

    return find_extrema(motion, acceleration_at, normal_force_at)


class _ForcePeaks(NamedTuple):
    """Peaks of a force over one step, as in `measures.FORCE_PEAK_MEASURES`."""

    n_peaks: Scalar
    peak_force: Scalar
    trough_depth: Scalar
    second_peak_rate: Scalar


def _summarize(extrema_of_phases: list[PhaseExtrema], durations: Array) -> _ForcePeaks:
    """Return the peaks of a step from the extrema in its phases."""
    starts = jnp.cumsum(durations) - durations
    shifted_extrema = [
        extrema._replace(time=extrema.time + start, rate_time=extrema.rate_time + start)
        for extrema, start in zip(extrema_of_phases, starts, strict=True)
    ]
    extrema = jax.tree.map(lambda *parts: jnp.concatenate(parts), *shifted_extrema)
    peaks = jnp.where(extrema.is_maximum, extrema.value, -jnp.inf)
    order = jnp.arange(len(peaks))
    highest_where = lambda mask: jnp.max(jnp.where(mask, peaks, -jnp.inf), axis=1)
    highest_before = highest_where(order < order[:, None])
    highest_after = highest_where(order > order[:, None])
    lower_peak = jnp.minimum(highest_before, highest_after)
    is_trough = extrema.is_minimum & jnp.isfinite(lower_peak)
    depths = jnp.where(is_trough, jnp.where(is_trough, lower_peak, 0.0) - extrema.value, 0.0)
    first_peak_time = jnp.min(jnp.where(extrema.is_maximum, extrema.time, jnp.inf))
    is_later_maximum = extrema.is_rate_maximum & (extrema.rate_time > first_peak_time)
    largest_rate = jnp.max(jnp.where(is_later_maximum, extrema.rate, -jnp.inf))
    return _ForcePeaks(
        n_peaks=jnp.sum(extrema.is_maximum).astype(durations.dtype),
        peak_force=jnp.where(jnp.any(extrema.is_maximum), jnp.max(peaks), 0.0),
        trough_depth=jnp.max(depths),
        second_peak_rate=jnp.where(jnp.any(is_later_maximum), largest_rate, jnp.nan),
    )
