"""The documented interface for any field, guards and resets: closed forms and errors."""

import itertools
import re
from fractions import Fraction
from pathlib import Path

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from support.slow_variants import mark_slow

import vrw_jax as vrw
from vrw_jax import lanes
from vrw_jax.continuation import solve_fixed_point
from vrw_jax.hybrid import (
    Guard,
    LCPStatus,
    Mode,
    Termination,
    enumerate_lcp_solutions,
    flow_jacobian_determinant,
    product_multipliers,
    segment_maps,
    simulate_hybrid,
    time_errors,
)

PAGE = Path(__file__).parents[2] / "docs" / "any_system.md"
TIGHT_OPTIONS = vrw.StepOptions.tight()
G = 9.81


def free_fall_field(y):
    return jnp.stack([y[1], -G + 0.0 * y[1]])


def make_ball_mode(restitution=0.8):
    return Mode(
        free_fall_field,
        (Guard(lambda y: y[0], lambda y: jnp.stack([0.0 * y[0], -restitution * y[1]])),),
    )


def read_termination(result):
    return Termination(int(result.termination))


@pytest.mark.slow
def test_the_examples_of_the_page_print_the_shown_output(capsys, monkeypatch):
    monkeypatch.setattr(vrw, "start_jax", lambda: None)
    blocks = re.findall(r"```python\n(.*?)```\n\n```text\n(.*?)```", PAGE.read_text(), re.DOTALL)
    assert len(blocks) == PAGE.read_text().count("```python")
    assert len([x for x in blocks[0][0].splitlines() if x]) <= 10
    names = {}
    for source, printed in blocks:
        exec(source, names)
        assert capsys.readouterr().out == printed


@pytest.mark.parametrize("restitution", [0.2, 0.5, 0.9])
def test_a_ball_bounces_until_its_event_times_accumulate(restitution):
    result = simulate_hybrid(
        [make_ball_mode(restitution)], [1.0, 0.0], events=600, options=TIGHT_OPTIONS
    )
    n = int(result.n_events)
    powers = restitution ** np.arange(n)
    reference = np.sqrt(2.0 / G) * (1.0 + 2.0 * restitution * (1.0 - powers) / (1.0 - restitution))
    assert read_termination(result) == Termination.ZENO
    np.testing.assert_allclose(result.times[:n], reference, rtol=1e-14)
    end = np.sqrt(2.0 / G) * (1.0 + restitution) / (1.0 - restitution)
    assert abs(float(result.time) - end) < 1e-14 * end


def test_derivatives_of_event_times_agree_with_the_closed_form():
    third = lambda height: simulate_hybrid(
        [make_ball_mode()], jnp.stack([height, 0.0 * height]), events=3, options=TIGHT_OPTIONS
    ).times[2]
    reference = lambda height: jnp.sqrt(2.0 * height / G) * (1.0 + 2.0 * (0.8 + 0.64))
    np.testing.assert_allclose(jax.jacfwd(third)(1.3), jax.grad(reference)(1.3), rtol=1e-12)


def test_a_simulation_inside_machine_code_has_derivatives_in_reverse_mode(recwarn):
    @lanes.jit
    def fall(height):
        start = jnp.stack([height, 0.0 * height])
        return simulate_hybrid([make_ball_mode()], start, events=1, options=TIGHT_OPTIONS).times[0]

    np.testing.assert_allclose(jax.grad(fall)(1.3), 0.5 * np.sqrt(2.0 / (1.3 * G)), rtol=1e-12)
    assert not recwarn.list


def test_modes_follow_the_target_modes_of_their_guards():
    # A thermostat: up with rate 2, down with rate 1, between 0 and 1.
    heat = Mode(lambda y: jnp.full_like(y, 2.0), (Guard(lambda y: 1.0 - y[0], target_mode=1),))
    cool = Mode(lambda y: jnp.full_like(y, -1.0), (Guard(lambda y: y[0], target_mode=0),))
    result = simulate_hybrid([heat, cool], [0.5], events=5, options=TIGHT_OPTIONS)
    assert read_termination(result) == Termination.MAX_EVENTS_REACHED
    np.testing.assert_array_equal(result.modes, [0, 1, 0, 1, 0])
    np.testing.assert_allclose(result.times, [0.25, 1.25, 1.75, 2.75, 3.25], rtol=1e-14)


def test_a_batched_simulation_equals_the_single_one():
    heights = jnp.array([0.5, 1.0, 2.0])
    one = lambda height: simulate_hybrid(
        [make_ball_mode()], jnp.stack([height, 0.0 * height]), events=4
    )
    many = jax.vmap(one)(heights)
    for i, height in enumerate(heights):
        np.testing.assert_allclose(many.times[i], one(height).times, rtol=1e-13)


@pytest.mark.parametrize("height", [-1e-17, 1e-17, 0.0])
def test_a_start_within_round_off_of_a_guard_is_on_the_guard(height):
    result = simulate_hybrid([make_ball_mode()], [height, 1.0], events=1, options=TIGHT_OPTIONS)
    assert read_termination(result) == Termination.MAX_EVENTS_REACHED
    assert abs(float(result.time) - 2.0 / G) < 1e-14


@pytest.mark.parametrize("depth", [0.5, 1e-4, 1e-8])
def test_the_time_tolerance_of_a_grazing_event_follows_the_closed_form(depth):
    # The height of a throw at g = 1 above a ceiling that it passes by `depth`: 1/2 - depth.
    throw = lambda y: jnp.stack([y[1], -1.0 + 0.0 * y[1]])
    mode = Mode(throw, (Guard(lambda y: 0.5 - depth - y[0]),))
    result = jax.vmap(lambda y: simulate_hybrid((mode,), y, events=2, options=TIGHT_OPTIONS))(
        jnp.array([[0.0, 1.0]])
    )
    rate, tolerance = np.sqrt(2.0 * depth), 1e-13 * (1.0 + 0.5 - depth)
    np.testing.assert_allclose(result.time_tolerance[0, 0], tolerance / rate, rtol=1e-6)
    assert abs(float(result.times[0, 0]) - (1.0 - rate)) <= float(result.time_tolerance[0, 0])


@pytest.mark.parametrize("depth", [1e-4, 1e-8])
def test_an_event_time_dominated_by_round_off_is_reported(depth):
    """A point of the unit circle dips below a line; 50 digits, about data a rounding off."""
    turn = Mode(lambda y: jnp.stack([-y[1], y[0]]), (Guard(lambda y: y[1] + (1.0 - depth)),))
    options = vrw.StepOptions(rtol=1e-15, atol=1e-15)
    result = simulate_hybrid([turn], [1.0, 0.0], events=1, options=options)
    with mpmath.workdps(50):
        line = 1 - mpmath.mpf(depth)
        compute_event = lambda radius: mpmath.mpf(3) / 2 * mpmath.pi - mpmath.acos(line / radius)
        shifted = float(abs(compute_event(1 + mpmath.mpf(2) ** -52) - compute_event(1)))
        wrong = float(abs(mpmath.mpf(float(result.times[0])) - compute_event(1)))
    np.testing.assert_allclose(result.time_roundoff[0], shifted, rtol=1e-3)
    assert (shifted > 1e-12) == (depth == 1e-8)
    # The state errs by its own rounding, and by some of the solver steps on the way.
    assert wrong < max(1e-12, 3.0 * float(result.time_roundoff[0]))


def make_switching_system(rate):
    """ARGESIM's C5: a fast state that follows a slow one and switches it at 5.8 and 2.5. What is
    left of the fast exponential at a switch is below exp(-900)."""
    slow, levels = 3.5651205, ((0.4, 5.5, 5.8), (-0.3, 2.73, 2.5))
    modes = [
        Mode(
            lambda y, a=a, b=b: jnp.stack([rate * (y[1] + a - y[0]), slow * (b - y[1])]),
            (
                Guard(
                    lambda y, level=level, sign=1.0 - 2.0 * k: sign * (level - y[0]),
                    target_mode=1 - k,
                ),
            ),
        )
        for k, (a, b, level) in enumerate(levels)
    ]
    y, times = 0.3, []
    for k in range(6):
        a, b, level = levels[k % 2]
        times.append(np.log((y - b) * rate / (rate - slow) / (level - a - b)) / slow)
        y = b + (y - b) * np.exp(-slow * times[-1])
    return modes, [4.2, 0.3], np.cumsum(times)


def make_crossing_system(field, start, behind, angle, events):
    """Return guards on y[0] = 1/2 in both directions; y[0] falls there at `behind` + `angle` + 2 pi
    k."""
    halves = [
        Guard(lambda y: y[0] - 0.5, target_mode=1),
        Guard(lambda y: 0.5 - y[0], target_mode=0),
    ]
    turns = 2.0 * np.pi * np.repeat(np.arange(events), 2)[1 : events + 1]
    signs = np.tile([angle, -angle], events)[:events]
    return [Mode(field, (half,)) for half in halves], start, turns + signs + behind


def make_rotating_field(rate):
    """Return y' = rate (cos t - y) with a rotation as clock; y is a cosine, smaller and later."""
    field = lambda y: jnp.stack([rate * (y[1] - y[0]), -y[2], y[1]])
    size = rate**2 / (1.0 + rate**2)  # cos of the lag times the amplitude
    angle = np.arccos(0.5 / np.sqrt(size))
    return make_crossing_system(field, [size, 1.0, 0.0], np.arctan(1.0 / rate), angle, 20)


def make_attracted_field(rate):
    """Return the field of Prothero and Robinson, which attracts to y = cos t."""
    field = lambda y: jnp.stack([-rate * (y[0] - jnp.cos(y[1])) - jnp.sin(y[1]), 1.0 + 0.0 * y[1]])
    return make_crossing_system(field, [1.0, 0.0], 0.0, np.pi / 3.0, 10)


@pytest.mark.parametrize(
    ("stiff", "rate", "solver"),
    [
        (make_switching_system, 2.7e6, "Kvaerno5"),
        *mark_slow(
            (make_attracted_field, 1e3, "Kvaerno4"),
            (make_switching_system, 1e3, "Kvaerno5"),
            (make_rotating_field, 1e6, "Kvaerno5"),
        ),
    ],
)
def test_event_times_of_implicit_solvers_are_within_their_stated_errors(stiff, rate, solver):
    modes, start, reference = stiff(rate)

    @jax.jit
    def both(tolerance):
        options = vrw.StepOptions(solver, rtol=tolerance, atol=tolerance, max_phase_time=100.0)
        results = simulate_hybrid(modes, start, events=len(reference), options=options)
        return results, time_errors(modes, start, results, options)

    outside_values = []
    for tolerance in (1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 1e-10):
        result, stated = both(jnp.asarray(tolerance))
        n = int(
            result.n_events
        )  # one of the walks ends early: a rounding off its guard, GUARD_PAST
        wrong = np.abs(result.times[:n] - reference[:n])
        assert n > 1
        assert np.all(wrong <= stated[:n]), tolerance
        outside_values.append(np.max(wrong / result.time_tolerance[:n]))
    # One event's resolution is no bound: errors add up, and the solver's estimate leaves some out.
    assert max(outside_values) > 3.0


def test_the_error_of_an_event_time_is_twice_its_tolerance_or_infinite_at_another_event():
    result = simulate_hybrid([make_ball_mode()], [1.0, 0.0], events=4, options=TIGHT_OPTIONS)
    stated = lambda result: time_errors([make_ball_mode()], [1.0, 0.0], result, TIGHT_OPTIONS)
    np.testing.assert_array_equal(
        stated(result), 2.0 * result.time_tolerance
    )  # a fall has no error
    other = result._replace(guards=result.guards.at[2].set(1), n_events=result.n_events - 1)
    np.testing.assert_array_equal(np.isinf(stated(other)), [False, False, True, False])
    assert stated(other)[3] == 0.0  # no event


def make_impact_oscillator(depth):
    """x'' + x = -(1 - w²) c cos wt with a stop at x = 1 that keeps 0.8 of the rate, c = 1 + depth,
    forced at twice its own frequency, and its motion with one impact each period: the rate behind
    the stop is 2 w √(c² - 1)/(1 - r) of it (Nordmark, J. Sound Vib. 145, 1991)."""
    c, w, r = 1.0 + depth, 2.0, 0.8
    force = (1.0 - w * w) * c
    field = lambda y: jnp.stack([y[1], -force * jnp.cos(w * y[2]) - y[0], 1.0 + 0.0 * y[0]])
    stop = Guard(lambda y: 1.0 - y[0], lambda y: jnp.stack([1.0 + 0.0 * y[0], -r * y[1], y[2]]))
    sine = np.sqrt(depth * (2.0 + depth))
    rate = -r * 2.0 * w * sine / (1.0 - r)
    return [Mode(field, (stop,))], jnp.array([1.0, rate, (np.pi - np.arctan(sine)) / w]), r


@pytest.mark.parametrize("depth", [*mark_slow(1e-2), 1e-6])
def test_the_product_of_multipliers_is_accurate_at_a_grazing_event(depth):
    modes, start, restitution = make_impact_oscillator(depth)

    @lanes.jit
    def back(x):
        return simulate_hybrid(
            modes, jnp.stack([1.0 + 0.0 * x[0], *x]), events=1, options=TIGHT_OPTIONS
        ).state[1:]

    fixed_point = solve_fixed_point(
        lambda x: back(x) - jnp.array([0.0, np.pi]), start[1:], tolerance=1e-11
    )
    assert fixed_point.converged
    start = jnp.stack([1.0, *fixed_point.x])
    result = simulate_hybrid(modes, start, events=1, options=TIGHT_OPTIONS)
    # Area shrinks by the restitution twice: of the rate, and of the time at which it passes.
    assert (
        abs(float(flow_jacobian_determinant(modes, start, result, TIGHT_OPTIONS)) - restitution**2)
        < 1e-15
    )
    determinant_error = abs(float(jnp.linalg.det(fixed_point.jacobian)) - restitution**2)
    assert (determinant_error > 1e-12) == (depth == 1e-6)


def test_volumes_change_by_the_guard_that_arms_at_the_event():
    oscillate = lambda y: jnp.stack([y[1], -y[0] - 0.1 * y[1]])
    reset = lambda y: jnp.stack([y[0] + 0.3, 0.9 * y[1]])
    guard = Guard(lambda y: y[0] - 0.5, reset, armed=lambda y: -y[1] - 0.3 * y[0] - 0.3)
    start = jnp.array([0.3, 0.2])
    determinants = []
    for mode in Mode(oscillate, guard), Mode(oscillate, Guard(guard.evaluate, reset)):
        result = simulate_hybrid(mode, start, events=1, options=TIGHT_OPTIONS)
        assert result.state[0] < 0.8  # The value was below zero before the guard was armed.
        determinants.append(flow_jacobian_determinant(mode, start, result, TIGHT_OPTIONS))
    np.testing.assert_allclose(*determinants, rtol=1e-12)
    assert abs(determinants[0] - 2.33252) < 1e-5  # central differences of SciPy's solution


def test_newtons_method_finds_a_repeating_state_next_to_a_jump_of_the_map():
    """x to x^2, whose points are 0 and 1, with a hole around 0 in which x leads to 7."""
    leaps = lambda x: jnp.where(jnp.abs(x) < 1e-15, 7.0, x**2)
    cycle = solve_fixed_point(leaps, jnp.array([1e-5]), tolerance=1e-9)
    assert cycle.converged
    assert abs(cycle.x[0] - 1.0) < 1e-12
    assert cycle.residual < 1e-12


@pytest.mark.parametrize("start", [np.pi, np.pi + 1e-12, 2.0 * np.pi])
def test_a_map_without_fixed_points_has_none_however_far_newtons_method_goes(start):
    """x moves by 0.1 at least, but from these starts to 1e12 and more, where 0.1 is round-off."""
    fixed_point = solve_fixed_point(lambda x: x + 1.1 + jnp.cos(x), jnp.array([start]))
    assert not fixed_point.converged
    assert fixed_point.x == start


@pytest.mark.parametrize("start", [0.0, 1.0])
def test_a_distant_fixed_point_is_found(start):
    fixed_point = solve_fixed_point(lambda x: 0.5 * x + 1e14, jnp.array([start]))
    assert fixed_point.converged
    np.testing.assert_allclose(fixed_point.x, 2e14, rtol=1e-12)


def test_the_tolerance_of_a_noisy_map_decides_whether_its_fixed_point_is_found():
    quantize = lambda x: (0.5 * x + 1.0 + 2e10) - 2e10  # in steps of 4e-6
    assert solve_fixed_point(quantize, jnp.array([0.3]), tolerance=1e-4).converged


def test_volumes_shrink_by_friction_and_by_every_bounce():
    """x' = v, v' = -g - v: exp(-t) in all, and r² at each bounce."""
    drag = lambda y: jnp.stack([y[1], -G - y[1]])
    floor = Guard(lambda y: y[0], lambda y: jnp.stack([0.0 * y[0], -0.5 * y[1]]))
    start = jnp.array([1.0, 0.0])
    result = simulate_hybrid([Mode(drag, (floor,))], start, events=5, options=TIGHT_OPTIONS)
    solution = jax.jit(
        lambda y: flow_jacobian_determinant([Mode(drag, (floor,))], y, result, TIGHT_OPTIONS)
    )(start)

    def moved(y):
        """With the time held: states past the fifth event flow for a moment more."""
        last_simulation = simulate_hybrid(
            [Mode(drag, (floor,))], y, events=5, options=TIGHT_OPTIONS
        )
        remaining_time = result.time - last_simulation.time
        return last_simulation.state + remaining_time * drag(last_simulation.state)

    # The saltation matrix of each event, by differentiating through its time.
    np.testing.assert_allclose(solution, jnp.linalg.det(jax.jacfwd(moved)(start)), rtol=1e-9)


@pytest.mark.parametrize(("bend", "time"), [(1.0, 3.0), (-1.0, 0.0)])
def test_a_guard_at_zero_fires_only_if_it_does_not_rise(bend, time):
    """h = bend t²/2 − t³/6, from h = h' = 0."""
    mode = Mode(lambda y: jnp.stack([y[1], y[2], -1.0 + 0.0 * y[2]]), (Guard(lambda y: y[0]),))
    result = simulate_hybrid((mode,), (0.0, 0.0, bend), events=1, options=TIGHT_OPTIONS)
    assert read_termination(result) == Termination.MAX_EVENTS_REACHED
    np.testing.assert_allclose(result.times[0], time, atol=1e-12)


def test_failures_of_a_simulation_are_termination_codes():
    assert (
        read_termination(simulate_hybrid([make_ball_mode()], [-1.0, 0.0], events=3))
        == Termination.GUARD_VIOLATED_AT_ENTRY
    )
    short = vrw.StepOptions(max_phase_time=0.1)
    assert (
        read_termination(simulate_hybrid([make_ball_mode()], [1.0, 0.0], events=3, options=short))
        == Termination.MAX_TIME_REACHED
    )
    two_step_options = vrw.StepOptions(max_solver_steps=2)
    result = simulate_hybrid([make_ball_mode()], [1.0, 0.0], events=3, options=two_step_options)
    assert read_termination(result) == Termination.MAX_STEPS_REACHED
    assert int(result.n_events) == 0
    sinks = Mode(lambda y: -0.5 / y, (Guard(lambda y: y[0] + 1.0),))  # sqrt(1 - t), then nothing
    assert (
        read_termination(simulate_hybrid([sinks], [1.0], events=1))
        == Termination.STEP_SIZE_UNDERFLOW
    )
    assert np.all(np.isfinite(simulate_hybrid([sinks], [1.0], events=1).state))
    into = Mode(free_fall_field, (Guard(lambda y: y[0], lambda y: jnp.stack([y[0] - 1.0, -y[1]])),))
    result = simulate_hybrid([into], [1.0, 0.0], events=3)
    assert (read_termination(result), int(result.n_events)) == (
        Termination.GUARD_VIOLATED_AT_ENTRY,
        1,
    )
    assert all(len(stop.meaning) > 20 for stop in Termination)


@pytest.mark.parametrize(
    ("modes", "start", "sentence"),
    [
        (
            [Mode(lambda y: y[:1], make_ball_mode().guards)],
            [1.0, 0.0],
            r"field of mode 0 gives .*\(1,\)",
        ),
        (
            [Mode(lambda y: (y[1], -G), make_ball_mode().guards)],
            [1.0, 0.0],
            "field of mode 0 gives tuple",
        ),
        (
            [Mode(free_fall_field, (Guard(lambda y: y),))],
            [1.0, 0.0],
            r"guard 0 of mode 0 gives .*\(2,\)",
        ),
        (
            [Mode(free_fall_field, (Guard(lambda y: y[0] > 0),))],
            [1.0, 0.0],
            "guard 0 of mode 0 gives bool",
        ),
        (
            [Mode(free_fall_field, (Guard(lambda y: y[0], lambda y: -y[1]),))],
            [1.0, 0.0],
            r"reset of guard 0 of mode 0 gives .*\(\)",
        ),
        ([Mode(free_fall_field, ())], [1.0, 0.0], "mode 0 has no guard"),
        (
            [Mode(free_fall_field, (Guard(lambda y: y[0], target_mode=3),))],
            [1.0, 0.0],
            "leads to mode 3",
        ),
        ([make_ball_mode()], [[1.0, 0.0]], "one row of numbers"),
        ([make_ball_mode()], [np.nan, 0.0], "not finite"),
        ([Mode(free_fall_field, (free_fall_field,))], [1.0, 0.0], "a guard is .* give Guard"),
    ],
)
def test_invalid_systems_are_refused_in_one_sentence(modes, start, sentence):
    with pytest.raises((ValueError, TypeError), match=sentence):
        simulate_hybrid(modes, start, events=2)


def decaying_field(y):
    x1, x2, t = y
    return jnp.stack([x2, -10 * jnp.cos(t) * x1 - (24 + 10 * jnp.sin(t)) * x2, 1.0 + 0.0 * t])


def test_multipliers_of_a_product_are_accurate_or_marked_as_inaccurate():
    cut = lambda n: segment_maps(
        decaying_field, jnp.zeros(3), 2 * np.pi, n, TIGHT_OPTIONS, n_directions=2
    )
    result = product_multipliers(cut(200).jacobians)
    assert np.all(result.is_known)
    np.testing.assert_allclose(result.values, [1.0, np.exp(-48 * np.pi)], rtol=1e-12)
    assert abs(float(cut(200).divergence) + 48 * np.pi) < 1e-12
    product = product_multipliers(cut(1).jacobians)
    np.testing.assert_array_equal(product.is_known, [True, False])
    assert abs(product.values[0] - 1.0) < 1e-12
    assert np.isnan(product.values[1])


@pytest.mark.parametrize("n_segments", [1, 2, 7, 10, 100])
def test_a_strong_contraction_is_accurate_in_one_segment(n_segments):
    """r' = g(t) (r² - 1)/(2 r) about r = 1: exp of the mean of g, 1 - 2 times Poisson's kernel."""
    q = 0.97

    def poisson(t):
        half = jnp.sin(0.5 * (t - np.pi))
        return 1.0 - 2.0 * (1.0 - q) * (1.0 + q) / ((1.0 - q) ** 2 + 4.0 * q * half * half)

    field = lambda y: jnp.stack([0.5 * poisson(y[1]) * (y[0] ** 2 - 1.0) / y[0], 1.0 + 0.0 * y[1]])
    cut = segment_maps(field, [1.0, 0.0], 2.0 * np.pi, n_segments, TIGHT_OPTIONS, n_directions=1)
    result = product_multipliers(cut.jacobians)
    np.testing.assert_allclose(result.values[0].real, np.exp(-2.0 * np.pi), rtol=1e-12)


@pytest.mark.parametrize("size", [1, 2, 4, 6])
def test_multipliers_of_products_agree_with_those_of_the_product(size):
    random = np.random.default_rng(size)
    for _ in range(20):
        maps = np.eye(size) + 0.3 * random.normal(size=(4, size, size))
        reference = np.linalg.eigvals(np.linalg.multi_dot(maps[::-1]))
        solution = product_multipliers(maps).values
        gap = np.abs(solution[:, None] - reference[None])
        assert max(gap.min(0).max(), gap.min(1).max()) < 1e-9 * np.abs(reference).max()


def test_a_singular_factor_hides_one_multiplier_and_leaves_the_others():
    result = product_multipliers([[[1.0, 2.0], [0.5, 1.0]], [[1.0, 0.0], [0.0, 2.0]]])
    np.testing.assert_array_equal(result.is_known, [True, False])
    assert abs(result.values[0] - 3.0) < 1e-14
    assert result.logarithms[1] < -30.0


def test_segments_and_products_refuse_wrong_shapes_in_one_sentence():
    with pytest.raises(ValueError, match=r"maps has shape \(2, 2\)"):
        product_multipliers(np.eye(2))
    spent_seconds = segment_maps(
        decaying_field, jnp.zeros(3), 9.0, 1, vrw.StepOptions(max_solver_steps=3), 2
    )
    with pytest.raises(ValueError, match="not finite: the flow left its domain, or its steps"):
        product_multipliers(spent_seconds.jacobians)
    with pytest.raises(ValueError, match="directions is 4"):
        segment_maps(decaying_field, jnp.zeros(3), 1.0, 2, TIGHT_OPTIONS, n_directions=4)
    with pytest.raises(ValueError, match="row of the same length"):
        segment_maps(lambda y: y[:1], jnp.zeros(3), 1.0, 2, TIGHT_OPTIONS)


def test_contact_problems_have_one_solution_several_or_none():
    answers = lambda matrix, free: LCPStatus(int(enumerate_lcp_solutions(matrix, free).status))
    assert answers([[1.0]], [-1.0]) == LCPStatus.UNIQUE_SOLUTION
    assert answers([[-1.0]], [1.0]) == LCPStatus.MULTIPLE_SOLUTIONS
    assert answers([[-1.0]], [-1.0]) == LCPStatus.NO_SOLUTION
    assert np.isnan(enumerate_lcp_solutions([[-1.0]], [-1.0]).force).all()
    random = np.random.default_rng(0)
    for _ in range(10):  # a positive definite matrix: one answer, by the quadratic programme
        root = random.normal(size=(3, 3))
        matrix, free = root @ root.T + 0.1 * np.eye(3), random.normal(size=3)
        result = enumerate_lcp_solutions(matrix, free)
        assert int(result.status) == LCPStatus.UNIQUE_SOLUTION
        assert float(jnp.min(result.force)) >= 0.0
        assert float(jnp.min(result.gap)) >= -1e-12
        np.testing.assert_allclose(result.force * result.gap, 0.0, atol=1e-12)
        np.testing.assert_allclose(result.gap, matrix @ result.force + free, atol=1e-12)
    with pytest.raises(ValueError, match=r"free_gap \(2,\)"):
        enumerate_lcp_solutions(np.eye(3), np.zeros(2))
    with pytest.raises(ValueError, match="not finite"):
        enumerate_lcp_solutions([[np.nan]], [1.0])
    assert np.isnan(
        jax.jit(enumerate_lcp_solutions)(jnp.full((1, 1), np.nan), jnp.ones(1)).force
    ).all()


def solve_lcp_exactly(matrix, free_gap):
    """Return the forces of all solutions in rational arithmetic, by Gauss-Jordan elimination."""
    n = len(free_gap)
    solutions = set()
    for closed in itertools.chain.from_iterable(
        itertools.combinations(range(n), k) for k in range(n + 1)
    ):
        rows = [[Fraction(matrix[i][j]) for j in closed] + [-Fraction(free_gap[i])] for i in closed]
        for k in range(len(closed)):
            rows[k:] = sorted(rows[k:], key=lambda row: row[k] == 0)
            if rows[k][k] == 0:
                break
            rows[k] = [x / rows[k][k] for x in rows[k]]
            for i in set(range(len(closed))) - {k}:
                rows[i] = [x - rows[i][k] * y for x, y in zip(rows[i], rows[k], strict=True)]
        else:
            force = [Fraction(0)] * n
            for i, row in zip(closed, rows, strict=True):
                force[i] = row[-1]
            gap = [
                sum(Fraction(matrix[i][j]) * force[j] for j in range(n)) + Fraction(free_gap[i])
                for i in range(n)
            ]
            if min(force + gap) >= 0:
                solutions.add(tuple(map(float, force)))
    return sorted(solutions)


def test_units_of_forces_and_gaps_do_not_change_the_solutions_of_contact_problems():
    """All solutions equal those in rational arithmetic, also degenerate ones."""
    enumerate_solutions = jax.jit(enumerate_lcp_solutions)

    def count_solutions(matrix, free_gap, gap_units, force_units):
        expected = solve_lcp_exactly(matrix, free_gap)
        result = enumerate_solutions(
            gap_units[:, None] * matrix * force_units, gap_units * free_gap
        )
        assert int(result.status) == min(len(expected), LCPStatus.MULTIPLE_SOLUTIONS)
        found = np.asarray(result.candidate_forces)[result.is_solution] * force_units
        assert len(found) == len(expected)
        for force in expected:
            assert np.min(np.max(np.abs(found - force), axis=1)) <= 1e-12 * (1.0 + max(force))
        return len(expected)

    assert count_solutions(np.eye(5), -np.ones(5), np.ones(5), np.array([1] + 4 * [1 / 1500])) == 1
    for unit in (1e-12, 1.0, 1e12):
        matrix, free_gap = np.array([[-1.0, 1.0], [1.0, -2.0]]), np.array([2.0, -1.0])
        assert count_solutions(matrix, free_gap, np.ones(2), unit * np.ones(2)) == 2
    random = np.random.default_rng(0)
    counts = set()
    for _ in range(150):  # Powers of two from 1e-12 to 1e12 leave degenerate problems degenerate.
        units = 2.0 ** random.integers(-40, 41, (2, 3))
        entries = random.integers(-2, 3, (3, 4)).astype(float)
        counts.add(count_solutions(entries[:, :3], entries[:, 3], *units))
        entries = random.normal(size=(3, 4))
        counts.add(count_solutions(entries[:, :3], entries[:, 3], *units))
    assert counts >= {0, 1, 2, 3, 4}


def test_functions_may_contain_traced_integers_and_flags_in_jit():
    def position_after(time, x, n, is_stiff):
        force = lambda y: jnp.where(is_stiff, -4.0 * n * y[1], 0.0)
        oscillate = lambda y: jnp.stack([1.0 + 0.0 * y[0], y[2], force(y)])
        end = Guard(lambda y: time - y[0], lambda y: y)
        start = jnp.stack([0.0 * x, x, 0.0 * x])
        return simulate_hybrid((Mode(oscillate, (end,)),), start, events=1).state[1]

    differentiate = jax.jit(jax.jacfwd(position_after, argnums=1), static_argnums=0)
    # The frequency is 6 rad/s. The tolerance is a hundred times that of a solver step.
    assert float(differentiate(1.0, 1.0, 9, True)) == pytest.approx(np.cos(6.0), abs=1e-8)


@pytest.mark.parametrize("height", [1e-5, 1e-7, 1e-10, -1e-10])
def test_an_event_counts_even_if_its_guard_is_disarmed_soon_after(height):
    """A ball has its apex `height` above a table, below which its apexes do not count."""
    g, table = 9.81, 0.02
    fly = lambda y: jnp.stack([y[1], -g + 0.0 * y[0]])
    apex = Guard(lambda y: y[1], armed=lambda y: y[0] - table)
    floor = Guard(lambda y: y[0] + 0.01)
    speed = np.sqrt(2.0 * g * (table + height))
    ball = simulate_hybrid((Mode(fly, (apex, floor)),), jnp.array([0.0, speed]), events=1)
    fall = speed + np.sqrt(speed**2 + 2.0 * g * 0.01)
    assert int(ball.guards[0]) == (0 if height > 0.0 else 1)
    # Events are located to round-off.
    assert float(ball.times[0]) == pytest.approx((speed if height > 0.0 else fall) / g, abs=1e-13)


def test_an_armed_guard_that_is_negative_for_a_short_time_ends_its_mode():
    """Of two points on circles, the first is the guard, and the second arms it.

    Both fall below their levels for a short time, so that each may be the first to fall, and the
    first to rise again.
    """
    n, end_time = 2000, 3.0
    rng = np.random.default_rng(5)
    rates, levels = rng.uniform(1.0, 6.0, (n, 2)), 1.0 - 10.0 ** rng.uniform(-6.5, 0.0, (n, 2))
    half = np.arccos(levels) / rates  # of the duration below the level
    meeting = rng.uniform(0.5, 2.5, (n, 1)) + 1.05 * half * rng.uniform(-1.0, 1.0, (n, 2))
    phases = np.pi - rates * meeting
    is_start_clear = np.all(np.cos(phases) > 0.01 - levels, axis=1)

    @jax.vmap
    def simulate(rates, levels, state):
        guard = Guard(lambda y: y[0] + levels[0], armed=lambda y: -y[1] - levels[1])
        clock = Guard(lambda y: end_time - y[4])
        a, b = rates
        field = lambda y: jnp.stack([a * y[2], b * y[3], -a * y[0], -b * y[1], 1.0 + 0.0 * y[4]])
        mode = Mode(field, (guard, clock))
        return simulate_hybrid((mode,), state, events=1, options=TIGHT_OPTIONS)

    states = np.hstack([np.cos(phases), -np.sin(phases), np.zeros((n, 1))])
    times = np.asarray(simulate(rates, levels, states).times[:, 0])
    middles = meeting[..., None] + 2.0 * np.pi * np.arange(-4, 5) / rates[..., None]
    starts, stops = middles - half[..., None], middles + half[..., None]
    start = np.maximum(starts[:, 0, :, None], starts[:, 1, None, :])
    stop = np.minimum(stops[:, 0, :, None], stops[:, 1, None, :])
    counts = (start < stop) & (start > 0.0)
    first = np.min(np.where(counts, start, end_time), axis=(1, 2), initial=end_time)
    # Errors of the state of 1e-13 move a zero whose rate is 1e-3 by 1e-10.
    np.testing.assert_allclose(times[is_start_clear], first[is_start_clear], atol=1e-9)


def test_an_event_is_located_where_two_roots_attract_the_search_in_turn():
    """Newton's method for the guard and that for its arming lead to each other's start."""
    a, b, level, armed_level = 3.0659, 5.347, 0.444, -0.5595
    field = lambda y: jnp.stack([y[1], -(a**2) * y[0], y[3], -(b**2) * y[2]])
    guard = Guard(lambda y: y[0] + level, armed=lambda y: y[3] - armed_level)
    size, phase = np.array([0.5119, 0.9203]), np.array([4.428, 1.3231])
    position, velocity = size * np.cos(phase), -size * [a, b] * np.sin(phase)
    start = jnp.array([position[0], velocity[0], position[1], velocity[1]])
    end = simulate_hybrid((Mode(field, (guard,)),), start, events=1)
    expected = (3.0 * np.pi + np.arcsin(armed_level / (size[1] * b)) - phase[1]) / b
    assert position[0] + level > 0.0 > size[0] * np.cos(a * expected + phase[0]) + level
    # The tolerance is ten times that of the default options.
    assert float(end.times[0]) == pytest.approx(expected, abs=1e-7)
