"""The compass gait of Goswami, Espiau and Keramane on a slope of 3 degrees.

Two legs of 1 m with 5 kg at their middle, 10 kg at the hip. Published just after impact: stance
0.2187, swing -0.3234 rad, rates -1.0918 and -0.3772 rad/s. The equations are derived in docstrings
below from energies and angular momenta; the reference beyond four digits is found in 40 digits by
many_digits.py.
"""

import math
from collections.abc import Iterator

import numpy as np
from matplotlib.figure import Figure
from scipy.integrate import solve_ivp

from experiments.atlas.gaits import ExactGait, ReturnMap, gaits
from experiments.atlas.hybrid import METHODS, GuardEdge, Part, make_row
from experiments.atlas.others import make_rows
from experiments.atlas.results import Case, Row

G, LEG, HALF, MASS, HIP = 9.8, 1.0, 0.5, 5.0, 10.0
SLOPE = math.radians(3.0)
PUBLISHED_STATE = (0.2187, -1.0918, -0.3772)  # stance angle, its rate, the swing leg's


def field(y, m):
    """Evaluate Lagrange's equations of two leg masses and a hip; angles are from the vertical."""
    stance, w, swing, v = y
    sin, cos = m.sin(stance - swing), m.cos(stance - swing)
    m11 = (HIP + MASS) * LEG**2 + MASS * HALF**2
    m22, m12 = MASS * HALF**2, -MASS * LEG * HALF * cos
    f1 = MASS * LEG * HALF * sin * v * v
    f1 = f1 + G * (MASS * HALF + (HIP + MASS) * LEG) * m.sin(stance)
    f2 = -MASS * LEG * HALF * sin * w * w - G * MASS * HALF * m.sin(swing)
    scale = 1.0 / (m11 * m22 - m12 * m12)
    return w, (m22 * f1 - m12 * f2) * scale, v, (m11 * f2 - m12 * f1) * scale


def impact(y, m):
    """Exchange the legs and conserve angular momentum about the new foot, and of the old leg about
    the hip.
    """
    stance, w, swing, v = y
    cos = m.cos(stance - swing)
    a11 = HIP * LEG**2 + MASS * HALF**2 + MASS * LEG**2 - MASS * LEG * HALF * cos
    a12 = MASS * HALF**2 - MASS * LEG * HALF * cos
    b1 = ((HIP * LEG**2 + 2.0 * MASS * HALF * LEG) * cos - MASS * HALF**2) * w - MASS * HALF**2 * v
    a21, a22, b2 = -LEG * cos, HALF, -HALF * w
    scale = 1.0 / (a11 * a22 - a12 * a21)
    return (
        swing, (a22 * b1 - a12 * b2) * scale, -2.0 * SLOPE - swing, (a11 * b2 - a21 * b1) * scale,
    )  # fmt: skip


def depth(y, m):
    """Return the depth of the swing foot below the ground, up to a positive factor."""
    return y[0] + y[2] + 2.0 * SLOPE


NAMES = ("stance angle", "its rate", "swing rate")
SYSTEM = (
    Part(
        field,
        (
            GuardEdge(
                lambda y, m: -depth(y, m), lambda y, m: (y[0], y[1], -2 * SLOPE - y[0], y[3]), 1
            ),
        ),
    ),
    Part(field, (GuardEdge(depth, impact, 0),)),
)
COMPASS = ReturnMap(
    SYSTEM,
    lambda x, m: (x[0], x[1], -2.0 * SLOPE - x[0], x[2]),
    lambda y: (y[0], y[1], y[3]),
    events=2,
    guess=PUBLISHED_STATE,
)


EXACT_GAIT = ExactGait(
    (0.21866880293899055, -1.0918266774895748, -0.37718155840327655),
    0.7347209621553588,
    (
        -0.19972612683003038 + 0.544476062094737j,
        -0.19972612683003038 - 0.544476062094737j,
        0.13157262407717674,
    ),
)


def rows() -> Iterator[Row]:
    for gait in gaits(COMPASS):
        for name, computed_coordinate, exact_coordinate, published_coordinate in zip(
            NAMES, gait.x, EXACT_GAIT.x, PUBLISHED_STATE, strict=True
        ):
            yield make_row(gait.simulation, name, float(computed_coordinate), exact_coordinate)
            yield make_row(
                gait.simulation,
                f"{name}, as published",
                float(computed_coordinate),
                published_coordinate,
                digits=4,
            )
        yield make_row(gait.simulation, "period", gait.duration, EXACT_GAIT.period)
        radius = abs(EXACT_GAIT.multipliers[0])
        yield make_row(
            gait.simulation, "spectral radius", float(np.abs(gait.multipliers[0])), radius
        )
    references = {"stance angle": EXACT_GAIT.x[0], "period": EXACT_GAIT.period}
    yield from make_rows("drake", "compass_gait", references)


def draw(figure: Figure, rows: list[dict[str, str]]) -> None:
    axes = figure.subplots()
    step = METHODS[0](SYSTEM, COMPASS.begin(PUBLISHED_STATE, math), 2, 20.0)
    begin = COMPASS.begin(PUBLISHED_STATE, math)
    for leg, style in ((0, "-"), (2, "--")):
        result = solve_ivp(
            lambda t, y: field(y, math), (0.0, float(step.times[1])), begin,
            rtol=1e-8, atol=1e-8, max_step=0.01,
        )  # fmt: skip
        name = "stance leg" if leg == 0 else "swing leg"
        axes.plot(result.y[leg], result.y[leg + 1], style, label=name)
    axes.plot(
        [PUBLISHED_STATE[0], -2 * SLOPE - PUBLISHED_STATE[0]],
        PUBLISHED_STATE[1:],
        "ko",
        label="published",
    )
    axes.set_xlabel("angle from the vertical [rad]")
    axes.set_ylabel("angular velocity [rad/s]")
    axes.legend()


CASE = Case(
    "Compass gait",
    "scuffing let through; an impact that exchanges legs",
    "published to 4 digits; beyond in 40 digits, own",
    "Goswami, Espiau, Keramane, Autonomous Robots 4 (1997); Drake's example compass_gait",
    rows,
    draw,
)
