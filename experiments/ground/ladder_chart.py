"""Draw which model is accurate over friction and damping, and which margin rules out the simpler
one.

    python -m experiments.ground.ladder_chart [--redraw]

The choice follows from the margins of the gaits of the paper's wheel, as in a scan with
`model="auto"`. `model_table` measures the costs of a step.
"""

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import ListedColormap

import vrw_jax as vrw
from experiments.shared.command import make_parser, parse_and_start_jax
from experiments.shared.tables import FIGURES, read_table, write_table
from vrw_jax import plot as plots
from vrw_jax.models import MARGIN_MEASURES, SELECTION_MARGIN_NAMES
from vrw_jax.studies import find_selection_reasons, plan_scan

DAMPING = np.linspace(20.0, 400.0, 77)
FRICTION = (0.7, 1.0, 2.0, 5.0, 10.0, 15.0, 20.0, 50.0, np.inf)
MEASURES = ("dls_fraction", "period", "speed", "slip")
TOLERANCE = 1e-8
REASON_TABLE, COST_TABLE = FIGURES / "ladder_map.csv", FIGURES / "rung_costs.csv"


def compute() -> None:
    """Write the reason of the choice for each wheel and friction."""
    options = vrw.StepOptions(rtol=TOLERANCE, atol=TOLERANCE)
    paper = vrw.scan(vrw.grid(damping=DAMPING), MEASURES[:3], options=options)
    engine = plan_scan(vrw.grid(damping=DAMPING), MEASURES[:3], options=options).build_scan_engine()
    paper_gaits = engine({"damping": DAMPING})
    reasons = [
        find_selection_reasons(vrw.LadderWheel(), paper_gaits, np.full(len(DAMPING), mu))
        for mu in FRICTION
    ]
    rows = [
        [f"{c:g}", mu, int(reason), f"{float(paper.dls_fraction[i]):.6g}"]
        for mu, reasons_of_friction in zip(FRICTION, reasons, strict=True)
        for i, (c, reason) in enumerate(zip(DAMPING, reasons_of_friction, strict=True))
    ]
    write_table(REASON_TABLE, ("damping", "friction", "reason", "paper_dls_fraction"), rows)


def draw() -> None:
    """Draw the first negative margin, the share of each model and the cost of a step."""
    reason = np.array([int(r["reason"]) for r in read_table(REASON_TABLE)]).reshape(
        len(FRICTION), len(DAMPING)
    )
    kinds = np.where(reason < 0, 1 + len(SELECTION_MARGIN_NAMES), reason)
    margin_labels = [MARGIN_MEASURES[name].violation_text for name in SELECTION_MARGIN_NAMES]
    labels = ["none: the paper's wheel is accurate", *margin_labels, "no gait of the paper's wheel"]
    shown_kinds = sorted({int(k) for k in kinds.ravel()})
    kind_index = np.vectorize({k: i for i, k in enumerate(shown_kinds)}.get)(kinds)
    figure, axes = plt.subplots(
        1, 3, figsize=(plots.PAGE_FIGURE_WIDTH_INCHES, 3.1), width_ratios=(1.7, 1.0, 1.0)
    )
    colors = ListedColormap(["#0072B2", "#E69F00", "#009E73", "#D55E00", "#BBBBBB"])
    assert len(shown_kinds) <= colors.N
    positions = np.arange(len(FRICTION))
    ticks = [f"{m:g}" if np.isfinite(m) else "∞" for m in FRICTION]
    axes[0].imshow(
        colors(kind_index.T), origin="lower", aspect="auto",
        extent=(-0.5, len(FRICTION) - 0.5, DAMPING[0], DAMPING[-1]),
    )  # fmt: skip
    for i, kind in enumerate(shown_kinds):
        axes[0].plot([], [], "s", color=colors(i), label=labels[kind])
    axes[0].set(ylabel="damping $c$ [N·s/m]", title="first negative margin")
    share = np.mean(reason == 0, axis=1)
    ground = {
        "label": "unilateral contact",
        "color": plots.LIGHT_GRAY_COLOR,
        "edgecolor": plots.DARK_GRAY_COLOR,
        "lw": 0.4,
    }
    axes[1].bar(positions, 100.0 * share, color=colors(0), label="the paper's wheel")
    axes[1].bar(positions, 100.0 * (1.0 - share), bottom=100.0 * share, **ground)
    axes[1].set(ylabel="share of gaits [%]", title="chosen model")
    cost = {r["model"]: float(r["us_in_a_batch"]) for r in read_table(COST_TABLE)}
    paper = np.full(len(FRICTION), cost["paper"])  # Every gait is computed with this model first.
    axes[2].bar(positions, paper, color=colors(0))
    axes[2].bar(positions, (1.0 - share) * cost["ground"], bottom=paper, **ground)
    axes[2].axhline(cost["ground"], color="k", ls="--", lw=0.8, label="unilateral contact for all")
    axes[2].set(ylabel="time per step, mean over gaits [µs]", title="cost")
    for axis in axes:
        axis.set_xticks(positions, ticks, rotation=90)
        axis.set_xlabel("friction coefficient $\\mu$")
    handles = [axis.get_legend_handles_labels() for axis in (axes[0], axes[1], axes[2])]
    handle_by_label = dict(pair for h, names in handles for pair in zip(names, h, strict=True))
    figure.legend(
        handle_by_label.values(), handle_by_label.keys(), loc="outside lower center", ncols=3
    )
    plots.save(figure, FIGURES, "ladder_chart")


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument(
        "--redraw", action="store_true", help="draw the stored table without computing"
    )
    if not parse_and_start_jax(parser).redraw:
        compute()
    with plots.figure_style():
        draw()


if __name__ == "__main__":
    main()
