"""Gaits of a wheel with two different legs in turn, against a five-coordinate code."""

import functools

import jax
import numpy as np
import pytest
from reference_code import five_coordinates
from support.leg_laws import BumpStop

import vrw_jax as vrw

PARAMS = vrw.WheelParams()
FIRST, SECOND = {"damping": 150.0}, {"damping": 170.0, "stiffness": 520.0}


def make_wheel(first=FIRST, second=SECOND, **turn):
    legs = vrw.AlternatingLegs(vrw.SpringDamper(**first), vrw.SpringDamper(**second), **turn)
    return vrw.ViscoelasticWheel(leg_force=legs)


def make_reference_params(*laws):
    """Return parameters of the reference code with one law for Leg 1 and one for Leg 2."""
    k, c = (np.array([(TABLE | law)[name] for law in laws]) for name in ("stiffness", "damping"))

    def leg_force(length, rate):
        if np.ndim(length) == 0:  # the preload of a leg on its stopper
            return k[0] * (1.02 - length) - c[0] * rate
        return k * (1.02 - length) - c * rate

    return five_coordinates.TABLE_1 | {"leg_force": leg_force}


TABLE = five_coordinates.TABLE_1


@pytest.fixture(scope="module")
def cycle():
    return vrw.limit_cycle(PARAMS, model=make_wheel(), period_n=2)


def test_a_gait_of_two_legs_is_a_fixed_point_of_two_steps_in_five_coordinates(cycle):
    x = np.asarray(cycle.section_state)
    for k, laws in enumerate([(FIRST, SECOND), (SECOND, FIRST)]):
        reference = five_coordinates.step(make_reference_params(*laws), x)
        np.testing.assert_allclose(reference["durations"], cycle.durations[k], atol=1e-10)
        assert abs(reference["lambda_plus"][3] - cycle.indicators.lambda_4[k]) < 1e-8
        x = reference["section_state"]
    np.testing.assert_allclose(x, cycle.section_state, atol=1e-10)
    assert int(cycle.minimal_period) == 2


def test_multipliers_are_those_of_two_steps_in_five_coordinates(cycle):
    def advance_twice(x):
        for laws in [(FIRST, SECOND), (SECOND, FIRST)]:
            x = five_coordinates.return_map(make_reference_params(*laws), x)
        return x

    jacobian = five_coordinates.jacobian(advance_twice, np.asarray(cycle.section_state))
    multipliers = sorted(np.linalg.eigvals(jacobian), key=abs)[::-1][:2]
    np.testing.assert_allclose(cycle.multipliers, multipliers, atol=1e-7)


def test_walks_and_batches_take_the_legs_in_turn(cycle):
    walk = vrw.walk(PARAMS, cycle.section_state, 4, model=make_wheel())
    np.testing.assert_allclose(walk.steps.durations[:2], cycle.durations, atol=1e-9)
    np.testing.assert_allclose(walk.steps.section_state[-1], cycle.section_state, atol=1e-8)
    for n_steps in (2, 3):
        batch = vrw.step_batch(PARAMS, cycle.section_state[None], n_steps, model=make_wheel())
        expected = walk.steps.section_state[n_steps - 1]
        np.testing.assert_allclose(batch.section_state[0], expected, atol=1e-9)
    other = vrw.step(PARAMS, walk.steps.section_state[0], model=make_wheel(turn=1.0))
    np.testing.assert_allclose(other.section_state, walk.steps.section_state[1], atol=1e-9)
    trajectory = vrw.simulate(PARAMS, cycle.section_state, 2, model=make_wheel())
    assert abs(float(trajectory.time[-1]) - cycle.period) < 1e-8
    assert "slopes" not in trajectory.attrs
    assert len(vrw.plot.walk_frames(trajectory, n_frames=2)[0]) == 2


def test_equal_legs_have_the_gait_of_the_wheel():
    law = {"damping": 150.0}
    cycle = vrw.limit_cycle(PARAMS, model=make_wheel(law, law), period_n=2)
    expected = vrw.limit_cycle(vrw.WheelParams(damping=150.0))
    np.testing.assert_allclose(cycle.section_state, expected.section_state, atol=1e-9)
    np.testing.assert_allclose(cycle.multipliers, expected.multipliers**2, atol=1e-8)
    assert int(cycle.minimal_period) == 1


@pytest.mark.slow
def test_derivatives_and_branches_by_a_parameter_of_one_leg_are_those_of_gaits():
    def measure_period(damping):
        model = make_wheel({"damping": damping})
        return vrw.limit_cycle(PARAMS, model=model, period_n=2).period

    difference = (measure_period(150.1) - measure_period(149.9)) / 0.2
    np.testing.assert_allclose(jax.grad(measure_period)(150.0), difference, rtol=1e-6)
    branch = vrw.continue_branch(
        PARAMS, "leg.first.damping", (148.0, 152.0), model=make_wheel(), period_n=2
    )
    periods = branch.dataset.period.values[[0, -1]]
    expected = [measure_period(value) for value in branch.values[[0, -1]]]
    np.testing.assert_allclose(periods, expected, atol=1e-9)


def test_scans_measure_both_steps_of_a_gait_together(cycle):
    names = ["period", "energy_lost_damping", "clearance_sls1", "d period / d leg.first.damping"]
    design = vrw.grid({"leg.first.damping": [149.9, 150.0, 150.1]})
    scan = vrw.scan(design, names, base=PARAMS, model=make_wheel())
    first = vrw.step(PARAMS, cycle.section_state, model=make_wheel())
    second = vrw.step(PARAMS, first.section_state, model=make_wheel(turn=1.0))
    # The gait and its steps have errors of 1e-10.
    np.testing.assert_allclose(scan.period[1], first.period + second.period, atol=1e-8)
    lost = first.energy.damping + second.energy.damping
    np.testing.assert_allclose(scan.energy_lost_damping[1], lost, rtol=1e-8)
    clearances = [step.margins.clearance_sls1 for step in (first, second)]
    np.testing.assert_allclose(scan.clearance_sls1[1], min(clearances), rtol=1e-7)
    assert clearances[0] > clearances[1] + 1e-3
    difference = float(scan.period[2] - scan.period[0]) / 0.2
    # The third derivative of the period makes an error of 1e-7 in the difference.
    np.testing.assert_allclose(scan["d period / d leg.first.damping"][1], difference, rtol=1e-6)


@pytest.mark.parametrize("turn", [0.0, 1.0])
def test_basins_know_whose_turn_it_is(cycle, turn):
    """The gait begins with the first leg, and one step later with the second."""
    states = vrw.walk(PARAMS, cycle.section_state, 2, model=make_wheel()).steps.section_state
    start = np.asarray(states[0 if turn else 1])
    wheel, names = make_wheel(turn=turn), ("theta_touchdown", "dtheta_touchdown", "dL1_touchdown")
    grid = dict(zip(names, start, strict=True)) | {names[1]: start[1] * np.array([0.95, 1.0, 1.05])}
    basin = vrw.basin(PARAMS, grid, model=wheel)
    assert basin.attractor.values.tolist() == [0, 0, 0]
    # Walks are periodic to 1e-7.
    orbit = basin.orbit_state.values[0, :2]
    np.testing.assert_allclose(orbit, [start, states[1 if turn else 0]], atol=1e-6)
    np.testing.assert_allclose(basin.orbit_dls_fraction, cycle.dls_fraction, atol=1e-6)
    box = grid | {names[1]: (0.95 * start[1], 1.05 * start[1])}
    share = vrw.basin_share(PARAMS, box, model=wheel, n_starts=8, max_steps=41)
    assert share.share == 1.0


@pytest.mark.slow
def test_tuning_keeps_a_margin_in_both_steps(cycle):
    """Speed and the lower clearance of both steps decrease with the damping of the second leg."""
    limit = 0.0705
    tuned = vrw.tune(
        PARAMS, {"speed": -1.0}, ["leg.second.damping"], {"leg.second.damping": (155.0, 185.0)},
        {"clearance_sls1": (limit, None)}, model=make_wheel(),
    )  # fmt: skip
    assert tuned.status.name == "CONVERGED"
    damping = float(tuned.model.leg_force.second.damping)
    legs = FIRST, SECOND | {"damping": damping}
    gait = vrw.limit_cycle(PARAMS, model=make_wheel(*legs), period_n=2)
    assert abs(float(gait.speed) + tuned.value) < 1e-9
    first = vrw.step(PARAMS, gait.section_state, model=make_wheel(*legs))
    second = vrw.step(PARAMS, first.section_state, model=make_wheel(*legs, turn=1.0))
    clearances = [float(step.margins.clearance_sls1) for step in (first, second)]
    assert abs(min(clearances) - limit) < 1e-7
    table = vrw.sensitivities(PARAMS, measures=["speed"], model=make_wheel(*legs))
    assert abs(float(table.value[0]) + tuned.value) < 1e-9


@pytest.mark.slow
def test_force_peaks_and_stoppers_see_both_legs(cycle):
    walk = vrw.simulate(PARAMS, cycle.section_state, 2, model=make_wheel(), n_samples=2001)
    assert abs(float(cycle.measure("peak_force")) - float(walk.lambda_2.max())) < 1e-2
    step = vrw.step(PARAMS, cycle.section_state, model=make_wheel())
    stiff = vrw.step(PARAMS, cycle.section_state, model=make_wheel(second=FIRST | {
        "stiffness": 520.0, "damping": 170.0, "natural_length": 1.03}))  # fmt: skip
    preloads = step.margins.locked_stopper_force - stiff.margins.locked_stopper_force
    assert np.all(np.abs(preloads[1::2]) > 4.0)  # every second leg is pressed by 5.2 N more


@pytest.mark.slow
def test_equal_legs_have_the_smallest_disturbance_of_the_wheel():
    law = {"damping": 150.0}
    expected = vrw.smallest_disturbance(vrw.WheelParams(damping=150.0)).size
    equal = vrw.smallest_disturbance(PARAMS, model=make_wheel(law, law))
    assert equal.size == pytest.approx(expected, rel=1e-6)
    # A smaller push of the other walk, whose legs differ, suffices.
    assert vrw.smallest_disturbance(PARAMS, model=make_wheel()).size < 0.6 * expected


GUESSED_WHEEL = make_wheel({"damping": 155.0}, SECOND | {"damping": 162.0})
DAMPINGS = ["leg.first.damping", "leg.second.damping"]


def test_a_fit_to_steps_of_five_coordinates_finds_the_damping_of_each_leg():
    x, durations = np.array(vrw.paper_start()), []
    for k in range(4):
        laws = (FIRST, SECOND) if k % 2 == 0 else (SECOND, FIRST)
        step = five_coordinates.step(make_reference_params(*laws), x)
        x = step["section_state"]
        durations.append(step["durations"])
    data = {
        "step": range(4), "period": np.sum(durations, 1), "period_error": [1e-4],
        "duration_dls": np.array(durations)[:, 0], "duration_dls_error": [1e-4],
    }  # fmt: skip
    fit = vrw.fit(data, PARAMS, DAMPINGS, model=GUESSED_WHEEL, start=vrw.paper_start(), n_starts=1)
    np.testing.assert_allclose(fit.values, [150.0, 170.0], rtol=1e-8)


@pytest.mark.slow
def test_fits_to_gaits_and_series_of_two_legs_find_both(cycle):
    find = functools.partial(vrw.fit, params=PARAMS, free=DAMPINGS, model=GUESSED_WHEEL, n_starts=1)
    gait = {name: [float(cycle.measure(name))] for name in ("period", "dls_fraction")}
    fit = find(gait | {f"{name}_error": [1e-4] for name in gait})
    np.testing.assert_allclose(fit.values, [150.0, 170.0], rtol=2e-6)
    walk = vrw.simulate(PARAMS, cycle.section_state, 4, model=make_wheel(), n_samples=400)
    times = np.arange(0.02, 2.5, 0.01)
    landings = np.cumsum(np.tile(np.sum(cycle.durations, 1), 2))
    times = times[np.abs(times[:, None] - landings).min(1) > 0.02]
    theta = np.interp(times, np.asarray(walk.time), np.asarray(walk.theta))
    series = {"time": times, "theta": theta, "theta_error": [1e-3]}
    # The samples are interpolated linearly.
    fit = find(series, start="gait", window=0)
    np.testing.assert_allclose(fit.values, [150.0, 170.0], rtol=2e-6)


@pytest.mark.slow
@pytest.mark.parametrize("turn", [0.0, 1.0])
def test_first_passages_of_two_legs_are_those_of_counted_walks(turn):
    """60,000 walks of at most 100 steps, of which none survives.

    Survivors of six steps have forgotten the gait, and the same leg has its turn again.
    """
    slope_sd, n, n_steps = 0.03, 60_000, 100
    model = make_wheel({"damping": 185.0}, {"damping": 205.0}, turn=turn)
    passage = vrw.first_passage(PARAMS, slope_sd, model=model)
    assert int(passage.status) == 0
    gait = vrw.limit_cycle(PARAMS, model=model, period_n=2)
    random = np.random.default_rng(7)
    slopes = 0.3 + slope_sd * random.standard_normal((n, n_steps + 1))
    slopes[:, 0] = 0.3
    starts = np.tile(gait.section_state, (n, 1))
    wheels = vrw.WheelParams(slope=slopes)
    n_stepped = vrw.step_batch(wheels, starts, n_steps, model=model).n_stepped
    assert n_stepped.max() < n_steps
    counted_error = 2.58 * np.std(n_stepped) / np.sqrt(n)
    difference = float(passage.mean_steps_from_gait) - np.mean(n_stepped)
    assert abs(difference) < counted_error + 1.5 * float(passage.error)
    lives = n_stepped[n_stepped >= 6] - 5  # with the step that fails
    counted_error = 2.58 * np.std(lives) / np.sqrt(len(lives))
    assert abs(float(passage.mean_steps) - np.mean(lives)) < counted_error + float(passage.error)
    with pytest.raises(ValueError, match="the legs alternate, but derivatives of sampled means"):
        jax.grad(lambda sd: vrw.first_passage(PARAMS, sd, model=model).mean_steps)(slope_sd)


def test_what_two_legs_cannot_do_is_refused_in_one_sentence():
    with pytest.raises(ValueError, match="a gait repeats after an even number of steps"):
        vrw.limit_cycle(PARAMS, model=make_wheel())
    design = vrw.grid(damping=[150.0])
    contact = vrw.UnilateralWheel(leg_force=make_wheel().leg_force)
    with pytest.raises(ValueError, match=r"with a UnilateralWheel vrw.scan takes gaits of one"):
        vrw.scan(design, ["period"], model=contact)
    with pytest.raises(ValueError, match="with a UnilateralWheel the data of gaits are of one"):
        vrw.fit({"period": [1.4], "period_error": [0.1]}, PARAMS, ["slope"], model=contact)
    with pytest.raises(ValueError, match="slope_sd is given and the legs alternate"):
        vrw.scan(design, ["period"], model=make_wheel(), slope_sd=0.01)
    with pytest.raises(ValueError, match="n_legs is 7, but legs alternate only if"):
        vrw.step(vrw.WheelParams(n_legs=7), vrw.paper_start(), model=make_wheel())


@pytest.mark.slow
def test_a_branch_of_two_kinked_legs_ends_in_the_gait_found_alone():
    legs = vrw.AlternatingLegs(BumpStop(100.0), BumpStop(160.0))
    model = vrw.ViscoelasticWheel(leg_force=legs)
    wheels = [vrw.WheelParams(damping=damping) for damping in (150.0, 150.5)]
    branch = vrw.continue_branch(wheels[0], "damping", (150.0, 150.5), model=model, period_n=2)
    alone = vrw.limit_cycle(wheels[1], model=model, period_n=2)
    end = branch.dataset.period[-1]
    assert float(end) == pytest.approx(float(alone.period), rel=1e-9)
