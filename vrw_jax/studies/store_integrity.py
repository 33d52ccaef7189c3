"""Integrity of a store: a checksum of each chunk's files, and a lock against a second writer.

The mark of a chunk is a digest of the scan's settings, of the chunk's index and of the files that
contain its variables. A mark states that the chunk is written, and reveals a damaged, truncated,
deleted or moved file. All marks are in one Zarr group. The attributes of this group list the scan's
variables, so that variables of other origin are ignored. The attributes also contain a copy of the
store's attributes.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

JsonObject = dict[str, Any]
"""Object of JSON: settings, attributes or metadata by name."""

MANIFEST_ATTRIBUTE = "scan"
"""Name of the attribute of a store that contains the settings of the scan."""

CHECKSUM_GROUP_NAME = "bookkeeping"
"""Name of the Zarr group that contains the marks of chunks. Users of the store do not see it."""

CHECKSUM_ARRAY_NAME = "bookkeeping/digest"
"""Name of the Zarr array that contains the marks of chunks."""

DIGEST_SIZE_BYTES = 16
"""Size of a digest, bytes, chosen because the marks in existing stores have this size."""

SCAN_VARIABLES_KEY = "variables"
"""Key of the scan's variable names, in the attributes of the Zarr group of marks."""

STORE_ATTRIBUTES_KEY = "attributes"
"""Key of the copy of the store's attributes, in the attributes of the Zarr group of marks."""

COORDINATE_DIGESTS_KEY = "coordinates"
"""Key of the digests of the coordinates, in the attributes of the Zarr group of marks."""

ATTRIBUTE_SEAL_KEY = "seal"
"""Key of the digest of all other attributes, in the attributes of the Zarr group of marks."""

METADATA_FILE_NAME = "zarr.json"
"""Name of the file that contains the metadata of a Zarr array or group."""


def read_scan_manifest(
    store_attributes: Any, attribute_name: str = MANIFEST_ATTRIBUTE
) -> JsonObject:
    """Return the settings of the scan from the attributes of a store or a labeled result.

    - `attribute_name`: attribute that contains the table; by default that of the settings.
    """
    stored_table = store_attributes.get(attribute_name, {})
    return dict(json.loads(stored_table) if isinstance(stored_table, str) else stored_table)


def add_attribute_seal(chunk_mark_attributes: JsonObject) -> JsonObject:
    """Return the attributes of the Zarr group of marks, with their digest added under
    `ATTRIBUTE_SEAL_KEY`.
    """
    unsealed_attributes = {
        attribute_key: attribute_value
        for attribute_key, attribute_value in chunk_mark_attributes.items()
        if attribute_key != ATTRIBUTE_SEAL_KEY
    }
    return unsealed_attributes | {
        ATTRIBUTE_SEAL_KEY: compute_hex_digest(
            json.dumps(unsealed_attributes, sort_keys=True).encode()
        )
    }


def compute_store_digest(store_path: Path) -> str:
    """Return a digest of the marks of all chunks of a store in hexadecimal digits.

    It changes with every setting and every result of the scan.
    """
    mark_paths = sorted(filter(Path.is_file, (store_path / CHECKSUM_ARRAY_NAME).rglob("*")))
    return compute_hex_digest(b"".join(map(Path.read_bytes, mark_paths)))


def digest_coordinate_values(coordinate_values: np.ndarray) -> str:
    """Return the digest of a coordinate's type, shape and values, in hexadecimal digits."""
    return compute_hex_digest(
        f"{coordinate_values.dtype.str} {coordinate_values.shape} ".encode()
        + coordinate_values.tobytes()
    )


def read_metadata_file(metadata_path: Path) -> JsonObject:
    """Return the content of a metadata file, or an empty dictionary if the file cannot be read."""
    try:
        return _ensure_dictionary(json.loads(metadata_path.read_text(encoding="utf-8")))
    except (OSError, ValueError, RecursionError):
        return {}


def _ensure_dictionary(metadata: Any) -> JsonObject:
    """Return `metadata`, or an empty dictionary if damaged metadata are no dictionary."""
    return metadata if isinstance(metadata, dict) else {}


class StoredMetadata:
    """Metadata of a store. Each array's metadata has two copies: a separate file, and a part of one
    file for all arrays.
    """

    def __init__(self, store_path: Path) -> None:
        self._store_path = store_path
        self.root_metadata = self._read_array_metadata("")
        consolidated_metadata_entry = _ensure_dictionary(
            self.root_metadata.get("consolidated_metadata")
        )
        self.consolidated_metadata = _ensure_dictionary(consolidated_metadata_entry.get("metadata"))
        """Metadata of all arrays and groups by name, from the one file for all arrays."""
        attribute_copies = [
            _ensure_dictionary(_ensure_dictionary(group_metadata).get("attributes"))
            for group_metadata in (
                self.consolidated_metadata.get(CHECKSUM_GROUP_NAME),
                self._read_array_metadata(CHECKSUM_GROUP_NAME),
            )
        ]
        usable_attribute_copies = [
            attribute_copy
            for attribute_copy in attribute_copies
            if isinstance(attribute_copy.get(SCAN_VARIABLES_KEY), list)
        ]
        intact_attribute_copies = (
            attribute_copy
            for attribute_copy in usable_attribute_copies
            if attribute_copy == add_attribute_seal(attribute_copy)
        )
        self.mark_attributes: JsonObject = next(
            intact_attribute_copies, (*usable_attribute_copies, {})[0]
        )
        """Attributes of the Zarr group of marks, from the intact copy; empty if both copies are
        lost.
        """
        self._root_attributes = _ensure_dictionary(self.root_metadata.get("attributes"))
        self.store_attributes: JsonObject = self._root_attributes | self.mark_attributes.get(
            STORE_ATTRIBUTES_KEY, {}
        )
        """Attributes of the store, completed from the copy in the Zarr group of marks."""
        self._do_mark_attributes_differ = (
            bool(self.consolidated_metadata and usable_attribute_copies)
            and attribute_copies[0] != attribute_copies[1]
        )

    @property
    def coordinate_digests(self) -> dict[str, str]:
        """Return the digests of the coordinates by their names."""
        return _ensure_dictionary(self.mark_attributes.get(COORDINATE_DIGESTS_KEY))

    @property
    def scan_variable_names(self) -> list[str]:
        """Return the names of the arrays that the scan wrote, without coordinates, sorted."""
        return sorted(self.mark_attributes.get(SCAN_VARIABLES_KEY, ()))

    def find_damaged_metadata(self) -> list[str]:
        """Return the names of the arrays whose two copies of the metadata differ.

        The list contains "attributes" if the two copies of the store's attributes differ.
        """
        checked_array_names = (
            *self.coordinate_digests,
            *self.scan_variable_names,
            CHECKSUM_ARRAY_NAME,
        )
        damaged_array_names = [
            array_name
            for array_name in (checked_array_names if self.consolidated_metadata else ())
            if self._read_array_metadata(array_name) != self.consolidated_metadata.get(array_name)
        ]
        if self._do_mark_attributes_differ:
            damaged_array_names.append(CHECKSUM_GROUP_NAME)
        sealed_attributes = self.mark_attributes.get(STORE_ATTRIBUTES_KEY, {})
        if any(
            self._root_attributes.get(attribute_key, attribute_value) != attribute_value
            for attribute_key, attribute_value in sealed_attributes.items()
        ):
            damaged_array_names.append("attributes")
        return damaged_array_names

    def restore_from_intact_store(self, intact_metadata: StoredMetadata) -> None:
        """Write the two copies of all metadata anew, from the metadata of an intact new store for
        the same scan.
        """
        restored_metadata = intact_metadata.consolidated_metadata | {
            CHECKSUM_GROUP_NAME: intact_metadata.consolidated_metadata[CHECKSUM_GROUP_NAME]
            | {"attributes": self.mark_attributes}
        }
        restored_root_metadata = intact_metadata.root_metadata | {
            "attributes": self.store_attributes,
            "consolidated_metadata": {
                "kind": "inline",
                "must_understand": False,
                # The first operand sets the order, in which arrays that the scan did not write come
                # last. The last operand sets the metadata.
                "metadata": restored_metadata | self.consolidated_metadata | restored_metadata,
            },
        }
        for array_name, array_metadata in [
            *restored_metadata.items(),
            ("", restored_root_metadata),
        ]:
            metadata_path = self._store_path / array_name / METADATA_FILE_NAME
            if read_metadata_file(metadata_path) != array_metadata:
                metadata_path.parent.mkdir(parents=True, exist_ok=True)
                temporary_path = metadata_path.with_name(f"{METADATA_FILE_NAME}.partial")
                temporary_path.write_text(json.dumps(array_metadata, indent=2), encoding="utf-8")
                temporary_path.replace(metadata_path)

    def _read_array_metadata(self, array_name: str) -> JsonObject:
        return read_metadata_file(self._store_path / array_name / METADATA_FILE_NAME)


def compute_hex_digest(digested_bytes: bytes) -> str:
    """Return the digest of `digested_bytes` in hexadecimal digits."""
    return hashlib.blake2b(digested_bytes, digest_size=DIGEST_SIZE_BYTES).hexdigest()


ZARR_READ_ERRORS = (OSError, ValueError, RuntimeError)
"""Exceptions that zarr and its codecs raise for a file that they cannot decode."""


@contextlib.contextmanager
def lock_store(store_path: Path) -> Iterator[None]:
    """Return a context that locks a store against other writers.

    Raise a ValueError if another scan has locked the store.
    """
    try:
        import fcntl
        import os
    except ImportError:  # Windows has no such locks.
        yield
        return
    file_descriptor = os.open(store_path, os.O_RDONLY)
    try:
        try:
            fcntl.flock(file_descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as lock_error:
            raise ValueError(
                f"another scan is at work on {store_path}: wait until it has ended, then run the "
                "same again, or give another place."
            ) from lock_error
        except OSError:
            pass  # The file system has no locks.
        yield
    finally:
        os.close(file_descriptor)
