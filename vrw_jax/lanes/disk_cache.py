"""Records of traces and machine code on disk, next to JAX's compiled code.

A record is one file, which begins with a digest of its name and its content. The name identifies
everything on which the content depends. The content is executed. Therefore records are read only
from a folder that no other user can write to, unless the user has declared the folder trusted.
"""

import functools
import hashlib
import importlib.metadata
import os
import re
import stat
import sys
import tempfile
import warnings
from pathlib import Path
from typing import Any

import jax

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
