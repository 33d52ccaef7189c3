"""Measure CPU time on one core, and start JAX without compiled programs."""

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
from vrw_jax.lanes import machine_code as code


@contextlib.contextmanager
def use_one_core() -> Iterator[None]:
    """Run all threads on one core, because two threads that wait for each other would both be
    counted."""
    if not hasattr(os, "sched_setaffinity"):  # Only Linux has the function.
        yield
        return
    cores = os.sched_getaffinity(0)
    threads = [int(name) for name in os.listdir("/proc/self/task")]
    for thread in threads:
        with contextlib.suppress(ProcessLookupError):  # The thread may have ended.
            os.sched_setaffinity(thread, {max(cores)})
    try:
        yield
    finally:
        for thread in map(int, os.listdir("/proc/self/task")):
            with contextlib.suppress(ProcessLookupError):
                os.sched_setaffinity(thread, cores)


def start_without_cache() -> None:
    """Start JAX as users do, on one thread of the CPU, with empty caches on disk and in memory."""
    global _cache
    os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false")
    jax.config.update("jax_platforms", "cpu")
    jax.clear_caches()
    code._machine_code_by_name.clear()
    code._lane_program_by_index_name.clear()
    _cache = tempfile.TemporaryDirectory()
    vrw.start_jax(_cache.name)
    compilation_cache.reset_cache()  # The cache may have opened another folder.


def measure_cpu_seconds(
    call: Callable[[], object],
    repeats: int = 5,
    max_seconds: float = float("inf"),
    reduction: Callable[[list[float]], float] = statistics.median,
) -> float:
    """Return the CPU time of a call that has run before, s; by default the median of the repeats.

    Repeats end when they have taken `max_seconds` together. `reduction` converts the times of the
    repeats to one number.
    """
    seconds: list[float] = []
    while not seconds or (len(seconds) < repeats and sum(seconds) < max_seconds):
        start_time = time.process_time()
        jax.block_until_ready(call())
        seconds.append(time.process_time() - start_time)
    return reduction(seconds)


def describe_processor() -> str:
    """Return the name of the CPU and its widest vector instructions."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    name = next((x.split(":")[1].strip() for x in lines if x.startswith("model name")), "a CPU")
    flags = next((x for x in lines if x.startswith("flags")), "")
    vector_instructions = " AVX-512" if "avx512f" in flags else " AVX2" if "avx2" in flags else ""
    return name + vector_instructions
