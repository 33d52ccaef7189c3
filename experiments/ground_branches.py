"""Slow and fast gaits on real ground are branches with folds, in damping and in friction.

    python experiments/ground_branches.py [damping] [friction] [--redraw]

Beside them: a walk just beyond the fold in friction lingers where the slow gait has been.
"""

import csv
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import vrw_jax as vrw

FRICTION, DAMPING = 0.7, 200.0  # held while the other one moves
STARTS = {  # of the branches: section state, damping and friction from where they are followed
    "slow": ((0.1, 1.6, -0.1), 300.0, 1.3),
    "fast": ((0.12, 2.4, -0.2), 300.0, 1.3),
}
ALONG = {"damping": (20.0, 400.0), "friction": (0.45, 2.0)}
N_TOWARDS = 300  # steps towards a branch's first gait
BELOW_FOLD = 0.01  # friction less than the fold's by this much leaves a ghost of the slow gait
N_GHOST = 300
STEP = vrw.Options(rtol=1e-9, atol=1e-9)
ARC = vrw.ArclengthOptions(first_step=0.01, largest_step=0.04, max_points=100)
SHOWN = {"dls_fraction": "DLS fraction", "period": "period / s", "slip": "slip per step / m"}
TARGET = Path(__file__).parents[1] / "docs" / "figures"
GHOST = TARGET / "ground_ghost.csv"


def first_gait(start: tuple, damping: float, friction: float) -> vrw.WalkedCycle:
    """The gait where a walk ends, solved for."""
    params, wheel = vrw.WheelParams(damping=damping), vrw.UnilateralWheel(friction=friction)
    walked = vrw.walk(params, start, N_TOWARDS, model=wheel, options=STEP)
    end = walked.steps.section_state[-1]
    return vrw.limit_cycle(params, guess=end, model=wheel, options=STEP)


def branches(name: str) -> dict[str, vrw.Branch]:
    """Slow and fast branch along one parameter, followed side by side."""
    starts = {
        "damping": lambda c, mu: (c, FRICTION),
        "friction": lambda c, mu: (DAMPING, mu),
    }
    at = [(start, *starts[name](c, mu)) for start, c, mu in STARTS.values()]
    cycles = [first_gait(*one) for one in at]
    for label, cycle in zip(STARTS, cycles, strict=True):
        print(name, label, vrw.Outcome(int(cycle.outcome)).name, float(cycle.period), flush=True)
    model = vrw.UnilateralWheel(friction=at[0][2])
    found = vrw.continue_branches(
        vrw.WheelParams(damping=jnp.asarray([c for _, c, _ in at])),
        name,
        ALONG[name],
        cycle=jax.tree.map(lambda *leaves: jnp.stack(leaves), *cycles),
        model=model,
        options=ARC,
        step_options=STEP,
    )
    return dict(zip(STARTS, found, strict=True))


def table(name: str) -> Path:
    return TARGET / f"ground_branches_{name}.csv"


def borders(name: str) -> Path:
    return TARGET / f"ground_branches_{name}_borders.csv"


def compute(name: str) -> None:
    """Follow the branches along one parameter; past a fold in friction, walk too."""
    rows, found, fold = [], [], None
    for label, branch in branches(name).items():
        print(name, label, branch, flush=True)
        for i, value in enumerate(branch.values):
            told = [float(branch.dataset[key][i]) for key in SHOWN]
            rows.append([label, value, *told, float(branch.dataset.spectral_radius[i])])
        for border in branch.borders:
            found.append([label, border.kind, border.value, border.point.spectral_radius])
            if (label, border.kind) == ("slow", "fold"):
                fold = border.value
    for path, header, lines in (
        (table(name), ["branch", "value", *SHOWN, "spectral_radius"], rows),
        (borders(name), ["branch", "kind", "value", "spectral_radius"], found),
    ):
        with path.open("w", newline="") as file:
            csv.writer(file).writerows([header, *lines])
    if name != "friction" or fold is None:
        return
    params, wheel = vrw.WheelParams(damping=DAMPING), vrw.UnilateralWheel(fold - BELOW_FOLD)
    walked = vrw.walk(params, STARTS["slow"][0], N_GHOST, model=wheel, options=STEP)
    periods = np.asarray(jnp.sum(walked.steps.durations, -1))[: int(walked.n_stepped)]
    with GHOST.open("w", newline="") as file:
        csv.writer(file).writerows([["step", "period"], *enumerate(periods)])


def read(path: Path) -> list[dict[str, str]]:
    with path.open() as file:
        return list(csv.DictReader(file))


def draw() -> None:
    """Measures over damping and friction, stable gaits solid; the walk past the fold."""
    names = [name for name in ALONG if table(name).exists()]
    figure, axes = plt.subplots(
        len(names), len(SHOWN), figsize=(12, 0.4 + 3.0 * len(names)), sharex="row",
        layout="constrained", squeeze=False,
    )  # fmt: skip
    held = {"damping": f"μ = {FRICTION}", "friction": f"c = {DAMPING:g} N s/m"}
    for name, line in zip(names, axes, strict=True):
        rows, folds = read(table(name)), read(borders(name))
        for axis, (key, text) in zip(line, SHOWN.items(), strict=True):
            for label, color in zip(STARTS, ("C0", "C1"), strict=True):
                own = [r for r in rows if r["branch"] == label]
                x, y, radius = (
                    np.array([float(r[k]) for r in own]) for k in ("value", key, "spectral_radius")
                )
                stable = radius < 1.0
                axis.plot(x, np.where(stable, y, np.nan), color, label=f"{label}, stable")
                axis.plot(x, np.where(stable, np.nan, y), color + ":", label=f"{label}, unstable")
                for fold in folds:
                    if (fold["branch"], fold["kind"]) == (label, "fold"):
                        place = int(np.argmin(np.abs(x - float(fold["value"]))))
                        axis.plot(x[place], y[place], "k.", ms=8)
            axis.set(ylabel=text, title=held[name])
            axis.set_xlabel("damping / N s/m" if name == "damping" else "friction coefficient")
    axes[0, 0].legend(fontsize=7)
    if GHOST.exists():
        ghost = read(GHOST)
        inset = axes[-1, 1].inset_axes((0.5, 0.12, 0.47, 0.4))
        inset.plot([int(r["step"]) for r in ghost], [float(r["period"]) for r in ghost], "0.3")
        inset.set_title(f"a walk {BELOW_FOLD:g} below the fold", fontsize=7)
        inset.set_xlabel("step", fontsize=7)
        inset.tick_params(labelsize=6)
    for ending in ("png", "svg"):
        figure.savefig(TARGET / f"ground_branches.{ending}", dpi=110)


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    if "--redraw" not in sys.argv:
        for name in [name for name in ALONG if name in sys.argv] or ALONG:
            compute(name)
    draw()


if __name__ == "__main__":
    main()
