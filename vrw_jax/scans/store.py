"""Storage of a scan's results: in memory, or in a Zarr store that survives a killed process.

A store is a Zarr group with one array per variable, divided into the scan's chunks, so that
`xarray.open_zarr` reads it. It is built in a temporary folder and then renamed. The data of a chunk
is written before its mark, which is a digest of the data (see `integrity`). Every file is written
under a temporary name and renamed. Whenever the process dies, a chunk is therefore either marked
and complete, or it is computed again.
"""

from __future__ import annotations

import abc
import contextlib
import json
import math
import os
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from vrw_jax.runtime import lazy_import
from vrw_jax.runtime import xarray as xr
from vrw_jax.scans.integrity import (
    ATTRIBUTES_KEY,
    CHECKSUM_ARRAY_NAME,
    CHECKSUM_GROUP_NAME,
    COORDINATES_KEY,
    DIGEST_SIZE_BYTES,
    MANIFEST_ATTRIBUTE,
    METADATA_FILE_NAME,
    VARIABLES_KEY,
    ChunkChecksums,
    StoredMetadata,
    describe_damage,
    digest_values,
    read_manifest,
    seal_attributes,
    store_lock,
)
from vrw_jax.scans.measure_catalog import canonicalize_name
from vrw_jax.validation import check_bool, check_path

if TYPE_CHECKING:
    import zarr
else:
    zarr = lazy_import("zarr")

PROVENANCE_ATTRIBUTE = "provenance"
"""Name of the attribute that describes the origin of the numbers."""

REQUESTED_ATTRIBUTE = "asked"
"""Name of the attribute that contains the requested measures."""

ChunkRegion = tuple[slice, ...]
"""Slices of a chunk along the axes of the samples."""
ChunkBlock = Mapping[str, np.ndarray]
"""Results of one chunk by variable; the axes of the samples come first."""


@dataclass(frozen=True)
class VariableLayout:
    """Description of one variable; `dims` and `shape` do not include the axes of the samples."""

    name: str
    dtype: str
    fill_value: float | int
    attrs: Mapping[str, Any]
    dims: tuple[str, ...] = ()
    shape: tuple[int, ...] = ()

    @property
    def bytes_per_sample(self) -> int:
        """Return the size of the value of one sample, in bytes."""
        return np.dtype(self.dtype).itemsize * math.prod(self.shape)


@dataclass(frozen=True)
class ResultLayout:
    """Description of a result: its axes, chunks, variables and coordinates."""

    dims: tuple[str, ...]
    shape: tuple[int, ...]
    chunk_shape: tuple[int, ...]
    variables: tuple[VariableLayout, ...]
    coordinates: Mapping[str, tuple[str, np.ndarray, Mapping[str, Any]]]

    @property
    def n_chunks(self) -> int:
        """Return the number of chunks."""
        return math.prod(self._chunks_per_axis)

    @property
    def _chunks_per_axis(self) -> tuple[int, ...]:
        """Return the number of chunks along each axis."""
        return tuple(
            -(-axis_length // chunk_length)
            for axis_length, chunk_length in zip(self.shape, self.chunk_shape, strict=True)
        )

    def chunk_region(self, chunk_index: int) -> ChunkRegion:
        """Return the slices of a chunk along the axes of the samples."""
        chunk_indices = np.unravel_index(chunk_index, self._chunks_per_axis)
        return tuple(
            slice(
                int(axis_index) * chunk_length,
                min((int(axis_index) + 1) * chunk_length, axis_length),
            )
            for axis_index, chunk_length, axis_length in zip(
                chunk_indices, self.chunk_shape, self.shape, strict=True
            )
        )

    def shape_of_chunk(self, chunk_index: int) -> tuple[int, ...]:
        """Return the shape of a chunk, which is smaller at the end of an axis."""
        return tuple(
            axis_slice.stop - axis_slice.start for axis_slice in self.chunk_region(chunk_index)
        )

    @property
    def bytes_per_sample(self) -> int:
        """Return the size of the results of one sample, uncompressed, in bytes."""
        return sum(variable.bytes_per_sample for variable in self.variables)


def choose_chunk_shape(shape: tuple[int, ...], max_samples: int) -> tuple[int, ...]:
    """Return the shape of a slab of at most `max_samples` samples with whole last axes."""
    chunk_shape, samples_left = [1] * len(shape), max_samples
    for axis in range(len(shape) - 1, -1, -1):
        chunk_shape[axis] = min(shape[axis], max(samples_left, 1))
        samples_left //= chunk_shape[axis]
        if chunk_shape[axis] < shape[axis]:
            break
    return tuple(chunk_shape)


class AbstractStore(abc.ABC):
    """Storage that accepts chunks, lists the missing ones and returns the labeled result."""

    location: str = "memory"
    damage_description: str = ""
    """Description of the damage of the store; an empty string if there is none."""

    @abc.abstractmethod
    def find_missing_chunks(self) -> list[int]:
        """Return the indices of the chunks that are not computed yet, in ascending order."""

    @abc.abstractmethod
    def write_chunk(self, chunk_index: int, chunk_results: ChunkBlock) -> None:
        """Write the results of a chunk and mark the chunk as written."""

    @abc.abstractmethod
    def load_dataset(self) -> xr.Dataset:
        """Return the labeled result."""

    @abc.abstractmethod
    def open_for_writing(self) -> contextlib.AbstractContextManager[None]:
        """Return the context of all writing, which removes unfinished files and holds the lock."""


class MemoryStore(AbstractStore):
    """Storage of a scan's results in memory."""

    def __init__(self, layout: ResultLayout, attrs: Mapping[str, object]) -> None:
        self._layout, self._attrs = layout, attrs
        self._is_chunk_done = np.zeros(layout.n_chunks, bool)
        try:
            self._arrays = {
                variable.name: np.full(
                    (*layout.shape, *variable.shape), variable.fill_value, variable.dtype
                )
                for variable in layout.variables
            }
        except MemoryError as error:
            n_samples = math.prod(layout.shape)
            raise ValueError(
                f"the result of {n_samples:,} samples takes "
                f"{n_samples * layout.bytes_per_sample / 1e9:,.0f} GB, more than this memory "
                "holds: give a store, whose chunks go to the disk."
            ) from error

    def find_missing_chunks(self) -> list[int]:
        return [int(chunk_index) for chunk_index in np.flatnonzero(~self._is_chunk_done)]

    def write_chunk(self, chunk_index: int, chunk_results: ChunkBlock) -> None:
        region = self._layout.chunk_region(chunk_index)
        for name, array in self._arrays.items():
            array[region] = chunk_results[name]
        self._is_chunk_done[chunk_index] = True

    def open_for_writing(self) -> contextlib.AbstractContextManager[None]:
        return contextlib.nullcontext()

    def load_dataset(self) -> xr.Dataset:
        layout = self._layout
        dataset = xr.Dataset(
            {
                variable.name: (
                    (*layout.dims, *variable.dims),
                    self._arrays[variable.name],
                    dict(variable.attrs),
                )
                for variable in layout.variables
            },
            coords={
                name: (dim, values, dict(attrs))
                for name, (dim, values, attrs) in layout.coordinates.items()
            },
            attrs=dict(self._attrs),
        )
        return _arrange_as_requested(dataset)


class ZarrStore(AbstractStore):
    """Storage of a scan's results in a folder; `verify` selects the search for damaged chunks."""

    def __init__(self, path: Path, layout: ResultLayout, verify: bool = True) -> None:
        self._path, self._layout, self.location, self._verify = path, layout, str(path), verify
        self._open()
        self.damage_description = describe_damage(
            path, self.damaged_chunks, self._damaged_coordinates, self._damaged_metadata
        )

    def _open(self) -> None:
        """Open the arrays and find damage; arrays with damaged metadata stay closed."""
        metadata, self._checksums = StoredMetadata(self._path), None
        self._damaged_metadata = metadata.find_damaged() if self._verify else []
        self.damaged_chunks: list[int] = []
        self._damaged_coordinates: list[str] = []
        try:
            self._group = _open_group(self._path, "r+", metadata)
            self._checksums = ChunkChecksums(self._path, self._group, metadata)
        except METADATA_ERRORS:
            if not self._damaged_metadata:
                raise
            return  # The metadata are written again before anything else is.
        if self._verify:
            self.damaged_chunks = self._checksums.find_damaged_chunks()
            self._damaged_coordinates = self._checksums.find_damaged_coordinates()

    def find_missing_chunks(self) -> list[int]:
        if self._checksums is None:
            return list(range(self._layout.n_chunks))
        is_done = self._checksums.is_chunk_marked()
        is_done[np.asarray(self.damaged_chunks, int)] = False
        return [int(chunk_index) for chunk_index in np.flatnonzero(~is_done)]

    def write_chunk(self, chunk_index: int, chunk_results: ChunkBlock) -> None:
        region = self._layout.chunk_region(chunk_index)
        for variable in self._layout.variables:
            _get_array(self._group, variable.name)[region] = chunk_results[variable.name]
        assert self._checksums is not None
        self._checksums.mark_chunk(chunk_index)
        self.damaged_chunks = [chunk for chunk in self.damaged_chunks if chunk != chunk_index]

    def load_dataset(self) -> xr.Dataset:
        return open_scan(self._path, verify=False)

    @contextlib.contextmanager
    def open_for_writing(self) -> Iterator[None]:
        with store_lock(self._path):
            for path in self._path.rglob("*.partial"):
                path.unlink(missing_ok=True)
            if self._damaged_metadata:
                _rewrite_metadata(self._path, self._layout)
                self._open()
            for name in self._damaged_coordinates:
                _get_array(self._group, name)[:] = self._layout.coordinates[name][1]
            self._damaged_coordinates = []
            yield


def _get_array(group: zarr.Group, name: str) -> zarr.Array:
    """Return the array `name` of a Zarr group; raise an error if it is no array."""
    array = group[name]
    assert isinstance(array, zarr.Array)
    return array


def open_scan(path: str | Path, *, verify: bool = True) -> xr.Dataset:
    """Return the labeled result of a scan, finished or not; values are read when they are used.

    In an unfinished scan, samples that are not yet computed have the outcome -1 and the measures
    NaN. A store with damaged files raises a ValueError; `verify=False` skips that check.

    Args:
        path: folder of the store.
        verify: whether the files of each chunk are compared with their digest.

    Returns:
        The dataset that `scan` returns.

    Raises:
        TypeError: if `path` is not a path.
        ValueError: if there is no store of a scan at `path`, or if its files are damaged.

    Examples:
        >>> design = vrw.grid(damping=[150.0, 300.0])
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = f"{folder}/scan.zarr"
        ...     gaits = vrw.scan(design, ["speed"], store=path).load()
        ...     xr.testing.assert_identical(vrw.open_scan(path).speed.load(), gaits.speed)
    """
    check_path("path", path, "give the folder that a scan wrote")
    verify = check_bool("verify", verify)
    metadata = _read_scan_metadata(Path(path))
    damaged_metadata = metadata.find_damaged() if verify else []
    try:
        group = _open_group(Path(path), "r", metadata)
        checksums = ChunkChecksums(Path(path), group, metadata)
        if verify:
            damage_description = describe_damage(
                path,
                checksums.find_damaged_chunks(),
                checksums.find_damaged_coordinates(),
                damaged_metadata,
            )
            if damage_description:
                raise ValueError(f"{damage_description}: {RECOMPUTE_REMEDY}")
        dataset = xr.open_zarr(
            path,
            consolidated=group.metadata.consolidated_metadata is not None,
            chunks=None,
            mask_and_scale=False,
            decode_times=False,
        )
    except METADATA_ERRORS as error:
        if isinstance(error, ValueError) and RECOMPUTE_REMEDY in str(error):
            raise
        reason = ", ".join(damaged_metadata) or " ".join(str(error).split()).rstrip(".")
        raise ValueError(
            f"{path} can't be opened ({reason}): run the scan again, which mends the arrays that "
            "it wrote, and delete others without dimension names."
        ) from error
    dataset = dataset.assign_attrs(
        {
            attribute_name: attribute_value
            for attribute_name, attribute_value in metadata.attributes.items()
            if attribute_name != "coordinates"
        }
    )
    return _arrange_as_requested(dataset)


RECOMPUTE_REMEDY = (
    "run the scan again, which computes these anew, or read the rest with "
    "open_scan(path, verify=False)."
)
METADATA_ERRORS = (
    ArithmeticError, AssertionError, AttributeError, LookupError, OSError, RuntimeError, TypeError,
    ValueError,
)  # fmt: skip
"""Exceptions that zarr, its codecs and xarray raise for metadata that they cannot interpret."""


def _open_group(path: Path, mode: Literal["r", "r+"], metadata: StoredMetadata) -> zarr.Group:
    """Return the group of a store, opened with the first copy of its metadata that can be read."""
    variables = metadata.mark_attributes.get(VARIABLES_KEY, ())
    for uses_consolidated in (None, False):
        try:
            group = zarr.open_group(
                path, mode=mode, zarr_format=3, use_consolidated=uses_consolidated
            )
            for name in (*metadata.coordinates, *variables, "outcome"):
                _get_array(group, name)
            return group
        except METADATA_ERRORS:
            if uses_consolidated is False:
                raise
    raise AssertionError


def _arrange_as_requested(dataset: xr.Dataset) -> xr.Dataset:
    """Return the dataset with the requested variables first, in their order and by their names.

    A file name cannot be "d speed / d damping", so the array of that variable in a store has
    another name.
    """
    requested_text = dataset.attrs.get(REQUESTED_ATTRIBUTE)
    names = (
        str(requested_text).split(", ")
        if requested_text
        else read_manifest(dataset.attrs).get("measures", [])
    )
    requested_names = {
        canonicalize_name(name): name
        for name in reversed(names)
        if canonicalize_name(name) in dataset
    }
    names_in_order = list(dict.fromkeys(map(canonicalize_name, names)))
    ordered_names = dict.fromkeys(
        [
            *(name for name in names_in_order if name in requested_names),
            *map(str, dataset.data_vars),
        ]
    )
    return dataset[list(ordered_names)].rename(
        {name: requested_names[name] for name in requested_names if name != requested_names[name]}
    )


def _read_scan_metadata(path: Path) -> StoredMetadata:
    """Return the metadata of a store; raise a ValueError if the folder is not a store of a scan."""
    metadata = StoredMetadata(path)
    if (
        metadata.root_metadata.get("node_type") != "group"
        or metadata.root_metadata.get("zarr_format") != 3
    ):
        raise ValueError(
            f"{path} is no scan's store: give the folder that `vrw scan` wrote, or a new place."
        )
    if MANIFEST_ATTRIBUTE not in metadata.attributes:
        raise ValueError(
            f"{path} is a Zarr store, but not a scan's: give the folder that `vrw scan` wrote."
        )
    return metadata


def read_stored_manifest(path: Path) -> dict | None:
    """Return the settings and provenance of the store at `path`, or None if there is no store."""
    if not path.exists() or (path.is_dir() and not any(path.iterdir())):
        return None
    attrs = _read_scan_metadata(path).attributes
    try:
        provenance_record = attrs.get(PROVENANCE_ATTRIBUTE, {})
        provenance_record = (
            json.loads(provenance_record)
            if isinstance(provenance_record, str)
            else provenance_record
        )
        return {MANIFEST_ATTRIBUTE: read_manifest(attrs), PROVENANCE_ATTRIBUTE: provenance_record}
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"{path} has damaged attributes ({error}): give another place for this scan."
        ) from error


def find_first_difference(
    stored_settings: object, current_settings: object, name: str = ""
) -> tuple[str, object, object]:
    """Return the name and both values of the first setting that differs, or ("", None, None)."""
    if isinstance(stored_settings, dict) and isinstance(current_settings, dict):
        for key in [
            *stored_settings,
            *(
                setting_name
                for setting_name in current_settings
                if setting_name not in stored_settings
            ),
        ]:
            nested_difference = find_first_difference(
                stored_settings.get(key),
                current_settings.get(key),
                f"{name}.{key}" if name else str(key),
            )
            if nested_difference[0]:
                return nested_difference
        return "", None, None
    return (
        ("", None, None)
        if stored_settings == current_settings
        else (name, stored_settings, current_settings)
    )


def create_store(path: Path, layout: ResultLayout, attrs: Mapping[str, object]) -> None:
    """Create an empty store at `path` atomically; a store that another process creates first is
    kept.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary_path = path.parent / f".{path.name}.{os.urandom(8).hex()}"
        temporary_path.mkdir()
    except OSError as error:
        reason = error.strerror or "no folder can be made there"
        raise OSError(
            error.errno, f"no store can be made at {path} ({reason}): give a place of your own"
        ) from error
    try:
        _create_arrays(temporary_path, layout, attrs)
        temporary_path.rename(path)
    except BaseException as error:
        shutil.rmtree(temporary_path, ignore_errors=True)
        if not (isinstance(error, OSError) and read_stored_manifest(path) is not None):
            raise


def _create_arrays(path: Path, layout: ResultLayout, attrs: Mapping[str, object]) -> None:
    """Create the Zarr group at `path` with its coordinates, empty variables and marks."""
    from zarr.codecs import Crc32cCodec, ZstdCodec

    # xarray reads from this attribute which arrays are coordinates, and removes it on opening.
    group_attrs = {**attrs, "coordinates": " ".join(layout.coordinates)}
    group = zarr.create_group(path, zarr_format=3, attributes=group_attrs)
    compressors = [ZstdCodec(level=3), Crc32cCodec()]  # The checksum reveals damage.
    for name, (dim, values, coordinate_attrs) in layout.coordinates.items():
        array = group.create_array(
            name,
            shape=values.shape,
            chunks=values.shape,
            dtype=values.dtype,
            dimension_names=(dim,),
            compressors=compressors,
            attributes=dict(coordinate_attrs),
        )
        array[:] = values
    for variable in layout.variables:
        group.create_array(
            variable.name,
            shape=(*layout.shape, *variable.shape),
            chunks=(*layout.chunk_shape, *variable.shape),
            dtype=variable.dtype,
            fill_value=variable.fill_value,
            dimension_names=(*layout.dims, *variable.dims),
            compressors=compressors,
            attributes=dict(variable.attrs),
        )
    chunks = (layout.n_chunks, DIGEST_SIZE_BYTES)
    mark_attributes = seal_attributes(
        {
            VARIABLES_KEY: [variable.name for variable in layout.variables],
            COORDINATES_KEY: {
                name: digest_values(np.asarray(values))
                for name, (_, values, _) in layout.coordinates.items()
            },
            ATTRIBUTES_KEY: dict(group_attrs),
        }
    )
    group.create_group(CHECKSUM_GROUP_NAME, attributes=mark_attributes).create_array(
        "digest", shape=chunks, chunks=(1, DIGEST_SIZE_BYTES), dtype="u1", fill_value=0
    )
    # All metadata are written into one file in this order, because zarr's function sorts them and
    # warns.
    names = [*layout.coordinates, *(variable.name for variable in layout.variables)]
    metadata_by_name = {
        name: json.loads((path / name / METADATA_FILE_NAME).read_text())
        for name in (*names, CHECKSUM_GROUP_NAME, CHECKSUM_ARRAY_NAME)
    }
    root_path = path / METADATA_FILE_NAME
    root = json.loads(root_path.read_text())
    root["consolidated_metadata"] = {
        "kind": "inline",
        "must_understand": False,
        "metadata": metadata_by_name,
    }
    root_path.write_text(json.dumps(root, indent=2))


def _rewrite_metadata(path: Path, layout: ResultLayout) -> None:
    """Write the metadata of the scan's arrays as they are in a new store, which is made
    temporarily.
    """
    stored_metadata = StoredMetadata(path)
    temporary_path = path.parent / f".{path.name}.{os.urandom(8).hex()}"
    try:
        temporary_path.mkdir()
        _create_arrays(temporary_path, layout, stored_metadata.attributes)
        stored_metadata.restore_metadata(StoredMetadata(temporary_path))
    finally:
        shutil.rmtree(temporary_path, ignore_errors=True)
