"""Units of length and time: in others a step is the same, and tells two columns of its Jacobian."""

import numpy as np
import pytest

import vrw_jax as vrw
from vrw_jax.models.scales import SCALES
from vrw_jax.wheel import DOMAINS, PARAMETER_NAMES

N = 64
TIGHT = vrw.Options.tight()
EVERY = ("section_state", *PARAMETER_NAMES)


def crowd():
    """Wheels like that of Table 1, starts, and units for each."""
    draw = np.random.default_rng(3)
    length, time = draw.uniform(0.2, 3.0, N), draw.uniform(0.5, 3.0, N)
    table = {name: np.full(N, float(getattr(vrw.WheelParams(), name))) for name in DOMAINS}
    table["damping"] = draw.uniform(100.0, 250.0, N)
    table["slope"] = draw.uniform(0.25, 0.35, N)
    start = np.array(vrw.paper_start()) * draw.uniform(0.95, 1.05, (N, 3))
    return table, start, length, time


def in_units(table, start, length, time):
    """The same wheels, with numbers in units so many times smaller."""
    powers = {"leg_com": 1, "locked_length": 1, "natural_length": 1, "gravity": 1}
    per_time = {"stiffness": 2, "damping": 1, "gravity": 2}
    told = {
        name: x * length ** powers.get(name, 0) / time ** per_time.get(name, 0)
        for name, x in table.items()
    }
    return told, start / np.stack([np.ones(N), time, time / length], 1)


def test_a_step_is_the_same_in_other_units():
    table, start, length, time = crowd()
    other, moved = in_units(table, start, length, time)
    one = vrw.steps(vrw.WheelParams(**table), start, options=TIGHT)
    same = vrw.steps(vrw.WheelParams(**other), moved, options=TIGHT)
    assert (one.outcome == vrw.Outcome.STEPPED).sum() > N / 2
    np.testing.assert_array_equal(same.outcome, one.outcome)
    units = np.stack([np.ones(N), time, time / length], 1)
    # Both engines' own 1e-12, in units up to six times smaller.
    np.testing.assert_allclose(same.section_state * units, one.section_state, rtol=0, atol=1e-11)
    np.testing.assert_allclose(same.durations / time[:, None], one.durations, rtol=0, atol=1e-11)


@pytest.mark.parametrize("name", [PARAMETER_NAMES[last] for last in SCALES])
def test_columns_that_units_tell_are_those_of_the_step(name):
    """Asked for by itself a column is carried through the step; with all others it is not."""
    table, start, length, time = crowd()
    other, moved = in_units(table, start, length, time)
    params = vrw.WheelParams(**other)
    every = vrw.steps(params, moved, options=TIGHT, derivatives=EVERY)
    alone = vrw.steps(params, moved, options=TIGHT, derivatives=(name,))
    both = every.derivatives[name], alone.derivatives[name]
    for part in ("section_state", "durations"):
        told, carried = (getattr(by, part) for by in both)
        size = np.abs(carried).max(0)
        # Derivatives are right to some 1e-11 of their size; sums of five terms lose a digit.
        assert np.max(np.abs(told - carried) / size) < 1e-9
        assert np.all(size > 1e-3)
