"""Float64, a persistent compilation cache, and shapes checked against signatures."""

import os
from pathlib import Path

import jax
from jaxtyping import install_import_hook

jax.config.update("jax_enable_x64", True)
_CACHE = os.environ.get("VRW_TEST_CACHE", str(Path(__file__).parent.parent / ".jax_cache"))
jax.config.update("jax_compilation_cache_dir", _CACHE)
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)

with install_import_hook("vrw_jax", "beartype.beartype"):
    import vrw_jax  # noqa: F401  imported here so that its annotations are checked
