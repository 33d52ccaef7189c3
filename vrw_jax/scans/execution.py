"""Execution of a scan: its chunks are computed, written and returned as one labeled dataset.

A scan is divided into chunks, which the same compiled function computes. If a store is given, each
chunk is written as soon as it is computed. An interrupted scan continues with the missing chunks.
"""

from __future__ import annotations

import contextlib
import errno
import math
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vrw_jax.cycles import CycleOptions
from vrw_jax.numerics import StepOptions
from vrw_jax.runtime import with_default_settings
from vrw_jax.runtime import xarray as xr
from vrw_jax.scans.design import AbstractDesign
from vrw_jax.scans.integrity import MANIFEST_ATTRIBUTE
from vrw_jax.scans.planning import (
    ChunkExecutor,
    ChunkResult,
    ScanPlan,
    describe_difference,
    describe_environment,
    plan_scan,
)
from vrw_jax.scans.store import (
    PROVENANCE_ATTRIBUTE,
    AbstractStore,
    MemoryStore,
    ZarrStore,
    create_store,
    read_stored_manifest,
)
from vrw_jax.simulation import ModelLike
from vrw_jax.validation import check_callable, check_path, raise_for_renamed_arguments
from vrw_jax.wheel import Outcome, WheelParams

ProgressCallback = Callable[["ScanProgress"], None]
"""Function that is called with the progress after each chunk."""


@dataclass(frozen=True)
class ScanProgress:
    """Progress of a scan, in numbers of samples."""

    n_samples: int  # samples to compute in this run
    n_done: int  # samples computed in this run
    n_failed: int  # computed samples without a steady gait
    n_reused: int  # samples that an earlier run computed


@with_default_settings
@raise_for_renamed_arguments(report="on_progress")
def scan(
    design: AbstractDesign,
    measures: Iterable[str] | None = None,
    *,
    base: WheelParams | None = None,
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
    """Return the steady gait of every sample with its outcome and margins, as a labeled dataset.

    `measures` are names (see `vrw_jax.scans.measure_catalog`), including derivatives as in
    'd dls_fraction / d damping'. The variables have the requested names and order. The result of a
    sample depends neither on other samples nor on `chunk`.

    If `store` is given, the result is written there chunk by chunk. An interrupted scan continues
    where it stopped and ends with bitwise the same data. A finished scan is only opened, but its
    damaged chunks are computed again, with a warning.

    `model` may be a `UnilateralWheel`, for which each sample walks to its gait. It may be "auto",
    which gives each sample the simplest valid model and adds the variables `rung` and `reason`.
    Both accept `friction` as a swept parameter.

    Args:
        design: the samples, from `grid`, `samples`, `sobol`, `uniform` or `saltelli`.
        measures: names of the measures; by default DLS fraction, speed and the like.
        base: the wheel whose parameters are not swept; Table 1 by default.
        model: the model; "auto" for the simplest valid model of each sample.
        options: numerical options of the steps that check the gaits.
        cycle_options: numerical options of the gaits.
        store: folder that holds the result.
        chunk: number of samples that are written at a time; 4,096 by default.
        on_progress: function that is called with the `ScanProgress` after each chunk.
        dask: address of a dask cluster that computes the chunks, or "local" to start one.
        tol: permitted error of each measure, in its unit, with respect to a `UnilateralWheel`. Each
            sample is computed by the simplest model whose error bound permits it (see
            `vrw.measure_to_tolerance`). The dataset holds `rung` and the errors, such as
            `speed_error`.
        slope_sd: standard deviation of random slopes, rad, which adds "mean_steps",
            "mean_steps_error" and "failure_probability" to the measures (see `vrw.first_passage`).
            A sample takes about a second, and 16 are written at a time by default.

    Returns:
        A dataset over the axes of the design.

    Raises:
        TypeError, ValueError: if an argument is invalid, or if the store holds another scan or is
            locked by another process; the message names the remedy.

    Examples:
        >>> gaits = vrw.scan(vrw.grid(damping=[150.0, 300.0]), ["speed"])
        >>> gaits.speed.round(3).values.tolist(), gaits.outcome.values.tolist()
        ([1.018, nan], [0, 14])
    """
    if store is not None:
        check_path("store", store, "give the folder to keep the result in")
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
    with resolve_executor(dask) as executor:
        return run_scan(scan_plan, store, on_progress=on_progress, executor=executor)


def resolve_executor(dask: str | None) -> contextlib.AbstractContextManager[ChunkExecutor | None]:
    """Return the context of a dask cluster's workers, or of None if this process computes."""
    if dask is None:
        return contextlib.nullcontext()
    from vrw_jax.scans.dask import connect_workers

    return connect_workers(dask)


@with_default_settings
def run_scan(
    scan_plan: ScanPlan,
    store: str | Path | AbstractStore | None = None,
    *,
    on_progress: ProgressCallback | None = None,
    executor: ChunkExecutor | None = None,
) -> xr.Dataset:
    """Return the dataset of a plan, computed in this process or by `executor`."""
    if isinstance(store, AbstractStore):
        storage = store
    elif store is None:
        storage = MemoryStore(scan_plan.layout, scan_plan.store_attrs)
    else:
        storage = open_or_create_store(scan_plan, Path(store))
        if storage.damage_description:
            warnings.warn(f"{storage.damage_description}: computed again.", stacklevel=3)
    if storage.damage_description or storage.find_missing_chunks():
        with storage.open_for_writing():
            _compute_chunks(
                scan_plan,
                storage,
                storage.find_missing_chunks(),
                on_progress,
                executor or _compute_in_process,
            )
    return storage.load_dataset()


def _compute_chunks(
    scan_plan: ScanPlan,
    storage: AbstractStore,
    missing_chunks: list[int],
    on_progress: ProgressCallback | None,
    executor: ChunkExecutor,
) -> None:
    """Compute the missing chunks and write them, with a report after each."""
    chunk_shapes = {
        chunk_index: scan_plan.layout.shape_of_chunk(chunk_index) for chunk_index in missing_chunks
    }
    n_samples, n_done, n_failed = sum(map(math.prod, chunk_shapes.values())), 0, 0
    if on_progress is not None:
        on_progress(ScanProgress(n_samples, 0, 0, scan_plan.design.size - n_samples))
    try:
        for chunk_index, results in executor(scan_plan, missing_chunks):
            chunk_shape = chunk_shapes[chunk_index]
            chunk_results = {
                name: values.reshape(*chunk_shape, *values.shape[1:])
                for name, values in results.items()
            }
            with _explain_full_disk(storage, scan_plan.layout.n_chunks):
                storage.write_chunk(chunk_index, chunk_results)
            n_done += math.prod(chunk_shape)
            n_failed += int(np.count_nonzero(results["outcome"] != Outcome.STEPPED))
            if on_progress is not None:
                on_progress(
                    ScanProgress(n_samples, n_done, n_failed, scan_plan.design.size - n_samples)
                )
    except KeyboardInterrupt:
        raise KeyboardInterrupt(
            _describe_interruption(storage, scan_plan.layout.n_chunks)
        ) from None


def _describe_interruption(storage: AbstractStore, n_chunks: int) -> str:
    """Return a sentence about the chunks that an interrupted scan keeps."""
    if isinstance(storage, MemoryStore):
        return "stopped, and nothing is kept: give store=, a folder, to continue another time."
    n_done = n_chunks - len(storage.find_missing_chunks())
    return (
        f"stopped: {n_done} of {n_chunks} chunks are kept in {storage.location}; run the same "
        "again, it goes on from there."
    )


def _compute_in_process(
    scan_plan: ScanPlan, missing_chunks: Sequence[int]
) -> Iterator[ChunkResult]:
    """Yield the missing chunks, computed one after another in this process."""
    engine = scan_plan.build_engine()
    for chunk_index in missing_chunks:
        yield (
            chunk_index,
            engine(scan_plan.design.sample_block(scan_plan.layout.chunk_region(chunk_index))),
        )


def open_or_create_store(scan_plan: ScanPlan, path: Path) -> ZarrStore:
    """Return the store at `path`, created if there is none; raise a ValueError if it contains
    another scan.
    """
    storage = find_store(scan_plan, path)
    if storage is None:
        create_store(path, scan_plan.layout, scan_plan.store_attrs)
        storage = find_store(scan_plan, path)
        assert storage is not None
    manifest = read_stored_manifest(path) or {}
    setting_difference = describe_difference(manifest[PROVENANCE_ATTRIBUTE], describe_environment())
    n_missing = len(storage.find_missing_chunks())
    if setting_difference and n_missing:
        damaged_text = (
            f" ({len(storage.damaged_chunks)} of them damaged)" if storage.damaged_chunks else ""
        )
        raise ValueError(
            f"{path} lacks {n_missing} of {scan_plan.layout.n_chunks} chunks{damaged_text} and "
            "was begun by other means, so that its last digits might not fit: "
            f"{setting_difference}. "
            "Go on with what it was begun with, or begin anew in another place."
        )
    return storage


def find_store(scan_plan: ScanPlan, path: Path, verify: bool = True) -> ZarrStore | None:
    """Return the store at `path`, or None if there is none; raise a ValueError if it contains
    another scan.
    """
    manifest = read_stored_manifest(path)
    if manifest is None:
        return None
    setting_difference = describe_difference(manifest[MANIFEST_ATTRIBUTE], scan_plan.settings)
    if setting_difference:
        raise ValueError(
            f"{path} holds a scan made with other settings: {setting_difference}. "
            "Give another place for this scan, or go back to those settings, or delete the store."
        )
    return ZarrStore(path, scan_plan.layout, verify)


@contextlib.contextmanager
def _explain_full_disk(storage: AbstractStore, n_chunks: int) -> Iterator[None]:
    """Return a context that replaces the error of a full disk by one with the number of complete
    chunks.
    """
    try:
        yield
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT):
            raise
        n_done = n_chunks - len(storage.find_missing_chunks())
        raise OSError(
            error.errno,
            f"no space is left for {storage.location}, where {n_done} chunks are complete: make "
            "room and run the same again, it goes on from there",
        ) from error
