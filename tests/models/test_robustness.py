"""Whatever the parameters and the start: an outcome, finite numbers, no exception."""

import jax
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from support.batched import NAMES, SIZE, full_steps

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
anything = st.floats(allow_nan=True, allow_infinity=True, width=64)
sensible = st.tuples(*(st.floats(*RANGES[name]) for name in NAMES))
wild = st.tuples(*(anything for _ in NAMES))
start = st.tuples(st.floats(-1.0, 1.0), st.floats(0.0, 10.0), st.floats(-5.0, 5.0))
OPTIONS = vrw.Options(rtol=1e-6, atol=1e-6, max_solver_steps=2000)


def check(lanes):
    result = full_steps(*map(np.asarray, zip(*lanes, strict=True)), OPTIONS)
    assert np.all(np.isin(result.outcome, list(vrw.Outcome)))
    for leaf in jax.tree.leaves(result):
        assert np.all(np.isfinite(leaf))
    stepped = np.asarray(result.outcome) == vrw.Outcome.STEPPED
    assert np.all(np.asarray(result.durations) >= 0.0)
    assert np.all(np.asarray(result.section_state)[stepped, 1] > 0.0)


def batches(vector, x):
    """Sixteen lanes at a time: neighbours of every kind."""
    return st.lists(st.tuples(vector, x), min_size=SIZE, max_size=SIZE)


@settings(max_examples=15, deadline=None)
@given(lanes=batches(sensible, start))
def test_every_wheel_gets_an_outcome(lanes):
    check(lanes)


@settings(max_examples=10, deadline=None)
@given(lanes=batches(wild, st.tuples(anything, anything, anything)))
def test_even_nonsense_gets_an_outcome(lanes):
    check(lanes)
