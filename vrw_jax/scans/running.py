"""Scans: the steady gait of every sample of a design, as one labelled dataset.

A scan is cut into chunks, each computed by the same compiled function and, where a store is given,
written at once: a scan that was interrupted goes on with the chunks that are missing.
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


@dataclass(frozen=True)
class Progress:
    """How far a scan is."""

    samples: int  # to do in this run
    done: int  # of them
    failed: int  # of those, without a steady gait
    kept: int  # samples that an earlier run had computed


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
    """The steady gait of every sample, labelled, with outcome and premise margins of each.

    `measures` are names (see `vrw_jax.scans.offer`), derivatives included as in
    'd dls_fraction / d damping'; variables have the names that were asked for, in that order. With
    `store` the result is kept there chunk by chunk: a scan that was interrupted goes on where it
    stopped and ends with bitwise the same data, a finished one is only opened, and chunks whose
    files are damaged are computed again, with a warning. `report` is told the progress after each
    chunk. What a sample gives does not depend on the others, nor on `chunk`. `model` may be the
    wheel on real ground, whose samples walk towards their gait, or "auto", each sample on the
    lowest rung that serves, with `rung` and `reason`; both take `friction` as a swept parameter.
    `dask` is the address of a cluster that computes in this process' stead, "local" for one started
    here.

    Args:
        design: the samples, of `grid`, `samples`, `sobol`, `uniform` or `saltelli`.
        measures: names of what is told; by default DLS fraction, speed and the like.
        base: the wheel of what is not swept; Table 1 by default.
        model: the rung; "auto" for each sample's lowest.
        options: of the checking steps.
        cycle_options: of the gaits.
        store: folder to keep it in.
        chunk: samples written at a time; 4,096 by default.
        report: told the progress after each chunk.
        dask: address of a cluster, or "local".
        tol: error allowed of each measure, in its unit, towards a `model` of real ground: each
            sample is answered by the lowest rung that can be shown to keep it (`vrw.answer`), and
            `rung` and `speed_error` (of speed) stand beside the values.

    Returns:
        A dataset over the design's axes.

    Raises:
        TypeError, ValueError: an argument that can't be meant, in one sentence.
        StoreError: a store of other settings, or one that another process writes.

    Examples:
        >>> found = vrw.scan(vrw.grid(damping=[150.0, 300.0]), ["speed"])
        >>> found.speed.round(3).values.tolist(), found.outcome.values.tolist()
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
    """The workers of a dask cluster; None where this process computes by itself."""
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
    """Carry out a plan, here or `through` others."""
    kept = store if isinstance(store, AbstractStore) else _kept(planned, store)
    missing = kept.missing()
    if missing or kept.damage:
        with kept.at_work():
            _compute(planned, kept, missing, report, through or _in_turn)
    return kept.dataset()


def _kept(planned: Plan, store: str | Path | None) -> AbstractStore:
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
    engine = planned.engine()
    for index in missing:
        yield index, engine(planned.design.block(planned.layout.region(index)))


def open_store(planned: Plan, path: Path) -> ZarrStore:
    """The store at `path`, made now if nothing is there; refused if it holds another scan."""
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
    """The store at `path`, None if nothing is there; refused if it holds another scan."""
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
