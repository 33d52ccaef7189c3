"""Curves of optima: each point is the optimum of a search of its own, also beside changes."""

import numpy as np
import pytest
from support.leg_laws import QuadraticDamper, make_wheel
from support.walkers import BALL_PARAMS, JuggledBall

import vrw_jax as vrw

FREE, BOUNDS = ("damping", "stiffness"), {"damping": (20.0, 300.0), "stiffness": (250.0, 1200.0)}


def follow(*slopes):
    wheel = vrw.WheelParams(slope=slopes[0])
    return vrw.tune(wheel, "spectral_margin", FREE, BOUNDS, along=("slope", slopes))


@pytest.fixture(scope="module")
def curve():
    return follow(0.30, 0.25, 0.23)


@pytest.mark.slow
def test_each_point_of_a_curve_is_the_optimum_of_a_search_of_its_own(curve):
    assert curve.dataset.slope.values[[0, -1]].tolist() == [0.30, 0.23]
    for point in (0, -1):
        start = {name: float(curve.dataset[name][point]) for name in FREE}
        start["damping"] -= 5.0
        wheel = vrw.WheelParams(slope=float(curve.dataset.slope[point]), **start)
        single = vrw.tune(wheel, "spectral_margin", FREE, BOUNDS)
        assert single.converged
        assert abs(single.value - float(curve.dataset.objective[point])) < 1e-6
        for name in FREE:
            assert abs(float(getattr(single.params, name)) - curve.dataset[name][point]) < 0.02


@pytest.mark.slow
def test_the_active_limits_change_where_the_damping_reaches_and_leaves_its_bound(curve):
    """On both sides of a change, searches of their own have the limits that the curve reports."""
    assert len(curve.changes) > 1
    assert all("damping at its upper bound" in repr(change) for change in curve.changes)
    first, last = curve.changes[0], curve.changes[-1]
    for slope, names in ((first.value + 1e-3, first.before), (last.value - 1e-3, last.after)):
        point = np.argmin(np.abs(curve.dataset.slope.values - slope))
        start = {name: float(curve.dataset[name][point]) for name in FREE}
        single = vrw.tune(vrw.WheelParams(slope=slope, **start), "spectral_margin", FREE, BOUNDS)
        assert {limit.name for limit in single.active} == set(names)


@pytest.mark.slow
def test_optima_along_a_parameter_of_the_law_are_gaits_with_the_law():
    bounds = {"damping": (140.0, 160.0)}
    curve = vrw.tune(
        vrw.WheelParams(damping=150.0), "speed", ["damping"], bounds,
        model=make_wheel(QuadraticDamper(60.0)), along=("leg.c2", (60.0, 30.0, 0.0)),
    ).dataset  # fmt: skip
    for c2, damping, speed in zip(curve["leg.c2"], curve.damping, curve.objective, strict=True):
        wheel = vrw.WheelParams(damping=float(damping))
        gait = vrw.limit_cycle(wheel, model=make_wheel(QuadraticDamper(float(c2))))
        assert float(gait.speed) == pytest.approx(float(speed), abs=1e-9)


def test_a_limit_changes_on_the_way_there_and_on_the_way_back():
    """The velocity k / (1 - e) reaches 2 m/s at e = 1/2, with the largest k of 1 m/s."""
    curve = vrw.tune(
        BALL_PARAMS, "velocity", ["kick"], {"kick": (0.5, 1.0)}, {"velocity": (None, 2.0)},
        model=JuggledBall(), along=("ball.restitution", (0.4, 0.6, 0.4)),
    )  # fmt: skip
    # A constraint is kept to 1e-6 of its change between the bounds, and counts as active at 1e-5.
    np.testing.assert_allclose(curve.dataset.kick, [1.0, 0.8, 1.0], atol=1e-6)
    np.testing.assert_allclose([change.value for change in curve.changes], 0.5, atol=1e-5)
    assert curve.changes[0].before == curve.changes[-1].after == ("kick at its upper bound",)
    assert ("velocity",) in [change.after for change in curve.changes]


def test_arguments_of_a_curve_are_refused_in_one_sentence():
    for along, message in (
        (("damping", (150.0, 160.0)), "which is free"),
        (("slope", (0.3,)), "at least two"),
        (("incline", (0.3, 0.2)), "no parameter"),
        (("slope", (0.3, np.nan)), "slope is nan, but"),
    ):
        with pytest.raises(ValueError, match=message):
            vrw.tune(vrw.WheelParams(), "dls_fraction", FREE, BOUNDS, along=along)


def test_a_curve_without_a_first_gait_speaks_of_its_start():
    """The velocity grows without end from a restitution of 1 on."""
    sentence = "restitution 1.5, where the curve begins: The search finds no gait near its start."
    with pytest.raises(ValueError, match=sentence):
        vrw.tune(
            BALL_PARAMS, "velocity", ["kick"], {"kick": (0.5, 1.0)}, {},
            model=JuggledBall(), along=("ball.restitution", (1.5, 0.4)),
        )  # fmt: skip
