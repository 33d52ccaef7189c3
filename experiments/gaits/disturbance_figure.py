"""The gait of Table 1 is most sensitive to a faster rotation, just after the landing.

    python -m experiments.gaits.disturbance_figure [folder]

Draws the smallest change of the angular velocity that leaves the basin: at each instant of the step
of Table 1's gait, and along the branch of gaits over damping. Writes `disturbances.svg` and `.png`
to `results/` or the folder given.
"""

import numpy as np
from matplotlib.figure import Figure

import vrw_jax as vrw
from experiments.shared.command import parse_folder_and_start_jax
from vrw_jax import plot as plots

DAMPING_BOUNDS = (100.0, 219.0)
N_POINTS = 25
PHASE_LABELS = ("DLS", "SLS-I", "SLS-II")


def main() -> None:
    folder = parse_folder_and_start_jax(__doc__)
    params = vrw.WheelParams()
    result = vrw.smallest_disturbance(params)
    branch = vrw.continue_branch(params, "damping", DAMPING_BOUNDS)
    basins = vrw.measure_basins(branch, n_points=N_POINTS)
    print(result)
    plots.save(draw_disturbances(result, basins), folder, "disturbances")


@plots.figure_style()
def draw_disturbances(result: vrw.SmallestDisturbance, basins: object) -> Figure:
    """Return the figure: sizes over the step, and smallest sizes over damping."""
    figure = Figure(figsize=(plots.PAGE_FIGURE_WIDTH_INCHES, 2.7))
    profile, branch = figure.subplots(1, 2)
    curves = (
        ("slower", result.backward_sizes, plots.LEG_2_COLOR),
        ("faster", result.forward_sizes, plots.LEG_1_COLOR),
    )
    for phase, label in enumerate(PHASE_LABELS):
        is_in_phase = result.profile_phase_indices == phase
        times = result.profile_times[is_in_phase]
        if phase == 1:
            profile.axvspan(
                times[0], times[-1], color=plots.LIGHT_GRAY_COLOR, linewidth=0.0, zorder=0
            )
        profile.text(
            float(np.mean(times[[0, -1]])), 1.02, label, ha="center", va="bottom",
            transform=profile.get_xaxis_transform(), color=plots.DARK_GRAY_COLOR, fontsize=7.5,
        )  # fmt: skip
        for name, sizes, color in curves:
            text = name if phase == 0 else None
            profile.plot(times, sizes[is_in_phase], color=color, label=text)
    profile.plot([result.time], [result.size], "o", color="black", markersize=3.5, clip_on=False)
    profile.set_xlabel("time after the landing [s]")
    profile.set_ylabel("smallest change of $\\dot\\theta$ [rad/s]")
    profile.set_ylim(bottom=0.0)
    profile.set_xlim(result.profile_times[0], result.profile_times[-1])
    profile.legend()
    branch.plot(basins.damping, basins.smallest_disturbance, "o-", color="black", markersize=2.5)
    branch.set_xlabel(plots.style.format_axis_label("damping"))
    branch.set_ylabel("smallest change over the step [rad/s]")
    branch.set_ylim(bottom=0.0)
    plots.style.draw_panel_letter(profile, "a")
    plots.style.draw_panel_letter(branch, "b")
    return figure


if __name__ == "__main__":
    main()
