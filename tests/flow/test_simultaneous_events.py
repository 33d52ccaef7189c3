"""Events at time zero and at the same time: values and derivatives against closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.slow_variants import mark_slow

import vrw_jax as vrw
from vrw_jax.hybrid import Guard, Mode, Termination, simulate_hybrid

TIGHT = vrw.StepOptions.tight()
G = 9.81
RESTITUTION = 0.8


def balls(n):
    """Return a mode of balls side by side, heights first, with a guard for each."""

    def bounce(i):
        return lambda y: y.at[i].set(0.0).at[n + i].set(-RESTITUTION * y[n + i])

    fall = lambda y: jnp.concatenate([y[n:], -G + 0.0 * y[n:]])
    return Mode(fall, tuple(Guard(lambda y, i=i: y[i], bounce(i)) for i in range(n)))


def heights_at(time, start, n, options):
    """Return the balls' heights at a time after their first bounces."""
    walked = simulate_hybrid(
        [balls(n)], jnp.concatenate([start, 0.0 * start]), events=n, options=options
    )
    left = time - walked.time
    return walked.state[:n] + left * walked.state[n:] - 0.5 * G * left**2


def height_at(time, start):
    """Return the same of one ball in closed form."""
    impact = jnp.sqrt(2.0 * start / G)
    left = time - impact
    return RESTITUTION * G * impact * left - 0.5 * G * left**2


@pytest.mark.parametrize(
    "options", [*mark_slow(vrw.StepOptions()), TIGHT], ids=["default", "tight"]
)
@pytest.mark.parametrize("n", [*mark_slow(2), 3])
def test_balls_that_land_together_have_the_derivatives_of_one_ball(n, options):
    jacobian = jax.jit(jax.jacfwd(lambda start: heights_at(0.7, start, n, options)))
    for height in (0.9, 1.0, 1.3):
        reference = jax.grad(height_at, 1)(0.7, height) * np.eye(n)
        np.testing.assert_allclose(jacobian(jnp.full(n, height)), reference, rtol=1e-12, atol=1e-12)
    apart = jacobian(jnp.array([1.0 + 1e-9 * i for i in range(n)]))
    np.testing.assert_allclose(apart, jacobian(jnp.ones(n)), atol=1e-7)
    np.testing.assert_allclose(apart[0, 0], 0.19055, atol=5e-6)


def thrown(start, options):
    """Return height, rate and impact time of a ball at 0.1 s, after its first bounce."""
    walked = simulate_hybrid([balls(1)], start, events=1, options=options)
    (height, rate), left = walked.state, 0.1 - walked.time
    return jnp.stack([height + rate * left - 0.5 * G * left**2, rate - G * left, walked.time])


def thrown_in_closed_form(start):
    impact = (start[1] + jnp.sqrt(start[1] ** 2 + 2.0 * G * start[0])) / G
    rate, left = -RESTITUTION * (start[1] - G * impact), 0.1 - impact
    return jnp.stack([rate * left - 0.5 * G * left**2, rate - G * left, impact])


@pytest.mark.parametrize("solver", ["Tsit5", *mark_slow("Dopri8", "Kvaerno5")])
@pytest.mark.parametrize("height", [0.0, -1e-17])
def test_a_start_on_a_falling_guard_has_the_event_time_s_derivatives(height, solver):
    options = vrw.StepOptions(solver, rtol=1e-12, atol=1e-12)
    start, on_guard = jnp.array([height, -2.0]), jnp.array([0.0, -2.0])
    first = jax.jit(jax.jacfwd(lambda y: thrown(y, options)))(start)
    np.testing.assert_allclose(first, jax.jacfwd(thrown_in_closed_form)(on_guard), atol=1e-12)
    np.testing.assert_array_equal(
        simulate_hybrid([balls(1)], start, events=1, options=options).times, 0.0
    )
    if solver == "Dopri8":
        second = jax.jacfwd(jax.jacfwd(lambda y: thrown(y, options)))(start)
        reference = jax.jacfwd(jax.jacfwd(thrown_in_closed_form))(on_guard)
        np.testing.assert_allclose(second, reference, atol=1e-11)


def differentiate_four_times(function, at):
    for _ in range(4):
        function = lambda a, f=function: jax.jvp(f, (a,), (1.0,))[1]
    return jax.jit(function)(at)


TSIT5 = vrw.StepOptions("Tsit5", rtol=1e-12, atol=1e-12)


def test_an_event_at_time_zero_has_right_fourth_derivatives():
    """Two decaying coordinates with a guard each: the first event is at time log y0."""
    guards = (Guard(lambda y: y[0] - 1.0), Guard(lambda y: y[1] - 1.0))
    decay = Mode(lambda y: jnp.stack([-y[0], -2.0 * y[1] * y[0]]), guards)

    def decayed(a):
        start = jnp.stack([a, 1.5 * a**2])
        solution = simulate_hybrid((decay,), start, events=1, options=TSIT5)
        return jnp.append(solution.states_before[0], solution.times)

    def decayed_in_closed_form(a):
        return jnp.stack([jnp.ones(()), 1.5 * a**2 * jnp.exp(2.0 * (1.0 - a)), jnp.log(a)])

    fourth = differentiate_four_times(decayed, 1.0)
    reference = differentiate_four_times(decayed_in_closed_form, 1.0)
    np.testing.assert_allclose(fourth, reference, atol=1e-10)  # round-off times 4!


@pytest.mark.slow
def test_an_event_that_the_first_guess_hits_has_right_fourth_derivatives():
    fourth = differentiate_four_times(lambda a: thrown(jnp.stack([a, 0.0 * a]), TSIT5), 0.5)
    closed_form = lambda a: thrown_in_closed_form(jnp.stack([a, 0.0 * a]))
    reference = differentiate_four_times(closed_form, 0.5)
    np.testing.assert_allclose(fourth, reference, rtol=1e-9)


@pytest.mark.slow
def test_starts_on_and_above_a_guard_have_right_derivatives_in_one_batch():
    starts = jnp.array([[0.0, -2.0], [0.3, -2.0], [0.0, -1.0], [1e-12, -2.0]])
    first = jax.vmap(jax.jacfwd(lambda y: thrown(y, TIGHT)))(starts)
    reference = jax.vmap(jax.jacfwd(thrown_in_closed_form))(starts)
    np.testing.assert_allclose(first, reference, atol=1e-11)


@pytest.mark.slow
def test_saltation_matrices_of_coinciding_events_are_composed_in_order():
    """Three constant fields, two planes that are met in the same point, and linear resets that do
    not commute: R. I. Leine and H. Nijmeijer, Dynamics and Bifurcations of Non-Smooth Mechanical
    Systems, 2004, section 7."""
    random = np.random.default_rng(3)
    fields, normals = random.normal(size=(3, 3)), random.normal(size=(2, 3))
    resets = np.eye(3) + 0.3 * random.normal(size=(2, 3, 3))
    for i in range(2):  # each field leads through its plane
        normals[i] *= -np.sign(normals[i] @ fields[i])
    constant = lambda i: lambda y: jnp.asarray(fields[i]) + 0.0 * y
    edge = lambda i: Guard(
        lambda y: jnp.asarray(normals[i]) @ y,
        lambda y: jnp.asarray(resets[i]) @ y,
        target_mode=i + 1,
    )
    rest = Guard(lambda y: 1e9 + y[0])
    modes = [Mode(constant(0), (edge(0),)), Mode(constant(1), (edge(1),))]
    modes.append(Mode(constant(2), (rest,)))

    def late(start):
        """The state at 2 s, in the last mode."""
        walked = simulate_hybrid(modes, start, events=2, options=TIGHT)
        return walked.state + (2.0 - walked.time) * jnp.asarray(fields[2])

    reference = np.eye(3)
    for i in range(2):
        jump = np.outer(fields[i + 1] - resets[i] @ fields[i], normals[i])
        reference = (resets[i] + jump / (normals[i] @ fields[i])) @ reference
    for before in (0.0, 0.5):  # s before both events: at time zero both
        start = jnp.asarray(-before * fields[0])
        walked = simulate_hybrid(modes, start, events=2, options=TIGHT)
        np.testing.assert_allclose(walked.times, before, atol=1e-15)
        np.testing.assert_allclose(jax.jacfwd(late)(start), reference, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("n", [*mark_slow(3, 5), 12])
def test_many_balls_that_land_together_go_on_bouncing(n):
    walked = simulate_hybrid(
        [balls(n)], jnp.repeat(jnp.array([1.0, 0.0]), n), events=3 * n, options=TIGHT
    )
    assert Termination(int(walked.termination)) == Termination.MAX_EVENTS_REACHED
    impacts = np.sqrt(2.0 / G) * np.array([1.0, 1.0 + 1.6, 1.0 + 1.6 + 1.28])
    np.testing.assert_allclose(walked.times, np.repeat(impacts, n), rtol=1e-14)
    for bounce in range(3):
        guards = np.asarray(walked.guards[bounce * n : (bounce + 1) * n])
        np.testing.assert_array_equal(np.sort(guards), np.arange(n))
    # One more of each, and then one each without end: the clock stands still at the same time.
    end = simulate_hybrid([balls(n)], jnp.repeat(jnp.array([1.0, 0.0]), n), events=600 * n)
    assert Termination(int(end.termination)) == Termination.ZENO
    assert abs(float(end.time) - np.sqrt(2.0 / G) * 9.0) < 1e-12


@pytest.mark.parametrize("n", [3, 5])
def test_balls_that_meet_in_one_point_hand_on_their_rates_in_one_instant(n):
    """Equal balls on a line swap rates: the fastest of n at last is the foremost, after a swap for
    each pair."""
    gap = lambda i: lambda y: y[i + 1] - y[i]
    swap = lambda i: lambda y: y.at[n + i].set(y[n + i + 1]).at[n + i + 1].set(y[n + i])
    roll = lambda y: jnp.concatenate([y[n:], 0.0 * y[n:]])
    guards = tuple(Guard(gap(i), swap(i)) for i in range(n - 1))
    rates = 2.0 - jnp.arange(n) ** 1.5
    start, pairs = jnp.concatenate([-rates, rates]), n * (n - 1) // 2
    walked = simulate_hybrid([Mode(roll, guards)], start, events=pairs)
    assert Termination(int(walked.termination)) == Termination.MAX_EVENTS_REACHED
    np.testing.assert_allclose(walked.times, 1.0, atol=1e-14)
    np.testing.assert_allclose(walked.state[n:], rates[::-1], atol=1e-14)
