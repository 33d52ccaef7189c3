"""A step and a gait are the same in other units, and units give two columns of a Jacobian."""

import numpy as np
import pytest
from support.slow_variants import ENGINES, mark_slow

import vrw_jax as vrw
from vrw_jax.models.walk_batch import UNIT_SCALING_BY_PARAMETER_INDEX
from vrw_jax.wheel import PARAMETER_DOMAINS, PARAMETER_NAMES

N = 64
TIGHT_OPTIONS = vrw.StepOptions.tight()
ALL_INPUT_NAMES = ("section_state", *PARAMETER_NAMES)


def random_batch():
    """Return wheels similar to that of Table 1, starts, and units for each."""
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
    """Return the same wheels in other units of length and time."""
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


UNIT_SCALED_NAMES = [PARAMETER_NAMES[last] for last in UNIT_SCALING_BY_PARAMETER_INDEX]


@pytest.mark.parametrize("name", mark_slow(*UNIT_SCALED_NAMES))
def test_tangents_derived_from_units_equal_those_of_the_step(name):
    """A single column is propagated through the step; with all columns, units give two of them."""
    table, start, length, time = random_batch()
    other, shifted = rescale_units(table, start, length, time)
    params = vrw.WheelParams(**other)
    every = vrw.step_batch(params, shifted, options=TIGHT_OPTIONS, derivatives=ALL_INPUT_NAMES)
    batch_result = vrw.step_batch(params, shifted, options=TIGHT_OPTIONS, derivatives=(name,))
    both_sensitivities = every.derivatives[name], batch_result.derivatives[name]
    for part in ("section_state", "durations"):
        result, carried = (getattr(by_input, part) for by_input in both_sensitivities)
        size = np.abs(carried).max(0)
        # Derivatives are right to some 1e-11 of their size; sums of five terms lose a digit.
        assert np.max(np.abs(result - carried) / size) < 1e-9
        assert np.all(size > 1e-3)


SCALES = [
    ("mass", 1e-12), ("mass", 1e-6), ("mass", 1e-4), ("mass", 1e6),
    ("length", 1e-12), ("length", 1e-6), ("length", 1e6),
    ("time", 1e-12), ("time", 1e-6), ("time", 1e-3), ("time", 1e3), ("time", 1e6),
]  # fmt: skip
"""Factors of one unit."""
GROUND = vrw.UnilateralWheel(friction=0.7)
DAMPED_WHEEL = vrw.WheelParams(damping=250.0)


def scale_wheel(unit, factor, params=DAMPED_WHEEL):
    """Return the similar wheel and the factors of its rates and speeds."""
    time = factor if unit == "time" else 1.0
    speed = factor if unit == "length" else 1.0 / time
    return params.scaled(**{unit: factor}), 1.0 / time, speed


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("scale", SCALES, ids=str)
def test_a_step_is_the_same_in_units_of_any_size(scale, engine):
    """With unilateral contact and without. Reference: the same step in SI."""
    for model in (GROUND, None):
        params, rate, speed = scale_wheel(*scale)
        start = np.array(vrw.paper_start()) * [1.0, rate, speed]
        options = vrw.StepOptions(engine=engine)
        here = vrw.step(params, start, model=model, options=options)
        there = vrw.step(DAMPED_WHEEL, vrw.paper_start(), model=model, options=options)
        assert int(here.outcome) == vrw.Outcome.STEPPED
        own = np.asarray(here.section_state[:2]) / [1.0, rate]
        np.testing.assert_allclose(own, there.section_state[:2], rtol=0, atol=1e-11)
        np.testing.assert_allclose(here.durations * rate, there.durations, rtol=0, atol=1e-11)


@pytest.mark.parametrize(
    "scale", [SCALES[0], *mark_slow(*((x,) for x in SCALES[1:-1])), SCALES[-1]], ids=str
)
def test_gaits_are_the_same_in_units_of_any_size(scale):
    """Both gaits with unilateral contact, and the paper's. Reference: those in SI."""
    cases = [
        (DAMPED_WHEEL, {"model": GROUND, "which": "slowest"}),
        (DAMPED_WHEEL, {"model": GROUND, "which": "fastest"}),
        (vrw.WheelParams(), {}),
    ]
    for table, arguments in cases:
        params, _, speed = scale_wheel(*scale, table)
        here, there = (vrw.limit_cycle(wheel, **arguments) for wheel in (params, table))
        assert bool(here.found)
        assert float(here.speed) / speed == pytest.approx(float(there.speed), rel=1e-10)
        radius = float(there.spectral_radius)
        assert float(here.spectral_radius) == pytest.approx(radius, rel=1e-7)


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("model", [GROUND, None], ids=["unilateral", "paper"])
def test_the_time_limit_of_a_phase_scales_with_the_unit_of_time(model, engine):
    """In milliseconds a phase of this wheel lasts longer than the limit's number of seconds."""
    params, rate, _ = scale_wheel("time", 1e3)
    start = np.array(vrw.paper_start()) * [1.0, rate, rate]
    for limit, outcome in ((1.0, "STEPPED"), (0.1, "NO_TOUCHDOWN_IN_TIME")):
        options = vrw.StepOptions(engine=engine, max_phase_time=limit)
        result = vrw.step(params, start, model=model, options=options)
        assert vrw.Outcome(int(result.outcome)).name == outcome


def test_columns_with_unilateral_contact_are_the_same_in_small_units_of_length():
    """The rank of the directions in which rates change a start does not depend on units."""
    jacobians = []
    for factor in (1.0, 1e-12):
        params, _, speed = scale_wheel("length", factor)
        start = np.array(vrw.paper_start())[None] * [1.0, 1.0, speed]
        result = vrw.step_batch(params, start, model=GROUND, derivatives=("section_state",))
        units = np.array([1.0, 1.0, *[speed] * 18])
        by_start = result.derivatives["section_state"].section_state[0, :20, :20]
        jacobians.append(by_start * units / units[:, None])
    np.testing.assert_allclose(jacobians[1], jacobians[0], rtol=0, atol=1e-9)
