"""Locate peaks of the ground's normal force in a sampled walk.

The peaks are located on a spline through samples of each interval between two events. A peak is a
smooth maximum inside a phase. Impacts and changes of phase are no peaks. The largest force may also
occur there.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from vrw_jax.base.checks import check_type
from vrw_jax.base.lazy_xarray import xarray as xr
from vrw_jax.base.progress import announce_wait
from vrw_jax.flow.smooth_parts import StepForceExtrema, summarize_forces
from vrw_jax.models.measures import FORCE_PEAK_MEASURES, make_measure_attributes

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
