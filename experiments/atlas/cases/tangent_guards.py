"""Two guards at a tangent, and a graze: the wrong root, the wrong order.

A point runs along a parabola's tangent: guards 1 - x and 1 + k y^2 - x, tangent to each other at y
= 0, are met at y = 1e-5 within 1e-10; the first must win though it is listed last. A point on the
unit circle dips 1e-8 below a line: it enters at t = 3 pi/2 - arccos(1 - 1e-8), long before its end.
"""

import math
from collections.abc import Iterator

import mpmath
import numpy as np
from matplotlib.figure import Figure

from experiments.atlas.hybrid import METHODS, GuardEdge, Part, last_time, make_row, run_library
from experiments.atlas.results import Case, Row

DEPTH = 1e-8


def tangents(height: float) -> tuple[tuple[Part, ...], tuple[float, ...]]:
    """System and start; the run at rate cos, so that steps are not exact."""
    run = lambda y, m: (m.cos(y[2]), 0.0 * y[1], 1.0 + 0.0 * y[2])
    edges = (GuardEdge(lambda y, m: 0.5 + y[1] * y[1] - y[0]), GuardEdge(lambda y, m: 0.5 - y[0]))
    return (Part(run, edges),), (0.0, height, 0.0)


def circle(depth: float) -> tuple[Part, ...]:
    edges = (GuardEdge(lambda y, m: y[1] + (1.0 - depth)), GuardEdge(lambda y, m: 8.0 - y[2]))
    return (Part(lambda y, m: (-y[1], y[0], 1.0 + 0.0 * y[2]), edges),)


def entry(depth: float) -> float:
    with mpmath.workdps(40):
        return float(1.5 * mpmath.pi - mpmath.acos(1 - mpmath.mpf(depth)))


def rows() -> Iterator[Row]:
    system, start = tangents(1e-5)
    for method in METHODS:
        walk_result = method(system, start, 1, 1.5)
        yield make_row(
            walk_result, "time of the first guard", last_time(walk_result, 1), math.pi / 6
        )
        which = float(walk_result.edges[0]) if len(walk_result.edges) else math.nan
        yield make_row(walk_result, "which guard (0, 1)", which, 1.0)
    walks = [method(circle(DEPTH), (1.0, 0.0, 0.0), 1, 9.0) for method in METHODS]
    fine = run_library(circle(DEPTH), (1.0, 0.0, 0.0), 1, 9.0, tolerance=1e-15)
    for walk_result in (*walks, fine._replace(method="ours, 1e-15")):
        yield make_row(
            walk_result, "dip of 1e-8", last_time(walk_result, 1), entry(DEPTH),
            condition=1.0 / math.sqrt(2.0 * DEPTH),
        )  # fmt: skip


def draw(figure: Figure, rows: list[dict[str, str]]) -> None:
    axes = figure.subplots()
    depths = 10.0 ** -np.arange(1.0, 15.0)
    for k, (method, marker) in enumerate(zip(METHODS, "o^sD", strict=True)):
        errors = []
        for depth in depths:
            walk_result = method(circle(depth), (1.0, 0.0, 0.0), 1, 9.0)
            errors.append(abs(last_time(walk_result, 1) - entry(depth)) + 1e-17)
        missed = np.array(errors) > 0.5
        line = axes.loglog(
            depths[~missed], np.array(errors)[~missed], marker + "-", ms=4, label=walk_result.method
        )
        axes.loglog(
            depths[missed], np.full(missed.sum(), 3.0 ** (1 + k)), "x", color=line[0].get_color()
        )
    axes.set_xlabel("depth of the dip")
    axes.set_ylabel("error of the event time (×: missed)")
    axes.legend()


CASE = Case(
    "Guards at a tangent",
    "wrong root, wrong order, a dip between two steps",
    "closed form",
    "the class of Park and Barton, ACM TOMACS 6 (1996); closed forms derived here",
    rows,
    draw,
)
