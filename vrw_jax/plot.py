"""Figures of labeled results. Only the package `app` imports matplotlib."""

from vrw_jax.app import figure_style as style
from vrw_jax.app._gait_figures import (
    branch_figure,
    foot_height,
    gait_panels,
    ground_forces,
    indicators,
    rear_force,
)
from vrw_jax.app._scan_figures import map_figure, scan_figures
from vrw_jax.app._study_figures import basin_figure, fit_figure, tornado_figure, tuning_figure
from vrw_jax.app._walk_figures import save_animation, sticks, walk_frames
from vrw_jax.app.figure_style import (
    DARK_GRAY_COLOR,
    LEG_1_COLOR,
    LEG_2_COLOR,
    LIGHT_GRAY_COLOR,
    PAGE_FIGURE_WIDTH_INCHES,
    figure_style,
    save,
)

__all__ = (
    "basin_figure",
    "branch_figure",
    "figure_style",
    "fit_figure",
    "foot_height",
    "gait_panels",
    "ground_forces",
    "indicators",
    "map_figure",
    "rear_force",
    "save",
    "save_animation",
    "scan_figures",
    "sticks",
    "tornado_figure",
    "tuning_figure",
    "walk_frames",
)  # The list of `help(vrw.plot)`.
