"""Libraries imported when they are first used: together they cost a second of every start."""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import diffrax as diffrax
    import xarray as xarray
    import zarr as zarr
else:

    class _Library:
        def __init__(self, name: str) -> None:
            self._name = name

        def __getattr__(self, attribute: str) -> Any:
            return getattr(importlib.import_module(self._name), attribute)

    diffrax, xarray, zarr = map(_Library, ("diffrax", "xarray", "zarr"))
