"""Map of all special points of gaits over two parameters, with a check against a scan.

If a quantity has different signs at neighboring samples of a scan, a curve of special points runs
between them. If no traced curve does, branches through these samples find it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vrw_jax.branches.branch import BorderCurve
from vrw_jax.branches.continuation import COARSE, ENDING
from vrw_jax.branches.gait_levels import EXACT, ROLLS_OFF
from vrw_jax.branches.tracing import OF_CURVES, Seed, Traced, Tracer, distance
from vrw_jax.models import ViscoelasticWheel
from vrw_jax.numerics import BIFURCATIONS, Options
from vrw_jax.results import MARGINS
from vrw_jax.runtime import xarray as xr
from vrw_jax.wheel import Outcome, WheelParams

ROUNDS = 3
"""Number of rounds in which special points met on the curves are continued in turn."""

LINES = 5
"""Number of parallel branches along each parameter on which a map starts."""

NEAR, APART = 1.0, 5.0
"""Distances in cells of the scan. The first is the largest one of a change of sign from a curve
that explains it. The second is the smallest one between changes that are examined in the same
round."""

LOOKS = 8
"""Largest number of rounds in which changes of sign are examined."""

NO_GAIT, STABILITY = "gait", "spectral_radius"
"""Names of changes between a gait and none, and between a stable and an unstable gait."""

SCANNED = ("lambda_4_plus", STABILITY)
"""Measures of a scan that indicate special points, in addition to the margins that every scan
has."""

TOLD_BY: Mapping[str, tuple[str, ...]] = {
    NO_GAIT: (*ENDING, *BIFURCATIONS),
    STABILITY: BIFURCATIONS,
    "lambda_4_plus": ("lambda_4_plus", ROLLS_OFF),
    **{exact: (name,) for name, exact in EXACT.items()},
}
"""Names of the curves that explain a change, if it is not the curve of the same name."""


class Change(NamedTuple):
    """Change of sign between two neighboring samples of a scan."""

    name: str
    axis: int
    sample: tuple[int, int]  # first sample, with a gait
    at: tuple[float, float]  # in cells of the scan


def border_map(
    scan: xr.Dataset, params: WheelParams, model: ViscoelasticWheel
) -> tuple[tuple[BorderCurve, ...], list[Change]]:
    """Return all curves of special points over the two parameters of a scan.

    The scan contains `SPECIAL_POINT_MEASURES` and margins. Return also the changes between its
    samples that no curve explains.
    """
    names = tuple(map(str, scan.outcome.dims))
    box = np.array([(scan[name].values[0], scan[name].values[-1]) for name in names], float)
    tracer = Tracer((names[0], names[1]), box, model, OF_CURVES, Options.tight())
    traced = _followed(tracer, across(tracer, params), [])
    changes = changes_of(scan, tracer.parameters)
    looked: list[Change] = []
    left = lambda: unexplained(changes, [one.curve for one in traced], scan)
    for _ in range(LOOKS):
        fresh = _thinned(left(), looked)
        if not fresh:
            break
        looked += fresh
        traced = _followed(tracer, _beside(tracer, params, scan, fresh), traced)
    return tuple(one.curve for one in traced), left()


def _followed(tracer: Tracer, seeds: list[Seed], traced: list[Traced]) -> list[Traced]:
    """Return the known curves, the curves through the seeds, and the curves through special points
    on these."""
    for _ in range(ROUNDS):
        more = tracer.followed(seeds, traced)
        longer = [one for one in traced if not any(tracer.lies_on(one, new) for new in more)]
        traced, seeds = [*longer, *more], [seed for one in more for seed in one.met]
    return traced


def across(tracer: Tracer, params: WheelParams) -> list[Seed]:
    """Return seeds on the branches through wheels on the middle lines of the box."""
    seeds, middle = [], tracer.box.mean(1)
    for axis, name in enumerate(tracer.parameters):
        low, high = tracer.box[1 - axis]
        at = low + (np.arange(LINES) + 0.5) / LINES * (high - low)
        other = tracer.parameters[1 - axis]
        wheels = [tracer.moved(params, {name: middle[axis], other: x}) for x in at]
        seeds += _along(tracer, axis, wheels)
    return seeds


def _along(tracer: Tracer, axis: int, wheels: list[WheelParams]) -> list[Seed]:
    """Return seeds on branches, always the same number side by side, so that they are compiled
    once."""
    seeds = []
    for begin in range(0, len(wheels), LINES):
        some = wheels[begin : begin + LINES]
        filled = [*some, *some[-1:] * (LINES - len(some))]
        seeds += tracer.along(axis, jax.tree.map(lambda *x: jnp.stack(x), *filled))
    return seeds


def _beside(
    tracer: Tracer, params: WheelParams, scan: xr.Dataset, changes: Sequence[Change]
) -> list[Seed]:
    """Return seeds on branches through the samples at which changes begin."""
    seeds = []
    for axis in range(2):
        own = [change for change in changes if change.axis == axis]
        at = [{n: float(scan[n][i]) for n, i in zip(tracer.parameters, c.sample, strict=True)}
              for c in own]  # fmt: skip
        seeds += _along(tracer, axis, [tracer.moved(params, values) for values in at])
    return seeds


def _columns(scan: xr.Dataset, dims: tuple[str, str]) -> dict[str, np.ndarray]:
    """Return the quantities whose signs may change, over the two parameters."""
    told = {"lambda_4_plus": scan.lambda_4_plus.transpose(*dims).values}
    told[STABILITY] = 1.0 - scan[STABILITY].transpose(*dims).values
    for name in (name for name in MARGINS if name not in EXACT):
        rows = scan[name].transpose(*dims, ...).values
        legs = scan.leg.values if MARGINS[name].axis else []
        told |= {f"{name}[{leg}]": rows[..., i] for i, leg in enumerate(legs)}
        if not MARGINS[name].axis:
            told[name] = rows
    return told


def changes_of(scan: xr.Dataset, dims: tuple[str, str]) -> list[Change]:
    """Return the changes between all neighbors. Both samples, or none, must have double support."""
    outcome = scan.outcome.transpose(*dims).values
    found, coarse = outcome == Outcome.STEPPED, outcome == Outcome.MESH_TOO_COARSE
    told, changes = _columns(scan, dims), []
    told[NO_GAIT] = np.where(found, 1.0, np.where(coarse, np.nan, -1.0))
    told[COARSE] = np.where(found, 1.0, np.where(coarse, -1.0, np.nan))
    for axis in range(2):
        sides = lambda x, axis=axis: (np.moveaxis(x, axis, 0)[:-1], np.moveaxis(x, axis, 0)[1:])
        order = lambda a, b, axis=axis: (a, b) if axis == 0 else (b, a)
        here, there = sides(found)
        alike = np.equal(*sides(told["lambda_4_plus"] > 0.0))
        for name, values in told.items():
            low, high = sides(values)
            change = low * high < 0.0
            if name not in (NO_GAIT, COARSE):
                change &= here & there & (alike | (name == "lambda_4_plus"))
            for i, j in np.argwhere(change):
                share = low[i, j] / (low[i, j] - high[i, j])
                sample = order(int(i if here[i, j] else i + 1), int(j))
                changes.append(Change(name, axis, sample, order(float(i + share), float(j))))
    return changes


def unexplained(
    changes: Sequence[Change], curves: Sequence[BorderCurve], scan: xr.Dataset
) -> list[Change]:
    """Return the changes that are not near any curve that could explain them."""
    left = []
    for name in sorted({change.name for change in changes}):
        own = [change for change in changes if change.name == name]
        telling = [curve for curve in curves if curve.name in TOLD_BY.get(name, (name,))]
        at, off = np.array([change.at for change in own]), np.full(len(own), np.inf)
        for curve in telling:
            axes = zip(curve.values.T, curve.parameters, strict=True)
            cells = [np.interp(v, scan[n].values, np.arange(scan.sizes[n])) for v, n in axes]
            off = np.minimum(off, distance(at, np.stack(cells, -1)))
        left += [change for change, far in zip(own, off, strict=True) if far > NEAR]
    return left


def _thinned(left: Sequence[Change], looked: Sequence[Change]) -> list[Change]:
    """Return changes of each name that are apart from each other and from those examined before."""
    chosen: list[Change] = []
    for change in left:
        alike = [c for c in (*looked, *chosen) if (c.name, c.axis) == (change.name, change.axis)]
        if all(np.hypot(*np.subtract(c.at, change.at)) > APART for c in alike):
            chosen.append(change)
    return chosen
