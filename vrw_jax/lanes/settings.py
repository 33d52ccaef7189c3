"""JAX settings that this library needs, and Python functions that JAX programs call."""

import functools
import os
import threading
from collections.abc import Callable
from typing import Any, TypeVar

import jax
from jax._src import xla_bridge

FunctionType = TypeVar("FunctionType", bound=Callable[..., Any])

FUSION_EMITTERS_FLAG = "xla_cpu_use_fusion_emitters"
"""Flag of XLA that switches its fusion emitters for CPUs."""


def with_default_jax_settings(function: FunctionType) -> FunctionType:
    """Return a function that runs `function` with JAX's default settings.

    `jax_disable_jit` and strict promotion of ranks and dtypes help to find faults in the caller's
    code. But only compiled programs can call this library's machine code, and its formulas accept
    numbers, batches and derivatives of any rank. The caller's settings are restored when `function`
    returns.
    """

    @functools.wraps(function)
    def call_with_default_settings(*args: Any, **keywords: Any) -> Any:
        jax_config: Any = jax.config
        has_default_jax_settings = (
            not jax_config.jax_disable_jit
            and jax_config.jax_numpy_rank_promotion == "allow"
            and jax_config.jax_numpy_dtype_promotion == "standard"
        )
        try:
            if has_default_jax_settings:
                return function(*args, **keywords)
            with (
                jax.disable_jit(False),
                jax.numpy_rank_promotion("allow"),
                jax.numpy_dtype_promotion("standard"),
            ):
                return function(*args, **keywords)
        except KeyboardInterrupt as interruption:
            if not interruption.args:
                raise
            # The frames of the library would hide a message that states what is kept.
            raise interruption.with_traceback(None) from None

    return call_with_default_settings  # type: ignore[return-value]


def make_fusion_emitter_options(are_fusion_emitters_enabled: bool) -> dict[str, str | bool]:
    """Return options for `jax.jit` that switch XLA's fusion emitters on or off on a CPU.

    Without fusion emitters, XLA compiles in half to two thirds of the time. The compiled code is as
    fast, except for events with unilateral contact, where it is slower by a seventh. Programs whose
    digits must not depend on the process always set this option.
    """
    can_set_emitters_flag = accepts_fusion_emitters_flag() and jax.default_backend() == "cpu"
    return {FUSION_EMITTERS_FLAG: are_fusion_emitters_enabled} if can_set_emitters_flag else {}


def accepts_fusion_emitters_flag() -> bool:
    """Return whether this version of XLA accepts the flag for fusion emitters.

    A version that does not accept the flag may abort the process on receiving it.
    """
    return jax.__version_info__[:2] in ((0, 9), (0, 10))


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


def count_available_cores() -> int:
    """Return the number of processor cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
