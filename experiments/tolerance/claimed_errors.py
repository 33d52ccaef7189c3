"""Compare claimed and true errors of `vrw.measure_to_tolerance`, its cost, and the models it uses.

    python -m experiments.tolerance.claimed_errors [--parts 25] [--folder FOLDER] [--redraw]

A part is 400 wheels of a wide box and 100 hostile ones. The hostile ones are those of eight times
as many whose gaits of the paper's model are nearest to a fold, nearest to the zero of an indicator,
or without double support. Friction is 0.5 to 100. Each wheel is measured once, to its own tolerance
between 1e-2 and 1e-8. The reference is Newton's method on steps with their own derivatives at
1e-12, or at up to 1e-9 if feet dip so often that it does not converge. It shares only the step with
the measured values. Parts that are in the folder are not computed again.
"""

from collections import Counter
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import ListedColormap
from matplotlib.patches import Patch

import vrw_jax as vrw
from experiments.shared.command import make_parser, parse_and_start_jax
from experiments.shared.tables import (
    FIGURES,
    format_markdown,
    read_column,
    read_table,
    write_table,
)
from experiments.shared.wheels import WIDE_BOX
from vrw_jax import plot as plots
from vrw_jax.gaits import make_finder
from vrw_jax.wheel import PARAMETER_NAMES

N_BOX_WHEELS, N_HOSTILE_WHEELS, N_PARTS = 400, 100, 8
SAME_GAIT_DISTANCE = 0.1
"""How near to an answer's section state its gait must be, rad, rad/s, m, m/s."""
WALKS = (40, 200)
"""Steps of a walk to it, where Newton's method from there leads elsewhere."""
RESULT_FIELDS = (
    "values",
    "errors",
    "model_errors",
    "models",
    "statuses",
    "n_steps",
    "states",
    "outcomes",
)
REFERENCE_TOLERANCES = (1e-12, 1e-11, 1e-10, 1e-9)
TOLERANCES = 10.0 ** -np.arange(2, 9)
MAP_TOLERANCES = (1e-2, 1e-4, 1e-6)
MEASURES = ("speed", "dls_fraction", "period")
DAMPING, FRICTION = np.linspace(100.0, 210.0, 12), np.geomspace(1.0, 100.0, 11)
CLOUD, MAP = FIGURES / "answers_cloud.npz", FIGURES / "answers_map.csv"
COUNT = FIGURES / "answers_count.csv"
MIN_MODEL_ERROR = 1e-9
"""True model error from which on its estimate counts."""
KINDS = ("lower stands", "continued", "walked to", "from a start")
COLOURS = ("#0072B2", "#56B4E9", "#E69F00", "#CC79A7", "#DDDDDD")
"""Of these kinds, and where no gait is found."""
Columns = dict[str, np.ndarray]


def wheels(part: int) -> tuple[Columns, np.ndarray, np.ndarray]:
    """Return the wheels of a part, those of the box first; friction and tolerance of each."""
    random = np.random.default_rng(part)
    draw = lambda n: {name: random.uniform(*ends, n) for name, ends in WIDE_BOX.items()}
    box, many = draw(N_BOX_WHEELS), draw(N_PARTS * N_HOSTILE_WHEELS)
    cycles = vrw.limit_cycles(vrw.WheelParams(**many))
    forces = cycles.indicators
    fold = np.abs(np.linalg.det(np.eye(2) - np.asarray(cycles.monodromy_value)))
    near = np.minimum.reduce([
        fold, np.abs(forces.lambda_4) / 20.0, np.abs(forces.lambda_I4) / 5.0,
        np.asarray(cycles.dls_fraction),
    ])  # fmt: skip
    hostile = np.argsort(np.where(np.asarray(cycles.found), near, np.inf))[:N_HOSTILE_WHEELS]
    columns = {name: np.concatenate([box[name], many[name][hostile]]) for name in box}
    n = N_BOX_WHEELS + N_HOSTILE_WHEELS
    friction = np.exp(random.uniform(np.log(0.5), np.log(100.0), n))
    return columns, friction, random.choice(TOLERANCES, n)


def compute_part(part: int) -> Columns:
    """Return claimed and reference results of the wheels of a part; NaN if a wheel has no gait."""
    columns, friction, tols = wheels(part)
    result: Columns = {}
    for tol in TOLERANCES:
        selection = np.flatnonzero(tols == tol)
        answered = vrw.measure_to_tolerance(
            MEASURES, select_wheels(columns, selection), tol, friction=friction[selection]
        )
        for name in RESULT_FIELDS:
            measured_values = getattr(answered, name)
            result.setdefault(name, np.zeros((len(tols), *measured_values.shape[1:])))[
                selection
            ] = measured_values
    exact = compute_reference(
        columns, friction, result.pop("states"), result["outcomes"] == vrw.Outcome.STEPPED
    )
    hostile = np.arange(len(tols)) >= N_BOX_WHEELS
    return (
        columns | result | {"exact": exact, "hostile": hostile, "friction": friction, "tol": tols}
    )


def select_wheels(columns: Columns, selection: np.ndarray) -> vrw.WheelParams:
    return vrw.WheelParams(**{name: x[selection] for name, x in columns.items()})


def compute_reference(
    columns: Columns, friction: np.ndarray, near: np.ndarray, solution: np.ndarray
) -> np.ndarray:
    """Return measures of the gaits next to the section states of the results.

    Newton's method uses derivatives of steps at 1e-12. If its gait is farther than
    `SAME_GAIT_DISTANCE` from the end of a walk of `WALKS` steps, looser tolerances follow. Only the
    step is shared with `vrw.measure_to_tolerance`. NaN means that there is no gait, and then the
    result is wrong.
    """
    exact, open_ = np.full((len(friction), len(MEASURES)), np.nan), np.flatnonzero(solution)
    legs = vrw.WheelParams().n_legs
    for n_steps, tol in [(n, REFERENCE_TOLERANCES[0]) for n in (0, *WALKS)] + [
        (0, tol) for tol in REFERENCE_TOLERANCES[1:]
    ]:
        options = vrw.StepOptions(rtol=tol, atol=tol)
        if not len(open_):
            break
        finder = make_finder(vrw.UnilateralWheel(), legs, step_options=options)
        params, x = select_wheels(columns, open_), near[open_]
        parameter_columns = [
            np.broadcast_to(getattr(params, n), len(open_)) for n in PARAMETER_NAMES
        ]
        if n_steps:
            ground = vrw.UnilateralWheel(friction[open_])
            x = np.asarray(vrw.step_batch(params, x, n_steps, model=ground).section_state)
        gait = finder.find_cycles_near(np.column_stack([*parameter_columns, friction[open_]]), x)
        missed = np.abs(np.asarray(gait.section_state) - near[open_]).max(1)
        hit = np.asarray(gait.found) & (missed < SAME_GAIT_DISTANCE)
        exact[open_[hit]] = np.stack([np.asarray(getattr(gait, m)) for m in MEASURES], 1)[hit]
        open_ = open_[~hit]
    return exact


def compute(parts: int, folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for part in range(parts):
        path = folder / f"part_{part:03}.npz"
        if not path.exists():
            result = compute_part(part)
            np.savez_compressed(path.with_suffix(".tmp.npz"), **result)
            path.with_suffix(".tmp.npz").rename(path)
            print(path, flush=True)


def gather_parts(folder: Path) -> None:
    """Write all parts into one small file."""
    parts = [dict(np.load(path)) for path in sorted(folder.glob("part_???.npz"))]
    result_by_name = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    lower = (
        result_by_name["values"]
        + np.where(result_by_name["statuses"] == 0, 0.0, result_by_name["model_errors"].T).T
    )
    small = {
        "answered": np.isfinite(result_by_name["values"]).all(1),
        "wrong": result_by_name["values"] - result_by_name["exact"],
        "effectivity": _divide(result_by_name["model_errors"], lower - result_by_name["exact"]),
        "model_error": lower - result_by_name["exact"],
        **{name: result_by_name[name] for name in (
            "errors", "statuses", "n_steps", "outcomes", "hostile", "friction", "tol", "damping",
        )},
    }  # fmt: skip
    np.savez_compressed(CLOUD, **{name: x.astype(np.float32) for name, x in small.items()})


def _divide(above: np.ndarray, below: np.ndarray) -> np.ndarray:
    return np.divide(above, below, out=np.full_like(above, np.nan), where=below != 0.0)


def compute_map() -> None:
    c, mu = (x.ravel() for x in np.meshgrid(DAMPING, FRICTION))
    rows = []
    for tol in MAP_TOLERANCES:
        measured = vrw.measure_to_tolerance("speed", vrw.WheelParams(damping=c), tol, friction=mu)
        columns = c, mu, measured.models, measured.statuses, measured.n_steps
        rows += [(tol, *row) for row in zip(*columns, strict=True)]
    write_table(MAP, ("tol", "damping", "friction", "rung", "how", "n_steps"), rows)


def find_best_model(cloud: Columns) -> np.ndarray:
    """Return the cost, in steps, of the cheapest accurate model.

    The cost is one step if the gait of the paper's model is accurate to the tolerance. Otherwise it
    is the cost of the refinement with unilateral contact.
    """
    lower = np.all(np.abs(cloud["model_error"]) <= cloud["tol"][:, None], axis=1)
    return np.where(lower & (cloud["statuses"] <= 1), 1.0, cloud["n_steps"])


def count_results() -> None:
    """Return the numbers of the page."""
    cloud, table = dict(np.load(CLOUD)), []
    hostile = cloud["hostile"] > 0
    for name, selection in (("box", ~hostile), ("hostile", hostile)):
        cloud_at_setting = {key: x[selection] for key, x in cloud.items()}
        answered = cloud_at_setting["answered"] > 0
        # The error is infinite if there is no gait.
        ratio = np.nan_to_num(
            np.abs(cloud_at_setting["wrong"]) / cloud_at_setting["errors"], nan=np.inf
        ).max(1)
        lower = answered & (cloud_at_setting["statuses"] <= 1) & np.isfinite(ratio)
        for which, rows in (
            ("all", lower),
            ("of one step", lower & (cloud_at_setting["statuses"] == 0)),
        ):
            effect = cloud_at_setting["effectivity"][rows][
                np.abs(cloud_at_setting["model_error"][rows]) > MIN_MODEL_ERROR
            ]
            within = np.sum((effect > 0.5) & (effect < 2.0))
            print(f"{name}: effectivity in 0.5 ... 2, {which}: {within} of {len(effect)}")
        cost = np.sum((1.0 + cloud_at_setting["n_steps"])[answered]) / np.sum(
            find_best_model(cloud_at_setting)[answered]
        )
        print(f"{name}: cost over that of the best rung {cost:.3f}")
        outcome_counts = Counter(
            vrw.Outcome(int(code)).name for code in cloud_at_setting["outcomes"][~answered]
        )
        print(
            f"{name}: {len(answered)} wheels, {answered.sum()} answered; no answer: "
            f"{dict(outcome_counts)}"
        )
        for tol in TOLERANCES:
            has_tolerance = answered & (np.abs(cloud_at_setting["tol"] / tol - 1.0) < 1e-3)
            hows = [
                np.sum(has_tolerance & (cloud_at_setting["statuses"] == status))
                for status in range(len(KINDS))
            ]
            outside = ratio[has_tolerance & (ratio > 1.0)]
            finite = outside[np.isfinite(outside)]
            worst = f"{finite.max():.3g}" if len(finite) else ""
            steps, without = (
                f"{np.mean(cloud_at_setting['n_steps'][has_tolerance]):.1f}",
                len(outside) - len(finite),
            )
            table.append(
                [
                    name,
                    f"{tol:.0e}",
                    np.sum(has_tolerance),
                    *hows,
                    steps,
                    len(finite),
                    worst,
                    without,
                ]
            )
    header = "set", "tolerance", "answers", *KINDS, "steps", "outside", "worst", "gait unconfirmed"
    write_table(COUNT, header, table)
    print(format_markdown(header, table))


def draw() -> None:
    cloud = dict(np.load(CLOUD))
    with plots.figure_style():
        page = plt.figure(figsize=(plots.PAGE_FIGURE_WIDTH_INCHES, 5.6))
        top, below = page.subfigures(2, 1)
        axis, cost = top.subplots(1, 2)
        ends = np.array([1e-13, 1e0])
        wrong = np.maximum(np.abs(cloud["wrong"]), ends[0])
        outside = np.abs(cloud["wrong"]) > cloud["errors"]
        for status, kind in enumerate(KINDS):
            selection = (cloud["statuses"] == status)[:, None] & ~outside
            axis.plot(cloud["errors"][selection], wrong[selection], ".", ms=1.5,
            color=COLOURS[status],
                      rasterized=True)  # fmt: skip
            axis.plot([], [], "o", ms=3, color=COLOURS[status], label=kind)
        axis.plot(cloud["errors"][outside], wrong[outside], "kx", ms=4, label="outside")
        axis.plot(ends, ends, "k", lw=0.6)
        axis.set(xscale="log", yscale="log", xlabel="claimed error", ylabel="true error",
                 xlim=ends, ylim=ends)  # fmt: skip
        axis.legend(fontsize=6)
        groups = (
            ("all", (0, 1, 2, 3), "black"),
            ("continue the paper's", (0, 1), COLOURS[1]),
            ("walked to", (2, 3), COLOURS[2]),
        )
        for name, hows, colour in groups:
            has_status = np.isin(cloud["statuses"], hows)
            masks_by_tolerance = [
                has_status & (np.abs(cloud["tol"] / tol - 1.0) < 1e-3) for tol in TOLERANCES
            ]
            mean_n_steps = [np.nanmean(cloud["n_steps"][i]) for i in masks_by_tolerance]
            cost.plot(TOLERANCES, mean_n_steps, "o-", ms=3, color=colour, label=name)
        cost.axhline(1.0, color=plots.DARK_GRAY_COLOR, lw=0.6)
        cost.set(
            xscale="log", yscale="log", xlabel="tolerance", ylabel="steps with unilateral contact"
        )
        cost.invert_xaxis()
        cost.legend(fontsize=6, loc="lower right", bbox_to_anchor=(1.0, 0.06))
        points = read_table(MAP)
        names = (*KINDS, "no gait found")
        colours = ListedColormap(COLOURS)
        for axis, tol in zip(below.subplots(1, 3, sharey=True), MAP_TOLERANCES, strict=True):
            selection = [r for r in points if float(r["tol"]) == tol]
            status = read_column(selection, "how").reshape(len(FRICTION), len(DAMPING))
            axis.pcolormesh(DAMPING, FRICTION, status, vmin=-0.5, vmax=4.5, cmap=colours)
            axis.set(yscale="log", xlabel="damping $c$ [N·s/m]", title=f"tolerance {tol:g}")
            if tol == MAP_TOLERANCES[0]:
                axis.set_ylabel("friction coefficient $\\mu$")
        patches = [Patch(color=colours(i), label=name) for i, name in enumerate(names)]
        below.legend(handles=patches, loc="outside lower center", ncols=len(names), fontsize=6)
    plots.save(page, FIGURES, "answers")


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--parts", type=int, default=25)
    parser.add_argument("--folder", type=Path, default=Path("results/answers"))
    parser.add_argument("--redraw", action="store_true", help="compute nothing")
    arguments = parse_and_start_jax(parser)
    if not arguments.redraw:
        compute(arguments.parts, arguments.folder)
        gather_parts(arguments.folder)
        compute_map()
    count_results()
    draw()


if __name__ == "__main__":
    main()
