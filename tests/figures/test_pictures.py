"""Pictures are read by every eye, by one meaning a colour and one form of units."""

import re
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
import xarray as xr

from experiments.shared.eyes import as_seen
from vrw_jax.figures import branch, indicators, style
from vrw_jax.figures.branch import basin_figure
from vrw_jax.wheel import Outcome

ROOT = Path(__file__).parents[2]
APART = 0.12
"""Least distance of two colours, of sqrt(3) between black and white."""


def seen(colour: str) -> np.ndarray:
    return as_seen(np.array(mpl.colors.to_rgb(colour)))


def test_grey_stays_grey_and_the_colours_of_okabe_and_ito_stay_apart_without_green_cones():
    np.testing.assert_allclose(seen("0.5"), 0.5, atol=1e-3)
    colours = [
        getattr(style, n) for n in ["BLUE", "ORANGE", "GREEN", "PINK", "SKY", "AMBER", "YELLOW"]
    ]
    for i, one in enumerate(colours):
        for other in colours[:i]:
            assert np.linalg.norm(seen(one) - seen(other)) > APART, (one, other)


def test_outcomes_have_colours_that_stay_apart_with_and_without_green_cones():
    told = [colour for _, colour in style.OUTCOMES.values()]
    told += [style.YELLOW, style.NOT_COMPUTED[1]]  # of unstable gaits, and of what is missing
    for i, one in enumerate(told):
        for other in told[:i]:
            plain = np.array(mpl.colors.to_rgb(one)) - mpl.colors.to_rgb(other)
            assert np.linalg.norm(plain) > APART, (one, other)
            assert np.linalg.norm(seen(one) - seen(other)) > APART, (one, other)


NAMED = (
    r"""["'](red|green|blue|[bgrcy](?:[.o*s^x]|--?|[.o]--?))["']|color=["'](?:[bgrcmy]["']|tab:)"""
)


@pytest.mark.parametrize("folder", ["experiments", "vrw_jax/figures"])
def test_pictures_take_no_colours_but_those_of_the_set(folder: str):
    """Okabe and Ito's, greys, black and white; matplotlib's own red, green and blue are others."""
    for path in (ROOT / folder).rglob("*.py"):
        assert not re.search(NAMED, path.read_text()), path


def test_shades_of_a_basin_are_apart_from_the_colours_of_its_falls():
    over = ("dtheta_touchdown", "dL1_touchdown")
    falls = [Outcome.FELL_BACK, Outcome.LEG_1_LIFTED_OFF, Outcome.TOUCHDOWN_BEFORE_STOPPER]
    outcome = np.array([[0, 0, 0], falls])
    result = xr.Dataset(
        {
            "outcome": (over, outcome),
            "steps": (over, np.array([[0.0, 10.0, 25.0], [1.0, 1.0, 1.0]])),
            "attractor": (over, np.where(outcome == 0, 0, -1)),
            "orbit_state": (("n", "state"), np.zeros((1, 3))),
        },
        {over[0]: [1.0, 2.0], over[1]: [0.0, 0.1, 0.2]},
    )
    figure = basin_figure([result], ["any"])
    mesh = figure.axes[0].collections[0]
    for steps in np.linspace(0.0, 25.0, 11):
        shade = as_seen(np.array(mesh.cmap(mesh.norm(steps))[:3]))
        for code in falls:
            assert np.linalg.norm(shade - seen(style.OUTCOMES[code][1])) > APART, (steps, code)


def test_borders_of_a_branch_have_colours_and_dashes_of_their_own():
    curves = {colour for _, series in branch.PANELS for colour in series.values()}
    assert not curves & {branch.ENDS, *branch.COLOURS.values()}
    assert branch.BORDER not in ("-", "--")


def test_the_indicators_tell_the_slope_that_they_are_of():
    gaits = xr.Dataset(
        {
            name: ("damping", np.array([1.0, 2.0]))
            for name in ("lambda_I4", "lambda_2_plus", "lambda_4_plus")
        }
        | {f"clearance_sls{i}": ("damping", np.array([-0.1, 0.1])) for i in (1, 2)}
        | {"settled": ("damping", np.array([True, True]))},
        {"damping": [4.0, 8.0]},
        {"parameter_slope": 0.3},
    )
    told = [text.get_text() for text in indicators(gaits).axes[0].texts]
    assert style.value_label("slope", 0.3) in told


UNIT = r"(s|ms|µs|m|mm|N|J|%|rad|m/s|rad/s|N s/m|N·s/m)"


@pytest.mark.parametrize("folder", ["experiments", "vrw_jax/figures"])
def test_labels_write_units_in_brackets(folder: str):
    """Not after a stroke or a comma."""
    wrong = re.compile(rf'["\n](?:[^"\[]*) / {UNIT}"|label="[^"\[]*, {UNIT}"|\[[^\]"]*N s')
    for path in (ROOT / folder).rglob("*.py"):
        labels = [
            line
            for line in path.read_text().splitlines()
            if re.search(r"label|title|SHOWN|: \(\"", line)
        ]
        found = [line for line in labels if wrong.search(line)]
        assert not found, (path, found)
