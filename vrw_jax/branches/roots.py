"""Locate roots and jumps of functions in brackets, many at once."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np


class RootLocations(NamedTuple):
    """Locations of roots in [0, 1], and the ends of the brackets that enclose them.

    Each array has the shape (brackets,).
    """

    best_locations: np.ndarray  # bracket end with the smaller absolute value
    left_bracket_ends: np.ndarray  # bracket end with the sign of location 0
    right_bracket_ends: np.ndarray  # bracket end with the sign of location 1


def locate_function_roots(
    function: Callable[[np.ndarray, np.ndarray], np.ndarray],
    bracket_end_values: tuple[np.ndarray, np.ndarray],
    max_bracket_width: np.ndarray,
) -> RootLocations:
    """Locate the roots of functions that have opposite signs at 0 and 1, by Chandrupatla's method.

    `function` maps locations and the indices of their brackets to function values. Each round
    evaluates it once for all brackets. `bracket_end_values` contains the function values at 0 and
    at 1. The search ends when every bracket is narrower than `max_bracket_width` or has an exact
    root. If the function is NaN at a location, that location is treated as having the sign of
    location 1.
    """
    from scipy.optimize import elementwise  # its import takes longer than that of the library

    end_values, widths_per_bracket = np.stack(bracket_end_values), 1.0 / max_bracket_width

    def evaluate(locations: np.ndarray, indices: np.ndarray) -> np.ndarray:
        # The unit of the locations is the width, and the values at both ends are known.
        indices = indices.astype(int)
        locations = locations / widths_per_bracket[indices]
        values = np.array(end_values[(locations > 0.5).astype(int), indices])
        inner = (locations > 0.0) & (locations < 1.0)
        if inner.any():
            values[inner] = function(locations[inner], indices[inner])
        return np.where(np.isnan(values), end_values[1, indices], values)

    result = elementwise.find_root(
        evaluate,
        (0.0 * widths_per_bracket, widths_per_bracket),
        args=(np.arange(len(widths_per_bracket)),),
        tolerances={"xatol": 1.0, "xrtol": 0.0, "fatol": 0.0, "frtol": 0.0},
    )
    left, right = np.stack(result.bracket) / widths_per_bracket
    is_left_better = np.abs(result.f_bracket[0]) <= np.abs(result.f_bracket[1])
    best = np.where(is_left_better, left, right)
    is_exact = np.any(np.stack(result.f_bracket) == 0.0, 0)
    return RootLocations(best, *np.where(is_exact, best, [left, right]))
