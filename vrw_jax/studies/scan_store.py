"""Storage of a scan's results: in memory, or in a Zarr store that survives a killed process.

A store is a Zarr group with one array per variable, divided into the scan's chunks, so that
`xarray.open_zarr` reads it. The store is built in a temporary folder, which is then renamed. The
data of a chunk are written before its mark. Every file is written under a temporary name and
renamed. Whenever the process dies, a chunk is therefore either marked and complete, or it is
computed again.

The mark of a chunk is a digest of the scan's settings, of the chunk's index and of the files that
contain its variables. A mark states that the chunk is written, and reveals a damaged, truncated,
deleted or moved file. All marks are in one Zarr group. The attributes of this group list the scan's
variables, so that variables of other origin are ignored. The attributes also contain a copy of the
store's attributes.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import math
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from vrw_jax.base.checks import check_bool, check_path
from vrw_jax.base.results import xarray as xr
from vrw_jax.studies.measure_catalog import ValuesByVariable, canonicalize_variable_name
from vrw_jax.studies.scan_design import (
    MANIFEST_ATTRIBUTE,
    REQUESTED_MEASURES_ATTRIBUTE,
    JsonObject,
    read_scan_manifest,
)
from vrw_jax.studies.scan_planning import PROVENANCE_ATTRIBUTE, ResultLayout

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


def add_attribute_seal(chunk_mark_attributes: JsonObject) -> JsonObject:
    """Return the attributes of the Zarr group of marks, with their digest added under
    `ATTRIBUTE_SEAL_KEY`.
    """
    unsealed = {k: x for k, x in chunk_mark_attributes.items() if k != ATTRIBUTE_SEAL_KEY}
    seal = compute_hex_digest(json.dumps(unsealed, sort_keys=True).encode())
    return unsealed | {ATTRIBUTE_SEAL_KEY: seal}


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
        metadata = json.loads(metadata_path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return metadata if isinstance(metadata, dict) else {}


def _select_dictionary(metadata: JsonObject, key: str) -> JsonObject:
    """Return an entry of metadata, or an empty dictionary if it is damaged or missing."""
    entry = metadata.get(key)
    return entry if isinstance(entry, dict) else {}


class StoredMetadata:
    """Metadata of a store. Each array's metadata has two copies: a separate file, and a part of one
    file for all arrays.
    """

    def __init__(self, store_path: Path) -> None:
        self._store_path = store_path
        self.root_metadata = self._read_array_metadata("")
        consolidated = _select_dictionary(self.root_metadata, "consolidated_metadata")
        self.consolidated_metadata = _select_dictionary(consolidated, "metadata")
        """Metadata of all arrays and groups by name, from the one file for all arrays."""
        group = _select_dictionary(self.consolidated_metadata, CHECKSUM_GROUP_NAME)
        copies = [
            _select_dictionary(metadata, "attributes")
            for metadata in (group, self._read_array_metadata(CHECKSUM_GROUP_NAME))
        ]
        usable = [copy for copy in copies if isinstance(copy.get(SCAN_VARIABLES_KEY), list)]
        intact = (copy for copy in usable if copy == add_attribute_seal(copy))
        self.mark_attributes: JsonObject = next(intact, (*usable, {})[0])
        """Attributes of the Zarr group of marks, from the intact copy; empty if both copies are
        lost.
        """
        self._root_attributes = _select_dictionary(self.root_metadata, "attributes")
        sealed_attributes = self.mark_attributes.get(STORE_ATTRIBUTES_KEY, {})
        self.store_attributes: JsonObject = self._root_attributes | sealed_attributes
        """Attributes of the store, completed from the copy in the Zarr group of marks."""
        self._do_mark_attributes_differ = (
            bool(self.consolidated_metadata and usable) and copies[0] != copies[1]
        )

    @property
    def coordinate_digests(self) -> dict[str, str]:
        """Return the digests of the coordinates by their names."""
        return _select_dictionary(self.mark_attributes, COORDINATE_DIGESTS_KEY)

    @property
    def scan_variable_names(self) -> list[str]:
        """Return the names of the arrays that the scan wrote, without coordinates, sorted."""
        return sorted(self.mark_attributes.get(SCAN_VARIABLES_KEY, ()))

    def find_damaged_metadata(self) -> list[str]:
        """Return the names of the arrays whose two copies of the metadata differ.

        The list contains "attributes" if the two copies of the store's attributes differ.
        """
        names = *self.coordinate_digests, *self.scan_variable_names, CHECKSUM_ARRAY_NAME
        damaged = [
            name
            for name in (names if self.consolidated_metadata else ())
            if self._read_array_metadata(name) != self.consolidated_metadata.get(name)
        ]
        if self._do_mark_attributes_differ:
            damaged.append(CHECKSUM_GROUP_NAME)
        sealed_attributes = self.mark_attributes.get(STORE_ATTRIBUTES_KEY, {}).items()
        if any(self._root_attributes.get(name, x) != x for name, x in sealed_attributes):
            damaged.append("attributes")
        return damaged

    def restore_from_intact_store(self, intact_metadata: StoredMetadata) -> None:
        """Write the two copies of all metadata anew, from the metadata of an intact new store for
        the same scan.
        """
        intact = intact_metadata.consolidated_metadata
        restored = intact | {
            CHECKSUM_GROUP_NAME: intact[CHECKSUM_GROUP_NAME] | {"attributes": self.mark_attributes}
        }
        # The first operand sets the order, in which arrays that the scan did not write come last.
        # The last operand sets the metadata.
        consolidated = _consolidate_metadata(restored | self.consolidated_metadata | restored)
        root = intact_metadata.root_metadata | {"attributes": self.store_attributes} | consolidated
        for name, metadata in (restored | {"": root}).items():
            path = self._store_path / name / METADATA_FILE_NAME
            if read_metadata_file(path) != metadata:
                path.parent.mkdir(parents=True, exist_ok=True)
                temporary_path = path.with_name(f"{METADATA_FILE_NAME}.partial")
                temporary_path.write_text(json.dumps(metadata, indent=2), encoding="utf-8")
                temporary_path.replace(path)

    def _read_array_metadata(self, array_name: str) -> JsonObject:
        return read_metadata_file(self._store_path / array_name / METADATA_FILE_NAME)


def _consolidate_metadata(metadata: JsonObject) -> JsonObject:
    """Return the entry of the root's metadata that contains the metadata of all arrays."""
    entry = {"kind": "inline", "must_understand": False, "metadata": metadata}
    return {"consolidated_metadata": entry}


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


if TYPE_CHECKING:
    import zarr


class MemoryResultStore:
    """Storage of a scan's results in memory, with the methods of `ZarrResultStore`."""

    store_location, damage_description = "memory", ""

    def __init__(self, result_layout: ResultLayout, store_attributes: JsonObject) -> None:
        self._result_layout = result_layout
        self._is_chunk_done = np.zeros(result_layout.n_chunks, bool)
        try:
            variables = {k: x.copy(deep=True) for k, x in result_layout.empty_variables.items()}
        except MemoryError as memory_error:
            n_samples = math.prod(result_layout.sample_shape)
            raise ValueError(
                f"the result of {n_samples:,} samples takes "
                f"{n_samples * result_layout.bytes_per_sample / 1e9:,.0f} GB, more than this "
                "memory holds: give a store, whose chunks go to the disk."
            ) from memory_error
        self._dataset = xr.Dataset(
            variables, dict(result_layout.result_coordinates), store_attributes
        )

    def find_missing_chunks(self) -> list[int]:
        return np.flatnonzero(~self._is_chunk_done).tolist()

    def write_chunk(self, chunk_index: int, chunk_results: ValuesByVariable) -> None:
        chunk_slices = self._result_layout.compute_chunk_region(chunk_index)
        for variable_name, variable_array in self._dataset.data_vars.items():
            variable_array.values[chunk_slices] = chunk_results[str(variable_name)]
        self._is_chunk_done[chunk_index] = True

    def open_for_writing(self) -> contextlib.AbstractContextManager[None]:
        return contextlib.nullcontext()

    def load_dataset(self) -> xr.Dataset:
        return _arrange_requested_variables(self._dataset)


class ZarrResultStore:
    """Storage of a scan's results in a folder, as a Zarr store, with a mark for each chunk.

    The mark of a chunk is a digest of its files, so that it reveals files that have changed since.

    - `layout`: layout of the result, which is needed to write; None to read only;
    - `verifies_files`: whether damaged chunks are searched for when the store is opened.
    """

    def __init__(self, path: Path, layout: ResultLayout | None, verifies_files: bool) -> None:
        self._path, self._layout, self._verifies_files = path, layout, verifies_files
        self.store_location = str(path)
        self._open_arrays()
        damages = []
        if chunks := self.damaged_chunks:
            numbers = ", ".join([*map(str, chunks[:10]), *["..."] * (len(chunks) > 10)])
            plural = "s" * (len(chunks) > 1)
            damages.append(f"{len(chunks)} damaged chunk{plural} (number {numbers})")
        for kind, names in (
            ("coordinates", self._damaged_coordinates),
            ("metadata", self.damaged_metadata),
        ):
            damages += [f"damaged {kind} ({', '.join(names)})"] if names else []
        self.damage_description = f"{path} has {' and '.join(damages)}" if damages else ""

    def _open_arrays(self) -> None:
        """Open the arrays and find damage. Arrays with damaged metadata are not opened."""
        metadata = StoredMetadata(self._path)
        self.damaged_metadata = metadata.find_damaged_metadata() if self._verifies_files else []
        self.damaged_chunks: list[int] = []
        self._damaged_coordinates: list[str] = []
        self.group: zarr.Group | None = None
        try:
            group = _open_zarr_group(self._path, "r+" if self._layout else "r", metadata)
            self._marks = _select_zarr_array(group, CHECKSUM_ARRAY_NAME)
            names = metadata.scan_variable_names
            self._arrays = {name: _select_zarr_array(group, name) for name in names}
            self._n_chunks_per_axis = self._arrays["outcome"].cdata_shape
            settings = read_scan_manifest(metadata.store_attributes)
        except ZARR_METADATA_ERRORS:
            if not self.damaged_metadata:
                raise
            return  # The metadata are written again before anything else is.
        self._settings_digest = compute_hex_digest(json.dumps(settings, sort_keys=True).encode())
        self.group = group
        if self._verifies_files:
            # The marks are read once, before any file, because a running scan marks a chunk only
            # after it has written the chunk's files.
            marks = self._read_marks()
            self.damaged_chunks = [
                i
                for i in np.flatnonzero(marks.any(1)).tolist()
                if not np.array_equal(self._compute_mark(i), marks[i])
            ]
            self._damaged_coordinates = [
                name
                for name, digest in metadata.coordinate_digests.items()
                if not _has_digest(group, name, digest)
            ]

    def _read_marks(self) -> np.ndarray:
        """Return the marks of all chunks, shape (chunks, bytes of a mark), 0 without a mark.

        The bytes of a mark that cannot be read are set to 255, so that its chunk counts as damaged.
        """
        try:
            return np.asarray(self._marks[:]).reshape(self._marks.shape[0], -1)
        except ZARR_READ_ERRORS:
            marks = np.full(self._marks.shape, 255, self._marks.dtype)
        for i in range(len(marks)):
            with contextlib.suppress(*ZARR_READ_ERRORS):
                marks[i] = self._marks[i]
        return marks

    def _compute_mark(self, chunk_index: int) -> np.ndarray:
        """Return the digest of a chunk's files as an array of bytes, shape (bytes of a mark,)."""
        digest = hashlib.blake2b(digest_size=DIGEST_SIZE_BYTES)
        digest.update(f"{self._settings_digest} {chunk_index} ".encode())
        indices: Any = np.unravel_index(chunk_index, self._n_chunks_per_axis)
        for name, array in self._arrays.items():
            key = array.metadata.encode_chunk_key((*indices, *(0,) * (array.ndim - len(indices))))
            try:
                content = (self._path / name / key).read_bytes()
            except OSError:
                content = b"none"  # Zarr writes no file if all values of a chunk are missing.
            digest.update(f"{name} {len(content)} ".encode() + content)
        return np.frombuffer(digest.digest(), np.uint8)

    def find_missing_chunks(self) -> list[int]:
        """Return the indices of the chunks whose results are missing, in ascending order."""
        if self.group is None:
            assert self._layout is not None
            return list(range(self._layout.n_chunks))
        is_written = np.asarray(self._read_marks().any(1))
        is_written[np.asarray(self.damaged_chunks, int)] = False
        return np.flatnonzero(~is_written).tolist()

    def write_chunk(self, chunk_index: int, chunk_results: ValuesByVariable) -> None:
        """Write the results of a chunk and mark the chunk as written."""
        assert self._layout is not None
        region = self._layout.compute_chunk_region(chunk_index)
        for name in self._layout.empty_variables:
            self._arrays[name][region] = chunk_results[name]
        self._marks[chunk_index] = self._compute_mark(chunk_index)
        self.damaged_chunks = [i for i in self.damaged_chunks if i != chunk_index]

    def load_dataset(self) -> xr.Dataset:
        """Return the labeled dataset of all results."""
        return open_scan(self._path, verify=False)

    @contextlib.contextmanager
    def open_for_writing(self) -> Iterator[None]:
        """Return the context in which chunks are written.

        It removes unfinished files and locks the store against other writers.
        """
        layout = self._layout
        assert layout is not None
        with lock_store(self._path):
            for unfinished_path in self._path.rglob("*.partial"):
                unfinished_path.unlink(missing_ok=True)
            if self.damaged_metadata:
                metadata = StoredMetadata(self._path)
                with _build_temporary_store(
                    self._path, layout, metadata.store_attributes
                ) as temporary_path:
                    metadata.restore_from_intact_store(StoredMetadata(temporary_path))
                self._open_arrays()
            assert self.group is not None
            for name in self._damaged_coordinates:
                values = layout.result_coordinates[name].values
                _select_zarr_array(self.group, name)[:] = values
            self._damaged_coordinates = []
            yield


ResultStore = MemoryResultStore | ZarrResultStore


def _has_digest(group: zarr.Group, name: str, digest: str) -> bool:
    try:
        return digest_coordinate_values(np.asarray(_select_zarr_array(group, name)[:])) == digest
    except (KeyError, *ZARR_READ_ERRORS):
        return False


def _select_zarr_array(zarr_group: zarr.Group, array_name: str) -> zarr.Array:
    """Return an array of a Zarr group. Raise an error if the name belongs to a group."""
    import zarr  # This import is slow.

    zarr_array = zarr_group[array_name]
    assert isinstance(zarr_array, zarr.Array)
    return zarr_array


def open_scan(path: str | Path, *, verify: bool = True) -> xr.Dataset:
    """Return the labeled result of a scan, finished or not. Arrays are read when they are used.

    In an unfinished scan, a sample without results has the outcome -1, and its measures are NaN. A
    store with damaged files causes a ValueError. `verify=False` skips the search for damage.

    Args:
        path: local folder of the store; no URL.
        verify: whether the files of each chunk are compared with the digest in the chunk's mark.

    Returns:
        The dataset that `scan` returns.

    Raises:
        TypeError: if `path` is not a path.
        ValueError: if `path` is a URL, if it contains no store of a scan, or if files are damaged.

    Examples:
        >>> design = vrw.grid(damping=[150.0, 300.0])
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = f"{folder}/scan.zarr"
        ...     gaits = vrw.scan(design, ["speed"], store=path).load()
        ...     xr.testing.assert_identical(vrw.open_scan(path).speed.load(), gaits.speed)
    """
    path = check_path("path", path, "give the folder that a scan wrote")
    verify = check_bool("verify", verify)
    stored_metadata, reason = _read_scan_metadata(path), None
    try:
        store = ZarrResultStore(path, None, verify)
        if store.group is None:
            reason = ", ".join(store.damaged_metadata)
        elif not store.damage_description:
            dataset = xr.open_zarr(
                path,
                consolidated=store.group.metadata.consolidated_metadata is not None,
                chunks=None,
                mask_and_scale=False,
                decode_times=False,
            )
    except ZARR_METADATA_ERRORS as error:
        reason = " ".join(str(error).split()).rstrip(".")
    if reason is not None:
        raise ValueError(
            f"{path} can't be opened ({reason}): run the scan again, which mends the "
            "arrays that it wrote, and delete others without dimension names."
        )
    if store.damage_description:
        raise ValueError(
            f"{store.damage_description}: run the scan again, which computes these anew, or read "
            "the rest with open_scan(path, verify=False)."
        )
    attributes = {k: x for k, x in stored_metadata.store_attributes.items() if k != "coordinates"}
    return _arrange_requested_variables(dataset.assign_attrs(attributes))


ZARR_METADATA_ERRORS = (
    ArithmeticError, AssertionError, AttributeError, LookupError, OSError, RuntimeError, TypeError,
    ValueError,
)  # fmt: skip
"""Exceptions that zarr, its codecs and xarray raise for metadata that they cannot interpret."""


def _open_zarr_group(
    store_path: Path, access_mode: Literal["r", "r+"], stored_metadata: StoredMetadata
) -> zarr.Group:
    """Return the Zarr group of a store with all its arrays.

    If the common copy of the metadata cannot be read, the files of the arrays are read instead.
    """

    import zarr  # This import is slow.

    names = *stored_metadata.coordinate_digests, *stored_metadata.scan_variable_names

    def open_with_all_arrays(use_consolidated: bool | None) -> zarr.Group:
        zarr_group = zarr.open_group(
            store_path, mode=access_mode, zarr_format=3, use_consolidated=use_consolidated
        )
        for name in names:
            _select_zarr_array(zarr_group, name)
        return zarr_group

    try:
        return open_with_all_arrays(None)
    except ZARR_METADATA_ERRORS:
        return open_with_all_arrays(False)


def _arrange_requested_variables(stored_dataset: xr.Dataset) -> xr.Dataset:
    """Return the dataset with the requested variables first, in the requested order and with the
    requested names.

    A file name cannot be "d speed / d damping", so the array of such a variable has another name in
    a store.
    """
    text = stored_dataset.attrs.get(REQUESTED_MEASURES_ATTRIBUTE)
    manifest = {} if text else read_scan_manifest(stored_dataset.attrs)
    requested = str(text).split(", ") if text else manifest.get("measures", [])
    names: dict[str, str] = {}
    for measure in requested:
        names.setdefault(canonicalize_variable_name(measure), measure)
    new_names = {
        name: names.get(name, name)
        for name in (*names, *map(str, stored_dataset.data_vars))
        if name in stored_dataset
    }
    return stored_dataset[list(new_names)].rename(new_names)


def _read_scan_metadata(store_path: Path) -> StoredMetadata:
    """Return the metadata of a store. Raise a ValueError if the folder contains no scan."""
    stored_metadata = StoredMetadata(store_path)
    root = stored_metadata.root_metadata
    if root.get("node_type") != "group" or root.get("zarr_format") != 3:
        raise ValueError(
            f"{store_path} is no scan's store: give the folder that `vrw scan` wrote, or a new "
            "place."
        )
    if MANIFEST_ATTRIBUTE not in stored_metadata.store_attributes:
        raise ValueError(
            f"{store_path} is a Zarr store, but not a scan's: give the folder that `vrw scan` "
            "wrote."
        )
    if not stored_metadata.mark_attributes:
        raise ValueError(
            f"{store_path} has no list of its variables, because its metadata are lost or an "
            "earlier version wrote it: run the scan into a new folder."
        )
    return stored_metadata


def read_stored_manifest(store_path: Path) -> dict | None:
    """Return settings and provenance of the store at `store_path`, or None if it does not exist."""
    if not store_path.exists() or (store_path.is_dir() and not any(store_path.iterdir())):
        return None
    store_attributes = _read_scan_metadata(store_path).store_attributes
    try:
        attributes = MANIFEST_ATTRIBUTE, PROVENANCE_ATTRIBUTE
        return {name: read_scan_manifest(store_attributes, name) for name in attributes}
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"{store_path} has damaged attributes ({error}): give another place for this scan."
        ) from error


def create_empty_store(
    store_path: Path, result_layout: ResultLayout, store_attributes: JsonObject
) -> None:
    """Create an empty store at `store_path` atomically.

    If another process creates a store there first, that store is not changed.
    """
    try:
        store_path.parent.mkdir(parents=True, exist_ok=True)
        with _build_temporary_store(store_path, result_layout, store_attributes) as temporary_path:
            temporary_path.rename(store_path)
    except OSError as creation_error:
        if read_stored_manifest(store_path) is None:
            reason = creation_error.strerror or "no folder can be made there"
            message = f"no store can be made at {store_path} ({reason}): give a place of your own."
            if creation_error.errno in (errno.ENOSPC, errno.EDQUOT):
                raise OSError(creation_error.errno, message) from creation_error
            raise ValueError(message) from creation_error


@contextlib.contextmanager
def _build_temporary_store(
    store_path: Path, result_layout: ResultLayout, store_attributes: JsonObject
) -> Iterator[Path]:
    """Yield the path of an empty store beside `store_path`, and remove what is left of it
    afterwards.
    """
    temporary_path = store_path.parent / f".{store_path.name}.{os.urandom(8).hex()}"
    try:
        temporary_path.mkdir()
        _create_zarr_arrays(temporary_path, result_layout, store_attributes)
        yield temporary_path
    finally:
        shutil.rmtree(temporary_path, ignore_errors=True)


def _create_zarr_arrays(
    store_path: Path, result_layout: ResultLayout, store_attributes: JsonObject
) -> None:
    import zarr  # This import is slow.
    from zarr.codecs import Crc32cCodec, ZstdCodec

    # xarray reads from this attribute which arrays are coordinates, and removes it on opening.
    result_coordinates = result_layout.result_coordinates
    group_attributes = {**store_attributes, "coordinates": " ".join(result_coordinates)}
    zarr_group = zarr.create_group(store_path, zarr_format=3, attributes=group_attributes)
    array_compressors = [ZstdCodec(level=3), Crc32cCodec()]  # The checksum reveals damage.
    for coordinate_name, coordinate in result_coordinates.items():
        zarr_group.create_array(
            coordinate_name,
            data=coordinate.values,
            chunks=coordinate.shape,
            dimension_names=map(str, coordinate.dims),
            compressors=array_compressors,
            attributes=coordinate.attrs,
        )
    chunk_shape = result_layout.chunk_shape
    for variable_name, empty_variable in result_layout.empty_variables.items():
        zarr_group.create_array(
            variable_name,
            shape=empty_variable.shape,
            chunks=(*chunk_shape, *empty_variable.shape[len(chunk_shape) :]),
            dtype=empty_variable.dtype,
            fill_value=empty_variable.values.flat[0],
            dimension_names=map(str, empty_variable.dims),
            compressors=array_compressors,
            attributes=empty_variable.attrs,
        )
    digests = {name: digest_coordinate_values(x.values) for name, x in result_coordinates.items()}
    mark_attributes = {
        SCAN_VARIABLES_KEY: list(result_layout.empty_variables),
        COORDINATE_DIGESTS_KEY: digests,
        STORE_ATTRIBUTES_KEY: group_attributes,
    }
    mark_attributes = add_attribute_seal(mark_attributes)
    zarr_group.create_group(CHECKSUM_GROUP_NAME, attributes=mark_attributes).create_array(
        "digest",
        shape=(result_layout.n_chunks, DIGEST_SIZE_BYTES),
        chunks=(1, DIGEST_SIZE_BYTES),
        dtype="u1",
        fill_value=0,
    )
    # All metadata are written into one file in this order, because zarr's function sorts them and
    # warns.
    variables = result_layout.empty_variables
    read = lambda name: json.loads((store_path / name / METADATA_FILE_NAME).read_text())
    names = *result_coordinates, *variables, CHECKSUM_GROUP_NAME, CHECKSUM_ARRAY_NAME
    root_metadata = read("") | _consolidate_metadata({name: read(name) for name in names})
    (store_path / METADATA_FILE_NAME).write_text(json.dumps(root_metadata, indent=2))
