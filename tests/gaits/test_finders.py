"""Two independent finders return the same gait, and one table names its measures."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.slow_variants import mark_slow

import vrw_jax as vrw
from vrw_jax.gaits import (
    CYCLE_MEASURE_FUNCTIONS,
    STATE_AGREEMENT_TOLERANCE,
    confirm_outcome_by_step,
    make_finder,
)
from vrw_jax.gaits.wheel_finders import ReturnMapFinder
from vrw_jax.models import MEASURES, AbstractWheel
from vrw_jax.wheel import FRICTION_NAME, PARAMETER_NAMES

MODELS = (vrw.RigidWheel(), vrw.ViscoelasticWheel(), vrw.UnilateralWheel(), vrw.LadderWheel())
TABLE_1 = vrw.WheelParams()
WHEEL_AXES = eqx.tree_at(
    lambda w: w.slope, jax.tree.map(lambda _: None, TABLE_1), 0, is_leaf=lambda x: x is None
)


@pytest.fixture(scope="module")
def finders_of_both_kinds() -> tuple[vrw.LimitCycle, vrw.ReturnMapCycle]:
    """Return Table 1's gait by collocation, and by Newton's method on the event-driven step."""
    collocated = vrw.limit_cycle(TABLE_1, options=vrw.CycleOptions.tight())
    walking = ReturnMapFinder(vrw.ViscoelasticWheel(), 8, vrw.StepOptions.tight())
    return collocated, walking.find_cycle(TABLE_1, collocated)


@pytest.mark.parametrize(
    "name", [name for name in CYCLE_MEASURE_FUNCTIONS if name in ReturnMapFinder.cycle_measures]
)
def test_two_finders_find_the_same_gait(finders_of_both_kinds, name):
    collocated, walk_result = finders_of_both_kinds
    # Errors of tight options; a double zero of the third multiplier costs nothing here.
    np.testing.assert_allclose(
        walk_result.measure(name), collocated.measure(name), rtol=1e-9, atol=1e-9
    )


def test_a_cycle_has_the_measures_of_the_step_from_it(finders_of_both_kinds):
    collocated, _ = finders_of_both_kinds
    step = vrw.step(TABLE_1, collocated.section_state, options=vrw.StepOptions.tight()).measures()
    shared = [name for name in CYCLE_MEASURE_FUNCTIONS if name in step]
    assert {"dL1_touchdown", "duration_sls2", "lambda_4_plus", "theta_post_impact"} <= {*shared}
    for name in shared:
        np.testing.assert_allclose(collocated.measure(name), step[name], rtol=1e-9, atol=1e-9)


def test_the_two_margins_of_stability_are_two_quantities(finders_of_both_kinds):
    collocated, _ = finders_of_both_kinds
    radius = np.max(np.abs(np.linalg.eigvals(np.asarray(collocated.monodromy_value))))
    assert float(collocated.spectral_margin) == pytest.approx(1.0 - radius, abs=1e-12)
    minimum = float(jnp.min(collocated.jury_margins))
    # The smooth minimum lies at most log(number of margins) / 50 below.
    assert minimum - np.log(3.0) / 50.0 <= float(collocated.stability_margin) <= minimum
    assert abs(float(collocated.stability_margin - collocated.spectral_margin)) > 0.01


@pytest.mark.parametrize("model", MODELS, ids=lambda model: model.model_name)
def test_every_model_has_a_finder_whose_measures_are_in_the_table(model: AbstractWheel):
    finder = make_finder(model, 8)
    assert (
        set(finder.default_measures)
        <= set(finder.differentiable_measures)
        <= set(finder.readable_measures)
    )
    assert set(finder.readable_measures) <= set(MEASURES)
    assert not [name for name in finder.differentiable_measures if MEASURES[name].leg_dimension]


@pytest.mark.parametrize("model", MODELS, ids=lambda model: model.model_name)
def test_values_and_from_values_of_a_model_are_inverse_to_each_other(model: AbstractWheel):
    feels = model.parameter_names == (*PARAMETER_NAMES, FRICTION_NAME)
    assert feels or model.parameter_names == PARAMETER_NAMES
    values = model.collect_parameter_values(TABLE_1)
    assert values.shape == (9 + feels,)
    changed = values.at[6].set(150.0)
    restored_model, wheel = model.from_parameter_values(changed, 8)
    assert float(wheel.damping) == 150.0
    np.testing.assert_array_equal(restored_model.collect_parameter_values(wheel), changed)
    if feels:
        ground, _ = model.with_parameter(TABLE_1, FRICTION_NAME, jnp.asarray(1.25))
        assert float(ground.friction) == 1.25


@pytest.mark.parametrize("period_n", mark_slow(2, 1))
def test_a_gait_of_one_step_asked_for_as_one_of_several_says_what_it_is(period_n):
    """A rigid wheel's steps all contract towards one: it has gaits of one step alone."""
    model, wheel, start = (
        vrw.RigidWheel(held_landing=True),
        vrw.WheelParams(slope=0.1),
        (0.39, 1.5),
    )
    find = lambda wheel: vrw.limit_cycle(wheel, model=model, guess=[*start, 0.0], period_n=period_n)
    gait, lost = find(wheel), find(vrw.WheelParams(slope=0.0))
    assert bool(gait.found)
    assert int(gait.minimal_period) == 1
    assert ("its minimal period is 1" in str(gait)) == (period_n > 1)
    assert (bool(lost.found), int(lost.minimal_period)) == (False, 0)
    if period_n == 1:  # A gait that was not found is no guess.
        assert bool(vrw.limit_cycle(wheel, model=model, guess=lost).found)


@pytest.mark.slow
def test_minimal_periods_of_several_wheels_are_found_under_vmap():
    slopes = vrw.WheelParams(slope=jnp.array([0.0, 0.1]))
    search = lambda params: vrw.limit_cycle(
        params, model=vrw.RigidWheel(held_landing=True), guess=[0.39, 1.5, 0.0], period_n=2
    )
    every = jax.vmap(search, in_axes=(WHEEL_AXES,))(slopes)
    np.testing.assert_array_equal(every.minimal_period, [0, 1])


@pytest.mark.slow
def test_a_cycle_of_two_steps_has_two_as_its_minimal_period():
    """The ends of its steps differ; made up from a gait of one step."""
    model, wheel = vrw.RigidWheel(held_landing=True), vrw.WheelParams(slope=0.1)
    gait = vrw.limit_cycle(wheel, model=model, guess=[0.39, 1.5, 0.0], period_n=2)
    place = lambda cycle: cycle.steps.section_state
    shift = 1e-5 * jnp.array([[1.0], [-1.0]])
    assert int(eqx.tree_at(place, gait, place(gait) + shift).minimal_period) == 2


def test_a_cycle_is_confirmed_only_if_the_step_from_it_returns_to_it():
    outcome = vrw.Outcome
    stepped, no_cycle, fell = outcome.STEPPED, outcome.NO_CYCLE_FOUND, outcome.FELL_BACK
    coarse = outcome.MESH_TOO_COARSE
    state = np.zeros((4, 3))
    reached = state + np.array([0.0, 0.9, 1.1, 0.0])[:, None] * STATE_AGREEMENT_TOLERANCE
    result = confirm_outcome_by_step(
        [stepped, stepped, stepped, no_cycle],
        state,
        [stepped, stepped, stepped, fell],
        reached,
    )
    assert list(result) == [stepped, stepped, coarse, no_cycle]
    assert confirm_outcome_by_step(stepped, state[0], fell, reached[0]) == fell


@pytest.mark.slow
def test_two_finders_agree_on_the_derivatives_of_a_gait():
    """By the implicit function theorem on nodes, and through the step: first derivatives."""
    names = ("dls_fraction", "period", "speed", "lambda_4_plus", "dtheta_touchdown")
    paper = make_finder(None, 8, cycle_options=vrw.CycleOptions.tight())
    walking = ReturnMapFinder(vrw.ViscoelasticWheel(), 8, vrw.StepOptions.tight())
    values = paper.model.collect_parameter_values(TABLE_1)
    guess = vrw.limit_cycle(TABLE_1).section_state
    one = jax.jit(
        lambda v: jnp.stack(list(paper.find_cycle_from_values(v).measures(names).values()))
    )
    expected = paper.measure_gait(values, None, names)
    solution = walking.measure_gait(values, guess, names)
    np.testing.assert_allclose(expected.measure_values, one(values), rtol=1e-12)
    scale = np.max(np.abs(np.asarray(expected.parameter_jacobian)), axis=-1, keepdims=True)
    np.testing.assert_allclose(
        solution.parameter_jacobian / scale, expected.parameter_jacobian / scale, rtol=0, atol=1e-7
    )
