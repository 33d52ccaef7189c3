"""Trajectories with unilateral contact: forces change momentum, labels shift, losses count."""

import dataclasses
import math
from itertools import pairwise
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr
from support.files import assert_netcdf_round_trip

import vrw_jax as vrw

pytestmark = pytest.mark.slow

START = (0.1, 1.6, -0.1)
N_STEPS, N_SAMPLES = 2, 401
PARAMS, GROUND_MODEL = vrw.WheelParams(), vrw.UnilateralWheel(friction=0.7)
MASS = float(PARAMS.hub_mass + 8.0 * PARAMS.leg_mass)


@pytest.fixture(scope="module")
def sampled_walk() -> xr.Dataset:
    return vrw.simulate(PARAMS, START, N_STEPS, model=GROUND_MODEL, n_samples=N_SAMPLES)


def split_into_intervals(sampled_walk: xr.Dataset) -> list[xr.Dataset]:
    """Return the samples between two events, for each interval."""
    return [
        sampled_walk.isel(time=slice(begin, begin + N_SAMPLES))
        for begin in range(0, sampled_walk.sizes["time"], N_SAMPLES)
    ]


def compute_center_of_mass(part: xr.Dataset) -> np.ndarray:
    """Return the moments of mass along x and z, kg m, with each mass at the paper's position."""
    angles = part.theta.values[:, None] + 2.0 * math.pi / 8 * np.arange(8)
    reach = part.length.values - float(PARAMS.leg_com)
    leg = float(PARAMS.leg_mass)
    return np.stack(
        [
            MASS * part.hub_x.values - leg * np.sum(reach * np.sin(angles), 1),
            MASS * part.hub_z.values - leg * np.sum(reach * np.cos(angles), 1),
        ]
    )


def test_ground_forces_and_weight_accelerate_the_center_of_mass(sampled_walk: xr.Dataset) -> None:
    for part in split_into_intervals(sampled_walk):
        time = part.time.values - part.time.values[0]
        # Twice integrated from both ends to the middle, the velocities drop out.
        lever = np.minimum(time, time[-1] - time)
        simpson = np.ones(N_SAMPLES)
        simpson[1:-1:2], simpson[2:-1:2] = 4.0, 2.0
        weigh = time[1] / 3.0 * simpson * lever
        weight = 9.81 * MASS * np.array([math.sin(0.30), -math.cos(0.30)])
        pushes = np.stack([part.tangential.values.sum(1), part.normal.values.sum(1)])
        moment = compute_center_of_mass(part)
        bend = moment[:, 0] - 2.0 * moment[:, N_SAMPLES // 2] + moment[:, -1]
        # Simpson's rule where a damped leg settles at c / m = 200 per second.
        np.testing.assert_allclose((pushes + weight[:, None]) @ weigh, bend, atol=1e-8)


def test_the_next_step_starts_at_the_end_of_the_last_one(sampled_walk: xr.Dataset) -> None:
    first, second = (sampled_walk.isel(time=sampled_walk.step.values == k) for k in range(N_STEPS))
    end, begin = first.isel(time=-1), second.isel(time=0)
    assert float(begin.time) == pytest.approx(float(end.time), abs=1e-12)
    assert float(begin.theta - end.theta) == pytest.approx(-math.pi / 4, abs=1e-9)
    for name in ("hub_x", "hub_z"):
        assert float(begin[name]) == pytest.approx(float(end[name]), abs=1e-9)
    for name in ("length", "foot_x", "foot_z"):
        np.testing.assert_allclose(begin[name], np.roll(end[name], 1), atol=1e-9)
    assert begin.foot_z.values[0] == pytest.approx(0.0, abs=1e-9)


def test_between_events_time_increases_and_motion_is_continuous(
    sampled_walk: xr.Dataset, tmp_path: Path
) -> None:
    assert_netcdf_round_trip(sampled_walk, tmp_path)
    parts = split_into_intervals(sampled_walk)
    assert len(parts) > 4
    for before, after in pairwise(parts):
        assert np.all(np.diff(before.time) > 0.0)
        assert float(after.time[0] - before.time[-1]) == pytest.approx(0.0, abs=1e-12)
        if after.step[0] == before.step[0]:
            for name in ("hub_x", "hub_z", "theta", "length"):
                np.testing.assert_allclose(after[name][0], before[name][-1], atol=1e-9)


def test_energy_falls_from_step_to_step_by_what_the_step_lost(sampled_walk: xr.Dataset) -> None:
    total = (
        sampled_walk.kinetic_energy
        + sampled_walk.gravitational_energy
        + sampled_walk.elastic_energy
    )
    ends = [float(total[sampled_walk.step.values == k][-1]) for k in range(N_STEPS)]
    x = vrw.step(PARAMS, START, model=GROUND_MODEL).section_state
    step = vrw.step(PARAMS, x, model=GROUND_MODEL)
    energy_loss = step.energy_impacts + step.energy_damping + step.energy_friction
    assert ends[0] - ends[1] == pytest.approx(float(energy_loss), abs=1e-8)


def test_forces_match_the_contact_mode(sampled_walk: xr.Dataset) -> None:
    in_the_air = sampled_walk.contact.values == 0
    for force in (sampled_walk.normal.values, sampled_walk.tangential.values):
        assert np.all(force[in_the_air] == 0.0)
    assert np.all(sampled_walk.normal.values[~in_the_air] > -1e-9)
    np.testing.assert_allclose(sampled_walk.foot_z.values[~in_the_air], 0.0, atol=1e-9)
    sliding = sampled_walk.contact.values == 2
    assert sliding.any()
    cone = sampled_walk.tangential.values + 0.7 * sampled_walk.normal.values
    np.testing.assert_allclose(cone[sliding], 0.0, atol=1e-9)
    assert sampled_walk.contact.attrs["flag_meanings"].split()[2] == "sliding_downhill"
    np.testing.assert_allclose(
        sampled_walk.length.values[sampled_walk.on_stopper.values], 1.0, atol=1e-12
    )


def test_machine_code_samples_the_motion_of_the_definition() -> None:
    params, wheel = vrw.WheelParams(damping=100.0), vrw.UnilateralWheel(friction=0.5)
    start = wheel.complete_section_state(params, jnp.asarray(START))
    lanes, definition = (
        wheel.sample_step(
            params, start, dataclasses.replace(vrw.StepOptions.tight(), engine=engine), 9
        )
        for engine in ("lanes", "diffrax")
    )
    happened = np.asarray(definition.duration) > 0.0
    assert happened.sum() == 6
    of_stretches = "time", "state", "contact", "locked", "tangential", "normal", "duration"
    for name in (*of_stretches, "section_state", "step_length", "outcome"):
        result, true = (np.asarray(getattr(trace, name)) for trace in (lanes, definition))
        if name in of_stretches:
            result, true = result[happened], true[happened]
        # At 1e-13 states differ by 2e-14, forces of some 100 N by 1e-12 N.
        np.testing.assert_allclose(result, true, rtol=0.0, atol=1e-10, err_msg=name)


def test_the_trajectory_of_the_ladder_gives_the_model_of_each_step() -> None:
    for friction, name in ((50.0, "ViscoelasticWheel"), (0.7, "UnilateralWheel")):
        ladder = vrw.LadderWheel(friction=friction)
        walk = vrw.simulate(PARAMS, START, 1, model=ladder, n_samples=3)
        assert np.all(walk.rung == walk.rung.attrs["flag_meanings"].split().index(name))
        resting = np.isin(walk.contact.values, (0, 1)).all()
        assert resting == (name == "ViscoelasticWheel")


def test_a_failing_step_ends_the_trajectory_with_its_outcome() -> None:
    walk = vrw.simulate(PARAMS, (0.1, math.nan, -0.1), 3, model=GROUND_MODEL, n_samples=N_SAMPLES)
    assert walk.attrs["outcome"] == "BAD_INPUT"
    assert walk.sizes["time"] == 0
