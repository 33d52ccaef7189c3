"""Where a scan's results are kept: in memory, or in a Zarr store that survives being killed.

A store is a Zarr group with one array per variable, cut into the scan's chunks, so that
`xarray.open_zarr` reads it. It appears whole (built beside its place, then renamed). A chunk's data
is written first and its mark after, a digest of what was written (`soundness`); every file is
written beside its place and renamed, so whatever moment the process dies at, a chunk is either
marked and complete or computed again.
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

Region = tuple[slice, ...]
Block = Mapping[str, np.ndarray]
"""Results of one chunk by variable; the samples' axes first."""


@dataclass(frozen=True)
class Variable:
    """One variable of the result. `dims` and `shape` are those beyond the samples' own."""

    name: str
    dtype: str
    missing: float | int
    attrs: Mapping[str, Any]
    dims: tuple[str, ...] = ()
    shape: tuple[int, ...] = ()

    @property
    def bytes_per_sample(self) -> int:
        """Size of one sample's value."""
        return np.dtype(self.dtype).itemsize * math.prod(self.shape)


@dataclass(frozen=True)
class Layout:
    """Axes, chunks, variables and coordinates of a result."""

    dims: tuple[str, ...]
    shape: tuple[int, ...]
    chunk: tuple[int, ...]
    variables: tuple[Variable, ...]
    coordinates: Mapping[str, tuple[str, np.ndarray, Mapping[str, Any]]]

    @property
    def n_chunks(self) -> int:
        return math.prod(self._counts)

    @property
    def _counts(self) -> tuple[int, ...]:
        return tuple(-(-n // c) for n, c in zip(self.shape, self.chunk, strict=True))

    def region(self, index: int) -> Region:
        places = np.unravel_index(index, self._counts)
        return tuple(
            slice(int(i) * c, min((int(i) + 1) * c, n))
            for i, c, n in zip(places, self.chunk, self.shape, strict=True)
        )

    def shape_of(self, index: int) -> tuple[int, ...]:
        return tuple(part.stop - part.start for part in self.region(index))

    @property
    def bytes_per_sample(self) -> int:
        """Size of one sample's results, uncompressed."""
        return sum(variable.bytes_per_sample for variable in self.variables)


def chunk_shape(shape: tuple[int, ...], most: int) -> tuple[int, ...]:
    """A box of at most `most` samples that is a slab of the array: the last axes are whole."""
    chunk, room = [1] * len(shape), most
    for axis in range(len(shape) - 1, -1, -1):
        chunk[axis] = min(shape[axis], max(room, 1))
        room //= chunk[axis]
        if chunk[axis] < shape[axis]:
            break
    return tuple(chunk)


class AbstractStore(abc.ABC):
    """Takes chunks, tells which are missing, gives the labelled whole."""

    place: str = "memory"
    damage: str = ""
    """What is damaged, in words; empty where nothing is."""

    @abc.abstractmethod
    def missing(self) -> list[int]:
        """Chunks still to compute, in order."""

    @abc.abstractmethod
    def write(self, index: int, block: Block) -> None:
        """Keep a chunk's results; when this returns the chunk is done."""

    @abc.abstractmethod
    def dataset(self) -> xr.Dataset:
        """The labelled whole."""

    @abc.abstractmethod
    def at_work(self) -> contextlib.AbstractContextManager[None]:
        """Around all writing: clears away what was left unfinished, lets no other work here."""


class MemoryStore(AbstractStore):
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
    """Results in a folder, chunk by chunk. `verify`: look for damage, to be computed again."""

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
    array = group[name]
    assert isinstance(array, zarr.Array)
    return array


def open_scan(path: str | Path, *, verify: bool = True) -> xr.Dataset:
    """The labelled result of a scan, finished or not; values are read when they are used.

    Where a scan isn't finished, samples not computed yet have the outcome -1 and NaN elsewhere. A
    store with damaged files is refused; `verify=False` opens it to read what can be read.

    Args:
        path: the store's folder.
        verify: whether each chunk's files are compared with their digest.

    Returns:
        The dataset that `scan` returns.

    Raises:
        FileNotFoundError: no store there.
        StoreError: a store with damaged files.

    Examples:
        >>> design = vrw.grid(damping=[150.0, 300.0])
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = f"{folder}/scan.zarr"
        ...     found = vrw.scan(design, ["speed"], store=path).load()
        ...     xr.testing.assert_identical(vrw.open_scan(path).speed.load(), found.speed)
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
    """Variables in the order and by the names that they were asked for, then the others.

    A file can't hold the name "d speed / d damping", so that in a store its array has another.
    """
    asked = dataset.attrs.get(ASKED)
    names = str(asked).split(", ") if asked else manifest_of(dataset.attrs).get("measures", [])
    told = {canonical(name): name for name in reversed(names) if canonical(name) in dataset}
    first = list(dict.fromkeys(map(canonical, names)))
    order = dict.fromkeys([*(n for n in first if n in told), *map(str, dataset.data_vars)])
    return dataset[list(order)].rename({n: told[n] for n in told if n != told[n]})


def _told_apart(dataset: xr.Dataset) -> xr.Dataset:
    """Stores of version 0.1 told two quantities as `stability_margin`, by rung: each by its name.

    It was the smooth Jury margin of the paper's wheel, and 1 - spectral radius on real ground.
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
    """Settings and provenance of the store at `path`; None where nothing is."""
    if not path.exists() or (path.is_dir() and not any(path.iterdir())):
        return None
    attrs = dict(_require_scan(path).attrs)
    origin = attrs.get(PROVENANCE, {})
    origin = json.loads(origin) if isinstance(origin, str) else origin
    return {MANIFEST: manifest_of(attrs), PROVENANCE: origin}


def first_difference(there: object, here: object, name: str = "") -> tuple[str, object, object]:
    """Name and values of the first setting that differs; ("", ...) where none does."""
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
    """Make an empty store at `path`, at once or not at all; there may be one in the meantime."""
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
    from zarr.codecs import Crc32cCodec, ZstdCodec

    # The attribute tells xarray which arrays are coordinates; it takes it off again when it opens.
    told = {**attrs, "coordinates": " ".join(layout.coordinates)}
    group = zarr.create_group(path, zarr_format=3, attributes=told)
    compressors = [ZstdCodec(level=3), Crc32cCodec()]  # a damaged file is noticed when read
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
    """All metadata in one file, in this order: zarr's own way sorts by name, and warns."""
    place = path / "zarr.json"
    told = json.loads(place.read_text())
    parts = {name: json.loads((path / name / "zarr.json").read_text()) for name in names}
    whole = {"kind": "inline", "must_understand": False, "metadata": parts}
    place.write_text(json.dumps(told | {"consolidated_metadata": whole}, indent=2))
