"""Scans on the workers of a dask cluster: each chunk of `run_scan` is computed by a free worker.

Workers only compute, and the calling process writes the store. If a worker dies, other workers
compute its chunks. Workers return a description of their environment. A chunk from an environment
other than that of the calling process is refused, because its last digits might differ.
"""

import asyncio
import contextlib
import functools
import itertools
import pickle
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
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
    from distributed import Client

QUEUED_CHUNKS_PER_THREAD = 2
"""Number of submitted chunks per thread, chosen to keep a thread busy with little memory."""

SCHEDULER_TIMEOUT = "10s"
"""Longest time until a scheduler responds."""


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
    with contextlib.ExitStack() as stack:
        if address == "local":
            cluster = LocalCluster(
                n_workers=count_cores(), threads_per_worker=1, dashboard_address=None
            )
            client = Client(stack.enter_context(cluster), set_as_default=False)
        else:
            try:
                _require_response(address)
                client = Client(address, timeout=SCHEDULER_TIMEOUT, set_as_default=False)
            except Exception as error:  # Libraries raise different errors for a wrong address.
                raise ValueError(
                    f"no dask scheduler answers at {address!r}: give the address that it printed "
                    "when it started, such as tcp://host:8786, or 'local'."
                ) from error
        stack.enter_context(client)
        yield functools.partial(_compute_chunks, client)


def _require_response(address: str) -> None:
    """Raise unless a scheduler responds at `address`; a client would wait for ever."""
    from dask.utils import parse_timedelta
    from distributed.comm import connect
    from distributed.security import Security

    async def connect_once() -> None:
        arguments = Security().get_connection_args("client")
        seconds = parse_timedelta(SCHEDULER_TIMEOUT)
        comm = await asyncio.wait_for(connect(address, timeout=seconds, **arguments), 2 * seconds)
        comm.abort()

    with ThreadPoolExecutor(1) as pool:  # The event loop of a notebook is busy.
        pool.submit(asyncio.run, connect_once()).result()


def _compute_chunks(
    client: "Client", plan: ScanPlan, missing: Sequence[int]
) -> Iterator[ChunkResult]:
    """Yield the results of the missing chunks in the order of completion."""
    from distributed import Future, KilledWorker, as_completed

    pickled_request = pickle.dumps(plan.request)
    local_environment, remaining_chunks = describe_environment(), iter(missing)
    chunk_of_future: dict[Future, int] = {}
    completed_futures = as_completed(loop=client.loop)

    def submit_chunks() -> None:
        """Submit chunks until every thread of the cluster has enough."""
        n_free = QUEUED_CHUNKS_PER_THREAD * max(1, sum(client.nthreads().values())) - len(
            chunk_of_future
        )
        for index in itertools.islice(remaining_chunks, max(n_free, 0)):
            columns = plan.design.sample_block(plan.layout.chunk_region(index))
            future = client.submit(_compute_in_worker, pickled_request, columns, pure=False)
            chunk_of_future[future] = index
            completed_futures.add(future)

    try:
        submit_chunks()
        for future in completed_futures:
            try:
                worker_environment, results = future.result()
            except KilledWorker as error:
                raise ValueError(
                    "a chunk was given up because each worker that had it died: see to the "
                    "workers (their memory, say) and run the same again, it goes on from there."
                ) from error
            environment_difference = describe_difference(local_environment, worker_environment)
            if environment_difference:
                raise ValueError(
                    "a worker computes by other means than this process: "
                    f"{environment_difference}. "
                    "Start the workers from the same installation on machines of one kind."
                )
            yield chunk_of_future.pop(future), results
            del future  # lets the cluster release its result
            submit_chunks()
    finally:
        client.cancel(list(chunk_of_future))


def _compute_in_worker(
    pickled_request: bytes, columns: SampleColumns
) -> tuple[dict[str, object], Mapping[str, np.ndarray]]:
    """Return the environment of the worker and the results of a chunk."""
    start_jax()
    return describe_environment(), _make_engine_once(pickled_request)(columns)


@functools.cache
def _make_engine_once(pickled_request: bytes) -> EvaluateSamples:
    """Return the engine of a pickled request, which a worker creates once."""
    from distributed import get_worker

    return make_engine(pickle.loads(pickled_request), get_worker().state.nthreads)
