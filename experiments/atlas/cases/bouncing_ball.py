"""A bouncing ball: infinitely many bounces in a finite time.

The ball falls from 1 m and keeps r = 0.8 of its rate at each bounce. Bounces end at t = sqrt(2 h/g)
(1 + r)/(1 - r); the k-th is at sqrt(2 h/g) (1 + 2 (r + ... + r^(k-1))).
"""

import math
from collections.abc import Iterator

import numpy as np
from matplotlib.figure import Figure

from experiments.atlas.hybrid import METHODS, GuardEdge, Part, last_time, make_row
from experiments.atlas.others import make_rows
from experiments.atlas.results import Case, Row

G, R = 9.81, 0.8
FALL = math.sqrt(2.0 / G)
ACCUMULATION_TIME = FALL * (1.0 + R) / (1.0 - R)
EVENTS = 250
BALL = (
    Part(lambda y, m: (y[1], -G), (GuardEdge(lambda y, m: y[0], lambda y, m: (0.0, -R * y[1])),)),
)


def times(n: int) -> np.ndarray:
    """Return the times of the first n bounces, s."""
    return FALL * (1.0 + 2.0 * R * (1.0 - R ** np.arange(n)) / (1.0 - R))


def rows() -> Iterator[Row]:
    for method in METHODS:
        walk_result = method(BALL, (1.0, 0.0), EVENTS, 10.0)
        early = walk_result._replace(says="", admits=False)
        reference = float(times(20)[-1])
        yield make_row(early, "time of bounce 20", last_time(walk_result, 20), reference, event=20)
        end = float(walk_result.times[-1]) if len(walk_result.times) else math.nan
        result = walk_result._replace(
            says=walk_result.says or f"goes on: {len(walk_result.times)} bounces"
        )
        yield make_row(result, "time of the last bounce", end, ACCUMULATION_TIME)
    references = {
        "time of bounce 20": float(times(20)[-1]),
        "time of the last bounce": ACCUMULATION_TIME,
    }
    yield from make_rows("siconos", "bouncing_ball", references)


def draw(figure: Figure, rows: list[dict[str, str]]) -> None:
    axes = figure.subplots()
    reference = times(EVENTS)
    for method, marker in zip(METHODS, "o^sD", strict=True):
        walk_result = method(BALL, (1.0, 0.0), EVENTS, 10.0)
        n = len(walk_result.times)
        error = np.abs(walk_result.times - reference[:n]) + 1e-17
        axes.semilogy(np.arange(1, n + 1), error, marker, ms=3, label=f"{walk_result.method}: {n}")
    axes.set_xlabel("bounce")
    axes.set_ylabel("error of the event time [s]")
    axes.legend(title="bounces found")


CASE = Case(
    "Bouncing ball",
    "Zeno: events without end",
    "closed form, √(2h/g) (1 + r)/(1 − r)",
    "textbook; heyoka's tutorial on event detection",
    rows,
    draw,
)
