"""Compute the force on one foot over its whole stance: two wheels and a spring-mass walker.

    python -m experiments.gaits.force_peak_stances

A stance lasts from the landing of the foot until its lift-off after the next landing. The wheels
are the parameter sets `table_1` and `two_peaks`. The command writes `force_peak_stances.csv`, with
sampled forces, and `force_peak_spring_mass.csv`, with measures of the spring-mass walker.

The spring-mass walker is that of Geyer, Seyfarth and Blickhan, *Compliant leg behaviour explains
basic dynamics of walking and running*, Proc. R. Soc. B 273, 2861-2867, 2006. Its parameters are
those of the implementation https://github.com/atharvasunder/GeyerEA06, file `main.m`.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from scipy.integrate import solve_ivp
from scipy.interpolate import make_interp_spline

import vrw_jax as vrw
from experiments.gaits.force_peak_wheels import compute_total_mass
from experiments.shared.command import make_parser, parse_and_start_jax
from experiments.shared.tables import FIGURES, write_named_rows

STANCE_TABLE = FIGURES / "force_peak_stances.csv"
SPRING_MASS_TABLE = FIGURES / "force_peak_spring_mass.csv"

N_SAMPLES_PER_PHASE = 60
"""Number of stored forces per phase, chosen because their curve is smooth in a figure."""

STIFFNESS = 13969.44  # N/m
MASS = 80.0  # kg
REST_LENGTH = 1.0  # m
ENERGY = 816.192  # J
LANDING_ANGLE = np.radians(69.0)
GRAVITY = 9.81  # m/s^2
MIDSTANCE_HEIGHT = 0.965  # m
WEIGHT = MASS * GRAVITY
N_STEPS = 400
"""Number of steps from mid-stance, chosen because the durations then repeat to 1e-6 s."""

Event = Callable[[float, np.ndarray, list[float]], float]


class SpringMassStep(NamedTuple):
    """Solutions of single and of double support of one step, and the place of the landing foot."""

    single_support: Any
    double_support: Any
    landing_foot: float


def compute_leg_force(state: np.ndarray, foot: float) -> np.ndarray:
    """Return the force of one leg on the mass, N, forward and upward."""
    leg = state[:2] - np.array([foot, 0.0])
    length = np.hypot(*leg)
    return STIFFNESS * max(REST_LENGTH - length, 0.0) / length * leg


def compute_rate(_: float, state: np.ndarray, feet: list[float]) -> np.ndarray:
    """Return velocity and acceleration of the mass."""
    force = sum((compute_leg_force(state, foot) for foot in feet), np.array([0.0, -WEIGHT]))
    return np.concatenate([state[2:], force / MASS])


def measure_touchdown_height(_: float, state: np.ndarray, feet: list[float]) -> float:
    """Return the height of the mass above that at the landing of the next leg, m."""
    return float(state[1] - REST_LENGTH * np.sin(LANDING_ANGLE))


def measure_rear_extension(_: float, state: np.ndarray, feet: list[float]) -> float:
    """Return the length of the rear leg beyond its rest length, m."""
    return float(np.hypot(state[0] - feet[0], state[1]) - REST_LENGTH)


def run_until(event: Event, direction: float, state: np.ndarray, feet: list[float]) -> Any:
    """Return the solution until the event, whose value then crosses zero in this direction."""

    def stop(time: float, state: np.ndarray, feet: list[float]) -> float:
        return event(time, state, feet)

    vars(stop).update(terminal=True, direction=direction)
    return solve_ivp(
        compute_rate, (0.0, 2.0), state, args=(feet,), events=stop, rtol=1e-11, atol=1e-11,
        method="DOP853", dense_output=True,
    )  # fmt: skip


def walk_spring_mass() -> list[SpringMassStep]:
    """Return the steps of the spring-mass walker from mid-stance."""
    compression = MIDSTANCE_HEIGHT - REST_LENGTH
    kinetic = ENERGY - WEIGHT * MIDSTANCE_HEIGHT - 0.5 * STIFFNESS * compression**2
    state = np.array([0.0, MIDSTANCE_HEIGHT, np.sqrt(2.0 * kinetic / MASS), 0.0])
    foot, steps = 0.0, []
    for _ in range(N_STEPS):
        single_support = run_until(measure_touchdown_height, -1.0, state, [foot])
        state = single_support.y[:, -1]
        landing_foot = state[0] + REST_LENGTH * np.cos(LANDING_ANGLE)
        double_support = run_until(measure_rear_extension, 1.0, state, [foot, landing_foot])
        steps.append(SpringMassStep(single_support, double_support, landing_foot))
        state, foot = double_support.y[:, -1], landing_foot
    return steps


def sample_spring_mass_stance(
    steps: list[SpringMassStep], n_samples: int
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return times since the landing, s, and vertical forces, N, of each phase of the last stance.

    The phases of a stance are double support, single support and double support.
    """
    before, last = steps[-2:]
    phase_start, samples = 0.0, []
    for phase in (before.double_support, last.single_support, last.double_support):
        phase_times = np.linspace(0.0, phase.t[-1], n_samples)
        states = phase.sol(phase_times).T
        forces = [compute_leg_force(state, before.landing_foot)[1] for state in states]
        samples.append((phase_start + phase_times, np.array(forces)))
        phase_start += phase.t[-1]
    return samples


def measure_spring_mass(steps: list[SpringMassStep]) -> dict[str, str]:
    """Return the table line of the spring-mass walker."""
    n_peaks, highest = [], 0.0
    for sample_times, forces in sample_spring_mass_stance(steps, 400):
        slope_signs = np.sign(make_interp_spline(sample_times, forces, 5)(sample_times, 1))
        peak_indices = np.flatnonzero(np.diff(slope_signs) < 0)
        n_peaks.append(len(peak_indices))
        highest = max(highest, *forces[peak_indices], 0.0)
    single, double = (steps[-1].single_support.t[-1], steps[-1].double_support.t[-1])
    bounce_period = 2.0 * np.pi * np.sqrt(MASS / STIFFNESS)
    return {
        "stiffness_number": f"{STIFFNESS * REST_LENGTH / WEIGHT:.4g}",
        "peaks_of_stance": str(sum(n_peaks)),
        "peaks_until_next_touchdown": str(sum(n_peaks[:2])),
        "peak_force_to_weight": f"{highest / WEIGHT:.4g}",
        "dls_fraction": f"{double / (single + double):.4g}",
        "bounces": f"{single / bounce_period:.4g}",
        "period": f"{single + double:.4g}",
        "change_of_double_support": f"{abs(double - steps[-2].double_support.t[-1]):.1e}",
    }


def sample_wheel_stance(params: vrw.WheelParams) -> tuple[np.ndarray, np.ndarray, float]:
    """Return times since the landing, s, forces of one foot, N, and the duration of a step, s."""
    gait = vrw.limit_cycle(params)
    walk = vrw.simulate(params, gait.section_state, n_steps=2, n_samples=N_SAMPLES_PER_PHASE)
    is_second_step = walk.step.values != walk.step.values[0]
    # The fore foot of the first step is the rear foot of the second.
    forces = np.where(is_second_step, walk.lambda_4.values, walk.lambda_2.values)
    n_samples = len(forces) - np.count_nonzero(is_second_step) + N_SAMPLES_PER_PHASE
    return walk.time.values[:n_samples], forces[:n_samples], float(gait.period)


def compute_stances() -> None:
    """Write the forces over the stance of both wheels and of the spring-mass walker."""
    rows = []
    for name in ("table_1", "two_peaks"):
        params = vrw.parameter_sets[name].params
        sample_times, forces, period = sample_wheel_stance(params)
        weight = compute_total_mass(params) * float(params.gravity)
        rows += make_rows(name, sample_times / period, forces / weight)
    steps = walk_spring_mass()
    spring_mass_line = measure_spring_mass(steps)
    period = float(spring_mass_line["period"])
    for sample_times, forces in sample_spring_mass_stance(steps, N_SAMPLES_PER_PHASE):
        rows += make_rows("spring-mass walker", sample_times / period, forces / WEIGHT)
    write_named_rows(STANCE_TABLE, rows)
    write_named_rows(SPRING_MASS_TABLE, [spring_mass_line])


def make_rows(walker: str, step_shares: np.ndarray, forces: np.ndarray) -> list[dict[str, str]]:
    """Return table lines of times, in durations of a step, and forces, in weights."""
    return [
        {"walker": walker, "time_to_period": f"{share:.5g}", "force_to_weight": f"{force:.5g}"}
        for share, force in zip(step_shares, forces, strict=True)
    ]


def main() -> None:
    parse_and_start_jax(make_parser(__doc__))
    compute_stances()


if __name__ == "__main__":
    main()
