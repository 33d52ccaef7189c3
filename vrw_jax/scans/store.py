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
from typing import TYPE_CHECKING, Any

import numpy as np

from vrw_jax.models import VISCOELASTIC
from vrw_jax.results import MEASURES
from vrw_jax.runtime import library
from vrw_jax.runtime import xarray as xr
from vrw_jax.scans.offer import canonical
from vrw_jax.scans.soundness import (
    BOOKS,
    DIGEST,
    DONE,
    MANIFEST,
    SIZE,
    Books,
    alone,
    manifest_of,
    told_damage,
)
from vrw_jax.wording import instance

if TYPE_CHECKING:
    import zarr
else:
    zarr = library("zarr")

PROVENANCE, ASKED = "provenance", "asked"
"""Names of the attributes that hold the origin of the numbers and the requested measures."""

Region = tuple[slice, ...]
"""Slices of a chunk along the axes of the samples."""
Block = Mapping[str, np.ndarray]
"""Results of one chunk by variable; the axes of the samples come first."""


@dataclass(frozen=True)
class Variable:
    """Description of one variable; `dims` and `shape` leave out the axes of the samples."""

    name: str
    dtype: str
    missing: float | int
    attrs: Mapping[str, Any]
    dims: tuple[str, ...] = ()
    shape: tuple[int, ...] = ()

    @property
    def bytes_per_sample(self) -> int:
        """Return the size of the value of one sample, in bytes."""
        return np.dtype(self.dtype).itemsize * math.prod(self.shape)


@dataclass(frozen=True)
class Layout:
    """Description of a result: its axes, chunks, variables and coordinates."""

    dims: tuple[str, ...]
    shape: tuple[int, ...]
    chunk: tuple[int, ...]
    variables: tuple[Variable, ...]
    coordinates: Mapping[str, tuple[str, np.ndarray, Mapping[str, Any]]]

    @property
    def n_chunks(self) -> int:
        """Return the number of chunks."""
        return math.prod(self._counts)

    @property
    def _counts(self) -> tuple[int, ...]:
        """Return the number of chunks along each axis."""
        return tuple(-(-n // c) for n, c in zip(self.shape, self.chunk, strict=True))

    def region(self, index: int) -> Region:
        """Return the slices of a chunk along the axes of the samples."""
        places = np.unravel_index(index, self._counts)
        return tuple(
            slice(int(i) * c, min((int(i) + 1) * c, n))
            for i, c, n in zip(places, self.chunk, self.shape, strict=True)
        )

    def shape_of(self, index: int) -> tuple[int, ...]:
        """Return the shape of a chunk, which is smaller at the end of an axis."""
        return tuple(part.stop - part.start for part in self.region(index))

    @property
    def bytes_per_sample(self) -> int:
        """Return the size of the results of one sample, uncompressed, in bytes."""
        return sum(variable.bytes_per_sample for variable in self.variables)


def chunk_shape(shape: tuple[int, ...], most: int) -> tuple[int, ...]:
    """Return the shape of a slab of at most `max_samples` samples with whole last axes."""
    chunk, room = [1] * len(shape), most
    for axis in range(len(shape) - 1, -1, -1):
        chunk[axis] = min(shape[axis], max(room, 1))
        room //= chunk[axis]
        if chunk[axis] < shape[axis]:
            break
    return tuple(chunk)


class AbstractStore(abc.ABC):
    """Storage that accepts chunks, lists the missing ones and returns the labelled result."""

    place: str = "memory"
    damage: str = ""
    """Description of the damage; an empty string if there is none."""

    @abc.abstractmethod
    def missing(self) -> list[int]:
        """Return the chunks that are still to be computed, in ascending order."""

    @abc.abstractmethod
    def write(self, index: int, block: Block) -> None:
        """Write the results of a chunk and mark it as done."""

    @abc.abstractmethod
    def dataset(self) -> xr.Dataset:
        """Return the labelled result."""

    @abc.abstractmethod
    def at_work(self) -> contextlib.AbstractContextManager[None]:
        """Return the context of all writing, which removes unfinished files and holds the lock."""


class MemoryStore(AbstractStore):
    """Storage of a scan's results in memory."""

    def __init__(self, layout: Layout, attrs: Mapping[str, object]) -> None:
        self._layout, self._attrs = layout, attrs
        self._done = np.zeros(layout.n_chunks, bool)
        try:
            self._arrays = {
                v.name: np.full((*layout.shape, *v.shape), v.missing, v.dtype)
                for v in layout.variables
            }
        except MemoryError as error:
            size = math.prod(layout.shape)
            raise ValueError(
                f"the result of {size:,} samples takes {size * layout.bytes_per_sample / 1e9:,.0f} "
                "GB, more than this memory holds: give a store, whose chunks go to the disk."
            ) from error

    def missing(self) -> list[int]:
        return [int(i) for i in np.flatnonzero(~self._done)]

    def write(self, index: int, block: Block) -> None:
        region = self._layout.region(index)
        for name, array in self._arrays.items():
            array[region] = block[name]
        self._done[index] = True

    def at_work(self) -> contextlib.AbstractContextManager[None]:
        return contextlib.nullcontext()

    def dataset(self) -> xr.Dataset:
        layout = self._layout
        dataset = xr.Dataset(
            {
                v.name: ((*layout.dims, *v.dims), self._arrays[v.name], dict(v.attrs))
                for v in layout.variables
            },
            coords={
                name: (dim, values, dict(attrs))
                for name, (dim, values, attrs) in layout.coordinates.items()
            },
            attrs=dict(self._attrs),
        )
        return _as_asked(dataset)


class ZarrStore(AbstractStore):
    """Storage of a scan's results in a folder; `verify` finds damaged chunks."""

    def __init__(self, path: Path, layout: Layout, verify: bool = True) -> None:
        self._path, self._layout, self.place = path, layout, str(path)
        self._group = zarr.open_group(path, mode="r+", zarr_format=3)
        self._books = Books(path, self._group)
        self.damaged = self._books.damaged() if verify else []
        self._coordinates = self._books.damaged_coordinates() if verify else []
        self.damage = told_damage(path, self.damaged, self._coordinates)

    def missing(self) -> list[int]:
        done = self._books.done()
        done[np.asarray(self.damaged, int)] = False
        return [int(i) for i in np.flatnonzero(~done)]

    def write(self, index: int, block: Block) -> None:
        region = self._layout.region(index)
        for variable in self._layout.variables:
            _array(self._group, variable.name)[region] = block[variable.name]
        self._books.mark(index)
        self.damaged = [chunk for chunk in self.damaged if chunk != index]

    def dataset(self) -> xr.Dataset:
        return open_scan(self._path, verify=False)

    @contextlib.contextmanager
    def at_work(self) -> Iterator[None]:
        with alone(self._path):
            for path in self._path.rglob("*.partial"):
                path.unlink(missing_ok=True)
            for name in self._coordinates:
                _array(self._group, name)[:] = self._layout.coordinates[name][1]
            self._coordinates = []
            yield


def _array(group: zarr.Group, name: str) -> zarr.Array:
    """Return the array `name` of a Zarr group."""
    array = group[name]
    assert isinstance(array, zarr.Array)
    return array


def open_scan(path: str | Path, *, verify: bool = True) -> xr.Dataset:
    """Return the labelled result of a scan, finished or not; values are read when they are used.

    In an unfinished scan, samples that are not yet computed have the outcome -1 and the measures
    NaN. A store with damaged files is refused; `verify=False` opens it without that check.

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
    instance("path", path, (str, Path), "give the folder that a scan wrote")
    group = _require_scan(Path(path))
    books = Books(Path(path), group)
    if verify:
        damage = told_damage(path, books.damaged(), books.damaged_coordinates())
        if damage:
            raise ValueError(
                f"{damage}: run the scan again, which computes these anew, or read the rest with "
                "open_scan(path, verify=False)."
            )
    dataset = xr.open_zarr(
        path,
        consolidated=group.metadata.consolidated_metadata is not None,
        chunks=None,
        mask_and_scale=False,
        decode_times=False,
    )
    return _as_asked(_told_apart(dataset.drop_vars(DONE, errors="ignore")))


def _as_asked(dataset: xr.Dataset) -> xr.Dataset:
    """Return the dataset with the requested variables first, in their order and by their names.

    A file name cannot be "d speed / d damping", so in a store the array of it has another name.
    """
    asked = dataset.attrs.get(ASKED)
    names = str(asked).split(", ") if asked else manifest_of(dataset.attrs).get("measures", [])
    told = {canonical(name): name for name in reversed(names) if canonical(name) in dataset}
    first = list(dict.fromkeys(map(canonical, names)))
    order = dict.fromkeys([*(n for n in first if n in told), *map(str, dataset.data_vars)])
    return dataset[list(order)].rename({n: told[n] for n in told if n != told[n]})


def _told_apart(dataset: xr.Dataset) -> xr.Dataset:
    """Return the dataset of a store of version 0.1 with its two stability margins named apart.

    The name `stability_margin` meant the smooth Jury margin for the paper's wheel, and 1 - spectral
    radius with unilateral contact.
    """
    old = dataset.get("stability_margin")
    if old is None or old.attrs.get("symbol") != MEASURES["spectral_margin"].symbol:
        return dataset
    smooth, plain = (MEASURES[n].attrs for n in ("stability_margin", "spectral_margin"))
    kind = manifest_of(dataset.attrs)["model"]["kind"]
    if kind == "ViscoelasticWheel":
        return dataset.assign(stability_margin=old.assign_attrs(smooth))
    radius = dataset["spectral_radius"].astype(old.dtype)
    dataset = dataset.assign(spectral_margin=(1.0 - radius).assign_attrs(plain))
    if kind == "UnilateralWheel":
        return dataset.drop_vars("stability_margin")
    of_paper = old.where(dataset["rung"] == VISCOELASTIC).assign_attrs(smooth)
    return dataset.assign(stability_margin=of_paper)


def _require_scan(path: Path) -> zarr.Group:
    """Return the Zarr group of the scan at `path`; raise if there is none."""
    try:
        group = zarr.open_group(path, mode="r", zarr_format=3)
        attrs = dict(group.attrs)
    except (FileNotFoundError, NotADirectoryError, ValueError) as error:
        raise ValueError(
            f"{path} is no scan's store: give the folder that `vrw scan` wrote, or a new place."
        ) from error
    if MANIFEST not in attrs:
        raise ValueError(
            f"{path} is a Zarr store, but not a scan's: give the folder that `vrw scan` wrote."
        )
    return group


def stored_manifest(path: Path) -> dict | None:
    """Return the settings and provenance of the store at `path`, or None if there is no store."""
    if not path.exists() or (path.is_dir() and not any(path.iterdir())):
        return None
    attrs = dict(_require_scan(path).attrs)
    origin = attrs.get(PROVENANCE, {})
    origin = json.loads(origin) if isinstance(origin, str) else origin
    return {MANIFEST: manifest_of(attrs), PROVENANCE: origin}


def first_difference(there: object, here: object, name: str = "") -> tuple[str, object, object]:
    """Return the name and both values of the first setting that differs, or ("", None, None)."""
    if isinstance(there, dict) and isinstance(here, dict):
        for key in [*there, *(k for k in here if k not in there)]:
            below = first_difference(
                there.get(key), here.get(key), f"{name}.{key}" if name else str(key)
            )
            if below[0]:
                return below
        return "", None, None
    return ("", None, None) if there == here else (name, there, here)


def create(path: Path, layout: Layout, attrs: Mapping[str, object]) -> None:
    """Create an empty store at `path` atomically; keep a store that appears in the meantime."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        building = path.parent / f".{path.name}.{os.urandom(8).hex()}"
        building.mkdir()
    except OSError as error:
        reason = error.strerror or "no folder can be made there"
        raise OSError(
            error.errno, f"no store can be made at {path} ({reason}): give a place of your own"
        ) from error
    try:
        _fill(building, layout, attrs)
        building.rename(path)
    except BaseException as error:
        shutil.rmtree(building, ignore_errors=True)
        if not (isinstance(error, OSError) and stored_manifest(path) is not None):
            raise


def _fill(path: Path, layout: Layout, attrs: Mapping[str, object]) -> None:
    """Create the Zarr group at `path` with its coordinates, empty variables and marks."""
    from zarr.codecs import Crc32cCodec, ZstdCodec

    # xarray reads from this attribute which arrays are coordinates, and removes it on opening.
    told = {**attrs, "coordinates": " ".join(layout.coordinates)}
    group = zarr.create_group(path, zarr_format=3, attributes=told)
    compressors = [ZstdCodec(level=3), Crc32cCodec()]  # the checksum reveals damage
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
            chunks=(*layout.chunk, *variable.shape),
            dtype=variable.dtype,
            fill_value=variable.missing,
            dimension_names=(*layout.dims, *variable.dims),
            compressors=compressors,
            attributes=dict(variable.attrs),
        )
    chunks = (layout.n_chunks, SIZE)
    group.create_group(BOOKS).create_array(
        "digest", shape=chunks, chunks=(1, SIZE), dtype="u1", fill_value=0
    )
    _consolidate(path, [*layout.coordinates, *(v.name for v in layout.variables), BOOKS, DIGEST])


def _consolidate(path: Path, names: list[str]) -> None:
    """Write all metadata into one file in the given order; zarr's own function sorts and warns."""
    place = path / "zarr.json"
    told = json.loads(place.read_text())
    parts = {name: json.loads((path / name / "zarr.json").read_text()) for name in names}
    whole = {"kind": "inline", "must_understand": False, "metadata": parts}
    place.write_text(json.dumps(told | {"consolidated_metadata": whole}, indent=2))
