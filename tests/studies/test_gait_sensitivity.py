"""Gait sensitivity norms: long walks, differences, a second formulation, gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.slow_variants import mark_slow
from support.walkers import BALL_PARAMS, GRAVITY, JuggledBall

import vrw_jax as vrw
from vrw_jax.gaits import compute_sensitivity_norms, derivatives, make_finder
from vrw_jax.models import walk

TABLE_1 = vrw.WheelParams()
PERIOD_NORM = 3.509
"""Of Table 1's wheel, s/rad, by an independent code to 0.001."""
MEASURES = ("period", "speed", "dls_fraction", "step_length", "duration_dls", "duration_sls2")
HELD = vrw.RigidWheel(held_landing=True)


@pytest.fixture(scope="module")
def sensitivity():
    return vrw.gait_sensitivity(TABLE_1, MEASURES)


def test_the_norm_of_the_period_is_that_of_an_independent_code(sensitivity):
    assert abs(float(sensitivity.norm[0]) - PERIOD_NORM) < 1e-3
    assert sensitivity.ending == "The gait is stable, and the norms are finite."
    assert "3.50861 s per rad" in repr(sensitivity)


def test_squares_of_the_parts_add_up_to_the_square_of_the_norm(sensitivity):
    parts = sensitivity.ending_step, sensitivity.beginning_step, sensitivity.later_steps
    np.testing.assert_allclose(sum(x**2 for x in parts), sensitivity.norm**2, rtol=1e-12)


@pytest.mark.slow
def test_collocation_and_event_driven_steps_give_the_same_norms(sensitivity):
    finder = make_finder(None, TABLE_1.n_legs)
    x = vrw.limit_cycle(TABLE_1).section_state
    response = derivatives.compute_step_slope_response(
        finder.model, TABLE_1, x, MEASURES, vrw.StepOptions.tight()
    )
    by_steps = compute_sensitivity_norms(response)
    # The states are taken at different instants of the step; the norm does not depend on that.
    np.testing.assert_allclose(by_steps.sensitivity_norms, sensitivity.norm, rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(
        by_steps.beginning_step_response, sensitivity.beginning_step, atol=1e-6
    )


def test_a_long_walk_on_slightly_uneven_ground_has_that_standard_deviation(sensitivity):
    # 400 walks of 100 steps after 20 that settle: correlated samples, standard error near 0.4 %.
    n_lanes, n_steps, slope_sd = 400, 120, 1e-4
    slopes = 0.3 + slope_sd * np.random.default_rng(1).standard_normal((n_lanes, n_steps + 1))
    state = np.tile(vrw.limit_cycle(TABLE_1).section_state, (n_lanes, 1))
    periods = []
    for k in range(n_steps):
        pair = vrw.WheelParams(slope=slopes[:, k : k + 2])
        result = vrw.step_batch(pair, state, 1)
        state = np.asarray(result.section_state)
        periods.append(np.asarray(result.durations).sum(-1))
    deviation = np.std(np.stack(periods[20:])) / slope_sd
    assert abs(deviation / float(sensitivity.norm[0]) - 1.0) < 0.01


@pytest.mark.slow
def test_norms_along_a_branch_are_those_of_its_wheels():
    branch = vrw.continue_branch(TABLE_1, "damping", (198.0, 202.0))
    norms = vrw.measure_gait_sensitivity(branch, ("period", "speed"), n_points=3)
    assert norms.damping.values[[0, -1]].tolist() == branch.values[[0, -1]].tolist()
    assert norms.gait_sensitivity_period.attrs["units"] == "s per rad"
    for i in range(3):
        params = vrw.WheelParams(damping=float(norms.damping[i]))
        expected = vrw.gait_sensitivity(params, ("period", "speed")).norm
        along_branch = [norms.gait_sensitivity_period[i], norms.gait_sensitivity_speed[i]]
        np.testing.assert_allclose(along_branch, expected, rtol=1e-8)
    with pytest.raises(ValueError, match="give the model of the branch"):
        vrw.measure_gait_sensitivity(branch, "period", model=HELD)
    with pytest.raises(ValueError, match="measure of a step"):
        vrw.measure_gait_sensitivity(branch, "spectral_radius")


@pytest.mark.slow
def test_norms_are_infinite_at_unstable_gaits_of_a_branch():
    # A fold near 0.319 rad separates the stable gaits from the unstable ones.
    params = vrw.WheelParams(damping=105.0, stiffness=530.0, slope=0.318)
    branch = vrw.continue_branch(params, "slope", (0.3175, 0.325))
    norms = vrw.measure_gait_sensitivity(branch, "period", n_points=2)
    assert branch.stable[[0, -1]].tolist() == [True, False]
    norm_values = norms.gait_sensitivity_period.values
    assert np.isfinite(norm_values).tolist() == [True, False]
    assert np.isinf(norm_values[-1])


@pytest.mark.slow
def test_the_linear_map_is_that_of_differences_of_walks():
    # Central differences with steps of 1e-4 have errors near 1e-9 of derivatives near 1.
    cycle, h = vrw.limit_cycle(TABLE_1), 1e-4
    response = derivatives.compute_step_slope_response(
        vrw.ViscoelasticWheel(), TABLE_1, cycle.section_state, ("period",), vrw.StepOptions.tight()
    )
    exact = np.concatenate([response.C[0], response.D1, response.D0])
    point = np.concatenate([cycle.section_state, [0.3, 0.3]])

    def period(inputs):
        params = vrw.WheelParams(slope=jnp.asarray(inputs[3:]))
        step = walk(params, inputs[:3], 1, options=vrw.StepOptions.tight())
        return float(step.steps.durations.sum())

    for i, unit in enumerate(np.eye(5)):
        difference = lambda h, unit=unit: (
            (period(point + h * unit) - period(point - h * unit)) / (2.0 * h)
        )
        extrapolated = (4.0 * difference(h) - difference(2.0 * h)) / 3.0
        assert abs(extrapolated - exact[i]) < 1e-8, i


@pytest.mark.slow
def test_gradients_are_central_differences():
    norm = lambda damping: vrw.gait_sensitivity(vrw.WheelParams(damping=damping), "period").norm[0]
    gradient, h = float(jax.jit(jax.grad(norm))(180.0)), 0.05
    outer, inner = (float(norm(180.0 + k * h) - norm(180.0 - k * h)) / (2 * k * h) for k in (2, 1))
    assert abs(gradient / ((4.0 * inner - outer) / 3.0) - 1.0) < 1e-6


@pytest.mark.parametrize("ground", ["slope", "height"])
def test_norms_of_an_own_walker_are_those_of_a_geometric_series(ground):
    """A kick e to one bounce changes the periods by 2 e / g times 1, r, r^2, ...

    If the kick is the difference of two heights, the next bounce has the opposite kick.
    """
    walker = type("Ball", (JuggledBall,), {"ground": {ground: "kick"}})()
    result = vrw.gait_sensitivity(BALL_PARAMS, "period", model=walker)
    r, unit = BALL_PARAMS["ball"]["restitution"], 2.0 / GRAVITY
    next_step = r if ground == "slope" else r - 1.0
    later = abs(next_step) * r / np.sqrt(1.0 - r**2)
    np.testing.assert_allclose(result.ending_step, [unit], rtol=1e-12)
    np.testing.assert_allclose(result.beginning_step, [unit * next_step], rtol=1e-12)
    np.testing.assert_allclose(result.later_steps, [unit * later], rtol=1e-12)
    norm = unit * np.sqrt(1.0 + next_step**2 + later**2)
    np.testing.assert_allclose(result.norm, [norm], rtol=1e-12)
    assert ("s per rad" if ground == "slope" else "s per m") in repr(result)


def test_norms_of_a_batch_have_a_printed_line_and_a_sentence_for_each_gait():
    walker = type("Ball", (JuggledBall,), {"ground": {"slope": "kick"}})()
    find = lambda kick: vrw.gait_sensitivity(BALL_PARAMS | {"kick": kick}, "period", model=walker)
    batch = jax.vmap(find)(jnp.array([1.0, -1.0]))
    np.testing.assert_allclose(batch.norm, [find(1.0).norm, [0.0]], rtol=1e-12)
    assert batch.ending[0] == "The gait is stable, and the norms are finite."
    assert "fall back" in batch.ending[1]
    assert "gaits: 2 in shape (2,): 1 STEPPED, 1 FELL_BACK" in repr(batch)


def test_norms_along_a_branch_of_an_own_walker_are_those_of_a_geometric_series():
    """Changes of the period by 2 / g times 1, e, e^2, ... have the norm 2 / g / sqrt(1 - e^2)."""
    walker = type("Ball", (JuggledBall,), {"ground": {"slope": "kick"}})()
    branch = vrw.continue_branch(
        BALL_PARAMS, "ball.restitution", (0.2, 0.9), model=walker,
        cycle=vrw.limit_cycle(BALL_PARAMS, model=walker),
    )  # fmt: skip
    twice = ["period", "period"]  # has one variable
    norms = vrw.measure_gait_sensitivity(branch, twice, model=walker, n_points=3)
    expected = 2.0 / GRAVITY / np.sqrt(1.0 - norms["ball.restitution"] ** 2)
    np.testing.assert_allclose(norms.gait_sensitivity_period, expected, rtol=1e-12)
    assert norms.gait_sensitivity_period.attrs["units"] == "s per rad"
    with pytest.raises(ValueError, match="does not declare where the ground enters"):
        vrw.measure_gait_sensitivity(branch, "period", model=JuggledBall())
    with pytest.raises(ValueError, match="'speed' is no measure of a step of this walker"):
        vrw.measure_gait_sensitivity(branch, "speed", model=walker)
    two_steps = vrw.continue_branch(
        BALL_PARAMS, "kick", (0.9, 1.1), model=walker, period_n=2,
        cycle=vrw.limit_cycle(BALL_PARAMS, model=walker),
    )  # fmt: skip
    with pytest.raises(ValueError, match=r"repeat after 2 steps.*period_n=1"):
        vrw.measure_gait_sensitivity(two_steps, "period", model=walker)


NORM_NAMES = ["gait_sensitivity_period", "gait_sensitivity_speed"]


def test_the_norm_is_a_measure_of_cycles():
    expected = vrw.gait_sensitivity(TABLE_1, ("period", "speed")).norm
    cycle = vrw.limit_cycle(TABLE_1)
    np.testing.assert_allclose([cycle.measure(name) for name in NORM_NAMES], expected, rtol=1e-12)


@pytest.mark.slow  # compiles second derivatives of a step for a batch
def test_the_norm_is_a_measure_of_scans(tmp_path):
    expected = vrw.gait_sensitivity(TABLE_1, ("period", "speed")).norm
    design = vrw.grid(damping=[150.0, 200.0])
    scan = vrw.scan(design, measures=NORM_NAMES, store=tmp_path / "scan")
    np.testing.assert_allclose(scan.gait_sensitivity_period.values[1], expected[0], rtol=1e-9)


@pytest.mark.slow  # compiles derivatives of derivatives of a cycle
def test_the_norm_is_a_measure_of_tables_of_sensitivities():
    expected = vrw.gait_sensitivity(TABLE_1, ("period", "speed")).norm
    table = vrw.sensitivities(TABLE_1, measures=NORM_NAMES)
    np.testing.assert_allclose(table.value, expected, rtol=1e-9)
    gradient = jax.jit(jax.grad(lambda p: vrw.gait_sensitivity(p, "period").norm[0]))(TABLE_1)
    exact = [gradient.damping, gradient.slope]
    of_table = table.derivative.sel(measure=NORM_NAMES[0], parameter=["damping", "slope"])
    np.testing.assert_allclose(of_table, exact, rtol=1e-7)
    assert table.measure_unit.values.tolist() == ["s/rad", "m/(s rad)"]


@pytest.mark.slow
def test_the_rigid_wheel_has_the_norm_of_its_closed_map():
    params = vrw.WheelParams(slope=0.1)
    result = vrw.gait_sensitivity(params, ["period"], model=HELD, guess=[0.39, 1.5, 0.0])
    cycle = vrw.limit_cycle(params, model=HELD, guess=[0.39, 1.5, 0.0])

    def end_and_period(rate, slope, next_slope):
        pair = vrw.WheelParams(slope=jnp.stack([slope, next_slope]))
        step = vrw.step(pair, jnp.stack([jnp.asarray(jnp.pi / 8), rate, 0.0 * rate]), model=HELD)
        return jnp.stack([step.section_state[1], step.period])

    at_gait = cycle.section_state[1], jnp.asarray(0.1), jnp.asarray(0.1)
    (a, b1, b0), (c, d1, d0) = np.transpose(jax.jacfwd(end_and_period, (0, 1, 2))(*at_gait))
    # One number is the state, so that the sum over later steps is a geometric series.
    later = (c * (a * b0 + b1)) ** 2 / (1.0 - a * a)
    norm = np.sqrt(d0**2 + (c * b0 + d1) ** 2 + later)
    assert abs(float(result.norm[0]) / norm - 1.0) < 1e-9


def test_an_unstable_gait_has_an_infinite_norm():
    response = derivatives.SlopeResponse(
        jnp.diag(jnp.array([1.1, 0.2])), *jnp.ones((2, 2)), jnp.ones((1, 2)), *jnp.ones((2, 1))
    )
    assert float(compute_sensitivity_norms(response).sensitivity_norms[0]) == np.inf


@pytest.mark.parametrize(
    ("measures", "changes", "sentence"),
    [
        ("perod", {}, "did you mean 'period'"),
        ([], {}, "'nothing' is no measure of a step"),
        *mark_slow(("period", {"damping": 300.0}, "there is no gait whose sensitivity")),
    ],
)
def test_bad_arguments_are_one_sentence(measures, changes, sentence):
    with pytest.raises(ValueError, match=sentence):
        vrw.gait_sensitivity(vrw.WheelParams(**changes), measures)
