"""Pictures of borders as curves over two parameters, on the measure that a scan found."""

from collections.abc import Sequence

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from vrw_jax.branches import BorderCurve
from vrw_jax.figures.style import (
    AMBER,
    BLUE,
    GREEN,
    LIGHT,
    ORANGE,
    PAGE,
    PINK,
    SKY,
    axis_label,
    figure_style,
)
from vrw_jax.results import what_breaks

STYLES = [(color, dash) for dash in ("-", "--", ":") for color in (
    "black", ORANGE, BLUE, GREEN, PINK, SKY, AMBER)]  # fmt: skip


@figure_style()
def map_figure(scan: xr.Dataset, measure: str, curves: Sequence[BorderCurve]) -> Figure:
    """The measure of the scan's gaits in colours, grey where there is none, and every border."""
    x, y = curves[0].parameters if curves else tuple(map(str, scan.dims))
    figure = Figure(figsize=(PAGE, 0.62 * PAGE))
    axes = figure.subplots()
    axes.set_facecolor(LIGHT)
    values = scan[measure].where(scan.outcome == 0).transpose(y, x).values
    image = axes.pcolormesh(
        scan[x].values, scan[y].values, values, shading="nearest", cmap="cividis", rasterized=True
    )
    figure.colorbar(image, ax=axes, aspect=30, pad=0.01).set_label(axis_label(measure))
    for (color, dash), curve in zip(STYLES, curves, strict=False):
        told = what_breaks(curve.name)
        axes.plot(*curve.values.T, color=color, linestyle=dash, label=told)
        met = np.array([meeting.values for meeting in curve.meetings]).reshape(-1, 2)
        axes.plot(*met.T, "o", color=color, markersize=3.0, markerfacecolor="white")
    axes.set_xlim(*scan[x].values[[0, -1]])
    axes.set_ylim(*scan[y].values[[0, -1]])
    axes.set_xlabel(axis_label(x))
    axes.set_ylabel(axis_label(y))
    if curves:
        figure.legend(loc="outside lower center", ncols=2)
    return figure
