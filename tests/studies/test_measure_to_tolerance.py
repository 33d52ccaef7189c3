"""Measures to within a tolerance: the model that is used, the error, and invalid arguments."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vrw_jax as vrw
from vrw_jax.studies.tolerances import _estimate_mean

TABLE_1 = vrw.WheelParams(damping=150.0)
WHEELS_NEAR_TABLE_1 = vrw.WheelParams(damping=jnp.linspace(120.0, 200.0, 24))
FRICTIONS = np.geomspace(8.0, 80.0, 24)


@pytest.fixture(scope="module")
def exact_measures():
    """Measures at the tolerance 1e-10, the reference for larger tolerances."""
    return vrw.measure_to_tolerance(
        ["speed", "dls_fraction", "period"], WHEELS_NEAR_TABLE_1, 1e-10, friction=FRICTIONS
    )


@pytest.mark.slow
def test_measures_equal_those_of_the_paper_if_feet_cannot_slip():
    measured = vrw.measure_to_tolerance("speed", TABLE_1, 1e-6, friction=math.inf)
    assert measured.model == "viscoelastic"
    assert abs(measured.value - float(vrw.limit_cycle(TABLE_1).speed)) < 1e-8
    assert measured.error <= 1e-6
    assert abs(measured.model_error) < 1e-8


@pytest.mark.slow
def test_a_converged_measure_repeats_with_unilateral_contact():
    names = ["theta_touchdown", "dtheta_touchdown", "dL1_touchdown"]
    measured = vrw.measure_to_tolerance(names, TABLE_1, 1e-9, friction=20.0)
    assert measured.model == "unilateral"
    x = np.array([[measured.value[name] for name in names]])
    step = vrw.step_batch(TABLE_1, x, model=vrw.UnilateralWheel(friction=20.0))
    assert np.max(np.abs(np.asarray(step.section_state)[0, [0, 1, 12]] - x[0])) < 1e-8


@pytest.mark.parametrize("tol", [1e-2, 1e-3, 1e-5])
def test_measures_are_within_their_stated_errors(tol, exact_measures):
    measured = vrw.measure_to_tolerance(
        ["speed", "dls_fraction", "period"], WHEELS_NEAR_TABLE_1, tol, friction=FRICTIONS
    )
    assert np.all(measured.found)
    assert np.all(exact_measures.found)
    assert np.all(measured.errors <= tol)
    wrong = np.abs(measured.values - exact_measures.values)
    assert np.all(wrong <= measured.errors + exact_measures.errors)


def test_one_step_gives_the_model_error_with_its_sign(exact_measures):
    measured = vrw.measure_to_tolerance(
        ["speed", "dls_fraction", "period"], WHEELS_NEAR_TABLE_1, 1.0, friction=FRICTIONS
    )
    assert set(measured.model) == {"viscoelastic"}
    assert np.all(measured.n_steps == 1)
    effectivity = measured.model_errors / (measured.values - exact_measures.values)
    assert np.mean((effectivity > 0.5) & (effectivity < 2.0)) > 0.9


def test_looser_tolerances_cost_less():
    steps = [
        vrw.measure_to_tolerance("speed", WHEELS_NEAR_TABLE_1, tol, friction=FRICTIONS).n_steps
        for tol in (1e-2, 1e-7)
    ]
    assert np.mean(steps[0]) < 0.5 * np.mean(steps[1])


def test_a_batch_element_has_the_result_of_a_single_wheel(exact_measures):
    one = jax.tree.map(lambda x: x[5] if x.ndim else x, WHEELS_NEAR_TABLE_1)
    measured = vrw.measure_to_tolerance(
        ["speed", "dls_fraction", "period"], one, 1e-10, friction=FRICTIONS[5]
    )
    assert np.array_equal(measured.values, exact_measures.values[5])


def test_at_low_friction_walks_reach_another_gait():
    measured = vrw.measure_to_tolerance("period", vrw.WheelParams(), 1e-3, friction=0.7)
    assert measured.model == "unilateral"
    assert abs(measured.value - 0.360) < 2e-3  # docs/explanation/ladder.md
    assert "a walk from the lower model's gait leads" in measured.why


HARD_WHEELS = {
    "damping": [178.5877, 153.6807, 193.5374, 151.5455, 114.5147, 98.5177],
    "stiffness": [515.5376, 534.7467, 536.8101, 532.1883, 584.6127, 576.7884],
    "natural_length": [1.0197, 1.0133, 1.0228, 1.0248, 1.0297, 1.0195],
    "slope": [0.3150, 0.3332, 0.3386, 0.3125, 0.2809, 0.2942],
}
"""Three whose legs change what they do on the way, with a slow direction; three whose errors are
the largest, of what was asked, in 10,152 answers: their feet dip for a microsecond."""
HARD_FRICTION = np.array([2.3666, 0.9022, 25.7033, 15.3909, 1.7096, 1.1505])
OUTCOMES_WITHOUT_GAIT = {2: vrw.Outcome.PAINLEVE_PARADOX}
"""Outcomes of the wheels without a gait: walks of wheel 2 end in Painlevé's singularity. No walk
leads to the gait of wheel 1, whose multiplier is 1.36, but Newton's method reaches it from the
paper's gait."""


def test_errors_hold_if_contact_sequences_change_and_feet_barely_lift_off():
    wheels = vrw.WheelParams(**{name: jnp.asarray(x) for name, x in HARD_WHEELS.items()})
    names = ["speed", "dls_fraction"]
    exact = vrw.measure_to_tolerance(names, wheels, 1e-8, friction=HARD_FRICTION)
    for tol in (1e-2, 1e-4):
        measured = vrw.measure_to_tolerance(names, wheels, tol, friction=HARD_FRICTION)
        for each in (measured, exact):
            indices_without_gait = np.flatnonzero(~each.found)
            assert {int(i): each.outcomes[i] for i in indices_without_gait} == OUTCOMES_WITHOUT_GAIT
        wrong = np.abs(measured.values - exact.values)
        assert np.all((wrong <= measured.errors + exact.errors)[measured.found])


def test_which_selects_one_of_the_attracting_gaits():
    slowest = vrw.measure_to_tolerance("speed", TABLE_1, 1e-4, friction=20.0, which="slowest")
    assert (
        abs(slowest.value - vrw.measure_to_tolerance("speed", TABLE_1, 1e-6, friction=20.0).value)
        < 1e-4
    )
    assert slowest.why.endswith("one of the attracting gaits, 1 in all")
    none = vrw.measure_to_tolerance("speed", TABLE_1, 1e-4, friction=20.0, which=1)
    assert not none.found
    assert none.why.endswith("gaits that attract: 1")


def test_the_rigid_wheel_is_used_for_stiff_damped_legs_and_loose_tolerances():
    stiffness, mass, gravity = 1e6, 18.0, 9.81
    wheel = vrw.WheelParams(
        stiffness=stiffness, damping=4.0 * math.sqrt(stiffness * mass), slope=0.1,
        natural_length=1.0 + mass * gravity / stiffness,
    )  # fmt: skip
    measured = vrw.measure_to_tolerance(["speed", "period"], wheel, 0.1, friction=50.0)
    exact = vrw.measure_to_tolerance(["speed", "period"], wheel, 1e-3, friction=50.0)
    assert (measured.model, exact.model) == ("rigid", "unilateral")
    wrong = measured.values - exact.values
    assert np.all(np.abs(wrong) < measured.errors)
    assert np.all(np.abs(measured.model_errors / wrong - 1.0) < 0.3)


def test_a_missing_gait_is_reported_instead_of_a_small_number():
    measured = vrw.measure_to_tolerance("speed", vrw.WheelParams(slope=0.02), 1e-3, friction=0.7)
    assert not measured.found
    assert math.isnan(measured.value)
    assert math.isinf(measured.error)
    assert measured.why.startswith("no such gait with unilateral contact: ")
    wheels = vrw.WheelParams(damping=[np.nan, -5.0, 200.0])
    outcomes = vrw.measure_to_tolerance("speed", wheels, 1e-2, friction=50.0).outcomes
    assert outcomes.tolist() == [vrw.Outcome.BAD_INPUT] * 2 + [vrw.Outcome.STEPPED]


def test_a_measure_result_prints_one_line():
    text = repr(vrw.measure_to_tolerance(["speed", "dls_fraction"], TABLE_1, 1e-2, friction=50.0))
    assert "\n" not in text
    assert "m/s ± " in text
    assert "checked by one step with unilateral contact" in text
    assert text.endswith(" ms")


def test_unsupported_requests_are_refused_in_one_sentence():
    with pytest.raises(ValueError, match="'spead' is no measure that every model has"):
        vrw.measure_to_tolerance("spead", TABLE_1, 1e-3)
    with pytest.raises(ValueError, match="tol is 0, but it must be positive"):
        vrw.measure_to_tolerance("speed", TABLE_1, 0.0)
    with pytest.raises(ValueError, match="a batch has one axis"):
        vrw.measure_to_tolerance("speed", WHEELS_NEAR_TABLE_1, 1e-3, friction=np.ones(3))
    with pytest.raises(TypeError, match="inside jit"):
        jax.jit(
            lambda c: vrw.measure_to_tolerance("speed", vrw.WheelParams(damping=c), 1e-3).value
        )(150.0)


def test_a_mean_combines_few_unilateral_gaits_with_all_gaits_of_the_paper():
    rng = np.random.default_rng(3)
    wheels = vrw.WheelParams(damping=jnp.asarray(rng.uniform(120.0, 200.0, 200)))
    every = vrw.measure_to_tolerance("speed", wheels, 1e-6, friction=15.0)
    mean = vrw.multifidelity_mean("speed", wheels, 1e-3, friction=15.0, pilot=12)
    assert abs(mean.value - np.mean(every.value)) < 1.5 * mean.error
    assert mean.error < 2e-3
    assert mean.n_high_fidelity < 60
    assert mean.cost < mean.cost_high_fidelity_only


def test_the_mean_of_wheels_that_are_all_computed_has_no_sampling_error():
    has_gait = np.ones(12, bool)
    drawn = (np.array([2.0]), has_gait[:1], np.array([1.9]))
    assert _estimate_mean(np.full(12, 2.0), has_gait, *drawn, True) == (2.0, 0.0)


def test_a_mean_includes_only_wheels_with_a_gait():
    """Whether some are asked, or all: then it is theirs and nothing but theirs."""
    rng = np.random.default_rng(1)
    random_columns = (
        rng.uniform(*ends, 60) for ends in ((120.0, 200.0), (450.0, 550.0), (0.26, 0.34))
    )
    wheels = vrw.WheelParams(
        **dict(zip(("damping", "stiffness", "slope"), random_columns, strict=True))
    )
    every = vrw.measure_to_tolerance("speed", wheels, 1e-5, friction=30.0)
    assert 40 < np.sum(every.found) < 60
    for tol, selection in ((3e-2, True), (1e-4, False)):
        mean = vrw.multifidelity_mean("speed", wheels, tol, friction=30.0, pilot=16, seed=1)
        assert (mean.n_high_fidelity < 60) == selection
        wrong = abs(mean.value - np.mean(every.value[every.found]))
        assert wrong < (
            mean.error if selection else 1e-4 * tol
        )  # the same answers, summed otherwise


@pytest.mark.slow
def test_errors_of_means_are_as_stated_if_few_wheels_have_no_gait():
    """Over seeds: about 95 % of the errors are within two standard errors, and few above `tol`.

    The pilot samples of most seeds contain no wheel without a gait.
    """
    rng, tol, n_seeds = np.random.default_rng(0), 1e-2, 20
    random_columns = (
        rng.uniform(*ends, 150) for ends in ((100.0, 210.0), (420.0, 600.0), (0.27, 0.31))
    )
    wheels = vrw.WheelParams(
        **dict(zip(("damping", "stiffness", "slope"), random_columns, strict=True))
    )
    every = vrw.measure_to_tolerance("speed", wheels, 1e-4, friction=15.0)
    assert 0.9 < np.mean(every.found) < 1.0
    means = [
        vrw.multifidelity_mean("speed", wheels, tol, friction=15.0, pilot=12, seed=seed)
        for seed in range(n_seeds)
    ]
    errors = np.array([mean.value for mean in means]) - np.mean(every.value[every.found])
    assert np.sqrt(np.mean(errors**2)) < tol
    # Fewer than 16 of 20 have a probability of 0.3 % at a coverage of 95 %.
    assert np.sum(np.abs(errors) < [mean.error for mean in means]) >= 16
    assert np.median([mean.n_high_fidelity for mean in means]) < 75
