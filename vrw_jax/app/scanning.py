"""Scans of the command line: planned from a config, verified and computed."""

from pathlib import Path
from typing import TYPE_CHECKING

import typer

from vrw_jax.app import printing
from vrw_jax.app.printing import complain, out, sentences

if TYPE_CHECKING:
    import xarray as xr

    from vrw_jax.app.config import Config
    from vrw_jax.scans import Plan

DAMAGED = 1
"""Exit code if a store is damaged."""


def planned_scan(settings: "Config", chunk: int | None, also: tuple[str, ...] = ()) -> "Plan":
    """Return the plan of the config's scan, with the additional measures."""
    from vrw_jax.scans import plan

    assert settings.design is not None
    measures = settings.scan.measures
    if also:
        measures = tuple(dict.fromkeys((*(measures or ("dls_fraction",)), *also)))
    return plan(
        settings.design,
        measures,
        base=settings.params(),
        model=settings.wheel_model(),
        options=settings.numerical_options(),
        chunk=chunk or settings.scan.chunk,
        text=settings.text,
        tol=settings.scan.tol,
    )


def verify_store(planned: "Plan", store: Path) -> None:
    """Print whether a store is complete and intact; exit with code 1 if it is damaged."""
    from vrw_jax.scans import found_store

    kept = found_store(planned, store)
    if kept is None:
        raise ValueError(f"there is no store {store} to verify: run the same without --verify.")
    if kept.damage:
        complain(f"{kept.damage}: run the same without --verify, which computes these again.")
        raise typer.Exit(DAMAGED)
    n, missing = planned.layout.n_chunks, len(kept.missing())
    told = f"lacks {missing:,} of {n:,} chunks, the others are" if missing else "is complete and"
    out.print(f"{store} {told} sound.", highlight=False, soft_wrap=True)


def compute_scan(planned: "Plan", store: Path, dask: str | None) -> "xr.Dataset":
    """Compute the chunks that the store lacks, with a progress bar, and return its dataset."""
    from vrw_jax.scans import carried, open_store, run

    stopped = f"stopped; what is done stays in {store}, run the same to go on."
    with sentences(stopped), carried(dask) as through:
        kept = open_store(planned, store)
        if kept.damage:
            complain(f"{kept.damage}: computed again.")
        elif not kept.missing():
            out.print(f"{store} is complete: nothing to compute.", highlight=False)
            return kept.dataset()
        with printing.progress_bar("scan") as bar:
            task = bar.add_task("compiling", total=None, note="")
            report = printing.scan_reporter(bar.update, task)
            return run(planned, kept, report=report, through=through)
