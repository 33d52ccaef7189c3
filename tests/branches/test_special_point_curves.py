"""Curves of special points in two parameters: turning points, closed curves and intersections."""

import functools
from collections.abc import Callable
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.walkers import Henon

import vrw_jax as vrw
from experiments.gaits.both_sides import judge_curve
from vrw_jax.branches.arclength import ArclengthOptions, ContinuationStatus
from vrw_jax.branches.branch_continuation import Continuation
from vrw_jax.branches.branch_location import continue_and_locate_special_points
from vrw_jax.branches.curve_problems import (
    AbstractCurveProblem,
    TwoParameterStep,
)
from vrw_jax.branches.special_point_curves import check_curve_arguments, continue_special_points

CURVE_OPTIONS = ArclengthOptions(max_points=400, max_ds=0.05)
BATCH_SIZE = 8


@dataclass(frozen=True, kw_only=True)
class MapCurveProblem(AbstractCurveProblem):
    """Of any map x -> `function(x, p)`: `quantity(jacobian, x, p)` is zero."""

    function: Callable
    quantity: Callable

    def linearize_in_two_parameters(self, args, z, p):
        rows = np.minimum(np.arange(BATCH_SIZE), len(z) - 1)  # one program for all batches
        results = self.linearize_batch(z[rows], p[rows])
        return TwoParameterStep(*(np.asarray(result)[: len(z)] for result in results))

    @functools.cached_property
    def linearize_batch(self):
        def linearize(z, p):
            by_x, by_p = jax.jacfwd(self.function, argnums=(0, 1))(z, p)
            right = jnp.concatenate([(self.function(z, p) - z)[:, None], by_p], 1)
            solved = jnp.linalg.solve(jnp.eye(len(z)) - by_x, right)
            value = lambda z, p: self.quantity(jax.jacfwd(self.function)(z, p), z, p)
            gz, gp = jax.jacfwd(value, argnums=(0, 1))(z, p)
            result = value(z, p) + gz @ solved[:, 0]
            return solved[:, 0], solved[:, 1:].T, by_x, result, gp + gz @ solved[:, 1:]

        return jax.jit(jax.vmap(linearize))


def trace_curve(function, quantity, z, p, bounds, seconds, second):
    """The curve through (p, second), as `continue_special_point` does for a gait."""
    problem = MapCurveProblem(second_bounds=seconds, function=function, quantity=quantity)
    start = np.array([(second - seconds[0]) / (seconds[1] - seconds[0]), *z])
    run = Continuation(problem, CURVE_OPTIONS, np.array(bounds), np.zeros(1))
    (strand,) = continue_and_locate_special_points(
        run, start[None], np.array([p]), np.array([True])
    )
    return strand.points.p, problem.compute_second_parameter(strand.points.z), strand


def evaluate_bowl(x, p):
    """Return a map whose fixed point is the squared distance of p from the origin."""
    return 0.5 * x + 0.5 * (p @ p)


def test_a_closed_curve_is_continued_until_it_closes():
    height = lambda jacobian, x, p: x[0] - 0.5
    first, second, strand = trace_curve(
        evaluate_bowl, height, [0.5], 0.5, (-1.0, 1.0), (-1.0, 1.0), 0.5
    )
    np.testing.assert_allclose(first**2 + second**2, 0.5, atol=1e-9)
    assert strand.end_reasons[1] == ContinuationStatus.CURVE_CLOSED.meaning
    angle = np.unwrap(np.arctan2(second, first))
    assert 2.0 * np.pi < np.ptp(angle) < 2.2 * np.pi


@pytest.mark.parametrize(("name", "factor"), [("period_doubling", 0.75), ("fold", -0.25)])
def test_bifurcations_of_henon_are_on_their_parabolas(name, factor):
    params = {"a": 0.2, "b": 0.3}
    gait = vrw.limit_cycle(params, model=Henon(), guess=[0.7, 0.2])
    with pytest.raises(ValueError, match="give params, which cycle has"):
        vrw.continue_special_point(name, ("a", "b"), gait, model=Henon())
    curve = vrw.continue_special_point(
        name,
        ("a", "b"),
        gait,
        model=Henon(),
        params=params,
        bounds={"a": (-1.0, 3.5), "b": (-1.4, 0.6)},
    )
    a, b = curve.values.T
    np.testing.assert_allclose(a, factor * (1.0 - b) ** 2, atol=1e-9)
    assert np.ptp(b) > 1.0
    assert curve.dataset.x.shape == (len(a), 2)
    unit = {"period_doubling": -1.0, "fold": 1.0}[name]
    multipliers = curve.dataset.multiplier_real + 1j * curve.dataset.multiplier_imag
    margins = np.prod(multipliers - unit, -1)
    # The curve of the fold has an offset of this size.
    np.testing.assert_allclose(margins, {"period_doubling": 0.0, "fold": 1e-6}[name], atol=1e-8)


class FoldAndDoubling(vrw.AbstractWalker):
    """x has a fold at a = 0, and y doubles its period where b = x."""

    def advance(self, params, x, options):
        x, y = x
        end = jnp.stack([x + params["a"] - x**2, (x - 1.0 - params["b"]) * y])
        return vrw.AdvanceResult(end, jnp.ones(1))


@pytest.mark.parametrize("names", [("a", "b"), ("b", "a")])
def test_a_curve_meets_a_fold_whichever_parameter_turns_back_there(names):
    """The fixed point is x = sqrt(a), so that the curve is the parabola a = b²."""
    params, walker = {"a": 0.25, "b": 0.6}, FoldAndDoubling()
    gait = vrw.limit_cycle(params, model=walker, guess=[0.5, 0.0])
    bounds = {"a": (-1.0, 1.0), "b": (-0.8, 0.8)}
    curve = vrw.continue_special_point(
        "period_doubling", names, gait, model=walker, params=params, bounds=bounds
    )
    values = dict(zip(names, curve.values.T, strict=True))
    np.testing.assert_allclose(values["a"], values["b"] ** 2, atol=1e-9)
    (fold,) = curve.codim2_points
    assert fold.name == "fold"
    # The fold is the minimum of a parabola, where 1e-9 of a is 3e-5 of b.
    assert dict(zip(names, fold.values, strict=True)) == pytest.approx(
        {"a": 0.0, "b": 0.0}, abs=3e-5
    )


class HenonWithInvariant(vrw.AbstractWalker):
    """Hénon's map with a + c, where c = z + x² is conserved."""

    invariants = (lambda x, params: x[2] + x[0] ** 2,)

    def advance(self, params, x, options):
        (conserved,) = self.evaluate_invariants(params, x)
        step = Henon().advance(params | {"a": params["a"] + conserved}, x[:2], options)
        z = conserved - step.section_state[0] ** 2
        return vrw.AdvanceResult(jnp.append(step.section_state, z), step.durations)


@pytest.mark.parametrize("period_n", [1, 2])
def test_walkers_with_an_invariant_or_several_steps_double_their_period_on_parabolas(period_n):
    """The orbit of period two doubles its own where 4 a = (1 + b)² + 4 (1 - b)² (see `Henon`)."""
    conserved, walker = 0.15, HenonWithInvariant()
    params = {"a": {1: 0.2, 2: 0.7}[period_n] - conserved, "b": 0.3}
    x, y = {1: (0.7, 0.2), 2: (1.32, -0.1)}[period_n]
    gait = vrw.limit_cycle(params, model=walker, guess=[x, y, conserved - x**2], period_n=period_n)
    evaluate = lambda b: (
        {1: 3.0 * (1.0 - b) ** 2, 2: (1.0 + b) ** 2 + 4.0 * (1.0 - b) ** 2}[period_n] / 4.0
    )
    bounds = {"a": (-1.0, 3.0), "b": (0.0, 0.6)}
    branch = vrw.continue_branch(
        params, "a", bounds["a"], model=walker, cycle=gait, period_n=period_n
    )
    doubling = next(point for point in branch.special_points if point.kind == "period_doubling")
    assert abs(doubling.value + conserved - evaluate(0.3)) < 1e-8
    np.testing.assert_allclose(
        doubling.cycle.section_state, doubling.point.section_state, atol=1e-8
    )
    curve = vrw.continue_special_point(
        "period_doubling", ("a", "b"), gait, model=walker, params=params, bounds=bounds
    )
    a, b = curve.values.T
    np.testing.assert_allclose(a + conserved, evaluate(b), atol=1e-8)
    assert np.ptp(b) == pytest.approx(0.6, abs=1e-8)
    assert curve.ends == ("The second parameter's range ended.",) * 2


CURVE_PARAMETERS = ("damping", "stiffness")
CURVE_BOX = {"damping": (95.0, 235.0), "stiffness": (420.0, 600.0)}
KNOWN_SPECIAL_POINTS = {
    "clearance_sls1": 108.444834914,
    "lambda_4_plus": 219.847688296,
    "hit_planted_impulse": 167.754920847,
    "friction_rear": 102.892041687,
}
"""Borders of the branch along the damping."""


def assert_through_the_branch(curve):
    off = np.abs(curve.values - (KNOWN_SPECIAL_POINTS[curve.name], 500.0)).max(1)
    assert np.min(off) < 1e-7, curve.name


def test_the_bounds_of_a_parameter_are_read_once():
    bounds = {"damping": map(float, ("100", "200")), "slope": (0.2, 0.3)}
    _, ranges, *_ = check_curve_arguments(("damping", "slope"), bounds, str, {}, None, None)
    np.testing.assert_array_equal(ranges, [[100.0, 200.0], [0.2, 0.3]])


@pytest.fixture(scope="module")
def table_1_cycle():
    return vrw.limit_cycle(vrw.WheelParams(damping=130.0))


def test_a_gait_that_was_not_found_begins_no_curve(table_1_cycle):
    lost = eqx.tree_at(lambda cycle: cycle.outcome, table_1_cycle, jnp.int32(9))
    with pytest.raises(ValueError, match="cycle was not found"):
        vrw.continue_special_point("lambda_4_plus", CURVE_PARAMETERS, lost)


@pytest.fixture(scope="module")
def special_point_curves(table_1_cycle):
    """Of the gait's own quantities, which are told together."""
    names = "clearance_sls1", "lambda_4_plus", "duration_dls"
    return continue_special_points(names, CURVE_PARAMETERS, table_1_cycle, bounds=CURVE_BOX)


@pytest.mark.slow
def test_special_point_curves_pass_through_the_special_points_of_the_branch(special_point_curves):
    for curve in special_point_curves[:2]:
        assert_through_the_branch(curve)


@pytest.mark.slow
def test_gaits_on_both_sides_of_a_curve_differ_in_its_sign(special_point_curves):
    random = np.random.default_rng(3)
    for curve in special_point_curves:
        result = judge_curve(curve, CURVE_BOX, 3, random)
        assert result["right, from the curve's own gait"] == 3, result
        # A wheel may have a second gait, on the other side of a fold, that is found cold instead;
        # all along the curve on which double support comes to last no time it has.
        assert result["right, found cold"] > 0 or curve.name == "duration_dls", result


@pytest.mark.slow
def test_period_doubling_lies_between_its_meetings_with_both_double_support_curves(
    special_point_curves,
):
    """A branch along the stiffness meets the doubling at c = 141.66, k = 571.4737."""
    _, jumps, rolls = special_point_curves
    (one,) = [
        codim2_point.values
        for codim2_point in rolls.codim2_points
        if codim2_point.name == "period_doubling"
    ]
    (other,) = [
        codim2_point.values
        for codim2_point in jumps.codim2_points
        if codim2_point.name == "period_doubling"
    ]
    share = (141.66 - one[0]) / (other[0] - one[0])
    # Its curve is off the chord by as much there, of 0.6 N/m.
    assert abs(one[1] + share * (other[1] - one[1]) - 571.4737) < 4e-3


@pytest.mark.slow
def test_curves_of_vanishing_and_of_zero_double_support_meet_at_one_point(special_point_curves):
    """And the polynomial through six points at which it still lasts says where it does not."""
    _, jumps, rolls = special_point_curves
    (one,) = [
        codim2_point.values
        for codim2_point in jumps.codim2_points
        if codim2_point.name == "duration_dls"
    ]
    (other,) = [
        codim2_point.values
        for codim2_point in rolls.codim2_points
        if codim2_point.name == "lambda_4_plus"
    ]
    np.testing.assert_allclose(one, other, rtol=1e-12)
    lasts = jumps.dataset.duration_dls.values
    point_indices = [i for i in np.argsort(lasts) if lasts[i] > 1e-3][:6]
    nowhere = [
        np.polyfit(lasts[point_indices], values, 5)[-1] for values in jumps.values[point_indices].T
    ]
    np.testing.assert_allclose(one, nowhere, rtol=1e-5)  # itself off by less than 1e-6
    assert f"{one[0]:.9g}" in jumps.ends[0] + jumps.ends[1]


@pytest.mark.slow
def test_both_test_functions_vanish_at_a_codimension_two_point(special_point_curves):
    scuffing, *_ = special_point_curves
    (codim2_point,) = [
        codim2_point
        for codim2_point in scuffing.codim2_points
        if codim2_point.name == "friction_rear"
    ]
    params = vrw.WheelParams(**dict(zip(CURVE_PARAMETERS, codim2_point.values, strict=True)))
    gait = vrw.limit_cycle(params, options=vrw.CycleOptions.tight())
    step = vrw.step(params, gait.section_state, options=vrw.StepOptions.tight())
    assert abs(gait.takeoff_acceleration) < 1e-7
    assert abs(step.margins.friction_rear) < 1e-8


@pytest.fixture(scope="module")
def step_margin_curves(table_1_cycle):
    return continue_special_points(
        ("hit_planted_impulse", "friction_rear"), CURVE_PARAMETERS, table_1_cycle, bounds=CURVE_BOX
    )


@pytest.mark.slow
def test_margins_of_steps_are_as_accurate_as_quantities_of_the_gait(step_margin_curves):
    random = np.random.default_rng(4)
    for curve in step_margin_curves:
        assert_through_the_branch(curve)
        result = judge_curve(curve, CURVE_BOX, 8, random)
        assert result["right, from the curve's own gait"] == 8, result
        assert result["right, found cold"] > 0, result


@pytest.mark.slow
def test_branches_turn_back_at_the_meeting_of_a_margin_and_a_fold(step_margin_curves):
    for curve in step_margin_curves:
        (damping, stiffness) = next(
            codim2_point.values
            for codim2_point in curve.codim2_points
            if codim2_point.name == "fold"
        )
        before = vrw.WheelParams(damping=damping, stiffness=stiffness - 10.0)
        bounds = stiffness - 20.0, stiffness + 20.0
        branch = vrw.continue_branch(before, "stiffness", bounds)
        (fold,) = [border.value for border in branch.special_points if border.name == "fold"]
        assert abs(fold - stiffness) < 1e-9


@pytest.mark.slow
def test_a_curve_begins_at_a_fold_where_the_search_finds_no_gait(table_1_cycle):
    """At a fixed parameter, Newton's method is singular at a fold."""
    curve = vrw.continue_special_point("fold", CURVE_PARAMETERS, table_1_cycle, bounds=CURVE_BOX)
    damping, stiffness = curve.values[1]
    assert damping < 100.0
    before = vrw.WheelParams(damping=damping, stiffness=stiffness - 10.0)
    branch = vrw.continue_branch(before, "stiffness", (stiffness - 20.0, stiffness + 20.0))
    (fold,) = [point for point in branch.special_points if point.name == "fold"]
    assert abs(fold.value - stiffness) < 1e-8
    assert not fold.cycle.found


class FoldCircle(vrw.AbstractWalker):
    """Its folds are at a^2 + c^2 = 1/4."""

    def advance(self, params, x, options):
        return vrw.AdvanceResult(
            x + (params["a"] ** 2 + params["c"] ** 2 - 0.25) - x**2, jnp.ones(1)
        )


class NeimarkSackerLine(vrw.AbstractWalker):
    """Its Neimark-Sacker bifurcations are at a = 0, for any angle."""

    def advance(self, params, x, options):
        cosine, sine = jnp.cos(params["angle"]), jnp.sin(params["angle"])
        turned = jnp.stack([cosine * x[0] - sine * x[1], sine * x[0] + cosine * x[1]])
        return vrw.AdvanceResult((1.0 + params["a"] - x @ x) * turned, jnp.ones(1))


@pytest.mark.parametrize(
    ("walker", "params", "guess", "name", "compute_defect"),
    [
        (FoldCircle(), {"a": 1.0, "c": 0.0}, [0.8], "fold", lambda a, c: a**2 + c**2 - 0.25),
        (
            NeimarkSackerLine(), {"a": -0.3, "angle": 1.0}, [0.0, 0.0],
            "neimark_sacker", lambda a, angle: a,
        ),
    ],
)  # fmt: skip
def test_a_curve_starts_where_it_is_parallel_to_the_second_parameter(
    walker, params, guess, name, compute_defect
):
    first, second = params
    bounds = {"a": (-1.0, 1.0), second: (-1.0, 1.0) if second == "c" else (0.2, 3.0)}
    gait = vrw.limit_cycle(params, model=walker, guess=guess)
    curve = vrw.continue_special_point(
        name, (first, second), gait, bounds=bounds, model=walker, params=params
    )
    values = curve.dataset[first].values, curve.dataset[second].values
    np.testing.assert_allclose(compute_defect(*values), 0.0, atol=1e-9)
    assert np.ptp(values[1]) > 0.99 * (1.0 if second == "c" else 2.8)
    assert not curve.codim2_points
