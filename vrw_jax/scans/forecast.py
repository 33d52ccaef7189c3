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
"""Typical time until the first sample with cached code, s; see docs/benchmarks/scans.md."""

TYPICAL_MEMORY_BYTES = 0.5e9
"""Typical memory of code and arrays, in bytes; see docs/benchmarks/scans.md."""


@with_default_settings
def forecast_scan(plan: ScanPlan, store: str | Path | None = None) -> dict[str, str]:
    """Return sizes, chunks, memory and time of a scan as texts by name; nothing is written.

    Time and memory are measured by computing samples that are spread over the design.
    """
    layout, n_samples = plan.layout, plan.design.size
    catalog = select_catalog(plan.request.model, plan.request.tol, plan.request.slope_sd)
    existing_store = None if store is None else find_store(plan, Path(store), verify=False)
    missing_chunks = (
        list(range(layout.n_chunks))
        if existing_store is None
        else existing_store.find_missing_chunks()
    )
    n_samples_left = sum(
        math.prod(layout.shape_of_chunk(chunk_index)) for chunk_index in missing_chunks
    )
    chunk_size = math.prod(layout.chunk_shape)
    axes_text = " x ".join(
        f"{n_measured} {name}" for name, n_measured in zip(layout.dims, layout.shape, strict=True)
    )
    forecast = {
        "samples": f"{n_samples:,} ({axes_text})",
        "measures": ", ".join(plan.requested_measures),
        "always included": ", ".join(catalog.always_included),
        "chunks": f"{layout.n_chunks:,} of up to {chunk_size:,} samples, "
        f"{len(missing_chunks):,} to compute",
        "result": f"{_format_bytes(n_samples * layout.bytes_per_sample)} before compression",
    }
    if not n_samples_left:
        return forecast | {"time": "none: the store is complete"}
    n_measured = min(n_samples_left, catalog.forecast_samples_per_core * count_cores())
    engine = plan.build_engine()
    start_time = perf_counter()
    engine(_select_spread_samples(plan.design, 1))
    compiled_time = perf_counter()
    engine(_select_spread_samples(plan.design, n_measured))
    samples_per_second = n_measured / (perf_counter() - compiled_time)
    memory_bytes = _measure_peak_memory() + chunk_size * 2 * layout.bytes_per_sample
    return forecast | {
        "memory": f"about {_format_bytes(memory_bytes)}, "
        + ("whatever the number of samples" if store is not None else "plus the result"),
        "time": f"about {format_seconds(n_samples_left / samples_per_second + STARTUP_SECONDS)}: "
        f"{n_samples_left:,} samples at {samples_per_second:,.0f} per "
        f"second on {count_cores()} cores, {STARTUP_SECONDS:.0f} s to start",
        "measured": f"just now, on {n_measured:,} samples spread over the design; the code "
        f"for it took {compiled_time - start_time:.0f} s and is kept",
    }


def _select_spread_samples(design: AbstractDesign, n_selected: int) -> SampleColumns:
    """Return samples that are spread evenly over a design, by parameter."""
    sample_numbers = np.linspace(0, design.size - 1, n_selected).round().astype(np.int64)
    sample_indices = zip(*np.unravel_index(sample_numbers, design.shape), strict=True)
    single_samples = [
        design.sample_block(tuple(slice(int(i), int(i) + 1) for i in index_of_sample))
        for index_of_sample in sample_indices
    ]
    return {
        name: np.concatenate([sample_columns[name] for sample_columns in single_samples])
        for name in design.names
    }


def _measure_peak_memory() -> float:
    """Return the peak memory of this process, in bytes."""
    try:
        import resource
    except ImportError:  # Windows has no such module.
        return TYPICAL_MEMORY_BYTES
    bytes_per_unit = 1 if sys.platform == "darwin" else 1024
    return float(bytes_per_unit) * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def _format_bytes(n_bytes: int | float) -> str:
    """Return a number of bytes as text with a unit."""
    for unit in ("B", "kB", "MB"):
        if n_bytes < 1000:
            return f"{n_bytes:.3g} {unit}"
        n_bytes /= 1000
    return f"{n_bytes:.3g} GB"


def format_seconds(seconds: float) -> str:
    """Return a time in seconds as text in s, min or h."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
