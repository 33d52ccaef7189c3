"""Branches of gaits of a user's own walker, against values of its paper and of closed forms."""

import functools

import jax.numpy as jnp
import numpy as np
import pytest
from support.slow_variants import mark_slow
from support.walkers import SIMPLEST_WALKER

import vrw_jax as vrw
from vrw_jax.hybrid import Guard, HybridSystem, Mode


def test_the_simplest_walker_doubles_its_period_near_the_slope_of_its_paper():
    """Garcia et al. (1998) print 0.0151 rad for the first period doubling."""
    tight = vrw.StepOptions.tight()
    gait = vrw.limit_cycle(
        {"slope": 0.009}, model=SIMPLEST_WALKER, guess=[0.2, -0.2], options=tight
    )
    branch = vrw.continue_branch(
        {"slope": 0.009},
        "slope",
        (0.006, 0.0155),
        model=SIMPLEST_WALKER,
        cycle=gait,
        step_options=tight,
    )
    (doubling,) = branch.special_points
    assert doubling.kind == "period_doubling"
    assert abs(doubling.value - 0.0151) < 5e-5  # the digits that are printed
    doubled = vrw.limit_cycle(
        {"slope": doubling.value},
        model=SIMPLEST_WALKER,
        guess=branch.dataset.x.sel(slope=doubling.value, method="nearest"),
        options=tight,
    )
    # A multiplier moves by 1e2 per unit of slope, and the slope is known to 1e-9 of its range.
    assert np.min(np.abs(np.asarray(doubled.multipliers) + 1.0)) < 1e-8
    two_steps = vrw.continue_branch(
        {"slope": 0.009},
        "slope",
        (0.006, 0.018),
        model=SIMPLEST_WALKER,
        cycle=gait,
        step_options=tight,
        switch_at=doubling,
    )
    (second_doubling,) = two_steps.special_points
    assert second_doubling.kind == "period_doubling"
    four = vrw.limit_cycle(
        {"slope": second_doubling.value},
        model=SIMPLEST_WALKER,
        guess=second_doubling.point.section_state,
        period_n=2,
        options=tight,
    )
    assert np.min(np.abs(np.asarray(four.multipliers) + 1.0)) < 1e-7
    np.testing.assert_allclose(four.section_state, second_doubling.cycle.section_state, atol=1e-8)


def test_a_rimless_wheel_of_a_user_has_the_speeds_of_its_closed_form_along_the_slope():
    """Drake's rimless wheel: the squared rate after a collision is c² r² + 4 g c² sin a sin s."""
    alpha = np.pi / 8
    wheel = HybridSystem(
        modes={
            "stance": Mode(
                lambda y, p: jnp.stack([y[1], p["gravity"] * jnp.sin(y[0])]),
                {
                    "touchdown": Guard(
                        lambda y, p: p["wheel"]["slope"] + alpha - y[0],
                        lambda y, p: jnp.stack(
                            [p["wheel"]["slope"] - alpha, y[1] * jnp.cos(2 * alpha)]
                        ),
                    )
                },
            )
        },
        section="touchdown",
        state=("angle", "rate"),
        project=lambda y, p: y[1:],
        embed=lambda x, p: jnp.stack([p["wheel"]["slope"] - alpha, x[0]]),
    )
    params = {"gravity": 9.81, "wheel": {"slope": 0.2}}
    gait = vrw.limit_cycle(params, model=wheel, guess=[1.5])
    branch = vrw.continue_branch(params, "wheel.slope", (0.15, 0.3), model=wheel, cycle=gait)
    slopes = branch.dataset["wheel.slope"].values
    c2 = np.cos(2 * alpha) ** 2
    rates = np.sqrt(4 * 9.81 * c2 / (1 - c2) * np.sin(alpha) * np.sin(slopes))
    np.testing.assert_allclose(branch.dataset.x.values[:, 0], rates, rtol=1e-9)
    with pytest.raises(ValueError, match="choose from gravity, wheel"):
        vrw.continue_branch(params, "incline", (0.15, 0.3), model=wheel, cycle=gait)


# A ball on a table that moves as A sin(2 pi t / T), and an oscillator with a stop -----------------

TIGHT = vrw.StepOptions.tight()
TABLE_RATE = 2.0 * np.pi  # rad/s, for a period of 1 s
RESTITUTION, GRAVITY = 0.8, 9.81


def table_height(phase, p):
    return p["amplitude"] * jnp.sin(TABLE_RATE * phase)


def bounce(y, p):
    table_speed = p["amplitude"] * TABLE_RATE * jnp.cos(TABLE_RATE * y[2])
    speed = (1.0 + RESTITUTION) * table_speed - RESTITUTION * y[1]
    return jnp.stack([y[0], speed, y[2] - 1.0])


BALL = HybridSystem(
    modes={
        "flight": Mode(
            lambda y, p: jnp.stack([y[1], -GRAVITY + 0.0 * y[1], 1.0 + 0.0 * y[2]]),
            {"impact": Guard(lambda y, p: y[0] - table_height(y[2], p), bounce)},
        )
    },
    section="impact",
    state=("height", "speed", "phase"),
    project=lambda y, p: y[1:],
    embed=lambda x, p: jnp.stack([table_height(x[1], p), x[0], x[1]]),
)


def continue_ball(**keywords):
    """From the orbit of one impact per period at the amplitude 0.15 m, whose phase is known."""
    params = {"amplitude": 0.15}
    speed = 0.5 * GRAVITY
    cosine = speed * (1.0 - RESTITUTION) / (1.0 + RESTITUTION) / (0.15 * TABLE_RATE)
    gait = vrw.limit_cycle(
        params, model=BALL, guess=[speed, np.arccos(cosine) / TABLE_RATE], options=TIGHT
    )
    return vrw.continue_branch(
        params, "amplitude", (0.05, 0.32), model=BALL, cycle=gait, step_options=TIGHT, **keywords
    )


def test_a_ball_on_a_moving_table_has_the_fold_and_the_doubling_of_its_closed_form():
    """Holmes (1982): orbits of one impact per period exist if the impact speed fits the table's."""
    branch = continue_ball()
    amplitude_rate = GRAVITY * (1.0 - RESTITUTION) / (2.0 * (1.0 + RESTITUTION))
    fold, doubling = sorted(branch.special_points, key=lambda point: point.value)
    assert (fold.kind, doubling.kind) == ("fold", "period_doubling")
    assert abs(fold.value - amplitude_rate / TABLE_RATE) < 1e-12
    # A multiplier is -1 where the table's acceleration at the impact is 2 (1 + e²)/(1 + e)² g.
    table_acceleration = 2.0 * (1.0 + RESTITUTION**2) / (1.0 + RESTITUTION) ** 2 * GRAVITY
    expected = np.hypot(amplitude_rate * TABLE_RATE, table_acceleration) / TABLE_RATE**2
    assert abs(doubling.value - expected) < 1e-9
    assert branch.dataset.period.values == pytest.approx(1.0, abs=1e-9)
    doubled = continue_ball(switch_at=doubling)
    assert doubled.ends[0] == "It begins on another branch."
    assert doubled.values[0] - doubling.value < 1e-5
    assert doubled.stable[:5].all()
    assert doubled.dataset.period.values == pytest.approx(2.0, abs=1e-9)
    speeds = doubled.dataset.x.values[-1]
    once = BALL.step({"amplitude": float(doubled.values[-1])}, speeds, TIGHT).section_state
    assert np.max(np.abs(np.asarray(once) - speeds)) > 0.1  # not of one impact per period
    with pytest.raises(ValueError, match="a branch_point or a period_doubling"):
        continue_ball(switch_at=fold)


def make_oscillator(has_stop):
    """x'' + 0.1 x' + x = A cos(w t), with a stop at x = 1 or without."""
    swing = lambda y, p: jnp.stack(
        [y[1], p["A"] * jnp.cos(y[2]) - y[0] - 0.1 * y[1], p["w"] + 0.0 * y[2]]
    )
    guards = {
        "period": Guard(
            lambda y, p: 2.0 * jnp.pi - y[2],
            lambda y, p: jnp.stack([y[0], y[1], y[2] - 2.0 * jnp.pi]),
        ),
        "stop": Guard(lambda y, p: 1.0 - y[0], lambda y, p: jnp.stack([y[0], -0.8 * y[1], y[2]])),
    }
    return HybridSystem(
        modes={"free": Mode(swing, guards if has_stop else {"period": guards["period"]})},
        section="period",
        state=("x", "v", "phase"),
        project=lambda y, p: y[:2],
        embed=lambda x, p: jnp.stack([x[0], x[1], 0.0 * x[0]]),
        max_events=4,
    )


@pytest.mark.parametrize("has_stop", [*mark_slow(False), True])
@pytest.mark.parametrize("rate", [0.7, 1.6])
def test_an_oscillator_touches_its_stop_at_the_amplitude_of_the_linear_equation(has_stop, rate):
    """Without the stop the branch goes on; with it, no step passes the touch, however short."""
    amplitude = np.hypot(1.0 - rate**2, 0.1 * rate)
    oscillator = make_oscillator(has_stop)
    params = {"A": 0.5 * amplitude, "w": rate}
    gait = vrw.limit_cycle(params, model=oscillator, guess=[0.3, 0.0], options=TIGHT)
    branch = vrw.continue_branch(
        params,
        "A",
        (0.4 * amplitude, 1.1 * amplitude),
        model=oscillator,
        cycle=gait,
        step_options=TIGHT,
        margins={"distance to the stop": lambda y, p: 1.0 - y[0]},
    )
    (touch,) = branch.special_points
    assert (touch.kind, touch.name) == ("border_collision", "distance to the stop")
    assert touch.ends_branch == has_stop
    assert abs(touch.value - amplitude) < 1e-12
    distance = branch.dataset["distance to the stop"].values
    np.testing.assert_allclose(distance, 1.0 - branch.values / amplitude, atol=1e-9)
    _, _, _, margin = vrw.plot.branch_figure(branch).axes
    assert margin.get_ylabel() == "distance to the stop"
    np.testing.assert_array_equal(margin.lines[0].get_ydata(), distance)


def test_the_curve_on_which_an_oscillator_touches_its_stop_is_that_of_the_linear_equation():
    """At a point on the curve, the amplitude of the motion is 1 for every rate."""
    oscillator, params = make_oscillator(has_stop=False), {"A": 0.3, "w": 0.7}
    gait = vrw.limit_cycle(params, model=oscillator, guess=[0.3, 0.0], options=TIGHT)
    follow = functools.partial(
        vrw.continue_special_point,
        "distance to the stop",
        cycle=gait,
        model=oscillator,
        params=params,
        margins={"distance to the stop": lambda y, p: 1.0 - y[0]},
    )
    curve = follow(parameters=("A", "w"), bounds={"A": (0.1, 1.0), "w": (0.6, 0.95)})
    amplitude, rate = curve.values.T
    np.testing.assert_allclose(amplitude, np.hypot(1.0 - rate**2, 0.1 * rate), atol=1e-9)
    assert np.ptp(rate) == pytest.approx(0.35, abs=1e-9)  # all of the range
    with pytest.raises(ValueError, match="bounds has no 'w'"):
        follow(parameters=("A", "w"), bounds={"A": (0.1, 1.0)})
    with pytest.raises(ValueError, match="two different ones"):
        follow(parameters=("A", "A"), bounds={"A": (0.1, 1.0)})
    with pytest.raises(ValueError, match=r"no special point 'distance to the stop'.*found: none"):
        follow(parameters=("A", "w"), bounds={"A": (0.25, 0.35), "w": (0.69, 0.71)})


def test_the_sequence_of_events_changes_where_a_second_leg_touches():
    """A point falls through two levels; the order of their guards changes at equal heights."""
    fall = lambda y, p: jnp.stack([1.0 + 0.0 * y[0], -y[1]])
    keep = lambda y, p: y
    clock = HybridSystem(
        modes={
            "first": Mode(
                fall,
                {
                    "half": Guard(lambda y, p: 0.5 - y[0], keep, "second"),
                    "level": Guard(lambda y, p: p["level"] - y[0], keep, "second"),
                },
            ),
            "second": Mode(
                fall,
                {
                    "turn": Guard(
                        lambda y, p: 1.0 - y[0],
                        lambda y, p: jnp.stack([0.0 * y[0], y[1] + 1.0]),
                        "first",
                    )
                },
            ),
        },
        section="turn",
        state=("phase", "level"),
        project=lambda y, p: y[1:],
        embed=lambda x, p: jnp.stack([0.0 * x[0], x[0]]),
    )
    params = {"level": 0.3}
    gait = vrw.limit_cycle(params, model=clock, guess=[1.5])
    branch = vrw.continue_branch(params, "level", (0.2, 0.8), model=clock, cycle=gait)
    (change,) = branch.special_points
    assert change.kind == "order_of_events_changes"
    assert abs(change.value - 0.5) < 1e-9
    assert branch.values[[0, -1]].tolist() == [0.2, 0.8]


class JuggledBall(vrw.AbstractWalker):
    """A ball that a paddle hits with the same kick each time, in closed form."""

    def advance(self, params, x, options):
        v = params["restitution"] * x + params["kick"]
        return vrw.AdvanceResult(v, 2.0 * v / 9.81)


def test_a_branch_of_a_walker_in_closed_form_has_its_states_and_periods():
    params, ball = {"restitution": 0.5, "kick": 1.0}, JuggledBall()
    gait = vrw.limit_cycle(params, model=ball, guess=[1.0])
    branch = vrw.continue_branch(params, "kick", (0.5, 2.0), model=ball, cycle=gait).dataset
    velocities = branch.kick.values / (1.0 - 0.5)
    # Newton's method ends at 1e-10 of the state.
    np.testing.assert_allclose(branch.x.values[:, 0], velocities, rtol=1e-9)
    np.testing.assert_allclose(branch.period, 2.0 * velocities / 9.81, rtol=1e-9)
    with pytest.raises(ValueError, match="JuggledBall does not define"):
        vrw.continue_branch(
            params, "kick", (0.5, 2.0), model=ball, cycle=gait, margins={"m": lambda y, p: y[0]}
        )


class Logistic(vrw.AbstractWalker):
    """x -> r x (1 - x) has the fixed point 1 - 1 / r, and x -> x the period 2 from r = 3."""

    def advance(self, params, x, options):
        return vrw.AdvanceResult(params["r"] * x * (1.0 - x), jnp.ones(1))

    def starts(self, params):
        return jnp.array([0.6])


def continue_logistic(r, **arguments):
    return vrw.continue_branch({"r": r}, "r", (2.8, 3.6), model=Logistic(), **arguments)


def test_a_branch_begins_at_the_gait_of_the_starts_if_no_gait_is_given():
    (doubling,) = continue_logistic(2.9).special_points
    assert doubling.value == pytest.approx(3.0, abs=1e-8)


def test_a_branch_has_the_period_of_its_gait():
    gait = vrw.limit_cycle({"r": 3.2}, model=Logistic(), guess=[0.513], period_n=2)
    branch = continue_logistic(3.2, cycle=gait)
    assert branch.period_n == 2
    r, x = branch.dataset.r.values, branch.dataset.x.values[:, 0]
    # Two steps of a gait lead back to its start, and one does not.
    step = lambda x: r * x * (1.0 - x)
    np.testing.assert_allclose(step(step(x)), x, rtol=1e-9)
    assert abs(step(x) - x).max() > 0.1


def test_a_gait_that_was_not_found_begins_no_branch():
    gait = vrw.limit_cycle({"r": 3.2}, model=Logistic(), guess=[np.nan])
    branch = continue_logistic(3.2, cycle=gait)
    assert branch.outcome == vrw.Outcome.BAD_INPUT
    assert branch.dataset.sizes["point"] == 0
    assert "BAD_INPUT" in branch.ends[0]


def test_a_margin_that_is_zero_at_a_computed_gait_is_found():
    """Each step lasts p, and the state is 2 p, so that the margin p - 0.25 vanishes at 0.25."""
    field = lambda y, p: jnp.stack([1.0 + 0.0 * y[0], 0.0 * y[1]])
    reset = lambda y, p: jnp.stack([0.0 * y[0], 0.5 * y[1] + p["p"]])
    walker = HybridSystem(
        modes={"run": Mode(field, {"end": Guard(lambda y, p: p["p"] - y[0], reset)})},
        section="end",
        state=("time", "level"),
        project=lambda y, p: y[1:],
        embed=lambda x, p: jnp.stack([0.0 * x[0], x[0]]),
        starts=lambda p: jnp.array([0.5]),
    )
    margins = {"low": lambda y, p: y[1] - 0.5}
    branch = vrw.continue_branch({"p": 0.25}, "p", (0.1, 0.4), model=walker, margins=margins)
    (border,) = branch.special_points
    assert border.name == "low"
    assert border.value == pytest.approx(0.25, abs=1e-9)
    for name in ("fold", "p"):
        with pytest.raises(ValueError, match=f"'{name}' names a parameter, margin or measure"):
            vrw.continue_branch(
                {"p": 0.25}, "p", (0.1, 0.4), model=walker, margins={name: margins["low"]}
            )
    # The step can't last longer than a mode may.
    options = vrw.StepOptions(max_phase_time=0.3)
    branch = vrw.continue_branch({"p": 0.25}, "p", (0.2, 0.4), model=walker, step_options=options)
    assert branch.ends[1].startswith(
        "Beyond it, no guard ends the mode within StepOptions.max_phase_time"
    )


def test_wrong_arguments_of_a_map_are_refused_before_the_continuation():
    logistic = lambda _, x, r: r * x * (1.0 - x)
    with pytest.raises(ValueError, match="'x' names a parameter"):
        vrw.continue_map(logistic, [0.6], 2.5, (2.0, 3.5), name="x")
    with pytest.raises(ValueError, match=r"float32, in which .*start_jax"):
        vrw.continue_map(logistic, jnp.array([0.6], jnp.float32), 2.5, (2.0, 3.5))
    # Integers are numbers too.
    assert vrw.continue_map(logistic, [2.0 / 3.0], 3, (2, 4)).special_points
