"""Scans on a dask cluster: each worker that is free computes a chunk of samples of `run_scan`.

Workers only compute, and the calling process writes the store. If a worker dies, other workers
compute its chunks. Each worker returns a description of its environment. A chunk raises an error if
this environment differs from that of the calling process, because the last digits of its results
might differ.
"""

import asyncio
import contextlib
import functools
import itertools
import logging
import pickle
import warnings
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING

import jax

from vrw_jax import lanes
from vrw_jax.base.progress import start_jax
from vrw_jax.studies.measure_catalog import ValuesByVariable
from vrw_jax.studies.scan_design import ParameterSamples
from vrw_jax.studies.scan_engines import SampleEvaluator, make_scan_engine
from vrw_jax.studies.scan_planning import (
    ChunkExecutor,
    ChunkResult,
    ScanPlan,
    describe_computing_environment,
    describe_settings_difference,
)

if TYPE_CHECKING:
    from distributed import Client, Future

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
