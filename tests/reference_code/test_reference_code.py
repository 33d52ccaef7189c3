"""The references satisfy their equations, agree with each other and reproduce the stored values."""

from __future__ import annotations

import json
import math
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from . import five_coordinates
from . import five_coordinates_equations as equations
from .constrained_wheel import Wheel
from .margins import mass_velocities

REFERENCE = json.loads(Path(__file__).with_name("reference_values.json").read_text())
CASES = {case["name"]: case for case in REFERENCE["cases"]}


def _params(case: dict[str, Any]) -> dict[str, float]:
    return {key: float(value) for key, value in case["params"].items()}


def _floats(values: Any) -> np.ndarray:
    return np.array(values, dtype=object).astype(float)


def _random_state(seed: int) -> tuple[np.ndarray, np.ndarray]:
    draw = np.random.default_rng(seed)
    q = np.array([0.0, 0.0, -0.3, 0.9, 0.8]) + 0.2 * draw.standard_normal(5)
    return q, draw.standard_normal(5)


@pytest.mark.parametrize("seed", range(3))
def test_mass_matrix_is_that_of_the_kinetic_energy_of_the_point_masses(seed: int) -> None:
    q, v = _random_state(seed)
    wheel = Wheel(five_coordinates.TABLE_1)
    velocities = mass_velocities(wheel, q, v)
    masses = [five_coordinates.TABLE_1["hub_mass"]] + [five_coordinates.TABLE_1["leg_mass"]] * 8
    expected = 0.5 * sum(m * float(u @ u) for m, u in zip(masses, velocities, strict=True))
    assert wheel.kinetic(q, v) == pytest.approx(expected, rel=1e-14)
    quadratic = 0.5 * v @ np.array(equations.mass_matrix(q, wheel.pack)) @ v
    assert quadratic == pytest.approx(expected, rel=1e-14)


@pytest.mark.parametrize("seed", range(3))
def test_contact_jacobian_is_the_derivative_of_the_feet(seed: int) -> None:
    q, _ = _random_state(seed)
    pack = Wheel(five_coordinates.TABLE_1).pack
    expected = five_coordinates.jacobian(lambda s: np.array(equations.feet(s, pack)), q, 1e-3)
    np.testing.assert_allclose(equations.jacobian(q, pack), expected, atol=1e-11)


@pytest.mark.parametrize("name", CASES)
def test_the_step_agrees_with_the_reference(name: str) -> None:
    case = CASES[name]
    reference = case["step"]
    step_result = five_coordinates.step(_params(case), _floats(reference["start"]))
    assert step_result["outcome"] == five_coordinates.STEPPED
    for key in ("section_state", "post_impact", "durations", "step_length"):
        np.testing.assert_allclose(step_result[key], _floats(reference[key]), rtol=0, atol=5e-13)
    indicators = [step_result["lambda_impulse"][3], *step_result["lambda_plus"][[1, 3]]]
    names = ("lambda_impulse_4", "lambda2_plus", "lambda4_plus")
    np.testing.assert_allclose(indicators, [float(reference[n]) for n in names], rtol=0, atol=1e-11)
    assert abs(step_result["energy_residual"]) < 1e-11
    assert step_result["constraint_residual"] < 1e-12


@pytest.mark.slow
def test_the_limit_cycle_agrees_with_the_reference() -> None:
    reference = CASES["table_1"]["cycle"]
    cycle = five_coordinates.limit_cycle(five_coordinates.TABLE_1, five_coordinates.START)
    for key in ("section_state", "post_impact", "durations", "period", "dls_fraction", "speed"):
        np.testing.assert_allclose(cycle[key], _floats(reference[key]), rtol=0, atol=5e-13)
    assert cycle["spectral_radius"] == pytest.approx(float(reference["spectral_radius"]), abs=1e-9)


@pytest.mark.parametrize("name", CASES)
def test_two_formulations_agree_in_22_digits(name: str) -> None:
    assert all(float(value) < 1e-22 for value in CASES[name]["disagreement"].values())


# Exponents of mass, length and time of each parameter, start, and measure.
SCALES = {
    "hub_mass": (1, 0, 0),
    "leg_mass": (1, 0, 0),
    "leg_com": (0, 1, 0),
    "locked_length": (0, 1, 0),
    "natural_length": (0, 1, 0),
    "stiffness": (1, 0, -2),
    "damping": (1, 0, -1),
    "slope": (0, 0, 0),
    "gravity": (0, 1, -2),
}
SECTION = [(0, 0, 0), (0, 0, -1), (0, 1, -1)]
TIMES = [(0, 0, 1)] * 3


def _assert_euler(
    value: str, powers: tuple[int, ...], terms: list[tuple[str, str, tuple[int, ...]]]
) -> None:
    """Sum of power * argument * derivative = power * value, for mass, length and time."""
    for unit in range(3):
        parts = [power[unit] * Decimal(x) * Decimal(slope) for x, slope, power in terms]
        scale = max(map(abs, parts))
        assert abs(sum(parts) - powers[unit] * Decimal(value)) < scale * Decimal("1e-22")


@pytest.mark.parametrize("name", CASES)
def test_derivatives_of_the_reference_obey_the_scaling_laws_in_22_digits(name: str) -> None:
    case = CASES[name]
    arguments = [
        (case["params"][key], SCALES[key]) for key in REFERENCE["provenance"]["parameter_order"]
    ]
    one, cycle = case["step"], case["cycle"]
    starts = list(zip(one["start"], SECTION, strict=True))
    for key, powers in (("section_state", SECTION), ("durations", TIMES)):
        for i, value in enumerate(one[key]):
            slopes = one[f"d_{key}_d_start"][i] + one[f"d_{key}_d_params"][i]
            pairs = zip(starts + arguments, slopes, strict=True)
            _assert_euler(value, powers[i], [(x, slope, power) for (x, power), slope in pairs])
    measures = [
        *zip(cycle["post_impact"], SECTION[:2], cycle["d_params"]["post_impact"], strict=True),
        *zip(cycle["durations"], TIMES, cycle["d_params"]["durations"], strict=True),
    ]
    for key, power in (
        ("period", (0, 0, 1)),
        ("dls_fraction", (0, 0, 0)),
        ("speed", (0, 1, -1)),
        ("step_length", (0, 1, 0)),
        ("spectral_radius", (0, 0, 0)),
    ):
        measures.append((cycle[key], power, cycle["d_params"][key]))
    for value, power, slopes in measures:
        pairs = zip(arguments, slopes, strict=True)
        _assert_euler(value, power, [(x, slope, scale) for (x, scale), slope in pairs])


@pytest.mark.slow
def test_newtons_law_on_the_point_masses_gives_the_multipliers() -> None:
    solution = five_coordinates.step_margins(five_coordinates.TABLE_1, five_coordinates.START)
    assert solution["newton_residual"] < 1e-9
    assert solution["lambda2"]["DLS"] == pytest.approx(103.898, abs=1e-2)


@pytest.mark.parametrize(
    ("changes", "x", "outcome"),
    [
        ({}, (0.103, 2.0, -0.109), five_coordinates.TOUCHDOWN_EARLY),
        ({"slope": 0.02}, (0.05, 1.0, -0.1), five_coordinates.FELL_BACK),
        ({"damping": 4.0}, (0.0445, 2.75, -0.9), five_coordinates.LIFTED_OFF),
        ({}, (math.nan, 1.6, -0.1), five_coordinates.BAD_INPUT),
        ({}, (0.4, 1.6, -0.1), five_coordinates.BAD_INPUT),  # Leg 1 would be longer than L0
    ],
)
def test_a_failed_step_reports_its_cause(
    changes: dict[str, float], x: tuple[float, float, float], outcome: str
) -> None:
    step_result = five_coordinates.step({**five_coordinates.TABLE_1, **changes}, x)
    assert step_result["outcome"] == outcome
    assert np.all(np.isnan(step_result["section_state"]))


def test_a_landing_that_would_pull_leg_2_releases_it() -> None:
    step_result = five_coordinates.step(five_coordinates.TABLE_1, (-0.1, 1.6, -0.1))
    assert step_result["lambda_impulse"][3] < 0  # (A3)
    assert step_result["lambda_impulse_applied"][3] == 0
    q, _, after = step_result["landing"]
    pack = Wheel(five_coordinates.TABLE_1).pack
    assert (np.array(equations.jacobian(q, pack)) @ after)[3] > 0
    assert step_result["phases"][0].duration == 0


def test_a_landing_without_load_on_leg_2_skips_double_support() -> None:
    step_result = five_coordinates.step(five_coordinates.TABLE_1, (0.103, 2.0, -0.109))
    assert step_result["lambda_impulse"][3] > 0 > step_result["lambda_plus"][3]  # (B3)
    assert step_result["phases"][0].duration == 0
    assert step_result["phases"][1].duration > 0
