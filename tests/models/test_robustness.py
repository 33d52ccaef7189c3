"""Any parameters and any start give an outcome and finite numbers, and raise no exception."""

import equinox as eqx
import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.batched import BATCH_SIZE, NAMES, compute_full_steps
from support.slow_variants import mark_slow

import vrw_jax as vrw

RANGES = {
    "hub_mass": (0.0, 100.0),
    "leg_mass": (0.02, 10.0),
    "leg_com": (0.0, 0.99),
    "locked_length": (0.3, 3.0),
    "natural_length": (0.5, 3.0),
    "stiffness": (0.0, 1e4),
    "damping": (0.0, 2e3),
    "slope": (-1.0, 1.0),
    "gravity": (0.1, 30.0),
}
any_float = st.floats(allow_nan=True, allow_infinity=True, width=64)
sensible_parameters = st.tuples(*(st.floats(*RANGES[name]) for name in NAMES))
any_parameters = st.tuples(*(any_float for _ in NAMES))
start = st.tuples(st.floats(-1.0, 1.0), st.floats(0.0, 10.0), st.floats(-5.0, 5.0))
OPTIONS = vrw.StepOptions(rtol=1e-6, atol=1e-6, max_solver_steps=2000)


def assert_valid_outcomes(lanes, by_lanes):
    rows = map(np.asarray, zip(*lanes, strict=True))
    result = compute_full_steps(*rows, OPTIONS, uses_lane_engine=by_lanes)
    assert np.all(np.isin(result.outcome, list(vrw.Outcome)))
    # The friction that collision II requires is infinite where the ground would have to pull.
    stopper_friction = result.required_friction.stopper
    assert not np.any(np.isnan(stopper_friction))
    others = eqx.tree_at(lambda step: step.required_friction.stopper, result, result.step_length)
    for leaf in jax.tree.leaves(others):
        assert np.all(np.isfinite(leaf))
    step_result = np.asarray(result.outcome) == vrw.Outcome.STEPPED
    assert np.all(np.asarray(result.durations) >= 0.0)
    assert np.all(np.asarray(result.section_state)[step_result, 1] > 0.0)


def make_batch(vector, x):
    """Return a batch of sixteen lanes with neighbors of every kind."""
    return st.lists(st.tuples(vector, x), min_size=BATCH_SIZE, max_size=BATCH_SIZE)


PARAMETRIZE_BY_ENGINE = pytest.mark.parametrize(
    "by_lanes", [*mark_slow(False), True], ids=["diffrax", "lanes"]
)


@PARAMETRIZE_BY_ENGINE
@settings(max_examples=5, deadline=None)
@given(lanes=make_batch(sensible_parameters, start))
def test_every_wheel_gets_an_outcome(by_lanes, lanes):
    assert_valid_outcomes(lanes, by_lanes)


@PARAMETRIZE_BY_ENGINE
@settings(max_examples=10, deadline=None)
@given(lanes=make_batch(any_parameters, st.tuples(any_float, any_float, any_float)))
def test_every_invalid_input_gets_an_outcome(by_lanes, lanes):
    assert_valid_outcomes(lanes, by_lanes)
