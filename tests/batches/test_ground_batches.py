"""Batches on real ground: what their ends move with."""

import numpy as np
import pytest

import vrw_jax as vrw

WHEELS = {"damping": np.array([120.0, 150.0, 200.0]), "slope": np.array([0.3, 0.31, 0.32])}
FRICTION = np.array([0.7, 0.9, 0.8])
STARTS = np.tile(vrw.paper_start(), (3, 1))
TIGHT = vrw.Options(rtol=1e-11, atol=1e-11)
N_STEPS = 2


def walked(wheels=WHEELS, friction=FRICTION, states=STARTS, **asked):
    model = vrw.UnilateralWheel(friction=friction)
    params = vrw.WheelParams(**wheels)
    return vrw.steps(params, states, N_STEPS, model=model, options=TIGHT, **asked)


def ends(found):
    return np.concatenate([found.section_state[:, :4], found.durations], 1)


@pytest.fixture(scope="module")
def found():
    return walked(derivatives=("friction", "section_state", "slope", "damping"))


@pytest.mark.parametrize("name", ["damping", "slope", "friction"])
def test_the_end_of_a_walk_moves_with_its_parameters_as_differences_do(found, name):
    # The step of differences: 1e-6 of a number, whose square is below what steps' 1e-11 leave.
    def at(factor):
        moved = {key: x * (factor if key == name else 1.0) for key, x in WHEELS.items()}
        return ends(walked(moved, FRICTION * (factor if name == "friction" else 1.0)))

    value = FRICTION if name == "friction" else WHEELS[name]
    differences = (at(1.0 + 1e-6) - at(1.0 - 1e-6)) / (2e-6 * value[:, None])
    by = found.derivatives[name]
    told = np.concatenate([by.section_state[:, :4], by.durations], 1)
    assert (np.asarray(found.outcome) == vrw.Outcome.STEPPED).all()
    assert np.abs(told - differences).max() < 1e-4 * max(np.abs(differences).max(), 1.0)
    assert np.abs(differences).max() > 1e-4  # something moves at all


def test_the_end_of_a_walk_moves_with_its_start_as_differences_do(found):
    states = np.asarray(walked().section_state)  # full: legs and codes, too
    again = walked(states=states, derivatives="section_state").derivatives["section_state"]
    for place in range(4):
        moved = [states.copy(), states.copy()]
        for sign, x in zip((1.0, -1.0), moved, strict=True):
            x[:, place] += sign * 1e-6
        plus, minus = (ends(walked(states=x)) for x in moved)
        told = np.concatenate([again.section_state[:, :4, place], again.durations[..., place]], 1)
        assert np.abs(told - (plus - minus) / 2e-6).max() < 1e-4 * max(np.abs(told).max(), 1.0)


def test_fields_have_the_shapes_that_they_say(found):
    by = found.derivatives
    size = found.section_state.shape[1]
    assert list(by) == ["friction", "section_state", "slope", "damping"]
    assert by["section_state"].section_state.shape == (3, size, size)
    assert by["friction"].durations.shape == (3, 3)


def test_a_lane_that_falls_has_zeros_and_its_neighbours_do_not_notice(found):
    backward = STARTS.copy()
    backward[1, 1] = -1.0
    asked = ("friction", "section_state", "slope", "damping")
    fallen = walked(states=backward, derivatives=asked)
    assert fallen.outcome[1] != vrw.Outcome.STEPPED
    for name in asked:
        mine, whole = fallen.derivatives[name], found.derivatives[name]
        assert not np.any(mine.section_state[1])
        assert not np.any(mine.durations[1])
        assert np.array_equal(mine.section_state[0], whole.section_state[0])


def test_what_was_given_is_left_as_it_was():
    states = np.array(walked().section_state)
    before = states.copy()
    walked(states=states, derivatives=("section_state",))
    np.testing.assert_array_equal(states, before)
