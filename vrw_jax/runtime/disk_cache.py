"""Files computed from code alone, saved beside JAX's compiled code."""

import functools
import hashlib
import os
import tempfile
from pathlib import Path
from typing import Any

import jax


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


def cache_folder() -> Any:
    """Return the folder of JAX's compilation cache; None if there is none."""
    return jax.config.jax_compilation_cache_dir  # type: ignore[attr-defined]


def load_bytes(name: str) -> bytes | None:
    """Return the content saved under that name beside JAX's compiled code; None if absent or
    damaged.
    """
    path = cache_folder() and Path(cache_folder()) / name
    if not path or not path.exists():
        return None
    file_content = path.read_bytes()
    digest, content = file_content[:32], file_content[32:]
    return content if hashlib.sha256(content).digest() == digest else None


def save_bytes(name: str, content: bytes) -> None:
    """Save `content` under that name, in a temporary file that is renamed; failures are ignored."""
    if not cache_folder():
        return
    path = Path(cache_folder()) / name
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, temporary_path = tempfile.mkstemp(dir=path.parent)
        with os.fdopen(handle, "wb") as file:
            file.write(hashlib.sha256(content).digest() + content)
        os.replace(temporary_path, path)
    except OSError:
        return
