"""Compare `vrw.tune` with CMA-ES, Nelder-Mead and COBYLA at equal numbers of limit cycles.

    python -m experiments.tuning.against_others [folder] [--starts 20]

The objectives are the largest double support and the largest stability margin, with nonnegative
margins, from random starts in the box of the configs. CMA-ES and Nelder-Mead use an exact penalty.
Then the command evaluates a grid around the best wheel, and a walk of it. `vrw.tune` finds the best
gait in 5 gaits; COBYLA takes 3 times as many. Both optima are corners, which as many constraints
and bounds hold as there are parameters. Therefore COBYLA's linear models suffice. Gaps below 1e-5
are smaller than the allowed violation.

The command writes `tuning_against_others.csv`, `.svg` and `.png` to `docs/figures` or the given
folder, and the table of `tuning.md`.
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
from experiments.shared.command import make_parser, parse_and_start_jax, require_extra
from experiments.shared.tables import (
    FIGURES,
    describe_run,
    format_markdown,
    replace_block,
    write_named_rows,
)
from vrw_jax import plot as plots
from vrw_jax.app.config import load_config
from vrw_jax.gaits import STATE_AGREEMENT_TOLERANCE
from vrw_jax.studies import tune
from vrw_jax.studies.tune_maximization import compute_slack_scales
from vrw_jax.studies.tune_problem import TuneProblem, make_tune_problem
from vrw_jax.wheel import make_wheel_from_parameters

cma = require_extra("cma")

CONFIGS = Path(__file__).parents[2] / "configs"
LABELS = {"tune": "this library"}
DASHES = ("-", "--", "-.", ":")  # line styles of the methods, in their order
PROBLEMS = {"most double support": "tune_dls", "largest stability margin": "tune_stability"}
MAX_EVALUATIONS = 400  # number of gaits per start and method
SEED = 1
CONSTRAINT_TOLERANCE = (
    1e-4  # breach of a constraint that still counts as none, in widths of the bounds
)
RELATIVE_GAPS = (1e-2, 1e-3, 1e-4)  # gaps to the best objective known, relative
PENALTY = 1.0  # objective lost per width of breach; several times any constraint's price
MISSING_GAIT_OBJECTIVE = (
    10.0  # objective where there is no gait, for the methods that can't be told
)


class MethodHistory(NamedTuple):
    """Evaluations of one method from one start, in order."""

    objective: np.ndarray  # NaN where there was no gait
    breach: np.ndarray
    seconds: float


class SpentError(Exception):
    pass


class Counter:
    """Objective and constraints of a problem at u without derivatives; counts the gaits."""

    def __init__(self, problem: TuneProblem, values: Callable, scales: np.ndarray) -> None:
        self._problem, self._values, self._scales = problem, values, scales
        self.objective: list[float] = []
        self.breach: list[float] = []
        self.allowed = MAX_EVALUATIONS

    def __call__(self, u: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the objective and the slack in widths of the bounds; NaN and -1 if there is no
        gait."""
        if len(self.objective) >= self.allowed:
            raise SpentError
        u = np.clip(u, 0.0, 1.0)
        solution, values = self._values(jnp.asarray(self._problem.denormalize_parameters(u)))
        values = np.asarray(values)
        slack = (values[1:] - self._problem.min_constraint_values) / self._scales
        if not bool(solution):
            values, slack = np.full_like(values, np.nan), -np.ones_like(slack)
        self.objective.append(float(values[0]))
        self.breach.append(float(np.max(-slack, initial=0.0)))
        return float(values[0]), slack

    def compute_penalized(self, u: np.ndarray) -> float:
        """Return the value to minimize: the objective with an exact penalty on violations and on
        leaving the box."""
        objective, slack = self(u)
        outside = float(np.sum(np.abs(u - np.clip(u, 0.0, 1.0))))
        if np.isnan(objective):
            return MISSING_GAIT_OBJECTIVE + outside
        return -objective + PENALTY * (float(np.sum(np.maximum(-slack, 0.0))) + outside)


def values_of(problem: TuneProblem) -> Callable:
    """Return a compiled function: whether there is a gait, the objective and the constraints."""
    target_values, finder = problem.objective_and_constraints, problem.gait_finder

    def values(parameters: jax.Array) -> tuple[jax.Array, jax.Array]:
        wheel = make_wheel_from_parameters(parameters, problem.params.n_legs)
        cycle = finder.find_cycle(wheel)
        step = finder.model.take_step(wheel, cycle.section_state, finder.step_options)
        agrees = (
            jnp.max(jnp.abs(step.section_state - cycle.section_state)) <= STATE_AGREEMENT_TOLERANCE
        )
        solution = cycle.found & (step.outcome == vrw.Outcome.STEPPED) & agrees
        return solution, target_values(cycle, step)

    return jax.jit(values)


def cma_es(count: Counter, u: np.ndarray, seed: int) -> None:
    options = {"bounds": [0.0, 1.0], "seed": seed + 1, "verbose": -9, "tolfun": 1e-12}
    cma.fmin2(count.compute_penalized, u, 0.25, options, restarts=9)


def nelder_mead(count: Counter, u: np.ndarray, seed: int) -> None:
    simplex = np.vstack([u, *(u + 0.15 * np.where(u < 0.5, 1, -1) * e for e in np.eye(u.size))])
    options = {
        "initial_simplex": simplex,
        "maxfev": MAX_EVALUATIONS,
        "xatol": 1e-10,
        "fatol": 1e-12,
    }
    minimize(count.compute_penalized, u, method="Nelder-Mead", options=options)


def cobyla(count: Counter, u: np.ndarray, seed: int) -> None:
    """Minimize by COBYLA with separate constraints; objective and constraints of one point share
    one gait."""
    last: dict[bytes, tuple[float, np.ndarray]] = {}

    def evaluate(u: np.ndarray) -> tuple[float, np.ndarray]:
        key = u.tobytes()
        if key not in last:
            last.clear()
            last[key] = count(u)
        return last[key]

    def objective(u: np.ndarray) -> float:
        value = evaluate(u)[0]
        return MISSING_GAIT_OBJECTIVE if np.isnan(value) else -value

    minimize(
        objective,
        u,
        method="COBYLA",
        bounds=[(0.0, 1.0)] * u.size,
        constraints={"type": "ineq", "fun": lambda u: evaluate(u)[1]},
        options={"rhobeg": 0.15, "tol": 1e-8, "maxiter": MAX_EVALUATIONS},
    )


OTHERS = {"CMA-ES": cma_es, "Nelder-Mead": nelder_mead, "COBYLA": cobyla}


def by_tune(problem: TuneProblem, u: np.ndarray, scales: np.ndarray) -> MethodHistory:
    began = time.perf_counter()
    tuned = tune(
        problem.make_wheel(u),
        problem.objective_and_constraints.objective_function,
        problem.free_parameters,
        dict(
            zip(
                problem.free_parameters,
                zip(problem.lower_bounds, problem.upper_bounds, strict=True),
                strict=True,
            )
        ),
        problem.constraint_margins,
        max_evaluations=MAX_EVALUATIONS,
    )
    slack = (tuned.path.constraint_value.values - problem.min_constraint_values) / scales
    breach = np.nan_to_num(np.max(-slack, axis=1, initial=0.0), nan=1.0)
    return MethodHistory(tuned.path.objective.values, breach, time.perf_counter() - began)


def by_other(method: Callable, count: Counter, u: np.ndarray, seed: int) -> MethodHistory:
    began = time.perf_counter()
    with contextlib.suppress(SpentError):
        method(count, u, seed)
    return MethodHistory(
        np.array(count.objective), np.array(count.breach), time.perf_counter() - began
    )


def best_so_far(history: MethodHistory) -> np.ndarray:
    """Return the best objective of an admissible gait, after each evaluation."""
    is_feasible = np.isfinite(history.objective) & (history.breach <= CONSTRAINT_TOLERANCE)
    return np.maximum.accumulate(np.where(is_feasible, history.objective, -np.inf))


def starts_of(problem: TuneProblem, values: Callable, n: int) -> list[np.ndarray]:
    """Return random wheels of the box that have a gait, admissible or not."""
    generator = np.random.default_rng(SEED)
    starts: list[np.ndarray] = []
    while len(starts) < n:
        u = generator.uniform(size=len(problem.free_parameters))
        if bool(values(jnp.asarray(problem.denormalize_parameters(u)))[0]):
            starts.append(u)
    return starts


def grid_around(problem: TuneProblem, values: Callable, u: np.ndarray, best: float) -> dict:
    """Return whether any wheel of a grid of 7 values per parameter around u is better, at two
    scales."""
    checked = n_feasible = better = 0
    for reach in (0.05, 0.005):
        for offset in itertools.product(np.linspace(-reach, reach, 7), repeat=u.size):
            place = u + np.array(offset)
            if place.min() < 0.0 or place.max() > 1.0:
                continue
            solution, result = values(jnp.asarray(problem.denormalize_parameters(place)))
            checked += 1
            if bool(solution) and np.all(np.asarray(result)[1:] >= problem.min_constraint_values):
                n_feasible += 1
                better += float(result[0]) > best + 1e-9
    return {"checked": checked, "keep the constraints": n_feasible, "better": better}


def compare_methods(problem: TuneProblem, n_starts: int, rows: list[dict], name: str) -> dict:
    values = values_of(problem)
    starts = starts_of(problem, values, n_starts)
    # Violations are scaled by the change of each constraint over the box, at the config's wheel.
    first = problem.evaluate_start_trial(problem.normalized_start)
    scales = compute_slack_scales(first.constraint_slacks, first.slack_jacobian)
    histories_by_method: dict[str, list[MethodHistory]] = {
        "tune": [by_tune(problem, u, scales) for u in starts]
    }
    for method, run in OTHERS.items():
        histories_by_method[method] = [
            by_other(run, Counter(problem, values, scales), u, i) for i, u in enumerate(starts)
        ]
        print(
            name, method, f"{sum(s.seconds for s in histories_by_method[method]):.0f} s", flush=True
        )
    curves = {
        method: [best_so_far(history) for history in histories]
        for method, histories in histories_by_method.items()
    }
    best = max(float(curve[-1]) for method_curves in curves.values() for curve in method_curves)
    for method, method_curves in curves.items():
        for start, (curve, one) in enumerate(
            zip(method_curves, histories_by_method[method], strict=True)
        ):
            row = {
                "problem": name,
                "method": method,
                "start": start,
                "best": f"{curve[-1]:.9g}",
                "gap": f"{(best - curve[-1]) / abs(best):.3g}",
                "gaits": len(curve),
                "seconds": f"{one.seconds:.3f}",
            }
            for gap in RELATIVE_GAPS:
                reached = np.flatnonzero(curve >= best - gap * abs(best))
                row[f"gaits to {gap:g}"] = int(reached[0]) + 1 if reached.size else ""
            rows.append(row)
    return {"curves": curves, "best": best, "starts": starts, "values": values}


def draw_chart(results: dict[str, dict]) -> Figure:
    """Draw the gap to the best known objective over the number of gaits: median and quartiles."""
    with plots.figure_style():
        figure = Figure(figsize=(plots.PAGE_FIGURE_WIDTH_INCHES, 2.9))
        panels = figure.subplots(1, len(results), sharey=True)
        for axes, (name, result) in zip(panels, results.items(), strict=True):
            for (method, curves), dash in zip(result["curves"].items(), DASHES, strict=True):
                gaits = np.arange(1, MAX_EVALUATIONS + 1)
                table = np.array(
                    [
                        np.r_[c, np.full(MAX_EVALUATIONS - len(c), c[-1])][:MAX_EVALUATIONS]
                        for c in curves
                    ]
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
    """Return how many starts came near the best, and the medians of gaits and times."""
    near = [f"within {gap:g}: starts, gaits" for gap in RELATIVE_GAPS[1:]]
    lines = []
    select = lambda row: (row["problem"], row["method"])
    for (problem, method), selection in itertools.groupby(rows, key=select):
        mine = list(selection)
        reached_cells = []
        for gap in RELATIVE_GAPS[1:]:
            reached = [int(row[f"gaits to {gap:g}"]) for row in mine if row[f"gaits to {gap:g}"]]
            gaits = f", {np.median(reached):.0f}" if reached else ""
            reached_cells.append(f"{len(reached)} of {len(mine)}{gaits}")
        seconds = np.median([float(row["seconds"]) for row in mine])
        lines.append((problem, method, *reached_cells, f"{seconds:.2f}"))
    return format_markdown(("problem", "method", *near, "s"), lines)


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("folder", type=Path, nargs="?", default=FIGURES)
    parser.add_argument("--starts", type=int, default=20, help="random starts of each problem")
    chosen = parse_and_start_jax(parser)
    folder, n_starts = chosen.folder, chosen.starts
    rows: list[dict] = []
    results = {}
    for name, config in PROBLEMS.items():
        settings = load_config(CONFIGS / f"{config}.toml")
        target_values = settings.tune
        assert target_values is not None
        problem = make_tune_problem(
            settings.make_wheel(), target_values.objective, tuple(target_values.bounds),
            target_values.bounds,
            target_values.constraints,
        )  # fmt: skip
        result = results[name] = compare_methods(problem, n_starts, rows, name)
        tuned = tune(
            problem.params,
            target_values.objective,
            problem.free_parameters,
            target_values.bounds,
            target_values.constraints,
        )
        u = (
            np.array([float(getattr(tuned.params, n)) for n in problem.free_parameters])
            - problem.lower_bounds
        )
        u = u / problem.bound_widths
        print(f"\n{name}: best known {result['best']:.9g}\n{tuned}")
        print("grid around it:", grid_around(problem, result["values"], u, tuned.value))
    write_named_rows(folder / "tuning_against_others.csv", rows)
    table = summary(rows)
    print(table)
    page = folder.parent / "tuning.md"
    if page.exists():
        replace_block(page, "table", table, describe_run("experiments.tuning.against_others"))
    plots.save(draw_chart(results), folder, "tuning_against_others")


if __name__ == "__main__":
    main()
