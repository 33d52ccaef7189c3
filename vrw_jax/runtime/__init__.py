"""Start of a process, lazily imported libraries, disk cache and compiled programs."""

from vrw_jax.runtime import disk_cache
from vrw_jax.runtime.cached_programs import (
    cached_lane_function,
    cached_lane_program,
    cached_trace,
    compile_exported,
)
from vrw_jax.runtime.disk_cache import source_digest
from vrw_jax.runtime.lazy_import import lazy_import, xarray
from vrw_jax.runtime.settings import with_default_settings
from vrw_jax.runtime.start import start_jax
