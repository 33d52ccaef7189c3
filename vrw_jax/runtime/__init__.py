"""Start of a process, disk cache, and notices during long calls."""

from vrw_jax.runtime import disk_cache
from vrw_jax.runtime.disk_cache import compute_source_digest, find_library_version
from vrw_jax.runtime.progress import PROGRESS_VARIABLE, announce_wait, report_progress
from vrw_jax.runtime.start import make_fusion_emitter_options, start_jax
