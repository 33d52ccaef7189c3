"""Figures of labeled results. Only this package imports matplotlib."""

from vrw_jax.figures import branch_figures, style
from vrw_jax.figures.branch_figures import basin_figure, branch_figure
from vrw_jax.figures.scan_figures import map_figure, scan_figures
from vrw_jax.figures.style import (
    DARK_GRAY_COLOR,
    LEG_1_COLOR,
    LEG_2_COLOR,
    LIGHT_GRAY_COLOR,
    PAGE_FIGURE_WIDTH_INCHES,
    figure_style,
    save,
)
from vrw_jax.figures.tornado_figures import tornado_figure
from vrw_jax.figures.tuning_figures import tuning_figure
from vrw_jax.figures.walk_figures import (
    foot_height,
    gait_panels,
    indicators,
    rear_force,
    save_animation,
    sticks,
    walk_frames,
)
