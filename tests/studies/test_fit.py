"""`vrw.fit`: estimates, uncertainties and predictions, for each kind of data and of walker."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr
from support.walkers import (
    BALL_PARAMS,
    BALL_SYSTEM,
    GRAVITY,
    SIMPLEST_WALKER,
    JuggledBall,
    SlowReturn,
)

import vrw_jax as vrw

SMALL_WHEEL = vrw.WheelParams(slope=0.25).scaled(mass=0.1, length=0.4, time=0.4**0.5)
"""Wheel of 1.8 kg with legs of 0.4 m under the same gravity."""
SMALL_GAIT = {
    "period": [0.300], "period_error": [0.004],
    "dls_fraction": [0.40], "dls_fraction_error": [0.02],
    "speed": [0.95], "speed_error": [0.02],
}  # fmt: skip
WHEEL = vrw.WheelParams(damping=150.0)
START = [0.1, 1.75, -0.1]
DURATIONS = ("duration_dls", "duration_sls1", "duration_sls2")


def tabulate_steps(durations, error=0.002, **columns):
    data = {"step": np.arange(len(durations)), **columns}
    for name, column in zip(DURATIONS, np.asarray(durations).T, strict=False):
        data |= {name: column, f"{name}_error": [error]}
    return data


def average_series(walk, times, window, name):
    """Return means over windows of a trajectory, by the trapezoidal rule."""
    time = walk.time.values + 1e-12 * np.arange(walk.sizes["time"])  # jumps are steep ramps
    offsets = np.linspace(-1.0, 1.0, 8001)
    values = np.interp(times[:, None] + window * offsets, time, walk[name])
    return np.trapezoid((1.0 - np.abs(offsets)) * values, offsets, axis=1)


@pytest.fixture(scope="module")
def small_fit():
    return vrw.fit(SMALL_GAIT, SMALL_WHEEL)


@pytest.fixture(scope="module")
def step_fit():
    walk = vrw.walk(WHEEL, START, 6)
    return vrw.fit(tabulate_steps(walk.steps.durations), WHEEL)


@pytest.fixture(scope="module")
def series_fit():
    walk = vrw.simulate(WHEEL, START, 2, n_samples=400)
    times = np.arange(0.05, 1.1, 0.025)
    data = {"time": times + 0.004}
    for name, error in {"lambda_1": 2.0, "lambda_2": 5.0, "lambda_4": 5.0, "L1": 0.002}.items():
        column = average_series(walk, times, 0.025, name)
        data |= {name: column, f"{name}_error": [error]}
    free = ("damping", "stiffness", "time_offset")
    return vrw.fit(data, WHEEL, free, start=START, n_starts=1)


def test_a_small_wheel_has_the_estimates_of_another_code(small_fit):
    """The reference is a least-squares fit and a bootstrap with SciPy and another simulator."""
    assert small_fit.converged
    assert small_fit["damping"] == pytest.approx(12.21, abs=0.01)
    assert small_fit["stiffness"] == pytest.approx(165.9, abs=0.05)
    assert small_fit.error("damping") == pytest.approx(0.89, abs=0.01)
    assert small_fit.error("stiffness") == pytest.approx(1.5, abs=0.02)
    correlation = small_fit.correlation.sel(unknown="damping", other="stiffness")
    assert float(correlation) == pytest.approx(0.85, abs=0.01)
    assert small_fit.params.damping == small_fit["damping"]


def test_measured_steps_return_the_wheel_that_made_them(step_fit):
    """The reference is the wheel and the start of `vrw.walk`. Errors of steps are 1e-9."""
    assert step_fit.chi2 < 1e-8
    np.testing.assert_allclose(step_fit.values[:2], [150.0, 500.0], rtol=1e-6)
    assert step_fit["start.theta_touchdown"] == pytest.approx(START[0], abs=1e-5)


@pytest.mark.slow  # compiles samples of steps with derivatives for a minute
def test_a_measured_series_returns_the_wheel_and_the_offset_of_its_clock(series_fit):
    """The reference is the trapezoidal rule over `vrw.simulate`, whose samples have errors of
    1e-3 N."""
    assert series_fit["damping"] == pytest.approx(150.0, abs=0.05)
    assert series_fit["stiffness"] == pytest.approx(500.0, abs=0.05)
    assert series_fit["time_offset"] == pytest.approx(0.004, abs=2e-5)
    assert series_fit.chi2 < 1e-3


@pytest.mark.parametrize(
    "kind", ["small_fit", "step_fit", pytest.param("series_fit", marks=pytest.mark.slow)]
)
def test_jacobians_agree_with_differences(kind, request):
    """The bound is that of the errors of predictions, 1e-9, divided by the change."""
    result = request.getfixturevalue(kind)
    predict = jax.jit(lambda x: result.problem.predict(x).values)
    for i, (value, column) in enumerate(zip(result.values, result.jacobian.T, strict=True)):
        change = 1e-4 * max(abs(value), 0.01)
        up, down, far_up, far_down = (
            np.asarray(predict(jnp.asarray(result.values).at[i].add(k * change)))
            for k in (1, -1, 2, -2)
        )
        differences = (8.0 * (up - down) - (far_up - far_down)) / (12.0 * change)
        largest = np.abs(column).max()
        np.testing.assert_allclose(column.T, differences, atol=1e-7 * largest + 1e-7, rtol=1e-7)


@pytest.mark.slow  # compiles steps on uneven ground
def test_uneven_ground_and_several_walks():
    """The reference is `vrw.walk` on the same slopes."""
    slopes = np.array([0.30, 0.31, 0.29, 0.30])
    walks = [vrw.walk(vrw.WheelParams(damping=150.0, slope=slopes[:n]), START, n) for n in (4, 3)]
    tables = [
        tabulate_steps(w.steps.durations, slope=slopes[:n])
        for w, n in zip(walks, (4, 3), strict=True)
    ]
    data = {
        name: np.concatenate([np.broadcast_to(t[name], len(t["step"])) for t in tables])
        for name in tables[0]
    }
    data["walk"] = np.repeat([7, 9], [4, 3])
    result = vrw.fit(data, WHEEL, start=START, n_starts=1)
    assert result.chi2 < 1e-8
    np.testing.assert_allclose(result.values, [150.0, 500.0], rtol=1e-6)


def test_a_batch_of_data_sets_has_the_estimates_of_each(small_fit):
    batch = small_fit.bootstrap(20, seed=1)
    numbers = small_fit.simulate(20, seed=1)
    for i in (0, 7):
        data = SMALL_GAIT | {
            name: numbers[i, :, k] for k, name in enumerate(("period", "dls_fraction", "speed"))
        }
        single = vrw.fit(data, SMALL_WHEEL)
        np.testing.assert_allclose(batch.values[i], single.values, rtol=1e-4)
        assert batch.chi2[i] == pytest.approx(single.chi2, abs=1e-5)
    assert batch.converged.all()
    dataset = xr.Dataset({name: ("trial", column) for name, column in SMALL_GAIT.items()})
    for k, name in enumerate(("period", "dls_fraction", "speed")):
        dataset[name] = (("dataset", "trial"), numbers[:2, :, k])
    of_dimension = vrw.fit(dataset, SMALL_WHEEL)
    of_one_row = vrw.fit(dataset.isel(trial=0, drop=True), SMALL_WHEEL)
    np.testing.assert_array_equal(of_one_row.values, of_dimension.values)
    np.testing.assert_allclose(of_dimension.values, batch.values[:2], rtol=1e-4)
    assert "spread" in str(of_dimension)
    assert "spread" not in str(vrw.fit(dataset.isel(dataset=[0]), SMALL_WHEEL))


def test_a_search_from_a_wheel_without_a_gait_finds_the_wheel(small_fit):
    start = dataclasses.replace(SMALL_WHEEL, damping=60.0)
    assert not bool(vrw.limit_cycle(start).found)
    bounds = {"damping": (5.0, 80.0), "stiffness": (100.0, 300.0)}
    result = vrw.fit(SMALL_GAIT, start, bounds=bounds)
    np.testing.assert_allclose(result.values, small_fit.values, rtol=1e-5)


def test_forms_and_units_of_data_do_not_matter(small_fit, tmp_path):
    pandas = pytest.importorskip("pandas")
    in_ms = {"period [ms]": [300.0], "period_error [ms]": [4.0], "dls_fraction [%]": [40.0]}
    in_ms |= {"dls_fraction_error [%]": [2.0], "speed": [0.95], "speed_error": [0.02]}
    file = tmp_path / "gait.csv"
    file.write_text(",".join(in_ms) + "\n" + ",".join(str(x[0]) for x in in_ms.values()) + "\n")
    dataset = xr.Dataset({name: ("trial", column) for name, column in SMALL_GAIT.items()})
    dataset["speed"] = ("trial", [95.0], {"units": "cm/s"})
    dataset["speed_error"] = ("trial", [2.0], {"units": "cm/s"})
    variances = np.diag([0.004, 0.02, 0.02]) ** 2
    exact = {name: SMALL_GAIT[name] for name in ("period", "dls_fraction", "speed")}
    for data, keywords in (
        (file, {}),
        (pandas.DataFrame(in_ms), {}),
        (dataset, {}),
        (exact, {"covariance": variances}),
        (
            {"period [ms]": [300.0], "dls_fraction": [0.4], "speed [cm/s]": [95.0]},
            {"covariance": np.diag([4.0, 0.02, 2.0]) ** 2},
        ),
    ):
        result = vrw.fit(data, SMALL_WHEEL, **keywords)
        np.testing.assert_allclose(result.values, small_fit.values, rtol=1e-9)
        np.testing.assert_allclose(result.covariance, small_fit.covariance, rtol=1e-6)


def test_forces_that_grow_together_are_not_identifiable(small_fit):
    """By similarity, durations and lengths stay the same if all masses and forces grow by one
    factor."""
    free = ("hub_mass", "leg_mass", "stiffness", "damping")
    single_support = vrw.limit_cycle(small_fit.params).durations[1:2]
    data = SMALL_GAIT | {"duration_sls1": single_support, "duration_sls1_error": [0.002]}
    result = vrw.fit(data, SMALL_WHEEL, free, n_starts=1)
    (direction,) = result.unidentifiable
    starts = np.array([float(getattr(SMALL_WHEEL, name)) for name in free])
    expected = result.values / starts
    found = np.array(list(direction.values()))
    assert found.max() == np.abs(found).max()
    np.testing.assert_allclose(found / found[0], expected / expected[0], rtol=1e-4)
    assert np.isinf(result.standard_errors).all()
    assert "not identifiable" in repr(result)


def test_a_prior_counts_as_a_measurement(small_fit):
    """The reference is the sum of the information of both, to first order in the small shift."""
    error = small_fit.error("damping")
    prior = {"damping": (small_fit["damping"], error)}
    result = vrw.fit(SMALL_GAIT, SMALL_WHEEL, priors=prior)
    assert result.error("damping") == pytest.approx(error / np.sqrt(2.0), rel=1e-4)
    assert result.dof == 2


def test_a_bound_holds_and_is_named():
    result = vrw.fit(SMALL_GAIT, SMALL_WHEEL, bounds={"damping": (14.0, 40.0)})
    assert result["damping"] == pytest.approx(14.0, abs=1e-4)
    assert result.at_bound == ("damping",)
    assert result.converged


def test_fitted_parameters_contain_their_offset():
    """The reference is the slope of the wheel whose gait is measured."""
    cycle = vrw.limit_cycle(vrw.WheelParams(damping=150.0, slope=0.32))
    data = {"period": [cycle.period], "period_error": [0.001]}
    result = vrw.fit(data, WHEEL, ["slope_offset"], n_starts=1)
    assert result["slope_offset"] == pytest.approx(0.32 - float(WHEEL.slope), abs=1e-6)
    assert result.params.slope == pytest.approx(0.32, abs=1e-6)


def test_what_sensors_report_is_fitted_too():
    """The reference is the delay that is added to the durations."""
    slopes = np.array([0.28, 0.32])
    cycles = vrw.limit_cycles(vrw.WheelParams(damping=150.0, slope=slopes))
    data = {"slope": slopes}
    data |= {"late_dls": cycles.durations[:, 0] + 0.006, "late_dls_error": [0.001]}
    data |= {"early_sls": cycles.durations[:, 1] - 0.006, "early_sls_error": [0.001]}

    def observe(measures, extra):
        return {
            "late_dls": measures["duration_dls"] + extra["delay"],
            "early_sls": measures["duration_sls1"] - extra["delay"],
        }

    result = vrw.fit(data, WHEEL, ["damping"], extra={"delay": 0.0}, observe=observe, n_starts=1)
    assert result["delay"] == pytest.approx(0.006, abs=1e-6)
    assert result["damping"] == pytest.approx(150.0, abs=1e-3)


def test_the_likelihood_of_the_data_is_that_of_normal_noise(small_fit):
    """The references are the density of normal errors, and its maximum at the estimates."""
    density = jax.jit(small_fit.log_likelihood)
    expected = -0.5 * small_fit.chi2 - np.sum(
        np.log(np.sqrt(2.0 * np.pi) * np.array([0.004, 0.02, 0.02]))
    )
    assert float(density(small_fit.values)) == pytest.approx(expected, abs=1e-9)
    slope = jax.grad(small_fit.log_likelihood)(jnp.asarray(small_fit.values))
    assert np.all(np.abs(slope) * small_fit.standard_errors < 1e-2)
    assert float(density(np.array([300.0, 166.0]))) == -np.inf  # no gait


def test_ends_of_a_profile_interval_raise_chi2_by_the_quantile(small_fit):
    """The reference is a fit with the end as the only allowed value."""
    low, high = small_fit.profile_interval("damping", 0.6827)
    for end in (low, high):
        result = vrw.fit(SMALL_GAIT, SMALL_WHEEL, priors={"damping": (end, 1e-5)}, n_starts=1)
        assert result.chi2 - small_fit.chi2 == pytest.approx(1.0, abs=0.01)
    bound = small_fit["damping"] + 0.5 * small_fit.error("damping")
    bounds = {"damping": (1.0, bound)}
    bounded = vrw.fit(SMALL_GAIT, small_fit.params, bounds=bounds, n_starts=1)
    assert bounded.profile_interval("damping", 0.6827) == pytest.approx((low, np.inf), abs=1e-3)


def test_steps_of_a_hybrid_system_are_fitted():
    """The reference is the slope of the walker that took the steps."""
    params, x, durations, angles = {"slope": 0.012}, np.array([0.21, -0.21]), [], []
    for _ in range(4):
        step = SIMPLEST_WALKER.step(params, x)
        x = np.asarray(step.section_state)
        durations.append(float(step.duration))
        angles.append(x[0])
    data = {"step": np.arange(4), "period": durations, "period_error": [0.01]}
    data |= {"x0": angles, "x0_error": [0.001]}
    result = vrw.fit(
        data, {"slope": 0.009}, ["slope"], model=SIMPLEST_WALKER, start=[0.21, -0.21], n_starts=1
    )
    assert result["slope"] == pytest.approx(0.012, abs=1e-8)
    assert result.params["slope"] == result["slope"]


class BallOnStairs(vrw.AbstractWalker):
    """Ball that is kicked to the same speed at each bounce, on stairs. Its flights have a closed
    form."""

    coordinates = {"velocity": "m/s"}  # noqa: RUF012
    ground = {"height": "rise"}  # noqa: RUF012

    def advance(self, params, x, options):
        fall = jnp.sqrt(x[0] ** 2 - 2.0 * GRAVITY * params["rise"])
        duration = (x[0] + fall) / GRAVITY
        return vrw.AdvanceResult(jnp.stack([params["restitution"] * fall]), duration[None])

    def sample_motion(self, params, x, options, n_samples):
        duration = self.advance(params, x, options).durations
        time = jnp.linspace(0.0, 1.0, n_samples) * duration[0]
        return {"height": (x[0] * time - 0.5 * GRAVITY * time**2)[None]}, duration


@pytest.mark.parametrize(
    "walker", [pytest.param(BALL_SYSTEM, marks=pytest.mark.slow), JuggledBall()]
)
def test_measures_of_gaits_of_any_walker_are_fitted(walker):
    """The reference is the gait in closed form: v = k / (1 - e), T = 2 v / g, h = v^2 / (2 g)."""
    speed = np.array([1.0, 1.5]) / (1.0 - 0.6)
    data = {"kick": [1.0, 1.5], "period": 2.0 * speed / GRAVITY, "period_error": [0.01]}
    data |= {"height": 0.5 * speed**2 / GRAVITY, "height_error": [0.01]}
    result = vrw.fit(data, BALL_PARAMS, ["ball.restitution"], model=walker, n_starts=1)
    assert result["ball.restitution"] == pytest.approx(0.6, abs=1e-6)
    # dT/de = 2 k / (g (1 - e)^2), dh/de = k^2 / (g (1 - e)^3)
    kicks, loss = np.array([1.0, 1.5]), 1.0 - result["ball.restitution"]
    slopes = [2.0 * kicks / loss**2 / GRAVITY, kicks**2 / loss**3 / GRAVITY]
    np.testing.assert_allclose(result.jacobian[..., 0].T, slopes, rtol=1e-8)  # error of a gait
    unknowns = {"names": ("damping", "stiffness"), "units": ("N s/m^2", "1")}
    numbers = {"values": np.ones(2), "standard_errors": np.ones(2), "covariance": np.eye(2)}
    figure = vrw.plot.fit_figure(dataclasses.replace(result, **unknowns, **numbers))
    period, height, _, ellipse = figure.axes
    # The period of a gait has one symbol for all walkers.
    assert [period.get_ylabel(), height.get_ylabel()] == ["$T$ [s]", "height [m]"]
    # Names of parameters of the wheel do not have its symbols and units here.
    assert [ellipse.get_xlabel(), ellipse.get_ylabel()] == ["damping [N·s/m²]", "stiffness"]
    batch = dataclasses.replace(result, values=np.ones((2, 1)), standard_errors=np.ones((2, 1)))
    with pytest.raises(ValueError, match="have one unknown"):
        vrw.plot.fit_figure(batch)


def test_gaits_far_from_the_starts_of_a_walker_are_fitted():
    """Newton's method does not reach them, so that the search begins at gaits found by walks."""
    data = {"offset": [3.0, 3.2], "offset_error": [0.1, 0.1]}
    result = vrw.fit(data, {"c": 1.0}, ["c"], model=SlowReturn(), n_starts=1)
    # The search ends where chi2 hardly decreases: 7e-5 is 1e-3 of the standard error.
    assert result["c"] == pytest.approx(3.1, abs=7e-5)


def test_uneven_ground_of_any_walker_and_an_unknown_start():
    """The reference is the walk in closed form, computed here once more."""
    heights, speed, durations = np.array([0.1, 0.05, 0.2, 0.15]), 4.0, []
    for rise in np.diff(heights, prepend=0.0):
        fall = np.sqrt(speed**2 - 2.0 * GRAVITY * rise)
        durations.append((speed + fall) / GRAVITY)
        speed = 0.8 * fall
    data = {"step": np.arange(4), "height": heights}
    data |= {"period": durations, "period_error": [0.01]}
    params = {"restitution": 0.7, "rise": 0.0}
    with pytest.raises(ValueError, match="no starts"):
        vrw.fit(data, params, ["restitution"], model=BallOnStairs())
    result = vrw.fit(data, params, ["restitution"], model=BallOnStairs(), start=[4.0], n_starts=1)
    assert result["restitution"] == pytest.approx(0.8, abs=1e-5)


@pytest.mark.parametrize(
    "walker", [pytest.param(BALL_SYSTEM, marks=pytest.mark.slow), BallOnStairs()]
)
def test_series_of_any_walker_are_fitted(walker):
    """The reference is the mean of a parabola: its value minus g w^2 / 12."""
    times = np.array([0.1, 0.2, 0.3, 0.45, 0.55, 0.65])
    speeds = np.where(times < 0.4, 2.0, 1.4)
    since = np.where(times < 0.4, times, times - 4.0 / GRAVITY)
    window = 0.02
    exact = speeds * since - 0.5 * GRAVITY * (since**2 + window**2 / 6.0)
    data = {"time": times + 0.003, "height": exact, "height_error": [0.001]}
    is_system = walker is BALL_SYSTEM
    params = {"ball": {"restitution": 0.65}, "kick": 0.0}
    if not is_system:
        params = {"restitution": 0.65, "rise": 0.0}
    name = "ball.restitution" if is_system else "restitution"
    result = vrw.fit(
        data, params, [name, "time_offset"], model=walker, start=[2.0], window=window, n_starts=1
    )
    assert result[name] == pytest.approx(0.7, abs=1e-6)
    assert result["time_offset"] == pytest.approx(0.003, abs=1e-6)
    # by the offset: minus the mean velocity; by the restitution: the height since its bounce
    since += 0.003 - result["time_offset"]
    speeds = np.where(times < 0.4, 2.0, 2.0 * result[name])
    np.testing.assert_allclose(result.jacobian[:, 0, 1], GRAVITY * since - speeds, atol=1e-7)


@pytest.mark.slow  # compiles steps with unilateral contact
@pytest.mark.parametrize("kind", ["gaits", "steps", "series"])
def test_measurements_with_unilateral_contact_return_the_wheel_that_made_them(kind):
    """The reference is the wheel whose gait, steps and motion are measured. Series have errors of
    the trapezoidal rule."""
    wheel, model = vrw.WheelParams(damping=200.0), vrw.UnilateralWheel(friction=0.7)
    gait = vrw.limit_cycle(wheel, model=model)
    start = np.asarray(gait.section_state)
    if kind == "gaits":
        data = {"period": [gait.period], "period_error": [0.001]}
        data |= {"speed": [gait.speed], "speed_error": [0.001]}
    elif kind == "steps":
        walk = vrw.walk(wheel, START, 4, model=model)
        data = tabulate_steps(np.asarray(walk.steps.durations)[:, :2])
        data = {name.replace("sls1", "single"): column for name, column in data.items()}
        start = START
    else:
        walk = vrw.simulate(wheel, start, 2, model=model, n_samples=200)
        walk["lambda_1"], walk["lambda_2"] = walk.tangential[:, 0], walk.normal[:, 0]
        times = np.arange(0.05, 0.65, 0.02)
        data = {"time": times}
        for name in ("lambda_1", "lambda_2"):
            column = average_series(walk, times, 0.02, name)
            data |= {name: column, f"{name}_error": [2.0]}
    result = vrw.fit(
        data, wheel, ["damping", "friction"], start=start, n_starts=1,
        model=vrw.UnilateralWheel(friction=0.72),
    )  # fmt: skip
    distance = (result.values - [200.0, 0.7]) / result.standard_errors
    assert np.abs(distance).max() < (0.05 if kind == "series" else 1e-2)
    assert result.model.friction == result["friction"]
    # The likelihood is largest at the estimates.
    slopes = jax.grad(result.log_likelihood)(jnp.asarray(result.values)) if kind == "series" else 0
    assert np.all(np.abs(slopes * result.standard_errors) < 0.05)


BAD_DATA = {
    "nan": ({"period": [np.nan], "period_error": [0.1]}, "contains NaN"),
    "a length in s": ({"period [m]": [0.3], "period_error": [0.1]}, "unit 'm'"),
    "a period in ms": ({"period": [300.0], "period_error": [0.1]}, "state the unit"),
    "no time": ({"period": [-0.3], "period_error": [0.1]}, "time passes"),
    "a percentage": ({"dls_fraction": [40.0], "dls_fraction_error": [1.0]}, "percentage"),
    "too few": ({"period": [0.3], "period_error": [0.1]}, "1 numbers for 2 unknowns"),
    "no error": ({"period": [0.3], "speed": [1.0]}, "standard error"),
    "error zero": ({"period": [0.3], "period_error": [0.0]}, "positive"),
    "a typo": ({"perod": [0.3], "perod_error": [0.1]}, "did you mean 'period'"),
    "lengths": ({"period": [0.3, 0.3], "speed": [1.0] * 3}, "lengths"),
    "text": ({"period": ["fast"], "period_error": [0.1]}, "numbers"),
    "nothing": ({}, "columns"),
    "errors of data sets": (
        {"period": [[0.3], [0.31]], "period_error": [[0.1], [0.2]]},
        r"period_error has shape \(2, 1\), but all data sets of a batch share",
    ),
    "slopes of data sets": (
        {"period": [[0.3], [0.31]], "period_error": [0.1], "slope": [[0.3], [0.2]]},
        "slope has shape",
    ),
    "no table": (3, "table"),
    "errors of nothing": (SMALL_GAIT | {"sped_error": [0.1]}, "no sped .did you mean 'speed'"),
}


def test_the_figure_shows_measured_numbers_residuals_and_the_ellipse(small_fit):
    """The references are the fit, and the ends of the ellipse: 2.448 standard errors for 95 %."""
    figure = vrw.plot.fit_figure(small_fit)
    *columns, residuals, ellipse = figure.axes
    figure.canvas.draw()
    for axes in (columns[-1], residuals):  # Legends cover no points.
        legend = axes.get_legend().get_window_extent()
        assert legend.y0 > axes.get_window_extent().y1
        assert 0.0 < legend.x0 < legend.x1 < figure.bbox.x1
    assert [axes.get_ylabel() for axes in columns] == [
        "$T$ [s]",
        r"$T_{\mathrm{DLS}}/T$",
        "$v$ [m/s]",
    ]
    assert len(residuals.lines) == 3
    outline, center = (line.get_xdata() for line in ellipse.lines)
    half_width = 0.5 * np.ptp(outline)
    assert center == small_fit["damping"]
    assert half_width == pytest.approx(2.448 * small_fit.error("damping"), rel=2e-3)


@pytest.mark.parametrize("name", BAD_DATA)
def test_bad_data_get_one_sentence(name):
    data, message = BAD_DATA[name]
    with pytest.raises((TypeError, ValueError), match=message) as error:
        vrw.fit(data, SMALL_WHEEL)
    assert str(error.value).count(". ") == 0


BAD_STEPS = {
    "a step without ground": ({"step": [0, 1, 3], "height": [0.1, 0.0, 0.2]}, "height of step 2"),
    "no first step": (
        {"step": [1, 2, 2], "walk": [4, 4, 7], "height": [0.1, 0.0, 0.2]},
        "height of step 1 of walk 7 is missing",
    ),
    "two grounds": ({"step": [0, 1, 1], "height": [0.1, 0.0, 0.2]}, "differs between the rows"),
    "parts of steps": ({"step": [0.7, 1.7, 2.7]}, "step is 0.7, but"),
}


@pytest.mark.parametrize("name", BAD_STEPS)
def test_steps_and_ground_that_are_missing_get_one_sentence(name):
    data, message = BAD_STEPS[name]
    data = data | {"period": [0.7] * 3, "period_error": [0.01]}
    with pytest.raises(ValueError, match=message) as error:
        vrw.fit(data, WHEEL, ["damping"], start=START)
    assert str(error.value).count(". ") == 0


def test_ground_goes_on_behind_the_last_step_of_a_walk_in_any_order_of_rows():
    """The reference is the walk in closed form, whose second walk ends on the second stair."""
    heights, speeds = np.array([0.1, 0.05, 0.2]), [4.0]
    for rise in np.diff(heights, prepend=0.0):
        speeds.append(0.8 * np.sqrt(speeds[-1] ** 2 - 2.0 * GRAVITY * rise))
    rows = np.array([[0, 1, 2, 0, 1], [0, 0, 0, 1, 1]])[:, [4, 2, 0, 3, 1]]
    durations = (np.array(speeds[:-1]) + np.array(speeds[1:]) / 0.8) / GRAVITY
    data = {"step": rows[0], "walk": rows[1], "height": heights[rows[0]]}
    data |= {"period": durations[rows[0]], "period_error": [0.01]}
    params = {"restitution": 0.7, "rise": 0.0}
    result = vrw.fit(data, params, ["restitution"], model=BallOnStairs(), start=[4.0], n_starts=1)
    assert result["restitution"] == pytest.approx(0.8, abs=1e-5)


@pytest.mark.parametrize("text", ["", "period,period_error\n", "period,period_error\n0.7\n"])
def test_an_incomplete_csv_file_gets_one_sentence(tmp_path, text):
    path = tmp_path / "gaits.csv"
    path.write_text(text)
    with pytest.raises(ValueError, match=r"gaits.csv has \d lines, with .*: complete its lines"):
        vrw.fit(path, SMALL_WHEEL)


def test_a_csv_file_may_begin_with_a_byte_order_mark(tmp_path):
    path = tmp_path / "gaits.csv"
    path.write_text("period [m]\n0.7\n", encoding="utf-8-sig")
    with pytest.raises(ValueError, match=r"^period has the unit 'm'"):
        vrw.fit(path, SMALL_WHEEL)


BAD_ARGUMENTS = {
    "a prior of no width": ({"priors": {"damping": (12.0, 0.0)}}, "positive"),
    "no columns": ({"observe": lambda measures, extra: [1.0]}, "result of observe"),
    "two errors": ({"covariance": np.diag([0.004, 0.02, 0.02]) ** 2}, "covariance= contains"),
}


@pytest.mark.parametrize("name", BAD_ARGUMENTS)
def test_bad_arguments_get_one_sentence(name):
    keywords, message = BAD_ARGUMENTS[name]
    with pytest.raises((TypeError, ValueError), match=message) as error:
        vrw.fit(SMALL_GAIT, SMALL_WHEEL, n_starts=1, **keywords)
    assert str(error.value).count(". ") == 0


@pytest.mark.parametrize(
    ("keywords", "message"),
    [({"start": [0.1, 1.6]}, "start has 2 entries"), ({"start": START, "window": -1.0}, "window")],
)
def test_bad_starts_and_windows_get_one_sentence(keywords, message):
    data = {"time": [0.1, 0.2, 0.3], "lambda_2": [100.0], "lambda_2_error": [5.0]}
    with pytest.raises(ValueError, match=message):
        vrw.fit(data, WHEEL, n_starts=1, **keywords)


def test_a_fit_without_any_gait_says_so():
    """A slope of 17 rad, which was meant in degrees, has no gait, and so no direction."""
    result = vrw.fit(SMALL_GAIT | {"slope": [17.0]}, SMALL_WHEEL, n_starts=1)
    assert not result.converged
    assert result.unidentifiable == ()
    assert "no walker with all measured gaits" in str(result)


def test_names_of_unknowns_are_checked():
    with pytest.raises(ValueError, match="'dampin' is no parameter"):
        vrw.compare_laws(SMALL_GAIT, SMALL_WHEEL, "dampin")
    for keywords, message in (
        ({"free": ["dampin"]}, "did you mean 'damping'"),
        ({"free": []}, "unknowns"),
        ({"bounds": {"damping": (1.0, 2.0)}}, "outside its bounds"),
        ({"priors": {"slope": (0.3, 0.1)}}, "unknown"),
    ):
        with pytest.raises(ValueError, match=message):
            vrw.fit(SMALL_GAIT, SMALL_WHEEL, **keywords)


@pytest.mark.slow  # compiles fits of three laws
def test_the_law_that_made_the_data_is_chosen():
    """The reference is the law of the wheel whose durations are measured."""

    slopes = np.linspace(0.27, 0.32, 6)
    law = lambda L, dL, p: (
        p.stiffness * (p.natural_length - L) - p.damping * dL - 40.0 * jnp.abs(dL) * dL
    )
    cycles = vrw.limit_cycles(
        vrw.WheelParams(damping=150.0, slope=slopes), model=vrw.ViscoelasticWheel(leg_force=law)
    )
    data = {"slope": slopes}
    for name, column in zip(DURATIONS, np.asarray(cycles.durations).T, strict=True):
        data |= {name: column, f"{name}_error": [0.001]}
    table = vrw.compare_laws(data, WHEEL, n_folds=3)
    assert table.attrs["best"] == "quadratic damper"
    assert table.attrs["fits"]["quadratic damper"]["leg.c2"] == pytest.approx(40.0, abs=0.01)
    errors = table.prediction_error
    assert errors.sel(law="quadratic damper") < 0.1 < errors.sel(law="linear")
    table = vrw.compare_laws(data, WHEEL, n_folds=1)  # One part leaves nothing to fit.
    assert np.isnan(table.prediction_error).all()
