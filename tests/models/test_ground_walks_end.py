"""Walks with unilateral contact end for physical reasons only, and alike at every tolerance."""

import math

import jax.numpy as jnp
import numpy as np
import pytest
from reference_code import complementarity
from scipy.integrate import solve_ivp
from support.slow_variants import mark_slow

import vrw_jax as vrw
from vrw_jax.flow.event_location import _propose_earliest_event
from vrw_jax.models import compute_leg_directions
from vrw_jax.models.contact_integrator import PAINLEVE_ATOL, PAINLEVE_RTOL_FACTOR

N_WHEELS, N_STEPS = 128, 60
HIGH_FRICTION, INFINITE_FRICTION = np.linspace(1.0, 3.0, N_WHEELS), np.full(N_WHEELS, math.inf)
FALL_OUTCOMES = {22: vrw.Outcome.NO_TOUCHDOWN_IN_TIME, 68: vrw.Outcome.FELL_BACK}
PARADOX_OUTCOMES = dict.fromkeys((78, 85, 90, 105, 121, 123, 126), vrw.Outcome.PAINLEVE_PARADOX)
"""Wheels of `experiments.ground.survey` that end, at infinite and at high friction."""


def draw_wheels():
    """Return the wheels of `experiments.ground.survey`."""
    draw = np.random.default_rng(0).uniform
    params = vrw.WheelParams(damping=draw(20.0, 400.0, N_WHEELS), slope=draw(0.1, 0.34, N_WHEELS))
    limits = (0.05, 0.15), (0.8, 2.2), (-0.3, 0.0)
    return params, np.stack([draw(*bounds, N_WHEELS) for bounds in limits], 1)


def find_walk_ends(friction, stoppers, tolerance, **settings):
    """Return the outcomes of the wheels that do not walk all steps."""
    params, starts = draw_wheels()
    model = vrw.UnilateralWheel(friction=friction, stoppers=stoppers, **settings)
    options = vrw.StepOptions(solver="Tsit5", rtol=tolerance, atol=tolerance)
    outcomes = np.asarray(
        vrw.step_batch(params, starts, N_STEPS, model=model, options=options).outcome
    )
    return {int(i): outcomes[i] for i in np.flatnonzero(outcomes)}


@pytest.mark.parametrize("tolerance", [1e-6, *mark_slow(1e-8, 1e-10)])
def test_outcomes_of_walks_do_not_depend_on_the_tolerance(tolerance):
    assert find_walk_ends(INFINITE_FRICTION, "bilateral", tolerance) == FALL_OUTCOMES
    assert find_walk_ends(HIGH_FRICTION, "bilateral", tolerance) == PARADOX_OUTCOMES


@pytest.mark.slow
@pytest.mark.parametrize("tolerance", [1e-6, 1e-12])
def test_outcomes_with_one_sided_stoppers_do_not_depend_on_the_tolerance(tolerance):
    """Without patience ten of 6,827 steps were lost at 1e-12 and high friction (see `ledger`).

    At infinite friction and 1e-12, some chains of events are longer than 400, which is the default.
    """
    ends = find_walk_ends(INFINITE_FRICTION, "one-sided", tolerance, max_events=4000)
    assert ends == FALL_OUTCOMES
    assert find_walk_ends(HIGH_FRICTION, "one-sided", tolerance) == PARADOX_OUTCOMES


def test_the_painleve_paradox_occurs_at_the_singularity_of_another_code():
    """Forces jump there; the determinant that vanishes does not."""
    (params, starts), place = draw_wheels(), 123
    parameter_values = [float(x[place]) for x in (params.damping, params.slope, HIGH_FRICTION)]
    wheel = complementarity.ComplementarityWheel(
        parameter_values[2], c=parameter_values[0], slope=parameter_values[1]
    )
    start = complementarity.paper_start(wheel, *starts[place])
    begin, _ = complementarity._process_event(wheel, start, 0, None)
    halves, modes = lambda y: (y[:11], y[11:]), (begin.mode, begin.is_locked)

    def rates(_, y):
        return np.r_[y[11:], complementarity._solve_contact_forces(wheel, *halves(y), *modes)[0]]

    def left(_, y):
        return complementarity.is_singular(wheel, *halves(y), *modes) - 1e-6

    left.terminal = True
    y = np.r_[begin.q, begin.v]
    method_name = solve_ivp(rates, (0.0, 1.0), y, "DOP853", events=left, rtol=1e-12, atol=1e-12)
    time, y = method_name.t[-1], method_name.y[:, -1]
    slope = -left(time, y - 1e-7 * rates(time, y)) / 1e-7  # the last bit by a straight line
    model = vrw.UnilateralWheel(friction=parameter_values[2])
    params = vrw.WheelParams(damping=parameter_values[0], slope=parameter_values[1])
    for tolerance in (1e-6, 1e-10):
        options = vrw.StepOptions(rtol=tolerance, atol=tolerance)
        step = vrw.step(params, starts[place], model=model, options=options)
        assert int(step.outcome) == vrw.Outcome.PAINLEVE_PARADOX
        # It ends where no more is left than `march.SINGULAR` says, of what falls by 0.8 a second.
        left_over = (PAINLEVE_ATOL + PAINLEVE_RTOL_FACTOR * tolerance) / 0.8
        assert abs(step.durations.sum() - (time - 1e-6 / slope)) < 1.1 * left_over


def test_leg_directions_are_accurate_after_any_number_of_turns():
    s = vrw.WheelParams().symbols()
    for theta in np.linspace(-20.0, 20.0, 41):
        legs, angles = (
            compute_leg_directions(s, jnp.asarray(theta)),
            theta + s.alpha * np.arange(s.n),
        )
        np.testing.assert_allclose(legs.sin, np.sin(angles), atol=1e-14)
        np.testing.assert_allclose(legs.cos, np.cos(angles), atol=1e-14)


def test_a_guard_that_is_already_negative_precedes_falling_guards():
    """The first stands on its own event, rises and is below at the end; the second falls there."""
    column = lambda *values: jnp.asarray(values)[:, None]
    time, guard_index = _propose_earliest_event(
        column(-1e-7, -0.1), column(1e-7, -1.1), column(True, True)
    )
    assert (time[0], guard_index[0]) == (-jnp.inf, 0)
