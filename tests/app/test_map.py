"""A map shows each curve of special points over the measure, and the points where curves meet."""

import numpy as np
import pytest
import xarray as xr

import vrw_jax as vrw
from vrw_jax.branches.branch import Codim2Point
from vrw_jax.plot import map_figure

C, K = np.linspace(50.0, 150.0, 5), np.linspace(400.0, 600.0, 4)


def test_special_point_curves_and_codimension_two_points_are_drawn_at_their_values():
    share = C[:, None] / K
    outcome = np.where(share > 0.3, vrw.Outcome.NO_CYCLE_FOUND, vrw.Outcome.STEPPED)
    over_values = ("damping", "stiffness")
    scan = xr.Dataset(
        {"dls_fraction": (over_values, share), "outcome": (over_values, outcome)},
        {"damping": C, "stiffness": K},
    )
    radius = {"spectral_radius": ("point", [0.5, 0.9, 1.1, 1.2])}
    line = xr.Dataset(radius, {"damping": ("point", 0.2 * K), "stiffness": ("point", K)})
    codim2_point = Codim2Point("fold", (100.0, 500.0), False)
    curve = vrw.SpecialPointCurve("lambda_4_plus", over_values, line, (codim2_point,), ("", ""))
    figure = map_figure(scan, "dls_fraction", [curve])
    axes = figure.axes[0]
    stable, thin, points = axes.lines
    places, gap = np.stack([0.2 * K, K], 1), np.full((1, 2), np.nan)
    np.testing.assert_array_equal(stable.get_xydata(), [*places[:3], *gap])
    np.testing.assert_array_equal(thin.get_xydata(), [*gap, *gap, *places[2:]])
    assert stable.get_linewidth() > thin.get_linewidth()
    np.testing.assert_array_equal(points.get_xydata(), [[100.0, 500.0]])
    (cells,) = axes.collections
    np.testing.assert_array_equal(np.ma.getmaskarray(cells.get_array()), (share > 0.3).T)
    assert axes.get_xlim() == (C[0], C[-1])


def make_curve(parameters, *codim2_points):
    line = xr.Dataset(
        {"spectral_radius": ("point", [0.5, 0.5])},
        {"damping": ("point", [60.0, 90.0]), "stiffness": ("point", [420.0, 580.0])},
    )
    return vrw.SpecialPointCurve("fold", parameters, line, codim2_points, ("", ""))


SCAN = xr.Dataset(
    {name: (("damping", "stiffness"), np.zeros((5, 4), int)) for name in ("speed", "outcome")},
    {"damping": C, "stiffness": K},
)


def test_curves_may_have_their_parameters_in_either_order():
    meeting = Codim2Point("period_doubling", (500.0, 100.0), False)
    swapped = make_curve(("stiffness", "damping"), meeting)
    axes = map_figure(SCAN, "speed", [make_curve(("damping", "stiffness")), swapped]).axes[0]
    first, _, second, _, points = axes.lines
    np.testing.assert_array_equal(second.get_xydata(), first.get_xydata())
    np.testing.assert_array_equal(points.get_xydata(), [[100.0, 500.0]])


def test_the_legend_names_only_what_is_drawn():
    figure = map_figure(SCAN, "speed", [make_curve(("damping", "stiffness"))])
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["fold"]


@pytest.mark.parametrize(
    ("scan", "curves", "message"),
    [
        (SCAN.expand_dims(slope=[0.3]), [], "the scan is over stiffness, damping, slope"),
        (SCAN.isel(damping=0), [], "the scan is over stiffness, but a map is over two"),
        (SCAN, [make_curve(("damping", "slope"))], "a curve is over damping and slope, but"),
    ],
)
def test_a_map_of_other_parameters_is_refused_in_one_sentence(scan, curves, message):
    with pytest.raises(ValueError, match=message):
        map_figure(scan, "speed", curves)
