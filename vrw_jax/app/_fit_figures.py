"""Figure of a fit: measured and fitted numbers, residuals, and ellipses of the estimates."""

import itertools

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from scipy.special import gammaincinv

from vrw_jax.app.figure_style import (
    DARK_GRAY_COLOR,
    LIGHT_GRAY_COLOR,
    OKABE_ITO_BLUE,
    OKABE_ITO_ORANGE,
    PAGE_FIGURE_WIDTH_INCHES,
    FigureWidth,
    StyledFigure,
    add_wrapped_legend,
    declare_own_quantities,
    figure_style,
    find_width_inches,
    format_axis_label,
)
from vrw_jax.base.checks import check_real, check_type
from vrw_jax.base.walker import is_own_walker
from vrw_jax.models.measures import MEASURES
from vrw_jax.studies.fit_result import FitResult

PANEL_HEIGHT_INCHES = 1.7
N_CURVE_POINTS = 100
MAX_DRAWN_PAIRS = 3
"""Largest number of ellipses, those of the pairs with the largest correlations."""


@figure_style()
def fit_figure(result: FitResult, *, level: float = 0.95, width: FigureWidth = None) -> Figure:
    """Return a figure of a fit: measured against fitted numbers, residuals, and ellipses.

    Time series are drawn over time, and sequences over steps. Residuals are in standard errors, and
    a gray band marks two of them. An ellipse contains two estimates with the given probability. A
    batch of data sets shows the estimates of all data sets instead.

    Args:
        result: result of `vrw.fit`.
        level: probability of the ellipses.
        width: "column", "page" or a number of mm; None for the usual width.

    Returns:
        Figure: one panel for each measured column, one for residuals, and the ellipses.

    Raises:
        TypeError, ValueError: if an argument is invalid.

    Examples:
        >>> data = {"period": [0.70, 0.68], "period_error": [0.002], "slope": [0.3, 0.32]}
        >>> data |= {"speed": [0.86, 0.94], "speed_error": [0.01]}
        >>> figure = vrw.plot.fit_figure(vrw.fit(data, vrw.WheelParams(damping=150.0)))
    """
    check_type("result", result, FitResult, "give vrw.fit(data, params)")
    level = check_real("level", level)
    is_batch = result.values.ndim > 1
    table = result.residuals
    correlation = np.abs(np.nan_to_num(result.correlation.values)).reshape(
        -1, len(result.names), len(result.names)
    )[0]
    pairs = sorted(
        itertools.combinations(range(len(result.names)), 2), key=lambda pair: -correlation[pair]
    )[:MAX_DRAWN_PAIRS]
    columns = [] if is_batch else list(result.data.names)
    own_units = _find_own_units(result)
    n_panels = len(columns) + (not is_batch) + len(pairs)
    n_columns = min(3, max(n_panels, 1))
    n_rows = -(-n_panels // n_columns)
    figure = StyledFigure(
        figsize=(find_width_inches(width, PAGE_FIGURE_WIDTH_INCHES), PANEL_HEIGHT_INCHES * n_rows)
    )
    panels = iter(figure.subplots(n_rows, n_columns, squeeze=False).flat)
    position_name = next((x for x in ("time", "step") if x in table.coords), None)
    positions = table[position_name].values if position_name else np.arange(table.sizes["row"])
    position_label = {"time": "time [s]", "step": "step"}.get(str(position_name), "row")
    for name in columns:
        axes = next(panels)
        axes.errorbar(
            positions,
            table[name],
            table[f"{name}_error"],
            fmt=".",
            color=DARK_GRAY_COLOR,
            markersize=3.0,
            elinewidth=0.5,
            label="measured",
        )
        axes.plot(
            positions,
            table[f"{name}_predicted"],
            "-" if position_name == "time" else "_",
            color=OKABE_ITO_BLUE,
            label="fitted",
        )
        ylabel = format_axis_label(name, "{symbol}", own_units)
        axes.set(xlabel=position_label, ylabel=ylabel)
        axes.xaxis.set_major_locator(MaxNLocator(4, integer=position_name != "time"))
    if columns:
        # Above the panels, legends cover no points.
        legend_settings = {"loc": "lower center", "bbox_to_anchor": (0.5, 1.0), "fontsize": 7.0}
        legend_width = 0.8 * figure.get_figwidth() / n_columns
        add_wrapped_legend(axes, 2, legend_width, **legend_settings)
        axes = next(panels)
        axes.axhspan(-2.0, 2.0, color=LIGHT_GRAY_COLOR, zorder=0)
        for name in columns:
            axes.plot(positions, table[f"{name}_residual"], ".", label=name)
        axes.set(xlabel=position_label, ylabel="residual [standard errors]")
        add_wrapped_legend(axes, len(columns), legend_width, **legend_settings)
    for i, j in pairs:
        _draw_ellipse(next(panels), result, i, j, level, own_units)
    for axes in panels:
        axes.remove()
    return figure


def _find_own_units(result: FitResult) -> xr.Dataset:
    """Return the units of all quantities of a walker of the user, or of the unknowns of a wheel
    that the library does not have.
    """
    units = dict(zip(result.names, result.units, strict=True))
    finder = result.problem.finder
    symbols = {name: domain.symbol for name, domain in finder.model.parameter_domains.items()}
    if not is_own_walker(result.model):
        own_names = [name for name in result.names if name not in MEASURES]
        return declare_own_quantities(own_names, [units[name] for name in own_names], symbols)
    measures = {measure.name: measure.unit for measure in finder.described_measures}
    symbols |= {measure.name: measure.symbol for measure in finder.described_measures}
    units = getattr(result.model, "state_units", {}) | measures | units
    units = dict.fromkeys(result.data.names, "1") | units
    return declare_own_quantities(units, units.values(), symbols)


def _draw_ellipse(
    axes: Axes, result: FitResult, i: int, j: int, level: float, own_units: xr.Dataset
) -> None:
    """Draw two estimates with their ellipse, or those of all data sets."""
    values = result.values.reshape(-1, len(result.names))
    if len(values) > 1:
        axes.plot(values[:, i], values[:, j], ".", color=OKABE_ITO_BLUE, markersize=2.0)
    else:
        covariance = result.covariance[np.ix_([i, j], [i, j])]
        angles = np.linspace(0.0, 2.0 * np.pi, N_CURVE_POINTS)
        # chi2 of two degrees of freedom
        radius = np.sqrt(2.0 * gammaincinv(1.0, level))
        eigenvalues, directions = np.linalg.eigh(covariance)
        half_axes = directions * np.sqrt(np.maximum(eigenvalues, 0.0))
        ellipse = values[0, [i, j], None] + radius * half_axes @ [np.cos(angles), np.sin(angles)]
        axes.plot(*ellipse, color=OKABE_ITO_BLUE)
        axes.plot(values[0, i], values[0, j], "+", color=OKABE_ITO_ORANGE)
    axes.set(
        xlabel=format_axis_label(result.names[i], "{symbol}", own_units),
        ylabel=format_axis_label(result.names[j], "{symbol}", own_units),
    )
