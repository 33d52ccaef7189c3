"""Compare the walker with SciPy, which solves equations that are written down once more here."""

import jax
import my_walker
import numpy as np
from scipy.integrate import solve_ivp

import vrw_jax as vrw

vrw.start_jax()
PARAMS = my_walker.Params()


def hop_with_scipy(velocity):
    """Return the velocity at the next touchdown, m/s, and the duration of the hop, s."""
    p, time = PARAMS, 0.0
    state = np.array([p.length, velocity])
    for thrust, event, direction in (
        (0.0, lambda t, y: y[1], 1.0),  # the lowest point
        (p.thrust, lambda t, y: y[0] - p.length, 1.0),  # take-off
    ):

        def accelerate(t, y, thrust=thrust):
            spring, damper = p.stiffness * (p.length - y[0]), p.damping * y[1]
            return [y[1], (spring - damper + thrust) / p.mass - p.gravity]

        event.terminal, event.direction = True, direction
        solution = solve_ivp(
            accelerate, (0.0, 10.0), state, events=event, rtol=1e-12, atol=1e-12, method="DOP853"
        )
        time, state = time + solution.t[-1], solution.y[:, -1]
    return -state[1], time + 2.0 * state[1] / p.gravity


def test_a_step_is_that_of_scipy():
    step = my_walker.walker.step(PARAMS, my_walker.guess)
    velocity, duration = hop_with_scipy(my_walker.guess[0])
    assert abs(step.section_state[0] - velocity) < 1e-8
    assert abs(step.duration - duration) < 1e-8


def test_the_gait_repeats_and_its_multiplier_is_the_slope_of_the_return_map():
    gait = my_walker.find_gait(PARAMS)
    velocity = float(gait.section_state[0])
    assert abs(hop_with_scipy(velocity)[0] - velocity) < 1e-8
    h = 1e-4
    slope = (hop_with_scipy(velocity + h)[0] - hop_with_scipy(velocity - h)[0]) / (2.0 * h)
    assert abs(gait.multipliers[0].real - slope) < 1e-6


def test_derivatives_are_differences():
    def measure_height(thrust):
        params = my_walker.Params(thrust=thrust)
        return my_walker.measure_height(params, my_walker.find_gait(params))

    difference = (measure_height(401.0) - measure_height(399.0)) / 2.0
    assert abs(jax.grad(measure_height)(400.0) - difference) < 1e-6


def test_the_figure_is_drawn(tmp_path):
    my_walker.draw(tmp_path / "figure.png")
    assert (tmp_path / "figure.png").stat().st_size > 1000
