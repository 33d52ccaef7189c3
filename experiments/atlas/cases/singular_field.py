"""Events beside a singularity of the field: a step that looks past the event finds nothing there.

y' = -1/(2 y) is sqrt(1 - t), which ends at t = 1; the guard is at y = 1e-4, so that t = 1 - 1e-8. A
tank runs empty by y' = -2 sqrt(y), y = (1 - t)^2; the guard is at y = 1e-4, so that t = 1 - 1e-2,
and below zero the field is not a number. Esposito and Kumar (2007) tell why events of such models
fail.
"""

from collections.abc import Iterator

import numpy as np
from matplotlib.figure import Figure

from experiments.atlas.hybrid import METHODS, GuardEdge, MethodRun, Part, last_time, make_row
from experiments.atlas.results import Case, Row

LEVELS = (1e-4, 1e-8)


def root(level: float) -> tuple[Part, ...]:
    return (Part(lambda y, m: (-0.5 / y[0],), (GuardEdge(lambda y, m: y[0] - level),)),)


def tank(level: float) -> tuple[Part, ...]:
    return (Part(lambda y, m: (-2.0 * m.sqrt(y[0]),), (GuardEdge(lambda y, m: y[0] - level),)),)


QUESTIONS = (("pole", root(1e-4), 1.0 - 1e-8), ("empty tank", tank(1e-4), 1.0 - 1e-2))


def rows() -> Iterator[Row]:
    for name, system, reference in QUESTIONS:
        for method in METHODS:
            walk_result = method(system, (1.0,), 1, 1.5)
            yield make_row(
                walk_result, f"event before the {name}", last_time(walk_result, 1), reference
            )


def draw(figure: Figure, rows: list[dict[str, str]]) -> None:
    axes = figure.subplots()
    levels = 10.0 ** -np.arange(1.0, 8.0)

    def error(walk_result: MethodRun, level: float) -> float:
        solution = last_time(walk_result, 1)
        return abs(solution - (1.0 - level**2)) + 1e-17 if np.isfinite(solution) else np.nan

    for method, marker in zip(METHODS, "o^sD", strict=True):
        walks = [method(root(level), (1.0,), 1, 1.5) for level in levels]
        errors = [error(w, level) for w, level in zip(walks, levels, strict=True)]
        line = axes.loglog(levels, errors, marker + "-", ms=4, label=walks[0].method)
        levels_without_result = levels[np.isnan(errors)]
        axes.loglog(
            levels_without_result,
            np.full(len(levels_without_result), 1.0),
            "x",
            color=line[0].get_color(),
        )
    axes.set_xlabel("guard's distance from the pole")
    axes.set_ylabel("error of the time (×: no event)")
    axes.legend()


CASE = Case(
    "Event beside a singularity",
    "a step past the event leaves the field's domain",
    "closed form: 1 − 1e-8 and 1 − 1e-2",
    "the class of Esposito and Kumar, ACM TOMACS 17 (2007); closed forms derived here",
    rows,
    draw,
)
