"""Is what lies in a store what was written there: a digest of each chunk's files, and none twice.

A chunk's mark is the digest of the files that hold its variables: it says that the chunk is done,
and lets a damaged, truncated or deleted file be noticed without opening any of them. Stores of
version 0.1 mark with a 1; there a chunk is read to see whether it can be.
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
"""A Zarr group: `store` knows zarr."""

MANIFEST = "scan"
DONE = "chunk_done"
"""The marks of a store of version 0.1."""
BOOKS, DIGEST = "bookkeeping", "bookkeeping/digest"
"""The group of marks, out of sight of who opens the store, and their array."""
SIZE = 16
"""Bytes of a digest."""


def manifest_of(attrs: Any) -> dict[str, Any]:
    """What a store or a labelled result says it was made with."""
    told = attrs.get(MANIFEST, {})
    return json.loads(told) if isinstance(told, str) else dict(told)


class Books:
    """The marks of a store's chunks, and whether its files still agree with them."""

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
        return _marked(np.asarray(self._marks[:]))

    def mark(self, index: int) -> None:
        """Say that a chunk's files are written."""
        self._marks[index : index + 1] = 1 if self._old else self._digest(index)[None]

    def damaged(self) -> list[int]:
        """Chunks that are marked, and whose files are not what was written.

        The marks are read once, before any file: a scan at work marks a chunk after its files.
        """
        marks = np.asarray(self._marks[:])
        sound = self._readable if self._old else lambda i: bool((self._digest(i) == marks[i]).all())
        return [int(i) for i in np.flatnonzero(_marked(marks)) if not sound(int(i))]

    def damaged_coordinates(self) -> list[str]:
        """The swept parameters, if their values are not those that the samples were taken at."""
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
        return tuple(int(i) for i in np.unravel_index(index, self._counts))

    def _file(self, name: str, index: int) -> Path:
        array, places = self._arrays[name], self._places(index)
        key = array.metadata.encode_chunk_key((*places, *(0,) * (array.ndim - len(places))))
        return self._path / name / key

    def _digest(self, index: int) -> np.ndarray:
        digest = hashlib.blake2b(digest_size=SIZE)
        for name in self._arrays:
            try:
                data = self._file(name, index).read_bytes()
            except OSError:
                data = b"none"  # as it is where all of a chunk's values are missing ones
            digest.update(f"{name} {len(data)} ".encode() + data)
        return np.frombuffer(digest.digest(), np.uint8)

    def _readable(self, index: int) -> bool:
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
    return np.any(marks.reshape(len(marks), -1) != 0, axis=1)


def _meant(values: np.ndarray) -> bool:
    """Whether the numbers of gaits may be those of a file that isn't there."""
    return not values.size or not bool(np.all(np.isnan(values) | (values == -1)))


UNREADABLE = (OSError, ValueError, RuntimeError)
"""What zarr and its codecs raise for a file that they can't make sense of."""


def told_damage(place: object, chunks: list[int], coordinates: list[str]) -> str:
    """In words what is damaged; empty where nothing is."""
    parts = []
    if chunks:
        shown = ", ".join(map(str, chunks[:10])) + (", ..." if len(chunks) > 10 else "")
        parts.append(f"{len(chunks)} damaged chunk{'s' * (len(chunks) > 1)} (number {shown})")
    if coordinates:
        parts.append(f"damaged coordinates ({', '.join(coordinates)})")
    return f"{place} has {' and '.join(parts)}" if parts else ""


@contextlib.contextmanager
def alone(path: Path) -> Iterator[None]:
    """Refuses a second scan at work on the same store, for as long as the first one lives."""
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
