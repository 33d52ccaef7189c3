"""Walks come to rest where plain ones do, in a fraction of the steps, and leaps are taken back."""

from unittest.mock import Mock

import numpy as np

import vrw_jax as vrw
from vrw_jax.answers.top import Ground, Stepped
from vrw_jax.answers.walking import BETWEEN, RESTS, ROUNDS, STEPS, led


def walked(one_step, start: float, hole: tuple[float, float] = (0.0, 0.0)):
    """Where a walk of one number and a code leads that no step may begin in the `hole`."""

    def step(lanes, x, n_steps=1):
        y = x.copy()
        for _ in range(n_steps):
            y[:, 0] = one_step(y[:, 0])
        lost = (hole[0] < x[:, 0]) & (x[:, 0] < hole[1])
        return Stepped(y, y, np.where(lost, int(vrw.Outcome.FELL_BACK), 0))

    ground = Mock(Ground, n=1, step=step, consistent=lambda x: x)
    ground.loosely.return_value = ground
    return led(ground, np.arange(1), np.array([[start, 0.0]]))


def test_a_walk_that_drifts_for_a_thousand_steps_comes_to_rest_in_ninety():
    walk = walked(lambda x: 0.3 + 0.995 * (x - 0.3), 1.3)
    assert walk.rests[0]
    assert abs(walk.x[0, 0] - 0.3) < RESTS  # the map's fixed point
    assert walk.n_steps[0] <= STEPS + ROUNDS * BETWEEN


def test_what_runs_away_or_turns_round_at_each_step_never_rests():
    assert not walked(lambda x: 1.003 * x, 1e-2).rests[0]
    assert not walked(lambda x: -x, 1e-2).rests[0]


def test_a_leap_to_where_no_step_begins_is_taken_back():
    walk = walked(lambda x: x - 1e-3, 0.6, hole=(-9.0, 0.5))
    assert walk.outcome[0] == vrw.Outcome.STEPPED
    assert abs(walk.x[0, 0] - (0.6 - 1e-3 * walk.n_steps[0])) < 1e-12


def test_a_gait_that_plain_walks_come_to_after_hundreds_of_steps_is_told():
    wheel = vrw.WheelParams(
        damping=211.6919, stiffness=594.5978, natural_length=1.0141, slope=0.3348
    )
    told = vrw.answer("speed", wheel, 1e-3, friction=50.1)
    # Walks of 200 steps, and Newton's method from their ends.
    alone = vrw.limit_cycle(wheel, model=vrw.UnilateralWheel(friction=50.1))
    assert abs(told.value - float(alone.speed)) < told.error < 1e-3
    assert told.n_steps < 120
