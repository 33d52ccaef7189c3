"""Starts are classified by their end: the orbit that attracts them, or their fall."""

import numpy as np
import pytest
from support.files import assert_netcdf_round_trip

import vrw_jax as vrw
from vrw_jax.gaits.gait_walks import PeriodicWalkEnds, find_distinct_orbits
from vrw_jax.models import POST_LANDING_COMPONENT_NAMES, PRE_TOUCHDOWN_COMPONENT_NAMES
from vrw_jax.plot import basin_figure

OPTIONS = vrw.StepOptions(rtol=1e-9, atol=1e-9)


def basin_at(damping, **extra_values):
    grid = {
        "theta_touchdown": 0.1,
        "dtheta_touchdown": np.linspace(0.8, 2.8, 6),
        "dL1_touchdown": np.linspace(-0.6, 0.2, 4),
    }
    return vrw.basin(vrw.WheelParams(damping=damping), grid, options=OPTIONS, **extra_values)


@pytest.fixture(scope="module")
def basins():
    return {damping: basin_at(damping) for damping in (100.0, 200.0, 221.0)}


def test_the_attractor_is_the_limit_cycle(basins):
    for damping in (100.0, 200.0):
        result = basins[damping]
        assert result.orbit_period.values.tolist() == [1]
        gait = vrw.limit_cycle(vrw.WheelParams(damping=damping))
        np.testing.assert_allclose(result.orbit_state[0, 0], gait.section_state, atol=1e-6)


def test_the_basin_at_200_is_far_smaller_than_at_100(basins):
    assert np.mean(basins[100.0].attractor == 0) > 0.9
    assert np.mean(basins[200.0].attractor == 0) < 0.6  # half of the 24 starts, one at its edge


def test_a_fast_start_at_200_touches_down_before_the_stopper(basins):
    fast = basins[200.0].sel(dtheta_touchdown=2.0, method="nearest").isel(dL1_touchdown=-1)
    assert int(fast.outcome) == vrw.Outcome.TOUCHDOWN_BEFORE_STOPPER
    assert int(fast.attractor) == -1


def test_each_start_has_one_ending(basins, tmp_path):
    assert_netcdf_round_trip(basins[100.0], tmp_path)
    for result in basins.values():
        walks = result.outcome.values == vrw.Outcome.STEPPED
        assert np.array_equal(walks, result.attractor.values >= 0)


def test_beyond_the_discontinuity_five_steps_attract_one_of_them_without_dls(basins):
    result = basins[221.0]
    assert result.orbit_period.values.tolist() == [5]
    states = result.orbit_state.values[0, :5]
    lifts = [
        float(vrw.step(vrw.WheelParams(damping=221.0), x, options=OPTIONS).durations[0]) == 0.0
        for x in states
    ]
    assert sum(lifts) == 1


def test_starts_after_a_landing_reach_the_attractors_of_the_starts_before_it():
    params = vrw.WheelParams(damping=200.0)
    gait = vrw.limit_cycle(params)
    theta, dtheta = (float(v) for v in gait.post_impact)
    grid = {"theta_post_impact": [theta, -0.2], "dtheta_post_impact": [dtheta]}
    result = vrw.basin(params, grid, options=OPTIONS)
    assert result.attractor.values[0, 0] == 0
    assert result.steps.values[0, 0] <= 1
    assert vrw.basin(params, grid, max_steps=2, options=OPTIONS).steps.max() == 2
    assert set(result.coords) >= set(POST_LANDING_COMPONENT_NAMES)
    assert not set(result.coords) & set(PRE_TOUCHDOWN_COMPONENT_NAMES)


def test_orbits_do_not_depend_on_their_first_step():
    orbit = np.full((3, 4, 3), np.nan)
    orbit[0, :2] = [[0.1, 1.0, 0.0], [0.1, 1.5, 0.0]]
    orbit[1, :2] = orbit[0, :2] + 1e-6
    orbit[2, :1] = [[0.1, 1.2, 0.0]]
    settled = PeriodicWalkEnds(np.zeros(3, int), np.array([2, 2, 1]), np.zeros(3, int), orbit)
    orbit_indices, orbit_states = find_distinct_orbits(settled)
    assert orbit_indices.tolist() == [0, 0, 1]
    assert [len(o) for o in orbit_states] == [2, 1]


def test_an_incomplete_grid_is_refused_with_the_missing_names():
    with pytest.raises(ValueError, match="must contain all of"):
        vrw.basin(vrw.WheelParams(), {"theta_touchdown": 0.1})


def test_a_basin_can_be_drawn(basins):
    figure = basin_figure([basins[100.0], basins[200.0]], ["a", "b"])
    assert len(figure.axes) == 3


@pytest.mark.slow
def test_unilateral_starts_reach_the_slow_or_the_fast_gait():
    params, ground = vrw.WheelParams(damping=300.0), vrw.UnilateralWheel(friction=0.7)
    grid = {"theta_touchdown": 0.1, "dtheta_touchdown": [0.3, 1.6, 2.6], "dL1_touchdown": -0.1}
    solution = vrw.basin(params, grid, model=ground, options=OPTIONS)
    gaits = vrw.limit_cycles(params, model=ground)
    for start, gait in ((1, 0), (2, 1)):
        orbit = solution.orbit_state[int(solution.attractor[start]), 0]
        np.testing.assert_allclose(orbit, gaits.section_state[gait], atol=1e-5)
    shares = solution.orbit_dls_fraction.values[solution.attractor.values[1:]]
    np.testing.assert_allclose(shares, gaits.dls_fraction, atol=1e-6)
    # "auto" uses unilateral contact, whose starts may lie anywhere.
    second_result = vrw.basin(params, grid, model=vrw.LadderWheel(friction=0.7), options=OPTIONS)
    np.testing.assert_array_equal(second_result.attractor, solution.attractor)
