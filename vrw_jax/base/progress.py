"""Start-up of a process, and notices on standard error for calls that last long.

A call prints one line, which states what it compiles and about how long that takes. In a terminal,
a second line shows the time and the progress until the call ends. Calls of a few seconds print
nothing, and no call prints anything if `PROGRESS_VARIABLE` is "0". `start_jax` makes later calls
faster.
"""

import contextlib
import functools
import os
import shutil
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import jax

from vrw_jax.base.checks import check_bool, check_path
from vrw_jax.lanes import environment as store
from vrw_jax.lanes.environment import (
    FUSION_EMITTERS_FLAG,
    accepts_fusion_emitters_flag,
    dispatch_cpu_programs_synchronously,
    with_default_jax_settings,
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


PROGRESS_VARIABLE = "VRW_PROGRESS"
"""Environment variable that switches notices off if it is "0"."""

SILENT_SECONDS = 3.0
"""Duration of a call, s, after which the notice appears. With the interval it is below 5 s."""

UPDATE_INTERVAL = 1.0
"""Interval between two updates of the notice, s."""

FunctionType = TypeVar("FunctionType", bound=Callable[..., Any])


class _PublicCall:
    """Public call that a user waits for, with the latest text about its progress."""

    def __init__(self, expectation: str) -> None:
        self.expectation, self.progress = expectation, ""
        self.start_seconds, self.has_notice = time.monotonic(), False

    def show_notice(self) -> None:
        """Print the notice once, and the progress in a terminal."""
        elapsed_seconds = time.monotonic() - self.start_seconds
        if elapsed_seconds < SILENT_SECONDS:
            return
        if not self.has_notice:
            self.has_notice = True
            print(self.expectation, file=sys.stderr, flush=True)
        if sys.stderr.isatty():
            _overwrite_terminal_line(f"{elapsed_seconds:.0f} s {self.progress}")

    def erase_progress(self) -> None:
        """Erase the progress in a terminal."""
        if self.has_notice and sys.stderr.isatty():
            _overwrite_terminal_line("")


def _overwrite_terminal_line(text: str) -> None:
    """Replace the current line of the terminal, and leave the cursor at its start."""
    n_columns = shutil.get_terminal_size().columns - 1
    print(f"\r{text[:n_columns]:{n_columns}}\r", end="", file=sys.stderr, flush=True)


_lock = threading.Lock()
_current_call: _PublicCall | None = None  # the outermost public call of the process
_watcher: threading.Thread | None = None  # thread that shows notices while a call runs


def announce_wait(
    compiled_programs: str, compile_time: str
) -> Callable[[FunctionType], FunctionType]:
    """Return a decorator for public functions that may last more than some seconds.

    The decorator computes nothing. It prints what is compiled, and sets JAX's default settings.
    Calls within another decorated call print nothing.

    - `compiled_programs`: programs that the first call of a process compiles;
    - `compile_time`: duration of that compilation without a cache, in CPU time, as text.
    """

    def decorate(function: FunctionType) -> FunctionType:
        expectation = (
            f"{function.__name__}: the first call of a process compiles {compiled_programs}, "
            f"which takes about {compile_time}; vrw.start_jax keeps the code for later ones."
        )

        @functools.wraps(function)
        def call_with_notice(*args: Any, **keywords: Any) -> Any:
            global _current_call, _watcher
            with _lock:
                if _current_call is not None or os.environ.get(PROGRESS_VARIABLE) == "0":
                    public_call = None
                else:
                    public_call = _current_call = _PublicCall(expectation)
                    # A forked process has no watcher.
                    if _watcher is None or not _watcher.is_alive():
                        _hold_lock_during_forks()
                        _watcher = threading.Thread(target=_watch_calls, daemon=True)
                        _watcher.start()
            if public_call is None:
                return function(*args, **keywords)
            try:
                return function(*args, **keywords)
            finally:
                with _lock:
                    _current_call = None
                    public_call.erase_progress()

        call_with_notice.announces_wait = True  # type: ignore[attr-defined]
        return with_default_jax_settings(call_with_notice)  # type: ignore[return-value]

    return decorate


@functools.cache
def _hold_lock_during_forks() -> None:
    """Prevent forks while the watcher holds the lock, because it prints.

    The child has no watcher, so that nothing in it would release the lock.
    """
    if hasattr(os, "register_at_fork"):
        os.register_at_fork(
            before=_lock.acquire, after_in_parent=_lock.release, after_in_child=_lock.release
        )


def report_progress(text: str) -> None:
    """Set the text about the progress of the current public call."""
    if _current_call is not None:
        _current_call.progress = text


def _watch_calls() -> None:
    """Show the notice of the current call, until no call has run for one interval."""
    global _watcher
    while True:
        time.sleep(UPDATE_INTERVAL)
        with _lock:
            if _current_call is None:
                _watcher = None
                return
            _current_call.show_notice()
