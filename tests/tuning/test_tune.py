"""Tuning ends at optima that nothing nearby beats, keeps what it must, and says what it met."""

import itertools

import jax.numpy as jnp
import numpy as np
import pytest
from support.files import kept_by_netcdf

import vrw_jax as vrw
from vrw_jax.cycles import finder_of
from vrw_jax.cycles.premises import PREMISES, default_margins
from vrw_jax.results.measures import MARGINS
from vrw_jax.tuning.climbing import ACTIVE, Ending, Kind
from vrw_jax.tuning.objective import bound_of, breach, margins_of, slack_scales
from vrw_jax.tuning.problem import Tuned, TuneProblem, tune, tuning_problem

BOX = {
    "damping": (20.0, 215.0),
    "stiffness": (400.0, 600.0),
    "natural_length": (1.01, 1.04),
    "slope": (0.26, 0.34),
}
FREE = tuple(BOX)


def problem_of(objective: object, constraints: object = None) -> TuneProblem:
    return tuning_problem(vrw.WheelParams(), objective, FREE, BOX, constraints)


@pytest.fixture(scope="module")
def most_dls() -> Tuned:
    return tune(vrw.WheelParams(), "dls_fraction", FREE, BOX)


@pytest.fixture(scope="module")
def most_dls_at_any_price() -> Tuned:
    return tune(vrw.WheelParams(), "dls_fraction", FREE, BOX, {})


@pytest.mark.slow
def test_gradients_of_objective_and_all_constraints_agree_with_central_differences():
    problem = problem_of({"dls_fraction": 1.0, "speed": -0.3})
    u = np.array([0.7, 0.45, 0.4, 0.55])
    here = problem.evaluate(u, None)
    exact = np.vstack([here.gradient, here.slopes])
    for i in range(u.size):
        h = 1e-3 * np.eye(u.size)[i]
        values = []
        for k in (-2, -1, 1, 2):
            there = problem.evaluate(u + k * h, here)
            values.append(np.r_[there.objective, there.slack])
        # Fourth order, and exact to the step's error over h.
        difference = (values[0] - 8.0 * values[1] + 8.0 * values[2] - values[3]) / 12e-3
        scale = np.maximum(np.abs(exact).max(axis=1), 1e-3)
        np.testing.assert_allclose(difference / scale, exact[:, i] / scale, atol=2e-6)


def test_the_optimum_meets_the_first_order_condition_with_every_premise_kept(most_dls):
    assert most_dls.ending == Ending.CONVERGED
    assert most_dls.kkt_residual < 1e-6
    assert {a.name for a in most_dls.active} >= {"takeoff_acceleration", "slope"}
    assert all(a.price > 0.0 for a in most_dls.active)
    kept = problem_of("dls_fraction").trial(
        np.zeros(4), most_dls_gait(most_dls), vrw.Outcome.STEPPED, True
    )
    # A constraint counts as kept within ACTIVE widths; the gait found afresh differs by 1e-9.
    assert breach(kept.slack, slack_scales(kept.slack, kept.slopes)) <= 1.01 * ACTIVE


def most_dls_gait(tuned: Tuned):
    """The gait at a result, evaluated afresh and from no neighbour."""
    problem = problem_of("dls_fraction")
    u = (np.array([float(getattr(tuned.params, n)) for n in FREE]) - problem.lower) / problem.widths
    return problem.evaluate(u, None).told


def test_no_wheel_on_a_grid_around_the_optimum_is_better(most_dls):
    problem = problem_of("dls_fraction")
    u = np.array([float(getattr(most_dls.params, n)) for n in FREE]) - problem.lower
    u = u / problem.widths
    centre = problem.evaluate(u, None)
    better = kept = 0
    for offsets in itertools.product((-0.02, 0.0, 0.02), repeat=4):
        place = np.clip(u + np.array(offsets), 0.0, 1.0)
        trial = problem.evaluate(place, centre)
        if trial.found and np.all(trial.slack >= 0.0):
            kept += 1
            better += trial.objective > centre.objective + 1e-9
    assert kept >= 5
    assert better == 0


def test_without_premises_double_support_is_bought_by_scuffing(most_dls, most_dls_at_any_price):
    free = most_dls_at_any_price
    assert free.value > most_dls.value + 0.02
    assert "clearance_sls1" in free.unkept
    assert float(free.step.monitors.clearance_sls1) < 0.0
    margins = default_margins(most_dls.params)
    for name in PREMISES:
        if name in MARGINS:
            least = float(jnp.min(getattr(most_dls.step.monitors, name)))
            # 1e-6 of what the bounds' width changes: of take-off, 22 m/s^2.
            assert least >= margins[name] * (1.0 - 3e-3)


def test_the_tuned_wheel_walks_and_keeps_its_premises_on_every_step(most_dls):
    walked = most_dls.walked
    assert walked.outcome == vrw.Outcome.STEPPED
    assert walked.steps == 10
    assert walked.kept
    assert walked.distance < 1e-7


def test_it_takes_few_gaits(most_dls):
    assert most_dls.evaluations <= 12


def test_a_lost_gait_shortens_the_step_and_is_reported():
    # lambda_4_plus = 0 ends the branch near c = 219: there is nothing to climb on beyond it.
    bounds = {"damping": (150.0, 400.0)}
    tuned = tune(vrw.WheelParams(), {"lambda_4_plus": -1.0}, ["damping"], bounds, {})
    lost = tuned.path.kind.values == Kind.LOST
    assert tuned.ending == Ending.AT_A_BORDER
    assert tuned.shortened == lost.sum() > 0
    assert np.all(tuned.path.outcome.values[lost] != vrw.Outcome.STEPPED)
    assert np.all(tuned.path.outcome.values[~lost] == vrw.Outcome.STEPPED)
    assert np.all(tuned.path.damping.values[~lost] <= float(tuned.params.damping))
    assert 219.0 < float(tuned.params.damping) < 220.0
    assert 0.0 < float(tuned.cycle.indicators.lambda_4) < 1e-3


def test_functions_of_cycle_and_step_are_objectives_like_names():
    u = np.array([0.7, 0.45, 0.4, 0.55])

    def faster(cycle, step):
        return cycle.speed - 0.01 * jnp.sum(step.durations)

    by_name = problem_of({"speed": 1.0, "period": -0.01}, {}).evaluate(u, None)
    of_both = problem_of(faster, {}).evaluate(u, None)
    of_cycle = problem_of(lambda cycle: cycle.speed - 0.01 * cycle.period, {}).evaluate(u, None)
    for other in (of_both, of_cycle):
        np.testing.assert_allclose(other.objective, by_name.objective, rtol=1e-8)
        np.testing.assert_allclose(other.gradient, by_name.gradient, rtol=1e-6)


def test_the_path_is_a_labelled_dataset_and_the_result_prints_itself(most_dls, tmp_path):
    kept_by_netcdf(most_dls.path, tmp_path)
    path = most_dls.path
    assert path.damping.attrs["units"] == "N s/m"
    assert path.sizes["evaluation"] == most_dls.evaluations
    assert path.attrs["ending"] == "CONVERGED"
    assert "takeoff_acceleration" in repr(most_dls)
    assert "<table>" in most_dls._repr_html_()


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"free": ["dampin"], "bounds": {"dampin": (1.0, 2.0)}}, r"did you mean 'damping'\?"),
        ({"free": [], "bounds": {}}, "at least one must move"),
        ({"free": ["damping"], "bounds": {}}, "damping is free but has no bounds"),
        ({"bounds": {"damping": (215.0, 20.0)}}, "which holds nothing"),
        ({"bounds": {"damping": (20.0, 20.0)}}, "which holds nothing"),
        ({"bounds": {"damping": (20.0, 100.0)}}, "outside its bounds"),
        ({"constraints": ["clearance_sls"]}, r"did you mean 'clearance_sls"),
        ({"constraints": {"contraction": float("nan")}}, "must be finite"),
        ({"objective": "dls"}, r"no measure for objective"),
        ({"objective": "locked_stopper_force"}, "one value for each locked leg"),
        ({"objective": {}}, "empty mapping"),
        ({"params": vrw.WheelParams(damping=jnp.array([1.0, 2.0]))}, "one wheel"),
        ({"tolerance": 0.0}, "must be positive"),
        ({"max_evaluations": 0}, "at least 1"),
        ({"n_starts": 0}, "at least 1"),
    ],
)
def test_bad_input_is_answered_in_one_sentence(changes, sentence):
    given = {
        "params": vrw.WheelParams(),
        "objective": "dls_fraction",
        "free": ["damping"],
        "bounds": {"damping": (20.0, 215.0)},
        "constraints": {},
    } | changes
    with pytest.raises(ValueError, match=sentence) as caught:
        tune(**given)
    assert "\n" not in str(caught.value)


@pytest.mark.slow
def test_many_starts_side_by_side_end_at_the_same_optimum(most_dls):
    many = tune(vrw.WheelParams(damping=30.0), "dls_fraction", FREE, BOX, n_starts=8)
    assert many.ending == Ending.CONVERGED
    np.testing.assert_allclose(many.value, most_dls.value, rtol=1e-6)
    walkers = np.isfinite(many.lanes.objective)
    assert walkers.sum() >= 4
    near = many.lanes.breach[walkers] < 0.05
    assert np.median(many.lanes.objective[walkers][near]) > 0.7  # of 0.786 after 25 steps


def test_a_start_without_a_gait_is_refused():
    bounds = {"damping": (20.0, 600.0)}
    with pytest.raises(ValueError, match="the start has no gait to tune"):
        tune(vrw.WheelParams(damping=500.0), "dls_fraction", ["damping"], bounds, {})


# Real ground --------------------------------------------------------------------------------------


def test_what_a_gait_on_real_ground_must_keep_is_a_least_value_or_a_range():
    ground = finder_of(vrw.UnilateralWheel(), 8)
    given = {"slip": (0.0, 0.05), "speed": 1.0}
    margins = margins_of(vrw.WheelParams(), given, ground)
    assert margins == {"-slip": -0.05, "slip": 0.0, "speed": 1.0}
    assert [bound_of(*pair) for pair in margins.items()] == [0.05, 0.0, 1.0]
    assert margins_of(vrw.WheelParams(), None, ground) == {}
    with pytest.raises(ValueError, match="clearance_sls1"):
        margins_of(vrw.WheelParams(), ["clearance_sls1"], ground)
    with pytest.raises(ValueError, match="holds nothing"):
        margins_of(vrw.WheelParams(), {"slip": (0.05, 0.0)}, ground)


@pytest.mark.slow
def test_tuning_on_real_ground_slides_no_further_than_allowed():
    """At mu = 0.5 more damping buys double support and slides further: here to the bound."""
    bounds, ground = {"damping": (270.0, 330.0)}, vrw.UnilateralWheel(friction=0.5)
    start = vrw.WheelParams(damping=280.0)
    given = {"slip": (0.0, 0.06), "speed": 0.1}
    problem = tuning_problem(start, "dls_fraction", ["damping"], bounds, given, model=ground)
    here = problem.evaluate(problem.start_u, None)
    ends = [problem.evaluate(problem.start_u + d, here) for d in (1e-3, -1e-3)]
    np.testing.assert_allclose(here.slopes[:, 0], (ends[0].slack - ends[1].slack) / 2e-3, rtol=1e-4)
    tuned = tune(start, "dls_fraction", ["damping"], bounds, given, model=ground)
    assert float(tuned.step.slip) == pytest.approx(0.06, abs=1e-7)
    assert tuned.walked.kept
    (active,) = tuned.active
    assert (active.name, active.limit) == ("slip", pytest.approx(0.06))
    assert active.price > 0.0
