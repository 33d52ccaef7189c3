"""A gait that a walk reaches is found, whatever the wheel; what is found repeats when walked."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vrw_jax as vrw
from vrw_jax.gaits.reaching import MESH_ERROR

OFF_THE_BOX = vrw.WheelParams(
    damping=[224.5, 214.0, 119.3, 200.0],
    stiffness=[542.89, 1070.2, 1087.7, 500.0],
    natural_length=[1.0196, 1.0053, 1.0459, 1.02],
    slope=[0.1129, 0.1321, 0.091, 0.02],  # the last does not walk
)
DURATIONS = ((3.168, 0.099, 0.333), (0.503, 0.138, 1.319), (0.190, 0.025, 0.743))
"""Of their gaits by walking, of the third by a mesh four times as fine; s."""


@pytest.fixture(scope="module")
def cycles():
    return vrw.limit_cycles(OFF_THE_BOX)


def test_gaits_off_the_box_are_found_cold_on_a_mesh_as_fine_as_they_need(cycles):
    assert np.asarray(cycles.found).tolist() == [True, True, True, False]
    np.testing.assert_allclose(cycles.durations[:3], DURATIONS, atol=2e-3)
    assert np.all(cycles.mesh_error <= MESH_ERROR)
    assert cycles.problem.options.steps > vrw.CycleOptions().steps


def test_what_is_found_off_the_box_repeats_when_walked(cycles):
    walked = vrw.steps(OFF_THE_BOX, np.asarray(cycles.section_state), 1)
    missed = np.abs(np.asarray(walked.section_state - cycles.section_state))[:3]
    assert missed.max() < 1e-8


def test_a_search_under_vmap_is_alone_on_the_mesh_of_its_options():
    batch = jax.tree.map(lambda x: jnp.broadcast_to(x, 4), OFF_THE_BOX)
    alone = jax.vmap(vrw.limit_cycle)(batch)
    assert not np.any(alone.found)
    assert alone.problem.options == vrw.CycleOptions()


def test_a_gait_of_16_legs_is_walked_to():
    params = vrw.WheelParams(
        n_legs=16, damping=150.7, stiffness=1146.0, natural_length=1.0469, slope=0.1453
    )
    cycle = vrw.limit_cycle(params)
    assert int(cycle.outcome) == vrw.Outcome.STEPPED
    np.testing.assert_allclose(cycle.durations, (0.366, 0.0056, 0.0329), atol=1e-3)


def test_a_gait_that_rolls_from_double_support_into_double_support_is_walked_to():
    # Leg 1 is all but normal to the slope at touchdown: few walks begin that far down.
    params = vrw.WheelParams(
        n_legs=16, damping=24.445, stiffness=1185.05, natural_length=1.02303, slope=0.202537
    )
    cycle = vrw.limit_cycle(params)
    assert int(cycle.outcome) == vrw.Outcome.STEPPED
    np.testing.assert_allclose(cycle.durations, (0.22908, 0.00814, 0.02849), atol=1e-4)
    walked = vrw.steps(jax.tree.map(lambda x: x[None], params), cycle.section_state[None], 1)
    assert np.abs(walked.section_state[0] - cycle.section_state).max() < 1e-8


def test_what_a_finer_mesh_found_has_its_derivatives():
    period = lambda slope: vrw.limit_cycle(vrw.WheelParams(slope=slope)).period
    at, step = 0.12, 1e-6
    quotient = (period(at + step) - period(at - step)) / (2.0 * step)
    np.testing.assert_allclose(jax.jacfwd(period)(at), quotient, rtol=1e-6)


def test_a_gait_near_a_section_state_has_the_derivatives_of_the_one_found_cold():
    period = lambda params, guess: vrw.limit_cycle(params, guess=guess).period
    for transform in (jax.jacfwd, jax.grad):
        near, cold = (transform(period)(vrw.WheelParams(), x) for x in (vrw.paper_start(), None))
        # Newton's last correction, 1e-10, as a share of each.
        for one, other in zip(jax.tree.leaves(near), jax.tree.leaves(cold), strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-9)


ORBITS = vrw.WheelParams(damping=219.85)


@pytest.fixture(scope="module")
def points_of_ten():
    """Of an orbit in which one of ten steps has no double support."""
    x = vrw.steps(ORBITS, np.asarray([[0.1, 1.6, -0.1]]), 600).section_state
    points = [np.asarray(x[0])]
    for _ in range(9):
        points.append(np.asarray(vrw.steps(ORBITS, points[-1][None]).section_state[0]))
    return points


def test_an_orbit_of_ten_steps_is_found_from_each_of_its_points_and_begins_there(points_of_ten):
    # The start may lie on either side of the step without double support.
    for point in points_of_ten:
        cycle = vrw.limit_cycle(ORBITS, guess=point, period_n=10)
        assert int(cycle.outcome) == vrw.Outcome.STEPPED
        assert np.max(np.abs(point - cycle.section_state)) < 1e-7
        assert np.sum(np.asarray(cycle.durations)[:, 0] == 0.0) == 1


def test_on_a_finer_mesh_that_orbit_is_found_from_each_point_under_vmap_too(points_of_ten):
    options = vrw.CycleOptions.tight()
    find = lambda x: vrw.limit_cycle(ORBITS, guess=x, period_n=10, options=options)
    cycles = jax.vmap(find)(np.stack(points_of_ten))
    assert np.all(np.asarray(cycles.outcome) == vrw.Outcome.STEPPED)
    assert np.abs(cycles.section_state - np.stack(points_of_ten)).max() < 1e-7
