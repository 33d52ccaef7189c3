"""Execution of a scan: its chunks are computed, written and returned as one labeled dataset.

A scan is divided into chunks of samples, which the same compiled function computes. If a store is
given, each chunk is written as soon as it is computed. An interrupted scan continues with the
missing chunks. A map of special points is a scan over two parameters, with curves between its
samples.

On a dask cluster, each worker that is free computes a chunk. Workers only compute, and the calling
process writes the store. If a worker dies, other workers compute its chunks. Each worker returns a
description of its environment. A chunk raises an error if this environment differs from that of the
calling process, because the last digits of its results might differ.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import functools
import itertools
import logging
import math
import pickle
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import numpy as np

from vrw_jax import lanes
from vrw_jax.base.checks import check_callable, check_names, check_path, check_type
from vrw_jax.base.options import StepOptions
from vrw_jax.base.progress import announce_wait, report_progress, start_jax
from vrw_jax.base.results import Measure, NoGaitError, Outcome
from vrw_jax.base.results import xarray as xr
from vrw_jax.branches.branch import SpecialPointCurve
from vrw_jax.branches.special_point_curves import (
    SPECIAL_POINT_MEASURES,
    ScanSignChange,
    trace_special_points,
)
from vrw_jax.gaits.cycle import CycleOptions
from vrw_jax.lanes.environment import with_default_jax_settings
from vrw_jax.models.ladder import describe_accepted_models
from vrw_jax.models.stepping import ModelLike, convert_model_argument
from vrw_jax.studies.measure_catalog import ValuesByVariable
from vrw_jax.studies.scan_design import (
    MANIFEST_ATTRIBUTE,
    ParameterSamples,
    SampleDesign,
    require_map_grid,
)
from vrw_jax.studies.scan_engines import SampleEvaluator, make_scan_engine
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

if TYPE_CHECKING:
    from distributed import Client, Future


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
@announce_wait("batches of gaits and gait steps", "10 s")
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
    return contextlib.nullcontext() if dask is None else connect_dask_workers(dask)


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


N_QUEUED_CHUNKS_PER_THREAD = 2
"""Number of submitted chunks per thread of the cluster.

The value is chosen because a thread then always has work, and little memory is used.
"""

DASK_SCHEDULER_TIMEOUT = "10s"
"""Longest time until a dask scheduler must respond, in the notation of dask."""

MAX_SECONDS_WITHOUT_RESULT = 10.0
"""Longest time without a result, s, after which the connected workers are counted.

The value is chosen because workers that have just started are connected by then.
"""


@contextlib.contextmanager
def connect_dask_workers(scheduler_address: str) -> Iterator[ChunkExecutor]:
    """Yield a function that computes chunks on the dask cluster at `scheduler_address`.

    The address "local" starts a cluster with one process per core.
    """
    try:
        from distributed import Client, LocalCluster
    except ImportError as connection_error:
        raise ValueError(
            "a scan on a cluster needs dask.distributed, which is not installed: "
            "run pip install 'vrw-jax[dask]'."
        ) from connection_error
    with contextlib.ExitStack() as exit_stack:
        exit_stack.enter_context(hide_cancelled_tasks_in_log())
        if scheduler_address == "local":
            local_cluster = LocalCluster(
                n_workers=lanes.count_available_cores(),
                threads_per_worker=1,
                dashboard_address=None,
            )
            dask_client = Client(exit_stack.enter_context(local_cluster), set_as_default=False)
        else:
            try:
                _require_scheduler_response(scheduler_address)
                dask_client = Client(
                    scheduler_address, timeout=DASK_SCHEDULER_TIMEOUT, set_as_default=False
                )
            # Libraries raise different errors for a wrong address.
            except Exception as connection_error:
                raise ValueError(
                    f"no dask scheduler answers at {scheduler_address!r}: give the address that "
                    "it printed when it started, such as tcp://host:8786, or 'local'."
                ) from connection_error
        exit_stack.enter_context(dask_client)
        yield functools.partial(_compute_chunks_on_cluster, dask_client, scheduler_address)


@contextlib.contextmanager
def hide_cancelled_tasks_in_log() -> Iterator[None]:
    """Return a context in which the client of dask logs no tasks that a lost scheduler cancels."""
    dask_client_logger = logging.getLogger("distributed.client")

    def is_log_record_shown(log_record: logging.LogRecord) -> bool:
        logged_error_type = log_record.exc_info[0] if log_record.exc_info else None
        return logged_error_type is None or not issubclass(
            logged_error_type, asyncio.CancelledError
        )

    dask_client_logger.addFilter(is_log_record_shown)
    try:
        yield
    finally:
        dask_client_logger.removeFilter(is_log_record_shown)


def _require_scheduler_response(scheduler_address: str) -> None:
    """Raise an error if no scheduler responds at `scheduler_address`.

    Without this check, a client would wait without limit.
    """
    from dask.utils import parse_timedelta
    from distributed.comm import connect
    from distributed.security import Security

    async def connect_to_scheduler() -> None:
        connection_arguments = Security().get_connection_args("client")
        timeout_seconds = parse_timedelta(DASK_SCHEDULER_TIMEOUT)
        scheduler_connection = await asyncio.wait_for(
            connect(scheduler_address, timeout=timeout_seconds, **connection_arguments),
            2 * timeout_seconds,
        )
        scheduler_connection.abort()

    # The event loop of a notebook is already running.
    with ThreadPoolExecutor(1) as connection_pool:
        connection_pool.submit(asyncio.run, connect_to_scheduler()).result()


def _compute_chunks_on_cluster(
    dask_client: "Client",
    scheduler_address: str,
    scan_plan: ScanPlan,
    missing_chunks: Sequence[int],
) -> Iterator[ChunkResult]:
    """Yield each missing chunk's index and results, in the order of completion."""
    from distributed.protocol.pickle import dumps  # pickles functions of a script too

    request = scan_plan.evaluation_request
    pickled_request = dumps((request, len(jax.tree.leaves(request))))
    local_computing_environment = describe_computing_environment()
    remaining_chunks = iter(missing_chunks)
    chunk_index_by_future: dict[Future, int] = {}
    completed_futures: SimpleQueue[Future] = SimpleQueue()
    has_warned_of_no_workers = False

    def submit_remaining_chunks() -> None:
        """Submit chunks until there are `N_QUEUED_CHUNKS_PER_THREAD` chunks per thread of the
        cluster, or until all chunks are submitted.
        """
        n_submittable_chunks = N_QUEUED_CHUNKS_PER_THREAD * max(
            1, sum(dask_client.nthreads().values())
        ) - len(chunk_index_by_future)
        for chunk_index in itertools.islice(remaining_chunks, max(n_submittable_chunks, 0)):
            samples_by_parameter = scan_plan.select_chunk_samples(chunk_index)
            chunk_future = dask_client.submit(
                _compute_chunk_in_worker, pickled_request, samples_by_parameter, pure=False
            )
            chunk_index_by_future[chunk_future] = chunk_index
            chunk_future.add_done_callback(completed_futures.put)

    try:
        with _explain_lost_cluster(scheduler_address, OSError):
            submit_remaining_chunks()
        while chunk_index_by_future:
            try:
                chunk_future = completed_futures.get(timeout=MAX_SECONDS_WITHOUT_RESULT)
            except Empty:
                with _explain_lost_cluster(scheduler_address, OSError):
                    is_warning_due = not (has_warned_of_no_workers or dask_client.nthreads())
                if is_warning_due:
                    warnings.warn(
                        f"the dask cluster at {scheduler_address} has no workers, so that nothing "
                        f"is computed: start some, as with `dask worker {scheduler_address}`; the "
                        "scan continues as soon as there is one.",
                        stacklevel=1,
                    )
                    has_warned_of_no_workers = True
                continue
            with _explain_lost_cluster(scheduler_address):
                worker_environment, chunk_results = chunk_future.result()
            environment_difference_text = describe_settings_difference(
                local_computing_environment, worker_environment
            )
            if environment_difference_text:
                raise ValueError(
                    "a worker computes by other means than this process: "
                    f"{environment_difference_text}. Start the workers from the same installation "
                    "on machines of one kind."
                )
            yield chunk_index_by_future.pop(chunk_future), chunk_results
            del chunk_future  # The cluster can then release the result.
            with _explain_lost_cluster(scheduler_address, OSError):
                submit_remaining_chunks()
    finally:
        if dask_client.status == "running":
            dask_client.cancel(list(chunk_index_by_future))


@contextlib.contextmanager
def _explain_lost_cluster(
    scheduler_address: str, *further_loss_errors: type[Exception]
) -> Iterator[None]:
    """Return a context that replaces the error for a lost worker or scheduler by a ValueError with
    a remedy.

    - `further_loss_errors`: additional exceptions that the context replaces, because the
      computation of a chunk cannot raise them.
    """
    from distributed import CancelledError, KilledWorker
    from distributed.comm import CommClosedError

    cluster_loss_errors: tuple[type[BaseException], ...] = (
        CancelledError,
        CommClosedError,
        *further_loss_errors,
    )
    try:
        yield
    except KilledWorker as loss_error:
        raise ValueError(
            "a chunk was given up because each worker that had it died: see to the workers "
            "(their memory, say) and run the same again, it goes on from there."
        ) from loss_error
    except cluster_loss_errors as loss_error:
        raise ValueError(
            f"the dask cluster at {scheduler_address} is gone: start it again and run the same "
            "again, it goes on with the chunks that its store lacks."
        ) from loss_error


def _compute_chunk_in_worker(
    pickled_request: bytes, samples_by_parameter: ParameterSamples
) -> tuple[dict[str, object], ValuesByVariable]:
    """Compute a chunk in a worker.

    Return a description of the worker's environment, and the values of each variable in the chunk,
    by the name of the variable.
    """
    start_jax()
    return describe_computing_environment(), make_worker_engine(pickled_request)(
        samples_by_parameter
    )


@functools.cache
def make_worker_engine(pickled_request: bytes) -> SampleEvaluator:
    """Return the scan engine for a pickled `EvaluationRequest` and its number of leaves.

    Each worker creates the engine once.
    """
    from distributed import get_worker

    request, n_leaves = pickle.loads(pickled_request)
    if len(jax.tree.leaves(request)) != n_leaves:  # Equinox finds no fields in a pickled class.
        raise ValueError(
            "the model or its parameters are of a class that the workers cannot import: define it "
            "in a module that they can import, or scan without dask."
        )
    return make_scan_engine(request, get_worker().state.nthreads)
