"""The atlas of gaits on real ground over damping and friction: which exist, and where they end.

python -m experiments.ground.atlas [--redraw]

One scan looks for all gaits that attract each wheel (`gaits_attracting`: walks from slow and fast
starts, then Newton's method). From the slow gaits at the highest friction branches in friction go
down, side by side, through the folds that end them and back on the unstable gaits between.
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
from vrw_jax import figures as plots
from vrw_jax.cycles import find_attracting_gaits, make_finder

FRICTION = (0.35, 0.4, 0.45, 0.5, 0.55, 0.6, 0.65, 0.7, 0.75, 0.8, 0.85, 0.9, 0.95, 1.0, 1.1, 1.2,
            1.3, 1.4, 1.5, 1.6)  # fmt: skip
DAMPING = tuple(float(c) for c in range(20, 401, 10))
BRANCH_DAMPINGS = (195.0, 200.0, 205.0, 210.0, 215.0, 220.0, 240.0, 270.0, 300.0, 340.0, 380.0)
BRANCH_FRICTION_RANGE = (0.32, 1.4)  # friction along the branches, which begin at its upper end
STEPS = vrw.ArclengthOptions(initial_ds=0.02, max_ds=0.06, max_points=80)
GREY, TABLE, BRANCHES = "0.85", FIGURES / "ground_atlas.csv", FIGURES / "ground_atlas_branches.csv"
FOLD = {
    "marker": "o", "markersize": 3.5, "markerfacecolor": "white", "color": "black", "linewidth": 1.2
}  # fmt: skip
"""Seen on every colour of the maps, and in the legend as there."""
MEASURES = ("period", "dls_fraction", "speed", "slip", "energy_lost_friction")


def scan_gaits(frictions: tuple[float, ...] = FRICTION) -> list[Row]:
    """A row for each gait that attracts a wheel, one for a wheel without any."""
    rows = []
    for friction in frictions:
        finder = make_finder(vrw.UnilateralWheel(friction=friction), 8)
        wheels = vrw.WheelParams(damping=jnp.asarray(DAMPING))
        wheels = jax.tree.map(lambda x: jnp.broadcast_to(x, len(DAMPING)), wheels)
        owner, every = find_attracting_gaits(
            finder, jax.vmap(finder.model.parameter_values)(wheels)
        )
        for wheel, damping in enumerate(DAMPING):
            gaits = jax.tree.map(lambda leaf, own=owner == wheel: leaf[own], every)
            values_array = np.asarray(gaits.found)
            where = {"friction": friction, "damping": damping, "gaits": int(values_array.sum())}
            if not values_array.any():
                code = vrw.Outcome(int(gaits.outcome[0])).name
                rows.append(where | {"outcome": code})
                continue
            result = jax.vmap(lambda steps: steps.measures())(
                jax.tree.map(lambda x: x[:, 0], gaits.steps)
            )
            for k in range(len(values_array)):
                rows.append(
                    where
                    | {"outcome": "STEPPED"}
                    | {name: f"{float(result[name][k]):.6g}" for name in MEASURES}
                    | {
                        "flight": f"{float(result['duration_flight'][k] / result['period'][k]):.5g}",  # noqa: E501
                        "spectral_radius": f"{float(gaits.spectral_radius[k]):.5g}",
                        "stopper_force": f"{float(gaits.margins.stopper_force[k]):.5g}",
                        "solutions": int(gaits.steps.most_solutions[k].max()),
                    }
                )
        print(f"mu = {friction:g}", flush=True)
    return rows


def follow_branches() -> list[Row]:
    """Points of branches down in friction from the slow gaits at its upper end."""
    ground = vrw.UnilateralWheel(friction=BRANCH_FRICTION_RANGE[1])
    wheels = vrw.WheelParams(damping=jnp.asarray(BRANCH_DAMPINGS))
    wheels = jax.tree.map(lambda x: jnp.broadcast_to(x, len(BRANCH_DAMPINGS)), wheels)
    slow = vrw.limit_cycles(wheels, model=ground)
    result_by_name = {"cycle": slow, "model": ground, "options": STEPS}
    branches = vrw.continue_branches(wheels, "friction", BRANCH_FRICTION_RANGE, **result_by_name)
    rows = []
    for damping, speed, branch in zip(BRANCH_DAMPINGS, slow.speed, branches, strict=True):
        print(damping, float(speed), branch, flush=True)
        for k, friction in enumerate(branch.values):
            value_at = branch.dataset.isel(point=k)
            row = {"damping": damping, "kind": "gait", "friction": f"{friction:.6g}"}
            result_by_name = {
                name: f"{float(value_at[name]):.6g}" for name in (*MEASURES, "spectral_radius")
            }
            rows.append(row | result_by_name)
        for border in branch.special_points:
            kind = border.kind if border.kind != "lost" else border.name
            rows.append({"damping": damping, "kind": kind, "friction": f"{border.value:.9g}"})
    return rows


def compute() -> None:
    write_named_rows(TABLE, scan_gaits())
    write_named_rows(BRANCHES, follow_branches())


def field(rows: list[Row], name: str, place: int) -> np.ndarray:
    """(friction, damping) of the slowest gait (0) or the faster one where there are two (1)."""
    result = np.full((len(FRICTION), len(DAMPING)), np.nan)
    counted: dict[tuple[int, int], int] = {}
    for row in rows:  # of a wheel slowest first
        value_at = FRICTION.index(float(row["friction"])), DAMPING.index(float(row["damping"]))
        if row["outcome"] == "STEPPED" and counted.setdefault(value_at, 0) == place:
            result[value_at] = float(row[name])
        counted[value_at] = counted.get(value_at, 0) + 1
    return result


def folds() -> tuple[np.ndarray, np.ndarray]:
    """Damping and friction at which the slow gait ends in a fold."""
    rows = [row for row in read_table(BRANCHES) if row["kind"] == "fold"]
    c, mu = read_column(rows, "damping"), read_column(rows, "friction")
    ends = c < 220.0  # beyond, two folds a hair apart end nothing
    return c[ends], mu[ends]


def draw() -> None:
    """Maps of the slower gait above, of the faster one where two attract below."""
    rows, (c_fold, mu_fold) = read_table(TABLE), folds()
    shown_by_name = {  # label, how to colour
        "speed": ("speed [m/s]", Normalize(0.0, 3.0)),
        "dls_fraction": ("DLS fraction", Normalize(0.0, 0.9)),
        "slip": ("slip per step [m]", LogNorm(0.01, 1.0)),
    }
    figure, axes = plt.subplots(
        2, 3, figsize=(plots.PAGE_WIDTH_INCHES, 4.8), sharex=True, sharey=True
    )
    corners = [compute_cell_edges(np.array(values)) for values in (DAMPING, FRICTION)]
    for column, (name, (label, norm)) in enumerate(shown_by_name.items()):
        for place, axis in enumerate(axes[:, column]):
            axis.set_facecolor(GREY)
            image = axis.pcolormesh(*corners, field(rows, name, place), norm=norm, rasterized=True)
            axis.plot(c_fold, mu_fold, **FOLD)
            axis.axhline(np.tan(0.3), color="black", linewidth=0.8)
            axis.set_ylim(0.28, corners[1][-1])
        axes[0, column].set_title(label)
        axes[-1, column].set_xlabel("damping $c$ [N·s/m]")
        figure.colorbar(image, ax=axes[:, column], location="bottom", extend="both", aspect=18)
    for axis, text in zip(axes[:, 0], ("slower", "faster of two"), strict=True):
        axis.set_ylabel(f"{text}: friction coefficient $\\mu$")
    lines = [
        Line2D([], [], **FOLD, label="fold that ends the slow gait"),
        Line2D([], [], color="black", linewidth=0.8, label="$\\tan\\phi$: no gait below"),
        Patch(color=GREY, label="one gait attracts"),
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
    rows, (c_fold, mu_fold) = read_table(BRANCHES), folds()
    figure, axes = plt.subplots(1, 3, figsize=(plots.PAGE_WIDTH_INCHES, 2.8), sharex=True)
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
            axis.plot(friction[turn], values[turn], **FOLD)
    for axis, label in zip(axes, quantities.values(), strict=True):
        axis.set(xlabel="friction coefficient $\\mu$", ylabel=label)
    lines = [
        *axes[0].get_legend_handles_labels()[0],
        Line2D([], [], color="black", lw=2.0, label="stable"),
        Line2D([], [], color="black", ls=":", lw=1.2, label="unstable"),
        Line2D([], [], **{**FOLD, "linewidth": 0.0}, label="fold"),
    ]
    figure.legend(handles=lines, loc="outside lower center", ncols=4)
    plots.save(figure, FIGURES, "ground_branches")


def compute_cell_edges(values: np.ndarray) -> np.ndarray:
    """Of cells around them."""
    middle = 0.5 * (values[1:] + values[:-1])
    return np.concatenate([[2.0 * values[0] - middle[0]], middle, [2.0 * values[-1] - middle[-1]]])


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--redraw", action="store_true", help="compute nothing")
    if not parse_and_start_jax(parser).redraw:
        compute()
    with plots.figure_style():
        draw()
        draw_branches()


if __name__ == "__main__":
    main()
