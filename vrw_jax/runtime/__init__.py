"""Start of a process, and disk cache."""

from vrw_jax.runtime import disk_cache
from vrw_jax.runtime.disk_cache import compute_source_digest, find_library_version
from vrw_jax.runtime.start import make_fusion_emitter_options, start_jax
