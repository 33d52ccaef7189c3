"""Where quantities along a branch change sign, and exactly at which place each of them does.

The places are sought for all brackets at once: one evaluation per round, whatever their number.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vrw_jax.numerics.floquet import bifurcation_margins, multipliers

BIFURCATIONS = ("fold", "period_doubling", "neimark_sacker")
"""Each vanishes where a multiplier is 1, where one is -1, where a pair of modulus 1 is."""

ROUNDS = 12
"""In which what is smooth is located. What is not jumps: from then on it is cut in SECTIONS."""

SECTIONS = 9
ON_CIRCLE = 1e-4
"""How far from modulus 1 the pair of a located Neimark-Sacker bifurcation may be."""


def bifurcation_functions(jacobians: np.ndarray) -> np.ndarray:
    """`BIFURCATIONS` on the last axis, from Jacobians (..., n, n); NaN where n has none such."""
    margins = np.asarray(_margins(jnp.asarray(jacobians)))
    values = np.full((*margins.shape[:-1], len(BIFURCATIONS)), np.nan)
    n = min(margins.shape[-1], len(BIFURCATIONS))
    values[..., :n] = margins[..., :n]
    return values


_margins = jax.jit(bifurcation_margins)


def turns(jacobian: np.ndarray) -> bool:
    """Whether a complex pair of multipliers lies on the unit circle.

    The product of two multipliers is 1 also where they are real and reciprocal: no bifurcation.
    """
    values = np.asarray(multipliers(jnp.asarray(jacobian)))
    return bool(np.any((np.abs(np.abs(values) - 1.0) < ON_CIRCLE) & (values.imag != 0.0)))


class Bracket(NamedTuple):
    """Between the points `left` and `right` of a branch, quantity `column` changes sign."""

    left: int
    right: int
    column: int


def brackets(values: np.ndarray, columns: Sequence[int] | None = None) -> list[Bracket]:
    """Where neighbours in `values` (point, quantity) differ in sign; NaN and zero differ in none.

    Two changes between neighbours are not seen: the continuation's steps decide what is found.
    """
    signs = np.sign(np.nan_to_num(values))
    found = np.argwhere(signs[:-1] * signs[1:] < 0.0)
    wanted = range(values.shape[1]) if columns is None else columns
    return [Bracket(int(i), int(i) + 1, int(q)) for i, q in found if q in wanted]


class Located(NamedTuple):
    """Where the functions change sign, as places in [0, 1], one of each per bracket."""

    place: np.ndarray  # the better of both sides
    left: np.ndarray  # with the sign at place 0
    right: np.ndarray  # with the sign at place 1


def locate(
    function: Callable[[np.ndarray, np.ndarray], np.ndarray],
    ends: tuple[np.ndarray, np.ndarray],
    width: np.ndarray,
) -> Located:
    """Zeros of functions that have opposite signs at 0 and 1, by Chandrupatla's method.

    `function` takes places and which brackets they are of. Inverse quadratic interpolation where it
    can be trusted, bisection else, and many sections at once where that goes on: a jump is found as
    surely as a smooth zero. Ends when each bracket is narrower than `width`. A place where the
    function is not a number counts to the side of 1; `ends` are its values at 0 and 1.
    """
    from scipy.optimize.elementwise import find_root  # only borders need it, its import is slow

    # Places in widths: the tolerance is one for all.
    at_zero, at_one = ends
    inside = (np.zeros(len(width)), 1.0 / width)

    def signed(place: np.ndarray, which: np.ndarray) -> np.ndarray:
        value = np.where(place > 0.0, at_one[which], at_zero[which])
        inner = np.flatnonzero((place > 0.0) & (place < inside[1][which]))
        if len(inner):
            value[inner] = function(place[inner] * width[which[inner]], which[inner])
        return np.where(np.isnan(value), at_one[which], value)

    tolerances = {"xatol": 1.0, "xrtol": 0.0, "fatol": 0.0}
    found = find_root(
        signed, inside, args=(np.arange(len(width)),), tolerances=tolerances, maxiter=ROUNDS
    )
    best, left, right = np.array((found.x, *found.bracket))
    open_ = np.flatnonzero(right - left > 1.0)
    while len(open_):
        cuts = np.linspace(left[open_], right[open_], SECTIONS + 1, axis=-1)
        inner = cuts[:, 1:-1]
        values = signed(inner.ravel(), np.repeat(open_, SECTIONS - 1)).reshape(inner.shape)
        ours = np.sign(values) != np.sign(at_one[open_])[:, None]
        last = np.sum(np.cumprod(ours, 1), 1)  # before the first place on the side of 1
        left[open_] = np.take_along_axis(cuts, last[:, None], 1)[:, 0]
        right[open_] = np.take_along_axis(cuts, last[:, None] + 1, 1)[:, 0]
        best[open_] = left[open_]
        open_ = open_[right[open_] - left[open_] > 1.0]
    return Located(*(place * width for place in (best, left, right)))
