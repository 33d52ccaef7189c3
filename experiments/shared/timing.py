"""Clocks of one core, and a start with nothing compiled before."""

import contextlib
import os
import platform
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import jax
from jax.experimental.compilation_cache import compilation_cache

import vrw_jax as vrw
from vrw_jax.simd import code_cache as code


@contextlib.contextmanager
def use_one_core() -> Iterator[None]:
    """All threads on one core: two that wait for each other would both be counted."""
    if not hasattr(os, "sched_setaffinity"):  # Linux alone has it
        yield
        return
    cores = os.sched_getaffinity(0)
    threads = [int(name) for name in os.listdir("/proc/self/task")]
    for thread in threads:
        with contextlib.suppress(ProcessLookupError):  # it has ended since
            os.sched_setaffinity(thread, {max(cores)})
    try:
        yield
    finally:
        for thread in map(int, os.listdir("/proc/self/task")):
            with contextlib.suppress(ProcessLookupError):
                os.sched_setaffinity(thread, cores)


def start_without_cache() -> None:
    """JAX as users start it, on a CPU's one thread, its cache thrown away with what it held."""
    global _cache
    os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false")
    jax.config.update("jax_platforms", "cpu")
    jax.clear_caches()
    code._code_by_name.clear()
    _cache = tempfile.TemporaryDirectory()
    vrw.start_jax(_cache.name)
    compilation_cache.reset_cache()  # it may have opened another folder


def measure_cpu_seconds(
    call: Callable[[], object],
    repeats: int = 5,
    enough: float = float("inf"),
    result: Callable[[list[float]], float] = statistics.median,
) -> float:
    """CPU time of a call that has been made before: the median of repeats, or what else is told.

    Repeats end once they have taken `enough` seconds.
    """
    used_values: list[float] = []
    while not used_values or (len(used_values) < repeats and sum(used_values) < enough):
        began = time.process_time()
        jax.block_until_ready(call())
        used_values.append(time.process_time() - began)
    return result(used_values)


def describe_processor() -> str:
    """The CPU's own name, and how wide its vectors are."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    name = next((x.split(":")[1].strip() for x in lines if x.startswith("model name")), "a CPU")
    flags = next((x for x in lines if x.startswith("flags")), "")
    wide = " AVX-512" if "avx512f" in flags else " AVX2" if "avx2" in flags else ""
    return name + wide
