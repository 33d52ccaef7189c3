"""Map of all special points of gaits over two parameters, checked against a scan.

If a quantity has different signs at neighboring samples of a scan, a curve of special points runs
between them. If that curve is not traced yet, it is found on branches through these samples.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vrw_jax.branches.branch import SpecialPointCurve
from vrw_jax.branches.continuation import BRANCH_ENDING_QUANTITIES, COARSE_MESH_NAME
from vrw_jax.branches.curve_tracing import (
    DEFAULT_CURVE_OPTIONS,
    CurveSeed,
    CurveTracer,
    TracedCurve,
    distance_to_polyline,
)
from vrw_jax.branches.gait_test_functions import DLS_VANISHES, LINEAR_SUBSTITUTES
from vrw_jax.continuation import BIFURCATION_NAMES
from vrw_jax.measures import MARGIN_MEASURES
from vrw_jax.models import ViscoelasticWheel
from vrw_jax.numerics import StepOptions
from vrw_jax.runtime import with_default_settings
from vrw_jax.runtime import xarray as xr
from vrw_jax.wheel import Outcome, WheelParams


@dataclass(frozen=True)
class MapOptions:
    """Options of the map of special points; distances are in cells of the scan.

    - `n_lines`: number of parallel branches along each parameter with which the map starts;
    - `n_meeting_rounds`: number of rounds in which special points on new curves are continued;
    - `max_search_rounds`: largest number of rounds in which changes of sign are examined;
    - `max_explained_distance`: largest distance of a change of sign from a curve that explains it;
    - `min_change_distance`: smallest distance between changes that are examined.
    """

    n_lines: int = 5
    n_meeting_rounds: int = 3
    max_search_rounds: int = 8
    max_explained_distance: float = 1.0
    min_change_distance: float = 5.0


MAP_OPTIONS = MapOptions()
"""Options of all maps of special points."""

GAIT_CHANGE = "gait"
"""Name of a change between a sample with a gait and one without."""

STABILITY_CHANGE = "spectral_radius"
"""Name of a change between a stable and an unstable gait."""

SPECIAL_POINT_MEASURES = ("lambda_4_plus", STABILITY_CHANGE)
"""Measures of a scan whose zeros indicate special points, in addition to the margins of every
scan.
"""

EXPLAINING_CURVES: Mapping[str, tuple[str, ...]] = {
    GAIT_CHANGE: (*BRANCH_ENDING_QUANTITIES, *BIFURCATION_NAMES),
    STABILITY_CHANGE: BIFURCATION_NAMES,
    "lambda_4_plus": ("lambda_4_plus", DLS_VANISHES),
    **{exact: (name,) for name, exact in LINEAR_SUBSTITUTES.items()},
}
"""Names of the curves that explain a change, if they are not the curve of the same name."""


class UnexplainedChange(NamedTuple):
    """Change of sign between two neighboring samples of a scan that no curve explains."""

    name: str
    axis: int
    sample: tuple[int, int]  # indices of the first sample, which has a gait
    cell_position: tuple[float, float]  # position of the change in cells of the scan


@with_default_settings
def trace_special_points(
    scan: xr.Dataset,
    params: WheelParams,
    model: ViscoelasticWheel,
    on_stage: Callable[[str], None] | None = None,
    options: MapOptions = MAP_OPTIONS,
) -> tuple[tuple[SpecialPointCurve, ...], tuple[UnexplainedChange, ...]]:
    """Return all curves of special points over the parameters of a scan, and the unexplained
    changes.

    The scan contains `SPECIAL_POINT_MEASURES` and margins. A change between its samples is
    unexplained if no curve is near it. `on_stage` is called with a description of each stage.
    """
    names = tuple(map(str, scan.outcome.dims))
    parameter_ranges = np.array(
        [(scan[name].values[0], scan[name].values[-1]) for name in names], float
    )
    tracer = CurveTracer(
        (names[0], names[1]),
        parameter_ranges,
        model,
        DEFAULT_CURVE_OPTIONS,
        StepOptions.tight(),
        on_stage,
    )
    seeds = find_seeds_on_middle_lines(tracer, params, options)
    curves = _trace_all(tracer, seeds, [], options)
    changes = find_sign_changes(scan, tracer.parameters)
    examined_changes: list[UnexplainedChange] = []
    remaining_changes = lambda: find_unexplained_changes(
        changes, [curve.curve for curve in curves], scan, options
    )
    for _ in range(options.max_search_rounds):
        new_changes = _select_distant_changes(remaining_changes(), examined_changes, options)
        if not new_changes:
            break
        examined_changes += new_changes
        seeds = []
        for axis in range(2):
            wheels = []
            for change in new_changes:
                if change.axis == axis:
                    indices = zip(tracer.parameters, change.sample, strict=True)
                    values = {
                        name: float(scan[name][change_index]) for name, change_index in indices
                    }
                    wheels.append(tracer.with_parameters(params, values))
            seeds += _find_seeds_on_branches(tracer, axis, wheels, options.n_lines)
        curves = _trace_all(tracer, seeds, curves, options)
    return tuple(curve.curve for curve in curves), tuple(remaining_changes())


def _trace_all(
    tracer: CurveTracer, seeds: list[CurveSeed], curves: list[TracedCurve], options: MapOptions
) -> list[TracedCurve]:
    """Return the curves, and those through the seeds and through special points on them."""
    for _ in range(options.n_meeting_rounds):
        new_curves = tracer.trace_curves(seeds, curves)
        known_curves = [
            curve
            for curve in curves
            if not any(tracer.is_same_curve(curve, new_curve) for new_curve in new_curves)
        ]
        curves = [*known_curves, *new_curves]
        seeds = [seed for curve in new_curves for seed in curve.new_seeds]
    return curves


def find_seeds_on_middle_lines(
    tracer: CurveTracer, params: WheelParams, options: MapOptions = MAP_OPTIONS
) -> list[CurveSeed]:
    """Return seeds on the branches through wheels on the middle lines of both ranges."""
    seeds, midpoints, n_lines = [], tracer.parameter_ranges.mean(1), options.n_lines
    for axis, name in enumerate(tracer.parameters):
        lower, upper = tracer.parameter_ranges[1 - axis]
        line_values = lower + (np.arange(n_lines) + 0.5) / n_lines * (upper - lower)
        other_parameter = tracer.parameters[1 - axis]
        wheels = [
            tracer.with_parameters(params, {name: midpoints[axis], other_parameter: coordinate})
            for coordinate in line_values
        ]
        seeds += _find_seeds_on_branches(tracer, axis, wheels, n_lines)
    return seeds


def _find_seeds_on_branches(
    tracer: CurveTracer, axis: int, wheels: list[WheelParams], batch_size: int
) -> list[CurveSeed]:
    """Return seeds on branches, which are continued in batches of one size so that one program
    is compiled.
    """
    seeds = []
    for first_wheel in range(0, len(wheels), batch_size):
        wheel_group = wheels[first_wheel : first_wheel + batch_size]
        padded_wheels = [*wheel_group, *wheel_group[-1:] * (batch_size - len(wheel_group))]
        seeds += tracer.find_seeds(axis, jax.tree.map(lambda *x: jnp.stack(x), *padded_wheels))
    return seeds


def _select_signed_quantities(scan: xr.Dataset, dims: tuple[str, str]) -> dict[str, np.ndarray]:
    """Return the quantities whose signs may change, as arrays over the two parameters."""
    quantities = {"lambda_4_plus": scan.lambda_4_plus.transpose(*dims).values}
    quantities[STABILITY_CHANGE] = 1.0 - scan[STABILITY_CHANGE].transpose(*dims).values
    for name in (name for name in MARGIN_MEASURES if name not in LINEAR_SUBSTITUTES):
        values = scan[name].transpose(*dims, ...).values
        leg_numbers = scan.leg.values if MARGIN_MEASURES[name].dimension else []
        quantities |= {f"{name}[{leg}]": values[..., i] for i, leg in enumerate(leg_numbers)}
        if not MARGIN_MEASURES[name].dimension:
            quantities[name] = values
    return quantities


def find_sign_changes(scan: xr.Dataset, dims: tuple[str, str]) -> list[UnexplainedChange]:
    """Return the changes of sign between all neighboring samples.

    Changes of measures count only if both samples, or none, have double support.
    """
    outcome = scan.outcome.transpose(*dims).values
    is_found, is_coarse = outcome == Outcome.STEPPED, outcome == Outcome.MESH_TOO_COARSE
    quantities, changes = _select_signed_quantities(scan, dims), []
    quantities[GAIT_CHANGE] = np.where(is_found, 1.0, np.where(is_coarse, np.nan, -1.0))
    quantities[COARSE_MESH_NAME] = np.where(is_found, 1.0, np.where(is_coarse, -1.0, np.nan))
    for axis in range(2):
        neighbor_indices = lambda x, axis=axis: (
            np.moveaxis(x, axis, 0)[:-1],
            np.moveaxis(x, axis, 0)[1:],
        )
        move_axis_first = lambda a, b, axis=axis: (a, b) if axis == 0 else (b, a)
        first_found, second_found = neighbor_indices(is_found)
        has_same_double_support = np.equal(*neighbor_indices(quantities["lambda_4_plus"] > 0.0))
        for name, quantity_values in quantities.items():
            first_values, second_values = neighbor_indices(quantity_values)
            changes_sign = first_values * second_values < 0.0
            if name not in (GAIT_CHANGE, COARSE_MESH_NAME):
                changes_sign &= (
                    first_found
                    & second_found
                    & (has_same_double_support | (name == "lambda_4_plus"))
                )
            for i, j in np.argwhere(changes_sign):
                fraction = first_values[i, j] / (first_values[i, j] - second_values[i, j])
                sample = move_axis_first(int(i if first_found[i, j] else i + 1), int(j))
                changes.append(
                    UnexplainedChange(
                        name, axis, sample, move_axis_first(float(i + fraction), float(j))
                    )
                )
    return changes


def find_unexplained_changes(
    changes: Sequence[UnexplainedChange],
    curves: Sequence[SpecialPointCurve],
    scan: xr.Dataset,
    options: MapOptions = MAP_OPTIONS,
) -> list[UnexplainedChange]:
    """Return the changes that are near no curve that can explain them."""
    remaining_changes = []
    for name in sorted({change.name for change in changes}):
        changes_of_name = [change for change in changes if change.name == name]
        explaining_curves = [
            curve for curve in curves if curve.name in EXPLAINING_CURVES.get(name, (name,))
        ]
        changes_in_cells = np.array([change.cell_position for change in changes_of_name])
        distances = np.full(len(changes_of_name), np.inf)
        for curve in explaining_curves:
            axes = zip(curve.values.T, curve.parameters, strict=True)
            curve_in_cells = [
                np.interp(values_of_axis, scan[n_samples].values, np.arange(scan.sizes[n_samples]))
                for values_of_axis, n_samples in axes
            ]
            distances = np.minimum(
                distances, distance_to_polyline(changes_in_cells, np.stack(curve_in_cells, -1))
            )
        remaining_changes += [
            change
            for change, distance_to_curve in zip(changes_of_name, distances, strict=True)
            if distance_to_curve > options.max_explained_distance
        ]
    return remaining_changes


def _select_distant_changes(
    remaining_changes: Sequence[UnexplainedChange],
    examined_changes: Sequence[UnexplainedChange],
    options: MapOptions,
) -> list[UnexplainedChange]:
    """Return changes of each name that are distant from each other and from the examined ones."""
    selected_changes: list[UnexplainedChange] = []
    for change in remaining_changes:
        changes_of_same_name = [
            other_change
            for other_change in (*examined_changes, *selected_changes)
            if (other_change.name, other_change.axis) == (change.name, change.axis)
        ]
        if all(
            np.hypot(*np.subtract(other_change.cell_position, change.cell_position))
            > options.min_change_distance
            for other_change in changes_of_same_name
        ):
            selected_changes.append(change)
    return selected_changes
