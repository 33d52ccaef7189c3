"""Tornado plots: the parameters that change a measure most, as bars sorted by length."""

import math
from collections.abc import Iterable, Mapping

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vrw_jax.figures.style import (
    AMBER,
    BLUE,
    PAGE_WIDTH_INCHES,
    figure_style,
    format_axis_label,
    require_variables,
    typeset_symbols,
)
from vrw_jax.measures import MEASURES
from vrw_jax.validation import check_known_name, check_names, check_positive
from vrw_jax.wheel import check_parameter_name

MAX_PANELS_PER_ROW = 3
"""Largest number of panels in a row, chosen because four leave no room for parameter symbols."""

MAX_DEFAULT_MEASURES = 6
"""Largest number of measures drawn by default, chosen because two rows of panels fit a page."""

BAR_HEIGHT_INCHES = 0.2
"""Height of the row of one parameter, chosen because its symbol has that height."""


@figure_style()
def tornado_figure(
    table: xr.Dataset,
    measures: str | Iterable[str] | None = None,
    *,
    spreads: Mapping[str, float] | None = None,
) -> Figure:
    """Return a figure of the change of each measure with each parameter, largest changes on top.

    Changes are of first order, from the derivatives of the gait. By default they are in per cent of
    the measure for 1 % of each parameter. With `spreads` they are in the unit of the measure for
    these changes of the parameters. An undefined change, such as for 1 % of a slope of 0, is left
    out.

    Args:
        table: dataset of `vrw.sensitivities`.
        measures: names of the measures; by default the first six of the table.
        spreads: change of each parameter by name, in its unit; other parameters are left out.

    Returns:
        Figure: one panel per measure, with bars over the parameters.

    Raises:
        TypeError, ValueError: if an argument is invalid.

    Examples:
        >>> table = vrw.sensitivities(vrw.WheelParams(), measures=["speed", "dls_fraction"])
        >>> figure = vrw.plot.tornado_figure(table)
        >>> figure = vrw.plot.tornado_figure(table, "speed", spreads={"damping": 10.0})
    """
    require_variables(
        "table", table, ("derivative", "elasticity"), "give vrw.sensitivities(params)"
    )
    known_measures = tuple(map(str, table.measure.values))
    names = known_measures[:MAX_DEFAULT_MEASURES]
    if measures is not None:
        names = check_names("measures", measures)
    for name in names:
        check_known_name(name, known_measures, "measure of this table")
    if not names:
        raise ValueError('measures is empty, but something is to be drawn: give "speed", say.')
    changes = _compute_changes(table, spreads)
    n_columns = min(len(names), MAX_PANELS_PER_ROW)
    n_rows = math.ceil(len(names) / n_columns)
    height = n_rows * (BAR_HEIGHT_INCHES * changes.sizes["parameter"] + 0.8) + 0.3
    width = PAGE_WIDTH_INCHES if n_columns > 1 else 0.6 * PAGE_WIDTH_INCHES
    figure = Figure(figsize=(width, height))
    panels = figure.subplots(n_rows, n_columns, squeeze=False).ravel()
    for axes in panels[len(names) :]:
        axes.set_axis_off()
    for axes, name in zip(panels, names, strict=False):
        _draw_bars(axes, changes.sel(measure=name))
        axes.set_title(typeset_symbols(MEASURES[name].long_name))
        change_label = format_axis_label(name, "change of {symbol}")
        axes.set_xlabel("change [%]" if spreads is None else change_label)
    parameter_change_text = "1 %" if spreads is None else "by its spread"
    handles, _ = panels[0].get_legend_handles_labels()
    labels = [f"parameter {direction} {parameter_change_text}" for direction in ("up", "down")]
    figure.legend(handles, labels, loc="outside lower center", ncols=2)
    return figure


def _compute_changes(table: xr.Dataset, spreads: Mapping[str, float] | None) -> xr.DataArray:
    """Return the change of each measure for an increase of each parameter."""
    if spreads is None:
        return table.elasticity  # changes in per cent for 1 %
    known_parameters = tuple(map(str, table.parameter.values))
    for name in spreads:
        check_parameter_name(name, known_parameters, "parameter of this table")
    if not spreads:
        raise ValueError('spreads is empty, but bars need one: give {"damping": 10.0}, say.')
    widths = [check_positive(f"spreads[{name!r}]", width) for name, width in spreads.items()]
    return table.derivative.sel(parameter=list(spreads)) * np.array(widths)


def _draw_bars(axes: Axes, changes: xr.DataArray) -> None:
    """Draw the bars of one measure, the longest on top."""
    changes = changes[np.isfinite(changes.values)]
    changes = changes[np.argsort(-np.abs(changes.values), kind="stable")]
    positions = np.arange(changes.size)
    for signs, color in ((1.0, BLUE), (-1.0, AMBER)):
        axes.barh(positions, signs * changes.values, 0.7, color=color, label=str(signs))
    axes.axvline(0.0, color="black", linewidth=0.6)
    symbols = [f"${MEASURES[str(name)].mathtext}$" for name in changes.parameter.values]
    axes.set_yticks(positions, symbols)
    axes.set_ylim(changes.size - 0.5, -0.5)
