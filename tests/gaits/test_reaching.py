"""The library finds each gait that a walk reaches, and a found gait repeats when it walks."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.slow_variants import mark_slow

import vrw_jax as vrw
from vrw_jax.gaits import further_search, gait_walks
from vrw_jax.gaits.further_search import MAX_UNREFINED_MESH_ERROR

WHEELS_OUTSIDE_BOX = vrw.WheelParams(
    damping=[224.5, 214.0, 119.3, 200.0],
    stiffness=[542.89, 1070.2, 1087.7, 500.0],
    natural_length=[1.0196, 1.0053, 1.0459, 1.02],
    slope=[0.1129, 0.1321, 0.091, 0.02],  # the last does not walk
)
REFERENCE_DURATIONS = ((3.168, 0.099, 0.333), (0.503, 0.138, 1.319), (0.190, 0.025, 0.743))
"""Of their gaits by walking, of the third by a mesh four times as fine; s."""


@pytest.fixture(scope="module")
def cycles():
    return vrw.limit_cycles(WHEELS_OUTSIDE_BOX)


@pytest.fixture(scope="module")
def random_wheels():
    """Return 40 random wheels, and three whose first and second search fail in different ways."""
    draw = np.random.default_rng(0).uniform
    box = {"damping": (50, 500), "stiffness": (200, 1200),
           "natural_length": (1.005, 1.06), "slope": (0.05, 0.5)}  # fmt: skip
    # The search fails in another way from the end of a failed search than from the surface.
    sensitive_wheels = ((61.298753, 621.911278, 1.021835, 0.341081),
                        (116.866774, 227.505349, 1.025182, 0.283469),
                        (378.067076, 820.319112, 1.005704, 0.127455))  # fmt: skip
    return {
        name: np.append(draw(*ends, 40), [wheel[i] for wheel in sensitive_wheels])
        for i, (name, ends) in enumerate(box.items())
    }


@pytest.fixture(scope="module")
def cycles_under_vmap(random_wheels):
    """Return the results of one program under vmap for `random_wheels` and `WHEELS_OUTSIDE_BOX`."""
    joined = {
        name: np.append(values, getattr(WHEELS_OUTSIDE_BOX, name))
        for name, values in random_wheels.items()
    }
    return jax.vmap(vrw.limit_cycle)(broadcast_wheels(joined))


def broadcast_wheels(values):
    """Return wheels all of whose parameters have the batch axis."""
    n_wheels = len(values["damping"])
    return jax.tree.map(lambda x: jnp.broadcast_to(x, n_wheels), vrw.WheelParams(**values))


def test_gaits_outside_the_fitted_box_are_found_on_a_refined_mesh(cycles):
    assert np.asarray(cycles.found).tolist() == [True, True, True, False]
    np.testing.assert_allclose(cycles.durations[:3], REFERENCE_DURATIONS, atol=2e-3)
    assert np.all(cycles.mesh_error <= MAX_UNREFINED_MESH_ERROR)
    assert cycles.system.cycle_options.mesh_intervals > vrw.CycleOptions().mesh_intervals


def test_gaits_outside_the_fitted_box_repeat_in_a_walk(cycles):
    batch_result = vrw.step_batch(WHEELS_OUTSIDE_BOX, np.asarray(cycles.section_state), 1)
    missed = np.abs(np.asarray(batch_result.section_state - cycles.section_state))[:3]
    assert missed.max() < 1e-8


def test_a_search_under_vmap_finds_gaits_outside_the_fitted_box_too(cycles, cycles_under_vmap):
    last = jax.tree.map(lambda x: x[-4:], cycles_under_vmap)
    np.testing.assert_array_equal(last.outcome, cycles.outcome)
    # A mesh error of 1e-5 is allowed there, a hundred times as much as outside of vmap.
    np.testing.assert_allclose(last.section_state, cycles.section_state, atol=1e-7)


def test_a_search_under_vmap_keeps_the_mesh_of_its_options():
    find = functools.partial(vrw.limit_cycle, options=vrw.CycleOptions())
    wheels = jax.tree.map(lambda x: jnp.broadcast_to(x, 4), WHEELS_OUTSIDE_BOX)
    assert not np.any(jax.vmap(find)(wheels).found)


def test_a_wheel_has_the_same_outcome_whichever_function_searches(random_wheels, cycles_under_vmap):
    wheels = broadcast_wheels(random_wheels)
    cycles = vrw.limit_cycles(wheels)
    outcomes = np.asarray(cycles.outcome)
    np.testing.assert_array_equal(outcomes, np.asarray(cycles_under_vmap.outcome)[:43])
    scanned = vrw.scan(vrw.samples(**random_wheels), ["period"]).outcome.values
    np.testing.assert_array_equal(outcomes, scanned)
    for i in (40, 41, 42):
        alone = vrw.limit_cycle(jax.tree.map(lambda x, i=i: x[i], wheels))
        assert int(alone.outcome) == outcomes[i]
        assert alone.ending == take_wheel(cycles, i).ending


def take_wheel(cycles, i):
    return jax.tree.map(lambda x: x[i], cycles)


@pytest.mark.slow
def test_a_walk_reaches_a_gait_of_16_legs():
    params = vrw.WheelParams(
        n_legs=16, damping=150.7, stiffness=1146.0, natural_length=1.0469, slope=0.1453
    )
    cycle = vrw.limit_cycle(params)
    assert int(cycle.outcome) == vrw.Outcome.STEPPED
    np.testing.assert_allclose(cycle.durations, (0.366, 0.0056, 0.0329), atol=1e-3)


@pytest.mark.slow
def test_a_walk_reaches_a_gait_with_very_short_single_support():
    # Leg 1 is all but normal to the slope at touchdown: few walks begin that far down.
    params = vrw.WheelParams(
        n_legs=16, damping=24.445, stiffness=1185.05, natural_length=1.02303, slope=0.202537
    )
    cycle = vrw.limit_cycle(params)
    assert int(cycle.outcome) == vrw.Outcome.STEPPED
    np.testing.assert_allclose(cycle.durations, (0.22908, 0.00814, 0.02849), atol=1e-4)
    batch_result = vrw.step_batch(
        jax.tree.map(lambda x: x[None], params), cycle.section_state[None], 1
    )
    assert np.abs(batch_result.section_state[0] - cycle.section_state).max() < 1e-8


@pytest.mark.slow
@pytest.mark.parametrize(
    ("n_legs", "damping", "stiffness", "natural_length", "slope", "state"),
    [(5, 36.09, 845.4, 1.0281, 0.1435, (0.5661, 2.2441, 0.2098))],
)  # fmt: skip
def test_gaits_of_few_legs_that_only_fast_walks_reach_are_found(
    n_legs, damping, stiffness, natural_length, slope, state
):
    """The states are the ends of walks of 200 steps from a grid of starts."""
    params = vrw.WheelParams(
        n_legs=n_legs, damping=damping, stiffness=stiffness, natural_length=natural_length,
        slope=slope,
    )  # fmt: skip
    cycle = vrw.limit_cycle(params)
    assert int(cycle.outcome) == vrw.Outcome.STEPPED
    np.testing.assert_allclose(cycle.section_state, state, atol=1e-4)
    # On the first mesh the search from the walk finds a cycle that the mesh does not resolve.
    from_walk = vrw.limit_cycle(params, guess=jnp.asarray(state))
    assert int(from_walk.outcome) == vrw.Outcome.STEPPED
    np.testing.assert_allclose(from_walk.section_state, cycle.section_state, atol=1e-8)


@pytest.mark.slow
def test_gaits_of_a_finer_mesh_have_accurate_derivatives():
    period = lambda slope: vrw.limit_cycle(vrw.WheelParams(slope=slope)).period
    slope, step = 0.12, 1e-6
    quotient = (period(slope + step) - period(slope - step)) / (2.0 * step)
    np.testing.assert_allclose(jax.jacfwd(period)(slope), quotient, rtol=1e-6)


@pytest.mark.slow
def test_a_gait_near_a_section_state_has_the_derivatives_of_the_one_found_cold():
    period = lambda params, guess: vrw.limit_cycle(params, guess=guess).period
    for transform in (jax.jacfwd, jax.grad):
        near, cold = (transform(period)(vrw.WheelParams(), x) for x in (vrw.paper_start(), None))
        # Newton's last correction, 1e-10, as a share of each.
        for one, other in zip(jax.tree.leaves(near), jax.tree.leaves(cold), strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-9)


ORBIT_WHEEL = vrw.WheelParams(damping=219.85)


@pytest.fixture(scope="module")
def ten_step_orbit_points():
    """Return the points of an orbit in which one of ten steps has no double support."""
    x = vrw.step_batch(ORBIT_WHEEL, np.asarray([[0.1, 1.6, -0.1]]), 600).section_state
    points = [np.asarray(x[0])]
    for _ in range(9):
        points.append(np.asarray(vrw.step_batch(ORBIT_WHEEL, points[-1][None]).section_state[0]))
    return points


@pytest.mark.parametrize("points", mark_slow(slice(0, 2), slice(2, 10)), ids=["two", "others"])
def test_a_ten_step_orbit_is_found_from_each_of_its_points_and_starts_there(
    ten_step_orbit_points, points
):
    # The start may lie on either side of the step without double support.
    for point in ten_step_orbit_points[points]:
        cycle = vrw.limit_cycle(ORBIT_WHEEL, guess=point, period_n=10)
        assert int(cycle.outcome) == vrw.Outcome.STEPPED
        assert np.max(np.abs(point - cycle.section_state)) < 1e-7
        assert np.sum(np.asarray(cycle.durations)[:, 0] == 0.0) == 1


@pytest.mark.slow
def test_under_vmap_a_finer_mesh_finds_that_orbit_from_each_point(ten_step_orbit_points):
    options = vrw.CycleOptions.tight()
    find = lambda x: vrw.limit_cycle(ORBIT_WHEEL, guess=x, period_n=10, options=options)
    cycles = jax.vmap(find)(np.stack(ten_step_orbit_points))
    assert np.all(np.asarray(cycles.outcome) == vrw.Outcome.STEPPED)
    assert np.abs(cycles.section_state - np.stack(ten_step_orbit_points)).max() < 1e-7


@pytest.mark.parametrize(
    "model",
    [None, *mark_slow(vrw.UnilateralWheel(), vrw.RigidWheel())],
    ids=lambda m: type(m).__name__,
)
def test_a_batch_of_no_wheels_has_no_cycles(model):
    empty = vrw.WheelParams(damping=np.zeros(0))
    result = vrw.limit_cycles(empty, model=model)
    one = vrw.limit_cycles(vrw.WheelParams(damping=np.full(1, np.nan)), model=model)
    assert jax.tree.structure(result) == jax.tree.structure(one)
    shapes = [leaf.shape for leaf in jax.tree.leaves(result)]
    assert shapes == [(0, *leaf.shape[1:]) for leaf in jax.tree.leaves(one)]
    assert result.found.shape == (0,)


def test_vmap_over_no_wheels_has_no_cycles():
    empty = vrw.WheelParams(damping=np.zeros(0))
    assert jax.vmap(vrw.limit_cycle, in_axes=(empty.in_axes,))(empty).found.shape == (0,)


@pytest.mark.parametrize("leg_mass", [1e-4, 1e-6, 1e-8])
def test_a_search_takes_no_walks_by_an_implicit_solver(leg_mass, monkeypatch):
    """Such walks take minutes. The search ends with a code instead; a call of None would fail."""
    for module in (further_search, gait_walks):
        monkeypatch.setattr(module, "step_batch", None)
    cycle = vrw.limit_cycle(vrw.WheelParams(leg_mass=leg_mass))
    assert vrw.Outcome(int(cycle.outcome)) in further_search.RETRY_OUTCOMES
