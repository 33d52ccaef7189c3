"""Trajectories: planted feet do not move, lost energy is dissipated, forces change momentum."""

from itertools import pairwise
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr
from support.files import assert_netcdf_round_trip

import vrw_jax as vrw
from vrw_jax.models.measures import TRAJECTORY_MEASURES
from vrw_jax.wheel.dynamics import Motion, compute_momentum

N_SAMPLES = 1001
STEADY_STATE = jnp.array([0.102726965088900357, 1.61345343427543820, -0.109037270])
"""Near the gait of Table 1: `tests/reference_code/reference_values.json`, first case, rounded."""


@pytest.fixture(scope="module")
def sampled_walk() -> xr.Dataset:
    return vrw.simulate(vrw.WheelParams(), STEADY_STATE, 3, n_samples=N_SAMPLES)


def _phases(sampled_walk: xr.Dataset) -> list[xr.Dataset]:
    key = 3 * sampled_walk.step.values + sampled_walk.phase.values
    cuts = np.r_[0, np.flatnonzero(np.diff(key)) + 1, key.size]
    return [sampled_walk.isel(time=slice(a, b)) for a, b in pairwise(cuts)]


def _integral(values: np.ndarray, time: np.ndarray) -> float:
    """Return Simpson's rule over equal intervals: an error of fourth order, some 1e-8 here."""
    h = (time[-1] - time[0]) / (time.size - 1)
    weights = np.ones(time.size)
    weights[1:-1:2], weights[2:-1:2] = 4.0, 2.0
    return float(h / 3.0 * np.sum(weights * values))


def _momentum(params: vrw.WheelParams, part: xr.Dataset) -> np.ndarray:
    motion = Motion.from_angle(
        *(jnp.asarray(part[name].values) for name in ("theta", "L1", "L2", "dtheta", "dL1", "dL2"))
    )
    return np.stack([np.asarray(p) for p in compute_momentum(params.symbols(), motion)])


def test_every_variable_has_unit_long_name_and_symbol(sampled_walk: xr.Dataset) -> None:
    assert set(sampled_walk.variables) == set(TRAJECTORY_MEASURES)
    for name, variable in sampled_walk.variables.items():
        assert variable.attrs["units"] == vrw.MEASURES[str(name)].unit
        assert variable.attrs["long_name"]
        assert variable.attrs["symbol"]
    assert sampled_walk.phase.attrs["flag_meanings"] == "DLS SLS-I SLS-II"


def test_a_trajectory_records_its_provenance(sampled_walk: xr.Dataset, tmp_path: Path) -> None:
    assert_netcdf_round_trip(sampled_walk, tmp_path)
    for key in ("versions", "device", "dtype", "solver", "rtol", "atol", "outcome", "start"):
        assert key in sampled_walk.attrs
    assert sampled_walk.attrs["parameter_damping"] == 200.0
    assert sampled_walk.attrs["outcome"] == "STEPPED"
    assert sampled_walk.attrs["n_steps"] == 3


def test_time_never_decreases_and_events_have_two_samples(sampled_walk: xr.Dataset) -> None:
    parts = _phases(sampled_walk)
    assert len(parts) == 9
    assert all(np.all(np.diff(part.time) > 0.0) for part in parts)
    for before, after in pairwise(parts):
        assert after.time[0] - before.time[-1] == pytest.approx(0.0, abs=1e-12)


def test_planted_feet_do_not_move(sampled_walk: xr.Dataset) -> None:
    for part in _phases(sampled_walk):
        feet = ["foot_1_x", "foot_1_z"]
        if part.phase[0] == 0:
            feet += ["foot_2_x", "foot_2_z"]
        for foot in feet:
            assert np.ptp(part[foot].values) < 1e-12
        assert np.all(part.foot_1_z == 0.0)


def test_the_next_foot_lands_one_step_length_ahead(sampled_walk: xr.Dataset) -> None:
    length = float(vrw.step(vrw.WheelParams(), STEADY_STATE).step_length)
    first = sampled_walk.isel(time=sampled_walk.step.values == 0)
    assert float(first.x[0] - first.foot_2_x[0]) == pytest.approx(length, abs=1e-9)
    landings = np.unique(sampled_walk.x.values)
    assert landings == pytest.approx(length * np.arange(3), abs=1e-7)


def test_the_hub_and_the_former_fore_foot_are_continuous_over_a_landing(
    sampled_walk: xr.Dataset,
) -> None:
    parts = _phases(sampled_walk)
    for before, after in ((parts[2], parts[3]), (parts[5], parts[6])):
        for old, new in (("hub_x", "hub_x"), ("hub_z", "hub_z"), ("foot_1_x", "foot_2_x")):
            assert float(after[new][0] - before[old][-1]) == pytest.approx(0.0, abs=1e-9)


def test_between_collisions_energy_falls_by_the_work_of_the_dampers(
    sampled_walk: xr.Dataset,
) -> None:
    params = vrw.WheelParams()
    for part in _phases(sampled_walk):
        energy_loss = float(part.total_energy[0] - part.total_energy[-1])
        rates = part.dL1.values**2 + part.dL2.values**2
        damper_work = _integral(float(params.damping) * rates, part.time.values)
        assert energy_loss == pytest.approx(damper_work, abs=1e-7)
        assert part.damping_power.values == pytest.approx(200.0 * rates, abs=1e-12)


def test_total_energy_jumps_only_in_the_two_collisions_and_by_their_losses(
    sampled_walk: xr.Dataset,
) -> None:
    collision_losses = vrw.step(vrw.WheelParams(), STEADY_STATE).energy
    parts = _phases(sampled_walk)
    jumps = [
        float(before.total_energy[-1] - after.total_energy[0]) for before, after in pairwise(parts)
    ]
    assert jumps[0::3] == pytest.approx([0.0] * 3, abs=1e-8)
    assert jumps[1::3] == pytest.approx([float(collision_losses.stopper)] * 3, abs=1e-7)
    assert jumps[2::3] == pytest.approx([float(collision_losses.landing)] * 2, abs=1e-6)


def test_ground_forces_and_weight_are_the_rate_of_total_momentum(sampled_walk: xr.Dataset) -> None:
    params = vrw.WheelParams()
    weight = float(params.hub_mass + 8.0 * params.leg_mass) * float(params.gravity)
    slope = float(params.slope)
    for part in _phases(sampled_walk):
        p = _momentum(params, part)
        pushes = (
            part.lambda_1.values + part.lambda_3.values + weight * np.sin(slope),
            part.lambda_2.values + part.lambda_4.values - weight * np.cos(slope),
        )
        for axis, push in enumerate(pushes):
            gained = p[axis, -1] - p[axis, 0]
            assert _integral(push, part.time.values) == pytest.approx(gained, abs=1e-7)


def test_the_trajectory_passes_through_the_section_states_of_the_return_map(
    sampled_walk: xr.Dataset,
) -> None:
    x = vrw.return_map(vrw.WheelParams(), STEADY_STATE)
    last = _phases(sampled_walk)[2].isel(time=-1)
    reached = [float(last[name]) for name in ("theta", "dtheta", "dL1")]
    assert reached == pytest.approx(np.asarray(x), abs=1e-9)


def test_a_failing_step_ends_the_trajectory_with_its_outcome() -> None:
    fall = vrw.simulate(vrw.WheelParams(), jnp.array([0.1, 2.0, -0.1]), 5, n_samples=N_SAMPLES)
    assert fall.attrs["outcome"] == vrw.Outcome.TOUCHDOWN_BEFORE_STOPPER.name
    assert fall.attrs["outcome_meaning"] == vrw.Outcome.TOUCHDOWN_BEFORE_STOPPER.meaning
    assert fall.attrs["n_steps"] == 0
    assert fall.sizes["time"] > 0
    assert all(np.all(np.isfinite(variable)) for variable in fall.variables.values())


def test_bad_input_gives_an_empty_trajectory_with_an_outcome() -> None:
    empty = vrw.simulate(vrw.WheelParams(), jnp.array([0.1, jnp.nan, -0.1]), 5, n_samples=N_SAMPLES)
    assert empty.attrs["outcome"] == vrw.Outcome.BAD_INPUT.name
    assert empty.sizes["time"] == 0


@pytest.mark.parametrize(
    ("choice", "sentence"),
    [({"n_steps": 0}, "at least 1"), ({"n_samples": 1}, "at least 2")],
)
def test_an_impossible_length_is_refused_in_one_sentence(
    choice: dict[str, int], sentence: str
) -> None:
    with pytest.raises(ValueError, match=sentence):
        vrw.simulate(vrw.WheelParams(), STEADY_STATE, **choice)


def test_the_rigid_wheel_is_simulated_by_the_same_function() -> None:
    model = vrw.RigidWheel()
    params = vrw.WheelParams(slope=0.1)  # at 0.30 its fore foot lifts off
    walk = vrw.simulate(params, model.compute_default_start(params), 2, model=model)
    assert walk.attrs["n_steps"] == 2
    assert np.all(walk.lambda_4 == 0.0)
    assert walk.L1.values == pytest.approx(float(params.locked_length), abs=1e-12)
    for part in _phases(walk):
        assert np.ptp(part.total_energy.values) < 1e-9
