"""Ground of given heights: an independent absolute frame, slopes between heights, bad input."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reference_code import complementarity, uneven_ground
from reference_code.five_coordinates import TABLE_1
from support.slow_variants import ENGINES, mark_slow

import vrw_jax as vrw
from vrw_jax.base import compute_arcsine

START, TIGHT = (0.1, 1.6, -0.1), vrw.StepOptions.tight()
WHEEL, OTHER = vrw.WheelParams(damping=150.0), {**TABLE_1, "damping": 150.0}
HEIGHTS = (0.004, -0.003, 0.006, -0.002, 0.001, -0.006, 0.003)
"""Heights of seven footholds, m: the one before the walk, and those of a walk of five steps."""
RIGID, CONTACT = vrw.RigidWheel(), vrw.UnilateralWheel(friction=0.7)


@pytest.mark.parametrize("engine", ENGINES)
def test_five_steps_over_heights_are_those_in_an_absolute_frame(engine):
    walk = vrw.walk(WHEEL, START, 5, heights=HEIGHTS, options=TIGHT, engine=engine)
    other = uneven_ground.walk_over_heights(OTHER, START, 0.3, HEIGHTS)
    assert int(walk.n_stepped) == len(other) == 5
    for name in ("durations", "section_state"):
        reference = np.stack([getattr(step, name) for step in other])
        np.testing.assert_allclose(getattr(walk.steps, name), reference, atol=1e-12)


def end_walk(inputs):
    """Return the last state and durations for a start, a mean slope and heights."""
    wheel = vrw.WheelParams(damping=150.0, slope=inputs[3])
    last = vrw.walk(wheel, inputs[:3], 2, heights=inputs[4:], options=TIGHT).steps
    return jnp.concatenate([last.section_state[-1], last.durations[-1]])


def test_derivatives_by_heights_are_differences_of_an_absolute_frame():
    def other(inputs):
        last = uneven_ground.walk_over_heights(OTHER, inputs[:3], inputs[3], inputs[4:])[-1]
        return np.concatenate([last.section_state, last.durations])

    point = np.array([*START, 0.3, *HEIGHTS[:4]])
    forward = jax.jacfwd(end_walk)(jnp.asarray(point))
    # A wrong derivative with respect to any input changes the derivative along a random direction.
    for direction in np.random.default_rng(0).standard_normal((3, len(point))):
        h = 1e-5  # Values have errors of 1e-13, and differences errors near 1e-8.
        difference = (other(point + h * direction) - other(point - h * direction)) / (2 * h)
        np.testing.assert_allclose(forward @ direction, difference, rtol=1e-6, atol=1e-7)


@pytest.mark.slow
def test_reverse_mode_by_heights_gives_the_derivatives_of_forward_mode():
    point = jnp.array([*START, 0.3, *HEIGHTS[:4]])
    np.testing.assert_allclose(jax.jacrev(end_walk)(point), jax.jacfwd(end_walk)(point), atol=1e-11)


@pytest.mark.parametrize("model", [None, RIGID, *mark_slow(CONTACT)])
def test_a_walk_over_heights_is_the_walk_over_the_slopes_of_its_lines(model):
    params = vrw.WheelParams(damping=150.0, slope=0.3 if model is None else 0.2)
    places = vrw.simulate(params, START, 5, heights=HEIGHTS, model=model, options=TIGHT)
    slopes = places.attrs["slopes"]
    assert places.attrs["n_steps"] == 5
    assert len(slopes) == 6
    steps = vrw.walk(params, START, 5, heights=HEIGHTS, model=model, options=TIGHT).steps
    on_slopes = vrw.WheelParams(damping=150.0, slope=slopes)
    same = vrw.walk(on_slopes, START, 5, model=model, options=TIGHT).steps
    # Slopes between heights are rounded, and some durations follow from differences of forces.
    np.testing.assert_allclose(steps.section_state, same.section_state, atol=1e-12)
    np.testing.assert_allclose(steps.durations, same.durations, atol=1e-11)


def test_feet_stand_at_the_given_heights_above_the_mean_line():
    places = vrw.simulate(WHEEL, START, 5, heights=HEIGHTS, options=TIGHT)
    feet = [places.foot_1_z.values[places.step.values == k] for k in range(5)]
    np.testing.assert_allclose(feet, np.repeat([HEIGHTS[1:6]], 300, 0).T)
    x = np.array([places.foot_1_x.values[places.step.values == k][0] for k in range(5)])
    rises, lengths = np.diff(HEIGHTS[1:6]), np.diff(x)
    np.testing.assert_allclose(places.attrs["slopes"][1:5], 0.3 - np.arctan2(rises, lengths))


@pytest.mark.slow
def test_steps_with_unilateral_contact_over_heights_are_those_of_complementarity():
    """The second formulation walks over the lines that join the footholds of the first one."""
    model = vrw.UnilateralWheel(friction=0.7)
    choices = {"heights": HEIGHTS[:5], "model": model, "options": TIGHT}
    places = vrw.simulate(vrw.WheelParams(), START, 3, **choices)
    walk = vrw.walk(vrw.WheelParams(), START, 3, **choices)
    end, slopes = None, places.attrs["slopes"]
    for k in range(3):
        tilt = slopes[k + 1] - slopes[k]
        wheel = complementarity.ComplementarityWheel(np.full(8, 0.7), slope=slopes[k], tilt=tilt)
        end = end or complementarity.paper_start(wheel, *START)
        step = complementarity.compute_step(wheel, end)
        end = step.end
        np.testing.assert_allclose(walk.steps.durations[k], step.durations, atol=1e-9)
        assert abs(float(walk.steps.section_state[k, 0]) - end.q[2] - complementarity.ALPHA) < 1e-9
    hub, legs = walk.steps.section_state[-1, :1], walk.steps.section_state[-1, 4:12]
    theta, fore, landing = float(hub[0]), float(legs[0]), float(legs[-1])
    alpha = complementarity.ALPHA
    distance = np.sqrt(fore**2 + landing**2 - 2.0 * fore * landing * np.cos(alpha))
    assert abs(fore * np.cos(theta) - landing * np.cos(theta - alpha)) < 1e-12
    rise = HEIGHTS[4] - HEIGHTS[3]
    assert abs(distance * np.sin(0.3 - slopes[3]) - rise) < 1e-12


@pytest.mark.parametrize("n_heights", [4, *mark_slow(5)])
@pytest.mark.parametrize("model", [None, *mark_slow(RIGID, CONTACT)])
def test_a_batch_over_heights_walks_as_wheels_do_one_by_one(model, n_heights):
    n, damping = 3, np.array([130.0, 170.0])
    heights = 0.005 * np.random.default_rng(1).standard_normal((2, n_heights))
    asked = "heights", "slope"
    found = vrw.step_batch(
        vrw.WheelParams(damping=damping), np.tile(START, (2, 1)), n, model=model,
        heights=heights, derivatives=asked, options=TIGHT,
    )  # fmt: skip
    assert found.n_stepped.tolist() == [n] * 2

    def one(heights, slope):
        wheel = vrw.WheelParams(damping=damping[i], slope=slope)
        walk = vrw.walk(wheel, START, n, heights=heights, model=model, options=TIGHT)
        return walk.steps.section_state[-1]

    for i in range(2):
        args = jnp.asarray(heights[i]), 0.3
        # The footholds of a batch and of a walk may be located in different rounding.
        np.testing.assert_allclose(found.section_state[i], one(*args), atol=1e-12)
        for name, reference in zip(asked, jax.jacfwd(one, (0, 1))(*args), strict=True):
            own = found.derivatives[name].section_state[i]
            np.testing.assert_allclose(own, reference, atol=1e-11)


def test_a_foothold_that_no_foot_can_reach_ends_one_walk_and_not_its_batch():
    heights = np.zeros((3, 4))
    heights[0, 1], heights[1, 1] = 5.0, np.nan
    found = vrw.step_batch(WHEEL, np.tile(START, (3, 1)), 3, heights=heights)
    assert found.outcome[0] != vrw.Outcome.STEPPED
    assert found.outcome[1:].tolist() == [vrw.Outcome.BAD_INPUT, vrw.Outcome.STEPPED]
    assert np.all(np.isfinite(found.section_state))
    for model in (None, RIGID):  # No feet are 5 m apart.
        walk = vrw.walk(
            WHEEL, START, 5, heights=(0.0, 5.0, *HEIGHTS[2:]), model=model, options=TIGHT
        )
        assert int(walk.outcome) == vrw.Outcome.BAD_INPUT


@pytest.mark.parametrize(
    ("call", "sentence"),
    [
        (lambda: vrw.walk(WHEEL, START, 3, heights=np.zeros(3)), r"takes 4 heights of footholds"),
        (lambda: vrw.simulate(WHEEL, START, 3, heights=np.zeros((2, 4))), r"takes 4 heights"),
        (
            lambda: vrw.walk(vrw.WheelParams(slope=np.full(3, 0.3)), START, 3, heights=np.zeros(4)),
            "heights are given and slope is an array",
        ),
        (lambda: vrw.walk(WHEEL, START, 3, heights=np.zeros(4), model="auto"), "on even ground"),
        (
            lambda: vrw.step_batch(WHEEL, np.tile(START, (2, 1)), 3, heights=np.zeros(4)),
            r"heights have shape \(4,\), but there are 2 states and 3 steps",
        ),
    ],
)
def test_bad_heights_are_one_sentence(call, sentence):
    with pytest.raises(ValueError, match=sentence):
        call()


def test_the_arcsine_is_accurate_to_round_off():
    sine = np.concatenate([np.linspace(-0.999, 0.999, 2001), [-1.0, 1.0, 1e-300]])
    # Near 1, the angle is ill-conditioned: its error is that of the sine over the cosine.
    error = np.abs(np.asarray(compute_arcsine(jnp.asarray(sine))) - np.arcsin(sine))
    assert np.all(error[:2001] < 4e-16 / np.sqrt(1.0 - sine[:2001] ** 2))
    np.testing.assert_allclose(compute_arcsine(jnp.asarray(sine[2001:])), np.arcsin(sine[2001:]))
    derivative = jax.vmap(jax.grad(compute_arcsine))(jnp.asarray(sine))
    np.testing.assert_allclose(derivative[:2001], 1.0 / np.sqrt(1.0 - sine[:2001] ** 2))
    assert np.all(derivative[2001:2003] == 0.0)
