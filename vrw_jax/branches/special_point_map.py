"""Map all special points of gaits in two parameters, and check the map against a scan.

If a quantity has opposite signs at neighboring samples of a scan, a curve of special points lies
between the samples. A curve that is not traced yet is found on branches through these samples.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vrw_jax.base.lazy_xarray import xarray as xr
from vrw_jax.base.options import StepOptions
from vrw_jax.base.outcomes import Outcome
from vrw_jax.branches.branch import SpecialPointCurve
from vrw_jax.branches.branch_location import COARSE_MESH_END_NAME
from vrw_jax.branches.continuation import BRANCH_ENDING_QUANTITIES, SECOND_PEAK_RATE_NAME
from vrw_jax.branches.curve_problems import DLS_VANISHING_NAME, LINEAR_MARGIN_SUBSTITUTES
from vrw_jax.branches.curve_tracing import (
    DEFAULT_CURVE_OPTIONS,
    CurveSeed,
    CurveTracer,
    TracedCurve,
    compute_distances_to_polyline,
)
from vrw_jax.branches.test_functions import BIFURCATIONS
from vrw_jax.lanes.settings import with_default_jax_settings
from vrw_jax.models.measures import MARGIN_MEASURES
from vrw_jax.models.viscoelastic import ViscoelasticWheel
from vrw_jax.wheel.params import WheelParams

GAIT_CHANGE_NAME = "gait"
"""Name of the change between a sample with a gait and a sample without a gait."""

STABILITY_CHANGE_NAME = "spectral_radius"
"""Name of the change between a stable and an unstable gait."""

SPECIAL_POINT_MEASURES = ("lambda_4_plus", STABILITY_CHANGE_NAME)
"""Names of the measures of a scan that vanish or cross 1 at special points, in addition to the
margins.
"""

EXPLAINING_CURVE_NAMES: Mapping[str, tuple[str, ...]] = {
    GAIT_CHANGE_NAME: (*BRANCH_ENDING_QUANTITIES, *BIFURCATIONS),
    STABILITY_CHANGE_NAME: tuple(BIFURCATIONS),
    "lambda_4_plus": ("lambda_4_plus", DLS_VANISHING_NAME),
    **{
        substitute_name: (margin_name,)
        for margin_name, substitute_name in LINEAR_MARGIN_SUBSTITUTES.items()
    },
}
"""Names of the curves that explain a sign change, by the name of the quantity.

By default the curve with the name of the quantity explains the change.
"""


# Smallest distance between examined sign changes, in cells of the scan.
MIN_DISTANCE_TO_EXAMINED = 5.0


class ScanSignChange(NamedTuple):
    """Sign change of a quantity between two neighboring samples of a scan."""

    quantity_name: str
    parameter_index: int
    sample_indices: tuple[int, int]  # indices of the first sample, which has a gait
    scan_position_in_cells: tuple[float, float]  # position of the change in each parameter

    def is_near(self, other: "ScanSignChange") -> bool:
        """Return whether another sign change is one of the same quantity and near this one."""
        return (
            self.quantity_name == other.quantity_name
            and self.parameter_index == other.parameter_index
            and math.dist(self.scan_position_in_cells, other.scan_position_in_cells)
            <= MIN_DISTANCE_TO_EXAMINED
        )


# Number of parallel branches in each parameter, from which the map starts.
N_PARALLEL_BRANCHES = 5
# Largest number of rounds in which sign changes are examined.
MAX_SEARCH_ROUNDS = 8


@with_default_jax_settings
def trace_special_points(
    scan_dataset: xr.Dataset,
    params: WheelParams,
    model: ViscoelasticWheel,
    on_stage: Callable[[str], None] | None,
) -> tuple[tuple[SpecialPointCurve, ...], tuple[ScanSignChange, ...]]:
    """Trace the curves of special points in the two parameters of a scan.

    Return the curves, and the sign changes that no curve explains. The scan contains
    `SPECIAL_POINT_MEASURES` and margins. If it contains "second_peak_rate", the curves on which a
    second force peak appears are also traced. A sign change between two samples is unexplained if
    no curve is near it. `on_stage` is called with a description of each stage.
    """
    parameter_names = tuple(map(str, scan_dataset.outcome.dims))
    parameter_ranges = np.array(
        [scan_dataset[parameter_name].values[[0, -1]] for parameter_name in parameter_names], float
    )
    curve_tracer = CurveTracer(
        (parameter_names[0], parameter_names[1]),
        parameter_ranges,
        model,
        DEFAULT_CURVE_OPTIONS,
        StepOptions.tight(),
        on_stage,
        measures_force_peaks=SECOND_PEAK_RATE_NAME in scan_dataset,
    )
    curve_seeds = find_seeds_on_parallel_lines(curve_tracer, params)
    traced_curves = _trace_curves_and_meetings(curve_tracer, curve_seeds, [])
    sign_changes = find_sign_changes_in_scan(scan_dataset, curve_tracer.parameter_names)
    examined_sign_changes: list[ScanSignChange] = []
    find_remaining_sign_changes = lambda: find_unexplained_sign_changes(
        sign_changes,
        [traced_curve.special_point_curve for traced_curve in traced_curves],
        scan_dataset,
    )
    for _ in range(MAX_SEARCH_ROUNDS):
        new_sign_changes: list[ScanSignChange] = []
        for sign_change in find_remaining_sign_changes():
            if not any(map(sign_change.is_near, (*examined_sign_changes, *new_sign_changes))):
                new_sign_changes.append(sign_change)
        if not new_sign_changes:
            break
        examined_sign_changes += new_sign_changes
        curve_seeds = []
        for parameter_index in range(2):
            wheels_beside_sign_change = [
                curve_tracer.with_parameters(
                    params,
                    [
                        float(scan_dataset[parameter_name][sample_index])
                        for parameter_name, sample_index in zip(
                            curve_tracer.parameter_names, sign_change.sample_indices, strict=True
                        )
                    ],
                )
                for sign_change in new_sign_changes
                if sign_change.parameter_index == parameter_index
            ]
            curve_seeds += _find_seeds_in_batches(
                curve_tracer,
                parameter_index,
                wheels_beside_sign_change,
                N_PARALLEL_BRANCHES,
            )
        traced_curves = _trace_curves_and_meetings(curve_tracer, curve_seeds, traced_curves)
    return tuple(traced_curve.special_point_curve for traced_curve in traced_curves), tuple(
        find_remaining_sign_changes()
    )


# Number of rounds in which special points on new curves are continued.
N_MEETING_ROUNDS = 3


def _trace_curves_and_meetings(
    curve_tracer: CurveTracer,
    curve_seeds: list[CurveSeed],
    traced_curves: list[TracedCurve],
) -> list[TracedCurve]:
    """Trace the curves through the seeds, and the curves through special points on new curves.

    Return these curves together with the known curves.
    """
    for _ in range(N_MEETING_ROUNDS):
        new_curves = curve_tracer.trace_curves(curve_seeds, traced_curves)
        known_curves = [
            traced_curve
            for traced_curve in traced_curves
            if not any(
                curve_tracer.are_same_curve(traced_curve, new_curve) for new_curve in new_curves
            )
        ]
        traced_curves = [*known_curves, *new_curves]
        curve_seeds = [
            curve_seed for traced_curve in new_curves for curve_seed in traced_curve.meeting_seeds
        ]
    return traced_curves


def find_seeds_on_parallel_lines(
    curve_tracer: CurveTracer,
    params: WheelParams,
) -> list[CurveSeed]:
    """Find seeds on parallel branches in each of the two parameters.

    A branch in one parameter starts at the middle of that parameter's range. The branches differ by
    evenly spaced values of the other parameter.
    """
    curve_seeds = []
    for parameter_index in range(2):
        lower_bound, upper_bound = curve_tracer.parameter_ranges[1 - parameter_index]
        line_parameter_values = lower_bound + (
            np.arange(N_PARALLEL_BRANCHES) + 0.5
        ) / N_PARALLEL_BRANCHES * (upper_bound - lower_bound)
        start_values = np.empty((N_PARALLEL_BRANCHES, 2))
        start_values[:, parameter_index] = curve_tracer.parameter_ranges[parameter_index].mean()
        start_values[:, 1 - parameter_index] = line_parameter_values
        wheels_on_line = [
            curve_tracer.with_parameters(params, start_values_on_line)
            for start_values_on_line in start_values
        ]
        curve_seeds += _find_seeds_in_batches(
            curve_tracer, parameter_index, wheels_on_line, N_PARALLEL_BRANCHES
        )
    return curve_seeds


def _find_seeds_in_batches(
    curve_tracer: CurveTracer, parameter_index: int, wheels: list[WheelParams], batch_size: int
) -> list[CurveSeed]:
    """Find seeds on the wheels' branches, which are continued in batches of the same size.

    A single size needs only one compiled program.
    """
    curve_seeds = []
    for first_wheel_index in range(0, len(wheels), batch_size):
        wheels_of_batch = wheels[first_wheel_index : first_wheel_index + batch_size]
        padded_wheels = [
            *wheels_of_batch,
            *wheels_of_batch[-1:] * (batch_size - len(wheels_of_batch)),
        ]
        curve_seeds += curve_tracer.find_seeds(
            parameter_index, jax.tree.map(lambda *x: jnp.stack(x), *padded_wheels)
        )
    return curve_seeds


def find_sign_changes_in_scan(
    scan_dataset: xr.Dataset, parameter_names: tuple[str, str]
) -> list[ScanSignChange]:
    """Return the sign changes of all quantities between neighboring samples.

    A sign change of a measure is ignored if exactly one of the two samples has double support.
    """
    scan_dataset = scan_dataset.transpose(*parameter_names, ...)
    has_gait_at_sample = scan_dataset.outcome.values == Outcome.STEPPED
    has_coarse_mesh_at_sample = scan_dataset.outcome.values == Outcome.MESH_TOO_COARSE
    signed_quantities = {STABILITY_CHANGE_NAME: 1.0 - scan_dataset[STABILITY_CHANGE_NAME].values}
    margin_names = [name for name in MARGIN_MEASURES if name not in LINEAR_MARGIN_SUBSTITUTES]
    peak_names = [SECOND_PEAK_RATE_NAME] if SECOND_PEAK_RATE_NAME in scan_dataset else []
    for measure_name in ("lambda_4_plus", *peak_names, *margin_names):
        measure = scan_dataset[measure_name]
        if "leg" in measure.dims:
            signed_quantities |= {
                f"{measure_name}[{leg_number}]": measure.values[..., i]
                for i, leg_number in enumerate(scan_dataset.leg.values)
            }
        else:
            signed_quantities[measure_name] = measure.values
    signed_quantities[GAIT_CHANGE_NAME] = np.where(
        has_gait_at_sample, 1.0, np.where(has_coarse_mesh_at_sample, np.nan, -1.0)
    )
    signed_quantities[COARSE_MESH_END_NAME] = np.where(
        has_gait_at_sample, 1.0, np.where(has_coarse_mesh_at_sample, -1.0, np.nan)
    )
    sign_changes = []
    for parameter_index in range(2):
        get_neighbor_values = lambda x, parameter_index=parameter_index: (
            np.moveaxis(x, parameter_index, 0)[:-1],
            np.moveaxis(x, parameter_index, 0)[1:],
        )
        has_first_sample_gait, has_second_sample_gait = get_neighbor_values(has_gait_at_sample)
        has_same_double_support = np.equal(
            *get_neighbor_values(signed_quantities["lambda_4_plus"] > 0.0)
        )
        for quantity_name, quantity_values in signed_quantities.items():
            first_sample_values, second_sample_values = get_neighbor_values(quantity_values)
            has_sign_change = first_sample_values * second_sample_values < 0.0
            if quantity_name not in (GAIT_CHANGE_NAME, COARSE_MESH_END_NAME):
                has_sign_change &= (
                    has_first_sample_gait
                    & has_second_sample_gait
                    & (has_same_double_support | (quantity_name == "lambda_4_plus"))
                )
            for i, j in np.argwhere(has_sign_change).tolist():
                sign_change_fraction = first_sample_values[i, j] / (
                    first_sample_values[i, j] - second_sample_values[i, j]
                )
                sample_indices = (i if has_first_sample_gait[i, j] else i + 1), j
                position_in_cells = float(i + sign_change_fraction), float(j)
                if parameter_index == 1:  # The first index is that of the second parameter.
                    sample_indices = sample_indices[::-1]
                    position_in_cells = position_in_cells[::-1]
                sign_changes.append(
                    ScanSignChange(
                        quantity_name, parameter_index, sample_indices, position_in_cells
                    )
                )
    return sign_changes


# Largest distance of a sign change from a curve that explains it, in cells of the scan.
MAX_DISTANCE_TO_EXPLAINING_CURVE = 1.0


def find_unexplained_sign_changes(
    sign_changes: Sequence[ScanSignChange],
    special_point_curves: Sequence[SpecialPointCurve],
    scan_dataset: xr.Dataset,
) -> list[ScanSignChange]:
    """Return the sign changes that are not near any curve that explains them."""
    unexplained_sign_changes = []
    for quantity_name in sorted({sign_change.quantity_name for sign_change in sign_changes}):
        sign_changes_of_quantity = [
            sign_change
            for sign_change in sign_changes
            if sign_change.quantity_name == quantity_name
        ]
        explaining_names = EXPLAINING_CURVE_NAMES.get(quantity_name, (quantity_name,))
        sign_change_positions = np.array(
            [sign_change.scan_position_in_cells for sign_change in sign_changes_of_quantity]
        )
        curve_distances = np.full(len(sign_changes_of_quantity), np.inf)
        for special_point_curve in special_point_curves:
            if special_point_curve.name not in explaining_names:
                continue
            curve_positions = [
                np.interp(
                    special_point_curve.dataset[parameter_name].values,
                    scan_dataset[parameter_name].values,
                    np.arange(scan_dataset.sizes[parameter_name]),
                )
                for parameter_name in special_point_curve.parameters
            ]
            curve_distances = np.minimum(
                curve_distances,
                compute_distances_to_polyline(sign_change_positions, np.stack(curve_positions, -1)),
            )
        unexplained_sign_changes += [
            sign_change
            for sign_change, curve_distance in zip(
                sign_changes_of_quantity, curve_distances, strict=True
            )
            if curve_distance > MAX_DISTANCE_TO_EXPLAINING_CURVE
        ]
    return unexplained_sign_changes
