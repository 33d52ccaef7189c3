"""Borders in two parameters: curves through turning points, closed ones, and what they meet."""

import functools
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vrw_jax as vrw
from experiments.gaits.both_sides import judged
from vrw_jax.branches.bordering import border_curves
from vrw_jax.branches.continuation import MapRun
from vrw_jax.branches.run import run_all
from vrw_jax.numerics.arclength import ArclengthOptions, Ending
from vrw_jax.numerics.levels import (
    AbstractLevel,
    LevelFollowed,
    LevelLinear,
    LevelPoint,
    margins_beside_fold,
)

OPTIONS = ArclengthOptions(max_points=400, largest_step=0.05)


class MapLevel(AbstractLevel):
    """Of any map x -> `function(wheel, x, p)`: `quantity(jacobian, x, p)` is zero."""

    function: Callable = eqx.field(static=True)
    quantity: Callable = eqx.field(static=True)

    def linearise(self, wheel, z, p):
        image = functools.partial(self.function, wheel)
        by_x, by_p = jax.jacfwd(image, argnums=(0, 1))(z, p)
        right = jnp.concatenate([(image(z, p) - z)[:, None], by_p], 1)
        solved = jnp.linalg.solve(jnp.eye(len(z)) - by_x, right)
        value = lambda z, p: self.quantity(jax.jacfwd(image)(z, p), z, p)
        gz, gp = jax.jacfwd(value, argnums=(0, 1))(z, p)
        told = value(z, p) + gz @ solved[:, 0]
        columns = solved[:, 1], solved[:, 2]
        return LevelLinear(solved[:, 0], columns, by_x, told, gp + gz @ solved[:, 1:])

    def section(self, z):
        return z


def followed(function, quantity, z, p, bounds, seconds, second):
    """The curve through (p, second), as `border_curve` follows that of a gait."""
    level = LevelFollowed(MapLevel(function, quantity), seconds)
    share = (second - seconds[0]) / (seconds[1] - seconds[0])
    lead = lambda x: jnp.asarray(x, float)[None]
    start = LevelPoint(lead(z), lead(share))
    run = MapRun(level, OPTIONS, jnp.zeros(1), np.array(bounds))
    (strand,) = run_all(run, start, lead(p), np.array([True]), lambda owner, point: None)
    second = level.second(jax.tree.map(jnp.asarray, strand.points.z))
    return strand.points.p, np.asarray(second), strand


def bowl(_, x, p):
    """Its fixed point is as high as p is far from the origin, squared."""
    return 0.5 * x + 0.5 * (p @ p)


def test_a_closed_curve_is_followed_round_and_ends_where_it_began():
    height = lambda jacobian, x, p: x[0] - 0.5
    first, second, strand = followed(bowl, height, [0.5], 0.5, (-1.0, 1.0), (-1.0, 1.0), 0.5)
    np.testing.assert_allclose(first**2 + second**2, 0.5, atol=1e-9)
    assert strand.ends[1] == Ending.CLOSED.meaning
    angle = np.unwrap(np.arctan2(second, first))
    assert 2.0 * np.pi < np.ptp(angle) < 2.2 * np.pi


def henon(_, x, p):
    """x -> 1 - a x^2 + y, y -> b x over p = (a, b)."""
    return jnp.stack([1.0 - p[0] * x[0] ** 2 + x[1], p[1] * x[0]])


def fixed_point(a, b):
    x = ((b - 1.0) + np.sqrt((1.0 - b) ** 2 + 4.0 * a)) / (2.0 * a)
    return [x, b * x]


def margin(place):
    return lambda jacobian, x, p: margins_beside_fold(jacobian)[place]


def test_period_doublings_of_henon_are_on_their_parabola():
    b = 0.3
    a = 0.75 * (1.0 - b) ** 2
    ends = (0.05, 3.5), (-1.4, 0.6)
    first, second, strand = followed(henon, margin(1), fixed_point(a, b), a, *ends, b)
    np.testing.assert_allclose(first, 0.75 * (1.0 - second) ** 2, atol=1e-9)
    assert np.ptp(second) > 1.0
    # At b = -1 both multipliers are -1: a pair on the circle meets the border there.
    (meeting,) = [border for border in strand.borders if border.name == "neimark_sacker"] or [None]
    assert meeting is None or abs(meeting.value - 3.0) < 1e-6


def test_folds_of_henon_are_on_their_parabola():
    b = 0.3
    a = -0.25 * (1.0 - b) ** 2
    start = [(b - 1.0) / (2.0 * a), b * (b - 1.0) / (2.0 * a)]
    ends = (-1.0, -0.02), (-0.9, 0.6)
    first, second, _ = followed(henon, margin(0), start, a + 1e-9, *ends, b)
    np.testing.assert_allclose(first, -0.25 * (1.0 - second) ** 2, atol=1e-9)
    assert np.ptp(second) > 1.0


OVER = ("damping", "stiffness")
BOX = {"damping": (95.0, 235.0), "stiffness": (420.0, 600.0)}
KNOWN = {
    "clearance_sls1": 108.444834914,
    "lambda_4_plus": 219.847688296,
    "hit_planted_impulse": 167.754920847,
    "friction_rear": 102.892041687,
}
"""Borders of the branch along the damping."""


def assert_through_the_branch(curve):
    off = np.abs(curve.values - (KNOWN[curve.name], 500.0)).max(1)
    assert np.min(off) < 1e-7, curve.name


@pytest.fixture(scope="module")
def cycle():
    return vrw.limit_cycle(vrw.WheelParams(damping=130.0))


@pytest.fixture(scope="module")
def curves(cycle):
    """Of the gait's own quantities, which are told together."""
    names = "clearance_sls1", "lambda_4_plus", "duration_dls"
    return border_curves(names, OVER, cycle, bounds=BOX)


def test_border_curves_pass_through_the_borders_of_the_branch(curves):
    for curve in curves[:2]:
        assert_through_the_branch(curve)


def test_gaits_on_both_sides_of_a_curve_differ_in_its_sign(curves):
    random = np.random.default_rng(3)
    for curve in curves:
        told = judged(curve, BOX, 3, random)
        assert told["right, from the curve's own gait"] == 3, told
        # A wheel may have a second gait, on the other side of a fold, that is found cold instead;
        # all along the curve on which double support comes to last no time it has.
        assert told["right, found cold"] > 0 or curve.name == "duration_dls", told


def test_where_double_support_begins_to_last_gaits_double_their_period(curves):
    """A branch along the stiffness meets the doubling at c = 141.66, k = 571.4737."""
    _, jumps, rolls = curves
    (one,) = [met.values for met in rolls.meetings if met.name == "period_doubling"]
    (other,) = [met.values for met in jumps.meetings if met.name == "period_doubling"]
    share = (141.66 - one[0]) / (other[0] - one[0])
    # Its curve is off the chord by as much there, of 0.6 N/m.
    assert abs(one[1] + share * (other[1] - one[1]) - 571.4737) < 4e-3


def test_where_double_support_that_stops_becomes_one_of_no_time_both_curves_tell_the_same(curves):
    """And the polynomial through six points at which it still lasts says where it does not."""
    _, jumps, rolls = curves
    (one,) = [met.values for met in jumps.meetings if met.name == "duration_dls"]
    (other,) = [met.values for met in rolls.meetings if met.name == "lambda_4_plus"]
    np.testing.assert_allclose(one, other, rtol=1e-12)
    lasts = jumps.dataset.duration_dls.values
    few = [i for i in np.argsort(lasts) if lasts[i] > 1e-3][:6]
    nowhere = [np.polyfit(lasts[few], values, 5)[-1] for values in jumps.values[few].T]
    np.testing.assert_allclose(one, nowhere, rtol=1e-5)  # itself off by less than 1e-6
    assert f"{one[0]:.9g}" in jumps.ends[0] + jumps.ends[1]


def test_where_two_borders_meet_both_vanish(curves):
    scuffing, *_ = curves
    (met,) = [met for met in scuffing.meetings if met.name == "friction_rear"]
    params = vrw.WheelParams(**dict(zip(OVER, met.values, strict=True)))
    gait = vrw.limit_cycle(params, options=vrw.CycleOptions.tight())
    step = vrw.step(params, gait.section_state, options=vrw.Options.tight())
    assert abs(gait.takeoff_acceleration) < 1e-7
    assert abs(step.monitors.friction_rear) < 1e-8


@pytest.fixture(scope="module")
def margins_of_steps(cycle):
    return border_curves(("hit_planted_impulse", "friction_rear"), OVER, cycle, bounds=BOX)


@pytest.mark.slow
def test_margins_of_steps_are_as_exact_as_quantities_of_the_gait(margins_of_steps):
    random = np.random.default_rng(4)
    for curve in margins_of_steps:
        assert_through_the_branch(curve)
        told = judged(curve, BOX, 8, random)
        assert told["right, from the curve's own gait"] == 8, told
        assert told["right, found cold"] > 0, told


@pytest.mark.slow
def test_where_a_margin_of_the_step_meets_a_fold_branches_turn_back(margins_of_steps):
    for curve in margins_of_steps:
        (damping, stiffness) = next(met.values for met in curve.meetings if met.name == "fold")
        before = vrw.WheelParams(damping=damping, stiffness=stiffness - 10.0)
        bounds = stiffness - 20.0, stiffness + 20.0
        branch = vrw.continue_branch(before, "stiffness", bounds)
        (fold,) = [border.value for border in branch.borders if border.name == "fold"]
        assert abs(fold - stiffness) < 1e-9
