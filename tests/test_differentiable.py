"""The table "What is differentiable" of docs/choose.md agrees with the code.

Each row names a function, a model and three modes. A cell that is "yes" is compared with a central
difference, and a cell that is "raises an error" raises an error.
"""

import re
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest

import vrw_jax as vrw
from vrw_jax.continuation import solve_fixed_point
from vrw_jax.hybrid import Guard, Mode, simulate_hybrid

PAGE = Path(__file__).parents[1] / "docs" / "choose.md"
SLOPE = 0.3
GROUND = vrw.UnilateralWheel(friction=0.7)
DIFFERENCE_STEP = 1e-4
"""Step of central differences, in rad or m, chosen because their error is below 1e-6."""

GAIT_CURVATURE_TOLERANCE = 2e-3
"""Relative tolerance of second derivatives of gaits, chosen because the first derivatives are
accurate to 1e-8, which the difference amplifies by up to 1e5."""

MODES = {"forward": jax.jacfwd, "reverse": jax.grad, "second": lambda f: jax.jacfwd(jax.jacfwd(f))}


def falling_time(height):
    """Return the time of the second bounce of a ball."""
    fall = lambda y: jnp.stack([y[1], -9.81 + 0.0 * y[1]])
    bounce = lambda y: jnp.stack([0.0 * y[0], -0.8 * y[1]])
    ball = Mode(fall, Guard(lambda y: y[0], bounce))
    return simulate_hybrid(ball, jnp.stack([height, 0.0 * height]), events=2).time


def wheel_on(slope, damping=250.0):
    return vrw.WheelParams(damping=damping, slope=slope)


def rigid_map(slope):
    model = vrw.RigidWheel()
    start = model.compute_default_start(vrw.WheelParams(slope=SLOPE))
    return vrw.return_map(vrw.WheelParams(slope=slope), start, model=model)[1]


def gait_with_contact(slope):
    guess = vrw.limit_cycle(wheel_on(SLOPE, 300.0), model=GROUND)
    return vrw.limit_cycle(wheel_on(slope, 300.0), model=GROUND, guess=guess).period


FUNCTIONS = {
    ("return_map", "viscoelastic"): lambda x: vrw.return_map(wheel_on(x), vrw.paper_start())[1],
    ("return_map", "unilateral"): lambda x: vrw.return_map(
        wheel_on(x), vrw.paper_start(), model=GROUND
    )[1],
    ("return_map", "rigid"): rigid_map,
    ("step", "viscoelastic"): lambda x: vrw.step(wheel_on(x), vrw.paper_start()).period,
    ("step", "unilateral"): lambda x: vrw.step(wheel_on(x), vrw.paper_start(), model=GROUND).period,
    ("walk", "viscoelastic"): lambda x: (
        vrw.walk(wheel_on(x, 150.0), vrw.paper_start(), 2).steps.durations[-1].sum()
    ),
    ("walk", "unilateral"): lambda x: (
        vrw.walk(wheel_on(x), vrw.paper_start(), 2, model=GROUND).steps.durations[-1].sum()
    ),
    ("limit_cycle", "viscoelastic"): lambda x: vrw.limit_cycle(wheel_on(x, 150.0)).period,
    ("limit_cycle", "unilateral"): gait_with_contact,
    ("solve_fixed_point", "any map"): lambda x: solve_fixed_point(
        lambda y: jnp.cos(x * y), jnp.ones(1)
    ).x[0],
    ("simulate_hybrid", "any modes"): falling_time,
}


def read_rows():
    """Return the rows of the table as (function, model, cells)."""
    section = PAGE.read_text().split("## What is differentiable")[1]
    for line in re.findall(r"^\| (`.*) \|$", section, re.MULTILINE):
        names, model, *cells = line.split(" | ")
        yield re.findall(r"`(\w+)`", names)[0], model, cells


SLOW_CELLS = (
    {("unilateral", mode) for mode in ("forward", "reverse")}
    | {(model, "second") for model in ("viscoelastic", "any modes")}
    | {("rigid", mode) for mode in MODES}
)
CHECKED = [
    pytest.param(
        (function, model),
        mode,
        cell,
        id=f"{function}-{model}-{mode}",
        marks=[pytest.mark.slow] if (model, mode) in SLOW_CELLS else [],
    )
    for function, model, cells in read_rows()
    if (function, model) in FUNCTIONS
    for mode, cell in zip(MODES, cells, strict=True)
    if cell.startswith(("yes", "raises an error"))
]


@pytest.mark.parametrize(("row", "mode", "cell"), CHECKED)
def test_a_cell_of_the_table_agrees_with_the_code(row, mode, cell):
    function = FUNCTIONS[row]
    point = 1.0 if "hybrid" in row[0] else SLOPE
    if cell == "raises an error":
        with pytest.raises(ValueError, match="jacfwd"):
            MODES[mode](function)(point)
        return
    differentiated = jax.jacfwd(function) if mode == "second" else function
    upper, lower = (differentiated(point + sign * DIFFERENCE_STEP) for sign in (1.0, -1.0))
    expected = float((upper - lower) / (2.0 * DIFFERENCE_STEP))
    is_gait_curvature = row == ("limit_cycle", "viscoelastic") and mode == "second"
    tolerance = GAIT_CURVATURE_TOLERANCE if is_gait_curvature else 1e-4
    assert float(MODES[mode](function)(point)) == pytest.approx(expected, rel=tolerance)


def test_every_row_with_yes_or_an_error_is_checked():
    rows = {(function, model) for function, model, cells in read_rows() if "yes" in " ".join(cells)}
    assert rows == set(FUNCTIONS)


@pytest.mark.slow
def test_derivatives_of_multipliers_with_contact_are_nan_as_the_table_says():
    cells = {(function, model): cells for function, model, cells in read_rows()}
    assert "multipliers NaN" in cells["limit_cycle", "unilateral"][0]
    guess = vrw.limit_cycle(wheel_on(SLOPE, 300.0), model=GROUND)
    radius = lambda slope: (
        vrw.limit_cycle(wheel_on(slope, 300.0), model=GROUND, guess=guess).spectral_radius
    )
    assert jnp.isnan(jax.jacfwd(radius)(SLOPE))
