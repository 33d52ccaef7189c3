"""Make ``reference.json``: steps, limit cycles and their derivatives to 22 digits and more.

Values and derivatives come from ``HubForm``; derivatives are central differences at
``DIGITS`` digits with relative steps of 1e-14, second ones included, so that their truncation is
near 1e-28 of the next even derivative. ``MultiplierForm``, which shares no equation with it,
recomputes every value, the multipliers, and the derivative along one direction in which all
starts and parameters move at once (of the step's section state and durations, and of the cycle's
durations and spectral radius), with differences of another size. The largest disagreements are
stored with each case; the script refuses to write a case in which fewer than 22 digits agree.

Run ``python -m reference_code.make_reference_values`` in ``tests/`` (some 20 minutes on one core).
``--only NAME`` recomputes single cases and keeps the others.
"""

from __future__ import annotations

import argparse
import json
import platform
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import heyoka
import mpmath as mp
import numpy as np
import scipy

from . import five_coordinates as double
from .constrained_wheel import Params, Wheel
from .differences import (
    Function,
    Stencil,
    compute_gap,
    plane_jacobian,
    solve_two,
    spectrum,
    subtract_identity,
)
from .hub_form import HubForm
from .multiplier_form import MultiplierForm
from .multiprecision import (
    BITS,
    DIGITS,
    NAMES,
    Formulation,
    Number,
    Vector,
    parameters,
    step,
    step_length,
)

TARGET_PATH = Path(__file__).with_name("reference_values.json")
STORED_DIGITS = 27  # significant digits written
AGREEMENT_TOLERANCE = mp.mpf("1e-22")
STENCIL_STEP = mp.mpf("1e-14")
CHECK_SIZE = mp.mpf("3e-14")
# Weights, relative to each parameter (or absolute for a start), of the checked direction.
DIRECTION = [mp.mpf(w) / 7 for w in (3, -5, 2, 7, -4, 6, -3, 5, -2)]
START_DIRECTION = [mp.mpf(w) / 11 for w in (4, -7, 9)]

VARIED_PARAMETERS = ("damping", "stiffness", "natural_length", "slope", "leg_mass", "leg_com")
CASES: dict[str, tuple[str, ...]] = {
    "table_1": ("200", "500", "1.02", "0.3", "1", "0.3"),
    "damping_100": ("100", "500", "1.02", "0.3", "1", "0.3"),
    "damping_60": ("60", "500", "1.02", "0.3", "1", "0.3"),
    "low_damping_light": ("20", "480", "1.02", "0.28", "0.75", "0.25"),
    "low_damping_soft": ("25", "450", "1.015", "0.28", "0.8", "0.4"),
    "low_damping_heavy": ("30", "400", "1.03", "0.32", "1.2", "0.5"),
    "long_spring": ("35", "520", "1.038", "0.26", "1", "0.32"),
    "short_spring": ("75", "420", "1.012", "0.27", "1.1", "0.45"),
    "long_double_support": ("110", "440", "1.01", "0.26", "0.9", "0.5"),
    "low_mass_centre": ("120", "480", "1.025", "0.31", "1.15", "0.22"),
    "short_double_support": ("140", "560", "1.018", "0.29", "0.85", "0.48"),
    "steep": ("150", "410", "1.03", "0.34", "1.05", "0.3"),
    "low_mass_centre_heavy": ("175", "510", "1.028", "0.3", "1.2", "0.2"),
    "heavy": ("190", "470", "1.02", "0.31", "1.2", "0.35"),
    "high_damping_soft": ("210", "400", "1.02", "0.28", "1.15", "0.3"),
    "high_damping": ("215", "470", "1.02", "0.29", "1.1", "0.3"),
}
"""Wheels on which a period-1 gait walks, reached from Table 1; values of ``VARIED`` as decimals."""


def make_wheel(name: str) -> dict[str, float]:
    """Parameters of a case as doubles; their shortest decimals are the exact reference's input."""
    values = dict(zip(VARIED_PARAMETERS, map(float, CASES[name]), strict=True))
    return {**double.TABLE_1, **values}


# --- Double precision: where the gait is.


def plane_map(params: Params, y: np.ndarray, rtol: float) -> tuple[np.ndarray, Any]:
    """From just after one landing to just after the next, both with planted feet."""
    result = double.step_after_impact(params, y, rtol=rtol, atol=rtol / 10)
    if result["outcome"] != double.STEPPED:
        raise ArithmeticError(result["outcome"])
    q, v = double.pre_impact(params, result["section_state"])
    q, v, _ = double.exchange_labels(params, q, v)
    after, impulse = Wheel(params).impact(q, v, "DLS")
    if impulse[3] < 0:
        raise ArithmeticError("the landing frees Leg 2")
    return np.array([q[2], after[2]]), result


def approach_gait(target: Params) -> tuple[np.ndarray, Any]:
    """Walk from Table 1's gait to the target's while the wheel changes; settle by Newton."""
    y = np.array([-0.68267, 1.04920])
    for share in np.linspace(0.0, 1.0, 9)[1:]:
        params = {
            key: value + share * (target[key] - value) if key in VARIED_PARAMETERS else value
            for key, value in double.TABLE_1.items()
        }
        for _ in range(3):
            y, _ = plane_map(params, y, 1e-9)
    for _ in range(8):
        slope = double.jacobian(lambda s: plane_map(target, s, 1e-12)[0], y, 1e-5)
        image, _ = plane_map(target, y, 1e-12)
        change = np.linalg.solve(np.eye(2) - slope, image - y)
        y = y + change
        if np.max(np.abs(change)) < 1e-9:
            return y, plane_map(target, y, 1e-13)[1]
    raise ArithmeticError("no cycle found")


# --- Multiprecision: steps and cycles.


def evaluate_around(model: Formulation, about: Sequence[float], n_legs: Number) -> Function:
    """(y, p) -> (next y, durations) of the plane map after impact, as one flat function."""

    def function(point: Sequence[Number]) -> Vector:
        p = [*point[2:], n_legs]
        landed = model.walk(point[:2], p, about)
        y, _ = model.land(landed.section_state, p)
        return [*y, *landed.durations]

    return function


def step_case(
    models: tuple[Formulation, Formulation], params: Params, x: list[str]
) -> tuple[dict[str, Any], dict[str, Number]]:
    """Reference of one step from a start, and the disagreements of the second formulation."""
    hub, five = models
    p = parameters(params)
    start = [mp.mpf(v) for v in x]
    outcome = double.step(params, [float(v) for v in x])
    if outcome["outcome"] != double.STEPPED or outcome["lambda_plus"][3] < 0:
        raise ArithmeticError(f"the start does not step: {outcome['outcome']}")
    about = [float(d) for d in outcome["durations"]]

    def flat(model: Formulation) -> Function:
        def function(point: Sequence[Number]) -> Vector:
            step_result = step(model, point[:3], [*point[3:], p[9]], about)
            return [*step_result.section_state, *step_result.durations]

        return function

    point = [*start, *p[:9]]
    sizes = [STENCIL_STEP] * 3 + [STENCIL_STEP * v for v in p[:9]]
    stencil = Stencil(flat(hub), point, sizes)
    gradient = [stencil.first(i) for i in range(12)]
    reference = step(hub, start, p, about)
    other = step(five, start, p, about)
    move = [*START_DIRECTION, *(w * v for w, v in zip(DIRECTION, p[:9], strict=True))]
    ends = [
        flat(five)([v + sign * CHECK_SIZE * d for v, d in zip(point, move, strict=True)])
        for sign in (1, -1)
    ]
    slope = [(a - b) / (2 * CHECK_SIZE) for a, b in zip(*ends, strict=True)]
    expected = [mp.fsum(gradient[i][k] * move[i] for i in range(12)) for k in range(6)]
    names = ("section_state", "post_impact", "durations", "indicators")
    disagreements = {
        "step_values": max(compute_gap(getattr(other, n), getattr(reference, n)) for n in names),
        "step_derivatives": max(
            abs(a - b) / max(abs(gradient[i][k] * move[i]) for i in range(12))
            for k, (a, b) in enumerate(zip(slope, expected, strict=True))
        ),
    }
    rows = [[gradient[i][k] for i in range(12)] for k in range(6)]
    return {
        "start": x,
        "section_state": reference.section_state,
        "post_impact": reference.post_impact,
        "durations": reference.durations,
        "step_length": reference.step_length,
        **indicator_names(reference.indicators),
        "d_section_state_d_start": [row[:3] for row in rows[:3]],
        "d_section_state_d_params": [row[3:] for row in rows[:3]],
        "d_durations_d_start": [row[:3] for row in rows[3:]],
        "d_durations_d_params": [row[3:] for row in rows[3:]],
    }, disagreements


def indicator_names(values: Vector) -> dict[str, Number]:
    """The three indicators by name; N s, N, N."""
    return dict(zip(("lambda_impulse_4", "lambda2_plus", "lambda4_plus"), values, strict=True))


def cycle_case(
    models: tuple[Formulation, Formulation], params: Params, guess: np.ndarray, about: Any
) -> tuple[dict[str, Any], dict[str, Number]]:
    """Reference of the limit cycle, and the disagreements of the second formulation."""
    hub, five = models
    p = parameters(params)
    about = [float(d) for d in about]
    function = evaluate_around(hub, about, p[9])
    y = [mp.mpf(float(v)) for v in guess]
    slope = subtract_identity(plane_jacobian(function, y, p[:9], STENCIL_STEP))
    for _ in range(12):
        image = function([*y, *p[:9]])
        change = solve_two(slope, [a - b for a, b in zip(image[:2], y, strict=True)])
        y = [a + b for a, b in zip(y, change, strict=True)]
        if max(map(abs, change)) < mp.mpf("1e-48"):
            break
    else:
        raise ArithmeticError("Newton's method did not settle")

    sizes = [STENCIL_STEP] * 2 + [STENCIL_STEP * v for v in p[:9]]
    stencil = Stencil(function, [*y, *p[:9]], sizes)
    by_y = [stencil.first(i) for i in range(2)]
    matrix = [[by_y[j][i] for j in range(2)] for i in range(2)]
    inverse = subtract_identity(matrix)
    multipliers, radius, radius_rate = spectrum(matrix)
    durations = stencil.value[2:]
    period = mp.fsum(durations)
    landed = hub.walk(y, p, about)
    _, impulse = hub.land(landed.section_state, p)
    length = step_length(y, p)
    curvature: list[list[Any]] = [
        [stencil.second(0, 0), stencil.second(0, 1)],
        [None, stencil.second(1, 1)],
    ]
    curvature[1][0] = curvature[0][1]

    derivatives: dict[str, list[Any]] = {
        name: []
        for name in (
            "post_impact",
            "durations",
            "period",
            "dls_fraction",
            "speed",
            "step_length",
            "spectral_radius",
        )
    }
    for i in range(9):
        by_p = stencil.first(2 + i)
        dy = solve_two(inverse, by_p[:2])
        d_durations = [
            by_p[2 + k] + by_y[0][2 + k] * dy[0] + by_y[1][2 + k] * dy[1] for k in range(3)
        ]
        mixed = [stencil.second(j, 2 + i) for j in range(2)]
        rate = [
            [mixed[c][r] + mp.fsum(curvature[c][k][r] * dy[k] for k in range(2)) for c in range(2)]
            for r in range(2)
        ]
        ends = []
        for sign in (1, -1):
            shifted = list(p)
            shifted[i] = shifted[i] + sign * sizes[2 + i]
            ends.append(
                step_length(
                    [v + sign * sizes[2 + i] * d for v, d in zip(y, dy, strict=True)], shifted
                )
            )
        d_length = (ends[0] - ends[1]) / (2 * sizes[2 + i])
        d_period = mp.fsum(d_durations)
        derivatives["post_impact"].append(dy)
        derivatives["durations"].append(d_durations)
        derivatives["period"].append(d_period)
        derivatives["dls_fraction"].append(
            d_durations[0] / period - durations[0] * d_period / period**2
        )
        derivatives["step_length"].append(d_length)
        derivatives["speed"].append(d_length / period - length * d_period / period**2)
        derivatives["spectral_radius"].append(radius_rate(rate))

    disagreements = check_cycle(
        evaluate_around(five, about, p[9]),
        y,
        p[:9],
        stencil.value,
        matrix,
        multipliers,
        derivatives,
    )
    other = five.walk(y, p, about)
    found_rows = [*other.section_state, *other.multipliers, five.land(other.section_state, p)[1]]
    indicators = [impulse, *landed.multipliers]
    disagreements["cycle_values"] = max(
        disagreements["cycle_values"],
        compute_gap(found_rows, [*landed.section_state, *landed.multipliers, impulse]),
    )
    for name in ("post_impact", "durations"):
        derivatives[name] = [list(row) for row in zip(*derivatives[name], strict=True)]
    return {
        "section_state": landed.section_state,
        "post_impact": y,
        "durations": durations,
        "period": period,
        "dls_fraction": durations[0] / period,
        "speed": length / period,
        "step_length": length,
        **indicator_names(indicators),
        "multipliers": [[mp.re(v), mp.im(v)] for v in multipliers],
        "spectral_radius": radius,
        "d_params": derivatives,
    }, disagreements


def check_cycle(
    function: Function,
    y: Vector,
    p: Vector,
    expected: Vector,
    matrix: list[Vector],
    multipliers: Vector,
    derivatives: Mapping[str, list[Any]],
) -> dict[str, Number]:
    """Disagreements of another formulation's map about the cycle."""
    image = function([*y, *p])
    values = max(compute_gap(image[:2], y), compute_gap(image[2:], expected[2:]))
    other = plane_jacobian(function, y, p, CHECK_SIZE)
    rows = max(compute_gap(a, b) for a, b in zip(other, matrix, strict=True))
    solution = compute_gap(spectrum(other)[0], multipliers)
    move = [w * v for w, v in zip(DIRECTION, p, strict=True)]
    rates_along_parameter = [
        mp.fsum(derivatives["post_impact"][i][k] * move[i] for i in range(9)) for k in range(2)
    ]
    images, radii = [], []
    for sign in (1, -1):
        y_moved = [v + sign * CHECK_SIZE * d for v, d in zip(y, rates_along_parameter, strict=True)]
        p_moved = [v + sign * CHECK_SIZE * d for v, d in zip(p, move, strict=True)]
        images.append(function([*y_moved, *p_moved]))
        radii.append(spectrum(plane_jacobian(function, y_moved, p_moved, CHECK_SIZE))[1])
    slope = [(a - b) / (2 * CHECK_SIZE) for a, b in zip(*images, strict=True)]
    worst = mp.mpf(0)
    # On the cycle the image moves as the cycle does.
    for k in range(5):
        entries = [
            derivatives["post_impact"][i][k] if k < 2 else derivatives["durations"][i][k - 2]
            for i in range(9)
        ]
        parts = [e * d for e, d in zip(entries, move, strict=True)]
        worst = max(worst, abs(slope[k] - mp.fsum(parts)) / max(map(abs, parts)))
    parts = [d * e for d, e in zip(derivatives["spectral_radius"], move, strict=True)]
    radius_slope = (radii[0] - radii[1]) / (2 * CHECK_SIZE)
    return {
        "cycle_values": values,
        "multipliers": max(rows, solution),
        "cycle_derivatives": worst,
        "spectral_radius_derivatives": abs(radius_slope - mp.fsum(parts)) / max(map(abs, parts)),
    }


# --- The file.


def to_strings(value: Any) -> Any:
    """Numbers as decimal strings, containers as they are."""
    if isinstance(value, mp.mpf):
        return mp.nstr(value, STORED_DIGITS)
    if isinstance(value, Mapping):
        return {key: to_strings(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [to_strings(entry) for entry in value]
    return value


def compute_case(name: str, models: tuple[Formulation, Formulation]) -> dict[str, Any]:
    """One case of the file."""
    params = make_wheel(name)
    guess, result = approach_gait(params)
    section = result["section_state"]
    start = [f"{section[0]:.3f}", f"{section[1]:.2f}", f"{section[2]:.3f}"]
    one, step_gaps = step_case(models, params, start)
    cycle, cycle_gaps = cycle_case(models, params, guess, result["durations"])
    gaps = {**step_gaps, **cycle_gaps}
    for key, value in gaps.items():
        if not value < AGREEMENT_TOLERANCE:
            raise ArithmeticError(
                f"{name}: the formulations differ in {key} by {mp.nstr(value, 3)}"
            )
    decimals = dict(zip(VARIED_PARAMETERS, CASES[name], strict=True))
    exact = {key: decimals.get(key, str(params[key])) for key in NAMES}
    return {
        "name": name,
        "params": {**exact, "n_legs": int(params["n_legs"])},
        "step": to_strings(one),
        "cycle": to_strings(cycle),
        "disagreement": {key: mp.nstr(value, 2) for key, value in gaps.items()},
    }


def provenance(cases: Sequence[Mapping[str, Any]], seconds: float) -> dict[str, Any]:
    """How the file came about."""
    keys = cases[0]["disagreement"]
    worst = {key: max((c["disagreement"][key] for c in cases), key=mp.mpf) for key in keys}
    return {
        "generator": "tests/reference_code/make_reference_values.py",
        "units": "SI: m, s, rad, N, N s",
        "parameter_order": list(NAMES),
        "numbers": f"{STORED_DIGITS} significant digits; parameters and starts are exact decimals",
        "working_precision": f"{DIGITS} digits ({BITS} bits), Taylor series of heyoka",
        "derivatives": f"central differences, relative step {mp.nstr(STENCIL_STEP, 2)}",
        "check": "MultiplierForm (multipliers) against HubForm (projected Newton's law): "
        "all values, multipliers, derivatives along one direction moving every argument, "
        f"differences of relative step {mp.nstr(CHECK_SIZE, 2)}",
        "largest_disagreement": worst,
        "versions": {
            "python": platform.python_version(),
            "heyoka": heyoka.__version__,
            "mpmath": mp.__version__,
            "numpy": np.__version__,
            "scipy": scipy.__version__,
        },
        "wall_seconds": round(seconds),
    }


def main() -> int:
    """Compute the cases and write the file after each."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="*", choices=list(CASES), help="recompute these cases")
    parser.add_argument("--target", type=Path, default=TARGET_PATH)
    options = parser.parse_args()
    begin = time.perf_counter()
    done: dict[str, Any] = {}
    if options.only and options.target.exists():
        old = json.loads(options.target.read_text())
        done = {case["name"]: case for case in old["cases"]}
        begin -= old["provenance"]["wall_seconds"]
    models = (HubForm(), MultiplierForm())
    for name in options.only or CASES:
        done[name] = compute_case(name, models)
        elapsed = time.perf_counter() - begin
        print(f"{name}: {elapsed:.0f} s, {done[name]['disagreement']}", flush=True)
        cases = [done[key] for key in CASES if key in done]
        content = {"provenance": provenance(cases, elapsed), "cases": cases}
        options.target.write_text(json.dumps(content, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
