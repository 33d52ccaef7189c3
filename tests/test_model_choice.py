"""The lowest rung whose premises hold, lane by lane, with its reason."""

import jax
import jax.numpy as jnp

import vrw_jax as vrw
from vrw_jax.model_choice import PREMISES, UNILATERAL, VISCOELASTIC

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


def test_scuffing_is_named_lane_by_lane():
    damping = jnp.asarray([50.0, 200.0])
    choose = lambda c: vrw.choose_model(vrw.WheelParams(damping=c), START, friction=1e3)
    choice = jax.jit(jax.vmap(choose))(damping)
    assert choice.rung.tolist() == [UNILATERAL, VISCOELASTIC]
    assert list(PREMISES)[int(choice.reason[0]) - 1] == "clearance_sls1"


def test_a_step_outside_the_papers_sequence_goes_up_the_ladder():
    choice = vrw.choose_model(vrw.WheelParams(), (0.1, 2.5, -0.1), friction=1e3)
    assert int(choice.rung) == UNILATERAL
    assert int(choice.reason) == -vrw.Outcome.TOUCHDOWN_BEFORE_STOPPER
