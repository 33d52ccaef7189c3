"""Margins and forces agree with Newton's law on the point masses, by the independent reference."""

import functools

import jax
import numpy as np
import pytest
from reference_code import five_coordinates
from support import reference_values
from support.batched import NAMES, compute_full_steps, make_parameter_rows
from support.slow_variants import mark_slow

import vrw_jax as vrw

CASE_INDICES = (0, 1, 5)
"""Table 1; c = 100, where foot 2 scuffs; a heavy-legged, softly damped wheel."""


@functools.cache  # Both engines are compared with it.
def compute_reference_margins(index):
    params = {k: float(v) for k, v in reference_values.REFERENCE_CASES[index]["params"].items()}
    params["n_legs"] = int(params["n_legs"])
    return five_coordinates.step_margins(
        params, reference_values.stack_quantity("step", "start")[index]
    )


PARAMETRIZE_BY_ENGINE = pytest.mark.parametrize(
    "by_lanes", [*mark_slow(False), True], ids=["wheel", "lanes"]
)


@PARAMETRIZE_BY_ENGINE
@pytest.mark.parametrize(
    "index",
    [*mark_slow(0, 1), 5],
    ids=lambda i: reference_values.REFERENCE_CASES[i]["name"],
)
def test_every_margin_equals_the_reference(index, by_lanes):
    solution = compute_full_steps(
        reference_values.REFERENCE_PARAMETERS[index],
        reference_values.stack_quantity("step", "start")[index],
        vrw.StepOptions.tight(),
        uses_lane_engine=by_lanes,
    )
    solution = jax.tree.map(lambda leaf: np.asarray(leaf[0]), solution)
    m = solution.margins
    reference = compute_reference_margins(index)
    least_fore = min(reference["lambda2"].values())
    # The reference takes minima of samples: errors of a few 1e-7 of the largest term.
    near = {"rtol": 2e-6, "atol": 2e-6}
    np.testing.assert_allclose(m.fore_foot_force, least_fore, **near)
    np.testing.assert_allclose(m.clearance_sls1, reference["foot2_clearance_sls1"], **near)
    np.testing.assert_allclose(m.clearance_sls2, reference["foot2_clearance_sls2"], **near)
    np.testing.assert_allclose(m.locked_stopper_force, reference["stopper_force_legs"], **near)
    np.testing.assert_allclose(m.rear_stopper_force, reference["stopper_force_leg2"], **near)
    np.testing.assert_allclose(m.contraction, reference["shortening"], **near)
    np.testing.assert_allclose(1.0 - m.friction_fore, reference["friction_leg1"], **near)
    # Algebra of an instant: the error of the states there.
    exact = {"rtol": 1e-9, "atol": 1e-10}
    np.testing.assert_allclose(m.takeoff_acceleration, reference["takeoff_acceleration"], **exact)
    np.testing.assert_allclose(1.0 - m.friction_rear, reference["friction_leg2_landing"], **exact)
    np.testing.assert_allclose(
        m.landing_stopper_impulse, reference["stopper_impulse_landing"], **exact
    )
    np.testing.assert_allclose(m.hit_stopper_impulse, reference["stopper_impulse_stopper"], **exact)
    np.testing.assert_allclose(m.hit_planted_impulse, reference["normal_impulse_stopper"], **exact)
    np.testing.assert_allclose(
        1.0 - m.landing_friction_fore, reference["impulse_friction_leg1"], **exact
    )
    np.testing.assert_allclose(
        1.0 - m.landing_friction_rear, reference["impulse_friction_leg2"], **exact
    )
    stopper_ratio = reference["impulse_friction_stopper"]
    expected = {
        "fore": reference["friction_leg1"],
        "rear": reference["friction_leg2_landing"],
        "landing_fore": reference["impulse_friction_leg1"],
        "landing_rear": reference["impulse_friction_leg2"],
        "stopper": stopper_ratio if stopper_ratio > 0.0 else np.inf,
    }
    needed = {name: getattr(solution.required_friction, name) for name in expected}
    # The impulses of collision II are 1e-4 of the momenta from whose difference they follow.
    rounded = {"fore": near, "stopper": {"rtol": 1e-6}}
    for name, value in expected.items():
        np.testing.assert_allclose(needed[name], value, **rounded.get(name, exact), err_msg=name)
    assert solution.required_friction.largest == max(list(needed.values())[:4])


def test_the_required_friction_of_table_1_is_that_of_the_rear_foot_just_after_the_landing():
    """14.2, and 9.7 and 1.10 in the landing: the independent code's numbers."""
    wheel = vrw.WheelParams()
    x = vrw.limit_cycle(wheel).section_state
    step = vrw.step(wheel, x, model=vrw.ViscoelasticWheel(friction=0.4))
    measures = step.measures()
    assert abs(measures["required_friction"] - 14.2) < 0.05
    assert measures["required_friction"] == measures["required_friction_rear"]
    assert abs(measures["required_friction_fore"] - 0.61) < 0.005
    assert abs(measures["required_friction_landing_fore"] - 1.10) < 0.005
    assert abs(measures["required_friction_landing_rear"] - 9.7) < 0.05
    for margin, part in (("friction_fore", "fore"), ("friction_rear", "rear"),
                         ("landing_friction_rear", "landing_rear")):  # fmt: skip
        assert measures[margin] == 0.4 - measures[f"required_friction_{part}"]
    # In collision II the ground would have to pull, so no friction holds the foot.
    assert step.margins.hit_planted_impulse < 0.0
    assert measures["required_friction_stopper"] == np.inf


@PARAMETRIZE_BY_ENGINE
def test_energy_losses_equal_the_reference(by_lanes):
    start = reference_values.stack_quantity("step", "start")[0]
    reference = five_coordinates.step(five_coordinates.TABLE_1, start)
    solution = compute_full_steps(
        reference_values.REFERENCE_PARAMETERS[0],
        start,
        vrw.StepOptions.tight(),
        uses_lane_engine=by_lanes,
    )
    for ours, theirs in [
        (solution.energy.landing, "energy_lost_landing"),
        (solution.energy.stopper, "energy_lost_stopper"),
        (solution.energy.damping, "energy_lost_damping"),
    ]:
        np.testing.assert_allclose(ours[0], reference[theirs], rtol=1e-9, atol=1e-10)


@PARAMETRIZE_BY_ENGINE
def test_the_step_of_the_reference_code_agrees(by_lanes):
    for index in CASE_INDICES:
        params = {k: float(v) for k, v in reference_values.REFERENCE_CASES[index]["params"].items()}
        params["n_legs"] = int(params["n_legs"])
        start = reference_values.stack_quantity("step", "start")[index]
        reference = five_coordinates.step(params, start)
        solution = compute_full_steps(
            reference_values.REFERENCE_PARAMETERS[index],
            start,
            vrw.StepOptions.tight(),
            uses_lane_engine=by_lanes,
        )
        np.testing.assert_allclose(
            solution.section_state[0], reference["section_state"], atol=1e-11
        )
        np.testing.assert_allclose(solution.durations[0], reference["durations"], atol=1e-11)


def assert_agrees_with_reference(vector, start, by_lanes):
    """Require the same outcome, durations and next state, for every branch of Section 5.1."""
    params = dict(zip(NAMES, map(float, vector), strict=True)) | {"n_legs": 8}
    reference = five_coordinates.step(params, start)
    steps = compute_full_steps(vector, start, vrw.StepOptions.tight(), uses_lane_engine=by_lanes)
    solution = jax.tree.map(lambda leaf: leaf[0], steps)
    assert reference["outcome"] == five_coordinates.STEPPED
    assert int(solution.outcome) == vrw.Outcome.STEPPED
    np.testing.assert_allclose(solution.durations, reference["durations"], atol=1e-10)
    np.testing.assert_allclose(solution.section_state, reference["section_state"], atol=1e-10)
    return solution


@PARAMETRIZE_BY_ENGINE
def test_a_landing_that_would_pull_the_rear_foot_frees_it(by_lanes):
    # (A3): Leg 1 extends before the landing.
    vector = make_parameter_rows(damping=60.0, slope=0.23)[0]
    solution = assert_agrees_with_reference(vector, np.array([0.34, 1.35, 1.14]), by_lanes)
    assert float(solution.indicators.lambda_I4) < 0.0
    assert float(solution.durations[0]) == 0.0


@PARAMETRIZE_BY_ENGINE
def test_a_rear_foot_without_load_after_the_landing_skips_double_support(by_lanes):
    # (B3): the impulse holds the rear foot, the damper then pulls it up.
    vector = make_parameter_rows(damping=225.0, slope=0.39)[0]
    solution = assert_agrees_with_reference(vector, np.array([0.34, 1.63, -0.43]), by_lanes)
    assert float(solution.indicators.lambda_I4) > 0.0
    assert float(solution.indicators.lambda_4) < 0.0
    assert float(solution.durations[0]) == 0.0


@pytest.mark.slow
def test_batches_have_all_measures_of_a_single_step():
    # Gaits, steps without double support (A3, B3), falls and a bad wheel, side by side.
    parameter_rows = make_parameter_rows(
        damping=[200.0, 60.0, 225.0, 100.0, -1.0, 160.0],
        slope=[0.30, 0.23, 0.39, 0.09, 0.30, 0.30],
    )
    starts = np.array(
        [[0.1027, 2.0, -0.109], [0.34, 1.35, 1.14], [0.34, 1.63, -0.43], [0.1027, 1.2, -0.109],
         [0.1027, 2.0, -0.109], [0.1027, 1.8, -0.1]]
    )  # fmt: skip
    wheel, lanes = (
        compute_full_steps(parameter_rows, starts, uses_lane_engine=method_name)
        for method_name in (False, True)
    )
    assert len(set(map(int, wheel.outcome))) == 3
    for place, one in jax.tree_util.tree_leaves_with_path(wheel):
        if "solver_steps" not in jax.tree_util.keystr(place):
            other = functools.reduce(lambda tree, key: getattr(tree, key.name), place, lanes)
            # Both engines' errors at the default tolerances; friction is a ratio of forces.
            np.testing.assert_allclose(other, one, rtol=1e-8, atol=1e-8, err_msg=str(place))


def test_margins_of_a_batch_element_are_bitwise_those_of_the_single_wheel():
    rng = np.random.default_rng(1)
    parameter_rows = make_parameter_rows(damping=rng.uniform(100.0, 215.0, 16))
    starts = np.array([0.1027, 2.0, -0.109]) * rng.uniform(0.95, 1.05, (16, 1))
    full_values = compute_full_steps(parameter_rows, starts, uses_lane_engine=True)
    order = rng.permutation(16)
    for selection in (order[:7], *order[7:, None]):
        part = compute_full_steps(
            parameter_rows[selection], starts[selection], uses_lane_engine=True
        )
        for a, b in zip(jax.tree.leaves(part), jax.tree.leaves(full_values), strict=True):
            np.testing.assert_array_equal(a, np.asarray(b)[selection])
