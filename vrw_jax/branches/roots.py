"""Locate roots and jumps of functions in brackets, many at once.

All brackets are searched in one batch. Each round evaluates the quantities once for all brackets.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

MAX_ROUNDS_PER_SMOOTH_BRACKET = 12
"""Number of rounds after which an unresolved bracket is treated as a jump."""
N_PARTS_PER_JUMP_BRACKET = 9
"""Number of equal sections into which each round divides a bracket that contains a jump."""


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

    `function` maps locations and the indices of their brackets to function values.
    `bracket_end_values` contains the function values at 0 and at 1. A round uses inverse quadratic
    interpolation if it is reliable, and bisection otherwise. A bracket in which the function jumps
    or stalls is divided into several sections per round. A jump is therefore located as reliably as
    a smooth root. The search ends when every bracket is narrower than `max_bracket_width` or has an
    exact root. If the function is NaN at a location, that location is treated as having the sign of
    location 1.
    """
    values_at_location_0, values_at_location_1 = bracket_end_values
    # The rows are the newest location, the end with the other sign, and the location replaced by
    # the newest one.
    bracket_locations = np.outer((0.0, 1.0, 1.0), np.ones_like(max_bracket_width))
    function_values = np.stack([values_at_location_0, values_at_location_1, values_at_location_1])
    is_sign_jump, n_search_rounds = np.zeros(len(max_bracket_width), bool), 0
    n_bracket_parts = N_PARTS_PER_JUMP_BRACKET
    while len(
        unresolved_indices := np.flatnonzero(
            np.abs(bracket_locations[0] - bracket_locations[1]) > max_bracket_width
        )
    ):
        smooth_bracket_indices = unresolved_indices[~is_sign_jump[unresolved_indices]]
        jump_bracket_indices = unresolved_indices[is_sign_jump[unresolved_indices]]
        proposed_locations = _propose_root_location(
            bracket_locations[:, smooth_bracket_indices],
            function_values[:, smooth_bracket_indices],
            max_bracket_width[smooth_bracket_indices],
        )
        lower_ends, upper_ends = np.sort(bracket_locations[:2, jump_bracket_indices], 0)
        bracket_part_ends = np.linspace(lower_ends, upper_ends, n_bracket_parts + 1, axis=-1)
        bracket_indices = np.concatenate(
            [smooth_bracket_indices, np.repeat(jump_bracket_indices, n_bracket_parts - 1)]
        )
        new_function_values = function(
            np.concatenate([proposed_locations, bracket_part_ends[:, 1:-1].ravel()]),
            bracket_indices,
        )
        is_function_undefined = np.isnan(new_function_values)
        new_function_values = np.where(
            is_function_undefined, values_at_location_1[bracket_indices], new_function_values
        )
        values_at_proposals = new_function_values[: len(smooth_bracket_indices)]
        values_at_part_ends = new_function_values[len(smooth_bracket_indices) :].reshape(
            -1, n_bracket_parts - 1
        )
        has_same_sign = np.sign(values_at_proposals) == np.sign(
            function_values[0, smooth_bracket_indices]
        )
        for stored_values, proposed_values in (
            (bracket_locations, proposed_locations),
            (function_values, values_at_proposals),
        ):
            newest_values, opposite_values, _ = stored_values[:, smooth_bracket_indices]
            stored_values[:, smooth_bracket_indices] = (
                proposed_values,
                np.where(has_same_sign, opposite_values, newest_values),
                np.where(has_same_sign, newest_values, opposite_values),
            )
        is_exact_root = values_at_proposals == 0.0
        bracket_locations[1, smooth_bracket_indices[is_exact_root]] = proposed_locations[
            is_exact_root
        ]
        is_left_side = (
            np.sign(values_at_part_ends)
            != np.sign(values_at_location_1[jump_bracket_indices])[:, None]
        )
        # The root lies between the last location with the sign of location 0 and the next location.
        last_left_index = np.sum(np.cumprod(is_left_side, 1), 1)
        bracket_locations[:2, jump_bracket_indices] = bracket_part_ends[
            np.arange(len(jump_bracket_indices)), np.stack([last_left_index, last_left_index + 1])
        ]
        n_search_rounds += 1
        is_sign_jump[smooth_bracket_indices] = (
            is_function_undefined[: len(smooth_bracket_indices)]
            | (values_at_proposals == function_values[2, smooth_bracket_indices])
            | (n_search_rounds >= MAX_ROUNDS_PER_SMOOTH_BRACKET)
        )
    is_newest_end_better = np.abs(function_values[0]) < np.abs(function_values[1])
    best_locations = np.where(
        is_sign_jump,
        np.min(bracket_locations[:2], 0),
        np.where(is_newest_end_better, bracket_locations[0], bracket_locations[1]),
    )
    return RootLocations(best_locations, *np.sort(bracket_locations[:2], 0))


def _propose_root_location(
    bracket_locations: np.ndarray, function_values: np.ndarray, max_bracket_width: np.ndarray
) -> np.ndarray:
    """Return the next trial location in each bracket by Chandrupatla's method (1997,
    doi 10/d9zjj8).
    """
    newest_location, opposite_location, replaced_location = bracket_locations
    newest_value, opposite_value, replaced_value = function_values
    with np.errstate(divide="ignore", invalid="ignore"):
        location_ratio = (newest_location - opposite_location) / (
            replaced_location - opposite_location
        )
        value_ratio = (newest_value - opposite_value) / (replaced_value - opposite_value)
        is_interpolation_trusted = (1.0 - np.sqrt(1.0 - location_ratio) < value_ratio) & (
            value_ratio < np.sqrt(location_ratio)
        )
        interpolated_fraction = (
            newest_value
            / (newest_value - opposite_value)
            * replaced_value
            / (replaced_value - opposite_value)
        )
        interpolated_fraction -= (
            (replaced_location - newest_location)
            / (opposite_location - newest_location)
            * newest_value
            / (replaced_value - newest_value)
            * opposite_value
            / (opposite_value - replaced_value)
        )
    bracket_length = opposite_location - newest_location
    min_bracket_fraction = 0.5 * max_bracket_width / np.abs(bracket_length)
    bracket_fraction = np.clip(
        np.where(is_interpolation_trusted, interpolated_fraction, 0.5),
        min_bracket_fraction,
        1.0 - min_bracket_fraction,
    )
    return newest_location + bracket_fraction * bracket_length
