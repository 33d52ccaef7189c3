"""Four wheels and three clutches in a row: locking, breaking loose, and locking again.

The Modelica library's CoupledClutches: inertias of 1 kg m^2, the first turns with 10 rad/s and is
driven by 10 sin(10 pi t) N m. A clutch that slides passes 10 N m times its pressure, a locked one
holds 1.1 times that; pressures are cos(0.4 pi t), and 1 from 0.4 s and from 0.9 s. Rates are sums
of sines, so that each time is the root of a closed form, here in 30 digits. Published: the times of
the library's own reference result (MAP-LIB_ReferenceResults), which 4 digits of hold.
"""

from collections.abc import Callable, Iterator
from typing import Any

import mpmath
import numpy as np
from matplotlib.figure import Figure

from experiments.atlas.hybrid import (
    METHODS,
    GuardEdge,
    Numbers,
    Part,
    last_time,
    make_row,
    run_library,
)
from experiments.atlas.results import Case, Row

SLIDING, STATIC_RATIO = 10.0, 1.1
FAST_FREQUENCY, SLOW_FREQUENCY = 10.0 * mpmath.pi, 0.4 * mpmath.pi
TIMES = (0.4, 0.9, 1.25)
"""When the second and third clutch are pressed, and the first no longer is, s."""
START = (10.0, 0.0, 0.0, 0.0, 0.0)
"""Rates of the wheels, rad/s, and the clock, s."""


def drive(t: Any, m: Any) -> Any:
    return 10.0 * m.sin(float(FAST_FREQUENCY) * t)


def first_clutch_torque(t: Any, m: Any) -> Any:
    """Return the torque of the first clutch while it slides, N m."""
    return SLIDING * m.cos(float(SLOW_FREQUENCY) * t)


SHARES = (  # of the drive, of the first clutch, and a constant, in each wheel's acceleration
    ((1, -1, 0), (0, 1, 0), (0, 0, 0), (0, 0, 0)),
    ((1, -1, 0), (0, 1, -10), (0, 0, 10), (0, 0, 0)),
    ((1, -1, 0), (0, 1 / 2, 0), (0, 1 / 2, 0), (0, 0, 0)),
    ((1 / 3, 0, 0), (1 / 3, 0, 0), (1 / 3, 0, 0), (0, 0, 0)),
    ((1, -1, 0), (0, 1 / 2, 0), (0, 1 / 2, 0), (0, 0, 0)),
    ((1, -1, 0), (0, 1 / 2, -5), (0, 1 / 2, -5), (0, 0, 10)),
    ((1 / 3, 0, -10 / 3), (1 / 3, 0, -10 / 3), (1 / 3, 0, -10 / 3), (0, 0, 10)),
    ((1, -1, 0), (0, 1 / 2, -5), (0, 1 / 2, -5), (0, 0, 10)),
    ((1, -1, 0), (0, 1 / 3, 0), (0, 1 / 3, 0), (0, 1 / 3, 0)),
    ((1, 0, 0), (0, 0, 0), (0, 0, 0), (0, 0, 0)),
)
"""Mode after mode."""


def clock(end: float) -> Callable:
    return lambda y, m: end - y[4]


def gap(first: int, second: int) -> Callable:
    return lambda y, m: y[first] - y[second]


def grip(mode: int) -> Callable:
    """Return a guard: the largest torque of the locked first clutch, minus the transmitted
    torque.
    """
    a, _, c = SHARES[mode][0]
    return lambda y, m: STATIC_RATIO * first_clutch_torque(y[4], m) - ((1 - a) * drive(y[4], m) - c)


ENDS = (
    clock(TIMES[0]), gap(1, 2), gap(0, 1), grip(3), clock(TIMES[1]), gap(0, 1), grip(6), gap(2, 3),
    clock(TIMES[2]), clock(1.5),
)  # fmt: skip
NAMES = {
    2: "clutch 2 locks", 3: "clutch 1 locks", 4: "clutch 1 breaks loose", 6: "clutch 1 locks again",
    7: "clutch 1 breaks loose again", 8: "clutch 3 locks",
}  # fmt: skip
PUBLISHED_TIMES = {
    2: 0.70962146383288, 3: 0.79165828432025, 4: 0.83110850627034, 6: 0.90684913754438,
    7: 1.00029586011387, 8: 1.14396963043371,
}  # fmt: skip
"""By the number of the event, s."""
RATE = 3.2470345652406571
"""Of the first wheel at 1.5 s, as published."""


def part(mode: int) -> Part:
    def field(y: Numbers, m: Any) -> tuple:
        pushes = drive(y[4], m), first_clutch_torque(y[4], m)
        return (*(a * pushes[0] + b * pushes[1] + c for a, b, c in SHARES[mode]), 1.0 + 0.0 * y[4])

    return Part(field, (GuardEdge(ENDS[mode], target_part=(mode + 1) % len(ENDS)),))


SYSTEM = tuple(part(mode) for mode in range(len(ENDS)))


def reference() -> tuple[np.ndarray, float]:
    """Return the event times, and the rate of the first wheel at the last event."""
    with mpmath.workdps(30):
        fast, slow = mpmath.mpf(float(FAST_FREQUENCY)), mpmath.mpf(float(SLOW_FREQUENCY))
        y, begin, result = [mpmath.mpf(x) for x in START], mpmath.mpf(0), []
        for mode, end in enumerate(ENDS):

            def at(t, y=y, begin=begin, mode=mode):
                sums = (
                    10 * (mpmath.cos(fast * begin) - mpmath.cos(fast * t)) / fast,
                    SLIDING * (mpmath.sin(slow * t) - mpmath.sin(slow * begin)) / slow,
                    t - begin,
                )
                shares = zip(y, SHARES[mode], strict=False)
                rates = [
                    w + sum(a * s for a, s in zip(torque_shares, sums, strict=True))
                    for w, torque_shares in shares
                ]
                return [*rates, t]

            value = lambda t, at=at, end=end: end(at(t), mpmath)
            t, step = begin + mpmath.mpf("1e-4"), mpmath.mpf("1e-3")
            while value(t + step) > 0:
                t += step
            t = mpmath.findroot(value, (t, t + step), solver="anderson", tol=1e-50)
            y, begin = at(t), t
            result.append(float(t))
        return np.array(result), float(y[0])


def rows() -> Iterator[Row]:
    times, rate = reference()
    for method in METHODS:
        walk_result = method(SYSTEM, START, len(ENDS), 2.0)
        for event in (3, 7, 8):
            solution = last_time(walk_result, event)
            yield make_row(walk_result, NAMES[event], solution, times[event - 1], event=event)
        has_all_events = len(walk_result.times) == len(ENDS)
        yield make_row(
            walk_result,
            "rate at 1.5 s",
            float(walk_result.end[0]) if has_all_events else np.nan,
            rate,
        )
        if method is run_library:
            for event, result in PUBLISHED_TIMES.items():
                solution, name = last_time(walk_result, event), f"{NAMES[event]}, as published"
                yield make_row(walk_result, name, solution, result, digits=4, event=event)
            yield make_row(
                walk_result, "rate, as published", float(walk_result.end[0]), RATE, digits=4
            )


def draw(figure: Figure, rows: list[dict[str, str]]) -> None:
    axes = figure.subplots()
    walk_result = run_library(SYSTEM, START, len(ENDS), 2.0)
    begin, y = 0.0, np.array(START[:4])
    for wheel, style in enumerate(("-", "--", "-.", ":")):
        axes.plot([], [], style, color=f"C{wheel}", label=f"wheel {wheel + 1}")
    for mode, (end, after) in enumerate(zip(walk_result.times, walk_result.states, strict=True)):
        t = np.linspace(begin, end, 60)
        sums = np.stack(
            [
                10
                * (np.cos(float(FAST_FREQUENCY) * begin) - np.cos(float(FAST_FREQUENCY) * t))
                / float(FAST_FREQUENCY),
                SLIDING
                * (np.sin(float(SLOW_FREQUENCY) * t) - np.sin(float(SLOW_FREQUENCY) * begin))
                / float(SLOW_FREQUENCY),
                t - begin,
            ]
        )
        for wheel, style in enumerate(("-", "--", "-.", ":")):
            axes.plot(t, y[wheel] + np.array(SHARES[mode][wheel]) @ sums, style, color=f"C{wheel}")
        begin, y = end, after[:4]
    for event, time in PUBLISHED_TIMES.items():
        axes.plot(time, walk_result.states[event - 1, 1], "ko", ms=4, mfc="w")
    axes.plot([], [], "ko", ms=4, mfc="w", label="published times")
    axes.set_xlabel("time [s]")
    axes.set_ylabel("rate [rad/s]")
    axes.legend(ncols=2)


CASE = Case(
    "Clutches in a row",
    "ten modes; each lock is broken by its own guard",
    "sums of sines, roots in 30 digits; published to 4 digits",
    "Modelica's Mechanics.Rotational.Examples.CoupledClutches and its reference result",
    rows,
    draw,
)
