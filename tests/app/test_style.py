"""Labels come from the table of measures, and every measure can be drawn."""

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.mathtext import MathTextParser

from vrw_jax import Outcome, plot
from vrw_jax.models import MEASURES
from vrw_jax.plot import style

MATHTEXT_PARSER = MathTextParser("path")


@pytest.mark.parametrize("measure", MEASURES.values(), ids=lambda measure: measure.name)
def test_every_symbol_is_mathtext(measure):
    assert measure.mathtext.isascii()
    MATHTEXT_PARSER.parse(f"${measure.mathtext}$")
    MATHTEXT_PARSER.parse(style.format_axis_label(measure.name))


@pytest.mark.parametrize(
    ("label", "text"),
    [
        (style.format_axis_label("damping"), "damping $c$ [N·s/m]"),
        (style.format_axis_label("damping", "{symbol}"), "$c$ [N·s/m]"),
        (style.format_axis_label("speed", "{name}"), "walking speed [m/s]"),
        (style.format_axis_label("gravity", "{symbol}"), "$g$ [m/s²]"),
        (style.format_axis_label("dls_fraction"), r"DLS fraction $T_{\mathrm{DLS}}/T$"),
        (style.format_axis_label("lambda_2_plus", "{name}"), r"DLS indicator $\lambda _2^+$ [N]"),
        (style.format_axis_label("mu"), "mu"),
        (style.format_value_label("damping", 50.0), "$c$ = 50 N·s/m"),
        (style.format_value_label("dls_fraction", 0.53153, 3), r"$T_{\mathrm{DLS}}/T$ = 0.532"),
        (style.format_value_label("mu", 0.25), "mu = 0.25"),
    ],
)
def test_a_label_has_name_symbol_and_unit(label, text):
    assert label == text


def test_every_outcome_has_its_own_color():
    colours = [
        style.OUTCOME_LABELS_AND_COLORS[code][1]
        for code in (*Outcome, style.UNSTABLE_CYCLE_CODE, style.NOT_COMPUTED_CODE)
    ]
    assert len(set(colours)) == len(Outcome) + 2


@pytest.mark.parametrize("known", [[Outcome.COLLAPSED], [Outcome.FELL_BACK, Outcome.COLLAPSED]])
def test_cells_have_the_colors_of_their_outcomes_and_others_stay_empty(known):
    axes = Figure().subplots()
    codes = np.array([[Outcome.STEPPED, Outcome.COLLAPSED], [Outcome.FELL_BACK, Outcome.STEPPED]])
    style.draw_outcome_cells(axes, np.arange(2.0), np.arange(2.0), codes, sorted(known))
    (mesh,) = axes.collections
    mesh.update_scalarmappable()
    for code, drawn_color in zip(codes.ravel(), mesh.get_facecolor().reshape(-1, 4), strict=True):
        expected = (
            style.OUTCOME_LABELS_AND_COLORS[Outcome(code)][1]
            if code in known
            else (0.0, 0.0, 0.0, 0.0)
        )
        assert np.allclose(drawn_color, mpl.colors.to_rgba(expected))


def test_a_style_ends_with_its_figure():
    before = dict(mpl.rcParams)
    with plot.figure_style():
        assert mpl.rcParams["font.serif"] == ["STIXGeneral"]
    assert dict(mpl.rcParams) == before


def test_special_points_in_confusable_colors_share_no_dash():
    names = {
        color: [name for name in style.SPECIAL_POINT_NAMES_BY_COLOR[color] if name]
        for color in style.SPECIAL_POINT_NAMES_BY_COLOR
    }
    dashes = lambda color: {style.select_special_point_style(name)[1] for name in names[color]}
    assert not dashes(style.OKABE_ITO_GREEN) & dashes(style.OKABE_ITO_PINK)
    looks = [
        style.select_special_point_style(name)
        for names_of_dash in names.values()
        for name in names_of_dash
    ]
    assert len(set(looks)) == len(looks)
