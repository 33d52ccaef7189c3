"""Scans from the command line: planning from a config, verification and computation."""

import json
from pathlib import Path

import typer

from vrw_jax.app import console as printing
from vrw_jax.app.config import Config, FigureConfig
from vrw_jax.app.console import (
    ExitCode,
    print_error_sentence,
    report_command_errors,
    stdout_console,
)
from vrw_jax.base.lazy_xarray import xarray as xr
from vrw_jax.lanes.disk_cache import compute_source_digest, find_library_version
from vrw_jax.studies.scan_execution import (
    find_matching_store,
    open_or_create_store,
    resolve_executor,
    run_scan,
)
from vrw_jax.studies.scan_planning import ScanPlan, plan_scan
from vrw_jax.studies.scan_store import compute_store_digest, read_metadata_file

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
    from vrw_jax.app.reports import write_figures

    figures = plot.scan_figures(scan_dataset, width=figure_config.width)
    figure_paths = write_figures(figures, store_path.parent, figure_config)
    figure_record = figure_origin | {"files": [str(path) for path in figure_paths]}
    record_path.write_text(json.dumps(figure_record, indent=2), encoding="utf-8")
    printing.print_written_paths(figure_paths)
