"""Claimed against true errors of `vrw.answer`, what it costs, and which rung answers where.

    python -m experiments.answers.claimed [--wheels 400] [--redraw]

Half of the wheels are drawn from a wide box, half are hostile: of eight times as many the paper's
gaits that are nearest to a fold, to a border (an indicator at zero) or without double support.
Friction is 0.5 to 100. The truth of a wheel is what the answer at a tolerance of 1e-9 tells, where
that is the same gait: it is the iteration's own limit, and proves no bound by another method.
"""

import matplotlib.pyplot as plt
import numpy as np

import vrw_jax as vrw
from experiments.shared.command import command, started
from experiments.shared.tables import FIGURES, numbers, read, write
from experiments.shared.wheels import WIDE_BOX
from vrw_jax import figures as plots

TOLERANCES = (1e-2, 1e-3, 1e-4, 1e-6)
EXACT = 1e-9
MAPPED = (1e-2, 1e-4, 1e-6)
MEASURES = ("speed", "dls_fraction", "period")
DAMPING, FRICTION = np.linspace(100.0, 210.0, 8), np.geomspace(1.0, 100.0, 7)
CLOUD, MAP = FIGURES / "answers_cloud.csv", FIGURES / "answers_map.csv"


def wheels(n: int) -> tuple[vrw.WheelParams, np.ndarray]:
    """The box first, then the hostile ones, and friction of each."""
    random = np.random.default_rng(0)
    draw = lambda n: {name: random.uniform(*ends, n) for name, ends in WIDE_BOX.items()}
    box, many = draw(n), draw(8 * n)
    cycles = vrw.limit_cycles(vrw.WheelParams(**many))
    forces = cycles.indicators
    fold = np.abs(np.linalg.det(np.eye(2) - np.asarray(cycles.matrix)))
    near = np.minimum.reduce([
        fold, np.abs(forces.lambda_4) / 20.0, np.abs(forces.lambda_I4) / 5.0,
        np.asarray(cycles.dls_fraction),
    ])  # fmt: skip
    hostile = np.argsort(np.where(np.asarray(cycles.found), near, np.inf))[:n]
    columns = {name: np.concatenate([box[name], many[name][hostile]]) for name in box}
    friction = np.exp(random.uniform(np.log(0.5), np.log(100.0), 2 * n))
    return vrw.WheelParams(**columns), friction


def compute(n: int) -> None:
    params, friction = wheels(n // 2)
    exact = vrw.answer(MEASURES, params, EXACT, friction=friction)
    rows = []
    for tol in TOLERANCES:
        told = vrw.answer(MEASURES, params, tol, friction=friction)
        for i, name in enumerate(MEASURES):
            columns = [
                np.arange(len(friction)) >= n // 2, friction, told.rungs, told.hows, told.n_steps,
                exact.hows, exact.n_steps, told.values[:, i], told.errors[:, i],
                told.model_errors[:, i], exact.values[:, i], exact.errors[:, i],
            ]  # fmt: skip
            rows += [(tol, name, *row) for row in zip(*columns, strict=True)]
    header = (
        "tol", "measure", "hostile", "friction", "rung", "how", "n_steps", "exact_how",
        "exact_n_steps", "value", "error", "model_error", "exact", "exact_error",
    )  # fmt: skip
    write(CLOUD, header, rows)
    c, mu = (x.ravel() for x in np.meshgrid(DAMPING, FRICTION))
    rows = []
    for tol in MAPPED:
        told = vrw.answer("speed", vrw.WheelParams(damping=c), tol, friction=mu)
        rows += [
            (tol, *row) for row in zip(c, mu, told.rungs, told.hows, told.n_steps, strict=True)
        ]
    write(MAP, ("tol", "damping", "friction", "rung", "how", "n_steps"), rows)


def counted() -> None:
    """Quantiles for the page."""
    rows = read(CLOUD)
    for tol in TOLERANCES:
        some = [r for r in rows if float(r["tol"]) == tol]
        of = lambda name, some=some: numbers(some, name)
        same = np.isfinite(of("value")) & np.isfinite(of("exact"))
        same &= (of("how") <= 1) == (of("exact_how") <= 1)
        wrong, allowed = np.abs(of("value") - of("exact")), of("error") + of("exact_error")
        ratio = (wrong / allowed)[same]
        first = same & (of("how") == 0) & (wrong > 1e-9)
        effect = (of("model_error") / (of("value") - of("exact")))[first]
        good = np.mean((effect > 0.5) & (effect < 2.0)) if len(effect) else np.nan
        print(
            f"tol {tol:g}: {same.sum()} of {len(same)} alike; outside {np.sum(ratio > 1.0)}, "
            f"by more than 3 {np.sum(ratio > 3.0)}, most {ratio.max():.3g}; lower {len(effect)}, "
            f"effectivity in 0.5 ... 2 {good:.3f}; steps {np.mean(of('n_steps')):.1f}"
        )


def draw() -> None:
    rows, page = read(CLOUD), plt.figure(figsize=(plots.PAGE, 5.4), layout="constrained")
    top, below = page.subfigures(2, 1)
    cloud, cost = top.subplots(1, 2)
    for tol, colour in zip(TOLERANCES, ("#0072B2", "#E69F00", "#009E73", "#D55E00"), strict=True):
        some = [r for r in rows if float(r["tol"]) == tol and np.isfinite(float(r["value"]))]
        wrong = np.abs(numbers(some, "value") - numbers(some, "exact"))
        cloud.loglog(numbers(some, "error"), np.maximum(wrong, 1e-13), ".", ms=2, color=colour,
                     label=f"{tol:g}")  # fmt: skip
    ends = np.array([1e-12, 1e-1])
    cloud.plot(ends, ends, "k", lw=0.6)
    cloud.set(xlabel="claimed error", ylabel="true error", xlim=ends, ylim=(1e-13, 1e0))
    cloud.legend(title="tolerance", fontsize=6)
    for name, how in (("continues the paper's", (0, 1)), ("walked to", (2, 3))):
        kept = [r for r in rows if int(r["exact_how"]) in how and r["measure"] == MEASURES[0]]
        mean = [
            np.mean([int(r["n_steps"]) for r in kept if float(r["tol"]) == t]) for t in TOLERANCES
        ]
        cost.loglog(TOLERANCES, mean, "o-", ms=3, label=name)
    cost.set(xlabel="tolerance", ylabel="steps on real ground")
    cost.legend(fontsize=6)
    points = read(MAP)
    for axis, tol in zip(below.subplots(1, 3, sharey=True), MAPPED, strict=True):
        some = [r for r in points if float(r["tol"]) == tol]
        how = numbers(some, "how").reshape(len(FRICTION), len(DAMPING))
        axis.pcolormesh(DAMPING, FRICTION, how, vmin=0, vmax=4, cmap="viridis")
        axis.set(yscale="log", xlabel="damping $c$ [N·s/m]", title=f"tolerance {tol:g}")
    plots.save(page, FIGURES, "answers")


def main() -> None:
    parser = command(__doc__)
    parser.add_argument("--wheels", type=int, default=400)
    parser.add_argument("--redraw", action="store_true", help="compute nothing")
    asked = started(parser)
    if not asked.redraw:
        compute(asked.wheels)
    counted()
    draw()


if __name__ == "__main__":
    main()
