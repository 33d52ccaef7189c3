"""Gaits, walks and basins of a user's walker, which is a class or a hybrid system.

The walker is a ball that a racket kicks. After a bounce its velocity is v' = e v + k, so that a
gait has v = k / (1 - e), the multiplier e and the period 2 v / g.
"""

import dataclasses
import re
from pathlib import Path

import equinox as eqx
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
    Henon,
    JuggledBall,
    SlowReturn,
    flight_height,
)

import vrw_jax as vrw
from vrw_jax.hybrid import Guard, Mode


@pytest.mark.parametrize("walker", [JuggledBall(), BALL_SYSTEM], ids=["class", "system"])
def test_a_gait_has_the_closed_form_of_velocity_multiplier_and_period(walker):
    gait = vrw.limit_cycle(BALL_PARAMS, model=walker)
    again = vrw.limit_cycle(BALL_PARAMS, model=walker, guess=gait)
    np.testing.assert_allclose(again.section_state, gait.section_state, rtol=1e-12)
    np.testing.assert_allclose(gait.section_state, [2.0], rtol=1e-12)
    np.testing.assert_allclose(np.asarray(gait.multipliers), [0.5], rtol=1e-9)
    # A flight lasts one solver step of a parabola; in the system it starts at the velocity before.
    assert float(gait.period) == pytest.approx(4.0 / GRAVITY, rel=1e-10)


@pytest.mark.parametrize("walker", [JuggledBall(), BALL_SYSTEM], ids=["class", "system"])
def test_an_element_of_a_batch_without_a_gait_has_a_code_and_the_others_their_gait(walker):
    params = BALL_PARAMS | {"kick": np.array([1.0, np.nan, 2.0])}
    gaits = vrw.limit_cycles(params, model=walker)
    assert gaits.outcome.tolist() == [0, vrw.Outcome.BAD_INPUT, 0]
    np.testing.assert_allclose(gaits.section_state[:, 0], [2.0, 0.0, 4.0], rtol=1e-12)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gaits))
    assert "BAD_INPUT" in gaits.why[1]


@pytest.mark.parametrize("guess", [None, np.zeros((0, 1))])
def test_an_empty_batch_has_no_gaits(guess):
    params = BALL_PARAMS | {"kick": np.zeros(0)}
    gaits = vrw.limit_cycles(params, model=BALL_SYSTEM, guess=guess)
    assert gaits.section_state.shape == (0, 1)
    assert gaits.outcome.shape == (0,)


def test_a_batch_has_the_gaits_of_single_searches():
    slopes = np.array([0.009, 0.012])
    gaits = vrw.limit_cycles({"slope": slopes}, model=SIMPLEST_WALKER, guess=[0.2, -0.2])
    for slope, state in zip(slopes, gaits.section_state, strict=True):
        one = vrw.limit_cycle({"slope": slope}, model=SIMPLEST_WALKER, guess=[0.2, -0.2])
        np.testing.assert_allclose(state, one.section_state, rtol=1e-10)


def test_the_first_start_that_leads_to_a_gait_is_taken():
    starts = lambda p: jnp.array([[-3.0], [1.0]])  # the ball that moves down never flies
    walker = dataclasses.replace(BALL_SYSTEM, starts=starts)
    assert vrw.limit_cycle(BALL_PARAMS, model=walker).converged


def test_a_missing_gait_of_an_own_walker_is_nan_on_request():
    params, guess = {"slope": -0.05}, [0.3, -0.3]  # No passive gait goes uphill.
    find = lambda on_failure: vrw.limit_cycle(
        params, model=SIMPLEST_WALKER, guess=guess, on_failure=on_failure
    )
    assert not find("zeros").found
    assert np.isnan(find("nan").section_state).all()
    with pytest.raises(ValueError, match="on_failure is 'typo'"):
        find("typo")


def test_gaits_far_from_the_starts_are_found_by_walks_everywhere():
    walker, c = SlowReturn(), np.linspace(1.0, 19.0, 5)
    find = lambda c: vrw.limit_cycle({"c": c}, model=walker).section_state[0]
    for transform in (jax.vmap, lambda f: jax.jit(jax.vmap(f))):
        np.testing.assert_allclose(transform(find)(c), c, rtol=1e-9)
        np.testing.assert_allclose(transform(jax.grad(find))(c), 1.0, rtol=1e-9)
    gait = vrw.limit_cycle({"c": 1.0}, model=walker)
    assert gait.section_state[0] == pytest.approx(1.0, rel=1e-9)
    gaits = vrw.limit_cycles({"c": np.append(c, np.nan)}, model=walker)
    np.testing.assert_allclose(gaits.section_state[:-1, 0], c, rtol=1e-9)
    assert gaits.outcome.tolist() == [vrw.Outcome.STEPPED] * 5 + [vrw.Outcome.BAD_INPUT]
    names = ["offset", "d offset / d c"]
    scan = vrw.scan(vrw.samples(c=c), names, base={"c": 1.0}, model=walker)
    np.testing.assert_allclose(scan.offset, c, rtol=1e-9)
    np.testing.assert_allclose(scan["d offset / d c"], 1.0, rtol=1e-9)
    table = vrw.sensitivities({"c": 1.0}, model=walker)
    assert table.derivative.sel(measure="offset", parameter="c") == pytest.approx(1.0, rel=1e-9)
    tuned = vrw.tune({"c": 1.0}, "offset", ["c"], {"c": (0.5, 3.0)}, model=walker)
    assert tuned.value == pytest.approx(3.0, rel=1e-9)


@pytest.mark.parametrize("walker", [JuggledBall(), BALL_SYSTEM], ids=["class", "system"])
def test_a_batch_has_the_derivatives_of_its_elements_by_one_of_several_parameters(walker):
    """T = 2 k / (1 - e) / g, where only k is differentiated; the last ball does not fly."""
    e, kicks = np.array([0.5, 0.6, 0.5]), jnp.array([1.0, 2.0, -1.0])

    def find_periods(kicks):
        params = {"ball": {"restitution": e}, "kick": kicks}
        return vrw.limit_cycles(params, model=walker).period

    expected = np.where(kicks > 0.0, 2.0 / (1.0 - e) / GRAVITY, 0.0)
    for jacobian in (jax.jacfwd, lambda f: jax.jit(jax.jacrev(f))):
        np.testing.assert_allclose(jacobian(find_periods)(kicks), np.diag(expected), rtol=1e-9)
    gradient = jax.grad(lambda kicks: find_periods(kicks).sum())(kicks)
    np.testing.assert_allclose(gradient, expected, rtol=1e-9)


def test_starts_may_be_lists_and_belong_to_each_element_of_a_batch():
    class Logistic(vrw.AbstractWalker):
        def advance(self, params, x, options):
            return vrw.AdvanceResult(params["r"] * x * (1.0 - x), jnp.ones(1))

        def starts(self, params):
            return [[0.6], [0.3]]

    r = np.array([2.5, 2.6])
    gaits = vrw.limit_cycles({"r": r}, model=Logistic())
    np.testing.assert_allclose(gaits.section_state[:, 0], 1.0 - 1.0 / r, rtol=1e-12)


def test_a_measure_has_a_name_of_its_own():
    @vrw.measure("velocity", unit="m/s", meaning="Another velocity.")
    def velocity(step, params):
        return step.duration

    for measures in ((velocity, velocity), (velocity,)):  # of two measures, and of a coordinate
        with pytest.raises(ValueError, match="2 measures or coordinates have the name 'velocity'"):
            vrw.sensitivities(
                BALL_PARAMS, model=dataclasses.replace(BALL_SYSTEM, measures=measures)
            )


def test_the_name_of_a_parameter_may_contain_a_space():
    class Decay(vrw.AbstractWalker):
        """x -> x / 2 + s has the fixed point 2 s."""

        def advance(self, params, x, options):
            return vrw.AdvanceResult(0.5 * x + params["step size"], jnp.ones(1))

        def starts(self, params):
            return jnp.array([1.0])

    name, walker = "step size", Decay()
    tuned = vrw.tune({name: 1.0}, "x0", [name], {name: (0.5, 3.0)}, model=walker)
    assert tuned.value == pytest.approx(6.0, rel=1e-9)
    assert "step size 3" in str(tuned)
    vrw.plot.tuning_figure(tuned)
    scan = vrw.scan(vrw.grid(**{name: [0.5, 1.0]}), ["x0"], base={name: 1.0}, model=walker)
    np.testing.assert_allclose(scan.x0, [1.0, 2.0], rtol=1e-9)


def test_an_optimum_is_followed_along_another_parameter():
    """v = k / (1 - e), and the best kick is the largest."""
    restitutions, bounds = (0.5, 0.6, 0.75), {"kick": (0.5, 2.0)}
    curve = vrw.tune(
        BALL_PARAMS, "velocity", ["kick"], bounds, model=JuggledBall(),
        along=("ball.restitution", restitutions),
    )  # fmt: skip
    expected = 2.0 / (1.0 - np.array(restitutions))
    np.testing.assert_allclose(curve.dataset.objective, expected, rtol=1e-9)


def test_both_bounds_of_a_measure_become_active_along_a_curve_of_optima():
    """The best size is s, and its bounds are 0.3 and 0.7."""

    class Sized(vrw.AbstractWalker):
        measures = (
            vrw.measure("gain", meaning="objective")(lambda step, p: -((p["a"] - p["s"]) ** 2)),
            vrw.measure("size", meaning="limited")(lambda step, p: p["a"] + 0.0 * p["s"]),
        )

        def advance(self, params, x, options):
            return vrw.AdvanceResult(0.5 * x + 0.5, jnp.ones(1))

        def starts(self, params):
            return jnp.array([1.0])

    curve = vrw.tune(
        {"a": 0.5, "s": 0.0}, "gain", ["a"], {"a": (-1.0, 2.0)}, {"size": (0.3, 0.7)},
        model=Sized(), along=("s", (0.0, 1.0)),
    )  # fmt: skip
    lower, upper = (f"size at its {side} bound" for side in ("lower", "upper"))
    assert [(x.before, x.after) for x in curve.changes] == [((lower,), ()), ((), (upper,))]
    np.testing.assert_allclose([x.value for x in curve.changes], [0.3, 0.7], atol=1e-5)
    prices = curve.dataset.price
    np.testing.assert_allclose(prices.sel(limit=lower), [0.6, 0.0], atol=1e-6)
    np.testing.assert_allclose(prices.sel(limit=upper), [0.0, 0.6], atol=1e-6)


@pytest.mark.parametrize("walker", [JuggledBall(), BALL_SYSTEM], ids=["class", "system"])
def test_sensitivities_are_the_derivatives_of_the_closed_form(walker):
    """v = k / (1 - e), T = 2 v / g and h = v^2 / 2 g."""
    table = vrw.sensitivities(BALL_PARAMS, model=walker)
    assert table.measure.values.tolist() == ["period", "velocity", "height"]
    assert table.parameter.values.tolist() == ["ball.restitution", "kick"]
    assert table.measure_unit.values.tolist() == ["s", "m/s", "m"]
    assert not table.attrs
    dv = np.array([4.0, 2.0])
    expected = [2.0 / GRAVITY * dv, dv, 2.0 / GRAVITY * dv]
    np.testing.assert_allclose(table.derivative, expected, rtol=1e-9)


@pytest.mark.parametrize("walker", [JuggledBall(), BALL_SYSTEM], ids=["class", "system"])
def test_a_walk_takes_a_parameter_for_each_step_and_a_batch_walks_as_one(walker):
    kicks = np.array([1.0, 0.5, 0.0])
    walk = vrw.walk(BALL_PARAMS | {"kick": kicks}, [2.0], 3, model=walker)
    np.testing.assert_allclose(walk.steps.section_state[:, 0], [2.0, 1.5, 0.75], rtol=1e-12)
    assert int(walk.n_stepped) == 3
    section = getattr(walker, "section", "section")
    assert walk.ending == f"The walker stepped from {section} to {section}."
    batch = vrw.step_batch(BALL_PARAMS | {"kick": kicks}, np.array([2.0]), 3, model=walker)
    expected = 0.125 * 2.0 + kicks * 1.75
    np.testing.assert_allclose(batch.section_state[:, 0], expected, rtol=1e-12)
    assert batch.n_stepped.tolist() == [3, 3, 3]


def test_a_walk_that_enters_a_mode_beyond_a_guard_says_so():
    buried = dataclasses.replace(
        BALL_SYSTEM, embed=lambda x, p: jnp.stack([jnp.where(x[0] < 1.8, -0.1, 0.0), x[0]])
    )
    walk = vrw.walk(BALL_PARAMS, [1.0], 2, model=buried)
    assert walk.steps.outcome.tolist() == [vrw.Outcome.GUARD_VIOLATED] * 2
    assert "guards" in walk.ending
    batch = vrw.step_batch(BALL_PARAMS, np.array([[1.0], [2.0]]), model=buried)
    assert batch.outcome.tolist() == [vrw.Outcome.GUARD_VIOLATED, vrw.Outcome.STEPPED]
    place = "guard 'bounce' of mode 'flight'"
    endings = buried.step_batch(BALL_PARAMS, np.array([[1.0], [2.0]])).ending
    assert place in endings[0]
    assert "mode" not in endings[1]
    assert place in str(buried.step(BALL_PARAMS, [1.0]))
    gait = vrw.limit_cycle(BALL_PARAMS, model=buried, guess=[1.0])
    assert gait.outcome == vrw.Outcome.GUARD_VIOLATED
    assert place in gait.why
    assert str(gait) == f"HybridGait\n  search: {gait.why}"


FALL_FREELY = BALL_SYSTEM.modes["flight"].field
ABOVE = lambda y, p: y[0] - p["rise"]
STUMBLING_BALL = vrw.HybridSystem(
    modes={
        "rise": Mode(
            FALL_FREELY,
            {
                "apex": Guard(lambda y, p: y[1], target_mode="fall", armed=ABOVE),
                "stumble": Guard(
                    lambda y, p: y[1], armed=lambda y, p: -ABOVE(y, p), ends_walk=True
                ),
            },
        ),
        "fall": Mode(
            FALL_FREELY,
            {"impact": Guard(ABOVE, lambda y, p: jnp.stack([0.0 * y[0], -0.5 * y[1]]), "rise")},
        ),
    },
    section="impact",
    state=("height", "velocity"),
    project=lambda y, p: y[1:],
    embed=lambda x, p: jnp.stack([0.0 * x[0], x[0]]),
    ground={"height": "rise"},
)


def test_a_guard_that_ends_walks_does_so_at_the_apex():
    """Bounces of half the velocity rise to a quarter of the height."""
    top = 2.0**2 / 2 / GRAVITY
    heights = np.array([[0.0, 0.0, 0.24 * top, 0.24 * top], [0.0, 0.0, 0.26 * top, 0.26 * top]])
    walks = vrw.step_batch(
        {"rise": 0.0}, np.full((2, 1), 2.0), 3, model=STUMBLING_BALL, heights=heights
    )
    assert walks.n_stepped.tolist() == [3, 1]
    assert walks.outcome.tolist() == [vrw.Outcome.STEPPED, vrw.Outcome.ENDED_BY_GUARD]
    step = STUMBLING_BALL.step({"rise": 1.01 * top}, [2.0])
    assert "guard 'stumble' of mode 'rise'" in step.ending
    np.testing.assert_allclose(step.duration, 2.0 / GRAVITY, rtol=1e-12)
    motion = STUMBLING_BALL.simulate({"rise": 1.01 * top}, [0.0, 2.0], events=9)
    np.testing.assert_allclose(motion.state, [top, 0.0], atol=1e-12)
    assert int(motion.n_events) == 1
    with pytest.raises(ValueError, match="has ends_walk, but it is the section"):
        dataclasses.replace(STUMBLING_BALL, section="stumble")


def test_section_coordinates_of_another_length_are_refused():
    with pytest.raises(ValueError, match="x has 2 entries, but project returns"):
        BALL_SYSTEM.step(BALL_PARAMS, [2.0, 1.0])


def test_panels_show_the_coordinates_of_a_walk_with_gaps_at_its_events():
    walk = vrw.simulate(BALL_PARAMS, [2.0], 3, model=BALL_SYSTEM, n_samples=5)
    panels = vrw.plot.gait_panels(walk).axes
    assert [axes.get_ylabel() for axes in panels] == ["height [m]", "velocity [m/s]"]
    velocity = panels[1].lines[-1].get_ydata()
    assert np.flatnonzero(np.isnan(velocity)).tolist() == [5, 11]  # between three flights
    assert velocity[4] == pytest.approx(-2.0, rel=1e-9)
    bounces = [line.get_xdata()[0] for line in panels[0].lines[:-1]]
    np.testing.assert_allclose(bounces, 4.0 / GRAVITY * np.array([1.0, 2.0]), rtol=1e-9)


class Mass(eqx.Module):
    kick: float = vrw.parameter(1.0, unit="m/s", domain=(0.0, np.inf))
    ball: dict = eqx.field(default_factory=lambda: BALL_PARAMS["ball"])

    def __getitem__(self, name):
        return getattr(self, name)


def test_parameters_outside_their_domain_have_a_code():
    assert vrw.limit_cycle(Mass(), model=BALL_SYSTEM).converged
    gait = vrw.limit_cycle(Mass(kick=-1.0), model=BALL_SYSTEM)
    assert gait.outcome == vrw.Outcome.BAD_INPUT
    assert "outside its domain" in gait.why
    for walker in (BALL_SYSTEM, JuggledBall()):
        step = vrw.step(Mass(kick=-1.0), [2.0], model=walker)
        assert int(step.outcome) == vrw.Outcome.BAD_INPUT
        walk = vrw.walk(Mass(kick=-1.0), [2.0], 2, model=walker)
        assert walk.steps.outcome.tolist() == [vrw.Outcome.BAD_INPUT] * 2
        batch = vrw.step_batch(Mass(kick=np.array([-1.0, 1.0])), np.ones((2, 1)), 2, model=walker)
        assert batch.outcome.tolist() == [vrw.Outcome.BAD_INPUT, vrw.Outcome.STEPPED]
        assert batch.n_stepped.tolist() == [0, 2]
        with pytest.raises(ValueError, match=r"kick is -1, but it must lie in \[0, inf\) m/s"):
            vrw.basin_share(Mass(kick=-1.0), {"velocity": (0.0, 1.0)}, model=walker)
    motion = vrw.simulate(Mass(kick=-1.0), [2.0], 1, model=BALL_SYSTEM)
    assert (motion.outcome, motion.n_steps) == ("BAD_INPUT", 0)
    assert "outside its domain" in motion.outcome_meaning


@pytest.mark.parametrize("walker", [BALL_SYSTEM, JuggledBall(), Henon()])
def test_starts_that_are_not_finite_have_a_code(walker):
    params = {**BALL_PARAMS, "a": 0.2, "b": 0.3}
    starts = np.full((3, 2 if isinstance(walker, Henon) else 1), [[0.5], [np.nan], [np.inf]])
    batch = vrw.step_batch(params, starts, 2, model=walker)
    assert batch.outcome.tolist() == [vrw.Outcome.STEPPED] + [vrw.Outcome.BAD_INPUT] * 2
    walk = vrw.walk(params, starts[1], 2, model=walker)
    assert walk.steps.outcome.tolist() == [vrw.Outcome.BAD_INPUT] * 2


class DampedBall(JuggledBall):
    """Juggled ball whose names have other meanings and units than those of the wheel."""

    class Params(eqx.Module):
        damping: float = vrw.parameter(0.5, unit="N s/m^2")
        stiffness: float = vrw.parameter(1.0, unit="m/s")
        slope: float = vrw.parameter(0.0)

    coordinates = {"theta": "m/s"}  # noqa: RUF012

    def advance(self, params, x, options):
        kick = params.stiffness + params.slope
        ball = {"ball": {"restitution": params.damping}, "kick": kick}
        return super().advance(ball, x, options)


def test_figures_show_the_results_of_any_walker():
    walker, params = DampedBall(), DampedBall.Params()
    damping_label, stiffness_label = "damping [N·s/m²]", "stiffness [m/s]"
    design = vrw.grid({"stiffness": [0.5, 1.0], "damping": [0.4, 0.5]})
    names = ["period", "height", "theta", "d height / d damping"]
    scan = vrw.scan(design, names, base=params, model=walker)
    (figure,) = vrw.plot.scan_figures(scan).values()
    assert figure.axes[4].get_xlabel() == stiffness_label
    assert figure.axes[4].get_ylabel() == damping_label
    labels = [axes.get_ylabel().replace("\n", " ") for axes in figure.axes[5:]]
    assert labels[:3] == ["step period [s]", "height [m]", "theta [m/s]"]
    assert labels[3] == "d height / d damping [m/(N·s/m²)]"
    more = scan.assign({f"more{i}": scan.height for i in range(3)})
    more.attrs["scan"] = scan.attrs["scan"].replace('"height"', '"height", "more1", "more2"', 1)
    with pytest.warns(UserWarning, match="first 6 measures, without more2: leave"):
        vrw.plot.scan_figures(more)
    map_axes = vrw.plot.map_figure(scan, "height", []).axes
    assert map_axes[0].get_xlabel() == stiffness_label
    assert map_axes[-1].get_ylabel() == "height [m]"
    table = vrw.sensitivities(params, model=walker)
    tornado = vrw.plot.tornado_figure(table)
    assert [axes.get_title() for axes in tornado.axes][1:] == ["theta", "height"]
    rows = [label.get_text() for label in tornado.axes[0].get_yticklabels()]
    assert rows == ["damping", "stiffness"]  # not the slope of 0
    changes = vrw.plot.tornado_figure(table, "theta", spreads={"slope": 0.1})
    assert changes.axes[0].get_xlabel() == "change of theta [m/s]"
    bounds, limits = {"stiffness": (0.5, 1.5)}, {"theta": (None, 2.5)}
    tuned = vrw.tune(params, "height", ["stiffness"], bounds, limits, model=walker)
    objective, slack, paths = vrw.plot.tuning_figure(tuned).axes
    assert objective.get_ylabel() == "height [m]"
    assert paths.get_legend_handles_labels()[1] == [r"$\mathrm{stiffness}$"]
    (limit,) = slack.get_yticklabels()
    assert (limit.get_text(), limit.get_fontweight()) == ("theta (upper bound)", "bold")
    assert slack.get_legend_handles_labels()[1] == ["active", "at the start", "tuned"]
    basin = vrw.basin(params, {"theta": [0.5, 1.0]}, model=walker).expand_dims(y=2).transpose()
    assert vrw.plot.basin_figure([basin], [""]).axes[0].get_ylabel() == "theta [m/s]"


@vrw.measure("height", unit="m", symbol="h")
def height_with_symbol(step, params):
    return GRAVITY / 8.0 * step.duration**2


def test_figures_show_declared_symbols():
    class SymbolBall(DampedBall):
        class Params(DampedBall.Params):
            stiffness: float = vrw.parameter(1.0, unit="m/s", symbol="k_1")

        measures = (height_with_symbol,)

    walker, params = SymbolBall(), SymbolBall.Params()
    label = "stiffness $k_{1}$ [m/s]"
    scan = vrw.scan(vrw.grid(stiffness=[0.5, 1.0, 1.5]), ["height"], base=params, model=walker)
    (figure,) = vrw.plot.scan_figures(scan).values()
    assert figure.axes[-1].get_xlabel() == label
    branch = vrw.continue_branch(
        params, "stiffness", (0.5, 1.5), model=walker, measures=["height"],
        cycle=vrw.limit_cycle(params, model=walker),
    )  # fmt: skip
    panels = vrw.plot.branch_figure(branch).axes
    assert panels[-1].get_xlabel() == label
    assert panels[-1].get_ylabel() == "$h$ [m]"
    bounds = {"stiffness": (0.5, 1.5)}
    tuned = vrw.tune(params, "height", ["stiffness"], bounds, model=walker)
    paths = vrw.plot.tuning_figure(tuned).axes[-1]
    assert paths.get_legend_handles_labels()[1] == ["$k_{1}$"]


def test_the_figure_of_a_branch_shows_the_limit_of_stability_and_measures():
    walker, params = DampedBall(), DampedBall.Params()
    branch = vrw.continue_branch(
        params, "damping", (-6.0, 0.9), model=walker, cycle=vrw.limit_cycle(params, model=walker),
        measures=["height"],
    )  # fmt: skip
    theta, multipliers, period, height = vrw.plot.branch_figure(branch).axes
    assert multipliers.get_ylim() == (0.0, 3.0)
    assert multipliers.get_ylabel().endswith("(up to 6)")
    assert [1.0, 1.0] in [list(line.get_ydata()) for line in multipliers.lines]
    labels = [axes.get_ylabel() for axes in (theta, period, height)]
    assert labels == ["theta [m/s]", "period [s]", "height [m]"]
    assert height.get_xlabel() == "damping [N·s/m²]"
    texts = [text.get_text() for text in height.figure.legends[0].get_texts()]
    assert texts[0] == "1  damping = -1 N·s/m²: period doubling"


def test_a_simulation_shows_the_flights_of_a_ball():
    walk = vrw.simulate(BALL_PARAMS, [2.0], 2, model=BALL_SYSTEM, n_samples=3)
    half = 2.0 / GRAVITY
    np.testing.assert_allclose(walk.time, half * np.array([0, 1, 2, 2, 3, 4]), rtol=1e-12)
    top = 2.0 / GRAVITY
    np.testing.assert_allclose(walk.height, [0, top, 0, 0, top, 0], atol=1e-12)
    assert walk.velocity.attrs["units"] == "m/s"
    flight = BALL_SYSTEM.modes["flight"]
    guards = {"apex": Guard(lambda y, p: y[1]), **flight.guards}
    endless = dataclasses.replace(
        BALL_SYSTEM, modes={"flight": Mode(flight.field, guards)}, max_events=1
    )
    walk = vrw.simulate(BALL_PARAMS, [2.0], 2, model=endless, n_samples=3)
    assert walk.attrs["outcome"] == "TOO_MANY_EVENTS"
    assert "max_events events: raise it" in walk.attrs["outcome_meaning"]
    with pytest.raises(TypeError, match=r"vrw\.walk"):
        vrw.simulate(BALL_PARAMS, [2.0], 2, model=JuggledBall())


@pytest.mark.parametrize("walker", [JuggledBall(), BALL_SYSTEM], ids=["class", "system"])
def test_every_start_is_in_the_basin_of_a_stable_gait(walker):
    basin = vrw.basin(BALL_PARAMS, {"velocity": [0.5, 1.0, 5.0]}, model=walker)
    assert basin.attractor.values.tolist() == [0, 0, 0]
    np.testing.assert_allclose(basin.orbit_state.values[0, 0], [2.0], atol=1e-6)
    assert basin.attrs["starts"] == "on the section"


def test_a_scan_has_the_closed_form_and_its_derivatives_and_knows_the_code(tmp_path):
    """T = 2 k / (1 - e) / g, whose derivative by e is T / (1 - e)."""
    design = vrw.grid({"kick": [0.5, 1.0, -1.0], "ball.restitution": [0.5, 0.6]})
    names = ["period", "d period / d ball.restitution"]
    scan = lambda walker: vrw.scan(
        design, names, base=BALL_PARAMS, model=walker, store=tmp_path / "scan", chunk=2
    )
    result = scan(JuggledBall())
    kick, e = np.meshgrid([0.5, 1.0], [0.5, 0.6], indexing="ij")
    period = 2.0 * kick / (1.0 - e) / GRAVITY
    np.testing.assert_allclose(result.period[:2], period, rtol=1e-10)
    np.testing.assert_allclose(result[names[1]][:2], period / (1.0 - e), rtol=1e-9)
    np.testing.assert_allclose(result.spectral_radius[:2], e, rtol=1e-9)
    assert np.all(result.outcome[2] == vrw.Outcome.FELL_BACK)
    assert np.all(np.isnan(result.period[2]))
    assert result.period.attrs["units"] == "s"
    xr.testing.assert_identical(scan(JuggledBall()), result)

    class OtherBall(JuggledBall.__base__):
        advance, starts = JuggledBall.advance, lambda self, params: jnp.array([1.5])
        coordinates = {"velocity": "m/s"}  # noqa: RUF012

    with pytest.raises(ValueError, match="the code of walker differs"):
        scan(OtherBall())


class Racket(eqx.Module):
    kick: float
    gain: float = eqx.field(static=True, default=1.0)


class GainedBall(vrw.AbstractWalker):
    coordinates = {"velocity": "m/s"}  # noqa: RUF012
    starts = JuggledBall.starts

    def advance(self, params, x, options):
        return vrw.AdvanceResult(0.5 * x + params.gain * params.kick, jnp.ones(1))


def test_a_stored_scan_knows_the_static_fields_of_the_parameters(tmp_path):
    scan = lambda gain: vrw.scan(
        vrw.grid(kick=[0.5, 1.0]), ["velocity"], base=Racket(1.0, gain), model=GainedBall(),
        store=tmp_path / "scan",
    )  # fmt: skip
    np.testing.assert_allclose(scan(1.0).velocity, [1.0, 2.0], rtol=1e-10)
    xr.testing.assert_identical(scan(1.0), scan(1.0))
    with pytest.raises(ValueError, match="the walker's parameters or one of their static fields"):
        scan(1.5)


def test_a_sample_of_a_scan_does_not_depend_on_others():
    kicks = np.linspace(0.5, 1.0, 70)
    scan = lambda kicks: (
        vrw.scan(vrw.samples(kick=kicks), base=BALL_PARAMS, model=BALL_SYSTEM).period
    )
    np.testing.assert_array_equal(scan(kicks)[65:], scan(kicks[65:]))


def test_tuning_ends_at_the_limit_of_a_measure_with_its_multiplier():
    """T = sqrt(8 h / g), so that at a height of 0.5 m the price is dT/dh = T / 2 h."""
    bounds = {"kick": (0.5, 2.0), "ball.restitution": (0.2, 0.8)}
    tuned = vrw.tune(
        BALL_PARAMS, "period", [*bounds], bounds, {"height": (None, 0.5)}, model=JuggledBall()
    )
    period = np.sqrt(8.0 * 0.5 / GRAVITY)
    assert tuned.converged
    assert tuned.value == pytest.approx(period, rel=1e-6)
    (height,) = tuned.active
    assert (height.name, height.unit) == ("height", "m")
    assert height.price == pytest.approx(period, rel=1e-5)
    assert tuned.validation.is_feasible
    assert "kick" in str(tuned)


KICKED_SYSTEM = dataclasses.replace(BALL_SYSTEM, ground={"slope": "kick"})
KICKS = BALL_PARAMS | {"kick": np.ones(2)}


def follow_kicked_system():
    gait = vrw.limit_cycle(BALL_PARAMS, model=KICKED_SYSTEM)
    return vrw.continue_branch(BALL_PARAMS, "kick", (0.9, 1.1), model=KICKED_SYSTEM, cycle=gait)


CALLS = {
    "walker.step": lambda: BALL_SYSTEM.step(BALL_PARAMS, [2.0]),
    "step_batch": lambda: BALL_SYSTEM.step_batch(BALL_PARAMS, [[2.0]]),
    "simulate": lambda: BALL_SYSTEM.simulate(BALL_PARAMS, [0.0, 2.0], events=1),
    "simulate_batch": lambda: BALL_SYSTEM.simulate_batch(BALL_PARAMS, [[0.0, 2.0]], events=1),
    "vrw.step": lambda: vrw.step(BALL_PARAMS, [2.0], model=BALL_SYSTEM),
    "vrw.walk": lambda: vrw.walk(BALL_PARAMS, [2.0], 3, model=BALL_SYSTEM),
    "vrw.step_batch": lambda: vrw.step_batch(BALL_PARAMS, np.array([[2.0]]), model=BALL_SYSTEM),
    "vrw.simulate": lambda: vrw.simulate(BALL_PARAMS, None, 2, model=BALL_SYSTEM, n_samples=3),
    "vrw.basin": lambda: vrw.basin(BALL_PARAMS, {"velocity": [0.5, 5.0]}, model=BALL_SYSTEM),
    "walker.return_map(params)": lambda: BALL_SYSTEM.return_map(BALL_PARAMS)(jnp.array([2.0])),
    "vrw.solve_fixed_point": lambda: vrw.solve_fixed_point(
        BALL_SYSTEM.return_map(BALL_PARAMS), jnp.array([1.0])
    ),
    "vrw.continue_map": lambda: vrw.continue_map(
        lambda _, x, kick: BALL_SYSTEM.return_map(BALL_PARAMS | {"kick": kick})(x),
        jnp.array([2.0]),
        1.0,
        (0.9, 1.1),
    ),
    "vrw.limit_cycle": lambda: vrw.limit_cycle(BALL_PARAMS, model=BALL_SYSTEM),
    "vrw.limit_cycles": lambda: vrw.limit_cycles(
        BALL_PARAMS | {"kick": np.ones(1)}, model=BALL_SYSTEM
    ),
    "vrw.sensitivities": lambda: vrw.sensitivities(BALL_PARAMS, model=BALL_SYSTEM),
    "vrw.continue_branch": lambda: vrw.continue_branch(
        BALL_PARAMS,
        "kick",
        (0.9, 1.1),
        model=BALL_SYSTEM,
        cycle=vrw.limit_cycle(BALL_PARAMS, model=BALL_SYSTEM),
    ),
    "vrw.continue_special_point": lambda: vrw.continue_special_point(
        "period_doubling",
        ("a", "b"),
        vrw.limit_cycle({"a": 0.2, "b": 0.3}, model=Henon(), guess=[0.7, 0.2]),
        model=Henon(),
        params={"a": 0.2, "b": 0.3},
        bounds={"a": (-1.0, 3.5), "b": (-1.4, 0.6)},
    ),
    "vrw.phase_response": lambda: vrw.phase_response(
        BALL_PARAMS,
        model=BALL_SYSTEM,
        cycle=vrw.limit_cycle(BALL_PARAMS, model=BALL_SYSTEM),
        n_samples=2,
        n_steps=1,
    ),
    "vrw.fit": lambda: vrw.fit(
        {"step": [0], "period": [0.4], "period_error": [0.1]},
        BALL_PARAMS,
        ["kick"],
        model=BALL_SYSTEM,
        start=[2.0],
    ),
    "vrw.first_passage": lambda: vrw.first_passage(
        BALL_PARAMS, 1.0, model=KICKED_SYSTEM, tol=0.2, n_walkers=1024
    ),
    "vrw.gait_sensitivity": lambda: vrw.gait_sensitivity(
        BALL_PARAMS, "height", model=KICKED_SYSTEM, guess=[2.0]
    ),
    "vrw.measure_basins": lambda: vrw.measure_basins(
        follow_kicked_system(), {"velocity": (1.0, 5.0)}, model=KICKED_SYSTEM, n_points=1
    ),
    "vrw.measure_gait_sensitivity": lambda: vrw.measure_gait_sensitivity(
        follow_kicked_system(), "period", model=KICKED_SYSTEM, n_points=1
    ),
    "vrw.smallest_disturbance": lambda: vrw.smallest_disturbance(
        BALL_PARAMS, model=BALL_SYSTEM, coordinate="velocity"
    ),
    "vrw.scan": lambda: vrw.scan(vrw.samples(kick=[1.0]), base=BALL_PARAMS, model=BALL_SYSTEM),
    "vrw.tune": lambda: vrw.tune(
        BALL_PARAMS, "period", ["kick"], {"kick": (0.9, 1.1)}, model=BALL_SYSTEM
    ),
}


def test_each_function_of_the_table_takes_a_walker():
    page = (Path(__file__).parents[2] / "docs" / "howto" / "own_walker.md").read_text()
    table = page.partition("| function | needs |")[2].partition("\n\n")[0]
    listed = {
        name
        for row in table.splitlines()[2:]
        for name in re.findall(r"`([\w.()]+)`", row.split("|")[1])
    }
    assert listed == {*CALLS}
    for call in CALLS.values():
        assert call() is not None


class Kick(eqx.Module):
    kick: float = 1.0


class AimedBall(JuggledBall):
    def advance(self, params, x, options):
        return super().advance(params, x + params.aim, options)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: vrw.limit_cycle({"slope": 0.009}, model=SIMPLEST_WALKER), "starts="),
        (lambda: vrw.sensitivities({"slope": 0.009}, model=SIMPLEST_WALKER), "starts="),
        (lambda: vrw.limit_cycles(BALL_PARAMS, model=JuggledBall()), "one common length"),
        (lambda: vrw.limit_cycle({"kick": np.ones(1)}, model=JuggledBall()), "limit_cycles"),
        (
            lambda: vrw.continue_branch(
                BALL_PARAMS,
                "kick",
                (0.5, 3.0),
                model=JuggledBall(),
                force_peaks=True,
                cycle=vrw.limit_cycle(BALL_PARAMS, model=JuggledBall()),
            ),
            "force_peaks",
        ),
        (lambda: vrw.basin(KICKS, {"velocity": 1.0}, model=JuggledBall()), "one walker"),
        (
            lambda: vrw.basin_share(KICKS, {"velocity": (1.0, 3.0)}, model=JuggledBall()),
            "one walker",
        ),
        (lambda: vrw.first_passage(KICKS, 0.1, model=JuggledBall()), "one walker"),
        (lambda: vrw.phase_response(KICKS, model=BALL_SYSTEM), "one walker"),
        (lambda: vrw.smallest_disturbance(KICKS, model=BALL_SYSTEM), "one walker"),
        (
            lambda: vrw.tune(
                BALL_PARAMS,
                vrw.WheelObjective(abs),
                ["kick"],
                {"kick": (1.0, 2.0)},
                model=JuggledBall(),
            ),
            "a walker of yours",
        ),
        (
            lambda: vrw.walk(KICKS, [2.0], 3, model=JuggledBall()),
            "shape",
        ),
        (lambda: vrw.basin(BALL_PARAMS, {"speed": 1.0}, model=JuggledBall()), "velocity"),
        (lambda: vrw.first_passage(BALL_PARAMS, 0.1, model=JuggledBall()), "does not declare"),
        (lambda: vrw.gait_sensitivity(BALL_PARAMS, "period", model=BALL_SYSTEM), "not declare"),
        (
            lambda: vrw.gait_sensitivity(BALL_PARAMS, "speed", model=KICKED_SYSTEM, guess=[2.0]),
            "a step of this walker.*period, height",
        ),
        (
            lambda: jax.grad(
                lambda sd: vrw.first_passage(BALL_PARAMS, sd, model=KICKED_SYSTEM).mean_steps
            )(0.4),
            "have no derivatives",
        ),
        (lambda: vrw.limit_cycle({"kick": 1.0}, model=BALL_SYSTEM), "of the walker reads 'ball'"),
        (
            lambda: vrw.fit(
                {"period": [1.0], "period_error": [0.1]},
                BALL_PARAMS | {"kick": -1.0},
                ["kick"],
                model=JuggledBall(),
            ),
            "gait 0 of the data was not found",
        ),
        (lambda: vrw.walk({"kick": 1.0}, [2.0], 2, model=JuggledBall()), "contains kick: add it"),
        (lambda: vrw.limit_cycle(BALL_PARAMS, model=BALL_SYSTEM).measure("x"), "height"),
        (lambda: BALL_SYSTEM.step_batch(KICKS, np.ones((7, 1))), "2 entries of kick, 7.*of x"),
        (lambda: BALL_SYSTEM.step_batch(BALL_PARAMS, [1.0]), "has no arrays, but.* and x have"),
        (
            lambda: BALL_SYSTEM.simulate_batch(KICKS, np.ones((7, 2)), events=1),
            "2 entries of kick, 7 entries of start",
        ),
        (
            lambda: vrw.step_batch(KICKS, np.ones((7, 1)), model=BALL_SYSTEM),
            "2 entries of kick, 7 entries of states",
        ),
        (
            lambda: vrw.step(BALL_PARAMS, [1.0], model=AimedBall()),
            "the attribute 'aim' of a dict, but params is a dict, which contains ball.restitution",
        ),
        (
            lambda: vrw.walk(BALL_PARAMS | {"kick": [1.0, 1.0]}, [1.0], 2, model=JuggledBall()),
            r"a parameter of its own: give a batch of values as np.array",
        ),
        (lambda: vrw.step({"leg": Kick()}, [1.0], model=AimedBall()), "'aim' of a dict"),
        (lambda: vrw.step(Kick(), [1.0], model=AimedBall()), "'aim' of a Kick.*contains kick: add"),
        (lambda: vrw.step(Kick(), [1.0], model=JuggledBall()), "an entry of a Kick in brackets"),
        (lambda: vrw.step(Kick, [1.0], model=JuggledBall()), r"give an instance, Kick\(\)"),
        (
            lambda: vrw.scan(
                vrw.grid(kick=[1.0]), ["heights"], base=BALL_PARAMS, model=BALL_SYSTEM
            ),
            "'height'.*such as 'd period / d ball.restitution'",
        ),
    ],
)
def test_what_is_missing_is_said_in_one_sentence(call, message):
    with pytest.raises((TypeError, ValueError), match=message):
        call()


def test_an_attribute_that_another_object_lacks_is_no_missing_parameter():
    class BallOfTable(JuggledBall):
        def advance(self, params, x, options):
            return super().advance(params, x + {"table": 1.0}.aim, options)

    with pytest.raises(AttributeError, match="'dict' object has no attribute 'aim'"):
        vrw.step(BALL_PARAMS, [1.0], model=BallOfTable())


def test_a_simulation_and_a_measure_print_what_they_are():
    solution = BALL_SYSTEM.simulate(BALL_PARAMS, [0.0, 2.0], events=3)
    rows = ["events: 3", f"time: {solution.time:.6g} s", f"ending: {solution.ending}"]
    assert str(solution).splitlines() == ["HybridSolution", *(f"  {row}" for row in rows)]
    batch = BALL_SYSTEM.simulate_batch(BALL_PARAMS, np.ones((4, 2)), events=3)
    assert "4 MAX_EVENTS_REACHED" in str(batch)
    jax.jit(lambda x: str(BALL_SYSTEM.simulate(BALL_PARAMS, x, events=3)) and x)(np.ones(2))
    assert str(flight_height) == "Measure(height [m])"
    peak = vrw.measure("peak", unit="m", phase="flight", reduction="max")(lambda y, p: y[0])
    assert str(peak) == "Measure(peak [m], max over flight)"


def test_random_kicks_end_a_walk_after_the_mean_number_of_steps_of_an_integral_equation():
    """v' = e v + k with a normal k, until v is negative: Nystrom's method with 400 Gauss points."""
    restitution, kick, sd = 0.5, 1.0, 0.6
    points, weights = np.polynomial.legendre.leggauss(400)
    highest = 2.0 + 10.0 * sd  # 8 standard deviations above the mean
    v, weights = 0.5 * highest * (points + 1.0), 0.5 * highest * weights
    kicks = v[None] - restitution * v[:, None] - kick
    survival = weights * np.exp(-0.5 * (kicks / sd) ** 2) / (sd * np.sqrt(2.0 * np.pi))
    kappa = np.sort(np.abs(np.linalg.eigvals(survival)))[-2:]
    walker = type("KickedBall", (JuggledBall,), {"ground": {"slope": "kick"}})()
    passage = vrw.first_passage(BALL_PARAMS, sd, model=walker)
    assert int(passage.status) == 0
    assert abs(passage.mean_steps - 1.0 / (1.0 - kappa[1])) < passage.error
    assert passage.error < 0.02 * passage.mean_steps
    assert float(passage.kappa_2) == pytest.approx(kappa[0], abs=0.03)
    assert "mean distance" not in str(passage)


RISING_BALL = vrw.HybridSystem(
    modes={
        "flight": Mode(
            lambda y, p: jnp.stack([y[1], -GRAVITY + 0.0 * y[1]]),
            {
                "impact": Guard(
                    lambda y, p: y[0] - p["rise"],
                    lambda y, p: jnp.stack([0.0 * y[0], -0.9 * y[1]]),
                    armed=lambda y, p: -y[1],
                )
            },
        )
    },
    section="impact",
    state=("height", "velocity"),
    project=lambda y, p: y[1:],
    embed=lambda x, p: jnp.stack([0.0 * x[0], x[0]]),
    ground={"height": "rise"},
)
"""A ball that bounces on stairs, whose velocity after a bounce is 0.9 sqrt(v^2 - 2 g rise)."""


def test_random_heights_end_a_walk_as_often_as_in_counted_walks():
    """v' = e sqrt(v^2 - 2 g rise) + k, in 200,000 walks of NumPy."""

    class ClimbingBall(vrw.AbstractWalker):
        ground = {"height": "rise"}  # noqa: RUF012

        def advance(self, params, x, options):
            square = x**2 - 2.0 * GRAVITY * params["rise"]
            v = 0.5 * jnp.sqrt(jnp.maximum(square, 0.0)) + 1.0
            return vrw.AdvanceResult(v, 2.0 * v / GRAVITY, jnp.where(square[0] > 0.0, 0, 3))

        def starts(self, params):
            return jnp.array([2.0])

    n, sd, draw = 200_000, 0.08, np.random.default_rng(1).standard_normal
    v, height, n_steps, is_walking = np.full(n, 2.0), sd * draw(n), 0, np.ones(n, bool)
    while is_walking.any():
        n_steps += is_walking.sum()
        height, last = sd * draw(n), height
        square = v**2 - 2.0 * GRAVITY * (height - last)
        is_walking &= square > 0.0
        v = 0.5 * np.sqrt(np.maximum(square, 0.0)) + 1.0
    passage = vrw.first_passage({"rise": 0.0}, height_sd=sd, model=ClimbingBall())
    assert int(passage.status) == 0
    # Relative errors: three standard errors of the count, and 1.5 times the tolerance.
    counted = n_steps / n
    assert float(passage.mean_steps_from_gait) == pytest.approx(counted, rel=0.007 + 0.03)


def test_heights_of_footholds_are_rises_in_walks_trajectories_and_batches():
    """The reference is the closed form of a fall between two heights."""
    heights = np.array([[0.3, 0.1, 0.2, -0.4], [0.0, 0.0, 0.05, 0.0]])
    expected = np.full((2, 1), 3.0)
    for rise in np.diff(heights).T:
        expected = 0.9 * np.sqrt(expected**2 - 2.0 * GRAVITY * rise[:, None])
    batch = vrw.step_batch(
        {"rise": 0.0}, np.full((2, 1), 3.0), 3, model=RISING_BALL, heights=heights
    )
    np.testing.assert_allclose(batch.section_state, expected, rtol=1e-9)
    rises = {"rise": np.diff(heights)}
    stepwise = vrw.step_batch(rises, np.full((2, 1), 3.0), 3, model=RISING_BALL)
    np.testing.assert_array_equal(stepwise.section_state, batch.section_state)
    on_stairs = vrw.step_batch(
        {"rise": np.array([0.02, -0.1])}, np.full((2, 1), 3.0), 3, model=RISING_BALL,
        heights=heights - np.outer([0.02, -0.1], range(4)),
    )  # fmt: skip
    np.testing.assert_allclose(on_stairs.section_state, expected, rtol=1e-9)
    walk = vrw.walk({"rise": 0.0}, [3.0], 3, model=RISING_BALL, heights=heights[0])
    np.testing.assert_allclose(walk.steps.section_state[-1], expected[0], rtol=1e-9)
    trajectory = vrw.simulate({"rise": 0.0}, [3.0], 3, model=RISING_BALL, heights=heights[0])
    # The last sample is just before the last bounce.
    np.testing.assert_allclose(trajectory.velocity[-1], -expected[0] / 0.9, rtol=1e-9)


def test_heights_that_fit_no_walk_are_refused():
    walk = lambda model, heights: vrw.walk({"rise": 0.0}, [3.0], 3, model=model, heights=heights)
    with pytest.raises(ValueError, match="give 4 heights"):
        walk(RISING_BALL, [0.0, 0.1, 0.2])
    with pytest.raises(ValueError, match="give 4 heights for each state"):
        vrw.step_batch(
            {"rise": 0.0}, np.full((3, 1), 3.0), 3, model=RISING_BALL, heights=np.zeros(4)
        )
    with pytest.raises(ValueError, match="does not declare what they change"):
        walk(dataclasses.replace(RISING_BALL, ground={}), np.zeros(4))
    with pytest.raises(ValueError, match="property of the ground"):
        dataclasses.replace(RISING_BALL, ground={"depth": "rise"})
