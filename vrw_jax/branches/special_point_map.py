"""Map of all special points of gaits over two parameters, with a check against a scan.

If a quantity has different signs at neighboring samples of a scan, a curve of special points runs
between them. If no traced curve does, branches through these samples find it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
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
    distance_to_path,
)
from vrw_jax.branches.gait_test_functions import DLS_VANISHES, LINEAR_SUBSTITUTES
from vrw_jax.continuation import BIFURCATION_NAMES
from vrw_jax.measures import MARGIN_MEASURES
from vrw_jax.models import ViscoelasticWheel
from vrw_jax.numerics import StepOptions
from vrw_jax.runtime import with_default_settings
from vrw_jax.runtime import xarray as xr
from vrw_jax.wheel import Outcome, WheelParams

MAX_MEETING_ROUNDS = 3
"""Number of rounds in which special points met on the curves are continued in turn."""

N_LINES = 5
"""Number of parallel branches along each parameter on which a map starts."""

MAX_EXPLAINED_DISTANCE, MIN_CHANGE_DISTANCE = 1.0, 5.0
"""Distances in cells of the scan. The first is the largest one of a change of sign from a curve
that explains it. The second is the smallest one between changes that are examined in the same
round."""

MAX_SEARCH_ROUNDS = 8
"""Largest number of rounds in which changes of sign are examined."""

GAIT_CHANGE, STABILITY_CHANGE = "gait", "spectral_radius"
"""Names of changes between a gait and none, and between a stable and an unstable gait."""

SPECIAL_POINT_MEASURES = ("lambda_4_plus", STABILITY_CHANGE)
"""Measures of a scan that indicate special points, in addition to the margins that every scan
has."""

EXPLAINING_CURVES: Mapping[str, tuple[str, ...]] = {
    GAIT_CHANGE: (*BRANCH_ENDING_QUANTITIES, *BIFURCATION_NAMES),
    STABILITY_CHANGE: BIFURCATION_NAMES,
    "lambda_4_plus": ("lambda_4_plus", DLS_VANISHES),
    **{exact: (name,) for name, exact in LINEAR_SUBSTITUTES.items()},
}
"""Names of the curves that explain a change, if it is not the curve of the same name."""


class UnexplainedChange(NamedTuple):
    """Change of sign between two neighboring samples of a scan."""

    name: str
    axis: int
    sample: tuple[int, int]  # first sample, with a gait
    cell_position: tuple[float, float]  # in cells of the scan


@with_default_settings
def trace_special_points(
    scan: xr.Dataset,
    params: WheelParams,
    model: ViscoelasticWheel,
    on_stage: Callable[[str], None] | None = None,
) -> tuple[tuple[SpecialPointCurve, ...], tuple[UnexplainedChange, ...]]:
    """Return all curves of special points over the two parameters of a scan.

    The scan contains `SPECIAL_POINT_MEASURES` and margins. Return also the changes between its
    samples that no curve explains. `on_stage` is called with a description of each stage.
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
    curves = _trace_all(tracer, find_seeds_on_middle_lines(tracer, params), [])
    changes = find_sign_change_cells(scan, tracer.parameters)
    examined: list[UnexplainedChange] = []
    remaining_changes = lambda: find_unexplained_changes(
        changes, [curve.curve for curve in curves], scan
    )
    for _ in range(MAX_SEARCH_ROUNDS):
        new_changes = _thin_changes(remaining_changes(), examined)
        if not new_changes:
            break
        examined += new_changes
        curves = _trace_all(
            tracer, _find_seeds_at_changes(tracer, params, scan, new_changes), curves
        )
    return tuple(curve.curve for curve in curves), tuple(remaining_changes())


def _trace_all(
    tracer: CurveTracer, seeds: list[CurveSeed], curves: list[TracedCurve]
) -> list[TracedCurve]:
    """Return the known curves, the curves through the seeds, and the curves through special points
    on these."""
    for _ in range(MAX_MEETING_ROUNDS):
        new_curves = tracer.trace_curves(seeds, curves)
        kept_curves = [
            curve
            for curve in curves
            if not any(tracer.is_same_curve(curve, new_curve) for new_curve in new_curves)
        ]
        curves, seeds = (
            [*kept_curves, *new_curves],
            [seed for curve in new_curves for seed in curve.new_seeds],
        )
    return curves


def find_seeds_on_middle_lines(tracer: CurveTracer, params: WheelParams) -> list[CurveSeed]:
    """Return seeds on the branches through wheels on the middle lines of the box."""
    seeds, midpoints = [], tracer.parameter_ranges.mean(1)
    for axis, name in enumerate(tracer.parameters):
        lower, upper = tracer.parameter_ranges[1 - axis]
        line_values = lower + (np.arange(N_LINES) + 0.5) / N_LINES * (upper - lower)
        other_parameter = tracer.parameters[1 - axis]
        wheels = [
            tracer.with_parameters(params, {name: midpoints[axis], other_parameter: x})
            for x in line_values
        ]
        seeds += _find_seeds_on_branches(tracer, axis, wheels)
    return seeds


def _find_seeds_on_branches(
    tracer: CurveTracer, axis: int, wheels: list[WheelParams]
) -> list[CurveSeed]:
    """Return seeds on branches, always the same number side by side, so that they are compiled
    once."""
    seeds = []
    for group_start in range(0, len(wheels), N_LINES):
        group = wheels[group_start : group_start + N_LINES]
        padded_group = [*group, *group[-1:] * (N_LINES - len(group))]
        seeds += tracer.find_seeds(axis, jax.tree.map(lambda *x: jnp.stack(x), *padded_group))
    return seeds


def _find_seeds_at_changes(
    tracer: CurveTracer, params: WheelParams, scan: xr.Dataset, changes: Sequence[UnexplainedChange]
) -> list[CurveSeed]:
    """Return seeds on branches through the samples at which changes begin."""
    seeds = []
    for axis in range(2):
        changes_on_axis = [change for change in changes if change.axis == axis]
        sample_values = [{n: float(scan[n][i]) for n, i in zip(tracer.parameters, c.sample,
            strict=True)}
              for c in changes_on_axis]  # fmt: skip
        seeds += _find_seeds_on_branches(
            tracer, axis, [tracer.with_parameters(params, values) for values in sample_values]
        )
    return seeds


def _signed_quantities(scan: xr.Dataset, dims: tuple[str, str]) -> dict[str, np.ndarray]:
    """Return the quantities whose signs may change, over the two parameters."""
    quantities = {"lambda_4_plus": scan.lambda_4_plus.transpose(*dims).values}
    quantities[STABILITY_CHANGE] = 1.0 - scan[STABILITY_CHANGE].transpose(*dims).values
    for name in (name for name in MARGIN_MEASURES if name not in LINEAR_SUBSTITUTES):
        values = scan[name].transpose(*dims, ...).values
        leg_numbers = scan.leg.values if MARGIN_MEASURES[name].dimension else []
        quantities |= {f"{name}[{leg}]": values[..., i] for i, leg in enumerate(leg_numbers)}
        if not MARGIN_MEASURES[name].dimension:
            quantities[name] = values
    return quantities


def find_sign_change_cells(scan: xr.Dataset, dims: tuple[str, str]) -> list[UnexplainedChange]:
    """Return the changes between all neighbors. Both samples, or none, must have double support."""
    outcome = scan.outcome.transpose(*dims).values
    is_found, is_coarse = outcome == Outcome.STEPPED, outcome == Outcome.MESH_TOO_COARSE
    quantities, changes = _signed_quantities(scan, dims), []
    quantities[GAIT_CHANGE] = np.where(is_found, 1.0, np.where(is_coarse, np.nan, -1.0))
    quantities[COARSE_MESH_NAME] = np.where(is_found, 1.0, np.where(is_coarse, -1.0, np.nan))
    for axis in range(2):
        neighbors = lambda x, axis=axis: (np.moveaxis(x, axis, 0)[:-1], np.moveaxis(x, axis, 0)[1:])
        in_axis_order = lambda a, b, axis=axis: (a, b) if axis == 0 else (b, a)
        first_found, second_found = neighbors(is_found)
        same_dls = np.equal(*neighbors(quantities["lambda_4_plus"] > 0.0))
        for name, quantity_values in quantities.items():
            first_values, second_values = neighbors(quantity_values)
            changes_sign = first_values * second_values < 0.0
            if name not in (GAIT_CHANGE, COARSE_MESH_NAME):
                changes_sign &= first_found & second_found & (same_dls | (name == "lambda_4_plus"))
            for i, j in np.argwhere(changes_sign):
                fraction = first_values[i, j] / (first_values[i, j] - second_values[i, j])
                sample = in_axis_order(int(i if first_found[i, j] else i + 1), int(j))
                changes.append(
                    UnexplainedChange(
                        name, axis, sample, in_axis_order(float(i + fraction), float(j))
                    )
                )
    return changes


def find_unexplained_changes(
    changes: Sequence[UnexplainedChange], curves: Sequence[SpecialPointCurve], scan: xr.Dataset
) -> list[UnexplainedChange]:
    """Return the changes that are not near any curve that could explain them."""
    remaining = []
    for name in sorted({change.name for change in changes}):
        changes_of_name = [change for change in changes if change.name == name]
        explaining_curves = [
            curve for curve in curves if curve.name in EXPLAINING_CURVES.get(name, (name,))
        ]
        change_cells, distances = (
            np.array([change.cell_position for change in changes_of_name]),
            np.full(len(changes_of_name), np.inf),
        )
        for curve in explaining_curves:
            axes = zip(curve.values.T, curve.parameters, strict=True)
            curve_cells = [np.interp(v, scan[n].values, np.arange(scan.sizes[n])) for v, n in axes]
            distances = np.minimum(
                distances, distance_to_path(change_cells, np.stack(curve_cells, -1))
            )
        remaining += [
            change
            for change, distance_to_curve in zip(changes_of_name, distances, strict=True)
            if distance_to_curve > MAX_EXPLAINED_DISTANCE
        ]
    return remaining


def _thin_changes(
    remaining: Sequence[UnexplainedChange], examined: Sequence[UnexplainedChange]
) -> list[UnexplainedChange]:
    """Return changes of each name that are apart from each other and from those examined before."""
    selected: list[UnexplainedChange] = []
    for change in remaining:
        similar = [
            other_change
            for other_change in (*examined, *selected)
            if (other_change.name, other_change.axis) == (change.name, change.axis)
        ]
        if all(
            np.hypot(*np.subtract(other_change.cell_position, change.cell_position))
            > MIN_CHANGE_DISTANCE
            for other_change in similar
        ):
            selected.append(change)
    return selected
