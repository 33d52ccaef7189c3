"""Start of a process, lazy import of libraries, disk cache and compiled programs."""

from vrw_jax.runtime import disk_cache
from vrw_jax.runtime.cached_programs import (
    call_through_saved_trace,
    compile_cached_lane_function,
    compile_cached_lane_program,
    compile_exported_function,
)
from vrw_jax.runtime.disk_cache import compute_source_digest
from vrw_jax.runtime.lazy_import import lazy_import, xarray
from vrw_jax.runtime.settings import with_default_jax_settings
from vrw_jax.runtime.start import start_jax
