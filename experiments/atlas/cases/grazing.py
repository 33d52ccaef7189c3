"""An impact oscillator at grazing: a square root in every map, on which Newton's method fails.

x'' + x = F cos(w t) with a stop at x = 1 that gives back r = 0.8 of the rate. Without impact the
motion is -c cos(w t). With c = 1 + d it reaches the stop at (pi - arccos(1/c))/w with the rate w
sqrt(c^2 - 1): a stop touched by d costs the map (1 + r) sqrt(2 a d), a = w^2, which is Nordmark's
coefficient, and its derivative grows as 1/sqrt(d). The motion with one impact each period is closed
too; its disturbances' area shrinks by r^2 each time, the product of its multipliers.
"""

import math
from collections.abc import Iterator
from importlib.metadata import version

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import vrw_jax as vrw
from experiments.atlas.gaits import ReturnMap, find_by_differences, find_by_newton, gaits
from experiments.atlas.hybrid import (
    METHODS,
    GuardEdge,
    Part,
    last_time,
    make_row,
    modes,
    run_library,
)
from experiments.atlas.results import Case, Row, compute_error, time_second_call
from vrw_jax.hybrid import simulate_hybrid

RESTITUTION_COEFFICIENT = 0.8


def make_stopped_oscillator(w: float) -> tuple[Part, ...]:
    """State: x, rate, clock, c."""
    force = 1.0 - w * w  # over -c: the particular motion is -c cos(w t)
    field = lambda y, m: (
        y[1],
        -force * y[3] * m.cos(w * y[2]) - y[0],
        1.0 + 0.0 * y[0],
        0.0 * y[0],
    )
    stop = GuardEdge(
        lambda y, m: 1.0 - y[0],
        lambda y, m: (1.0 + 0.0 * y[0], -RESTITUTION_COEFFICIENT * y[1], y[2], y[3]),
    )
    return (Part(field, (stop,)),)


def compute_touch_time(w: float, depth: float) -> float:
    """Time of the first touch from x = -c at rest; arccos(1/c) without cancellation."""
    return (math.pi - math.atan(math.sqrt(depth * (2.0 + depth)))) / w


def compute_repeating_motion(w: float, depth: float) -> tuple[float, float]:
    """Motion with one impact each period: the clock at impact, and the rate after it.

    From x = A cos t + B sin t - c cos(w t + p) with x(0) = x(T) = 1 and v(0) = -r v(T).
    """
    c, period = -(1.0 + depth), 2.0 * math.pi / w
    cot, ratio = (
        1.0 / math.tan(period / 2.0),
        (1.0 - RESTITUTION_COEFFICIENT) / (1.0 + RESTITUTION_COEFFICIENT),
    )
    a, b, e = cot**2 + (ratio / w) ** 2, -2.0 * cot, 1.0 - c * c
    roots = [(-b + sign * math.sqrt(b * b - 4.0 * a * e)) / (2.0 * a) for sign in (1.0, -1.0)]
    B = min(roots)  # it must push into the stop: B < 0
    phase = math.atan2(B * ratio / w / c, (1.0 - B * cot) / c)
    return (phase / w) % period, RESTITUTION_COEFFICIENT * 2.0 * B / (1.0 + RESTITUTION_COEFFICIENT)


W, DEPTH = 2.6, 0.05
GRAZING_DEPTH = 1e-6
"""By how much the stop is touched."""
NORDMARK = (1.0 + RESTITUTION_COEFFICIENT) * math.sqrt(1.0 + 0.5 * GRAZING_DEPTH)
"""1 + r, the coefficient of the map's square root over sqrt(2 a), where the touch is shallow."""


def compute_impact_derivative(w: float, depth: float) -> ReturnMap:
    """From just after one impact to just after the next: clock and rate."""
    c, period = 1.0 + depth, 2.0 * math.pi / w
    system = make_stopped_oscillator(w)
    clock, rate = compute_repeating_motion(w, depth)
    return ReturnMap(
        system,
        lambda x, m: (1.0 + 0.0 * x[0], x[1], x[0], c + 0.0 * x[0]),
        lambda y: (y[2] - period, y[1]),
        events=1,
        guess=(clock + 1e-3, rate * 1.01),
    )


def derivative() -> Iterator[Row]:
    """Return the derivative of the touching time by the depth, which grows as 1/sqrt(depth)."""
    c = 1.0 + GRAZING_DEPTH
    reference = -1.0 / (W * c * math.sqrt(c * c - 1.0))
    parts, options = modes(make_stopped_oscillator(W)), vrw.StepOptions.tight()
    start = lambda c: jnp.stack([-c, 0.0 * c, 0.0 * c, c])
    slope = jax.jit(
        jax.jacfwd(lambda c: simulate_hybrid(parts, start(c), events=1, options=options).times[0])
    )
    solution, seconds = time_second_call(lambda: float(slope(c)))
    yield Row(
        "derivative of that "
            "time", "ours", solution, reference, compute_error(solution, reference,
            relative=True), "",
        False, 1, seconds, "Dopri8 1e-13", version("vrw-jax"), 0.5 / GRAZING_DEPTH,
    )  # fmt: skip
    h = 1e-8
    for method in METHODS[1:]:
        ends = [
            method(make_stopped_oscillator(W), (-(c + s), 0.0, 0.0, c + s), 1, 20.0)
            for s in (h, -h)
        ]
        solution = (last_time(ends[0], 1) - last_time(ends[1], 1)) / (2.0 * h)
        walk_result = ends[0]._replace(method=f"{ends[0].method}, differences")
        yield make_row(
            walk_result,
            "derivative of that time",
            solution,
            reference,
            relative=True,
            condition=0.5 / GRAZING_DEPTH,
        )


def rows() -> Iterator[Row]:
    for method in METHODS:
        walk_result = method(
            make_stopped_oscillator(W),
            (-(1.0 + GRAZING_DEPTH), 0.0, 0.0, 1.0 + GRAZING_DEPTH),
            1,
            20.0,
        )
        solution = last_time(walk_result, 1)
        yield make_row(
            walk_result, "time of touching by 1e-6", solution, compute_touch_time(W, GRAZING_DEPTH),
            condition=1.0 / (W * math.sqrt(2.0 * GRAZING_DEPTH)),
        )  # fmt: skip
        last = walk_result.states[-1][1] if len(walk_result.times) else math.nan
        jump = walk_result.end[1] - last  # of the rate; over the square root of twice a = w^2 and d
        yield make_row(
            walk_result, "jump over √(2 a "
                "d)", -jump / (W * math.sqrt(2.0 * GRAZING_DEPTH)), NORDMARK,
            condition=0.5 / GRAZING_DEPTH,
        )  # fmt: skip
    fine = run_library(
        make_stopped_oscillator(W),
        (-(1.0 + GRAZING_DEPTH), 0.0, 0.0, 1.0 + GRAZING_DEPTH),
        1,
        20.0,
        tolerance=1e-15,
    )
    fine = fine._replace(method="ours, 1e-15")
    yield make_row(
        fine, "time of touching by 1e-6", last_time(fine, 1), compute_touch_time(W, GRAZING_DEPTH),
        condition=1.0 / (W * math.sqrt(2.0 * GRAZING_DEPTH)),
    )  # fmt: skip
    yield from derivative()
    _, rate = compute_repeating_motion(W, DEPTH)
    for gait in gaits(compute_impact_derivative(W, DEPTH)):
        yield make_row(gait.simulation, "rate after impact", float(gait.x[1]), rate)
        yield make_row(
            gait.simulation, "product of multipliers", gait.product, RESTITUTION_COEFFICIENT**2
        )
    graze = compute_impact_derivative(W, 1e-9)._replace(guess=(math.pi / W, -1e-4))
    reference = compute_repeating_motion(W, 1e-9)[1]
    for gait in (find_by_newton(graze), find_by_differences(METHODS[3], graze)):
        solution = float(gait.x[1])
        yield make_row(gait.simulation, "rate, Newton from the graze", solution, reference)


def draw(figure: Figure, rows: list[dict[str, str]]) -> None:
    axes = figure.subplots()
    depths = 10.0 ** -np.arange(1.0, 14.0)
    for k, (method, marker) in enumerate(zip(METHODS, "o^sD", strict=True)):
        errors = []
        for depth in depths:
            walk_result = method(
                make_stopped_oscillator(W), (-(1.0 + depth), 0.0, 0.0, 1.0 + depth), 1, 4.0
            )
            errors.append(abs(last_time(walk_result, 1) - compute_touch_time(W, depth)) + 1e-17)
        missed = np.array([not error < 0.5 for error in errors])
        solution = np.array(errors)[~missed]
        line = axes.loglog(depths[~missed], solution, marker + "-", ms=4, label=walk_result.method)
        axes.loglog(depths[missed], np.full(missed.sum(), 30.0**k), "x", color=line[0].get_color())
    axes.loglog(depths, 1e-16 / (W * np.sqrt(2.0 * depths)), "k-", lw=0.7, label="rounding")
    axes.set_xlabel("depth of touching")
    axes.set_ylabel("error of the event time (×: missed)")
    axes.legend(loc="center right", bbox_to_anchor=(1.0, 0.6))


CASE = Case(
    "Impact oscillator at grazing",
    "a square root: derivatives without bound, Newton on the map",
    "closed form; Nordmark's coefficient",
    "Nordmark, J. Sound Vib. 145 (1991); derived in the module",
    rows,
    draw,
)
