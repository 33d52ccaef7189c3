"""What the lowest sufficient rung saves: share of gaits per rung, and its cost, over μ and c.

    python experiments/ladder_chart.py [--redraw]

Gaits over damping and friction by `vrw.scan(model="auto")`; times are CPU seconds of one core for
the same samples, compiled before: by the paper's rung alone, real ground alone, and the ladder.
"""

import csv
import os
import sys
import time
from pathlib import Path

os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false")
os.environ.setdefault("JAX_PLATFORMS", "cpu")
if hasattr(os, "sched_setaffinity"):
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})

import jax
import matplotlib.pyplot as plt
import numpy as np

jax.config.update("jax_enable_x64", True)

import vrw_jax as vrw  # noqa: E402  the number format is chosen first
from vrw_jax.models.ladder import PREMISES, UNILATERAL, VISCOELASTIC  # noqa: E402
from vrw_jax.scan import plan  # noqa: E402

DAMPING = np.linspace(20.0, 400.0, 20)
FRICTION = (0.7, 2.0, 10.0, 15.0, 20.0, 50.0, np.inf)
MEASURES = ("dls_fraction", "period", "speed", "slip")
OPTIONS = vrw.Options(rtol=1e-8, atol=1e-8)
TARGET = Path(__file__).parents[1] / "docs" / "figures"
MAP, COST = TARGET / "ladder_map.csv", TARGET / "ladder_cost.csv"
NAMES = ("served", *PREMISES)


def timed(design: object, model: object) -> tuple[dict, float]:
    """Results, and CPU seconds of a second run."""
    planned = plan(design, MEASURES, model=model, options=OPTIONS)
    engine = planned.engine()
    columns = design.block(tuple(slice(0, n) for n in design.shape))
    engine(columns)
    began = time.process_time()
    told = engine(columns)
    return told, time.process_time() - began


def compute() -> None:
    design = vrw.grid(damping=DAMPING, friction=FRICTION)
    told, ladder = timed(design, "auto")
    _, ground = timed(design, vrw.UnilateralWheel())
    _, paper = timed(vrw.grid(damping=np.repeat(DAMPING, len(FRICTION))), None)
    columns = design.block(tuple(slice(0, n) for n in design.shape))
    rows = zip(
        columns["damping"], columns["friction"], told["rung"], told["reason"], told["outcome"],
        told["dls_fraction"], strict=True,
    )  # fmt: skip
    with MAP.open("w", newline="") as file:
        csv.writer(file).writerows(
            [["damping", "friction", "rung", "reason", "outcome", "dls_fraction"], *rows]
        )
    served = int(np.sum(told["rung"] == VISCOELASTIC))
    with COST.open("w", newline="") as file:
        csv.writer(file).writerows(
            [
                ["engine", "gaits", "of them by the paper's rung", "cpu_s"],
                ["paper's rung alone", design.size, design.size, f"{paper:.3f}"],
                ["real ground alone", design.size, 0, f"{ground:.3f}"],
                ["lowest sufficient rung", design.size, served, f"{ladder:.3f}"],
            ]
        )


def draw() -> None:
    """Which rung serves and why, its share by friction, and the times."""
    with MAP.open() as file:
        rows = list(csv.DictReader(file))
    with COST.open() as file:
        costs = list(csv.DictReader(file))
    shape = (len(DAMPING), len(FRICTION))
    column = lambda name: np.array([float(r[name]) for r in rows]).reshape(shape)
    rung, reason, outcome = column("rung"), column("reason"), column("outcome")
    kinds = np.where(reason < 0, len(NAMES), reason)
    labels = [*(name.replace("_", " ") for name in NAMES), "no gait on the paper's rung"]
    seen = sorted({int(k) for k in kinds.ravel()})
    figure, axes = plt.subplots(
        1, 3, figsize=(13, 4.2), layout="constrained", width_ratios=(1.6, 1.0, 0.9)
    )
    colours = plt.get_cmap("tab10")
    place = np.vectorize({k: i for i, k in enumerate(seen)}.get)(kinds)
    ticks = [f"{m:g}" if np.isfinite(m) else "∞" for m in FRICTION]
    axes[0].imshow(
        colours(place), origin="lower", aspect="auto",
        extent=(-0.5, len(FRICTION) - 0.5, DAMPING[0], DAMPING[-1]),
    )  # fmt: skip
    failed = np.argwhere(outcome != 0)
    axes[0].plot(failed[:, 1], DAMPING[failed[:, 0]], "kx", ms=3)
    for i, kind in enumerate(seen):
        axes[0].plot([], [], "s", color=colours(i), label=labels[kind])
    axes[0].plot([], [], "kx", ms=4, label="no gait on real ground either")
    axes[0].set_xticks(range(len(FRICTION)), ticks)
    axes[0].set(xlabel="friction coefficient", ylabel="damping / N s/m", title="what breaks first")
    axes[0].legend(fontsize=7, loc="upper left", framealpha=0.9)
    share = np.mean(rung == VISCOELASTIC, axis=0)
    axes[1].bar(range(len(FRICTION)), 100.0 * share, color="C0", label="paper's rung")
    axes[1].bar(
        range(len(FRICTION)), 100.0 * np.mean(rung == UNILATERAL, axis=0), bottom=100.0 * share,
        color="0.75", label="real ground",
    )  # fmt: skip
    axes[1].set_xticks(range(len(FRICTION)), ticks)
    axes[1].set(
        xlabel="friction coefficient", ylabel="share of gaits / %", title="rung that served"
    )
    axes[1].legend(fontsize=7)
    axes[2].barh([c["engine"] for c in costs], [float(c["cpu_s"]) for c in costs], color="C0")
    axes[2].set(xlabel="CPU time of one core / s", title=f"{costs[0]['gaits']} gaits")
    for ending in ("png", "svg"):
        figure.savefig(TARGET / f"ladder_chart.{ending}", dpi=110)


def main() -> None:
    if "--redraw" not in sys.argv:
        compute()
    draw()


if __name__ == "__main__":
    main()
