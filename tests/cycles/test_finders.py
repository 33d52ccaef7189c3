"""One face for gaits: two independent finders tell the same gait, one table names what it tells."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vrw_jax as vrw
from vrw_jax.cycles import MEASURED, confirmed, finder_of
from vrw_jax.cycles.by_walking import SectionFinder
from vrw_jax.cycles.finder import AGREEMENT
from vrw_jax.models import AbstractWheel
from vrw_jax.results import MEASURES
from vrw_jax.wheel import FRICTION, PARAMETER_NAMES

RUNGS = (vrw.RigidWheel(), vrw.ViscoelasticWheel(), vrw.UnilateralWheel(), vrw.LadderWheel())
TABLE_1 = vrw.WheelParams()


@pytest.fixture(scope="module")
def both() -> tuple[vrw.LimitCycle, vrw.WalkedCycle]:
    """Table 1's gait by collocation, and by Newton's method on the event-driven step."""
    collocated = vrw.limit_cycle(TABLE_1, options=vrw.CycleOptions.tight())
    walking = SectionFinder(vrw.ViscoelasticWheel(), 8, vrw.Options.tight())
    return collocated, walking.cycle(TABLE_1, collocated)


@pytest.mark.parametrize("name", [name for name in MEASURED if name != "takeoff_acceleration"])
def test_two_finders_tell_the_same_gait(both, name):
    collocated, walked = both
    # Errors of tight options; a double zero of the third multiplier costs nothing here.
    np.testing.assert_allclose(walked.measure(name), collocated.measure(name), rtol=1e-9, atol=1e-9)


def test_a_cycle_tells_what_the_step_from_it_tells(both):
    collocated, _ = both
    step = vrw.step(TABLE_1, collocated.section_state, options=vrw.Options.tight()).measures()
    shared = [name for name in MEASURED if name in step]
    assert {"dL1_touchdown", "duration_sls2", "lambda_4_plus", "theta_post_impact"} <= {*shared}
    for name in shared:
        np.testing.assert_allclose(collocated.measure(name), step[name], rtol=1e-9, atol=1e-9)


def test_the_two_margins_of_stability_are_two_quantities(both):
    collocated, _ = both
    radius = np.max(np.abs(np.linalg.eigvals(np.asarray(collocated.matrix))))
    assert float(collocated.spectral_margin) == pytest.approx(1.0 - radius, abs=1e-12)
    least = float(jnp.min(collocated.jury_margins))
    # The smooth minimum lies at most log(number of margins) / 50 below.
    assert least - np.log(3.0) / 50.0 <= float(collocated.stability_margin) <= least
    assert abs(float(collocated.stability_margin - collocated.spectral_margin)) > 0.01


@pytest.mark.parametrize("model", RUNGS, ids=lambda model: model.rung)
def test_every_rung_has_a_finder_whose_measures_stand_in_the_table(model: AbstractWheel):
    finder = finder_of(model, 8)
    assert set(finder.usual) <= set(finder.differentiable) <= set(finder.readable)
    assert set(finder.readable) <= set(MEASURES)
    assert not [name for name in finder.differentiable if MEASURES[name].axis]


@pytest.mark.parametrize("model", RUNGS, ids=lambda model: model.rung)
def test_a_rung_and_its_numbers_are_each_other_s_inverse(model: AbstractWheel):
    feels = model.parameter_names == (*PARAMETER_NAMES, FRICTION)
    assert feels or model.parameter_names == PARAMETER_NAMES
    values = model.values(TABLE_1)
    assert values.shape == (9 + feels,)
    changed = values.at[6].set(150.0)
    there, wheel = model.at(changed, 8)
    assert float(wheel.damping) == 150.0
    np.testing.assert_array_equal(there.values(wheel), changed)
    if feels:
        ground, _ = model.moved(TABLE_1, FRICTION, jnp.asarray(1.25))
        assert float(ground.friction) == 1.25


def test_a_cycle_counts_only_where_the_step_from_it_ends_on_it():
    outcome = vrw.Outcome
    found, lost, fell = outcome.STEPPED, outcome.NO_CYCLE_FOUND, outcome.FELL_BACK
    coarse = outcome.MESH_TOO_COARSE
    state = np.zeros((4, 3))
    reached = state + np.array([0.0, 0.9, 1.1, 0.0])[:, None] * AGREEMENT
    told = confirmed([found, found, found, lost], state, [found, found, found, fell], reached)
    assert list(told) == [found, found, coarse, lost]
    assert confirmed(found, state[0], fell, reached[0]) == fell


@pytest.mark.slow
def test_two_finders_differentiate_the_same_gait_alike():
    """By the implicit function theorem on nodes, and through the step: first derivatives."""
    names = ("dls_fraction", "period", "speed", "lambda_4_plus", "dtheta_touchdown")
    paper = finder_of(None, 8, cycle_options=vrw.CycleOptions.tight())
    walking = SectionFinder(vrw.ViscoelasticWheel(), 8, vrw.Options.tight())
    values = paper.model.values(TABLE_1)
    guess = vrw.limit_cycle(TABLE_1).section_state
    one = jax.jit(lambda v: jnp.stack(list(paper.cycle_of(v).measures(names).values())))
    expected = paper.measured(values, None, names)
    found = walking.measured(values, guess, names)
    np.testing.assert_allclose(expected.values, one(values), rtol=1e-12)
    scale = np.max(np.abs(np.asarray(expected.slopes)), axis=-1, keepdims=True)
    np.testing.assert_allclose(found.slopes / scale, expected.slopes / scale, rtol=0, atol=1e-7)
