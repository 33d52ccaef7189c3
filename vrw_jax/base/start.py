"""Start-up configuration of a process: 64-bit numbers, a compilation cache, and fast
compilation.
"""

import contextlib
import os
from pathlib import Path

import jax

from vrw_jax.base.checks import check_bool, check_path
from vrw_jax.lanes import disk_cache as store
from vrw_jax.lanes.python_calls import dispatch_cpu_programs_synchronously
from vrw_jax.lanes.settings import (
    FUSION_EMITTERS_FLAG,
    accepts_fusion_emitters_flag,
)


def start_jax(cache: str | Path | None = None, *, trust_shared: bool = False) -> None:
    """Configure JAX: 64-bit numbers, a cache for compiled code, and faster XLA compilation on CPUs.

    Call this function before the first array is created. The library also works without this call,
    but processes then take much longer to start. By default, `cache` is the folder that JAX already
    uses, set by JAX_COMPILATION_CACHE_DIR or by an earlier call. If JAX uses none, it is a folder
    in the user's cache folder. A call on a CPU returns when its results are computed, since
    `jax_cpu_enable_async_dispatch` is switched off. Searches for gaits inside `jax.jit` can then
    walk.

    Args:
        cache: folder for compiled code; `~` means the user's home folder.
        trust_shared: whether to use a folder that belongs to another user, or to which other users
            can write. Everyone who can write to the folder can then run code as you.

    Returns:
        Nothing.

    Raises:
        TypeError: if `cache` is not a path.
        NotADirectoryError: if `cache` is a file.
        PermissionError: if another user may have put code into the folder.

    Examples:
        >>> vrw.start_jax("~/.cache/vrw_jax")  # doctest: +SKIP
    """
    if cache is not None:
        cache = check_path("cache", cache, "give a folder, or nothing for the user's own")
        if cache.is_file():
            raise NotADirectoryError(
                f"cache is {cache}, a file, but compiled code is kept in a folder: give a folder."
            )
    if check_bool("trust_shared", trust_shared):
        os.environ[store.TRUST_SHARED_CACHE_VARIABLE] = (
            "1"  # The setting also holds for child processes.
        )
    jax.config.update("jax_enable_x64", True)
    dispatch_cpu_programs_synchronously()
    if cache is not None or not jax.config.jax_compilation_cache_dir:  # type: ignore[attr-defined]
        jax_cache_folder = store.find_user_cache_folder() / "vrw_jax" if cache is None else cache
        jax.config.update("jax_compilation_cache_dir", str(jax_cache_folder))
    cache_folder = jax.config.jax_compilation_cache_dir  # type: ignore[attr-defined]
    if cache_folder and "://" not in cache_folder:  # A storage bucket is no folder.
        distrust_reason = store.explain_cache_folder_distrust(Path(cache_folder))
        if distrust_reason:
            jax.config.update("jax_compilation_cache_dir", None)
            raise PermissionError(f"{distrust_reason}.")
        with contextlib.suppress(OSError):  # Without the folder nothing is cached.
            store.create_cache_folder(Path(cache_folder))
    min_seconds = jax.config.jax_persistent_cache_min_compile_time_secs  # type: ignore[attr-defined]
    jax.config.update("jax_persistent_cache_min_compile_time_secs", min(min_seconds, 0.2))
    xla_flags = os.environ.get("XLA_FLAGS", "")
    # XLA reads the flags when the first array is created.
    if accepts_fusion_emitters_flag() and FUSION_EMITTERS_FLAG not in xla_flags:
        os.environ["XLA_FLAGS"] = f"{xla_flags} --{FUSION_EMITTERS_FLAG}=false".strip()
