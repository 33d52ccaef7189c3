"""Which rung serves over friction and damping, and which premise fails the lower one.

    python -m experiments.ground.ladder_chart [--redraw]

It follows from the margins of the paper's gaits, as in a scan of the ladder; costs of a step are
those that `model_table` measures.
"""

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import ListedColormap

import vrw_jax as vrw
from experiments.shared.command import make_parser, parse_and_start_jax
from experiments.shared.tables import FIGURES, read_table, write_table
from vrw_jax import figures as plots
from vrw_jax.scans import plan_scan
from vrw_jax.selection import SELECTION_MARGINS

DAMPING = np.linspace(20.0, 400.0, 77)
FRICTION = (0.7, 1.0, 2.0, 5.0, 10.0, 15.0, 20.0, 50.0, np.inf)
MEASURES = ("dls_fraction", "period", "speed", "slip")
TOLERANCE = 1e-8
MAP, COSTS = FIGURES / "ladder_map.csv", FIGURES / "rung_costs.csv"


def compute() -> None:
    """The map, by the paper's rung."""
    options = vrw.StepOptions(rtol=TOLERANCE, atol=TOLERANCE)
    paper = vrw.scan(vrw.grid(damping=DAMPING), MEASURES[:3], options=options)
    engine = plan_scan(vrw.grid(damping=DAMPING), MEASURES[:3], options=options).build_engine()
    lower = engine({"damping": DAMPING})
    ladder = plan_scan(
        vrw.grid(damping=DAMPING), MEASURES, model="auto", options=options
    ).build_engine()
    reasons = [ladder.find_reasons(lower, np.full(len(DAMPING), mu)) for mu in FRICTION]
    rows = [
        [f"{c:g}", mu, int(reason), f"{float(paper.dls_fraction[i]):.6g}"]
        for mu, of_friction in zip(FRICTION, reasons, strict=True)
        for i, (c, reason) in enumerate(zip(DAMPING, of_friction, strict=True))
    ]
    write_table(MAP, ("damping", "friction", "reason", "paper_dls_fraction"), rows)


def draw() -> None:
    """Which premise breaks first, and the share of each rung."""
    reason = np.array([int(r["reason"]) for r in read_table(MAP)]).reshape(
        len(FRICTION), len(DAMPING)
    )
    kinds = np.where(reason < 0, 1 + len(SELECTION_MARGINS), reason)
    broken = SELECTION_MARGINS.values()
    labels = ["none: the paper's wheel serves", *broken, "no gait of the paper's wheel"]
    sorted_items = sorted({int(k) for k in kinds.ravel()})
    place = np.vectorize({k: i for i, k in enumerate(sorted_items)}.get)(kinds)
    figure, axes = plt.subplots(
        1, 3, figsize=(plots.PAGE_WIDTH_INCHES, 3.1), width_ratios=(1.7, 1.0, 1.0)
    )
    colours = ListedColormap(["#0072B2", "#E69F00", "#009E73", "#D55E00", "#BBBBBB"])
    assert len(sorted_items) <= colours.N
    value_at = np.arange(len(FRICTION))
    ticks = [f"{m:g}" if np.isfinite(m) else "∞" for m in FRICTION]
    axes[0].imshow(
        colours(place.T), origin="lower", aspect="auto",
        extent=(-0.5, len(FRICTION) - 0.5, DAMPING[0], DAMPING[-1]),
    )  # fmt: skip
    for i, kind in enumerate(sorted_items):
        axes[0].plot([], [], "s", color=colours(i), label=labels[kind])
    axes[0].set(ylabel="damping $c$ [N·s/m]", title="the first premise that breaks")
    share = np.mean(reason == 0, axis=1)
    ground = {
        "label": "real ground",
        "color": plots.LIGHT_GRAY,
        "edgecolor": plots.DARK_GRAY,
        "lw": 0.4,
    }
    axes[1].bar(value_at, 100.0 * share, color=colours(0), label="the paper's wheel")
    axes[1].bar(value_at, 100.0 * (1.0 - share), bottom=100.0 * share, **ground)
    axes[1].set(ylabel="share of gaits [%]", title="the wheel that serves")
    cost = {r["rung"]: float(r["us_in_a_batch"]) for r in read_table(COSTS)}
    paper = np.full(len(FRICTION), cost["paper"])  # every gait is tried there
    axes[2].bar(value_at, paper, color=colours(0))
    axes[2].bar(value_at, (1.0 - share) * cost["ground"], bottom=paper, **ground)
    axes[2].axhline(cost["ground"], color="k", ls="--", lw=0.8, label="all on real ground")
    axes[2].set(ylabel="time per step, mean over gaits [µs]", title="what it costs")
    for axis in axes:
        axis.set_xticks(value_at, ticks, rotation=90)
        axis.set_xlabel("friction coefficient $\\mu$")
    handles = [axis.get_legend_handles_labels() for axis in (axes[0], axes[1], axes[2])]
    result = dict(pair for h, names in handles for pair in zip(names, h, strict=True))
    figure.legend(result.values(), result.keys(), loc="outside lower center", ncols=3)
    plots.save(figure, FIGURES, "ladder_chart")


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--redraw", action="store_true", help="compute nothing")
    if not parse_and_start_jax(parser).redraw:
        compute()
    with plots.figure_style():
        draw()


if __name__ == "__main__":
    main()
