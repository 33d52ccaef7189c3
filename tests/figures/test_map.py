"""A map shows every border as a curve over the measure, and where borders meet."""

import numpy as np
import xarray as xr

import vrw_jax as vrw
from vrw_jax.branches.branch import Meeting
from vrw_jax.figures.scan import map_figure

C, K = np.linspace(50.0, 150.0, 5), np.linspace(400.0, 600.0, 4)


def test_borders_and_meetings_are_drawn_where_they_are():
    share = C[:, None] / K
    outcome = np.where(share > 0.3, vrw.Outcome.NO_CYCLE_FOUND, vrw.Outcome.STEPPED)
    over = ("damping", "stiffness")
    scan = xr.Dataset(
        {"dls_fraction": (over, share), "outcome": (over, outcome)},
        {"damping": C, "stiffness": K},
    )
    radius = {"spectral_radius": ("point", [0.5, 0.9, 1.1, 1.2])}
    line = xr.Dataset(radius, {"damping": ("point", 0.2 * K), "stiffness": ("point", K)})
    met = Meeting("fold", (100.0, 500.0), False)
    curve = vrw.BorderCurve("lambda_4_plus", over, line, (met,), ("", ""))
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
