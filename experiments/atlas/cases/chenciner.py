"""Steinmetz and Larter's reaction near a Chenciner point: a cycle whose pair is on the circle.

Published (MatCont's manual, 2012): at k7 = 1.5163129, k8 = 0.83200664 a pair of multipliers has
modulus 1, and the cycle passes through `PUBLISHED`; so at `FIRST`. BifurcationKit's pages tell k8
at k7 = 1.5, where the pair's exponent reaches their `tol_stability`. On that curve of such points
lies the Chenciner point, where the return map's cubic coefficient vanishes too: its k7 is told as
1.752 by the author of BifurcationKit (issue 222), 1.7465 to 1.7475 by its pages, and 1.855 there by
collocation; it is found here from two sections. A walk neither settles nor leaves, so that only
Newton's method finds the cycle. Along any cycle one multiplier is 1, and the product of all is the
exponential of the divergence's integral.
"""

import math
import time
from collections.abc import Callable, Iterator
from importlib.metadata import version

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure
from scipy.optimize import brentq

import vrw_jax as vrw
from experiments.atlas.chenciner_point import Point, chenciner_point
from experiments.atlas.gaits import ReturnMap, gaits
from experiments.atlas.hybrid import JAX, METHODS, GuardEdge, Part, make_row
from experiments.atlas.results import Case, Row, compute_error, time_second_call
from vrw_jax.continuation import solve_fixed_point
from vrw_jax.hybrid import Guard, Mode, product_multipliers, segment_maps, simulate_hybrid

K1, K2, K3, K4, K5, K6, K9 = 0.1631021, 1250.0, 0.046875, 20.0, 1.104, 0.001, 0.1175
K7, K8 = 1.5163129, 0.83200664
LEVEL = 9.1855407
PUBLISHED_CYCLE = (6.1231735, 5.4271408e-3, 2.4602951e-2)  # of A, X, Y where B rises through LEVEL
SEGMENTS = 600
PUBLISHED_CHENCINER_POINT, NEARBY_CYCLE = (1.752, 0.9113), (9.2149, 1.9652e-3, 2.4941e-3)
"""The Chenciner point's k7 as told and k8 on the curve there, and A, X, Y on the cycle."""
OTHER_LEVEL = 11.0
FIRST_K, FIRST_LEVEL = (0.71643356, 0.5), 25.678306
MANUAL_FIRST_POINT = (1.8609653, 1.0838258e-2, 9.4707061e-2)
"""The manual's first point: k7 and k8, B, and A, X, Y on the cycle."""
AT_K7, STABLE, PAGES_K8 = 1.5, 1e-3, 0.82521357
"""BifurcationKit's point: k7, the exponent that it takes for zero, and k8 by its page of 0.3.2."""


def field(y, m, k7=K7, k8=K8):
    A, B, X, Y = y
    first, third, second = K1 * A * B * X, K3 * A * B * Y, 2.0 * K2 * X * X
    return (
        k7 - K9 * A - first - third,
        k8 - first - third,
        first - second + 2.0 * third - K4 * X + K6,
        second - third - K5 * Y,
    )


SYSTEM = (
    Part(field, (GuardEdge(lambda y, m: y[1] - LEVEL, lambda y, m: (y[0], LEVEL, y[2], y[3]), 1),)),
    Part(field, (GuardEdge(lambda y, m: LEVEL - y[1], lambda y, m: (y[0], LEVEL, y[2], y[3]), 0),)),
)
CYCLE = ReturnMap(
    SYSTEM,
    lambda x, m: (x[0], LEVEL + 0.0 * x[0], x[1], x[2]),
    lambda y: (y[0], y[2], y[3]),
    events=2,
    guess=PUBLISHED_CYCLE,
    limit=60.0,
)


def modes(k: jnp.ndarray, level: float) -> tuple[Mode, Mode]:
    """B rises through a level, and falls through it."""
    flow = lambda y: jnp.stack(field(y, JAX, k[0], k[1]))
    onto = lambda y: jnp.stack([y[0], level + 0.0 * y[1], y[2], y[3]])
    return (
        Mode(flow, (Guard(lambda y: y[1] - level, onto, 1),)),
        Mode(flow, (Guard(lambda y: level - y[1], onto, 0),)),
    )


def simulate_long_run() -> vrw.StepOptions:
    return vrw.StepOptions(rtol=1e-13, atol=1e-13, max_phase_time=60.0)


def make_return_map(level: float) -> Callable:
    """From where B rises through a level to where it does next, (A, X, Y) by (k7, k8)."""

    def there(x, k):
        start = jnp.stack([x[0], level + 0.0 * x[0], x[1], x[2]])
        return simulate_hybrid(modes(k, level), start, events=2, options=simulate_long_run()).state[
            jnp.array([0, 2, 3])
        ]

    return there


def find_cycle_on_level(level: float) -> tuple[Point, float]:
    """Return the Chenciner point by the section at a level, and CPU seconds including
    compilation.
    """
    k, begin = (
        jnp.array(PUBLISHED_CHENCINER_POINT),
        jnp.array([NEARBY_CYCLE[0], LEVEL, *NEARBY_CYCLE[1:]]),
    )
    began = time.process_time()
    if level > LEVEL:
        rising = (Guard(lambda y: level - y[1]),)
        begin = simulate_hybrid(
            [modes(k, level)[0]._replace(guards=rising)],
            begin,
            events=1,
            options=simulate_long_run(),
        )
        begin = begin.state
    point = chenciner_point(make_return_map(level), np.asarray(begin)[[0, 2, 3]], np.asarray(k))
    return point, time.process_time() - began


@jax.jit
def cycle_at(x, k, level):
    return solve_fixed_point(lambda x: make_return_map(level)(x, k), x, tolerance=1e-11)


def torus_points() -> Iterator[Row]:
    """Yield two more published points with a pair of multipliers on the unit circle."""
    largest = lambda cycle: float(np.abs(np.linalg.eigvals(cycle.jacobian)).max())
    options = "Dopri8 1e-13; Newton 1e-11"
    first, seconds = time_second_call(
        lambda: jax.block_until_ready(
            cycle_at(jnp.array(MANUAL_FIRST_POINT), jnp.array(FIRST_K), FIRST_LEVEL)
        )
    )
    x, guess = float(first.x[0]), jnp.array(PUBLISHED_CYCLE)
    began = time.process_time()
    guess = cycle_at(guess, jnp.array([AT_K7, PAGES_K8]), LEVEL).x
    exponent = lambda k8: math.log(largest(cycle_at(guess, jnp.array([AT_K7, k8]), LEVEL)))
    k8 = brentq(lambda k8: exponent(k8) - STABLE, PAGES_K8 - 1e-4, PAGES_K8 + 1e-4, xtol=1e-12)
    for name, solution, reference, digits, took in (
        ("modulus at the first point, as published", largest(first), 1.0, 6, seconds),
        ("A at the first point, as published", x, MANUAL_FIRST_POINT[0], 6, seconds),
        ("k8 of exponent 1e-3, as published", k8, PAGES_K8, 8, time.process_time() - began),
    ):
        yield Row(
            name, "ours", solution, reference, compute_error(solution, reference), "",
            not bool(first.converged),
            int(first.n_iterations), took, options, version("vrw-jax"), digits=digits,
        )  # fmt: skip


def rows() -> Iterator[Row]:
    result = gaits(CYCLE)
    other = result[-1]
    for gait in result:
        modulus = float(np.abs(gait.multipliers[0]))
        yield make_row(gait.simulation, "modulus of the pair, as published", modulus, 1.0, digits=5)
        yield make_row(
            gait.simulation, "A, as published", float(gait.x[0]), PUBLISHED_CYCLE[0], digits=6
        )
        if gait is not other:
            yield make_row(gait.simulation, "period, as heyoka's", gait.duration, other.duration)
    start = jnp.array(CYCLE.begin(result[0].x, np), float)

    def whole():
        cut = segment_maps(
            lambda y: jnp.stack(field(y, JAX)), start, result[0].duration, SEGMENTS,
            vrw.StepOptions.tight(),
        )  # fmt: skip
        return product_multipliers(cut.jacobians), float(cut.divergence)

    (solution, divergence), seconds = time_second_call(whole)
    trivial = float(solution.values[np.nanargmin(np.abs(solution.values - 1.0))].real)
    sums = float(np.sum(solution.logarithms))
    for name, value, reference in (
        ("trivial multiplier", trivial, 1.0),
        ("logarithm of their product", sums, divergence),
    ):
        yield Row(
            name, "ours", value, reference, compute_error(value, reference, relative=True), "",
            False,
            SEGMENTS,
            seconds, f"Dopri8 1e-13, {SEGMENTS} segments", version("vrw-jax"),
        )  # fmt: skip

    yield from torus_points()
    (point, seconds), (other, _) = find_cycle_on_level(LEVEL), find_cycle_on_level(OTHER_LEVEL)
    for name, value, reference in zip(
        ("k7", "k8"), point.parameters, other.parameters, strict=True
    ):
        yield Row(
            f"{name} of the Chenciner point, by another section", "ours", value, reference,
            compute_error(value, reference), "", False, 1, seconds,
            "Dopri8 1e-13, three derivatives, compiling counted", version("vrw-jax"),
        )  # fmt: skip


def draw(figure: Figure, rows: list[dict[str, str]]) -> None:
    axes = figure.subplots()
    walk_result = METHODS[3](
        SYSTEM, CYCLE.begin(np.array(PUBLISHED_CYCLE) * (1.01, 1.0, 1.0), np), 400, 60.0
    )
    rising = walk_result.states[1::2]
    axes.plot(rising[:, 0], rising[:, 2], ".-", ms=3, lw=0.3, label="returns of a walk")
    cycle = gaits(CYCLE._replace(limit=60.0))[0].x
    axes.plot(cycle[0], cycle[1], "*", color="C1", ms=9, label="the cycle, by Newton")
    axes.set_xlabel("A")
    axes.set_ylabel("X")
    axes.legend()


CASE = Case(
    "Near a Chenciner point",
    "a cycle that no simulation reaches; its pair of multipliers on the circle",
    "published point and state; trivial multiplier 1; Liouville",
    "MatCont's manual (2012), its second point for this reaction, as its users quote it; constants "
    "as in the tutorials of BifurcationKit and COCO; De Witte et al., Physica D 267 (2013)",
    rows,
    draw,
)
