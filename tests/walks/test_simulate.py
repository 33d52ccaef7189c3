"""Trajectories: what is planted stands, what is lost was dissipated, forces are momentum's."""

from itertools import pairwise
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr
from support.files import kept_by_netcdf

import vrw_jax as vrw
from vrw_jax.results.measures import MEASURES, TRAJECTORY
from vrw_jax.wheel.dynamics import momentum
from vrw_jax.wheel.geometry import Motion

N_SAMPLES = 1001
STEADY = jnp.array([0.102726965088900357, 1.61345343427543820, -0.109037270])
"""Near the gait of Table 1: `tests/oracle/truth.json`, first case, rounded."""


@pytest.fixture(scope="module")
def walk() -> xr.Dataset:
    return vrw.simulate(vrw.WheelParams(), STEADY, 3, n_samples=N_SAMPLES)


def _phases(walk: xr.Dataset) -> list[xr.Dataset]:
    key = 3 * walk.step.values + walk.phase.values
    cuts = np.r_[0, np.flatnonzero(np.diff(key)) + 1, key.size]
    return [walk.isel(time=slice(a, b)) for a, b in pairwise(cuts)]


def _integral(values: np.ndarray, time: np.ndarray) -> float:
    """Simpson's rule over equal intervals: error of fourth order, some 1e-8 here."""
    h = (time[-1] - time[0]) / (time.size - 1)
    weights = np.ones(time.size)
    weights[1:-1:2], weights[2:-1:2] = 4.0, 2.0
    return float(h / 3.0 * np.sum(weights * values))


def _momentum(params: vrw.WheelParams, part: xr.Dataset) -> np.ndarray:
    motion = Motion.of(
        *(jnp.asarray(part[name].values) for name in ("theta", "L1", "L2", "dtheta", "dL1", "dL2"))
    )
    return np.stack([np.asarray(p) for p in momentum(params.symbols(), motion)])


def test_every_variable_has_unit_long_name_and_symbol(walk: xr.Dataset) -> None:
    assert set(walk.variables) == set(TRAJECTORY)
    for name, variable in walk.variables.items():
        assert variable.attrs["units"] == MEASURES[str(name)].unit
        assert variable.attrs["long_name"]
        assert variable.attrs["symbol"]
    assert walk.phase.attrs["flag_meanings"] == "DLS SLS-I SLS-II"


def test_a_trajectory_says_where_it_comes_from(walk: xr.Dataset, tmp_path: Path) -> None:
    kept_by_netcdf(walk, tmp_path)
    for key in ("versions", "device", "dtype", "solver", "rtol", "atol", "outcome", "start"):
        assert key in walk.attrs
    assert walk.attrs["parameter_damping"] == 200.0
    assert walk.attrs["outcome"] == "STEPPED"
    assert walk.attrs["n_steps"] == 3


def test_time_never_runs_back_and_events_stand_twice(walk: xr.Dataset) -> None:
    parts = _phases(walk)
    assert len(parts) == 9
    assert all(np.all(np.diff(part.time) > 0.0) for part in parts)
    for before, after in pairwise(parts):
        assert after.time[0] - before.time[-1] == pytest.approx(0.0, abs=1e-12)


def test_planted_feet_do_not_move(walk: xr.Dataset) -> None:
    for part in _phases(walk):
        feet = ["foot_1_x", "foot_1_z"]
        if part.phase[0] == 0:
            feet += ["foot_2_x", "foot_2_z"]
        for foot in feet:
            assert np.ptp(part[foot].values) < 1e-12
        assert np.all(part.foot_1_z == 0.0)


def test_the_next_foot_lands_one_step_length_ahead(walk: xr.Dataset) -> None:
    length = float(vrw.step(vrw.WheelParams(), STEADY).step_length)
    first = walk.isel(time=walk.step.values == 0)
    assert float(first.x[0] - first.foot_2_x[0]) == pytest.approx(length, abs=1e-9)
    landings = np.unique(walk.x.values)
    assert landings == pytest.approx(length * np.arange(3), abs=1e-7)


def test_the_hub_and_the_former_fore_foot_are_continuous_over_a_landing(walk: xr.Dataset) -> None:
    parts = _phases(walk)
    for before, after in ((parts[2], parts[3]), (parts[5], parts[6])):
        for old, new in (("hub_x", "hub_x"), ("hub_z", "hub_z"), ("foot_1_x", "foot_2_x")):
            assert float(after[new][0] - before[old][-1]) == pytest.approx(0.0, abs=1e-9)


def test_between_collisions_energy_falls_by_what_the_dampers_take(walk: xr.Dataset) -> None:
    params = vrw.WheelParams()
    for part in _phases(walk):
        lost = float(part.total_energy[0] - part.total_energy[-1])
        rates = part.dL1.values**2 + part.dL2.values**2
        taken = _integral(float(params.damping) * rates, part.time.values)
        assert lost == pytest.approx(taken, abs=1e-7)
        assert part.damping_power.values == pytest.approx(200.0 * rates, abs=1e-12)


def test_total_energy_jumps_only_in_the_two_collisions_and_by_their_losses(
    walk: xr.Dataset,
) -> None:
    lost = vrw.step(vrw.WheelParams(), STEADY).energy
    parts = _phases(walk)
    jumps = [
        float(before.total_energy[-1] - after.total_energy[0]) for before, after in pairwise(parts)
    ]
    assert jumps[0::3] == pytest.approx([0.0] * 3, abs=1e-8)
    assert jumps[1::3] == pytest.approx([float(lost.stopper)] * 3, abs=1e-7)
    assert jumps[2::3] == pytest.approx([float(lost.landing)] * 2, abs=1e-6)


def test_ground_forces_and_weight_are_the_rate_of_total_momentum(walk: xr.Dataset) -> None:
    params = vrw.WheelParams()
    weight = float(params.hub_mass + 8.0 * params.leg_mass) * float(params.gravity)
    slope = float(params.slope)
    for part in _phases(walk):
        p = _momentum(params, part)
        pushes = (
            part.lambda_1.values + part.lambda_3.values + weight * np.sin(slope),
            part.lambda_2.values + part.lambda_4.values - weight * np.cos(slope),
        )
        for axis, push in enumerate(pushes):
            gained = p[axis, -1] - p[axis, 0]
            assert _integral(push, part.time.values) == pytest.approx(gained, abs=1e-7)


def test_the_trajectory_passes_through_the_section_states_of_the_return_map(
    walk: xr.Dataset,
) -> None:
    x = vrw.return_map(vrw.WheelParams(), STEADY)
    last = _phases(walk)[2].isel(time=-1)
    reached = [float(last[name]) for name in ("theta", "dtheta", "dL1")]
    assert reached == pytest.approx(np.asarray(x), abs=1e-9)


def test_a_failing_step_ends_the_trajectory_with_its_outcome() -> None:
    fall = vrw.simulate(vrw.WheelParams(), jnp.array([0.1, 2.0, -0.1]), 5, n_samples=N_SAMPLES)
    assert fall.attrs["outcome"] == vrw.Outcome.TOUCHDOWN_BEFORE_STOPPER.name
    assert fall.attrs["outcome_meaning"] == vrw.Outcome.TOUCHDOWN_BEFORE_STOPPER.meaning
    assert fall.attrs["n_steps"] == 0
    assert fall.sizes["time"] > 0
    assert all(np.all(np.isfinite(variable)) for variable in fall.variables.values())


def test_bad_input_gives_an_empty_trajectory_that_says_so() -> None:
    empty = vrw.simulate(vrw.WheelParams(), jnp.array([0.1, jnp.nan, -0.1]), 5, n_samples=N_SAMPLES)
    assert empty.attrs["outcome"] == vrw.Outcome.BAD_INPUT.name
    assert empty.sizes["time"] == 0


@pytest.mark.parametrize(
    ("choice", "sentence"),
    [({"n_steps": 0}, "at least 1"), ({"n_samples": 1}, "at least 2")],
)
def test_an_impossible_length_is_refused_in_a_sentence(
    choice: dict[str, int], sentence: str
) -> None:
    with pytest.raises(ValueError, match=sentence):
        vrw.simulate(vrw.WheelParams(), STEADY, **choice)


def test_the_rigid_wheel_walks_through_the_same_door() -> None:
    model = vrw.RigidWheel()
    params = vrw.WheelParams(slope=0.1)  # at 0.30 its fore foot lifts off
    walk = vrw.simulate(params, model.start(params), 2, model=model)
    assert walk.attrs["n_steps"] == 2
    assert np.all(walk.lambda_4 == 0.0)
    assert walk.L1.values == pytest.approx(float(params.locked_length), abs=1e-12)
    for part in _phases(walk):
        assert np.ptp(part.total_energy.values) < 1e-9
