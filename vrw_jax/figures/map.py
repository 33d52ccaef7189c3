"""Pictures of borders as curves over two parameters, on the measure that a scan found."""

from collections.abc import Sequence

import numpy as np
import xarray as xr
from matplotlib.figure import Figure
from matplotlib.patheffects import Normal, Stroke

from vrw_jax.branches import BorderCurve
from vrw_jax.figures.style import (
    LIGHT,
    PAGE,
    axis_label,
    border_style,
    drawable,
    figure_style,
    typeset,
)
from vrw_jax.results import what_breaks
from vrw_jax.scans import SWEPT


@figure_style()
def map_figure(scan: xr.Dataset, measure: str, curves: Sequence[BorderCurve]) -> Figure:
    """The measure of the scan's gaits in colours, grey where there is none, and every border.

    Thin where the gaits on it are not stable.

    Args:
        scan: of `vrw.scan` over a grid of two parameters.
        measure: one of its columns.
        curves: of `vrw.border_curve` over the same two; may be empty.

    Returns:
        Figure: one panel, in SI units.

    Examples:
        >>> grid = vrw.grid(damping=[150.0, 200.0], slope=[0.28, 0.3])
        >>> figure = vrw.plot.map_figure(vrw.scan(grid, ["speed"]), "speed", [])
    """
    drawable("scan", scan, ("outcome", measure), "give vrw.scan of two parameters and the measure")
    x, y = curves[0].parameters if curves else [n for n in SWEPT if n in scan.dims]
    figure = Figure(figsize=(PAGE, 0.62 * PAGE))
    axes = figure.subplots()
    axes.set_facecolor(LIGHT)
    values = scan[measure].where(scan.outcome == 0).transpose(y, x).values
    image = axes.pcolormesh(
        scan[x].values, scan[y].values, values, shading="nearest", cmap="cividis", rasterized=True
    )
    figure.colorbar(image, ax=axes, aspect=30, pad=0.01).set_label(axis_label(measure))
    names = sorted({curve.name for curve in curves})
    labels = {name: typeset(what_breaks(name)) for name in names}
    for curve in curves:
        color, dash = border_style(curve.name)
        stable = curve.dataset.spectral_radius.values < 1.0
        for there, width in ((stable, 1.2), (~stable, 0.5)):
            # A point of what follows joins them; several pieces of a border are told once.
            joined = there | np.append(False, there[:-1])
            drawn = np.where(joined[:, None], curve.values, np.nan)
            told = labels.pop(curve.name, None) if there.any() else None
            halo = [Stroke(linewidth=width + 1.0, foreground="white"), Normal()]
            axes.plot(
                *drawn.T, color=color, linestyle=dash, linewidth=width, label=told,
                path_effects=halo,
            )  # fmt: skip
    met = np.array([meeting.values for curve in curves for meeting in curve.meetings])
    axes.plot(
        *met.reshape(-1, 2).T, "o", color="black", markersize=2.5, markerfacecolor="white",
        markeredgewidth=0.6, label="two borders at once",
    )  # fmt: skip
    axes.set_xlim(*scan[x].values[[0, -1]])
    axes.set_ylim(*scan[y].values[[0, -1]])
    axes.set_xlabel(axis_label(x))
    axes.set_ylabel(axis_label(y))
    if curves:
        figure.legend(loc="outside lower center", ncols=2)
    return figure
