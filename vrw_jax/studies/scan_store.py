"""Storage of a scan's results: in memory, or in a Zarr store that survives a killed process.

A store is a Zarr group with one array per variable, divided into the scan's chunks, so that
`xarray.open_zarr` reads it. The store is built in a temporary folder, which is then renamed. The
data of a chunk are written before its mark, which is a digest of the data (see `integrity`). Every
file is written under a temporary name and renamed. Whenever the process dies, a chunk is therefore
either marked and complete, or it is computed again.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import os
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from vrw_jax.base.checks import check_bool, check_path
from vrw_jax.base.lazy_xarray import xarray as xr
from vrw_jax.studies.measure_catalog import ValuesByVariable, canonicalize_variable_name
from vrw_jax.studies.store_integrity import (
    CHECKSUM_ARRAY_NAME,
    CHECKSUM_GROUP_NAME,
    COORDINATE_DIGESTS_KEY,
    DIGEST_SIZE_BYTES,
    MANIFEST_ATTRIBUTE,
    METADATA_FILE_NAME,
    SCAN_VARIABLES_KEY,
    STORE_ATTRIBUTES_KEY,
    ZARR_READ_ERRORS,
    JsonObject,
    StoredMetadata,
    add_attribute_seal,
    compute_hex_digest,
    digest_coordinate_values,
    lock_store,
    read_scan_manifest,
)

if TYPE_CHECKING:
    import zarr

PROVENANCE_ATTRIBUTE = "provenance"
"""Name of the attribute of a store that describes the origin of the results."""

REQUESTED_MEASURES_ATTRIBUTE = "asked"
"""Name of the attribute of a store that lists the requested measures."""

ChunkRegion = tuple[slice, ...]
"""Slices that select the samples of a chunk, one for each sample axis."""


@dataclass(frozen=True)
class ResultLayout:
    """Description of a result: its sample axes, chunks, variables and coordinates.

    The variables have the shape of the whole result and contain missing values, which occupy no
    memory.
    """

    sample_shape: tuple[int, ...]
    chunk_shape: tuple[int, ...]
    empty_variables: Mapping[str, xr.Variable]
    result_coordinates: Mapping[str, xr.Variable]

    @property
    def n_chunks(self) -> int:
        """Return the number of chunks of the result."""
        return math.prod(self._chunks_per_axis)

    @property
    def _chunks_per_axis(self) -> tuple[int, ...]:
        n_chunks_by_axis = np.ceil(np.divide(self.sample_shape, self.chunk_shape))
        return tuple(n_chunks_by_axis.astype(int).tolist())

    def compute_chunk_region(self, chunk_index: int) -> ChunkRegion:
        """Return the slices that select the samples of a chunk, one for each sample axis."""
        chunk_indices = np.unravel_index(chunk_index, self._chunks_per_axis)
        chunk_starts = np.multiply(chunk_indices, self.chunk_shape)
        chunk_ends = np.minimum(chunk_starts + self.chunk_shape, self.sample_shape)
        return tuple(map(slice, chunk_starts.tolist(), chunk_ends.tolist()))

    def compute_chunk_sample_shape(self, chunk_index: int) -> tuple[int, ...]:
        """Return the number of samples in a chunk along each sample axis.

        A chunk at the end of an axis may be smaller than others.
        """
        return tuple(
            chunk_slice.stop - chunk_slice.start
            for chunk_slice in self.compute_chunk_region(chunk_index)
        )

    @property
    def bytes_per_sample(self) -> int:
        """Return the number of bytes that the uncompressed results of one sample occupy."""
        n_bytes = sum(variable.nbytes for variable in self.empty_variables.values())
        return n_bytes // math.prod(self.sample_shape)


def choose_chunk_shape(sample_shape: tuple[int, ...], max_chunk_samples: int) -> tuple[int, ...]:
    """Return the shape of chunks that contain at most `max_chunk_samples` samples.

    A chunk spans the whole length of the last axes.
    """
    chunk_shape: list[int] = []
    for axis_length in reversed(sample_shape):
        chunk_length = min(axis_length, max_chunk_samples)
        max_chunk_samples //= chunk_length  # It stays at least 1.
        chunk_shape.insert(0, chunk_length)
    return tuple(chunk_shape)


class MemoryResultStore:
    """Storage of a scan's results in memory, with the methods of `ZarrResultStore`."""

    store_location, damage_description = "memory", ""

    def __init__(self, result_layout: ResultLayout, store_attributes: JsonObject) -> None:
        self._result_layout = result_layout
        self._is_chunk_done = np.zeros(result_layout.n_chunks, bool)
        try:
            dataset_variables = {
                variable_name: empty_variable.copy(deep=True)
                for variable_name, empty_variable in result_layout.empty_variables.items()
            }
        except MemoryError as memory_error:
            n_samples = math.prod(result_layout.sample_shape)
            raise ValueError(
                f"the result of {n_samples:,} samples takes "
                f"{n_samples * result_layout.bytes_per_sample / 1e9:,.0f} GB, more than this "
                "memory holds: give a store, whose chunks go to the disk."
            ) from memory_error
        self._dataset = xr.Dataset(
            dataset_variables, dict(result_layout.result_coordinates), store_attributes
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
    dataset = dataset.assign_attrs(
        {
            attribute_name: attribute_value
            for attribute_name, attribute_value in stored_metadata.store_attributes.items()
            if attribute_name != "coordinates"
        }
    )
    return _arrange_requested_variables(dataset)


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

    def open_with_all_arrays(uses_consolidated_metadata: bool | None) -> zarr.Group:
        zarr_group = zarr.open_group(
            store_path,
            mode=access_mode,
            zarr_format=3,
            use_consolidated=uses_consolidated_metadata,
        )
        for array_name in (
            *stored_metadata.coordinate_digests,
            *stored_metadata.scan_variable_names,
        ):
            _select_zarr_array(zarr_group, array_name)
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
    requested_measures_text = stored_dataset.attrs.get(REQUESTED_MEASURES_ATTRIBUTE)
    requested_measures = (
        str(requested_measures_text).split(", ")
        if requested_measures_text
        else read_scan_manifest(stored_dataset.attrs).get("measures", [])
    )
    requested_name_by_variable: dict[str, str] = {}
    for requested_measure in requested_measures:
        requested_name_by_variable.setdefault(
            canonicalize_variable_name(requested_measure), requested_measure
        )
    new_name_by_variable = {
        variable_name: requested_name_by_variable.get(variable_name, variable_name)
        for variable_name in (*requested_name_by_variable, *map(str, stored_dataset.data_vars))
        if variable_name in stored_dataset
    }
    return stored_dataset[list(new_name_by_variable)].rename(new_name_by_variable)


def _read_scan_metadata(store_path: Path) -> StoredMetadata:
    """Return the metadata of a store. Raise a ValueError if the folder contains no scan."""
    stored_metadata = StoredMetadata(store_path)
    if (
        stored_metadata.root_metadata.get("node_type") != "group"
        or stored_metadata.root_metadata.get("zarr_format") != 3
    ):
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
        return {
            attribute_name: read_scan_manifest(store_attributes, attribute_name)
            for attribute_name in (MANIFEST_ATTRIBUTE, PROVENANCE_ATTRIBUTE)
        }
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
            creation_failure_reason = creation_error.strerror or "no folder can be made there"
            raise OSError(
                creation_error.errno,
                f"no store can be made at {store_path} ({creation_failure_reason}): give a place "
                "of your own",
            ) from creation_error


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
    chunk_mark_attributes = add_attribute_seal(
        {
            SCAN_VARIABLES_KEY: list(result_layout.empty_variables),
            COORDINATE_DIGESTS_KEY: {
                coordinate_name: digest_coordinate_values(coordinate.values)
                for coordinate_name, coordinate in result_coordinates.items()
            },
            STORE_ATTRIBUTES_KEY: group_attributes,
        }
    )
    zarr_group.create_group(CHECKSUM_GROUP_NAME, attributes=chunk_mark_attributes).create_array(
        "digest",
        shape=(result_layout.n_chunks, DIGEST_SIZE_BYTES),
        chunks=(1, DIGEST_SIZE_BYTES),
        dtype="u1",
        fill_value=0,
    )
    # All metadata are written into one file in this order, because zarr's function sorts them and
    # warns.
    metadata_by_name = {
        array_name: json.loads((store_path / array_name / METADATA_FILE_NAME).read_text())
        for array_name in (
            *result_coordinates,
            *result_layout.empty_variables,
            CHECKSUM_GROUP_NAME,
            CHECKSUM_ARRAY_NAME,
        )
    }
    root_metadata_path = store_path / METADATA_FILE_NAME
    root_metadata = json.loads(root_metadata_path.read_text())
    root_metadata["consolidated_metadata"] = {
        "kind": "inline",
        "must_understand": False,
        "metadata": metadata_by_name,
    }
    root_metadata_path.write_text(json.dumps(root_metadata, indent=2))
