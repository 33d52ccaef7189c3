"""How a process of its own computes: 64-bit numbers, compiled code kept between runs."""

import os
import sys
from pathlib import Path

import jax


def start_jax() -> None:
    """64-bit numbers, and compiled code kept in the user's cache folder.

    JAX_COMPILATION_CACHE_DIR names another folder.
    """
    jax.config.update("jax_enable_x64", True)
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        jax.config.update("jax_compilation_cache_dir", str(_cache_folder() / "vrw_jax"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)


def _cache_folder() -> Path:
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", Path.home() / "AppData" / "Local"))
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
