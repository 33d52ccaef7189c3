"""What is computed from code alone, kept on disk beside JAX's compiled code.

A record is one file. It begins with a digest of its name, which covers all that the content depends
on, and of the content. Its content is executed, so that records are used only from a folder that
nobody else can write, unless the user trusts those who can.
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
"""The environment variable that allows a cache which others can write, in child processes too."""
DIGEST_BYTES = 32
"""Length of the digest before a record's content: that of SHA-256."""
TRACED_WITH = ("jax", "jaxlib", "numpy", "equinox", "diffrax", "optax", "llvmlite")
"""Libraries whose version a trace depends on."""

SUFFIX = ".record"
"""End of a record's file name."""

_warned: set[str] = set()
"""Kinds of warnings that this process has given."""


@functools.cache
def source_digest() -> str:
    """Return a digest of the library's source and tableaus: a change of either may
    change digits.
    """
    digest = hashlib.sha256()
    folder = Path(__file__).parents[1]
    for path in sorted((*folder.rglob("*.py"), *folder.rglob("*.json"))):
        digest.update(path.relative_to(folder).as_posix().encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()


@functools.cache
def _versions() -> tuple[str, ...]:
    told = [f"python {sys.version_info[0]}.{sys.version_info[1]}"]
    for name in TRACED_WITH:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            told.append(f"{name} {importlib.metadata.version(name)}")
    return tuple(told)


def describe_process() -> tuple[object, ...]:
    """Return what every trace depends on: the library's source, versions, number format."""
    config: Any = jax.config
    return (
        source_digest(),
        _versions(),
        jax.dtypes.canonicalize_dtype(float).name,
        config.jax_default_matmul_precision,
        config.jax_numpy_dtype_promotion,
    )


def cache_folder() -> Any:
    """JAX's compilation cache; None where there is none, or none that can be trusted."""
    place = jax.config.jax_compilation_cache_dir  # type: ignore[attr-defined]
    if not place or "://" in str(place):  # a bucket, which JAX alone can read
        return None
    refused = refuse_folder(Path(place))
    if refused:
        _warn_once("folder", f"{refused}; until then no machine code or trace is kept or used.")
        return None
    return place


def refuse_folder(place: Path) -> str:
    """Return why code kept in that folder is not executed, and what to do; empty if it is."""
    try:
        reason = _distrust(place.stat())
    except OSError:
        return ""  # it is not there yet, or can't be read: then nothing is executed either
    if not reason:
        return ""
    return (
        f"the cache {place} {reason}, but what lies there is executed: run `chmod 700` on a folder "
        "of your own, give another one, or, if you trust all who can write there, say so by "
        f"start_jax(..., trust_shared=True) or {TRUST_SHARED_VARIABLE}=1"
    )


def trusts_shared() -> bool:
    """Return whether the user trusts all who can write the cache."""
    return os.environ.get(TRUST_SHARED_VARIABLE, "") not in ("", "0")


def make_folder(place: Path) -> None:
    """Make a folder for code, with its parents: the user's alone, unless caches are shared."""
    for missing in reversed([place, *place.parents]):
        if not missing.exists():
            missing.mkdir(mode=0o777 if trusts_shared() else 0o700, exist_ok=True)


def load_bytes(name: str) -> bytes | None:
    """Return what was kept under that name beside JAX's compiled code; None if nothing usable."""
    path = cache_folder() and Path(cache_folder()) / f"{name}{SUFFIX}"
    if not path or not re.fullmatch(r"\w+", name):  # a name comes from a record too
        return None
    try:
        with open(path, "rb", opener=_open_without_waiting) as file:
            status = os.fstat(file.fileno())
            reason = "is no file" if not stat.S_ISREG(status.st_mode) else _distrust(status)
            file_content = b"" if reason else file.read()
    except FileNotFoundError:
        return None
    except OSError as error:
        reason, file_content = f"can't be read ({error.strerror})", b""
    digest, content = file_content[:DIGEST_BYTES], file_content[DIGEST_BYTES:]
    if not reason and _digest(name, content) != digest:
        reason = "is damaged"
    if reason:
        warn_unusable(f"{path} {reason}")
        return None
    return content


def warn_unusable(what: str) -> None:
    """Warn, once in a process, that something of the cache is not used."""
    _warn_once(
        "record", f"the cached code {what}: it is compiled again, as is any other such file."
    )


def save_bytes(name: str, content: bytes) -> None:
    """Written beside its place, synced and renamed; a cache that can't be written is no error."""
    if not cache_folder():
        return
    path, temporary_path = Path(cache_folder()) / f"{name}{SUFFIX}", None
    try:
        make_folder(path.parent)
        handle, temporary_path = tempfile.mkstemp(dir=path.parent, prefix="unfinished_")
        with os.fdopen(handle, "wb") as file:
            file.write(_digest(name, content) + content)
            file.flush()
            os.fsync(file.fileno())
        if trusts_shared():  # else it stays the user's alone
            os.chmod(temporary_path, 0o644)
        os.replace(temporary_path, path)
    except OSError:
        if temporary_path is not None:
            Path(temporary_path).unlink(missing_ok=True)


def _digest(name: str, content: bytes) -> bytes:
    return hashlib.sha256(name.encode() + b"\n" + content).digest()


def _distrust(status: os.stat_result) -> str:
    """Return why somebody else may have written this; empty if nobody may or all are trusted."""
    if os.name != "posix" or trusts_shared():
        return ""
    if status.st_uid != os.geteuid():
        return "belongs to another user"
    if status.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        return f"can be written by other users (its mode is {stat.S_IMODE(status.st_mode):04o})"
    return ""


def _open_without_waiting(path: str, flags: int) -> int:
    """Open a file as `open` does; a pipe in its place doesn't block."""
    return os.open(path, flags | getattr(os, "O_NONBLOCK", 0))


def _warn_once(kind: str, sentence: str) -> None:
    if kind not in _warned:
        _warned.add(kind)
        warnings.warn(sentence, stacklevel=3)
