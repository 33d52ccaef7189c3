"""Scans on the workers of a dask cluster: a free worker computes each chunk of `run_scan`.

Workers only compute, and the calling process writes the store. If a worker dies, other workers
compute its chunks. Workers return a description of their environment. A chunk from an environment
that differs from that of the calling process raises an error, because its last digits might differ.
"""

import asyncio
import contextlib
import functools
import itertools
import logging
import pickle
import warnings
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING

import numpy as np

from vrw_jax.runtime import start_jax
from vrw_jax.scans.collocation_engine import count_cores
from vrw_jax.scans.design import SampleColumns
from vrw_jax.scans.engines import make_engine
from vrw_jax.scans.planning import (
    ChunkExecutor,
    ChunkResult,
    EvaluateSamples,
    ScanPlan,
    describe_difference,
    describe_environment,
)

if TYPE_CHECKING:
    from distributed import Client, Future

QUEUED_CHUNKS_PER_THREAD = 2
"""Number of submitted chunks per thread, chosen so that a thread always has work and little
memory is used.
"""

SCHEDULER_TIMEOUT = "10s"
"""Longest time in which a scheduler must respond."""

MAX_SILENT_SECONDS = 10.0
"""Longest time without a result before the workers are counted, s. It is chosen because workers
that have just started are connected by then.
"""


@contextlib.contextmanager
def connect_workers(address: str) -> Iterator[ChunkExecutor]:
    """Yield an executor on the cluster at `address`; "local" starts one process per core."""
    try:
        from distributed import Client, LocalCluster
    except ImportError as error:
        raise ValueError(
            "a scan on a cluster needs dask.distributed, which is not installed: "
            "run pip install 'vrw-jax[dask]'."
        ) from error
    with contextlib.ExitStack() as exit_stack:
        exit_stack.enter_context(_hide_cancelled_tasks())
        if address == "local":
            cluster = LocalCluster(
                n_workers=count_cores(), threads_per_worker=1, dashboard_address=None
            )
            client = Client(exit_stack.enter_context(cluster), set_as_default=False)
        else:
            try:
                _require_response(address)
                client = Client(address, timeout=SCHEDULER_TIMEOUT, set_as_default=False)
            except Exception as error:  # Libraries raise different errors for a wrong address.
                raise ValueError(
                    f"no dask scheduler answers at {address!r}: give the address that it printed "
                    "when it started, such as tcp://host:8786, or 'local'."
                ) from error
        exit_stack.enter_context(client)
        yield functools.partial(_compute_chunks, client, address)


@contextlib.contextmanager
def _hide_cancelled_tasks() -> Iterator[None]:
    """Return a context that removes tasks cancelled with a lost scheduler from the log of
    distributed.
    """
    logger = logging.getLogger("distributed.client")

    def is_shown(record: logging.LogRecord) -> bool:
        error_type = record.exc_info[0] if record.exc_info else None
        return error_type is None or not issubclass(error_type, asyncio.CancelledError)

    logger.addFilter(is_shown)
    try:
        yield
    finally:
        logger.removeFilter(is_shown)


def _require_response(address: str) -> None:
    """Raise a ValueError unless a scheduler responds at `address`; a client would wait without
    limit.
    """
    from dask.utils import parse_timedelta
    from distributed.comm import connect
    from distributed.security import Security

    async def connect_once() -> None:
        arguments = Security().get_connection_args("client")
        timeout_seconds = parse_timedelta(SCHEDULER_TIMEOUT)
        connection = await asyncio.wait_for(
            connect(address, timeout=timeout_seconds, **arguments), 2 * timeout_seconds
        )
        connection.abort()

    with ThreadPoolExecutor(
        1
    ) as connection_pool:  # The event loop of a notebook is already running.
        connection_pool.submit(asyncio.run, connect_once()).result()


def _compute_chunks(
    client: "Client", address: str, plan: ScanPlan, missing_chunks: Sequence[int]
) -> Iterator[ChunkResult]:
    """Yield the results of the missing chunks in the order of completion."""
    pickled_request = pickle.dumps(plan.request)
    local_environment, remaining_chunks = describe_environment(), iter(missing_chunks)
    chunk_of_future: dict[Future, int] = {}
    completed_futures: SimpleQueue[Future] = SimpleQueue()

    def submit_chunks() -> None:
        """Submit chunks until every thread of the cluster has enough of them."""
        n_free_slots = QUEUED_CHUNKS_PER_THREAD * max(1, sum(client.nthreads().values())) - len(
            chunk_of_future
        )
        for chunk_index in itertools.islice(remaining_chunks, max(n_free_slots, 0)):
            columns = plan.design.sample_block(plan.layout.chunk_region(chunk_index))
            future = client.submit(_compute_in_worker, pickled_request, columns, pure=False)
            chunk_of_future[future] = chunk_index
            future.add_done_callback(completed_futures.put)

    try:
        with _explain_loss(address, OSError):
            submit_chunks()
        while chunk_of_future:
            with _explain_loss(address, OSError):
                future = _wait_for_future(client, address, completed_futures)
            with _explain_loss(address):
                worker_environment, results = future.result()
            environment_difference = describe_difference(local_environment, worker_environment)
            if environment_difference:
                raise ValueError(
                    "a worker computes by other means than this process: "
                    f"{environment_difference}. "
                    "Start the workers from the same installation on machines of one kind."
                )
            yield chunk_of_future.pop(future), results
            del future  # The cluster can then release the result.
            with _explain_loss(address, OSError):
                submit_chunks()
    finally:
        if client.status == "running":
            client.cancel(list(chunk_of_future))


def _wait_for_future(
    client: "Client", address: str, completed_futures: "SimpleQueue[Future]"
) -> "Future":
    """Return the next completed future; warn once if the cluster has no workers."""
    has_warned = False
    while True:
        try:
            return completed_futures.get(timeout=MAX_SILENT_SECONDS)
        except Empty:
            pass
        if not has_warned and not client.nthreads():
            warnings.warn(
                f"the dask cluster at {address} has no workers, so that nothing is computed: start "
                f"some, as with `dask worker {address}`; the scan continues as soon as there is "
                "one.",
                stacklevel=1,
            )
            has_warned = True


@contextlib.contextmanager
def _explain_loss(address: str, *other_errors: type[Exception]) -> Iterator[None]:
    """Return a context that replaces errors of lost workers or of a lost scheduler by one sentence
    with a remedy.

    `other_errors` are further exceptions with the same cause, which the chunk itself cannot raise.
    """
    from distributed import CancelledError, KilledWorker
    from distributed.comm import CommClosedError

    loss_errors: tuple[type[BaseException], ...] = (CancelledError, CommClosedError, *other_errors)
    try:
        yield
    except KilledWorker as error:
        raise ValueError(
            "a chunk was given up because each worker that had it died: see to the "
            "workers (their memory, say) and run the same again, it goes on from there."
        ) from error
    except loss_errors as error:
        raise ValueError(
            f"the dask cluster at {address} is gone: start it again and run the same again, it goes"
            " on with the chunks that its store lacks."
        ) from error


def _compute_in_worker(
    pickled_request: bytes, columns: SampleColumns
) -> tuple[dict[str, object], Mapping[str, np.ndarray]]:
    """Return the environment of the worker and the results of a chunk by variable."""
    start_jax()
    return describe_environment(), _make_engine_once(pickled_request)(columns)


@functools.cache
def _make_engine_once(pickled_request: bytes) -> EvaluateSamples:
    """Return the engine of a pickled request, which a worker creates once."""
    from distributed import get_worker

    return make_engine(pickle.loads(pickled_request), get_worker().state.nthreads)
