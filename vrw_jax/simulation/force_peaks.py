"""Peaks of the ground's normal force in each step of a sampled walk, of any model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from vrw_jax.measures import FORCE_PEAK_MEASURES, measure_attrs
from vrw_jax.runtime import xarray as xr
from vrw_jax.validation import check_type


@dataclass(frozen=True)
class PeakOptions:
    """Numbers of the search for peaks in a sampled walk."""

    spline_degree: int = 7
    """Degree of the spline through the samples of an interval, chosen because its error with the
    default number of samples is that of the solver."""
    min_height_fraction: float = 1e-7
    """Least rise and fall beside an extremum, as a fraction of the largest force. It is chosen
    above the errors of the solver, which would be extrema of a force that is constant."""


PEAK_OPTIONS = PeakOptions()

SAMPLED_PEAK_MEASURES = tuple(name for name in FORCE_PEAK_MEASURES if name != "landing_impulse")
"""Measures of the force between impacts."""


def force_peaks(walk: xr.Dataset) -> xr.Dataset:
    """Return the peaks of the normal force in each step of a walk that `vrw.simulate` returned.

    A peak is a smooth maximum of the force on the fore foot, Leg 1, between two events. Impacts and
    changes of phase or contact are no peaks. Peaks are located on a spline of degree 7 through the
    samples of each interval. For gaits of the paper's model `LimitCycle.measure` gives the same
    measures without samples, with derivatives.

    Args:
        walk: a trajectory with at least 9 samples per phase.

    Returns:
        A dataset of the force measures over `step`. Over `extremum` it has `force`, `force_time`,
        `force_step` and `is_maximum` of each extremum of the fore foot's force.

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
        fore, rear = walk.lambda_2.values, walk.lambda_4.values
        total = fore + rear
    elif "normal" in walk:
        fore, total = walk.normal.values[:, 0], walk.normal.values.sum(1)
    else:
        raise ValueError(
            f"walk holds {', '.join(map(str, walk)) or 'nothing'}, but no normal force of the "
            "feet: give the result of vrw.simulate."
        )
    intervals = _split_intervals(walk.time.values, walk.step.values)
    least, n_samples = PEAK_OPTIONS.spline_degree + 2, max(map(len, intervals))
    if n_samples < least:
        raise ValueError(
            f"the phases of the walk have {n_samples} samples, but its peaks need at least "
            f"{least}: give simulate(..., n_samples={least}) or more."
        )
    steps, step_of_sample = np.unique(walk.step.values), walk.step.values
    intervals_by_step = [
        [rows for rows in intervals if len(rows) == n_samples and step_of_sample[rows[0]] == step]
        for step in steps
    ]
    fore_extrema, total_extrema = (
        [_find_extrema(walk.time.values, force, intervals) for intervals in intervals_by_step]
        for force in (fore, total)
    )
    values = [
        _summarize(fore, total) for fore, total in zip(fore_extrema, total_extrema, strict=True)
    ]
    data = {
        name: ("step", np.array([row[name] for row in values]), measure_attrs(name))
        for name in SAMPLED_PEAK_MEASURES
    }
    joined = [np.concatenate(parts) for parts in zip(*fore_extrema, strict=True)]
    extrema = _Extrema(*joined)
    step_of_extremum = np.repeat(steps, [len(part.time) for part in fore_extrema])
    data |= {
        "force": ("extremum", extrema.force, measure_attrs("lambda_2")),
        "force_time": ("extremum", extrema.time, measure_attrs("time")),
        "force_step": ("extremum", step_of_extremum, measure_attrs("step")),
        "is_maximum": ("extremum", extrema.is_maximum, {"long_name": "whether a maximum"}),
    }
    return xr.Dataset(data, {"step": steps}, dict(walk.attrs))


class _Extrema(NamedTuple):
    """Extrema of a force in one step, in the order of time."""

    time: np.ndarray  # s
    force: np.ndarray  # N
    is_maximum: np.ndarray
    later_rate: np.ndarray  # largest maximum of the rate after the first peak, N/s; one number


def _split_intervals(time: np.ndarray, step: np.ndarray) -> list[np.ndarray]:
    """Return the indices of the samples of each interval between two events.

    The time of an event is listed twice, up to round-off.
    """
    roundoff = 4.0 * np.finfo(float).eps * np.max(time)
    is_first = np.flatnonzero((np.diff(time) <= roundoff) | (np.diff(step) != 0)) + 1
    return np.split(np.arange(len(time)), is_first)


def _find_extrema(time: np.ndarray, force: np.ndarray, intervals: list[np.ndarray]) -> _Extrema:
    """Return the extrema of a force in the intervals of one step."""
    from scipy.interpolate import PPoly, make_interp_spline  # This import is slow.

    times, values, flags, rate_times, rates = [], [], [], [], []
    min_height = PEAK_OPTIONS.min_height_fraction * np.max(np.abs(force))
    for interval in intervals:
        if np.ptp(force[interval]) < min_height:
            continue
        interval_time = time[interval]
        start, length = interval_time[0], np.ptp(interval_time)
        fractions = (interval_time - start) / length
        spline = make_interp_spline(fractions, force[interval], PEAK_OPTIONS.spline_degree)
        is_inside = lambda roots: roots[(roots > 0.0) & (roots < 1.0)]
        roots = is_inside(PPoly.from_spline(spline.derivative(1)).roots())
        boundaries = spline(np.concatenate([[0.0], roots, [1.0]]))
        heights = np.abs(np.diff(boundaries))
        roots = roots[np.minimum(heights[:-1], heights[1:]) > min_height]
        times.append(start + length * roots)
        values.append(spline(roots))
        flags.append(spline(roots, 2) < 0.0)
        rate_roots = is_inside(PPoly.from_spline(spline.derivative(2)).roots())
        rate_roots = rate_roots[spline(rate_roots, 3) < 0.0]
        rate_times.append(start + length * rate_roots)
        rates.append(spline(rate_roots, 1) / length)
    join = lambda parts: np.concatenate([np.zeros(0), *parts])
    extremum_times, is_maximum = join(times), join(flags).astype(bool)
    first_peak = np.min(extremum_times[is_maximum], initial=np.inf)
    later_rates = join(rates)[join(rate_times) > first_peak]
    later_rate = np.array([np.max(later_rates)]) if later_rates.size else np.array([np.nan])
    return _Extrema(extremum_times, join(values), is_maximum, later_rate)


def _summarize(fore: _Extrema, total: _Extrema) -> dict[str, Any]:
    """Return the measures of one step from the extrema of its forces."""
    depth = 0.0
    for i in np.flatnonzero(~fore.is_maximum):
        before, after = (
            part[flags]
            for part, flags in (
                (fore.force[:i], fore.is_maximum[:i]),
                (fore.force[i:], fore.is_maximum[i:]),
            )
        )
        if before.size and after.size:
            depth = max(depth, min(before.max(), after.max()) - fore.force[i])
    return {
        "n_force_peaks": int(np.sum(fore.is_maximum)),
        "peak_force": np.max(fore.force[fore.is_maximum], initial=0.0),
        "force_trough_depth": depth,
        "second_peak_rate": fore.later_rate[0],
        "n_total_force_peaks": int(np.sum(total.is_maximum)),
        "peak_total_force": np.max(total.force[total.is_maximum], initial=0.0),
    }
