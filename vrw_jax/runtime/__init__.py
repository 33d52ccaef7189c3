"""Process-wide runtime: number format, lazily imported libraries, disk cache, compiled programs."""

from vrw_jax.runtime.lazy import lazy_import, xarray
from vrw_jax.runtime.programs import (
    cached_lane_function,
    cached_lane_program,
    cached_trace,
    compile_exported,
)
from vrw_jax.runtime.start import start_jax
from vrw_jax.runtime.store import source_digest
