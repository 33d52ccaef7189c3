"""Start of a process, disk cache, and notices during long calls."""

from vrw_jax.runtime.progress import PROGRESS_VARIABLE, announce_wait, report_progress
from vrw_jax.runtime.start import start_jax
from vrw_jax.simd import disk_cache
from vrw_jax.simd.disk_cache import compute_source_digest, find_library_version
