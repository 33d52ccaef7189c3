"""Sign changes of quantities along a branch, and their exact locations.

All brackets are searched together: each round has one evaluation, whatever their number.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from vrw_jax.numerics.floquet import bifurcation_margins, multipliers

BIFURCATIONS = ("fold", "period_doubling", "neimark_sacker")
"""Names of the bifurcations: a multiplier is 1, one is -1, or a pair has modulus 1."""

ROUNDS = 12
"""Limit of rounds to locate a smooth zero; an unresolved bracket then counts as a jump."""

SECTIONS = 9
"""Number of equal sections into which a bracket with a jump is divided per round."""
ON_CIRCLE = 1e-4
"""Largest distance from modulus 1 of the pair of a located Neimark-Sacker bifurcation."""


def bifurcation_functions(jacobians: np.ndarray) -> np.ndarray:
    """Return the test functions of `BIFURCATION_NAMES` on the last axis, from Jacobians (..., n,
    n).

    They are NaN where n admits no such bifurcation.
    """
    margins = np.asarray(bifurcation_margins(jnp.asarray(jacobians)))
    values = np.full((*margins.shape[:-1], len(BIFURCATIONS)), np.nan)
    n = min(margins.shape[-1], len(BIFURCATIONS))
    values[..., :n] = margins[..., :n]
    return values


def turns(jacobian: np.ndarray) -> bool:
    """Return whether a complex pair of multipliers lies on the unit circle.

    The product of two multipliers is also 1 if they are real and reciprocal, which is no
    bifurcation.
    """
    values = np.asarray(multipliers(jnp.asarray(jacobian)))
    return bool(np.any((np.abs(np.abs(values) - 1.0) < ON_CIRCLE) & (values.imag != 0.0)))


class Bracket(NamedTuple):
    """A sign change of the quantity with index `quantity_index` between two points of a branch."""

    left: int
    right: int
    column: int


def brackets(values: np.ndarray) -> list[Bracket]:
    """Return the sign changes between neighbors in `values` (point, quantity); NaN and zero have
    none.

    Two changes between neighbors are not detected: the continuation step decides what is found.
    """
    signs = np.sign(np.nan_to_num(values))
    found = np.argwhere(signs[:-1] * signs[1:] < 0.0)
    return [Bracket(int(i), int(i) + 1, int(q)) for i, q in found]


class Located(NamedTuple):
    """Locations of sign changes in [0, 1], one per bracket."""

    place: np.ndarray  # the side with the smaller value
    left: np.ndarray  # with the sign at location 0
    right: np.ndarray  # with the sign at location 1


def locate(
    function: Callable[[np.ndarray, np.ndarray], np.ndarray],
    ends: tuple[np.ndarray, np.ndarray],
    width: np.ndarray,
) -> Located:
    """Return zeros of functions with opposite signs at 0 and 1, by Chandrupatla's method.

    `function` takes locations and the indices of their brackets. A round uses inverse quadratic
    interpolation where it is reliable and bisection elsewhere. A bracket in which the function
    jumps or stalls is divided into N_BRACKET_SECTIONS sections together: a jump is located as
    reliably as a smooth zero. The search ends when each bracket is narrower than `width`, or at a
    zero itself. A location where the function is NaN counts to the side of 1; `end_values` are its
    values at 0 and 1.
    """
    at_zero, at_one = ends
    # Rows: the newest location, the end of the other sign, and the location that it replaced.
    x = np.outer((0.0, 1.0, 1.0), np.ones_like(width))
    f = np.stack([at_zero, at_one, at_one])
    jumps, rounds = np.zeros(len(width), bool), 0
    while len(open_ := np.flatnonzero(np.abs(x[0] - x[1]) > width)):
        some, cut = open_[~jumps[open_]], open_[jumps[open_]]
        near = _proposed(x[:, some], f[:, some], width[some])
        low, high = np.sort(x[:2, cut], 0)
        cuts = np.linspace(low, high, SECTIONS + 1, axis=-1)
        which = np.concatenate([some, np.repeat(cut, SECTIONS - 1)])
        values = function(np.concatenate([near, cuts[:, 1:-1].ravel()]), which)
        lost = np.isnan(values)
        values = np.where(lost, at_one[which], values)
        value, inner = values[: len(some)], values[len(some) :].reshape(-1, SECTIONS - 1)
        same = np.sign(value) == np.sign(f[0, some])
        for rows, newest in ((x, near), (f, value)):
            first, other, _ = rows[:, some]
            rows[:, some] = newest, np.where(same, other, first), np.where(same, first, other)
        x[1, some[value == 0.0]] = near[value == 0.0]
        ours = np.sign(inner) != np.sign(at_one[cut])[:, None]
        last = np.sum(np.cumprod(ours, 1), 1)  # before the first location on the side of 1
        x[:2, cut] = cuts[np.arange(len(cut)), np.stack([last, last + 1])]
        rounds += 1
        jumps[some] = lost[: len(some)] | (value == f[2, some]) | (rounds >= ROUNDS)
    best = np.where(jumps, np.min(x[:2], 0), np.where(np.abs(f[0]) < np.abs(f[1]), x[0], x[1]))
    return Located(best, *np.sort(x[:2], 0))


def _proposed(x: np.ndarray, f: np.ndarray, width: np.ndarray) -> np.ndarray:
    """Return the next locations of Chandrupatla's method from its three points (1997, doi
    10/d9zjj8).
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        xi, phi = (x[0] - x[1]) / (x[2] - x[1]), (f[0] - f[1]) / (f[2] - f[1])
        trusted = (1.0 - np.sqrt(1.0 - xi) < phi) & (phi < np.sqrt(xi))
        share = f[0] / (f[0] - f[1]) * f[2] / (f[2] - f[1])
        share -= (x[2] - x[0]) / (x[1] - x[0]) * f[0] / (f[2] - f[0]) * f[1] / (f[1] - f[2])
    span = x[1] - x[0]
    margin = 0.5 * width / np.abs(span)
    return x[0] + np.clip(np.where(trusted, share, 0.5), margin, 1.0 - margin) * span
