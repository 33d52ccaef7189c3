"""Integrity of a store: a checksum of each chunk's files, and a lock against a second writer.

A chunk's mark is the digest of the scan's settings, the chunk's number and the files that hold its
variables: it says that the chunk is done, and lets a damaged, truncated, deleted or moved file be
noticed without opening any of them. The attributes of the group of marks list the scan's own
variables, so that others are ignored, and repeat the store's attributes. Stores without that list
have marks of the files alone. Stores of version 0.1 mark with a 1; there a chunk is read to see
whether it can be.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from vrw_jax.scans.design import digest_columns
from vrw_jax.scans.measure_catalog import get_variable_attrs, parse_derivative
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
"""Bytes of a digest."""
VARIABLES, ATTRIBUTES, COORDINATES, SEAL = "variables", "attributes", "coordinates", "seal"
"""Keys of the attributes of the group of marks; the last one is a digest of the others."""
METADATA = "zarr.json"


def read_manifest(attrs: Any) -> dict[str, Any]:
    """Return the settings that a store or a labelled result was made with."""
    manifest = attrs.get(MANIFEST_ATTRIBUTE, {})
    return json.loads(manifest) if isinstance(manifest, str) else dict(manifest)


def seal(book: dict[str, Any]) -> dict[str, Any]:
    """Return the attributes of the group of marks with a digest of them."""
    rest = {key: value for key, value in book.items() if key != SEAL}
    return rest | {SEAL: _hex(json.dumps(rest, sort_keys=True).encode())}


def digest_values(values: np.ndarray) -> str:
    """Return the digest of a coordinate's values."""
    return _hex(f"{values.dtype.str} {values.shape} ".encode() + values.tobytes())


def read_metadata(place: Path) -> dict[str, Any]:
    """Return what a file of metadata holds; nothing if it can't be read."""
    try:
        told = json.loads(place.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return told if isinstance(told, dict) else {}


class StoredMetadata:
    """The metadata of a store as two copies: of each array its own, and all in one file."""

    def __init__(self, path: Path) -> None:
        self._path, self.root = path, read_metadata(path / METADATA)
        attrs, whole = self.root.get("attributes"), self.root.get("consolidated_metadata")
        whole = whole.get("metadata") if isinstance(whole, dict) else None
        self.inline: dict[str, Any] = whole if isinstance(whole, dict) else {}
        copies = [
            self._attributes(x)
            for x in (self.inline.get(CHECKSUM_GROUP_NAME), self._own(CHECKSUM_GROUP_NAME))
        ]
        listed = [x for x in copies if isinstance(x.get(VARIABLES), list)]
        self.book: dict[str, Any] = next((x for x in listed if x == seal(x)), (*listed, {})[0])
        """Attributes of the group of marks, by the sound copy; empty in stores without them."""
        told = self.book.get(ATTRIBUTES, {})
        self._root_attrs = attrs if isinstance(attrs, dict) else {}
        self.attrs: dict[str, Any] = self._root_attrs | told
        """The store's attributes."""
        self._books_differ = bool(listed) and copies[0] != copies[-1]

    @property
    def coordinates(self) -> list[str]:
        told = self.book.get(COORDINATES)
        return list(told) if told else str(self.attrs.get("coordinates", "")).split()

    def own_variables(self, names: Iterable[str]) -> list[str]:
        """Return those of these arrays that the scan wrote, but coordinates."""
        if VARIABLES in self.book:
            return sorted(self.book[VARIABLES])
        manifest = read_manifest(self.attrs)
        measures, swept = manifest.get("measures", []), manifest.get("design", {}).get("swept", [])
        out_of = (*self.coordinates, *swept, LEGACY_MARKS_NAME)
        return sorted(n for n in names if n not in out_of and (n in measures or _is_measure(n)))

    def damaged(self) -> list[str]:
        """Return the arrays whose two copies differ, and "attributes" if the store's are others."""
        known = [
            n
            for n, told in self.inline.items()
            if self._is_array(told) and n != CHECKSUM_ARRAY_NAME
        ]
        names = [*self.coordinates, *self.own_variables(known)] if self.inline else []
        names += [CHECKSUM_ARRAY_NAME] if self.inline else []
        found = [n for n in names if not self._own(n) or self._own(n) != self.inline.get(n)]
        told = self.book.get(ATTRIBUTES, {})
        differ = any(self._root_attrs.get(key, told[key]) != told[key] for key in told)
        return found + [CHECKSUM_GROUP_NAME] * self._books_differ + ["attributes"] * differ

    def mend(self, fresh: StoredMetadata) -> None:
        """Write both copies of each array again, as in a store of the same scan made afresh."""
        arrays = fresh.inline | {
            CHECKSUM_GROUP_NAME: fresh.inline[CHECKSUM_GROUP_NAME] | {"attributes": self.book}
        }
        others = {name: told for name, told in self.inline.items() if name not in arrays}
        whole = {"kind": "inline", "must_understand": False, "metadata": arrays | others}
        root = fresh.root | {"attributes": self.attrs, "consolidated_metadata": whole}
        for name, told in [*arrays.items(), ("", root)]:
            place = self._path / name / METADATA
            if read_metadata(place) != told:
                place.parent.mkdir(parents=True, exist_ok=True)
                unfinished = place.with_name(f"{METADATA}.partial")
                unfinished.write_text(json.dumps(told, indent=2), encoding="utf-8")
                unfinished.replace(place)

    def _own(self, name: str) -> dict[str, Any]:
        return read_metadata(self._path / name / METADATA)

    @staticmethod
    def _attributes(told: object) -> dict[str, Any]:
        attrs = told.get("attributes") if isinstance(told, dict) else None
        return attrs if isinstance(attrs, dict) else {}

    @staticmethod
    def _is_array(told: object) -> bool:
        return isinstance(told, dict) and told.get("node_type") == "array"


def _is_measure(name: str) -> bool:
    try:
        return parse_derivative(name) is None and bool(get_variable_attrs(name))
    except (KeyError, ValueError):
        return False


def _hex(content: bytes) -> str:
    return hashlib.blake2b(content, digest_size=DIGEST_SIZE_BYTES).hexdigest()


class ChunkChecksums:
    """Checksums of the chunks of a store, and their comparison with its files."""

    def __init__(self, path: Path, group: ZarrGroup, metadata: StoredMetadata) -> None:
        self._path, self._group, self._metadata = path, group, metadata
        self._is_legacy = LEGACY_MARKS_NAME in group
        self._marks = group[LEGACY_MARKS_NAME if self._is_legacy else CHECKSUM_ARRAY_NAME]
        names = [name for name, _ in group.arrays()]
        self._arrays = {name: group[name] for name in metadata.own_variables(names)}
        outcome = self._arrays["outcome"]
        self._counts = tuple(-(-n // c) for n, c in zip(outcome.shape, outcome.chunks, strict=True))
        settings = json.dumps(read_manifest(metadata.attrs), sort_keys=True)
        self._settings = _hex(settings.encode()) if VARIABLES in metadata.book else ""

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
        """The coordinates whose values are not those that were written; before there were digests
        of each, the swept parameters, if their values are not those of the samples."""
        if COORDINATES in self._metadata.book:
            digests = self._metadata.book[COORDINATES].items()
            return [name for name, digest in digests if self._coordinate_digest(name) != digest]
        design = read_manifest(self._metadata.attrs).get("design", {})
        if "digest" not in design:
            return []
        try:
            values = {n: np.asarray(self._group[n][:]) for n in design["swept"]}
            is_intact = digest_columns(design["kind"], values) == design["digest"]
        except (KeyError, *READ_ERRORS):
            is_intact = False
        return [] if is_intact else list(design["swept"])

    def _coordinate_digest(self, name: str) -> str:
        try:
            return digest_values(np.asarray(self._group[name][:]))
        except (KeyError, *READ_ERRORS):
            return ""

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
        if self._settings:  # else of a store whose marks cover the files alone
            digest.update(f"{self._settings} {index} ".encode())
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


def describe_damage(
    location: object, chunks: list[int], coordinates: list[str], metadata: list[str]
) -> str:
    """In words what is damaged; empty where nothing is."""
    parts = []
    if chunks:
        chunks_text = ", ".join(map(str, chunks[:10])) + (", ..." if len(chunks) > 10 else "")
        parts.append(f"{len(chunks)} damaged chunk{'s' * (len(chunks) > 1)} (number {chunks_text})")
    if coordinates:
        parts.append(f"damaged coordinates ({', '.join(coordinates)})")
    if metadata:
        parts.append(f"damaged metadata ({', '.join(metadata)})")
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
