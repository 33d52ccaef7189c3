"""Records of traces and machine code on disk, beside JAX's compiled code.

A record is one file. It begins with a digest of its name and its content. The name identifies
everything on which the content depends. The content is executed, so records are used only from a
folder that nobody else can write, unless the user trusts those who can.
"""

import contextlib
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

TRUST_SHARED_VARIABLE = "VRW_TRUST_SHARED_CACHE"
"""Environment variable that allows a cache which others can write, in child processes too."""

TRACE_LIBRARIES = ("jax", "jaxlib", "numpy", "equinox", "diffrax", "optax", "llvmlite")
"""Libraries on whose version a trace depends."""

RECORD_SUFFIX = ".record"
"""Suffix of a record's file name."""

_warned_kinds: set[str] = set()
"""Kinds of warnings that this process has issued."""


@functools.cache
def source_digest() -> str:
    """Return a digest of the library's source and tableaus.

    A change of either may change digits.
    """
    digest = hashlib.sha256()
    folder = Path(__file__).parents[1]
    for path in sorted((*folder.rglob("*.py"), *folder.rglob("*.json"))):
        digest.update(path.relative_to(folder).as_posix().encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()


@functools.cache
def _library_versions() -> tuple[str, ...]:
    """Return the versions of Python and of the installed `TRACE_LIBRARIES`."""
    versions = [f"python {sys.version_info[0]}.{sys.version_info[1]}"]
    for name in TRACE_LIBRARIES:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            versions.append(f"{name} {importlib.metadata.version(name)}")
    return tuple(versions)


def describe_process() -> tuple[object, ...]:
    """Return everything on which every trace depends: source, versions, number format."""
    config: Any = jax.config
    return (
        source_digest(),
        _library_versions(),
        jax.dtypes.canonicalize_dtype(float).name,
        config.jax_default_matmul_precision,
        config.jax_numpy_dtype_promotion,
    )


def cache_folder() -> Any:
    """Return the folder of JAX's compilation cache, or None if none is set or it is not trusted."""
    folder = jax.config.jax_compilation_cache_dir  # type: ignore[attr-defined]
    if not folder or "://" in str(folder):  # Only JAX can read a storage bucket.
        return None
    distrust_reason = describe_untrusted_folder(Path(folder))
    if distrust_reason:
        _warn_once(
            "folder", f"{distrust_reason}; until then no machine code or trace is kept or used."
        )
        return None
    return folder


def describe_untrusted_folder(folder: Path) -> str:
    """Return why code in `folder` is not executed, with a remedy, or "" if it is executed."""
    try:
        reason = _describe_distrust(folder.stat())
    except OSError:
        return ""  # The folder does not exist or cannot be read, so nothing in it is executed.
    if not reason:
        return ""
    return (
        f"the cache {folder} {reason}, but its files are executed: run `chmod 700` on a folder "
        "of your own, give another one, or, if you trust all who can write there, say so by "
        f"start_jax(..., trust_shared=True) or {TRUST_SHARED_VARIABLE}=1"
    )


def trusts_shared() -> bool:
    """Return whether the user trusts all who can write the cache."""
    return os.environ.get(TRUST_SHARED_VARIABLE, "") not in ("", "0")


def make_folder(folder: Path) -> None:
    """Create a folder for code and its parents, for the user alone unless caches are shared."""
    for missing_folder in reversed([folder, *folder.parents]):
        if not missing_folder.exists():
            missing_folder.mkdir(mode=0o777 if trusts_shared() else 0o700, exist_ok=True)


def load_bytes(name: str) -> bytes | None:
    """Return the content of the record with this name, or None if there is no usable record."""
    path = cache_folder() and Path(cache_folder()) / f"{name}{RECORD_SUFFIX}"
    if not path or not re.fullmatch(r"\w+", name):  # Some names are read from a record.
        return None
    # Without this flag the call would block if the file were a pipe.
    open_without_blocking = lambda path, flags: os.open(path, flags | getattr(os, "O_NONBLOCK", 0))
    try:
        with open(path, "rb", opener=open_without_blocking) as file:
            file_status = os.fstat(file.fileno())
            is_file = stat.S_ISREG(file_status.st_mode)
            distrust_reason = _describe_distrust(file_status) if is_file else "is no file"
            file_bytes = b"" if distrust_reason else file.read()
    except FileNotFoundError:
        return None
    except OSError as error:
        distrust_reason, file_bytes = f"can't be read ({error.strerror})", b""
    n_digest = hashlib.sha256().digest_size
    digest, content = file_bytes[:n_digest], file_bytes[n_digest:]
    if not distrust_reason and _record_digest(name, content) != digest:
        distrust_reason = "is damaged"
    if distrust_reason:
        warn_unusable(f"{path} {distrust_reason}")
        return None
    return content


def warn_unusable(description: str) -> None:
    """Issue a warning, once per process, that a record of the cache is not used."""
    _warn_once(
        "record", f"the cached code {description}: it is compiled again, as is any other such file."
    )


def save_bytes(name: str, content: bytes) -> None:
    """Write a record atomically: to a temporary file, which is synced and renamed.

    No error is raised if the cache cannot be written.
    """
    if not cache_folder():
        return
    path, temporary_path = Path(cache_folder()) / f"{name}{RECORD_SUFFIX}", None
    try:
        make_folder(path.parent)
        file_descriptor, temporary_path = tempfile.mkstemp(dir=path.parent, prefix="unfinished_")
        with os.fdopen(file_descriptor, "wb") as file:
            file.write(_record_digest(name, content) + content)
            file.flush()
            os.fsync(file.fileno())
        if trusts_shared():  # Otherwise only the user can read it.
            os.chmod(temporary_path, 0o644)
        os.replace(temporary_path, path)
    except OSError:
        if temporary_path is not None:
            Path(temporary_path).unlink(missing_ok=True)


def _record_digest(name: str, content: bytes) -> bytes:
    """Return the digest of a record's name and content."""
    return hashlib.sha256(name.encode() + b"\n" + content).digest()


def _describe_distrust(file_status: os.stat_result) -> str:
    """Return why another user may have written this file, or "" if nobody may or all are
    trusted.
    """
    if os.name != "posix" or trusts_shared():
        return ""
    if file_status.st_uid != os.geteuid():
        return "belongs to another user"
    if file_status.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        return (
            f"can be written by other users (its mode is {stat.S_IMODE(file_status.st_mode):04o})"
        )
    return ""


def _warn_once(kind: str, sentence: str) -> None:
    """Issue the warning `sentence` unless this process has issued one of this kind."""
    if kind not in _warned_kinds:
        _warned_kinds.add(kind)
        warnings.warn(sentence, stacklevel=3)
