"""Environment of all programs of a process: settings of JAX, cores, versions, and records on disk.

Records contain traces and machine code, next to JAX's compiled code. A record is one file, which
begins with a digest of its name and its content. The name identifies everything on which the
content depends. The content is executed. Therefore records are read only from a folder that no
other user can write to, unless the user has declared the folder trusted.

Python functions that JAX programs call need one of XLA's threads.
"""

import functools
import hashlib
import importlib.metadata
import os
import re
import stat
import sys
import tempfile
import threading
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import jax
from jax._src import xla_bridge

FunctionType = TypeVar("FunctionType", bound=Callable[..., Any])

FUSION_EMITTERS_FLAG = "xla_cpu_use_fusion_emitters"
"""Flag of XLA that switches its fusion emitters for CPUs."""


def with_default_jax_settings(function: FunctionType) -> FunctionType:
    """Return a function that runs `function` with JAX's default settings.

    `jax_disable_jit` and strict promotion of ranks and dtypes help to find faults in the caller's
    code. But only compiled programs can call this library's machine code, and its formulas accept
    numbers, batches and derivatives of any rank. The caller's settings are restored when `function`
    returns.
    """

    @functools.wraps(function)
    def call_with_default_settings(*args: Any, **keywords: Any) -> Any:
        jax_config: Any = jax.config
        has_default_jax_settings = (
            not jax_config.jax_disable_jit
            and jax_config.jax_numpy_rank_promotion == "allow"
            and jax_config.jax_numpy_dtype_promotion == "standard"
        )
        try:
            if has_default_jax_settings:
                return function(*args, **keywords)
            with (
                jax.disable_jit(False),
                jax.numpy_rank_promotion("allow"),
                jax.numpy_dtype_promotion("standard"),
            ):
                return function(*args, **keywords)
        except KeyboardInterrupt as interruption:
            if not interruption.args:
                raise
            # The frames of the library would hide a message that states what is kept.
            raise interruption.with_traceback(None) from None

    return call_with_default_settings  # type: ignore[return-value]


def make_fusion_emitter_options(are_fusion_emitters_enabled: bool) -> dict[str, str | bool]:
    """Return options for `jax.jit` that switch XLA's fusion emitters on or off on a CPU.

    Without fusion emitters, XLA compiles in half to two thirds of the time. The compiled code is as
    fast, except for events with unilateral contact, where it is slower by a seventh. Programs whose
    digits must not depend on the process always set this option.
    """
    can_set_emitters_flag = accepts_fusion_emitters_flag() and jax.default_backend() == "cpu"
    return {FUSION_EMITTERS_FLAG: are_fusion_emitters_enabled} if can_set_emitters_flag else {}


def accepts_fusion_emitters_flag() -> bool:
    """Return whether this version of XLA accepts the flag for fusion emitters.

    A version that does not accept the flag may abort the process on receiving it.
    """
    return jax.__version_info__[:2] in ((0, 9), (0, 10))


_spare_threads: list[threading.Semaphore] = []
"""Counter of XLA's threads that Python functions may hold, if JAX dispatches synchronously."""


def dispatch_cpu_programs_synchronously() -> None:
    """Let JAX run programs for CPUs in the threads that call them, unless an array exists already.

    With asynchronous dispatch, programs that wait for Python functions can take all threads that
    these functions need.
    """
    # XLA has one thread for each core, or as many as this variable states.
    n_threads = int(os.environ.get("NPROC") or count_available_cores())
    if n_threads > 1 and not xla_bridge.backends_are_initialized() and not _spare_threads:
        jax.config.update("jax_cpu_enable_async_dispatch", False)
        _spare_threads.append(threading.Semaphore(n_threads - 1))


def can_programs_call_jax() -> bool:
    """Return whether a Python function that a JAX program calls may run JAX programs itself.

    Each such call holds one of XLA's threads, and several devices would call at the same time.
    """
    is_one_cpu = jax.default_backend() == "cpu" and jax.local_device_count() == 1
    return bool(_spare_threads) and is_one_cpu


def call_python(
    function: Callable, result_types: Any, *arguments: Any, vmap_method: str | None = None
) -> Any:
    """Return the results of a Python function that may run JAX programs, as `jax.pure_callback`.

    Use it only where `can_programs_call_jax` allows it.
    """

    def call_unless_threads_are_missing(*arrays: Any) -> Any:
        if not _spare_threads[0].acquire(blocking=False):
            raise RuntimeError(
                "as many searches inside jax.jit walk at the same time as there are cores, and "
                "would wait for each other: run these programs one after another."
            )
        try:
            return function(*arrays)
        finally:
            _spare_threads[0].release()

    return jax.pure_callback(
        call_unless_threads_are_missing, result_types, *arguments, vmap_method=vmap_method
    )


def count_available_cores() -> int:
    """Return the number of processor cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


TRUST_SHARED_CACHE_VARIABLE = "VRW_TRUST_SHARED_CACHE"
"""Environment variable that allows a cache folder to which other users can write, also in child
processes.
"""

TRACE_LIBRARY_NAMES = ("jax", "jaxlib", "numpy", "equinox", "diffrax", "optax", "llvmlite")
"""Libraries whose versions affect a trace."""

CACHE_RECORD_SUFFIX = ".record"
"""Suffix of a record's file name."""

_issued_warning_kinds: set[str] = set()
"""Kinds of warnings that this process has already issued."""


@functools.cache
def compute_source_digest() -> str:
    """Return a digest of the library's source code and Butcher tableaus.

    A change in either may change digits of results.
    """
    source_hasher = hashlib.sha256()
    package_folder = Path(__file__).parents[1]
    for source_path in sorted((*package_folder.rglob("*.py"), *package_folder.rglob("*.json"))):
        source_hasher.update(source_path.relative_to(package_folder).as_posix().encode())
        source_hasher.update(source_path.read_bytes())
    return source_hasher.hexdigest()


@functools.cache  # Reading the metadata takes longer than the steps of a walk.
def find_library_version(library_name: str) -> str:
    """Return the version of an installed library, or "not installed"."""
    try:
        return importlib.metadata.version(library_name)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"


def describe_trace_environment() -> tuple[object, ...]:
    """Return the settings on which every trace depends: source code, versions and number
    formats.
    """
    jax_config: Any = jax.config
    return (
        compute_source_digest(),
        sys.version_info[:2],
        *map(find_library_version, TRACE_LIBRARY_NAMES),
        jax.dtypes.canonicalize_dtype(float).name,
        jax_config.jax_default_matmul_precision,
        jax_config.jax_numpy_dtype_promotion,
    )


def find_user_cache_folder() -> Path:
    """Return the folder in which this operating system stores the user's caches."""
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", Path.home() / "AppData" / "Local"))
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")


def find_cache_folder() -> Any:
    """Return the folder of JAX's compilation cache, or None if no trusted folder is set."""
    jax_cache_folder = jax.config.jax_compilation_cache_dir  # type: ignore[attr-defined]
    # Only JAX can read a storage bucket.
    if not jax_cache_folder or "://" in str(jax_cache_folder):
        return None
    distrust_reason = explain_cache_folder_distrust(Path(jax_cache_folder))
    if distrust_reason:
        _warn_once(
            "folder", f"{distrust_reason}; until then no machine code or trace is kept or used."
        )
        return None
    return jax_cache_folder


def explain_cache_folder_distrust(cache_folder: Path) -> str:
    """Return the reason why code in a folder must not be executed, with a remedy.

    The text is empty if the code may be executed.
    """
    try:
        distrust_reason = _explain_file_distrust(cache_folder.stat())
    except OSError:
        return ""  # The folder does not exist or cannot be read, so nothing in it is executed.
    if not distrust_reason:
        return ""
    return (
        f"the cache {cache_folder} {distrust_reason}, but its files are executed: run `chmod 700` "
        "on a folder "
        "of your own, give another one, or, if you trust all who can write there, say so by "
        f"start_jax(..., trust_shared=True) or {TRUST_SHARED_CACHE_VARIABLE}=1"
    )


def is_shared_cache_trusted() -> bool:
    """Return whether the user trusts everyone who can write to the cache folder."""
    return os.environ.get(TRUST_SHARED_CACHE_VARIABLE, "") not in ("", "0")


def create_cache_folder(cache_folder: Path) -> None:
    """Create a folder for code, and its parents.

    Only the user can access the folders that are created here, unless the user trusts a shared
    cache.
    """
    for missing_folder in reversed([cache_folder, *cache_folder.parents]):
        if not missing_folder.exists():
            missing_folder.mkdir(mode=0o777 if is_shared_cache_trusted() else 0o700, exist_ok=True)


def load_cache_record(cache_record_name: str) -> bytes | None:
    """Return the content of the record `cache_record_name`, or None if no usable record exists."""
    # Some names are read from a record.
    if not (cache_folder := find_cache_folder()) or not re.fullmatch(r"\w+", cache_record_name):
        return None
    cache_record_path = Path(cache_folder) / f"{cache_record_name}{CACHE_RECORD_SUFFIX}"
    # Without this flag the call would block if the file were a pipe.
    open_nonblocking = lambda cache_record_path, open_flags: os.open(
        cache_record_path, open_flags | getattr(os, "O_NONBLOCK", 0)
    )
    try:
        with open(cache_record_path, "rb", opener=open_nonblocking) as cache_record_file:
            file_stat_result = os.fstat(cache_record_file.fileno())
            distrust_reason = "is no file"
            if stat.S_ISREG(file_stat_result.st_mode):
                distrust_reason = _explain_file_distrust(file_stat_result)
            cache_record_bytes = b"" if distrust_reason else cache_record_file.read()
    except FileNotFoundError:
        return None
    except OSError as read_error:
        distrust_reason, cache_record_bytes = f"can't be read ({read_error.strerror})", b""
    cache_record_content = cache_record_bytes[hashlib.sha256().digest_size :]
    if not distrust_reason and cache_record_bytes != _prepend_digest(
        cache_record_name, cache_record_content
    ):
        distrust_reason = "is damaged"
    if distrust_reason:
        warn_of_unusable_cache_record(f"{cache_record_path} {distrust_reason}")
        return None
    return cache_record_content


def warn_of_unusable_cache_record(unusable_record_text: str) -> None:
    """Issue a warning, once per process, that a cache record is unusable."""
    _warn_once(
        "record",
        f"the cached code {unusable_record_text}: it is compiled again, as is any other such file.",
    )


def save_cache_record(cache_record_name: str, cache_record_content: bytes) -> None:
    """Write a record atomically: write a temporary file, synchronize it to disk, and rename it.

    If the cache folder is not writable, no error is raised.
    """
    if not (cache_folder := find_cache_folder()):
        return
    cache_record_path = Path(cache_folder) / f"{cache_record_name}{CACHE_RECORD_SUFFIX}"
    temporary_path = None
    try:
        create_cache_folder(cache_record_path.parent)
        file_descriptor, temporary_path = tempfile.mkstemp(
            dir=cache_record_path.parent, prefix="unfinished_"
        )
        with os.fdopen(file_descriptor, "wb") as cache_record_file:
            cache_record_file.write(_prepend_digest(cache_record_name, cache_record_content))
            cache_record_file.flush()
            os.fsync(cache_record_file.fileno())
        if is_shared_cache_trusted():  # Otherwise only the user can read it.
            os.chmod(temporary_path, 0o644)
        os.replace(temporary_path, cache_record_path)
    except OSError:
        if temporary_path is not None:
            Path(temporary_path).unlink(missing_ok=True)


def _prepend_digest(cache_record_name: str, cache_record_content: bytes) -> bytes:
    """Return the content of a record after the digest of its name and content."""
    digested_bytes = cache_record_name.encode() + b"\n" + cache_record_content
    return hashlib.sha256(digested_bytes).digest() + cache_record_content


def _explain_file_distrust(file_stat_result: os.stat_result) -> str:
    """Return the reason why another user may have written a file.

    The text is empty if no other user can have written the file, or if the user trusts a shared
    cache.
    """
    if os.name != "posix" or is_shared_cache_trusted():
        return ""
    if file_stat_result.st_uid != os.geteuid():
        return "belongs to another user"
    if file_stat_result.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        file_mode = stat.S_IMODE(file_stat_result.st_mode)
        return f"can be written by other users (its mode is {file_mode:04o})"
    return ""


def _warn_once(warning_kind: str, warning_sentence: str) -> None:
    """Issue a warning, unless this process has already issued a warning of the same kind."""
    if warning_kind not in _issued_warning_kinds:
        _issued_warning_kinds.add(warning_kind)
        warnings.warn(warning_sentence, stacklevel=3)
