"""Compute the atlas of gaits with unilateral contact over damping and friction.

    python -m experiments.ground.atlas [--redraw]

A scan finds all attracting gaits of each wheel (`find_attracting_gaits`: walks from slow and fast
starts, then Newton's method). Branches start at the slow gaits with the highest friction. They go
down in friction, through the folds that end them, and back along the unstable gaits between.
"""

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import LogNorm, Normalize
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

import vrw_jax as vrw
from experiments.shared.command import make_parser, parse_and_start_jax
from experiments.shared.tables import FIGURES, Row, read_column, read_table, write_named_rows
from vrw_jax import plot as plots
from vrw_jax.gaits import find_attracting_gaits, make_finder

FRICTION = (0.35, 0.4, 0.45, 0.5, 0.55, 0.6, 0.65, 0.7, 0.75, 0.8, 0.85, 0.9, 0.95, 1.0, 1.1, 1.2,
            1.3, 1.4, 1.5, 1.6)  # fmt: skip
DAMPING = tuple(float(c) for c in range(20, 401, 10))
BRANCH_DAMPINGS = (195.0, 200.0, 205.0, 210.0, 215.0, 220.0, 240.0, 270.0, 300.0, 340.0, 380.0)
BRANCH_FRICTION_RANGE = (0.32, 1.4)
"""Friction along the branches, which start at the upper end."""
CONTINUATION_OPTIONS = vrw.ArclengthOptions(initial_ds=0.02, max_ds=0.06, max_points=80)
NO_GAIT_COLOR, GAIT_TABLE, BRANCH_TABLE = (
    "0.85",
    FIGURES / "ground_atlas.csv",
    FIGURES / "ground_atlas_branches.csv",
)
FOLD_MARKER = {
    "marker": "o", "markersize": 3.5, "markerfacecolor": "white", "color": "black", "linewidth": 1.2
}  # fmt: skip
"""Style of a fold, chosen because it is visible on every color of the maps."""
MEASURES = ("period", "dls_fraction", "speed", "slip", "energy_lost_friction")


def scan_gaits(frictions: tuple[float, ...] = FRICTION) -> list[Row]:
    """Return a row for each attracting gait, and one row for a wheel without any."""
    rows = []
    for friction in frictions:
        finder = make_finder(vrw.UnilateralWheel(friction=friction), 8)
        wheels = vrw.WheelParams(damping=jnp.asarray(DAMPING))
        wheels = jax.tree.map(lambda x: jnp.broadcast_to(x, len(DAMPING)), wheels)
        wheel_index, all_gaits = find_attracting_gaits(
            finder, jax.vmap(finder.model.collect_parameter_values)(wheels)
        )
        for wheel, damping in enumerate(DAMPING):
            gaits = jax.tree.map(lambda leaf, own=wheel_index == wheel: leaf[own], all_gaits)
            is_found = np.asarray(gaits.found)
            common_cells = {"friction": friction, "damping": damping, "gaits": int(is_found.sum())}
            if not is_found.any():
                code = vrw.Outcome(int(gaits.outcome[0])).name
                rows.append(common_cells | {"outcome": code})
                continue
            measures = jax.vmap(lambda steps: steps.measures())(
                jax.tree.map(lambda x: x[:, 0], gaits.steps)
            )
            for k in range(len(is_found)):
                rows.append(
                    common_cells
                    | {"outcome": "STEPPED"}
                    | {name: f"{float(measures[name][k]):.6g}" for name in MEASURES}
                    | {
                        "flight": f"{float(measures['duration_flight'][k] / measures['period'][k]):.5g}",  # noqa: E501
                        "spectral_radius": f"{float(gaits.spectral_radius[k]):.5g}",
                        "stopper_force": f"{float(gaits.margins.stopper_force[k]):.5g}",
                        "solutions": int(gaits.steps.most_solutions[k].max()),
                    }
                )
        print(f"mu = {friction:g}", flush=True)
    return rows


def follow_branches() -> list[Row]:
    """Return the points of the branches that start at the slow gaits and go down in friction."""
    ground = vrw.UnilateralWheel(friction=BRANCH_FRICTION_RANGE[1])
    wheels = vrw.WheelParams(damping=jnp.asarray(BRANCH_DAMPINGS))
    wheels = jax.tree.map(lambda x: jnp.broadcast_to(x, len(BRANCH_DAMPINGS)), wheels)
    slow_gaits = vrw.limit_cycles(wheels, model=ground)
    result_by_name = {"cycle": slow_gaits, "model": ground, "options": CONTINUATION_OPTIONS}
    branches = vrw.continue_branches(wheels, "friction", BRANCH_FRICTION_RANGE, **result_by_name)
    rows = []
    for damping, speed, branch in zip(BRANCH_DAMPINGS, slow_gaits.speed, branches, strict=True):
        print(damping, float(speed), branch, flush=True)
        for k, friction in enumerate(branch.values):
            branch_point = branch.dataset.isel(point=k)
            row = {"damping": damping, "kind": "gait", "friction": f"{friction:.6g}"}
            result_by_name = {
                name: f"{float(branch_point[name]):.6g}" for name in (*MEASURES, "spectral_radius")
            }
            rows.append(row | result_by_name)
        for special_point in branch.special_points:
            kind = special_point.kind if special_point.kind != "lost" else special_point.name
            rows.append(
                {"damping": damping, "kind": kind, "friction": f"{special_point.value:.9g}"}
            )
    return rows


def compute() -> None:
    """Compute both tables."""
    write_named_rows(GAIT_TABLE, scan_gaits())
    write_named_rows(BRANCH_TABLE, follow_branches())


def tabulate_gaits(rows: list[Row], name: str, gait_number: int) -> np.ndarray:
    """Return a measure of each wheel's gait number 0 (slowest) or 1, shape (friction, damping)."""
    result = np.full((len(FRICTION), len(DAMPING)), np.nan)
    n_gaits: dict[tuple[int, int], int] = {}
    for row in rows:  # The slowest gait of a wheel comes first.
        cell = FRICTION.index(float(row["friction"])), DAMPING.index(float(row["damping"]))
        if row["outcome"] == "STEPPED" and n_gaits.setdefault(cell, 0) == gait_number:
            result[cell] = float(row[name])
        n_gaits[cell] = n_gaits.get(cell, 0) + 1
    return result


def read_folds() -> tuple[np.ndarray, np.ndarray]:
    """Return damping and friction of the folds at which the slow gait ends."""
    rows = [row for row in read_table(BRANCH_TABLE) if row["kind"] == "fold"]
    c, mu = read_column(rows, "damping"), read_column(rows, "friction")
    ends = c < 220.0  # At higher damping two folds lie close together, and the branch continues.
    return c[ends], mu[ends]


def draw() -> None:
    """Draw maps of the slower gait above, and of the faster one of two below."""
    rows, (c_fold, mu_fold) = read_table(GAIT_TABLE), read_folds()
    shown_by_name = {  # label and normalization of the colors
        "speed": ("speed [m/s]", Normalize(0.0, 3.0)),
        "dls_fraction": ("DLS fraction", Normalize(0.0, 0.9)),
        "slip": ("slip per step [m]", LogNorm(0.01, 1.0)),
    }
    figure, axes = plt.subplots(
        2, 3, figsize=(plots.PAGE_FIGURE_WIDTH_INCHES, 4.8), sharex=True, sharey=True
    )
    corners = [compute_cell_edges(np.array(values)) for values in (DAMPING, FRICTION)]
    for column, (name, (label, norm)) in enumerate(shown_by_name.items()):
        for gait_number, axis in enumerate(axes[:, column]):
            axis.set_facecolor(NO_GAIT_COLOR)
            image = axis.pcolormesh(
                *corners, tabulate_gaits(rows, name, gait_number), norm=norm, rasterized=True
            )
            axis.plot(c_fold, mu_fold, **FOLD_MARKER)
            axis.axhline(np.tan(0.3), color="black", linewidth=0.8)
            axis.set_ylim(0.28, corners[1][-1])
        axes[0, column].set_title(label)
        axes[-1, column].set_xlabel("damping $c$ [N·s/m]")
        figure.colorbar(image, ax=axes[:, column], location="bottom", extend="both", aspect=18)
    for axis, text in zip(axes[:, 0], ("slower gait", "faster gait"), strict=True):
        axis.set_ylabel(f"{text}: friction $\\mu$")
    lines = [
        Line2D([], [], **FOLD_MARKER, label="fold that ends the slow gait"),
        Line2D([], [], color="black", linewidth=0.8, label="$\\tan\\phi$: no gait below"),
        Patch(color=NO_GAIT_COLOR, label="no such gait"),
    ]
    figure.legend(handles=lines, loc="outside lower center", ncols=3)
    plots.save(figure, FIGURES, "ground_atlas")


def draw_branches() -> None:
    """Draw the branches that turn in a fold, stable gaits solid, and save the figure."""
    quantities = {
        "dls_fraction": "DLS fraction",
        "period": "period [s]",
        "slip": "slip per step [m]",
    }
    rows, (c_fold, mu_fold) = read_table(BRANCH_TABLE), read_folds()
    figure, axes = plt.subplots(1, 3, figsize=(plots.PAGE_FIGURE_WIDTH_INCHES, 2.8), sharex=True)
    colors = plt.get_cmap("viridis")(np.linspace(0.0, 0.85, len(c_fold)))
    for damping, friction_of_fold, color in zip(c_fold, mu_fold, colors, strict=True):
        gaits = [row for row in rows if row["kind"] == "gait" and float(row["damping"]) == damping]
        friction, spectral_radius = (
            read_column(gaits, name) for name in ("friction", "spectral_radius")
        )
        turn = int(np.argmin(np.abs(friction - friction_of_fold)))
        for axis, name in zip(axes, quantities, strict=True):
            values = read_column(gaits, name)
            stable_values = np.where(spectral_radius < 1.0, values, np.nan)
            axis.plot(friction, values, color=color, ls=":", lw=1.2)
            axis.plot(friction, stable_values, color=color, lw=2.0, label=f"c = {damping:g} N·s/m")
            axis.plot(friction[turn], values[turn], **FOLD_MARKER)
    for axis, label in zip(axes, quantities.values(), strict=True):
        axis.set(xlabel="friction coefficient $\\mu$", ylabel=label)
    lines = [
        *axes[0].get_legend_handles_labels()[0],
        Line2D([], [], color="black", lw=2.0, label="stable"),
        Line2D([], [], color="black", ls=":", lw=1.2, label="unstable"),
        Line2D([], [], **{**FOLD_MARKER, "linewidth": 0.0}, label="fold"),
    ]
    figure.legend(handles=lines, loc="outside lower center", ncols=4)
    plots.save(figure, FIGURES, "ground_branches")


def compute_cell_edges(values: np.ndarray) -> np.ndarray:
    """Return the edges of the cells around equidistant or unequal centers."""
    middle = 0.5 * (values[1:] + values[:-1])
    return np.concatenate([[2.0 * values[0] - middle[0]], middle, [2.0 * values[-1] - middle[-1]]])


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument(
        "--redraw", action="store_true", help="draw the stored table without computing"
    )
    if not parse_and_start_jax(parser).redraw:
        compute()
    with plots.figure_style():
        draw()
        draw_branches()


if __name__ == "__main__":
    main()
