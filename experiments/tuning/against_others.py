"""Exact gradients find the best gait in 5 gaits; COBYLA takes 3 times, CMA-ES 60 times as many.

From random starts in the box of the configs, for the most double support and for the largest
stability margin, every premise kept: `vrw.tune`, CMA-ES, Nelder-Mead (both with an exact penalty)
and COBYLA, at equal numbers of limit cycles. Then a grid around the best wheel, and a walk of it.
Both optima are corners, held by as many constraints and bounds as there are parameters: where
linear models are all it takes COBYLA is as good as it gets. Gaps below 1e-5 are the breach allowed.

    python -m experiments.tuning.against_others [folder] [--starts 20]

Writes `tuning_against_others.csv`, `.svg` and `.png` to `docs/figures` or the folder given, and the
table of `tuning.md` beside it.
"""

import contextlib
import itertools
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure
from scipy.optimize import minimize

import vrw_jax as vrw
from experiments.shared.command import command, extra, started
from experiments.shared.tables import FIGURES, markdown, replace, write_named
from vrw_jax import figures as plots
from vrw_jax.app.config import load
from vrw_jax.cycles import AGREEMENT
from vrw_jax.tuning import tune
from vrw_jax.tuning.objective import slack_scales
from vrw_jax.tuning.problem import TuneProblem, tuning_problem
from vrw_jax.wheel import wheel_of

cma = extra("cma")

CONFIGS = Path(__file__).parents[2] / "configs"
LABELS = {"tune": "this library"}
DASHES = ("-", "--", "-.", ":")  # of the methods, in their order
PROBLEMS = {"most double support": "tune_dls", "largest stability margin": "tune_stability"}
ALLOWED = 400  # gaits per start and method
SEED = 1
KEPT = 1e-4  # breach of a constraint that still counts as none, in widths of the bounds
NEAR = (1e-2, 1e-3, 1e-4)  # gaps to the best objective known, relative
PENALTY = 1.0  # objective lost per width of breach; several times any constraint's price
LOST = 10.0  # objective where there is no gait, for the methods that can't be told


class Seen(NamedTuple):
    """What one method evaluated from one start, in order."""

    objective: np.ndarray  # NaN where there was no gait
    breach: np.ndarray
    seconds: float


class SpentError(Exception):
    pass


class Counter:
    """Objective and breach of a problem at u, each gait counted; without derivatives."""

    def __init__(self, problem: TuneProblem, values: Callable, scales: np.ndarray) -> None:
        self._problem, self._values, self._scales = problem, values, scales
        self.objective: list[float] = []
        self.breach: list[float] = []
        self.allowed = ALLOWED

    def __call__(self, u: np.ndarray) -> tuple[float, np.ndarray]:
        """Objective and slack in widths of the bounds; NaN and -1 where there is no gait."""
        if len(self.objective) >= self.allowed:
            raise SpentError
        u = np.clip(u, 0.0, 1.0)
        found, values = self._values(jnp.asarray(self._problem.parameters(u)))
        values = np.asarray(values)
        slack = (values[1:] - self._problem.least) / self._scales
        if not bool(found):
            values, slack = np.full_like(values, np.nan), -np.ones_like(slack)
        self.objective.append(float(values[0]))
        self.breach.append(float(np.max(-slack, initial=0.0)))
        return float(values[0]), slack

    def penalised(self, u: np.ndarray) -> float:
        """To be minimised: an exact penalty on every breach, and on leaving the box."""
        objective, slack = self(u)
        outside = float(np.sum(np.abs(u - np.clip(u, 0.0, 1.0))))
        if np.isnan(objective):
            return LOST + outside
        return -objective + PENALTY * (float(np.sum(np.maximum(-slack, 0.0))) + outside)


def values_of(problem: TuneProblem) -> Callable:
    """Whether there is a gait, and objective and constraints, compiled without derivatives."""
    sought, finder = problem.sought, problem.finder

    def values(parameters: jax.Array) -> tuple[jax.Array, jax.Array]:
        wheel = wheel_of(parameters, problem.params.n_legs)
        cycle = finder.cycle(wheel)
        step = finder.model.step(wheel, cycle.section_state, finder.step_options)
        agrees = jnp.max(jnp.abs(step.section_state - cycle.section_state)) <= AGREEMENT
        found = cycle.found & (step.outcome == vrw.Outcome.STEPPED) & agrees
        return found, sought(cycle, step)

    return jax.jit(values)


def cma_es(count: Counter, u: np.ndarray, seed: int) -> None:
    options = {"bounds": [0.0, 1.0], "seed": seed + 1, "verbose": -9, "tolfun": 1e-12}
    cma.fmin2(count.penalised, u, 0.25, options, restarts=9)


def nelder_mead(count: Counter, u: np.ndarray, seed: int) -> None:
    simplex = np.vstack([u, *(u + 0.15 * np.where(u < 0.5, 1, -1) * e for e in np.eye(u.size))])
    options = {"initial_simplex": simplex, "maxfev": ALLOWED, "xatol": 1e-10, "fatol": 1e-12}
    minimize(count.penalised, u, method="Nelder-Mead", options=options)


def cobyla(count: Counter, u: np.ndarray, seed: int) -> None:
    """The constraints as they are; both functions of one place are one gait."""
    last: dict[bytes, tuple[float, np.ndarray]] = {}

    def told(u: np.ndarray) -> tuple[float, np.ndarray]:
        key = u.tobytes()
        if key not in last:
            last.clear()
            last[key] = count(u)
        return last[key]

    def objective(u: np.ndarray) -> float:
        value = told(u)[0]
        return LOST if np.isnan(value) else -value

    minimize(
        objective,
        u,
        method="COBYLA",
        bounds=[(0.0, 1.0)] * u.size,
        constraints={"type": "ineq", "fun": lambda u: told(u)[1]},
        options={"rhobeg": 0.15, "tol": 1e-8, "maxiter": ALLOWED},
    )


OTHERS = {"CMA-ES": cma_es, "Nelder-Mead": nelder_mead, "COBYLA": cobyla}


def by_tune(problem: TuneProblem, u: np.ndarray, scales: np.ndarray) -> Seen:
    began = time.perf_counter()
    tuned = tune(
        problem.wheel(u),
        problem.sought.objective,
        problem.free,
        dict(zip(problem.free, zip(problem.lower, problem.upper, strict=True), strict=True)),
        problem.margins,
        max_evaluations=ALLOWED,
    )
    slack = (tuned.path.constraint_value.values - problem.least) / scales
    breach = np.nan_to_num(np.max(-slack, axis=1, initial=0.0), nan=1.0)
    return Seen(tuned.path.objective.values, breach, time.perf_counter() - began)


def by_other(method: Callable, count: Counter, u: np.ndarray, seed: int) -> Seen:
    began = time.perf_counter()
    with contextlib.suppress(SpentError):
        method(count, u, seed)
    return Seen(np.array(count.objective), np.array(count.breach), time.perf_counter() - began)


def best_so_far(seen: Seen) -> np.ndarray:
    """The best objective of a gait that keeps every constraint, after each evaluation."""
    kept = np.isfinite(seen.objective) & (seen.breach <= KEPT)
    return np.maximum.accumulate(np.where(kept, seen.objective, -np.inf))


def starts_of(problem: TuneProblem, values: Callable, n: int) -> list[np.ndarray]:
    """Random wheels of the box that have a gait, whether or not it keeps the premises."""
    generator = np.random.default_rng(SEED)
    starts: list[np.ndarray] = []
    while len(starts) < n:
        u = generator.uniform(size=len(problem.free))
        if bool(values(jnp.asarray(problem.parameters(u)))[0]):
            starts.append(u)
    return starts


def grid_around(problem: TuneProblem, values: Callable, u: np.ndarray, best: float) -> dict:
    """Whether any wheel of a grid of 7 values per parameter around u is better, at two scales."""
    checked = kept = better = 0
    for reach in (0.05, 0.005):
        for offset in itertools.product(np.linspace(-reach, reach, 7), repeat=u.size):
            place = u + np.array(offset)
            if place.min() < 0.0 or place.max() > 1.0:
                continue
            found, told = values(jnp.asarray(problem.parameters(place)))
            checked += 1
            if bool(found) and np.all(np.asarray(told)[1:] >= problem.least):
                kept += 1
                better += float(told[0]) > best + 1e-9
    return {"checked": checked, "keep the constraints": kept, "better": better}


def compared(problem: TuneProblem, n_starts: int, rows: list[dict], name: str) -> dict:
    values = values_of(problem)
    starts = starts_of(problem, values, n_starts)
    # What a constraint changes over the box makes breaches comparable; once, at the config's wheel.
    first = problem.start()
    scales = slack_scales(first.slack, first.slopes)
    seen: dict[str, list[Seen]] = {"tune": [by_tune(problem, u, scales) for u in starts]}
    for method, run in OTHERS.items():
        seen[method] = [
            by_other(run, Counter(problem, values, scales), u, i) for i, u in enumerate(starts)
        ]
        print(name, method, f"{sum(s.seconds for s in seen[method]):.0f} s", flush=True)
    curves = {method: [best_so_far(one) for one in some] for method, some in seen.items()}
    best = max(float(curve[-1]) for some in curves.values() for curve in some)
    for method, some in curves.items():
        for start, (curve, one) in enumerate(zip(some, seen[method], strict=True)):
            row = {
                "problem": name,
                "method": method,
                "start": start,
                "best": f"{curve[-1]:.9g}",
                "gap": f"{(best - curve[-1]) / abs(best):.3g}",
                "gaits": len(curve),
                "seconds": f"{one.seconds:.3f}",
            }
            for gap in NEAR:
                reached = np.flatnonzero(curve >= best - gap * abs(best))
                row[f"gaits to {gap:g}"] = int(reached[0]) + 1 if reached.size else ""
            rows.append(row)
    return {"curves": curves, "best": best, "starts": starts, "values": values}


def drawn(results: dict[str, dict]) -> Figure:
    """Gap to the best known over gaits evaluated: median of the starts, and quartiles."""
    with plots.figure_style():
        figure = Figure(figsize=(plots.PAGE, 2.9))
        panels = figure.subplots(1, len(results), sharey=True)
        for axes, (name, result) in zip(panels, results.items(), strict=True):
            for (method, curves), dash in zip(result["curves"].items(), DASHES, strict=True):
                gaits = np.arange(1, ALLOWED + 1)
                table = np.array(
                    [np.r_[c, np.full(ALLOWED - len(c), c[-1])][:ALLOWED] for c in curves]
                )
                gap = np.clip((result["best"] - table) / abs(result["best"]), 1e-9, 1.0)
                low, middle, high = np.quantile(gap, (0.25, 0.5, 0.75), axis=0)
                (line,) = axes.plot(gaits, middle, dash, label=LABELS.get(method, method))
                axes.fill_between(gaits, low, high, color=line.get_color(), alpha=0.15, linewidth=0)
            axes.set_xscale("log")
            axes.set_yscale("log")
            axes.set_title(name)
            axes.set_xlabel("gaits evaluated")
        panels[0].set_ylabel("gap to the best optimum, relative")
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper center", ncols=4)
    return figure


def summary(rows: list[dict]) -> str:
    """How many starts came near the best, by how many gaits and in what time: medians."""
    near = [f"within {gap:g}: starts, gaits" for gap in NEAR]
    lines = []
    of = lambda row: (row["problem"], row["method"])
    for (problem, method), some in itertools.groupby(rows, key=of):
        mine = list(some)
        told = []
        for gap in NEAR:
            reached = [int(row[f"gaits to {gap:g}"]) for row in mine if row[f"gaits to {gap:g}"]]
            gaits = f", {np.median(reached):.0f}" if reached else ""
            told.append(f"{len(reached)} of {len(mine)}{gaits}")
        seconds = [float(row["seconds"]) for row in mine]
        times = f"{np.median(seconds):.2f}", f"{max(seconds):.2f}"
        lines.append((problem, method, *told, *times))
    return markdown(("problem", "method", *near, "s", "longest, s"), lines)


def main() -> None:
    parser = command(__doc__)
    parser.add_argument("folder", type=Path, nargs="?", default=FIGURES)
    parser.add_argument("--starts", type=int, default=20, help="random starts of each problem")
    chosen = started(parser)
    folder, n_starts = chosen.folder, chosen.starts
    rows: list[dict] = []
    results = {}
    for name, config in PROBLEMS.items():
        settings = load(CONFIGS / f"{config}.toml")
        sought = settings.tune
        assert sought is not None
        problem = tuning_problem(
            settings.params(), sought.objective, tuple(sought.bounds), sought.bounds,
            sought.constraints,
        )  # fmt: skip
        result = results[name] = compared(problem, n_starts, rows, name)
        tuned = tune(
            problem.params, sought.objective, problem.free, sought.bounds, sought.constraints
        )
        u = np.array([float(getattr(tuned.params, n)) for n in problem.free]) - problem.lower
        u = u / problem.widths
        print(f"\n{name}: best known {result['best']:.9g}\n{tuned}")
        print("grid around it:", grid_around(problem, result["values"], u, tuned.value))
    write_named(folder / "tuning_against_others.csv", rows)
    table = summary(rows)
    print(table)
    page = folder.parent / "tuning.md"
    if page.exists():
        replace(page, "table", table)
    plots.save(drawn(results), folder, "tuning_against_others")


if __name__ == "__main__":
    main()
