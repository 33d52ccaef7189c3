"""Monitors and forces against Newton's law on the point masses, from the independent oracle."""

import functools

import jax
import numpy as np
import pytest
from oracle import five_coordinates
from support import truth
from support.batched import NAMES, full_steps, wheels_like

import vrw_jax as vrw

CASES = (0, 1, 5)  # Table 1; c = 100, where foot 2 scuffs; a heavy-legged, softly damped wheel


@pytest.mark.parametrize("by_lanes", [False, True], ids=["wheel", "lanes"])
@pytest.mark.parametrize("index", CASES, ids=lambda i: truth.CASES[i]["name"])
def test_every_margin_is_that_of_the_oracle(index, by_lanes):
    params = {k: float(v) for k, v in truth.CASES[index]["params"].items()}
    params["n_legs"] = int(params["n_legs"])
    start = truth.table("step", "start")[index]
    found = full_steps(truth.PARAMETERS[index], start, vrw.Options.tight(), by_lanes=by_lanes)
    found = jax.tree.map(lambda leaf: np.asarray(leaf[0]), found)
    m = found.monitors
    oracle = five_coordinates.monitors(params, start)
    least_fore = min(oracle["lambda2"].values())
    # The oracle reads minima off a dense trajectory: a few 1e-7 of the largest term near a minimum.
    near = {"rtol": 2e-6, "atol": 2e-6}
    np.testing.assert_allclose(m.fore_foot_force, least_fore, **near)
    np.testing.assert_allclose(m.clearance_sls1, oracle["foot2_clearance_sls1"], **near)
    np.testing.assert_allclose(m.clearance_sls2, oracle["foot2_clearance_sls2"], **near)
    np.testing.assert_allclose(m.locked_stopper_force, oracle["stopper_force_legs"], **near)
    np.testing.assert_allclose(m.rear_stopper_force, oracle["stopper_force_leg2"], **near)
    np.testing.assert_allclose(m.contraction, oracle["shortening"], **near)
    np.testing.assert_allclose(1.0 - m.friction_fore, oracle["friction_leg1"], **near)
    # Algebra of an instant: the error of the states there.
    exact = {"rtol": 1e-9, "atol": 1e-10}
    np.testing.assert_allclose(m.takeoff_acceleration, oracle["takeoff_acceleration"], **exact)
    np.testing.assert_allclose(1.0 - m.friction_rear, oracle["friction_leg2_landing"], **exact)
    np.testing.assert_allclose(
        m.landing_stopper_impulse, oracle["stopper_impulse_landing"], **exact
    )
    np.testing.assert_allclose(m.hit_stopper_impulse, oracle["stopper_impulse_stopper"], **exact)
    np.testing.assert_allclose(m.hit_planted_impulse, oracle["normal_impulse_stopper"], **exact)
    np.testing.assert_allclose(
        1.0 - m.landing_friction_fore, oracle["impulse_friction_leg1"], **exact
    )
    np.testing.assert_allclose(
        1.0 - m.landing_friction_rear, oracle["impulse_friction_leg2"], **exact
    )


def test_energy_losses_are_those_of_the_oracle():
    start = truth.table("step", "start")[0]
    oracle = five_coordinates.step(five_coordinates.TABLE_1, start)
    found = full_steps(truth.PARAMETERS[0], start, vrw.Options.tight())
    for ours, theirs in [
        (found.energy.landing, "energy_lost_landing"),
        (found.energy.stopper, "energy_lost_stopper"),
        (found.energy.damping, "energy_lost_damping"),
    ]:
        np.testing.assert_allclose(ours[0], oracle[theirs], rtol=1e-9, atol=1e-10)


def test_the_oracles_own_step_agrees():
    for index in CASES:
        params = {k: float(v) for k, v in truth.CASES[index]["params"].items()}
        params["n_legs"] = int(params["n_legs"])
        start = truth.table("step", "start")[index]
        oracle = five_coordinates.step(params, start)
        found = full_steps(truth.PARAMETERS[index], start, vrw.Options.tight())
        np.testing.assert_allclose(found.section_state[0], oracle["section_state"], atol=1e-11)
        np.testing.assert_allclose(found.durations[0], oracle["durations"], atol=1e-11)


def agrees_with_oracle(vector, start):
    """Same outcome, durations and next state, whichever branch of Section 5.1 was taken."""
    params = dict(zip(NAMES, map(float, vector), strict=True)) | {"n_legs": 8}
    oracle = five_coordinates.step(params, start)
    found = jax.tree.map(lambda leaf: leaf[0], full_steps(vector, start, vrw.Options.tight()))
    assert oracle["outcome"] == five_coordinates.STEPPED
    assert int(found.outcome) == vrw.Outcome.STEPPED
    np.testing.assert_allclose(found.durations, oracle["durations"], atol=1e-10)
    np.testing.assert_allclose(found.section_state, oracle["section_state"], atol=1e-10)
    return found


def test_a_landing_that_would_pull_the_rear_foot_frees_it():
    # (A3): Leg 1 extends before the landing.
    vector = wheels_like(damping=60.0, slope=0.23)[0]
    found = agrees_with_oracle(vector, np.array([0.34, 1.35, 1.14]))
    assert float(found.indicators.lambda_I4) < 0.0
    assert float(found.durations[0]) == 0.0


def test_a_rear_foot_without_load_after_the_landing_skips_double_support():
    # (B3): the impulse holds the rear foot, the damper then pulls it up.
    vector = wheels_like(damping=225.0, slope=0.39)[0]
    found = agrees_with_oracle(vector, np.array([0.34, 1.63, -0.43]))
    assert float(found.indicators.lambda_I4) > 0.0
    assert float(found.indicators.lambda_4) < 0.0
    assert float(found.durations[0]) == 0.0


def test_lanes_tell_all_of_a_step_that_the_wheel_does():
    # Gaits, steps without double support (A3, B3), falls and a bad wheel, side by side.
    vectors = wheels_like(
        damping=[200.0, 60.0, 225.0, 100.0, -1.0, 160.0],
        slope=[0.30, 0.23, 0.39, 0.09, 0.30, 0.30],
    )
    starts = np.array(
        [[0.1027, 2.0, -0.109], [0.34, 1.35, 1.14], [0.34, 1.63, -0.43], [0.1027, 1.2, -0.109],
         [0.1027, 2.0, -0.109], [0.1027, 1.8, -0.1]]
    )  # fmt: skip
    wheel, lanes = (full_steps(vectors, starts, by_lanes=way) for way in (False, True))
    assert len(set(map(int, wheel.outcome))) == 3
    for place, one in jax.tree_util.tree_leaves_with_path(wheel):
        if "solver_steps" not in jax.tree_util.keystr(place):
            other = functools.reduce(lambda tree, key: getattr(tree, key.name), place, lanes)
            # Both engines' errors at the default tolerances; friction is a ratio of forces.
            np.testing.assert_allclose(other, one, rtol=1e-8, atol=1e-8, err_msg=str(place))


def test_a_lane_s_monitors_are_bitwise_its_own_in_any_company_and_alone():
    rng = np.random.default_rng(1)
    vectors = wheels_like(damping=rng.uniform(100.0, 215.0, 16))
    starts = np.array([0.1027, 2.0, -0.109]) * rng.uniform(0.95, 1.05, (16, 1))
    whole = full_steps(vectors, starts, by_lanes=True)
    order = rng.permutation(16)
    for some in (order[:7], *order[7:, None]):
        part = full_steps(vectors[some], starts[some], by_lanes=True)
        for a, b in zip(jax.tree.leaves(part), jax.tree.leaves(whole), strict=True):
            np.testing.assert_array_equal(a, np.asarray(b)[some])
