"""The rimless wheel of Drake's examples, with its defaults: eight spokes, length 1, slope 0.08.

From one spoke to the next it is a pendulum that falls over, then an impact keeps cos 2 alpha of the
rate: energy gives the gait, w^2 = 4 g sin(alpha) sin(slope) cos^2(2 alpha) / (1 - cos^2(2 alpha)),
its multiplier is cos^2(2 alpha) = 1/2, its period an integral. Drake's reset takes 2 alpha off an
angle just past its guard, which leaves its guard above zero.
"""

import math
from collections.abc import Iterator

import mpmath
import numpy as np
from matplotlib.figure import Figure

from experiments.atlas.gaits import ReturnMap, gaits
from experiments.atlas.hybrid import METHODS, GuardEdge, Part, make_row
from experiments.atlas.others import make_rows
from experiments.atlas.results import Case, Row

G, SLOPE, ALPHA = 9.81, 0.08, math.pi / 8
RATE_RATIO = math.cos(2.0 * ALPHA)
STEP = Part(
    lambda y, m: (y[1], G * m.sin(y[0])),
    (
        GuardEdge(
            lambda y, m: SLOPE + ALPHA - y[0],
            lambda y, m: (SLOPE - ALPHA + 0.0 * y[0], RATE_RATIO * y[1]),
        ),
    ),
)
WHEEL = ReturnMap(
    (STEP,), lambda x, m: (SLOPE - ALPHA, x[0]), lambda y: (y[1],), events=1, guess=(1.3,)
)
RATE = math.sqrt(
    4.0 * G * math.sin(ALPHA) * math.sin(SLOPE) * RATE_RATIO**2 / (1.0 - RATE_RATIO**2)
)


def period() -> float:
    """Return the period of the gait, which is the integral of an angle over its rate."""
    with mpmath.workdps(30):
        begin, end = mpmath.mpf(SLOPE) - mpmath.mpf(ALPHA), mpmath.mpf(SLOPE) + mpmath.mpf(ALPHA)
        rate = lambda a: mpmath.sqrt(
            mpmath.mpf(RATE) ** 2 + 2 * G * (mpmath.cos(begin) - mpmath.cos(a))
        )
        return float(mpmath.quad(lambda a: 1 / rate(a), mpmath.linspace(begin, end, 5)))


def rows() -> Iterator[Row]:
    for gait in gaits(WHEEL):
        yield make_row(gait.simulation, "rate after impact", float(gait.x[0]), RATE)
        yield make_row(gait.simulation, "period", gait.duration, period())
        yield make_row(gait.simulation, "multiplier", float(gait.jacobian[0, 0]), RATE_RATIO**2)
    references = {"rate after impact": RATE, "period": period(), "multiplier": RATE_RATIO**2}
    yield from make_rows("drake", "rimless_wheel", references)


def draw(figure: Figure, rows: list[dict[str, str]]) -> None:
    axes = figure.subplots()
    start = (SLOPE - ALPHA, 1.7)
    for method, marker in zip(METHODS, "o^sD", strict=True):
        walk_result = method((STEP,), start, 40, 20.0)
        rates = RATE_RATIO * walk_result.states[:, 1]
        gap = np.abs(rates - RATE) + 1e-17
        axes.semilogy(range(1, len(gap) + 1), gap, marker, ms=3, label=walk_result.method)
    steps = np.arange(1, 41)
    energy = RATE_RATIO ** (2 * steps) * (1.7**2 - RATE**2)
    axes.semilogy(
        steps, energy / (RATE + np.sqrt(RATE**2 + energy)), "k-", lw=0.7, label="closed form"
    )
    axes.set_xlabel("step")
    axes.set_ylabel("distance from the gait [rad/s]")
    axes.legend()


CASE = Case(
    "Rimless wheel",
    "a reset that puts the state on the next step's guard",
    "closed form",
    "Drake's example rimless_wheel (its defaults)",
    rows,
    draw,
)
