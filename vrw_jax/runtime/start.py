"""How a process of its own computes: 64-bit numbers, compiled code kept, a quick compiler."""

import os
import sys
from pathlib import Path

import jax

from vrw_jax.wording import instance


def start_jax(cache: str | Path | None = None) -> None:
    """64-bit numbers, compiled code kept in `cache`, and on a CPU the quicker of XLA's two ways.

    To be called before the first array is made; nothing here needs it, but processes start in a
    fraction of the time. Without `cache` it is the folder that JAX_COMPILATION_CACHE_DIR names, or
    else one of the user's cache folder.

    Args:
        cache: folder of compiled code; `~` is the user's own.

    Returns:
        Nothing.

    Raises:
        TypeError: a `cache` that is no path.
        NotADirectoryError: a `cache` that is a file.

    Examples:
        >>> vrw.start_jax("~/.cache/vrw_jax")  # doctest: +SKIP
    """
    if cache is not None:
        instance("cache", cache, (str, Path), "give a folder, or nothing for the user's own")
        cache = Path(cache).expanduser()
        if cache.is_file():
            raise NotADirectoryError(
                f"cache is {cache}, a file, but compiled code is kept in a folder: give a folder."
            )
    jax.config.update("jax_enable_x64", True)
    if cache is not None or "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        folder = _cache_folder() / "vrw_jax" if cache is None else cache
        jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)
    flags = os.environ.get("XLA_FLAGS", "")
    if _KNOWN and _EMITTERS not in flags:  # read when the first array is made
        os.environ["XLA_FLAGS"] = f"{flags} --{_EMITTERS}=false".strip()


def fusion_emitters(on: bool) -> dict[str, str | bool]:
    """Which of its two ways of making CPU code XLA takes for a program: options for `jax.jit`.

    Without its fusion emitters it compiles in half to two thirds of the time, to code as fast or,
    for events on real ground, slower by a seventh. Programs whose digits are promised not to depend
    on the process always say which.
    """
    return {_EMITTERS: on} if _KNOWN and jax.default_backend() == "cpu" else {}


_EMITTERS = "xla_cpu_use_fusion_emitters"

_KNOWN = jax.__version_info__[:2] in ((0, 9), (0, 10))
"""Whether this XLA has been seen to know the flag: others may end the process over it."""


def _cache_folder() -> Path:
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", Path.home() / "AppData" / "Local"))
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
