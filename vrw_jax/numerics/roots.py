"""Where quantities along a branch change sign, and exactly at which place each of them does.

The places are sought for all brackets at once: one evaluation per round, whatever their number.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from vrw_jax.numerics.floquet import bifurcation_margins, multipliers

BIFURCATIONS = ("fold", "period_doubling", "neimark_sacker")
"""Each vanishes where a multiplier is 1, where one is -1, where a pair of modulus 1 is."""

ROUNDS = 100
ON_CIRCLE = 1e-4
"""How far from modulus 1 the pair of a located Neimark-Sacker bifurcation may be."""


def bifurcation_functions(jacobians: np.ndarray) -> np.ndarray:
    """`BIFURCATIONS` on the last axis, from Jacobians (..., n, n); NaN where n has none such."""
    margins = np.asarray(bifurcation_margins(jnp.asarray(jacobians)))
    values = np.full((*margins.shape[:-1], len(BIFURCATIONS)), np.nan)
    n = min(margins.shape[-1], len(BIFURCATIONS))
    values[..., :n] = margins[..., :n]
    return values


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
    function: Callable[[np.ndarray], np.ndarray],
    at_zero: np.ndarray,
    at_one: np.ndarray,
    width: np.ndarray,
) -> Located:
    """Zeros of functions that have opposite signs at 0 and 1, by Chandrupatla's method.

    Inverse quadratic interpolation where it can be trusted, bisection else: a jump is found as
    surely as a smooth zero. Ends when each bracket is narrower than `width`. A place where the
    function is not a number counts to the side of 1.
    """
    n = len(at_zero)
    a, fa = np.ones(n), np.array(at_one, float)  # the newest
    b, fb = np.zeros(n), np.array(at_zero, float)  # across from it
    c, fc = a.copy(), fa.copy()  # the one before
    sign_one = np.sign(at_one)
    share = np.full(n, 0.5)
    left, right = np.zeros(n), np.ones(n)
    for _ in range(ROUNDS):
        open_ = (np.abs(b - a) > width) & (fa != 0.0) & (fb != 0.0)
        if not open_.any():
            break
        trial = np.where(open_, a + share * (b - a), a)
        value = np.asarray(function(trial), float)
        value = np.where(np.isnan(value), sign_one, value)
        across = np.sign(value) == np.sign(fa)
        c_new, fc_new = np.where(across, a, b), np.where(across, fa, fb)
        b_new, fb_new = np.where(across, b, a), np.where(across, fb, fa)
        c, fc = np.where(open_, c_new, c), np.where(open_, fc_new, fc)
        b, fb = np.where(open_, b_new, b), np.where(open_, fb_new, fb)
        a, fa = np.where(open_, trial, a), np.where(open_, value, fa)
        on_right = np.sign(fa) == sign_one
        right = np.where(on_right, a, np.where(np.sign(fb) == sign_one, b, right))
        left = np.where(~on_right, a, np.where(np.sign(fb) != sign_one, b, left))
        share = _share(a, fa, b, fb, c, fc, width)
    place = np.where(np.abs(fa) <= np.abs(fb), a, b)
    return Located(place, left, right)


def _share(
    a: np.ndarray,
    fa: np.ndarray,
    b: np.ndarray,
    fb: np.ndarray,
    c: np.ndarray,
    fc: np.ndarray,
    width: np.ndarray,
) -> np.ndarray:
    """Where between a and b to look next, as a share of the way."""
    with np.errstate(all="ignore"):
        xi = (a - b) / (c - b)
        phi = (fa - fb) / (fc - fb)
        trusted = (phi**2 < xi) & ((1.0 - phi) ** 2 < 1.0 - xi)
        by_parabola = fa / (fb - fa) * fc / (fb - fc) + (c - a) / (b - a) * fa / (fc - fa) * fb / (
            fc - fb
        )
        share = np.where(trusted & np.isfinite(by_parabola), by_parabola, 0.5)
        least = np.minimum(0.5, 0.5 * width / np.abs(b - a))
        return np.clip(np.where(np.isfinite(share), share, 0.5), least, 1.0 - least)
