"""Integrity of a store: a checksum of each chunk's files, and a lock against a second writer.

The mark of a chunk is the digest of the scan's settings, the chunk's number and the files of its
variables. A mark states that the chunk is written, and it reveals a damaged, truncated, deleted or
moved file. The attributes of the group of marks list the scan's variables, so that others are
ignored, and repeat the store's attributes. In stores without that list a mark is the digest of the
files alone.
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

ZarrGroup = Any
"""A Zarr group; only the module `store` imports zarr."""

MANIFEST_ATTRIBUTE = "scan"
"""Name of the attribute that contains the settings of a scan."""

CHECKSUM_GROUP_NAME = "bookkeeping"
"""Name of the group of marks, which is hidden from users of the store."""

CHECKSUM_ARRAY_NAME = "bookkeeping/digest"
"""Name of the array of marks."""

DIGEST_SIZE_BYTES = 16
"""Size of a digest, that of existing stores."""

VARIABLES_KEY = "variables"
"""Key of the names of the scan's variables, in the attributes of the group of marks."""

ATTRIBUTES_KEY = "attributes"
"""Key of the copy of the store's attributes, in the attributes of the group of marks."""

COORDINATES_KEY = "coordinates"
"""Key of the digests of the coordinates, in the attributes of the group of marks."""

SEAL_KEY = "seal"
"""Key of the digest of all other attributes of the group of marks."""

METADATA_FILE_NAME = "zarr.json"
"""Name of the file that contains the metadata of an array or a group."""


def read_manifest(attrs: Any) -> dict[str, Any]:
    """Return the settings with which a store or a labeled result was made."""
    manifest = attrs.get(MANIFEST_ATTRIBUTE, {})
    return json.loads(manifest) if isinstance(manifest, str) else dict(manifest)


def seal_attributes(attributes: dict[str, Any]) -> dict[str, Any]:
    """Return the attributes of the group of marks, together with a digest of them."""
    encoded_attributes = {key: value for key, value in attributes.items() if key != SEAL_KEY}
    return encoded_attributes | {
        SEAL_KEY: _hex_digest(json.dumps(encoded_attributes, sort_keys=True).encode())
    }


def digest_values(values: np.ndarray) -> str:
    """Return the digest of a coordinate's values."""
    return _hex_digest(f"{values.dtype.str} {values.shape} ".encode() + values.tobytes())


def read_metadata(path: Path) -> dict[str, Any]:
    """Return the content of a metadata file; an empty dictionary if it cannot be read."""
    try:
        metadata = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return metadata if isinstance(metadata, dict) else {}


class StoredMetadata:
    """Metadata of a store, which exist twice: in a file for each array, and in one file for all
    arrays.
    """

    def __init__(self, path: Path) -> None:
        self._path, self.root_metadata = path, read_metadata(path / METADATA_FILE_NAME)
        root_attrs = self.root_metadata.get("attributes")
        consolidated_entry = self.root_metadata.get("consolidated_metadata")
        consolidated_arrays = (
            consolidated_entry.get("metadata") if isinstance(consolidated_entry, dict) else None
        )
        self.consolidated_metadata: dict[str, Any] = (
            consolidated_arrays if isinstance(consolidated_arrays, dict) else {}
        )
        """Metadata of all arrays and groups by name, from the one file for all."""
        attribute_copies = [
            _get_attributes(metadata)
            for metadata in (
                self.consolidated_metadata.get(CHECKSUM_GROUP_NAME),
                self._read_file_of(CHECKSUM_GROUP_NAME),
            )
        ]
        usable_copies = [
            copy for copy in attribute_copies if isinstance(copy.get(VARIABLES_KEY), list)
        ]
        intact_copies = (copy for copy in usable_copies if copy == seal_attributes(copy))
        self.mark_attributes: dict[str, Any] = next(intact_copies, (*usable_copies, {})[0])
        """Attributes of the group of marks, from the intact copy; empty in stores without them."""
        self._root_attrs = root_attrs if isinstance(root_attrs, dict) else {}
        self.attributes: dict[str, Any] = self._root_attrs | self.mark_attributes.get(
            ATTRIBUTES_KEY, {}
        )
        """Attributes of the store."""
        self._mark_attrs_differ = (
            bool(usable_copies) and attribute_copies[0] != attribute_copies[-1]
        )

    @property
    def coordinates(self) -> list[str]:
        """Return the names of the coordinates."""
        digests = self.mark_attributes.get(COORDINATES_KEY)
        return list(digests) if digests else str(self.attributes.get("coordinates", "")).split()

    def select_variables(self, names: Iterable[str]) -> list[str]:
        """Return the arrays among `names` that the scan wrote, without coordinates."""
        if VARIABLES_KEY in self.mark_attributes:
            return sorted(self.mark_attributes[VARIABLES_KEY])
        manifest = read_manifest(self.attributes)
        measures, swept_parameters = (
            manifest.get("measures", []),
            manifest.get("design", {}).get("swept", []),
        )
        excluded_names = (*self.coordinates, *swept_parameters)
        return sorted(
            name
            for name in names
            if name not in excluded_names and (name in measures or _is_measure(name))
        )

    def find_damaged(self) -> list[str]:
        """Return the names of the arrays whose two copies of metadata differ.

        The name "attributes" is among them if the attributes of the store differ.
        """
        array_names = [
            name
            for name, metadata in self.consolidated_metadata.items()
            if name != CHECKSUM_ARRAY_NAME
            and isinstance(metadata, dict)
            and metadata.get("node_type") == "array"
        ]
        names = (
            [*self.coordinates, *self.select_variables(array_names)]
            if self.consolidated_metadata
            else []
        )
        names += [CHECKSUM_ARRAY_NAME] if self.consolidated_metadata else []
        damaged_names = []
        for name in names:
            metadata = self._read_file_of(name)
            if not metadata or metadata != self.consolidated_metadata.get(name):
                damaged_names.append(name)
        if self._mark_attrs_differ:
            damaged_names.append(CHECKSUM_GROUP_NAME)
        sealed_attrs = self.mark_attributes.get(ATTRIBUTES_KEY, {})
        if any(self._root_attrs.get(key, value) != value for key, value in sealed_attrs.items()):
            damaged_names.append("attributes")
        return damaged_names

    def restore_metadata(self, intact_metadata: StoredMetadata) -> None:
        """Write both copies of all metadata as they are in an intact new store of the same scan."""
        arrays = intact_metadata.consolidated_metadata | {
            CHECKSUM_GROUP_NAME: intact_metadata.consolidated_metadata[CHECKSUM_GROUP_NAME]
            | {"attributes": self.mark_attributes}
        }
        other_metadata = {
            name: metadata
            for name, metadata in self.consolidated_metadata.items()
            if name not in arrays
        }
        consolidated_entry = {
            "kind": "inline",
            "must_understand": False,
            "metadata": arrays | other_metadata,
        }
        new_root = intact_metadata.root_metadata | {
            "attributes": self.attributes,
            "consolidated_metadata": consolidated_entry,
        }
        for name, metadata in [*arrays.items(), ("", new_root)]:
            path = self._path / name / METADATA_FILE_NAME
            if read_metadata(path) != metadata:
                path.parent.mkdir(parents=True, exist_ok=True)
                partial_path = path.with_name(f"{METADATA_FILE_NAME}.partial")
                partial_path.write_text(json.dumps(metadata, indent=2), encoding="utf-8")
                partial_path.replace(path)

    def _read_file_of(self, name: str) -> dict[str, Any]:
        """Return the metadata in the file of one array or group."""
        return read_metadata(self._path / name / METADATA_FILE_NAME)


def _get_attributes(metadata: object) -> dict[str, Any]:
    """Return the attributes in the metadata of an array or group; empty if there are none."""
    attrs = metadata.get("attributes") if isinstance(metadata, dict) else None
    return attrs if isinstance(attrs, dict) else {}


def _is_measure(name: str) -> bool:
    """Return whether a variable of this name is a measure of a scan."""
    try:
        return parse_derivative(name) is None and bool(get_variable_attrs(name))
    except (KeyError, ValueError):
        return False


def _hex_digest(content: bytes) -> str:
    """Return the digest of some bytes as hexadecimal text."""
    return hashlib.blake2b(content, digest_size=DIGEST_SIZE_BYTES).hexdigest()


class ChunkChecksums:
    """Checksums of the chunks of a store, and their comparison with the files."""

    def __init__(self, path: Path, group: ZarrGroup, metadata: StoredMetadata) -> None:
        self._path, self._group, self._metadata = path, group, metadata
        self._marks = group[CHECKSUM_ARRAY_NAME]
        names = [name for name, _ in group.arrays()]
        self._arrays = {name: group[name] for name in metadata.select_variables(names)}
        outcome = self._arrays["outcome"]
        self._counts = tuple(
            -(-n_samples // chunk_length)
            for n_samples, chunk_length in zip(outcome.shape, outcome.chunks, strict=True)
        )
        self._settings_digest = ""  # It is empty if marks are digests of the files alone.
        if VARIABLES_KEY in metadata.mark_attributes:
            settings = json.dumps(read_manifest(metadata.attributes), sort_keys=True)
            self._settings_digest = _hex_digest(settings.encode())

    def is_chunk_marked(self) -> np.ndarray:
        """Return whether each chunk is marked, shape (chunks,)."""
        return _are_marks_set(self._read_marks())

    def _read_marks(self) -> np.ndarray:
        """Return the marks of all chunks, shape (chunks, bytes of a mark).

        A mark that cannot be read gets the value 255, so that its chunk counts as damaged.
        """
        try:
            return np.asarray(self._marks[:])
        except READ_ERRORS:
            marks = np.full(self._marks.shape, 255, self._marks.dtype)
        for chunk_index in range(len(marks)):
            with contextlib.suppress(*READ_ERRORS):
                marks[chunk_index] = self._marks[chunk_index]
        return marks

    def mark_chunk(self, chunk_index: int) -> None:
        """Mark a chunk as written, with the digest of its files."""
        self._marks[chunk_index : chunk_index + 1] = self._compute_chunk_digest(chunk_index)[None]

    def find_damaged_chunks(self) -> list[int]:
        """Return the indices of chunks that are marked but whose files differ from the written
        ones.

        The marks are read once, before any file, because a running scan marks a chunk after it has
        written the files.
        """
        marks = self._read_marks()
        is_intact = lambda chunk_index: bool(
            (self._compute_chunk_digest(chunk_index) == marks[chunk_index]).all()
        )
        return [
            int(chunk_index)
            for chunk_index in np.flatnonzero(_are_marks_set(marks))
            if not is_intact(int(chunk_index))
        ]

    def find_damaged_coordinates(self) -> list[str]:
        """Return the coordinates whose values differ from the written ones.

        In stores without a digest of each coordinate, return the swept parameters if their values
        are not those of the samples.
        """
        if COORDINATES_KEY in self._metadata.mark_attributes:
            digests = self._metadata.mark_attributes[COORDINATES_KEY].items()
            return [name for name, digest in digests if self._coordinate_digest(name) != digest]
        design_settings = read_manifest(self._metadata.attributes).get("design", {})
        if "digest" not in design_settings:
            return []
        try:
            values = {
                coordinate_name: np.asarray(self._group[coordinate_name][:])
                for coordinate_name in design_settings["swept"]
            }
            is_intact = digest_columns(design_settings["kind"], values) == design_settings["digest"]
        except (KeyError, *READ_ERRORS):
            is_intact = False
        return [] if is_intact else list(design_settings["swept"])

    def _coordinate_digest(self, name: str) -> str:
        """Return the digest of a coordinate's values, or "" if they cannot be read."""
        try:
            return digest_values(np.asarray(self._group[name][:]))
        except (KeyError, *READ_ERRORS):
            return ""

    def _chunk_indices(self, chunk_index: int) -> tuple[int, ...]:
        """Return the indices of a chunk along the axes of the samples."""
        return tuple(int(i) for i in np.unravel_index(chunk_index, self._counts))

    def _chunk_file(self, name: str, chunk_index: int) -> Path:
        """Return the path of the file that contains one variable of a chunk."""
        array, chunk_indices = self._arrays[name], self._chunk_indices(chunk_index)
        key = array.metadata.encode_chunk_key(
            (*chunk_indices, *(0,) * (array.ndim - len(chunk_indices)))
        )
        return self._path / name / key

    def _compute_chunk_digest(self, chunk_index: int) -> np.ndarray:
        """Return the digest of the files of a chunk, as an array of bytes."""
        digest = hashlib.blake2b(digest_size=DIGEST_SIZE_BYTES)
        if self._settings_digest:
            digest.update(f"{self._settings_digest} {chunk_index} ".encode())
        for name in self._arrays:
            try:
                data = self._chunk_file(name, chunk_index).read_bytes()
            except OSError:
                data = b"none"  # Zarr writes no file if all values of a chunk are missing.
            digest.update(f"{name} {len(data)} ".encode() + data)
        return np.frombuffer(digest.digest(), np.uint8)


def _are_marks_set(marks: np.ndarray) -> np.ndarray:
    """Return whether the mark of each chunk is set, shape (chunks,)."""
    return np.any(marks.reshape(len(marks), -1) != 0, axis=1)


READ_ERRORS = (OSError, ValueError, RuntimeError)
"""Exceptions that zarr and its codecs raise for a file that they cannot decode."""


def describe_damage(
    location: object, chunks: list[int], coordinates: list[str], metadata: list[str]
) -> str:
    """Return a sentence about the damage of a store, or "" if there is none."""
    damage_texts = []
    if chunks:
        chunks_text = ", ".join(map(str, chunks[:10])) + (", ..." if len(chunks) > 10 else "")
        damage_texts.append(
            f"{len(chunks)} damaged chunk{'s' * (len(chunks) > 1)} (number {chunks_text})"
        )
    if coordinates:
        damage_texts.append(f"damaged coordinates ({', '.join(coordinates)})")
    if metadata:
        damage_texts.append(f"damaged metadata ({', '.join(metadata)})")
    return f"{location} has {' and '.join(damage_texts)}" if damage_texts else ""


@contextlib.contextmanager
def store_lock(path: Path) -> Iterator[None]:
    """Return a context that holds the lock of a store; raise a ValueError if another scan holds
    it.
    """
    try:
        import fcntl
        import os
    except ImportError:  # Windows has no such locks.
        yield
        return
    file_descriptor = os.open(path, os.O_RDONLY)
    try:
        try:
            fcntl.flock(file_descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise ValueError(
                f"another scan is at work on {path}: wait until it has ended, then run the same "
                "again, or give another place."
            ) from error
        except OSError:
            pass  # The file system has no locks.
        yield
    finally:
        os.close(file_descriptor)
