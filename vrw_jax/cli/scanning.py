"""Scans of the command line: plan from a config, verification and computation."""

from pathlib import Path
from typing import TYPE_CHECKING

import typer

from vrw_jax.cli import console as printing
from vrw_jax.cli.console import ExitCode, print_error, report_errors, stdout_console

if TYPE_CHECKING:
    import xarray as xr

    from vrw_jax.cli.config import Config
    from vrw_jax.scans import ScanPlan


def plan_config_scan(
    settings: "Config", chunk: int | None, additional_measures: tuple[str, ...] = ()
) -> "ScanPlan":
    """Return the plan of the config's scan, with the additional measures."""
    from vrw_jax.scans import plan_scan

    assert settings.design is not None
    measures = settings.scan.measures
    if additional_measures:
        measures = tuple(dict.fromkeys((*(measures or ("dls_fraction",)), *additional_measures)))
    return plan_scan(
        settings.design,
        measures,
        base=settings.make_wheel(),
        model=settings.make_model(),
        options=settings.make_options(),
        chunk=chunk or settings.scan.chunk,
        config_text=settings.source_text,
        tol=settings.scan.tol,
        slope_sd=settings.scan.slope_sd,
    )


def verify_store(plan: "ScanPlan", store: Path) -> None:
    """Print whether a store is complete and intact; exit with code 1 if it is damaged."""
    from vrw_jax.scans import find_store

    zarr_store = find_store(plan, store)
    if zarr_store is None:
        raise ValueError(f"there is no store {store} to verify: run the same without --verify.")
    if zarr_store.damage_description:
        print_error(
            f"{zarr_store.damage_description}: run the same without --verify, which computes "
            "these again."
        )
        raise typer.Exit(ExitCode.CHECK_FAILED)
    n_chunks, missing_chunks = plan.layout.n_chunks, len(zarr_store.find_missing_chunks())
    state_text = (
        f"lacks {missing_chunks:,} of {n_chunks:,} chunks, the others are"
        if missing_chunks
        else "is complete and"
    )
    stdout_console.print(f"{store} {state_text} sound.", highlight=False, soft_wrap=True)


def compute_scan(plan: "ScanPlan", store: Path, dask: str | None) -> "xr.Dataset":
    """Compute the chunks that the store lacks, with a progress bar, and return the dataset."""
    from vrw_jax.scans import open_or_create_store, resolve_executor, run_scan

    interruption_message = f"stopped; what is done stays in {store}, run the same to go on."
    with report_errors(interruption_message), resolve_executor(dask) as executor:
        zarr_store = open_or_create_store(plan, store)
        if zarr_store.damage_description:
            print_error(f"{zarr_store.damage_description}: computed again.")
        elif not zarr_store.find_missing_chunks():
            stdout_console.print(f"{store} is complete: nothing to compute.", highlight=False)
            return zarr_store.load_dataset()
        with printing.make_progress_bar("scan") as progress_bar:
            task = progress_bar.add_task("compiling", total=None, note="")
            report_progress = printing.make_scan_reporter(progress_bar.update, task)
            return run_scan(plan, zarr_store, on_progress=report_progress, executor=executor)
