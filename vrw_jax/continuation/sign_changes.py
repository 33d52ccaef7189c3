"""Sign changes of quantities along a branch, and their exact locations.

All brackets are searched in one batch: each round has one evaluation, whatever their number.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from vrw_jax.continuation.floquet import (
    MULTIPLIER_TOLERANCES,
    MultiplierTolerances,
    bifurcation_margins,
    floquet_multipliers,
)

BIFURCATION_NAMES = ("fold", "period_doubling", "neimark_sacker")
"""Names of the bifurcations: a multiplier is 1, one is -1, or a pair has modulus 1."""


@dataclass(frozen=True)
class ZeroSearchOptions:
    """Numbers of the search for zeros of `locate_zeros`.

    - `max_smooth_rounds`: limit of rounds to locate a smooth zero, after which an unresolved
      bracket counts as a jump;
    - `n_sections`: number of equal sections into which a bracket with a jump is divided per round.
    """

    max_smooth_rounds: int = 12
    n_sections: int = 9


ZERO_SEARCH_OPTIONS = ZeroSearchOptions()
"""Options of all searches."""


def evaluate_bifurcation_functions(jacobians: np.ndarray) -> np.ndarray:
    """Return the test functions of `BIFURCATION_NAMES` on the last axis.

    `jacobians` have the shape (..., n, n). A function is NaN if matrices of this size cannot have
    its bifurcation.
    """
    margins = np.asarray(bifurcation_margins(jnp.asarray(jacobians)))
    values = np.full((*margins.shape[:-1], len(BIFURCATION_NAMES)), np.nan)
    n = min(margins.shape[-1], len(BIFURCATION_NAMES))
    values[..., :n] = margins[..., :n]
    return values


def has_unit_circle_pair(
    jacobian: np.ndarray, tolerances: MultiplierTolerances = MULTIPLIER_TOLERANCES
) -> bool:
    """Return whether a complex pair of multipliers lies on the unit circle.

    The product of two multipliers is also 1 if they are real and reciprocal, which is no
    bifurcation.
    """
    values = np.asarray(floquet_multipliers(jnp.asarray(jacobian)))
    is_pair = np.abs(values.imag) > tolerances.min_imaginary
    is_on_circle = np.abs(np.abs(values) - 1.0) < tolerances.located_on_circle
    return bool(np.any(is_on_circle & is_pair))


class SignChange(NamedTuple):
    """A sign change of the quantity with index `quantity_index` between two points of a branch."""

    left_index: int
    right_index: int
    quantity_index: int


def find_sign_changes(values: np.ndarray) -> list[SignChange]:
    """Return the sign changes between neighboring points in `values` (point, quantity).

    NaN and zero have no sign. Two changes between neighbors are not detected, so the continuation
    step must be short enough.
    """
    signs = np.sign(np.nan_to_num(values))
    rows = np.argwhere(signs[:-1] * signs[1:] < 0.0)
    return [SignChange(int(i), int(i) + 1, int(q)) for i, q in rows]


class LocatedZeros(NamedTuple):
    """Locations of sign changes in [0, 1], one per bracket."""

    best: np.ndarray  # the side with the smaller value
    left_end: np.ndarray  # with the sign at location 0
    right_end: np.ndarray  # with the sign at location 1


def locate_zeros(
    function: Callable[[np.ndarray, np.ndarray], np.ndarray],
    end_values: tuple[np.ndarray, np.ndarray],
    width: np.ndarray,
    options: ZeroSearchOptions = ZERO_SEARCH_OPTIONS,
) -> LocatedZeros:
    """Return zeros of functions with opposite signs at 0 and 1, by Chandrupatla's method.

    `function` takes locations and the indices of their brackets; `end_values` are its values at 0
    and 1. A round uses inverse quadratic interpolation if it is reliable, and otherwise bisection.
    A bracket in which the function jumps or stalls is divided into several sections per round, so
    that a jump is located as reliably as a smooth zero. The search ends when each bracket is
    narrower than `width`, or at an exact zero. A location where the function is NaN counts to the
    side of 1.
    """
    values_at_zero, values_at_one = end_values
    # Rows: the newest location, the end of the other sign, and the location that it replaced.
    x = np.outer((0.0, 1.0, 1.0), np.ones_like(width))
    f = np.stack([values_at_zero, values_at_one, values_at_one])
    is_jump, n_rounds, n_sections = np.zeros(len(width), bool), 0, options.n_sections
    while len(unresolved_indices := np.flatnonzero(np.abs(x[0] - x[1]) > width)):
        smooth_brackets = unresolved_indices[~is_jump[unresolved_indices]]
        jump_brackets = unresolved_indices[is_jump[unresolved_indices]]
        proposals = _propose_location(
            x[:, smooth_brackets], f[:, smooth_brackets], width[smooth_brackets]
        )
        lower_ends, upper_ends = np.sort(x[:2, jump_brackets], 0)
        section_ends = np.linspace(lower_ends, upper_ends, n_sections + 1, axis=-1)
        bracket_indices = np.concatenate(
            [smooth_brackets, np.repeat(jump_brackets, n_sections - 1)]
        )
        values = function(
            np.concatenate([proposals, section_ends[:, 1:-1].ravel()]), bracket_indices
        )
        is_undefined = np.isnan(values)
        values = np.where(is_undefined, values_at_one[bracket_indices], values)
        value = values[: len(smooth_brackets)]
        section_values = values[len(smooth_brackets) :].reshape(-1, n_sections - 1)
        has_same_sign = np.sign(value) == np.sign(f[0, smooth_brackets])
        for table, newest_row in ((x, proposals), (f, value)):
            first_row, other_row, _ = table[:, smooth_brackets]
            table[:, smooth_brackets] = (
                newest_row,
                np.where(has_same_sign, other_row, first_row),
                np.where(has_same_sign, first_row, other_row),
            )
        x[1, smooth_brackets[value == 0.0]] = proposals[value == 0.0]
        is_left_side = np.sign(section_values) != np.sign(values_at_one[jump_brackets])[:, None]
        # The last location on the side of 0 precedes the first one on the side of 1.
        last_left = np.sum(np.cumprod(is_left_side, 1), 1)
        x[:2, jump_brackets] = section_ends[
            np.arange(len(jump_brackets)), np.stack([last_left, last_left + 1])
        ]
        n_rounds += 1
        is_jump[smooth_brackets] = (
            is_undefined[: len(smooth_brackets)]
            | (value == f[2, smooth_brackets])
            | (n_rounds >= options.max_smooth_rounds)
        )
    best_location = np.where(
        is_jump, np.min(x[:2], 0), np.where(np.abs(f[0]) < np.abs(f[1]), x[0], x[1])
    )
    return LocatedZeros(best_location, *np.sort(x[:2], 0))


def _propose_location(x: np.ndarray, f: np.ndarray, width: np.ndarray) -> np.ndarray:
    """Return the next locations of Chandrupatla's method (1997, doi 10/d9zjj8)."""
    with np.errstate(divide="ignore", invalid="ignore"):
        xi, phi = (x[0] - x[1]) / (x[2] - x[1]), (f[0] - f[1]) / (f[2] - f[1])
        is_trusted = (1.0 - np.sqrt(1.0 - xi) < phi) & (phi < np.sqrt(xi))
        interpolated_fraction = f[0] / (f[0] - f[1]) * f[2] / (f[2] - f[1])
        interpolated_fraction -= (
            (x[2] - x[0]) / (x[1] - x[0]) * f[0] / (f[2] - f[0]) * f[1] / (f[1] - f[2])
        )
    span = x[1] - x[0]
    margin = 0.5 * width / np.abs(span)
    return (
        x[0]
        + np.clip(np.where(is_trusted, interpolated_fraction, 0.5), margin, 1.0 - margin) * span
    )
