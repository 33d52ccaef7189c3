"""One explicit Runge-Kutta step for a batch, with separate arrays per component.

The equations of motion are of second order, q'' = f(q, q'), so a step stores only the accelerations
of its stages. Positions use the square of the tableau's matrix, rates the matrix. The method is the
same, with half of the stored derivatives. The tableaus are those of diffrax.
"""

import functools
import itertools
import json
import math
import operator
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from vrw_jax.numerics.lanes import if_any
from vrw_jax.numerics.types import Vector


class Tableau(NamedTuple):
    """An explicit method whose last stage is the step's end and the first stage of the
    next step.
    """

    order: int
    places: np.ndarray  # Butcher's c: of the stages, in step lengths
    once: np.ndarray  # Butcher's A: from accelerations to rates
    twice: np.ndarray  # A squared: from accelerations to positions
    error_once: np.ndarray
    error_twice: np.ndarray
    middle: int
    """Index of a stage well inside the step, at which the parabolas through guards are fitted."""
    inside: tuple[int, ...]
    """Stages separated from each other and from both ends, at which guards are sampled to find
    dips."""
    hull: np.ndarray
    """Matrix from guard values to the inner Bernstein coefficients of the polynomial through them,
    which does not fall below its least coefficient. The values are those at the start, at
    `guard_stages` and at the end."""

    def __eq__(self, other: object) -> bool:
        return self is other  # `load_explicit_tableau` creates each tableau once

    def __hash__(self) -> int:
        return id(self)


@functools.cache
def explicit_tableau(name: str) -> Tableau | None:
    """Return diffrax's tableau of that name; None if the method is not explicit Runge-Kutta.

    The numbers are stored beside this file, because loading diffrax takes a fifth of a cached
    start.
    """
    known = json.loads(Path(__file__).with_name("tableaus.json").read_text(encoding="utf-8"))
    if name not in known:
        return None
    given = known[name]
    n, ends_there = len(given["b_sol"]), given["ssal"]
    once = np.zeros((n + (not ends_there), n + (not ends_there)))
    for i, row in enumerate(given["a_lower"]):
        once[i + 1, : i + 1] = row
    error = np.zeros(len(once))
    error[:n] = given["b_error"]
    if not ends_there:
        once[n, :n] = given["b_sol"]
    places = once.sum(axis=1)
    inside = _apart(places)
    return Tableau(
        order=given["order"],
        places=places,
        once=once,
        twice=_without_rounding(once @ once),
        error_once=error,
        error_twice=_without_rounding(error @ once),
        middle=min(inside, key=lambda i: abs(places[i] - 0.45), default=0),
        inside=inside,
        hull=_hull(np.array([0.0, *places[list(inside)], 1.0])),
    )


INSIDE = (0.15, 0.47, 0.92)
"""Approximate nodes at which guards are sampled inside a step.

They are chosen nearer to the ends than equally spaced nodes, because a dip just after the start or
before the end is the hardest to detect.
"""


def _apart(places: np.ndarray) -> tuple[int, ...]:
    """Return the stages nearest to GUARD_STAGE_NODES; of several at one node the last, most
    accurate.
    """
    last = {round(float(place), 3): i for i, place in enumerate(places) if 0.05 < place < 0.95}
    nearest = {min((abs(place - at), place) for place in last)[1] for at in INSIDE if last}
    return tuple(last[place] for place in sorted(nearest))


def _hull(nodes: np.ndarray) -> np.ndarray:
    """Return the matrix of inner Bernstein coefficients for values at nodes of [0, 1]."""
    n = len(nodes) - 1
    basis = [math.comb(n, i) * nodes**i * (1.0 - nodes) ** (n - i) for i in range(n + 1)]
    return np.linalg.inv(np.stack(basis, 1))[1:-1]


def parabola(tableau: Tableau, start: Array, inside: Array, end: Array) -> tuple[Array, Array]:
    """Return curvature and rate, in step lengths, of the parabola through a guard's values.

    `middle_value` is the guard at the stage `middle_stage`.
    """
    place = float(tableau.places[tableau.middle])
    bend = (end - start - (inside - start) / place) / (1.0 - place)
    return bend, end - start - bend


def _bernstein(tableau: Tableau, values: list[Array]) -> list[Array]:
    """Return a guard's Bernstein coefficients except the last: if all are positive, so is the
    guard.

    `values` are those at the start, at the `guard_stages`, and at the end.
    """
    return [values[0], *(_weigh(row, values) for row in tableau.hull)]


@functools.partial(jax.jit, static_argnums=0)  # traced once, for whichever guard
def _may_dip(tableau: Tableau, values: list[Array]) -> Array:
    """Return whether a guard may fall below zero inside a step and be positive again at its end."""
    return (functools.reduce(jnp.minimum, _bernstein(tableau, values)) <= 0.0) & (values[-1] > 0.0)


@functools.partial(jax.jit, static_argnums=0)  # traced once, for whichever guard
def below(tableau: Tableau, values: list[Array]) -> tuple[Array, Array]:
    """Return whether a guard may dip and rises somewhere, and the fraction of the step to try
    first.

    A guard that only decays is no dip, however steep. The fraction is the node of the lowest
    Bernstein coefficient. `values`: at the start, at the `guard_stages`, at the end.
    """
    lowest, *inner = _bernstein(tableau, values)
    at = jnp.zeros_like(lowest)
    for i, coefficient in enumerate(inner):
        at = jnp.where(coefficient < lowest, (i + 1) / len(values[1:]), at)
        lowest = jnp.minimum(coefficient, lowest)
    rises = inner[-1] < values[-1]
    for before, after in itertools.pairwise(values):
        rises = rises | (before < after)
    return (lowest <= 0.0) & (at > 0.0) & rises & (values[-1] > 0.0), at


def to_earliest_dip(tableau: Tableau, guards: list[Vector]) -> Array:
    """Return the fraction of the step before a guard that may dip below zero in it; 1 if there is
    none.

    `guard_values`: at the start, at the `guard_stages` and at the end. The dip is located only if
    some batch element of the group may have one.
    """
    columns = [list(values) for values in zip(*guards, strict=True)]
    may = functools.reduce(operator.or_, (_may_dip(tableau, values) for values in columns))

    def to_first(share: Array) -> Array:
        for values in columns:
            looks, at = below(tableau, values)
            share = jnp.where(looks, jnp.minimum(share, at), share)
        return share

    none = jnp.ones_like(guards[0][0])
    return if_any(jnp.any(may), to_first, none)


SAFETY, LEAST, MOST = 0.9, 0.2, 5.0
"""Parameters of the step-size controller: the usual safety factor, and the limits of the change of
a step's length."""


def change_of_length(tableau: Tableau, squared: Array, dtype: Any) -> Array:
    """Return the next step's length over this one's, from its squared error over tolerance."""
    power = jnp.exp(jnp.log(jnp.clip(squared, 1e-20, 1e20)) * (-0.5 / tableau.order)).astype(dtype)
    return jnp.clip(SAFETY * power, LEAST, jnp.where(squared <= 1.0, MOST, 1.0))


def _without_rounding(x: np.ndarray) -> np.ndarray:
    """Return the products of a tableau with entries that are only round-off set to zero."""
    return np.where(np.abs(x) < 1e-14 * np.max(np.abs(x)), 0.0, x)


class Slope(NamedTuple):
    """Accelerations at one state, with the sine and cosine of theta."""

    sin: Array  # of theta
    cos: Array
    acceleration: Vector  # of all three coordinates, those of the phase first


def real_stability_limit(tableau: Tableau) -> float:
    """Return the largest z with |R(-z)| <= 1: a mode of decay rate r allows steps up to z / r."""
    z, stages, growth = np.linspace(0.01, 20.0, 2000), np.ones(len(tableau.places)), 1.0
    for power in range(1, len(stages) + 1):  # R is the polynomial 1 - z w (1 - z A + ...)
        growth = growth + (-z) ** power * (tableau.once[-1] @ stages)
        stages = tableau.once @ stages
    return float(z[np.argmax(np.abs(growth) > 1.0 + 1e-12)])


class Place(NamedTuple):
    """Positions, rates and accelerations of one stage."""

    q: Vector
    v: Vector
    slope: Slope


class Taken(NamedTuple):
    """A Runge-Kutta step: its end, the error estimate, and its stages."""

    end: Place
    error: Vector  # of positions, then rates
    stages: list[Place]  # the start first, the end last


Evaluate = Callable[[Vector, Vector], Slope]
Take = Callable[[Place, Array], Taken]


def take_step(
    tableau: Tableau, evaluate: Evaluate, start: Place, h: Array, with_error: bool = True
) -> Taken:
    """Take one Runge-Kutta step of length `h` from `start`, elementwise over the batch."""
    n = len(start.q)
    places, slopes = [start], [start.slope.acceleration[:n]]
    for i in range(1, len(tableau.places)):
        q, v = stage_at(tableau, i, start.q, start.v, slopes, h)
        slope = evaluate(q, v)
        places.append(Place(q, v, slope))
        slopes.append(slope.acceleration[:n])

    error: Vector = ()
    if with_error:
        known = [[slope[d] for slope in slopes] for d in range(n)]
        of_position = [h * h * _weigh(tableau.error_twice, k) for k in known]
        error = tuple(of_position + [h * _weigh(tableau.error_once, k) for k in known])
    return Taken(places[-1], error, places)


@functools.partial(jax.jit, static_argnums=(0, 1))  # traced once for all steps
def stage_at(
    tableau: Tableau, i: int, q0: Vector, v0: Vector, slopes: list[Vector], h: Array
) -> tuple[Vector, Vector]:
    """Return positions and rates of one stage, from the accelerations of those before."""
    position, rate = [], []
    for d in range(len(q0)):
        known = [slope[d] for slope in slopes]
        twice, once = _weigh(tableau.twice[i], known), _weigh(tableau.once[i], known)
        drift = float(tableau.places[i]) * v0[d]
        position.append(q0[d] + h * (drift if twice is None else drift + h * twice))
        rate.append(v0[d] + h * once)
    return tuple(position), tuple(rate)


def _weigh(weights: np.ndarray, terms: list[Array]) -> Any:
    """Return a weighted sum, None if all weights vanish.

    It uses `lax`, because half of a step's operations are such sums, and operators take three times
    as long to trace.
    """
    pairs = zip(weights, terms, strict=False)
    parts = [lax.mul(x.dtype.type(w), x) for w, x in pairs if w != 0.0]
    return functools.reduce(lax.add, parts) if parts else None
