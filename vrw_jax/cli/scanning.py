"""Scans from the command line: planning from a config, verification and computation."""

from pathlib import Path

import typer

from vrw_jax.cli import console as printing
from vrw_jax.cli.config import Config
from vrw_jax.cli.console import (
    ExitCode,
    print_error_sentence,
    report_command_errors,
    stdout_console,
)
from vrw_jax.measures import xarray as xr
from vrw_jax.scans import (
    ScanPlan,
    find_matching_store,
    open_or_create_store,
    plan_scan,
    resolve_executor,
    run_scan,
)


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
    with report_command_errors(interruption_message), resolve_executor(dask) as chunk_executor:
        zarr_store = open_or_create_store(scan_plan, store_path)
        if zarr_store.damage_description:
            print_error_sentence(f"{zarr_store.damage_description}: computed again.")
        elif not zarr_store.find_missing_chunks():
            stdout_console.print(f"{store_path} is complete: nothing to compute.", highlight=False)
            return zarr_store.load_dataset()
        with printing.make_progress_bar("scan") as progress_bar:
            progress_task = progress_bar.add_task("compiling", total=None, note="")
            report_progress = printing.make_scan_progress_reporter(
                progress_bar.update, progress_task
            )
            return run_scan(
                scan_plan, zarr_store, on_progress=report_progress, chunk_executor=chunk_executor
            )
