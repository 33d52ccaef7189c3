"""Peaks of the ground's normal force in each step of a sampled walk, for any model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from vrw_jax.measures import FORCE_PEAK_MEASURES, make_measure_attributes
from vrw_jax.measures import xarray as xr
from vrw_jax.validation import check_type


@dataclass(frozen=True)
class ForcePeakOptions:
    """Options of the search for force peaks in a sampled walk."""

    spline_degree: int = 7
    """Degree of the spline through the samples of an interval. The value is chosen because the
    spline's error with the default number of samples is that of the solver.
    """
    min_extremum_height_fraction: float = 1e-7
    """Smallest height of an extremum above or below its neighborhood, as a fraction of the largest
    force. The value is chosen because errors of the solver would otherwise be extrema of a constant
    force.
    """


FORCE_PEAK_OPTIONS = ForcePeakOptions()

SAMPLED_FORCE_PEAK_MEASURES = tuple(
    name for name in FORCE_PEAK_MEASURES if name != "landing_impulse"
)
"""Measures of the peaks of the normal force between impacts."""


def force_peaks(walk: xr.Dataset) -> xr.Dataset:
    """Return the peaks of the normal force in each step of a walk that `vrw.simulate` returned.

    A peak is a smooth maximum of the force on the fore foot, Leg 1, between two events. Impacts and
    changes of phase or contact are not peaks. Peaks are located on a spline of degree 7 through the
    samples of each interval. For gaits, the method `measures` of the result of `vrw.limit_cycle`
    returns the same measures without samples, and with derivatives.

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
    sample_times = walk.time.values
    # The time of an event is listed twice, up to round-off.
    time_roundoff = 4.0 * np.finfo(float).eps * np.max(sample_times)
    is_interval_end = (np.diff(sample_times) <= time_roundoff) | (np.diff(walk.step.values) != 0)
    interval_starts = np.flatnonzero(is_interval_end) + 1
    sampled_intervals = np.split(np.arange(len(sample_times)), interval_starts)
    min_samples_per_phase, n_samples = (
        FORCE_PEAK_OPTIONS.spline_degree + 2,
        max(map(len, sampled_intervals)),
    )
    if n_samples < min_samples_per_phase:
        raise ValueError(
            f"the phases of the walk have {n_samples} samples, but its peaks need at least "
            f"{min_samples_per_phase}: give simulate(..., n_samples={min_samples_per_phase}) or "
            "more."
        )
    step_indices, step_index_by_sample = np.unique(walk.step.values), walk.step.values
    intervals_by_step = [
        [
            sample_indices
            for sample_indices in sampled_intervals
            if len(sample_indices) == n_samples
            and step_index_by_sample[sample_indices[0]] == step_index
        ]
        for step_index in step_indices
    ]
    fore_force_extrema, total_force_extrema = (
        [
            _find_force_extrema(walk.time.values, normal_force, sampled_intervals)
            for sampled_intervals in intervals_by_step
        ]
        for normal_force in (fore_force, total_force)
    )
    measures_by_step = [
        _summarize_force_extrema(fore_extrema_of_step, total_extrema_of_step)
        for fore_extrema_of_step, total_extrema_of_step in zip(
            fore_force_extrema, total_force_extrema, strict=True
        )
    ]
    dataset_variables = {
        measure_name: (
            "step",
            np.array([step_measures[measure_name] for step_measures in measures_by_step]),
            make_measure_attributes(measure_name),
        )
        for measure_name in SAMPLED_FORCE_PEAK_MEASURES
    }
    walk_extremum_arrays = [
        np.concatenate(force_extremum_arrays)
        for force_extremum_arrays in zip(*fore_force_extrema, strict=True)
    ]
    walk_force_extrema = _ForceExtrema(*walk_extremum_arrays)
    step_index_by_extremum = np.repeat(
        step_indices, [len(extrema_of_step.time) for extrema_of_step in fore_force_extrema]
    )
    dataset_variables |= {
        "force": ("extremum", walk_force_extrema.force, make_measure_attributes("lambda_2")),
        "force_time": ("extremum", walk_force_extrema.time, make_measure_attributes("time")),
        "force_step": ("extremum", step_index_by_extremum, make_measure_attributes("step")),
        "is_maximum": (
            "extremum",
            walk_force_extrema.is_extremum_maximum,
            {"long_name": "whether a maximum"},
        ),
    }
    return xr.Dataset(dataset_variables, {"step": step_indices}, dict(walk.attrs))


class _ForceExtrema(NamedTuple):
    """Extrema of a force in one gait step, in chronological order."""

    time: np.ndarray  # s
    force: np.ndarray  # N
    is_extremum_maximum: np.ndarray
    # largest maximum of the rate after the first peak, N/s; one number
    max_rate_after_first_peak: np.ndarray


def _find_force_extrema(
    sample_times: np.ndarray,
    sampled_forces: np.ndarray,
    sample_indices_by_interval: list[np.ndarray],
) -> _ForceExtrema:
    """Return the extrema of a force within the intervals between the events of one step.

    - `interval_indices`: indices of the samples in each interval between two events.
    """
    from scipy.interpolate import PPoly, make_interp_spline  # This import is slow.

    (
        times_by_interval,
        forces_by_interval,
        maximum_flags_by_interval,
        force_rate_maximum_times,
        force_rate_maxima,
    ) = (
        [],
        [],
        [],
        [],
        [],
    )
    min_extremum_height = FORCE_PEAK_OPTIONS.min_extremum_height_fraction * np.max(
        np.abs(sampled_forces)
    )
    for sample_indices in sample_indices_by_interval:
        if np.ptp(sampled_forces[sample_indices]) < min_extremum_height:
            continue
        interval_sample_times = sample_times[sample_indices]
        interval_start, interval_duration = interval_sample_times[0], np.ptp(interval_sample_times)
        time_fractions = (interval_sample_times - interval_start) / interval_duration
        force_spline = make_interp_spline(
            time_fractions, sampled_forces[sample_indices], FORCE_PEAK_OPTIONS.spline_degree
        )
        interior_fraction_selector = lambda extremum_time_fractions: extremum_time_fractions[
            (extremum_time_fractions > 0.0) & (extremum_time_fractions < 1.0)
        ]
        extremum_time_fractions = interior_fraction_selector(
            PPoly.from_spline(force_spline.derivative(1)).roots()
        )
        forces_at_extrema_and_ends = force_spline(
            np.concatenate([[0.0], extremum_time_fractions, [1.0]])
        )
        force_changes_between_extrema = np.abs(np.diff(forces_at_extrema_and_ends))
        extremum_time_fractions = extremum_time_fractions[
            np.minimum(force_changes_between_extrema[:-1], force_changes_between_extrema[1:])
            > min_extremum_height
        ]
        times_by_interval.append(interval_start + interval_duration * extremum_time_fractions)
        forces_by_interval.append(force_spline(extremum_time_fractions))
        maximum_flags_by_interval.append(force_spline(extremum_time_fractions, 2) < 0.0)
        rate_maximum_time_fractions = interior_fraction_selector(
            PPoly.from_spline(force_spline.derivative(2)).roots()
        )
        rate_maximum_time_fractions = rate_maximum_time_fractions[
            force_spline(rate_maximum_time_fractions, 3) < 0.0
        ]
        force_rate_maximum_times.append(
            interval_start + interval_duration * rate_maximum_time_fractions
        )
        force_rate_maxima.append(force_spline(rate_maximum_time_fractions, 1) / interval_duration)
    interval_array_joiner = lambda arrays_by_interval: np.concatenate(
        [np.zeros(0), *arrays_by_interval]
    )
    sorted_extremum_times, sorted_maximum_flags = (
        interval_array_joiner(times_by_interval),
        interval_array_joiner(maximum_flags_by_interval).astype(bool),
    )
    first_peak_time = np.min(sorted_extremum_times[sorted_maximum_flags], initial=np.inf)
    rates_after_first_peak = interval_array_joiner(force_rate_maxima)[
        interval_array_joiner(force_rate_maximum_times) > first_peak_time
    ]
    max_rate_after_first_peak = (
        np.array([np.max(rates_after_first_peak)])
        if rates_after_first_peak.size
        else np.array([np.nan])
    )
    return _ForceExtrema(
        sorted_extremum_times,
        interval_array_joiner(forces_by_interval),
        sorted_maximum_flags,
        max_rate_after_first_peak,
    )


def _summarize_force_extrema(
    fore_force_extrema: _ForceExtrema, total_force_extrema: _ForceExtrema
) -> dict[str, Any]:
    """Return the force measures of one step.

    The measures are computed from the extrema of the normal force on the fore foot and of the total
    normal force.
    """
    force_trough_depth = 0.0
    for i in np.flatnonzero(~fore_force_extrema.is_extremum_maximum):
        earlier_peak_forces, later_peak_forces = (
            extremum_forces[is_force_maximum]
            for extremum_forces, is_force_maximum in (
                (fore_force_extrema.force[:i], fore_force_extrema.is_extremum_maximum[:i]),
                (fore_force_extrema.force[i:], fore_force_extrema.is_extremum_maximum[i:]),
            )
        )
        if earlier_peak_forces.size and later_peak_forces.size:
            force_trough_depth = max(
                force_trough_depth,
                min(earlier_peak_forces.max(), later_peak_forces.max())
                - fore_force_extrema.force[i],
            )
    return {
        "n_force_peaks": int(np.sum(fore_force_extrema.is_extremum_maximum)),
        "peak_force": np.max(
            fore_force_extrema.force[fore_force_extrema.is_extremum_maximum], initial=0.0
        ),
        "force_trough_depth": force_trough_depth,
        "second_peak_rate": fore_force_extrema.max_rate_after_first_peak[0],
        "n_total_force_peaks": int(np.sum(total_force_extrema.is_extremum_maximum)),
        "peak_total_force": np.max(
            total_force_extrema.force[total_force_extrema.is_extremum_maximum], initial=0.0
        ),
    }
