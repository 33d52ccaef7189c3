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

from vrw_jax.scans.design import digest_columns
from vrw_jax.wheel import Outcome

ZarrGroup = Any
"""A Zarr group; only the module `store` imports zarr."""

MANIFEST_ATTRIBUTE = "scan"
"""Name of the attribute that holds the settings of a scan."""
LEGACY_MARKS_NAME = "chunk_done"
"""Name of the array of marks in a store of version 0.1."""
CHECKSUM_GROUP_NAME, CHECKSUM_ARRAY_NAME = "bookkeeping", "bookkeeping/digest"
"""Names of the group of marks, which is hidden from users of the store, and of its array."""
DIGEST_SIZE_BYTES = 16
"""Size of a digest in bytes."""


def read_manifest(attrs: Any) -> dict[str, Any]:
    """Return the settings that a store or a labelled result was made with."""
    manifest = attrs.get(MANIFEST_ATTRIBUTE, {})
    return json.loads(manifest) if isinstance(manifest, str) else dict(manifest)


class ChunkChecksums:
    """Checksums of the chunks of a store, and their comparison with its files."""

    def __init__(self, path: Path, group: ZarrGroup) -> None:
        self._path, self._group = path, group
        self._is_legacy = LEGACY_MARKS_NAME in group
        self._marks = group[LEGACY_MARKS_NAME if self._is_legacy else CHECKSUM_ARRAY_NAME]
        coordinates = str(group.attrs.get("coordinates", "")).split()
        arrays = {
            name: array
            for name, array in group.arrays()
            if name not in (*coordinates, LEGACY_MARKS_NAME)
        }
        self._arrays = {name: arrays[name] for name in sorted(arrays)}
        shape, chunk = arrays["outcome"].shape, arrays["outcome"].chunks
        self._counts = tuple(-(-n // c) for n, c in zip(shape, chunk, strict=True))

    def is_chunk_marked(self) -> np.ndarray:
        """Return whether each chunk is marked, shape (chunks,)."""
        return _are_marks_set(np.asarray(self._marks[:]))

    def mark_chunk(self, index: int) -> None:
        """Mark a chunk as written, with the digest of its files."""
        self._marks[index : index + 1] = (
            1 if self._is_legacy else self._compute_chunk_digest(index)[None]
        )

    def find_damaged_chunks(self) -> list[int]:
        """Return the chunks that are marked but whose files differ from what was written.

        The marks are read once, before any file, because a running scan marks a chunk after it has
        written the files.
        """
        marks = np.asarray(self._marks[:])
        is_intact = (
            self._is_readable
            if self._is_legacy
            else lambda i: bool((self._compute_chunk_digest(i) == marks[i]).all())
        )
        return [int(i) for i in np.flatnonzero(_are_marks_set(marks)) if not is_intact(int(i))]

    def find_damaged_coordinates(self) -> list[str]:
        """Return the swept parameters if their values differ from those of the samples."""
        design = read_manifest(self._group.attrs).get("design", {})
        if "digest" not in design:
            return []
        try:
            values = {n: np.asarray(self._group[n][:]) for n in design["swept"]}
            is_intact = digest_columns(design["kind"], values) == design["digest"]
        except (KeyError, *READ_ERRORS):
            is_intact = False
        return [] if is_intact else list(design["swept"])

    def _chunk_indices(self, index: int) -> tuple[int, ...]:
        """Return the indices of a chunk along the axes of the samples."""
        return tuple(int(i) for i in np.unravel_index(index, self._counts))

    def _chunk_file(self, name: str, index: int) -> Path:
        """Return the path of the file that holds one variable of a chunk."""
        array, chunk_indices = self._arrays[name], self._chunk_indices(index)
        key = array.metadata.encode_chunk_key(
            (*chunk_indices, *(0,) * (array.ndim - len(chunk_indices)))
        )
        return self._path / name / key

    def _compute_chunk_digest(self, index: int) -> np.ndarray:
        """Return the digest of the files of a chunk, as bytes."""
        digest = hashlib.blake2b(digest_size=DIGEST_SIZE_BYTES)
        for name in self._arrays:
            try:
                data = self._chunk_file(name, index).read_bytes()
            except OSError:
                data = b"none"  # zarr writes no file if all values of a chunk are missing
            digest.update(f"{name} {len(data)} ".encode() + data)
        return np.frombuffer(digest.digest(), np.uint8)

    def _is_readable(self, index: int) -> bool:
        """Return whether every variable of a chunk can be read and holds numbers for each gait."""
        chunk_indices = self._chunk_indices(index)
        try:
            variables = {name: array.blocks[chunk_indices] for name, array in self._arrays.items()}
        except READ_ERRORS:
            return False
        outcome = np.asarray(variables.pop("outcome"))
        has_gait = outcome == Outcome.STEPPED
        is_file_absent = [not self._chunk_file(name, index).exists() for name in variables]
        is_lost = [
            is_absent and not _holds_numbers(x[has_gait])
            for is_absent, x in zip(is_file_absent, variables.values(), strict=True)
        ]
        return bool(np.all(outcome >= 0)) and not any(is_lost)


def _are_marks_set(marks: np.ndarray) -> np.ndarray:
    """Return whether the mark of each chunk is set, shape (chunks,)."""
    return np.any(marks.reshape(len(marks), -1) != 0, axis=1)


def _holds_numbers(values: np.ndarray) -> bool:
    """Return whether some value of a gait is a number; true if there is no gait."""
    return not values.size or not bool(np.all(np.isnan(values) | (values == -1)))


READ_ERRORS = (OSError, ValueError, RuntimeError)
"""Exceptions that zarr and its codecs raise for a file that they cannot decode."""


def describe_damage(location: object, chunks: list[int], coordinates: list[str]) -> str:
    """Return a description of the damage, or an empty string if there is none."""
    parts = []
    if chunks:
        chunks_text = ", ".join(map(str, chunks[:10])) + (", ..." if len(chunks) > 10 else "")
        parts.append(f"{len(chunks)} damaged chunk{'s' * (len(chunks) > 1)} (number {chunks_text})")
    if coordinates:
        parts.append(f"damaged coordinates ({', '.join(coordinates)})")
    return f"{location} has {' and '.join(parts)}" if parts else ""


@contextlib.contextmanager
def store_lock(path: Path) -> Iterator[None]:
    """Hold the lock of a store; raise if another scan holds it."""
    try:
        import fcntl
        import os
    except ImportError:  # not on Windows
        yield
        return
    descriptor = os.open(path, os.O_RDONLY)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise ValueError(
                f"another scan is at work on {path}: wait until it has ended, then run the same "
                "again, or give another place."
            ) from error
        except OSError:
            pass  # a file system without locks
        yield
    finally:
        os.close(descriptor)
