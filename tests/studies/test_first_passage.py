"""First passage: published values, extended precision, counts, gradients and bad input."""

import equinox as eqx
import jax
import numpy as np
import pytest
from scipy.special import ndtr
from support.slow_variants import mark_slow

import vrw_jax as vrw
from vrw_jax.studies.first_passage import PassageStatus, differentiate_log_mean_steps
from vrw_jax.studies.sampled_passage import (
    MIN_SAMPLING_ROUNDS,
    _estimate_failure_probability,
    _estimate_kappa_2,
    sample_passage,
)
from vrw_jax.studies.walker_groups import WalkerGroups

DEGREE = np.pi / 180.0
BYL = vrw.WheelParams(hub_mass=1.0, leg_mass=1e-15, gravity=1.0, slope=8.0 * DEGREE)
"""Point mass at the hub on a mean slope of 8 degrees, g/l = 1."""
RIGID = vrw.RigidWheel(stop_at_lift_off=False)
MEAN_STEPS = {
    1.5: 654447.8, 1.75: 31492.18, 2.0: 4324.913, 2.5: 411.6028, 3.0: 113.5697, 4.0: 30.7486
}  # fmt: skip
"""By the standard deviation of the slope, degrees, from an independent quadrature."""


def solve_in_extended_precision(slope_sd, n_nodes=200):
    """Return mean steps by the same kernel in 80-bit numbers, without the form 1 - kappa_1."""
    wide, half, mean = np.longdouble, np.longdouble(np.pi) / 8, np.longdouble(8.0 * DEGREE)
    kept, gravity = wide(0.5), wide(2.0)
    cosine, sine = (1 - kept) * np.cos(half), (1 + kept) * np.sin(half)
    peak, amplitude = np.arctan2(sine, cosine), gravity * np.hypot(cosine, sine)
    swing = amplitude * np.cos(np.minimum(mean + 9 * slope_sd, peak) - peak)
    largest = swing / (1 - kept) - gravity
    nodes, weights = (x.astype(wide) for x in np.polynomial.legendre.leggauss(n_nodes))
    x, weights = largest * (1 + nodes) / 2, largest * weights / 2
    offset = kept * x - gravity * (1 - kept)
    ratio = (x - offset[:, None]) / amplitude
    is_reached = np.abs(ratio) < 1
    ratio = np.where(is_reached, ratio, 0)
    deviation = (peak - np.arccos(ratio) - mean) / slope_sd
    density = np.exp(-(deviation**2) / 2) / np.sqrt(2 * wide(np.pi)) / slope_sd / amplitude
    matrix = np.where(is_reached, density / np.sqrt(1 - ratio**2), 0) * weights
    flattest = peak - np.arccos(np.clip(-offset / amplitude, -1, 1))
    failure = ndtr(((flattest - mean) / slope_sd).astype(float))
    share = np.ones(n_nodes, wide) / n_nodes
    for _ in range(120):
        share = share @ matrix
        share /= share.sum()
    return float(1 / (share @ failure))


@pytest.mark.parametrize("degrees", MEAN_STEPS)
def test_rigid_wheels_have_the_published_mean_steps(degrees):
    passage = vrw.first_passage(BYL, degrees * DEGREE, model=RIGID)
    assert abs(float(passage.mean_steps) / MEAN_STEPS[degrees] - 1.0) < 1e-6
    assert passage.ending == "The error estimate is within the tolerance."
    assert float(passage.error) < 1e-8 * float(passage.mean_steps)


def test_passages_of_a_batch_have_the_means_and_sentences_of_their_elements():
    deviations = np.array([2.0, 4.0])
    find = lambda sd: vrw.first_passage(BYL, sd * DEGREE, model=RIGID)
    batch = jax.vmap(find)(deviations)
    expected = [MEAN_STEPS[sd] for sd in deviations]
    np.testing.assert_allclose(batch.mean_steps, expected, rtol=1e-6)
    assert batch.ending.tolist() == ["The error estimate is within the tolerance."] * 2
    assert "wheels: 2 in shape (2,): 2 CONVERGED" in repr(batch)


def test_long_lives_keep_their_digits():
    # 95,369,578 was published, from numbers of 64 bits: 1.8e-6 away from 80 bits.
    passage = vrw.first_passage(BYL, 1.25 * DEGREE, model=RIGID)
    exact = solve_in_extended_precision(1.25 * DEGREE)
    assert abs(float(passage.mean_steps) / exact - 1.0) < 1e-9
    assert abs(exact / 95369578.0 - 1.0) < 2e-6


def test_the_start_at_the_gait_adds_the_published_steps():
    for degrees, steps in ((2.0, 4326.185), (2.5, 412.534), (3.0, 114.207)):
        passage = vrw.first_passage(BYL, degrees * DEGREE, model=RIGID)
        assert abs(float(passage.mean_steps_from_gait) - steps) < 5.1e-4  # half of the last digit
    assert abs(float(vrw.first_passage(BYL, 1.5 * DEGREE, model=RIGID).kappa_2) - 0.5) < 1e-4


def test_a_compiled_function_of_the_unevenness_gives_the_published_steps():
    compiled = jax.jit(lambda sd: vrw.first_passage(BYL, sd, model=RIGID).mean_steps_from_gait)
    assert abs(float(compiled(2.5 * DEGREE)) - 412.534) < 5.1e-4  # half of the last digit


def test_the_derivative_of_a_long_life_is_a_central_difference():
    def mean_steps(slope_sd):
        return vrw.first_passage(BYL, slope_sd, model=RIGID).mean_steps

    slope_sd, h = 2.0 * DEGREE, 1e-6
    gradient = float(jax.grad(mean_steps)(slope_sd))
    difference = float(mean_steps(slope_sd + h) - mean_steps(slope_sd - h)) / (2.0 * h)
    assert abs(gradient / difference - 1.0) < 1e-6


def count_rigid_steps(ground_sd, has_heights, n_walks=20_000):
    """Return mean steps of walks from the gait, and their standard error, by energy conservation.

    On random heights, the wheel comes from the mean line and lands on a random foothold.
    """
    half, mean, random = np.pi / 8, 8.0 * DEGREE, np.random.default_rng(3)
    distance, is_walking = 2.0 * np.sin(half), np.ones(n_walks, bool)
    height, lives = np.zeros(n_walks), np.zeros(n_walks)

    def draw_line(height):
        z = ground_sd * random.standard_normal(n_walks)
        if not has_heights:
            return mean + z, height
        return mean - np.arcsin(np.clip((z - height) / distance, -1.0, 1.0)), z

    # Half of the squared rate remains in a landing.
    rate_before_landing = 4.0 * (np.cos(half - mean) - np.cos(half + mean))
    slope, height = draw_line(height) if has_heights else (mean, height)
    while np.any(is_walking):
        rate = 0.5 * rate_before_landing - 2.0 * (1.0 - np.cos(half - slope))  # at the vertical
        is_walking &= (np.abs(slope) < np.pi / 2) & ((rate > 0.0) | (slope > half))
        lives += is_walking
        slope, height = draw_line(height)
        rate_before_landing = rate + 2.0 * (1.0 - np.cos(half + slope))
    return lives.mean(), lives.std() / np.sqrt(n_walks)


@pytest.mark.parametrize("choices", [{"slope_sd": 2.0}, {"slope_sd": 0.2}, {"height_sd": 0.05}])
def test_means_on_very_uneven_ground_and_on_heights_are_those_of_counted_walks(choices):
    ((name, ground_sd),) = choices.items()
    passage = vrw.first_passage(BYL, **choices, model=RIGID)
    counted, standard_error = count_rigid_steps(ground_sd, name == "height_sd")
    # 99.9 % of normal numbers are within 3.3 standard deviations.
    assert abs(float(passage.mean_steps_from_gait) - counted) < 3.3 * standard_error
    assert "within the tolerance" in passage.ending


def test_derivatives_on_random_heights_are_central_differences():
    """Of the distance and of the steps from the gait, with one number of nodes."""

    def solve(slope, height_sd):
        params = vrw.WheelParams(hub_mass=1.0, leg_mass=1e-15, gravity=1.0, slope=slope)
        passage = vrw.first_passage(params, height_sd=height_sd, model=RIGID, tol=1.0)
        return jax.numpy.stack([passage.mean_distance, passage.mean_steps_from_gait])

    point, h = np.array([8.0 * DEGREE, 0.04]), 1e-5
    jacobian = jax.jacfwd(lambda point: solve(*point))(point)
    for i, by in enumerate(jacobian.T):
        ends = [solve(*(point + sign * h * np.eye(2)[i])) for sign in (1, -1)]
        # The limits of the nodes move in differences only, which changes their errors of 1e-6.
        np.testing.assert_allclose(by, (ends[0] - ends[1]) / (2.0 * h), rtol=1e-4)


@pytest.mark.parametrize(
    ("sd_name", "ground_sd"),
    mark_slow(*(("slope_sd", d * DEGREE) for d in (1.25, 2.0, 3.0)), ("height_sd", 0.03)),
)
def test_samples_agree_with_quadrature_within_their_error(sd_name, ground_sd):
    gait = vrw.limit_cycle(BYL, model=RIGID)
    start = np.asarray(gait.section_state)
    random, options = np.random.default_rng(0), vrw.StepOptions()
    groups = WalkerGroups(BYL, start, ground_sd, RIGID, options, 4096, random, sd_name=sd_name)
    sample = sample_passage(groups, float(gait.spectral_radius), 0.03, 1_000_000)
    exact = vrw.first_passage(BYL, **{sd_name: ground_sd}, model=RIGID)
    assert sample.relative_error < 0.05
    mean = 1.0 / sample.failure_probability
    assert abs(mean / float(exact.mean_steps) - 1.0) < sample.relative_error
    from_gait = sample.mean_steps_from_gait / float(exact.mean_steps_from_gait)
    assert abs(from_gait - 1.0) < 1.5 * sample.relative_error
    assert abs(sample.kappa_2 - float(exact.kappa_2)) < 0.01
    distance = float(exact.mean_distance / exact.mean_steps)
    assert abs(sample.mean_step_distance - distance) < sample.step_distance_error
    assert tuple(sample.fraction_by_outcome) == ("FELL_BACK",)


@pytest.mark.parametrize(
    ("slope_sd", "steps", "error"), [(0.015, 13.23, 0.06), *mark_slow((0.02, 6.9, 0.05))]
)
def test_the_papers_wheel_lasts_as_long_as_an_independent_code_counts(slope_sd, steps, error):
    passage = vrw.first_passage(vrw.WheelParams(), slope_sd)
    relative_error = 1.5 * float(passage.error / passage.mean_steps)
    difference = float(passage.mean_steps_from_gait) - steps
    assert abs(difference) < relative_error * steps + 2.58 * error
    assert passage.ending == "The error estimate is within the tolerance."
    assert passage.end_names == ("TOUCHDOWN_BEFORE_STOPPER",)
    assert float(passage.weights.sum()) == pytest.approx(1.0)
    assert "FirstPassage" in repr(passage)


def test_short_lives_meet_the_tolerance_from_any_seed():
    """With these seeds, more walks from the same starts cannot reduce the error to 2 %."""
    for seed in (1, 8):
        passage = vrw.first_passage(vrw.WheelParams(), 0.01407, seed=seed)
        assert passage.ending == "The error estimate is within the tolerance."
        assert float(passage.error) < 0.02 * float(passage.mean_steps)
        # A count of 1,500,000 steps with another seed.
        assert abs(float(passage.mean_steps) - 15.60) < float(passage.error) + 0.13


def test_every_failed_status_names_an_argument_to_change():
    for status in PassageStatus:
        names = ("tol", "max_steps", "n_nodes", "n_walkers")
        assert status == PassageStatus.CONVERGED or any(name in status.meaning for name in names)


@pytest.mark.parametrize(
    ("damping", "counted", "error"), [(200.0, 5.9, 0.13), *mark_slow((150.0, 67.1, 1.6))]
)
def test_the_papers_wheel_lasts_on_heights_as_long_as_walks_on_such_slopes(damping, counted, error):
    """Counts of slopes between random heights, by an independent simulator."""
    passage = vrw.first_passage(vrw.WheelParams(damping=damping), height_sd=0.01)
    relative_error = 1.5 * float(passage.error / passage.mean_steps)
    difference = float(passage.mean_steps_from_gait) - counted
    assert abs(difference) < relative_error * counted + 2.58 * error
    assert passage.ending == "The error estimate is within the tolerance."
    step_distance = float(passage.mean_distance / passage.mean_steps)
    assert step_distance == pytest.approx(0.711, abs=0.001)  # as on even ground, to second order
    assert 0.0 < float(passage.distance_error) < 0.025 * float(passage.mean_distance)


def count_failure_share(params, slope_sd, n_walkers, n_steps, model=None):
    """Return failures per step, their standard error, and the number of counted steps."""
    random, mean = np.random.default_rng(5), float(params.slope)
    gait = vrw.limit_cycle(params, model=model)
    start = np.tile(np.asarray(gait.section_state), (n_walkers, 1))
    states, slopes, ages = start, np.full(n_walkers, mean), np.zeros(n_walkers, int)
    n_failures, n_counted = 0, 0
    for _ in range(n_steps):
        next_slopes = mean + slope_sd * random.standard_normal(n_walkers)
        wheels = eqx.tree_at(lambda p: p.slope, params, np.stack([slopes, next_slopes], 1))
        result = vrw.step_batch(wheels, states, model=model)
        is_alive, is_old = result.outcome == 0, ages >= 12
        n_failures, n_counted = n_failures + np.sum(~is_alive & is_old), n_counted + np.sum(is_old)
        states = np.where(is_alive[:, None], result.section_state, start)
        slopes, ages = np.where(is_alive, next_slopes, mean), np.where(is_alive, ages + 1, 0)
    return n_failures / n_counted, np.sqrt(n_failures) / n_counted, n_counted


@pytest.mark.parametrize(
    ("slope_sd", "damping", "n_walkers", "n_steps", "tol"),
    [
        *mark_slow(
            (0.0125, 200.0, 8192, 32, 0.02),
            (0.007, 200.0, 16384, 85, 0.01),
            (0.01, 200.0, 16384, 85, 0.01),
            (0.0125, 200.0, 16384, 85, 0.01),
            (0.015, 150.0, 16384, 85, 0.01),
        ),
    ],
)
def test_samples_agree_with_counted_steps(slope_sd, damping, n_walkers, n_steps, tol):
    """Of a million steps, or of enough that 4,000 failures are counted."""
    params = vrw.WheelParams(damping=damping)
    share, standard_error, n_counted = count_failure_share(params, slope_sd, n_walkers, n_steps)
    assert n_counted > 1e6 or share * n_counted > 4000
    passage = vrw.first_passage(params, slope_sd, tol=tol)
    error = float(passage.error / passage.mean_steps) * share + 2.58 * standard_error
    assert abs(float(passage.failure_probability) - share) < error


@pytest.mark.slow
def test_means_with_unilateral_contact_agree_with_counted_steps():
    """Feet that cannot slide; most walks end because the wheel falls back."""
    params, slope_sd, model = vrw.WheelParams(), 0.2, vrw.UnilateralWheel(friction=np.inf)
    share, standard_error, _ = count_failure_share(params, slope_sd, 1024, 40, model)
    passage = vrw.first_passage(params, slope_sd, model=model, n_walkers=512, tol=0.1)
    error = float(passage.error / passage.mean_steps) * share + 2.58 * standard_error
    assert error < 0.2 * share
    assert abs(float(passage.failure_probability) - share) < error
    assert passage.end_names[0] == "FELL_BACK"


@pytest.mark.slow
def test_loose_tolerances_cause_no_failures_with_unilateral_contact():
    """At tolerances of 1e-6, 22 of 512 walks of 40 steps end with a Painlevé paradox."""
    params, model = vrw.WheelParams(), vrw.UnilateralWheel(friction=np.inf)
    passage = vrw.first_passage(params, 0.02, model=model, n_walkers=256, tol=0.1, max_steps=50_000)
    assert float(passage.mean_steps) > 1e5  # 98 at tolerances of 1e-6


@pytest.mark.slow
def test_a_life_of_millions_of_steps_depends_on_no_choice_of_the_sampling():
    # 8 million counted steps had no failure at this standard deviation.
    params, slope_sd = vrw.WheelParams(), 0.004
    passage = vrw.first_passage(params, slope_sd)
    gait = vrw.limit_cycle(params)
    start, random = np.asarray(gait.section_state), np.random.default_rng(11)
    groups = WalkerGroups(
        params,
        start,
        slope_sd,
        vrw.ViscoelasticWheel(),
        vrw.StepOptions(),
        8192,
        random,
        n_groups=64,
        negligible_ground_line_effect=3e-4,
        min_forgetting_steps=14,
    )
    sample = sample_passage(groups, float(gait.spectral_radius), 0.03, 2_000_000)
    error = sample.relative_error + float(passage.error / passage.mean_steps)
    mean = float(passage.mean_steps)
    assert 5e7 < mean < 8e7
    assert abs(sample.failure_probability * mean - 1.0) < error
    assert float(passage.kappa_2) == pytest.approx(float(gait.spectral_radius), abs=0.02)


@pytest.mark.slow
def test_the_error_keeps_its_level_although_the_error_ends_the_sampling():
    """Normal group means with known mean: an error test after each round covers only 98.6 %."""
    random, n_estimates, probability, tol = np.random.default_rng(0), 2000, 1e-6, 0.02
    groups = WalkerGroups(BYL, np.zeros(1), 0.01, RIGID, vrw.StepOptions(), 32, random)

    def draw_weights():
        groups.n_steps += 1
        return probability * (1.0 + 0.2 * random.standard_normal(groups.n_groups))

    n_covered, n_rounds = 0, 0
    for _ in range(n_estimates):
        groups.n_steps = 0
        estimate, error, _ = _estimate_failure_probability(
            groups,
            draw_weights,
            1,
            start_effect_decay=(0.0, 1),
            relative_tolerance=tol,
            max_steps=10_000,
        )
        assert error <= tol
        n_covered += abs(estimate / probability - 1.0) <= error
        n_rounds += groups.n_steps
    assert n_covered >= 0.99 * n_estimates
    # With a known variance, (2.576 * 0.2 / tol)^2 / 32 = 21 rounds have this error.
    assert n_rounds < 2.5 * 21 * n_estimates


def test_sampling_ends_if_the_effect_of_the_start_exceeds_the_tolerance():
    """More walks from the same walkers cannot reduce this effect."""
    random, tol, decay_factor, n_steps = np.random.default_rng(0), 0.02, 0.9, 20
    # Each of 32 weights per round is one failure.
    groups = WalkerGroups(
        BYL, np.zeros(1), 0.01, RIGID, vrw.StepOptions(), 32, random, min_effective_failures=1.0
    )
    start_effect = decay_factor ** (n_steps + 1)  # 0.11

    def run_rounds(are_walkers_advanced):
        groups.n_steps = 0

        def draw_weights():
            groups.n_steps += 1
            return 1e-3 * (1.0 + 0.01 * random.standard_normal(groups.n_groups))

        _, error, remaining_effect = _estimate_failure_probability(
            groups,
            draw_weights,
            1,
            start_effect_decay=(decay_factor, n_steps),
            relative_tolerance=tol,
            max_steps=10_000,
            are_walkers_advanced=are_walkers_advanced,
        )
        return error, remaining_effect, groups.n_steps

    error, remaining_effect, n_rounds = run_rounds(are_walkers_advanced=False)
    assert remaining_effect == pytest.approx(start_effect)
    assert start_effect < error < start_effect + tol
    assert n_rounds == MIN_SAMPLING_ROUNDS
    # If each round advances the walkers, the mean effect over the rounds decays.
    error, remaining_effect, n_rounds = run_rounds(are_walkers_advanced=True)
    mean_effect = start_effect * (1.0 - decay_factor**n_rounds) / (1.0 - decay_factor) / n_rounds
    assert remaining_effect == pytest.approx(mean_effect)
    assert error <= tol


@pytest.mark.parametrize("n_walkers", [256, 512, 4096])
def test_kappa_2_of_many_components_with_outliers_is_that_of_the_linear_map(n_walkers):
    """Twenty components with Student's noise, of which the slowest decays by 0.8 per step.

    With 512 walkers, a projection on all quadratic functions gives 0.94 to 3.9.
    """
    random, decay_factors = np.random.default_rng(0), np.linspace(0.8, 0.0, 20)
    states, step_transitions = random.standard_normal((n_walkers, 21)), []
    for i_step in range(24):
        slope_deviations = random.standard_normal(n_walkers)
        noise = random.standard_t(3.0, (n_walkers, 20))
        next_components = decay_factors * states[:, :20] + noise + slope_deviations[:, None]
        next_states = np.concatenate([next_components, slope_deviations[:, None]], 1)
        if i_step >= 20:
            is_alive = np.ones(n_walkers, bool)
            step_transitions.append((states, is_alive, slope_deviations, next_states))
        states = next_states
    assert _estimate_kappa_2(step_transitions, 20) == pytest.approx(0.8, abs=0.06)


def test_kappa_2_is_unknown_if_its_estimate_exceeds_kappa_1():
    """The second eigenvalue of an operator is not larger than the first."""
    random, n_walkers = np.random.default_rng(0), 256
    states, slope_deviations = random.standard_normal((n_walkers, 3)), np.zeros(n_walkers)
    is_alive = random.random(n_walkers) < 0.5
    transition = states, is_alive, slope_deviations, 3.0 * states
    assert np.isnan(_estimate_kappa_2([transition], 2))


def test_a_mean_that_few_walks_dominate_has_no_error_estimate():
    # Other seeds give 2e13 to 7e16 steps for this slowly decaying gait, of spectral radius 0.71.
    params = vrw.WheelParams(damping=109.66, stiffness=524.94, slope=0.31148)
    passage = vrw.first_passage(params, 0.008915, n_walkers=1024, max_steps=10_000)
    assert float(passage.error) == np.inf
    assert "The error is unknown" in passage.ending


@pytest.mark.slow
def test_failures_are_counted_if_few_sampled_walks_dominate():
    # Importance sampling alone gives 5754 steps with a stated error of 16 %.
    params = vrw.WheelParams(damping=113.217253, stiffness=515.611361, slope=0.31709696)
    passage = vrw.first_passage(params, 0.014743410)
    # A separate count of 1,016,657 steps contains 309 failures.
    counted_mean, counted_error = 3290.0, 0.147 * 3290.0
    error = float(passage.error)
    assert error < 0.2 * float(passage.mean_steps)
    assert abs(float(passage.mean_steps) - counted_mean) < error + counted_error


@pytest.mark.slow
def test_failures_that_no_large_slope_causes_are_counted():
    """A landing that releases the rear foot precedes one failure in ten of this wheel.

    Importance sampling alone gives 321.0 steps with a stated error of 1.8 %.
    """
    params = vrw.WheelParams(damping=214.656184, stiffness=481.549933, slope=0.286840858)
    # Counts: 50,741 failures after the start's effect has decayed.
    passage = vrw.first_passage(params, 0.0101333984, seed=2, tol=0.05)
    assert set(passage.end_names) == {"TOUCHDOWN_BEFORE_STOPPER", "FELL_BACK"}
    counted_mean, counted_error = 287.53, 0.0114 * 287.53
    assert float(passage.error) < 0.06 * counted_mean
    assert abs(float(passage.mean_steps) - counted_mean) < float(passage.error) + counted_error


def test_no_failure_is_an_ending_and_not_an_error():
    passage = vrw.first_passage(vrw.WheelParams(), 1e-5, n_walkers=64)
    assert float(passage.mean_steps) == np.inf
    assert "No walk failed" in passage.ending


@pytest.mark.parametrize(
    ("changes", "choices", "sentence"),
    [
        ({}, {"slope_sd": 0.0}, "slope_sd is 0, but it must be positive"),
        ({}, {"height_sd": 0.01}, "slope_sd is 0.01 and height_sd is 0.01"),
        ({}, {"slope_sd": None}, "slope_sd is None and height_sd is None"),
        ({}, {"slope_sd": None, "height_sd": -1.0}, "height_sd is -1, but it must be positive"),
        ({}, {"slope_sd": 5.0, "n_walkers": 64}, "all walks of a group of 2 failed"),
        ({}, {"n_walkers": 1}, "group of 1 failed .* or a larger n_walkers"),
        ({"damping": 300.0}, {}, "this wheel has no gait"),
        ({}, {"model": vrw.RigidWheel()}, "stop_at_lift_off=False"),
        ({"slope": 0.0}, {"model": RIGID}, "on which this rigid wheel has no gait"),
    ],
)
def test_bad_arguments_are_one_sentence(changes, choices, sentence):
    with pytest.raises(ValueError, match=sentence):
        vrw.first_passage(vrw.WheelParams(**changes), **({"slope_sd": 0.01} | choices))


@pytest.mark.slow  # a million counted steps
def test_derivatives_of_sampled_means_are_those_of_quadrature():
    """For the rigid wheel, with respect to every parameter and the standard deviation."""
    slope_sd = 2.0 * DEGREE
    names = ("slope", "gravity", "hub_mass", "slope_sd")
    gait = vrw.limit_cycle(BYL, model=RIGID)
    start, random = np.asarray(gait.section_state), np.random.default_rng(0)
    groups = WalkerGroups(BYL, start, slope_sd, RIGID, vrw.StepOptions(), 8192, random)
    sample = sample_passage(groups, float(gait.spectral_radius), 0.02, 1_000_000)
    gradient = differentiate_log_mean_steps(groups, sample.walk_density, names)

    def log_mean_steps(params, slope_sd):
        return jax.numpy.log(vrw.first_passage(params, slope_sd, model=RIGID).mean_steps)

    by_params, by_slope_sd = jax.grad(log_mean_steps, (0, 1))(BYL, slope_sd)
    # Neglected terms have the relative size 1/4325, and 1024 walks give an error near 3 %.
    assert gradient["slope"] == pytest.approx(float(by_params.slope), rel=0.06)
    assert gradient["slope_sd"] == pytest.approx(float(by_slope_sd), rel=0.06)
    assert abs(gradient["gravity"]) < 1e-3 * abs(gradient["slope"])  # no effect but on time
    assert abs(gradient["hub_mass"]) < 1e-3 * abs(gradient["slope"])


@pytest.mark.slow
def test_a_parameter_of_zero_has_a_derivative():
    """The mass of the hub has almost no effect on a wheel whose legs have much more."""
    params = vrw.WheelParams(hub_mass=0.0, leg_com=0.9, slope=0.15)
    gait, random = vrw.limit_cycle(params, model=RIGID), np.random.default_rng(0)
    start = np.asarray(gait.section_state)
    groups = WalkerGroups(params, start, 0.05, RIGID, vrw.StepOptions(), 2048, random)
    sample = sample_passage(groups, float(gait.spectral_radius), 0.1, 200_000)
    names = ("hub_mass", "slope_sd")
    gradient = differentiate_log_mean_steps(groups, sample.walk_density, names)
    assert abs(gradient["hub_mass"]) < 1e-3 * abs(gradient["slope_sd"])


@pytest.mark.slow
def test_a_gradient_of_the_papers_wheel_is_a_central_difference():
    """At this damping walks fail in two ways, with different derivatives."""

    def log_mean_steps(damping, **choices):
        params = vrw.WheelParams(damping=damping)
        return jax.numpy.log(vrw.first_passage(params, 0.007, **choices).mean_steps)

    h, tol = 1.0, 0.02
    gradient = float(jax.grad(log_mean_steps)(200.0))
    ends = [float(log_mean_steps(200.0 + d, tol=tol, seed=3)) for d in (h, -h)]
    # Each end has an error of `tol`, and the gradient one near 3 %, at 99 % twice as much.
    error = np.sqrt(2.0) * tol / (2.0 * h) + 0.06 * abs(gradient)
    assert abs(gradient - (ends[0] - ends[1]) / (2.0 * h)) < error


def test_a_derivative_without_failing_walks_raises_one_sentence():
    mean_steps = lambda slope_sd: (
        vrw.first_passage(vrw.WheelParams(), slope_sd, n_walkers=64).mean_steps
    )
    with pytest.raises(ValueError, match="no sampled walk failed with slope_sd 1e-05 rad"):
        jax.grad(mean_steps)(1e-5)


def test_sampled_means_inside_jit_are_one_sentence():
    mean_steps = lambda damping: (
        vrw.first_passage(vrw.WheelParams(damping=damping), 0.01).mean_steps
    )
    for function in (mean_steps, jax.grad(mean_steps)):
        with pytest.raises(TypeError, match="of a function that is not compiled"):
            jax.jit(function)(200.0)
