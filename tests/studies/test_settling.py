"""Walks settle where walks without leaps do, in a fraction of the steps, and leaps are undone."""

from unittest.mock import Mock

import numpy as np

import vrw_jax as vrw
from vrw_jax.studies.fidelity import (
    MAX_LEAPS,
    MAX_SETTLED_DRIFT,
    N_STEPS_PER_LEAP,
    N_WARMUP_STEPS,
    ContactWheelBatch,
    StepQuantities,
    walk_until_settled,
)


def walk_scalar_map(one_step, start: float, failing_interval: tuple[float, float] = (0.0, 0.0)):
    """Where a walk of one number and a code leads that no step may begin in the `hole`."""

    def step(indices, x, n_steps=1):
        y = x.copy()
        for _ in range(n_steps):
            y[:, 0] = one_step(y[:, 0])
        has_failed = (failing_interval[0] < x[:, 0]) & (x[:, 0] < failing_interval[1])
        return StepQuantities(y, y, np.where(has_failed, int(vrw.Outcome.FELL_BACK), 0))

    map_on_ground = Mock(ContactWheelBatch, n_legs=1, take_steps=step)
    map_on_ground.make_walk_batch.return_value = map_on_ground
    return walk_until_settled(map_on_ground, np.arange(1), np.array([[start, 0.0]]))


def test_a_walk_that_drifts_for_a_thousand_steps_settles_in_ninety():
    walk = walk_scalar_map(lambda x: 0.3 + 0.995 * (x - 0.3), 1.3)
    assert walk.has_settled[0]
    fixed_point = 0.3
    assert abs(walk.section_states[0, 0] - fixed_point) < MAX_SETTLED_DRIFT
    max_steps = N_WARMUP_STEPS + MAX_LEAPS * N_STEPS_PER_LEAP
    assert walk.n_steps[0] <= max_steps


def test_divergent_and_alternating_walks_never_settle():
    assert not walk_scalar_map(lambda x: 1.003 * x, 1e-2).has_settled[0]
    assert not walk_scalar_map(lambda x: -x, 1e-2).has_settled[0]


def test_a_leap_to_a_state_without_a_step_is_undone():
    walk = walk_scalar_map(lambda x: x - 1e-3, 0.6, failing_interval=(-9.0, 0.5))
    assert walk.walk_outcomes[0] == vrw.Outcome.STEPPED
    assert abs(walk.section_states[0, 0] - (0.6 - 1e-3 * walk.n_steps[0])) < 1e-12


def test_a_gait_that_plain_walks_reach_after_hundreds_of_steps_is_found():
    wheel = vrw.WheelParams(
        damping=211.6919, stiffness=594.5978, natural_length=1.0141, slope=0.3348
    )
    measured = vrw.measure_to_tolerance("speed", wheel, 1e-3, friction=50.1)
    # Walks of 200 steps, and Newton's method from their ends.
    cycle = vrw.limit_cycle(wheel, model=vrw.UnilateralWheel(friction=50.1))
    assert abs(measured.value - float(cycle.speed)) < measured.error < 1e-3
    assert measured.n_steps < 120
