"""Tuning ends at optima that no neighbor improves, keeps its constraints and reports its end."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.files import assert_netcdf_round_trip
from support.slow_variants import mark_slow
from support.walkers import BALL_PARAMS, JuggledBall

import vrw_jax as vrw
from vrw_jax import tune
from vrw_jax.app.output import format_tuning_summary
from vrw_jax.gaits import make_finder
from vrw_jax.models import MARGIN_MEASURES
from vrw_jax.studies import TrialKind
from vrw_jax.studies.tune_maximization import (
    ACTIVE_BOUND_TOLERANCE,
    compute_max_violation,
    compute_slack_scales,
)
from vrw_jax.studies.tune_problem import (
    TuneProblem,
    make_tune_problem,
    parse_constraint_margins,
    restore_sign_of_bound,
)
from vrw_jax.wheel import PARAMETER_NAMES

PARAMETER_BOX = {
    "damping": (20.0, 215.0),
    "stiffness": (400.0, 600.0),
    "natural_length": (1.01, 1.04),
    "slope": (0.26, 0.34),
}
FREE_PARAMETERS = tuple(PARAMETER_BOX)


def make_problem(objective: object, constraints: object = None) -> TuneProblem:
    return make_tune_problem(
        vrw.WheelParams(), objective, FREE_PARAMETERS, PARAMETER_BOX, constraints
    )


@pytest.fixture(scope="module")
def max_dls_result() -> vrw.TuneResult:
    return tune(vrw.WheelParams(), "dls_fraction", FREE_PARAMETERS, PARAMETER_BOX)


@pytest.fixture(scope="module")
def max_dls_without_margins() -> vrw.TuneResult:
    return tune(vrw.WheelParams(), "dls_fraction", FREE_PARAMETERS, PARAMETER_BOX, {})


@pytest.mark.slow
def test_gradients_of_objective_and_all_constraints_agree_with_central_differences():
    problem = make_problem({"dls_fraction": 1.0, "speed": -0.3})
    u = np.array([0.7, 0.45, 0.4, 0.55])
    trial = problem.evaluate_trial(u, None)
    exact = np.vstack([trial.objective_gradient, trial.slack_jacobian])
    for i in range(u.size):
        h = 1e-3 * np.eye(u.size)[i]
        values = []
        for k in (-2, -1, 1, 2):
            displaced_trial = problem.evaluate_trial(u + k * h, trial)
            values.append(np.r_[displaced_trial.objective, displaced_trial.constraint_slacks])
        # Fourth order, and exact to the step's error over h.
        difference = (values[0] - 8.0 * values[1] + 8.0 * values[2] - values[3]) / 12e-3
        scale = np.maximum(np.abs(exact).max(axis=1), 1e-3)
        np.testing.assert_allclose(difference / scale, exact[:, i] / scale, atol=2e-6)


def test_the_optimum_meets_the_first_order_condition_and_every_margin(max_dls_result):
    assert max_dls_result.converged
    assert max_dls_result.kkt_residual < 1e-6
    assert {a.name for a in max_dls_result.active} >= {"takeoff_acceleration", "slope"}
    assert all(a.price > 0.0 for a in max_dls_result.active)
    retained = find_max_dls_trial(max_dls_result)
    # A constraint counts as kept within ACTIVE widths; the gait found afresh differs by 1e-9.
    assert (
        compute_max_violation(
            retained.constraint_slacks,
            compute_slack_scales(retained.constraint_slacks, retained.slack_jacobian),
        )
        <= 1.01 * ACTIVE_BOUND_TOLERANCE
    )


def find_max_dls_trial(tuned: vrw.TuneResult):
    """Return the trial at a result, computed without a guess."""
    problem = make_problem("dls_fraction")
    u = (
        np.array([float(getattr(tuned.params, n)) for n in FREE_PARAMETERS]) - problem.lower_bounds
    ) / problem.bound_widths
    return problem.evaluate_trial(u, None)


def test_an_iterate_just_inside_an_active_constraint_is_not_taken_for_the_optimum():
    """The velocity 1 / (1 - e) of a ball is at least 2 m/s, so that the least e is 1/2.

    As the velocity is convex, the step from e = 0.501 leaves a slack of 8e-6 m/s.
    """
    start = {"ball": {"restitution": 0.501}, "kick": 1.0}
    tuned = vrw.tune(
        start, {"velocity": -1.0}, ["ball.restitution"], {"ball.restitution": (0.2, 0.8)},
        {"velocity": 2.0}, model=JuggledBall(),
    )  # fmt: skip
    # The tolerance of the first-order condition, 1e-6, times the change between the bounds.
    assert tuned.value == pytest.approx(-2.0, abs=1e-6 * 4.0 * 0.6)


def test_no_wheel_on_a_grid_around_the_optimum_is_better(max_dls_result):
    problem = make_problem("dls_fraction")
    u = (
        np.array([float(getattr(max_dls_result.params, n)) for n in FREE_PARAMETERS])
        - problem.lower_bounds
    )
    u = u / problem.bound_widths
    centre = problem.evaluate_trial(u, None)
    better = retained = 0
    for offsets in itertools.product((-0.02, 0.0, 0.02), repeat=4):
        place = np.clip(u + np.array(offsets), 0.0, 1.0)
        trial = problem.evaluate_trial(place, centre)
        if trial.has_gait_on_branch and np.all(trial.constraint_slacks >= 0.0):
            retained += 1
            better += trial.objective > centre.objective + 1e-9
    assert retained >= 5
    assert better == 0


def test_without_margins_the_optimum_of_double_support_scuffs(
    max_dls_result, max_dls_without_margins
):
    free = max_dls_without_margins
    assert free.value > max_dls_result.value + 0.02
    assert "clearance_sls1" in free.violated_margins
    assert float(free.step.margins.clearance_sls1) < 0.0
    margins = vrw.default_margins(max_dls_result.params)
    for name, limit in margins.items():
        if name in MARGIN_MEASURES:
            minimum = float(jnp.min(getattr(max_dls_result.step.margins, name)))
            # 1e-6 of what the bounds' width changes: of take-off, 22 m/s^2.
            assert minimum >= limit * (1.0 - 3e-3)


def test_the_tuned_wheel_walks_and_satisfies_its_margins_on_every_step(max_dls_result):
    walk_result = max_dls_result.validation
    assert walk_result.outcome == vrw.Outcome.STEPPED
    assert walk_result.n_steps == 10
    assert walk_result.is_feasible
    assert walk_result.distance < 1e-7


def test_tuning_evaluates_few_gaits(max_dls_result):
    assert max_dls_result.n_evaluations <= 12


def test_a_lost_gait_shortens_the_step_and_is_reported():
    # lambda_4_plus = 0 ends the branch near c = 219: there is nothing to climb on beyond it.
    bounds = {"damping": (150.0, 400.0)}
    tuned = tune(vrw.WheelParams(), {"lambda_4_plus": -1.0}, ["damping"], bounds, {})
    is_gait_lost = tuned.path.kind.values == TrialKind.LOST
    assert tuned.status.name == "BRANCH_ENDED"
    assert tuned.n_backtracks == is_gait_lost.sum() > 0
    assert np.all(tuned.path.outcome.values[is_gait_lost] != vrw.Outcome.STEPPED)
    assert np.all(tuned.path.outcome.values[~is_gait_lost] == vrw.Outcome.STEPPED)
    assert np.all(tuned.path.damping.values[~is_gait_lost] <= float(tuned.params.damping))
    assert 219.0 < float(tuned.params.damping) < 220.0
    assert 0.0 < float(tuned.cycle.indicators.lambda_4) < 1e-3


@pytest.mark.parametrize("factor", [1e-18, 1e-200, 1e100])
def test_an_objective_in_other_units_has_the_same_optimum_and_prices_in_these_units(factor):
    bounds = {"damping": (20.0, 215.0), "slope": (0.26, 0.34)}
    results = [
        tune(vrw.WheelParams(), {"dls_fraction": weight}, list(bounds), bounds, {})
        for weight in (1.0, factor)
    ]
    assert [result.status.name for result in results] == ["CONVERGED"] * 2
    np.testing.assert_allclose(results[1].value, factor * results[0].value, rtol=1e-9)
    for first, other in zip(results[0].active, results[1].active, strict=True):
        assert first.name == other.name
        np.testing.assert_allclose(other.price, factor * first.price, rtol=1e-6)


@pytest.mark.parametrize(
    "free", [("damping", "stiffness"), *mark_slow((("damping", "stiffness", "slope"),))]
)
def test_any_start_finds_the_optimum_at_a_kink_and_the_multiplier_there(free):
    """The reference is the difference of optima with other limits: their slope is the multiplier.

    The friction margin is least at two instants at once, between which its gradient jumps.
    """
    bounds = {name: PARAMETER_BOX[name] for name in free}

    def tune_from(damping: float, limit: float) -> vrw.TuneResult:
        wheel, margin = vrw.WheelParams(damping=damping), {"friction_fore": limit}
        return tune(wheel, "dls_fraction", free, bounds, margin)

    displaced = [tune_from(120.0, 0.5 + change).value for change in (-1e-3, 1e-3)]
    results = [tune_from(damping, 0.5) for damping in (200.0, 120.0, 60.0)]
    for result in results:
        assert result.converged
        assert result.kinks == ("friction_fore",)
        assert "several instants" in str(result)
        np.testing.assert_allclose(result.value, results[0].value, rtol=1e-8)
        assert [active.name for active in result.active] == ["friction_fore", *free[2:]]
        # The values of optima have curvature, of which a central difference is free.
        difference = (displaced[0] - displaced[1]) / 2e-3
        np.testing.assert_allclose(result.active[0].price, difference, rtol=1e-3)


def test_an_objective_with_a_kink_is_maximized():
    """|speed - 1.2| has its least value 0 where the speed is 1.2 m/s."""

    def objective(cycle):
        return -jnp.abs(cycle.speed - 1.2)

    bounds = {"damping": (20.0, 215.0)}
    tuned = tune(vrw.WheelParams(), objective, ["damping"], bounds, {})
    assert tuned.converged
    assert tuned.kinks == ("objective",)
    assert float(tuned.cycle.speed) == pytest.approx(1.2, abs=1e-9)


def test_multipliers_that_are_not_unique_are_given_as_ranges():
    """A bound and a constraint hold the same wheel, so either may have the whole multiplier.

    The objective is the constrained speed. Its multiplier is at most 1, and that of the bound is at
    most the derivative of the speed with respect to damping.
    """
    cycle = vrw.limit_cycle(vrw.WheelParams(damping=100.0))
    given, bounds = {"speed": (None, float(cycle.speed))}, {"damping": (100.0, 150.0)}
    tuned = tune(vrw.WheelParams(damping=110.0), "speed", ["damping"], bounds, given)
    derivative = jax.grad(lambda params: vrw.limit_cycle(params).speed)(
        vrw.WheelParams(damping=100.0)
    ).damping
    assert [active.name for active in tuned.active] == ["speed", "damping"]
    for active, largest in zip(tuned.active, (1.0, -float(derivative)), strict=True):
        assert np.isnan(active.price)
        np.testing.assert_allclose(active.price_range, (0.0, largest), rtol=1e-4, atol=1e-9)
    assert "not unique: 0 to 1" in format_tuning_summary(tuned)


def test_no_branch_that_ends_is_called_a_maximum_inside_all_bounds():
    bounds = {"damping": (150.0, 400.0)}
    tuned = tune(vrw.WheelParams(), {"lambda_4_plus": -1.0}, ["damping"], bounds, {})
    assert tuned.status.name == "BRANCH_ENDED"
    assert not tuned.active
    assert tuned.describe()["held by"] == "the end of the branch, no constraint and no bound"


@pytest.mark.parametrize("bad", [jnp.nan, jnp.inf, -jnp.inf])
def test_trials_without_a_finite_objective_are_shortened(bad):
    """(c - 150)^2 has its least value at 150, beyond which trials meet no number."""

    def objective(cycle):
        damping = cycle.parameters[PARAMETER_NAMES.index("damping")]
        return jnp.where(damping > 160.0, bad, -((damping - 150.0) ** 2))

    bounds = {"damping": (100.0, 215.0)}
    tuned = tune(vrw.WheelParams(damping=110.0), objective, ["damping"], bounds, {})
    assert tuned.converged
    assert float(tuned.params.damping) == pytest.approx(150.0, abs=1e-3)
    beyond = tuned.path.damping.values > 160.0
    np.testing.assert_array_equal(beyond, tuned.path.kind.values == TrialKind.NOT_FINITE)
    assert tuned.n_backtracks == beyond.sum() > 0


@pytest.mark.slow
def test_a_climb_ends_where_the_objective_ceases_to_be_finite():
    def objective(cycle):
        damping = cycle.parameters[PARAMETER_NAMES.index("damping")]
        return jnp.where(damping > 160.0, jnp.nan, damping)

    bounds = {"damping": (100.0, 215.0)}
    tuned = tune(vrw.WheelParams(damping=110.0), objective, ["damping"], bounds, {}, n_starts=3)
    assert tuned.status.name == "BRANCH_ENDED"
    assert np.isfinite(tuned.value)
    assert 159.99 < float(tuned.params.damping) <= 160.0


@pytest.mark.parametrize(
    ("objective", "sentence"),
    [
        (lambda cycle: cycle.speed * jnp.nan, "is nan at the start"),
        (lambda cycle: cycle.speed + jnp.inf, "is inf at the start"),
        (lambda cycle: jnp.sqrt(0.0 * cycle.speed), "has a derivative that is not finite"),
    ],
)
def test_a_start_that_is_not_finite_is_refused_in_one_sentence(objective, sentence):
    bounds = {"damping": (100.0, 215.0)}
    with pytest.raises(ValueError, match=sentence) as caught:
        tune(vrw.WheelParams(damping=110.0), objective, ["damping"], bounds, {})
    assert "\n" not in str(caught.value)


def test_functions_of_cycle_and_step_are_objectives_like_names():
    u = np.array([0.7, 0.45, 0.4, 0.55])

    def faster(cycle, step):
        return cycle.speed - 0.01 * jnp.sum(step.durations)

    by_name = make_problem({"speed": 1.0, "period": -0.01}, {}).evaluate_trial(u, None)
    of_both = make_problem(faster, {}).evaluate_trial(u, None)
    of_cycle = make_problem(lambda cycle: cycle.speed - 0.01 * cycle.period, {}).evaluate_trial(
        u, None
    )
    for other in (of_both, of_cycle):
        np.testing.assert_allclose(other.objective, by_name.objective, rtol=1e-8)
        np.testing.assert_allclose(other.objective_gradient, by_name.objective_gradient, rtol=1e-6)


def test_the_path_is_a_labelled_dataset_and_the_result_prints_itself(max_dls_result, tmp_path):
    assert_netcdf_round_trip(max_dls_result.path, tmp_path)
    path = max_dls_result.path
    assert path.damping.attrs["units"] == "N s/m"
    assert path.sizes["evaluation"] == max_dls_result.n_evaluations
    assert path.attrs["ending"] == "CONVERGED"
    assert "takeoff_acceleration" in repr(max_dls_result)
    assert "<table>" in max_dls_result._repr_html_()


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
def test_invalid_arguments_of_tune_are_refused_in_one_sentence(changes, sentence):
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
def test_many_starts_reach_the_same_optimum(max_dls_result):
    many = tune(
        vrw.WheelParams(damping=30.0), "dls_fraction", FREE_PARAMETERS, PARAMETER_BOX, n_starts=8
    )
    assert many.converged
    np.testing.assert_allclose(many.value, max_dls_result.value, rtol=1e-6)
    walkers = np.isfinite(many.exploration.objective)
    assert walkers.sum() >= 4
    near = many.exploration.max_violations[walkers] < 0.05
    assert np.median(many.exploration.objective[walkers][near]) > 0.7  # of 0.786 after 25 steps


def test_with_many_starts_the_start_value_is_still_that_of_the_given_parameters():
    tuned = vrw.tune(
        BALL_PARAMS, "velocity", ["kick"], {"kick": (0.5, 1.5)}, model=JuggledBall(), n_starts=3
    )
    np.testing.assert_allclose([tuned.start_value, tuned.value], [2.0, 3.0], rtol=1e-9)


def test_a_start_without_a_gait_is_refused():
    bounds = {"damping": (20.0, 600.0)}
    with pytest.raises(ValueError, match="the start has no gait to tune"):
        tune(vrw.WheelParams(damping=500.0), "dls_fraction", ["damping"], bounds, {})


# Unilateral contact


def test_constraints_of_a_unilateral_gait_are_lower_bounds_or_ranges():
    ground = make_finder(vrw.UnilateralWheel(), 8)
    given = {"slip": (0.0, 0.05), "speed": 1.0}
    margins = parse_constraint_margins(vrw.WheelParams(), given, ground)
    assert margins == {"-slip": -0.05, "slip": 0.0, "speed": 1.0}
    assert [restore_sign_of_bound(*pair) for pair in margins.items()] == [0.05, 0.0, 1.0]
    assert parse_constraint_margins(vrw.WheelParams(), None, ground) == {}
    with pytest.raises(ValueError, match="clearance_sls1"):
        parse_constraint_margins(vrw.WheelParams(), ["clearance_sls1"], ground)
    with pytest.raises(ValueError, match="holds nothing"):
        parse_constraint_margins(vrw.WheelParams(), {"slip": (0.05, 0.0)}, ground)


@pytest.mark.parametrize(
    ("pair", "margins"),
    [
        ((None, 0.6), {"-dls_fraction": -0.6}),
        ((0.2, None), {"dls_fraction": 0.2}),
        ((0.2, 0.6), {"-dls_fraction": -0.6, "dls_fraction": 0.2}),
    ],
)
def test_none_at_an_end_of_a_constraint_s_range_is_no_bound(pair, margins):
    finder = make_finder(vrw.ViscoelasticWheel(), 8)
    assert parse_constraint_margins(vrw.WheelParams(), {"dls_fraction": pair}, finder) == margins


def test_a_range_without_any_bound_is_refused():
    finder = make_finder(vrw.ViscoelasticWheel(), 8)
    with pytest.raises(ValueError, match="bounds nothing"):
        parse_constraint_margins(vrw.WheelParams(), {"dls_fraction": (None, None)}, finder)


def test_an_upper_bound_alone_is_kept():
    bounds = {"damping": (100.0, 215.0)}
    given = {"dls_fraction": (None, 0.545)}
    tuned = tune(vrw.WheelParams(damping=120.0), "dls_fraction", ["damping"], bounds, given)
    assert tuned.value == pytest.approx(0.545, abs=1e-6)
    (active,) = tuned.active
    assert (active.name, active.limit) == ("dls_fraction", 0.545)


@pytest.mark.slow
def test_unilateral_tuning_keeps_the_slip_within_its_bound():
    """At mu = 0.5 more damping buys double support and slides further: here to the bound."""
    bounds, ground = {"damping": (270.0, 330.0)}, vrw.UnilateralWheel(friction=0.5)
    start = vrw.WheelParams(damping=280.0)
    given = {"slip": (0.0, 0.06), "speed": 0.1}
    problem = make_tune_problem(start, "dls_fraction", ["damping"], bounds, given, model=ground)
    trial = problem.evaluate_trial(problem.normalized_start, None)
    ends = [problem.evaluate_trial(problem.normalized_start + d, trial) for d in (1e-3, -1e-3)]
    np.testing.assert_allclose(
        trial.slack_jacobian[:, 0],
        (ends[0].constraint_slacks - ends[1].constraint_slacks) / 2e-3,
        rtol=1e-4,
    )
    tuned = tune(start, "dls_fraction", ["damping"], bounds, given, model=ground)
    assert float(tuned.step.slip) == pytest.approx(0.06, abs=1e-7)
    assert tuned.validation.is_feasible
    (active,) = tuned.active
    assert (active.name, active.limit) == ("slip", pytest.approx(0.06))
    assert active.price > 0.0


def estimate_log_life(params: vrw.WheelParams) -> jnp.ndarray:
    """Return the logarithm of the mean number of steps on random slopes."""
    return jnp.log(vrw.first_passage(params, 0.01, n_walkers=4096, tol=0.03).mean_steps)


@pytest.mark.slow  # docs/tuning.md runs the same call
def test_tuning_raises_the_mean_number_of_steps_on_random_slopes():
    """A second estimate with another seed confirms the life of the tuned wheel."""
    bounds = {"damping": (190.0, 202.0)}
    objective = vrw.WheelObjective(estimate_log_life)
    tuned = vrw.tune(vrw.WheelParams(), objective, ["damping"], bounds)
    assert tuned.converged
    assert [constraint.name for constraint in tuned.active] == ["damping"]
    assert float(tuned.params.damping) == 190.0
    passage = vrw.first_passage(tuned.params, 0.01, seed=7)
    relative_error = 0.03 + float(passage.error / passage.mean_steps)
    assert abs(np.exp(tuned.value) / float(passage.mean_steps) - 1.0) < relative_error
    assert tuned.value - tuned.start_value > 1.0  # 205 steps instead of 61
    assert tuned.objective == "estimate_log_life"


@pytest.mark.parametrize(
    ("wheel_function", "choices", "sentence"),
    [
        (lambda params: params.damping, {"n_starts": 4}, "n_starts is 4, but a WheelObjective"),
        (lambda params: jnp.ones(2) * params.damping, {}, "returns an array of shape"),
        (lambda params: "life", {}, "objective is 'life'"),
    ],
)
def test_bad_wheel_objectives_are_one_sentence(wheel_function, choices, sentence):
    with pytest.raises((TypeError, ValueError), match=sentence):
        vrw.tune(
            vrw.WheelParams(),
            vrw.WheelObjective(wheel_function),
            ["damping"],
            {"damping": (190.0, 202.0)},
            **choices,
        )
