"""Python functions that JAX programs call, and that run JAX programs themselves."""

import os
import threading
from collections.abc import Callable
from typing import Any

import jax
from jax._src import xla_bridge

from vrw_jax.lanes.program import count_available_cores

_spare_threads: list[threading.Semaphore] = []
"""Counter of XLA's threads that Python functions may hold, if JAX dispatches synchronously."""


def dispatch_cpu_programs_synchronously() -> None:
    """Let JAX run programs for CPUs in the threads that call them, unless an array exists already.

    With asynchronous dispatch, programs that wait for Python functions can take all threads that
    these functions need.
    """
    # XLA has one thread for each core, or as many as this variable states.
    n_threads = int(os.environ.get("NPROC") or count_available_cores())
    if n_threads > 1 and not xla_bridge.backends_are_initialized() and not _spare_threads:
        jax.config.update("jax_cpu_enable_async_dispatch", False)
        _spare_threads.append(threading.Semaphore(n_threads - 1))


def can_programs_call_jax() -> bool:
    """Return whether a Python function that a JAX program calls may run JAX programs itself.

    Each such call holds one of XLA's threads, and several devices would call at the same time.
    """
    is_one_cpu = jax.default_backend() == "cpu" and jax.local_device_count() == 1
    return bool(_spare_threads) and is_one_cpu


def call_python(
    function: Callable, result_types: Any, *arguments: Any, vmap_method: str | None = None
) -> Any:
    """Return the results of a Python function that may run JAX programs, as `jax.pure_callback`.

    Use it only where `can_programs_call_jax` allows it.
    """

    def call_unless_threads_are_missing(*arrays: Any) -> Any:
        if not _spare_threads[0].acquire(blocking=False):
            raise RuntimeError(
                "as many searches inside jax.jit walk at the same time as there are cores, and "
                "would wait for each other: run these programs one after another."
            )
        try:
            return function(*arrays)
        finally:
            _spare_threads[0].release()

    return jax.pure_callback(
        call_unless_threads_are_missing, result_types, *arguments, vmap_method=vmap_method
    )
