"""The chosen model is the simplest one with nonnegative margins for each lane, with its reason."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vrw_jax as vrw
from vrw_jax.models import SELECTION_MARGIN_NAMES
from vrw_jax.models.ladder import ModelCode, describe_selection_reason

START = (0.1, 1.6, -0.1)


def test_the_papers_model_is_chosen_at_sufficient_friction():
    choice = vrw.choose_model(vrw.WheelParams(), START, friction=50.0)
    assert int(choice.model_code) == ModelCode.VISCOELASTIC
    assert isinstance(choice.model, vrw.ViscoelasticWheel)
    assert "all its margins are positive" in choice.why


def test_the_unilateral_model_is_chosen_with_a_reason_at_low_friction():
    choice = vrw.choose_model(vrw.WheelParams(), START, friction=0.7)
    assert int(choice.model_code) == ModelCode.UNILATERAL
    assert isinstance(choice.model, vrw.UnilateralWheel)
    assert "slide" in choice.why


def test_a_step_outside_the_papers_sequence_uses_the_unilateral_model():
    choice = vrw.choose_model(vrw.WheelParams(), (0.1, 2.5, -0.1), friction=1e3)
    assert int(choice.model_code) == ModelCode.UNILATERAL
    assert int(choice.reason_code) == -vrw.Outcome.TOUCHDOWN_BEFORE_STOPPER


FAST_START = (0.1, 2.0, -0.1)
HIGH_FRICTION = 50.0
"""Friction that holds the feet of the paper's gait at Table 1 and not those of faster wheels."""


@pytest.fixture(scope="module")
def ladder_steps():
    """Return steps of lanes that differ in damping and friction, all in one batch."""
    damping = jnp.asarray([200.0, 50.0, 200.0, 150.0])
    friction = jnp.asarray([HIGH_FRICTION, HIGH_FRICTION, 0.7, math.inf])

    def one(c, mu):
        return vrw.step(vrw.WheelParams(damping=c), START, model=vrw.LadderWheel(friction=mu))

    return damping, friction, jax.jit(jax.vmap(one))(damping, friction)


def test_each_batch_element_has_its_own_model_and_reason(ladder_steps):
    *_, step = ladder_steps
    reasons = [describe_selection_reason(code) for code in step.choice.reason_code.tolist()]
    assert step.choice.why.tolist() == reasons
    assert step.choice.model_code.tolist() == [
        ModelCode.VISCOELASTIC,
        ModelCode.UNILATERAL,
        ModelCode.UNILATERAL,
        ModelCode.VISCOELASTIC,
    ]
    rows = [describe_selection_reason(int(reason)) for reason in step.choice.reason_code]
    assert ["all its margins are positive" in text for text in rows] == [True, False, False, True]
    assert "scuffs" in rows[1]
    assert SELECTION_MARGIN_NAMES[int(step.choice.reason_code[1]) - 1] == "clearance_sls1"
    assert "slide" in rows[2]


def test_a_step_of_the_ladder_equals_that_of_the_chosen_model(ladder_steps):
    damping, friction, step = ladder_steps
    n = vrw.WheelParams().n_legs
    for i, rung in enumerate(step.choice.model_code.tolist()):
        params = vrw.WheelParams(damping=damping[i])
        if rung == ModelCode.VISCOELASTIC:
            step_result = vrw.step(params, START)
            x = step.section_state[i, jnp.asarray([0, 1, 4 + n])]
            impact_loss = step_result.energy.landing + step_result.energy.stopper
        else:
            ground = vrw.UnilateralWheel(
                friction=friction[i], infinite_friction_rule="paper"
            )  # it is finite
            step_result = vrw.step(params, START, model=ground)
            x, impact_loss = step.section_state[i], step_result.energy_impacts
        np.testing.assert_allclose(x, step_result.section_state, atol=1e-12)
        np.testing.assert_allclose(step.period[i], step_result.period, atol=1e-12)
        np.testing.assert_allclose(step.dls_fraction[i], step_result.dls_fraction, atol=1e-12)
        np.testing.assert_allclose(step.energy_impacts[i], impact_loss, atol=1e-10)


def test_an_element_of_the_papers_model_costs_no_unilateral_steps(ladder_steps):
    damping, _, step = ladder_steps
    for i in (0, 3):
        step_result = vrw.step(vrw.WheelParams(damping=damping[i]), START)
        assert int(step.solver_steps[i]) == int(step_result.solver_steps)


@pytest.mark.slow
def test_a_walk_returns_to_the_papers_model_when_its_margins_hold_again():
    # A start too fast for the paper's sequence, on ground that holds every foot.
    walk = vrw.walk(vrw.WheelParams(), FAST_START, 12, model=vrw.LadderWheel(friction=math.inf))
    assert int(walk.outcome) == vrw.Outcome.STEPPED
    assert int(walk.steps.model_code[0]) == ModelCode.UNILATERAL
    assert int(walk.steps.reason_code[0]) == -vrw.Outcome.TOUCHDOWN_BEFORE_STOPPER
    assert int(walk.steps.model_code[-1]) == ModelCode.VISCOELASTIC
    paper = vrw.limit_cycle(vrw.WheelParams())
    np.testing.assert_allclose(walk.steps.section_state[-1, :2], paper.section_state[:2], atol=1e-4)


def test_a_batch_of_steps_has_one_model():
    starts = np.tile(vrw.paper_start(), (2, 1))
    with pytest.raises(ValueError, match="a batch of steps has one"):
        vrw.step_batch(vrw.WheelParams(), starts, model=vrw.LadderWheel())
