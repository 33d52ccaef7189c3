"""Notices on standard error for calls that last long: what they do, and how far they are.

A call prints one line, which states what it compiles and about how long that takes. In a terminal,
a second line shows the time and the progress until the call ends. Calls of a few seconds print
nothing, and no call prints anything if `PROGRESS_VARIABLE` is "0".
"""

import functools
import os
import shutil
import sys
import threading
import time
from collections.abc import Callable
from typing import Any, TypeVar

from vrw_jax.lanes.settings import with_default_jax_settings

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

    They run with the default settings of JAX. Calls within another decorated call print nothing.

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
