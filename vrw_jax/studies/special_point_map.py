"""Map of gaits over two parameters: a scan, and curves of special points between its samples."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from vrw_jax.base.checks import check_callable, check_names, check_type
from vrw_jax.base.lazy_xarray import xarray as xr
from vrw_jax.base.options import StepOptions
from vrw_jax.base.outcomes import Outcome
from vrw_jax.base.progress import announce_wait
from vrw_jax.branches.branch import SpecialPointCurve
from vrw_jax.branches.special_point_map import (
    SPECIAL_POINT_MEASURES,
    ScanSignChange,
    trace_special_points,
)
from vrw_jax.gaits.options import CycleOptions
from vrw_jax.models.registry import describe_accepted_models
from vrw_jax.models.stepping import ModelLike, convert_model_argument
from vrw_jax.studies.scan_design import AbstractSampleDesign
from vrw_jax.studies.scan_execution import ProgressCallback, scan
from vrw_jax.wheel.params import WheelParams


class SpecialPointMap(NamedTuple):
    """Gaits on a grid over two parameters, and all curves of special points between the samples.

    - `scan`: the gaits of the samples, as `vrw.scan` returns them;
    - `curves`: every curve, as `vrw.continue_special_point` returns it;
    - `unexplained_changes`: sign changes of a quantity between neighboring samples that no curve
      explains.

    Examples:
        >>> grid = vrw.grid(damping=[150.0, 180.0, 210.0], slope=[0.28, 0.29, 0.30])
        >>> special_points = vrw.map_special_points(grid)  # doctest: +SKIP
        >>> [curve.name for curve in special_points.curves]  # doctest: +SKIP
    """

    scan: xr.Dataset
    curves: tuple[SpecialPointCurve, ...]
    unexplained_changes: tuple[ScanSignChange, ...]

    @property
    def ending(self) -> str:
        """Return a sentence that states how many sign changes between samples no curve explains."""
        n_unexplained_changes = len(self.unexplained_changes)
        return (
            f"{n_unexplained_changes} changes of sign between neighboring samples have no curve "
            "nearby."
        )

    def __str__(self) -> str:
        text_lines = [self.ending]
        for sign_change in self.unexplained_changes:
            sample = self.scan.outcome[tuple(sign_change.sample_indices)]
            x, y = (float(sample[parameter_name]) for parameter_name in self.scan.outcome.dims)
            text_lines.append(f"    {sign_change.quantity_name} at ({x:.6g}, {y:.6g})")
        return "\n\n".join([*map(str, self.curves), "\n".join(text_lines)])

    def __repr__(self) -> str:
        return str(self)


@announce_wait("gaits and the second derivatives of special points", "120 s")
def map_special_points(
    design: AbstractSampleDesign,
    measures: str | Iterable[str] = ("dls_fraction",),
    *,
    base: WheelParams | None = None,
    model: ModelLike | None = None,
    options: StepOptions | None = None,
    cycle_options: CycleOptions | None = None,
    store: str | Path | None = None,
    on_progress: ProgressCallback | None = None,
    on_stage: Callable[[str], None] | None = None,
) -> SpecialPointMap:
    """Scan a grid over two parameters, and compute all curves of special points of its gaits.

    The command `vrw map` calls this function. Curves start on branches of gaits across the grid. A
    quantity may have different signs at neighboring samples although no curve runs between them.
    Branches through these samples are then searched for further curves.

    Args:
        design: a `vrw.grid` over two parameters with ascending values.
        measures: names of measures of the scan, in addition to those that the curves need. With
            "second_peak_rate", the map contains curves on which a second force peak appears.
        base: wheel with the parameters that are not swept; by default that of Table 1 of the
            paper.
        model: a `ViscoelasticWheel`, which is the default.
        options: numerical options of the gait steps that check the gaits of the scan.
        cycle_options: numerical options of the gait search of the scan.
        store: local folder to which the scan is written.
        on_progress: function that is called with the `ScanProgress` after each chunk.
        on_stage: function that is called with a description of each stage after the scan.

    Returns:
        A `SpecialPointMap`. `vrw.plot.map_figure` draws its scan and curves.

    Raises:
        TypeError, ValueError: if an argument is invalid, or if no sample has a gait.

    Examples:
        >>> grid = vrw.grid(damping=[150.0, 180.0, 210.0], slope=[0.28, 0.29, 0.30])
        >>> special_points = vrw.map_special_points(grid, "speed")  # doctest: +SKIP
        >>> figure = vrw.plot.map_figure(
        ...     special_points.scan, "speed", special_points.curves
        ... )  # doctest: +SKIP
    """
    check_type("design", design, AbstractSampleDesign, "give vrw.grid(damping=[...], slope=[...])")
    require_map_grid(design)
    if on_stage is not None:
        check_callable("on_stage", on_stage, "that takes a sentence")
    wheel_model: Any = convert_model_argument(model)
    if "map" not in wheel_model.commands:
        raise ValueError(
            f"model is {type(wheel_model).__name__}, but special points are mapped for "
            f"{describe_accepted_models('map')}: give that."
        )
    scanned_samples = scan(
        design,
        tuple(dict.fromkeys((*check_names("measures", measures), *SPECIAL_POINT_MEASURES))),
        base=base,
        model=wheel_model,
        options=options,
        cycle_options=cycle_options,
        store=store,
        on_progress=on_progress,
    )
    return follow_special_points(
        scanned_samples, WheelParams() if base is None else base, wheel_model, on_stage
    )


def follow_special_points(
    scanned_samples: xr.Dataset,
    base_wheel: WheelParams,
    wheel_model: Any,
    on_stage: Callable[[str], None] | None,
) -> SpecialPointMap:
    """Return the map of special points over the two parameters of a scan.

    - `scanned_samples`: dataset of the scan, which must contain the measures that define special
      points;
    - `on_stage`: function that is called with a description of each stage.
    """
    if not np.any(scanned_samples.outcome.values == Outcome.STEPPED):
        raise ValueError("no gait was found on the grid: choose another.")
    return SpecialPointMap(
        scanned_samples, *trace_special_points(scanned_samples, base_wheel, wheel_model, on_stage)
    )


def require_map_grid(design: AbstractSampleDesign) -> None:
    """Raise a ValueError if the design is not a grid over two parameters with ascending values."""
    if len(design.shape) != 2:
        raise ValueError(
            f"the design sweeps {', '.join(design.swept_parameters)}, but a map is a grid over two "
            "parameters: sweep two below [grid], or in vrw.grid."
        )
    for parameter_name in design.swept_parameters:
        parameter_values = design.values_by_parameter[parameter_name]
        if len(parameter_values) < 2 or not np.all(np.diff(parameter_values) > 0.0):
            raise ValueError(
                f"{parameter_name} has the values {parameter_values.tolist()}, but each side of "
                "a map has at least two ascending ones: sort them, or give more."
            )
