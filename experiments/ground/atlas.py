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
from experiments.shared.command import command, started
from experiments.shared.tables import FIGURES, Row, numbers, read, write_named
from vrw_jax import figures as plots
from vrw_jax.cycles import finder_of, gaits_attracting

FRICTION = (0.35, 0.4, 0.45, 0.5, 0.55, 0.6, 0.65, 0.7, 0.75, 0.8, 0.85, 0.9, 0.95, 1.0, 1.1, 1.2,
            1.3, 1.4, 1.5, 1.6)  # fmt: skip
DAMPING = tuple(float(c) for c in range(20, 401, 10))
FOLLOWED = (195.0, 200.0, 205.0, 210.0, 215.0, 220.0, 240.0, 270.0, 300.0, 340.0, 380.0)
DOWN = (0.32, 1.4)  # friction along the branches, which begin at its upper end
STEPS = vrw.ArclengthOptions(first_step=0.02, largest_step=0.06, max_points=80)
GREY, TABLE, BRANCHES = "0.85", FIGURES / "ground_atlas.csv", FIGURES / "ground_atlas_branches.csv"
FOLD = {
    "marker": "o", "markersize": 3.5, "markerfacecolor": "white", "color": "black", "linewidth": 1.2
}  # fmt: skip
"""Seen on every colour of the maps, and in the legend as there."""
MEASURES = ("period", "dls_fraction", "speed", "slip", "energy_lost_friction")


def scanned(frictions: tuple[float, ...] = FRICTION) -> list[Row]:
    """A row for each gait that attracts a wheel, one for a wheel without any."""
    rows = []
    for friction in frictions:
        finder = finder_of(vrw.UnilateralWheel(friction=friction), 8)
        wheels = vrw.WheelParams(damping=jnp.asarray(DAMPING))
        wheels = jax.tree.map(lambda x: jnp.broadcast_to(x, len(DAMPING)), wheels)
        owner, every = gaits_attracting(finder, jax.vmap(finder.model.values)(wheels))
        for wheel, damping in enumerate(DAMPING):
            gaits = jax.tree.map(lambda leaf, own=owner == wheel: leaf[own], every)
            found = np.asarray(gaits.found)
            where = {"friction": friction, "damping": damping, "gaits": int(found.sum())}
            if not found.any():
                code = vrw.Outcome(int(gaits.outcome[0])).name
                rows.append(where | {"outcome": code})
                continue
            told = jax.vmap(lambda steps: steps.measures())(
                jax.tree.map(lambda x: x[:, 0], gaits.steps)
            )
            for k in range(len(found)):
                rows.append(
                    where
                    | {"outcome": "STEPPED"}
                    | {name: f"{float(told[name][k]):.6g}" for name in MEASURES}
                    | {
                        "flight": f"{float(told['duration_flight'][k] / told['period'][k]):.5g}",
                        "spectral_radius": f"{float(gaits.spectral_radius[k]):.5g}",
                        "stopper_force": f"{float(gaits.monitors.stopper_force[k]):.5g}",
                        "solutions": int(gaits.steps.most_solutions[k].max()),
                    }
                )
        print(f"mu = {friction:g}", flush=True)
    return rows


def followed() -> list[Row]:
    """Points of branches down in friction from the slow gaits at its upper end."""
    ground = vrw.UnilateralWheel(friction=DOWN[1])
    wheels = vrw.WheelParams(damping=jnp.asarray(FOLLOWED))
    wheels = jax.tree.map(lambda x: jnp.broadcast_to(x, len(FOLLOWED)), wheels)
    slow = vrw.limit_cycles(wheels, model=ground)
    told = {"cycle": slow, "model": ground, "options": STEPS}
    branches = vrw.continue_branches(wheels, "friction", DOWN, **told)
    rows = []
    for damping, speed, branch in zip(FOLLOWED, slow.speed, branches, strict=True):
        print(damping, float(speed), branch, flush=True)
        for k, friction in enumerate(branch.values):
            at = branch.dataset.isel(point=k)
            row = {"damping": damping, "kind": "gait", "friction": f"{friction:.6g}"}
            told = {name: f"{float(at[name]):.6g}" for name in (*MEASURES, "spectral_radius")}
            rows.append(row | told)
        for border in branch.borders:
            kind = border.kind if border.kind != "lost" else border.name
            rows.append({"damping": damping, "kind": kind, "friction": f"{border.value:.9g}"})
    return rows


def compute() -> None:
    write_named(TABLE, scanned())
    write_named(BRANCHES, followed())


def field(rows: list[Row], name: str, place: int) -> np.ndarray:
    """(friction, damping) of the slowest gait (0) or the faster one where there are two (1)."""
    told = np.full((len(FRICTION), len(DAMPING)), np.nan)
    counted: dict[tuple[int, int], int] = {}
    for row in rows:  # of a wheel slowest first
        at = FRICTION.index(float(row["friction"])), DAMPING.index(float(row["damping"]))
        if row["outcome"] == "STEPPED" and counted.setdefault(at, 0) == place:
            told[at] = float(row[name])
        counted[at] = counted.get(at, 0) + 1
    return told


def folds() -> tuple[np.ndarray, np.ndarray]:
    """Damping and friction at which the slow gait ends in a fold."""
    rows = [row for row in read(BRANCHES) if row["kind"] == "fold"]
    c, mu = numbers(rows, "damping"), numbers(rows, "friction")
    ends = c < 220.0  # beyond, two folds a hair apart end nothing
    return c[ends], mu[ends]


def draw() -> None:
    """Maps of the slower gait above, of the faster one where two attract below."""
    rows, (c_fold, mu_fold) = read(TABLE), folds()
    shown = {  # label, how to colour
        "speed": ("speed [m/s]", Normalize(0.0, 3.0)),
        "dls_fraction": ("DLS fraction", Normalize(0.0, 0.9)),
        "slip": ("slip per step [m]", LogNorm(0.01, 1.0)),
    }
    figure, axes = plt.subplots(2, 3, figsize=(plots.PAGE, 4.8), sharex=True, sharey=True)
    corners = [edges(np.array(values)) for values in (DAMPING, FRICTION)]
    for column, (name, (label, norm)) in enumerate(shown.items()):
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


def edges(values: np.ndarray) -> np.ndarray:
    """Of cells around them."""
    middle = 0.5 * (values[1:] + values[:-1])
    return np.concatenate([[2.0 * values[0] - middle[0]], middle, [2.0 * values[-1] - middle[-1]]])


def main() -> None:
    parser = command(__doc__)
    parser.add_argument("--redraw", action="store_true", help="compute nothing")
    if not started(parser).redraw:
        compute()
    with plots.figure_style():
        draw()


if __name__ == "__main__":
    main()
