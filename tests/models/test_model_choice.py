"""The lowest rung whose premises hold, lane by lane, with its reason."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vrw_jax as vrw
from vrw_jax.models.ladder import PREMISES, UNILATERAL, VISCOELASTIC, told_why

START = (0.1, 1.6, -0.1)


def test_ground_that_holds_every_foot_leaves_the_papers_wheel():
    choice = vrw.choose_model(vrw.WheelParams(), START, friction=50.0)
    assert int(choice.rung) == VISCOELASTIC
    assert isinstance(choice.model, vrw.ViscoelasticWheel)
    assert "premises hold" in choice.why


def test_real_ground_needs_the_unilateral_wheel_and_says_why():
    choice = vrw.choose_model(vrw.WheelParams(), START, friction=0.7)
    assert int(choice.rung) == UNILATERAL
    assert isinstance(choice.model, vrw.UnilateralWheel)
    assert "slide" in choice.why


def test_a_step_outside_the_papers_sequence_goes_up_the_ladder():
    choice = vrw.choose_model(vrw.WheelParams(), (0.1, 2.5, -0.1), friction=1e3)
    assert int(choice.rung) == UNILATERAL
    assert int(choice.reason) == -vrw.Outcome.TOUCHDOWN_BEFORE_STOPPER


FAST = (0.1, 2.0, -0.1)
GROUND = 50.0
"""Friction that holds the feet of the paper's gait at Table 1 and not those of faster wheels."""


@pytest.fixture(scope="module")
def stepped():
    """Lanes that differ in damping and friction, all steps at once."""
    damping = jnp.asarray([200.0, 50.0, 200.0, 150.0])
    friction = jnp.asarray([GROUND, GROUND, 0.7, math.inf])

    def one(c, mu):
        return vrw.step(vrw.WheelParams(damping=c), START, model=vrw.LadderWheel(friction=mu))

    return damping, friction, jax.jit(jax.vmap(one))(damping, friction)


def test_each_lane_is_served_by_its_own_rung_and_says_why(stepped):
    *_, step = stepped
    assert step.choice.rung.tolist() == [VISCOELASTIC, UNILATERAL, UNILATERAL, VISCOELASTIC]
    told = [told_why(int(reason)) for reason in step.choice.reason]
    assert ["premises hold" in text for text in told] == [True, False, False, True]
    assert "scuffs" in told[1]
    assert list(PREMISES)[int(step.choice.reason[1]) - 1] == "clearance_sls1"
    assert "slide" in told[2]


def test_a_served_step_is_the_rungs_own_step(stepped):
    damping, friction, step = stepped
    n = vrw.WheelParams().n_legs
    for i, rung in enumerate(step.choice.rung.tolist()):
        params = vrw.WheelParams(damping=damping[i])
        if rung == VISCOELASTIC:
            own = vrw.step(params, START)
            x = step.section_state[i, jnp.asarray([0, 1, 4 + n])]
            lost = own.energy.landing + own.energy.stopper
        else:
            ground = vrw.UnilateralWheel(friction=friction[i], infinite="paper")  # it is finite
            own = vrw.step(params, START, model=ground)
            x, lost = step.section_state[i], own.energy_impacts
        np.testing.assert_allclose(x, own.section_state, atol=1e-12)
        np.testing.assert_allclose(step.period[i], own.period, atol=1e-12)
        np.testing.assert_allclose(step.dls_fraction[i], own.dls_fraction, atol=1e-12)
        np.testing.assert_allclose(step.energy_impacts[i], lost, atol=1e-10)


def test_a_lane_that_the_papers_wheel_serves_does_no_work_on_the_upper_rung(stepped):
    damping, _, step = stepped
    for i in (0, 3):
        own = vrw.step(vrw.WheelParams(damping=damping[i]), START)
        assert int(step.solver_steps[i]) == int(own.solver_steps)


@pytest.mark.slow
def test_a_walk_comes_down_the_ladder_when_its_premises_hold_again():
    # A start too fast for the paper's sequence, on ground that holds every foot.
    walk = vrw.walk(vrw.WheelParams(), FAST, 12, model=vrw.LadderWheel(friction=math.inf))
    assert int(walk.outcome) == vrw.Outcome.STEPPED
    assert int(walk.steps.rung[0]) == UNILATERAL
    assert int(walk.steps.reason[0]) == -vrw.Outcome.TOUCHDOWN_BEFORE_STOPPER
    assert int(walk.steps.rung[-1]) == VISCOELASTIC
    paper = vrw.limit_cycle(vrw.WheelParams())
    np.testing.assert_allclose(walk.steps.section_state[-1, :2], paper.section_state[:2], atol=1e-4)
