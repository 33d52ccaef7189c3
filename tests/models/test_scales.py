"""Units of length and time: in others a step is the same, and tells two columns of its Jacobian."""

import numpy as np
import pytest

import vrw_jax as vrw
from vrw_jax.models.unit_scaling import SCALING_BY_PARAMETER
from vrw_jax.wheel import PARAMETER_DOMAINS, PARAMETER_NAMES

N = 64
TIGHT_OPTIONS = vrw.StepOptions.tight()
ALL_INPUT_NAMES = ("section_state", *PARAMETER_NAMES)


def random_batch():
    """Wheels like that of Table 1, starts, and units for each."""
    draw = np.random.default_rng(3)
    length, time = draw.uniform(0.2, 3.0, N), draw.uniform(0.5, 3.0, N)
    table = {
        name: np.full(N, float(getattr(vrw.WheelParams(), name))) for name in PARAMETER_DOMAINS
    }
    table["damping"] = draw.uniform(100.0, 250.0, N)
    table["slope"] = draw.uniform(0.25, 0.35, N)
    start = np.array(vrw.paper_start()) * draw.uniform(0.95, 1.05, (N, 3))
    return table, start, length, time


def rescale_units(table, start, length, time):
    """The same wheels, with numbers in units so many times smaller."""
    powers = {"leg_com": 1, "locked_length": 1, "natural_length": 1, "gravity": 1}
    per_time = {"stiffness": 2, "damping": 1, "gravity": 2}
    result_by_name = {
        name: x * length ** powers.get(name, 0) / time ** per_time.get(name, 0)
        for name, x in table.items()
    }
    return result_by_name, start / np.stack([np.ones(N), time, time / length], 1)


def test_a_step_is_the_same_in_other_units():
    table, start, length, time = random_batch()
    other, shifted = rescale_units(table, start, length, time)
    one = vrw.step_batch(vrw.WheelParams(**table), start, options=TIGHT_OPTIONS)
    batch_result = vrw.step_batch(vrw.WheelParams(**other), shifted, options=TIGHT_OPTIONS)
    assert (one.outcome == vrw.Outcome.STEPPED).sum() > N / 2
    np.testing.assert_array_equal(batch_result.outcome, one.outcome)
    units = np.stack([np.ones(N), time, time / length], 1)
    # Both engines' own 1e-12, in units up to six times smaller.
    np.testing.assert_allclose(
        batch_result.section_state * units, one.section_state, rtol=0, atol=1e-11
    )
    np.testing.assert_allclose(
        batch_result.durations / time[:, None], one.durations, rtol=0, atol=1e-11
    )


@pytest.mark.parametrize("name", [PARAMETER_NAMES[last] for last in SCALING_BY_PARAMETER])
def test_tangents_derived_from_units_equal_those_of_the_step(name):
    """Asked for by itself a column is carried through the step; with all others it is not."""
    table, start, length, time = random_batch()
    other, shifted = rescale_units(table, start, length, time)
    params = vrw.WheelParams(**other)
    every = vrw.step_batch(params, shifted, options=TIGHT_OPTIONS, derivatives=ALL_INPUT_NAMES)
    batch_result = vrw.step_batch(params, shifted, options=TIGHT_OPTIONS, derivatives=(name,))
    both_values = every.derivatives[name], batch_result.derivatives[name]
    for part in ("section_state", "durations"):
        result, carried = (getattr(by_input, part) for by_input in both_values)
        size = np.abs(carried).max(0)
        # Derivatives are right to some 1e-11 of their size; sums of five terms lose a digit.
        assert np.max(np.abs(result - carried) / size) < 1e-9
        assert np.all(size > 1e-3)
