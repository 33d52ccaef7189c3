"""The documented face: any field, guards and resets; closed forms, and what it refuses."""

import re
from pathlib import Path

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest

import vrw_jax as vrw
from vrw_jax.numerics import (
    Answers,
    Guard,
    Mode,
    Stop,
    complementary,
    newton_cycle,
    product_multipliers,
    segment_maps,
    time_errors,
    volume_change,
    walk,
)

PAGE = Path(__file__).parents[2] / "docs" / "any_system.md"
TIGHT = vrw.Options.tight()
G = 9.81


def fall(y):
    return jnp.stack([y[1], -G + 0.0 * y[1]])


def ball(restitution=0.8):
    return Mode(
        fall,
        (Guard(lambda y: y[0], lambda y: jnp.stack([0.0 * y[0], -restitution * y[1]])),),
    )


def code(told):
    return Stop(int(told.stop))


def test_the_page_s_examples_print_what_it_says(capsys, monkeypatch):
    monkeypatch.setattr(vrw, "start_jax", lambda: None)
    blocks = re.findall(r"```python\n(.*?)```\n\n```text\n(.*?)```", PAGE.read_text(), re.DOTALL)
    assert len(blocks) == PAGE.read_text().count("```python")
    assert len([x for x in blocks[0][0].splitlines() if x]) <= 10
    names = {}
    for source, printed in blocks:
        exec(source, names)
        assert capsys.readouterr().out == printed


@pytest.mark.parametrize("restitution", [0.2, 0.5, 0.9])
def test_a_ball_bounces_until_the_clock_stands_still(restitution):
    told = walk([ball(restitution)], [1.0, 0.0], events=600, options=TIGHT)
    n = int(told.n_events)
    powers = restitution ** np.arange(n)
    truth = np.sqrt(2.0 / G) * (1.0 + 2.0 * restitution * (1.0 - powers) / (1.0 - restitution))
    assert code(told) == Stop.EVENTS_PILE_UP
    np.testing.assert_allclose(told.times[:n], truth, rtol=1e-14)
    end = np.sqrt(2.0 / G) * (1.0 + restitution) / (1.0 - restitution)
    assert abs(float(told.time) - end) < 1e-14 * end


def test_event_times_have_the_closed_form_s_derivatives():
    third = lambda height: walk(
        [ball()], jnp.stack([height, 0.0 * height]), events=3, options=TIGHT
    ).times[2]
    truth = lambda height: jnp.sqrt(2.0 * height / G) * (1.0 + 2.0 * (0.8 + 0.64))
    np.testing.assert_allclose(jax.jacfwd(third)(1.3), jax.grad(truth)(1.3), rtol=1e-12)


def test_modes_follow_each_other_as_their_guards_say():
    # A thermostat: up with rate 2, down with rate 1, between 0 and 1.
    heat = Mode(lambda y: jnp.full_like(y, 2.0), (Guard(lambda y: 1.0 - y[0], to=1),))
    cool = Mode(lambda y: jnp.full_like(y, -1.0), (Guard(lambda y: y[0], to=0),))
    told = walk([heat, cool], [0.5], events=5, options=TIGHT)
    assert code(told) == Stop.EVENTS_DONE
    np.testing.assert_array_equal(told.modes, [0, 1, 0, 1, 0])
    np.testing.assert_allclose(told.times, [0.25, 1.25, 1.75, 2.75, 3.25], rtol=1e-14)


def test_a_walk_in_a_batch_is_the_walk_alone():
    heights = jnp.array([0.5, 1.0, 2.0])
    one = lambda height: walk([ball()], jnp.stack([height, 0.0 * height]), events=4)
    many = jax.vmap(one)(heights)
    for i, height in enumerate(heights):
        np.testing.assert_allclose(many.times[i], one(height).times, rtol=1e-13)


@pytest.mark.parametrize("height", [-1e-17, 1e-17, 0.0])
def test_a_start_that_is_a_rounding_off_its_guard_is_on_it(height):
    told = walk([ball()], [height, 1.0], events=1, options=TIGHT)
    assert code(told) == Stop.EVENTS_DONE
    assert abs(float(told.time) - 2.0 / G) < 1e-14


@pytest.mark.parametrize("depth", [0.5, 1e-4, 1e-8])
def test_the_resolution_of_a_grazed_guard_s_time_follows_the_closed_form(depth):
    # The height of a throw at g = 1 above a ceiling that it passes by `depth`: 1/2 - depth.
    throw = lambda y: jnp.stack([y[1], -1.0 + 0.0 * y[1]])
    mode = Mode(throw, (Guard(lambda y: 0.5 - depth - y[0]),))
    told = jax.vmap(lambda y: walk((mode,), y, events=2, options=TIGHT))(jnp.array([[0.0, 1.0]]))
    rate, tolerance = np.sqrt(2.0 * depth), 1e-13 * (1.0 + 0.5 - depth)
    np.testing.assert_allclose(told.resolution[0, 0], tolerance / rate, rtol=1e-6)
    assert abs(float(told.times[0, 0]) - (1.0 - rate)) <= float(told.resolution[0, 0])


@pytest.mark.parametrize("depth", [1e-4, 1e-8])
def test_where_one_rounding_moves_an_event_more_than_its_digits_the_walk_says_so(depth):
    """A point of the unit circle dips below a line; 50 digits, about data a rounding off."""
    turn = Mode(lambda y: jnp.stack([-y[1], y[0]]), (Guard(lambda y: y[1] + (1.0 - depth)),))
    options = vrw.Options(rtol=1e-15, atol=1e-15)
    told = walk([turn], [1.0, 0.0], events=1, options=options)
    with mpmath.workdps(50):
        line = 1 - mpmath.mpf(depth)
        met = lambda radius: mpmath.mpf(3) / 2 * mpmath.pi - mpmath.acos(line / radius)
        moved = float(abs(met(1 + mpmath.mpf(2) ** -52) - met(1)))
        wrong = float(abs(mpmath.mpf(float(told.times[0])) - met(1)))
    np.testing.assert_allclose(told.rounding[0], moved, rtol=1e-3)
    assert (moved > 1e-12) == (depth == 1e-8)
    assert wrong < max(1e-12, 2.0 * float(told.rounding[0]))


def switching(rate):
    """ARGESIM's C5: a fast state that follows a slow one and switches it at 5.8 and 2.5. What is
    left of the fast exponential at a switch is below exp(-900)."""
    slow, levels = 3.5651205, ((0.4, 5.5, 5.8), (-0.3, 2.73, 2.5))
    modes = [
        Mode(
            lambda y, a=a, b=b: jnp.stack([rate * (y[1] + a - y[0]), slow * (b - y[1])]),
            (Guard(lambda y, at=at, sign=1.0 - 2.0 * k: sign * (at - y[0]), to=1 - k),),
        )
        for k, (a, b, at) in enumerate(levels)
    ]
    y, times = 0.3, []
    for k in range(6):
        a, b, at = levels[k % 2]
        times.append(np.log((y - b) * rate / (rate - slow) / (at - a - b)) / slow)
        y = b + (y - b) * np.exp(-slow * times[-1])
    return modes, [4.2, 0.3], np.cumsum(times)


def crossing(field, start, behind, angle, events):
    """Guards on y[0] = 1/2 both ways, of y[0] that falls there at `behind` + `angle` + 2 pi k."""
    halves = [Guard(lambda y: y[0] - 0.5, to=1), Guard(lambda y: 0.5 - y[0], to=0)]
    turns = 2.0 * np.pi * np.repeat(np.arange(events), 2)[1 : events + 1]
    signs = np.tile([angle, -angle], events)[:events]
    return [Mode(field, (half,)) for half in halves], start, turns + signs + behind


def following(rate):
    """y' = rate (cos t - y) of a rotation: its cosine, a little smaller and later."""
    field = lambda y: jnp.stack([rate * (y[1] - y[0]), -y[2], y[1]])
    size = rate**2 / (1.0 + rate**2)  # cos of the lag times the amplitude
    angle = np.arccos(0.5 / np.sqrt(size))
    return crossing(field, [size, 1.0, 0.0], np.arctan(1.0 / rate), angle, 20)


def attracted(rate):
    """Prothero and Robinson's: y = cos t, to which the field pulls."""
    field = lambda y: jnp.stack([-rate * (y[0] - jnp.cos(y[1])) - jnp.sin(y[1]), 1.0 + 0.0 * y[1]])
    return crossing(field, [1.0, 0.0], 0.0, np.pi / 3.0, 10)


@pytest.mark.parametrize(
    ("stiff", "rate", "solver"),
    [
        (switching, 2.7e6, "Kvaerno5"),
        (switching, 1e3, "Kvaerno5"),
        (following, 1e6, "Kvaerno5"),
        (attracted, 1e3, "Kvaerno4"),
    ],
)
def test_event_times_of_implicit_solvers_are_within_what_is_stated(stiff, rate, solver):
    modes, start, truth = stiff(rate)

    @jax.jit
    def both(tolerance):
        options = vrw.Options(solver, rtol=tolerance, atol=tolerance, max_phase_time=100.0)
        told = walk(modes, start, events=len(truth), options=options)
        return told, time_errors(modes, start, told, options)

    beyond = []
    for tolerance in (1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 1e-10):
        told, stated = both(jnp.asarray(tolerance))
        n = int(told.n_events)  # one of the walks ends early: a rounding off its guard, GUARD_PAST
        wrong = np.abs(told.times[:n] - truth[:n])
        assert n > 1
        assert np.all(wrong <= stated[:n]), tolerance
        beyond.append(np.max(wrong / told.resolution[:n]))
    # One event's resolution is no bound: errors add up, and the solver's estimate leaves some out.
    assert max(beyond) > 3.0


def test_an_event_time_s_error_is_twice_its_resolution_at_least_and_infinite_past_another_event():
    told = walk([ball()], [1.0, 0.0], events=4, options=TIGHT)
    stated = lambda told: time_errors([ball()], [1.0, 0.0], told, TIGHT)
    np.testing.assert_array_equal(stated(told), 2.0 * told.resolution)  # a fall has no error
    other = told._replace(guards=told.guards.at[2].set(1), n_events=told.n_events - 1)
    np.testing.assert_array_equal(np.isinf(stated(other)), [False, False, True, False])
    assert stated(other)[3] == 0.0  # no event


def impacting(depth):
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


@pytest.mark.parametrize("depth", [1e-2, 1e-6])
def test_at_a_graze_the_product_of_multipliers_keeps_its_digits(depth):
    modes, start, kept = impacting(depth)

    def back(x):
        return walk(modes, jnp.stack([1.0 + 0.0 * x[0], *x]), events=1, options=TIGHT).state[1:]

    found = newton_cycle(lambda x: back(x) - jnp.array([0.0, np.pi]), start[1:], tolerance=1e-11)
    assert found.converged
    start = jnp.stack([1.0, *found.x])
    told = walk(modes, start, events=1, options=TIGHT)
    # Area shrinks by the restitution twice: of the rate, and of the time at which it passes.
    assert abs(float(volume_change(modes, start, told, TIGHT)) - kept**2) < 1e-15
    lost = abs(float(jnp.linalg.det(found.jacobian)) - kept**2)
    assert (lost > 1e-12) == (depth == 1e-6)


def test_what_newton_s_method_tells_repeats_where_the_map_jumps_next_to_it():
    """x to x^2, whose points are 0 and 1, with a hole around 0 in which x leads to 7."""
    leaps = lambda x: jnp.where(jnp.abs(x) < 1e-15, 7.0, x**2)
    cycle = newton_cycle(leaps, jnp.array([1e-5]), tolerance=1e-9)
    assert cycle.converged
    assert abs(cycle.x[0] - 1.0) < 1e-12
    assert cycle.residual < 1e-12


def test_volumes_shrink_by_friction_and_by_every_bounce():
    """x' = v, v' = -g - v: exp(-t) in all, and r² at each bounce."""
    drag = lambda y: jnp.stack([y[1], -G - y[1]])
    floor = Guard(lambda y: y[0], lambda y: jnp.stack([0.0 * y[0], -0.5 * y[1]]))
    start = jnp.array([1.0, 0.0])
    told = walk([Mode(drag, (floor,))], start, events=5, options=TIGHT)
    found = jax.jit(lambda y: volume_change([Mode(drag, (floor,))], y, told, TIGHT))(start)

    def moved(y):
        """With the time held: states past the fifth event flow for a moment more."""
        own = walk([Mode(drag, (floor,))], y, events=5, options=TIGHT)
        late = told.time - own.time
        return own.state + late * drag(own.state)

    # The saltation matrix of each event, by differentiating through its time.
    np.testing.assert_allclose(found, jnp.linalg.det(jax.jacfwd(moved)(start)), rtol=1e-9)


@pytest.mark.parametrize(("bend", "time"), [(1.0, 3.0), (-1.0, 0.0)])
def test_a_guard_at_rest_on_zero_fires_only_if_it_does_not_rise(bend, time):
    """h = bend t²/2 − t³/6, from h = h' = 0."""
    mode = Mode(lambda y: jnp.stack([y[1], y[2], -1.0 + 0.0 * y[2]]), (Guard(lambda y: y[0]),))
    told = walk((mode,), (0.0, 0.0, bend), events=1, options=TIGHT)
    assert code(told) == Stop.EVENTS_DONE
    np.testing.assert_allclose(told.times[0], time, atol=1e-12)


def test_what_goes_wrong_on_the_way_is_a_code():
    assert code(walk([ball()], [-1.0, 0.0], events=3)) == Stop.GUARD_PAST
    short = vrw.Options(max_phase_time=0.1)
    assert code(walk([ball()], [1.0, 0.0], events=3, options=short)) == Stop.TIME_OVER
    few = vrw.Options(max_solver_steps=2)
    told = walk([ball()], [1.0, 0.0], events=3, options=few)
    assert code(told) == Stop.STEPS_SPENT
    assert int(told.n_events) == 0
    sinks = Mode(lambda y: -0.5 / y, (Guard(lambda y: y[0] + 1.0),))  # sqrt(1 - t), then nothing
    assert code(walk([sinks], [1.0], events=1)) == Stop.STUCK
    assert np.all(np.isfinite(walk([sinks], [1.0], events=1).state))
    into = Mode(fall, (Guard(lambda y: y[0], lambda y: jnp.stack([y[0] - 1.0, -y[1]])),))
    told = walk([into], [1.0, 0.0], events=3)
    assert (code(told), int(told.n_events)) == (Stop.GUARD_PAST, 1)
    assert all(len(stop.meaning) > 20 for stop in Stop)


@pytest.mark.parametrize(
    ("modes", "start", "sentence"),
    [
        ([Mode(lambda y: y[:1], ball().guards)], [1.0, 0.0], r"field of mode 0 gives .*\(1,\)"),
        ([Mode(lambda y: (y[1], -G), ball().guards)], [1.0, 0.0], "field of mode 0 gives tuple"),
        ([Mode(fall, (Guard(lambda y: y),))], [1.0, 0.0], r"guard 0 of mode 0 gives .*\(2,\)"),
        ([Mode(fall, (Guard(lambda y: y[0] > 0),))], [1.0, 0.0], "guard 0 of mode 0 gives bool"),
        (
            [Mode(fall, (Guard(lambda y: y[0], lambda y: -y[1]),))],
            [1.0, 0.0],
            r"reset of guard 0 of mode 0 gives .*\(\)",
        ),
        ([Mode(fall, ())], [1.0, 0.0], "mode 0 has no guard"),
        ([Mode(fall, (Guard(lambda y: y[0], to=3),))], [1.0, 0.0], "leads to mode 3"),
        ([ball()], [[1.0, 0.0]], "one row of numbers"),
        ([ball()], [np.nan, 0.0], "not finite"),
        ([Mode(fall, (fall,))], [1.0, 0.0], "a guard is .* give Guard"),
    ],
)
def test_what_can_not_be_walked_is_one_sentence(modes, start, sentence):
    with pytest.raises((ValueError, TypeError), match=sentence):
        walk(modes, start, events=2)


def decaying(y):
    x1, x2, t = y
    return jnp.stack([x2, -10 * jnp.cos(t) * x1 - (24 + 10 * jnp.sin(t)) * x2, 1.0 + 0.0 * t])


def test_multipliers_of_a_product_keep_every_digit_or_say_that_they_do_not():
    cut = lambda n: segment_maps(decaying, jnp.zeros(3), 2 * np.pi, n, TIGHT, directions=2)
    told = product_multipliers(cut(200).maps)
    assert np.all(told.known)
    np.testing.assert_allclose(told.values, [1.0, np.exp(-48 * np.pi)], rtol=1e-12)
    assert abs(float(cut(200).divergence) + 48 * np.pi) < 1e-12
    whole = product_multipliers(cut(1).maps)
    np.testing.assert_array_equal(whole.known, [True, False])
    assert abs(whole.values[0] - 1.0) < 1e-12
    assert np.isnan(whole.values[1])


@pytest.mark.parametrize("n_segments", [1, 2, 7, 10, 100])
def test_a_narrow_contraction_keeps_its_digits_in_one_segment(n_segments):
    """r' = g(t) (r² - 1)/(2 r) about r = 1: exp of the mean of g, 1 - 2 times Poisson's kernel."""
    q = 0.97

    def poisson(t):
        half = jnp.sin(0.5 * (t - np.pi))
        return 1.0 - 2.0 * (1.0 - q) * (1.0 + q) / ((1.0 - q) ** 2 + 4.0 * q * half * half)

    field = lambda y: jnp.stack([0.5 * poisson(y[1]) * (y[0] ** 2 - 1.0) / y[0], 1.0 + 0.0 * y[1]])
    cut = segment_maps(field, [1.0, 0.0], 2.0 * np.pi, n_segments, TIGHT, directions=1)
    told = product_multipliers(cut.maps)
    np.testing.assert_allclose(told.values[0].real, np.exp(-2.0 * np.pi), rtol=1e-12)


@pytest.mark.parametrize("size", [1, 2, 4, 6])
def test_multipliers_of_products_agree_with_those_of_the_product(size):
    random = np.random.default_rng(size)
    for _ in range(20):
        maps = np.eye(size) + 0.3 * random.normal(size=(4, size, size))
        truth = np.linalg.eigvals(np.linalg.multi_dot(maps[::-1]))
        found = product_multipliers(maps).values
        gap = np.abs(found[:, None] - truth[None])
        assert max(gap.min(0).max(), gap.min(1).max()) < 1e-9 * np.abs(truth).max()


def test_a_singular_factor_hides_one_multiplier_and_leaves_the_others():
    told = product_multipliers([[[1.0, 2.0], [0.5, 1.0]], [[1.0, 0.0], [0.0, 2.0]]])
    np.testing.assert_array_equal(told.known, [True, False])
    assert abs(told.values[0] - 3.0) < 1e-14
    assert told.logarithms[1] < -30.0


def test_segments_and_products_refuse_wrong_shapes_in_a_sentence():
    with pytest.raises(ValueError, match=r"maps has shape \(2, 2\)"):
        product_multipliers(np.eye(2))
    spent = segment_maps(decaying, jnp.zeros(3), 9.0, 1, vrw.Options(max_solver_steps=3), 2)
    with pytest.raises(ValueError, match="not finite: the flow left its domain, or its steps"):
        product_multipliers(spent.maps)
    with pytest.raises(ValueError, match="directions is 4"):
        segment_maps(decaying, jnp.zeros(3), 1.0, 2, TIGHT, directions=4)
    with pytest.raises(ValueError, match="row of the same length"):
        segment_maps(lambda y: y[:1], jnp.zeros(3), 1.0, 2, TIGHT)


def test_contacts_have_one_answer_several_or_none():
    answers = lambda matrix, free: Answers(int(complementary(matrix, free).answers))
    assert answers([[1.0]], [-1.0]) == Answers.ONE
    assert answers([[-1.0]], [1.0]) == Answers.SEVERAL
    assert answers([[-1.0]], [-1.0]) == Answers.NONE
    assert np.isnan(complementary([[-1.0]], [-1.0]).force).all()
    random = np.random.default_rng(0)
    for _ in range(10):  # a positive definite matrix: one answer, by the quadratic programme
        root = random.normal(size=(3, 3))
        matrix, free = root @ root.T + 0.1 * np.eye(3), random.normal(size=3)
        told = complementary(matrix, free)
        assert int(told.answers) == Answers.ONE
        assert float(jnp.min(told.force)) >= 0.0
        assert float(jnp.min(told.gap)) >= -1e-12
        np.testing.assert_allclose(told.force * told.gap, 0.0, atol=1e-12)
        np.testing.assert_allclose(told.gap, matrix @ told.force + free, atol=1e-12)
    with pytest.raises(ValueError, match=r"free \(2,\)"):
        complementary(np.eye(3), np.zeros(2))
    with pytest.raises(ValueError, match="not finite"):
        complementary([[np.nan]], [1.0])
    assert np.isnan(jax.jit(complementary)(jnp.full((1, 1), np.nan), jnp.ones(1)).force).all()
