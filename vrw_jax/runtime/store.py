"""Files computed from code alone, saved beside JAX's compiled code."""

import functools
import hashlib
import os
import tempfile
from pathlib import Path
from typing import Any

import jax


@functools.cache
def code_digest() -> str:
    """Return a digest of the library's source and tableaus: a change of either may
    change digits.
    """
    digest = hashlib.sha256()
    folder = Path(__file__).parents[1]
    for path in sorted((*folder.rglob("*.py"), *folder.rglob("*.json"))):
        digest.update(path.relative_to(folder).as_posix().encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()


def folder() -> Any:
    """Return the folder of JAX's compilation cache; None if there is none."""
    return jax.config.jax_compilation_cache_dir  # type: ignore[attr-defined]


def kept(name: str) -> bytes | None:
    """Return the content saved under that name beside JAX's compiled code; None if absent or
    damaged.
    """
    place = folder() and Path(folder()) / name
    if not place or not place.exists():
        return None
    stored = place.read_bytes()
    digest, content = stored[:32], stored[32:]
    return content if hashlib.sha256(content).digest() == digest else None


def keep(name: str, content: bytes) -> None:
    """Save `content` under that name, in a temporary file that is renamed; failures are ignored."""
    if not folder():
        return
    place = Path(folder()) / name
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
        handle, unfinished = tempfile.mkstemp(dir=place.parent)
        with os.fdopen(handle, "wb") as file:
            file.write(hashlib.sha256(content).digest() + content)
        os.replace(unfinished, place)
    except OSError:
        return
