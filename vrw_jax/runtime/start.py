"""Start-up configuration of a process: 64-bit numbers, a compilation cache, fast compilation."""

import contextlib
import os
import sys
from pathlib import Path

import jax

from vrw_jax.runtime import disk_cache as store
from vrw_jax.validation import check_bool, check_type


def start_jax(cache: str | Path | None = None, *, trust_shared: bool = False) -> None:
    """64-bit numbers, compiled code kept in `cache`, and on a CPU the quicker of XLA's two ways.

    Call it before the first array is created. The library works without it, but with it processes
    start in a fraction of the time. Without `cache` it uses the folder in
    JAX_COMPILATION_CACHE_DIR, or else one in the user's cache folder.

    Args:
        cache: folder of compiled code; `~` is the user's own.
        trust_shared: whether a folder that belongs to somebody else, or that others can write, is
            used all the same: all who can write there can run code as you.

    Returns:
        Nothing.

    Raises:
        TypeError: a `cache` that is no path.
        NotADirectoryError: a `cache` that is a file.
        PermissionError: a folder in which somebody else may have put code.

    Examples:
        >>> vrw.start_jax("~/.cache/vrw_jax")  # doctest: +SKIP
    """
    if cache is not None:
        check_type("cache", cache, (str, Path), "give a folder, or nothing for the user's own")
        cache = Path(cache).expanduser()
        if cache.is_file():
            raise NotADirectoryError(
                f"cache is {cache}, a file, but compiled code is kept in a folder: give a folder."
            )
    if check_bool("trust_shared", trust_shared):
        os.environ[store.TRUST_SHARED_VARIABLE] = "1"  # child processes too
    jax.config.update("jax_enable_x64", True)
    if cache is not None or "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        folder = _user_cache_folder() / "vrw_jax" if cache is None else cache
        jax.config.update("jax_compilation_cache_dir", str(folder))
    _require_own_cache()
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)
    flags = os.environ.get("XLA_FLAGS", "")
    if _IS_FLAG_KNOWN and _EMITTERS_FLAG not in flags:  # read when the first array is created
        os.environ["XLA_FLAGS"] = f"{flags} --{_EMITTERS_FLAG}=false".strip()


def _require_own_cache() -> None:
    """Make the cache's folder, the user's alone; refuse one that others can write."""
    place = jax.config.jax_compilation_cache_dir  # type: ignore[attr-defined]
    if not place or "://" in place:
        return
    refused = store.refuse_folder(Path(place))
    if refused:
        jax.config.update("jax_compilation_cache_dir", None)
        raise PermissionError(f"{refused}.")
    with contextlib.suppress(OSError):  # then nothing is kept
        store.make_folder(Path(place))


def fusion_emitter_options(is_enabled: bool) -> dict[str, str | bool]:
    """Return options for `jax.jit` that select XLA's fusion emitters on or off for a program on a
    CPU.

    Without them, XLA compiles in half to two thirds of the time. The code is as fast or, for events
    with unilateral contact, slower by a seventh. Programs whose digits must not depend on the
    process always set the option.
    """
    return {_EMITTERS_FLAG: is_enabled} if _IS_FLAG_KNOWN and jax.default_backend() == "cpu" else {}


_EMITTERS_FLAG = "xla_cpu_use_fusion_emitters"

_IS_FLAG_KNOWN = jax.__version_info__[:2] in ((0, 9), (0, 10))
"""Whether this version of XLA is known to accept the flag: others may abort the process."""


def _user_cache_folder() -> Path:
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", Path.home() / "AppData" / "Local"))
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
