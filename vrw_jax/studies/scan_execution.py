"""Execution of a scan: its chunks are computed, written and returned as one labeled dataset.

A scan is divided into chunks of samples, which the same compiled function computes. If a store is
given, each chunk is written as soon as it is computed. An interrupted scan continues with the
missing chunks. A forecast measures time and memory while some samples are computed. A map of
special points is a scan over two parameters, with curves between its samples.
"""

from __future__ import annotations

import contextlib
import errno
import math
import sys
import warnings
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np

from vrw_jax import lanes
from vrw_jax.base.checks import check_callable, check_names, check_path, check_type
from vrw_jax.base.lazy_xarray import xarray as xr
from vrw_jax.base.measures import Measure
from vrw_jax.base.options import StepOptions
from vrw_jax.base.outcomes import NoGaitError, Outcome
from vrw_jax.base.progress import announce_wait, report_progress
from vrw_jax.branches.branch import SpecialPointCurve
from vrw_jax.branches.special_point_curves import (
    SPECIAL_POINT_MEASURES,
    ScanSignChange,
    trace_special_points,
)
from vrw_jax.gaits.options import CycleOptions
from vrw_jax.lanes.settings import with_default_jax_settings
from vrw_jax.models.ladder import describe_accepted_models
from vrw_jax.models.stepping import ModelLike, convert_model_argument
from vrw_jax.studies.scan_design import MANIFEST_ATTRIBUTE, ParameterSamples, SampleDesign
from vrw_jax.studies.scan_planning import (
    PROVENANCE_ATTRIBUTE,
    ChunkExecutor,
    ChunkResult,
    ScanPlan,
    describe_computing_environment,
    describe_settings_difference,
    plan_scan,
)
from vrw_jax.studies.scan_store import (
    MemoryResultStore,
    ResultStore,
    ZarrResultStore,
    create_empty_store,
    read_stored_manifest,
)
from vrw_jax.wheel.params import WheelParams

ProgressCallback = Callable[["ScanProgress"], None]
"""Function that is called with the progress of a scan after each chunk."""


@dataclass(frozen=True)
class ScanProgress:
    """Progress of a scan, measured in samples."""

    n_samples: int  # samples to compute in this run
    n_done: int  # samples computed in this run
    n_failed: int  # computed samples without a steady gait
    n_reused: int  # samples that an earlier run computed


@with_default_jax_settings
@announce_wait("batches of gaits and gait steps", "15 s")
def scan(
    design: SampleDesign,
    measures: Iterable[str | Measure] | Measure | None = None,
    *,
    base: Any = None,
    model: ModelLike | None = None,
    options: StepOptions | None = None,
    cycle_options: CycleOptions | None = None,
    store: str | Path | None = None,
    chunk: int | None = None,
    on_progress: ProgressCallback | None = None,
    dask: str | None = None,
    tol: float | None = None,
    slope_sd: float | None = None,
) -> xr.Dataset:
    """Return outcome, margins and measures of the steady gait for every sample, as a labeled
    dataset.

    `measures` are names (see `vrw_jax.studies.measure_catalog`), including derivatives such as
    'd dls_fraction / d damping'. The variables of the dataset have these names and this order. The
    result for a sample depends neither on other samples nor on `chunk`.

    If `store` is given, the result is written there chunk by chunk. An interrupted scan continues
    where it stopped and ends with bitwise the same data. A finished scan is only opened, but its
    damaged chunks are computed again, with a warning.

    `model` may be a `UnilateralWheel`, whose gaits are computed by walks. `model` may also be
    "auto", which selects the simplest valid model for each sample. Then the dataset also contains
    `rung`, the code of the model, and `reason`, the code of the reason for the choice of the model.
    With `UnilateralWheel` and "auto", `friction` may be a swept parameter.

    For a walker of yours, which needs `starts`, the design has the names of its parameters, with
    dots if they are nested. The measures are the period, the section coordinates and its own
    `measures`. A store belongs to the code of the walker and to the static fields of its
    parameters.

    Args:
        design: the samples, from `grid`, `samples`, `sobol`, `uniform` or `saltelli`.
        measures: names of the measures, or measures of your own, see `vrw.measure`; by default DLS
            fraction, speed and similar measures.
        base: wheel with the parameters that are not swept; by default that of Table 1 of the
            paper. For a walker of yours, its parameters.
        model: model of the wheel; "auto" for the simplest valid model for each sample.
        options: numerical options of the gait steps that check the gaits, and of walks over random
            slopes. With `tol`, they cannot be given.
        cycle_options: numerical options of the search for gaits. By default, the mesh of each
            sample is refined until its gait is accurate, and otherwise the mesh is fixed.
        store: local folder to which the result is written, not a URL; may begin with `~`.
        chunk: number of samples that are written at a time; 4,096 by default.
        on_progress: function that is called with the `ScanProgress` after each chunk.
        dask: address of a dask cluster that computes the chunks, or "local" to start one.
        tol: permitted error of each measure, in its unit, with respect to a `UnilateralWheel`. Each
            sample is computed with the simplest model whose error bound is within `tol` (see
            `vrw.measure_to_tolerance`). The dataset also contains `rung`, the code of that model,
            and the errors of the measures, such as `speed_error`.
        slope_sd: standard deviation of random slopes, rad. If it is given, "mean_steps",
            "mean_steps_error" and "failure_probability" are additional measures (see
            `vrw.first_passage`). A sample then takes about a second, and by default 16 samples are
            written at a time.

    Returns:
        A dataset whose dimensions are the axes of the design.

    Raises:
        TypeError, ValueError: if an argument is invalid, or if the store contains another scan or
            is locked by another process; the message names the remedy.

    Examples:
        >>> gaits = vrw.scan(vrw.grid(damping=[150.0, 300.0]), ["speed"])
        >>> gaits.speed.round(3).values.tolist(), gaits.outcome.values.tolist()
        ([1.018, nan], [0, 14])
    """
    if store is not None:
        store = check_path("store", store, "give the folder to keep the result in")
    if on_progress is not None:
        check_callable("on_progress", on_progress, "that takes the progress")
    scan_plan = plan_scan(
        design,
        measures,
        base=base,
        model=model,
        options=options,
        cycle_options=cycle_options,
        chunk=chunk,
        tol=tol,
        slope_sd=slope_sd,
    )
    with resolve_executor(dask) as chunk_executor:
        return run_scan(scan_plan, store, on_progress=on_progress, chunk_executor=chunk_executor)


def resolve_executor(dask: str | None) -> contextlib.AbstractContextManager[ChunkExecutor | None]:
    """Return a context that provides an executor on a dask cluster, or None if `dask` is None.

    With None, the chunks are computed in this process.
    """
    if dask is None:
        return contextlib.nullcontext()
    from vrw_jax.studies.scan_dask import connect_dask_workers

    return connect_dask_workers(dask)


@with_default_jax_settings
def run_scan(
    scan_plan: ScanPlan,
    store: str | Path | ResultStore | None,
    *,
    on_progress: ProgressCallback | None = None,
    chunk_executor: ChunkExecutor | None = None,
) -> xr.Dataset:
    """Compute a scan plan, and return its results as a labeled dataset.

    - `store`: store or folder to which the results are written; with None they stay in memory;
    - `chunk_executor`: function that computes the chunks; by default this process computes them.
    """
    if isinstance(store, ResultStore):
        result_store = store
    elif store is None:
        result_store = MemoryResultStore(scan_plan.result_layout, scan_plan.store_attributes)
    else:
        result_store = open_or_create_store(scan_plan, Path(store))
        if result_store.damage_description:
            warnings.warn(f"{result_store.damage_description}: computed again.", stacklevel=3)
    if result_store.damage_description or result_store.find_missing_chunks():
        with result_store.open_for_writing():
            _compute_and_write_chunks(scan_plan, result_store, on_progress, chunk_executor)
    return result_store.load_dataset()


def _compute_and_write_chunks(
    scan_plan: ScanPlan,
    result_store: ResultStore,
    on_progress: ProgressCallback | None,
    chunk_executor: ChunkExecutor | None,
) -> None:
    """Compute the missing chunks, write each chunk to the store, and report the progress after each
    chunk.
    """
    missing_chunks = result_store.find_missing_chunks()
    chunk_shapes = {
        chunk_index: scan_plan.result_layout.compute_chunk_sample_shape(chunk_index)
        for chunk_index in missing_chunks
    }
    n_samples = sum(map(math.prod, chunk_shapes.values()))
    scan_progress = ScanProgress(n_samples, 0, 0, scan_plan.design.size - n_samples)
    n_chunks = scan_plan.result_layout.n_chunks
    if on_progress is not None:
        on_progress(scan_progress)
    try:
        if chunk_executor is None:
            scan_engine = scan_plan.build_scan_engine()
            computed_chunks: Iterable[ChunkResult] = (
                (chunk_index, scan_engine(scan_plan.select_chunk_samples(chunk_index)))
                for chunk_index in missing_chunks
            )
        else:
            computed_chunks = chunk_executor(scan_plan, missing_chunks)
        for chunk_index, flat_chunk_results in computed_chunks:
            chunk_shape = chunk_shapes[chunk_index]
            chunk_results = {
                variable_name: variable_values.reshape(*chunk_shape, *variable_values.shape[1:])
                for variable_name, variable_values in flat_chunk_results.items()
            }
            try:
                result_store.write_chunk(chunk_index, chunk_results)
            except IsADirectoryError as file_error:
                raise ValueError(
                    f"{file_error.filename2 or file_error.filename} is a folder, but the scan "
                    "writes a file there: remove the folder, and run the same again."
                ) from file_error
            except OSError as disk_error:
                if disk_error.errno not in (errno.ENOSPC, errno.EDQUOT):
                    raise
                n_chunks_done = n_chunks - len(result_store.find_missing_chunks())
                raise OSError(
                    disk_error.errno,
                    f"no space is left for {result_store.store_location}, where {n_chunks_done} "
                    "chunks are complete: make room and run the same again, it goes on from there",
                ) from disk_error
            has_failed = flat_chunk_results["outcome"] != Outcome.STEPPED
            scan_progress = replace(
                scan_progress,
                n_done=scan_progress.n_done + has_failed.size,
                n_failed=scan_progress.n_failed + int(has_failed.sum()),
            )
            report_progress(f"{scan_progress.n_done:,} of {n_samples:,} samples")
            if on_progress is not None:
                on_progress(scan_progress)
    except KeyboardInterrupt:
        if isinstance(result_store, MemoryResultStore):
            raise KeyboardInterrupt(
                "stopped, and nothing is kept: give store=, a folder, to continue another time."
            ) from None
        n_chunks_done = n_chunks - len(result_store.find_missing_chunks())
        raise KeyboardInterrupt(
            f"stopped: {n_chunks_done} of {n_chunks} chunks are kept in "
            f"{result_store.store_location}; run the same again, it goes on from there."
        ) from None


def open_or_create_store(scan_plan: ScanPlan, store_path: Path) -> ZarrResultStore:
    """Return the store at `store_path`, which is created if it does not exist.

    Raise a ValueError if the store contains another scan.
    """
    if read_stored_manifest(store_path) is None:
        create_empty_store(store_path, scan_plan.result_layout, scan_plan.store_attributes)
    zarr_store = find_matching_store(scan_plan, store_path)
    assert zarr_store is not None
    stored_manifest = read_stored_manifest(store_path) or {}
    settings_difference_text = describe_settings_difference(
        stored_manifest[PROVENANCE_ATTRIBUTE], describe_computing_environment()
    )
    if settings_difference_text and (n_missing_chunks := len(zarr_store.find_missing_chunks())):
        damaged_chunks_text = (
            f" ({len(zarr_store.damaged_chunks)} of them damaged)"
            if zarr_store.damaged_chunks
            else ""
        )
        raise ValueError(
            f"{store_path} lacks {n_missing_chunks} of {scan_plan.result_layout.n_chunks} "
            f"chunks{damaged_chunks_text} and was begun by other means, so that its last digits "
            f"might not fit: {settings_difference_text}. Go on with what it was begun with, or "
            "begin anew in another place."
        )
    return zarr_store


def find_matching_store(
    scan_plan: ScanPlan, store_path: Path, verifies_files: bool = True
) -> ZarrResultStore | None:
    """Return the store at `store_path`, or None if it does not exist.

    Raise a ValueError if the store contains another scan.

    - `verifies_files`: whether damaged chunks are searched for.
    """
    stored_manifest = read_stored_manifest(store_path)
    if stored_manifest is None:
        return None
    settings_difference_text = describe_settings_difference(
        stored_manifest[MANIFEST_ATTRIBUTE], scan_plan.scan_settings
    )
    if settings_difference_text:
        raise ValueError(
            f"{store_path} holds a scan made with other settings: {settings_difference_text}. "
            "Give another place for this scan, or go back to those settings, or delete the store."
        )
    return ZarrResultStore(store_path, scan_plan.result_layout, verifies_files)


SCAN_STARTUP_SECONDS = 5.0
"""Typical time until the first sample is computed with cached code, s; see
docs/benchmarks/scans.md.
"""

TYPICAL_SCAN_MEMORY_BYTES = 500_000_000
"""Typical memory that code and arrays of a scan occupy, bytes; see docs/benchmarks/scans.md."""


@with_default_jax_settings
def forecast_scan(scan_plan: ScanPlan, store_path: Path) -> dict[str, str]:
    """Return a forecast of a scan: its size, chunks, memory and time, as texts by label.

    No file is written. Time and memory are measured while samples that are spread over the design
    are computed.

    - `store_path`: folder of the scan's store. Only chunks that are missing in the store are
      forecast.
    """
    result_layout, n_samples = scan_plan.result_layout, scan_plan.design.size
    measure_catalog = scan_plan.measure_catalog
    existing_store = find_matching_store(scan_plan, store_path, verifies_files=False)
    missing_chunks = (
        range(result_layout.n_chunks)
        if existing_store is None
        else existing_store.find_missing_chunks()
    )
    n_missing_samples = sum(
        math.prod(result_layout.compute_chunk_sample_shape(chunk_index))
        for chunk_index in missing_chunks
    )
    chunk_size = math.prod(result_layout.chunk_shape)
    sample_axes_description = " x ".join(
        f"{axis_length} {sample_axis_name}"
        for sample_axis_name, axis_length in zip(
            scan_plan.design.dims, scan_plan.design.shape, strict=True
        )
    )
    forecast_texts = {
        "samples": f"{n_samples:,} ({sample_axes_description})",
        "measures": ", ".join(scan_plan.requested_measures),
        "always included": ", ".join(measure_catalog.always_included_variables),
        "chunks": f"{result_layout.n_chunks:,} of up to {chunk_size:,} samples, "
        f"{len(missing_chunks):,} to compute",
        "result": f"{_format_bytes(n_samples * result_layout.bytes_per_sample)} before compression",
    }
    if not n_missing_samples:
        return forecast_texts | {"time": "none: the store is complete"}
    n_measured_samples = min(
        n_missing_samples, measure_catalog.forecast_samples_per_core * lanes.count_available_cores()
    )
    scan_engine = scan_plan.build_scan_engine()
    start_seconds = perf_counter()
    scan_engine(_select_spread_samples(scan_plan.design, 1))
    compilation_end_seconds = perf_counter()
    scan_engine(_select_spread_samples(scan_plan.design, n_measured_samples))
    samples_per_second = n_measured_samples / (perf_counter() - compilation_end_seconds)
    try:
        import resource

        bytes_per_unit = 1 if sys.platform == "darwin" else 1024
        peak_memory_bytes = bytes_per_unit * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    except ImportError:  # Windows has no such module.
        peak_memory_bytes = TYPICAL_SCAN_MEMORY_BYTES
    forecast_memory_bytes = peak_memory_bytes + chunk_size * 2 * result_layout.bytes_per_sample
    return forecast_texts | {
        "memory": f"about {_format_bytes(forecast_memory_bytes)}, whatever the number of samples",
        "time": f"about "
        f"{format_duration(n_missing_samples / samples_per_second + SCAN_STARTUP_SECONDS)}: "
        f"{n_missing_samples:,} samples at {samples_per_second:,.0f} per "
        f"second on {lanes.count_available_cores()} cores, {SCAN_STARTUP_SECONDS:.0f} s to start",
        "measured": f"just now, on {n_measured_samples:,} samples spread over the design; the code "
        f"for it took {compilation_end_seconds - start_seconds:.0f} s and is kept",
    }


def _select_spread_samples(design: SampleDesign, n_selected_samples: int) -> ParameterSamples:
    flat_sample_indices = np.linspace(0, design.size - 1, n_selected_samples).round().astype(int)
    axis_indices = np.unravel_index(flat_sample_indices, design.shape)
    indices_by_axis = dict(zip(design.dims, axis_indices, strict=True))
    return {
        parameter_name: parameter_values[indices_by_axis.get(parameter_name, axis_indices[0])]
        for parameter_name, parameter_values in design.values_by_parameter.items()
    }


def _format_bytes(n_bytes: int | float) -> str:
    for unit_of_bytes in ("B", "kB", "MB"):
        if n_bytes < 1000:
            return f"{n_bytes:.3g} {unit_of_bytes}"
        n_bytes /= 1000
    return f"{n_bytes:.3g} GB"


def format_duration(seconds: float) -> str:
    """Return a text that states a duration in s, min or h.

    - `seconds`: the duration, s.
    """
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


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
    design: SampleDesign,
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
    check_type("design", design, SampleDesign, "give vrw.grid(damping=[...], slope=[...])")
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
        raise NoGaitError("no gait was found on the grid: choose another.")
    return SpecialPointMap(
        scanned_samples, *trace_special_points(scanned_samples, base_wheel, wheel_model, on_stage)
    )


def require_map_grid(design: SampleDesign) -> None:
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
