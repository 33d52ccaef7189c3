"""Python functions that JAX programs call, and that run JAX programs themselves."""

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
    if not xla_bridge.backends_are_initialized() and not _spare_threads:
        jax.config.update("jax_cpu_enable_async_dispatch", False)
        _spare_threads.append(threading.Semaphore(count_available_cores() - 1))


def can_programs_call_jax() -> bool:
    """Return whether a Python function that a JAX program calls may run JAX programs itself.

    Each such call holds a thread, and XLA has one thread for each core.
    """
    return bool(_spare_threads) and count_available_cores() > 1 and jax.default_backend() == "cpu"


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
