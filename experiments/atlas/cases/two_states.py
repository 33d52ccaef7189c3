"""ARGESIM benchmark C5: a stiff linear system that switches at thresholds of its fast state.

y1' = 2.7e6 (y2 + c2 - y1), y2' = 3.5651205 (c4 - y2), from (4.2, 0.3). With c2 = 0.4, c4 = 5.5
until y1 rises to 5.8, with c2 = -0.3, c4 = 2.73 until it falls to 2.5, and so on. Both states are
sums of two exponentials; switching times are their roots in 40 digits.
"""

import itertools
from collections.abc import Iterator

import mpmath
import numpy as np
from matplotlib.figure import Figure

from experiments.atlas.hybrid import (
    GuardEdge,
    MethodRun,
    Part,
    last_time,
    make_row,
    run_diffrax,
    run_heyoka,
    run_library,
    run_scipy,
)
from experiments.atlas.results import Case, Row

FAST_RATE, SLOW_RATE = 2.7e6, 3.5651205
LEVELS = ((0.4, 5.5, 5.8), (-0.3, 2.73, 2.5))  # c2, c4, and where y1 switches
START = (4.2, 0.3)
EVENTS = 5


def part(index: int) -> Part:
    c2, c4, level = LEVELS[index]
    sign = 1.0 if index == 0 else -1.0
    return Part(
        lambda y, m: (FAST_RATE * (y[1] + c2 - y[0]), SLOW_RATE * (c4 - y[1])),
        (GuardEdge(lambda y, m: sign * (level - y[0]), target_part=1 - index),),
    )


SYSTEM = (part(0), part(1))


def reference() -> np.ndarray:
    """Switching times."""
    with mpmath.workdps(40):
        fast, slow = mpmath.mpf(FAST_RATE), mpmath.mpf(SLOW_RATE)
        y1, y2, time, result = mpmath.mpf(START[0]), mpmath.mpf(START[1]), mpmath.mpf(0), []
        for (c2, c4, level), _ in zip(itertools.cycle(LEVELS), range(EVENTS), strict=False):
            c2, c4, level = map(mpmath.mpf, (c2, c4, level))
            slow_amplitude = fast / (fast - slow) * (y2 - c4)  # of the slow exponential in y1
            first_state = lambda t, y1=y1, slow_amplitude=slow_amplitude, c2=c2, c4=c4: (
                c4 + c2 + slow_amplitude * mpmath.exp(-slow * t)
                + (y1 - c4 - c2 - slow_amplitude) * mpmath.exp(-fast * t)
            )  # fmt: skip
            first = -mpmath.log((level - c4 - c2) / slow_amplitude) / slow
            t = mpmath.findroot(
                lambda t, first_state=first_state, level=level: first_state(t) - level, first
            )
            y1, y2 = level, c4 + (y2 - c4) * mpmath.exp(-slow * t)
            time += t
            result.append(float(time))
        return np.array(result)


def walks() -> Iterator[MethodRun]:
    many = {"first_step": 1e-7, "max_solver_steps": 4_000_000}
    yield run_library(SYSTEM, START, EVENTS, 5.0, **many)
    simulation = run_library(SYSTEM, START, EVENTS, 5.0, first_step=1e-7)
    yield simulation._replace(method="ours, 20,000 steps")
    implicit = run_library(SYSTEM, START, EVENTS, 5.0, solver="Kvaerno5", tolerance=1e-10)
    yield implicit._replace(method="ours, implicit")
    yield run_diffrax(SYSTEM, START, EVENTS, 5.0, solver="Kvaerno5", tolerance=1e-10)
    yield run_scipy(SYSTEM, START, EVENTS, 5.0, method="Radau", tolerance=1e-10)
    yield run_heyoka(SYSTEM, START, EVENTS, 5.0)


def rows() -> Iterator[Row]:
    times = reference()
    for walk_result in walks():
        for n in (1, EVENTS):
            solution = last_time(walk_result, n)
            yield make_row(
                walk_result, f"switching time {n}", solution, float(times[n - 1]), event=n
            )


def draw(figure: Figure, rows: list[dict[str, str]]) -> None:
    axes = figure.subplots()
    times, begin, states = reference(), 0.0, START[1]
    for (c2, c4, _), end in zip(itertools.cycle(LEVELS), times, strict=False):
        t = np.linspace(begin, end, 100)
        y2 = c4 + (states - c4) * np.exp(-SLOW_RATE * (t - begin))
        axes.plot(t, y2 + c2, color="C0")
        axes.plot(t, y2, "--", color="C1")
        begin, states = end, y2[-1]
    for level in (5.8, 2.5):
        axes.axhline(level, color="0.7", lw=0.8)
    axes.plot([], [], color="C0", label="$y_1$, that switches")
    axes.plot([], [], "--", color="C1", label="$y_2$")
    axes.plot(times, np.interp(times, times, [5.8, 2.5, 5.8, 2.5, 5.8]), "k.", label="events")
    axes.set_xlabel("t")
    axes.set_ylim(-0.2, 8.0)
    axes.legend(loc="upper left", ncols=3)


CASE = Case(
    "Two states that switch",
    "events in a stiff phase (rate 2.7e6)",
    "sums of two exponentials, roots in 40 digits",
    "ARGESIM benchmark C5 (argesim.org/benchmarks/c05 describes it); its numbers from memory",
    rows,
    draw,
)
