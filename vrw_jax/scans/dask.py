"""Scans on the workers of a dask cluster: each chunk of `run_scan` is computed by a free worker.

Workers only compute, and the calling process writes the store. If a worker dies, other workers
compute its chunks. Workers return a description of their environment. A chunk from an environment
other than that of the calling process is refused, because its last digits might differ.
"""

import contextlib
import functools
import itertools
import pickle
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from vrw_jax.runtime import start_jax
from vrw_jax.scans.design import Columns
from vrw_jax.scans.evaluate import n_cores
from vrw_jax.scans.ground import engine_for
from vrw_jax.scans.planning import Chunk, Evaluate, Plan, Through, difference, origin

if TYPE_CHECKING:
    from distributed import Client

AHEAD = 2
"""Number of submitted chunks per thread, chosen to keep a thread busy with little memory."""

ANSWER = "10s"
"""Longest time in which a scheduler must respond."""


@contextlib.contextmanager
def workers(address: str) -> Iterator[Through]:
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
                n_workers=n_cores(), threads_per_worker=1, dashboard_address=None
            )
            client = Client(stack.enter_context(cluster), set_as_default=False)
        else:
            try:
                client = Client(address, timeout=ANSWER, set_as_default=False)
            except (OSError, ValueError) as error:  # no response, or an invalid address
                raise ValueError(
                    f"no dask scheduler answers at {address!r}: give the address that it printed "
                    "when it started, such as tcp://host:8786, or 'local'."
                ) from error
        stack.enter_context(client)
        yield functools.partial(_chunks, client)


def _chunks(client: "Client", planned: Plan, missing: Sequence[int]) -> Iterator[Chunk]:
    """Yield the results of the missing chunks in the order of completion."""
    from distributed import Future, KilledWorker, as_completed

    recipe = pickle.dumps(planned.for_engine)
    here, waiting = origin(), iter(missing)
    held: dict[Future, int] = {}
    coming = as_completed(loop=client.loop)

    def fill() -> None:
        """Submit chunks until every thread of the cluster has enough."""
        room = AHEAD * max(1, sum(client.nthreads().values())) - len(held)
        for index in itertools.islice(waiting, max(room, 0)):
            columns = planned.design.block(planned.layout.region(index))
            future = client.submit(_computed, recipe, columns, pure=False)
            held[future] = index
            coming.add(future)

    try:
        fill()
        for future in coming:
            try:
                there, results = future.result()
            except KilledWorker as error:
                raise ValueError(
                    "a chunk was given up because each worker that had it died: see to the "
                    "workers (their memory, say) and run the same again, it goes on from there."
                ) from error
            told = difference(here, there)
            if told:
                raise ValueError(
                    f"a worker computes by other means than this process: {told}. "
                    "Start the workers from the same installation on machines of one kind."
                )
            yield held.pop(future), results
            del future  # lets the cluster release its result
            fill()
    finally:
        client.cancel(list(held))


def _computed(
    recipe: bytes, columns: Columns
) -> tuple[dict[str, object], Mapping[str, np.ndarray]]:
    """Return the environment of the worker and the results of a chunk."""
    start_jax()
    return origin(), _engine(recipe)(columns)


@functools.cache
def _engine(recipe: bytes) -> Evaluate:
    """Return the engine of a pickled request, which a worker creates once."""
    from distributed import get_worker

    return engine_for(pickle.loads(recipe), get_worker().state.nthreads)
