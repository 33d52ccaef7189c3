"""Locate peaks of the ground's normal force in a gait of the paper's model.

The peaks are located on the collocation solution of the gait. A peak is a smooth maximum inside a
phase. Impacts and changes of phase are no peaks. The largest force may also occur there.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from vrw_jax.base.types import Scalar
from vrw_jax.gaits.collocation_search import CollocationSystem
from vrw_jax.gaits.extrema import (
    CollocatedPhaseMotion,
    ExtremumValues,
    FunctionOfCoordinatesAndRates,
    LocatedExtrema,
    evaluate_extrema,
    locate_extrema,
)
from vrw_jax.gaits.phase_collocation import CollocationSolution
from vrw_jax.wheel import transitions
from vrw_jax.wheel.phases import AbstractPhase, PhaseInstant, make_paper_phases


class PhaseForces(NamedTuple):
    """Motion in one phase, and functions of coordinates and rates: accelerations and forces.

    The forces are the normal force on the fore foot and, in double support, also the total force.
    """

    motion: CollocatedPhaseMotion
    compute_acceleration: FunctionOfCoordinatesAndRates
    compute_forces: FunctionOfCoordinatesAndRates


def _collect_phase_forces(
    collocation_system: CollocationSystem, parameters: Array, solution: CollocationSolution
) -> tuple[list[list[PhaseForces]], list[Scalar]]:
    """Return the forces of each phase in each gait step, and the impulse of the next landing."""
    forces_by_step, landing_impulses = [], []
    for step_index, phase_points in enumerate(
        collocation_system.evaluate_phase_points(parameters, solution)
    ):
        symbols = collocation_system.make_wheel(parameters, step_index).symbols()
        phases = make_paper_phases(
            symbols, phase_points[0].phase_start_point.held_constants[0], stop_at_lift_off=False
        )
        forces_by_step.append(
            [
                PhaseForces(
                    CollocatedPhaseMotion.from_node_accelerations(
                        mesh,
                        jnp.stack(points.phase_start_point.q),
                        jnp.stack(points.phase_start_point.v),
                        duration,
                        accelerations[step_index],
                    ),
                    functools.partial(_compute_acceleration, phase),
                    functools.partial(_compute_forces, phase),
                )
                for mesh, phase, points, duration, accelerations in zip(
                    collocation_system.phase_meshes,
                    phases,
                    phase_points,
                    solution.durations[step_index],
                    solution.accelerations,
                    strict=True,
                )
            ]
        )
        end_point = phase_points[-1].phase_end_point
        landing = transitions.resolve_landing(symbols, end_point.q[0], *end_point.v)
        landing_impulses.append(landing.fore_impulse.normal)
    return forces_by_step, landing_impulses


def _compute_acceleration(phase: AbstractPhase, q: Array, v: Array) -> Array:
    motion = phase.compute_motion(tuple(q), tuple(v))
    return jnp.stack(phase.solve_acceleration(motion)[: phase.n_dof])


def _compute_forces(phase: AbstractPhase, q: Array, v: Array) -> Array:
    instant = PhaseInstant(phase, phase.compute_motion(tuple(q), tuple(v)))
    fore_force = jnp.asarray(instant.fore_force.normal)
    if instant.rear_force is None:
        return fore_force[None]
    return jnp.stack([fore_force, fore_force + instant.rear_force.normal])


@functools.partial(jax.jit, static_argnums=0)
def locate_force_extrema(
    collocation_system: CollocationSystem, parameters: Array, solution: CollocationSolution
) -> list[list[LocatedExtrema]]:
    """Return where the forces of each phase in each gait step have extrema.

    The result has no derivatives.
    """
    parameters, solution = lax.stop_gradient((parameters, solution))
    forces_by_step, _ = _collect_phase_forces(collocation_system, parameters, solution)
    return [[locate_extrema(*forces) for forces in step_forces] for step_forces in forces_by_step]


@functools.partial(jax.jit, static_argnums=0)
def evaluate_force_peaks(
    collocation_system: CollocationSystem,
    parameters: Array,
    solution: CollocationSolution,
    extrema_by_step: list[list[LocatedExtrema]],
) -> dict[str, Scalar]:
    """Return the `measures.FORCE_PEAK_MEASURES` of a cycle by name, from its located extrema.

    Each measure is the largest value over the gait steps of the cycle.
    """
    forces_by_step, landing_impulses = _collect_phase_forces(
        collocation_system, parameters, solution
    )
    peaks_by_step = []
    for step_forces, step_extrema, durations, landing_impulse in zip(
        forces_by_step, extrema_by_step, solution.durations, landing_impulses, strict=True
    ):
        values = [
            evaluate_extrema(*forces, extrema)
            for forces, extrema in zip(step_forces, step_extrema, strict=True)
        ]
        fore_peaks, total_force_peaks = (
            _summarize_force_extrema(step_extrema, values, durations, force_index)
            for force_index in range(2)
        )
        peaks_by_step.append(
            {
                **fore_peaks,
                "n_total_force_peaks": total_force_peaks["n_force_peaks"],
                "peak_total_force": total_force_peaks["peak_force"],
                "smooth_peak_total_force": total_force_peaks["smooth_peak_force"],
                "landing_impulse": landing_impulse,
            }
        )
    return jax.tree.map(
        lambda *values_by_step: jnp.nanmax(jnp.stack(values_by_step)), *peaks_by_step
    )


def compute_force_peaks(
    collocation_system: CollocationSystem, parameters: Array, solution: CollocationSolution
) -> dict[str, Scalar]:
    """Return the `measures.FORCE_PEAK_MEASURES` of a cycle by name, inside a larger program."""
    extrema = locate_force_extrema(collocation_system, parameters, solution)
    return evaluate_force_peaks(collocation_system, parameters, solution, extrema)


def _summarize_force_extrema(
    extrema_of_phases: list[LocatedExtrema],
    values_of_phases: list[ExtremumValues],
    phase_durations: Array,
    force_index: int,
) -> dict[str, Scalar]:
    """Return the measures of one force over a gait step, from the extrema in each phase.

    The measures are those of the fore foot in `measures.FORCE_PEAK_MEASURES`, by name.

    - `force_index`: 0 for the force on the fore foot, 1 for the total force.
    """
    extrema_of_phases, values_of_phases = jax.tree.map(
        lambda x: x[min(force_index, len(x) - 1)], (extrema_of_phases, values_of_phases)
    )
    start_times = jnp.cumsum(phase_durations) - phase_durations
    extrema, values = (
        jax.tree.map(lambda *by_phase: jnp.concatenate(by_phase), *phases)
        for phases in (
            [
                extrema._replace(
                    times=extrema.times + start_time,
                    rate_times=extrema.rate_times + start_time,
                    node_accelerations=jnp.zeros(0),
                    inverse_jacobian=jnp.zeros(0),
                )
                for extrema, start_time in zip(extrema_of_phases, start_times, strict=True)
            ],
            values_of_phases,
        )
    )
    extremum_values = values.values
    is_peak = extrema.is_maximum
    peak_forces = jnp.where(is_peak, extremum_values, -jnp.inf)
    extremum_indices = jnp.arange(len(peak_forces))
    find_highest_peak_force = lambda extremum_mask: jnp.max(
        jnp.where(extremum_mask, peak_forces, -jnp.inf), axis=1
    )
    lower_neighbor_peak_force = jnp.minimum(
        find_highest_peak_force(extremum_indices < extremum_indices[:, None]),
        find_highest_peak_force(extremum_indices > extremum_indices[:, None]),
    )
    is_force_trough = extrema.is_minimum & jnp.isfinite(lower_neighbor_peak_force)
    force_trough_depths = jnp.where(
        is_force_trough,
        jnp.where(is_force_trough, lower_neighbor_peak_force, 0.0) - extremum_values,
        0.0,
    )
    first_peak_time = jnp.min(jnp.where(is_peak, extrema.times, jnp.inf))
    is_later_rate_maximum = extrema.is_rate_maximum & (extrema.rate_times > first_peak_time)
    has_phase_occurred = jnp.repeat(phase_durations > 0.0, 2)
    candidate_forces = jnp.append(peak_forces, jnp.where(has_phase_occurred, values.ends, -jnp.inf))
    largest_force_rate = jnp.max(jnp.where(is_later_rate_maximum, values.rates, -jnp.inf))
    return {
        "n_force_peaks": jnp.sum(is_peak).astype(phase_durations.dtype),
        # The maximum of tied forces has one-sided derivatives. Selection returns one of them.
        "peak_force": candidate_forces[jnp.argmax(candidate_forces)],
        "smooth_peak_force": jnp.where(jnp.any(is_peak), jnp.max(peak_forces), jnp.nan),
        "force_trough_depth": jnp.max(force_trough_depths),
        "second_peak_rate": jnp.where(jnp.any(is_later_rate_maximum), largest_force_rate, jnp.nan),
    }
