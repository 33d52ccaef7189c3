"""Scans: the steady gait of every sample of a design, as one labelled dataset.

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
from vrw_jax.numerics import Options
from vrw_jax.runtime import xarray as xr
from vrw_jax.scans.design import AbstractDesign
from vrw_jax.scans.planning import Chunk, Plan, Through, difference, origin, plan
from vrw_jax.scans.store import (
    MANIFEST,
    PROVENANCE,
    AbstractStore,
    MemoryStore,
    ZarrStore,
    create,
    stored_manifest,
)
from vrw_jax.walks import ModelLike
from vrw_jax.wheel import Outcome, WheelParams

Report = Callable[["Progress"], None]
"""Function that is called with the progress after each chunk."""


@dataclass(frozen=True)
class Progress:
    """Progress of a scan, as numbers of samples."""

    samples: int  # samples to compute in this run
    done: int  # samples computed in this run
    failed: int  # computed samples without a steady gait
    kept: int  # samples that an earlier run computed


def scan(
    design: AbstractDesign,
    measures: Iterable[str] | None = None,
    *,
    base: WheelParams | None = None,
    model: ModelLike | None = None,
    options: Options | None = None,
    cycle_options: CycleOptions | None = None,
    store: str | Path | None = None,
    chunk: int | None = None,
    report: Report | None = None,
    dask: str | None = None,
    tol: float | None = None,
) -> xr.Dataset:
    """Return the steady gait of every sample with its outcome and margins, as a labelled dataset.

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
    planned = plan(
        design,
        measures,
        base=base,
        model=model,
        options=options,
        cycle_options=cycle_options,
        chunk=chunk,
        tol=tol,
    )
    with carried(dask) as through:
        return run(planned, store, report=report, through=through)


def carried(dask: str | None) -> contextlib.AbstractContextManager[Through | None]:
    """Return the context of a dask cluster's workers, or of None if this process computes."""
    if dask is None:
        return contextlib.nullcontext()
    from vrw_jax.scans.dask import workers

    return workers(dask)


def run(
    planned: Plan,
    store: str | Path | AbstractStore | None = None,
    *,
    report: Report | None = None,
    through: Through | None = None,
) -> xr.Dataset:
    """Return the dataset of a plan, computed in this process or by `executor`."""
    kept = store if isinstance(store, AbstractStore) else _kept(planned, store)
    missing = kept.missing()
    if missing or kept.damage:
        with kept.at_work():
            _compute(planned, kept, missing, report, through or _in_turn)
    return kept.dataset()


def _kept(planned: Plan, store: str | Path | None) -> AbstractStore:
    """Return the storage of a scan; warn if some of its chunks are damaged."""
    if store is None:
        return MemoryStore(planned.layout, planned.attrs)
    kept = open_store(planned, Path(store))
    if kept.damage:
        warnings.warn(f"{kept.damage}: computed again.", stacklevel=4)
    return kept


def _compute(
    planned: Plan,
    kept: AbstractStore,
    missing: list[int],
    report: Report | None,
    through: Through,
) -> None:
    """Compute the missing chunks and write them, with a report after each."""
    shapes = {index: planned.layout.shape_of(index) for index in missing}
    total, done, failed = sum(map(math.prod, shapes.values())), 0, 0
    if report is not None:
        report(Progress(total, 0, 0, planned.design.size - total))
    for index, results in through(planned, missing):
        shape = shapes[index]
        block = {name: x.reshape(*shape, *x.shape[1:]) for name, x in results.items()}
        with _disk_full_explained(kept, planned.layout.n_chunks):
            kept.write(index, block)
        done += math.prod(shape)
        failed += int(np.count_nonzero(results["outcome"] != Outcome.STEPPED))
        if report is not None:
            report(Progress(total, done, failed, planned.design.size - total))


def _in_turn(planned: Plan, missing: Sequence[int]) -> Iterator[Chunk]:
    """Yield the missing chunks, computed one after another in this process."""
    engine = planned.engine()
    for index in missing:
        yield index, engine(planned.design.block(planned.layout.region(index)))


def open_store(planned: Plan, path: Path) -> ZarrStore:
    """Return the store at `path`, created if there is none; raise if it holds another scan."""
    kept = found_store(planned, path)
    if kept is None:
        create(path, planned.layout, planned.attrs)
        kept = found_store(planned, path)
        assert kept is not None
    there = stored_manifest(path) or {}
    other = difference(there[PROVENANCE], origin())
    missing = len(kept.missing())
    if other and missing:
        damaged = f" ({len(kept.damaged)} of them damaged)" if kept.damaged else ""
        raise ValueError(
            f"{path} lacks {missing} of {planned.layout.n_chunks} chunks{damaged} and "
            f"was begun by other means, so that its last digits might not fit: {other}. "
            "Go on with what it was begun with, or begin anew in another place."
        )
    return kept


def found_store(planned: Plan, path: Path, verify: bool = True) -> ZarrStore | None:
    """Return the store at `path`, or None if there is none; raise if it holds another scan."""
    there = stored_manifest(path)
    if there is None:
        return None
    other = difference(there[MANIFEST], planned.settings)
    if other:
        raise ValueError(
            f"{path} holds a scan made with other settings: {other}. "
            "Give another place for this scan, or go back to those settings, or delete the store."
        )
    return ZarrStore(path, planned.layout, verify)


@contextlib.contextmanager
def _disk_full_explained(kept: AbstractStore, n_chunks: int) -> Iterator[None]:
    """Replace the error of a full disk by one that names the number of complete chunks."""
    try:
        yield
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT):
            raise
        n_done = n_chunks - len(kept.missing())
        raise OSError(
            error.errno,
            f"no space is left for {kept.place}, where {n_done} chunks are complete: make room and "
            "run the same again, it goes on from there",
        ) from error
