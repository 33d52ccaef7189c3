"""ARGESIM benchmark C7: a pendulum that winds around a pin and off again.

Length 1 m, from pi/6 at rest; at -pi/12 the string meets a pin 0.7 m below the pivot, and swings on
with 0.3 m. Its end's speed stays, so the angle's rate jumps by 1/0.3, and back. Without damping
times are elliptic integrals; the benchmark's own run with damping has none.
"""

import math
from collections.abc import Iterator

import mpmath
import numpy as np
from matplotlib.figure import Figure

from experiments.atlas.hybrid import METHODS, GuardEdge, Part, last_time, make_row
from experiments.atlas.results import Case, Row

G, LONG_LENGTH, SHORT_LENGTH = 9.81, 1.0, 0.3
START_ANGLE, PIN_ANGLE = math.pi / 6, -math.pi / 12
EVENTS = 12


def swing(length: float, gain: float, sign: float, target: int) -> Part:
    return Part(
        lambda y, m: (y[1], -G / length * m.sin(y[0])),
        (
            GuardEdge(
                lambda y, m: sign * (y[0] - PIN_ANGLE),
                lambda y, m: (PIN_ANGLE, gain * y[1]),
                target,
            ),
        ),
    )


SYSTEM = (
    swing(LONG_LENGTH, LONG_LENGTH / SHORT_LENGTH, 1.0, 1),
    swing(SHORT_LENGTH, SHORT_LENGTH / LONG_LENGTH, -1.0, 0),
)
START = (START_ANGLE, 0.0)


def reference(events: int) -> np.ndarray:
    """Return the times at which the pendulum touches and leaves the pin."""
    with mpmath.workdps(40):
        half = lambda high, angle: mpmath.sin(mpmath.mpf(angle) / 2) / mpmath.sin(high / 2)

        def passage(length: float, high: mpmath.mpf, angle: mpmath.mpf) -> mpmath.mpf:
            """From the highest angle to another."""
            m = mpmath.sin(high / 2) ** 2
            part = mpmath.ellipk(m) - mpmath.ellipf(mpmath.asin(half(high, angle)), m)
            return part * mpmath.sqrt(mpmath.mpf(length) / mpmath.mpf(G))

        high, pin = mpmath.mpf(START_ANGLE), mpmath.mpf(PIN_ANGLE)
        rise = mpmath.mpf(LONG_LENGTH) * (
            mpmath.cos(pin) - mpmath.cos(high)
        )  # of energy at the pin
        other = mpmath.acos(mpmath.cos(pin) - rise / mpmath.mpf(SHORT_LENGTH))
        on_long = passage(LONG_LENGTH, high, pin)
        on_short = 2 * passage(SHORT_LENGTH, other, -pin)
        parts = [on_long] + [on_short, 2 * on_long] * events
        return np.array([float(x) for x in np.cumsum(parts[:events])])


def rows() -> Iterator[Row]:
    times = reference(EVENTS)
    for method in METHODS:
        walk_result = method(SYSTEM, START, EVENTS, 10.0)
        for n in (1, 2, EVENTS):
            reference_n = float(times[n - 1])
            yield make_row(
                walk_result, f"time of event {n}", last_time(walk_result, n), reference_n, event=n
            )


def draw(figure: Figure, rows: list[dict[str, str]]) -> None:
    axes = figure.subplots()
    times = reference(EVENTS)
    for method, marker in zip(METHODS, "o^sD", strict=True):
        walk_result = method(SYSTEM, START, EVENTS, 10.0)
        n = len(walk_result.times)
        axes.semilogy(
            range(1, n + 1),
            np.abs(walk_result.times - times[:n]) + 1e-17,
            marker,
            label=walk_result.method,
        )
    axes.set_xlabel("event: on the pin, off the pin, ...")
    axes.set_ylabel("error of the event time [s]")
    axes.set_ylim(1e-19, 1e-10)
    axes.legend(loc="lower center", ncols=4)


CASE = Case(
    "Pendulum with a pin",
    "a sequence of modes, each begun on its own guard",
    "elliptic integrals",
    "ARGESIM benchmark C7, undamped; equation and jumps as sdynamix.com/pendulum.html gives them, "
    "lengths and angles from memory",
    rows,
    draw,
)
