"""Start of a process, lazy import of libraries, and disk cache."""

from vrw_jax.runtime import disk_cache
from vrw_jax.runtime.disk_cache import compute_source_digest
from vrw_jax.runtime.lazy_import import lazy_import
from vrw_jax.runtime.start import make_fusion_emitter_options, start_jax
