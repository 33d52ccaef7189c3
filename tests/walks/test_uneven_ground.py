"""A floor whose slope and friction differ from step to step: another code, energy, plain calls."""

import jax.numpy as jnp
import numpy as np
import pytest
from oracle import complementarity

import vrw_jax as vrw
from vrw_jax.contact.mechanics import find_slots, slot_friction
from vrw_jax.contact.section import pack_section_state, unpack_section_state

START = (0.1, 1.6, -0.1)
SLOPES, FRICTIONS = (0.3, 0.33, 0.27, 0.31), (0.7, 0.5, 0.9, 0.6)


def make_uneven_ground(slopes=SLOPES, frictions=FRICTIONS):
    model = vrw.UnilateralWheel(friction=jnp.asarray(frictions))
    return vrw.WheelParams(slope=jnp.asarray(slopes)), model


def test_each_foot_keeps_the_friction_of_its_landing():
    params, model = make_uneven_ground()
    slope, friction, others, tilt = model.split_ground(params, 4)
    np.testing.assert_allclose(slope, SLOPES)
    np.testing.assert_allclose(friction, FRICTIONS)
    np.testing.assert_allclose(others, (0.7, 0.7, 0.5, 0.9))
    np.testing.assert_allclose(tilt, (0.03, -0.06, 0.04, 0.0), atol=1e-15)
    both_values, rear = find_slots(jnp.arange(8) < 2), find_slots(jnp.arange(8) == 1)
    assert [float(x) for x in slot_friction((0.7, 0.5), both_values)] == [0.7, 0.5]
    assert [float(x) for x in slot_friction((0.7, 0.5), rear)] == [0.5, 0.5]


def test_a_landing_on_a_steeper_line_is_the_same_motion_in_another_frame():
    s, model = vrw.WheelParams().symbols(), vrw.UnilateralWheel()
    x = model.embed_section(vrw.WheelParams(), jnp.asarray(START))
    motion, stance = unpack_section_state(s, x)
    result, turned = (
        pack_section_state(motion, stance),
        pack_section_state(motion, stance, jnp.asarray(0.05)),
    )
    assert abs(float(result[0] - turned[0]) - 0.05) < 1e-15
    np.testing.assert_allclose(turned[4:], result[4:])
    frame = np.array([[np.cos(0.05), -np.sin(0.05)], [np.sin(0.05), np.cos(0.05)]])
    np.testing.assert_allclose(turned[2:4], frame @ np.asarray(result[2:4]), atol=1e-15)


def test_arrays_not_over_steps_are_refused_like_batches():
    params, model = make_uneven_ground()
    with pytest.raises(ValueError, match="one wheel"):
        vrw.walk(params, START, 3, model=model)
    with pytest.raises(ValueError, match="one wheel"):
        vrw.walk(params, START, 4)  # the paper's rung: roles do not ask for it


@pytest.mark.slow
def test_a_walk_over_uneven_ground_agrees_with_another_code():
    params, model = make_uneven_ground()
    walk = vrw.walk(params, START, 4, model=model, options=vrw.StepOptions.tight())
    place = None
    for k in range(4):
        rough = np.r_[FRICTIONS[k], np.full(7, FRICTIONS[max(k - 1, 0)])]
        tilt = SLOPES[min(k + 1, 3)] - SLOPES[k]
        wheel = complementarity.ComplementarityWheel(rough, slope=SLOPES[k], tilt=tilt)
        place = place or complementarity.paper_start(wheel, *START)
        other = complementarity.compute_step(wheel, place)
        place = other.end
        assert int(walk.steps.outcome[k]) == vrw.Outcome.STEPPED
        np.testing.assert_allclose(walk.steps.durations[k], other.durations, atol=1e-9)
    theta = place.q[2] + complementarity.ALPHA
    assert abs(float(walk.steps.section_state[-1, 0]) - theta) < 1e-9
    level = vrw.walk(vrw.WheelParams(), START, 4, model=vrw.UnilateralWheel())
    assert abs(float(jnp.sum(level.steps.durations - walk.steps.durations))) > 1e-3


UNEVEN_SLOPES = 0.3 + 0.02 * np.array([[0.0, 1.0, -1.0], [1.0, -1.0, 2.0], [-2.0, 0.5, 0.0]])
UNEVEN_FRICTIONS = np.array([[0.7, 0.5, 0.9], [0.6, 0.8, 0.7], [1.0, 0.6, 0.6]])
START_STATES = np.tile((0.1, 1.6, -0.1), (3, 1))


@pytest.mark.slow
def test_a_batch_on_uneven_ground_equals_single_wheels():
    damping = np.array([250.0, 270.0, 300.0])
    params, ground = vrw.WheelParams(damping=damping, slope=UNEVEN_SLOPES), vrw.UnilateralWheel
    batch_result = vrw.step_batch(params, START_STATES, 3, model=ground(friction=UNEVEN_FRICTIONS))
    assert batch_result.n_stepped.tolist() == [3, 3, 3]
    for i, (c, slope, friction) in enumerate(
        zip(damping, UNEVEN_SLOPES, UNEVEN_FRICTIONS, strict=True)
    ):
        one = vrw.WheelParams(damping=c, slope=slope)
        walk = vrw.walk(one, START_STATES[i], 3, model=ground(friction=friction))
        # The same program for many and for one; XLA sums in another order.
        np.testing.assert_allclose(batch_result.durations[i], walk.steps.durations[-1], atol=1e-11)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"n_steps": 4}, r"slope has shape \(3, 3\), but there are 3 states and 4 steps: give one"),
        ({"params": vrw.WheelParams(damping=[1.0, 2.0])}, r"damping has shape \(2,\), but there"),
        ({"derivatives": ("slope",)}, "without derivatives: leave engine and derivatives out"),
        ({"engine": "lanes"}, "needs vrw.UnilateralWheel and 'diffrax'"),
        ({"model": None}, "needs vrw.UnilateralWheel and 'diffrax'"),
    ],
)
def test_uneven_ground_unsupported_by_batches_is_refused_in_one_sentence(changes, sentence):
    given = {
        "params": vrw.WheelParams(slope=UNEVEN_SLOPES),
        "n_steps": 3,
        "model": vrw.UnilateralWheel(friction=UNEVEN_FRICTIONS),
    }
    with pytest.raises(ValueError, match=sentence):
        vrw.step_batch(states=START_STATES, **given | changes)
