"""Walks settle on gaits, and a walk that ends keeps its last state near a gait."""

from types import SimpleNamespace

import numpy as np

import vrw_jax as vrw
from vrw_jax.gaits import gait_walks

N_COORDINATES = 3
FIXED_POINT = np.array([0.1, 1.5, -0.1])
"""Fixed point of the map that replaces a step, rad, rad/s, m/s."""


def walk_by_linear_map(monkeypatch, multiplier, last_step=10**9):
    """Return the ends of walks of the map x -> FIXED_POINT + multiplier (x - FIXED_POINT).

    The walks fail after `last_step` steps.
    """
    n_taken = 0

    def take_steps(finder, values, states, n_steps):
        nonlocal n_taken
        n_taken += n_steps if n_steps > finder.period_n else 0
        outcome = vrw.Outcome.STEPPED if n_taken <= last_step else vrw.Outcome.FELL_BACK
        end_states = FIXED_POINT + multiplier**n_steps * (states - FIXED_POINT)
        return end_states, np.full(len(states), int(outcome))

    monkeypatch.setattr(gait_walks, "_simulate_wheel_walks", take_steps)
    finder = SimpleNamespace(
        model=vrw.ViscoelasticWheel(),
        n_legs=8,
        period_n=1,
        complete_section_states=lambda values, states: states,
    )
    values = np.asarray(vrw.ViscoelasticWheel().collect_parameter_values(vrw.WheelParams()))[None]
    starts = (FIXED_POINT + 0.01 * np.ones(N_COORDINATES))[None, None]
    return gait_walks.walk_to_gaits(finder, values, lambda params: starts)


def test_a_walk_stops_after_the_round_in_which_it_settles(monkeypatch):
    _, section_states, period_defects = walk_by_linear_map(monkeypatch, 0.5)
    first_round = gait_walks.N_WALK_STEPS_BY_ROUND[0]
    np.testing.assert_allclose(section_states[0], FIXED_POINT + 0.5**first_round * 0.01)
    assert period_defects[0] < gait_walks.MAX_SETTLED_DEFECT


def test_a_walk_that_ends_keeps_its_last_state_near_a_repelling_gait(monkeypatch):
    """The multiplier is 1.2. The state after the first round is usable, and the walk ends later."""
    _, section_states, period_defects = walk_by_linear_map(monkeypatch, 1.2, last_step=10)
    np.testing.assert_allclose(section_states[0], FIXED_POINT + 1.2**8 * 0.01)
    assert 0.0 < period_defects[0] < gait_walks.MAX_NEWTON_START_DEFECT
