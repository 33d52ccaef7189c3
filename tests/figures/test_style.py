"""Labels come from the table of measures, and any of them can be drawn."""

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.mathtext import MathTextParser

from vrw_jax import figures
from vrw_jax.figures import style
from vrw_jax.results import MEASURES
from vrw_jax.wheel import Outcome

PARSER = MathTextParser("path")


@pytest.mark.parametrize("measure", MEASURES.values(), ids=lambda measure: measure.name)
def test_every_symbol_is_mathtext(measure):
    assert measure.tex.isascii()
    PARSER.parse(f"${measure.tex}$")
    PARSER.parse(style.axis_label(measure.name))


@pytest.mark.parametrize(
    ("label", "text"),
    [
        (style.axis_label("damping"), "damping $c$ [N·s/m]"),
        (style.axis_label("damping", "{symbol}"), "$c$ [N·s/m]"),
        (style.axis_label("speed", "{name}"), "walking speed [m/s]"),
        (style.axis_label("gravity", "{symbol}"), "$g$ [m/s²]"),
        (style.axis_label("dls_fraction"), r"DLS fraction $T_{\mathrm{DLS}}/T$"),
        (style.axis_label("lambda_2_plus", "{name}"), r"DLS indicator $\lambda _2^+$ [N]"),
        (style.axis_label("mu"), "mu"),
        (style.value_label("damping", 50.0), "$c$ = 50 N·s/m"),
        (style.value_label("dls_fraction", 0.53153, 3), r"$T_{\mathrm{DLS}}/T$ = 0.532"),
        (style.value_label("mu", 0.25), "mu = 0.25"),
    ],
)
def test_a_label_has_name_symbol_and_unit(label, text):
    assert label == text


def test_every_outcome_has_a_colour_of_its_own():
    colours = [style.outcome_style(int(code))[1] for code in (*Outcome, style.UNSTABLE, -1)]
    assert len(set(colours)) == len(Outcome) + 2


@pytest.mark.parametrize("known", [[Outcome.COLLAPSED], [Outcome.FELL_BACK, Outcome.COLLAPSED]])
def test_cells_have_the_colours_of_their_outcomes_and_the_rest_stays_empty(known):
    axes = Figure().subplots()
    codes = np.array([[Outcome.STEPPED, Outcome.COLLAPSED], [Outcome.FELL_BACK, Outcome.STEPPED]])
    style.outcome_cells(axes, np.arange(2.0), np.arange(2.0), codes, sorted(known))
    (mesh,) = axes.collections
    mesh.update_scalarmappable()
    for code, drawn in zip(codes.ravel(), mesh.get_facecolor().reshape(-1, 4), strict=True):
        expected = style.OUTCOMES[Outcome(code)][1] if code in known else (0.0, 0.0, 0.0, 0.0)
        assert np.allclose(drawn, mpl.colors.to_rgba(expected))


def test_a_style_ends_with_its_figure():
    before = dict(mpl.rcParams)
    with figures.figure_style():
        assert mpl.rcParams["font.serif"] == ["STIXGeneral"]
    assert dict(mpl.rcParams) == before


def test_borders_that_some_eyes_see_in_one_grey_have_no_dash_in_common():
    names = {color: [name for name in style.KINDS[color] if name] for color in style.KINDS}
    dashes = lambda color: {style.border_style(name)[1] for name in names[color]}
    assert not dashes(style.GREEN) & dashes(style.PINK)
    looks = [style.border_style(name) for own in names.values() for name in own]
    assert len(set(looks)) == len(looks)
