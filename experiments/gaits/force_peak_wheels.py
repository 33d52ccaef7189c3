"""Wheels of the study of force peaks, given by dimensionless numbers.

The numbers are the stiffness k L0 / (M g), the damping ratio c / (2 sqrt(k M)), the slope, the
natural length in units of the locked length, and the share of all legs in the mass M of the wheel.
"""

from typing import NamedTuple

import jax
import numpy as np

import vrw_jax as vrw

GAIT_OPTIONS = vrw.CycleOptions(mesh_intervals=(40, 32, 16))
"""One mesh for all gaits, chosen because gaits with two peaks need its resolution."""


def compute_total_mass(params: vrw.WheelParams) -> float:
    """Return the mass of the wheel, kg."""
    return float(params.hub_mass + params.n_legs * params.leg_mass)


def compute_leg_share(params: vrw.WheelParams) -> float:
    """Return the mass of all legs as a fraction of the mass of the wheel."""
    return params.n_legs * float(params.leg_mass) / compute_total_mass(params)


def compute_stiffness_number(params: vrw.WheelParams) -> float:
    """Return the dimensionless stiffness k L0 / (M g)."""
    weight = compute_total_mass(params) * float(params.gravity)
    return float(params.stiffness * params.locked_length) / weight


def compute_damping_ratio(params: vrw.WheelParams) -> float:
    """Return the damping ratio c / (2 sqrt(k M)) of the wheel's mass on one leg."""
    critical_damping = 2.0 * np.sqrt(float(params.stiffness) * compute_total_mass(params))
    return float(params.damping) / critical_damping


def make_wheels(
    stiffness_number: np.ndarray | float,
    damping_ratio: np.ndarray | float,
    slope: np.ndarray | float,
    natural_length: np.ndarray | float = 1.0,
    leg_share: np.ndarray | float | None = None,
) -> vrw.WheelParams:
    """Return wheels with the mass, length and gravity of Table 1; arguments are broadcast.

    `slope` is in rad and `natural_length` in m. `leg_share` is the mass of all legs as a fraction
    of the mass of the wheel, that of Table 1 by default.
    """
    # WheelParams contains 64-bit numbers only if vrw.start_jax() was called.
    table_1 = vrw.WheelParams()
    mass = compute_total_mass(table_1)
    if leg_share is None:
        leg_share = compute_leg_share(table_1)
    arguments = stiffness_number, damping_ratio, slope, natural_length, leg_share
    number, ratio, slope, natural_length, leg_share = np.broadcast_arrays(
        *map(np.asarray, arguments)
    )
    stiffness = number / compute_stiffness_number(table_1) * float(table_1.stiffness)
    return vrw.WheelParams(
        hub_mass=mass * (1.0 - leg_share),
        leg_mass=mass * leg_share / table_1.n_legs,
        stiffness=stiffness,
        damping=2.0 * ratio * np.sqrt(stiffness * mass),
        natural_length=natural_length,
        slope=slope,
    )


LIGHT_DAMPING = 100.0 / (2.0 * np.sqrt(2500.0 * 18.0))
"""Damping ratio of the parameter set `two_peaks`, with 100 N s/m, 2500 N/m and 18 kg."""


def select_wheel(params: vrw.WheelParams, index: int) -> vrw.WheelParams:
    """Return one wheel of a batch, whose parameters may also be numbers."""
    shape = np.shape(params.stiffness)
    return jax.tree.map(lambda x: np.broadcast_to(x, shape)[index], params)


class ForcePeakTimes(NamedTuple):
    """Times of one gait in periods of the bounce, NaN if there is no such peak.

    - `first_peak_to_touchdown`: from the first peak to the next touchdown;
    - `peak_distance`: from the first peak to the second.
    """

    first_peak_to_touchdown: float
    peak_distance: float


def compute_bounce_periods(params: vrw.WheelParams) -> np.ndarray:
    """Return the periods of the damped bounce on one leg, s; NaN for overdamped legs.

    The mass of the leg on the ground does not bounce, because it moves with the foot.
    """
    mass = np.asarray(params.hub_mass + (params.n_legs - 1) * params.leg_mass)
    decay_rate = np.asarray(params.damping) / (2.0 * mass)
    squared_rate = np.asarray(params.stiffness) / mass - decay_rate**2
    is_underdamped = squared_rate > 0.0
    return np.where(
        is_underdamped, 2.0 * np.pi / np.sqrt(np.where(is_underdamped, squared_rate, 1.0)), np.nan
    )


def compute_peak_times(params: vrw.WheelParams, section_state: np.ndarray) -> ForcePeakTimes:
    """Return the times of the force peaks of the gait of one wheel with underdamped legs."""
    walk = vrw.simulate(params, section_state, n_steps=1)
    peaks = vrw.force_peaks(walk)
    peak_times = peaks.force_time.values[peaks.is_maximum.values]
    bounce_period, touchdown = float(compute_bounce_periods(params)), walk.time.values[-1]
    return ForcePeakTimes(
        (touchdown - peak_times[0]) / bounce_period if len(peak_times) > 0 else np.nan,
        (peak_times[1] - peak_times[0]) / bounce_period if len(peak_times) > 1 else np.nan,
    )
