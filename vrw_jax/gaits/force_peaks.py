"""Locate peaks of the ground's normal force in a gait of the paper's model.

The peaks are located on the collocation solution of the gait. A peak is a smooth maximum inside a
phase. Impacts and changes of phase are no peaks. The largest force may also occur there.
"""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array

from vrw_jax.base.types import Scalar
from vrw_jax.gaits.collocation_search import CollocationSystem
from vrw_jax.gaits.extrema import CollocatedPhaseMotion, PhaseExtrema, find_quantity_extrema
from vrw_jax.gaits.phase_collocation import CollocationSolution
from vrw_jax.wheel import transitions
from vrw_jax.wheel.phases import AbstractPhase, PhaseInstant, make_paper_phases


@functools.partial(jax.jit, static_argnums=0)
def compute_force_peaks(
    collocation_system: CollocationSystem,
    parameters: Array,
    collocation_solution: CollocationSolution,
) -> dict[str, Scalar]:
    """Return the `measures.FORCE_PEAK_MEASURES` of a cycle by name.

    Each measure is the largest value over the gait steps of the cycle.
    """
    wheel_symbols = collocation_system.make_wheel(parameters).symbols()
    peaks_by_step = []
    phase_points_by_step = collocation_system.evaluate_phase_points(
        parameters, collocation_solution
    )
    for step_index, phase_points in enumerate(phase_points_by_step):
        wheel_phases = make_paper_phases(
            wheel_symbols,
            phase_points[0].phase_start_point.held_constants[0],
            stop_at_lift_off=False,
        )
        phase_durations = collocation_solution.durations[step_index]
        fore_force_extrema = []
        total_force_extrema = []
        for phase_index, (phase, points_of_phase) in enumerate(
            zip(wheel_phases, phase_points, strict=True)
        ):
            collocated_phase = CollocatedPhaseMotion.from_node_accelerations(
                collocation_system.phase_meshes[phase_index],
                jnp.stack(points_of_phase.phase_start_point.q),
                jnp.stack(points_of_phase.phase_start_point.v),
                phase_durations[phase_index],
                collocation_solution.accelerations[phase_index][step_index],
            )
            fore_force_extrema.append(
                _find_force_extrema(phase, collocated_phase, includes_rear_force=False)
            )
            has_rear_foot = phase_index == 0
            total_force_extrema.append(
                _find_force_extrema(phase, collocated_phase, includes_rear_force=True)
                if has_rear_foot
                else fore_force_extrema[-1]
            )
        total_force_peaks = _summarize_force_extrema(total_force_extrema, phase_durations)
        end_point = phase_points[-1].phase_end_point
        landing_result = transitions.resolve_landing(wheel_symbols, end_point.q[0], *end_point.v)
        peaks_by_step.append(
            {
                **_summarize_force_extrema(fore_force_extrema, phase_durations),
                "n_total_force_peaks": total_force_peaks["n_force_peaks"],
                "peak_total_force": total_force_peaks["peak_force"],
                "smooth_peak_total_force": total_force_peaks["smooth_peak_force"],
                "landing_impulse": landing_result.fore_impulse.normal,
            }
        )
    return jax.tree.map(
        lambda *values_by_step: jnp.nanmax(jnp.stack(values_by_step)), *peaks_by_step
    )


def _find_force_extrema(
    phase: AbstractPhase, collocated_phase: CollocatedPhaseMotion, includes_rear_force: bool
) -> PhaseExtrema:
    """Return the extrema of the normal force in a phase.

    The force is that on the fore foot or, if `includes_rear_force` is true, the sum of the forces
    on the two feet.
    """

    def evaluate_acceleration(q: Array, v: Array) -> Array:
        return jnp.stack(
            phase.solve_acceleration(phase.compute_motion(tuple(q), tuple(v)))[: phase.n_dof]
        )

    def evaluate_normal_force(q: Array, v: Array) -> Array:
        phase_instant = PhaseInstant(phase, phase.compute_motion(tuple(q), tuple(v)))
        normal_force = jnp.asarray(phase_instant.fore_force.normal)
        if includes_rear_force and phase_instant.rear_force is not None:
            normal_force = normal_force + phase_instant.rear_force.normal
        return normal_force

    return find_quantity_extrema(collocated_phase, evaluate_acceleration, evaluate_normal_force)


def _summarize_force_extrema(
    extrema_of_phases: list[PhaseExtrema], phase_durations: Array
) -> dict[str, Scalar]:
    """Return the measures of a force over a gait step, from the force's extrema in each phase.

    The force is that on the fore foot, or the total force.

    The measures are those of the fore foot in `measures.FORCE_PEAK_MEASURES`, by name.
    """
    phase_start_times = jnp.cumsum(phase_durations) - phase_durations
    shifted_extrema = [
        step_extrema._replace(
            extremum_times=step_extrema.extremum_times + phase_start_time,
            rate_extremum_times=step_extrema.rate_extremum_times + phase_start_time,
        )
        for step_extrema, phase_start_time in zip(extrema_of_phases, phase_start_times, strict=True)
    ]
    step_extrema = jax.tree.map(
        lambda *values_by_phase: jnp.concatenate(values_by_phase), *shifted_extrema
    )
    is_peak = step_extrema.is_quantity_maximum
    peak_forces = jnp.where(is_peak, step_extrema.extremum_values, -jnp.inf)
    extremum_indices = jnp.arange(len(peak_forces))
    find_highest_peak_force = lambda extremum_mask: jnp.max(
        jnp.where(extremum_mask, peak_forces, -jnp.inf), axis=1
    )
    lower_neighbor_peak_force = jnp.minimum(
        find_highest_peak_force(extremum_indices < extremum_indices[:, None]),
        find_highest_peak_force(extremum_indices > extremum_indices[:, None]),
    )
    is_force_trough = step_extrema.is_quantity_minimum & jnp.isfinite(lower_neighbor_peak_force)
    force_trough_depths = jnp.where(
        is_force_trough,
        jnp.where(is_force_trough, lower_neighbor_peak_force, 0.0) - step_extrema.extremum_values,
        0.0,
    )
    first_peak_time = jnp.min(jnp.where(is_peak, step_extrema.extremum_times, jnp.inf))
    is_later_rate_maximum = step_extrema.is_rate_maximum & (
        step_extrema.rate_extremum_times > first_peak_time
    )
    has_phase_occurred = jnp.repeat(phase_durations > 0.0, 2)
    candidate_forces = jnp.append(
        peak_forces, jnp.where(has_phase_occurred, step_extrema.end_values, -jnp.inf)
    )
    largest_force_rate = jnp.max(
        jnp.where(is_later_rate_maximum, step_extrema.rate_extremum_values, -jnp.inf)
    )
    return {
        "n_force_peaks": jnp.sum(is_peak).astype(phase_durations.dtype),
        # The maximum of tied forces has one-sided derivatives. Selection returns one of them.
        "peak_force": candidate_forces[jnp.argmax(candidate_forces)],
        "smooth_peak_force": jnp.where(jnp.any(is_peak), jnp.max(peak_forces), jnp.nan),
        "force_trough_depth": jnp.max(force_trough_depths),
        "second_peak_rate": jnp.where(jnp.any(is_later_rate_maximum), largest_force_rate, jnp.nan),
    }
