"""Answers to within a tolerance: by which rung, how wrong, and what is refused."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vrw_jax as vrw

TABLE_1 = vrw.WheelParams(damping=150.0)
NEAR = vrw.WheelParams(damping=jnp.linspace(120.0, 200.0, 24))
FRICTIONS = np.geomspace(8.0, 80.0, 24)


@pytest.fixture(scope="module")
def exact():
    """What the iteration on real ground converges to, as the truth of looser answers."""
    return vrw.answer(["speed", "dls_fraction", "period"], NEAR, 1e-10, friction=FRICTIONS)


def test_where_feet_can_not_slide_the_papers_value_stands():
    told = vrw.answer("speed", TABLE_1, 1e-6, friction=math.inf)
    assert told.rung == "viscoelastic"
    assert abs(told.value - float(vrw.limit_cycle(TABLE_1).speed)) < 1e-8
    assert told.error <= 1e-6
    assert abs(told.model_error) < 1e-8


def test_a_converged_answer_repeats_on_real_ground():
    names = ["theta_touchdown", "dtheta_touchdown", "dL1_touchdown"]
    told = vrw.answer(names, TABLE_1, 1e-9, friction=20.0)
    assert told.rung == "unilateral"
    x = np.array([[told.value[name] for name in names]])
    step = vrw.steps(TABLE_1, x, model=vrw.UnilateralWheel(friction=20.0))
    assert np.max(np.abs(np.asarray(step.section_state)[0, [0, 1, 12]] - x[0])) < 1e-8


@pytest.mark.parametrize("tol", [1e-2, 1e-3, 1e-5])
def test_answers_keep_their_stated_errors(tol, exact):
    told = vrw.answer(["speed", "dls_fraction", "period"], NEAR, tol, friction=FRICTIONS)
    assert np.all(told.found)
    assert np.all(exact.found)
    assert np.all(told.errors <= tol)
    wrong = np.abs(told.values - exact.values)
    assert np.all(wrong <= told.errors + exact.errors)


def test_one_step_tells_the_model_error_with_its_sign(exact):
    told = vrw.answer(["speed", "dls_fraction", "period"], NEAR, 1.0, friction=FRICTIONS)
    assert set(told.rung) == {"viscoelastic"}
    assert np.all(told.n_steps == 1)
    effectivity = told.model_errors / (told.values - exact.values)
    assert np.mean((effectivity > 0.5) & (effectivity < 2.0)) > 0.9


def test_looser_answers_cost_less():
    steps = [vrw.answer("speed", NEAR, tol, friction=FRICTIONS).n_steps for tol in (1e-2, 1e-7)]
    assert np.mean(steps[0]) < 0.5 * np.mean(steps[1])


def test_a_lane_is_answered_as_it_is_alone(exact):
    one = jax.tree.map(lambda x: x[5] if x.ndim else x, NEAR)
    alone = vrw.answer(["speed", "dls_fraction", "period"], one, 1e-10, friction=FRICTIONS[5])
    assert np.array_equal(alone.values, exact.values[5])


def test_at_low_friction_another_gait_is_walked_to():
    told = vrw.answer("period", vrw.WheelParams(), 1e-3, friction=0.7)
    assert told.rung == "unilateral"
    assert abs(told.value - 0.360) < 2e-3  # docs/ladder.md
    assert "another gait" in told.why


HARD = {
    "damping": [178.5877, 153.6807, 193.5374, 151.5455, 114.5147, 98.5177],
    "stiffness": [515.5376, 534.7467, 536.8101, 532.1883, 584.6127, 576.7884],
    "natural_length": [1.0197, 1.0133, 1.0228, 1.0248, 1.0297, 1.0195],
    "slope": [0.3150, 0.3332, 0.3386, 0.3125, 0.2809, 0.2942],
}
"""Three whose legs change what they do on the way, with a slow direction; three whose errors are
the largest, of what was asked, in 10,152 answers: their feet dip for a microsecond."""
HARD_FRICTION = np.array([2.3666, 0.9022, 25.7033, 15.3909, 1.7096, 1.1505])
NONE = {1: vrw.Outcome.NO_CYCLE_FOUND, 2: vrw.Outcome.FRICTION_PARADOX}
"""A multiplier of 1.36, so that no walk leads to the gait; walks to Painlevé's singularity."""


def test_errors_are_kept_where_motions_change_and_feet_hardly_leave_the_ground():
    wheels = vrw.WheelParams(**{name: jnp.asarray(x) for name, x in HARD.items()})
    names = ["speed", "dls_fraction"]
    exact = vrw.answer(names, wheels, 1e-8, friction=HARD_FRICTION)
    for tol in (1e-2, 1e-4):
        told = vrw.answer(names, wheels, tol, friction=HARD_FRICTION)
        for each in (told, exact):
            lost = np.flatnonzero(~each.found)
            assert {int(i): each.outcomes[i] for i in lost} == NONE
        wrong = np.abs(told.values - exact.values)
        assert np.all((wrong <= told.errors + exact.errors)[told.found])


def test_which_takes_one_of_the_gaits_that_attract():
    slowest = vrw.answer("speed", TABLE_1, 1e-4, friction=20.0, which="slowest")
    assert abs(slowest.value - vrw.answer("speed", TABLE_1, 1e-6, friction=20.0).value) < 1e-4
    assert slowest.why.endswith("one of those that attract, 1 in all")
    none = vrw.answer("speed", TABLE_1, 1e-4, friction=20.0, which=1)
    assert not none.found
    assert none.why.endswith("gaits that attract: 1")


def test_the_rigid_wheel_answers_for_stiff_damped_legs_and_loose_tolerances():
    stiffness, mass, gravity = 1e6, 18.0, 9.81
    wheel = vrw.WheelParams(
        stiffness=stiffness, damping=4.0 * math.sqrt(stiffness * mass), slope=0.1,
        natural_length=1.0 + mass * gravity / stiffness,
    )  # fmt: skip
    told = vrw.answer(["speed", "period"], wheel, 0.1, friction=50.0)
    exact = vrw.answer(["speed", "period"], wheel, 1e-3, friction=50.0)
    assert (told.rung, exact.rung) == ("rigid", "unilateral")
    wrong = told.values - exact.values
    assert np.all(np.abs(wrong) < told.errors)
    assert np.all(np.abs(told.model_errors / wrong - 1.0) < 0.3)


def test_no_gait_is_said_and_no_small_number():
    told = vrw.answer("speed", vrw.WheelParams(slope=0.02), 1e-3, friction=0.7)
    assert not told.found
    assert math.isnan(told.value)
    assert math.isinf(told.error)
    assert told.why.startswith("no such gait on real ground: ")


def test_an_answer_prints_itself_in_one_line():
    text = repr(vrw.answer(["speed", "dls_fraction"], TABLE_1, 1e-2, friction=50.0))
    assert "\n" not in text
    assert "m/s ± " in text
    assert "checked by one step on real ground" in text
    assert text.endswith(" ms")


def test_what_can_not_be_answered_is_refused_in_one_sentence():
    with pytest.raises(ValueError, match="'spead' is no measure that every rung tells"):
        vrw.answer("spead", TABLE_1, 1e-3)
    with pytest.raises(ValueError, match="tol is 0, but it must be positive"):
        vrw.answer("speed", TABLE_1, 0.0)
    with pytest.raises(ValueError, match="lanes have one axis"):
        vrw.answer("speed", NEAR, 1e-3, friction=np.ones(3))
    with pytest.raises(TypeError, match="inside jit"):
        jax.jit(lambda c: vrw.answer("speed", vrw.WheelParams(damping=c), 1e-3).value)(150.0)


def test_few_gaits_on_real_ground_and_all_of_the_papers_make_a_mean():
    rng = np.random.default_rng(3)
    wheels = vrw.WheelParams(damping=jnp.asarray(rng.uniform(120.0, 200.0, 200)))
    every = vrw.answer("speed", wheels, 1e-6, friction=15.0)
    mean = vrw.average("speed", wheels, 1e-3, friction=15.0, pilot=12)
    assert abs(mean.value - np.mean(every.value)) < 1.5 * mean.error
    assert mean.error < 2e-3
    assert mean.n_top < 60
    assert mean.steps < mean.steps_alone


def test_a_mean_is_of_the_wheels_that_have_a_gait():
    """Whether some are asked, or all: then it is theirs and nothing but theirs."""
    rng = np.random.default_rng(1)
    drawn = (rng.uniform(*ends, 60) for ends in ((120.0, 200.0), (450.0, 550.0), (0.26, 0.34)))
    wheels = vrw.WheelParams(**dict(zip(("damping", "stiffness", "slope"), drawn, strict=True)))
    every = vrw.answer("speed", wheels, 1e-5, friction=30.0)
    assert 40 < np.sum(every.found) < 60
    for tol, some in ((3e-2, True), (1e-4, False)):
        mean = vrw.average("speed", wheels, tol, friction=30.0, pilot=16, seed=1)
        assert (mean.n_top < 60) == some
        wrong = abs(mean.value - np.mean(every.value[every.found]))
        assert wrong < (mean.error if some else 1e-4 * tol)  # the same answers, summed otherwise
