"""Beyond λ4⁺ = 0 (c = 219.85) gaits of 6, 5, 4 ... steps attract, one landing in each without DLS.

    python -m experiments.gaits.orbit_diagram [folder] [--redraw]

Many starts at each damping are walked until they repeat or fall. Writes `orbit_diagram.svg`, `.png`
and `.csv` to `results/` or the folder given.
"""

from pathlib import Path

import numpy as np
import pandas as pd
import xarray as xr
from matplotlib.figure import Figure

import vrw_jax as vrw
from experiments.shared.command import make_parser, parse_and_start_jax
from vrw_jax import figures as plots
from vrw_jax.figures.branch_figures import BRANCH_END_COLOR, SPECIAL_POINT_LINE_STYLE
from vrw_jax.figures.style import draw_marks, format_axis_label
from vrw_jax.simulation.attractors import (
    WalkEnds,
    find_distinct_orbits,
    measure_orbits,
    walk_until_periodic,
)

DAMPINGS = np.round(np.arange(215.0, 225.001, 0.1), 3)  # N s/m
N_STARTS = 12
TABLE = "orbit_diagram.csv"
MOST_STEPS, LONGEST_PERIOD = 300, 40
PREMISES = ("clearance_sls1", "clearance_sls2", "locked_stopper_force", "fore_foot_force")


def starts() -> np.ndarray:
    """Section states scattered around the gait at c = 219."""
    draw = np.random.default_rng(1).uniform
    sizes = (N_STARTS,)
    return np.stack([draw(0.0, 0.2, sizes), draw(1.3, 1.8, sizes), draw(-0.3, 0.0, sizes)], 1)


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("folder", type=Path, nargs="?", default="results")
    parser.add_argument("--redraw", action="store_true", help="walk nothing: draw the table there")
    chosen = parse_and_start_jax(parser)
    if not chosen.redraw:
        compute().to_csv(create_folder(chosen.folder) / TABLE, index=False, float_format="%.7g")
    table = pd.read_csv(chosen.folder / TABLE)
    border = vrw.continue_branch(vrw.WheelParams(), "damping", (190.0, 230.0)).special_points[-1]
    figure = orbit_figure(table.to_xarray(), border.value)
    plots.save(figure, chosen.folder, "orbit_diagram")


@plots.figure_style()
def orbit_figure(orbits: xr.Dataset, border: float) -> Figure:
    """Post-impact rates and periods of all that attracts, a row a step, over damping.

    Open: the foot scuffs somewhere in that step; a cross: a step without double support. `border`:
    where λ4⁺ = 0.
    """
    value = orbits.damping.values
    lifts, scuffs = orbits.duration_dls.values == 0.0, orbits.clearance.values < 0.0
    figure = Figure(figsize=(plots.PAGE_WIDTH_INCHES, 3.9))
    rates, periods = figure.subplots(2, 1, sharex=True, height_ratios=[2.2, 1.0])
    groups = (
        (~lifts & ~scuffs, "o", plots.LEG_1_COLOR, plots.LEG_1_COLOR, "with DLS"),
        (~lifts & scuffs, "o", plots.LEG_1_COLOR, "white", "with DLS, foot 2 scuffs"),
        (
            lifts,
            "x",
            plots.LEG_2_COLOR,
            plots.LEG_2_COLOR,
            "rear foot lifts at once ($\\lambda_4^+ < 0$)",
        ),
        (lifts & scuffs, "o", plots.LEG_2_COLOR, "none", "the same, foot 2 scuffs"),
    )
    for chosen, marker, colour, fill, text in groups:
        if chosen.any():
            size = 2.4 if marker == "o" else 3.4
            x, y = value[chosen], orbits.dtheta_post_impact.values[chosen]
            draw_marks(rates, x, y, marker, colour, fill, markersize=size, label=text)
    periods.plot(value, orbits.period.values, "s", color="black", markersize=2.0)
    for axes in (rates, periods):
        axes.axvline(
            border,
            color=BRANCH_END_COLOR,
            linewidth=0.7,
            linestyle=SPECIAL_POINT_LINE_STYLE,
            zorder=0,
        )
        for left_part, right in _empty_stretches(orbits):
            axes.axvspan(left_part, right, color=plots.LIGHT_GRAY, linewidth=0.0, zorder=0)
    for left_part, right in _empty_stretches(orbits)[-1:]:
        rates.text(0.5 * (left_part + right), 0.5, "falls", rotation=90, ha="center", va="center",
                   transform=rates.get_xaxis_transform(), color=plots.DARK_GRAY)  # fmt: skip
    rates.text(border, 0.4, " $\\lambda_4^+ = 0$", color=BRANCH_END_COLOR,
               transform=rates.get_xaxis_transform())  # fmt: skip
    rates.set_ylabel("rate after landing, $\\dot\\theta^+$ [rad/s]")
    rates.legend(loc="lower left", fontsize=7.5)
    periods.set_ylabel("period [steps]")
    periods.set_ylim(0.0, 1.0 + float(orbits.period.max()))
    periods.yaxis.get_major_locator().set_params(integer=True)
    periods.set_xlabel(format_axis_label("damping"))
    return figure


def _empty_stretches(orbits: xr.Dataset) -> list[tuple[float, float]]:
    """Stretches of the damping where no start settled."""
    empty = ~np.isin(DAMPINGS, orbits.damping.values)
    half = 0.5 * (DAMPINGS[1] - DAMPINGS[0])
    cuts = np.flatnonzero(np.diff(empty.astype(int))) + 1
    parts = [part for part in np.split(np.arange(len(DAMPINGS)), cuts) if empty[part[0]]]
    return [(DAMPINGS[part[0]] - half, DAMPINGS[part[-1]] + half) for part in parts]


def create_folder(folder: Path) -> Path:
    """The folder, there at the latest now."""
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def compute() -> pd.DataFrame:
    """Every step of every orbit that attracts, at each damping."""
    model = vrw.ViscoelasticWheel(stop_at_lift_off=False)  # λ2 < 0 is told, not a fall
    options = vrw.StepOptions(rtol=1e-9, atol=1e-9)
    dampings = np.repeat(DAMPINGS, N_STARTS)
    walk_result = walk_until_periodic(
        vrw.WheelParams(damping=dampings),
        np.tile(starts(), (len(DAMPINGS), 1)),
        model,
        options,
        MOST_STEPS,
        LONGEST_PERIOD,
    )
    rows = []
    for damping in DAMPINGS:
        values_here = WalkEnds(*(part[dampings == damping] for part in walk_result))
        fell = [vrw.Outcome(int(c)).name for c in values_here.outcome if c != vrw.Outcome.STEPPED]
        orbits = find_distinct_orbits(values_here)
        for index, orbit in enumerate(orbits.orbits):
            result = measure_orbits(vrw.WheelParams(damping=damping), orbit, model, options)
            for k in range(len(orbit)):
                broken = [name for name in PREMISES if result[name][k].min() < 0.0]
                rows.append(
                    {
                        "damping": damping,
                        "orbit": index,
                        "period": len(orbit),
                        "step": k,
                        "theta_post_impact": result["theta_post_impact"][k],
                        "dtheta_post_impact": result["dtheta_post_impact"][k],
                        "duration_dls": result["duration_dls"][k],
                        "lambda_4_plus": result["lambda_4_plus"][k],
                        "clearance": min(result[name][k] for name in PREMISES[:2]),
                        "broken": " ".join(broken),
                        "share_of_starts": np.mean(orbits.orbit_index == index),
                    }
                )
        print(damping, sorted({len(o) for o in orbits.orbits}), {n: fell.count(n) for n in fell})
    return pd.DataFrame(rows)


if __name__ == "__main__":
    main()
