"""Batches with unilateral contact: derivatives of their ends."""

import numpy as np
import pytest

import vrw_jax as vrw

WHEEL_PARAMETERS = {
    "damping": np.array([120.0, 150.0, 200.0]),
    "slope": np.array([0.3, 0.31, 0.32]),
}
FRICTION = np.array([0.7, 0.9, 0.8])
STARTS = np.tile(vrw.paper_start(), (3, 1))
TIGHT_OPTIONS = vrw.StepOptions(rtol=1e-11, atol=1e-11)
N_STEPS = 2


def walk_batch(wheels=WHEEL_PARAMETERS, friction=FRICTION, states=STARTS, **requested):
    model = vrw.UnilateralWheel(friction=friction)
    params = vrw.WheelParams(**wheels)
    return vrw.step_batch(params, states, N_STEPS, model=model, options=TIGHT_OPTIONS, **requested)


def concat_end_values(walks_with_derivatives):
    return np.concatenate(
        [walks_with_derivatives.section_state[:, :4], walks_with_derivatives.durations], 1
    )


@pytest.fixture(scope="module")
def walks_with_derivatives():
    return walk_batch(derivatives=("friction", "section_state", "slope", "damping"))


@pytest.mark.parametrize("name", ["damping", "slope", "friction"])
def test_derivatives_of_a_walk_by_parameters_equal_difference_quotients(
    walks_with_derivatives, name
):
    # The step of differences: 1e-6 of a number, whose square is below what steps' 1e-11 leave.
    def at(factor):
        shifted_by_name = {
            key: x * (factor if key == name else 1.0) for key, x in WHEEL_PARAMETERS.items()
        }
        return concat_end_values(
            walk_batch(shifted_by_name, FRICTION * (factor if name == "friction" else 1.0))
        )

    value = FRICTION if name == "friction" else WHEEL_PARAMETERS[name]
    differences = (at(1.0 + 1e-6) - at(1.0 - 1e-6)) / (2e-6 * value[:, None])
    by_input = walks_with_derivatives.derivatives[name]
    joined_values = np.concatenate([by_input.section_state[:, :4], by_input.durations], 1)
    assert (np.asarray(walks_with_derivatives.outcome) == vrw.Outcome.STEPPED).all()
    assert np.abs(joined_values - differences).max() < 1e-4 * max(np.abs(differences).max(), 1.0)
    assert np.abs(differences).max() > 1e-4  # something moves at all


def test_derivatives_of_a_walk_by_its_start_equal_difference_quotients(walks_with_derivatives):
    states = np.asarray(walk_batch().section_state)  # full: legs and codes, too
    sensitivities = walk_batch(states=states, derivatives="section_state").derivatives[
        "section_state"
    ]
    for place in range(4):
        shifted_rows = [states.copy(), states.copy()]
        for sign, x in zip((1.0, -1.0), shifted_rows, strict=True):
            x[:, place] += sign * 1e-6
        plus, minus = (concat_end_values(walk_batch(states=x)) for x in shifted_rows)
        joined_values = np.concatenate(
            [sensitivities.section_state[:, :4, place], sensitivities.durations[..., place]], 1
        )
        assert np.abs(joined_values - (plus - minus) / 2e-6).max() < 1e-4 * max(
            np.abs(joined_values).max(), 1.0
        )


def test_fields_have_their_documented_shapes(walks_with_derivatives):
    by_input = walks_with_derivatives.derivatives
    size = walks_with_derivatives.section_state.shape[1]
    assert list(by_input) == ["friction", "section_state", "slope", "damping"]
    assert by_input["section_state"].section_state.shape == (3, size, size)
    assert by_input["friction"].durations.shape == (3, 3)


def test_a_falling_batch_element_is_zero_and_leaves_the_others_unchanged(walks_with_derivatives):
    backward = STARTS.copy()
    backward[1, 1] = -1.0
    requested = ("friction", "section_state", "slope", "damping")
    fallen = walk_batch(states=backward, derivatives=requested)
    assert fallen.outcome[1] != vrw.Outcome.STEPPED
    for name in requested:
        mine, sensitivity_without_fall = (
            fallen.derivatives[name],
            walks_with_derivatives.derivatives[name],
        )
        assert not np.any(mine.section_state[1])
        assert not np.any(mine.durations[1])
        assert np.array_equal(mine.section_state[0], sensitivity_without_fall.section_state[0])


def test_arguments_are_not_modified():
    states = np.array(walk_batch().section_state)
    before = states.copy()
    walk_batch(states=states, derivatives=("section_state",))
    np.testing.assert_array_equal(states, before)
