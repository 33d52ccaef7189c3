"""Forecast of a scan's computing time and memory, measured while some samples are computed."""

from __future__ import annotations

import math
import sys
from pathlib import Path
from time import perf_counter

import numpy as np

from vrw_jax import lanes
from vrw_jax.lanes.settings import with_default_jax_settings
from vrw_jax.studies.scan_design import AbstractSampleDesign, ParameterSamples
from vrw_jax.studies.scan_execution import find_matching_store
from vrw_jax.studies.scan_planning import ScanPlan

SCAN_STARTUP_SECONDS = 5.0
"""Typical time until the first sample is computed with cached code, s; see
docs/benchmarks/scans.md.
"""

TYPICAL_SCAN_MEMORY_BYTES = 500_000_000
"""Typical memory that code and arrays of a scan occupy, bytes; see docs/benchmarks/scans.md."""


@with_default_jax_settings
def forecast_scan(scan_plan: ScanPlan, store_path: Path) -> dict[str, str]:
    """Return a forecast of a scan: its size, chunks, memory and time, as texts by label.

    No file is written. Time and memory are measured while samples that are spread over the design
    are computed.

    - `store_path`: folder of the scan's store. Only chunks that are missing in the store are
      forecast.
    """
    result_layout, n_samples = scan_plan.result_layout, scan_plan.design.size
    measure_catalog = scan_plan.measure_catalog
    existing_store = find_matching_store(scan_plan, store_path, verifies_files=False)
    missing_chunks = (
        range(result_layout.n_chunks)
        if existing_store is None
        else existing_store.find_missing_chunks()
    )
    n_missing_samples = sum(
        math.prod(result_layout.compute_chunk_sample_shape(chunk_index))
        for chunk_index in missing_chunks
    )
    chunk_size = math.prod(result_layout.chunk_shape)
    sample_axes_description = " x ".join(
        f"{axis_length} {sample_axis_name}"
        for sample_axis_name, axis_length in zip(
            scan_plan.design.dims, scan_plan.design.shape, strict=True
        )
    )
    forecast_texts = {
        "samples": f"{n_samples:,} ({sample_axes_description})",
        "measures": ", ".join(scan_plan.requested_measures),
        "always included": ", ".join(measure_catalog.always_included_variables),
        "chunks": f"{result_layout.n_chunks:,} of up to {chunk_size:,} samples, "
        f"{len(missing_chunks):,} to compute",
        "result": f"{_format_bytes(n_samples * result_layout.bytes_per_sample)} before compression",
    }
    if not n_missing_samples:
        return forecast_texts | {"time": "none: the store is complete"}
    n_measured_samples = min(
        n_missing_samples, measure_catalog.forecast_samples_per_core * lanes.count_available_cores()
    )
    scan_engine = scan_plan.build_scan_engine()
    start_seconds = perf_counter()
    scan_engine(_select_spread_samples(scan_plan.design, 1))
    compilation_end_seconds = perf_counter()
    scan_engine(_select_spread_samples(scan_plan.design, n_measured_samples))
    samples_per_second = n_measured_samples / (perf_counter() - compilation_end_seconds)
    try:
        import resource

        bytes_per_unit = 1 if sys.platform == "darwin" else 1024
        peak_memory_bytes = bytes_per_unit * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    except ImportError:  # Windows has no such module.
        peak_memory_bytes = TYPICAL_SCAN_MEMORY_BYTES
    forecast_memory_bytes = peak_memory_bytes + chunk_size * 2 * result_layout.bytes_per_sample
    return forecast_texts | {
        "memory": f"about {_format_bytes(forecast_memory_bytes)}, whatever the number of samples",
        "time": f"about "
        f"{format_duration(n_missing_samples / samples_per_second + SCAN_STARTUP_SECONDS)}: "
        f"{n_missing_samples:,} samples at {samples_per_second:,.0f} per "
        f"second on {lanes.count_available_cores()} cores, {SCAN_STARTUP_SECONDS:.0f} s to start",
        "measured": f"just now, on {n_measured_samples:,} samples spread over the design; the code "
        f"for it took {compilation_end_seconds - start_seconds:.0f} s and is kept",
    }


def _select_spread_samples(
    design: AbstractSampleDesign, n_selected_samples: int
) -> ParameterSamples:
    """Return samples that are spread evenly over a design, as one column per parameter."""
    flat_sample_indices = np.linspace(0, design.size - 1, n_selected_samples).round().astype(int)
    axis_indices = np.unravel_index(flat_sample_indices, design.shape)
    indices_by_axis = dict(zip(design.dims, axis_indices, strict=True))
    return {
        parameter_name: parameter_values[indices_by_axis.get(parameter_name, axis_indices[0])]
        for parameter_name, parameter_values in design.values_by_parameter.items()
    }


def _format_bytes(n_bytes: int | float) -> str:
    """Return a text that states a number of bytes in B, kB, MB or GB."""
    for unit_of_bytes in ("B", "kB", "MB"):
        if n_bytes < 1000:
            return f"{n_bytes:.3g} {unit_of_bytes}"
        n_bytes /= 1000
    return f"{n_bytes:.3g} GB"


def format_duration(seconds: float) -> str:
    """Return a text that states a duration in s, min or h.

    - `seconds`: the duration, s.
    """
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
