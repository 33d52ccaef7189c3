"""Scans from the command line: planning from a config, verification, forecast and computation."""

import json
import math
import sys
from pathlib import Path
from time import perf_counter

import numpy as np
import typer

from vrw_jax import lanes
from vrw_jax.app import output as printing
from vrw_jax.app.config import Config, FigureConfig
from vrw_jax.app.output import (
    ExitCode,
    format_duration,
    print_error_sentence,
    report_command_errors,
    stdout_console,
    write_figures,
)
from vrw_jax.base.results import xarray as xr
from vrw_jax.lanes.environment import (
    compute_source_digest,
    find_library_version,
    with_default_jax_settings,
)
from vrw_jax.studies.scan_design import ParameterSamples, SampleDesign
from vrw_jax.studies.scan_execution import (
    find_matching_store,
    open_or_create_store,
    resolve_executor,
    run_scan,
)
from vrw_jax.studies.scan_planning import (
    ScanPlan,
    plan_scan,
)
from vrw_jax.studies.scan_store import (
    compute_store_digest,
    read_metadata_file,
)

FIGURE_RECORD_NAME = "figures.json"
"""Name of the file that states from which results and with which code figures were drawn."""


def plan_config_scan(
    command_config: Config, chunk_size: int | None, additional_measures: tuple[str, ...] = ()
) -> ScanPlan:
    """Return the plan for the scan that a config defines, extended by additional measures."""
    assert command_config.design is not None
    measure_names = command_config.scan.measures
    if additional_measures:
        measure_names = measure_names or ("dls_fraction",)
        measure_names = tuple(dict.fromkeys((*measure_names, *additional_measures)))
    return plan_scan(
        command_config.design,
        measure_names,
        base=command_config.make_wheel(),
        model=command_config.make_model(),
        options=command_config.make_options(),
        cycle_options=command_config.scan.make_cycle_options(),
        chunk=chunk_size or command_config.scan.chunk,
        config_text=command_config.source_text,
        tol=command_config.scan.tol,
        slope_sd=command_config.scan.slope_sd,
    )


def verify_scan_store(scan_plan: ScanPlan, store_path: Path) -> None:
    """Print whether a scan store is complete and intact, and exit with code 1 if it is damaged."""
    zarr_store = find_matching_store(scan_plan, store_path)
    if zarr_store is None:
        raise ValueError(
            f"there is no store {store_path} to verify: run the same without --verify."
        )
    if zarr_store.damage_description:
        print_error_sentence(
            f"{zarr_store.damage_description}: run the same without --verify, which computes "
            "these again."
        )
        raise typer.Exit(ExitCode.CHECK_FAILED)
    n_chunks = scan_plan.result_layout.n_chunks
    n_missing_chunks = len(zarr_store.find_missing_chunks())
    store_state_text = (
        f"lacks {n_missing_chunks:,} of {n_chunks:,} chunks, the others are"
        if n_missing_chunks
        else "is complete and"
    )
    stdout_console.print(f"{store_path} {store_state_text} sound.", highlight=False, soft_wrap=True)


def compute_scan_with_progress(
    scan_plan: ScanPlan, store_path: Path, dask: str | None
) -> "xr.Dataset":
    """Compute the missing chunks of a scan store with a progress bar, and return the labeled
    dataset.
    """
    interruption_message = f"stopped; what is done stays in {store_path}, run the same to go on."
    with report_command_errors(), resolve_executor(dask) as chunk_executor:
        zarr_store = open_or_create_store(scan_plan, store_path)
        if zarr_store.damage_description:
            print_error_sentence(f"{zarr_store.damage_description}: computed again.")
        elif not zarr_store.find_missing_chunks():
            stdout_console.print(f"{store_path} is complete: nothing to compute.", highlight=False)
            return zarr_store.load_dataset()
        with (
            report_command_errors(interruption_message),
            printing.make_progress_bar("scan") as progress_bar,
        ):
            progress_task = progress_bar.add_task("compiling", total=None, note="")
            report_progress = printing.make_scan_progress_reporter(
                progress_bar.update, progress_task
            )
            return run_scan(
                scan_plan, zarr_store, on_progress=report_progress, chunk_executor=chunk_executor
            )


def draw_scan_figures(
    scan_dataset: "xr.Dataset", store_path: Path, figure_config: FigureConfig
) -> None:
    """Write the figures of a scan beside its store, or to the file of the config, and print their
    paths.

    Figures that were drawn from the same results with the same code and config are not drawn again.
    """
    record_path = store_path.with_name(FIGURE_RECORD_NAME)
    figure_origin = {
        "results": compute_store_digest(store_path),
        "code": compute_source_digest(),
        "matplotlib": find_library_version("matplotlib"),
        "config": repr(figure_config),
    }
    figure_record = read_metadata_file(record_path)
    files = figure_record.pop("files", None)
    figure_paths = [Path(str(file)) for file in files] if isinstance(files, list) else []
    if figure_paths and figure_record == figure_origin and all(map(Path.is_file, figure_paths)):
        for figure_path in figure_paths:
            stdout_console.print(f"up to date: {figure_path}", highlight=False, soft_wrap=True)
        return
    from vrw_jax import plot

    figures = plot.scan_figures(scan_dataset, width=figure_config.width)
    figure_paths = write_figures(figures, store_path.parent, figure_config)
    figure_record = figure_origin | {"files": [str(path) for path in figure_paths]}
    record_path.write_text(json.dumps(figure_record, indent=2), encoding="utf-8")
    printing.print_written_paths(figure_paths)


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
