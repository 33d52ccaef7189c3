"""The damping and the stiffness of the most stable gait at each slope, and where limits change.

    python -m experiments.tuning.optima_along_slope [folder]

Follows the optimum of `vrw.tune` from the slope 0.30 downward to 0.05, or to the slope at which no
wheel nearby satisfies the default margins. Writes `optima_along_slope.svg` and `.png` to `results/`
or the folder given.
"""

import numpy as np
from matplotlib.figure import Figure

import vrw_jax as vrw
from experiments.shared.command import parse_folder_and_start_jax
from vrw_jax import plot as plots

BOUNDS = {"damping": (20.0, 1000.0), "stiffness": (150.0, 1500.0)}
SLOPES = np.linspace(0.30, 0.05, 101)
PANELS = (
    ("damping", plots.style.format_axis_label("damping")),
    ("stiffness", plots.style.format_axis_label("stiffness")),
    ("objective", "largest stability margin"),
)


def main() -> None:
    folder = parse_folder_and_start_jax(__doc__)
    curve = vrw.tune(
        vrw.WheelParams(), "spectral_margin", tuple(BOUNDS), BOUNDS, along=("slope", SLOPES)
    )
    print(curve)
    plots.save(draw_optima(curve), folder, "optima_along_slope")


@plots.figure_style()
def draw_optima(curve: vrw.OptimumCurve) -> Figure:
    """Return the figure: the best parameters and the objective, with changes of active limits."""
    figure = Figure(figsize=(plots.PAGE_FIGURE_WIDTH_INCHES, 2.3), layout="constrained")
    all_axes = figure.subplots(1, len(PANELS))
    for axes, letter, (name, label) in zip(all_axes, "abc", PANELS, strict=True):
        axes.plot(curve.dataset.slope, curve.dataset[name], color="black")
        for change in curve.changes:
            axes.axvline(change.value, color=plots.LEG_2_COLOR, linestyle=(0, (1, 1.2)))
        axes.set_xlabel(plots.style.format_axis_label("slope"))
        axes.set_ylabel(label)
        plots.style.draw_panel_letter(axes, letter)
    return figure


if __name__ == "__main__":
    main()
