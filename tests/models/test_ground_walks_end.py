"""How walks on real ground end: by physics alone, and alike at every tolerance."""

import math

import jax.numpy as jnp
import numpy as np
import pytest
from oracle import complementarity
from scipy.integrate import solve_ivp

import vrw_jax as vrw
from vrw_jax.models.unilateral.march import (
    SINGULAR,
    Search,
    _earliest_root,
    _earliest_secant,
)
from vrw_jax.models.unilateral.mechanics import directions

WHEELS, STEPS = 128, 60
HIGH, INFINITE = np.linspace(1.0, 3.0, WHEELS), np.full(WHEELS, math.inf)
FALLEN = {22: vrw.Outcome.NO_TOUCHDOWN_IN_TIME, 68: vrw.Outcome.FELL_BACK}
PARADOX = dict.fromkeys((78, 85, 90, 105, 121, 123, 126), vrw.Outcome.FRICTION_PARADOX)
"""Wheels of `experiments.ground.survey` that end, at infinite and at high friction."""


def wheels():
    """Of `experiments.ground.survey`."""
    draw = np.random.default_rng(0).uniform
    params = vrw.WheelParams(damping=draw(20.0, 400.0, WHEELS), slope=draw(0.1, 0.34, WHEELS))
    limits = (0.05, 0.15), (0.8, 2.2), (-0.3, 0.0)
    return params, np.stack([draw(*some, WHEELS) for some in limits], 1)


def ends(friction, stoppers, tolerance):
    """Outcomes of the wheels that don't walk all steps."""
    params, starts = wheels()
    model = vrw.UnilateralWheel(friction=friction, stoppers=stoppers)
    options = vrw.Options(solver="Tsit5", rtol=tolerance, atol=tolerance)
    found = np.asarray(vrw.steps(params, starts, STEPS, model=model, options=options).outcome)
    return {int(i): found[i] for i in np.flatnonzero(found)}


@pytest.mark.parametrize("tolerance", [1e-6, 1e-8, 1e-10])
def test_how_walks_end_does_not_depend_on_the_tolerance(tolerance):
    assert ends(INFINITE, "bilateral", tolerance) == FALLEN
    assert ends(HIGH, "bilateral", tolerance) == PARADOX


@pytest.mark.slow
@pytest.mark.parametrize("tolerance", [1e-6, 1e-12])
def test_nor_where_stoppers_only_push(tolerance):
    """Without patience ten of 6,827 steps were lost at 1e-12 and high friction (see `ledger`)."""
    assert ends(INFINITE, "one-sided", tolerance) == FALLEN
    assert ends(HIGH, "one-sided", tolerance) == PARADOX


def test_the_paradox_is_where_another_code_has_its_singularity():
    """Forces jump there; the determinant that vanishes does not."""
    (params, starts), place = wheels(), 123
    own = [float(x[place]) for x in (params.damping, params.slope, HIGH)]
    wheel = complementarity.Wheel(own[2], c=own[0], slope=own[1])
    start = complementarity.paper_start(wheel, *starts[place])
    begin, _ = complementarity._event(wheel, start, 0, None)
    halves, modes = lambda y: (y[:11], y[11:]), (begin.mode, begin.held)

    def rates(_, y):
        return np.r_[y[11:], complementarity._carried(wheel, *halves(y), *modes)[0]]

    def left(_, y):
        return complementarity.singular(wheel, *halves(y), *modes) - 1e-6

    left.terminal = True
    y = np.r_[begin.q, begin.v]
    way = solve_ivp(rates, (0.0, 1.0), y, "DOP853", events=left, rtol=1e-12, atol=1e-12)
    time, y = way.t[-1], way.y[:, -1]
    slope = -left(time, y - 1e-7 * rates(time, y)) / 1e-7  # the last bit by a straight line
    model = vrw.UnilateralWheel(friction=own[2])
    params = vrw.WheelParams(damping=own[0], slope=own[1])
    for tolerance in (1e-6, 1e-10):
        options = vrw.Options(rtol=tolerance, atol=tolerance)
        step = vrw.step(params, starts[place], model=model, options=options)
        assert int(step.outcome) == vrw.Outcome.FRICTION_PARADOX
        # It ends where no more is left than `march.SINGULAR` says, of what falls by 0.8 a second.
        left_over = (SINGULAR[0] + SINGULAR[1] * tolerance) / 0.8
        assert abs(step.durations.sum() - (time - 1e-6 / slope)) < 1.1 * left_over


def test_legs_point_where_the_angle_says_after_any_number_of_turns():
    s = vrw.WheelParams().symbols()
    for theta in np.linspace(-20.0, 20.0, 41):
        legs, angles = directions(s, jnp.asarray(theta)), theta + s.alpha * np.arange(s.n)
        np.testing.assert_allclose(legs.sin, np.sin(angles), atol=1e-14)
        np.testing.assert_allclose(legs.cos, np.cos(angles), atol=1e-14)


def test_a_guard_that_has_fallen_unseen_is_looked_for_before_any_that_falls():
    """The first stands on its own event, rises and is below at the end; the second falls there."""
    column = lambda *values: jnp.asarray(values)[:, None]
    start, end, crossing = column(1e-14, 1.0), column(-1e-7, -0.1), column(True, True)
    slope = column(-1e-7, -1.1)
    first, _ = _earliest_root(start, slope, 0.0 * slope, crossing, column(True, False))
    assert first[0] == -jnp.inf
    none = jnp.zeros(1)
    search = Search(none > 0, crossing, *(none,) * 4, jnp.asarray([1.0]), 2.0 * end)
    first, _ = _earliest_secant(search, end, jnp.asarray([1.1]), crossing)
    assert first[0] == -jnp.inf
