"""Every way a step can end has a code, a wheel that provokes it, and disturbs nobody."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import truth
from support.batched import (
    GAIT,
    IN_TIME,
    PROVOKED,
    TABLE_1,
    full_steps,
    jacobians,
    lean_steps,
    wheels_like,
)

import vrw_jax as vrw
from vrw_jax import Outcome


@pytest.mark.parametrize("outcome", PROVOKED, ids=lambda o: o.name)
def test_each_outcome_is_provoked(outcome):
    vectors, start = PROVOKED[outcome]
    result = full_steps(vectors, start)
    assert Outcome(int(result.outcome[0])) is outcome


def test_no_touchdown_in_time_is_a_code():
    longest = float(np.max(full_steps(wheels_like(), GAIT).durations))
    for share, outcome in IN_TIME:  # within one solver step of the phase's end
        result = full_steps(wheels_like(), GAIT, vrw.Options(max_phase_time=share * longest))
        assert int(result.outcome[0]) == outcome


def test_a_solver_that_runs_out_of_steps_is_a_code():
    stiff = vrw.WheelParams(damping=1e8)  # explicit steps of nanoseconds
    result = vrw.step(stiff, GAIT)
    assert int(result.outcome) == Outcome.SOLVER_GAVE_UP
    assert int(result.solver_steps) >= vrw.Options().max_solver_steps


@pytest.mark.parametrize(
    "start", [[np.nan, 1.6, -0.1], [0.1, np.inf, -0.1], [0.1, -1.0, -0.1], [2.0, 1.0, 0.0]], ids=str
)
def test_a_start_that_is_no_section_state_is_bad_input(start):
    assert int(full_steps(wheels_like(), start).outcome[0]) == Outcome.BAD_INPUT


def test_every_outcome_has_a_name_and_one_sentence():
    for outcome in Outcome:
        assert outcome.meaning.endswith(".")
        assert outcome.meaning.count(".") == 1


def test_failing_lanes_do_not_disturb_their_neighbours():
    bad = [vectors[0] for vectors, _ in PROVOKED.values()]
    starts = [np.asarray(start) for _, start in PROVOKED.values()]
    among = full_steps(np.stack(bad), np.stack(starts))
    alone = full_steps(wheels_like(), GAIT)
    for mixed, single in zip(jax.tree.leaves(among), jax.tree.leaves(alone), strict=True):
        # A vmapped loop may fuse differently: round-off, a few 1e-14 relative.
        np.testing.assert_allclose(mixed[0], single[0], rtol=5e-14, atol=5e-14)


def test_failing_lanes_yield_finite_values_and_derivatives():
    vectors = jnp.asarray(np.stack([v[0] for v, _ in PROVOKED.values()]))
    starts = jnp.asarray(np.stack([np.asarray(x) for _, x in PROVOKED.values()]))
    pad = 16 - len(PROVOKED)
    vectors = jnp.concatenate([vectors, jnp.tile(TABLE_1, (pad, 1))])
    starts = jnp.concatenate([starts, jnp.tile(GAIT, (pad, 1))])
    result = full_steps(vectors, starts)
    for leaf in jax.tree.leaves(result):
        assert np.all(np.isfinite(leaf))
    by_parameter, by_start = jacobians(vectors, starts, vrw.Options())
    assert np.all(np.isfinite(by_parameter))
    assert np.all(np.isfinite(by_start))
    clean, _ = jacobians(jnp.tile(TABLE_1, (16, 1)), jnp.tile(GAIT, (16, 1)), vrw.Options())
    np.testing.assert_allclose(by_parameter[0], clean[0], rtol=1e-12, atol=1e-12)


def test_a_step_that_failed_leaves_zeros_which_are_no_section_state():
    vectors, start = PROVOKED[Outcome.FELL_BACK]
    result = full_steps(vectors, start)
    assert np.all(np.asarray(result.section_state) == 0.0)


def test_a_walk_stops_at_its_first_failure():
    walk = vrw.walk(vrw.WheelParams(slope=0.09, damping=100.0), [0.1027, 2.0, -0.109], 12)
    assert int(walk.outcome) == Outcome.FELL_BACK
    stepped = int(walk.n_stepped)
    assert 0 < stepped < 12
    outcomes = np.asarray(walk.steps.outcome)
    assert np.all(outcomes[:stepped] == Outcome.STEPPED)
    assert np.all(outcomes[stepped:] == Outcome.FELL_BACK)


def test_a_lane_in_a_batch_equals_the_single_run():
    starts = truth.table("step", "start")
    batch, _ = lean_steps(truth.PARAMETERS, starts, vrw.Options())
    for index in (0, 3, 9):
        params = truth.wheel(truth.PARAMETERS[index])
        single = vrw.return_map(params, starts[index])
        np.testing.assert_allclose(batch[index, :3], single, rtol=5e-14, atol=5e-14)
