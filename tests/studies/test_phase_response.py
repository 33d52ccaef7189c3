"""Pushes within a step: their response, against walks and simulations that are pushed."""

import jax.numpy as jnp
import numpy as np
import pytest
from support.walkers import (
    BALL_SYSTEM,
    GRAVITY,
    LOGISTIC_A,
    LOGISTIC_BALL,
    LOGISTIC_CYCLE,
    RIMLESS_WHEEL,
    SIMPLEST_WALKER,
)

import vrw_jax as vrw

TIGHT = vrw.StepOptions.tight()
N_STEPS = 40  # after which the pushed walkers are on their gaits up to round-off


@pytest.fixture(scope="module")
def wheel_response():
    return vrw.phase_response(vrw.WheelParams(), n_samples=3)


def finish_and_walk(params, phase_index, foot_distance, state):
    """Return the time of each landing after a state within a step."""
    model = vrw.ViscoelasticWheel()
    rest = model.finish_step(params, phase_index, foot_distance, jnp.asarray(state), TIGHT)
    walk = vrw.walk(params, rest.section_state, N_STEPS, options=TIGHT)
    durations = np.sum(np.asarray(walk.steps.durations), -1)
    first = float(np.sum(np.asarray(rest.durations)))
    return first + np.concatenate([[0.0], np.cumsum(durations)])


@pytest.mark.slow
@pytest.mark.parametrize("instant", [1, 3, 4, 7])  # in double support, at a take-off, in SLS-I, -II
def test_a_pushed_wheel_lands_as_much_earlier_as_its_response_says(wheel_response, instant):
    """By central differences of walks: their error is the square of the push."""
    params, push = vrw.WheelParams(), 1e-4
    gait = vrw.limit_cycle(params, options=vrw.CycleOptions.tight())
    distance = vrw.step(params, gait.section_state, options=TIGHT).step_length
    phase_index = int(wheel_response.phase_indices[instant])
    for coordinate in (3, 4):  # dtheta, and the rate of Leg 1
        times = []
        for sign in (1.0, -1.0):
            state = wheel_response.states[instant].copy()
            state[coordinate] += sign * push
            times.append(finish_and_walk(params, phase_index, distance, state))
        delays = (times[0] - times[1]) / (2.0 * push)
        assert abs(delays[-1] - wheel_response.delay[instant, coordinate]) < 2e-6
        expected = wheel_response.measures["period"][:, instant, coordinate]
        np.testing.assert_allclose(np.diff(delays)[:3], expected, atol=2e-6)
    # In double support the feet stay, so that the angular velocity determines the rates of legs.
    assert (wheel_response.delay[instant, 4] == 0.0) == (phase_index == 0)


def test_a_push_along_the_flow_is_a_shift_in_time_on_both_sides_of_an_impact():
    """A rimless wheel whose speed follows from its energy, pushed at all instants of a step."""
    params = {"slope": 0.2}
    gait = vrw.limit_cycle(params, model=RIMLESS_WHEEL, options=TIGHT)
    response = vrw.phase_response(params, model=RIMLESS_WHEEL, cycle=gait, n_samples=5)
    angle, rate = response.states.T
    flow = np.stack([rate, 9.81 * np.sin(angle)], 1)
    np.testing.assert_allclose(np.sum(response.delay * flow, 1), -1.0, atol=1e-9)
    # A push that keeps the energy moves the wheel along its orbit, without another effect.
    np.testing.assert_allclose(
        np.einsum("kidn,id->kin", response.section_states, flow), 0.0, atol=1e-9
    )
    assert (response.phase_advance[:, 1] > 0.0).all()


@pytest.mark.slow
def test_a_pushed_simplest_walker_strikes_as_much_earlier_as_its_response_says():
    params, push = {"slope": 0.009}, 1e-6
    gait = vrw.limit_cycle(params, model=SIMPLEST_WALKER, guess=[0.2, -0.2], options=TIGHT)
    response = vrw.phase_response(params, model=SIMPLEST_WALKER, cycle=gait, n_samples=4)
    instant, n_strikes = 1, 60
    unpushed = SIMPLEST_WALKER.simulate(
        params, response.states[instant], events=n_strikes, options=TIGHT
    )
    for coordinate in range(4):
        times = []
        for sign in (1.0, -1.0):
            state = response.states[instant].copy()
            state[coordinate] += sign * push
            pushed = SIMPLEST_WALKER.simulate(params, state, events=n_strikes, options=TIGHT)
            times.append(np.asarray(pushed.times))
        assert pushed.n_events == unpushed.n_events == n_strikes
        delays = (times[0] - times[1]) / (2.0 * push)
        assert abs(delays[-1] - response.delay[instant, coordinate]) < 1e-5
        periods = np.diff(delays)[:3]
        np.testing.assert_allclose(
            periods, response.measures["period"][:, instant, coordinate], atol=1e-5
        )
    flow = SIMPLEST_WALKER.modes["swing"].field(jnp.asarray(response.states[instant]), params)
    # A push along the flow is a shift in time.
    assert response.delay[instant] @ np.asarray(flow) == pytest.approx(-1.0, abs=1e-8)


def test_a_gait_of_two_steps_has_the_closed_form_of_its_response():
    """A push changes the impact speed s by ds, and the steps after it by a (1 - 2 s) ds, ..."""
    params = {"a": LOGISTIC_A}
    gait = vrw.limit_cycle(params, model=LOGISTIC_BALL, guess=[0.5], period_n=2, options=TIGHT)
    np.testing.assert_allclose(gait.section_state, LOGISTIC_CYCLE[:1], rtol=1e-9)
    response = vrw.phase_response(params, model=LOGISTIC_BALL, cycle=gait, n_samples=3)
    assert response.period == pytest.approx(2.0 * LOGISTIC_CYCLE.sum() / GRAVITY, rel=1e-10)
    assert response.step_indices.tolist() == [0, 0, 0, 1, 1, 1]
    height, velocity = response.states.T
    speed = np.sqrt(velocity**2 + 2.0 * GRAVITY * height)
    by_state = np.stack([GRAVITY / speed, velocity / speed], 1)
    remaining = by_state / GRAVITY + np.stack([0.0 * speed, 0.0 * speed + 1.0 / GRAVITY], 1)
    slopes = LOGISTIC_A * (1.0 - 2.0 * LOGISTIC_CYCLE)
    adjoints = 2.0 / GRAVITY * (1.0 + slopes) / (1.0 - slopes.prod())
    own = np.repeat(slopes, 3)[:, None] * by_state  # at the end of this step
    other = np.repeat(slopes[::-1], 3)[:, None]
    np.testing.assert_allclose(response.section_states[0, ..., 0], own, rtol=1e-6)
    np.testing.assert_allclose(response.section_states[1, ..., 0], other * own, rtol=1e-6)
    periods = 2.0 / GRAVITY * own
    np.testing.assert_allclose(response.measures["period"][0], periods, rtol=1e-6)
    delay = remaining + np.repeat(adjoints[::-1], 3)[:, None] * own
    np.testing.assert_allclose(response.delay, delay, rtol=1e-6)


@pytest.mark.slow
def test_legs_in_turn_have_the_responses_of_walks(wheel_response):
    """Equal legs have the response of one step twice, and others that of differences of walks."""
    params, push = vrw.WheelParams(), 1e-4
    make_wheel = lambda **second: vrw.ViscoelasticWheel(
        leg_force=vrw.AlternatingLegs(vrw.SpringDamper(), vrw.SpringDamper(**second))
    )
    equal = vrw.phase_response(params, model=make_wheel(), n_samples=3)
    for half in np.split(equal.delay, 2):
        np.testing.assert_allclose(half, wheel_response.delay, atol=1e-9)
    model = make_wheel(damping=185.0)
    response = vrw.phase_response(params, model=model, n_samples=3)
    instant = int(np.flatnonzero((response.step_indices == 1) & (response.phase_indices == 1))[1])
    gait = vrw.limit_cycle(params, model=model, period_n=2, options=vrw.CycleOptions.tight())
    model_1 = model.with_laws(model.laws.exchange_legs(1))
    x_1 = vrw.step(params, gait.section_state, model=model, options=TIGHT).section_state
    distance = vrw.step(params, x_1, model=model_1, options=TIGHT).step_length
    times = []
    for sign in (1.0, -1.0):
        state = response.states[instant].copy()
        state[3] += sign * push
        rest = model_1.finish_step(params, 1, distance, jnp.asarray(state), TIGHT)
        walk = vrw.walk(params, rest.section_state, N_STEPS, model=model, options=TIGHT)
        times.append(float(np.sum(rest.durations) + np.sum(walk.steps.durations)))
    delay = (times[0] - times[1]) / (2.0 * push)
    assert abs(delay - response.delay[instant, 3]) < 2e-6


@pytest.mark.slow
def test_pushes_just_before_a_landing_move_the_landing(wheel_response):
    """A push of positions along their rates changes the time of the landing, but not its angle."""
    rates = wheel_response.states[-1, 3:]
    angle_by_positions = wheel_response.section_states[0, -1, :3, 0]
    assert abs(rates @ angle_by_positions) < 1e-9
    assert (np.abs(rates * angle_by_positions)[:2] > 0.01).all()


def test_an_unstable_gait_is_refused():
    """A racket that returns 1.5 of the velocity: the gait v = k / (1 - e) has the multiplier e."""
    params = {"ball": {"restitution": 1.5}, "kick": -1.0}
    unstable = vrw.limit_cycle(params, model=BALL_SYSTEM, guess=[2.1])
    np.testing.assert_allclose(unstable.section_state, [2.0], rtol=1e-12)
    with pytest.raises(ValueError, match="it is not stable"):
        vrw.phase_response(params, model=BALL_SYSTEM, cycle=unstable)


@pytest.mark.slow
def test_the_unstable_gait_of_the_simplest_walker_is_refused():
    """Its multipliers are those of an independent code."""
    unstable = vrw.limit_cycle(
        {"slope": 0.009}, model=SIMPLEST_WALKER, guess=[0.1939, -0.2039], options=TIGHT
    )
    np.testing.assert_allclose(unstable.multipliers, [4.00386435893, 0.4595895898], rtol=1e-9)
    with pytest.raises(ValueError, match="it is not stable"):
        vrw.phase_response({"slope": 0.009}, model=SIMPLEST_WALKER, cycle=unstable)
