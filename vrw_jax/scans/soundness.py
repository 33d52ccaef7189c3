"""Integrity of a store: a checksum of each chunk's files, and a lock against a second writer.

The mark of a chunk is the digest of the files that hold its variables. It records that the chunk is
done, and it reveals a damaged, truncated or deleted file without decoding any file. Stores of
version 0.1 mark a chunk with a 1; there the chunk is read to find out whether it is readable.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from vrw_jax.scans.design import digest_of
from vrw_jax.wheel import Outcome

Group = Any
"""A Zarr group; only the module `store` imports zarr."""

MANIFEST = "scan"
"""Name of the attribute that holds the settings of a scan."""
DONE = "chunk_done"
"""Name of the array of marks in a store of version 0.1."""
BOOKS, DIGEST = "bookkeeping", "bookkeeping/digest"
"""Names of the group of marks, which is hidden from users of the store, and of its array."""
SIZE = 16
"""Size of a digest in bytes."""


def manifest_of(attrs: Any) -> dict[str, Any]:
    """Return the settings that a store or a labelled result was made with."""
    told = attrs.get(MANIFEST, {})
    return json.loads(told) if isinstance(told, str) else dict(told)


class Books:
    """Checksums of the chunks of a store, and their comparison with its files."""

    def __init__(self, path: Path, group: Group) -> None:
        self._path, self._group = path, group
        self._old = DONE in group
        self._marks = group[DONE if self._old else DIGEST]
        coordinates = str(group.attrs.get("coordinates", "")).split()
        arrays = {name: array for name, array in group.arrays() if name not in (*coordinates, DONE)}
        self._arrays = {name: arrays[name] for name in sorted(arrays)}
        shape, chunk = arrays["outcome"].shape, arrays["outcome"].chunks
        self._counts = tuple(-(-n // c) for n, c in zip(shape, chunk, strict=True))

    def done(self) -> np.ndarray:
        """Return whether each chunk is marked, shape (chunks,)."""
        return _marked(np.asarray(self._marks[:]))

    def mark(self, index: int) -> None:
        """Mark a chunk as written, with the digest of its files."""
        self._marks[index : index + 1] = 1 if self._old else self._digest(index)[None]

    def damaged(self) -> list[int]:
        """Return the chunks that are marked but whose files differ from what was written.

        The marks are read once, before any file, because a running scan marks a chunk after it has
        written the files.
        """
        marks = np.asarray(self._marks[:])
        sound = self._readable if self._old else lambda i: bool((self._digest(i) == marks[i]).all())
        return [int(i) for i in np.flatnonzero(_marked(marks)) if not sound(int(i))]

    def damaged_coordinates(self) -> list[str]:
        """Return the swept parameters if their values differ from those of the samples."""
        told = manifest_of(self._group.attrs).get("design", {})
        if "digest" not in told:
            return []
        try:
            values = {n: np.asarray(self._group[n][:]) for n in told["swept"]}
            kept = digest_of(told["kind"], values) == told["digest"]
        except (KeyError, *UNREADABLE):
            kept = False
        return [] if kept else list(told["swept"])

    def _places(self, index: int) -> tuple[int, ...]:
        """Return the indices of a chunk along the axes of the samples."""
        return tuple(int(i) for i in np.unravel_index(index, self._counts))

    def _file(self, name: str, index: int) -> Path:
        """Return the path of the file that holds one variable of a chunk."""
        array, places = self._arrays[name], self._places(index)
        key = array.metadata.encode_chunk_key((*places, *(0,) * (array.ndim - len(places))))
        return self._path / name / key

    def _digest(self, index: int) -> np.ndarray:
        """Return the digest of the files of a chunk, as bytes."""
        digest = hashlib.blake2b(digest_size=SIZE)
        for name in self._arrays:
            try:
                data = self._file(name, index).read_bytes()
            except OSError:
                data = b"none"  # zarr writes no file if all values of a chunk are missing
            digest.update(f"{name} {len(data)} ".encode() + data)
        return np.frombuffer(digest.digest(), np.uint8)

    def _readable(self, index: int) -> bool:
        """Return whether every variable of a chunk can be read and holds numbers for each gait."""
        places = self._places(index)
        try:
            told = {name: array.blocks[places] for name, array in self._arrays.items()}
        except UNREADABLE:
            return False
        outcome = np.asarray(told.pop("outcome"))
        gaits = outcome == Outcome.STEPPED
        absent = [not self._file(name, index).exists() for name in told]
        lost = [
            gone and not _meant(x[gaits]) for gone, x in zip(absent, told.values(), strict=True)
        ]
        return bool(np.all(outcome >= 0)) and not any(lost)


def _marked(marks: np.ndarray) -> np.ndarray:
    """Return whether the mark of each chunk is set, shape (chunks,)."""
    return np.any(marks.reshape(len(marks), -1) != 0, axis=1)


def _meant(values: np.ndarray) -> bool:
    """Return whether some value of a gait is a number; true if there is no gait."""
    return not values.size or not bool(np.all(np.isnan(values) | (values == -1)))


UNREADABLE = (OSError, ValueError, RuntimeError)
"""Exceptions that zarr and its codecs raise for a file that they cannot decode."""


def told_damage(place: object, chunks: list[int], coordinates: list[str]) -> str:
    """Return a description of the damage, or an empty string if there is none."""
    parts = []
    if chunks:
        shown = ", ".join(map(str, chunks[:10])) + (", ..." if len(chunks) > 10 else "")
        parts.append(f"{len(chunks)} damaged chunk{'s' * (len(chunks) > 1)} (number {shown})")
    if coordinates:
        parts.append(f"damaged coordinates ({', '.join(coordinates)})")
    return f"{place} has {' and '.join(parts)}" if parts else ""


@contextlib.contextmanager
def alone(path: Path) -> Iterator[None]:
    """Hold the lock of a store; raise if another scan holds it."""
    try:
        import fcntl
        import os
    except ImportError:  # not on Windows
        yield
        return
    place = os.open(path, os.O_RDONLY)
    try:
        try:
            fcntl.flock(place, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise ValueError(
                f"another scan is at work on {path}: wait until it has ended, then run the same "
                "again, or give another place."
            ) from error
        except OSError:
            pass  # a file system without locks
        yield
    finally:
        os.close(place)
