"""Events of a phase, on flows with event times in closed form."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vrw_jax as vrw
from vrw_jax import lanes
from vrw_jax.hybrid import GuardsAndMargins, integrate_phase

TIGHT_OPTIONS = vrw.StepOptions.tight()


def clock_field(y):
    """Return the rates of y = (t, s), with t the time and s a second coordinate: t' = 1, s' = cos
    t."""
    return jnp.stack([jnp.ones_like(y[0]), jnp.cos(y[0])])


def find_phase_end(
    guards, start=(0.0, 0.0), field=clock_field, monitors=(), count_start=(), options=TIGHT_OPTIONS
):
    """Integrate with guards given as functions of the state."""
    values = lambda y: jnp.stack([g(y) for g in (*guards, *monitors)])
    watched = GuardsAndMargins(values, len(guards), count_start)
    integrate = lambda start: integrate_phase(field, watched, start, jnp.asarray(True), options)
    return lanes.jit(integrate)(jnp.asarray(start))


def test_the_earliest_guard_wins_whatever_its_place_in_the_list():
    late_guard, early_guard = lambda y: 2.0 - y[0], lambda y: 1.0 - y[0]
    for guards, index in [((late_guard, early_guard), 1), ((early_guard, late_guard), 0)]:
        end = find_phase_end(guards)
        assert int(end.end_guard_index) == index
        assert abs(float(end.duration) - 1.0) < 1e-14


def test_the_earliest_of_two_guards_inside_one_step_wins():
    # Both cross within 1e-9 s: far less than a step.
    first, second = lambda y: 1.0 - y[0], lambda y: 1.0 + 1e-9 - y[0]
    assert int(find_phase_end((second, first)).end_guard_index) == 1
    assert abs(float(find_phase_end((second, first)).duration) - 1.0) < 1e-14


def test_simultaneous_guards_give_the_first_in_the_list():
    compute_same = lambda y: 1.0 - y[0]
    twice = lambda y: 2.0 - 2.0 * y[0]
    assert int(find_phase_end((compute_same, twice)).end_guard_index) == 0
    assert int(find_phase_end((twice, compute_same)).end_guard_index) == 0


@pytest.mark.parametrize("jump_time", [0.3, 0.5, 0.7, 1.1, 1.3, 1.7])
def test_a_guard_that_jumps_below_zero_ends_the_phase_and_no_other_guard(jump_time):
    """A guard without a rate has no Newton step; the end is still its own."""
    positive, jumping = lambda y: 1.0 + y[0], lambda y: jnp.where(y[0] < jump_time, 1.0, -1.0)
    end = find_phase_end((positive, jumping))
    assert int(end.end_guard_index) == 1
    assert abs(float(end.duration) - jump_time) < 1e-9


def test_an_event_has_the_accuracy_of_the_integrator():
    # s = sin t falls through 0 at pi; the guard sees only the integrated s.
    for tolerance in (1e-6, 1e-9, 1e-12):
        options = vrw.StepOptions(rtol=tolerance, atol=tolerance)
        end = find_phase_end(
            (lambda y: y[1] + 1e-300,), (1e-3, float(np.sin(1e-3))), options=options
        )
        assert abs(float(end.duration) + 1e-3 - np.pi) < tolerance
        assert abs(float(end.state[1])) < 1e-15  # on the event to round-off


def test_a_guard_that_grazes_from_above_does_not_fire():
    margin = 1e-6
    grazing = lambda y: 1.0 + margin + y[1]  # lowest, margin, at t = 3 pi / 2
    end = find_phase_end((grazing, lambda y: 8.0 - y[0]))
    assert int(end.end_guard_index) == 1
    assert abs(float(end.duration) - 8.0) < 1e-12


@pytest.mark.parametrize("depth", [1e-2, 1e-4, 1e-6, 1e-8])
def test_a_guard_that_dips_below_zero_within_one_step_fires(depth):
    dipping = lambda y: 1.0 - depth + y[1]  # below zero around t = 3 pi / 2
    end = find_phase_end((dipping, lambda y: 8.0 - y[0]))
    assert int(end.end_guard_index) == 0
    reference = np.pi + np.arcsin(1.0 - depth)
    # A graze turns an error of s (1e-13) into one of its square root's conditioning.
    assert abs(float(end.duration) - reference) < 1e-12 / np.sqrt(depth)


def test_a_phase_that_starts_on_a_falling_guard_ends_at_once():
    end = find_phase_end((lambda y: -y[0],))
    assert int(end.end_guard_index) == 0
    assert float(end.duration) == 0.0


def test_a_phase_that_starts_past_a_guard_ends_at_once():
    end = find_phase_end((lambda y: y[0] - 1.0,))
    assert int(end.end_guard_index) == 0
    assert float(end.duration) == 0.0


def test_a_guard_that_starts_at_zero_and_rises_fires_only_when_it_comes_back():
    end = find_phase_end((lambda y: y[1],))  # sin t: zero and rising at t = 0, back at pi
    assert int(end.end_guard_index) == 0
    assert abs(float(end.duration) - np.pi) < 1e-12


@pytest.mark.parametrize("height", [1e-2, 1e-5, 1e-10])
def test_a_guard_that_rises_from_zero_and_comes_back_within_the_first_step_fires(height):
    arc = lambda y: jnp.stack([y[1], -jnp.ones_like(y[1])])  # up at rate v, back after 2 v
    end = find_phase_end((lambda y: y[0],), start=(0.0, height), field=arc)
    assert int(end.end_guard_index) == 0
    assert abs(float(end.duration) / (2.0 * height) - 1.0) < 1e-14


def test_a_tiny_phase_is_integrated_and_not_skipped():
    for length in (1e-6, 1e-9, 1e-12):
        end = find_phase_end((lambda y, length=length: length - y[0],))
        assert int(end.end_guard_index) == 0
        assert abs(float(end.duration) - length) < 1e-15


def test_event_time_and_state_have_accurate_first_and_second_derivatives():
    # Fall from height z0 with rate v0: z = z0 + v0 t - t^2 / 2, landing at v0 + sqrt(v0^2 + 2 z0).
    @lanes.jit
    def land(z):
        field = lambda y: jnp.stack([y[1], -jnp.ones_like(y[1])])
        watched = GuardsAndMargins(lambda y: y[:1], 1)
        end = integrate_phase(field, watched, z, jnp.asarray(True), TIGHT_OPTIONS)
        return jnp.stack([end.duration, end.state[1]])

    def closed(z):
        root = jnp.sqrt(z[1] ** 2 + 2.0 * z[0])
        return jnp.stack([z[1] + root, -root])

    z = jnp.asarray([0.7, 0.3])
    np.testing.assert_allclose(land(z), closed(z), rtol=1e-13)
    np.testing.assert_allclose(jax.jacfwd(land)(z), jax.jacfwd(closed)(z), rtol=1e-11)
    second, reference = jax.jacfwd(jax.jacfwd(land))(z), jax.jacfwd(jax.jacfwd(closed))(z)
    np.testing.assert_allclose(second, reference, rtol=1e-10, atol=1e-12)


def test_a_margin_has_its_minimum_to_the_accuracy_of_the_integrator():
    # Lowest value of sin t + t / 10 on (0, 8): where cos t = -1/10, after pi.
    minimum_time = 2.0 * np.pi - np.arccos(-0.1)
    reference = np.sin(minimum_time) + minimum_time / 10.0
    end = find_phase_end(
        (lambda y: 8.0 - y[0],), monitors=(lambda y: y[1] + y[0] / 10.0,), count_start=(True,)
    )
    assert abs(float(end.margin_minima[0]) - reference) < 1e-12


def test_a_margin_that_starts_at_zero_counts_from_its_next_minimum():
    # t^2 (2 - t)... rises from rest at zero: without its start the minimum is at the end.
    height = lambda y: 1.0 - jnp.cos(y[0])
    stop = lambda y: 2.0 - y[0]
    counted = find_phase_end((stop,), monitors=(height,), count_start=(True,))
    ignored = find_phase_end((stop,), monitors=(height,), count_start=(False,))
    assert float(counted.margin_minima[0]) == 0.0
    assert abs(float(ignored.margin_minima[0]) - (1.0 - np.cos(2.0))) < 1e-12


def test_reaching_the_time_limit_is_a_code():
    options = vrw.StepOptions(max_phase_time=0.5)
    end = find_phase_end((lambda y: 1.0 - y[0],), options=options)
    assert bool(end.is_timed_out)
    assert int(end.end_guard_index) == -1


def test_a_divergent_flow_fails_with_finite_values():
    explode = lambda y: y * y
    end = find_phase_end((lambda y: 1e30 - y[0],), start=(1.0, 1.0), field=explode)
    assert bool(end.has_integration_failed) or int(end.end_guard_index) == 0
    assert np.all(np.isfinite(np.asarray(end.state)))


def test_an_inactive_phase_costs_nothing():
    watched = GuardsAndMargins(lambda y: 1.0 - y[:1], 1)
    end = jax.jit(
        lambda y: integrate_phase(clock_field, watched, y, jnp.asarray(False), TIGHT_OPTIONS)
    )(jnp.zeros(2))
    assert int(end.solver_steps) == 0
    assert float(end.duration) == 0.0
