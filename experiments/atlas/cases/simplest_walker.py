"""Garcia's simplest walker at slope 0.009: a swing foot that scuffs and is let through.

theta'' = sin(theta - slope); phi'' = theta'' + theta'^2 sin phi - cos(theta - slope) sin phi. The
foot's height passes zero at mid-stance, where the model ignores it, and at heelstrike, where theta
changes its sign and rates follow from impulse laws. Published: both gaits at 0.009 to 15 digits
(Garcia, Chatterjee, Ruina, Coleman 1998; eigenvalues again in Bhounsule 2014). `many_digits.py`
computes the reference in 40 digits: 13 digits of the published gait and 6 of its eigenvalues hold.
"""

import math
from collections.abc import Iterator

import numpy as np
from matplotlib.figure import Figure

from experiments.atlas.gaits import ExactGait, ReturnMap, gaits
from experiments.atlas.hybrid import METHODS, GuardEdge, Part, make_row
from experiments.atlas.results import Case, Row

SLOPE = 0.009
LONG_PERIOD_GAIT = (0.200310900544287, -0.199832473004977)
PAIR = (-0.190099639402167, 0.557599274284362)  # real and imaginary part of the multipliers


def field(y, m):
    theta, rate, phi, swing = y
    fall = m.sin(theta - SLOPE)
    return rate, fall, swing, fall + (rate * rate - m.cos(theta - SLOPE)) * m.sin(phi)


def heelstrike(y, m):
    theta, rate = y[0], y[1]
    retained_share = m.cos(2.0 * theta)
    return (
        -theta,
        retained_share * rate,
        -2.0 * theta,
        retained_share * (1.0 - retained_share) * rate,
    )


def height(y, m):
    """Return the height of the swing foot up to a positive factor; it is zero just after
    heelstrike.
    """
    return y[2] - 2.0 * y[0]


SYSTEM = (
    Part(field, (GuardEdge(height, lambda y, m: (y[0], y[1], 2.0 * y[0], y[3]), 1),)),
    Part(field, (GuardEdge(lambda y, m: -height(y, m), heelstrike, 0),)),
)


def begin(x, m):
    retained_share = (m if hasattr(m, "cos") else math).cos(2.0 * x[0])
    return x[0], x[1], 2.0 * x[0], x[1] * (1.0 - retained_share)


WALKER = ReturnMap(SYSTEM, begin, lambda y: (y[0], y[1]), events=2, guess=(0.2, -0.2))


EXACT_GAIT = ExactGait(
    (0.20031090054424708, -0.19983247300495235),
    3.882463752851374,
    (-0.1900998410658881 + 0.5575987766820683j, -0.1900998410658881 - 0.5575987766820683j),
)


def rows() -> Iterator[Row]:
    reference = EXACT_GAIT.multipliers[0]
    for gait in gaits(WALKER):
        walk_result, first = gait.simulation, gait.multipliers[0]
        parts = (
            ("real", first.real, reference.real),
            ("imaginary", abs(first.imag), reference.imag),
        )
        for name, computed_value, exact_value, published_value in zip(
            ("stance angle", "its rate"), gait.x, EXACT_GAIT.x, LONG_PERIOD_GAIT, strict=True
        ):
            yield make_row(walk_result, name, float(computed_value), exact_value)
            yield make_row(
                walk_result,
                f"{name}, as published",
                float(computed_value),
                published_value,
                digits=13,
            )
        yield make_row(walk_result, "period", gait.duration, EXACT_GAIT.period)
        for (name, computed_value, exact_value), published_value in zip(parts, PAIR, strict=True):
            name = f"multipliers, {name} part"
            yield make_row(walk_result, name, float(computed_value), exact_value)
            yield make_row(
                walk_result,
                f"{name}, as published",
                float(computed_value),
                published_value,
                digits=6,
            )


def draw(figure: Figure, rows: list[dict[str, str]]) -> None:
    axes = figure.subplots()
    for method, marker in zip(METHODS, "o^sD", strict=True):
        x = np.array(LONG_PERIOD_GAIT) * 1.01
        gaps = []
        for _ in range(25):
            walk_result = method(SYSTEM, begin(x, math), 2, 20.0)
            if len(walk_result.times) < 2:
                break
            x = walk_result.end[:2]
            gaps.append(float(np.hypot(*(x - LONG_PERIOD_GAIT))) + 1e-17)
        axes.semilogy(range(1, len(gaps) + 1), gaps, marker, ms=3, label=walk_result.method)
    steps = np.arange(1, 26)
    axes.semilogy(steps, 3e-3 * np.hypot(*PAIR) ** steps, "k-", lw=0.7, label="|multiplier|ⁿ")
    axes.set_xlabel("step")
    axes.set_ylabel("distance from the published gait")
    axes.legend()


CASE = Case(
    "Simplest walker",
    "each mode begins on its own guard; the foot grazes the ground",
    "published, 13 and 6 digits hold; beyond in 40 digits, own",
    "Garcia et al., J. Biomech. Eng. 120 (1998); Bhounsule, DCDIS B 21 (2014)",
    rows,
    draw,
)
