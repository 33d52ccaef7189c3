"""Pictures of borders as curves over two parameters, on the measure that a scan found."""

import itertools
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
    names = sorted({curve.name for curve in curves})
    styles = dict(zip(names, itertools.cycle(STYLES), strict=False))
    labels = {name: what_breaks(name) for name in names}
    for curve in curves:
        color, dash = styles[curve.name]
        told = labels.pop(curve.name, None)  # several pieces of a border are told once
        axes.plot(*curve.values.T, color=color, linestyle=dash, linewidth=1.0, label=told)
    met = np.array([meeting.values for curve in curves for meeting in curve.meetings])
    points = {"markersize": 2.5, "markerfacecolor": "white", "markeredgewidth": 0.6}
    axes.plot(*met.reshape(-1, 2).T, "o", color="black", **points, label="two borders at once")
    axes.set_xlim(*scan[x].values[[0, -1]])
    axes.set_ylim(*scan[y].values[[0, -1]])
    axes.set_xlabel(axis_label(x))
    axes.set_ylabel(axis_label(y))
    if curves:
        figure.legend(loc="outside lower center", ncols=2)
    return figure
