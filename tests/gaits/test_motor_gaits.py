"""Gaits of a wheel with a motor on its hub, on level ground too."""

import math

import jax
import numpy as np
import pytest
from reference_code import five_coordinates

import vrw_jax as vrw

LEVEL = vrw.WheelParams(slope=0.0)
TORQUE = 47.23  # N m
LEVEL_GAIT = {"period": 0.85085, "dls_fraction": 0.5478, "speed": 0.8352}
"""Values of an independent code, rounded."""
WEIGHT = 18.0 * 9.81  # N


def find_gait(torque=TORQUE, params=LEVEL, **options):
    return vrw.limit_cycle(params, model=vrw.ViscoelasticWheel(hub_torque=torque), **options)


def test_a_motor_walks_on_level_ground_as_in_another_code():
    cycle = find_gait()
    for name, value in LEVEL_GAIT.items():
        assert abs(getattr(cycle, name) - value) < 5e-5
    params = five_coordinates.TABLE_1 | {"slope": 0.0, "hub_torque": lambda rate: TORQUE}
    reference = five_coordinates.step(params, np.asarray(cycle.section_state))
    np.testing.assert_allclose(reference["section_state"], cycle.section_state, atol=1e-11)
    np.testing.assert_allclose(reference["durations"], cycle.durations, atol=1e-10)


def test_gravity_and_motor_supply_what_impacts_and_dampers_take():
    for params, torque in ((LEVEL, TORQUE), (vrw.WheelParams(slope=0.1), 31.0)):
        cycle = find_gait(torque, params)
        step = vrw.step(params, cycle.section_state, model=vrw.ViscoelasticWheel(hub_torque=torque))
        lost = step.energy.landing + step.energy.stopper + step.energy.damping
        supplied = torque * math.pi / 4 + WEIGHT * math.sin(params.slope) * cycle.step_length
        assert abs(lost - supplied) < 1e-8


def test_a_motor_without_torque_has_the_gait_of_the_paper():
    cycle, expected = find_gait(0.0, vrw.WheelParams()), vrw.limit_cycle(vrw.WheelParams())
    for name in ("section_state", "durations", "multipliers"):
        np.testing.assert_allclose(getattr(cycle, name), getattr(expected, name), atol=2e-10)


def test_derivatives_of_gaits_by_the_torque_are_differences():
    gradient = jax.grad(lambda torque: find_gait(torque).period)(TORQUE)
    measure_period = lambda torque: find_gait(torque[0]).period[None]
    difference = five_coordinates.jacobian(measure_period, np.array([TORQUE]))[0, 0]
    np.testing.assert_allclose(gradient, difference, rtol=1e-6)
    cycles = vrw.limit_cycles(
        LEVEL, model=vrw.ViscoelasticWheel(hub_torque=np.array([TORQUE, -1.0]))
    )
    assert cycles.found.tolist() == [True, False]


@pytest.mark.slow
def test_without_slope_and_torque_no_gait_can_exist():
    for torque in (0.0, -1.0):
        assert "No steady gait can exist: the slope is 0 rad" in find_gait(torque).why
    assert "No steady gait can exist" not in find_gait(1.0).why


@pytest.mark.slow
def test_a_branch_and_a_scan_along_the_torque_have_gaits_of_their_torques():
    model = vrw.ViscoelasticWheel(hub_torque=TORQUE)
    branch = vrw.continue_branch(LEVEL, "hub.torque", (44.0, 50.0), model=model)
    scan = vrw.scan(
        vrw.grid({"hub.torque": branch.values[[0, -1]]}), ["period"], base=LEVEL, model=model
    )
    np.testing.assert_allclose(scan.period, branch.dataset.period.values[[0, -1]], atol=1e-9)
    np.testing.assert_allclose(scan.period[0], find_gait(branch.values[0]).period, atol=1e-10)
    assert branch.dataset["hub.torque"].attrs["units"] == "N m"


@pytest.mark.slow
def test_studies_of_gaits_know_the_motor():
    model = vrw.ViscoelasticWheel(hub_torque=TORQUE)
    table = vrw.sensitivities(LEVEL, measures=["speed"], model=model)
    measure_speed = lambda torque: find_gait(torque[0]).speed[None]
    difference = five_coordinates.jacobian(measure_speed, np.array([TORQUE]))[0, 0]
    by_torque = table.derivative.sel(measure="speed", parameter="hub.torque")
    np.testing.assert_allclose(by_torque, difference, rtol=1e-6)
    bounds = {"hub.torque": (45.0, 48.0)}
    tuned = vrw.tune(LEVEL, "speed", ["hub.torque"], bounds, {}, model=model)
    assert float(tuned.model.hub_torque.torque) == 48.0
    start = {"theta_post_impact": -0.686, "dtheta_post_impact": [1.046]}
    assert vrw.basin(LEVEL, start, model=model).attractor.values.tolist() == [0]
