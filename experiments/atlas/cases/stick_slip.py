"""A mass on a moving belt: sticking, slipping, and a multiplier of exactly zero.

Mass 1 on a spring of 1, belt at 0.2, static friction 1, kinetic 0.5. It sticks until the spring
pulls with 1, slips along a circle until its rate is the belt's again, after 2 pi - 2
arctan(0.5/0.2), and sticks for 2 (0.5)/0.2. Whatever the start, slipping begins at one state: the
multiplier is zero.
"""

import math
import time
from collections.abc import Iterator
from importlib.metadata import version

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure
from scipy.integrate import solve_ivp

import vrw_jax as vrw
from experiments.atlas.hybrid import METHODS, GuardEdge, MethodRun, Part, make_row, modes
from experiments.atlas.results import Case, Row, compute_error
from vrw_jax.hybrid import simulate_hybrid

BELT, STATIC, KINETIC = 0.2, 1.0, 0.5
DROP = STATIC - KINETIC
SLIP = 2.0 * math.pi - 2.0 * math.atan(DROP / BELT)
PERIOD = SLIP + 2.0 * DROP / BELT
STICKS = Part(
    lambda y, m: (BELT + 0.0 * y[0], 0.0 * y[1]),
    (GuardEdge(lambda y, m: STATIC - y[0], lambda y, m: (STATIC, BELT), 1),),
)
SLIPS = Part(
    lambda y, m: (y[1], KINETIC - y[0]),
    (GuardEdge(lambda y, m: BELT - y[1], lambda y, m: (y[0], BELT), 0),),
)
SYSTEM, START = (STICKS, SLIPS), (0.3, BELT)
EVENTS = 9


def period(walk_result: MethodRun) -> float:
    """Between the last two beginnings of slip."""
    return (
        float(walk_result.times[8] - walk_result.times[6])
        if len(walk_result.times) > 8
        else math.nan
    )


def integrate_regularized(width: float) -> tuple[float, int, float]:
    """Period, evaluations and seconds of SciPy on friction smoothed over `width`."""

    def field(t: float, y: np.ndarray) -> tuple:
        slip = (BELT - y[1]) / width
        level = KINETIC + (STATIC - KINETIC) * math.exp(-abs(slip) / 10.0)
        return y[1], level * math.tanh(slip) - y[0]

    up = lambda t, y: y[0] - KINETIC
    up.direction = 1.0  # type: ignore[attr-defined]
    began = time.process_time()
    result = solve_ivp(field, (0.0, 60.0), START, "Radau", events=up, rtol=1e-8, atol=1e-10)
    ends = result.t_events[0]
    took = time.process_time() - began
    return float(ends[-1] - ends[-2]), result.nfev, took


def rows() -> Iterator[Row]:
    for method in METHODS:
        walk_result = method(SYSTEM, START, EVENTS, 20.0)
        yield make_row(walk_result, "period", period(walk_result), PERIOD)
    solution, work, seconds = integrate_regularized(1e-3)
    yield Row(
        "period", "SciPy, "
            "smoothed", solution, PERIOD, compute_error(solution, PERIOD), "", False, work, seconds,
        "Radau 1e-8, tanh over 1e-3", version("scipy"),
    )  # fmt: skip
    options = vrw.StepOptions.tight()
    once = lambda x: simulate_hybrid(
        modes(SYSTEM), jnp.stack([x, BELT]), events=2, options=options
    ).state[0]
    result = float(jax.jit(jax.jacfwd(once))(0.3))
    mine = METHODS[0](SYSTEM, START, 2, 20.0)
    yield make_row(mine, "multiplier", result, 0.0)


def draw(figure: Figure, rows: list[dict[str, str]]) -> None:
    axes = figure.subplots()
    t = np.linspace(0.0, SLIP, 200)
    x = KINETIC + DROP * np.cos(t) + BELT * np.sin(t)
    v = -DROP * np.sin(t) + BELT * np.cos(t)
    axes.plot(x, v, label="slip")
    axes.plot([KINETIC - DROP, STATIC], [BELT, BELT], lw=2, label="stick")
    walk_result = METHODS[0](SYSTEM, START, EVENTS, 20.0)
    axes.plot(*walk_result.states.T, "k.", label="events found")
    axes.set_xlabel("position")
    axes.set_ylabel("rate")
    axes.legend()


CASE = Case(
    "Stick and slip",
    "a mode begins on its own guard; smoothing moves the period",
    "closed form; multiplier 0",
    "the textbook oscillator on a belt (Leine, van Campen); derived in the module",
    rows,
    draw,
)
