"""Locate peaks of the ground's normal force in a gait of the paper's model, or in a sampled walk.

The peaks of a gait are located on its collocation solution, and those of a walk on a spline through
samples of each interval between two events. A peak is a smooth maximum inside a phase. Impacts and
changes of phase are no peaks. The largest force may also occur there.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from vrw_jax.base.checks import check_type
from vrw_jax.base.lazy_xarray import xarray as xr
from vrw_jax.base.measures import Measure
from vrw_jax.base.progress import announce_wait
from vrw_jax.base.types import Scalar
from vrw_jax.flow.kinks import StepForceExtrema, summarize_forces
from vrw_jax.gaits.derivatives import attach_derivatives, make_tangent_function
from vrw_jax.gaits.extrema import (
    ExtremumValues,
    LocatedExtrema,
    PhaseMotion,
    evaluate_extrema,
    locate_extrema,
    reconstruct_motion,
)
from vrw_jax.gaits.phase_collocation import CollocationSolution, PhasePoint
from vrw_jax.gaits.phase_sequence import CollocationState, CollocationSystem
from vrw_jax.lanes.autodiff import make_implicit_jacobian
from vrw_jax.lanes.batching import BatchFunction, unbatch
from vrw_jax.lanes.lane_function import compile_batch_function, with_lane_axis
from vrw_jax.models.measures import FORCE_PEAK_MEASURES, make_measure_attributes
from vrw_jax.wheel import transitions
from vrw_jax.wheel.phases import PAPER_PHASES, AbstractPhase, PhaseInstant, make_paper_phases


def _compute_forces(wheel: Any, phase: AbstractPhase, q: Array, v: Array) -> Array:
    """Return the normal force on the fore foot and, in double support, also the total force."""
    instant = PhaseInstant(phase, phase.compute_motion(tuple(q), tuple(v)))
    fore_force = jnp.asarray(instant.fore_force.normal)
    if instant.rear_force is None:
        return fore_force[None]
    return jnp.stack([fore_force, fore_force + instant.rear_force.normal])


def _reconstruct_phases(
    system: CollocationSystem,
    parameters: Array,
    solution: CollocationSolution,
    has_polynomials: bool = False,
    compute_quantities: Callable[..., Array] = _compute_forces,
) -> tuple[list[list[PhaseMotion]], list[Scalar]]:
    """Return the motion of each phase in each gait step, and each landing's impulse.

    - `compute_quantities`: function of wheel, phase, coordinates and rates whose extrema are
      located.
    """
    sequence, constants = system.phase_sequence, system.phase_constants_function(*parameters)
    section_state, motions_by_step, impulses = tuple(solution.section_state), [], []
    for step_index in range(system.period_n):
        step_constants = sequence.select_constants(constants, (step_index % 2,))
        wheel = system.make_wheel(parameters, step_index)
        symbols = wheel.symbols()
        start = sequence.step_start_map(step_constants, section_state)
        paper_phases = make_paper_phases(symbols, start.held_constants[0], stop_at_lift_off=False)
        motions = []
        for i, phase in enumerate(sequence.phases):
            motion = reconstruct_motion(
                system.phase_meshes[i],
                (jnp.stack(start.q), jnp.stack(start.v)),
                solution.durations[step_index, i],
                solution.accelerations[i][step_index],
                functools.partial(_compute_acceleration, paper_phases[i]),
                functools.partial(compute_quantities, wheel, paper_phases[i]),
                has_polynomials,
            )
            motions.append(motion)
            end = PhasePoint(start.held_constants, tuple(motion.q[-1]), tuple(motion.v[-1]))
            start = phase.reset_map(step_constants, end)
        section_state = start.q
        motions_by_step.append(motions)
        impulses.append(transitions.resolve_landing(symbols, end.q[0], *end.v).fore_impulse.normal)
    return motions_by_step, impulses


def _compute_acceleration(phase: AbstractPhase, q: Array, v: Array) -> Array:
    motion = phase.compute_motion(tuple(q), tuple(v))
    return jnp.stack(phase.solve_acceleration(motion)[: phase.n_dof])


ForceExtrema = list[list[LocatedExtrema]]
"""Extrema of the forces of each phase in each gait step."""


def _summarize_steps(
    extrema_by_step: ForceExtrema,
    values_by_step: list[list[ExtremumValues]],
    durations: Array,
    landing_impulses: list[Scalar],
) -> dict[str, Scalar]:
    """Return the `measures.FORCE_PEAK_MEASURES`: the largest value of each over the gait steps."""
    peaks_by_step = []
    for extrema, values, step_durations, landing_impulse in zip(
        extrema_by_step, values_by_step, durations, landing_impulses, strict=True
    ):
        forces = (_join_phases(extrema, values, step_durations, index) for index in range(2))
        step_peaks = {**summarize_forces(jnp, *forces), "landing_impulse": landing_impulse}
        peaks_by_step.append(jax.tree.map(lambda x: x.astype(durations.dtype), step_peaks))
    return jax.tree.map(lambda *values: functools.reduce(jnp.fmax, values), *peaks_by_step)


def _locate_force_peaks(
    system: CollocationSystem, parameters: Array, solution: CollocationSolution
) -> tuple[dict[str, Scalar], ForceExtrema]:
    """Return the measures of the forces, and the extrema."""
    motions, impulses = _reconstruct_phases(system, parameters, solution, True)
    located = [[locate_extrema(motion) for motion in step_motions] for step_motions in motions]
    extrema = [[x for x, _ in step] for step in located]
    values = [[x for _, x in step] for step in located]
    return _summarize_steps(extrema, values, solution.durations, impulses), extrema


def _compute_peak_derivatives(
    system: CollocationSystem, parameters: Array, gait_and_tangents: tuple
) -> dict[str, Array]:
    """Return the derivatives of the measures by the parameters, on a leading axis.

    - `gait_and_tangents`: the gait and its extrema, and the gait's derivatives by the parameters.
    """
    (state, extrema), (state_tangents, _) = gait_and_tangents

    def evaluate(parameters: Array, solution: CollocationSolution) -> dict[str, Scalar]:
        motions, impulses = _reconstruct_phases(system, parameters, solution)
        values = [list(map(evaluate_extrema, *step)) for step in zip(motions, extrema, strict=True)]
        return _summarize_steps(extrema, values, solution.durations, impulses)

    directions = jnp.eye(len(parameters), dtype=parameters.dtype), state_tangents.solution
    return lax.map(lambda x: jax.jvp(evaluate, (parameters, state.solution), x)[1], directions)


def measure_extremum(
    system: CollocationSystem, parameters: Array, solution: CollocationSolution, measure: Measure
) -> Array:
    """Return the extremum of a measure of the user over its phases, as the mean over the steps."""

    def compute_quantity(wheel: Any, phase: AbstractPhase, q: Array, v: Array) -> Array:
        if phase.phase_name not in measure.phases:
            return jnp.zeros(1, q.dtype)
        instant = PhaseInstant(phase, phase.compute_motion(tuple(q), tuple(v)))
        return jnp.asarray(measure(instant, wheel))[None]

    reconstruct = functools.partial(_reconstruct_phases, system)
    motions_by_step, _ = reconstruct(parameters, solution, False, compute_quantity)
    # Only values at the extrema need derivatives.
    fixed = lax.stop_gradient((parameters, solution))
    fixed_motions_by_step, _ = reconstruct(*fixed, True, compute_quantity)
    sign, of_steps = (1.0 if measure.reduction == "max" else -1.0), []
    for motions, fixed_motions, durations in zip(
        motions_by_step, fixed_motions_by_step, solution.durations, strict=True
    ):
        candidates = []
        for motion, fixed_motion, phase, duration in zip(
            motions, fixed_motions, PAPER_PHASES, durations, strict=True
        ):
            if phase.phase_name in measure.phases:
                extrema, _ = locate_extrema(fixed_motion)
                values = evaluate_extrema(motion, extrema)
                is_extremum = extrema.is_maximum if sign > 0.0 else extrema.is_minimum
                is_candidate = jnp.append(is_extremum[0], jnp.ones(2, bool)) & (duration > 0.0)
                values_and_ends = sign * jnp.append(values.values[0], values.ends[0])
                candidates.append(jnp.where(is_candidate, values_and_ends, -jnp.inf))
        largest = jnp.max(jnp.concatenate(candidates))
        of_steps.append(jnp.where(jnp.isfinite(largest), sign * largest, 0.0))
    return jnp.mean(jnp.stack(of_steps))


def _compile_for_gaits(function: Callable, system: CollocationSystem) -> BatchFunction:
    function_of_gait = with_lane_axis(functools.partial(function, system))
    return compile_batch_function(function_of_gait, system.cycle_options.batch_size)


@functools.partial(jax.jit, static_argnums=0)
def locate_force_peaks(
    system: CollocationSystem, parameters: Array, solution: CollocationSolution
) -> tuple[dict[str, Scalar], ForceExtrema]:
    """Return the `measures.FORCE_PEAK_MEASURES` of a gait by name, and the extrema.

    The results have no derivatives.
    """
    locate = unbatch(_compile_for_gaits(_locate_force_peaks, system))
    return locate(*lax.stop_gradient((parameters, solution)))


@functools.partial(jax.jit, static_argnums=0)
def measure_force_peaks(
    system: CollocationSystem, parameters: Array, state: CollocationState
) -> dict[str, Scalar]:
    """Return the `measures.FORCE_PEAK_MEASURES` of a gait by name, with first derivatives."""
    peaks, extrema = locate_force_peaks(system, parameters, state.solution)
    tangent_function = make_tangent_function(system)

    def compile_derivatives(_: BatchFunction, order: int) -> BatchFunction:
        if order > 1:
            raise NotImplementedError(
                "measures of the force's peaks have first derivatives only: take differences of "
                "their gradients."
            )
        return _compile_for_gaits(_compute_peak_derivatives, system)

    compute_derivatives = make_implicit_jacobian(
        functools.partial(_compute_peak_derivatives, system),
        lambda parameters, gait: (tangent_function(parameters, gait[0]), ()),
        compile_derivatives,
        make_jacobian=functools.partial(_compute_peak_derivatives, system),
    )
    return attach_derivatives(compute_derivatives, peaks, parameters, (state, extrema))


def _join_phases(
    extrema_of_phases: list[LocatedExtrema],
    values_of_phases: list[ExtremumValues],
    phase_durations: Array,
    force_index: int,
) -> StepForceExtrema:
    """Return the extrema of one force over a gait step, from the extrema in each phase.

    - `force_index`: 0 for the force on the fore foot, 1 for the total force.
    """
    extrema_of_phases, values_of_phases = jax.tree.map(
        lambda x: x[min(force_index, len(x) - 1)], (extrema_of_phases, values_of_phases)
    )
    join = lambda name, phases: jnp.concatenate([getattr(phase, name) for phase in phases])
    start_times = jnp.cumsum(phase_durations) - phase_durations
    times, rate_times = (
        jnp.concatenate(
            [
                getattr(extrema, name) + start_time
                for extrema, start_time in zip(extrema_of_phases, start_times, strict=True)
            ]
        )
        for name in ("times", "rate_times")
    )
    has_phase_occurred = jnp.repeat(phase_durations > 0.0, 2)
    return StepForceExtrema(
        times,
        join("values", values_of_phases),
        join("is_maximum", extrema_of_phases),
        join("is_minimum", extrema_of_phases),
        rate_times,
        join("rates", values_of_phases),
        join("is_rate_maximum", extrema_of_phases),
        jnp.where(has_phase_occurred, join("ends", values_of_phases), -jnp.inf),
    )


SPLINE_DEGREE = 7
"""Degree of the spline through the samples of an interval. The value is chosen because the spline's
error with the default number of samples is that of the solver.
"""
MIN_EXTREMUM_HEIGHT_FRACTION = 1e-7
"""Smallest height of an extremum above or below its neighborhood, as a fraction of the largest
force. The value is chosen because errors of the solver would otherwise be extrema of a constant
force.
"""


SAMPLED_FORCE_PEAK_MEASURES = tuple(
    name for name in FORCE_PEAK_MEASURES if name != "landing_impulse"
)
"""Measures of the peaks of the normal force between impacts."""


@announce_wait("samples of gait steps", "10 s")
def force_peaks(walk: xr.Dataset) -> xr.Dataset:
    """Return the peaks of the normal force in each step of a walk that `vrw.simulate` returned.

    A peak is a smooth maximum of the force on the fore foot, Leg 1, between two events. Impacts and
    changes of phase or contact are not peaks, but the largest force may occur there. Peaks are
    located on a spline of degree 7 through the samples of each interval. For gaits, the method
    `measures` of the result of `vrw.limit_cycle` returns the same measures without samples, and
    with derivatives.

    Args:
        walk: a trajectory with at least 9 samples per phase.

    Returns:
        A dataset of the force measures over `step`. Its variables `force`, `force_time`,
        `force_step` and `is_maximum` over `extremum` describe the extrema of the fore foot's force.

    Raises:
        TypeError, ValueError: an invalid argument, described in one sentence.

    Examples:
        >>> wheel = vrw.parameter_sets["two_peaks"].params
        >>> start = vrw.limit_cycle(wheel).section_state
        >>> peaks = vrw.force_peaks(vrw.simulate(wheel, start, n_steps=1))
        >>> peaks.n_force_peaks.values, peaks.force.values.round(2)
        (array([2]), array([223.2 , 133.5 , 158.84]))
    """
    check_type("walk", walk, xr.Dataset, "give the result of vrw.simulate")
    if "lambda_2" in walk:
        fore_force, rear_force = walk.lambda_2.values, walk.lambda_4.values
        total_force = fore_force + rear_force
    elif "normal" in walk:
        fore_force, total_force = walk.normal.values[:, 0], walk.normal.values.sum(1)
    else:
        raise ValueError(
            f"walk holds {', '.join(map(str, walk)) or 'nothing'}, but no normal force of the "
            "feet: give the result of vrw.simulate."
        )
    sample_times, sample_steps = walk.time.values, walk.step.values
    if not len(sample_times):
        raise ValueError(
            f"the walk has no samples, because its outcome is {walk.attrs.get('outcome')}: give a "
            "walk that leaves its start."
        )
    # The time of an event is listed twice, up to round-off.
    time_roundoff = 4.0 * np.finfo(float).eps * np.max(sample_times)
    is_interval_end = (np.diff(sample_times) <= time_roundoff) | (np.diff(sample_steps) != 0)
    interval_starts = np.flatnonzero(is_interval_end) + 1
    sampled_intervals = np.split(np.arange(len(sample_times)), interval_starts)
    min_samples_per_phase = SPLINE_DEGREE + 2
    n_samples = max(map(len, sampled_intervals))
    if n_samples < min_samples_per_phase:
        raise ValueError(
            f"the phases of the walk have {n_samples} samples, but its peaks need at least "
            f"{min_samples_per_phase}: give simulate(..., n_samples={min_samples_per_phase}) or "
            "more."
        )
    step_indices = np.unique(sample_steps)
    fore_force_extrema, measures_by_step = [], []
    for step_index in step_indices:
        intervals_of_step = [
            sample_indices
            for sample_indices in sampled_intervals
            if len(sample_indices) == n_samples and sample_steps[sample_indices[0]] == step_index
        ]
        extrema = [
            _find_force_extrema(sample_times, force, intervals_of_step)._replace(
                other_forces=force[sample_steps == step_index]
            )
            for force in (fore_force, total_force)
        ]
        fore_force_extrema.append(extrema[0])
        measures_by_step.append(summarize_forces(np, *extrema))
    dataset_variables = {
        measure_name: (
            "step",
            np.array([step_measures[measure_name] for step_measures in measures_by_step]),
            make_measure_attributes(measure_name),
        )
        for measure_name in SAMPLED_FORCE_PEAK_MEASURES
    }
    extremum_times, extremum_forces, is_maximum, *_ = map(
        np.concatenate, zip(*fore_force_extrema, strict=True)
    )
    step_index_by_extremum = np.repeat(
        step_indices, [len(extrema.times) for extrema in fore_force_extrema]
    )
    dataset_variables |= {
        "force": ("extremum", extremum_forces, make_measure_attributes("lambda_2")),
        "force_time": ("extremum", extremum_times, make_measure_attributes("time")),
        "force_step": ("extremum", step_index_by_extremum, make_measure_attributes("step")),
        "is_maximum": ("extremum", is_maximum, {"long_name": "whether a maximum"}),
    }
    return xr.Dataset(dataset_variables, {"step": step_indices}, dict(walk.attrs))


def _find_force_extrema(
    sample_times: np.ndarray,
    sampled_forces: np.ndarray,
    sample_indices_by_interval: list[np.ndarray],
) -> StepForceExtrema:
    """Return the extrema of a force within the intervals between the events of one step.

    - `sample_indices_by_interval`: indices of the samples in each interval between two events.
    """
    from scipy.interpolate import PPoly, make_interp_spline  # This import is slow.

    extrema_by_interval = [(np.zeros(0), np.zeros(0), np.zeros(0, bool))]
    rate_maxima_by_interval = [(np.zeros(0), np.zeros(0))]

    def find_interior_roots(polynomial: Any) -> np.ndarray:
        roots = PPoly.from_spline(polynomial).roots()
        return roots[(roots > 0.0) & (roots < 1.0)]

    min_extremum_height = MIN_EXTREMUM_HEIGHT_FRACTION * np.max(np.abs(sampled_forces))
    for sample_indices in sample_indices_by_interval:
        if np.ptp(sampled_forces[sample_indices]) < min_extremum_height:
            continue
        interval_sample_times = sample_times[sample_indices]
        interval_start, interval_duration = interval_sample_times[0], np.ptp(interval_sample_times)
        time_fractions = (interval_sample_times - interval_start) / interval_duration
        force_spline = make_interp_spline(
            time_fractions, sampled_forces[sample_indices], SPLINE_DEGREE
        )
        extremum_fractions = find_interior_roots(force_spline.derivative(1))
        forces_at_extrema_and_ends = force_spline(
            np.concatenate([[0.0], extremum_fractions, [1.0]])
        )
        force_changes = np.abs(np.diff(forces_at_extrema_and_ends))
        extremum_fractions = extremum_fractions[
            np.minimum(force_changes[:-1], force_changes[1:]) > min_extremum_height
        ]
        extrema_by_interval.append(
            (
                interval_start + interval_duration * extremum_fractions,
                force_spline(extremum_fractions),
                force_spline(extremum_fractions, 2) < 0.0,
            )
        )
        rate_maximum_fractions = find_interior_roots(force_spline.derivative(2))
        rate_maximum_fractions = rate_maximum_fractions[
            force_spline(rate_maximum_fractions, 3) < 0.0
        ]
        rate_maxima_by_interval.append(
            (
                interval_start + interval_duration * rate_maximum_fractions,
                force_spline(rate_maximum_fractions, 1) / interval_duration,
            )
        )
    times, forces, is_maximum = map(np.concatenate, zip(*extrema_by_interval, strict=True))
    rate_times, rate_maxima = map(np.concatenate, zip(*rate_maxima_by_interval, strict=True))
    return StepForceExtrema(
        times, forces, is_maximum, ~is_maximum, rate_times, rate_maxima, rate_times > 0.0, ()
    )
