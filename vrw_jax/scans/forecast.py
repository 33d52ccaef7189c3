"""Forecast of the time and memory of a scan, measured on some of its samples."""

from __future__ import annotations

import math
import sys
from pathlib import Path
from time import perf_counter

import numpy as np

from vrw_jax.runtime import with_default_settings
from vrw_jax.scans.collocation_engine import count_cores
from vrw_jax.scans.design import AbstractDesign, SampleColumns
from vrw_jax.scans.execution import find_store
from vrw_jax.scans.measure_catalog import select_catalog
from vrw_jax.scans.planning import ScanPlan

STARTUP_SECONDS = 5.0
"""Time in seconds until the first sample with cached code; see docs/benchmarks/scans.md."""

TYPICAL_MEMORY_BYTES = 0.5e9
"""Typical memory in bytes of code and arrays; see docs/benchmarks/scans.md."""


@with_default_settings
def forecast_scan(plan: ScanPlan, store: str | Path | None = None) -> dict[str, str]:
    """Return sizes, chunks, memory and time of a scan as lines of text, without writing anything.

    Time and memory are measured by computing samples that are spread over the design.
    """
    layout, size = plan.layout, plan.design.size
    catalog = select_catalog(plan.request.model, plan.request.tol)
    store_found = None if store is None else find_store(plan, Path(store), verify=False)
    missing = (
        list(range(layout.n_chunks)) if store_found is None else store_found.find_missing_chunks()
    )
    n_samples_left = sum(math.prod(layout.shape_of_chunk(i)) for i in missing)
    chunk = math.prod(layout.chunk_shape)
    axes = " x ".join(f"{n} {name}" for name, n in zip(layout.dims, layout.shape, strict=True))
    lines = {
        "samples": f"{size:,} ({axes})",
        "measures": ", ".join(plan.requested_measures),
        "always included": ", ".join(catalog.always_included),
        "chunks": f"{layout.n_chunks:,} of up to {chunk:,} samples, {len(missing):,} to compute",
        "result": f"{_format_bytes(size * layout.bytes_per_sample)} before compression",
    }
    if not n_samples_left:
        return lines | {"time": "none: the store is complete"}
    n = min(n_samples_left, catalog.forecast_samples_per_core * count_cores())
    engine = plan.build_engine()
    start_time = perf_counter()
    engine(_select_spread_samples(plan.design, 1))
    compiled_time = perf_counter()
    engine(_select_spread_samples(plan.design, n))
    rate = n / (perf_counter() - compiled_time)
    memory = _measure_peak_memory() + chunk * 2 * layout.bytes_per_sample
    return lines | {
        "memory": f"about {_format_bytes(memory)}, "
        + ("whatever the number of samples" if store is not None else "plus the result"),
        "time": f"about {format_seconds(n_samples_left / rate + STARTUP_SECONDS)}: "
        f"{n_samples_left:,} samples at {rate:,.0f} per "
        f"second on {count_cores()} cores, {STARTUP_SECONDS:.0f} s to start",
        "measured": f"just now, on {n:,} samples spread over the design; the code for it took "
        f"{compiled_time - start_time:.0f} s and is kept",
    }


def _select_spread_samples(design: AbstractDesign, n: int) -> SampleColumns:
    """Return `n` samples that are spread evenly over a design."""
    numbers = np.linspace(0, design.size - 1, n).round().astype(np.int64)
    places = zip(*np.unravel_index(numbers, design.shape), strict=True)
    single_samples = [
        design.sample_block(tuple(slice(int(i), int(i) + 1) for i in place)) for place in places
    ]
    return {
        name: np.concatenate([block[name] for block in single_samples]) for name in design.names
    }


def _measure_peak_memory() -> float:
    """Return the peak memory of this process, in bytes."""
    try:
        import resource
    except ImportError:  # Windows does not report it.
        return TYPICAL_MEMORY_BYTES
    unit = 1 if sys.platform == "darwin" else 1024
    return float(unit) * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def _format_bytes(n_bytes: int | float) -> str:
    """Return a number of bytes as text with a unit."""
    for unit in ("B", "kB", "MB"):
        if n_bytes < 1000:
            return f"{n_bytes:.3g} {unit}"
        n_bytes /= 1000
    return f"{n_bytes:.3g} GB"


def format_seconds(seconds: float) -> str:
    """Return a time, given in seconds, as text in s, min or h."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
