"""Grazing in resonance: forced at twice its own frequency, impacts grow as a square root.

Away from resonance the motion with one impact each period hits the stop at a rate proportional to
the depth d by which the stop stands in its way; where w = 2, half a period of its own is one of the
force, the linear term vanishes (Nordmark's n : 2 resonances), and the rate is
2 w sqrt(c^2 - 1)/(1 - r), c = 1 + d: a jump of infinite slope out of the graze.
"""

import math
from collections.abc import Iterator

import numpy as np
from matplotlib.figure import Figure

from experiments.atlas.cases.grazing import (
    RESTITUTION_COEFFICIENT,
    compute_impact_derivative,
    compute_repeating_motion,
)
from experiments.atlas.gaits import gaits
from experiments.atlas.hybrid import make_row
from experiments.atlas.results import Case, Row

W, DEPTHS = 2.0, (1e-2, 1e-6)


def rate(depth: float) -> float:
    """After the impact, in resonance."""
    c = 1.0 + depth
    return (
        -RESTITUTION_COEFFICIENT
        * 2.0
        * W
        * math.sqrt(c * c - 1.0)
        / (1.0 - RESTITUTION_COEFFICIENT)
    )


def resonant(depth: float):
    result = compute_impact_derivative(W, depth)
    c = 1.0 + depth
    phase = math.atan2(-math.sqrt(c * c - 1.0) / -c, 1.0 / -c)
    clock = (phase / W) % (2.0 * math.pi / W)
    return result._replace(guess=(clock * (1.0 + 1e-4), rate(depth) * 1.001))


def rows() -> Iterator[Row]:
    for depth in DEPTHS:
        for gait in gaits(resonant(depth)):
            name = f"rate after impact, depth {depth:g}"
            steep = abs(rate(depth)) / (2.0 * depth)  # of the rate over the depth
            yield make_row(gait.simulation, name, float(gait.x[1]), rate(depth), condition=steep)
            name = f"product of multipliers, {depth:g}"
            yield make_row(
                gait.simulation, name, gait.product, RESTITUTION_COEFFICIENT**2, condition=steep
            )


def draw(figure: Figure, rows: list[dict[str, str]]) -> None:
    axes = figure.subplots()
    depths = np.geomspace(1e-6, 0.1, 40)
    for w in (2.6, 2.2, 2.02):
        rates = [-compute_repeating_motion(w, d)[1] for d in depths]
        axes.loglog(depths, rates, label=f"$w = {w}$")
    axes.loglog(depths, [-rate(d) for d in depths], "k-", label="$w = 2$, resonance")
    solution = {(r["quantity"], r["found"]) for r in rows if r["method"] == "ours"}
    for depth in DEPTHS:
        for quantity, value in solution:
            if quantity == f"rate after impact, depth {depth:g}":
                axes.loglog(depth, -float(value), "o", color="k")
    axes.set_xlabel("depth of grazing")
    axes.set_ylabel("rate after impact")
    axes.legend()


CASE = Case(
    "Grazing in resonance",
    "the branch leaves the graze with infinite slope",
    "closed form",
    "Nordmark's resonances; derived in the module",
    rows,
    draw,
)
