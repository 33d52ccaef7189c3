"""Branches pass folds, and every special point on them is located to 1e-9."""

import dataclasses
import pickle

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.files import assert_netcdf_round_trip

import vrw_jax as vrw
from vrw_jax import lanes
from vrw_jax.app._gait_figures import branch_figure
from vrw_jax.app.config import FigureConfig
from vrw_jax.app.output import write_branch_report
from vrw_jax.branches.arclength import ArclengthDriver, MapProblem, run_together
from vrw_jax.branches.branch_location import locate_function_roots
from vrw_jax.flow.phase_integration import GuardsAndMargins, integrate_phase
from vrw_jax.gaits.fixed_points import estimate_state_units

RADIUS_AT_200 = 0.32861954  # Table 1: published for orientation beside the physics
LOCATION_TOLERANCE = 1e-9


# Maps with closed forms ---------------------------------------------------------------------------


def evaluate_henon(b, x, a):
    """x -> 1 - a x^2 + y, y -> b x: fold at -(1-b)^2/4, period doubling at 3 (1-b)^2/4."""
    return jnp.stack([1.0 - a * x[0] ** 2 + x[1], b * x[0]])


def evaluate_logistic(_, x, r):
    """x -> r x (1 - x): period doubling at 3."""
    return r * x * (1.0 - x)


def evaluate_delayed_logistic(_, x, r):
    """x -> r x (1 - y), y -> x: Neimark-Sacker bifurcation at 2, multipliers exp(+-i pi/3)."""
    return jnp.stack([r * x[0] * (1.0 - x[1]), x[0]])


def evaluate_stretched_map(_, x, p):
    """Three numbers: a fold in the first at p = 0 beside two that contract."""
    return jnp.stack([x[0] + p - x[0] ** 2, 0.5 * x[1] + x[0], -0.3 * x[2]])


def test_branches_continued_together_equal_single_ones_with_two_iterations_per_point():
    """Eleven of different lengths. From the tangent alone, three iterations would be needed."""
    b, a = np.linspace(-0.4, 0.5, 11), np.linspace(1.0, 0.4, 11)
    n_linearized = []

    class CountingProblem(MapProblem):
        def linearize(self, args, z, p):
            n_linearized.append(len(p))
            return super().linearize(args, z, p)

    driver = ArclengthDriver(
        CountingProblem((1.0, 1.0), evaluate_henon), vrw.ArclengthOptions(), np.array([-1.0, 2.0])
    )

    def trace(owners):
        tasks = [driver.trace(b[i], np.array([0.6, 0.6 * b[i]]), a[i], 1.0) for i in owners]
        return run_together(driver.problem, b, owners, tasks)

    every = trace(range(11))
    n_points = [len(track.points) for track in every]
    assert sum(n_linearized) < 2.3 * sum(n_points)
    assert np.ptp(n_points) > 10
    for i in (0, 5, 10):
        (single,) = trace([i])
        assert len(single.points) == n_points[i]
        single_values, values = ([point.p for point in x.points] for x in (single, every[i]))
        np.testing.assert_allclose(single_values, values, rtol=0, atol=1e-10)


def special_points_by_kind(branch):
    return {border.kind: border.value for border in branch.special_points}


def test_fold_and_period_doubling_of_henon_agree_with_the_closed_form():
    for b in (0.3, -0.4):
        branch = vrw.continue_map(evaluate_henon, [0.6, 0.6 * b], 1.0, (-1.0, 2.0), constants=b)
        solution = special_points_by_kind(branch)
        assert set(solution) == {"fold", "period_doubling"}
        assert abs(solution["fold"] + (1.0 - b) ** 2 / 4.0) < LOCATION_TOLERANCE
        assert abs(solution["period_doubling"] - 3.0 * (1.0 - b) ** 2 / 4.0) < LOCATION_TOLERANCE


def test_the_branch_turns_back_at_a_fold_and_continues_unstable():
    branch = vrw.continue_map(evaluate_henon, [0.6, 0.18], 1.0, (-1.0, 2.0), constants=0.3)
    values, b = branch.values, 0.3
    turn = int(np.argmin(values))
    assert 0 < turn < values.size - 1
    printed_range = f"from {values.min():.6g} to {values.max():.6g}"
    assert printed_range in str(branch), "both ends of a branch with a fold have large values"
    x = branch.dataset.x.values[:, 0]
    residual = values * x**2 + (1.0 - b) * x - 1.0
    assert np.abs(residual).max() < 1e-9 * max(1.0, np.abs(values * x**2).max())
    assert not branch.stable[: turn - 2].any()


def test_period_doubling_of_the_logistic_map_is_at_3():
    branch = vrw.continue_map(evaluate_logistic, [0.6], 2.5, (1.5, 4.0))
    assert abs(special_points_by_kind(branch)["period_doubling"] - 3.0) < LOCATION_TOLERANCE


def test_neimark_sacker_of_the_delayed_logistic_map_is_at_2():
    branch = vrw.continue_map(evaluate_delayed_logistic, [0.4, 0.4], 1.7, (1.4, 2.2))
    (border,) = branch.special_points
    assert border.kind == "neimark_sacker"
    assert abs(border.value - 2.0) < LOCATION_TOLERANCE
    turn = np.exp(1j * np.pi / 3.0)
    np.testing.assert_allclose(sorted(border.cycle.multipliers.imag), [-turn.imag, turn.imag])


def test_real_reciprocal_multipliers_are_no_neimark_sacker_bifurcation():
    # Multipliers 2 p and 1/2: their product is 1 at p = 1, where nothing happens.
    saddle = lambda _, x, p: jnp.stack([2.0 * p * x[0], 0.5 * x[1]])
    branch = vrw.continue_map(saddle, [0.0, 0.0], 0.8, (0.6, 1.4))
    assert "neimark_sacker" not in special_points_by_kind(branch)


def pitchfork(offset, x, p):
    """x -> x + (p x - x^3 + offset)/10: side branch p = x^2, broken where the offset is not 0."""
    return x + 0.1 * (p * x - x**3 + offset)


def along_the_side_branch(offset):
    return vrw.continue_map(pitchfork, [1.0], 1.0, (-1.0, 1.2), constants=offset)


@pytest.mark.parametrize("n", [2, 3, 5])
def test_equal_logistic_maps_double_their_period_all_at_once_at_3(n):
    branch = vrw.continue_map(evaluate_logistic, [0.6] * n, 2.5, (2.0, 3.5))
    (border,) = branch.special_points
    assert (border.kind, border.n_multipliers) == ("period_doubling", n)
    assert abs(border.value - 3.0) < LOCATION_TOLERANCE
    assert f"of {n} multipliers at once" in str(border)


def test_three_equal_maps_seen_from_other_coordinates_are_no_neimark_sacker_bifurcation():
    """Round-off makes a threefold multiplier complex, by 1e-5."""
    into = jnp.array([[1.0, 2.0, 0.3], [0.0, 1.0, -1.0], [0.5, 0.0, 1.0]])
    turned = lambda _, x, r: into @ evaluate_logistic(None, jnp.linalg.solve(into, x), r)
    branch = vrw.continue_map(turned, into @ jnp.full(3, 0.6), 2.5, (2.0, 3.5))
    (border,) = branch.special_points
    assert (border.kind, border.n_multipliers) == ("period_doubling", 3)
    assert abs(border.value - 3.0) < LOCATION_TOLERANCE


def test_two_pairs_of_multipliers_leave_the_circle_at_once():
    twice = lambda _, x, r: jnp.concatenate(
        [evaluate_delayed_logistic(_, x[:2], r), evaluate_delayed_logistic(_, x[2:], r)]
    )
    (border,) = vrw.continue_map(twice, [0.4] * 4, 1.7, (1.4, 2.2)).special_points
    assert (border.kind, border.n_multipliers) == ("neimark_sacker", 4)
    assert abs(border.value - 2.0) < LOCATION_TOLERANCE


def test_two_period_doublings_within_one_step_are_told_apart():
    beside = lambda _, x, r: jnp.stack(
        [evaluate_logistic(_, x[0], r), evaluate_logistic(_, x[1], r + 1e-4)]
    )
    first, second = vrw.continue_map(beside, [0.6, 0.6], 2.5, (2.0, 3.5)).special_points
    assert {first.kind, second.kind} == {"period_doubling"}
    assert abs(first.value - 2.9999) < LOCATION_TOLERANCE
    assert abs(second.value - 3.0) < LOCATION_TOLERANCE


def test_different_bifurcations_at_one_place_are_each_found():
    """A pair at 2, and a period doubling of the logistic map there."""
    both = lambda _, x, r: jnp.concatenate(
        [evaluate_delayed_logistic(_, x[:2], r), evaluate_logistic(_, x[2:], r + 1.0)]
    )
    branch = vrw.continue_map(both, [0.4, 0.4, 0.63], 1.7, (1.4, 2.2))
    assert sorted(border.kind for border in branch.special_points) == [
        "neimark_sacker",
        "period_doubling",
    ]
    assert all(abs(border.value - 2.0) < LOCATION_TOLERANCE for border in branch.special_points)


def test_a_pitchfork_is_met_along_its_side_branch():
    branch = along_the_side_branch(0.0)
    (border,) = branch.special_points
    assert border.kind == "branch_point"
    assert abs(border.value) < LOCATION_TOLERANCE
    assert abs(border.point.section_state[0]) < 1e-5  # p = x^2
    np.testing.assert_allclose(branch.dataset.x[:, 0] ** 2, branch.values, atol=1e-9)


def cross(_, x, p):
    """x = sin p crosses x = sin p + (p - 0.4321) / 0.3."""
    offset = x - jnp.sin(p)
    return x + 0.1 * offset * (p - 0.4321 - 0.3 * offset)


def cross_at_a_small_angle(_, x, p):
    """x = sin p crosses another branch, whose slope differs by a twentieth of exp 0.4321."""
    offset = x - jnp.sin(p)
    return x + 0.3 * offset * (offset - 0.05 * (p - 0.4321) * jnp.exp(p))


def fork(_, x, p):
    """x = (p, 0) meets the parabola (x[0] - p)² = p - 0.4321, but for the second entry."""
    offset = x[0] - p
    first = x[0] + offset * (p - 0.4321 - offset**2 + 0.2 * x[1])
    return jnp.stack([first, 0.5 * x[1] + 0.3 * offset])


@pytest.mark.parametrize("tolerance", [1e-6, 1e-8, 1e-10, 1e-11, 1e-12])
@pytest.mark.parametrize(
    ("function", "start"),
    [(cross, [np.sin(0.1)]), (cross_at_a_small_angle, [np.sin(0.1)]), (fork, [0.1, 0.0])],
)
def test_a_branch_crosses_another_one_at_every_tolerance(function, start, tolerance):
    """Next to the crossing, Newton's method amplifies round-off above the smaller tolerances."""
    options = vrw.ArclengthOptions(tolerance=tolerance)
    branch = vrw.continue_map(function, start, 0.1, (0.0, 1.0), options=options)
    (border,) = branch.special_points
    assert border.kind == "branch_point"
    assert abs(border.value - 0.4321) < LOCATION_TOLERANCE
    known = branch.values if function is fork else np.sin(branch.values)
    np.testing.assert_allclose(branch.dataset.x[:, 0], known, atol=10.0 * tolerance)


@pytest.mark.parametrize("p", [0.8661, 0.87, -0.86])
def test_a_closed_branch_that_starts_next_to_a_special_point_has_it_once(p):
    """x^2 + p^2 = 1 has folds at p = -1 and 1, and period doublings at x = 1/2."""
    closed = lambda _, x, p: x - 2.0 * (x**2 + p**2 - 1.0)
    branch = vrw.continue_map(closed, [np.sqrt(1.0 - p**2)], p, (-2.0, 2.0))
    found = sorted((point.value, point.kind) for point in branch.special_points)
    values, kinds = zip(*found, strict=True)
    assert kinds == ("fold", "period_doubling", "period_doubling", "fold")
    half_width = np.sqrt(0.75)
    np.testing.assert_allclose(
        values, [-1.0, -half_width, half_width, 1.0], atol=LOCATION_TOLERANCE
    )
    np.testing.assert_allclose(branch.values[[0, -1]], p, rtol=1e-15)


@pytest.mark.parametrize("bound", [0.0, -1e-12, -1e-6, 1e-6])
def test_a_fold_at_a_bound_of_the_parameter_is_passed(bound):
    """x^2 = p has its fold at 0, and both halves reach the other bound."""
    parabola = lambda _, x, p: x - (x**2 - p)
    branch = vrw.continue_map(parabola, [np.sqrt(0.5)], 0.5, (bound, 1.0))
    folds = [point.value for point in branch.special_points if point.kind == "fold"]
    assert branch.ends == ("The parameter's range ended.",) * 2
    assert branch.values[[0, -1]].tolist() == [1.0 if bound <= 0.0 else bound, 1.0]
    np.testing.assert_allclose(folds, [0.0] * (bound <= 0.0), atol=LOCATION_TOLERANCE)


def test_a_branch_that_bends_toward_a_bound_ends_on_it():
    """With 0.1 as the longest step, the tangent misses p = 0, beyond which the parabola bends."""
    offset = 0.00990523733462663
    parabola = lambda _, x, p: x + 0.5 * (1.0 + offset - p - x**2)
    options = vrw.ArclengthOptions(max_ds=0.1)
    x = [np.sqrt(0.5 + offset)]
    branch = vrw.continue_map(parabola, x, 0.5, (0.0, 1.0), options=options)
    assert branch.values[[0, -1]].tolist() == [0.0, 1.0]


@pytest.mark.parametrize("offset", [1e-3, 1e-6, 1e-9])
def test_beside_a_pitchfork_that_nearly_is_one_the_branch_is_not_left(offset):
    """Above, the branch is x > 0 and stable; below, it turns back at 3 (offset/2)^(2/3)."""
    above = along_the_side_branch(offset)
    assert not above.special_points
    assert above.values[0] == -1.0
    assert (above.dataset.x > 0.0).all()
    assert above.stable.all()
    below = along_the_side_branch(-offset)
    (fold,) = below.special_points
    assert fold.kind == "fold"
    assert abs(fold.value - 3.0 * (0.5 * offset) ** (2 / 3)) < LOCATION_TOLERANCE
    assert below.values[[0, -1]].tolist() == [1.2, 1.2]
    assert (below.dataset.x > 0.0).all()


# Units --------------------------------------------------------------------------------------------


def circle(units, x, p):
    """x -> x + 0.3 u (1 - (x/u)^2 - (p/v)^2): a circle with folds at p = -v and p = v."""
    u, v = units
    return x + 0.3 * u * (1.0 - (x / u) ** 2 - (p / v) ** 2)


@pytest.mark.parametrize(("u", "v"), [(1.0, 1.0), (1e-9, 1e6), (1e-3, 1e-9), (1e3, 1.0)])
@pytest.mark.parametrize("start", [(1.0, 0.0), (0.0, 1.0)], ids=["regular", "fold"])
def test_a_circle_with_two_folds_is_the_same_in_all_units(u, v, start):
    x, p = [u * start[0]], v * start[1]
    branch = vrw.continue_map(circle, x, p, (-2.0 * v, 2.0 * v), constants=(u, v))
    folds = [point.value / v for point in branch.special_points]
    assert {point.kind for point in branch.special_points} == {"fold"}
    np.testing.assert_allclose(sorted(folds), [-1.0, 1.0], atol=LOCATION_TOLERANCE)
    assert branch.ends == ("The curve returned to its start.",) * 2
    points = branch.dataset.x.values[:, 0] / u, branch.values / v
    np.testing.assert_allclose(np.hypot(*points), 1.0, atol=LOCATION_TOLERANCE)
    for fold in branch.special_points:
        np.testing.assert_allclose(fold.point.section_state / u, 0.0, atol=1e-4)  # root of 1e-9


def test_components_of_different_size_have_their_own_units():
    """Henon's map in units of 1e-9 and 1e6, from its fold."""
    units, b = np.array([1e-9, 1e6]), 0.3
    in_units = lambda _, x, a: units * evaluate_henon(b, x / units, a)
    fold = -((1.0 - b) ** 2) / 4.0
    x = -(1.0 - b) / (2.0 * fold)
    branch = vrw.continue_map(in_units, units * np.array([x, b * x]), fold, (-1.0, 2.0))
    solution = special_points_by_kind(branch)
    assert set(solution) == {"fold", "period_doubling"}
    assert abs(solution["fold"] - fold) < LOCATION_TOLERANCE
    assert abs(solution["period_doubling"] + 3.0 * fold) < LOCATION_TOLERANCE
    doubling = next(point for point in branch.special_points if point.kind == "period_doubling")
    multipliers = np.sort(doubling.point.multipliers.real)  # -1 and, by the determinant -b, b
    np.testing.assert_allclose(multipliers, [-1.0, b], atol=1e-5)


@pytest.mark.parametrize("u", [1.0, 1e-9])
def test_a_branch_starts_where_two_branches_cross(u):
    """x = -u p and x = u p cross at 0, where the map has no first derivative but that of x."""
    cross = lambda u, x, p: x + 0.1 * u * ((x / u) ** 2 - p**2)
    branch = vrw.continue_map(cross, [0.0], 0.0, (-1.0, 1.2), constants=u)
    (border,) = branch.special_points
    assert border.kind == "branch_point"
    assert abs(border.value) < LOCATION_TOLERANCE
    assert branch.values[[0, -1]].tolist() == [-1.0, 1.2]
    side = np.sign(branch.dataset.x.values[-1, 0])
    np.testing.assert_allclose(branch.dataset.x.values[:, 0] / u, side * branch.values, atol=1e-9)


def test_a_branch_starts_at_a_pitchfork():
    branch = vrw.continue_map(pitchfork, [0.0], 0.0, (-1.0, 1.2), constants=0.0)
    (border,) = branch.special_points
    assert border.kind == "branch_point"
    assert abs(border.value) < LOCATION_TOLERANCE


@pytest.mark.parametrize(
    ("function", "expected"),
    [
        (lambda _, x, p: x + 0.3 * (p * x - x**2), lambda x: x),
        (lambda _, x, p: pitchfork(0.0, x, p), np.square),
    ],
    ids=["transcritical", "pitchfork"],
)
def test_a_crossing_branch_is_continued_to_both_sides(function, expected):
    """x = 0 is crossed by x = p, or by x² = p."""
    trivial = vrw.continue_map(function, [0.0], -0.5, (-1.0, 1.2))
    (crossing,) = trivial.special_points
    branch = vrw.continue_map(function, [0.0], -0.5, (-1.0, 1.2), switch_at=crossing)
    x = branch.dataset.x.values[:, 0]
    np.testing.assert_allclose(expected(x), branch.values, atol=1e-9)
    assert np.min(x) < -0.9
    assert np.max(x) > 0.9
    assert [point.kind for point in branch.special_points] == ["branch_point"]
    assert branch.ends == ("The parameter's range ended.",) * 2


def test_a_doubling_of_a_switched_branch_doubles_its_period_again():
    """x -> a - x² doubles its period at 3/4, at 5/4, and at 1.3680989394 (Feigenbaum's cascade)."""
    follow = lambda **keywords: vrw.continue_map(
        lambda _, x, a: a - x**2, [0.5], 0.75 - 1e-3, (0.5, 1.39), **keywords
    )
    branch = follow()
    for value, period_n in ((0.75, 2), (1.25, 4)):
        assert abs(special_points_by_kind(branch)["period_doubling"] - value) < 1e-9
        (doubling,) = [x for x in branch.special_points if x.kind == "period_doubling"]
        branch = follow(switch_at=doubling)
        assert branch.period_n == period_n
        assert branch.stable[0]
        x = orbit = branch.section_states[-1]
        distances = []
        for _ in range(period_n):
            x = branch.values[-1] - x**2
            distances.append(float(np.abs(x - orbit)[0]))
        assert distances[-1] < 1e-8
        assert min(distances[:-1]) > 1e-4
    assert abs(special_points_by_kind(branch)["period_doubling"] - 1.3680989394) < 1e-9


def test_a_component_that_is_only_round_off_does_not_set_its_unit():
    noisy = lambda _, x, r: jnp.stack(
        [evaluate_logistic(_, x[0], r), 0.5 * x[1] + jnp.cos(x[0]) ** 2 + jnp.sin(x[0]) ** 2 - 1.0]
    )
    branch = vrw.continue_map(noisy, [0.6, 1e-17], 2.5, (2.0, 3.5))
    assert abs(special_points_by_kind(branch)["period_doubling"] - 3.0) < LOCATION_TOLERANCE


def test_the_remainder_of_an_iteration_towards_the_origin_sets_no_unit():
    turn = jnp.array([[0.8, -0.6], [0.6, 0.8]])
    spiral = lambda _, x, p: jnp.exp(p) * (turn @ x) * (1.0 - x @ x)
    for remainder in ([1e-64, 0.0], [1e-18, -1e-20]):
        units = estimate_state_units(spiral, None, np.array(remainder), -0.5, (-1.0, 1.0))
        np.testing.assert_array_equal(units, 1.0)
    small = lambda u, x, r: u * evaluate_logistic(None, x / u, r)
    units = estimate_state_units(small, 1e-20, np.array([0.6e-20]), 2.5, (2.0, 3.5))
    assert 0.5e-20 < units[0] < 2e-20


def test_a_branch_along_a_conserved_quantity_names_the_multiplier_1():
    conserved = lambda _, x, p: jnp.stack([x[0], 0.5 * x[1] + p])
    branch = vrw.continue_map(conserved, [0.3, 0.2], 0.1, (0.0, 1.0))
    assert not branch.values.size
    assert "multiplier is 1, which a conserved quantity or a fold causes" in str(branch)


def test_a_fold_of_a_map_of_three_numbers_is_found():
    branch = vrw.continue_map(evaluate_stretched_map, [0.5, 1.0, 0.0], 0.25, (-1.0, 1.0))
    assert abs(special_points_by_kind(branch)["fold"]) < LOCATION_TOLERANCE


def test_a_zero_is_located_to_its_width_even_at_a_jump():
    kinds = (
        lambda x: x**3 - 0.3,
        lambda x: np.where(x < 0.777, -1.0, np.nan),  # no number counts to the side of 1
        lambda x: np.exp(5 * x) - 20,
    )
    functions = lambda x, which: np.array([kinds[k](y) for k, y in zip(which, x, strict=True)])
    every = np.arange(3)
    ends = np.array([-0.3, -1.0, -19.0]), np.array([0.7, 1e-3, 128.4])
    best, left_ends, right_ends = locate_function_roots(functions, ends, np.full(3, 1e-12))
    exact = np.array([0.3 ** (1 / 3), 0.777, np.log(20.0) / 5.0])
    np.testing.assert_allclose(best, exact, atol=1e-12)
    assert np.all(functions(left_ends, every) <= 0.0)
    assert not np.any(functions(right_ends, every) < 0.0)


# A model that is not ours: the simplest walking model (Garcia et al. 1998) ------------------------

MIDSTANCE = -0.05
"""Stance angle past which the swing foot is looked at: before, its feet scuff at mid-stance."""


def make_simplest_walker(options):
    """Map of (stance angle, its rate) just after heel strike; leg length and gravity are 1."""

    def field(slope):
        def rates(y):
            theta, phi, dtheta, dphi = y
            ddtheta = jnp.sin(theta - slope)
            swing = ddtheta + dtheta**2 * jnp.sin(phi) - jnp.cos(theta - slope) * jnp.sin(phi)
            return jnp.stack([dtheta, dphi, ddtheta, swing])

        return rates

    def walk(x, slope):
        theta, dtheta = x
        start = jnp.stack([theta, 2.0 * theta, dtheta, (1.0 - jnp.cos(2.0 * theta)) * dtheta])
        going = jnp.asarray(True)
        past = GuardsAndMargins(lambda y: jnp.stack([y[0] - MIDSTANCE]), 1)
        strike = GuardsAndMargins(lambda y: jnp.stack([2.0 * y[0] - y[1]]), 1)
        middle = integrate_phase(field(slope), past, start, going, options)
        end = integrate_phase(
            field(slope), strike, middle.state, middle.end_guard_index == 0, options
        )
        theta, _, dtheta, _ = end.state
        after = jnp.stack([-theta, jnp.cos(2.0 * theta) * dtheta])
        walk_result = (end.end_guard_index == 0) & (end.duration > 0.0)
        return jnp.where(walk_result, after, jnp.nan), middle.duration + end.duration

    return walk


WALKER_STEP = lanes.jit(make_simplest_walker(vrw.StepOptions.tight()))


def evaluate_walker_map(_, x, slope):
    return WALKER_STEP(x, slope)[0]


# docs/explanation/physics.md: section state, period, multipliers at slope 0.009.
STABLE_CYCLE = ((0.200310900544, -0.199832473005), 3.88246375285, -0.19009984107 + 0.55759877668j)
UNSTABLE_CYCLE = ((0.193937369810, -0.203866927442), 3.09610586808, (4.00386435893, 0.45958958980))


@pytest.fixture(scope="module")
def walker_branches():
    step = vrw.ArclengthOptions(max_ds=0.05, initial_ds=0.02)
    follow = lambda x: vrw.continue_map(
        evaluate_walker_map, x, 0.009, (0.004, 0.018), name="slope", options=step
    )
    return follow(STABLE_CYCLE[0]), follow(UNSTABLE_CYCLE[0])


def find_index_at_slope(branch, slope):
    return int(np.argmin(np.abs(branch.values - slope)))


def test_simplest_walker_has_the_published_fixed_points_and_multipliers(walker_branches):
    for branch, (x, period, _) in zip(walker_branches, (STABLE_CYCLE, UNSTABLE_CYCLE), strict=True):
        i = find_index_at_slope(branch, 0.009)
        assert branch.values[i] == 0.009
        np.testing.assert_allclose(branch.dataset.x.values[i], x, atol=LOCATION_TOLERANCE)
        assert abs(float(WALKER_STEP(jnp.asarray(x), 0.009)[1]) - period) < 1e-8
    stable, unstable = (b.multipliers[find_index_at_slope(b, 0.009)] for b in walker_branches)
    np.testing.assert_allclose(
        stable, [np.conj(STABLE_CYCLE[2]), STABLE_CYCLE[2]][::-1], atol=LOCATION_TOLERANCE
    )
    np.testing.assert_allclose(unstable, UNSTABLE_CYCLE[2], atol=LOCATION_TOLERANCE)


def test_simplest_walker_doubles_its_period_near_slope_0015(walker_branches):
    stable, unstable = walker_branches
    doubling = special_points_by_kind(stable)["period_doubling"]
    assert 0.0148 < doubling < 0.0154
    assert not unstable.stable.any()
    below = stable.values < doubling
    assert stable.stable[below].all()
    assert not stable.stable[~below].any()


# The wheel ----------------------------------------------------------------------------------------


BRANCH_WHEELS = vrw.WheelParams(
    damping=jnp.asarray([200.0, 150.0, 100.0]),
    natural_length=jnp.asarray([1.02, 1.03, 1.02]),
    slope=jnp.asarray([0.30, 0.28, 0.02]),  # the last does not walk
)


@pytest.fixture(scope="module")
def branches():
    return vrw.continue_branches(BRANCH_WHEELS, "damping", (4.0, 230.0))


@pytest.fixture(scope="module")
def branch(branches):
    return branches[0]


@pytest.fixture(scope="module")
def find_gait_at_damping(branch):
    """Return a function: the gait of Table 1's wheel at a damping, searched next to the branch."""
    guess = branch.special_points[-1].cycle

    def find(damping):
        params = vrw.WheelParams(damping=damping)
        return params, vrw.limit_cycle(params, guess=guess, options=vrw.CycleOptions.tight())

    return find


def special_points_by_name(branch):
    return {border.name: border for border in branch.special_points}


def test_the_branch_along_damping_ends_at_a_zero_of_an_indicator(branch):
    first, last = branch.special_points[0], branch.special_points[-1]
    assert (first.name, last.name) == ("lambda_2_plus", "lambda_4_plus")
    assert first.ends_branch
    assert last.ends_branch
    assert abs(first.value - 4.65) < 0.01
    assert abs(last.value - 219.85) < 0.01
    assert branch.values[0] - first.value < LOCATION_TOLERANCE
    assert last.value - branch.values[-1] < LOCATION_TOLERANCE
    assert branch.stable.all()


def test_every_gait_on_the_branch_repeats_in_a_walk(branch):
    assert branch.dataset.closure.max() < 1e-11


def test_scuffing_begins_between_100_and_120(branch, find_gait_at_damping):
    border = special_points_by_name(branch)["clearance_sls1"]
    assert 100.0 < border.value < 120.0
    for offset, scuffs in ((-1.0, True), (1.0, False)):
        params, gait = find_gait_at_damping(border.value + offset)
        clearance = vrw.step(params, gait.section_state, options=vrw.StepOptions.tight())
        assert (float(clearance.margins.clearance_sls1) < 0.0) == scuffs


def assert_same_points_in_random_bounds(branch, count):
    # Just below the scuffing border the foot dips so little that no step of a solver shows it.
    random = np.random.default_rng(19)
    ends = random.uniform(20.0, 100.0, count), random.uniform(115.0, 215.0, count)
    wheel = vrw.WheelParams(damping=110.0)
    cycle = vrw.limit_cycle(wheel)
    coarse = vrw.ArclengthOptions(initial_ds=0.011, max_ds=0.05)
    for i, (low, high) in enumerate(zip(*ends, strict=True)):
        options = coarse if i < 3 else None
        branch_result = vrw.continue_branch(
            wheel, "damping", (low, high), cycle=cycle, options=options
        )
        known_by_name = {b.name: b.value for b in branch.special_points if low < b.value < high}
        assert {b.name for b in branch_result.special_points} == set(known_by_name)
        for border in branch_result.special_points:
            assert abs(border.value / known_by_name[border.name] - 1.0) < LOCATION_TOLERANCE, (
                low,
                high,
                border,
            )


@pytest.mark.slow
def test_special_points_do_not_depend_on_bounds_or_continuation_step(branch):
    assert_same_points_in_random_bounds(branch, 8)


@pytest.mark.slow
def test_special_points_do_not_depend_on_any_of_a_hundred_bounds(branch):
    assert_same_points_in_random_bounds(branch, 100)


def test_each_special_point_is_located_to_1e_9(branch, find_gait_at_damping):
    def quantity(border, damping):
        """Return the test function of a special point at a damping; negative if the gait does not
        exist."""
        params, gait = find_gait_at_damping(damping)
        if not bool(gait.found):
            return -1.0
        result = vrw.step(params, gait.section_state, options=vrw.StepOptions.tight())
        return float(result.measures()[border.name])

    for border in branch.special_points:
        if border.name == "clearance_sls1":  # vanishes like a cube: see the test above
            continue
        below, above = (
            quantity(border, border.value + d) for d in (-LOCATION_TOLERANCE, LOCATION_TOLERANCE)
        )
        assert below * above < 0.0, border


def test_the_cycle_at_a_special_point_is_a_limit_cycle_of_the_wheel(branch):
    border = branch.special_points[-1]
    assert bool(border.cycle.found)
    assert 0.0 < float(border.cycle.indicators.lambda_4) < 1e-8
    np.testing.assert_allclose(
        border.cycle.multipliers, border.point.multipliers, atol=1e-9, rtol=0.0
    )


def test_a_branch_with_borders_survives_pickling(branch):
    """Its borders find the same gaits then."""
    again = pickle.loads(pickle.dumps(branch))
    assert str(again) == str(branch)
    assert again.dataset.identical(branch.dataset)
    one, other = branch.special_points[-1].cycle, again.special_points[-1].cycle
    np.testing.assert_array_equal(other.section_state, one.section_state)


def test_the_map_before_touchdown_and_after_impact_have_the_same_multipliers(find_gait_at_damping):
    options = vrw.StepOptions.tight()
    params, gait = find_gait_at_damping(200.0)
    # By all arguments, for which other tests have the machine code.
    _, before = jax.jacfwd(vrw.return_map, (0, 1))(params, gait.section_state, options=options)
    values = np.linalg.eigvals(np.asarray(before))
    values = values[np.argsort(-np.abs(values))]
    np.testing.assert_allclose(values[:2], gait.multipliers, atol=1e-9)
    assert abs(values[2]) < 1e-9
    assert abs(float(gait.spectral_radius) - RADIUS_AT_200) < 1e-8


def test_each_wheel_of_a_batch_has_its_own_branch(branches):
    walks, branch_without_gait = branches[1:]
    i = int(np.argmin(np.abs(walks.values - 150.0)))
    gait = vrw.limit_cycle(jax.tree.map(lambda x: jnp.broadcast_to(x, 3)[1], BRANCH_WHEELS))
    assert walks.values[i] == 150.0
    assert abs(walks.dataset.dls_fraction[i] - gait.dls_fraction) < 1e-8
    assert branch_without_gait.outcome == vrw.Outcome.NO_CYCLE_FOUND
    assert not branch_without_gait.values.size
    assert "none" in str(branch_without_gait)


@pytest.mark.slow
def test_the_mesh_of_a_branch_resolves_its_gaits_or_ends_the_branch():
    wheel = vrw.WheelParams(slope=0.13)  # towards the least slope double support lasts and lasts
    fixed = vrw.CycleOptions.tight()
    coarse = vrw.continue_branch(wheel, "slope", (0.11, 0.14), cycle_options=fixed)
    assert coarse.special_points[0].name == "mesh_too_coarse"
    assert coarse.ends[0].startswith("mesh too coarse at 0.1168")
    fine = vrw.continue_branch(wheel, "slope", (0.11, 0.14))
    assert fine.values[0] == 0.11
    assert "range" in fine.ends[0]


@pytest.mark.slow  # the search for gaits of two steps compiles for more than half a minute
def test_a_wheel_is_continued_beyond_a_period_doubling_by_gaits_of_two_steps():
    """Its steps then differ by the square root of the distance, until one has no double support."""
    wheel = vrw.WheelParams(damping=141.66)
    branch = vrw.continue_branch(wheel, "stiffness", (560.0, 580.0))
    (doubling,) = [x for x in branch.special_points if x.kind == "period_doubling"]
    doubled = vrw.continue_branch(wheel, "stiffness", (560.0, 580.0), switch_at=doubling)
    assert doubled.period_n == 2
    assert doubled.special_points[-1].name == "duration_dls"
    states, distances = doubled.section_states, doubled.values - doubling.value
    sizes = np.sum((states - np.asarray(doubling.cycle.section_state)) ** 2, 1)
    np.testing.assert_allclose(distances / sizes, distances[0] / sizes[0], rtol=0.01)
    assert 0.0 < distances[0] < 1e-3
    last = dataclasses.replace(wheel, stiffness=doubled.values[-1])
    gait = vrw.limit_cycle(last, period_n=2, guess=states[-1], options=vrw.CycleOptions.tight())
    np.testing.assert_allclose(gait.section_state, states[-1], atol=1e-9)
    once = vrw.return_map(last, states[-1])
    assert np.max(np.abs(np.asarray(once) - states[-1])) > 1e-4
    with pytest.raises(ValueError, match="a branch_point or a period_doubling"):
        vrw.continue_branch(wheel, "stiffness", (560.0, 580.0), switch_at=branch.special_points[0])


@pytest.mark.slow
def test_a_rigid_wheel_is_continued_with_its_own_step():
    branch = vrw.continue_branch(
        vrw.WheelParams(), "slope", (0.2, 0.35), model=vrw.RigidWheel(stop_at_lift_off=False)
    )
    s = vrw.WheelParams().symbols()
    inertia = float(8.0 * s.m * s.c0**2)
    total = float(s.Mt * s.L0**2)
    keep = (total * s.cos_alpha + inertia) / (total + inertia)
    np.testing.assert_allclose(branch.dataset.spectral_radius, keep**2, atol=1e-9)
    assert branch.values[[0, -1]].tolist() == [0.2, 0.35]
    assert len(branch_figure(branch).axes) == 4  # without indicators


def test_invalid_arguments_of_a_continuation_are_refused_in_one_sentence():
    with pytest.raises(ValueError, match=r"no parameter \(did you mean 'damping'\?\): choose from"):
        vrw.continue_branch(vrw.WheelParams(), "damp", (50.0, 100.0))
    with pytest.raises(ValueError, match="which holds nothing"):
        vrw.continue_branch(vrw.WheelParams(), "damping", (100.0, 50.0))
    with pytest.raises(ValueError, match=r"use vrw\.continue_branches"):
        vrw.continue_branch(vrw.WheelParams(damping=[1.0, 2.0]), "damping", (50.0, 100.0))


def test_a_branch_is_written_drawn_and_summarized(branch, tmp_path):
    assert_netcdf_round_trip(branch.dataset, tmp_path)
    assert len(branch_figure(branch).axes) == 4
    names = {path.name for path in write_branch_report(branch, tmp_path, FigureConfig())}
    assert names == {"branch.zarr", "borders.csv", "branch.md", "branch.svg", "branch.png"}
    assert "219.84768" in (tmp_path / "branch.md").read_text()
    assert "ends the branch" in branch._repr_html_()
