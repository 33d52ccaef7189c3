"""Walks through modes: their ends, the error of their event times, and their compilation."""

from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.slow_variants import mark_slow

import vrw_jax as vrw
from vrw_jax.continuation import solve_fixed_point
from vrw_jax.hybrid import (
    Guard,
    Mode,
    ReturnMap,
    Termination,
    flow_jacobian_determinant,
    segment_maps,
    simulate_hybrid,
    time_errors,
)

TIGHT = vrw.StepOptions.tight()


def turn(y):
    """Return the rate of a rotation by one radian per second."""
    return jnp.stack([y[1], -y[0]])


@pytest.mark.parametrize("limit", [1e-4, 0.3, 2.0])
@pytest.mark.parametrize("solver", ["Dopri8", *mark_slow("Tsit5", "Kvaerno5")])
def test_a_walk_that_runs_out_of_time_ends_in_the_state_at_the_time_limit(solver, limit):
    """A rotation: its state at any time is a cosine and a sine. The limit is that of each mode."""
    options = vrw.StepOptions(solver, rtol=1e-11, atol=1e-11, max_phase_time=limit)
    modes = [
        Mode(
            lambda y: 10.0 * turn(y), (Guard(lambda y: y[0] - jnp.cos(5.0 * limit), target_mode=1),)
        ),
        Mode(turn, (Guard(lambda y: y[0] + 2.0),)),
    ]
    first = simulate_hybrid(modes[1:], [1.0, 0.0], events=1, options=options)
    assert Termination(int(first.termination)) == Termination.MAX_TIME_REACHED
    assert float(first.time) == limit
    np.testing.assert_allclose(first.state, [np.cos(limit), -np.sin(limit)], atol=1e-9)
    if limit < 0.6:  # the first mode leaves half of the limit unused
        second = simulate_hybrid(modes, [1.0, 0.0], events=2, options=options)
        assert (Termination(int(second.termination)), int(second.n_events)) == (
            Termination.MAX_TIME_REACHED,
            1,
        )
        assert abs(float(second.time) - 1.5 * limit) < 1e-9
        angle = 6.0 * limit
        np.testing.assert_allclose(second.state, [np.cos(angle), -np.sin(angle)], atol=1e-8)


def test_the_state_at_the_time_limit_moves_with_the_start():
    options = vrw.StepOptions(rtol=1e-12, atol=1e-12, max_phase_time=0.7)
    end = lambda y: simulate_hybrid(
        [Mode(turn, (Guard(lambda y: y[0] + 9.0),))], y, events=1, options=options
    )
    cosine, sine = np.cos(0.7), np.sin(0.7)
    found = jax.jacfwd(lambda y: end(y).state)(jnp.array([1.0, 0.0]))
    np.testing.assert_allclose(found, [[cosine, sine], [-sine, cosine]], atol=1e-10)


def accelerated(acceleration, distance, options):
    """Return the walk of a body at rest until it has gone a distance."""
    field = lambda y: jnp.stack([y[1], acceleration + 0.0 * y[1]])
    mode = Mode(field, (Guard(lambda y: distance - y[0]),))
    return simulate_hybrid([mode], [0.0, 0.0], events=1, options=options)


@pytest.mark.parametrize("tolerance", [*mark_slow(1e-5, 1e-10), 1e-13])
def test_an_event_much_earlier_than_the_first_solver_step_has_the_closed_form_s_time(tolerance):
    options = vrw.StepOptions(rtol=tolerance, atol=tolerance)
    run = jax.jit(lambda acceleration: accelerated(acceleration, 1e-6, options))
    for acceleration in 10.0 ** np.arange(0.0, 37.0, 3.0):
        walked = run(acceleration)
        assert Termination(int(walked.termination)) == Termination.MAX_EVENTS_REACHED
        np.testing.assert_allclose(walked.time, np.sqrt(2e-6 / acceleration), rtol=1e-14)
    time = lambda acceleration: accelerated(acceleration, 1e-6, options).time
    slope = jax.jit(jax.jacfwd(time))(1e20)
    np.testing.assert_allclose(slope, -0.5 * np.sqrt(2e-6 / 1e20) / 1e20, rtol=1e-12)


@pytest.mark.parametrize("distance", [1e-10, 1e-13, 1e-15])
def test_an_early_event_that_rounding_blurs_is_still_met(distance):
    """The guard is a difference of numbers of about one: its zero is known to 1e-16 of these."""
    field = lambda y: jnp.stack([y[1], 1e6 + 0.0 * y[1]])
    mode = Mode(field, (Guard(lambda y: (1.0 + distance) - y[0]),))
    walked = simulate_hybrid([mode], [1.0, 0.0], events=1)
    assert Termination(int(walked.termination)) == Termination.MAX_EVENTS_REACHED
    moved, blur = (1.0 + distance) - 1.0, 3e-16
    assert np.sqrt(2e-6 * (moved - blur)) <= float(walked.time) <= np.sqrt(2e-6 * (moved + blur))


@pytest.mark.parametrize("unit", [1e-25, 1e-9, 1.0, 1e9])
def test_an_absolute_tolerance_may_be_as_small_as_the_unit_makes_the_state(unit):
    """A spring's quarter of a period, which no unit of length changes."""
    swing = Mode(lambda y: jnp.stack([y[1], -y[0]]), (Guard(lambda y: y[0]),))
    options = vrw.StepOptions(rtol=1e-11, atol=1e-11 * unit)
    walked = simulate_hybrid([swing], [unit, 0.0], events=1, options=options)
    np.testing.assert_allclose(walked.time, 0.5 * np.pi, rtol=1e-9)


def test_a_relative_tolerance_below_round_off_is_refused_in_a_sentence():
    swing = Mode(turn, (Guard(lambda y: y[0]),))
    options = vrw.StepOptions(rtol=1e-17, atol=1e-30)
    with pytest.raises(ValueError, match="rtol is 1e-17, but float64 numbers can't resolve"):
        simulate_hybrid([swing], [1.0, 0.0], events=1, options=options)


def test_the_clock_of_a_long_walk_loses_no_digit_and_its_stated_error_holds():
    """Ticks of equal length: times are their multiples, by fractions."""
    n = 3000
    reset = lambda y: jnp.stack([0.0 * y[0], y[1]])
    clock = Mode(
        lambda y: jnp.stack([1.0 + 0.0 * y[0], 0.0 * y[1]]), (Guard(lambda y: y[1] - y[0], reset),)
    )

    @jax.jit
    def ticking(tick):
        start = jnp.stack([0.0 * tick, tick])
        walked = simulate_hybrid([clock], start, events=n, options=TIGHT)
        return walked.times, time_errors([clock], start, walked, TIGHT)

    for tick in (Fraction(1, 10), Fraction(1, 3)):
        times, stated = (np.asarray(x) for x in ticking(float(tick)))
        for k in (1, 10, 1000, n):
            found = Fraction(float(times[k - 1]))
            assert float(abs(found - k * Fraction(float(tick)))) <= np.spacing(times[k - 1])
            assert float(abs(found - k * tick)) <= stated[k - 1]
        assert stated[-1] < 1e-14 * n


def test_the_derivative_of_a_long_walk_s_clock_loses_no_digit():
    field = lambda y: jnp.stack([y[1], 0.0 * y[1]])
    clock = Mode(field, (Guard(lambda y: 0.1 - y[0], lambda y: y.at[0].set(0.0)),))
    time = lambda rate: simulate_hybrid([clock], jnp.stack([0.0 * rate, rate]), events=2000).time
    np.testing.assert_allclose(jax.jacfwd(time)(1.0), -2000 * 0.1, rtol=4e-16)


def bouncing(restitution=0.8, lift=0.0):
    """Return a ball whose floor adds `lift` to the rate after a bounce."""
    fall = lambda y: jnp.stack([y[1], -9.81 + 0.0 * y[1]])
    bounce = lambda y: jnp.stack([0.0 * y[0], lift - restitution * y[1]])
    return fall, Guard(lambda y: y[0], bounce)


def test_one_mode_and_one_guard_may_be_given_without_a_tuple():
    fall, floor = bouncing()
    start, options = [1.0, 0.0], vrw.StepOptions()
    listed, alone = [Mode(fall, (floor,))], Mode(fall, floor)
    solution = simulate_hybrid(listed, start, events=3)
    for modes in (alone, [alone], Mode(fall, [floor])):
        jax.tree.map(
            np.testing.assert_array_equal, simulate_hybrid(modes, start, events=3), solution
        )
    np.testing.assert_array_equal(
        time_errors(alone, start, solution, options), time_errors(listed, start, solution, options)
    )
    np.testing.assert_array_equal(
        flow_jacobian_determinant(alone, start, solution, options),
        flow_jacobian_determinant(listed, start, solution, options),
    )
    for modes in (floor, [floor]):
        with pytest.raises(TypeError, match="Mode"):
            simulate_hybrid(modes, start, events=3)


def simulate_two_bounces(height, restitution=0.8):
    return simulate_hybrid(
        Mode(*bouncing(restitution)), jnp.stack([height, 0.0 * height]), events=2
    )


@pytest.mark.parametrize(
    "differentiate",
    [
        lambda time: jax.grad(time)(1.0),
        *mark_slow(
            lambda time: jax.jit(jax.jacrev(time))(1.0),
            lambda time: jax.vmap(jax.grad(time))(jnp.ones(2)),
            lambda time: jax.hessian(time)(1.0),
            lambda _: jax.grad(lambda share: simulate_two_bounces(1.0, share).state[1])(0.8),
        ),
    ],
    ids=["grad", "jit", "vmap", "hessian", "closure"],
)
def test_reverse_mode_is_refused_in_a_sentence_that_names_forward_mode(differentiate):
    with pytest.raises(ValueError, match=r"has no .* use forward mode, jax.jacf"):
        differentiate(lambda height: simulate_two_bounces(height).time)


def test_segment_maps_refuse_reverse_mode_in_a_sentence():
    fall, _ = bouncing()
    cut = lambda height: segment_maps(fall, [height, 0.0], 0.1, 1, TIGHT).jacobians[0, 0, 1]
    with pytest.raises(ValueError, match=r"segment_maps has no .* jax.jacfwd"):
        jax.grad(cut)(1.0)


def test_forward_mode_of_a_batch_gives_the_closed_form():
    time = lambda height: simulate_two_bounces(height).time
    forwards = jax.vmap(jax.jit(jax.jacfwd(time)))(jnp.ones(2))
    np.testing.assert_allclose(forwards, 0.5 * 2.6 * np.sqrt(2.0 / 9.81), rtol=1e-12)


def make_rebound_map(height, options=None):
    """Return the return map of a ball that rebounds at half of its impact speed plus 2 m/s.

    Its fixed point is a speed of 4 m/s.
    """
    embed = lambda rate: jnp.stack([height + 0.0 * rate[0], rate[0]])
    return ReturnMap(Mode(*bouncing(0.5, 2.0)), embed, lambda y: y[1:], options=options)


@pytest.mark.parametrize(
    ("height", "options", "stop"),
    [
        (-0.1, None, Termination.GUARD_VIOLATED_AT_ENTRY),
        *mark_slow(
            (0.0, vrw.StepOptions(max_phase_time=0.01), Termination.MAX_TIME_REACHED),
            (1.0, vrw.StepOptions(max_solver_steps=2), Termination.MAX_STEPS_REACHED),
        ),
    ],
)
def test_a_return_map_repeats_no_state_at_which_a_walk_stopped(height, options, stop):
    early, rate = make_rebound_map(height, options), jnp.array([1.0])
    stopped = simulate_hybrid(early.modes, early.embed(rate), events=1, options=options)
    assert Termination(int(stopped.termination)) == stop
    if stop == Termination.GUARD_VIOLATED_AT_ENTRY:
        np.testing.assert_array_equal(stopped.state[1:], rate)  # as if the walk had returned
    assert np.isnan(early(rate)).all()
    assert np.isnan(jax.jacfwd(early)(rate)).all()
    lost = solve_fixed_point(early, rate)
    assert not lost.converged
    assert Termination(int(lost.termination)) == stop
    assert stop.meaning in repr(lost)
    assert np.isnan(lost.residual)


def test_a_return_map_has_the_fixed_point_and_the_multiplier_of_the_closed_form():
    rate = jnp.array([1.0])
    cycle = solve_fixed_point(make_rebound_map(0.0, TIGHT), rate)
    assert cycle.converged
    assert Termination(int(cycle.termination)) == Termination.MAX_EVENTS_REACHED
    np.testing.assert_allclose(cycle.x, 4.0, rtol=1e-12)
    np.testing.assert_allclose(cycle.jacobian, 0.5, rtol=1e-12)
    twice = solve_fixed_point(make_rebound_map(0.0, TIGHT), rate, period_n=2)
    np.testing.assert_allclose(twice.jacobian, 0.25, rtol=1e-12)
    assert Termination(int(twice.termination)) == Termination.MAX_EVENTS_REACHED


@pytest.mark.slow
def test_a_return_map_s_point_moves_with_what_its_modes_close_over():
    def rate(lift):
        embed = lambda rate: jnp.stack([0.0 * rate[0], rate[0]])
        back = ReturnMap(Mode(*bouncing(0.5, lift)), embed, lambda y: y[1:], options=TIGHT)
        return solve_fixed_point(back, jnp.array([1.0])).x[0]

    np.testing.assert_allclose(jax.jacfwd(rate)(2.0), 2.0, rtol=1e-10)
