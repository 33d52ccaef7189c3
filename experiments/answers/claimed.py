"""Claimed against true errors of `vrw.answer`, what it costs, and which rung answers where.

    python -m experiments.answers.claimed [--parts 25] [--folder results/answers] [--redraw]

A part is 400 wheels of a wide box and 100 hostile ones: of eight times as many the paper's gaits
that are nearest to a fold, to a border (an indicator at zero) or without double support. Friction
is 0.5 to 100. Each wheel is asked once, to a tolerance of its own between 1e-2 and 1e-8. Its truth
is Newton's method on steps with their own derivatives, at 1e-12, or where feet dip so often that it
does not converge at up to 1e-9, which shares nothing but the step with the answer. Parts that lie
in the folder are not computed again.
"""

from collections import Counter
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import ListedColormap
from matplotlib.patches import Patch

import vrw_jax as vrw
from experiments.shared.command import command, started
from experiments.shared.tables import FIGURES, markdown, numbers, read, write
from experiments.shared.wheels import WIDE_BOX
from vrw_jax import figures as plots
from vrw_jax.cycles import finder_of
from vrw_jax.wheel import PARAMETER_NAMES

BOX, HOSTILE, OF = 400, 100, 8
CLOSE = 0.1
"""How near to an answer's section state its gait must be, rad, rad/s, m, m/s."""
WALKS = (40, 200)
"""Steps of a walk to it, where Newton's method from there leads elsewhere."""
TOLD = ("values", "errors", "model_errors", "rungs", "hows", "n_steps", "states", "outcomes")
TRUE = (1e-12, 1e-11, 1e-10, 1e-9)
TOLERANCES = 10.0 ** -np.arange(2, 9)
MAPPED = (1e-2, 1e-4, 1e-6)
MEASURES = ("speed", "dls_fraction", "period")
DAMPING, FRICTION = np.linspace(100.0, 210.0, 12), np.geomspace(1.0, 100.0, 11)
CLOUD, MAP = FIGURES / "answers_cloud.npz", FIGURES / "answers_map.csv"
COUNT = FIGURES / "answers_count.csv"
SEEN = 1e-9
"""True model error from which on its estimate counts."""
KINDS = ("lower stands", "continued", "walked to", "from a start")
COLOURS = ("#0072B2", "#56B4E9", "#E69F00", "#CC79A7", "#DDDDDD")
"""Of these kinds, and where no gait is found."""
Columns = dict[str, np.ndarray]


def wheels(part: int) -> tuple[Columns, np.ndarray, np.ndarray]:
    """The box first, then the hostile ones; friction and tolerance of each."""
    random = np.random.default_rng(part)
    draw = lambda n: {name: random.uniform(*ends, n) for name, ends in WIDE_BOX.items()}
    box, many = draw(BOX), draw(OF * HOSTILE)
    cycles = vrw.limit_cycles(vrw.WheelParams(**many))
    forces = cycles.indicators
    fold = np.abs(np.linalg.det(np.eye(2) - np.asarray(cycles.matrix)))
    near = np.minimum.reduce([
        fold, np.abs(forces.lambda_4) / 20.0, np.abs(forces.lambda_I4) / 5.0,
        np.asarray(cycles.dls_fraction),
    ])  # fmt: skip
    hostile = np.argsort(np.where(np.asarray(cycles.found), near, np.inf))[:HOSTILE]
    columns = {name: np.concatenate([box[name], many[name][hostile]]) for name in box}
    n = BOX + HOSTILE
    friction = np.exp(random.uniform(np.log(0.5), np.log(100.0), n))
    return columns, friction, random.choice(TOLERANCES, n)


def computed(part: int) -> Columns:
    """What wheels of a part are told, and the truth; NaN where they have no gait."""
    columns, friction, tols = wheels(part)
    told: Columns = {}
    for tol in TOLERANCES:
        some = np.flatnonzero(tols == tol)
        answered = vrw.answer(MEASURES, of(columns, some), tol, friction=friction[some])
        for name in TOLD:
            own = getattr(answered, name)
            told.setdefault(name, np.zeros((len(tols), *own.shape[1:])))[some] = own
    exact = truth(columns, friction, told.pop("states"), told["outcomes"] == vrw.Outcome.STEPPED)
    hostile = np.arange(len(tols)) >= BOX
    return columns | told | {"exact": exact, "hostile": hostile, "friction": friction, "tol": tols}


def of(columns: Columns, some: np.ndarray) -> vrw.WheelParams:
    return vrw.WheelParams(**{name: x[some] for name, x in columns.items()})


def truth(
    columns: Columns, friction: np.ndarray, near: np.ndarray, found: np.ndarray
) -> np.ndarray:
    """Measures of the gaits next to the answers' section states.

    By Newton's method with the derivatives of steps at 1e-12 from there, where it leads farther
    than CLOSE from where walks of WALKS steps end, and at last at looser tolerances: nothing
    but the step is shared with what `vrw.answer` does. NaN where there is none: then the answer
    is wrong.
    """
    exact, open_ = np.full((len(friction), len(MEASURES)), np.nan), np.flatnonzero(found)
    legs = vrw.WheelParams().n_legs
    for n_steps, tol in [(n, TRUE[0]) for n in (0, *WALKS)] + [(0, tol) for tol in TRUE[1:]]:
        options = vrw.Options(rtol=tol, atol=tol)
        if not len(open_):
            break
        finder = finder_of(vrw.UnilateralWheel(), legs, step_options=options)
        params, x = of(columns, open_), near[open_]
        own = [np.broadcast_to(getattr(params, n), len(open_)) for n in PARAMETER_NAMES]
        if n_steps:
            ground = vrw.UnilateralWheel(friction[open_])
            x = np.asarray(vrw.steps(params, x, n_steps, model=ground).section_state)
        gait = finder.near(np.column_stack([*own, friction[open_]]), x)
        missed = np.abs(np.asarray(gait.section_state) - near[open_]).max(1)
        hit = np.asarray(gait.found) & (missed < CLOSE)
        exact[open_[hit]] = np.stack([np.asarray(getattr(gait, m)) for m in MEASURES], 1)[hit]
        open_ = open_[~hit]
    return exact


def compute(parts: int, folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for part in range(parts):
        path = folder / f"part_{part:03}.npz"
        if not path.exists():
            told = computed(part)
            np.savez_compressed(path.with_suffix(".tmp.npz"), **told)
            path.with_suffix(".tmp.npz").rename(path)
            print(path, flush=True)


def gathered(folder: Path) -> None:
    """All parts in one small file."""
    parts = [dict(np.load(path)) for path in sorted(folder.glob("part_???.npz"))]
    told = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    lower = told["values"] + np.where(told["hows"] == 0, 0.0, told["model_errors"].T).T
    small = {
        "answered": np.isfinite(told["values"]).all(1),
        "wrong": told["values"] - told["exact"],
        "effectivity": _over(told["model_errors"], lower - told["exact"]),
        "model_error": lower - told["exact"],
        **{name: told[name] for name in (
            "errors", "hows", "n_steps", "outcomes", "hostile", "friction", "tol", "damping",
        )},
    }  # fmt: skip
    np.savez_compressed(CLOUD, **{name: x.astype(np.float32) for name, x in small.items()})


def _over(above: np.ndarray, below: np.ndarray) -> np.ndarray:
    return np.divide(above, below, out=np.full_like(above, np.nan), where=below != 0.0)


def mapped() -> None:
    c, mu = (x.ravel() for x in np.meshgrid(DAMPING, FRICTION))
    rows = []
    for tol in MAPPED:
        told = vrw.answer("speed", vrw.WheelParams(damping=c), tol, friction=mu)
        columns = c, mu, told.rungs, told.hows, told.n_steps
        rows += [(tol, *row) for row in zip(*columns, strict=True)]
    write(MAP, ("tol", "damping", "friction", "rung", "how", "n_steps"), rows)


def best(cloud: Columns) -> np.ndarray:
    """Steps' worth of what would have sufficed: the paper's gait alone, which costs what one step
    does, where it is right to the tolerance; else real ground, as it was climbed to."""
    lower = np.all(np.abs(cloud["model_error"]) <= cloud["tol"][:, None], axis=1)
    return np.where(lower & (cloud["hows"] <= 1), 1.0, cloud["n_steps"])


def counted() -> None:
    """The page's numbers."""
    cloud, table = dict(np.load(CLOUD)), []
    hostile = cloud["hostile"] > 0
    for name, some in (("box", ~hostile), ("hostile", hostile)):
        own = {key: x[some] for key, x in cloud.items()}
        answered = own["answered"] > 0
        # Infinite where there is no gait to be right about.
        ratio = np.nan_to_num(np.abs(own["wrong"]) / own["errors"], nan=np.inf).max(1)
        lower = answered & (own["hows"] <= 1) & np.isfinite(ratio)
        for which, rows in (("all", lower), ("of one step", lower & (own["hows"] == 0))):
            effect = own["effectivity"][rows][np.abs(own["model_error"][rows]) > SEEN]
            within = np.sum((effect > 0.5) & (effect < 2.0))
            print(f"{name}: effectivity in 0.5 ... 2, {which}: {within} of {len(effect)}")
        cost = np.sum((1.0 + own["n_steps"])[answered]) / np.sum(best(own)[answered])
        print(f"{name}: cost over that of the best rung {cost:.3f}")
        lost = Counter(vrw.Outcome(int(code)).name for code in own["outcomes"][~answered])
        print(f"{name}: {len(answered)} wheels, {answered.sum()} answered; no answer: {dict(lost)}")
        for tol in TOLERANCES:
            here = answered & (np.abs(own["tol"] / tol - 1.0) < 1e-3)
            hows = [np.sum(here & (own["hows"] == how)) for how in range(len(KINDS))]
            outside = ratio[here & (ratio > 1.0)]
            finite = outside[np.isfinite(outside)]
            worst = f"{finite.max():.3g}" if len(finite) else ""
            steps, without = f"{np.mean(own['n_steps'][here]):.1f}", len(outside) - len(finite)
            table.append(
                [name, f"{tol:.0e}", np.sum(here), *hows, steps, len(finite), worst, without]
            )
    header = "set", "tolerance", "answers", *KINDS, "steps", "outside", "worst", "gait unconfirmed"
    write(COUNT, header, table)
    print(markdown(header, table))


def draw() -> None:
    cloud = dict(np.load(CLOUD))
    with plots.figure_style():
        page = plt.figure(figsize=(plots.PAGE, 5.6))
        top, below = page.subfigures(2, 1)
        axis, cost = top.subplots(1, 2)
        ends = np.array([1e-13, 1e0])
        wrong = np.maximum(np.abs(cloud["wrong"]), ends[0])
        outside = np.abs(cloud["wrong"]) > cloud["errors"]
        for how, kind in enumerate(KINDS):
            some = (cloud["hows"] == how)[:, None] & ~outside
            axis.plot(cloud["errors"][some], wrong[some], ".", ms=1.5, color=COLOURS[how],
                      rasterized=True)  # fmt: skip
            axis.plot([], [], "o", ms=3, color=COLOURS[how], label=kind)
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
            kept = np.isin(cloud["hows"], hows)
            here = [kept & (np.abs(cloud["tol"] / tol - 1.0) < 1e-3) for tol in TOLERANCES]
            cost.plot(TOLERANCES, [np.nanmean(cloud["n_steps"][i]) for i in here], "o-", ms=3,
                      color=colour, label=name)  # fmt: skip
        cost.axhline(1.0, color=plots.GREY, lw=0.6)
        cost.set(xscale="log", yscale="log", xlabel="tolerance", ylabel="steps on real ground")
        cost.invert_xaxis()
        cost.legend(fontsize=6, loc="lower right", bbox_to_anchor=(1.0, 0.06))
        points = read(MAP)
        names = (*KINDS, "no gait found")
        colours = ListedColormap(COLOURS)
        for axis, tol in zip(below.subplots(1, 3, sharey=True), MAPPED, strict=True):
            some = [r for r in points if float(r["tol"]) == tol]
            how = numbers(some, "how").reshape(len(FRICTION), len(DAMPING))
            axis.pcolormesh(DAMPING, FRICTION, how, vmin=-0.5, vmax=4.5, cmap=colours)
            axis.set(yscale="log", xlabel="damping $c$ [N·s/m]", title=f"tolerance {tol:g}")
            if tol == MAPPED[0]:
                axis.set_ylabel("friction coefficient $\\mu$")
        patches = [Patch(color=colours(i), label=name) for i, name in enumerate(names)]
        below.legend(handles=patches, loc="outside lower center", ncols=len(names), fontsize=6)
    plots.save(page, FIGURES, "answers")


def main() -> None:
    parser = command(__doc__)
    parser.add_argument("--parts", type=int, default=25)
    parser.add_argument("--folder", type=Path, default=Path("results/answers"))
    parser.add_argument("--redraw", action="store_true", help="compute nothing")
    asked = started(parser)
    if not asked.redraw:
        compute(asked.parts, asked.folder)
        gathered(asked.folder)
        mapped()
    counted()
    draw()


if __name__ == "__main__":
    main()
