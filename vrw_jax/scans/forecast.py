"""Forecast of the time and memory of a scan, measured on some of its samples."""

from __future__ import annotations

import math
import sys
from pathlib import Path
from time import perf_counter

import numpy as np

from vrw_jax.scans.design import AbstractDesign, Columns
from vrw_jax.scans.evaluate import n_cores
from vrw_jax.scans.offer import offer_of
from vrw_jax.scans.planning import Plan
from vrw_jax.scans.running import found_store

START = 5.0
"""Time in seconds until the first sample if the compiled code is cached; see docs/scans.md."""

TYPICAL = 0.5e9
"""Typical memory in bytes of code and arrays; see docs/scans.md."""


def explained(planned: Plan, store: str | Path | None = None) -> dict[str, str]:
    """Return sizes, chunks, memory and time of a scan as lines of text, without writing anything.

    Time and memory are measured by computing samples that are spread over the design.
    """
    layout, size = planned.layout, planned.design.size
    offer = offer_of(planned.for_engine.model, planned.for_engine.tol)
    kept = None if store is None else found_store(planned, Path(store), verify=False)
    missing = list(range(layout.n_chunks)) if kept is None else kept.missing()
    left = sum(math.prod(layout.shape_of(i)) for i in missing)
    chunk = math.prod(layout.chunk)
    axes = " x ".join(f"{n} {name}" for name, n in zip(layout.dims, layout.shape, strict=True))
    told = {
        "samples": f"{size:,} ({axes})",
        "measures": ", ".join(planned.asked),
        "always included": ", ".join(offer.always),
        "chunks": f"{layout.n_chunks:,} of up to {chunk:,} samples, {len(missing):,} to compute",
        "result": f"{_bytes(size * layout.bytes_per_sample)} before compression",
    }
    if not left:
        return told | {"time": "none: the store is complete"}
    n = min(left, offer.tried * n_cores())
    engine = planned.engine()
    began = perf_counter()
    engine(_spread(planned.design, 1))
    ready = perf_counter()
    engine(_spread(planned.design, n))
    rate = n / (perf_counter() - ready)
    memory = _peak() + chunk * 2 * layout.bytes_per_sample
    return told | {
        "memory": f"about {_bytes(memory)}, "
        + ("whatever the number of samples" if store is not None else "plus the result"),
        "time": f"about {in_words(left / rate + START)}: {left:,} samples at {rate:,.0f} per "
        f"second on {n_cores()} cores, {START:.0f} s to start",
        "measured": f"just now, on {n:,} samples spread over the design; the code for it took "
        f"{ready - began:.0f} s and is kept",
    }


def _spread(design: AbstractDesign, n: int) -> Columns:
    """Return `n` samples that are spread evenly over a design."""
    numbers = np.linspace(0, design.size - 1, n).round().astype(np.int64)
    places = zip(*np.unravel_index(numbers, design.shape), strict=True)
    one = [design.block(tuple(slice(int(i), int(i) + 1) for i in place)) for place in places]
    return {name: np.concatenate([block[name] for block in one]) for name in design.names}


def _peak() -> float:
    """Return the peak memory of this process, in bytes."""
    try:
        import resource
    except ImportError:  # on Windows
        return TYPICAL
    unit = 1 if sys.platform == "darwin" else 1024
    return float(unit) * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def _bytes(n: int | float) -> str:
    """Return a number of bytes as text with a unit."""
    for unit in ("B", "kB", "MB"):
        if n < 1000:
            return f"{n:.3g} {unit}"
        n /= 1000
    return f"{n:.3g} GB"


def in_words(t: float) -> str:
    """Return a time, given in seconds, as text in s, min or h."""
    if t < 90:
        return f"{t:.0f} s"
    return f"{t / 60:.0f} min" if t < 5400 else f"{t / 3600:.1f} h"
